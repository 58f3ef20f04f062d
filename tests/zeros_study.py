"""How often zeros, signs and couplings that differ from the URDF are found: ``python tests/zeros_study.py [DRAWS] [ROBOT]``.

Each draw is a machine with typical errors and compliances, 80 poses of it and a tracker with 0.05 mm of noise. What it
reports differs from the URDF as drawn. Held-out errors are compared with those of the same poses under the true description.
"""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from placed_arms import measured

from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.calibration import Calibration, run_calibration
from pincal.errors import BadInputError
from pincal.measure.measurements import Measurements
from pincal.robot.robot import Robot
from pincal.robot.urdf_file import find_file
from pincal.simulate.typical import draw_typical_elasticity, draw_typical_errors

PUBLISHED = next((f / "shared/robots" for f in Path(__file__).resolve().parents if (f / "shared/robots").is_dir()), None)
POSES = 80
Reported = tuple[np.ndarray, tuple[str, ...]]


@dataclass(frozen=True)
class Arm:
    """A robot of the study, and where its URDF is.

    Attributes:
        urdf: the file, or a name of example-robot-data.
        tip: of the arm.
        coupled: names of the two joints that are coupled.
    """

    urdf: str
    tip: str | None
    coupled: tuple[str, str]


ARMS = {
    "KR 125": Arm(str(kuka_urdf_path()), "tool0", ("joint_2", "joint_3")),
    "SO-101": Arm("so101", None, ("shoulder_lift", "elbow_flex")),
}
if PUBLISHED is not None:
    ARMS |= {
        "KR 16": Arm(str(PUBLISHED / "kuka/kuka_kr16_support/urdf/kr16_2.urdf"), "tool0", ("joint_a2", "joint_a3")),
        "IRB 2400": Arm(str(PUBLISHED / "abb/abb_irb2400_support/urdf/irb2400.urdf"), "tool0", ("joint_2", "joint_3")),
        "LR Mate": Arm(
            str(PUBLISHED / "fanuc/fanuc_lrmate200id_support/urdf/lrmate200id.xacro"), "tool0", ("joint_2", "joint_3")
        ),
    }


def drawn(arm: Arm, seed: int) -> tuple[Robot, Measurements]:
    """Return a robot and what is measured of a machine of it, reported as the URDF has it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        robot = Robot.from_urdf(arm.urdf, tip=arm.tip)
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        # The simulator takes no xacro.
        file = Path(folder) / "expanded.urdf"
        file.write_bytes(robot.urdf)
        machine = sim.TrueMachine.from_urdf(file if arm.urdf.endswith(".xacro") else find_file(arm.urdf), tip=robot.tip)
    machine = draw_typical_errors(machine, rng)
    if machine.nominal.masses.sum() > 0.0:
        machine = draw_typical_elasticity(machine, rng)
    tool = np.array([0.1, 0.05, 0.2]) * min(1.0, robot.reach)
    return robot, measured(machine, robot, poses=POSES, tool=tool, seed=seed, turn=0.9)


def _inner(robot: Robot, rng: np.random.Generator, count: int) -> list[int]:
    """Return joints whose zeros show: that of the first is a turn of the base, that of the last one of the tool."""
    inner = np.arange(1, robot.n_joints - 1)
    return sorted(rng.permutation(inner)[:count].tolist())


def one_shift(arm: Arm, robot: Robot, q: np.ndarray, rng: np.random.Generator) -> Reported:
    """One zero is 10 deg off."""
    return _shifts(robot, q, {_inner(robot, rng, 1)[0]: 10.0 * rng.choice([-1, 1])})


def five_shifts(arm: Arm, robot: Robot, q: np.ndarray, rng: np.random.Generator) -> Reported:
    """Five zeros, the first and the last among them, are 4 to 6 deg off."""
    joints = rng.permutation(robot.n_joints)[:5].tolist()
    return _shifts(robot, q, {i: float(rng.uniform(4.0, 6.0) * rng.choice([-1, 1])) for i in joints})


def quarter_turn(arm: Arm, robot: Robot, q: np.ndarray, rng: np.random.Generator) -> Reported:
    """One zero is 90 deg off."""
    return _shifts(robot, q, {_inner(robot, rng, 1)[0]: 90.0 * rng.choice([-1, 1])})


def _shifts(robot: Robot, q: np.ndarray, degrees: dict[int, float]) -> Reported:
    q = q.copy()
    for i, angle in degrees.items():
        q[:, i] -= np.deg2rad(angle)
    seen = {robot.joint_names[i]: angle for i, angle in degrees.items() if 0 < i < robot.n_joints - 1}
    return q, tuple(f"{name} is shifted by {angle:+.0f}" for name, angle in seen.items())


def one_sign(arm: Arm, robot: Robot, q: np.ndarray, rng: np.random.Generator) -> Reported:
    """One joint counts the other way."""
    i = int(rng.integers(robot.n_joints))
    return q * np.where(np.arange(robot.n_joints) == i, -1.0, 1.0), (f"{robot.joint_names[i]} counts in the opposite sense",)


def coupled(sign: float) -> Callable[[Arm, Robot, np.ndarray, np.random.Generator], Reported]:
    """The third joint reports its position minus or plus that of the second."""

    def reported(arm: Arm, robot: Robot, q: np.ndarray, rng: np.random.Generator) -> Reported:
        i, j = (robot.joint_names.index(name) for name in arm.coupled)
        q = q.copy()
        q[:, j] -= sign * q[:, i]
        return q, (f"{arm.coupled[1]} reports its position {'minus' if sign > 0 else 'plus'} that of {arm.coupled[0]}",)

    return reported


CASES: dict[str, Callable[[Arm, Robot, np.ndarray, np.random.Generator], Reported]] = {
    "one zero 10 deg": one_shift,
    "five zeros 4-6 deg": five_shifts,
    "one zero 90 deg": quarter_turn,
    "one sign": one_sign,
    "J3 minus J2": coupled(1.0),
    "J3 plus J2": coupled(-1.0),
}


def is_named(said: str, notes: tuple[str, ...]) -> bool:
    """Return whether a note says that; a shift to half a degree or so."""
    words, _, angle = said.rpartition(" ")
    if "shifted" not in said:
        return any(note.startswith(said) for note in notes)
    told = [note.removeprefix(words).split()[0] for note in notes if note.startswith(words)]
    return any(abs(float(number) - float(angle)) < 1.0 for number in told)


def tried(arm: Arm, case: str, seed: int) -> tuple[bool, float, float, str]:
    """Return whether it was found and named, the error over that of the true description, the seconds, and what was said."""
    robot, table = drawn(arm, seed)
    q, said = CASES[case](arm, robot, table.q, np.random.default_rng(seed))
    true = _quietly(robot, table)
    begun = time.perf_counter()
    try:
        found = _quietly(robot, replace(table, q=q))
    except BadInputError as error:
        return False, np.inf, time.perf_counter() - begun, str(error)
    seconds = time.perf_counter() - begun
    notes = corrections(found)
    right = all(is_named(one, notes) for one in said) and (len(notes) == len(said) or case.startswith("five"))
    return right, held_out(found) / held_out(true), seconds, "; ".join(notes) + " / " + "; ".join(said)


def corrections(found: Calibration) -> tuple[str, ...]:
    """Return the notes of a calibration on how the description was corrected."""
    words = (" is shifted by ", " counts in the opposite sense ", " reports its position ")
    return tuple(str(note) for note in found.notes if any(word in str(note) for word in words))


def held_out(found: Calibration) -> float:
    """Return the error on rows that were not fitted [mm]."""
    return found.result.error["calibrated"]["test"]["rms_mm"]


def _quietly(robot: Robot, table: Measurements) -> Calibration:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return run_calibration(robot, table, split="random")


def main(draws: int = 10, only: str = "", case: str = "") -> None:
    """Print the table."""
    for name, arm in ARMS.items():
        if only not in name:
            continue
        given = [one for one in CASES if case in one]
        for one in given:
            outcomes = [tried(arm, one, seed) for seed in range(draws)]
            count, ratios = sum(right for right, *_ in outcomes), [ratio for _, ratio, *_ in outcomes]
            seconds = np.mean([spent for *_, spent, _ in outcomes])
            words = f"{count} of {draws}, error x {np.median(ratios):.3f} (worst {max(ratios):.3f}), {seconds:.1f} s"
            print(f"{name:9s} {one:19s} {words}", flush=True)
            for seed, (right, ratio, _, text) in enumerate(outcomes):
                if not right or ratio > 1.05:
                    print(f"    {seed}: {ratio:.3f} {text[:300]}", flush=True)
        falsely = [corrections(_quietly(*drawn(arm, 100 + seed))) for seed in range(0 if case else draws)]
        print(f"{name:9s} sound: {sum(map(bool, falsely))} of {len(falsely)} corrected", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10, *sys.argv[2:])
