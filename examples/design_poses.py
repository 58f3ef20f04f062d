"""Designed poses compared with random ones: predicted errors, and errors on simulated machines.

A KUKA KR 125/2 carries 100 kg and is calibrated, geometry and elasticity, from 40 positions that a laser tracker measures
with 0.05 mm of noise. It is used over all of its reach. There are two campaigns: in a cell, the tracker is in front of the
robot and sees a box; in an open hall, it sees every pose. Each is done with designed poses and with random ones under the
same constraints. The machines are simulated, share no code with the fitted model, and differ in geometry and compliance
from draw to draw; errors are those at held-out poses, anywhere within reach. Run it as

    python examples/design_poses.py [--draws 50] [--poses 40]
"""

from __future__ import annotations

import argparse

import numpy as np

from pincal import DesignRequest, Measurements, Options, Robot, calibrate, design_poses, measurements_from_arrays
from pincal.builtin import kuka_urdf_path
from pincal.design.pose_design import Design
from pincal.design.reach import Limits, Reach, SensorSetup
from pincal.simulate import Instrument, TrueMachine
from pincal.simulate.typical import draw_typical_elasticity, draw_typical_errors

NOISE = 5e-5  # standard deviation of one coordinate [m]
LOAD, LOAD_COM = 100.0, (0.0, 0.0, 0.2)  # [kg], [m in the tip frame]
TARGET = (0.08, 0.06, 0.15)  # the reflector in the tip frame [m]
TRACKER = (4.5, -1.0, 1.2)  # in the robot's base frame [m]
BOX = (0.8, -1.2, 0.2, 2.4, 1.2, 2.0)  # what it sees of the cell: least and largest x, y, z [m]
HELD_OUT = 300
ROBOT = Robot.from_urdf(kuka_urdf_path())
OPTIONS = Options(sigma=NOISE, payload_centre=LOAD_COM)
CAMPAIGNS = {
    "in a cell, the tracker in front": Reach(ROBOT, SensorSetup(tool=TARGET, instrument=TRACKER), Limits(box=BOX)),
    "in an open hall": Reach(ROBOT, SensorSetup(tool=TARGET)),
}


def draw_machine(rng: np.random.Generator) -> TrueMachine:
    """Return a machine with errors of geometry, and with compliant drives and bearings."""
    machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    return draw_typical_elasticity(draw_typical_errors(machine, rng), rng)


def positions(machine: TrueMachine, q: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
    """Return positions of the target, shape (N, 3) [m], with noise if there is a source of noise."""
    load = np.full(len(q), LOAD)
    sigma = 0.0 if rng is None else NOISE
    tracker = Instrument(targets=TARGET, sigma=sigma)
    table = tracker.measure(machine, q, rng=rng, payload=load, payload_com=LOAD_COM)
    return np.column_stack([table[axis] for axis in "xyz"])


def table(q: np.ndarray, position: np.ndarray) -> Measurements:
    """Return the rows of a target at poses q, the load on the tool."""
    return measurements_from_arrays(ROBOT.joint_names, q, position=position, payload=np.full(len(q), LOAD))


def error_held_out(machine: TrueMachine, q: np.ndarray, held_out: Measurements, rng: np.random.Generator) -> float:
    """Calibrate from poses q, and return the error of the position at poses held out, root mean square [m]."""
    fit = calibrate(ROBOT, table(q, positions(machine, q, rng)), OPTIONS)
    return float(np.sqrt(np.mean(np.sum(fit.readings(held_out).residuals(fit.values) ** 2, axis=0))))


def realised(reach: Reach, design: Design, draws: int) -> np.ndarray:
    """Return the errors with the designed and with random poses, medians over machines, noise and draws, shape (2,) [m]."""
    pool = reach.draw(1500, np.random.default_rng(1)).q
    held_out = reach.draw(HELD_OUT, np.random.default_rng(2), measured=False).q
    errors = []
    for seed in range(draws):
        rng = np.random.default_rng([3, seed])
        machine = draw_machine(rng)
        drawn = pool[rng.choice(len(pool), len(design.q), replace=False)]
        truth = table(held_out, positions(machine, held_out))
        errors.append([error_held_out(machine, q, truth, rng) for q in (design.q, drawn)])
    return np.asarray(np.median(errors, axis=0))


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--draws", type=int, default=50, help="random sets of poses (default: %(default)s)")
    parser.add_argument("--poses", type=int, default=40, help="in a set (default: %(default)s)")
    chosen = parser.parse_args()
    print(f"KUKA KR 125/2, geometry and elasticity, {LOAD:g} kg, noise {NOISE * 1e3:g} mm, {chosen.poses} poses")
    print(f"errors anywhere in reach, rms [mm]; random: the median of {chosen.draws} draws      designed  random  ratio")
    for name, reach in CAMPAIGNS.items():
        request = DesignRequest(poses=chosen.poses, payloads=[LOAD])
        design = design_poses(ROBOT, request, OPTIONS, rig=reach.rig, limits=reach.limits)
        found, seen = design.found, realised(reach, design, chosen.draws)
        print(f"{name}: {design.drawn.in_words()}")
        for what, mine, random in (("predicted", found.designed.error, found.random.error), ("realised", *seen)):
            print(f"  {what:66s} {1e3 * mine:10.4f} {1e3 * random:8.4f} {random / mine:6.2f}")
        print(f"  {'predicted lower bound for any choice of the candidates':66s} {1e3 * (design.bound or 0.0):10.4f}")
        equal = [str(point.poses) for point in design.curve if point.random.error <= found.designed.error]
        print(f"  random poses for the same accuracy: {equal[0] if equal else f'more than {design.curve[-1].poses}'}")


if __name__ == "__main__":
    main()
