"""An effect from outside the package goes through every verb by the command line, and is found where it was put."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.cli import pincal as pincal_command
from pincal.errors import BadInputError, ModelFileError
from pincal.measure.table import write_table
from pincal.model.effect_registry import EFFECTS
from pincal.model.effects import JointOffset

PLUGIN = Path(__file__).parents[1] / "examples" / "hose_pull.py"
NOISE, POSES = 5e-5, 200
PULL = 1e-4  # turn of joint 5 when joint 4 has turned by one radian [rad]


@dataclass(frozen=True)
class Scene:
    """Files of a simulated robot whose joint 5 is pulled by a hose."""

    folder: Path

    def run(self, *arguments: str) -> None:
        """Run a command in this folder with the plugin; raises as the command does."""
        code = pincal_command.main(args=[*arguments, "--plugin", str(PLUGIN)], standalone_mode=False)
        assert not code, arguments

    def read(self, name: str) -> dict[str, object]:
        """Return a JSON file of this folder."""
        return dict(json.loads((self.folder / name).read_text()))


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene]:
    """Write a robot and two tables; forget the plugin again afterwards."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(5)
    machine = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    machine = machine.draw_errors(rng, sigma_length=3e-4, sigma_angle=3e-4, sigma_offset=3e-4)
    (tmp_path / "robot.urdf").write_bytes(kuka_urdf_path().read_bytes())
    for name in ("fit.csv", "new.csv"):
        q = sim.plan_poses(machine.arm, POSES, rng)
        # The joint stands where its drive does, and where the hose has pulled it.
        pulled = q.copy()
        pulled[:, 4] += PULL * q[:, 3] ** 2
        tips = machine.tip(pulled)
        position = tips[:, :3, 3] + tips[:, :3, :3] @ (0.1, 0.05, 0.15) + NOISE * rng.standard_normal((POSES, 3))
        write_table(tmp_path / name, dict(zip((*machine.names, "x", "y", "z"), (*q.T, *position.T), strict=True)))
    before = dict(EFFECTS.known())
    yield Scene(tmp_path)
    EFFECTS._classes.clear()
    EFFECTS._classes.update(before)
    sys.modules.pop("hose_pull", None)


@pytest.mark.long
def test_an_effect_goes_through_every_verb(scene: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    """Its detectable size is told; it is found, named and reported; its model validates, predicts and is drawn."""
    scene.run("check", "robot.urdf", "fit.csv", "--noise", "0.05mm", "--verbose")
    assert "hose_pull" in capsys.readouterr().out
    scene.run("discover", "robot.urdf", "fit.csv", "--out", "out", "--noise", "0.05mm", "--stability", "0", "--view")
    (found,) = scene.read("out/discovery.json")["effects"]  # type: ignore[misc]
    assert (found["effect"], found["joint"], found["source"]) == ("hose_pull", "joint_5", "joint_4")
    pull = found["parameters"]["joint_5.hose"]
    assert abs(pull["value"] - PULL) < 4.0 * pull["sigma"] < 0.2 * PULL
    assert "a hose that is too short pulls at the joint" in (scene.folder / "out" / "report.html").read_text()
    scene.run("validate", "out/model.json", "new.csv", "--max-error", "0.1mm")
    scene.run("predict", "out/model.json", "new.csv", "--out", "predicted.csv")
    assert "sigma_x" in (scene.folder / "predicted.csv").read_text().splitlines()[0]
    scene.run("view", "out/model.json", "new.csv", "--html", "view.html")
    assert "hose_pull" in (scene.folder / "view.html").read_text()


@pytest.mark.long
def test_an_effect_from_outside_is_fitted_on_request(scene: Scene) -> None:
    """``--add`` puts it into a calibration, and the file of the model says which module it comes from."""
    fit = ("calibrate", "robot.urdf", "fit.csv", "--out", "out", "--model", "geometric", "--add", "hose_pull:joint_5")
    scene.run(*fit)
    found = {entry["name"]: entry for entry in scene.read("out/result.json")["parameters"]}  # type: ignore[attr-defined]
    assert abs(found["joint_5.hose"]["value"] - PULL) < 4.0 * found["joint_5.hose"]["sigma"]
    entry = scene.read("out/model.json")["stations"][0]["effects"][-1]  # type: ignore[index]
    assert entry == {"name": "hose_pull", "module": "hose_pull", "joint": "joint_5", "wound": "joint_4"}
    scene.run("validate", "out/model.json", "new.csv", "--max-error", "0.1mm")
    EFFECTS._classes.pop("hose_pull")
    with pytest.raises(ModelFileError, match=r"effect 'hose_pull' is not pincal's own.*--plugin hose_pull"):
        pincal_command.main(args=["validate", "out/model.json", "new.csv"], standalone_mode=False)
    with pytest.raises(BadInputError, match=r"effect 'hose_pull:joint_5': unknown; expected one of .*gear_ratio"):
        pincal_command.main(args=[*fit], standalone_mode=False)


def test_attributes_of_the_release_before_are_read_with_a_warning() -> None:
    """A plugin that says ``alike`` and ``looks`` has the same prior and the same correction of its p-value."""
    with pytest.warns(DeprecationWarning, match=r"Effect\.(looks|alike) is now Effect\.(trials|shares_scale)"):

        class Old(JointOffset):
            alike = True
            looks = property(lambda self: 7.0)

    assert Old.shares_scale
    assert Old().trials == 7.0
