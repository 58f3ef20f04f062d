"""Compile the loops into their cache; tests do so beside their collection, once for all workers."""

import warnings

import numpy as np

from pincal.builtin import kuka_urdf_path
from pincal.errors import PincalWarning
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.model import Model
from pincal.robot.robot import Robot


def main() -> None:
    """Predict a pose, which compiles the loop that takes longest, unless it is in the cache."""
    robot = Robot.from_urdf(kuka_urdf_path())
    with warnings.catch_warnings():
        # That it compiles.
        warnings.simplefilter("ignore", PincalWarning)
        Model(Chain.of(robot), ()).predict(np.zeros(0), Conditions.at(np.zeros((1, robot.n_joints))))


if __name__ == "__main__":
    main()
