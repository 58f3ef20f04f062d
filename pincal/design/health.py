"""Health checks: the fewest poses with which a diagnosis detects changes of a calibrated robot of a
given size.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from msgspec import to_builtins

from pincal.calibration.covered import Covered
from pincal.calibration.fitted_robot import FittedRobot
from pincal.compensate.robot_frames import base_in_instrument
from pincal.design.design_model import DesignModel, held_columns
from pincal.design.design_numbers import DESIGN_NUMBERS
from pincal.design.detection import (
    DetectableChange,
    DetectionDesign,
    detectable_changes,
    detection_design,
    lineup_over,
)
from pincal.design.exchange import covariance, order_by_load, total
from pincal.design.reach import Draw, Limits, Reach, SensorSetup
from pincal.design.request import pose_columns
from pincal.diagnosis.change_search import raises_alarm
from pincal.diagnosis.lineup import ChangeHypotheses, PossibleChange
from pincal.diagnosis.robot_diagnosis import FALSE_ALARM, known_degrees
from pincal.diagnosis.row_evidence import prior_root
from pincal.errors import BadInputError, few
from pincal.identify.options import Options
from pincal.model.conditions import Conditions
from pincal.parameters import FRAME_SYMBOLS, estimate_of
from pincal.recorded import RECORDABLE, RECORDED, typical_columns
from pincal.robot.robot import Robot
from pincal.sensors.registry import is_held
from pincal.thresholds import Count, Scale

log = logging.getLogger(__name__)

# Random poses to choose from, points of the working volume, and poses of the assumed calibration of
# a robot without a model.
_CANDIDATES: Count = 300
_PLACES: Count = 100
_CALIBRATED_FROM: Count = 100
# Sockets that a note lists.
_NAMED: Count = 6
# Time from one measured pose to the next [s].
_SECONDS_PER_POSE: Scale = 20.0


@dataclass(frozen=True)
class NoticedChange:
    """A change in its least detectable direction, scaled to the motion of the target to be
    detected.

    Attributes:
        change: the change.
        noncentrality: its squared signal relative to the uncertainty of noise and calibration.
        needed: non-centrality required for the requested power.
        step: shape (P,), the change of the lineup's parameters.
    """

    change: PossibleChange
    noncentrality: float
    needed: float
    step: np.ndarray


@dataclass(frozen=True, repr=False)
class HealthCheck:
    """Poses of a health check, and what it detects.

    Attributes:
        robot: the arm.
        conditions: the N poses, in an order with a short path.
        has_payloads: whether the payload was part of the design.
        sensor: kind of the sensor.
        held_at: name of the column with the point at which the target is held -> shape (N,); empty
            if it is not held.
        notice: motion of the target to be detected [m].
        power: required probability of detection.
        alpha: probability of a false alarm.
        changes: every change considered, the hardest to detect first.
        absorbed: changes absorbed by new poses of base and target, or that never cause so large a
            motion.
        alarms: fraction of simulated checks of an unchanged robot with an alarm.
        noticed: fraction of simulated checks with an alarm, given the first of ``changes``.
        draws: number of simulated checks, of each.
        drawn: the candidates, and the number removed by each constraint.
        notes: messages to the user.
        seconds: computing time.
    """

    robot: Robot
    conditions: Conditions
    has_payloads: bool
    sensor: str
    held_at: dict[str, np.ndarray]
    notice: float
    power: float
    alpha: float
    changes: tuple[NoticedChange, ...]
    absorbed: tuple[PossibleChange, ...]
    alarms: float
    noticed: float
    draws: int
    drawn: Draw
    notes: tuple[str, ...]
    seconds: float

    def __repr__(self) -> str:
        return (
            f"HealthCheck({self.robot.name!r}: {len(self.conditions)} poses to detect "
            f"{1e3 * self.notice:.3g} mm)"
        )

    @property
    def is_met(self) -> bool:
        """Whether every change is detected with the required power."""
        return self.changes[0].noncentrality >= self.changes[0].needed

    @property
    def minutes(self) -> float:
        """Duration of the measurement, at 20 s per pose."""
        return len(self.conditions) * _SECONDS_PER_POSE / 60.0

    @property
    def noticeable(self) -> float:
        """Motion of the target from which even the hardest change is detected [m]."""
        hardest = self.changes[0]
        return self.notice * float(np.sqrt(hardest.needed / max(hardest.noncentrality, 1e-300)))

    def summary(self) -> str:
        """Return the effort of the check and its detectable change, in a sentence."""
        what = "any change of the robot that moves some point by more than"
        rates = (
            f"is detected with a probability of {100 * self.power:g} %, at "
            f"{100 * self.alpha:g} % false alarms"
        )
        size = self.notice if self.is_met else self.noticeable
        return (
            f"{len(self.conditions)} poses, {self.minutes:.0f} minutes: {what} "
            f"{1e3 * size:.3g} mm {rates}"
        )

    def columns(self) -> dict[str, np.ndarray]:
        """Return the table to be filled in: joints, and other columns that the model needs."""
        return (
            pose_columns(self.robot, self.conditions, has_payloads=self.has_payloads) | self.held_at
        )

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain data, without the poses."""
        return {
            "robot": self.robot.name,
            "sensor": self.sensor,
            "poses": len(self.conditions),
            "minutes": self.minutes,
            "notice_mm": 1e3 * self.notice,
            "power": self.power,
            "alpha": self.alpha,
            "met": self.is_met,
            "changes": [
                to_builtins(noticed.change.label)
                | {"noncentrality": noticed.noncentrality, "needed": noticed.needed}
                for noticed in self.changes
            ],
            "absorbed": [
                to_builtins(change.label) | {"parameters": list(change.parameters)}
                for change in self.absorbed
            ],
            "simulated": {"draws": self.draws, "alarms": self.alarms, "noticed": self.noticed},
            "candidates": {
                "found": len(self.drawn.q),
                "drawn": self.drawn.drawn,
                "removed": self.drawn.removed,
            },
            "notes": list(self.notes),
            "seconds": self.seconds,
        }


@dataclass(frozen=True, kw_only=True)
class CheckRequest:
    """Requirements of a health check.

    Attributes:
        notice: motion of the target anywhere in the working volume that is to be detected [m].
        power: probability of detection.
        alpha: probability of an alarm on an unchanged robot.
        max_poses: largest number of poses.
        payloads: masses at the tip [kg], taken in turn; default: none.
        candidates: number of random poses to choose from; default: 300.
        draws: number of simulated checks of an unchanged robot, and of one with the change that is
            hardest to detect.
        seed: seed of all random numbers.

    Raises:
        BadInputError: if one of them is invalid.
    """

    notice: float = 1e-4
    power: float = 0.95
    alpha: float = FALSE_ALARM
    max_poses: int = 40
    payloads: Sequence[float] = ()
    candidates: int | None = None
    draws: int = 150
    seed: int = 0

    def __post_init__(self) -> None:
        RECORDABLE["payload"].checked(self.payloads)
        if not 0.0 < self.notice < np.inf:
            raise BadInputError(
                f"notice is {self.notice:g} m; expected a length above 0, such as 1e-4"
            )
        if not 0.0 < self.alpha < 0.5:
            raise BadInputError(
                f"alpha is {self.alpha:g}; expected a probability of a false alarm "
                "between 0 and 0.5, such as 0.01"
            )
        if not self.alpha < self.power < 1.0:
            raise BadInputError(
                f"power is {self.power:g}; expected a probability between alpha and 1, such as 0.95"
            )
        fewest = DESIGN_NUMBERS.fewest
        if not fewest <= self.max_poses <= self.n_candidates:
            raise BadInputError(
                f"at most {self.max_poses} poses of {self.n_candidates} candidates; "
                f"expected {fewest} to that many poses"
            )
        if not all(0.0 <= load < np.inf for load in self.payloads):
            raise BadInputError(
                f"payloads {', '.join(map(str, self.payloads))}; expected masses of 0 kg or more"
            )

    @property
    def n_candidates(self) -> int:
        """Number of random poses to choose from."""
        return _CANDIDATES if self.candidates is None else self.candidates


def design_check(
    known: Robot | FittedRobot,
    request: CheckRequest | None = None,
    *,
    options: Options | None = None,
    rig: SensorSetup | None = None,
    limits: Limits | None = None,
) -> HealthCheck:
    """Choose the fewest poses with which a diagnosis detects any change of a robot that moves the
    target by a distance.

    Args:
        known: the calibrated robot; for a robot alone, a calibration from 100 random poses is
            assumed.
        request: the requirements.
        options: options of the assumed calibration of a robot alone: effects, noise, moment frame.
        rig: sensor set-up.
        limits: limits of the workspace.

    Raises:
        BadInputError: for constraints that leave too few poses, or an unsupported sensor or model.

    Example:
        >>> from pincal.model.effects import GEOMETRIC
        >>> request = CheckRequest(notice=5e-4, candidates=60, draws=10)
        >>> options = Options(effects=GEOMETRIC)
        >>> found = design_check(Robot.from_urdf("ur10"), request, options=options)
        >>> found.is_met, 5 < len(found.conditions) < 30
        (True, True)
    """
    begun = time.perf_counter()
    request = request or CheckRequest()
    rig = rig or SensorSetup()
    planning = _Planning.of(known, request, options or Options(), rig, limits or Limits())
    reach = planning.reach
    choice = planning.choose()
    log.info("simulating %d checks", 2 * request.draws)
    unchanged = np.zeros(len(choice.hypotheses.start))
    alarms = planning.alarms(choice, unchanged)
    noticed = planning.alarms(choice, choice.changes[0].step)
    return HealthCheck(
        robot=reach.robot,
        conditions=choice.conditions,
        has_payloads=bool(request.payloads),
        sensor=reach.rig.sensor,
        held_at=_named(held_columns(choice.hypotheses.station), reach.rig.held_names),
        notice=request.notice,
        power=request.power,
        alpha=request.alpha,
        changes=choice.changes,
        absorbed=choice.absorbed,
        alarms=alarms,
        noticed=noticed,
        draws=request.draws,
        drawn=choice.drawn,
        notes=(*_on_sockets(reach.rig), *reach.robot.notes, *reach.bodies.notes),
        seconds=time.perf_counter() - begun,
    )


@dataclass(frozen=True)
class _Choice:
    """The poses of a check, and what a diagnosis detects at them.

    Attributes:
        drawn: the candidates, and the number removed by each constraint.
        conditions: the N chosen poses, in an order with a short path.
        hypotheses: all possible changes, for these poses.
        degrees: degrees of freedom of the noise from other data.
        changes: every change to be detected, the hardest first.
        absorbed: changes that no check detects.
    """

    drawn: Draw
    conditions: Conditions
    hypotheses: ChangeHypotheses
    degrees: float
    changes: tuple[NoticedChange, ...]
    absorbed: tuple[PossibleChange, ...]


@dataclass(frozen=True)
class _Planning:
    """The calibrated robot of a check, its admissible poses, and the requirements.

    Attributes:
        reach: admissible poses, with the sensor set-up.
        model: the calibrated robot.
        request: the requirements.
        rng: source of all random numbers.
    """

    reach: Reach
    model: FittedRobot
    request: CheckRequest
    rng: np.random.Generator

    @classmethod
    def of(
        cls,
        known: Robot | FittedRobot,
        request: CheckRequest,
        options: Options,
        rig: SensorSetup,
        limits: Limits,
    ) -> _Planning:
        """Return the planning for a robot, or for a calibrated one."""
        rng = np.random.default_rng([request.seed, 41])
        if isinstance(known, Robot):
            reach = Reach(known, rig, limits)
            return cls(reach, _as_if_calibrated(reach, options, request, rng=rng), request, rng)
        model = known.robot_model()
        return cls(Reach(model.model.chain.robot, _rig_of(rig, model), limits), model, request, rng)

    def choose(self) -> _Choice:
        """Choose the fewest poses that detect every change.

        Raises:
            BadInputError: for constraints that leave too few poses.
        """
        drawn = self._candidates()
        conditions = self._at(drawn.q)
        lineup = lineup_over(self.model, self.reach.rig, conditions)
        places = self._at(self.reach.draw(_PLACES, self.rng, measured=False).q)
        request = self.request
        detectable, absorbed = detectable_changes(lineup, places, request.notice, rng=self.rng)
        degrees = known_degrees(self.model, lineup.station)
        design = detection_design(
            lineup, detectable, alpha=request.alpha, power=request.power, degrees=degrees
        )
        log.info("choosing among %d poses", len(conditions))
        groups = lineup.station.sensor.groups
        chosen = design.fewest_of(
            request.max_poses, np.zeros(len(conditions)) if groups is None else groups
        )
        order, _, _ = order_by_load(drawn.q[chosen], conditions.payload[chosen], self.reach.range)
        rows = np.array(chosen)[order]
        final = replace(lineup, station=lineup.station.select(rows))
        changes = _noticed(design, final, detectable, chosen)
        return _Choice(drawn, conditions.select(rows), final, degrees, changes, tuple(absorbed))

    def alarms(self, choice: _Choice, step: np.ndarray) -> float:
        """Return the fraction of simulated checks with an alarm, with random noise and random
        errors of the calibration, of a robot that has changed by a step, shape (P,).
        """
        lineup = choice.hypotheses
        station = lineup.station
        errors = _calibration_errors(lineup)
        noise = np.repeat(lineup.robot.sigma, station.block_sizes)[:, None] / station.weights
        changed = station.residuals(lineup.start + step)
        alarms = 0
        for _ in range(self.request.draws):
            off = np.tensordot(self.rng.standard_normal(len(errors)), errors, 1)
            change = noise * self.rng.standard_normal(noise.shape) + off - changed
            rows = replace(station, sensor=station.sensor.shifted(change))
            alarms += raises_alarm(
                replace(lineup, station=rows), alpha=self.request.alpha, degrees=choice.degrees
            )
        return alarms / self.request.draws

    def _candidates(self) -> Draw:
        drawn = self.reach.draw(self.request.n_candidates, self.rng)
        most = self.request.max_poses
        if len(drawn.q) < most:
            raise BadInputError(
                f"the constraints leave too few poses for {most}: {drawn.in_words()}"
            )
        return drawn

    def _at(self, q: np.ndarray) -> Conditions:
        """Return poses with the loads in turn and all columns that the effects of a model need."""
        n = len(q)
        needs = {column for effect in self.model.model.effects for column in effect.needs}
        columns = typical_columns(needs & RECORDED.keys(), q)
        if "approach" in needs:
            columns["approach"] = self.rng.choice([-1.0, 1.0], q.shape)
        loads = np.resize(np.array(self.request.payloads or (0.0,), float), n)
        centre = np.array(self.model.payload_centre, float)
        return Conditions(q, np.zeros(n, int), loads, centre, **columns)


def _calibration_errors(lineup: ChangeHypotheses) -> np.ndarray:
    """Return how the readings, shape (m, n), change with each independent error of the
    calibration, to first order: shape (k, m, n).

    What the calibration knows is of first order, too. Masses known to a third and compliances that
    make up for them may be wrong together, as the rows of the calibration hold their product;
    drawn as they are, their second order would move the target by more than the noise, which
    these rows would have shown.
    """
    station = lineup.station
    root = prior_root(station, lineup.known, lineup.surroundings)
    every = np.ones(len(lineup.start), bool)
    pieces = [
        np.tensordot(root, jacobian, 1) for _, _, jacobian in station.linearise(lineup.start, every)
    ]
    return np.concatenate(pieces, axis=2)


def _as_if_calibrated(
    reach: Reach, options: Options, request: CheckRequest, *, rng: np.random.Generator
) -> FittedRobot:
    """Return the calibrated model expected from random poses of a robot that agrees
    with its URDF.
    """
    drawn = reach.draw(_CALIBRATED_FROM, rng)
    q = drawn.q
    if len(q) < DESIGN_NUMBERS.fewest:
        raise BadInputError(
            f"the constraints leave too few poses for a calibration: {drawn.in_words()}"
        )
    loads = np.resize(np.array(request.payloads or (0.0,), float), len(q))
    centre = np.array(options.payload_centre, float)
    conditions = Conditions(q, np.zeros(len(q), int), loads, centre)
    design = DesignModel.of(reach.robot, conditions, options, reach.rig)
    C = covariance(design.known + total(design.readings(conditions)))
    whole = np.zeros((len(design.values),) * 2)
    whole[np.ix_(design.free, design.free)] = C * np.outer(design.units, design.units)
    n = design.model.n_parameters
    estimate = estimate_of(design.model.parameters, design.values[:n], whole[:n, :n])
    return FittedRobot.given(
        design.model,
        estimate,
        Covered.of(conditions),
        sensor_kind=reach.rig.sensor,
        payload_centre=centre,
        sigma=design.sigma,
    )


def calibrated_sockets(model: FittedRobot) -> SensorSetup | None:
    """Return the set-up of a robot that was calibrated by contacts, its target held in the same
    sockets again; None of another robot, or of contacts between two hands.
    """
    robot = model.model.chain.robot
    if not is_held(model.sensor_kind) or robot.path.start != robot.base:
        return None
    middle = model.covered.q.mean(axis=1)[None]
    T_instrument_base = base_in_instrument(model, Conditions.at(robot.following(middle)))[0]
    turn = T_instrument_base[:3, :3]
    known = model.station.setup.points
    found = {
        name: place
        if place is not None
        else tuple(model.estimate[f"{name}.{axis}"] for axis in "xyz")
        for name, place in known.items()
    }
    places = [(np.array(place) - T_instrument_base[:3, 3]) @ turn for place in found.values()]
    held_at = tuple((float(x), float(y), float(z)) for x, y, z in places)
    return SensorSetup(sensor=model.sensor_kind, held_at=held_at, held_names=tuple(found))


def _on_sockets(rig: SensorSetup) -> Iterator[str]:
    """Yield the note that the sockets of the calibration are used."""
    if rig.held_names:
        yield (
            f"the target is held in the sockets of the calibration ({few(rig.held_names, _NAMED)});"
            " --sensor position plans for an instrument"
        )


def _named(columns: dict[str, np.ndarray], names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return columns of sockets with the names that they have in the cell, if these are known."""
    own = {f"socket_{k}": name for k, name in enumerate(names, 1)}
    return {
        column: np.array([own.get(str(name), str(name)) for name in held])
        for column, held in columns.items()
    }


def _rig_of(rig: SensorSetup, model: FittedRobot) -> SensorSetup:
    names = [f"{model.model.chain.targets[0]}.{symbol}" for symbol in FRAME_SYMBOLS[:3]]
    if rig.tool is not None or not set(names) <= set(model.estimate.names):
        return rig
    x, y, z = (model.estimate[name] for name in names)
    return replace(rig, tool=(x, y, z))


def _noticed(
    design: DetectionDesign,
    final: ChangeHypotheses,
    detectable: list[DetectableChange],
    chosen: list[int],
) -> tuple[NoticedChange, ...]:
    """Return the detectability of each change at the chosen poses, in its hardest direction, the
    hardest change first.
    """
    found = design.noncentralities(chosen)
    needed = design.needed(len(chosen))
    order = np.argsort(found / needed)
    hardest: dict[int, NoticedChange] = {}
    for k in order:
        i = detectable[k].change
        hardest.setdefault(
            i,
            NoticedChange(final.changes[i], float(found[k]), float(needed[k]), detectable[k].step),
        )
    return tuple(hardest.values())
