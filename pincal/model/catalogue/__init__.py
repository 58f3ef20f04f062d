"""The catalogue: physical effects beyond the geometric and elastic model, each one small class.

Example:
    >>> from pincal.model.chain import Chain
    >>> from pincal.robot.robot import Robot
    >>> chain = Chain.of(Robot.from_urdf("ur10"))
    >>> [parameter.name for parameter in GearEccentricity("elbow_joint").parameters(chain)]
    ['elbow_joint.eccentric_sin1', 'elbow_joint.eccentric_cos1']
"""

# Imported so that model files which hold terms without a name can be read.
import pincal.model.catalogue.unnamed  # noqa: F401
from pincal.model.catalogue.candidates import candidates, untestable
from pincal.model.catalogue.curves import TransmissionError
from pincal.model.catalogue.drives import (
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

__all__ = [
    "AxisWobble",
    "Backlash",
    "BaseDrift",
    "BaseElasticity",
    "GearEccentricity",
    "GearRatio",
    "GravityCompensator",
    "JointCoupling",
    "LinkBending",
    "LoadBacklash",
    "MeasurementScale",
    "NonlinearElasticity",
    "PayloadError",
    "ThermalExpansion",
    "ThermalOffset",
    "TransmissionError",
    "candidates",
    "untestable",
]
