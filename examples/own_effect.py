"""A custom effect (``hose_pull.py``) takes part in discovery, in the fit and in everything after it.

The hose package along the forearm of this KUKA is too short. Wound up by joint 4 it pulls, and joint 5 yields. The catalogue
has no such effect; without the custom one, discovery reports an unnamed effect at joint_5 that depends on joint_4. Run it as

    python examples/own_effect.py
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal import GEOMETRIC, Options, Robot, load_plugin, measurements_from_arrays
from pincal.builtin import kuka_urdf_path
from pincal.discover.run import run_discovery
from pincal.simulate import Arm, Instrument, Poses, TrueMachine, plan_poses
from pincal.simulate.effect import DeformingEffect
from pincal.simulate.state import Deformation, Loads
from pincal.simulate.typical import draw_typical_elasticity, draw_typical_errors

NOISE, POSES = 5e-5, 250  # standard deviation of one coordinate [m], number of measured poses
PULL = 2e-5  # turn of joint 5 when joint 4 has turned by one radian [rad]


@dataclass(frozen=True, kw_only=True)
class Hose(DeformingEffect):
    """The real hose: it lies straight along the forearm and becomes a helix; ``size`` is the turn at one radian [rad]."""

    effect: ClassVar[str] = "hose"
    radius: float = 0.06
    length: float = 1.2

    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        """Turn joint 5 in proportion to the stretch."""
        stretch = np.hypot(self.length, self.radius * poses.q[:, arm.index("joint_4")]) - self.length
        at_one = np.hypot(self.length, self.radius) - self.length
        deformation.joint[:, arm.index("joint_5")] += self.size * stretch / at_one


def main() -> None:
    """Run the example."""
    rng = np.random.default_rng(3)
    machine = draw_typical_errors(TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0"), rng)
    machine = draw_typical_elasticity(machine, rng).with_effects(Hose(size=PULL))
    q = plan_poses(machine.nominal, POSES, rng)
    read = Instrument(targets=(0.1, 0.05, 0.15), sigma=NOISE).measure(machine, q, rng=rng)
    table = measurements_from_arrays(machine.names, q, position=np.column_stack([read[axis] for axis in "xyz"]))
    robot, options = Robot.from_urdf(kuka_urdf_path()), Options(effects=GEOMETRIC, sigma=NOISE)

    for title in ("The catalogue alone", "With hose_pull"):
        if title == "With hose_pull":
            load_plugin("hose_pull")
        report = run_discovery(robot, table, options).report
        print(title)
        for found in (entry for entry in report["effects"] if "elasticity" not in entry["effect"]):
            depends = f", depends on {found['depends_on']}" if "depends_on" in found else ""
            gap = f"{found['gap_before_mm']:.4f} -> {found['gap_after_mm']:.4f} mm"
            print(f"  {found['effect']} at {found['joint']}{depends}: held-out mean {gap}, p {found['p_value']:.0e}")
    own = next(entry["parameters"]["joint_5.hose"] for entry in report["effects"] if entry["effect"] == "hose_pull")
    print(f"Turn at one radian: simulated {PULL:.3e} rad, found {own['value']:.3e} +- {own['sigma']:.1e} rad")


if __name__ == "__main__":
    main()
