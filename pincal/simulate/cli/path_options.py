"""A path that ``pincal simulate`` drives, and the loggers of it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pincal.cli.arguments import NumberType, option
from pincal.cli.quantities import ANGLES, DURATION, QuantityType
from pincal.measure.table_schema import TABLE_ENDINGS
from pincal.thresholds import Scale
from pincal.units import UNITS, plain_numbers, size_of

if TYPE_CHECKING:
    from pincal.simulate.session import SessionOptions


# Samples per second of a fast logger.
_MOST_RATE: Scale = 10_000.0


def _densities(text: str) -> tuple[float, float]:
    """Return noise densities of accelerometer and gyroscope, such as ``1mg,0.01deg/s``, in SI units
    per root hertz.
    """
    found = list[float]()
    words = text.split(",")
    for word, quantity, example in zip(
        words, ("acceleration", "angular rate"), ("1mg", "0.01deg/s"), strict=False
    ):
        units = {unit: size_of(unit, quantity) for unit in UNITS[quantity]}
        found.append(QuantityType(units, example, zero=True)(word))
    if len(words) != 2:
        raise click.BadParameter(
            f"{text!r}; expected the densities of accelerometer and gyroscope, such as "
            "1mg,0.01deg/s"
        )
    return found[0], found[1]


def _rates(text: str) -> tuple[float, ...]:
    """Return sampling rates of joints, IMU and tracker [Hz], such as ``150,100,250``."""
    rates = plain_numbers(text.split(","))
    if len(rates) != 3 or not all(1.0 <= rate <= _MOST_RATE for rate in rates):
        raise click.BadParameter(
            f"{text!r}; expected rates of joints, IMU and tracker [Hz], such as 150,100,250"
        )
    return tuple(rates)


def _path(text: str) -> float | Path:
    """Return the duration of a random path [s], or the table of the poses along a path."""
    is_file = Path(text).suffix.lower() in TABLE_ENDINGS or Path(text).is_file()
    return Path(text) if is_file else float(DURATION(text))


@dataclass(frozen=True, kw_only=True)
class MotionArguments:
    """A path and its loggers."""

    path: float | Path | None = option(
        "Drive a random path of this duration, or through the poses of a table at the "
        "times in its column time, instead of "
        "holding poses; --out is then a folder of joints.csv, imu.csv and tracker.csv, "
        "each with its own clock.",
        metavar="DURATION|FILE",
        type=_path,
    )
    imu: bool = option("Log an IMU on the tool, and a tracker as well if --sensor is given.", False)
    imu_noise: tuple[float, float] | None = option(
        "Noise densities of accelerometer and gyroscope, per square root of hertz.",
        metavar="ACC,GYRO",
        type=_densities,
        words="1mg,0.01deg/s",
    )
    vibration: float | None = option(
        "Vibration of the arm at full speed [m/s^2 rms].",
        metavar="SIZE",
        type=NumberType(0.0, 100.0),
        words="0.1",
    )
    resolution: float | None = option(
        "Resolution of the recorded joint positions.",
        metavar="ANGLE",
        type=QuantityType(ANGLES, "0.001deg", zero=True),
        words="0.001deg",
    )
    log_rates: tuple[float, float, float] | None = option(
        "Sampling rates of joints, IMU and tracker.",
        metavar="HZ,HZ,HZ",
        type=_rates,
        words="150,100,250, cameras 30",
    )
    clock_drift: float | None = option(
        "Drift of the clocks of IMU and tracker.",
        metavar="PPM",
        type=NumberType(-1e5, 1e5),
        words="random within 100",
    )
    dropped: float | None = option(
        "Percentage of rows lost by the loggers.",
        metavar="PERCENT",
        type=NumberType(0.0, 20.0),
        words="0.5",
    )

    def first_given(self) -> str | None:
        """Return the first of these options that is given."""
        return next(
            (
                field.name
                for field in fields(self)
                if getattr(self, field.name) not in (None, False)
            ),
            None,
        )

    def session_options(self, duration: float) -> SessionOptions:
        """Return the options of the logs of a path of this duration [s]."""
        from pincal.simulate.session import SessionOptions

        drift = None if self.clock_drift is None else 1e-6 * self.clock_drift
        dropped = None if self.dropped is None else 1e-2 * self.dropped
        own: dict[str, Any] = {
            "duration": duration,
            "imu": self.imu,
            "imu_noise": self.imu_noise,
            "drift": drift,
        }
        own |= {
            "vibration": self.vibration,
            "resolution": self.resolution,
            "rates": self.log_rates,
            "dropped": dropped,
        }
        return SessionOptions(**{name: value for name, value in own.items() if value is not None})
