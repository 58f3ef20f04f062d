"""What the effects of the catalogue share: joints by name, recorded columns, parameters and moments in other axes."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from pincal.errors import BadInputError, nearest_first
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect, Term
from pincal.parameters import Parameter

# Typical sizes of what an effect does to its coordinate [rad or m]: some tenths of a milliradian or of a millimetre, ratios
# to a thousandth. They are priors where the data can't tell, so the order of magnitude is what counts.
PLAY = 2e-4
WAVE = 3e-4
TILT = 1e-4
GROWTH = 3e-4
RATIO = 1e-3

# Direction cosine below which a moment has no part along an axis: rounding of a URDF's rotations.
_ACROSS = 1e-12


def joint_index(chain: Chain, joint: str) -> int:
    """Return the place of a joint, 0 at the base.

    Raises:
        BadInputError: if the arm has no such joint.
    """
    names = chain.robot.joint_names
    if joint not in names:
        raise BadInputError(f"joint {joint!r}: not on this arm; expected one of {', '.join(nearest_first([joint], names))}")
    return names.index(joint)


def drive_unit(chain: Chain, joint: str) -> str:
    """Return the unit of a joint's position."""
    return chain.robot.joint_units[joint_index(chain, joint)]


def positions(chain: Chain, conditions: Conditions, joint: str) -> np.ndarray:
    """Return the recorded positions of a joint, shape (N,) [rad or m]."""
    return np.asarray(conditions.q[:, joint_index(chain, joint)])


def recorded(effect: Effect, column: str, values: np.ndarray | None) -> np.ndarray:
    """Return a column of conditions.

    Raises:
        BadInputError: if these poses come without it.
    """
    if values is None:
        raise BadInputError(f"{effect.name} needs the column {column}, which these poses do not have; add it")
    return values


def parameters_of(effect: Effect, element: str, symbols: Iterable[str], *, unit: str, size: float) -> tuple[Parameter, ...]:
    """Return parameters of one element that share unit and typical size; each is zero in the nominal robot."""
    return tuple(Parameter(f"{element}.{symbol}", unit, effect.name, 0.0, size) for symbol in symbols)


def drive_terms(chain: Chain, joint: str, bases: Iterable[np.ndarray]) -> tuple[Term, ...]:
    """Return one term a basis, all on the coordinate that the joint's position adds to."""
    drive = int(chain.drives[joint_index(chain, joint)])
    return tuple(Term(p, drive, basis) for p, basis in enumerate(bases))


def waves(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return sine and cosine of angles [rad]."""
    return np.sin(angle), np.cos(angle)


def turning(chain: Chain, conditions: Conditions, i: int) -> np.ndarray:
    """Return the rotations from the axes of joint i after q to those before q, shape (N, 3, 3), by nominal theta."""
    turned = np.zeros((len(conditions), 3, 3), conditions.q.dtype)
    turned_by = conditions.q[:, i] if chain.robot.joint_types[i] != "prismatic" else np.zeros(len(conditions))
    sine, cosine = waves(chain.nominal[chain.joint(i, "theta")] + turned_by)
    turned[:, 0, 0] = turned[:, 1, 1] = cosine
    turned[:, 0, 1], turned[:, 1, 0] = -sine, sine
    turned[:, 2, 2] = 1.0
    return turned


def tilt_terms(
    chain: Chain, conditions: Conditions, joint: str, *, seen_from: str, tilts: Iterable[tuple[int, int, np.ndarray]]
) -> tuple[Term, ...]:
    """Return the terms of tilts of a joint's axis about its bearing.

    Beside the origin of its frame the bearing is where its compliance acts, found there if the data say where; at the origin
    the tilts are s_x and s_y.

    Args:
        chain: the chain.
        conditions: the N poses.
        joint: the joint, one that turns.
        seen_from: the side in whose axes they are: "before" or "after" q.
        tilts: of each its parameter, its axis (0 for x, 1 for y) and its basis, shape (N,).
    """
    i = joint_index(chain, joint)
    side, symbol = (chain.moment_frame, "gamma") if chain.bearing_heights[i] else ("before", "s")
    at = chain.joint(i, f"{symbol}_x"), chain.joint(i, f"{symbol}_y")
    if seen_from == side:
        return tuple(Term(parameter, at[axis], basis) for parameter, axis, basis in tilts)
    turned = turning(chain, conditions, i)
    turned = turned if side == "before" else turned.transpose(0, 2, 1)
    return tuple(Term(p, at[c], turned[:, c, axis] * basis) for p, axis, basis in tilts for c in range(2))


def moment_axes(chain: Chain, conditions: Conditions, i: int) -> np.ndarray:
    """Return the rotations from the axes in which the chain takes joint i's moment to those before q, (N, 3, 3)."""
    if chain.moment_frame == "after":
        return turning(chain, conditions, i)
    return np.broadcast_to(np.eye(3), (len(conditions), 3, 3))


def moment_terms(parameter: int, coordinate: int, i: int, *, axis: np.ndarray, moments: np.ndarray) -> tuple[Term, ...]:
    """Return the terms of one parameter driven by the moment of joint i about an axis: one a component.

    Args:
        parameter: index among the effect's parameters.
        coordinate: index in the chain.
        i: the joint.
        axis: shape (N, 3), the axis in the axes of the moment.
        moments: shape (N, 3 n), static moments [N m].
    """
    return tuple(
        Term(parameter, coordinate, axis[:, c] * moments[:, 3 * i + c], 3 * i + c, axis[:, c].copy())
        for c in range(3)
        if np.abs(axis[:, c]).max(initial=0.0) > _ACROSS
    )
