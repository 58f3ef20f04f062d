"""``pincal diagnose`` and ``update``: new rows tested for a change of a calibrated robot, or added
to it.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pincal.cli.arguments import argument, group, option, verb
from pincal.cli.cell_defaults import came_from_cell
from pincal.cli.common import GeneralOptions, TableArguments, model_argument, noise_angle_option
from pincal.cli.identity_options import HEADING, IdentityOptions
from pincal.cli.outputs import echo_notes, print_json, provenance
from pincal.cli.quantities import LENGTH
from pincal.cli.result_place import results_option
from pincal.errors import Exit, IdentificationError, counted
from pincal.io.result_folder import output_folder

if TYPE_CHECKING:
    from pincal.calibration.fitted_robot import FittedRobot
    from pincal.diagnosis.diagnosis_file import DiagnosisFile
    from pincal.diagnosis.robot_diagnosis import Diagnosis
    from pincal.measure.measurements import Measurements
    from pincal.robot.robot import Robot

_SHOWN = ("out", "noise", "noise_angle", "as_json", "quiet")
_DIAGNOSE_EXAMPLES = """
Example:
  pincal diagnose results/model.json new.csv --out diagnosis

DIR then holds diagnosis.json, report.html and model.json: the model in which only what has changed
was re-identified, or the unchanged model; it predicts at the new station.
"""
_UPDATE_EXAMPLES = """
Examples:
  pincal update results/model.json new.csv --out updated
  pincal update results/model.json new.csv --anew transmission_error:joint_1 --out updated
"""


@dataclass(frozen=True, kw_only=True)
class _NewRows:
    """Arguments of both commands."""

    model: Path = model_argument()
    data: Path = argument(
        "NEW.csv",
        "New measurements, or the folder of a session with a tracker; instrument and "
        "target may have moved.",
    )
    table: TableArguments = group("Tables")
    identity: IdentityOptions = group(HEADING)
    general: GeneralOptions = group("General")

    def read(self, robot: Robot) -> Measurements:
        """Return the new measurements; of a session, the readings of positions if there are any."""
        from pincal.cli.inputs import load_table, load_tables
        from pincal.measure.log_reader import reader_of

        if reader_of(self.data) is None:
            return load_table(robot, self.data, options=self.table.options)
        tables = load_tables(robot, [self.data], options=self.table.options)
        return next(
            (table for table in tables.values() if table.sensor and table.sensor.reads_place),
            next(iter(tables.values())),
        )

    def noise_of(self, table: Measurements, declared: float | None) -> float | None:
        """Return the noise of the new readings; that of a cell file holds for rows without one."""
        if table.sigma is not None and came_from_cell("noise"):
            return None
        return declared

    def load_model(self) -> tuple[FittedRobot, tuple[str, ...]]:
        """Return the model, with what was stated on the command line; and notes on that.

        Raises:
            BadInputError: if it is of another robot than stated.
        """
        from pincal.calibration.fitted_robot import load_model

        found = load_model(self.model)
        notes = tuple(self.identity.of_model(found.identity, self.model))
        return replace(found, identity=self.identity.given.over(found.identity)), notes

    @property
    def files(self) -> tuple[Path, ...]:
        """The input files of the result."""
        from pincal.cli.streams import no_streams

        return (self.model, *no_streams().input_files([self.data]))


@dataclass(frozen=True, kw_only=True)
class DiagnoseArguments(_NewRows):
    """Arguments of diagnose."""

    out: Path = results_option("diagnosis")
    alpha: float = option("Probability of a false alarm.", 0.01)
    noise: float | None = option(
        "Noise of one coordinate of the new measurements, if larger than that of the calibration.",
        type=LENGTH,
        words="that of the calibration",
        in_cell=True,
    )
    noise_angle: float | None = noise_angle_option()


@verb(
    DiagnoseArguments,
    examples=_DIAGNOSE_EXAMPLES,
    exits=(Exit.UNDECIDED, Exit.CHANGED),
    shown=("alpha", *_SHOWN),
)
def diagnose_verb(arguments: DiagnoseArguments) -> Exit:
    """Find out whether a calibrated robot has changed, and what.

    Ten to sixty poses are enough: the calibration, with its uncertainty, serves as prior knowledge.
    """
    from pincal.diagnosis.robot_diagnosis import diagnose
    from pincal.notes import doubts_of

    calibrated, unchecked = arguments.load_model()
    table = arguments.read(calibrated.robot_model().model.chain.robot)
    with output_folder(arguments.out) as draft:
        found = diagnose(
            calibrated,
            table,
            alpha=arguments.alpha,
            sigma=arguments.noise_of(table, arguments.noise),
            sigma_orientation=arguments.noise_angle,
        )
        write_diagnosis(draft, found, provenance(arguments.files))
    if arguments.general.as_json:
        print_json(found.report)
    else:
        _print_found(found.found, _next(found.found, arguments))
        click.echo(f"written to {arguments.out}: diagnosis.json model.json report.html")
    echo_notes([*found.found.warnings, *unchecked], quiet=arguments.general.quiet)
    if not found.found.is_judged:
        raise IdentificationError(
            f"not judged: {'; '.join(map(str, doubts_of(found.found.warnings)))}"
        )
    return Exit.CHANGED if found.changed else Exit.DONE


def _next(found: DiagnosisFile, arguments: DiagnoseArguments) -> str:
    """Return the one thing to do next, as a command if there is one."""
    model = shlex.quote(str(arguments.out / "model.json"))
    named = [change for change in found.changes if change.parameters]
    if named:
        use = f"pincal compensate {model} PROGRAM.csv --out corrected.csv"
        return f"{use}  # until {named[0].joint or 'the arm'} is repaired"
    if found.changed or not found.is_judged:
        return "measure more poses, and calibrate again"
    words = shlex.join([str(arguments.model), str(arguments.data)])
    return f"pincal update {words} --out updated  # takes these poses into the model"


def _print_found(found: DiagnosisFile, following: str) -> None:
    """Print the doubts about a diagnosis, what changed, what to do next, and the curves of the
    drives that changed.
    """
    from pincal.cli.progress import console
    from pincal.cli.screen import print_doubts, print_lines
    from pincal.diagnosis.diagnosis_page import curve_table, lines

    print_doubts(found.warnings, console())
    print_lines(lines(found), console(), following=following)
    if found.curves is not None:
        console().print(curve_table(found.curves))


def write_diagnosis(folder: Path, diagnosis: Diagnosis, origin: dict[str, Any]) -> None:
    """Write ``diagnosis.json``, the page and the re-identified model with its origin."""
    from pincal.diagnosis.diagnosis_page import diagnosis_page
    from pincal.io.strict_json import write_json

    replace(diagnosis.model, provenance=origin).save(folder / "model.json")
    write_json(folder / "diagnosis.json", diagnosis.report)
    (folder / "report.html").write_text(
        diagnosis_page(diagnosis, version=origin["pincal"]), encoding="utf-8"
    )


@dataclass(frozen=True, kw_only=True)
class UpdateArguments(_NewRows):
    """Arguments of update."""

    out: Path = results_option("updated")
    noise: float | None = option(
        "Noise of one coordinate of the new measurements.",
        type=LENGTH,
        words="as declared for the calibration, else estimated",
        in_cell=True,
    )
    noise_angle: float | None = noise_angle_option()
    anew: tuple[str, ...] = option(
        "Re-estimate this effect of the model, named as by diagnose; no test for changes is made.",
        (),
        metavar="EFFECT[:JOINT]",
    )


@verb(
    UpdateArguments,
    examples=_UPDATE_EXAMPLES,
    exits=(Exit.UNDECIDED, Exit.CHANGED),
    shown=("anew", *_SHOWN),
)
def update_verb(arguments: UpdateArguments) -> Exit:
    """Add new measurements to a calibrated model permanently.

    The result equals a calibration from old and new rows together, but does not need the old ones.
    Rows of a robot that has changed are refused (exit code 6): see diagnose. With --anew, the named
    effect is re-estimated from its prior.
    """
    from pincal.calibration.day_notes import notes_on_day
    from pincal.diagnosis.model_update import update
    from pincal.validate.accuracy import error_summary

    stations, _ = arguments.load_model()
    table = arguments.read(stations.robot_model().model.chain.robot)
    calibrated = stations.robot_model(table.kind)
    with output_folder(arguments.out) as draft:
        found = update(
            calibrated,
            table,
            sigma=arguments.noise_of(table, arguments.noise),
            sigma_orientation=arguments.noise_angle,
            anew=arguments.anew,
        )
        replace(found, provenance=provenance(arguments.files)).save(draft / "model.json")
    error = error_summary(found.readings(table), found.values)
    if arguments.general.as_json:
        print_json({"rows": len(table), "error": error, "out": str(arguments.out)})
    else:
        anew = f", {', '.join(arguments.anew)} re-estimated" if arguments.anew else ""
        click.echo(
            f"{counted(len(table), 'row')} added{anew}; mean error {error['mean_mm']:.4f} mm"
        )
        click.echo(f"written to {arguments.out}: model.json")
    echo_notes(notes_on_day(calibrated, table), quiet=arguments.general.quiet)
    return Exit.DONE
