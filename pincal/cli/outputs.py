"""Results of a command: columns of poses, JSON on stdout, notes on stderr, limits."""

from __future__ import annotations

import json
import os
import platform
import shlex
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from importlib.metadata import PackageNotFoundError, version
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pincal.atomic import replacing
from pincal.cli.cell_defaults import cell_files
from pincal.errors import (
    AccuracyGateError,
    OutputError,
    PincalError,
    RobotWarning,
    counted,
    printable,
)
from pincal.thresholds import Count
from pincal.units import format_joint, range_of_joint

if TYPE_CHECKING:
    import numpy as np

    from pincal.calibration.covered import CurveGap, OutsideCurve, Turned
    from pincal.calibration.fitted_robot import FittedRobot
    from pincal.model.conditions import Conditions
    from pincal.notes import Note

# Packages whose versions a report of a problem names.
_PACKAGES = ("numpy", "scipy", "pin", "numba", "llvmlite", "polars", "example-robot-data")
# Longer headers are truncated.
_LONGEST_HEADER: Count = 500
# Number of rows outside the calibrated range that are listed individually.
_SHOWN: Count = 5


def print_json(contents: Mapping[str, Any]) -> None:
    """Print a result for programs."""
    click.echo(json.dumps(contents, indent=2, allow_nan=False))


def echo_notes(notes: Iterable[Note | str], *, quiet: bool) -> None:
    """Print notes on stderr unless ``quiet``; doubts are printed before the result."""
    from pincal.notes import doubts_first

    for note in doubts_first(notes) if not quiet else ():
        if not note.is_doubt:
            click.echo(f"pincal: note: {note}", err=True)


@contextmanager
def robot_notes_in_result() -> Iterator[None]:
    """Leave notes on the robot to the result, which has them; before an error they are printed, as
    they may be the cause.
    """
    held: list[tuple[Warning | str, type[Warning]]] = []
    with warnings.catch_warnings():
        show = warnings.showwarning

        def hold(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, RobotWarning):
                held.append((message, category))
            else:
                show(message, category, *where, **more)

        warnings.showwarning = hold
        try:
            yield
        except PincalError:
            for message, category in held:
                show(message, category, "", 0)
            raise


def provenance(files: Sequence[Path], *, seed: int | None = None) -> dict[str, Any]:
    """Return the origin of a result: versions, command, seed, and the input files with their
    hashes.
    """
    from pincal.io.result_folder import file_hash

    return {
        "pincal": version("pincal"),
        "numpy": version("numpy"),
        "pin": version("pin"),
        "python": sys.version.split()[0],
        "command": " ".join(["pincal", *sys.argv[1:]]),
        "seed": seed,
        "inputs": {
            file.name: file_hash(file) for file in (*files, *cell_files()) if file.is_file()
        },
    }


def require_accuracy(mean_mm: float | None, max_error: float | None, *, rows: str) -> None:
    """Raise :class:`AccuracyGateError` if the mean error [mm] of these rows exceeds the limit [m],
    if there is one.
    """
    if max_error is not None and mean_mm is None:
        raise AccuracyGateError(
            f"--max-error {max_error * 1e3:g} mm: the {rows} rows have no positions, so "
            "no error in mm"
        )
    if max_error is not None and mean_mm is not None and mean_mm > max_error * 1e3:
        raise AccuracyGateError(
            f"mean error of {mean_mm:.4f} mm on {rows} rows exceeds --max-error "
            f"{max_error * 1e3:g} mm"
        )


def columns_of_poses(poses: np.ndarray, *, with_orientation: bool) -> dict[str, np.ndarray]:
    """Return poses, shape (N, 3, 4), as the columns x y z and, if wanted, qx qy qz qw
    of a table.
    """
    from pincal.robot.se3 import quaternions

    columns = dict(zip("xyz", poses[:, :, 3].T, strict=True))
    if with_orientation:
        columns |= zip(("qx", "qy", "qz", "qw"), quaternions(poses[:, :, :3]).T, strict=True)
    return columns


def extrapolation(
    calibrated: FittedRobot, conditions: Conditions, lines: np.ndarray
) -> tuple[dict[str, Any], list[str]]:
    """Return where a model is used outside the range of its calibration data.

    Args:
        calibrated: the model.
        conditions: of the N rows.
        lines: shape (N,), line of each row in its file.

    Returns:
        Entries for ``--json``, and notes for the user.
    """
    from pincal.calibration.curve_coverage import gaps_in_curves, outside_curves, turned_curves
    from pincal.recorded import RECORDABLE

    values = calibrated.outside(conditions)
    curves = outside_curves(calibrated, conditions)
    gaps = gaps_in_curves(calibrated, conditions)
    turned = turned_curves(calibrated, conditions)
    robot = calibrated.model.chain.robot
    units = dict(zip(robot.joint_names, robot.joint_units, strict=True))
    units |= {name: variable.unit for name, variable in RECORDABLE.items()}
    rows = len({value.row for value in values})
    notes = [f"rows outside the range of the calibration data: {rows}"] if rows else []
    for row, name, value, low, high in values[:_SHOWN]:
        at = format_joint(value, units[name])
        notes.append(
            f"line {lines[row]}: {name} = {at}, calibrated from "
            f"{range_of_joint(low, high, units[name])}"
        )
    notes += [_curve_words(curve, units[curve.variable]) for curve in curves]
    notes += _gap_words(gaps, units)
    notes += map(_turned_words, turned)
    contents = {
        "outside": rows,
        "curves": [curve._asdict() for curve in curves],
        "gaps": [gap._asdict() for gap in gaps],
    }
    return contents | ({"turned": [found._asdict() for found in turned]} if turned else {}), notes


def _curve_words(curve: OutsideCurve, unit: str) -> str:
    return (
        f"{counted(curve.rows, 'row', 'need')} the {curve.effect} of {curve.joint} at "
        f"{curve.variable} {range_of_joint(curve.lowest, curve.highest, unit)}; it was "
        f"identified from {range_of_joint(curve.lower, curve.upper, unit)} only and is held "
        "constant outside"
    )


def _gap_words(gaps: Iterable[CurveGap], units: Mapping[str, str]) -> Iterator[str]:
    """Yield a note on each curve with gaps, with the widest of them."""
    for (effect, joint), group in groupby(gaps, key=lambda gap: (gap.effect, gap.joint)):
        *narrower, widest = sorted(group, key=lambda gap: gap.upper - gap.lower)
        more = f" and in {len(narrower)} narrower gap{'s'[: len(narrower) > 1]}" if narrower else ""
        yield (
            f"rows in gaps of the {effect} of {joint}: "
            f"{sum(gap.rows for gap in (*narrower, widest))}; {widest.variable} "
            f"{range_of_joint(widest.lower, widest.upper, units[widest.variable])}{more}: "
            "the calibration had too few poses there to determine it, and it is interpolated"
        )


def _turned_words(found: Turned) -> str:
    return (
        f"{counted(found.rows, 'row', 'have')} {found.variable} a revolution away from where the "
        f"{found.effect} of {found.joint} was "
        "identified; it is assumed to repeat every revolution"
    )


def write_all(files: dict[str, tuple[Path | None, Callable[[Path], None]]]) -> None:
    """Write several files, all or none, each by its function; keys are the options that
    name them.
    """
    wanted = {option: (path, write) for option, (path, write) in files.items() if path is not None}
    _check_places({option: path for option, (path, _) in wanted.items()})
    with ExitStack() as drafts:
        for option, (path, write) in wanted.items():
            write(drafts.enter_context(replacing(path, advice=f"choose another {option}")))


def _check_places(paths: dict[str, Path]) -> None:
    places = [path.absolute() for path in paths.values()]
    for (option, path), place in zip(paths.items(), places, strict=True):
        if path.is_dir():
            raise OutputError(f"{path}: is a folder; expected a file to write to")
        if not path.absolute().parent.is_dir():
            raise OutputError(f"{path}: can't be written (no such folder); choose another {option}")
        if places.count(place) > 1:
            named = " and ".join(
                other for other, there in paths.items() if there.absolute() == place
            )
            raise OutputError(
                f"{path}: named by {named}; expected "
                f"{'two' if len(paths) == 2 else 'different'} files"
            )


def write_plain(path: Path, *, contents: dict[str, Any]) -> None:
    """Write a result for programs."""
    path.write_text(json.dumps(contents, indent=1, allow_nan=False), encoding="utf-8")


def problem_report(words: Sequence[str], files: Sequence[Path]) -> Iterator[str]:
    """Yield the first lines of a bug report.

    Args:
        words: the command line after ``pincal``.
        files: files among them; of text tables, the header is shown, but no data.
    """
    from pincal.io.result_folder import file_hash

    yield (
        f"pincal {version('pincal')}, Python {platform.python_version()}, "
        f"{platform.platform()}, {os.cpu_count()} cores"
    )
    yield ", ".join(f"{package} {_version(package)}" for package in _PACKAGES)
    yield f"command: {printable(shlex.join(['pincal', *words]), _LONGEST_HEADER)}"
    for file in files:
        if file.is_file():
            yield (
                f"{file.name}: {file.stat().st_size} bytes, sha256 "
                f"{file_hash(file)[:12]}{_columns(file)}"
            )
        else:
            yield f"{printable(file.name, _LONGEST_HEADER)}: not a file"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _columns(table: Path) -> str:
    """Return the header of a text table in words; nothing for other files."""
    if table.suffix.lower() not in (".csv", ".txt", ".tsv", ".dat"):
        return ""
    with table.open("rb") as file:
        first = file.readline(2 * _LONGEST_HEADER).decode("utf-8", "replace").strip()
    letters = sum(character.isalpha() for character in first)
    return (
        f", first line: {printable(first, _LONGEST_HEADER)}"
        if letters > len(first) / 4
        else ", no header"
    )
