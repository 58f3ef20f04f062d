"""The result of a calibration: parameters with uncertainty, status and reason; errors before and after; what it rests on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, cast

import numpy as np
from msgspec import UNSET
from scipy.special import chdtrc

from pincal.calibration.notes import Kind, Note, notes_on_fit, notes_on_held_out, notes_on_outliers, notes_on_replicates
from pincal.calibration.rows import StationRows
from pincal.identify.explain import explain
from pincal.identify.fit import Fit
from pincal.identify.reasons import Reason, Status
from pincal.identify.station import Station
from pincal.io.result_file import Correlation, Errors, NoiseRecord, Outcome, ParameterRecord, StationRecord
from pincal.parameters import FRAME_SYMBOLS
from pincal.robot.se3 import placed, rotation_vectors
from pincal.validate.accuracy import error_statistics
from pincal.validate.lack_of_fit import LackOfFit, lack_of_fit
from pincal.validate.replicates import Replicates, iso9283, replicate_groups

# Absolute correlation from which a pair is listed: two parameters then share four fifths of their variance.
_CORRELATED = 0.9
# Pairs that are listed at most, the strongest first.
_MOST_CORRELATIONS = 20


@dataclass(frozen=True)
class ParameterRow:
    """One line of the parameter table, SI units.

    Attributes:
        name: ``<element>.<symbol>``.
        unit: "m", "rad" or "rad/(N m)".
        nominal: what the URDF says.
        value: what was found.
        sigma: its standard deviation; that of the prior where the data say nothing, None for a given value.
        status: whether the data identify it.
        reason: why not.
        effect: that owns it; "named_point" for coordinates of sockets, anchors and points of an object.
    """

    name: str
    unit: str
    nominal: float
    value: float
    sigma: float | None
    status: Status
    reason: Reason
    effect: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of ``result.json``, the reason in words."""
        names = (field.name for field in fields(ParameterRecord))
        return {name: getattr(self, name) for name in names} | {"status": str(self.status), "reason": str(self.reason)}


@dataclass(frozen=True, kw_only=True)
class Result(Outcome):
    """All that ``result.json`` says, as one object."""

    parameters: tuple[ParameterRow, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of ``result.json``."""
        absent = {name for name in ("iso9283", "lack_of_fit", "stations") if getattr(self, name) in (None, UNSET)}
        contents = {name: value for name, value in asdict(self).items() if name not in absent}
        return contents | {"parameters": [row.to_dict() for row in self.parameters]}


def result_of(fit: Fit, rows: Sequence[StationRows], *, seconds: float, notes: tuple[str, ...] = ()) -> Result:
    """Put a calibration's result together.

    Args:
        fit: the calibration.
        rows: the rows of each station, fitted and held out.
        seconds: how long it took.
        notes: notes on robot and data, which come first.
    """
    solution = fit.solution
    parameters = parameter_rows(fit)
    p_value = float(chdtrc(solution.degrees, solution.chi2)) if fit.is_declared else None
    seen = [_Seen.of(fit, k, part) for k, part in enumerate(rows)]
    iso, lack = _replicates(fit, seen)
    found = [*notes_on_fit(fit, p_value), *(note for part in seen for note in part.notes)]
    found += [] if any(part.test for part in seen) else [Note(Kind.NOT_HELD_OUT)]
    found += [note for part in seen for note in notes_on_held_out(part.test, part.values["calibrated"], part.rows.test)]
    found += notes_on_replicates(lack, p_value)
    return Result(
        noise=_noise(fit),
        rows={"train": len(fit.problem), "test": sum(len(part.rows.test) for part in seen)},
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
        error=_errors(seen),
        warnings=(*notes, *map(str, found)),
        iso9283=iso,
        lack_of_fit=lack,
        stations=tuple(_record(fit, seen, k) for k in range(len(seen))) if len(seen) > 1 else UNSET,
    )


@dataclass(frozen=True)
class _Seen:
    """A station as a calibration sees it.

    Attributes:
        rows: its rows.
        train: the fitted ones under the calibrated model.
        test: the held-out ones; None without any.
        values: its parameters with base and tool fitted alone ("nominal"), and "calibrated".
        blocks: where its blocks of readings stand among all.
        weights: robust weights of the fitted rows.
    """

    rows: StationRows
    train: Station
    test: Station | None
    values: dict[str, np.ndarray]
    blocks: slice
    weights: np.ndarray

    @classmethod
    def of(cls, fit: Fit, k: int, rows: StationRows) -> _Seen:
        problem = fit.problem
        values = {"nominal": fit.nominal.values[problem.places[k]], "calibrated": fit.values[problem.places[k]]}
        weights = fit.solution.weights[problem.rows[k]]
        return cls(rows, problem.stations[k], rows.held(fit), values, problem.block_spans[k], weights)

    @property
    def parts(self) -> dict[str, Station]:
        """Fitted rows, and held-out ones if there are any."""
        return {"train": self.train} | ({} if self.test is None else {"test": self.test})

    @property
    def outliers(self) -> list[int]:
        """Lines of the rejected rows."""
        return [int(line) for line in self.rows.train.rows[self.weights == 0.0]]

    @property
    def notes(self) -> list[Note]:
        """What to say of them."""
        return notes_on_outliers(self.outliers, station=self.rows.name)


def _errors(seen: Sequence[_Seen]) -> Errors:
    """Return the errors of stations taken together, by model and part."""
    parts = [part for part in ("train", "test") if any(part in station.parts for station in seen)]
    return {
        model: {part: error_statistics((s.parts[part], s.values[model]) for s in seen if part in s.parts) for part in parts}
        for model in ("nominal", "calibrated")
    }


def _record(fit: Fit, seen: Sequence[_Seen], k: int) -> StationRecord:
    """Return what is to be said of one of several stations."""
    station = seen[k]
    record: StationRecord = {
        "name": station.rows.name,
        "kind": station.train.sensor.kind,
        "rows": {"train": len(station.train), "test": len(station.rows.test)},
        "noise": _noise(fit, station.blocks),
        "outliers": station.outliers,
        "error": _errors([station]),
    }
    first, here = (placement_of(s.train, s.values["calibrated"]) for s in (seen[0], station))
    if k and first is not None and here is not None:
        apart = np.linalg.inv(first)[:3, 3] - np.linalg.inv(here)[:3, 3]
        record["moved_mm"] = float(1e3 * np.linalg.norm(apart))
    return record


def placement_of(station: Station, values: np.ndarray) -> np.ndarray | None:
    """Return the robot's base in the instrument's frame, shape (4, 4); None where a station does not tell all of it."""
    places = {p.name: i for i, p in enumerate(station.parameters)}
    names = [f"base.{symbol}" for symbol in FRAME_SYMBOLS]
    if not all(name in places for name in names):
        return None
    return placed(station.model.chain.base_rotation, values[[places[name] for name in names]])


def _replicates(fit: Fit, seen: Sequence[_Seen]) -> tuple[dict[str, Any] | None, LackOfFit | None]:
    """Return accuracy and repeatability by ISO 9283, and the test of lack of fit, where one station measured poses again."""
    if len(seen) > 1:
        return None, None
    station, solution = seen[0], fit.solution
    train_poses, test_poses = replicate_groups([station.rows.train, station.rows.test])
    found = [Replicates("train", station.rows.train, station.train, train_poses, station.weights > 0.0)]
    if station.test is not None:
        found.append(Replicates("test", station.rows.test, station.test, test_poses, np.ones(len(station.test), bool)))
    lack = lack_of_fit(found, fit.values, solution.sigma, spent=solution.posterior.effective)
    return iso9283(found, station.values), lack


def _noise(fit: Fit, blocks: slice = slice(None)) -> NoiseRecord:
    """Return the noise of some blocks of readings; of several of one unit the root mean square over readings."""
    of_blocks = zip(fit.problem.blocks, fit.solution.sigma, fit.noise.declared, fit.solution.estimated, strict=True)
    rows = np.repeat([len(station) for station in fit.problem.stations], [b.stop - b.start for b in fit.problem.block_spans])
    found: dict[str, list[tuple[float, float]]] = {}
    for (block, sigma, declared, estimated), n in list(zip(of_blocks, rows, strict=True))[blocks]:
        weight = float(n * block.size)
        found.setdefault(f"sigma_{block.unit}", []).append((float(sigma if declared is None else declared), weight))
        found.setdefault(f"residual_sigma_{block.unit}", []).append((float(estimated), weight))
    noise = {name: _root_mean_square(sizes) for name, sizes in found.items()}
    source: Literal["declared", "estimated"] = "declared" if fit.is_declared else "estimated"
    return cast(NoiseRecord, {"source": source, **noise})


def _root_mean_square(sizes: list[tuple[float, float]]) -> float:
    if len(sizes) == 1:
        return sizes[0][0]
    values, weights = np.array(sizes).T
    return float(np.sqrt(np.average(values**2, weights=weights)))


def parameter_rows(fit: Fit) -> tuple[ParameterRow, ...]:
    """Return the parameter table of a fit; the angles of base and tool as rotation vectors of their orientation."""
    values = fit.values + np.array([p.nominal for p in fit.problem.parameters])
    for station, local in zip(fit.problem.stations, fit.problem.places, strict=True):
        chain = station.model.chain
        references = {"base": chain.base_rotation, **dict(zip(chain.targets, chain.tool_rotations, strict=True))}
        for element, rotation in references.items():
            names = {f"{element}.r{axis}" for axis in "xyz"}
            places = [i for i, p in zip(local, station.parameters, strict=True) if p.name in names]
            if len(places) == 3:
                turned = placed(rotation, np.concatenate([np.zeros(3), values[places]]))
                values[places] = rotation_vectors(turned[None, :3, :3])[0]
    return tuple(
        ParameterRow(
            name=parameter.name,
            unit=parameter.unit,
            nominal=parameter.nominal,
            value=float(value),
            sigma=None if finding.status == "fixed" else float(sigma),
            status=finding.status,
            reason=finding.reason,
            effect=parameter.effect,
        )
        for parameter, value, sigma, finding in zip(
            fit.problem.parameters, values, fit.estimate.sigma, explain(fit), strict=True
        )
    )


def _correlations(fit: Fit, rows: tuple[ParameterRow, ...]) -> tuple[Correlation, ...]:
    """Return the strongest correlations between identified parameters, those of base and tool left out."""
    C = fit.solution.posterior.covariance
    sd = np.sqrt(np.diag(C))
    correlation = C / np.outer(sd, sd)
    shared = fit.solution.free & fit.problem.is_shared
    parameters = [p for p, is_shared in zip(fit.problem.parameters, shared, strict=True) if is_shared]
    identified = {row.name for row in rows if row.status == "identified"}
    inner = np.array([np.isfinite(p.size) and p.name in identified for p in parameters], bool)
    pairs = [
        (float(correlation[i, j]), parameters[i].name, parameters[j].name)
        for i, j in zip(*np.nonzero(np.triu(np.abs(correlation) > _CORRELATED, 1) & np.outer(inner, inner)), strict=True)
    ]
    pairs.sort(key=lambda pair: -abs(pair[0]))
    return tuple({"parameters": [a, b], "correlation": r} for r, a, b in pairs[:_MOST_CORRELATIONS])
