"""``discovery.json``: where the disagreement sits, which effect makes it, how sure that is, and what else it could be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtrc

from pincal.discover.loop import Step, Trail, discover_effects, place_of
from pincal.discover.power import deciding_measurement
from pincal.discover.scatter import Scatter, find_scatter
from pincal.identify.calibrate import Fit, Options
from pincal.identify.split import Split, row_groups
from pincal.measure.measurements import Measurements
from pincal.model.catalogue import untestable
from pincal.model.effects import GEOMETRIC, Compliance, Effect, JointElasticity
from pincal.report.result import parameter_rows, result_of
from pincal.report.run import Calibration, run_calibration
from pincal.report.validation import error_table
from pincal.robot.robot import Robot

# Standard deviations that a compliance has to be away from zero to be named by itself.
_SIGNIFICANT = 4.0
_MISFIT = 1e-3
_CV_BLOCKS = 8
_MOST_PLACES = 3


@dataclass(frozen=True)
class Discovery:
    """A discovery with its calibration.

    Attributes:
        calibration: the calibration with all that was found.
        trail: how it was found.
        report: the contents of ``discovery.json``.
    """

    calibration: Calibration
    trail: Trail
    report: dict[str, Any]


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

    Raises:
        BadInputError: as :func:`run_calibration`.
    """
    options = Options(effects=GEOMETRIC) if options is None else options
    first = run_calibration(
        robot, measurements, options, test_fraction=test_fraction, split=split, seed=seed, holdout=holdout
    )
    blocks = row_groups(first.train, split="blocked", seed=seed) % _CV_BLOCKS
    trail = discover_effects(first.fit, blocks, extra=extra, elastic=not robot.massless)
    held = trail.final.readings(first.test) if len(first.test) else None
    result = result_of(
        trail.final, held, seconds=first.result.seconds, train_rows=first.train.rows, notes=first.result.warnings[:0]
    )
    calibration = replace(first, fit=trail.final, result=result)
    return Discovery(calibration, trail, discovery_report(calibration, trail))


def discovery_report(calibration: Calibration, trail: Trail) -> dict[str, Any]:
    """Return the contents of ``discovery.json`` (contract)."""
    final = trail.final
    scatter = find_scatter(final)
    sigma = final.noise.declared[0] or float(final.solution.estimated[0])
    size = final.problem.sensor.blocks[0].size
    floor = float(sigma * np.sqrt(size) * 1e3)
    after = _gap(calibration, final)
    misfit = _is_misfit(final)
    unexplained = float(np.sqrt(max(final.solution.estimated[0] ** 2 - sigma**2, 0.0) * size) * 1e3)
    effects = [entry for step in trail.steps for entry in _entries(calibration, trail, step)]
    return {
        "noise_floor_mm": floor,
        "gap": {"before": _gap(calibration, trail.first), "after": after},
        "where": _where(trail, scatter),
        "effects": effects,
        "scatter": [_scatter_entry(scatter, final)] if scatter else [],
        "not_testable": _not_testable(trail),
        "verdict": "not adequate" if misfit or scatter else "adequate",
        "unexplained_mm": unexplained,
    }


def _gap(calibration: Calibration, fit: Fit) -> dict[str, float]:
    problem = fit.readings(calibration.test) if len(calibration.test) else fit.problem
    errors = error_table(problem, fit.values)
    return {name: errors[name] for name in ("mean_mm", "rms_mm", "max_mm")}


def _is_misfit(fit: Fit) -> bool:
    """Return whether the residuals are larger than the declared noise allows."""
    if fit.noise.declared[0] is None:
        return False
    return bool(chdtrc(fit.solution.degrees, fit.solution.chi2) < _MISFIT)


def _entries(calibration: Calibration, trail: Trail, step: Step) -> list[dict[str, Any]]:
    """Return the entries of one step: one an effect, elasticity one a joint."""
    gap = {
        "gap_before_mm": _gap(calibration, step.before)["mean_mm"],
        "gap_after_mm": _gap(calibration, step.after)["mean_mm"],
    }
    if isinstance(step.effects[0], JointElasticity):
        return [entry | gap | {"equivalent": [], "tell_apart": ""} for entry in _elastic_entries(trail.final)]
    effect = step.effects[0]
    rival = step.equivalent[0] if step.equivalent else None
    decide = "" if rival is None else deciding_measurement(step.before, step.criticism, step.index[0], rival)
    return [
        _identity(effect)
        | {"parameters": _parameters(trail.final, effect), "p_value": step.score.p_value}
        | gap
        | {"equivalent": [_identity(e) for e in step.equivalent], "tell_apart": decide}
    ]


def _identity(effect: Effect) -> dict[str, Any]:
    """Return name, joint and whatever else tells an effect from its likes."""
    joint, source = place_of(effect)
    entry: dict[str, Any] = {"effect": effect.name, "joint": joint}
    if source is not None:
        entry["source"] = source
    for key in ("order", "depends_on", "acts_on", "shape", "place"):
        value = vars(effect).get(key, getattr(effect, key, None))
        if value is not None:
            entry[key] = value
    return entry


def _parameters(fit: Fit, effect: Effect) -> dict[str, dict[str, Any]]:
    names = {parameter.name for parameter in effect.parameters(fit.model.chain)}
    return {
        row.name: {"value": row.value, "sigma": row.sigma, "unit": row.unit}
        for row in parameter_rows(fit)
        if row.name in names
    }


def _elastic_entries(fit: Fit) -> list[dict[str, Any]]:
    """Return the joints and bearings whose compliance is far from zero, the surest first."""
    sigma = np.full(len(fit.values), np.inf)
    sigma[fit.solution.free] = np.sqrt(np.diag(fit.solution.posterior.covariance))
    found = []
    for effect in fit.model.effects:
        if not isinstance(effect, Compliance):
            continue
        by_joint: dict[str, list[int]] = {}
        for parameter in effect.parameters(fit.model.chain):
            by_joint.setdefault(parameter.name.rsplit(".", 1)[0], []).append(fit.model.index(parameter.name))
        for joint, places in by_joint.items():
            z2 = float(np.sum((fit.values[places] / sigma[places]) ** 2))
            found.append((z2, len(places), effect.name, joint, places))
    found.sort(key=lambda item: -item[0])
    sure = [item for item in found if item[0] > _SIGNIFICANT**2 * item[1]] or found[:1]
    return [
        {
            "effect": name,
            "joint": joint,
            "parameters": {
                fit.model.names[i]: {
                    "value": float(fit.values[i]),
                    "sigma": float(sigma[i]) if np.isfinite(sigma[i]) else None,
                    "unit": fit.model.parameters[i].unit,
                }
                for i in places
            },
            "p_value": float(chdtrc(size, z2)),
        }
        for z2, size, name, joint, places in sure
    ]


def _where(trail: Trail, scatter: Scatter | None) -> list[dict[str, Any]]:
    """Say where the disagreement sat, step by step, before anything was named."""
    found = []
    for step in trail.steps:
        share = min(max(step.score.gain / step.criticism.squares, 0.0), 1.0)
        joint, _ = place_of(step.effects[0])
        if isinstance(step.effects[0], JointElasticity):
            statement = "what the geometric model leaves follows the static moments on the joints"
            joint = _elastic_entries(step.after)[0]["joint"]
        elif joint is None:
            statement = "what was left shows on the whole arm"
        else:
            statement = f"what was left acts at {joint}{_variable(step.effects[0])}"
        found.append({"joint": joint, "statement": statement, "share": share})
    if scatter:
        found.append({"joint": scatter.joint, "statement": f"{scatter.joint} scatters from pose to pose", "share": 1.0})
    return found


def _variable(effect: Effect) -> str:
    depends = vars(effect).get("depends_on") or place_of(effect)[1]
    own = effect.name in ("gear_eccentricity", "transmission_error", "gear_ratio", "axis_wobble", "gravity_compensator")
    if depends and depends != place_of(effect)[0]:
        return f" and follows {depends}"
    return " and follows its own angle" if own or depends else ""


def _scatter_entry(scatter: Scatter, fit: Fit) -> dict[str, Any]:
    """Name the column that could explain a scattering joint."""
    conditions = fit.problem.conditions
    missing = f"approach_{scatter.joint}"
    if conditions.approach is not None:
        missing = "temperature" if conditions.temperature is None else "time"
    return {"joint": scatter.joint, "sigma_rad": scatter.sigma, "missing": missing}


def _not_testable(trail: Trail) -> list[dict[str, Any]]:
    """Return what these data can't test, with the reason."""
    final = trail.final
    found = [_identity(e) | {"reason": reason} for e, reason in untestable(final.model.chain, final.problem.conditions)]
    for i, effect in enumerate(trail.last.effects):
        if trail.last.gain([i])[1] == 0:
            found.append(_identity(effect) | {"reason": "the fitted model absorbs all of it in these poses (rank zero)"})
    return found
