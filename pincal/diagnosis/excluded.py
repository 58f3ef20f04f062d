"""How large a change has to be to be noticed, and which poses would tell two changes apart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.special import fdtri, ncfdtr

from pincal.diagnosis.changes import Change
from pincal.diagnosis.evidence import Evidence
from pincal.diagnosis.search import Step, Verdict, limit_of
from pincal.io.diagnosis_file import ExcludedEntry

# Chance with which a change of the size that is given would have been noticed.
POWER = 0.9
# Non-centrality at which two changes are told apart: 5.5 standard deviations of one parameter.
_TOLD_APART = 30.0
# Times as many poses as there were that are tried to tell changes apart.
_TIMES = (1, 2, 4)
# A direction in which an effect shows less than this part of what it shows in the best is not seen.
_SEEN = 1e-6


def excluded(verdict: Verdict) -> Iterator[ExcludedEntry]:
    """Yield what would have been noticed beside what was found: each parameter, each effect, from which size on."""
    lineup, found = verdict.lineup, verdict.evidence
    taken = {lineup.changes[i].heading for i in verdict.happened}
    listed: set[tuple[object, ...]] = set()
    motion = lineup.motion(verdict.values)
    for change, places in zip(lineup.changes, lineup.places, strict=True):
        units = {lineup.station.parameters[i].unit for i in places}
        key = (*change.heading, change.parameters if change.effect is None else None)
        if change.parts or change.heading in taken or len(units) > 1 or key in listed:
            continue
        worst = _weakest(found, places)
        if worst is None:
            continue
        rank, strength, direction = worst
        smallest = float(np.sqrt(noticed_noncentrality(rank, verdict.degrees + found.degrees, limit_of(verdict)) / strength))
        listed.add(key)
        shift = np.linalg.norm(motion[:, :, places] @ direction, axis=1).max()
        yield ExcludedEntry(
            effect=change.name,
            joint=change.joint,
            source=change.source,
            parameter=change.parameters[0] if len(places) == 1 else "",
            smallest=smallest,
            unit=units.pop(),
            tip_mm=float(1e3 * smallest * shift),
        )


def _weakest(found: Evidence, places: np.ndarray) -> tuple[int, float, np.ndarray] | None:
    """Return rank, non-centrality of a change of size 1 in the direction that shows least, and this direction."""
    rank = found.gain(places)[1]
    strengths, directions = np.linalg.eigh(found.P[np.ix_(places, places)])
    if rank < len(places) or strengths[0] <= _SEEN * strengths[-1]:
        return None
    return rank, float(strengths[0]), directions[:, 0]


@lru_cache(maxsize=256)
def noticed_noncentrality(rank: int, degrees: float, limit: float, power: float = POWER) -> float:
    """Return the non-centrality at which a change of some rank is noticed with the chance ``power``."""
    from scipy.optimize import brentq

    rest = max(degrees - rank, 1.0)
    F = float(fdtri(rank, rest, 1.0 - limit))
    upper = 100.0
    while ncfdtr(rank, rest, upper, F) > 1.0 - power:
        upper *= 2.0
    return float(brentq(lambda value: ncfdtr(rank, rest, value, F) - (1.0 - power), 1e-6, upper))


def tell_apart(verdict: Verdict, step: Step) -> str:
    """Return, in words, how many more poses would tell a change from the likeliest of the others."""
    rival = next((score.change for score in step.equivalent), None)
    if rival is None:
        return ""
    n = len(verdict.lineup.station)
    for times in _TIMES:
        if _separation(verdict, step.score.change, rival, times * n) > _TOLD_APART:
            return f"measure {times * n} more poses over the whole range of the joints, with and without load"
    return "no further poses with this instrument do; look at the joints themselves"


def _separation(verdict: Verdict, change: int, rival: int, more: int) -> float:
    """Return the signal of a change that another can't take over if poses are added, squared, in units of the noise."""
    lineup, rng = verdict.lineup, np.random.default_rng(0)
    rows = np.resize(np.arange(len(lineup.station)), len(lineup.station) + more)
    wider = lineup.station.select(rows)
    conditions, robot = wider.conditions, wider.model.chain.robot
    q, payload = conditions.q.copy(), conditions.payload.copy()
    q[-more:] = robot.random_configurations(more, rng)
    payload[-more:] = rng.choice(lineup.robot.covered.payload, more)
    there = replace(wider, conditions=replace(conditions, q=q, payload=payload))
    others = [i for i in verdict.happened if i != change]
    found = replace(lineup, station=there).weigh(verdict.values, others)
    c, g = lineup.places[change], lineup.places[rival]
    g = np.setdiff1d(g, c)
    size = (verdict.values - lineup.start)[c]
    if not len(g):
        return 0.0
    left = found.given(g).P[np.ix_(c, c)]
    return float(max(size @ left @ size, 0.0))


def names_of(changes: tuple[Change, ...], step: Step, most: int = 8) -> list[Change]:
    """Return the changes that a step can't tell from its own, each heading once."""
    found = {changes[score.change].heading: changes[score.change] for score in reversed(step.equivalent)}
    found.pop(changes[step.score.change].heading, None)
    return list(reversed(found.values()))[:most]
