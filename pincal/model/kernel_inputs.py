"""Inputs of the compiled loops: the constant part of a chain, values of its coordinates, their
derivatives by parameters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pincal.thresholds import Count

# Numbers of coordinates: of a joint, of a frame (base or tool), and of the mount of a branch.
BLOCK: Count = 10
FRAME: Count = 6
MOUNT: Count = 2


class Route(NamedTuple):
    """A walk over coordinates.

    Attributes:
        coordinate: shape (S,), the coordinates in order.
        sign: shape (S,), 1.0 where a coordinate is traversed forwards, -1.0 where backwards.
        fixed_before: shape (S,), index of the fixed transform that precedes a step, -1 for none.
    """

    coordinate: np.ndarray
    sign: np.ndarray
    fixed_before: np.ndarray


class Layout(NamedTuple):
    """The constant part of a chain as arrays.

    Attributes:
        kind: shape (K,), 0, 1, 2 for rotations about x, y, z and 3, 4, 5 for translations along
            them.
        less: shape (K,), another coordinate whose translation coordinate k takes back, -1 for none.
        starts: shape (n + 1,), the first coordinate of each joint, and the first one after the last
            joint.
        parents: shape (n,), the joint that carries each joint, an earlier one, -1 for the base.
        tree: the walk over the joints' coordinates, each joint's after the link that carries it.
        path: the walk from the instrument to the target.
        bears: shape (n,), joints whose moments bend the path.
        acting: shape (A,), joints that move or turn the loads of these: they themselves, and those
            above and below them.
        fixed: shape (F, 3, 4), the fixed transforms.
        tip: index of the fixed transform to the tip, from the link frame of the joint that carries
            it.
        tip_joint: that joint, -1 for the base.
        base_rotation: shape (set-ups, 3, 3), reference orientation of the base in each instrument's
            frame.
        tool_rotation: shape (tools, 3, 3), reference orientation of each tool frame.
        moment_y, moment_z: shape (n,), coordinates whose axes are y and z of the frame that joint
            i's moment is expressed in; it is taken about the origin of the later one.
        moment_cut: shape (n,), the last coordinate that turns or moves this frame.
        masses, centres: shape (n,), (n, 3), the bodies in the link frames.
        gravity: shape (3,), in the robot's base frame.
    """

    kind: np.ndarray
    less: np.ndarray
    starts: np.ndarray
    parents: np.ndarray
    tree: Route
    path: Route
    bears: np.ndarray
    acting: np.ndarray
    fixed: np.ndarray
    tip: int
    tip_joint: int
    base_rotation: np.ndarray
    tool_rotation: np.ndarray
    moment_y: np.ndarray
    moment_z: np.ndarray
    moment_cut: np.ndarray
    masses: np.ndarray
    centres: np.ndarray
    gravity: np.ndarray


class Values(NamedTuple):
    """Values of all coordinates at all poses: constants, and columns that differ from pose to pose.

    Attributes:
        constant: shape (K,), coordinates [rad or m].
        slot: shape (K,), row of ``varying`` with the values of coordinate k, -1 for the constant.
        varying: shape (V, N).
    """

    constant: np.ndarray
    slot: np.ndarray
    varying: np.ndarray


class Terms(NamedTuple):
    """Derivatives of coordinates by parameters, as a list of terms: d x_k / d parameter = basis.

    Attributes:
        coordinate, parameter: shape (E,).
        slot: shape (E,), row of ``basis``, -1 where the derivative is 1.
        elastic: shape (E,), whether the term depends on the static moments.
        basis: shape (S, N).
    """

    coordinate: np.ndarray
    parameter: np.ndarray
    slot: np.ndarray
    elastic: np.ndarray
    basis: np.ndarray


class Compliances(NamedTuple):
    """Derivatives of coordinates by moments: d x_k / d n_l.

    Attributes:
        coordinate, moment: shape (C,), k and l = 3 i + component of joint i.
        rate: shape (C, N), or (C, 1) where it is the same at all poses [rad/(N m) or m/(N m)].
    """

    coordinate: np.ndarray
    moment: np.ndarray
    rate: np.ndarray


class MassTerms(NamedTuple):
    """Contributions of parameters to the masses of links.

    Attributes:
        joint, parameter: shape (E,), the link of each entry, and the parameter's column.
        mass: shape (E,), by one unit of the parameter [kg].
        moment: shape (E, 3), first moment of mass in the link frame by one unit [kg m].
    """

    joint: np.ndarray
    parameter: np.ndarray
    mass: np.ndarray
    moment: np.ndarray


class Places(NamedTuple):
    """Index of the reference orientation of the base, and of the tool, at each pose; both of shape
    (N,).
    """

    base: np.ndarray
    tool: np.ndarray


class Payload(NamedTuple):
    """Mass [kg], shape (N,), and centre of mass in the tip frame [m], shape (3,), beyond the last
    link.
    """

    mass: np.ndarray
    centre: np.ndarray


class Wanted(NamedTuple):
    """The requested columns.

    Attributes:
        terms: derivatives of coordinates by parameters.
        compliances: derivatives of coordinates by moments; may be empty.
        masses: contributions of parameters to masses; may be empty.
        n_columns: number P of columns.
        rows: 3 for the velocity of the target, 6 for velocity and angular velocity, in the
            instrument's axes; 0 for the moments themselves instead of columns.
        sweeps: 0 for moments on the undeformed arm; else the number of iterations for the effect of
            deformation on moments.
    """

    terms: Terms
    compliances: Compliances
    masses: MassTerms
    n_columns: int
    rows: int
    sweeps: int
