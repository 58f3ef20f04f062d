"""A calibrated model at the place where it is used: the calibrated one, a station of several, or a new one."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import click

from pincal.calibration.calibrated import CalibratedModel
from pincal.calibration.calibrated_robot import load_stations
from pincal.calibration.placing import place_station, without_absent
from pincal.calibration.validation import doubt_of
from pincal.cli.common import PlaceOptions
from pincal.cli.inputs import load_table
from pincal.errors import BadInputError
from pincal.measure.admit import check_table, usable_rows
from pincal.measure.fields import TableOptions
from pincal.measure.measurements import Measurements


@dataclass(frozen=True)
class PlacedModel:
    """A calibrated model at a place.

    Attributes:
        model: the model.
        notes: what the user should know of the place.
        contents: how the place was found, for programs; empty for one of the calibration.
        doubt: why it can't be found: the rows are of another robot; empty if they are not.
    """

    model: CalibratedModel
    notes: tuple[str, ...] = ()
    contents: dict[str, Any] = field(default_factory=dict)
    doubt: str = ""

    def over(self, rows: Measurements) -> PlacedModel:
        """Return the place for some rows: what they lack columns for and belonged to the calibrated station is left out."""
        model, notes = without_absent(self.model, rows)
        return PlacedModel(model, (*self.notes, *notes), self.contents, self.doubt)


def find_place(path: Path, chosen: PlaceOptions, reading: TableOptions) -> PlacedModel:
    """Return the model of a file at the place that the command line asks for.

    Raises:
        BadInputError: if the station is not in the model, none is chosen of several, or rows don't tell a new place.
    """
    if chosen.placement is not None and chosen.station is not None:
        raise click.UsageError("--placement identifies a new pose, --station takes one of the model; give one of them")
    stations = load_stations(path)
    first = next(iter(stations.models.values()))
    if chosen.placement is not None:
        return _placed(first, chosen.placement, reading)
    if chosen.station is not None:
        return PlacedModel(stations.at(chosen.station))
    if len(stations.models) > 1:
        raise BadInputError(
            f"{path}: calibrated at the stations {', '.join(stations.names)}; expected a choice: --station NAME for one of "
            "them, or --placement FEW.csv with some measured rows for a new place"
        )
    return PlacedModel(first)


def _placed(model: CalibratedModel, path: Path, reading: TableOptions) -> PlacedModel:
    robot = model.model.chain.robot
    table = load_table(robot, path, options=replace(reading, shares_log=True))
    check_table(robot, table, minimum=1)
    table = usable_rows(table, model.setup.over(table))
    found = place_station(model, table)
    words = f"placed by {len(table)} rows of {path.name}: {found.moved}"
    contents = {"placement": {"rows": len(table), "ratio": found.misfit.ratio} | found.moved.to_dict()}
    return PlacedModel(found.model, (words, *found.notes), contents, doubt_of(table, found))


def print_doubt(doubt: str, path: Path) -> None:
    """Say on stderr that rows are not of this robot, or it has changed, and what to do."""
    click.echo(
        f"pincal: {doubt}. They belong to another robot, or it has changed since calibration. Check joint columns, units "
        f"and times; then find out what changed: pincal diagnose {path} DATA.csv --out DIR",
        err=True,
    )
