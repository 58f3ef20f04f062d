"""JSON, YAML, NumPy's .npz and MATLAB's .mat as sheets: lists of records, or columns of numbers and
lists.

The columns of a list of numbers follow from its name and length.

Samples of hand-eye calibrations (MoveIt, easy_handeye) hold the pose of an object in a camera for
each pose of the robot. With a fixed camera the object is on the hand, and its pose is that of a
tool. With the camera on the hand the object is fixed, and the inverse is the pose of the camera in
the object's frame. The samples determine which: relative rotations of hand and object are
consistent in one of the two cases only.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pincal.errors import MeasurementError, needed, warn
from pincal.measure.reading_numbers import LAYOUT
from pincal.measure.sheet import FrameSheet, Sheet, check_unpacked
from pincal.robot.se3 import transform
from pincal.thresholds import Count

JOINTS = re.compile(
    r"(joints?|joint_?(positions?|values?|angles?|states?|pos)|(actual_?)?q|qpos|angles?|state)"
    r"(_deg|_rad)?",
    re.I,
)
"""Names of lists of joint positions."""
PLACE = re.compile(
    r"(position|pos|xyz|translation|point|p|t|trans|tvec|target|place|measured)(_mm|_m)?", re.I
)
TURNED = re.compile(r"(orientation|rotation|quaternions?|quat|q|ori|rot|R)(_?(xyzw|wxyz))?", re.I)
POSE = re.compile(r".*(pose|transform|T|matrix|wrt).*", re.I)
IS_OF_CONTROLLER = re.compile(
    r"robot|effector_wrt_world|(actual_)?tcp(_pose)?|flange|ee_pos(e)?|end_?effector", re.I
)
"""Names of poses that a controller computes from the joints, which are no measurements."""
_UNIT = re.compile(r".*[_ \[(](deg|rad|mm|cm|m)[\])]?")
_AXES = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_ORDER = "quaternions in lists are read in the order x y z w; if that is wrong, call them wxyz"


def vector_labels(
    path: str, values: np.ndarray, names: Sequence[str] | None = None
) -> tuple[tuple[str, ...], list[np.ndarray], str]:
    """Return labels and columns of N lists or matrices, and a note on an assumed order of
    components, or an empty one.

    Args:
        path: their keys in the file, separated by dots.
        values: shape (N, ...).
        names: of the joints, where the file has them.

    Example:
        >>> vector_labels("tool.pose", np.zeros((2, 7)))[0]
        ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
    """
    key = path.split(".")[-1]
    if not JOINTS.fullmatch(key) and any(
        IS_OF_CONTROLLER.fullmatch(part) for part in path.split(".")
    ):
        return *_numbered(path, values), ""
    if values.shape[1:] == (4, 4) or (values.shape[1:] == (16,) and POSE.fullmatch(key)):
        matrices = values.reshape(-1, 4, 4)
        return (
            (*_AXES, *_QUATERNION),
            [*matrices[:, :3, 3].T, *quaternions_of(matrices[:, :3, :3]).T],
            "",
        )
    if values.shape[1:] == (3, 3):
        return _QUATERNION, [*quaternions_of(values).T], ""
    if values.ndim != 2:
        return *_numbered(path, values), ""
    labels, note = _plain(key, values.shape[1], names)
    if not labels:
        return *_numbered(path, values), ""
    unit = match[1] if (match := _UNIT.fullmatch(key)) else ""
    return (
        tuple(f"{label} [{unit}]" if unit and label[0] != "q" else label for label in labels),
        [*values.T],
        note,
    )


def _plain(key: str, count: int, names: Sequence[str] | None) -> tuple[tuple[str, ...], str]:
    """Return the labels of ``count`` numbers and a note; no labels if undetermined."""
    if (
        names is not None
        and len(names) == count
        and (JOINTS.fullmatch(key) or "state" in key or "position" in key)
    ):
        return tuple(map(str, names)), ""
    if count == 3 and PLACE.fullmatch(key):
        return _AXES, ""
    if count == 4 and TURNED.fullmatch(key):
        return (("qw", "qx", "qy", "qz"), "") if "wxyz" in key.casefold() else (_QUATERNION, _ORDER)
    if count == 3 and key.casefold() in ("rotvec", "rvec", "rotation_vector"):
        return ("rx", "ry", "rz"), ""
    if count == 3 and key.casefold() in ("rpy", "euler"):
        return ("roll", "pitch", "yaw"), ""
    if count in (6, 7) and POSE.fullmatch(key) and not JOINTS.fullmatch(key):
        return ((*_AXES, "rx", "ry", "rz"), "") if count == 6 else ((*_AXES, *_QUATERNION), _ORDER)
    if count == 2 and key.casefold() in ("uv", "pixel", "pixels", "image"):
        return ("u", "v"), ""
    if JOINTS.fullmatch(key):
        return tuple(f"joint_{i + 1}" for i in range(count)), ""
    return (), ""


def quaternions_of(matrices: np.ndarray) -> np.ndarray:
    """Return quaternions x y z w of rotation matrices, shape (N, 3, 3); NaN for other matrices."""
    found = np.full((len(matrices), 4), np.nan)
    product = np.einsum("nij,nkj->nik", matrices, matrices)
    right = np.isfinite(matrices).all(axis=(1, 2)) & (
        np.abs(product - np.eye(3)).max(axis=(1, 2)) < 1e-2
    )
    right &= np.linalg.det(np.where(right[:, None, None], matrices, np.eye(3))) > 0
    found[right] = Rotation.from_matrix(matrices[right]).as_quat() if right.any() else found[right]
    return found


def _numbered(path: str, values: np.ndarray) -> tuple[tuple[str, ...], list[np.ndarray]]:
    flat = values.reshape(len(values), -1)
    return tuple(f"{path}.{i}" for i in range(flat.shape[1])), [*flat.T]


_OF_ROBOT = ("effector_wrt_world", "robot")
_OF_OBJECT = ("object_wrt_sensor", "tracking", "optical")


def _tracked_poses(
    columns: Mapping[str, np.ndarray], *, is_on_hand: bool | None, source: str
) -> tuple[np.ndarray, tuple[str, str]] | None:
    """Return the poses of a hand-eye calibration, shape (N, 4, 4), and the keys of its groups; None
    for other files.

    Refused if neither the file nor the samples determine whether the camera is on the hand.
    """
    parts = {path.split(".")[0] for path in columns}
    robot, seen = (
        next((name for name in names if name in parts), None) for names in (_OF_ROBOT, _OF_OBJECT)
    )
    if robot is None or seen is None:
        return None
    hand, object_ = (_matrices(columns, name, source=source) for name in (robot, seen))
    evidence = "as the file states"
    if is_on_hand is None:
        fixed = _misfit(hand, object_)
        moved = _misfit(hand, np.linalg.inv(object_))
        if min(fixed, moved) > LAYOUT.clear * max(fixed, moved):
            raise MeasurementError(
                f"{source}: {len(hand)} samples do not show whether the camera is on the "
                f"hand ({moved:.3g} rad) or fixed "
                f"({fixed:.3g} rad); expected more samples with rotations about different axes"
            )
        is_on_hand = moved < fixed
        evidence = "as the samples show"
    where = "on the hand and the object fixed" if is_on_hand else "fixed and the object on the hand"
    warn(
        f"{source}: {len(hand)} samples of a hand-eye calibration with the camera "
        f"{where}, {evidence}; {robot} is not used"
    )
    return np.linalg.inv(object_) if is_on_hand else object_, (robot, seen)


def _matrices(columns: Mapping[str, np.ndarray], group: str, *, source: str) -> np.ndarray:
    """Return the poses of a group of a file, shape (N, 4, 4)."""
    found = dict[str, np.ndarray]()
    for path, values in columns.items():
        if path.split(".")[0] == group:
            inner = "pose" + path.removeprefix(group)
            if values.ndim > 1:
                labels, parts, _ = vector_labels(inner, values)
                found |= dict(zip(labels, parts, strict=True))
            else:
                *_, above, leaf = ("", *inner.split("."))
                found["q" * above.startswith(("rot", "ori")) + leaf] = values
    try:
        place, turned = (
            np.column_stack([np.asarray(found[n], float) for n in ns])
            for ns in ("xyz", ("qx", "qy", "qz", "qw"))
        )
        rotations = Rotation.from_quat(turned).as_matrix()
    except (KeyError, ValueError, TypeError) as error:
        raise MeasurementError(
            f"{source}: {group} does not hold a pose in each sample; expected translation "
            "and rotation"
        ) from error
    if np.isnan(quaternions_of(rotations)).any() or not np.isfinite(place).all():
        raise MeasurementError(
            f"{source}: {group} does not hold a pose in each sample; expected finite numbers"
        )
    return transform(rotations, place)


def _misfit(hand: np.ndarray, target: np.ndarray) -> float:
    """Return the residual of the rotations of two bodies from sample to sample as those of one
    rigid body [rad].
    """
    turns = [
        Rotation.from_matrix(np.einsum("nji,njk->nik", T[:-1, :3, :3], T[1:, :3, :3])).as_rotvec()
        for T in (hand, target)
    ]
    found = Rotation.align_vectors(*turns)[0] if len(turns[0]) else Rotation.identity()
    return (
        float(np.sqrt(np.mean((turns[0] - found.apply(turns[1])) ** 2))) if len(turns[0]) else 0.0
    )


_YAML = (".yaml", ".yml", ".samples")
# Deepest nesting of measured values, and most values of a record.
_DEEPEST: Count = 12
_MOST: Count = 2000


def nested_kind(path: Path) -> str:
    """Return "json", "yaml", "npz" or "mat" for a file of such contents; empty for any other."""
    with path.open("rb") as file:
        head = file.read(4096)
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if head.startswith(b"PK\x03\x04") and (path.suffix.lower() == ".npz" or b".npy" in head[:200]):
        return "npz"
    if head.startswith(b"MATLAB ") or path.suffix.lower() == ".mat":
        return "mat"
    if re.match(rb'[{]\s*["}]|\[\s*[{\[]', start) and b"\0" not in head:
        return "json"
    is_yaml = path.suffix.lower() in _YAML or re.match(
        rb"---\s|%YAML|- *\n|- \w+:\s|\w+:[ ]*\n\s*- ", start
    )
    return "yaml" if is_yaml and b"\0" not in head else ""


def open_nested(path: Path, kind: str) -> Sheet:
    """Read a file of records or columns, of a kind returned by :func:`nested_kind`.

    Raises:
        MeasurementError: for a file that can't be read or has no table.
    """
    import polars as pl

    try:
        data = {"json": _json, "yaml": _yaml, "npz": _npz, "mat": _mat}[kind](path)
    except MeasurementError:
        raise
    except Exception as error:  # Broken files raise all kinds of errors in these libraries.
        reason = " ".join(str(error).split())[:200]
        raise MeasurementError(
            f"{path.name}: can't be read as {kind} ({reason}); expected a list of records"
        ) from error
    if isinstance(data, Mapping) and {"transformation", "parameters"} <= data.keys():
        raise MeasurementError(
            f"{path.name}: the result of a hand-eye calibration; expected the samples "
            "behind it, with --joints LOG"
        )
    columns = _table(data, path.name)
    found = dict[str, pl.Series]()
    for label, values in columns.items():
        if values.dtype == object:
            texts = [
                None if v is None else str(v) if isinstance(v, str | int | float) else ""
                for v in values
            ]
            found[label] = pl.Series(label, texts, dtype=pl.String)
        else:
            found[label] = pl.Series(label, values)
    return FrameSheet(path, tuple(found), False, pl.LazyFrame(found))


def _json(path: Path) -> Any:
    import msgspec

    text = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    try:
        return msgspec.json.decode(text)
    except msgspec.DecodeError:
        return [msgspec.json.decode(line) for line in text.splitlines() if line.strip()]


def _yaml(path: Path) -> Any:
    with needed("PyYAML", f"{path.name}: YAML files", error=MeasurementError):
        import yaml

    class Plain(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
        """A loader without references, by which a small file could expand to a large one."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.events.AliasEvent):
                raise MeasurementError(
                    f"{path.name}: holds references (*name); expected plain values"
                )
            return super().compose_node(parent, index)

    return yaml.load(path.read_bytes(), Plain)


def _npz(path: Path) -> Any:
    with zipfile.ZipFile(path) as parts:
        check_unpacked(path, sum(part.file_size for part in parts.infolist()))
    with np.load(path, allow_pickle=False) as parts:
        return {name: parts[name] for name in parts.files}


def _mat(path: Path) -> Any:
    import scipy.io

    if path.read_bytes()[:10] == b"MATLAB 7.3":
        raise MeasurementError(
            f"{path.name}: MATLAB's format 7.3 is not read; expected save(..., '-v7')"
        )
    check_unpacked(
        path, sum(8 * int(np.prod(shape, dtype=float)) for _, shape, _ in scipy.io.whosmat(path))
    )
    found = scipy.io.loadmat(path, simplify_cells=True)
    return {name: value for name, value in found.items() if not name.startswith("__")}


def _table(data: Any, source: str) -> dict[str, np.ndarray]:
    """Return the columns of a table, shape (N,) each, as numbers or as objects."""
    columns = _with_tracked_poses(_by_path(data, source), data, source)
    lists = ((path, value) for path, value in _flat(data) if isinstance(value, list))
    given = next((list(value) for path, value in lists if re.search(r"names?$", path)), None)
    found = dict[str, np.ndarray]()
    notes = list[str]()
    for path, values in columns.items():
        shape = values.shape[1:]
        if not shape:
            labels = [_scalar_label(path)]
            parts = [values]
        elif values.dtype == object or int(np.prod(shape)) > _MOST:
            continue
        else:
            several, parts, note = vector_labels(path, values, given)
            labels = [*several]
            notes = [*notes, *([note] if note else [])]
        if taken := [label for label in labels if label in found]:
            labels = [f"{path}.{label}" if label in taken else label for label in labels]
        found |= dict(zip(labels, parts, strict=True))
    if not found:
        raise MeasurementError(
            f"{source}: no table in the file; expected a list of records, or columns of one length"
        )
    for note in dict.fromkeys(notes):
        warn(f"{source}: {note}")
    return found


def _with_tracked_poses(
    columns: dict[str, np.ndarray], data: Any, source: str
) -> dict[str, np.ndarray]:
    """Return the columns with the poses of a hand-eye calibration instead of its groups."""
    on_hand = (
        v for path, v in _flat(data) if path.split(".")[-1] == "eye_on_hand" and isinstance(v, bool)
    )
    tracked = _tracked_poses(columns, is_on_hand=next(on_hand, None), source=source)
    if tracked is None:
        return columns
    poses, groups = tracked
    others = {path: v for path, v in columns.items() if path.split(".")[0] not in groups}
    return others | {"pose": poses}


def _scalar_label(path: str) -> str:
    """Return the label of a scalar by its keys: components of an orientation begin with q."""
    *above, leaf = path.split(".")
    if leaf in ("x", "y", "z", "w") and any(IS_OF_CONTROLLER.fullmatch(part) for part in above):
        return path
    turned = above and TURNED.fullmatch(above[-1]) and leaf in ("x", "y", "z", "w")
    return f"q{leaf}" if turned else leaf


def _by_path(data: Any, source: str) -> dict[str, np.ndarray]:
    """Return the columns of equal length N, by their keys in the file: shape (N, ...)."""
    records = data if isinstance(data, list) else _records(data, source)
    if records is not None:
        return _of_records(records, source)
    if not isinstance(data, Mapping):
        raise MeasurementError(
            f"{source}: holds one value; expected a list of records, or columns of one length"
        )
    found = {path: _array(v) for path, v in _flat(data) if isinstance(v, list | np.ndarray)}
    found = {
        path: np.moveaxis(v, -1, 0) if v.shape[:2] == (4, 4) and v.ndim == 3 else v
        for path, v in found.items()
    }
    lengths = [len(v) for path, v in found.items() if v.ndim and not re.search(r"names?$", path)]
    count = max(set(lengths), key=lambda length: (lengths.count(length), length), default=0)
    others = [path for path, v in found.items() if not v.ndim or len(v) != count]
    if others:
        warn(
            f"{source}: these differ in length from the {count} rows and are left out: "
            f"{', '.join(others[:20])}"
        )
    return {path: v for path, v in found.items() if path not in others}


def _records(data: Any, source: str) -> list[Any] | None:
    """Return the only list of records among nested values; None without any."""
    if not isinstance(data, Mapping):
        return None
    lists = {
        path: v
        for path, v in _flat(data)
        if isinstance(v, list) and v and all(isinstance(r, Mapping) for r in v)
    }
    if len(lists) > 1:
        raise MeasurementError(
            f"{source}: several lists of records: {', '.join(lists)}; expected one"
        )
    return next(iter(lists.values()), None)


def _of_records(records: list[Any], source: str) -> dict[str, np.ndarray]:
    """Return the columns of records, which may lack some of the values."""
    if not records or not all(isinstance(record, Mapping) for record in records):
        raise MeasurementError(
            f"{source}: a list without records; expected one named record per pose"
        )
    rows = [dict(_flat(record)) for record in records]
    paths = dict.fromkeys(path for row in rows for path in row)
    if len(paths) > _MOST:
        raise MeasurementError(
            f"{source}: {len(paths)} values per record; expected at most {_MOST}"
        )
    return {path: _array([row.get(path) for row in rows]) for path in paths}


def _flat(value: Any, path: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested mappings by their keys, separated by dots."""
    if not isinstance(value, Mapping):
        yield path, value
    elif depth < _DEEPEST:
        for name, inner in value.items():
            yield from _flat(inner, f"{path}.{name}" if path else str(name), depth + 1)


def _array(values: Any) -> np.ndarray:
    """Return values as numbers, with NaN for None, else as objects."""
    if isinstance(values, np.ndarray):
        return values if values.dtype.kind in "fiub" else values.astype(object)
    usual = next((v for v in values if isinstance(v, list)), None)
    if usual is not None:
        nothing = np.full(np.shape(usual), np.nan).tolist()
        values = [nothing if v is None else v for v in values]
    try:
        if any(isinstance(v, str | bool) for v in values):
            raise ValueError
        return np.array([np.nan if v is None else v for v in values], float)
    except (TypeError, ValueError, OverflowError):
        found = np.empty(len(values), object)
        found[:] = values
        return found
