"""What is believed of a problem's parameters before anything is fitted: which may move, how far, and how large noise is."""

from __future__ import annotations

import numpy as np

from pincal.identify.noise import Noise
from pincal.identify.options import Options, known_frames
from pincal.identify.problem import Problem
from pincal.identify.solve import Priors
from pincal.model.effects import LENGTH_SIZE

# A point that seems farther away than this [m] was seen from too much the same side.
_FARTHEST = 50.0


def frames_of(problem: Problem) -> np.ndarray:
    """Return which parameters say where things are: base and tool, named points, a camera's pinhole, shape (P,)."""
    return np.array([p.is_extrinsic for p in problem.local_parameters], bool)


def sensors_own(problem: Problem) -> np.ndarray:
    """Return which parameters belong to sensors, shape (P,): coordinates of named points, a camera's lens."""
    own = np.zeros(problem.size, bool)
    for station, places in zip(problem.stations, problem.places, strict=True):
        local = np.zeros(len(places), bool)
        station.split(local)[1][:] = True
        own[places] |= local
    return own


def released_of(problem: Problem, options: Options) -> np.ndarray:
    """Return which parameters a fit may move: all but a known base, known tools and what sensors know of themselves."""
    free = np.zeros(problem.size, bool)
    for station, places in zip(problem.stations, problem.places, strict=True):
        known = known_frames(options.at(station.name))
        local = np.array([p.name not in known for p in station.parameters]) if known else np.ones(len(places), bool)
        station.split(local)[1][:] = ~station.sensor.fixed
        free[places] |= local
    return free


def excited_of(problem: Problem) -> np.ndarray:
    """Return which parameters act at all at the nominal geometry, or did so: not the compliance about a vertical axis."""
    return np.asarray(problem.is_remembered | problem.largest_basis[1])


def priors_of(problem: Problem, options: Options) -> Priors:
    """Return priors by physical group: so many mm, mrad, or mrad at the largest moment that these poses bring."""
    sizes = np.array([parameter.size for parameter in problem.local_parameters]) / problem.largest_basis[0]
    if problem.remembered is not None:
        known, earlier = problem.remembered
        sizes[known] = earlier.widened(sizes[known])
    return Priors(sizes, bounds_of(problem, options))


def bounds_of(problem: Problem, options: Options) -> np.ndarray:
    """Return the largest deviations that a fit may find, shape (P,); inf for none.

    The bound of lengths is meant for those of links; a length that is known less well may be off by as many times more.
    """
    sizes = np.array([p.size if p.unit == "m" and np.isfinite(p.size) else np.inf for p in problem.local_parameters])
    bounds = options.length_bound * np.maximum(sizes / LENGTH_SIZE, 1.0)
    far = np.array([p.unit == "m" and p.is_extrinsic for p in problem.local_parameters])
    bounds[sensors_own(problem) & far] = _FARTHEST
    return bounds


def noise_of(problem: Problem, options: Options) -> Noise:
    """Return the declared noise of each block of readings."""
    declared: list[float | None] = []
    for station in problem.stations:
        own = options.at(station.name)
        sighted = station.conditions.sighted
        sigma = own.sigma if own.instrument is None or sighted is None else own.instrument.sigma(sighted)
        declared += [own.sigma_orientation if b.unit == "rad" else sigma for b in station.sensor.blocks]
    return Noise(tuple(declared))
