"""JSON, YAML, NumPy's .npy and .npz, MATLAB's .mat and OpenCV's FileStorage as sheets: lists of
records, or columns of numbers and lists.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pincal.errors import MeasurementError, needed, warn
from pincal.measure.hand_eye import grouped, is_of_hand, tracked_poses
from pincal.measure.nameless import with_poses_in_rows
from pincal.measure.nested_labels import IS_OF_CONTROLLER, TURNED, vector_labels
from pincal.measure.sheet import FrameSheet, Sheet, check_unpacked
from pincal.measure.sheet_reader import SheetOptions, SheetReader
from pincal.readers.nested_values import MOST_VALUES, by_path, flat
from pincal.readers.opencv_storage import (
    TAG,
    is_storage,
    matrix,
    read_xml,
    with_arrays,
    without_directive,
)

# Keys that state whether the camera is on the hand.
_ON_HAND = ("eye_on_hand", "eye_in_hand")
# Columns that only one value of a file may give: of a position, orientations and joints.
_FIRST_COLUMNS = ("x", "qx", "rx", "joint_1")
_YAML = (".yaml", ".yml", ".samples")


def nested_kind(path: Path) -> str:
    """Return "json", "yaml", "npy", "npz", "mat" or "xml" for a file of such contents; empty for
    any other.
    """
    with path.open("rb") as file:
        head = file.read(4096)
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if head.startswith(b"PK\x03\x04") and (path.suffix.lower() == ".npz" or b".npy" in head[:200]):
        return "npz"
    if head.startswith(b"\x93NUMPY"):
        return "npy"
    if is_storage(head):
        return "xml"
    if head.startswith(b"MATLAB ") or path.suffix.lower() == ".mat":
        return "mat"
    if re.match(rb'[{]\s*["}]|\[\s*[{\[]', start) and b"\0" not in head:
        return "json"
    is_yaml = path.suffix.lower() in _YAML or re.match(
        rb"---\s|%YAML|- *\n|- \w+:\s|\w+:[ ]*\n\s*- ", start
    )
    return "yaml" if is_yaml and b"\0" not in head else ""


def open_nested(path: Path, kind: str, *, ignore: Collection[str] = (), joints: int = 0) -> Sheet:
    """Read a file of records or columns, of a kind returned by :func:`nested_kind`.

    Args:
        path: the file.
        kind: its kind.
        ignore: keys of values to leave out.
        joints: of the arm, by which it is judged whether numbers without names have a pose in each
            row or in each column.

    Raises:
        MeasurementError: for a file that can't be read or has no table.
    """
    import polars as pl

    try:
        data = _READERS[kind](path)
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
    columns = _table(_alone(data, path.name, joints), path.name, ignore)
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
        return with_arrays(msgspec.json.decode(text))
    except msgspec.DecodeError:
        return [
            with_arrays(msgspec.json.decode(line)) for line in text.splitlines() if line.strip()
        ]


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

    def stored(loader: Any, node: Any) -> np.ndarray:
        return matrix(loader.construct_mapping(node, deep=True))

    Plain.add_constructor(TAG, stored)
    documents = [*yaml.load_all(without_directive(path.read_bytes()), Plain)]
    # ``rostopic echo`` ends each message by three dashes.
    whole = [each for each in documents if each is not None]
    return whole[0] if len(whole) == 1 else whole


def _npy(path: Path) -> Any:
    found = np.load(path, allow_pickle=False)
    if found.dtype.names:
        return {name: found[name] for name in found.dtype.names}
    return found


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


_READERS = {
    "json": _json,
    "yaml": _yaml,
    "npy": _npy,
    "npz": _npz,
    "mat": _mat,
    "xml": read_xml,
}


@dataclass(frozen=True, eq=False)
class _Value:
    """The columns of one value of a file, by its keys.

    Attributes:
        path: the keys, separated by dots.
        labels: of its columns.
        columns: shape (N,) each.
        note: on an assumed order of components, or an empty one.
    """

    path: str
    labels: tuple[str, ...]
    columns: tuple[np.ndarray, ...]
    note: str = ""

    @classmethod
    def of(cls, path: str, values: np.ndarray, names: list[Any] | None) -> _Value:
        """Return the columns of values, shape (N, ...); ``names`` are those of joints."""
        if values.ndim < 2:
            return cls(path, (_scalar_label(path),), (values,))
        labels, columns, note = vector_labels(path, values, names)
        return cls(path, labels, tuple(columns), note)

    @property
    def places(self) -> set[str]:
        """The first columns of a reading or of joints, of which a table has one each."""
        return {label.split(" [")[0] for label in self.labels} & {*_FIRST_COLUMNS}

    def is_of(self, role: Callable[[str], bool]) -> bool:
        """Return whether any of its keys has a role."""
        return any(map(role, self.path.split(".")))


def _table(data: Any, source: str, ignore: Collection[str]) -> dict[str, np.ndarray]:
    """Return the columns of a table, shape (N,) each, as numbers or as objects."""
    columns = {grouped(path): values for path, values in by_path(data, source).items()}
    columns = _with_tracked_poses(columns, data, source)
    lists = ((path, value) for path, value in flat(data) if isinstance(value, list))
    given = next((list(value) for path, value in lists if re.search(r"names?$", path)), None)
    values = [
        _Value.of(path, of, given)
        for path, of in columns.items()
        if not {path, path.split(".")[0]} & {*ignore}
        and (of.ndim < 2 or (of.dtype != object and int(np.prod(of.shape[1:])) <= MOST_VALUES))
    ]
    found = dict[str, np.ndarray]()
    for value in _without_others(values, source):
        for label, column in zip(value.labels, value.columns, strict=True):
            found[f"{value.path}.{label}" if label in found else label] = column
    if not found:
        raise MeasurementError(
            f"{source}: no table in the file; expected a list of records, or columns of one length"
        )
    for note in dict.fromkeys(value.note for value in values if value.note):
        warn(f"{source}: {note}")
    return found


def _without_others(values: list[_Value], source: str) -> list[_Value]:
    """Return the values of a table with one reading; refuse several of which none is known to be
    the controller's.
    """
    for first in _FIRST_COLUMNS:
        rivals = [value for value in values if first in value.places]
        several = [value for value in rivals if not value.is_of(is_of_hand)] or rivals
        if len(several) > 1 and not all(map(partial(_are_equal, several[0]), several)):
            named = " and ".join(f'"{value.path}"' for value in several)
            raise MeasurementError(
                f"{source}: {first} may be of {named}; expected one of them: leave the others out "
                f"(--ignore '{several[-1].path}')"
            )
        gone = [value for value in rivals if value is not several[0]]
        values = [value for value in values if not any(value is other for other in gone)]
    return values


def _are_equal(one: _Value, other: _Value) -> bool:
    """Return whether two values are the same columns."""
    return one.labels == other.labels and all(
        np.array_equal(a, b, equal_nan=a.dtype != object)
        for a, b in zip(one.columns, other.columns, strict=True)
    )


def _alone(data: Any, source: str, joints: int) -> Any:
    """Return the values of a file, of a single matrix without a telling name the matrix alone, with
    a pose in each row.
    """
    found = [(path, v) for path, v in flat(data) if isinstance(v, np.ndarray) and v.ndim > 1]
    if len(found) != 1 or found[0][1].ndim != 2 or found[0][1].dtype.kind not in "fiub":
        return data
    ((path, values),) = found
    if isinstance(data, Mapping) and not vector_labels(path, values)[0][0].startswith(f"{path}."):
        return data
    turned = with_poses_in_rows(values, joints)
    if turned is not values:
        rows, columns = values.shape
        warn(f"{source}: {rows} x {columns} numbers; each column is read as a pose")
    return turned


def _with_tracked_poses(
    columns: dict[str, np.ndarray], data: Any, source: str
) -> dict[str, np.ndarray]:
    """Return the columns with the poses of a hand-eye calibration instead of its groups."""
    on_hand = (
        v for path, v in flat(data) if path.split(".")[-1] in _ON_HAND and isinstance(v, bool)
    )
    tracked = tracked_poses(columns, is_on_hand=next(on_hand, None), source=source)
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


class _Nested:
    """Reads nested values of all these formats."""

    def reads(self, path: Path) -> bool:
        return bool(nested_kind(path))

    def open(self, path: Path, options: SheetOptions) -> Sheet:
        return open_nested(
            path, nested_kind(path), ignore=options.ignore, joints=len(options.joints)
        )


NESTED: SheetReader = _Nested()
