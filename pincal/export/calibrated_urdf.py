"""The calibrated robot as its own URDF with corrected joint origins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from pincal.calibration.calibrated import CalibratedModel
from pincal.errors import BadInputError
from pincal.export.exported import FORMATS, Exported, Format
from pincal.io.urdf_export import calibrated_urdf


@FORMATS.register
@dataclass(frozen=True)
class CalibratedUrdf(Format):
    """The original URDF with corrected joint origins, verified with Pinocchio."""

    name: ClassVar[str] = "urdf"
    meaning: ClassVar[str] = "the calibrated URDF"
    of_robot: ClassVar[bool] = True

    def export(self, calibrated: CalibratedModel) -> Exported:
        """Return the file."""
        if not calibrated.model.chain.robot.urdf:
            raise BadInputError("the model holds no URDF to correct; calibrate again from a URDF file")
        found = calibrated_urdf(calibrated.model, calibrated.values)
        return Exported({"": found.text}, found.notes, found.max_error_m)
