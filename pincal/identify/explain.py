"""Which parameters the data identify, why not the others, and which combination is identifiable
instead.

Judged at the nominal geometry, so that it is a statement about the robot, the poses and the
instrument, not the noise. A reason is data, a cause with its figures; only here does it become
words.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from enum import Enum, StrEnum
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigh, solve_triangular
from scipy.linalg.lapack import dpstrf

from pincal.identify.criteria import CRITERIA
from pincal.identify.fit import ModelFit
from pincal.identify.normal import accumulate
from pincal.identify.options import known_frames
from pincal.identify.posterior import Posterior
from pincal.identify.problem import Problem
from pincal.identify.quadratic import NULL, Form
from pincal.identify.station import Station
from pincal.model.effects import BaseFrame
from pincal.parameters import Parameter
from pincal.sensors.row_samples import sample_rows
from pincal.sensors.sensor import KnownParameters
from pincal.thresholds import Count, Scale
from pincal.units import format_readable


class Status(StrEnum):
    """Outcome for a parameter; the values are those of ``result.json``."""

    IDENTIFIED = "identified"
    PRIOR = "prior"
    FIXED = "fixed"
    UNIDENTIFIABLE = "unidentifiable"
    AT_BOUND = "at bound"


class Cause(Enum):
    """Why a parameter is not identified; the values are the words, with the figures of a reason in
    braces.
    """

    NONE = ""
    GIVEN = "given by the user"
    NOT_NEEDED = "fixed at zero: most lenses need no higher terms"
    NOT_IMPROVED = "as in the robot description, since these readings do not improve it"
    AT_BOUND = "stopped at its bound of {size}"
    ABSORBS = "sigma {size} if the parameters it absorbs are held at their estimates"
    NO_MOMENT = (
        "no static moment about this axis in any pose (axis {axis} parallel to gravity, or no "
        "mass beyond it)"
    )
    NOT_EXCITED = "not excited by any of these poses"
    NOT_OBSERVED = "has no influence on the measured target"
    BASE = "the unknown base frame absorbs it"
    TOOL = "the unknown tool frame{unknowns} absorb{s} it"
    FRAMES = "the unknown base and tool frames{unknowns} absorb it"
    PARALLEL_AXES = "only {combination} is identifiable (the axes are parallel)"
    COMBINATION = "only {combination} is identifiable"
    ALIASED = "indistinguishable from {aliases}{together}"
    HIDDEN = "indistinguishable from a combination of many other parameters"
    MASS = (
        "only its product with the compliances is identifiable; the shape of the arm sets the "
        "factor"
    )
    WEAK = "the data narrow the prior only from sigma {size} to {narrowed}"
    UNINFORMED = "the data add nothing to the prior (sigma {size})"


@dataclass(frozen=True)
class Combination:
    """A sum ``other + factor * own`` that the data identify although they do not identify its
    members.
    """

    other: str
    factor: float
    own: str

    def __str__(self) -> str:
        size = abs(self.factor)
        times = "" if abs(size - 1.0) < _ONE else f"{size:.3g} x "
        return f"{self.other} {'+' if self.factor > 0 else '-'} {times}{self.own}"


# Relative difference from 1 that three digits of a factor do not show.
_ONE: Scale = 1e-3


@dataclass(frozen=True)
class Reason:
    """Why a parameter is not identified, as data; ``str()`` gives it in words.

    Attributes:
        cause: the kind of reason.
        parameters: the others that have the same effect, largest share first or in the order of the
            model.
        combination: the sum that is identifiable instead.
        size: bound, prior standard deviation, or conditional standard deviation of a frame's
            coordinate [``unit``].
        narrowed: posterior standard deviation [``unit``].
        unit: SI unit of the parameter.
        axis: letter of a compliance's axis; otherwise empty.
        moment: largest static moment about that axis in these poses [N m].
        unknowns: what else is unknown along with the tool frame, such as "the unknown points".
    """

    cause: Cause
    parameters: tuple[str, ...] = ()
    combination: Combination | None = None
    size: float | None = None
    narrowed: float | None = None
    unit: str = ""
    axis: str = ""
    moment: float | None = None
    unknowns: str = ""

    def __str__(self) -> str:
        words = self.cause.value.format(
            aliases=_listed(self.parameters),
            combination=self.combination,
            size="" if self.size is None else format_readable(self.size, self.unit),
            narrowed="" if self.narrowed is None else format_readable(self.narrowed, self.unit),
            axis=self.axis,
            together=" together" if len(self.parameters) > 1 else "",
            unknowns=f" and {self.unknowns}" if self.unknowns else "",
            s="" if self.unknowns else "s",
        )
        return (
            words
            if self.moment is None
            else f"{words} (static moment about this axis: at most {self.moment:.2g} N m)"
        )


def _listed(names: tuple[str, ...]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else "".join(names)


IDENTIFIED = Reason(Cause.NONE)
"""The reason of an identified parameter."""


# Residual share of a column's square below which other columns have the same effect: 1e-4 of the
# column itself, far below what any instrument resolves and far above rounding.
_SAME: Scale = 1e-8
# Eigenvalues of a scaled Gram matrix, relative to the largest, below which they are rounding (its
# square is 1e-16).
_RANK: Scale = 1e-10
# Poses that are used; more do not change what can be identified, and take time.
_ROWS: Count = 2000
# Stations examined together: what no such group determines, all of them together hardly do either.
_TOGETHER: Count = 8


@dataclass(frozen=True)
class ParameterFinding:
    """Name of a parameter, whether the data identify it, and why not."""

    name: str
    status: Status
    reason: Reason = IDENTIFIED


def explain(fit: ModelFit) -> tuple[ParameterFinding, ...]:
    """Return a finding on every parameter of a fit."""
    # At the nominal geometry, for some stations at a time so that the equations stay small.
    stations = fit.problem.stations
    cuts = [*range(0, max(len(stations) - 1, 1), _TOGETHER), len(stations)]
    nominals = [_Nominal.of(fit, stations[a:b]) for a, b in pairwise(cuts)]
    variance = np.zeros(len(fit.values))
    variance[fit.solution.free] = fit.estimate.covariance.variance
    ratio = np.sqrt(variance) / fit.priors.sizes
    frames = _frame_variances(fit)
    found = (
        _of_frame(parameter, frames[i], variance[i])
        if i in frames
        else _of_inner(fit, nominals, i, float(ratio[i]))
        for i, parameter in enumerate(fit.problem.parameters)
    )
    return tuple(
        ParameterFinding(p.name, *why) for p, why in zip(fit.problem.parameters, found, strict=True)
    )


def _frame_variances(fit: ModelFit) -> dict[int, float]:
    """Return for each free coordinate of bases and tools its variance conditional on all that it
    absorbs at the nominal.
    """
    found = fit.solution.posterior
    reported = fit.solution.known
    free = fit.solution.free
    frames = np.flatnonzero(~found.has_prior)
    inner = np.flatnonzero(found.has_prior)
    shared = np.flatnonzero(free & fit.problem.is_shared)
    C = reported.covariance
    weak = _weak_directions(found, fit.priors.sizes[shared][inner])
    hidden = np.sum((_absorbed(C, inner, frames) @ weak) ** 2, axis=1)
    left = np.maximum(np.diag(C)[frames] - hidden, 0.0)
    known = {int(shared[i]): float(v) for i, v in zip(frames, left, strict=True)}
    # A station's frames follow the robot's parameters by the coefficients of their elimination.
    place = np.flatnonzero(free)
    variance = fit.estimate.covariance.variance
    spread = np.zeros((len(shared), weak.shape[1]))
    spread[inner] = weak
    for part in reported.own:
        hidden = np.sum((part.carried @ spread[part.shared]) ** 2, axis=-1)
        left = np.maximum(variance[part.places] - hidden, 0.0)
        is_frame = np.broadcast_to(part.precision == 0.0, part.places.shape)
        known |= {
            int(place[i]): float(v)
            for i, v in zip(part.places[is_frame], left[is_frame], strict=True)
        }
    return known


def _absorbed(C: np.ndarray, inner: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Return how much of each inner parameter each coordinate of a frame absorbs, shape (frames,
    inner), from the covariance of both.
    """
    # Their units differ by orders of magnitude.
    scale = np.sqrt(np.diag(C)[inner])[:, None]
    both = C[np.ix_(inner, inner)] / (scale * scale.T)
    return np.asarray(-(np.linalg.solve(both, C[np.ix_(inner, frames)] / scale) / scale).T)


def _weak_directions(found: Posterior, sizes: np.ndarray) -> np.ndarray:
    """Return what readings leave of the directions of inner parameters that they hardly observe,
    shape (inner, k), each as long as its standard deviation.
    """
    few = found.information < 1.0
    weak = sizes[:, None] * found.directions[:, few] if len(sizes) else np.zeros((0, 0))
    return np.asarray(weak / np.sqrt(1.0 + found.information[few]))


def _of_frame(parameter: Parameter, known: float, variance: float) -> tuple[Status, Reason]:
    """Return the status of a frame's coordinate, which is known as well as the parameters that it
    absorbs.
    """
    if known > (1.0 - CRITERIA.identified**2) * variance:
        return Status.IDENTIFIED, IDENTIFIED
    return Status.PRIOR, Reason(Cause.ABSORBS, size=float(np.sqrt(known)), unit=parameter.unit)


def _of_inner(
    fit: ModelFit, nominals: list[_Nominal], i: int, ratio: float
) -> tuple[Status, Reason]:
    parameter = fit.problem.parameters[i]
    size = float(fit.priors.sizes[i])
    if fit.is_kept and fit.options.kept is not None and parameter.name in fit.options.kept.names:
        return Status.FIXED, Reason(Cause.NOT_IMPROVED)
    if fit.solution.at_bound[i]:
        bound = float(fit.priors.bounds[i])
        return Status.AT_BOUND, Reason(Cause.AT_BOUND, size=bound, unit=parameter.unit)
    if not fit.solution.free[i]:
        return _not_free(fit, parameter)
    is_uncertain = ratio >= CRITERIA.identified
    model, _ = fit.arm
    if parameter.name in {model.names[body.parameter] for body in model.bodies}:
        # At the nominal geometry nothing deflects, so neither a mass nor the place of a bearing has
        # an effect.
        return (
            (Status.PRIOR, Reason(Cause.MASS)) if is_uncertain else (Status.IDENTIFIED, IDENTIFIED)
        )
    if is_uncertain or not np.isfinite(size):
        reason = _why_unseen(nominals, parameter)
        # The place of a bearing has an effect only if it is compliant, which at the nominal it is
        # not.
        if reason is not None and (
            reason.cause is not Cause.NOT_OBSERVED or ratio >= CRITERIA.narrowed
        ):
            return Status.UNIDENTIFIABLE, replace(reason, moment=_largest_moment(fit, parameter))
    if is_uncertain:
        cause = Cause.WEAK if ratio < CRITERIA.narrowed else Cause.UNINFORMED
        found = Reason(cause, size=size, narrowed=size * ratio, unit=parameter.unit)
        return Status.PRIOR, replace(found, moment=_largest_moment(fit, parameter))
    return Status.IDENTIFIED, IDENTIFIED


def _why_unseen(nominals: list[_Nominal], parameter: Parameter) -> Reason | None:
    """Return why no station sees a parameter at the nominal geometry; None if one does."""
    name = parameter.name
    views = [(nominal, nominal.index[name]) for nominal in nominals if name in nominal.index]
    if min(nominal.unseen[k] for nominal, k in views) <= CRITERIA.unseen:
        return None
    nominal, k = views[0]
    return nominal.counterpart(k)


def _not_free(fit: ModelFit, parameter: Parameter) -> tuple[Status, Reason]:
    """Return why a parameter took no part in the fit."""
    name = parameter.local_name
    if name in known_frames(fit.options.at(parameter.station)):
        return Status.FIXED, Reason(Cause.GIVEN)
    for sensor in (
        station.sensor for station in fit.problem.stations if station.name == parameter.station
    ):
        held = {
            p.name for p, is_fixed in zip(sensor.parameters, sensor.fixed, strict=True) if is_fixed
        }
        if isinstance(sensor, KnownParameters) and name in held:
            return Status.FIXED, Reason(Cause.GIVEN if sensor.is_given else Cause.NOT_NEEDED)
    if parameter.is_compliance:
        return Status.UNIDENTIFIABLE, Reason(Cause.NO_MOMENT, axis=parameter.name[-1])
    return Status.UNIDENTIFIABLE, Reason(Cause.NOT_EXCITED)


def _largest_moment(fit: ModelFit, parameter: Parameter) -> float | None:
    """Return the largest static moment on a joint's compliance in these poses [N m]; None for other
    parameters.
    """
    stations = fit.problem.stations[:_TOGETHER]
    joints = stations[0].model.chain.robot.joint_names
    joint = parameter.element
    symbol = parameter.symbol
    if not parameter.is_compliance or joint not in joints or symbol not in ("k_x", "k_y", "k_z"):
        return None
    largest = []
    column = 3 * joints.index(joint) + "xyz".index(symbol[-1])
    for station in stations:
        conditions = station.conditions.select(sample_rows(len(station), _ROWS))
        moments = station.model.static_moments(np.zeros(station.model.n_parameters), conditions)
        largest.append(float(np.abs(moments[:, column]).max()))
    return max(largest)


@dataclass(frozen=True)
class _Nominal:
    """Normal equations of stations at the nominal geometry, with fitted base and tool.

    Attributes:
        parameters: the P parameters.
        unknowns: what the sensors' own parameters describe, in words.
        H: shape (P, P), scaled to a unit diagonal; zero rows for parameters without effect.
        scale: shape (P,), by which columns were divided.
        unseen: shape (P,), each parameter's share in unobservable directions.
    """

    parameters: tuple[Parameter, ...]
    unknowns: str
    H: np.ndarray
    scale: np.ndarray
    unseen: np.ndarray

    @classmethod
    def of(cls, fit: ModelFit, stations: tuple[Station, ...]) -> _Nominal:
        problem = fit.problem if len(stations) == len(fit.problem.stations) else Problem(stations)
        chosen = fit.estimate.places(p.name for p in problem.parameters)
        free = fit.solution.free[chosen]
        n = len(chosen)
        H = np.zeros((n, n))
        sigma = {
            s.name: fit.solution.sigma[b]
            for s, b in zip(fit.problem.stations, fit.problem.block_spans, strict=True)
        }
        for station, places in zip(problem.stations, problem.places, strict=True):
            rows = sample_rows(len(station), _ROWS // len(stations))
            everything = np.ones(len(places), bool)
            nominal = fit.nominal.values[chosen][places]
            normal = accumulate(station.select(rows), nominal, everything, np.ones(len(rows)))
            H[places[:, None], places] += normal.at(sigma[station.name]).H
        found = Posterior(
            Form.of(H[np.ix_(free, free)]),
            fit.priors.sizes[chosen][free],
            np.zeros(int(free.sum())),
        )
        unseen = np.zeros(n)
        unseen[np.flatnonzero(free)[found.has_prior]] = np.sum(
            found.directions[:, found.information == 0.0] ** 2, axis=1
        )
        scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
        H = np.where(np.outer(free, free), H / np.outer(scale, scale), 0.0)
        unknowns = " and ".join(dict.fromkeys(filter(None, (s.sensor.unknowns for s in stations))))
        return cls(problem.parameters, unknowns, H, scale, unseen)

    def counterpart(self, i: int) -> Reason:
        """Return what has the same effect as parameter ``i``: the smallest set of parameters that
        has.
        """
        if self.H[i, i] < NULL:
            return Reason(Cause.NOT_OBSERVED)
        for others, cause in self._candidates(i):
            share = self._shares(i, others)
            if share is not None:
                return self._reason(i, cause, others, share)
        return Reason(Cause.HIDDEN)

    def _reason(self, i: int, cause: Cause, others: list[int], share: np.ndarray) -> Reason:
        if cause in (Cause.COMBINATION, Cause.PARALLEL_AXES):
            factor = float(share[0] * self.scale[i] / self.scale[others[0]])
            return Reason(
                cause, combination=Combination(self.names[others[0]], factor, self.names[i])
            )
        if cause is Cause.ALIASED:
            named = (
                self.names[j]
                for j, s in zip(others, share, strict=True)
                if abs(s) > CRITERIA.worth_naming
            )
            return Reason(cause, tuple(named))
        return Reason(cause, unknowns="" if cause is Cause.BASE else self.unknowns)

    def _candidates(self, i: int) -> Iterator[tuple[list[int], Cause]]:
        """Yield sets of parameters that may have the same effect, the simplest first, with the
        cause if they do.
        """
        symbol = self.parameters[i].symbol
        base = [j for j in self._extrinsic if self.parameters[j].effect == BaseFrame.name]
        tool = [j for j in self._extrinsic if self.parameters[j].effect != BaseFrame.name]
        inner = [
            j
            for j in range(len(self.names))
            if j != i and j not in base and j not in tool and self.H[j, j] > 0
        ]
        same_symbol = [j for j in inner if self.names[j].endswith("." + symbol)]
        yield base, Cause.BASE
        yield tool, Cause.TOOL
        for j in self._same(self.H, i, same_symbol):
            yield [j], Cause.PARALLEL_AXES if symbol == "d" else Cause.COMBINATION
        for j in self._same(self.H, i, inner):
            yield [j], Cause.COMBINATION
        yield base + tool, Cause.FRAMES if base else Cause.TOOL
        for j in self._same(self._placed, i, inner):
            yield [j, *base, *tool], Cause.ALIASED
        near = [j for j in inner if abs(self._element[i] - self._element[j]) <= 1]
        yield near, Cause.ALIASED
        yield [*near, *base, *tool], Cause.ALIASED
        yield [*inner, *base, *tool], Cause.ALIASED

    @cached_property
    def index(self) -> dict[str, int]:
        """The place of each parameter by its name."""
        return {name: i for i, name in enumerate(self.names)}

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    @cached_property
    def _extrinsic(self) -> list[int]:
        return [j for j, parameter in enumerate(self.parameters) if parameter.is_extrinsic]

    @cached_property
    def _placed(self) -> np.ndarray:
        """H with base and tool eliminated."""
        extrinsic = np.array(self._extrinsic, int)
        across = self.H[:, extrinsic] @ Form.of(self.H).root(extrinsic, _RANK)
        return np.asarray(self.H - across @ across.T)

    @cached_property
    def _element(self) -> list[int]:
        """Number of each parameter's joint, counted from the base."""
        owners = [(parameter.station, parameter.element) for parameter in self.parameters]
        place = {owner: i for i, owner in enumerate(dict.fromkeys(owners))}
        return [place[owner] for owner in owners]

    @staticmethod
    def _same(H: np.ndarray, i: int, others: list[int]) -> list[int]:
        """Return the others that may each have the effect of parameter i; a quick sieve."""
        j = np.array(others, int)
        own = np.maximum(np.diag(H)[j], 1e-300)
        return [int(k) for k in j[H[i, i] - H[i, j] ** 2 / own < 10.0 * _SAME]]

    def _shares(self, i: int, others: Iterable[int]) -> np.ndarray | None:
        """Return the coefficients by which ``others`` reproduce column i, scaled columns; None if
        they can't.
        """
        j = list(others)
        if not j:
            return None
        # A quick sieve, which admits more of their directions.
        factor, pivots, rank, _ = dpstrf(self.H[np.ix_(j, j)], tol=_RANK, lower=1)
        seen = np.array(j)[pivots[:rank] - 1]
        along = solve_triangular(
            factor[:rank, :rank], self.H[seen, i], lower=True, check_finite=False
        )
        if self.H[i, i] - along @ along >= 10.0 * _SAME:
            return None
        share = _least_share(self.H[np.ix_(j, j)], self.H[j, i])
        return share if self.H[i, i] - share @ self.H[j, i] < _SAME else None


def _least_share(H: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return the coefficients by which columns with the products H, shape (n, n), come nearest to
    one, by its products with these, shape (n,): the least ones, without what is rounding.

    The few axes of rounding are held, which takes half the time of all axes.
    """
    _, axes = eigh(H, subset_by_value=(-np.inf, _RANK), check_finite=False)
    seen = across - axes @ (axes.T @ across)
    return np.asarray(cho_solve(cho_factor(H + axes @ axes.T, lower=True), seen))
