"""The result of a calibration: parameters with uncertainty, status and reason; errors before and
after; reservations.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from msgspec import UNSET, UnsetType, to_builtins
from scipy.special import chdtrc

from pincal.calibration.assessed_station import AssessedStation, noise_of
from pincal.calibration.benefit import findings_on_benefit
from pincal.calibration.calibration_numbers import DOUBTED
from pincal.calibration.caveats import (
    DOUBTS,
    UNUSABLE,
    Caveat,
    CaveatKind,
    Readings,
    findings_on_data,
    findings_on_fit,
    findings_on_moves,
    findings_on_plausibility,
    findings_on_rounding,
    findings_on_scatter,
    findings_on_tools,
)
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.held_out import (
    LeftOut,
    StationRows,
    Validated,
    errors_held_out,
    headline_of,
)
from pincal.calibration.improvement import (
    angle_gain,
    findings_without_instrument,
    improvements,
)
from pincal.calibration.moves import moves_of
from pincal.calibration.result_tables import ParameterRecord, ParameterRow, parameter_rows
from pincal.calibration.unmodelled import instruments_error
from pincal.calibration.visit_findings import joined_with_means
from pincal.identify.explain import Cause
from pincal.identify.fit import ModelFit, Solution
from pincal.identify.prior_scale import has_instrument
from pincal.notes import Note, doubts_first, doubts_of
from pincal.recorded import Moving
from pincal.thresholds import Count
from pincal.validate.accuracy import error_statistics
from pincal.validate.lack_of_fit import LackOfFit
from pincal.validate.misfit import NoiseTest, Verdict, is_informative, judge
from pincal.validate.outcome import (
    ClockRecord,
    ClockStep,
    Correlation,
    Errors,
    Improvement,
    MovedParameter,
    Outcome,
    RowCounts,
    ValidationWay,
)
from pincal.validate.pose_characteristics import error_intervals

# Pairs listed at most, the strongest first.
_MOST_CORRELATIONS: Count = 20
# What of a result is for its summary alone; the file has it in its warnings.
_NOT_WRITTEN = ("doubt", "shift", "doubted", "arrivals")


@dataclass(frozen=True, kw_only=True)
class _Grounds:
    """What a verdict rests on.

    Attributes:
        lacks: for each station the residuals against the scatter of visits, if it has any.
        p_value: chance of larger residuals by the declared noise; None where it was estimated.
        reduced: sum of squares per degree of freedom.
        arrivals: as of :class:`Result`.
        doubts: the warnings that keep it from being "adequate".
        is_usable: whether the fit converged and nothing rejects it.
        degrees: readings of distinct poses beyond the parameters that they determine.
    """

    lacks: Sequence[LackOfFit | None]
    p_value: float | None
    reduced: float
    arrivals: float | None
    doubts: tuple[Note, ...]
    is_usable: bool
    degrees: float

    @property
    def noise_test(self) -> NoiseTest | None:
        """As of :class:`Result`."""
        known = [
            test
            for lack in self.lacks
            if lack is not None and (test := lack.noise_test) is not None
        ]
        if known and len(known) == len(self.lacks):
            return min(known, key=lambda test: test.p_value)
        if self.p_value is None or self.arrivals is not None:
            return None
        return NoiseTest("the declared noise of the instrument", self.reduced**0.5, self.p_value)

    def verdict(self, *, incomplete: bool) -> Verdict:
        """Return the verdict; ``incomplete`` as of :meth:`Result.verdict_of`."""
        few = not is_informative(self.degrees)
        return judge(
            self.noise_test,
            self.doubts,
            unusable=not self.is_usable,
            incomplete=incomplete,
            few=few,
        )


@dataclass(frozen=True, kw_only=True)
class Result(Outcome):
    """The contents of ``result.json``, as one object."""

    parameters: tuple[ParameterRow, ...]
    doubt: str = ""
    """Why the calibration is rejected though the fit converged; empty if it is not."""
    shift: str = ""
    """Where readings shift from some line on, as if of two set-ups; empty if they do not."""
    doubted: tuple[CaveatKind, ...] = ()
    """What the findings among the doubts are of, in their order."""
    arrivals: float | None = None
    """To what all drives stop, if that explains what exceeds the declared noise of the instrument
    [rad].
    """

    @property
    def doubts(self) -> tuple[Note, ...]:
        """The warnings that keep the verdict from being "adequate"."""
        return doubts_of(self.warnings)

    @property
    def is_kept(self) -> bool:
        """Whether the robot stays as in its URDF because the readings do not improve it."""
        return any(row.reason.cause is Cause.NOT_IMPROVED for row in self.parameters)

    @property
    def noise_test(self) -> NoiseTest | None:
        """The residuals against a noise that is known without the model; None if there is none.

        Where poses were repeated it is their scatter, which includes the robot's repeatability. A
        declared noise of the instrument is none where the drives scatter more than it.
        """
        return self._grounds.noise_test

    @property
    def _grounds(self) -> _Grounds:
        """What its verdict rests on."""
        lacks = (
            [self.lack_of_fit]
            if self.stations is UNSET
            else [record.get("lack_of_fit") for record in self.stations]
        )
        return _Grounds(
            lacks=lacks,
            p_value=self.chi2_p_value,
            reduced=self.chi2_reduced,
            arrivals=self.arrivals,
            doubts=self.doubts,
            is_usable=self.converged and not self.doubt,
            degrees=self.degrees,
        )

    def verdict_of(self, *, incomplete: bool = False) -> Verdict:
        """Return whether the model explains the data; ``incomplete`` is the finding of a search
        that it does not.
        """
        return self._grounds.verdict(incomplete=incomplete)

    @property
    def left_out_mm(self) -> tuple[float, float] | None:
        """Mean error of stations by the model of the others [mm], and by their geometric model;
        None without any.
        """
        every = (
            []
            if self.stations is UNSET
            else [record for record in self.stations if "left_out" in record]
        )
        records = [record for record in every if "mean_mm" in record["left_out"]]
        if not records:
            return None
        rows = [record["rows"]["train"] for record in records]
        found = (
            [record[name]["mean_mm"] for record in records]
            for name in ("left_out", "left_out_geometric")
        )
        calibrated, geometric = (float(np.average(means, weights=rows)) for means in found)
        return calibrated, geometric

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of ``result.json``."""
        perhaps = (
            "iso9283",
            "lack_of_fit",
            "stations",
            "improvement",
            "angle_gain",
            "clocks",
            "validation",
            "repeatability",
            "elsewhere",
            "intervals",
            "id",
            "uncertainty",
        )
        absent = {name for name in perhaps if getattr(self, name) in (None, UNSET)}
        contents = {
            name: value
            for name, value in asdict(self).items()
            if name not in {*absent, *_NOT_WRITTEN}
        }
        contents |= {
            "parameters": [row.to_dict() for row in self.parameters],
            "warnings": to_builtins(self.warnings),
        }
        if self.id is not UNSET:
            contents["id"] = to_builtins(self.id)
        return contents | {"verdict": self.verdict_of().value}


@dataclass(frozen=True, kw_only=True)
class ResultFile(Outcome):
    """The whole of ``result.json``.

    Attributes:
        parameters: every parameter, those that were not identified with the reason.
        verdict: whether the residuals are explained by the noise; not in files of version 0.1.0.
    """

    parameters: tuple[ParameterRecord, ...]
    warnings: tuple[Note | str, ...]  # type: ignore[assignment]
    verdict: Verdict = Verdict.NOT_JUDGED


@dataclass(frozen=True, eq=False)
class _Assessed:
    """A calibration with its stations assessed.

    Attributes:
        fit: the fit of all stations.
        stations: what was assessed at each.
        is_left_out: whether stations were predicted by models of the others.
    """

    fit: ModelFit
    stations: Sequence[AssessedStation]
    is_left_out: bool

    @property
    def p_value(self) -> float | None:
        """Chance of larger residuals by the declared noise; None where it was estimated."""
        solution = self.fit.solution
        return float(chdtrc(solution.degrees, solution.chi2)) if self.fit.is_declared else None

    @cached_property
    def read(self) -> Readings:
        """What was read, of distinct poses."""
        return Readings.of(self.fit, [station.poses[0] for station in self.stations])

    @cached_property
    def improved(self) -> tuple[Improvement, ...]:
        """Improvement of predictions; empty with an instrument, which measures it."""
        return () if has_instrument(self.fit) else improvements(self.fit)

    @cached_property
    def moves(self) -> tuple[tuple[MovedParameter, ...], ...]:
        """Parameters that differ between stations; empty of one station."""
        return moves_of(self.fit) if len(self.stations) > 1 else ()

    def findings(self, arrivals: float | None) -> list[Caveat]:
        """Return the findings, without those that others explain."""
        fit = self.fit
        stations = self.stations
        found = [
            *findings_on_plausibility(fit, [station.rows.train for station in stations]),
            *findings_on_benefit(fit),
            *findings_on_fit(fit, self.p_value, arrivals),
            *findings_on_tools(fit),
            *findings_on_scatter(fit),
            *findings_on_rounding(fit),
            *findings_on_data(fit, self.read),
            *findings_without_instrument(fit, self.improved),
            *_on_rows(stations, is_left_out=self.is_left_out),
            *(one for station in stations for one in station.on_replicates(self.p_value)),
            *(one for station in stations for one in station.on_visits()),
            *findings_on_moves(fit, self.moves),
        ]
        found = joined_with_means(found)
        found += _on_misreading(stations, found)
        return _without_explained(found, len(stations))


def _to_assess(
    fit: ModelFit,
    rows: Sequence[StationRows],
    left_out: Sequence[LeftOut],
    validated: Validated | None,
) -> list[AssessedStation]:
    """Return the stations; ``left_out`` are their errors by models of the others, if there are."""
    apart = left_out or [LeftOut(part.name) for part in rows]
    parts = enumerate(zip(rows, apart, strict=True))
    return [AssessedStation(fit, k, part, validated, away) for k, (part, away) in parts]


def _solved(solution: Solution) -> dict[str, Any]:
    """Return what the solution says of the equations."""
    return {
        "rank": solution.posterior.identifiable_rank,
        "condition": solution.posterior.condition,
        "chi2_reduced": solution.cost,
        "converged": solution.converged,
    }


def result_of(
    fit: ModelFit,
    rows: Sequence[StationRows],
    *,
    seconds: float,
    notes: Sequence[Note] = (),
    left_out: Sequence[LeftOut] = (),
    validated: Validated | None = None,
    arrivals: float | None = None,
) -> Result:
    """Assemble the result of a calibration that took some seconds, with the rows of each station.

    Notes on robot and data are listed before others of their severity. Errors by cross-validation
    are ``validated``; if stations were predicted by models of the others, ``left_out``, these are
    the held-out errors. ``arrivals`` is to what all drives stop, if a search has shown that this
    explains what exceeds the declared noise [rad].
    """
    stations = _to_assess(fit, rows, left_out, validated)
    assessed = _Assessed(fit, stations, is_left_out=bool(left_out))
    found = assessed.findings(arrivals)
    error = _errors(stations)
    parameters = parameter_rows(fit)
    return Result(
        noise=noise_of(fit),
        rows=_counts(stations),
        parameters=parameters,
        chi2_p_value=assessed.p_value,
        iterations=fit.iterations,
        seconds=seconds,
        **_solved(fit.solution),
        outliers=tuple(line for station in stations for line in station.outliers),
        correlations=_correlations(fit, parameters),
        stages=fit.stages,
        error=error,
        warnings=doubts_first([*notes, *(n.note for n in found)]),
        degrees=assessed.read.degrees,
        doubt=next((str(n) for n in found if n.kind in UNUSABLE), ""),
        arrivals=arrivals,
        shift=next((str(n) for n in found if n.kind is CaveatKind.STEP), ""),
        doubted=tuple(n.kind for n in found if n.kind in DOUBTS),
        validation=_validation(validated, error),
        improvement=assessed.improved or UNSET,
        angle_gain=angle_gain(fit) or UNSET,
        clocks=tuple(_clocks(fit, rows)) or UNSET,
        intervals=_intervals(stations) or UNSET,
        **_by_station(stations, assessed.moves),
    )


def verdict_on(
    fit: ModelFit,
    rows: Sequence[StationRows],
    *,
    incomplete: bool,
    notes: Sequence[Note] = (),
    left_out: Sequence[LeftOut] = (),
    validated: Validated | None = None,
    arrivals: float | None = None,
) -> Verdict:
    """Return the verdict on a calibration, as of :meth:`Result.verdict_of` of what
    :func:`result_of` returns, whose arguments these are; its parameters are not explained for it.
    """
    stations = _to_assess(fit, rows, left_out, validated)
    assessed = _Assessed(fit, stations, is_left_out=bool(left_out))
    found = assessed.findings(arrivals)
    solved = _solved(fit.solution)
    grounds = _Grounds(
        lacks=[station.lack_of_fit for station in stations],
        p_value=assessed.p_value,
        reduced=solved["chi2_reduced"],
        arrivals=arrivals,
        doubts=doubts_of([*notes, *(n.note for n in found)]),
        is_usable=solved["converged"] and not any(n.kind in UNUSABLE for n in found),
        degrees=assessed.read.degrees,
    )
    return grounds.verdict(incomplete=incomplete)


def _on_rows(stations: Sequence[AssessedStation], *, is_left_out: bool) -> Iterator[Caveat]:
    """Yield the findings on the fitted rows of each station, then on rows that were not fitted."""
    for station in stations:
        yield from station.on_fitted_rows()
    has_unseen = any(station.validated or station.held for station in stations)
    if not is_left_out and not has_unseen:
        yield Caveat(CaveatKind.NOT_HELD_OUT)
    for one in (station.left_out for station in stations):
        if one.obstacle:
            yield Caveat(CaveatKind.NOT_LEFT_OUT, {"why": one.obstacle}, one.station)
    for station in stations:
        yield from station.on_held_out_rows()
    for station in stations:
        yield from station.on_unseen_poses()


def _on_misreading(
    stations: Sequence[AssessedStation], found: Sequence[Caveat]
) -> Iterator[Caveat]:
    """Yield that the residuals depend on the instrument's axes, where nothing else is doubted that
    would explain them.
    """
    fit = stations[0].fit
    is_judged = fit.is_declared or any(station.lack_of_fit for station in stations)
    if not is_judged or any(one.kind in DOUBTS for one in found):
        return
    if (misread := instruments_error(fit)) is not None:
        at, effect, chance = misread
        yield Caveat(CaveatKind.MISREAD, {"effect": effect, "p_value": chance}, at)


def _without_explained(found: Sequence[Caveat], n_stations: int) -> list[Caveat]:
    """Return the findings without those that another one explains, a change midway first."""
    kept = list(found)
    noisy = {one.station for one in kept if one.kind is CaveatKind.NOISY_REPLICATES}
    if len(noisy) == n_stations and not any(one.kind is CaveatKind.LACK_OF_FIT for one in kept):
        # The scatter between replicates, already reported, is what exceeds the declared noise.
        kept = [one for one in kept if one.kind is not CaveatKind.NOISE_EXCEEDED]
    # What changed between visits is what makes them differ.
    changed = {
        one.station
        for one in kept
        if one.kind is CaveatKind.BETWEEN_VISITS or "lines" in one.figures
    }
    kept = [
        one
        for one in kept
        if one.kind is not CaveatKind.NOISY_REPLICATES or one.station not in changed
    ]
    # A change midway explains the other findings, so it precedes them and replaces "not this
    # robot".
    stepped = {one.station for one in kept if one.kind is CaveatKind.STEP}
    kept = [
        one for one in kept if one.kind is not CaveatKind.IMPLAUSIBLE or one.station not in stepped
    ]
    # Then what rejects the calibration, which its verdict refers to.
    return sorted(kept, key=lambda one: (one.kind is not CaveatKind.STEP, one.kind not in UNUSABLE))


def _counts(stations: Sequence[AssessedStation]) -> RowCounts:
    """Return the numbers of readings that were fitted, and that were predicted without them."""
    fitted, held = (
        sum(len(station.rows.measured[part]) for station in stations) for part in (0, 1)
    )
    if (validated := stations[0].validated) is not None:
        held = validated.rows
    alone = [station for station in stations if station.left_out.sizes]
    if alone:
        held = sum(len(station.fitted) for station in alone)
    return {"train": fitted, "test": held}


def _by_station(
    stations: Sequence[AssessedStation], moves: Sequence[Sequence[MovedParameter]]
) -> dict[str, Any]:
    """Return the replicates of a single station, or the records of several."""
    if len(stations) > 1:
        robots = FittedRobot.of(stations[0].fit).each
        pairs = zip(stations, moves, strict=True)
        return {"stations": tuple(station.record(robots, own) for station, own in pairs)}
    (only,) = stations
    return {
        "iso9283": only.iso9283,
        "lack_of_fit": only.lack_of_fit,
        "repeatability": only.repeatability or UNSET,
    }


def _validation(validated: Validated | None, error: Errors) -> ValidationWay | UnsetType:
    """Return how the errors at rows that were not fitted are stated; unset without any."""
    if "test" not in error["calibrated"]:
        return UNSET
    if validated is None:
        return ValidationWay("held out", 0)
    return ValidationWay(validated.headline, validated.folds.count(validated.headline))


def _errors(stations: Sequence[AssessedStation]) -> Errors:
    """Return the errors of all stations together, by model and part; "test" of every model is the
    way in which the calibrated one predicts worse.
    """
    fit = stations[0].fit
    validated = stations[0].validated
    alone = [station.left_out for station in stations if station.left_out.sizes]
    found: Errors = {}
    for model, solution in (("nominal", fit.nominal), ("calibrated", fit.solution)):
        fitted = [station.fitted_errors(model) for station in stations]
        sizes, shares = zip(*fitted, strict=True)
        unseen = (
            errors_held_out(fit, solution, [station.rows for station in stations])
            if validated is None
            else validated.errors(model)
        )
        found[model] = {"train": error_statistics(sizes, shares=shares)} | unseen
    lead = headline_of(found["calibrated"])
    for model, of_model in found.items():
        if lead in of_model:
            of_model["test"] = of_model[lead]
        if alone:
            of_model["test"] = error_statistics(one.sizes[model] for one in alone)
    return found


def _intervals(stations: Sequence[AssessedStation]) -> dict[str, Any]:
    """Return the intervals of the errors of the calibrated model that are "test"; empty if there
    are none.
    """
    parts = [part for station in stations if (part := station.unseen) is not None]
    units = dict.fromkeys(unit for part in parts for unit in part.sizes)
    found = dict[str, Any]()
    for unit in units:
        of_unit = [part for part in parts if unit in part.sizes]
        found |= error_intervals(
            {unit: np.concatenate([part.sizes[unit] for part in of_unit])},
            independent=sum(part.poses for part in of_unit),
            shares=np.concatenate([part.shares for part in of_unit]),
        )
    return found


def _clocks(fit: ModelFit, rows: Sequence[StationRows]) -> Iterator[ClockRecord]:
    """Yield the clocks of the stations in motion: alignment plus fitted correction."""
    values = dict(
        zip(fit.estimate.names, zip(fit.values, fit.estimate.sigma, strict=True), strict=True)
    )
    for part, station in zip(rows, fit.problem.stations, strict=True):
        if (moving := part.measured[0].moving) is None:
            continue
        mark = f"{station.name}/" if station.name else ""
        (offset, offset_sigma), (drift, drift_sigma) = (
            values[f"{mark}clock.{name}"] for name in ("offset", "drift")
        )
        late, sigma = values.get(f"{mark}imu.gyro_delay", (None, None))
        yield ClockRecord(
            part.name,
            *(moving.clock[0] + float(offset), float(offset_sigma)),
            *(1e6 * (moving.clock[1] + float(drift)), 1e6 * float(drift_sigma)),
            moving.middle,
            *(
                None if late is None else moving.delay + float(late),
                None if sigma is None else float(sigma),
            ),
            _steps(moving, values, mark),
        )


def _steps(
    moving: Moving, values: Mapping[str, tuple[float, float]], mark: str
) -> tuple[ClockStep, ...]:
    """Return the steps of a clock: as laid out plus fitted correction; ``values`` are those of
    parameters with their standard deviations, ``mark`` begins the names of a station's.
    """
    found = list[ClockStep]()
    for number, (at, size) in enumerate(moving.steps, 1):
        more, sigma = values[f"{mark}clock.step_{number}"]
        found.append(ClockStep(at, size + float(more), float(sigma)))
    return tuple(found)


def _correlations(fit: ModelFit, rows: tuple[ParameterRow, ...]) -> tuple[Correlation, ...]:
    """Return the strongest correlations between identified parameters other than those of base and
    tool.
    """
    C = fit.solution.known.covariance
    sd = np.sqrt(np.diag(C))
    correlation = C / np.outer(sd, sd)
    shared = fit.solution.free & fit.problem.is_shared
    parameters = [
        p for p, is_shared in zip(fit.problem.parameters, shared, strict=True) if is_shared
    ]
    identified = {row.name for row in rows if row.status == "identified"}
    inner = np.array([not p.is_extrinsic and p.name in identified for p in parameters], bool)
    pairs = [
        (float(correlation[i, j]), parameters[i].name, parameters[j].name)
        for i, j in zip(
            *np.nonzero(
                np.triu(np.abs(correlation) > DOUBTED.correlated, 1) & np.outer(inner, inner)
            ),
            strict=True,
        )
    ]
    pairs.sort(key=lambda pair: -abs(pair[0]))
    return tuple({"parameters": [a, b], "correlation": r} for r, a, b in pairs[:_MOST_CORRELATIONS])
