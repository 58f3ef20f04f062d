"""Plans of acceptance tests: where to put calibrated lengths, and in which poses to contact their
ends.

The lengths are tested in seven places, as ISO 10360 asks for: along the axes of the base frame and
along the four diagonals of space, each as far from the others as reach allows. Either end is
contacted several times, with the arm in another articulation each time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pincal.design.reach import Reach
from pincal.errors import BadInputError
from pincal.thresholds import Count

# Directions in which lengths are put: the axes, then the diagonals.
_DIRECTIONS = np.array(
    [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1]], float
)
# Random places that are tried for each.
_CANDIDATES: Count = 60
# Random poses that are brought to each end.
_POSES: Count = 64


@dataclass(frozen=True, eq=False)
class Contact:
    """A contact of the tool point with one end of a length.

    Attributes:
        socket: name of the end: place, length, and a or b.
        q: shape (n,), joint positions [rad or m].
    """

    socket: str
    q: np.ndarray


@dataclass(frozen=True, eq=False)
class PlacedLength:
    """A calibrated length in one place.

    Attributes:
        first, second: names of its ends.
        length: [m].
        ends: shape (2, 3), in the base frame [m].
    """

    first: str
    second: str
    length: float
    ends: np.ndarray


@dataclass(frozen=True, eq=False)
class AcceptancePlan:
    """A plan.

    Attributes:
        lengths: in their places.
        contacts: in order.
    """

    lengths: tuple[PlacedLength, ...]
    contacts: tuple[Contact, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the result for ``--json``."""
        return {
            "lengths": [
                {
                    "first": of.first,
                    "second": of.second,
                    "length_mm": 1e3 * of.length,
                    "ends_mm": (1e3 * of.ends).tolist(),
                }
                for of in self.lengths
            ],
            "contacts": len(self.contacts),
        }


def plan_acceptance(
    reach: Reach, lengths: Sequence[float], *, times: int = 3, seed: int = 0
) -> AcceptancePlan:
    """Return where lengths are to be tested.

    Args:
        reach: the arm, its tool point and limits.
        lengths: nominal [m].
        times: contacts with each end in each place.
        seed: of the random places and poses.

    Raises:
        BadInputError: if the arm does not reach both ends of a length in some direction.
    """
    rng = np.random.default_rng(seed)
    # The longest is the least likely to be in reach.
    in_order = sorted(lengths, reverse=True)
    centres: list[np.ndarray] = []
    placed: list[PlacedLength] = []
    contacts: list[Contact] = []
    for place, direction in enumerate(_DIRECTIONS / np.linalg.norm(_DIRECTIONS, axis=1)[:, None]):
        for number, bar in enumerate(_placed(reach, in_order, direction, centres, times, rng)):
            name = f"{place + 1}" if len(lengths) == 1 else f"{place + 1}.{number + 1}"
            of = PlacedLength(f"{name}a", f"{name}b", in_order[number], bar.ends)
            placed.append(of)
            contacts += bar.contacts(of, times)
        centres.append(placed[-1].ends.mean(axis=0))
    return AcceptancePlan(tuple(placed), tuple(contacts))


@dataclass(frozen=True, eq=False)
class _Bar:
    """A length in a place where the arm reaches both ends.

    Attributes:
        ends: shape (2, 3), in the base frame [m].
        poses: poses that hold the tool point at either end, shape (n, joints) each.
    """

    ends: np.ndarray
    poses: tuple[np.ndarray, ...]

    def contacts(self, of: PlacedLength, times: int) -> list[Contact]:
        """Return the contacts with both ends in turn, each end's far apart in the joints."""
        chosen = [_spread(poses, times) for poses in self.poses]
        return [
            Contact(socket, poses[k])
            for k in range(times)
            for socket, poses in zip((of.first, of.second), chosen, strict=True)
        ]


def _placed(
    reach: Reach,
    lengths: Sequence[float],
    direction: np.ndarray,
    others: Sequence[np.ndarray],
    times: int,
    rng: np.random.Generator,
) -> list[_Bar]:
    """Return the lengths about a common centre, along a direction: of random places in reach of the
    arm the one farthest from the others.
    """
    centres = reach.targets(reach.draw(_CANDIDATES, rng).q)
    apart = [
        min((float(np.linalg.norm(centre - other)) for other in others), default=0.0)
        for centre in centres
    ]
    for centre in centres[np.argsort(apart, kind="stable")[::-1]]:
        bars = []
        for length in lengths:
            ends = centre + np.array([[-0.5], [0.5]]) * length * direction
            bars.append(_Bar(ends, tuple(poses_at(reach, end, rng) for end in ends)))
            if min(map(len, bars[-1].poses)) < times:
                break
        else:
            return bars
    towards = " ".join(f"{v:.2g}" for v in direction)
    raise BadInputError(
        f"a length of {max(lengths):g} m along {towards} of the base frame: the arm reaches both "
        f"ends in {times} poses in none of the {len(centres)} places tried; expected a shorter "
        "one, fewer --times, or wider limits"
    )


def poses_at(reach: Reach, place: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return poses that hold the tool point at a place, shape (n, joints); maybe none."""
    rig = replace(reach.rig, sensor="socket", held_at=(tuple(place.tolist()),))
    return replace(reach, rig=rig).tried(_POSES, rng)


def _spread(q: np.ndarray, n: int) -> np.ndarray:
    """Return n of the poses that are far from each other in the joints."""
    chosen = [0]
    while len(chosen) < n:
        near = np.min(np.linalg.norm(q[:, None] - q[chosen], axis=2), axis=1)
        chosen.append(int(np.argmax(near)))
    return q[chosen]
