"""From the history of a discovery to its findings: how sure each is, what else it could be, and whether all is explained."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from msgspec.structs import replace
from scipy.special import chdtrc

from pincal.discover.elastic_rivals import instead_of, without_compliance
from pincal.discover.history import History, Step
from pincal.discover.lines import told_of_line
from pincal.discover.power import ABSORBED, deciding_measurement
from pincal.discover.scatter import find_excess
from pincal.discover.shrink import PartialResidual, period_of
from pincal.discover.stability import Halves, Heading
from pincal.discover.where import Sure, noise_floor, sure_compliances, where_of
from pincal.identify.fit import Fit
from pincal.io.discovery_file import (
    SURE,
    Bootstrap,
    EffectName,
    Findings,
    FoundEffect,
    FoundParameter,
    Repeated,
    Stability,
    Stage,
    Untestable,
)
from pincal.model.catalogue import untestable
from pincal.model.effect import Effect, Tone
from pincal.parameters import Estimate
from pincal.validate.misfit import MISFIT
from pincal.validate.verdict import judge


def findings_of(
    fit: Fit,
    trail: History,
    *,
    gaps: tuple[Stage, ...],
    traces: tuple[PartialResidual, ...],
    approach_from: str | None = None,
) -> Findings:
    """Return what a discovery found.

    Args:
        fit: the fit with all that was found, its covariance paying for the choice.
        trail: how it was found.
        gaps: the errors at the start and after each change of the model.
        traces: what each effect explains.
        approach_from: where directions of approach come from, in words; None where there are none.
    """
    final = trail.final
    excess = find_excess(final)
    scatter = None if excess is None else excess.scattering
    floor, left = _errors_of(final)
    # Residuals that are larger than the declared noise allows.
    is_misfit = final.is_declared and chdtrc(final.solution.degrees, final.solution.chi2) < MISFIT
    periods = {trace.effect: period_of(trace) for trace in traces if trace.effect.is_nameless}
    effects = tuple(found for step in trail.steps for found in _found(fit, trail, step, gaps=gaps, periods=periods))
    return Findings(
        noise_floor_mm=floor,
        gap={"before": gaps[0].gap, "after": gaps[-1].gap},
        chain=gaps,
        where=where_of(trail, excess, is_misfit=is_misfit),
        effects=effects,
        scatter=() if scatter is None else (scatter,),
        not_testable=tuple(Untestable.of(effect, reason=reason) for effect, reason in _not_testable(trail)),
        verdict=judge(None, left=is_misfit or excess is not None),
        unexplained_mm=left,
        approach_from=approach_from,
    )


def repeated(findings: Findings, halves: Halves, bootstrap: Bootstrap | None) -> Findings:
    """Return findings with how stable they are.

    Args:
        findings: what a discovery found.
        halves: what the search named in halves of the poses.
        bootstrap: whether the effect that was accepted last may be chance; None if there is none.
    """
    if not halves:
        return replace(findings, bootstrap=bootstrap)
    effects = tuple(replace(entry, stability=_stability(entry, halves)) for entry in findings.effects)
    return replace(
        findings,
        effects=effects,
        hints=tuple(_repeated(entry, entry.stability) for entry in effects if entry.stability and entry.is_hint),
        only_in_halves=tuple(_only_in_halves(effects, halves)),
        poses_in_a_half=halves.poses,
        bootstrap=bootstrap,
    )


def _heading(entry: EffectName) -> Heading:
    return entry.effect, entry.joint, entry.source


def _stability(entry: EffectName, halves: Halves) -> Stability:
    return Stability(halves.count(_heading(entry)), len(halves))


def _repeated(name: EffectName, stability: Stability) -> Repeated:
    return Repeated(**{field: getattr(name, field) for field in EffectName.__struct_fields__}, stability=stability)


def _only_in_halves(effects: Sequence[FoundEffect], halves: Halves) -> Iterator[Repeated]:
    """Yield names that most halves bring up and that all rows neither have nor list among what could be theirs."""
    known = [_heading(name) for entry in effects for name in (entry, *entry.equivalent)]
    for (effect, joint, source), named in halves.others(known, SURE):
        yield Repeated(effect=effect, joint=joint, source=source, stability=Stability(named, len(halves)))


def _errors_of(fit: Fit) -> tuple[float, float]:
    """Return the rms errors that noise makes and those that it does not, over the rows of all stations [mm]."""
    sizes, rows = [], []
    for station, places, blocks in fit.stations:
        sigma, found, size = (
            float(noise_floor(fit)[blocks.start]),
            fit.solution.estimated[blocks.start],
            station.sensor.blocks[0].size,
        )
        to_mm = 1e3 * station.metres_per_reading(fit.values[places])
        sizes.append((sigma * np.sqrt(size) * to_mm, np.sqrt(max(found**2 - sigma**2, 0.0) * size) * to_mm))
        rows.append(len(station))
    if len(sizes) == 1:
        return float(sizes[0][0]), float(sizes[0][1])
    floor, left = np.sqrt(np.average(np.square(sizes), axis=0, weights=rows))
    return float(floor), float(left)


def _found(
    fit: Fit,
    trail: History,
    step: Step,
    *,
    gaps: tuple[Stage, ...],
    periods: dict[Effect, float | None],
) -> Iterator[FoundEffect]:
    """Yield what entered in one step; elasticity joint by joint."""
    place = next(i for i, change in enumerate(trail.changes) if change.fit is step.after)
    before, after = gaps[place], gaps[place + 1]
    # Standard deviations that pay for the choice, too.
    known = fit.estimate
    if step.is_elastic:
        found = [
            (sure.effect, e := sure.estimate, known.take(e.names).fitted_sigma, sure.p_value, *_in_its_place(trail, sure))
            for sure in sure_compliances(trail.final, step.effects, step.equivalent)
        ]
    else:
        decide = _deciding(step)
        whole = step.effects if isinstance(step.effect, Tone) else step.effects[:1]
        estimate = known.take(trail.final.names_of(whole))
        found = [(step.effect, estimate, estimate.sigma, step.score.p_value, step.equivalent, decide)]
    line = told_of_line(trail, step)
    for effect, estimate, sigma, p_value, equivalent, decide in found:
        if step.is_elastic and trail.is_held_up and p_value > trail.policy.false_name:
            # Beside all other compliances, which few rows leave to what is known beforehand, nothing is left of it.
            continue
        yield FoundEffect.of(
            effect,
            period=periods.get(effect),
            parameters=_parameters(estimate, sigma),
            p_value=p_value,
            gap_before_mm=before.mean_mm,
            gap_after_mm=after.mean_mm,
            gap_before_mrad=before.mean_mrad,
            gap_after_mrad=after.mean_mrad,
            equivalent=tuple(EffectName.of(other) for other in equivalent),
            tell_apart=decide,
            **line,
        )


def _deciding(step: Step) -> str:
    """Return what would tell an effect from the first that could stand in its place, or from several that together could."""
    told = (step.before, step.tested, step.estimate)
    if not step.together:
        return "".join(deciding_measurement(*told, rival) for rival in step.equivalent[:1])
    names = [f"{effect.name} of order {at.order}" if (at := effect.locus).order else effect.name for effect in step.together]
    words = f"{', '.join(names[:-1])} and {names[-1]} of {step.effect.locus.joint} together do as much"
    return f"{words}; {deciding_measurement(*told, *step.together)}"


def _in_its_place(trail: History, sure: Sure) -> tuple[tuple[Effect, ...], str]:
    """Return what could give way in the place of one joint's compliance, others among it, and what decides."""
    compliance = sure.effect
    rivals = tuple(dict.fromkeys((*instead_of(trail.last, compliance, sure.estimate, sure.beside), *sure.others)))
    if not rivals:
        return (), ""
    rest = without_compliance(trail.final, compliance, *(sure.others[:1] if sure.beside else ()))
    own = np.array([sure.estimate[parameter.name] for parameter in compliance.parameters(rest.problem.chain)])
    return rivals, deciding_measurement(rest, compliance, own, rivals[0])


def _parameters(estimate: Estimate, sigmas: np.ndarray) -> dict[str, FoundParameter]:
    """Return parameters by name; nothing is known of those whose standard deviation is infinite."""
    return {
        p.name: FoundParameter(p.nominal + float(value), float(sigma) if np.isfinite(sigma) else None, p.unit)
        for p, value, sigma in zip(estimate.parameters, estimate.values, sigmas, strict=True)
    }


def _not_testable(trail: History) -> Iterator[tuple[Effect, str]]:
    """Yield what these data can't test, with the reason."""
    final = trail.final
    is_alone = len(final.problem.stations) == 1
    lost = untestable(final.problem.chain, final.problem.conditions)
    yield from ((effect, reason) for effect, reason in lost if is_alone or effect.scope == "robot")
    for i, effect in enumerate(trail.last.effects):
        if trail.last.gain([i])[1] == 0:
            yield effect, ABSORBED
