"""Calibrate with pybotics 3.1: modified Denavit-Hartenberg parameters by its own residual, the distance at each pose.

Levenberg-Marquardt ends sooner and closer than SciPy's default method. It reads no URDF: the robot is Table I of the paper,
in the modified convention.
"""

import numpy as np
from adaptor import judge
from pybotics.optimization import OptimizationHandler, optimize_accuracy
from pybotics.robot import Robot
from pybotics.tool import Tool
from scipy.optimize import least_squares

# alpha and a of the link before, theta, d; where nothing tells two parameters apart, one is fixed.
LINKS = np.array(
    [
        [0.0, 0.0, 0.0, 0.865],
        [np.pi / 2, 0.41, 0.0, 0.0],
        [0.0, 1.0, np.pi / 2, 0.0],
        [np.pi / 2, 0.045, 0.0, 1.0],
        [-np.pi / 2, 0.0, 0.0, 0.0],
        [np.pi / 2, 0.0, np.pi, 0.21],
    ]
)
FIXED = {(5, 2), (5, 3)}  # theta and d of the last link: the tool's position says the same
# x, y, rx, ry of the base: how axis 1 stands; z and rz are d and theta of the first link, whose alpha and a are fixed.
WORLD = [True, True, False, True, True, False]


def prepare(urdf, reflector, elastic):
    """Return the fit of a robot."""
    mask = [link > 0 if parameter < 2 else (link, parameter) not in FIXED for link in range(6) for parameter in range(4)]

    def fit(q, position):
        tool = np.eye(4)
        tool[:3, 3] = reflector
        robot = Robot.from_parameters(LINKS.ravel())
        robot.tool = Tool(tool)
        handler = OptimizationHandler(robot, mask, [True] * 3 + [False] * 3, WORLD)
        start = handler.generate_optimization_vector()
        result = least_squares(optimize_accuracy, start, args=(handler, q, position), method="lm")
        handler.apply_optimization_vector(result.x)

        def predict(joints):
            return np.array([handler.robot.fk(row)[:3, 3] for row in joints])

        return len(start), predict

    return fit


if __name__ == "__main__":
    judge(prepare)
