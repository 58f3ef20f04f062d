"""Where a fit of a station begins: the best of its sensor's closed-form placements of base and tool."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pincal.errors import BadInputError, MeasurementError
from pincal.identify.beliefs import bounds_of, frames_of, noise_of, released_of
from pincal.identify.options import Options
from pincal.identify.problem import Problem
from pincal.identify.solve import Priors, most_probable
from pincal.identify.station import Station, station_of
from pincal.measure.extrinsics import Extrinsics
from pincal.measure.measurements import Measurements
from pincal.measure.rows import some_rows
from pincal.model.chain import Chain
from pincal.model.effects import BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.parameters import carried_over
from pincal.robot.robot import Robot

# More rows than these add nothing to a start.
_ROWS = 2000


def place(robot: Robot, measurements: Measurements, options: Options, *, name: str = "") -> tuple[Station, np.ndarray]:
    """Return a station with base and tool about where they are, and the values to start from.

    Args:
        robot: the arm, taken as nominal.
        measurements: the station's table.
        options: how to calibrate, as they are for this station.
        name: of the station, where there are several.
    """
    gravity = None if options.gravity is None else np.array(options.gravity)
    arm = Model(Chain.of(robot, moment_frame=options.moment_frame, gravity=gravity), ())
    station, values = place_arm(arm, np.zeros(0), measurements, options=options, name=name)
    model = replace(station.model, effects=(*station.model.effects, *options.effects), equilibrium=options.equilibrium)
    index = {parameter.name: i for i, parameter in enumerate(station.parameters)}
    whole = station.with_model(model)
    return whole, carried_over(values, index, whole.parameters)


def place_arm(
    arm: Model, values: np.ndarray, measurements: Measurements, *, options: Options, name: str = ""
) -> tuple[Station, np.ndarray]:
    """Return the station of an arm whose deviations are known, with base and tool about where they are, and its values.

    Of the closed-form candidates the one whose fit of base and tool leaves least is taken.

    Args:
        arm: the arm's chain and effects, without base and tool; its targets and reference orientations don't count.
        values: shape (P,), of its parameters.
        measurements: the station's table.
        options: what is known of the station.
        name: of the station, where there are several.
    """
    if len(measurements) == 0:
        raise MeasurementError(f"{measurements.source}: no rows to calibrate with")
    targets = tuple(str(t) for t in np.unique(measurements.target))
    chain = replace(arm.chain, targets=targets).with_references(np.eye(3), np.tile(np.eye(3), (len(targets), 1, 1)))
    arm = arm.with_chain(chain)
    rows = station_of(arm, measurements, np.array(options.payload_centre), options.setup, name=name)
    some = rows.select(some_rows(len(rows), _ROWS, rows.sensor.groups))
    tips = np.ascontiguousarray(arm.predict(values, some.conditions))
    found = some.sensor.starts(tips, some.conditions.target, len(targets))
    candidates = [_known(placement, chain, options) for placement in found]
    if not rows.sensor.base_symbols:
        candidates = [replace(candidate, base=np.eye(4)) for candidate in candidates]
    frames = (BaseFrame(rows.sensor.base_symbols), ToolFrame(rows.sensor.tool_symbols))
    whole = rows.with_model(arm.with_effects([*frames, *arm.effects]))
    deviations = dict(zip(arm.names, values, strict=True))
    starts = [_at(whole, placement, deviations) for placement in candidates]
    settled = [_settled(*start, options) for start in starts]
    best = int(np.argmin([rest for _, rest in settled]))
    return starts[best][0], settled[best][0]


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


def _at(station: Station, placement: Extrinsics, deviations: Mapping[str, float]) -> tuple[Station, np.ndarray]:
    """Return the station about a placement, and the values that stand there, with those of the arm by name."""
    chain = station.model.chain.with_references(placement.base[:3, :3], placement.tools[:, :3, :3])
    station = station.with_model(station.model.with_chain(chain))
    values = np.zeros(len(station.parameters))
    station.split(values)[1][:] = placement.own
    names = {parameter.name: i for i, parameter in enumerate(station.parameters)}
    for name, value in deviations.items():
        values[names[name]] = value
    for element, at in [("base", placement.base), *zip(chain.targets, placement.tools, strict=True)]:
        for symbol, value in zip("xyz", at[:3, 3], strict=True):
            if f"{element}.{symbol}" in names:
                values[names[f"{element}.{symbol}"]] = value
    return station, values


def _settled(station: Station, values: np.ndarray, options: Options) -> tuple[np.ndarray, float]:
    """Return the values after a short fit of base and tool, and the median row residual; outliers don't vote."""
    sample = station.select(some_rows(len(station), 500, station.sensor.groups))
    problem = Problem((sample,))
    free = released_of(problem, options) & frames_of(problem)
    priors = Priors(np.full(len(values), np.inf), bounds_of(problem, options))
    values = most_probable(problem, values, free, priors, noise_of(problem, options), loss="huber")
    return values, float(np.median(np.linalg.norm(sample.residuals(values), axis=0)))
