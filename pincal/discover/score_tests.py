r"""Score tests of candidate effects on the Jacobian of a fitted model.

With A the whitened Jacobian by all parameters (those of the model, N, and those of every candidate, at zero), r the
whitened residuals, S = A A^T and b = A r, everything that criticism asks follows from S and b: with the model's tangent
space and its priors L projected out,

.. math:: S'_{gg} = S_{gg} - S_{gN} (S_{NN} + L)^{-1} S_{Ng}, \qquad T_g = b'^T_g S'^{-1}_{gg} b'_g ,

T_g is what adding effect g and refitting everything would take off the sum of squares (Rao's score test; chi-square with
k_g degrees of freedom if g is not there). One pass over the data serves all candidates.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve
from scipy.special import fdtrc

from pincal.discover.first_order import Doubt, FirstOrder
from pincal.discover.information import Information
from pincal.discover.tangent import Tangent
from pincal.identify.beliefs import priors_of
from pincal.identify.fit import Fit
from pincal.model.effect import Family
from pincal.model.effects import Effect

# By how much wider than in a fit the priors of geometry are where effects are tested: one that only they keep apart from
# geometry would be found wherever a machine leaves them. Sound arms with nearly parallel axes do: small errors of these are
# large ones of where their common normal stands.
WIDER = 10.0
VETO = 2.0
"""Standard errors that blocks of poses have to gain for one of them not to count against them: 1 in 40 by chance."""
# Blocks of which the extreme ones can be told.
_FEWEST_BLOCKS = 6


@dataclass(frozen=True)
class Score:
    """The test of one candidate.

    Attributes:
        gain: T, what it takes off the sum of squares (in units of the noise that the model leaves).
        rank: k, directions of it that the data see.
        p_value: of the F test, the places or frequencies paid for among which the candidate was chosen.
        ebic: change of the extended Bayesian information criterion (Chen and Chen 2008); negative is better.
    """

    gain: float
    rank: int
    p_value: float
    ebic: float


@dataclass(frozen=True, eq=False)
class ScoreTests(FirstOrder):
    """Score tests of all candidates: how likely chance explains one, and what it costs to believe it."""

    @property
    def dof(self) -> float:
        """Degrees of freedom that the model leaves."""
        return max(self.readings - self.spent, 1.0)

    def score(self, which: Sequence[int], groups: int) -> Score:
        """Return the test of some candidates taken as one, of so many groups that are tested."""
        looks = math.prod(self.effects[i].looks for i in which)
        return self._judged(*self.gain(which), groups, looks)

    def score_given(self, which: Sequence[int], given: Sequence[int], groups: int = 1) -> Score:
        """Return the test of what some candidates still explain once others are in the model."""
        both, rank_both = self.gain(sorted({*which, *given}))
        alone, rank_alone = self.gain(given)
        return self._judged(both - alone, max(rank_both - rank_alone, 0), groups, beside=(alone, rank_alone))

    def p_value_of_any(self, which: Sequence[int]) -> float:
        """Return the p-value of some candidates, of all as one or of one of them alone, its choice paid for.

        One joint's drive that gives way is lost among as many parameters as all drives and bearings have.
        """
        alone = (len(which) * self.score([i], 1).p_value for i in which)
        return min(self.score(which, 1).p_value, *alone)

    def _judged(
        self, gain: float, rank: int, groups: int, looks: float = 1.0, beside: tuple[float, int] = (0.0, 0)
    ) -> Score:
        if rank == 0:
            return Score(0.0, 0, 1.0, np.inf)
        squares, dof = max(self.squares - beside[0], 1e-6 * self.squares), self.dof - beside[1]
        gain = min(gain, 0.999999 * squares)
        left, rest = squares - gain, max(dof - rank, 1.0)
        p_value = min(looks * float(fdtrc(rank, rest, (gain / rank) / (left / rest))), 1.0)
        price = rank * np.log(self.readings) + 2.0 * np.log(max(groups, 1) * looks)
        ebic = self.readings * np.log(left / squares) + price
        return Score(gain, rank, p_value, float(ebic))

    def log_evidence(self, which: Sequence[int]) -> float:
        """Return the log of how much likelier the data are with some candidates, whatever their values, than without.

        Their priors decide what they may be: a wide one costs more, which no p-value knows (Bayes factor, first order). The
        places or frequencies among which they were chosen cost, too.
        """
        cost, tests = self.likeliest(which)
        j, S, b = tests.within(which)
        size = self.sizes[self.n_model + j]
        information = np.outer(size, size) * S + np.eye(len(j))
        step = np.linalg.solve(information, size * b)
        looks = sum(float(np.log(self.effects[i].looks)) for i in which)
        return float(0.5 * ((size * b) @ step - np.linalg.slogdet(information)[1] - cost)) - looks

    def costs_instead(self, which: Sequence[int], lost: Mapping[str, float]) -> list[float]:
        """Return the changes of the information criterion if each candidate took the place of some parameters of the model.

        Both are in the model first, priors included, and these parameters then lose what they are told to, to first order.
        """
        j = np.array([i for i, name in enumerate(self.names) if name in lost], int)
        scale, factor, _ = self.model.factor
        units = np.eye(self.n_model)[:, j]
        columns = scale[:, None] * cho_solve((factor, True), scale[:, None] * units, check_finite=False)
        values = np.array([lost[self.names[i]] for i in j]) + columns.T @ (self.model.b - self.model.pull)
        spared = float(np.sum(np.clip(1.0 - np.diag(columns[j]) * self.precision[j], 0.0, 1.0)))
        costs = []
        for c, S, b in (self.within([i]) for i in which):
            inverse = np.linalg.inv(S + np.diag(self.precision[self.n_model + c]))
            cross = columns.T @ self.products.cross[:, c]
            left = values - cross @ inverse @ b
            loss = left @ np.linalg.solve(columns[j] + cross @ inverse @ cross.T, left) - b @ inverse @ b
            costs.append(float(loss + (len(c) - spared) * np.log(self.readings)))
        return costs


def standard_errors(gains: np.ndarray) -> float:
    """Return the sum of what blocks of poses left out gain, in its standard errors as the blocks differ.

    More than one is what it takes, here and everywhere in a discovery, to call a prediction better. One block alone, such as
    a region that the others don't reach, can't veto what they agree in: if they do by ``VETO`` standard errors, the blocks
    that gain least and most count as those next to them (Winsor's mean).
    """
    if len(gains) < 2:
        return 0.0
    every, inner = _in_errors(gains), np.clip(gains, *np.sort(gains)[[1, -2]])
    return max(every, _in_errors(inner)) if len(gains) >= _FEWEST_BLOCKS and _in_errors(inner) > VETO else every


def _in_errors(gains: np.ndarray) -> float:
    return float(gains.sum() / max(gains.std(ddof=1) * np.sqrt(len(gains)), 1e-300))


def enough_errors(effect: Effect) -> float:
    """Return how many standard errors blocks left out have to gain by an effect.

    One; two by an effect that is the best of many that were looked at on all blocks, such as waves of all orders: to be the
    best it took chance for help, in the blocks left out as well. Of the ripples that chance does not explain on a real UR10
    that one comes up in both series, at 2.4 and 2.2; the others reach 1.7 at most.
    """
    return 2.0 if effect.looks > 1.0 else 1.0


def score_test(
    fit: Fit,
    candidates: Sequence[Effect],
    nuisance: Sequence[Effect] = (),
    groups: np.ndarray | None = None,
    *,
    wider: float = WIDER,
    doubtful: Sequence[Effect] = (),
    beliefs: Sequence[tuple[float, float]] = (),
) -> ScoreTests:
    """Test candidates against a fit.

    Args:
        fit: the fitted model.
        candidates: effects to test, none of them in the model.
        nuisance: effects that are projected out but not tested.
        groups: shape (N,), the block of each training row, for cross-validation; default: one block.
        wider: by how much wider than in the fit the priors of geometry are.
        doubtful: those of the nuisance effects of whose parameters the sizes are in doubt.
        beliefs: what these sizes may have to be multiplied by, and the cost of believing that, as an
            information criterion; default: they are what they are.
    """
    tangent = Tangent.at(fit, nuisance, groups)
    return tests_beside(tangent, candidates, wider=wider, doubtful=doubtful, beliefs=beliefs)


def tests_beside(
    tangent: Tangent,
    candidates: Sequence[Effect],
    *,
    wider: float = WIDER,
    doubtful: Sequence[Effect] = (),
    beliefs: Sequence[tuple[float, float]] = (),
) -> ScoreTests:
    """Test candidates against a fit, given the columns of the model; see :func:`score_test`."""
    fit, found = tangent.fit, tangent.beside(candidates)
    problem, model, known = found.problem, found.model, found.known
    # Of nuisance parameters the sizes are priors as they are, whatever they move.
    sizes, values = np.array([parameter.size for parameter in problem.parameters]), np.zeros(len(problem.parameters))
    sizes[known], values[known] = fit.priors.sizes, fit.values
    for effect in fit.problem.effects:
        sizes[problem.places_at(effect)] *= wider if effect.family is Family.GEOMETRY else 1.0
    alone = fit.problem.with_effects(candidates)
    own = priors_of(alone, fit.options).sizes
    for effect in candidates:
        sizes[problem.places_at(effect)] = own[alone.places_at(effect)]
    if wider not in tangent.information:
        beyond, slope = problem.beyond_priors(model, values, sizes)
        beyond.flat[:: len(beyond) + 1] += sizes[model] ** -2.0
        pull = values[model] * sizes[model] ** -2.0 - slope
        tangent.information[wider] = Information(tangent.S, tangent.b, beyond, pull)
    unsure = [place for effect in doubtful for place in problem.places_at(effect)]
    doubt = Doubt(np.isin(model, unsure), *zip(*beliefs, strict=True)) if unsure else None
    counts = problem.counted_rows(fit.solution.weights)[problem.station_of_block]
    return ScoreTests(
        effects=tuple(candidates),
        names=tuple(problem.parameters[i].name for i in model),
        values=values[model],
        sizes=sizes[np.concatenate([model, found.tested])],
        model=tangent.information[wider],
        products=found.products,
        squares=tangent.squares,
        readings=int(counts @ problem.block_sizes),
        spent=fit.solution.effective,
        doubt=doubt,
    )
