"""A calibrated robot that is checked day after day, and whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import date, timedelta
from functools import cache

import numpy as np

from pincal import GEOMETRIC, FittedRobot, Measurements, Options, Robot, calibrate, measurements_from_arrays
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path

NOISE = 5e-5  # [m]
ROWS, POSES = 60, 5
TOOL, INSTRUMENT = np.array([0.1, 0.05, 0.2]), np.array([2.0, 0.5, -0.3])  # [m]
FIRST = date(2026, 1, 1)


@dataclass(frozen=True, eq=False)
class CheckedArm:
    """An arm, its calibration, and the poses of its checks.

    Attributes:
        machine: the true one.
        fitted: as it was calibrated.
        q: shape (N, n), poses of every check.
        rng: of the noise.
    """

    machine: sim.TrueMachine
    fitted: FittedRobot
    q: np.ndarray
    rng: np.random.Generator

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(self.machine.names)

    def table(
        self,
        machine: sim.TrueMachine | None = None,
        *,
        times: float = 1.0,
        tool: np.ndarray = TOOL,
        base: np.ndarray | float = 0.0,
        turned: np.ndarray | None = None,
        warm: float = 0.0,
        q: np.ndarray | None = None,
    ) -> Measurements:
        """Return the readings of a check.

        Its noise may be so many times as large as stated, its target another, its base shifted, its instrument
        elsewhere [m], and its arm warmer [K].
        """
        q = self.q if q is None else q
        seen = positions(machine or self.machine, q, tool, warm=warm) + base
        seen = seen + times * NOISE * self.rng.standard_normal((len(q), 3))
        if turned is not None:
            seen = seen @ turned.T + [1.0, -2.0, 0.5]
        return measurements_from_arrays(self.joints, q, position=seen)

    def bent(self, size: float, joint: int = 2) -> sim.TrueMachine:
        """Return the machine with an offset of a joint [rad]."""
        return replace(self.machine, joint_offsets=self.machine.joint_offsets + size * np.eye(len(self.joints))[joint])


def positions(machine: sim.TrueMachine, q: np.ndarray, tool: np.ndarray = TOOL, *, warm: float = 0.0) -> np.ndarray:
    """Return where a target is, without noise, shape (N, 3) [m]; of an arm so many kelvin warmer than it was."""
    hall = np.eye(4)
    hall[:3, 3] = INSTRUMENT
    machine = machine.with_effects(sim.ThermalExpansion(size=1.2e-5))
    seen = sim.Instrument(pose=hall, targets=tool).measure(machine, q, temperature=np.full(len(q), 20.0 + warm))
    return np.column_stack([seen[axis] for axis in "xyz"])


def checked_arm(seed: int, *, poses: int = POSES) -> CheckedArm:
    """Draw a robot, calibrate it, and choose the poses of its checks."""
    rng = np.random.default_rng([seed, 49])
    machine = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0").draw_errors(rng, sigma_length=3e-4, sigma_angle=1e-3)
    q = sim.plan_poses(machine.nominal, ROWS, rng)
    seen = positions(machine, q) + NOISE * rng.standard_normal((ROWS, 3))
    table = measurements_from_arrays(machine.names, q, position=seen)
    fit = calibrate(nominal(), table, Options(effects=GEOMETRIC, sigma=NOISE))
    return CheckedArm(machine, fit, sim.plan_poses(machine.nominal, poses, rng), rng)


@cache
def nominal() -> Robot:
    """Return the arm as its data sheet has it."""
    return Robot.from_urdf(kuka_urdf_path())


def day_of(number: int) -> str:
    """Return the day of a check, from 0."""
    return (FIRST + timedelta(days=number)).isoformat()
