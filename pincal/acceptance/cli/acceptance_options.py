"""Acceptance tests for ``pincal validate``: options, and what is printed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pincal.cli.arguments import option
from pincal.cli.outputs import echo_notes, print_json
from pincal.cli.quantities import LENGTH
from pincal.cli.tested_rows import TestedRows
from pincal.errors import BadInputError, Exit, MeasurementError

if TYPE_CHECKING:
    from pincal.acceptance.lengths import Acceptance, Contacts, Permitted
    from pincal.calibration.validation import Validation
    from pincal.result_table import Table

_EXAMPLE = "0.2mm or 0.1mm+0.05mm/m"


@dataclass(frozen=True, kw_only=True)
class AcceptanceOptions(TestedRows):
    """An acceptance test by calibrated lengths."""

    acceptance: Path | None = option(
        "Test the lengths between sockets that this table gives (first, second, distance, and "
        "sigma if known) after ISO 10360-12: pass, fail or undecided.",
        metavar="LENGTHS.csv",
    )
    mpe: str | None = option(
        f"Maximum permissible error of a length, such as {_EXAMPLE}.", metavar="MPE"
    )
    mpe_location: float | None = option(
        "Maximum permissible location error L_Dia of a socket held in several articulations.",
        type=LENGTH,
    )

    @property
    def is_wanted(self) -> bool:
        """Whether the rows are an acceptance test."""
        given = (self.acceptance, self.mpe, self.mpe_location)
        if self.acceptance is None and any(value is not None for value in given):
            raise click.UsageError(
                "--mpe and --mpe-location are limits of --acceptance LENGTHS.csv; give that as well"
            )
        if self.acceptance is not None and self.mpe is None:
            raise click.UsageError(
                f"--acceptance: no limit; expected the maximum permissible error, --mpe {_EXAMPLE}"
            )
        return self.acceptance is not None

    def judge(self, found: Sequence[Validation], *, as_json: bool, quiet: bool) -> Exit:
        """Print whether the lengths are permitted."""
        from pincal.acceptance.lengths import acceptance
        from pincal.measure.points_table import read_distances
        from pincal.notes import doubts_first

        assert self.acceptance is not None
        assert self.mpe is not None
        outcome = acceptance(
            _contacts(found),
            read_distances(self.acceptance),
            _permitted(self.mpe),
            permitted_location=self.mpe_location,
        )
        notes = doubts_first([note for each in found for note in each.notes])
        if as_json:
            from msgspec import to_builtins

            print_json(outcome.to_dict() | {"warnings": to_builtins(notes)})
        else:
            _print(outcome)
        echo_notes(notes, quiet=quiet)
        return Exit.INACCURATE if outcome.outcome == "fail" else Exit.DONE


def _permitted(text: str) -> Permitted:
    from pincal.acceptance.lengths import Permitted
    from pincal.measure.instruments import mpe_terms

    try:
        found = Permitted(*mpe_terms(text))
    except ValueError:
        raise BadInputError(f"--mpe {text!r}; expected a length, such as {_EXAMPLE}") from None
    if not found.constant + found.per_metre > 0.0:
        raise BadInputError(f"--mpe {text!r}; expected more than 0")
    return found


def _contacts(found: Sequence[Validation]) -> Contacts:
    """Return the contacts of all tables; of several tables, sockets of each are its own."""
    import numpy as np

    from pincal.acceptance.lengths import Contacts

    (first, *others) = found
    if others:
        raise BadInputError("--acceptance judges one table; give its rows as one, not several")
    names = first.table.point_names
    if names is None or not first.station.sensor.is_of_joints:
        raise MeasurementError(
            f"{first.table.source}: rows of {first.table.kind}; expected contacts of the tool "
            "point with the ends of the lengths, named in the column socket"
        )
    conditions = first.station.conditions
    poses = first.model.model.predict(first.model.model_values, conditions)
    covariance = first.model.covariance_of(conditions)
    return Contacts(
        seat=np.asarray(names),
        position=poses[:, :, 3],
        covariance=covariance.matrix.reshape(len(poses), 3, len(poses), 3),
        noise=_noise_of_a_contact(first),
        source=first.table.source,
    )


def _noise_of_a_contact(found: Validation) -> float:
    """Return the noise of one coordinate of a contact [m]: that of a calibration by contacts; 0 of
    any other, whose noise is another instrument's.
    """
    is_known = found.model.sensor_kind == found.table.kind
    return float(found.model.sigma[0]) if is_known else 0.0


def _print(found: Acceptance) -> None:
    from pincal.cli.progress import console
    from pincal.result_table import hanging

    out = console()
    out.print(_length_table(found))
    if found.locations:
        out.print(_location_table(found))
    within = sum(each.within_stated for each in found.lengths)
    out.print(
        hanging(
            "stated U:",
            f"{within} of {found.measured} lengths are within the uncertainty (k = 2) that the "
            "model states",
        )
    )
    if found.scope:
        out.print(hanging("scope:", found.scope))
    out.print(hanging("acceptance:", _VERDICTS[found.outcome]))


_VERDICTS = {
    "pass": "PASS: every error is proven to be within its limit (ISO 14253-1)",
    "fail": "FAIL: an error is proven to exceed its limit (ISO 14253-1)",
    "undecided": "UNDECIDED: an error is closer to its limit than the uncertainty of the test; "
    "use a better calibrated length, or agree on a rule",
}


def _length_table(found: Acceptance) -> Table:
    from pincal.result_table import Column, Kind, Table
    from pincal.units import fixed

    columns = (
        Column("length", kind=Kind.NAME),
        *(
            Column(name, "mm", Kind.NUMBER, fixed(4))
            for name in ("calibrated", "mean error", "worst error", "U (k = 2)", "MPE")
        ),
        Column("times", kind=Kind.NUMBER, show=str),
        Column("", kind=Kind.LABEL),
    )
    rows = tuple(
        (
            f"{each.length.first} {each.length.second}",
            1e3 * each.length.length,
            1e3 * float(each.errors.mean()),
            1e3 * each.worst,
            each.to_dict()["U_mm"],
            1e3 * each.permitted,
            len(each.errors),
            each.outcome,
        )
        for each in found.lengths
    )
    return Table("Calibrated lengths (ISO 10360-12, E_Uni)", columns, rows)


def _location_table(found: Acceptance) -> Table:
    from pincal.result_table import Column, Kind, Table
    from pincal.units import fixed

    columns = (
        Column("socket", kind=Kind.NAME),
        Column("articulations", kind=Kind.NUMBER, show=str),
        *(Column(name, "mm", Kind.NUMBER, fixed(4)) for name in ("L_Dia", "MPE")),
        Column("", kind=Kind.LABEL),
    )
    rows = tuple(
        (each.seat, each.contacts, 1e3 * each.diameter, 1e3 * each.permitted, each.outcome)
        for each in found.locations
    )
    return Table("Articulated location (ISO 10360-12, L_Dia)", columns, rows)
