"""From the history of a discovery to its findings: how sure each is, what else it could be, and whether all is explained."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc

from pincal.calibration.run import Calibration
from pincal.discover.findings import Findings, FoundEffect, Untestable, Verdict
from pincal.discover.history import History, Step
from pincal.discover.power import deciding_measurement
from pincal.discover.scatter import Scatter, find_scatter
from pincal.discover.shrink import PartialResidual, gap_of, period_of
from pincal.discover.where import noise_floor, sure_compliances, where_of
from pincal.identify.fit import Fit
from pincal.io.discovery_file import FoundParameter, ScatteringJoint
from pincal.model.catalogue import untestable
from pincal.model.effect import Effect

# Chance of residuals as large as these, if there were only the declared noise, below which something is missing.
_MISFIT = 1e-3


def findings_of(calibration: Calibration, trail: History, traces: tuple[PartialResidual, ...]) -> Findings:
    """Return what a discovery found.

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
    is_misfit = _is_misfit(final)
    periods = {trace.effect: period_of(trace) for trace in traces if trace.effect.is_nameless}
    return Findings(
        noise_floor_mm=float(sigma * np.sqrt(size) * to_mm),
        before=gap_of(trail.first, calibration.test),
        after=gap_of(final, calibration.test),
        where=where_of(trail, scatter, is_misfit=is_misfit),
        effects=tuple(e for step in trail.steps for e in _found(calibration, trail, step, periods=periods)),
        scatter=() if scatter is None else (_scattering(scatter, final),),
        not_testable=_not_testable(trail),
        verdict=Verdict.NOT_ADEQUATE if is_misfit or scatter else Verdict.ADEQUATE,
        unexplained_mm=float(np.sqrt(max(final.solution.estimated[0] ** 2 - sigma**2, 0.0) * size) * to_mm),
    )


def _is_misfit(fit: Fit) -> bool:
    """Return whether the residuals are larger than the declared noise allows."""
    if fit.noise.declared[0] is None:
        return False
    return bool(chdtrc(fit.solution.degrees, fit.solution.chi2) < _MISFIT)


def _found(
    calibration: Calibration, trail: History, step: Step, *, periods: dict[Effect, float | None]
) -> list[FoundEffect]:
    """Return what entered in one step; elasticity joint by joint."""
    before, after = (gap_of(fit, calibration.test).mean_mm for fit in (step.before, step.after))
    if step.is_elastic:
        return [FoundEffect(effect, found, p, before, after) for effect, found, p in sure_compliances(trail.final)]
    rival = step.equivalent[0] if step.equivalent else None
    decide = "" if rival is None else deciding_measurement(step.before, step.criticism, step.index[0], rival)
    effect = step.effect
    return [
        FoundEffect(
            effect,
            _parameters(trail.final, effect),
            step.score.p_value,
            before,
            after,
            equivalent=step.equivalent,
            tell_apart=decide,
            period=periods.get(effect),
        )
    ]


def _parameters(fit: Fit, effect: Effect) -> dict[str, FoundParameter]:
    found = fit.estimate.take(parameter.name for parameter in effect.parameters(fit.model.chain))
    return {
        parameter.name: FoundParameter(parameter.nominal + float(value), float(sigma), parameter.unit)
        for parameter, value, sigma in zip(found.parameters, found.values, found.sigma, strict=True)
    }


def _scattering(scatter: Scatter, fit: Fit) -> ScatteringJoint:
    """Name the column that could explain a scattering joint."""
    conditions = fit.station.conditions
    missing = f"approach_{scatter.joint}"
    if conditions.approach is not None:
        missing = "temperature" if conditions.temperature is None else "time"
    return ScatteringJoint(scatter.joint, scatter.sigma, missing)


def _not_testable(trail: History) -> tuple[Untestable, ...]:
    """Return what these data can't test, with the reason."""
    final = trail.final
    found = [Untestable(*pair) for pair in untestable(final.model.chain, final.station.conditions)]
    for i, effect in enumerate(trail.last.effects):
        if trail.last.gain([i])[1] == 0:
            found.append(Untestable(effect, "the fitted model absorbs all of it in these poses (rank zero)"))
    return tuple(found)
