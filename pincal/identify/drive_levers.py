"""Levers: derivatives of the readings by coordinates of the chain, such as the positions of its
drives.
"""

from __future__ import annotations

import numpy as np

from pincal.identify.station import Station
from pincal.model.motions import Motions


def drive_levers(station: Station, values: np.ndarray) -> np.ndarray:
    """Return the derivatives of the readings by the position of each drive, shape (n, m, N)."""
    model = station.model
    wide = model.with_effects([*model.effects, Motions(tuple(map(int, model.chain.drives)))])
    of_model, own = station.split(values)
    n = len(model.chain.drives)
    whole = np.concatenate([of_model, np.zeros(n), own])
    free = np.zeros(len(whole), bool)
    free[len(of_model) : len(of_model) + n] = True
    parts = station.with_model(wide).linearise(whole, free)
    return np.concatenate([J for _, _, J in parts], axis=2)
