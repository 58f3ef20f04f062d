"""The tables of a calibration: errors, parameters with status and reason, correlations, accuracy
and repeatability.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pincal.errors import counted
from pincal.identify.explain import Reason, Status, explain
from pincal.identify.fit import ModelFit
from pincal.identify.station import Station
from pincal.parameters import Estimate, Parameter
from pincal.result_table import Cell, Column, Kind, RowTone, Table
from pincal.robot.se3 import placed, rotation_vectors
from pincal.thresholds import Count
from pincal.units import (
    INTERVAL,
    Quantity,
    Unit,
    fixed,
    readable_unit,
    show_chance,
    show_measured,
    show_plainly,
    show_rounded,
    show_sigma,
    show_unit,
    show_value,
)
from pincal.validate.accuracy import ANGLE_WORDS, ERROR_UNITS, leading_unit
from pincal.validate.outcome import ClockRecord, Improvement, StationRecord

PARTS = {
    "train": "fitted",
    "test": "held out",
    "regions": "held-out regions",
    "stretches": "held-out stretches",
    "sessions": "held-out sessions",
    "random": "held-out poses",
}
"""Names of the parts of a data set."""

# Decimal places of nominal values in mm and mrad: 1 nm and 1 nrad.
_NOMINAL_PLACES: Count = 6
# Rows of parameters beyond which only those that moved are listed.
_MOST_MOVED: Count = 40
# Moves named in one line.
_MOST_NAMED: Count = 3
# Coordinates of named points beyond which they are omitted from printed tables; result.json has
# them.
_MOST_POINTS: Count = 24
_STATISTICS = {"mean": "mean", "median": "median", "rms": "rms", "p95": "95 %", "max": "max"}
_BRIEF = {"mean": "mean", "p95": "95 %", "max": "max"}
_IN_TIME = {"nominal": "before", "calibrated": "after"}
_MODELS = {"nominal": "nominal, base and tool fitted", "calibrated": "calibrated"}
_TONES: dict[str, RowTone] = {
    "identified": "good",
    "prior": "care",
    "fixed": "mute",
    "unidentifiable": "care",
    "at bound": "bad",
}


@dataclass(frozen=True)
class ParameterRecord:
    """One parameter [SI units].

    Attributes:
        name: ``<element>.<symbol>``, such as ``joint_2.s_x``.
        unit: its unit.
        nominal: value of the URDF.
        value: the estimate that replaces the nominal.
        sigma: its standard deviation; that of the prior if unobservable, null for a given value.
        status: "identified"; "prior" (dominated by the prior); "fixed"; "unidentifiable"; "at
            bound".
        reason: why it is not identified; empty where it is.
    """

    name: str
    unit: str
    nominal: float
    value: float
    sigma: float | None
    status: Status
    reason: str


@dataclass(frozen=True)
class ParameterRow(ParameterRecord):
    """One row of the parameter table: :class:`ParameterRecord`, but the reason as data.

    Attributes:
        reason: why it is not identified, as data.
        effect: to which it belongs; "named_point" for coordinates of sockets, anchors and points of
            an object.
    """

    reason: Reason  # type: ignore[assignment]
    effect: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of ``result.json``, the reason in words."""
        names = (field.name for field in fields(ParameterRecord))
        return {name: getattr(self, name) for name in names} | {
            "status": str(self.status),
            "reason": str(self.reason),
        }


def parameter_rows(fit: ModelFit) -> tuple[ParameterRow, ...]:
    """Return the rows of the parameter table; orientations of base and tool as rotation vectors."""
    return tuple(
        ParameterRow(
            name=parameter.name,
            unit=parameter.unit,
            nominal=parameter.nominal,
            value=float(value),
            # What stays nominal for want of better readings is uncertain all the same.
            sigma=None if finding.status == "fixed" and not is_free else float(sigma),
            status=finding.status,
            reason=finding.reason,
            effect=parameter.effect,
        )
        for parameter, value, sigma, is_free, finding in zip(
            fit.problem.parameters,
            _with_whole_turns(fit),
            fit.estimate.sigma,
            fit.solution.free,
            explain(fit),
            strict=True,
        )
    )


def _with_whole_turns(fit: ModelFit) -> np.ndarray:
    """Return the values of all parameters, shape (P,), orientations of base and tool not relative
    to references.
    """
    values = fit.values + np.array([p.nominal for p in fit.problem.parameters])
    for station, local in zip(fit.problem.stations, fit.problem.places, strict=True):
        chain = station.model.chain
        references = {
            "base": chain.base_rotation,
            **dict(zip(chain.targets, chain.tool_rotations, strict=True)),
        }
        for element, rotation in references.items():
            names = {f"{element}.r{axis}" for axis in "xyz"}
            places = [i for i, p in zip(local, station.parameters, strict=True) if p.name in names]
            if len(places) == 3:
                turned = placed(rotation, np.concatenate([np.zeros(3), values[places]]))
                values[places] = rotation_vectors(turned[None, :3, :3])[0]
    return np.asarray(values)


def residuals_by_name(
    station: Station,
    what: str,
    residuals: np.ndarray,
) -> dict[str, np.ndarray]:
    """Return residuals, shape (m, N), by component, such as "nominal_position_x [m]", (N,) each."""
    found = {}
    left = iter(residuals)
    for block in station.sensor.blocks:
        for component in block.components:
            found[f"{what}_{component} [{block.unit}]"] = next(left)
    return found


def residual_table(fit: ModelFit) -> Table:
    """Return the residuals of the rows of a fit, station by station, before and after."""
    is_single = len(fit.problem.stations) == 1
    records: list[dict[str, Cell]] = []
    for (station, places, _), rows in zip(fit.stations, fit.problem.rows, strict=True):
        columns: dict[str, Sequence[Cell]] = {}
        if not is_single:
            columns["station"] = [station.name] * len(station)
        columns["row"] = range(len(station))
        columns["outlier"] = (fit.solution.weights[rows] == 0.0).astype(int).tolist()
        for model, values in (("nominal", fit.nominal.values), ("calibrated", fit.values)):
            left = residuals_by_name(station, model, station.residuals(values[places]))
            columns |= {name: numbers.tolist() for name, numbers in left.items()}
        for cells in zip(*columns.values(), strict=True):
            records.append(dict(zip(columns, cells, strict=True)))
    # Stations with other sensors have other components.
    names = list(dict.fromkeys(name for record in records for name in record))
    kinds = [Kind.NAME if name == "station" else Kind.NUMBER for name in names]
    named = zip(names, kinds, strict=True)
    heads = tuple(Column(name, kind=kind, show=_show_residual) for name, kind in named)
    cells_of = (tuple(record.get(name) for name in names) for record in records)
    return Table("Residuals", heads, tuple(cells_of))


def _show_residual(cell: Cell) -> str:
    return f"{cell:.3g}" if isinstance(cell, float) else show_plainly(cell)


def error_table(
    error: Mapping[str, Mapping[str, Mapping[str, float]]], *, only: Sequence[str] = ()
) -> Table:
    """Return the table of errors before and after, from ``error`` of ``result.json``, with a row
    per unit; ``only`` some units for a page that says what the models are, more briefly.
    """
    statistics = _BRIEF if only else _STATISTICS
    models = _IN_TIME if only else _MODELS
    found = [*_stated_errors(error, only or ERROR_UNITS)]
    own = () if len(only) == 1 else ("unit",)
    of_places = any(unit == "mm" for _, _, unit, _ in found)
    return Table(
        "Pose accuracy: distance from predicted to measured target" if of_places else "Errors",
        (
            *(Column(name, kind=Kind.LABEL) for name in ("model", "poses", *own)),
            *(Column(name, "", Kind.NUMBER, fixed(4), key) for key, name in statistics.items()),
        ),
        tuple(
            (
                models.get(model, model),
                PARTS.get(part, part),
                *(unit for _ in own),
                *(values[f"{name}_{unit}"] for name in statistics),
            )
            for model, part, unit, values in found
        ),
        () if own else (f"All in {only[0]}.",),
        sources=tuple(
            f"result.json#/error/{model}/{part}/{{}}_{unit.replace('/', '~1')}"
            for model, part, unit, _ in found
        ),
    )


def _stated_errors(
    error: Mapping[str, Mapping[str, Mapping[str, float]]], units: Sequence[str]
) -> Iterator[tuple[str, str, str, Mapping[str, float]]]:
    """Yield model, part, unit and statistics of all errors in some units, each part once."""
    for model, by_part in error.items():
        for part, values in by_part.items():
            # By cross-validation "test" repeats the way that is stated.
            if part == "test" and any(values == by_part[way] for way in by_part if way != part):
                continue
            for unit in units:
                if f"mean_{unit}" in values:
                    yield model, part, unit, values


def station_table(stations: Sequence[StationRecord]) -> Table:
    """Return the table of mean errors at each station, before and after, and left out where that
    was computed.
    """
    is_left_out = any("left_out" in station for station in stations)
    units = {leading_unit(station["error"]["calibrated"]["train"]) for station in stations}
    is_in_mm = units == {"mm"}
    heads = [
        Column("station", kind=Kind.NAME),
        Column("measured", kind=Kind.LABEL),
        Column("poses", kind=Kind.LABEL),
        *([] if is_in_mm else [Column("unit", kind=Kind.LABEL)]),
        Column("rows", kind=Kind.NUMBER, show=str),
    ]
    left_out = ("left out, geometry alone", "left out") if is_left_out else ()
    heads += [
        Column(name, kind=Kind.NUMBER, show=fixed(4), key="" if name in left_out else name)
        for name in ("nominal", *left_out, "calibrated")
    ]
    rows = tuple(
        row
        for station in stations
        for row in _rows_of_station(station, is_left_out=is_left_out, has_unit=not is_in_mm)
    )
    sources = tuple(
        f"result.json#/stations/{k}/error/{{}}/{part}/mean_{leading_unit(error).replace('/', '~1')}"
        for k, station in enumerate(stations)
        for part, error in station["error"]["calibrated"].items()
    )
    title = f"Mean error at each station{' [mm]' * is_in_mm}"
    return Table(title, tuple(heads), rows, sources=sources)


def _rows_of_station(
    station: StationRecord, *, is_left_out: bool, has_unit: bool
) -> Iterator[tuple[Cell, ...]]:
    """Yield the mean errors of a station, a row for each part of its rows."""
    errors = station["error"]
    unit = leading_unit(errors["calibrated"]["train"])
    mean = f"mean_{unit}"
    left_out = (station.get("left_out_geometric", {}), station.get("left_out", {}))
    others = [found.get(mean) for found in left_out] if is_left_out else []
    for part, error in errors["calibrated"].items():
        before = errors["nominal"][part][mean]
        count = station["rows"]["train" if part == "train" else "test"]
        about = (station["name"], station["kind"], PARTS[part], *((unit,) if has_unit else ()))
        yield (*about, count, before, *others, error[mean])


def clock_words(clock: ClockRecord) -> str:
    """Return offset and drift of an instrument's clock with 95 % intervals, in words."""
    words = (
        f"{clock.offset_s:+.5f} s ± {_half(1e3 * clock.offset_sigma_s)} ms, drift "
        f"{clock.drift_ppm:+.1f} ± {_half(clock.drift_sigma_ppm)} ppm"
    )
    if clock.gyro_early_s is not None and clock.gyro_early_sigma_s is not None:
        words += (
            f"; its gyroscope {1e3 * clock.gyro_early_s:+.2f} ± "
            f"{_half(1e3 * clock.gyro_early_sigma_s)} ms"
        )
    words += "".join(f"; {words_of_step}" for words_of_step in _step_words(clock))
    return f"{clock.station}: {words}" if clock.station else words


def _step_words(clock: ClockRecord) -> Iterator[str]:
    """Yield the steps of a clock with 95 % intervals, in words."""
    for step in clock.steps:
        half = _half(1e3 * step.size_sigma_s)
        yield f"from {step.at_s:.6g} s on {1e3 * step.size_s:+.2f} ± {half} ms"


def _half(sigma: float) -> str:
    """Return half of a 95 % interval, given the standard deviation, to two digits.

    Example:
        >>> _half(0.153), _half(6.1)
        ('0.30', '12')
    """
    return f"{INTERVAL * sigma:#.2g}".removesuffix(".")


def clock_table(clocks: Sequence[ClockRecord]) -> Table:
    """Return the table of the clocks of instruments that measure in motion: corrections to their
    time stamps.
    """
    offsets = (("offset", "s", 5), ("±", "ms", 3))
    drifts = (("drift", "ppm", 1), ("±", "ppm", 2))
    heads = (*offsets, *drifts, ("gyroscope", "ms", 3), ("±", "ms", 3))
    columns = (
        Column("station", kind=Kind.NAME),
        *(Column(name, u, Kind.NUMBER, fixed(n)) for name, u, n in heads),
    )
    rows: list[tuple[Cell, ...]] = []
    for at in clocks:
        gyro = (at.gyro_early_s, at.gyro_early_sigma_s)
        delay = (
            (None, None)
            if gyro[0] is None or gyro[1] is None
            else (1e3 * gyro[0], 1e3 * INTERVAL * gyro[1])
        )
        sigmas = 1e3 * INTERVAL * at.offset_sigma_s, INTERVAL * at.drift_sigma_ppm
        rows.append(
            (at.station or "instrument", at.offset_s, sigmas[0], at.drift_ppm, sigmas[1], *delay)
        )
    note = (
        "correction to the time stamps of a station at the middle of its session; for a gyroscope "
        "in addition to its accelerometer's; ± 95 %"
    )
    steps = (
        f"stamps of {at.station or 'the instrument'} {words}, where its clock or the joints' steps"
        for at in clocks
        for words in _step_words(at)
    )
    return Table("Clocks relative to that of the joints", columns, tuple(rows), (note, *steps))


def improvement_table(regions: Sequence[Improvement]) -> Table:
    """Return the table of standard deviations of predicted positions before and after, by link and
    region.
    """
    heads = (
        Column("link", kind=Kind.NAME),
        Column("region", kind=Kind.LABEL),
        Column("poses", kind=Kind.NUMBER, show=str),
    )
    sizes = tuple(Column(name, "mm", Kind.NUMBER, fixed(3)) for name in ("before", "after"))
    rows = tuple((of.link, of.region, of.poses, of.before_mm, of.after_mm) for of in regions)
    note = (
        "near, far, low and high: halves by distance from the axis of the base and by height, "
        "within the joints' limits"
    )
    return Table("Standard deviation of predicted positions", (*heads, *sizes), rows, (note,))


def moved_table(stations: Sequence[StationRecord]) -> Table | None:
    """Return the table of parameters that differ between stations; None if none does.

    Of very many rows only those where a parameter moved.
    """
    names = dict.fromkeys(
        entry["name"] for station in stations for entry in station.get("parameters", ())
    )
    found = [
        (station["name"], entry)
        for name in names
        for station in stations
        for entry in station.get("parameters", ())
        if entry["name"] == name and entry["sigma"] > 0.0
    ]
    is_short = len(found) <= _MOST_MOVED
    rows = [_moved_row(at, entry) for at, entry in found if is_short or entry["moved"]]
    if not rows:
        return None
    columns = (
        Column("parameter", kind=Kind.NAME),
        Column("unit", kind=Kind.LABEL, show=show_unit),
        Column("station", kind=Kind.NAME),
        Column("since the first", kind=Kind.NUMBER, show=show_rounded),
        Column("95 %: from", kind=Kind.NUMBER, show=show_rounded),
        Column("to", kind=Kind.NUMBER, show=show_rounded),
        Column("since the previous", kind=Kind.LABEL),
    )
    hidden = len(found) - len(rows)
    omitted = f"Omitted here: {counted(hidden, 'row')} without a change; see result.json."
    notes = (omitted,) if hidden else ()
    return Table("Parameters that moved between stations", columns, tuple(rows), notes)


def _moved_row(at: str, entry: Mapping[str, Any]) -> tuple[Cell, ...]:
    """Return the row of a parameter at a station."""
    change = entry["change"]
    half = INTERVAL * entry["sigma"]
    bounds = (change, change - half, change + half)
    numbers = (Quantity(number, entry["unit"], entry["sigma"]) for number in bounds)
    return (entry["name"], entry["unit"], at, *numbers, "moved" if entry["moved"] else "")


def _with_interval(entry: Mapping[str, Any]) -> str:
    """Return a change with its interval, in words."""
    unit = readable_unit(entry["unit"])
    return f"{show_measured(entry['change'], entry['sigma'], unit)} {unit.name}"


def station_changes(stations: Sequence[StationRecord]) -> str:
    """Return the moves between stations, in words; empty without any."""
    moved = [
        (station["name"], entry)
        for station in stations
        for entry in station.get("parameters", ())
        if entry["moved"]
    ]
    words = [
        f"{entry['name']} at {name} by {_with_interval(entry)} (95 %)"
        for name, entry in moved[:_MOST_NAMED]
    ]
    return "; ".join(words) + (
        f"; and {len(moved) - _MOST_NAMED} more" if len(moved) > _MOST_NAMED else ""
    )


def repeated_table(stations: Sequence[StationRecord]) -> Table | None:
    """Return the table of repeated measurements at each station; None without any."""
    rows = []
    for station in stations:
        iso = station.get("iso9283")
        lack = station.get("lack_of_fit")
        if iso is None and lack is None:
            continue
        accuracy = {} if iso is None else next(iter(iso["calibrated"].values()))
        numbers = (accuracy.get(key, {}).get("mean") for key in ("AP_mm", "RP_mm"))
        counts = (None, None) if iso is None else (sum(iso["poses"].values()), iso["cycles"]["max"])
        test = (None, "") if lack is None else (lack.F, show_chance(lack.p_value))
        verdict = (
            "" if lack is None else "incomplete" if lack.is_significant else "within the scatter"
        )
        rows.append((station["name"], *counts, *numbers, *test, verdict))
    numbers_of = (
        Column(name, kind=Kind.NUMBER, show=fixed(4)) for name in ("AP mean [mm]", "RP mean [mm]")
    )
    columns = (
        Column("station", kind=Kind.NAME),
        *(Column(name, kind=Kind.NUMBER) for name in ("poses", "cycles")),
        *numbers_of,
        Column("lack of fit F", kind=Kind.NUMBER, show=fixed(2)),
        *(Column(name, kind=Kind.LABEL) for name in ("p", "model")),
    )
    return (
        Table("Repeated measurements of poses at each station (ISO 9283)", columns, tuple(rows))
        if rows
        else None
    )


def shown_parameters(rows: Sequence[ParameterRow]) -> tuple[ParameterRow, ...]:
    """Return the parameters to print: without the coordinates of named points, if these
    are many.
    """
    inner = tuple(row for row in rows if row.effect != "named_point")
    return tuple(rows) if len(rows) - len(inner) <= _MOST_POINTS else inner


_ESTIMATES = (
    Column("parameter", kind=Kind.NAME),
    Column("unit", kind=Kind.LABEL, show=show_unit),
    Column("nominal", kind=Kind.NUMBER, show=show_value),
    Column("value", kind=Kind.NUMBER, show=show_value),
    Column("sigma", kind=Kind.NUMBER, show=show_sigma),
)


def parameter_table(parameters: Sequence[ParameterRow], title: str = "Parameters") -> Table:
    """Return the table of nominal value, calibrated value, standard deviation and status of each
    parameter.
    """
    shown = shown_parameters(parameters)
    hidden = len(parameters) - len(shown)
    return Table(
        title,
        (*_ESTIMATES, Column("status", kind=Kind.STATUS), Column("reason", kind=Kind.REMARK)),
        tuple(
            (*_cells(row, row.nominal, row.value, row.sigma), row.status, str(row.reason))
            for row in shown
        ),
        (f"The coordinates of {hidden // 3} named points are omitted here; result.json has them.",)
        if hidden
        else (),
        tuple(_TONES[row.status] for row in shown),
    )


def rounded_table(parameters: Sequence[ParameterRow], places: Iterable[int]) -> Table:
    """Return the table of some parameters for a page: values rounded to their standard deviations
    (JCGM 100, 7.2.6).

    Args:
        parameters: all parameters, in the order of ``result.json``.
        places: indices of those in the table.
    """
    columns = (
        Column("parameter", kind=Kind.NAME),
        Column("nominal", kind=Kind.NUMBER, key="nominal"),
        Column("value", kind=Kind.NUMBER, key="value sigma"),
        Column("unit", kind=Kind.LABEL, show=show_unit),
        Column("status", kind=Kind.STATUS),
        Column("reason", kind=Kind.REMARK),
    )
    chosen = [(k, parameters[k]) for k in places]
    rows = tuple(
        (
            row.name,
            _show_nominal(row.nominal, readable_unit(row.unit)),
            show_measured(row.value, row.sigma, readable_unit(row.unit)),
            row.unit,
            row.status,
            str(row.reason),
        )
        for _, row in chosen
    )
    sources = tuple(f"result.json#/parameters/{k}/{{}}" for k, _ in chosen)
    tones = tuple(_TONES[row.status] for _, row in chosen)
    return Table("Parameters", columns, rows, tones=tones, sources=sources)


def _show_nominal(value: float, unit: Unit) -> str:
    """Return a nominal value; what the arithmetic of frames leaves in place of zero is zero.

    Example:
        >>> _show_nominal(6.1e-17, Unit(1e3, "mm")), _show_nominal(0.0945, Unit(1e3, "mm"))
        ('0', '94.5')
    """
    shown = value * unit.factor
    return f"{shown if unit.factor == 1.0 else round(shown, _NOMINAL_PLACES):z.6g}"


def estimate_table(estimate: Estimate) -> Table:
    """Return the table of nominal value, calibrated value and standard deviation of
    each parameter.
    """
    numbers = zip(estimate.parameters, estimate.values, estimate.fitted_sigma, strict=True)
    rows = tuple(
        _cells(p, p.nominal, p.nominal + float(value), float(sigma) if np.isfinite(sigma) else None)
        for p, value, sigma in numbers
    )
    return Table("Parameters", _ESTIMATES, rows)


def _cells(of: ParameterRow | Parameter, *numbers: float | None) -> tuple[Cell, ...]:
    return (
        of.name,
        of.unit,
        *(None if number is None else Quantity(number, of.unit) for number in numbers),
    )


def correlation_table(correlations: Iterable[Mapping[str, Any]]) -> Table:
    """Return the table of strongly correlated parameters."""
    names = tuple(Column(name, kind=Kind.NAME) for name in ("parameter", "with"))
    columns = (
        *names,
        Column("correlation", kind=Kind.NUMBER, show="{:+.3f}".format, key="correlation"),
    )
    rows = tuple((*pair["parameters"], pair["correlation"]) for pair in correlations)
    sources = tuple(f"result.json#/correlations/{k}/{{}}" for k in range(len(rows)))
    return Table("Strong correlations", columns, rows, sources=sources)


_CHARACTERISTICS = {
    "AP": "pose accuracy",
    "RP": "pose repeatability",
    "AD": "distance accuracy",
    "RD": "distance repeatability",
    "vAP": "variation with direction",
    "dAP": "drift of accuracy",
    "dRP": "drift of repeatability",
}


def characteristics_table(found: Mapping[str, Any]) -> Table:
    """Return the table of the characteristics of ISO 9283, as from
    :func:`pincal.validate.pose_characteristics.characteristics`, with their 95 % intervals.
    """
    columns = (
        *(Column(name, kind=Kind.LABEL) for name in ("", "characteristic")),
        Column("mean mm", kind=Kind.NUMBER, show=fixed(4)),
        Column("95 % interval", kind=Kind.LABEL),
        Column("max mm", kind=Kind.NUMBER, show=fixed(4)),
        *(Column(name, kind=Kind.NUMBER, show=str) for name in ("of", "cycles")),
    )
    rows = []
    for name, entry in found.items():
        symbol = name.removesuffix("_mm")
        ends = entry["interval"]
        interval = "" if ends is None else "{:.4f} to {:.4f}".format(*ends)
        rows.append(
            (
                symbol,
                _CHARACTERISTICS[symbol],
                entry["mean"],
                interval,
                entry["max"],
                entry["of"],
                entry["cycles"],
            )
        )
    return Table("Characteristics of repeated poses (ISO 9283)", columns, tuple(rows))


def iso9283_table(iso: Mapping[str, Any]) -> Table:
    """Return the table of mean and largest pose accuracy AP and repeatability RP, with a row per
    unit.
    """
    heads = [Column(name, kind=Kind.LABEL) for name in ("model", "poses", "unit")]
    statistics = ("mean", "max")
    heads += [
        Column(f"{name} {size}", kind=Kind.NUMBER, show=fixed(4))
        for name in ("AP", "RP")
        for size in statistics
    ]
    rows = []
    for model in _MODELS:
        for part, values in iso.get(model, {}).items():
            for key in (key for key in values if key.startswith("AP")):
                numbers = (
                    values[name][size] for name in (key, "R" + key[1:]) for size in statistics
                )
                rows.append(
                    (model, f"{iso['poses'][part]} {PARTS[part]}", ANGLE_WORDS[key], *numbers)
                )
    return Table("Pose accuracy AP and pose repeatability RP (ISO 9283)", tuple(heads), tuple(rows))
