"""Calibrate with pincal: geometry, perhaps elasticity, base and tool; nothing is known beforehand but the URDF."""

import numpy as np
from adaptor import judge

from pincal import ELASTIC, GEOMETRIC, Options, Robot, calibrate, measurements_from_arrays


def prepare(urdf, reflector, elastic):
    """Return the fit of a robot."""
    robot = Robot.from_urdf(urdf)

    def fit(q, position):
        table = measurements_from_arrays(robot.joint_names, q, position=position)
        found = calibrate(robot, table, Options(effects=ELASTIC if elastic else GEOMETRIC))
        model = found.at()

        def predict(joints):
            return np.asarray(model.predict(joints))[:, :3, 3]

        return found.solution.posterior.visible_rank, predict

    return fit


if __name__ == "__main__":
    judge(prepare)
