"""Rows of a store: measurements and information on machines, as tables for Parquet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from pincal.errors import BadInputError
from pincal.fleet.machines import SCHEMA_VERSION, Machine, labelled, machines_frame
from pincal.measure.measurements import Measurements, validated
from pincal.units import LARGEST

CALIBRATION = "calibration"
CHECK = "check"
ROLES = (CALIBRATION, CHECK)
"""Purposes of measured rows: to calibrate a machine, or to check whether it has changed since."""


def table_frame(table: Measurements, role: str, labels: Mapping[str, str]) -> pl.DataFrame:
    """Return measurements as a table: a column per array, of lists if it has several numbers per
    row.
    """
    n = len(table)
    columns = [
        pl.Series("role", [role] * n, pl.String),
        labelled([labels] * n),
        pl.Series("joints", [list(table.joint_names)] * n, pl.List(pl.String)),
        pl.Series("source", [table.source] * n, pl.String),
    ]
    for name, array in table.columns().items():
        if array.dtype.kind not in "fi":
            columns.append(pl.Series(name, array.astype(str).tolist(), pl.String))
        elif array.ndim == 2:
            columns.append(pl.Series(name, array.astype(float).tolist(), pl.List(pl.Float64)))
        else:
            columns.append(pl.Series(name, np.ascontiguousarray(array)))
    return pl.DataFrame(columns)


def measurements_of(frame: pl.DataFrame, source: str) -> Measurements:
    """Return the measurements of a table of :func:`table_frame`.

    Raises:
        BadInputError: for another schema.
        MeasurementError: for invalid values.
    """
    if (
        "joints" not in frame.columns
        or "q" not in frame.columns
        or frame["schema"][0] != SCHEMA_VERSION
    ):
        raise BadInputError(f"{source}: not a table of a store of version {SCHEMA_VERSION}")
    arrays = dict[str, np.ndarray]()
    for name in frame.columns:
        if name in ("role", "labels", "joints", "source", "schema", "machine", "day", "id"):
            continue
        column = frame[name]
        if isinstance(column.dtype, pl.List):
            arrays[name] = np.array(column.to_list(), float)
        else:
            arrays[name] = (
                np.array(column.to_list(), str) if column.dtype == pl.String else column.to_numpy()
            )
    if any(
        array.dtype.kind in "fi" and not (np.abs(array) <= LARGEST).all()
        for array in arrays.values()
    ):
        raise BadInputError(
            f"{source}: contains numbers that are not finite; delete it and add it again"
        )
    return validated(tuple(frame["joints"][0]), arrays, source=str(frame["source"][0]), units={})


def text_frame(text: str, **facts: Any) -> pl.DataFrame:
    """Return a text, such as the content of a model.json, with further columns as one row."""
    return pl.DataFrame({"text": [text], **{name: [value] for name, value in facts.items()}})


def information_frame(
    machine: Machine,
    role: str,
    *,
    rows: int = 0,
    converged: bool = True,
    noise: Sequence[float] = (),
    off: Sequence[str] = (),
) -> pl.DataFrame:
    """Return information on a machine as one row.

    Args:
        machine: the machine.
        role: one of :data:`ROLES`.
        rows: number of rows of its calibration; 0 if unknown.
        converged: whether the calibration converged.
        noise: of each block of readings [m, rad, px].
        off: elements in which the machine differs from its type.
    """
    columns = [
        pl.Series("role", [role]),
        pl.Series("rows", [rows], pl.Int64),
        pl.Series("converged", [converged]),
        pl.Series("noise", [list(noise)], pl.List(pl.Float64)),
        pl.Series("off", [list(off)], pl.List(pl.String)),
    ]
    return machines_frame([machine]).hstack(columns)
