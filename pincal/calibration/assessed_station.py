"""One station of a calibration: its rows under the model, its errors, replicates and findings, and
its record.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np

from pincal.calibration.caveats import (
    Caveat,
    far_off,
    findings_on_held_out,
    findings_on_order,
    findings_on_outliers,
    findings_on_replicates,
)
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.frame_shift import moved
from pincal.calibration.held_out import LeftOut, StationRows, Validated
from pincal.calibration.station_information import spent_at
from pincal.calibration.visit_findings import by_visit, findings_on_visits
from pincal.identify.beliefs import declared_noise
from pincal.identify.fit import ModelFit
from pincal.identify.station import Station
from pincal.identify.visit_weights import ScatterByLevel, scatter_by_level
from pincal.measure.measurements import Measurements
from pincal.measure.poses import SCATTER, replicate_groups
from pincal.measure.stops import plan_of
from pincal.validate.accuracy import (
    Replicates,
    error_statistics,
    error_summary,
    iso9283,
    pose_error_sizes,
)
from pincal.validate.lack_of_fit import LackOfFit, lack_of_fit
from pincal.validate.outcome import MovedParameter, NoiseRecord, StationRecord, noise_key


@dataclass(frozen=True)
class UnseenErrors:
    """Errors of one station at rows that a fit has not seen.

    Attributes:
        sizes: unit ("mm", ...) -> shape (N,), their magnitudes.
        shares: shape (N,), weight of each in statistics.
        poses: number of different poses.
    """

    sizes: Mapping[str, np.ndarray]
    shares: np.ndarray
    poses: int

    @classmethod
    def of(cls, sizes: Mapping[str, np.ndarray], poses: int) -> UnseenErrors:
        """Return errors of equal weight."""
        return cls(sizes, np.ones(len(next(iter(sizes.values()), ()))), poses)


@dataclass(frozen=True)
class AssessedStation:
    """A station of a calibration, to be assessed.

    Attributes:
        fit: the fit of all stations.
        k: index of the station.
        rows: its rows.
        validated: errors of all stations by fits without their folds; None without them.
        left_out: its errors by the model of the other stations; empty unless that was asked for.
    """

    fit: ModelFit
    k: int
    rows: StationRows
    validated: Validated | None
    left_out: LeftOut

    @property
    def name(self) -> str:
        """Its name in the fit."""
        return self.fitted.name

    @property
    def fitted(self) -> Station:
        """The calibrated model over the fitted rows."""
        return self.fit.problem.stations[self.k]

    @cached_property
    def held(self) -> Station | None:
        """The calibrated model over the held-out rows; None without any."""
        return self.rows.held(self.fit)

    @property
    def parts(self) -> dict[str, Station]:
        """The fitted rows, "train", and the held-out ones, "test", if there are any."""
        return {"train": self.fitted} | ({} if self.held is None else {"test": self.held})

    @property
    def blocks(self) -> slice:
        """Its blocks of readings among all."""
        return self.fit.problem.block_spans[self.k]

    @property
    def weights(self) -> np.ndarray:
        """Robust weights of the fitted rows, shape (N,)."""
        return self.fit.solution.weights[self.fit.problem.rows[self.k]]

    @property
    def free(self) -> np.ndarray:
        """Which of the station's parameters were fitted, shape (P,)."""
        return np.asarray(self.fit.solution.free[self.fit.problem.places[self.k]])

    @property
    def values(self) -> dict[str, np.ndarray]:
        """Its parameters with only base and tool fitted ("nominal"), and "calibrated"."""
        places = self.fit.problem.places[self.k]
        return {"nominal": self.fit.nominal.values[places], "calibrated": self.fit.values[places]}

    @property
    def as_measured(self) -> Measurements:
        """The fitted rows as they were measured, each reading a row."""
        return self.rows.measured[0]

    @cached_property
    def counted(self) -> np.ndarray:
        """Which of the readings as measured are no outliers, a mask of shape (N,)."""
        return np.asarray(self.rows.by_row(self.weights) > 0.0)

    @cached_property
    def poses(self) -> list[np.ndarray]:
        """Pose numbers of the fitted rows as measured, and of the held-out ones."""
        return replicate_groups(self.rows.measured, within=SCATTER)

    @property
    def outliers(self) -> list[int]:
        """Lines of the rejected rows, and of wrong readings of poses with others."""
        rejected = self.as_measured.rows[~self.counted]
        return sorted([*rejected.tolist(), *self.rows.wrong])

    # Errors

    def fitted_errors(self, model: str) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return the error magnitudes of the fitted readings that are no outliers, by unit, and
        their shares.
        """
        station = self.fitted
        if self.rows.train is not self.as_measured:
            station = self.fit.readings(self.as_measured, station=self.name)
        sizes = pose_error_sizes(station, self.values[model])
        return {unit: of[self.counted] for unit, of in sizes.items()}, self.rows.share[self.counted]

    @property
    def unseen(self) -> UnseenErrors | None:
        """The errors of the calibrated model at rows that no fit has seen; None without any."""
        fitted, held = (len(np.unique(poses)) for poses in self.poses)
        if self.left_out.sizes:
            by_others = self.left_out.sizes["calibrated"]
            return UnseenErrors.of({unit: np.asarray(of) for unit, of in by_others.items()}, fitted)
        if self.validated is not None:
            part = self.validated.lead[self.k]
            shares = part.share[part.counted]
            return UnseenErrors(part.counted_sizes, shares, fitted) if len(shares) else None
        if (station := self.held) is None:
            return None
        return UnseenErrors.of(pose_error_sizes(station, self.values["calibrated"]), held)

    def _errors(self) -> dict[str, dict[str, dict[str, float]]]:
        """Return its errors, by model and part."""
        found = {
            model: {part: error_summary(at, values) for part, at in self.parts.items()}
            for model, values in self.values.items()
        }
        for model, by_part in found.items():
            # Readings of a station that were never left out have no such errors.
            if self.validated is not None and (of := self.validated.at_station(self.k, model)):
                by_part["test"] = of
        return found

    # Replicates

    @cached_property
    def _replicates(self) -> list[Replicates]:
        """The rows with repeated poses, fitted and held out; empty without any."""
        together = np.concatenate(self.poses)
        if len(np.unique(together)) == len(together):
            return []
        found = []
        masks = (self.counted, np.ones(len(self.rows.measured[1]), bool))
        parts = zip(("train", "test"), self.rows.measured, self.poses, masks, strict=True)
        for part, table, poses, counted in parts:
            if part in self.parts:
                over = self.fit.readings(table, station=self.name)
                found.append(Replicates(part, table, over, poses, counted))
        return found

    @cached_property
    def lack_of_fit(self) -> LackOfFit | None:
        """The residuals against the scatter of visits of the same poses; None without any."""
        if not self._replicates:
            return None
        solution = self.fit.solution
        is_alone = len(self.fit.problem.stations) == 1
        found = lack_of_fit(
            by_visit(self.fit, self.name, self._replicates),
            self.values["calibrated"],
            solution.sigma[self.blocks],
            spent=solution.effective if is_alone else spent_at(self.fit, self.k),
        )
        is_revisited = any(plan_of(part.table).is_revisited for part in self._replicates)
        # Readings within stops show the instrument's noise alone: what exceeds it may be the
        # arrival of the drives.
        return None if found is not None and found.is_significant and not is_revisited else found

    @cached_property
    def iso9283(self) -> dict[str, Any] | None:
        """Accuracy and repeatability by ISO 9283; None without repeated poses.

        Accuracy is that at poses which a fit has not seen, where there are any.
        """
        if not self._replicates:
            return None
        validated = self.validated
        if validated is None or len(validated.lead[self.k].counted) != len(self.as_measured):
            return iso9283(self._replicates, self.values)
        unseen = {model: validated.leading(model)[self.k].residuals for model in validated.of_model}
        known = np.all([np.isfinite(of).all(axis=0) for of in unseen.values()], axis=0)
        predicted = replace(self._replicates[0], part="test", counted=self.counted & known)
        return iso9283([predicted], self.values, residuals=unseen)

    @cached_property
    def repeatability(self) -> ScatterByLevel | None:
        """How its readings scatter, level by level; None where none was repeated."""
        if self.rows.train is self.as_measured:
            return None
        as_read = self.fit.readings(self.as_measured, station=self.name)
        return scatter_by_level(self.fit.alone[self.k], as_read, plan_of(self.as_measured))

    # Findings

    def on_fitted_rows(self) -> Iterator[Caveat]:
        """Yield the findings on the fitted rows: outliers, and their order."""
        yield from findings_on_outliers(
            self.fitted,
            self.values["calibrated"],
            self.free,
            table=self.rows.train,
            rejected=self.weights == 0.0,
            lines=self.outliers,
        )
        yield from findings_on_order(self.fitted)

    def on_held_out_rows(self) -> Iterator[Caveat]:
        """Yield the findings on the rows that were held out for good."""
        yield from findings_on_held_out(self.held, self.values["calibrated"], self.rows.test)

    def on_unseen_poses(self) -> Iterator[Caveat]:
        """Yield the findings on poses that are predicted far off by fits without them."""
        if self.validated is None:
            return
        found = self.validated.lead[self.k]
        if found.counted.any():
            is_of_readings = len(found.counted) == len(self.as_measured)
            table = self.as_measured if is_of_readings else self.rows.train
            sizes = next(iter(found.counted_sizes.values()))
            yield from far_off(sizes, table.select(found.counted), self.rows.name)

    def on_replicates(self, p_value: float | None) -> list[Caveat]:
        """Return the findings on replicates, given the p-value of the declared noise."""
        found = findings_on_replicates(self.lack_of_fit, p_value)
        return [replace(one, station=self.rows.name) for one in found]

    def on_visits(self) -> Iterator[Caveat]:
        """Yield the findings on what changed between visits of the same poses."""
        yield from findings_on_visits(self.fit, self.k, self.rows, self.lack_of_fit)

    # Record

    def record(
        self, robots: Sequence[FittedRobot], moves: Sequence[MovedParameter]
    ) -> StationRecord:
        """Return its record among several stations.

        Args:
            robots: the fitted robot at each of the stations alone.
            moves: parameters that differ between the stations, with their values here.
        """
        error = self._errors()
        fitted, held = map(len, self.rows.measured)
        is_validated = self.validated is not None and "test" in error["calibrated"]
        found: StationRecord = {
            "name": self.rows.name,
            "kind": self.fitted.sensor.kind,
            "rows": {"train": fitted, "test": fitted if is_validated else held},
            "noise": noise_of(self.fit, self.blocks),
            "outliers": self.outliers,
            "error": error,
        }
        displacement = moved(robots[0], robots[self.k]).instrument if self.k else None
        if displacement is not None:
            found["moved_mm"] = 1e3 * displacement
        if sizes := self.left_out.sizes:
            found["left_out"] = error_statistics([sizes["calibrated"]])
            found["left_out_geometric"] = error_statistics([sizes["geometric"]])
        if moves:
            found["parameters"] = list(moves)
        if self.iso9283 is not None:
            found["iso9283"] = self.iso9283
        if self.lack_of_fit is not None:
            found["lack_of_fit"] = self.lack_of_fit
        if self.repeatability is not None:
            found["repeatability"] = self.repeatability
        return found


def noise_of(fit: ModelFit, blocks: slice = slice(None)) -> NoiseRecord:
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
    repeated = _repeated_sigma(fit)
    found: dict[str, list[tuple[float, float]]] = {}
    is_declared: dict[str, bool] = {}
    each = list(zip(zip(of_blocks, repeated, strict=True), rows, strict=True))[blocks]
    for ((block, sigma, declared, estimated), scatter), n in each:
        weight = float(n * block.size)
        name = noise_key(block.unit)
        used = float(sigma if declared is None else declared)
        found.setdefault(name, []).append((used, weight))
        found.setdefault(f"residual_{name}", []).append((float(estimated), weight))
        if scatter > 0.0:
            found.setdefault(f"repeated_{name}", []).append((scatter, weight))
        is_declared[name] = is_declared.get(name, True) and declared is not None
    noise = {}
    for name, sizes in found.items():
        values, weights = np.array(sizes).T
        noise[name] = float(
            values[0] if len(values) == 1 else np.sqrt(np.average(values**2, weights=weights))
        )
    source = "declared" if fit.is_declared else "estimated"
    stated_names = [name for name, is_stated in is_declared.items() if is_stated]
    return cast(NoiseRecord, {"source": source, "declared": stated_names, **noise})


def _repeated_sigma(fit: ModelFit) -> list[float]:
    """Return by what repeated readings scatter, for each block of readings; 0 where none are."""
    found: list[float] = []
    for station, _, blocks in fit.stations:
        scatter = fit.scatter.get(station.name)
        size = blocks.stop - blocks.start
        if scatter is None:
            found += [0.0] * size
            continue
        is_known = (scatter.within_degrees > 0.0) | (scatter.between_degrees > 0.0)
        found += np.where(is_known, np.sqrt(scatter.of_row(1.0)), 0.0).tolist()
    return found
