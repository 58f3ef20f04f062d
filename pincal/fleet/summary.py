"""Summaries of a type and of a fleet: how far machines differ, errors of the data sheet, unusual
machines, changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.special import ndtr

from pincal.design.design_model import DesignModel
from pincal.design.reach import SensorSetup
from pincal.errors import BadInputError, counted
from pincal.fleet.fleet_numbers import TYPES, WATCH
from pincal.fleet.history import FleetChange, FleetHistory, LastCheck
from pincal.fleet.robot_type import Learned, Membership, RobotType
from pincal.identify.options import Options
from pincal.model.catalogue.masses import with_masses
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect
from pincal.model.effects import GEOMETRIC
from pincal.parameters import root_of
from pincal.result_table import Cell, Column, Kind, Table
from pincal.robot.robot import Robot
from pincal.thresholds import Count, Scale
from pincal.units import (
    Quantity,
    fixed,
    format_digits,
    format_readable,
    readable_unit,
    show_chance,
    show_percent,
    show_sigma,
    show_unit,
    show_value,
)

# Poses at which the tool is compared, and draws of the machines for exchangeability, of which ISO
# 9283 compares five.
_POSES: Count = 200
_DRAWN: Count = 200
_COMPARED: Count = 5
# Numbers of poses for which the error of a further machine is predicted, and sets of poses of each.
_NUMBERS: tuple[Count, ...] = (4, 6, 8, 10, 12, 15, 20, 25, 30, 40, 60)
_SETS: Count = 8
# 95 % of a normal distribution lie within this number of standard deviations.
_INTERVAL: Scale = 1.96
# Number of robots listed, in tables and in brief, and of groups in brief.
_FIRST: Count = 10
BRIEF: Count = 4
_GROUPS: Count = 2
# Power of ten of odds beyond which their size means nothing more.
_BEYOND_DOUBT: Scale = 10.0
# Number of parameters named in which the data sheet is wrong.
_NAMED: Count = 3

_State = Literal["changed", "watch", "drifted"]


@dataclass(frozen=True)
class AtTool:
    """How far machines of a type differ at the tool after fitting base and tool, over random poses
    [m].

    Attributes:
        spread: root mean square distance of a machine from the mean one.
        by_effect: the same by each effect alone.
        by_parameter: shape (P,), the same by each parameter of the type alone; nan if the model
            lacks it.
        sheet: root mean square distance of the mean machine from the nominal one, by its lengths
            and angles.
        exchangeability: largest distance between any two of five machines at the same joint
            positions, mean over poses and draws (exchangeability of ISO 9283, at random poses).
        needed: number of poses -> predicted root mean square error of a further machine, with this
            type and without.
    """

    spread: float
    by_effect: dict[str, float]
    by_parameter: np.ndarray
    sheet: float
    exchangeability: float
    needed: dict[int, tuple[float, float]]

    def poses_for(self, error: float) -> tuple[int | None, int | None]:
        """Return the fewest poses that reach an error [m], with the type and without; None if more
        than tabulated.
        """
        with_type, without = (
            next((poses for poses, both in self.needed.items() if both[k] <= error), None)
            for k in (0, 1)
        )
        return with_type, without


def at_tool(
    of: RobotType,
    robot: Robot,
    effects: tuple[Effect, ...] = GEOMETRIC,
    *,
    noise: float = 5e-5,
) -> AtTool:
    """Return how far machines of a type differ at the tool.

    Args:
        of: the type.
        robot: the arm.
        effects: of the model of a further machine, calibrated from positions.
        noise: of one component of a position [m].

    Raises:
        BadInputError: if the arm has another nominal geometry, or the model has none of the type's
            parameters.
    """
    rng = np.random.default_rng(0)
    cared = Conditions.at(robot.random_configurations(_POSES, rng))
    alone = Options(effects=with_masses(robot, effects), sigma=noise)
    typed = replace(alone, earlier=of.prior_of(robot, effects))
    designs = [DesignModel.of(robot, cared, options, SensorSetup()) for options in (typed, alone)]
    motion = _ToolMotion.of(designs[1], of, cared)
    exchangeability = motion.exchangeability(of, rng)
    needed = {}
    for poses in _NUMBERS:
        sets = [Conditions.at(robot.random_configurations(poses, rng)) for _ in range(_SETS)]
        with_type, without = np.median(
            [[design.foreseen(one, cared) for design in designs] for one in sets], axis=0
        )
        needed[poses] = float(with_type), float(without)
    return AtTool(
        _rms(np.sum(motion.moved(of) ** 2, axis=1)),
        motion.by_effect(of),
        motion.by_parameter(of),
        motion.sheet(of),
        exchangeability,
        needed,
    )


@dataclass(frozen=True, eq=False)
class _ToolMotion:
    """The motion of the tool over N poses by the parameters that a type and a model share.

    Attributes:
        places: shape (K,), indices of these parameters in the type.
        placed: shape (3 N, K), the motion by each, after fitting base and tool [m per its unit].
    """

    places: np.ndarray
    placed: np.ndarray

    @classmethod
    def of(cls, model: DesignModel, of: RobotType, cared: Conditions) -> _ToolMotion:
        """Return the motion by a model's parameters.

        Raises:
            BadInputError: if the model has none of the type's parameters.
        """
        own = [k for k, name in enumerate(model.own_names) if name in of.names]
        if not own:
            raise BadInputError(
                f"the model of {model.model.chain.robot.name} has no parameter of the type; "
                "expected one of its machines"
            )
        places = np.array([of.names.index(model.own_names[k]) for k in own])
        # Differences equivalent to a rigid displacement of base or tool do not count.
        placed = (model.placed_errors(cared) / model.units[model.has_prior])[:, own]
        return cls(places, placed)

    def covariance(self, of: RobotType) -> np.ndarray:
        """Return the covariance of machines, shape (K, K)."""
        return np.asarray(of.determined[2][np.ix_(self.places, self.places)])

    def moved(self, of: RobotType) -> np.ndarray:
        """Return a root of the covariance of the tool's motion over machines, shape (3 N, P)."""
        return np.asarray(self.placed @ of.readable[self.places] @ root_of(of.covariance))

    def by_effect(self, of: RobotType) -> dict[str, float]:
        """Return the root mean square motion by each effect alone [m]."""
        covariance = self.covariance(of)
        found = {}
        for effect in dict.fromkeys(of.parameters[k].effect for k in self.places):
            at = np.array([of.parameters[k].effect == effect for k in self.places])
            part = self.placed[:, at]
            found[effect] = _rms(np.sum(part @ covariance[np.ix_(at, at)] * part, axis=1))
        return found

    def by_parameter(self, of: RobotType) -> np.ndarray:
        """Return the root mean square motion by each parameter alone, shape (P,) [m]; nan where
        the model lacks it.
        """
        found = np.full(len(of.names), np.nan)
        variances = np.diag(self.covariance(of))
        found[self.places] = np.sqrt(3.0 * np.mean(self.placed**2, axis=0) * variances)
        return found

    def sheet(self, of: RobotType) -> float:
        """Return the root mean square motion from the nominal machine to the mean one [m]."""
        # A data sheet contains lengths and angles, but no compliances.
        is_sheet = np.array([of.parameters[k].unit in ("m", "rad") for k in self.places])
        return _rms((self.placed @ (of.determined[0][self.places] * is_sheet)) ** 2)

    def exchangeability(self, of: RobotType, rng: np.random.Generator) -> float:
        """Return the largest distance between any two of some drawn machines, mean over poses and
        draws [m].
        """
        moved = self.moved(of)
        drawn = (rng.normal(size=(_DRAWN, _COMPARED, moved.shape[1])) @ moved.T).reshape(
            _DRAWN, _COMPARED, -1, 3
        )
        apart = np.linalg.norm(drawn[:, :, None] - drawn[:, None], axis=-1).max(axis=(1, 2))
        return float(apart.mean())


def _rms(squares: np.ndarray) -> float:
    """Return the root mean square length of N displacements with these mean squares of components,
    shape (3 N,).
    """
    return float(np.sqrt(3.0 * np.mean(squares)))


def parameter_summary(
    of: RobotType, found: AtTool | None = None, *, most: int | None = None
) -> Table:
    """Return errors of the data sheet and differences between machines, by parameter.

    Args:
        of: the type.
        found: the differences at the tool, by which parameters are sorted if given.
        most: number of parameters; default: all.
    """
    share = np.diag(of.seen)
    moves = np.full(len(of.names), np.nan) if found is None else found.by_parameter
    order = (
        np.arange(len(of.names))
        if found is None
        else np.argsort(-np.nan_to_num(moves * (share > TYPES.told)))
    )
    rows = _parameter_rows(of, moves)
    note = (
        "mean: of all machines minus the data sheet, with half the width of its 95 % "
        "interval; differ: standard deviation "
        "of machines, at the tool after fitting base and tool; determined: share of the "
        "parameter that the "
        "readings separate from the others; the rest is a matter of convention"
    )
    columns = (
        Column("parameter", kind=Kind.NAME),
        Column("unit", kind=Kind.LABEL, show=show_unit),
        Column("mean", kind=Kind.NUMBER, show=show_value),
        Column("95 %", kind=Kind.NUMBER, show=show_sigma),
        Column("differ", kind=Kind.NUMBER, show=show_sigma),
        Column("at the tool", "mm", kind=Kind.NUMBER, show=fixed(3)),
        Column("determined", kind=Kind.NUMBER, show=show_percent),
    )
    return Table("Machines of the type", columns, tuple(rows[k] for k in order[:most]), (note,))


def _parameter_rows(of: RobotType, moves: np.ndarray) -> list[tuple[Cell, ...]]:
    """Return the row of each parameter; ``moves``, shape (P,), at the tool [m]."""
    share = np.diag(of.seen)
    sheet, *spreads = of.determined
    sigma, spread = (np.sqrt(np.diag(C)) for C in spreads)
    rows = list[tuple[Cell, ...]]()
    for k, p in enumerate(of.parameters):
        numbers = [Quantity(float(x), p.unit) for x in (sheet[k], _INTERVAL * sigma[k], spread[k])]
        at = None if np.isnan(moves[k]) else float(1e3 * moves[k])
        told = [*numbers, at] if share[k] > TYPES.told else (None,) * 4
        rows.append((p.name, p.unit, *told, float(share[k])))
    return rows


def effect_summary(found: AtTool) -> Table:
    """Return the differences between machines at the tool, by effect."""
    columns = (
        Column("effect", kind=Kind.LABEL),
        Column("at the tool", "mm", Kind.NUMBER, fixed(3)),
    )
    rows = [
        (effect, 1e3 * size)
        for effect, size in sorted(found.by_effect.items(), key=lambda one: -one[1])
    ]
    return Table("Differences by effect", columns, tuple(rows))


def poses_summary(found: AtTool) -> Table:
    """Return the predicted error of a further machine by the number of its poses."""
    columns = (
        Column("poses", kind=Kind.NUMBER),
        Column("with the type", "mm", Kind.NUMBER, fixed(3)),
        Column("without", "mm", Kind.NUMBER, fixed(3)),
    )
    rows = tuple((poses, *(1e3 * error for error in both)) for poses, both in found.needed.items())
    return Table("Random poses of a further machine", columns, rows)


def strangers(members: Sequence[Membership]) -> list[tuple[Membership, float]]:
    """Return the machines that do not belong to their type, with p-values adjusted for their number
    (Holm 1979).
    """
    ranked = sorted(members, key=lambda one: one.p_value)
    found = list[tuple[Membership, float]]()
    largest = 0.0
    for k, member in enumerate(ranked):
        largest = max(largest, min(1.0, member.p_value * (len(ranked) - k)))
        if largest < TYPES.among_all and member.off:
            found.append((member, largest))
    return found


def member_summary(learned: Learned) -> Table:
    """Return the machines that do not belong to the type, the least likely first."""
    columns = (
        Column("machine", kind=Kind.NAME),
        Column("p", kind=Kind.NUMBER, show=show_chance),
        Column("differs in", kind=Kind.NAME),
    )
    rows = [
        (member.machine or "-", p, ", ".join(member.off))
        for member, p in strangers(learned.members)
    ]
    hit = f"of which an estimated {100 * learned.type.hit:.1f} % are unlike the others"
    count = f"{counted(len(learned.members), 'machine')}, {hit}"
    return Table("Machines unlike the others", columns, tuple(rows), (count,))


def type_lines(learned: Learned, at: AtTool | None, *, error: float | None = None) -> Iterator[str]:
    """Yield a summary of a type, line by line.

    Args:
        learned: the type and its machines.
        at: the differences at the tool, if the arm is known.
        error: wanted for a further machine [m].
    """
    of = learned.type
    apart = len(strangers(learned.members))
    machines = counted(of.machines, "machine")
    parameters = counted(len(of.names), "parameter")
    yield f"{of.robot}: {machines}, {parameters}, of which they determine {np.trace(of.seen):.0f}"
    if at is not None:
        yield (
            f"differ by:         {1e3 * at.spread:.3f} mm rms at the tool from their mean, "
            "after fitting base and tool"
        )
        yield f"exchangeability:   {1e3 * at.exchangeability:.3f} mm (ISO 9283, five machines)"
        yield (
            f"data sheet:        {1e3 * at.sheet:.3f} mm rms off the mean machine, {_off_sheet(of)}"
        )
    yield f"unlike the others: {apart} of {of.machines}; {100.0 * of.hit:.1f} % are expected"
    if at is not None and error is not None:
        words = [
            "more than " + str(_NUMBERS[-1]) if count is None else str(count)
            for count in at.poses_for(error)
        ]
        yield (
            f"a further machine: {words[0]} random poses reach {1e3 * error:.3g} mm; without "
            f"the type {words[1]}"
        )


def _off_sheet(of: RobotType) -> str:
    """Return the number of parameters in which the data sheet is significantly off (Holm 1979), and
    the first of them.
    """
    mean, C, _ = of.determined
    half = _INTERVAL * np.sqrt(np.maximum(np.diag(C), 1e-300))
    places = [
        k
        for k, p in enumerate(of.parameters)
        if p.unit in ("m", "rad") and of.seen[k, k] > TYPES.told
    ]
    p = 2.0 * ndtr(-_INTERVAL * np.abs(mean) / half)
    ranked = sorted(places, key=lambda k: p[k])
    count = next(
        (i for i, k in enumerate(ranked) if p[k] * (len(ranked) - i) >= TYPES.data_sheet),
        len(ranked),
    )
    words = []
    for k in ranked[:_NAMED][:count]:
        factor, unit = readable_unit(of.parameters[k].unit)
        words.append(f"{of.names[k]} {factor * mean[k]:+.3f} ± {factor * half[k]:.3f} {unit}")
    return f"significantly in {count} of {len(ranked)} parameters" + (
        f": {', '.join(words)}" if words else ""
    )


def plain_type(
    learned: Learned, at: AtTool | None, *, error: float | None = None
) -> dict[str, Any]:
    """Return the summary of a type as plain data; arguments as for :func:`type_lines`."""
    of = learned.type
    found = {
        "robot": of.robot,
        "machines": _plain_members(learned),
        "parameters": _plain_parameters(of),
        "hit": of.hit,
    }
    if at is None:
        return found
    poses = (
        {}
        if error is None
        else dict(zip(("with_type", "without"), at.poses_for(error), strict=True))
    )
    return found | {
        "spread_mm": 1e3 * at.spread,
        "sheet_mm": 1e3 * at.sheet,
        "exchangeability_mm": 1e3 * at.exchangeability,
        "effects_mm": {effect: 1e3 * size for effect, size in at.by_effect.items()},
        "errors_mm": {str(n): [1e3 * both[0], 1e3 * both[1]] for n, both in at.needed.items()},
        "poses": poses,
    }


def _plain_members(learned: Learned) -> list[dict[str, Any]]:
    return [
        {
            "machine": one.machine,
            "p_value": one.p_value,
            "like_others": one.probability,
            "differs_in": list(one.off),
        }
        for one in learned.members
    ]


def _plain_parameters(of: RobotType) -> list[dict[str, Any]]:
    mean, *spreads = of.determined
    sigma, spread = (np.sqrt(np.diag(C)) for C in spreads)
    return [
        {
            "name": p.name,
            "unit": p.unit,
            "mean": float(mean[k]),
            "mean_sigma": float(sigma[k]),
            "spread": float(spread[k]),
            "determined": float(of.seen[k, k]),
        }
        for k, p in enumerate(of.parameters)
    ]


def change_summary(found: FleetHistory, *, groups: bool | None = None) -> Table:
    """Return the changes in a fleet, the latest first: of robots, groups, or both."""
    columns = (
        Column("robot or group", kind=Kind.NAME),
        Column("since", kind=Kind.LABEL),
        Column("found", kind=Kind.LABEL),
        Column("what", kind=Kind.NAME),
        Column("by", kind=Kind.LABEL),
        Column("odds", kind=Kind.NUMBER, show=odds_words),
    )
    rows = [
        (
            one.subject,
            one.since,
            one.found,
            _causes(one),
            _by(one),
            one.log_e / np.log(10.0),
        )
        for one in sorted(found.changes, key=lambda one: one.found, reverse=True)
        if groups in (None, one.is_group)
    ]
    note = (
        "since: the first check after the change; odds: how much more probable the change makes "
        "the readings (e-value); beyond doubt: over 10 billion to 1; a joint without a symbol: "
        "several of its parameters at once"
    )
    return Table("Changes", columns, tuple(rows), (note,) if rows else ())


def odds_words(power: float) -> str:
    """Return odds in words, given their power of ten.

    Example:
        >>> [odds_words(power) for power in (150.6, 7.5, 3.1, 0.4, -0.2)]
        ['beyond doubt', '32 million to 1', '1300 to 1', '2.5 to 1', '1 to 1.6']
    """
    if power >= _BEYOND_DOUBT:
        return "beyond doubt"
    if power < 0.0:
        return f"1 to {format_digits(10.0 ** min(-power, _BEYOND_DOUBT))}"
    for word, size in (("billion", 9), ("million", 6)):
        if power >= size:
            return f"{format_digits(10.0 ** (power - size))} {word} to 1"
    digits = f"{float(f'{10.0**power:.2g}'):g}"
    return f"{digits} to 1"


def look_first(found: FleetHistory, most: int = _FIRST) -> Table:
    """Return the robots to look at first: those that changed and were not recalibrated, then those
    that may have.
    """
    columns = (
        Column("robot", kind=Kind.NAME),
        Column("state", kind=Kind.LABEL),
        Column("what", kind=Kind.NAME),
        Column("last check", kind=Kind.LABEL),
        Column("odds", kind=Kind.NUMBER, show=odds_words),
        Column("p-value", kind=Kind.NUMBER, show=show_chance),
        Column("adjusted", kind=Kind.NUMBER, show=show_chance),
    )
    rows = _first_rows(found)
    note = (
        "odds of a change: how much more probable it makes the readings since calibration "
        "(e-value); beyond doubt: over 10 billion to 1; p-value: of the last check, if nothing "
        "has changed; adjusted: for the false "
        "discovery rate among all checks of "
        "that round (Benjamini and Hochberg 1995)"
    )
    notes = [note] if rows else []
    if len(rows) > most:
        notes.append(f"and {len(rows) - most} more")
    notes += _on_others(found, len(rows))
    return Table("Inspect these first", columns, tuple(rows[:most]), tuple(notes))


def _first_rows(found: FleetHistory) -> list[tuple[Cell, ...]]:
    """Return the row of each robot that is to be looked at, in this order."""
    what = {one.subject: _by_what(one, _causes(one)) for one in found.changes}
    return [
        (
            one.machine,
            state,
            what.get(one.machine, "-") if one.machine in found.open else "-",
            one.day,
            one.log_e / np.log(10.0),
            one.p_value,
            one.q_value,
        )
        for one, state in _ranked(found)
    ]


def _ranked(found: FleetHistory) -> list[tuple[LastCheck, _State]]:
    """Return the robots that are to be looked at, and why, the most urgent first."""
    state: dict[str, _State] = dict.fromkeys(found.drifted, "drifted")
    state |= {one.machine: "watch" for one in found.last if one.q_value < WATCH.watched}
    state |= dict.fromkeys(found.open, "changed")
    listed = [(one, state[one.machine]) for one in found.last if one.machine in state]
    order = ("changed", "watch", "drifted")
    return sorted(listed, key=lambda one: (order.index(one[1]), -one[0].log_e))


def history_line(found: FleetHistory) -> str:
    """Return a summary of a fleet's history in one line."""
    robots = sum(not change.is_group for change in found.changes)
    whole = f"{counted(found.robots, 'robot')}, {counted(found.checks, 'check')}"
    return f"{whole}: {robots} changed, {len(found.open)} of them not recalibrated since"


def brief_lines(found: FleetHistory, most: int = BRIEF) -> list[tuple[str, str]]:
    """Return groups that drifted, and robots to look at, each behind its name."""
    return [*group_lines(found, min(most, _GROUPS)), *robot_lines(found, most)]


def group_lines(found: FleetHistory, most: int | None = None) -> Iterator[tuple[str, str]]:
    """Yield each group that drifted, the last found first, and what was found on it; then how many
    other groups there are.
    """
    groups = [change for change in found.changes if change.is_group]
    latest = sorted(groups, key=lambda one: (one.found, one.log_e), reverse=True)
    for change in latest[:most]:
        yield change.subject, f"drift since {change.since}: {_by_what(change, change.what)}"
    if more := len(groups[most:]) if most is not None else 0:
        yield "groups", f"{more} more drifted"


def robot_lines(found: FleetHistory, most: int = BRIEF) -> Iterator[tuple[str, str]]:
    """Yield each robot to look at, those first that changed and were not recalibrated, and what was
    found on it; then how many others there are.
    """
    ranked = _ranked(found)
    changes = {one.subject: one for one in found.changes}
    for last, state in ranked[:most]:
        if state == "changed":
            words = _change_words(changes[last.machine])
        elif state == "watch":
            words = f"watch: unusual on {last.day} (p {show_chance(last.p_value)}), but no alarm"
        else:
            words = f"drifted with its group; last checked on {last.day}"
        yield last.machine, words
    more = [f"{len(ranked) - most} more to look at"] if len(ranked) > most else []
    if words := "; ".join([*more, *_on_others(found, len(ranked))]):
        yield "others" if ranked else "all", words


def _on_others(found: FleetHistory, looked_at: int) -> Iterator[str]:
    """Yield on how many robots nothing was found, other than those to look at, if there are any."""
    if not found.last:
        # A robot that was calibrated since its last check has none that counts.
        yield "no robot has been checked since its calibration"
    elif others := len(found.last) - looked_at:
        yield f"nothing was found on {counted(others, 'other robot' if looked_at else 'robot')}"


def _change_words(change: FleetChange) -> str:
    """Return since when a robot has changed, what, by how much, and how sure that is."""
    since = f"since {change.since}"
    if change.found != change.since:
        since += f" (found {change.found})"
    what = _by_what(change, _causes(change))
    return f"changed {since}: {what}; odds {odds_words(change.log_e / np.log(10.0))}"


def next_step(found: FleetHistory, store: str) -> str:
    """Return the one thing to do next, with the commands."""
    add = f"pincal fleet add {store}"
    last, state = next(iter(_ranked(found)), (None, None))
    if last is None:
        # Without a name, a table would be a check of a machine called like its file.
        check = f"{add} CHECK.csv --check --machine NAME"
        calm = "Nothing to inspect. " if found.last else ""
        return f"{calm}Add the next round of checks: {check}"
    if state == "changed":
        return (
            f"Inspect {last.machine}; once it is repaired, measure and calibrate it again: {add} "
            f"NEW.csv --robot ROBOT.urdf --machine {last.machine}, then pincal fleet calibrate"
        )
    if state == "watch":
        return f"Check {last.machine} again soon: {add} CHECK.csv --check --machine {last.machine}"
    return "Inspect what the robots of the group share, and calibrate them again afterwards"


def plain_history(found: FleetHistory) -> dict[str, Any]:
    """Return a fleet's history as plain data."""
    changes, last = ([vars(one) for one in of] for of in (found.changes, found.last))
    return {
        "robots": found.robots,
        "checks": found.checks,
        "open": sorted(found.open),
        "drifted": sorted(found.drifted),
        "changes": [one | {"equals": list(one["equals"])} for one in changes],
        "last": last,
    }


def _causes(change: FleetChange) -> str:
    """Return what has changed, and what explains it as well."""
    return " or ".join((change.what, *change.equals[:2]))


def _by_what(change: FleetChange, what: str) -> str:
    """Return what has changed, and by how much where that is known."""
    return f"{what} {_by(change)}".removesuffix(" -")


def _by(change: FleetChange) -> str:
    return "-" if change.change is None else format_readable(change.change, change.unit, "+.3f")
