"""How fine a drive curve the data can tell, judged by blocks of poses left out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pincal.discover.nuisance import score_test_beside_masses
from pincal.identify.fit import Fit
from pincal.model.catalogue import TransmissionError

# Numbers of basis functions that are tried.
_SIZES = (8, 10, 12, 15, 18, 22, 26, 32, 38, 44, 52, 60, 70, 80, 100, 120, 150, 180)


def curves_over(fit: Fit, joint: str, sizes: Sequence[int]) -> list[TransmissionError]:
    """Return drive curves of one joint, as fine as the number of poses allows."""
    conditions = fit.station.conditions
    q = conditions.q[:, fit.model.chain.robot.joint_names.index(joint)]
    return [TransmissionError.over(joint, q, size) for size in sizes if size <= len(conditions) // 6]


def resolved(fit: Fit, curve: TransmissionError, groups: np.ndarray) -> TransmissionError:
    """Return the curve of this joint in the resolution that predicts blocks of poses left out best."""
    curves = curves_over(fit, curve.joint, _SIZES)
    return curves[int(np.argmax(_gains(fit, curves, groups).sum(axis=1)))]


def refined(fit: Fit, curve: TransmissionError, groups: np.ndarray) -> TransmissionError:
    """Return a finer curve of this joint if it predicts blocks of poses left out better by more than chance, else this."""
    curves = [curve, *curves_over(fit, curve.joint, [size for size in _SIZES if size > curve.size])]
    more = _gains(fit, curves, groups)
    more -= more[0].copy()
    best = int(np.argmax(more.sum(axis=1)))
    return curves[best if more[best].sum() > more[best].std() * np.sqrt(more.shape[1]) else 0]


def _gains(fit: Fit, curves: Sequence[TransmissionError], groups: np.ndarray) -> np.ndarray:
    """Return by how much each curve lowers the squared error on each block left out, shape (curves, blocks)."""
    found = score_test_beside_masses(fit, groups, curves)
    return np.array([found.gains_by_block([i]) for i in range(len(curves))])
