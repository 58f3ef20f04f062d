"""The first ten lines of a result: before, after, the noise, the verdict and what to do next; --verbose tells the rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET
from rich.console import Console

from pincal.calibration.run import Calibration
from pincal.calibration.tables import moved_words
from pincal.cli.tables import held_out_words, print_doubts, print_left_out
from pincal.discover.precheck import DataReport
from pincal.discover.run import Discovery
from pincal.io.discovery_file import FoundEffect
from pincal.measure.registry import blocks_of
from pincal.model.effect import Family
from pincal.model.registry import EFFECTS
from pincal.notes import Note, doubts_first
from pincal.report.tables import show_chance
from pincal.report.verdict import next_steps, verdict_of
from pincal.report.words import effect_words, noise_words, rank_words
from pincal.robot.robot import Robot
from pincal.tables import hanging, one_line

# Effects, and notes, that are named one by one.
_EFFECTS, _NOTES = 3, 1
# Mean distance that independent errors of standard deviation 1 make in so many directions (chi distribution).
_MEAN_DISTANCE = {1: np.sqrt(2.0 / np.pi), 2: np.sqrt(np.pi / 2.0), 3: np.sqrt(8.0 / np.pi)}
_PARTS = {"test": "held out", "train": "fitted"}


def print_brief(
    calibration: Calibration, discovery: Discovery | None, out: Console, *, folder: Path, notes: Sequence[str] = ()
) -> None:
    """Print what a calibration, or a discovery, comes to; ``notes`` are on the files in the folder."""
    result = calibration.result
    print_doubts(result.warnings, out)
    print_left_out(result, out)
    rows = f"{result.rows['train']} rows fitted, {held_out_words(result)}"
    _line(out, "robot", f"{_arm(calibration.robot)}; {rows}")
    for name, model in (("before", "nominal"), ("after", "calibrated")):
        _line(out, name, _errors(result.error[model], name))
    _line(out, "noise", f"{noise_of(result.noise, calibration.stations[0].train.kind)} ({result.noise['source']})")
    if result.stations is not UNSET and (moved := moved_words(result.stations)):
        _line(out, "moved", moved)
    if discovery is not None:
        _line(out, "found", _found(discovery))
    verdict = verdict_of(result, discovery)
    _line(out, "verdict", f"{verdict.judgement}. {verdict.reason}")
    _line(out, "next", next_steps(calibration, discovery)[0])
    print_first_notes([*result.warnings, *notes], out)
    _line(out, "more", f"--verbose, or {folder / 'report.html'}")


def print_brief_check(found: DataReport, robot: Robot, out: Console, *, command: str) -> None:
    """Print what a table can tell of a robot."""
    print_doubts(found.warnings, out)
    _line(out, "robot", _arm(robot))
    _line(out, "rows", f"{found.rows} of kind {found.kind}")
    _line(out, "before", f"mean {found.nominal['mean_mm']:.4f} mm, max {found.nominal['max_mm']:.4f} mm: nominal robot, "
          "base and tool fitted")  # fmt: skip
    _line(out, "noise", f"{noise_of(found.noise, found.kind)} ({found.noise['source']})")
    shares = {
        joint.joint: (joint.high - joint.low) / (joint.upper_limit - joint.lower_limit)
        for joint in found.joints
        if joint.lower_limit is not None and joint.upper_limit is not None
    }
    if shares:
        least = min(shares, key=lambda name: shares[name])
        _line(out, "covered", f"each joint's range by at least {100 * shares[least]:.0f} % ({least})")
    statuses = [parameter.status for parameter in found.parameters]
    _line(out, "rank", rank_words(statuses, rank=found.rank, condition=found.condition, why="why: --verbose"))
    print_first_notes(found.warnings, out)
    _line(out, "next", command)
    _line(out, "more", "--verbose: coverage, what to expect of each parameter, smallest effects that would be found")


def print_first_notes(told: Sequence[Note | str], out: Console) -> None:
    """Print the first of what is good to know, and how much more there is; doubts stand before the result, in full."""
    notes = [note for note in doubts_first(told) if not note.is_doubt]
    more = len(notes) - _NOTES
    plural = "s" if more > 1 else ""
    for i, note in enumerate(notes[:_NOTES], 1):
        rest = f" ({more} more note{plural} with --verbose)" if more > 0 and i == _NOTES else ""
        out.print(hanging("note:   ", f"{note}{rest}"), style="yellow")


def noise_of(noise: Mapping[str, Any], kind: str) -> str:
    """Return the noise as the mean distance that it makes, beside that of one coordinate.

    Example:
        >>> noise_of({"sigma_m": 5e-5}, "position"), noise_of({"sigma_m": 5e-5}, "distance")
        ('mean 0.0798 mm, 0.0500 mm per coordinate', 'mean 0.0399 mm, 0.0500 mm per coordinate')
    """
    size = next((block.size for block in blocks_of(kind)), 0)
    if "sigma_m" not in noise or size not in _MEAN_DISTANCE:
        return noise_words(noise)
    return f"mean {1e3 * noise['sigma_m'] * _MEAN_DISTANCE[size]:.4f} mm, {noise_words(noise)}"


def _arm(robot: Robot) -> str:
    """Return which arm was taken, and how to take another."""
    return f"{robot.name}, {robot.n_joints} joints from {robot.base} to {robot.tip} (--tip takes another link)"


def _errors(by_part: Mapping[str, Mapping[str, float]], name: str) -> str:
    part = "test" if "test" in by_part else "train"
    values = by_part[part]
    unit = "mm" if "mean_mm" in values else "px"
    words = f"mean {values[f'mean_{unit}']:.4f} {unit}, 95 % {values[f'p95_{unit}']:.4f}, max {values[f'max_{unit}']:.4f}"
    model = "nominal, base and tool fitted" if name == "before" else "calibrated"
    return f"{words}: {model}, {_PARTS[part]}"


def _found(discovery: Discovery) -> str:
    effects = discovery.findings.effects
    if not effects:
        return "these data show no missing effect"
    # What every arm has comes after what nobody knew, and those that may be chance last, named as what they are.
    elastic = [name for name, cls in EFFECTS.known().items() if cls.family is Family.ELASTICITY]
    named = [_named(entry) for entry in sorted(effects, key=lambda e: (e.is_hint, e.effect in elastic))[:_EFFECTS]]
    more = len(effects) - _EFFECTS
    return ", ".join([*named, *([f"{more} more"] if more > 0 else [])])


def _named(entry: FoundEffect) -> str:
    chance = f"p {show_chance(entry.p_value)}"
    words = chance if entry.stability is None else f"{entry.stability} halves, {chance}"
    return f"{'perhaps ' if entry.is_hint else ''}{effect_words(entry)} ({words})"


def _line(out: Console, name: str, text: str) -> None:
    out.print(hanging(f"{name:8s}", one_line(text)), markup=False)
