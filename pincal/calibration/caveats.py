"""Reservations about a fit: the findings as data, and the one place where they are worded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from pincal.calibration.calibration_numbers import DOUBTED
from pincal.calibration.change_numbers import CHANGES
from pincal.errors import counted
from pincal.identify.arrivals import shares_stops
from pincal.identify.beliefs import is_on_tool
from pincal.identify.calibrate import doubts_of_known
from pincal.identify.choices import found_moments
from pincal.identify.fit import ModelFit
from pincal.identify.rounded_joints import RoundedJoints
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.notes import Note, Severity
from pincal.thresholds import Count
from pincal.units import Quantity, format_small, show_chance, show_rounded, show_unit
from pincal.validate.accuracy import pose_error_sizes
from pincal.validate.agreement import computed, implausible
from pincal.validate.gathered import Gathering, bump_in, gathering_of, in_common
from pincal.validate.given_lengths import contradicted_lengths
from pincal.validate.lack_of_fit import LackOfFit
from pincal.validate.midway import change_in
from pincal.validate.misfit import MISFIT, is_informative
from pincal.validate.outcome import MovedParameter

# Lines that a note lists.
_LISTED: Count = 8


class CaveatKind(Enum):
    """What is noteworthy; the values are the messages, with their figures in braces."""

    FEW_READINGS = (
        "{poses} training poses give {readings} readings for {parameters} parameters, {left:.0f} "
        "more than they determine: too few to detect residuals of twice the noise, and the result "
        "is dominated by the prior; measure more poses"
    )
    SPARE_READINGS = (
        "{poses} training poses give {readings} readings for {parameters} parameters: the result "
        "relies on the prior; measure more poses"
    )
    NOT_IMPROVED = (
        "these readings are too few or too noisy to improve the robot safely: within the joint "
        "limits its URDF is expected to be off by {nominal:.3g} mm rms, the geometry that they "
        "suggest by {calibrated:.3g} mm. It stays as in its URDF; only instrument and target are "
        "calibrated. Measure more poses, or with less noise"
    )
    NARROWED = (
        "these readings determine little of the robot away from their poses, and a plain fit would "
        "make it worse there: its deviations were taken to be about {scale:.2g} times the usual "
        "size, as the readings suggest. Measure more of the joints' ranges for more"
    )
    CONTRADICTED = "{what}"
    WRONG_LENGTH = (
        "{points} were given as {given} apart; without that, these readings and the robot's own "
        "lengths say {found}: measure the distance again"
    )
    NOT_CONVERGED = (
        "the fit did not converge ({how}); check the noise, and look for rows that do not "
        "belong to this robot"
    )
    NOISE_EXCEEDED = (
        "the residuals are {ratio:.2f} times the declared noise (p {p_value}): the model is "
        "incomplete or the declared noise is too small; uncertainties are scaled up accordingly"
    )
    ARRIVALS = (
        "the residuals are {ratio:.2f} times the declared noise of the instrument, as of drives "
        "that all stop to {size} from pose to pose (one standard deviation): neighbouring poses "
        "have unrelated errors. No calibration improves this; measure ten poses three times each, "
        "arriving anew, to judge the model by it"
    )
    ROUNDED = "{what}; {how}; record the joints with all digits"
    NOISE_OVERSTATED = (
        "the residuals are smaller than the declared noise allows: the declared noise is too large"
    )
    UNTURNED = (
        "these poses turn the tool about one axis or not at all, and do not tell where on it the "
        "target is (standard deviation {sigma}): turn the wrist about two axes, or give its place "
        "(tool in cell.toml)"
    )
    NO_INSTRUMENT = (
        "no instrument measured the robot, so what its readings do not determine keeps its nominal "
        "value; priors are as wide as the readings require: {lengths:g} times the usual for "
        "lengths, {angles:g} for angles, {drives:g} for drive compliances, {bearings:g} for "
        "others. Elsewhere the standard deviation of a predicted position falls {how}"
    )
    UNSEEN_DIRECTION = (
        "all readings are within 10 degrees of {where} in the axes of {base}: nothing was measured "
        "perpendicular to it; measure in other directions, too"
    )
    BLIND = (
        "these readings hardly determine {link}: the standard deviation of its predicted "
        "position in its workspace was "
        "{before:.2g} mm and is now {after:.2g} mm; do not use the model to correct its positions"
    )
    MOUNT_MOVED = (
        "the readings alone move the mount of {joint} by {moved:.3g} mm, with a standard "
        "deviation of {sigma:.2g} mm: they "
        "do not determine it. Measure in more directions and at more places, or with an instrument"
    )
    MASSES_FOUND = (
        "the robot description has no usable masses for {links}: they were estimated with "
        "the compliances, {mass:.3g} kg in total (standard deviation {percent:.0f} %); predictions "
        "do not depend on their common factor"
    )
    IMPLAUSIBLE = (
        "{how}: too large for any calibrated arm, so this is not a model of this robot; "
        "check table, URDF, tip, and lengths that were given. If the instrument is that noisy, "
        "declare it (--noise, or a column sigma)"
    )
    OWN_POSE = (
        "with only base and tool fitted, {left} remain: no instrument is that accurate, so these "
        "are the controller's own poses, computed from the joints (or simulated without noise). "
        "They contain nothing about the robot's errors; supply the readings of an instrument, or "
        "name their columns (--columns)"
    )
    OWN_MODEL = (
        "the calibration leaves {left}: no instrument is that accurate, so these are poses that a "
        "controller computed with its own parameters (or simulated without noise). The result is "
        "these parameters, not the robot's errors"
    )
    MANY_OUTLIERS = (
        "{count} of {rows} rows do not fit the others, so the calibration is rejected: {common}; "
        "find the cause before using the model. Lines {lines}"
    )
    STEP = (
        "from line {line} on {what} If so, make the rows before and after it two stations "
        "(column station)"
    )
    BETWEEN_VISITS = "{what}; the means of poses do not show it, and intervals do not include it"
    VISITS_APART = (
        "visits of the same pose differ by more than the means of poses about the model allow "
        "({test}): something changed between visits, such as a load, the direction of approach, or "
        "the set-up; measure in one set-up, or record it in a column"
    )
    VISITS_SCATTER = (
        "visits of the same pose differ by {scatter}, which is more than the declared noise of "
        "{declared} and drives that arrive within {arrival:g} mrad explain (p {p_value}): the "
        "robot repeats poorly, the target is loose, or the declared noise is too small"
    )
    NOISY_REPEATS = (
        "repeated readings within a stop differ by {scatter} and the declared noise is {declared} "
        "(p {p_value}): the declared noise is too small, or the arm was not yet at rest"
    )
    DEPENDENT_ROWS = (
        "the residuals depend on the order of the rows: {what}; rows were weighted accordingly; "
        "look for what changed during the measurement (the instrument's set-up, temperature, the "
        "clamping of robot and target), or for an effect that neighbouring poses share"
    )
    LEFT_IN_MOTION = (
        "the residuals follow the motion: {what}; rows were weighted accordingly; the model lacks "
        "an effect of the arm, which pincal discover can identify, or the instrument's set-up or a "
        "clock changed during the session"
    )
    UNLIKE_ITS_SCATTER = (
        "residuals of the {what} are {ratio:.2g} times the scatter within a tenth of a "
        "second: were the joints commanded "
        "instead of measured, was the IMU polled or its range too small, or is its filter too slow?"
    )
    BLOCKS = (
        "the errors of consecutive rows are correlated: standard deviations are {factor:.3g} times "
        "those of independent rows; look for what changed during the measurement, or for an effect "
        "that neighbouring poses share (pincal discover)"
    )
    SORTED = (
        "{joint} moved steadily along the rows, so drift with time can't be distinguished "
        "from effects of this joint; "
        "measure the poses in random order, or repeat some of them at the end"
    )
    GATHERED = (
        "{count} of the {rows} rows rejected as outliers cluster {where}: the robot has an error "
        "there that the model does not describe, or the instrument misread; lines {lines}"
    )
    BUMP = (
        "where {joint} is {low:.4g} to {high:.4g} {unit}, {count} rows share an error of "
        "{size:.3g} m{per} of this joint: its drive has a local error that the model does not "
        "describe; measure more poses there. Lines {lines}"
    )
    MOVED = (
        "{what} since the first station: a single value for all stations is wrong at each; "
        "calibrate each separately, or run pincal discover on all of them, which names what changed"
    )
    MISREAD = (
        "the residuals depend on the instrument's own axes ({effect}, p {p_value}): it "
        "misreads, or the robot has an equivalent error, and intervals do not include it; run "
        "pincal discover, or measure the same poses with the instrument elsewhere"
    )
    OUTLIERS = "{rejected} rejected as outliers and left out of the fit: lines {lines}"
    NOT_HELD_OUT = "no rows were held out, so the errors are those of the fit, not of prediction"
    NOT_LEFT_OUT = "not predicted by the model of the other stations: {why}"
    FAR_OFF = (
        "{count} of {rows} held-out rows are off by up to {largest:.3g} mm, the others by "
        "{mean:.4f} mm on average: wrong "
        "readings, or poses outside what the model covers; see lines {lines}"
    )
    LACK_OF_FIT = "lack of fit against replicates: {test}"
    NOISY_REPLICATES = (
        "replicates scatter as much as the residuals do ({test}): the declared noise is too small "
        "or the robot repeats poorly; the model is not at fault"
    )


UNUSABLE = frozenset({CaveatKind.IMPLAUSIBLE, CaveatKind.MANY_OUTLIERS, CaveatKind.MOUNT_MOVED})
"""What rejects a calibration, though it converged."""

DOUBTS = frozenset(CaveatKind) - {
    CaveatKind.SPARE_READINGS,
    CaveatKind.NARROWED,
    CaveatKind.ARRIVALS,
    CaveatKind.ROUNDED,
    CaveatKind.NOISE_OVERSTATED,
    CaveatKind.NO_INSTRUMENT,
    CaveatKind.MASSES_FOUND,
    CaveatKind.OWN_MODEL,
    CaveatKind.OUTLIERS,
    CaveatKind.NOT_HELD_OUT,
    CaveatKind.NOT_LEFT_OUT,
    CaveatKind.NOISY_REPLICATES,
}
"""What keeps the verdict from being "adequate": all but mere notes."""


@dataclass(frozen=True)
class Caveat:
    """One reservation; ``str()`` returns its message.

    Attributes:
        kind: what was found.
        figures: its figures by the names in the message; ``count`` and ``lines`` follow from the
            rows.
        station: name of the station concerned; "" for all of them.
        rows: lines of the rows concerned, if any.
    """

    kind: CaveatKind
    figures: dict[str, Any] = field(default_factory=dict)
    station: str = ""
    rows: tuple[int, ...] = ()

    def __str__(self) -> str:
        lines = ", ".join(map(str, self.rows[:_LISTED])) + " ..." * (len(self.rows) > _LISTED)
        figures: dict[str, Any] = {"count": len(self.rows), "lines": lines} | self.figures
        if "p_value" in figures:
            figures["p_value"] = show_chance(figures["p_value"])
        words = self.kind.value.format(**figures)
        return f"{self.station}: {words}" if self.station else words

    @property
    def note(self) -> Note:
        """Its message with its severity."""
        return Note(Severity.DOUBT if self.kind in DOUBTS else Severity.NOTE, str(self), self.rows)


@dataclass(frozen=True)
class Readings:
    """How much a fit rests on.

    Attributes:
        poses: number of distinct poses of the fitted rows.
        readings: number of readings; a repeated pose counts once, and a pose for at most six
            coordinates.
        degrees: readings beyond the parameters that they determine.
    """

    poses: int
    readings: int
    degrees: float

    @classmethod
    def of(cls, fit: ModelFit, replicates: Iterable[np.ndarray]) -> Readings:
        """Count the readings of a calibration; ``replicates`` are each station's pose numbers of
        the fitted rows.
        """
        readings = 0
        n_poses = 0
        for (station, places, _), numbers in zip(fit.stations, replicates, strict=True):
            distinct = len(np.unique(numbers))
            poses = min(len(np.unique(station.conditions.q, axis=0)), distinct)
            own = int(station.split(fit.solution.free[places])[1].sum())
            readings += min(distinct * station.reading_size, 6 * poses + own)
            n_poses += poses
        return cls(n_poses, readings, readings - float(fit.solution.effective))


def findings_on_data(fit: ModelFit, read: Readings) -> list[Caveat]:
    """Return whether the readings are few for the parameters, and whether they contradict given
    values.
    """
    found = [Caveat(CaveatKind.CONTRADICTED, {"what": what}) for what in doubts_of_known(fit)]
    released = int(fit.solution.free.sum())
    figures = {"poses": read.poses, "readings": read.readings, "parameters": released}
    if not is_informative(read.degrees):
        return [Caveat(CaveatKind.FEW_READINGS, figures | {"left": max(read.degrees, 0.0)}), *found]
    return (
        [Caveat(CaveatKind.SPARE_READINGS, figures), *found]
        if read.readings < 2 * released
        else found
    )


def findings_on_tools(fit: ModelFit) -> Iterator[Caveat]:
    """Yield the stations whose poses hardly turn the tool."""
    sigma = fit.estimate.sigma
    for name in fit.options.unturned:
        of_tool = [p.station == name and is_on_tool(p) for p in fit.problem.parameters]
        size = float(sigma[np.array(of_tool)].max())
        yield Caveat(CaveatKind.UNTURNED, {"sigma": format_small(size, "m")}, name)


def findings_on_moves(fit: ModelFit, moves: Sequence[Sequence[MovedParameter]]) -> Iterator[Caveat]:
    """Yield moves that the model's one value for all stations does not describe, of the moves at
    each station.
    """
    effects = (effect for station in fit.problem.stations for effect in station.model.effects)
    own = {
        p.name
        for e in effects
        if e.locus.station is not None
        for p in e.parameters(fit.problem.chain)
    }
    for station, here in zip(fit.problem.stations, moves, strict=False):
        least = CHANGES.matters * len(station) * station.reading_size
        some = [
            f"{move['name']} moved by {_rounded(move)}"
            for move in here
            if move["moved"]
            and move["name"] not in own
            and (move["change"] / move["sigma"]) ** 2 > least
        ]
        if some:
            yield Caveat(CaveatKind.MOVED, {"what": " and ".join(some)}, station.name)


def _rounded(move: MovedParameter) -> str:
    """Return how far a parameter moved, to the digits of its uncertainty, in words."""
    moved = Quantity(move["change"], move["unit"], move["sigma"])
    return f"{show_rounded(moved)} {show_unit(move['unit'])}"


def findings_on_fit(
    fit: ModelFit, p_value: float | None, arrivals: float | None = None
) -> list[Caveat]:
    """Return the findings of the fit itself.

    Args:
        fit: the fit.
        p_value: of chi-square against the declared noise; None without any.
        arrivals: to what all drives stop, if that explains what exceeds the declared noise [rad].
    """
    found = (
        []
        if fit.solution.converged
        else [Caveat(CaveatKind.NOT_CONVERGED, {"how": fit.solution.exit.value})]
    )
    if p_value is not None and p_value < MISFIT:
        ratio = float(np.sqrt(fit.solution.cost))
        if arrivals is None:
            found.append(Caveat(CaveatKind.NOISE_EXCEEDED, {"ratio": ratio, "p_value": p_value}))
        else:
            found.append(
                Caveat(CaveatKind.ARRIVALS, {"ratio": ratio, "size": format_small(arrivals, "rad")})
            )
    if p_value is not None and p_value > 1.0 - MISFIT:
        found.append(Caveat(CaveatKind.NOISE_OVERSTATED))
    if fit.solution.of_blocks > 1.0:
        found.append(Caveat(CaveatKind.BLOCKS, {"factor": float(np.sqrt(fit.solution.of_blocks))}))
    if (moments := found_moments(fit)) is not None:
        percent = 100.0 * moments.factor_sigma
        found.append(
            Caveat(
                CaveatKind.MASSES_FOUND,
                {
                    "links": counted(len(moments.links), "link"),
                    "mass": moments.mass,
                    "percent": percent,
                },
            )
        )
    return found


def findings_on_scatter(fit: ModelFit) -> Iterator[Caveat]:
    """Yield IMU readings whose residuals exceed their scatter by far."""
    for station, _, blocks in fit.stations:
        scatter = () if station.conditions.around is None else station.conditions.around.scatter
        for block, noise, expected in zip(
            station.sensor.blocks, fit.solution.estimated[blocks], scatter, strict=False
        ):
            # A filter in the sensor reduces the scatter; the residuals are then still those of any
            # IMU.
            if noise > max(DOUBTED.unlike * expected, DOUBTED.usual * block.noise):
                figures = {"what": block.name.replace("_", " "), "ratio": noise / expected}
                yield Caveat(CaveatKind.UNLIKE_ITS_SCATTER, figures, station.name)


def findings_on_rounding(fit: ModelFit) -> Iterator[Caveat]:
    """Yield the stations whose joints are written in coarse steps that explain what rows are
    off.
    """
    for station, places, _ in fit.stations:
        rounded = RoundedJoints.of(station, fit.values[places])
        if rounded is None:
            continue
        if station.arrival is not None and not shares_stops(station):
            how = "this counts as noise of the rows, beside the declared one"
        elif rounded.explains() and not fit.is_declared:
            off = f"{rounded.off * 1e3:.2g} mm"
            how = f"no noise is declared, and what is estimated from the rows, off by {off}, has it"
        else:
            continue
        yield Caveat(CaveatKind.ROUNDED, {"what": rounded.words, "how": how}, station.name)


def findings_on_order(station: Station) -> list[Caveat]:
    """Return whether the noise of a station's rows depends on their order, and whether a joint
    moved in that order.
    """
    found = []
    serial = station.serial
    n = len(station)
    # The windows of an IMU overlap by design.
    if serial is not None and station.sensor.reads_place:
        rows = 1.0 / (1.0 - float(np.max(serial.phi)))
        lasts = f"for about {rows:.0f} rows" if rows < n else "over all rows"
        error = "an error" if serial.turns is None else "an error of the target's place on the tool"
        what = (
            f"{100 * np.max(serial.share):.0f} % of their variance is {error} that persists {lasts}"
        )
        is_in_motion = station.conditions.are_in_motion
        kind = CaveatKind.LEFT_IN_MOTION if is_in_motion else CaveatKind.DEPENDENT_ROWS
        found.append(Caveat(kind, {"what": what}, station.name))
    if station.position is not None and n >= DOUBTED.rows:
        steady = _steadiness(station)
        if steady.max() > DOUBTED.steady:
            joint = station.model.chain.robot.joint_names[int(np.argmax(steady))]
            found.append(Caveat(CaveatKind.SORTED, {"joint": joint}, station.name))
    return found


def _steadiness(station: Station) -> np.ndarray:
    """Return the rank correlation of each joint with the order of the rows, shape (n,)."""
    payload = station.conditions.payload
    # Blocks of different loads are judged separately: what differs between them may be elastic.
    loads = (payload == load for load in np.unique(payload))
    parts = [station.select(rows) for rows in loads if rows.sum() >= DOUBTED.rows] or [station]
    steady = np.full(station.conditions.q.shape[1], np.inf)
    for q, position in ((part.conditions.q, part.position) for part in parts):
        rank = np.argsort(np.argsort([*q.T, position], axis=1), axis=1)
        correlation = np.abs(np.atleast_2d(np.corrcoef(rank))[-1, :-1])
        steady = np.minimum(steady, np.where(np.ptp(q, axis=0) > 0.0, correlation, 0.0))
    return steady


def findings_on_plausibility(fit: ModelFit, tables: Iterable[Measurements]) -> list[Caveat]:
    """Return the stations at which the residuals are larger or smaller than those of any real arm,
    behind given lengths that may be the reason.
    """
    tables = list(tables)
    named = {s.name: table for s, table in zip(fit.problem.stations, tables, strict=True)}
    lengths = [
        Caveat(CaveatKind.WRONG_LENGTH, found.figures) for found in contradicted_lengths(fit, named)
    ]
    kinds = (CaveatKind.OWN_MODEL, CaveatKind.OWN_POSE)
    own = [
        Caveat(kinds[is_nominal], {"left": left}, name) for name, is_nominal, left in computed(fit)
    ]
    too_large = [
        Caveat(CaveatKind.IMPLAUSIBLE, {"how": how}, name) for name, how in implausible(fit, tables)
    ]
    return [*lengths, *too_large, *own]


def findings_on_outliers(
    station: Station,
    values: np.ndarray,
    free: np.ndarray,
    *,
    table: Measurements,
    rejected: np.ndarray,
    lines: Sequence[int] | None = None,
) -> list[Caveat]:
    """Return which of a station's fitted rows were rejected, and where the instrument was moved
    between rows.

    Its parameters have values, shape (P,), and ``free``, shape (P,), were fitted; ``rejected``,
    shape (N,), is a mask, and ``lines`` are those of all rejected readings as measured; default: of
    the rejected rows.
    """

    def about(kind: CaveatKind, some: np.ndarray, **figures: Any) -> Caveat:
        return Caveat(kind, figures, station.name, tuple(table.rows[some].tolist()))

    left_out = table.rows[rejected].tolist() if lines is None else lines
    said = {"rejected": counted(len(left_out), "row")}
    found = [Caveat(CaveatKind.OUTLIERS, said, station.name, tuple(left_out))] if left_out else []
    if rejected.mean() >= DOUBTED.many:
        common = in_common(station, values, table, rejected) or "no common cause was found"
        found = [about(CaveatKind.MANY_OUTLIERS, rejected, rows=len(table), common=common)]
    elif (gathered := gathering_of(station, rejected)) is not None:
        where = _where(gathered, _unit_of(station, gathered))
        count = int(rejected.sum())
        found.append(about(CaveatKind.GATHERED, gathered.rows, rows=count, where=where))
    if (bump := bump_in(station, values)) is not None:
        assert bump.size is not None
        per = _unit_of(station, bump)
        found.append(
            about(
                CaveatKind.BUMP, bump.rows, size=1e3 * abs(bump.size), per=per, **_span(bump, per)
            )
        )
    if change := change_in(station, values, free, table.rows):
        figures = {"line": change.line, "what": change}
        found.append(Caveat(CaveatKind.STEP, figures, station.name, (change.line,)))
    return found


def _where(gathered: Gathering, unit: str) -> str:
    """Return where rejected rows lie, in words; ``unit`` is of the joint, empty if it is none."""
    if not unit:
        return "in one stretch of the table"
    low, high = ((np.degrees(x) if unit == "rad" else x) for x in (gathered.low, gathered.high))
    shown = "deg" if unit == "rad" else unit
    return f"where {gathered.variable} is {low:.4g} to {high:.4g} {shown}"


def _span(bump: Gathering, unit: str) -> dict[str, Any]:
    """Return the figures of the joint and the range in which its drive has a bump."""
    turns = unit == "rad"
    low, high = ((float(np.degrees(x)) if turns else 1e3 * x) for x in (bump.low, bump.high))
    return {"joint": bump.variable, "low": low, "high": high, "unit": "deg" if turns else "mm"}


def _unit_of(station: Station, gathered: Gathering) -> str:
    """Return the unit of the joint along which outliers cluster; empty for another variable."""
    robot = station.model.chain.robot
    return dict(zip(robot.joint_names, robot.joint_units, strict=True)).get(gathered.variable, "")


def findings_on_held_out(
    test: Station | None, values: np.ndarray, table: Measurements
) -> list[Caveat]:
    """Return whether some held-out rows of a station have errors far beyond all others, which
    dominate a mean.
    """
    if test is None:
        return []
    return far_off(next(iter(pose_error_sizes(test, values).values())), table, test.name)


def far_off(errors: np.ndarray, table: Measurements, station: str) -> list[Caveat]:
    """Return whether some rows, not used by the fit that predicts them, have errors far beyond all
    others.

    Args:
        errors: shape (N,), their magnitudes [mm].
        table: the rows.
        station: their station.
    """
    far = errors > DOUBTED.far * np.median(errors)
    if not far.any():
        return []
    figures = {
        "rows": len(errors),
        "largest": float(errors.max()),
        "mean": float(errors[~far].mean()),
    }
    return [Caveat(CaveatKind.FAR_OFF, figures, station, tuple(table.rows[far].tolist()))]


def findings_on_replicates(lack: LackOfFit | None, p_value: float | None) -> list[Caveat]:
    """Return what replicates show of model and noise; ``p_value`` as for
    :func:`findings_on_fit`.
    """
    if lack is not None and lack.is_significant:
        return [Caveat(CaveatKind.LACK_OF_FIT, {"test": lack})]
    is_noisy = lack is not None and p_value is not None and p_value < MISFIT
    return [Caveat(CaveatKind.NOISY_REPLICATES, {"test": lack})] if is_noisy else []
