"""Waves of many periods a turn: searched for in one scan, paid for, and told from what positions on a grid can't tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pincal import GEOMETRIC, Options, Robot, measurements_from_arrays, run_discovery
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.discover import levers
from pincal.discover.candidate_tests import Search, hidden_wave
from pincal.discover.decisions import is_near
from pincal.discover.first_order import ScoreResult
from pincal.discover.levers import situation_of
from pincal.discover.policy import POLICY
from pincal.discover.report.found_words import effect_words
from pincal.discover.score_tests import score_test_given_nuisances
from pincal.discover.steps import SearchState, SearchStep, add_hidden_waves
from pincal.errors import BadInputError
from pincal.identify.calibrate import fit_tables
from pincal.identify.fit import ModelFit
from pincal.identify.split import row_groups
from pincal.measure.measurements import Measurements
from pincal.model.catalogue import EncoderSubdivision, GearRipple
from pincal.model.catalogue.candidates import find_effect
from pincal.model.catalogue.candidates import testable as could_show
from pincal.model.catalogue.ripple import independent_orders
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Harmonic

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

SIGMA = 5e-5
OPTIONS = Options(effects=GEOMETRIC, sigma=SIGMA)
BAND = (20.0, 450.0)


@pytest.fixture(scope="module")
def machine() -> sim.TrueMachine:
    """Return a stiff KUKA with errors of its geometry."""
    machine = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    return machine.draw_errors(np.random.default_rng(1), sigma_length=3e-4, sigma_angle=1e-3, sigma_offset=1e-3)


def measured(machine: sim.TrueMachine, *hidden: sim.HiddenEffect, grid: float = 0.0, n: int = 150) -> Measurements:
    """Return noisy positions of the machine with hidden effects, its joints at multiples of a step [rad] if there is one."""
    rng = np.random.default_rng(2)
    q = sim.plan_poses(machine.nominal, n, rng)
    q = np.round(q / grid) * grid if grid else q
    tip = machine.with_effects(*hidden).tip(q)
    position = tip[:, :3, 3] + tip[:, :3, :3] @ [0.1, 0.05, 0.2] + SIGMA * rng.standard_normal((n, 3))
    return measurements_from_arrays(machine.names, q, position=position)


def named(machine: sim.TrueMachine, rows: Measurements, *extra: Harmonic) -> list[tuple[str, str | None, float | None]]:
    """Return what a discovery names, with its order."""
    robot = Robot.from_urdf(kuka_urdf_path(), tip="tool0")
    found = run_discovery(robot, rows, Options(effects=GEOMETRIC, sigma=SIGMA), extra=extra)
    return [(e.effect, e.joint, e.order) for e in found.findings.effects]


def fitted(rows: Measurements) -> ModelFit:
    """Return the geometric model of some rows."""
    return fit_tables(Robot.from_urdf(kuka_urdf_path(), tip="tool0"), rows, Options(effects=GEOMETRIC, sigma=SIGMA))


def strongest(fit: ModelFit) -> list[Harmonic]:
    """Return what the scan finds."""
    return levers.strongest_tones(fit, could_show(situation_of(fit)), 15.0)


def test_the_scan_is_least_squares_of_a_sine_and_a_cosine() -> None:
    """On even steps, by products of two small matrices, it gives what lstsq gives order by order."""
    rng = np.random.default_rng(0)
    q, lever = rng.uniform(-2.0, 2.5, 60), rng.uniform(0.1, 1.0, (3, 60))
    r = rng.standard_normal((3, 60))
    orders, gains = levers.on_steps(q, (lever * r).sum(0), (lever**2).sum(0), start=20.0, step=0.7, end=150.0)
    for k in range(0, len(orders), 11):
        A = np.stack([lever * np.sin(orders[k] * q), lever * np.cos(orders[k] * q)]).reshape(2, -1).T
        fit = A @ np.linalg.lstsq(A, r.ravel(), rcond=None)[0]
        assert gains[k] == pytest.approx(fit @ fit, rel=1e-9)
    assert orders[-1] <= 150.0 < orders[-1] + 0.7


def test_what_was_searched_for_is_paid_for() -> None:
    """Of noise alone the highest of the band passes a chance of 10 %, all orders paid, in at most 10 % of draws."""
    rng = np.random.default_rng(3)
    q, lever = rng.uniform(-2.6, 2.6, 200), rng.uniform(0.5, 1.0, 200)
    step = 0.25 * 2 * np.pi / np.ptp(q)
    draws = lever * rng.standard_normal((300, 200))
    highest = [levers.on_steps(q, along, lever**2, start=BAND[0], step=step, end=BAND[1])[1].max() for along in draws]
    chances = independent_orders(q, BAND) * np.exp(-0.5 * np.array(highest))

    assert 0.01 < np.mean(chances < 0.1) < 0.1


def test_the_price_is_in_the_test(machine: sim.TrueMachine) -> None:
    """A searched order's p-value is that of a known order times the number of orders, its criterion dearer by as much."""
    fit = fitted(measured(machine))
    tests = score_test_given_nuisances(fit, [GearRipple("joint_2", 90.0), GearRipple("joint_2", 90.0, 50.0)])
    known, searched = tests.score([0], 1), tests.score([1], 1)

    assert searched.gain == pytest.approx(known.gain, rel=1e-9)
    assert searched.p_value == pytest.approx(min(1.0, 50.0 * known.p_value))
    assert searched.ebic == pytest.approx(known.ebic + 2.0 * np.log(50.0))


@pytest.mark.long
def test_a_stage_is_found_at_its_order(machine: sim.TrueMachine) -> None:
    """A ripple of 60 urad is named with its joint, and its order to a tenth of what the range of the joint resolves."""
    (found,) = named(machine, measured(machine, sim.GearRipple(joint="joint_2", size=6e-5, order=161.3)))

    assert found[:2] == ("gear_ripple", "joint_2") and found[2] == pytest.approx(161.3, abs=0.3)


def test_the_second_wave_of_two_lobes_is_in_the_band(machine: sim.TrueMachine) -> None:
    """A usual strain wave gear of 1:101 makes 404 cycles per revolution beside its 202."""
    (tone, *_) = strongest(fitted(measured(machine, sim.GearRipple(joint="joint_2", size=6e-5, order=404.0))))

    assert tone.locus.joint == "joint_2" and tone.locus.order == pytest.approx(404.0, abs=0.3)


@pytest.mark.long
def test_a_power_of_two_is_an_encoder_beside_the_ripple_that_it_looks_like(machine: sim.TrueMachine) -> None:
    """Lines that count in binary are in the headline; the ripple, and half as many lines, make the same wave."""
    rows = measured(machine, sim.EncoderSubdivision(joint="joint_2", size=6e-5, order=64.0, offset=0.0))
    (found,) = run_discovery(Robot.from_urdf(kuka_urdf_path(), tip="tool0"), rows, OPTIONS).findings.effects
    could_be = [(e.effect, e.order) for e in found.equivalent]

    assert (found.effect, found.joint, found.order) == ("encoder_subdivision", "joint_2", 128.0)
    assert found.origin.startswith("2^7, as for an encoder")
    assert ("gear_ripple", pytest.approx(128.0, abs=0.3)) in could_be
    assert ("encoder_subdivision", pytest.approx(64.0, abs=0.15)) in could_be


@pytest.mark.long
def test_once_and_twice_a_line_are_one_encoder(machine: sim.TrueMachine) -> None:
    """Both waves that an encoder makes come in by themselves and go out for it; an order half a wave off is none."""
    for order, found in ((64.0, [("encoder_subdivision", "joint_2", 64.0)]), (64.5, ["gear_ripple"] * 2)):
        rows = measured(machine, sim.EncoderSubdivision(joint="joint_2", size=1e-4, order=order))
        names = named(machine, rows)
        assert names == found or [name for name, *_ in names] == found


@pytest.mark.long
def test_what_the_span_does_not_tell_apart_is_one_line(machine: sim.TrueMachine) -> None:
    """Two waves 1.5 over the span apart are a line that waxes and wanes, its order as sure as the span; further ones two."""
    span = np.ptp(measured(machine).q[:, 1]) / (2.0 * np.pi)
    for apart, lines in ((1.5, 1), (3.0, 2)):
        orders = 202.0 - 0.5 * apart / span, 202.0 + 0.5 * apart / span
        rows = measured(machine, *(sim.GearRipple(joint="joint_2", size=8e-5, order=order) for order in orders), n=300)
        found = run_discovery(Robot.from_urdf(kuka_urdf_path(), tip="tool0"), rows, OPTIONS).findings.effects

        assert len(found) == lines
        assert sorted([float(e.order or 0.0) for e in found] + [k for e in found for k in e.beside]) == pytest.approx(
            orders, abs=0.3 / span
        )
        assert all(e.resolution == pytest.approx(1.0 / span, rel=0.1) for e in found)
        assert lines == 2 or found[0].origin.startswith("2 x 101, the ratio of a usual strain wave gear")
        assert lines == 2 or f"order 202.0 \u00b1 {found[0].resolution:.1f}" in effect_words(found[0])


@pytest.mark.parametrize(
    ("order", "resolution", "wheels", "said"),
    [
        (404.0, 1.35, {}, "4 x 101, the ratio of a usual strain wave gear"),
        (404.0, 1.35, {202.0: "given by the user"}, "2 x 202, given by the user"),
        (404.0, 6.0, {}, ""),
        (161.3, 1.2, {}, ""),
        (483.9, 1.2, {161.3: "a line of joint_1"}, "3 x 161.3, a line of joint_1"),
    ],
)
def test_a_multiple_is_proposed_unless_chance_does_as_well(
    order: float, resolution: float, wheels: dict[float, str], said: str
) -> None:
    """An order is a harmonic of a wheel that is known where few orders are as near to one; else nothing is said."""
    found = GearRipple("joint_1", order).origin(order, resolution, wheels)

    assert found.startswith(said) and bool(found) == bool(said)


def test_sound_residuals_show_no_wave(machine: sim.TrueMachine) -> None:
    """Noise alone makes no candidate; nor does a wave that the model has."""
    rows = measured(machine, sim.GearRipple(joint="joint_1", size=1e-4, order=77.0))
    (tone, *_) = strongest(fitted(rows))
    known = fit_tables(fitted(rows).problem.chain.robot, rows, Options(effects=(*GEOMETRIC, tone), sigma=SIGMA))

    assert tone.locus.joint == "joint_1" and not strongest(known) and not strongest(fitted(measured(machine)))


def test_waves_behind_curves_are_added_until_there_are_none(machine: sim.TrueMachine) -> None:
    """A fit that ends with a ripple left gets it, and no other; one of more rows than were looked at gets nothing."""
    rows = measured(machine, sim.GearRipple(joint="joint_2", size=6e-5, order=161.3))
    fit = fitted(rows)
    search = Search(POLICY, (), fit, row_groups(rows, split="blocked", seed=0))
    state = add_hidden_waves(SearchState(fit), search)
    (step,) = state.steps
    part = replace(search, groups=search.groups[1:])

    assert step.effect.heading[:2] == ("gear_ripple", "joint_2")
    assert step.effect.locus.order == pytest.approx(161.3, abs=0.3)
    assert step.effect in state.fit.problem.effects and [c.entered for c in state.changes] == [step.effects]
    assert hidden_wave(state.fit, search) is None
    assert add_hidden_waves(SearchState(fit), part) == SearchState(fit)


def test_a_wave_found_again_close_by_came_in_so(machine: sim.TrueMachine) -> None:
    """Its last order is told from the start, the fit is the last one, and no change of its own is told."""
    first, again = GearRipple("joint_2", 161.3), GearRipple("joint_2", 161.34)
    before = fitted(measured(machine, n=40))
    after, last = replace(before), replace(before)
    step = SearchStep((first,), ScoreResult(90.0, 2, 1e-9, -50.0), (), before, after, first, np.zeros(2))
    state = SearchState(before).with_step(step).tuned(step, replace(step, effects=(again,), after=last))

    assert is_near(first, again, 1.0) and not is_near(first, GearRipple("joint_2", 165.0), 1.0)
    assert not is_near(first, EncoderSubdivision("joint_2", 161.34), 1.0)
    assert [(c.fit, c.entered, c.left) for c in state.changes] == [(last, (again,), ())] and state.fit is last
    (told,) = state.steps
    assert (told.effect, told.before, told.after) == (again, before, last)


def test_a_grid_of_positions_does_not_tell_orders_apart(machine: sim.TrueMachine) -> None:
    """At multiples of 5 degrees 100 cycles per revolution are 28, 44, 116, ... as well: all are listed."""
    rows = measured(machine, sim.GearRipple(joint="joint_3", size=1e-4, order=100.0), grid=np.deg2rad(5.0))
    orders = sorted(tone.locus.order or 0.0 for tone in strongest(fitted(rows)) if tone.locus.joint == "joint_3")

    assert len(orders) == 4
    for order in orders:
        assert min(abs((order - s * 100.0) / 72.0 - round((order - s * 100.0) / 72.0)) for s in (1, -1)) < 0.01


@pytest.mark.long
def test_a_known_order_shows_sooner(machine: sim.TrueMachine) -> None:
    """A ripple too small for a search, and lines of an encoder beyond its band, are found where their orders are told."""
    small = measured(machine, sim.GearRipple(joint="joint_2", size=1.15e-5, order=121.0))
    lines = measured(machine, sim.EncoderSubdivision(joint="joint_1", size=4e-5, order=1024.0))

    assert named(machine, small) == []
    assert named(machine, small, GearRipple("joint_2", 121.0)) == [("gear_ripple", "joint_2", 121.0)]
    assert named(machine, lines, EncoderSubdivision("joint_1", 1024.0)) == [("encoder_subdivision", "joint_1", 1024.0)]


def test_an_order_is_named_by_the_user() -> None:
    """A wave is found by name with any number of cycles per revolution; a word is none."""
    chain = Chain.of(Robot.from_urdf(kuka_urdf_path(), tip="tool0"))
    conditions = Conditions.at(chain.robot.random_configurations(20, np.random.default_rng(0)))

    assert find_effect("gear_ripple:joint_3:order=100.5", chain, conditions) == GearRipple("joint_3", 100.5)
    assert find_effect("encoder_subdivision:joint_1:order=512", chain, conditions) == EncoderSubdivision("joint_1", 512.0)
    with pytest.raises(BadInputError, match="order=many; expected a number of cycles per revolution"):
        find_effect("gear_ripple:joint_3:order=many", chain, conditions)
    with pytest.raises(BadInputError, match="lines per revolution are unknown"):
        find_effect("encoder_subdivision:joint_1", chain, conditions)
