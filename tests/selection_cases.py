"""Small tables of real kinds, on which a selection has gone wrong: a light arm that bends, and drives with waves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from pincal import Measurements, Robot, measurements_from_arrays
from pincal import simulate as sim
from pincal.robot.urdf_file import find_file
from pincal.simulate.effect import HiddenEffect

TOOL = np.array([0.06, -0.04, 0.1])  # [m]


def bent_panda(seed: int, *, n: int = 58, sigma: float = 1e-4, soft: float = 0.3) -> tuple[Robot, Measurements, np.ndarray]:
    """Return 58 poses of a 7R arm whose drives bend, and nothing else of note; position of a reflector.

    Returns:
        The arm; the measured rows, and as many other poses after them; noise-free positions of all, shape (2 n, 3).
    """
    rng = np.random.default_rng(seed)
    path = find_file("panda")
    machine = sim.TrueMachine.from_urdf(path, tip="panda_link8")
    machine = machine.draw_errors(rng, sigma_length=3e-4, sigma_angle=1e-3, sigma_offset=2e-3).draw_masses(rng, sigma=0.05)
    drive = soft * rng.uniform(0.7, 1.3, 7) * np.array([2.0, 2.0, 2.0, 2.0, 5.0, 5.0, 5.0]) * 1e-5
    bent = np.column_stack([0.0 * drive, 0.0 * drive, drive])
    machine = replace(machine, compliance=bent, moment_frame="after")
    return _measured(machine, Robot.from_urdf(path, tip="panda_link8"), rng, n=n, sigma=sigma)


def waving_ur5(seed: int, *, n: int = 160, sigma: float = 3e-5) -> tuple[Robot, Measurements, np.ndarray]:
    """Return a table of a UR5 whose first four drives err by curves of their own angles; the rest as above."""
    rng = np.random.default_rng(seed)
    path = find_file("ur5")
    machine = sim.TrueMachine.from_urdf(path, tip="tool0")
    machine = machine.draw_errors(rng, sigma_length=3e-4, sigma_angle=1e-3, sigma_offset=2e-3).draw_masses(rng, sigma=0.05)
    waves = [
        sim.hidden_effect("transmission_error", joint=name, size=1.2e-4, seed=int(rng.integers(1000)), bumps=6)
        for name in machine.names[:4]
    ]
    return _measured(machine, Robot.from_urdf(path, tip="tool0"), rng, *waves, n=n, sigma=sigma)


def _measured(
    machine: sim.TrueMachine, robot: Robot, rng: np.random.Generator, *hidden: HiddenEffect, n: int, sigma: float
) -> tuple[Robot, Measurements, np.ndarray]:
    q = sim.plan_poses(machine.nominal, 2 * n, rng, min_height=-0.2)
    hall = np.eye(4)
    hall[:3, :3], hall[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.uniform(-3.0, 3.0, 3)
    table = sim.Instrument(pose=hall, targets=TOOL).measure(machine.with_effects(*hidden), q)
    clean = np.column_stack([table[axis] for axis in "xyz"])
    noisy = clean + sigma * rng.standard_normal(clean.shape)
    return robot, measurements_from_arrays(machine.names, q, position=noisy), clean
