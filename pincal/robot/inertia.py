"""The masses of an arm's links: what a URDF says of them, whether that is to be believed, and what the shape suggests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# Mass of what moves of an industrial arm, over the length of its links along the joints to the power below [kg/m^2.5]; from
# data sheets of arms from 0.6 m to 3.2 m. Of cobots it is a fifth. It is only where a search starts.
_PER_LENGTH, _GROWTH = 36.0, 2.5
# Part of a data sheet's mass that moves; the rest is the base that the arm stands on.
_MOVING = 0.7
# Length that a link has at least, over that of the arm: flanges are short but weigh.
_SHORTEST = 0.02
# Links that may weigh the same by chance are fewer than these.
_FEWEST_ALIKE = 3


def are_placeholders(masses: Sequence[float]) -> bool:
    """Return whether the masses of links [kg] were only written so that a program reads them: all of them the same.

    The last link may carry a flange that has its own.

    Example:
        >>> are_placeholders([2.0] * 6), are_placeholders([2.0, 2.0, 2.0, 4.0]), are_placeholders([7.8, 12.9, 12.9, 3.9])
        (True, True, False)
    """
    arm = np.asarray(masses if len(masses) == _FEWEST_ALIKE else masses[:-1], float)
    return len(arm) >= _FEWEST_ALIKE and bool(arm[0] > 0.0 and np.allclose(arm, arm[0], rtol=1e-9, atol=0.0))


def guessed_masses(
    masses: np.ndarray, ends: np.ndarray, unknown: np.ndarray, *, total: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return masses, those that are not known told by the shape of the arm, and where the shape has the centres of mass.

    A link weighs in proportion to the length of arm from its joint to the tip, and has its centre between its joint and
    the next. The scale is that of the links whose mass is known, or else of industrial arms of this length.

    Args:
        masses: shape (n,), as far as they are known [kg].
        ends: shape (n + 1, 3), the joints at q = 0 and the tip, in the base frame [m].
        unknown: shape (n,), which links have no mass that is known.
        total: mass of the whole robot with its base, as on a data sheet [kg].

    Returns:
        Masses, shape (n,) [kg], and centres, shape (n, 3), in the base frame [m].
    """
    lengths = np.linalg.norm(np.diff(ends, axis=0), axis=1)
    whole = max(float(lengths.sum()), 1e-3)
    beyond = np.cumsum(np.maximum(lengths, _SHORTEST * whole)[::-1])[::-1]
    if total is not None:
        scale = max(_MOVING * total - masses[~unknown].sum(), 0.0) / beyond[unknown].sum()
    elif unknown.all():
        scale = _PER_LENGTH * whole**_GROWTH / beyond.sum()
    else:
        scale = masses[~unknown].sum() / beyond[~unknown].sum()
    return np.where(unknown, scale * beyond, masses), 0.5 * (ends[:-1] + ends[1:])
