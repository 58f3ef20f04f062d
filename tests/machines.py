"""Robots for the tests of the true machine."""

import numpy as np

from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path

G = 9.81
READY = np.array([[0.3, 1.2, -1.1, 0.4, 0.7, -0.5]])


def planar_arm(axis: str = "0 -1 0") -> str:
    """Return a URDF of links 1 m and 0.5 m long with 10 and 5 kg at their middles; positive angles lift."""
    link = '<link name="{}"><inertial><origin xyz="{} 0 0"/><mass value="{}"/>'
    link += '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
    joint = '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/><origin xyz="{}"/><axis xyz="{}"/>'
    joint += '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
    return (
        '<robot name="planar"><link name="base"/>'
        + link.format("upper", 0.5, 10)
        + link.format("fore", 0.25, 5)
        + '<link name="tip"/>'
        + joint.format("lift", "revolute", "base", "upper", "0 0 0.4", axis)
        + joint.format("bend", "revolute", "upper", "fore", "1 0 0", axis)
        + joint.format("end", "fixed", "fore", "tip", "0.5 0 0", axis)
        + "</robot>"
    )


def planar(**errors: object) -> sim.TrueMachine:
    """Return the planar arm as a true machine."""
    return sim.TrueMachine.from_urdf(planar_arm(), tip="tip", **errors)


def kuka(**errors: object) -> sim.TrueMachine:
    """Return the KUKA as a true machine."""
    return sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0", **errors)


def angles(machine: sim.TrueMachine, q: np.ndarray, **conditions: object) -> np.ndarray:
    """Return what a joint of the planar arm really turned from its recorded angle, both joints summed."""
    tip = machine.tip(q, **conditions)
    return np.arctan2(tip[:, 2, 0], tip[:, 0, 0]) - q.sum(axis=1)


def sweep(joint: int = 0, count: int = 41) -> np.ndarray:
    """Return poses of the planar arm in which one joint sweeps, the other stays at 0."""
    q = np.zeros((count, 2))
    q[:, joint] = np.linspace(-1.4, 1.4, count)
    return q


def random_poses(machine: sim.TrueMachine, count: int, seed: int = 0) -> np.ndarray:
    """Return poses of a machine within its limits."""
    return sim.plan_poses(machine.nominal, count, np.random.default_rng(seed), min_height=None)
