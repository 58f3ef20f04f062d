"""Designed poses: optimal where that can be worked out, within constraints, and as good as they say."""

import json
import re
from itertools import combinations, permutations

import coal
import numpy as np
import pytest
from command_line import run
from machines import planar_arm
from test_examples import numbers
from test_examples import run as run_example

from pincal import GEOMETRIC, DesignRequest, Options, Robot, calibrate, design_poses, measurements_from_arrays
from pincal.builtin import kuka_urdf_path
from pincal.design.collisions import Bodies, Boxes, read_collisions
from pincal.design.design_model import DesignModel, noncentrality
from pincal.design.exchange import (
    DesignState,
    choose_greedily,
    covariance,
    exchange,
    gains,
    information,
    length,
    lower_bound,
    short_route,
    travel,
    value,
)
from pincal.design.pose_design import PREDICTED_BY, observability, observed_directions
from pincal.design.reach import Limits, Reach, SensorSetup
from pincal.design.study import find_rival
from pincal.errors import BadInputError
from pincal.measure.table import read_measurements
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.simulate import Instrument, TrueMachine
from pincal.simulate.typical import draw_typical_elasticity, draw_typical_errors

KUKA = str(kuka_urdf_path())
TARGET = (0.08, 0.06, 0.15)
# What a tracker in front of the KUKA sees of its cell.
CELL = {"rig": SensorSetup(tool=TARGET, instrument=(4.5, -1.0, 1.2)), "limits": Limits(box=(0.8, -1.2, 0.2, 2.4, 1.2, 2.0))}
SMALL = {"candidates": 150, "refine": False, "curve": False}


def chosen_poses(robot, poses=None, options=None, *, rig=None, limits=None, **wanted):
    """Return the design of a request."""
    return design_poses(robot, DesignRequest(poses=poses, **wanted), options, rig=rig, limits=limits)


def candidates(seed, n=9, m=2, size=3):
    """Return random candidates, a weight, and priors."""
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(size, size))
    return rng.normal(size=(n, m, size)), half @ half.T, np.eye(size)


def criterion(A, W, H, chosen):
    return value(covariance(H + information(A, chosen)), W)


@pytest.fixture(scope="module")
def ur10():
    return Robot.from_urdf("ur10")


# Exchange.


@pytest.mark.parametrize("weighted", [True, False])
def test_exchange_finds_what_trying_all_designs_finds(weighted):
    """Over many small problems the exchange ends at the best of all subsets, but for a few near misses."""
    missed = []
    for seed in range(40):
        A, W, H = candidates(seed)
        W = W if weighted else None
        best = min(criterion(A, W, H, chosen) for chosen in combinations(range(len(A)), 4))
        found = criterion(A, W, H, exchange(A, W, H, choose_greedily(A, W, H, 4)[0]))
        missed.append(found - best)

    assert np.sum(np.array(missed) > 1e-9) <= 4
    assert max(missed) < 0.1


@pytest.mark.parametrize("weighted", [True, False])
def test_no_single_swap_is_left_that_helps(weighted):
    """Whatever it begins with, an exchange ends where each pose is the best beside the others."""
    A, W, H = candidates(1, n=60, m=3, size=6)
    W = W if weighted else None
    design = exchange(A, W, H, range(10))
    best = criterion(A, W, H, design)

    for place in range(10):
        rest = design[:place] + design[place + 1 :]
        others = [criterion(A, W, H, [*rest, j]) for j in range(60) if j not in rest]
        assert min(others) >= best - 1e-9 * abs(best)


@pytest.mark.parametrize("weighted", [True, False])
def test_updates_of_low_rank_equal_inverses(weighted):
    """Taking candidates in and out gives what working everything out again gives."""
    A, W, H = candidates(2, n=20, m=3, size=8)
    W = W if weighted else None
    state = DesignState.of(A, W, H).moved(3, 1.0).moved(7, 1.0).moved(3, -1.0)
    anew = DesignState.of(A, W, H + A[7].T @ A[7])

    np.testing.assert_allclose(state.C, anew.C, atol=1e-12)
    np.testing.assert_allclose(state.K, anew.K, atol=1e-11)
    if weighted:
        np.testing.assert_allclose(state.L, anew.L, atol=1e-11)


@pytest.mark.parametrize("weighted", [True, False])
def test_each_greedy_choice_is_the_best_where_hardly_anything_was_known(weighted):
    """Frames known to a metre before and to some micrometres after leave no rounding in what decides."""
    A, W, H = candidates(11, n=40, m=3, size=12)
    A[:, :, :6] *= 2e4
    W[:, :6] *= 2e4
    W[:6] *= 2e4
    W = W if weighted else None
    chosen, course = choose_greedily(A, W, H, 8)

    for n, j in enumerate(chosen):
        state = DesignState.of(A, W, H + information(A, chosen[:n]))
        free = np.setdiff1d(np.arange(len(A)), chosen[:n])
        assert state.gains()[j] >= (1.0 - 1e-6) * state.gains()[free].max()
        assert course[n] == pytest.approx(criterion(A, W, H, chosen[: n + 1]), rel=1e-6)


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("m", [1, 3, 6])
def test_gains_are_what_the_criterion_loses(weighted, m):
    """The gain of each candidate is the difference of the criterion with and without it."""
    A, W, H = candidates(3, m=m)
    W = W if weighted else None
    state = DesignState.of(A, W, H)
    lost = [criterion(A, W, H, []) - criterion(A, W, H, [j]) for j in range(len(A))]

    np.testing.assert_allclose(gains(state.K, state.L), lost, atol=1e-12)


def test_a_parabola_is_measured_at_its_ends_and_in_the_middle():
    """The D-optimal design for 1, x, x^2 on -1 .. 1 is a third of the readings each at -1, 0 and 1 (Smith 1918)."""
    x = np.tile(np.linspace(-1.0, 1.0, 21), 2)
    A = 1e3 * np.stack([x**0, x, x**2], axis=-1)[:, None]
    design = exchange(A, None, np.eye(3), choose_greedily(A, None, np.eye(3), 6)[0])

    assert sorted(x[design]) == [-1.0, -1.0, 0.0, 0.0, 1.0, 1.0]
    # Its determinant is 4 n^3 / 27, which no other design exceeds.
    closed = -np.log(4.0 * 6**3 / 27.0) - 3 * np.log(1e6)
    assert criterion(A, None, np.eye(3), design) == pytest.approx(closed, abs=1e-5)
    assert lower_bound(A, None, np.eye(3), 6, rounds=400) == pytest.approx(closed, abs=0.01)


@pytest.mark.parametrize("weighted", [True, False])
def test_nothing_falls_below_the_bound(weighted):
    """The best of all subsets is not below the bound, and the bound is not far."""
    for seed in range(5):
        A, W, H = candidates(seed)
        W = W if weighted else None
        best = min(criterion(A, W, H, chosen) for chosen in combinations(range(len(A)), 5))
        bound = lower_bound(A, W, H, 5, rounds=400)

        assert bound <= best + 1e-12
        assert bound > (0.6 * best if weighted else best - 1.5)


# Bodies, constraints.


@pytest.mark.parametrize("name", ["ur10", "panda", "kinova", KUKA])
@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
def test_frames_at_many_poses_equal_pinocchio(name, rng):
    """The tip that follows from the frames of all bodies is Pinocchio's."""
    robot = Robot.from_urdf(name)
    q = robot.random_configurations(10, rng)
    tips = robot.kinematics.frames(q)[:, -1] @ robot.frames.T_last_tip

    np.testing.assert_allclose(tips, robot.forward_kinematics(q), rtol=0, atol=1e-12)


def test_boxes_hide_what_lies_behind_them(rng):
    """A line is hidden if and only if some of its points lie in the box; a point in the box is not."""
    T = np.eye(4)
    T[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T[:3, 3] = 0.2, -0.1, 0.3
    half, eye, points = np.array([0.3, 0.2, 0.5]), np.array([2.0, 1.0, 0.5]), rng.normal(size=(400, 3))
    frames = np.tile(np.eye(4), (400, 1, 1, 1))
    hidden = Boxes(np.zeros(1, int), T[None], half[None]).hide(frames, eye, points)
    along = eye + np.linspace(0.0, 1.0, 4001)[:, None, None] * (points - eye)
    inside = np.all(np.abs((along - T[:3, 3]) @ T[:3, :3]) <= half, axis=2)

    np.testing.assert_array_equal(hidden, inside.any(axis=0) & ~inside[-1])


def test_boxes_hold_the_bodies(ur10, rng):
    """The lowest corner of the boxes is not above any vertex of the collision meshes."""
    bodies = Bodies.of(ur10)
    q = ur10.random_configurations(4, rng)
    frames = ur10.kinematics.frames(q)
    items = bodies.collisions.geometry.geometryObjects
    for row, lowest in zip(frames, bodies.boxes.lowest(frames, 2), strict=True):
        heights = []
        for i, item in enumerate(items):
            if bodies.boxes.body[i] >= 2 and isinstance(item.geometry, coal.BVHModelBase):
                T = row[bodies.boxes.body[i]] @ ur10.T_link_joint[bodies.boxes.body[i] - 1] @ item.placement.homogeneous
                vertices = item.geometry.vertices() * item.meshScale
                heights.append((vertices @ T[2, :3] + T[2, 3]).min())
        assert min(heights) - 0.25 < lowest <= min(heights) + 1e-9


def test_designed_poses_keep_to_all_constraints(ur10):
    """After refining, too: joint limits, floor, box, sight, cone and self-collision, each checked by itself."""
    rig = SensorSetup(tool=(0.05, 0.0, 0.1), instrument=(2.5, 0.5, 0.8), normal=(1.0, 0.0, 0.0), cone=np.radians(60.0))
    limits = Limits(span=0.5, floor=0.1, box=(-0.9, -0.9, 0.2, 0.9, 0.9, 1.2))
    found = chosen_poses(ur10, 6, Options(effects=GEOMETRIC), rig=rig, limits=limits, candidates=30, curve=False)
    q, bodies = found.q, Bodies.of(ur10, clearance=limits.clearance)
    frames, tips = ur10.kinematics.frames(q), ur10.forward_kinematics(q)
    targets = tips[:, :3, :3] @ rig.tool + tips[:, :3, 3]
    sight = np.array(rig.instrument) - targets

    assert np.all(np.abs(q) <= 0.5 * 2.0 * np.pi + 1e-9)
    assert np.all((targets > limits.box[:3]) & (targets < limits.box[3:]))
    assert np.all(bodies.boxes.lowest(frames, 3) >= 0.1)
    assert not bodies.boxes.hide(frames, np.array(rig.instrument), targets).any()
    assert not bodies.collisions.hit(q).any()
    assert np.all(np.einsum("ni,ni->n", tips[:, :3, 0], sight) >= 0.5 * np.linalg.norm(sight, axis=1) - 1e-9)
    assert set(found.drawn.removed) == {
        "floor at 0.1 m", "box", "facing the instrument within 60 deg", "line of sight", "self-collision",
    }  # fmt: skip


def test_the_shoulder_may_be_below_the_floor_and_no_later_link(ur10, rng):
    """The links of the first two joints may, the third's, all later ones and the target may not."""
    reach = Reach(ur10, SensorSetup(), Limits(span=1.0, floor=0.1))
    q = ur10.random_configurations(300, rng)
    frames, tips = ur10.kinematics.frames(q), ur10.forward_kinematics(q)
    target = tips[:, 2, :3] @ reach.target + tips[:, 2, 3]
    above = {joint: np.minimum(target, reach.bodies.boxes.lowest(frames, joint)) >= 0.1 for joint in (2, 3, 4)}

    assert np.array_equal(reach.allows_apart(q), above[3])
    assert above[2].sum() < above[3].sum() < above[4].sum()


def folding_arm(mesh: str = "", pedestal: str = '<cylinder radius="0.6" length="0.8"/>') -> Robot:
    """Return a planar arm that can fold onto its pedestal, with boxes around its links, one perhaps a mesh."""
    shape = f'<mesh filename="{mesh}"/>' if mesh else '<box size="0.4 0.1 0.1"/>'
    solid = '<collision><origin xyz="{} 0 0"/><geometry>{}</geometry></collision></link>'
    text = planar_arm()
    fore = solid.format(0.25, shape)
    base = '<link name="base">' + solid.format(0.0, pedestal)
    text = text.replace('<link name="base"/>', base)
    head, tail = text.split('<link name="fore">')
    return Robot.from_urdf((head + '<link name="fore">' + tail.replace("</link>", fore, 1)).encode())


def test_a_fold_is_a_collision_and_a_stretch_is_not():
    """The fore arm hits the pedestal when it is folded back, and only then."""
    collisions = Bodies.of(folding_arm()).collisions

    assert collisions.hit(np.array([[0.0, 0.0], [0.0, -2.9], [1.0, 0.3]])).tolist() == [False, True, False]


@pytest.mark.parametrize(("radius", "is_named"), [(1.36, False), (1.4, True)])
def test_links_that_always_touch_are_named_and_not_checked(radius, is_named):
    """The fore arm within a ball in more than 95 of 100 poses is there by construction; a little less often it collides."""
    bodies = Bodies.of(folding_arm(pedestal=f'<sphere radius="{radius}"/>'))

    assert any("touching by construction: base and fore" in note for note in bodies.notes) == is_named
    assert (bodies.collisions is None) == is_named


def test_a_missing_mesh_is_told_and_not_checked():
    """What is there is checked; what is not is named."""
    alone = Bodies.of(folding_arm("package://somewhere/fore.stl"))

    assert any("'package://somewhere/fore.stl' was not found" in note for note in alone.notes)
    assert alone.collisions is None


@pytest.mark.parametrize(
    ("pedestal", "said"),
    [
        ('<cylinder radius="0.6" length="0.8"/>', "collisions of 1 link (fore) are not checked"),
        ('<mesh filename="package://gone/base.stl"/>', "the collision meshes of 2 links can't be read"),
    ],
)
def test_one_missing_mesh_stands_for_all(pedestal, said):
    """However many meshes are missing, a single line says so, with a count."""
    _, notes = read_collisions(folding_arm("package://gone/fore.stl", pedestal), 0.0)

    assert len(notes) == 1
    assert said in notes[0] and "was not found" in notes[0]


def test_an_arm_without_collision_geometry_says_so():
    """Its self-collision is not checked, and lines of sight meet bars from joint to joint."""
    robot = Robot.from_urdf(planar_arm().encode())
    bodies = Bodies.of(robot)
    stretched = robot.kinematics.frames(np.zeros((1, 2)))

    assert bodies.collisions is None and "no collision geometry" in bodies.notes[0]
    assert bodies.boxes.hide(stretched, np.array([0.7, 0.0, 2.0]), np.array([[0.7, 0.0, -2.0]])).all()
    assert not bodies.boxes.hide(stretched, np.array([0.7, 1.0, 2.0]), np.array([[0.7, 1.0, -2.0]])).any()


@pytest.mark.parametrize(
    ("limits", "rig", "words"),
    [
        (Limits(floor=9.0), SensorSetup(), "floor at 9 m [1-9]"),
        (Limits(box=(5.0, 5.0, 5.0, 6.0, 6.0, 6.0)), SensorSetup(), "box [1-9]"),
        (
            Limits(),
            SensorSetup(instrument=(3, 0, 1), normal=(0, 0, 1), cone=1e-6),
            "facing the instrument within .* deg [1-9]",
        ),
    ],
)
def test_constraints_that_leave_nothing_are_named(limits, rig, words):
    """The error says which constraint removed how many poses."""
    with pytest.raises(BadInputError, match=words):
        chosen_poses(Robot.from_urdf(KUKA), 10, Options(effects=GEOMETRIC), rig=rig, limits=limits, candidates=10)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"poses": None}, "neither a number"),
        ({"poses": 0}, "0 poses"),
        ({"candidates": 4}, "4 candidates for 5 poses"),
        ({"accuracy": 1e-9}, "accuracy 1e-06 mm: 150 poses reach"),
        ({"accuracy": -1.0}, "accuracy -1 m"),
        ({"accuracy": 1e-4, "criterion": "determinant"}, "requires the criterion task"),
        ({"criterion": "guess"}, "expected task or determinant"),
        ({"payloads": [-1.0]}, "payloads -1"),
        ({"rig": SensorSetup(sensor="distance")}, "position of the instrument"),
        ({"rig": SensorSetup(sensor="scale")}, "expected one of position, pose, distance"),
        ({"options": Options(effects=GEOMETRIC, sigma=1e-9)}, "noise 1e-09"),
        ({"options": Options(effects=GEOMETRIC, sigma=9e-8)}, "noise 9e-08 .* expected 1e-07 or more"),
        ({"tell_apart": ("gear_rato:joint_1", "backlash:joint_1")}, "expected one of gear_ratio, "),
        ({"tell_apart": ("gear_ratio:joint_9", "backlash:joint_1")}, "not on 'joint_9'; expected one of .*joint_1"),
        ({"tell_apart": ("gear_ratio", "backlash:joint_1")}, "names no joint; expected gear_ratio:JOINT"),
        ({"tell_apart": ("base_elasticity:joint_1", "backlash:joint_1")}, "acts on the whole arm"),
        ({"tell_apart": ("gear_eccentricity:joint_1:order=9", "backlash:joint_1")}, "none has order=9"),
        ({"tell_apart": ("gear_eccentricity:joint_1:order=", "backlash:joint_1")}, "expected KEY=VALUE"),
        ({"tell_apart": ("thermal_offset:joint_1", "backlash:joint_1")}, "column temperature is missing"),
        ({"tell_apart": ("gear_ratio:joint_1", "gear_ratio:joint_1")}, "one and the same"),
    ],
)
def test_what_can_not_be_designed_is_refused(kuka, given, words):
    """Each with what was found and what is expected."""
    arguments = {"poses": 5, "options": Options(effects=GEOMETRIC)} | SMALL | given
    with pytest.raises(BadInputError, match=words):
        chosen_poses(kuka, **arguments)


def test_fields_of_the_request_may_still_be_given_to_the_function(kuka):
    """As they were before there was one, with a warning."""
    options = Options(effects=GEOMETRIC)
    with pytest.warns(DeprecationWarning, match="as a DesignRequest"):
        earlier = design_poses(kuka, 5, options, **SMALL)
    assert np.array_equal(earlier.q, chosen_poses(kuka, 5, options, **SMALL).q)


def test_an_arm_without_masses_can_be_designed_for():
    """Its moments are those that its shape suggests."""
    robot = Robot.from_urdf(planar_arm().replace('<mass value="10"/>', '<mass value="0"/>').encode())

    assert robot.massless == ("upper",)
    found = chosen_poses(robot, 5, limits=Limits(floor=None), **SMALL)
    assert len(found.q) == 5 and any("no usable masses" in note for note in found.notes)
    rigid = chosen_poses(robot, 5, Options(effects=GEOMETRIC), limits=Limits(floor=None), **SMALL)
    assert not any("masses" in note for note in rigid.notes)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: SensorSetup(normal=(1, 0, 0)), "position of the instrument"),
        (lambda: SensorSetup(instrument=(1, 0, 0), normal=(0, 0, 0)), "expected a direction"),
        (lambda: SensorSetup(cone=4.0), "cone"),
        (lambda: SensorSetup(tool=(np.nan, 0, 0)), "tool nan 0 0"),
        (lambda: Limits(span=0.0), "span 0"),
        (lambda: Limits(clearance=-1.0), "clearance -1"),
        (lambda: Limits(floor=np.nan), "floor at nan"),
        (lambda: Limits(box=(1, 1, 1, 0, 0, 0)), "box 1 1 1 0 0 0"),
    ],
)
def test_constraints_that_can_not_be_are_refused(make, words):
    """Before any pose is drawn."""
    with pytest.raises(BadInputError, match=words):
        make()


# What the poses will tell.


@pytest.mark.parametrize("sensor", ["position", pytest.param("pose", marks=pytest.mark.long), "distance"])
def test_foresight_is_the_derivative_of_the_readings(kuka, rng, sensor):
    """Central differences of the readings, in units of noise and priors, whatever the sensor is."""
    conditions = Conditions.at(kuka.random_configurations(5, rng), payload=50.0)
    rig = SensorSetup(sensor=sensor, tool=TARGET, instrument=(3.0, 1.0, 0.5))
    design_model = DesignModel.of(kuka, conditions, Options(sigma=2e-5, sigma_orientation=3e-4), rig)
    A = design_model.readings(conditions)
    noise = {"position": [2e-5] * 3, "pose": [2e-5] * 3 + [3e-4] * 3, "distance": [2e-5]}[sensor]
    for k in rng.choice(design_model.n_free, 12, replace=False):
        step = np.zeros(len(design_model.values))
        step[np.flatnonzero(design_model.free)[k]] = design_model.units[k] * 1e-4
        ahead, behind = (readings(design_model, design_model.values + sign * step, conditions, sensor) for sign in (1, -1))
        slope = (ahead - behind) / 2e-4 / np.array(noise)

        np.testing.assert_allclose(A[:, :, k], slope, rtol=1e-4, atol=1e-5 * np.abs(A[:, :, k]).max() + 1e-5)


def readings(design_model, values, conditions, sensor):
    """Return what a sensor reads, shape (N, m), by nothing but the model's prediction."""
    poses = design_model.model.predict(values, conditions)
    if sensor == "distance":
        return np.linalg.norm(poses[:, :, 3], axis=1)[:, None]
    if sensor == "position":
        return poses[:, :, 3]
    from scipy.spatial.transform import Rotation

    still = design_model.model.predict(design_model.values, conditions)[:, :, :3]
    turns = Rotation.from_matrix(poses[:, :, :3] @ still.transpose(0, 2, 1)).as_rotvec()
    return np.hstack([poses[:, :, 3], turns])


@pytest.mark.parametrize("options", [Options(sigma=5e-5), Options(effects=GEOMETRIC, sigma=1e-4)])
def test_a_fit_knows_its_predictions_as_well_as_was_foreseen(kuka, options):
    """The covariance of a calibration at designed poses gives the predicted error over the task."""
    q = kuka.random_configurations(60, np.random.default_rng(0))
    task = measurements_from_arrays(kuka.joint_names, q)
    found = chosen_poses(
        kuka, 40, options, rig=SensorSetup(tool=TARGET), task=task, candidates=200, curve=False, refine=False
    )
    conditions = found.conditions
    table = measurements_from_arrays(
        kuka.joint_names,
        found.q,
        position=found.design_model.model.predict(found.design_model.values, conditions)[:, :, 3],
    )
    fit = calibrate(kuka, table, options)
    _, J = fit.model.linearise(fit.values, Conditions.at(q), free=fit.solution.free)
    C = fit.solution.known.covariance
    error = np.sqrt(np.mean(np.einsum("nip,pq,niq->n", J, C, J)))

    # The fit scales compliances by the largest moments of its own 40 poses, the design by those of its candidates.
    assert found.found.designed.error == pytest.approx(error, rel=0.02)


def test_what_was_measured_counts(kuka):
    """The information of poses measured before adds to that of new ones, load by load."""
    options = Options(sigma=5e-5)
    first = chosen_poses(kuka, 25, options, payloads=[0.0, 100.0], **SMALL)
    columns = first.columns()
    measured = measurements_from_arrays(kuka.joint_names, first.q, payload=columns["payload"])
    more = chosen_poses(kuka, 10, options, payloads=[0.0, 100.0], measured=measured, seed=1, **SMALL)
    known, new = (more.design_model.readings(conditions).reshape(-1, more.design_model.n_free)
                  for conditions in (first.conditions, more.conditions))  # fmt: skip
    H = np.eye(more.design_model.n_free) + known.T @ known
    study_error = more.found.designed.error

    assert set(columns["payload"]) == {0.0, 100.0}
    assert study_error < more.found.random.error < more.before.error
    assert value(covariance(H + new.T @ new), None) < value(covariance(H), None)


def test_two_targets_measured_before_each_keep_their_place(kuka):
    """Each has unknowns of its own; new poses measure the first."""
    q = kuka.random_configurations(12, np.random.default_rng(0))
    measured = measurements_from_arrays(kuka.joint_names, np.tile(q, (2, 1)), target=np.repeat(["left", "right"], 12))
    found = chosen_poses(kuka, 5, Options(effects=GEOMETRIC), measured=measured, **SMALL)

    assert {"left.x", "right.x"} <= set(found.design_model.names)
    assert set(found.columns()["target"]) == {"left"}


def test_rivals_are_told_apart_by_what_a_refit_leaves(kuka):
    """The non-centrality is the signal of one effect that a least-squares fit of everything else can't take up."""
    pair = ("gear_ratio:joint_4", "backlash:joint_4")
    found = chosen_poses(kuka, 30, Options(effects=GEOMETRIC, sigma=5e-5), tell_apart=pair, **SMALL)
    design_model = found.design_model
    A = design_model.readings(found.conditions).reshape(-1, design_model.n_free)
    for mine, told in zip(design_model.rivals, found.found.designed.apart, strict=True):
        others = np.setdiff1d(np.arange(design_model.n_free), mine)
        # Priors are readings of zero.
        rest = np.vstack([A[:, others], np.eye(len(others))])
        signal = np.append(A[:, mine[0]], np.zeros(len(others))) / 10.0
        left = signal - rest @ np.linalg.lstsq(rest, signal, rcond=None)[0]

        assert told == pytest.approx(left @ left, rel=1e-6)
    assert min(found.found.designed.apart) > 1.5 * min(found.found.random.apart)
    assert {f"approach_{name}" for name in kuka.joint_names} < set(found.columns())


def test_rivals_are_found_by_name(kuka, rng):
    """With keys where there are several; compliances that are part of the model serve as they are."""
    chain, conditions = Chain.of(kuka), Conditions.at(kuka.random_configurations(30, rng), payload=80.0)
    wobble = find_rival("axis_wobble:joint_4:order=2,frame=after", chain, conditions)
    elastic = find_rival("joint_elasticity:joint_3", chain, conditions)
    design_model = DesignModel.of(kuka, conditions, Options(), SensorSetup(tool=TARGET), rivals=[wobble, elastic])

    assert (wobble.joint, wobble.order, wobble.frame) == ("joint_4", 2, "after")
    assert [design_model.names[i] for i in design_model.rivals[1]] == ["joint_3.k_z"]
    assert design_model.core.sum() == design_model.n_free - len(design_model.rivals[0])
    assert all(value > 0.0 for value in noncentrality(0.5 * np.eye(design_model.n_free), design_model.rivals))


def test_the_smallest_number_of_poses_reaches_the_accuracy(kuka):
    """As many as are told suffice, and one less does not."""
    arguments = {"options": Options(effects=GEOMETRIC, sigma=5e-5), "rig": SensorSetup(tool=TARGET)} | SMALL
    found = chosen_poses(kuka, accuracy=6e-5, **arguments)
    less = chosen_poses(kuka, found.needed - 1, **arguments)

    assert found.found.poses == found.needed
    assert found.found.designed.error <= 6e-5 < less.found.designed.error


def test_too_few_poses_are_warned_of(kuka):
    """With how many would do."""
    found = chosen_poses(kuka, 4, Options(effects=GEOMETRIC), **SMALL)

    (note,) = [note for note in found.notes if note.startswith("4 poses give 12 readings for")]
    fewest, better = (int(number) for number in re.search(r"expected (\d+) poses or more, better (\d+)", note).groups())
    assert fewest == np.ceil(found.rank / 3) and better == np.ceil(1.5 * found.rank / 3)


# The part of the predicted error that remains: 0.93 of it with the lower noise, 0.88 with the higher.
@pytest.mark.parametrize(("sigma", "is_useless"), [(3e-4, True), (5e-4, False)])
def test_an_error_that_no_number_of_poses_reduces_is_warned_of(kuka, sigma, is_useless):
    """Contacts leave the scale, so that more of them are useless, unless they are so noisy that more of them help, too."""
    held = SensorSetup(sensor="socket", tool=TARGET, held_at=((1.6, 0.6, 0.9), (1.4, -0.8, 1.3)))
    found = chosen_poses(kuka, 20, Options(effects=GEOMETRIC, sigma=sigma), rig=held, **SMALL)

    assert any("however many such poses" in note for note in found.notes) == is_useless


@pytest.mark.long
def test_refining_makes_a_design_better_and_the_curve_falls(kuka):
    """Refined poses are better than candidates; more poses are better than fewer; designed ones than random ones."""
    arguments = {"options": Options(effects=GEOMETRIC, sigma=5e-5), "candidates": 150}
    found = chosen_poses(kuka, 20, **arguments)
    plain = chosen_poses(kuka, 20, **arguments | SMALL)
    designed, drawn = ([getattr(point, name).error for point in found.curve] for name in ("designed", "random"))

    assert found.found.designed.error < 0.99 * plain.found.designed.error
    assert plain.found.designed.error > found.bound
    # No joint takes a position twice: its drive is seen at as many places as there are poses.
    spans = kuka.upper - kuka.lower
    assert np.all(np.diff(np.sort(found.q, axis=0), axis=0).min(axis=0) > 1e-5 * spans)
    assert np.all(np.diff(designed) < 0.0) and np.all(np.array(designed) < drawn)
    assert [point.poses for point in found.curve][:5] == [10, 15, 20, 30, 40]


def test_the_same_seed_gives_the_same_poses(kuka):
    """And another seed others."""
    one, two, other = (chosen_poses(kuka, 8, Options(effects=GEOMETRIC), seed=s, **SMALL).q for s in (3, 3, 4))

    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)


def test_determinant_designs_tell_more_of_the_parameters(kuka):
    """Their observability exceeds that of random poses; those of the task their error."""
    arguments = {"options": Options(effects=GEOMETRIC, sigma=5e-5), "rig": SensorSetup(tool=TARGET)} | SMALL
    task, volume = (chosen_poses(kuka, 25, criterion=name, **arguments) for name in ("task", "determinant"))

    assert set(task.observability) == set(PREDICTED_BY)
    assert volume.observability["O1"] > 1.1 * volume.observability_random["O1"]
    assert volume.observability["O1"] > task.observability["O1"]
    assert task.found.designed.error < volume.found.designed.error


def test_observability_indices_are_those_of_the_literature(kuka, rng):
    """Of singular values 6, 3 and 2 at 4 poses, by their formulas."""
    conditions = Conditions.at(kuka.random_configurations(5, rng))
    options = Options(effects=GEOMETRIC)
    design_model = DesignModel.of(kuka, conditions, options, SensorSetup(tool=TARGET))
    inner = np.flatnonzero(np.isfinite(design_model.sizes))[:3]
    H = np.zeros((design_model.n_free, design_model.n_free))
    H[inner, inner] = 36.0, 9.0, 4.0
    indices = observability(design_model, observed_directions(design_model, H, 1), H, 4)

    expected = {"O1": 36 ** (1 / 3) / 2, "O2": 1 / 3, "O3": 2.0, "O4": 2 / 3, "O5": 1.0}
    assert indices == pytest.approx(expected)


# Order and command.


def test_a_short_route_is_nearly_the_shortest(rng):
    """Among seven poses, against all orders; it visits each once and begins where it should."""
    for _ in range(10):
        distances = travel(rng.normal(size=(7, 3)), np.ones(3))
        order = short_route(distances, 2)
        best = min(length(distances, np.array((2, *rest))) for rest in permutations([0, 1, 3, 4, 5, 6]))

        assert order[0] == 2 and sorted(order) == list(range(7))
        assert length(distances, order) <= 1.15 * best


def test_poses_are_measured_load_by_load(kuka):
    """Loads change once, and the way is shorter than in the order in which poses were found."""
    found = chosen_poses(kuka, 30, Options(sigma=5e-5), payloads=[0.0, 100.0], **SMALL)

    assert np.all(np.diff(found.conditions.payload) >= 0.0)
    assert found.path_length < 0.8 * found.path_length_unordered


def test_the_command_writes_poses_that_simulate_takes(tmp_path, capsys):
    """From a design to a table of measurements, by files."""
    poses, data = tmp_path / "poses.csv", tmp_path / "data.csv"
    chosen = ["--poses", 25, "--model", "geometric", "--candidates", 60, "--payload", "0,50"]
    assert run("design", KUKA, *chosen, "--out", poses, "--quiet") == 0
    text = capsys.readouterr().out
    assert run("simulate", KUKA, "--at", poses, "--out", data, "--quiet") == 0
    table = read_measurements(data, Robot.from_urdf(KUKA).joint_names)

    assert len(table) == 25 and set(table.payload) == {0.0, 50.0}
    for words in (
        "25 poses",
        "floor at 0 m",
        "self-collision is not checked",
        "index O1",
        "How many poses?",
    ):
        assert words in text


@pytest.mark.long
def test_the_table_has_degrees_on_request_and_columns_to_fill_in(tmp_path):
    """Rows are the same poses; what the instrument will read is empty, and said to be so by whoever reads it."""
    chosen = ["--poses", 8, "--model", "geometric", "--candidates", 20, "--quiet"]
    assert run("design", KUKA, *chosen, "--out", tmp_path / "rad.csv") == 0
    assert run("design", KUKA, *chosen, "--degrees", "--out", tmp_path / "deg.csv", "--sensor", "pose") == 0
    header = [(tmp_path / f"{name}.csv").read_text().splitlines()[0].split(",") for name in ("rad", "deg")]
    names = Robot.from_urdf(KUKA).joint_names

    assert header[0] == [*names, "x", "y", "z"]
    assert header[1] == [*(f"{name} [deg]" for name in names), *"xyz", "qx", "qy", "qz", "qw"]
    rad, deg = (read_measurements(tmp_path / f"{name}.csv", names, require="joints").q for name in ("rad", "deg"))
    np.testing.assert_allclose(np.abs([rad, deg]) < 2.0 * np.pi, True)
    assert rad.shape == deg.shape == (8, 6)
    with pytest.raises(ValueError, match=r"none of \d+ rows has a reading"):
        read_measurements(tmp_path / "rad.csv", names)


def test_the_command_answers_programs(tmp_path, capsys):
    """With --json: the fewest poses for an accuracy, the curve, and what each constraint removed."""
    arguments = ["--accuracy", "0.1mm", "--model", "geometric", "--candidates", 100, "--instrument", 4, 0, 1]
    assert run("design", KUKA, *arguments, "--out", tmp_path / "p.csv", "--json", "--quiet") == 0
    found = json.loads(capsys.readouterr().out)

    assert found["needed"] == found["poses"] > 5
    assert found["designed"]["error_rms_mm"] <= 0.1
    assert set(found["candidates"]["removed"]) == {"floor at 0 m", "line of sight"}
    assert found["curve"][0]["poses"] == 10 and found["observability"]["designed"]["O1"] > 0.0


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ([], 2, "give --poses N"),
        (["--poses", "5", "--floor", "1", "--no-floor"], 2, "exclude each other"),
        (["--poses", "5", "--payload", "heavy"], 2, "masses in kg"),
        (["--poses", "5", "--box", 1, 1, 1, 0, 0, 0], 3, "box 1 1 1 0 0 0"),
        (["--poses", "5", "--measured", "nowhere.csv"], 3, "nowhere.csv: no such file"),
        (["--poses", "5", "--tell-apart", "backlash:joint_1", "magic"], 3, "effect 'magic': unknown"),
    ],
)
def test_the_command_refuses_what_can_not_be(tmp_path, capsys, arguments, code, words):
    """With the exit code of its kind, and nothing written."""
    out = tmp_path / "p.csv"

    assert run("design", KUKA, *arguments, "--candidates", 20, "--out", out, "--quiet") == code
    assert words in capsys.readouterr().err
    assert not out.exists()


def test_a_robot_that_hangs_has_no_floor(tmp_path, capsys):
    """Unless one is given."""
    arguments = ["--poses", 5, "--candidates", 20, "--model", "geometric", "--out", tmp_path / "p.csv", "--json", "--quiet"]
    assert run("design", KUKA, *arguments, "--gravity", 0, 0, 9.81) == 0

    assert json.loads(capsys.readouterr().out)["candidates"]["removed"] == {}


# What comes of it.


@pytest.mark.long
def test_designed_poses_are_better_on_a_machine_too(kuka):
    """From a cell, used all over the reach: predicted and found, at least 1.5 times less error than random poses leave."""
    options = Options(sigma=5e-5)
    found = chosen_poses(kuka, 40, options, **CELL, payloads=[100.0], candidates=400, curve=False)
    reach = Reach(kuka, **CELL)
    held_out = reach.draw(60, np.random.default_rng(1), measured=False).q
    errors = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        machine = draw_typical_errors(TrueMachine.from_urdf(KUKA, tip="tool0"), rng)
        machine = draw_typical_elasticity(machine, rng)
        drawn = reach.draw(40, rng).q
        errors.append([held_out_error(kuka, machine, q, held_out, options, rng) for q in (found.q, drawn)])
    designed, random = np.median(errors, axis=0)

    assert found.found.random.error > 1.5 * found.found.designed.error
    assert random > 1.5 * designed
    assert designed == pytest.approx(found.found.designed.error, rel=0.5)


def held_out_error(robot, machine, q, held_out, options, rng):
    """Calibrate from noisy positions at q; return the error at exact ones held out, root mean square [m]."""
    tables = []
    for poses, sigma in ((q, options.sigma), (held_out, 0.0)):
        load = np.full(len(poses), 100.0)
        seen = Instrument(targets=TARGET, sigma=sigma).measure(machine, poses, rng=rng, payload=load)
        position = np.column_stack([seen[axis] for axis in "xyz"])
        tables.append(measurements_from_arrays(robot.joint_names, poses, position=position, payload=load))
    fit = calibrate(robot, tables[0], options)
    return np.sqrt(np.mean(np.sum(fit.readings(tables[1]).residuals(fit.values) ** 2, axis=0)))


@pytest.mark.long
@pytest.mark.rooms(
    "examples/design_poses.py", "pincal/design", "pincal/identify", "pincal/measure", "pincal/model", "pincal/robot",
    "pincal/simulate", "pincal/calibration", "pincal/parameters.py",
)  # fmt: skip
@pytest.mark.parametrize("draws", [15, pytest.param(50, marks=pytest.mark.rates)])
def test_the_example_shows_what_design_is_worth(tmp_path, draws):
    """From a cell at least 1.5 times less error, predicted and realised; in the open nearly all that is possible."""
    text = run_example("design_poses.py", "--draws", str(draws), folder=tmp_path)
    cell, hall = text.split("in an open hall")

    for part, least in ((cell, 1.5), (hall, 1.2)):
        assert numbers(part, "predicted  ")[2] >= least
        assert numbers(part, "realised  ")[2] >= least
    bound = numbers(hall, "predicted lower bound for any choice of the candidates")[0]
    designed = numbers(hall, "predicted  ")[0]
    assert bound < designed < 1.05 * bound
