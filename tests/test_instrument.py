"""The instrument is a machine, too: its own errors are told from the robot's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tracker_cases import NOISE, seen, standing

from pincal import load_model, run_calibration
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.checked_fit import calibrate
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.placing import place_station
from pincal.calibration.unmodelled import instruments_error
from pincal.diagnosis.robot_diagnosis import diagnose
from pincal.discover.candidate_tests import variants
from pincal.discover.loop import discover_effects
from pincal.discover.steps import History
from pincal.export.c_source import CSource
from pincal.identify.calibrate import fit_tables
from pincal.identify.options import Options
from pincal.identify.split import row_groups
from pincal.io.urdf_export import rigid_notes
from pincal.measure.measurements import Measurements
from pincal.model.catalogue import (
    InstrumentAzimuth,
    InstrumentElevation,
    InstrumentRange,
    InstrumentStretch,
    InstrumentTilt,
    untestable,
)
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect
from pincal.model.effects import GEOMETRIC
from pincal.notes import Severity
from pincal.robot.robot import Robot
from pincal.simulate.tracker import ReadingEffect, cartesian, spherical

OWN = ("instrument_azimuth", "instrument_elevation", "instrument_tilt", "instrument_range")


PAIRS: dict[str, tuple[ReadingEffect, Effect, list[float]]] = {
    "azimuth": (
        sim.InstrumentAzimuth(size=1e-5),
        InstrumentAzimuth(),
        [1e-5 * np.cos(0.6), -1e-5 * np.sin(0.6)],
    ),
    "azimuth, oval": (
        sim.InstrumentAzimuth(size=1e-5, order=2, phase=0.0),
        InstrumentAzimuth(2),
        [0.0, 0.0, 1e-5, 0.0],
    ),
    "elevation": (
        sim.InstrumentElevation(size=1e-5),
        InstrumentElevation(),
        [1e-5 * np.cos(0.6), -1e-5 * np.sin(0.6)],
    ),
    "elevation, oval": (
        sim.InstrumentElevation(size=1e-5, order=2, phase=0.0),
        InstrumentElevation(2),
        [0.0, 0.0, 1e-5, 0.0],
    ),
    "angles of axes": (
        sim.InstrumentTilt(size=1e-5, transit=1.0, beam=-2.0, index=3.0),
        InstrumentTilt(),
        [1e-5, -2e-5, 3e-5],
    ),
    "angles and offsets of axes": (
        sim.InstrumentTilt(size=1e-5, transit=1.0, beam=2.0, index=3.0, behind=4.0, right=5.0, below=-6.0),
        InstrumentTilt(offsets=True),
        [1e-5, 2e-5, 3e-5, 4e-5, 5e-5, -6e-5],
    ),
    "range": (sim.InstrumentRange(size=1e-5), InstrumentRange(), [1e-5]),
    "stretch": (
        sim.InstrumentStretch(size=1e-5, towards=(4.0, 3.0, 0.0)),
        InstrumentStretch(),
        [0.64e-5, 0.36e-5, 0.48e-5, 0.0, 0.0],
    ),
}


@pytest.mark.parametrize("name", PAIRS)
def test_a_tracker_errs_as_its_parts_do(kuka: Robot, name: str) -> None:
    """To first order, an error in 10^4 being of second, the catalogue moves readings as the simulated tracker's parts."""
    hidden, effect, values = PAIRS[name]
    position = np.random.default_rng(2).uniform([2.0, 0.0, -0.7], [4.0, 2.0, 1.3], (200, 3))
    conditions = replace(Conditions.at(np.zeros((200, 6))), sighted=position)
    moved = np.zeros((200, 3))
    for term in effect.terms(Chain.of(kuka), conditions, None):
        assert term.basis is not None
        moved[:, term.coordinate] += values[term.parameter] * term.basis

    np.testing.assert_allclose(hidden.as_read(position) - position, moved, rtol=0.0, atol=1e-4 * np.abs(moved).max())


def test_the_simulated_readings_are_those_of_a_perfect_tracker_without_errors() -> None:
    """Azimuth, elevation and range of a position come to the position again."""
    position = np.random.default_rng(3).uniform(-3.0, 3.0, (50, 3))
    np.testing.assert_allclose(cartesian(*spherical(position)), position, rtol=0.0, atol=1e-14)


def test_a_model_predicts_where_nothing_was_read(kuka: Robot, tmp_path: Path) -> None:
    """From the positions that it predicts itself, to what of an error of 60 um the noise of a reading makes; saved, too."""
    rows = seen(sim.InstrumentAzimuth(size=2e-5))
    fit = calibrate(kuka, rows, Options(effects=(*GEOMETRIC, InstrumentAzimuth())))
    fit.save(tmp_path / "model.json")
    read = fit.model.predict(fit.model.own(fit.values), fit.fit.station.conditions)

    own = fit.estimate.take(["instrument.azimuth_sin1", "instrument.azimuth_cos1"])
    assert np.all(np.abs(own.values - 2e-5 * np.array([np.cos(0.6), -np.sin(0.6)])) < 3.5 * own.sigma)
    np.testing.assert_allclose(fit.predict(rows.q), read, rtol=0.0, atol=1e-8)
    saved = load_model(tmp_path / "model.json")
    np.testing.assert_array_equal(saved.predict(rows.q), fit.predict(rows.q))
    # Programs for controllers say where the target is, not how a tracker misreads it.
    assert (CSource().export(saved).max_error_m or 0.0) < 1e-9 and "an error of the instrument" in " ".join(
        rigid_notes(saved.model)
    )


def test_readings_in_another_frame_are_not_judged(kuka: Robot) -> None:
    """In the robot's own frame no tracker stands; a distance says nothing of directions."""
    at_base, beside = seen(place=np.eye(4)), seen()
    cases = {
        "m from the robot's base, where no tracker can be": calibrate(
            kuka, at_base, Options(effects=GEOMETRIC)
        ).fit.station.conditions,
        "no positions in an instrument frame": Conditions.at(at_base.q),
    }
    for reason, conditions in cases.items():
        why = {effect.name: text for effect, text in untestable(Chain.of(kuka), conditions) if effect.name in OWN}
        assert set(why) == set(OWN) and all(reason in text for text in why.values()), why
    names = {effect.name for effect in variants(calibrate(kuka, beside, Options(effects=GEOMETRIC)).fit)}
    assert set(OWN) <= names


def searched(fit: FittedRobot, tables: Mapping[str, Measurements]) -> History:
    """Return what is discovered beyond a fit."""
    groups = np.concatenate([row_groups(table, split="blocked", seed=0) % 8 for table in tables.values()])
    return discover_effects(fit.fit, groups)


@pytest.mark.long
def test_an_eccentric_circle_of_the_tracker_is_not_the_robots(kuka: Robot) -> None:
    """30 urad, 0.1 mm at 4 m: the instrument's name leads, and no name of the robot stands without it."""
    table = seen(sim.InstrumentAzimuth(size=3e-5))
    steps = searched(calibrate(kuka, table, Options(effects=GEOMETRIC, sigma=NOISE)), {"": table}).steps

    assert [step.effect.name for step in steps] == ["instrument_azimuth"]


@pytest.mark.long
def test_what_stretches_coordinates_is_found_anew_on_another_day(kuka: Robot) -> None:
    """Two in ten thousand: named, known to its interval, and on another day that of the instrument that stands there."""
    stretched = sim.InstrumentStretch(size=2e-4, towards=(4.0, 3.0, 0.0))
    fit = calibrate(kuka, seen(stretched), Options(effects=(*GEOMETRIC, InstrumentStretch()), sigma=NOISE))
    days = [seen(*hidden, seed=1, place=standing(2.0, 1.0), poses=60) for hidden in ((stretched,), ())]
    placed = [place_station(fit, day) for day in days]

    for model, size in ((fit, 2e-4), (placed[0].model, 2e-4), (placed[1].model, 0.0)):
        own = model.estimate.take([f"instrument.stretch_{axes}" for axes in ("x", "y", "xy", "xz", "yz")])
        assert np.all(np.abs(own.values - size * np.array([0.64, 0.36, 0.48, 0.0, 0.0])) < 3.5 * own.sigma)
    assert all(one.misfit.ratio < 1.15 and not one.notes for one in placed)
    # Neither the same instrument nor a sound one makes another robot of it.
    assert not any(diagnose(fit, day).changed for day in days)


@pytest.mark.long
def test_stretched_coordinates_are_named(kuka: Robot) -> None:
    """Of a robot that is sound: by the instrument's name alone."""
    table = seen(sim.InstrumentStretch(size=2e-4), poses=120)
    steps = searched(calibrate(kuka, table, Options(effects=GEOMETRIC, sigma=NOISE)), {"": table}).steps

    assert [step.effect.name for step in steps] == ["instrument_stretch"]


@pytest.mark.long
def test_two_places_tell_the_instrument_from_the_robot(kuka: Robot) -> None:
    """One circle at both stations, its values by station; a gear of the robot is still found as the robot's."""
    places = {"east": standing(0.5), "north": standing(2.0, 1.0)}
    for hidden, name, joint in (
        (sim.InstrumentAzimuth(size=3e-5), "instrument_azimuth", None),
        (sim.GearEccentricity(joint="joint_1", size=8e-5), "gear_eccentricity", "joint_1"),
    ):
        tables = {of: seen(hidden, seed=i, place=T, poses=120) for i, (of, T) in enumerate(places.items())}
        steps = searched(calibrate(kuka, tables, Options(effects=GEOMETRIC, sigma=NOISE)), tables).steps

        assert [(step.effect.name, step.effect.locus.joint) for step in steps] == [(name, joint)]
        assert not {effect.name for effect in steps[0].equivalent} & {name, *OWN}


@pytest.mark.parametrize("size", [0.0, 2.5e-5])
def test_a_calibration_of_a_tracker_that_misreads_is_not_adequate(size: float) -> None:
    """Residuals of 1.06 times the declared noise pass by themselves; the eccentric encoder is seen, and said."""
    hidden = [sim.InstrumentAzimuth(size=size)] if size else []
    table = seen(*hidden, poses=150, sigma=2e-5)
    result = run_calibration(Robot.from_urdf(kuka_urdf_path()), table, Options(sigma=2e-5)).result
    doubts = [str(note) for note in result.warnings if note.severity is Severity.DOUBT]

    assert result.chi2_p_value is not None and result.chi2_p_value > 1e-3
    assert [("instrument_azimuth" in doubt, "misreads" in doubt) for doubt in doubts] == ([(True, True)] if size else [])


@pytest.mark.long
def test_of_two_trackers_the_one_that_misreads_is_said() -> None:
    """Each from a place of its own, the second with an eccentric encoder."""
    second = seen(sim.InstrumentAzimuth(size=2.5e-5), poses=100, seed=1, place=standing(1.2), sigma=2e-5)
    tables = {"a": seen(poses=100, sigma=2e-5), "b": second}
    fit = fit_tables(Robot.from_urdf(kuka_urdf_path()), tables, Options(sigma=2e-5))
    found = instruments_error(fit)

    assert found is not None and found[:2] == ("b", "instrument_azimuth") and found[2] < 1e-4
