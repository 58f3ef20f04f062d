"""Truth from the controller: the poses that a robot reports reveal the calibration that its manufacturer stored in it.

Manufacturers calibrate their arms and store the result in the controller: every arm of Universal Robots has corrections of
its Denavit-Hartenberg parameters, KUKA and FANUC sell such a calibration as an option. The URDF does not contain it. But the
controller computes with it, so that a log of joint positions and of the tool poses that it reports is a measurement without
an instrument, exact to the last digit: some tens of poses recover the calibration. The robot need not even move if the
controller computes poses for any joint positions (get_forward_kin of a UR).

Here the controller is a UR10 with hidden corrections that reports six decimals; pincal gets its log and the URDF. Run it as

    python examples/controller_truth.py [--poses 80] [--decimals 6] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pincal import GEOMETRIC, Options, PincalError, Robot, export_model, read_measurements, run_calibration

# Denavit-Hartenberg parameters of the UR10 as its maker publishes them: theta, d, a, alpha [rad, m].
DRAWING = np.array([
    [0.0, 0.1273, 0.0, np.pi / 2], [0.0, 0.0, -0.612, 0.0], [0.0, 0.0, -0.5723, 0.0],
    [0.0, 0.163941, 0.0, np.pi / 2], [0.0, 0.1157, 0.0, -np.pi / 2], [0.0, 0.0922, 0.0, 0.0],
])  # fmt: skip
# How much arms differ from the drawing [rad, m, m, rad].
SPREAD = np.array([2e-3, 5e-4, 5e-4, 1e-3])
# Poses at which the result is judged.
CHECKED = 1000


class Controller:
    """A controller with a hidden calibration."""

    def __init__(self, rng: np.random.Generator) -> None:
        """Draw the corrections of one arm."""
        self._parameters = DRAWING + rng.uniform(-1.0, 1.0, DRAWING.shape) * SPREAD

    def report(self, q: np.ndarray) -> np.ndarray:
        """Return position [m] and rotation vector [rad] of the flange at joint positions of shape (N, 6)."""
        poses = np.tile(np.eye(4), (len(q), 1, 1))
        for i, (theta, d, a, alpha) in enumerate(self._parameters):
            step = np.tile(np.eye(4), (len(q), 1, 1))
            turned = Rotation.from_euler("z", q[:, i, None] + theta)
            step[:, :3, :3] = (turned * Rotation.from_euler("x", alpha)).as_matrix()
            step[:, :3, 3] = turned.apply([a, 0.0, d])
            poses = poses @ step
        return np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()])


def write_log(path: Path, robot: Robot, controller: Controller, *, poses: int, decimals: int) -> None:
    """Write a log: joint positions and reported poses in the controller's own convention."""
    q = robot.random_configurations(poses, np.random.default_rng(1))
    rows = np.hstack([q, controller.report(q)])
    header = ",".join([*robot.joint_names, "x", "y", "z", "rx", "ry", "rz"])
    np.savetxt(path, rows, fmt=f"%.{decimals}f", delimiter=",", header=header, comments="")


def main() -> int:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--poses", type=int, default=80, help="rows of the log (default: %(default)s)")
    parser.add_argument("--decimals", type=int, default=6, help="that the controller reports (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path(), help="folder for log and results (default: here)")
    chosen = parser.parse_args()
    robot, controller = Robot.from_urdf("ur10", tip="tool0"), Controller(np.random.default_rng(2))
    chosen.out.mkdir(parents=True, exist_ok=True)
    log = chosen.out / "controller_log.csv"
    write_log(log, robot, controller, poses=chosen.poses, decimals=chosen.decimals)
    try:
        table = read_measurements(log, robot.joint_names)
        found = run_calibration(robot, table, Options(effects=GEOMETRIC))
    except PincalError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    q = robot.random_configurations(CHECKED, np.random.default_rng(3))
    truth = controller.report(q)
    poses = found.fit.predict(q)
    away = np.linalg.norm(poses[:, :, 3] - truth[:, :3], axis=1)
    turned = (Rotation.from_matrix(poses[:, :, :3]) * Rotation.from_rotvec(truth[:, 3:]).inv()).magnitude()
    nominal = 1e-3 * found.result.error["nominal"]["test"]["max_mm"]
    exported = export_model(found.fit, "urdf", chosen.out / "as_the_controller.urdf")
    print(f"UR10, {len(table)} reported poses of {chosen.decimals} decimals; {CHECKED} others against the controller itself")
    print(f"  by the URDF, base and tool fitted, max: {nominal:.1e} m")
    print(f"  calibrated,                        max: {away.max():.1e} m, {turned.max():.1e} rad")
    print(f"  URDF written; it and the model agree to {exported.max_error_m:.1e} m")
    return 0


if __name__ == "__main__":
    sys.exit(main())
