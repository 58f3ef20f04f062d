"""Which functions of two joints' positions a fit leaves: the likeliest maps, by what they take off along a joint's lever."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri

from pincal.discover.nuisance import situation_of
from pincal.discover.tones import seen_along
from pincal.identify.fit import Fit
from pincal.model.basis import FEWEST_SPLINES, spline_basis
from pincal.model.catalogue.unnamed import maps_of
from pincal.model.effect import Effect

# Of so many resolutions of the likeliest map the coarsest and the finest are tested.
_RESOLUTIONS = 3
# Chance of what it takes off the squares below which it becomes a candidate; the test that follows is exact.
_WORTH_A_TEST = 0.05
# Part of the largest diagonal below which a piece of a map sees no pose.
_SEEN = 1e-6


def likely_maps(fit: Fit, joints: Sequence[str]) -> list[Effect]:
    """Return the map, coarse and finer, that takes most off the squares at some joints, if it is worth a test.

    What a refit would take up of it is left out of account: what is found is tested like any other candidate, and pays for
    the pairs of joints among which it was chosen.
    """
    situation, chain = situation_of(fit), fit.problem.chain
    present = {effect.identity for effect in fit.problem.effects}
    drives = [int(chain.drives[situation.joints.index(joint)]) for joint in joints]
    along, lever = seen_along(fit, np.array(drives))
    columns = dict(zip(situation.joints, situation.conditions.q.T, strict=True))
    splines = {name: _coarse(q) for name, q in columns.items() if np.ptp(q)}
    found: list[tuple[float, Sequence[Effect]]] = []
    for joint, b, v in zip(joints, along, lever, strict=True):
        for effect in maps_of(situation, joint):
            forms = effect.resolutions(situation)
            if forms and effect.identity not in present:
                basis = np.einsum("an,bn->abn", splines[joint], splines[effect.depends_on]).reshape(-1, len(b))
                found.append((_gain(basis, b, v), forms))
    gain, likeliest = max(found, key=lambda one: one[0], default=(0.0, ()))
    worth = float(chdtri(FEWEST_SPLINES**2, _WORTH_A_TEST / max(len(found), 1)))
    tried = likeliest[:_RESOLUTIONS]
    return list(dict.fromkeys([tried[0], tried[-1]])) if gain > worth else []


def _coarse(q: np.ndarray) -> np.ndarray:
    """Return the splines of which the coarsest map is made, of positions of shape (N,), shape (4, N)."""
    return spline_basis(q, float(q.min()), float(q.max()), FEWEST_SPLINES)


def _gain(basis: np.ndarray, along: np.ndarray, lever: np.ndarray) -> float:
    """Return what basis functions, shape (K, N), of a joint's position take off the squares."""
    S, b = (basis * lever) @ basis.T, basis @ along
    ridge = _SEEN * float(np.diag(S).max(initial=0.0))
    return float(b @ np.linalg.solve(S + ridge * np.eye(len(S)), b)) if ridge else 0.0
