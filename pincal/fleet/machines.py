"""Machines of a type as a site shares them: information on the parameters of each, without poses
and times; their file.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import polars as pl

from pincal.atomic import write_atomic
from pincal.calibration.information import RobotInformation, information_of, load_information
from pincal.errors import BadInputError, ModelFileError
from pincal.fleet.evidence import Forms
from pincal.identify.fit import ModelFit
from pincal.parameters import Parameter
from pincal.thresholds import Count

SCHEMA_VERSION: Count = 1
"""Version of the rows in which machines are stored."""
# The column of a site's file with the checksum of all its rows.
_CHECKSUM = "checksum"


@dataclass(frozen=True, eq=False)
class Machine:
    """Information on one machine.

    Attributes:
        name: of the machine; "" if the site does not share it.
        information: of its readings on its parameters, with base, targets and instrument
            marginalised and without a prior.
        labels: further properties, such as its supplier, batch or hall.
    """

    name: str
    information: RobotInformation
    labels: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls, fit: ModelFit, name: str = "", *, labels: Mapping[str, str] | None = None
    ) -> Machine:
        """Return the machine of a fit, without the fit's prior."""
        return cls(name, RobotInformation.of(fit), dict(labels or {}))

    def __add__(self, other: Machine) -> Machine:
        """Return the machine with the readings of both."""
        return replace(
            self,
            information=self.information + other.information,
            labels={**other.labels, **self.labels},
        )


@dataclass(frozen=True, eq=False)
class Gathered:
    """Machines of one type, all in the same parameters.

    Attributes:
        machines: one per name.
        robot: name of the arm.
        geometry: checksum of its nominal geometry.
        parameters: the P parameters of all machines together.
        priors: shape (P,), standard deviations of their priors without a type.
        forms: the machines' information, in units of these priors.
    """

    machines: tuple[Machine, ...]
    robot: str
    geometry: int
    parameters: tuple[Parameter, ...]
    priors: np.ndarray
    forms: Forms


def gathered(machines: Iterable[Machine], *, like: Sequence[Parameter] = ()) -> Gathered:
    """Return machines in the same parameters; readings give no information on parameters that a
    machine lacks.

    Args:
        machines: one or more; machines of one name are added up, and identical ones count once.
        like: the first parameters.

    Raises:
        BadInputError: for no machine, one under two names, different nominal geometries, or
            different units of a parameter.
    """
    found = _added_up(machines)
    if not found:
        raise BadInputError("no machines; expected information on one or more")
    first = found[0].information
    priors_of = _priors_of_all(found, like)
    parameters = tuple(priors_of)
    place = {parameter.name: i for i, parameter in enumerate(parameters)}
    priors = np.array(list(priors_of.values()))
    H = np.zeros((len(found), len(place), len(place)))
    g = np.zeros((len(found), len(place)))
    for k, machine in enumerate(found):
        form = machine.information.form
        at = np.array([place[name] for name in form.names], int)
        D = priors[at]
        H[k, at[:, None], at] = form.H * np.outer(D, D)
        g[k, at] = form.g * D
    forms = Forms(H, g, _numbered(p.element for p in parameters))
    return Gathered(found, first.robot, first.geometry, parameters, priors, forms)


def _added_up(machines: Iterable[Machine]) -> tuple[Machine, ...]:
    """Return machines, one per name, without repeated readings.

    Raises:
        BadInputError: for a machine under two names.
    """
    named = dict[object, Machine]()
    twins = dict[object, Machine]()
    for k, machine in enumerate(machines):
        key = machine.name or k
        # Because of noise no two sets of readings are equal.
        own = machine.information
        readings = own.geometry, own.g.tobytes() or k
        if (twin := twins.get(readings)) is not None:
            if machine.name and twin.name == machine.name:
                continue
            raise BadInputError(
                f"{_called(machine)} has the same readings as {_called(twin)}; expected "
                "each machine once, under one name: "
                "leave one out"
            )
        twins[readings] = machine
        named[key] = named[key] + machine if key in named else machine
    return tuple(named.values())


def _priors_of_all(
    machines: Sequence[Machine], like: Sequence[Parameter]
) -> dict[Parameter, float]:
    """Return each parameter of any of the machines, first those of ``like``, with the standard
    deviation of its prior without a type.

    Raises:
        BadInputError: for different nominal geometries, or different units of a parameter.
    """
    first = machines[0].information
    parameters = {p.name: p for p in like}
    sizes = dict[str, list[float]]()
    for machine in machines:
        own = machine.information
        if own.geometry != first.geometry:
            raise BadInputError(
                f"{_called(machine)} ({own.robot}) and {_called(machines[0])} "
                f"({first.robot}) have different nominal "
                "geometries, so they are not of one type; calibrate all with the same "
                "URDF, base and tip"
            )
        for parameter, size in own.known.values():
            known = parameters.setdefault(parameter.name, parameter)
            if known.unit != parameter.unit:
                raise BadInputError(
                    f"{_called(machine)}: {parameter.name} is in {parameter.unit}; "
                    f"expected {known.unit}"
                )
            sizes.setdefault(parameter.name, []).append(size)
    # The prior of compliances depends on the poses of each machine.
    return {p: float(np.median(sizes.get(p.name, [p.size]))) for p in parameters.values()}


def kinds_of(parameters: Sequence[Parameter]) -> np.ndarray:
    """Return the number of each parameter's kind, shape (P,): those of one effect and unit have
    similar spreads.
    """
    return _numbered((p.effect, p.unit) for p in parameters)


def machines_frame(machines: Iterable[Machine]) -> pl.DataFrame:
    """Return machines as a table, one row per machine."""
    found = list(machines)
    rows = [
        (SCHEMA_VERSION, one.name, one.information.robot, one.information.text()) for one in found
    ]
    schema = {"schema": pl.Int32, "machine": pl.String, "arm": pl.String, "information": pl.String}
    return pl.DataFrame(rows, schema, orient="row").with_columns(
        labelled([machine.labels for machine in found])
    )


def labelled(labels: Sequence[Mapping[str, str]]) -> pl.Series:
    """Return the labels of each row as a column."""
    entries = [
        [{"key": key, "value": value} for key, value in sorted(row.items())] for row in labels
    ]
    return pl.Series("labels", entries, pl.List(pl.Struct({"key": pl.String, "value": pl.String})))


def machines_of(frame: pl.DataFrame, source: str) -> list[Machine]:
    """Return the machines of a table of :func:`machines_frame`.

    Raises:
        ModelFileError: for another schema, or inconsistent arrays.
    """
    missing = [
        name for name in ("schema", "machine", "information", "labels") if name not in frame.columns
    ]
    if missing:
        raise ModelFileError(
            f"{source}: no column {missing[0]!r}; expected information on machines as "
            "pincal writes it"
        )
    found = list[Machine]()
    for k, (schema, name, text, labels) in enumerate(
        frame.select("schema", "machine", "information", "labels").rows()
    ):
        if schema != SCHEMA_VERSION:
            raise ModelFileError(
                f"{source}: row {k} has schema {schema}; expected {SCHEMA_VERSION}"
            )
        information = information_of(text, f"{source}: row {k}, machine {name!r}")
        found.append(Machine(name, information, {entry["key"]: entry["value"] for entry in labels}))
    return found


def save_machines(
    path: str | os.PathLike[str], machines: Iterable[Machine], *, names: bool = False
) -> None:
    """Write what a site shares: information on its machines as one Parquet file, some kilobytes
    each.

    Args:
        path: the file.
        machines: the machines.
        names: whether their names and labels are included.

    Raises:
        OutputError: if the place can't be written to.
    """
    sent = [machine if names else replace(machine, name="", labels={}) for machine in machines]
    frame = machines_frame(sent)
    frame = frame.with_columns(pl.lit(_checksum_of(frame)).alias(_CHECKSUM))
    write_atomic(path, parquet_bytes(frame))


def load_machines(
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
) -> list[Machine]:
    """Return the machines of files: Parquet of :func:`save_machines`, or information files of
    single machines (JSON).

    The machine of an information file has the name of the file.

    Raises:
        ModelFileError: if a file can't be read, or is damaged.
    """
    found = list[Machine]()
    for path in [paths] if isinstance(paths, str | os.PathLike) else paths:
        if Path(path).suffix.lower() != ".parquet":
            found.append(Machine(Path(path).stem, load_information(path)))
            continue
        try:
            with silent_decoder():
                frame = pl.read_parquet(Path(path), glob=False)
        except (OSError, pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:
            raise ModelFileError(
                f"{os.fspath(path)}: can't be read ({error}); expected information on machines"
            ) from None
        machines = machines_of(frame, os.fspath(path))
        _check_sum(frame, os.fspath(path))
        found += machines
    return found


def _check_sum(frame: pl.DataFrame, source: str) -> None:
    """Refuse a site's file whose rows are others than were written; earlier files have no checksum.

    Raises:
        ModelFileError: if they are.
    """
    if _CHECKSUM not in frame.columns:
        return
    if frame[_CHECKSUM].to_list() != [_checksum_of(frame.drop(_CHECKSUM))] * len(frame):
        raise ModelFileError(
            f"{source}: damaged (its rows have another checksum than when they were written); "
            "have the site send it again"
        )


def _checksum_of(frame: pl.DataFrame) -> str:
    """Return the checksum of all rows of a table, whatever the file's compression."""
    content = json.dumps([frame.columns, frame.rows()], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()


@contextlib.contextmanager
def silent_decoder() -> Iterator[None]:
    """Send to nowhere what the decoder itself writes on stderr, a backtrace of many lines for a
    damaged file; the error that it raises says what is wrong.
    """
    try:
        kept = os.dup(2)
    except OSError:
        # Nobody listens.
        yield
        return
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def parquet_bytes(frame: pl.DataFrame) -> bytes:
    """Return the content of a Parquet file of a table, identical for equal tables."""
    stream = io.BytesIO()
    frame.write_parquet(stream)
    return stream.getvalue()


def _called(machine: Machine) -> str:
    return f"machine {machine.name!r}" if machine.name else "a machine without a name"


def _numbered(things: Iterable[object]) -> np.ndarray:
    """Number things in order of appearance, equal ones equally, shape (n,)."""
    known = dict[object, int]()
    return np.array([known.setdefault(thing, len(known)) for thing in things], int)
