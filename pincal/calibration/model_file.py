"""The structure of ``model.json``: all that a prediction needs, without the URDF.

The file holds a fitted robot with one station or more. Files of earlier versions are read, too, see
:mod:`pincal.calibration.earlier_files`.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import msgspec
import numpy as np

from pincal.calibration.covered import Covered
from pincal.calibration.discrepancy import Discrepancy
from pincal.calibration.fit_evidence import Evidence
from pincal.calibration.fitted_station import FittedStation
from pincal.calibration.information import RobotInformation
from pincal.calibration.model_statement import ModelStatement
from pincal.calibration.repeatability import Repeatability
from pincal.calibration.unmodelled import Unmodelled
from pincal.errors import OutputError
from pincal.identify.station import are_fingerprints
from pincal.identity import Identity
from pincal.io.arrays import (
    ArrayShape,
    Numbers,
    Packed,
    Record,
    Vector,
    packed_covariance,
    packed_matrix,
    shaped,
)
from pincal.io.entries import (
    ChainEntry,
    Effects,
    ParameterEntry,
    SetupEntry,
    model_of,
    plain,
)
from pincal.io.robot_entry import RobotEntry
from pincal.io.strict_json import Fault, write_json
from pincal.model.model import Model
from pincal.parameters import Covariance, Estimate
from pincal.sensors.registry import known_kinds
from pincal.thresholds import Count

FORMAT_VERSION: Count = 3
# Building the model of a station takes a millisecond, and so do ten effects.
MOST_STATIONS: Count = 500
_MOST_EFFECTS: Count = 10 * MOST_STATIONS


class MeasuredEntry(Record, frozen=True, kw_only=True):
    """The sensor of a station and the coverage of its rows.

    Attributes:
        sensor_kind: what was measured: "position", "pose", "distance" and so on.
        sensor_module: the module that defines the sensor, if it is not one of pincal's own. Reading
            never imports it.
        sigma: shape (blocks,), noise of one component of each block of readings that the fit used
            [m, rad, px].
        payload_centre: shape (3,), centre of mass of the payload in the tip frame [m].
        covered: the range of the training rows.
        setup: named points and the camera.
        rows: fingerprints of the training rows, by which they are recognised; not in files of
            version 0.1.0.
        is_noise_declared: whether the noise was declared, not estimated.
        repeatability: of the readings within a stop and of stops at a pose; none where nothing was
            repeated, and not in files of earlier versions.
    """

    sensor_kind: str
    sigma: Annotated[Numbers, ArrayShape("any")]
    payload_centre: Vector
    covered: Covered
    setup: SetupEntry
    sensor_module: str | None = None
    rows: str = ""
    is_noise_declared: bool = False
    repeatability: Repeatability | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not are_fingerprints(self.rows):
            raise Fault(
                "holds no fingerprints", "four bytes per training row, as base64", key=".rows"
            )
        kind = self.sensor_kind
        module = self.sensor_module
        if kind in known_kinds():
            return
        if module:
            expected = f"its module to be loaded: --plugin {module}"
            raise Fault(f"sensor {kind!r} is not pincal's own", expected, key=".sensor_kind")
        raise Fault(
            f"unknown sensor {kind!r}", f"one of {', '.join(known_kinds())}", key=".sensor_kind"
        )


class GroupEntry(Record, frozen=True, kw_only=True):
    """A block of the covariance of some of the fitted parameters.

    Attributes:
        parameters: their indices among the fitted ones, from 0.
        block: shape (b, b), added to their covariance.
    """

    parameters: Annotated[tuple[int, ...], ArrayShape("block")]
    block: Annotated[Packed, ArrayShape("block", "block", write=packed_covariance)]


class CovarianceEntry(Record, frozen=True, kw_only=True):
    """Covariance of the F fitted parameters: factor times its transpose plus a block per group.

    Attributes:
        groups: the blocks: one of all parameters, or of several stations one per station.
        factor: shape (F, k); a large matrix is packed into text. None where no parameters of
            different groups are correlated.
    """

    groups: tuple[GroupEntry, ...]
    factor: Annotated[Packed | None, ArrayShape("any", "any", write=packed_matrix)] = None

    @classmethod
    def of_covariance(cls, covariance: Covariance) -> CovarianceEntry:
        """Return the entry of a covariance."""
        groups = (
            GroupEntry(parameters=tuple(map(int, places)), block=block)
            for places, block in covariance.groups
            if len(places)
        )
        factor = covariance.factor if covariance.factor.size else None
        return cls(factor=factor, groups=tuple(groups))

    def covariance(self, n: int) -> Covariance:
        """Return the covariance of n fitted parameters."""
        return Covariance(
            np.zeros((n, 0)) if self.factor is None else self.factor,
            tuple((np.array(group.parameters, int), group.block) for group in self.groups),
        )


class StationEntry(MeasuredEntry, frozen=True, kw_only=True):
    """A station.

    Attributes:
        name: of the station, as in the parameters.
        chain: reference frames of base and targets.
        effects: the effects of the robot and of this station.
        equilibrium: whether moments are those of the deflected arm.
        parameters: indices of its parameters in the table: those of the effects, then the sensor's
            own.
    """

    name: str
    chain: ChainEntry
    effects: Effects
    equilibrium: bool
    parameters: tuple[int, ...]

    @classmethod
    def of_station(cls, station: FittedStation, estimate: Estimate) -> StationEntry:
        """Return the entry of a station, with its parameters in an estimate of all."""
        module = known_kinds().get(station.sensor_kind, "pincal")
        is_own = module.split(".")[0] == "pincal"
        return cls.like(
            station,
            sensor_module=None if is_own else module,
            setup=SetupEntry.of_setup(station.setup),
            chain=ChainEntry.of_chain(station.model.chain),
            effects=station.model.effects,
            equilibrium=station.model.equilibrium,
            parameters=tuple(estimate.places(station.parameter_names).tolist()),
        )


class ModelFile(Record, frozen=True, kw_only=True):
    """The whole of ``model.json``.

    Attributes:
        format_version: 3.
        provenance: versions, time, command, seed, input files with their SHA-256.
        robot: the arm.
        parameters: the P parameters: the robot's, then those of each station, of several stations
            under the station's name.
        values: shape (P,), deviations from the nominal.
        fitted: shape (P,), which parameters were fitted.
        covariance: of the fitted ones.
        stations: the stations, one or more.
        nominal_values: shape (P,), the values with only base and tool fitted; none where unknown.
        unmodelled: effects present in the rows but not in the model; none without any, or if not
            tested.
        information: information of the rows on the robot, without any prior, from which types of
            robots are learned; none where it is not known.
        discrepancy: the covariance of what the model lacks; none where its residuals are noise, or
            it is not known.
        id: identity of robot, instrument and circumstances; none where nothing was stated.
        statement: what the calibration states of the model; not in files of earlier versions.
        files: the files written with it, with their SHA-256; none where it was saved alone.
        check: SHA-256 of all values but ``files``, which have to belong together; not in files of
            earlier versions. A file that is meant to be edited has none.
    """

    format_version: int
    provenance: dict[str, Any]
    robot: RobotEntry
    parameters: Annotated[tuple[ParameterEntry, ...], ArrayShape("parameters")]
    values: Annotated[Numbers, ArrayShape("parameters")]
    fitted: Annotated[tuple[bool, ...], ArrayShape("parameters")]
    covariance: CovarianceEntry
    stations: Annotated[
        tuple[StationEntry, ...], msgspec.Meta(min_length=1, max_length=MOST_STATIONS)
    ]
    nominal_values: Annotated[Numbers | None, ArrayShape("parameters")] = None
    unmodelled: Unmodelled | None = None
    information: RobotInformation | None = None
    discrepancy: Discrepancy | None = None
    id: Identity | None = None
    statement: ModelStatement | None = None
    files: dict[str, str] | None = None
    check: str | None = None

    @classmethod
    def of_robot(
        cls,
        stations: Sequence[FittedStation],
        estimate: Estimate,
        nominal_values: np.ndarray | None,
        evidence: Evidence,
        provenance: dict[str, Any],
        discrepancy: Discrepancy | None,
        identity: Identity,
        statement: ModelStatement | None = None,
    ) -> ModelFile:
        """Return the file of a fitted robot, given by its parts."""
        return cls(
            format_version=FORMAT_VERSION,
            provenance=provenance,
            robot=RobotEntry.of_robot(stations[0].model.chain.robot),
            parameters=tuple(map(ParameterEntry.of_parameter, estimate.parameters)),
            values=estimate.values,
            fitted=tuple(map(bool, estimate.free)),
            covariance=CovarianceEntry.of_covariance(estimate.covariance),
            stations=tuple(StationEntry.of_station(station, estimate) for station in stations),
            nominal_values=nominal_values,
            unmodelled=evidence.unmodelled,
            information=evidence.information,
            discrepancy=discrepancy,
            id=identity or None,
            statement=statement,
        )

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_covariance()
        n_effects = sum(len(station.effects) for station in self.stations)
        if n_effects > _MOST_EFFECTS:
            raise Fault(f"hold {n_effects} effects", f"at most {_MOST_EFFECTS}", key=".stations")
        for k, station in enumerate(self.stations):
            covered = station.covered.q
            key = f".stations[{k}]"
            shaped(f"{key}.covered.q", covered, ArrayShape(len(self.robot.joint_names), 2), {})
            self._check_parameters(station, self.model(k).names, f"{key}.parameters")

    def _check_covariance(self) -> None:
        """Refuse a covariance that is not of the fitted parameters."""
        n = sum(self.fitted)
        if self.covariance.factor is not None:
            shaped(".covariance.factor", self.covariance.factor, ArrayShape(n, "any"), {})
        for k, group in enumerate(self.covariance.groups):
            if any(not 0 <= i < n for i in group.parameters):
                raise Fault(
                    "has an entry that is not a fitted parameter",
                    f"numbers from 0 to {n - 1}",
                    key=f".covariance.groups[{k}].parameters",
                )

    def _check_parameters(self, station: StationEntry, names: tuple[str, ...], key: str) -> None:
        """Refuse a station whose parameters are not those of its effects."""
        n = len(self.parameters)
        if any(not 0 <= i < n for i in station.parameters):
            raise Fault("has an entry that is no parameter", f"numbers from 0 to {n - 1}", key=key)
        known = [self.parameters[i].parameter().local_name for i in station.parameters]
        if tuple(known[: len(names)]) != names:
            raise Fault(
                "are not those of the effects", f"{', '.join(names[:3])} and so on", key=key
            )

    def model(self, k: int) -> Model:
        """Return the model of the k-th station."""
        entry = self.stations[k]
        return model_of(
            self.robot.robot(),
            entry.chain,
            entry.effects,
            equilibrium=entry.equilibrium,
            key=f".stations[{k}]",
        )

    def estimate(self) -> Estimate:
        """Return the estimate of all parameters."""
        parameters = tuple(entry.parameter() for entry in self.parameters)
        prior = np.array([parameter.size for parameter in parameters])
        fitted = np.array(self.fitted, bool)
        covariance = self.covariance.covariance(int(fitted.sum()))
        return Estimate(parameters, self.values, fitted, covariance, prior)

    def fitted_stations(self) -> tuple[FittedStation, ...]:
        """Return the stations."""
        return tuple(
            FittedStation(
                name=entry.name,
                model=self.model(k),
                parameter_names=tuple(self.parameters[i].name for i in entry.parameters),
                sensor_kind=entry.sensor_kind,
                payload_centre=entry.payload_centre,
                covered=entry.covered,
                sigma=entry.sigma,
                setup=entry.setup.setup(),
                rows=entry.rows,
                is_noise_declared=entry.is_noise_declared,
                repeated=entry.repeatability,
            )
            for k, entry in enumerate(self.stations)
        )


def write_model_file(path: str | os.PathLike[str], made: Callable[[], ModelFile]) -> None:
    """Write the ``model.json`` that a function makes: the whole file or nothing, its numbers in
    full precision.

    Raises:
        OutputError: if the place can't be written to, or a number is not finite.
    """
    try:
        file = made()
    except Fault as fault:
        place = fault.key.removeprefix(".")
        raise OutputError(
            f"{os.fspath(path)}: not finite or not whole: {place} {fault}; calibrate again"
        ) from None
    contents = {"format_version": file.format_version, **plain(file)}
    write_json(path, {"check": check_of(contents), **contents}, indent=None)


def check_of(contents: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the values of a ``model.json``, whatever their order and layout.

    Example:
        >>> check_of({"values": [1e-3], "check": "0"}) == check_of({"values": [0.001]})
        True
        >>> check_of({"values": [0.002]}) == check_of({"values": [0.001]})
        False
    """
    values = {key: value for key, value in contents.items() if key not in ("files", "check")}
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode("ascii")).hexdigest()
