"""Holes of a body-in-white, measured by a 3D sensor on the flange of a KUKA KR 125/2: the case of the paper.

A machine with errors of a typical size, drawn by code that is independent of the model, looks at a calibration object from
60 poses. The calibrated robot then looks at a panel beside it, at six points of the rim of each of four holes, from three
poses each, and runs this program twice. The panel differs from its drawing by a tenth of a millimetre, which the script
knows. Run it as

    python examples/body_in_white.py [--out DIR]

which writes the tables and the part's file to DIR (default: body_in_white) for the commands

    pincal calibrate DIR/kuka.urdf DIR/calibration.csv --points DIR/grid.csv --noise 0.05mm --out DIR/results
    pincal measure DIR/results/model.json DIR/readings.csv --features DIR/part.toml --out DIR/measured

With --measure it does the same in Python, and prints true and measured deviations with their expanded uncertainty.
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import pincal
from pincal.builtin import kuka_urdf_path
from pincal.measure.table import write_table
from pincal.simulate import CalibrationObject, EyeInHand, TrueMachine, grid_object
from pincal.simulate.typical import draw_typical_elasticity, draw_typical_errors

POSES, VIEWS, PASSES = 60, 3, 2  # of the calibration; of each hole; times that the program runs
NOISE = 5e-5  # of a coordinate [m]
RIM = 6  # points of a hole
# Nominal centres on the panel, and radii [m]; the panel's z axis is their normal.
HOLES = {"h1": (0.0, 0.0, 0.010), "h2": (0.18, 0.0, 0.006), "h3": (0.18, 0.12, 0.006), "h4": (0.06, 0.12, 0.008)}
OFF = 8e-5  # how far a hole is from where it should be, and half of it how its radius differs [m]


def frame(angles: tuple[float, ...], place: tuple[float, ...]) -> np.ndarray:
    """Return a transform of roll, pitch and yaw [rad] and a place [m], shape (4, 4)."""
    out = np.eye(4)
    out[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    out[:3, 3] = place
    return out


T_TIP_CAMERA = frame((0.1, -0.2, 0.7), (0.08, 0.0, 0.12))
T_BASE_GRID = frame((0.05, -0.04, 0.4), (1.5, 0.2, 0.9))
T_BASE_PANEL = frame((-0.08, 0.06, 1.1), (1.45, 0.0, 0.95))


@dataclass(frozen=True)
class Cell:
    """A true machine with a sensor on its flange, and where true holes are on the panel."""

    machine: TrueMachine
    holes: dict[str, np.ndarray]  # x, y, z, radius of each [m]

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Cell:
        """Draw a machine, and holes that are not quite where they should be."""
        machine = draw_typical_errors(TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0"), rng)
        machine = draw_typical_elasticity(machine, rng).draw_masses(rng, sigma=0.03)
        off = {name: rng.normal(0.0, OFF, 4) * [1.0, 1.0, 0.3, 0.5] for name in HOLES}
        return cls(machine, {name: np.array([x, y, 0.0, r]) + off[name] for name, (x, y, r) in HOLES.items()})

    def calibration(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Return the readings of the calibration object, by column."""
        looks = EyeInHand(
            target=grid_object(), object_pose=T_BASE_GRID, camera_pose=T_TIP_CAMERA, in_metres=True, sigma=NOISE
        )
        q = looks.plan(self.machine.nominal, POSES, rng=rng)
        return looks.measure(self.machine, q, rng=rng)

    def program(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Return the joint positions in which the nominal arm looks at each hole, shape (VIEWS, 6)."""
        views = {name: self.looking_at(name) for name in HOLES}
        return {name: looks.plan(self.machine.nominal, VIEWS, rng=rng) for name, looks in views.items()}

    def looking_at(self, name: str) -> EyeInHand:
        """Return the sensor and the rim of a hole as it truly is."""
        angle = 2.0 * np.pi * np.arange(RIM) / RIM
        x, y, z, radius = self.holes[name]
        rim = np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle), np.full(RIM, z)])
        points = CalibrationObject.of_points(
            {str(k): place for k, place in enumerate(rim)}, {str(k): (0.0, 0.0, 1.0) for k in range(RIM)}
        )
        return EyeInHand(target=points, object_pose=T_BASE_PANEL, camera_pose=T_TIP_CAMERA, in_metres=True, sigma=NOISE)

    def readings(self, program: dict[str, np.ndarray], rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Return what the sensor reads of the panel in all passes, by column."""
        found: dict[str, list[np.ndarray]] = {}
        for k in range(PASSES):
            for name, q in program.items():
                part = self.looking_at(name).measure(self.machine, q, rng=rng)
                n = len(part["point"])
                part |= {"feature": np.full(n, name), "pass": np.full(n, f"pass {k + 1}")}
                for column, values in part.items():
                    found.setdefault(column, []).append(np.asarray(values))
        return {column: np.concatenate(parts) for column, parts in found.items() if column != "point"}


def part_file() -> str:
    """Return the part's file: four holes, their places and diameters, and a distance."""
    holes = ", ".join(f'"{name}"' for name in HOLES)
    lines = ['unit = "mm"', "", "[datum]", 'kind = "best fit"', f"features = [{holes}]", ""]
    for name, (x, y, radius) in HOLES.items():
        lines += [f"[feature.{name}]", 'kind = "circle"', f"nominal = [{1e3 * x:g}, {1e3 * y:g}, 0]"]
        lines += ["direction = [0, 0, 1]", f"diameter = {2e3 * radius:g}"]
        lines += ["tolerance = { position = 0.5, diameter = 0.15 }", ""]
    lines += ["[feature.h1_h2]", 'kind = "distance"', 'of = ["h1", "h2"]', "nominal = 180", "tolerance = 0.3"]
    return "\n".join(lines) + "\n"


def measure(folder: Path, cell: Cell) -> None:
    """Calibrate and measure from the tables of a folder, and print what is true beside what is found."""
    robot = pincal.Robot.from_urdf(folder / "kuka.urdf")
    table = pincal.read_measurements(folder / "calibration.csv", robot)
    points = {name: tuple(place) for name, place in zip(grid_object().names, grid_object().places.tolist(), strict=True)}
    fit = pincal.calibrate(robot, table, pincal.Options(sigma=NOISE, setup=pincal.Setup(points=points)))
    readings = pincal.read_readings(folder / "readings.csv", robot)
    measured = pincal.measure_part(fit.at(), readings, pincal.Part.from_toml(folder / "part.toml"))
    true = {name: 2e3 * hole[3] for name, hole in cell.holes.items()}
    true["h1_h2"] = 1e3 * float(np.linalg.norm(cell.holes["h1"][:3] - cell.holes["h2"][:3]))
    print("feature  quantity       true   measured        U [mm]")
    for feature in measured.found.features:
        for name in {"diameter", "distance"} & feature.values.keys():
            value = feature.values[name]
            numbers = "".join(f"{number:10.4f} " for number in (true[feature.name], value.value, value.U))
            print(f"{feature.name:8} {name:8} {numbers} {value.decision}")


def main() -> None:
    """Write the tables, and measure."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("body_in_white"), help="folder (default: %(default)s)")
    parser.add_argument("--measure", action="store_true", help="calibrate and measure in Python, too")
    chosen = parser.parse_args()
    rng = np.random.default_rng(3)
    cell = Cell.drawn(rng)
    chosen.out.mkdir(parents=True, exist_ok=True)
    shutil.copy(kuka_urdf_path(), chosen.out / "kuka.urdf")
    grid = grid_object()
    write_table(chosen.out / "grid.csv", {"point": np.array(grid.names)} | dict(zip("xyz", grid.places.T, strict=True)))
    write_table(chosen.out / "calibration.csv", cell.calibration(rng))
    write_table(chosen.out / "readings.csv", cell.readings(cell.program(rng), rng))
    (chosen.out / "part.toml").write_text(part_file(), encoding="utf-8")
    print(f"written to {chosen.out}: kuka.urdf grid.csv calibration.csv readings.csv part.toml")
    if chosen.measure:
        measure(chosen.out, cell)


if __name__ == "__main__":
    main()
