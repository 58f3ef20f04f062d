"""Acceptance tests for ``pincal design``: options, the tables written, and what is printed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from pincal.cli.arguments import option
from pincal.cli.outputs import print_json
from pincal.cli.quantities import LENGTH
from pincal.errors import Exit

if TYPE_CHECKING:
    from pincal.design.acceptance_plan import AcceptancePlan
    from pincal.design.reach import Reach
    from pincal.result_table import Table
    from pincal.robot.robot import Robot


def _lengths(text: str) -> tuple[float, ...]:
    return tuple(LENGTH.convert(part.strip(), None, None) for part in text.split(","))


@dataclass(frozen=True, kw_only=True)
class AcceptancePlanOptions:
    """A plan of an acceptance test."""

    acceptance: Sequence[float] | None = option(
        "Plan the test of calibrated lengths for pincal validate --acceptance: in seven places, "
        "the tool point held in both ends.",
        metavar="LENGTH[,LENGTH...]",
        type=_lengths,
    )
    times: int = option(
        "Contacts with each end in each place.", 3, metavar="N", type=click.IntRange(min=2)
    )
    sphere: float | None = option(
        "Also plan the 25 contacts with a calibrated sphere of this diameter, for pincal validate "
        "--sphere.",
        metavar="DIAMETER",
        type=LENGTH,
    )
    probe_radius: float = option(
        "Radius of the ball that touches it, whose centre is the tool point.",
        0.0,
        type=LENGTH,
        words="0, a tip",
    )


@dataclass(frozen=True, kw_only=True)
class OutputWanted:
    """How a plan is to be written.

    Attributes:
        out: the table of contacts.
        in_degrees: whether joint positions are in degrees.
        as_json: whether the result is printed as JSON.
    """

    out: Path
    in_degrees: bool
    as_json: bool

    @property
    def lengths(self) -> Path:
        """The table of the lengths, beside that of the contacts."""
        return self.out.with_name(f"{self.out.stem}_lengths.csv")

    @property
    def sphere(self) -> Path:
        """The table of the contacts with a sphere, likewise."""
        return self.out.with_name(f"{self.out.stem}_sphere.csv")


def write_acceptance_plan(
    reach: Reach, options: AcceptancePlanOptions, wanted: OutputWanted, *, seed: int
) -> Exit:
    """Write the poses of the contacts, and the table of lengths, to complete by the certificate."""
    from pincal.design.acceptance_plan import plan_acceptance
    from pincal.measure.table import write_table

    assert options.acceptance is not None
    found = plan_acceptance(reach, options.acceptance, times=options.times, seed=seed)
    sphere = _sphere(reach, options, seed)
    q = np.array([contact.q for contact in found.contacts])
    sockets = np.array([contact.socket for contact in found.contacts])
    joints = _joint_columns(reach.robot, q, in_degrees=wanted.in_degrees)
    write_table(wanted.out, joints | {"socket": sockets})
    write_table(
        wanted.lengths,
        {
            "first": np.array([of.first for of in found.lengths]),
            "second": np.array([of.second for of in found.lengths]),
            "distance [mm]": np.array([1e3 * of.length for of in found.lengths]),
        },
    )
    if sphere is not None:
        columns = _joint_columns(reach.robot, sphere[1], in_degrees=wanted.in_degrees)
        write_table(wanted.sphere, columns)
    if wanted.as_json:
        tables = {"out": str(wanted.out), "lengths_table": str(wanted.lengths)}
        if sphere is not None:
            tables["sphere_table"] = str(wanted.sphere)
        print_json(found.to_dict() | tables)
    else:
        _print(found, wanted)
        if sphere is not None:
            _print_sphere(*sphere, wanted)
    return Exit.DONE


def _print_sphere(centre: np.ndarray, q: np.ndarray, wanted: OutputWanted) -> None:
    place = ", ".join(f"{1e3 * axis:.0f}" for axis in centre)
    click.echo(
        f"{len(q)} contacts with a sphere at {place} mm of the base frame written "
        f"to {wanted.sphere}: --sphere {wanted.sphere} --sphere-diameter ..."
    )


def _sphere(
    reach: Reach, options: AcceptancePlanOptions, seed: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the place of the sphere and the poses of its contacts; None without one."""
    from pincal.design.probing_plan import plan_probing

    if options.sphere is None:
        return None
    return plan_probing(reach, 0.5 * options.sphere + options.probe_radius, seed=seed)


def _joint_columns(robot: Robot, q: np.ndarray, *, in_degrees: bool) -> dict[str, np.ndarray]:
    """Return the columns of joint positions, shape (N, n)."""
    found = {}
    for name, kind, values in zip(robot.joint_names, robot.joint_types, q.T, strict=True):
        is_angle = in_degrees and kind == "revolute"
        found[f"{name} [deg]" if is_angle else name] = np.rad2deg(values) if is_angle else values
    return found


def _print(found: AcceptancePlan, wanted: OutputWanted) -> None:
    from pincal.cli.progress import console

    out = console()
    out.print(_table(found))
    click.echo(
        f"{len(found.contacts)} contacts written to {wanted.out}; {wanted.lengths}: enter the "
        "certificate's lengths, and sigma"
    )
    click.echo(
        f"next: pincal validate MODEL.json {wanted.out} --acceptance {wanted.lengths} --mpe LIMIT"
    )


def _table(found: AcceptancePlan) -> Table:
    from pincal.result_table import Column, Kind, Table
    from pincal.units import fixed

    names = [f"{end} {axis}" for end in ("first", "second") for axis in "xyz"]
    columns = (
        Column("length", kind=Kind.NAME),
        Column("", "mm", Kind.NUMBER, fixed(0)),
        *(Column(name, "mm", Kind.NUMBER, fixed(0)) for name in names),
    )
    rows: list[tuple[str | float, ...]] = [
        (f"{of.first} {of.second}", 1e3 * of.length, *map(float, (1e3 * of.ends).ravel()))
        for of in found.lengths
    ]
    return Table("Where to put the lengths, in the base frame", columns, tuple(rows))
