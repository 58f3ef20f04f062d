"""An effect that lives outside the package goes through the command line like pincal's own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pincal.builtin import kuka_urdf_path
from pincal.measure.table import write_table
from pincal.robot.robot import Robot
from pincal.simulate import TrueMachine

PLUGIN = '''
"""A hose that pulls at a joint when another one winds it up."""

from dataclasses import dataclass
from typing import ClassVar

from pincal.model.effect import Candidate, Discoverable, Locus, Term
from pincal.model.registry import register_effect
from pincal.parameters import Parameter


@register_effect
@dataclass(frozen=True)
class HosePull(Discoverable):
    joint: str
    wound: str
    name: ClassVar[str] = "hose_pull"
    meaning: ClassVar[str] = "a hose that is too short pulls at the joint"

    @property
    def locus(self):
        return Locus(self.joint, "drive", self.wound)

    @classmethod
    def candidates(cls, situation):
        yield from (Candidate(cls(*pair)) for pair in zip(situation.joints[1:], situation.joints))

    def parameters(self, chain):
        return (Parameter(f"{self.joint}.hose", "rad", self.name, nominal=0.0, size=1e-3),)

    def terms(self, chain, conditions, moments):
        names = chain.robot.joint_names
        angle = conditions.q[:, names.index(self.wound)]
        return (Term(0, int(chain.drives[names.index(self.joint)]), angle**2),)
'''
# Turn at one radian of winding [rad].
PULL = 2e-5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the plugin and a table of a robot on which the hose pulls at joint 5."""
    folder = tmp_path_factory.mktemp("hose")
    (folder / "hose.py").write_text(PLUGIN)
    robot = Robot.from_urdf(kuka_urdf_path())
    rng = np.random.default_rng(0)
    q = robot.random_configurations(80, rng)
    bent = q.copy()
    bent[:, 4] += PULL * q[:, 3] ** 2
    machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    tips = machine.tip(bent)[:, :3]
    position = tips[:, :, 3] + tips[:, :, :3] @ np.array([0.1, 0.05, 0.2]) + 1e-5 * rng.standard_normal((80, 3))
    columns = dict(zip(robot.joint_names, q.T, strict=True)) | dict(zip("xyz", position.T, strict=True))
    write_table(folder / "table.csv", columns)
    return folder


def pincal(folder: Path, *arguments: str, code: int = 0) -> tuple[dict[str, Any], str]:
    """Run the command in a process of its own and return its JSON, if any, and what it says on stderr."""
    run = subprocess.run(
        [sys.executable, "-m", "pincal", *arguments, "--json"], cwd=folder, capture_output=True, text=True, check=False
    )
    assert run.returncode == code, run.stderr
    return json.loads(run.stdout) if run.stdout else {}, run.stderr


def test_an_effect_from_outside_is_known_to_every_verb(folder: Path) -> None:
    """It is checked, fitted, explained, saved, validated and predicted with; without its module a message names that."""
    robot, plugin = str(kuka_urdf_path()), ("--plugin", "hose")
    checked, _ = pincal(folder, "check", robot, "table.csv", "--model", "geometric", *plugin)
    assert "hose_pull" in {entry["effect"] for entry in checked["detectable"]["effects"]}

    fit = ("calibrate", robot, "table.csv", "--out", "out", "--model", "geometric", "--add", "hose_pull:joint_5")
    result, _ = pincal(folder, *fit, *plugin)
    found = next(entry for entry in result["parameters"] if entry["name"] == "joint_5.hose")
    assert abs(found["value"] - PULL) < 4 * found["sigma"]
    assert "a hose that is too short" in (folder / "out" / "report.html").read_text()
    entry = json.loads((folder / "out" / "model.json").read_text())["model"]["effects"][-1]
    assert entry == {"name": "hose_pull", "module": "hose", "joint": "joint_5", "wound": "joint_4"}

    valid, _ = pincal(folder, "validate", "out/model.json", "table.csv", *plugin)
    assert valid["error"]["calibrated"]["test"]["mean_mm"] < 0.1
    pincal(folder, "predict", "out/model.json", "table.csv", "--out", "poses.csv", *plugin)
    pincal(folder, "view", "out/model.json", "table.csv", "--html", "view.html", *plugin)
    assert "hose_pull of joint_5 by joint_4" in (folder / "view.html").read_text()
    _, message = pincal(folder, "validate", "out/model.json", "table.csv", code=3)
    assert "effect 'hose_pull' is not pincal's own" in message and "--plugin hose" in message


def test_an_unknown_effect_is_told_with_the_known_ones(folder: Path) -> None:
    """Without the plugin its name is none, and the message lists those that there are."""
    fit = ("calibrate", str(kuka_urdf_path()), "table.csv", "--out", "no", "--add", "hose_pull:joint_5")
    _, message = pincal(folder, *fit, code=3)
    assert "effect 'hose_pull:joint_5': unknown; expected one of" in message and "gear_ratio" in message
