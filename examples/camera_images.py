"""From photographs of a ChArUco board to a calibrated robot: a camera in its hand, and nothing else to measure with.

Without arguments, images are rendered: a simulated KUKA KR 125/2 points a camera on its flange at a board, both in unknown
poses. OpenCV finds the corners; robot, lens and both poses are identified jointly and compared with the truth.

    python examples/camera_images.py [--out FOLDER] [--seed 1] [--quick]
    python examples/camera_images.py --images FOLDER --joints joints.csv --robot robot.urdf --squares 12 9 --square 0.06

takes your own photographs: ``joints.csv`` has a column ``image`` with the names of the files and one column per joint, in
rad unless its header says ``joint_1 [deg]``. Needs OpenCV: ``pip install '.[images]'``.
"""

from __future__ import annotations

import argparse
import csv
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

import pincal
from pincal.builtin import kuka_urdf_path
from pincal.measure.points_table import read_points
from pincal.measure.table import read_columns, write_table
from pincal.simulate import TrueMachine, plan_poses
from pincal.simulate.planning import reach

try:
    import cv2
except ImportError:
    print("this example needs OpenCV 4.8 or later; install it with: pip install opencv-python-headless", file=sys.stderr)
    raise SystemExit(3) from None

VIEWS, FRESH, SIZE = 48, 200, (1280, 960)  # photographs to calibrate with, other views to judge by, pixels of a photograph
# The true camera: focal lengths and principal point [px], distortion; the same as OpenCV wants it.
CAMERA = {"fx": 1412.0, "fy": 1409.5, "u0": 651.3, "v0": 471.8, "k1": -0.12, "k2": 0.08, "p1": 6e-4, "p2": -4e-4}
FX, FY, U0, V0, *BENT = CAMERA.values()
LENS = np.array([[FX, 0.0, U0], [0.0, FY, V0], [0.0, 0.0, 1.0]]), np.array(BENT)
DISTANCE, TILT = (0.8, 1.5), (0.0, 0.7)  # of the camera from the board [m], of its view from the board's normal [rad]
TEXTURE = 100  # width of a square in the board's own picture [px]
WALL, DARK, CONTRAST = 120.0, 35.0, 0.7  # grey of the wall behind; what the camera makes of black, and of a grey level
BLUR, GRAIN = 1.0, 6.0  # standard deviations: of the image of a point [px], of a grey level


@dataclass(frozen=True)
class Scene:
    """The truth of the simulated photographs.

    Attributes:
        machine: the robot as it is.
        T_tip_camera: from the camera's frame (z along the view, x to the right) to the flange's, shape (4, 4).
        T_base_board: from the board's frame (x to the right, y down, z into it) to the robot's base, shape (4, 4).
    """

    machine: TrueMachine
    T_tip_camera: np.ndarray
    T_base_board: np.ndarray

    def cameras(self, q: np.ndarray) -> np.ndarray:
        """Return the true poses of the camera in the board's frame, shape (N, 4, 4)."""
        return np.asarray(np.linalg.inv(self.T_base_board) @ self.machine.tip(q) @ self.T_tip_camera)


def build_scene(board: cv2.aruco.CharucoBoard, rng: np.random.Generator) -> Scene:
    """Return a robot with errors of a typical size, a camera on its flange and a board on a table."""
    machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0").draw_masses(rng, sigma=0.03)
    machine = machine.draw_errors(rng, sigma_length=5e-4, sigma_angle=1e-3, sigma_offset=2e-3)
    drive = rng.uniform(1e-7, 4e-7, len(machine.names))  # [rad/(N m)]
    machine = replace(machine, compliance=np.column_stack([0.15 * drive, 0.15 * drive, drive]))
    T_base_board = transform([np.pi - 0.2, 0.15, 0.3], [1.5, 0.3, 0.5])
    T_base_board[:3, 3] -= T_base_board[:3, :3] @ board.getRightBottomCorner() / 2.0
    return Scene(machine, transform([0.3, -0.2, 0.7], [0.09, -0.04, 0.12]), T_base_board)


def transform(angles: list[float] | np.ndarray, place: list[float] | np.ndarray, *, order: str = "xyz") -> np.ndarray:
    """Return transforms of angles about axes [rad], shape (..., 3), and translations [m], shape (..., 3)."""
    T = np.zeros((*np.shape(place)[:-1], 4, 4)) + np.eye(4)
    T[..., :3, :3], T[..., :3, 3] = Rotation.from_euler(order, angles).as_matrix(), place
    return T


def plan_views(scene: Scene, board: cv2.aruco.CharucoBoard, *, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return joint positions in which the camera looks at a point of the board, shape (count, 6)."""
    found = np.empty((0, len(scene.machine.names)))
    while len(found) < count:
        seed = plan_poses(scene.machine.nominal, 2 * count, rng)
        turn = rng.uniform([-np.pi, TILT[0], -np.pi], [np.pi, TILT[1], np.pi], (len(seed), 3))
        T_board_camera = transform(turn, rng.uniform(0.1, 0.9, turn.shape) * board.getRightBottomCorner(), order="ZYZ")
        T_board_camera[:, :3, 3] -= rng.uniform(*DISTANCE, (len(seed), 1)) * T_board_camera[:, :3, 2]
        T_base_tip = scene.T_base_board @ T_board_camera @ np.linalg.inv(scene.T_tip_camera)
        q, is_reached = reach(scene.machine.nominal, seed, goal=T_base_tip)
        found = np.vstack([found, q[is_reached]])
    return found[:count]


def project(T_board_camera: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the exact image of points of the board, shape (K, 2) [px]."""
    T = np.linalg.inv(T_board_camera)
    return np.asarray(cv2.projectPoints(points, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], *LENS)[0][:, 0])


def photograph(scene: Scene, board: cv2.aruco.CharucoBoard, folder: Path, *, quick: bool, rng: np.random.Generator) -> None:
    """Write photographs of the board, and the joint positions in which they were taken."""
    q = plan_views(scene, board, count=VIEWS // 2 if quick else VIEWS, rng=rng)
    views = {f"view_{i + 1:02d}.png": T_board_camera for i, T_board_camera in enumerate(scene.cameras(q))}
    # Lines of sight of the pixels' centres, the first of which is at u = v = 0.
    centres = np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in SIZE)), axis=-1)
    slopes = cv2.undistortPoints(centres.reshape(-1, 1, 2), *LENS).reshape(centres.shape).astype("f4")
    for name, T_board_camera in views.items():
        image = cv2.GaussianBlur(render(board, T_board_camera, slopes=slopes, samples=2 if quick else 4), (0, 0), BLUR)
        image = DARK + CONTRAST * image + GRAIN * rng.standard_normal(image.shape, "f4")
        cv2.imwrite(str(folder / name), np.clip(np.rint(image), 0, 255).astype(np.uint8))
    write_table(folder / "joints.csv", {"image": np.array([*views]), **dict(zip(scene.machine.names, q.T, strict=True))})


def render(board: cv2.aruco.CharucoBoard, T_board_camera: np.ndarray, *, slopes: np.ndarray, samples: int) -> np.ndarray:
    """Return a sharp image, each pixel the mean over ``samples`` times ``samples`` lines of sight, shape (height, width)."""
    texture = board.generateImage([TEXTURE * n for n in board.getChessboardSize()]).astype("f4")
    parts = np.array([[x, y, 0.0] for x in np.linspace(0.0, 1.0, 5) for y in np.linspace(0.0, 1.0, 5)])
    area = project(T_board_camera, parts * board.getRightBottomCorner())
    (u0, v0), (u1, v1) = np.clip([area.min(axis=0) - 20, area.max(axis=0) + 20], 0, SIZE).astype(int)
    # A line of sight meets the board at (x, y, 1) ~ [r_x r_y t]^-1 (slopes, 1), and its corner is half a pixel from the
    # centre of the first pixel of its picture.
    scale = TEXTURE / board.getSquareLength()
    to_board = np.linalg.inv(np.linalg.inv(T_board_camera)[:3, [0, 1, 3]])
    to_picture = np.array([[scale, 0.0, -0.5], [0.0, scale, -0.5], [0.0, 0.0, 1.0]]) @ to_board
    # Enlarging the field of slopes spreads the samples evenly about the centre of each pixel.
    finer = cv2.resize(slopes[v0:v1, u0:u1], None, fx=samples, fy=samples)
    places = cv2.perspectiveTransform(finer, to_picture)
    seen = cv2.remap(texture, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=WALL)
    image = np.full(slopes.shape[:2], WALL, "f4")
    image[v0:v1, u0:u1] = cv2.resize(seen, (u1 - u0, v1 - v0), interpolation=cv2.INTER_AREA)
    return image


def find_corners(detector: cv2.aruco.CharucoDetector, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the board's corners in an image, shape (N,), and their positions, shape (N, 2) [px]."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise pincal.BadInputError(f"{path}: can't be read as an image; expected one for each line of the joint positions")
    corners, numbers, _, _ = detector.detectBoard(image)
    if numbers is None or len(numbers) < 4:
        return np.empty(0, int), np.empty((0, 2))
    # Once more, with a window that touches no marker: in a slanting view that of the detector does, to half a pixel.
    board = detector.getBoard()
    border = 0.5 * (1.0 - board.getMarkerLength() / board.getSquareLength()) * pdist(corners.reshape(-1, 2)).min()
    half = int(np.clip(0.8 * border, 2, 8))
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    corners = cv2.cornerSubPix(image, corners, (half, half), (-1, -1), until)
    return numbers.ravel(), corners.reshape(-1, 2).astype(float)


def measure(robot: pincal.Robot, board: cv2.aruco.CharucoBoard, *, images: Path, joints: Path, out: Path) -> None:
    """Find the corners in all images; write them as ``measurements.csv``, and the board's as ``points.csv``."""
    kinds = {"revolute": "angle", "prismatic": "length"}
    quantities = {name: kinds[kind] for name, kind in zip(robot.joint_names, robot.joint_types, strict=True)}
    poses, detector = read_columns(joints, {"image": "name"} | quantities), cv2.aruco.CharucoDetector(board)
    found = [find_corners(detector, images / name) for name in poses["image"]]
    view = np.repeat(np.arange(len(found)), [len(numbers) for numbers, _ in found])
    numbers, corners = (np.concatenate(parts) for parts in zip(*found, strict=True))
    table = {name: poses[name][view] for name in robot.joint_names} | {"point": np.char.mod("corner_%d", numbers)}
    write_table(out / "measurements.csv", table | {"u [px]": corners[:, 0], "v [px]": corners[:, 1]})
    x, y, z = board.getChessboardCorners().astype(float).round(9).T
    write_table(out / "points.csv", {"point": np.char.mod("corner_%d", np.arange(len(x))), "x": x, "y": y, "z": z})
    print(f"corners found             {len(view)} in {len(np.unique(view))} of {len(found)} images")


def identify(robot: pincal.Robot, folder: Path, *, truth: dict[str, float]) -> pincal.Calibration:
    """Identify robot, lens and the poses of camera and board jointly from the two tables, and print the result."""
    setup = pincal.Setup(points=read_points(folder / "points.csv"))
    table = pincal.read_measurements(folder / "measurements.csv", robot.joint_names, joint_types=robot.joint_types)
    calibration = pincal.run_calibration(robot, table, pincal.Options(setup=setup))
    result, images = calibration.result, len(np.unique(calibration.train.q, axis=0))
    print(f"noise of a corner         {result.noise['sigma_px']:.4f} px, estimated from {images} images")
    for row in result.parameters:
        if (name := row.name.removeprefix("camera.")) in CAMERA:
            print(f"{row.name:25s} {row.value:.6g} +- {row.sigma:.2g}" + (f", truth {truth[name]:g}" if truth else ""))
    for model, what in (("nominal", "only places and pinhole fitted"), ("calibrated", "robot and distortion, too")):
        error = result.error[model]["test"]
        print(f"held out, {model:15s} mean {error['mean_mm']:.4f} mm, {error['mean_px']:.4f} px ({what})")
    print("".join(f"{warning.severity}: {warning}\n" for warning in result.warnings), end="")
    return calibration


def judge(scene: Scene, board: cv2.aruco.CharucoBoard, calibration: pincal.Calibration, *, rng: np.random.Generator) -> None:
    """Print the errors of the corners, and of the camera at other views of the board."""
    rows, fit = calibration.train, calibration.fit
    q, view = np.unique(rows.q, axis=0, return_inverse=True)
    places = np.array([fit.options.setup.points[name] for name in rows.point])
    missed = [rows.pixel[view == i] - project(T, places[view == i]) for i, T in enumerate(scene.cameras(q))]
    (u, v), rms = np.vstack(missed).mean(axis=0), np.sqrt(np.mean(np.vstack(missed) ** 2))
    print(f"corners off the truth     rms {rms:.4f} px, mean {u:.4f} and {v:.4f} px")
    q = plan_views(scene, board, count=FRESH, rng=rng)
    truth = scene.cameras(q)[:, :3, 3]
    for model, values in (("nominal", fit.fit.nominal.values), ("calibrated", fit.values)):
        found = fit.model.predict(fit.model.own(values), pincal.Conditions.at(q))[:, :, 3]
        error = 1e3 * np.linalg.norm(found - truth, axis=1)
        print(f"camera, {model:17s} off the truth by mean {error.mean():.4f} mm, max {error.max():.4f} mm")


def run(chosen: argparse.Namespace, out: Path) -> None:
    """Take photographs, or use given ones; identify; compare with the truth if it is known."""
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, chosen.dictionary))
    board = cv2.aruco.CharucoBoard(chosen.squares, chosen.square, chosen.marker, markers)
    out.mkdir(parents=True, exist_ok=True)
    rng, images = np.random.default_rng(chosen.seed), chosen.images or out
    scene = None if chosen.images else build_scene(board, rng)
    if scene:
        photograph(scene, board, images, quick=chosen.quick, rng=rng)
    joints = chosen.joints if chosen.joints and chosen.images else images / "joints.csv"
    with joints.open(newline="") as file:
        names = [name for name in next(csv.reader(file)) if name != "image"]
    robot = pincal.Robot.from_urdf(chosen.robot, joints=names)
    (out / "robot.urdf").write_bytes(robot.urdf)
    measure(robot, board, images=images, joints=joints, out=out)
    calibration = identify(robot, out, truth=CAMERA if scene else {})
    if scene:
        judge(scene, board, calibration, rng=rng)
    print("the same in the folder    pincal calibrate robot.urdf measurements.csv --points points.csv --out results")


def main() -> int:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--images", type=Path, help="folder of photographs; they are simulated unless given")
    parser.add_argument("--joints", type=Path, help="the joint positions (default: joints.csv in this folder)")
    parser.add_argument("--robot", default=str(kuka_urdf_path()), help="its URDF (default: the KUKA KR 125/2)")
    parser.add_argument("--squares", type=int, nargs=2, default=(12, 9), help="across and down (default: 12 9)")
    parser.add_argument("--square", type=float, default=0.06, help="size of a square [m] (default: %(default)s)")
    parser.add_argument("--marker", type=float, default=0.045, help="size of a marker [m] (default: %(default)s)")
    dictionaries = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
    parser.add_argument("--dictionary", default="DICT_5X5_100", choices=dictionaries, metavar="DICT_...", help="of markers")
    parser.add_argument("--seed", type=int, default=1, help="of the simulation (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="simulate fewer and coarser photographs")
    parser.add_argument("--out", type=Path, help="folder for what is written; a temporary one unless given")
    chosen = parser.parse_args()
    try:
        with tempfile.TemporaryDirectory() as temporary:
            run(chosen, chosen.out or Path(temporary))
    except pincal.PincalError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
