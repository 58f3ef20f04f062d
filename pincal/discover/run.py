"""``discovery.json``: where the disagreement sits, which effect makes it, how sure that is, and what else it could be."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtrc

from pincal.calibration.fit import Fit as CalibratedFit
from pincal.calibration.result import result_of
from pincal.calibration.run import Calibration, run_calibration
from pincal.discover.candidate_tests import sampled
from pincal.discover.history import History, Step
from pincal.discover.loop import discover_effects
from pincal.discover.policy import POLICY
from pincal.discover.power import deciding_measurement
from pincal.discover.scatter import Scatter, find_scatter
from pincal.discover.shrink import PartialResidual, StageError, gap_of, gaps_of, partial_residuals, period_of
from pincal.discover.where import elastic_entries, noise_floor, where_of
from pincal.identify.calibrate import refit
from pincal.identify.fit import Fit
from pincal.identify.noise import outlier_limit
from pincal.identify.options import Options
from pincal.identify.split import Split, row_groups
from pincal.measure.measurements import Measurements
from pincal.model.catalogue import untestable
from pincal.model.chain import MomentFrame
from pincal.model.effect import Effect
from pincal.model.effects import ELASTIC, GEOMETRIC
from pincal.robot.robot import Robot

log = logging.getLogger(__name__)

_MISFIT = 1e-3
_CV_BLOCKS = 8
# Difference of -2 log likelihood from which another convention of moments counts as better (odds of 150 to 1).
_FRAME_BETTER = 10.0


@dataclass(frozen=True)
class Discovery:
    """A discovery with its calibration.

    Attributes:
        calibration: the calibration with all that was found.
        trail: how it was found.
        report: the contents of ``discovery.json``.
        gaps: errors on held-out rows at the start, after each step and with everything fitted together.
        traces: what each effect explains, pose by pose.
    """

    calibration: Calibration
    trail: History
    report: dict[str, Any]
    gaps: tuple[StageError, ...]
    traces: tuple[PartialResidual, ...]


def run_discovery(
    robot: Robot,
    measurements: Measurements,
    options: Options | None = None,
    *,
    extra: tuple[Effect, ...] = (),
    test_fraction: float = 0.2,
    split: Split = "blocked",
    seed: int = 0,
    holdout: Measurements | None = None,
    moment_frames: Sequence[MomentFrame] = (),
) -> Discovery:
    """Calibrate, find what the model misses, name it, add it and show the gap shrink on rows that criticism never saw.

    Args:
        robot: the arm.
        measurements: the table.
        options: how to calibrate; its effects are the model to start from, the geometric one unless given.
        extra: effects of the user's own that take part.
        test_fraction: part of the rows held out.
        split: how rows are chosen; whole regions of joint space unless given.
        seed: of the choice.
        holdout: other measurements to hold out instead.
        moment_frames: conventions of where moments bend the arm to choose from by the data; that of the options unless
            given. The first stays unless another fits better beyond chance.

    Raises:
        BadInputError: as :func:`run_calibration`.
    """
    options = Options(effects=GEOMETRIC) if options is None else options
    begun = time.perf_counter()
    frames = list(moment_frames) or [options.moment_frame]

    def start(frame: MomentFrame) -> Calibration:
        return run_calibration(
            robot,
            measurements,
            replace(options, moment_frame=frame),
            test_fraction=test_fraction,
            split=split,
            seed=seed,
            holdout=holdout,
        )

    first = start(frames[0])
    likeliest = frames[0] if robot.massless else _likeliest(first.fit, frames)
    found = {likeliest: _discover(first if likeliest == frames[0] else start(likeliest), extra)}
    others = _other_frames(found[likeliest][1], [frame for frame in frames if frame != likeliest])
    for k, frame in enumerate(others, 1):
        log.info("once more with --moment-frame %s", frame, extra={"done": k, "of": 1 + len(others)})
        found[frame] = _discover(start(frame), extra)
    costs = {frame: _cost(trail) + _FRAME_BETTER * (frame != frames[0]) for frame, (_, trail) in found.items()}
    frame = min(costs, key=lambda f: costs[f])
    first, trail = found[frame]
    notes = first.notes
    if frame != frames[0]:
        notes = (*notes, f"moments bend the arm as with --moment-frame {frame}: it fits better than {frames[0]}")
    held = trail.final.readings(first.test) if len(first.test) else None
    seconds = time.perf_counter() - begun
    result = result_of(trail.final, held, seconds=seconds, tables=(first.train, first.test), notes=notes)
    final = replace(first, fit=CalibratedFit.of(trail.final), result=result, notes=notes)
    gaps, traces = gaps_of(trail, final.test), partial_residuals(trail)
    return Discovery(final, trail, discovery_report(final, trail, traces), gaps, traces)


def _discover(first: Calibration, extra: tuple[Effect, ...]) -> tuple[Calibration, History]:
    blocks = row_groups(first.train, split="blocked", seed=0) % _CV_BLOCKS
    return first, discover_effects(first.fit, blocks, extra=extra, elastic=not first.robot.massless)


def _likeliest(fit: Fit, frames: Sequence[MomentFrame]) -> MomentFrame:
    """Return the convention in which elasticity explains most; the first unless another does so beyond chance."""
    if len(frames) == 1:
        return frames[0]
    few, _ = sampled(fit, POLICY)
    effects = [*fit.options.effects, *(e for e in ELASTIC if e.uses_moments and e not in fit.options.effects)]
    misfits = [_misfit(refit(few, effects, moment_frame=frame)) for frame in frames]
    best = int(np.argmin(misfits))
    return frames[best] if misfits[best] < misfits[0] - _FRAME_BETTER else frames[0]


def _other_frames(trail: History, frames: Sequence[MomentFrame]) -> list[MomentFrame]:
    """Return the conventions worth a discovery of their own.

    They fit what was found better, or as well without the effects of loads and the nameless that were found, which a wrong
    convention brings about. A convention that would take less off the squares than an effect must matters to nobody.
    """
    fit, rows = sampled(trail.final, POLICY)
    effects = fit.options.effects
    if not any(effect.uses_moments for effect in effects):
        return []
    brought = {e for step in trail.steps for e in step.effects if e.is_of_loads or e.is_nameless}
    plain = [effect for effect in effects if effect not in brought]
    rough = len(rows) < len(trail.final.station)
    cost = _fit_cost(refit(fit, effects, rough=rough))
    enough = POLICY.least_gain(fit.solution.degrees, declared=fit.noise.declared[0] is not None)

    def is_better(frame: MomentFrame) -> bool:
        if _fit_cost(refit(fit, effects, moment_frame=frame, rough=rough)) < cost - enough:
            return True
        return bool(brought) and _fit_cost(refit(fit, plain, moment_frame=frame, rough=rough)) < cost

    return [frame for frame in frames if is_better(frame)]


def _misfit(fit: Fit) -> float:
    """Return -2 log likelihood, up to a constant; an outlier counts as a row at the edge of the noise."""
    n, sizes = len(fit.station), [block.size for block in fit.station.sensor.blocks]
    outliers = int(np.sum(fit.solution.weights == 0.0))
    return 2.0 * n * float(np.dot(sizes, np.log(fit.solution.estimated))) + outliers * outlier_limit(n, sum(sizes))


def _cost(trail: History) -> float:
    """Return the extended Bayesian information criterion of all that was found."""
    named = sum(not step.is_elastic for step in trail.steps)
    return _fit_cost(trail.final) + 2.0 * named * float(np.log(max(len(trail.last.effects), 2)))


def _fit_cost(fit: Fit) -> float:
    """Return the Bayesian information criterion of a fit."""
    readings = len(fit.station) * sum(block.size for block in fit.station.sensor.blocks)
    return _misfit(fit) + fit.solution.posterior.effective * float(np.log(readings))


def discovery_report(calibration: Calibration, trail: History, traces: tuple[PartialResidual, ...]) -> dict[str, Any]:
    """Return the contents of ``discovery.json`` (contract).

    Args:
        calibration: the calibration with all that was found.
        trail: how it was found.
        traces: what each effect explains.
    """
    final = trail.final
    scatter = find_scatter(final)
    sigma = float(noise_floor(final)[0])
    size = final.station.sensor.blocks[0].size
    to_mm = 1e3 * final.station.metres_per_reading(final.values)
    floor = float(sigma * np.sqrt(size) * to_mm)
    after = _gap(calibration, final)
    misfit = _is_misfit(final)
    unexplained = float(np.sqrt(max(final.solution.estimated[0] ** 2 - sigma**2, 0.0) * size) * to_mm)
    periods = {trace.effect: period_of(trace) for trace in traces if trace.effect.is_nameless}
    effects = [entry for step in trail.steps for entry in _entries(calibration, trail, step, periods)]
    return {
        "noise_floor_mm": floor,
        "gap": {"before": _gap(calibration, trail.first), "after": after},
        "where": where_of(trail, scatter, is_misfit=misfit),
        "effects": effects,
        "scatter": [_scatter_entry(scatter, final)] if scatter else [],
        "not_testable": _not_testable(trail),
        "verdict": "not adequate" if misfit or scatter else "adequate",
        "unexplained_mm": unexplained,
    }


def _gap(calibration: Calibration, fit: Fit) -> dict[str, float]:
    return gap_of(fit, calibration.test).to_dict()


def _is_misfit(fit: Fit) -> bool:
    """Return whether the residuals are larger than the declared noise allows."""
    if fit.noise.declared[0] is None:
        return False
    return bool(chdtrc(fit.solution.degrees, fit.solution.chi2) < _MISFIT)


def _entries(
    calibration: Calibration, trail: History, step: Step, periods: dict[Effect, float | None]
) -> list[dict[str, Any]]:
    """Return the entries of one step: one an effect, elasticity one a joint."""
    gap = {
        "gap_before_mm": _gap(calibration, step.before)["mean_mm"],
        "gap_after_mm": _gap(calibration, step.after)["mean_mm"],
    }
    if step.is_elastic:
        return [entry | gap | {"equivalent": [], "tell_apart": ""} for entry in elastic_entries(trail.final)]
    effect = step.effects[0]
    period = periods.get(effect)
    rival = step.equivalent[0] if step.equivalent else None
    decide = "" if rival is None else deciding_measurement(step.before, step.criticism, step.index[0], rival)
    return [
        effect.describe()
        | ({} if period is None else {"period": period})
        | {"parameters": _parameters(trail.final, effect), "p_value": step.score.p_value}
        | gap
        | {"equivalent": [e.describe() for e in step.equivalent], "tell_apart": decide}
    ]


def _parameters(fit: Fit, effect: Effect) -> dict[str, dict[str, Any]]:
    """Return value, standard deviation (that of the prior where it was not fitted) and unit of an effect's parameters."""
    found = fit.estimate.take(parameter.name for parameter in effect.parameters(fit.model.chain))
    return {
        parameter.name: {"value": parameter.nominal + float(value), "sigma": float(sigma), "unit": parameter.unit}
        for parameter, value, sigma in zip(found.parameters, found.values, found.sigma, strict=True)
    }


def _scatter_entry(scatter: Scatter, fit: Fit) -> dict[str, Any]:
    """Name the column that could explain a scattering joint."""
    conditions = fit.station.conditions
    missing = f"approach_{scatter.joint}"
    if conditions.approach is not None:
        missing = "temperature" if conditions.temperature is None else "time"
    return {"joint": scatter.joint, "sigma_rad": scatter.sigma, "missing": missing}


def _not_testable(trail: History) -> list[dict[str, Any]]:
    """Return what these data can't test, with the reason."""
    final = trail.final
    found = [e.describe() | {"reason": reason} for e, reason in untestable(final.model.chain, final.station.conditions)]
    for i, effect in enumerate(trail.last.effects):
        if trail.last.gain([i])[1] == 0:
            found.append(effect.describe() | {"reason": "the fitted model absorbs all of it in these poses (rank zero)"})
    return found
