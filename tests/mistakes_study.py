"""How often mistakes of a table or a description are named: ``python tests/mistakes_study.py --out FILE.jsonl``.

Each draw is a machine with typical errors, what an instrument reads of it, and nothing, one thing or two that are wrong with
the table or the URDF. Draws are lines of a file as soon as they are done: a run that was stopped goes on where it was. Rates
stand with their exact 95 % intervals. A description counts as named if the calibration says it and the model is as good as
that of the true description; orientations if the refusal says what is wrong with them.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from placed_arms import FIRST, NOISE, TOOL
from rates import in_words, version
from rows_study import append, read
from scipy.spatial.transform import Rotation

from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.agreed import fit_agreed
from pincal.errors import BadInputError
from pincal.identify.calibrate import fit_tables
from pincal.identify.fit import ModelFit
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.model.effects import GEOMETRIC
from pincal.parameters import Covariance, Estimate
from pincal.robot.mastering import resized
from pincal.robot.robot import Robot
from pincal.robot.urdf_file import find_file
from pincal.simulate.typical import draw_typical_errors
from pincal.spread import end_with_parent

PLAIN = Options(effects=GEOMETRIC)
ROBOTS = ("kr125", "ur5", "ur10")
WRONG = ("orientation", "signs", "length", "zero", "coupling")
KINDS = ("few", "few typed", "sound", *WRONG, *(" and ".join(pair) for pair in combinations(WRONG, 2)))
# Poses of tables of few poses, and of others; poses that no table has, by which models are compared.
FEW = (6, 12)
MANY = (40, 80)
FRESH = 200
# Error of a model, relative to that of the true description, up to which it is as good; tables of a few tens of poses
# differ by chance.
AS_GOOD = 1.5


class Task(NamedTuple):
    """What is drawn."""

    kind: str
    seed: int


@dataclass(frozen=True)
class Drawn:
    """A machine, what is measured of it, and the URDF that it is taken for.

    Attributes:
        true: the robot as its controller has it, and has it been drawn.
        robot: the robot as described.
        table: what is given to the calibration.
        sound: the same readings with the joints as the true robot has them.
        fresh: poses that were not measured, with the joints as the table would have them, and their true positions.
        said: what has to be said, one word or more each.
    """

    true: Robot
    robot: Robot
    table: Measurements
    sound: Measurements
    fresh: tuple[np.ndarray, np.ndarray, np.ndarray]
    said: tuple[str, ...] = ()


@cache
def robot_of(name: str) -> tuple[Robot, Path]:
    """Return a robot and its URDF."""
    file = Path(kuka_urdf_path()) if name == "kr125" else Path(find_file(name))
    return Robot.from_urdf(file, tip="tool0"), file


def machine_of(robot: Robot, rng: np.random.Generator) -> sim.TrueMachine:
    """Return a machine with typical errors."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "robot.urdf"
        file.write_bytes(robot.urdf)
        return draw_typical_errors(sim.TrueMachine.from_urdf(file, tip=robot.tip), rng)


def poses_of(machine: sim.TrueMachine, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and rotations of a target on the tool, in the instrument's frame."""
    tip = FIRST @ machine.equilibrium(machine.poses(q)).tip
    target = Rotation.from_euler("xyz", (0.4, -0.9, 1.3)).as_matrix()
    return tip[:, :3, :3] @ TOOL + tip[:, :3, 3], tip[:, :3, :3] @ target


def draw(task: Task) -> Drawn:
    """Return a case."""
    rng = np.random.default_rng([task.seed, KINDS.index(task.kind)])
    given, _ = robot_of(ROBOTS[task.seed % len(ROBOTS)])
    wrong = task.kind.split(" and ")
    # The machine is that of the true robot; the URDF lacks what is wrong with it.
    true, said = lengthened(given, rng) if "length" in wrong else (given, ())
    machine = machine_of(true, rng)
    count = int(rng.integers(*(FEW if task.kind.startswith("few") else MANY), endpoint=True))
    q = 0.9 * true.random_configurations(count, rng)
    fresh = 0.9 * true.random_configurations(FRESH, rng)
    position, rotation = poses_of(machine, q)
    readings = {"position": position + NOISE * rng.normal(size=position.shape)}
    if "orientation" in wrong or (not task.kind.startswith("few") and rng.random() < 0.3):
        noisy = Rotation.from_rotvec(1e-4 * rng.normal(size=(count, 3))) * Rotation.from_matrix(rotation)
        readings["quaternion"] = noisy.as_quat()
    sound = measurements_from_arrays(true.joint_names, q, **readings)
    table = sound
    reported = fresh
    for what in wrong:
        if what in REPORTED:
            change, words = REPORTED[what](true, rng)
            table = replace(table, q=change(table.q))
            reported, said = change(reported), (*said, *words)
    if "orientation" in wrong:
        change, words = ORIENTATIONS[int(rng.integers(len(ORIENTATIONS)))]
        table = table.with_readings(quaternion=change(table.readings["quaternion"]))
        said = (*said, words)
    return Drawn(true, given, table, sound, (reported, fresh, poses_of(machine, fresh)[0]), said)


def lengthened(robot: Robot, rng: np.random.Generator) -> tuple[Robot, tuple[str, ...]]:
    """Return an arm of which a length that shows is some centimetres off, and that it is."""
    shown = [f"{robot.joint_names[i]}.a" for i in range(1, robot.n_joints - 2) if abs(robot.frames.parameters[i, 4]) > 0.02]
    name = str(rng.choice(shown))
    more = float(rng.uniform(0.015, 0.06) * rng.choice([-1, 1]))
    return resized(robot, {name: more}), (f"the length a of {name.split('.')[0]} ",)


Change = Callable[[np.ndarray], np.ndarray]
Reported = tuple[Change, tuple[str, ...]]


def signs(robot: Robot, rng: np.random.Generator) -> Reported:
    """One to three joints count the other way."""
    turned = rng.permutation(robot.n_joints)[: int(rng.integers(1, 4))]
    factor = np.where(np.isin(np.arange(robot.n_joints), turned), -1.0, 1.0)
    return lambda q: q * factor, tuple(f"{robot.joint_names[k]} counts in the opposite" for k in sorted(turned))


def zero(robot: Robot, rng: np.random.Generator) -> Reported:
    """An inner zero is off, by a right angle or any other."""
    joint = int(rng.integers(1, robot.n_joints - 1))
    angles = (*np.deg2rad([90.0, -90.0, 180.0]), *(rng.uniform(0.1, 0.8, 3) * rng.choice([-1, 1], 3)))
    shift = np.eye(robot.n_joints)[joint] * rng.choice(angles)
    return lambda q: q - shift, (f"{robot.joint_names[joint]} is shifted",)


def coupling(robot: Robot, rng: np.random.Generator) -> Reported:
    """A joint reports its position plus or minus its neighbour's."""
    joint = int(rng.integers(1, robot.n_joints))
    factor = float(rng.choice([-1, 1]))

    def change(q: np.ndarray) -> np.ndarray:
        q = q.copy()
        q[:, joint] += factor * q[:, joint - 1]
        return q

    return change, (f"{robot.joint_names[joint]} reports its position",)


REPORTED: dict[str, Callable[[Robot, np.random.Generator], Reported]] = {
    # What is coupled is so in the joints' own sense, and zeros are those of the reports.
    "coupling": coupling,
    "signs": signs,
    "zero": zero,
}


def _turned(change: Callable[[Rotation], np.ndarray | Rotation]) -> Change:
    def changed(quaternions: np.ndarray) -> np.ndarray:
        found = change(Rotation.from_quat(quaternions))
        return found.as_quat() if isinstance(found, Rotation) else found

    return changed


def _as(sequence: str, read: str = "xyz", factor: float = 1.0) -> Change:
    """Return orientations whose angles in one sequence are read in another one."""
    return _turned(lambda turned: Rotation.from_euler(read, factor * turned.as_euler(sequence)))


ORIENTATIONS: tuple[tuple[Change, str], ...] = (
    (_as("xyz", factor=np.pi / 180.0), "in radians, not degrees"),
    (_as("XYZ"), "angles about x, the new y and the new z"),
    (_as("ZYX"), "angles about z, the new y and the new x"),
    (_as("ZYZ"), "angles about z, the new y and the new z"),
    (_as("ZXZ"), "angles about z, the new x and the new z"),
    (_turned(lambda turned: Rotation.from_euler("xyz", turned.as_rotvec())), "a rotation vector"),
    (_turned(lambda turned: Rotation.from_rotvec(turned.as_euler("xyz"))), "angles about fixed x, y and z"),
    (_turned(lambda turned: turned.inv()), "inverted"),
    (_turned(lambda turned: turned.as_quat()[:, [3, 0, 1, 2]]), "w first"),
    (_turned(lambda turned: Rotation.from_euler("z", 90.0, degrees=True) * turned), "in another frame than the positions"),
    (_turned(lambda turned: Rotation.from_rotvec([0.3, -0.5, 0.2]) * turned), "in another frame than the positions"),
)


def said_of(task: Task) -> dict[str, Any]:
    """Return what a calibration says of a case, in types that JSON knows."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        case = draw(task)
        few = (
            typed(case.robot, np.random.default_rng(task.seed)) if task.kind == "few typed" else replace(PLAIN, sigma=NOISE)
        )
        options = few if task.kind.startswith("few") else PLAIN
        begun = time.perf_counter()
        notes: tuple[str, ...] = ()
        refused = ""
        ratio = None
        try:
            found = fit_agreed(case.robot, {"": case.table}, options)
        except BadInputError as error:
            refused = str(error)
        else:
            notes = found.notes
            ratio = _error(found.fit, case.fresh[0], case.fresh[2])
        seconds = time.perf_counter() - begun
        if ratio is not None:
            sound = fit_tables(case.true, {"": case.sound}, options)
            ratio /= _error(sound, case.fresh[1], case.fresh[2])
    return {
        **task._asdict(),
        "said": case.said,
        "notes": notes,
        "refused": refused,
        "ratio": ratio,
        "poses": len(case.table),
        "seconds": seconds,
    }


def typed(robot: Robot, rng: np.random.Generator) -> Options:
    """Return options with what seven machines of a type, calibrated well, say of another one."""
    fits = []
    for _ in range(7):
        machine = machine_of(robot, rng)
        q = 0.9 * robot.random_configurations(80, rng)
        position = poses_of(machine, q)[0]
        table = measurements_from_arrays(robot.joint_names, q, position=position + NOISE * rng.normal(size=position.shape))
        fits.append(fit_tables(robot, {"": table}, PLAIN).estimate)
    own = fits[0]
    here = np.array([not p.is_extrinsic and not p.station for p in own.parameters])
    values = np.array([one.values[here] for one in fits])
    sizes = np.array([p.size for p in own.parameters])[here]
    spread = values.std(axis=0, ddof=1) + 0.02 * sizes
    parameters = tuple(p for p, is_here in zip(own.parameters, here, strict=True) if is_here)
    covariance = Covariance.of(np.diag((1.1 * spread) ** 2))
    earlier = Estimate(parameters, values.mean(axis=0), np.ones(len(sizes), bool), covariance, sizes)
    return replace(PLAIN, earlier=earlier, sigma=NOISE)


def _error(fit: ModelFit, q: np.ndarray, true: np.ndarray) -> float:
    """Return the error of a model at poses that were not measured [m]."""
    from pincal.calibration.fitted_robot import FittedRobot

    return float(np.sqrt(np.mean(np.sum((FittedRobot.of(fit).predict(q)[:, :, 3] - true) ** 2, axis=1))))


def is_right(case: dict[str, Any]) -> bool:
    """Return whether nothing is said of a sound table, and what is wrong of another one."""
    if case["kind"].startswith("few") or case["kind"] == "sound":
        return not case["refused"] and not case["notes"]
    text = "; ".join((case["refused"], *case["notes"]))
    if "orientation" in case["kind"]:
        orientation = case["said"][-1] in case["refused"]
        others = case["said"][:-1]
        return orientation and (all(words in text for words in others) or text.count(": has it been") + 1 >= len(others))
    is_good = case["ratio"] is not None and case["ratio"] < AS_GOOD
    # Other signs and zeros describe the same arm: of a wrist that turns over, or joints that only turn base or tool.
    return is_good and (all(words in text for words in case["said"]) or bool(case["notes"]))


def summary(cases: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the rates in lines."""
    for kind in KINDS:
        own = [case for case in cases if case["kind"] == kind]
        if not own:
            continue
        seconds = np.median([case["seconds"] for case in own])
        if kind in ("few", "few typed", "sound"):
            refused = in_words(sum(bool(case["refused"]) for case in own), len(own))
            corrected = in_words(sum(bool(case["notes"]) for case in own), len(own))
            yield f"{kind:26} refused {refused}; corrected {corrected}; {seconds:.2f} s"
        else:
            yield f"{kind:26} named {in_words(sum(map(is_right, own)), len(own))}; {seconds:.2f} s"
    wrong = [is_right(case) for case in cases if case["kind"] not in ("few", "few typed", "sound")]
    if wrong:
        yield f"{'all that is wrong':26} named {in_words(sum(wrong), len(wrong))}"


def main() -> None:
    """Add draws to a file and print the rates of this version."""
    parser = argparse.ArgumentParser(description="Print how often mistakes are named, and sound tables accused.")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS, metavar="KIND", help=f"default: all: {KINDS}")
    parser.add_argument("--count", type=int, default=20, help="draws of each kind; default: 20")
    parser.add_argument("--seed", type=int, default=1, help="of the first draw; default: 1")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="lines of JSON; they add up")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes; default: one for each core")
    chosen = parser.parse_args()
    of = version()
    done = {Task(case["kind"], case["seed"]): case for case in read(chosen.out) if case["version"] == of}
    tasks = [Task(kind, seed) for seed in range(chosen.seed, chosen.seed + chosen.count) for kind in chosen.kinds]
    left = [task for task in tasks if task not in done]
    with ProcessPoolExecutor(chosen.workers, mp_context=get_context("forkserver"), initializer=end_with_parent) as pool:
        for future in as_completed([pool.submit(said_of, task) for task in left]):
            case = {"version": of, **future.result()}
            done[Task(case["kind"], case["seed"])] = case
            append(chosen.out, case)
    found = [done[task] for task in tasks]
    print("\n".join(summary(found)))
    for case in found:
        if not is_right(case):
            print(
                json.dumps({name: case[name] for name in ("kind", "seed", "poses", "said", "notes", "refused", "ratio")})[
                    :600
                ]
            )


if __name__ == "__main__":
    for _name in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[_name] = "1"  # for the processes that are started
    main()
