"""Typed arguments: a frozen dataclass describes a verb's command line, and Click fills it in.

Its fields are made by :func:`option`, :func:`argument`, or :func:`group` for options that several verbs share and that have
a section of their own in the help text. How a value is read follows from the type of the field.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields
from functools import partial
from pathlib import Path
from types import NoneType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import click

from pincal.cli import show_progress
from pincal.errors import Exit

A = TypeVar("A")
_MARKER = "command line"
# The sections of arguments, and of options that belong to no group.
_POSITIONAL, _OWN = "Arguments", "Options"


@dataclass(frozen=True)
class _Option:
    """What the command line has to know of an option beside its type and default; see :func:`option`."""

    help: str
    words: str | None
    metavar: str | None
    kind: click.ParamType[Any] | None
    names: tuple[str, ...]
    first: Callable[[Any], None] | None


@dataclass(frozen=True)
class _Argument:
    """What the command line has to know of a positional argument; see :func:`argument`."""

    metavar: str
    help: str
    required: bool


@dataclass(frozen=True)
class _Group:
    """A field that is a dataclass of options itself; see :func:`group`."""

    heading: str


def option(
    help: str,
    default: Any = None,
    *,
    words: str | None = None,
    metavar: str | None = None,
    kind: click.ParamType[Any] | None = None,
    names: tuple[str, ...] = (),
    first: Callable[[Any], None] | None = None,
) -> Any:
    """Return a field that is an option.

    Args:
        help: one sentence.
        default: its value if it is not given; ``MISSING`` for an option that has to be given.
        words: the default in words, where its value would not be understood.
        metavar: name of the value in the help text; default: by the type.
        kind: Click's reader of the value; default: by the type.
        names: names on the command line; default: the field's name with hyphens.
        first: what to do with the value before any other option or argument is looked at.
    """
    return field(default=default, metadata={_MARKER: _Option(help, words, metavar, kind, names, first)})


def argument(metavar: str, help: str, *, required: bool = True) -> Any:
    """Return a field that is a positional argument.

    Args:
        metavar: its name in the help text.
        help: one sentence.
        required: whether it has to be given; None if not.
    """
    return field(default=MISSING if required else None, metadata={_MARKER: _Argument(metavar, help, required)})


def group(heading: str) -> Any:
    """Return a field that is a dataclass of options itself.

    Args:
        heading: its section in the help text.
    """
    return field(metadata={_MARKER: _Group(heading)})


@dataclass(frozen=True)
class _Leaf:
    """An option or argument: name, type and default of its field, what the command line has to know, and its section."""

    name: str
    kind: Any
    default: Any
    marker: _Option | _Argument
    heading: str


class Verb(click.Command):
    """A command whose help text explains its arguments and has a section for each group of options.

    Args:
        leaves: the options and arguments by name.
        attributes: those of Click.
    """

    def __init__(self, *, leaves: Mapping[str, _Leaf], **attributes: Any) -> None:
        super().__init__(**attributes)
        self._leaves = leaves

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write arguments and options, section by section."""
        records: dict[str, list[tuple[str, str]]] = {_POSITIONAL: [], _OWN: []}
        for parameter in self.get_params(ctx):
            leaf = self._leaves.get(str(parameter.name))
            if leaf is not None and isinstance(leaf.marker, _Argument):
                records.setdefault(_POSITIONAL, []).append((leaf.marker.metavar, leaf.marker.help))
            elif (record := parameter.get_help_record(ctx)) is not None:
                records.setdefault(_OWN if leaf is None else leaf.heading, []).append(record)
        for heading, rows in ((heading, rows) for heading, rows in records.items() if rows):
            with formatter.section(heading):
                formatter.write_dl(rows)


def verb(
    arguments: type[A],
    *,
    examples: str,
    exits: tuple[Exit, ...] = (),
    defaults: Mapping[str, tuple[Any, str | None]] | None = None,
) -> Callable[[Callable[[A], Exit]], Verb]:
    """Return a decorator that makes a command of a function of typed arguments; its docstring is the help text.

    Args:
        arguments: a frozen dataclass whose fields are options, arguments and groups of them.
        examples: lines to copy, and what else stands at the end of the help text.
        exits: how the verb may end beside done, wrong usage and bad input.
        defaults: name of an option -> its default for this verb and, where that is not understood, in words; for
            options whose default differs from the group's.
    """

    def decorate(function: Callable[[A], Exit]) -> Verb:
        leaves = {leaf.name: leaf for leaf in _leaves(arguments, _OWN)}

        def run(**given: Any) -> Exit:
            show_progress(given["quiet"])
            return function(_filled(arguments, given))

        return Verb(
            name=function.__name__.replace("_", "-"),
            callback=run,
            params=[_parameter(leaf, defaults or {}) for leaf in leaves.values()],
            leaves=leaves,
            help=inspect.getdoc(function),
            epilog=f"\b\n{examples.strip()}\n\n{_exit_codes(exits)}",
        )

    return decorate


def _exit_codes(exits: tuple[Exit, ...]) -> str:
    codes = sorted({Exit.DONE, Exit.USAGE, Exit.BAD_INPUT, *exits})
    return "Exit codes: " + "; ".join(f"{int(code)} {code.meaning}" for code in codes) + "."


def _leaves(arguments: type, heading: str) -> Iterator[_Leaf]:
    """Yield all options and arguments, those of groups in their place."""
    kinds = get_type_hints(arguments)
    for part in fields(arguments):
        marker, kind = part.metadata[_MARKER], kinds[part.name]
        if isinstance(marker, _Group):
            yield from _leaves(kind, marker.heading)
        else:
            yield _Leaf(part.name, kind, part.default, marker, heading)


def _filled(arguments: type[A], given: Mapping[str, Any]) -> A:
    """Return the dataclass with the values that Click has read."""
    kinds = get_type_hints(arguments)
    groups = {part.name for part in fields(arguments) if isinstance(part.metadata[_MARKER], _Group)}  # type: ignore[arg-type]
    return arguments(
        **{
            part.name: _filled(kinds[part.name], given) if part.name in groups else given[part.name]
            for part in fields(arguments)  # type: ignore[arg-type]
        }
    )


def _parameter(leaf: _Leaf, defaults: Mapping[str, tuple[Any, str | None]]) -> click.Parameter:
    """Return an option or argument for Click."""
    marker, reader = leaf.marker, _reader(leaf.kind)
    if isinstance(marker, _Argument):
        reader.pop("metavar", None)
        return click.Argument([leaf.name], metavar=marker.metavar, required=marker.required, **reader)
    default, words = defaults.get(leaf.name, (leaf.default, marker.words))
    text = marker.help + " May be repeated." * ("multiple" in reader)
    if marker.kind is not None:
        reader["type"] = marker.kind
    if marker.metavar is not None:
        reader["metavar"] = marker.metavar
    if marker.first is not None:
        reader |= {"is_eager": True, "callback": partial(_call, marker.first)}
    return click.Option(
        [*(marker.names or ("--" + leaf.name.replace("_", "-"),)), leaf.name],
        help=text if words is None else f"{text}  [default: {words}]",
        **({"required": True} if default is MISSING else {"default": default}),
        show_default=words is None and default is not None,
        **reader,
    )


def _call(first: Callable[[Any], None], context: click.Context, parameter: click.Parameter, value: Any) -> Any:
    first(value)
    return value


def _reader(kind: Any) -> dict[str, Any]:
    """Return type, number and name of values for Click from the type of a field.

    Example:
        >>> _reader(tuple[str, float] | None), _reader(tuple[int, ...])
        ({'type': (<class 'str'>, <class 'float'>)}, {'type': <class 'int'>, 'multiple': True})
    """
    parts = get_args(kind)
    if NoneType in parts:
        (known,) = (part for part in parts if part is not NoneType)
        return _reader(known)
    if get_origin(kind) is Literal:
        return {"type": click.Choice(parts)}
    if get_origin(kind) is tuple:
        return {**_reader(parts[0]), "multiple": True} if parts[-1] is ... else {"type": parts} | _metavar(parts)
    if kind is bool:
        return {"is_flag": True}
    return {"type": click.Path(path_type=Path), "metavar": "FILE.csv"} if kind is Path else {"type": kind}


def _metavar(parts: tuple[Any, ...]) -> dict[str, Any]:
    return {"metavar": "X Y Z"} if parts == (float, float, float) else {}
