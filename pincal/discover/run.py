"""Discovery of effects that a calibration lacks: findings, a model with them, and their stability.

The search is repeated on subsamples of half of the regions of joint space; a half and the other
regions are a complementary pair (Shah and Samworth 2013, J. R. Stat. Soc. B 75, 55-80). A name
found in 19 of 20 halves does not depend on a few poses and would probably be found with other
poses; one found in less than 60 % is a hint.

A search on a half starts from the geometric fit of all rows, in their moment frame, with all
effects of the catalogue and those unnamed dependences that were found on all rows. Of the names
found on all rows those that the half leaves no doubt of enter together (``sure_names``); the others
have to be found again one by one. Its last fits converge as closely as tests of names need. Where
effects are selected on a sample of the rows, see ``Policy.enough_readings``, halves are of this
sample; they begin once it has named all that it shows, while all rows are fitted.
"""

from __future__ import annotations

import html
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypedDict, Unpack, cast

import numpy as np
from msgspec import to_builtins
from msgspec.structs import asdict
from msgspec.structs import replace as changed

from pincal.calibration.benefit import without_harm
from pincal.calibration.calibration import Calibration, FittedTables, fit_admitted
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.held_out import HeldBack, LeftOut, Validated, by_stops, leave_out_stations
from pincal.calibration.result import result_of
from pincal.calibration.stated import stated
from pincal.calibration.validation import Validation
from pincal.calibration.visit_findings import is_shifted
from pincal.discover.candidate_tests import NamelessKind, nameless_kind, sampled
from pincal.discover.discovery_file import (
    Bootstrap,
    EffectName,
    Findings,
    FoundEffect,
    Repeated,
    Stability,
    Stage,
)
from pincal.discover.drive_curves import notes_on_repeats
from pincal.discover.elastic import significant_compliances
from pincal.discover.ending import note_on_joints, untold_of, widened
from pincal.discover.findings import bootstrap_last, findings_of
from pincal.discover.loop import discover_effects, withdraw_names_at_change
from pincal.discover.names_by_region import doubt_of_regions, regions_by_names
from pincal.discover.policy import POLICY, Policy
from pincal.discover.scatter import arrivals_within
from pincal.discover.score_numbers import TESTING
from pincal.discover.shrink import PartialResidual, partial_residuals, stages_of
from pincal.discover.smooth_rest import SmoothRest, note_on_remainder, with_remainder
from pincal.discover.steps import History, listed
from pincal.errors import BadInputError, PincalError
from pincal.identify.calibrate import (
    Tables,
    nominal_without_outliers,
    reads_places,
    refit,
    tables_of,
)
from pincal.identify.fit import ModelFit
from pincal.identify.options import Options
from pincal.identify.split import row_groups
from pincal.measure.approach import note_on_sides
from pincal.measure.measurements import Measurements
from pincal.model.chain import MOMENT_FRAMES, MomentFrame
from pincal.model.effect import Effect
from pincal.model.effects import GEOMETRIC
from pincal.notes import Note, Severity, doubts_first
from pincal.robot.robot import Robot
from pincal.spread import spread, wake
from pincal.thresholds import Scale
from pincal.validate.misfit import SURE, Verdict

# Noise of half of the rows, at least, in units of that of all: of less readings than parameters it
# would be rounding.
_LEAST: Scale = 0.5

Group = tuple[EffectName, ...]
"""Names of an effect found and of its equivalents, as far as all tables have them."""


@dataclass(frozen=True, repr=False)
class Discovery:
    """A discovery with its calibration.

    Attributes:
        calibration: the calibration with all effects found.
        trail: the history of the search.
        findings: the findings.
        gaps: errors on held-out rows at the start, after each change of the model.
        traces: partial residuals of each effect, pose by pose.
    """

    calibration: Calibration
    trail: History
    findings: Findings
    gaps: tuple[Stage, ...]
    traces: tuple[PartialResidual, ...]

    def __repr__(self) -> str:
        named = ", ".join(
            " of ".join(filter(None, (entry.effect, entry.joint)))
            for entry in self.findings.effects
        )
        robot = self.calibration.robot.name
        return f"Discovery({robot!r}: {named or 'no effect'}; {self.findings.verdict})"

    def _repr_html_(self) -> str:
        return f"{self.calibration._repr_html_()}<p>{html.escape(repr(self))}</p>"

    @property
    def report(self) -> dict[str, Any]:
        """The contents of ``discovery.json``."""
        return dict(to_builtins(self.findings))

    def ended(self, findings: Findings, seconds: float) -> Discovery:
        """Return the discovery with all that was found, after so many seconds."""
        result = replace(self.calibration.result, seconds=seconds)
        return replace(
            self, calibration=replace(self.calibration, result=result), findings=findings
        )


class Choices(TypedDict, total=False):
    """How rows are held out, as for a calibration, moment frames to choose from, and whether what
    has no name may enter.
    """

    test_fraction: float
    split: Validation
    seed: int
    holdout: Tables | None
    moment_frames: Sequence[MomentFrame]
    remainder: bool


def _usual_frames(options: Options) -> tuple[MomentFrame, ...]:
    """Return the moment frames to choose from where the user names none."""
    return MOMENT_FRAMES if options.moment_frame == "auto" else (options.moment_frame,)


def run_discovery(
    robot: Robot,
    measurements: Tables,
    options: Options | None = None,
    *,
    extra: tuple[Effect, ...] = (),
    policy: Policy = POLICY,
    stability: int = 0,
    executor: Executor | None = None,
    **choices: Unpack[Choices],
) -> Discovery:
    """Calibrate, identify and add the effects that the model lacks, and validate each step on
    held-out rows.

    Args:
        robot: the arm.
        measurements: the table, or several, a station each.
        options: how to calibrate; its effects are the model to start from, default: the geometric
            one.
        extra: additional candidate effects of the user.
        policy: thresholds and limits.
        stability: number of subsamples on which the search is repeated, to count how often each
            name is found; a bootstrap then also tests the effect accepted last; default: none.
        executor: runs these searches, and the discoveries that leave a station out; default:
            sequentially, here.

    Keyword Args:
        test_fraction: fraction of the poses to hold out for good; default: none, errors are stated
            by cross-validation.
        split: how poses are divided into folds, or chosen; default: whole regions of joint space,
            and stretches of consecutive rows, the headline being the one predicted worse. With
            "station" each station is predicted by a discovery on the others.
        seed: of the choice; default: 0.
        holdout: other measurements to hold out instead.
        moment_frames: moment frames to choose from by the data; default: as in the options. The
            first is kept unless another fits significantly better.
        remainder: whether what is smooth in the joints and has no name may enter the model after
            the last name, where it predicts regions that were left out, and none of them worse than
            by geometry and elasticity alone; default: yes.

    Returns:
        The calibration with all effects found, and the history of the search.

    Raises:
        BadInputError: as :func:`run_calibration`, and if the number of subsamples is negative.

    Example:
        >>> import numpy as np
        >>> from pincal.builtin import kuka_urdf_path
        >>> from pincal.measure.table import measurements_from_arrays
        >>> robot = Robot.from_urdf(kuka_urdf_path())
        >>> rng = np.random.default_rng(0)
        >>> q = robot.random_configurations(60, rng)
        >>> bent = q + np.array([0.0, 0.0, 0.0, 1e-3, 0.0, 0.0]) * np.sin(q)
        >>> tips = robot.forward_kinematics(bent)
        >>> position = tips[:, :3, 3] + tips[:, :3, :3] @ [0.1, 0.0, 0.2]
        >>> position += 5e-5 * rng.standard_normal((60, 3))
        >>> table = measurements_from_arrays(robot.joint_names, q, position=position)
        >>> found = run_discovery(robot, table, Options(effects=GEOMETRIC, sigma=5e-5))
        >>> [(entry.effect, entry.joint) for entry in found.findings.effects]
        [('gear_eccentricity', 'joint_4')]
    """
    if stability < 0:
        raise BadInputError(
            f"stability is {stability}; expected a number of subsamples, 0 for none"
        )
    tables = _tables_of_positions(measurements)
    options = Options(effects=GEOMETRIC) if options is None else options
    begun = time.perf_counter()
    frames = tuple(choices.pop("moment_frames", ())) or _usual_frames(options)
    options = replace(options, moment_frame=frames[0])
    remainder = choices.pop("remainder", True)
    search = partial(_search, frames=frames, extra=extra, policy=policy)
    left_out: Iterable[LeftOut] = ()
    held_back = HeldBack(**cast("dict[str, Any]", choices))
    if held_back.split == "station":
        # Stations are held out instead of rows.
        held_back = replace(held_back, test_fraction=0.0, split="random")
        others = partial(_discovered, search, remainder=remainder)
        left_out = leave_out_stations(robot, tables, options, fit_others=others, executor=executor)
    if executor is not None:
        wake(executor, stability, begin_subsamples.__module__)
    first = _first_fit(robot, measurements, options, held_back)
    halves = _Halves(_regions(first), stability, executor)
    trail, notes = halves.beside(partial(search, first))
    # The following runs while workers search the halves.
    ended = _Ended.of(first, trail, remainder=remainder).lighter
    trail = ended.named
    found = ended.discovery(notes, tuple(left_out))
    bootstrap = bootstrap_last(trail) if stability else None
    findings = with_subsamples(found.findings, halves.names(), bootstrap)
    return found.ended(findings, time.perf_counter() - begun)


def _tables_of_positions(measurements: Tables) -> dict[str, Measurements]:
    """Return the tables by name; refuse an IMU alone."""
    tables = tables_of(measurements)
    if not reads_places(tables):
        raise BadInputError(
            f"{', '.join(table.source for table in tables.values())}: an IMU alone measures no "
            "positions, which a discovery needs to distinguish causes; add a tracker in motion or "
            "some static poses, or only calibrate (pincal calibrate)"
        )
    return tables


def _first_fit(
    robot: Robot, measurements: Tables, options: Options, held_back: HeldBack
) -> FittedTables:
    """Return the fit from which a search starts."""
    # Correlation along the rows may be due to the effects searched for.
    plain = replace(options, serial=False)
    first = fit_admitted(robot, measurements, plain, held_back)
    wanted = replace(first.fit.options, serial=options.serial)
    return replace(first, fit=replace(first.fit, options=wanted))


@dataclass(frozen=True)
class _Ended:
    """The end of a search, with what its fit shows.

    Attributes:
        first: the fit from which it started, with its tables.
        named: its history.
        trail: the same, with what entered without a name.
        rest: what entered without a name; None if nothing did.
        untold: what errors of the model of names add to the variance of the rows.
        fit: its last fit, with the uncertainty of its model; as in the URDF if no effect was found
            and the readings do not improve the robot.
        validated: the errors of this fit at rows that were held out; None without any.
        of_names: the same of the fit of names alone, if something entered without one.
        gaps: errors on held-out rows at the start, after each change of the model.
        traces: partial residuals of each effect.
        arrivals: to how much all drives alike would have to stop to explain residuals beyond the
            declared noise [rad]; None if nothing exceeds it so.
        findings: what was found.
    """

    first: FittedTables
    named: History
    trail: History
    rest: SmoothRest | None
    untold: float
    fit: ModelFit
    validated: Validated | None
    of_names: Validated | None
    gaps: tuple[Stage, ...]
    traces: tuple[PartialResidual, ...]
    arrivals: float | None
    findings: Findings

    @classmethod
    def of(cls, first: FittedTables, named: History, *, remainder: bool) -> _Ended:
        """Return what the last fit of a search shows, perhaps with what has no name."""
        # Without any effect a robot that the readings do not improve stays as in its URDF.
        harmless = first.fit if named.steps else without_harm(first.fit)
        is_kept = harmless.is_kept
        trail = named
        rest = None
        if remainder and not is_kept:
            trail, rest = with_remainder(named)
        untold = 0.0 if is_kept else untold_of(named)
        fit = harmless if is_kept else widened(named, trail.final, untold=untold)
        traces = partial_residuals(trail)
        # Rows that the first model could not describe may be sound.
        fit = replace(fit, nominal=nominal_without_outliers(fit))
        validated = Validated.of(fit, first.stations, first.folds)
        of_names = None if rest is None else Validated.of(named.final, first.stations, first.folds)
        gaps, held_out = stages_of(trail, first.stations, validated, of_names)
        origins = ", ".join(
            dict.fromkeys(filter(None, (rows.train.approach_from for rows in first.stations)))
        )
        # Neither names nor verdict depend on what has no name.
        measured = by_stops(named.final, first.stations)
        arrivals = arrivals_within(named.final)
        findings = findings_of(
            fit,
            named,
            rest=rest,
            gaps=gaps,
            traces=traces,
            measured=measured,
            held_out=held_out,
            approach_from=origins or None,
            arrivals=arrivals,
        )
        return cls(
            *(first, named, trail, rest, untold, fit),
            *(validated, of_names, gaps, traces, arrivals, findings),
        )

    @property
    def lighter(self) -> _Ended:
        """The same without the tests of what was not found, which are large and asked for again
        only if something entered without a name.
        """
        if self.rest is not None:
            return self
        named = replace(self.named)
        return replace(self, named=named, trail=named)

    def discovery(self, notes: tuple[Note, ...], left_out: tuple[LeftOut, ...]) -> Discovery:
        """Return the discovery with its calibration, without subsamples and before it is known how
        long it takes.
        """
        first = self.first
        findings = self.findings
        if self.rest is None:
            regions = regions_by_names(self.named, self.validated, first.stations)
            findings = changed(findings, regions=regions)
        more = [doubt_of_regions(findings.regions)]
        more += [] if self.rest is None else [Note(Severity.NOTE, note_on_remainder(self.rest))]
        notes = doubts_first([*notes, *filter(None, more)])
        given = partial(result_of, rows=first.stations, notes=notes, left_out=left_out)
        given = partial(given, arrivals=self.arrivals)
        result = given(self.fit, validated=self.validated)
        # The search decides whether the model is inadequate; whether it is adequate, the rule
        # common to all commands.
        incomplete = findings.verdict is Verdict.NOT_ADEQUATE
        verdict = result.verdict_of(incomplete=incomplete)
        if self.rest is not None:
            named = widened(self.named, untold=self.untold)
            of_names = given(named, validated=self.of_names, parameters=())
            verdict = of_names.verdict_of(incomplete=incomplete)
        known, result = stated(self.fit, result, verdict)
        final = Calibration(first.robot, first.stations, known, result, notes, self.validated)
        findings = changed(findings, verdict=verdict, warnings=result.warnings)
        return Discovery(final, self.trail, findings, self.gaps, self.traces)


def _search(
    first: FittedTables,
    *,
    frames: tuple[MomentFrame, ...],
    extra: tuple[Effect, ...],
    policy: Policy,
    when_named: Callable[[History], None] | None = None,
) -> tuple[History, tuple[Note, ...]]:
    """Return the history of a search from a calibration on, and notes.

    ``when_named`` is told names as by :func:`discover_effects`, and what is left of them if some
    are withdrawn.
    """
    blocks = np.concatenate(_regions(first)) % TESTING.blocks
    given: dict[str, Any] = {"frames": frames, "extra": extra, "policy": policy}
    found = discover_effects(first.fit, blocks, when_named=when_named, **given)
    trail = withdraw_names_at_change(found, partial(is_shifted, rows=first.stations))
    problem = trail.final.problem
    tables = (rows.train for rows in first.stations)
    sides = (note_on_sides(table.source, table.approach_from) for table in tables)
    notes: list[Note | str] = [
        *first.notes,
        *dict.fromkeys(filter(None, sides)),
        *notes_on_repeats(problem.chain.robot, problem.conditions.q),
    ]
    if trail is not found:
        names = listed(trail.changes[-1].left)
        notes.append(
            f"withdrawn, since a change during the session may explain them: {names}; run "
            "again with two stations"
        )
        if when_named:
            when_named(trail)
    was = first.fit.options.moment_frame
    frame = trail.final.options.moment_frame
    if frame != was:
        notes.append(
            f"moments are computed as with --moment-frame {frame}, which fits better than {was}"
        )
    if of_joints := note_on_joints(trail.final):
        notes.append(of_joints)
    return trail, doubts_first(notes)


def _regions(first: FittedTables) -> list[np.ndarray]:
    """Return the region of joint space of each training row, station by station."""
    return [row_groups(rows.train, split="blocked", seed=0) for rows in first.stations]


def _discovered(
    search: Callable[[FittedTables], tuple[History, tuple[Note, ...]]],
    robot: Robot,
    tables: dict[str, Measurements],
    options: Options,
    *,
    remainder: bool,
) -> FittedRobot:
    """Return the final fit of a discovery on all rows of some stations."""
    trail, _ = search(fit_admitted(robot, tables, options, HeldBack()))
    return FittedRobot.of((with_remainder(trail)[0] if remainder else trail).final)


@dataclass
class _Halves:
    """The repetition of a search on halves, which begins when its names are known, and again if
    they become others; arguments as of :func:`begin_subsamples`.
    """

    regions: Sequence[np.ndarray]
    count: int
    executor: Executor | None
    _begun: Callable[[], Subsamples] | None = None

    def begin(self, trail: History) -> None:
        """Begin; halves that began with other names are given up."""
        self._begun = None
        self._begun = begin_subsamples(trail, self.regions, self.count, executor=self.executor)

    def beside(
        self, search: Callable[..., tuple[History, tuple[Note, ...]]]
    ) -> tuple[History, tuple[Note, ...]]:
        """Return the result of a search, beside the end of which they begin."""
        trail, notes = search(when_named=self.begin)
        if self._begun is None:
            self.begin(trail)
        return trail, notes

    def names(self) -> Subsamples:
        """Wait for the names; none if nothing began."""
        return Subsamples((), 0) if self._begun is None else self._begun()


@dataclass(frozen=True)
class Subsamples:
    """Names found in each half of the poses, and the mean number of rows of a half."""

    named: tuple[tuple[Group, ...], ...]
    poses: int

    def __len__(self) -> int:
        return len(self.named)

    def count(self, name: EffectName) -> int:
        """Return the number of halves in which a name was found, also as an equivalent."""
        return sum(any(name in group for group in groups) for groups in self.named)

    def stability(self, entry: FoundEffect) -> Stability:
        """Return how often an effect was found, and how often not it but an alternative."""
        names = {name.in_tables for name in entry.equivalent}
        own = self.count(entry.in_tables)
        either = sum(
            any(names.union([entry.in_tables]).intersection(group) for group in groups)
            for groups in self.named
        )
        return Stability(own, len(self), either - own)

    def others(self, known: Sequence[EffectName], share: float) -> list[tuple[EffectName, int]]:
        """Return unknown names that were found, not only as equivalents, in at least a share of the
        halves, with counts.
        """
        first = Counter(
            name for groups in self.named for name in dict.fromkeys(group[0] for group in groups)
        )
        return [
            (name, n)
            for name, n in first.most_common()
            if name not in known and n >= share * len(self)
        ]


def begin_subsamples(
    trail: History, regions: Sequence[np.ndarray], count: int, *, executor: Executor | None = None
) -> Callable[[], Subsamples]:
    """Begin to repeat a search on halves of its poses; return a function that waits for the names.

    Args:
        trail: the search on all rows.
        regions: for each station shape (rows,), the region of joint space of each training row.
        count: number of halves.
        executor: runs the searches, all started now; default: sequentially, here, when they are
            waited for.
    """
    if not count:
        return lambda: Subsamples((), 0)
    few, rows = sampled(trail.first, trail.policy)
    # The correlation along the rows is estimated from all rows.
    few = replace(few, options=replace(few.options, serial=False))
    # A few positions beside days of an IMU are fewer still in a half, and would be fitted exactly.
    few = replace(few, noise=few.noise.no_less_than(_LEAST * trail.final.solution.sigma))
    offsets = np.cumsum([0, *(int(part.max()) + 1 for part in regions)])
    joined = np.concatenate(
        [part + offset for part, offset in zip(regions, offsets, strict=False)]
    )[rows]
    parts = [np.unique(joined[span]) for span in few.problem.rows]
    found = [effect for step in trail.steps for effect in (*step.effects, *step.equivalent)]
    nameless = frozenset(nameless_kind(effect) for effect in found if effect.is_nameless)
    expected = tuple(step.tested for step in trail.steps if not step.is_elastic)
    # Names do not depend on the final resolution of curves.
    policy = replace(trail.policy, finer=1.0)
    run = partial(_names_in_half, few, joined, trail.extra, policy, nameless, expected)
    halves = list(_subsamples(parts, joined, count))
    poses = round(float(np.mean([np.count_nonzero(np.isin(joined, half)) for half in halves])))
    named = spread(run, halves, label="subsample", executor=executor)
    return lambda: Subsamples(tuple(groups for groups in named if groups is not None), poses)


def _subsamples(
    parts: Sequence[np.ndarray], regions: np.ndarray, count: int
) -> Iterator[np.ndarray]:
    """Yield the regions of each half, with about half of the rows of every station."""
    rng = np.random.default_rng(0)
    sizes = np.bincount(regions)
    for k in range(count):
        if k % 2 == 0:
            orders = [rng.permutation(part) for part in parts]
            sums = [np.cumsum(sizes[order]) for order in orders]
            # At least one region, and not all.
            cuts = [
                int(np.clip(np.argmin(np.abs(n - 0.5 * n[-1])) + 1, 1, max(len(n) - 1, 1)))
                for n in sums
            ]
        pairs = zip(orders, cuts, strict=True)
        yield np.concatenate([order[cut:] if k % 2 else order[:cut] for order, cut in pairs])


def _names_in_half(
    first: ModelFit,
    regions: np.ndarray,
    extra: tuple[Effect, ...],
    policy: Policy,
    nameless: frozenset[NamelessKind],
    expected: tuple[Effect, ...],
    half: np.ndarray,
) -> tuple[Group, ...] | None:
    """Return the names found by a search on some regions; None if their rows can't be fitted."""
    rows = np.flatnonzero(np.isin(regions, half))
    groups = np.unique(regions[rows], return_inverse=True)[1] % TESTING.blocks
    try:
        few = first.select(rows)
        start = refit(few, few.options.effects, start={})
        known: dict[str, Any] = {"extra": extra, "nameless": nameless, "expected": expected}
        return tuple(_groups(discover_effects(start, groups, policy=policy, **known)))
    except PincalError:
        return None


def _groups(trail: History) -> Iterator[Group]:
    """Yield the names found by a search, as in its findings: elasticity joint by joint."""
    for step in trail.steps:
        if step.is_elastic:
            yield from (
                (EffectName.of(sure.effect).in_tables,)
                for sure in significant_compliances(trail.final, step.effects)
            )
        else:
            yield tuple(
                EffectName.of(effect).in_tables for effect in (step.effect, *step.equivalent)
            )


def with_subsamples(
    findings: Findings, halves: Subsamples, bootstrap: Bootstrap | None
) -> Findings:
    """Return findings with their stability, from names in halves of the poses, and a bootstrap of
    the last effect.
    """
    if not halves:
        return changed(findings, bootstrap=bootstrap)
    every = [(entry, halves.stability(entry)) for entry in findings.effects]
    effects = tuple(changed(entry, stability=of) for entry, of in every)
    names = (
        {key: getattr(entry, key) for key in EffectName.__struct_fields__} for entry in effects
    )
    hints = (
        Repeated(**name, stability=of)
        for name, (_, of) in zip(names, every, strict=True)
        if of.share < SURE
    )
    # Names found in most halves that are neither found on all rows nor equivalents.
    known = [name.in_tables for entry in effects for name in (entry, *entry.equivalent)]
    only = (
        Repeated(**asdict(name), stability=Stability(named, len(halves)))
        for name, named in halves.others(known, SURE)
    )
    stability: dict[str, Any] = {
        "hints": tuple(hints),
        "only_in_halves": tuple(only),
        "poses_in_a_half": halves.poses,
    }
    return changed(findings, effects=effects, bootstrap=bootstrap, **stability)
