"""The noise of an instrument by range and direction, as its data sheet says it, and rows weighed by it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tracker_cases import seen, standing

from pincal.builtin import kuka_urdf_path
from pincal.calibration.checked_fit import calibrate
from pincal.calibration.fitted_robot import FittedRobot
from pincal.cli import main
from pincal.discover.ending import note_on_joints
from pincal.errors import BadInputError, MeasurementError
from pincal.identify.options import Options
from pincal.measure.instruments import INSTRUMENTS, InstrumentNoise
from pincal.measure.measurements import measurements_from_arrays
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot
from pincal.simulate.tracker import cartesian, spherical


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("10um+0.3um/m,15um+6um/m", (5e-6, 1.5e-7, 7.5e-6, 3e-6)),
        ("leica_at500", (5e-6, 1.5e-7, 7.5e-6, 3e-6)),
        ("leica_at960", (7.5e-6, 3e-6, 7.5e-6, 3e-6)),
        ("0.02mm , 5urad", (1e-5, 0.0, 0.0, 2.5e-6)),
        ("15um + 6ppm", (7.5e-6, 3e-6, 7.5e-6, 3e-6)),
    ],
)
def test_half_of_what_a_data_sheet_permits_is_the_standard_deviation(text: str, found: tuple[float, ...]) -> None:
    """Along and across the line of sight, constant and in proportion to the range; one statement alone holds both ways."""
    noise = InstrumentNoise.of(text)
    np.testing.assert_allclose((noise.along, noise.along_per_m, noise.across, noise.across_per_m), found, rtol=1e-12)


@pytest.mark.parametrize(
    "text",
    ["at_9000", "", "15um,6um,3um", "15", "15um+6", "-3um", "nan um", "0um", "1e300um,1um", "1um,1e200um", "1e-300um"],
)
def test_an_instrument_that_says_nothing_is_refused(text: str) -> None:
    """The message names what is known and shows how numbers are given."""
    with pytest.raises(BadInputError, match="expected"):
        InstrumentNoise.of(text)


def test_every_data_sheet_has_its_source() -> None:
    """A name that nobody could look up would be a guess."""
    assert all(
        sheet.source and InstrumentNoise.of(name) == InstrumentNoise.of(sheet.mpe) for name, sheet in INSTRUMENTS.items()
    )


NEAR_AND_FAR = InstrumentNoise(1e-5, 1e-6, 1e-5, 3e-5)


def noisy(position: np.ndarray, noise: InstrumentNoise, rng: np.random.Generator) -> np.ndarray:
    """Return positions read with noise of range and angles, drawn as such."""
    azimuth, elevation, distance = spherical(position)
    draws = rng.standard_normal((3, len(position)))
    along = noise.along + noise.along_per_m * distance
    angle = noise.across / distance + noise.across_per_m
    return cartesian(
        azimuth + draws[0] * angle / np.cos(elevation), elevation + draws[1] * angle, distance + draws[2] * along
    )


def test_the_covariance_of_a_reading_is_that_of_range_and_angles() -> None:
    """Of 40000 readings each at three places, to 2 % of the largest variance; whitened, it is the unit matrix."""
    places = np.array([[1.5, 0.2, -0.4], [-2.0, 4.0, 1.5], [0.3, -7.0, 0.6]])
    rng = np.random.default_rng(4)
    covariance, whitening = NEAR_AND_FAR.covariance(places), NEAR_AND_FAR.whitening(places, 6)
    for i, place in enumerate(places):
        drawn = noisy(np.tile(place, (40000, 1)), NEAR_AND_FAR, rng)
        np.testing.assert_allclose(np.cov(drawn.T), covariance[i], rtol=0.0, atol=0.02 * covariance[i].max())
        L = whitening[:3, :3, i] / NEAR_AND_FAR.sigma(places)
        np.testing.assert_allclose(L @ covariance[i] @ L.T, np.eye(3), rtol=0.0, atol=1e-9)
        np.testing.assert_array_equal(whitening[3:, :, i], np.eye(6)[3:])


def weighed_and_even(kuka: Robot, seed: int) -> tuple[FittedRobot, FittedRobot, np.ndarray]:
    """Return fits that weigh positions near and far, along and across, and that take them for even; and the truth."""
    exact = seen(seed=seed, place=standing(0.5, away=3.0), sigma=0.0, poses=150)
    assert exact.position is not None
    table = exact.with_readings(position=noisy(exact.position, NEAR_AND_FAR, np.random.default_rng(50 + seed)))
    weighed = calibrate(kuka, table, Options(effects=GEOMETRIC, instrument=NEAR_AND_FAR))
    return weighed, calibrate(kuka, table, Options(effects=GEOMETRIC)), exact.position


@pytest.mark.long
def test_readings_are_weighed_by_what_the_instrument_says(kuka: Robot) -> None:
    """Over eight tables chi-square is that of the degrees of freedom, and the fit nearer to the truth than an even one's."""
    chi2, degrees, errors = 0.0, 0.0, np.zeros(2)
    for seed in range(8):
        *fits, truth = weighed_and_even(kuka, seed)
        chi2, degrees = chi2 + fits[0].solution.chi2, degrees + fits[0].solution.degrees
        errors += [np.mean((fit.predict(fit.fit.station.conditions)[:, :, 3] - truth) ** 2) for fit in fits]

    assert abs(chi2 - degrees) < 4.0 * np.sqrt(2.0 * degrees)
    assert errors[0] < 0.9 * errors[1]
    assert fits[0].fit.is_declared and note_on_joints(fits[0].fit) is None


def test_a_table_that_says_its_own_noise_or_no_position_is_refused(kuka: Robot) -> None:
    """One of two statements of noise has to go; a distance has no direction."""
    table = seen(poses=60)
    distances = measurements_from_arrays(kuka.joint_names, table.q, distance=np.linalg.norm(table.position, axis=1))
    for rows, message in ((replace(table, sigma=np.full(60, 1e-5)), "column sigma"), (distances, "holds distance")):
        with pytest.raises(MeasurementError, match=message):
            calibrate(kuka, rows, Options(effects=GEOMETRIC, instrument=NEAR_AND_FAR))


def cli(*arguments: str) -> int:
    """Return the exit code of a command line."""
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    return int(ended.value.code or 0)


@pytest.mark.long
def test_calibrate_takes_an_instrument_by_its_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The noise of result.json is declared, of the size that the data sheet gives at these ranges; bad input ends with 3."""
    table, out = tmp_path / "table.csv", tmp_path / "out"
    rows = seen(poses=90, sigma=1.5e-5)
    assert rows.position is not None
    header = ",".join([*rows.joint_names, "x", "y", "z"])
    np.savetxt(table, np.hstack([rows.q, rows.position]), delimiter=",", header=header, comments="")
    fitted = ["calibrate", str(kuka_urdf_path()), str(table), "--model", "geometric", "--out", str(out), "--instrument"]
    assert cli(*fitted, "leica_at500") == 0
    noise = json.loads((out / "result.json").read_text())["noise"]

    assert noise["source"] == "declared"
    assert noise["sigma_m"] == pytest.approx(InstrumentNoise.of("leica_at500").sigma(rows.position), rel=0.02)
    for more, message in (
        (["laica"], "expected leica_at500, leica_at960"),
        (["leica_at500", "--noise", "0.05mm"], "expected one of the two"),
    ):
        capsys.readouterr()
        assert cli(*fitted, *more) == 3
        assert message in " ".join(capsys.readouterr().err.split())
