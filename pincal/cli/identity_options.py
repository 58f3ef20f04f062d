"""Identity of a calibration on the command line: stated, or compared with that of a model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import click

from pincal.cli.arguments import option, pair
from pincal.cli.cell_defaults import identity_of_cell
from pincal.errors import BadInputError
from pincal.identity import KEYS, Identity

_PREFIX = "id."
_EXPECTED = "id.KEY=VALUE, such as id.robot=2021300117"
HEADING = "Identity"


def identity_entry(text: str) -> tuple[str, str]:
    """Return key and value of a setting; what states the identity is checked.

    Raises:
        click.BadParameter: if there is no such entry, or the value is none.
    """
    key, value = pair(text, _EXPECTED)
    if key.startswith(_PREFIX):
        try:
            Identity.of({key.removeprefix(_PREFIX): value})
        except BadInputError as error:
            raise click.BadParameter(str(error)) from None
    return key, value


@dataclass(frozen=True, kw_only=True)
class IdentityOptions:
    """What is stated of robot, instrument and circumstances."""

    entries: tuple[tuple[str, str], ...] = option(
        "Set any option by its name, such as noise=0.05mm, or state the identity: which robot it "
        f"is, how it was measured and by whom. Its keys: id. and {', '.join(KEYS)}; anything else "
        "as id.note.NAME.",
        (),
        metavar="KEY=VALUE",
        name="--set",
        type=identity_entry,
    )

    @property
    def given(self) -> Identity:
        """What was stated; of a key given twice the last value."""
        return Identity.of(self._stated)

    @property
    def _stated(self) -> dict[str, str]:
        return {
            key.removeprefix(_PREFIX): value
            for key, value in self.entries
            if key.startswith(_PREFIX)
        }

    @property
    def of_cell(self) -> Identity:
        """What the cell file states, and the command line does not."""
        return Identity.of(identity_of_cell())

    @property
    def without_cell(self) -> Identity:
        """What the command line states."""
        of_cell = identity_of_cell()
        return Identity.of({k: value for k, value in self._stated.items() if k not in of_cell})

    def of_model(self, known: Identity, path: Path) -> Iterator[str]:
        """Yield a note where it can't be checked that a model is of the robot stated, and where
        the robot has another controller now.

        Args:
            known: identity of the model.
            path: its file.

        Raises:
            BadInputError: if the model is of another robot.
        """
        given = self.given
        given.require(known, str(path))
        if given.robot and not known.robot:
            yield (
                f"{path} does not state its robot: it was not checked that it is of "
                f"{given.robot}; pincal update --set id.robot=... or a new calibration states it"
            )
        if given.controller and known.controller and given.controller != known.controller:
            yield (
                f"the controller is {given.controller}, at the calibration it was "
                f"{known.controller}: its mastering and corrections may differ"
            )
