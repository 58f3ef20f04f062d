"""The true machine: an independent oracle that measures a robot whose errors are known.

The oracle is what tests hold the model against, and shares nothing with it: ``arm``, ``chain``, ``inertia``, ``state``,
``machine``, ``moving``, ``paper_machine``, the effects (``drive``, ``elastic``, ``surroundings``, ``tracker``) and what
sensors read (``lens``, the set-ups, ``session``). The rest plans campaigns for ``pincal simulate``: ``planning``,
``layout``, ``typical``, ``campaign``, ``request``.
"""

from pincal.simulate.arm import Arm, read_arm
from pincal.simulate.calibration_object import CalibrationObject, grid_object, paper_object
from pincal.simulate.camera import EyeInHand, View, plan_views
from pincal.simulate.campaign import Campaign
from pincal.simulate.contact import Contact
from pincal.simulate.drive import (
    AxisWobble,
    Backlash,
    EncoderSubdivision,
    FrictionWindup,
    GearEccentricity,
    GearRatio,
    GearRipple,
    JointCoupling,
    JointCreep,
    JointLag,
    JointOffset,
    JointScatter,
    ShortOfTarget,
    ThermalOffset,
    TransmissionError,
)
from pincal.simulate.effect import HiddenEffect
from pincal.simulate.elastic import (
    BaseElasticity,
    BearingElasticity,
    GravityCompensator,
    Hysteresis,
    JointElasticity,
    LinkBending,
    LoadBacklash,
    NonlinearElasticity,
    ServoDroop,
)
from pincal.simulate.hidden import HIDDEN_EFFECTS, hidden_effect
from pincal.simulate.instrument import Instrument
from pincal.simulate.lens import Lens
from pincal.simulate.machine import TrueMachine
from pincal.simulate.paper_machine import paper_moments, paper_positions, paper_transform
from pincal.simulate.planning import plan_poses
from pincal.simulate.sensors import SENSORS, SetupOptions, draw_setup
from pincal.simulate.setup import SensorSetup
from pincal.simulate.state import Poses
from pincal.simulate.surroundings import BaseDrift, PayloadError, ThermalExpansion, ThermalGrowth
from pincal.simulate.tracker import InstrumentAzimuth, InstrumentElevation, InstrumentRange, InstrumentTilt, MeasurementScale

__all__ = [
    "HIDDEN_EFFECTS",
    "SENSORS",
    "Arm",
    "AxisWobble",
    "Backlash",
    "BaseDrift",
    "BaseElasticity",
    "BearingElasticity",
    "CalibrationObject",
    "Campaign",
    "Contact",
    "EncoderSubdivision",
    "EyeInHand",
    "FrictionWindup",
    "GearEccentricity",
    "GearRatio",
    "GearRipple",
    "GravityCompensator",
    "HiddenEffect",
    "Hysteresis",
    "Instrument",
    "InstrumentAzimuth",
    "InstrumentElevation",
    "InstrumentRange",
    "InstrumentTilt",
    "JointCoupling",
    "JointCreep",
    "JointElasticity",
    "JointLag",
    "JointOffset",
    "JointScatter",
    "Lens",
    "LinkBending",
    "LoadBacklash",
    "MeasurementScale",
    "NonlinearElasticity",
    "PayloadError",
    "Poses",
    "SensorSetup",
    "ServoDroop",
    "SetupOptions",
    "ShortOfTarget",
    "ThermalExpansion",
    "ThermalGrowth",
    "ThermalOffset",
    "TransmissionError",
    "TrueMachine",
    "View",
    "draw_setup",
    "grid_object",
    "hidden_effect",
    "paper_moments",
    "paper_object",
    "paper_positions",
    "paper_transform",
    "plan_poses",
    "plan_views",
    "read_arm",
]
