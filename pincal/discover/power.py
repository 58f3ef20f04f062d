"""How large an effect has to be to be found, and which measurement would tell two effects apart: predicted, not guessed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import fdtri, ncfdtr

from pincal.discover.candidate_tests import sampled
from pincal.discover.information import scaled_factor
from pincal.discover.nuisance import score_test_beside_nuisances, situation_of
from pincal.discover.policy import ALPHA, POLICY
from pincal.discover.score_tests import ScoreTests, score_test
from pincal.identify.fit import Fit
from pincal.identify.problem import Problem
from pincal.model.conditions import Conditions
from pincal.model.effect import Curve, Effect, Reducible
from pincal.model.latest import Latest
from pincal.model.model import Model
from pincal.model.sizes import largest_basis
from pincal.robot.robot import Robot

# Chance with which an effect of the size that is called detectable is found (test_discovery_report.py counts it).
POWER = 0.9
# Below this many degrees of freedom nothing is left to judge an effect by: the noise is known to 22 % then.
FEWEST = 10.0
# Why an effect of rank zero can't be tested.
ABSORBED = "the fitted model absorbs all of it in these poses (rank zero)"
# Non-centrality beyond which a test is given up: the readings are too few for it.
_HOPELESS = 1e7
# Random shapes of an effect of several parameters over which its power is averaged: to 1.5 % at a power of 0.9.
_SHAPES = 400
# Non-centrality above which two effects count as told apart: 5.5 standard deviations of one parameter.
TOLD_APART = 30.0
# A design has to do better than the same poses once more, by this factor.
_TELLING = 1.5
# Change of temperature that another run could make [K].
_WARMER = 10.0
# Moves by which another run could come to its poses [rad, m]: a turn of the hand, and one as short as a programme has.
_MOVES = (-1.5, -0.1, 0.1, 1.5)
# The runs that could be made instead of the latest poses, by what they are.
_DESIGNS = Latest[dict[str, Conditions]](16)


@dataclass(frozen=True)
class Detectable:
    """The smallest size of an effect that would be found.

    Attributes:
        effect: what.
        measure: what the size is the size of: the name of the effect's one parameter, "amplitude" (the length of the
            vector of its parameters), "rms of the curve" or, of compliances, "largest rotation in these poses".
        unit: the unit of the sizes.
        size: at which it is found with the chance ``POWER``, all directions of its parameters alike; None where no size
            would show.
        best: the same in the direction that shows best.
        absorbed: part of the squared signal that a refitted model takes up (the mean over the directions).
        reason: why no size would show; empty otherwise.
    """

    effect: Effect
    measure: str = ""
    unit: str = ""
    size: float | None = None
    best: float | None = None
    absorbed: float | None = None
    reason: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain data, the effect by name, joint, source, order and frame."""
        at = self.effect.locus
        which = zip(("effect", "joint", "source", "order", "frame"), (*self.effect.heading, at.order, at.frame), strict=True)
        return dict(which) | {key: value for key, value in vars(self).items() if key != "effect"}


def minimum_detectable(
    fit: Fit, effects: Sequence[Effect], *, sigma: np.ndarray | None = None, alpha: float = ALPHA
) -> list[Detectable]:
    """Return, for each effect, how large it would have to be to be found with these poses and this noise.

    An effect of parameters beta leaves the non-centrality beta^T S' beta once everything else, uncertain masses included,
    is refitted. It is found if its gain passes what the loop asks: the F test at ``alpha`` over the number of groups
    tested, and the share of the squares. The power follows from the non-central F distribution.

    Args:
        fit: the model that every effect would be added to.
        effects: which.
        sigma: shape (blocks,), standard deviation of one component of each block of readings; that of the residuals
            unless given.
        alpha: chance of a false name.
    """
    situation = situation_of(fit)
    tested = [effect.reduced(situation) if isinstance(effect, Reducible) else effect for effect in effects]
    noise = fit.solution.estimated if sigma is None else sigma
    quiet = replace(fit, solution=replace(fit.solution, estimated=noise))
    found = score_test_beside_nuisances(quiet, tested)
    if found.dof < FEWEST:
        return [Detectable(effect, reason=_too_few(found)) for effect in effects]
    groups = len({effect.identity for effect in effects})
    return [row for i in range(len(tested)) for row in _sizes(fit, found, i, alpha, groups)]


def _too_few(found: ScoreTests) -> str:
    return f"{found.readings} readings leave {found.dof:.0f} degrees of freedom to judge by; measure more poses"


def _sizes(fit: Fit, found: ScoreTests, i: int, alpha: float, groups: int) -> Iterator[Detectable]:
    """Yield the detectable size of an effect, one a unit of its parameters."""
    effect = found.effects[i]
    parameters = effect.parameters(fit.problem.chain)
    rank = found.gain([i])[1]
    test = (round(found.dof, 3), rank, round(groups * effect.looks), alpha)
    for unit in dict.fromkeys(p.unit for p in parameters):
        own = np.array([k for k, p in enumerate(parameters) if p.unit == unit])
        measure, shown, scale = _measure(effect, fit, own, unit)
        if rank == 0:
            yield Detectable(effect, measure, shown, absorbed=1.0, reason=ABSORBED)
            continue
        if not np.isfinite(detectable_noncentrality(test)):
            yield Detectable(effect, measure, shown, reason=_too_few(found))
            continue
        whole = found.products.inner_of([i])[np.ix_(own, own)]
        signal = scale.T @ found.within([i])[1][np.ix_(own, own)] @ scale
        size, best = _size_at(np.maximum(np.linalg.eigvalsh(signal), 0.0), test)
        absorbed = float(np.clip(1.0 - np.trace(signal) / np.trace(scale.T @ whole @ scale), 0.0, 1.0))
        yield Detectable(effect, measure, shown, size, best, absorbed)


def _measure(effect: Effect, fit: Fit, own: np.ndarray, unit: str) -> tuple[str, str, np.ndarray]:
    """Return what the size of some parameters means, its unit, and the parameters of vectors of size 1, shape (p, k)."""
    if isinstance(effect, Curve):
        return "rms of the curve", unit, _unit_curves(effect, fit)
    if "N m" in unit:
        # Micro-radians say more than compliances.
        largest, felt = largest_basis(Model(fit.problem.chain, (effect,)), fit.problem.conditions)
        return "largest rotation in these poses", "rad", np.diag(1.0 / largest[own])[:, felt[own]]
    one = len(own) == 1
    return effect.parameters(fit.problem.chain)[own[0]].name if one else "amplitude", unit, np.eye(len(own))


def _unit_curves(effect: Curve, fit: Fit) -> np.ndarray:
    """Return coefficients, shape (size, k), of orthogonal curves whose rms about their mean over the poses is 1."""
    terms = effect.terms(fit.problem.chain, fit.problem.conditions, None)
    basis = np.stack([term.basis for term in terms if term.basis is not None])
    basis = basis - basis.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(basis @ basis.T / basis.shape[1])
    seen = values > 1e-6 * values[-1]
    return np.asarray(vectors[:, seen] / np.sqrt(values[seen]))


Test = tuple[float, int, int, float]  # degrees of freedom that the model leaves, rank, groups tested, alpha


def _size_at(strengths: np.ndarray, test: Test) -> tuple[float, float]:
    """Return the size that is found with the chance POWER in a random direction, and in the best one.

    Args:
        strengths: shape (k,), non-centrality of an effect of size 1 along the principal directions.
        test: what the loop asks.
    """
    from scipy.optimize import brentq

    best = float(np.sqrt(detectable_noncentrality(test) / strengths.max()))
    if len(strengths) == 1:
        return best, best
    z = np.random.default_rng(0).standard_normal((_SHAPES, len(strengths)))
    along = (z**2 / np.sum(z**2, axis=1, keepdims=True)) @ strengths
    grid, powers = _power_curve(test)
    missing = lambda log_size: float(np.mean(np.interp(np.exp(2.0 * log_size) * along, grid, powers))) - POWER  # noqa: E731
    return float(np.exp(brentq(missing, np.log(0.1 * best), np.log(1e6 * best)))), best


def critical_gain(test: Test) -> float:
    """Return what an effect has to take off the sum of squares to be let in, in units of the noise."""
    dof, rank, groups, alpha = test
    rest = max(dof - rank, 1.0)
    ratio = rank * float(fdtri(rank, rest, 1.0 - alpha / max(groups, 1))) / rest
    return max(ratio / (1.0 + ratio) * dof, POLICY.least_gain(dof, declared=True))


def power_of(noncentrality: float, test: Test) -> float:
    """Return the chance that an effect of a non-centrality passes the loop's test."""
    dof, rank, *_ = test
    gain, rest = critical_gain(test), max(dof - rank, 1.0)
    F = (gain / rank) / (max(dof - gain, 1e-9) / rest)
    return 1.0 - float(ncfdtr(rank, rest, noncentrality, F))


@lru_cache(maxsize=256)
def detectable_noncentrality(test: Test) -> float:
    """Return the non-centrality at which the chance to be found is POWER; inf where no effect passes the test."""
    from scipy.optimize import brentq

    upper = 10.0 * critical_gain(test) + 100.0
    while power_of(upper, test) < POWER:
        upper *= 4.0
        if upper > _HOPELESS:
            return np.inf
    return float(brentq(lambda value: power_of(value, test) - POWER, 1e-3, upper))


@lru_cache(maxsize=256)
def _power_curve(test: Test) -> tuple[np.ndarray, np.ndarray]:
    """Return non-centralities and the chances that belong to them."""
    grid = np.linspace(0.0, 3.0 * detectable_noncentrality(test), 60)
    return grid, np.array([power_of(value, test) for value in np.maximum(grid, 1e-9)])


def deciding_measurement(fit: Fit, effect: Effect, value: np.ndarray, *rivals: Effect) -> str:
    """Return, in words, the cheapest further measurement that would tell an effect from a rival, or several together.

    For each kind of further run the power to tell them apart is computed from the Jacobian at its poses.

    Args:
        fit: the fit before the effect was added.
        effect: the effect.
        value: its parameters, shape (K,).
        rivals: the other one, or those that together do as much.
    """
    few, _ = sampled(fit, POLICY)
    stations, rows_each = few.problem.stations, len(fit.problem) / len(few.problem)

    def tests_at(poses: Iterable[Conditions]) -> ScoreTests:
        problem = Problem(tuple(replace(at, conditions=c) for at, c in zip(stations, poses, strict=True)))
        return score_test(replace(few, problem=problem), [effect, *rivals])

    here = tests_at(station.conditions for station in stations)
    designs = [_designs(few.problem.chain.robot, station.conditions) for station in stations]
    for words in (words for words in designs[0] if all(words in others for others in designs)):
        try:
            there = tests_at(design[words] for design in designs)
        except (ValueError, KeyError):
            continue
        told = _separation([here, there], rows_each, value)
        if told > TOLD_APART and told > _TELLING * _separation([here, here], rows_each, value):
            return words
    many = TOLD_APART / max(_separation([here], rows_each, value), 1e-9)
    if many < 50:
        return f"about {int(np.ceil(many)) * len(fit.problem)} poses of this kind"
    return "no further run of this kind tells them apart; look at the joint itself, or at its drive's own encoder"


def _separation(runs: Sequence[ScoreTests], weight: float, value: np.ndarray) -> float:
    """Return the signal of the first effect that the others can't take over, squared, in units of the noise.

    Args:
        runs: the tests of all at the poses of each run.
        weight: of each row.
        value: the parameters of the first.
    """
    (c, *others), products = runs[0].columns, [run.products for run in runs]
    g = np.concatenate(others)
    whole, cross, inner = (
        np.asarray(weight * sum(of))
        for of in ((run.model.S for run in runs), (of.cross for of in products), (of.inner for of in products))
    )
    whole += runs[0].model.known
    scale, L = scaled_factor(whole)
    taken = solve_triangular(L, scale[:, None] * cross, lower=True, check_finite=False)
    S = inner - taken.T @ taken
    G = S[np.ix_(g, g)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(G), 1e-300))
    taken = scale[:, None] * np.linalg.pinv(G * np.outer(scale, scale), rcond=1e-6, hermitian=True) * scale
    left = S[np.ix_(c, c)] - S[np.ix_(c, g)] @ taken @ S[np.ix_(g, c)]
    return float(max(value @ left @ value, 0.0))


def _designs(robot: Robot, c: Conditions) -> dict[str, Conditions]:
    """Return further runs that a user could make instead of these poses, cheapest first; the same objects if asked again."""
    known = _DESIGNS.of(robot, c)
    if "runs" not in known:
        known["runs"] = dict(_runs(robot, c))
    return known["runs"]


def _runs(robot: Robot, c: Conditions) -> Iterator[tuple[str, Conditions]]:
    rng = np.random.default_rng(0)
    if c.sighted is not None:
        # A quarter of the way around the poses, its axes as they are; that its place is found anew costs six readings.
        x, y, _ = c.sighted.mean(axis=0)
        yield (
            "the same poses with the instrument on another side of the robot, as a second station",
            replace(c, sighted=c.sighted - [x + y, y - x, 0.0]),
        )
    load = 0.1 * float(robot.masses.sum()) if not np.any(c.payload) else 2.0 * float(c.payload.max())
    if np.ptp(c.payload) == 0.0:
        yield "the same poses with a second payload", replace(c, payload=np.full(len(c), load))
    if c.approach is None or not np.ptp(c.approach):
        yield (
            "the same poses approached from both directions, with the columns approach_<joint>",
            replace(c, approach=rng.choice([-1.0, 1.0], c.q.shape)),
        )
    if c.move is not None:
        moves = np.random.default_rng(1).choice(_MOVES, c.q.shape)
        yield (
            "the same poses, each reached by long and by short moves from both sides",
            replace(c, move=moves, approach=np.sign(moves)),
        )
    temperature = np.full(len(c), 20.0) if c.temperature is None else c.temperature
    if np.ptp(temperature) < _WARMER:
        yield "the same poses warm and cold, with the column temperature", replace(c, temperature=temperature + _WARMER)
    yield "poses over the whole range of the joints", replace(c, q=robot.random_configurations(len(c), rng), sighted=None)
