r"""How a search ends: noise that comes by way of the joints, waves that are one line, a covariance that pays for the choice.

What no effect describes is mostly somewhere in the drives: friction, backlash, waves too short for a curve. It moves the
readings of a pose together, the more the longer the levers. With noise :math:`\sigma_b` of the instrument, levers :math:`J`
and variances :math:`\tau_j^2` of the joints, the covariance of a row is

.. math:: V = \operatorname{diag}(\sigma_b^2) + J \operatorname{diag}(\tau_j^2) J^T,

whose variances are those by which the residuals of a fit are likeliest. A fit that weighs its rows by V (generalised least
squares) is the most exact one, and does not take readings of one joint's error for several.

Over S turns of a joint a wave shows orders 1 / S to either side of its own; two that are less than 2 / S apart are as well
one line between them that waxes and wanes once over the span, as the load or the mesh of a gear makes it.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain
from typing import Any

import numpy as np
from scipy.optimize import minimize

from pincal.discover.candidate_tests import Search, over_rows_of, sampled
from pincal.discover.decisions import each_heading_once
from pincal.discover.drive_curves import smoothed
from pincal.discover.first_order import ScoreTests
from pincal.discover.levers import MassError, levers, missing_features, situation_of
from pincal.discover.policy import NOISE, WAVES
from pincal.discover.score_tests import score_test_given_nuisances
from pincal.discover.steps import (
    History,
    SearchState,
    SearchStep,
    worded,
)
from pincal.identify.calibrate import Tolerance, refit
from pincal.identify.choices import deviance
from pincal.identify.dependence import with_blocks
from pincal.identify.fit import Ending, ModelFit, without
from pincal.measure.extrinsics import sample_rows
from pincal.model.catalogue.ripple import resolution_of
from pincal.model.effect import Curve, Effect, Harmonic
from pincal.units import format_small

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class JointNoise:
    """What moves the readings from row to row.

    Attributes:
        joints: shape (n,), standard deviation of each joint's position [rad or m].
        instrument: shape (blocks,), that of the readings otherwise, by block of readings of all stations.
    """

    joints: np.ndarray
    instrument: np.ndarray


def joint_noise(fit: ModelFit) -> JointNoise | None:
    """Return the noise that comes by way of the joints; None where noise is declared or the residuals don't call for it."""
    problem, solution = fit.problem, fit.solution
    readings = problem.readings(solution.weights).sum()
    is_declared = any(sigma is not None for sigma in fit.noise.declared)
    is_whole = any(station.sensor.is_whole for station in problem.stations)
    if is_declared or is_whole or solution.exit is Ending.EXACT or readings < NOISE.readings_each * solution.effective:
        return None
    parts = list(_readings(fit))
    squares = sum(np.sum(part.levers**2, axis=(0, 1)) for part in parts)
    lengths = np.sqrt(np.where(squares > 0.0, squares, np.inf) / sum(part.residuals.size for part in parts))
    variances, gain = _likeliest([replace(part, levers=part.levers / lengths) for part in parts], len(problem.blocks))
    if gain < NOISE.joints:
        return None
    n = len(lengths)
    joints = np.where(np.isfinite(lengths), np.sqrt(variances[:n]) / lengths, 0.0)
    return JointNoise(joints, np.sqrt(variances[n:]) * solution.estimated)


def weighed(fit: ModelFit, noise: JointNoise) -> ModelFit:
    """Return a fit as it is whose readings are to be weighed by this noise.

    The size of the noise of each block of readings keeps its meaning: that of a single reading, all causes together.
    """
    drives, stations = tuple(map(int, fit.problem.chain.drives)), []
    for (station, _, blocks), alone in zip(fit.stations, fit.alone, strict=True):
        if not station.sensor.reads_place:
            stations.append(station)
            continue
        moved = levers(alone, drives).transpose(2, 1, 0) * noise.joints
        V = moved @ moved.transpose(0, 2, 1)
        sizes = np.empty(V.shape[1])
        for of, sigma in zip(station.block_rows, noise.instrument[blocks], strict=True):
            at = np.arange(of.start, of.stop)
            V[:, at, at] += sigma**2
            sizes[of] = np.sqrt(np.mean(V[:, at, at]))
        whitening = np.linalg.inv(np.linalg.cholesky(V)) * sizes[:, None]
        stations.append(replace(station, whitening=np.ascontiguousarray(whitening.transpose(1, 2, 0))))
    return fit.over(stations)


def note_on_joints(fit: ModelFit) -> str | None:
    """Return what to say of a fit whose readings are weighed by this noise; None of any other."""
    if fit.is_declared or all(station.whitening is None for station in fit.problem.stations):
        return None
    noise, robot = joint_noise(fit), fit.problem.chain.robot
    joints = np.zeros(robot.n_joints) if noise is None else noise.joints
    triples = zip(robot.joint_names, joints.tolist(), robot.joint_units, strict=True)
    sizes = ", ".join(f"{joint} {format_small(sigma, unit)}" for joint, sigma, unit in triples if sigma > 0.0)
    return (
        f"the residuals look like joint noise ({sizes or 'hardly'} from row to row), and the "
        "final fit weights the readings of each row accordingly"
    )


@dataclass(frozen=True)
class _Readings:
    """Rows of a station, in units of the noise.

    Attributes:
        residuals: shape (N, m).
        levers: shape (N, m, n), how they move with each joint.
        block: shape (m,), the block of each reading.
    """

    residuals: np.ndarray
    levers: np.ndarray
    block: np.ndarray


def _readings(fit: ModelFit) -> Iterator[_Readings]:
    """Yield rows of each station that count, as many as tell the variances."""
    drives = tuple(map(int, fit.problem.chain.drives))
    for station, alone, blocks in fit.in_places:
        sound = np.flatnonzero(alone.solution.weights > 0.0)
        rows = sound[sample_rows(len(sound), NOISE.rows)]
        if not len(rows):
            continue
        few = alone.select(rows)
        block = np.repeat(np.arange(blocks.start, blocks.stop), station.block_sizes)
        scale = station.weights[rows] / fit.solution.estimated[block][:, None]
        residuals = few.station.residuals(alone.values) * scale
        yield _Readings(residuals.T, (levers(few, drives) * scale).transpose(2, 1, 0), block)


def _likeliest(parts: Sequence[_Readings], n_blocks: int) -> tuple[np.ndarray, float]:
    """Return the likeliest variances of joints and blocks, shape (n + blocks,), and what those of joints gain."""
    n = parts[0].levers.shape[2]
    squares, counts = np.zeros(n_blocks), np.zeros(n_blocks)
    for part in parts:
        np.add.at(squares, part.block, np.sum(part.residuals**2, axis=0))
        np.add.at(counts, part.block, len(part.residuals))
    seen = counts > 0.0
    without = float(np.sum(counts[seen] * (1.0 + np.log(squares[seen] / counts[seen]))))

    def misfit(logs: np.ndarray) -> tuple[float, np.ndarray]:
        variances, total, slope = np.exp(logs), 0.0, np.zeros(len(logs))
        for part in parts:
            V = (part.levers * variances[:n]) @ part.levers.transpose(0, 2, 1)
            at = np.arange(len(part.block))
            V[:, at, at] += variances[n + part.block]
            inverse = np.linalg.inv(V)
            z = np.einsum("nij,nj->ni", inverse, part.residuals)
            total += float(np.sum(np.linalg.slogdet(V)[1]) + np.sum(z * part.residuals))
            # Of -2 log L by V.
            D = inverse - z[:, :, None] * z[:, None, :]
            slope[:n] += np.einsum("nik,nik->k", D @ part.levers, part.levers)
            np.add.at(slope, n + part.block, D[:, at, at].sum(axis=0))
        return total, slope * variances

    start = np.full(n + n_blocks, np.log(NOISE.start))
    found = minimize(
        misfit, start, jac=True, method="L-BFGS-B", bounds=[(np.log(NOISE.bounds[0]), np.log(NOISE.bounds[1]))] * len(start)
    )
    return np.exp(found.x), without - float(found.fun)


def name_lines(state: SearchState, search: Search) -> SearchState:
    """Take waves that the span of their joint can't tell apart as one line, and give it the name that its order suggests."""
    for step in _lines(state.steps):
        state = _joined(state, step)
    for wave in sorted((step.effect for step in _lines(state.steps)), key=_order):
        found = next((step for step in state.steps if step.effect is wave), None)
        state = state if found is None else _as_suggested(state, found, search)
    return state


def line_details(trail: History, step: SearchStep) -> dict[str, Any]:
    """Return what is to be said of a line beside its name: fields of :class:`FoundEffect`; nothing of other effects."""
    if not isinstance(step.effect, Harmonic):
        return {}
    width, orders = _resolution(trail.final, step.effect), [_order(effect) for effect in step.effects]
    wheels = {_order(e): "given by the user" for e in trail.extra if isinstance(e, Harmonic)}
    for other in _lines(trail.steps):
        if other is not step and isinstance(other.effect, Harmonic) and other.effect.band is not None:
            wheels.setdefault(_order(other.effect), f"a line of {other.effect.locus.joint}")
    origin = step.effect.origin(float(np.mean(orders)), width, wheels)
    return {"resolution": width, "beside": tuple(orders[1:]), "origin": origin}


def _lines(steps: tuple[SearchStep, ...]) -> list[SearchStep]:
    return [step for step in steps if isinstance(step.effect, Harmonic)]


def _order(effect: Effect) -> float:
    return effect.locus.order or 0.0


def _resolution(fit: ModelFit, effect: Effect) -> float:
    joint = fit.problem.chain.robot.joint_names.index(str(effect.locus.joint))
    return resolution_of(fit.problem.conditions.q[fit.solution.weights > 0.0, joint])


def _joined(state: SearchState, step: SearchStep) -> SearchState:
    """Return the state in which a wave is part of an earlier line, if it is no further from it than the span tells."""
    near = WAVES.line * _resolution(state.fit, step.effect)
    earlier = _lines(state.steps[: state.steps.index(step)])
    line = next((s for s in earlier if all(_is_near(step.effect, part, near) for part in s.effects)), None)
    if line is None:
        return state
    parts = (*line.effects, *step.effects)
    log.info("%s: one line with %s", worded(step.effects), worded(line.effects[:1]))
    others = tuple(other for other in line.equivalent if not any(_is_near(other, part, near) for part in parts))
    return state.with_replaced(line, replace(line, effects=parts, equivalent=others)).without_step(step)


def _is_near(effect: Effect, other: Effect, near: float) -> bool:
    """Return whether two effects are waves of one name on one joint, and of nearly one order."""
    return effect.heading == other.heading and abs(_order(effect) - _order(other)) < near


def _as_suggested(state: SearchState, step: SearchStep, search: Search) -> SearchState:
    """Return the state with the cause that the order of a line suggests in its place, and of others that this has in it.

    It has to explain the data as well in the very order that it has by its nature.
    """
    wave, *others = step.effects
    width = _resolution(state.fit, wave)
    assert isinstance(wave, Harmonic)
    cause = wave.suggested(width)
    if others or cause == wave:
        return state
    on_joint = [s.effects for s in _lines(state.steps) if s.effect.locus.joint == wave.locus.joint]
    inside = [part for part in on_joint if all(min(abs(_order(e) - k) for k in cause.orders) < width for e in part)]
    rest = reduce(without, chain.from_iterable(inside), state.fit)
    after = refit(rest, [*rest.options.effects, cause], start={})
    if deviance(after) > deviance(state.fit) + search.policy.tie:
        return state
    log.info("%s is %s by its order", worded([wave]), worded([cause]))
    told = each_heading_once([wave, *(e for e in step.equivalent if not _is_near(e, cause, width))], cause, search.policy)
    state = state.tuned(step, replace(step, effects=(cause,), equivalent=told, after=after))
    if gone := [part for part in inside if part[0] is not wave]:
        left = tuple(effect for part in gone for effect in part)
        state = state.changed(after, tuple(s for s in state.steps if s.effects not in gone), (), left)
    return state


def widened(trail: History) -> ModelFit:
    r"""Return the last fit of a discovery with a covariance that pays for what the model does not have.

    A fit's covariance holds if its effects are all there are. After a discovery they are those that were chosen, and three
    things are left out that move other poses as well: masses and centres of mass are a few per cent off, which the score
    tests grant and the model does not have; among the candidates that were refused some may be there; and each bearing has
    directions and a place of its own, which enter only where the data call for them. What each adds to the
    variance of a prediction follows, on average over the rows, from the projected products of the score tests,

    .. math:: e_m = m^T S' m + \operatorname{tr} S' C, \qquad C = (S' + D^{-2})^{-1}, \quad m = C b' ,

    for masses known to D, in units of the noise and summed over the readings, and the mean over candidates,
    :math:`e_c = \sum_g w_g T_g`, with weights from the information criterion, :math:`w_g \propto \exp(-\mathrm{EBIC}_g/2)`,
    1 for no candidate (Bayesian model averaging: Hoeting et al. 1999, Stat. Sci. 14, 382-417); of bearings the same of each
    direction and place by itself, :math:`e_b`. What the fit's own parameters add is their effective number p. So the
    covariance is that of noise whose variance is :math:`1 + (e_m + e_c + e_b) / p` times as large.
    """
    fit = trail.final
    few, _ = sampled(fit, trail.policy)
    rows = len(fit.problem) / max(len(few.problem), 1)
    noise = float(np.mean((fit.solution.estimated / fit.solution.sigma) ** 2))
    features = score_test_given_nuisances(few, missing_features(few))
    beyond = (of_masses(few, features) + of_candidates(trail.last) + of_bearings(features)) * rows * noise
    return with_blocks(fit, 1.0 + beyond / max(fit.solution.effective, 1.0))


def of_masses(fit: ModelFit, tests: ScoreTests) -> float:
    """Return what masses that are off add to the variance of the rows, summed over readings, in units of the noise.

    Args:
        fit: the fit.
        tests: those of what it does not have of its bearings, beside its masses alone.
    """
    masses = MassError.of(*fit.arm)
    if masses is None:
        return 0.0
    place = {name: i for i, name in enumerate(tests.names)}
    parameters = masses.parameters(fit.problem.chain)
    at, sizes = [place[p.name] for p in parameters], np.array([p.size for p in parameters])
    # Beside the fit's parameters, what rows and priors say of them together.
    half = tests.model.factor.half(np.eye(tests.n_model)[:, at] / sizes)
    C, most_probable = half.T @ half, half.T @ tests.model.slope
    S = np.linalg.inv(C) - np.eye(len(C))
    return float(most_probable @ S @ most_probable + np.sum(S * C))


def of_bearings(tests: ScoreTests) -> float:
    """Return the same of directions and places of bearings that the data did not call for: each may be there by itself."""
    return float(sum(of_candidates(tests, [i]) for i in range(len(tests.effects))))


def of_candidates(tests: ScoreTests, which: Sequence[int] | None = None) -> float:
    """Return the same of the candidates that were refused, each weighed by how likely it is there all the same.

    Args:
        tests: those against the last model.
        which: of which candidates, one of them at most there; default: all.
    """
    which = range(len(tests.effects)) if which is None else which
    groups = len({tests.effects[i].identity for i in which})
    scores = [tests.score([i], groups) for i in which]
    gains, costs = np.array([score.gain for score in scores]), np.array([score.ebic for score in scores])
    # Odds against no candidate, which costs nothing.
    best = min(float(costs.min(initial=0.0)), 0.0)
    odds = np.exp(-0.5 * (costs - best))
    return float(odds @ gains / (odds.sum() + np.exp(0.5 * best)))


def fit_all_rows(state: SearchState, search: Search) -> SearchState:
    """Fit all rows of the first fit, and every curve that was found as fine and as smooth as they say that it is.

    At the end rows are weighed by the noise that is left, which may come by way of the joints. How smooth curves are is told
    before: what is left of them passes for such noise.
    """
    fit, first = state.fit, search.first
    is_thinned, noise = len(fit.problem) < len(first.problem), joint_noise(fit)
    if is_thinned:
        whole = over_rows_of(fit, first)
        situation = situation_of(whole)
        wider: dict[Effect, Effect] = {e: e.resized(situation, e.resolution) for e in _curves_of(state)}
        fit = refit(whole, _exchanged(fit.options.effects, wider), until=Tolerance.ROUGH)
        state = _with_others(state, wider, fit)
    curves = _curves_of(state)
    if not curves and not is_thinned and noise is None:
        return state.fitted_again(refit(fit, fit.options.effects, start={})) if state.changes else state
    chosen: dict[Curve, tuple[Curve, np.ndarray]] = {}
    if curves and fit.solution.exit is not Ending.EXACT:
        chosen, fit = smoothed(fit, curves, search.policy.finer)
    for curve, (finer, _) in chosen.items():
        log.info("%s: %d pieces, smooth %d", curve.locus.joint, curve.resolution, finer.resolution)
    by: dict[Effect, Effect] = {curve: finer for curve, (finer, _) in chosen.items()}
    start: dict[Effect, np.ndarray] = dict(chosen.values())
    effects = _exchanged(fit.options.effects, by)
    fit = fit if noise is None else weighed(fit, noise)
    state = _with_others(state, by, refit(fit, effects, start=start))
    return state.changed(state.fit, state.steps, (), ())


def _curves_of(state: SearchState) -> list[Curve]:
    """Return the curves that were found; those that the user gave stay as they are."""
    return [effect for step in state.steps for effect in step.effects if isinstance(effect, Curve)]


def _exchanged(effects: Iterable[Effect], by: Mapping[Effect, Effect]) -> tuple[Effect, ...]:
    return tuple(by.get(effect, effect) if isinstance(effect, Curve) else effect for effect in effects)


def _with_others(state: SearchState, by: Mapping[Effect, Effect], fit: ModelFit) -> SearchState:
    steps = tuple(replace(step, effects=_exchanged(step.effects, by)) for step in state.steps)
    return replace(state, fit=fit, steps=steps)
