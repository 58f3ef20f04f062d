# ruff: noqa: I001
# The public names, topic by topic.

# Robots
from pincal.robot.robot import Robot as Robot
from pincal.robot.cell import read_cell as read_cell

# Tables and conditions
from pincal.measure.table import read_measurements as read_measurements
from pincal.measure.measurements import measurements as measurements
from pincal.measure.measurements import measurements_from_arrays as measurements_from_arrays
from pincal.measure.measurements import Measurements as Measurements
from pincal.model.conditions import Conditions as Conditions
from pincal.measure.table import row_parts as row_parts

# Calibration
from pincal.calibration.checked_fit import calibrate as calibrate
from pincal.calibration.calibration import run_calibration as run_calibration
from pincal.calibration.checked_fit import calibrate_parts as calibrate_parts
from pincal.identify.split import cross_validate as cross_validate
from pincal.calibration.placing import place_station as place_station
from pincal.calibration.information import load_information as load_information
from pincal.identify.options import Options as Options
from pincal.identify.options import StationOptions as StationOptions
from pincal.sensors.setup import Setup as Setup
from pincal.model.effects import GEOMETRIC as GEOMETRIC
from pincal.model.effects import ELASTIC as ELASTIC
from pincal.calibration.calibration import Calibration as Calibration
from pincal.identity import Identity as Identity

# A calibrated robot
from pincal.calibration.fitted_robot import load_model as load_model
from pincal.calibration.fitted_robot import FittedRobot as FittedRobot

# Discovery and health
from pincal.discover.run import run_discovery as run_discovery
from pincal.discover.run import Discovery as Discovery
from pincal.diagnosis.robot_diagnosis import diagnose as diagnose
from pincal.diagnosis.model_update import update as update
from pincal.design.health import design_check as design_check

# Use of a model
from pincal.compensate.compensation import compensate_poses as compensate_poses
from pincal.compensate.compensation import compensate_program as compensate_program
from pincal.export import export_model as export_model
from pincal.report.drawings import drawings as drawings
from pincal.viewer.page import draw_field as draw_field
from pincal.features.measured_part import measure_part as measure_part
from pincal.features.part import Part as Part
from pincal.features.readings import read_readings as read_readings

# Plans and motion
from pincal.design.pose_design import design_poses as design_poses
from pincal.design.request import DesignRequest as DesignRequest
from pincal.motion.sessions import read_session as read_session
from pincal.motion.stations import session_tables as session_tables

# Effects and sensors of your own
from pincal.model.effect import Effect as Effect
from pincal.model.effect_registry import register_effect as register_effect
from pincal.sensors.sensor import Sensor as Sensor
from pincal.sensors.registry import register_sensor as register_sensor
from pincal.plugins import load_plugin as load_plugin

# Errors and warnings
from pincal.errors import PincalError as PincalError
from pincal.errors import BadInputError as BadInputError
from pincal.errors import IdentificationError as IdentificationError
from pincal.errors import PincalWarning as PincalWarning

# Moved: for one release, with a warning
from pincal.calibration.information import RobotInformation as RobotInformation
from pincal.calibration.placing import Placed as Placed
from pincal.compensate.compensation import Compensation as Compensation
from pincal.compensate.robot_frames import false_targets as false_targets
from pincal.design.health import CheckRequest as CheckRequest
from pincal.design.health import HealthCheck as HealthCheck
from pincal.design.motion_design import MotionDesign as MotionDesign
from pincal.design.motion_design import design_motion as design_motion
from pincal.design.pose_design import Design as Design
from pincal.design.reach import Limits as Limits
from pincal.design.reach import SensorSetup as SensorSetup
from pincal.diagnosis.robot_diagnosis import Diagnosis as Diagnosis
from pincal.discover.discovery_file import Findings as Findings
from pincal.discover.discovery_file import FoundEffect as FoundEffect
from pincal.discover.policy import Policy as Policy
from pincal.features.flange_sensor import FlangeSensor as FlangeSensor
from pincal.features.measured_part import MeasuredPart as MeasuredPart
from pincal.features.mounted_sensor import Reservations as Reservations
from pincal.features.readings import FeatureReadings as FeatureReadings
from pincal.fleet.machines import Machine as Machine
from pincal.fleet.robot_type import RobotType as RobotType
from pincal.fleet.robot_type import calibrate_of_type as calibrate_of_type
from pincal.fleet.robot_type import learn_type as learn_type
from pincal.fleet.robot_type import load_type as load_type
from pincal.fleet.store import open_store as open_store
from pincal.identify.options import PriorScale as PriorScale
from pincal.io.urdf_export import calibrated_urdf as calibrated_urdf
from pincal.model.augmented import augmented_model as augmented_model
from pincal.model.augmented import pinocchio_model as pinocchio_model
from pincal.model.chain import Chain as Chain
from pincal.model.conditions import PoseSet as PoseSet
from pincal.model.effect import Candidate as Candidate
from pincal.model.effect import Discoverable as Discoverable
from pincal.model.effect import Locus as Locus
from pincal.model.effect import Term as Term
from pincal.model.model import Model as Model
from pincal.motion.sessions import read_streams as read_streams
from pincal.notes import Note as Note
from pincal.parameters import Parameter as Parameter
from pincal.robot.cell import Beside as Beside
from pincal.sensors.lens import Lens as Lens
from pincal.sensors.setup import KnownDistance as KnownDistance
from pincal.validate.misfit import Verdict as Verdict

__version__: str
