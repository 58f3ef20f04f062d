"""Acceptance tests for ``pincal validate``: options, and what is printed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
    from pincal.acceptance.probing import ProbingErrors
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

    sphere: Path | None = option(
        "Also test probing: a table of joints in which the tool point touches a calibrated sphere, "
        "25 contacts over half of it.",
        metavar="CONTACTS.csv",
    )
    sphere_diameter: float | None = option(
        "Its diameter by its certificate.", type=LENGTH, words="none"
    )
    sphere_u: float = option(
        "Standard uncertainty of its diameter and form.", 0.0, type=LENGTH, words="0"
    )
    probe_radius: float = option(
        "Radius of the ball that touches it, whose centre is the tool point.",
        0.0,
        type=LENGTH,
        words="0, a tip",
    )
    mpe_size: float | None = option(
        "Maximum permissible probing size error P_Size.", type=LENGTH, words="not tested"
    )
    mpe_form: float | None = option(
        "Maximum permissible probing form error P_Form.", type=LENGTH, words="not tested"
    )

    @property
    def is_wanted(self) -> bool:
        """Whether the rows are an acceptance test."""
        given = (self.acceptance, self.mpe, self.mpe_location, self.sphere, *self._of_sphere)
        if self.acceptance is None and any(value is not None for value in given):
            raise click.UsageError(
                "--mpe, --mpe-location and --sphere belong to --acceptance LENGTHS.csv; give that "
                "as well"
            )
        self._check_sphere()
        if self.acceptance is not None and self.mpe is None:
            raise click.UsageError(
                f"--acceptance: no limit; expected the maximum permissible error, --mpe {_EXAMPLE}"
            )
        return self.acceptance is not None

    @property
    def _of_sphere(self) -> tuple[float | None, ...]:
        return (self.sphere_diameter, self.mpe_size, self.mpe_form)

    def _check_sphere(self) -> None:
        """Refuse limits without a sphere, and a sphere without diameter or limit."""
        if self.sphere is None and any(value is not None for value in self._of_sphere):
            raise click.UsageError(
                "--sphere-diameter, --mpe-size and --mpe-form are of --sphere CONTACTS.csv; give "
                "that as well"
            )
        if self.sphere is not None and self.sphere_diameter is None:
            raise click.UsageError(
                "--sphere: no diameter; expected that of its certificate, --sphere-diameter 25mm"
            )
        if self.sphere is not None and self.mpe_size is None and self.mpe_form is None:
            raise click.UsageError(
                "--sphere: no limit; expected --mpe-size, --mpe-form, or both, such as 0.1mm"
            )

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
        probed = self._probed(found[0])
        if probed is not None:
            outcome = replace(outcome, probing=probed)
        notes = doubts_first([note for each in found for note in each.notes])
        if as_json:
            from msgspec import to_builtins

            print_json(outcome.to_dict() | {"warnings": to_builtins(notes)})
        else:
            _print(outcome)
        echo_notes(notes, quiet=quiet)
        return Exit.INACCURATE if outcome.outcome == "fail" else Exit.DONE

    def _probed(self, found: Validation) -> ProbingErrors | None:
        """Return the errors of probing the sphere; None without one."""
        from pincal.acceptance.probing import KnownSphere, probing
        from pincal.cli.inputs import load_table

        if self.sphere is None or self.sphere_diameter is None:
            return None
        model = found.model
        table = load_table(model.model.chain.robot, self.sphere, joints_only=True)
        conditions = model.conditions(table)
        poses = model.model.predict(model.model_values, conditions)
        return probing(
            poses[:, :, 3],
            model.covariance_of(conditions).matrix,
            KnownSphere(self.sphere_diameter, self.sphere_u, self.probe_radius),
            size=self.mpe_size,
            form=self.mpe_form,
            source=str(self.sphere),
        )


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
    if found.probing is not None:
        out.print(_probing_table(found.probing))
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


def _probing_table(found: ProbingErrors) -> Table:
    from pincal.result_table import Column, Kind, Table
    from pincal.units import fixed

    names = ("error", "MPE", "U of the test", "U stated by the model")
    columns = (
        Column("probing", kind=Kind.NAME),
        Column("contacts", kind=Kind.NUMBER, show=str),
        *(Column(name, "mm", Kind.NUMBER, fixed(4)) for name in names),
        Column("", kind=Kind.LABEL),
    )
    of_test = 2e3 * found.sphere.sigma
    lines = (
        ("P_Size", found.size, found.permitted_size, 2e3 * found.stated, found.outcome_of_size),
        ("P_Form", found.form, found.permitted_form, None, found.outcome_of_form),
    )
    rows = tuple(
        (
            name,
            found.points,
            1e3 * error,
            None if limit is None else 1e3 * limit,
            of_test,
            stated,
            outcome or "not tested",
        )
        for name, error, limit, stated, outcome in lines
    )
    return Table("Probing a calibrated sphere (ISO 10360-12)", columns, rows)
