"""Calibrate with robotkinecal 0.1: four parameters of each screw axis and the end effector's position."""

import numpy as np
import roboticstoolbox as rtb
from adaptor import judge
from robotkinecal import SerialRobotKineCal


def prepare(urdf, reflector, elastic):
    """Return the fit of a robot."""

    def fit(q, position):
        # A fit changes the robot's poses; another starts from the file again.
        calibration = SerialRobotKineCal(rtb.ERobot.URDF(urdf), ee_name="tool0")
        calibration.set_observations(list(q), list(position))
        calibration.solve()

        def predict(joints):
            last = calibration.N_JOINTS + 1
            return np.array([calibration.forward_kinematics(last, row).t for row in joints])

        return calibration.N_PARAMS, predict

    return fit


if __name__ == "__main__":
    judge(prepare)
