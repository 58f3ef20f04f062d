"""Where a model and data disagree, found before anything is named: in which joint, following what, in which range.

Every coordinate in which an arm could move has a lever: how the readings move with it. A disagreement acts at a place if
a curve of some variable times the lever of that place explains it, once all that a refit would take up is projected out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import qr
from scipy.special import chdtrc, fdtrc

from pincal.discover.candidate_tests import some_rows
from pincal.discover.levers import Motions, linearised
from pincal.discover.nuisance import MassError
from pincal.discover.regions import regions_of
from pincal.identify.fit import Fit
from pincal.identify.normal import block_rows
from pincal.io.discovery_file import Disagreement
from pincal.model.basis import spline_basis
from pincal.model.catalogue.curves import most_pieces
from pincal.model.chain import Chain
from pincal.model.conditions import Situation, distinct_values, recorded_variable, varies
from pincal.model.effect import Effect
from pincal.parameters import FRAME_SYMBOLS

# Chance that sound data show a place at all (test_nothing_is_located_where_there_is_only_noise).
_ALPHA = 0.01
# Part of the excess below which a further place is not worth a line, and places at most.
_SHARE, _MOST_PLACES = 0.05, 3
# Part of a column's square that must be left after projection for the data to see it.
_SEEN = 1e-5
# Pieces of curves: smooth ones, of a joint's own position also as fine as a gear's waves, of slow variables coarser.
_SIZE, _OWN_SIZES, _SLOW_SIZE = 8, (24, 60), 5
# What counts as sitting in one range: this part of it in less than that part of range and of rows.
_MOST, _NARROW = 0.6, 0.4
# Rows beyond this number are thinned, for time: a place worth a line shows in fewer.
_ENOUGH_ROWS = 1000


@dataclass(frozen=True)
class Place:
    """Where a disagreement acts and what it follows.

    Attributes:
        joint: the joint, None for the whole arm.
        acts_on: "drive" (about or along the joint's own axis), "gamma_x" or "gamma_y" (across it), "base" or "lengths".
        depends_on: a joint's name, "approach", "move", "load", "payload", "temperature" or "time".
        share: part of the excess of the squared residuals that it explains, 0 to 1.
        size: rms of the motion that a refit does not take up [rad; m of sliding joints; 1 for "lengths"; none for "base"].
        window: the narrow range of the variable in which most of it sits, None if it is spread.
        inside: part of it that sits in this range.
    """

    joint: str | None
    acts_on: str
    depends_on: str
    share: float = 0.0
    size: float = 0.0
    window: tuple[float, float] | None = None
    inside: float = 0.0


@dataclass(frozen=True)
class Location:
    """What is known of a disagreement before it has a name.

    Attributes:
        p_value: chance of the residuals if there were only noise.
        places: where it acts, the largest first.
        regions: where in the workspace it shows, if somewhere more than elsewhere.
    """

    p_value: float
    places: tuple[Place, ...]
    regions: tuple[Disagreement, ...]


def locate(fit: Fit, sigma: np.ndarray) -> Location:
    """Return where a fit and its data disagree.

    Args:
        fit: the fit; best with elasticity, so that what is left is what nobody has named yet.
        sigma: shape (blocks,), standard deviation of one component of each block of readings.
    """
    rows = np.flatnonzero(fit.solution.weights > 0.0)
    fit = some_rows(fit, rows[np.unique(np.linspace(0, len(rows) - 1, _ENOUGH_ROWS).astype(int))])
    rest = _rest_of(fit, sigma)
    left, dof, excess = rest.by_row(rest.left), rest.dof, rest.squares - rest.dof
    p_value = float(chdtrc(dof, rest.squares))
    places: list[Place] = []
    while len(places) < _MOST_PLACES and (best := rest.best()) is not None:
        place = rest.described(best, excess)
        if place.share < _SHARE:
            break
        places.append(place)
        rest = rest.without(best)
    regions: tuple[Disagreement, ...] = ()
    if fit.station.sensor.blocks[0].size == 3 and (places or p_value < _ALPHA):
        regions = tuple(regions_of(fit, left[:3], 3.0 * dof / rest.readings))
    return Location(p_value, tuple(places), regions)


@dataclass(frozen=True)
class _Candidate:
    """A place where a disagreement may act.

    Attributes:
        place: the place, its share and size not known yet.
        lever: root of the summed squares of all readings' motion with it.
        columns: shape (k, m N), curves times lever, whitened.
        gram: shape (k, k), their products once what is taken up is projected out.
        whole: shape (k,), their squares before that.
    """

    place: Place
    lever: float
    columns: np.ndarray
    gram: np.ndarray
    whole: np.ndarray

    @classmethod
    def of(cls, place: Place, lever: float, columns: np.ndarray) -> _Candidate:
        """Return a place with nothing taken up."""
        gram = columns @ columns.T
        return cls(place, lever, columns, gram, np.diag(gram))

    def along(self, vectors: np.ndarray) -> np.ndarray:
        """Return the products of its columns with vectors of all readings and priors, shape (m N + priors, ...)."""
        return np.asarray(self.columns @ vectors[: self.columns.shape[1]])

    def without(self, Q: np.ndarray) -> _Candidate:
        """Return it once further orthonormal vectors are taken up."""
        taken = self.along(Q)
        return replace(self, gram=self.gram - taken @ taken.T)


@dataclass(frozen=True)
class _Rest:
    """What is left of the readings, whitened, once all that a refit would take up is projected out.

    Attributes:
        fit: the fit.
        left: shape (m N + priors,), the residuals, priors among them, projected.
        taken: shape (m N + priors, p), orthonormal vectors of what is projected out.
        candidates: where it may come from.
        spent: parameters spent.
    """

    fit: Fit
    left: np.ndarray
    taken: np.ndarray
    candidates: Sequence[_Candidate]
    spent: float

    @property
    def readings(self) -> int:
        """Number of readings."""
        return len(self.fit.station) * sum(block.size for block in self.fit.station.sensor.blocks)

    @property
    def dof(self) -> float:
        """Degrees of freedom that are left."""
        return max(self.readings - self.spent, 1.0)

    @property
    def squares(self) -> float:
        """Sum of squares that is left."""
        return float(self.left @ self.left)

    def by_row(self, vector: np.ndarray) -> np.ndarray:
        """Return the readings of a vector like ``left``, shape (m, N)."""
        return vector[: self.readings].reshape(-1, len(self.fit.station))

    def best(self) -> _Candidate | None:
        """Return the candidate that explains most for its freedom; None if none is sure."""
        squares = self.squares
        found = [self._judged(candidate, squares) for candidate in self.candidates]
        i = min(range(len(found)), key=lambda k: found[k][0])
        ebic, p_value = found[i]
        return self.candidates[i] if p_value < _ALPHA / len(found) and ebic < 0.0 else None

    def _judged(self, candidate: _Candidate, squares: float) -> tuple[float, float]:
        """Return information criterion and p-value of a candidate."""
        scale = 1.0 / np.sqrt(np.maximum(candidate.whole, 1e-300))
        values, vectors = np.linalg.eigh(candidate.gram * np.outer(scale, scale))
        seen = values > _SEEN
        rank = int(seen.sum())
        if rank == 0 or rank >= 0.5 * self.dof:
            return np.inf, 1.0
        along = vectors[:, seen].T @ (scale * candidate.along(self.left))
        gain = min(float(np.sum(along**2 / values[seen])), 0.999999 * squares)
        rest = max(self.dof - rank, 1.0)
        p_value = float(fdtrc(rank, rest, gain / rank / ((squares - gain) / rest)))
        return self.readings * float(np.log1p(-gain / squares)) + rank * float(np.log(self.readings)), p_value

    def without(self, best: _Candidate) -> _Rest:
        """Return what is left once a candidate is taken up as well."""
        Q = _orthonormal(self.columns_of(best))
        return _Rest(
            self.fit,
            self.left - Q @ (Q.T @ self.left),
            np.hstack([self.taken, Q]),
            [candidate.without(Q) for candidate in self.candidates],
            self.spent + Q.shape[1],
        )

    def columns_of(self, candidate: _Candidate) -> np.ndarray:
        """Return the columns of a candidate, projected, shape (m N + priors, k)."""
        columns = np.asarray(-self.taken @ candidate.along(self.taken).T)
        columns[: candidate.columns.shape[1]] += candidate.columns.T
        return columns

    def described(self, candidate: _Candidate, excess: float) -> Place:
        """Return a candidate with its share of the whole excess, its size and the range in which it sits."""
        place, columns = candidate.place, self.columns_of(candidate)
        height, _, rank, _ = np.linalg.lstsq(columns, self.left, rcond=np.sqrt(_SEEN))
        fitted = columns @ height
        gain = float(fitted @ fitted) - rank
        change = self.by_row(fitted)
        window, inside = None, 0.0
        if place.depends_on in self.fit.model.chain.robot.joint_names:
            x = _variable(self.fit, place.joint, place.depends_on)
            window, inside = _window(x, np.sum(change**2, axis=0))
        share = float(np.clip(gain / max(excess, gain), 0.0, 1.0))
        size = float(np.linalg.norm(change)) / candidate.lever
        return replace(place, share=share, size=size, window=window, inside=inside)


def _rest_of(fit: Fit, sigma: np.ndarray) -> _Rest:
    """Return what a fit leaves, with its parameters and uncertain masses taken up."""
    free = fit.solution.free
    masses = MassError.of(fit.model, fit.values)
    extra: list[Effect] = [masses] if masses else []
    spots = _spots(fit.model.chain)
    residuals, jacobian = linearised(fit, [*extra, Motions(tuple(spots.values()))], free)
    weights = np.empty(residuals.shape)
    for rows, s in zip(block_rows(fit.station), sigma, strict=True):
        weights[rows] = fit.station.weights * fit.solution.weights / s
    jacobian *= weights
    own = len(jacobian) - len(spots)
    # Masses are known as they are, whatever they move.
    sizes = np.concatenate([fit.priors.sizes[free], *([p.size for p in e.parameters(fit.model.chain)] for e in extra)])
    values = np.append(fit.values[free], np.zeros(own - int(free.sum())))
    beliefs = np.vstack([np.diag(1.0 / sizes), *_smoothness(fit, own)])
    r = np.append((residuals * weights).ravel(), -beliefs @ values)
    Q = _orthonormal(np.vstack([jacobian[:own].reshape(own, -1).T, beliefs]))
    motions = jacobian[own:].copy()
    # As large as all candidates together.
    del jacobian
    moved = dict(zip(spots, motions, strict=True))
    candidates = [_Candidate.of(*found).without(Q) for found in _candidates(fit, moved)]
    return _Rest(fit, r - Q @ (Q.T @ r), Q, candidates, fit.solution.effective)


def _smoothness(fit: Fit, own: int) -> Iterator[np.ndarray]:
    """Yield what is believed of curves as readings of their heights, shape (K, own) each."""
    column = np.cumsum(fit.solution.free) - 1
    for places, information in fit.problem.smooth:
        squares, axes = np.linalg.eigh(information)
        rows = np.zeros((len(places), own))
        rows[:, column[places]] = np.sqrt(np.maximum(squares, 0.0))[:, None] * axes.T
        yield rows


def _orthonormal(A: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of what the columns of a matrix span."""
    sizes = np.linalg.norm(A, axis=0)
    # Pivoted: a column that adds nothing has to come last, or a direction that rounding makes up is kept from all after it.
    Q, R, _ = qr(A / np.maximum(sizes, 1e-300), mode="economic", pivoting=True, check_finite=False, overwrite_a=True)
    return np.asarray(Q[:, np.abs(np.diag(R)) > 1e-7])


# A coordinate by (joint or None, acts_on, number).
Spot = tuple[str | None, str, int]


def _spots(chain: Chain) -> dict[Spot, int]:
    """Return the coordinates of the chain in which a disagreement may act."""
    found: dict[Spot, int] = {}
    for i, joint in enumerate(chain.robot.joint_names):
        found |= {(joint, "drive", 0): int(chain.drives[i])}
        found |= {(joint, axis, 0): chain.joint(i, axis) for axis in ("gamma_x", "gamma_y")}
    found |= {(None, "base", k): chain.base(symbol) for k, symbol in enumerate(FRAME_SYMBOLS)}
    lengths = [chain.joint(i, symbol) for i in range(chain.robot.n_joints) for symbol in "da"]
    return found | {(None, "lengths", k): c for k, c in enumerate(lengths) if chain.nominal[c]}


def _candidates(fit: Fit, moved: dict[Spot, np.ndarray]) -> Iterator[tuple[Place, float, np.ndarray]]:
    """Yield places, their levers and whitened columns, shape (k, m N); ``moved`` tells how the readings move."""
    names, conditions = fit.model.chain.robot.joint_names, fit.station.conditions
    slow = [v for v in ("payload", "temperature", "time") if varies(conditions.column(v))]
    bases = {v: _basis(_variable(fit, None, v), _SLOW_SIZE) for v in slow}
    bases |= {name: _basis(_variable(fit, name, name), _SIZE) for name in names}
    followed: list[tuple[str | None, str, str, np.ndarray, np.ndarray]] = [
        (joint, acts_on, variable, basis, moved[joint, acts_on, 0][None])
        for joint in names
        for acts_on in ("drive", "gamma_x", "gamma_y")
        for variable, basis in (*bases.items(), *(_of_own_drive(fit, joint) if acts_on == "drive" else ()))
    ]
    of = {at: np.array([m for (_, acts_on, _), m in moved.items() if acts_on == at]) for at in ("base", "lengths")}
    # All lengths grow alike.
    lengths = [fit.model.chain.nominal[c] for (_, at, _), c in _spots(fit.model.chain).items() if at == "lengths"]
    of["lengths"] = np.tensordot(np.array(lengths), of["lengths"], axes=1)[None]
    followed += [(None, at, variable, bases[variable], lever) for variable in slow for at, lever in of.items()]
    for joint, acts_on, variable, basis, lever in followed:
        # A variable that does not vary has no curves.
        if len(basis):
            columns = (lever[:, None] * basis[:, None, :]).reshape(len(lever) * len(basis), -1)
            yield Place(joint, acts_on, variable), float(np.linalg.norm(lever)), columns


def _of_own_drive(fit: Fit, joint: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield what a drive may follow beside positions: fine waves of its gear, direction of approach, last move, load."""
    conditions = fit.station.conditions
    q = _variable(fit, joint, joint)
    for size in _OWN_SIZES:
        if np.ptp(q) and size <= most_pieces(q):
            yield joint, _basis(q, size)
    if conditions.approach is not None and varies(approach := _variable(fit, joint, "approach")):
        yield "approach", approach[None]
    if conditions.move is not None and varies(move := _variable(fit, joint, "move")):
        yield "move", move[None]
    yield "load", _basis(_variable(fit, joint, "load"), _SIZE)


def _variable(fit: Fit, joint: str | None, name: str) -> np.ndarray:
    """Return a variable at the rows of a fit, shape (N,)."""
    if name == "load" and joint is not None:
        return Situation(fit.model.chain, fit.station.conditions).moment(joint)
    return recorded_variable(fit.model.chain, fit.station.conditions, name, joint=joint)


def _basis(x: np.ndarray, size: int) -> np.ndarray:
    """Return curves of a variable, shape (k, N): splines, or powers where it takes few values; none of a constant."""
    count, lower, upper = distinct_values(x), float(x.min()), float(x.max())
    if count < 2:
        return np.zeros((0, len(x)))
    if count < 2 * size:
        centred = (2.0 * x - lower - upper) / (upper - lower)
        return np.stack([centred**k for k in range(1, min(count, 4))])
    return spline_basis(x, lower, upper, size)


def _window(x: np.ndarray, energy: np.ndarray) -> tuple[tuple[float, float] | None, float]:
    """Return the narrowest range of x that holds most of an energy a row, and how much; None if it is not narrow."""
    order = np.argsort(x, kind="stable")
    x, total = x[order], np.concatenate([[0.0], np.cumsum(energy[order])])
    if not total[-1] > 0.0 or len(np.unique(x)) < 10:
        return None, 0.0
    last = np.searchsorted(total, total[:-1] + _MOST * total[-1] * (1.0 - 1e-12), side="left") - 1
    width = np.where(last < len(x), x[np.minimum(last, len(x) - 1)] - x, np.inf)
    i = int(np.argmin(width))
    j = int(last[i])
    if width[i] > _NARROW * (x[-1] - x[0]) or j + 1 - i > _NARROW * len(x):
        return None, 0.0
    return (float(x[i]), float(x[j])), float((total[j + 1] - total[i]) / total[-1])
