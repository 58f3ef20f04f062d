"""Compensation: a robot with errors of a centimetre is calibrated, and commanded such that it reaches its targets.

The machine is a simulated KUKA KR 125/2 with errors of geometry, which deflects under its own weight and a load of 100 kg,
whose masses differ by 3 % from the URDF, with an eccentric gear in joint 3 and backlash in joint 2. A laser tracker with
0.05 mm of noise measures 300 poses. Then a program of other poses, made with the nominal model, is corrected with the
calibrated one, and the true machine runs the corrected joint positions. Errors are those of the machine, not of the model.
Run it as

    python examples/compensate.py [--seed 1]
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pincal import (
    ELASTIC,
    GEOMETRIC,
    Conditions,
    FittedRobot,
    Options,
    Robot,
    compensate_poses,
    measurements_from_arrays,
    run_calibration,
)
from pincal.builtin import kuka_urdf_path
from pincal.discover.run import run_discovery
from pincal.simulate import Instrument, TrueMachine, plan_poses
from pincal.simulate.setup import draw_conditions, spread_payloads
from pincal.simulate.typical import draw_typical_elasticity, draw_typical_errors, typical_effect

NOISE = 5e-5  # standard deviation of one coordinate [m]
MEASURED, PROGRAM = 300, 200  # poses to calibrate with, and poses of the program
LOAD, LOAD_COM = 100.0, (0.06, 0.03, 0.2)  # on the flange in every other pose [kg], [m in the tip frame]
ERRORS = 3.0  # geometric errors over typical ones: together about a centimetre


@dataclass(frozen=True)
class Cell:
    """The machine, the tracker somewhere in the hall and its reflector on the flange."""

    machine: TrueMachine
    hall: np.ndarray
    reflector: np.ndarray

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Cell:
        """Return a machine with more errors than a calibration usually knows."""
        machine = draw_typical_errors(TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0"), rng, scale=ERRORS)
        machine = draw_typical_elasticity(machine, rng).draw_masses(rng, sigma=0.03)
        gear = typical_effect(machine, "gear_eccentricity", rng, joint="joint_3")
        machine = machine.with_effects(gear, typical_effect(machine, "backlash", rng, joint="joint_2"))
        hall = np.eye(4)
        hall[:3, :3], hall[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.uniform(-4.0, 4.0, 3)
        return cls(machine, hall, rng.uniform(0.05, 0.2, 3))

    def plan(self, poses: int, rng: np.random.Generator) -> tuple[np.ndarray, dict[str, Any]]:
        """Return joint positions, with and without the load, approached from either side."""
        conditions = draw_conditions(["approach"], poses, joints=len(self.machine.names), rng=rng)
        conditions["payload"] = spread_payloads([0.0, LOAD], poses, order="alternating")
        return plan_poses(self.machine.nominal, poses, rng), conditions

    def see(self, q: np.ndarray, conditions: dict[str, Any], rng: np.random.Generator | None = None) -> np.ndarray:
        """Return positions of the reflector in the tracker's frame, shape (N, 3) [m]; exact without a source of noise."""
        tracker = Instrument(pose=self.hall, targets=self.reflector, sigma=0.0 if rng is None else NOISE)
        table = tracker.measure(self.machine, q, rng=rng, payload_com=LOAD_COM, **conditions)
        return np.column_stack([table[axis] for axis in "xyz"])


def report(name: str, errors: np.ndarray) -> None:
    """Print one line of the table."""
    mean = 1e3 * errors.mean()
    print(f"  {name:40s} mean {mean:8.4f} mm, max {1e3 * errors.max():8.4f} mm, mean over noise {mean / (1e3 * NOISE):6.2f}")


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1, help="of everything that is drawn (default: %(default)s)")
    rng = np.random.default_rng(parser.parse_args().seed)
    cell = Cell.draw(rng)
    (q, conditions), (other, others) = cell.plan(MEASURED, rng), cell.plan(PROGRAM, rng)
    table = measurements_from_arrays(cell.machine.names, q, position=cell.see(q, conditions, rng), **conditions)

    robot, options = Robot.from_urdf(kuka_urdf_path()), Options(effects=ELASTIC, sigma=NOISE, payload_centre=LOAD_COM)
    fit = run_calibration(robot, table, options).fit
    discovery = run_discovery(robot, table, replace(options, effects=GEOMETRIC))
    program = replace(Conditions.at(other, payload_centre=LOAD_COM), **others)
    # The program was made with the nominal robot, its base and tool measured in: there it would bring the reflector.
    wanted = fit.model.predict(fit.model.own(fit.fit.nominal.values), program)

    print(f"KUKA KR 125/2, {MEASURED} poses measured with {1e3 * NOISE:g} mm noise, a program of {PROGRAM} other poses")
    report("as programmed", np.linalg.norm(cell.see(other, others) - wanted[:, :, 3], axis=1))
    for name, found in (("geometry and elasticity", fit), ("discovery", FittedRobot.of(discovery.trail.final))):
        corrected = compensate_poses(found, wanted, program)
        errors = np.linalg.norm(cell.see(corrected.q, others) - wanted[:, :, 3], axis=1)
        report(f"corrected by {name}", errors)
    elastic = ("joint_elasticity", "bearing_elasticity")
    named = [f"{e['effect']} of {e['joint']}" for e in discovery.report["effects"] if e["effect"] not in elastic]
    print(f"  discovered in addition to elasticity: {', '.join(named)}")
    for name in ("singular", "joint_limit", "unreachable"):
        print(f"  {name:12s} {np.sum(corrected.status == name):3d} of {PROGRAM} poses")


if __name__ == "__main__":
    main()
