"""The calibrated robot in three dimensions: its deviations as arrows, in a page that opens offline
or from a local server.

Example:
    >>> import numpy as np
    >>> from pincal.builtin import kuka_urdf_path
    >>> from pincal.model.chain import Chain
    >>> from pincal.model.effects import GEOMETRIC
    >>> from pincal.model.model import Model
    >>> from pincal.calibration.fitted_robot import FittedRobot
    >>> from pincal.parameters import estimate_of
    >>> from pincal.calibration.covered import Covered
    >>> from pincal.robot.robot import Robot
    >>> model = Model(Chain.of(Robot.from_urdf(kuka_urdf_path())), GEOMETRIC)
    >>> values = np.full(model.n_parameters, 1e-4)
    >>> covered = Covered(np.tile([-1.0, 1.0], (6, 1)), np.zeros(2))
    >>> estimate = estimate_of(model.parameters, values, np.zeros((len(values), len(values))))
    >>> kuka = FittedRobot.given(model, estimate, covered)
    >>> [layer.name for layer in deviation_fields(kuka, grid=50).layers]  # doctest: +ELLIPSIS
    ['workspace/nominal to calibrated', 'workspace/explained by joint_offset', ...]
    >>> scene = build_scene(kuka, grid=50)
    >>> scene.title, [frame.name for frame in scene.frames]
    ('kuka_kr125_2', ['base', 'tool'])
"""

from pincal.viewer.field import FieldPoses as FieldPoses
from pincal.viewer.field import Fields as Fields
from pincal.viewer.field import Layer as Layer
from pincal.viewer.field import deviation_fields as deviation_fields
from pincal.viewer.page import LiveView as LiveView
from pincal.viewer.page import draw_field as draw_field
from pincal.viewer.page import page as page
from pincal.viewer.page import show as show
from pincal.viewer.page import write_html as write_html
from pincal.viewer.scene import Scene as Scene
from pincal.viewer.scene import build_scene as build_scene
from pincal.viewer.scene import held_out_rows as held_out_rows
