"""How a URDF lays its joint frames is a choice of words: every verb says the same of the same machine in other words.

The machines' axes meet at no right angle, or are parallel and perpendicular; the truth is the simulator's, of the URDF as
it was. The other URDF has its joint frames turned about their axes by random angles and slid along them by up to 0.1 m: a
bearing then sits elsewhere than where the URDF has the joint, which readings as good as these find out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rewritten_urdf import rewritten
from test_bearings import skew_arm

import pincal
import pincal.simulate as sim
from pincal import GEOMETRIC, Conditions, Options, Robot
from pincal.builtin import kuka_urdf_path
from pincal.measure.measurements import Measurements
from pincal.model.catalogue.drives import AxisWobble
from pincal.model.chain import MOMENT_FRAMES, Chain

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

SAME = 1e-6  # [m]
SIGMA = 5e-7  # of a coordinate [m]
TARGET = np.array([0.1, 0.05, 0.2])  # in the tip frame [m]
CENTRE = (0.02, 0.03, 0.1)
# Compliance of drives, shoulder to wrist [rad/(N m)].
SOFT = np.array([1.0, 1.0, 1.5, 8.0, 8.0, 12.0])


@dataclass(frozen=True, eq=False)
class Case:
    """A machine's rows, and the robot as each of the two URDFs has it."""

    machine: sim.TrueMachine
    robots: tuple[Robot, Robot]
    rows: Measurements
    later: Measurements
    options: Options

    def at(self, count: int = 100) -> Conditions:
        """Return other poses with a payload."""
        q = self.robots[0].random_configurations(count, np.random.default_rng(9))
        return Conditions.at(q, payload=20.0, payload_centre=CENTRE)

    @cached_property
    def fits(self) -> list[Any]:
        """Return the calibrations of both."""
        return [pincal.calibrate(robot, self.rows, self.options) for robot in self.robots]


@cache
def case_of(name: str) -> Case:
    """Return a machine by name: "kuka", or "skew" and a seed; with soft bearings, seen with and without a payload.

    With a "wobble" at the end the fourth axis tilts to and fro as it turns, and the fit knows of it.
    """
    rng = np.random.default_rng(4)
    kind, *more = name.split()
    text = Path(kuka_urdf_path()).read_text() if kind == "kuka" else skew_arm(int(more[0]))
    robots = Robot.from_urdf(text.encode()), Robot.from_urdf(rewritten(text, 5, slide=0.1).encode())
    robot = robots[0]
    nominal = sim.TrueMachine.from_urdf(text, tip=robot.tip, base=robot.base, gravity=(0.0, 0.0, -9.81))
    drive = SOFT * rng.uniform(0.7, 1.3, 6) * (3e-7 if kind == "kuka" else 1e-6)
    across = (1.0 if kind == "kuka" else 0.3) * drive
    machine = replace(
        nominal.draw_errors(rng, sigma_length=5e-4, sigma_angle=1e-3, sigma_offset=2e-3),
        compliance=np.column_stack([across, across * rng.uniform(0.5, 1.5, 6), drive]),
        moment_frame="after",
    )
    options = Options(moment_frame="auto", sigma=SIGMA, equilibrium=True, payload_centre=CENTRE)
    if more[1:] == ["wobble"]:
        joint = robot.joint_names[3]
        machine = machine.with_effects(sim.AxisWobble(joint=joint, size=2e-4, roundness=0.4))
        options = replace(options, effects=(*options.effects, AxisWobble(joint)))
    tables = [_measured(machine, robot, rng, count) for count in (150, 40)]
    return Case(machine, robots, *tables, options)


def _measured(machine: sim.TrueMachine, robot: Robot, rng: np.random.Generator, count: int) -> Measurements:
    q, payload = robot.random_configurations(count, rng), np.where(np.arange(count) % 2, 20.0, 0.0)
    tracker = sim.Instrument(pose=np.eye(4), targets=TARGET)
    read = tracker.measure(machine, q, payload=payload, payload_com=CENTRE)
    position = np.column_stack([read[axis] for axis in "xyz"]) + SIGMA * rng.standard_normal((count, 3))
    return pincal.measurements_from_arrays(machine.names, q, position=position, payload=payload)


def calibrated(case: Case) -> list[tuple[Any, dict[str, np.ndarray]]]:
    """The convention of moments and all parameters but where bearings sit along their axes, and predictions."""
    names = [{name for name in fit.estimate.names if not name.endswith(".h")} for fit in case.fits]
    return [
        ((fit.options.moment_frame, found), {"tip": fit.predict(case.at())[:, :3, 3]})
        for fit, found in zip(case.fits, names, strict=True)
    ]


def validated(case: Case) -> list[tuple[Any, dict[str, np.ndarray]]]:
    """Where the robot is at another station, found from few rows."""
    models = [fit.at() for fit in case.fits]
    found = [pincal.place_station(model, case.later) for model in models]
    return [(None, {"tip": placed.model.predict(case.at())[:, :3, 3]}) for placed in found]


def diagnosed(case: Case) -> list[tuple[Any, dict[str, np.ndarray]]]:
    """What changed when a joint's zero jumped, and the mended model."""
    offsets = case.later.q + np.array([0.0, 0.0, 4e-4, 0.0, 0.0, 0.0])
    found = [pincal.diagnose(fit, replace(case.later, q=offsets)) for fit in case.fits]
    names = [[(change.effect, change.joint) for change in each.changes] for each in found]
    return [(name, {"tip": each.model.predict(case.at())[:, :3, 3]}) for name, each in zip(names, found, strict=True)]


def compensated(case: Case) -> list[tuple[Any, dict[str, np.ndarray]]]:
    """Where the joints that are commanded bring the nominal arm, for places that the instrument sees."""
    at, robot = case.at(), case.robots[0]
    tips = robot.forward_kinematics(at.q)
    wanted = tips[:, :3, 3] + tips[:, :3, :3] @ TARGET
    found = [pincal.compensate_poses(fit.at(), wanted, at, orientation="free") for fit in case.fits]
    return [(each.status.tolist(), {"tip": robot.forward_kinematics(each.q)[:, :3, 3]}) for each in found]


def designed(case: Case) -> list[tuple[Any, dict[str, np.ndarray]]]:
    """The poses to measure and what they tell."""
    options = replace(case.options, moment_frame="after")
    request = pincal.DesignRequest(poses=25, candidates=150, curve=False, seed=1)
    found = [pincal.design_poses(robot, request, options) for robot in case.robots]
    return [(None, {"error": np.array(each.found.designed.error)}) for each in found]


def discovered(case: Case) -> list[tuple[Any, dict[str, np.ndarray]]]:
    """The names that a discovery finds: elasticity, and nothing else."""
    options = replace(case.options, effects=GEOMETRIC)
    found = [pincal.run_discovery(robot, case.rows, options, moment_frames=MOMENT_FRAMES) for robot in case.robots]
    names = [{(entry.effect, entry.joint) for entry in each.findings.effects} for each in found]
    assert {effect for effect, _ in names[0]} == {"joint_elasticity", "bearing_elasticity"}
    return [
        (name, {"tip": each.calibration.fit.predict(case.at())[:, :3, 3]}) for name, each in zip(names, found, strict=True)
    ]


@pytest.mark.long
def test_a_bearing_is_found_where_it_is() -> None:
    """Slid along its axis, a URDF's joint is no longer where the bearing is, and the fit says where that is."""
    case = case_of("skew 0")
    fits = case.fits
    seats = []
    for fit, robot in zip(fits, case.robots, strict=True):
        found = dict(zip(fit.estimate.names, zip(fit.estimate.values, fit.estimate.sigma, strict=True), strict=True))
        of_urdf = Chain.of(robot, moment_frame=fit.options.moment_frame).bearing_heights
        moves = [found.get(f"{joint}.h", (0.0, 0.0)) for joint in robot.joint_names]
        seats.append((of_urdf + [move for move, _ in moves], np.array([sigma for _, sigma in moves])))
    (at_joint, _), (places, sigma) = seats
    true = Chain.of(case.robots[0], moment_frame="after").bearing_heights
    # The first axis has its frame where the URDF has the joint.
    was, is_now = (robot.frames.T_base_first[:3] for robot in case.robots)
    slid = (is_now[:, 3] - was[:, 3]) @ is_now[:, 2]

    # Errors of the geometry move the feet of the common normals, from which heights are measured, by millimetres.
    np.testing.assert_allclose(at_joint, true, atol=8e-3)
    assert np.abs(places + np.eye(6)[0] * slid - true).max() < 8e-3 and (sigma > 0.0).sum() >= 5


@pytest.mark.long
@pytest.mark.parametrize(
    ("verb", "name"),
    [
        (compensated, "skew 0"),
        *(
            pytest.param(verb, name, marks=pytest.mark.long)
            for verb, name in [
                (calibrated, "skew 0"),
                (validated, "skew 0"),
                (diagnosed, "skew 0"),
                (designed, "skew 0"),
                (calibrated, "skew 0 wobble"),
                (discovered, "skew 0"),
            ]
        ),
        *(pytest.param(calibrated, name, marks=[pytest.mark.long, pytest.mark.rates]) for name in ("kuka", "skew 1")),
    ],
)
def test_a_verb_says_the_same_of_the_same_machine(
    verb: Callable[[Case], list[tuple[Any, dict[str, np.ndarray]]]], name: str
) -> None:
    """Same names, and places within a micrometre."""
    (names, places), (others, elsewhere) = verb(case_of(name))

    assert names == others
    for key, values in places.items():
        np.testing.assert_allclose(values, elsewhere[key], rtol=0.0, atol=SAME)
