"""JSON, YAML, NumPy's .npz and MATLAB's .mat as sheets: lists of records, or columns of numbers and lists."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pincal.errors import MeasurementError, needed, warn
from pincal.measure.handeye import tracked_poses
from pincal.measure.sheet import FrameSheet, Sheet, check_unpacked
from pincal.measure.vectors import IS_OF_CONTROLLER, TURNED, vector_labels

_YAML = (".yaml", ".yml", ".samples")
# How deep what is measured may nest, and values that a record may have.
_DEEPEST, _MOST = 12, 2000


def nested_kind(path: Path) -> str:
    """Return "json", "yaml", "npz" or "mat" for a file of this kind, by its contents; empty for any other."""
    with path.open("rb") as file:
        head = file.read(4096)
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if head.startswith(b"PK\x03\x04") and (path.suffix.lower() == ".npz" or b".npy" in head[:200]):
        return "npz"
    if head.startswith(b"MATLAB ") or path.suffix.lower() == ".mat":
        return "mat"
    if re.match(rb'[{]\s*["}]|\[\s*[{\[]', start) and b"\0" not in head:
        return "json"
    is_yaml = path.suffix.lower() in _YAML or re.match(rb"---\s|%YAML|- *\n|- \w+:\s|\w+:[ ]*\n\s*- ", start)
    return "yaml" if is_yaml and b"\0" not in head else ""


def open_nested(path: Path, kind: str) -> Sheet:
    """Read a file of records or columns.

    Args:
        path: the file.
        kind: as :func:`nested_kind` says.

    Raises:
        MeasurementError: for a file that can't be read, or that holds no table.
    """
    import polars as pl

    try:
        data = {"json": _json, "yaml": _yaml, "npz": _npz, "mat": _mat}[kind](path)
    except MeasurementError:
        raise
    except Exception as error:  # Whatever a broken file does to the libraries below.
        reason = " ".join(str(error).split())[:200]
        raise MeasurementError(f"{path.name}: can't be read as {kind} ({reason}); expected a list of records") from error
    if isinstance(data, Mapping) and {"transformation", "parameters"} <= data.keys():
        raise MeasurementError(
            f"{path.name}: the result of a hand-eye calibration; expected the samples that it was made of, with --joints LOG"
        )
    columns = _table(data, path.name)
    found = dict[str, pl.Series]()
    for label, values in columns.items():
        if values.dtype == object:
            texts = [None if v is None else str(v) if isinstance(v, str | int | float) else "" for v in values]
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
        """A loader without references, which make a small file a large one."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.events.AliasEvent):
                raise MeasurementError(f"{path.name}: holds references (*name); expected plain values")
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
        raise MeasurementError(f"{path.name}: MATLAB's format 7.3 is not read; expected save(..., '-v7')")
    check_unpacked(path, sum(8 * int(np.prod(shape, dtype=float)) for _, shape, _ in scipy.io.whosmat(path)))
    found = scipy.io.loadmat(path, simplify_cells=True)
    return {name: value for name, value in found.items() if not name.startswith("__")}


def _table(data: Any, source: str) -> dict[str, np.ndarray]:
    """Return the columns of a table, shape (N,) each, as numbers or as objects."""
    columns = _by_path(data, source)
    if (poses := tracked_poses(columns, is_on_hand=_said(data, "eye_on_hand"), source=source)) is not None:
        columns = {path: v for path, v in columns.items() if path.split(".")[0] not in poses.groups}
        columns |= {"pose": poses.matrices}
    names = {path: list(value) for path, value in _flat(data) if re.search(r"names?$", path) and isinstance(value, list)}
    given = next(iter(names.values()), None)
    found, notes = dict[str, np.ndarray](), list[str]()
    for path, values in columns.items():
        shape = values.shape[1:]
        if not shape:
            labels, parts = [_scalar_label(path)], [values]
        elif values.dtype == object or int(np.prod(shape)) > _MOST:
            continue
        else:
            several, parts, note = vector_labels(path, values, given)
            labels, notes = [*several], [*notes, *([note] if note else [])]
        if taken := [label for label in labels if label in found]:
            labels = [f"{path}.{label}" if label in taken else label for label in labels]
        found |= dict(zip(labels, parts, strict=True))
    if not found:
        raise MeasurementError(f"{source}: no table in the file; expected a list of records, or columns of one length")
    for note in dict.fromkeys(notes):
        warn(f"{source}: {note}")
    return found


def _scalar_label(path: str) -> str:
    """Return the label of a plain value by its place: that of a component of an orientation begins with q."""
    *above, leaf = path.split(".")
    if leaf in ("x", "y", "z", "w") and any(IS_OF_CONTROLLER.fullmatch(part) for part in above):
        return path
    turned = above and TURNED.fullmatch(above[-1]) and leaf in ("x", "y", "z", "w")
    return f"q{leaf}" if turned else leaf


def _by_path(data: Any, source: str) -> dict[str, np.ndarray]:
    """Return what has one length N, by its place in the file: shape (N, ...)."""
    records = data if isinstance(data, list) else None
    if isinstance(data, Mapping):
        lists = {path: v for path, v in _flat(data) if isinstance(v, list) and v and all(isinstance(r, Mapping) for r in v)}
        if len(lists) > 1:
            raise MeasurementError(f"{source}: several lists of records: {', '.join(lists)}; expected one")
        records = next(iter(lists.values()), None)
    if records is not None:
        if not records or not all(isinstance(record, Mapping) for record in records):
            raise MeasurementError(f"{source}: a list without records; expected one record with names a pose")
        rows = [dict(_flat(record)) for record in records]
        paths = dict.fromkeys(path for row in rows for path in row)
        if len(paths) > _MOST:
            raise MeasurementError(f"{source}: {len(paths)} values a record; expected at most {_MOST}")
        return {path: _array([row.get(path) for row in rows]) for path in paths}
    if not isinstance(data, Mapping):
        raise MeasurementError(f"{source}: holds one value; expected a list of records, or columns of one length")
    found = {path: _array(v) for path, v in _flat(data) if isinstance(v, list | np.ndarray)}
    found = {path: np.moveaxis(v, -1, 0) if v.shape[:2] == (4, 4) and v.ndim == 3 else v for path, v in found.items()}
    lengths = [len(v) for path, v in found.items() if v.ndim and not re.search(r"names?$", path)]
    count = max(set(lengths), key=lambda length: (lengths.count(length), length), default=0)
    left = [path for path, v in found.items() if not v.ndim or len(v) != count]
    if left:
        warn(f"{source}: of another length than the {count} rows and left out: {', '.join(left[:20])}")
    return {path: v for path, v in found.items() if path not in left}


def _flat(value: Any, path: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested mappings by their place."""
    if not isinstance(value, Mapping):
        yield path, value
    elif depth < _DEEPEST:
        for name, inner in value.items():
            yield from _flat(inner, f"{path}.{name}" if path else str(name), depth + 1)


def _array(values: Any) -> np.ndarray:
    """Return values as numbers, nothing as nan, else as they are."""
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


def _said(data: Any, name: str) -> bool | None:
    """Return a value yes or no that a file has somewhere, by its name."""
    found = [v for path, v in _flat(data) if path.split(".")[-1] == name and isinstance(v, bool)]
    return found[0] if found else None
