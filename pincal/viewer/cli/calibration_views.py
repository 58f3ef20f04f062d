"""The view in three dimensions that accompanies a report."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pincal.calibration.calibration import Calibration
from pincal.cli.fitting import VIEW
from pincal.measure.table import concatenate
from pincal.thresholds import Count
from pincal.viewer import build_scene, write_html

# Most stations with their own view: a page is about a megabyte.
_MOST_VIEWS: Count = 12


def write_views(folder: Path, calibration: Calibration) -> None:
    """Write the 3D view; of several stations, a page for each, the first one under the
    usual name.
    """
    stations = calibration.stations[:_MOST_VIEWS]
    names = [
        VIEW if k == 0 else f"{Path(VIEW).stem}-{rows.name}{Path(VIEW).suffix}"
        for k, rows in enumerate(stations)
    ]
    for rows, name in zip(stations, names, strict=True):
        table = concatenate([rows.train, rows.test]) if len(rows.test) else rows.train
        held = np.repeat([False, True], [len(rows.train), len(rows.test)])
        others = ", ".join(other for other in names if other != name)
        notes = [f"station {rows.name}; the others are in {others}"] if others else []
        model = calibration.fit.at(rows.name) if others else calibration.fit.robot_model()
        write_html(
            folder / name.replace("/", "_"),
            build_scene(model, table, held_out=held).opening(notes=notes),
        )
