"""URDFs of robots with closed loops, each written in every way that a URDF has for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

# How a loop is written: as the constraint that is proposed for URDF, as a joint of Gazebo, or as a second joint of one link.
WAYS = ("constraint", "gazebo", "second joint")


def words(values: Sequence[float]) -> str:
    """Return numbers as an attribute."""
    return " ".join(f"{value:.12g}" for value in values)


@dataclass
class Builder:
    """A URDF that grows link by link."""

    name: str
    parts: list[str] = field(default_factory=list)

    def link(self, name: str, mass: float = 0.0, centre: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Add a link."""
        inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
        inertial = f'<inertial><origin xyz="{words(centre)}"/><mass value="{mass:g}"/>{inertia}</inertial>' if mass else ""
        self.parts.append(f'<link name="{name}">{inertial}</link>')

    def joint(
        self,
        name: str,
        parent: str,
        child: str,
        *,
        xyz: Sequence[float] = (0.0, 0.0, 0.0),
        axis: Sequence[float] = (0.0, 1.0, 0.0),
        ends: tuple[float, float] = (-3.0, 3.0),
        kind: str = "revolute",
        mimic: tuple[str, float] | None = None,
    ) -> None:
        """Add a joint."""
        limit = f'<limit lower="{ends[0]}" upper="{ends[1]}" effort="1" velocity="1"/>' if kind != "fixed" else ""
        follows = f'<mimic joint="{mimic[0]}" multiplier="{mimic[1]:g}"/>' if mimic else ""
        self.parts.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{words(xyz)}"/><axis xyz="{words(axis)}"/>{limit}{follows}</joint>'
        )

    def close(
        self,
        name: str,
        rod: str,
        link: str,
        way: str,
        *,
        on_rod: Sequence[float],
        on_link: Sequence[float],
        axis: Sequence[float] = (0.0, 1.0, 0.0),
        kind: str = "revolute",
    ) -> None:
        """Close a loop between the end of a rod and a link."""
        if way == "constraint":
            self.parts.append(
                f'<constraint name="{name}" type="{kind}">'
                f'<parent link="{rod}"/><parent_origin xyz="{words(on_rod)}" rpy="0 0 0"/><parent_axis xyz="{words(axis)}"/>'
                f'<child link="{link}"/><child_origin xyz="{words(on_link)}" rpy="0 0 0"/><child_axis xyz="{words(axis)}"/>'
                "</constraint>"
            )
            return
        self.link(f"{name}_seat")
        self.joint(f"{name}_seat", link, f"{name}_seat", xyz=on_link, kind="fixed")
        if way == "second joint":
            self.joint(name, rod, f"{name}_seat", xyz=on_rod, axis=axis, kind=kind)
        else:
            kind = "ball" if kind == "spherical" else kind
            self.parts.append(
                f'<gazebo><joint name="{name}" type="{kind}"><parent>{rod}</parent><child>{name}_seat</child>'
                f"<axis><xyz>{words(axis)}</xyz></axis></joint></gazebo>"
            )

    def text(self) -> bytes:
        """Return the URDF."""
        return f'<?xml version="1.0"?><robot name="{self.name}">{"".join(self.parts)}</robot>'.encode()


def palletizer(way: str = "constraint", *, kind: str = "revolute") -> bytes:
    """Return a palletizer of four drives: a rod from a crank moves the upper arm, two more keep the hand level.

    With ``way`` "mimic" it has no rods: a link that stays level carries the upper arm.
    """
    b = Builder("palletizer")
    b.link("base")
    b.link("turntable", 400.0, (0.1, 0.0, 0.3))
    b.joint("joint_1", "base", "turntable", xyz=(0, 0, 0.4), axis=(0, 0, 1))
    shoulder, elbow, wrist = (0.3, 0.0, 0.5), (0.0, 0.05, 0.9), (1.1, -0.02, 0.0)
    b.link("lower_arm", 120.0, (0.02, 0.0, 0.45))
    b.joint("joint_2", "turntable", "lower_arm", xyz=shoulder, ends=(-0.6, 0.9))
    b.link("upper_arm", 80.0, (0.4, 0.0, 0.05))
    b.link("hand", 20.0, (0.05, 0.0, -0.1))
    b.link("flange", 8.0, (0.0, 0.0, 0.05))
    b.link("tool0")
    if way == "mimic":
        b.link("level")
        b.joint("level_1", "lower_arm", "level", xyz=elbow, mimic=("joint_2", -1.0))
        b.joint("joint_3", "level", "upper_arm", ends=(-0.5, 0.6))
        b.joint("level_2", "upper_arm", "hand", xyz=wrist, mimic=("joint_3", -1.0))
    else:
        b.joint("elbow", "lower_arm", "upper_arm", xyz=elbow)
        b.joint("wrist", "upper_arm", "hand", xyz=wrist)
        b.link("crank", 30.0, (-0.15, 0.0, 0.0))
        b.joint("joint_3", "turntable", "crank", xyz=(0.3, 0.2, 0.5), ends=(-0.5, 0.6))
        b.link("rod", 15.0, (0.0, 0.0, 0.45))
        b.joint("rod_foot", "crank", "rod", xyz=(-0.4, 0.03, 0.0))
        b.close("rod_head", "rod", "upper_arm", way, on_rod=(0, 0.01, 0.9), on_link=(-0.4, 0.19, 0.0), kind=kind)
        b.link("strut_1", 6.0, (0.0, 0.0, 0.45))
        b.joint("strut_1_foot", "turntable", "strut_1", xyz=(0.05, -0.1, 0.55))
        b.link("triangle", 10.0, (0.05, 0.0, 0.1))
        b.joint("triangle", "lower_arm", "triangle", xyz=(0.0, -0.1, 0.9))
        b.close("strut_1_head", "strut_1", "triangle", way, on_rod=(0, 0, 0.9), on_link=(-0.25, 0.0, 0.05), kind=kind)
        b.link("strut_2", 6.0, (0.55, 0.0, 0.0))
        b.joint("strut_2_foot", "triangle", "strut_2", xyz=(0.1, -0.02, 0.22))
        b.close("strut_2_head", "strut_2", "hand", way, on_rod=(1.1, 0, 0), on_link=(0.1, -0.15, 0.22), kind=kind)
    b.joint("joint_4", "hand", "flange", xyz=(0.15, 0, -0.1), axis=(0, 0, -1))
    b.joint("tool", "flange", "tool0", xyz=(0, 0, -0.05), kind="fixed")
    return b.text()


def rod_arm(way: str = "constraint", *, skew: float = 0.0, kind: str = "revolute") -> bytes:
    """Return an arm of six drives whose third stands beside the second and moves the elbow by a rod.

    ``skew`` is how much longer than the lower arm the rod is [m]: it is no parallelogram then.
    """
    b = Builder("rod_arm")
    b.link("base_link")
    b.link("link_1", 300.0, (0.1, 0.0, -0.1))
    b.joint("joint_1", "base_link", "link_1", xyz=(0, 0, 0.78), axis=(0, 0, 1))
    b.link("link_2", 150.0, (0.0, 0.0, 0.5))
    b.joint("joint_2", "link_1", "link_2", xyz=(0.32, 0, 0), ends=(-0.9, 0.9))
    b.link("link_3", 200.0, (0.2, 0.0, 0.15))
    b.joint("elbow", "link_2", "link_3", xyz=(0, 0, 1.075))
    if way == "mimic":
        raise ValueError("a rod can't be mimicked: the elbow follows two joints")
    b.link("lever", 60.0, (-0.2, 0.0, 0.0))
    b.joint("joint_3", "link_1", "lever", xyz=(0.32, 0.25, 0.02 * (skew != 0.0)), ends=(-0.55, 0.6))
    b.link("rod", 30.0, (0.0, 0.0, 0.5))
    b.joint("rod_foot", "lever", "rod", xyz=(-0.35, 0.0, 0.0))
    b.close(
        "rod_head", "rod", "link_3", way, on_rod=(0, 0, 1.075 + skew), on_link=(-0.35 - 0.5 * skew, 0.25, 0.0), kind=kind
    )
    b.link("link_4", 50.0, (0.3, 0.0, 0.0))
    b.joint("joint_4", "link_3", "link_4", xyz=(0.5, 0, 0.2), axis=(1, 0, 0))
    b.link("link_5", 30.0, (0.05, 0.0, 0.0))
    b.joint("joint_5", "link_4", "link_5", xyz=(0.6425, 0, 0), ends=(-2.0, 2.0))
    b.link("link_6", 10.0, (0.05, 0.0, 0.0))
    b.joint("joint_6", "link_5", "link_6", xyz=(0.2, 0, 0), axis=(1, 0, 0))
    b.link("tool0")
    b.joint("tool", "link_6", "tool0", xyz=(0.05, 0, 0), kind="fixed")
    return b.text()


def four_bar(way: str = "constraint") -> bytes:
    """Return a plain four-bar of unequal bars, of which the coupler carries the tip."""
    b = Builder("four_bar")
    b.link("ground")
    b.link("crank", 3.0, (0.1, 0.0, 0.0))
    b.joint("drive", "ground", "crank", axis=(0, 0, 1), kind="continuous")
    b.link("coupler", 5.0, (0.3, 0.1, 0.0))
    b.joint("knee", "crank", "coupler", xyz=(0.2, 0, 0.05), axis=(0, 0, 1))
    b.link("rocker", 4.0, (0.2, 0.0, 0.0))
    b.joint("seat", "ground", "rocker", xyz=(0.65, -0.5, 0.05), axis=(0, 0, 1))
    b.close("pin", "coupler", "rocker", way, on_rod=(0.6, 0, 0.02), on_link=(0.15, 0.5, 0.02), axis=(0, 0, 1))
    b.link("tip")
    b.joint("tip", "coupler", "tip", xyz=(0.3, 0.4, 0), kind="fixed")
    return b.text()
