"""A fleet: forty machines of the type KUKA KR 125/2, the type learned from them, further machines, and weeks of checks.

Lengths differ by 0.1 mm and angles by 0.15 mrad from machine to machine, and the data sheet is off by 0.3 mm. Three robots
change in the second week. All measurements are in a store, a folder of Parquet files. Run it as

    python examples/fleet.py [--robots 40] [--store fleet-store]

If it is stopped, the next run continues. Then look at the pages that it writes, or use the command line:

    pincal fleet learn fleet-store --robot kuka.urdf --out type.json
    pincal fleet check type.json fleet-store
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import pincal
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.fleet.checks import fleet_changes
from pincal.fleet.fleet_pages import fleet_page, type_page
from pincal.fleet.jobs import CalibrateTables, run_job, visits_of
from pincal.fleet.robot_type import calibrate_of_type, learn_type
from pincal.fleet.store import open_store
from pincal.fleet.summary import at_tool, group_lines, history_line, look_first, type_lines

NOISE = 5e-5  # standard deviation of one coordinate [m]
FURTHER, POSES = 5, 8  # machines that are new, and poses of each
SPREAD = np.repeat([1e-4, 1.5e-4], 3)  # of placements from machine to machine [m, rad]
BEGIN, WEEKS = np.datetime64("2026-01-05"), 3
CHANGED = {3: ("joint_2", 4e-4), 5: ("joint_3", 4e-4), 8: ("joint_5", 8e-4)}  # robot: joint whose zero moves [rad]


class Fleet:
    """True machines, and a tracker that reads a reflector on each."""

    def __init__(self, robots: int) -> None:
        """Draw as many machines, and some more."""
        nominal, rng = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0"), np.random.default_rng(1)
        sheet = np.zeros((len(nominal.names) + 1, 6))
        sheet[2, 0] = 3e-4
        drawn = [sheet + SPREAD * rng.normal(size=sheet.shape) for _ in range(robots + FURTHER)]
        machines = [replace(nominal, placement_errors=errors) for errors in drawn]
        self.machines, self.further = machines[FURTHER:], machines[:FURTHER]

    def change(self, robot: int, joint: str, by: float) -> None:
        """Move the zero of a joint."""
        machine = self.machines[robot]
        offsets = np.array(machine.joint_offsets) + by * (np.array(machine.names) == joint)
        self.machines[robot] = replace(machine, joint_offsets=offsets)


def measured(
    robot: pincal.Robot, machine: sim.TrueMachine, poses: int, seed: int, sigma: float = NOISE
) -> pincal.Measurements:
    """Return what a tracker reads in random poses."""
    rng = np.random.default_rng(seed)
    q = robot.random_configurations(poses, rng)
    tip = machine.tip(q)
    position = tip[:, :3, :3] @ [0.1, 0.0, 0.2] + tip[:, :3, 3] + sigma * rng.normal(size=(poses, 3))
    return pincal.measurements_from_arrays(robot.joint_names, q, position=position)


def errors_mm(fit: pincal.FittedRobot, truth: pincal.Measurements) -> tuple[float, float]:
    """Return the mean error of predictions and the standard deviation that the fit states [mm]."""
    off, sigma = fit.predict(truth.q)[:, :, 3] - truth.position, fit.position_sigma(fit.readings(truth).conditions)
    return 1e3 * float(np.linalg.norm(off, axis=1).mean()), 1e3 * float(np.linalg.norm(sigma, axis=1).mean())


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--robots", type=int, default=40, help="number of machines (default: %(default)s)")
    parser.add_argument("--store", default="fleet-store", help="folder of the store (default: %(default)s)")
    given = parser.parse_args()
    robot, options = pincal.Robot.from_urdf(kuka_urdf_path()), pincal.Options(effects=pincal.GEOMETRIC, sigma=NOISE)
    fleet, store = Fleet(given.robots), open_store(given.store, create=True)

    for k, machine in enumerate(fleet.machines):
        labels = {"supplier": "AB"[k % 2]}
        store.add_table(f"R{k + 1:02d}", str(BEGIN), measured(robot, machine, 40, k), labels=labels)
    done = run_job(store, CalibrateTables(robot, options, role="calibration"))
    print(f"calibrated: {done.done} machines, {done.before} done before")
    learned = learn_type(machine for _, machine, _ in store.machines())
    of, at = learned.type, at_tool(learned.type, robot)
    print(*type_lines(learned, at, error=1e-4), sep="\n")
    of.save("type.json")
    Path("type.html").write_text(type_page(learned, at, version=""), encoding="utf-8")

    alone, typed = [], []
    for k, machine in enumerate(fleet.further):
        few, truth = measured(robot, machine, POSES, 77 + k), measured(robot, machine, 200, 97 + k, sigma=0.0)
        alone.append(errors_mm(pincal.calibrate(robot, few, options), truth))
        typed.append(errors_mm(calibrate_of_type(robot, few, of, options)[0], truth))
    for words, errors in (("alone", alone), ("with the type", typed)):
        found, stated = np.mean(errors, axis=0)
        print(f"{len(errors)} further machines from {POSES} poses {words}: {found:.3f} mm off, stated {stated:.3f} mm")

    for week in range(1, WEEKS):
        if week == WEEKS - 1:
            for k, (joint, by) in CHANGED.items():
                fleet.change(k, joint, by)
        for k, machine in enumerate(fleet.machines):
            day = str(BEGIN + 7 * week)
            store.add_table(f"R{k + 1:02d}", day, measured(robot, machine, 10, 1000 * week + k), role="check")
    done = run_job(store, CalibrateTables(robot, options, of, role="check"))
    found = fleet_changes(of, visits_of(store))
    print(history_line(found), *(f"{group}: {words}" for group, words in group_lines(found)), sep="\n")
    print(look_first(found, 5))
    Path("fleet.html").write_text(fleet_page(of, found, alpha=0.05, version=""), encoding="utf-8")


if __name__ == "__main__":
    main()
