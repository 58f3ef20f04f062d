"""Largest motion of a coordinate per unit of each parameter, which scales priors to millimetres and
milliradians.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from pincal.model.conditions import UNFELT, Conditions
from pincal.model.evaluated import key_of
from pincal.model.model import Evaluation, Model
from pincal.model.sparse_basis import dense_rows
from pincal.thresholds import Scale

# Levers of an arm's weight below which moments are rounding [m], as where each link's centre of
# mass is on its joint's axis.
_LEVER_OF_ROUNDING: Scale = 1e-12


def largest_basis(model: Model, conditions: Conditions) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest motion of its coordinate per unit of each parameter, and whether it is
    excited, both shape (P,).

    Moments are bounded below by a fraction of the largest on the arm: otherwise an unloaded wrist,
    or one with a moment of rounding only, would get a prior as soft as rubber. A moment that is
    zero on the nominal arm, such as about a vertical axis, does not excite its parameter, although
    a base that is not quite level would. All splines of a curve get the same size, however few of
    the poses are near each.
    """
    largest, excited = largest_bases(model, conditions, np.zeros(1, int))
    return largest[0], excited[0]


def largest_bases(
    model: Model, conditions: Conditions, starts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return :func:`largest_basis` of each of S parts of the rows, which begin at ``starts``, shape
    (S, P).
    """
    if model.bodies or not model.effects or conditions.setup is not None:
        # Masses act through other effects that depend on moments; rows of several set-ups are
        # joined afresh each time.
        return _largest_bases(model, conditions, starts)
    # A discovery tries the same candidates at every step; the effects are kept alive with the
    # results.
    known = model.chain.known("largest", conditions)
    parts = starts.tobytes()
    keys = [(key_of(effect), parts) for effect in model.effects]
    new = model.with_effects(
        [e for key, e in zip(keys, model.effects, strict=True) if key not in known]
    )
    if new.effects:
        largest, excited = _largest_bases(new, conditions, starts)
        for of, effect in zip(new.spans, new.effects, strict=True):
            known[key_of(effect), parts] = effect, largest[:, of], excited[:, of]
    found = [known[key] for key in keys]
    return np.hstack([size for _, size, _ in found]), np.hstack([acts for *_, acts in found])


def _largest_bases(
    model: Model, conditions: Conditions, starts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    state = Evaluation.at(model, np.zeros(model.n_parameters), conditions)
    most = partial(_most, starts=starts)
    moments = np.array([most(moment) for moment in state.moments]).reshape(-1, len(starts))
    moments[moments <= _LEVER_OF_ROUNDING * _weight(state)] = 0.0
    heaviest = moments.max(axis=0, initial=0.0)
    largest = np.zeros((len(starts), model.n_parameters))
    excited = np.zeros(largest.shape, bool)
    least = np.zeros(model.n_parameters)
    for span, effect in zip(model.spans, model.effects, strict=True):
        least[span] = effect.least_moment
    # Most parameters move their coordinate alike in all poses.
    always = [p for p, term in state.terms if term.basis is None and term.moment is None]
    largest[:, always] = 1.0
    excited[:, always] = True
    for p, term in state.terms:
        if term.basis is None and term.moment is None:
            continue
        size = np.ones(len(starts)) if term.basis is None else most(term.basis)
        if term.moment is None:
            excited[:, p] |= size > 0.0
        else:
            excited[:, p] |= moments[term.moment] > UNFELT * heaviest
            size = np.where(moments[term.moment] > 0.0, size, 0.0)
            if term.slope is None:
                size = np.maximum(size, max(least[p], UNFELT) * heaviest)
        largest[:, p] = np.maximum(largest[:, p], size)
    for at, _, basis in state.curves:
        for row, p in zip(dense_rows(basis), at.tolist(), strict=True):
            largest[:, p] = most(row)
        excited[:, at] = largest[:, at] > 0.0
    for body in model.bodies:
        excited[:, body.parameter] = heaviest > 0.0
    for span, effect in zip(model.spans, model.effects, strict=True):
        if effect.shares_scale:
            largest[:, span] = largest[:, span].max(axis=1, keepdims=True)
            excited[:, span] = excited[:, span].any(axis=1, keepdims=True)
    return np.where(largest > 0.0, largest, 1.0), excited


def _weight(state: Evaluation) -> float:
    """Return the weight of an arm with its load [N]."""
    mass = float(np.sum(state.layout.masses)) + float(state.payload.mass.max(initial=0.0))
    return mass * float(np.linalg.norm(state.layout.gravity))


def _most(of_rows: np.ndarray, *, starts: np.ndarray) -> np.ndarray:
    """Return the largest absolute values of rows of each block that begins at a start."""
    return np.maximum.reduceat(np.abs(of_rows), starts) if len(of_rows) else np.zeros(len(starts))
