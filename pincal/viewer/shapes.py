"""The shapes of an arm: the meshes of its URDF, or simple shapes where these are missing."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pincal.errors import BadInputError, RobotFileError, counted, needed
from pincal.robot.packages import Meshes
from pincal.robot.robot import Robot
from pincal.robot.se3 import perpendicular, rotation_of_rpy
from pincal.robot.urdf_file import parse_xml
from pincal.thresholds import Count, Scale
from pincal.units import plain_numbers

# Most faces of all meshes of a robot; finer ones are decimated to keep the page small and fast.
_FACES: Count = 60_000
_SUFFIXES = (".stl", ".dae", ".obj", ".ply", ".glb", ".gltf", ".off")
# Most faces of a file that is shown: as many as the largest file that is read can contain, 50 bytes
# a face in a binary STL; scene files may contain a mesh any number of times.
_MOST_FACES: Count = 800_000
_GREY: tuple[Scale, Scale, Scale] = (0.72, 0.75, 0.79)
# Sides of a drawn cylinder.
_SIDES: Count = 20


@dataclass(frozen=True)
class DrawnShape:
    """One body of one colour.

    Attributes:
        link: name of the link that it belongs to, as the control tree shows it.
        body: 0 for stationary links, i for those that move with joint i; its frame is S_i (the base
            frame for 0).
        vertices: shape (V, 3) [m], in the frame of the body.
        faces: shape (F, 3).
        colour: red, green, blue from 0 to 1.
    """

    link: str
    body: int
    vertices: np.ndarray
    faces: np.ndarray
    colour: tuple[float, float, float]


def shapes_of(
    robot: Robot, folders: Sequence[str | os.PathLike[str]] = ()
) -> tuple[tuple[DrawnShape, ...], tuple[str, ...]]:
    """Return the shapes of an arm, and notes on differences from the URDF.

    Args:
        robot: the arm; the text of its URDF has the visuals of its links, its source the folder of
            their meshes.
        folders: further folders with meshes, or with the packages that the URDF names.

    Returns:
        The shapes, and notes on missing meshes and links without visuals.
    """
    drawn: list[DrawnShape] = []
    notes: list[str] = []
    if robot.urdf:
        try:
            drawn, notes = _visuals(robot, [Path(folder) for folder in folders])
        except (RobotFileError, ValueError, RuntimeError) as error:
            notes = [f"the visuals of the robot can't be read from its URDF ({error})"]
    bare = sorted(set(range(1, robot.n_joints + 1)) - {shape.body for shape in drawn})
    if not drawn:
        # That none can be shown follows, so one stands for all.
        rest = counted(len(notes) - 1, "other visual") if notes[1:] else ""
        notes = [f"{notes[0]}{f', nor {rest}' if rest else ''}"] if notes else []
        why = (
            "the URDF has no visual geometry"
            if not notes
            else "none of the URDF's meshes can be shown"
        )
        notes.append(
            f"{why if robot.urdf else 'the model holds no URDF'}: the arm is drawn in simple shapes"
        )
        bare = list(range(robot.n_joints + 1))
    elif bare:
        notes.append(
            "drawn as simple shapes: links that move with "
            f"{', '.join(robot.joint_names[i - 1] for i in bare)}"
        )
    if (total := sum(len(shape.faces) for shape in drawn)) > _FACES:
        # Meshes are decimated in proportion to their size.
        drawn = [_thin(shape, max(200, int(len(shape.faces) * _FACES / total))) for shape in drawn]
    return (*drawn, *_simple(robot, bare)), tuple(notes)


class _NotShown(Exception):
    """A visual that can't be drawn, with the reason as its message."""


def _visuals(robot: Robot, folders: list[Path]) -> tuple[list[DrawnShape], list[str]]:
    """Return the shapes of the URDF's visuals, and notes on those that can't be shown."""
    root = parse_xml(robot.urdf, robot.source)
    colours = {m.get("name"): _colour(m) for m in root.iterfind("material")}
    places = _link_places(robot)
    drawn: list[DrawnShape] = []
    notes: dict[str, None] = {}
    meshes = Meshes(robot.source, folders)
    for link in root.iterfind("link"):
        if (name := link.get("name")) not in places:
            continue
        body, placement = places[name]
        for visual in link.iterfind("visual"):
            material = visual.find("material")
            colour = (
                None if material is None else _colour(material) or colours.get(material.get("name"))
            )
            at = placement @ _origin(visual)
            try:
                for vertices, faces, own in _geometry(visual, meshes):
                    drawn.append(
                        DrawnShape(name, body, _moved(at, vertices), faces, colour or own or _GREY)
                    )
            except _NotShown as why:
                notes[f"{name}: {why}"] = None
    return drawn, list(notes)


def _link_places(robot: Robot) -> dict[str, tuple[int, np.ndarray]]:
    """Return link -> the body that it moves with, and its pose in the body's frame; other arms are
    left out.
    """
    import pinocchio as pin

    model = robot.pinocchio_model()
    base = model.frames[model.getFrameId(robot.base, pin.BODY)].placement
    bodies = {model.getJointId(name): i + 1 for i, name in enumerate(robot.joint_names)}
    before = {0: (0, base.inverse().homogeneous)} | {
        joint: (i, robot.T_link_joint[i - 1]) for joint, i in bodies.items()
    }
    return {
        frame.name: (
            before[frame.parentJoint][0],
            before[frame.parentJoint][1] @ frame.placement.homogeneous,
        )
        for frame in model.frames
        if frame.type == pin.BODY and frame.parentJoint in before
    }


_Mesh = tuple[np.ndarray, np.ndarray, tuple[float, float, float] | None]


def _solid(shape: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and faces of a box, cylinder or sphere, shape (V, 3) and (F, 3).

    Raises:
        _NotShown: for any other shape.
    """
    if shape.tag == "box":
        corners = np.array(
            [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
        )
        return _hull(corners * _numbers(shape, "size", 3))
    if shape.tag in ("cylinder", "capsule"):
        radius = _numbers(shape, "radius", 1)[0]
        half = np.array([0.0, 0.0, _numbers(shape, "length", 1)[0] / 2])
        return _cylinder(-half, half, radius)
    if shape.tag == "sphere":
        up, around = np.meshgrid(np.linspace(0, np.pi, 13), 2 * np.pi * np.arange(_SIDES) / _SIDES)
        points = np.stack(
            [np.sin(up) * np.cos(around), np.sin(up) * np.sin(around), np.cos(up)], axis=-1
        )
        return _hull(_numbers(shape, "radius", 1)[0] * points.reshape(-1, 3))
    raise _NotShown(f"a visual of kind {shape.tag} is not shown")


def _geometry(visual: Any, files: Meshes) -> list[_Mesh]:
    """Return the meshes of a visual, shape (V, 3) and (F, 3) with a colour of their own.

    Raises:
        _NotShown: if there are none, or they can't be read.
    """
    geometry = visual.find("geometry")
    shape = (
        None if geometry is None else next((e for e in geometry if isinstance(e.tag, str)), None)
    )
    if shape is None:
        raise _NotShown("a visual without geometry is not shown")
    if shape.tag != "mesh":
        return [(*_solid(shape), None)]
    name = shape.get("filename", "")
    known = Path(name).suffix.lower() in _SUFFIXES
    path, why = files.find(name) if known else (None, "was not found")
    if path is None:
        raise _NotShown(f"mesh {name} {why}")
    try:
        return _read_mesh(path, _numbers(shape, "scale", 3) if shape.get("scale") else np.ones(3))
    except BadInputError as error:
        raise _NotShown(f"mesh {name} is not shown: {error}") from None
    except Exception as error:  # Mesh readers fail in many ways, which must not prevent the page.
        raise _NotShown(
            f"mesh {name} can't be read ({type(error).__name__}: {str(error)[:120]})"
        ) from None


def _read_mesh(path: Path, scale: np.ndarray) -> list[_Mesh]:
    with needed("trimesh", "meshes", install="'trimesh[easy]'"):
        import trimesh

    scene = trimesh.load_scene(path)
    shown = (scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry)
    if (count := sum(len(getattr(mesh, "faces", ())) for mesh in shown)) > _MOST_FACES:
        raise ValueError(f"{count} triangles, more than {_MOST_FACES}")
    meshes = [
        mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)
    ]
    if not meshes:
        raise ValueError("no triangles")
    if not all(np.isfinite(mesh.vertices).all() for mesh in meshes):
        raise ValueError("vertices that are not finite")
    return [
        (np.asarray(mesh.vertices) * scale, np.asarray(mesh.faces), _mesh_colour(mesh))
        for mesh in meshes
    ]


def _mesh_colour(mesh: Any) -> tuple[float, float, float] | None:
    look = mesh.visual
    rgba = getattr(getattr(look, "material", look), "main_color", None) if look.defined else None
    return None if rgba is None else (rgba[0] / 255, rgba[1] / 255, rgba[2] / 255)


def _thin(shape: DrawnShape, most: int) -> DrawnShape:
    """Merge vertices in cells that grow until ``most`` faces are left."""
    extent = float(np.ptp(shape.vertices, axis=0).max())
    cell = extent / 400
    faces = shape.faces
    vertices = shape.vertices
    while len(faces) > most and cell < extent:
        # Each round continues with the vertices merged in the round before.
        place = _unique_rows(np.round((vertices - vertices.min(axis=0)) / cell).astype(np.int64))[1]
        count = np.bincount(place)
        vertices = np.column_stack([np.bincount(place, column) / count for column in vertices.T])
        faces = place[faces]
        faces = faces[
            (faces[:, 0] != faces[:, 1])
            & (faces[:, 1] != faces[:, 2])
            & (faces[:, 2] != faces[:, 0])
        ]
        faces = faces[_unique_rows(faces)[0]]
        cell *= 1.3
    return replace(shape, vertices=vertices, faces=faces)


def _unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first of each group of equal rows of three numbers >= 0, and the group of each
    row.
    """
    span = int(rows.max(initial=0)) + 1
    # Three numbers below 2^21 are one below 2^63; others are first replaced by their ranks.
    if span >= 1 << 21:
        rows = np.column_stack([np.unique(column, return_inverse=True)[1] for column in rows.T])
        span = int(rows.max(initial=0)) + 1
    _, first, group = np.unique(
        (rows[:, 0] * span + rows[:, 1]) * span + rows[:, 2], return_index=True, return_inverse=True
    )
    return first, group


def _simple(robot: Robot, bodies: Sequence[int]) -> Iterator[DrawnShape]:
    """Yield a hub on each joint's axis and a bar to the next joint, for some bodies of the arm."""
    frames = robot.frames
    places = robot.frames.T_base_link @ robot.T_link_joint
    points = [np.zeros(3), *places[:, :3, 3], (frames.T_base_link[-1] @ frames.T_last_tip)[:3, 3]]
    inverses = [np.eye(4), *np.linalg.inv(frames.T_base_link)]
    size = robot.reach / 22
    for body in bodies:
        radius = size * (1.0 - 0.6 * body / robot.n_joints)
        name = robot.base if body == 0 else robot.joint_names[body - 1]
        here = points[body]
        there = points[body + 1]
        parts = (
            [_cylinder(here, there, 0.7 * radius)] if np.linalg.norm(there - here) > 1e-6 else []
        )
        if body:
            axis = robot.frames.axis(body - 1, robot.parents[body - 1])
            parts.append(
                _cylinder(here - 1.3 * radius * axis, here + 1.3 * radius * axis, 1.25 * radius)
            )
        else:
            parts.append(_cylinder(np.zeros(3), np.array([0.0, 0.0, 0.4 * radius]), 2.0 * radius))
        for vertices, faces in parts:
            yield DrawnShape(name, body, _moved(inverses[body], vertices), faces, _GREY)


def _cylinder(start: np.ndarray, end: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed cylinder from one point to another."""
    along = (end - start) / np.linalg.norm(end - start)
    side = perpendicular(along)
    side /= np.linalg.norm(side)
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    ring = radius * (np.outer(np.cos(angle), side) + np.outer(np.sin(angle), np.cross(along, side)))
    return _hull(np.vstack([start + ring, end + ring]))


def _hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the convex hull of points as triangles, also of flat ones."""
    from scipy.spatial import ConvexHull

    return points, np.asarray(ConvexHull(points, qhull_options="QJ").simplices)


def _moved(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _numbers(element: Any, key: str, count: int) -> np.ndarray:
    values = np.array(plain_numbers(element.get(key, "").split()))
    if values.shape != (count,) or not np.isfinite(values).all():
        raise RobotFileError(
            f"<{element.tag} {key}={element.get(key)!r}>; expected {count} finite numbers"
        )
    return values


def _origin(visual: Any) -> np.ndarray:
    T = np.eye(4)
    origin = visual.find("origin")
    if origin is not None:
        T[:3, 3] = _numbers(origin, "xyz", 3) if origin.get("xyz") else 0.0
        T[:3, :3] = rotation_of_rpy(_numbers(origin, "rpy", 3)) if origin.get("rpy") else np.eye(3)
    return T


def _colour(material: Any) -> tuple[float, float, float] | None:
    colour = material.find("color")
    if colour is None:
        return None
    red, green, blue, _ = np.clip(_numbers(colour, "rgba", 4), 0.0, 1.0)
    return float(red), float(green), float(blue)
