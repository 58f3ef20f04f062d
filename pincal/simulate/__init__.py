"""The true machine: an independent oracle that measures a robot whose errors are known.

Tests compare the model with the oracle, which shares nothing with it: ``arm``, ``state``,
``inertia``, ``machine``, ``moving``, ``paper_machine``, the effects (``drive``, ``elastic``,
``tracker``) and the sensors (``lens``, the set-ups, ``session``). The rest plans campaigns for
``pincal simulate``: ``planning``, ``typical``, ``request``.
"""

from pincal.simulate.arm import Arm as Arm
from pincal.simulate.camera import CalibrationObject as CalibrationObject
from pincal.simulate.camera import EyeInHand as EyeInHand
from pincal.simulate.camera import View as View
from pincal.simulate.camera import grid_object as grid_object
from pincal.simulate.camera import paper_object as paper_object
from pincal.simulate.camera import plan_views as plan_views
from pincal.simulate.contact import Contact as Contact
from pincal.simulate.drive import AxisWobble as AxisWobble
from pincal.simulate.drive import Backlash as Backlash
from pincal.simulate.drive import EncoderSubdivision as EncoderSubdivision
from pincal.simulate.drive import FrictionWindup as FrictionWindup
from pincal.simulate.drive import GearEccentricity as GearEccentricity
from pincal.simulate.drive import GearRatio as GearRatio
from pincal.simulate.drive import GearRipple as GearRipple
from pincal.simulate.drive import JointCoupling as JointCoupling
from pincal.simulate.drive import JointCreep as JointCreep
from pincal.simulate.drive import JointLag as JointLag
from pincal.simulate.drive import JointOffset as JointOffset
from pincal.simulate.drive import JointScatter as JointScatter
from pincal.simulate.drive import ShortOfTarget as ShortOfTarget
from pincal.simulate.drive import ThermalOffset as ThermalOffset
from pincal.simulate.drive import TransmissionError as TransmissionError
from pincal.simulate.effect import HIDDEN_EFFECTS as HIDDEN_EFFECTS
from pincal.simulate.effect import HiddenEffect as HiddenEffect
from pincal.simulate.elastic import BaseDrift as BaseDrift
from pincal.simulate.elastic import BaseElasticity as BaseElasticity
from pincal.simulate.elastic import BearingElasticity as BearingElasticity
from pincal.simulate.elastic import GravityCompensator as GravityCompensator
from pincal.simulate.elastic import Hysteresis as Hysteresis
from pincal.simulate.elastic import JointElasticity as JointElasticity
from pincal.simulate.elastic import LinkBending as LinkBending
from pincal.simulate.elastic import LoadBacklash as LoadBacklash
from pincal.simulate.elastic import NonlinearElasticity as NonlinearElasticity
from pincal.simulate.elastic import PayloadError as PayloadError
from pincal.simulate.elastic import ServoDroop as ServoDroop
from pincal.simulate.elastic import ThermalExpansion as ThermalExpansion
from pincal.simulate.elastic import ThermalGrowth as ThermalGrowth
from pincal.simulate.instrument import Instrument as Instrument
from pincal.simulate.lens import Lens as Lens
from pincal.simulate.machine import TrueMachine as TrueMachine
from pincal.simulate.paper_machine import paper_moments as paper_moments
from pincal.simulate.paper_machine import paper_positions as paper_positions
from pincal.simulate.paper_machine import paper_transform as paper_transform
from pincal.simulate.planning import plan_poses as plan_poses
from pincal.simulate.request import SENSORS as SENSORS
from pincal.simulate.request import SetupOptions as SetupOptions
from pincal.simulate.request import draw_setup as draw_setup
from pincal.simulate.setup import Campaign as Campaign
from pincal.simulate.setup import SensorSetup as SensorSetup
from pincal.simulate.state import Poses as Poses
from pincal.simulate.tracker import InstrumentAzimuth as InstrumentAzimuth
from pincal.simulate.tracker import InstrumentElevation as InstrumentElevation
from pincal.simulate.tracker import InstrumentRange as InstrumentRange
from pincal.simulate.tracker import InstrumentStretch as InstrumentStretch
from pincal.simulate.tracker import InstrumentTilt as InstrumentTilt
from pincal.simulate.tracker import MeasurementScale as MeasurementScale
from pincal.simulate.typical import hidden_effect as hidden_effect
from pincal.simulate.urdf_arm import read_arm as read_arm
