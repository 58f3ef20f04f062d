"""Sensors: what an instrument reads of a pose, and how the reading moves with it.

A sensor knows the target's pose in the instrument's frame and nothing of robots. Whatever is asked of measurements elsewhere
goes through :class:`Sensor`, so that a sensor needs no other place than its own file.

What only some sensors have is a class of its own to inherit from: :class:`OwnParameters`, :class:`KnownParameters`,
:class:`Grouped`, :class:`Divided`, :class:`Simulatable`, :class:`Plausible`.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, final

import numpy as np

from pincal.measure.extrinsics import Extrinsics
from pincal.measure.fields import Field, TableRows
from pincal.measure.setup import Setup
from pincal.parameters import Parameter


@dataclass(frozen=True)
class Block:
    """Components of a reading that share a unit and a standard deviation.

    Attributes:
        name: "position", "orientation", "distance", ...
        unit: "m", "rad" or "px"; of an IMU "m/s^2" and "rad/s".
        size: number of components.
        rounding: of a prediction; noise is never taken to be less.
        noise: standard deviation of one component as good instruments have it, taken where the noise is neither declared
            nor can be estimated.
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
    """C facts on a sensor's own parameters, as if they were readings.

    Attributes:
        residuals: shape (C,), known minus predicted.
        jacobian: shape (own, C), derivative of the predicted.
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
        expected: what a table with no other rows would need.
    """

    rows: np.ndarray
    reason: str
    expected: str


class Sensor(ABC):
    """Readings of N poses.

    A class defines, in addition to the abstract methods:

    Attributes:
        kind: what is measured, in files and messages.
        fields: what a table has to hold, that which gives the kind of measurement away first.
        blocks: the components of a reading.
        tool_symbols: coordinates of the target on the tool that readings depend on.
        twist_rows: 3 if readings depend on the target's position alone, 6 if on its orientation as well.
        per_row: names of the attributes that have one entry per row.
        names_points: field that names a fixed point for each row.
        default_target: name of the target in a table that names none.
        reads_pose: whether the first three components are the target's position in the instrument's axes and further ones
            its orientation, so that repeated poses have an accuracy and a repeatability as ISO 9283 defines them.
        pose_limit: completes "3 poses ..." where many rows can share a pose and yet give no more than six coordinates.
        has_camera: whether a known camera can be given.
        is_of_joints: whether a row reads the joints alone, at a touch (:func:`pincal.identify.believed.slope_of_contacts`).
        is_on_tool: whether the sensor itself sits on the tool, so that its mount can be given.
        reads_place: whether readings tell places, and so lengths, held otherwise; else errors have no size in mm.
        follows: how readings depend on the moving tip: "linearly", "squared" or "as ratios", see ``motion/reading_starts``.
        deviation_end: where an arrow from the predicted position ends that is as long as the reading deviates.
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
        """Return the readings of a table that has all of ``fields``, with what is known of named points and of a camera.

        Raises:
            MeasurementError: for a point that the setup does not have and that can't be judged without.
        """

    @property
    @abstractmethod
    def base_symbols(self) -> tuple[str, ...]:
        """Coordinates of the base frame that the readings can depend on."""

    @abstractmethod
    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return reading minus prediction.

        Args:
            poses: shape (N, 3, 4), the target in the instrument's frame; where conditions have K moments about each row
                shape (N K, 3, 4), and so in the other methods.
            own: values of the sensor's parameters.

        Returns:
            Shape (m, N), block after block.
        """

    @abstractmethod
    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the derivative of minus the residuals.

        Args:
            poses: shape (N, 3, 4).
            motion: shape (P, ``twist_rows``, N), motion of the target by parameter, in the instrument's axes.
            own: values of the sensor's parameters.

        Returns:
            Shape (P + number of own parameters, m, N); the motion itself may be returned, but is not changed.
        """

    @abstractmethod
    def shifted(self, change: np.ndarray) -> Self:
        """Return readings that differ by ``change``, shape (m, N), in the components of the residuals."""

    @abstractmethod
    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the deviation of the target from its prediction, as far as the reading determines it.

        Where no better formula is at hand, :meth:`least_displacement` serves.

        Args:
            residuals: shape (m, N), as :meth:`residuals` has them.
            poses: shape (N, 3, 4), the target in the instrument's frame.
            own: values of the sensor's parameters.

        Returns:
            Shape (N, 3) [m], in the instrument's axes.
        """

    @abstractmethod
    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield where instrument, tools and all that the sensor owns may stand; some candidates may be far off.

        Args:
            tips: shape (N, 3, 4), nominal tips in the robot's base frame.
            target: shape (N,), index of each row's target.
            n_targets: number of targets.
        """

    @abstractmethod
    def unobservable(self) -> Iterator[str]:
        """Yield what readings of this kind can't determine, however many there are, in words."""

    @final
    def __len__(self) -> int:
        return len(getattr(self, self.per_row[0]))

    @final
    def select(self, rows: slice | np.ndarray) -> Self:
        """Return the readings of some rows."""
        arrays = {name: getattr(self, name) for name in self.per_row}
        chosen: dict[str, Any] = {name: array[rows] for name, array in arrays.items() if array is not None}
        return replace(self, **chosen)  # type: ignore[type-var]

    @final
    def joined(self, others: Sequence[Self]) -> Self:
        """Return these readings and others of the same instrument, one after the other."""
        names = [name for name in self.per_row if getattr(self, name) is not None]
        chosen: dict[str, Any] = {n: np.concatenate([getattr(each, n) for each in (self, *others)]) for n in names}
        return replace(self, **chosen)  # type: ignore[type-var]

    @final
    def least_displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the shortest displacement of the target that explains the first block of readings, shape (N, 3) [m]."""
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
        """What the sensor's own parameters describe; empty if it has none."""
        return self.own_words if isinstance(self, OwnParameters) else ""

    @property
    @final
    def fixed(self) -> np.ndarray:
        """Which of its own parameters are known and stay as they are, shape (own,)."""
        return self.known_parameters if isinstance(self, KnownParameters) else np.zeros(len(self.parameters), bool)

    @final
    def constraints(self, own: np.ndarray) -> Constraints | None:
        """Return prior knowledge of the sensor's own parameters, None if there is none."""
        return self.facts(own) if isinstance(self, Grouped) else None

    @property
    @final
    def groups(self) -> np.ndarray | None:
        """What each row belongs to, shape (N,), where a sample needs rows of everything; else None."""
        return self.row_groups if isinstance(self, Grouped) else None

    @property
    @final
    def is_whole(self) -> bool:
        """Whether the rows make sense only together, so that they can't be worked on in pieces."""
        return isinstance(self, Grouped) and self.needs_all_rows


class Additive(Sensor):
    """A sensor whose readings are the attribute that is named as its first field, and add up with their errors."""

    @final
    def shifted(self, change: np.ndarray) -> Self:
        name = self.fields[0].name
        shifted: dict[str, Any] = {name: getattr(self, name) + (change[0] if len(change) == 1 else change.T)}
        return replace(self, **shifted)  # type: ignore[type-var]


class OwnParameters(ABC):
    """A sensor with parameters of its own, such as the position of a socket.

    Those that may lie anywhere have an infinite size: they are fitted together with base and tool.
    """

    @property
    @abstractmethod
    def own_parameters(self) -> tuple[Parameter, ...]:
        """The parameters."""

    @property
    @abstractmethod
    def own_words(self) -> str:
        """What those that may lie anywhere describe, such as "the unknown points"; empty if nothing worth a name."""


class KnownParameters(ABC):
    """A sensor some of whose own parameters may be known, so that a fit leaves them as they are."""

    @property
    @abstractmethod
    def known_parameters(self) -> np.ndarray:
        """Which of the own parameters are known, shape (own,)."""

    @property
    @abstractmethod
    def is_given(self) -> bool:
        """Whether the known values were given for this very instrument, not taken from experience."""

    @property
    @abstractmethod
    def doubt(self) -> str:
        """The message if the readings contradict the values that were given."""


class Grouped(ABC):
    """A sensor each of whose rows involves one of several things, such as a socket; own parameters describe unknown ones."""

    @property
    @abstractmethod
    def row_groups(self) -> np.ndarray:
        """The thing that each row involves, shape (N,)."""

    @property
    @abstractmethod
    def needs_all_rows(self) -> bool:
        """Whether the rows make sense only together."""

    @abstractmethod
    def facts(self, own: np.ndarray) -> Constraints | None:
        """Return what is known of the own parameters from elsewhere, such as the distance of two sockets, or None."""

    @abstractmethod
    def unusable_rows(self) -> Iterator[Excluded]:
        """Yield rows without information; later ones are judged without the earlier ones."""

    @classmethod
    @abstractmethod
    def unscorable_rows(cls, table: TableRows, setup: Setup) -> Iterator[Excluded]:
        """Yield rows by which a calibration that knew ``setup`` can't be judged."""


class Divided(ABC):
    """A sensor whose rows may belong to several stations, as they are between different links, or read differently."""

    @classmethod
    @abstractmethod
    def parts(cls, table: Any) -> Iterator[tuple[str, Any]]:
        """Yield what kind of rows each part has, in a word, and the part, a table with its links.

        Raises:
            MeasurementError: for rows that do not name the links.
        """


class Simulatable(ABC):
    """A sensor whose readings follow from the target's pose alone, so that measurements can be designed beforehand.

    Attributes:
        needs_instrument: whether the information of readings depends on where the instrument is.
        needs_places: whether the target is held at places, which are the sensor's own parameters, one after the other.
    """

    blocks: ClassVar[tuple[Block, ...]]
    needs_instrument: ClassVar[bool] = False
    needs_places: ClassVar[bool] = False

    @classmethod
    @abstractmethod
    def simulated(cls, poses: np.ndarray, places: np.ndarray | None = None) -> Sensor:
        """Return what an instrument without errors reads of poses.

        Args:
            poses: shape (N, 3, 4), in the instrument's frame.
            places: shape (K, 3), in that frame [m], where the target is held by what needs places; each pose belongs to the
                nearest.
        """


class Plausible(ABC):
    """A sensor whose readings show by their size if they are in another unit than assumed."""

    @classmethod
    @abstractmethod
    def check_plausible(cls, table: TableRows, reach_m: float) -> None:
        """Refuse a table, of at least two rows, whose readings can't be of an arm that reaches so far [m] with its flange.

        Raises:
            MeasurementError: naming the unit that seems to be meant.
        """


class _Foreseeable(Simulatable):
    @classmethod
    def simulated(cls, poses: np.ndarray, places: np.ndarray | None = None) -> Sensor:
        """Return what the class calls foreseen."""
        found: Sensor = cls.foreseen(poses, places)  # type: ignore[attr-defined]
        return found


def __getattr__(name: str) -> Any:
    if name == "Foreseeable":
        warnings.warn("Foreseeable.foreseen is now Simulatable.simulated", DeprecationWarning, stacklevel=2)
        return _Foreseeable
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
