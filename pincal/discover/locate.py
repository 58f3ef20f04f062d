"""Where a model and data disagree, found before anything is named: in which joint, following what, in which range.

Every coordinate in which an arm could move has a lever: how the readings move with it. A disagreement acts at a place if
a curve of some variable times the lever of that place explains it, once all that a refit would take up is projected out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import ClassVar

import numpy as np
from scipy.special import chdtrc, fdtrc

from pincal.discover.nuisance import MassError
from pincal.identify.fit import Fit
from pincal.identify.normal import block_rows
from pincal.model.basis import spline_basis
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, Situation, recorded_variable, varies
from pincal.model.effect import Effect, Locus, Term
from pincal.parameters import FRAME_SYMBOLS, Parameter

# Chance that sound data show a place at all (test_nothing_is_located_where_there_is_only_noise).
_ALPHA = 0.01
# Part of the excess below which a further place is not worth a line.
_SHARE = 0.05
_MOST_PLACES = 3
# Part of a column's square that must be left after projection for the data to see it.
_SEEN = 1e-5
# Pieces of curves: smooth ones, of a joint's own position also as fine as a gear's waves, of slow variables coarser.
_SIZE, _OWN_SIZES, _SLOW_SIZE = 8, (24, 60), 5
# Rows that each piece of a curve needs, as a drive curve in a discovery does.
_ROWS = 6
# What counts as sitting in one range: this part of it in less than that part of range and of rows.
_MOST, _NARROW = 0.6, 0.4
# Rows beyond this number are thinned, for time: a place worth a line shows in fewer.
_ENOUGH_ROWS = 1000
# Shuffles by which chance is judged: enough for a level of 0.01, three of them beyond it.
_SHUFFLES = 300


@dataclass(frozen=True)
class Motions(Effect):
    """Unit motions of some coordinates of the chain, for their levers."""

    coordinates: tuple[int, ...]
    name: ClassVar[str] = "motions"
    meaning: ClassVar[str] = "coordinates of the chain move by themselves"

    @property
    def locus(self) -> Locus:
        """Any coordinates."""
        return Locus()

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """One a coordinate."""
        return tuple(Parameter(f"chain.{k}", "rad", self.name, 0.0, 1.0) for k in self.coordinates)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add constants."""
        return tuple(Term(p, k) for p, k in enumerate(self.coordinates))


def levers(fit: Fit, coordinates: tuple[int, ...]) -> np.ndarray:
    """Return how the readings move with coordinates of the chain.

    Args:
        fit: the fit.
        coordinates: K indices in the chain.

    Returns:
        Shape (K, m, N), in units of the readings per rad or m.
    """
    _, jacobian = _linearised(fit, [Motions(coordinates)], np.zeros(len(fit.values), bool))
    return jacobian


def _linearised(fit: Fit, extra: list[Effect], free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals, shape (m, N), and the Jacobian by free parameters and all of the extra effects."""
    problem, known = fit.problem.extended(extra)
    values, mask = np.zeros(len(problem.parameters)), np.ones(len(problem.parameters), bool)
    values[known], mask[known] = fit.values, free
    pieces = list(problem.station.linearise(values, mask))
    residuals = np.concatenate([r for _, r, _ in pieces], axis=1)
    jacobian = np.concatenate([J for _, _, J in pieces], axis=2)
    column = np.cumsum(mask) - 1
    present = column[known[free]]
    return residuals, jacobian[np.concatenate([present, np.setdiff1d(np.arange(len(jacobian)), present)])]


@dataclass(frozen=True)
class Place:
    """Where a disagreement acts and what it follows.

    Attributes:
        joint: the joint, None for the whole arm.
        acts_on: "drive" (about or along the joint's own axis), "gamma_x" or "gamma_y" (across it), "base" or "lengths".
        depends_on: a joint's name, "approach", "load", "payload", "temperature" or "time".
        share: part of the excess of the squared residuals that it explains, 0 to 1.
        size: rms of the motion that a refit does not take up [rad; m of sliding joints; 1 for "lengths"; none for "base"].
        window: the narrow range of the variable in which most of it sits, None if it is spread.
        inside: part of it that sits in this range.
    """

    joint: str | None
    acts_on: str
    depends_on: str
    share: float
    size: float
    window: tuple[float, float] | None
    inside: float


@dataclass(frozen=True)
class Region:
    """A part of the workspace, or a direction, in which the excess is concentrated.

    Attributes:
        variable: "reach" (from the origin of joint 1) or "height" (above it) [m], or "direction".
        lower, upper: the range; for a direction both 0.
        direction: "vertical", "radial" or "tangential" (horizontal, away from and around axis 1); empty otherwise.
        share: part of the excess there.
        rows: part of the rows there; for a direction a third.
    """

    variable: str
    lower: float
    upper: float
    direction: str
    share: float
    rows: float


@dataclass(frozen=True)
class Location:
    """What is known of a disagreement before it has a name.

    Attributes:
        excess: squared residuals beyond what the noise makes, in units of its variance.
        p_value: chance of the residuals if there were only noise.
        places: where it acts, the largest first.
        regions: where in the workspace it shows, if somewhere more than elsewhere.
    """

    excess: float
    p_value: float
    places: tuple[Place, ...]
    regions: tuple[Region, ...]


def locate(fit: Fit, sigma: np.ndarray) -> Location:
    """Return where a fit and its data disagree.

    Args:
        fit: the fit; best with elasticity, so that what is left is what nobody has named yet.
        sigma: shape (blocks,), standard deviation of one component of each block of readings.
    """
    first = rest = _Rest.of(_thinned(fit), sigma)
    p_value = float(chdtrc(first.dof, first.squares))
    places: list[Place] = []
    while len(places) < _MOST_PLACES and (i := rest.best()) is not None:
        place = rest.described(i, first.excess)
        if place.share < _SHARE:
            break
        places.append(place)
        rest = rest.without(i)
    regions = _regions(first) if places or p_value < _ALPHA else ()
    return Location(first.excess, p_value, tuple(places), regions)


def _thinned(fit: Fit) -> Fit:
    """Return the fit of the sound rows, at most so many of them."""
    rows = np.flatnonzero(fit.solution.weights > 0.0)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, _ENOUGH_ROWS).astype(int))]
    solution = replace(fit.solution, weights=fit.solution.weights[rows])
    return replace(fit, problem=fit.problem.select(rows), solution=solution)


@dataclass(frozen=True)
class _Rest:
    """What is left of the readings, whitened, once all that a refit would take up is projected out.

    Attributes:
        fit: the fit.
        left: shape (m N + priors,), the residuals, priors among them, projected.
        Q: shape (m N + priors, P), orthonormal, what the model and found places take up.
        places: C candidates, their shares and sizes not known yet.
        columns: shape (K, m N), curves times levers of all candidates, whitened.
        spans: where each candidate stands in ``columns``.
        taken: shape (K, P), columns times Q.
        spent: parameters spent.
    """

    fit: Fit
    left: np.ndarray
    Q: np.ndarray
    places: tuple[Place, ...]
    columns: np.ndarray
    spans: tuple[slice, ...]
    taken: np.ndarray
    spent: float

    @classmethod
    def of(cls, fit: Fit, sigma: np.ndarray) -> _Rest:
        free = fit.solution.free
        masses = MassError.of(fit.model, fit.values)
        extra: list[Effect] = [masses] if masses else []
        spots = _spots(fit.model.chain)
        residuals, jacobian = _linearised(fit, [*extra, Motions(tuple(spots.values()))], free)
        weights = np.empty(residuals.shape)
        for rows, s in zip(block_rows(fit.station), sigma, strict=True):
            weights[rows] = fit.station.weights * fit.solution.weights / s
        jacobian *= weights
        own = len(jacobian) - len(spots)
        sizes = np.concatenate([fit.priors.sizes[free], *(_sizes(fit, effect) for effect in extra)])
        values = np.append(fit.values[free], np.zeros(own - int(free.sum())))
        r = np.append((residuals * weights).ravel(), -values / sizes)
        Q = _orthonormal(np.vstack([jacobian[:own].reshape(own, -1).T, np.diag(1.0 / sizes)]))
        places, found = zip(*_candidates(fit, dict(zip(spots, jacobian[own:], strict=True))), strict=True)
        ends = np.cumsum([0, *map(len, found)])
        spans = tuple(slice(int(a), int(b)) for a, b in pairwise(ends))
        columns = np.concatenate(found)
        taken = columns @ Q[: columns.shape[1]]
        return cls(fit, r - Q @ (Q.T @ r), Q, places, columns, spans, taken, fit.solution.posterior.effective)

    @property
    def components(self) -> int:
        """Components of one row's readings."""
        return sum(block.size for block in self.fit.station.sensor.blocks)

    @property
    def readings(self) -> int:
        """Number of readings."""
        return self.components * len(self.fit.station)

    @property
    def dof(self) -> float:
        """Degrees of freedom that are left."""
        return max(self.readings - self.spent, 1.0)

    @cached_property
    def squares(self) -> float:
        """Sum of squares that is left."""
        return float(self.left @ self.left)

    @property
    def excess(self) -> float:
        """What the noise does not make of it."""
        return self.squares - self.dof

    def best(self) -> int | None:
        """Return the candidate that explains most for its freedom; None if none is sure."""
        slopes = self.columns @ self.left[: self.columns.shape[1]]
        found = [self._judged(span, slopes[span]) for span in self.spans]
        i = min(range(len(found)), key=lambda k: found[k][0])
        ebic, p_value = found[i]
        return i if p_value < _ALPHA / len(found) and ebic < 0.0 else None

    def _judged(self, span: slice, slope: np.ndarray) -> tuple[float, float]:
        """Return information criterion and p-value of a candidate."""
        values, along = self._spectrum(span, slope)
        rank, rest = len(values), max(self.dof - len(values), 1.0)
        if rank == 0 or rank >= 0.5 * self.dof:
            return np.inf, 1.0
        gain = min(float(np.sum(along**2 / values)), 0.999999 * self.squares)
        p_value = float(fdtrc(rank, rest, gain / rank / ((self.squares - gain) / rest)))
        return self.readings * float(np.log1p(-gain / self.squares)) + rank * float(np.log(self.readings)), p_value

    def _spectrum(self, span: slice, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the strengths of the directions of a candidate that are seen, and the slopes along them."""
        Z, W = self.columns[span], self.taken[span]
        whole = Z @ Z.T
        scale = 1.0 / np.sqrt(np.maximum(np.diag(whole), 1e-300))
        values, vectors = np.linalg.eigh((whole - W @ W.T) * np.outer(scale, scale))
        seen = values > _SEEN
        return values[seen], vectors[:, seen].T @ (scale * slope)

    def without(self, i: int) -> _Rest:
        """Return what is left once a candidate is taken up as well."""
        more = _orthonormal(self._projected(i))
        more -= self.Q @ (self.Q.T @ more)
        taken = np.hstack([self.taken, self.columns @ more[: self.columns.shape[1]]])
        left = self.left - more @ (more.T @ self.left)
        spent = self.spent + more.shape[1]
        return replace(self, left=left, Q=np.hstack([self.Q, more]), taken=taken, spent=spent)

    def _projected(self, i: int) -> np.ndarray:
        """Return the columns of a candidate, what the model takes up left out, shape (m N + priors, k)."""
        Z = self.columns[self.spans[i]]
        out = -self.Q @ self.taken[self.spans[i]].T
        out[: Z.shape[1]] += Z.T
        return np.asarray(out)

    def described(self, i: int, excess: float) -> Place:
        """Return a candidate with its share of the whole excess, its size and the range in which it sits."""
        place, columns = self.places[i], self._projected(i)
        height, _, rank, _ = np.linalg.lstsq(columns, self.left, rcond=np.sqrt(_SEEN))
        fitted = columns @ height
        gain = float(fitted @ fitted) - rank
        change = fitted[: self.columns.shape[1]].reshape(self.components, -1)
        # Of a candidate the size is still that of its lever.
        size = float(np.linalg.norm(change)) / place.size
        window, inside = None, 0.0
        if place.depends_on in self.fit.model.chain.robot.joint_names:
            x = _variable(self.fit, place.joint, place.depends_on)
            window, inside = _window(x, np.sum(change**2, axis=0))
        return replace(
            place, share=float(np.clip(gain / max(excess, gain), 0.0, 1.0)), size=size, window=window, inside=inside
        )


def _orthonormal(A: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of what the columns of a matrix span."""
    Q, R = np.linalg.qr(A / np.maximum(np.linalg.norm(A, axis=0), 1e-300))
    return np.asarray(Q[:, np.abs(np.diag(R)) > 1e-7])


def _sizes(fit: Fit, effect: Effect) -> np.ndarray:
    """Return the priors of nuisance parameters, which are as they are, whatever they move."""
    return np.array([p.size for p in effect.parameters(fit.model.chain)])


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


def _candidates(fit: Fit, moved: dict[Spot, np.ndarray]) -> Iterator[tuple[Place, np.ndarray]]:
    """Yield places and their whitened columns, shape (k, m N), from how the readings move with each coordinate."""
    names, conditions = fit.model.chain.robot.joint_names, fit.station.conditions
    slow = [v for v in ("payload", "temperature", "time") if varies(conditions.column(v))]
    bases = {v: _basis(_variable(fit, None, v), _SLOW_SIZE) for v in slow}
    bases |= {name: _basis(_variable(fit, name, name), _SIZE) for name in names}
    for joint in names:
        for acts_on in ("drive", "gamma_x", "gamma_y"):
            for variable, basis in bases.items():
                yield from _at(joint, acts_on, variable, [moved[joint, acts_on, 0]], basis)
        for variable, basis in _of_own_drive(fit, joint):
            yield from _at(joint, "drive", variable, [moved[joint, "drive", 0]], basis)
    # All lengths grow alike.
    lengths = [fit.model.chain.nominal[c] for (_, at, _), c in _spots(fit.model.chain).items() if at == "lengths"]
    grown = np.tensordot(np.array(lengths), np.array([m for (_, at, _), m in moved.items() if at == "lengths"]), axes=1)
    for variable in slow:
        yield from _at(None, "base", variable, [m for (_, at, _), m in moved.items() if at == "base"], bases[variable])
        yield from _at(None, "lengths", variable, [grown], bases[variable])


def _of_own_drive(fit: Fit, joint: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield what a drive may follow beside positions: fine waves of its gear, direction of approach, load."""
    conditions = fit.station.conditions
    q = _variable(fit, joint, joint)
    for size in _OWN_SIZES:
        if np.ptp(q) and size <= len(q) // _ROWS:
            yield joint, _basis(q, size)
    if conditions.approach is not None and varies(approach := _variable(fit, joint, "approach")):
        yield "approach", approach[None]
    if not fit.model.chain.robot.massless:
        yield "load", _basis(_variable(fit, joint, "load"), _SIZE)


def _at(
    joint: str | None, acts_on: str, variable: str, moved: list[np.ndarray], basis: np.ndarray
) -> Iterator[tuple[Place, np.ndarray]]:
    """Yield a place with its columns, nothing where the variable does not vary."""
    if len(basis):
        columns = np.array(moved)[:, None] * basis[:, None, :]
        motion = float(np.sqrt(np.sum(np.array(moved) ** 2)))
        yield Place(joint, acts_on, variable, 0.0, motion, None, 0.0), columns.reshape(len(moved) * len(basis), -1)


def _variable(fit: Fit, joint: str | None, name: str) -> np.ndarray:
    """Return a variable at the rows of a fit, shape (N,)."""
    if name == "load":
        assert joint is not None
        return Situation(fit.model.chain, fit.station.conditions).moment(joint)
    return recorded_variable(fit.model.chain, fit.station.conditions, name, joint=joint)


def _basis(x: np.ndarray, size: int) -> np.ndarray:
    """Return curves of a variable, shape (k, N): splines, or powers where it takes few values; none of a constant."""
    values = np.unique(x)
    if len(values) < 2:
        return np.zeros((0, len(x)))
    if len(values) < 2 * size:
        centred = 2.0 * (x - values.mean()) / np.ptp(values)
        return np.stack([centred**k for k in range(1, min(len(values), 4))])
    return spline_basis(x, float(values[0]), float(values[-1]), size)


def _window(x: np.ndarray, energy: np.ndarray) -> tuple[tuple[float, float] | None, float]:
    """Return the narrowest range of x that holds most of an energy a row, and how much; None if it is not narrow."""
    order = np.argsort(x, kind="stable")
    x, total = x[order], np.concatenate([[0.0], np.cumsum(energy[order])])
    if not total[-1] > 0.0 or len(np.unique(x)) < 10:
        return None, 0.0
    first = np.arange(len(x))
    last = np.searchsorted(total, total[first] + _MOST * total[-1] * (1.0 - 1e-12), side="left") - 1
    fits = last < len(x)
    width = np.where(fits, x[np.minimum(last, len(x) - 1)] - x, np.inf)
    i = int(np.argmin(width))
    j = int(last[i])
    if width[i] > _NARROW * (x[-1] - x[0]) or j + 1 - i > _NARROW * len(x):
        return None, 0.0
    return (float(x[i]), float(x[j])), float((total[j + 1] - total[i]) / total[-1])


def _regions(rest: _Rest) -> tuple[Region, ...]:
    """Return where in the workspace, and along which direction, the excess shows more than elsewhere."""
    fit = rest.fit
    if fit.station.sensor.blocks[0].size != 3:
        return ()
    n = len(fit.station)
    left = rest.left[: n * rest.components].reshape(rest.components, n)[:3]
    # A row's part of the excess: its squares less what the noise makes of them.
    expected = 3.0 * rest.dof / rest.readings
    energy = np.sum(left**2, axis=0) - expected
    if energy.sum() <= 0.0:
        return ()
    tip = fit.model.chain.robot.forward_kinematics(fit.station.conditions.q)[:, :3, 3]
    up = -fit.model.chain.gravity / np.linalg.norm(fit.model.chain.gravity)
    away = tip - fit.model.chain.robot.frames.T_base_first[:3, 3]
    height = away @ up
    found = [_thickest(name, x, energy) for name, x in (("reach", np.linalg.norm(away, axis=1)), ("height", height))]
    sure = sorted((region for region in found if region), key=lambda region: -region.share / region.rows)
    return (*sure[:1], *_direction(fit, left, away, up, expected))


def _thickest(name: str, x: np.ndarray, energy: np.ndarray) -> Region | None:
    """Return the third of the rows, neighbours in x, with most of the excess, if chance does not make as much."""
    order = np.argsort(x, kind="stable")
    third = max(len(x) // 3, 1)
    rng = np.random.default_rng(0)

    def most(rows: np.ndarray) -> np.ndarray:
        total = np.cumsum(np.concatenate([np.zeros((*rows.shape[:-1], 1)), rows], axis=-1), axis=-1)
        return np.asarray(total[..., third:] - total[..., :-third])

    sums = most(energy[order])
    by_chance = most(rng.permuted(np.tile(energy, (_SHUFFLES, 1)), axis=1)).max(axis=1)
    if np.mean(by_chance >= sums.max()) > _ALPHA:
        return None
    start = int(np.argmax(sums))
    inside = order[start : start + third]
    share = float(energy[inside].sum() / energy.sum())
    return Region(name, float(x[inside].min()), float(x[inside].max()), "", min(share, 1.0), third / len(x))


def _direction(fit: Fit, left: np.ndarray, away: np.ndarray, up: np.ndarray, expected: float) -> tuple[Region, ...]:
    """Return the direction in which more than half of the excess points, if there is one."""
    local = fit.model.chain.base_rotation.T @ left
    outward = away - np.outer(away @ up, up)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    parts = {
        "vertical": up @ local,
        "radial": np.sum(outward.T * local, axis=0),
        "tangential": np.sum(np.cross(up, outward).T * local, axis=0),
    }
    excess = {name: float(np.sum(part**2) - len(part) * expected / 3.0) for name, part in parts.items()}
    name = max(excess, key=lambda key: excess[key])
    whole = sum(max(value, 0.0) for value in excess.values())
    # Twice the noise of a sum of squares of N numbers.
    if excess[name] < 0.55 * whole or excess[name] < 4.0 * np.sqrt(2.0 * left.shape[1]):
        return ()
    return (Region("direction", 0.0, 0.0, name, excess[name] / whole, 1.0 / 3.0),)
