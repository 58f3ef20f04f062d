"""Contribution of each drive curve to the error on another day: each is re-estimated alone, with
cross-validation.

A curve is re-estimated with its prior on roughness; everything else is held as calibrated, except
for the poses of instrument and target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from pincal.calibration.covered import SeenCurve, curves_at
from pincal.calibration.placing import Placed
from pincal.diagnosis.diagnosis_file import CurveEntry, CurvesEntry
from pincal.diagnosis.diagnosis_numbers import DIAGNOSIS
from pincal.diagnosis.row_evidence import rows_in_noise
from pincal.identify.quadratic import Factor, Form
from pincal.identify.split import row_groups
from pincal.measure.measurements import Measurements
from pincal.model.effect import Curve
from pincal.model.model import Model


@dataclass(frozen=True)
class _Rows:
    """Rows of a station, in blocks, linearised in the parameters that may be re-estimated.

    Attributes:
        blocks: information of each of B blocks on these parameters.
        A: shape (P, N, m), the Jacobian of the first readings in metres.
        off: shape (N, m), their residuals as calibrated [m].
        block: shape (N,), of each row that counts, -1 for others.
    """

    blocks: Form
    A: np.ndarray
    off: np.ndarray
    block: np.ndarray

    def found(
        self, free: np.ndarray, belief: np.ndarray, *, without: int | None = None
    ) -> np.ndarray:
        """Return the step of some parameters, shape (F,), perhaps without a block."""
        H = self.whole.H
        g = self.whole.g
        if without is not None:
            H = H - self.blocks.H[without]
            g = g - self.blocks.g[without]
        return Factor.of(H[np.ix_(free, free)] + belief).solve(g[free])

    @cached_property
    def whole(self) -> Form:
        """Information of all blocks."""
        return self.blocks.sum()

    def error(self, free: np.ndarray, belief: np.ndarray) -> float:
        """Return the cross-validated mean error with some parameters re-estimated [m]."""
        errors = []
        for k in range(len(self.blocks.g)):
            here = np.flatnonzero(self.block == k)
            step = self.found(free, belief, without=k)
            residuals = self.off[here] - np.einsum("p,pnm->nm", step, self.A[np.ix_(free, here)])
            errors.append(np.linalg.norm(residuals, axis=1))
        return float(np.concatenate(errors).mean())


def _believed_curves(model: Model) -> list[tuple[Curve, slice, np.ndarray]]:
    """Return the curves of a model, each with the places of its parameters and the information of
    its prior.
    """
    return [
        (effect, span, belief)
        for effect, span in zip(model.effects, model.spans, strict=True)
        if isinstance(effect, Curve)
        and (belief := effect.belief(effect.parameters(model.chain))) is not None
    ]


def redrawn_curves(
    placed: Placed, table: Measurements, *, kept: np.ndarray, session: str
) -> CurvesEntry | None:
    """Return the contribution of each curve to the error on another day; None without curves, or
    with too few rows.
    """
    model = placed.station.model
    curves = _believed_curves(model)
    if not curves or kept.sum() < DIAGNOSIS.curve_rows:
        return None
    own = np.flatnonzero(placed.solution.free)
    places = [np.arange(span.start, span.stop) for _, span, _ in curves]
    free = np.unique(np.concatenate([own, *places]))
    block = row_groups(table, split="blocked", seed=0) % DIAGNOSIS.curve_blocks
    rows = _rows(placed, free, block=block, kept=kept)

    def reestimated(some: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        at = np.searchsorted(free, np.concatenate([own, *(places[i] for i in some)]))
        return at, block_diag(np.zeros((len(own),) * 2), *(curves[i][2] for i in some))

    entries = []
    seen = {
        curve.effect: curve for curve in curves_at(model, placed.station.conditions.select(kept))
    }
    for i, (effect, _, _) in enumerate(curves):
        at, believed = reestimated([i])
        change = rows.found(at, believed)[len(own) :]
        entries.append(_entry(placed, effect, seen[effect], change, error=rows.error(at, believed)))
    entries.sort(key=lambda entry: entry.error_mm)
    before, after = (1e3 * rows.error(*reestimated(some)) for some in ((), range(len(curves))))
    return CurvesEntry(
        session=session, as_it_was_mm=before, all_anew_mm=after, joints=tuple(entries)
    )


def _rows(placed: Placed, free: np.ndarray, *, block: np.ndarray, kept: np.ndarray) -> _Rows:
    station = placed.station
    sigma = placed.model.sigma
    whole, r = rows_in_noise(station, placed.values, sigma, free)
    N = len(station)
    m = sum(part.size for part in station.sensor.blocks)
    A = whole[:, : N * m].reshape(len(free), N, m)
    r = r[: N * m].reshape(N, m)
    names = np.unique(block[kept])
    of = [np.flatnonzero(kept & (block == k)) for k in names]
    parts = [A[:, rows].reshape(len(free), -1) for rows in of]
    first = station.sensor.blocks[0].size
    metres = sigma[0] * station.metres_per_reading(placed.values) / station.weights[:, None]
    return _Rows(
        blocks=Form.of(
            np.array([part @ part.T for part in parts]),
            np.array([part @ r[rows].ravel() for part, rows in zip(parts, of, strict=True)]),
        ),
        A=A[:, :, :first] * metres,
        off=r[:, :first] * metres,
        block=np.where(kept, np.searchsorted(names, block), -1),
    )


def _entry(
    placed: Placed, effect: Curve, seen: SeenCurve, change: np.ndarray, *, error: float
) -> CurveEntry:
    """Return the contribution of one curve."""
    model = placed.station.model
    chain = placed.station.model.chain
    basis = effect.basis(seen.x)
    basis = basis - basis.mean(axis=1, keepdims=True)
    old = placed.values[model.spans[model.effects.index(effect)]] @ basis
    difference = change @ basis
    new = old + difference
    both = float(np.linalg.norm(old) * np.linalg.norm(new))
    return CurveEntry(
        joint=seen.joint,
        error_mm=1e3 * error,
        correlation=float(old @ new) / both if both else None,
        rms=float(np.sqrt(np.mean(difference**2))),
        unit=chain.robot.joint_units[chain.robot.joint_names.index(seen.joint)],
        seen=float(np.mean(seen.determined(chain, placed.model.estimate))),
    )
