"""Contacts: what they show, what they leave at its prior, and that no fit of them does harm.

The hands of Baxter, simulated by Pinocchio; the robot has the deviations of an arm of three tenths of the usual size.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import compress
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.special import chdtri
from test_named_points import contacts

import pincal.simulate as sim
from pincal import GEOMETRIC, BadInputError, Options, Robot, Setup, calibrate, measurements_from_arrays
from pincal.calibration.calibration import run_calibration
from pincal.calibration.caveats import CaveatKind
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.improvement import findings_without_instrument, improvements, unseen_directions
from pincal.calibration.placing import place_station
from pincal.calibration.validation import validate_rows
from pincal.cli import main
from pincal.cli.common import InputOptions, LinkOptions, TableArguments
from pincal.cli.inputs import load_robot, load_table
from pincal.design.pose_design import DesignRequest, design_poses
from pincal.design.reach import Limits, Reach, SensorSetup
from pincal.errors import Exit, PincalWarning
from pincal.identify.calibrate import fit_tables
from pincal.identify.criteria import CRITERIA
from pincal.identify.fit import ModelFit
from pincal.identify.options import PriorScale
from pincal.identify.prior_scale import prior_scale
from pincal.measure.measurements import Measurements
from pincal.measure.table import read_measurements, stations_of
from pincal.model.model import Model
from pincal.motion.cli.motion_options import MotionOptions
from pincal.report.judgement import next_steps
from pincal.robot.urdf_file import arm_text
from pincal.sensors.plane import PlaneContactSensor
from pincal.simulate.planning import plan_poses
from pincal.validate.outcome import Improvement

HANDS = "left_gripper", "right_gripper"
NOISE = 5e-5


@pytest.fixture(scope="module")
def baxter() -> Robot:
    """Return both arms, as seen from the left hand."""
    return Robot.from_urdf("baxter", start=HANDS[0], tip=HANDS[1], paths=[("base", hand) for hand in HANDS])


def drawn(baxter: Robot, seed: int) -> sim.TrueMachine:
    """Return true arms between the hands."""
    text = arm_text(baxter.urdf, baxter.joint_names, baxter.source)
    found = sim.TrueMachine.from_urdf(text, tip=HANDS[1], base="base", start=HANDS[0], joints=baxter.joint_names)
    return found.draw_errors(np.random.default_rng(seed), sigma_length=1e-4, sigma_angle=3e-4, sigma_offset=6e-4)


def touched(baxter: Robot, machine: sim.TrueMachine) -> Measurements:
    """Return contacts of the right hand in two sockets on the left one."""
    rng = np.random.default_rng(4)
    places = {"one": np.array([0.1, 0.05, 0.2]), "two": np.array([-0.1, 0.1, 0.15])}
    setup = sim.Contact(fixed=places, tool=(0.02, 0.03, 0.1), sigma=NOISE)
    table = setup.measure(machine, setup.plan(machine.nominal, 160, rng=rng, min_height=None), rng=rng)
    q = np.column_stack([table[name] for name in baxter.joint_names])
    links = {"from_link": np.repeat(HANDS[0], len(q)), "to_link": np.repeat(HANDS[1], len(q))}
    return measurements_from_arrays(baxter.joint_names, q, socket=table["socket"], **links)


def tracked(baxter: Robot, machine: sim.TrueMachine) -> Measurements:
    """Return exact positions of the right hand as a tracker sees it."""
    text = arm_text(baxter.urdf, baxter.joint_names, baxter.source)
    nominal = sim.TrueMachine.from_urdf(text, tip=HANDS[1], base="base", joints=baxter.joint_names)
    true = replace(machine, nominal=nominal.nominal)
    q = plan_poses(nominal.nominal, 200, np.random.default_rng(5), min_height=None)
    links = {"from_link": np.repeat("base", len(q)), "to_link": np.repeat(HANDS[1], len(q))}
    return measurements_from_arrays(baxter.joint_names, q, position=true.tip(q)[:, :3, 3], **links)


@pytest.fixture(scope="module")
def machine(baxter: Robot) -> sim.TrueMachine:
    """Return the true arms between the hands."""
    return drawn(baxter, 3)


@pytest.fixture(scope="module")
def touching(baxter: Robot, machine: sim.TrueMachine) -> Measurements:
    """Return their contacts."""
    return touched(baxter, machine)


@pytest.fixture(scope="module")
def fit(baxter: Robot, touching: Measurements) -> FittedRobot:
    """Return the calibration by contacts alone."""
    return calibrate(baxter, touching, Options(effects=GEOMETRIC, sigma=NOISE))


def off_by(model: FittedRobot, table: Measurements) -> float:
    """Return the root mean square error once the instrument is placed [m]."""
    placed = place_station(model, table)
    residuals = placed.station.residuals(placed.values)
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=0))))


@pytest.mark.long
def test_priors_are_as_wide_as_the_readings_allow(
    fit: FittedRobot, baxter: Robot, touching: Measurements, machine: sim.TrueMachine
) -> None:
    """Deviations of a thirtieth and a tenth of the priors are taken for such, and a tracker sees what becomes of it."""
    wide, none = (
        calibrate(baxter, touching, Options(effects=GEOMETRIC, sigma=NOISE, prior_scale=PriorScale(factor, factor))).at()
        for factor in (1.0, 1e-3)
    )

    seen = tracked(baxter, machine)

    assert fit.options.prior_scale is not None
    assert 0.02 <= fit.options.prior_scale.lengths <= 0.1
    assert 0.05 <= fit.options.prior_scale.angles <= 0.2
    # One that excludes nothing takes the largest factors there are, one that excludes all but the likeliest the latter.
    for excluded, lengths in ((np.inf, 1.0), (0.0, fit.options.prior_scale.lengths)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("pincal.identify.prior_scale.CRITERIA", replace(CRITERIA, wider_prior=excluded))
            found = prior_scale(fit.fit)
        assert (found.lengths == 1.0) if excluded else (found.lengths <= lengths)
    assert off_by(fit.at(), seen) < 0.5 * off_by(none, seen)
    assert off_by(fit.at(), seen) < 0.5 * off_by(wide, seen)


@pytest.mark.long
def test_predicted_errors_elsewhere_are_those_of_a_tracker(baxter: Robot) -> None:
    """What calibrations of four robots expect of the right hand is what an instrument sees that they never had.

    Most of it is one direction, the scale: the squares of the ratios have a mean of 1 and few degrees of freedom.
    """
    squares = []
    for seed in range(3, 7):
        machine = drawn(baxter, seed)
        found = calibrate(baxter, touched(baxter, machine), Options(effects=GEOMETRIC, sigma=NOISE))
        hand = [region for region in improvements(found.fit) if region.link == HANDS[1]]
        elsewhere = np.mean([region.after_mm**2 for region in hand if region.region != "measured poses"])
        squares.append(1e6 * off_by(found.at(), tracked(baxter, machine)) ** 2 / elsewhere)

        assert all(region.after_mm < region.before_mm for region in hand)
    assert chdtri(4, 0.975) < np.sum(squares) < chdtri(4, 0.025)


def test_the_noise_of_contacts_does_not_shrink_the_robot(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Without a known length the scale of the arm stays nominal within its own uncertainty, however many contacts there are.

    The noise of 600 contacts alone would shrink it by three standard deviations.
    """
    sound = sim.TrueMachine.from_urdf(kuka.urdf.decode(), tip=kuka.tip, base=kuka.base)
    found = fit_tables(
        kuka, contacts(sound, kuka, each=150, noise=NOISE), Options(effects=GEOMETRIC, sigma=NOISE, prior_scale=PriorScale())
    )
    model = FittedRobot.of(found, {})
    lengths = np.array([p.nominal if p.symbol in ("a", "d") else 0.0 for p in found.estimate.parameters])
    scale = lengths / (lengths @ lengths)

    assert abs(scale @ found.values) < 2.0 * np.sqrt(scale @ model.covariance @ scale)


@pytest.mark.long
def test_directions_without_contact_are_named(fit: FittedRobot) -> None:
    """Sockets tell all three directions; a plane across z on the base tells no other, one on a hand that turns tells all."""
    station, values = fit.problem.stations[0], fit.values
    n, model = len(station), station.model
    plane = PlaneContactSensor(("plane",), np.zeros(n, int), np.zeros(n))
    own = np.append(station.split(values)[0], [0.0, 0.0, 1.0, 0.5])

    def with_plane(model: Model) -> ModelFit:
        problem = replace(fit.problem, stations=(replace(station, sensor=plane, model=model),))
        return replace(fit.fit, problem=problem, solution=replace(fit.solution, values=own))

    assert unseen_directions(fit.fit) == ()
    assert unseen_directions(with_plane(model)) == ()
    found = unseen_directions(with_plane(model.with_chain(model.chain.between("base", HANDS[1]))))
    assert np.abs(np.cross(*found)) == pytest.approx([0.0, 0.0, 1.0], abs=1e-12)


def test_what_contacts_do_not_hold_is_said(fit: FittedRobot, baxter: Robot, touching: Measurements) -> None:
    """A hand that is no better known than before is a doubt, and an arm whose mount moved without being held is refused."""
    regions = improvements(fit.fit)
    none = [replace(region, after_mm=0.95 * region.before_mm) for region in regions]
    mount = next(name for name in fit.estimate.names if name in fit.problem.chain.mounts and name.endswith(".y"))
    wide = Options(effects=GEOMETRIC, sigma=NOISE, prior_scale=PriorScale())
    few = calibrate(baxter, touching.select(np.arange(0, len(touching), 4)), wide)

    def kinds(found: FittedRobot, way: float, improved: list[Improvement]) -> set[CaveatKind]:
        values = found.values.copy()
        values[found.estimate.names.index(mount)] = way
        moved = replace(found.fit, solution=replace(found.solution, values=values))
        return {caveat.kind for caveat in findings_without_instrument(moved, improved)}

    assert kinds(fit, 0.0, list(regions)) == {CaveatKind.NO_INSTRUMENT}
    assert kinds(fit, 0.0, none) == {CaveatKind.NO_INSTRUMENT, CaveatKind.BLIND}
    # All contacts hold a mount 30 mm away; a quarter of them, which know it to 4 mm, do not.
    assert CaveatKind.MOUNT_MOVED not in kinds(fit, 0.03, list(regions))
    assert CaveatKind.MOUNT_MOVED in kinds(few, 0.03, list(improvements(few.fit)))


def test_the_next_step_says_how_well_contacts_tell_positions(touching: Measurements, baxter: Robot) -> None:
    """At worst, so that nobody takes what contacts alone found for what an instrument would have."""
    found = run_calibration(baxter, touching, Options(effects=GEOMETRIC, sigma=NOISE))
    worst = max(region.after_mm for region in found.result.improvement)

    assert f"is known to {worst:.2g} mm at worst" in " ".join(next_steps(found))


def without_links(table: Measurements, to: str | None = None) -> Measurements:
    """Return rows that do not name their links, or the hand alone."""
    return replace(table, from_link=None, to_link=None if to is None else np.repeat(to, len(table)))


@pytest.mark.long
def test_a_tracker_sees_the_hand_that_its_rows_fit(fit: FittedRobot, baxter: Robot, machine: sim.TrueMachine) -> None:
    """Rows with the joints of both arms, without links, are of one hand from the base; others stay as they are."""
    table = tracked(baxter, machine)
    named = validate_rows(fit.each, table, name="named")
    for to in (None, HANDS[1]):
        with pytest.warns(PincalWarning, match="taken as measured from base to right_gripper, which they fit"):
            found = validate_rows(fit.each, without_links(table, to), name="bare")
        assert found.error["mean_mm"] == pytest.approx(named.error["mean_mm"], rel=1e-9)
        assert found.error["mean_mm"] < 0.2
    # Rows that fit no way are not taken for any.
    rng = np.random.default_rng(1)
    mixed = replace(without_links(table), q=rng.permutation(table.q))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*taken as measured")
        assert validate_rows(fit.each, mixed, name="mixed").doubt


@pytest.mark.parametrize("hand", HANDS)
def test_rows_that_name_the_hand_are_from_where_their_joints_lead(
    fit: FittedRobot, baxter: Robot, tmp_path: Path, hand: str
) -> None:
    """A column ``to`` is enough where one arm has its joints; with both arms, what the rows fit decides later."""
    own = [name for name in baxter.joint_names if name.startswith(hand.split("_")[0])]
    row = {name: [0.1, 0.2] for name in own} | {axis: [0.5, 0.6] for axis in "xyz"} | {"to": [hand, hand]}
    pl.DataFrame(row).write_csv(tmp_path / "one.csv")
    robot = fit.model.chain.robot
    found = load_table(robot, tmp_path / "one.csv")
    assert set(found.from_link) == {"base"} and set(found.to_link) == {hand}

    pl.DataFrame({name: [0.1, 0.2] for name in baxter.joint_names} | row).write_csv(tmp_path / "both.csv")
    both = load_table(robot, tmp_path / "both.csv")
    assert (both.from_link is None) == (hand != robot.path.start) and set(both.to_link) == {hand}


def test_points_of_links_may_be_known(baxter: Robot, touching: Measurements) -> None:
    """A point whose place on its link is given stays there, whichever end of a contact it is."""
    first = np.array([f"{HANDS[0]}:{name}" for name in touching.point_names])
    second = np.repeat(f"{HANDS[1]}:ball", len(first))
    table = measurements_from_arrays(
        baxter.joint_names, touching.q, distance=np.zeros(len(first)), first=first, second=second
    )
    places = {f"{HANDS[0]}:one": (0.1, 0.05, 0.2), f"{HANDS[1]}:ball": (0.02, 0.03, 0.1)}
    found = calibrate(baxter, table, Options(effects=GEOMETRIC, sigma=NOISE, setup=Setup(points=places)))
    free = {name.rpartition(".")[0] for name in compress(found.estimate.names, found.solution.free)}

    assert f"{HANDS[0]}:two" in free
    assert not free & set(places)


def test_a_table_of_points_that_coincide_needs_no_distance(baxter: Robot, touching: Measurements, tmp_path: Path) -> None:
    """It is read as the same contacts with a distance of zero."""
    columns = dict(zip(baxter.joint_names, touching.q.T, strict=True))
    columns |= {"first": np.array([f"{HANDS[0]}:{name}" for name in touching.point_names])}
    table = pl.DataFrame(columns | {"second": np.repeat(f"{HANDS[1]}:ball", len(touching))})
    alone, zero = tmp_path / "alone.csv", tmp_path / "zero.csv"
    table.write_csv(alone)
    table.with_columns(distance=pl.lit(0.0)).write_csv(zero)
    (found,), (same,) = (list(stations_of([("", read_measurements(path, baxter))]).values()) for path in (alone, zero))

    assert found.sensor is same.sensor
    np.testing.assert_array_equal(found.point_names, same.point_names)
    np.testing.assert_array_equal(found.q, same.q)


@pytest.mark.parametrize(
    ("links", "told"),
    [
        ("--to left_griper", "--to left_griper, but the rows have right_gripper; leave one of them out"),
        ("--from base", "--from base, but the rows have left_gripper; leave one of them out"),
        ("--station touched:base:left_gripper", "no table or station of this name; expected one of touch"),
        ("--rest head_pn=10deg", "--rest head_pn; expected one of head_pan"),
    ],
)
def test_links_and_joints_that_are_not_there_are_refused(
    links: str, told: str, touching: Measurements, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A typing error is not passed over where the rows say between which links they are."""
    columns = dict(zip(touching.joint_names, touching.q.T, strict=True)) | {"socket": touching.point_names}
    table = pl.DataFrame(columns | {"from": touching.from_link, "to": touching.to_link})
    table.write_csv(tmp_path / "touch.csv")
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", "baxter", str(tmp_path / "touch.csv"), *links.split(), "--out", str(tmp_path / "out"), "--quiet"])

    assert ended.value.code == Exit.BAD_INPUT
    assert told in capsys.readouterr().err


def test_a_joint_off_the_path_rests_where_it_is_told(touching: Measurements, tmp_path: Path) -> None:
    """It moves then, and a note says where it rests; what it carries loads the others there."""
    left = [name for name in touching.joint_names if name.startswith("left")]
    columns = {name: touching.q[:, touching.joint_names.index(name)] for name in left}
    pl.DataFrame(columns | dict.fromkeys("xyz", 0.0)).write_csv(tmp_path / "left.csv")
    told = LinkOptions(rest=(("head_pan", 0.2),))
    general = {"motion": MotionOptions(), "table": TableArguments()}
    robot = load_robot(InputOptions(robot="baxter", data=(tmp_path / "left.csv",), links=told, **general))
    with pytest.warns(PincalWarning, match=r"assumed at rest: head_pan at 0\.2"):
        table = load_table(robot, tmp_path / "left.csv", links=told)

    assert set(robot.joint_names) == {"head_pan", *left}
    np.testing.assert_array_equal(table.q[:, robot.joint_names.index("head_pan")], 0.2)


@pytest.mark.parametrize("scale", [PriorScale(lengths=0.0), PriorScale(drives=-1.0), PriorScale(angles=float("nan"))])
def test_factors_on_priors_are_positive(scale: PriorScale) -> None:
    """A factor that is none is refused where it is given."""
    with pytest.raises(BadInputError, match="prior_scale"):
        Options(prior_scale=scale)


@pytest.mark.long
def test_poses_in_which_hands_touch_are_designed() -> None:
    """The ball is in its socket by Pinocchio, no arm is in the way of the other, and random poses tell less."""
    robot = Robot.from_urdf("baxter", start=HANDS[0], tip=HANDS[1])
    rig = SensorSetup("socket", tool=(0.02, 0.03, 0.1), held_at=((0.1, 0.05, 0.2), (-0.1, 0.1, 0.15)))
    request = DesignRequest(poses=36, candidates=50, curve=False, criterion="determinant")
    found = design_poses(robot, request, Options(effects=GEOMETRIC), rig=rig, limits=Limits(floor=None))
    tips, sockets = robot.forward_kinematics(found.q), found.columns()["socket"]
    places = dict(zip(("socket_1", "socket_2"), rig.places, strict=True))
    off = tips[:, :3, :3] @ rig.target(robot) + tips[:, :3, 3] - [places[name] for name in sockets]

    assert np.abs(off).max() < 1e-4
    assert set(sockets) == set(places)
    assert not Reach(robot, rig).collides(found.q).any()
    assert found.observability["O1"] > 1.05 * found.observability_random["O1"]
    assert any("known length" in note for note in found.notes)
