r"""Final passes of a search: joint noise, waves that form one line, and a covariance that includes
the selection.

Unmodelled errors are mostly in the drives: friction, backlash, waves too short for a curve. They
move all readings of a pose together, in proportion to the levers. With noise :math:`\sigma_b` of
the instrument, levers :math:`J` and variances
:math:`\tau_j^2` of the joints, the covariance of a row is

.. math:: V = \operatorname{diag}(\sigma_b^2) + J \operatorname{diag}(\tau_j^2) J^T,

with the variances of maximum likelihood. A fit with weights from V (generalised least squares) is
the most accurate one, and does not count one joint's error as several.

Over S turns of a joint a wave has a line width of 1 / S to either side of its order; two orders
less than 2 / S apart may be a single line between them whose amplitude varies once over the span,
as with the load or the mesh of a gear.
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
from pincal.discover.decisions import each_heading_once, is_near
from pincal.discover.drive_curves import smoothed
from pincal.discover.first_order import ScoreTests
from pincal.discover.levers import missing_features, situation_of
from pincal.discover.noise_numbers import NOISE
from pincal.discover.score_tests import score_test_given_nuisances
from pincal.discover.steps import History, SearchState, SearchStep, listed
from pincal.discover.wave_numbers import WAVES
from pincal.identify.arrivals import shares_stops, with_arrivals
from pincal.identify.calibrate import Tolerance, refit, told_by
from pincal.identify.choices import deviance
from pincal.identify.dependence import with_blocks
from pincal.identify.fit import Ending, ModelFit, without
from pincal.identify.fit_levers import levers
from pincal.identify.mass_error import MassError
from pincal.model.catalogue.ripple import resolution_of
from pincal.model.effect import Curve, Effect, Harmonic
from pincal.sensors.row_samples import sample_rows
from pincal.units import format_small

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class JointNoise:
    """Noise of joints and instrument.

    Attributes:
        joints: shape (n,), standard deviation of each joint's position [rad or m].
        instrument: shape (blocks,), standard deviation of the readings otherwise, by block of
            readings of all stations.
    """

    joints: np.ndarray
    instrument: np.ndarray


def joint_noise(fit: ModelFit) -> JointNoise | None:
    """Return the noise of joints and instrument; None where noise is declared or joint noise is not
    significant.
    """
    problem = fit.problem
    solution = fit.solution
    readings = problem.readings(solution.weights).sum()
    is_declared = any(sigma is not None for sigma in fit.noise.declared)
    is_whole = any(station.sensor.is_whole for station in problem.stations)
    if any(station.arrival is not None for station in problem.stations):
        # Rows of one stop are weighted by what they share already.
        return None
    if (
        is_declared
        or is_whole
        or solution.exit is Ending.EXACT
        or readings < NOISE.readings_each * solution.effective
    ):
        return None
    parts = list(_readings(fit))
    squares = sum(np.sum(part.levers**2, axis=(0, 1)) for part in parts)
    lengths = np.sqrt(
        np.where(squares > 0.0, squares, np.inf) / sum(part.residuals.size for part in parts)
    )
    variances, gain = _likeliest(
        [replace(part, levers=part.levers / lengths) for part in parts], len(problem.blocks)
    )
    if gain < NOISE.joints:
        return None
    n = len(lengths)
    joints = np.where(np.isfinite(lengths), np.sqrt(variances[:n]) / lengths, 0.0)
    return JointNoise(joints, np.sqrt(variances[n:]) * solution.estimated)


def weighed(fit: ModelFit, noise: JointNoise) -> ModelFit:
    """Return a fit, not refitted, with weights from this noise.

    The noise of each block of readings is still that of a single reading from all causes together.
    """
    drives = tuple(map(int, fit.problem.chain.drives))
    stations = []
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
        stations.append(
            replace(station, whitening=np.ascontiguousarray(whitening.transpose(1, 2, 0)))
        )
    return fit.over(stations)


def note_on_joints(fit: ModelFit) -> str | None:
    """Return the note on a fit whose readings are weighted by joint noise; None for any other."""
    if any(station.arrival is not None for station in fit.problem.stations):
        return (
            "readings of several targets, or points, in one stop of the robot share an error that "
            "scatters from stop to stop; a stop counts as one observation of the robot"
        )
    if fit.is_declared or all(station.whitening is None for station in fit.problem.stations):
        return None
    noise = joint_noise(fit)
    robot = fit.problem.chain.robot
    joints = np.zeros(robot.n_joints) if noise is None else noise.joints
    triples = zip(robot.joint_names, joints.tolist(), robot.joint_units, strict=True)
    sizes = ", ".join(
        f"{joint} {format_small(sigma, unit)}" for joint, sigma, unit in triples if sigma > 0.0
    )
    return (
        f"the residuals are consistent with joint noise ({sizes or 'negligible'} from row to row), "
        "and the final fit weights the readings of each row accordingly"
    )


@dataclass(frozen=True)
class _Readings:
    """Residuals of a station, shape (N, m), their levers, (N, m, n), in units of the noise, and
    blocks of readings, (m,).
    """

    residuals: np.ndarray
    levers: np.ndarray
    block: np.ndarray


def _readings(fit: ModelFit) -> Iterator[_Readings]:
    """Yield rows of each station that count, as many as the variances need."""
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
    """Return the variances of joints and blocks of maximum likelihood, shape (n + blocks,), and the
    gain by joints.
    """
    likelihood = _Likelihood(parts, parts[0].levers.shape[2], n_blocks)
    start = np.full(likelihood.n + n_blocks, np.log(NOISE.start))
    found = minimize(
        likelihood.misfit,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=[(np.log(NOISE.bounds[0]), np.log(NOISE.bounds[1]))] * len(start),
    )
    return np.exp(found.x), likelihood.without_joints - float(found.fun)


@dataclass(frozen=True, eq=False)
class _Likelihood:
    """Of the variances of joints and blocks: -2 log L, but for a constant.

    Attributes:
        parts: the readings.
        n: number of joints.
        n_blocks: number of blocks.
    """

    parts: Sequence[_Readings]
    n: int
    n_blocks: int

    @property
    def without_joints(self) -> float:
        """At its optimum if joints have no variance."""
        squares = np.zeros(self.n_blocks)
        counts = np.zeros(self.n_blocks)
        for part in self.parts:
            np.add.at(squares, part.block, np.sum(part.residuals**2, axis=0))
            np.add.at(counts, part.block, len(part.residuals))
        seen = counts > 0.0
        return float(np.sum(counts[seen] * (1.0 + np.log(squares[seen] / counts[seen]))))

    def misfit(self, logs: np.ndarray) -> tuple[float, np.ndarray]:
        """Return it and its slope, shape (n + blocks,), at the logs of the variances."""
        n = self.n
        variances = np.exp(logs)
        total = 0.0
        slope = np.zeros(len(logs))
        for part in self.parts:
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


def name_lines(state: SearchState, search: Search) -> SearchState:
    """Join waves that the span of their joint can't resolve into one line, and give it the name
    that its order suggests.
    """
    for step in _lines(state.steps):
        state = _joined(state, step)
    for wave in sorted((step.effect for step in _lines(state.steps)), key=_order):
        found = next((step for step in state.steps if step.effect is wave), None)
        state = state if found is None else _as_suggested(state, found, search)
    return state


def line_details(trail: History, step: SearchStep) -> dict[str, Any]:
    """Return the further fields of :class:`FoundEffect` of a line; empty for other effects."""
    if not isinstance(step.effect, Harmonic):
        return {}
    width = _resolution(trail.final, step.effect)
    orders = [_order(effect) for effect in step.effects]
    wheels = {_order(e): "given by the user" for e in trail.extra if isinstance(e, Harmonic)}
    for other in _lines(trail.steps):
        if (
            other is not step
            and isinstance(other.effect, Harmonic)
            and other.effect.band is not None
        ):
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
    """Return the state in which a wave is part of an earlier line, if the span can't
    resolve them.
    """
    near = WAVES.line * _resolution(state.fit, step.effect)
    earlier = _lines(state.steps[: state.steps.index(step)])
    line = next(
        (s for s in earlier if all(is_near(step.effect, part, near) for part in s.effects)), None
    )
    if line is None:
        return state
    parts = (*line.effects, *step.effects)
    log.info("%s and %s are one line", listed(step.effects), listed(line.effects[:1]))
    others = tuple(
        other for other in line.equivalent if not any(is_near(other, part, near) for part in parts)
    )
    return state.with_replaced(line, replace(line, effects=parts, equivalent=others)).without_step(
        step
    )


def _as_suggested(state: SearchState, step: SearchStep, search: Search) -> SearchState:
    """Return the state with a line, and others that its cause contains, replaced by the cause that
    its order suggests.

    The cause has to explain the data as well at its exact order.
    """
    wave, *others = step.effects
    width = _resolution(state.fit, wave)
    assert isinstance(wave, Harmonic)
    cause = wave.suggested(width)
    if others or cause == wave:
        return state
    on_joint = [s.effects for s in _lines(state.steps) if s.effect.locus.joint == wave.locus.joint]
    inside = [
        part
        for part in on_joint
        if all(min(abs(_order(e) - k) for k in cause.orders) < width for e in part)
    ]
    rest = reduce(without, chain.from_iterable(inside), state.fit)
    until = search.until(told_by(rest))
    after = refit(rest, [*rest.options.effects, cause], start={}, until=until)
    if deviance(after) > deviance(state.fit) + search.policy.tie:
        return state
    log.info("%s is %s, judging by its order", listed([wave]), listed([cause]))
    rivals = each_heading_once(
        [wave, *(e for e in step.equivalent if not is_near(e, cause, width))], cause, search.policy
    )
    state = state.tuned(step, replace(step, effects=(cause,), equivalent=rivals, after=after))
    if removed := [part for part in inside if part[0] is not wave]:
        steps = tuple(s for s in state.steps if s.effects not in removed)
        state = state.changed(after, steps, (), tuple(chain.from_iterable(removed)))
    return state


def widened(
    trail: History, last: ModelFit | None = None, *, untold: float | None = None
) -> ModelFit:
    r"""Return the last fit of a discovery with a covariance that includes the uncertainty of its
    model.

    A fit's covariance holds if its effects are complete. A discovery selects them, and three errors
    remain that affect other poses, too: masses and centres of mass are a few per cent off, which
    the score tests allow for and the model does not; some of the rejected candidates may be
    present; and each bearing has its own directions and place, which enter only where the data
    require them. What each adds to the variance of a prediction follows, on average over the rows,
    from the projected products of the score tests,

    .. math:: e_m = m^T S' m + \operatorname{tr} S' C, \qquad
        C = (S' + D^{-2})^{-1}, \quad m = C b' ,

    for masses known to D, in units of the noise and summed over the readings, and the mean over
    candidates,
    :math:`e_c = \sum_g w_g T_g`, with weights from the information criterion,
      :math:`w_g \propto \exp(-\mathrm{EBIC}_g/2)`,
    1 for no candidate (Bayesian model averaging: Hoeting et al. 1999, Stat. Sci. 14, 382-417); for
    bearings the same of each direction and place separately, :math:`e_b`. The fit's own parameters
    add their effective number p. So the covariance is that of noise with a variance
    :math:`1 + (e_m + e_c + e_b) / p` times as large. ``last`` is the fit with what has no name as
    well; default: that in which the search ended; ``untold`` is :func:`untold_of`, where known.
    """
    fit = trail.final if last is None else last
    noise = float(np.mean((fit.solution.estimated / fit.solution.sigma) ** 2))
    beyond = noise * (untold_of(trail) if untold is None else untold)
    return with_blocks(fit, 1.0 + beyond / max(fit.solution.effective, 1.0))


def untold_of(trail: History) -> float:
    """Return what errors of the model add to the variance of the rows, see :func:`widened`, summed
    over readings, in units of the residual noise.
    """
    named = trail.final
    few, _ = sampled(named, trail.policy)
    rows = len(named.problem) / max(len(few.problem), 1)
    features = score_test_given_nuisances(few, missing_features(few))
    beyond = of_masses(few, features) + of_candidates(trail.last) + of_bearings(features)
    return beyond * rows


def of_masses(fit: ModelFit, tests: ScoreTests) -> float:
    """Return what errors of masses add to the variance of the rows, summed over readings, in units
    of the noise.

    The tests are of missing bearing features, with the masses as the only nuisance.
    """
    masses = MassError.of(*fit.arm)
    if masses is None:
        return 0.0
    place = {name: i for i, name in enumerate(tests.names)}
    parameters = masses.parameters(fit.problem.chain)
    at = [place[p.name] for p in parameters]
    sizes = np.array([p.size for p in parameters])
    # Posterior of the masses, with the fit's parameters marginalised.
    half = tests.model.factor.half(np.eye(tests.n_model)[:, at] / sizes)
    C = half.T @ half
    most_probable = half.T @ tests.model.slope
    S = np.linalg.inv(C) - np.eye(len(C))
    return float(most_probable @ S @ most_probable + np.sum(S * C))


def of_bearings(tests: ScoreTests) -> float:
    """Return the same for directions and places of bearings that the data did not require, each
    separately.
    """
    return float(sum(of_candidates(tests, [i]) for i in range(len(tests.effects))))


def of_candidates(tests: ScoreTests, which: Sequence[int] | None = None) -> float:
    """Return the same for rejected candidates, of which at most one is present, weighted by its
    probability.
    """
    which = range(len(tests.effects)) if which is None else which
    groups = len({tests.effects[i].identity for i in which})
    scores = [tests.score([i], groups) for i in which]
    gains = np.array([score.gain for score in scores])
    costs = np.array([score.ebic for score in scores])
    # Odds against no candidate, which costs nothing.
    best = min(float(costs.min(initial=0.0)), 0.0)
    odds = np.exp(-0.5 * (costs - best))
    return float(odds @ gains / (odds.sum() + np.exp(0.5 * best)))


def fit_all_rows(state: SearchState, search: Search) -> SearchState:
    """Fit all rows of the first fit, with every curve found as fine and as smooth as they
    determine.

    Last, rows are weighted by the remaining noise, perhaps of the joints; the smoothness of curves
    is determined before, as their unmodelled part looks like such noise.
    """
    fit = state.fit
    first = search.first
    is_thinned = len(fit.problem) < len(first.problem)
    noise = joint_noise(fit)
    if is_thinned:
        whole = over_rows_of(fit, first)
        situation = situation_of(whole)
        wider: dict[Effect, Effect] = {
            e: e.resized(situation, e.resolution) for e in _curves_of(state)
        }
        fit = refit(whole, _exchanged(fit.options.effects, wider), until=Tolerance.ROUGH)
        state = _with_others(state, wider, fit)
    curves = _curves_of(state)
    is_shared = any(map(shares_stops, fit.problem.stations))
    if not curves and not is_thinned and noise is None and not is_shared:
        if not state.changes:
            return state
        return state.fitted_again(refit(fit, fit.options.effects, start={}))
    chosen: dict[Curve, tuple[Curve, np.ndarray]] = {}
    if curves and fit.solution.exit is not Ending.EXACT:
        chosen, fit = smoothed(fit, curves, search.policy.finer)
    for curve, (finer, _) in chosen.items():
        log.info("%s: %d pieces, smooth %d", curve.locus.joint, curve.resolution, finer.resolution)
    by: dict[Effect, Effect] = {curve: finer for curve, (finer, _) in chosen.items()}
    start: dict[Effect, np.ndarray] = dict(chosen.values())
    effects = _exchanged(fit.options.effects, by)
    fit = with_arrivals(fit) if noise is None else weighed(fit, noise)
    until = search.until(told_by(fit))
    state = _with_others(state, by, refit(fit, effects, start=start, until=until))
    return state.changed(state.fit, state.steps, (), ())


def _curves_of(state: SearchState) -> list[Curve]:
    """Return the curves that were found; curves given by the user are kept."""
    return [effect for step in state.steps for effect in step.effects if isinstance(effect, Curve)]


def _exchanged(effects: Iterable[Effect], by: Mapping[Effect, Effect]) -> tuple[Effect, ...]:
    return tuple(
        by.get(effect, effect) if isinstance(effect, Curve) else effect for effect in effects
    )


def _with_others(state: SearchState, by: Mapping[Effect, Effect], fit: ModelFit) -> SearchState:
    steps = tuple(replace(step, effects=_exchanged(step.effects, by)) for step in state.steps)
    return replace(state, fit=fit, steps=steps)
