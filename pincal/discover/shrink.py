"""How the disagreement shrinks: held-out errors step by step, and what each effect explains, pose by pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from msgspec.structs import asdict

from pincal.discover.history import History
from pincal.discover.locate import levers
from pincal.identify.fit import Fit
from pincal.identify.normal import block_rows
from pincal.io.discovery_file import Gap
from pincal.measure.measurements import Measurements
from pincal.model.conditions import COLUMN_UNITS, MOMENT, recorded_variable
from pincal.model.effect import Effect
from pincal.model.effects import Compliance
from pincal.validate.accuracy import error_table

# Periods that have to be seen, and the part of the excess that one tone has to explain, before a curve is called periodic.
_PERIODS, _TONE = 1.8, 0.7
# Chance that noise makes any tone of this strength.
_CHANCE = 1e-3
_FINEST = 0.25  # periods a row
_OVERSAMPLED = 8


class Stage(Gap, frozen=True, kw_only=True):
    """Errors under one of the models that a discovery went through, ``name`` says which."""

    name: str


def gap_of(fit: Fit, held: Measurements) -> Gap:
    """Return the errors of a fit on held-out rows."""
    errors = error_table(fit.readings(held) if len(held) else fit.station, fit.values)
    return Gap(mean_mm=errors["mean_mm"], rms_mm=errors["rms_mm"], max_mm=errors["max_mm"])


def stages_of(trail: History, held: Measurements) -> tuple[Stage, ...]:
    """Return the errors at the start, after each step, and with everything fitted together."""
    fits = [("at the start", trail.first)]
    fits += [("+ " + ", ".join(_title(e, e.locus.joint) for e in step.effects), step.after) for step in trail.steps]
    if fits[-1][1] is not trail.final:
        fits.append(("all together", trail.final))
    return tuple(Stage(name=name, **asdict(gap_of(fit, held))) for name, fit in fits)


@dataclass(frozen=True)
class PartialResidual:
    """What one effect explains at each of N rows.

    Attributes:
        effect: the effect.
        joint: where it acts; of elasticity the joint that it shows most at; None for the whole arm.
        variable: what explains it: a joint's name, "approach", "moment", "payload", "temperature" or "time".
        unit: of the variable: "rad", "m", "N m", "kg", "deg C", "s" or "".
        x: shape (N,), the variable.
        before: shape (N,), error of the coordinate that would explain each row's residual, the effect left out of the
            final model and nothing else changed [``error_unit``].
        after: the same with the effect.
        fitted: shape (N,), the effect.
        weights: shape (N,), inverse variance of ``before`` and ``after`` [1 / ``error_unit``^2].
        error_unit: "rad" or "m".
    """

    effect: Effect
    joint: str | None
    variable: str
    unit: str
    x: np.ndarray
    before: np.ndarray
    after: np.ndarray
    fitted: np.ndarray
    weights: np.ndarray
    error_unit: str

    @property
    def title(self) -> str:
        """The name of the effect and where it acts."""
        return _title(self.effect, self.joint)


def partial_residuals(trail: History) -> tuple[PartialResidual, ...]:
    """Return what each step's effect explains in the final model."""
    found = []
    for step in trail.steps:
        effect = next((e for e in step.effects if e in trail.final.model.effects), None)
        if effect is not None:
            found.append(partial_residual(trail.final, effect))
    return tuple(found)


def partial_residual(fit: Fit, effect: Effect) -> PartialResidual:
    """Return what an effect of a fit explains at the rows that count.

    An effect on one coordinate of the chain is seen through this coordinate's lever, any other along the way by which it
    moves the target.
    """
    shown = replace(effect, joints=(_stiffest(fit, effect),)) if isinstance(effect, Compliance) else effect
    joint = shown.locus.joint
    names = [parameter.name for parameter in shown.parameters(fit.model.chain)]
    idle = fit.values.copy()
    idle[[fit.model.index(name) for name in names]] = 0.0
    rows = fit.solution.weights > 0.0
    scale = _scale(fit)[:, rows]
    without, left = (fit.station.residuals(values)[:, rows] * scale for values in (idle, fit.values))
    change = without - left
    coordinate = _coordinate(fit, shown)
    if coordinate is None:
        length = np.linalg.norm(change, axis=0)
        direction = change / np.maximum(length, 1e-300)
        sigma = float(fit.solution.estimated[0])
        sigma *= fit.station.metres_per_reading(fit.values)
        parts = [np.sum(direction * r, axis=0) * sigma for r in (without, left)]
        fitted, weights, unit = length * sigma, np.full(int(rows.sum()), sigma**-2.0), "m"
    else:
        lever = levers(fit, (coordinate,))[0][:, rows] * scale
        weights = np.sum(lever**2, axis=0)
        parts = [np.sum(lever * r, axis=0) / np.maximum(weights, 1e-300) for r in (without, left)]
        fitted = np.sum(lever * change, axis=0) / np.maximum(weights, 1e-300)
        unit = "m" if joint is not None and _is_prismatic(fit, joint) else "rad"
    variable, x_unit, x = _explaining(fit, shown)
    return PartialResidual(effect, joint, variable, x_unit, x[rows], parts[0], parts[1], fitted, weights, unit)


def _scale(fit: Fit) -> np.ndarray:
    """Return 1 / standard deviation of each component of each reading, shape (m, N)."""
    out = np.empty((sum(block.size for block in fit.station.sensor.blocks), len(fit.station)))
    for rows, sigma in zip(block_rows(fit.station), fit.solution.estimated, strict=True):
        out[rows] = fit.station.weights / sigma
    return out


def _stiffest(fit: Fit, effect: Compliance) -> str:
    """Return the joint whose compliance is furthest from zero, in units of its standard deviation."""
    found = fit.estimate.take(parameter.name for parameter in effect.parameters(fit.model.chain))
    return found.names[int(np.argmax(np.abs(found.values) / found.fitted_sigma))].rsplit(".", 1)[0]


def _is_prismatic(fit: Fit, joint: str) -> bool:
    robot = fit.model.chain.robot
    return robot.joint_types[robot.joint_names.index(joint)] == "prismatic"


def _coordinate(fit: Fit, effect: Effect) -> int | None:
    """Return the one coordinate that an effect moves, None if there are several."""
    chain = fit.model.chain
    first = np.zeros(1, int)
    moments = fit.model.static_moments(fit.model_values, fit.station.conditions.select(first))
    moved = {term.coordinate for term in effect.terms(chain, fit.station.conditions.select(first), moments)}
    return moved.pop() if len(moved) == 1 else None


def _explaining(fit: Fit, effect: Effect) -> tuple[str, str, np.ndarray]:
    """Return the name, the unit and the values of the variable that an effect follows, shape (N,)."""
    conditions, chain, at = fit.station.conditions, fit.model.chain, effect.locus
    names = chain.robot.joint_names
    if at.follows == MOMENT:
        i = 0 if at.joint is None else names.index(at.joint)
        moments = fit.model.static_moments(fit.model_values, conditions)
        # Of the whole arm the moment on joint 1 that tilts it.
        both = np.hypot(moments[:, 3 * i], moments[:, 3 * i + 1])
        return MOMENT, "N m", both if at.joint is None else moments[:, 3 * i + 2]
    name = at.follows or at.joint or names[0]
    unit = COLUMN_UNITS.get(name) if name not in names else "m" if _is_prismatic(fit, name) else "rad"
    return name, unit or "", recorded_variable(chain, conditions, name, joint=at.joint)


def period_of(trace: PartialResidual) -> float | None:
    """Return the period of what an effect explains, in units of its variable; None if it is not periodic.

    It is called periodic if one tone explains most of what the noise does not, and about two periods of it are seen: a
    weighted periodogram of the error at the joint (Lomb and Scargle).
    """
    x, y, w = trace.x, trace.before, trace.weights
    width = float(np.ptp(x))
    if width <= 0.0 or len(x) < 20:
        return None
    if (order := trace.effect.locus.order) is not None:
        period = 2.0 * np.pi / order
        return float(period) if width >= _PERIODS * period else None
    y = y - np.sum(w * y) / np.sum(w)
    cycles = np.arange(_PERIODS, _FINEST * len(x), 1.0 / _OVERSAMPLED)
    gains = np.array([_tone_gain(2.0 * np.pi * c * (x - x.min()) / width, y, w) for c in cycles])
    if not len(gains):
        return None
    # Whitened, each row of noise adds 1 to the weighted squares, a tone of noise alone 2.
    excess = float(np.sum(w * y**2)) - len(y)
    best = int(np.argmax(gains))
    sure = gains[best] > 2.0 * np.log(len(cycles) / _CHANCE)
    return width / float(cycles[best]) if sure and gains[best] - 2.0 > _TONE * max(excess, 1e-9) else None


def _tone_gain(phase: np.ndarray, y: np.ndarray, w: np.ndarray) -> float:
    """Return what a sine and a cosine beside a constant take off the weighted squares."""
    A = np.stack([np.cos(phase), np.sin(phase)])
    A = A - (A @ w / w.sum())[:, None]
    G, b = (A * w) @ A.T, (A * w) @ y
    return float(b @ np.linalg.pinv(G, rcond=1e-9, hermitian=True) @ b)


def _title(effect: Effect, joint: str | None) -> str:
    of = "" if joint is None else f" of {joint}"
    source = effect.locus.follows if effect.is_nameless else effect.locus.source
    by = f" by {source}" if source and source != joint else ""
    return f"{effect.name}{of}{by}"
