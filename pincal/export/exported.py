"""What an export is, and the formats that there are: one class a format, known by its name."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from pincal.atomic import write_atomic
from pincal.calibration.calibrated import Calibrated, CalibratedModel
from pincal.errors import BadInputError, OutputError, nearest_first
from pincal.plugins import Registry


@dataclass(frozen=True)
class Exported:
    """A calibrated robot in some format.

    Attributes:
        files: contents by name in the folder that is written; of a format with a single file the name is empty.
        notes: what the format can't carry, in words.
        max_error_m: largest distance between target or tip by what was written, read back (of C by its formulas), and by
            what the format can carry of the model [m]; None where there is nothing to compare.
    """

    files: dict[str, bytes]
    notes: tuple[str, ...] = ()
    max_error_m: float | None = None

    @property
    def text(self) -> str:
        """The contents, of several files one after the other."""
        return "\n".join(content.decode() for content in self.files.values())

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the file, or the files into a folder.

        Raises:
            OutputError: if the place can't be written to.
        """
        for name, content in self.files.items():
            if name:
                try:
                    Path(path).mkdir(parents=True, exist_ok=True)
                except OSError as error:
                    raise OutputError(f"{path}: no folder ({error.strerror}); choose another one") from None
            write_atomic(Path(path, name) if name else path, content, advice="choose another place")


class Format(ABC):
    """A format that a calibrated robot can be written in.

    Attributes:
        name: its name.
        meaning: what it is for, in words.
        of_robot: whether it is of the robot alone, wherever instrument and targets stand.
    """

    name: ClassVar[str]
    meaning: ClassVar[str]
    of_robot: ClassVar[bool] = False

    @abstractmethod
    def export(self, calibrated: CalibratedModel) -> Exported:
        """Return a calibrated robot in this format, checked against the model.

        Raises:
            BadInputError: if the format can't carry this robot or one of its effects.
        """


FORMATS: Registry[Format] = Registry("export format", group="pincal.formats", name_of=lambda cls: cls.name)


def export_model(
    calibrated: Calibrated, format: str, path: str | os.PathLike[str] | None = None, **options: str
) -> Exported:
    """Return a calibrated robot in another format, and write it if a place is named.

    Args:
        calibrated: what a calibration found.
        format: name of the format, one of ``FORMATS``: "c", "python", "urdf" and so on.
        path: the file to write, for "c" the folder.
        options: those of the format, such as ``frame="base"`` for "c" and "python".

    Raises:
        BadInputError: for a name or option that is invalid, or if the format can't carry this robot.
        OutputError: if the place can't be written to.
    """
    known = FORMATS.known()
    if format not in known:
        raise BadInputError(f"format {format!r}: unknown; expected one of {', '.join(nearest_first([format], known))}")
    try:
        chosen = known[format](**options)
    except TypeError as error:
        raise BadInputError(f"format {format!r}: {error}") from None
    exported = chosen.export(calibrated.robot_model() if chosen.of_robot else calibrated.to_model())
    robot = calibrated.robot_model().model.chain.robot if chosen.of_robot else None
    if robot is not None and robot.couplings:
        coupled = ", ".join(dict.fromkeys(one.joint for one in robot.couplings))
        exported = replace(
            exported, notes=(*exported.notes, f"{coupled}: as in the URDF, not as reported by the controller")
        )
    if path is not None:
        exported.write(path)
    return exported
