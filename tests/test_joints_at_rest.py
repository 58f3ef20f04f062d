"""Joints that stand still in all rows, at whatever position, as exactly as an encoder reads it."""

from __future__ import annotations

import numpy as np
import pytest

from pincal import GEOMETRIC, Options, Robot, measurements_from_arrays, run_discovery
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.discover.scatter import related
from pincal.identify.split import joint_regions, ways_held_out
from pincal.measure.measurements import Measurements
from pincal.model.catalogue.candidates import untestable
from pincal.model.catalogue.unnamed import nameless_candidates
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, PoseSet, moves

URDF = kuka_urdf_path()
ROBOT = Robot.from_urdf(URDF)
NOISE, JITTER, N = 3e-5, 1e-5, 100
TARGET = np.array([0.1, 0.05, 0.2])
# Joints that stand still; all others take any position.
AT_REST = {"the last": (5,), "the first three": (0, 1, 2), "all but two": (0, 3, 4, 5), "all but one": (0, 1, 3, 4, 5)}


def table(still: tuple[int, ...], *, at: float = np.pi / 4, jitter: float = 0.0) -> Measurements:
    """Return what an instrument reads of a KUKA some of whose joints stand still, read by encoders that jitter."""
    rng = np.random.default_rng(11)
    machine = sim.TrueMachine.from_urdf(URDF, tip="tool0").draw_errors(rng, sigma_length=3e-4, sigma_angle=5e-4)
    q = sim.plan_poses(machine.nominal, N, rng)
    q[:, still] = np.where(np.array(still) == 2, q[0, 2], at if at else 0.0)
    tip = machine.tip(q)
    position = tip[:, :3, 3] + tip[:, :3, :3] @ TARGET + NOISE * rng.standard_normal((N, 3))
    q[:, still] += jitter * rng.standard_normal((N, len(still)))
    return measurements_from_arrays(machine.names, q, position=position)


def together(groups: np.ndarray) -> np.ndarray:
    """Return which rows are in one group, shape (N, N)."""
    return np.asarray(groups[:, None] == groups)


@pytest.mark.parametrize("still", AT_REST.values(), ids=AT_REST)
def test_regions_are_those_of_the_joints_that_move(still: tuple[int, ...]) -> None:
    """The same wherever the others stand and however their encoders jitter, and many of them."""
    rng = np.random.default_rng(4)
    q = rng.uniform(-1.5, 1.5, (150, 6))
    alone = joint_regions(np.delete(q, still, axis=1), 25)
    assert alone.max() + 1 >= 15

    for at in (0.0, 0.785398163, -2.9):
        q[:, still] = at
        assert np.array_equal(together(joint_regions(q, 25)), together(alone))
        read = q.copy()
        read[:, still] += JITTER * rng.standard_normal((150, len(still)))
        assert np.array_equal(together(joint_regions(read, 25)), together(alone))


def test_where_no_joint_moves_there_is_one_region() -> None:
    """Of no rows there is none."""
    assert not joint_regions(np.full((7, 6), 0.3), 25).any()
    assert len(joint_regions(np.zeros((0, 6)), 25)) == 0


def test_a_joint_moves_if_it_moves_more_than_its_encoder_jitters() -> None:
    """A rail of 5 mm beside joints that turn does; so does each of two that turn by a milliradian."""
    rng = np.random.default_rng(0)
    q = np.column_stack([rng.uniform(-3.0, 3.0, 50), rng.uniform(0.0, 0.01, 50), np.full(50, 0.7)])
    q[:, 2] += JITTER * rng.standard_normal(50)

    assert moves(q).tolist() == [True, True, False]
    assert moves(rng.uniform(0.0, 1e-3, (50, 2))).all() and not moves(q[:1]).any()


@pytest.mark.parametrize("still", AT_REST.values(), ids=AT_REST)
def test_a_resting_joint_has_no_error_that_depends_on_its_position(still: tuple[int, ...]) -> None:
    """Jitter of its encoder would imitate one; the reason says that it does not move."""
    rows = table(still, jitter=JITTER)
    chain, conditions = Chain.of(ROBOT), Conditions.at(rows.q)
    resting = {ROBOT.joint_names[j] for j in still}

    assert PoseSet(chain, conditions).moving == tuple(name for name in ROBOT.joint_names if name not in resting)
    reasons = [reason for effect, reason in untestable(chain, conditions) if effect.locus.follows in resting]
    assert sum("does not move in any pose" in reason for reason in reasons) >= 5 * len(resting)
    assert not resting & {term.depends_on for term in nameless_candidates(chain, conditions, ROBOT.joint_names)}


def test_neighbours_are_near_in_the_joints_that_move() -> None:
    """Errors follow one joint, whatever the encoders of the others jitter."""
    rng = np.random.default_rng(6)
    q = rng.uniform(-1.5, 1.5, (6, 120))
    q[3:] = 0.4 + JITTER * rng.standard_normal((3, 120))
    errors = (np.sin(4.0 * q[0]) + rng.standard_normal(120)) / np.sqrt(1.5)

    assert related(dict(zip("abcdef", q, strict=True)), errors, np.full(120, np.sqrt(0.5))) == ("a",)


@pytest.mark.parametrize("jitter", [JITTER, pytest.param(0.0, marks=pytest.mark.long)])
@pytest.mark.parametrize(
    "still",
    [pytest.param(still, id=name, marks=() if len(still) == 3 else pytest.mark.long) for name, still in AT_REST.items()],
)
def test_a_sound_robot_is_found_sound_whatever_stands_still(still: tuple[int, ...], jitter: float) -> None:
    """Nothing is named, and regions are held out."""
    rows = table(still, jitter=jitter)
    assert ways_held_out(rows, 0.2)["regions"].any()
    found = run_discovery(ROBOT, rows, Options(effects=GEOMETRIC, sigma=NOISE))

    assert found.findings.effects == ()
    errors = found.calibration.result.error["calibrated"]
    assert {"regions", "stretches"} <= errors.keys()
