"""Where model and data disagree, in words."""

from __future__ import annotations

import numpy as np

from pincal.discover.locate import Place, Region
from pincal.robot.robot import Robot
from pincal.units import format_small

_FOLLOWED = {
    "approach": "depending on the direction from which it arrives",
    "load": "following the load on its axis",
    "payload": "following the payload",
    "temperature": "following the temperature",
    "time": "as time goes by",
}


def location_words(place: Place, robot: Robot) -> str:
    """Return where a disagreement acts and what it follows."""
    followed = _FOLLOWED.get(place.depends_on)
    if followed is None:
        own = place.depends_on == place.joint
        followed = f"following {'its own' if own else 'the'} position" + ("" if own else f" of {place.depends_on}")
    return f"{_moves(place, robot)}, {followed}{_range_words(place, robot)}"


def _moves(place: Place, robot: Robot) -> str:
    if place.joint is None:
        return (
            "the whole arm moves on its base"
            if place.acts_on == "base"
            else f"all lengths grow by {format_small(place.size, '1')} rms"
        )
    prismatic = robot.joint_types[robot.joint_names.index(place.joint)] == "prismatic"
    if place.acts_on != "drive":
        return f"the axis of {place.joint} tilts by {format_small(place.size, 'rad')} rms"
    if prismatic:
        return f"{place.joint} is off along its axis by {format_small(place.size, 'm')} rms"
    return f"{place.joint} is off about its own axis by {format_small(place.size, 'rad')} rms"


def _range_words(place: Place, robot: Robot) -> str:
    if place.window is None:
        return ""
    prismatic = robot.joint_types[robot.joint_names.index(place.depends_on)] == "prismatic"
    low, high = place.window if prismatic else np.degrees(place.window)
    form = ".3f" if prismatic else ".0f"
    unit = "m" if prismatic else "deg"
    return f"; {100 * place.inside:.0f} % of it between {low:{form}} and {high:{form}} {unit}"


def region_words(region: Region, robot: Robot) -> tuple[str, str]:
    """Return a region's name and what is to be said of it."""
    if region.direction:
        name = f"{region.direction} direction"
        return name, f"the error points in the {name} (a third would be even)"
    name = f"{region.variable} {region.lower:.2f} to {region.upper:.2f} m"
    first = robot.joint_names[0]
    where = f"from {first}" if region.variable == "reach" else f"above {first}"
    rows = f"{100 * region.rows:.0f} % of the poses"
    return name, f"it shows where the tip is {region.lower:.2f} to {region.upper:.2f} m {where}, in {rows}"
