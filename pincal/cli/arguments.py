"""Typed arguments: a frozen dataclass describes a verb's command line, and Click fills it in.

Its fields are made by :func:`option`, :func:`argument`, or :func:`group` for options that several
verbs share and that have a section of their own in the help text. How a value is read follows from
the type of the field.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields
from pathlib import Path
from types import NoneType
from typing import Any, Literal, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

import click

from pincal.cli import show_progress
from pincal.cli.cell_defaults import (
    CELL_FIELD,
    ENTRIES,
    SETTINGS,
    cell_key,
    filled_from_cell,
    tell_cell,
)
from pincal.errors import BadInputError, Exit, OutputError
from pincal.satellites import Place
from pincal.units import LARGEST, plain_numbers

A = TypeVar("A")
T = TypeVar("T")
# Keys of an identity that say who issues a document, and for whom.
_ISSUER = ("laboratory", "customer", "country")
# Options that only say what is printed.
_PRINTING = ("--quiet", "--verbose", "--json")
_HEADING = "heading"
_HANDED_IN = "handed in"
_CELL = "cell"
_ALL = "pincal.all options"
_SETTINGS_HEADING = "Cell"
_WORDS = "pincal.words"
_OPTIONS: Place[type[Any]] = Place("options")


def option(
    help: str,
    default: Any = None,
    *,
    words: str | None = None,
    name: str | None = None,
    in_cell: bool = False,
    **attributes: Any,
) -> Any:
    """Return a field that is an option.

    Args:
        help: one sentence.
        default: its value if it is not given; ``MISSING`` for an option that has to be given.
        words: the default in words, if its value would not be understood.
        name: its name on the command line; default: the field's name with hyphens.
        in_cell: whether a cell file may give it, under this name with underscores.
        attributes: further ones for Click; type and number of values follow from the type of the
            field.
    """
    about = {"help": help, "words": words, "name": name, _CELL: in_cell}
    return field(default=default, metadata={**about, **attributes})


def argument(metavar: str, help: str, *, required: bool = True, in_cell: bool = False) -> Any:
    """Return a field that is a positional argument.

    Args:
        metavar: its name in the help text.
        help: one sentence.
        required: whether it has to be given; the field is None, or empty, if it is not.
        in_cell: whether a cell file may give it, under the field's name.
    """
    about = {"cls": _Argument, "metavar": metavar, "help": help, "required": required}
    about[_CELL] = in_cell
    return field(default=MISSING if required else None, metadata=about)


def group(heading: str, *, is_handed_in: bool = False) -> Any:
    """Return a field that is a dataclass of options itself.

    Args:
        heading: of their section in the help text.
        is_handed_in: whether a satellite may hand in, by this heading, a subclass of the field's
            class with options of its own.
    """
    return field(metadata={_HEADING: heading, _HANDED_IN: is_handed_in})


def option_class(heading: str, kind: type[T]) -> type[T]:
    """Return what a satellite hands in as the options under a heading, or else this class."""
    return _OPTIONS.get(heading) or kind


def pair(text: str, expected: str, *, sign: str = "=") -> tuple[str, str]:
    """Return the two sides of NAME=VALUE, blanks about them left out.

    Raises:
        click.BadParameter: if one is missing, with what is expected.
    """
    name, found, value = (word.strip() for word in text.partition(sign))
    if not (name and found and value):
        raise click.BadParameter(f"{text.strip()!r}; expected {expected}")
    return name, value


class NumberType(click.ParamType[float]):
    """A plausible number in SI units: finite, of a magnitude that occurs in a robot cell, and
    within a range.
    """

    name = "float"

    def __init__(self, least: float = -LARGEST, most: float = LARGEST) -> None:
        self._least = least
        self._most = most

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the number."""
        # Not a number is in no range.
        (number,) = plain_numbers([str(value)]) or [math.nan]
        if not self._least <= number <= self._most:
            self.fail(
                f"{str(value)!r}; expected a number from {self._least:g} to {self._most:g}",
                param,
                ctx,
            )
        return number


class _Place(click.Path):
    """A file or a folder; an empty text, such as an unset shell variable, is refused and not the
    current folder.
    """

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail(
                "'' is not a name; expected a file or a folder (. for the current one)", param, ctx
            )
        return super().convert(value, param, ctx)


# Endings of file names: a name with one of them is not meant as a folder.
_OF_FILES = (
    ".csv",
    ".html",
    ".json",
    ".parquet",
    ".pdf",
    ".txt",
    ".urdf",
    ".xlsx",
    ".xml",
    ".yaml",
)


class Output(_Place):
    """A file to write, with one of the endings that the command can write; a folder if there are
    none.

    Other names are refused before any work is done.
    """

    def __init__(self, *endings: str) -> None:
        super().__init__()
        self._endings = endings

    def replaces(self, path: Path, source: Path) -> bool:
        """Return whether writing to this path would replace a file that there is."""
        return path.is_file() and path.samefile(source)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path."""
        path = super().convert(value, param, ctx)
        ending = path.suffix.lower()
        name = param.opts[0] if param is not None else "output"
        if self._endings and ending not in self._endings:
            expected = " or ".join(filter(None, self._endings))
            raise OutputError(
                f"{name} {path}: can't be written as "
                f"{ending or 'a file without an extension'}; end the name in {expected}"
            )
        if not self._endings and ending in _OF_FILES and not path.is_dir():
            raise OutputError(
                f"{name} {path}: a folder is written here, not a {ending} file; give the "
                "name of a folder"
            )
        return path


class _Argument(click.Argument):
    """A positional argument that the help text explains."""

    def __init__(self, *names: Any, help: str, **attributes: Any) -> None:
        super().__init__(*names, **attributes)
        self._help = help

    def get_help_record(self, ctx: click.Context) -> tuple[str, str]:
        """Return name and explanation."""
        return str(self.metavar), self._help


class _Described(NamedTuple):
    """Click's parameter of a field: heading of its section, and whether a cell file may give it."""

    heading: str
    parameter: click.Parameter
    in_cell: bool = False


class Verb(click.Command):
    """A command whose help text has a section for its arguments and for each group of options.

    ``--help`` shows what most calls need; ``--help all`` shows all options by their sections.

    Attributes:
        shown: the fields whose options the short help text shows; None for all.
    """

    def __init__(
        self,
        *,
        described: Sequence[_Described],
        about: VerbHelp,
        reads_cell: bool,
        takes_identity: bool,
        identity_keys: Collection[str] | None,
        **attributes: Any,
    ) -> None:
        super().__init__(params=[each.parameter for each in described], **attributes)
        self._headings = {str(each.parameter.name): each.heading for each in described}
        self._cell_keys = {
            str(each.parameter.name): cell_key(each.parameter) for each in described if each.in_cell
        }
        self._reads_cell = reads_cell
        self._takes_identity = takes_identity
        self._identity_keys = identity_keys
        self._ending = about.ending
        self.shown = about.shown

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the words of the command line, and keep them for :func:`words_given`.

        Raises:
            BadInputError: for bytes that are no text, which files and the libraries that read them
                can't hold as names.
        """
        for word in args:
            if not _is_text(word):
                raise BadInputError(
                    f"{word!r}: has bytes that are no text in UTF-8; expected names in UTF-8: "
                    "rename the file, or correct the encoding of the terminal or the script"
                )
        ctx.meta[_WORDS] = tuple(args)
        words = filled_from_cell(
            self,
            ctx,
            args,
            keys=self._cell_keys if self._reads_cell else None,
            takes_identity=self._takes_identity,
            identity_keys=self._identity_keys,
        )
        return super().parse_args(ctx, words)

    def get_help_option(self, ctx: click.Context) -> click.Option:
        """Return the option that prints the help text, short or, followed by ``all``, in full."""
        if self._help_option is None:
            self._help_option = click.Option(
                [*self.get_help_option_names(ctx), "_help"],
                is_flag=False,
                flag_value="",
                is_eager=True,
                expose_value=False,
                metavar="[all]",
                help="Print this text; --help all: with all options."
                if self.shown is not None
                else "Print this text.",
                callback=_print_help,
            )
        return self._help_option

    def full_help(self, ctx: click.Context) -> str:
        """Return the help text with all options."""
        ctx.meta[_ALL] = True
        return self.get_help(ctx)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write arguments and options, section by section, or those that most calls need."""
        sections: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        is_short = self.shown is not None and not ctx.meta.get(_ALL, False)
        for parameter in self.get_params(ctx):
            if is_short and not self._is_shown(parameter):
                continue
            heading = (
                "Arguments"
                if isinstance(parameter, _Argument)
                else "Options"
                if is_short
                else self._headings.get(str(parameter.name), "Options")
            )
            record = parameter.get_help_record(ctx)
            sections.setdefault(heading, []).extend([] if record is None else [record])
        for heading, records in sections.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)

    def _is_shown(self, parameter: click.Parameter) -> bool:
        """Return whether the short help text has a parameter."""
        always = (CELL_FIELD, SETTINGS, ENTRIES, "_help")
        return isinstance(parameter, _Argument) or parameter.name in (*(self.shown or ()), *always)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write examples and exit codes, and the ending verbatim."""
        super().format_epilog(ctx, formatter)
        if self._ending is not None:
            formatter.write(f"\n{self._ending()}\n")


@dataclass(frozen=True)
class VerbHelp:
    """What the help text of a verb shows.

    Attributes:
        shown: the fields whose options it shows unless it is asked for all; None for all.
        ending: makes lines after the examples, called only when they are shown.
    """

    shown: tuple[str, ...] | None = None
    ending: Callable[[], str] | None = None


def _print_help(context: click.Context, parameter: click.Parameter, given: str | None) -> None:
    """Print the help text if it is asked for."""
    if given is None or context.resilient_parsing:
        return
    command = context.command
    assert isinstance(command, Verb)
    # Another word after the option, such as a file, is no reason to refuse help.
    text = command.full_help(context) if given == "all" else command.get_help(context)
    click.echo(text, color=context.color)
    context.exit()


def _is_text(word: str) -> bool:
    """Return whether a word of the command line consists of characters; bytes that are none in the
    encoding of the system are surrogates.
    """
    try:
        word.encode()
    except UnicodeEncodeError:
        return False
    return True


def words_given() -> tuple[str, ...]:
    """Return the words of the command line after the present command."""
    return tuple(click.get_current_context().meta[_WORDS])


def words_to_repeat() -> tuple[str, ...]:
    """Return the words of :func:`words_given` for a further command: without those that only say
    what this one prints.
    """
    return tuple(word for word in words_given() if word not in _PRINTING)


def verb(
    arguments: type[A],
    *,
    examples: str,
    exits: tuple[Exit, ...] = (),
    defaults: Mapping[str, Any] | None = None,
    shown: tuple[str, ...] | None = None,
    ending: Callable[[], str] | None = None,
    cell: Literal["read", "read issuer", "read, written", "written", "none"] = "read",
) -> Callable[[Callable[[A], Exit]], Verb]:
    """Return a decorator that makes a command of a function of typed arguments; its docstring is
    the help text.

    The function has the name of the command, with ``_verb`` at the end if the library has that name
    itself.

    Args:
        arguments: a frozen dataclass whose fields are options, arguments and groups of them.
        examples: lines to copy, and further text for the end of the help text.
        exits: exit codes other than done, wrong usage and bad input.
        defaults: name of an option -> its default for this command, or a tuple of default and
            words, if it differs.
        shown: the fields whose options the short help text shows; default: all.
        ending: makes lines after the examples, called only when the help text is shown; default:
            none.
        cell: whether a cell file gives what the command line leaves out, and whether the command
            writes one where there is none; of the identity "read issuer" takes only who issues
            it, and for whom.
    """
    codes = sorted({Exit.DONE, Exit.USAGE, Exit.BAD_INPUT, *exits})
    meanings = "; ".join(f"{int(code)} {code.meaning}" for code in codes)

    def decorate(function: Callable[[A], Exit]) -> Verb:
        def run(**given: Any) -> Exit:
            show_progress(given["quiet"])
            if not given["quiet"]:
                tell_cell()
            _keep_inputs(parameters, given)
            return function(_filled(arguments, given))

        parameters = list(_parameters(arguments, defaults or {}, heading="Options"))
        states_identity = any(each.parameter.name == ENTRIES for each in parameters)
        reads_cell = cell.startswith("read")
        reads_any = reads_cell and (states_identity or any(each.in_cell for each in parameters))
        described = [
            each._replace(in_cell=each.in_cell and reads_cell)
            for each in (*parameters, *_settings(reads_any, states_identity))
        ]
        return Verb(
            name=function.__name__.removesuffix("_verb"),
            callback=run,
            described=described,
            about=VerbHelp(shown, ending),
            reads_cell=reads_any,
            takes_identity=states_identity or cell.endswith("written"),
            identity_keys=_ISSUER if cell == "read issuer" else None,
            context_settings={"help_option_names": ["-h", "--help"]},
            help=inspect.getdoc(function),
            epilog=f"\b\n{examples.strip()}\n\nExit codes: {meanings}.",
        )

    return decorate


def _settings(reads_cell: bool, states_identity: bool) -> Iterator[_Described]:
    """Yield the options that every verb has: the cell file, if it can give anything, and settings
    unless the verb has them with an identity.
    """
    if reads_cell:
        yield _Described(
            _SETTINGS_HEADING,
            click.Option(
                ["--cell", CELL_FIELD],
                metavar="FILE",
                expose_value=False,
                help="File that describes the cell: robot, noise and more; none for none.  "
                "[default: cell.toml beside the table, or in the current folder without a table]",
            ),
        )
    if not states_identity:
        yield _Described(
            _SETTINGS_HEADING,
            click.Option(
                ["--set", SETTINGS],
                metavar="KEY=VALUE",
                multiple=True,
                expose_value=False,
                help="Set any option by its name, such as noise=0.05mm. May be repeated.",
            ),
        )


def _keep_inputs(parameters: Sequence[_Described], given: Mapping[str, Any]) -> None:
    """Refuse a file to write that is also read: measurements would be replaced by results.

    Raises:
        OutputError: with both names.
    """
    read = list[Path]()
    written = list[tuple[str, Output, Path]]()
    for _, parameter, _ in parameters:
        value = given[str(parameter.name)]
        paths = [
            Path(each)
            for each in (value if isinstance(value, tuple) else (value,))
            if isinstance(each, Path) or (parameter.name == "robot" and isinstance(each, str))
        ]
        if isinstance(parameter.type, Output):
            written += [(parameter.opts[0], parameter.type, path) for path in paths]
        else:
            read += [path for path in paths if path.is_file()]
    for name, kind, path in written:
        for source in read:
            if kind.replaces(path, source):
                place = path if path.is_file() else f"{path} with {source}"
                raise OutputError(
                    f"{name} {place}: is read by this command and would be replaced; choose "
                    "another name"
                )


def _filled(arguments: type[A], given: Mapping[str, Any]) -> A:
    """Return the dataclass with the values that Click has read."""
    kinds = get_type_hints(arguments)
    values = {}
    for part in fields(arguments):  # type: ignore[arg-type]
        is_group = _HEADING in part.metadata
        kind = _kind_of(part, kinds)
        values[part.name] = _filled(kind, given) if is_group else given[part.name]
    return arguments(**values)


def _kind_of(part: Field[Any], kinds: Mapping[str, Any]) -> Any:
    """Return the type of a field, of a group that is handed in the satellite's."""
    kind = kinds[part.name]
    is_handed_in = part.metadata.get(_HANDED_IN, False)
    return option_class(part.metadata[_HEADING], kind) if is_handed_in else kind


def _parameters(
    arguments: type, defaults: Mapping[str, Any], *, heading: str
) -> Iterator[_Described]:
    """Yield Click's parameters of all options and arguments, those of groups included."""
    kinds = get_type_hints(arguments)
    for part in fields(arguments):
        kind = _kind_of(part, kinds)
        about = dict(part.metadata)
        if _HEADING in about:
            yield from _parameters(kind, defaults, heading=about[_HEADING])
            continue
        in_cell = about.pop(_CELL)
        if "cls" in about:
            made: click.Parameter = _positional(part.name, kind, about)
        else:
            default = defaults.get(part.name, part.default)
            made = _option(part.name, default, attributes=_reader(kind) | about)
        yield _Described(heading, made, in_cell)


def _positional(name: str, kind: Any, about: dict[str, Any]) -> click.Argument:
    """Return Click's parameter of an argument."""
    read = _reader(kind)
    several = {"nargs": -1} if read.pop("multiple", False) else {}
    about.pop("cls")
    return _Argument([name], **read | about | several)


def _option(field_name: str, default: Any, *, attributes: dict[str, Any]) -> click.Option:
    name = attributes.pop("name")
    words = attributes.pop("words")
    if isinstance(default, tuple) and len(default) == 2:
        default, words = default
    attributes["help"] += " May be repeated." * attributes.get("multiple", False)
    if words is not None:
        attributes["help"] += f"  [default: {words}]"
    attributes |= {"required": True} if default is MISSING else {"default": default}
    attributes["show_default"] = words is None and default is not None
    return click.Option([name or "--" + field_name.replace("_", "-"), field_name], **attributes)


def _reader(kind: Any) -> dict[str, Any]:
    """Return type, number and name of values for Click from the type of a field.

    Example:
        >>> _reader(tuple[str, str] | None), _reader(tuple[int, ...])
        ({'type': (<class 'str'>, <class 'str'>)}, {'type': <IntRange x>=0>, 'multiple': True})
    """
    parts = get_args(kind)
    if NoneType in parts:
        return _reader(next(part for part in parts if part is not NoneType))
    if get_origin(kind) is Literal:
        return {"type": click.Choice(parts)}
    if parts and parts[-1] is ...:
        return _reader(parts[0]) | {"multiple": True}
    if parts:
        return {"type": tuple(_reader(part)["type"] for part in parts)} | (
            {"metavar": "X Y Z"} if parts == (float,) * 3 else {}
        )
    if kind is bool:
        return {"is_flag": True}
    if kind is Path:
        return {"type": _Place(), "metavar": "FILE.csv"}
    # Whole numbers are counts and seeds.
    return {"type": {float: NumberType(), int: click.IntRange(min=0)}.get(kind, kind)}
