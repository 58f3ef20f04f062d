"""What a calibrated model states of itself, kept with it: its verdict, what this rests on, and how
good its predictions are.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from pincal.io.arrays import Record
from pincal.io.strict_json import Fault
from pincal.thresholds import Scale
from pincal.validate.misfit import Verdict

RestsOn = Literal["declared noise", "repeated poses", "residuals"]
# Coverage factor of expanded uncertainties (JCGM 100, 6.3.3).
COVERAGE_FACTOR: Scale = 2.0


class ModelStatement(Record, frozen=True, kw_only=True):
    """What a calibrated model states of itself.

    Attributes:
        verdict: whether its residuals are explained by the noise.
        doubts: what kept the calibration from being adequate, in words.
        rests_on: by what its errors were told from noise: noise that was declared, poses that were
            repeated, or nothing but the residuals.
        here: standard uncertainty of a coordinate of predicted positions, root mean square over the
            poses of the calibration [m]; none where no instrument observed positions, or where its
            readings leave open where the base stands, as distances do.
        anywhere: the same over random poses within the joint limits.
    """

    verdict: Verdict
    doubts: tuple[str, ...] = ()
    rests_on: RestsOn = "residuals"
    here: float | None = None
    anywhere: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("here", "anywhere"):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value < float("inf"):
                raise Fault(f"is {value}", "a number of 0 or more", key=f".{name}")

    @property
    def worth(self) -> str:
        """How good predictions are beside the rows of the calibration, see :meth:`worth_at`."""
        return self.worth_at("these poses")

    def worth_at(self, poses: str) -> str:
        """Return how good predictions are, in words; "" where it is not known.

        Args:
            poses: what those of the calibration are called.

        Example:
            >>> found = ModelStatement(verdict=Verdict.ADEQUATE, here=2e-5, anywhere=5e-5)
            >>> found.worth_at("these poses")
            'good to U (k = 2) 0.0400 mm a coordinate at these poses, 0.1000 mm anywhere'
        """
        if self.here is None or self.anywhere is None:
            return ""
        here = 1e3 * COVERAGE_FACTOR * self.here
        anywhere = 1e3 * COVERAGE_FACTOR * self.anywhere
        return (
            f"good to U (k = {COVERAGE_FACTOR:.0f}) {here:.4f} mm a coordinate at {poses}, "
            f"{anywhere:.4f} mm anywhere"
        )

    def notes(self) -> Iterator[str]:
        """Yield what users of predictions have to know: a doubt, once, and on what uncertainties
        rest if neither noise was declared nor poses were repeated.
        """
        if self.doubts:
            others = len(self.doubts) - 1
            more = f" (and {others} more, see its report)" if others else ""
            yield f"the calibration of this model left a doubt: {self.doubts[0]}{more}"
        elif self.verdict is Verdict.NOT_ADEQUATE:
            yield (
                "this model is not adequate: its residuals exceed the noise, and uncertainties "
                "include what it lacks"
            )
        if self.rests_on == "residuals":
            yield (
                "no noise was declared and no pose repeated: uncertainties rest on the residuals "
                "of the calibration alone"
            )
