"""Levers: derivatives of the readings by coordinates of the chain, such as the positions of its
drives.
"""

from __future__ import annotations

import numpy as np

from pincal.identify.station import Station
from pincal.model.motions import with_moving_drives


def drive_levers(station: Station, values: np.ndarray) -> np.ndarray:
    """Return the derivatives of the readings by the position of each drive, shape (n, m, N)."""
    wide = with_moving_drives(station.model)
    of_model, own = station.split(values)
    n = wide.n_parameters - len(of_model)
    whole = np.concatenate([of_model, np.zeros(n), own])
    free = np.zeros(len(whole), bool)
    free[len(of_model) : len(of_model) + n] = True
    parts = station.with_model(wide).linearise(whole, free)
    return np.concatenate([J for _, _, J in parts], axis=2)
