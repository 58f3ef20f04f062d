"""Quantities with units, and other values of options on the command line."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import click

from pincal.cli.arguments import pair
from pincal.robot.cell import Beside
from pincal.units import LARGEST, SMALLEST, plain_number, plain_numbers, unit_sizes

LENGTH_UNITS = unit_sizes("um", "mm", "cm", "m")
ANGLES = unit_sizes("urad", "mrad", "rad", "deg")


class QuantityType(click.ParamType[float]):
    """A positive number with its unit, such as ``0.05mm``; if zero is allowed, also 0 with or
    without a unit.

    A number without a unit is in multiples ``bare`` of the SI unit, if that is given.
    """

    def __init__(
        self, units: dict[str, float], name: str, *, zero: bool = False, bare: float | None = None
    ) -> None:
        self._units = units
        self.name = name
        self._zero = zero
        self._bare = bare
        self._si = next(unit for unit, factor in units.items() if factor == 1.0)

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """Return an example of the value, for the help text."""
        return self.name

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the value in SI units."""
        if isinstance(value, float):
            return value
        text = str(value).strip()
        for unit in (*sorted(self._units, key=len, reverse=True), ""):
            if text.endswith(unit):
                try:
                    number = plain_number(text.removesuffix(unit))
                except ValueError:
                    break
                if self._zero and number == 0.0:
                    return 0.0
                if not unit and self._bare is None:
                    break
                si = number * (self._units[unit] if unit else self._bare or 1.0)
                if not SMALLEST <= si <= LARGEST:
                    kind = f"a positive number{' of pixels' if unit == 'px' else ''}"
                    self.fail(
                        f"{text!r} is not {kind} from {SMALLEST:g} to {LARGEST:g} {self._si}",
                        param,
                        ctx,
                    )
                return si
        self.fail(
            f"{text!r}; expected a number with a unit, such as {self.name} "
            f"({', '.join(self._units)})",
            param,
            ctx,
        )


class NoiseType(click.ParamType[tuple[float, str]]):
    """The noise of a reading: a length in metres, or pixels; with the unit, "m" or "px"."""

    name = "0.05mm"

    def __init__(self, *, zero: bool = False) -> None:
        self._zero = zero

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, str]:
        """Return the value in SI units, or in pixels, and its unit."""
        is_image = str(value).strip().endswith("px")
        units, example = ({"px": 1.0}, "0.1px") if is_image else (LENGTH_UNITS, "0.05mm")
        number = QuantityType(units, example, zero=self._zero).convert(str(value), param, ctx)
        return number, "px" if is_image else "m"


def masses(text: str) -> tuple[float, ...]:
    """Return one or several masses [kg], separated by commas."""
    loads = plain_numbers(part.strip().removesuffix("kg") for part in text.split(","))
    if not loads or not all(0.0 <= load <= LARGEST for load in loads):
        raise click.BadParameter(
            f"{text!r}; expected one or several masses in kg, such as 80 or 0,80, of at "
            f"most {LARGEST:g}"
        )
    return tuple(loads)


def xacro_argument(text: str) -> tuple[str, str]:
    """Return name and value of an argument of a xacro file, in the syntax of xacro."""
    name, sign, value = text.partition(":=")
    if not sign or not name:
        raise click.BadParameter(f"{text!r}; expected NAME:=VALUE, such as ur_type:=ur5e")
    return name, value


COLUMNS = "'J1=joint_a1 [deg],...'"


def columns(text: str) -> dict[str, str]:
    """Return the quantities of columns by name, from ``NAME=MEANING`` separated by commas."""
    found: dict[str, str] = {}
    expected = f"NAME=MEANING, each name once, such as {COLUMNS}"
    for part in text.split(","):
        name, meaning = pair(part, expected)
        if name in found:
            raise click.BadParameter(f"{part.strip()!r}; expected {expected}")
        found[name] = meaning
    return found


BESIDE = "right=ur10.urdf@1.5m,0,0,0,0,180deg"
LENGTH = QuantityType(LENGTH_UNITS, "0.05mm")
ANGLE = QuantityType(ANGLES, "0.1mrad")
DURATION = QuantityType({"s": 1.0, "min": 60.0}, "300s")


def station_links(text: str) -> tuple[str, str, str]:
    """Return the name of a station, and the links of its instrument and target."""
    words = tuple(word.strip() for word in text.rsplit(":", 2))
    if len(words) != 3 or not all(words):
        raise click.BadParameter(
            f"{text!r}; expected NAME:FROM:TO, such as left:base_link:left_hand"
        )
    return words


def beside(text: str) -> Beside:
    """Return a further robot of the cell, ``[NAME=]URDF[@X,Y,Z,ROLL,PITCH,YAW]``."""
    given, at, numbers = text.partition("@")
    name, sign, source = given.partition("=")
    if not sign:
        name = re.sub(r"\W", "_", Path(given).stem)
        source = given
    units = [LENGTH_UNITS] * 3 + [ANGLES] * 3
    place = (
        [_signed(word.strip(), of) for word, of in zip(numbers.split(","), units, strict=False)]
        if at
        else None
    )
    if not (source and re.fullmatch(r"\w+", name)) or (
        place is not None and numbers.count(",") != 5
    ):
        raise click.BadParameter(
            f"{text!r}; expected [NAME=]URDF[@X,Y,Z,ROLL,PITCH,YAW], such as {BESIDE}"
        )
    return Beside(source, name, None if place is None else tuple(place))


def resting(text: str) -> tuple[str, float]:
    """Return a joint and its resting position [rad or m]."""
    joint, value = pair(text, "JOINT=POSITION, such as torso_lift=0.1m or head_1=20deg")
    units = {**ANGLES, **LENGTH_UNITS}
    return joint, _signed(value, units)


def _signed(text: str, units: dict[str, float]) -> float:
    unit = next((unit for unit in sorted(units, key=len, reverse=True) if text.endswith(unit)), "")
    try:
        number = plain_number(text.removesuffix(unit)) * units.get(unit, 1.0)
    except ValueError:
        number = math.nan
    # Not a number is in no range.
    if not -LARGEST <= number <= LARGEST:
        raise click.BadParameter(
            f"{text!r}; expected a position such as 0.1m, 20deg or 0.35 (rad or m), of at most "
            f"{LARGEST:g}"
        )
    return number
