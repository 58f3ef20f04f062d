"""Candidates without a physical name: what depends on one variable and acts in one place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pincal.model.catalogue.unnamed import ActsOn, Unnamed, spline_basis, variable
from pincal.model.chain import Chain
from pincal.model.effects import Conditions

__all__ = ["Unnamed", "generic_candidates", "spline_basis", "variable"]

_SIZE = 8
_ORDERS = (1, 2, 3)
# Places where a curve may break, as fractions of the rows below them.
_PLACES = np.linspace(0.08, 0.92, 22)
_ACROSS: tuple[ActsOn, ...] = ("gamma_x", "gamma_y")
_BEFORE: tuple[ActsOn, ...] = ("s_x", "s_y")
_DRIVE: tuple[ActsOn, ...] = ("drive",)
# A variable that changes by less than this is a constant.
_CONSTANT = 1e-6


def generic_candidates(chain: Chain, conditions: Conditions, joints: Sequence[str]) -> Iterator[Unnamed]:
    """Return what no entry of the catalogue describes: of some joints, what follows a variable.

    A smooth curve of the joint's own position is the catalogue's transmission error, and its waves of order 1 and 2 are
    there too. Waves and products say in few parameters what a curve says in many.
    """
    names = chain.robot.joint_names
    columns = {name: conditions.q[:, i] for i, name in enumerate(names)}
    columns |= {n: c for n, c in (("time", conditions.time), ("temperature", conditions.temperature)) if c is not None}
    moving = {name: column for name, column in columns.items() if np.ptp(column) > _CONSTANT}
    for joint in joints:
        for source, column in moving.items():
            lower, upper = float(column.min()), float(column.max())
            own = source == joint
            for acts_on in (*_ACROSS, *_BEFORE) if own else _DRIVE:
                yield Unnamed(joint, acts_on, source, lower=lower, upper=upper, size=_SIZE)
            if source in names:
                yield from _of_two_joints(joint, source) if not own else _of_one_joint(joint, column)


def _of_two_joints(joint: str, source: str) -> Iterator[Unnamed]:
    for acts_on in (*_DRIVE, *_ACROSS):
        yield from (Unnamed(joint, acts_on, source, "waves", order=order) for order in _ORDERS)
    yield Unnamed(joint, "drive", source, "product")


def _of_one_joint(joint: str, column: np.ndarray) -> Iterator[Unnamed]:
    for acts_on in (*_DRIVE, *_ACROSS, *_BEFORE):
        yield Unnamed(joint, acts_on, joint, "waves", order=3)
    for place in np.quantile(column, _PLACES):
        yield Unnamed(joint, "drive", joint, "step", place=float(place))
        yield Unnamed(joint, "drive", joint, "kink", place=float(place))
