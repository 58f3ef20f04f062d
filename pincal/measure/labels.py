"""The labels of a header: spellings of names and units, numbered joints, other names of vectors."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from pincal.errors import MeasurementError
from pincal.measure.heading import NUMBERED, normal_unit
from pincal.thresholds import Count
from pincal.units import UNITS

# Columns that a message lists at most.
_LISTED: Count = 20
# Words next to the letter of an axis in names of a position.
_PLACES = frozenset(
    ("p", "pos", "position", "tcp", "point", "target", "meas", "measured", "tracker", "reflector",
     "smr", "laser", "trans", "translation", "t", "loc", "location", "coord", "coordinate",
     "actual", "act", "value", "tvec", "xyz", "pose", "transform", "tf", "marker", "prism",
     "measurement", "vicon", "mocap", "optitrack")
)  # fmt: skip
_FORCES = frozenset(("a", "acc", "accel", "acceleration", "accelerometer", "specific force"))
_RATES = frozenset(
    (
        "w",
        "g",
        "gyr",
        "gyro",
        "gyroscope",
        "omega",
        "angular velocity",
        "angular rate",
        "gyro rate",
        "turn rate",
    )
)
_TURNS = frozenset(("q", "quat", "quaternion", "orientation", "rotation", "rot", "attitude"))
_ROTATION_VECTORS = frozenset(("rvec", "rotvec", "rodrigues", "rotation vector", "axis angle"))
# Vectors of a stream, and the words next to the letter of an axis in their names.
_VECTORS = {
    ("x", "y", "z"): _PLACES,
    ("ax", "ay", "az"): _FORCES,
    ("wx", "wy", "wz"): _RATES,
    ("qx", "qy", "qz", "qw"): _TURNS,
    ("rx", "ry", "rz"): _ROTATION_VECTORS,
}
# Those of a table, and words of a position by which its components may be numbered.
_OF_TABLES = ("x", "qx", "rx")
_COUNTED = frozenset(("pos", "position", "tvec", "t", "trans", "translation", "xyz", "p", "point"))
# Words that denote the position of a joint, and words that denote another quantity.
_POSITIONS = frozenset(
    ("position", "positions", "pos", "q", "angle", "value", "actual", "act", "measured", "meas")
)
_NUMBERS = _POSITIONS | {"j", "joint", "joints", "a", "axis", "theta", "rax", "achse", "gelenk"}
_OTHERS = frozenset(
    ("velocity", "velocities", "vel", "speed", "qd", "dq", "qdd", "effort", "torque", "tau",
     "current", "error", "command", "commanded", "cmd", "desired", "des", "target", "setpoint",
     "goal", "reference", "ref", "nominal", "temperature", "temp", "covariance", "std", "bias",
     "voltage", "load", "magnetic", "mag", "gravity", "angular")
)  # fmt: skip
# `x [mm]` is how pincal writes a unit; these are the other spellings: `x (mm)`, `x_mm`, `x mm`,
# `x/mm`.
_OTHER_SPELLINGS = (
    r"(.*?)\s*\(\s*([^()]*?)\s*\)",
    r"(.*)_([^_]*)",
    r"(.*?)\s+(\S*)",
    r"(.*?)\s*/\s*(\S*)",
)
# What begins a unit in brackets, which a number in brackets, as of ``q[0]``, is not.
_INDEX = re.compile(r"\[\s*\d+\s*\]")
_UNIT = re.compile(r"\[(?!\s*\d+\s*\])")
# Units that are ordinary words as well.
_WORDS = ("in",)


@dataclass(frozen=True)
class Label:
    """A label of a header.

    Attributes:
        index: of the column.
        text: the label in the header.
        meant: the same with the meaning that the user assigned.
    """

    index: int
    text: str
    meant: str

    @property
    def name(self) -> str:
        """Its name, without a unit in brackets."""
        return name_of(self.meant)


def name_of(label: str) -> str:
    """Return a label without its unit in brackets.

    Example:
        >>> name_of("q[0] [deg]"), name_of("x[mm]")
        ('q[0]', 'x')
    """
    return _UNIT.split(label, maxsplit=1)[0].strip()


def renamed(
    labels: Sequence[str], columns: Mapping[str, str], *, source: str, others: Sequence[str] = ()
) -> list[Label]:
    """Return the labels with the meanings that the user assigned; units in the header apply unless
    the user gives one.

    Args:
        labels: the header.
        columns: names and their meanings.
        source: the file, for messages.
        others: labels of a file that is joined with it, to which the user may refer as well.

    Raises:
        MeasurementError: for a name of no column or of several.
    """
    found = [Label(i, text, text) for i, text in enumerate(labels)]
    for name, meaning in columns.items():
        hits = [i for i, text in enumerate(labels) if is_named(text, name)]
        if not hits and any(is_named(text, name) for text in others):
            continue
        if len(hits) != 1:
            column, bracket, unit = meaning.partition("[")
            swapped = not hits and any(is_named(text, column.strip()) for text in labels)
            hint = (
                f'; is "{column.strip()}={name}{bracket and f" [{unit}"}" meant?' if swapped else ""
            )
            count = "no column" if not hits else f"{len(hits)} columns"
            raise MeasurementError(
                f'{source}: {count} "{name}" for --columns {name}={meaning}{hint}; '
                f"{columns_listed(labels)}"
            )
        text = labels[hits[0]]
        unit = unit_in(text)
        found[hits[0]] = Label(
            hits[0], text, meaning if "[" in meaning or not unit else f"{meaning} [{unit}]"
        )
    return found


def is_named(text: str, name: str) -> bool:
    """Return whether a name denotes a column: its label, with or without the unit."""
    return name in (text, name_of(text), _bare(text))


def unignored(labels: Sequence[Label], ignored: Sequence[str]) -> list[Label]:
    """Return the labels without those that the user ignores, by any of their names, or by how these
    begin: ``matrix_*``.
    """
    starts = tuple(name[:-1] for name in ignored if name.endswith("*") and len(name) > 1)
    names = set(ignored)
    return [
        label
        for label in labels
        if not {label.name, label.meant, label.text} & names
        and not (starts and label.text.startswith(starts))
    ]


def columns_listed(labels: Sequence[str]) -> str:
    """Return the columns of a table, for messages."""
    shown = ", ".join(f'"{text[:30]}"' for text in labels[:_LISTED])
    return f"the table has {shown}{', ...' if len(labels) > _LISTED else ''}"


def _bare(text: str) -> str:
    """Return a label without a unit in parentheses."""
    match = re.fullmatch(_OTHER_SPELLINGS[0], text)
    return match[1] if match else text


def unit_in(text: str) -> str:
    """Return the unit of a label in brackets or parentheses; empty without one."""
    match = re.fullmatch(r"[^\[(]*[\[(]([^\])]*)[\])]\s*", _INDEX.sub("", text))
    return match[1].strip() if match else ""


def spelled(label: Label, quantities: Mapping[str, str]) -> tuple[str, str] | None:
    """Return the known name and the unit of a label in any spelling; None if the name is unknown.

    Example:
        >>> known = {"x": "length", "joint_1": "angle"}
        >>> texts = ("X", "x (mm)", "Joint_1_deg", "x_kg")
        >>> [spelled(Label(0, text, text), known) for text in texts]
        [('x', ''), ('x', 'mm'), ('joint_1', 'deg'), None]
    """
    folded: dict[str, list[str]] = {}
    for each in quantities:
        folded.setdefault(each.casefold(), []).append(each)

    def known(text: str) -> str | None:
        same = folded.get(text.strip().casefold(), [])
        return text.strip() if text.strip() in quantities else same[0] if len(same) == 1 else None

    if (plain := known(label.name)) is not None:
        return plain, label.meant[len(_UNIT.split(label.meant, maxsplit=1)[0]) :]
    for place, pattern in enumerate(_OTHER_SPELLINGS):
        match = re.fullmatch(pattern, label.meant)
        name = known(match[1]) if match else None
        if match and name:
            unit = normal_unit(match[2])
            if unit in UNITS[quantities[name]] and (place == 0 or unit not in _WORDS):
                return name, unit
    return None


def unit_of(label: str, quantity: str, *, where: str) -> str:
    """Return the unit of a label in brackets, empty without one; refuse an unclosed one or one of
    another quantity.
    """
    match = re.fullmatch(r"[^\[\]]*(?:\[([^\[\]]*)\])?", label)
    unit = normal_unit(match[1] or "") if match else ""
    accepted = ", ".join(f"[{unit}]" for unit in UNITS[quantity]) or "no unit"
    if match is None:
        raise MeasurementError(f"{where}: unclosed unit; expected at its end one of {accepted}")
    if "[" in label and unit not in UNITS[quantity]:
        raise MeasurementError(
            f"{where}: [{unit}] is not a unit of this column; expected one of {accepted}"
        )
    return unit


def numbered_joints(labels: Sequence[Label], joints: Sequence[str]) -> dict[str, str]:
    """Return the meanings of the labels that number all joints of an arm; empty if no set of labels
    does, or several do.

    Joints are numbered from the base to the flange, starting at 1 or 0. Sets with a further number,
    such as an external axis, are not taken for an arm, nor are q1 q2 q3 q4, which may be a
    quaternion.

    Example:
        >>> labels = [Label(i, f"J{i + 1} (deg)", f"J{i + 1} (deg)") for i in range(2)]
        >>> numbered_joints(labels, ["shoulder", "elbow"])
        {'J1 (deg)': 'shoulder [deg]', 'J2 (deg)': 'elbow [deg]'}
    """
    n = len(joints)
    whole = [
        family
        for words, family in numbered_families(labels)
        if numbers_all(family, n) and not (words == ("q",) and n == 4)
    ]
    if len(whole) != 1:
        return {}
    pairs = zip((whole[0][i] for i in sorted(whole[0])), joints, strict=True)
    return {label.meant: f"{joint} [{unit}]" if unit else joint for (label, unit), joint in pairs}


def without_unit(text: str, *quantities: str) -> str:
    """Return a label without the unit of an angle or a length, or of the given quantities, in any
    spelling.

    Example:
        >>> without_unit("Roll (deg)"), without_unit("rx_deg"), without_unit("q_1")
        ('Roll', 'rx', 'q_1')
    """
    return next((base for base, unit in splits(text, *quantities) if unit), name_of(text))


def splits(text: str, *quantities: str) -> Iterator[tuple[str, str]]:
    """Yield the splits of a label into a name and a unit of an angle, a length or the given
    quantities.
    """
    yield name_of(text), unit_in(text) if "[" in text else ""
    known: Collection[str] = {
        unit for quantity in quantities or ("angle", "length") for unit in UNITS[quantity]
    }
    for pattern in _OTHER_SPELLINGS:
        match = re.fullmatch(pattern, text)
        if match and normal_unit(match[2]) in known:
            yield match[1], normal_unit(match[2])


def words_of(text: str) -> tuple[str, ...]:
    """Return the words of a label in lower case, split at signs, capitals and numbers.

    Example:
        >>> words_of("/imu/linearAcceleration.x"), words_of("position[0]")
        (('imu', 'linear', 'acceleration', 'x'), ('position', '0'))
    """
    return tuple(re.findall(r"[^\W\d_]+|\d+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text).casefold()))


def vector_columns(
    labels: Sequence[Label],
    quantities: Mapping[str, str],
    *,
    is_stream: bool = False,
    source: str = "",
) -> dict[str, str]:
    """Return the meanings of labels that name a vector otherwise than by x y z and the like.

    Args:
        labels: unknown columns.
        quantities: what may still be missing.
        is_stream: whether names may have any prefix, such as the topic of a recording, and vectors
            include those of an IMU; otherwise only positions and orientations are sought, the
            components of a position and of a rotation vector by their number as well.
        source: the file, for messages.

    Raises:
        MeasurementError: for a stream with several candidates.

    Example:
        >>> texts = ("TCP_X (mm)", "TCP_Y (mm)", "TCP_Z (mm)", "RMS")
        >>> labels = [Label(i, text, text) for i, text in enumerate(texts)]
        >>> vector_columns(labels, dict.fromkeys("xyz", "length"))
        {'TCP_X (mm)': 'x [mm]', 'TCP_Y (mm)': 'y [mm]', 'TCP_Z (mm)': 'z [mm]'}
    """
    guessed = dict[str, str]()
    for columns, names in _VECTORS.items():
        if not quantities.keys() >= {*columns} or not (is_stream or columns[0] in _OF_TABLES):
            continue
        families = _vector_families(labels, columns, names, quantities, is_stream=is_stream)
        whole = [axes for axes in families.values() if len(axes) == len(columns)]
        if is_stream:
            check_one(
                [[label for label, _ in axes.values()] for axes in whole],
                " ".join(columns),
                source=source,
            )
        if len(whole) == 1:
            by_axis = {column[-1]: column for column in columns}
            pairs = ((label, by_axis[axis], unit) for axis, (label, unit) in whole[0].items())
            guessed |= {
                label.meant: f"{column} [{unit}]" if unit else column
                for label, column, unit in pairs
            }
    return guessed


_Families = dict[tuple[str, ...], dict[str, tuple[Label, str]]]


def _vector_families(
    labels: Sequence[Label],
    columns: tuple[str, ...],
    names: frozenset[str],
    quantities: Mapping[str, str],
    *,
    is_stream: bool,
) -> _Families:
    """Return the labels that may be components of a vector, with their units, by the other words of
    their names and by their axes.
    """
    families: _Families = {}
    letters = {column[-1] for column in columns}
    for label in labels:
        for base, unit in splits(label.meant, quantities[columns[0]]):
            if (found := _axis_of(base, letters, names, is_stream=is_stream)) is not None:
                families.setdefault(found[0], {}).setdefault(found[1], (label, unit))
    counted = {"x": _COUNTED, "rx": _ROTATION_VECTORS}.get(columns[0])
    if counted is None or is_stream or any(len(axes) == len(columns) for axes in families.values()):
        return families
    return _counted_families(labels, counted, quantities[columns[0]])


def _counted_families(labels: Sequence[Label], names: frozenset[str], quantity: str) -> _Families:
    """Return the labels of vectors whose three components have numbers, by their other words."""
    by_number = dict[tuple[str, ...], dict[int, tuple[Label, str]]]()
    for label in labels:
        for base, unit in splits(label.meant, quantity):
            *rest, last = words_of(base) or ("",)
            if last.isdecimal() and " ".join(rest) in names:
                by_number.setdefault(tuple(rest), {}).setdefault(int(last), (label, unit))
    return {
        rest: dict(zip("xyz", (found[k] for k in sorted(found)), strict=True))
        for rest, found in by_number.items()
        if numbers_all(found, 3)
    }


def _axis_of(
    base: str, letters: Collection[str], names: frozenset[str], *, is_stream: bool
) -> tuple[tuple[str, ...], str] | None:
    """Return the words and the axis of a component of a vector of some names; None for any other
    label.
    """
    # ``posx`` is one word.
    parts = [
        part
        for word in words_of(base)
        for part in (
            (word[:-1], word[-1]) if word[:-1] in names and word[-1] in letters else (word,)
        )
    ]
    axes = [part for part in parts if part in letters]
    rest = tuple(part for part in parts if part not in axes)
    is_named = names.issuperset(rest)
    if is_stream:
        ends = [k for k in (2, 1) if " ".join(rest[-k:]) in names]
        # A single letter after the axis is a unit: ``accel_x_g``.
        is_name = bool(ends) and (len(rest[-1]) > 1 or parts[-1] in axes)
        is_named = is_name and not (_OTHERS - names) & {*rest[: -ends[0]]}
    elif names is not _PLACES:
        # An orientation may be named with the body, as in ``tcp_quat_x``.
        ends = [k for k in (2, 1) if rest and " ".join(rest[-k:]) in names]
        is_named = bool(ends) and _PLACES.issuperset(rest[: -ends[0]])
    return (rest, axes[0]) if len(axes) == 1 and rest and is_named else None


def check_one(
    families: Sequence[Sequence[Label]], what: str, *, source: str, example: str = ""
) -> None:
    """Refuse several sets of columns with the same meaning."""
    if len(families) > 1:
        firsts = " and ".join(f'"{family[0].text}"' for family in families)
        cure = f"{families[-1][0].text}={example or what.split()[0]}"
        raise MeasurementError(
            f"{source}: {what} may be the columns of {firsts}; expected one set: name the right "
            f"ones (--columns '{cure}{',...' if len(families[-1]) > 1 else ''}'), or leave out the "
            "others (--ignore)"
        )


def joint_families(
    labels: Sequence[Label], joints: Collection[str]
) -> list[dict[str, tuple[Label, str]]]:
    """Return columns that name joints among other words, with their units, by joint: one entry for
    each set of words.

    The word joint, topics and namespaces before a name, and words for a position are disregarded;
    velocities and commanded positions are excluded.

    Example:
        >>> topic = "/joint_states/elbow_joint"
        >>> texts = (f"{topic}/position", f"{topic}/velocity", "elbow.pos")
        >>> labels = [Label(i, text, text) for i, text in enumerate(texts)]
        >>> [family["elbow_joint"][0].text for family in joint_families(labels, ["elbow_joint"])]
        ['/joint_states/elbow_joint/position', 'elbow.pos']
    """
    cores = {joint: _core(joint) for joint in joints}
    families = dict[tuple[tuple[str, ...], ...], dict[str, tuple[Label, str]]]()
    for label in labels:
        for base, unit in splits(label.meant):
            words = _core(base)
            found = list[tuple[int, int, str]]()
            for joint, core in cores.items():
                found += [
                    (len(core), at, joint)
                    for at in range(len(words) - len(core) + 1)
                    if words[at : at + len(core)] == core
                ]
            if not found:
                continue
            size, at, joint = max(found)
            before = words[:at]
            after = words[at + size :]
            if not _OTHERS & {*before, *after} and _POSITIONS.issuperset(after):
                families.setdefault((before, after), {}).setdefault(joint, (label, unit))
                break
    return list(families.values())


def _core(name: str) -> tuple[str, ...]:
    """Return the words of a name without the word joint, unless only a number would remain."""
    words = words_of(name)
    short = tuple(word for word in words if word != "joint")
    return short if any(word.isalpha() for word in short) else words


def numbered_families(
    labels: Sequence[Label], *, is_stream: bool = False
) -> list[tuple[tuple[str, ...], dict[int, tuple[Label, str]]]]:
    """Return columns of numbered joints, with their units, by number: one entry for each set of
    words around the number.

    Args:
        labels: the columns.
        is_stream: whether the number may be among other words.
    """
    families = dict[tuple[str, ...], dict[int, tuple[Label, str]]]()
    for label in labels:
        for base, unit in splits(re.sub(r"\[(\d+)\]", r"_\1", label.meant)):
            if found := _amid_words(base) if is_stream else _after_name(base):
                words, number = found
                families.setdefault(words, {}).setdefault(number, (label, unit))
                break
    return list(families.items())


def numbers_all(family: Collection[int], n: int) -> bool:
    """Return whether the numbers are 0 to n - 1 or 1 to n."""
    return sorted(family) in ([*range(n)], [*range(1, n + 1)])


def _after_name(base: str) -> tuple[tuple[str, ...], int] | None:
    match = NUMBERED.fullmatch(base)
    return match and ((base[: match.start(2)].casefold(),), int(match[2]))


def _amid_words(base: str) -> tuple[tuple[str, ...], int] | None:
    words = words_of(base)
    at = next((k for k in range(len(words) - 1, 0, -1) if words[k].isdigit()), 0)
    is_joint = (
        at
        and words[at - 1] in _NUMBERS
        and _POSITIONS.issuperset(words[at + 1 :])
        and not _OTHERS & {*words}
    )
    return ((*words[:at], *words[at + 1 :]), int(words[at])) if is_joint else None
