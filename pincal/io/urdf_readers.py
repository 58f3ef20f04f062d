"""A written URDF read by Pinocchio and by yourdfpy, which share no code: whether its links are in
the same places.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np

from pincal.errors import RobotFileError
from pincal.io.file_numbers import IN_FILES
from pincal.robot.arm_of_tree import arm_model
from pincal.robot.robot import Robot
from pincal.robot.tree import UrdfTree
from pincal.robot.urdf_file import arm_text, parse_urdf, silent_yourdfpy
from pincal.thresholds import Count

_POSES: Count = 5


@dataclass(frozen=True)
class LinksReadTwice:
    """Where two readers put the links of a URDF.

    Attributes:
        error_m: largest difference of a link's pose in the root's frame [m, 1].
        link: the link of this difference; "" if there is none.
        failure: why yourdfpy can't read the file; "" if it can.
        is_installed: whether there is a yourdfpy.
    """

    error_m: float
    link: str
    failure: str = ""
    is_installed: bool = True

    @property
    def agree(self) -> bool:
        """Whether the file was read by both, and alike."""
        return not self.failure and self.error_m <= IN_FILES.tip_error

    @property
    def note(self) -> str:
        """What is to be told of a URDF that was written nevertheless; "" if they agree."""
        if not self.is_installed:
            return (
                "yourdfpy is not installed (pip install yourdfpy): the calibrated URDF was read "
                "back by Pinocchio alone"
            )
        return "" if self.agree else f"{self}, in the URDF that it was made from, too"

    def __str__(self) -> str:
        """What they differ in."""
        if self.failure:
            return f"yourdfpy can't read it ({self.failure})"
        return f"Pinocchio and yourdfpy put {self.link} up to {self.error_m:.3g} m or rad apart"


def read_back(robot: Robot, text: bytes, original: bytes) -> LinksReadTwice:
    """Read a written URDF by Pinocchio and by yourdfpy and compare the poses of all links at
    joint positions of the robot.

    Args:
        robot: the arm; its other joints stay at zero.
        text: the URDF that was written.
        original: the one that it was made from.

    Returns:
        Where both put the links; if they disagree, they do so about the original as well, as about
        mimic joints of mimic joints. A small installation has no yourdfpy.

    Raises:
        RobotFileError: if they disagree about the written file alone.
    """
    try:
        import yourdfpy  # noqa: F401
    except ImportError as missing:
        return LinksReadTwice(np.inf, "", str(missing), is_installed=False)
    found = _readings(robot, text)
    if not found.agree and _readings(robot, original).agree:
        raise RobotFileError(
            f"{robot.name}: the calibrated URDF would be ambiguous: {found}; report this with "
            "the URDF"
        )
    return found


def _readings(robot: Robot, text: bytes) -> LinksReadTwice:
    """Return where both readers put the links of a URDF."""
    tree = parse_urdf(text, source=robot.source)
    q = robot.random_configurations(_POSES, np.random.default_rng(0))
    links = _comparable(tree, robot)
    try:
        there = _by_yourdfpy(tree, robot, q, links)
    except Exception as error:  # A reader of others may raise anything for a file.
        return LinksReadTwice(np.inf, "", f"{type(error).__name__}: {error}"[:200])
    apart = np.abs(there - _by_pinocchio(tree, robot, q, links)).max(axis=(0, 2, 3))
    worst = int(np.argmax(apart))
    return LinksReadTwice(float(apart[worst]), links[worst])


def _comparable(tree: UrdfTree, robot: Robot) -> list[str]:
    """Return the links that follow from the positions of the robot's joints: not those behind
    other mimic joints, which Pinocchio's model holds at zero.
    """
    return [
        link
        for link in tree.links
        if all(joint.mimic is None or joint.name in robot.joint_names for joint in tree.above(link))
    ]


def _by_yourdfpy(tree: UrdfTree, robot: Robot, q: np.ndarray, links: list[str]) -> np.ndarray:
    """Return the poses of links in the root's frame, shape (N, L, 3, 4)."""
    import yourdfpy

    # It does not close loops; of these files it reads the tree.
    text = arm_text(tree.text, robot.joint_names, tree.source).encode() if tree.closures else None
    with silent_yourdfpy():
        arm = yourdfpy.URDF.load(io.BytesIO(text or tree.text), load_meshes=False)
        found = []
        for row in q:
            arm.update_cfg(dict(zip(robot.joint_names, row.tolist(), strict=True)))
            found.append([arm.get_transform(link, tree.root)[:3] for link in links])
    return np.array(found)


def _by_pinocchio(tree: UrdfTree, robot: Robot, q: np.ndarray, links: list[str]) -> np.ndarray:
    """Return the poses of links in the root's frame, shape (N, L, 3, 4)."""
    import pinocchio as pin

    model = arm_model(tree.text, robot.joint_names, tree.source)
    data = model.createData()
    frames = [model.getFrameId(link, pin.BODY) for link in links]
    found = []
    for row in robot.configurations(model, q):
        pin.framesForwardKinematics(model, data, row)
        found.append([data.oMf[frame].homogeneous[:3] for frame in frames])
    return np.array(found)
