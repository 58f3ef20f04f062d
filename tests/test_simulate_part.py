"""``pincal simulate --features``: readings of a part whose truth is known."""

import json
from pathlib import Path

import numpy as np
import pytest

from pincal import Robot
from pincal.builtin import kuka_urdf_path
from pincal.cli import main
from pincal.errors import BadInputError
from pincal.features.feature_set import FeatureSet
from pincal.measure.reader import read_columns
from pincal.simulate import TrueMachine
from pincal.simulate.true_part import TrueFeature, object_of_features, readings_of_features

URDF = str(kuka_urdf_path())
X, _, Z = np.eye(3)
FEATURES = {
    "point": TrueFeature("point", "point", np.array([0.06, 0.04, 0.0]), Z),
    "edge": TrueFeature("edge", "line", np.array([0.0, -0.05, 0.0]), X),
    "top": TrueFeature("top", "plane", np.zeros(3), np.array([0.0, 0.6, 0.8])),
    "hole": TrueFeature("hole", "circle", np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.6, 0.8]), 0.006),
    "ball": TrueFeature("ball", "sphere", np.array([0.0, 0.1, 0.02]), Z, 0.015),
    "shaft": TrueFeature("shaft", "cylinder", np.array([0.0, 0.1, 0.02]), X, 0.012),
    "pin": TrueFeature("pin", "cylinder", np.array([0.0, 0.1, 0.02]), Z, 0.012),
}
PART = """
unit = "mm"
[feature.hole]
kind = "circle"
nominal = [0, 0, 0]
direction = [0, 0, 1]
diameter = 20
[feature.ball]
kind = "sphere"
nominal = [60, 40, 20]
diameter = 30
[feature.pitch]
kind = "distance"
of = ["hole", "ball"]
"""


@pytest.mark.parametrize("name", FEATURES)
def test_points_are_of_their_feature(name: str) -> None:
    """A fit finds it again, its deviations too; each is seen from outside."""
    for feature in (FEATURES[name], FEATURES[name].drawn(np.random.default_rng(1), 1e-3)):
        points, normals = feature.points()
        found = FeatureSet.fit({name: feature.kind}, np.repeat(name, len(points)), points, 1e-12 * np.eye(3 * len(points)))
        fit = found.fits[name]
        off = fit.position - feature.position
        if feature.kind in ("line", "cylinder"):
            off -= feature.direction * (feature.direction @ off)
        if feature.kind == "plane":
            off = feature.direction * (feature.direction @ off)

        assert normals.shape == points.shape
        assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0)
        assert np.abs(off).max() < 1e-8
        assert fit.radius == pytest.approx(feature.radius, abs=1e-8)
        if "i" in fit.names:
            assert abs(fit.direction @ feature.direction) == pytest.approx(1.0, abs=1e-9)


def test_a_pose_reads_the_feature_that_it_is_for() -> None:
    """Others in the image are left out, and a second visit is a second pass."""
    names = object_of_features([FEATURES["point"], FEATURES["hole"]]).names
    table = {"j": np.repeat([0.1, 0.2, 0.1, 0.2], len(names)), "point": np.array(names * 4)}
    found = readings_of_features(table, "j", np.array([0.1, 0.2]), ["point", "hole"])

    assert found["feature"].tolist() == (["point"] + ["hole"] * 8) * 2
    assert found["pass"].tolist() == [1] * 9 + [2] * 9
    assert found["point"].tolist()[:3] == ["1", "1", "2"]


def test_images_of_a_point_are_two_or_none() -> None:
    """One alone does not tell where the point is."""
    table = {
        "j": np.array([0.1, 0.1, 0.2, 0.1, 0.2, 0.2]),
        "point": np.array(["a/1", "a/2", "a/1", "a/1", "a/2", "a/1"]),
        "u": np.arange(6.0),
    }
    found = readings_of_features(table, "j", np.array([0.1, 0.2]), ["a"])

    assert found["u"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    alone = {name: column[:2] for name, column in table.items()}
    with pytest.raises(BadInputError, match="from 2 poses"):
        readings_of_features(alone, "j", np.array([0.1, 0.2]), ["a"])
    fewer = {name: column[:3] for name, column in table.items()}
    assert readings_of_features(fewer, "j", np.array([0.1, 0.2]), ["a"])["u"].tolist() == [0.0, 2.0]


def test_readings_of_an_exact_machine_are_the_part(tmp_path: Path) -> None:
    """Without errors and noise, points through the robot's own kinematics are those of the true features."""
    part = tmp_path / "part.toml"
    part.write_text(PART)
    command = ["simulate", URDF, "--features", str(part), "--errors", "0", "--elastic", "0", "--noise", "0mm"]
    files = ["--out", str(tmp_path / "seen.csv"), "--truth", str(tmp_path / "truth.json")]
    with pytest.raises(SystemExit) as ended:
        main([*command, *files, "--cycles", "2"])
    assert ended.value.code in (0, None)
    truth = json.loads((tmp_path / "truth.json").read_text())
    robot = Robot.from_urdf(URDF)
    columns = dict.fromkeys((*robot.joint_names, "pass"), "number") | dict.fromkeys(("cx", "cy", "cz"), "length")
    table = read_columns(tmp_path / "seen.csv", columns | {"feature": "name", "point": "name"})
    q = np.column_stack([table[name] for name in robot.joint_names])
    # Kinematics of the URDF, as the machine has no errors.
    tips = TrueMachine.from_urdf(URDF, tip=robot.tip).tip(q)
    seen = np.column_stack([table[name] for name in ("cx", "cy", "cz")])
    camera = tips @ np.array(truth["T_tip_camera"])
    places = np.einsum("nij,nj->ni", camera[:, :3, :3], seen) + camera[:, :3, 3]
    base_part = np.array(truth["part"]["T_base_part"])
    places = (places - base_part[:3, 3]) @ base_part[:3, :3]
    kinds = {"hole": "circle", "ball": "sphere"}
    found = FeatureSet.fit(kinds, table["feature"].astype(str), places, 1e-12 * np.eye(3 * len(places)))

    for name, fit in found.fits.items():
        true = truth["part"]["features"][name]
        assert fit.position == pytest.approx(true["position_m"], abs=1e-7)
        assert 2.0 * fit.radius == pytest.approx(true["diameter_m"], abs=1e-7)
        assert true["diameter_m"] != pytest.approx(0.02 if name == "hole" else 0.03, abs=1e-7)
    assert np.unique(table["pass"]).tolist() == [1, 2]


REFUSED = {
    "sensor": (["--sensor", "position"], 2),
    "poses of a table": (["--at", "poses.csv"], 2),
    "deviation alone": (["--part-deviation", "1mm"], 2),
}


@pytest.mark.parametrize("case", REFUSED)
def test_options_that_have_nothing_to_do_with_a_part_are_refused(case: str, tmp_path: Path) -> None:
    """As wrong usage."""
    options, code = REFUSED[case]
    part = tmp_path / "part.toml"
    part.write_text(PART)
    features = [] if case == "deviation alone" else ["--features", str(part)]
    with pytest.raises(SystemExit) as ended:
        main(["simulate", URDF, *features, *options, "--poses", "3", "--out", str(tmp_path / "out.csv")])

    assert ended.value.code == code


def test_a_feature_without_nominals_is_refused(tmp_path: Path) -> None:
    """As it has no place."""
    part = tmp_path / "part.toml"
    part.write_text('[feature.a]\nkind = "circle"\nnominal_mm = 3\n')
    with pytest.raises(SystemExit) as ended:
        main(["simulate", URDF, "--features", str(part), "--out", str(tmp_path / "out.csv")])
    assert ended.value.code == 3
    with pytest.raises(BadInputError, match="more than 0"):
        TrueFeature("a", "circle", np.zeros(3), Z)
    with pytest.raises(BadInputError, match="expected one of point"):
        TrueFeature("a", "torus", np.zeros(3), Z)
