"""The user's request for a simulation, and the machine, set-up and conditions drawn for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate import contact
from pincal.simulate.arm import Arm
from pincal.simulate.camera import OBJECTS, CalibrationObject, EyeInHand
from pincal.simulate.instrument import KINDS, CellCamera, Instrument, OnHand
from pincal.simulate.lens import draw_lens
from pincal.simulate.machine import TrueMachine
from pincal.simulate.setup import SensorSetup, draw_conditions, spread_payloads
from pincal.simulate.state import Conditions
from pincal.simulate.typical import draw_typical_elasticity, draw_typical_errors, typical_effect

if TYPE_CHECKING:
    from pincal.measure.measurements import Measurements


@dataclass(frozen=True, kw_only=True)
class SetupOptions:
    """Options of a measuring set-up; the rest is drawn.

    Attributes:
        sigma: Noise of a coordinate or distance [m], of image coordinates [px].
        noise_angle: Noise of an orientation about each axis [rad].
        targets: Number of targets on the tool.
        tool: Target, tool point or camera in the tip frame [m]; drawn if None.
        at_base: Whether positions are given in the robot's base frame instead of a random
            instrument's.
        sockets: Number of sockets.
        socket_spacing: Distance between the two sockets of a pair [m].
        anchors: Number of points from which distances are measured; 0: from the instrument's
            origin.
        ball_bar: Length of a bar between anchor and tool point [m]; None without one.
        object: Calibration object of a camera, a key of :data:`pincal.simulate.camera.OBJECTS`.
        target: What the camera looks at instead of such an object.
        least_distance: From which it looks at it [m].
        lens: Given intrinsics of the camera, see :attr:`pincal.simulate.lens.Lens.intrinsics`.
        min_height: Height of the floor in the base frame [m]; None for no floor.
        on_hand: Whether the instrument is on the hand, and what it measures beside the robot.
    """

    sigma: float = 0.0
    noise_angle: float = 0.0
    targets: int = 1
    tool: contact.Point | None = None
    at_base: bool = False
    sockets: int = 4
    socket_spacing: float = 0.05
    anchors: int = 0
    ball_bar: float | None = None
    object: str = "paper"
    target: CalibrationObject | None = None
    least_distance: float = 0.0
    lens: dict[str, float] = field(default_factory=dict)
    min_height: float | None = 0.0
    on_hand: bool = False


def draw_setup(
    kind: str, arm: Arm, *, rng: np.random.Generator, options: SetupOptions
) -> SensorSetup:
    """Set up a sensor, a key of ``SENSORS``, around a nominal arm.

    Raises:
        BadInputError: If there is no such sensor, or no suitable position.
    """
    if kind not in SENSORS:
        raise BadInputError(f"sensor {kind!r}; expected one of {', '.join(SENSORS)}")
    if options.on_hand and (SENSORS[kind] is not _beside or options.ball_bar is not None):
        raise BadInputError(
            f"sensor {kind!r} from the hand to a link that no joint moves; expected one of "
            f"{', '.join(KINDS)}, without a ball bar"
        )
    return SENSORS[kind](kind, arm, rng, options)


def _beside(kind: str, arm: Arm, rng: np.random.Generator, options: SetupOptions) -> SensorSetup:
    if options.ball_bar is not None:
        return _contact("distance", arm, rng, options)
    instrument, targets = _instrument_and_targets(arm, rng, options)
    anchors = {f"anchor_{i + 1}": contact.place_beside(arm, rng) for i in range(options.anchors)}
    sigma = options.sigma
    sigma_angle = options.noise_angle
    made = OnHand if options.on_hand else Instrument
    return made(
        reads=kind,
        pose=instrument,
        targets=targets,
        anchors=anchors,
        sigma=sigma,
        sigma_angle=sigma_angle,
    )


def _contact(kind: str, arm: Arm, rng: np.random.Generator, options: SetupOptions) -> SensorSetup:
    instrument, targets = _instrument_and_targets(arm, rng, replace(options, targets=1))
    x, y, z = (float(value) for value in next(iter(targets.values()))[:3, 3])
    spacing: float | None = options.socket_spacing
    label = "socket"
    count = options.sockets
    length = 0.0
    if kind == "distance":
        label = "anchor"
        count = max(options.anchors, 1)
        length = options.ball_bar or 0.0
        spacing = None
    places = contact.draw_fixed_points(
        arm,
        count,
        rng,
        tool=(x, y, z),
        radius=length,
        spacing=spacing,
        min_height=options.min_height,
    )
    fixed = {f"{label}_{i + 1}": place for i, place in enumerate(places)}
    return contact.Contact(
        tool=(x, y, z), fixed=fixed, instrument=instrument, sigma=options.sigma, length=length
    )


def _eye_in_hand(
    kind: str, arm: Arm, rng: np.random.Generator, options: SetupOptions
) -> SensorSetup:
    camera = contact.draw_camera(arm, rng)
    if options.tool is not None:
        camera[:3, 3] = options.tool
    setup = EyeInHand(
        target=options.target or OBJECTS[options.object](),
        camera_pose=camera,
        lens=draw_lens(rng, **options.lens),
        in_metres=kind == "camera_point",
        sigma=options.sigma,
        least_distance=options.least_distance,
    )

    def is_seen(pose: np.ndarray) -> bool:
        return replace(setup, object_pose=pose).has_views(arm, rng, min_height=options.min_height)

    return replace(setup, object_pose=contact.draw_object(arm, rng, is_seen=is_seen))


def _cell_camera(
    kind: str, arm: Arm, rng: np.random.Generator, options: SetupOptions
) -> SensorSetup:
    return CellCamera(
        pose=contact.draw_cell_camera(arm, rng),
        targets=_instrument_and_targets(arm, rng, options)[1],
        lens=draw_lens(rng, **options.lens),
        sigma=options.sigma,
    )


SENSORS: dict[str, Callable[[str, Arm, np.random.Generator, SetupOptions], SensorSetup]] = {
    "position": _beside,
    "pose": _beside,
    "distance": _beside,
    "socket": _contact,
    "camera_point": _eye_in_hand,
    "camera_pixel": _eye_in_hand,
    "fixed_camera_pixel": _cell_camera,
}
"""Factories of set-ups by :attr:`pincal.measure.measurements.Measurements.kind`."""


def _instrument_and_targets(
    arm: Arm, rng: np.random.Generator, options: SetupOptions
) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the instrument's pose and the targets, the first at ``options.tool`` if given."""
    instrument = contact.draw_instrument(arm, rng)
    targets = contact.draw_targets(arm, options.targets, rng)
    if options.tool is not None:
        if len(targets) > 1:
            raise BadInputError(
                f"tool {options.tool} places one target; expected targets 1, not {len(targets)}"
            )
        next(iter(targets.values()))[:3, 3] = options.tool
    return np.eye(4) if options.at_base else instrument, targets


# Conditions that a campaign may record.
_RECORDED = ("temperature", "time", "approach")
# Mass of an arm of 1 m reach [kg], and the exponent of its growth with reach.
_MASS = 45.0
_GROWTH = 2.4
# Least and largest factor of deviation from these rules.
_OF_ARM = (0.7, 1.3)
_OF_LINK = (0.6, 1.5)
# Mass of a joint's drive relative to a link as long as the arm.
_DRIVE = 0.3
# Centre of mass of a link: least and largest fraction of the vector to the next joint, and the
# lateral offset.
_ALONG = (0.2, 0.6)
_BESIDE = 0.1


class Stream(IntEnum):
    """Parts of a simulation with independent random streams: a change to one does not affect the
    others.
    """

    ERRORS, ELASTICITY, MASSES, EFFECTS, LAYOUT, POSES, CONDITIONS, NOISE, WEIGHTS = range(9)
    PART = 9
    READINGS = 10

    def generator(self, seed: int) -> np.random.Generator:
        """Return the random generator of this part for the seed of the whole
        simulation, 0 or more.
        """
        if seed < 0:
            raise BadInputError(f"seed {seed}; expected 0 or more")
        return np.random.default_rng([seed, int(self)])


def draw_machine(
    nominal: TrueMachine,
    *,
    seed: int = 0,
    errors: float = 1.0,
    elastic: float = 1.0,
    masses_off: float = 0.0,
    effects: Sequence[tuple[str, Mapping[str, Any]]] = (),
    unweighed: Sequence[str] = (),
) -> TrueMachine:
    """Draw a machine with errors, elasticity and hidden effects.

    Args:
        nominal: The machine without errors.
        seed: Seed of the machine.
        errors: Size of the geometric errors relative to typical ones, 0 for none.
        elastic: Compliance of drives and bearings relative to a typical one.
        masses_off: Standard deviation of masses and centres of mass [%].
        effects: Hidden effects: name and given fields of each.
        unweighed: Names of the joints whose links have no known mass, for which plausible masses
            are drawn.

    Raises:
        BadInputError: If an effect is unknown.
    """
    nominal = _draw_weights(nominal, unweighed, Stream.WEIGHTS.generator(seed))
    machine = draw_typical_errors(nominal, Stream.ERRORS.generator(seed), scale=errors)
    machine = machine.draw_masses(Stream.MASSES.generator(seed), sigma=masses_off / 100.0)
    if elastic:
        machine = draw_typical_elasticity(machine, Stream.ELASTICITY.generator(seed), scale=elastic)
    rng = Stream.EFFECTS.generator(seed)
    return machine.with_effects(
        *(typical_effect(machine, name, rng, **values) for name, values in effects)
    )


def _draw_weights(
    machine: TrueMachine, joints: Sequence[str], rng: np.random.Generator
) -> TrueMachine:
    """Return the machine with random masses and centres of mass of the links of some joints.

    Links and drives get lighter towards the tip, as they carry less; known masses of other links
    set the scale.
    """
    arm = machine.nominal
    n = len(machine.names)
    drawn = np.isin(machine.names, joints)
    if not drawn.any():
        return machine
    beyond = np.cumsum(arm.lengths[::-1])[::-1] + 0.05 * arm.reach
    sizes = (_DRIVE * arm.reach + arm.lengths) * beyond * rng.uniform(*_OF_LINK, n)
    known = float(arm.masses[~drawn].sum())
    whole = _MASS * arm.reach**_GROWTH * rng.uniform(*_OF_ARM)
    scale = known / sizes[~drawn].sum() if known else whole / sizes.sum()
    ways = arm.ends[:, :3, 3] * rng.uniform(*_ALONG, (n, 1))
    ways += np.maximum(arm.lengths, 0.1 * arm.reach)[:, None] * rng.uniform(
        -_BESIDE, _BESIDE, (n, 3)
    )
    masses = np.where(drawn, scale * sizes, arm.masses)
    return replace(
        machine,
        nominal=replace(arm, masses=masses, centres=np.where(drawn[:, None], ways, arm.centres)),
    )


@dataclass(frozen=True, kw_only=True)
class Repetition:
    """Repetition of poses, and their payloads.

    Attributes:
        cycles: Number of times that all poses are measured.
        recorded: Those of temperature, time and approach to record even if no effect needs them.
        payload: Payloads [kg]; None for no payload column.
        payload_order: As in :func:`pincal.simulate.setup.spread_payloads`.
        payload_com: Centre of mass of the payload in the tip frame [m].
    """

    cycles: int = 1
    recorded: Sequence[str] = ()
    payload: Sequence[float] | None = None
    payload_order: str = "blocks"
    payload_com: tuple[float, float, float] = (0.0, 0.0, 0.0)


def repeat_poses(
    machine: TrueMachine,
    q: np.ndarray,
    wanted: Repetition,
    *,
    given: Mapping[str, np.ndarray],
    seed: int = 0,
) -> tuple[np.ndarray, Conditions]:
    """Return the poses of all cycles, shape (cycles N, n), and the conditions under which they are
    measured.

    Args:
        machine: The machine, whose effects determine which conditions matter.
        q: Joint positions of one cycle [rad or m], shape (N, n).
        wanted: Their repetition.
        given: Fixed conditions of these poses, shape (N, ...); others are drawn.
        seed: Seed of poses, conditions and noise.
    """
    needed = {effect.column for effect in machine.effects} | set(wanted.recorded)
    names = [name for name in _RECORDED if name in needed]
    poses = len(q)
    rng = Stream.CONDITIONS.generator(seed)
    drawn = draw_conditions(names, wanted.cycles * poses, joints=len(machine.names), rng=rng)
    fixed = dict(given)
    if wanted.payload is not None:
        fixed["payload"] = spread_payloads(wanted.payload, poses, order=wanted.payload_order)
    if "approach" in drawn:
        # Every cycle approaches a pose from the same side, as in ISO 9283.
        fixed = {"approach": drawn["approach"][:poses]} | fixed
    repeated = {
        name: np.tile(value, (wanted.cycles, *[1] * (value.ndim - 1)))
        for name, value in fixed.items()
    }
    conditions: Any = drawn | repeated | {"payload_com": wanted.payload_com}
    return np.tile(q, (wanted.cycles, 1)), conditions


def poses_of_table(rows: Measurements) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the distinct poses of a table [rad or m], shape (N, n), and their recorded conditions.

    Rows of several targets or points measured in one pose count as one pose.
    """
    labels = rows.target if rows.point is None else rows.point
    begins = np.ones(len(rows), bool)
    seen = set[str]()
    for i, label in enumerate(labels):
        begins[i] = i == 0 or label in seen or not np.array_equal(rows.q[i], rows.q[i - 1])
        seen = {label} if begins[i] else seen | {label}
    rows = rows.select(begins)
    given = {
        name: value
        for name in (*_RECORDED, "payload")
        if (value := getattr(rows, name)) is not None
    }
    return rows.q, given
