"""The rows of a calibration without readings that are wrong by the others of their pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pincal.calibration.held_out import StationRows
from pincal.identify.fit import ModelFit
from pincal.identify.screening import wrong_readings
from pincal.measure.poses import SCATTER, replicate_groups


def screened(fit: ModelFit, parts: Sequence[StationRows]) -> tuple[StationRows, ...]:
    """Return the rows of each station, in the order of the fit, without wrong readings, held-out
    ones among them.

    Readings that the fit left out are known; held-out ones are judged by it.
    """
    held = wrong_readings(fit, {part.name: part.measured[1] for part in parts})
    found = []
    for k, part in enumerate(parts):
        train, test = part.measured
        in_train = fit.wrong[k] if fit.wrong else np.zeros(len(train), bool)
        in_test = held[part.name]
        if not in_train.any() and not in_test.any():
            found.append(part)
            continue
        pose = replicate_groups([test], within=SCATTER)[0]
        ways = {way: test.rows[mask[pose]] for way, mask in part.ways.items()}
        fitted = train.select(~in_train)
        clean = StationRows.of(part.name, fitted, test.select(~in_test), ways)
        lines = np.concatenate([train.rows[in_train], test.rows[in_test]])
        found.append(
            replace(clean, wrong=tuple(sorted(lines.tolist())), screened_from=part.measured)
        )
    return tuple(found)
