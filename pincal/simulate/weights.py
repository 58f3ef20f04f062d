"""Masses for a machine of which the URDF has none: drawn as a designer might have chosen them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pincal.simulate.machine import TrueMachine

# Mass of an arm of 1 m [kg], and the power of its reach with which it grows.
_MASS, _GROWTH = 45.0, 2.4
# How far masses are from these rules: least and largest factor.
_OF_ARM, _OF_LINK = (0.7, 1.3), (0.6, 1.5)
# Weight of a joint's drive over that of as much link as the arm is long.
_DRIVE = 0.3
# Where a link has its centre: least and largest part of the way to the next joint, and off that way.
_ALONG, _BESIDE = (0.2, 0.6), 0.1


def draw_weights(machine: TrueMachine, joints: Sequence[str], rng: np.random.Generator) -> TrueMachine:
    """Return the machine whose links behind some joints have masses and centres drawn at random.

    Links and drives get lighter towards the tip, as they carry less; where other links have masses, these are the measure.

    Args:
        machine: The machine; its errors of mass are relative to what is drawn.
        joints: Names of the joints whose links have no mass.
        rng: Source of randomness.
    """
    arm, n = machine.nominal, len(machine.names)
    drawn = np.isin(machine.names, joints)
    if not drawn.any():
        return machine
    beyond = np.cumsum(arm.lengths[::-1])[::-1] + 0.05 * arm.reach
    sizes = (_DRIVE * arm.reach + arm.lengths) * beyond * rng.uniform(*_OF_LINK, n)
    known = float(arm.masses[~drawn].sum())
    whole = _MASS * arm.reach**_GROWTH * rng.uniform(*_OF_ARM)
    scale = known / sizes[~drawn].sum() if known else whole / sizes.sum()
    ways = arm.placements[1:, :3, 3] * rng.uniform(*_ALONG, (n, 1))
    ways += np.maximum(arm.lengths, 0.1 * arm.reach)[:, None] * rng.uniform(-_BESIDE, _BESIDE, (n, 3))
    masses = np.where(drawn, scale * sizes, arm.masses)
    return replace(machine, nominal=replace(arm, masses=masses, centres=np.where(drawn[:, None], ways, arm.centres)))
