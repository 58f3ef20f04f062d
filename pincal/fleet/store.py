"""Measurements and results of a fleet, as Parquet files in a folder or an object store.

A file is written once, as a whole, and never changed:
``KIND/machine=NAME/day=YYYY-MM-DD/ID.CHECKSUM.parquet``. Its ID is a checksum of its rows, or of
what they were computed from, so that concurrent writers need no lock, duplicates are stored once,
and finished work is recognised. The second checksum is of the file's bytes: a file that was damaged
or exchanged is refused before anything in it is decoded. Every row has the version of its schema,
and machine, day and ID, which must be those of the path. DuckDB, Polars and others read the files.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import polars as pl

from pincal.atomic import ELSEWHERE, write_atomic
from pincal.errors import BadInputError, OutputError, needed
from pincal.fleet.machines import (
    SCHEMA_VERSION,
    Machine,
    machines_of,
    parquet_bytes,
    silent_decoder,
)
from pincal.fleet.stored_rows import (
    CALIBRATION,
    ROLES,
    information_frame,
    measurements_of,
    table_frame,
    text_frame,
)
from pincal.measure.measurements import Measurements
from pincal.thresholds import Count

TABLES = "tables"
INFORMATION = "information"
DIAGNOSES = "diagnoses"
DISCOVERIES = "discoveries"
MODELS = "models"
STORED = (TABLES, INFORMATION, DIAGNOSES, DISCOVERIES, MODELS)
"""Content of a store: rows as measured, information on machines, diagnoses, discoveries
and models.
"""

_MARK = "store.json"
_FORMAT = "pincal-store"
_VERSION: Count = 1
# Files read at a time: with information on 40 parameters they take 10 MB.
_PIECE: Count = 1000
# Digits of a checksum: 80 bits, equal by chance in none of a million million files.
_DIGITS: Count = 20
# Columns that say where a file belongs, and further ones without which a kind is not readable.
_PLACE = ("machine", "day", "id")
_COLUMNS = {
    TABLES: ("role", "labels", "joints", "source"),
    INFORMATION: ("role", "labels", "job", "table", "failure", "information"),
    DIAGNOSES: ("text", "p_value", "table", "failure"),
    DISCOVERIES: ("text",),
    MODELS: ("text",),
}
# Longest name of a machine in a path [characters]: file systems allow 255.
_LONGEST: Count = 240


@dataclass(frozen=True, order=True)
class Key:
    """A file of a store.

    Attributes:
        kind: one of :data:`STORED`.
        machine: name of the machine.
        day: ISO date.
        id: of the file within these.
        checksum: of its bytes; "" if unknown, as in stores written before files had one. Keys that
            differ in nothing else are equal.
    """

    kind: str
    machine: str
    day: str
    id: str
    checksum: str = field(default="", compare=False)

    @property
    def path(self) -> str:
        """Its path in the store."""
        name = f"{self.id}.{self.checksum}" if self.checksum else self.id
        return f"{self.kind}/machine={quote(self.machine, safe='')}/day={self.day}/{name}.parquet"

    @property
    def is_added(self) -> bool:
        """Whether it was added, with a checksum of its rows as ID, and is no result of a job."""
        return "-" not in self.id

    @classmethod
    def of(cls, path: str) -> Key:
        """Return the key of a path that ends as :attr:`path`.

        Raises:
            BadInputError: for any other path, such as a copy's.
        """
        kind, machine, day, name = path.replace("\\", "/").split("/")[-4:]
        machine = unquote(machine.removeprefix("machine="))
        day = day.removeprefix("day=")
        found = cls(kind, machine, day, *name.removesuffix(".parquet").split(".", 1))
        if not path.replace("\\", "/").endswith(found.path) or iso_day(day) != day:
            raise BadInputError(
                f"{path}: not a file that pincal wrote to a store; expected {found.path}: "
                "move it elsewhere"
            )
        return found


@dataclass(frozen=True)
class Store:
    """A folder of files, on a disk or any file system of fsspec; see :func:`open_store`.

    Attributes:
        place: the folder, or a URL such as ``s3://bucket/fleet``.
    """

    place: str

    @property
    def _is_url(self) -> bool:
        return "://" in self.place

    @cached_property
    def _files(self) -> tuple[Any, str]:
        """File system and path of a URL."""
        with needed(
            "fsspec", "stores at a URL", install="fsspec and the package for the URL, such as s3fs"
        ):
            import fsspec  # type: ignore[import-untyped]
        try:
            found: tuple[Any, str] = fsspec.core.url_to_fs(self.place)
        except (ValueError, ImportError) as error:
            raise BadInputError(
                f"{self.place}: no such store ({error}); expected a folder or a URL that "
                "fsspec knows"
            ) from None
        return found

    def __getstate__(self) -> dict[str, str]:
        """Return the place alone: connections can't be shared between processes."""
        return {"place": self.place}

    def read(self, path: str) -> bytes | None:
        """Return the content of a file; None if there is none."""
        try:
            if self._is_url:
                files, root = self._files
                content: bytes = files.cat_file(f"{root}/{path}")
                return content
            return (Path(self.place) / path).read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise BadInputError(
                f"{self.place}/{path}: can't be read ({error.strerror or error})"
            ) from None

    def write(self, path: str, content: bytes) -> None:
        """Write a file as a whole or not at all.

        Raises:
            OutputError: if the place can't be written to.
        """
        try:
            if self._is_url:
                files, root = self._files
                target = f"{root}/{path}"
                files.makedirs(target.rpartition("/")[0], exist_ok=True)
                files.pipe_file(target, content)
                return
            target_path = Path(self.place) / path
            target_path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"{self.place}: can't be written ({error.strerror or error}); {ELSEWHERE}"
            ) from None
        write_atomic(target_path, content)

    def keys(self, kind: str) -> list[Key]:
        """Return the files of a kind, in order."""
        return self._found(f"{kind}/machine=*/day=*/*.parquet")

    def _found(self, pattern: str) -> list[Key]:
        """Return the files whose paths match a pattern, in order.

        Results that two workers computed at the same time may differ in their last bits; then the
        file with the smaller checksum counts.
        """
        if self._is_url:
            files, root = self._files
            paths = files.glob(f"{root}/{pattern}")
        else:
            # Drafts of writers at work begin with a dot.
            there = Path(self.place).glob(pattern)
            paths = [path.as_posix() for path in there if not path.name.startswith(".")]
        found = sorted(map(Key.of, paths), key=lambda key: (key, not key.checksum, key.checksum))
        first = {key: key for key in reversed(found)}
        return [*first.values()][::-1]

    def frame(self, key: Key) -> pl.DataFrame:
        """Return the content of a file.

        Raises:
            BadInputError: if there is none, it is damaged, or it belongs elsewhere.
        """
        frame = self._decoded([key])
        self._check_columns([key] * len(frame) or [key], frame)
        self._check_places([key] * len(frame), frame)
        self._check_earlier(key, frame)
        return frame

    def frames(self, kind: str) -> Iterator[tuple[Sequence[Key], pl.DataFrame]]:
        """Yield the files of a kind with one row each, several at a time as one table, with their
        keys.

        Raises:
            BadInputError: if a file is damaged, belongs elsewhere, or has other columns or rows.
        """
        keys = self.keys(kind)
        for start in range(0, len(keys), _PIECE):
            some = keys[start : start + _PIECE]
            try:
                frame = self._decoded(some)
            except BadInputError:
                # Reading a damaged file raises its own error; else one has other columns than the
                # rest.
                columns = [self._decoded([key]).schema for key in some]
                odd = min(range(len(some)), key=lambda k: columns.count(columns[k]))
                raise BadInputError(
                    f"{self.place}/{some[odd].path}: columns "
                    f"{', '.join(columns[odd])[:200]}; expected the columns of other "
                    f"{kind}: move it elsewhere"
                ) from None
            if len(frame) != len(some):
                raise BadInputError(
                    f"{self.place}/{kind}: {len(frame)} rows in {len(some)} files; "
                    "expected one in each"
                )
            self._check_columns(some, frame)
            self._check_places(some, frame)
            for key, row in zip(some, frame.iter_slices(1), strict=True):
                self._check_earlier(key, row)
            yield some, frame

    def _decoded(self, keys: Sequence[Key]) -> pl.DataFrame:
        """Return the rows of files as one table.

        Raises:
            BadInputError: if a file is not there or damaged, or if they have different columns.
        """
        contents = [self._content(key) for key in keys]
        is_known = all(key.checksum for key in keys)
        try:
            with contextlib.nullcontext() if is_known else silent_decoder():
                return pl.read_parquet(contents)
        except pl.exceptions.PanicException:
            raise self._damaged(keys[0], "it can't be decoded") from None
        except (OSError, pl.exceptions.PolarsError) as error:
            raise self._damaged(keys[0], str(error).partition("\n")[0]) from None

    def _content(self, key: Key) -> bytes:
        """Return the bytes of a file.

        Raises:
            BadInputError: if there is none, or they are not those that were written.
        """
        content = self.read(key.path)
        if content is None:
            raise BadInputError(f"{self.place}: no file {key.path}")
        if key.checksum and _checksum(content) != key.checksum:
            raise self._damaged(key, "its content has another checksum than its name")
        return content

    def _damaged(self, key: Key, why: str) -> BadInputError:
        again = "add it again" if key.is_added else "repeat the work"
        return BadInputError(f"{self.place}/{key.path}: damaged ({why}); delete it and {again}")

    def _check_columns(self, keys: Sequence[Key], frame: pl.DataFrame) -> None:
        """Refuse rows that lack something, one key per row.

        Raises:
            BadInputError: if there is no row, or a column is missing or has gaps.
        """
        expected = ("schema", *_PLACE, *_COLUMNS[keys[0].kind])
        lacking = [name for name in expected if name not in frame.columns]
        lacking += [name for name in frame.columns if name in expected and frame[name].has_nulls()]
        if lacking or frame.is_empty():
            what = lacking[0] if lacking else "rows"
            at = frame[what].is_null().arg_max() if what in frame.columns else 0
            raise BadInputError(
                f"{self.place}/{keys[at or 0].path}: no {what}; expected a file as pincal writes "
                "it: delete it and add it again"
            )

    def _check_places(self, keys: Sequence[Key], frame: pl.DataFrame) -> None:
        """Refuse rows of another machine, day or ID than the paths say, one key per row.

        Raises:
            BadInputError: if a file belongs elsewhere.
        """
        for key, machine, day, of in zip(keys, *(frame[name] for name in _PLACE), strict=True):
            there = replace(key, machine=machine, day=day, id=of)
            if there != key:
                raise BadInputError(
                    f"{self.place}/{key.path}: the content is of {there.path}; expected machine, "
                    "day and ID of its path: move it there, or delete it"
                )

    def _check_earlier(self, key: Key, frame: pl.DataFrame) -> None:
        """Refuse a file without a checksum of its bytes whose rows are not those of its ID.

        Raises:
            BadInputError: if they are not.
        """
        if key.checksum or not key.is_added:
            return
        further = ("day", "id") if key.kind == INFORMATION else ("schema", *_PLACE)
        if _checksum(parquet_bytes(frame.drop(further))) != key.id:
            raise self._damaged(
                key, "or written before files had checksums, with another version of Polars"
            )

    def add(self, key: Key, frame: pl.DataFrame, **facts: str) -> Key:
        """Write a file, with facts as further columns, and its key in the columns ``machine``,
        ``day`` and ``id``.

        Returns:
            The key, with the checksum.
        """
        facts |= {name: getattr(key, name) for name in _PLACE}
        columns = {"schema": pl.lit(SCHEMA_VERSION, pl.Int32)} | {
            name: pl.lit(fact) for name, fact in facts.items()
        }
        content = parquet_bytes(frame.with_columns(**columns))
        written = replace(key, checksum=_checksum(content))
        self.write(written.path, content)
        return written

    def add_table(
        self,
        machine: str,
        day: str,
        table: Measurements,
        *,
        role: str = CALIBRATION,
        labels: Mapping[str, str] | None = None,
    ) -> Key:
        """Add rows of a machine; rows added twice are stored once.

        Args:
            machine: its name.
            day: ISO date.
            table: the rows.
            role: one of :data:`ROLES`.
            labels: further properties of the machine, such as its supplier, batch or hall.

        Raises:
            BadInputError: for an invalid name, day or role.
            OutputError: if the store can't be written to.
        """
        if role not in ROLES:
            raise BadInputError(f"role {role!r}; expected {' or '.join(ROLES)}")
        return self._added(TABLES, machine, day, table_frame(table, role, labels or {}))

    def table(self, key: Key) -> Measurements:
        """Return rows of a machine."""
        return measurements_of(self.frame(key), f"{self.place}/{key.path}")

    def add_information(self, day: str, machine: Machine) -> Key:
        """Add information of a calibration on a machine, by its name.

        Raises:
            BadInputError: for a machine without a name, or an invalid day.
            OutputError: if the store can't be written to.
        """
        frame = information_frame(machine, CALIBRATION)
        frame = frame.with_columns(pl.lit("").alias(name) for name in ("job", "table", "failure"))
        return self._added(INFORMATION, machine.name, day, frame)

    def add_model(self, machine: str, day: str, content: str) -> Key:
        """Add the text of a model.json and when it was added, by which :meth:`last_model` tells
        models of one day apart.

        Raises:
            BadInputError: for an invalid name or day.
            OutputError: if the store can't be written to.
        """
        now = datetime.now(tz=UTC).isoformat(timespec="microseconds")
        return self._added(MODELS, machine, day, text_frame(content), added=now)

    def last_model(self, machine: str | None = None, day: str = "9999") -> str | None:
        """Return the text of the last model of a machine, default any, from a day or earlier; of
        several of that day, of the one that was added last. None if there is none.

        Raises:
            BadInputError: if a file is damaged.
        """
        known = [one for one in self.keys(MODELS) if machine in (None, one.machine)]
        last = max((one.day for one in known if one.day <= day), default=None)
        found: tuple[str, Key, str] | None = None
        for key in known:
            if key.day == last:
                row = self.frame(key).row(0, named=True)
                one = row.get("added", ""), key, row["text"]
                found = one if found is None else max(found, one)
        return None if found is None else found[-1]

    def first_calibration(self, machine: str) -> str | None:
        """Return the day of the first rows or model by which a machine is calibrated, ISO date;
        None if there are none.

        Raises:
            BadInputError: if a file is damaged.
        """
        at = f"machine={quote(machine, safe='')}/day=*/*.parquet"
        days = [key.day for key in self._found(f"{MODELS}/{at}")]
        days += [
            key.day
            for kind in (TABLES, INFORMATION)
            for key in self._found(f"{kind}/{at}")
            if self.frame(key)["role"][0] == CALIBRATION
        ]
        return min(days, default=None)

    def add_text(self, kind: str, machine: str, day: str, content: str, **facts: Any) -> Key:
        """Add the text of a diagnosis.json, with further columns."""
        return self._added(kind, machine, day, text_frame(content, **facts))

    def _added(self, kind: str, machine: str, day: str, frame: pl.DataFrame, **facts: str) -> Key:
        """Write a file identified by its content, with facts that don't identify it; one that is
        there already stays.
        """
        key = Key(kind, named_machine(machine), iso_day(day), _checksum(parquet_bytes(frame)))
        there = self._found(f"{key.path.removesuffix('.parquet')}.*parquet")
        return there[0] if there and there[0].checksum else self.add(key, frame, **facts)

    def machines(
        self, *, job: str | None = None, role: str | None = CALIBRATION
    ) -> Iterator[tuple[Key, Machine, str]]:
        """Yield the information on machines, in the order of their names and days: key, machine and
        role.

        Args:
            job: the one that computed it, see :mod:`pincal.fleet.jobs`; default: any.
            role: of the measured rows; None for all.

        Raises:
            BadInputError: if several jobs computed it from the same rows.
        """
        done = dict[str, str]()
        for keys, frame in self.frames(INFORMATION):
            kept = pl.col("failure") == ""
            kept &= pl.lit(True) if role is None else pl.col("role") == role
            kept &= pl.lit(True) if job is None else pl.col("job").is_in(["", job])
            chosen = frame.with_row_index().filter(kept)
            found = machines_of(chosen, f"{self.place}/{INFORMATION}")
            facts = (chosen[name] for name in ("index", "role", "table", "job"))
            for machine, k, of, table, by in zip(found, *facts, strict=True):
                if table and done.setdefault(table, by) != by:
                    raise BadInputError(
                        f"{self.place}: rows were calibrated by {done[table]} and by "
                        f"{by}; choose a job"
                    )
                yield keys[k], machine, of

    def query(self, sql: str) -> pl.DataFrame:
        """Return the result of an SQL query by DuckDB, with a view for each kind.

        Raises:
            BadInputError: without DuckDB, for an invalid query, or if any file is damaged.

        Example::

            store.query("select machine, count(*) as tables from tables group by machine")
        """
        with needed("duckdb", "queries of a store", install="'pincal[fleet]'"):
            import duckdb
        with duckdb.connect() as connection:
            self._show(connection)
            try:
                answer = connection.execute(sql)
                names = [column[0] for column in answer.description or ()]
                rows = answer.fetchall()
            except duckdb.Error as error:
                raise BadInputError(f"{self.place}: {error}") from None
        return pl.DataFrame(rows, schema=names, orient="row", infer_schema_length=None)

    def _show(self, connection: Any) -> None:
        """Add a view for each kind to a database.

        Raises:
            BadInputError: if a file is damaged.
        """
        place = self.place
        if self._is_url:
            files, root = self._files
            connection.register_filesystem(files)
            protocol = files.protocol if isinstance(files.protocol, str) else files.protocol[0]
            place = f"{protocol}://{root.lstrip('/')}"
        for kind in STORED:
            keys = self.keys(kind)
            for key in keys:
                # DuckDB reads the files itself, without a look at checksums and places.
                self.frame(key)
            if keys:
                pattern = f"{place}/{kind}/machine=*/day=*/*.parquet".replace("'", "''")
                source = f"read_parquet('{pattern}', union_by_name=true, hive_partitioning=false)"
                connection.execute(f"create view {kind} as select * from {source}")


def open_store(place: str | os.PathLike[str], *, create: bool = False) -> Store:
    """Return a store.

    Args:
        place: the folder, or a URL that fsspec supports.
        create: whether to create it if it does not exist.

    Raises:
        BadInputError: if it does not exist, or has a newer version.
        OutputError: if it can't be written to.

    Example:
        >>> import tempfile
        >>> from pincal import measurements_from_arrays
        >>> store = open_store(tempfile.mkdtemp(), create=True)
        >>> q = [[0.0, 1.0], [0.5, 1.0]]
        >>> rows = measurements_from_arrays(["a", "b"], q, distance=[1.2, 1.3])
        >>> key = store.add_table("R17", "2026-11-03", rows)
        >>> store.table(key).distance, len(store.keys("tables"))
        (array([1.2, 1.3]), 1)
    """
    store = Store(os.fspath(place).removeprefix("file://").rstrip("/") or "/")
    content = store.read(_MARK)
    if content is None:
        if not create:
            raise BadInputError(
                f"{store.place}: no {_MARK} here; expected a store created by pincal fleet add"
            )
        store.write(
            _MARK, (json.dumps({"format": _FORMAT, "format_version": _VERSION}) + "\n").encode()
        )
        return store
    try:
        found = json.loads(content)
        version = found["format_version"] if found["format"] == _FORMAT else None
    except (ValueError, TypeError, KeyError, RecursionError):
        version = None
    if type(version) is not int or version < _VERSION:
        raise BadInputError(
            f"{store.place}: {_MARK} does not mark a store of pincal; expected format {_FORMAT!r}"
        )
    if version > _VERSION:
        raise BadInputError(
            f"{store.place}: a store of version {version}, newer than this pincal; "
            f"expected {_VERSION}: update it"
        )
    return store


def named_machine(machine: str) -> str:
    """Return the name of a machine if it is valid.

    Raises:
        BadInputError: if it is not.
    """
    try:
        quoted = quote(machine, safe="")
    except UnicodeEncodeError:
        raise BadInputError(
            f"machine {machine!r}: bytes that are no text in UTF-8; expected a short name, such as "
            "its serial number"
        ) from None
    if not machine or machine in (".", "..") or len(quoted) > _LONGEST:
        raise BadInputError(
            f"machine {machine[:_LONGEST]!r}; expected a short name, such as its serial number"
        )
    return machine


def iso_day(day: str) -> str:
    """Return a day as an ISO date.

    Raises:
        BadInputError: if it is not a date.
    """
    try:
        return datetime.fromisoformat(day).date().isoformat()
    except ValueError:
        raise BadInputError(f"day {day!r}; expected an ISO date such as 2026-11-03") from None


def _checksum(content: bytes) -> str:
    """Return the checksum of a file's bytes, or of rows as bytes."""
    return hashlib.sha256(content).hexdigest()[:_DIGITS]
