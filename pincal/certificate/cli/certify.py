"""``pincal certificate``: a sheet to sign, and the same as a digital calibration certificate."""

from __future__ import annotations

import datetime
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pincal.cli.arguments import Output, argument, group, option, verb
from pincal.cli.common import GeneralOptions
from pincal.cli.identity_options import HEADING, IdentityOptions
from pincal.cli.outputs import echo_notes, print_json
from pincal.errors import Exit, OutputError, printable
from pincal.identity import LONGEST_ENTRY

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pincal.certificate.contents import Certificate

PAGE_FILE = "certificate.html"
DCC_FILE = "dcc.xml"
_EXAMPLES = """
Examples:
  pincal certificate results/model.json --out certificate
  pincal certificate results --out results --set "id.laboratory=Example Ltd" --set id.country=DE

DIR then holds certificate.html, one page of A4 to print and sign, and dcc.xml, the same as a
digital calibration certificate of PTB. Laboratory, customer and country that neither --set nor the
model states are taken from the cell file; the rest is marked as not stated.
"""


def _day(text: str) -> datetime.date:
    """Return a day."""
    with suppress(ValueError):
        found = datetime.date.fromisoformat(text)
        if found.isoformat() == text:
            return found
    raise click.BadParameter(f"{text!r}; expected a day as YYYY-MM-DD")


def _number(text: str) -> str:
    """Return the number of a certificate, which has to fit on a line of the sheet."""
    number = text.strip()
    if len(number) > LONGEST_ENTRY or not number.isprintable():
        raise click.BadParameter(
            f"{printable(number, LONGEST_ENTRY)!r}; expected a line of text of at most "
            f"{LONGEST_ENTRY} characters"
        )
    return number


@dataclass(frozen=True, kw_only=True)
class CertificateArguments:
    """Arguments of certificate."""

    source: Path = argument(
        "MODEL.json|DIR",
        "Calibrated model in the folder of its results, or a folder that calibrate, discover or "
        "measure wrote.",
    )
    out: Path | None = option(
        "Folder for the certificate.",
        metavar="DIR",
        type=Output(),
        words="that of what is certified",
    )
    number: str = option(
        "Number of the certificate.",
        "",
        metavar="NUMBER",
        words="from the file's checksum",
        type=_number,
    )
    issued: datetime.date | None = option(
        "Day on which it is issued.", metavar="YYYY-MM-DD", words="today", type=_day
    )
    identity: IdentityOptions = group(HEADING)
    general: GeneralOptions = group("General")

    @property
    def folder(self) -> Path:
        """Where the certificate is written."""
        beside = self.source if self.source.is_dir() else self.source.parent
        return beside if self.out is None else self.out


@verb(CertificateArguments, examples=_EXAMPLES, cell="read issuer")
def certificate(arguments: CertificateArguments) -> Exit:
    """Certify a calibrated robot, or a measured part.

    The figures are those of result.json or measured.json; nothing is computed anew but the budget
    of a robot.
    """
    found = _certificate(arguments)
    _write(arguments.folder, found)
    if arguments.general.as_json:
        contents = {"number": found.number, "out": str(arguments.folder)}
        print_json(contents | {"not_stated": list(found.lacking)})
    else:
        for doubt in found.doubts:
            click.echo(f"doubt: {doubt}")
        click.echo(f"{found.title}: {found.item}, No. {found.number}")
        click.echo(f"written to {arguments.folder}: {PAGE_FILE} {DCC_FILE}")
    echo_notes(_notes(found), quiet=arguments.general.quiet)
    return Exit.DONE


def _certificate(arguments: CertificateArguments) -> Certificate:
    """Return the certificate of what the command line names."""
    from pincal.certificate.contents import Issue
    from pincal.certificate.of_measured import MEASURED, certificate_of_measured
    from pincal.certificate.of_model import certificate_of_model
    from pincal.io.result_folder import MODEL

    day = arguments.issued or datetime.datetime.now(tz=datetime.UTC).date()
    source = arguments.source
    stated = arguments.identity.without_cell
    issue = Issue(number=arguments.number, day=day, usual=arguments.identity.of_cell)
    if source.name == MEASURED and source.is_file():
        return certificate_of_measured(source.parent, stated, issue)
    if not source.is_dir():
        return certificate_of_model(source, stated, issue)
    if (source / MODEL).is_file() and not (source / MEASURED).is_file():
        return certificate_of_model(source / MODEL, stated, issue)
    return certificate_of_measured(source, stated, issue)


def _write(folder: Path, found: Certificate) -> None:
    """Write both files; other files of the folder are kept, as it may be that of the results."""
    from pincal.atomic import write_atomic
    from pincal.certificate.certificate_page import certificate_page
    from pincal.certificate.dcc import digital_certificate

    contents = {PAGE_FILE: certificate_page(found).encode(), DCC_FILE: digital_certificate(found)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{folder}: can't write here ({error.strerror}); choose another --out"
        ) from None
    for name, content in contents.items():
        write_atomic(folder / name, content, advice="choose another --out")


def _notes(found: Certificate) -> Iterator[str]:
    """Yield what a certificate needs and the user has not stated."""
    if found.lacking:
        keys = ", ".join(f"id.{key}" for key in found.lacking)
        yield f"not stated, and marked so: {keys}; --set KEY=VALUE states them"
