"""The catalogue: physical effects beyond the geometric and elastic model, each one small class.

Example:
    >>> from pincal.model.chain import Chain
    >>> from pincal.robot.robot import Robot
    >>> chain = Chain.of(Robot.from_urdf("ur10"))
    >>> [parameter.name for parameter in GearEccentricity("elbow_joint").parameters(chain)]
    ['elbow_joint.eccentric_sin1', 'elbow_joint.eccentric_cos1']
"""

from pincal.model.catalogue.bearings import BearingPlace, ObliqueBearing
from pincal.model.catalogue.candidates import candidates, untestable
from pincal.model.catalogue.curves import TransmissionError
from pincal.model.catalogue.drives import (
    AxisWobble,
    Backlash,
    GearEccentricity,
    GearRatio,
    JointCoupling,
    ShortOfTarget,
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
from pincal.model.catalogue.friction import Hysteresis, ServoDroop
from pincal.model.catalogue.instrument import InstrumentAzimuth, InstrumentElevation, InstrumentRange, InstrumentTilt
from pincal.model.catalogue.masses import LinkMass
from pincal.model.catalogue.settling import JointCreep, ThermalGrowth
from pincal.model.catalogue.tones import EncoderSubdivision, GearRipple
from pincal.model.catalogue.unnamed import Unnamed
from pincal.model.registry import EFFECTS

__all__ = [
    "AxisWobble",
    "Backlash",
    "BaseDrift",
    "BaseElasticity",
    "BearingPlace",
    "EncoderSubdivision",
    "GearEccentricity",
    "GearRatio",
    "GearRipple",
    "GravityCompensator",
    "Hysteresis",
    "InstrumentAzimuth",
    "InstrumentElevation",
    "InstrumentRange",
    "InstrumentTilt",
    "JointCoupling",
    "JointCreep",
    "LinkBending",
    "LinkMass",
    "LoadBacklash",
    "MeasurementScale",
    "NonlinearElasticity",
    "ObliqueBearing",
    "PayloadError",
    "ServoDroop",
    "ShortOfTarget",
    "ThermalExpansion",
    "ThermalGrowth",
    "ThermalOffset",
    "TransmissionError",
    "Unnamed",
    "candidates",
    "untestable",
]

# In the order in which reports list the effects of one joint, and then those of the whole arm.
for _effect in (
    GearRatio,
    TransmissionError,
    JointCoupling,
    Backlash,
    ShortOfTarget,
    ThermalOffset,
    JointCreep,
    ServoDroop,
    BaseElasticity,
    PayloadError,
    ThermalExpansion,
    ThermalGrowth,
    LinkMass,
    NonlinearElasticity,
    LoadBacklash,
    Hysteresis,
    GravityCompensator,
    GearEccentricity,
    GearRipple,
    EncoderSubdivision,
    AxisWobble,
    ObliqueBearing,
    BearingPlace,
    LinkBending,
    BaseDrift,
    MeasurementScale,
    InstrumentAzimuth,
    InstrumentElevation,
    InstrumentTilt,
    InstrumentRange,
    Unnamed,
):
    EFFECTS.register(_effect)
