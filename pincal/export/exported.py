"""Exports, the registry of formats (one class per format, by name), and what source code in all
languages shares.
"""

from __future__ import annotations

import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import ClassVar

import numpy as np

from pincal.atomic import write_atomic
from pincal.calibration.fitted_robot import FittedRobot
from pincal.compensate.compensate_numbers import COMPENSATION
from pincal.compensate.robot_frames import in_base_frame
from pincal.errors import BadInputError, OutputError, counted, nearest_first
from pincal.export.formulas import Formulas, sides_following
from pincal.model.conditions import Conditions
from pincal.plugins import Registry
from pincal.satellites import Place
from pincal.thresholds import Count, Scale


@dataclass(frozen=True, repr=False)
class Exported:
    """A calibrated robot in some format.

    Attributes:
        files: contents by name in the output folder; the name of a single file is empty.
        notes: what the format can't represent.
        max_error_m: largest distance between target or tip by the written file, read back (for C,
            by its formulas), and by what the format can represent of the model [m]; None if there
            is nothing to compare.
    """

    files: dict[str, bytes]
    notes: tuple[str, ...] = ()
    max_error_m: float | None = None

    def __repr__(self) -> str:
        size = sum(len(content) for content in self.files.values())
        names = " ".join(name for name in self.files if name) or "no name"
        return f"Exported({names}: {counted(len(self.files), 'file')}, {size} bytes)"

    @property
    def text(self) -> str:
        """The contents, concatenated if there are several files."""
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
                    raise OutputError(
                        f"{path}: no folder ({error.strerror}); choose another one"
                    ) from None
            write_atomic(Path(path, name) if name else path, content, advice="choose another place")


class Format(ABC):
    """A format for calibrated robots.

    Attributes:
        name: its name.
        meaning: its purpose.
        of_robot: whether it describes the robot alone, regardless of instrument and targets.
    """

    name: ClassVar[str]
    meaning: ClassVar[str]
    of_robot: ClassVar[bool] = False

    @abstractmethod
    def export(self, calibrated: FittedRobot) -> Exported:
        """Return a calibrated robot in this format, checked against the model.

        Raises:
            BadInputError: if the format can't represent this robot or one of its effects.
        """


FORMATS: Registry[Format] = Registry(
    "export format",
    group="pincal.formats",
    name_of=lambda cls: cls.name,
    handed_in=Place[type[Format]]("formats").all,
)


def export_model(
    calibrated: FittedRobot, format: str, path: str | os.PathLike[str] | None = None, **options: str
) -> Exported:
    """Return a calibrated robot in another format, and write it if a path is given.

    Args:
        calibrated: the result of a calibration.
        format: name of the format, one of ``FORMATS``: "c", "python", "urdf" and so on.
        path: the file to write, for "c" the folder.
        options: of the format, such as ``frame="base"`` for "c" and "python".

    Raises:
        BadInputError: for an invalid name or option, or if the format can't represent this robot.
        OutputError: if the place can't be written to.
    """
    known = FORMATS.known()
    if format not in known:
        raise BadInputError(
            f"format {format!r}: unknown; expected one of "
            f"{', '.join(nearest_first([format], known))}"
        )
    try:
        chosen = known[format](**options)
    except TypeError as error:
        raise BadInputError(f"format {format!r}: {error}") from None
    exported = chosen.export(calibrated.robot_model() if chosen.of_robot else calibrated.at())
    if chosen.of_robot and (couplings := calibrated.robot_model().model.chain.robot.couplings):
        coupled = ", ".join(dict.fromkeys(one.joint for one in couplings))
        note = f"{coupled}: as in the URDF, not as reported by the controller"
        exported = replace(exported, notes=(*exported.notes, note))
    if path is not None:
        exported.write(path)
    return exported


# Weight of a rotation against a translation in compensation, over the robot's reach; see
# pincal.compensate.ik_problem.
_LEVER: Scale = 1.0 / 3.0
_CHECKED_POSES: Count = 200
_PAYLOAD: Scale = 20.0
_WARM: tuple[Scale, Scale] = (5.0, 45.0)
_LONG: Scale = 1e5

NOTES = (
    "standard deviations of parameters and the parameters of the sensor itself are in "
    "model.json only",
    "the model is not validated outside the measured range: pincal predict and compensate "
    "report such poses",
)


def placed_in(calibrated: FittedRobot, frame: str) -> FittedRobot:
    """Return a calibrated model that predicts poses of targets, not readings of them, in a frame:
    "instrument" or "base".

    Raises:
        BadInputError: for another name.
    """
    if frame not in ("instrument", "base"):
        raise BadInputError(f"frame {frame!r}; expected instrument or base")
    if frame == "base":
        return in_base_frame(calibrated)
    has_reading_errors = any(effect.is_sighted for effect in calibrated.model.effects)
    return (
        calibrated.with_effects(lambda effect: not effect.is_sighted)
        if has_reading_errors
        else calibrated
    )


def export_notes(calibrated: FittedRobot, formulas: Formulas) -> tuple[str, ...]:
    """Return what source code can't represent of a calibrated model."""
    read = ", ".join(effect.name for effect in calibrated.model.effects if effect.is_sighted)
    notes = [*NOTES]
    if read:
        notes.append(f"{read}: an error of the instrument; it is in model.json only")
    if formulas.spread.is_known and not formulas.motions:
        notes.append("the uncertainty of predictions is by pincal predict only")
    return tuple(notes)


def filled(
    template: str,
    formulas: Formulas,
    *,
    frame: str,
    numbers: Callable[[np.ndarray], str],
    **words: str,
) -> str:
    """Return the text of a template filled with the words that all languages share, and others;
    ``numbers`` writes a list of numbers.
    """
    robot = formulas.calibrated.model.chain.robot
    # Reported positions of coupled joints have no limits of their own.
    coupled = (robot.combination != np.eye(robot.n_joints)).any(axis=1)
    common = {
        "n": str(len(formulas.joints)),
        "length": repr(max(_LEVER * robot.reach, 1e-3)),
        "orthonormal": repr(COMPENSATION.orthonormal),
        "lower": numbers(np.where(coupled, -np.inf, robot.lower)[formulas.joints]),
        "upper": numbers(np.where(coupled, np.inf, robot.upper)[formulas.joints]),
        "frame": frame,
        "payload_centre": "({:g}, {:g}, {:g})".format(*formulas.calibrated.payload_centre),
    }
    return Template(template).substitute(common | words)


def template_of(name: str) -> str:
    """Return the text of a template of this folder."""
    return files("pincal.export").joinpath("templates", name).read_text(encoding="utf-8")


def header(formulas: Formulas, *, frame: str) -> list[str]:
    """Return lines on what the export contains, and what not."""
    found = formulas.calibrated
    effects = ", ".join(dict.fromkeys(effect.name for effect in found.model.effects)) or "none"
    return [
        f"{as_comment(found.model.chain.robot.name)}: the calibrated robot, written by "
        f"pincal {version('pincal')}.",
        *(f"{line}." for line in machine_lines(found)),
        "",
        f"Poses of the target in the {frame} frame, with every effect of the model:",
        f"{effects}.",
        "",
        *_worth_lines(found),
        "Not included:",
        *(f"- {note}" for note in NOTES),
    ]


def worth_of(calibrated: FittedRobot) -> list[str]:
    """Return how good a model states its predictions to be, and its doubt, in sentences; none where
    it does not.
    """
    statement = calibrated.statement
    if statement is None:
        return []
    worth = statement.worth_at("the poses of its calibration")
    return [said for said in (worth, *statement.notes()) if said]


def _worth_lines(calibrated: FittedRobot) -> list[str]:
    """Return the lines of a header on how good a model is."""
    said = [f"- {as_comment(words)}" for words in worth_of(calibrated)]
    return ["What the calibration states of it:", *said, ""] if said else []


def machine_lines(calibrated: FittedRobot) -> tuple[str, ...]:
    """Return a line for a comment on which robot it is, if that was stated: the numbers of
    another one of the same type look the same.
    """
    machine = calibrated.identity.machine
    return (as_comment(f"for {machine}"),) if machine else ()


def identifier(name: str) -> str:
    """Return a name as an identifier of a programming language."""
    found = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_").lower()
    return found if found and not found[0].isdigit() else f"robot_{found}".rstrip("_")


def as_comment(text: str) -> str:
    """Return a text that is safe in a comment of any language, and is no formula in a table.

    Example:
        >>> as_comment("good to U (k = 2) of */ 0.1 mm"), as_comment("=1+1")
        ('good to U (k = 2) of _/ 0.1 mm', '_1_1')
    """
    plain = re.sub(r"^=|[^\w .:;()'/,=%-]", "_", text, flags=re.ASCII)
    return plain.replace("*/", "_").replace("/*", "_")


def checked_poses(calibrated: FittedRobot, *, n: int = _CHECKED_POSES, seed: int = 0) -> Conditions:
    """Return n poses at which an export is compared with the model: over the joint ranges, with all
    conditions recorded.
    """
    robot = calibrated.model.chain.robot
    rng = np.random.default_rng(seed)
    found = Conditions.at(
        robot.random_configurations(n, rng), payload_centre=calibrated.payload_centre
    )
    return replace(
        found,
        target=rng.integers(0, len(calibrated.model.chain.targets), n),
        payload=rng.uniform(0.0, _PAYLOAD, n),
        temperature=rng.uniform(*_WARM, n),
        time=rng.uniform(0.0, _LONG, n),
        approach=sides_following(robot, rng.integers(-1, 2, found.q.shape)),
    )
