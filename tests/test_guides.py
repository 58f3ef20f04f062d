"""Rails that are crooked: roll, straightness and angles that follow the position of a prismatic joint."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pincal import Options, Robot, measurements_from_arrays, run_discovery
from pincal.discover.discovery_file import EffectName
from pincal.discover.report.found_words import effect_words
from pincal.discover.run import Discovery
from pincal.model.catalogue.unnamed import Unnamed, nameless_candidates
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effects import GEOMETRIC

_NOISE = 5e-5
_JOINTS = (
    ("rail", "prismatic", "1 0 0", "0 0 0.3", 1.5),
    ("pan", "revolute", "0 0 1", "0 0 0.2", 2.5),
    ("lift", "revolute", "0 1 0", "0 0 0.2", 1.8),
    ("elbow", "revolute", "0 1 0", "0.6 0 0", 2.0),
    ("roll", "revolute", "1 0 0", "0.5 0 0", 2.5),
    ("bend", "revolute", "0 1 0", "0.1 0 0", 2.0),
)


@pytest.fixture(scope="module")
def arm() -> Robot:
    """Return an arm of five axes on a rail of three metres."""
    text = '<robot name="rail"><link name="l0"/>'
    for k, (name, kind, axis, place, most) in enumerate(_JOINTS):
        text += f'<link name="l{k + 1}"/><joint name="{name}" type="{kind}"><parent link="l{k}"/><child link="l{k + 1}"/>'
        text += f'<origin xyz="{place}"/><axis xyz="{axis}"/>'
        text += f'<limit lower="{-most}" upper="{most}" effort="1" velocity="1"/></joint>'
    return Robot.from_urdf((text + "</robot>").encode())


@pytest.fixture(scope="module")
def found(arm: Robot) -> Discovery:
    """Return what is found if the guide rolls by 0.3 mrad and leaves the straight line by 0.2 mm sideways."""
    rng = np.random.default_rng(8)
    q = 0.8 * arm.random_configurations(250, rng)
    tip = arm.forward_kinematics(q)
    at = tip[:, :3, :3] @ [0.05, 0.02, 0.1] + tip[:, :3, 3] - [0.0, 0.0, 0.3]
    at = Rotation.from_rotvec(np.outer(3e-4 * np.sin(2.5 * q[:, 0]), [1.0, 0.0, 0.0])).apply(at)
    at[:, 1] += 2e-4 * np.cos(3.0 * q[:, 0])
    at += rng.normal([1.0, 2.0, 0.0], _NOISE, at.shape)
    rows = measurements_from_arrays(arm.joint_names, q, position=at)
    return run_discovery(arm, rows, Options(effects=GEOMETRIC, sigma=_NOISE))


@pytest.mark.long
def test_roll_and_straightness_of_a_guide_are_found(found: Discovery) -> None:
    """As functions of the position along it, down to the noise; tilts alone left 2.4 times that, and a false name."""
    floor = found.report["noise_floor_mm"]
    entries = found.report["effects"]

    assert {(entry["joint"], entry["depends_on"]) for entry in entries} == {("rail", "rail")}
    assert {"gamma_z", "a"} & {entry["acts_on"] for entry in entries}
    assert found.report["verdict"] == "adequate"
    assert found.report["gap"]["before"]["rms_mm"] > 1.5 * floor
    assert found.report["gap"]["after"]["rms_mm"] < 1.1 * floor


def test_their_parameters_have_the_units_of_what_they_move(arm: Robot) -> None:
    """Roll in radians, displacement in metres, slopes of a kink by themselves; a revolute joint has no guide."""
    conditions = Conditions.at(arm.random_configurations(30, np.random.default_rng(1)))
    chain = Unnamed("rail", "a", "rail"), Unnamed("rail", "gamma_z", "rail")
    every = list(nameless_candidates(Chain.of(arm), conditions, arm.joint_names))
    kink = Unnamed("pan", "drive", "pan", "kink", place=0.5)
    of_guides = {(e.joint, e.acts_on) for e in every if e.acts_on in ("gamma_z", "a")}

    assert [effect.parameters(Chain.of(arm))[0].unit for effect in (*chain, kink)] == ["m", "rad", "1"]
    assert of_guides == {("rail", "gamma_z"), ("rail", "a")}
    assert [effect_words(EffectName.of(effect)) for effect in chain] == [
        "unnamed of rail (curve of rail, displacement a)",
        "unnamed of rail (curve of rail, roll gamma_z)",
    ]
