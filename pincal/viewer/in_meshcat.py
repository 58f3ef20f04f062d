"""Deviation fields in a viewer of the user's own: meshcat, beside what Pinocchio's ``MeshcatVisualizer`` draws there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pincal.calibration.calibrated import Calibrated
from pincal.errors import BadInputError, nearest_first, needed
from pincal.measure.measurements import Measurements
from pincal.robot.robot import Robot
from pincal.viewer.field import Layer, deviation_fields
from pincal.viewer.scene import base_of, visible_scale

if TYPE_CHECKING:
    import meshcat
    from pinocchio.visualize import MeshcatVisualizer

# Length of the strokes of an arrow's head, over its length.
_HEAD = 0.25


def draw_field(
    viz: meshcat.Visualizer | MeshcatVisualizer,
    calibrated: Calibrated,
    measurements: Measurements | None = None,
    *,
    layer: str | None = None,
    scale: float | None = None,
    path: str = "pincal",
    grid: int = 1000,
) -> Layer:
    """Draw a deviation field as arrows into a meshcat viewer that shows the robot.

    The viewer's world is the root of the URDF, as ``MeshcatVisualizer`` has it. A field of the same name is replaced.

    Args:
        viz: a ``meshcat.Visualizer``, or a viewer that has one as ``viewer``, such as Pinocchio's ``MeshcatVisualizer``.
        calibrated: the robot.
        measurements: its measured poses; default: none, arrows stand over the workspace.
        layer: which field, by its name; default: the first one, from nominal to measured or to calibrated.
        scale: factor of the arrows' lengths; default: a round number that makes them visible.
        path: node of meshcat's tree below which the field is drawn, under its own name.
        grid: about how many places of the workspace get an arrow; 0 for none.

    Returns:
        The field, true to scale, in the frame of the viewer.

    Raises:
        BadInputError: if there is no such field, or the factor is not positive.
    """
    with needed("meshcat", "fields in a viewer"):
        import meshcat
        import meshcat.geometry as g

    if scale is not None and not 0.0 < scale < np.inf:
        raise BadInputError(f"scale is {scale}; expected a positive number")
    model = calibrated.to_model()
    robot = model.model.chain.robot
    fields = deviation_fields(model, measurements, grid=grid).seen_from(_root_of(robot) @ np.linalg.inv(base_of(model)))
    names = [field.name for field in fields.layers]
    if layer is not None and layer not in names:
        raise BadInputError(f"no field {layer!r}; expected one of {', '.join(nearest_first([layer], names))}")
    found = fields.layers[0 if layer is None else names.index(layer)]
    factor = visible_scale(found, robot.reach) if scale is None else scale
    ends, colours = _strokes(found, factor)
    lines = g.LineSegments(g.PointsGeometry(ends.T, color=colours.T), g.LineBasicMaterial(vertexColors=True))
    viewer = viz if isinstance(viz, meshcat.Visualizer) else viz.viewer
    viewer[path][found.name].set_object(lines)
    return found


def _strokes(field: Layer, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of an arrow's three strokes, shape (6 N, 3) [m], and their colours by length, shape (6 N, 3)."""
    from matplotlib import colormaps

    tails, along = field.points, factor * field.vectors
    heads, size = tails + along, np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, np.where(np.abs(along[:, 2:]) < 0.9 * size, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
    side *= 0.5 * _HEAD * size / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-300)
    back = heads - _HEAD * along
    ends = np.stack([tails, heads, heads, back + side, heads, back - side], axis=1).reshape(-1, 3)
    largest = max(float(field.sizes.max(initial=0.0)), 1e-300)
    return ends, np.repeat(colormaps["viridis"](field.sizes / largest)[:, :3], 6, axis=0)


def _root_of(robot: Robot) -> np.ndarray:
    """Return the base of the arm in the root of its URDF, shape (4, 4), the joints before it at zero."""
    import pinocchio as pin

    if not robot.urdf:
        return np.eye(4)
    model = robot.pinocchio_model()
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    return np.asarray(data.oMf[model.getFrameId(robot.base, pin.BODY)].homogeneous)
