"""Where a model and data disagree, found before anything is named: in which joint, following what, in which range, where.

Every coordinate in which an arm could move has a lever: how the readings move with it. A disagreement acts at a place if
a curve of some variable times the lever of that place explains it, once all that a refit would take up is projected out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import qr
from scipy.special import chdtrc

from pincal.discover.candidate_tests import fit_of_rows
from pincal.discover.first_order import chance_of, information_criterion
from pincal.discover.levers import MassError, Motions, linearised
from pincal.discover.policy import WHERE
from pincal.identify.fit import ModelFit
from pincal.identify.normal import block_rows
from pincal.identify.quadratic import SEEN, root_of_inverse
from pincal.io.discovery_file import Disagreement
from pincal.model.basis import spline_basis
from pincal.model.catalogue.transmission import most_pieces
from pincal.model.chain import Chain
from pincal.model.conditions import PoseSet, distinct_values, recorded_variable, varies
from pincal.model.effect import Effect
from pincal.parameters import FRAME_SYMBOLS

# A coordinate by (joint or None, acts_on, number).
Spot = tuple[str | None, str, int]


@dataclass(frozen=True)
class Located:
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
    places: tuple[Located, ...]
    regions: tuple[Disagreement, ...]


def locate(fit: ModelFit, sigma: np.ndarray) -> Location:
    """Return where a fit and its data disagree.

    Args:
        fit: the fit; best with elasticity, so that what is left is what nobody has named yet.
        sigma: shape (blocks,), standard deviation of one component of each block of readings.
    """
    rows = np.flatnonzero(fit.solution.weights > 0.0)
    fit = fit_of_rows(fit, rows[np.unique(np.linspace(0, len(rows) - 1, WHERE.rows).astype(int))])
    rest = _rest_of(fit, sigma)
    left, dof, excess = rest.by_row(rest.left), rest.dof, rest.squares - rest.dof
    p_value = float(chdtrc(dof, rest.squares))
    places: list[Located] = []
    while len(places) < WHERE.places and (best := rest.best()) is not None:
        place = rest.described(best, excess)
        if place.share < WHERE.share:
            break
        places.append(place)
        rest = rest.without(best)
    regions: tuple[Disagreement, ...] = ()
    if fit.station.sensor.blocks[0].size == 3 and (places or p_value < WHERE.chance):
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

    place: Located
    lever: float
    columns: np.ndarray
    gram: np.ndarray
    whole: np.ndarray

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

    fit: ModelFit
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
        i, (ebic, p_value) = min(enumerate(found), key=lambda one: one[1][0])
        return self.candidates[i] if p_value < WHERE.chance / len(found) and ebic < 0.0 else None

    def _judged(self, candidate: _Candidate, squares: float) -> tuple[float, float]:
        """Return information criterion and p-value of a candidate."""
        root = root_of_inverse(candidate.gram, candidate.whole, SEEN)
        rank = root.shape[1]
        if rank == 0 or rank >= 0.5 * self.dof:
            return np.inf, 1.0
        gain = float(np.sum((candidate.along(self.left) @ root) ** 2))
        return information_criterion(gain, rank, squares, self.readings), float(chance_of(gain, rank, squares, self.dof))

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

    def described(self, candidate: _Candidate, excess: float) -> Located:
        """Return a candidate with its share of the whole excess, its size and the range in which it sits."""
        place, columns = candidate.place, self.columns_of(candidate)
        height, _, rank, _ = np.linalg.lstsq(columns, self.left, rcond=np.sqrt(SEEN))
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


def _rest_of(fit: ModelFit, sigma: np.ndarray) -> _Rest:
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
    candidates = [candidate.without(Q) for candidate in _candidates(fit, moved)]
    return _Rest(fit, r - Q @ (Q.T @ r), Q, candidates, fit.solution.effective)


def _smoothness(fit: ModelFit, own: int) -> Iterator[np.ndarray]:
    """Yield what is believed of curves as readings of their heights, shape (K, own) each."""
    column = np.cumsum(fit.solution.free) - 1
    for term in (term for term in fit.problem.beliefs.terms if term.sigma is None):
        squares, axes = np.linalg.eigh(term.information)
        rows = np.zeros((len(term.places), own))
        rows[:, column[term.places]] = np.sqrt(np.maximum(squares, 0.0))[:, None] * axes.T
        yield rows


def _orthonormal(A: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of what the columns of a matrix span."""
    sizes = np.linalg.norm(A, axis=0)
    # Pivoted: a column that adds nothing has to come last, or a direction that rounding makes up is kept from all after it.
    Q, R, _ = qr(A / np.maximum(sizes, 1e-300), mode="economic", pivoting=True, check_finite=False, overwrite_a=True)
    return np.asarray(Q[:, np.abs(np.diag(R)) > WHERE.spanned])


def _spots(chain: Chain) -> dict[Spot, int]:
    """Return the coordinates of the chain in which a disagreement may act."""
    found: dict[Spot, int] = {}
    for joint in chain.robot.measured_joints:
        i = chain.robot.joint_names.index(joint)
        found |= {(joint, "drive", 0): int(chain.drives[i])}
        found |= {(joint, axis, 0): chain.joint(i, axis) for axis in ("gamma_x", "gamma_y")}
    found |= {(None, "base", k): chain.base(symbol) for k, symbol in enumerate(FRAME_SYMBOLS)}
    lengths = [chain.joint(i, symbol) for i in range(chain.robot.n_joints) for symbol in "da"]
    return found | {(None, "lengths", k): c for k, c in enumerate(lengths) if chain.nominal[c]}


def _candidates(fit: ModelFit, moved: dict[Spot, np.ndarray]) -> Iterator[_Candidate]:
    """Yield places with nothing taken up; ``moved`` tells how the readings move."""
    names, conditions = fit.model.chain.robot.measured_joints, fit.station.conditions
    slow = [v for v in ("payload", "temperature", "time") if varies(conditions.column(v))]
    bases = {v: _basis(_variable(fit, None, v), WHERE.slow_pieces) for v in slow}
    bases |= {name: _basis(_variable(fit, name, name), WHERE.pieces) for name in names}
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
            gram = columns @ columns.T
            yield _Candidate(Located(joint, acts_on, variable), float(np.linalg.norm(lever)), columns, gram, np.diag(gram))


def _of_own_drive(fit: ModelFit, joint: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield what a drive may follow beside positions: fine waves of its gear, direction of approach, last move, load."""
    conditions = fit.station.conditions
    q = _variable(fit, joint, joint)
    for size in WHERE.own_pieces:
        if np.ptp(q) and size <= most_pieces(q):
            yield joint, _basis(q, size)
    for name, column in (("approach", conditions.approach), ("move", conditions.move)):
        if column is not None and varies(x := _variable(fit, joint, name)):
            yield name, x[None]
    yield "load", _basis(_variable(fit, joint, "load"), WHERE.pieces)


def _variable(fit: ModelFit, joint: str | None, name: str) -> np.ndarray:
    """Return a variable at the rows of a fit, shape (N,)."""
    if name == "load" and joint is not None:
        return PoseSet(fit.model.chain, fit.station.conditions).moment(joint)
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
    if not total[-1] > 0.0 or len(np.unique(x)) < WHERE.distinct:
        return None, 0.0
    last = np.searchsorted(total, total[:-1] + WHERE.most * total[-1] * (1.0 - 1e-12), side="left") - 1
    width = np.where(last < len(x), x[np.minimum(last, len(x) - 1)] - x, np.inf)
    i = int(np.argmin(width))
    j = int(last[i])
    if width[i] > WHERE.narrow * (x[-1] - x[0]) or j + 1 - i > WHERE.narrow * len(x):
        return None, 0.0
    return (float(x[i]), float(x[j])), float((total[j + 1] - total[i]) / total[-1])


def regions_of(fit: ModelFit, left: np.ndarray, expected: float) -> Iterator[Disagreement]:
    """Yield the range of reach or height and the direction in which what is left of positions is concentrated.

    Args:
        fit: the fit.
        left: shape (3, N), whitened residuals in the frame of the instrument.
        expected: what the noise makes of the squares of a row.
    """
    robot, gravity = fit.model.chain.robot, fit.model.chain.gravity
    # A row's part of the excess: its squares less what the noise makes of them.
    energy = np.sum(left**2, axis=0) - expected
    if energy.sum() <= 0.0:
        return
    up = -gravity / np.linalg.norm(gravity)
    away = robot.forward_kinematics(fit.station.conditions.q)[:, :3, 3] - robot.frames.T_base_first[:3, 3]
    first = robot.joint_names[0]
    ranges = ("reach", f"from {first}", np.linalg.norm(away, axis=1)), ("height", f"above {first}", away @ up)
    found = [region for name, where, x in ranges for region in _thickest(name, where, x, energy)]
    if found:
        yield max(found, key=lambda region: region.share)
    yield from _direction(fit.model.chain.base_rotation.T @ left, away, up, expected)


def _thickest(name: str, where: str, x: np.ndarray, energy: np.ndarray) -> Iterator[Disagreement]:
    """Yield the third of the rows, neighbours in x [m], with most of the excess, if chance does not make as much."""
    order = np.argsort(x, kind="stable")
    third = max(len(x) // 3, 1)

    def sums(rows: np.ndarray) -> np.ndarray:
        total = np.cumsum(np.concatenate([np.zeros((*rows.shape[:-1], 1)), rows], axis=-1), axis=-1)
        return np.asarray(total[..., third:] - total[..., :-third])

    found = sums(energy[order])
    shuffled = np.random.default_rng(0).permuted(np.tile(energy, (WHERE.shuffles, 1)), axis=1)
    if np.mean(sums(shuffled).max(axis=1) >= found.max()) > WHERE.chance:
        return
    inside = order[np.argmax(found) :][:third]
    span = f"{x[inside].min():.2f} to {x[inside].max():.2f} m"
    statement = f"it appears where the tip is {span} {where}, in {100 * third / len(x):.0f} % of the poses"
    yield Disagreement(statement, min(float(energy[inside].sum() / energy.sum()), 1.0), region=f"{name} {span}")


def _direction(left: np.ndarray, away: np.ndarray, up: np.ndarray, expected: float) -> Iterator[Disagreement]:
    """Yield the direction in which more than half of the excess points, if there is one.

    All in the base frame: whitened residuals, shape (3, N), the tip from the first joint, shape (N, 3) [m], and up, (3,).
    """
    outward = away - np.outer(away @ up, up)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    parts = {
        "vertical": up @ left,
        "radial": np.sum(outward.T * left, axis=0),
        "tangential": np.sum(np.cross(up, outward).T * left, axis=0),
    }
    excess = {name: float(np.sum(part**2) - len(part) * expected / 3.0) for name, part in parts.items()}
    name = max(excess, key=lambda key: excess[key])
    whole = sum(max(value, 0.0) for value in excess.values())
    # A sum of squares of N numbers scatters by the root of 2 N.
    if excess[name] >= WHERE.pointed * whole and excess[name] >= WHERE.above * np.sqrt(2.0 * left.shape[1]):
        direction = f"{name} direction"
        statement = f"the error points in the {direction} (a third would be isotropic)"
        yield Disagreement(statement, excess[name] / whole, region=direction)
