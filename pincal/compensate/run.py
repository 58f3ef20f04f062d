"""One compensation from table to result: the wanted poses of its rows, and the joint positions that reach them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.compensate.compensation import Compensation, Orientation, compensate_poses, middle_of_range
from pincal.compensate.frames import Frame, base_in_instrument, in_base_frame, program_poses
from pincal.compensate.targets import Targets, check_positions
from pincal.model.effects import Conditions
from pincal.robot.se3 import compose, inverse, rotation_matrices


@dataclass(frozen=True)
class CompensatedTable:
    """A table of targets with the joint positions to command.

    Attributes:
        targets: the table.
        seeds: the conditions of its rows, with the joint positions that the search started from.
        commanded: the same conditions with the joint positions to command.
        found: how each row ended.
        orientation: "keep" if the rows want an orientation, "free" if any will do.
        sigma: shape (N,), standard deviation of the predicted position, all three coordinates combined [m]: the uncertainty
            of the calibration.
    """

    targets: Targets
    seeds: Conditions
    commanded: Conditions
    found: Compensation
    orientation: Orientation
    sigma: np.ndarray


def run_compensation(
    calibrated: CalibratedModel,
    targets: Targets,
    *,
    frame: Frame = "instrument",
    seed: np.ndarray | None = None,
    any_orientation: bool = False,
    limits: bool = True,
) -> CompensatedTable:
    """Find the joint positions to command for a table of targets or a nominal program.

    Args:
        calibrated: the calibrated model.
        targets: the table.
        frame: frame of its positions and of the wanted poses in the result; a program is always meant in the base frame.
        seed: shape (n,), joint positions to start from if the table has none; default: the middle of the joint ranges, with
            any orientation for positions without a quaternion.
        any_orientation: whether to reach positions in any orientation, even if the table has one.
        limits: whether to stay within the joint limits of the URDF.

    Raises:
        BadInputError: as :func:`pincal.compensate.compensation.compensate_poses`.
        MeasurementError: if the wanted positions are evidently in another unit.
    """
    robot = calibrated.model.chain.robot
    seeds = targets.conditions(calibrated, middle_of_range(robot) if seed is None else seed)
    has_orientation = targets.rows.quaternion is not None or targets.has_joints or seed is not None
    orientation: Orientation = "keep" if has_orientation and not any_orientation else "free"
    if targets.is_program:
        poses = program_poses(calibrated, seeds)
        wanted = poses if orientation == "keep" else poses[:, :, 3]
        found = compensate_poses(calibrated, wanted, seeds, frame="base", orientation=orientation, limits=limits)
        if frame == "instrument":
            in_instrument = compose(base_in_instrument(calibrated, seeds), found.wanted)
            found = replace(found, wanted=in_instrument, frame=frame)
    else:
        wanted = _wanted(targets, with_orientation=orientation == "keep")
        check_positions(targets, robot, positions=_in_base(calibrated, wanted, seeds=seeds, frame=frame))
        found = compensate_poses(calibrated, wanted, seeds, frame=frame, orientation=orientation, limits=limits)
    commanded = replace(seeds, q=found.q)
    predictor = in_base_frame(calibrated) if frame == "base" else calibrated
    sigma = np.linalg.norm(predictor.position_sigma(commanded), axis=1)
    return CompensatedTable(targets, seeds, commanded, found, orientation, sigma)


def _wanted(targets: Targets, *, with_orientation: bool) -> np.ndarray:
    """Return the wanted positions, shape (N, 3), or poses, shape (N, 3, 4), of the table."""
    position, quaternion = targets.rows.position, targets.rows.quaternion
    assert position is not None
    if quaternion is None or not with_orientation:
        return position
    return np.concatenate([rotation_matrices(quaternion), position[:, :, None]], axis=2)


def _in_base(calibrated: CalibratedModel, wanted: np.ndarray, *, seeds: Conditions, frame: Frame) -> np.ndarray:
    """Return wanted positions in the robot's base frame, shape (N, 3) [m]."""
    places = wanted if wanted.ndim == 2 else wanted[:, :, 3]
    if frame == "base":
        return places
    to_base = inverse(base_in_instrument(calibrated, seeds))
    return np.asarray(np.einsum("nij,nj->ni", to_base[:, :, :3], places) + to_base[:, :, 3])
