"""The result of a calibration: parameters with uncertainty, status and reason; errors before and
after; reservations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from msgspec import UNSET, UnsetType, to_builtins
from scipy.special import chdtrc

from pincal.calibration.benefit import findings_on_benefit
from pincal.calibration.caveats import (
    DOUBTS,
    UNUSABLE,
    Caveat,
    CaveatKind,
    Readings,
    far_off,
    findings_on_data,
    findings_on_fit,
    findings_on_held_out,
    findings_on_moves,
    findings_on_order,
    findings_on_outliers,
    findings_on_plausibility,
    findings_on_replicates,
    findings_on_scatter,
)
from pincal.calibration.elsewhere import elsewhere_of
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.held_out import (
    LeftOut,
    StationRows,
    Validated,
    errors_held_out,
    headline_of,
)
from pincal.calibration.improvement import findings_without_instrument, improvements
from pincal.calibration.moves import moves_of
from pincal.calibration.placing import moved
from pincal.calibration.result_tables import ParameterRecord, ParameterRow, parameter_rows
from pincal.calibration.station_information import spent_at
from pincal.calibration.unmodelled import instruments_error
from pincal.calibration.visit_findings import by_visit, findings_on_visits, joined_with_means
from pincal.identify.beliefs import declared_noise
from pincal.identify.explain import Cause
from pincal.identify.fit import ModelFit
from pincal.identify.prior_scale import has_instrument
from pincal.identify.station import Station
from pincal.identify.visit_weights import ScatterByLevel, scatter_by_level
from pincal.measure.poses import SCATTER, replicate_groups
from pincal.measure.stops import plan_of
from pincal.notes import Note, doubts_first, doubts_of
from pincal.validate.accuracy import (
    Replicates,
    error_statistics,
    error_summary,
    iso9283,
    pose_error_sizes,
)
from pincal.validate.lack_of_fit import LackOfFit, lack_of_fit
from pincal.validate.misfit import NoiseTest, Verdict, is_informative, judge
from pincal.validate.outcome import (
    ClockRecord,
    Correlation,
    Errors,
    MovedParameter,
    NoiseRecord,
    Outcome,
    StationRecord,
    ValidationWay,
    noise_key,
)

# Absolute correlation above which a pair is listed: the two parameters share four fifths of their
# variance.
_CORRELATED = 0.9
# Pairs listed at most, the strongest first.
_MOST_CORRELATIONS = 20


@dataclass(frozen=True, kw_only=True)
class Result(Outcome):
    """The contents of ``result.json``, as one object."""

    parameters: tuple[ParameterRow, ...]
    doubt: str = ""
    """Why the calibration is rejected though the fit converged; empty if it is not."""
    shift: str = ""
    """Where readings shift from some line on, as if of two set-ups; empty if they do not."""
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
        lacks = (
            [self.lack_of_fit]
            if self.stations is UNSET
            else [record.get("lack_of_fit") for record in self.stations]
        )
        known = [
            test for lack in lacks if lack is not None and (test := lack.noise_test) is not None
        ]
        if known and len(known) == len(lacks):
            return min(known, key=lambda test: test.p_value)
        if self.chi2_p_value is None or self.arrivals is not None:
            return None
        return NoiseTest(
            "the declared noise of the instrument", self.chi2_reduced**0.5, self.chi2_p_value
        )

    def verdict_of(self, *, incomplete: bool = False) -> Verdict:
        """Return whether the model explains the data; ``incomplete`` is the finding of a search
        that it does not.
        """
        unusable = bool(self.doubt) or not self.converged
        few = not is_informative(self.degrees)
        return judge(
            self.noise_test, self.doubts, unusable=unusable, incomplete=incomplete, few=few
        )

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
            "clocks",
            "validation",
            "repeatability",
            "elsewhere",
        )
        absent = {name for name in perhaps if getattr(self, name) in (None, UNSET)}
        contents = {
            name: value
            for name, value in asdict(self).items()
            if name not in {*absent, "doubt", "shift", "arrivals"}
        }
        contents |= {
            "parameters": [row.to_dict() for row in self.parameters],
            "warnings": to_builtins(self.warnings),
        }
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
    solution = fit.solution
    parameters = parameter_rows(fit)
    p_value = float(chdtrc(solution.degrees, solution.chi2)) if fit.is_declared else None
    seen = [_Seen.of(fit, k, part) for k, part in enumerate(rows)]
    again = [_replicates(fit, k, part, validated) for k, part in enumerate(seen)]
    iso, lack = again[0] if len(seen) == 1 else (None, None)
    scatter = [_repeatability(fit, k, part) for k, part in enumerate(seen)]
    on_replicates = [
        replace(found, station=part.rows.name)
        for part, (_, lack) in zip(seen, again, strict=True)
        for found in findings_on_replicates(lack, p_value)
    ]
    on_visits = [
        found
        for k, (part, (_, lack)) in enumerate(zip(seen, again, strict=True))
        for found in findings_on_visits(fit, k, part.rows, lack)
    ]
    read = Readings.of(fit, [part.poses[0] for part in seen])
    improved = () if has_instrument(fit) else improvements(fit)
    moves = moves_of(fit) if len(seen) > 1 else ()
    found = [
        *findings_on_plausibility(fit, [part.train for part in rows]),
        *findings_on_benefit(fit),
        *findings_on_fit(fit, p_value, arrivals),
        *findings_on_scatter(fit),
        *findings_on_data(fit, read),
        *findings_without_instrument(fit, improved),
        *_on_rows(seen, left_out, validated),
        *on_replicates,
        *on_visits,
        *findings_on_moves(fit, moves),
    ]
    found = joined_with_means(found)
    is_judged = fit.is_declared or any(lack is not None for _, lack in again)
    if (
        is_judged
        and not any(n.kind in DOUBTS for n in found)
        and (misread := instruments_error(fit)) is not None
    ):
        station, effect, chance = misread
        found.append(Caveat(CaveatKind.MISREAD, {"effect": effect, "p_value": chance}, station))
    if len(on_replicates) == len(seen) and all(
        n.kind is CaveatKind.NOISY_REPLICATES for n in on_replicates
    ):
        # The scatter between replicates, already reported, is what exceeds the declared noise.
        found = [n for n in found if n.kind is not CaveatKind.NOISE_EXCEEDED]
    # What changed between visits is what makes them differ.
    changed = {
        n.station for n in found if n.kind is CaveatKind.BETWEEN_VISITS or "lines" in n.figures
    }
    found = [
        n for n in found if n.kind is not CaveatKind.NOISY_REPLICATES or n.station not in changed
    ]
    # A change midway explains the other findings, so it precedes them and replaces "not this
    # robot".
    stepped = {n.station for n in found if n.kind is CaveatKind.STEP}
    found = [n for n in found if n.kind is not CaveatKind.IMPLAUSIBLE or n.station not in stepped]
    found.sort(key=lambda n: n.kind is not CaveatKind.STEP)
    fitted, held = (sum(len(part.rows.measured[k]) for part in seen) for k in (0, 1))
    error = _errors(fit, seen, validated)
    if validated is not None:
        held = validated.rows
    alone = [one for one in left_out if one.sizes]
    if alone:
        for model, by_part in error.items():
            by_part["test"] = error_statistics(one.sizes[model] for one in alone)
        held = sum(
            len(part.parts["train"]) for part, one in zip(seen, left_out, strict=True) if one.sizes
        )
    apart = left_out or [LeftOut(part.rows.name) for part in seen]
    return Result(
        noise=_noise(fit),
        rows={"train": fitted, "test": held},
        parameters=parameters,
        rank=solution.posterior.identifiable_rank,
        condition=solution.posterior.condition,
        chi2_reduced=solution.cost,
        chi2_p_value=p_value,
        iterations=fit.iterations,
        seconds=seconds,
        converged=solution.converged,
        outliers=tuple(line for part in seen for line in part.outliers),
        correlations=_correlations(fit, parameters),
        stages=fit.stages,
        error=error,
        warnings=doubts_first([*notes, *(n.note for n in found)]),
        degrees=read.degrees,
        doubt=next((str(n) for n in found if n.kind in UNUSABLE), ""),
        arrivals=arrivals,
        shift=next((str(n) for n in found if n.kind is CaveatKind.STEP), ""),
        iso9283=iso,
        lack_of_fit=lack,
        repeatability=scatter[0] or UNSET if len(seen) == 1 else UNSET,
        validation=_validation(validated, error),
        stations=tuple(_records(fit, seen, apart, again, scatter, moves, validated))
        if len(seen) > 1
        else UNSET,
        improvement=improved or UNSET,
        clocks=tuple(_clocks(fit, rows)) or UNSET,
        elsewhere=elsewhere_of(fit) or UNSET,
    )


@dataclass(frozen=True)
class _Seen:
    """A station of a calibration.

    Attributes:
        rows: its rows.
        parts: the calibrated model over the fitted rows, "train", and over the held-out ones,
            "test", if there are any.
        values: its parameters with only base and tool fitted ("nominal"), and "calibrated".
        blocks: its blocks of readings among all.
        weights: robust weights of the fitted rows.
        free: shape (P,), which of the station's parameters were fitted.
    """

    rows: StationRows
    parts: dict[str, Station]
    values: dict[str, np.ndarray]
    blocks: slice
    weights: np.ndarray
    free: np.ndarray

    @classmethod
    def of(cls, fit: ModelFit, k: int, rows: StationRows) -> _Seen:
        problem = fit.problem
        test = rows.held(fit)
        places = problem.places[k]
        of_rows = problem.rows[k]
        return cls(
            rows=rows,
            parts={"train": problem.stations[k]} | ({} if test is None else {"test": test}),
            values={"nominal": fit.nominal.values[places], "calibrated": fit.values[places]},
            blocks=problem.block_spans[k],
            weights=fit.solution.weights[of_rows],
            free=fit.solution.free[places],
        )

    def fitted_errors(self, fit: ModelFit, model: str) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return the error magnitudes of the fitted readings that are no outliers, by unit, and
        their shares.
        """
        table = self.rows.measured[0]
        station = self.parts["train"]
        if self.rows.train is not table:
            station = fit.readings(table, station=station.name)
        counted = self.rows.by_row(self.weights) > 0.0
        sizes = pose_error_sizes(station, self.values[model])
        return {unit: of[counted] for unit, of in sizes.items()}, self.rows.share[counted]

    @cached_property
    def poses(self) -> list[np.ndarray]:
        """Pose numbers of the fitted rows as measured, and of the held-out ones."""
        return replicate_groups(self.rows.measured, within=SCATTER)

    @property
    def outliers(self) -> list[int]:
        """Lines of the rejected rows, and of wrong readings of poses with others."""
        rejected = self.rows.measured[0].rows[self.rows.by_row(self.weights) == 0.0]
        return sorted([*rejected.tolist(), *self.rows.wrong])


def _validation(validated: Validated | None, error: Errors) -> ValidationWay | UnsetType:
    """Return how the errors at rows that were not fitted are stated; unset without any."""
    if "test" not in error["calibrated"]:
        return UNSET
    if validated is None:
        return ValidationWay("held out", 0)
    return ValidationWay(validated.headline, validated.folds.count(validated.headline))


def _errors(fit: ModelFit, seen: Sequence[_Seen], validated: Validated | None) -> Errors:
    """Return the errors of all stations together, by model and part; of several ways the worse is
    "test".
    """
    rows = [part.rows for part in seen]
    found: Errors = {}
    solutions = {"nominal": fit.nominal, "calibrated": fit.solution}
    for model, solution in solutions.items():
        fitted = [part.fitted_errors(fit, model) for part in seen]
        sizes, shares = zip(*fitted, strict=True)
        unseen = (
            errors_held_out(fit, solution, rows) if validated is None else validated.errors(model)
        )
        found[model] = {"train": error_statistics(sizes, shares=shares)} | unseen
    for of_model in found.values():
        lead = headline_of(of_model)
        if lead in of_model:
            of_model["test"] = of_model[lead]
    return found


def _records(
    fit: ModelFit,
    seen: Sequence[_Seen],
    left_out: Sequence[LeftOut],
    again: Sequence[tuple[dict[str, Any] | None, LackOfFit | None]],
    scatter: Sequence[ScatterByLevel | None],
    moved_there: Sequence[Sequence[MovedParameter]],
    validated: Validated | None,
) -> Iterator[StationRecord]:
    """Yield the records of several stations."""
    robots = FittedRobot.of(fit).each
    for k, (station, one, (iso, lack), moves) in enumerate(
        zip(seen, left_out, again, moved_there, strict=True)
    ):
        record: StationRecord = {
            "name": station.rows.name,
            "kind": station.parts["train"].sensor.kind,
            "rows": {"train": len(station.rows.measured[0]), "test": len(station.rows.measured[1])},
            "noise": _noise(fit, station.blocks),
            "outliers": station.outliers,
            "error": {
                model: {part: error_summary(at, values) for part, at in station.parts.items()}
                for model, values in station.values.items()
            },
        }
        for model, by_part in record["error"].items():
            # Readings of a station that were never left out have no such errors.
            if validated is not None and (found := validated.at_station(k, model)):
                record["rows"]["test"] = record["rows"]["train"]
                by_part["test"] = found
        displacement = moved(robots[0], robots[k]).instrument if k else None
        if displacement is not None:
            record["moved_mm"] = 1e3 * displacement
        if one.sizes:
            record["left_out"] = error_statistics([one.sizes["calibrated"]])
            record["left_out_geometric"] = error_statistics([one.sizes["geometric"]])
        if moves:
            record["parameters"] = list(moves)
        if iso is not None:
            record["iso9283"] = iso
        if lack is not None:
            record["lack_of_fit"] = lack
        if (levels := scatter[k]) is not None:
            record["repeatability"] = levels
        yield record


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
        )


def _on_rows(
    seen: Sequence[_Seen], left_out: Sequence[LeftOut], validated: Validated | None
) -> Iterator[Caveat]:
    """Yield the findings on the fitted rows of each station, then on the held-out ones."""
    for part in seen:
        train = part.parts["train"]
        values = part.values["calibrated"]
        rejected = part.weights == 0.0
        table = part.rows.train
        lines = part.outliers
        yield from findings_on_outliers(
            train, values, part.free, table=table, rejected=rejected, lines=lines
        )
        yield from findings_on_order(train)
    if not left_out and validated is None and not any("test" in part.parts for part in seen):
        yield Caveat(CaveatKind.NOT_HELD_OUT)
    for one in left_out:
        if one.obstacle:
            yield Caveat(CaveatKind.NOT_LEFT_OUT, {"why": one.obstacle}, one.station)
    for part in seen:
        yield from findings_on_held_out(
            part.parts.get("test"), part.values["calibrated"], part.rows.test
        )
    for part, found in zip(seen, [] if validated is None else validated.lead, strict=False):
        if found.counted.any():
            table = (
                part.rows.measured[0]
                if len(found.counted) == len(part.rows.measured[0])
                else part.rows.train
            )
            sizes = found.counted_sizes
            yield from far_off(
                next(iter(sizes.values())), table.select(found.counted), part.rows.name
            )


def _replicates(
    fit: ModelFit, k: int, seen: _Seen, validated: Validated | None
) -> tuple[dict[str, Any] | None, LackOfFit | None]:
    """Return accuracy and repeatability by ISO 9283, and the test of lack of fit; None without
    repeated poses.

    Accuracy is that at poses which a fit has not seen, where there are any.
    """
    (train, test), (train_poses, test_poses) = seen.rows.measured, seen.poses
    if len(np.unique(np.concatenate([train_poses, test_poses]))) == len(train_poses) + len(
        test_poses
    ):
        return None, None
    at = fit.problem.stations[k].name
    counted = seen.rows.by_row(seen.weights) > 0.0
    found = [Replicates("train", train, fit.readings(train, station=at), train_poses, counted)]
    if "test" in seen.parts:
        found.append(
            Replicates(
                "test", test, fit.readings(test, station=at), test_poses, np.ones(len(test), bool)
            )
        )
    solution = fit.solution
    is_alone = len(fit.problem.stations) == 1
    spent = solution.effective if is_alone else spent_at(fit, k)
    visits = by_visit(fit, at, found)
    lack = lack_of_fit(visits, seen.values["calibrated"], solution.sigma[seen.blocks], spent=spent)
    if (
        lack is not None
        and lack.is_significant
        and not any(plan_of(part.table).is_revisited for part in found)
    ):
        # Readings within stops show the instrument's noise alone: what exceeds it may be the
        # arrival of the drives.
        lack = None
    if validated is None or len(validated.lead[k].counted) != len(train):
        return iso9283(found, seen.values), lack
    unseen = {model: validated.leading(model)[k].residuals for model in validated.of_model}
    known = np.all([np.isfinite(of).all(axis=0) for of in unseen.values()], axis=0)
    predicted = replace(found[0], part="test", counted=counted & known)
    return iso9283([predicted], seen.values, residuals=unseen), lack


def _repeatability(fit: ModelFit, k: int, seen: _Seen) -> ScatterByLevel | None:
    """Return how the readings of a station scatter, level by level; None where none was
    repeated.
    """
    table = seen.rows.measured[0]
    if seen.rows.train is table:
        return None
    as_read = fit.readings(table, station=fit.problem.stations[k].name)
    return scatter_by_level(fit.alone[k], as_read, plan_of(table))


def _noise(fit: ModelFit, blocks: slice = slice(None)) -> NoiseRecord:
    """Return the noise of some blocks of readings, the root mean square over the readings of each
    unit.
    """
    stated = declared_noise(fit.problem, fit.options).declared
    of_blocks = zip(
        fit.problem.blocks, fit.solution.sigma, stated, fit.solution.estimated, strict=True
    )
    rows = np.repeat(
        [len(station) for station in fit.problem.stations],
        [b.stop - b.start for b in fit.problem.block_spans],
    )
    found: dict[str, list[tuple[float, float]]] = {}
    for (block, sigma, declared, estimated), n in list(zip(of_blocks, rows, strict=True))[blocks]:
        weight = float(n * block.size)
        found.setdefault(noise_key(block.unit), []).append(
            (float(sigma if declared is None else declared), weight)
        )
        found.setdefault(f"residual_{noise_key(block.unit)}", []).append((float(estimated), weight))
    noise = {}
    for name, sizes in found.items():
        values, weights = np.array(sizes).T
        noise[name] = float(
            values[0] if len(values) == 1 else np.sqrt(np.average(values**2, weights=weights))
        )
    return cast(NoiseRecord, {"source": "declared" if fit.is_declared else "estimated", **noise})


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
            *np.nonzero(np.triu(np.abs(correlation) > _CORRELATED, 1) & np.outer(inner, inner)),
            strict=True,
        )
    ]
    pairs.sort(key=lambda pair: -abs(pair[0]))
    return tuple({"parameters": [a, b], "correlation": r} for r, a, b in pairs[:_MOST_CORRELATIONS])
