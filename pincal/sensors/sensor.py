"""Sensors: models of readings as functions of a pose, with derivatives.

A sensor predicts readings from the target's pose in the instrument's frame, independently of
robots. :class:`Sensor` is its only interface, so that a sensor is defined in one file. Properties
of only some sensors are mix-in classes:
:class:`OwnParameters`, :class:`KnownParameters`, :class:`Grouped`, :class:`Divided`,
  :class:`Simulatable`,
:class:`Plausible`.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, final

import numpy as np

from pincal.parameters import Parameter
from pincal.sensors.extrinsics import Extrinsics
from pincal.sensors.fields import Field, TableRows
from pincal.sensors.setup import Setup


@dataclass(frozen=True)
class Block:
    """Components of a reading that share a unit and a standard deviation.

    Attributes:
        name: "position", "orientation", "distance", ...
        unit: "m", "rad" or "px"; of an IMU "m/s^2" and "rad/s".
        size: number of components.
        rounding: rounding error of a prediction, the least noise.
        noise: standard deviation of one component for good instruments, used where it is neither
            declared nor can be estimated.
        axes: one letter per component; x, y, z or numbers by default.
    """

    name: str
    unit: str
    size: int
    rounding: float = 1e-12
    noise: float = 5e-5
    axes: str = ""

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the components, e.g. ``("position_x", "position_y", "position_z")``."""
        if self.size == 1:
            return (self.name,)
        axes = self.axes or ("xyz" if self.size == 3 else [str(i + 1) for i in range(self.size)])
        return tuple(f"{self.name}_{axis}" for axis in axes)


@dataclass(frozen=True)
class Constraints:
    """C constraints on a sensor's own parameters, in the form of readings.

    Attributes:
        residuals: shape (C,), known minus predicted value.
        jacobian: shape (own, C), derivative of the prediction.
        sigma: shape (C,), standard deviations.
    """

    residuals: np.ndarray
    jacobian: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True)
class Excluded:
    """Rows without information.

    Attributes:
        rows: shape (N,).
        reason: completes the sentence "3 rows ... and are left out".
        expected: the rows that a table without any others would need.
    """

    rows: np.ndarray
    reason: str
    expected: str


class Sensor(ABC):
    """Readings of N poses.

    A class defines, in addition to the abstract methods:

    Attributes:
        kind: kind of measurement, in files and messages.
        fields: the required fields, beginning with the one that identifies the kind of measurement.
        blocks: the components of a reading.
        tool_symbols: coordinates of the target on the tool on which readings depend.
        twist_rows: 3 if readings depend only on the target's position, 6 if on its orientation as
            well.
        per_row: names of the attributes with one entry per row.
        names_points: field with the name of a fixed point for each row.
        default_target: name of the target in a table without one.
        reads_pose: whether the first three components are the target's position in the instrument's
            axes and further ones its orientation, so that replicates have an accuracy and a
            repeatability as in ISO 9283.
        pose_limit: completes "3 poses ..." where many rows of one pose determine no more than six
            coordinates.
        has_camera: whether a known camera can be given.
        is_of_joints: whether a row reads only the joints, at a contact
            (:func:`pincal.identify.believed.slope_of_contacts`).
        is_on_tool: whether the sensor itself is on the tool, so that its mount can be given.
        reads_place: whether readings determine positions, and so lengths; else these are held and
            errors have no size in mm.
        follows: how readings depend on the moving tip: "linearly", "squared" or "as ratios", see
            ``motion/reading_starts``.
        deviation_end: end of the arrow from the predicted position that represents the deviation of
            the reading.
    """

    kind: ClassVar[str]
    fields: ClassVar[tuple[Field, ...]]
    blocks: ClassVar[tuple[Block, ...]]
    tool_symbols: ClassVar[tuple[str, ...]]
    twist_rows: ClassVar[int]
    per_row: ClassVar[tuple[str, ...]]
    names_points: ClassVar[str | None] = None
    default_target: ClassVar[str] = "tool"
    reads_pose: ClassVar[bool] = False
    pose_limit: ClassVar[str] = ""
    has_camera: ClassVar[bool] = False
    is_of_joints: ClassVar[bool] = False
    is_on_tool: ClassVar[bool] = False
    reads_place: ClassVar[bool] = True
    follows: ClassVar[str] = "linearly"
    deviation_end: ClassVar[str] = "measured"

    @classmethod
    @abstractmethod
    def of(cls, table: TableRows, setup: Setup) -> Self:
        """Return the readings of a table that has all of ``fields``, with the known points and
        camera of the setup.

        Raises:
            MeasurementError: for a point that the setup does not have and that can't be judged.
        """

    @property
    @abstractmethod
    def base_symbols(self) -> tuple[str, ...]:
        """Coordinates of the base frame on which readings can depend."""

    @abstractmethod
    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return reading minus prediction.

        Args:
            poses: shape (N, 3, 4), the target in the instrument's frame; with K moments about each
                row shape (N K, 3, 4), here and in the other methods.
            own: values of the sensor's parameters.

        Returns:
            Shape (m, N), block after block.
        """

    @abstractmethod
    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the derivative of the prediction.

        Args:
            poses: shape (N, 3, 4).
            motion: shape (P, ``twist_rows``, N), motion of the target per parameter, in the
                instrument's axes.
            own: values of the sensor's parameters.

        Returns:
            Shape (P + number of own parameters, m, N); may be the motion itself, which is not
            changed.
        """

    @abstractmethod
    def shifted(self, change: np.ndarray) -> Self:
        """Return readings that differ by ``change``, shape (m, N), in the components of the
        residuals.
        """

    @abstractmethod
    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the deviation of the target from its prediction, as far as the reading determines
        it.

        Use :meth:`least_displacement` where there is no better formula.

        Args:
            residuals: shape (m, N), as from :meth:`residuals`.
            poses: shape (N, 3, 4), the target in the instrument's frame.
            own: values of the sensor's parameters.

        Returns:
            Shape (N, 3) [m], in the instrument's axes.
        """

    @abstractmethod
    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield candidates for the poses of instrument and tools and for own parameters; some may
        be far off.

        Args:
            tips: shape (N, 3, 4), nominal tips in the robot's base frame.
            target: shape (N,), index of each row's target.
            n_targets: number of targets.
        """

    @abstractmethod
    def unobservable(self) -> Iterator[str]:
        """Yield in words what readings of this kind can't determine, however many there are."""

    @final
    def __len__(self) -> int:
        return len(getattr(self, self.per_row[0]))

    @final
    def select(self, rows: slice | np.ndarray) -> Self:
        """Return the readings of some rows."""
        arrays = {name: getattr(self, name) for name in self.per_row}
        chosen: dict[str, Any] = {
            name: array[rows] for name, array in arrays.items() if array is not None
        }
        return replace(self, **chosen)  # type: ignore[type-var]

    @final
    def joined(self, others: Sequence[Self]) -> Self:
        """Return these readings concatenated with others of the same instrument."""
        names = [name for name in self.per_row if getattr(self, name) is not None]
        chosen: dict[str, Any] = {
            n: np.concatenate([getattr(each, n) for each in (self, *others)]) for n in names
        }
        return replace(self, **chosen)  # type: ignore[type-var]

    @final
    def least_displacement(
        self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray
    ) -> np.ndarray:
        """Return the shortest displacement of the target that explains the first block of readings,
        shape (N, 3) [m].
        """
        size = self.blocks[0].size
        motion = np.zeros((3, self.twist_rows, len(poses)))
        motion[[0, 1, 2], [0, 1, 2]] = 1.0
        by_position = self.jacobian(poses, motion, own)[:3, :size].transpose(2, 1, 0)
        return np.asarray(np.einsum("nij,jn->ni", np.linalg.pinv(by_position), residuals[:size]))

    @property
    @final
    def parameters(self) -> tuple[Parameter, ...]:
        """The sensor's own parameters."""
        return self.own_parameters if isinstance(self, OwnParameters) else ()

    @property
    @final
    def unknowns(self) -> str:
        """Description of the sensor's own parameters; empty if it has none."""
        return self.own_words if isinstance(self, OwnParameters) else ""

    @property
    @final
    def fixed(self) -> np.ndarray:
        """Which of its own parameters are known and held fixed, shape (own,)."""
        return (
            self.known_parameters
            if isinstance(self, KnownParameters)
            else np.zeros(len(self.parameters), bool)
        )

    @final
    def constraints(self, own: np.ndarray) -> Constraints | None:
        """Return prior knowledge of the sensor's own parameters, None if there is none."""
        return self.facts(own) if isinstance(self, Grouped) else None

    @property
    @final
    def groups(self) -> np.ndarray | None:
        """Group of each row, shape (N,), where a subsample needs rows of each; else None."""
        return self.row_groups if isinstance(self, Grouped) else None

    @property
    @final
    def is_whole(self) -> bool:
        """Whether the rows can be processed only together, not in parts."""
        return isinstance(self, Grouped) and self.needs_all_rows


class Additive(Sensor):
    """A sensor whose readings are the attribute named like its first field, with
    additive errors.
    """

    @final
    def shifted(self, change: np.ndarray) -> Self:
        name = self.fields[0].name
        shifted: dict[str, Any] = {
            name: getattr(self, name) + (change[0] if len(change) == 1 else change.T)
        }
        return replace(self, **shifted)  # type: ignore[type-var]


class OwnParameters(ABC):
    """A sensor with parameters of its own, such as the position of a socket.

    Unconstrained ones have an infinite size and are fitted together with base and tool.
    """

    @property
    @abstractmethod
    def own_parameters(self) -> tuple[Parameter, ...]:
        """The parameters."""

    @property
    @abstractmethod
    def own_words(self) -> str:
        """Description of the unconstrained ones, such as "the unknown points"; empty if there are
        none.
        """


class KnownParameters(ABC):
    """A sensor some of whose own parameters may be known and are held fixed in a fit."""

    @property
    @abstractmethod
    def known_parameters(self) -> np.ndarray:
        """Which of the own parameters are known, shape (own,)."""

    @property
    @abstractmethod
    def is_given(self) -> bool:
        """Whether the known values were given for this instrument, rather than assumed."""

    @property
    @abstractmethod
    def doubt(self) -> str:
        """The message if readings contradict the given values."""


class Grouped(ABC):
    """A sensor whose rows are in groups, such as one for each socket; own parameters describe the
    unknown ones.
    """

    @property
    @abstractmethod
    def row_groups(self) -> np.ndarray:
        """Group of each row, shape (N,)."""

    @property
    @abstractmethod
    def needs_all_rows(self) -> bool:
        """Whether the rows can be processed only together."""

    @abstractmethod
    def facts(self, own: np.ndarray) -> Constraints | None:
        """Return prior knowledge of the own parameters, such as the distance of two sockets, or
        None.
        """

    @abstractmethod
    def unusable_rows(self) -> Iterator[Excluded]:
        """Yield rows without information, each judged without the rows yielded before."""

    @classmethod
    @abstractmethod
    def unscorable_rows(cls, table: TableRows, setup: Setup) -> Iterator[Excluded]:
        """Yield rows by which a calibration with ``setup`` can't be judged."""


class Divided(ABC):
    """A sensor whose rows may belong to several stations, between different links or of different
    kinds.
    """

    @classmethod
    @abstractmethod
    def parts(cls, table: Any) -> Iterator[tuple[str, Any]]:
        """Yield each part as a word for its kind of rows and a table with its links.

        Raises:
            MeasurementError: for rows without the names of the links.
        """


class Simulatable(ABC):
    """A sensor whose readings follow from the target's pose, so that measurements can be designed
    in advance.

    Attributes:
        needs_instrument: whether the information in readings depends on the pose of the instrument.
        needs_places: whether the target is held at fixed places, whose positions are the sensor's
            own parameters.
    """

    blocks: ClassVar[tuple[Block, ...]]
    needs_instrument: ClassVar[bool] = False
    needs_places: ClassVar[bool] = False

    @classmethod
    @abstractmethod
    def simulated(cls, poses: np.ndarray, places: np.ndarray | None = None) -> Sensor:
        """Return error-free readings of poses.

        Args:
            poses: shape (N, 3, 4), in the instrument's frame.
            places: shape (K, 3), places in that frame where the target is held, if needed [m]; each
                pose is assigned to the nearest.
        """


class Plausible(ABC):
    """A sensor whose readings reveal a wrong unit by their size."""

    @classmethod
    @abstractmethod
    def check_plausible(cls, table: TableRows, reach_m: float) -> None:
        """Refuse a table, of at least two rows, whose readings are impossible for the reach of the
        flange [m].

        Raises:
            MeasurementError: naming the unit that seems to be meant.
        """


class _Foreseeable(Simulatable):
    @classmethod
    def simulated(cls, poses: np.ndarray, places: np.ndarray | None = None) -> Sensor:
        """Return the readings by the old method ``foreseen``."""
        found: Sensor = cls.foreseen(poses, places)  # type: ignore[attr-defined]
        return found


def __getattr__(name: str) -> Any:
    if name == "Foreseeable":
        warnings.warn(
            "Foreseeable.foreseen is now Simulatable.simulated", DeprecationWarning, stacklevel=2
        )
        return _Foreseeable
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
