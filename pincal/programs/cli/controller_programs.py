"""Programs of controllers for ``pincal compensate``: options of the cell, the points corrected and
left unchanged.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from pincal.cli.arguments import NumberType, option, pair
from pincal.cli.outputs import echo_notes, extrapolation, print_json
from pincal.cli.quantities import LENGTH
from pincal.cli.target_files import FileCorrection, TargetFiles
from pincal.errors import Exit, counted

if TYPE_CHECKING:
    from pincal.calibration.fitted_robot import FittedRobot
    from pincal.programs.correct import Change, ProgramCell
    from pincal.programs.language import ControllerLanguage
    from pincal.programs.paths import Deviation
    from pincal.programs.program import Edit, PointKey, Program, Skipped
    from pincal.robot.robot import Robot

# Links of the controller's world and flange in URDFs of ROS-Industrial.
_WORLD = "base"
_FLANGE = "tool0"


def _named(text: str) -> tuple[str, str]:
    return pair(text, "NAME=X,Y,Z,... as the controller shows them")


@dataclass(frozen=True, kw_only=True)
class ProgramOptions(TargetFiles):
    """Properties of the cell that a controller's program does not contain."""

    tools: tuple[tuple[str, str], ...] = option(
        "Values of a tool, by its name or number in the program.",
        (),
        name="--tool",
        type=_named,
        metavar="NAME=X,Y,Z,...",
    )
    bases: tuple[tuple[str, str], ...] = option(
        "Values of a base, user frame or work object.",
        (),
        name="--base",
        type=_named,
        metavar="NAME=X,Y,Z,...",
    )
    world: str | None = option(
        "The controller's world frame: a link of the URDF, or its pose in the robot's base frame.",
        metavar="LINK|X,Y,Z,...",
        words="link 'base' if it is stationary, otherwise the first link of the model",
    )
    flange: str | None = option(
        "The controller's flange frame: a link of the URDF, or its pose in the tip frame.",
        metavar="LINK|X,Y,Z,...",
        words="link 'tool0' if it is fixed to the tip, otherwise the last link of the model",
    )
    axes: str | None = option(
        "The program's axes in terms of the model's joints, in degrees, such as "
        "'q1,90-q2,q3-q2,q4,q5,q6'.",
        metavar="SUMS",
        words="the joints themselves",
    )
    pulses: str | None = option("Pulses per degree of each axis (Yaskawa).", metavar='"P1 P2 ..."')
    with_files: tuple[Path, ...] = option(
        "Further file of the same language with tools, bases or points that the program "
        "uses; it is only read.",
        (),
        name="--with",
        metavar="FILE",
    )
    payload: float = option(
        "Mass at the tip while the program runs [kg].",
        0.0,
        type=NumberType(least=0.0),
        in_cell=True,
    )
    explain: bool = option("Also say of each corrected point why it could be.", False)
    path_error: float | None = option(
        "Insert points into lines where the tool deviates by more than this.", type=LENGTH
    )

    def reads(self, path: Path) -> bool:
        """Return whether a file is a program of a known language."""
        from pincal.programs.language import language_of

        return language_of(path) is not None

    def correct(self, calibrated: FittedRobot, wanted: FileCorrection) -> Exit:
        """Correct a controller's program, and print what was done."""
        from pincal.cli.progress import end_progress
        from pincal.programs.language import language_of

        language = language_of(wanted.path)
        assert language is not None
        limits = Allowed(wanted.seed, wanted.keeps_limits, wanted.max_change)
        result, changes = correct_file(calibrated, wanted.path, wanted.out, language, self, limits)
        notes = list(result["notes"])
        if changes:
            at = calibrated.conditions_at(np.array([change.commanded for change in changes]))
            at = replace(at, payload=np.array([change.payload for change in changes]))
            lines = np.array([change.point.line for change in changes])
            beyond, more = extrapolation(calibrated, at, lines)
            notes += more
            result |= beyond
        end_progress()
        if wanted.as_json:
            print_json(result)
        else:
            click.echo("\n".join(summary_of_program(result, language.name)))
        echo_notes(notes, quiet=wanted.quiet)
        is_lost = not result["points"] or (wanted.is_strict and result["left"])
        return Exit.UNDECIDED if is_lost else Exit.DONE


def correct_file(
    calibrated: FittedRobot,
    path: Path,
    out: Path,
    language: ControllerLanguage,
    options: ProgramOptions,
    limits: Allowed,
) -> tuple[dict[str, Any], list[Change]]:
    """Correct a program and write it; return the result for ``--json``, and the changes.

    Raises:
        ProgramError: for a file that is truncated, in another dialect, or can't be read.
    """
    from pincal.programs.correct import Corrector
    from pincal.programs.language import files_of
    from pincal.programs.paths import Follower, legs_of

    files = files_of(path, language)
    outs = _outputs(path, out, files, language)
    if options.pulses is not None:
        language = language.with_pulses(options.pulses)
    program = _program(files, language, options)
    robot = calibrated.model.chain.robot
    corrector = Corrector(calibrated, language, _cell(robot, language, options, limits))
    changes, left = corrector.changes(program)
    follower = Follower(corrector)
    legs = legs_of(program, changes)
    deviations = follower.deviations(legs)
    edits = [edit for change in changes.values() for edit in corrector.edits(change)]
    inserted = 0
    if options.path_error is not None:
        more, others, inserted = follower.inserted(program, legs, options.path_error)
        edits = edits + more
        left = left + others
    _write(program, edits, outs)
    result = _result(program, list(changes.values()), left, deviations)
    if options.explain:
        _explain(result["points"], program, changes)
    is_renamed = language.is_pair and out.stem.lower() != path.stem.lower()
    result |= _links(robot, corrector.cell, options)
    result |= {"must_be_named": path.name if is_renamed else "", "notes": corrector.notes(program)}
    result |= {"inserted": inserted, "out": [str(target) for target in outs]}
    return result, list(changes.values())


def _program(
    files: Sequence[Path], language: ControllerLanguage, options: ProgramOptions
) -> Program:
    """Return the program of some files, of which those of ``--with`` are only read."""
    from pincal.programs.language import read_sources

    program = language.read(read_sources([*files, *options.with_files]))
    program.leave(range(len(files), len(files) + len(options.with_files)))
    return program


def _outputs(
    path: Path, out: Path, files: Sequence[Path], language: ControllerLanguage
) -> list[Path]:
    """Return the files to be written, one for each of a program; refuse those of the program."""
    if out.suffix.lower() != path.suffix.lower():
        raise click.UsageError(
            f"--out {out}: a {language.name} program is written as one; expected a name "
            f"that ends in {path.suffix}"
        )
    outs = [out.with_suffix(file.suffix) for file in files]
    if any(target.resolve() == file.resolve() for target, file in zip(outs, files, strict=True)):
        raise click.UsageError(
            f"--out {out}: this is the program itself; expected another name, or the same "
            "one in another folder, so that a "
            "second run does not correct it again"
        )
    return outs


def _explain(
    points: Sequence[dict[str, Any]], program: Program, changes: Mapping[PointKey, Change]
) -> None:
    """Add to each point why it could be corrected."""
    from pincal.programs.explanation import explanations

    reasons = explanations(program, changes).values()
    for point, reason in zip(points, reasons, strict=True):
        point["because"] = reason


def _write(program: Program, edits: Sequence[Edit], outs: Sequence[Path]) -> None:
    """Write the files of a program with edits applied."""
    from pincal.atomic import write_atomic
    from pincal.programs.program import spliced

    # A pair keeps its name and is therefore written into another folder.
    with contextlib.suppress(OSError):
        outs[0].parent.mkdir(parents=True, exist_ok=True)
    for i, target in enumerate(outs):
        write_atomic(target, spliced(program.sources[i], i, edits))


def _links(robot: Robot, cell: ProgramCell, options: ProgramOptions) -> dict[str, str]:
    """Return where the controller's frames are, and its axes, as they are said to the user."""
    world = robot.base if np.array_equal(cell.world, np.eye(4)) else _WORLD
    flange = robot.tip if np.array_equal(cell.flange, np.eye(4)) else _FLANGE
    return {
        "world": options.world or world,
        "flange": options.flange or flange,
        "axes": options.axes or "the model's joints",
    }


@dataclass(frozen=True)
class Allowed:
    """Limits of a correction, and the start of the program; see
    :class:`pincal.programs.correct.ProgramCell`.
    """

    seed: np.ndarray | None
    keep: bool
    max_change: float


def _cell(
    robot: Robot, language: ControllerLanguage, options: ProgramOptions, limits: Allowed
) -> ProgramCell:
    from pincal.programs.arms import ProgramAxes
    from pincal.programs.correct import ProgramCell

    places = {
        name: _pose_of(robot, language, text, usual=usual, link=link)
        for name, text, usual, link in (
            ("world", options.world, _WORLD, robot.base),
            ("flange", options.flange, _FLANGE, robot.tip),
        )
    }
    return ProgramCell(
        axes=ProgramAxes.parse(options.axes, robot),
        tools={language.key(name): language.frame(value) for name, value in options.tools},
        bases={language.key(name): language.frame(value) for name, value in options.bases},
        seed=None if limits.seed is None else robot.from_reported(limits.seed[None])[0],
        payload=options.payload,
        limits=limits.keep,
        max_change=limits.max_change,
        **places,
    )


def _pose_of(
    robot: Robot, language: ControllerLanguage, text: str | None, *, usual: str, link: str
) -> np.ndarray:
    """Return the pose, shape (4, 4), of a link or of numbers in the frame of a link of
    the model.
    """
    from pincal.errors import BadInputError
    from pincal.programs.arms import rigid_pose

    if text is None:
        found = rigid_pose(robot, usual, link)
        return np.eye(4) if found is None else found
    if "," in text:
        return language.frame(text)
    found = rigid_pose(robot, text, link)
    if found is None:
        raise BadInputError(
            f"{text!r} is not a link that is fixed to {link}; expected one, or X,Y,Z,..."
        )
    return found


def _result(
    program: Program,
    changes: Sequence[Change],
    left: Sequence[Skipped],
    deviations: Sequence[Deviation],
) -> dict[str, Any]:
    """Return the result for ``--json``."""
    names = [source.name for source in program.sources]
    points = [
        {
            "name": change.point.name,
            "file": names[change.point.source],
            "line": change.point.line,
            "shift_mm": 1e3 * change.shift,
            "turn_mrad": 1e3 * change.turn,
        }
        for change in changes
    ]
    sure = [found for found in deviations if np.isfinite(found.size)]
    worst = max(sure, key=lambda found: found.size, default=None)
    path = {
        "motions": len(deviations),
        "not_followed": [
            found.motion.statement.line for found in deviations if not np.isfinite(found.size)
        ],
    }
    if worst is not None:
        path |= {"largest_mm": 1e3 * worst.size, "line": worst.motion.statement.line}
    return {
        "points": points,
        "left": [
            {"name": one.name, "file": names[one.source], "line": one.line, "reason": one.reason}
            for one in left
        ],
        "path": path,
    }


def summary_of_program(result: dict[str, Any], language: str) -> Iterator[str]:
    """Yield the lines that summarise a corrected program."""
    left = result["left"]
    yield (
        f"{language}: {counted(len(result['points']), 'point')} corrected, "
        f"{len(left)} left unchanged"
    )
    yield (
        f"  the controller's world is {result['world']}, its flange {result['flange']} "
        "(--world, --flange), its axes are"
    )
    yield f"  {result['axes']} (--axes)"
    yield from _lines_of_points(result["points"])
    path = result["path"]
    if "largest_mm" in path:
        yield (
            "  between corrected points the tool deviates from its path by at most "
            f"{path['largest_mm']:.4f} mm "
            f"(line {path['line']}, {counted(path['motions'], 'motion')})"
        )
    if result["inserted"]:
        yield f"  {counted(result['inserted'], 'point')} inserted"
    if left:
        yield "left unchanged:"
    for one in left:
        yield f"  {one['file']} line {one['line']}, {one['name']}: {one['reason']}"
    yield f"written to {', '.join(result['out'])}"
    if result["must_be_named"]:
        yield (
            "the controller requires the file to be named after its module: "
            f"{result['must_be_named']}"
        )


def _lines_of_points(points: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the changes of points, one below the other, and why each was corrected."""
    names = [f"{point['file']} line {point['line']}, {point['name']}" for point in points]
    width = max((len(name) for name in names), default=0)
    for name, point in zip(names, points, strict=True):
        yield f"  {name:{width}s} {point['shift_mm']:9.4f} mm {point['turn_mrad']:9.4f} mrad"
        if "because" in point:
            yield f"    {point['because']}"
