"""Where a fit begins: base and tool in closed form, then fitted alone."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from pincal.errors import BadInputError, MeasurementError
from pincal.identify.beliefs import frames_of, noise_of, priors_of, released_of
from pincal.identify.noise import Loss, Noise
from pincal.identify.options import Options
from pincal.identify.problem import Problem
from pincal.identify.solve import Priors, Solution, solve
from pincal.identify.start import placements
from pincal.identify.station import Station, conditions_of, station_of
from pincal.measure.extrinsics import Extrinsics
from pincal.measure.measurements import Measurements
from pincal.measure.rows import some_rows
from pincal.measure.sensing import sensor_of
from pincal.model.chain import Chain
from pincal.model.effects import BaseFrame, Effect, ToolFrame
from pincal.model.model import Model
from pincal.robot.robot import Robot


def place(robot: Robot, measurements: Measurements, options: Options, *, name: str = "") -> tuple[Station, np.ndarray]:
    """Return a station with base and tool about where they are, and the values to start from.

    Of the closed-form candidates the one whose fit of base and tool leaves least is taken.

    Args:
        robot: the arm.
        measurements: the station's table.
        options: how to calibrate, as they are for this station.
        name: of the station, where there are several.
    """
    if len(measurements) == 0:
        raise MeasurementError(f"{measurements.source}: no rows to calibrate with")
    chain = Chain.of(
        robot,
        moment_frame=options.moment_frame,
        gravity=None if options.gravity is None else np.array(options.gravity),
        targets=tuple(str(t) for t in np.unique(measurements.target)),
    )
    sensor = sensor_of(measurements, options.setup)
    frames: tuple[Effect, ...] = (BaseFrame(sensor.base_symbols), ToolFrame(sensor.tool_symbols))
    bare = Model(chain, frames)
    conditions = conditions_of(bare, measurements, np.array(options.payload_centre))
    sample = some_rows(len(conditions), 2000, sensor.groups)
    tips = bare.predict(np.zeros(bare.n_parameters), conditions.select(sample))
    found = placements(sensor.select(sample), tips, conditions.target[sample], len(chain.targets))
    candidates = [_known(placement, chain, options) for placement in found]
    if not sensor.base_symbols:
        candidates = [replace(candidate, base=np.eye(4)) for candidate in candidates]
    starts = [_at(bare, measurements, placement, options) for placement in candidates]
    settled = [_settled(station, values, options) for station, values in starts]
    best = int(np.argmin([rest for _, rest in settled]))
    model = Model(chain, (*frames, *options.effects), equilibrium=options.equilibrium)
    station, _ = _at(model, measurements, candidates[best], options, name=name)
    start = dict(zip((p.name for p in starts[best][0].parameters), settled[best][0], strict=True))
    return station, np.array([start.get(p.name, 0.0) for p in station.parameters])


def fit_frames(
    problem: Problem,
    start: np.ndarray,
    free: np.ndarray,
    *,
    sizes: np.ndarray | None = None,
    bounds: np.ndarray | None = None,
    noise: Noise | None = None,
    loss: Loss = "huber",
    rough: bool = True,
    label: str = "",
    executor: Executor | None = None,
) -> Solution:
    """Fit what stands around the robot, with the robot itself as it is.

    Args:
        problem: the stations.
        start: shape (P,), where to begin.
        free: shape (P,), which parameters to fit, such as those of :func:`pincal.identify.beliefs.frames_of`.
        sizes: shape (P,), of priors, where more than frames is to be fitted; default: none.
        bounds: shape (P,), largest values; default: none.
        noise: default: none is declared.
        loss: what to do with outliers.
        rough: whether it will do to come close.
        label: what the fit is called in the log.
        executor: as for :func:`pincal.identify.solve.solve`.
    """
    nothing = np.full(len(start), np.inf)
    priors = Priors(nothing if sizes is None else sizes, nothing if bounds is None else bounds)
    noise = Noise((None,) * len(problem.blocks)) if noise is None else noise
    return solve(problem, start, free, priors, noise, loss=loss, rough=rough, label=label, executor=executor)


def _known(placement: Extrinsics, chain: Chain, options: Options) -> Extrinsics:
    """Put in what the user knows of base and tools."""
    base = placement.base if options.base is None else np.asarray(options.base, float)
    tools = placement.tools.copy()
    for name, given in (options.tools or {}).items():
        if name not in chain.targets:
            raise BadInputError(f"tool {name!r} is given but no row has this target; targets: {', '.join(chain.targets)}")
        if np.shape(given) == (4, 4):
            tools[chain.targets.index(name)] = given
        else:
            tools[chain.targets.index(name), :3, 3] = given
    return replace(placement, base=base, tools=tools)


def _at(
    model: Model, measurements: Measurements, placement: Extrinsics, options: Options, *, name: str = ""
) -> tuple[Station, np.ndarray]:
    """Return the station and values that stand at a placement."""
    chain = model.chain.with_references(placement.base[:3, :3], placement.tools[:, :3, :3])
    centre = np.array(options.payload_centre)
    station = station_of(model.with_chain(chain), measurements, centre, options.setup, name=name)
    values = np.zeros(len(station.parameters))
    station.split(values)[1][:] = placement.own
    names = [parameter.name for parameter in station.parameters]
    for element, at in [("base", placement.base), *zip(chain.targets, placement.tools, strict=True)]:
        for symbol, value in zip("xyz", at[:3, 3], strict=True):
            if f"{element}.{symbol}" in names:
                values[names.index(f"{element}.{symbol}")] = value
    return station, values


def _settled(station: Station, values: np.ndarray, options: Options) -> tuple[np.ndarray, float]:
    """Return the values after a short fit of base and tool, and the median row residual; outliers don't vote."""
    sample = station.select(some_rows(len(station), 500, station.sensor.groups))
    problem = Problem((sample,))
    free = released_of(problem, options) & frames_of(problem)
    bounds = priors_of(problem, options).bounds
    fit = fit_frames(problem, values, free, bounds=bounds, noise=noise_of(problem, options), rough=False)
    return fit.values, float(np.median(np.linalg.norm(sample.residuals(fit.values), axis=0)))
