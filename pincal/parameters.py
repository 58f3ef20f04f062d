"""Named parameters: what a fit may find, whoever owns it."""

from __future__ import annotations

from dataclasses import dataclass

# Coordinates of a frame: position [m] and small angles [rad].
FRAME_SYMBOLS = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class Parameter:
    """One number that a fit may find.

    Attributes:
        name: ``<element>.<symbol>``, e.g. ``joint_2.s_x``.
        unit: "rad", "m" or "rad/(N m)".
        effect: name of the effect that owns it.
        nominal: what the URDF says; a fit finds the deviation from it.
        size: how far it typically moves its coordinate [rad or m]; inf for frames that are anywhere.
    """

    name: str
    unit: str
    effect: str
    nominal: float
    size: float
