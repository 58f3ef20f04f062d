"""Arms on tracks: a carriage bears what it carries where it is, however long its track."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pincal import ELASTIC, Calibration, Options, Robot, load_model, measurements_from_arrays, run_calibration
from pincal import simulate as sim
from pincal.discover.discovery_file import EffectName
from pincal.discover.report.found_words import effect_words
from pincal.errors import PincalWarning
from pincal.model.catalogue.link_bending import LinkBending
from pincal.model.catalogue.unnamed import nameless_candidates
from pincal.model.chain import MOMENT_FRAMES, Chain, MomentFrame
from pincal.model.conditions import Conditions, nominal_moments
from pincal.model.model import Model
from pincal.simulate.effect import HiddenEffect

TRAVELS = (0.3, 3.0, 10.0)
LONGEST = [pytest.param(of, marks=pytest.mark.long if of < max(TRAVELS) else ()) for of in TRAVELS]
NOISE, N, FRESH = 1.5e-5, 160, 300
TARGET = np.array([0.03, 0.02, 0.15])
# Stiffness of a small arm's drives [rad/(N m)], as cobots of this size have.
DRIVES = (0.0, 1e-6, 1.9e-5, 2e-5, 4e-5, 4e-5, 4e-5)
COVERED = 1.959963984540054
# Joints: name, place on the link before, axis, and the link's mass and centre.
_ARM = (
    ("pan", "0 0 0.18", "0 0 1", 7.4, "0 -0.02 -0.03"),
    ("lift", "0 0.15 0", "0 1 0", 13.1, "0 0 0.29"),
    ("elbow", "0 -0.13 0.68", "0 1 0", 4.2, "0 0 0.28"),
    ("wrist_1", "0 0 0.62", "0 1 0", 2.0, "0 0.09 0"),
    ("wrist_2", "0 0.12 0", "0 0 1", 2.0, "0 0 0.09"),
    ("wrist_3", "0 0 0.13", "0 1 0", 0.4, "0 0.05 0"),
)


def urdf(travel: float) -> bytes:
    """Return a small arm on a track of some length [m]."""
    text = '<robot name="tracked"><link name="floor"/>' + _link("carriage", 60.0, "0 0 0.1")
    text += _joint("track", "prismatic", "floor", "carriage", "0 0 0", "1 0 0", 0.0, travel)
    last = "carriage"
    for name, place, axis, mass, centre in _ARM:
        text += _link(f"{name}_link", mass, centre)
        text += _joint(name, "revolute", last, f"{name}_link", place, axis, -2.6, 2.6)
        last = f"{name}_link"
    text += '<link name="tool0"/>' + _joint("flange", "fixed", last, "tool0", "0 0.09 0", "0 0 1", 0.0, 0.0)
    return (text + "</robot>").encode()


def _link(name: str, mass: float, centre: str) -> str:
    inertia = '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>'
    return f'<link name="{name}"><inertial><origin xyz="{centre}"/><mass value="{mass}"/>{inertia}</inertial></link>'


def _joint(name: str, kind: str, parent: str, child: str, place: str, axis: str, lower: float, upper: float) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{place}"/>'
        f'<axis xyz="{axis}"/><limit lower="{lower}" upper="{upper}" effort="1e4" velocity="3"/></joint>'
    )


@cache
def measured(travel: float, *effects: HiddenEffect) -> tuple[Calibration, np.ndarray, np.ndarray]:
    """Return a calibration of a true machine on a track, and poses never measured with the truth there."""
    rng = np.random.default_rng([15, round(10 * travel)])
    machine = sim.TrueMachine.from_urdf(urdf(travel).decode(), tip="tool0")
    machine = machine.draw_errors(rng, sigma_length=3e-4, sigma_angle=5e-4, sigma_offset=1e-3)
    drives = [sim.JointElasticity(joint=name, size=k) for name, k in zip(machine.names, DRIVES, strict=True) if k]
    machine = machine.with_effects(*drives, *effects)
    q = rng.uniform(machine.nominal.lower, machine.nominal.upper, (N + FRESH, len(machine.names)))
    tip = machine.tip(q)
    position = tip[:, :3, 3] + tip[:, :3, :3] @ TARGET
    read = position[:N] + NOISE * rng.standard_normal((N, 3))
    rows = measurements_from_arrays(machine.names, q[:N], position=read)
    options = Options(effects=ELASTIC, moment_frame="after", sigma=NOISE)
    return run_calibration(Robot.from_urdf(urdf(travel)), rows, options, test_fraction=0.0), q[N:], position[N:]


def errors(travel: float, *effects: HiddenEffect) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of predicted positions never measured, shape (M, 3), and their standard deviations [m]."""
    calibration, q, truth = measured(travel, *effects)
    predicted, sigma = calibration.fit.predict(q, return_sigma=True)
    return predicted[:, :3, 3] - truth, sigma


@pytest.mark.parametrize("moment_frame", MOMENT_FRAMES)
def test_the_moment_on_a_carriage_is_about_the_carriage(moment_frame: MomentFrame) -> None:
    """It is the same wherever the carriage stands, and that of the simulated machine."""
    robot, machine = Robot.from_urdf(urdf(10.0)), sim.TrueMachine.from_urdf(urdf(10.0).decode(), tip="tool0")
    q = np.tile(np.random.default_rng(0).uniform(-1.5, 1.5, 7), (3, 1))
    q[:, 0] = 0.0, 4.0, 10.0
    chain = Chain.of(robot, moment_frame=moment_frame)
    moments = nominal_moments(chain, Conditions.at(q))

    np.testing.assert_allclose(moments, moments[[0, 0, 0]], rtol=0.0, atol=1e-9)
    # By axes that may be turned about the direction of motion.
    true = machine.equilibrium(machine.poses(q)).loads.before[0, 0]
    assert moments[0, 2] == pytest.approx(true[2], abs=1e-9)
    if moment_frame != "paper":
        # The paper has the bearing at the origin of a frame, which is elsewhere along the track.
        assert np.linalg.norm(moments[0, :2]) == pytest.approx(np.linalg.norm(true[:2]), rel=1e-9)


@pytest.mark.parametrize("travel", LONGEST)
def test_intervals_on_a_track_cover_whatever_its_length(travel: float) -> None:
    """At poses never measured, of a rigid track: 95 % intervals contain at least 90 % of the true coordinates."""
    error, sigma = errors(travel)

    assert np.mean(np.abs(error) < COVERED * sigma) > 0.9
    assert np.sqrt(np.mean(error**2)) < NOISE


@pytest.mark.parametrize("travel", LONGEST)
def test_a_long_track_hides_no_moment(travel: float) -> None:
    """A wrist that bears 2 N m has one, and compliances of drives are found within their intervals."""
    found = {p.name: (p.value, p.sigma, p.reason) for p in measured(travel)[0].result.parameters}

    for name, true in zip(("lift", "elbow", "wrist_1"), (1.9e-5, 2e-5, 4e-5), strict=True):
        value, sigma, _ = found[f"{name}.k_z"]
        assert sigma is not None and 0.0 < abs(value - true) < 4.0 * sigma
    without = {name for name, (*_, reason) in found.items() if "no static moment" in str(reason)}
    assert not without & {"wrist_1.k_z", "wrist_2.k_z", "wrist_2.k_x", "wrist_1.k_x"}


@pytest.mark.parametrize("travel", LONGEST)
def test_a_carriage_that_tilts_is_identified(travel: float) -> None:
    """Its compliance across the track is found, and intervals cover."""
    tilting = sim.BearingElasticity(joint="track", size=2e-6, moment_frame="after")
    error, sigma = errors(travel, tilting)

    assert np.mean(np.abs(error) < COVERED * sigma) > 0.9
    across = [p for p in measured(travel, tilting)[0].result.parameters if p.name in ("track.k_x", "track.k_y")]
    best = min(across, key=lambda p: p.sigma or np.inf)
    assert best.sigma is not None and abs(best.value - 2e-6) < 4.0 * best.sigma and best.sigma < 5e-7


def test_a_file_of_an_earlier_version_says_that_moments_differ(tmp_path: Path) -> None:
    """Its carriage bore where its travel starts."""
    path = tmp_path / "model.json"
    measured(0.3)[0].fit.save(path)
    load_model(path)
    saved = json.loads(path.read_text())
    del saved["stations"][0]["chain"]["on_carriages"], saved["check"]
    path.write_text(json.dumps(saved))

    with pytest.warns(PincalWarning, match="about the start of the travel.*calibrate again"):
        load_model(path)


def test_a_boom_bends_under_a_carriage_that_moves_on(rng: np.random.Generator) -> None:
    """The link before a track bends by the moment about its end, wherever the carriage stands, as the machine's does."""
    text = '<robot name="boom"><link name="floor"/>' + _link("boom", 5.0, "0.4 0 0") + _link("slider", 8.0, "0.1 0 0.05")
    text += _joint("lift", "revolute", "floor", "boom", "0 0 1", "0 1 0", -1.5, 1.5) + _link("hand", 3.0, "0 0.1 0.1")
    text += _joint("slide", "prismatic", "boom", "slider", "0.8 0 0.1", "1 0 0", 0.0, 2.0)
    text += _joint("turn", "revolute", "slider", "hand", "0.2 0 0", "0 0 1", -3.0, 3.0)
    text += '<link name="tool0"/>' + _joint("flange", "fixed", "hand", "tool0", "0.3 0 0", "0 0 1", 0.0, 0.0) + "</robot>"
    machine, robot = sim.TrueMachine.from_urdf(text, tip="tool0"), Robot.from_urdf(text.encode())
    q = rng.uniform(robot.lower, robot.upper, (20, 3))
    bent = machine.with_effects(sim.LinkBending(joint="lift", size=1e-7)).tip(q) - machine.tip(q)
    model = Model(Chain.of(robot, moment_frame="after"), (LinkBending("lift"),))
    predicted = model.predict(np.array([1e-7]), Conditions.at(q)) - model.predict(np.zeros(1), Conditions.at(q))

    size = np.abs(bent[:, :3]).max()
    assert size > 1e-5
    np.testing.assert_allclose(predicted, bent[:, :3], rtol=0.0, atol=2e-3 * size)


def test_waves_along_a_track_are_told_by_their_period() -> None:
    """In words, files and titles: a track has no revolutions; waves of joints that turn keep their order."""
    chain = Chain.of(Robot.from_urdf(urdf(3.0)))
    q = np.random.default_rng(1).uniform(0.1, 2.0, (30, 7))
    waves = [e for e in nameless_candidates(chain, Conditions.at(q), ("track", "pan")) if e.shape == "waves"]
    names = [EffectName.of(effect) for effect in waves]

    assert {e.depends_on for e in waves} == {*chain.robot.joint_names}
    for effect, name in zip(waves, names, strict=True):
        along = effect.depends_on == "track"
        assert (name.order is None) == along == (name.period_unit == "m")
        assert ("of period 2094 mm of track" if along and effect.order == 3 else "of ") in effect_words(name)
        assert ("order" in effect_words(name)) != along
        assert effect.order is not None
        if along:
            assert name.period == pytest.approx(2.0 * np.pi / effect.order)
