"""Which robot a model is of: stated once, carried into every file, and compared where it is stated again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from command_line import run
from test_cli import URDF, columns_of
from test_export import calibrated_of

from pincal import Robot, export_model, load_model
from pincal.builtin import kuka_urdf_path
from pincal.calibration.fitted_robot import FittedRobot
from pincal.errors import BadInputError, ModelFileError
from pincal.identity import KEYS, Identity
from pincal.io.urdf_text import with_comment
from pincal.measure.table import write_table
from pincal.model.chain import Chain
from pincal.model.effects import BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.parameters import FRAME_SYMBOLS

STATED = Identity.of(
    {
        "robot": "2021-17",
        "controller": "C4-9",
        "instrument": "tracker 7512",
        "certificate": "4711 D-K-15070",
        "operator": "A. Smith",
        "date": "2026-11-28",
        "temperature": "20.5 degC",
        "place": "hall 3",
        "laboratory": "Metrology, Example Ltd",
        "customer": "Body shop",
        "country": "DE",
        "note.order": "88-12",
    }
)


@pytest.fixture(scope="module")
def known(kuka: Robot) -> FittedRobot:
    """Return the KUKA of the paper with a base and a tool frame of its own, and an identity."""
    model = Model(Chain.of(kuka), (BaseFrame(), ToolFrame(FRAME_SYMBOLS)))
    found = calibrated_of(model, np.full(model.n_parameters, 1e-3))
    return replace(found, identity=STATED)


@pytest.fixture
def saved(tmp_path: Path, known: FittedRobot) -> Path:
    """Return its file."""
    known.save(tmp_path / "model.json")
    return tmp_path / "model.json"


@pytest.fixture
def poses(tmp_path: Path, kuka: Robot) -> Path:
    """Return a table of joint positions."""
    q = kuka.random_configurations(3, np.random.default_rng(0))
    write_table(tmp_path / "poses.csv", dict(zip(kuka.joint_names, q.T, strict=True)))
    return tmp_path / "poses.csv"


def test_a_model_file_keeps_every_entry(saved: Path) -> None:
    """What was stated is read back as it was, under the key ``id`` beside the provenance."""
    assert set(json.loads(saved.read_text())["id"]) == {*KEYS, "note"}
    assert load_model(saved).identity == STATED


def test_a_model_without_identity_is_as_before(tmp_path: Path, known: FittedRobot) -> None:
    """Nothing stated leaves no key, and a file without the key states nothing."""
    replace(known, identity=Identity()).save(tmp_path / "model.json")

    assert "id" not in json.loads((tmp_path / "model.json").read_text())
    assert not load_model(tmp_path / "model.json").identity


def test_an_invalid_identity_in_a_file_is_refused(saved: Path) -> None:
    """A file that was edited wrongly names the value and what is expected."""
    content = json.loads(saved.read_text())
    saved.write_text(json.dumps(content | {"id": {"robot": "17", "date": "28.11.2026"}}))

    with pytest.raises(ModelFileError, match=r"id.*28\.11\.2026.*YYYY-MM-DD"):
        load_model(saved)


@pytest.mark.parametrize(
    ("key", "text", "expected"),
    [
        ("robt", "17", "expected one of robot"),
        ("note.", "17", "id.note.NAME"),
        ("robot", " ", "expected a line of text"),
        ("robot", "1\n2", "expected a line of text"),
        ("robot", "1" * 201, "at most 200 characters"),
        ("date", "28.11.2026", "YYYY-MM-DD"),
        ("date", "2026-02-30", "YYYY-MM-DD"),
        ("temperature", "warm", "expected deg C"),
        ("temperature", "-300", "expected deg C"),
        ("country", "Germany", "two capital letters"),
    ],
)
def test_what_is_none_is_refused(key: str, text: str, expected: str) -> None:
    """Keys are known, dates are days, temperatures possible: the error says what is expected."""
    with pytest.raises(BadInputError, match=expected):
        Identity.of({key: text})


def test_later_statements_add_to_earlier_ones() -> None:
    """New rows may have another operator; the robot stays the same, and so do notes."""
    later = Identity.of({"operator": "B. Jones", "note.shift": "2"})

    found = later.over(STATED)

    assert (found.robot, found.operator, found.note) == ("2021-17", "B. Jones", {"order": "88-12", "shift": "2"})


def test_circumstances_of_a_calibration_are_not_those_of_a_part() -> None:
    """Robot, instrument, laboratory and notes last; operator, day, place and temperature are of the readings."""
    entries = {key: "x" for key in KEYS} | {"date": "2026-11-29", "temperature": "20.5", "country": "DE", "note.order": "1"}
    stated = Identity.of(entries)

    lost = {key for key, _, _ in stated.entries()} - {key for key, _, _ in stated.lasting.entries()}

    assert lost == {"operator", "date", "place", "temperature"}
    assert set(stated.lasting.entries()) < set(stated.entries())


@pytest.mark.parametrize(("one", "other", "same"), [("A 1", "a1", True), ("A 1", "A 2", False), ("A 1", "", True)])
def test_serial_numbers_are_compared_without_case_and_blanks(one: str, other: str, same: bool) -> None:
    """A blank is no other robot, and who says nothing does not contradict."""
    assert Identity(robot=one).is_of(Identity(robot=other)) is same


@pytest.mark.parametrize("verb", ["predict", "compensate"])
def test_the_output_says_of_which_robot_it_is(verb: str, saved: Path, poses: Path, capsys, tmp_path: Path) -> None:
    """A corrector for the wrong robot does not look the same; programs read it, too."""
    assert run(verb, saved, poses, "--out", tmp_path / "out.csv", "--quiet") == 0
    assert "for robot 2021-17, controller C4-9" in capsys.readouterr().out

    assert run(verb, saved, poses, "--out", tmp_path / "out.csv", "--quiet", "--json") == 0
    assert json.loads(capsys.readouterr().out)["id"]["robot"] == "2021-17"


@pytest.mark.parametrize("verb", ["predict", "compensate", "validate", "diagnose", "update", "export"])
def test_the_model_of_another_robot_is_refused(verb: str, saved: Path, poses: Path, capsys, tmp_path: Path) -> None:
    """The refusal has both serial numbers, and nothing is written."""
    out = [] if verb == "validate" else ["--out", tmp_path / ("out.csv" if verb[0] in "pc" else "out")]
    words = ["--page", tmp_path / "page.html"] if verb == "export" else [poses, *out]

    assert run(verb, saved, *words, "--set", "id.robot=2021-18") == 3

    error = capsys.readouterr().err
    assert "is of robot 2021-17" in error and "robot 2021-18" in error
    assert sorted(file.name for file in tmp_path.iterdir()) == ["model.json", "poses.csv"]


def test_a_model_that_states_no_robot_is_said_to_be_unchecked(
    known: FittedRobot, poses: Path, capsys, tmp_path: Path
) -> None:
    """A serial number that can't be compared is a note; another controller is one, too."""
    path = tmp_path / "model.json"
    replace(known, identity=Identity(controller="C4-9")).save(path)
    stated = ["--set", "id.robot=2021-18", "--set", "id.controller=C4-10"]

    assert run("predict", path, poses, "--out", tmp_path / "out.csv", *stated) == 0

    error = capsys.readouterr().err
    assert "not checked that it is of 2021-18" in error
    assert "the controller is C4-10, at the calibration it was C4-9" in error


@pytest.mark.parametrize("given", ["robot=1", "id.robt=1", "id.robot", "id.date=today"])
def test_a_misspelt_entry_is_wrong_usage(given: str, saved: Path, poses: Path, tmp_path: Path) -> None:
    """It is refused before any work is done."""
    assert run("predict", saved, poses, "--out", tmp_path / "out.csv", "--set", given) == 2


@pytest.mark.parametrize("name", ["urdf", "mjcf", "dh", "c", "python", "page", "frames"])
def test_every_export_says_of_which_robot_it_is(name: str, known: FittedRobot) -> None:
    """Another robot's file of the same type differs in more than its numbers."""
    exported = export_model(known, name)

    assert "robot 2021-17, controller C4-9" in exported.text
    assert "2021-17" not in export_model(replace(known, identity=Identity()), name).text


@pytest.mark.parametrize("start", [b"", b'<?xml version="1.0"?>\n', b'\xef\xbb\xbf<?xml version="1.0"?>\r\n'])
def test_a_comment_leaves_the_urdf_as_it_was(start: bytes) -> None:
    """The declaration stays first, and the rest is unchanged to the byte, whatever the comment."""
    urdf = start + kuka_urdf_path().read_bytes().split(b"?>", 1)[1].lstrip()

    found = with_comment(urdf, "robot -- Ä--")

    assert found.startswith(start)
    assert ET.canonicalize(found.decode("utf-8-sig")) == ET.canonicalize(urdf.decode("utf-8-sig"))
    assert with_comment(urdf, "") == urdf


@pytest.mark.long
def test_a_calibration_carries_what_is_stated_into_all_its_files(tmp_path: Path, kuka: Robot) -> None:
    """The folder of a calibration, a diagnosis with its model, and an updated model name the robot."""
    from test_calibrate import paper_table

    for name, seed in (("old.csv", 0), ("new.csv", 1)):
        write_table(tmp_path / name, columns_of(paper_table(kuka, 40, seed, 5e-5)))
    stated = ["--set", "id.robot=2021-17", "--set", "id.operator=A. Smith"]
    out = tmp_path / "out"
    assert run("calibrate", URDF, tmp_path / "old.csv", "--out", out, "--quiet", *stated) in (0, 4)
    entries = {"robot": "2021-17", "operator": "A. Smith"}
    assert json.loads((out / "model.json").read_text())["id"] == entries
    assert json.loads((out / "result.json").read_text())["id"] == entries
    assert "2021-17" in (out / "report.html").read_text()
    assert b"<!-- robot 2021-17 -->" in (out / "calibrated.urdf").read_bytes()

    found = tmp_path / "diagnosis"
    later = ["--set", "id.operator=B. Jones"]
    run("diagnose", out / "model.json", tmp_path / "new.csv", "--out", found, "--quiet", *later)
    for file in ("diagnosis.json", "model.json"):
        assert json.loads((found / file).read_text())["id"] == entries | {"operator": "B. Jones"}
    assert "robot 2021-17" in (found / "report.html").read_text()


@pytest.mark.long
def test_a_store_names_a_machine_by_the_serial_number_of_its_model(tmp_path: Path, saved: Path) -> None:
    """Files called model.json in any folder are of the robot that they state."""
    pytest.importorskip("duckdb")
    assert run("fleet", "add", tmp_path / "store", saved) == 0

    assert [path.name for path in (tmp_path / "store" / "models").iterdir()] == ["machine=2021-17"]
