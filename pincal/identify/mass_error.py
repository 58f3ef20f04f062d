r"""Errors of the masses in a URDF: as an effect of the model, and what they add to the uncertainty
of a calibration.

The masses of a URDF are a few per cent off. They deflect the arm through its compliances, which the
parameters of a fit absorb in part. With S' and b' information and gradient of the masses, known to
D and in units of the noise, the parameters of the fit projected out,

.. math:: e_m = m^T S' m + \operatorname{tr} S' C, \qquad C = (S' + D^{-2})^{-1}, \quad m = C b' ,

is what they add to the variance of the rows, summed over the readings. The fit's own parameters add
their effective number.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.identify.criteria import CRITERIA
from pincal.identify.dependence import widened_by
from pincal.identify.equations import Linearised
from pincal.identify.fit import AnyFit, ModelFit
from pincal.identify.problem import extended
from pincal.model import kernels
from pincal.model.chain import Chain
from pincal.model.conditions import MOMENT, Conditions
from pincal.model.effect import Effect, Family, Locus, Term
from pincal.model.kernel_inputs import Layout, Payload, Values
from pincal.model.loops import borne_moments
from pincal.model.model import Model
from pincal.parameters import Parameter
from pincal.robot.link_path import above


@dataclass(frozen=True)
class MassError(Effect):
    """Errors of mass and first moment of each link, which act through the present compliances.

    The static moments are linear in mass and first moment of mass, so one evaluation per parameter
    gives the basis: gamma_l += k_l d n_l / d parameter. They are computed with the nominal
    geometry, which is accurate enough and serves all fits of one table.

    Attributes:
        compliances: compliant coordinates, each with its moment and its k [rad/(N m)].
        links: the joints of the links whose masses are from the URDF; other masses are parameters
            of the model.
    """

    compliances: tuple[tuple[int, int, float], ...]
    links: tuple[int, ...]
    name: ClassVar[str] = "mass_error"
    meaning: ClassVar[str] = "masses and centres of mass of the links differ from the URDF"
    family: ClassVar[Family] = Family.LOAD

    @classmethod
    def of(cls, model: Model, values: np.ndarray) -> MassError | None:
        """Return the effect for a model's compliances; None for a rigid model, or if all masses are
        its parameters.
        """
        chain = model.chain
        found = {body.joint for body in model.bodies}
        links = tuple(i for i in range(chain.robot.n_joints) if i not in found)
        n = chain.robot.n_joints
        bent = []
        for span, effect in zip(model.spans, model.effects, strict=True):
            if effect.family is Family.ELASTICITY:
                terms = effect.terms(chain, Conditions.at(np.zeros((1, n))), np.ones((1, 3 * n)))
                own = values[span]
                bent += [
                    (t.coordinate, t.moment, float(own[t.parameter]))
                    for t in terms
                    if t.moment is not None
                ]
        compliances = tuple(entry for entry in bent if entry[2])
        return cls(compliances, links) if compliances and links else None

    @property
    def locus(self) -> Locus:
        """All elastic rotations of the arm."""
        return Locus(acts_on="gamma", follows=MOMENT)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Relative error of mass, and of the first moment along x, y, z in units of mass times link
        size.
        """
        return tuple(
            Parameter(
                f"{joint}.{symbol}",
                "1",
                self.name,
                0.0,
                CRITERIA.mass if symbol == "mass" else CRITERIA.centre,
            )
            for joint in (chain.robot.joint_names[i] for i in self.links)
            for symbol in ("mass", "mc_x", "mc_y", "mc_z")
        )

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        """Add each compliance times the change of its moment."""
        known = chain.kept.about("moments of links", chain, conditions)
        terms = list[Term]()
        for p, i in enumerate(self.links):
            if i not in known:
                known[i] = tuple(_moments_of_link(chain, conditions, i))
            for c, change in enumerate(known[i]):
                terms += [
                    Term(4 * p + c, at, k * change[m])
                    for at, m, k in self.compliances
                    if m // 3 <= i
                ]
        return tuple(terms)


def _moments_of_link(chain: Chain, conditions: Conditions, i: int) -> Iterator[np.ndarray]:
    """Yield the static moments, shape (3 n, N), of one unit of each parameter of link i alone, on
    the nominal arm.
    """
    robot = chain.robot
    drives = chain.drives
    slot = np.full(len(chain.nominal), -1)
    slot[drives] = np.arange(len(drives))
    values = Values(
        chain.nominal.copy(), slot, np.ascontiguousarray((conditions.q + chain.nominal[drives]).T)
    )
    masses = np.zeros_like(robot.masses)
    centres = np.zeros_like(robot.centres)
    masses[i] = robot.masses[i]
    no_load = Payload(np.zeros(len(conditions)), np.zeros(3))
    layout = _under(chain, i)

    def moments_at(centre: np.ndarray) -> np.ndarray:
        centres[i] = centre
        laden = layout._replace(masses=masses, centres=centres)
        static = kernels.static_moments(laden, values, no_load, bending=True)
        return borne_moments(chain, values, static)

    straight = moments_at(np.zeros(3))
    size = max(
        float(np.linalg.norm(robot.centres[i])),
        0.2 * float(np.hypot(*robot.frames.parameters[i, 3:5])),
        0.02,
    )
    along = [moments_at(size * axis) - straight for axis in np.eye(3)]
    yield straight + sum(part * of for part, of in zip(robot.centres[i] / size, along, strict=True))
    yield from along


def _under(chain: Chain, i: int) -> Layout:
    """Return the layout of a chain with the joints that carry link i alone, and nothing at the tip:
    no other joint bears it.
    """
    carrying = np.array(above(i, chain.robot.parents))
    bears = np.isin(np.arange(chain.robot.n_joints), carrying)
    return chain.layout._replace(acting=carrying, bears=bears, tip_joint=-1)


def variance_of_masses(fit: ModelFit) -> float:
    """Return what errors of masses add to the variance of the rows, summed over readings, in units
    of the noise.
    """
    masses = MassError.of(*fit.arm)
    if masses is None:
        return 0.0
    problem, known = extended(fit.problem, [masses])
    count = len(problem.parameters)
    values = np.zeros(count)
    free = np.ones(count, bool)
    sizes = np.array([parameter.size for parameter in problem.parameters])
    values[known] = fit.values
    free[known] = fit.solution.free
    sizes[known] = fit.priors.sizes
    posterior = Linearised(problem, values, free, fit.solution.weights, sizes).posterior(
        fit.solution.sigma
    )
    names = {parameter.name for parameter in masses.parameters(fit.problem.chain)}
    shared = np.flatnonzero(free & problem.is_shared)
    at = np.flatnonzero([problem.parameters[i].name in names for i in shared])
    D = posterior.sizes[at]
    C = posterior.determined[np.ix_(at, at)] / np.outer(D, D)
    most_probable = posterior.step[at] / D
    S = np.linalg.inv(C) - np.eye(len(C))
    return float(most_probable @ S @ most_probable + np.sum(S * C))


def with_masses_unsure(fit: AnyFit) -> AnyFit:
    """Return a fit with a covariance that includes errors of the masses in the URDF, on average
    over its rows.
    """
    beyond = variance_of_masses(fit)
    return widened_by(fit, 1.0 + beyond / max(fit.solution.effective, 1.0)) if beyond else fit
