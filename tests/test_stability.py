"""How often names come up in halves of the poses, and what a discovery says of it."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from discovery_cases import Case, draw_case
from scipy.stats import binom, kstest
from stability_study import by_class, study

from pincal.builtin import kuka_urdf_path
from pincal.calibration.fitted_robot import FittedRobot
from pincal.discover.cli.search_screen import _evidence
from pincal.discover.discovery_file import EffectName, Findings, Repeated, Stability
from pincal.discover.ending import of_bearings, of_candidates, of_masses
from pincal.discover.findings import bootstrap_last, chance_of_best, findings_of
from pincal.discover.levers import missing_features
from pincal.discover.loop import discover_effects
from pincal.discover.report.found_drawings import stability_drawings
from pincal.discover.report.found_section import _named
from pincal.discover.run import Discovery, Subsamples, _subsamples, begin_subsamples, run_discovery
from pincal.discover.score_tests import GivenNuisances, ScoreTests, score_test, score_test_given_nuisances
from pincal.discover.sure_names import _over_these_poses
from pincal.errors import BadInputError
from pincal.identify.calibrate import fit_tables, refit
from pincal.identify.fit import Ending, ModelFit
from pincal.identify.mass_error import MassError, variance_of_masses
from pincal.identify.options import Options
from pincal.identify.split import row_groups
from pincal.measure.measurements import Measurements
from pincal.measure.table import measurements_from_arrays
from pincal.model.catalogue.bearing_features import bearing_features
from pincal.model.catalogue.elasticity import BaseElasticity
from pincal.model.catalogue.transmission import TransmissionError
from pincal.model.catalogue.unnamed import Unnamed
from pincal.model.effects import GEOMETRIC
from pincal.parameters import root_of
from pincal.robot.robot import Robot

COUNT = 2


@pytest.fixture(scope="module")
def case() -> Case:
    return draw_case("backlash", 3, n=130, arm="kuka", strength=300.0)


@pytest.fixture(scope="module")
def found(case: Case) -> Discovery:
    """Return a search without its repetition in halves, which takes as long again."""
    return run_discovery(case.robot, case.rows, case.options)


def test_halves_are_complementary_pairs_of_whole_regions() -> None:
    """Of two stations each half has about half of the rows of each, and the next one has the rest of the regions."""
    rng = np.random.default_rng(0)
    regions = np.concatenate([rng.integers(0, 20, 400), rng.integers(20, 32, 100)])
    stations = [np.arange(20), np.arange(20, 32)]
    halves = list(_subsamples(stations, regions, 6))

    for one, other in zip(halves[::2], halves[1::2], strict=True):
        assert sorted([*one, *other]) == list(range(32))
        for rows in (regions[:400], regions[400:]):
            assert np.isin(rows, one).mean() == pytest.approx(0.5, abs=0.1)
    assert len({tuple(sorted(half)) for half in halves}) == 6


def test_a_name_counts_where_it_is_named_or_could_be_meant() -> None:
    """The source of a coupling is part of its name; what came up first in most halves and is not known is told."""
    by_2, by_3 = (EffectName(effect="joint_coupling", joint="a", source=source) for source in ("joint_2", "joint_3"))
    gear = EffectName(effect="gear_ratio", joint="b")
    halves = Subsamples((((by_2, gear),), ((by_3,), (gear, by_2)), ((gear,),)), 50)

    assert [halves.count(name) for name in (by_2, by_3, gear)] == [2, 1, 3]
    assert halves.others([by_2], 0.6) == [(gear, 2)]
    assert halves.others([by_2, gear], 0.6) == []


def test_what_has_no_name_counts_by_what_it_depends_on_and_where_it_acts() -> None:
    """A tilt that drifts is no curve of the same joint's drive; shape and order differ from half to half."""
    waves = Unnamed("a", "drive", "b", "waves", order=3)
    same = (Unnamed("a", "drive", "b"), Unnamed("a", "drive", "b", "field", lengths=(2.0, 1.5)))
    others = (Unnamed("a", "drive", "time"), Unnamed("a", "s_x", "b"), Unnamed("c", "drive", "b"))
    name, *named = (EffectName.of(effect).in_tables for effect in (waves, *same, *others))
    halves = Subsamples(tuple(((other,),) for other in named), 50)

    assert halves.count(name) == len(same)
    told = dict(halves.others([name], 0.0))
    assert len(told) == len(others) and all(each.depends_on and each.acts_on for each in told)


@pytest.mark.long
def test_what_is_plain_to_see_comes_up_in_every_half(case: Case) -> None:
    """And the file says so; it is the same without the repetition but for that."""
    found = run_discovery(case.robot, case.rows, case.options, stability=COUNT)
    alone = msgspec.to_builtins(findings_of(found.calibration.fit.fit, found.trail, gaps=found.gaps, traces=found.traces))
    report = json.loads(json.dumps(found.report, allow_nan=False))
    # What is held out, and the verdict on the noise, are told by the whole.
    for of in (alone, report):
        for name in ("verdict", "held_out", "warnings", "regions"):
            of.pop(name, None)
    often = {(e["effect"], e["joint"]): e.pop("stability") for e in report["effects"]}

    assert often["backlash", case.hidden[0].joint] == {"named": COUNT, "of": COUNT}
    poses = len(case.rows)
    assert 0.4 * poses < report.pop("poses_in_a_half") < 0.6 * poses
    hints = [(e["effect"], e["joint"]) for e in report.pop("hints", [])]
    assert hints == [name for name, stability in often.items() if stability["named"] < 0.6 * COUNT]
    report.pop("only_in_halves", None)
    assert report.pop("bootstrap")["draws"] == 200
    assert report == json.loads(json.dumps(alone))
    assert msgspec.convert(found.report, Findings) == found.findings


def _with_two_drives(*, still: bool) -> tuple[Measurements, ModelFit]:
    """Return a table of an arm whose second and fourth drive are off, the second perhaps still, and a geometric fit."""
    robot = Robot.from_urdf(kuka_urdf_path())
    rng = np.random.default_rng(0)
    q = robot.random_configurations(200, rng)
    q[:, 1] *= not still
    bent = q + 1e-3 * np.array([0.0, 1.0, 0.0, 1.0, 0.0, 0.0]) * np.sin([1.0, 1.0, 1.0, 2.0, 1.0, 1.0] * q)
    tips = robot.forward_kinematics(bent)
    position = tips[:, :3, 3] + tips[:, :3, :3] @ [0.1, 0.0, 0.2] + 5e-5 * rng.standard_normal((200, 3))
    table = measurements_from_arrays(robot.joint_names, q, position=position)
    return table, fit_tables(robot, table, Options(effects=GEOMETRIC))


def test_names_that_poses_cannot_show_do_not_enter() -> None:
    """A curve of a joint that stood still, and what loads do to a rigid arm; others are of the range of the poses."""
    effects = [TransmissionError(f"joint_{k}", -9.0, 9.0, 12) for k in (2, 4)]
    moved, stood = (_over_these_poses(_with_two_drives(still=still)[1], effects) for still in (False, True))

    assert [effect.joint for effect in moved] == ["joint_2", "joint_4"] and [effect.joint for effect in stood] == ["joint_4"]
    assert all(-7.0 < effect.locus.span[0] < effect.locus.span[1] < 7.0 for effect in (*moved, *stood))
    assert not _over_these_poses(_with_two_drives(still=False)[1], [BaseElasticity()])


def test_strong_names_enter_a_half_together() -> None:
    """Two errors of drives, and one that is expected and absent: names and equivalents are those of a search one by one."""
    table, fit = _with_two_drives(still=False)
    groups = row_groups(table, split="blocked", seed=0) % 8

    one_by_one = discover_effects(fit, groups)
    tested = [step.tested for step in one_by_one.steps]
    absent = replace(tested[0], joint="joint_5")
    together = discover_effects(fit, groups, expected=[*tested, absent])

    names, same = ([(s.effect.heading, [e.heading for e in s.equivalent]) for s in t.steps] for t in (one_by_one, together))
    assert [heading[:2] for heading, _ in names] == [("gear_eccentricity", "joint_2"), ("gear_eccentricity", "joint_4")]
    assert sorted(same) == sorted(names)
    assert [step.before is trail.steps[0].before for trail in (one_by_one, together) for step in trail.steps[1:]] == [
        False,
        True,
    ]
    assert together.final.solution.estimated == pytest.approx(one_by_one.final.solution.estimated, rel=1e-6)


@pytest.mark.long
def test_few_readings_in_a_half_are_not_fitted_exactly(
    case: Case, found: Discovery, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three positions of a station are as many readings as its parameters: a half takes their noise from all rows."""
    few, rest = case.rows.select(np.arange(6)), case.rows.select(np.arange(6, 130))
    fit = fit_tables(case.robot, {"few": few, "rest": rest}, Options(effects=GEOMETRIC))
    half = fit.select(np.array([0, 1, 2, *range(6, 130, 2)]))
    sigma = fit.solution.sigma

    alone = refit(half, GEOMETRIC, start={}).solution
    held = refit(replace(half, noise=half.noise.no_less_than(0.5 * sigma)), GEOMETRIC, start={}).solution

    assert alone.sigma[0] < 1e-3 * sigma[0]
    assert (held.sigma >= 0.5 * sigma).all() and held.exit is Ending.SETTLED
    assert held.sigma[1] == pytest.approx(sigma[1], rel=0.3)

    seen = []
    monkeypatch.setattr("pincal.discover.run._names_in_half", lambda first, *rest: seen.append(first.noise) or ())
    begin_subsamples(found.trail, [np.arange(len(found.trail.first.problem)) // 10], 2)()
    assert [noise.least for noise in seen] == [tuple(0.5 * found.trail.final.solution.sigma)] * 2


@pytest.mark.long
def test_an_executor_brings_the_same(case: Case, found: Discovery) -> None:
    """Here threads; the order of the halves is kept."""
    regions = [row_groups(found.calibration.train, split="blocked", seed=0)]
    with ThreadPoolExecutor(2) as pool:
        spread, here = (begin_subsamples(found.trail, regions, 2, executor=e)() for e in (pool, None))

    assert spread == here and len(here) == 2


def test_halves_that_name_an_alternative_are_counted_as_such(found: Discovery) -> None:
    """A compliance that halves name as another one is not only "in 0 of 4": page, file and screen count the other one."""
    here, other, third = (EffectName(effect=f"{kind}_elasticity", joint="joint_2") for kind in ("bearing", "joint", "base"))
    entry = msgspec.structs.replace(found.findings.effects[0], effect=here.effect, joint=here.joint, equivalent=(other,))
    halves = Subsamples((((other,),), ((third,),), ((third,), (other,)), ((here, other),)), 60)
    often = halves.stability(entry)
    of_entry = msgspec.structs.replace(entry, stability=often)
    page = "".join(str(block) for block in _named(msgspec.structs.replace(found.findings, effects=(of_entry,))))

    assert often == Stability(1, 4, 2)
    assert msgspec.to_builtins(often) == {"named": 1, "of": 4, "alternatives": 2}
    assert "The search names it in 1 of 4 subsamples, and in 2 others an alternative." in page
    assert _evidence([of_entry]) == [" (in 1 of 4 subsamples, an alternative in 2)"]
    assert halves.stability(msgspec.structs.replace(entry, equivalent=())) == Stability(1, 4)


def test_hints_stand_apart_and_all_are_drawn(found: Discovery) -> None:
    """With what only the halves name; without a repetition there is nothing to draw."""
    first, *others = (msgspec.structs.replace(entry, stability=Stability(4, 4)) for entry in found.findings.effects)
    few = msgspec.structs.replace(first, stability=Stability(1, 4))
    more = Repeated(effect="gear_ratio", joint="joint_4", stability=Stability(3, 4))
    findings = msgspec.structs.replace(found.findings, effects=(few, *others), only_in_halves=(more,))
    page = "".join(str(block) for block in _named(findings))
    bare = tuple(msgspec.structs.replace(entry, stability=None) for entry in findings.effects)

    assert few.is_hint and not others[0].is_hint
    assert page.index(others[0].effect) < page.index("Hints") < page.index("in 1 of 4 subsamples")
    assert "gear_ratio of joint_4 (in 3 of 4)" in page
    ((figure, _, _),) = stability_drawings(findings)
    assert len(figure.axes[0].patches) == len(findings.effects) + 1
    assert not list(stability_drawings(msgspec.structs.replace(findings, effects=bare, only_in_halves=())))


def told(tests: ScoreTests, of_model: np.ndarray, of_candidates: np.ndarray, squares: float) -> ScoreTests:
    """Return tests of other residuals, given their products with the columns, at the minimum beside priors, and squares."""
    blocks = replace(tests.model.blocks, g=(of_model - tests.model.prior.g)[None])
    model = replace(tests.model, blocks=blocks)
    return replace(tests, model=model, blocks_g=of_candidates[None], squares=squares)


def test_a_bootstrap_of_noise_has_any_chance_alike(found: Discovery) -> None:
    """Of sixty tables of nothing but noise the p-values are uniform."""
    tests = score_test(found.trail.final, found.trail.last.effects[:12])
    model, cross = tests.model, tests.cross
    rng, root = np.random.default_rng(5), root_of(np.block([[model.rows.H, cross], [cross.T, tests.inner]]))
    root, unseen = root[:, np.linalg.norm(root, axis=0) > 0.0], tests.readings
    chances = []
    for seed in range(60):
        noise = rng.standard_normal(root.shape[1])
        b, squares = root @ noise, float(noise @ noise + rng.chisquare(unseen - len(noise)))
        # Noise about a fit of the model, which takes its part of the squares.
        of_model, of_candidates = np.split(b, [tests.n_model])
        squares -= float(of_model @ np.linalg.solve(model.rows.H + model.prior.H, of_model))
        table = told(tests, of_model, of_candidates, squares)
        chances.append(chance_of_best(table, 100, seed))

    assert kstest(chances, "uniform").pvalue > 1e-3


def test_what_is_there_is_no_chance(case: Case, found: Discovery) -> None:
    """None of the tables without the effect that was accepted last looks as good."""
    bootstrap = bootstrap_last(found.trail)

    assert bootstrap is not None and bootstrap.p_value == pytest.approx(1 / 201)
    assert (bootstrap.effect, bootstrap.joint) == ("backlash", case.hidden[0].joint)


@pytest.mark.long
def test_what_others_would_take_up_is_no_noise() -> None:
    """The others are fitted without the effect accepted last before it is tested.

    Formerly all 200 tables looked as good as this one, whose effect has p = 1e-9.
    """
    case = draw_case("nonlinear_elasticity", 0, n=80, arm="kuka", strength=60.0)
    trail = run_discovery(case.robot, case.rows, case.options).trail
    last = [step for step in trail.steps if not step.is_elastic][-1]
    told = bootstrap_last(trail)

    assert last.score.p_value < 1e-8 and told is not None
    assert told.p_value == pytest.approx(1 / 201)


def test_standard_deviations_pay_for_what_is_not_in_the_model(found: Discovery) -> None:
    """By one factor in the noise, priors left alone; values, the noise and what is identified stay."""
    fit, last = found.calibration.fit, found.trail.final
    ratio = fit.solution.known.covariance.diagonal() / last.solution.known.covariance.diagonal()
    others = fit.readings(found.calibration.train).conditions

    assert np.all(ratio > 1.0 - 1e-9) and 1.05 < ratio.max() < 2.0
    assert np.all(fit.estimate.sigma <= fit.fit.priors.sizes * (1.0 + 1e-9))
    assert np.all(fit.position_sigma(others) > FittedRobot.of(last).position_sigma(others))
    assert np.array_equal(fit.values, last.values) and np.array_equal(fit.solution.sigma, last.solution.sigma)
    assert fit.solution.posterior.identifiable_rank == last.solution.posterior.identifiable_rank


def test_candidates_weigh_as_likely_as_they_are(found: Discovery) -> None:
    """One that should have been accepted counts whole, those that explain nothing not at all."""
    tests = score_test(found.trail.final, found.trail.last.effects[:25])
    # A candidate with a single parameter.
    lone = next(i for i in range(1, 25) if len(tests.columns[i]) == 1)
    chosen = tests.columns[lone][0]

    def left(gain: float) -> ScoreTests:
        """Residuals that are this candidate's, of so large a gain."""
        size = np.sqrt(gain / tests.within(range(25))[1][chosen, chosen])
        return told(tests, size * tests.cross[:, chosen], size * tests.inner[:, chosen], tests.dof + gain)

    assert of_candidates(left(0.0)) == pytest.approx(0.0, abs=1e-9)
    assert of_candidates(left(3.0)) < 0.5
    assert of_candidates(left(100.0)) == pytest.approx(100.0, rel=0.05)
    # One that is there or not, whatever the others are.
    assert of_candidates(left(100.0), [lone]) == pytest.approx(100.0) and of_candidates(left(100.0), [0]) < 100.0


def test_bearings_may_give_way_in_directions_that_no_data_called_for(found: Discovery) -> None:
    """Each direction and place counts less than it could take off the squares; of a rigid arm there is none."""
    fit = found.trail.final
    refused = [e for e in bearing_features(fit.problem.chain, fit.options.effects) if e not in fit.options.effects]
    gains = [score_test_given_nuisances(fit, [effect]).gain([0])[0] for effect in refused]

    assert 0.0 < of_bearings(score_test_given_nuisances(fit, refused)) < sum(gains)
    rigid = refit(fit, GEOMETRIC)
    assert of_bearings(score_test_given_nuisances(rigid, [])) == of_masses(rigid, score_test(rigid, [])) == 0.0


@pytest.mark.parametrize("has_blocks", [False, True])
def test_tests_that_follow_each_other_are_those_made_alone(found: Discovery, has_blocks: bool) -> None:
    """The columns of bearings' features that candidates replace are left out of those that are known already."""
    fit = found.trail.final
    features = missing_features(fit)
    blocks = np.arange(len(fit.problem)) % 4
    one_by_one = GivenNuisances(fit, blocks)
    groups = blocks if has_blocks else None

    assert len(features) > 1
    for effects in (features[:1], features, features[1:]):
        alone = score_test_given_nuisances(fit, effects, groups)
        follows = one_by_one(effects, groups)
        assert follows.names == alone.names
        for which in ([0], range(len(effects))):
            assert follows.gain(which) == pytest.approx(alone.gain(which), rel=1e-6)
            np.testing.assert_allclose(follows.gains_by_block(which), alone.gains_by_block(which), rtol=1e-4, atol=1e-6)


def test_masses_add_what_the_data_leave_of_their_priors(found: Discovery) -> None:
    """By the formula, with masses tested as any other effect; tests widen the priors of geometry, fits do not."""
    fit = found.trail.final
    masses = MassError.of(*fit.arm)
    assert masses is not None
    D = np.array([parameter.size for parameter in masses.parameters(fit.problem.chain)])

    def expected(tests: ScoreTests) -> float:
        _, S, b = tests.within([0])
        C = np.linalg.inv(S + np.diag(D**-2.0))
        return float((C @ b) @ S @ (C @ b) + np.sum(S * C))

    searched = of_masses(fit, score_test_given_nuisances(fit, missing_features(fit)))
    at_its_noise = replace(fit, solution=replace(fit.solution, sigma=fit.solution.estimated))

    assert searched == pytest.approx(expected(score_test(fit, [masses])), rel=1e-6)
    assert variance_of_masses(at_its_noise) == pytest.approx(expected(score_test(fit, [masses], wider=1.0)), rel=1e-6)
    assert variance_of_masses(at_its_noise) > 0.0


def test_fewer_than_no_halves_are_refused(case: Case) -> None:
    """Before anything is fitted."""
    with pytest.raises(BadInputError, match="stability is -1"):
        run_discovery(case.robot, case.rows, case.options, stability=-1)


@pytest.mark.long
@pytest.mark.rates
def test_what_comes_up_in_nearly_every_half_is_true() -> None:
    """Of sound tables and hidden effects; names that are sure are right, and intervals cover what they say."""
    kinds = ["null", "gear_eccentricity", "backlash", "link_bending", "thermal_offset", "step"]
    found = study([(kind, 9900 + i, 250.0) for i, kind in enumerate(kinds)])
    for halves, right in by_class(found):
        print(f"in {halves[0]} to {halves[-1]} of 20: {len(right)} names, {sum(right)} right")
    covered = np.array([case.coverage for case in found])
    print(f"95 % intervals cover {covered.mean():.4f}")

    *_, (_, sure) = by_class(found)
    assert len(sure) >= 3 and binom.cdf(sum(sure), len(sure), 0.99) > 1e-3
    assert abs(covered.mean() - 0.95) < 0.01 + 3.3 * covered.std(ddof=1) / np.sqrt(len(covered))
