"""Calibrate with figaroh 1.0: six parameters a joint, without those that no data could tell, place of the marker, drives.

Which these are is decided at the tool frame. With the flange, on axis 6, two are dropped that a reflector off this axis
shows (87 um instead of 29 at 100 poses), so the tool frame is one about where the reflector is. The residual is the plain
difference of positions, cheaper than the logarithm that figaroh offers for poses. Whether base and marker are known has to
be set in Python, as the configuration file has no place for it.
"""

import logging
import tempfile
import warnings
from pathlib import Path

import numpy as np
from adaptor import judge

warnings.simplefilter("ignore")  # Boost's converters are registered twice.

from figaroh.calibration.base_calibration import BaseCalibration  # noqa: E402
from figaroh.calibration.calibration_tools import calc_updated_fkm  # noqa: E402
from figaroh.tools.robot import create_robot  # noqa: E402

CONFIGURATION = """
robot:
  name: kuka
tasks:
  calibration:
    enabled: true
    type: kinematic_calibration
    joints: {{active_joints: [joint_1, joint_2, joint_3, joint_4, joint_5, joint_6]}}
    kinematics: {{base_frame: universe, tool_frame: reflector}}
    parameters: {{calibration_level: full_params, outlier_threshold: 0.05, include_non_geometric: {elastic}}}
    measurements:
      markers: [{{measurable_dof: [true, true, true, false, false, false]}}]
    data: {{source_file: {table}, number_of_samples: {rows}}}
"""
FRAME = """  <link name="reflector"/>
  <joint name="reflector_mount" type="fixed">
    <parent link="tool0"/><child link="reflector"/><origin xyz="{} {} {}" rpy="0 0 0"/>
  </joint>
</robot>
"""


class Calibration(BaseCalibration):
    """Positions of one marker, without weights."""

    def cost_function(self, var):
        """Return predicted minus measured coordinates [m], shape (3 N,)."""
        return calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config) - self.PEE_measured


def prepare(urdf, reflector, elastic):
    """Return the fit of a robot."""
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as folder:
        extended = Path(folder) / "robot.urdf"
        extended.write_text(Path(urdf).read_text().replace("</robot>", FRAME.format(*reflector)))
        robot = create_robot(str(extended), package_dirs=folder)

    def fit(q, position):
        with tempfile.TemporaryDirectory() as folder:
            table, configuration = Path(folder) / "table.csv", Path(folder) / "kuka.yaml"
            header = ",".join(["x1", "y1", "z1", *(f"joint_{i + 1}" for i in range(6))])
            np.savetxt(table, np.hstack([position, q]), delimiter=",", header=header, comments="", fmt="%.17g")
            configuration.write_text(CONFIGURATION.format(table=table, rows=len(q), elastic=str(elastic).lower()))
            calibration = Calibration(robot, str(configuration))
            calibration.calib_config.update(known_baseframe=True, known_tipframe=False)
            calibration.initialize()
        result = calibration.solve(enable_logging=False)

        def predict(joints):
            config = calibration.calib_config | {"NbSample": len(joints)}
            return calc_updated_fkm(calibration.model, calibration.data, result.x, joints, config).reshape(3, -1).T

        return len(result.x), predict

    return fit


if __name__ == "__main__":
    judge(prepare)
