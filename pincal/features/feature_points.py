"""Points of features, from the readings of a sensor on the flange, with their covariance by its
sources.

An image lacks the depth: its points are intersections, see :mod:`pincal.features.triangulation`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pincal.calibration.position_covariance import PositionCovariance, SharedErrors
from pincal.features.mounted_sensor import MountedSensor, SourceEvidence
from pincal.features.readings import CONTACT, RANGE, FeatureReadings


@dataclass(frozen=True, eq=False)
class LocatedPoints:
    """K points of features in one frame, see :class:`MountedSensor`.

    Attributes:
        feature: shape (K,), the feature of each.
        place: shape (K, 3) [m].
        covariance: of these, by its sources.
        evidence: of the sources.
        passes: shape (K,), the run through the features.
        sensor: shape (K, 3), where the robot's tip was, which tells the side of a touch [m].
        readings: shape (K,), number of readings behind each.
        stops: of each, the numbers of the stops in which it was read.
    """

    feature: np.ndarray
    place: np.ndarray
    covariance: PositionCovariance
    evidence: Mapping[str, SourceEvidence]
    passes: np.ndarray
    sensor: np.ndarray
    readings: np.ndarray
    stops: tuple[frozenset[int], ...]

    def __len__(self) -> int:
        return len(self.feature)

    def select(self, rows: np.ndarray) -> LocatedPoints:
        """Return some of the points, by mask or indices."""
        index = np.arange(len(self))[rows]
        return replace(
            self,
            feature=self.feature[index],
            place=self.place[index],
            covariance=self.covariance.select(index),
            passes=self.passes[index],
            sensor=self.sensor[index],
            readings=self.readings[index],
            stops=tuple(self.stops[i] for i in index),
        )

    def without_source(self, name: str) -> LocatedPoints:
        """Return the points as if they had no errors by a source."""
        return replace(self, covariance=self.covariance.without_source(name))

    def moved(self, shift: np.ndarray) -> LocatedPoints:
        """Return the points at other places, by shifts of shape (K, 3) [m]."""
        return replace(self, place=self.place + shift)

    def with_source(
        self, name: str, errors: SharedErrors, evidence: SourceEvidence
    ) -> LocatedPoints:
        """Return the points with a further source of uncertainty."""
        return replace(
            self,
            covariance=self.covariance.with_source(name, errors),
            evidence={**self.evidence, name: evidence},
        )


def points_of_sensor(mounted: MountedSensor) -> LocatedPoints:
    """Return the points of readings that tell all three coordinates: of a 3D sensor, of a range
    along the sensor's axis, and of contacts.
    """
    readings = mounted.readings
    seen = _seen(readings)
    turn = mounted.poses[:, :, :3]
    place = np.einsum("nij,nj->ni", turn, seen) + mounted.poses[:, :, 3]
    covariance = mounted.arm_errors(seen)
    evidence = dict(mounted.arm_evidence(covariance.sources))
    found = LocatedPoints(
        feature=readings.feature,
        place=place,
        covariance=covariance,
        evidence=evidence,
        passes=readings.passes,
        sensor=mounted.tips,
        readings=np.ones(len(readings), int),
        stops=tuple(frozenset({stop}) for stop in readings.stop.tolist()),
    )
    sigma, rest = mounted.noise
    if readings.kind == RANGE:
        sigma = sigma * np.array([0.0, 0.0, 1.0])
    if not np.any(sigma):
        return found
    blocks = turn @ (sigma[:, None] ** 2 * turn.swapaxes(1, 2))
    return found.with_source("sensor", SharedErrors.of_each(blocks), rest)


def _seen(readings: FeatureReadings) -> np.ndarray:
    """Return the points of readings in the sensor's frame, shape (N, 3) [m]."""
    if readings.kind == CONTACT or readings.seen is None:
        return np.zeros((len(readings), 3))
    if readings.kind == RANGE:
        return np.column_stack([np.zeros((len(readings), 2)), readings.seen])
    return readings.seen
