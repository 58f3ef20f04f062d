"""The measuring setup of the paper: a camera in the hand of the KUKA KR 125/2 looks at the two-sided object of Fig. 5.

Radkhah, Hemker, Friedmann, von Stryk, "Towards the deployment of industrial robots as measurement instruments", sections
IV.A and V: points 25 mm apart on two sides, three image fields per side, each seen in two joint configurations. The robot is
that of Table I (exact readings), or drawn with the spread of real ones (readings with noise), and evaluated by code that is
independent of the fitted model; 36 geometric parameters and the 9 elastic ones of joints 1 to 3 are free.
Run it as

    python examples/kuka_camera.py [--draws 12]

which takes a minute or two. With OPENBLAS_NUM_THREADS=1 it takes a quarter of that, as small matrices gain nothing from
several threads; with --draws 40 the ratios are known to a tenth.
"""

from __future__ import annotations

import argparse
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pincal import FittedRobot, Options, Robot, Setup, measurements_from_arrays
from pincal.builtin import kuka_urdf_path
from pincal.calibration.checked_fit import fitted
from pincal.measure.measurements import Measurements
from pincal.model.effects import GEOMETRIC, BearingElasticity, JointElasticity
from pincal.sensors.lens import Lens
from pincal.simulate import View, paper_object, paper_transform, plan_views, read_arm
from pincal.simulate.paper_machine import ELASTICITY, NOMINAL, PAYLOAD_COM, PAYLOAD_MASS, REAL, Geometry, paper_moments

VIEWS, OTHER = 2, 6  # joint configurations a field: to fit, and others to predict
NOISE = 5e-5  # of a point in the camera's frame [m]
PIXELS = 0.1  # of a point in the image [px]
SPREAD, BENDING = 3e-3, 1e-3  # how robots differ: of a length [m] or angle [rad]; of a bending [rad]

ROBOT = Robot.from_urdf(kuka_urdf_path())
ARM = read_arm(kuka_urdf_path(), "tool0")
ELASTIC_JOINTS = ROBOT.joint_names[:3]
EFFECTS = (*GEOMETRIC, JointElasticity(joints=ELASTIC_JOINTS), BearingElasticity(joints=ELASTIC_JOINTS))
OBJECT = paper_object()
LENS = Lens(fx=2400.0, fy=2405.0, u0=1024.0, v0=768.0, k1=-0.08, k2=0.05, p1=4e-4, p2=-3e-4)


def frame(angles: tuple[float, ...], place: tuple[float, ...]) -> np.ndarray:
    """Return a transform of XYZ Euler angles [rad] and a place [m]."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_euler("XYZ", angles).as_matrix(), place
    return out


T_TIP_CAMERA = frame((0.1, -0.2, 0.7), (0.08, 0.0, 0.12))
T_BASE_OBJECT = frame((0.03, -0.02, 0.4), (1.5, 0.2, 0.9))


# Joint positions, shape (N, 6), and the field of the object that each sees, shape (N,).
Plan = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Case:
    """A kind of measurement, and the quantities known beforehand.

    Attributes:
        words: its name.
        in_pixels: whether images are measured instead of points in the camera's frame.
        is_placed: whether the camera's mount and the object's place are known, as in the paper.
        sigma: noise of a reading [m or px].
    """

    words: str
    in_pixels: bool
    is_placed: bool
    sigma: float

    @property
    def setup(self) -> Setup:
        """The object is a known artefact; the lens is identified with everything else unless all is given."""
        places = OBJECT.places.tolist()
        points = {name: (x, y, z) for name, (x, y, z) in zip(OBJECT.names, places, strict=True)}
        return Setup(points=points, lens=LENS if self.in_pixels and self.is_placed else None)

    def options(self, sigma: float | None) -> Options:
        """Return how to calibrate."""
        known: dict[str, Any] = {}
        if self.is_placed:
            known = {"base": np.linalg.inv(T_BASE_OBJECT), "tools": {"camera": T_TIP_CAMERA}}
        return Options(effects=EFFECTS, sigma=sigma, setup=self.setup, payload_centre=PAYLOAD_COM, **known)


CASES = (
    Case("points in the camera's frame, mount and object's place known", False, True, NOISE),
    Case("points in the camera's frame, both unknown", False, False, NOISE),
    Case("images, lens, mount and object's place known", True, True, PIXELS),
    Case("images, all three unknown", True, False, PIXELS),
)


@dataclass(frozen=True)
class Machine:
    """A robot of this type: that of Table I unless another is given."""

    geometry: Geometry = field(default_factory=lambda: REAL)
    elasticity: Geometry = field(default_factory=lambda: ELASTICITY)

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Machine:
        """Draw a robot from the priors of the calibration: 3 mm, 3 mrad, and at most 1 mrad of deflection."""
        geometry = {name: tuple(np.array(row) + rng.normal(0.0, SPREAD, 6)) for name, row in NOMINAL.items()}
        largest = largest_moments()
        constants = rng.normal(0.0, BENDING / np.maximum(largest, 0.1 * largest.max()))
        return cls(
            geometry, {f"k_{axis}": (*column, 0.0, 0.0, 0.0) for axis, column in zip("xyz", constants.T, strict=True)}
        )


def plan(views: int, rng: np.random.Generator) -> Plan:
    """Return joint positions in which the nominal robot sees each field, and the field that each sees."""
    places = OBJECT.places @ T_BASE_OBJECT[:3, :3].T + T_BASE_OBJECT[:3, 3]
    found = []
    for k in range(OBJECT.n_fields):
        _, normal, _ = OBJECT.look_at(k)
        centre, facing = places[OBJECT.field == k].mean(axis=0), T_BASE_OBJECT[:3, :3] @ normal
        view = View(camera_pose=T_TIP_CAMERA, look_at=centre, facing=facing, tilt=0.5)
        found.append(plan_views(ARM, views, rng=rng, view=view))
    return np.vstack(found), np.repeat(np.arange(OBJECT.n_fields), views)


@cache
def largest_moments() -> np.ndarray:
    """Return the largest moments of each elastic joint about x, y and z in some views, shape (3, 3) [N m]."""
    return np.asarray(np.abs(paper_moments(plan(VIEWS, np.random.default_rng(0))[0], geometry=NOMINAL)).max(axis=0)[:3])


@cache
def planned(seed: int) -> tuple[Plan, Plan]:
    """Return views to fit and others to predict; all cases have the same."""
    rng = np.random.default_rng(seed)
    return plan(VIEWS, rng), plan(OTHER, rng)


@cache
def drawn(seed: int) -> tuple[Machine, Plan, Plan, np.random.Generator]:
    """Return a robot, views to fit and others to predict, which all cases have, and the source of numbers after these."""
    rng = np.random.default_rng([1, seed])
    return Machine.drawn(rng), plan(VIEWS, rng), plan(OTHER, rng), rng


def measure(case: Case, views: Plan, robot: Machine, noise: np.random.Generator | None = None) -> Measurements:
    """Return the camera's readings of the points of the field in view; exact without a source of noise."""
    q, fields = views
    flange = paper_transform(q, geometry=robot.geometry, elasticity=robot.elasticity)
    T_object_camera = np.linalg.inv(T_BASE_OBJECT) @ flange @ T_TIP_CAMERA
    pose, point = np.nonzero(OBJECT.field == fields[:, None])
    away = OBJECT.places[point] - T_object_camera[pose, :3, 3]
    seen = np.einsum("nji,nj->ni", T_object_camera[pose, :3, :3], away)
    reading = LENS.project(seen) if case.in_pixels else seen
    if noise is not None:
        reading = reading + noise.normal(0.0, case.sigma, reading.shape)
    columns: dict[str, Any] = {"pixel" if case.in_pixels else "camera_point": reading}
    names = np.array(OBJECT.names)[point]
    return measurements_from_arrays(
        ROBOT.joint_names, q[pose], point=names, payload=np.full(len(pose), PAYLOAD_MASS), **columns
    )


def errors(found: FittedRobot, table: Measurements, values: np.ndarray | None = None) -> np.ndarray:
    """Return the errors of held-out readings as lengths at the object, shape (N,) [m]."""
    displacements = found.readings(table).displacements(found.values if values is None else values)
    return np.asarray(np.linalg.norm(displacements, axis=1))


def foretold(found: FittedRobot, table: Measurements) -> float:
    """Return the root mean square error of held-out readings predicted by the covariance [reading's unit]."""
    problem = found.readings(table)
    J = np.concatenate([part for _, _, part in problem.linearise(found.values, found.solution.free)], axis=2)
    J = J.reshape(len(J), -1)
    return float(np.sqrt(np.mean(np.sum(J * (found.solution.known.covariance @ J), axis=0))))


def without_noise(case: Case, seeds: int) -> None:
    """Fit exact readings of twelve images and predict others."""
    worst, nominal, steps = 0.0, 0.0, 0
    for seed in range(seeds):
        measured, other = (measure(case, views, Machine()) for views in planned(seed))
        found = fitted(ROBOT, measured, case.options(None))
        worst, steps = max(worst, errors(found, other).max()), max(steps, found.fit.iterations)
        nominal = max(nominal, errors(found, other, found.fit.nominal.values).max())
    print(f"  exact: nominal max {nominal * 1e3:.2f} mm, held-out max {worst:.1e} m, at most {steps} iterations")


def with_noise(case: Case, draws: int) -> None:
    """Fit readings with noise, each time of another robot, and compare the held-out error with the covariance."""
    squares, expected, chi2 = [], [], []
    for seed in range(draws):
        robot, views, others, rng = drawn(seed)
        measured, other = measure(case, views, robot, deepcopy(rng)), measure(case, others, robot)
        found = fitted(ROBOT, measured, case.options(case.sigma))
        squares.append(np.mean(found.readings(other).residuals(found.values) ** 2))
        expected.append(foretold(found, other) ** 2)
        chi2.append(found.solution.cost)
    typical = np.sqrt(np.median(squares))
    # Each against its own: a few unlucky sets of twelve views would outweigh all others.
    ratio = np.sqrt(np.mean(np.divide(squares, expected)))
    unit, factor = ("px", 1.0) if case.in_pixels else ("mm", 1e3)
    print(f"  noise {case.sigma * factor:g} {unit}, {draws} robots: held-out rms {typical * factor:.4f} {unit} a coordinate "
          f"(median), ratio to what the covariance foretells {ratio:.3f}, chi-square {np.mean(chi2):.3f}")  # fmt: skip


def main() -> None:
    """Run the case study."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=2, help="sets of exact readings (default: %(default)s)")
    parser.add_argument("--draws", type=int, default=12, help="sets of readings with noise (default: %(default)s)")
    chosen = parser.parse_args()
    print(f"{len(OBJECT.names)} points 25 mm apart in {OBJECT.n_fields} fields, {VIEWS} joint configurations a field")
    for case in CASES:
        print(f"\n{case.words}")
        without_noise(case, chosen.seeds)
        with_noise(case, chosen.draws)


if __name__ == "__main__":
    main()
