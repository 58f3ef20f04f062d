"""The result of a calibration: parameters with uncertainty, status and reason; errors before and after; what it rests on."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, cast

import numpy as np
from scipy.special import chdtrc

from pincal.calibration.notes import notes_on_fit, notes_on_held_out, notes_on_replicates
from pincal.identify.explain import explain
from pincal.identify.fit import Fit
from pincal.identify.reasons import Reason, Status
from pincal.identify.station import Station
from pincal.io.result_file import Correlation, NoiseRecord, Outcome, ParameterRecord
from pincal.measure.measurements import Measurements
from pincal.robot.se3 import placed, rotation_vectors
from pincal.validate.accuracy import error_table
from pincal.validate.lack_of_fit import lack_of_fit
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
        absent = {name for name in ("iso9283", "lack_of_fit") if getattr(self, name) is None}
        contents = {name: value for name, value in asdict(self).items() if name not in absent}
        return contents | {"parameters": [row.to_dict() for row in self.parameters]}


def result_of(
    fit: Fit,
    test: Station | None,
    *,
    seconds: float,
    tables: tuple[Measurements, Measurements],
    notes: tuple[str, ...] = (),
) -> Result:
    """Put a calibration's result together.

    Args:
        fit: the calibration.
        test: held-out rows under the calibrated model; None without any.
        seconds: how long it took.
        tables: the training rows, and the held-out ones.
        notes: notes on robot and data, which come first.
    """
    solution = fit.solution
    declared = fit.noise.declared[0] is not None
    parameters = parameter_rows(fit)
    p_value = float(chdtrc(solution.degrees, solution.chi2)) if declared else None
    outliers = tuple(int(line) for line in tables[0].rows[solution.weights == 0.0])
    replicates = _replicates(fit, test, tables)
    lack = lack_of_fit(replicates, fit.values, solution.sigma, spent=solution.posterior.effective)
    models = {"nominal": fit.nominal.values, "calibrated": fit.values}
    parts = {"train": fit.station} | ({} if test is None else {"test": test})
    found = [*notes_on_fit(fit, p_value, outliers, test), *notes_on_held_out(fit, test, tables[1])]
    found += notes_on_replicates(lack, p_value)
    return Result(
        noise=_noise(fit),
        rows={"train": len(fit.station), "test": 0 if test is None else len(test)},
        parameters=parameters,
        rank=solution.posterior.identifiable_rank,
        condition=solution.posterior.condition,
        chi2_reduced=solution.cost,
        chi2_p_value=p_value,
        iterations=fit.iterations,
        seconds=seconds,
        converged=solution.converged,
        outliers=outliers,
        correlations=_correlations(fit, parameters),
        stages=fit.stages,
        error={name: {part: error_table(rows, of) for part, rows in parts.items()} for name, of in models.items()},
        warnings=(*notes, *map(str, found)),
        iso9283=iso9283(replicates, models),
        lack_of_fit=lack,
    )


def _replicates(fit: Fit, test: Station | None, tables: tuple[Measurements, Measurements]) -> list[Replicates]:
    """Return fitted and held-out rows with the poses that they are replicates of."""
    train_poses, test_poses = replicate_groups(tables)
    found = [Replicates("train", tables[0], fit.station, train_poses, fit.solution.weights > 0.0)]
    if test is not None:
        found.append(Replicates("test", tables[1], test, test_poses, np.ones(len(test), bool)))
    return found


def _noise(fit: Fit) -> NoiseRecord:
    noise: dict[str, float] = {}
    for block, sigma, declared, estimated in zip(
        fit.station.sensor.blocks, fit.solution.sigma, fit.noise.declared, fit.solution.estimated, strict=True
    ):
        name = f"sigma_{block.unit}"
        noise[name] = float(sigma if declared is None else declared)
        noise[f"residual_{name}"] = float(estimated)
    source: Literal["declared", "estimated"] = "estimated" if fit.noise.declared[0] is None else "declared"
    return cast(NoiseRecord, {"source": source, **noise})


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
    parameters = [p for p, free in zip(fit.station.parameters, fit.solution.free, strict=True) if free]
    identified = {row.name for row in rows if row.status == "identified"}
    inner = np.array([np.isfinite(p.size) and p.name in identified for p in parameters], bool)
    pairs = [
        (float(correlation[i, j]), parameters[i].name, parameters[j].name)
        for i, j in zip(*np.nonzero(np.triu(np.abs(correlation) > _CORRELATED, 1) & np.outer(inner, inner)), strict=True)
    ]
    pairs.sort(key=lambda pair: -abs(pair[0]))
    return tuple({"parameters": [a, b], "correlation": r} for r, a, b in pairs[:_MOST_CORRELATIONS])
