r"""Which robots have changed, how and since when, over many robots and months, with a bound on
false discoveries.

A robot is known from its calibration and all checks since. For each round s of checks the
hypothesis is that one parameter, one element (joint) or everything on it changed just before. The
likelihood ratio of the readings from s to t, of marginal likelihoods, is a test martingale in t;
weighted with the probability h of a change in each round these ratios add up to an e-process
(Ramdas, Gruenwald, Vovk and Shafer 2023),

.. math:: E_t = \sum_{s \le t} h (1 - h)^{s - 1} E_{s,t} + (1 - h)^t ,

whose mean is at most 1 at any time on a robot that has not changed. A robot is reported as changed
if E is at least
:math:`N / (\alpha k)` where it is the k-th largest of N robots. Then each of R alarms has an
  e-value of at least
:math:`N / (\alpha R)`, so that the false discovery rate of all alarms, whenever they were raised,
  is at most alpha under any
dependence between robots and rounds (e-BH, Wang and Ramdas 2022). A recalibrated robot is a new
hypothesis; its j-th one has the weight :math:`6 / (\pi j)^2`.

A change shared by the robots of a supplier, a batch or a hall is a drift of that group: scores and
their covariances add up over its robots. Of all changes of robots and groups the likeliest is
reported first; the drift of a group is subtracted from its robots before these are judged.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pincal.errors import BadInputError
from pincal.fleet.evidence import least_chance, log_evidence
from pincal.fleet.fleet_numbers import WATCH
from pincal.fleet.history import (
    DIAGNOSED,
    WHOLE_FLEET,
    FleetChange,
    FleetHistory,
    LastCheck,
    Visit,
    benjamini_hochberg,
    e_value,
)
from pincal.fleet.machines import Machine, gathered
from pincal.fleet.robot_type import EVERYTHING, RobotType
from pincal.thresholds import Count, Scale

FALSE_DISCOVERIES = WATCH.false_discoveries
"""Largest fraction of alarms that are false, in the long run."""

# Number of rounds, the first one and the last ones, before which a change may have occurred.
_WINDOW: Count = 7
# Size of a change, in units of the priors without a type: a millimetre or a milliradian.
_SIZE: Scale = 0.3
# Upper bound on log evidence, so that exponentials are finite.
_MOST: Scale = 600.0


def fleet_changes(
    of: RobotType, visits: Iterable[Visit], *, alpha: float = FALSE_DISCOVERIES, every: int = 7
) -> FleetHistory:
    """Return which robots have changed, how and since when.

    Robots that share a label of their calibrations, such as a supplier or a hall, are a group that
    may drift.

    Args:
        of: their type.
        visits: calibrations and checks of robots, in any order.
        alpha: fraction of the alarms that may be false.
        every: length of a round in days.

    Raises:
        BadInputError: for a day that is no ISO date, a check of a robot without an earlier
            calibration, or an alpha outside 0 to 0.5.
    """
    if not 0.0 < alpha < 0.5:
        raise BadInputError(
            f"alpha is {alpha:g}; expected the fraction of alarms that may be false, such as 0.05"
        )
    rounds = dict[int, list[Visit]]()
    for visit in visits:
        try:
            day = int(np.datetime64(visit.day, "D").astype(int))
        except ValueError:
            raise BadInputError(
                f"robot {visit.machine!r}: day {visit.day!r}; expected an ISO date such "
                "as 2026-11-03"
            ) from None
        rounds.setdefault(day // every, []).append(visit)
    fleet = FleetWatch(of, alpha)
    for number in sorted(rounds):
        fleet.take(number, rounds[number])
    return fleet.history()


@dataclass(eq=False)
class _Step:
    """What was known of a robot before a round of checks.

    Attributes:
        round: its number.
        day: of the robot's check in it.
        H, g: information, including the prior.
        extra: sum of log e-values of diagnoses from this round on.
        p_value: smallest p-value of diagnoses in this round.
        q, Q: score of a change before the round, and its covariance.
        logs: log evidence of each kind of change, weighted with its probability.
        total: log evidence of any change.
    """

    round: int
    day: str
    H: np.ndarray
    g: np.ndarray
    extra: float = 0.0
    p_value: float = 1.0
    q: np.ndarray = field(default_factory=lambda: np.empty(0))
    Q: np.ndarray = field(default_factory=lambda: np.empty(0))
    logs: np.ndarray = field(default_factory=lambda: np.empty(0))
    total: float = 0.0


@dataclass(eq=False)
class _Epoch:
    """A robot since its calibration.

    Attributes:
        number: number of its calibrations.
        groups: the groups that it belongs to.
        H, g: information of the prior, the calibration and all checks, with the drift of groups
            subtracted.
        drift: shape (P,), of its groups so far.
        steps: before the first round of checks, and before the last ones.
        checks: number of rounds.
        is_changed: whether it has changed and was not recalibrated since.
    """

    number: int
    groups: tuple[str, ...]
    H: np.ndarray
    g: np.ndarray
    drift: np.ndarray
    steps: list[_Step] = field(default_factory=list)
    checks: int = 0
    is_changed: bool = False

    def parts(self) -> np.ndarray:
        """Return the log evidence of a change before each round, weighted with its probability,
        shape (steps,).
        """
        return np.asarray(
            np.array([step.total + step.extra for step in self.steps]) + _hazard(self.steps)
        )

    def log_e(self) -> float:
        """Return the logarithm of the e-process, including the weight of the hypothesis."""
        whole = np.logaddexp.reduce([*self.parts(), self.checks * np.log1p(-WATCH.hazard)])
        return float(whole + np.log(6.0 / (np.pi * self.number) ** 2))


class FleetWatch:
    """Robots of a type, monitored round by round; ``alpha`` is the fraction of the alarms that may
    be false.
    """

    def __init__(self, of: RobotType, alpha: float = FALSE_DISCOVERIES) -> None:
        self.type = of
        self.alpha = alpha
        prior = of.prior()
        P = len(of.parameters)
        self._prior_H = np.linalg.inv(prior.dense_covariance() / np.outer(of.priors, of.priors))
        self._prior_g = self._prior_H @ (prior.values / of.priors)
        elements = list(dict.fromkeys(p.element for p in of.parameters))
        self._elements = [
            np.array([k for k, p in enumerate(of.parameters) if p.element == e]) for e in elements
        ]
        self._ways = [*np.arange(P)[:, None], *self._elements, np.arange(P)]
        self._names = [*of.names, *elements, EVERYTHING]
        chances = (
            [WATCH.one / P] * P
            + [WATCH.element / len(elements)] * len(elements)
            + [WATCH.everything]
        )
        self._log_chances = np.log(chances)
        self._epochs = dict[str, _Epoch]()
        self._last = dict[str, LastCheck]()
        self._changes = list[FleetChange]()
        self._checks = 0

    def history(self) -> FleetHistory:
        """Return what has been found so far."""
        last = tuple(sorted(self._last.values(), key=lambda one: -one.log_e))
        changed = frozenset(name for name, epoch in self._epochs.items() if epoch.is_changed)
        drifted = frozenset(name for name, epoch in self._epochs.items() if epoch.drift.any())
        return FleetHistory(
            tuple(self._changes), last, len(self._epochs), self._checks, changed, drifted
        )

    def take(self, number: int, visits: Iterable[Visit]) -> tuple[FleetChange, ...]:
        """Add a round and return the changes that it reveals.

        Args:
            number: of the round, larger than all before.
            visits: of the round.

        Raises:
            BadInputError: for a check of a robot without an earlier calibration.
        """
        checked = dict[str, None]()
        day = ""
        before = len(self._changes)
        for visit in sorted(visits, key=lambda one: (one.day, not one.is_calibration, one.machine)):
            day = visit.day
            if visit.is_calibration:
                self._begin(visit)
                checked.pop(visit.machine, None)
            elif visit.machine not in self._epochs:
                raise BadInputError(
                    f"robot {visit.machine!r} was checked on {visit.day} but not "
                    "calibrated before; add its calibration"
                )
            elif not self._epochs[visit.machine].is_changed:
                self._add(number, visit)
                checked[visit.machine] = None
        for robot in checked:
            self._weigh(self._epochs[robot])
        if checked:
            self._note(list(checked), day)
            while (found := self._next(day)) is not None:
                self._changes.append(found)
            if any(change.is_group for change in self._changes[before:]):
                self._note(list(checked), day)
        return tuple(self._changes[before:])

    def _begin(self, visit: Visit) -> None:
        if visit.found is None:
            raise BadInputError(
                f"robot {visit.machine!r}: a calibration without an information matrix; "
                "calibrate again"
            )
        H, g = self._form(visit.found)
        number = self._epochs[visit.machine].number + 1 if visit.machine in self._epochs else 1
        groups = (
            WHOLE_FLEET,
            *(f"{key}={value}" for key, value in sorted(visit.found.labels.items())),
        )
        known = self._prior_H + H, self._prior_g + g
        self._epochs[visit.machine] = _Epoch(number, groups, *known, np.zeros(len(g)))
        self._last.pop(visit.machine, None)

    def _form(self, machine: Machine) -> tuple[np.ndarray, np.ndarray]:
        """Return information in units of the type's priors; parameters outside the type are held as
        calibrated.
        """
        found = gathered([machine], like=self.type.parameters)
        P = len(self.type.priors)
        self.type.require(f"machine {machine.name!r} ({found.robot})", found.geometry)
        scale = self.type.priors / found.priors[:P]
        return found.forms.H[0, :P, :P] * np.outer(scale, scale), found.forms.g[0, :P] * scale

    def _add(self, number: int, visit: Visit) -> None:
        """Add a check."""
        epoch = self._epochs[visit.machine]
        if not epoch.steps or epoch.steps[-1].round < number:
            epoch.checks += 1
            epoch.steps.append(_Step(number, visit.day, epoch.H, epoch.g))
            # The first one is kept.
            del epoch.steps[1:-_WINDOW]
        self._checks += 1
        if visit.found is not None:
            H, g = self._form(visit.found)
            epoch.H = epoch.H + H
            epoch.g = epoch.g + g - H @ epoch.drift
        elif visit.p_value is not None:
            epoch.steps[-1].p_value = min(visit.p_value, epoch.steps[-1].p_value)
            for step in epoch.steps:
                step.extra += float(np.log(e_value(visit.p_value)))

    def _weigh(self, epoch: _Epoch) -> None:
        """Compute the evidence of a change before each round."""
        H, g = (np.array([getattr(step, name) for step in epoch.steps]) for name in ("H", "g"))
        # With information A before, B = T - A after and T in total: B - B T^-1 B = A - A T^-1 A.
        Q = H - H @ np.linalg.inv(epoch.H) @ H
        mean = np.linalg.solve(H, g[..., None])
        moved = np.linalg.solve(epoch.H, epoch.g)
        q = (H @ (moved[:, None] - mean))[..., 0]
        Q = 0.5 * (Q + Q.swapaxes(1, 2))
        for step, *found in zip(epoch.steps, q, Q, self._logs(q, Q), strict=True):
            step.q, step.Q, step.logs = found
            step.total = float(np.logaddexp.reduce(step.logs))

    def _logs(self, q: np.ndarray, Q: np.ndarray) -> np.ndarray:
        """Return the weighted log evidence of each kind of change, (steps, kinds), for q (steps,
        P), Q (steps, P, P).
        """
        d = np.maximum(np.diagonal(Q, axis1=1, axis2=2), 0.0)
        single = 0.5 * q**2 / (_SIZE**-2 + d) - 0.5 * np.log1p(_SIZE**2 * d)
        several = [
            log_evidence(q[:, at], Q[:, at[:, None], at], _SIZE) for at in self._ways[q.shape[1] :]
        ]
        return np.asarray(
            np.minimum(np.column_stack([single, *several]), _MOST) + self._log_chances
        )

    def _note(self, robots: Sequence[str], day: str) -> None:
        """Record what a round shows of each robot by itself."""
        p = np.empty(len(robots))
        for k, robot in enumerate(robots):
            step = self._epochs[robot].steps[-1]
            root = np.linalg.inv(np.linalg.cholesky(step.H)).T
            p[k] = min(
                step.p_value, least_chance(step.q[None], step.Q[None], root, self._elements)[0]
            )
        for robot, one, adjusted in zip(robots, p, benjamini_hochberg(p), strict=True):
            self._last[robot] = LastCheck(
                robot, day, float(one), float(adjusted), self._epochs[robot].log_e()
            )

    def _next(self, day: str) -> FleetChange | None:
        """Return the likeliest change that the readings show and that has not been found yet."""
        active = {
            name: epoch
            for name, epoch in self._epochs.items()
            if epoch.steps and not epoch.is_changed
        }
        if not active:
            return None
        logs = {name: epoch.log_e() for name, epoch in active.items()}
        robot = max(logs, key=lambda name: logs[name])
        found = self._drift(active, day, least=logs[robot])
        if found is not None:
            return found
        alarms = 1 + sum(not change.is_group for change in self._changes)
        # The k-th largest against N / (alpha k), for the largest k (e-BH).
        ranked = np.sort(list(logs.values()))[::-1]
        limits = np.log(len(self._epochs) / self.alpha) - np.log(alarms + np.arange(len(ranked)))
        passed = np.flatnonzero(ranked >= limits)
        if not len(passed):
            return None
        active[robot].is_changed = True
        step = active[robot].steps[int(np.argmax(active[robot].parts()))]
        self._last[robot] = replace(self._last[robot], log_e=logs[robot])
        return self._described(robot, step, day, logs[robot], is_group=False)

    def _drift(self, active: Mapping[str, _Epoch], day: str, *, least: float) -> FleetChange | None:
        """Return the likeliest drift of a group, if likelier than ``least``, and subtract it from
        the group's robots.
        """
        members = dict[str, list[_Epoch]]()
        for epoch in active.values():
            for group in epoch.groups:
                members.setdefault(group, []).append(epoch)
        members = {group: own for group, own in members.items() if len(own) >= WATCH.fewest}
        best: tuple[float, str, _Step] | None = None
        for group, own in members.items():
            steps = self._common(own)
            if not steps:
                continue
            parts = np.array([step.total for step in steps]) + _hazard(steps)
            log_e = float(np.logaddexp.reduce(parts))
            if best is None or log_e > best[0]:
                best = log_e, group, steps[int(np.argmax(parts))]
        drifted = 1 + sum(change.is_group for change in self._changes)
        if best is None or best[0] < max(least, np.log(len(members) / self.alpha / drifted)):
            return None
        log_e, group, step = best
        at = self._ways[int(np.argmax(step.logs))]
        shift = np.zeros(len(step.q))
        shift[at] = np.linalg.solve(step.Q[np.ix_(at, at)] + np.eye(len(at)) / _SIZE**2, step.q[at])
        for epoch in members[group]:
            self._shift(epoch, step.round, shift)
        return self._described(group, step, day, log_e, is_group=True)

    def _common(self, own: Sequence[_Epoch]) -> list[_Step]:
        """Return the joint evidence of a group's robots on a change before each of the
        last rounds.
        """
        rounds = sorted({step.round for epoch in own for step in epoch.steps})[-_WINDOW:]
        found = list[_Step]()
        for number in rounds:
            firsts = [next((s for s in epoch.steps if s.round >= number), None) for epoch in own]
            steps = [step for step in firsts if step is not None]
            if len(steps) >= WATCH.fewest:
                q = np.sum([step.q for step in steps], axis=0)
                Q = np.sum([step.Q for step in steps], axis=0)
                logs = self._logs(q[None], Q[None])[0]
                day = min(step.day for step in steps)
                found.append(
                    _Step(
                        number,
                        day,
                        Q,
                        q,
                        q=q,
                        Q=Q,
                        logs=logs,
                        total=float(np.logaddexp.reduce(logs)),
                    )
                )
        return found

    def _shift(self, epoch: _Epoch, since: int, by: np.ndarray) -> None:
        """Subtract a drift since a round from a robot's readings."""
        first = next((step for step in epoch.steps if step.round >= since), None)
        epoch.drift = epoch.drift + by
        if first is None:
            return
        for step in epoch.steps:
            if step.round > first.round:
                step.g = step.g - (step.H - first.H) @ by
        epoch.g = epoch.g - (epoch.H - first.H) @ by
        self._weigh(epoch)

    def _described(
        self, subject: str, step: _Step, day: str, log_e: float, *, is_group: bool
    ) -> FleetChange:
        """Return the change that a step shows."""
        if step.extra > step.total:
            return FleetChange(
                subject, is_group, day, step.day, DIAGNOSED, (), None, None, "", log_e
            )
        best = int(np.argmax(step.logs))
        equals = [
            self._names[k]
            for k in np.argsort(-step.logs)
            if k != best and step.logs[k] > step.logs[best] - WATCH.equal
        ]
        change = None
        sigma = None
        unit = ""
        if best < len(step.q):
            unit = self.type.parameters[best].unit
            variance = 1.0 / (step.Q[best, best] + _SIZE**-2)
            change = float(variance * step.q[best] * self.type.priors[best])
            sigma = float(np.sqrt(variance) * self.type.priors[best])
        return FleetChange(
            subject,
            is_group,
            day,
            step.day,
            self._names[best],
            tuple(equals),
            change,
            sigma,
            unit,
            log_e,
        )


def _hazard(steps: Sequence[_Step]) -> np.ndarray:
    """Return the log probability of a change before each round, shape (steps,)."""
    rounds = np.array([step.round for step in steps]) - steps[0].round
    return np.asarray(np.log(WATCH.hazard) + rounds * np.log1p(-WATCH.hazard))
