r"""The calibrated geometry as tables of Denavit-Hartenberg parameters, standard and modified.

Between a base frame and a tool frame, with q added to theta, or to d of a prismatic joint,

.. math::

    \text{standard:}\; \prod_i R_z(\theta_i) T_z(d_i) T_x(a_i) R_x(\alpha_i) R_y(\beta_i), \qquad
    \text{modified:}\; \prod_i T_x(a_i) R_x(\alpha_i) R_y(\beta_i) R_z(\theta_i) T_z(d_i).

:math:`\beta` is Hayati's parameter [Hayati1983]_: two axes that are parallel but for a fraction of a milliradian have their
common normal kilometres away, which no controller can calculate with; it is zero for all others.

.. [Hayati1983] S. Hayati, Robot arm geometric link parameter estimation, IEEE CDC 1983.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.errors import BadInputError
from pincal.export.exported import FORMATS, Exported, Format
from pincal.io.urdf_export import rigid_notes, rigid_tips
from pincal.io.urdf_text import rpy_of
from pincal.model.model import Model
from pincal.robot.dh import DhFrames, dh_frames
from pincal.robot.se3 import rotation, translation

_COLUMNS = ("theta", "d", "a", "alpha", "beta")
_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
_HEAD = ["convention", "row", "type", *(f"{c} [{'m' if c in 'da' else 'rad'}]" for c in _COLUMNS)]
_HEAD += [f"{c} [{'m' if c in 'xyz' else 'rad'}]" for c in _POSE]
_TOLERANCE = 1e-9
_CHECKED_POSES = 50


@FORMATS.register
@dataclass(frozen=True)
class DhTable(Format):
    """A CSV with a row a joint between a base frame and a tool frame, in both conventions."""

    name: ClassVar[str] = "dh"
    meaning: ClassVar[str] = "Denavit-Hartenberg parameters, standard and modified"
    of_robot: ClassVar[bool] = True

    def export(self, calibrated: CalibratedModel) -> Exported:
        """Return the table."""
        model, values = calibrated.model, calibrated.model_values
        robot = model.chain.robot
        frames = _calibrated_frames(model, values)
        rows = _rows(frames)
        q = robot.random_configurations(_CHECKED_POSES, np.random.default_rng(0))
        true = rigid_tips(model, values, q)[:, :, 3]
        slides = np.array([kind == "prismatic" for kind in robot.joint_types])
        tables = {"standard": rows, "modified": _modified(rows)}
        tips = {name: _tips(name, table, frames, q=q, slides=slides) for name, table in tables.items()}
        worst = max(float(np.linalg.norm(found - true, axis=1).max()) for found in tips.values())
        if not worst <= _TOLERANCE:
            raise BadInputError(f"{robot.name}: its parameters would be off by up to {worst:.2g} m; use another format")
        notes = rigid_notes(model, what="table of DH parameters")
        notes += tuple(
            f"{mimic.joint} follows {mimic.source}: {mimic.multiplier!r} times its position plus {mimic.offset!r}"
            for mimic in robot.mimics
        )
        if np.any(rows[:, 4]):
            flat = _tips("standard", rows * [1.0, 1.0, 1.0, 1.0, 0.0], frames, q=q, slides=slides)
            off = 1e3 * float(np.linalg.norm(flat - true, axis=1).max())
            pairs = ", ".join(f"{robot.joint_names[i]} and the next" for i in np.flatnonzero(rows[:, 4]))
            cost = f"without beta the tip is off by up to {off:.3f} mm"
            notes += (f"beta (Hayati): the axes of {pairs} are nearly parallel; {cost}",)
        text = [f"# {note}" for note in notes] + [",".join(_HEAD)]
        for name, table in tables.items():
            text += _lines(name, table, frames, names=robot.joint_names, types=robot.joint_types)
        return Exported({"": ("\n".join(text) + "\n").encode()}, notes, worst)


def _calibrated_frames(model: Model, values: np.ndarray) -> DhFrames:
    """Return DH frames along the calibrated axes."""
    chain, x = model.chain, model.rigid_coordinates(values)
    frame, origins, axes = chain.robot.frames.T_base_first, [], []
    for i in range(chain.robot.n_joints):
        at = {s: x[chain.joint(i, s)] for s in ("s_x", "s_y", "theta", "d", "a", "alpha")}
        frame = frame @ rotation("x", at["s_x"]) @ rotation("y", at["s_y"])
        origins.append(frame[:3, 3])
        axes.append(frame[:3, 2])
        frame = frame @ rotation("z", at["theta"]) @ translation(at["a"], 0.0, at["d"]) @ rotation("x", at["alpha"])
    return dh_frames(np.array(origins), np.array(axes), frame @ chain.robot.frames.T_last_tip)


def _rows(frames: DhFrames) -> np.ndarray:
    """Return theta, d, a, alpha, beta of each joint, shape (n, 5): the tilt before an axis belongs to the row before it."""
    tilt = np.vstack([frames.parameters[1:, :2], np.zeros((1, 2))])
    theta, d, a, alpha = frames.parameters[:, 2:].T
    return np.column_stack([theta, d, a, alpha + tilt[:, 0], tilt[:, 1]])


def _modified(rows: np.ndarray) -> np.ndarray:
    """Return the rows in which a, alpha and beta stand before their joint; those behind the last are zero."""
    assert not rows[-1, 2:].any()
    return np.column_stack([rows[:, :2], np.vstack([np.zeros((1, 3)), rows[:-1, 2:]])])


def _tips(name: str, rows: np.ndarray, frames: DhFrames, *, q: np.ndarray, slides: np.ndarray) -> np.ndarray:
    """Return the tip's positions by a table, shape (N, 3) [m]."""
    out = []
    for at in q:
        T = frames.T_base_first
        for (theta, d, a, alpha, beta), position, is_sliding in zip(rows, at, slides, strict=True):
            turned, moved = (theta, d + position) if is_sliding else (theta + position, d)
            joint = rotation("z", turned) @ translation(0.0, 0.0, moved)
            link = translation(a, 0.0, 0.0) @ rotation("x", alpha) @ rotation("y", beta)
            T = T @ (joint @ link if name == "standard" else link @ joint)
        out.append((T @ frames.T_last_tip)[:3, 3])
    return np.array(out)


def _lines(name: str, rows: np.ndarray, frames: DhFrames, *, names: tuple[str, ...], types: tuple[str, ...]) -> list[str]:
    """Return the lines of one convention; numbers in full precision."""

    def frame(what: str, T: np.ndarray) -> str:
        pose = [*T[:3, 3], *rpy_of(T[:3, :3], np.zeros(3))]
        return ",".join([name, what, "frame", *[""] * len(_COLUMNS), *(repr(float(v)) for v in pose)])

    joints = [
        ",".join([name, joint, kind, *(repr(float(v)) for v in row), *[""] * len(_POSE)])
        for joint, kind, row in zip(names, types, rows, strict=True)
    ]
    return [frame("base", frames.T_base_first), *joints, frame("tool", frames.T_last_tip)]
