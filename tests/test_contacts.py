"""Contacts: what they show, what they leave at its prior, and that no fit of them does harm.

The hands of Baxter, simulated by Pinocchio; the robot has the deviations of an arm of three tenths of the usual size.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import compress

import numpy as np
import pytest
from test_named_points import contacts

import pincal.simulate as sim
from pincal import GEOMETRIC, BadInputError, Options, Robot, Setup, calibrate, measurements_from_arrays
from pincal.calibration.calibrated import CalibratedModel
from pincal.calibration.calibrated_robot import Fit
from pincal.calibration.caveats import CaveatKind
from pincal.calibration.improvement import findings_without_instrument, improvements, unseen_directions
from pincal.calibration.placing import place_station
from pincal.identify.calibrate import fit_tables
from pincal.measure.measurements import Measurements
from pincal.measure.sensors.plane import PlaneContactSensor
from pincal.model.model import Model
from pincal.robot.urdf_file import arm_text
from pincal.simulate.planning import plan_poses
from pincal.validate.outcome import Improvement

HANDS = "left_gripper", "right_gripper"
NOISE = 5e-5


@pytest.fixture(scope="module")
def baxter() -> Robot:
    """Return both arms, as seen from the left hand."""
    return Robot.from_urdf("baxter", start=HANDS[0], tip=HANDS[1], paths=[("base", hand) for hand in HANDS])


@pytest.fixture(scope="module")
def machine(baxter: Robot) -> sim.TrueMachine:
    """Return the true arms between the hands."""
    text = arm_text(baxter.urdf, baxter.joint_names, baxter.source)
    found = sim.TrueMachine.from_urdf(text, tip=HANDS[1], base="base", start=HANDS[0], joints=baxter.joint_names)
    return found.draw_errors(np.random.default_rng(3), sigma_length=1e-4, sigma_angle=3e-4, sigma_offset=6e-4)


@pytest.fixture(scope="module")
def touching(baxter: Robot, machine: sim.TrueMachine) -> Measurements:
    """Return contacts of the right hand in two sockets on the left one."""
    rng = np.random.default_rng(4)
    places = {"one": np.array([0.1, 0.05, 0.2]), "two": np.array([-0.1, 0.1, 0.15])}
    setup = sim.Contact(fixed=places, tool=(0.02, 0.03, 0.1), sigma=NOISE)
    table = setup.measure(machine, setup.plan(machine.nominal, 160, rng=rng, min_height=None), rng=rng)
    q = np.column_stack([table[name] for name in baxter.joint_names])
    links = {"from_link": np.repeat(HANDS[0], len(q)), "to_link": np.repeat(HANDS[1], len(q))}
    return measurements_from_arrays(baxter.joint_names, q, socket=table["socket"], **links)


@pytest.fixture(scope="module")
def seen(baxter: Robot, machine: sim.TrueMachine) -> Measurements:
    """Return exact positions of the right hand as a tracker sees it."""
    text = arm_text(baxter.urdf, baxter.joint_names, baxter.source)
    nominal = sim.TrueMachine.from_urdf(text, tip=HANDS[1], base="base", joints=baxter.joint_names)
    true = replace(machine, nominal=nominal.nominal)
    q = plan_poses(nominal.nominal, 200, np.random.default_rng(5), min_height=None)
    links = {"from_link": np.repeat("base", len(q)), "to_link": np.repeat(HANDS[1], len(q))}
    return measurements_from_arrays(baxter.joint_names, q, position=true.tip(q)[:, :3, 3], **links)


@pytest.fixture(scope="module")
def fit(baxter: Robot, touching: Measurements) -> Fit:
    """Return the calibration by contacts alone."""
    return calibrate(baxter, touching, Options(effects=GEOMETRIC, sigma=NOISE))


def off_by(model: CalibratedModel, table: Measurements) -> float:
    """Return the root mean square error once the instrument is placed [m]."""
    placed = place_station(model, table)
    residuals = placed.station.residuals(placed.values)
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=0))))


def test_priors_are_as_wide_as_the_robots_deviations(
    fit: Fit, baxter: Robot, touching: Measurements, seen: Measurements
) -> None:
    """Deviations of a tenth of the priors are taken for such; a tracker sees what becomes of it, and of the nominal one."""
    wide, none = (
        calibrate(baxter, touching, Options(effects=GEOMETRIC, sigma=NOISE, prior_scale=(factor, factor))).at()
        for factor in (1.0, 1e-3)
    )

    assert fit.options.prior_scale is not None
    assert 0.03 <= fit.options.prior_scale[0] <= 0.3
    assert off_by(fit.at(), seen) < 0.5 * off_by(none, seen)
    assert off_by(fit.at(), seen) < 0.5 * off_by(wide, seen)


def test_predicted_errors_elsewhere_are_those_of_a_tracker(fit: Fit, seen: Measurements) -> None:
    """What the calibration expects of the right hand is what an instrument sees that it never had."""
    hand = [region for region in improvements(fit) if region.link == HANDS[1]]
    elsewhere = np.sqrt(np.mean([region.after_mm**2 for region in hand if region.region != "measured poses"]))

    assert 0.5 < 1e3 * off_by(fit.at(), seen) / elsewhere < 2.0
    assert all(region.after_mm < region.before_mm for region in hand)


def test_the_noise_of_contacts_does_not_shrink_the_robot(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Without a known length the scale of the arm stays nominal within its own uncertainty, however many contacts there are.

    The noise of 600 contacts alone would shrink it by three standard deviations.
    """
    sound = sim.TrueMachine.from_urdf(kuka.urdf.decode(), tip=kuka.tip, base=kuka.base)
    found = fit_tables(
        kuka, contacts(sound, kuka, each=150, noise=NOISE), Options(effects=GEOMETRIC, sigma=NOISE, prior_scale=(1.0, 1.0))
    )
    model = CalibratedModel.of(found, {})
    lengths = np.array([p.nominal if p.symbol in ("a", "d") else 0.0 for p in found.estimate.parameters])
    scale = lengths / (lengths @ lengths)

    assert abs(scale @ found.values) < 2.0 * np.sqrt(scale @ model.covariance @ scale)


def test_directions_without_contact_are_named(fit: Fit) -> None:
    """Sockets tell all three directions; a plane across z on the base tells no other, one on a hand that turns tells all."""
    station, values = fit.problem.stations[0], fit.values
    n, model = len(station), station.model
    plane = PlaneContactSensor(("plane",), np.zeros(n, int), np.zeros(n))
    own = np.append(station.split(values)[0], [0.0, 0.0, 1.0, 0.5])

    def with_plane(model: Model) -> Fit:
        problem = replace(fit.problem, stations=(replace(station, sensor=plane, model=model),))
        return replace(fit, problem=problem, solution=replace(fit.solution, values=own))

    assert unseen_directions(fit) == ()
    assert unseen_directions(with_plane(model)) == ()
    found = unseen_directions(with_plane(model.with_chain(model.chain.between("base", HANDS[1]))))
    assert np.abs(np.cross(*found)) == pytest.approx([0.0, 0.0, 1.0], abs=1e-12)


def test_what_contacts_do_not_hold_is_said(fit: Fit, baxter: Robot, touching: Measurements) -> None:
    """A hand that is no better known than before is a doubt, and an arm whose mount moved without being held is refused."""
    regions = improvements(fit)
    none = [replace(region, after_mm=0.95 * region.before_mm) for region in regions]
    mount = next(name for name in fit.estimate.names if name in fit.problem.chain.mounts and name.endswith(".y"))
    wide = Options(effects=GEOMETRIC, sigma=NOISE, prior_scale=(1.0, 1.0))
    few = calibrate(baxter, touching.select(np.arange(0, len(touching), 4)), wide)

    def kinds(found: Fit, way: float, improved: list[Improvement]) -> set[CaveatKind]:
        values = found.values.copy()
        values[found.estimate.names.index(mount)] = way
        moved = replace(found, solution=replace(found.solution, values=values))
        return {caveat.kind for caveat in findings_without_instrument(moved, improved)}

    assert kinds(fit, 0.0, list(regions)) == {CaveatKind.NO_INSTRUMENT}
    assert kinds(fit, 0.0, none) == {CaveatKind.NO_INSTRUMENT, CaveatKind.BLIND}
    # All contacts hold a mount 30 mm away; a quarter of them, which know it to 4 mm, do not.
    assert CaveatKind.MOUNT_MOVED not in kinds(fit, 0.03, list(regions))
    assert CaveatKind.MOUNT_MOVED in kinds(few, 0.03, list(improvements(few)))


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


@pytest.mark.parametrize("scale", [(0.0, 1.0), (1.0, -1.0), (float("nan"), 1.0)])
def test_factors_on_priors_are_positive(scale: tuple[float, float]) -> None:
    """A factor that is none is refused where it is given."""
    with pytest.raises(BadInputError, match="prior_scale"):
        Options(prior_scale=scale)
