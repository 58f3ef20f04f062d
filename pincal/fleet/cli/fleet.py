"""``pincal fleet learn`` and ``check``: a type learned from its machines, and changes
of machines.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pincal.cli.arguments import Output, argument, group, option, verb
from pincal.cli.common import GeneralOptions, base_option, tip_option, verbose_option
from pincal.cli.outputs import print_json, provenance
from pincal.cli.quantities import LENGTH
from pincal.errors import BadInputError, Exit, counted
from pincal.fleet.cli.fleet_store import (
    fleet_add,
    fleet_calibrate,
    fleet_diagnose,
    fleet_discover,
    machine_names,
    store_argument,
)
from pincal.thresholds import Count

if TYPE_CHECKING:
    from rich.console import Console

    from pincal.calibration.fitted_robot import FittedRobot
    from pincal.fleet.history import FleetHistory, Visit
    from pincal.fleet.machines import Machine
    from pincal.fleet.robot_type import Learned, RobotType
    from pincal.fleet.summary import AtTool

# Number of parameters that are listed, and lines of what is said in brief.
_PARAMETERS: Count = 8
_LINES: Count = 14
_LEARN_EXAMPLES = """
Examples:
  pincal fleet learn r1/model.json r2/model.json r3/model.json --out type.json --report type.html
  pincal fleet learn fleet-store --out type.json --error 0.1mm
  pincal fleet learn */model.json --out type.json --share site.parquet     \
# for another site, without names
  pincal fleet learn */model.json other-site.parquet --out type.json       # there
Then:
  pincal calibrate robot.urdf few.csv --type type.json --out results
"""
_CHECK_EXAMPLES = """
Example:
  pincal fleet calibrate robot.urdf fleet-store --type type.json --noise 0.05mm
  pincal fleet check type.json fleet-store --report fleet.html
"""


@dataclass(frozen=True, kw_only=True)
class LearnArguments:
    """Arguments of fleet learn."""

    machines: tuple[str, ...] = argument(
        "MODEL.json...",
        "Calibrated models, files of information (.json), files of another site "
        "(.parquet), or a store. A machine is named "
        "after its file, or after the folder of a model.json.",
    )
    out: Path = option("The type.", MISSING, metavar="TYPE.json", type=Output(".json"))
    report: Path | None = option(
        "Also write a page with pictures.", metavar="PAGE.html", type=Output(".html")
    )
    share: Path | None = option(
        "Also write the information of each machine, without names, poses and times, for "
        "another site to include in its "
        "type.",
        metavar="SITE.parquet",
        type=Output(".parquet"),
    )
    robot: str | None = option(
        "URDF of the arm, to state differences as motion of the tool.",
        metavar="URDF",
        words="that of the first model.json",
    )
    tip: str | None = tip_option(words="flange or tool at the end of the longest chain")
    base: str | None = base_option()
    error: float | None = option(
        "Predict the number of poses for this accuracy of a further machine.", type=LENGTH
    )
    noise: float = option(
        "Noise of one coordinate for a further machine.", 5e-5, type=LENGTH, words="0.05mm"
    )
    verbose: bool = verbose_option()
    general: GeneralOptions = group("General")


@verb(LearnArguments, examples=_LEARN_EXAMPLES, cell="none")
def fleet_learn(arguments: LearnArguments) -> Exit:
    """Learn a type of robot from its machines.

    Prints how much machines differ, how far the data sheet is off, which machines do not belong,
    and how many poses a further one needs. The type is then prior knowledge for calibrate,
    discover, check and design (--type).
    """
    from pincal.atomic import write_atomic
    from pincal.fleet import summary
    from pincal.fleet.machines import save_machines
    from pincal.fleet.robot_type import learn_type

    machines, model = _machines(arguments.machines)
    learned = learn_type(machines)
    at = _at_tool(learned.type, model, arguments)
    origin = provenance([Path(text) for text in arguments.machines])
    learned.type.save(arguments.out, provenance=origin)
    if arguments.share is not None:
        save_machines(arguments.share, machines)
    if arguments.report is not None:
        from pincal.fleet.fleet_pages import type_page

        write_atomic(arguments.report, type_page(learned, at, version=origin["pincal"]))
    if arguments.general.as_json:
        print_json(summary.plain_type(learned, at, error=arguments.error))
        return Exit.DONE
    _print_type(learned, at, arguments)
    written = [
        str(path) for path in (arguments.out, arguments.share, arguments.report) if path is not None
    ]
    click.echo(f"written to {' '.join(written)}")
    return Exit.DONE


def _at_tool(of: RobotType, first: FittedRobot | None, arguments: LearnArguments) -> AtTool | None:
    """Return what a type moves at the tool, of the arm of the command line or else of the first
    model; None if neither is given.
    """
    from pincal.fleet import summary
    from pincal.model.effects import ELASTIC, GEOMETRIC
    from pincal.robot.robot import Robot

    if arguments.robot is not None:
        robot = Robot.from_urdf(arguments.robot, tip=arguments.tip, base=arguments.base)
        is_elastic = any(parameter.is_compliance for parameter in of.parameters)
        return summary.at_tool(
            of, robot, ELASTIC if is_elastic else GEOMETRIC, noise=arguments.noise
        )
    if first is None:
        return None
    effects = tuple(effect for effect in first.model.effects if effect.scope == "robot")
    return summary.at_tool(of, first.model.chain.robot, effects, noise=arguments.noise)


def _print_type(learned: Learned, at: AtTool | None, arguments: LearnArguments) -> None:
    """Print how machines of a type differ and, if the arm is known, what that moves at the tool."""
    from pincal.cli.progress import console
    from pincal.fleet import summary

    out = console()
    for line in summary.type_lines(learned, at, error=arguments.error):
        click.echo(line)
    if at is not None:
        out.print(summary.effect_summary(at))
    out.print(
        summary.parameter_summary(learned.type, at, most=None if arguments.verbose else _PARAMETERS)
    )
    if summary.strangers(learned.members):
        out.print(summary.member_summary(learned))
    if at is not None:
        out.print(summary.poses_summary(at))
    else:
        click.echo(
            "note: to express this as motion of the tool, the arm must be known: give a "
            "model.json, or --robot URDF"
        )


def _machines(texts: Sequence[str]) -> tuple[list[Machine], FittedRobot | None]:
    """Return the machines of files and stores, and the first model among them.

    Raises:
        BadInputError: for another kind of file, or a model without information.
    """
    from pincal.calibration.fitted_robot import load_model
    from pincal.fleet.jobs import last_model
    from pincal.fleet.machines import Machine, load_machines
    from pincal.fleet.store import open_store
    from pincal.io.strict_json import MODEL_FILE, read_bounded

    names = machine_names([text for text in texts if text.lower().endswith(".json")])
    found = list[Machine]()
    first = None
    for text in texts:
        if "://" in text or Path(text).is_dir():
            store = open_store(text)
            found += [machine for _, machine, _ in store.machines()]
            first = first or last_model(store)
        elif text not in names or b'"pincal-information"' in read_bounded(text, MODEL_FILE)[:100]:
            found += [replace(one, name=names.get(text, one.name)) for one in load_machines(text)]
        else:
            model = load_model(text).robot_model()
            if model.information is None:
                raise BadInputError(
                    f"{text}: written by a version that stored no information matrix; "
                    "calibrate again"
                )
            found = [*found, Machine(names[text], model.information)]
            first = first or model
    return found, first


@dataclass(frozen=True, kw_only=True)
class FleetCheckArguments:
    """Arguments of fleet check."""

    type: Path = argument("TYPE.json", "The type, as written by fleet learn.")
    store: str = store_argument()
    out: Path | None = option("Folder for fleet.json and the page report.html.", metavar="DIR")
    report: Path | None = option(
        "Also write a page: what to look at first.", metavar="PAGE.html", type=Output(".html")
    )
    alpha: float = option("Largest fraction of alarms that may be false, in the long run.", 0.05)
    verbose: bool = verbose_option()
    every: int = option("Days per round of checks.", 7, metavar="N", type=click.IntRange(min=1))
    general: GeneralOptions = group("General")


@verb(FleetCheckArguments, examples=_CHECK_EXAMPLES, exits=(Exit.CHANGED,), cell="none")
def fleet_check(arguments: FleetCheckArguments) -> Exit:
    """Find which machines have changed, what, and since when.

    Option --alpha bounds the fraction of false alarms, however many machines there are and however
    long they are monitored. A change that machines with the same label share is reported as a drift
    of that group.
    """
    from pincal.fleet import summary
    from pincal.fleet.checks import fleet_changes
    from pincal.fleet.jobs import visits_of, without_information
    from pincal.fleet.robot_type import load_type
    from pincal.fleet.store import open_store

    of = load_type(arguments.type)
    store = open_store(arguments.store)
    known, strangers = _since_calibration(visits_of(store))
    found = fleet_changes(of, known, alpha=arguments.alpha, every=arguments.every)
    written = _written(arguments, of, found)
    waiting = len(without_information(store))
    if arguments.general.as_json:
        print_json(summary.plain_history(found))
    else:
        following, notes = _after(arguments, found, strangers, waiting)
        ending = [f"written to {', '.join(map(str, written))}"] if written else []
        print_history(
            found,
            following,
            [*notes, *ending],
            page=arguments.report,
            is_verbose=arguments.verbose,
        )
    return Exit.CHANGED if found.open or found.drifted else Exit.DONE


def _after(
    arguments: FleetCheckArguments, found: FleetHistory, strangers: Sequence[str], waiting: int
) -> tuple[str, list[str]]:
    """Return what to do next, and notes on what did not count.

    Args:
        arguments: of the command.
        found: the fleet's history.
        strangers: machines that were checked and never calibrated.
        waiting: number of tables that are not calibrated yet.
    """
    from pincal.fleet import summary

    command = f"pincal fleet calibrate ROBOT.urdf {arguments.store} --type {arguments.type}"
    tables = f"{counted(waiting, 'table')} of the store"
    following = summary.next_step(found, arguments.store)
    notes = list[str]()
    if strangers:
        notes.append(f"note: ignored: checks of {_some(strangers)}, which have no calibration")
    if waiting and (found.open or found.drifted):
        notes.append(f"note: {tables} not calibrated yet: {command}")
    elif waiting:
        # Where nothing is to be inspected, what waits comes first: it may be the latest checks.
        following = f"Calibrate {tables}: {command}"
    return following, notes


def _written(arguments: FleetCheckArguments, of: RobotType, found: FleetHistory) -> list[Path]:
    """Write what was found where it is wanted, and return where."""
    from pincal.atomic import write_atomic
    from pincal.fleet import summary
    from pincal.fleet.fleet_pages import fleet_page
    from pincal.io.result_folder import output_folder

    written = [path for path in (arguments.out, arguments.report) if path is not None]
    if not written:
        return []
    page = fleet_page(of, found, alpha=arguments.alpha, version=provenance([])["pincal"])
    if arguments.report is not None:
        write_atomic(arguments.report, page)
    if arguments.out is not None:
        history = json.dumps(summary.plain_history(found), indent=2, allow_nan=False)
        with output_folder(arguments.out) as draft:
            (draft / "fleet.json").write_text(f"{history}\n", encoding="utf-8")
            (draft / "report.html").write_text(page, encoding="utf-8")
    return written


def _since_calibration(visits: Iterable[Visit]) -> tuple[list[Visit], list[str]]:
    """Return the visits from the first calibration of each machine on, and the machines that have
    none.
    """
    ordered = sorted(visits, key=lambda visit: visit.day)
    begun = {visit.machine: visit.day for visit in reversed(ordered) if visit.is_calibration}
    known = [visit for visit in ordered if begun.get(visit.machine, "9999") <= visit.day]
    return known, sorted({visit.machine for visit in ordered} - begun.keys())


def print_history(
    found: FleetHistory,
    following: str,
    last: Sequence[str],
    *,
    page: Path | None = None,
    is_verbose: bool = False,
) -> None:
    """Print what changed in a fleet and which robots to look at first, in brief within 14 lines.

    Args:
        found: the fleet's history.
        following: what to do next.
        last: the last lines.
        page: the page that was written.
        is_verbose: whether to print all tables.
    """
    from pincal.cli.progress import console
    from pincal.cli.screen import print_lines
    from pincal.fleet import summary

    out = console()
    click.echo(summary.history_line(found))
    if is_verbose:
        print_lines(summary.group_lines(found), out)
        for table in (summary.change_summary(found), summary.look_first(found)):
            if len(table):
                out.print(table)
        print_lines([("next", following)], out)
    else:
        more = f"all tables: --verbose{'' if page is None else f', or {page}'}"
        ending = [("next", following), *([("more", more)] if found.changes else [])]
        print_lines(_brief_lines(found, ending, out, most=_LINES - 1 - len(last)), out)
    for line in last:
        click.echo(line)


def _brief_lines(
    found: FleetHistory, ending: Sequence[tuple[str, str]], out: Console, *, most: int
) -> list[tuple[str, str]]:
    """Return as many groups and robots to look at as fit into some lines before an ending, at
    least one of each.
    """
    from pincal.cli.screen import height_of
    from pincal.fleet import summary

    lines = list[tuple[str, str]]()
    for listed in range(summary.BRIEF, 0, -1):
        lines = [*summary.brief_lines(found, listed), *ending]
        if height_of(lines, out) <= most:
            break
    return lines


def _some(names: Sequence[str]) -> str:
    others = " and others" if len(names) > _PARAMETERS else ""
    return ", ".join(names[:_PARAMETERS]) + others


fleet = click.Group(
    "fleet",
    commands={
        "add": fleet_add,
        "calibrate": fleet_calibrate,
        "check": fleet_check,
        "diagnose": fleet_diagnose,
        "discover": fleet_discover,
        "learn": fleet_learn,
    },
    help="Learn from many robots of a type, and monitor them.",
    context_settings={"help_option_names": ["-h", "--help"]},
)
