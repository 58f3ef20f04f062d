"""Options of ``pincal simulate`` for readings of a part."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from pincal.cli.arguments import option
from pincal.cli.quantities import LENGTH_UNITS, QuantityType
from pincal.errors import BadInputError
from pincal.thresholds import Count, Scale

if TYPE_CHECKING:
    from pincal.features.part_feature import PartFeature
    from pincal.simulate.camera import CalibrationObject
    from pincal.simulate.request import SetupOptions
    from pincal.simulate.true_part import TrueFeature

# Poses from which each feature is seen, and distance of the sensor from it at the least [m].
VIEWS: Count = 3
_DISTANCE: Scale = 0.3
# Standard deviation of a true coordinate from the nominal one [m].
_DEVIATION: Scale = 1e-4
_SENSORS = ("camera_point", "camera_pixel")
_ROUND = ("circle", "sphere", "cylinder")


@dataclass(frozen=True, kw_only=True)
class PartArguments:
    """The part that is measured."""

    features: Path | None = option(
        "Readings of the features of this part, for pincal measure: --poses is the number of poses "
        "from which each is seen (default: 3), --cycles that of passes.",
        metavar="PART.toml",
    )
    part_deviation: float | None = option(
        "Standard deviation of true positions from the nominal ones; half of it of radii.",
        metavar="LENGTH",
        type=QuantityType(LENGTH_UNITS, "0.1mm", zero=True),
        words="0.1mm",
    )

    def check(self, kind: str, given: dict[str, object]) -> None:
        """Refuse options that do not go together.

        Args:
            kind: of the sensor.
            given: options that a part takes the place of, with their values.

        Raises:
            UsageError: for such an option, or another sensor.
        """
        if self.features is None:
            if self.part_deviation is not None:
                raise click.UsageError("--part-deviation is of a part; add --features PART.toml")
            return
        if kind not in _SENSORS:
            raise click.UsageError(
                f"--features is for --sensor {' or '.join(_SENSORS)}, not for {kind}"
            )
        for name, value in given.items():
            if value is not None:
                raise click.UsageError(f"{name} has nothing to do with --features; leave it out")

    def drawn(self, rng: np.random.Generator) -> tuple[TrueFeature, ...]:
        """Return the true features, in the part's frame.

        Raises:
            BadInputError: for a part that can't be read, or a feature without the nominal values
                that its points need.
        """
        from pincal.features.part import Part

        assert self.features is not None
        deviation = _DEVIATION if self.part_deviation is None else self.part_deviation
        part = Part.from_toml(self.features)
        measured = [feature for feature in part.features.values() if not feature.is_derived]
        if not measured:
            raise BadInputError(f"{self.features}: no feature that is measured; expected one")
        return tuple(_nominal(feature, self.features).drawn(rng, deviation) for feature in measured)


def _nominal(feature: PartFeature, path: Path) -> TrueFeature:
    """Return a feature as it should be."""
    from pincal.simulate.true_part import TrueFeature

    if feature.position is None:
        raise BadInputError(
            f"{path}, [feature.{feature.name}]: no nominal position; expected nominal_mm = "
            "[x, y, z], as readings of it are simulated there"
        )
    diameter = feature.nominal.get("diameter")
    if feature.kind in _ROUND and not diameter:
        raise BadInputError(
            f"{path}, [feature.{feature.name}]: no nominal diameter; expected diameter_mm = ..., "
            "as readings of it are simulated"
        )
    default = np.eye(3)[0 if feature.kind == "line" else 2]
    return TrueFeature(
        name=feature.name,
        kind=feature.kind,
        position=feature.position,
        direction=default if feature.direction is None else feature.direction,
        radius=(diameter or 0.0) / 2.0,
    )


def looking_at(options: SetupOptions, target: CalibrationObject) -> SetupOptions:
    """Return the options of a set-up whose camera looks at a part."""
    return replace(options, target=target, least_distance=_DISTANCE)


def truth_of(features: tuple[TrueFeature, ...], found: dict[str, Any]) -> dict[str, Any]:
    """Return the true part, for JSON, nothing without features; ``found`` is what is known of the
    set-up.
    """
    if not features:
        return {}
    return {
        "part": {
            "T_base_part": found["T_base_object"],
            "features": {feature.name: feature.truth() for feature in features},
        }
    }
