"""Units for input and output, and the formatting of numbers; the only place with conversion
factors.

The library computes in SI units throughout; factors are applied where a number is read or shown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from pincal.errors import BadInputError
from pincal.thresholds import Count, Scale

if TYPE_CHECKING:
    import numpy as np

LARGEST: Scale = 1e7
"""Largest plausible quantity of a robot cell in SI units.

Some cells are placed in national grids, which extend that far; beyond, a double does not resolve a
nanometre.
"""
SMALLEST: Scale = 1e-12
"""Smallest plausible positive quantity in SI units: a picometre is a hundredth of an atom."""

STANDARD_GRAVITY: Scale = 9.80665
"""Gravity that defines units of g [m/s^2]."""
_DEG = math.pi / 180
_LENGTHS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "µm": 1e-6, "in": 0.0254}
_TURN = {"rev": 2.0 * math.pi, "gon": math.pi / 200}
_SIZES = {
    "length": _LENGTHS,
    "noise": {**_LENGTHS, "px": 1.0},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": _DEG, "°": _DEG} | _TURN,
    "mass": {"kg": 1.0, "g": 1e-3, "lb": 0.45359237},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "temperature": {"degC": 1.0, "°C": 1.0, "K": 1.0},
    "pixel": {"px": 1.0},
    "acceleration": {"m/s^2": 1.0, "m/s²": 1.0, "mm/s^2": 1e-3},
    "angular rate": {"rad/s": 1.0, "mrad/s": 1e-3} | dict.fromkeys(("deg/s", "°/s", "dps"), _DEG),
    "number": {},
    "name": {},
}
_SIZES["angular rate"] |= dict.fromkeys(("mdeg/s", "mdps"), 1e-3 * _DEG)
# Units with another meaning for this quantity.
_SIZES_OF = {"acceleration": {"g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY}}
SIZES = {unit: size for sizes in _SIZES.values() for unit, size in sizes.items()} | {"urad": 1e-6}
"""Sizes of units in SI units (temperatures: in deg C)."""
UNITS = {quantity: (*sizes, *_SIZES_OF.get(quantity, ())) for quantity, sizes in _SIZES.items()}
"""The possible units of a column by its quantity, the SI unit first; without a unit in the header
it is in SI units.
"""


def unit_sizes(*units: str) -> dict[str, float]:
    """Return the sizes of some units in SI units.

    Example:
        >>> unit_sizes("mm", "m")
        {'mm': 0.001, 'm': 1.0}
    """
    return {unit: SIZES[unit] for unit in units}


# Offsets of units, added after scaling.
_OFFSETS = {"K": -273.15}
# Quantities of any size, such as counts and times, which some clocks count in nanoseconds from
# 1970; their limit.
_UNBOUNDED = ("time", "number", "name")
_LARGEST_COUNT: Scale = 1e20


def is_possible(values: np.ndarray, quantity: str) -> np.ndarray:
    """Return which values of a quantity in SI units are plausible: finite, and no larger than
    anything about a robot.
    """
    import numpy as np

    return np.asarray(np.abs(values) <= (_LARGEST_COUNT if quantity in _UNBOUNDED else LARGEST))


def expected_number(quantity: str) -> str:
    """Return in words which values are plausible.

    Example:
        >>> expected_number("length"), expected_number("time")
        ('a finite number (at most 1e+07 m)', 'a finite number (at most 1e+20)')
    """
    most = (_LARGEST_COUNT, "") if quantity in _UNBOUNDED else (LARGEST, f" {UNITS[quantity][0]}")
    return "a finite number (at most {:g}{})".format(*most)


def size_of(unit: str, quantity: str = "") -> float:
    """Return the size of a unit of a quantity in SI units; an unknown one counts as SI.

    Example:
        >>> size_of("g"), size_of("g", "acceleration")
        (0.001, 9.80665)
    """
    return _SIZES_OF.get(quantity, {}).get(unit, SIZES.get(unit, 1.0))


def in_si(values: np.ndarray, unit: str, quantity: str = "") -> np.ndarray:
    """Return values of a quantity in SI units; an empty unit is SI."""
    size = size_of(unit, quantity)
    offset = _OFFSETS.get(unit, 0.0)
    return values if (size, offset) == (1.0, 0.0) else values * size + offset


def in_unit(values: np.ndarray, unit: str) -> np.ndarray:
    """Return values in SI units in another unit; an empty one is SI."""
    size = SIZES.get(unit, 1.0)
    offset = _OFFSETS.get(unit, 0.0)
    return values if (size, offset) == (1.0, 0.0) else (values - offset) / size


# Plausible gravity other than zero [m/s^2], from orbit to a hundred times that on earth.
_LEAST_GRAVITY: Scale = 1e-6
_MOST_GRAVITY: Scale = 1e3
# Gravity on earth is 9.76 to 9.84; to a percent of it.
_OF_EARTH: Scale = 0.1
GRAVITIES = f"0 0 0, or a vector of {_LEAST_GRAVITY:g} to {_MOST_GRAVITY:g} m/s^2"
"""Plausible gravity in words."""


def is_gravity(vector: Sequence[float]) -> bool:
    """Return whether a vector is a plausible gravity [m/s^2].

    Example:
        >>> [is_gravity((0.0, 0.0, z)) for z in (-9.81, 1e-300, 0.0)]
        [True, False, True]
    """
    size = math.hypot(*vector)
    return size == 0.0 or _LEAST_GRAVITY <= size <= _MOST_GRAVITY


def is_of_earth(vector: Sequence[float]) -> bool:
    """Return whether a vector is as long as gravity anywhere on earth, to a percent [m/s^2].

    Example:
        >>> [is_of_earth((0.0, 0.0, z)) for z in (-9.81, -9.8, -1.0, 0.0)]
        [True, True, False, False]
    """
    return abs(math.hypot(*vector) - STANDARD_GRAVITY) <= _OF_EARTH


def plain_number(text: str) -> float:
    """Return a number written in decimal digits; Python alone would also accept ``1_0`` or Arabic
    digits.

    Raises:
        ValueError: for any other text.

    Example:
        >>> plain_number(" -1.5e3 ")
        -1500.0
    """
    if not text.isascii() or "_" in text:
        raise ValueError(f"{text!r} is not a number in plain digits")
    return float(text)


def plain_numbers(words: Iterable[str]) -> list[float]:
    """Return words as numbers, see :func:`plain_number`; none if some word is not a number."""
    try:
        return [plain_number(word) for word in words]
    except ValueError:
        return []


def unmasked(value: Any, what: str) -> Any:
    """Return an array, or lists of some, of a caller as they are.

    Raises:
        BadInputError: for masked values, which NumPy alone would use.
    """
    import numpy as np

    parts = value if isinstance(value, list | tuple) else ()
    masked = (part for part in (value, *parts) if isinstance(part, np.ma.MaskedArray))
    if any(map(np.ma.is_masked, masked)):
        raise BadInputError(
            f"{what}: has masked values; expected none: leave the rows with masked values out"
        )
    return value


def real_array(value: Any, what: str) -> np.ndarray:
    """Return numbers of a caller as an array of floats; NumPy alone would use what is masked, and
    drop imaginary parts.

    Args:
        value: an array, or nested lists.
        what: its name, for messages.

    Raises:
        BadInputError: for masked values, or complex numbers.
        ValueError: for what are no numbers, or rows of different lengths.
        TypeError: likewise.

    Example:
        >>> real_array([[1, 2]], "q")
        array([[1., 2.]])
    """
    import numpy as np

    found = np.asarray(unmasked(value, what))
    if np.iscomplexobj(found):
        raise BadInputError(f"{what}: has complex numbers; expected real ones")
    return np.asarray(found, float)


def size_in(text: str, unit: str) -> float:
    """Return a number with or without a unit as a number in another unit of the same kind.

    Raises:
        ValueError: for other text.

    Example:
        >>> size_in("0.5mm", "m"), size_in("0.2 urad/Nm", "rad/(N m)"), size_in("inf", "rad")
        (0.0005, 2e-07, inf)
    """
    of, _, per = unit.partition("/")
    kinds = [kind for kind in UNITS.values() if of in kind]
    number, divided, below = text.replace(" ", "").partition("/")
    if divided and below.strip("()") != per.replace(" ", "").strip("()"):
        raise ValueError(f"{text!r}; expected a number in {unit}")
    known = {
        name: SIZES[name] / SIZES[of]
        for name in (*(kinds[0] if kinds else ()), *(("urad",) if of == "rad" else ()))
    }
    for name in (*sorted(known, key=len, reverse=True), ""):
        if number.endswith(name) and not (per and name and not divided):
            try:
                return plain_number(number.removesuffix(name)) * known.get(name, 1.0)
            except ValueError:
                continue
    raise ValueError(f"{text!r}; expected a number in {unit}")


class Unit(NamedTuple):
    """A unit for display: the factor on an SI value, and the symbol."""

    factor: float
    name: str


# SI unit -> unit in which calibration parameters and errors are shown.
_READABLE = {
    "m": Unit(1e3, "mm"),
    "rad": Unit(1e3, "mrad"),
    "px": Unit(1.0, "px"),
    "rad/s": Unit(1e3, "mrad/s"),
    "rad/(N m)": Unit(1e6, "µrad/(N m)"),
}
# SI unit -> unit in which joint positions and their changes are shown, as pendants do.
_OF_JOINTS = {"rad": Unit(180.0 / math.pi, "deg"), "m": Unit(1e3, "mm")}
# SI unit -> unit in which small effects of a robot are shown.
_SMALL = {
    "rad": Unit(1e6, "µrad"),
    "m": Unit(1e6, "µm"),
    "1": Unit(1e6, "ppm"),
    "1/K": Unit(1e6, "ppm/K"),
    "rad/K": Unit(1e6, "µrad/K"),
    "m/K": Unit(1e6, "µm/K"),
    "m/s": Unit(3.6e9, "µm/h"),
    "rad/s": Unit(3.6e9, "µrad/h"),
    "rad/m": Unit(1e3, "µrad/mm"),
    "m/rad": Unit(1e3, "µm/mrad"),
    "rad/(N m)": Unit(1e6, "µrad/(N m)"),
}


def readable_unit(unit: str) -> Unit:
    """Return the unit for showing parameters and errors given in an SI unit; an unknown unit is
    unchanged.

    Example:
        >>> readable_unit("m"), readable_unit("kg")
        (Unit(factor=1000.0, name='mm'), Unit(factor=1.0, name='kg'))
    """
    return _READABLE.get(unit, Unit(1.0, unit))


def small_unit(unit: str) -> Unit:
    """Return the unit for showing small effects given in an SI unit; an unknown unit is unchanged.

    Example:
        >>> small_unit("rad/K")
        Unit(factor=1000000.0, name='µrad/K')
    """
    return _SMALL.get(unit, Unit(1.0, unit))


def unit_of_size(value: float, unit: str) -> Unit:
    """Return the unit for showing an effect of some size given in an SI unit: the small one, or
    millimetres and milliradians from one of these on.

    Example:
        >>> unit_of_size(2.1e-5, "m").name, unit_of_size(-0.346, "m").name
        ('µm', 'mm')
    """
    factor, name = small_unit(unit)
    if abs(value * factor) >= 1000.0 and name in ("µrad", "µm"):
        return Unit(factor / 1000.0, name.replace("µ", "m"))
    return Unit(factor, name)


def format_readable(value: float, unit: str, form: str = ".3g") -> str:
    """Return an SI value in its readable unit.

    Example:
        >>> format_readable(2.5e-4, "rad"), format_readable(0.0123456, "m", ".4f")
        ('0.25 mrad', '12.3456 mm')
    """
    factor, name = readable_unit(unit)
    return f"{value * factor:{form}} {name}"


def joint_unit(unit: str) -> Unit:
    """Return the unit in which a joint's position is shown, given its SI unit; another unit, of a
    payload or a temperature, is unchanged.

    Example:
        >>> joint_unit("m"), joint_unit("kg")
        (Unit(factor=1000.0, name='mm'), Unit(factor=1.0, name='kg'))
    """
    return _OF_JOINTS.get(unit, Unit(1.0, unit))


def format_joint(value: float, unit: str) -> str:
    """Return a joint's position or its change, as a pendant shows it.

    Example:
        >>> format_joint(-0.19792, "rad"), format_joint(0.0123, "m")
        ('-11.34 deg', '12.3 mm')
    """
    factor, name = joint_unit(unit)
    return f"{value * factor:.4g} {name}"


def range_of_joint(low: float, high: float, unit: str) -> str:
    """Return a range of a joint's positions, as a pendant shows it.

    Example:
        >>> range_of_joint(-0.5, 1.25, "rad")
        '-28.65 to 71.62 deg'
    """
    factor, name = joint_unit(unit)
    return f"{low * factor:.4g} to {high * factor:.4g} {name}"


def format_small(value: float, unit: str) -> str:
    """Return a small SI value with two or three significant digits in its small unit.

    Example:
        >>> format_small(2.13e-5, "rad"), format_small(3.2e-3, "rad"), format_small(6.31e-6, "1/K")
        ('21 µrad', '3.2 mrad', '6.3 ppm/K')
    """
    factor, name = unit_of_size(value, unit)
    return f"{format_digits(value * factor)} {name}"


def format_digits(value: float) -> str:
    """Return a number with at least two significant digits, without an exponent where it is of
    ordinary size.

    Example:
        >>> [format_digits(x) for x in (21.3, 3.21, 0.0312, 12345.0, 2e-9)]
        ['21', '3.2', '0.031', '12345', '2.0e-09']
    """
    if value == 0.0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.1e}"
    return (
        f"{value:.0f}"
        if abs(value) >= 10.0
        else f"{float(f'{value:.2g}'):.{2 if abs(value) >= 0.1 else 4}g}"
    )


# Cells of tables


class Quantity(NamedTuple):
    """A number with its own SI unit, for columns whose rows have different units, and perhaps with
    the uncertainty to which it is shown.
    """

    value: float
    unit: str
    sigma: float | None = None


def show_plainly(value: Any) -> str:
    """Return a cell as text; a missing one is a dash."""
    return "-" if value is None else str(value)


def fixed(places: int) -> Callable[[Any], str]:
    """Return a function that formats a number with so many decimal places.

    Example:
        >>> fixed(2)(1.005), fixed(2)(None), fixed(2)("")
        ('1.00', '-', '')
    """
    return lambda value: (
        show_plainly(value) if value is None or isinstance(value, str) else f"{value:z.{places}f}"
    )


def show_size(places: int) -> Callable[[float], str]:
    """Return a function that formats the size of what is not zero with so many decimal places: a
    smaller one by a bound.

    Example:
        >>> show_size(4)(0.01234), show_size(4)(2e-6)
        ('0.0123', '<0.0001')
    """
    least = 10.0**-places
    return lambda size: f"{size:.{places}f}" if size >= least / 2.0 else f"<{least:.{places}f}"


INTERVAL: Scale = 1.96
"""Half of a 95 % interval, in standard deviations."""

# Decimal places beyond which a number is shown with an exponent.
_MOST_PLACES: Count = 6
# Chance below which its size means nothing more.
_LEAST_CHANCE: Scale = 1e-10


def show_limits(least: float, largest: float, show: Callable[[float], str]) -> str:
    """Return the range between two limits, of which one may be infinite.

    Example:
        >>> show_limits(1.5, 2.0, str), show_limits(-math.inf, 0.5, str)
        ('1.5 to 2.0', 'at most 0.5')
    """
    if math.isinf(least):
        return f"at most {show(largest)}"
    return f"at least {show(least)}" if math.isinf(largest) else f"{show(least)} to {show(largest)}"


def show_percent(share: float | None) -> str:
    """Return a fraction in percent."""
    return "-" if share is None else f"{100 * share:z.0f} %"


def show_chance(p_value: float) -> str:
    """Return a p-value as text, to two digits; one that is beyond doubt is given by a bound, and
    one that was not computed is no chance.

    Example:
        >>> [show_chance(p_value) for p_value in (0.27, 1.2e-5, 1e-130, 0.0, 1.0, math.nan)]
        ['0.27', '1.2e-05', '<1e-10', '<1e-10', '1', 'not known']
    """
    if math.isnan(p_value):
        return "not known"
    return f"{p_value:.2g}" if p_value >= _LEAST_CHANCE else f"<{_LEAST_CHANCE:.0e}"


def chance_words(p_value: float) -> str:
    """Return a p-value in words.

    Example:
        >>> [chance_words(p_value) for p_value in (0.27, 1.0, 1e-300, 0.0, math.nan)]
        ['p = 0.27', 'p = 1', 'p <1e-10', 'p <1e-10', 'p not known']
    """
    shown = show_chance(p_value)
    return f"p = {shown}" if shown[0].isdigit() else f"p {shown}"


def show_value(quantity: Quantity | None) -> str:
    """Return a quantity in its readable unit, without the unit.

    Example:
        >>> values = (Quantity(0.0123456, "m"), Quantity(1.5e-6, "1/K"), Quantity(0.0, "kg"))
        >>> [show_value(value) for value in values]
        ['12.3456', '1.500e-06', '0']
    """
    return _scaled(quantity, scaled="z.4f", plain=".3e")


def show_rounded(quantity: Quantity) -> str:
    """Return a quantity in its readable unit, rounded to two digits of its interval, without the
    unit.

    Example:
        >>> show_rounded(Quantity(4.0567e-4, "rad", 3.4e-5)), show_rounded(Quantity(2.0, "kg"))
        ('0.406', '2')
    """
    unit = readable_unit(quantity.unit)
    return show_measured(quantity.value, quantity.sigma, unit).partition(" ")[0]


def show_sigma(quantity: Quantity | None) -> str:
    """Return a standard deviation in its readable unit to two digits, without the unit.

    Example:
        >>> show_sigma(Quantity(1.234e-5, "rad")), show_sigma(None)
        ('0.012', '-')
    """
    return _scaled(quantity, scaled="#.2g", plain=".1e").removesuffix(".")


def _scaled(quantity: Quantity | None, *, scaled: str, plain: str) -> str:
    if quantity is None:
        return "-"
    factor, name = readable_unit(quantity.unit)
    if name == "px":
        return f"{quantity.value:z.3f}"
    if factor != 1.0:
        return f"{quantity.value * factor:{scaled}}"
    return f"{quantity.value:{plain}}" if quantity.value else "0"


def show_measured(value: float, sigma: float | None, unit: Unit) -> str:
    """Return a value with half of its 95 % interval, as everywhere behind ±, both rounded to two
    digits of the latter (JCGM 100, 7.2.6), without the unit.

    Args:
        value: of a quantity in its SI unit.
        sigma: its standard deviation; None or 0 if there is none.
        unit: the unit in which both are shown.

    Example:
        >>> show_measured(1.00030512, 3.61e-5, Unit(1e3, "mm"))
        '1000.305 ± 0.071'
        >>> show_measured(2.0, None, Unit(1.0, "kg"))
        '2'
    """
    value = value * unit.factor
    if not sigma or not math.isfinite(sigma):
        return f"{value:.6g}"
    digits = f"{INTERVAL * sigma * unit.factor:.1e}"
    places = max(0, 1 - int(digits.partition("e")[2]))
    if places > _MOST_PLACES:
        return f"{value:.3g} ± {digits}"
    return f"{value:z.{places}f} ± {float(digits):.{places}f}"


def typeset(page: str) -> str:
    """Return a page with its units as in print; terminals and files have them in plain letters.

    Example:
        >>> typeset("<td>0.02 m/s^2</td>")
        '<td>0.02 m/s²</td>'
    """
    return page.replace("m/s^2", "m/s²")


def show_unit(unit: str) -> str:
    """Return the name of the readable unit of an SI unit."""
    return readable_unit(unit).name
