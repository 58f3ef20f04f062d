"""How to calibrate, and prior knowledge of each station."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from pincal.errors import BadInputError
from pincal.identify.noise import Loss
from pincal.measure.instruments import InstrumentNoise
from pincal.model.chain import MomentFrame
from pincal.model.effect import Effect
from pincal.model.effects import ELASTIC
from pincal.parameters import FRAME_SYMBOLS, Estimate
from pincal.sensors.setup import Setup
from pincal.thresholds import Scale
from pincal.units import GRAVITIES, LARGEST, SMALLEST, is_gravity

Stages = Literal["joint", "paper"]
Tools = dict[str, tuple[float, float, float] | np.ndarray]

# Largest deviation of a length that a fit may find [m]; the paper (IV.C) gives +-1 cm for real
# deviations.
LENGTH_BOUND: Scale = 0.01


class PriorScale(NamedTuple):
    """Factors on the standard deviations of priors, by the kind of the robot's parameters.

    Attributes:
        lengths: of link lengths and joint offsets along axes.
        angles: of link twists, axis distortions and joint offsets.
        drives: of drive compliances k_z.
        bearings: of all other compliances.
    """

    lengths: float = 1.0
    angles: float = 1.0
    drives: float = 1.0
    bearings: float = 1.0


class Kept(NamedTuple):
    """What a calibration left as in the robot description.

    Attributes:
        names: of the robot's parameters.
        nominal_mm: expected rms position error of the robot as described [mm].
        calibrated_mm: the same with the parameters that the readings suggest [mm].
    """

    names: tuple[str, ...]
    nominal_mm: float
    calibrated_mm: float


@dataclass(frozen=True)
class StationOptions:
    """Options of one station, by the names of :class:`Options`; None for the common ones."""

    sigma: float | None = None
    sigma_orientation: float | None = None
    payload_centre: tuple[float, float, float] | None = None
    base: np.ndarray | None = None
    tools: Tools | None = None
    setup: Setup | None = None
    instrument: InstrumentNoise | None = None

    def __post_init__(self) -> None:
        _check_numbers(self)


@dataclass(frozen=True)
class Options:
    """How to calibrate.

    Attributes:
        effects: what may deviate, in addition to base and tool.
        sigma: standard deviation of one component of a position, or of a distance [m], of an image
            [px]; estimated if None.
        sigma_orientation: likewise of one component of an orientation [rad].
        moment_frame: where moments are taken and deflect the arm, see
            :class:`pincal.model.chain.Chain`; "auto" for the best fit, as in the paper if several
            fit equally well.
        equilibrium: moments on the deflected arm instead of the rigid one.
        gravity: shape (3,), in the robot's base frame [m/s^2]; default: along -z of the URDF's
            root.
        payload_centre: centre of mass of the payload in the tip frame [m].
        base: shape (4, 4), robot base in the instrument's frame, if known.
        tools: target name -> (x, y, z) in the tip frame [m], or shape (4, 4), target to tip frame,
            if known.
        stages: "joint" fits all parameters at once, "paper" follows the paper's sequence.
        loss: treatment of outliers: "screen", "huber" or "none".
        length_bound: largest deviation of a length [m].
        setup: named points and the camera, as far as they are known.
        stations: station name -> its own options, where there are several stations.
        instrument: the noise of positions by range and direction, instead of ``sigma``; positions
            are then in the instrument's own frame.
        earlier: estimate of the robot's parameters from an earlier fit; it replaces their priors.
        priors: name of a parameter, or a pattern such as ``"*.theta"`` -> standard deviation from
            its value in the URDF, in its SI unit or with another (0.001, "1mrad", "0.2urad/Nm"); 0
            holds it, inf leaves it unconstrained. The last of several matches counts.
        zeros: joints with unknown zeros, by names or patterns such as ``"*"``.
        prior_scale: factors on the priors of a robot's lengths, angles, drive compliances and other
            compliances, except those in ``priors``; default: 1, or where no instrument determines
            positions as large as the readings allow.
        unturned: names of the stations whose poses hardly turn the tool: their targets are assumed
            within the arm's reach of the tip, as a calibration finds out itself.
        kept: what a calibration left nominal because its readings do not improve the robot.
        serial: whether to test for noise that is correlated along the rows, and weight rows
            accordingly.
    """

    effects: tuple[Effect, ...] = ELASTIC
    sigma: float | None = None
    sigma_orientation: float | None = None
    moment_frame: MomentFrame | Literal["auto"] = "paper"
    equilibrium: bool = False
    gravity: tuple[float, float, float] | None = None
    payload_centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    base: np.ndarray | None = None
    tools: Tools | None = None
    stages: Stages = "joint"
    loss: Loss = "screen"
    length_bound: float = LENGTH_BOUND
    setup: Setup = field(default_factory=Setup)
    stations: Mapping[str, StationOptions] = field(default_factory=dict)
    instrument: InstrumentNoise | None = None
    earlier: Estimate | None = None
    priors: Mapping[str, float | str] = field(default_factory=dict)
    zeros: tuple[str, ...] = ()
    prior_scale: PriorScale | None = None
    unturned: tuple[str, ...] = ()
    kept: Kept | None = None
    serial: bool = True

    def __post_init__(self) -> None:
        _check_numbers(self)

    @property
    def first_frame(self) -> MomentFrame:
        """The moment convention to begin with."""
        return "paper" if self.moment_frame == "auto" else self.moment_frame

    def at(self, station: str) -> Options:
        """Return the options of one station."""
        if station not in self.stations:
            return self
        own = self.stations[station]
        given = {
            f.name: getattr(own, f.name) for f in fields(own) if getattr(own, f.name) is not None
        }
        return replace(self, **given, stations={})


def _check_numbers(options: Options | StationOptions) -> None:
    """Refuse numbers that make no sense, before the arithmetic fails on them.

    Raises:
        BadInputError: naming the attribute.
    """
    held = {name: value for name, value in vars(options).items() if value is not None}
    coordinates: dict[str, Any] = {
        name: held[name] for name in ("gravity", "payload_centre", "base") if name in held
    }
    coordinates |= {f"tool {target!r}": place for target, place in held.get("tools", {}).items()}
    for what, value in coordinates.items():
        if not (np.abs(np.asarray(value, float)) <= LARGEST).all():
            raise BadInputError(
                f"{what} is {np.asarray(value).tolist()}; expected finite numbers of at "
                f"most {LARGEST:g}"
            )
    for name in ("sigma", "sigma_orientation", "length_bound"):
        if name in held and not SMALLEST <= held[name] <= LARGEST:
            raise BadInputError(
                f"{name} is {held[name]}; expected a number from {SMALLEST:g} to {LARGEST:g}"
            )
    for scale in held.get("prior_scale", ()):
        if not SMALLEST <= scale <= LARGEST:
            raise BadInputError(
                f"prior_scale is {held['prior_scale']}; expected four numbers from "
                f"{SMALLEST:g} to {LARGEST:g}"
            )
    if "gravity" in held and not is_gravity(held["gravity"]):
        raise BadInputError(f"gravity is {list(held['gravity'])}; expected {GRAVITIES}")


def known_frames(options: Options) -> set[str]:
    """Return the names of the coordinates of base and tools that the user gave."""
    given: dict[str, tuple[str, ...]] = {} if options.base is None else {"base": FRAME_SYMBOLS}
    given |= {
        n: FRAME_SYMBOLS[: 6 if np.shape(at) == (4, 4) else 3]
        for n, at in (options.tools or {}).items()
    }
    return {f"{element}.{symbol}" for element, symbols in given.items() for symbol in symbols}
