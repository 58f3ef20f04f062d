"""A fitted robot in words: in one line, and in a few."""

from __future__ import annotations

from collections.abc import Sequence

from pincal.calibration.fit_evidence import Evidence, FitEvidence
from pincal.calibration.fitted_station import FittedStation
from pincal.identify.fit import ModelFit
from pincal.parameters import Estimate
from pincal.thresholds import Count
from pincal.units import format_readable

# Stations whose noise stands in one line.
_NAMED_STATIONS: Count = 3


def in_one_line(stations: Sequence[FittedStation], estimate: Estimate, evidence: Evidence) -> str:
    """Return what a robot of this estimate rests on: the rows and noise of its fit, its stations,
    or its parameters.
    """
    if isinstance(evidence, FitEvidence):
        noise = _noise(evidence.fit)
        if len(noise) > _NAMED_STATIONS:
            more = f"and {len(noise) - _NAMED_STATIONS} more stations"
            noise = [*noise[:_NAMED_STATIONS], more]
        return f"{len(evidence.fit.problem)} rows, noise {'; '.join(noise)}"
    if len(stations) > 1:
        return f"stations {' '.join(station.name for station in stations)}"
    return f"{len(estimate)} parameters, {stations[0].sensor_kind}"


def in_few_lines(stations: Sequence[FittedStation], estimate: Estimate, evidence: Evidence) -> str:
    """Return the robot, its measurements, the number of fitted parameters and, of a fit, how it
    ended.
    """
    model = stations[0].model
    robot = model.chain.robot
    effects = ", ".join(dict.fromkeys(effect.name for effect in model.effects))
    kinds = ", ".join(dict.fromkeys(station.sensor_kind for station in stations))
    words = (
        f"{robot.name}, {robot.n_joints} joints from {robot.base} to {robot.tip}, "
        f"calibrated with {kinds} measurements\n{int(estimate.free.sum())} of "
        f"{len(estimate)} parameters fitted: {effects}"
    )
    if not isinstance(evidence, FitEvidence):
        return words
    fit = evidence.fit
    solution = fit.solution
    state = "converged" if solution.converged else "did not converge"
    return (
        f"{words}\n{len(fit.problem)} rows, {state} after {fit.iterations} iterations; "
        f"{solution.posterior.identifiable_rank} combinations of {int(solution.free.sum())} "
        f"parameters determined; noise {'; '.join(_noise(fit))}"
    )


def _noise(fit: ModelFit) -> list[str]:
    """Return the noise of each station's residuals, with its name if there are several."""
    found = list[str]()
    for station, _, blocks in fit.stations:
        estimated = fit.solution.estimated[blocks]
        sizes = zip(estimated.tolist(), station.sensor.blocks, strict=True)
        words = ", ".join(format_readable(size, block.unit) for size, block in sizes)
        found.append(words if len(fit.problem.stations) == 1 else f"{station.name}: {words}")
    return found
