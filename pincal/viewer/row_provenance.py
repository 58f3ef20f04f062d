"""Which rows of a table a calibration saw, as far as its own files tell."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from pincal.measure.measurements import Measurements


def held_out_rows(
    provenance: dict[str, Any], residuals: Path, data: Path, measurements: Measurements
) -> tuple[np.ndarray | None, str]:
    """Return which rows of a table were held out of a calibration, and in words how this is known.

    Args:
        provenance: of the calibrated model; names its input files with their SHA-256, the training table first.
        residuals: the calibration's ``residuals.csv``; need not exist.
        data: the table's file.
        measurements: its rows.

    Returns:
        Shape (N,), True for rows that the fit did not see, or None if unknown; and the reason.
    """
    import polars as pl

    inputs = provenance.get("inputs")
    known = list(inputs.values()) if isinstance(inputs, dict) else []
    if not known:
        return None, f"the model names no input files, so nobody knows which rows of {data.name} it was fitted to"
    digest, unseen = hashlib.sha256(data.read_bytes()).hexdigest(), np.ones(len(measurements), bool)
    if digest not in known:
        return unseen, f"{data.name} is none of the model's input files: all rows count as held out"
    try:
        table = pl.read_csv(residuals)
        if "station" in table.columns:
            # Of several stations each table is one of them, named by its file.
            table = table.filter(pl.col("station") == data.stem)
        if digest != known[0] and not ("station" in table.columns and len(table)):
            return unseen, f"{data.name} was held out of the fit as a whole"
        fitted = table.filter(pl.col("rows") == "fitted")["line"].cast(pl.Int64).to_numpy()
    except (OSError, pl.exceptions.PolarsError):
        return None, f"which rows were held out stands in {residuals.name}, which is not beside the model: none is marked"
    held = ~np.isin(measurements.rows, fitted)
    words = f"{held.sum()} of {len(held)} rows were held out of the fit" if held.any() else "no row was held out of the fit"
    return held, words
