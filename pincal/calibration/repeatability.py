"""Repeatability of the readings of a calibration, kept with its model.

Rows of another plan of measurement, of more readings or visits, have another noise.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from pincal.identify.stop_scatter import StopScatter
from pincal.io.arrays import ArrayShape, Numbers, Record
from pincal.io.strict_json import Fault


class Repeatability(Record, frozen=True, kw_only=True):
    """Standard deviations by moments of one component of each block of a calibration's readings,
    shape (blocks,) each.

    Attributes:
        within_stop: of a reading about the mean of its stop [m, rad, px]; where nothing was
            repeated in a stop the declared noise, 0 if none was.
        between_stops: of a stop about the mean of its pose, without that of its readings; 0 where
            no pose was revisited.
        within_degrees: degrees of freedom of the first.
        between_degrees: degrees of freedom of the second.
        readings: number of readings of a target in a stop behind each row that was fitted.
        stops: number of stops behind each row that was fitted.
        shared: factor by which noise that readings of a stop share, its arrival, increases the
            variances of the parameters.
        drives: fraction of the variance of a row that follows the levers of the drives.
        of_single: whether the noise of the model is that of a single reading in a single stop; else
            of such a row.
    """

    within_stop: Annotated[Numbers, ArrayShape("blocks")]
    between_stops: Annotated[Numbers, ArrayShape("blocks")]
    within_degrees: Annotated[Numbers, ArrayShape("blocks")]
    between_degrees: Annotated[Numbers, ArrayShape("blocks")]
    readings: float
    stops: float
    shared: float
    drives: float
    of_single: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("within_stop", "between_stops", "within_degrees", "between_degrees"):
            if np.any(getattr(self, name) < 0.0):
                raise Fault("has a negative entry", "numbers of 0 or more", key=f".{name}")
        if not 0.0 <= self.drives <= 1.0:
            raise Fault(f"is {self.drives}", "a fraction from 0 to 1", key=".drives")
        for name in ("readings", "stops", "shared"):
            if not getattr(self, name) >= 1.0:
                raise Fault(f"is {getattr(self, name)}", "a number of 1 or more", key=f".{name}")

    @classmethod
    def of(cls, found: StopScatter) -> Repeatability:
        """Return the record of the scatter of a table's readings."""
        return cls.like(
            found, within_stop=np.sqrt(found.within), between_stops=np.sqrt(found.between)
        )

    @property
    def scatter(self) -> StopScatter:
        """The same as variances."""
        return StopScatter(
            within=self.within_stop**2,
            between=self.between_stops**2,
            within_degrees=self.within_degrees,
            between_degrees=self.between_degrees,
            readings=self.readings,
            stops=self.stops,
            shared=self.shared,
            drives=self.drives,
            of_single=self.of_single,
        )
