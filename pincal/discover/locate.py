"""Localisation of misfit before anything is named: joint, variable, range of the variable, and
region of the workspace.

Misfit is located at a place if a motion of it along a curve of some variable explains it, given a
refit of the model: a score test, as of any effect, of the dependence of every place on every
variable.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc

from pincal.discover.discovery_file import Disagreement
from pincal.discover.first_order import ScoreTests
from pincal.discover.place_numbers import WHERE
from pincal.discover.products import Information
from pincal.discover.score_tests import Tangent
from pincal.identify.fit import ModelFit
from pincal.identify.fit_levers import levers
from pincal.identify.mass_error import MassError
from pincal.identify.quadratic import Form
from pincal.model.basis import spline_basis
from pincal.model.catalogue.transmission import most_pieces
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, PoseSet, distinct_values, recorded_variable, varies
from pincal.model.effect import Effect, Locus, Term
from pincal.parameters import FRAME_SYMBOLS, Parameter
from pincal.recorded import SURROUNDINGS
from pincal.sensors.row_samples import evenly


@dataclass(frozen=True)
class Located:
    """Where misfit acts and on what it depends.

    Attributes:
        joint: the joint, None for the whole arm.
        acts_on: "drive" (about or along the joint's own axis), "gamma_x" or "gamma_y" (across it),
            "base" or "lengths".
        depends_on: a joint's name, "approach", "move", "load", "payload", "temperature" or "time".
        share: fraction of the excess of the squared residuals that it explains, 0 to 1.
        size: rms of the motion that a refit does not absorb [rad; m of prismatic joints; 1 for
            "lengths"; none for "base"].
        window: narrow range of the variable that contains most of it, None if it is spread.
        inside: fraction of it in this range.
    """

    joint: str | None
    acts_on: str
    depends_on: str
    share: float = 0.0
    size: float = 0.0
    window: tuple[float, float] | None = None
    inside: float = 0.0


@dataclass(frozen=True, eq=False)
class MovedPlace(Effect):
    """Motion of a joint, the base or all lengths along curves of a variable, at the poses of one
    table.

    Attributes:
        joint, acts_on, depends_on: as of :class:`Located`.
        curves: shape (k, N).
    """

    joint: str | None
    acts_on: str
    depends_on: str
    curves: np.ndarray
    name: ClassVar[str] = "motion"
    meaning: ClassVar[str] = "a frame moves as a smooth function of a variable"

    @property
    def locus(self) -> Locus:
        """Place and variable."""
        return Locus(self.joint, self.acts_on, self.depends_on)

    def moved(self, chain: Chain) -> list[dict[int, float]]:
        """Return the independent motions, each as displacements of coordinates."""
        if self.joint is not None:
            i = chain.robot.joint_names.index(self.joint)
            return [{chain.joint_or_drive(i, self.acts_on): 1.0}]
        if self.acts_on == "base":
            return [{chain.base(symbol): 1.0} for symbol in FRAME_SYMBOLS]
        # All lengths are scaled by the same factor.
        lengths = (chain.joint(i, symbol) for i in range(chain.robot.n_joints) for symbol in "da")
        return [{k: float(chain.nominal[k]) for k in lengths if chain.nominal[k]}]

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Coefficients of the curves, without a prior."""
        stem = f"{self.joint}.{self.acts_on}_of_{self.depends_on}"
        shape = (len(self.moved(chain)), len(self.curves))
        return tuple(
            Parameter(f"{stem}_{shape[1]}_{k}", "rad", self.name, 0.0, 1.0)
            for k in range(np.prod(shape))
        )

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        """Add the curves to each coordinate."""
        columns = enumerate(
            (motion, curve) for motion in self.moved(chain) for curve in self.curves
        )
        return tuple(
            Term(p, k, scale * curve)
            for p, (motion, curve) in columns
            for k, scale in motion.items()
        )


def locate(fit: ModelFit, sigma: np.ndarray) -> tuple[list[Located], list[Disagreement]]:
    """Return where a fit and its data disagree, the largest first, and the regions of the workspace
    with most misfit.

    Args:
        fit: the fit, preferably with elasticity, so that only unknown effects remain.
        sigma: shape (blocks,), standard deviation of one component of each block of readings.
    """
    rows = np.flatnonzero(fit.solution.weights > 0.0)
    fit = fit.select(rows[evenly(len(rows), WHERE.rows)])
    # Rows are taken to be independent.
    fit = fit.over([replace(fit.station, whitening=None, serial=None, arrival=None)])
    fit = replace(fit, solution=replace(fit.solution, estimated=sigma))
    every = _motions(fit)
    places = list[Located]()
    masses = MassError.of(fit.model, fit.values)
    tests = Tangent.at(fit, [masses] if masses else [], None).tests(every, wider=1.0)
    # Squares after a refit, with those of priors; the sizes of mass errors are certain.
    known = float(np.sum((fit.values / fit.priors.sizes) ** 2)) + fit.problem.beliefs.square(
        fit.values, fit.priors.sizes
    )
    squares = tests.squares + known - float(tests.model.slope @ tests.model.slope)
    tests = replace(tests, unsure=np.zeros_like(tests.unsure), squares=squares)
    residuals = _projected(tests)
    dof = tests.dof
    excess = tests.squares - tests.dof
    is_noise = chdtrc(dof, tests.squares) >= WHERE.chance
    while len(places) < WHERE.places and (best := _best(tests)) is not None:
        place = _described(fit, tests, best, excess)
        if place.share < WHERE.share:
            break
        places.append(place)
        tests = _given(tests, best)
    if fit.station.sensor.blocks[0].size != 3 or (is_noise and not places):
        return places, []
    return places, list(regions_of(fit, residuals[:3], 3.0 * dof / tests.readings))


def _given(tests: ScoreTests, best: int) -> ScoreTests:
    """Return the tests of the other motions given one in the model."""
    model = tests.model
    n = tests.n_model
    j = tests.columns[best]
    mine = n + j
    others = [i for i in range(len(tests.effects)) if i != best]
    nothing = np.zeros(len(j))
    cross = tests.cross[:, j]
    rows = np.block([[model.rows.H, cross], [cross.T, tests.own(best)]])
    blocks = Form.of(rows[None], np.append(model.rows.g, tests.g[j])[None])
    prior = Form.of(
        block_diag(model.of_priors, tests.prior([best])), np.append(model.prior.g, nothing)
    )
    both = Information(blocks, prior)
    return replace(
        tests.rearranged(np.append(np.arange(n), mine), others, np.zeros(n + len(tests.g))),
        names=(*tests.names, *(f"{best}.{k}" for k in j)),
        values=np.append(tests.values, nothing),
        unsure=np.append(tests.unsure, nothing > 0.0),
        model=both,
        squares=tests.squares + float(model.slope @ model.slope - both.slope @ both.slope),
        spent=tests.spent + tests.score([best], 1).rank,
    )


def _projected(tests: ScoreTests) -> np.ndarray:
    """Return the residuals after a refit, shape (m, N)."""
    return np.concatenate(
        [residuals for _, residuals, _ in tests.along_rows((), np.zeros((0, 0)))], axis=1
    )


def _best(tests: ScoreTests) -> int | None:
    """Return the motion of smallest information criterion; None if it is not significant."""
    scores = [tests.score([i], 1) for i in range(len(tests.effects))]
    costs = [score.ebic if score.rank < 0.5 * tests.dof else np.inf for score in scores]
    best = int(np.argmin(costs))
    return best if scores[best].p_value < WHERE.chance / len(scores) and costs[best] < 0.0 else None


def _described(fit: ModelFit, tests: ScoreTests, best: int, excess: float) -> Located:
    """Return a motion with its share of the whole excess, its size and its range."""
    motion = tests.effects[best]
    (_, whitening) = tests.whitening([best])
    assert isinstance(motion, MovedPlace)
    height = whitening @ (whitening.T @ tests.within([best])[2])
    change = np.concatenate(
        [moved[0] for _, _, moved in tests.along_rows([best], height[:, None])], axis=1
    )
    noise = np.repeat(fit.solution.estimated, fit.station.block_sizes)
    scale = fit.station.weights * fit.solution.weights / noise[:, None]
    each = (
        np.tensordot([*by.values()], levers(fit, [*by]), axes=1) * scale
        for by in motion.moved(fit.model.chain)
    )
    lever = sum(float(np.sum(moved**2)) for moved in each)
    gain = float(tests.gain([best])[0]) - whitening.shape[1]
    window = None
    inside = 0.0
    if motion.depends_on in fit.model.chain.robot.joint_names:
        x = _variable(fit, None, motion.depends_on)
        window, inside = _window(x, np.sum(change**2, axis=0))
    share = float(np.clip(gain / max(excess, gain), 0.0, 1.0))
    size = float(np.linalg.norm(change) / np.sqrt(lever))
    return Located(motion.joint, motion.acts_on, motion.depends_on, share, size, window, inside)


def _motions(fit: ModelFit) -> list[MovedPlace]:
    """Return the motions of all places along all variables."""
    names = fit.model.chain.robot.measured_joints
    conditions = fit.station.conditions
    slow = [v for v in ("payload", *SURROUNDINGS) if varies(conditions.column(v))]
    curves = {v: _curves(_variable(fit, None, v), WHERE.slow_pieces) for v in slow}
    moving = [name for name in names if name in PoseSet(fit.model.chain, conditions).moving]
    everywhere = curves | {
        name: _curves(_variable(fit, None, name), WHERE.pieces) for name in moving
    }
    every = [
        MovedPlace(joint, acts_on, variable, basis)
        for joint in names
        for acts_on in ("drive", "gamma_x", "gamma_y")
        for variable, basis in (
            *everywhere.items(),
            *(_of_own_drive(fit, joint) if acts_on == "drive" else ()),
        )
    ]
    every += [
        MovedPlace(None, acts_on, variable, basis)
        for variable, basis in curves.items()
        for acts_on in ("base", "lengths")
    ]
    # A variable that does not vary has no curves.
    return [motion for motion in every if len(motion.curves)]


def _of_own_drive(fit: ModelFit, joint: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield further variables of a drive, with curves: fine waves of its gear, direction of
    approach, last move, load.
    """
    conditions = fit.station.conditions
    q = _variable(fit, None, joint)
    does = joint in PoseSet(fit.model.chain, conditions).moving
    for size in WHERE.own_pieces if does else ():
        if size <= most_pieces(q):
            yield joint, _curves(q, size)
    for name, column in (("approach", conditions.approach), ("move", conditions.move)):
        if column is not None and varies(x := _variable(fit, joint, name)):
            yield name, x[None]
    yield "load", _curves(PoseSet(fit.model.chain, conditions).moment(joint), WHERE.pieces)


def _variable(fit: ModelFit, joint: str | None, name: str) -> np.ndarray:
    """Return a variable at the rows of a fit, shape (N,)."""
    return recorded_variable(fit.model.chain, fit.station.conditions, name, joint=joint)


def _curves(x: np.ndarray, size: int) -> np.ndarray:
    """Return curves of a variable, shape (k, N): splines, or powers where it takes few values; none
    of a constant.
    """
    count = distinct_values(x)
    lower = float(x.min())
    upper = float(x.max())
    if count < 2:
        return np.zeros((0, len(x)))
    if count < 2 * size:
        centred = (2.0 * x - lower - upper) / (upper - lower)
        return np.stack([centred**k for k in range(1, min(count, 4))])
    return spline_basis(x, lower, upper, size)


def _window(x: np.ndarray, energy: np.ndarray) -> tuple[tuple[float, float] | None, float]:
    """Return the narrowest range of x that contains most of the rows' energy, and how much; None if
    it is not narrow.
    """
    order = np.argsort(x, kind="stable")
    x = x[order]
    total = np.concatenate([[0.0], np.cumsum(energy[order])])
    if not total[-1] > 0.0 or len(np.unique(x)) < WHERE.distinct:
        return None, 0.0
    last = (
        np.searchsorted(total, total[:-1] + WHERE.most * total[-1] * (1.0 - 1e-12), side="left") - 1
    )
    width = np.where(last < len(x), x[np.minimum(last, len(x) - 1)] - x, np.inf)
    i = int(np.argmin(width))
    j = int(last[i])
    if width[i] > WHERE.narrow * (x[-1] - x[0]) or j + 1 - i > WHERE.narrow * len(x):
        return None, 0.0
    return (float(x[i]), float(x[j])), float((total[j + 1] - total[i]) / total[-1])


def regions_of(fit: ModelFit, residuals: np.ndarray, expected: float) -> Iterator[Disagreement]:
    """Yield the range of reach or height and the direction in which residuals of positions are
    concentrated.

    These are whitened, shape (3, N), in the frame of the instrument; noise explains the square
    ``expected`` of a row.
    """
    robot = fit.model.chain.robot
    gravity = fit.model.chain.gravity
    energy = np.sum(residuals**2, axis=0) - expected
    if energy.sum() <= 0.0:
        return
    up = -gravity / np.linalg.norm(gravity)
    away = (
        robot.forward_kinematics(fit.station.conditions.q)[:, :3, 3]
        - robot.frames.T_base_first[:3, 3]
    )
    first = robot.joint_names[0]
    ranges = (
        ("reach", f"from {first}", np.linalg.norm(away, axis=1)),
        ("height", f"above {first}", away @ up),
    )
    found = [region for name, where, x in ranges for region in _densest(name, where, x, energy)]
    if found:
        yield max(found, key=lambda region: region.share)
    yield from _direction(fit.model.chain.base_rotation.T @ residuals, away, up, expected)


def _densest(name: str, where: str, x: np.ndarray, energy: np.ndarray) -> Iterator[Disagreement]:
    """Yield the third of the rows, adjacent in x [m], with most of the excess, if it is
    significant.
    """
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
    statement = (
        f"it appears where the tip is {span} {where}, in {100 * third / len(x):.0f} % of the poses"
    )
    yield Disagreement(
        statement, min(float(energy[inside].sum() / energy.sum()), 1.0), region=f"{name} {span}"
    )


def _direction(
    residuals: np.ndarray, away: np.ndarray, up: np.ndarray, expected: float
) -> Iterator[Disagreement]:
    """Yield the direction that contains more than half of the excess, if there is one.

    All in the base frame: whitened residuals, shape (3, N), the tip from the first joint, shape (N,
    3) [m], and up, (3,).
    """
    outward = away - np.outer(away @ up, up)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    parts = {
        "vertical": up @ residuals,
        "radial": np.sum(outward.T * residuals, axis=0),
        "tangential": np.sum(np.cross(up, outward).T * residuals, axis=0),
    }
    excess = {
        name: float(np.sum(part**2) - len(part) * expected / 3.0) for name, part in parts.items()
    }
    name = max(excess, key=lambda key: excess[key])
    whole = sum(max(value, 0.0) for value in excess.values())
    # A sum of squares of N normal numbers has a standard deviation of the root of 2 N.
    if excess[name] >= WHERE.pointed * whole and excess[name] >= WHERE.above * np.sqrt(
        2.0 * residuals.shape[1]
    ):
        direction = f"{name} direction"
        statement = f"the error points in the {direction} (a third would be isotropic)"
        yield Disagreement(statement, excess[name] / whole, region=direction)
