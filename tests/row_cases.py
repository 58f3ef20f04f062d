"""Tables whose rows are as they are measured in the world: in an order, again and again, with an instrument and a day.

The robot, the poses and all that goes wrong come from :mod:`pincal.simulate` and plain numpy. What is known of a table: the
covariance of its noise, so that the strength of what is hidden can be told by it, and the truth at poses never measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any
from zlib import crc32

import numpy as np
from discovery_cases import (
    ELASTICITY,
    FRESH_ARMS,
    NEEDS,
    SIGMA,
    Foreign,
    Name,
    _Absorber,
    _named,
    _plain,
    _scaled,
    _Setting,
    _setting,
)
from scipy.interpolate import PchipInterpolator
from scipy.linalg import eigh, toeplitz
from scipy.spatial.transform import Rotation

from pincal import GEOMETRIC, Options, Robot, measurements_from_arrays
from pincal import simulate as sim
from pincal.measure.approach import moves_by_order, sides_of
from pincal.measure.measurements import Measurements
from pincal.model.chain import MomentFrame
from pincal.simulate.effect import HiddenEffect

ARMS = ("kuka", "heavy", "light", *FRESH_ARMS)
# Noise of neighbouring rows: the autoregression of the issue.
_PHI = 0.9
# What repeats agree to, what drives arrive to and what their encoders read back to: as on two arms whose repeats are public.
REPEATS_AGREE = 2e-6  # [m]
DRIVES_ARRIVE = 20e-6  # [rad]
READ_BACK = 2e-6  # [rad]
_WHITE_OF_WALK = 20e-6  # [m]
_GROSS, _GROSS_SHARE = 2e-3, 0.05  # [m], part of the rows
_SHIFT = 2e-3  # [m]
_REMASTERED = 1e-3  # [rad]
_PER_MOVE = 2e-4  # part of the last move
_TOOL_CHANGE = 1e-3  # [m]
_WARMING, _EXPANSION = 10.0, 11e-6  # [K], [1/K]
_WARMING_OF_TABLES = 12.0  # of those that have a temperature [K]
_RMS_OF_WALK = (50e-6, 100e-6)  # over the table, with the white part [m]
_ACROSS, _ALONG = 25e-6, 20e-6  # noise across the line of sight [m], and along it per metre of range [-]
_ROWS_OF_BUMP = 6  # that meet the bump within its width
_ROW_TIME = 40.0  # [s]
_BUMP_WIDTH = np.deg2rad(5.0)  # full width at half of the height


@dataclass(frozen=True)
class World:
    """N poses as they were taken.

    Attributes:
        q: joint positions that the table gets [rad], shape (N, 6).
        arrived: where drives truly stand minus that [rad], shape (N, 6).
        conditions: payload [kg], time [s], temperature [deg C] and approach, whether the table has them or not.
        tool: target in the tip frame [m], shape (N, 3).
        shift: added to what the instrument reads [m], shape (N, 3).
    """

    q: np.ndarray
    arrived: np.ndarray
    conditions: dict[str, Any]
    tool: np.ndarray
    shift: np.ndarray


@dataclass(frozen=True)
class _Noise:
    """Noise of rows, the sum of two parts.

    Attributes:
        common: covariance of rows, the same for each coordinate and none between coordinates, shape (N, N) [m^2].
        visit: number of the visit of each row, shape (N,): rows of one visit have the other part in common.
        own_of: gives that of the coordinates of each row, shape (N, 3, 3) [m^2].
    """

    common: np.ndarray
    visit: np.ndarray
    own_of: Callable[[], np.ndarray]

    @cached_property
    def own(self) -> np.ndarray:
        """Covariance of the coordinates of each row that is independent between visits, shape (N, 3, 3) [m^2]."""
        return self.own_of()

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of all coordinates, row by row, shape (3N, 3N) [m^2]."""
        n = len(self.visit)
        whole = np.kron(self.common, np.eye(3)).reshape(n, 3, n, 3)
        together = self.visit[:, None] == self.visit
        whole += np.where(together[:, None, :, None], self.own[:, :, None, :], 0.0)
        return whole.reshape(3 * n, 3 * n)

    @property
    def rms(self) -> float:
        """Standard deviation of a coordinate, over all rows [m]."""
        return float(np.sqrt(np.mean(np.diag(self.common)) + np.mean(np.trace(self.own, axis1=1, axis2=2)) / 3.0))


@dataclass(frozen=True, eq=False)
class RowsCase:
    """A robot's measured rows, all that is true of them and how they would be given to a discovery.

    Attributes:
        kind: one of ``KINDS``.
        seed: of everything.
        robot: the arm as its URDF has it.
        rows: the table.
        options: as those of the command; the noise is declared or not.
        hidden: what is hidden of the robot, as effects of the simulator.
        truth: names of what is hidden of the robot; of what has no name, "unnamed" with its joint.
        setup: names of what is hidden of set-up or instrument.
        clean: readings without noise, shape (N, 3) [m].
        noise: what is known of the noise.
        strength: lambda of the hidden effect by the true covariance, over all rows; 0 if none was asked for.
        seen: what a discovery can see of it: on the training rows, with masses known to some per cent.
        arm: class of arms.
        moment_frame: where moments bend it.
        world: the poses as they were taken.
        campaign: what goes on while they are taken.
    """

    kind: str
    seed: int
    robot: Robot
    rows: Measurements
    options: Options
    hidden: tuple[HiddenEffect, ...]
    truth: tuple[Name, ...]
    setup: tuple[Name, ...]
    clean: np.ndarray
    noise: _Noise
    strength: float
    seen: float
    arm: str
    moment_frame: MomentFrame
    world: World
    campaign: _Campaign

    @cached_property
    def covariance(self) -> np.ndarray:
        """True covariance of all coordinates of the table, row by row, shape (3N, 3N) [m^2]."""
        return self.noise.covariance

    @cached_property
    def whitening(self) -> np.ndarray:
        """W with W C W' = I on what has noise at all, shape (R, 3N); where rows are copies R is smaller than 3N."""
        return whitening_of(self.covariance)

    @property
    def line(self) -> int:
        """Line of the table from which on something is other than before, in kinds in which something is."""
        part = np.arange(len(self.rows)) / len(self.rows)
        return int(self.rows.rows[np.argmax(part > self.campaign.change)])

    @property
    def is_declared(self) -> bool:
        """Whether the noise is declared."""
        return self.options.sigma is not None

    def fresh(self, count: int, seed: int = 0) -> tuple[Measurements, np.ndarray]:
        """Return poses never measured, at any time of the campaign, with readings without noise, and these, (count, 3)."""
        rng = np.random.default_rng([self.seed, crc32(self.kind.encode()), 77, seed])
        world = self.campaign.elsewhere(self.world.conditions["payload"], count, rng)
        clean = self.campaign.positions(world, *self.hidden)
        return self.campaign.table(world, clean), clean


def whitening_of(covariance: np.ndarray) -> np.ndarray:
    """Return W, shape (R, M), with W C W' = I for a covariance C of rank R, shape (M, M)."""
    values, vectors = eigh(covariance)
    kept = values > 1e-9 * values[-1]
    return np.asarray((vectors[:, kept] / np.sqrt(values[kept])).T)


class _Whitened(_Absorber):
    """As its base, by the true covariance of the noise."""

    def __init__(self, setting: _Setting, options: Options, covariance: np.ndarray) -> None:
        # What noise-free tables leave is none that depends on the order.
        super().__init__(setting, replace(options, serial=False))
        self.jacobian = self.jacobian * SIGMA
        self.covariance = covariance

    def strength(self, difference: np.ndarray) -> float:
        """Return lambda of a difference of positions, shape (N, 3)."""
        everywhere = np.arange(len(difference))
        return self._seen_on(everywhere, difference, self.n_fit)

    def seen(self, difference: np.ndarray) -> float:
        """Return what of it a discovery can see: on the training rows, with masses known to some per cent."""
        return self._seen_on(self.training, difference, len(self.held))

    def _seen_on(self, rows: np.ndarray, difference: np.ndarray, free: int) -> float:
        places = (3 * rows[:, None] + np.arange(3)).ravel()
        W = whitening_of(self.covariance[np.ix_(places, places)])
        d = W @ difference[rows].ravel()
        A = np.vstack([W @ self.jacobian[rows][:, :, :free].reshape(len(places), free), np.diag(self.held[:free])])
        scale = np.linalg.norm(A, axis=0)
        target = np.append(d, np.zeros(free))
        p = np.linalg.lstsq(A / scale, target, rcond=None)[0]
        return float(np.sum((target - A / scale @ p)[: len(d)] ** 2))


Order = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def _as_drawn(q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return q


def _sorted(q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return q[np.argsort(q[:, 0])]


def _path(q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return as many poses on a smooth path through every sixth to twelfth of some poses; it keeps within limits."""
    through = q[: max(len(q) // int(rng.integers(6, 13)), 2) + 1]
    return np.asarray(PchipInterpolator(np.arange(len(through)), through)(np.linspace(0, len(through) - 1, len(q))))


@dataclass(frozen=True)
class _Plan:
    """How poses of a kind are taken.

    Attributes:
        poses: fewest and most different poses.
        order: what becomes of poses drawn at random.
        cycles: visits of each pose.
        readings: readings of each visit, one after the other.
    """

    poses: tuple[int, int] = (150, 300)
    order: Order = _as_drawn
    cycles: int = 1
    readings: int = 1


_PLANS = {
    "white": _Plan(),
    "ar_path": _Plan(order=_path),
    "ar_random": _Plan(),
    "walk_sorted": _Plan(order=_sorted),
    "walk_random": _Plan(),
    "repeats": _Plan((60, 100), readings=3),
    "repeats_scattered": _Plan((60, 100), readings=3),
    "repeats_cycles": _Plan((40, 60), cycles=3, readings=3),
    "copies": _Plan((70, 110), readings=3),
    "instrument_azimuth": _Plan(),
    "instrument_range": _Plan(),
    "bump": _Plan((250, 400)),
    "gross": _Plan(),
    "moves": _Plan(),
    "heat": _Plan(order=_sorted),
    "remastered": _Plan(),
    "shifted": _Plan(),
    "tool_exchanged": _Plan(),
    "few": _Plan((8, 12)),
}
KINDS = tuple(_PLANS)
# Kinds in which rows hang together by more than what the pose tells.
CORRELATED = ("ar_path", "ar_random", "walk_sorted", "walk_random")
# Kinds in which the robot itself has something that its geometry and elasticity do not tell; the others are sound robots.
OF_ROBOT = ("bump", "moves", "heat", "remastered")


@dataclass(frozen=True)
class _Campaign:
    """What goes on while poses of a kind are taken, those of the table and fresh ones.

    Attributes:
        kind: one of ``KINDS``.
        setting: the arm in its hall.
        tracker: base to instrument, shape (4, 4).
        joint: index of the joint at which something of the kind is wrong.
        bump: what a drive has.
        azimuth: eccentricity of the azimuth encoder [rad] and where it points [rad].
        change: part of the rows before what is different after it.
        span: how long it takes [s].
        warming: time constant [s].
        shift: of what is read after the change [m], shape (3,).
        tool_change: of the tool after it [m], shape (3,).
        columns: what the table has beside joints, readings and payload.
    """

    kind: str
    setting: _Setting
    tracker: np.ndarray
    joint: int
    azimuth: tuple[float, float]
    change: float
    span: float
    warming: float
    shift: np.ndarray
    tool_change: np.ndarray
    columns: frozenset[str]
    bump: Foreign | None = None

    def positions(self, world: World, *effects: HiddenEffect) -> np.ndarray:
        """Return what the instrument reads without noise, shape (N, 3) [m]."""
        machine = self.setting.machine.with_effects(*effects, *([self.bump] if self.bump else []))
        if self.kind == "heat":
            machine = machine.with_effects(sim.ThermalExpansion(size=_EXPANSION))
        poses = machine.poses(world.q + world.arrived, payload_com=self.setting.com, **world.conditions)
        tip = machine.equilibrium(poses).tip
        at_base = np.einsum("nij,nj->ni", tip[:, :3, :3], world.tool) + tip[:, :3, 3]
        seen = at_base @ self.tracker[:3, :3].T + self.tracker[:3, 3]
        size, direction = self.azimuth
        turn = size * np.sin(np.arctan2(seen[:, 1], seen[:, 0]) - direction)
        return Rotation.from_rotvec(np.outer(turn, [0.0, 0.0, 1.0])).apply(seen) + world.shift

    def at(self, q: np.ndarray, last: np.ndarray, part: np.ndarray, payload: np.ndarray) -> World:
        """Return poses, (N, 6), that drives reach from others, (N, 6), after a part of the campaign, 0 to 1, (N,)."""
        arrived, after = np.zeros_like(q), part > self.change
        if self.kind == "moves":
            # The drive stops short of where it is told to be.
            arrived[:, self.joint] = -_PER_MOVE * (q - last)[:, self.joint]
        if self.kind == "remastered":
            arrived[after, self.joint] = _REMASTERED
        conditions = {"payload": payload, "time": part * self.span, "approach": np.sign(q - last)}
        warmer = {"heat": _WARMING}.get(self.kind, _WARMING_OF_TABLES if "temperature" in self.columns else 0.0)
        conditions["temperature"] = 20.0 - warmer * np.expm1(-conditions["time"] / self.warming)
        tool, shift = (np.outer(after, change) for change in (self.tool_change, self.shift))
        return World(q, arrived, conditions, self.setting.tool + tool, shift)

    def elsewhere(self, payloads: np.ndarray, count: int, rng: np.random.Generator) -> World:
        """Return poses never measured, one after the other throughout the campaign, each with a load that was carried."""
        q = sim.plan_poses(self.setting.machine.nominal, count, rng, min_height=_floor(self.setting))
        part = np.sort(rng.uniform(0.0, 1.0, count))
        return self.at(q, q[np.maximum(np.arange(count) - 1, 0)], part, rng.choice(np.unique(payloads), count))

    def table(self, world: World, positions: np.ndarray, q: np.ndarray | None = None) -> Measurements:
        """Return the table of poses and readings, shape (N, 3) [m]."""
        columns = {name: world.conditions[name] for name in ("payload", *sorted(self.columns))}
        names, q = self.setting.machine.names, world.q if q is None else q
        if "approach" in self.columns:
            # As --rows-in-order tells it.
            columns["approach"] = sides_of(moves_by_order(q))
        if self.columns & {"approach", "time"}:
            columns["move"] = moves_by_order(q)
        table = measurements_from_arrays(names, q, position=positions, **columns)
        said = "the sign of the move from the row before" if "approach" in self.columns else ""
        return replace(table, approach_from=said)


def _floor(setting: _Setting) -> float:
    return -0.5 if setting.arm.endswith("light") else 0.1


@dataclass
class _Taken(_Setting):
    """Poses of a campaign as they were taken."""

    campaign: _Campaign | None = None
    world: World | None = None

    def positions(self, *effects: HiddenEffect) -> np.ndarray:
        """Return noise-free readings with effects."""
        assert self.campaign is not None and self.world is not None
        if effects not in self.known:
            self.known[effects] = self.campaign.positions(self.world, *effects)
        return self.known[effects]


def draw_rows_case(
    kind: str,
    seed: int,
    *,
    hidden: str | None = None,
    strength: float = 100.0,
    declared: bool | None = None,
    arm: str | None = None,
    poses: int | None = None,
) -> RowsCase:
    """Draw a table.

    Args:
        kind: one of ``KINDS``.
        seed: of everything.
        hidden: also hide this effect, a name of ``discovery_cases.NAMED``.
        strength: lambda of it by the true covariance of the noise, over all rows.
        declared: whether the options hold the noise; that of every other seed unless given.
        arm: one of ``ARMS``; in turn unless given.
        poses: different poses; drawn unless given.
    """
    rng = np.random.default_rng([seed, crc32(kind.encode()), crc32((hidden or "").encode())])
    arm = ARMS[seed % len(ARMS)] if arm is None else arm
    declared = bool(seed % 2) if declared is None else declared
    for _ in range(30):
        case = _draw(kind, seed, rng, hidden=hidden, strength=strength, arm=arm, poses=poses, declared=declared)
        if case is not None:
            return case
    raise ValueError(f"{kind} {seed}: no arm on which {hidden} is seen, or on which a bump has rows enough")


# Largest rms of what a hidden effect does to the tool [m], as for independent rows.
_RAW = 2e-3


def _draw(
    kind: str,
    seed: int,
    rng: np.random.Generator,
    *,
    hidden: str | None,
    strength: float,
    arm: str,
    poses: int | None,
    declared: bool,
) -> RowsCase | None:
    plan = _PLANS[kind]
    n = int(rng.integers(plan.poses[0], plan.poses[1] + 1)) if poses is None else poses
    frames: tuple[MomentFrame, ...] = (
        ("before", "after") if arm in FRESH_ARMS and hidden != "base_elasticity" else ("after",)
    )
    frame = frames[int(rng.integers(len(frames)))]
    elastic = hidden not in ELASTICITY
    drawn: dict[str, Any] = {"elastic": elastic, "masses": 0.03, "one_payload": True, "columns": set(), "in_order": False}
    setting = _setting(rng, n, arm=arm, moment_frame=frame, **drawn)
    # The load throughout, or nothing and then the load.
    load = float(setting.conditions["payload"][0])
    parts = np.array_split(setting.q, int(rng.integers(1, 3)))
    q = np.concatenate([plan.order(part, rng) for part in parts])
    payload = np.repeat([load] if len(parts) == 1 else [0.0, load], [len(part) for part in parts])
    # Visits of the poses, and the readings of each visit.
    visited = np.tile(np.arange(n), plan.cycles)
    visit = np.repeat(np.arange(len(visited)), plan.readings)
    campaign = _campaign(kind, rng, setting, len(visit), needs=NEEDS.get(hidden or ""))
    last = q[visited[np.maximum(np.arange(len(visited)) - 1, 0)]]
    world = campaign.at(q[visited][visit], last[visit], np.arange(len(visit)) / len(visit), payload[visited][visit])
    if kind == "bump":
        bump = _bump(rng, campaign, world)
        if bump is None:
            return None
        campaign = replace(campaign, bump=bump)
    noise = _noise_of(kind, rng, campaign, world, visit)
    effects: tuple[HiddenEffect, ...] = ()
    got = seen = 0.0
    if hidden is not None:
        columns = {name: world.conditions[name] for name in ("payload", *campaign.columns)}
        taken = _Taken(**{**vars(setting), "q": world.q, "conditions": columns, "known": {}}, campaign=campaign, world=world)
        options = Options(payload_centre=setting.com)
        absorber = _Whitened(taken, _plain(options, moment_frame=frame, elastic=elastic), noise.covariance)
        effect, got, raw = _scaled(_named(hidden, rng, taken), strength, taken, absorber)
        if not raw < _RAW or abs(got / strength - 1.0) > 0.05:
            return None
        effects, seen = (effect,), absorber.seen(taken.positions(effect) - taken.positions())
    clean = campaign.positions(world, *effects)
    read, q_table = _read(kind, rng, campaign, world, noise, effects)
    # What the maker of the instrument states: how drives arrive is none of its noise.
    known = REPEATS_AGREE if kind.startswith("repeats") else noise.rms
    options = Options(effects=GEOMETRIC, sigma=known if declared else None, moment_frame="auto", payload_centre=setting.com)
    name = setting.machine.names[campaign.joint]
    truth = tuple((e.effect, e.joint, vars(e).get("source")) for e in effects) + _TRUTH.get(kind, lambda joint: ())(name)
    table = campaign.table(world, read, q_table)
    about: dict[str, Any] = {"kind": kind, "seed": seed, "robot": setting.robot, "rows": table, "options": options}
    about |= {"hidden": effects, "truth": truth, "setup": _OF_SETUP.get(kind, ()), "clean": clean, "noise": noise}
    about |= {"strength": got, "seen": seen, "arm": arm, "moment_frame": frame, "world": world, "campaign": campaign}
    return RowsCase(**about)


# What is true of the robot, from the name of the joint at which it is; any of these names is right.
_TRUTH: dict[str, Callable[[str], tuple[Name, ...]]] = {
    "bump": lambda joint: (("unnamed", joint, None),),
    "moves": lambda joint: (("settling", joint, None),),
    "heat": lambda joint: (("thermal_growth", None, None), ("thermal_expansion", None, None)),
    "remastered": lambda joint: (("remastered", joint, None),),
}
_OF_SETUP: dict[str, tuple[Name, ...]] = {
    "instrument_azimuth": (("instrument_azimuth", None, None),),
    "shifted": (("shifted", None, None),),
    "tool_exchanged": (("tool_exchanged", None, None),),
}


def _campaign(kind: str, rng: np.random.Generator, setting: _Setting, rows: int, *, needs: str | None) -> _Campaign:
    span = rows * _ROW_TIME
    tracker = _upright(rng) if kind.startswith("instrument") else setting.hall
    columns = {needs} if needs else set()
    columns |= {name for name in ("time", "approach") if rng.random() < 0.3}
    columns -= {"time"} if kind == "heat" else set()
    columns |= {"approach"} if kind == "moves" else set()
    eccentric = rng.uniform(10e-6, 40e-6), rng.uniform(-np.pi, np.pi)
    directions = rng.standard_normal((2, 3))
    away, tool_change = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return _Campaign(
        kind=kind,
        setting=setting,
        tracker=tracker,
        joint=int(rng.integers(0, 3 if kind == "moves" else 5)),
        azimuth=eccentric if kind == "instrument_azimuth" else (0.0, 0.0),
        change=0.5 if kind == "shifted" else float(rng.uniform(0.35, 0.65)),
        span=span,
        warming=span * float(rng.uniform(0.15, 0.5)),
        shift=_SHIFT * away * (kind == "shifted"),
        tool_change=_TOOL_CHANGE * tool_change * (kind == "tool_exchanged"),
        columns=frozenset(columns),
    )


def _upright(rng: np.random.Generator) -> np.ndarray:
    """Return base to instrument for one that stands some metres away, its first axis plumb to a degree, shape (4, 4)."""
    azimuth, distance = rng.uniform(-np.pi, np.pi), rng.uniform(2.5, 5.0)
    place = np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), rng.uniform(0.2, 1.2)])
    T = np.eye(4)
    lean = Rotation.from_rotvec(np.append(rng.normal(0.0, np.deg2rad(1.0), 2), 0.0))
    T[:3, :3] = (lean * Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])).as_matrix()
    T[:3, 3] = -T[:3, :3] @ place
    return T


def _bump(rng: np.random.Generator, campaign: _Campaign, world: World) -> Foreign | None:
    """Return a bump of a drive that moves the tool by a fifth to half of a millimetre; None where few rows meet it."""
    angle = world.q[:, campaign.joint]
    near = np.abs(angle[:, None] - angle) < _BUMP_WIDTH / 2.0
    places = np.flatnonzero(near.sum(axis=1) >= _ROWS_OF_BUMP)
    if not len(places):
        return None
    place, width = float(angle[rng.choice(places)]), _BUMP_WIDTH / np.sqrt(8.0 * np.log(2.0))
    name = campaign.setting.machine.names[campaign.joint]
    bump = Foreign(joint=name, size=1e-4, shape=lambda poses, j: np.exp(-0.5 * ((poses.q[:, j] - place) / width) ** 2))
    moved = np.linalg.norm(campaign.positions(world, bump) - campaign.positions(world), axis=1).max()
    return replace(bump, size=bump.size * float(rng.uniform(2e-4, 5e-4) / moved))


def _noise_of(kind: str, rng: np.random.Generator, campaign: _Campaign, world: World, visit: np.ndarray) -> _Noise:
    n = len(visit)
    own_of, common = partial(np.zeros, (n, 3, 3)), SIGMA**2 * np.eye(n)
    if kind.startswith("ar_"):
        common = SIGMA**2 * toeplitz(_PHI ** np.arange(n))
    elif kind.startswith("walk_"):
        step = (rng.uniform(*_RMS_OF_WALK) ** 2 - _WHITE_OF_WALK**2) * 2.0 / (n + 1)
        place = np.arange(1, n + 1)
        common = step * np.minimum(place[:, None], place) + _WHITE_OF_WALK**2 * np.eye(n)
    elif kind.startswith("repeats"):
        common, own_of = REPEATS_AGREE**2 * np.eye(n), partial(_arrivals, campaign, world)
    elif kind == "copies":
        common = SIGMA**2 * (visit[:, None] == visit)
    elif kind == "instrument_range":
        common, own_of = np.zeros((n, n)), partial(_along_and_across, campaign, world)
    return _Noise(common, visit, own_of)


def _along_and_across(campaign: _Campaign, world: World) -> np.ndarray:
    """Return the covariance of an instrument whose noise grows with range, shape (N, 3, 3) [m^2]."""
    seen = campaign.positions(world)
    distance = np.linalg.norm(seen, axis=1)[:, None, None]
    along = seen[:, :, None] * seen[:, None, :] / distance**2
    return _ACROSS**2 * (np.eye(3) - along) + (_ALONG * distance) ** 2 * along


def _arrivals(campaign: _Campaign, world: World) -> np.ndarray:
    """Return the covariance of where the target is when drives arrive as they do, shape (N, 3, 3) [m^2]."""
    n, joints = world.q.shape
    at, J = campaign.positions(world), np.empty((n, 3, joints))
    for j in range(joints):
        step = np.zeros(joints)
        step[j] = 1e-5
        J[:, :, j] = (campaign.positions(replace(world, arrived=world.arrived + step)) - at) / 1e-5
    return DRIVES_ARRIVE**2 * J @ J.transpose(0, 2, 1)


def _read(
    kind: str, rng: np.random.Generator, campaign: _Campaign, world: World, noise: _Noise, effects: tuple[HiddenEffect, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return readings [m], shape (N, 3), and the joint positions of the table [rad], shape (N, 6)."""
    n, visit, q = len(noise.visit), noise.visit, world.q
    white = rng.standard_normal((n, 3))
    if kind.startswith("repeats"):
        missed = DRIVES_ARRIVE * rng.standard_normal((visit[-1] + 1, q.shape[1]))[visit]
        world = replace(world, arrived=world.arrived + missed)
        if kind == "repeats_scattered":
            q = np.round((q + READ_BACK * rng.standard_normal(q.shape)) / READ_BACK) * READ_BACK
        return campaign.positions(world, *effects) + REPEATS_AGREE * white, q
    clean = campaign.positions(world, *effects)
    if kind == "instrument_range":
        line = clean / np.linalg.norm(clean, axis=1, keepdims=True)
        along = np.sum(white * line, axis=1, keepdims=True) * line
        distance = np.linalg.norm(clean, axis=1, keepdims=True)
        return clean + _ACROSS * (white - along) + _ALONG * distance * along, q
    drawn = SIGMA * white
    if kind.startswith("ar_"):
        drawn = np.empty_like(white)
        drawn[0] = SIGMA * white[0]
        for k in range(1, n):
            drawn[k] = _PHI * drawn[k - 1] + SIGMA * np.sqrt(1.0 - _PHI**2) * white[k]
    elif kind.startswith("walk_"):
        step = np.sqrt(noise.common[0, 0] - _WHITE_OF_WALK**2)
        drawn = np.cumsum(step * white, axis=0) + _WHITE_OF_WALK * rng.standard_normal((n, 3))
    elif kind == "copies":
        drawn = drawn[np.searchsorted(visit, visit)]
    elif kind == "gross":
        wrong = rng.permutation(n)[: round(_GROSS_SHARE * n)]
        away = rng.standard_normal((len(wrong), 3))
        drawn[wrong] += _GROSS * away / np.linalg.norm(away, axis=1, keepdims=True)
    return clean + drawn, q
