"""Stations of sessions in motion: an IMU and a tracker in a calibration, from arrays, in Python and on the command line."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run

import pincal
from pincal.builtin import kuka_urdf_path
from pincal.calibration.caveats import CaveatKind, findings_on_order, findings_on_scatter
from pincal.calibration.placing import place_station
from pincal.calibration.precheck import precheck
from pincal.calibration.result_tables import clock_words
from pincal.calibration.station_information import SharedInformation
from pincal.calibration.validation import validate_rows
from pincal.errors import BadInputError, Exit, MeasurementError
from pincal.identify import many_rows
from pincal.identify.fit import ModelFit
from pincal.identify.options import PriorScale
from pincal.identify.station import Station
from pincal.identify.whitening import Serial
from pincal.measure.measurements import concatenate
from pincal.measure.poses import by_pose
from pincal.motion.sessions import read_streams
from pincal.recorded import Moving
from pincal.sensors.pose import PositionSensor
from pincal.validate.gathered import bump_in, gathering_of

URDF = str(kuka_urdf_path())
ROBOT = pincal.Robot.from_urdf(kuka_urdf_path())
GEOMETRY = pincal.Options(effects=pincal.GEOMETRIC)
GEOMETRY_NAMES = {"joint_offset", "link_geometry", "axis_distortion"}
DRIVEN = ["--imu", "--sensor", "position", "--noise", "0.03mm", "--elastic", "0", "--clock-drift", "150", "--seed", "3"]


def simulated(folder: Path, *arguments: str) -> dict[str, Any]:
    """Drive a path; return the truth."""
    truth = folder.with_suffix(".json")
    assert run("simulate", URDF, "--path", "25s", "--out", folder, "--truth", truth, "--quiet", *DRIVEN, *arguments) == 0
    found: dict[str, Any] = json.loads(truth.read_text())
    return found


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a session, its truth beside it, and a table of eight held poses of the same machine."""
    folder = tmp_path_factory.mktemp("sessions") / "monday"
    simulated(folder, "--log-rates", "80,80,50")
    held = ["--poses", "8", "--noise", "0.03mm", "--elastic", "0", "--seed", "3"]
    assert run("simulate", URDF, *held, "--out", folder.parent / "eight.csv", "--quiet") == 0
    return folder


@pytest.fixture(scope="module")
def fit(day: Path) -> pincal.FittedRobot:
    """Return a calibration by both streams."""
    return pincal.calibrate(ROBOT, pincal.session_tables(ROBOT, [pincal.read_session(ROBOT, day)]), GEOMETRY)


def clock_of(fit: ModelFit, station: str, moving: Moving) -> tuple[float, float, float]:
    """Return offset, its standard deviation, and drift, of a station."""
    known = dict(zip(fit.estimate.names, zip(fit.values, fit.estimate.sigma, strict=True), strict=True))
    (offset, sigma), (drift, _) = known[f"{station}clock.offset"], known[f"{station}clock.drift"]
    return moving.clock[0] + offset, sigma, moving.clock[1] + drift


def sloped(station: Station, values: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the Jacobian of a station and that by differences, shape (P, m, N)."""
    whole = np.concatenate([J for _, _, J in station.linearise(values, free)], axis=2)
    found = []
    for k in range(len(values)):
        step = np.zeros(len(values))
        # Second differences of poses are rounded to 1e-8 m/s^2.
        step[k] = 1e-5 if station.parameters[k].symbol == "drift" else 3e-4
        found.append((station.residuals(values - step) - station.residuals(values + step)) / (2.0 * step[k]))
    return whole, np.array(found)


def test_jacobians_of_stations_in_motion_are_exact(fit: pincal.FittedRobot) -> None:
    """By geometry, base, mount, the clock and the sensor's own, against differences; and as normal equations have them."""
    for station, places, _ in fit.fit.stations:
        some, values = station.select(np.arange(5, len(station), len(station) // 7)), fit.values[places]
        exact, differences = sloped(some, values, free := np.ones(len(values), bool))
        size = np.abs(differences).max(axis=(1, 2), keepdims=True) + 1e-3 * np.abs(differences).max()
        np.testing.assert_allclose(exact / size, differences / size, rtol=0.0, atol=1e-3)
        ((_, _, shared),) = replace(some, serial=None).linearise_shared(values, free)
        columns, kept = shared.dense_columns()
        np.testing.assert_allclose(columns, exact[kept], rtol=1e-9, atol=1e-12 * np.abs(exact).max())


def test_clocks_are_found_with_everything_else(fit: pincal.FittedRobot, day: Path) -> None:
    """Each to its interval, the IMU's to a tenth of a millisecond or two, the tracker's to some microseconds."""
    truth, tables = json.loads(day.with_suffix(".json").read_text())["clocks"], fit.problem.stations
    session = pincal.session_tables(ROBOT, [pincal.read_session(ROBOT, day)])
    assert [station.name for station in tables] == [*session] == ["monday/imu", "monday/tracker"]
    for name, most in (("imu", 1e-3), ("tracker", 2e-5)):
        moving, at = session[f"monday/{name}"].moving, truth[name]
        assert moving is not None
        offset, sigma, drift = clock_of(fit.fit, f"monday/{name}/", moving)
        off = offset - at["offset"] - at["drift"] * (moving.middle - at["middle"])
        assert abs(off) < min(4.0 * sigma, most) and drift == pytest.approx(1.5e-4, abs=4e-5)


def test_noise_and_readings_are_what_was_put_in(fit: pincal.FittedRobot) -> None:
    """Nothing is left but the noise: of positions the declared one, of the IMU that of its densities in the window."""
    positions = fit.solution.estimated[2]
    assert positions == pytest.approx(3e-5, rel=0.1)
    # White noise in a Gaussian window of 30 ms: density times the root of 1 / (2 sqrt(pi) width), half for one side.
    assert fit.solution.estimated[1] > 1.7e-4 * np.sqrt(0.5 / (2.0 * np.sqrt(np.pi) * 0.03))


def test_what_follows_the_motion_is_no_change_of_the_setup(fit: pincal.FittedRobot) -> None:
    """Errors that persist along a path are what the model lacks; windows of an IMU overlap, which is no doubt."""
    imu, tracker = fit.problem.stations
    told = []
    for station in (imu, tracker, replace(tracker, conditions=replace(tracker.conditions, velocity=None))):
        m, n = int(station.block_sizes.sum()), len(station)
        serial = Serial(np.full(m, 0.9), np.full(m, 0.5), np.arange(n, dtype=float), np.ones(n, bool))
        told.append([found.kind for found in findings_on_order(replace(station, serial=serial))])
    assert told == [[], [CaveatKind.LEFT_IN_MOTION], [CaveatKind.DEPENDENT_ROWS]]


def test_what_follows_the_motion_tells_of_no_move(fit: pincal.FittedRobot) -> None:
    """Motions differ from session to session, and so does what a model lacks of them: such a station has no say."""
    imu, tracker = fit.problem.stations
    m, n = int(tracker.block_sizes.sum()), len(tracker)
    left = replace(tracker, serial=Serial(np.full(m, 0.9), np.full(m, 0.5), np.arange(n, dtype=float), np.ones(n, bool)))
    without, with_it = (
        SharedInformation.of(replace(fit.fit, problem=replace(fit.problem, stations=(imu, station)))).whole[1].any()
        for station in (left, tracker)
    )
    assert with_it and not without


def test_what_is_off_for_a_moment_is_no_place_of_a_joint(fit: pincal.FittedRobot) -> None:
    """A tenth of a second in which all readings are off lies in a narrow window of each joint; of held poses it is told."""
    _, tracker = fit.problem.stations
    values = fit.values[fit.problem.places[1]]
    rejected = np.zeros(len(tracker), bool)
    rejected[300:330] = True
    sensor = tracker.sensor
    assert isinstance(sensor, PositionSensor)
    off = replace(tracker, sensor=replace(sensor, position=sensor.position + 1e-3 * np.outer(rejected, [0.6, 0.0, 0.8])))
    held = replace(off, conditions=replace(off.conditions, inertial=None))

    assert gathering_of(off, rejected) is None and bump_in(off, values) is None
    assert gathering_of(held, rejected) is not None and bump_in(held, values) is not None


@pytest.mark.long
def test_a_clock_that_slips_has_a_step_with_its_uncertainty(day: Path, tmp_path: Path) -> None:
    """By less than the nominal arm could tell; what it is, is said, and the model is as good as without it."""
    session = pincal.read_session(ROBOT, day)
    assert session.tracker is not None
    slipped = session.tracker.time - 4e-3 * (np.arange(len(session.tracker)) >= 600)
    tables = pincal.session_tables(ROBOT, [replace(session, imu=None, tracker=replace(session.tracker, time=slipped))])
    found = pincal.run_calibration(ROBOT, tables, GEOMETRY, test_fraction=0.0)
    (clock,) = found.result.clocks
    (step,) = clock.steps

    assert step.at_s == pytest.approx(slipped[600], abs=0.1)
    assert step.size_s == pytest.approx(4e-3, abs=4.0 * step.size_sigma_s) and step.size_sigma_s < 2e-4
    assert found.fit.solution.estimated[0] == pytest.approx(3e-5, rel=0.1)
    assert "steps by +4" in " ".join(note.text for note in found.result.warnings)
    assert re.search(r"from 1\d\.\d* s on \+[34]\.\d* ± 0\.\d* ms", clock_words(clock))
    found.fit.save(tmp_path / "model.json")
    again = pincal.load_model(tmp_path / "model.json")
    assert "clock.step_1" in again.estimate.names


@pytest.mark.long
def test_a_clock_that_slips_on_another_day_is_no_change_of_the_robot(
    day: Path, fit: pincal.FittedRobot, tmp_path: Path
) -> None:
    """Neither for a validation nor for a diagnosis: the step is found as in a calibration, and said."""
    simulated(tmp_path / "later", "--log-rates", "80,80,50", "--pose-seed", "9", "--setup-seed", "9")
    session = pincal.read_session(ROBOT, tmp_path / "later")
    assert session.tracker is not None
    slipped = session.tracker.time - 4e-3 * (np.arange(len(session.tracker)) >= 600)
    tracker = replace(session.tracker, time=slipped)
    (whole,), (table,) = (
        pincal.session_tables(ROBOT, [replace(session, imu=None, tracker=of)]).values() for of in (session.tracker, tracker)
    )
    found, sound = (place_station(fit, of) for of in (table, whole))
    judged = validate_rows(fit.each, table)

    assert found.table.moving is not None and sound.table.moving is not None and not sound.table.moving.steps
    ((at, size),) = found.table.moving.steps
    assert at == pytest.approx(slipped[600], abs=0.1) and size == pytest.approx(4e-3, abs=2e-4)
    assert found.solution.estimated[0] == pytest.approx(sound.solution.estimated[0], rel=0.05)
    assert judged.misfit.ratio == pytest.approx(validate_rows(fit.each, whole).misfit.ratio, rel=0.05)
    assert any("steps by +4" in note.text for note in judged.notes) and not judged.doubt
    assert not pincal.diagnose(fit, table).changed


@pytest.mark.long
def test_joints_that_were_commanded_are_doubted_by_an_imu(day: Path, fit: pincal.FittedRobot) -> None:
    """They are ahead of those that moved, each by another time; what is left then is more than an IMU scatters."""
    session = pincal.read_session(ROBOT, day)
    time, q = session.joints.time, session.joints.readings["q"]
    ahead = q + np.linspace(0.01, 0.04, 6) * np.gradient(q, time, axis=0)
    moved = replace(session, tracker=None, joints=replace(session.joints, readings={"q": ahead}))
    (found,) = findings_on_scatter(pincal.calibrate(ROBOT, pincal.session_tables(ROBOT, [moved]), GEOMETRY).fit)

    assert re.search(r"angular rate are \d+ times .* commanded instead of measured", str(found))
    assert not list(findings_on_scatter(fit.fit))


def test_a_path_of_one_joint_is_asked_for_more(day: Path) -> None:
    """Rates about one axis tell no mount; what they seem to say of units and of other arms is not the reason."""
    session = pincal.read_session(ROBOT, day)
    assert session.imu is not None
    still = session.joints.readings["q"] * (np.arange(6) == 1)
    turned = np.zeros((len(session.imu), 3))
    turned[:, 1] = session.imu.readings["angular_rate"][:, 1]
    imu = replace(session.imu, readings={**session.imu.readings, "angular_rate": turned})
    one = replace(session, tracker=None, imu=imu, joints=replace(session.joints, readings={"q": still}))
    with pytest.raises(MeasurementError, match=f"joints that moved: {ROBOT.joint_names[1]}; expected a path on which all"):
        pincal.session_tables(ROBOT, [one])


@pytest.mark.long
def test_an_imu_alone_holds_lengths(day: Path, tmp_path: Path) -> None:
    """Lengths stay as in the URDF unless a prior is given; errors are of accelerations; a saved model is the same."""
    table = pincal.session_tables(ROBOT, [pincal.read_session(ROBOT, day)])["monday/imu"]
    found = pincal.calibrate(ROBOT, table, GEOMETRY)
    lengths = [k for k, p in enumerate(found.problem.parameters) if p.unit == "m" and p.effect != "tool_frame"]
    assert len(lengths) >= 12 and not found.values[lengths].any() and not found.solution.free[lengths].any()
    assert {"gear_eccentricity", "friction_windup", "joint_elasticity"} <= {effect.name for effect in found.model.effects}
    found.save(tmp_path / "model.json")
    q = table.q[:3]
    np.testing.assert_allclose(pincal.load_model(tmp_path / "model.json").predict(q), found.predict(q), atol=1e-12)

    freed = pincal.calibrate(ROBOT, table, pincal.Options(effects=pincal.GEOMETRIC, priors={"joint_2.a": "0.2mm"}))
    assert freed.values[freed.estimate.names.index("joint_2.a")] != 0.0


@pytest.mark.long
def test_few_positions_beside_an_imu_are_no_accuracy(day: Path) -> None:
    """Four are fitted exactly: of unknown noise their error would be 0.0000 mm; a declared noise is kept."""
    imu = pincal.session_tables(ROBOT, [pincal.read_session(ROBOT, day)])["monday/imu"]
    held = pincal.read_measurements(day.parent / "eight.csv", ROBOT.joint_names)
    tables = {"four": held.select(np.arange(4)), "monday/imu": imu}

    # Elasticity takes a search for what is exact along directions that the IMU's noise leaves open: it had no end.
    for look, options in ((pincal.calibrate, GEOMETRY), (precheck, GEOMETRY), (precheck, pincal.Options())):
        with pytest.raises(
            MeasurementError, match=r"^four: 4 rows of positions, .*declare the noise \(--noise\), or measure more"
        ):
            look(ROBOT, tables, options)
    found = pincal.calibrate(ROBOT, tables, replace(GEOMETRY, sigma=3e-5))
    assert found.at("four").sigma[0] == 3e-5


@pytest.mark.long
@pytest.mark.parametrize("seed", ["4", pytest.param("5", marks=pytest.mark.rates)])
def test_a_noisy_imu_alone_leaves_a_sound_robot_nearer_to_itself(tmp_path: Path, seed: str) -> None:
    """Thirty times the usual noise, and a robot as its URDF has it: the prior gets as narrow as the readings show."""
    arguments = ["--path", "100s", "--imu", "--imu-noise", "30mg,0.3deg/s", "--log-rates", "80,100,50", "--errors", "0"]
    assert run("simulate", URDF, *arguments, "--elastic", "0", "--seed", seed, "--out", tmp_path / "day", "--quiet") == 0
    tables = pincal.session_tables(ROBOT, [pincal.read_session(ROBOT, tmp_path / "day")])
    wide, told = (pincal.calibrate(ROBOT, tables, replace(GEOMETRY, prior_scale=scale)) for scale in (PriorScale(), None))
    angles = [k for k, p in enumerate(told.problem.parameters) if p.unit == "rad" and p.effect in GEOMETRY_NAMES]
    off, off_of_told = (np.sqrt(np.mean(fit.values[angles] ** 2)) for fit in (wide, told))
    assert told.options.prior_scale is not None and told.options.prior_scale.angles <= 0.3
    assert off > 4e-4 and off_of_told < 0.75 * off


def test_rows_in_motion_are_no_replicates(day: Path) -> None:
    """They are never averaged, and what follows them goes along when they are chosen or joined."""
    table = pincal.session_tables(ROBOT, [pincal.read_session(ROBOT, day)])["monday/imu"]
    assert by_pose(table) is table
    parts = concatenate([table.select(slice(0, 20)), table.select(slice(20, None))])
    assert table.moving is not None and parts.moving is not None and table.moving.q is not None
    np.testing.assert_array_equal(parts.moving.q, table.moving.q)
    assert parts.moving.clock == table.moving.clock


@pytest.mark.long
def test_a_fit_begun_by_some_rows_is_that_of_all(day: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Values, their standard deviations and the rows left out are those of a fit to all rows from the start."""
    tables = pincal.session_tables(ROBOT, [pincal.read_session(ROBOT, day)])
    position = tables["monday/tracker"].array("position").copy()
    gross = np.arange(7, len(position), 50)
    position[gross] += 0.01
    tables["monday/tracker"] = tables["monday/tracker"].with_readings(position=position)
    options = pincal.Options(moment_frame="auto")
    whole = pincal.calibrate(ROBOT, tables, options)
    n = len(whole.problem)
    assert many_rows.some_of(whole.problem) is whole.problem and n < many_rows.MANY
    monkeypatch.setattr(many_rows, "MANY", n // 5)
    monkeypatch.setattr(many_rows, "EACH", 100)
    assert 0.15 * n < len(many_rows.some_of(whole.problem)) < 0.25 * n
    begun = pincal.calibrate(ROBOT, tables, options)

    assert begun.problem.chain.moment_frame == whole.problem.chain.moment_frame and begun.fit.stages != whole.fit.stages
    free = whole.solution.free
    np.testing.assert_array_equal(begun.solution.free, free)
    sigma = whole.estimate.sigma[free]
    np.testing.assert_allclose((begun.values[free] - whole.values[free]) / sigma, 0.0, rtol=0.0, atol=0.1)
    np.testing.assert_allclose(begun.estimate.sigma[free], sigma, rtol=0.02)
    np.testing.assert_array_equal(begun.solution.weights, whole.solution.weights)
    np.testing.assert_allclose(begun.solution.sigma, whole.solution.sigma, rtol=1e-3)
    np.testing.assert_allclose(begun.fit.nominal.estimated, whole.fit.nominal.estimated, rtol=1e-3)
    tracker = whole.problem.rows[list(tables).index("monday/tracker")]
    assert set(gross) <= set(np.flatnonzero(begun.solution.weights[tracker] == 0.0))


@pytest.mark.long
def test_a_session_is_calibrated_by_commands(
    day: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a few held poses as a further station; by the streams one by one; and another session validates it."""
    monkeypatch.setenv("COLUMNS", "100")
    out, model = tmp_path / "both", ["--model", "geometric", "--quiet"]
    assert run("calibrate", URDF, day.parent / "eight.csv", day, "--out", out, *model) == 0
    printed = capsys.readouterr().out
    assert "clock    monday/imu: " in printed and "gyroscope" in printed and "drift +1" in printed
    result = json.loads((out / "result.json").read_text())
    assert [station["name"] for station in result["stations"]] == ["eight", "monday/imu", "monday/tracker"]
    clock = next(clock for clock in result["clocks"] if clock["station"] == "monday/tracker")
    assert clock["drift_ppm"] == pytest.approx(150.0, abs=2.0) and clock["gyro_early_s"] is None
    page = (out / "report.html").read_text()
    assert "Clocks relative to that of the joints" in page and "m/s²" in page and "m/s^2" not in page

    streams = ["--joints", day / "joints.csv", "--imu", day / "imu.csv"]
    # It has no error in mm, so no limit in mm is kept.
    assert run("calibrate", URDF, *streams, "--out", tmp_path / "o", *model, "--max-error", "0.1mm") == Exit.INACCURATE
    printed = capsys.readouterr()
    words = " ".join(printed.out.split())
    assert "m/s^2" in words.split("after")[1] and " mm" not in words and "lengths, which are held" in words
    assert "have no positions" in printed.err

    simulated(tmp_path / "tuesday", "--pose-seed", "8", "--log-rates", "80,80,50")
    capsys.readouterr()
    assert run("validate", out / "model.json", tmp_path / "tuesday", "--quiet", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["mean_mm"] < 0.06 and {each["kind"] for each in found["stations"]} == {"imu", "position"}
    imu, tracker = sorted(found["stations"], key=lambda each: each["kind"])
    assert "path" not in imu and tracker["path"]["cycles"] == 1 and not any(key.startswith("RT") for key in tracker["path"])
    assert 0.5 * tracker["error"]["max_mm"] < tracker["path"]["AT_mm"] <= tracker["error"]["max_mm"]
    assert run("validate", out / "model.json", tmp_path / "tuesday", "--quiet") == 0
    assert "path: AT 0." in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([], "Missing argument"),
        (["--imu", "imu.csv"], "--joints LOG"),
        (["nothing"], "nothing"),
    ],
)
def test_streams_that_are_not_given_are_asked_for(
    given: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A usage error, or one that names what is missing."""
    assert run("calibrate", URDF, *given, "--out", tmp_path / "out") != 0
    assert words in capsys.readouterr().err


def test_an_imu_in_a_table_of_poses_is_refused() -> None:
    """Its readings are of a motion; what to give instead is said."""
    rng = np.random.default_rng(0)
    read = {
        "specific_force": rng.standard_normal((40, 3)) + np.array([0.0, 0.0, 9.8]),
        "angular_rate": rng.standard_normal((40, 3)),
    }
    table = pincal.measurements(ROBOT, ROBOT.random_configurations(40, rng), **read)
    with pytest.raises(MeasurementError, match="--joints LOG --imu LOG, which may be one file"):
        pincal.calibrate(ROBOT, table, GEOMETRY)


@pytest.mark.long
def test_causes_are_not_looked_for_by_an_imu_alone(day: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Whatever their number; what to add, or to run instead, is said."""
    table = pincal.session_tables(ROBOT, [pincal.read_session(ROBOT, day)])["monday/imu"]
    for tables in (table, {"a": table, "b": table}):
        with pytest.raises(BadInputError, match=r"measures no positions, .* add a tracker in motion or some static poses"):
            pincal.run_discovery(ROBOT, tables, GEOMETRY)
    given = ["--joints", day / "joints.csv", "--imu", day / "imu.csv", "--out", tmp_path / "out"]
    assert run("discover", URDF, *given, "--quiet") == Exit.BAD_INPUT
    assert "or only calibrate (pincal calibrate)" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("count", "header", "words"),
    [
        pytest.param(2400, "distance", "distances do not follow these joints", marks=pytest.mark.long),
        (999, "distance", "distances over 9.98 s of motion do not determine the offset"),
        (999, "distance,anchor", "distances over 9.98 s of motion"),
    ],
)
def test_an_instrument_that_does_not_follow_the_motion_is_refused(
    day: Path, tmp_path: Path, count: int, header: str, words: str
) -> None:
    """Distances are those of one point, whose squares follow from the motion."""
    rows = "".join(f"{0.01 * k},1.{k}{',a' if 'anchor' in header else ''}\n" for k in range(count))
    (tmp_path / "tracker.csv").write_text(f"time,{header}\n{rows}")
    session = read_streams(ROBOT, joints=day / "joints.csv", tracker=tmp_path / "tracker.csv")
    with pytest.raises(MeasurementError, match=words):
        pincal.session_tables(ROBOT, [session])


@pytest.mark.long
def test_a_load_that_is_carried_bends_the_arm_in_motion(tmp_path: Path) -> None:
    """A hundred kilograms in the log of the joints leave the noise; a fit that does not know of them leaves more."""
    loaded = ["--path", "60s", "--sensor", "position", "--noise", "0.05mm", "--payload", "100", "--seed", "5"]
    loaded += ["--log-rates", "80,80,50"]
    assert run("simulate", URDF, *loaded, "--out", tmp_path / "day", "--quiet") == 0
    session = pincal.read_session(ROBOT, tmp_path / "day")
    assert session.payload == 100.0
    q = session.joints.readings["q"]
    unknown = replace(session, joints=replace(session.joints, readings={"q": q}))
    tables = (pincal.session_tables(ROBOT, [each]) for each in (session, unknown))
    told, untold = (pincal.calibrate(ROBOT, each, pincal.Options(moment_frame="auto")).solution.sigma[0] for each in tables)

    assert told == pytest.approx(5e-5, rel=0.02)
    assert untold > 1.1 * told
    log = (tmp_path / "day" / "joints.csv").read_text().replace(",100.0\n", ",80.0\n", 5)
    (tmp_path / "day" / "joints.csv").write_text(log)
    with pytest.raises(MeasurementError, match=r"joints\.csv: payload from 80 to 100 kg; expected one load"):
        pincal.read_session(ROBOT, tmp_path / "day")


@pytest.mark.long
def test_a_later_session_shows_whether_the_robot_has_changed(
    day: Path, fit: pincal.FittedRobot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A tracker that runs along tells what held poses would: nothing, or the joint that lags; an IMU alone is refused."""
    model, again = tmp_path / "model.json", ["--log-rates", "80,80,50", "--pose-seed", "9", "--setup-seed", "9"]
    fit.save(model)
    simulated(tmp_path / "sound", *again)
    simulated(tmp_path / "slow", *again, "--effect", "joint_lag:joint_3:size=2e-3")

    assert run("diagnose", model, tmp_path / "sound", "--out", tmp_path / "a", "--quiet") == Exit.DONE
    assert run("diagnose", model, tmp_path / "slow", "--out", tmp_path / "b", "--quiet") == Exit.CHANGED
    assert "joint_lag of joint_3" in capsys.readouterr().out
    (tmp_path / "slow" / "tracker.csv").unlink()
    assert run("diagnose", model, tmp_path / "slow", "--out", tmp_path / "c", "--quiet") == Exit.BAD_INPUT
    assert "do not determine positions of the tool" in capsys.readouterr().err


@pytest.mark.long
def test_a_later_session_has_the_noise_of_its_instrument(tmp_path: Path) -> None:
    """Ten times that of a good tracker, which the first station, an IMU, does not tell."""
    noisy = ["--noise", "0.3mm", "--log-rates", "80,80,50"]
    simulated(tmp_path / "day", *noisy)
    simulated(tmp_path / "later", *noisy, "--pose-seed", "9", "--setup-seed", "9")
    first, later = (pincal.session_tables(ROBOT, [pincal.read_session(ROBOT, tmp_path / name)]) for name in ("day", "later"))
    fit = pincal.calibrate(ROBOT, first, GEOMETRY)

    assert [*first] == ["day/imu", "day/tracker"]
    assert place_station(fit, later["later/tracker"]).model.sigma[0] == pytest.approx(3e-4, rel=0.1)
    assert not pincal.diagnose(fit, later["later/tracker"]).changed


@pytest.mark.long
def test_distances_are_read_in_motion(tmp_path: Path) -> None:
    """A draw-wire sensor on a clock of its own, 1000 ppm off, leaves its noise; distances of another motion are refused."""
    wire = ["--sensor", "distance", "--noise", "0.05mm", "--elastic", "0", "--log-rates", "80,80,50", "--path", "40s"]
    for name, seed in (("day", "3"), ("other", "4")):
        given = [*wire, "--seed", seed, "--clock-drift", "1000", "--truth", tmp_path / f"{name}.json", "--quiet"]
        assert run("simulate", URDF, *given, "--out", tmp_path / name) == 0
    (table,) = pincal.session_tables(ROBOT, [pincal.read_session(ROBOT, tmp_path / "day")]).values()
    fit = pincal.calibrate(ROBOT, table, GEOMETRY)
    true = json.loads((tmp_path / "day.json").read_text())["clocks"]["tracker"]

    assert fit.solution.sigma[0] == pytest.approx(5e-5, rel=0.05)
    assert table.moving is not None
    offset, sigma, drift = clock_of(fit.fit, "", table.moving)
    assert abs(offset - true["offset"] - true["drift"] * (table.moving.middle - true["middle"])) < 4.0 * sigma < 1e-4
    assert drift == pytest.approx(1e-3, abs=2e-6)
    shutil.copy(tmp_path / "other" / "tracker.csv", tmp_path / "day" / "tracker.csv")
    with pytest.raises(MeasurementError, match="distances do not follow these joints"):
        pincal.session_tables(ROBOT, [pincal.read_session(ROBOT, tmp_path / "day")])
