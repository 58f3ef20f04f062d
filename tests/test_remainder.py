"""What is smooth in the joints and has no name: a remainder that predicts, and says nothing of causes."""

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from machines import kuka as true_kuka

from pincal import load_model
from pincal import simulate as sim
from pincal.discover.run import Discovery, run_discovery
from pincal.discover.smooth_rest import likely_remainders, remainder_of
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.model.catalogue.remainder import SmoothRemainder, golden_ratio
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effects import ELASTIC
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
    from pincal.discover.policy import POLICY

    few = replace(POLICY, most_steps=1)
    return run_discovery(kuka, rows, Options(effects=ELASTIC, moment_frame="after"), policy=few, remainder=remainder)


@pytest.fixture(scope="module")
def found(kuka: Robot) -> Discovery:
    """Return a discovery with a remainder."""
    return searched(kuka, table(kuka, 1.5e-4, 300, 7)[0], remainder=True)


@pytest.mark.long
def test_a_smooth_error_of_all_joints_is_predicted(kuka: Robot, found: Discovery) -> None:
    """At poses that were not measured the error is a third less than without; regions left out are predicted better."""
    rows, true = table(kuka, 1.5e-4, 200, 11)
    plain = searched(kuka, table(kuka, 1.5e-4, 300, 7)[0], remainder=False)
    at = found.calibration.fit.readings(rows).conditions
    errors = [np.mean(np.linalg.norm(of.calibration.fit.predict(at)[:, :, 3] - true, axis=1)) for of in (plain, found)]
    gaps = [of.report["gap"]["after"]["mean_mm"] for of in (plain, found)]

    assert remainder_of(found.trail.final) and not remainder_of(plain.trail.final)
    assert errors[1] < 0.67 * errors[0]
    assert gaps[1] < gaps[0]


def test_it_is_told_apart_from_names(found: Discovery) -> None:
    """It is no effect of the findings; a note, a stage of the search and its parameters say that it is there."""
    (note,) = (note.text for note in found.calibration.notes if note.text.startswith("unnamed, smooth"))

    assert "says nothing of causes" in note or "say nothing of causes" in note
    assert "smooth_remainder" not in {entry["effect"] for entry in found.report["effects"]}
    assert any("unnamed, smooth" in stage.name for stage in found.gaps)


def test_its_intervals_cover(kuka: Robot, found: Discovery) -> None:
    """At poses that were not measured, as often as they say or more."""
    rows, true = table(kuka, 1.5e-4, 200, 13)
    at = found.calibration.fit.readings(rows).conditions
    error = found.calibration.fit.predict(at)[:, :, 3] - true

    assert np.mean(np.abs(error) < 1.96 * found.calibration.fit.position_sigma(at)) > 0.9


def test_a_model_file_keeps_it(found: Discovery, tmp_path: Path, rng: np.random.Generator) -> None:
    """The same predictions from the file."""
    found.calibration.fit.save(tmp_path / "model.json")
    again = load_model(tmp_path / "model.json")
    q = rng.uniform(-1.0, 1.0, (20, 6))
    entries = json.loads((tmp_path / "model.json").read_text())

    assert "smooth_remainder" in json.dumps(entries["model"]["effects"] if "model" in entries else entries)
    np.testing.assert_allclose(again.predict(q), found.calibration.fit.predict(q), atol=1e-12)


@pytest.mark.long
def test_noise_has_no_remainder(kuka: Robot) -> None:
    """Of a table that the model describes, nothing enters, and the note says so."""
    sound = searched(kuka, table(kuka, 0.0, 200, 17)[0], remainder=True)

    assert remainder_of(sound.trail.final) is None and not likely_remainders(sound.trail.final)
    assert any("nothing entered" in note.text for note in sound.calibration.notes)


def test_waves_are_a_process_of_the_stated_length(kuka: Robot) -> None:
    """Of many waves the covariance of two poses is that of sums over pairs, by its closed form."""
    effect = SmoothRemainder(("joint_1", "joint_2", "joint_3"), 2, 0.8, 1e-4, 30000)
    q = np.zeros((2, 6))
    q[1, :3] = [0.3, -0.5, 0.9]
    basis = np.array([term.basis for term in effect.terms(Chain.of(kuka), Conditions.at(q), None)[:60000]])
    expected = [np.exp(-0.5 * sum(q[1, list(pair)] ** 2) / 0.8**2) for pair in itertools.combinations(range(3), 2)]

    assert (basis.T @ basis / effect.count)[0, 1] == pytest.approx(np.mean(expected), abs=0.01)
    assert golden_ratio(2) ** 3 == pytest.approx(golden_ratio(2) + 1.0)
