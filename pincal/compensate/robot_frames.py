"""Frames and models in which a pose is given: calibrated in the robot's base frame, nominal, or as
a false target.

All are derived from the calibrated model by leaving out effects: without the instrument's effects
it predicts in the robot's base frame; with the tool's effects only it is the nominal robot with the
identified tool.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect
from pincal.model.model import Model
from pincal.robot.se3 import compose, inverse

PoseFrame = Literal["instrument", "base"]
FalseTarget = Literal["tip", "target"]


def _is_of(effect: Effect, *frames: str) -> bool:
    return effect.scope == "station" and effect.locus.acts_on in frames


def in_base_frame(calibrated: FittedRobot) -> FittedRobot:
    """Return the calibrated model without the instrument, which predicts in the robot's
    base frame.
    """
    return _with_effects(
        calibrated, lambda effect: effect.scope == "robot" or _is_of(effect, "tool"), np.eye(3)
    )


def tip_in_instrument(calibrated: FittedRobot) -> FittedRobot:
    """Return the calibrated model without its target, which predicts the pose of the tip in the
    instrument's frame.
    """
    found = _with_effects(
        calibrated, lambda effect: not _is_of(effect, "tool"), calibrated.model.chain.base_rotation
    )
    chain = found.model.chain
    tools = np.tile(np.eye(3), (len(chain.targets), 1, 1))
    model = found.model.with_chain(chain.with_references(chain.base_rotation, tools))
    return found.with_model(model, found.estimate)


def _with_effects(
    calibrated: FittedRobot, is_kept: Callable[[Effect], bool], base_rotation: np.ndarray
) -> FittedRobot:
    found = calibrated.with_effects(is_kept)
    chain = found.model.chain.with_references(base_rotation, found.model.chain.tool_rotations)
    model = found.model.with_chain(chain)
    return found.with_model(model, found.estimate.take(model.names))


def program_poses(calibrated: FittedRobot, conditions: Conditions) -> np.ndarray:
    """Return the target poses of a nominal program, by the nominal robot with the calibrated tool.

    Returns:
        Poses in the robot's base frame, shape (N, 3, 4) [m].
    """
    return nominal_robot(calibrated).predict(conditions)


def nominal_robot(calibrated: FittedRobot) -> FittedRobot:
    """Return the nominal robot with the calibrated tool, which predicts in the robot's
    base frame.
    """
    return _with_effects(calibrated, lambda effect: _is_of(effect, "tool"), np.eye(3))


def nominal_in_instrument(calibrated: FittedRobot) -> FittedRobot:
    """Return the nominal robot with the calibrated tool and base, which predicts in the
    instrument's frame.
    """
    return _with_effects(
        calibrated, lambda e: _is_of(e, "tool", "base"), calibrated.model.chain.base_rotation
    )


def base_in_instrument(calibrated: FittedRobot, conditions: Conditions) -> np.ndarray:
    """Return the pose of the robot's base in the instrument's frame at each of N poses, shape (N,
    3, 4) [m].

    Rows differ only if the base drifts.
    """
    placed = _with_effects(
        calibrated, lambda effect: _is_of(effect, "base"), calibrated.model.chain.base_rotation
    )
    bare = _with_effects(calibrated, lambda effect: False, np.eye(3))
    return compose(placed.predict(conditions), inverse(bare.predict(conditions)))


def false_targets(
    calibrated: FittedRobot, conditions: Conditions, *, of: FalseTarget = "tip"
) -> np.ndarray:
    """Return the poses for which a controller with the nominal model commands given joint
    positions.

    The controller has to choose the same branch of its inverse kinematics (with seven joints, the
    same elbow position).

    Args:
        calibrated: the calibrated model.
        conditions: the N poses, with the joint positions to command.
        of: "tip": poses of the nominal robot's tip link, for a controller without a tool; "target":
            for a controller that has the calibrated tool.

    Returns:
        Poses in the robot's base frame, shape (N, 3, 4) [m].
    """
    if of == "target":
        return program_poses(calibrated, conditions)
    bare = Model(Chain.of(calibrated.model.chain.robot), ())
    return bare.predict(np.zeros(0), replace(conditions, target=np.zeros(len(conditions), int)))
