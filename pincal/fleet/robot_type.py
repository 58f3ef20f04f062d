"""A type of robot: what its machines have in common, how far they differ, and which machines do not
belong to it.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from pincal.calibration.checked_fit import fitted
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.information import geometry_of
from pincal.errors import BadInputError, ModelFileError
from pincal.fleet.evidence import (
    Forms,
    in_prior_units,
    least_chance,
    log_ratios,
    regular,
    scores,
    times_farther,
)
from pincal.fleet.fleet_numbers import TYPES
from pincal.fleet.machines import Gathered, Machine, gathered, kinds_of
from pincal.fleet.population import Population, population_of
from pincal.identify.calibrate import Tables
from pincal.identify.options import Options
from pincal.io.arrays import ArrayShape, Numbers, Packed, Record, packed_matrix
from pincal.io.entries import ParameterEntry, plain, restoring
from pincal.io.strict_json import Fault, FileKind, read_json, write_json
from pincal.model.catalogue.masses import with_masses
from pincal.model.chain import Chain
from pincal.model.effect import Effect
from pincal.model.model import Model
from pincal.parameters import Covariance, Estimate, Parameter, root_of
from pincal.robot.robot import Robot
from pincal.thresholds import Scale

# Upper bound on the variance of log variances, however few the machines; logarithm of the factor on
# standard deviations per unit of it, so that 95 % of further machines are within 1.96 of them.
_LOOSEST: Scale = 2.0
_WIDER: Scale = 0.35
# Rounding of a covariance with unit diagonal, and of its eigenvalues.
_ROUNDED: Scale = 1e-9
_INDEFINITE: Scale = 1e-6
EVERYTHING = "all"
"""Stands for more than one element in which a machine differs."""

_FILE = FileKind("a type", ModelFileError, whole="a file written by pincal fleet learn")


@dataclass(frozen=True, eq=False)
class Membership:
    """How a machine compares with its type.

    Attributes:
        machine: its name.
        p_value: of its deviation, in any element or in all, for machines of the type.
        probability: that it is like the others.
        off: elements (joints) in which it differs, :data:`EVERYTHING` for more than one; empty if
            it is like the others.
        times: factor on the variances of its prior: some machines are farther from the mean than
            others, as 8 poses show.
    """

    machine: str
    p_value: float
    probability: float
    off: tuple[str, ...]
    times: float = 1.0

    @property
    def is_usual(self) -> bool:
        """Whether its prior is the one of any machine of the type."""
        return not self.off and self.times == 1.0


class RobotType(Record, frozen=True, kw_only=True):
    """The machines of a type as a normal distribution of their parameters; its file contains no
    single machine.

    Attributes:
        format: kind of the file.
        format_version: 1.
        robot: name of the arm.
        geometry: checksum of its nominal geometry (CRC-32 of its link frames, rounded to 1e-9).
        entries: the P parameters; values are deviations from their nominals.
        priors: shape (P,), standard deviations of their priors without a type [their own units].
        mean: shape (P,), of the mean machine.
        covariance: shape (P, P), of machines about the mean.
        mean_covariance: shape (P, P), of the mean.
        spread_variance: shape (P,), variance of the logarithm of each variance: the uncertainty of
            the spread.
        seen: shape (P, P), projector on directions that the machines determine, parameters in units
            of their priors; along all others, such as a joint offset equivalent to a rotation of
            the base, the priors hold.
        machines: number of machines.
        hit: fraction of them that were hit or are of another kind.
        provenance: version of pincal, time, command, input files with their SHA-256.
    """

    format: Literal["pincal-type"]
    format_version: Literal[1]
    robot: str
    geometry: int
    entries: Annotated[tuple[ParameterEntry, ...], ArrayShape("parameters")]
    priors: Annotated[Numbers, ArrayShape("parameters")]
    mean: Annotated[Numbers, ArrayShape("parameters")]
    covariance: Annotated[Packed, ArrayShape("parameters", "parameters", write=packed_matrix)]
    mean_covariance: Annotated[Packed, ArrayShape("parameters", "parameters", write=packed_matrix)]
    spread_variance: Annotated[Numbers, ArrayShape("parameters")]
    seen: Annotated[Packed, ArrayShape("parameters", "parameters", write=packed_matrix)]
    machines: int
    hit: float
    provenance: dict[str, Any]

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.names)) < len(self.names):
            raise Fault("lists a parameter twice", "each once", key=".entries")
        counts = self.machines > 0 and 0.0 <= self.hit < 1.0
        sound = counts and np.all(self.priors > 0.0) and np.all(self.spread_variance >= 0.0)
        if not sound or np.any(np.abs(self.mean) > TYPES.absurd * self.priors):
            raise Fault(
                "contains invalid numbers", "standard deviations above 0 and a fraction below 1"
            )
        for name in ("covariance", "mean_covariance"):
            matrix = getattr(self, name)
            size = np.sqrt(np.abs(np.diag(matrix))) + _ROUNDED * self.priors
            unit = matrix / np.outer(size, size)
            is_even = (
                np.all(np.abs(unit - unit.T) <= _ROUNDED)
                and np.linalg.eigvalsh(unit).min(initial=0.0) > -_INDEFINITE
            )
            if not is_even or np.any(size > TYPES.absurd * self.priors):
                raise Fault(
                    "is not a covariance",
                    "a symmetric matrix without negative eigenvalues",
                    key=f".{name}",
                )
        if np.any(np.abs(self.seen @ self.seen.T - self.seen) > _INDEFINITE):
            raise Fault(
                "is not a projection matrix",
                "a symmetric matrix that equals its square",
                key=".seen",
            )

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its parameters."""
        return tuple(entry.parameter() for entry in self.entries)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(entry.name for entry in self.entries)

    @property
    def degrees(self) -> float:
        """Degrees of freedom of the estimated spreads."""
        share = np.diag(self.seen)
        return float(2.0 / max(share @ self.spread_variance / max(share.sum(), 1e-9), 1e-6))

    @property
    def readable(self) -> np.ndarray:
        """Projector on the directions that readings determine, shape (P, P)."""
        return np.asarray(self.seen * np.outer(self.priors, 1.0 / self.priors))

    @property
    def determined(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean, covariance of the mean and covariance of machines, along the directions that
        readings determine.
        """
        known = self.readable
        return (
            known @ self.mean,
            known @ self.mean_covariance @ known.T,
            known @ self.covariance @ known.T,
        )

    def drawn(self, robot: Robot, rng: np.random.Generator) -> np.ndarray:
        """Return the parameters of a further machine, shape (P,), drawn along the directions that
        readings determine.

        Raises:
            BadInputError: if the arm has another nominal geometry.
        """
        self.require(robot.name, geometry_of(robot))
        # The root is taken before the projection, whose rounding makes zero variances negative.
        apart = root_of(self.mean_covariance + self.covariance) @ rng.standard_normal(
            len(self.mean)
        )
        return np.asarray(self.readable @ (self.mean + apart))

    def require(self, robot: str, geometry: int) -> None:
        """Refuse an arm of another nominal geometry.

        Raises:
            BadInputError: naming both.
        """
        if geometry != self.geometry:
            raise BadInputError(
                f"the type describes {self.robot}, but {robot} has a different nominal "
                "geometry; expected the same URDF, "
                "base and tip, and the same robots of a cell (pincal calibrate --beside; "
                "fleet add takes its model.json)"
            )

    def prior(
        self, *, names: Collection[str] | None = None, member: Membership | None = None
    ) -> Estimate:
        """Return the prior of a further machine: ``Options.earlier`` of its calibration.

        Args:
            names: parameters of its model; default: all. The others are uncorrelated with these, so
                that a model without them is not conditioned on their being zero.
            member: comparison of the machine with the type: the prior is wider if it is farther
                from the mean than others, and includes the prior without a type in elements that
                differ.
        """
        mean, covariance = self._further(member)
        if names is not None:
            here = np.array([name in names for name in self.names])
            covariance *= here[:, None] == here
        scale = self.priors
        found = Covariance.of(covariance * np.outer(scale, scale))
        return Estimate(self.parameters, mean * scale, np.ones(len(scale), bool), found, scale)

    def prior_of(
        self, robot: Robot, effects: tuple[Effect, ...], member: Membership | None = None
    ) -> Estimate:
        """Return the prior of a further machine for a model of an arm with these effects.

        Raises:
            BadInputError: if the arm has another nominal geometry.
        """
        self.require(robot.name, geometry_of(robot))
        return self.prior(
            names=Model(Chain.of(robot), with_masses(robot, effects)).names, member=member
        )

    def _further(self, member: Membership | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and covariance of a further machine in units of the priors, including the
        uncertainty of both.
        """
        scale = np.outer(self.priors, self.priors)
        wider = np.exp(_WIDER * np.minimum(self.spread_variance, _LOOSEST))
        covariance = (self.covariance * np.outer(wider, wider) + self.mean_covariance) / scale
        if member is not None:
            wide = np.array(
                [EVERYTHING in member.off or p.element in member.off for p in self.parameters],
                float,
            )
            covariance = member.times * covariance + np.diag(wide)
        covariance = self.seen @ covariance @ self.seen + np.eye(len(scale)) - self.seen
        return self.seen @ (self.mean / self.priors), 0.5 * (covariance + covariance.T)

    def judge(self, machine: Machine) -> Membership:
        """Compare a machine from which the type was not learned with the type.

        Raises:
            BadInputError: if it has another nominal geometry.
        """
        self.require(
            f"machine {machine.name!r} ({machine.information.robot})", machine.information.geometry
        )
        found = gathered([machine], like=self.parameters)
        (membership,) = _memberships(found, found.forms, *self._with_own(found), self)
        wider = self._with_own(found, membership)
        q, Q = scores(found.forms, *wider)
        times = times_farther(q[0], Q[0])
        return replace(membership, times=times if times > TYPES.farther else 1.0)

    def _with_own(
        self, found: Gathered, member: Membership | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and root of the covariance of a machine; parameters that the type lacks keep
        their priors.
        """
        mean, covariance = self._further(member)
        P = len(mean)
        own = len(found.parameters)
        whole_mean = np.zeros(own)
        whole = np.eye(own)
        scale = self.priors / found.priors[:P]
        whole_mean[:P] = mean * scale
        whole[:P, :P] = covariance * np.outer(scale, scale)
        return whole_mean, root_of(whole)

    def save(
        self, path: str | os.PathLike[str], *, provenance: dict[str, Any] | None = None
    ) -> None:
        """Write the type to a file, see :func:`load_type`.

        Raises:
            OutputError: if the place can't be written to.
        """
        found = self if provenance is None else msgspec.structs.replace(self, provenance=provenance)
        write_json(path, plain(found), indent=None)


def load_type(path: str | os.PathLike[str]) -> RobotType:
    """Read a type.

    Raises:
        ModelFileError: if the file can't be read, or a value is missing or invalid.
    """
    return read_json(path, RobotType, _FILE, hook=restoring())


@dataclass(frozen=True, eq=False)
class Learned:
    """A type and the machines that it was learned from.

    Attributes:
        type: the type.
        members: comparison of each machine with it, in the order of the machines, one per name.
        values: shape (M, P), the most probable deviations of each machine from the nominal.
        sigma: shape (M, P), their standard deviations.
    """

    type: RobotType
    members: tuple[Membership, ...]
    values: np.ndarray
    sigma: np.ndarray


def learn_type(machines: Iterable[Machine]) -> Learned:
    """Learn a type from information on its machines, by empirical Bayes (see
    :mod:`pincal.fleet.population`).

    Each machine is weighted by the information of its readings: few poses, other sensors and
    additional parameters are welcome. A single machine is enough to begin with. The result depends
    neither on the order of the machines nor on their distribution over files.

    Raises:
        BadInputError: for no machine, or machines with different nominal geometries.
    """
    given = tuple(machines)
    order = sorted(range(len(given)), key=lambda k: given[k].information.form.g.tobytes())
    found = gathered(given[k] for k in order)
    learned = _type_of(found, population_of(found.forms, kinds_of(found.parameters)))
    mean, covariance = learned._further()
    root = root_of(covariance)
    members = _memberships(found, found.forms, mean, root, learned)
    values, sigma = _points(found.forms, mean, root)
    # Back to the order in which machines were given.
    first = dict[object, int]()
    for k, machine in enumerate(given):
        first.setdefault(machine.name or id(machine), k)
    places = np.argsort([first[machine.name or id(machine)] for machine in found.machines])
    return Learned(
        learned,
        tuple(members[k] for k in places),
        values[places] * found.priors,
        sigma[places] * found.priors,
    )


def _type_of(found: Gathered, population: Population) -> RobotType:
    """Return the type of machines of a population, in their own units."""
    scale = np.outer(found.priors, found.priors)
    return RobotType(
        format="pincal-type",
        format_version=1,
        robot=found.robot,
        geometry=found.geometry,
        entries=tuple(map(ParameterEntry.of_parameter, found.parameters)),
        priors=found.priors,
        mean=population.mean * found.priors,
        covariance=population.covariance * scale,
        mean_covariance=population.mean_covariance * scale,
        spread_variance=population.spread_variance,
        seen=population.seen,
        machines=len(found.machines),
        hit=population.hit,
        provenance={},
    )


def _memberships(
    found: Gathered, forms: Forms, mean: np.ndarray, root: np.ndarray, of: RobotType
) -> list[Membership]:
    """Compare machines with a population of this mean and root of its covariance."""
    members = list[Membership]()
    elements = list(dict.fromkeys(p.element for p in found.parameters))
    labels = [*elements, EVERYTHING] if len(elements) > 1 else elements
    for rows, part in forms.pieces():
        q, Q = in_prior_units(*scores(part, mean, root), root)
        logs = log_ratios(part, q, Q)
        like = regular(logs, max(of.hit, TYPES.least_hit))
        p = least_chance(q, Q, root, part.ways[: len(elements)], of.degrees)
        for k, machine in enumerate(found.machines[rows]):
            share = np.exp(logs[:, k] - logs[:, k].max())
            off = tuple(
                label
                for label, s in zip(labels, share / share.sum(), strict=True)
                if s > TYPES.share
            )
            is_off = like[k] < TYPES.unlikely and p[k] < TYPES.unusual
            members.append(
                Membership(machine.name, float(p[k]), float(like[k]), off if is_off else ())
            )
    return members


def _points(forms: Forms, mean: np.ndarray, root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the most probable deviations of machines and their standard deviations, shape (M, P)
    each.
    """
    values = np.empty_like(forms.g)
    sigma = np.empty_like(forms.g)
    for rows, part in forms.pieces():
        q, Q = scores(part, mean, root)
        values[rows] = mean + q @ root.T
        variance = np.sum((root @ (np.eye(len(mean)) - Q)) * root, axis=2)
        sigma[rows] = np.sqrt(np.maximum(variance, 0.0))
    return values, sigma


def calibrate_of_type(
    robot: Robot,
    measurements: Tables,
    of: RobotType,
    options: Options | None = None,
    *,
    name: str = "",
) -> tuple[FittedRobot, Membership]:
    """Calibrate a machine of a known type, with a wider prior if its rows show that it is not like
    the others.

    Args:
        robot: the arm, with the nominal geometry of the type.
        measurements: its rows, as :func:`pincal.calibrate` takes them.
        of: the type.
        options: how to calibrate.
        name: of the machine.

    Returns:
        The fit, and the comparison of the machine with its type.

    Raises:
        BadInputError: if the robot has another nominal geometry.
        MeasurementError: as :func:`pincal.calibrate`.
    """
    options = Options() if options is None else options
    # With what the type tells, too few rows to tell a mistake in the table from a deviation do.
    fit = fitted(robot, measurements, replace(options, earlier=of.prior_of(robot, options.effects)))
    # A deviation that the prior excludes inflates the noise, so that nothing is significant: then
    # judged without the prior.
    is_fair = fit.fit.is_declared and fit.solution.cost < TYPES.fits
    fair = fit if is_fair else fitted(robot, measurements, options)
    member = of.judge(Machine.of(fair.fit, name))
    if not member.is_usual:
        wider = of.prior_of(robot, options.effects, member)
        fit = fitted(robot, measurements, replace(options, earlier=wider))
    return fit, member
