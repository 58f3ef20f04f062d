"""Additive information of readings on a robot, from stations, days and sites that do not share
their tables.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import reduce
from operator import add
from typing import Annotated, Literal

import numpy as np

from pincal.calibration.station_information import information_at
from pincal.errors import BadInputError, ModelFileError
from pincal.identify.fit import ModelFit
from pincal.identify.quadratic import ROUNDING, Quadratic
from pincal.io.arrays import ArrayShape, Numbers, Packed, Record, packed_symmetric
from pincal.io.entries import ParameterEntry, plain, restoring
from pincal.io.strict_json import Fault, FileKind, built, read_json, write_json
from pincal.model.catalogue.remainder import SmoothRemainder
from pincal.parameters import Estimate, Parameter, estimate_of
from pincal.robot.robot import Robot
from pincal.thresholds import Count, Scale

# Digits to which link frames [m or 1] of the same robot agree.
_DIGITS: Count = 9
# Asymmetry of a matrix, relative to its largest entry, that rounding explains.
_ROUNDING: Scale = 1e-9
_FILE = FileKind(
    "an information file",
    ModelFileError,
    whole="a file written by save() of pincal's RobotInformation",
)


class RobotInformation(Record, frozen=True, kw_only=True):
    """Information of readings on the parameters of one robot, a quadratic about its nominal without
    any prior, and its file.

    In units of the noise it is square - 2 g x + x H x over deviations x of the robot's parameters,
    an information form (Bierman 1977), see :mod:`pincal.identify.quadratic`. ``a + b`` is the
    information of the rows of both: that of a joint fit, linearised where each was fitted. Base,
    targets and instrument of each station are eliminated, and with its prior what is smooth in the
    joints and has no name, whose functions are those of one table.

    Attributes:
        format: what the file is.
        format_version: 1.
        robot: name of the arm.
        geometry: checksum of its nominal geometry (CRC-32 of its link frames, rounded to 1e-9).
        parameters: the F parameters of the robot that were fitted, each with its prior.
        H: shape (F, F), their information.
        g: shape (F,), half of the negative gradient of the sum of squares.
        whole: shape (F,), the diagonal of H before base, targets and instrument were eliminated.
        square: the sum of squares at the nominal.
        degrees: number of readings minus number of eliminated parameters.
        priors: shape (F,), standard deviations of the priors that they had [their own units]: of a
            compliance by the moments of these poses; not in files of earlier versions.
    """

    format: Literal["pincal-information"]
    format_version: Literal[1]
    robot: str
    geometry: int
    parameters: Annotated[tuple[ParameterEntry, ...], ArrayShape("parameters")]
    H: Annotated[Packed, ArrayShape("parameters", "parameters", write=packed_symmetric)]
    g: Annotated[Numbers, ArrayShape("parameters")]
    whole: Annotated[Numbers, ArrayShape("parameters")]
    square: float
    degrees: float
    priors: Annotated[Numbers | None, ArrayShape("parameters")] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [parameter.name for parameter in self.parameters]
        if len(set(names)) < len(names):
            raise Fault("has a parameter twice", "each once", key=".parameters")
        if self.H.size and np.abs(self.H - self.H.T).max() > _ROUNDING * np.abs(self.H).max():
            raise Fault("is not symmetric", "an information matrix", key=".H")
        if np.any(self.whole < 0.0) or np.any(np.diag(self.H) < -_ROUNDING * self.whole):
            raise Fault("has a negative entry on its diagonal", "an information matrix", key=".H")
        if self.priors is not None and np.any(self.priors <= 0.0):
            raise Fault(
                "holds a standard deviation that is not positive",
                "standard deviations above 0",
                key=".priors",
            )

    @classmethod
    def of(cls, fit: ModelFit) -> RobotInformation:
        """Return the information of the rows of all stations of a fit on the robot."""
        problem = fit.problem
        robot = fit.problem.chain.robot
        form = reduce(add, (information_at(fit, k).form for k in range(len(problem.stations))))
        known = {
            p.name: (p, value) for p, value in zip(problem.parameters, fit.values, strict=True)
        }
        nominal = form.at(-np.array([known[name][1] for name in form.names]))
        sizes = np.array([p.size for p in problem.parameters]) / problem.largest_basis[0]
        priors = {
            p.name: (p, float(size)) for p, size in zip(problem.parameters, sizes, strict=True)
        }
        return cls.of_form(_of_causes(nominal, priors), robot.name, geometry_of(robot), priors)

    @classmethod
    def of_form(
        cls,
        form: Quadratic,
        robot: str,
        geometry: int,
        known: Mapping[str, tuple[Parameter, float]],
    ) -> RobotInformation:
        """Return information given as a form about the nominal, with its parameters and their
        priors by name.
        """
        # Sums and projections are symmetric, and positive semidefinite, only up to rounding, which
        # may dominate what is left of frames that nearly parallel axes hardly distinguish.
        H = 0.5 * (form.H + form.H.T)
        scale = np.sqrt(np.maximum(form.whole, 1e-300))[:, None]
        if np.any(np.diag(H) < 0.0):
            values, axes = np.linalg.eigh(H / (scale * scale.T))
            root = scale * axes * np.sqrt(np.maximum(values, 0.0))
            H = root @ root.T
        return cls.like(
            replace(form, H=H),
            format="pincal-information",
            format_version=1,
            robot=robot,
            geometry=geometry,
            parameters=tuple(ParameterEntry.of_parameter(known[name][0]) for name in form.names),
            priors=np.array([known[name][1] for name in form.names]),
        )

    @property
    def known(self) -> dict[str, tuple[Parameter, float]]:
        """Its parameters by name, each with the standard deviation of its prior."""
        own = [entry.parameter() for entry in self.parameters]
        sizes = [p.size for p in own] if self.priors is None else self.priors
        return {p.name: (p, float(size)) for p, size in zip(own, sizes, strict=True)}

    @property
    def form(self) -> Quadratic:
        """The quadratic by the names of its parameters."""
        names = tuple(parameter.name for parameter in self.parameters)
        return Quadratic(
            self.H, self.g, self.whole, names=names, square=self.square, degrees=self.degrees
        )

    def __add__(self, other: RobotInformation) -> RobotInformation:
        """Return the information of the rows of both.

        Raises:
            BadInputError: if they are of different robots.
        """
        if self.geometry != other.geometry:
            raise BadInputError(
                f"information on {self.robot!r} and on {other.robot!r} can't be added: their "
                "nominal geometries differ; calibrate both with the same URDF, base and tip"
            )
        return self.of_form(
            self.form + other.form, self.robot, self.geometry, {**other.known, **self.known}
        )

    def estimate(self) -> Estimate:
        """Return the posterior mode of the parameters and their covariance, the priors of the model
        counted once.
        """
        parameters = [p for p, _ in self.known.values()]
        form = self.form + Quadratic.of_prior(
            self.form.names, np.array([p.size for p in parameters])
        )
        values, covariance = form.estimate(np.arange(len(form.names)), ROUNDING)
        return estimate_of(parameters, values, covariance)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it to a file, see :func:`load_information`.

        Raises:
            OutputError: if the place can't be written to, or a number is not finite.
        """
        write_json(path, plain(self), indent=None)

    def text(self) -> str:
        """Return its JSON, as :func:`information_of` takes it."""
        return json.dumps(plain(self), allow_nan=False)


def _of_causes(form: Quadratic, priors: Mapping[str, tuple[Parameter, float]]) -> Quadratic:
    """Return information without the amplitudes of what is smooth and has no name."""
    known = [priors[name] for name in form.names]
    smooth = np.array([p.effect == SmoothRemainder.name for p, _ in known], bool)
    if not smooth.any():
        return form
    at = np.flatnonzero(smooth)
    names = [form.names[i] for i in at]
    sizes = np.array([size for _, size in known])[at]
    return (form + Quadratic.of_prior(names, sizes)).released(at).held(at)


def geometry_of(robot: Robot) -> int:
    """Return the checksum of a robot's nominal geometry, the same for the same joints and link
    frames.
    """
    frames = (
        np.round(np.concatenate([robot.frames.T_base_link, robot.frames.T_last_tip[None]]), _DIGITS)
        + 0.0
    )
    return zlib.crc32(" ".join(robot.joint_names).encode() + frames.tobytes())


def information_of(text: str, source: str) -> RobotInformation:
    """Return the information from a JSON text.

    Raises:
        ModelFileError: if a value is missing or invalid, naming ``source``.
    """
    return built(text.encode(), RobotInformation, _FILE, file=source, hook=restoring())


def load_information(
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
) -> RobotInformation:
    """Return the information on a robot from a file, or the sum of several.

    Raises:
        ModelFileError: if a file can't be read, or a value is missing or invalid.
        BadInputError: without any file, or if they are of different robots.
    """
    paths = [paths] if isinstance(paths, str | os.PathLike) else paths
    found = [read_json(path, RobotInformation, _FILE, hook=restoring()) for path in paths]
    if not found:
        raise BadInputError("no information files; expected one or more")
    return reduce(add, found)
