"""How far instrument and targets moved between two stations, and how well that is known."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import compress

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.model.chain import Chain
from pincal.parameters import FRAME_SYMBOLS, Estimate
from pincal.robot.se3 import placed as frame_at
from pincal.robot.se3 import rotation_vectors
from pincal.thresholds import Scale
from pincal.units import format_readable

# Step of the derivatives of a displacement [m, rad].
_DIFFERENCE: Scale = 1e-7


@dataclass(frozen=True)
class FrameShift:
    """How far instrument and targets moved from one station to another.

    Attributes:
        instrument: displacement of its origin in the robot's base frame [m]; None where readings
            don't determine it.
        turned: angle by which it turned [rad]; likewise.
        target: largest displacement of a common target on the tool [m]; None if there is none.
        instrument_U, turned_U, target_U: expanded uncertainties (k = 2) of these, with what both
            stations leave open of the robot.
    """

    instrument: float | None
    turned: float | None
    target: float | None
    instrument_U: float = 0.0
    turned_U: float = 0.0
    target_U: float = 0.0

    def to_dict(self) -> dict[str, float | None]:
        """Return the entries of files: ``moved_mm``, ``turned_mrad``, ``target_moved_mm``."""
        shifts = {
            "moved_mm": self.instrument,
            "turned_mrad": self.turned,
            "target_moved_mm": self.target,
        }
        return {name: None if shift is None else 1e3 * shift for name, shift in shifts.items()}

    def uncertainties(self) -> dict[str, float]:
        """Return the entries ``moved_U_mm``, ``turned_U_mrad`` and ``target_moved_U_mm``."""
        return {
            "moved_U_mm": 1e3 * self.instrument_U,
            "turned_U_mrad": 1e3 * self.turned_U,
            "target_moved_U_mm": 1e3 * self.target_U,
        }

    def __str__(self) -> str:
        shifts = (
            ("the instrument moved", self.instrument, self.instrument_U, "m"),
            ("it turned", self.turned, self.turned_U, "rad"),
            ("the target moved", self.target, self.target_U, "m"),
        )
        known = [
            f"{words} {by_how_much(shift, U, partial(_shown, unit=unit))}"
            for words, shift, U, unit in shifts
            if shift is not None
        ]
        return ", ".join(known) or "how far they moved is unknown"


def by_how_much(shift: float, U: float, show: Callable[[float], str]) -> str:
    """Return by how much something moved, in words; where this may be nothing, only to how much it
    is known.

    Args:
        shift: its displacement.
        U: the expanded uncertainty of this.
        show: returns one of them with its unit.

    Example:
        >>> by_how_much(7.5, 0.2, "{:.2f} mm".format), by_how_much(7.5, 30.0, "{:.0f} mm".format)
        ('by 7.50 mm', 'by less than can be told (30 mm)')
    """
    return f"by {show(shift)}" if shift >= U else f"by less than can be told ({show(U)})"


def _shown(size: float, unit: str) -> str:
    """Return a displacement with its unit."""
    return format_readable(size, unit, ".4g")


def moved(before: FittedRobot, after: FittedRobot, changed: Collection[str] = ()) -> FrameShift:
    """Return the displacement of instrument and targets between two stations of the same robot.

    Both stations are taken with the robot as the second one knows it: where readings determine a
    frame only together with the robot, what is learned of the robot moves no instrument.

    Args:
        before: the robot at the first station.
        after: the same at the second one.
        changed: names of parameters of the robot that differ between the stations.
    """
    chains = [model.model.chain for model in (before, after)]
    if len({(chain.path.start, chain.path.tip) for chain in chains}) > 1:
        # An instrument on another link has not moved, and another hand has other targets.
        return FrameShift(None, None, None)
    names = _coordinates(chains)
    frames, covariance = _two_set_ups((before.estimate, after.estimate), names, changed)
    rotations = [chain.base_rotation for chain in chains]
    ways = _displacements(rotations, frames)
    slopes = _slopes(rotations, frames)
    covariances = slopes @ covariance @ slopes.transpose(0, 2, 1)
    both = set(before.estimate.names) & set(after.estimate.names)
    targets = np.linalg.norm(ways[2:], axis=1)
    farthest = 2 + int(np.argmax(targets)) if len(targets) else None
    (instrument, instrument_U), (turned, turned_U), (target, target_U) = (
        (None, 0.0)
        if k is None
        else (float(np.linalg.norm(ways[k])), _expanded(ways[k], covariances[k]))
        for k in (
            0 if both >= set(names[0][:3]) else None,
            1 if both >= set(names[0][3:6]) else None,
            farthest,
        )
    )
    return FrameShift(instrument, turned, target, instrument_U, turned_U, target_U)


def _coordinates(chains: Sequence[Chain]) -> list[list[str]]:
    """Return the names of the coordinates of the base and of each common target at two stations:
    one alone is the same by any name.
    """
    pairs = (
        list(zip(*(chain.targets for chain in chains), strict=True))
        if {len(chain.targets) for chain in chains} == {1}
        else [(name, name) for name in chains[0].targets if name in chains[1].targets]
    )
    elements = [("base", *of_one) for of_one in zip(*pairs, strict=True)] or [("base",)] * 2
    return [
        [f"{element}.{symbol}" for element in of_one for symbol in FRAME_SYMBOLS]
        for of_one in elements
    ]


def _slopes(rotations: Sequence[np.ndarray], frames: np.ndarray) -> np.ndarray:
    """Return the derivatives of :func:`_displacements` by all coordinates, shape (2 + targets, 3,
    coordinates).
    """
    slopes = []
    for way in _DIFFERENCE * np.eye(frames.size):
        step = way.reshape(frames.shape)
        further, back = (_displacements(rotations, frames + by) for by in (step, -step))
        slopes.append((further - back) / (2.0 * _DIFFERENCE))
    return np.stack(slopes, axis=-1)


def _expanded(way: np.ndarray, covariance: np.ndarray) -> float:
    """Return the expanded uncertainty (k = 2) of the length of a displacement, shape (3,), along
    it; of one of 0 in any direction.
    """
    length = float(np.linalg.norm(way))
    if not length:
        return 2.0 * float(np.sqrt(np.linalg.eigvalsh(covariance)[-1].clip(0.0)))
    along = way / length
    return 2.0 * float(np.sqrt(max(along @ covariance @ along, 0.0)))


def _displacements(rotations: Sequence[np.ndarray], frames: np.ndarray) -> np.ndarray:
    """Return by how much the instrument moved and turned, and each target moved, between two
    stations, shape (2 + targets, 3) [m, rad, m].

    Args:
        rotations: of the nominal base at each station.
        frames: coordinates of base and targets at each station, shape (2, 1 + targets, 6).
    """
    T_instrument_base = [
        frame_at(rotation, frame) for rotation, frame in zip(rotations, frames[:, 0], strict=True)
    ]
    origins = [np.linalg.inv(T)[:3, 3] for T in T_instrument_base]
    turn = T_instrument_base[1][:3, :3] @ T_instrument_base[0][:3, :3].T
    targets = frames[0, 1:, :3] - frames[1, 1:, :3]
    return np.vstack([origins[1] - origins[0], rotation_vectors(turn[None])[0], targets])


def _two_set_ups(
    estimates: tuple[Estimate, Estimate], names: Sequence[Sequence[str]], changed: Collection[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates of frames at two stations with the robot of the second one, shape (2,
    frames, 6), and their covariance, all of the first one and then all of the second.

    The uncertainty of the robot counts only where it displaces both differently.
    """
    before, after = estimates
    own = {name for of_one in names for name in of_one}.union(changed)
    common = [name for name in before.names if name not in own and name in after.names]
    size = len(names[0])
    frames = np.zeros((2, size))
    covariance = np.zeros((2 * size, 2 * size))
    by_robot = np.zeros((2 * size, len(common)))
    for k, estimate in enumerate(estimates):
        here = slice(k * size, (k + 1) * size)
        covariance[here, here], by_robot[here] = _given(estimate, names[k], common)
        learned = [after[name] - estimate[name] for name in common]
        values = [estimate[name] if name in estimate.names else 0.0 for name in names[k]]
        frames[k] = values + by_robot[here] @ learned
    of_robot = before.take(common).dense_covariance()
    covariance += by_robot @ of_robot @ by_robot.T
    return frames.reshape(2, -1, len(FRAME_SYMBOLS)), covariance


def _given(
    estimate: Estimate, names: Sequence[str], common: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariance of parameters where others are known, and their derivatives by these;
    zero for names that the estimate does not have.
    """
    have = np.array([name in estimate.names for name in names])
    found = estimate.take([*compress(names, have), *common]).dense_covariance()
    n = int(have.sum())
    scale = np.sqrt(np.diag(found)[n:])
    scale[scale == 0.0] = 1.0
    inverse = np.linalg.pinv(found[n:, n:] / np.outer(scale, scale), hermitian=True)
    slopes = (found[:n, n:] / scale) @ inverse
    covariance = np.zeros((len(names), len(names)))
    covariance[np.ix_(have, have)] = found[:n, :n] - slopes @ (found[n:, :n] / scale[:, None])
    carried = np.zeros((len(names), len(common)))
    carried[have] = slopes / scale
    return covariance, carried
