"""A calibrated robot at a new set-up: instrument and targets located from its rows.

The robot's own parameters are held fixed; base frame, targets, the instrument's systematic errors
and other parameters of the sensor are estimated. Effects of another station (a drift, a scale) are
not transferred.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress

import numpy as np
from scipy.special import gammainc

from pincal.calibration.another_day import unrecorded
from pincal.calibration.calibration_numbers import OTHER_ROWS
from pincal.calibration.covered import of_the_day
from pincal.calibration.day_notes import note_on, notes_on_day
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.frame_shift import FrameShift, moved
from pincal.calibration.row_noise import RowNoise, noise_of_rows
from pincal.calibration.stepping import laid_again, step_notes
from pincal.errors import BadInputError, counted
from pincal.identify.beliefs import bounds_of
from pincal.identify.fit import Priors, Solution
from pincal.identify.initial import place_arm
from pincal.identify.noise import Noise
from pincal.identify.normal import accumulate
from pincal.identify.options import Options
from pincal.identify.posterior import eliminate
from pincal.identify.problem import Problem
from pincal.identify.solve import solve
from pincal.identify.station import Station, count, known_rows, station_of
from pincal.identify.stop_scatter import SharedNoise, StopScatter, scatter_of_stops, shared_noise
from pincal.measure.admit import check_placeable
from pincal.measure.measurements import Measurements
from pincal.measure.poses import by_pose
from pincal.measure.stops import StopRows
from pincal.model.effect import Effect
from pincal.parameters import Estimate, estimate_of
from pincal.sensors.setup import Setup
from pincal.thresholds import Count, Scale
from pincal.validate.clock_jumps import SteppingClock, stepping_clock
from pincal.validate.misfit import Misfit, misfit_at

# Multiple of its noise at which a block of readings tells nothing, and halvings of the range of a
# noise.
_NO_INFORMATION: Scale = 1e4
_HALVINGS: Count = 12
# Different fingerprints of a row.
_FINGERPRINTS: Scale = 2.0**32
# Poses of the calibrated range at which it is evaluated.
_EVALUATED: Count = 64


@dataclass(frozen=True, repr=False)
class Placed:
    """A calibrated robot at a new station.

    Attributes:
        model: the calibrated model, which predicts in the frame of the new station's instrument.
        station: that model over the station's rows: the mean of each stop.
        solution: the fit of the station's own parameters.
        moved: displacement of instrument and target.
        stops: the rows, and the single readings behind them.
        noise: of the rows.
        notes: effects of the calibration's day or set-up that could not be transferred.
    """

    model: FittedRobot
    station: Station
    solution: Solution
    moved: FrameShift
    stops: StopRows
    noise: RowNoise
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"Placed({self.model!r}, {len(self.station)} rows)"

    @property
    def values(self) -> np.ndarray:
        """Values of the station's parameters, shape (P,)."""
        return self.model.values

    @property
    def table(self) -> Measurements:
        """The rows: the mean of each stop."""
        return self.stops.table

    def stepping(self, table: Measurements) -> Measurements:
        """Return the table of its rows, or one with more of them, by its clock with its steps."""
        found = self.table.moving
        given = table.moving
        if found is None or given is None or found.steps == given.steps:
            return table
        return laid_again(table, SteppingClock(found.clock, found.steps)) or table

    @cached_property
    def shared(self) -> SharedNoise | None:
        """Noise that coordinates and targets of a stop, and stops at a pose, share; None where none
        is known.

        What targets share is estimated from the residuals: if the robot has changed it is too
        large, which is cautious.
        """
        plan = self.stops.plan
        sizes = self.station.block_sizes
        of_pose = float(np.average(self.noise.of_pose, weights=sizes))
        of_drives = float(np.average(self.noise.of_drives, weights=sizes))
        if plan.n_poses == len(plan) and not of_drives:
            return None
        sigma = self.model.sigma
        each = np.full(len(plan), of_pose)
        found = shared_noise(self.station, self.values, plan, sigma=sigma, of_pose=each)
        found = replace(found, of_drives=of_drives, of_rows=1.0 - of_drives)
        if plan.shares_stops:
            scale = self.station.weights / np.repeat(sigma, self.station.block_sizes)[:, None]
            sound = np.flatnonzero(self.solution.weights > 0.0)
            residuals = (self.station.residuals(self.values) * scale)[:, sound]
            spent = int(self.solution.free.sum())
            likeliest = found.select(sound).likeliest(residuals, spent=spent)
            # Together no less than the noise that is expected.
            of_drives = max(likeliest.of_drives, 1.0 - likeliest.of_rows)
            found = replace(found, of_drives=of_drives, of_rows=likeliest.of_rows)
        return found if found.of_drives or of_pose else None

    def misfit_of(self, rows: np.ndarray) -> Misfit:
        """Return the residuals of some of the rows, a mask of shape (N,), against what
        is allowed.
        """
        known = self.model
        found = self.solution.free
        robust = rows.astype(float)
        at = self.station, self.values
        return misfit_at(
            *at, covariance=known.covariance, sigma=known.sigma, robust=robust, found=found
        )

    @cached_property
    def misfit(self) -> Misfit:
        """The residuals against what noise and the calibration's uncertainty allow; outliers left
        out.
        """
        return self.misfit_of(self.solution.weights > 0.0)


@dataclass(frozen=True, eq=False)
class _Visit:
    """A calibrated robot and the rows of a new station.

    Attributes:
        known: the calibrated model for their kind of readings.
        stops: the rows, and the single readings behind them.
        setup: of the station.
    """

    known: FittedRobot
    stops: StopRows
    setup: Setup

    @classmethod
    def of(cls, calibrated: FittedRobot, measurements: Measurements | StopRows) -> _Visit:
        if isinstance(measurements, StopRows):
            stops = measurements
        else:
            robot = calibrated.robot_model().model.chain.robot
            stops = StopRows.of(measurements.in_order_of(robot))
        known = calibrated.robot_model(stops.table.kind)
        named = stops.table.point_names
        # Other named points belong to other stations.
        points = () if named is None else map(str, np.unique(named))
        kept = {name: known.setup.points.get(name) for name in points}
        return cls(known, stops, replace(known.setup, points=kept))

    @cached_property
    def rows(self) -> Measurements:
        """The rows on the day of the calibration."""
        return self.known.of_its_day(self.stops.table)

    @cached_property
    def arm(self) -> FittedRobot:
        """The calibrated robot without the effects that are not transferred."""
        reads = self.rows.position is not None

        def comes_along(effect: Effect) -> bool:
            return effect.scope == "robot" or (
                reads and effect.is_sighted and effect.locus.station is None
            )

        return self.known.with_effects(comes_along)

    @cached_property
    def options(self) -> Options:
        """Of the fit of the station's own parameters."""
        return self.known.fitting_options(setup=self.setup)

    @cached_property
    def located(self) -> tuple[Station, np.ndarray]:
        """The station, and the initial values of its parameters, shape (P,)."""
        arm = self.arm
        rows = {"": self.rows}
        (found,) = place_arm(arm.model, arm.model_values, rows, options=self.options)
        return found

    def noise(self, sigma_orientation: float | None) -> RowNoise:
        """Return the noise of the rows in the session of the calibration."""
        station, start = self.located
        return noise_of_rows(
            self.known,
            self.rows.kind,
            station.sensor.blocks,
            declared=self.rows.sigma,
            scatter=_scatter(self.known, station, start, self.stops, self.setup),
            sigma_orientation=sigma_orientation,
        )

    def solution(self, noise: RowNoise) -> Solution:
        """Return the fit of the station's own parameters."""
        station, start = self.located
        problem = Problem((station,))
        free = station.is_own.copy()
        station.split(free)[1][:] = ~station.sensor.fixed
        sizes = np.array([parameter.size for parameter in station.parameters])
        priors = Priors(sizes, bounds_of(problem, self.options))
        return solve(problem, start, free, priors, Noise(noise.declared))

    def model(self, solution: Solution, noise: RowNoise) -> FittedRobot:
        """Return the calibrated model at the station."""
        station, _ = self.located
        at_station = replace(
            self.known.station,
            sensor_kind=self.rows.kind,
            sigma=noise.estimated(solution.estimated),
            setup=self.setup,
            repeated=noise.repeatability,
        )
        estimate = _estimate(station, solution, self.arm.estimate)
        return self.known.with_station(at_station).with_model(station.model, estimate)


def place_station(
    calibrated: FittedRobot,
    measurements: Measurements | StopRows,
    *,
    sigma_orientation: float | None = None,
) -> Placed:
    """Locate instrument and targets of a new station; the robot is held as calibrated.

    Readings of a target in one stop share the arrival of the drives, so that their mean is one row.

    Args:
        calibrated: the calibrated robot; of several stations, displacements refer to the first with
            such readings.
        measurements: rows of the new station, with any instrument.
        sigma_orientation: noise of orientations [rad]; default: that of the calibration, or, of a
            model without any, estimated from the rows.

    Returns:
        The robot at the new station. Outliers are left out. Of an arm in motion its clock has the
        steps that the rows show, as in a calibration.

    Raises:
        BadInputError: if the rows are too few, or too similar, to determine the poses, or a clock
            steps more often than one does.

    Example:
        >>> from pincal import Conditions, Options, Robot
        >>> from pincal.model.chain import Chain
        >>> from pincal.model.model import Model
        >>> from pincal import calibrate, measurements_from_arrays
        >>> robot = Robot.from_urdf("ur10")
        >>> q = robot.random_configurations(40, np.random.default_rng(0))
        >>> seen = Model(Chain.of(robot), ()).predict(np.zeros(0), Conditions.at(q))[:, :, 3]
        >>> first, second = (
        ...     measurements_from_arrays(robot.joint_names, q, position=seen + way)
        ...     for way in (0.0, 0.5)
        ... )
        >>> found = place_station(calibrate(robot, first, Options(effects=())), second)
        >>> round(found.moved.instrument, 6), found.moved.target < 1e-9
        (0.866025, True)
    """
    found = _at_station(_Visit.of(calibrated, measurements), sigma_orientation)
    # A step shows others that it hid.
    while (clock := _stepping_clock(found)) is not None:
        stepping = laid_again(found.table, clock)
        if stepping is None:
            break
        found = _at_station(_Visit.of(calibrated, stepping), sigma_orientation)
    told = tuple(step_notes({"": found.table}))
    return replace(found, notes=(*found.notes, *told))


def _stepping_clock(placed: Placed) -> SteppingClock | None:
    """Return the clock with further steps that the rows of a station show, as for a calibration;
    None if they show none.
    """
    solution = placed.solution
    return stepping_clock(
        placed.table, placed.station, solution.values, solution.free, solution.estimated
    )


def _at_station(visit: _Visit, sigma_orientation: float | None) -> Placed:
    """Return the robot at a new station, whose clock has the steps of its rows."""
    known = visit.known
    stops = visit.stops
    check_placeable(stops.table, visit.setup)
    station, _ = visit.located
    along = set(visit.arm.model.effects)
    unknown, notes = _of_another_session(known, station, stops.table, along)
    noise = visit.noise(sigma_orientation)
    if unknown:
        noise = noise.with_unknown(unknown, station.sensor.blocks)
    solution = visit.solution(noise)
    model = visit.model(solution, noise)
    _refuse_undetermined(model, station, solution, source=stops.table.source)
    for block in np.flatnonzero(~noise.is_known):
        sigma = _beyond_uncertainty(model, station, solution, int(block))
        model = model.with_station(replace(model.station, sigma=sigma))
    return Placed(model, station, solution, moved(known, model), stops, noise, notes)


def _beyond_uncertainty(
    model: FittedRobot, station: Station, solution: Solution, block: int
) -> np.ndarray:
    """Return the noise, shape (blocks,), with that of one block reduced by what the calibration's
    uncertainty explains.

    Residuals of readings that a calibration did not have, such as orientations, are partly its own
    uncertainty.
    """
    robust = (solution.weights > 0.0).astype(float)

    def at(size: float) -> Misfit:
        sigma = model.sigma.copy()
        sigma[block] = size
        return misfit_at(
            station,
            model.values,
            covariance=model.covariance,
            sigma=sigma,
            robust=robust,
            found=solution.free,
        )

    largest = float(model.sigma[block])
    without = at(_NO_INFORMATION * largest)
    expected = float(station.block_sizes[block] * robust.sum()) - (
        at(largest).found - without.found
    )
    low = 0.0
    high = largest
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if at(middle).square - without.square > expected:
            low = middle
        else:
            high = middle
    return np.where(np.arange(len(model.sigma)) == block, high, model.sigma)


def _scatter(
    known: FittedRobot, station: Station, values: np.ndarray, stops: StopRows, setup: Setup
) -> StopScatter | None:
    """Return the scatter of the single readings behind a station's rows; None where none was
    repeated.
    """
    if not stops.of_readings.is_repeated:
        return None
    readings = known.of_its_day(stops.readings)
    single = station_of(station.model, readings, station.conditions.payload_centre, setup)
    return scatter_of_stops(single, values, stops.of_readings)


def _of_another_session(
    known: FittedRobot, station: Station, rows: Measurements, along: set[Effect]
) -> tuple[float, tuple[str, ...]]:
    """Return the additional uncertainty of rows of another day or set-up, per axis [m], and notes
    on it.

    It is what effects that are not transferred, and effects of columns that the rows lack, did to
    the target.
    """
    lacking = set(unrecorded(known.station, rows))
    untransferred = [
        effect
        for effect in known.model.effects
        # Apart from its pose, drift and targets, effects of the instrument are not transferred.
        if effect in lacking
        or (
            effect.scope == "station"
            and effect.locus.station is None
            and effect.locus.acts_on not in ("base", "tool", "clock")
            and effect not in along
        )
    ]
    at = (
        known.of_its_day(replace(station.conditions, target=np.zeros(len(station), int)))
        if untransferred
        else None
    )
    days = set(known.covered.days)
    found = [
        note_on(known, effect, rows.source, at if set(effect.needs) <= days else None)
        for effect in untransferred
    ]
    return float(np.sqrt(sum(size**2 / 3.0 for size, _ in found))), tuple(note for _, note in found)


def fitted_rows(marks: str, model: FittedRobot, stops: StopRows) -> np.ndarray:
    """Return which single readings a model was fitted to, alone or in a mean of their stop or pose,
    shape (N,).

    Args:
        marks: fingerprints of the rows that it was fitted to.
        model: that reads them, wherever the station is.
        stops: the readings and their means.
    """
    found = known_rows(marks, model.readings(stops.readings))
    # Among many rows some have the fingerprint of another by chance.
    by_chance = count(marks) * len(found) / _FINGERPRINTS
    if gammainc(int(found.sum()), by_chance) > OTHER_ROWS.rare:
        found = np.zeros(len(found), bool)
    if not stops.of_readings.is_repeated:
        return found
    of_stops = np.flatnonzero(known_rows(marks, model.readings(stops.table)))
    found |= np.isin(stops.row_of, of_stops)
    means = by_pose(stops.readings)
    things = stops.of_readings.thing
    # Means of poses stand in the order of their first readings.
    order = things[np.sort(np.unique(things, return_index=True)[1])]
    return np.asarray(found | np.isin(things, order[known_rows(marks, model.readings(means))]))


def _estimate(station: Station, solution: Solution, arm: Estimate) -> Estimate:
    r"""Return the estimate of all parameters, the station's own conditional on the arm's.

    With K their covariance for a known arm, L their derivatives by the arm's parameters and C the
    covariance of these, they have the covariance :math:`K + L C L^T`, and :math:`-L C` with the
    arm's.
    """
    own = solution.free
    robots = ~station.is_own
    covariance = np.zeros((len(own),) * 2)
    covariance[np.ix_(robots, robots)] = arm.take(
        p.name for p in compress(station.parameters, robots)
    ).dense_covariance()
    known = np.diag(covariance) > 0.0
    free = own | known
    form = accumulate(station, solution.values, free, solution.weights).at(solution.sigma)
    sizes = np.array([parameter.size for parameter in station.parameters])
    _, part = eliminate(form, own[free], sizes[free], solution.values[free])
    C = covariance[np.ix_(known, known)]
    covariance[np.ix_(own, own)] = part.alone.covariance + part.carried @ C @ part.carried.T
    covariance[np.ix_(own, known)] = -part.carried @ C
    covariance[np.ix_(known, own)] = covariance[np.ix_(own, known)].T
    return estimate_of(station.parameters, solution.values, covariance)


def _refuse_undetermined(
    model: FittedRobot, station: Station, solution: Solution, *, source: str
) -> None:
    """Refuse rows that do not determine instrument and target: predictions in other poses would be
    arbitrary.
    """
    if station.sensor.blocks[0].unit != "m":
        return
    rng = np.random.default_rng(0)
    (lower, upper) = model.covered.q.T
    rows = station.select(np.resize(np.arange(len(station)), _EVALUATED))
    there = replace(rows.conditions, q=rng.uniform(lower, upper, (len(rows), len(lower))))
    size = station.sensor.blocks[0].size
    K = solution.posterior.covariance
    pieces = replace(rows, conditions=there).linearise(solution.values, solution.free)
    worst = (
        max(
            float(np.einsum("imn,ij,jmn->mn", J[:, :size], K, J[:, :size]).max())
            for _, _, J in pieces
        )
        ** 0.5
    )
    if worst > OTHER_ROWS.undetermined * solution.sigma[0]:
        raise BadInputError(
            f"{source}: {counted(len(station), 'row', 'do')} not determine the pose of "
            "instrument and target: "
            f"predictions in other poses are uncertain by {1e3 * worst:.3g} mm; add rows in "
            "different poses and with the tool turned in different ways"
        )


def without_absent(
    calibrated: FittedRobot, rows: Measurements
) -> tuple[FittedRobot, tuple[str, ...]]:
    """Return the model without effects of its station that rows can't evaluate, such as a drift
    without times, and notes.

    Effects of a column whose mean the model contains are kept and evaluated at that mean.
    """
    days = set(calibrated.covered.days)
    lacking = unrecorded(calibrated.station, rows)
    gone = [
        effect
        for effect in lacking
        if effect.scope == "station" and not set(of_the_day(effect)) <= days
    ]
    notes = tuple(note_on(calibrated, effect, rows.source, None)[1] for effect in gone)
    found = calibrated.with_effects(lambda effect: effect not in gone) if gone else calibrated
    return found, (*notes, *notes_on_day(found, rows))
