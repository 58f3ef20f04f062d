"""Any arm: a random 6R robot, from its URDF to a calibrated URDF that any program reads.

The robot is drawn at random: lengths, twists, the rotation of each joint frame about its axis, masses. The real machine has
errors in all of them, drives and bearings that are compliant under its own weight, and an unknown pose in a hall with a
laser tracker. 300 noisy positions are measured; the result is compared with the truth at 500 other poses. Run it as

    python examples/any_6r_arm.py [--seed 3] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pincal import GEOMETRIC, Conditions, Options, Robot, load_model, measurements_from_arrays, run_calibration
from pincal.io.urdf_export import calibrated_urdf
from pincal.measure.measurements import Measurements
from pincal.model.chain import Chain
from pincal.model.model import Model
from pincal.simulate import Instrument, TrueMachine, plan_poses

JOINTS = 6
NOISE = 5e-5  # standard deviation of one component of a measured position [m]
MEASURED, OTHER = 300, 500  # poses to calibrate with, and others to judge by
MASSES = np.array([60.0, 40.0, 25.0, 12.0, 6.0, 3.0])  # of a typical link [kg], drawn to +- 40 %
LENGTHS = np.array([0.3, 0.6, 0.3, 0.3, 0.15, 0.05])  # of a typical link [m], likewise
COMPLIANCE = (5e-7, 3e-6)  # of drives and bearings [rad/(N m)]

_LINK = """  <link name="{name}">
    <inertial>
      <origin xyz="{centre}"/><mass value="{mass}"/>
      <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>
    </inertial>
  </link>
"""
_JOINT = """  <joint name="{name}" type="{kind}">
    <parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}" rpy="{rpy}"/>
"""
_AXIS = '    <axis xyz="0 0 1"/><limit lower="-2.9" upper="2.9" effort="1000" velocity="3"/>\n'


def random_urdf(rng: np.random.Generator) -> str:
    """Return the URDF of a random 6R arm with skew axes.

    Each joint frame sits at the foot of the common normal to the axis before: this is where the model lets a bearing give
    way, as the paper does. Elsewhere on the axis up to a tenth of a millimetre would be left.
    """
    text = ['<robot name="random_6r">\n  <link name="base"/>\n']
    xyz, turn = np.array([0.0, 0.0, 0.4]), Rotation.from_rotvec(rng.normal(0.0, 0.2, 3))
    lengths, masses = LENGTHS * rng.uniform(0.6, 1.4, JOINTS), MASSES * rng.uniform(0.6, 1.4, JOINTS)
    for i in range(JOINTS):
        parent, name = "base" if i == 0 else f"link_{i}", f"link_{i + 1}"
        text.append(_joint(f"joint_{i + 1}", "revolute", parent, name, xyz, turn) + _AXIS + "  </joint>\n")
        to_next = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
        xyz = lengths[i] * to_next.apply([0.9, 0.0, rng.uniform(-0.4, 0.4)])
        # The next axis is skew to this one, and its frame has a random rotation about it.
        twist = Rotation.from_euler("x", rng.uniform(0.3, np.pi / 2) * rng.choice([-1.0, 1.0]))
        turn = to_next * twist * Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
        centre = rng.uniform(0.2, 0.8) * xyz + rng.normal(0.0, 0.02, 3)
        text.append(_LINK.format(name=name, centre=_numbers(centre), mass=masses[i]))
    text.append('  <link name="flange"/>\n' + _joint("mount", "fixed", name, "flange", xyz, turn) + "  </joint>\n</robot>\n")
    return "".join(text)


def _joint(name: str, kind: str, parent: str, child: str, xyz: np.ndarray, turn: Rotation) -> str:
    # A URDF's roll, pitch and yaw turn about fixed axes: x, y, z in this order.
    rpy = _numbers(turn.as_euler("xyz"))
    return _JOINT.format(name=name, kind=kind, parent=parent, child=child, xyz=_numbers(xyz), rpy=rpy)


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)


def build_machine(urdf: Path, rng: np.random.Generator) -> TrueMachine:
    """Return the real machine behind a URDF."""
    machine = TrueMachine.from_urdf(urdf, tip="flange")
    machine = machine.draw_errors(rng, sigma_length=5e-4, sigma_angle=1e-3, sigma_offset=2e-3).draw_masses(rng, sigma=0.03)
    drive, bearing = rng.uniform(*COMPLIANCE, (2, JOINTS))
    # A bearing has the same compliance about all axes across its own, and rotates with the link, so that the rotation of
    # the joint frames in the URDF does not matter.
    return replace(machine, compliance=np.column_stack([bearing, bearing, drive]), moment_frame="after")


def observe(
    machine: TrueMachine, q: np.ndarray, hall: np.ndarray, tool: np.ndarray, *, rng: np.random.Generator | None
) -> Measurements:
    """Measure a reflector on the flange with the tracker; without a source of noise, exactly."""
    tracker = Instrument(pose=hall, targets=tool, sigma=0.0 if rng is None else NOISE)
    columns = tracker.measure(machine, q, rng=rng)
    return measurements_from_arrays(machine.names, q, position=np.column_stack([columns[axis] for axis in "xyz"]))


def calibrate_and_judge(folder: Path, seed: int) -> None:
    """Draw, measure, calibrate, export, reload and validate."""
    rng = np.random.default_rng(seed)
    urdf = folder / "robot.urdf"
    urdf.write_text(random_urdf(rng), encoding="utf-8")
    machine, robot = build_machine(urdf, rng), Robot.from_urdf(urdf)
    hall, tool = np.eye(4), rng.uniform(0.05, 0.2, 3)
    hall[:3, :3], hall[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.uniform(-4.0, 4.0, 3)
    measured, other = (plan_poses(machine.nominal, count, rng, min_height=None) for count in (MEASURED, OTHER))
    table, truth = observe(machine, measured, hall, tool, rng=rng), observe(machine, other, hall, tool, rng=None)

    options = Options(sigma=NOISE, moment_frame="after")
    calibration = run_calibration(robot, table, options, holdout=truth)
    fit, result = calibration.fit, calibration.result
    export = calibrated_urdf(fit.model, fit.values)
    (folder / "calibrated.urdf").write_bytes(export.text)
    fit.save(folder / "model.json", provenance={"seed": seed})

    reloaded = load_model(folder / "model.json")
    predicted = reloaded.predict(Conditions.at(other))[:, :, 3]
    model_error = 1e3 * np.linalg.norm(predicted - truth.position, axis=1)
    rigid = geometry_difference(folder / "calibrated.urdf", export.tip, fit.model, fit.values, other)
    nominal = result.error["nominal"]["test"]
    print(f"Random 6R arm, seed {seed}, reach {robot.reach:.2f} m")
    print(f"  {MEASURED} poses with {NOISE * 1e3:g} mm noise to calibrate with, {OTHER} exact ones for validation")
    print(f"  nominal model          mean {nominal['mean_mm']:7.4f} mm, max {nominal['max_mm']:7.4f} mm")
    print(f"  model.json, reloaded   mean {model_error.mean():7.4f} mm, max {model_error.max():7.4f} mm")
    print(f"  reduced chi-square     {result.chi2_reduced:.3f} after {result.iterations} iterations")
    print(f"  calibrated.urdf        flange within {rigid:.1e} m of the model's geometry at all {OTHER} poses")
    print(f"  {nominal['mean_mm'] / model_error.mean():.0f} times more accurate")


def geometry_difference(urdf: Path, tip: str, model: Model, values: np.ndarray, q: np.ndarray) -> float:
    """Return the largest distance between the flange of the written URDF and that of the model without elasticity [m]."""
    written = Robot.from_urdf(urdf, tip=tip)
    rigid = Model(Chain.of(model.chain.robot), GEOMETRIC)
    picked = np.array([values[model.index(name)] for name in rigid.names])
    flange = rigid.predict(picked, Conditions.at(q))[:, :, 3]
    return float(np.linalg.norm(written.forward_kinematics(q)[:, :3, 3] - flange, axis=1).max())


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=3, help="which robot (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="folder for the URDFs and model.json; a temporary one unless given")
    chosen = parser.parse_args()
    if chosen.out is None:
        with tempfile.TemporaryDirectory() as folder:
            calibrate_and_judge(Path(folder), chosen.seed)
    else:
        chosen.out.mkdir(parents=True, exist_ok=True)
        calibrate_and_judge(chosen.out, chosen.seed)


if __name__ == "__main__":
    main()
