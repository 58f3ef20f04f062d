"""Prior knowledge about a problem's parameters: which are released, their priors and bounds, and
the declared noise.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from fnmatch import fnmatchcase

import numpy as np

from pincal.errors import BadInputError
from pincal.identify.fit import Priors
from pincal.identify.noise import Noise, usual_sizes
from pincal.identify.options import Options, PriorScale, known_frames
from pincal.identify.problem import Problem
from pincal.identify.station import Station
from pincal.model.effects import LENGTH_SIZE
from pincal.parameters import Parameter
from pincal.thresholds import Scale
from pincal.units import size_in

# A point estimated to be farther away than this [m] was observed from too few directions.
_FARTHEST: Scale = 50.0
# Prior of a parameter declared free, as a multiple of its usual size.
_FREE: Scale = 1e3
# Range of sensible prior standard deviations, in any unit; a float holds their squares.
_LEAST: Scale = 1e-30
_MOST: Scale = 1e30
_EXPECTED = f"a standard deviation from {_LEAST:g} to {_MOST:g}"


def is_frame(problem: Problem) -> np.ndarray:
    """Return which parameters are frame coordinates (base, tool, named points, a camera's pinhole),
    shape (P,).
    """
    return np.array([p.is_extrinsic for p in problem.parameters], bool)


def is_on_tool(parameter: Parameter) -> bool:
    """Return whether a parameter is a coordinate of the unknown place of a target or point."""
    return parameter.is_extrinsic and parameter.unit == "m" and parameter.element != "base"


def of_stations(problem: Problem, mask_of: Callable[[Station], np.ndarray]) -> np.ndarray:
    """Return which parameters are in the mask of any station, shape (P,)."""
    found = np.zeros(len(problem.parameters), bool)
    for station, places in zip(problem.stations, problem.places, strict=True):
        found[places] |= mask_of(station)
    return found


def of_sensors(problem: Problem) -> np.ndarray:
    """Return which parameters belong to sensors (coordinates of named points, a camera's lens),
    shape (P,).
    """
    return of_stations(problem, Station.sensors)


def given_sizes(problem: Problem, options: Options) -> np.ndarray:
    """Return the standard deviations of the priors in ``options.priors``, shape (P,): 0 if held,
    nan if none is given.

    Raises:
        BadInputError: for a size in another unit than the parameter's.
    """
    sizes = np.full(len(problem.parameters), np.nan)
    for pattern, size in options.priors.items():
        for k in _named(problem, pattern):
            parameter = problem.parameters[k]
            try:
                sizes[k] = size_in(size, parameter.unit) if isinstance(size, str) else size
            except ValueError as error:
                raise BadInputError(
                    f"the prior of {parameter.name} is {error}, or with a unit"
                ) from error
            if not (sizes[k] in (0.0, np.inf) or _LEAST <= sizes[k] <= _MOST):
                raise BadInputError(
                    f"the prior of {parameter.name} is {size}; expected {_EXPECTED}, or 0 "
                    "to hold it"
                )
    return sizes


def require_named(problem: Problem, options: Options) -> None:
    """Refuse a prior that matches no parameter of the model.

    Raises:
        BadInputError: naming similar parameters.
    """
    known = [problem.parameters[k].local_name for k in _named(problem, "*")]
    for pattern in options.priors:
        if not _named(problem, pattern):
            close = ", ".join(
                difflib.get_close_matches(pattern, dict.fromkeys(known), n=3, cutoff=0.0)
            )
            raise BadInputError(
                f"a prior is given for {pattern!r}, which is not a parameter of this "
                "model (base and targets excluded); "
                f"expected one such as {close}, or a pattern such as '*.theta'"
            )


def _named(problem: Problem, pattern: str) -> list[int]:
    """Return the indices of the parameters that match a name or pattern, frame coordinates and
    sensors' own excluded.
    """
    is_place = is_frame(problem) | of_sensors(problem)
    names = [{p.name, p.local_name} for p in problem.parameters]
    return [
        k
        for k, of in enumerate(names)
        if not is_place[k] and any(fnmatchcase(name, pattern) for name in of)
    ]


def released_of(problem: Problem, options: Options) -> np.ndarray:
    """Return which parameters a fit releases: all but those that the user gave, a sensor fixes, or
    a prior of 0 holds.
    """

    def released(station: Station) -> np.ndarray:
        known = known_frames(options.at(station.name))
        free = (
            np.array([p.name not in known for p in station.parameters])
            if known
            else np.ones(len(station.is_own), bool)
        )
        station.split(free)[1][:] = ~station.sensor.fixed
        return free

    given = given_sizes(problem, options)
    found = of_stations(problem, released) & (given != 0.0)
    if not any(station.sensor.reads_place for station in problem.stations):
        # A prior of 2 mm on unobservable lengths of links made a real arm worse than nominal.
        of_robot = ~of_stations(problem, lambda station: station.is_own)
        lengths = [p.unit == "m" and not p.is_extrinsic for p in problem.parameters] & of_robot
        found &= ~(lengths & np.isnan(given))
    return np.asarray(found)


def excited_of(problem: Problem) -> np.ndarray:
    """Return which parameters act at all at the nominal geometry, or did so in an earlier fit,
    shape (P,).
    """
    return np.asarray(problem.beliefs.is_earlier | problem.largest_basis[1])


def deviations(problem: Problem, options: Options) -> tuple[np.ndarray, ...]:
    """Return which parameters are of the kinds of :class:`PriorScale`, shape (P,) each.

    Excluded: where an arm is mounted, parameters with priors given by the user, and joint offsets
    with unknown zeros.
    """
    mounts = problem.chain.mounts
    zeros = [f"{pattern}.theta" for pattern in options.zeros]
    unknown = np.array(
        [
            p.local_name in mounts or any(fnmatchcase(p.local_name, z) for z in zeros)
            for p in problem.parameters
        ]
    )
    known = ~(unknown | is_frame(problem) | of_sensors(problem)) & np.isnan(
        given_sizes(problem, options)
    )
    elastic = np.array([p.is_compliance for p in problem.parameters], bool)
    lengths, angles = (
        known & ~elastic & np.array([p.unit == unit for p in problem.parameters])
        for unit in ("m", "rad")
    )
    drives = np.array([p.symbol == "k_z" for p in problem.parameters], bool)
    return lengths, angles, known & elastic & drives, known & elastic & ~drives


def priors_of(problem: Problem, options: Options) -> Priors:
    """Return priors by physical group: some mm, some mrad, or some mrad at the largest moment in
    these poses.
    """
    sizes = usual_sizes(problem)
    given = given_sizes(problem, options)
    for kind, scale in zip(
        deviations(problem, options), options.prior_scale or PriorScale(), strict=True
    ):
        sizes[kind] *= scale
    for pattern in options.zeros:
        unknown = [fnmatchcase(p.local_name, f"{pattern}.theta") for p in problem.parameters]
        sizes[np.array(unknown, bool)] = np.pi
    # Along axes that are known to be nearly parallel, as a SCARA's, or that no pose turns, a
    # target's position would be unbounded.
    near = [
        is_on_tool(p) and (options.earlier is not None or p.station in options.unturned)
        for p in problem.parameters
    ]
    sizes[np.array(near, bool)] = problem.chain.robot.reach
    # A free parameter needs a finite prior where no pose determines it; one that is held never
    # moves, whatever its size.
    given = np.where(np.isinf(given), np.maximum(_FREE * sizes, 1e-300), given)
    return Priors(
        problem.beliefs.widened(np.where(given > 0.0, given, sizes)), bounds_of(problem, options)
    )


def bounds_of(problem: Problem, options: Options) -> np.ndarray:
    """Return the largest deviations that a fit may find, shape (P,); inf for none.

    The bound on lengths applies to links; it grows in proportion for a length with a wider prior.
    """
    sizes = np.array([p.size for p in problem.parameters])
    given = given_sizes(problem, options)
    sizes = np.where(
        [p.unit == "m" for p in problem.parameters], np.where(given > 0.0, given, sizes), np.inf
    )
    bounds = options.length_bound * np.maximum(sizes / LENGTH_SIZE, 1.0)
    far = np.array([p.unit == "m" and p.is_extrinsic for p in problem.parameters])
    bounds[of_sensors(problem) & far] = _FARTHEST
    return bounds


def declared_noise(problem: Problem, options: Options) -> Noise:
    """Return the declared noise of each block of readings."""
    declared: list[float | None] = []
    for station in problem.stations:
        own = options.at(station.name)
        sighted = station.conditions.sighted
        sigma = (
            own.sigma
            if own.instrument is None or sighted is None
            else own.instrument.sigma(sighted)
        )
        of_unit = {"rad": own.sigma_orientation, "m": sigma, "px": sigma}
        declared += [of_unit.get(block.unit) for block in station.sensor.blocks]
    return Noise(tuple(declared))
