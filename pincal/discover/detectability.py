"""What a search could find in tables: the smallest detectable size of each effect."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.special import ncfdtr

from pincal.discover.decisions import critical_gain
from pincal.discover.detectability_numbers import SIGHT
from pincal.discover.first_order import ScoreTests
from pincal.discover.levers import situation_of
from pincal.discover.policy import POLICY
from pincal.discover.score_tests import score_test_given_nuisances
from pincal.identify.calibrate import refit
from pincal.identify.fit import ModelFit
from pincal.model.catalogue import candidates, untestable
from pincal.model.effect import Curve, Effect, Reducible
from pincal.model.effects import ELASTIC
from pincal.model.model import Model
from pincal.model.sizes import largest_basis

# Why an effect of rank zero can't be tested.
ABSORBED = "the fitted model absorbs all of it in these poses (rank zero)"
FTest = tuple[float, int, int]  # residual degrees of freedom, rank, groups tested


@dataclass(frozen=True)
class DetectabilityTable:
    """Effects that a discovery could find with these poses and this noise.

    Attributes:
        model: "elastic" or "geometric": the model fitted along with every effect.
        sigma_m: the underlying noise [m]; of an image, at the distance of its points; None of an
            IMU alone.
        source: "declared", "estimated" or "assumed".
        alpha: probability of any false name.
        power: probability of finding an effect of the detectable size.
        effects: each effect of the catalogue.
    """

    model: str
    sigma_m: float | None
    source: str
    alpha: float
    power: float
    effects: tuple[Detectable, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return vars(self) | {"effects": [found.to_dict() for found in self.effects]}


def detectable_effects(fit: ModelFit) -> DetectabilityTable:
    """Return the effects that can be found beyond the elastic model, of a fit of base and tool."""
    base = refit(fit, ELASTIC)
    can_estimate = base.solution.degrees >= SIGHT.fewest
    usual = (
        base.solution.estimated if can_estimate else [block.noise for block in base.problem.blocks]
    )
    sigma = np.array(
        [s if d is None else d for s, d in zip(usual, fit.noise.declared, strict=True)]
    )
    source = "declared" if fit.is_declared else "estimated" if can_estimate else "assumed"
    chain = base.problem.chain
    conditions = base.problem.conditions
    sights = minimum_detectable(base, candidates(chain, conditions), sigma=sigma)
    sights += [
        Detectable(effect, reason=reason) for effect, reason in untestable(chain, conditions)
    ]
    seen = (station for station in fit.stations if station[0].sensor.reads_place)
    in_metres = (
        float(sigma[of][0]) * s.metres_per_reading(fit.nominal.values[places])
        for s, places, of in seen
    )
    sigma_m = next(in_metres, None)
    return DetectabilityTable(
        model="elastic",
        sigma_m=sigma_m,
        source=source,
        alpha=POLICY.false_name,
        power=SIGHT.power,
        effects=tuple(sights),
    )


@dataclass(frozen=True)
class Detectable:
    """The smallest detectable size of an effect.

    Attributes:
        effect: the effect.
        measure: the measured quantity: the name of the effect's only parameter, "amplitude" (the
            norm of its parameters), "rms of the curve" or, of compliances, "largest rotation in
            these poses".
        unit: unit of the sizes.
        size: size that is found with probability ``SIGHT.power``, for random directions of its
            parameters; None if no size is detectable.
        best: the same in the most visible direction.
        absorbed: fraction of the squared signal that a refitted model absorbs (mean over the
            directions).
        reason: why no size is detectable; empty otherwise.
    """

    effect: Effect
    measure: str = ""
    unit: str = ""
    size: float | None = None
    best: float | None = None
    absorbed: float | None = None
    reason: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, the effect by name, joint, source, order and frame."""
        at = self.effect.locus
        which = zip(
            ("effect", "joint", "source", "order", "frame"),
            (*self.effect.heading, at.order, at.frame),
            strict=True,
        )
        return dict(which) | {key: value for key, value in vars(self).items() if key != "effect"}


def minimum_detectable(
    fit: ModelFit, effects: Sequence[Effect], *, sigma: np.ndarray | None = None
) -> list[Detectable]:
    """Return the smallest detectable size of each effect with these poses and this noise.

    An effect of parameters beta has the non-centrality beta^T S' beta with everything else
    refitted, uncertain masses included. It is found if its gain passes the tests of the search: the
    F test corrected for the number of groups, and the smallest relevant gain. The power follows
    from the non-central F distribution.

    Args:
        fit: the model to which every effect would be added.
        effects: the effects.
        sigma: shape (blocks,), standard deviation of one component of each block of readings;
            default: of the residuals.
    """
    situation = situation_of(fit)
    tested = [
        effect.reduced(situation) if isinstance(effect, Reducible) else effect for effect in effects
    ]
    noise = fit.solution.estimated if sigma is None else sigma
    quiet = replace(fit, solution=replace(fit.solution, estimated=noise))
    found = score_test_given_nuisances(quiet, tested)
    if found.dof < SIGHT.fewest:
        return [Detectable(effect, reason=_too_few(found)) for effect in effects]
    groups = len({effect.identity for effect in effects})
    return [row for i in range(len(tested)) for row in _sizes(fit, found, i, groups)]


def _too_few(found: ScoreTests) -> str:
    return (
        f"{found.readings} readings leave only {found.dof:.0f} degrees of freedom for the "
        "tests; measure more poses"
    )


def _sizes(fit: ModelFit, found: ScoreTests, i: int, groups: int) -> Iterator[Detectable]:
    """Yield the detectable size of an effect, one per unit of its parameters."""
    effect = found.effects[i]
    parameters = effect.parameters(fit.problem.chain)
    rank = found.gain([i])[1]
    test = (round(found.dof, 3), rank, round(groups * effect.trials))
    for unit in dict.fromkeys(p.unit for p in parameters):
        own = np.array([k for k, p in enumerate(parameters) if p.unit == unit])
        measure, shown, scale = _measure(effect, fit, own, unit)
        if rank == 0:
            yield Detectable(effect, measure, shown, absorbed=1.0, reason=ABSORBED)
            continue
        if not np.isfinite(detectable_noncentrality(test)):
            yield Detectable(effect, measure, shown, reason=_too_few(found))
            continue
        whole = found.inner_of([i])[np.ix_(own, own)]
        signal = scale.T @ found.within([i])[1][np.ix_(own, own)] @ scale
        size, best = _size_at(np.maximum(np.linalg.eigvalsh(signal), 0.0), test)
        absorbed = float(
            np.clip(1.0 - np.trace(signal) / np.trace(scale.T @ whole @ scale), 0.0, 1.0)
        )
        yield Detectable(effect, measure, shown, size, best, absorbed)


def _measure(
    effect: Effect, fit: ModelFit, own: np.ndarray, unit: str
) -> tuple[str, str, np.ndarray]:
    """Return the measure of the size of some parameters, its unit, and parameter vectors of size 1,
    shape (p, k).
    """
    if isinstance(effect, Curve):
        return "rms of the curve", unit, _unit_curves(effect, fit)
    if "N m" in unit:
        # A rotation is more intuitive than a compliance.
        largest, felt = largest_basis(Model(fit.problem.chain, (effect,)), fit.problem.conditions)
        return "largest rotation in these poses", "rad", np.diag(1.0 / largest[own])[:, felt[own]]
    one = len(own) == 1
    return (
        effect.parameters(fit.problem.chain)[own[0]].name if one else "amplitude",
        unit,
        np.eye(len(own)),
    )


def _unit_curves(effect: Curve, fit: ModelFit) -> np.ndarray:
    """Return coefficients, shape (size, k), of orthogonal curves whose rms about their mean over
    the poses is 1.
    """
    terms = effect.terms(fit.problem.chain, fit.problem.conditions, None)
    basis = np.stack([term.basis for term in terms if term.basis is not None])
    basis = basis - basis.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(basis @ basis.T / basis.shape[1])
    seen = values > 1e-6 * values[-1]
    return np.asarray(vectors[:, seen] / np.sqrt(values[seen]))


def _size_at(strengths: np.ndarray, test: FTest) -> tuple[float, float]:
    """Return the size that is found with probability SIGHT.power in a random direction, and in the
    best one.

    ``strengths``, shape (k,), are the non-centralities of an effect of size 1 along its principal
    directions.
    """
    from scipy.optimize import brentq

    best = float(np.sqrt(detectable_noncentrality(test) / strengths.max()))
    if len(strengths) == 1:
        return best, best
    z = np.random.default_rng(0).standard_normal((SIGHT.shapes, len(strengths)))
    along = (z**2 / np.sum(z**2, axis=1, keepdims=True)) @ strengths
    grid, powers = _power_curve(test)
    missing = lambda log_size: (  # noqa: E731
        float(np.mean(np.interp(np.exp(2.0 * log_size) * along, grid, powers))) - SIGHT.power
    )
    return float(np.exp(brentq(missing, np.log(0.1 * best), np.log(1e6 * best)))), best


def power_of(noncentrality: float, test: FTest) -> float:
    """Return the probability that an effect of a non-centrality is accepted."""
    dof, rank, *_ = test
    gain = critical_gain(*test, POLICY)
    rest = max(dof - rank, 1.0)
    F = (gain / rank) / (max(dof - gain, 1e-9) / rest)
    return 1.0 - float(ncfdtr(rank, rest, noncentrality, F))


@lru_cache(maxsize=256)
def detectable_noncentrality(test: FTest) -> float:
    """Return the non-centrality that is found with probability SIGHT.power; inf where no effect
    passes the test.
    """
    from scipy.optimize import brentq

    upper = 10.0 * critical_gain(*test, POLICY) + 100.0
    while power_of(upper, test) < SIGHT.power:
        upper *= 4.0
        if upper > SIGHT.hopeless:
            return np.inf
    return float(brentq(lambda value: power_of(value, test) - SIGHT.power, 1e-3, upper))


@lru_cache(maxsize=256)
def _power_curve(test: FTest) -> tuple[np.ndarray, np.ndarray]:
    """Return non-centralities and the power at each."""
    grid = np.linspace(0.0, 3.0 * detectable_noncentrality(test), 60)
    return grid, np.array([power_of(value, test) for value in np.maximum(grid, 1e-9)])
