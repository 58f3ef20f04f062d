"""An upright laser tracker beside the KUKA, and the positions that it reads."""

from __future__ import annotations

import numpy as np
from machines import kuka as true_kuka
from scipy.spatial.transform import Rotation

from pincal import simulate as sim
from pincal.measure.measurements import Measurements, measurements_from_arrays

NOISE = 5e-5


def standing(direction: float, turned: float = 0.3, away: float = 4.0) -> np.ndarray:
    """Return T_instrument_base of an upright tracker beside the robot."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", turned).as_matrix()
    T[:3, 3] = -T[:3, :3] @ [away * np.cos(direction), away * np.sin(direction), 0.8]
    return T


def seen(
    *hidden: sim.HiddenEffect, seed: int = 0, place: np.ndarray | None = None, poses: int = 200, sigma: float = NOISE
) -> Measurements:
    """Return positions of a rigid machine with errors, as a tracker that errs reads them."""
    rng = np.random.default_rng(5)
    machine = true_kuka().draw_errors(rng, sigma_length=5e-4, sigma_angle=1e-3).with_effects(*hidden)
    q = sim.plan_poses(machine.nominal, poses, np.random.default_rng(seed))
    tracker = sim.Instrument(pose=standing(0.5) if place is None else place, targets=(0.12, 0.05, 0.2), sigma=sigma)
    table = tracker.measure(machine, q, rng=np.random.default_rng(1000 + seed))
    return measurements_from_arrays(machine.names, q, position=np.column_stack([table[axis] for axis in "xyz"]))
