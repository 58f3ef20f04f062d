"""JSON files read strictly into typed structures: within limits, and with the key of
every fault.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

import msgspec
import numpy as np

from pincal.atomic import write_atomic
from pincal.errors import BadInputError, ModelFileError, OutputError
from pincal.measure.table_schema import TABLE_ENDINGS
from pincal.thresholds import Count

_T = TypeVar("_T")
Hook = Callable[[Any, Any], Any]

# Limits that are checked before parsing. Together they bound the work on a hostile file to less
# than a second and 200 MB, but allow a model of 1500 parameters, whose covariance has 2.25 million
# numbers in files of version 0.1.0.
MOST_BYTES: Count = 52 << 20
# Separators, brackets and quotes: each value has at least one, and becomes a Python object of 30 to
# 100 bytes.
MOST_TOKENS: Count = 2_500_000
# pincal's files nest eight deep; the provenance by users may be deeper.
MOST_DEPTH: Count = 32
# The longest sensible number has 325 digits: the smallest one written out in full.
MOST_DIGITS: Count = 1000

_LONG_NUMBER = b"0" * (MOST_DIGITS + 1)

MISSING = "is missing"

_STRING = rb'"(?:[^"\\]++|\\.)*+"?'
_STRINGS = re.compile(_STRING, re.DOTALL)
_NOT_FINITE = re.compile(_STRING + rb"|-?(?:NaN|Infinity)\b", re.DOTALL)
_DIGITS = bytes(ord("0") if chr(code).isdigit() else 32 for code in range(128)) + bytes(128)
_NO_BRACKETS = bytes(set(range(256)) - set(b"[]{}"))

_SURROGATES = re.compile(rb"\\u[dD][89a-fA-F]")
_PLACE = re.compile(r" - at `(?P<place>[^`]*)`$")
# Keys of dictionaries are not named, but stand as [...].
_ANY_KEY = "[...]"
_KEY = re.compile(r"\.([^.\[]+)|\[(\d+)\]")
_KINDS = {
    dict: "an object",
    list: "a list",
    str: "a string",
    type(None): "null",
    bool: "true or false",
}
_EXPECTED = {
    "object": "an object",
    "array": "a list",
    "str": "a string",
    "bool": "true or false",
    "int": "a whole number",
    "float": "a number",
    "null": "null",
}


class Fault(ValueError):
    """An invalid value.

    Attributes:
        problem: what is wrong with it.
        expected: what was expected instead.
        key: keys from the structure being built to the value, e.g. ``.covered.q``; empty for the
            structure.
    """

    def __init__(self, problem: str, expected: str, *, key: str = "") -> None:
        super().__init__(f"{problem}; expected {expected}")
        self.problem = problem
        self.expected = expected
        self.key = key


@dataclass(frozen=True)
class FileKind:
    """A kind of JSON file.

    Attributes:
        name: such a file, in words.
        error: the class of its errors.
        advice: what a user can do about a bad one; empty for none.
        mark: separator between a key and the problem in messages.
        whole: the expected contents, for messages about a missing key; empty for none.
    """

    name: str
    error: type[BadInputError]
    advice: str = ""
    mark: str = ": "
    whole: str = ""

    def fault(self, file: str, place: str, problem: str, expected: str) -> BadInputError:
        """Return the error for a fault at a key of a file."""
        key = f"{place}{self.mark}" if place else ""
        is_another = place in ("", "format", "format_version")
        if is_another and self.name == MODEL_FILE.name and (model := _model_beside(file)):
            return self.error(f"{file}: {key}{problem}; expected {self.name}, such as {model}")
        if self.whole and (is_another or problem == MISSING):
            expected = self.whole
        return self.error(
            f"{file}: {key}{problem}; expected {expected}"
            + (f"; {self.advice}" if self.advice else "")
        )


MODEL_FILE = FileKind(
    "a model.json", ModelFileError, "take the file from a backup or run pincal calibrate again"
)


def read_json(
    path: str | os.PathLike[str], wanted: type[_T], kind: FileKind, *, hook: Hook | None = None
) -> _T:
    """Read a JSON file.

    Args:
        path: the file.
        wanted: the structure to read.
        kind: the kind of file, for messages.
        hook: builds values of types unknown to msgspec, see :class:`msgspec.json.Decoder`; raises
            :class:`Fault`.

    Raises:
        BadInputError: of the kind's class: the file can't be read, is too large, is not JSON, or
            has a fault.
    """
    return built(read_bounded(path, kind), wanted, kind, file=os.fspath(path), hook=hook)


def read_bounded(path: str | os.PathLike[str], kind: FileKind) -> bytes:
    """Return the text of a JSON file within the limits.

    Raises:
        BadInputError: of the kind's class: the file can't be read, or is too large.
    """
    file = os.fspath(path)
    try:
        with Path(path).open("rb") as stream:
            content = stream.read(MOST_BYTES + 1)
    except OSError as error:
        model = _model_beside(file) if kind is MODEL_FILE else None
        such = f", such as {model}" if model else ""
        raise kind.error(
            f"{file}: can't be read ({error.strerror}); expected {kind.name}{such}"
        ) from None
    return bounded(content, kind, file)


def _model_beside(file: str) -> Path | None:
    """Return the model in a folder, or beside another file of a result; None if there is none."""
    path = Path(file)
    model = path / "model.json" if path.is_dir() else path.with_name("model.json")
    return model if model.is_file() and model != path else None


def built(
    content: bytes, wanted: type[_T], kind: FileKind, *, file: str, hook: Hook | None = None
) -> _T:
    """Return the structure in a bounded text; see :func:`read_json`.

    Example:
        >>> class Point(msgspec.Struct):
        ...     x: float
        >>> built(b'{"x": "a"}', Point, MODEL_FILE, file="f.json")
        Traceback (most recent call last):
        pincal.errors.ModelFileError: f.json: x: is 'a'; expected a number; take the file from a \
backup or run pincal calibrate again
    """
    try:
        # A text of other bytes is no JSON; where msgspec skips a key it does not look at them.
        content.decode()
        if _SURROGATES.search(content):
            return msgspec.convert(_loaded(content), wanted, dec_hook=hook)
        return msgspec.json.decode(content, type=wanted, dec_hook=hook)
    except msgspec.ValidationError as error:
        try:
            place, problem, expected = explained(error, lambda: _loaded(content), wanted)
        except ValueError as other:
            # The decoder stopped at the first fault; the text after it is not JSON.
            place = ""
            problem = f"truncated or not JSON ({other})"
            expected = kind.name
        raise kind.fault(file, place, problem, expected) from None
    except ValueError as error:
        problem = f"truncated or not JSON ({error})"
        if Path(file).suffix.lower() in TABLE_ENDINGS:
            problem = "is a table"
            kind = replace(kind, advice="are two files in each other's place?")
        raise kind.fault(file, "", problem, kind.name) from None


def bounded(content: bytes, kind: FileKind, file: str) -> bytes:
    """Return a text within the limits, with NaN and infinities as numbers out of range, which are
    reported by key.
    """
    if excess := _excess(content):
        raise kind.fault(file, "", f"too large to be read safely ({excess})", kind.name)
    if b"NaN" in content or b"Infinity" in content:
        return _NOT_FINITE.sub(
            lambda found: found[0] if found[0][:1] == b'"' else b"1e999", content
        )
    return content


def _loaded(content: bytes) -> Any:
    """Return a JSON text in Python's types; unlike msgspec this accepts lone surrogates, by which
    bytes are escaped.
    """
    return json.loads(content, parse_float=_finite)


def _finite(text: str) -> float:
    if abs(value := float(text)) == float("inf"):
        raise ValueError(f"{text} is out of range")
    return value


def _excess(content: bytes) -> str:
    """Return the limit that a text exceeds, in words; empty if none."""
    if len(content) > MOST_BYTES:
        return f"more than {MOST_BYTES >> 20} MB"
    if sum(content.count(token) for token in (b",", b":", b"[", b"{", b'"')) > MOST_TOKENS:
        return f"more than {MOST_TOKENS:,} values"
    # Most files have neither long numbers nor many brackets, even in strings, and need no parsing.
    if (
        _LONG_NUMBER not in content.translate(_DIGITS)
        and content.count(b"[") + content.count(b"{") <= MOST_DEPTH
    ):
        return ""
    bare = _STRINGS.sub(b'""', content)
    if _LONG_NUMBER in bare.translate(_DIGITS):
        return f"a number of more than {MOST_DIGITS} digits"
    brackets = np.frombuffer(bare.translate(None, _NO_BRACKETS), np.uint8)
    depth = np.cumsum(
        np.where((brackets == ord("[")) | (brackets == ord("{")), 1, -1), dtype=np.int32
    )
    return f"nested more than {MOST_DEPTH} deep" if depth.max(initial=0) > MOST_DEPTH else ""


def explained(
    error: msgspec.ValidationError, loaded: Callable[[], Any], wanted: Any
) -> tuple[str, str, str]:
    """Return the key of an error of the decoder, the problem and the expected value, in words."""
    message = str(error)
    found = _PLACE.search(message)
    place = found["place"].removeprefix("$").removeprefix(".") if found else ""
    message = message[: found.start()] if found else message
    cause = error.__cause__
    if isinstance(cause, Fault):
        return (place + cause.key).removeprefix("."), cause.problem, cause.expected
    if match := re.fullmatch(r"Object missing required field `(.+)`", message):
        return f"{place}.{match[1]}".removeprefix("."), MISSING, "this key"
    if message == "Number out of range":
        return (
            re.sub(r"(\[[^]]*\])+$", "", place),
            "has entries that are not finite numbers",
            "finite numbers",
        )
    if match := re.fullmatch(r"Invalid enum value (.+)", message, re.DOTALL):
        choices = get_args(_type_at(wanted, place))
        return place, f"is {match[1]}", f"one of {', '.join(map(str, choices))}"
    if match := re.fullmatch(r"Expected `([^`]+)`, got `([^`]+)`", message):
        expected = " or ".join(_EXPECTED.get(name, name) for name in match[1].split(" | "))
        if _ANY_KEY in place:
            return place, f"is {_EXPECTED.get(match[2], match[2])}", expected
        return place, what_is(_value_at(loaded(), place), expected), expected
    return place, f"is invalid ({message})", "what pincal writes"


def what_is(value: Any, expected: str) -> str:
    """Return a value in words: a short text or number itself, else its kind."""
    if isinstance(value, (str, bool, int, float)) and len(repr(value)) <= 40:
        return f"is {value!r}"
    return f"is {_KINDS.get(type(value), 'a number')}, not {expected}"


def _steps(place: str) -> list[str | int]:
    return [
        key or int(index) for key, index in _KEY.findall(_without_any_key(place)) if key or index
    ]


def _without_any_key(place: str) -> str:
    """Return a place that begins with a separator, without keys of dictionaries."""
    plain = place.replace(_ANY_KEY, "")
    return plain if plain[:1] == "[" else f".{plain}"


def _value_at(value: Any, place: str) -> Any:
    try:
        for step in _steps(place):
            value = value[step]
    except (LookupError, TypeError):
        return None
    return value


def _type_at(wanted: Any, place: str) -> Any:
    for step in _steps(place):
        if isinstance(step, str):
            wanted = next(
                field.type for field in msgspec.structs.fields(wanted) if field.encode_name == step
            )
        while not isinstance(wanted, type) and get_origin(wanted) is not Literal:
            # Of a dictionary its values.
            wanted = get_args(wanted)[-1 if get_origin(wanted) is dict else 0]
    return wanted


def in_script(text: str) -> str:
    """Return JSON with escapes that keep it plain text in a script element."""
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def write_json(
    path: str | os.PathLike[str], contents: dict[str, Any], *, indent: int | None = 1
) -> None:
    """Write contents in JSON types atomically, with numbers in full precision.

    The indent is as for :func:`json.dumps`; None gives one line per key of the outermost object.

    Raises:
        OutputError: if the file can't be written, or a number is not finite.
    """
    try:
        if indent is None:
            lines = [
                f"{json.dumps(key)}: {json.dumps(value, allow_nan=False)}"
                for key, value in contents.items()
            ]
            text = "{\n" + ",\n".join(lines) + "\n}\n"
        else:
            text = json.dumps(contents, indent=indent, allow_nan=False) + "\n"
    except ValueError as error:
        raise OutputError(
            f"{os.fspath(path)}: a number is not finite ({error}); calibrate again"
        ) from None
    write_atomic(path, text)
