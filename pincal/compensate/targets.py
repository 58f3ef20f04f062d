"""The table of targets, wanted poses or a nominal program, with or without seeds, and the joint
positions to reach them.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.located_arm import LocatedArm
from pincal.compensate.compensate_numbers import COMPENSATION
from pincal.compensate.compensation import (
    Compensation,
    KeptOrientation,
    compensate_poses,
    middle_of_range,
)
from pincal.compensate.ik_problem import IkProblem
from pincal.compensate.robot_frames import (
    PoseFrame,
    base_in_instrument,
    in_base_frame,
    program_poses,
)
from pincal.errors import MeasurementError
from pincal.measure.admit import check_joints_of
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.measure.reader import Cells, read_table
from pincal.measure.table_schema import Schema, TableOptions
from pincal.model.conditions import Conditions
from pincal.robot.robot import Robot
from pincal.robot.se3 import compose, inverse, rotation_matrices
from pincal.sensors.fields import CONDITIONS
from pincal.sensors.registry import known_fields

# Further columns that the command writes: they are ignored, so that its output can be its input.
_WRITTEN = ("status", "error_mm", "error_mrad", "sigma_mm", "change_max", "large_change",
            *(f"false_{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")))  # fmt: skip
_FIELDS = tuple(
    known_fields()[name] for name in ("position", "quaternion", *CONDITIONS) if name != "point"
)


@dataclass(frozen=True)
class Targets:
    """Rows to compensate.

    Attributes:
        rows: wanted positions or poses (kind "none" for a program), and the conditions of each row,
            with joint positions of 0 if the table has none.
        has_joints: whether the table has joint positions.
        cells: the table.
    """

    rows: Measurements
    has_joints: bool
    cells: Cells


@dataclass(frozen=True)
class CompensatedTable:
    """A table of targets with the joint positions to command.

    Attributes:
        targets: the table.
        seeds: the conditions of its rows, with the initial joint positions of the search.
        commanded: the same conditions with the joint positions to command.
        found: the result of each row.
        orientation: "keep" if an orientation is wanted, "free" if any is allowed.
        sigma: shape (N,), standard deviation of the predicted position, root sum of squares of
            three coordinates [m], by the uncertainty of the calibration; once base and target are
            located, where its readings leave open where the base stands.
        robot: the arm.
    """

    targets: Targets
    seeds: Conditions
    commanded: Conditions
    found: Compensation
    orientation: KeptOrientation
    sigma: np.ndarray
    robot: Robot

    @property
    def change(self) -> np.ndarray:
        """Commanded minus initial joint positions, as reported by the controller, shape (N, n); 0
        for joints that follow from others, which no controller commands.
        """
        own = np.isin(np.arange(self.robot.n_joints), self.robot.own_joints)
        return np.where(own, self.found.q - self.robot.as_reported(self.seeds.q), 0.0)


def read_targets(
    path: str | os.PathLike[str], robot: Robot, *, options: TableOptions | None = None
) -> Targets:
    """Read a table of targets or of a nominal program, with the same units and formats as
    measurements.

    Args:
        path: the file: columns of joints, x y z (and qx qy qz qw), or both, and conditions.
        robot: the arm.
        options: how to read the table.

    Raises:
        MeasurementError: for a file that can't be read, a table with neither wanted positions nor
            joints, or an invalid column, unit or value.
    """
    path = Path(path)
    options = options or TableOptions()
    options = replace(options, ignore=(*_WRITTEN, *options.ignore))
    cells = read_table(path, Schema(_FIELDS, may_lack_joints=True, options=options).of_robot(robot))
    has_joints = "q" in cells.arrays
    if not has_joints and "position" not in cells.arrays:
        raise MeasurementError(
            f"{path.name}: neither desired positions nor joints; expected columns x y z, "
            f"or {' '.join(robot.joint_names)}"
        )
    arrays = {"q": np.zeros((len(cells.rows), robot.n_joints))} | cells.arrays
    rows = measurements_from_arrays(
        robot.joint_names, **arrays, rows=cells.rows, source=path.name, units=cells.units
    )
    if has_joints:
        check_joints_of(robot, rows)
    return Targets(rows, has_joints, cells)


def run_compensation(
    calibrated: FittedRobot,
    targets: Targets,
    *,
    frame: PoseFrame = "instrument",
    seed: np.ndarray | None = None,
    any_orientation: bool = False,
    limits: bool = True,
) -> CompensatedTable:
    """Find the joint positions to command for a table of targets or a nominal program.

    Args:
        calibrated: the calibrated model.
        targets: the table.
        frame: frame of its positions and of the wanted poses in the result; a program is always in
            the base frame.
        seed: shape (n,), initial joint positions if the table has none; default: the middle of the
            joint ranges, with any orientation for positions without a quaternion.
        any_orientation: whether to allow any orientation even if the table has one.
        limits: whether to respect the joint limits of the URDF.

    Raises:
        BadInputError: as :func:`pincal.compensate.compensation.compensate_poses`, or for a target
            that the model lacks.
        MeasurementError: if the wanted positions are evidently in another unit.
    """
    robot = calibrated.model.chain.robot
    seeds = calibrated.conditions(targets.rows)
    if not targets.has_joints:
        start = middle_of_range(robot) if seed is None else robot.from_reported(seed[None])[0]
        seeds = replace(seeds, q=np.tile(start, (len(targets.rows), 1)))
    has_orientation = targets.rows.quaternion is not None or targets.has_joints or seed is not None
    orientation: KeptOrientation = "keep" if has_orientation and not any_orientation else "free"
    if targets.rows.kind == "none":
        poses = program_poses(calibrated, seeds)
        wanted = poses if orientation == "keep" else poses[:, :, 3]
        found = compensate_poses(
            calibrated, wanted, seeds, frame="base", orientation=orientation, limits=limits
        )
        if frame == "instrument":
            in_instrument = compose(base_in_instrument(calibrated, seeds), found.wanted)
            found = replace(found, wanted=in_instrument, frame=frame)
    else:
        wanted = _wanted(targets, with_orientation=orientation == "keep")
        _check_unit(calibrated, targets, seeds=seeds, frame=frame)
        found = compensate_poses(
            calibrated, wanted, seeds, frame=frame, orientation=orientation, limits=limits
        )
    commanded = replace(seeds, q=robot.from_reported(found.q))
    sigma = np.linalg.norm(_position_sigma(calibrated, commanded, frame), axis=1)
    return CompensatedTable(targets, seeds, commanded, found, orientation, sigma, robot)


def _position_sigma(
    calibrated: FittedRobot, conditions: Conditions, frame: PoseFrame
) -> np.ndarray:
    """Return the standard uncertainty of positions, shape (N, 3) [m]."""
    if not calibrated.station.is_placed:
        return LocatedArm.where_measured(calibrated, conditions).position_sigma(conditions)
    predictor = in_base_frame(calibrated) if frame == "base" else calibrated
    return predictor.position_sigma(conditions)


def unreached_turns(calibrated: FittedRobot, done: CompensatedTable) -> str:
    """Return a description of the rotations that an arm with too few joints can't make; "" if there
    are none.
    """
    robot = calibrated.model.chain.robot
    if done.orientation != "keep" or len(robot.own_joints) >= 6:
        return ""
    placed = in_base_frame(calibrated)
    conditions = calibrated.of_its_day(done.commanded)
    wanted = done.found.wanted
    problem = IkProblem.of(
        placed.model,
        placed.model_values,
        conditions=conditions,
        wanted=wanted,
        with_orientation=True,
    )
    free = problem.turns_in_place(done.found.q[:, robot.own_joints]).mean(axis=0)
    lost = 3 - round(float(free.sum()))
    axes = [axis for axis, part in zip("xyz", free, strict=True) if part < COMPENSATION.hardly]
    if len(axes) == lost:
        return f"about {' and '.join(axes)} of its base frame" if axes else ""
    return f"about {lost} of three axes, which differ from pose to pose"


def _wanted(targets: Targets, *, with_orientation: bool) -> np.ndarray:
    """Return the wanted positions, shape (N, 3), or poses, shape (N, 3, 4), of the table."""
    position = targets.rows.position
    quaternion = targets.rows.quaternion
    assert position is not None
    if quaternion is None or not with_orientation:
        return position
    return np.concatenate([rotation_matrices(quaternion), position[:, :, None]], axis=2)


def _check_unit(
    calibrated: FittedRobot, targets: Targets, *, seeds: Conditions, frame: PoseFrame
) -> None:
    """Reject a table with most positions far beyond the robot's reach, if its header does not state
    their unit.
    """
    places = _wanted(targets, with_orientation=False)
    reach = calibrated.model.chain.robot.reach
    if frame == "instrument":
        to_base = inverse(base_in_instrument(calibrated, seeds))
        places = np.einsum("nij,nj->ni", to_base[:, :, :3], places) + to_base[:, :, 3]
    away = float(np.median(np.linalg.norm(places, axis=1)))
    if away > COMPENSATION.other_unit * reach and "x" not in targets.rows.units:
        raise MeasurementError(
            f"{targets.rows.source}: desired positions lie {away:.4g} m from the robot's base, "
            f"whose reach is {reach:.3g} m; this looks like millimetres: write `x [mm]` in the "
            "header, or `x [m]` if it is correct"
        )
