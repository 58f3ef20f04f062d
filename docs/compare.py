"""Calibrate the same simulated robot with pincal and with other programs, and print how long they take and how good it is.

Each program gets a virtual environment of its own, filled from the package index, and runs as a process of its own, one at a
time and on one thread, through a small adaptor in ``peers/``: what a user of that program would write. Run it as

    python docs/compare.py [--truth geometry] [--poses 100 1000] [--tools pincal figaroh] [--keep FOLDER]

The robot is the built-in KUKA KR 125/2 with errors in its Denavit-Hartenberg parameters, 1 mm and 1.5 mrad (standard
deviations), and a reflector off the flange, measured with 0.05 mm of noise on each coordinate. The result is judged at 500
other poses without noise. Positions are in the robot's base frame, as most of the programs expect them. With ``--truth
drives`` the drives are compliant under the robot's own weight as well, with ``bearings`` the bearings, too; programs that
know of elasticity then use it, and masses are those of the URDF.

Seconds are those of the processor, from data in memory to a predicting model, without imports: the shortest of a few fits.
They depend on the machine and what else it does; compare the ratios of one run.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import venv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pincal.builtin import kuka_urdf_path
from pincal.simulate import Instrument, TrueMachine, plan_poses

ADAPTORS = Path(__file__).resolve().parent / "peers"
# What is installed for each; pincal is the one that runs this script.
TOOLS: dict[str, tuple[str, ...]] = {
    "pincal": (),
    "figaroh": ("figaroh==1.0.2",),
    "robotkinecal": ("robotkinecal==0.1.0",),
    "pybotics": ("pybotics==3.1.2",),
}
NOISE = 5e-5  # standard deviation of one coordinate [m]
LENGTH, ANGLE = 1e-3, 1.5e-3  # standard deviations of the errors [m, rad]
REFLECTOR = (0.05, 0.03, 0.12)  # in the flange's frame [m]
OTHER = 500
DRIVES = np.array([3e-7, 3e-7, 4e-7, 1.5e-6, 2e-6, 3e-6])  # compliances about the joint axes [rad/(N m)]
BEARINGS = 0.4  # those about the axes across, as part of these
TRUTHS = ("geometry", "drives", "bearings")
# d_i z, a_i x of Table I end at the next joint, whose frame is turned by alpha_i about x.
ALPHA = np.array([np.pi / 2, 0.0, np.pi / 2, -np.pi / 2, np.pi / 2, 0.0])
COLUMNS = ("tool", "poses", "parameters", "seconds", "ratio", "held out [um]")
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def true_machine(truth: str, rng: np.random.Generator) -> TrueMachine:
    """Return the KUKA with errors in all of its 24 Denavit-Hartenberg parameters, and perhaps elasticity.

    T_i = Rz(q_i + theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i) ends at the frame of joint i + 1: errors of a and alpha are along and
    about its x, those of d along the axis of joint i, which in this frame is turned back by alpha.
    """
    d, a = LENGTH * rng.standard_normal((2, 6))
    alpha, theta = ANGLE * rng.standard_normal((2, 6))
    errors = np.zeros((7, 6))
    errors[1:, :4] = np.column_stack([a, d * np.sin(ALPHA), d * np.cos(ALPHA), alpha])
    across = DRIVES * BEARINGS * (truth == "bearings")
    compliance = np.column_stack([across, across, DRIVES * (truth != "geometry")])
    errors_and_springs = {"placement_errors": errors, "joint_offsets": theta, "compliance": compliance}
    return TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0", **errors_and_springs)


def write_data(path: Path, truth: str, poses: int) -> None:
    """Simulate a table of poses and one to judge by; joints [rad], shape (N, 6), and positions [m], shape (N, 3)."""
    rng = np.random.default_rng(1)
    machine = true_machine(truth, rng)
    other = plan_poses(machine.nominal, OTHER, rng)
    q = plan_poses(machine.nominal, poses, rng)

    def positions(joints: np.ndarray, sigma: float) -> np.ndarray:
        columns = Instrument(targets=REFLECTOR, sigma=sigma).measure(machine, joints, rng=rng)
        return np.column_stack([columns[axis] for axis in "xyz"])

    tables = {"q": q, "position": positions(q, NOISE), "other_q": other, "other_position": positions(other, 0.0)}
    np.savez(path, reflector=REFLECTOR, elastic=truth != "geometry", **tables)


def python_of(tool: str, folder: Path) -> Path:
    """Return the Python that has a program, installed into a folder unless it is there; pincal's own is this one.

    Raises:
        subprocess.CalledProcessError: If it can't be installed.
    """
    if not TOOLS[tool]:
        return Path(sys.executable)
    place = folder / tool
    python = place / ("Scripts" if os.name == "nt" else "bin") / "python"
    done = place / "installed"
    if not done.is_file():
        print(f"installing {' '.join(TOOLS[tool])}", file=sys.stderr, flush=True)
        venv.create(place, with_pip=True, clear=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", *TOOLS[tool]], check=True, capture_output=True, text=True)
        done.touch()
    return python


def run(tool: str, environments: Path, truth: str, poses: int) -> dict[str, float]:
    """Fit with one program; return the number of parameters, seconds and the held-out rms [um].

    Raises:
        subprocess.CalledProcessError: If its installation or its adaptor fails.
    """
    variables = os.environ | dict.fromkeys(_THREADS, "1")
    if TOOLS[tool]:
        variables.pop("PYTHONPATH", None)
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data.npz"
        write_data(data, truth, poses)
        command = [python_of(tool, environments), ADAPTORS / f"run_{tool}.py", kuka_urdf_path(), data]
        done = subprocess.run(command, env=variables, cwd=folder, check=True, capture_output=True, text=True)
    result: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return result


def compare(truth: str, tools: Sequence[str], poses: Sequence[int], environments: Path) -> bool:
    """Print the table, a row for each program and number of poses; return whether all of them ran."""
    complete = True
    print("{:13s} {:>6s} {:>11s} {:>9s} {:>7s} {:>14s}".format(*COLUMNS))
    for count in poses:
        own = None
        for tool in tools:
            try:
                found = run(tool, environments, truth, count)
            except subprocess.CalledProcessError as error:
                complete = False
                reason = (error.stderr or "").strip().splitlines() or ["no message"]
                print(f"{tool:13s} {count:6d}  failed: {reason[-1]}", flush=True)
                continue
            own = found["seconds"] if tool == "pincal" else own
            ratio = "-" if own is None else f"{found['seconds'] / own:.0f}"
            numbers = f"{found['parameters']:11.0f} {found['seconds']:9.3f} {ratio:>7s} {found['held_out_um']:14.2f}"
            print(f"{tool:13s} {count:6d} {numbers}", flush=True)
    return complete


def main() -> None:
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--truth", choices=TRUTHS, default="geometry", help="what is compliant, too (default: nothing)")
    parser.add_argument("--poses", type=int, nargs="+", default=[100, 1000], help="sizes of the tables (default: 100 1000)")
    parser.add_argument("--tools", nargs="+", choices=TOOLS, default=list(TOOLS), help="which programs (default: all)")
    parser.add_argument("--keep", type=Path, help="folder for the environments, kept for the next run (default: temporary)")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        environments = (chosen.keep or Path(temporary)).resolve()
        complete = compare(chosen.truth, chosen.tools, chosen.poses, environments)
    sys.exit(not complete)


if __name__ == "__main__":
    main()
