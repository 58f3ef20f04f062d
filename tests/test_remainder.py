"""What is smooth in the joints and has no name: a remainder that predicts, and says nothing of causes."""

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from command_line import run
from machines import kuka as true_kuka
from test_cell_file import VERBS
from test_corrector import answered
from test_corrector import states_of as page_states
from test_export import Compiled, calibrated_of, columns_of, conditions_of, loaded, poses_of, share_formulas, units_of

from pincal import load_model
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.fitted_robot import FittedRobot
from pincal.cli.cell_defaults import _words_of
from pincal.compensate.compensation import compensate_program
from pincal.compensate.robot_frames import in_base_frame, program_poses
from pincal.discover.cli.search_screen import summary_of_search
from pincal.discover.policy import POLICY
from pincal.discover.remainder_numbers import REMAINDER
from pincal.discover.report.found_section import found_section
from pincal.discover.report.found_words import smooth_words
from pincal.discover.run import Discovery, run_discovery
from pincal.discover.smooth_judge import LeftOutRegions, joined_regions
from pincal.discover.smooth_likelihood import likely_remainders
from pincal.discover.smooth_rest import with_remainder
from pincal.errors import BadInputError
from pincal.export import export_model
from pincal.export.formulas import formulas_of
from pincal.export.numpy_source import numpy_source
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.measure.table import write_table
from pincal.model.catalogue.remainder import SmoothRemainder, golden_ratio
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect
from pincal.model.effects import ELASTIC, BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.robot.robot import Robot

SIGMA = 5e-5


def table(kuka: Robot, amplitude: float, poses: int, seed: int) -> tuple[Measurements, np.ndarray]:
    """Return rows of a KUKA of which three drives err by functions of two pairs of joints, and its true positions."""
    rng = np.random.default_rng(5)
    machine = true_kuka().draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    q = sim.plan_poses(machine.nominal, poses, np.random.default_rng(seed))
    there = q.copy()
    for j, phase in zip((1, 2, 4), (0.0, 1.0, 2.0), strict=True):
        there[:, j] += amplitude * (np.sin(1.5 * q[:, 1] - q[:, 2] + phase) + np.cos(q[:, 0] + 1.2 * q[:, 4] - phase))
    read = sim.Instrument(targets={"ball": (0.1, 0.0, 0.1)}).measure(machine, there, rng=rng)
    position = np.column_stack([read[axis] for axis in "xyz"])
    noise = SIGMA * np.random.default_rng(seed + 1).standard_normal(position.shape)
    return measurements_from_arrays(kuka.joint_names, q, position=position + noise), position


def searched(kuka: Robot, rows: Measurements, *, remainder: bool) -> Discovery:
    """Return a discovery of which at most one name is accepted, so that something is left without one."""
    few = replace(POLICY, most_steps=1)
    return run_discovery(kuka, rows, Options(effects=ELASTIC, moment_frame="after"), policy=few, remainder=remainder)


@pytest.fixture(scope="module")
def found(kuka: Robot) -> Discovery:
    """Return a discovery with a remainder."""
    return searched(kuka, table(kuka, 1.5e-4, 300, 7)[0], remainder=True)


@pytest.mark.long
def test_a_smooth_error_of_all_joints_is_predicted(kuka: Robot, found: Discovery) -> None:
    """At poses that were not measured the error is a quarter less than without; regions left out are predicted better."""
    rows, true = table(kuka, 1.5e-4, 200, 11)
    plain = searched(kuka, table(kuka, 1.5e-4, 300, 7)[0], remainder=False)
    at = found.calibration.fit.readings(rows).conditions
    errors = [np.mean(np.linalg.norm(of.calibration.fit.predict(at)[:, :, 3] - true, axis=1)) for of in (plain, found)]
    gaps = [of.report["gap"]["after"]["mean_mm"] for of in (plain, found)]

    assert found.findings.remainder and plain.findings.remainder is None
    assert errors[1] < 0.75 * errors[0]
    assert gaps[1] < gaps[0]
    # Neither names nor verdict depend on it.
    assert [e.effect for e in found.findings.effects] == [e.effect for e in plain.findings.effects]
    assert found.findings.verdict == plain.findings.verdict


def displaced(kuka: Robot, poses: int, seed: int) -> tuple[Measurements, np.ndarray]:
    """Return rows of a KUKA whose target is displaced by .25 mm as functions of three pairs of joints, and its positions."""
    machine = true_kuka().draw_errors(np.random.default_rng(5), sigma_length=1e-3, sigma_angle=1e-3)
    q = sim.plan_poses(machine.nominal, poses, np.random.default_rng(seed))
    read = sim.Instrument(targets={"ball": (0.1, 0.0, 0.1)}).measure(machine, q, rng=np.random.default_rng(seed))
    position = np.column_stack([read[axis] for axis in "xyz"])
    rng = np.random.default_rng(99)
    for pair in ((0, 1), (0, 4), (1, 4)):
        for k, _ in itertools.product(range(3), range(6)):
            wave = q[:, pair] @ rng.standard_normal(2) / 1.2 + rng.uniform(0.0, 2.0 * np.pi)
            position[:, k] += 7e-5 * np.sin(wave)
    noise = SIGMA * np.random.default_rng(seed + 1).standard_normal(position.shape)
    return measurements_from_arrays(kuka.joint_names, q, position=position + noise), position


@pytest.mark.long
def test_a_displacement_that_is_of_no_drive_is_predicted(kuka: Robot) -> None:
    """A smooth displacement of the target enters as such, and errors at poses that were not measured are a quarter less."""
    rows, _ = displaced(kuka, 300, 7)
    others, true = displaced(kuka, 200, 11)
    found = searched(kuka, rows, remainder=True)
    # The fit before the remainder entered is that of a discovery without.
    fits = FittedRobot.of(found.trail.changes[-2].fit), found.calibration.fit
    errors = [np.mean(np.linalg.norm(of.predict(of.readings(others).conditions)[:, :, 3] - true, axis=1)) for of in fits]

    assert found.findings.remainder is not None
    assert "base" in {part.errs for part in found.findings.remainder.parts}
    assert errors[1] < 0.75 * errors[0]


def test_no_region_is_worse_than_by_calibration(found: Discovery) -> None:
    """Of regions left out none is predicted worse than by geometry and elasticity, which is what `calibrate` fits."""
    smooth = found.findings.remainder
    assert smooth is not None
    regions = smooth.regions

    assert smooth.smooth_mm < smooth.named_mm
    assert all(of.smooth_mm <= of.calibrated_mm + 1e-9 for of in regions)
    assert min(of.rows for of in regions) >= REMAINDER.region
    assert sum(of.rows for of in regions) == np.count_nonzero(found.trail.final.solution.weights)


def test_a_region_that_is_worse_refuses_it() -> None:
    """A remainder that gains on average but makes one region worse than calibrated does not enter, however little it is."""
    rows = np.full(10, 30)
    plain = np.full(10, 0.3)
    after = plain - np.linspace(0.04, 0.06, 10)
    worse = after.copy()
    worse[3] = 0.3001
    # Where the names are worse, what enters makes it good.
    named = plain.copy()
    named[3] = 0.32

    assert LeftOutRegions(rows, plain, plain, after).predicts
    assert LeftOutRegions(rows, plain, plain, after).is_nowhere_worse
    assert LeftOutRegions(rows, plain, plain, worse).predicts
    assert not LeftOutRegions(rows, plain, plain, worse).is_nowhere_worse
    assert not LeftOutRegions(rows, plain, named, worse).is_nowhere_worse
    assert LeftOutRegions(rows, plain, named, after).is_nowhere_worse
    assert not LeftOutRegions(rows, plain, plain, plain).predicts


@pytest.mark.long
def test_one_with_less_freedom_is_tried(kuka: Robot, found: Discovery, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the likeliest remainders make a region worse, the best of them is tried with half of its sizes."""
    (likeliest,) = found.trail.changes[-1].entered
    refused = itertools.chain(itertools.repeat(False, REMAINDER.tried), itertools.repeat(True))
    monkeypatch.setattr(LeftOutRegions, "is_nowhere_worse", property(lambda _: next(refused)))
    plain = replace(found.trail, fit=found.trail.changes[-2].fit, changes=found.trail.changes[:-1])
    _, rest = with_remainder(plain)

    assert rest is not None and isinstance(likeliest, SmoothRemainder)
    assert rest.effects == (replace(likeliest, size=REMAINDER.narrower[0] * likeliest.size),)


def test_regions_of_few_rows_are_joined_to_the_nearest(rng: np.random.Generator) -> None:
    """A region of three rows is one with its neighbour; larger ones stay, and one that is alone stays alone."""
    centres = np.array([[0.0, 0.0], [0.1, 0.0], [5.0, 5.0]])
    region = np.repeat([0, 1, 2], [3, 20, 10])
    q = centres[region] + 0.01 * rng.standard_normal((len(region), 2))

    np.testing.assert_array_equal(joined_regions(q, region, 10), np.repeat([1, 2], [23, 10]))
    np.testing.assert_array_equal(joined_regions(q, region, 3), region)
    np.testing.assert_array_equal(joined_regions(q[:3], region[:3], 10), region[:3])


def test_it_is_told_apart_from_names(found: Discovery, tmp_path: Path) -> None:
    """It is no effect of the findings; a note, a stage of the search, the report and discovery.json say that it is there."""
    (note,) = (note.text for note in found.calibration.notes if note.text.startswith("unnamed, smooth"))
    smooth = found.report["remainder"]
    section = found_section(found).blocks
    page = " ".join(map(str, section))

    assert "says nothing of causes" in note
    assert "smooth_remainder" not in {entry["effect"] for entry in found.report["effects"]}
    assert found.gaps[-1].name == "+ unnamed, smooth (drives)"
    assert smooth["parts"][0]["errs"] == "drive" and 0.0 < smooth["parts"][0]["size"] < 3e-4
    assert "Unnamed, smooth" in page and f"{smooth['smooth_mm']:.4f} mm" in page
    assert f"{smooth['smooth_mm']:.4f} mm" in smooth_words(found.findings.remainder)


def test_the_summary_says_that_a_model_has_it(found: Discovery) -> None:
    """In every length, as errors of the model are with it; and it is not "no missing effect" where nothing has a name."""
    unnamed = cast(Discovery, SimpleNamespace(findings=msgspec.structs.replace(found.findings, effects=())))
    none = cast(Discovery, SimpleNamespace(findings=msgspec.structs.replace(found.findings, effects=(), remainder=None)))

    assert all(words.endswith("; and a smooth remainder without a name") for words in summary_of_search(found))
    assert summary_of_search(unnamed) == ("these data show no effect with a name; and a smooth remainder without a name",)
    assert summary_of_search(none) == ("these data show no missing effect",)


def test_its_intervals_cover(kuka: Robot, found: Discovery) -> None:
    """At poses that were not measured, as often as they say or more."""
    rows, true = table(kuka, 1.5e-4, 200, 13)
    at = found.calibration.fit.readings(rows).conditions
    error = found.calibration.fit.predict(at)[:, :, 3] - true

    assert np.mean(np.abs(error) < 1.96 * found.calibration.fit.position_sigma(at)) > 0.9


@pytest.mark.long
def test_exports_have_its_uncertainty(
    found: Discovery, tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """C and NumPy state the model's u, though a load bends the arm otherwise where parameters nobody sees apart differ."""
    calibrated = found.calibration.fit
    share_formulas(calibrated, monkeypatch)
    at = replace(poses_of(calibrated, 200, rng), payload_centre=calibrated.payload_centre)
    expected = calibrated.position_sigma(at)
    source = loaded(export_model(calibrated, "python").text)
    sigma, _ = Compiled.of(calibrated, tmp_path, "instrument", optimised=False).uncertainty(at)
    formulas = formulas_of(calibrated)
    own = loaded(numpy_source(formulas, frame="instrument"))

    np.testing.assert_allclose(source["uncertainty"](at.q, **columns_of(at)), expected, rtol=0.03)
    np.testing.assert_allclose(sigma, expected, rtol=0.03)
    assert np.abs(own["uncertainty"](at.q, **columns_of(at)) / expected - 1.0).max() > 0.08


def test_a_model_file_keeps_it(found: Discovery, tmp_path: Path, rng: np.random.Generator) -> None:
    """The same predictions from a file of less than 300 kB."""
    found.calibration.fit.save(tmp_path / "model.json")
    again = load_model(tmp_path / "model.json")
    q = rng.uniform(-1.0, 1.0, (20, 6))

    assert "smooth_remainder" in (tmp_path / "model.json").read_text()
    assert (tmp_path / "model.json").stat().st_size < 300_000
    np.testing.assert_allclose(again.predict(q), found.calibration.fit.predict(q), atol=1e-12)
    sigmas = [of.position_sigma(Conditions.at(q)) for of in (again, found.calibration.fit)]
    np.testing.assert_allclose(*sigmas, rtol=1e-6)


@pytest.mark.long
def test_noise_has_no_remainder(kuka: Robot) -> None:
    """Of a table that the model describes nothing enters, with the noise declared or not."""
    rows = table(kuka, 0.0, 200, 17)[0]
    sound = searched(kuka, rows, remainder=True)
    fit = sound.trail.final

    assert sound.findings.remainder is None and not likely_remainders(fit)
    assert with_remainder(sound.trail) == (sound.trail, None)


@pytest.mark.long
def test_of_many_rows_some_are_judged_first(found: Discovery, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 300 rows 200 are judged, and what passes is fitted to all and judged by all regions, as if they were few."""
    monkeypatch.setattr("pincal.discover.smooth_rest.REMAINDER", replace(REMAINDER, judged=200))
    plain = replace(found.trail, fit=found.trail.changes[-2].fit, changes=found.trail.changes[:-1])
    trail, rest = with_remainder(plain)

    assert rest is not None and rest.regions.is_nowhere_worse and rest.regions.predicts
    assert sum(rest.regions.rows) == np.count_nonzero(plain.final.solution.weights)
    assert len(trail.final.problem) == len(plain.final.problem) == 300
    assert {effect.moves for effect in rest.effects} == {"drive"}


def test_few_poses_have_none(found: Discovery, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of fewer than four regions of ten rows nothing is fitted, whatever they would show."""
    fit = found.trail.changes[-2].fit
    some = fit.select(np.arange(REMAINDER.regions * REMAINDER.region - 1))
    asked = list[object]()
    monkeypatch.setattr("pincal.discover.smooth_rest.likely_remainders", lambda fit: asked.append(fit) or [])
    for of in (some, fit):
        trail = replace(found.trail, fit=of, changes=found.trail.changes[:-1])
        assert with_remainder(trail) == (trail, None)

    assert len(asked) == 1


def test_waves_are_a_process_of_the_stated_length(kuka: Robot) -> None:
    """Of many waves the covariance of two poses is that of sums over pairs, by its closed form."""
    effect = SmoothRemainder(("joint_1", "joint_2", "joint_3"), 2, 0.8, 1e-4, 30000)
    q = np.zeros((2, 6))
    q[1, :3] = [0.3, -0.5, 0.9]
    basis = effect.waves(Chain.of(kuka), Conditions.at(q))
    expected = [np.exp(-0.5 * sum(q[1, list(pair)] ** 2) / 0.8**2) for pair in itertools.combinations(range(3), 2)]

    assert (basis.T @ basis / effect.count)[0, 1] == pytest.approx(np.mean(expected), abs=0.01)
    assert golden_ratio(2) ** 3 == pytest.approx(golden_ratio(2) + 1.0)


def test_sums_of_waves_have_the_prior_of_their_waves(kuka: Robot) -> None:
    """Whatever the norm of the rows of its modes, an error has the same variance at a pose as by single waves."""
    chain = Chain.of(kuka)
    at = Conditions.at(np.array([[0.3, -0.5, 0.9, 0.2, 0.1, 0.7]]))
    single = SmoothRemainder(("joint_1", "joint_2", "joint_3"), 2, 0.8, 1e-4, 3)
    turned = 0.3 * np.linalg.qr(np.random.default_rng(0).standard_normal((6, 6)))[0]
    mixed = replace(single, places=("joint_2",), modes=(tuple(map(tuple, turned.tolist())),))

    def variance(effect: SmoothRemainder) -> float:
        sizes = [p.size for p in effect.parameters(chain) if p.name.startswith("joint_2.")]
        basis = effect.errors(chain, at)[effect.erring.index("joint_2")]
        return float(np.square(sizes) @ basis[:, 0] ** 2)

    assert variance(mixed) == pytest.approx(variance(single), rel=1e-12)


def test_a_displacement_has_the_axes_of_the_base(kuka: Robot, rng: np.random.Generator) -> None:
    """Turned with the instrument's frame, in which the base stands, the target is displaced alike."""
    effect = SmoothRemainder(("joint_1", "joint_2"), 2, 0.8, 1e-4, 3, moves="base")
    q = rng.uniform(-1.0, 1.0, (5, 6))
    turn = np.array([[0.0, -1.0, 0.0], [0.6, 0.0, -0.8], [0.8, 0.0, 0.6]])
    upright = Chain.of(kuka)
    values = 1e-3 * rng.standard_normal(18)

    def displacement(chain: Chain) -> np.ndarray:
        model = Model(chain, (effect,))
        return (model.predict(values, Conditions.at(q)) - model.predict(0.0 * values, Conditions.at(q)))[:, :, 3]

    turned = displacement(upright.with_references(turn, upright.tool_rotations))
    np.testing.assert_allclose(turned, displacement(upright) @ turn.T, atol=1e-15)
    assert np.abs(turned).max() > 1e-4


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"length": 0.0}, "expected more than 0"),
        ({"together": 4}, "expected 1 to 3"),
        ({"moves": "base", "places": ("joint_1",)}, "expected of x, y, z"),
        ({"modes": (((1.0,),),)}, "expected 3 places and 6 waves"),
    ],
)
def test_what_is_none_is_refused(change: dict[str, Any], words: str) -> None:
    """Values that describe no remainder are refused with what is expected."""
    with pytest.raises(BadInputError, match=words):
        replace(SmoothRemainder(("joint_1", "joint_2", "joint_3"), 2, 0.8, 1e-4, 3), **change)


def parts(*, modes: bool) -> tuple[SmoothRemainder, SmoothRemainder]:
    """Return errors of two drives and displacements along the base's axes, in sums of waves or in single ones."""
    joints = ("joint_1", "joint_2", "joint_3", "joint_5")
    drives = SmoothRemainder(joints, 2, 0.8, 1e-4, 6, places=("joint_2", "joint_5"))
    base = SmoothRemainder(joints, 2, 1.2, 1e-4, 6, moves="base")
    if not modes:
        return drives, base
    turned = np.round(0.3 * np.linalg.qr(np.random.default_rng(3).standard_normal((12, 12)))[0], 4).tolist()
    some = tuple(map(tuple, turned[:5]))
    return replace(drives, modes=(some, some[:2])), replace(base, modes=(some[:3], some[2:], some[:1]))


def uneven(kuka: Robot, *effects: Effect) -> FittedRobot:
    """Return a calibrated elastic arm with these effects, of values of some tenths of a millimetre."""
    rng = np.random.default_rng(4)
    model = Model(Chain.of(kuka, moment_frame="after"), (BaseFrame(), ToolFrame(), *ELASTIC, *effects))
    units = units_of(model, conditions_of(kuka, 50, rng))
    return calibrated_of(model, 3e-4 * rng.uniform(-1.0, 1.0, model.n_parameters) / units)


@pytest.mark.parametrize(
    ("modes", "frame"),
    [
        (True, "base"),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in ((False, "instrument"), (False, "base"), (True, "instrument"))
        ),
    ],
)
def test_exports_have_it(kuka: Robot, modes: bool, frame: str, tmp_path: Path, rng: np.random.Generator) -> None:
    """C and NumPy agree with the model, forward and back, in the instrument's frame and in the base's."""
    calibrated = uneven(kuka, *parts(modes=modes))
    at = poses_of(calibrated, 200, rng)
    true = (in_base_frame(calibrated) if frame == "base" else calibrated).predict(at)
    source = loaded(export_model(calibrated, "python", frame=frame).text)
    compiled = Compiled.of(calibrated, tmp_path, frame)
    without = calibrated.with_effects(lambda effect: not isinstance(effect, SmoothRemainder))
    seed = replace(at, q=at.q + rng.normal(0.0, 2e-3, at.q.shape))
    q, status, _ = compiled.compensate(true, seed)
    arrived = (in_base_frame(calibrated) if frame == "base" else calibrated).predict(replace(at, q=q))

    np.testing.assert_allclose(source["forward"](at.q, **columns_of(at)), true, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(compiled.forward(at)[0], true, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(arrived[status == 0], true[status == 0], rtol=0.0, atol=2e-10)
    assert np.mean(status == 0) > 0.95
    assert np.abs(without.predict(at) - calibrated.predict(at))[:, :, 3].max() > 1e-4


@pytest.mark.long
def test_the_page_has_it(kuka: Robot, tmp_path: Path) -> None:
    """In JavaScript the robot is where the model says, and corrections reach their poses."""
    calibrated = uneven(kuka, *parts(modes=True))
    at = poses_of(calibrated, 100, np.random.default_rng(3))
    told = answered(
        export_model(calibrated, "page").text,
        f"const S = {page_states(at, kuka.own_joints)};"
        "return S.map((s) => [calibrated(s)[0], compensate(calibrated, nominal(s)[0], s)]);",
        tmp_path,
    )
    placed = in_base_frame(calibrated)
    ok = np.array([row[1]["status"] == "ok" for row in told])
    q = np.array([row[1]["q"] for row in told])
    arrived = placed.predict(replace(at, q=kuka.spread(q)))

    poses = np.array([row[0] for row in told]).reshape(-1, 3, 4)
    np.testing.assert_allclose(poses, placed.predict(at), rtol=0.0, atol=1e-12)
    assert ok.mean() > 0.9
    np.testing.assert_allclose(arrived[ok], program_poses(calibrated, at)[ok], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("kind", [0, 1])
def test_compensation_takes_it_away(kuka: Robot, kind: int, rng: np.random.Generator) -> None:
    """Joint positions that are corrected by a model with it reach the wanted poses; nominal ones are off by what it is."""
    effect = parts(modes=True)[kind]
    model = Model(Chain.of(kuka), (BaseFrame(), ToolFrame(), effect))
    values = np.zeros(model.n_parameters)
    values[-len(effect.parameters(model.chain)) :] = 2e-4
    calibrated = calibrated_of(model, values)
    at = poses_of(calibrated, 50, rng)
    wanted = program_poses(calibrated, at)
    found = compensate_program(calibrated, at)
    reached = found.is_ok
    there = in_base_frame(calibrated).predict(replace(at, q=found.q))

    assert np.mean(reached) > 0.9
    np.testing.assert_allclose(there[reached][:, :, 3], wanted[reached][:, :, 3], rtol=0.0, atol=1e-9)
    assert np.abs(in_base_frame(calibrated).predict(at) - wanted)[:, :, 3].max() > 5e-5


@pytest.mark.parametrize(
    ("words", "wanted"),
    [((), True), (("--remainder",), True), (("--no-remainder",), False), (("--set", "remainder=no"), False)],
)
def test_the_command_hands_the_choice_on(
    kuka: Robot, words: tuple[str, ...], wanted: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By default it may enter; --no-remainder, or --set remainder=no, leaves it out; words told again say the same."""
    asked = list[bool]()

    def searched(*_: Any, remainder: bool, **__: Any) -> None:
        asked.append(remainder)
        raise BadInputError("asked")

    monkeypatch.setattr("pincal.discover.run.run_discovery", searched)
    rows = table(kuka, 0.0, 30, 1)[0]
    columns = zip((*kuka.joint_names, *"xyz"), np.hstack([rows.q, rows.position]).T, strict=True)
    write_table(tmp_path / "rows.csv", dict(columns))
    option = next(of for of in VERBS["discover"].params if of.name == "remainder")

    assert run("discover", kuka_urdf_path(), tmp_path / "rows.csv", *words, "--out", tmp_path / "out", "--quiet") == 3
    assert asked == [wanted]
    assert list(_words_of(option, wanted)) == ["--remainder" if wanted else "--no-remainder"]
