"""A robot's life: calibrated over two set-ups, hit, diagnosed from twelve poses, re-identified, and updated with new rows.

The machine is a simulated KUKA KR 125/2 with errors of geometry; a laser tracker with 0.05 mm of noise has a new, unknown
pose each time. Run it as

    python examples/life_of_a_robot.py [--seed 1]
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.spatial.transform import Rotation

import pincal
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path

NOISE = 5e-5  # standard deviation of one coordinate [m]
HIT = 5e-4  # shift of the zero of joint_2 by a collision [rad]


class Machine:
    """A true machine; its controller does not register the collision."""

    def __init__(self, rng: np.random.Generator) -> None:
        """Draw errors of lengths and angles, of half a millimetre and a milliradian."""
        sound = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
        self.true, self.rng = sound.draw_errors(rng, sigma_length=5e-4, sigma_angle=1e-3), rng
        self.shift = np.zeros(len(sound.names))

    def measure(self, poses: int, *, sigma: float = NOISE) -> pincal.Measurements:
        """Return the readings of a tracker in a new pose."""
        q, place = sim.plan_poses(self.true.nominal, poses, self.rng), np.eye(4)
        place[:3, :3], place[:3, 3] = Rotation.random(rng=self.rng).as_matrix(), self.rng.uniform(-3.0, 3.0, 3)
        tracker = sim.Instrument(pose=place, targets=(0.1, 0.0, 0.2), sigma=sigma)
        table = tracker.measure(self.true, q + self.shift, rng=self.rng)
        position = np.column_stack([table[axis] for axis in "xyz"])
        return pincal.measurements_from_arrays(self.true.names, q, position=position)


def accuracy(model: pincal.FittedRobot, machine: Machine) -> float:
    """Return the mean error [mm] in 200 new poses, with instrument and target located from them."""
    placed = pincal.place_station(model, machine.measure(200, sigma=0.0))
    return float(1e3 * np.linalg.norm(placed.station.residuals(placed.values), axis=0).mean())


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1, help="of everything that is drawn (default: %(default)s)")
    machine = Machine(np.random.default_rng(parser.parse_args().seed))
    robot, options = pincal.Robot.from_urdf(kuka_urdf_path()), pincal.Options(effects=pincal.GEOMETRIC, sigma=NOISE)

    fit = pincal.calibrate(robot, {"monday": machine.measure(60), "tuesday": machine.measure(60)}, options)
    model = fit.robot_model()
    print(f"calibrated over two set-ups: {accuracy(model, machine):.4f} mm in new poses")
    print(f"before the collision: changed {pincal.diagnose(model, machine.measure(12)).changed}")

    machine.shift[1] = HIT
    found = pincal.diagnose(model, machine.measure(12))
    for change in found.changes:
        ((name, moved),) = change.parameters.items()
        size = f"{name} by {1e3 * (moved.after - moved.before):.3f} +- {1e3 * moved.sigma:.3f} mrad"
        print(f"hit by {1e3 * HIT:.3f} mrad: changed {found.changed}, {change.effect} of {change.joint}, {size}")
    print(f"the old model: {accuracy(model, machine):.4f} mm")
    print(f"re-identified from 12 poses: {accuracy(found.model, machine):.4f} mm")
    print(f"with 40 new rows: {accuracy(pincal.update(found.model, machine.measure(40)), machine):.4f} mm")


if __name__ == "__main__":
    main()
