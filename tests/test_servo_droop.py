"""Joints commanded and read back in one table: which are fitted is told, and what the other ones say is one effect."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from machines import angles, planar

from pincal import GEOMETRIC, Options, Robot, run_discovery
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.measure.table import read_measurements

JOINTS = ("a", "b")
HEAD, ROWS = "a,b,x,y,z", ((0.1, 0.2), (0.3, 0.4), (0.5, 0.7))


def table(folder: Path, **others: list[float]) -> Path:
    """Return a file with further columns."""
    path = folder / "rows.csv"
    lines = [",".join([HEAD, *(name.replace("__", " [deg]") for name in others)])]
    for i, (a, b) in enumerate(ROWS):
        lines.append(",".join(map(str, [a, b, 1.0, 0.0, 0.0, *(column[i] for column in others.values())])))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_a_table_says_which_positions_are_fitted(tmp_path: Path) -> None:
    """The droop is commanded minus read back whichever of them is the joints' own; units convert; a warning says which."""
    with pytest.warns(PincalWarning, match="fitted, as positions that were read back; commanded_a"):
        rows = read_measurements(table(tmp_path, commanded_a=[0.11, 0.3, 0.5]), JOINTS)
    np.testing.assert_allclose(rows.droop, [[0.01, 0.0], [0.0, 0.0], [0.0, 0.0]], atol=1e-15)
    degrees = np.degrees([0.19, 0.4, 0.7]).tolist()
    with pytest.warns(PincalWarning, match="fitted, as positions that were commanded; read_b"):
        rows = read_measurements(table(tmp_path, read_b__=degrees), JOINTS)
    np.testing.assert_allclose(rows.droop, [[0.0, 0.01], [0.0, 0.0], [0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(rows.select([0]).droop, [[0.0, 0.01]], atol=1e-12)


def test_two_records_beside_the_joints_are_refused(tmp_path: Path) -> None:
    """Nobody could say what the joints' own columns are then; the message says what to do."""
    with pytest.raises(MeasurementError, match="expected two records: name the one to fit as the joints"):
        read_measurements(table(tmp_path, commanded_a=[0.1] * 3, read_a=[0.1] * 3), JOINTS)


def test_the_simulated_encoder_sees_the_droop() -> None:
    """The joint sags by its torque times the droop, and is read where it stands; --hide read leaves that out."""
    droop = sim.ServoDroop(joint="lift", size=1e-6, stiction=0.0)
    machine, q = planar(effects=(droop,)), np.array([[0.0, 0.0], [np.pi / 2, 0.0]])
    read = sim.Instrument().measure(machine, q)["read_lift"]

    np.testing.assert_allclose(read - q[:, 0], angles(machine, q), rtol=0, atol=1e-12)
    assert read[0] < -1e-5 and abs(read[1] - q[1, 0]) < 1e-8
    assert "read_lift" not in sim.Instrument().measure(machine, q, hide=["read"])


def measured(n: int = 150) -> tuple[Measurements, np.ndarray, np.ndarray]:
    """Return rows of a KUKA whose joint 2 droops, as commanded, and the positions commanded and read back, (N, 6)."""
    rng = np.random.default_rng(3)
    machine = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    machine = machine.with_effects(sim.ServoDroop(joint="joint_2", size=2e-8, stiction=1e-4))
    q = sim.plan_poses(machine.nominal, n, rng)
    columns = sim.Instrument(sigma=5e-5, targets=np.array([0.1, 0.05, 0.2])).measure(machine, q, rng=rng)
    read = q.copy()
    read[:, 1] = columns["read_joint_2"]
    position = np.column_stack([columns[axis] for axis in "xyz"])
    return measurements_from_arrays(machine.names, q, position=position, droop=q - read), q, read


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
def test_positions_that_were_only_commanded_are_found_out() -> None:
    """Fitted as commanded, the joint is off by all of its droop; as read back, nothing is left to name."""
    robot, options = Robot.from_urdf(kuka_urdf_path(), tip="tool0"), Options(effects=GEOMETRIC, sigma=5e-5)
    rows, q, read = measured()
    effects = run_discovery(robot, rows, options).findings.effects
    (found,) = (entry for entry in effects if entry.effect not in ("joint_elasticity", "bearing_elasticity"))
    (part,) = found.parameters.values()

    assert (found.effect, found.joint) == ("servo_droop", "joint_2")
    assert part.sigma is not None and abs(part.value + 1.0) < 3.0 * part.sigma
    honest = measurements_from_arrays(rows.joint_names, read, position=rows.position, droop=q - read)
    assert not run_discovery(robot, honest, options).findings.effects
