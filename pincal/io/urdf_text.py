"""Editing the text of a URDF in place: only numbers of origins change, and no other byte."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np

from pincal.errors import RobotFileError
from pincal.io.file_numbers import IN_FILES
from pincal.robot.se3 import rotation_of_rpy, transform
from pincal.robot.urdf_file import parse_xml
from pincal.thresholds import Scale

# Rounding of the product of three rotations, within which angles are equally good.
_ROUNDING: Scale = 2e-16

# Elements with origins, and the tags of these.
_ORIGINS = {"joint": ("origin",), "constraint": ("parent_origin", "child_origin")}

_TAG = re.compile(rb"<[^\s/>]+(?:[^>\"']|\"[^\"]*\"|'[^']*')*>")
_ATTRIBUTE = re.compile(rb"([^\s=<>/\"']+)\s*=\s*(\"[^\"]*\"|'[^']*')")
_BLANKS = re.compile(rb"\s*")
# What precedes the root: a mark of the byte order, and the declaration of the encoding.
_DECLARATION = re.compile(rb"(?:\xef\xbb\xbf)?(?:<\?xml[^>]*\?>[ \t]*\r?\n?)?")


@dataclass(frozen=True)
class Origin:
    """Numbers of an ``<origin>``: ``xyz``, shape (3,) [m], and ``rpy``, shape (3,) [rad], R = R_z
    R_y R_x.
    """

    xyz: np.ndarray
    rpy: np.ndarray

    @property
    def matrix(self) -> np.ndarray:
        """The placement, shape (4, 4), of the child frame in the parent frame."""
        return transform(rotation_of_rpy(self.rpy), self.xyz)


def rpy_of(rotation: np.ndarray, near: np.ndarray) -> np.ndarray:
    r"""Return the roll, pitch and yaw [rad] that reproduce a rotation to rounding, the ones nearest
    to ``near``.

    Yaw and pitch are of :math:`R R_x(-roll)`, which is also exact at a pitch of 90 degrees, where
    roll and yaw are about the same axis and only their sum or difference is determined.
    """
    R = rotation
    rolls = np.array([near[0], np.arctan2(R[2, 1], R[2, 2]), np.arctan2(-R[2, 1], -R[2, 2])])
    c = np.cos(rolls)
    s = np.sin(rolls)
    pitches = np.arctan2(-R[2, 0], R[2, 1] * s + R[2, 2] * c)
    yaws = np.arctan2(R[0, 2] * s - R[0, 1] * c, R[1, 1] * c - R[1, 2] * s)
    found = np.column_stack([rolls, pitches, yaws])
    errors = np.array([np.abs(rotation_of_rpy(angles) - R).max() for angles in found])
    good = found[errors <= errors.min() + _ROUNDING]
    return np.asarray(good[np.argmin(np.abs(good - near).sum(axis=1))])


def read_origins(text: bytes, source: str) -> dict[str, Origin]:
    """Return the origins of joints, and of constraints as ``NAME.parent_origin`` and
    ``NAME.child_origin``, or zero.
    """
    origins = {}
    root = parse_xml(text, source)
    for holder, tags in _ORIGINS.items():
        for element in root.iterfind(holder):
            for tag in tags:
                origin = element.find(tag)
                numbers = [
                    ("0 0 0" if origin is None else origin.get(key, "0 0 0")).split()
                    for key in ("xyz", "rpy")
                ]
                origins[_key(element.get("name", ""), tag)] = Origin(*np.array(numbers, float))
    return origins


def _key(name: str, tag: str) -> str:
    return name if tag == "origin" else f"{name}.{tag}"


def write_origins(text: bytes, origins: Mapping[str, Origin], source: str) -> bytes:
    """Return the text of a valid URDF with new origins, by the names of :func:`read_origins`.

    Unchanged numbers keep their text.

    Raises:
        RobotFileError: if the encoding of the text does not extend ASCII.
    """
    before = read_origins(text, source)
    places = _places(text, source)
    edits = []
    for name, new in origins.items():
        pairs = {"xyz": (new.xyz, before[name].xyz), "rpy": (new.rpy, before[name].rpy)}
        changes = {
            key: value
            for key, (value, old) in pairs.items()
            if np.any(np.abs(value - old) >= IN_FILES.kept)
        }
        if changes:
            at = places.origins.get(name)
            edits.append(
                _inserted(text, *places.holders[name], changes)
                if at is None
                else _replaced(text, at, changes)
            )
    for start, end, piece in sorted(edits, reverse=True):
        text = text[:start] + piece + text[end:]
    return text


def append_frame(
    text: bytes, *, parent: str, joint: str, link: str, origin: Origin, source: str
) -> bytes:
    """Return the text with a further link at its end, fixed to link ``parent``."""
    encoding = parse_xml(text, source).getroottree().docinfo.encoding or "utf-8"
    end = _places(text, source).end
    lines = [
        f"  <link name={quoteattr(link)}/>",
        f'  <joint name={quoteattr(joint)} type="fixed">',
        f"    <parent link={quoteattr(parent)}/>",
        f"    <child link={quoteattr(link)}/>",
        f'    <origin xyz="{_words(origin.xyz)}" rpy="{_words(origin.rpy)}"/>',
        "  </joint>",
        "",
    ]
    newline = "\r\n" if b"\r\n" in text else "\n"
    return text[:end] + newline.join(lines).encode(encoding, "xmlcharrefreplace") + text[end:]


@dataclass
class _Places:
    """Byte offsets in a text: start tags of holders of origins, with their tags, origins, and the
    end tag of the root.
    """

    holders: dict[str, tuple[int, str]] = field(default_factory=dict)
    origins: dict[str, int] = field(default_factory=dict)
    end: int = 0


class _Finder:
    """Notes the places of joints while a text is parsed."""

    def __init__(self) -> None:
        self.places = _Places()
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self._above = list[str]()
        self._name = ""

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        at = self.parser.CurrentByteIndex
        if self._above == ["robot"] and tag in _ORIGINS:
            self._name = attributes.get("name", "")
            self.places.holders |= {_key(self._name, held): (at, held) for held in _ORIGINS[tag]}
        elif len(self._above) == 2 and tag in _ORIGINS.get(self._above[1], ()):
            self.places.origins.setdefault(_key(self._name, tag), at)
        self._above.append(tag)

    def _end(self, tag: str) -> None:
        self._above.pop()
        self.places.end = self.parser.CurrentByteIndex


def _places(text: bytes, source: str) -> _Places:
    """Find the joints directly below the root, not those of transmissions and controllers."""
    finder = _Finder()
    places = finder.places
    try:
        finder.parser.Parse(text, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise RobotFileError(
            f"{source}: can't be edited ({error}); save it as UTF-8 first"
        ) from None
    offsets = [*(at for at, _ in places.holders.values()), *places.origins.values()]
    tags = tuple(f"<{tag}".encode() for holder, held in _ORIGINS.items() for tag in (holder, *held))
    if not all(text.startswith(tags, at) for at in offsets):
        raise RobotFileError(f"{source}: can't be edited in its encoding; save it as UTF-8 first")
    return places


def _words(values: np.ndarray, old: bytes = b"") -> str:
    """Return numbers in full precision; unchanged ones keep their text in ``old``."""
    texts = old.decode("ascii", "replace").split() or ["0"] * 3
    if b"&" in old:
        # Text with character references is not kept.
        texts = ["nan"] * 3
    return " ".join(
        word if abs(float(word) - value) < IN_FILES.kept else repr(float(value) + 0.0)
        for word, value in zip(texts, values, strict=True)
    )


def _tag_at(text: bytes, at: int) -> bytes:
    found = _TAG.match(text, at)
    assert found is not None
    return found.group()


def _replaced(text: bytes, at: int, changes: Mapping[str, np.ndarray]) -> tuple[int, int, bytes]:
    """Return start, end and new text of an origin's tag with changed attributes."""
    tag = _tag_at(text, at)
    piece = tag
    missing = dict(changes)
    for found in reversed(list(_ATTRIBUTE.finditer(tag))):
        key = found[1].decode("ascii", "replace")
        if key in missing:
            first = found.start(2) + 1
            last = found.end(2) - 1
            piece = (
                piece[:first] + _words(missing.pop(key), tag[first:last]).encode() + piece[last:]
            )
    close = len(piece) - (2 if piece.endswith(b"/>") else 1)
    added = "".join(f' {key}="{_words(values)}"' for key, values in missing.items())
    return (
        at,
        at + len(tag),
        piece[:close].rstrip() + added.encode() + piece[close:] if added else piece,
    )


def _inserted(
    text: bytes, holder: int, tag: str, changes: Mapping[str, np.ndarray]
) -> tuple[int, int, bytes]:
    """Return where to insert a missing origin, and its text, indented like the next element."""
    start = holder + len(_tag_at(text, holder))
    blanks = _BLANKS.match(text, start)
    assert blanks is not None
    words = "".join(f' {key}="{_words(values)}"' for key, values in changes.items())
    return start, start, blanks.group() + f"<{tag}{words}/>".encode()


def with_comment(text: bytes, comment: str) -> bytes:
    """Return the text of a URDF with a comment of a line at its top, behind the declaration that
    has to be first; without a comment the text itself.

    Characters beyond ASCII are escaped, since the encoding is only known to extend it.
    """
    if not comment:
        return text
    words = re.sub("-(?=-|$)", "- ", comment).encode("ascii", "xmlcharrefreplace")
    found = _DECLARATION.match(text)
    start = found.end() if found else 0
    return b"%b<!-- %b -->\n%b" % (text[:start], words, text[start:])
