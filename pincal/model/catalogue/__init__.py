"""The catalogue: physical effects beyond the geometric and elastic model, each one small class.

Example:
    >>> from pincal.model.chain import Chain
    >>> from pincal.robot.robot import Robot
    >>> chain = Chain.of(Robot.from_urdf("ur10"))
    >>> [parameter.name for parameter in GearEccentricity("elbow_joint").parameters(chain)]
    ['elbow_joint.eccentric_sin1', 'elbow_joint.eccentric_cos1']
"""

from pincal.model.catalogue.bearing_features import BearingPlace, ObliqueBearing
from pincal.model.catalogue.candidates import candidates, untestable
from pincal.model.catalogue.drives import (
    AxisWobble,
    Backlash,
    GearEccentricity,
    GearRatio,
    JointCoupling,
    ServoDroop,
    ShortOfTarget,
    ThermalOffset,
)
from pincal.model.catalogue.elasticity import (
    BaseElasticity,
    GravityCompensator,
    Hysteresis,
    LoadBacklash,
    NonlinearElasticity,
    PayloadError,
)
from pincal.model.catalogue.environment import BaseDrift, MeasurementScale, ThermalExpansion
from pincal.model.catalogue.instrument import (
    InstrumentAzimuth,
    InstrumentElevation,
    InstrumentRange,
    InstrumentStretch,
    InstrumentTilt,
)
from pincal.model.catalogue.link_bending import LinkBending
from pincal.model.catalogue.masses import LinkMass
from pincal.model.catalogue.motion import FrictionWindup, InstrumentClock, JointLag
from pincal.model.catalogue.relaxation import JointCreep, ThermalGrowth
from pincal.model.catalogue.remainder import SmoothRemainder
from pincal.model.catalogue.ripple import EncoderSubdivision, GearRipple
from pincal.model.catalogue.transmission import TransmissionError
from pincal.model.catalogue.unnamed import Unnamed
from pincal.model.effect import Effect
from pincal.model.effect_registry import EFFECTS

# In the order in which reports list the effects of one joint, and then those of the whole arm.
_IN_ORDER: tuple[type[Effect], ...] = (
    GearRatio,
    TransmissionError,
    JointCoupling,
    Backlash,
    ShortOfTarget,
    ThermalOffset,
    JointCreep,
    ServoDroop,
    JointLag,
    FrictionWindup,
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
    InstrumentStretch,
    InstrumentClock,
    Unnamed,
    SmoothRemainder,
)
for _effect in _IN_ORDER:
    EFFECTS.register(_effect)

__all__ = ["candidates", "untestable"]
__all__ += [_effect.__name__ for _effect in _IN_ORDER]
