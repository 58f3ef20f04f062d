"""Held-out errors step by step, and partial residuals: what each effect explains, pose by pose."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, cast

import numpy as np
from msgspec.structs import asdict

from pincal.calibration.held_out import StationRows, Validated, errors_held_out, headline_of
from pincal.discover.discovery_file import EffectName, Gap, Stage
from pincal.discover.levers import on_steps
from pincal.discover.steps import History, ModelChange
from pincal.discover.wave_numbers import WAVES
from pincal.identify.dependence import placed_at_mean
from pincal.identify.fit import ModelFit
from pincal.identify.fit_levers import levers
from pincal.identify.folds import Folds, Way
from pincal.model.conditions import MOMENT, recorded_variable
from pincal.model.effect import Curve, Effect, Family, Locus
from pincal.model.effect_bases import drive_unit
from pincal.model.effects import Compliance
from pincal.recorded import RECORDABLE
from pincal.units import format_joint
from pincal.validate.accuracy import error_statistics, pose_error_sizes

# Shapes of effects that depend on the joint's own position and another's.
_OF_BOTH = ("product", "map", "field")


def gaps_of(
    fit: ModelFit, rows: Sequence[StationRows], folds: Folds | None = None
) -> dict[str, Gap]:
    """Return the errors of a fit at rows that it has not seen, by the ways of dividing them; else
    those of the fitted rows.

    ``folds`` divide the fitted rows; default: rows were held out for good, of which "test" is all.
    """
    fit = placed_at_mean(fit)
    errors = errors_held_out(
        fit, fit.solution, rows, None if folds is None else folds.over(fit.problem)
    )
    if not errors:
        errors = {
            "test": error_statistics(
                pose_error_sizes(at, fit.values[places]) for at, places, _ in fit.stations
            )
        }
    return _gaps(errors)


def _gaps(errors: Mapping[str, Mapping[str, float]]) -> dict[str, Gap]:
    """Return error statistics, part by part, as gaps."""
    return {
        part: Gap(**{key: of[key] for key in Gap.__struct_fields__ if key in of})
        for part, of in errors.items()
    }


def stages_of(
    trail: History,
    rows: Sequence[StationRows],
    validated: Validated | None = None,
    of_names: Validated | None = None,
) -> tuple[tuple[Stage, ...], dict[str, dict[Literal["before", "after"], Gap]]]:
    """Return the errors at the start and after each change of the model, and at start and end on
    rows held out in each way.

    The share of a change is its reduction of the mean square given the previous changes, so that
    nothing counts twice. (Shapley values would divide it evenly, but need a fit of every subset.)
    ``validated`` are the errors of the last fit by cross-validation; default: rows were held out
    for good, or none. ``of_names`` are those of the fit before it, if what has no name entered
    last.
    """
    folds = None if validated is None else validated.folds
    final = trail.changes[-1].fit if trail.changes else trail.first
    first = gaps_of(trail.first, rows, folds)
    last = gaps_of(final, rows) if validated is None else _gaps(validated.errors("calibrated"))
    lead = headline_of({part: {"mean_mm": gap.mean_mm} for part, gap in last.items()})
    # Between them only the headline is shown.
    leading = None if folds is None else folds.only(cast(Way, lead))
    fits = [change.fit for change in trail.changes[:-1]]
    known = [] if of_names is None else [_gaps(of_names.errors("calibrated"))[lead]][: len(fits)]
    between = [gaps_of(fit, rows, leading)[lead] for fit in fits[: len(fits) - len(known)]] + known
    gaps = [first[lead], *between, *([last[lead]] if trail.changes else [])]
    squares = [gap.rms_mm**2 for gap in gaps]
    fell = squares[0] - squares[-1]
    stages = [Stage(name="at the start", **asdict(gaps[0]))]
    for change, gap, before, after in zip(
        trail.changes, gaps[1:], squares, squares[1:], strict=False
    ):
        entered, left = (
            tuple(EffectName.of(effect) for effect in effects)
            for effects in (change.entered, change.left)
        )
        share = (before - after) / fell if fell > 0.0 else None
        stages.append(
            Stage(name=_words(change), entered=entered, left=left, share=share, **asdict(gap))
        )
    return tuple(stages), {
        way: {"before": first[way], "after": last[way]} for way in last if way != "test"
    }


def _words(change: ModelChange) -> str:
    """Return a change in words."""
    entered, left = (
        ", ".join(_title(effect) for effect in effects) for effects in (change.entered, change.left)
    )
    if entered and left:
        return f"{entered} instead of {left}"
    if entered or left:
        return f"+ {entered}" if entered else f"- {left}"
    has_curves = any(isinstance(effect, Curve) for effect in change.fit.problem.effects)
    return "final fit, smoothness of curves estimated" if has_curves else "all fitted again"


@dataclass(frozen=True)
class PartialResidual:
    """Partial residuals of one effect at each of N rows.

    Attributes:
        effect: the effect; of elasticity the most significant compliance.
        variable: its variable: a joint's name, "approach", "moment", "payload", "temperature" or
            "time".
        unit: of the variable: "rad", "m", "N m", "kg", "deg C", "s" or "".
        x: shape (N,), the variable.
        before: shape (N,), error of the coordinate that would explain each row's residual, with the
            effect removed from the final model without a refit [``error_unit``].
        after: the same with the effect.
        fitted: shape (N,), the effect.
        weights: shape (N,), inverse variance of ``before`` and ``after`` [1 / ``error_unit``^2].
        error_unit: "rad" or "m".
        own: shape (N,), of an effect of two joints' positions that of the joint on which it acts;
            else None.
    """

    effect: Effect
    variable: str
    unit: str
    x: np.ndarray
    before: np.ndarray
    after: np.ndarray
    fitted: np.ndarray
    weights: np.ndarray
    error_unit: str
    own: np.ndarray | None = None

    @property
    def joint(self) -> str | None:
        """Where it acts; None for the whole arm."""
        return self.effect.locus.joint

    @property
    def title(self) -> str:
        """The name of the effect and where it acts."""
        return _title(self.effect)


def partial_residuals(trail: History) -> tuple[PartialResidual, ...]:
    """Return the partial residuals of each step's effect in the final model, at the rows that
    count.

    An effect on one coordinate of the chain is projected on the lever of this coordinate, any other
    on its motion of the target.
    """
    fit = trail.final
    kept = [
        [effect for effect in step.effects if effect in fit.problem.effects] for step in trail.steps
    ]
    shown = [(effects[0], _shown(fit, effects[0])) for effects in kept if effects]
    return tuple(
        _joined(parts)
        for parts in zip(*(_at_station(alone, shown) for _, alone, _ in fit.in_places), strict=True)
    )


def _shown(fit: ModelFit, effect: Effect) -> Effect:
    """Return the effect to show: of elasticity the most significant compliance."""
    if not isinstance(effect, Compliance):
        return effect
    found = fit.estimate.take(fit.names_of([effect]))
    surest = found.parameters[int(np.argmax(np.abs(found.values) / found.fitted_sigma))]
    return replace(effect, joints=(surest.element,))


def _joined(parts: Sequence[PartialResidual | None]) -> PartialResidual:
    """Return the partial residuals of an effect at all stations that have it."""
    first, *others = filter(None, parts)
    names = ["x", "before", "after", "fitted", "weights"] + (
        ["own"] if first.own is not None else []
    )
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in (first, *others)]) for name in names
    }
    return replace(first, **arrays)


def _at_station(
    fit: ModelFit, shown: Sequence[tuple[Effect, Effect]]
) -> Iterator[PartialResidual | None]:
    """Yield the partial residuals of effects, each with the effect to show, at the only station;
    None where absent.
    """
    rows = _SoundRows(fit.select(np.flatnonzero(fit.solution.weights > 0.0)))
    present = rows.fit.model.effects
    moved = [rows.coordinates(part) if effect in present else set() for effect, part in shown]
    single = tuple(dict.fromkeys(k for of in moved if len(of) == 1 for k in of))
    lever_of = dict(zip(single, levers(rows.fit, single) * rows.scale, strict=True))
    for (effect, part), coordinates in zip(shown, moved, strict=True):
        if effect in present:
            lever = lever_of[coordinates.pop()] if len(coordinates) == 1 else None
            yield rows.partial_residual(part, lever)
        else:
            yield None


@dataclass(frozen=True, eq=False)
class _SoundRows:
    """The rows of a station with their fit, outliers left out; residuals in units of the noise."""

    fit: ModelFit

    @cached_property
    def moments(self) -> np.ndarray:
        """Static moments, shape (N, 3 n)."""
        fit = self.fit
        return fit.model.static_moments(fit.model_values, fit.station.conditions)

    @cached_property
    def scale(self) -> np.ndarray:
        """Of readings, shape (m, N)."""
        station = self.fit.station
        sigma = np.repeat(self.fit.solution.estimated, station.block_sizes)[:, None]
        return np.asarray(station.weights / sigma)

    @cached_property
    def residuals(self) -> np.ndarray:
        """Of the fit, shape (m, N)."""
        return np.asarray(self.fit.station.residuals(self.fit.values) * self.scale)

    def coordinates(self, effect: Effect) -> set[int]:
        """Return the coordinates that an effect moves."""
        few = self.fit.station.conditions.select(np.zeros(1, int))
        terms = effect.terms(self.fit.model.chain, few, self.moments[:1])
        return {term.coordinate for term in terms}

    def without(self, effect: Effect) -> np.ndarray:
        """Return the residuals without an effect, shape (m, N)."""
        fit = self.fit
        idle = fit.values.copy()
        parameters = effect.parameters(fit.model.chain)
        idle[[fit.model.index(parameter.name) for parameter in parameters]] = 0.0
        return np.asarray(fit.station.residuals(idle) * self.scale)

    def partial_residual(self, effect: Effect, lever: np.ndarray | None) -> PartialResidual:
        """Return the partial residuals of an effect: at the joint with this lever, shape (m, N), or
        at the target along its errors.
        """
        fit = self.fit
        station = fit.station
        chain = fit.model.chain
        at = effect.locus
        without = self.without(effect)
        if lever is not None:
            weights = np.sum(lever**2, axis=0)
            unit_errors = lever / np.maximum(weights, 1e-300)
            unit = "rad" if at.joint is None else drive_unit(chain, at.joint)
        else:
            sigma = float(fit.solution.estimated[0]) * station.metres_per_reading(fit.values)
            unit_errors = _directions(without - self.residuals) * sigma
            weights = np.full(len(station), sigma**-2.0)
            unit = "m"
        each = (without, self.residuals, without - self.residuals)
        before, after, fitted = (np.sum(unit_errors * r, axis=0) for r in each)
        is_of_both = at.shape in _OF_BOTH and at.joint is not None
        own = recorded_variable(chain, station.conditions, str(at.joint)) if is_of_both else None
        variable = _explaining(fit, at, self.moments)
        return PartialResidual(effect, *variable, before, after, fitted, weights, unit, own)


def _directions(errors: np.ndarray) -> np.ndarray:
    """Return the direction of the error of each row, shape (m, N)."""
    return np.asarray(errors / np.maximum(np.linalg.norm(errors, axis=0), 1e-300))


def _explaining(fit: ModelFit, at: Locus, moments: np.ndarray) -> tuple[str, str, np.ndarray]:
    """Return the name, the unit and the values, shape (N,), of the variable of an effect."""
    chain = fit.model.chain
    names = chain.robot.joint_names
    if at.follows == MOMENT:
        i = 0 if at.joint is None else names.index(at.joint)
        # For the whole arm the tilting moment on joint 1.
        both = np.hypot(moments[:, 3 * i], moments[:, 3 * i + 1])
        return MOMENT, "N m", both if at.joint is None else moments[:, 3 * i + 2]
    name = at.follows or at.joint or names[0]
    unit = (
        drive_unit(chain, name)
        if name in names
        else RECORDABLE[name].unit
        if name in RECORDABLE
        else ""
    )
    return name, unit, recorded_variable(chain, fit.station.conditions, name, joint=at.joint)


def period_of(trace: PartialResidual) -> float | None:
    """Return the period of an effect, in units of its variable; None if it is not periodic.

    It is called periodic if one tone explains most of the excess over the noise, and about two
    periods are observed, in a weighted periodogram of the error at the joint (Lomb and Scargle).
    """
    x = trace.x
    y = trace.before
    w = trace.weights
    width = float(np.ptp(x))
    if width <= 0.0 or len(x) < WAVES.fewest:
        return None
    if (order := trace.effect.locus.order) is not None:
        period = 2.0 * np.pi / order
        return float(period) if width >= WAVES.periods * period else None
    angle = 2.0 * np.pi * (x - x.min()) / width
    end = WAVES.finest * len(x)
    if end <= WAVES.periods:
        return None
    steps = {"start": WAVES.periods, "step": 1.0 / WAVES.oversampled, "end": end}
    cycles, gains = on_steps(angle, w * y, w, **steps, is_beside_constant=True)
    # Noise contributes 1 per row to the weighted squares, and 2 to a tone.
    excess = float(np.sum(w * (y - np.average(y, weights=w)) ** 2)) - len(y)
    best = int(np.argmax(gains))
    sure = gains[best] > 2.0 * np.log(len(cycles) / WAVES.period)
    return (
        width / float(cycles[best])
        if sure and gains[best] - 2.0 > WAVES.tone * max(excess, 1e-9)
        else None
    )


def _title(effect: Effect) -> str:
    """Return the name of an effect, where it acts and its source."""
    if effect.locus.shape == "smooth":
        what = "drives" if effect.locus.acts_on == "drive" else "target"
        return f"unnamed, smooth ({what})"
    joint = effect.locus.joint
    of = "" if joint is None else f" of {joint}"
    source = effect.locus.follows if effect.is_nameless else effect.locus.source
    by = f" by {source}" if source and source != joint else ""
    where = f" at {effect.locus.station}" if effect.locus.station else ""
    across = effect.is_nameless and effect.locus.acts_on != "drive"
    where += f" ({effect.locus.acts_on})" if across else ""
    order = f" order {effect.locus.order:g}" if (effect.locus.order or 1) != 1 else ""
    if effect.locus.period is not None:
        order = f" of period {format_joint(effect.locus.period, 'm')}"
    # Bearing features share the heading of compliances, so their own names are used.
    is_feature = effect.family is Family.ELASTICITY and effect.locus.station is None
    return f"{effect.name if is_feature else effect.heading[0]}{of}{by}{where}{order}"
