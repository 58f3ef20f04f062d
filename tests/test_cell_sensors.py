"""Instruments of the cell: a fixed camera that sees targets on the tool, and planes that a probe touches or a dial reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pincal import simulate as sim
from pincal.calibration.fitted_robot import FittedRobot, load_model
from pincal.errors import MeasurementError
from pincal.identify.calibrate import fit_tables
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements, measurements_from_arrays, sensor_of
from pincal.measure.table import read_measurements
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot
from pincal.sensors.lens import Lens
from pincal.sensors.setup import Setup

LENS = Lens(2400.0, 2410.0, 1224.0, 1024.0, -0.08, 0.05, 5e-4, -3e-4)
TARGETS = {"left": (0.05, 0.08, 0.12), "right": (-0.06, 0.02, 0.15)}
TIP = np.array([0.05, 0.03, 0.2])
# Robot base in the camera's frame: the camera stands three metres before the arm and looks at it.
CAMERA = np.eye(4)
CAMERA[:3, :3] = Rotation.from_euler("xyz", [1.4, 0.2, -1.3]).as_matrix()
CAMERA[:3, 3] = (0.2, 0.5, 4.0)
# Normal and distance of a table, two walls, and a slanted plate: n.x = d.
PLANES = {
    "table": (0.02, 0.01, 1.0, 0.6),
    "wall": (1.0, 0.03, -0.02, 1.9),
    "side": (0.05, 1.0, 0.1, 0.9),
    "plate": (1, -1, 1, 1.9),
}


def tips(machine: sim.TrueMachine, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return joints and the true tips of n poses."""
    q = sim.plan_poses(machine.nominal, n, np.random.default_rng(seed))
    return q, machine.equilibrium(machine.poses(q)).tip


def images(machine: sim.TrueMachine, robot: Robot, *, poses: int = 120, noise: float = 0.0, seed: int = 3) -> Measurements:
    """Return images of both targets, by a pinhole with distortion written out here."""
    q, tip = tips(machine, poses, seed)
    places = np.stack([tip[:, :3, :3] @ np.array(t) + tip[:, :3, 3] for t in TARGETS.values()], axis=1).reshape(-1, 3)
    x, y, z = (places @ CAMERA[:3, :3].T + CAMERA[:3, 3]).T
    assert z.min() > 0.5
    a, b = x / z, y / z
    r2 = a * a + b * b
    radial = 1.0 + LENS.k1 * r2 + LENS.k2 * r2**2
    u = LENS.fx * (a * radial + 2.0 * LENS.p1 * a * b + LENS.p2 * (r2 + 2.0 * a * a)) + LENS.u0
    v = LENS.fy * (b * radial + LENS.p1 * (r2 + 2.0 * b * b) + 2.0 * LENS.p2 * a * b) + LENS.v0
    pixel = np.column_stack([u, v]) + np.random.default_rng(seed).normal(0.0, noise, (len(u), 2))
    names = np.tile(list(TARGETS), poses)
    return measurements_from_arrays(robot.joint_names, np.repeat(q, 2, axis=0), pixel=pixel, target=names)


def probed(
    machine: sim.TrueMachine, robot: Robot, *, each: int = 40, touching: bool, noise: float = 0.0, seed: int = 5
) -> Measurements:
    """Return readings of a dial before each plane within its 10 mm, or contacts; the arm is brought there by its joints."""
    rng = np.random.default_rng(seed)
    every, tip = tips(machine, 60 * each, seed)
    ends = tip[:, :3, :3] @ TIP + tip[:, :3, 3]
    rows, readings = [], []
    for plane in PLANES.values():
        length = np.linalg.norm(plane[:3])
        normal, d = np.array(plane[:3]) / length, plane[3] / length
        q = every[np.argsort(np.abs(ends @ normal - d))[: 2 * each]]
        wanted = np.zeros(len(q)) if touching else rng.uniform(0.0, 0.01, len(q))

        def height(joints: np.ndarray, normal: np.ndarray = normal, d: float = d) -> np.ndarray:
            tip = machine.equilibrium(machine.poses(joints)).tip
            return np.asarray((tip[:, :3, :3] @ TIP + tip[:, :3, 3]) @ normal - d)

        for _ in range(6):
            at = height(q)
            slopes = np.column_stack([(height(q + step) - at) / 1e-6 for step in 1e-6 * np.eye(6)[:3]])
            q[:, :3] -= slopes * ((at - wanted) / np.maximum((slopes**2).sum(axis=1), 0.04))[:, None]
        good = np.flatnonzero(np.abs(height(q) - wanted) < 1e-12)[:each]
        assert len(good) == each
        rows.append(q[good])
        readings.append(wanted[good])
    reading = np.concatenate(readings) + rng.normal(0.0, noise, each * len(PLANES))
    columns = {"plane": np.repeat(list(PLANES), each)} | ({} if touching else {"gauge": reading})
    return measurements_from_arrays(robot.joint_names, np.concatenate(rows), **columns)  # type: ignore[arg-type]


WAYS = {
    "images, camera known": (images, {}, Setup(lens=LENS)),
    "images, camera unknown": (images, {}, Setup()),
    "dial": (probed, {"touching": False}, Setup()),
    "touch": (probed, {"touching": True}, Setup()),
}


@pytest.mark.long
@pytest.mark.parametrize("way", WAYS)
def test_exact_readings_are_explained_wherever_things_stand(way: str, machine: sim.TrueMachine, kuka: Robot) -> None:
    """Without a first guess of camera, targets, probe or planes, exact readings are predicted on rows held out."""
    make, how, setup = WAYS[way]
    table = make(machine, kuka, **how)  # type: ignore[operator]
    held = np.random.default_rng(1).random(len(table)) < 0.25
    fit = fit_tables(kuka, table.select(~held), Options(effects=GEOMETRIC, setup=setup))
    there = fit.readings(table.select(held))

    assert fit.solution.converged
    assert np.median(np.linalg.norm(fit.station.displacements(fit.nominal.values), axis=1)) > 5e-5
    assert np.linalg.norm(there.displacements(fit.values), axis=1).max() < 1e-9


NOISY = {
    "images": (images, {"noise": 0.1}, Setup(lens=LENS), 0.1),
    "dial": (probed, {"touching": False, "noise": 2e-5}, Setup(), 2e-5),
}


@pytest.mark.parametrize("way", NOISY)
def test_noise_is_all_that_is_left(way: str, machine: sim.TrueMachine, kuka: Robot) -> None:
    """Readings held out are off by their noise, within a sixth of it."""
    make, how, setup, noise = NOISY[way]
    table = make(machine, kuka, **how)  # type: ignore[operator]
    held = np.random.default_rng(1).random(len(table)) < 0.3
    fit = fit_tables(kuka, table.select(~held), Options(effects=GEOMETRIC, setup=setup))
    left = fit.readings(table.select(held)).residuals(fit.values)

    assert np.sqrt(np.mean(left**2)) < 1.16 * noise


def test_camera_and_targets_come_out_where_they_are(machine: sim.TrueMachine, kuka: Robot) -> None:
    """With its focal length unknown the camera is found: place up to the scale that only lengths tell, and parameters."""
    fit = fit_tables(kuka, images(machine, kuka), Options(effects=GEOMETRIC, setup=Setup()))
    own = fit.station.split(fit.values)[1]
    found = np.array([p.nominal + value for p, value in zip(fit.station.sensor.parameters, own, strict=True)])

    np.testing.assert_allclose(found, LENS.values, rtol=2e-2, atol=2e-3)
    np.testing.assert_allclose(found[:4], LENS.values[:4], rtol=1e-3)


@pytest.mark.long
def test_planes_come_out_where_they_are(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Angles between planes, which no place of the base changes, are those of the planes; normals have the length 1."""
    fit = fit_tables(kuka, probed(machine, kuka, touching=False), Options(effects=GEOMETRIC))
    found = fit.station.split(fit.values)[1].reshape(-1, 4)[:, :3]
    names = [parameter.name for parameter in fit.station.sensor.parameters]
    true = np.array([PLANES[name.split(".")[0]][:3] for name in names[::4]], float)
    true /= np.linalg.norm(true, axis=1, keepdims=True)

    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.abs(found @ found.T), np.abs(true @ true.T), rtol=0, atol=2e-3)


@pytest.mark.long
@pytest.mark.parametrize("way", ["images, camera unknown", "dial"])
def test_the_model_file_reads_further_rows(way: str, machine: sim.TrueMachine, kuka: Robot, tmp_path: Path) -> None:
    """A model that comes back from its file has the camera and the planes."""
    make, how, setup = WAYS[way]
    table = make(machine, kuka, **how)  # type: ignore[operator]
    fit = fit_tables(kuka, table, Options(effects=GEOMETRIC, setup=setup))
    FittedRobot.of(fit, {}).save(tmp_path / "model.json")
    back = load_model(tmp_path / "model.json")

    np.testing.assert_array_equal(back.readings(table).residuals(back.values), fit.station.residuals(fit.values))


def test_rows_that_tell_nothing_are_named(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Planes with too few readings, new ones, and planes that are given as points are left out or refused."""
    table = probed(machine, kuka, each=4, touching=True)
    few = table.select(np.arange(len(table))[:-1])
    (excluded,) = sensor_of(few).unusable_rows()  # type: ignore[attr-defined]
    assert excluded.rows.sum() == 3 and "fewer than 4 readings" in excluded.reason and "plate" in excluded.reason
    known = Setup(points=dict.fromkeys(["table", "wall", "side"]))
    (new,) = type(sensor_of(table)).unscorable_rows(table, known)  # type: ignore[attr-defined]
    assert new.rows.sum() == 4 and "plate" in new.reason
    with pytest.raises(MeasurementError, match="'plate' was not among those of the calibration"):
        sensor_of(table, known)
    with pytest.raises(MeasurementError, match="plane 'table' is one of the known points"):
        sensor_of(table, Setup(points=dict.fromkeys(PLANES) | {"table": (0.0, 0.0, 1.0)}))


@pytest.mark.parametrize(
    ("columns", "cells", "kind"),
    [("u,v,target", "1,2,left", "fixed_camera_pixel"), ("u,v,point,target", "1,2,p,left", "camera_pixel"),
     ("plane", "table", "plane"), ("plane,gauge [mm]", "table,1.5", "gauge")],
)  # fmt: skip
def test_columns_tell_the_sensor(tmp_path: Path, columns: str, cells: str, kind: str) -> None:
    """A target without a point is seen by a camera that stands still; a plane with a dial is no contact."""
    (tmp_path / "t.csv").write_text(f"a,b,{columns}\n0,0,{cells}\n")
    assert read_measurements(tmp_path / "t.csv", ("a", "b")).kind == kind


@pytest.mark.parametrize(("columns", "text"), [("u,v", "u v without point or target"), ("gauge", "gauge without plane")])
def test_columns_that_lack_something_are_refused(tmp_path: Path, columns: str, text: str) -> None:
    """The error names what is missing."""
    (tmp_path / "t.csv").write_text(f"a,b,{columns}\n0,0{',1' * len(columns.split(','))}\n")
    with pytest.raises(MeasurementError, match=text):
        read_measurements(tmp_path / "t.csv", ("a", "b"))
