"""The pages of architecture and extension: layers are the real ones, places exist, and recipes do what they promise."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from report_cases import kuka_run
from test_layers import LAYERS, PACKAGE, SATELLITES

from pincal import Conditions, Robot, calibrate, measurements_from_arrays, satellites
from pincal.builtin import kuka_urdf_path
from pincal.calibration.calibration import Calibration
from pincal.cli import _COMMANDS
from pincal.cli import pincal as pincal_command
from pincal.errors import MeasurementError
from pincal.identify.options import Options
from pincal.measure.table import write_table
from pincal.model.chain import Chain
from pincal.model.effect_registry import EFFECTS
from pincal.model.effects import GEOMETRIC, JointOffset
from pincal.model.model import Model
from pincal.plugins import load_plugin
from pincal.report.html import SECTIONS, report_page
from pincal.report.subject import Subject
from pincal.satellites import Place
from pincal.sensors.registry import SENSORS
from pincal.simulate import TrueMachine, plan_poses
from pincal.validate.cures import TOPICS

DOCS = Path(__file__).parents[1] / "docs"
ARCHITECTURE = (DOCS / "architecture.md").read_text(encoding="utf-8")
EXTENDING = (DOCS / "extending.md").read_text(encoding="utf-8")


@pytest.fixture
def recipe(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """Return the code block of a recipe as a module of its own."""
    block = re.search(rf"<!-- recipe: {request.param} -->\n```python\n(.*?)```", EXTENDING, re.DOTALL)
    assert block is not None
    name = f"recipe_{request.param}"
    (tmp_path / f"{name}.py").write_text(block[1])
    if request.param in ("effect", "sensor"):
        yield load_plugin(str(tmp_path / f"{name}.py"))
    else:
        monkeypatch.syspath_prepend(tmp_path)
        yield import_module(name)
    sys.modules.pop(name, None)


def test_the_table_of_layers_is_the_one_that_is_enforced() -> None:
    """The layers of the page, top down, are those of the layer test, bottom up."""
    table = ARCHITECTURE.split("## The layers")[1].split("## Control flow")[0]
    told = [name for row in re.findall(r"^\| (`.*?`) \|", table, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)]
    assert [*(name for name in LAYERS if name != "__main__"), *SATELLITES] == told


def test_every_place_that_the_page_names_exists() -> None:
    """Files stand where the page says, and functions in them."""
    nouns = re.findall(r"`([a-z_]+(?:/[a-z_]+)*\.py|[a-z_]+(?:/[a-z_]+)+(?:\.[A-Za-z_]+)?/?)`", ARCHITECTURE + EXTENDING)
    root = PACKAGE.parent
    for place in nouns:
        path, _, name = place.partition(".") if not place.endswith(".py") else (place.removesuffix(".py"), "", "")
        found = [
            p for top in (PACKAGE, root) for p in (top / f"{path}.py", top / path / "__init__.py", top / path) if p.exists()
        ]
        assert found, place
        if name and found[0].is_file():
            assert re.search(rf"\b{name}\b", found[0].read_text(encoding="utf-8")), place


@pytest.mark.parametrize("recipe", ["effect"], indirect=True)
def test_the_recipe_of_an_effect(recipe: ModuleType, kuka: Robot) -> None:
    """It is known by its name, and its Jacobian is that of its predictions."""
    assert EFFECTS.known()["encoder_sag"] is recipe.EncoderSag
    chain, at = Chain.of(kuka), Conditions.at(kuka.random_configurations(5, np.random.default_rng(0)))
    model = Model(chain, (recipe.EncoderSag("joint_2"),))
    poses, jacobian = model.linearise(np.array([1e-3]), at)
    ends = [model.predict(np.array([value]), at)[:, :, 3] for value in (1e-3 - 1e-5, 1e-3 + 1e-5)]

    assert np.abs(jacobian[:, :, 0] - (ends[1] - ends[0]) / 2e-5).max() < 1e-7
    assert poses.shape == (5, 3, 4)


@pytest.mark.long
@pytest.mark.first
def test_an_effect_in_a_file_of_its_own_passes_the_tests_of_the_house(tmp_path: Path) -> None:
    """The file of the page, added to a copy of the project as the page says, is as good as any other of the catalogue."""
    root = PACKAGE.parent
    for folder in ("pincal", "tests", "urdf"):
        # With what was compiled of it, which stays valid: files are copied with their times.
        shutil.copytree(root / folder, tmp_path / folder)
    shutil.copy(root / "pyproject.toml", tmp_path)
    block = re.search(r"<!-- recipe: catalogue -->\n```python\n(.*?)```", EXTENDING, re.DOTALL)
    assert block is not None
    catalogue = tmp_path / "pincal" / "model" / "catalogue"
    (catalogue / "encoder_sag.py").write_text(block[1], encoding="utf-8")
    _edit(
        catalogue / "__init__.py",
        ("from pincal.model.catalogue.environment", "from pincal.model.catalogue.encoder_sag import EncoderSag\n"),
        ("    GearRatio,\n    TransmissionError,", "    EncoderSag,\n"),
    )
    _edit(
        tmp_path / "tests" / "test_catalogue.py",
        ("from pincal.model.catalogue import", "from pincal.model.catalogue.encoder_sag import EncoderSag\n"),
        ('    "gear_ratio": lambda', '    "encoder_sag": lambda j: EncoderSag(j[1]),\n'),
    )
    files = ["tests/test_house.py", "tests/test_layers.py", "tests/test_effect_names.py", "tests/test_catalogue.py"]
    chosen = "test_house or test_layers or test_effect_names or encoder_sag or every_effect or names_of_their_own"
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "long or not long", "-k", chosen, *files],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    passed = re.search(r"(\d+) passed", done.stdout)

    assert done.returncode == 0, done.stdout[-3000:]
    assert passed is not None and int(passed[1]) > 30


@pytest.mark.long
def test_a_column_is_one_field(tmp_path: Path) -> None:
    """Tables, fits, models, checks of a robot by ``pincal design --check`` and diagnoses know it, and no other file does."""
    done = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("column_case.py")), str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )

    assert done.returncode == 0, done.stderr[-3000:]
    assert (tmp_path / "check.csv").exists()


def _edit(file: Path, *insertions: tuple[str, str]) -> None:
    """Insert texts before others."""
    text = file.read_text(encoding="utf-8")
    for before, inserted in insertions:
        assert text.count(before) == 1, before
        text = text.replace(before, inserted + before)
    file.write_text(text, encoding="utf-8")


@pytest.mark.parametrize("recipe", ["sensor"], indirect=True)
def test_the_recipe_of_a_sensor(recipe: ModuleType, kuka: Robot) -> None:
    """Heights over a plate find the joint offsets that they can see."""
    rng = np.random.default_rng(3)
    machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0").draw_errors(
        rng, sigma_length=0.0, sigma_angle=0.0, sigma_offset=1e-3
    )
    q = plan_poses(machine.arm, 80, rng)
    tips = machine.tip(q)
    height = tips[:, 2, 3] + tips[:, 2, :3] @ (0.1, 0.05, 0.2) + 0.7
    table = measurements_from_arrays(kuka.joint_names, q, height=height)
    fit = calibrate(kuka, table, Options(effects=(JointOffset(),)))

    assert SENSORS.known()["height"] is recipe.HeightGauge and table.kind == "height"
    assert np.abs(fit.fit.station.residuals(fit.values)).max() < 1e-9


@pytest.mark.long
@pytest.mark.parametrize("recipe", ["hypothesis"], indirect=True)
def test_the_recipe_of_a_hypothesis(recipe: ModuleType, kuka: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """One more topic is all it takes for a table to be refused with its words; a sound table has none of it."""
    rng = np.random.default_rng(3)
    machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0").draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    q = plan_poses(machine.arm, 60, rng)
    position = machine.tip(q)[:, :3, 3] + 5e-5 * rng.normal(size=(60, 3))
    wrong, sound = (measurements_from_arrays(kuka.joint_names, rows, position=position) for rows in (q[::-1], q))
    # Other zeros, signs and lengths explain nothing of either, and take time to try.
    monkeypatch.setattr("pincal.validate.trials.zero_shifts", lambda *_: {})
    monkeypatch.setattr("pincal.validate.trials.Trials.described", lambda *_, **__: None)
    geometry = Options(effects=GEOMETRIC)
    words = "the rows of the joints appear to be in reverse order: .* reverse them and run again"

    with pytest.raises(MeasurementError, match="Are units, joint zeros"):
        calibrate(kuka, wrong, geometry)
    monkeypatch.setattr("pincal.validate.trials.TOPICS", (*TOPICS, recipe.orders))
    with pytest.raises(MeasurementError, match=words):
        calibrate(kuka, wrong, geometry)
    assert len(calibrate(kuka, sound, geometry).problem) == 60


@pytest.mark.parametrize("recipe", ["verb"], indirect=True)
def test_the_recipe_of_a_verb(
    recipe: ModuleType, kuka: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line makes it a verb of the command, with help and typed errors."""
    monkeypatch.setitem(_COMMANDS, "ranges", f"{recipe.__name__}:ranges")
    q = np.linspace(-0.5, 0.5, 12)[:, None] * np.ones(6)
    columns = dict(zip(kuka.joint_names, q.T, strict=True)) | dict.fromkeys("xyz", np.ones(12))
    write_table(tmp_path / "table.csv", columns)
    code = pincal_command.main(args=["ranges", str(kuka_urdf_path()), str(tmp_path / "table.csv")], standalone_mode=False)

    assert code == 0
    assert "joint_1: -0.500 to 0.500" in capsys.readouterr().out


@pytest.mark.parametrize("recipe", ["section"], indirect=True)
def test_the_recipe_of_a_section(recipe: ModuleType, kuka: Robot) -> None:
    """It has its place and its link on the page."""
    run = kuka_run(kuka, 60)
    page = report_page(Subject(run, {"inputs": {}}), layout=(SECTIONS[0], recipe.coverage))

    assert f"{run.n_poses('train')} poses were fitted." in page and 'href="#coverage"' in page


@pytest.mark.parametrize("recipe", ["satellite"], indirect=True)
def test_the_recipe_of_a_satellite(recipe: ModuleType, kuka: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What it hands in is found in its place after that of pincal's own, and does what it says."""
    known = satellites._declarations()
    monkeypatch.setattr(satellites, "_declarations", lambda: (*known, recipe.HANDED_IN))
    *_, write = Place[Callable[[Path, Calibration], None]]("views").all()
    run = kuka_run(kuka, 60)
    write(tmp_path, run)

    assert (tmp_path / "poses.txt").read_text() == str(run.n_poses("train"))


def test_the_table_of_places_is_complete() -> None:
    """The page names each place of the code, satellites hand in at these alone, and all that they hand in exists."""
    table = EXTENDING.split("## Add a satellite")[1].split("## Add an export")[0]
    told = re.findall(r'^\| `"(\w+)"` \|', table, re.MULTILINE)
    code = "".join(path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py") if path.name != "satellites.py")
    used = {name for handed_in in satellites._declarations() for name in handed_in}

    assert sorted(told) == sorted(re.findall(r'\bPlace(?:\[.*?\]+)?\("(\w+)"\)', code)) == sorted(used)
    assert all(len(tuple(Place[object](name).all())) == len(Place[object](name).names()) > 0 for name in told)
