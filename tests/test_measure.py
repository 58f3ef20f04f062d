"""``pincal measure``: from readings of a part to a result that one can sign."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import feature_cases as cases
import numpy as np
import pytest
from page_numbers import PageNumbers, disagreements, numbers_without_source
from scipy.stats import chi2

from pincal import BadInputError, schemas
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.model_statement import ModelStatement
from pincal.cli import main
from pincal.features.flange_sensor import FlangeSensor
from pincal.features.measured_file import MeasuredFile
from pincal.features.measured_page import measured_page, verdict_words
from pincal.features.measured_part import MeasuredPart, measure_part
from pincal.features.part import Part
from pincal.features.readings import FeatureReadings
from pincal.identity import Identity
from pincal.notes import doubts_of
from pincal.parameters import estimate_of
from pincal.validate.misfit import Verdict

RADIUS = 0.01
CENTRES = {"h1": (0.0, 0.0), "h2": (0.08, 0.0), "h3": (0.08, 0.06)}
PART = """
unit = "mm"
[datum]
kind = "best fit"
features = ["h1", "h2", "h3"]
[feature.h1]
kind = "circle"
nominal = [0, 0, 0]
direction = [0, 0, 1]
diameter = 20
tolerance = {{ position = {position}, diameter = {diameter} }}
[feature.h2]
kind = "circle"
nominal = [80, 0, 0]
direction = [0, 0, 1]
diameter = 20
[feature.h3]
kind = "circle"
nominal = [80, 60, 0]
direction = [0, 0, 1]
diameter = 20
[feature.pitch]
kind = "distance"
of = ["h1", "h2"]
nominal = 80
tolerance = {distance}
[feature.never_seen]
kind = "point"
nominal = [0, 0, 0]
"""


def part_in(folder: Path, *, position: float = 1.0, diameter: float = 0.5, distance: float = 0.5) -> Path:
    """Write a part of three holes with these tolerances [mm]."""
    path = folder / "part.toml"
    path.write_text(PART.format(position=position, diameter=diameter, distance=distance))
    return path


def rims(panel: np.ndarray, *, wider: float = 0.0, n: int = 8) -> tuple[np.ndarray, list[str]]:
    """Return points of the rims of the holes of a panel at a pose, shape (3n, 3), and their features."""
    angle = 2.0 * np.pi * np.arange(n) / n
    places, names = [], []
    for name, (x, y) in CENTRES.items():
        radius = RADIUS + (wider if name == "h1" else 0.0)
        places.append(np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle), 0.0 * angle]))
        names += [name] * n
    return np.vstack(places) @ panel[:, :3].T + panel[:, 3], names


def seen_panel(
    truth: FittedRobot, rng: np.random.Generator, *, noise: float = 0.0, passes: int = 1, wider: float = 0.0
) -> FeatureReadings:
    """Return what a 3D sensor of a robot reads of the panel, each hole from two poses in each pass."""
    fixed = np.random.default_rng(11)
    q = cases.poses_near(fixed, 6, 0.15)
    panel = np.column_stack([np.linalg.qr(fixed.normal(size=(3, 3)))[0], cases.ahead(truth, q)])
    panel[:, 2] *= np.sign(np.linalg.det(panel[:, :3]))
    places, names = rims(panel, wider=wider)
    row = np.repeat(np.arange(6), 4)
    place = places.reshape(3, 8, 3).reshape(24, 3)
    exact = np.tile(cases.seen_by(truth, q[row], place), (passes, 1))
    return cases.table(
        np.tile(q[row], (passes, 1)),
        names * passes,
        camera_point=exact + noise * rng.standard_normal(exact.shape),
        pass_name=np.repeat(np.arange(passes), 24).astype(str),
    )


@pytest.fixture(scope="module")
def camera() -> FittedRobot:
    """Return a robot that was calibrated with a 3D camera."""
    return cases.robot_with("camera_point", size=3e-5)


def measured(robot: FittedRobot, readings: FeatureReadings, folder: Path, **tolerances: float) -> MeasuredPart:
    """Return the measured part."""
    return measure_part(robot, readings, Part.from_toml(part_in(folder, **tolerances)))


def test_a_perfect_part_is_found_perfect(camera: FittedRobot, rng: np.random.Generator, tmp_path: Path) -> None:
    """Readings without noise by the calibrated robot itself: no deviations, whatever the pose of the part."""
    found = measured(camera, seen_panel(camera, rng), tmp_path).found
    of = {(f.name, name): v for f in found.features for name, v in f.values.items()}
    assert abs(of["h1", "diameter"].value - 20.0) < 1e-6
    assert abs(of["pitch", "distance"].deviation) < 1e-6
    assert abs(of["h3", "y"].deviation) < 1e-6 and of["h3", "y"].nominal == 60.0
    assert [value.decision for _, _, value in found.decided()] == ["conforms"] * 3
    assert verdict_words(found) == "The part conforms: all of 3 values."
    assert any("never_seen" in note.text for note in found.warnings)
    h1 = found.features[0]
    assert (h1.readings, h1.stops, h1.form_mm < 1e-6) == (8, 2, True)


def test_the_budget_is_the_covariance(camera: FittedRobot, rng: np.random.Generator, tmp_path: Path) -> None:
    """The sources of each quantity add up to its u, shares to 1, and the matrix has the squares on its diagonal."""
    found = measured(camera, seen_panel(camera, rng, noise=5e-5), tmp_path).found
    diagonal = np.diag(found.covariance.matrix)
    for name, square in zip(found.covariance.names, diagonal, strict=True):
        feature, quantity = name.split(".")
        value = next(f for f in found.features if f.name == feature).values[quantity]
        np.testing.assert_allclose(value.u**2, square, rtol=1e-9)
        np.testing.assert_allclose(value.u**2, sum(u**2 for u in value.by_source.values()), rtol=1e-9)
        np.testing.assert_allclose(value.U, value.k * value.u, rtol=1e-12)
    assert {of.source for of in found.budget} >= {"parameters", "sensor"}
    np.testing.assert_allclose(sum(of.share for of in found.budget), 1.0)
    assert all(of.distribution == ("normal" if of.dof is None else "t") for of in found.budget)
    # A circle of n points at equal angles, each with the noise of a coordinate: u(diameter) = 2 sigma / sqrt(n).
    sensor = found.features[0].values["diameter"].by_source["sensor"]
    np.testing.assert_allclose(sensor, 2.0 * 0.05 / np.sqrt(8), rtol=1e-3)


@pytest.mark.long
def test_the_whole_chain_has_the_spread_that_it_states(rng: np.random.Generator, tmp_path: Path) -> None:
    """Monte Carlo of robots and noise (JCGM 101): errors of all quantities follow the stated covariance."""
    robot = cases.robot_with("camera_point", size=1e-4)
    part = Part.from_toml(part_in(tmp_path))
    root = np.linalg.cholesky(robot.covariance + 1e-18 * np.eye(len(robot.values)))
    total, draws = 0.0, 40
    for _ in range(draws):
        truth = robot
        for k, step in enumerate(root @ rng.standard_normal(len(robot.values))):
            truth = cases.changed(truth, k, step)
        found = measure_part(robot, seen_panel(truth, rng, noise=5e-5), part).found
        chosen = [i for i, name in enumerate(found.covariance.names) if name.endswith((".diameter", ".distance"))]
        values = {f"{f.name}.{name}": v for f in found.features for name, v in f.values.items()}
        error = np.array([values[found.covariance.names[i]].deviation for i in chosen])
        total += error @ np.linalg.solve(np.array(found.covariance.matrix)[np.ix_(chosen, chosen)], error)
    assert 0.001 < chi2.sf(total, draws * len(chosen)) < 0.999


def test_a_hole_that_is_too_wide_does_not_conform(camera: FittedRobot, rng: np.random.Generator, tmp_path: Path) -> None:
    """0.6 mm beyond a tolerance of 0.5 mm is no; at the limit it is undecided, by a U of some hundredths."""
    wide = measured(camera, seen_panel(camera, rng, wider=3e-4, noise=1e-5), tmp_path).found
    assert wide.features[0].values["diameter"].decision == "does not conform"
    assert "does not conform: 1 of 3 values (h1 diameter)" in verdict_words(wide)
    edge = measured(camera, seen_panel(camera, rng, wider=2.5e-4), tmp_path).found
    assert edge.features[0].values["diameter"].decision == "undecided"
    assert verdict_words(edge).startswith("Undecided: 1 of 3 values lies too near to a limit for its uncertainty; the")


def test_every_number_of_the_page_is_in_its_file(camera: FittedRobot, rng: np.random.Generator, tmp_path: Path) -> None:
    """To the digits that are shown, and each table has pointers; a wrong digit is noticed."""
    readings = seen_panel(camera, rng, noise=5e-5, passes=4)
    two = np.where(np.isin(readings.pass_name, ("0", "1")), "ann", "bob")
    found = measured(camera, replace(readings, appraiser=two), tmp_path).found
    text = measured_page(found, robot="r", version="0")
    files = {"measured.json": json.loads(json.dumps(found.report))}
    page = PageNumbers(text)
    said = f"{json.dumps(files)} ISO 14253-1 95.45 4.5 {verdict_words(found)}"
    assert [*disagreements(page, files)] == []
    assert numbers_without_source(page, said) == []
    for part in ("/values/", "/budget/", "/repeatability/", "/form_mm", "/gauge/"):
        assert any(part in pointer for of in page.shown for pointer in of.pointers), part
    value = f"{found.features[0].values['diameter'].value:.4f}"
    wrong = PageNumbers(text.replace(f">{value}<", f">{float(value) + 1e-4:.4f}<", 1))
    assert len([*disagreements(wrong, files)]) == 1


def test_passes_give_the_repeatability(camera: FittedRobot, rng: np.random.Generator, tmp_path: Path) -> None:
    """The spread of passes is that of the noise: 0.05 mm a coordinate makes 2 sigma / sqrt(8) of a diameter."""
    found = measured(camera, seen_panel(camera, rng, noise=5e-5, passes=12), tmp_path).found
    repeats = {of.quantity: of for of in found.features[0].repeatability}
    assert repeats["diameter"].passes == 12
    low, high = repeats["diameter"].s_interval
    assert low < 2.0 * 0.05 / np.sqrt(8) < high
    assert found.features[0].readings == 8 * 12


def test_a_pass_that_was_cut_off_counts_in_the_whole_alone(
    camera: FittedRobot, rng: np.random.Generator, tmp_path: Path
) -> None:
    """Its readings are used, it is no repetition of its own, and a note says why."""
    readings = seen_panel(camera, rng, noise=5e-5, passes=3).select(np.arange(60))
    found = measured(camera, readings, tmp_path).found
    assert [of.readings for of in found.features[:3]] == [24, 20, 16]
    assert found.features[0].repeatability[0].passes == 2
    assert any("pass 3 is no repetition of its own" in note.text for note in found.warnings)


@pytest.mark.parametrize(
    ("names", "words"),
    [(["h1", "h9"], r"line 3: feature 'h9' is not in the part's file.*h1"), (["h1", "pitch"], "not measured itself")],
)
def test_readings_of_unknown_features_are_refused(
    camera: FittedRobot, rng: np.random.Generator, tmp_path: Path, names: list[str], words: str
) -> None:
    """The line, the name, and those that there are."""
    readings = cases.table(cases.poses_near(rng, 2), names, camera_point=np.tile([0.0, 0.0, 0.4], (2, 1)))
    with pytest.raises(BadInputError, match=words):
        measured(camera, readings, tmp_path)


def test_too_few_readings_and_nameless_images_are_refused(
    camera: FittedRobot, rng: np.random.Generator, tmp_path: Path
) -> None:
    """Two points are no circle; images of a circle without names of points can't be matched."""
    readings = seen_panel(camera, rng).select(np.arange(2))
    with pytest.raises(BadInputError, match=r"'h1' \(circle\): 2 points; expected 3 or more"):
        measured(camera, readings, tmp_path)
    pixel = np.tile([640.0, 512.0], (2, 1))
    images = cases.table(cases.poses_near(rng, 2), ["h1", "h1"], pixel=pixel)
    sensor = FlangeSensor(lens=cases.LENS, pixel_noise=0.1)
    with pytest.raises(BadInputError, match="images of 'h1', a circle, without a column point"):
        measure_part(camera, images, Part.from_toml(part_in(tmp_path)), sensor=sensor)


@pytest.mark.parametrize(
    ("declared", "words"),
    [
        (FlangeSensor(pixel_noise=0.1), "declared in pixels, but it reads no images"),
        (FlangeSensor(radius=1e-3), "a probe with a ball is declared"),
    ],
)
def test_what_is_declared_of_another_sensor_is_refused(
    camera: FittedRobot, rng: np.random.Generator, tmp_path: Path, declared: FlangeSensor, words: str
) -> None:
    """Noise in pixels of a 3D sensor, or its ball, would be ignored or wrong."""
    with pytest.raises(BadInputError, match=words):
        measure_part(camera, seen_panel(camera, rng), Part.from_toml(part_in(tmp_path)), sensor=declared)


def test_a_probe_measures_a_bore(rng: np.random.Generator, tmp_path: Path) -> None:
    """Contacts of a calibrated ball with a bore: the diameter is that of the bore, and unknown noise is noted."""
    robot = cases.robot_with("position")
    q = cases.poses_near(rng, 1)
    pose = robot.predict(q)[0]
    part = tmp_path / "part.toml"
    part.write_text('[feature.bore]\nkind = "circle"\ndiameter_mm = 20\nlimits = { diameter_mm = [19.9, 20.1] }\n')
    angle = 2.0 * np.pi * np.arange(6) / 6
    rim = pose[:, 3] + 0.009 * (np.cos(angle)[:, None] * pose[:, 0] + np.sin(angle)[:, None] * pose[:, 1])
    held = np.array([cases.reaching(robot, q[0], place) for place in rim])
    readings = cases.table(held, ["bore"] * 6)
    found = measure_part(robot, readings, Part.from_toml(part), sensor=FlangeSensor(radius=1e-3)).found
    diameter = found.features[0].values["diameter"]
    assert abs(diameter.value - 20.0) < 1e-4 and diameter.decision == "conforms"
    assert any("no noise of a contact is declared" in note.text for note in found.warnings)


def write_readings(path: Path, readings: FeatureReadings) -> None:
    """Write readings of a 3D sensor as a table."""
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow([*readings.rows.joint_names, "feature", "cx", "cy", "cz"])
        for q, name, seen in zip(readings.rows.q, readings.feature, readings.seen, strict=True):
            out.writerow([*q.tolist(), name, *seen.tolist()])


EXPANSION = """
[expansion]
coefficient_um_per_m_K = 20
u_coefficient_um_per_m_K = 2
temperature_C = 70
u_temperature_K = 3
"""


def test_lengths_are_stated_at_20_degrees(camera: FittedRobot, rng: np.random.Generator, tmp_path: Path) -> None:
    """A part 1000 um/m larger: its pitch of 80 mm is 80 um shorter, with the uncertainty of JCGM 100."""
    readings = seen_panel(camera, rng)
    path = part_in(tmp_path)
    sensor = FlangeSensor(noise=np.full(3, 1e-5))
    warm = measure_part(camera, readings, Part.from_toml(path), sensor=sensor).found
    path.write_text(path.read_text() + EXPANSION)
    found = measure_part(camera, readings, Part.from_toml(path), sensor=sensor).found
    before, after = (next(of for of in one.features if of.name == "pitch").values["distance"] for one in (warm, found))
    assert after.value == pytest.approx(before.value / 1.001, abs=1e-6)
    # 20e-6 * 3 and 50 * 2e-6 per length of 80 mm.
    u = 80.0 * np.hypot(6e-5, 1e-4)
    assert after.by_source["expansion"] == pytest.approx(u, rel=2e-3)
    assert after.u**2 == pytest.approx(before.u**2 + u**2, rel=1e-2)
    assert any(line.source == "expansion" and line.type == "B" for line in found.budget)
    assert any("lengths are stated at 20 deg C" in note.text for note in found.warnings)


def test_what_the_calibration_leaves_open_is_no_fault_of_the_readings(rng: np.random.Generator, tmp_path: Path) -> None:
    """Contacts of a turning wrist with a probe whose place on the tool no pose of the calibration told."""
    robot = cases.robot_with("position")
    parameters = robot.estimate.parameters
    is_open = [p.element == "tool" for p in parameters]
    covariance = robot.covariance + np.diag(np.where(is_open, 4.0, 0.0))
    unknown = replace(robot, estimate=estimate_of(parameters, robot.values, covariance))
    turns = cases.poses_near(rng, 1) + np.linspace(0.0, 5.0, 8)[:, None] * np.eye(6)[5]
    readings = cases.table(turns, ["h1"] * 8)
    part = tmp_path / "part.toml"
    part.write_text('unit = "mm"\n[feature.h1]\nkind = "circle"\nnominal = [0, 0, 0]\ndirection = [0, 0, 1]\n')
    words = r"'h1' \(circle\): its readings would do, .*the target on the tool has a standard deviation of 2000 mm"

    assert measure_part(robot, readings, Part.from_toml(part)).found.features
    with pytest.raises(BadInputError, match=words):
        measure_part(unknown, readings, Part.from_toml(part))
    with pytest.raises(BadInputError, match="4 points are in one line"):
        measure_part(robot, cases.table(turns[[0, 0, 0, 0]], ["h1"] * 4), Part.from_toml(part))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("expansion = 3", "expected a table"),
        ("[expansion]\ncoefficient = 11.5", "unknown key 'coefficient'; expected one of coefficient_um_per_m_K"),
        ("[expansion]\ncoefficient_um_per_m_K = 11.5", "no temperature_C; expected a number"),
        ("[expansion]\ncoefficient_um_per_m_K = 'steel'", "coefficient_um_per_m_K = 'steel'"),
        ("[expansion]\ncoefficient_um_per_m_K = 11.5\ntemperature_C = nan", "temperature_C = nan"),
        ("[expansion]\ncoefficient_um_per_m_K = 11.5\ntemperature_C = 20\nu_temperature_K = -1", "u_temperature_K = -1"),
    ],
)
def test_an_expansion_that_is_none_is_refused(wrong: str, words: str, tmp_path: Path) -> None:
    """With the key, and what was expected."""
    path = tmp_path / "part.toml"
    path.write_text(f'unit = "mm"\n{wrong}\n[feature.a]\nkind = "point"\n')
    with pytest.raises(BadInputError, match=words):
        Part.from_toml(path)


def test_operators_of_a_table_give_gauge_studies(
    camera: FittedRobot, rng: np.random.Generator, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two operators with two passes each, whose passes are numbered alike; the page and the file have the analysis."""
    camera.save(tmp_path / "model.json", provenance={})
    readings = seen_panel(camera, rng, noise=1e-5, passes=4)
    write_readings(tmp_path / "plain.csv", readings)
    head, *lines = (tmp_path / "plain.csv").read_text().splitlines()
    named = [f"{line},{'AB'[k // 48]},{1 + k // 24 % 2}" for k, line in enumerate(lines)]
    (tmp_path / "readings.csv").write_text("\n".join([f"{head},operator,pass", *named]))
    words = ["measure", str(tmp_path / "model.json"), str(tmp_path / "readings.csv"), "--features", str(part_in(tmp_path))]
    with pytest.raises(SystemExit):
        main([*words, "--out", str(tmp_path / "out")])
    assert "Gauge repeatability and reproducibility" in capsys.readouterr().out
    found = json.loads((tmp_path / "out" / "measured.json").read_text())
    by_quantity = {of["quantity"]: of for of in found["gauge"]}
    diameter = by_quantity["diameter"]
    assert (diameter["parts"], diameter["appraisers"], diameter["repeats"]) == (3, 2, 2)
    assert 0.0 < diameter["ev"] < 0.03 and diameter["grr"] == pytest.approx(np.hypot(diameter["ev"], diameter["av"]))
    assert "reproducibility" in (tmp_path / "out" / "report.html").read_text()


def test_the_command_measures_a_part(
    camera: FittedRobot, rng: np.random.Generator, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The folder has file, table and page with one result; the exit code says that a tolerance is not met."""
    calibrated = Identity.of({"instrument": "AT960 7512", "date": "2026-01-31", "operator": "A. Smith"})
    replace(camera, identity=calibrated).save(tmp_path / "model.json", provenance={})
    write_readings(tmp_path / "readings.csv", seen_panel(camera, rng, wider=3e-4, noise=1e-5))
    part = part_in(tmp_path)
    words = ["measure", str(tmp_path / "model.json"), str(tmp_path / "readings.csv"), "--features", str(part)]
    with pytest.raises(SystemExit) as ended:
        main([*words, "--set", "id.robot=2021-17", "--set", "id.operator=B. Jones", "--out", str(tmp_path / "out")])
    printed = capsys.readouterr().out
    assert ended.value.code == 5
    assert "does not conform: 1 of 3 values (h1 diameter)" in printed and len(printed.splitlines()) < 15
    found = json.loads((tmp_path / "out" / "measured.json").read_text())
    assert found["id"] == {"robot": "2021-17", "instrument": "AT960 7512", "operator": "B. Jones"}
    assert found["features"][0]["values"]["diameter"]["decision"] == "does not conform"
    with (tmp_path / "out" / "measured.csv").open() as file:
        rows = list(csv.DictReader(file))
    with pytest.raises(SystemExit) as ended:
        main([*words, "--sensor-noise", "0.1px", "--out", str(tmp_path / "none")])
    assert ended.value.code == 3 and not (tmp_path / "none").exists()
    row = next(row for row in rows if (row["feature"], row["quantity"]) == ("h1", "diameter"))
    np.testing.assert_allclose(float(row["value"]), found["features"][0]["values"]["diameter"]["value"])
    page = (tmp_path / "out" / "report.html").read_text()
    assert "does not conform" in page and "2021-17" in page and "<script" not in page
    assert "24 readings" in page and "at most 1<" in page and "U: expanded uncertainty" in page


def test_a_doubt_of_the_calibration_is_one_of_the_part(
    camera: FittedRobot, rng: np.random.Generator, tmp_path: Path
) -> None:
    """It is said once, as a doubt, with the part measured nevertheless."""
    said = ModelStatement(verdict=Verdict.NOT_ADEQUATE, doubts=("the target was touched",))
    found = measured(replace(camera, statement=said), seen_panel(camera, rng), tmp_path).found
    doubts = [note.text for note in doubts_of(found.warnings)]
    assert doubts == ["the calibration of this model left a doubt: the target was touched"]
    sound = ModelStatement(verdict=Verdict.ADEQUATE, rests_on="declared noise")
    found = measured(replace(camera, statement=sound), seen_panel(camera, rng), tmp_path).found
    assert not doubts_of(found.warnings)


def test_the_structure_has_its_schema() -> None:
    """The file's structure is handed in by the satellite."""
    assert schemas.structure_of("measured") is MeasuredFile
