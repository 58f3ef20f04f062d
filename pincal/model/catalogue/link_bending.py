"""Bending of a link: the load at its far end, and the chain's coordinates that move this end."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pincal.errors import BadInputError
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, PoseSet, nominal_moments
from pincal.model.effect import Candidate, Discoverable, Family, Locus, Term
from pincal.model.effect_bases import joint_index, moment_axes, parameters_of
from pincal.model.effect_numbers import SHOWN
from pincal.model.effects import BENDING_SIZE
from pincal.parameters import Parameter
from pincal.robot.link_path import above
from pincal.thresholds import Scale

# Sine of the twist between two axes from which a shift along the first axis moves the second across
# the link.
_TWISTED: Scale = 0.5
# Sine below which a shift along the first axis would have to be fifty times its effect.
_HARDLY_TWISTED: Scale = 0.02


@dataclass(frozen=True)
class LinkBending(Discoverable):
    r"""Link that bends like a cantilever from its joint to the next, under the weight of everything
    beyond it.

    The end of a link of length L along u, with force F and moment M across u, rotates (Euler,
    Bernoulli) by

    .. math:: b (L M + L^2/2 \; u \times F), \quad \text{and moves by} \quad
        b (L^2/2 \; M \times u + L^3/3 \; F).

    The link's own weight and different stiffness in its two planes are neglected. Force and moment
    are taken on the nominal arm, since errors of some mm change them by a thousandth.

    Distinguished by:
        a payload far off the link: link bending displaces and rotates its end, a bearing only
        rotates it. Orientation (6D) distinguishes the two in fewer poses.

    Source:
        Euler and Bernoulli's beam; in robots Judd and Knasinski (1990), Lightcap et al. (2008).

    Attributes:
        joint: the joint that moves the link; it must carry exactly one other joint.
    """

    joint: str
    name: ClassVar[str] = "link_bending"
    meaning: ClassVar[str] = "the link itself bends under load"
    family: ClassVar[Family] = Family.LOAD

    @property
    def locus(self) -> Locus:
        return Locus(self.joint, "link")

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        robot = situation.chain.robot
        joints = (
            joint
            for joint in robot.measured_joints
            if robot.next_joint(situation.index(joint)) is not None
        )
        yield from (Candidate(cls(joint)) for joint in joints)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Flexibility b = 1 / (E I) [1/(N m^2)].

        Raises:
            BadInputError: if no joint follows, or several do.
        """
        self._index(chain)
        return parameters_of(self, self.joint, ("bend",), unit="1/(N m^2)", size=BENDING_SIZE)

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        i = self._index(chain)
        k = chain.robot.next_joint(i)
        assert k is not None
        span = _link_span(chain, i, k)
        length = float(np.linalg.norm(span))
        if length < SHOWN.short:
            return ()
        u = span / length
        force, moment = (
            load - np.outer(load @ u, u) for load in _loads_at_end(chain, conditions, k)
        )
        turn = length * moment + length**2 / 2.0 * np.cross(u, force)
        shift = length**2 / 2.0 * np.cross(moment, u) + length**3 / 3.0 * force
        return _end_terms(chain, i, k, shift=shift, turn=turn)

    def _index(self, chain: Chain) -> int:
        i = joint_index(chain, self.joint)
        robot = chain.robot
        if robot.next_joint(i) is None:
            others = ", ".join(
                name for k, name in enumerate(robot.joint_names) if robot.next_joint(k) is not None
            )
            count = "several joints follow" if i in robot.parents else "no joint follows"
            raise BadInputError(
                f"{self.name} of {self.joint}: {count} its link; expected one of {others}"
            )
        return i


def _link_span(chain: Chain, i: int, k: int) -> np.ndarray:
    """Return the vector from joint i to the next, k, as the URDF places them, in the axes at the
    end of link i [m].
    """
    d, a, alpha = (float(chain.nominal[chain.joint(i, symbol)]) for symbol in ("d", "a", "alpha"))
    along = d - chain.height_on_axis(i)
    return np.array([a, along * np.sin(alpha), along * np.cos(alpha) + chain.height_on_axis(k)])


def _loads_at_end(chain: Chain, conditions: Conditions, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return force and moment, shape (N, 3) each, of everything that joint k carries, about its
    origin in the URDF.

    They are taken on the nominal arm at rest, in the axes at the end of the link before it [N, N
    m].
    """
    robot = chain.robot
    conditions = replace(conditions, inertial=None)
    carried = [j for j in range(robot.n_joints) if j == k or robot.carries(k, j)]
    mass = robot.masses[carried].sum() + conditions.payload * float(chain.path.tip_joint in carried)
    force = mass[:, None] * _gravity_before(chain, conditions, k)
    own = nominal_moments(chain, conditions)[:, 3 * k : 3 * (k + 1)]
    moment = np.einsum("nab,nb->na", moment_axes(chain, conditions, k), own)
    # A carriage bears where it is, and the link ends where its track begins.
    travelled = (
        conditions.q[:, k] if robot.joint_types[k] == "prismatic" else np.zeros(len(conditions))
    )
    away = np.zeros((len(conditions), 3), travelled.dtype)
    away[:, 2] = chain.height_on_axis(k) - chain.bearing_heights[k] - travelled
    return force, moment - np.cross(away, force)


def _gravity_before(chain: Chain, conditions: Conditions, k: int) -> np.ndarray:
    """Return the acceleration of gravity on the nominal arm at the end of the link that carries
    joint k, (N, 3) [m/s^2].
    """
    robot = chain.robot
    g = np.broadcast_to(chain.gravity, (len(conditions), 3))
    for j in above(robot.parents[k], robot.parents):
        g = g @ robot.frames.before(j)[:3, :3]
        angles = {
            symbol: chain.nominal[chain.joint(j, symbol)]
            for symbol in ("s_x", "s_y", "theta", "alpha")
        }
        turned = angles["theta"] + (
            conditions.q[:, j] if robot.joint_types[j] != "prismatic" else 0.0
        )
        for axis, angle in (
            (0, angles["s_x"]),
            (1, angles["s_y"]),
            (2, turned),
            (0, angles["alpha"]),
        ):
            g = _turned_back(g, axis, angle)
    return g


def _turned_back(vectors: np.ndarray, axis: int, angle: float | np.ndarray) -> np.ndarray:
    """Return vectors, shape (N, 3), in axes rotated by an angle about one of them."""
    c = np.cos(angle)
    s = np.sin(angle)
    y = (axis + 1) % 3
    z = (axis + 2) % 3
    out = np.array(vectors, np.result_type(vectors, c))
    out[:, y] = c * vectors[:, y] + s * vectors[:, z]
    out[:, z] = c * vectors[:, z] - s * vectors[:, y]
    return out


def _end_terms(
    chain: Chain, i: int, following: int, *, shift: np.ndarray, turn: np.ndarray | None = None
) -> tuple[Term, ...]:
    """Return the terms of one parameter that shifts and rotates the far end of link i, at the joint
    that follows.

    The chain rotates the end about the foot of the common normal, and shifts it along both joint
    axes and the normal. Across parallel axes it can't shift: there the link rotates about its
    joint, and its end back again. ``shift`` [m] and ``turn`` [rad], shape (N, 3) each, are in the
    axes at the end of the link.
    """
    if turn is not None:
        shift = shift - np.cross(turn, [0.0, 0.0, chain.height_on_axis(following)])
    alpha, a = (float(chain.nominal[chain.joint(i, symbol)]) for symbol in ("alpha", "a"))
    sine = np.sin(alpha)
    cosine = np.cos(alpha)
    x, y, z = shift.T
    bases = {("a", i): x}
    if abs(sine) > _TWISTED or (abs(a) <= SHOWN.short and abs(sine) > _HARDLY_TWISTED):
        bases[("d", i)] = y / sine
        bases[("d", following)] = z - y * cosine / sine
    elif abs(a) > SHOWN.short:
        back = y / (a * cosine)
        bases[("theta", i)] = back
        bases[("d", following)] = z + y * sine / cosine
        turn = (0.0 if turn is None else turn) - back[:, None] * np.array([0.0, sine, cosine])
    else:
        bases[("d", following)] = z
    if turn is not None:
        bases |= {
            ("s_x", following): turn[:, 0],
            ("s_y", following): turn[:, 1],
            ("theta", following): turn[:, 2],
        }
    return tuple(
        Term(0, chain.joint(j, symbol), np.ascontiguousarray(basis))
        for (symbol, j), basis in bases.items()
    )
