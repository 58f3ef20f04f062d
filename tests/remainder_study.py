"""What is smooth and has no name: on a table of one's own, and on tables that a model describes completely.

``python tests/remainder_study.py table ROBOT TABLE.csv`` prints the mean error of each region of joint space that is left
out, by geometry and elasticity, with the names of a discovery, and with what has no name.
``python tests/remainder_study.py sound N`` draws N tables of a KUKA, of 60 to 300 poses, that geometry and elasticity
describe, half of them with the noise declared, and counts those of which something is taken to be smooth and unnamed.
``python tests/remainder_study.py curves N`` draws N tables of a KUKA of which drives err by bumps in their own position,
or in that of two joints, that no entry describes, and compares regions of fresh poses without noise, by calibrate and as
delivered.
"""

from __future__ import annotations

import argparse
import warnings
from dataclasses import dataclass

import numpy as np
from machines import kuka as true_kuka
from scipy.stats import beta

from pincal import Options, Robot, calibrate
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.discover.policy import POLICY
from pincal.discover.run import run_discovery
from pincal.discover.smooth_rest import with_remainder
from pincal.discover.steps import History
from pincal.identify.split import joint_regions
from pincal.measure.measurements import measurements_from_arrays
from pincal.measure.table import read_measurements
from pincal.model.chain import MOMENT_FRAMES
from pincal.model.effects import ELASTIC, GEOMETRIC

SIGMA = 5e-5
POSES = (60, 120, 300)


def print_table(robot_of: str, path: str) -> None:
    """Print the errors of regions that are left out."""
    robot = Robot.from_urdf(robot_of)
    rows = read_measurements(path, robot)
    found = run_discovery(robot, rows, Options(effects=GEOMETRIC), moment_frames=MOMENT_FRAMES, remainder=True)
    print(found)
    for way, gap in found.findings.held_out.items():
        print(f"{way}: {gap['before'].mean_mm:.4f} -> {gap['after'].mean_mm:.4f} mm")
    smooth = found.findings.remainder
    if smooth is None:
        print("nothing smooth predicts regions that are left out better")
        return
    for part in smooth.parts:
        print(f"{part.errs}: {part.size:.2g} {part.unit} rms over {part.length_rad:g} rad, {part.parameters} amplitudes")
    print("rows, calibrated, named, with what has no name [mm]")
    for region in smooth.regions:
        print(f"{region.rows:5d} {region.calibrated_mm:.4f} {region.named_mm:.4f} {region.smooth_mm:.4f}")
    worse = sum(region.smooth_mm > region.calibrated_mm for region in smooth.regions)
    print(f"mean {smooth.named_mm:.4f} -> {smooth.smooth_mm:.4f} mm; {worse} regions worse than calibrated")


def is_taken(k: int) -> bool:
    """Return whether something smooth enters the model of the k-th sound table."""
    rng = np.random.default_rng([7, k])
    machine = true_kuka().draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    q = sim.plan_poses(machine.nominal, POSES[k % len(POSES)], rng)
    read = sim.Instrument(targets={"ball": (0.1, 0.0, 0.1)}).measure(machine, q, rng=rng)
    position = np.column_stack([read[axis] for axis in "xyz"]) + SIGMA * rng.standard_normal((len(q), 3))
    robot = Robot.from_urdf(kuka_urdf_path())
    rows = measurements_from_arrays(robot.joint_names, q, position=position)
    options = Options(effects=ELASTIC, moment_frame="after", sigma=None if k % 2 else SIGMA)
    fit = calibrate(robot, rows, options).fit
    _, rest = with_remainder(History(fit, first=fit, extra=(), policy=POLICY))
    return rest is not None


@dataclass(frozen=True)
class Fresh:
    """Mean errors of R regions of fresh poses, shape (R,) each [mm], and what was delivered."""

    calibrated: np.ndarray
    named: np.ndarray
    delivered: np.ndarray
    what: str

    def __str__(self) -> str:
        means = " -> ".join(f"{of.mean():.4f}" for of in (self.calibrated, self.named, self.delivered))
        worse = [int(np.sum(of > self.calibrated)) for of in (self.named, self.delivered)]
        return f"{means} mm, {self.what}; regions worse than calibrated: {worse[0]} by names, {worse[1]} as delivered"


def bent(q: np.ndarray, rng: np.random.Generator, *, pairs: bool) -> np.ndarray:
    """Return joint positions of which three drives err by five bumps each of up to .4 mrad, in one or two joints."""
    found = q.copy()
    for joint in rng.choice(6, 3, replace=False):
        of = [joint, *rng.choice(np.delete(np.arange(6), joint), 1)] if pairs else [joint]
        for _ in range(5):
            away = (q[:, of] - rng.uniform(-1.5, 1.5, len(of))) / rng.uniform(0.3, 0.9)
            found[:, joint] += rng.uniform(-4e-4, 4e-4) * np.exp(-0.5 * np.sum(away**2, axis=1))
    return found


def fresh_errors(k: int) -> Fresh:
    """Return the errors of regions of 1000 fresh poses, by models of the k-th table of 300, every other one of pairs."""
    rng = np.random.default_rng([11, k])
    machine = true_kuka().draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    q = sim.plan_poses(machine.nominal, 1300, rng)
    there = bent(q, rng, pairs=bool(k % 2))
    read = sim.Instrument(targets={"ball": (0.1, 0.0, 0.1)}).measure(machine, there, rng=rng)
    true = np.column_stack([read[axis] for axis in "xyz"])
    robot = Robot.from_urdf(kuka_urdf_path())
    some, fresh = np.arange(300), np.arange(300, 1300)
    noisy = true + SIGMA * rng.standard_normal(true.shape)
    rows = measurements_from_arrays(robot.joint_names, q[some], position=noisy[some])
    bare = Options(effects=GEOMETRIC, moment_frame="after")
    both = [run_discovery(robot, rows, bare, remainder=wanted) for wanted in (False, True)]
    plain = calibrate(robot, rows, Options(effects=ELASTIC, moment_frame="after"))
    at = plain.readings(measurements_from_arrays(robot.joint_names, q[fresh], position=true[fresh])).conditions
    region = joint_regions(q[fresh], 25, 0)
    means = []
    for fit in (plain, *(of.calibration.fit for of in both)):
        errors = 1e3 * np.linalg.norm(fit.predict(at)[:, :, 3] - true[fresh], axis=1)
        means.append(np.array([errors[region == one].mean() for one in np.unique(region)]))
    return Fresh(*means, str(both[1].findings.delivered))


def print_fresh(n: int) -> None:
    """Print the errors of n tables, and what all of them show together."""
    found = list[Fresh]()
    for k in range(n):
        found.append(fresh_errors(k))
        print(found[-1], flush=True)
    for name in ("named", "delivered"):
        worse = sum(int(np.sum(getattr(of, name) > of.calibrated)) for of in found)
        print(f"{name}: {worse} of {sum(len(of.calibrated) for of in found)} regions of fresh poses worse than calibrated")


def print_rate(n: int) -> None:
    """Print how many of n sound tables have something smooth, with an exact interval."""
    taken = [k for k in range(n) if is_taken(k)]
    most = float(beta.ppf(0.975, len(taken) + 1, n - len(taken))) if len(taken) < n else 1.0
    least = float(beta.ppf(0.025, len(taken), n - len(taken) + 1)) if taken else 0.0
    print(f"{len(taken)} of {n} sound tables, 95 % interval {least:.3f} to {most:.3f}; tables {taken}")


def main() -> None:
    """Print what was asked for."""
    parser = argparse.ArgumentParser(description="Print what a smooth remainder gains, or how often it is none.")
    asked = parser.add_subparsers(dest="asked", required=True)
    table = asked.add_parser("table")
    table.add_argument("robot", help="URDF, or the name of a robot, as for pincal discover")
    table.add_argument("table", help="measured poses")
    asked.add_parser("sound").add_argument("n", type=int, help="number of tables")
    asked.add_parser("curves").add_argument("n", type=int, help="number of tables")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    if chosen.asked == "table":
        print_table(chosen.robot, chosen.table)
    elif chosen.asked == "curves":
        print_fresh(chosen.n)
    else:
        print_rate(chosen.n)


if __name__ == "__main__":
    main()
