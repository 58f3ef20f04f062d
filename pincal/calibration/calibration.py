"""One calibration from tables to result: check, fit, validate."""

from __future__ import annotations

import html
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from pincal.calibration.agreed import fit_agreed
from pincal.calibration.benefit import without_harm
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.held_out import (
    HeldBack,
    LeftOut,
    SplitBy,
    StationRows,
    Validated,
    leave_out_stations,
    require_several,
)
from pincal.calibration.result import Result, result_of
from pincal.calibration.result_tables import error_table
from pincal.calibration.screened import screened
from pincal.calibration.stated import stated
from pincal.calibration.stepping import step_notes, with_steps
from pincal.errors import BadInputError, warn
from pincal.identify.calibrate import Tables, tables_of
from pincal.identify.fit import ModelFit
from pincal.identify.folds import Folds
from pincal.identify.mass_error import with_masses_unsure
from pincal.identify.options import Options
from pincal.measure.admit import admit, noted, unobservable_notes
from pincal.measure.measurements import Measurements
from pincal.notes import Note, doubts_first
from pincal.robot.robot import Robot
from pincal.sensors.setup import Setup
from pincal.validate.accuracy import leading_unit
from pincal.validate.clock_jumps import SteppingClocksError

log = logging.getLogger(__name__)


@dataclass(frozen=True, repr=False)
class Calibration:
    """A calibration with its validation.

    Attributes:
        robot: the arm.
        stations: the rows of each station, fitted and held out.
        fit: the calibrated robot.
        result: parameters, errors, warnings.
        notes: the warnings among them that are on robot and tables, not on the fit.
        validated: the errors of the fitted readings by fits without their folds; None where rows
            were held out for good, or whole stations in turn.
    """

    robot: Robot
    stations: tuple[StationRows, ...]
    fit: FittedRobot
    result: Result
    notes: tuple[Note, ...] = ()
    validated: Validated | None = None

    def __repr__(self) -> str:
        rows = self.result.rows
        errors = self.result.error["calibrated"]
        found = errors["test" if "test" in errors else "train"]
        mean = found[f"mean_{(unit := leading_unit(found))}"]
        counts = f"{rows['train']} rows fitted" + (
            f", {rows['test']} held out" if self.validated is None else ""
        )
        return f"Calibration({self.robot.name!r}: {counts}, mean error {mean:.4g} {unit})"

    def _repr_html_(self) -> str:
        doubts = "".join(
            f"<p><b>doubt: {html.escape(note.text)}</b></p>" for note in self.result.doubts
        )
        errors = error_table(self.result.error).to_html()
        parameters = self.fit.parameters.to_html()
        return f"{doubts}<p>{html.escape(repr(self))}</p>{errors}{parameters}"

    @property
    def station(self) -> StationRows:
        """The rows of the only station; BadInputError if there are several."""
        if len(self.stations) > 1:
            names = ", ".join(rows.name for rows in self.stations)
            raise BadInputError(
                f"this needs a single station, and there are several: {names}; use the "
                "rows of one station"
            )
        return self.stations[0]

    @property
    def train(self) -> Measurements:
        """Fitted rows of the only station."""
        return self.station.train

    @property
    def test(self) -> Measurements:
        """Held-out rows of the only station; may be empty."""
        return self.station.test

    def n_poses(self, *parts: str) -> int:
        """Return the number of poses, each with one reading or more, of "train",
        "test", or both.
        """
        q = np.vstack(
            [getattr(rows, part).q for rows in self.stations for part in parts or ("train", "test")]
        )
        return len(np.unique(q, axis=0))


def run_calibration(
    robot: Robot,
    measurements: Tables,
    options: Options | None = None,
    *,
    test_fraction: float = 0.0,
    split: SplitBy = "both",
    seed: int = 0,
    holdout: Tables | None = None,
    executor: Executor | None = None,
) -> Calibration:
    """Check tables, calibrate on all rows, and state errors by cross-validation: each pose
    predicted by a fit without it.

    The covariance includes that masses in a URDF are a few per cent off, which
    :func:`pincal.calibrate` takes as exact.

    Args:
        robot: the arm.
        measurements: one table or several, as :func:`pincal.calibrate` takes them.
        options: how to calibrate.
        test_fraction: part of each station's poses to hold out for good instead; ignored with
            ``holdout``.
        split: how poses are divided into folds, or chosen; with "both" each pose is predicted by a
            fit without its region of joint space and by one without its stretch of consecutive rows
            (of several sessions, also without its session), the headline being the way that is
            predicted worse; with "station" each station in turn is predicted by a model of the
            others, only its own frames fitted to it.
        seed: of the division.
        holdout: other measurements to validate on; then all rows of ``measurements`` are fitted. Of
            several stations the rows name theirs.
        executor: fits the models that leave a station out; default: sequentially, here.

    Raises:
        BadInputError: if tables and robot don't match, or rows are too few.
        IdentificationError: if nothing can be identified.
    """
    begun = time.perf_counter()
    held_back = HeldBack(test_fraction=test_fraction, split=split, seed=seed, holdout=holdout)
    fitted = fit_admitted(robot, measurements, options, held_back)
    log.info("assessing the fit")
    fitted = replace(fitted, fit=with_masses_unsure(without_harm(fitted.fit)))
    left_out: Iterable[LeftOut] = ()
    if split == "station":
        left_out = leave_out_stations(
            fitted.robot, fitted.admitted, fitted.options, executor=executor
        )
    validated = Validated.of(fitted.fit, fitted.stations, fitted.folds)
    result = result_of(
        fitted.fit,
        fitted.stations,
        notes=fitted.notes,
        left_out=tuple(left_out),
        validated=validated,
    )
    result = replace(result, seconds=time.perf_counter() - begun)
    calibrated, result = stated(fitted.fit, result, result.verdict_of())
    return Calibration(fitted.robot, fitted.stations, calibrated, result, fitted.notes, validated)


@dataclass(frozen=True)
class FittedTables:
    """A fit to tables that were checked, not yet assessed.

    Attributes:
        robot: the arm, its description perhaps corrected.
        stations: the rows of each station.
        fit: the calibrated model.
        notes: on robot and tables.
        folds: the division of the fitted poses by which errors are stated; None where rows were
            held out for good, or whole stations in turn.
        admitted: the tables as they were admitted, by station.
        options: how they were fitted.
    """

    robot: Robot
    stations: tuple[StationRows, ...]
    fit: ModelFit
    notes: tuple[Note, ...]
    folds: Folds | None
    admitted: dict[str, Measurements]
    options: Options


def fit_admitted(
    robot: Robot,
    measurements: Tables,
    options: Options | None,
    held_back: HeldBack,
) -> FittedTables:
    """Check tables and fit them; arguments and errors as for :func:`run_calibration`."""
    options = Options() if options is None else options
    tables = tables_of(measurements)
    others = held_back.others
    if held_back.split == "station":
        require_several(tables)
    setup_of = _setups(options)
    admitted = admit(robot, tables, setup_of, holdout=others)
    with noted() as split_notes:
        parts = held_back.divided(robot, admitted.tables, setup_of)
    trained = {part.name: part.measured[0] for part in parts}
    try:
        agreed = fit_agreed(robot, admitted.tables, options, trained=trained)
    except SteppingClocksError as found:
        return fit_admitted(robot, with_steps(tables, found), options, held_back)
    fit = agreed.fit
    steps = tuple(step_notes(tables))
    for text in (*agreed.notes, *steps):
        warn(text)
    notes = [*agreed.notes, *steps, *agreed.robot.notes]
    notes += [*dict.fromkeys((*admitted.notes, *split_notes)), *admitted.idle]
    notes += [*unobservable(trained, options), *_on_moment_frame(fit, options.first_frame)]
    return FittedTables(
        robot=agreed.robot,
        stations=_named_as_fitted(fit, parts),
        fit=fit,
        notes=doubts_first(notes),
        folds=held_back.folds(fit.problem),
        admitted=admitted.tables,
        options=options,
    )


def _named_as_fitted(fit: ModelFit, parts: Sequence[StationRows]) -> tuple[StationRows, ...]:
    """Return the rows of the stations without those that the fit left out, by its names."""
    pairs = zip(screened(fit, parts), fit.problem.stations, strict=True)
    return tuple(replace(part, name=at.name) for part, at in pairs)


def _setups(options: Options) -> Callable[[str], Setup]:
    """Return the function that gives the setup of a station by its name."""
    return lambda name: options.at(name).setup


def unobservable(tables: Mapping[str, Measurements], options: Options) -> list[str]:
    """Return the notes on what no station can observe: the sensor of another may observe what that
    of one can't.
    """
    unseen = [
        list(unobservable_notes(table, options.at(name).setup)) for name, table in tables.items()
    ]
    return [note for note in unseen[0] if all(note in other for other in unseen)]


def _on_moment_frame(fit: ModelFit, first: str) -> Iterator[str]:
    """Yield that another convention of moments than the first one was chosen, as it fits better."""
    chosen = fit.options.moment_frame
    if chosen != first:
        yield (
            f"moments are computed as with --moment-frame {chosen}, which fits better than {first}"
        )
