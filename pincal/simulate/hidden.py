"""The catalogue of hidden effects, by the names that discovery reports."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from pincal.errors import BadInputError, nearest_first
from pincal.simulate import drive, elastic, surroundings, tracker
from pincal.simulate.effect import HiddenEffect

HIDDEN_EFFECTS: dict[str, type[HiddenEffect]] = {
    kind.effect: kind
    for kind in (
        elastic.JointElasticity,
        elastic.BearingElasticity,
        elastic.NonlinearElasticity,
        elastic.LinkBending,
        elastic.BaseElasticity,
        elastic.GravityCompensator,
        surroundings.PayloadError,
        drive.JointOffset,
        drive.GearEccentricity,
        drive.GearRipple,
        drive.EncoderSubdivision,
        drive.TransmissionError,
        drive.GearRatio,
        drive.JointCoupling,
        drive.AxisWobble,
        drive.Backlash,
        drive.ShortOfTarget,
        elastic.LoadBacklash,
        elastic.Hysteresis,
        elastic.ServoDroop,
        surroundings.ThermalExpansion,
        surroundings.ThermalGrowth,
        drive.ThermalOffset,
        drive.JointCreep,
        surroundings.BaseDrift,
        tracker.MeasurementScale,
        tracker.InstrumentAzimuth,
        tracker.InstrumentElevation,
        tracker.InstrumentTilt,
        tracker.InstrumentRange,
        drive.JointScatter,
        drive.JointLag,
        drive.FrictionWindup,
    )
}


def hidden_effect(name: str, **values: Any) -> HiddenEffect:
    """Make a hidden effect from its name, a key of ``HIDDEN_EFFECTS``, and its fields.

    Raises:
        BadInputError: If there is no such effect, or it has no such field.

    Example:
        >>> hidden_effect("backlash", joint="joint_2", size=2e-4)
        Backlash(joint='joint_2', size=0.0002)
    """
    if name not in HIDDEN_EFFECTS:
        near = ", ".join(nearest_first([name], HIDDEN_EFFECTS))
        raise BadInputError(f"effect {name!r}: unknown; expected one of {near}")
    kind = HIDDEN_EFFECTS[name]
    known = [field.name for field in fields(kind)]
    if unknown := sorted(set(values) - set(known)):
        raise BadInputError(f"{name} has no {', '.join(unknown)}; it has {', '.join(known)}")
    try:
        return kind(**values)
    except TypeError as error:
        raise BadInputError(f"{name}: {error}; it has {', '.join(known)}") from error
