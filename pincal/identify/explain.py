"""What the data can tell of each parameter, in words, and which combination they tell where not the parameter itself.

Judged at the nominal geometry, so that it is a statement on the robot, the poses and the instrument, not on the noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from pincal.identify.calibrate import EXTRINSICS, Fit, known_frames
from pincal.identify.normal import NULL, accumulate, posterior
from pincal.identify.rows import some_rows
from pincal.units import format_readable

Status = Literal["identified", "prior", "fixed", "unidentifiable", "at bound"]

# Below this ratio of posterior to prior standard deviation the data say at least three times as much as the prior.
_IDENTIFIED = 0.5
# A parameter with more than this share in directions that no reading sees can't be told by itself.
_UNSEEN = 1e-3
# Part of a column's square that other columns may leave and still count as doing the same.
_SAME = 1e-8
# Share of a parameter's action below which another one is not worth naming as its counterpart.
_WORTH_NAMING = 0.05
_ROWS = 2000


@dataclass(frozen=True)
class Finding:
    """What became of one parameter.

    Attributes:
        name: of the parameter.
        status: "identified", "prior", "fixed", "unidentifiable" or "at bound".
        reason: in words; empty for an identified parameter.
    """

    name: str
    status: Status
    reason: str


def explain(fit: Fit) -> tuple[Finding, ...]:
    """Return a finding on every parameter of a fit."""
    nominal = _Nominal.of(fit)
    variance = np.zeros(len(fit.values))
    variance[fit.solution.free] = np.diag(fit.solution.posterior.covariance)
    ratio = np.sqrt(variance) / fit.priors.sizes
    told = _told_of_frames(fit)
    return tuple(
        _frame_finding(fit, i, told[i], variance[i]) if i in told else _finding(fit, nominal, i, float(ratio[i]))
        for i in range(len(fit.values))
    )


def _told_of_frames(fit: Fit) -> dict[int, float]:
    """Return, for each free coordinate of base and tool, its variance with all that hides behind it at the nominal."""
    found = fit.solution.posterior
    frames, inner = np.flatnonzero(~found.has_prior), np.flatnonzero(found.has_prior)
    place = np.flatnonzero(fit.solution.free)
    C = found.covariance
    F = -np.linalg.lstsq(C[np.ix_(inner, inner)], C[np.ix_(inner, frames)], rcond=None)[0].T
    D = fit.priors.sizes[fit.solution.free][inner]
    weak = D[:, None] * found.directions[:, found.information < 1.0] if len(inner) else np.zeros((0, 0))
    hidden = np.sum((F @ (weak / np.sqrt(1.0 + found.information[found.information < 1.0]))) ** 2, axis=1)
    left = np.maximum(np.diag(C)[frames] - hidden, 0.0)
    return {int(place[i]): float(v) for i, v in zip(frames, left, strict=True)}


def _frame_finding(fit: Fit, i: int, told: float, variance: float) -> Finding:
    """Frames of base and tool are known as well as the parameters that they absorb."""
    parameter = fit.problem.parameters[i]
    if told > (1.0 - _IDENTIFIED**2) * variance:
        return Finding(parameter.name, "identified", "")
    sharp = format_readable(float(np.sqrt(told)), parameter.unit)
    return Finding(parameter.name, "prior", f"+- {sharp} with the parameters that it absorbs at their values here")


def _finding(fit: Fit, nominal: _Nominal, i: int, ratio: float) -> Finding:
    parameter = fit.problem.parameters[i]
    if fit.solution.at_bound[i]:
        return Finding(parameter.name, "at bound", f"held at its bound of {format_readable(fit.priors.bounds[i], 'm', 'g')}")
    if not fit.solution.free[i]:
        if parameter.name in known_frames(fit.options):
            return Finding(parameter.name, "fixed", "given by the user")
        if parameter.effect in ("lens", "lens_distortion"):
            given = "left at zero: usual lenses need no more" if fit.options.setup.lens is None else "given by the user"
            return Finding(parameter.name, "fixed", given)
        return Finding(parameter.name, "unidentifiable", _not_excited(parameter.name, parameter.unit))
    if nominal.unseen[i] > _UNSEEN and (ratio >= _IDENTIFIED or not np.isfinite(fit.priors.sizes[i])):
        reason = nominal.counterpart(i) + _small_moment(fit, parameter.name, parameter.unit)
        return Finding(parameter.name, "unidentifiable", reason)
    if ratio >= _IDENTIFIED:
        return Finding(parameter.name, "prior", _weak(fit, i, ratio))
    return Finding(parameter.name, "identified", "")


def _not_excited(name: str, unit: str) -> str:
    if unit.endswith("/(N m)"):
        return f"no moment about this axis in any pose (axis {name[-1]} parallel to gravity, or nothing hangs on it)"
    return "nothing in these poses acts on it"


def _weak(fit: Fit, i: int, ratio: float) -> str:
    parameter = fit.problem.parameters[i]
    before = format_readable(fit.priors.sizes[i], parameter.unit)
    after = format_readable(fit.priors.sizes[i] * ratio, parameter.unit)
    told = (
        f"known beforehand to +- {before}; the poses narrow this only to +- {after}"
        if ratio < 0.97
        else (f"the poses say nothing beyond what is known beforehand, +- {before}")
    )
    return f"{told}{_small_moment(fit, parameter.name, parameter.unit)}"


def _small_moment(fit: Fit, name: str, unit: str) -> str:
    """Say how large the moment gets that a compliance answers to."""
    joints = fit.model.chain.robot.joint_names
    joint, symbol = name.rsplit(".", 1)
    if not unit.endswith("/(N m)") or joint not in joints or symbol not in ("k_x", "k_y", "k_z"):
        return ""
    rows = some_rows(len(fit.problem), _ROWS)
    moments = fit.model.static_moments(np.zeros(fit.model.n_parameters), fit.problem.conditions.select(rows))
    largest = np.abs(moments[:, 3 * joints.index(joint) + "xyz".index(symbol[-1])]).max()
    return f" (the moment about this axis stays below {largest:.2g} N m)"


@dataclass(frozen=True)
class _Nominal:
    """Normal equations at the nominal geometry, with base and tool where they are.

    Attributes:
        names: of the P parameters.
        effects: those that own them.
        G: shape (P, P), scaled to a unit diagonal; zero rows for what has no effect.
        scale: shape (P,), by which columns were divided.
        unseen: shape (P,), each parameter's share in the directions that no reading sees.
    """

    names: tuple[str, ...]
    effects: tuple[str, ...]
    G: np.ndarray
    scale: np.ndarray
    unseen: np.ndarray

    @classmethod
    def of(cls, fit: Fit) -> _Nominal:
        problem = fit.problem
        rows = some_rows(len(problem), _ROWS)
        everything = np.ones(len(fit.values), bool)
        normal = accumulate(problem.select(rows), fit.nominal.values, everything, np.ones(len(rows)))
        G, g = normal.at(fit.solution.sigma)
        free = fit.solution.free
        told = posterior(G[np.ix_(free, free)], g[free], fit.priors.sizes[free], np.zeros(int(free.sum())))
        null = told.directions[:, told.information == 0.0]
        unseen = np.zeros(len(fit.values))
        unseen[np.flatnonzero(free)[told.has_prior]] = np.sum(null**2, axis=1)
        scale = np.sqrt(np.maximum(np.diag(G), 1e-300))
        G = np.where(np.outer(free, free), G / np.outer(scale, scale), 0.0)
        names, effects = zip(*((p.name, p.effect) for p in problem.parameters), strict=True)
        return cls(names, effects, G, scale, unseen)

    def counterpart(self, i: int) -> str:
        """Say what does the same as parameter ``i``; the smallest set of parameters that does is named."""
        if self.G[i, i] < NULL:
            return "it does not move the measured target"
        for others, words in self._candidates(i):
            share = self._shares(i, others)
            if share is not None:
                named = [self.names[j] for j, s in zip(others, share, strict=True) if abs(s) > _WORTH_NAMING]
                together = f"{', '.join(named)} together do the same" if len(named) > 1 else f"{named[0]} does the same"
                return words.format(self._combination(i, others, share), together)
        return "its action hides behind that of many others together"

    def _candidates(self, i: int) -> Iterator[tuple[list[int], str]]:
        symbol = self.names[i].rsplit(".", 1)[1]
        base, tool = self._of("base_frame"), self._of("tool_frame", "named_point", "lens")
        inner = [j for j in range(len(self.names)) if j != i and j not in base and j not in tool and self.G[j, j] > 0]
        alike = [j for j in inner if self.names[j].endswith("." + symbol)]
        yield base, "the unknown base frame absorbs it"
        yield tool, f"{self._unknown} absorbs it"
        for j in self._same(self.G, i, alike):
            yield [j], "only {0} is determined (the axes are parallel)" if symbol == "d" else "only {0} is determined"
        for j in self._same(self.G, i, inner):
            yield [j], "only {0} is determined"
        yield base + tool, "the unknown base and tool frames absorb it" if base else f"{self._unknown} absorbs it"
        for j in self._same(self._beside_frames, i, inner):
            yield [j, *base, *tool], "{1}"
        near = [j for j in inner if abs(self._element[i] - self._element[j]) <= 1]
        yield near, "{1}"
        yield [*near, *base, *tool], "{1}"
        yield [*inner, *base, *tool], "{1}"

    @property
    def _unknown(self) -> str:
        """Name what is free beside the base frame."""
        return "the unknown tool frame" + (" with the unknown points" if self._of("named_point") else "")

    def _of(self, *effects: str) -> list[int]:
        return [j for j, effect in enumerate(self.effects) if effect in effects]

    @cached_property
    def _element(self) -> list[int]:
        """Which joint, counted from the base, each parameter belongs to."""
        owners = [name.rsplit(".", 1)[0] for name in self.names]
        place = {owner: i for i, owner in enumerate(dict.fromkeys(owners))}
        return [place[owner] for owner in owners]

    @cached_property
    def _beside_frames(self) -> np.ndarray:
        """G with what base and tool absorb taken out."""
        frames = self._of(*EXTRINSICS)
        inverse = np.linalg.pinv(self.G[np.ix_(frames, frames)], rcond=1e-10, hermitian=True)
        return np.asarray(self.G - self.G[:, frames] @ inverse @ self.G[frames])

    @staticmethod
    def _same(G: np.ndarray, i: int, others: list[int]) -> list[int]:
        """Return those of the others that may do by themselves what parameter i does; a quick sieve."""
        j = np.array(others, int)
        own = np.maximum(np.diag(G)[j], 1e-300)
        return [int(k) for k in j[G[i, i] - G[i, j] ** 2 / own < 10.0 * _SAME]]

    def _shares(self, i: int, others: Iterable[int]) -> np.ndarray | None:
        """Return the coefficients by which ``others`` reproduce column i, scaled columns; None if they can't."""
        j = list(others)
        if not j:
            return None
        values, vectors = np.linalg.eigh(self.G[np.ix_(j, j)])
        seen = values > 1e-10 * max(values[-1], 1e-300)
        U = vectors[:, seen]
        share = (U / values[seen]) @ (U.T @ self.G[j, i])
        left = self.G[i, i] - share @ self.G[j, i]
        return np.asarray(share) if left < _SAME else None

    def _combination(self, i: int, others: list[int], share: np.ndarray) -> str:
        """Write the sum of parameter i and its single counterpart that readings depend on."""
        factor = share[0] * self.scale[i] / self.scale[others[0]]
        sign = "+" if factor > 0 else "-"
        times = "" if abs(abs(factor) - 1.0) < 1e-3 else f"{abs(factor):.3g} x "
        return f"{self.names[others[0]]} {sign} {times}{self.names[i]}"
