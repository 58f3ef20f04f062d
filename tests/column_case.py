"""Run a command with one more column on which an effect depends: the pressure of a balancing cylinder at joint 2.

``python column_case.py FOLDER``: of ``recorded.py`` one field is added, as the page on architecture says, and nothing else.
"""

from __future__ import annotations

import csv
import importlib.util
import sys
import types
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

FIELD = """    pressure: Annotated[
        np.ndarray | None, Variable("number", "", "pressure", label="pressure of the cylinder", typical=5.0)
    ] = None
"""
BEFORE = "    droop: Annotated["
TURN = 2e-4  # turn of joint 2 by one unit of pressure [rad]


def add_the_column() -> None:
    """Load ``pincal.recorded`` with one more field, before any other part of the library does."""
    spec = importlib.util.find_spec("pincal.recorded")
    assert spec is not None and spec.origin is not None and "pincal.recorded" not in sys.modules
    text = Path(spec.origin).read_text(encoding="utf-8")
    assert text.count(BEFORE) == 1
    module = types.ModuleType("pincal.recorded")
    module.__file__ = spec.origin
    sys.modules["pincal.recorded"] = module
    exec(compile(text.replace(BEFORE, FIELD + BEFORE), spec.origin, "exec"), module.__dict__)


def main(folder: Path) -> None:
    """Calibrate a robot whose joint 2 follows the pressure, design a check of it, and diagnose by the check's rows."""
    add_the_column()
    from pincal import Options, Robot, calibrate, diagnose, load_model, register_effect
    from pincal import simulate as sim
    from pincal.builtin import kuka_urdf_path
    from pincal.cli import pincal as command
    from pincal.design import health
    from pincal.measure.table import read_measurements, write_table
    from pincal.model.conditions import PoseSet
    from pincal.model.effect import Candidate, Discoverable, Locus, Term
    from pincal.model.effects import GEOMETRIC
    from pincal.parameters import Parameter

    @register_effect
    @dataclass(frozen=True)
    class CylinderPressure(Discoverable):
        """The joint turns in proportion to the pressure of a cylinder that balances it."""

        joint: str
        name = "cylinder_pressure"
        meaning = "the joint turns with the pressure of its cylinder"
        locus = property(lambda self: Locus(self.joint, "drive", follows="pressure"))

        @classmethod
        def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
            """Yield the cylinder at every joint."""
            yield from (Candidate(cls(joint)) for joint in situation.joints)

        def parameters(self, chain):
            """Turn by one unit of pressure [rad]."""
            return (Parameter(f"{self.joint}.cylinder", "rad", self.name, nominal=0.0, size=1e-3),)

        def terms(self, chain, conditions, moments):
            """Add to the coordinate that the joint drives."""
            k = int(chain.drives[chain.robot.joint_names.index(self.joint)])
            return (Term(0, k, conditions.column("pressure")),)

    rng = np.random.default_rng(3)
    robot = Robot.from_urdf(kuka_urdf_path(), tip="tool0")
    machine = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    machine = machine.draw_errors(rng, sigma_length=3e-4, sigma_angle=3e-4, sigma_offset=3e-4)

    def measured(name: str, q: np.ndarray) -> None:
        pressure = rng.uniform(4.0, 6.0, len(q))
        tips = machine.tip(q + TURN * np.outer(pressure, np.arange(len(machine.names)) == 1))
        position = tips[:, :3, 3] + tips[:, :3, :3] @ (0.1, 0.05, 0.15) + 5e-5 * rng.standard_normal((len(q), 3))
        columns = dict(zip((*machine.names, "x", "y", "z"), (*q.T, *position.T), strict=True))
        write_table(folder / name, columns | {"pressure": pressure})

    measured("fit.csv", sim.plan_poses(machine.arm, 100, rng))
    options = Options(effects=(*GEOMETRIC, CylinderPressure("joint_2")), sigma=5e-5)
    fit = calibrate(robot, read_measurements(folder / "fit.csv", robot), options)
    turn = fit.values[[parameter.name for parameter in fit.problem.parameters].index("joint_2.cylinder")]
    assert abs(turn - TURN) < 2e-5, turn
    model = folder / "model.json"
    fit.save(model)
    # What is simulated of a check takes most of its time, and decides nothing here.
    health.CheckRequest = partial(health.CheckRequest, draws=20)
    plan = ["design", str(model), "--check", "--notice", "2mm", "--candidates", "60", "--out", str(folder / "check.csv")]
    assert command.main(args=plan, standalone_mode=False) == 0
    with (folder / "check.csv").open(encoding="utf-8") as stream:
        planned = [[float(row[name]) for name in machine.names] for row in csv.DictReader(stream)]
    measured("check_read.csv", np.array(planned))
    calibrated = load_model(model)
    found = diagnose(calibrated, read_measurements(folder / "check_read.csv", robot))
    assert not found.changed, found
    # Rows that lack it are taken at its mean over the calibration's rows.
    mean, spread = calibrated.covered.days["pressure"]
    assert abs(mean - 5.0) < 0.2 and 0.4 < spread < 0.8


if __name__ == "__main__":
    main(Path(sys.argv[1]))
