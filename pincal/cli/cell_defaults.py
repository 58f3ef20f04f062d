"""What a command line leaves out, taken from the cell file and from ``--set KEY=VALUE``.

Both become Click's default values, so that they are read as on the command line, and options
override them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click

from pincal.cli.cell_file import (
    CELL_KEYS,
    CELL_NAME,
    IDENTITY,
    KEYS_OF_ROBOT,
    NO_CELL,
    CellFile,
    write_cell,
)
from pincal.errors import BadInputError, OutputError, nearest_first
from pincal.identity import Identity
from pincal.measure.table_schema import TABLE_ENDINGS
from pincal.thresholds import Count

CELL_FIELD = "cell_file"
"""Field of the option that names a cell file."""
SETTINGS = "settings"
"""Field of ``--set`` where a verb states no identity."""
ENTRIES = "entries"
"""Field of ``--set`` where a verb states an identity."""
_VARIABLE = "PINCAL_CELL"
_META = "pincal.cell"
_ROBOT_FIELD = "robot"
# Endings of robots and of models, which are no tables.
_NO_TABLES = (".urdf", ".xacro", ".xml", ".json", ".toml")
# Keys of places and distances that are known, one of which stands in place of the others.
_KNOWN_PLACES = ("points", "distances", "socket_distance")
# Fields of options that only say what is printed.
_PRINTING = ("verbose", "as_json", "quiet")
_OF_ID = f"{IDENTITY}."
# Most keys that a message lists.
_LISTED: Count = 12
_EXPECTED = "KEY=VALUE, such as noise=0.05mm or id.robot=2021300117"


@dataclass
class _Taken:
    """What a command takes from a cell file.

    Attributes:
        cell: the file; None if there is none.
        is_wanted: whether a cell file may be written where there is none.
        place: where it would be.
        keys: what it gives.
        given: what the command line gives of a cell, by key.
        identity: what the command line states, by key.
        stated: what the cell file gives of the identity, by key.
        beyond: words of the command line that no cell file holds.
        written: the cell file that the command wrote.
    """

    cell: CellFile | None
    is_wanted: bool
    place: Path
    keys: list[str] = field(default_factory=list)
    given: dict[str, Any] = field(default_factory=dict)
    identity: dict[str, str] = field(default_factory=dict)
    stated: dict[str, str] = field(default_factory=dict)
    beyond: list[str] = field(default_factory=list)
    written: Path | None = None


def filled_from_cell(
    command: click.Command,
    context: click.Context,
    words: list[str],
    *,
    keys: Mapping[str, str] | None,
    takes_identity: bool,
    identity_keys: Collection[str] | None,
) -> list[str]:
    """Return the words of a command line with what a cell file and ``--set`` give; Click's defaults
    are set.

    Args:
        command: the verb.
        context: of this call.
        words: after the verb.
        keys: keys of a cell file by the names of the parameters that they are for; None for a verb
            that reads no cell file.
        takes_identity: whether the verb has a use for an identity.
        identity_keys: what of the identity a cell file may give; None for all.

    Raises:
        BadInputError: for a cell file that can't be read or has a value that is none.
        UsageError: for a setting that there is not, or is given twice.
    """
    try:
        given, _, _ = command.make_parser(context).parse_args(list(words))
    except click.UsageError:
        # It is told when the words are read again.
        return words
    reader = _Reader(
        command,
        context,
        keys or {},
        given,
        takes_identity,
        identity_keys,
        keys is not None,
    )
    return reader.words(words)


@dataclass
class _Reader:
    """The command line of one verb.

    Attributes:
        command: the verb.
        context: of this call.
        keys: keys of a cell file by the names of parameters.
        given: what stands on the command line, as text, by the names of parameters.
        takes_identity: whether the verb has a use for an identity.
        identity_keys: what of the identity a cell file may give; None for all.
        reads_cell: whether the verb reads a cell file.
    """

    command: click.Command
    context: click.Context
    keys: Mapping[str, str]
    given: Mapping[str, Any]
    takes_identity: bool
    identity_keys: Collection[str] | None
    reads_cell: bool

    def words(self, words: list[str]) -> list[str]:
        """Return the words with robot and identity of the cell; set the defaults."""
        taken = self._found()
        self.context.meta[_META] = taken
        defaults = dict(self._settings(taken))
        first = [str(defaults.pop(_ROBOT_FIELD))] if _ROBOT_FIELD in defaults else []
        if not first and _ROBOT_FIELD in self.keys and self._is_robot_left_out():
            first = self._robot_of(taken)
        robot = first[0] if first else self.given.get(_ROBOT_FIELD)
        if taken.cell is not None:
            defaults = dict(self._of_cell(taken, robot)) | defaults
        self.context.default_map = {**(self.context.default_map or {}), **defaults}
        self._keep(taken, robot)
        return [*first, *self._stated(taken, robot), *words]

    def _found(self) -> _Taken:
        """Return the cell file of this command line, nothing being taken from it yet."""
        named = self.given.get(CELL_FIELD) or os.environ.get(_VARIABLE, "")
        place = Path(named) if named else _beside(self._positional()) / CELL_NAME
        if named == NO_CELL:
            return _Taken(None, False, place)
        if not self.reads_cell:
            return _Taken(None, True, place)
        if named or place.is_file():
            return _Taken(CellFile.read(place), False, place)
        return _Taken(None, not place.exists(), place)

    def _positional(self) -> Iterator[str]:
        """Yield the words that are no options."""
        for parameter in self.command.params:
            if isinstance(parameter, click.Argument):
                value = self.given.get(str(parameter.name))
                for word in value if isinstance(value, tuple | list) else (value,):
                    if isinstance(word, str):
                        yield word

    def _is_robot_left_out(self) -> bool:
        """Return whether all words are tables, or there are none."""
        return all(map(_is_table, self._positional()))

    def _robot_of(self, taken: _Taken) -> list[str]:
        """Return the robot of the cell; nothing where none is needed to say what is missing.

        Raises:
            UsageError: if a table is given, and there is neither a robot nor a cell that names one.
        """
        words = list(self._positional())
        if taken.cell is not None and _ROBOT_FIELD in taken.cell.entries:
            taken.keys.append(_ROBOT_FIELD)
            taken.cell.require_file(_ROBOT_FIELD)
            return [str(taken.cell.entries[_ROBOT_FIELD])]
        if not words:
            return []
        lacks = f"{taken.place} names none"
        if taken.cell is None:
            lacks = (
                f"there is no {taken.place}" if taken.is_wanted else "no cell file is to be used"
            )
        raise click.UsageError(
            f"no robot: {words[0]} is a table, and {lacks}; expected ROBOT.urdf {words[0]}. "
            f"pincal check ROBOT.urdf {words[0]} writes a {CELL_NAME}, after which the robot may "
            "be left out",
            self.context,
        )

    def _of_cell(self, taken: _Taken, robot: Any) -> Iterator[tuple[str, Any]]:
        """Yield the parameters that the cell gives, and their values as text."""
        assert taken.cell is not None
        entries = taken.cell.entries
        is_other = self._is_other(taken.cell, robot)
        # What the command line knows of sockets and points stands in place of what the cell knows.
        states_places = any(self.keys.get(name) in _KNOWN_PLACES for name in self.given)
        for parameter in self.command.params:
            name = str(parameter.name)
            key = self.keys.get(name, "")
            if key not in entries or name == _ROBOT_FIELD or (is_other and key in KEYS_OF_ROBOT):
                continue
            if key in _KNOWN_PLACES and states_places:
                continue
            value = entries[key]
            if parameter.multiple and not isinstance(value, tuple):
                value = (value,)
            if _is_for_images(key, value) and "px" not in str(parameter.metavar):
                continue
            if name not in self.given:
                taken.cell.require_file(key)
                taken.keys.append(key)
            self._check(taken.cell, key, parameter, value)
            yield name, value

    def _is_other(self, cell: CellFile, robot: Any) -> bool:
        """Return whether a command line names another robot than the cell."""
        own = cell.entries.get(_ROBOT_FIELD)
        return _ROBOT_FIELD in self.keys and None not in (own, robot) and not _is_same(own, robot)

    def _check(self, cell: CellFile, key: str, parameter: click.Parameter, value: Any) -> None:
        """Refuse a value that the option does not take."""
        is_list = parameter.multiple or parameter.nargs != 1
        if isinstance(value, tuple) != is_list:
            expected = "a list" if is_list else "one value"
            example = CELL_KEYS[key].example
            raise BadInputError(
                f"{cell.path}: {key} = {value!r}; expected {expected}, such as {example}"
            )
        try:
            parameter.process_value(self.context, value)
        except click.BadParameter as error:
            raise BadInputError(f"{cell.path}: {key}: {error.message}") from None

    def _settings(self, taken: _Taken) -> Iterator[tuple[str, Any]]:
        """Yield the parameters that ``--set`` gives, and their values; keep what it states."""
        options = {cell_key(of): of for of in self.command.params if _is_settable(of, self.keys)}
        found = dict[str, list[str]]()
        for text in (*self.given.get(SETTINGS, ()), *self.given.get(ENTRIES, ())):
            name, sign, value = (part.strip() for part in str(text).partition("="))
            if name.startswith(_OF_ID) and self.takes_identity:
                taken.identity[name.removeprefix(_OF_ID)] = value
                continue
            key = name.replace("-", "_")
            if not sign or key not in options:
                near = ", ".join(nearest_first([key], options)[:_LISTED])
                raise click.BadParameter(
                    f"{text!r}; expected {_EXPECTED}, with one of the keys {near}",
                    param_hint="--set",
                )
            found.setdefault(key, []).append(value)
        if not self._states_identity():
            Identity.of(taken.identity)
        for key, values in found.items():
            yield str(options[key].name), self._setting(options[key], key, values)

    def _setting(self, parameter: click.Parameter, key: str, values: list[str]) -> Any:
        """Return the value of a parameter from the texts that ``--set`` gives."""
        is_robot = parameter.name == _ROBOT_FIELD
        is_given = not self._is_robot_left_out() if is_robot else parameter.name in self.given
        if is_given or (len(values) > 1 and not parameter.multiple):
            raise click.BadParameter(f"{key} is given twice", param_hint="--set")
        parts = [
            value if parameter.nargs == 1 else tuple(re.split(r"[,\s]+", value.strip("[] ")))
            for value in values
        ]
        return tuple(parts) if parameter.multiple else parts[0]

    def _stated(self, taken: _Taken, robot: Any) -> list[str]:
        """Return the words that state the identity of the cell, before those of the user."""
        cell = taken.cell
        if cell is None or not cell.identity or not self._states_identity():
            return []
        is_other = self._is_other(cell, robot)
        stated = {
            key: value
            for key, value in cell.identity.items()
            if self.identity_keys is None or key in self.identity_keys
            if not (is_other and key in ("robot", "controller"))
        }
        taken.stated = stated
        if stated:
            taken.keys.append(f"{IDENTITY} ({', '.join(stated)})")
        return [word for key, value in stated.items() for word in ("--set", f"id.{key}={value}")]

    def _states_identity(self) -> bool:
        return any(parameter.name == ENTRIES for parameter in self.command.params)

    def _keep(self, taken: _Taken, robot: Any) -> None:
        """Keep what the command line gives of a cell, and its other words."""
        for parameter in self.command.params:
            name = str(parameter.name)
            if name not in self.given or not isinstance(parameter, click.Option):
                continue
            if name in self.keys:
                taken.given[self.keys[name]] = self.given[name]
            elif name not in (SETTINGS, ENTRIES, *_PRINTING):
                taken.beyond += _words_of(parameter, self.given[name])
        for key in (SETTINGS, ENTRIES):
            for text in self.given.get(key, ()):
                name, _, value = (part.strip() for part in str(text).partition("="))
                if name in CELL_KEYS:
                    taken.given[name] = value
                elif not name.startswith(_OF_ID):
                    taken.beyond += ["--set", str(text)]
        if isinstance(robot, str) and _ROBOT_FIELD in self.keys:
            taken.given[_ROBOT_FIELD] = robot


def cell_key(parameter: click.Parameter) -> str:
    """Return the key of a parameter in a cell file and for ``--set``: its name with underscores."""
    return parameter.opts[0].lstrip("-").replace("-", "_")


def _is_settable(parameter: click.Parameter, keys: Mapping[str, str]) -> bool:
    """Return whether ``--set`` may give a parameter."""
    if isinstance(parameter, click.Option):
        return parameter.name not in (CELL_FIELD, SETTINGS, ENTRIES, "plugins")
    return parameter.name == _ROBOT_FIELD and _ROBOT_FIELD in keys


def _words_of(parameter: click.Parameter, value: Any) -> Iterator[str]:
    """Yield the words of an option as they may stand on a command line."""
    values = value if parameter.multiple else [value]
    for each in values:
        is_flag = isinstance(parameter, click.Option) and parameter.is_flag
        is_off = is_flag and not each and parameter.secondary_opts
        yield parameter.secondary_opts[0] if is_off else parameter.opts[0]
        if not is_flag:
            yield from each if isinstance(each, tuple | list) else [str(each)]


def _is_for_images(key: str, value: Any) -> bool:
    """Return whether a noise is that of an image, which options for lengths leave alone."""
    return key == "noise" and str(value).strip().endswith("px")


def _is_table(word: str) -> bool:
    """Return whether a word is meant as measurements rather than as a robot."""
    path = Path(word)
    ending = path.suffix.lower()
    if path.is_dir():
        from pincal.measure.log_reader import joints_of_log

        return joints_of_log(path) is not None
    return ending in TABLE_ENDINGS or (path.is_file() and ending not in ("", *_NO_TABLES))


def _is_same(own: Any, robot: str) -> bool:
    """Return whether two words name the same robot or file."""
    if own == robot:
        return True
    return os.path.exists(str(own)) and os.path.exists(robot) and os.path.samefile(own, robot)


def _beside(words: Iterator[str]) -> Path:
    """Return the folder of the first table among words, or the current folder."""
    for word in words:
        if _is_table(word) and Path(word).exists():
            return Path(word).parent
    return Path()


def _taken() -> _Taken | None:
    """Return what the present command takes from a cell file."""
    context = click.get_current_context(silent=True)
    found = None if context is None else context.meta.get(_META)
    return found if isinstance(found, _Taken) else None


def tell_cell() -> None:
    """Say on stderr what came from the cell file, if anything did."""
    taken = _taken()
    if taken is not None and taken.cell is not None and taken.keys:
        click.echo(f"{taken.cell.path}: {', '.join(taken.keys)}", err=True)


def identity_of_cell() -> dict[str, str]:
    """Return what the present command takes from the cell file of the identity, and its command
    line does not state.
    """
    taken = _taken()
    if taken is None:
        return {}
    return {key: of for key, of in taken.stated.items() if key not in taken.identity}


def came_from_cell(key: str) -> bool:
    """Return whether the cell file gave a key to the present command."""
    taken = _taken()
    return taken is not None and key in taken.keys


def cell_files() -> tuple[Path, ...]:
    """Return the cell file of the present command, for the provenance of its results."""
    taken = _taken()
    return () if taken is None or taken.cell is None or not taken.keys else (taken.cell.path,)


def written_cell(
    by: str,
    *,
    more: Mapping[str, Any] | None = None,
    usual: Mapping[str, str] | None = None,
    place: Path | None = None,
) -> Path | None:
    """Write the cell file of the present command from its command line, unless there is one, or
    none is wanted.

    Args:
        by: the command.
        more: further values by key, as on a command line.
        usual: values that hold without a key, by key, to be shown as comments.
        place: folder; default: that of the table.

    Returns:
        The file; None if none was written.
    """
    taken = _taken()
    path = None if taken is None else (taken.place if place is None else place / CELL_NAME)
    if taken is None or path is None or not taken.is_wanted or path.exists():
        return None
    try:
        given = {**taken.given, **(more or {})}
        write_cell(path, given, taken.identity, by=by, usual=usual)
    except OutputError as error:
        # The result does not depend on it.
        click.echo(f"pincal: note: no cell file: {error}", err=True)
        return None
    taken.written = path
    return path


def is_cell_beside(given: Mapping[str, Any], place: Path) -> bool | None:
    """Return whether the cell file of a folder gives just these values, as on a command line; None
    if there is none.

    Raises:
        BadInputError: if it can't be read.
    """
    path = place / CELL_NAME
    taken = _taken()
    if taken is None or not taken.is_wanted or not path.is_file():
        return None
    entries = CellFile.read(path).entries
    holds_all = all(_holds(entries, key, value) for key, value in given.items())
    return given.keys() == entries.keys() and holds_all


def _as_read(value: Any) -> Any:
    """Return a value as a cell file gives it: text, or tuples of texts."""
    if isinstance(value, str):
        return value
    return tuple(_as_read(each) for each in value)


def words_beyond_cell() -> tuple[str, ...] | None:
    """Return the options of the present command line that its cell file does not hold, be it
    written by it or there before; None if there is none, or one that says something else.
    """
    taken = _taken()
    if taken is None:
        return None
    if taken.written is None:
        entries = {} if taken.cell is None else taken.cell.entries
        if not all(_holds(entries, key, value) for key, value in taken.given.items()):
            return None
    is_there = taken.written is not None or taken.cell is not None
    return tuple(taken.beyond) if is_there else None


def _holds(entries: Mapping[str, Any], key: str, value: Any) -> bool:
    """Return whether a cell gives a value, as on a command line."""
    if key not in entries:
        return False
    if isinstance(value, str):
        return _is_same(entries[key], value)
    return bool(entries[key] == _as_read(value))
