"""What happens at the far end of a link: where it is, what pulls there, and how a chain moves it."""

from __future__ import annotations

import numpy as np

from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, nominal_moments
from pincal.model.effect import Term
from pincal.model.places import moment_axes

# Sine of the twist between two axes from which a shift along the first moves the second across the link.
_TWISTED = 0.5
# Sine below which a shift along the first axis would have to be fifty times the one that it makes.
_HARDLY_TWISTED = 0.02
# A link shorter than this is no lever: what turns it to shift its end by hundredths of a millimetre would not be small [m].
_SHORT = 1e-3


def link_span(chain: Chain, i: int) -> np.ndarray:
    """Return the way from joint i to the next, as the URDF places them, in the axes at the end of link i [m]."""
    d, a, alpha = (float(chain.nominal[chain.joint(i, symbol)]) for symbol in ("d", "a", "alpha"))
    along = d - chain.height_on_axis(i)
    return np.array([a, along * np.sin(alpha), along * np.cos(alpha) + chain.height_on_axis(i + 1)])


def loads_at_end(chain: Chain, conditions: Conditions, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Return force and moment of all beyond link i, about where the URDF places joint i + 1, each of shape (N, 3).

    On the nominal arm, in the axes at the end of link i [N, N m].
    """
    force = (chain.robot.masses[i + 1 :].sum() + conditions.payload)[:, None] * gravity_before(chain, conditions, i + 1)
    own = nominal_moments(chain, conditions)[:, 3 * (i + 1) : 3 * (i + 2)]
    moment = np.einsum("nab,nb->na", moment_axes(chain, conditions, i + 1), own)
    above = chain.height_on_axis(i + 1) - chain.bearing_heights[i + 1]
    return force, moment - np.cross([0.0, 0.0, above], force)


def gravity_before(chain: Chain, conditions: Conditions, i: int) -> np.ndarray:
    """Return the acceleration of gravity on the nominal arm in the axes before joint i, shape (N, 3) [m/s^2].

    They are those at the end of the link that carries the joint; with ``i`` the number of joints, those of the tip's link.
    """
    g = np.broadcast_to(chain.robot.frames.T_base_first[:3, :3].T @ chain.gravity, (len(conditions), 3))
    for j in range(i):
        angles = {symbol: chain.nominal[chain.joint(j, symbol)] for symbol in ("s_x", "s_y", "theta", "alpha")}
        turned = angles["theta"] + (conditions.q[:, j] if chain.robot.joint_types[j] != "prismatic" else 0.0)
        for axis, angle in ((0, angles["s_x"]), (1, angles["s_y"]), (2, turned), (0, angles["alpha"])):
            g = _turned_back(g, axis, angle)
    return g


def _turned_back(vectors: np.ndarray, axis: int, angle: float | np.ndarray) -> np.ndarray:
    """Return vectors, shape (N, 3), in axes that are turned by an angle about one of their own."""
    c, s = np.cos(angle), np.sin(angle)
    y, z = (axis + 1) % 3, (axis + 2) % 3
    out = np.array(vectors, np.result_type(vectors, c))
    out[:, y], out[:, z] = c * vectors[:, y] + s * vectors[:, z], c * vectors[:, z] - s * vectors[:, y]
    return out


def end_terms(chain: Chain, i: int, *, shift: np.ndarray, turn: np.ndarray | None = None) -> tuple[Term, ...]:
    """Return the terms of one parameter that moves and turns the far end of link i, where the URDF has joint i + 1.

    The chain turns the end about the foot of the common normal, and moves it along the axes of both joints and along the
    normal. Across parallel axes it has no shift: there the link turns about its joint, and its end back again.

    Args:
        chain: the chain.
        i: the joint that moves the link; not the last.
        shift: shape (N, 3), in the axes at the end of the link [m].
        turn: shape (N, 3), likewise [rad]; default: none.
    """
    if turn is not None:
        shift = shift - np.cross(turn, [0.0, 0.0, chain.height_on_axis(i + 1)])
    alpha, a = (float(chain.nominal[chain.joint(i, symbol)]) for symbol in ("alpha", "a"))
    sine, cosine = np.sin(alpha), np.cos(alpha)
    x, y, z = shift.T
    bases = {("a", i): x}
    if abs(sine) > _TWISTED or (abs(a) <= _SHORT and abs(sine) > _HARDLY_TWISTED):
        bases[("d", i)] = y / sine
        bases[("d", i + 1)] = z - y * cosine / sine
    elif abs(a) > _SHORT:
        back = y / (a * cosine)
        bases[("theta", i)] = back
        bases[("d", i + 1)] = z + y * sine / cosine
        turn = (0.0 if turn is None else turn) - back[:, None] * np.array([0.0, sine, cosine])
    else:
        bases[("d", i + 1)] = z
    if turn is not None:
        bases |= {("s_x", i + 1): turn[:, 0], ("s_y", i + 1): turn[:, 1], ("theta", i + 1): turn[:, 2]}
    return tuple(Term(0, chain.joint(j, symbol), np.ascontiguousarray(basis)) for (symbol, j), basis in bases.items())
