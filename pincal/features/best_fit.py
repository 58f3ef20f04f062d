r"""A frame by fitting nominal features to measured ones.

With the deviations e of the datum's features in the part's frame, their derivatives J by motions of
the frame and H by the measured numbers z, and S the covariance of z,

.. math:: \min_\xi (e + J \xi)^T (H S H^T)^{-1} (e + J \xi), \qquad
    \delta\xi = -(J^T W J)^{-1} J^T W H \, \delta z .
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from pincal.errors import BadInputError, IdentificationError
from pincal.features.feature_kinds import OF_DIRECTION, OF_POSITION, across
from pincal.features.feature_set import FeatureSet
from pincal.features.fit_numbers import FIT
from pincal.features.part import Part
from pincal.features.part_feature import PartFeature
from pincal.features.part_frame import PartFrame, differentiate
from pincal.robot.se3 import nearest_rotation
from pincal.thresholds import Count, Scale

# Features whose direction may point either way in a start; further ones are left out of it.
_TURNED: Count = 4
# Ratio to the least of the squared deviations of a start that may lead to the best fit; others
# have a direction the wrong way.
_ALIKE: Scale = 100.0
_STEPS: Count = 30
# Motion below which a fit has converged [rad, m].
_CONVERGED: Scale = 1e-10
# Motion that rounding leaves under weights that differ by much.
_STALLED: Scale = 1e-7
# Least standard deviation of a deviation [m], and relative to the largest one.
_EXACT: Scale = 1e-9
_RELATIVE: Scale = 1e-3
# Distance for which a turn counts where one feature is all there is [m].
_LEVER: Scale = 0.1
# Digits of squared deviations [m^2] to which frames fit alike: of 30 um.
_DIGITS: Count = 9
_PLACED = ("point", "circle", "sphere")
_AXIS = ("line", "cylinder")


def best_fit_frame(part: Part, measured: FeatureSet, covariance: np.ndarray) -> PartFrame:
    """Return the frame in which features are nearest to their nominals, see
    :func:`pincal.features.datum.frame_of`.

    Raises:
        BadInputError: for a feature without the nominals that it needs, or features that leave the
            frame open.
        IdentificationError: if the fit does not converge.
    """
    names = part.datum.features
    for name in names:
        feature = part.features[name]
        if feature.kind not in _PLACED and feature.direction is None:
            raise BadInputError(
                f"datum best fit: {feature.kind} {name!r} has no nominal direction; expected "
                f"direction = [i, j, k] in [feature.{name}]"
            )
    index = np.concatenate([np.arange(7) + measured.at(name).start for name in names])
    fit = _BestFit(
        features=tuple(part.features[name] for name in names),
        numbers=np.concatenate([measured.fits[name].numbers for name in names]),
        covariance=covariance[np.ix_(index, index)],
    )
    frame = fit.solve(lambda frame: misfit_of(part, measured, frame))
    by_numbers = np.zeros((6, len(measured.numbers)))
    by_numbers[:, index] = -fit.to_motion(frame) @ fit.by_numbers(frame)
    return PartFrame(frame.rotation, frame.origin, by_numbers)


def misfit_of(part: Part, measured: FeatureSet, frame: PartFrame) -> tuple[float, float]:
    """Return by how much the positions of all measured features are off their nominals in a frame
    [m^2], and how far it is turned: of frames that fit alike, as lines and planes have no sense of
    direction, the one that is turned least is meant.
    """
    off = 0.0
    for name, fit in measured.fits.items():
        feature = part.features[name]
        seen = frame.see(fit.numbers)
        if feature.position is not None:
            off += float(np.sum(_held(feature, seen) ** 2))
    return round(off, _DIGITS), -float(np.trace(frame.rotation))


def _held(feature: PartFeature, seen: np.ndarray) -> np.ndarray:
    """Return the deviation of a feature's position from the nominal one in the directions that it
    has, shape (3,) [m].
    """
    assert feature.position is not None
    off = seen[OF_POSITION] - feature.position
    along = seen[OF_DIRECTION] * (seen[OF_DIRECTION] @ off)
    if feature.kind in _AXIS:
        return np.asarray(off - along)
    if feature.kind == "plane":
        return np.asarray(along)
    return np.asarray(off)


@dataclass(frozen=True, eq=False)
class _BestFit:
    """Datum features with their numbers, shape (7D,), and the covariance of these."""

    features: tuple[PartFeature, ...]
    numbers: np.ndarray
    covariance: np.ndarray

    @cached_property
    def lever(self) -> float:
        """Distance for which deviations of directions count [m]: the extent of the nominals."""
        places = np.array([feature.position for feature in self.features])
        extent = float(np.linalg.norm(np.ptp(places, axis=0)))
        return extent if extent > _EXACT else _LEVER

    def deviations(self, frame: PartFrame, numbers: np.ndarray) -> np.ndarray:
        """Return the deviations of all features from their nominals in a frame, shape (m,) [m]."""
        found = []
        for feature, of in zip(self.features, numbers.reshape(-1, 7), strict=True):
            found.append(self._deviation(feature, frame.see(of)))
        return np.concatenate(found)

    def _deviation(self, feature: PartFeature, seen: np.ndarray) -> np.ndarray:
        """Return the deviations of one feature's numbers in the part's frame [m]."""
        assert feature.position is not None
        off = seen[OF_POSITION] - feature.position
        if feature.kind in _PLACED:
            return np.asarray(off)
        assert feature.direction is not None
        E = across(feature.direction)
        direction = seen[OF_DIRECTION] * (
            1.0 if seen[OF_DIRECTION] @ feature.direction > 0.0 else -1.0
        )
        turned = self.lever * (direction @ E)
        cosine = max(float(direction @ feature.direction), FIT.flat)
        if feature.kind == "plane":
            return np.concatenate([[direction @ off / cosine], turned])
        beside = off - direction * (feature.direction @ off) / cosine
        return np.concatenate([beside @ E, turned])

    def by_motion(self, frame: PartFrame) -> np.ndarray:
        """Return the derivatives of the deviations by motions of the frame, shape (m, 6)."""

        def at(motion: np.ndarray) -> np.ndarray:
            return self.deviations(frame.moved(motion), self.numbers)

        return differentiate(at, np.zeros(6))

    def by_numbers(self, frame: PartFrame) -> np.ndarray:
        """Return the derivatives of the deviations by the numbers, shape (m, 7D)."""

        def at(numbers: np.ndarray) -> np.ndarray:
            return self.deviations(frame, numbers)

        return differentiate(at, self.numbers)

    def to_motion(self, frame: PartFrame) -> np.ndarray:
        """Return minus the motion that deviations of 1 cause, shape (6, m)."""
        H = self.by_numbers(frame)
        S = H @ self.covariance @ H.T
        least = max(_EXACT, _RELATIVE * float(np.sqrt(np.diag(S).max(initial=0.0))))
        whiten = np.linalg.inv(np.linalg.cholesky(S + least**2 * np.eye(len(S))))
        return np.asarray(np.linalg.pinv(whiten @ self.by_motion(frame)) @ whiten)

    def is_open(self, frame: PartFrame) -> bool:
        """Return whether some motion of the frame changes no deviation."""
        # Turns about the middle of the features, by lengths at their extent: sizes are alike.
        scale = np.repeat([1.0 / self.lever, 1.0], 3)
        middle = self.numbers.reshape(-1, 7)[:, OF_POSITION].mean(axis=0) - frame.origin
        about = np.eye(6)
        about[3:, :3] = np.cross(np.eye(3), -middle).T
        sizes = np.linalg.svd((self.by_motion(frame) @ about) * scale, compute_uv=False)
        return bool(len(sizes) < 6 or sizes[-1] < FIT.flat * sizes[0])

    def solve(self, misfit: Callable[[PartFrame], tuple[float, float]]) -> PartFrame:
        """Return the best frame from all starts, by the misfit of all features.

        Raises:
            BadInputError: if the features leave the frame open.
            IdentificationError: if no fit converges.
        """
        starts = list(self._starts())
        found = [frame for frame in map(self._descend, starts) if frame is not None]
        best = min(found or starts, key=misfit)
        if self.is_open(best):
            raise BadInputError(
                f"datum best fit: {', '.join(feature.name for feature in self.features)} leave the "
                "frame open; expected three points apart, or features that hold every motion"
            )
        if not found:
            raise IdentificationError(
                "datum best fit: did not converge; look for a feature that was taken for another "
                "one, or nominals in another frame"
            )
        return best

    def _cost(self, frame: PartFrame) -> float:
        """Return the sum of the squared deviations [m^2]."""
        return float(np.sum(self.deviations(frame, self.numbers) ** 2))

    def _starts(self) -> Iterator[PartFrame]:
        """Yield the frames that fit best of those that align positions and directions, for each
        way in which directions may point.
        """
        turned = [i for i, of in enumerate(self.features) if of.kind not in _PLACED][:_TURNED]
        ways = product((1.0, -1.0), repeat=len(turned))
        starts = [self._aligned(turned, signs) for signs in ways]
        least = _ALIKE * min(map(self._cost, starts)) + _EXACT
        yield from (start for start in starts if self._cost(start) <= least)

    def _aligned(self, turned: list[int], signs: tuple[float, ...]) -> PartFrame:
        """Return the frame turned as directions and ways between places are, with the shift that
        fits best then.
        """
        numbers = self.numbers.reshape(-1, 7)
        nominal = []
        there = []
        for i, sign in zip(turned, signs, strict=True):
            nominal.append(self.features[i].direction)
            there.append(sign * numbers[i, OF_DIRECTION])
        placed = [i for i, of in enumerate(self.features) if of.kind in _PLACED]
        if placed:
            places = np.array([self.features[i].position for i in placed])
            nominal.extend((places - places.mean(axis=0)) / self.lever)
            measured = numbers[placed][:, OF_POSITION]
            there.extend((measured - measured.mean(axis=0)) / self.lever)
        R = nearest_rotation(np.array(there).T @ np.array(nominal))
        frame = PartFrame(R, numbers[:, OF_POSITION].mean(axis=0), np.zeros((6, 0)))
        by_shift = self.by_motion(frame)[:, 3:]
        off = self.deviations(frame, self.numbers)
        shift = np.linalg.lstsq(by_shift, -off, rcond=None)[0]
        return frame.moved(np.concatenate([np.zeros(3), shift]))

    def _descend(self, frame: PartFrame) -> PartFrame | None:
        """Return the nearest generalised least-squares frame (Gauss, Newton), None if there is no
        convergence.
        """
        step = np.full(6, np.inf)
        for _ in range(_STEPS):
            step = -self.to_motion(frame) @ self.deviations(frame, self.numbers)
            frame = frame.moved(step)
            if np.linalg.norm(step) < _CONVERGED:
                break
        return frame if np.linalg.norm(step) < _STALLED else None
