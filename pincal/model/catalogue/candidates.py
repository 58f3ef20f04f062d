"""Which effects of the catalogue can be tried on given poses, and why the others can't."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pincal.model.catalogue.curves import TransmissionError
from pincal.model.catalogue.drives import (
    ORDERS,
    WOBBLE_FRAMES,
    AxisWobble,
    Backlash,
    GearEccentricity,
    GearRatio,
    JointCoupling,
    ThermalOffset,
)
from pincal.model.catalogue.elasticity import (
    BaseElasticity,
    GravityCompensator,
    LinkBending,
    LoadBacklash,
    NonlinearElasticity,
    PayloadError,
)
from pincal.model.catalogue.environment import BaseDrift, MeasurementScale, ThermalExpansion
from pincal.model.catalogue.places import joint_index, nominal_moments
from pincal.model.chain import Chain
from pincal.model.effects import Conditions, Effect
from pincal.model.model import Model

CURVE_SIZE = 24
# A basis that changes by less than this part of its size is a constant.
_CONSTANT = 1e-9
# Part of the largest moment on the arm below which nobody builds a compensator.
_WORTH_A_SPRING = 0.1


def candidates(chain: Chain, conditions: Conditions) -> tuple[Effect, ...]:
    """Return every effect of the catalogue, joint by joint, that these poses could show.

    Joint and bearing elasticity are not among them: they are effects of the model that a fit starts from.
    """
    return tuple(effect for effect, reason in _judged(chain, conditions) if not reason)


def untestable(chain: Chain, conditions: Conditions) -> tuple[tuple[Effect, str], ...]:
    """Return the other effects of the catalogue, each with the reason in words."""
    return tuple((effect, reason) for effect, reason in _judged(chain, conditions) if reason)


def _judged(chain: Chain, conditions: Conditions) -> Iterator[tuple[Effect, str]]:
    moments = nominal_moments(chain, conditions)
    for effect in _all(chain, conditions, moments):
        yield effect, _reason(effect, chain, conditions, moments)


def _all(chain: Chain, conditions: Conditions, moments: np.ndarray) -> Iterator[Effect]:
    for i, joint in enumerate(chain.robot.joint_names):
        yield from _of_any_joint(chain, conditions.q[:, i], joint)
        if chain.robot.joint_types[i] != "prismatic":
            yield from _of_revolute_joint(joint, moments[:, 3 * i + 2])
        if i + 1 < chain.robot.n_joints:
            yield LinkBending(joint)
    yield BaseElasticity()
    yield PayloadError.over(chain, conditions)
    yield ThermalExpansion()
    yield BaseDrift() if conditions.time is None else BaseDrift.over(conditions.time)
    yield MeasurementScale()


def _of_any_joint(chain: Chain, q: np.ndarray, joint: str) -> Iterator[Effect]:
    yield GearRatio(joint)
    # A joint that stands still is reported as such; its curve only has to have some range.
    yield TransmissionError.over(joint, q if np.ptp(q) else np.array([q[0] - 1.0, q[0] + 1.0]), CURVE_SIZE)
    yield from (JointCoupling(joint, source) for source in chain.robot.joint_names if source != joint)
    yield Backlash(joint)
    yield ThermalOffset(joint)
    yield ThermalExpansion(joint)


def _of_revolute_joint(joint: str, moment: np.ndarray) -> Iterator[Effect]:
    yield NonlinearElasticity(joint)
    yield LoadBacklash.over(joint, moment)
    yield GravityCompensator(joint)
    yield from (GearEccentricity(joint, order) for order in ORDERS)
    yield from (AxisWobble(joint, order, frame) for order in ORDERS for frame in WOBBLE_FRAMES)


def _reason(effect: Effect, chain: Chain, conditions: Conditions, moments: np.ndarray) -> str:
    """Return why an effect can't be tried, empty if it can."""
    if missing := effect.missing(conditions):
        return "; ".join(_lacking(column, conditions) for column in missing)
    if isinstance(effect, Backlash):
        assert conditions.approach is not None
        if not np.ptp(conditions.approach[:, joint_index(chain, effect.joint)]):
            return f"column approach_{effect.joint} is missing or the same in all rows"
    if isinstance(effect, GravityCompensator) and not _is_loaded(moments, joint_index(chain, effect.joint)):
        return f"gravity exerts no moment about the axis of {effect.joint} that could be compensated"
    if effect.uses_moments:
        excited = bool(Model(chain, (effect,)).largest_basis(conditions)[1].any())
        return "" if excited else "gravity exerts no moment about its axis in any pose"
    return "" if isinstance(effect, MeasurementScale) else _standing_still(effect, chain, conditions)


def _lacking(column: str, conditions: Conditions) -> str:
    values = {"temperature": conditions.temperature, "time": conditions.time, "approach": conditions.approach}
    absent = column in values and values[column] is None
    name = "approach_<joint>" if column == "approach" else column
    return f"column {name} is {'missing' if absent else 'the same in all rows'}"


def _is_loaded(moments: np.ndarray, i: int) -> bool:
    return bool(np.abs(moments[:, 3 * i + 2]).max() > _WORTH_A_SPRING * np.abs(moments).max())


def _standing_still(effect: Effect, chain: Chain, conditions: Conditions) -> str:
    bases = [t.basis for t in effect.terms(chain, conditions, None) if t.basis is not None and t.basis.any()]
    if any(np.ptp(basis) > _CONSTANT * np.abs(basis).max() for basis in bases):
        return ""
    if not bases:
        return "nothing in these poses or on this arm that it acts on"
    source = effect.source if isinstance(effect, JointCoupling) else getattr(effect, "joint", None)
    return f"{source} stands still in all poses, so that it is a constant of the geometry"
