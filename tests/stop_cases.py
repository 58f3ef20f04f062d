"""Robots that are measured by plans: readings within a stop, visits of a pose, several targets; and checked later by others.

The machine is that of ``pincal.simulate``, which shares nothing with the model that is fitted.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from discovery_cases import random_urdf
from scipy.spatial.transform import Rotation

from pincal import FittedRobot, Measurements, Options, Robot, calibrate, measurements_from_arrays
from pincal import simulate as sim
from pincal.model.effects import GEOMETRIC

NOISE = 15e-6
"""Standard deviation of one coordinate of a reading [m]."""


@dataclass(frozen=True)
class MeasuringPlan:
    """How a robot is measured.

    Attributes:
        poses: number of poses.
        dwell: readings of each target in a stop.
        visits: stops at each pose, one in each pass.
        targets: number of targets read in each stop.
    """

    poses: int = 30
    dwell: int = 1
    visits: int = 1
    targets: int = 1


@dataclass(frozen=True)
class MeasuredRobot:
    """A machine whose drives stop with a scatter, and its nominal robot.

    Attributes:
        robot: the nominal one.
        machine: the true one.
        arrival: standard deviation of each drive's arrival [rad].
    """

    robot: Robot
    machine: sim.TrueMachine
    arrival: float

    @classmethod
    def drawn(cls, rng: np.random.Generator, arrival: float | None = None) -> MeasuredRobot:
        """Draw a heavy arm of six joints whose drives stop within 10 to 60 urad."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(random_urdf(rng, heavy=True), encoding="utf-8")
            robot = Robot.from_urdf(path, tip="tool0")
            machine = sim.TrueMachine.from_urdf(path, tip="tool0")
        machine = machine.draw_errors(rng, sigma_length=5e-4, sigma_angle=1e-3, sigma_offset=2e-3)
        return cls(robot, machine, float(rng.uniform(1e-5, 6e-5)) if arrival is None else arrival)

    def changed(self, joint: int, offset: float) -> MeasuredRobot:
        """Return the robot with another zero of a joint [rad]."""
        step = offset * np.eye(len(self.machine.names))[joint]
        return replace(self, machine=replace(self.machine, joint_offsets=self.machine.joint_offsets + step))

    def measured(self, plan: MeasuringPlan, rng: np.random.Generator) -> Measurements:
        """Return the table of a plan, with instrument and targets set up afresh."""
        hall = np.eye(4)
        hall[:3, :3] = Rotation.random(rng=rng).as_matrix()
        hall[:3, 3] = rng.uniform(-4.0, 4.0, 3)
        places = {f"t{k}": rng.uniform((-0.15, -0.15, 0.05), (0.15, 0.15, 0.35)) for k in range(plan.targets)}
        poses = sim.plan_poses(self.machine.nominal, plan.poses, rng)
        stops = np.tile(poses, (plan.visits, 1))
        arrived = stops + self.arrival * rng.standard_normal(stops.shape)
        seen = sim.Instrument(pose=hall, targets=places).measure(self.machine, np.repeat(arrived, plan.dwell, axis=0))
        position = np.column_stack([seen[axis] for axis in "xyz"])
        position = position + NOISE * rng.standard_normal(position.shape)
        target = None if plan.targets == 1 else np.tile(list(places), len(stops) * plan.dwell)
        commanded = np.repeat(stops, plan.dwell * plan.targets, axis=0)
        return measurements_from_arrays(self.robot.joint_names, commanded, position=position, target=target)

    def calibrated(self, plan: MeasuringPlan, rng: np.random.Generator) -> FittedRobot:
        """Return the robot calibrated by a plan."""
        return calibrate(self.robot, self.measured(plan, rng), Options(effects=GEOMETRIC)).at()
