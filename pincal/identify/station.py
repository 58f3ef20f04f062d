"""A station: one table of readings under a model, evaluated in pieces so that memory does not grow
with their number.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import compress, pairwise

import numpy as np

from pincal.errors import BadInputError
from pincal.identify.jacobian import AlongRows, Jacobian, SharedColumns
from pincal.identify.whitening import Serial, StopNoise, whitened_rows
from pincal.measure.instruments import InstrumentNoise, seen_by
from pincal.measure.measurements import Measurements, sensor_of
from pincal.model.conditions import Conditions, part_of
from pincal.model.model import Model, Shared
from pincal.parameters import Parameter, is_on_link
from pincal.sensors.row_samples import sample_rows
from pincal.sensors.sensor import Sensor
from pincal.sensors.setup import Setup
from pincal.thresholds import Count

# Rows worked on at once: with 60 parameters a piece is about 6 MB.
PIECE: Count = 4096
# Values of a model at which poses are known: those of base and tool alone are asked for again where
# a fit has ended, some steps later.
_LATEST: Count = 6
# Numbers of correlated columns that are whitened at once (16 MB), as that takes several copies.
_MOST_NUMBERS: Count = 2_000_000


# Columns of each joint in units of its position; the approach direction, in contrast, is that of
# its drive.
_MOVED = ("droop", "move")


@dataclass(frozen=True)
class Station:
    """One set-up of instrument and targets: a model, the conditions of N poses and the sensor's
    readings there.

    Vectors of values have the model's parameters first, then the sensor's.

    Attributes:
        model: the model, its chain's reference orientations being those of this station.
        conditions: the poses.
        sensor: the readings.
        weights: shape (N,), each row's inverse standard deviation relative to the others (mean
            about 1).
        whitening: shape (m, m, N), lower triangular matrix of each row that whitens the noise of
            its readings; default: it is white.
        name: distinguishes the stations of a problem; "" for a single one.
        position: shape (N,), of each row in the order of measurement, in rows; None without an
            order.
        serial: correlation of the noise along that order; default: none.
        arrival: noise that the rows of each stop of the robot share; default: none.
        trusted: shape (N,), rows that are never outliers; default: none.
        setup: name of the set-up whose instrument it shares with stations between other links; ""
            if it is its own.
    """

    model: Model
    conditions: Conditions
    sensor: Sensor
    weights: np.ndarray
    name: str = ""
    whitening: np.ndarray | None = None
    position: np.ndarray | None = None
    serial: Serial | None = None
    arrival: StopNoise | None = None
    trusted: np.ndarray | None = None
    setup: str = ""

    @property
    def shares_setup(self) -> bool:
        """Whether other stations may share some of its own parameters."""
        return bool(self.setup) or any(
            is_on_link(p.element) for p in compress(self.parameters, self.is_own)
        )

    def owner(self, parameter: Parameter) -> str:
        """Return the name under which one of several stations has a parameter of its own, "" for a
        part of the robot.

        A place on a link belongs to the robot, a target to the station, and all else to the
        instrument.
        """
        if is_on_link(parameter.element):
            return ""
        return (
            self.name if parameter.element in self.model.chain.targets else self.setup or self.name
        )

    def split(self, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the parts of a vector, shape (P,), for the model and for the sensor."""
        of_model = self.model.own(vector)
        return of_model, vector[len(of_model) :]

    def sensors(self, mask: np.ndarray | bool = True) -> np.ndarray:
        """Return which parameters are the sensor's, shape (P,), or those of them in a mask."""
        found = np.zeros(len(self.parameters), bool)
        self.split(found)[1][:] = mask
        return found

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The model's parameters, then the sensor's."""
        return self.model.parameters + self.sensor.parameters

    @cached_property
    def is_own(self) -> np.ndarray:
        """Which parameters are the station's own, shape (P,); the others are the robot's."""
        return np.concatenate([self.model.of_station, np.ones(len(self.sensor.parameters), bool)])

    @cached_property
    def block_sizes(self) -> np.ndarray:
        """Components of each block of readings, shape (blocks,)."""
        return np.array([block.size for block in self.sensor.blocks])

    @cached_property
    def reading_size(self) -> int:
        """Number m of components of a row's readings, all blocks together."""
        return int(self.block_sizes.sum())

    @cached_property
    def block_rows(self) -> list[slice]:
        """Slice of each block of readings among these components."""
        return [slice(a, b) for a, b in pairwise(np.cumsum([0, *self.block_sizes]).tolist())]

    def __len__(self) -> int:
        return len(self.conditions)

    def select(self, rows: np.ndarray) -> Station:
        """Return the station with some of its rows (mask or indices); itself with all in order."""
        if _are_all(rows, len(self)):
            return self
        found = replace(
            self,
            conditions=self.conditions.select(rows),
            sensor=self.sensor.select(rows),
            weights=self.weights[rows],
            whitening=None
            if self.whitening is None
            else np.ascontiguousarray(self.whitening[..., rows]),
            position=None if self.position is None else self.position[rows],
            serial=None if self.serial is None else self.serial.select(rows),
            arrival=None if self.arrival is None else self.arrival.select(rows),
            trusted=None if self.trusted is None else self.trusted[rows],
        )
        if self.conditions.around is None:
            latest = list(self._latest_poses.items())[-1:]
            found._latest_poses.update((key, poses[rows]) for key, poses in latest)
        return found

    def sample(self, most: int) -> Station:
        """Return the station with at most ``most`` of its rows, some of everything; itself if it
        has no more.
        """
        return (
            self
            if len(self) <= most
            else self.select(sample_rows(len(self), most, self.sensor.groups))
        )

    def with_model(self, model: Model) -> Station:
        """Return the same readings under another model."""
        return replace(self, model=model)

    def residuals(self, values: np.ndarray) -> np.ndarray:
        """Return reading minus prediction at all rows, shape (m, N), not weighted [m, rad]."""
        out = np.empty((self.reading_size, len(self)))
        (of_model, own) = self.split(values)
        for piece in self._pieces():
            part = self._part(piece)
            out[:, piece] = part.sensor.residuals(part.poses_read(of_model), own)
        return out

    def poses_read(self, of_model: np.ndarray) -> np.ndarray:
        """Return the poses that the readings depend on, shape (n, 3, 4), of the model at its
        values; those of the latest values are known.
        """
        known = self._latest_poses.get(of_model.tobytes())
        if known is not None:
            return known
        found = self.model.predict(of_model, self.conditions.at_moments)
        self.note_poses(of_model, found, most=_LATEST)
        return found

    @cached_property
    def _latest_poses(self) -> dict[bytes, np.ndarray]:
        return {}

    def knows_poses(self, of_model: np.ndarray) -> bool:
        """Return whether these are the latest values of the model, whose poses are known."""
        return of_model.tobytes() in self._latest_poses

    def note_poses(self, of_model: np.ndarray, poses: np.ndarray, *, most: int = 1) -> None:
        """Keep the poses at the latest values of the model, ``most`` of them, if they are few."""
        known = self._latest_poses
        key = of_model.tobytes()
        known.pop(key, None)
        for oldest in list(known)[: max(len(known) - most + 1, 0)]:
            del known[oldest]
        if len(poses) <= PIECE:
            known[key] = poses

    def _white(self, columns: np.ndarray) -> np.ndarray:
        """Return columns, shape (P, m, N), in which the noise of each row is white."""
        if self.whitening is None:
            return columns
        return np.asarray(whitened_rows(self.whitening, np.ascontiguousarray(columns)))

    def whitened(self, residuals: np.ndarray) -> np.ndarray:
        """Return residuals of all rows, shape (m, N), with white noise as a fit weights them."""
        residuals = self._white(residuals[None])[0]
        if not self.is_correlated:
            return residuals
        return np.concatenate(
            [self.uncorrelated(residuals[None, :, p], p)[0] for p in self._pieces()], axis=1
        )

    @property
    def is_correlated(self) -> bool:
        """Whether the noise of a row depends on that of others."""
        return self.serial is not None or self.arrival is not None

    def uncorrelated(self, columns: np.ndarray, piece: slice) -> np.ndarray:
        """Return columns of a piece of the rows, shape (D, m, n), with the correlation of rows
        removed.
        """
        if not self.is_correlated:
            return columns
        found = np.array(columns, order="C")
        self.uncorrelate(found, piece, slice(0, self.reading_size))
        return found

    @property
    def readings_apart(self) -> list[slice]:
        """Readings that are whitened by themselves where rows are correlated: blocks of them differ
        in the noise along the order of the rows, and rows of a stop share all.
        """
        if self.serial is None or self.arrival is not None:
            return [slice(0, self.reading_size)]
        return self.block_rows

    def factor_alone(self, readings: slice) -> np.ndarray | None:
        """Return the factor on these readings by which :meth:`uncorrelate` multiplies them, shape
        (m, 1), if their rows are independent.
        """
        if not self.is_correlated:
            return np.ones((1, 1))
        if self.serial is None or self.arrival is not None:
            return None
        return self.serial.of_readings(readings).alone

    def uncorrelate(
        self, columns: np.ndarray, piece: slice, readings: slice, *, transposed: bool = False
    ) -> None:
        """Remove the correlation of rows from columns at some :attr:`readings_apart`, or at all, in
        place; or multiply them by the transpose of what removes it.
        """
        # Rows of larger weight have less of all kinds of noise.
        weights = self.weights[piece]
        serial = None if self.serial is None else self.serial.of_readings(readings).select(piece)
        if self.arrival is None and serial is not None:
            # With the weights in one pass, as others take as long.
            serial.whiten(columns, weights, transposed=transposed)
            return
        columns *= 1.0 / weights if transposed else weights
        if serial is not None and transposed:
            serial.whiten(columns, np.ones(len(weights)), transposed=True)
        if self.arrival is not None:
            arrival = self.arrival.select(piece)
            columns[:] = arrival.whitened(columns, transposed=transposed)
        if serial is not None and not transposed:
            serial.whiten(columns, np.ones(len(weights)))
        columns *= weights if transposed else 1.0 / weights

    def coloured(self, noise: np.ndarray) -> np.ndarray:
        """Return white noise of all rows, shape (m, N), correlated like the readings': the inverse
        of :meth:`whitened`.
        """
        if self.serial is not None:
            parts = [
                self.serial.select(p).coloured((noise * self.weights)[:, p]) for p in self._pieces()
            ]
            noise = np.concatenate(parts, axis=1) / self.weights
        if self.arrival is not None:
            noise = self.arrival.coloured(noise * self.weights) / self.weights
        if self.whitening is None:
            return noise
        return np.asarray(
            np.linalg.solve(np.moveaxis(self.whitening, 2, 0), noise.T[:, :, None])[:, :, 0].T
        )

    def displacements(self, values: np.ndarray, residuals: np.ndarray | None = None) -> np.ndarray:
        """Return the displacement of each row's target, as far as its reading determines it, shape
        (N, 3) [m].

        ``residuals``, shape (m, N), are of predictions by nearby values; default: by these.
        """
        if residuals is not None:
            return self._displacements(values, residuals)
        # Several findings ask for those at the values of a fit.
        key = values.tobytes()
        if key not in self._latest_displacements:
            self._latest_displacements.clear()
            self._latest_displacements[key] = self._displacements(values, None)
        return self._latest_displacements[key].copy()

    @cached_property
    def _latest_displacements(self) -> dict[bytes, np.ndarray]:
        return {}

    def _displacements(self, values: np.ndarray, residuals: np.ndarray | None) -> np.ndarray:
        out = np.empty((len(self), 3))
        (of_model, own) = self.split(values)
        for piece in self._pieces():
            part = self._part(piece)
            poses = part.poses_read(of_model)
            off = part.sensor.residuals(poses, own) if residuals is None else residuals[:, piece]
            out[piece] = part.sensor.displacement(off, poses, own)
        return out

    def displacements_by(self, values: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Return the displacements of each row's target by free parameters, as far as its reading
        determines them, shape (F, N, 3) [m per unit].
        """
        of_model, own = self.split(values)
        model_free, own_free = self.split(free)
        columns = np.concatenate([np.ones(np.count_nonzero(model_free), bool), own_free])
        out = np.empty((np.count_nonzero(free), len(self), 3))
        for piece in self._pieces():
            part = self._part(piece)
            poses, motion = part._motion(of_model, model_free)
            jacobian = part.sensor.jacobian(poses, motion, own)[columns]
            for by_parameter, column in zip(out, jacobian, strict=True):
                by_parameter[piece] = part.sensor.displacement(column, poses, own)
        return out

    def displacements_shared(
        self, values: np.ndarray, free: np.ndarray
    ) -> Iterator[tuple[slice, Jacobian]]:
        """Yield, piece by piece, the rows and what :meth:`displacements_by` returns of them, with
        curves as basis times column.
        """
        of_model, own = self.split(values)
        plain = replace(self, whitening=None, serial=None, arrival=None)
        for piece, _, jacobian in plain.linearise_correlated(values, free):
            part = plain._part(piece)
            yield piece, jacobian.mapped(part._displaced(part.poses_read(of_model), own))

    def _displaced(self, poses: np.ndarray, own: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """Return the function from columns of readings, shape (m, N), to displacements of the
        target, shape (3, N).
        """
        return lambda column: self.sensor.displacement(column, poses, own).T

    def metres_per_reading(self, values: np.ndarray) -> float:
        """Return the displacement of the target per unit of the first block of readings: 1 except
        for images.
        """
        if self.sensor.blocks[0].unit == "m":
            return 1.0
        if not self.sensor.reads_place:
            return np.nan
        sizes = np.linalg.norm(self.residuals(values)[: self.sensor.blocks[0].size], axis=0)
        return float(
            np.median(
                np.linalg.norm(self.displacements(values), axis=1) / np.maximum(sizes, 1e-300)
            )
        )

    def linearise(
        self, values: np.ndarray, free: np.ndarray
    ) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Yield, piece by piece, the rows, the residuals, shape (m, n), and the Jacobian, shape
        (free, m, n).
        """
        of_model, own = self.split(values)
        model_free, own_free = self.split(free)
        for piece in self._pieces():
            part = self._part(piece)
            poses, motion = part._motion(of_model, model_free)
            jacobian = part.sensor.jacobian(poses, motion, own)
            if not own_free.all():
                jacobian = jacobian[np.concatenate([np.ones(len(motion), bool), own_free])]
            yield piece, part.sensor.residuals(poses, own), jacobian

    def _motion(self, of_model: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the poses that the rows depend on, and their motion by free parameters of the
        model, shape (F, rows, n).
        """
        poses, motion = self.model.linearise(
            of_model, self.conditions.at_moments, free=free, rows=self.sensor.twist_rows
        )
        return poses, motion.transpose(2, 1, 0)

    def linearise_shared(
        self, values: np.ndarray, free: np.ndarray
    ) -> Iterator[tuple[slice, np.ndarray, Jacobian]]:
        """Yield what :meth:`linearise` does, whitened and with curves as basis times column, for
        Gram matrices.

        Parameters of joints off the path that act through the loads on it alone have no columns:
        their effect is negligible.
        """
        # Nothing of a piece is held here while it is processed.
        for piece in self._pieces():
            yield piece, *self._uncorrelated_shared(*self._shared(piece, values, free), piece)

    def linearise_correlated(
        self, values: np.ndarray, free: np.ndarray
    ) -> Iterator[tuple[slice, np.ndarray, Jacobian]]:
        """Yield what :meth:`linearise_shared` does, still correlated between rows: a curve is a
        basis times a column, which takes far less memory.
        """
        for piece in self._pieces():
            yield piece, *self._shared(piece, values, free)

    def _shared(
        self, piece: slice, values: np.ndarray, free: np.ndarray
    ) -> tuple[np.ndarray, Jacobian]:
        """Return residuals and Jacobian of a piece of the rows, correlated between rows."""
        part = self._part(piece)
        of_model, own = self.split(values)
        model_free, own_free = self.split(free)
        model_free = model_free & part.model.affects_tip
        poses, motion, shared = part._motion_shared(of_model, model_free)
        part.note_poses(of_model, poses, most=_LATEST)
        curves = [
            (parameters, basis, i)
            for i, group in enumerate(shared)
            for parameters, basis in group.families
        ]
        apart = free.copy()
        self.split(apart)[0][:] = model_free
        for parameters, *_ in curves:
            apart[parameters] = False
        columns = part._white(part.sensor.jacobian(poses, motion, own))
        residuals = part._white(part.sensor.residuals(poses, own)[None])[0]
        n_apart = int(self.split(apart)[0].sum())
        of_sensor = columns[len(motion) :][own_free]
        plain = not shared and not len(of_sensor)
        dense = columns[:n_apart] if plain else np.concatenate([columns[:n_apart], of_sensor])
        column_of = np.cumsum(free) - 1
        families = tuple(
            SharedColumns(column_of[places], basis, columns[n_apart + i])
            for places, basis, i in curves
        )
        return residuals, Jacobian(int(free.sum()), column_of[apart], dense, families)

    def _motion_shared(
        self, of_model: np.ndarray, free: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, list[Shared]]:
        """Return the result of :meth:`_motion` with columns of curves shared, as
        :meth:`Model.linearise_shared` does.
        """
        if self.conditions.around is None:
            return self.model.linearise_shared(
                of_model, self.conditions, free=free, rows=self.sensor.twist_rows
            )
        # A curve has another value at each moment of a row.
        return *self._motion(of_model, free), []

    def _uncorrelated_shared(
        self, residuals: np.ndarray, jacobian: Jacobian, piece: slice
    ) -> tuple[np.ndarray, Jacobian]:
        """Return residuals and Jacobian of a piece of the rows, uncorrelated between rows."""
        if not self.is_correlated:
            return residuals, jacobian
        apart = self.uncorrelated_jacobian(jacobian, piece, slice(0, self.reading_size))
        return self.uncorrelated(residuals[None], piece)[0], apart

    def by_block(
        self, jacobian: Jacobian, piece: slice
    ) -> Iterator[tuple[slice, Jacobian | AlongRows]]:
        """Yield each block of readings, and a Jacobian of a piece of the rows there, uncorrelated
        between rows.
        """
        poses = slice(0, piece.stop - piece.start)
        whole = jacobian
        if self.arrival is not None:
            whole = self.uncorrelated_jacobian(jacobian, piece, slice(0, self.reading_size))
        for rows in self.block_rows:
            part = whole.part(rows, poses)
            factor = self.factor_alone(rows)
            change = self.along_rows(piece, rows)
            if change is None:
                yield rows, part
            elif factor is not None:
                yield rows, part.weighted(factor)
            else:
                yield rows, AlongRows(part, change)

    def along_rows(self, piece: slice, readings: slice) -> Callable[..., None] | None:
        """Return what :meth:`uncorrelate` does to columns of a piece that are stored pose by pose,
        shape (n, m, D); None unless rows are correlated along their order alone.
        """
        if self.serial is None or self.arrival is not None:
            return None
        serial = self.serial.of_readings(readings).select(piece)
        return partial(serial.whiten_rows, weights=self.weights[piece])

    def apart(
        self, jacobian: Jacobian, piece: slice, *, is_one: bool
    ) -> Iterator[tuple[slice, Jacobian | AlongRows]]:
        """Yield readings that are whitened by themselves, and a Jacobian of a piece of the rows
        there, uncorrelated between rows; its columns are changed a few at a time if all rows of it
        are one part.
        """
        if is_one and self.serial is not None and self.arrival is None:
            yield from self.by_block(jacobian, piece)
            return
        for some in self.readings_apart:
            yield some, self.uncorrelated_jacobian(jacobian, piece, some)

    def uncorrelated_jacobian(self, jacobian: Jacobian, piece: slice, readings: slice) -> Jacobian:
        """Return a Jacobian of a piece of the rows at some :attr:`readings_apart`, or at all, with
        the correlation of rows removed.
        """
        some = jacobian.part(readings, slice(0, piece.stop - piece.start))
        if (factor := self.factor_alone(readings)) is not None:
            return some.weighted(factor) if self.is_correlated else some
        # The effect of a curve at one row reaches others, too.
        columns, places = some.dense_columns()
        size = max(_MOST_NUMBERS // max(columns[0].size, 1), 1) if len(columns) else 1
        for start in range(0, len(columns), size):
            self.uncorrelate(columns[start : start + size], piece, readings)
        return Jacobian(jacobian.size, places, columns)

    def _pieces(self) -> Iterator[slice]:
        is_whole = self.sensor.is_whole or (
            self.serial is not None and np.any(np.diff(self.serial.position) < 0.0)
        )
        if self.arrival is not None and not is_whole:
            is_whole = not _is_contiguous(self.arrival.stop)
        around = self.conditions.around
        moments = 1 if around is None or around.q is None else around.q.shape[1]
        size = max(len(self), 1) if is_whole else max(PIECE // moments, 1)
        cuts = list(range(0, len(self), size))
        if self.arrival is not None and len(cuts) > 1:
            # No stop is divided.
            begins = np.flatnonzero(np.diff(self.arrival.stop, prepend=-1))
            cuts = np.unique(begins[np.searchsorted(begins, cuts, side="right") - 1]).tolist()
        for start, stop in pairwise([*cuts, len(self)]):
            yield slice(start, stop)

    def _part(self, piece: slice) -> Station:
        if piece == slice(0, len(self)):
            return self
        conditions = part_of(self.conditions, piece, (piece.start, piece.stop))
        # Weights and positions are the whole station's, as pieces are assembled by them.
        whitening = (
            None if self.whitening is None else np.ascontiguousarray(self.whitening[..., piece])
        )
        serial = None if self.serial is None else self.serial.select(piece)
        arrival = None if self.arrival is None else self.arrival.select(piece)
        return replace(
            self,
            conditions=conditions,
            sensor=self.sensor.select(piece),
            whitening=whitening,
            serial=serial,
            arrival=arrival,
        )


def _are_all(rows: np.ndarray, n: int) -> bool:
    """Return whether a mask or indices are all of n rows in their order."""
    if len(rows) != n:
        return False
    return bool(rows.all() if rows.dtype == bool else np.array_equal(rows, np.arange(n)))


def _is_contiguous(stop: np.ndarray) -> bool:
    """Return whether the rows of each stop, by number, follow each other."""
    return int(np.count_nonzero(np.diff(stop))) + 1 == len(np.unique(stop))


def station_of(
    model: Model,
    measurements: Measurements,
    payload_centre: np.ndarray,
    setup: Setup | None = None,
    *,
    name: str = "",
    instrument: InstrumentNoise | None = None,
) -> Station:
    """Return the station of a table of measurements under a model.

    Args:
        model: the model; its chain's targets are those of the table.
        measurements: the table.
        payload_centre: shape (3,), centre of mass of the payload in the tip frame [m].
        setup: the named points and the camera; default: as for
            :func:`pincal.measure.measurements.sensor_of`.
        name: of the station, if there are several.
        instrument: declared noise of its positions by range and direction.
    """
    sigma = measurements.sigma
    weights = np.ones(len(measurements)) if sigma is None else np.sqrt(np.mean(sigma**2)) / sigma
    conditions = conditions_of(model, measurements, payload_centre)
    sensor = sensor_of(measurements, setup)
    whitening = None
    if instrument is not None:
        whitening = instrument.whitening(
            seen_by(measurements), sum(block.size for block in sensor.blocks)
        )
    position = _positions(measurements)
    return Station(
        model,
        conditions,
        sensor,
        weights,
        name,
        whitening,
        position=position,
        setup=measurements.setup,
    )


def _positions(measurements: Measurements) -> np.ndarray:
    """Return the position of each row in the order of measurement, by time or line, shape (N,)."""
    along = measurements.rows.astype(float) if measurements.time is None else measurements.time
    steps = np.diff(np.sort(along))
    if measurements.time is None and np.any(np.diff(along) <= 0.0):
        # Rows of several files.
        return np.arange(len(along), dtype=float)
    return (
        np.asarray(along / np.median(steps[steps > 0.0]))
        if np.any(steps > 0.0)
        else np.arange(len(along), dtype=float)
    )


def conditions_of(
    model: Model, measurements: Measurements, payload_centre: np.ndarray
) -> Conditions:
    """Return the conditions of a table's rows; rows without a payload have none.

    Raises:
        BadInputError: for a target that a model of several targets does not have.
    """
    n = len(measurements)
    targets = _target_numbers(measurements, model.chain.targets)
    robot = model.chain.robot
    recorded = measurements.recorded()
    if robot.couplings:
        recorded |= {
            name: way @ robot.combination.T
            for name in _MOVED
            if (way := recorded[name]) is not None
        }
    moving = measurements.moving
    return Conditions(
        q=robot.from_reported(measurements.q),
        target=targets,
        payload=np.zeros(n) if measurements.payload is None else measurements.payload,
        payload_centre=np.asarray(payload_centre, float),
        sighted=measurements.position,
        inertial=None if moving is None else moving.inertial,
        around=replace(moving, course=None)
        if moving is not None and moving.q is not None
        else None,
        **recorded,
    )


def _target_numbers(measurements: Measurements, targets: Sequence[str]) -> np.ndarray:
    """Return the number of each row's target among those of a model, shape (N,)."""
    if len(targets) <= 1:
        return np.zeros(len(measurements), int)
    unknown = sorted(set(map(str, measurements.target)) - set(targets))
    if unknown:
        raise BadInputError(
            f"{measurements.source}: target {unknown[0]!r} is not in the model; "
            f"expected one of {', '.join(targets)}"
        )
    return np.array([targets.index(target) for target in measurements.target], int)


def fingerprints(station: Station) -> str:
    """Return four bytes per row, from its joint positions and readings, as text (base64).

    They identify the rows that a model was fitted to, which need not be kept.
    """
    sensor = station.sensor
    columns = [
        station.conditions.q,
        *(np.asarray(getattr(sensor, name)) for name in sensor.per_row),
    ]
    numbers = [c.reshape(len(station), -1) for c in columns if np.issubdtype(c.dtype, np.floating)]
    rows = np.ascontiguousarray(np.hstack(numbers)) + 0.0
    of_each = rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1])))
    sums = [zlib.crc32(bytes(of)) for of in of_each.ravel().tolist()]
    return base64.b64encode(np.array(sums, "<u4").tobytes()).decode()


def together(*marks: str) -> str:
    """Return the joint fingerprints of several sets of rows."""
    return base64.b64encode(np.concatenate([_numbers(part) for part in marks]).tobytes()).decode()


def count(marks: str) -> int:
    """Return the number of rows behind fingerprints."""
    return len(_numbers(marks))


def are_fingerprints(text: str) -> bool:
    """Return whether a text holds fingerprints."""
    try:
        return len(base64.b64decode(text, validate=True)) % 4 == 0
    except ValueError:
        return False


def known_rows(marks: str, station: Station) -> np.ndarray:
    """Return which rows of a station are among those behind fingerprints, shape (N,); by chance one
    in 10^5 is.
    """
    return np.isin(_numbers(fingerprints(station)), _numbers(marks))


def _numbers(marks: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(marks), "<u4")
