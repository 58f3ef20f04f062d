"""Plans of probing tests: in which poses the tool point touches a calibrated sphere.

ISO 10360-5 recommends 25 points over half of a sphere: the pole, and four and eight alternately on
circles at 22.5, 45, 67.5 and 90 deg from it. The pole is up, and of the poses that reach a point
the one is taken whose tool points most at the centre of the sphere.
"""

from __future__ import annotations

import numpy as np

from pincal.design.acceptance_plan import poses_at
from pincal.design.reach import Reach
from pincal.errors import BadInputError
from pincal.thresholds import Count, Scale

# Circles of points: degrees from the pole, number of points, and degrees by which they are turned.
_CIRCLES: tuple[tuple[Scale, Count, Scale], ...] = (
    (0.0, 1, 0.0),
    (22.5, 4, 0.0),
    (45.0, 8, 22.5),
    (67.5, 4, 45.0),
    (90.0, 8, 0.0),
)
# Random places that are tried.
_PLACES: Count = 20


def points_on_hemisphere() -> np.ndarray:
    """Return the directions of the 25 points, shape (25, 3).

    Example:
        >>> found = points_on_hemisphere()
        >>> found.shape, bool(np.all(found[:, 2] > -1e-9))
        ((25, 3), True)
    """
    found = []
    for polar, n, turned in _CIRCLES:
        around = np.deg2rad(turned + 360.0 * np.arange(n) / n)
        down = np.deg2rad(polar)
        flat = np.sin(down) * np.column_stack([np.cos(around), np.sin(around)])
        found.append(np.column_stack([flat, np.full(n, np.cos(down))]))
    return np.vstack(found)


def plan_probing(reach: Reach, distance: float, *, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return where to put a sphere, shape (3,) in the base frame [m], and the poses of 25 contacts,
    shape (25, joints).

    Args:
        reach: the arm, its tool point and limits.
        distance: of the tool point from the centre in a contact [m]: half the diameter of the
            sphere, and the radius of the ball that touches it.
        seed: of the random places and poses.

    Raises:
        BadInputError: if the arm reaches all points in none of the places.
    """
    rng = np.random.default_rng(seed)
    directions = points_on_hemisphere()
    for centre in reach.targets(reach.draw(_PLACES, rng).q):
        chosen = []
        for direction in directions:
            held = poses_at(reach, centre + distance * direction, rng)
            if not len(held):
                break
            chosen.append(held[int(np.argmin(_along(reach, held, direction)))])
        else:
            return centre, np.array(chosen)
    raise BadInputError(
        f"a sphere touched at {1e3 * distance:g} mm from its centre: the arm reaches all 25 points "
        f"in none of the {_PLACES} places tried; expected wider limits"
    )


def _along(reach: Reach, q: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the cosine between a direction and the tool, shape (N,)."""
    tool = np.asarray(reach.rig.tool, float)
    size = float(np.linalg.norm(tool))
    axis = tool / size if size else np.array([0.0, 0.0, 1.0])
    turned = reach.robot.forward_kinematics(q)[:, :3, :3]
    return np.asarray(turned @ axis @ direction)
