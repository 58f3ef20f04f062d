"""The cell file, ``cell.toml``: what commands need to know of a robot cell beside the tables.

.. code-block:: toml

    robot = "ur10.urdf"
    tip = "tool0"
    noise = "0.05mm"
    points = "sockets.csv"

    [id]
    robot = "2021300117"

A key is named like the option whose value it is, with underscores, and its value is what the
option takes: text, a number, or a list. Names of files are relative to the cell file. The table
``id`` states robot, instrument and circumstances (:mod:`pincal.identity`).
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

from pincal.atomic import replacing
from pincal.errors import BadInputError, RobotFileError
from pincal.identity import KEYS as ID_KEYS
from pincal.identity import Identity
from pincal.io.keyed_table import read_toml, require_known
from pincal.units import plain_numbers

CELL_NAME = "cell.toml"
"""Name of a cell file beside tables."""
NO_CELL = "none"
"""Word in place of a cell file, for none."""
IDENTITY = "id"
"""Table of the file that states the identity."""


class CellKey(NamedTuple):
    """A key of a cell file.

    Attributes:
        meaning: of its value, a line.
        example: a value, in TOML.
    """

    meaning: str
    example: str


_ROBOT = {
    "robot": CellKey("URDF or xacro file, or the name of a robot of the library", '"robot.urdf"'),
    "base": CellKey("first link of the arm; else the root of the URDF", '"base_link"'),
    "tip": CellKey("last link of the arm; else told by the joints of the table", '"tool0"'),
    "from": CellKey("link that carries the instrument; else the base", '"head_camera"'),
    "sign": CellKey("joints whose sign is opposite to that of the URDF", '["joint_4"]'),
    "coupling": CellKey("coupled joints", '["joint_3=+joint_2"]'),
    "rest": CellKey("joints that stand still and have no column", '["torso=0.1m"]'),
    "beside": CellKey("further robots", '["right=ur10.urdf@1.5m,0,0,0,0,180deg"]'),
    "xacro_arg": CellKey("arguments of a xacro file", '["ur_type:=ur5e"]'),
    "mass": CellKey("total mass of the robot with its base [kg], from its data sheet", "235"),
    "type": CellKey("prior knowledge of this type of robot, by pincal fleet learn", '"type.json"'),
    "tool": CellKey("target in the tip frame [m], if known; else identified", "[0, 0, 0.1]"),
    "payload": CellKey("mass at the tip [kg] in rows without a column payload", "80"),
    "payload_com": CellKey("its centre of mass in the tip frame [m]", "[0, 0, 0.12]"),
}
_INSTRUMENT = {
    "noise": CellKey(
        "standard deviation of one coordinate: decides what is significant, and the verdict",
        '"0.05mm"',
    ),
    "noise_angle": CellKey("the same of one orientation component", '"0.1mrad"'),
    "instrument": CellKey(
        "noise by range and direction: a name, or maximum permissible errors",
        '"leica_at960"',
    ),
    "points": CellKey("table of known sockets, anchors or points of an object", '"points.csv"'),
    "points_in": CellKey("frame of these points: own or base", '"own"'),
    "distances": CellKey("table of known distances of these points", '"distances.csv"'),
    "socket_distance": CellKey("known distances, as a list", '[["A", "B", "50mm"]]'),
    "anchor": CellKey("fixed point of a distance meter in the base frame [m]", "[1, 0, 0.5]"),
    "camera": CellKey("parameters of the camera", '"camera.json"'),
    "gravity": CellKey("gravity in the base frame [m/s^2], if not along -z", "[0, 0, 9.81]"),
}
KEYS_OF_ROBOT = frozenset(_ROBOT)
"""Keys that are true of one robot, and not of another at the same instrument."""
CELL_KEYS: dict[str, CellKey] = {**_ROBOT, **_INSTRUMENT}
"""All keys but the table ``id``, in the order of the file."""
_OF_FILES = frozenset(("type", "points", "distances", "camera"))
_OF_NUMBERS = frozenset(("mass", "tool", "payload", "payload_com", "anchor", "gravity"))
_HEADINGS = {"robot": "Robot, tool and load", "noise": "Instrument and what it looks at"}


@dataclass(frozen=True)
class CellFile:
    """A cell file.

    Attributes:
        path: the file.
        entries: values by key, as on a command line: text, or a tuple of these; files relative to
            the current folder.
        identity: what is stated of robot, instrument and circumstances, by key.
    """

    path: Path
    entries: Mapping[str, Any]
    identity: Mapping[str, str]

    @classmethod
    def read(cls, path: Path) -> CellFile:
        """Read a file.

        Raises:
            BadInputError: if it can't be read, for an unknown key, or a value that is none.
        """
        content = read_toml(path, f"a cell file in TOML; {NO_CELL} in place of its name for none")
        require_known(str(path), content, (*CELL_KEYS, IDENTITY))
        stated = content.pop(IDENTITY, {})
        if not isinstance(stated, dict):
            raise BadInputError(f"{path}: {IDENTITY} = {stated!r}; expected a table [{IDENTITY}]")
        entries = {key: _words(f"{path}: {key}", value) for key, value in content.items()}
        robot = entries.get("robot", ".urdf")
        if not isinstance(robot, str) or not robot or (path.parent / robot).is_dir():
            raise BadInputError(
                f"{path}: robot = {content['robot']!r}; expected a URDF or xacro file, or the name "
                "of a robot of example-robot-data"
            )
        located = {key: _located(path.parent, key, value) for key, value in entries.items()}
        return cls(path, located, _identity(path, stated))

    def require_file(self, key: str) -> None:
        """Refuse a file that is not there, of a key that names one, and a robot that is neither a
        file nor one of the library.

        Raises:
            BadInputError: with the key and the file.
        """
        value = self.entries.get(key)
        if not isinstance(value, str) or not value or os.path.exists(value):
            return
        if key in _OF_FILES or (key == "robot" and (Path(value).suffix or os.sep in value)):
            raise BadInputError(
                f"{self.path}: {key} = {value!r}: there is no such file; expected one relative to "
                f"{self.path}, or another by the command line; --cell {NO_CELL} takes nothing from "
                "the cell file"
            )
        if key == "robot":
            self._require_of_library(value)

    def _require_of_library(self, name: str) -> None:
        from pincal.robot.urdf_file import find_file

        try:
            find_file(name)
        except RobotFileError as error:
            raise BadInputError(f"{self.path}: robot = {error}") from None


def _words(where: str, value: Any) -> Any:
    """Return a value as on a command line, of a list a tuple of these."""
    if isinstance(value, list):
        return tuple(_words(where, each) for each in value)
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, str | int | float):
        return str(value)
    raise BadInputError(f"{where} = {value!r}; expected text, a number, or a list of these")


def _located(folder: Path, key: str, value: Any) -> Any:
    """Return a value in which names of files are relative to the current folder."""
    if key == "beside" and isinstance(value, tuple):
        return tuple(_beside(folder, each) for each in value)
    if not isinstance(value, str):
        return value
    if key == "beside":
        return _beside(folder, value)
    if key == "robot":
        return _robot(folder, value)
    return str(folder / value) if key in _OF_FILES and value else value


def _robot(folder: Path, text: str) -> str:
    """Return the file of a robot; what is no file is the name of a robot of the library."""
    return str(folder / text) if text and (folder / text).is_file() else text


def _beside(folder: Path, text: str) -> str:
    """Return the text of a further robot with the place of its file."""
    given, at, place = text.partition("@")
    name, sign, source = given.rpartition("=")
    return f"{name}{sign}{_robot(folder, source)}{at}{place}"


def _identity(path: Path, stated: Mapping[str, Any]) -> dict[str, str]:
    """Return what a file states, notes as ``note.NAME``.

    Raises:
        BadInputError: for an unknown key, or a value that is none.
    """
    plain = {key: value for key, value in stated.items() if key != "note"}
    notes = stated.get("note", {})
    if not isinstance(notes, dict):
        raise BadInputError(f"{path}: note = {notes!r}; expected note.NAME = TEXT")
    plain |= {f"note.{name}": value for name, value in notes.items()}
    found = dict[str, str]()
    for key, value in plain.items():
        words = _words(f"{path}: {IDENTITY}.{key}", value)
        if not isinstance(words, str):
            raise BadInputError(f"{path}: {IDENTITY}.{key} = {value!r}; expected a line of text")
        found[key] = words
    try:
        Identity.of(found)
    except BadInputError as error:
        raise BadInputError(f"{path}: {error}") from None
    return found


def write_cell(
    path: Path,
    given: Mapping[str, Any],
    identity: Mapping[str, str],
    *,
    by: str,
    usual: Mapping[str, str] | None = None,
) -> None:
    """Write a cell file; what is not given stands in it as a comment, to be filled in.

    Args:
        path: a file that is not there yet.
        given: values by key, as on a command line: text, or sequences of texts; files relative to
            the current folder.
        identity: what is stated, by key.
        by: the command that writes it.
        usual: values that hold without a key, by key, to be shown as comments.

    Raises:
        OutputError: if it can't be written.
    """
    text = "\n".join(_lines(path.parent, given, identity, by, usual or {})) + "\n"
    with replacing(path, advice="name another cell file by --cell") as draft:
        draft.write_text(text, encoding="utf-8")


def _lines(
    folder: Path,
    given: Mapping[str, Any],
    identity: Mapping[str, str],
    by: str,
    usual: Mapping[str, str],
) -> Iterator[str]:
    """Yield the lines of a cell file."""
    yield f"# The cell, written by {by}, and yours to edit: remove a # and fill in."
    yield "# Commands find it beside the table, or by --cell FILE. Keys are named like the options"
    yield "# (pincal calibrate --help all), which override them. Files are relative to this one."
    for key, about in CELL_KEYS.items():
        if key in _HEADINGS:
            yield f"\n# {_HEADINGS[key]}"
        known = given.get(key, usual.get(key))
        value = about.example if known is None else _written(folder, key, known)
        yield f"{'' if key in given else '# '}{key} = {value}  # {about.meaning}"
    yield f"\n# Stated in models, reports and certificates\n[{IDENTITY}]"
    for key, meaning in ID_KEYS.items():
        value = _quoted(identity.get(key, "..."))
        yield f"{'' if key in identity else '# '}{key} = {value}  # {meaning}"
    for key, value in identity.items():
        if key not in ID_KEYS:
            note = key.removeprefix("note.")
            yield f"note.{_quoted(note)} = {_quoted(value)}"


def _written(folder: Path, key: str, value: Any) -> str:
    """Return a value in TOML."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(_written(folder, key, each) for each in value)}]"
    text = str(value)
    if key in _OF_NUMBERS and (numbers := plain_numbers([text])):
        return f"{numbers[0]:.12g}"
    if key == "beside":
        given, at, place = text.partition("@")
        name, sign, source = given.rpartition("=")
        return _quoted(f"{name}{sign}{_seen_from(folder, source)}{at}{place}")
    is_file = key in _OF_FILES or key == "robot"
    return _quoted(_seen_from(folder, text) if is_file else text)


def _seen_from(folder: Path, name: str) -> str:
    """Return the name of a file relative to a folder; another text as it is."""
    if not os.path.exists(name) or os.path.isabs(name):
        return name
    return os.path.relpath(name, folder)


def _quoted(text: str) -> str:
    """Return a text as TOML writes it."""
    return json.dumps(text, ensure_ascii=False)
