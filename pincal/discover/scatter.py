r"""Scatter of one joint from pose to pose, and score tests for noise that is uneven because of it.

Residuals in excess of the noise along the lever of a joint are due either to its repeatability or
to an unknown function of the pose. Repeated poses distinguish these; so do poses that are close in
some joints, where a smooth function has nearly the same value and scatter has not.

Drives that all stop to some tens of micro-radians leave an excess along every lever, the longest
most. One joint is named only if it scatters more than the others: with L_v the levers of all joints
at visit v,

.. math:: V_v = \sigma^2 I + L_v^T \, \mathrm{diag}(s^2 + s_j^2) \, L_v

has to be far more likely with s_j of one joint than with s alone.

A score test assumes a single noise variance. Where a joint does not repeat, readings are noisier
along its lever than across it, and the test understates the p-values of effects on this joint. The
noise along an effect follows from the scores of single visits,
:math:`s_v = W^T \sum_{n \in v} X'_n{}^T r_n` (X' the effect's columns with the model's tangent
space projected out, whitened by W, r the residuals with the effect): with even noise their
components have a mean square of 1 in total. Divided by a mean square that is significantly larger,
the test is valid for any noise (Rao and Scott 1981, first order).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Literal

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import cKDTree
from scipy.special import chdtrc, chdtri, fdtrc

from pincal.discover.alike_scatter import AlikeScatter
from pincal.discover.discovery_file import ScatteringJoint
from pincal.discover.first_order import ScoreTests
from pincal.discover.noise_numbers import NOISE
from pincal.discover.score_numbers import TESTING
from pincal.identify.fit import ModelFit
from pincal.identify.fit_levers import levers
from pincal.identify.station import Station
from pincal.measure.poses import same_joints
from pincal.model.conditions import moves
from pincal.sensors.row_samples import evenly
from pincal.validate.misfit import MISFIT

_ROW_ORDER = "the order of the rows"


@dataclass(frozen=True)
class Excess:
    """Residuals in excess of the noise along the lever of one joint.

    Attributes:
        joint: the joint.
        sigma: standard deviation of its position that would explain it [rad or m].
        missing: the column that could explain it.
        shown_by: evidence that it is scatter: "replicates" or "neighbours"; "" without any.
        follows: the joints on whose positions it depends, or the order of the rows, according to
            neighbours; else empty.
        is_repeated: whether repeated poses reproduce it.
    """

    joint: str
    sigma: float
    missing: str
    shown_by: Literal["replicates", "neighbours", ""]
    follows: tuple[str, ...] = ()
    is_repeated: bool = False

    @property
    def scattering(self) -> ScatteringJoint | None:
        """The entry of the findings, if scatter is shown."""
        return (
            ScatteringJoint(self.joint, self.sigma, self.missing, self.shown_by)
            if self.shown_by
            else None
        )

    @property
    def statement(self) -> str:
        """The finding in words."""
        if self.shown_by == "replicates":
            return (
                f"{self.joint} does not return to the same position about its own axis, even "
                "when a pose is repeated"
            )
        if self.shown_by:
            return (
                f"{self.joint} does not return to the same position about its own axis, "
                "regardless of pose and recorded columns: neighbouring poses have unrelated errors"
            )
        if self.follows:
            is_few = len(self.follows) <= NOISE.most_joints
            of = " and ".join(self.follows) if is_few else "all joints"
            return (
                f"{self.joint} has an error about its own axis that follows {of}: "
                "neighbouring poses have correlated errors; it does not scatter, and more poses "
                "would resolve it"
            )
        if self.is_repeated:
            return (
                f"{self.joint} has an error about its own axis that is a function of the "
                "pose: repeated poses reproduce it; more poses would resolve it"
            )
        return (
            f"{self.joint} has an error about its own axis that is scatter or a function "
            "of the pose: no pose was repeated, and too few are neighbours to decide; measure ten "
            "poses three times each"
        )


def find_excess(fit: ModelFit, measured: ModelFit | None = None) -> Excess | None:
    """Return the joint with the largest excess along its lever, if significant, and whether it is
    scatter.

    Scatter that all joints have alike is none of one, nor is an excess that may be such scatter as
    too few poses are neighbours to tell. It is scatter if replicates differ by it, in
    ``measured`` if the rows of the fit are means of poses. Without replicates it is scatter if
    neighbours in the positions of some joints have unrelated errors although a smooth function of
    these joints would have been detected, in a permutation test.
    """
    found = [(one.scatter(), one) for _, alone, _ in fit.in_places for one in _along_levers(alone)]
    index = max(range(len(found)), key=lambda i: found[i][0].gain)
    if found[index][0].gain <= NOISE.scatter:
        return None
    excess = _excess_of(found, index, measured)
    if excess.follows or (excess.is_repeated and not excess.shown_by):
        # A function of the pose, which no scatter of all joints explains.
        return excess
    is_again = excess.shown_by == "replicates"
    # Where replicates show it, by the differences between them, which lack what follows the pose.
    shown_in = measured if is_again and measured is not None else fit
    more = _Arrivals.of(shown_in, between=is_again).beyond_others()
    joint = max(more, key=lambda name: more[name])
    if more[joint] <= (NOISE.scatter if excess.shown_by else NOISE.beyond_alike):
        return None
    return excess if excess.joint == joint else _excess_of(found, _largest(found, joint), measured)


def _largest(found: list[tuple[_Component, _AlongLever]], joint: str) -> int:
    """Return the index of the largest scatter of a joint at any station."""
    own = [i for i, (_, one) in enumerate(found) if one.joint == joint]
    return max(own, key=lambda i: found[i][0].gain)


def _excess_of(
    found: list[tuple[_Component, _AlongLever]], index: int, measured: ModelFit | None
) -> Excess:
    """Return the excess along one of the levers of all stations, and whether it is scatter."""
    whole, best = found[index]
    conditions = best.station.conditions
    missing = "time" if conditions.temperature is not None else "temperature"
    missing = missing if conditions.approach is not None else f"approach_{best.joint}"
    single = (
        best
        if measured is None
        else [one for _, alone, _ in measured.in_places for one in _along_levers(alone)][index]
    )
    again = single.differences()
    if again is not None and again.gain > chdtri(1, 2.0 * NOISE.chance):
        return Excess(best.joint, again.sigma, missing, "replicates")
    follows = best.follows(whole)
    is_repeated = again is not None
    shown_by: Literal["neighbours", ""] = "neighbours" if follows == () and not is_repeated else ""
    return Excess(best.joint, whole.sigma, missing, shown_by, follows or (), is_repeated)


def arrivals_within(fit: ModelFit) -> float | None:
    """Return to how much all drives alike would have to stop to explain residuals beyond the
    declared noise [rad].

    None if no noise is declared, if it explains the residuals, or if such scatter does not: one
    joint scatters more than others, a larger noise of the instrument is likelier, errors of
    neighbours are related, or something is left.
    """
    solution = fit.solution
    if not fit.is_declared or chdtrc(solution.degrees, solution.chi2) >= MISFIT:
        return None
    arrivals = _Arrivals.of(fit)
    alike, likelihood = arrivals.alike(sigma2=1.0)
    noisier = arrivals.likelihood(np.zeros(arrivals.n_joints))[0]
    if likelihood <= noisier or max(arrivals.beyond_others().values()) > NOISE.scatter:
        return None
    # The scatter that is likeliest makes as much of the squares as there are readings.
    left = arrivals.likelihood(alike * arrivals.turns, sigma2=1.0)[2]
    if chdtrc(arrivals.readings, left) < MISFIT:
        return None
    levers_of_all = (one for _, alone, _ in fit.in_places for one in _along_levers(alone))
    whole, best = max(
        ((one.scatter(), one) for one in levers_of_all), key=lambda pair: pair[0].gain
    )
    return float(np.sqrt(alike)) if best.follows(whole) == () else None


@dataclass(frozen=True)
class _Arrivals:
    """Sums over the readings of each of V visits, in units of the noise, from which the scatter of
    all n joints follows.

    Attributes:
        joints: names of the joints.
        turns: shape (n,), which of them are revolute: these may scatter alike.
        gram: shape (V, n, n), products of the levers.
        along: shape (V, n), products of levers and residuals.
        squares: sum of the squared residuals.
        readings: their number.
    """

    joints: tuple[str, ...]
    turns: np.ndarray
    gram: np.ndarray
    along: np.ndarray
    squares: float
    readings: int

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @classmethod
    def of(cls, fit: ModelFit, *, between: bool = False) -> _Arrivals:
        """Return the sums of a fit over visits, as many as the variances need, or over differences
        between replicates.
        """
        gram = list[np.ndarray]()
        along = list[np.ndarray]()
        squares = 0.0
        readings = 0
        for _, alone, blocks in fit.in_places:
            declared = alone.noise.declared[0]
            sigma = fit.solution.estimated[blocks.start] if declared is None else declared
            every = list(_along_levers(alone))
            sets = [(one.lever, one.residuals, one.visit) for one in every]
            if between:
                sets = [of for one in every if (of := one.contrasts()) is not None]
            if not sets:
                continue
            lever = np.stack([of[0] for of in sets]) / sigma
            residuals = sets[0][1] / sigma
            visit = sets[0][2]
            some = _sampled_visits(visit)
            kept = np.isin(visit, some)
            lever = lever[:, :, kept]
            residuals = residuals[:, kept]
            visit = visit[kept]
            gram.append(_summed(np.einsum("imr,jmr->rij", lever, lever), visit)[some])
            along.append(_summed(np.einsum("imr,mr->ri", lever, residuals), visit)[some])
            squares += float(np.sum(residuals**2))
            readings += residuals.size
        robot = fit.problem.chain.robot
        turns = np.array([kind != "prismatic" for kind in robot.joint_types])
        return cls(
            robot.joint_names, turns, np.concatenate(gram), np.concatenate(along), squares, readings
        )

    def likelihood(
        self, variances: np.ndarray, sigma2: float | None = None
    ) -> tuple[float, float, float]:
        """Return 2 log-likelihood, the noise's variance, and the squares weighted by all variances.

        Args:
            variances: shape (n,), of the joints, relative to the noise's.
            sigma2: of the noise; default: the likeliest.
        """
        root = np.sqrt(variances)
        inner = np.eye(self.n_joints) + root[:, None] * self.gram * root
        b = root * self.along
        explained = np.sum(b * np.linalg.solve(inner, b[:, :, None])[:, :, 0])
        left = max(self.squares - float(explained), 1e-300)
        variance = left / self.readings if sigma2 is None else sigma2
        volume = float(np.sum(np.linalg.slogdet(inner)[1]))
        return (
            -self.readings * float(np.log(variance)) - volume - left / variance,
            variance,
            left / variance,
        )

    def alike(self, sigma2: float | None = None) -> tuple[float, float]:
        """Return the variance that all revolute joints have in common, relative to the noise's, and
        2 log-likelihood.
        """
        likelihoods = self._alike.nothing.likelihood(slice(None), 0.0, sigma2)
        best = int(np.argmax(likelihoods))
        return float(self._ratios[best]), float(likelihoods[best])

    @cached_property
    def _alike(self) -> AlikeScatter:
        """The scatter that all revolute joints have in common, for the candidate variances."""
        return AlikeScatter.of(
            self.gram,
            self.along,
            self.turns,
            ratios=self._ratios,
            squares=self.squares,
            readings=self.readings,
        )

    @cached_property
    def _ratios(self) -> np.ndarray:
        """Candidate variances of a joint."""
        lever2 = (
            np.mean(np.einsum("vii->vi", self.gram)[:, self.turns]) if self.turns.any() else 1.0
        )
        return np.asarray(
            np.concatenate([[0.0], np.logspace(*NOISE.ratios)]) / max(float(lever2), 1e-300)
        )

    def beyond_others(self) -> dict[str, float]:
        """Return by how much 2 log-likelihood increases if one joint scatters more than all do
        alike, by its name.
        """
        ratios = self._ratios
        every = self._alike.nothing.likelihood(slice(None), 0.0)
        common = int(np.argmax(every))
        found = dict[str, float]()
        for j, name in enumerate(self.joints):
            beside = self._alike.beside(j)
            shared = common
            gain = 0.0
            for _ in range(NOISE.turns):
                more = float(ratios[np.argmax(beside.likelihood(shared, ratios))])
                likelihoods = beside.likelihood(slice(None), more)
                shared = int(np.argmax(likelihoods))
                gain = float(likelihoods[shared] - every[common])
            found[name] = gain
        return found


def _sampled_visits(visit: np.ndarray) -> np.ndarray:
    """Return the numbers of as many visits as the variances need, evenly spread."""
    return evenly(int(visit.max()) + 1, NOISE.visits)


def _summed(products: np.ndarray, visit: np.ndarray) -> np.ndarray:
    """Return the sums of products of rows, shape (n, ...), over each visit."""
    sums = np.zeros((int(visit.max()) + 1, *products.shape[1:]))
    np.add.at(sums, visit, products)
    return sums


@dataclass(frozen=True)
class _Component:
    """A variance component: its gain in 2 log-likelihood, its standard deviation [rad or m], and
    that of the noise.
    """

    gain: float
    sigma: float
    noise: float


@dataclass(frozen=True)
class _AlongLever:
    """Whitened readings of a station and their lever of a joint.

    Attributes:
        station: the station, with the rows that count.
        joint: the joint.
        lever: shape (size, N), of the first block of readings.
        residuals: shape (size, N).
        visit: shape (N,), the visit of each row.
    """

    station: Station
    joint: str
    lever: np.ndarray
    residuals: np.ndarray
    visit: np.ndarray

    def scatter(self) -> _Component:
        """Return the scatter of the joint, whether repeatability or a function of the pose."""
        return _scatter_along(self.lever, self.residuals, self.visit)

    def differences(self) -> _Component | None:
        """Return the scatter between replicates of a pose, None without replicates."""
        contrasts = self.contrasts()
        return None if contrasts is None else _scatter_along(*contrasts)

    def contrasts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return lever and residuals of differences of replicates, and their visits, as
        :func:`_scatter_along` takes them.

        None without replicates. They are n - 1 orthonormal contrasts (Helmert) of n replicates, in
        which the pose's mean cancels; contrasts of different targets in the same visits share the
        scatter.
        """
        conditions = self.station.conditions
        pose, thing = _things(self.station)
        load = np.round(conditions.payload, 3)
        sides = np.zeros((len(load), 0)) if conditions.approach is None else conditions.approach
        _, same = np.unique(np.column_stack([thing, load, sides]), axis=0, return_inverse=True)
        lever = list[np.ndarray]()
        residuals = list[np.ndarray]()
        visit = list[tuple[int, int]]()
        for rows in (
            np.flatnonzero(same.ravel() == k) for k in np.flatnonzero(np.bincount(same.ravel()) > 1)
        ):
            for k in range(1, len(rows)):
                residuals.append(
                    (self.residuals[:, rows[:k]].sum(axis=1) - k * self.residuals[:, rows[k]])
                    / np.sqrt(k * k + k)
                )
                lever.append(self.lever[:, rows].mean(axis=1))
                visit.append((pose[rows[0]], k))
        if not visit:
            return None
        shared = np.unique(visit, axis=0, return_inverse=True)[1].ravel()
        return np.transpose(lever), np.transpose(residuals), shared

    def follows(self, whole: _Component) -> tuple[str, ...] | None:
        """Return on what the errors depend according to neighbours; empty if unrelated, None if too
        few are near.
        """
        _, first = np.unique(self.visit, return_index=True)
        a2 = np.bincount(self.visit, np.sum(self.lever**2, axis=0))
        along = np.bincount(self.visit, np.sum(self.residuals * self.lever, axis=0))
        signal = whole.sigma**2 * a2
        errors = along / np.sqrt(np.maximum(a2, 1e-300) * (whole.noise**2 + signal))
        share = np.sqrt(signal / (whole.noise**2 + signal))
        some = evenly(len(first), NOISE.visits)
        q = self.station.conditions.q[first[some]]
        names = self.station.model.chain.robot.joint_names
        return related(dict(zip(names, q.T, strict=True)), errors[some], share[some])


def related(
    joints: dict[str, np.ndarray], errors: np.ndarray, share: np.ndarray
) -> tuple[str, ...] | None:
    """Return the joints, few or all, whose neighbours have related errors; empty if none, None if
    undecided.

    Args:
        joints: name -> shape (V,), positions.
        errors: shape (V,), of unit variance.
        share: shape (V,), root of the fraction of each error's variance that is not noise.
    """
    rng = np.random.default_rng(0)
    drawn = np.column_stack([errors, *(rng.permutation(errors) for _ in range(NOISE.draws))])
    does = dict(zip(joints, moves(np.column_stack(list(joints.values()))), strict=True))
    moving = {name: (q - q.min()) / np.ptp(q) for name, q in joints.items() if does[name]}
    sets = [names for n in range(1, NOISE.most_joints + 1) for names in combinations(moving, n)]
    if len(moving) > NOISE.most_joints:
        sets.append(tuple(moving))
    spaces = {names: np.column_stack([moving[name] for name in names]) for names in sets}
    spaces[(_ROW_ORDER,)] = np.arange(len(errors))[:, None] / len(errors)
    values = np.empty((len(spaces), NOISE.draws + 1))
    expected = np.empty(len(spaces))
    for k, places in enumerate(spaces.values()):
        pairs, expected[k] = _neighbours(places, share)
        values[k] = np.einsum("vd,vd->d", drawn, pairs @ drawn)
    mean = values[:, 1:].mean(axis=1)
    spread = values[:, 1:].std(axis=1)
    scores = (values - mean[:, None]) / spread[:, None]
    critical = float(np.quantile(scores[:, 1:].max(axis=0), 1.0 - NOISE.chance))
    # Related if at least half of the excess is smooth.
    is_related = (scores[:, 0] > critical) & (values[:, 0] - mean > 0.5 * expected)
    if is_related.any():
        # Irrelevant joints in the distance make neighbours fewer, not farther.
        enough = 0.5 * scores[is_related, 0].max()
        close = is_related & (scores[:, 0] > enough)
        return min(
            (len(names), -scores[k, 0], names) for k, names in enumerate(spaces) if close[k]
        )[2]
    few = np.array([len(names) <= NOISE.near_joints for names in spaces])
    return () if np.all(expected[few] > (critical + NOISE.beyond) * spread[few]) else None


def _neighbours(places: np.ndarray, share: np.ndarray) -> tuple[coo_array, float]:
    """Return the weights of the products of neighbours' errors, shape (V, V), and their sum for a
    smooth function.
    """
    n_near = min(NOISE.neighbours, len(places) - 1)
    distance, near = cKDTree(places).query(places, n_near + 1)
    row = np.repeat(np.arange(len(places)), n_near + 1)
    column = near.ravel()
    distance = distance.ravel()
    others = row != column
    row = row[others]
    column = column[others]
    distance = distance[others]
    weight = share[row] * share[column]
    pairs = coo_array((weight, (row, column)), shape=(len(places), len(places))).tocsr()
    return pairs, float(np.sum(weight**2 * np.exp(-0.5 * (distance / NOISE.smooth) ** 2)))


def _along_levers(fit: ModelFit) -> Iterator[_AlongLever]:
    """Yield the readings of the only station along the lever of each joint."""
    chain = fit.model.chain
    rows = fit.station.block_rows[0]
    sound = fit.solution.weights > 0.0
    weights = fit.station.weights[sound]
    visit = visits(fit.station)[sound]
    residuals = fit.station.residuals(fit.values)[rows, sound] * weights
    moved = levers(fit, tuple(map(int, chain.drives)))[:, rows, sound] * weights
    station = fit.station.select(np.flatnonzero(sound))
    visit = np.unique(visit, return_inverse=True)[1].ravel()
    for joint, lever in zip(chain.robot.joint_names, moved, strict=True):
        yield _AlongLever(station, joint, lever, residuals, visit)


def _things(station: Station) -> tuple[np.ndarray, np.ndarray]:
    """Return pose numbers of the rows, and numbers that are equal for replicates of a target or
    point, shape (N,) each.
    """
    pose = same_joints(station.conditions.q)
    point = station.sensor.groups
    read = np.column_stack(
        [pose, station.conditions.target, np.zeros(len(pose), int) if point is None else point]
    )
    return pose, np.unique(read, axis=0, return_inverse=True)[1].ravel()


def visits(station: Station) -> np.ndarray:
    """Return the visit of each row, shape (N,): rows of the same joint positions, except
    replicates.
    """
    pose, thing = _things(station)
    count = np.bincount(thing)
    order = np.argsort(thing, kind="stable")
    again = np.empty(len(pose), int)
    again[order] = np.arange(len(pose)) - np.repeat(np.cumsum(count) - count, count)
    return np.unique(np.column_stack([pose, again]), axis=0, return_inverse=True)[1].ravel()


def _scatter_along(lever: np.ndarray, residuals: np.ndarray, visit: np.ndarray) -> _Component:
    """Return the scatter along a lever, by maximum likelihood with the noise's variance profiled
    out.

    Along the lever, of length a_i at visit i, the variance is sigma^2 + s^2 a_i^2, and sigma^2
    across it. Readings of one visit, of several targets or the points of an image, share the
    joint's position. See :class:`_AlongLever`.
    """
    a2 = np.bincount(visit, np.sum(lever**2, axis=0))
    along2 = np.bincount(visit, np.sum(residuals * lever, axis=0)) ** 2 / np.maximum(a2, 1e-300)
    across2 = float(np.sum(residuals**2) - np.sum(along2))
    readings = residuals.size
    # In the first row without any scatter.
    ratios = np.concatenate([[0.0], np.logspace(*NOISE.ratios)])
    spread = 1.0 + np.outer(ratios, a2 / np.mean(a2))
    sigma2 = (across2 + np.sum(along2 / spread, axis=1)) / readings
    likelihood = -readings * np.log(sigma2) - np.sum(np.log(spread), axis=1)
    best = 1 + int(np.argmax(likelihood[1:]))
    gain = float(likelihood[best] - likelihood[0])
    return _Component(
        max(gain, 0.0),
        float(np.sqrt(ratios[best] * sigma2[best] / np.mean(a2))),
        float(np.sqrt(sigma2[best])),
    )


def p_value_of_uneven_noise(fit: ModelFit, tests: ScoreTests) -> float:
    """Return the p-value of the score test of a single candidate against a fit, valid for uneven
    noise of visits.
    """
    (effect,) = tests.effects
    _, whitening = tests.whitening([0])
    if not whitening.shape[1]:
        return 1.0
    scores, taken = _scores_by_visit(fit, tests, whitening)
    # Corrected for the leverage of each visit.
    scores /= (1.0 - np.minimum(taken, TESTING.most_taken))[:, None]
    gain, rank = tests.gain([0])
    uneven = float(np.sum(scores**2)) / rank
    # Effective number of visits.
    many = float(np.sum(taken) ** 2 / np.sum(taken**2))
    if chdtrc(many, uneven * many) > TESTING.uneven:
        return tests.score([0], 1).p_value
    return min(effect.trials * float(fdtrc(rank, max(many - rank, 1.0), gain / uneven / rank)), 1.0)


def _scores_by_visit(
    fit: ModelFit, tests: ScoreTests, whitening: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the scores of residuals with the effect, shape (V, rank), and the leverage of each
    visit, shape (V,).
    """
    each = [visits(station) for station in fit.problem.stations]
    step = whitening.T @ tests.within([0])[2]
    starts = np.cumsum([0, *(int(of.max()) + 1 for of in each)])
    visit = np.concatenate([start + of for start, of in zip(starts, each, strict=False)])
    sums, shares = np.zeros((2, int(visit.max()) + 1, len(step)))
    for rows, residuals, moved in tests.along_rows([0], whitening):
        np.add.at(
            sums,
            visit[rows],
            np.einsum("rmn,mn->nr", moved, residuals - np.tensordot(step, moved, axes=1)),
        )
        np.add.at(shares, visit[rows], np.einsum("rmn,rmn->nr", moved, moved))
    return sums, shares.sum(axis=1)
