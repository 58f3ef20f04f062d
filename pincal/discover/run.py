"""Discover what a calibration misses: from a robot and a table to findings and a model that holds them."""

from __future__ import annotations

import html
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import msgspec
import numpy as np

from pincal.calibration.fit import Fit as CalibratedFit
from pincal.calibration.left_out import leave_out_stations
from pincal.calibration.result import result_of
from pincal.calibration.rows import LeftOut, Validation
from pincal.calibration.run import Calibration, run_calibration
from pincal.discover.bootstrap import bootstrap_last
from pincal.discover.history import History
from pincal.discover.joint_noise import note_on_joints
from pincal.discover.judge import findings_of, repeated
from pincal.discover.loop import discover_effects
from pincal.discover.policy import POLICY, Policy
from pincal.discover.resolution import notes_on_repeats
from pincal.discover.shrink import PartialResidual, partial_residuals, stages_of
from pincal.discover.stability import begin_halves
from pincal.discover.widened import widened
from pincal.errors import BadInputError
from pincal.identify.calibrate import Tables, tables_of
from pincal.identify.options import Options
from pincal.identify.split import row_groups
from pincal.io.discovery_file import Findings, Stage
from pincal.measure.approach import note_on_sides
from pincal.measure.measurements import Measurements
from pincal.model.chain import MOMENT_FRAMES, MomentFrame
from pincal.model.effect import Effect
from pincal.model.effects import GEOMETRIC
from pincal.notes import Note, doubts_first
from pincal.robot.robot import Robot
from pincal.spread import wake
from pincal.validate.verdict import Verdict

# Blocks of poses that are left out in turn: enough that seven eighths determine the model nearly as well as all.
_CV_BLOCKS = 8


@dataclass(frozen=True, repr=False)
class Discovery:
    """A discovery with its calibration.

    Attributes:
        calibration: the calibration with all that was found.
        trail: how it was found.
        findings: what was found.
        gaps: errors on held-out rows at the start, after each change of the model.
        traces: what each effect explains, pose by pose.
    """

    calibration: Calibration
    trail: History
    findings: Findings
    gaps: tuple[Stage, ...]
    traces: tuple[PartialResidual, ...]

    def __repr__(self) -> str:
        named = ", ".join(" of ".join(filter(None, (entry.effect, entry.joint))) for entry in self.findings.effects)
        robot = self.calibration.robot.name
        return f"Discovery({robot!r}: {named or 'no effect'}; {self.findings.verdict})"

    def _repr_html_(self) -> str:
        return f"{self.calibration._repr_html_()}<p>{html.escape(repr(self))}</p>"

    @property
    def report(self) -> dict[str, Any]:
        """The contents of ``discovery.json``."""
        return dict(msgspec.to_builtins(self.findings))


def run_discovery(
    robot: Robot,
    measurements: Tables,
    options: Options | None = None,
    *,
    extra: tuple[Effect, ...] = (),
    test_fraction: float = 0.2,
    split: Validation = "blocked",
    seed: int = 0,
    holdout: Tables | None = None,
    moment_frames: Sequence[MomentFrame] = (),
    policy: Policy = POLICY,
    stability: int = 0,
    executor: Executor | None = None,
) -> Discovery:
    """Calibrate, find what the model misses, name it, add it and show the gap shrink on rows that criticism never saw.

    Args:
        robot: the arm.
        measurements: the table, or several, which are a station each.
        options: how to calibrate; its effects are the model to start from, default: the geometric one.
        extra: effects of the user's own that take part.
        test_fraction: part of the rows held out.
        split: how rows are chosen; default: whole regions of joint space. With "station" each station in turn is
            predicted by a discovery on the others.
        seed: of the choice.
        holdout: other measurements to hold out instead.
        moment_frames: conventions of where moments bend the arm to choose from by the data; that of the options unless
            given. The first stays unless another fits better beyond chance.
        policy: thresholds and limits.
        stability: halves of the poses on which the search is repeated, to tell how often each name comes up; then a
            bootstrap also says whether the name accepted last may be chance; default: none.
        executor: makes these searches, and the discoveries that leave a station out; default: one after the other, here.

    Returns:
        The calibration with all that was found, and how it was found.

    Raises:
        BadInputError: as :func:`run_calibration`, and if there are to be fewer than no halves.

    Example:
        >>> import numpy as np
        >>> from pincal.builtin import kuka_urdf_path
        >>> from pincal.measure.table import measurements_from_arrays
        >>> robot = Robot.from_urdf(kuka_urdf_path())
        >>> rng = np.random.default_rng(0)
        >>> q = robot.random_configurations(60, rng)
        >>> bent = q + np.array([0.0, 0.0, 0.0, 1e-3, 0.0, 0.0]) * np.sin(q)
        >>> tips = robot.forward_kinematics(bent)
        >>> position = tips[:, :3, 3] + tips[:, :3, :3] @ [0.1, 0.0, 0.2] + 5e-5 * rng.standard_normal((60, 3))
        >>> table = measurements_from_arrays(robot.joint_names, q, position=position)
        >>> found = run_discovery(robot, table, Options(effects=GEOMETRIC, sigma=5e-5))
        >>> [(entry.effect, entry.joint) for entry in found.findings.effects]
        [('gear_eccentricity', 'joint_4')]
    """
    if stability < 0:
        raise BadInputError(f"stability is {stability}; expected a number of halves of the poses, 0 for none")
    options = Options(effects=GEOMETRIC) if options is None else options
    begun = time.perf_counter()
    frames = tuple(moment_frames) or (MOMENT_FRAMES if options.moment_frame == "auto" else (options.moment_frame,))
    options = replace(options, moment_frame=frames[0])
    search = partial(_search, frames=frames, extra=extra, policy=policy)
    left_out: Iterable[LeftOut] = ()
    if split == "station":
        # Stations are held out instead of rows.
        split, test_fraction = "random", 0.0
        others = partial(_discovered, search)
        left_out = leave_out_stations(robot, tables_of(measurements), options, fit_others=others, executor=executor)
    if executor is not None:
        wake(executor, stability, begin_halves.__module__)
    # Before names are looked for, what depends on the order of rows may be what they stand for.
    plain = replace(options, serial=False)
    first = run_calibration(robot, measurements, plain, test_fraction=test_fraction, split=split, seed=seed, holdout=holdout)
    trail, notes = search(first)
    halves = begin_halves(trail, _regions(first), stability, executor=executor)
    # What follows is done here while workers are at the halves.
    fit, gaps, traces = widened(trail), stages_of(trail, first.stations), partial_residuals(trail)
    origins = ", ".join(dict.fromkeys(filter(None, (rows.train.approach_from for rows in first.stations))))
    findings = findings_of(fit, trail, gaps=gaps, traces=traces, approach_from=origins or None)
    if stability:
        bootstrap = bootstrap_last(trail)
        findings = repeated(findings, halves(), bootstrap)
    left_out = tuple(left_out)
    seconds = time.perf_counter() - begun
    result = result_of(fit, first.stations, seconds=seconds, notes=notes, left_out=left_out)
    final = replace(first, fit=CalibratedFit.of(fit), result=result, notes=notes)
    # The search says what speaks against the model; whether anything speaks for it, the rule for all verbs.
    verdict = result.verdict_of(left=findings.verdict is Verdict.NOT_ADEQUATE)
    findings = msgspec.structs.replace(findings, verdict=verdict, warnings=result.warnings)
    return Discovery(final, trail, findings, gaps, traces)


def _search(
    first: Calibration, *, frames: tuple[MomentFrame, ...], extra: tuple[Effect, ...], policy: Policy
) -> tuple[History, tuple[Note, ...]]:
    """Return what was found from a calibration on, and notes."""
    blocks = np.concatenate(_regions(first)) % _CV_BLOCKS
    trail = discover_effects(first.fit, blocks, frames=frames, extra=extra, policy=policy)
    problem = trail.final.problem
    tables = (rows.train for rows in first.stations)
    sides = (note_on_sides(table.source, table.approach_from) for table in tables)
    notes: list[Note | str] = [
        *first.notes,
        *dict.fromkeys(filter(None, sides)),
        *notes_on_repeats(problem.chain.robot, problem.conditions.q),
    ]
    was, frame = first.fit.options.moment_frame, trail.final.options.moment_frame
    if frame != was:
        notes.append(f"moments bend the arm as with --moment-frame {frame}: it fits better than {was}")
    if of_joints := note_on_joints(trail.final):
        notes.append(of_joints)
    return trail, doubts_first(notes)


def _regions(first: Calibration) -> list[np.ndarray]:
    """Return the region of joint space of each training row, station by station."""
    return [row_groups(rows.train, split="blocked", seed=0) for rows in first.stations]


def _discovered(
    search: Callable[[Calibration], tuple[History, tuple[Note, ...]]],
    robot: Robot,
    tables: dict[str, Measurements],
    options: Options,
) -> CalibratedFit:
    """Return the fit of all that is discovered on all rows of some stations."""
    trail, _ = search(run_calibration(robot, tables, options, test_fraction=0.0))
    return CalibratedFit.of(trail.final)
