"""The contents of a page in one frame: upright, with the robot's base at its origin."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.errors import BadInputError
from pincal.measure.measurements import Measurements
from pincal.model.chain import Chain
from pincal.parameters import FRAME_SYMBOLS
from pincal.robot.kinematics import Kinematics
from pincal.robot.se3 import placed, rotation, shortest_turn, translation
from pincal.thresholds import Scale
from pincal.viewer.field import FieldPoses, Fields, Layer, deviation_fields
from pincal.viewer.shapes import DrawnShape, shapes_of

# Largest drawn tilt of an axis [rad], and largest drawn offset as a fraction of the reach.
_DRAWN_TILT: Scale = 0.25
_DRAWN_OFFSET: Scale = 0.06
# Tilts and offsets below which an axis counts as undistorted [rad, m].
_NO_TILT: Scale = 1e-12


@dataclass(frozen=True)
class Axis:
    """One joint axis, nominal and with its distortion exaggerated, in the link frame that it is
    mounted on.

    Attributes:
        joint: name.
        nominal: shape (2, 3), its ends [m].
        actual: shape (2, 3), the same with tilt and offset times the factor.
        tilt: by the calibration [rad].
        offset: sideways, at the joint frame of the URDF [m].
    """

    joint: str
    nominal: np.ndarray
    actual: np.ndarray
    tilt: float
    offset: float


def axes_of(calibrated: FittedRobot, factor: float | None = None) -> tuple[tuple[Axis, ...], float]:
    """Return the joint axes and the factor by which their distortions are exaggerated.

    Args:
        calibrated: the robot.
        factor: of tilts and offsets; default: a round number that makes the largest visible without
            exaggeration.
    """
    chain = calibrated.model.chain
    coordinates = calibrated.model.rigid_coordinates(calibrated.model_values)
    # Position of each joint frame of the URDF along its axis, from the origin of the
    # Denavit-Hartenberg frame [m].
    after = chain.robot.kinematics.after
    heights = [float((B @ T)[2, 3]) for B, T in zip(after, chain.robot.T_link_joint, strict=True)]
    found = [_distortion(chain, coordinates, i, height) for i, height in enumerate(heights)]
    reach = chain.robot.reach
    if factor is None:
        tilt, offset = (max(float(np.linalg.norm(change[k])) for change in found) for k in (1, 2))
        room = [_DRAWN_TILT / tilt] if tilt > _NO_TILT else []
        room += [_DRAWN_OFFSET * reach / offset] if offset > _NO_TILT else []
        factor = round_down(min(room, default=1.0))
    half = 0.11 * reach
    return tuple(
        Axis(
            name,
            _line(frame, np.zeros(2), np.zeros(2), height, half),
            _line(frame, factor * tilt, factor * offset, height, half),
            float(np.linalg.norm(tilt)),
            float(np.linalg.norm(offset)),
        )
        for name, (frame, tilt, offset), height in zip(
            chain.robot.joint_names, found, heights, strict=True
        )
    ), factor


def round_down(value: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not above ``value``.

    Example:
        >>> [round_down(x) for x in (730.0, 200.0, 0.19)]
        [500.0, 200.0, 0.1]
    """
    power = 10.0 ** np.floor(np.log10(value) + 1e-9)
    step = max(digit for digit in (1.0, 2.0, 5.0) if digit * power <= value * (1.0 + 1e-9))
    return float(step * power)


def _distortion(
    chain: Chain, coordinates: np.ndarray, i: int, height: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the frame of the nominal axis in the link before it, and tilt [rad] and offset [m]
    across it, shape (2,).
    """

    def mounted(values: np.ndarray) -> np.ndarray:
        link = np.eye(4)
        if i:
            a, d, alpha = (values[chain.joint(i - 1, symbol)] for symbol in ("a", "d", "alpha"))
            link = translation(a, 0.0, d) @ rotation("x", alpha)
        s_x, s_y = (values[chain.joint(i, symbol)] for symbol in ("s_x", "s_y"))
        return np.asarray(link @ (rotation("x", s_x) @ rotation("y", s_y)))

    nominal = mounted(chain.nominal)
    change = np.linalg.inv(nominal) @ mounted(coordinates)
    # Both include the nominal transform from the frame before the link's to the link's own.
    link = np.eye(4) if i == 0 else chain.robot.kinematics.after[i - 1]
    return np.linalg.inv(link) @ nominal, change[:2, 2], change[:2, 3] + change[:2, 2] * height


def _line(
    frame: np.ndarray, tilt: np.ndarray, offset: np.ndarray, height: float, half: float
) -> np.ndarray:
    """Return the ends of a line about the z axis of a frame, shape (2, 3)."""
    angle = float(np.linalg.norm(tilt))
    across = tilt / angle if angle > 0.0 else np.zeros(2)
    direction = np.array([*(np.sin(angle) * across), np.cos(angle)])
    middle = np.array([*offset, height])
    ends = np.array([middle - half * direction, middle + half * direction])
    return np.asarray(ends @ frame[:3, :3].T + frame[:3, 3])


# Largest length of nearly all arrows, as a fraction of the robot's reach and of the distance
# between arrows.
_DRAWN: Scale = 0.12
_CROWDED: Scale = 0.8


@dataclass(frozen=True)
class DrawnFrame:
    """A coordinate system to draw.

    Attributes:
        name: "base", "instrument", or the name of a target.
        body: the body that it moves with: 0 for stationary frames, n for the last link.
        placement: shape (4, 4), in the scene for body 0, otherwise in the frame S_i.
    """

    name: str
    body: int
    placement: np.ndarray


@dataclass(frozen=True)
class Scene:
    """A robot and its deviations, ready to be drawn.

    Attributes:
        title: the robot's name.
        joints: their names.
        lower: shape (n,), ends of the joints' sliders [rad or m].
        upper: shape (n,), upper ends.
        q: shape (n,), the initial pose.
        T_scene_base: shape (4, 4), pose of the robot's base in the scene, in which gravity points
            down.
        kinematics: of the arm.
        shapes: of its links.
        axes: its joint axes, with distortions times ``axis_scale``.
        axis_scale: that factor.
        frames: base, tools, instrument.
        fields: the deviations, in the scene.
        scale: initial scale factor of the arrows.
        reach: of the arm [m].
        notes: on what is missing, and on assumptions.
    """

    title: str
    joints: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    q: np.ndarray
    T_scene_base: np.ndarray
    kinematics: Kinematics
    shapes: tuple[DrawnShape, ...]
    axes: tuple[Axis, ...]
    axis_scale: float
    frames: tuple[DrawnFrame, ...]
    fields: Fields
    scale: float
    reach: float
    notes: tuple[str, ...]

    def opening(self, q: np.ndarray | None = None, *, notes: Sequence[str] = ()) -> Scene:
        """Return the same scene at another pose, shape (n,) [rad or m], and with further notes.

        Raises:
            BadInputError: if the pose is not one finite number per joint.
        """
        found = self.q if q is None else np.asarray(q, float)
        names = self.joints
        if found.shape != (len(names),) or not np.isfinite(found).all():
            raise BadInputError(
                f"a pose of {found.size} values ({found.tolist()}); expected "
                f"{len(names)}: {', '.join(names)}"
            )
        return replace(self, q=found, notes=(*notes, *self.notes))


def build_scene(
    calibrated: FittedRobot,
    measurements: Measurements | None = None,
    *,
    held_out: np.ndarray | None = None,
    grid: int = 1000,
    scale: float | None = None,
    axis_scale: float | None = None,
    mesh_folders: Sequence[str | os.PathLike[str]] = (),
) -> Scene:
    """Return the scene of a calibrated robot, at the first measured pose.

    Args:
        calibrated: the robot.
        measurements: measured poses, of its targets.
        held_out: shape (N,), which of them were held out of the fit; None if unknown.
        grid: approximate number of workspace points with an arrow; 0 for none.
        scale: scale factor of the arrows; default: a round number that makes them visible.
        axis_scale: scale factor of the distortions of axes, with the same default.
        mesh_folders: further folders with the meshes and packages that the URDF names.

    Returns:
        The scene.

    Raises:
        BadInputError: if a factor is not positive, or there is nothing to show.
    """
    chain = calibrated.model.chain
    for name, factor in (("scale", scale), ("axis_scale", axis_scale)):
        if factor is not None and not 0.0 < factor < np.inf:
            raise BadInputError(f"{name} is {factor}; expected a positive number")
    fields = deviation_fields(calibrated, measurements, held_out=held_out, grid=grid)
    shapes, missing = shapes_of(chain.robot, mesh_folders)
    axes, axis_scale = axes_of(calibrated, axis_scale)
    upright = _upright(chain.gravity)
    coordinates = calibrated.model.rigid_coordinates(calibrated.model_values)
    T_scene_instrument = upright @ np.linalg.inv(base_of(calibrated))
    lower, upper = _slider_ends(calibrated, fields.poses)
    return Scene(
        title=chain.robot.name,
        joints=chain.robot.joint_names,
        lower=lower,
        upper=upper,
        q=np.asarray(fields.poses[0].q[0], float),
        T_scene_base=upright,
        kinematics=chain.robot.kinematics,
        shapes=shapes,
        axes=axes,
        axis_scale=axis_scale,
        frames=_frames(calibrated, upright, T_scene_instrument, coordinates),
        fields=fields.transformed(T_scene_instrument),
        scale=visible_scale(fields.layers[0], chain.robot.reach) if scale is None else scale,
        reach=chain.robot.reach,
        notes=(*_row_notes(fields.poses), *missing, *fields.notes),
    )


def _slider_ends(
    calibrated: FittedRobot, poses: tuple[FieldPoses, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of the joints' sliders, shape (n,) each, which enclose the limits and all
    poses shown.
    """
    robot = calibrated.model.chain.robot
    lower = np.vstack([calibrated.covered.q[:, 0], *(part.q for part in poses)]).min(axis=0)
    upper = np.vstack([calibrated.covered.q[:, 1], *(part.q for part in poses)]).max(axis=0)
    return (
        np.where(np.isfinite(robot.lower), np.minimum(robot.lower, lower), lower),
        np.where(np.isfinite(robot.upper), np.maximum(robot.upper, upper), upper),
    )


def base_of(calibrated: FittedRobot) -> np.ndarray:
    """Return the robot's base in the instrument's frame, shape (4, 4)."""
    chain = calibrated.model.chain
    coordinates = calibrated.model.rigid_coordinates(calibrated.model_values)
    return placed(
        chain.base_rotation, coordinates[[chain.base(symbol) for symbol in FRAME_SYMBOLS]]
    )


def visible_scale(layer: Layer, reach: float) -> float:
    """Return a round factor with which nearly all arrows are visible and do not overlap."""
    size = float(np.percentile(layer.sizes, 95.0))
    apart = float(np.cbrt(np.prod(np.ptp(layer.points, axis=0)) / len(layer.points)))
    drawn = min(_DRAWN * reach, _CROWDED * apart) if apart > 0.0 else _DRAWN * reach
    return round_down(drawn / size) if size > 0.0 else 1.0


def _row_notes(poses: tuple[FieldPoses, ...]) -> tuple[str, ...]:
    measured = next((part for part in poses if part.name == "measured"), None)
    if measured is None:
        return ("no measured poses were given: only the workspace is shown",)
    found = []
    if measured.held_out is not None and not measured.held_out.any():
        found.append("the held-out set is empty")
    if measured.position is None:
        found.append("the instrument measured no positions: no measured points are shown")
    return tuple(found)


def _upright(gravity: np.ndarray) -> np.ndarray:
    """Return the smallest rotation, shape (4, 4), that turns gravity downwards."""
    size = float(np.linalg.norm(gravity))
    if size == 0.0:
        return np.eye(4)
    return shortest_turn(-gravity / size, np.array([0.0, 0.0, 1.0]))


def _frames(
    calibrated: FittedRobot,
    upright: np.ndarray,
    T_scene_instrument: np.ndarray,
    coordinates: np.ndarray,
) -> tuple[DrawnFrame, ...]:
    chain = calibrated.model.chain
    n = calibrated.model.chain.robot.n_joints
    known = {
        p.name: v for p, v in zip(calibrated.model.parameters, calibrated.values, strict=False)
    }
    found = [DrawnFrame("base", 0, upright)]
    # A contact has no instrument: everything is relative to the robot's base.
    if any(p.effect == "base_frame" for p in calibrated.model.parameters):
        found.append(DrawnFrame("instrument", 0, T_scene_instrument))
    for target, reference in zip(chain.targets, chain.tool_rotations, strict=True):
        one = len(chain.targets) == 1
        at = [
            coordinates[chain.tool(s)] if one else known.get(f"{target}.{s}", 0.0)
            for s in FRAME_SYMBOLS
        ]
        placement = chain.robot.frames.T_last_tip @ placed(reference, np.array(at, float))
        found.append(DrawnFrame(target, n, placement))
    return tuple(found)


def _fitted_lines(residuals: Path, station: str, *, is_first: bool) -> np.ndarray | None:
    """Return the lines of a table that were fitted, shape (n,); None for a table other than the
    first that is no station.
    """
    import polars as pl

    table = pl.read_csv(residuals)
    if "station" in table.columns:
        # With several stations, each table is one, named after its file.
        table = table.filter(pl.col("station") == station)
    if not is_first and not ("station" in table.columns and len(table)):
        return None
    return table.filter(pl.col("rows") == "fitted")["line"].cast(pl.Int64).to_numpy()


def held_out_rows(
    provenance: dict[str, Any], residuals: Path, data: Path, measurements: Measurements
) -> tuple[np.ndarray | None, str]:
    """Return which rows of a table were held out of a calibration, and how this is known, in words.

    Args:
        provenance: of the calibrated model; names its input files with their SHA-256, the training
            table first.
        residuals: the calibration's ``residuals.csv``; need not exist.
        data: the table's file.
        measurements: its rows.

    Returns:
        Shape (N,), True for rows that were held out of the fit, or None if unknown; and the reason.
    """
    import polars as pl

    inputs = provenance.get("inputs")
    known = list(inputs.values()) if isinstance(inputs, dict) else []
    name = data.name
    if not known:
        unnamed = "the model names no input files, so it is unknown which rows of"
        return None, f"{unnamed} {name} it was fitted to"
    digest = hashlib.sha256(data.read_bytes()).hexdigest()
    unseen = np.ones(len(measurements), bool)
    if digest not in known:
        return unseen, f"{name} is not one of the model's input files: all rows count as held out"
    try:
        fitted = _fitted_lines(residuals, data.stem, is_first=digest == known[0])
    except (OSError, pl.exceptions.PolarsError):
        absent = "which lists the held-out rows, is not in the model's folder: no row is marked"
        return None, f"{residuals.name}, {absent}"
    if fitted is None:
        return unseen, f"{name} was held out of the fit as a whole"
    held = ~np.isin(measurements.rows, fitted)
    if not held.any():
        return held, "no row was held out of the fit"
    return held, f"{held.sum()} of {len(held)} rows were held out of the fit"
