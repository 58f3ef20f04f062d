"""The sensors by name, and how each is set up around a machine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm
from pincal.simulate.calibration_object import OBJECTS
from pincal.simulate.camera import EyeInHand
from pincal.simulate.contact import Contact, Point
from pincal.simulate.instrument import Instrument
from pincal.simulate.layout import draw_camera, draw_fixed_points, draw_instrument, draw_object, draw_targets, place_beside
from pincal.simulate.lens import draw_lens
from pincal.simulate.setup import SensorSetup


@dataclass(frozen=True, kw_only=True)
class SetupOptions:
    """What may be chosen of a measuring set-up; the rest is drawn.

    Attributes:
        sigma: Noise of a coordinate or distance [m], of image coordinates [px].
        noise_angle: Noise of an orientation about each axis [rad].
        targets: Number of targets on the tool.
        tool: Target, tool point or camera in the tip frame [m]; drawn if None.
        at_base: Whether positions are given in the robot's base frame instead of an instrument's drawn one.
        sockets: Number of sockets.
        socket_spacing: Distance of the two sockets of a pair [m].
        anchors: Number of points from which distances are measured; 0: from the instrument's origin.
        ball_bar: Length of a bar between anchor and tool point [m]; None without one.
        object: What a camera looks at, a key of :data:`pincal.simulate.calibration_object.OBJECTS`.
        lens: Given intrinsics of the camera, see :attr:`pincal.simulate.lens.Lens.intrinsics`.
        min_height: Height of the floor in the base frame [m]; None for no floor.
    """

    sigma: float = 0.0
    noise_angle: float = 0.0
    targets: int = 1
    tool: Point | None = None
    at_base: bool = False
    sockets: int = 4
    socket_spacing: float = 0.05
    anchors: int = 0
    ball_bar: float | None = None
    object: str = "paper"
    lens: dict[str, float] = field(default_factory=dict)
    min_height: float | None = 0.0


def draw_setup(kind: str, arm: Arm, *, rng: np.random.Generator, options: SetupOptions) -> SensorSetup:
    """Set up a sensor, a key of ``SENSORS``, around a nominal arm.

    Raises:
        BadInputError: If there is no such sensor, or no place for it.
    """
    if kind not in SENSORS:
        raise BadInputError(f"sensor {kind!r}; expected one of {', '.join(SENSORS)}")
    return SENSORS[kind](kind, arm, rng, options)


def _beside(kind: str, arm: Arm, rng: np.random.Generator, options: SetupOptions) -> SensorSetup:
    if options.ball_bar is not None:
        return _contact("distance", arm, rng, options)
    instrument, targets = _instrument_and_targets(arm, rng, options)
    anchors = {f"anchor_{i + 1}": place_beside(arm, rng) for i in range(options.anchors)}
    sigma, sigma_angle = options.sigma, options.noise_angle
    return Instrument(reads=kind, pose=instrument, targets=targets, anchors=anchors, sigma=sigma, sigma_angle=sigma_angle)


def _contact(kind: str, arm: Arm, rng: np.random.Generator, options: SetupOptions) -> SensorSetup:
    """Return sockets, or the anchors of a ball bar."""
    instrument, targets = _instrument_and_targets(arm, rng, replace(options, targets=1))
    x, y, z = (float(value) for value in next(iter(targets.values()))[:3, 3])
    spacing: float | None = options.socket_spacing
    label, count, length = "socket", options.sockets, 0.0
    if kind == "distance":
        label, count, length, spacing = "anchor", max(options.anchors, 1), options.ball_bar or 0.0, None
    places = draw_fixed_points(
        arm, count, rng, tool=(x, y, z), radius=length, spacing=spacing, min_height=options.min_height
    )
    fixed = {f"{label}_{i + 1}": place for i, place in enumerate(places)}
    return Contact(tool=(x, y, z), fixed=fixed, instrument=instrument, sigma=options.sigma, length=length)


def _eye_in_hand(kind: str, arm: Arm, rng: np.random.Generator, options: SetupOptions) -> SensorSetup:
    camera = draw_camera(arm, rng)
    if options.tool is not None:
        camera[:3, 3] = options.tool
    setup = EyeInHand(
        target=OBJECTS[options.object](),
        camera_pose=camera,
        lens=draw_lens(rng, **options.lens),
        in_metres=kind == "camera_point",
        sigma=options.sigma,
    )

    def is_seen(pose: np.ndarray) -> bool:
        return replace(setup, object_pose=pose).has_views(arm, rng, min_height=options.min_height)

    return replace(setup, object_pose=draw_object(arm, rng, is_seen=is_seen))


SENSORS: dict[str, Callable[[str, Arm, np.random.Generator, SetupOptions], SensorSetup]] = {
    "position": _beside,
    "pose": _beside,
    "distance": _beside,
    "socket": _contact,
    "camera_point": _eye_in_hand,
    "camera_pixel": _eye_in_hand,
}
"""How each kind of measurement is set up, by the names of :attr:`pincal.measure.measurements.Measurements.kind`."""


def _instrument_and_targets(arm: Arm, rng: np.random.Generator, options: SetupOptions) -> tuple[np.ndarray, dict[str, Any]]:
    """Return where the instrument stands and the targets are, the chosen one at its place."""
    instrument, targets = draw_instrument(arm, rng), draw_targets(arm, options.targets, rng)
    if options.tool is not None:
        if len(targets) > 1:
            raise BadInputError(f"tool {options.tool} places one target; expected targets 1, not {len(targets)}")
        next(iter(targets.values()))[:3, 3] = options.tool
    return np.eye(4) if options.at_base else instrument, targets
