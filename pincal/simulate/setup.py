"""Sensor set-ups: the sensor, its pose, suitable robot poses and the table of readings.

A campaign is a set-up with the poses and conditions of its measurements.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple, Protocol, Unpack

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm
from pincal.simulate.effect import HiddenEffect, ReadBackEffect, needs_order
from pincal.simulate.machine import TrueMachine
from pincal.simulate.state import Conditions, Equilibrium, Poses
from pincal.simulate.tracker import ReadingEffect, as_read

Table = dict[str, np.ndarray]
"""Columns of a table of measurements, by name."""

# Poses whose equilibria are computed at once; each takes about 10 kB.
_PIECE = 5_000


class Machine(Protocol):
    """The interface of a machine that a set-up can measure."""

    @property
    def nominal(self) -> Arm:
        """The arm of the URDF."""

    @property
    def effects(self) -> tuple[HiddenEffect, ...]:
        """Hidden effects, including the instrument's."""

    def poses(
        self, q: np.ndarray, *, scatter: np.ndarray | None = None, **conditions: Unpack[Conditions]
    ) -> Poses:
        """Return recorded poses with their conditions."""

    def equilibrium(self, poses: Poses) -> Equilibrium:
        """Return the arm at rest in every pose."""


def tips_of(machine: Machine, poses: Poses) -> np.ndarray:
    """Return the tips of the arm at rest, shape (N, 4, 4), computed in pieces unless effects depend
    on preceding poses.
    """
    if not len(poses.q) or needs_order(machine.effects, poses):
        return machine.equilibrium(poses).tip
    tips = np.empty((len(poses.q), 4, 4))
    start = 0
    for part in poses.pieces(_PIECE):
        tips[start : start + len(part.q)] = machine.equilibrium(part).tip
        start += len(part.q)
    return tips


class Reading(NamedTuple):
    """Readings in N poses: the index of the pose of each of M rows, shape (M,), and the sensor's
    columns.
    """

    poses: Poses
    rows: np.ndarray
    columns: Table


@dataclass(frozen=True, kw_only=True)
class SensorSetup(ABC):
    """A sensor and its pose relative to the robot.

    Attributes:
        sigma: Standard deviation of a coordinate or distance [m], of image coordinates [px].
    """

    sigma: float = 0.0

    @property
    @abstractmethod
    def kind(self) -> str:
        """The kind of measurement, by :class:`pincal.measure.measurements.Measurements`."""

    @property
    @abstractmethod
    def points(self) -> dict[str, np.ndarray]:
        """Named points known to the user [m], shape (3,), in the instrument's frame or the object's
        own.
        """

    @abstractmethod
    def plan(
        self, arm: Arm, n: int, *, rng: np.random.Generator, min_height: float | None = 0.1
    ) -> np.ndarray:
        """Draw suitable poses of the nominal arm, above a floor at ``min_height`` [m] (None: no
        floor).

        They are joint positions [rad or m], shape (n, number of joints); BadInputError if hardly
        any pose is suitable.
        """

    def measure(
        self,
        machine: Machine,
        q: np.ndarray,
        *,
        rng: np.random.Generator | None = None,
        hide: Collection[str] = (),
        **conditions: Unpack[Conditions],
    ) -> Table:
        """Measure the true machine.

        The random numbers of the same ``rng`` do not depend on the machine's effects. Without noise
        the rows are the truth.

        Args:
            machine: The true machine.
            q: Recorded joint positions [rad or m], shape (N, n); with contact, positions near the
                recorded ones.
            rng: Source of noise and scatter; needed if there is noise.
            hide: Columns to leave out of the table; ``approach`` and ``read`` stand for those of
                all joints.
            **conditions: The conditions of the poses.

        Returns:
            Columns of the table by name: joints, those of ``payload``, ``temperature``, ``time``
            and ``approach_<joint>`` that are given, and the sensor's readings.

        Raises:
            BadInputError: If an argument has a wrong shape, or the set-up can't measure this
                machine.
        """
        poses = machine.poses(q, scatter=draw_scatter(machine, q, rng), **conditions)
        reading = self._read(machine, poses, rng)
        table = _pose_columns(machine.nominal, reading.poses, conditions) | _read_back(
            machine, reading.poses
        )
        table = {name: column[reading.rows] for name, column in table.items()} | reading.columns
        per_joint = [kind for kind in ("approach", "read") if kind in hide]
        hidden = {
            *hide,
            *(f"{kind}_{name}" for kind in per_joint for name in machine.nominal.names),
        }
        return {name: column for name, column in table.items() if name not in hidden}

    @abstractmethod
    def _read(self, machine: Machine, poses: Poses, rng: np.random.Generator | None) -> Reading:
        """Return the sensor's readings of a machine in its poses."""

    @abstractmethod
    def line_of_sight(self, tip: np.ndarray) -> np.ndarray:
        """Return the observed point in the sensor's frame [m], shape (N, 3), for tips in the base
        frame, (N, 4, 4).
        """

    @abstractmethod
    def truth(self) -> dict[str, Any]:
        """Return the poses of all parts, for JSON."""


def draw_scatter(
    machine: Machine, q: np.ndarray, rng: np.random.Generator | None
) -> np.ndarray | None:
    """Return scatter for poses q, from a child of the generator, so that the noise does not depend
    on it.
    """
    return (
        None
        if rng is None
        else rng.spawn(1)[0].standard_normal((len(q), len(machine.nominal.names)))
    )


def draw_noise(shape: tuple[int, ...], sigma: float, rng: np.random.Generator | None) -> np.ndarray:
    """Return normal noise of a shape, or zeros if sigma is 0; BadInputError if noise is requested
    without ``rng``.
    """
    if sigma == 0.0:
        return np.zeros(shape)
    if rng is None:
        raise BadInputError(
            "noise needs rng; pass np.random.default_rng(seed), or a set-up with sigma=0"
        )
    return rng.normal(0.0, sigma, shape)


def refuse_scale(machine: Machine, why: str) -> None:
    """Raise BadInputError for a machine with errors of an instrument's lengths; ``why`` completes
    the message.
    """
    for effect in machine.effects:
        if isinstance(effect, ReadingEffect):
            raise BadInputError(
                f"{effect.effect}: an error of an instrument that reads lengths, and "
                f"{why}; leave it out"
            )


def transformed(transform: np.ndarray, points: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return named points [m], shape (3,), moved by a transform, shape (4, 4)."""
    return {name: transform[:3, :3] @ place + transform[:3, 3] for name, place in points.items()}


def as_lists(points: Mapping[str, np.ndarray]) -> dict[str, list[float]]:
    """Return named points as lists, for JSON."""
    return {name: np.asarray(place).tolist() for name, place in points.items()}


def _read_back(machine: Machine, poses: Poses) -> Table:
    seen = [effect for effect in machine.effects if isinstance(effect, ReadBackEffect)]
    if not seen:
        return {}
    loads = machine.equilibrium(poses).loads
    index = machine.nominal.index
    return {
        f"read_{effect.joint}": effect.read_back(index(effect.joint), poses, loads)
        for effect in seen
    }


def _pose_columns(arm: Arm, poses: Poses, conditions: Mapping[str, object]) -> Table:
    """Return the columns that do not depend on the sensor: joints and declared conditions."""
    table = {name: poses.q[:, arm.names.index(name)] for name in arm.recorded}
    for name in ("payload", "temperature", "time"):
        if conditions.get(name) is not None:
            table[name] = np.broadcast_to(np.asarray(conditions[name], float), len(poses.q))
    if poses.approach is not None:
        table |= {
            f"approach_{name}": poses.approach[:, arm.names.index(name)] for name in arm.recorded
        }
    return table


# Time from one pose to the next: drive, settle, measure [s].
_INTERVAL = 40.0
# Warming up of a machine: initial temperature, rise, and standard deviation of draughts [deg C].
_COLD = 20.0
_WARMING = 10.0
_DRAUGHT = 0.7


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """Poses, conditions and set-up: everything but the machine that is measured.

    Attributes:
        q: Joint positions of the measurements [rad or m], shape (N, n); with contact, positions
            near them.
        conditions: The conditions.
        setup: The sensor set-up.
        hidden: Conditions that act but are not recorded.
    """

    q: np.ndarray
    conditions: Conditions
    setup: SensorSetup
    hidden: tuple[str, ...] = ()

    def measure(self, machine: Machine, rng: np.random.Generator) -> Table:
        """Return the campaign's table for a machine; ``rng`` is the source of noise and scatter.

        Raises:
            BadInputError: If the set-up can't measure it, or its errors and effects are
                unrealistically large.
        """
        table = self.setup.measure(machine, self.q, rng=rng, hide=self.hidden, **self.conditions)
        for name, column in table.items():
            if column.dtype.kind == "f" and not np.isfinite(column).all():
                raise BadInputError(f"column {name}: not finite; make errors and effects smaller")
        return table

    def shift(self, machine: TrueMachine, effect: HiddenEffect) -> float:
        """Return the displacement of the observed point by one of the machine's effects, rms over
        the poses [m].
        """
        without = replace(machine, effects=tuple(e for e in machine.effects if e is not effect))
        moved = self._line_of_sight(machine) - self._line_of_sight(without)
        return float(np.sqrt((moved**2).sum(axis=1).mean()))

    def _line_of_sight(self, machine: TrueMachine) -> np.ndarray:
        """Return the noise-free reading of the observed point [m], shape (N, 3)."""
        scatter = draw_scatter(machine, self.q, np.random.default_rng(0))
        tip = tips_of(machine, machine.poses(self.q, scatter=scatter, **self.conditions))
        return as_read(machine.effects, self.setup.line_of_sight(tip))

    def truth(self, machine: TrueMachine, *, tip: str) -> dict[str, Any]:
        """Return errors and effects of the machine, noise and set-up, for JSON; ``tip`` names the
        last frame.
        """
        names = machine.names
        found = {
            "poses": len(self.q),
            "sensor": self.setup.kind,
            "effects": [self._entry(machine, effect) for effect in machine.effects],
            "geometry": {
                "placement_errors": {
                    end: {"translation_m": row[:3].tolist(), "rotation_rad": row[3:].tolist()}
                    for end, row in zip((*names, tip), machine.placement_errors, strict=True)
                },
                "joint_offsets": dict(zip(names, machine.joint_offsets.tolist(), strict=True)),
            },
            "compliance": {
                name: dict(zip(("k_x", "k_y", "k_z"), row.tolist(), strict=True))
                for name, row in zip(names, machine.compliance, strict=True)
            },
            "moment_frame": machine.moment_frame,
            "mass_factors": dict(zip(names, machine.mass_factors.tolist(), strict=True)),
            "com_errors_m": dict(zip(names, machine.com_errors.tolist(), strict=True)),
            "gravity": list(machine.gravity),
            "payload_com": list(self.conditions.get("payload_com", (0.0, 0.0, 0.0))),
            "not_recorded": list(self.hidden),
        }
        return found | self.setup.truth()

    def _entry(self, machine: TrueMachine, effect: HiddenEffect) -> dict[str, Any]:
        """Return an effect with its unit and the displacement of the observed point."""
        values = {
            name: list(v) if isinstance(v, tuple) else v for name, v in asdict(effect).items()
        }
        shift = 1e3 * self.shift(machine, effect)
        return (
            {"effect": effect.effect} | values | {"unit": effect.unit, "moves_target_rms_mm": shift}
        )


def draw_conditions(
    names: Sequence[str], poses: int, *, joints: int, rng: np.random.Generator
) -> dict[str, Any]:
    """Return random conditions of N poses of n joints by name, whose values do not depend on the
    names requested.

    They are ``temperature`` [deg C], warming up, and ``time`` [s], shape (N,), and ``approach`` (-1
    or 1), shape (N, n).
    """
    time = _INTERVAL * np.arange(poses)
    warming = _COLD + _WARMING * (1.0 - np.exp(-3.0 * np.arange(poses) / poses))
    drawn = {
        "temperature": np.round(warming + _DRAUGHT * rng.standard_normal(poses), 2),
        "time": time,
        "approach": rng.choice([-1.0, 1.0], (poses, joints)),
    }
    return {name: drawn[name] for name in names}


def spread_payloads(values: Sequence[float], poses: int, *, order: str = "blocks") -> np.ndarray:
    """Return the payload of each of N poses [kg], shape (N,), in the order ``blocks`` or
    ``alternating``.

    Raises:
        BadInputError: If there is no such order.

    Example:
        >>> spread_payloads([0.0, 80.0], 4)
        array([ 0.,  0., 80., 80.])
    """
    rows = np.arange(poses)
    loads = np.asarray(values, float)
    if order not in ("blocks", "alternating"):
        raise BadInputError(f"order {order!r} of the payloads; expected blocks or alternating")
    place = rows * len(loads) // poses if order == "blocks" else rows % len(loads)
    return np.asarray(loads[place])
