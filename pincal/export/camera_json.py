"""The camera that was calibrated with the robot, as a calibration reads it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import ClassVar

from pincal.calibration.calibrated import CalibratedModel
from pincal.export.exported import FORMATS, Exported, Format


@FORMATS.register
@dataclass(frozen=True)
class CameraJson(Format):
    """Parameters and mount of the camera as JSON."""

    name: ClassVar[str] = "camera"
    meaning: ClassVar[str] = "the camera, parameters and mount"

    def export(self, calibrated: CalibratedModel) -> Exported:
        """Return the file."""
        return Exported({"": (json.dumps(calibrated.camera(), indent=1) + "\n").encode()})
