"""Numbers in the units that people measure such things in."""

from __future__ import annotations

# SI unit -> factor and unit of small errors of robots.
_SMALL = {
    "rad": (1e6, "µrad"),
    "m": (1e6, "µm"),
    "1": (1e6, "ppm"),
    "1/K": (1e6, "ppm/K"),
    "rad/K": (1e6, "µrad/K"),
    "m/K": (1e6, "µm/K"),
    "m/s": (3.6e9, "µm/h"),
    "rad/s": (3.6e9, "µrad/h"),
    "rad/m": (1e3, "µrad/mm"),
    "m/rad": (1e3, "µm/mrad"),
}


def small_unit(unit: str) -> tuple[float, str]:
    """Return the factor and the name of the unit in which small errors are told; an unknown unit stays as it is.

    Example:
        >>> small_unit("rad/K")
        (1000000.0, 'µrad/K')
    """
    return _SMALL.get(unit, (1.0, unit))


def told(value: float, unit: str) -> str:
    """Return a small number with two or three digits and its unit.

    Example:
        >>> told(2.13e-5, "rad"), told(3.2e-3, "rad"), told(6.31e-6, "1/K")
        ('21 µrad', '3.2 mrad', '6.3 ppm/K')
    """
    factor, name = small_unit(unit)
    scaled = value * factor
    if abs(scaled) >= 1000.0 and name in ("µrad", "µm"):
        scaled, name = scaled / 1000.0, name.replace("µ", "m")
    return f"{digits(scaled)} {name}"


def digits(value: float) -> str:
    """Return a number with at least two significant digits and no exponent where it is of ordinary size.

    Example:
        >>> digits(21.3), digits(3.21), digits(0.0312), digits(12345.0), digits(2e-9)
        ('21', '3.2', '0.031', '12345', '2.0e-09')
    """
    if value == 0.0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.1e}"
    return f"{value:.0f}" if abs(value) >= 10.0 else f"{float(f'{value:.2g}'):.{2 if abs(value) >= 0.1 else 4}g}"
