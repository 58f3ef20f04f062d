"""Calibrate a serial robot into a measuring instrument: from a URDF and measured poses to a true robot model.

Example:
    >>> import pincal
    >>> robot = pincal.Robot.from_urdf("ur10")
    >>> robot.n_joints
    6
"""

from __future__ import annotations

import importlib
import warnings
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pincal.calibration.calibrated import CalibratedModel
    from pincal.calibration.calibrated_robot import (
        CalibratedRobot,
        Fit,
        calibrate,
        calibrate_parts,
        load_model,
        load_stations,
        save_model,
    )
    from pincal.calibration.calibration import Calibration, run_calibration
    from pincal.calibration.information import RobotInformation, load_information
    from pincal.calibration.placing import Placed, place_station
    from pincal.compensate.compensation import Compensation, compensate_poses, compensate_program
    from pincal.compensate.robot_frames import false_targets
    from pincal.design.health import CheckRequest, HealthCheck, design_check
    from pincal.design.pose_design import Design, design_poses
    from pincal.design.reach import Limits, SensorSetup
    from pincal.design.request import DesignRequest
    from pincal.diagnosis.model_update import update
    from pincal.diagnosis.robot_diagnosis import Diagnosis, diagnose
    from pincal.discover.policy import Policy
    from pincal.discover.run import Discovery, run_discovery
    from pincal.errors import BadInputError, IdentificationError, PincalError, PincalWarning
    from pincal.export import export_model
    from pincal.identify.explain import explain
    from pincal.identify.options import Options, StationOptions
    from pincal.identify.split import bootstrap, bootstrap_stations, cross_validate, monte_carlo
    from pincal.io.urdf_export import calibrated_urdf
    from pincal.measure.lens import Lens
    from pincal.measure.measurements import Measurements, measurements, measurements_from_arrays
    from pincal.measure.registry import register_sensor
    from pincal.measure.sensor import Sensor
    from pincal.measure.setup import KnownDistance, Setup
    from pincal.measure.table import read_measurements, row_parts
    from pincal.model.augmented import augmented_model, pinocchio_model
    from pincal.model.chain import Chain
    from pincal.model.conditions import Conditions, PoseSet
    from pincal.model.effect import Candidate, Discoverable, Effect, Locus, Term
    from pincal.model.effect_registry import register_effect
    from pincal.model.effects import ELASTIC, GEOMETRIC
    from pincal.model.model import Model
    from pincal.parameters import Parameter
    from pincal.plugins import load_plugin
    from pincal.robot.robot import Robot
    from pincal.viewer.in_meshcat import draw_field

# Names are imported when they are first used: Pinocchio, Numba and SciPy take longer to load than most commands to run.
_HOMES = {
    "pincal.calibration.calibrated": ("CalibratedModel",),
    "pincal.calibration.calibrated_robot": (
        "CalibratedRobot",
        "Fit",
        "calibrate",
        "calibrate_parts",
        "load_model",
        "load_stations",
        "save_model",
    ),
    "pincal.calibration.information": ("RobotInformation", "load_information"),
    "pincal.calibration.placing": ("Placed", "place_station"),
    "pincal.calibration.calibration": ("Calibration", "run_calibration"),
    "pincal.compensate.compensation": ("Compensation", "compensate_poses", "compensate_program"),
    "pincal.compensate.robot_frames": ("false_targets",),
    "pincal.design.pose_design": ("Design", "design_poses"),
    "pincal.design.health": ("CheckRequest", "HealthCheck", "design_check"),
    "pincal.design.reach": ("Limits", "SensorSetup"),
    "pincal.design.request": ("DesignRequest",),
    "pincal.io.discovery_file": ("Findings", "FoundEffect"),
    "pincal.notes": ("Note",),
    "pincal.validate.misfit": ("Verdict",),
    "pincal.diagnosis.robot_diagnosis": ("Diagnosis", "diagnose"),
    "pincal.diagnosis.model_update": ("update",),
    "pincal.discover.policy": ("Policy",),
    "pincal.discover.run": ("Discovery", "run_discovery"),
    "pincal.errors": ("BadInputError", "IdentificationError", "PincalError", "PincalWarning"),
    "pincal.export": ("export_model",),
    "pincal.identify.explain": ("explain",),
    "pincal.identify.options": ("Options", "StationOptions"),
    "pincal.identify.split": ("bootstrap", "bootstrap_stations", "cross_validate", "monte_carlo"),
    "pincal.io.urdf_export": ("calibrated_urdf",),
    "pincal.measure.lens": ("Lens",),
    "pincal.measure.measurements": ("Measurements", "measurements", "measurements_from_arrays"),
    "pincal.measure.registry": ("register_sensor",),
    "pincal.measure.sensor": ("Sensor",),
    "pincal.measure.setup": ("KnownDistance", "Setup"),
    "pincal.measure.table": ("read_measurements", "row_parts"),
    "pincal.model.augmented": ("augmented_model", "pinocchio_model"),
    "pincal.model.chain": ("Chain",),
    "pincal.model.conditions": ("Conditions", "PoseSet"),
    "pincal.model.effect": ("Candidate", "Discoverable", "Locus", "Effect", "Term"),
    "pincal.model.effects": ("ELASTIC", "GEOMETRIC"),
    "pincal.model.model": ("Model",),
    "pincal.model.effect_registry": ("register_effect",),
    "pincal.parameters": ("Parameter",),
    "pincal.plugins": ("load_plugin",),
    "pincal.robot.robot": ("Robot",),
    "pincal.viewer.in_meshcat": ("draw_field",),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}
# Names of 0.1.0, for one release.
_RENAMED = {
    "CalibratedStations": "CalibratedRobot",
    "Gap": "KnownDistance",
    "Rig": "SensorSetup",
    "Situation": "PoseSet",
    "calibrated_model": "pinocchio_model",
    "calibrated_model_of": "CalibratedModel.of",
}

__all__ = [
    "ELASTIC",
    "GEOMETRIC",
    "BadInputError",
    "CalibratedModel",
    "CalibratedRobot",
    "Calibration",
    "Candidate",
    "Chain",
    "CheckRequest",
    "Compensation",
    "Conditions",
    "Design",
    "DesignRequest",
    "Diagnosis",
    "Discoverable",
    "Discovery",
    "Effect",
    "Findings",
    "Fit",
    "FoundEffect",
    "HealthCheck",
    "IdentificationError",
    "KnownDistance",
    "Lens",
    "Limits",
    "Locus",
    "Measurements",
    "Model",
    "Note",
    "Options",
    "Parameter",
    "PincalError",
    "PincalWarning",
    "Placed",
    "Policy",
    "PoseSet",
    "Robot",
    "RobotInformation",
    "Sensor",
    "SensorSetup",
    "Setup",
    "StationOptions",
    "Term",
    "Verdict",
    "augmented_model",
    "bootstrap",
    "bootstrap_stations",
    "calibrate",
    "calibrate_parts",
    "calibrated_urdf",
    "compensate_poses",
    "compensate_program",
    "cross_validate",
    "design_check",
    "design_poses",
    "diagnose",
    "draw_field",
    "explain",
    "export_model",
    "false_targets",
    "load_information",
    "load_model",
    "load_plugin",
    "load_stations",
    "measurements",
    "measurements_from_arrays",
    "monte_carlo",
    "pinocchio_model",
    "place_station",
    "read_measurements",
    "register_effect",
    "register_sensor",
    "row_parts",
    "run_calibration",
    "run_discovery",
    "save_model",
    "update",
]


def __getattr__(name: str) -> Any:
    if name in _RENAMED:
        warnings.warn(f"pincal.{name} is now pincal.{_RENAMED[name]}", DeprecationWarning, stacklevel=2)
        name = _RENAMED[name]
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("pincal")
    name, _, part = name.partition(".")
    if name not in _HOME:
        raise AttributeError(f"module 'pincal' has no attribute {name!r}")
    found = getattr(importlib.import_module(_HOME[name]), name)
    return getattr(found, part) if part else found


def __dir__() -> list[str]:
    return ["__version__", *__all__]
