"""What a discovery reports: discovery.json, where it disagrees, how large effects must be, how the gap shrinks."""

import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from command_line import run
from discovery_cases import SIGMA, Case, draw_case
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from rich.console import Console
from scipy.special import fdtrc

from pincal import ELASTIC, GEOMETRIC, Options, Robot, calibrate
from pincal.calibration.curve_coverage import outside_curves
from pincal.calibration.fitted_robot import load_model
from pincal.calibration.precheck import precheck
from pincal.discover.cli.search_screen import print_discovery
from pincal.discover.decisions import Row, critical_gain, is_more_than_chance
from pincal.discover.detectability import detectable_noncentrality, minimum_detectable, power_of
from pincal.discover.discovery_file import Findings, FoundEffect, Gap, ScatteringJoint
from pincal.discover.discovery_file import Verdict as FoundVerdict
from pincal.discover.first_order import ScoreResult
from pincal.discover.levers import on_steps
from pincal.discover.locate import _window, locate
from pincal.discover.policy import POLICY
from pincal.discover.report.found_figures import effect_figure, shrinking_figure, stability_figure
from pincal.discover.report.found_words import gain_words
from pincal.discover.report.search_answer import SearchAnswer, _apart, verdict_of_search
from pincal.discover.run import Discovery, run_discovery
from pincal.discover.score_tests import score_test
from pincal.discover.shrink import PartialResidual, period_of
from pincal.identify.calibrate import refit
from pincal.identify.fit_levers import levers
from pincal.identify.folds import Folds
from pincal.measure.measurements import Measurements
from pincal.measure.table import read_measurements, write_table
from pincal.model.catalogue import GearEccentricity, TransmissionError, candidates
from pincal.model.catalogue.unnamed import Unnamed
from pincal.notes import Note, Severity
from pincal.parameters import estimate_of
from pincal.report.judgement import judged, relative_to_noise

HIDDEN = (
    "backlash_cobot",
    "coupling_heavy",
    "curve_cobot",
    "eccentricity_heavy",
    "null_cobot",
    "null_heavy",
    "pair_heavy",
    "rigid_cobot",
    "step_cobot",
    "thermal_heavy",
)
# None, two at once, of drives, of the warming links and of what has no name; an elastic arm and a rigid one.
OF_EACH_KIND = ("null_cobot", "pair_heavy", "curve_cobot", "rigid_cobot", "step_cobot", "thermal_heavy")


@pytest.fixture(scope="module")
def case() -> Case:
    return draw_case("backlash", 3, n=160, arm="kuka", strength=200.0)


@pytest.fixture(scope="module")
def found(case: Case) -> Discovery:
    return run_discovery(case.robot, case.rows, case.options, split="blocked")


@pytest.fixture(scope="module")
def elastic_fit(case: Case) -> Any:
    return calibrate(case.robot, case.rows, replace(case.options, effects=ELASTIC, loss="none"))


def test_discovery_json_has_the_fields_of_the_contract(found: Discovery) -> None:
    """Every field is there with its type, and the whole is JSON without NaN."""
    report = json.loads(json.dumps(found.report, allow_nan=False))

    assert set(report) == {
        "noise_floor_mm",
        "gap",
        "chain",
        "delivered",
        "regions",
        "where",
        "effects",
        "scatter",
        "not_testable",
        "verdict",
        "unexplained_mm",
        "held_out",
    }
    assert report["noise_floor_mm"] == pytest.approx(1e3 * SIGMA * np.sqrt(3.0))
    for gap in report["gap"].values():
        assert set(gap) == {"mean_mm", "rms_mm", "max_mm"} and all(isinstance(v, float) for v in gap.values())
    for place in report["where"]:
        assert ("joint" in place) != ("region" in place)
        assert place["statement"] and 0.0 <= place["share"] <= 1.0
    for entry in report["effects"]:
        assert {"effect", "joint", "parameters", "p_value", "gap_before_mm", "gap_after_mm"} <= set(entry)
        assert 0.0 <= entry["p_value"] < 1.0
        for parameter in entry["parameters"].values():
            assert set(parameter) == {"value", "sigma", "unit"} and isinstance(parameter["value"], float)
    assert all(entry["effect"] and entry["reason"] for entry in report["not_testable"])
    assert report["verdict"] in ("adequate", "not adequate")
    assert report["verdict"] == judged(found.calibration.result, SearchAnswer(found)).judgement


def test_the_gap_is_a_chain_whose_shares_add_up(found: Discovery) -> None:
    """Each effect begins where the row above ended, the last row is the gap, and nothing that is shared counts twice."""
    chain, report = found.findings.chain, found.report

    assert (chain[0].gap, chain[-1].gap) == (found.findings.gap["before"], found.findings.gap["after"])
    for entry in report["effects"]:
        place = next(i for i, row in enumerate(chain) if entry["effect"] in [effect.effect for effect in row.entered])
        before, after = chain[place - 1 : place + 1]
        assert (entry["gap_before_mm"], entry["gap_after_mm"]) == (before.mean_mm, after.mean_mm)
    assert sum(row.share or 0.0 for row in chain) == pytest.approx(1.0)
    squares = [row.rms_mm**2 for row in chain]
    assert chain[1].share == pytest.approx((squares[0] - squares[1]) / (squares[0] - squares[-1]))


def test_tell_apart_stands_exactly_where_there_are_equivalents(found: Discovery) -> None:
    """What could also be something else says which measurement decides, anything else says nothing."""
    for entry in found.report["effects"]:
        assert bool(entry["equivalent"]) == bool(entry["tell_apart"])


def test_the_hidden_effect_is_named_and_was_located_before(case: Case, found: Discovery) -> None:
    """The place that the elastic fit's residuals point to is that of the hidden effect, and so is what it follows."""
    joint = case.hidden[0].joint
    names = [(entry["effect"], entry["joint"]) for entry in found.report["effects"]]
    places = [place for place in found.report["where"] if "depends_on" in place]

    assert ("backlash", joint) in names
    assert [(p["joint"], p["acts_on"], p["depends_on"]) for p in places[:1]] == [(joint, "drive", "approach")]
    assert places[0]["share"] > 0.5
    assert joint in places[0]["statement"]


def test_gap_is_the_error_on_rows_that_nobody_saw(found: Discovery) -> None:
    """The numbers of the gap are those of fits by which each region was predicted without its own rows."""
    fit = found.calibration.fit
    fold = Folds.of(fit.problem, ("regions",)).of_way["regions"]
    for when, used in (("before", found.trail.first), ("after", fit.fit)):
        errors = np.empty(len(fold))
        for k in range(int(fold.max()) + 1):
            others = used.select(np.flatnonzero(fold != k))
            again = refit(others, others.options.effects, start={})
            held = used.problem.stations[0].select(np.flatnonzero(fold == k))
            errors[fold == k] = 1e3 * np.linalg.norm(held.residuals(again.values), axis=0)

        gap = found.report["gap"][when]
        assert gap["mean_mm"] == pytest.approx(errors.mean(), rel=0.02)
        assert gap["max_mm"] == pytest.approx(errors.max(), rel=0.05)


def test_model_file_predicts_with_the_new_effect(tmp_path: Path, found: Discovery) -> None:
    """A model read back predicts what the fit predicts, the effect that was found included."""
    fit = found.calibration.fit
    fit.save(tmp_path / "model.json")
    back = load_model(tmp_path / "model.json")
    conditions = fit.fit.station.conditions

    assert "backlash" in [effect.name for effect in back.model.effects]
    expected = fit.model.predict(fit.model_values, conditions)
    np.testing.assert_array_equal(back.predict(conditions), expected)
    turned = replace(conditions, approach=-conditions.approach)
    assert np.abs(back.predict(turned) - expected)[:, :, 3].max() > 1e-5


def test_nothing_is_located_where_there_is_only_noise() -> None:
    """An elastic arm with nothing hidden has no place but that of its elasticity."""
    null = draw_case("null", 4, n=150, arm="kuka")
    fit = calibrate(null.robot, null.rows, replace(null.options, effects=ELASTIC))

    assert locate(fit.fit, np.array([SIGMA])) == ([], [])


def test_levers_are_how_readings_move(elastic_fit: Any) -> None:
    """The lever of a joint's drive is the derivative of the prediction by the joint's position."""
    chain, problem, h = elastic_fit.model.chain, elastic_fit.fit.station, 1e-5
    values = elastic_fit.model_values
    moved = [replace(problem.conditions, q=problem.conditions.q + h * sign * np.eye(6)[2]) for sign in (1.0, -1.0)]
    plus, minus = (elastic_fit.model.predict(values, c)[:, :, 3] for c in moved)

    lever = levers(elastic_fit, (int(chain.drives[2]),))[0]

    # What the load bends more or less at the new position is no part of a lever.
    np.testing.assert_allclose(lever, ((plus - minus) / (2.0 * h)).T, atol=5e-3)


def test_a_range_is_named_only_if_most_sits_in_it() -> None:
    """The narrowest range with 60 % of the energy is found; spread energy has none."""
    x = np.linspace(0.0, 100.0, 401)

    window, inside = _window(x, np.exp(-0.5 * ((x - 30.0) / 5.0) ** 2))

    assert window is not None and 24.0 < window[0] < 27.0 and 33.0 < window[1] < 36.0
    assert 0.6 <= inside < 0.62
    assert _window(x, np.ones(401)) == (None, 0.0)


# How large an effect has to be.


@pytest.mark.parametrize(("dof", "rank", "among"), [(550.0, 1, 75), (40.0, 3, 20), (5000.0, 8, 200)])
def test_the_critical_gain_is_where_a_name_enters(dof: float, rank: int, among: int) -> None:
    """What the check before a search promises is what the search asks, by the F test and by relevance."""

    def enters(gain: float) -> bool:
        p_value = float(fdtrc(rank, dof - rank, gain / rank / ((dof - gain) / (dof - rank))))
        row = Row(
            GearEccentricity("joint_1"),
            ScoreResult(gain, rank, p_value, 0.0),
            0.0,
            among=among,
            least=POLICY.least_gain(dof, declared=True),
        )
        return is_more_than_chance(row, POLICY)

    least = critical_gain(dof, rank, among, POLICY)

    assert enters(least * (1.0 + 1e-9))
    assert not enters(least * (1.0 - 1e-9))


def test_power_is_that_of_simulated_tests() -> None:
    """At the detectable non-centrality nine of ten simulated F tests pass the critical gain."""
    rng = np.random.default_rng(1)
    for rank in (1, 2, 8):
        test = (550.0, rank, 75)
        noncentrality = detectable_noncentrality(test)
        gain = rng.noncentral_chisquare(rank, noncentrality, 20000)
        left = rng.chisquare(550.0 - rank, 20000)
        passed = gain / (gain + left) * 550.0 > critical_gain(*test, POLICY)

        assert power_of(noncentrality, test) == pytest.approx(0.9, abs=1e-6)
        assert passed.mean() == pytest.approx(0.9, abs=0.01)
        # Without effect the test is at most as often wrong as it promises.
        assert power_of(1e-9, test) <= 1.001 * POLICY.false_name / 75


def test_detectable_size_follows_noise_and_curves_are_measured_by_rms(elastic_fit: Any, case: Case) -> None:
    """Twice the noise needs twice the effect; each has a size, or a reason why it has none."""
    effects = candidates(elastic_fit.model.chain, elastic_fit.fit.station.conditions)
    once, twice = (minimum_detectable(elastic_fit.fit, effects, sigma=np.array([s])) for s in (SIGMA, 2.0 * SIGMA))

    for a, b in zip(once, twice, strict=True):
        assert (a.size is None) == bool(a.reason)
        if a.size is not None and b.size is not None:
            # Priors do not grow with the noise: where it is loud the model takes up less, along more directions. Of what
            # they let it take up nearly all, most is left to them.
            least = 1.35 if a.absorbed < 0.995 else 1.0
            assert least * a.size < b.size < (2.01 if a.size == a.best else 3.0) * a.size
            assert a.best is not None and 0.0 < a.best <= a.size * (1.0 + 1e-9)
    assert {a.measure for a in once if isinstance(a.effect, TransmissionError)} == {"rms of the curve"}
    joint = case.hidden[0].joint
    play = next(a for a in once if a.effect.name == "backlash" and vars(a.effect)["joint"] == joint)
    # The case is drawn at a non-centrality of 200, the threshold of one parameter is about 28; half the play counts.
    assert play.size == pytest.approx(0.5 * case.hidden[0].size * np.sqrt(28.0 / 200.0), rel=0.25)


@pytest.mark.long
@pytest.mark.parametrize("name", ["backlash", pytest.param("gear_eccentricity", marks=pytest.mark.rates)])
def test_effects_of_detectable_size_are_found_nine_times_of_ten(name: str, elastic_fit: Any, case: Case) -> None:
    """Tables simulated with an effect of that size, random in phase, pass the test about that often."""
    fit, rng = elastic_fit, np.random.default_rng(3)
    conditions = fit.fit.station.conditions
    effects = candidates(fit.model.chain, conditions)
    sights = minimum_detectable(fit.fit, effects, sigma=np.array([SIGMA]))
    sight = next(s for s in sights if s.effect.name == name and vars(s.effect)["joint"] == "joint_3")
    assert sight.size is not None
    model = fit.model.with_effects([*fit.model.effects, sight.effect])
    groups = len(
        {(e.name, vars(e).get("joint"), vars(e).get("source"), vars(e).get("order"), vars(e).get("frame")) for e in effects}
    )
    hits = []
    for _ in range(60):
        beta = rng.standard_normal(len(sight.effect.parameters(fit.model.chain)))
        values = np.concatenate([fit.values, sight.size * beta / np.linalg.norm(beta)])
        position = model.predict(values, conditions)[:, :, 3] + SIGMA * rng.standard_normal((len(conditions), 3))
        again = calibrate(case.robot, case.rows.with_readings(position=position), fit.options)
        tested = score_test(again.fit, [sight.effect], np.zeros(len(conditions), int))
        score = tested.score([0], len(effects))
        hits.append(score.p_value < POLICY.false_name / groups)

    assert 0.78 <= np.mean(hits) <= 0.99


def test_survey_tells_what_could_be_found(case: Case) -> None:
    """A precheck lists every effect with a size or a reason, and the noise that this rests on."""
    declared = precheck(case.robot, case.rows, replace(case.options, effects=GEOMETRIC)).further["detectable"].found
    estimated = precheck(case.robot, case.rows, replace(case.options, sigma=None)).further["detectable"].found

    assert (declared.model, declared.source, declared.sigma_m) == ("elastic", "declared", SIGMA)
    # The hidden effect, which is not in the model, makes the noise seem larger.
    assert estimated.source == "estimated" and SIGMA * 0.9 < estimated.sigma_m < SIGMA * 1.5
    assert all((sight.size is None) == bool(sight.reason) for sight in declared.effects)
    assert {"backlash", "gear_eccentricity", "transmission_error"} <= {s.effect.name for s in declared.effects if s.size}
    assert any(s.effect.name == "measurement_scale" and "rank zero" in s.reason for s in declared.effects)


def test_survey_assumes_noise_where_rows_are_too_few_to_tell(case: Case) -> None:
    """With as many readings as parameters nothing is promised, and the noise is said to be assumed."""
    few = precheck(case.robot, case.rows.select(np.arange(8)), replace(case.options, sigma=None)).further["detectable"].found

    assert few.source == "assumed"
    assert all(sight.size is None and sight.reason for sight in few.effects)


# Periods and pictures.


def _trace(y: np.ndarray, x: np.ndarray, sigma: float) -> PartialResidual:
    noise = sigma * np.random.default_rng(0).standard_normal(len(x))
    effect = Unnamed("a", "gamma_x", "b", lower=float(x.min()), upper=float(x.max()))
    return PartialResidual(effect, "b", "rad", x, y + noise, noise, y, np.full(len(x), sigma**-2.0), "rad")


def test_period_is_that_of_a_tone_and_none_of_anything_else() -> None:
    """A tone of which two periods are seen has a period; a step, a bump, half a wave and noise have none."""
    x = np.random.default_rng(2).uniform(-2.5, 2.5, 300)

    assert period_of(_trace(1e-4 * np.sin(7.3 * x + 1.0), x, 5e-5)) == pytest.approx(2.0 * np.pi / 7.3, rel=0.02)
    assert period_of(_trace(1e-4 * (x > 0.4), x, 3e-5)) is None
    assert period_of(_trace(1e-4 * np.exp(-0.5 * ((x - 0.5) / 0.3) ** 2), x, 3e-5)) is None
    assert period_of(_trace(1e-4 * np.sin(0.8 * x), x, 3e-5)) is None
    assert period_of(_trace(0.0 * x, x, 3e-5)) is None


def test_gains_of_tones_are_those_of_least_squares() -> None:
    """A sine, a cosine and a constant fitted with weights take as much off, for the first of many cycles and the last."""
    rng = np.random.default_rng(2)
    angle, y, w = rng.uniform(0.0, 2.0 * np.pi, 300), rng.standard_normal(300), rng.uniform(0.5, 2.0, 300)

    cycles, gains = on_steps(angle, w * y, w, start=1.8, step=0.125, end=75.0, is_beside_constant=True)

    constant = np.sum(w * (y - np.average(y, weights=w)) ** 2)
    for k in (0, 100, len(cycles) - 1):
        A = np.sqrt(w)[:, None] * np.column_stack([np.ones(300), np.cos(cycles[k] * angle), np.sin(cycles[k] * angle)])
        left = np.linalg.lstsq(A, np.sqrt(w) * y, rcond=None)[1]
        assert gains[k] == pytest.approx(constant - left[0], rel=1e-9)


def test_traces_show_noise_after_and_the_effect_before(found: Discovery) -> None:
    """With the effect left out the rows follow it, with it they scatter about zero as the noise lets them."""
    trace = next(t for t in found.traces if t.effect.name == "backlash")

    assert (trace.variable, trace.error_unit) == ("approach", "rad")
    np.testing.assert_allclose(trace.before - trace.after, trace.fitted, atol=1e-9)
    assert np.mean(trace.after**2 * trace.weights) == pytest.approx(1.0, abs=0.4)
    mean = np.average(trace.before * np.sign(trace.fitted), weights=trace.weights)
    assert mean == pytest.approx(np.abs(trace.fitted).mean(), rel=0.3)


def printed(found: Discovery, **entries: Any) -> str:
    """Return what the screen shows of a discovery with other entries, line ends and all."""
    out = io.StringIO()
    findings = msgspec.structs.replace(found.findings, **entries)
    print_discovery(replace(found, findings=findings), Console(file=out, width=100))
    return out.getvalue()


def entry_of(effect: str, joint: str, **more: Any) -> FoundEffect:
    """Return an effect as a discovery names it."""
    rest = {"p_value": 1e-9, "gap_before_mm": 0.2, "gap_after_mm": 0.1, "parameters": {}, "equivalent": (), "tell_apart": ""}
    return FoundEffect(effect=effect, joint=joint, **{**rest, **more})


def test_one_way_to_distinguish_several_effects_is_said_once() -> None:
    """Four ripples of a UR5 had the same sentence, which is no next step for any of them."""
    found = [entry_of("gear_ripple", f"joint_{k}", tell_apart="inspect the joint") for k in (1, 2)]
    found += [entry_of("backlash", "joint_3", tell_apart="approach from both sides"), entry_of("gear_ratio", "joint_1")]

    assert list(_apart(found)) == [
        "To distinguish gear_ripple of joint_1; gear_ripple of joint_2 from their alternatives: inspect the joint.",
        "To distinguish backlash of joint_3 from its alternatives: approach from both sides.",
    ]


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (
            entry_of("gear_ripple", "joint_2", order=405.0, beside=(401.4,), origin="as often as a wheel's teeth"),
            "as often as a wheel's teeth; one spectral line whose amplitude varies over the span of the joint, fitted as "
            "harmonics of order 405 and 401.4",
        ),
        (
            entry_of("backlash", "joint_3", tell_apart="approach [some] poses from both sides"),
            "to distinguish backlash of joint_3 from its alternatives: approach [some] poses from both sides",
        ),
        (
            entry_of("unnamed", "joint_1", depends_on="time", shape="wave", period=600.0, period_unit="s"),
            "repeats every 600 s",
        ),
        (
            entry_of("unnamed", "joint_1", depends_on="joint_2", shape="wave", period=0.25, period_unit="rad"),
            "repeats every 14.32 deg",
        ),
        (
            entry_of("unnamed", "rail", depends_on="rail", shape="curve", period=0.25, period_unit="m"),
            "unnamed of rail (curve of rail) repeats every 250 mm",
        ),
    ],
    ids=["a spectral line", "alternatives", "a period of time", "a period of a joint", "a period along a rail"],
)
def test_the_screen_says_of_an_effect_what_no_table_holds(found: Discovery, entry: FoundEffect, words: str) -> None:
    """Its spectral line, what tells it from its alternatives, and its period; of an effect without them no such line."""
    shown = " ".join(printed(found, effects=(entry,)).split())
    plain = " ".join(printed(found, effects=(entry_of(entry.effect, entry.joint or ""),)).split())

    assert words in shown
    assert not any(line in plain for line in ("spectral line", "to distinguish", "repeats every"))


def test_the_screen_says_which_joint_scatters_and_that_nothing_was_found(found: Discovery) -> None:
    """A joint with its size and what to record; without effects, that none is missing."""
    scatter = ScatteringJoint(joint="joint_5", sigma_rad=2.5e-4, missing="the direction of approach")
    shown = " ".join(printed(found, effects=(), scatter=(scatter,)).split())

    assert "joint_5 scatters by 0.250 mrad; record the direction of approach" in shown
    assert "These data show no missing effect." in shown


def test_figures_are_drawn_from_results(found: Discovery) -> None:
    """Each trace and the gaps make a figure; nothing to draw is refused."""
    for trace in found.traces:
        figure = effect_figure(trace, "title")
        assert [axes.get_title(loc="left").split(":")[0] for axes in figure.axes] == ["without it", "with it"]
    names = [str(k) for k in range(len(found.gaps))]
    shrinking_figure(names, {"rms": [gap.rms_mm for gap in found.gaps]}, 0.1)
    trace = found.traces[0]
    empty = replace(trace, x=trace.x[:0])
    with pytest.raises(ValueError, match="no rows"):
        effect_figure(empty, "title")


# Commands.


def _columns(rows: Measurements) -> dict[str, np.ndarray]:
    assert rows.position is not None and rows.payload is not None and rows.approach is not None
    columns = {name: rows.q[:, i] for i, name in enumerate(rows.joint_names)}
    columns |= {axis: rows.position[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"approach_{name}": rows.approach[:, i] for i, name in enumerate(rows.joint_names)}
    return columns | {"payload": rows.payload}


_LONG = "unnamed of shoulder_pan_joint (field of shoulder_pan_joint and elbow_joint)"


@pytest.mark.parametrize("name", ["joint_elasticity of joint_2", "gear_eccentricity of shoulder_lift_joint", _LONG])
def test_the_label_of_subsamples_is_whole(name: str) -> None:
    """Beside long names the axis is narrow; what it shows stands within the figure, and a long name on several lines."""
    figure = stability_figure({name: 20, "gear_ratio of joint_1": 3}, 20, 0.6)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    label = figure.axes[0].xaxis.label.get_window_extent(canvas.get_renderer())

    assert label.x0 >= 0.0 and label.x1 <= figure.bbox.width
    assert name in [text.get_text().replace("\n", " ") for text in figure.axes[0].get_yticklabels()]


@pytest.mark.long
def test_check_prints_what_could_be_found(tmp_path: Path, case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    """The table of sizes is printed and stands in the JSON; no line of a table is wider than a page."""
    write_table(tmp_path / "data.csv", _columns(case.rows))
    (tmp_path / "robot.urdf").write_bytes(case.robot.urdf)
    common = (tmp_path / "robot.urdf", tmp_path / "data.csv", "--noise", "0.05mm", "--tip", case.robot.tip)
    assert run("check", *common, "--verbose", "--quiet") == 0
    printed = capsys.readouterr().out

    assert "Smallest effects that would be found" in printed
    assert "backlash" in printed and "µrad" in printed
    assert max(len(line) for line in printed.splitlines()) <= 100
    assert run("check", *common, "--json", "--quiet") == 0
    detectable = json.loads(capsys.readouterr().out)["detectable"]
    assert detectable["source"] == "declared" and detectable["power"] == 0.9
    assert {"effect", "joint", "size", "unit", "reason"} <= set(detectable["effects"][0])


@pytest.mark.long
@pytest.mark.usefixtures("drawn")
def test_discover_shows_the_gap_shrink(tmp_path: Path, case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    """The terminal has a line a step down to the noise, and report.html the figures, without any network."""
    write_table(tmp_path / "data.csv", _columns(case.rows))
    (tmp_path / "robot.urdf").write_bytes(case.robot.urdf)
    files = (tmp_path / "robot.urdf", tmp_path / "data.csv", "--out", tmp_path / "out", "--tip", case.robot.tip)
    options = ("--noise", "0.05mm", "--payload-com", *case.options.payload_centre, "--moment-frame", "after", "--quiet")
    assert run("discover", *files, *options, "--verbose", "--stability", "0") == 0
    printed, page = capsys.readouterr().out, (tmp_path / "out" / "report.html").read_text(encoding="utf-8")

    assert f"+ backlash of {case.hidden[0].joint}" in printed and "noise alone" in printed
    assert page.count("without and with it") == 2
    assert "http" not in page.replace("http://www.w3.org", "")
    assert json.loads((tmp_path / "out" / "discovery.json").read_text())["effects"]


# Curves outside the range in which they were seen.


@pytest.mark.parametrize("periodic", [False, True])
def test_a_curve_keeps_its_end_value(periodic: bool, kuka: Robot) -> None:
    """Outside the positions that were seen a drive curve neither swings nor repeats."""
    curve = TransmissionError("joint_1", -1.0, 2.0, 12, periodic)
    height = np.random.default_rng(0).standard_normal(12)
    ends = height @ curve.basis(np.array([-1.0, 2.0]))

    np.testing.assert_allclose(height @ curve.basis(np.array([-3.0, -1.2])), ends[0])
    np.testing.assert_allclose(height @ curve.basis(np.array([2.01, 6.0])), ends[1])


def _model_with(fit: Any, effect: Any) -> Any:
    model = fit.model.with_effects([*fit.model.effects, effect])
    bare = fit
    more = model.n_parameters - fit.model.n_parameters
    padded = np.zeros((model.n_parameters, model.n_parameters))
    padded[: len(bare.values), : len(bare.values)] = bare.covariance
    values = np.append(bare.values, np.full(more, 1e-4))
    return bare.with_model(model, estimate_of(model.parameters, values, padded))


def test_rows_outside_a_curve_are_told(elastic_fit: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Predictions beyond a curve's range, of its own joint or of another variable, name the joint and both ranges."""
    q = np.zeros((3, 6))
    q[:, 1], q[2, 2] = -1.5, 0.9
    calibrated = _model_with(elastic_fit, TransmissionError("joint_3", -0.5, 0.5))
    calibrated.save(tmp_path / "model.json")
    write_table(tmp_path / "poses.csv", {name: q[:, i] for i, name in enumerate(calibrated.model.chain.robot.joint_names)})
    conditions = elastic_fit.fit.station.conditions.select(np.arange(3))

    (beyond,) = outside_curves(calibrated, replace(conditions, q=q))

    assert (beyond.effect, beyond.joint, beyond.variable, beyond.rows) == ("transmission_error", "joint_3", "joint_3", 1)
    assert (beyond.lower, beyond.upper, beyond.highest) == (-0.5, 0.5, 0.9)
    assert outside_curves(calibrated, replace(conditions, q=np.zeros((3, 6)))) == []
    other = _model_with(elastic_fit, Unnamed("joint_2", "drive", "joint_3", lower=-0.5, upper=0.5))
    assert [(o.joint, o.variable) for o in outside_curves(other, replace(conditions, q=q))] == [("joint_2", "joint_3")]
    ranges = {"lower": -0.5, "upper": 0.5, "own_lower": -1.0, "own_upper": 1.0}
    over_both = _model_with(elastic_fit, Unnamed("joint_2", "drive", "joint_3", "map", size=4, **ranges))
    along_each = [(o.joint, o.variable, o.rows) for o in outside_curves(over_both, replace(conditions, q=q))]
    assert along_each == [("joint_2", "joint_3", 1), ("joint_2", "joint_2", 3)]
    assert outside_curves(_model_with(elastic_fit, GearEccentricity("joint_3")), replace(conditions, q=q)) == []
    assert run("predict", tmp_path / "model.json", tmp_path / "poses.csv", "--out", tmp_path / "predicted.csv") == 0
    noted = capsys.readouterr().err
    assert "transmission_error of joint_3" in noted and f"{-np.degrees(0.5):.2f} to {np.degrees(0.5):.2f} deg" in noted
    assert f"0 to {np.degrees(0.9):.2f} deg" in noted


# The examples with answers.


# The others are named in drawn cases of discovery as well.
@pytest.mark.long
@pytest.mark.parametrize(
    "name", [name if name in OF_EACH_KIND else pytest.param(name, marks=pytest.mark.rates) for name in HIDDEN]
)
def test_hidden_examples_come_out_right(name: str, hidden_examples: Path) -> None:
    """What is hidden stands among the names of discovery.json, elastic only if the machine is, and nothing else."""
    folder = hidden_examples / "cases" / name
    given = json.loads((folder / "case.json").read_text())
    answer = json.loads((hidden_examples / "answers" / f"{name}.json").read_text())
    robot = Robot.from_urdf(folder / "robot.urdf", tip=given["tip"])
    rows = read_measurements(folder / "data.csv", robot.joint_names)
    options = Options(effects=GEOMETRIC, sigma=given["sigma"], payload_centre=tuple(given["payload_com"]))

    report = run_discovery(robot, rows, options).report

    elastic = {"joint_elasticity", "bearing_elasticity"}
    named = [entry for entry in report["effects"] if entry["effect"] not in elastic]
    assert any(entry["effect"] in elastic for entry in report["effects"]) == (answer["elastic"] is not None)
    assert len(named) + len(report["scatter"]) == len(answer["hidden"])
    for hidden in answer["hidden"]:
        classes = [[entry, *entry["equivalent"]] for entry in [*named, *_as_effects(report["scatter"])]]
        assert any(_is(hidden, other) for others in classes for other in others), hidden
    assert report["verdict"] == ("not adequate" if report["scatter"] else "adequate")
    assert all(bool(entry["equivalent"]) == bool(entry["tell_apart"]) for entry in report["effects"])
    # The places that were found before anything was named are those of what is hidden.
    located = [place.get("joint") for place in report["where"] if "depends_on" in place]
    assert sorted(map(str, located)) == sorted(str(hidden["joint"]) for hidden in answer["hidden"])


def _as_effects(scatter: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{"effect": "joint_scatter", "joint": entry["joint"], "equivalent": []} for entry in scatter]


def _is(hidden: dict[str, Any], named: dict[str, Any]) -> bool:
    """Return whether a name is the hidden one, and at its joint; of a nameless one the joint alone."""
    keys = [key for key in ("effect", "joint", "source") if key in hidden]
    return all(hidden[key] == named.get(key) for key in keys)


@pytest.mark.parametrize(("left", "is_mentioned"), [(4.9e-4, False), (5.1e-4, True)])
def test_errors_below_what_is_printed_are_not_mentioned(found: Discovery, left: float, is_mentioned: bool) -> None:
    """Less than half a micrometre would be 0.000 mm."""
    sound = {"verdict": FoundVerdict.ADEQUATE, "warnings": ()}
    findings = msgspec.structs.replace(found.findings, unexplained_mm=left, **sound)

    assert ("mm rms beyond the noise" in str(verdict_of_search(findings).reason)) == is_mentioned


def test_a_verdict_says_what_is_wrong() -> None:
    """Never "not adequate" with nothing unexplained: a joint scatters, or single rows are too far off."""
    gap = Gap(mean_mm=0.1, rms_mm=0.1, max_mm=0.2)
    findings = Findings(
        noise_floor_mm=0.08,
        gap={"before": gap, "after": gap},
        where=(),
        effects=(),
        scatter=(),
        not_testable=(),
        verdict=FoundVerdict.NOT_ADEQUATE,
        unexplained_mm=0.0,
    )
    scatter = ScatteringJoint("elbow", 1e-4, "approach_elbow")

    assert "are larger than the declared noise" in verdict_of_search(findings).reason
    scatters = verdict_of_search(msgspec.structs.replace(findings, scatter=(scatter,))).reason
    assert "elbow scatters from reading to reading" in scatters and "0.0" not in scatters
    assert (
        "0.250 mm rms beyond the noise" in verdict_of_search(msgspec.structs.replace(findings, unexplained_mm=0.25)).reason
    )


def test_chance_is_not_what_is_wrong_where_there_is_a_doubt() -> None:
    """What is beyond a known noise that explains the residuals is left to the doubt that keeps the verdict."""
    gap = Gap(mean_mm=0.1, rms_mm=0.1, max_mm=0.2)
    bare: dict[str, Any] = {"where": (), "effects": (), "scatter": (), "not_testable": (), "noise_floor_mm": 0.08}
    doubt = Note(Severity.DOUBT, "a joint moved steadily along the rows")
    verdict = FoundVerdict.NOT_ADEQUATE
    found = Findings(**bare, gap={"before": gap, "after": gap}, verdict=verdict, unexplained_mm=0.011, warnings=(doubt,))

    assert "0.011 mm rms beyond the noise" in verdict_of_search(found).reason
    assert verdict_of_search(found, is_within_noise=True).reason == "Nothing was added; see the doubt stated first."


@given(
    ratio=st.floats(0.0, 1e3),
    left=st.floats(0.0, 1.0),
    before=st.tuples(*[st.floats(0.0, 2.0)] * 2),
    after=st.tuples(*[st.floats(0.0, 2.0)] * 2),
    is_misfit=st.booleans(),
    scatters=st.booleans(),
)
def test_words_never_contradict_their_numbers(
    ratio: float, left: float, before: tuple[float, float], after: tuple[float, float], is_misfit: bool, scatters: bool
) -> None:
    """Whatever the figures: larger is not said of what is shown as smaller, nor noise of what is said to be unexplained."""
    ratio = max(ratio, 1.0 + 1e-6) if is_misfit else ratio
    words = relative_to_noise(ratio, "the noise", is_misfit=is_misfit)
    assert ("no larger" in words) <= (not is_misfit and ratio < 1.01)
    assert not re.search(r"\b(0\.\d\d|1\.00) times", words)
    assert is_misfit != (("chance" in words and "too many rows" not in words) or "no larger" in words)

    gap = Gap(mean_mm=0.1, rms_mm=0.1, max_mm=0.2)
    scatter = (ScatteringJoint("elbow", 1e-4, "approach_elbow"),) if scatters and is_misfit else ()
    judgement = FoundVerdict.NOT_ADEQUATE if is_misfit else FoundVerdict.ADEQUATE
    bare: dict[str, Any] = {"where": (), "effects": (), "not_testable": (), "noise_floor_mm": 0.1}
    found = Findings(**bare, gap={"before": gap, "after": gap}, scatter=scatter, verdict=judgement, unexplained_mm=left)
    verdict = verdict_of_search(found)
    assert verdict.judgement == judgement
    assert ("consistent with noise" in verdict.reason) != is_misfit and ("unexplained" in verdict.reason) <= is_misfit
    assert "0.000 mm" not in verdict.reason and (f"{left:.3f} mm" in verdict.reason) == (left >= 5e-4)

    sizes = dict(zip(("gap_before_mm", "gap_before_mrad"), before, strict=True))
    sizes |= dict(zip(("gap_after_mm", "gap_after_mrad"), after, strict=True))
    name: dict[str, Any] = {"effect": "backlash", "joint": "elbow", "parameters": {}, "equivalent": (), "tell_apart": ""}
    figures, _, said = gain_words(FoundEffect(**name, p_value=1e-9, **sizes)).partition(": ")
    mm, mrad = (float(b) < float(a) for a, b in re.findall(r"(\d\.\d{4}) to (\d\.\d{4})", figures))
    assert said == ("" if mm else "improves orientation only" if mrad else "no improvement on these rows")
