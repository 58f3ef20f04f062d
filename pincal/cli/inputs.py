"""From files and typed arguments of the command line to the library's objects: tables, options,
models with placement.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import click
import numpy as np
from msgspec import to_builtins

from pincal.calibration.fitted_robot import FittedRobot, load_model
from pincal.calibration.located import located
from pincal.calibration.placing import place_station, without_absent
from pincal.calibration.validation import doubt_of
from pincal.cli.common import (
    CalibrationOptions,
    InputOptions,
    LinkOptions,
    PlaceOptions,
    SetupOptions,
    tip_or_to,
)
from pincal.cli.progress import log_step
from pincal.cli.robot_priors import load_prior
from pincal.cli.streams import Streams, no_streams
from pincal.errors import (
    BadInputError,
    ChangedRobotError,
    MeasurementError,
    RobotFileError,
    counted,
    nearest_first,
)
from pincal.identify.options import Options, StationOptions
from pincal.identify.station import conditions_of
from pincal.io.camera_file import read_camera
from pincal.measure.admit import check_table, usable_rows
from pincal.measure.instruments import InstrumentNoise
from pincal.measure.log_reader import joints_of_log
from pincal.measure.measurements import Measurements
from pincal.measure.points_table import read_distances, read_points
from pincal.measure.reader import links_of_rows, nearly_named, of_path
from pincal.measure.table import joint_columns, read_measurements, stations_of
from pincal.measure.table_schema import TableOptions
from pincal.model.catalogue.candidates import find_effect
from pincal.model.chain import Chain
from pincal.model.effect import Effect
from pincal.model.model import Model
from pincal.robot.arm_of_tree import TreeRequest
from pincal.robot.cell import NOWHERE, read_cell, robot_files
from pincal.robot.mastering import remastered
from pincal.robot.robot import Robot
from pincal.robot.se3 import transform
from pincal.robot.tree import MOVING_TYPES, UrdfTree
from pincal.sensors.setup import KnownDistance, Setup
from pincal.thresholds import Scale
from pincal.units import readable_unit

# Distance of two sockets in which one arm was held, in units of its reach, that none has: with a
# long tool in opposite directions it is hardly more than 2.
_FAR: Scale = 3.0


@dataclass(frozen=True)
class Prepared:
    """Robot, measurements and options of a command.

    Attributes:
        robot: the arm.
        tables: the measurements of each station by its name; a single station may have any name.
        options: how to calibrate.
        files: all input files, for the provenance of the result.
    """

    robot: Robot
    tables: dict[str, Measurements]
    options: Options
    files: tuple[Path, ...]

    @property
    def table(self) -> Measurements:
        """The measurements of the only station.

        Raises:
            BadInputError: if there are several.
        """
        if len(self.tables) > 1:
            raise BadInputError(
                f"there are several stations: {', '.join(self.tables)}; expected one: "
                "give one table"
            )
        return next(iter(self.tables.values()))


def prepare(source: InputOptions, chosen: CalibrationOptions) -> Prepared:
    """Load robot, tables and measurement setup.

    Raises:
        BadInputError: for a file or an option that is invalid.
    """
    source.motion.check(source.table.joints, source.data)
    log_step("reading robot and tables")
    unplaced = replace(
        source, beside=tuple(replace(of, place=of.place or NOWHERE) for of in source.beside)
    )
    robot = load_robot(unplaced)
    tables = load_tables(
        robot, source.data, options=source.table.options, links=source.links, motion=source.motion
    )
    tables = {name: with_payload(table, source.payload) for name, table in tables.items()}
    options = options_of(chosen, tables)
    _refuse_far(options, robot, tables)
    if unplaced.beside != source.beside:
        robot = load_robot(replace(source, beside=located(robot, source.beside, tables, options)))
    effects = named_effects(chosen.fit.add, options, robot=robot, tables=tables)
    options = replace(options, effects=(*options.effects, *effects))
    if chosen.fit.type is not None:
        options = replace(
            options, earlier=load_prior(chosen.fit.type).prior_of(robot, options.effects)
        )
    return Prepared(robot, tables, options, _input_files(source, chosen, robot))


def with_payload(table: Measurements, payload: float | None) -> Measurements:
    """Return a table with the mass at the tip [kg] in all rows, unless it states its own."""
    if payload is None or table.payload is not None:
        return table
    return replace(table, payload=np.full(len(table), payload))


def _input_files(
    source: InputOptions, chosen: CalibrationOptions, robot: Robot
) -> tuple[Path, ...]:
    """Return all files that a command line names, and those of the robot."""
    setup = chosen.setup
    named = (
        source.table.joints,
        *source.motion.files,
        setup.points,
        setup.distances,
        setup.camera,
        chosen.fit.type,
    )
    return (
        *source.motion.input_files(source.data),
        *(path for path in named if path is not None),
        *robot_files(robot.source, source.beside),
    )


def named_effects(
    texts: Sequence[str], options: Options, *, robot: Robot, tables: Mapping[str, Measurements]
) -> tuple[Effect, ...]:
    """Return the effects that the command line names.

    Raises:
        BadInputError: for an effect that is unknown or that these poses can't show.
    """
    if not texts:
        return ()
    # The station with most columns; the others may lack the one on which the effect depends.
    name, table = max(tables.items(), key=lambda item: len(item[1].columns()))
    chain = Chain.of(robot, targets=tuple(str(target) for target in np.unique(table.target)))
    conditions = conditions_of(Model(chain, ()), table, np.array(options.at(name).payload_centre))
    return tuple(find_effect(text, chain, conditions) for text in texts)


def load_robot(source: InputOptions) -> Robot:
    """Return the arm whose joints are columns of the (first) table."""
    return as_stated(_described(source), signs=source.signs, couplings=source.couplings)


def as_stated(robot: Robot, *, signs: Sequence[str], couplings: Sequence[str]) -> Robot:
    """Return the robot with the signs and couplings of reported positions that the command line
    states.
    """
    robot = remastered(robot, turned=signs) if signs else robot
    return robot.with_couplings(*couplings) if couplings else robot


@dataclass(frozen=True)
class _Named:
    """Links and joints that the rows of the command line name.

    Attributes:
        paths: the first and the last link of rows, None for the base.
        joints: the joint columns of each file.
    """

    paths: list[tuple[str | None, str | None]]
    joints: list[tuple[str, ...]]

    @classmethod
    def of(cls, source: InputOptions, tree: UrdfTree) -> _Named:
        """Return what the tables, the log of the joints and the options for links name."""
        tip = tip_or_to(source.tip, source.links.to)
        start = source.links.start
        reading = source.table.options
        given = {name: (first, last) for name, first, last in source.links.stations}
        known = {joint.name for joint in tree.joints}
        named = cls([], [])
        files = [*source.data]
        if source.motion.files and reading.joints is not None:
            files = [*files, Path(reading.joints)]
            reading = replace(reading, joints=None)
        for path in files:
            session = joints_of_log(path)
            is_log = session is not None or path not in source.data
            pairs: list[tuple[str | None, str | None]] = [given.get(path.stem, (None, None))]
            if path.stem not in given and not is_log:
                pairs = links_of_rows(path, reading)
            way = _movable_above(tree, [last or tip for _, last in pairs])
            log = session or path
            columns = joint_columns(log, known, of_path(log, way, reading))
            named.joints.append(columns)
            # By default, the end of the chain whose joints are columns of the table.
            named.add(
                [
                    (first or start, last or tip or tree.default_tip(columns or None))
                    for first, last in pairs
                ]
            )
        named.add(given.values())
        return named

    def add(self, paths: Iterable[tuple[str | None, str | None]]) -> None:
        """Add paths that are not named yet."""
        self.paths.extend([pair for pair in paths if pair not in self.paths])

    def check(self, start: str | None, tip: str | None) -> None:
        """Refuse a link for all rows, of ``--from`` or ``--to``, that none of them has."""
        for option, link, named in (
            ("--from", start, [pair[0] for pair in self.paths]),
            ("--to", tip, [pair[1] for pair in self.paths]),
        ):
            if link is not None and link not in named:
                raise BadInputError(
                    f"{option} {link}, but the rows have {', '.join(map(str, named))}; leave "
                    "one of them out"
                )


def _movable_above(tree: UrdfTree, tips: Iterable[str | None]) -> list[str]:
    """Return the joints that move these links, None being no link."""
    above = [joint for tip in tips if tip for joint in tree.above(tip)]
    return [joint.name for joint in above if joint.kind in MOVING_TYPES]


def _described(source: InputOptions) -> Robot:
    """Return the robot of the URDF: the joints between the links of the tables."""
    tree = read_cell(source.robot, source.beside, xacro_args=dict(source.xacro_args))
    tip = tip_or_to(source.tip, source.links.to)
    named = _Named.of(source, tree)
    named.check(source.links.start, tip)
    movable = [joint.name for joint in tree.joints if joint.kind in MOVING_TYPES]
    rested = [name for name, _ in source.links.rest]
    if unknown := [name for name in rested if name not in movable]:
        raise BadInputError(
            f"--rest {unknown[0]}; expected one of "
            f"{', '.join(nearest_first(unknown, movable)[:12])}"
        )
    (first, last), *others = named.paths
    if not others and first is None and not tip:
        on_way = [joint.name for joint in tree.above(str(last)) if joint.name in rested]
        wanted = TreeRequest(
            base=source.base, joints=(*named.joints[0], *on_way) or None, others=rested
        )
        return _without_slip(_arm_of(tree, wanted, source), tree, source)
    base = source.base or tree.root
    recorded = tuple(dict.fromkeys(name for columns in named.joints for name in columns))
    wanted = TreeRequest(
        last,
        first,
        source.base,
        recorded if tree.loops else None,
        paths=[(start or base, str(end)) for start, end in others],
        others=[name for name in (*recorded, *rested) if name in movable],
    )
    return _arm_of(tree, wanted, source)


def _arm_of(tree: UrdfTree, wanted: TreeRequest, source: InputOptions) -> Robot:
    """Return the robot, and name the column that may be misspelt where loops lack the reading of a
    drive.
    """
    try:
        return Robot.from_tree(tree, wanted, mass=source.mass)
    except RobotFileError as error:
        moving = [joint.name for joint in tree.joints if joint.kind in MOVING_TYPES]
        found = _slip(moving, tree, source) if tree.loops else None
        if found is None or found[1] not in str(error):
            raise
        raise RobotFileError(f'{error} (is it "{found[0]}" of {source.data[0].name}?)') from None


def _slip(joints: Sequence[str], tree: UrdfTree, source: InputOptions) -> tuple[str, str] | None:
    """Return a column of the table that is of no joint and nearly that of one of some joints, and
    this joint; None if there is none.
    """
    if not source.data or not joints or joints_of_log(source.data[0]) is not None:
        return None
    known = [joint.name for joint in tree.joints]
    return nearly_named(source.data[0], joints, source.table.options, known=known)


def _without_slip(robot: Robot, tree: UrdfTree, source: InputOptions) -> Robot:
    """Return the robot unless the name of a joint above its base is misspelt in the table: without
    its column the joint would be taken to stand still.

    Raises:
        MeasurementError: with the column and the joint.
    """
    if source.base is not None:
        return robot
    above = [joint.name for joint in tree.above(robot.base) if joint.kind in MOVING_TYPES]
    if (found := _slip(above, tree, source)) is not None:
        raise MeasurementError(
            f'{source.data[0].name}: no column for joint "{found[1]}" (is it "{found[0]}"?); '
            f"expected a column named as in the URDF, or --base {robot.base} if that joint stood "
            "still"
        )
    return robot


def load_tables(
    robot: Robot,
    paths: Iterable[Path],
    *,
    options: TableOptions | None = None,
    links: LinkOptions | None = None,
    motion: Streams | None = None,
) -> dict[str, Measurements]:
    """Return the measurements of each station, named after its file or by a column ``station``.

    Sessions in motion are named after the folder and the instrument.

    Raises:
        BadInputError: for a file that is invalid, or two stations of one name; or if a joint on the
            way between the links of a row has no column.
    """
    links = links or LinkOptions()
    reading = options or TableOptions()
    paths = tuple(paths)
    streams = motion or no_streams()
    moving, held = streams.tables(robot, paths, reading)
    if streams.files:
        reading = replace(reading, joints=None)
    if len(held) > 1:
        reading = replace(reading, shares_log=True)
    tables = [(path.stem, load_table(robot, path, options=reading, links=links)) for path in held]
    stations = {path.stem for path in paths}.union(
        *(of.station.tolist() for _, of in tables if of.station is not None)
    )
    if unknown := [name for name, *_ in links.stations if name not in stations]:
        known = ", ".join(nearest_first(unknown, stations))
        raise BadInputError(
            f"--station {unknown[0]}:FROM:TO: no table or station of this name; expected "
            f"one of {known}"
        )
    return stations_of(
        [*((name, _between(table, name, links)) for name, table in tables), *moving.items()]
    )


def _between(table: Measurements, name: str, links: LinkOptions) -> Measurements:
    """Return a table with the links given on the command line for its rows."""
    names = np.full(len(table), name) if table.station is None else table.station
    for station, start, tip in links.stations:
        if (rows := (names == station) | (name == station)).any():
            table = _with_links(table, rows, start, tip)
    return table


def _with_links(table: Measurements, rows: np.ndarray, start: str, tip: str) -> Measurements:
    """Return a table with these links in some rows, shape (N,)."""
    nothing = np.full(len(table), "", object)
    first, last = (
        nothing if of is None else of.astype(object) for of in (table.from_link, table.to_link)
    )
    return replace(
        table,
        from_link=np.where(rows, start, first).astype(str),
        to_link=np.where(rows, tip, last).astype(str),
    )


@dataclass(frozen=True)
class _RowLinks:
    """Between which links of a robot with several arms the rows of a table are.

    Attributes:
        pairs: the first and the last link of rows, None for those of the robot.
        starts: the first link of rows that name the last one alone, by this.
        of_all: the links of all rows, of a table that names none.
    """

    pairs: Sequence[tuple[str | None, str | None]] = ((None, None),)
    starts: Mapping[str, str] = field(default_factory=dict)
    of_all: tuple[str, str] | None = None

    @classmethod
    def of(
        cls, robot: Robot, pairs: Sequence[tuple[str | None, str | None]], there: Collection[str]
    ) -> _RowLinks:
        """Return the links of rows that name these, of a table with these joints."""
        if list(pairs) == [(None, None)]:
            return cls._of_nameless(robot, there)
        if not any(start is None and tip is not None for start, tip in pairs):
            return cls(pairs)
        # Rows that name the hand alone are from the model's other hand, or from the base.
        ends = {tip: _only_start(robot, tip, there) for start, tip in pairs if tip and not start}
        starts = {tip: start for tip, start in ends.items() if start}
        return cls([(start or starts.get(str(tip)), tip) for start, tip in pairs], starts)

    @classmethod
    def _of_nameless(cls, robot: Robot, there: Collection[str]) -> _RowLinks:
        """Return the first arm whose joints are all columns of a table."""
        own = (robot.path.start, robot.tip)
        # An arm that was calibrated by contacts may also be measured by an instrument at the base.
        ends = dict.fromkeys(end for pair in (own, *robot.links) for end in pair)
        from_base = ((robot.base, end) for end in ends if end != robot.base)
        ways = (own, *robot.links, *from_base)
        found = next(
            (way for way in ways if set(there).issuperset(robot.joints_between(*way))), None
        )
        if found is None:
            return cls()
        # Between two hands, rows with the joints of both may be of either: what they fit decides.
        is_open = found == own and robot.path.start != robot.base
        return cls([found], of_all=None if is_open else found)

    def named_in(self, table: Measurements) -> Measurements:
        """Return a table whose rows name the links."""
        for tip, start in self.starts.items():
            assert table.to_link is not None
            table = _with_links(table, table.to_link == tip, start, tip)
        if self.of_all is None:
            return table
        return _with_links(table, np.ones(len(table), bool), *self.of_all)


def load_table(
    robot: Robot,
    path: Path,
    *,
    options: TableOptions | None = None,
    joints_only: bool = False,
    links: LinkOptions | None = None,
) -> Measurements:
    """Return the measurements (or the joint positions alone) of a file for this robot.

    Without links, a table of a robot with several arms is about the first arm of which it has all
    joint columns.
    """
    require: Literal["measurement", "joints"] = "joints" if joints_only else "measurement"
    reading = options or TableOptions()
    links = links or LinkOptions()
    between = _RowLinks()
    if robot.links or robot.path.start != robot.base:
        given = [(start, tip) for name, start, tip in links.stations if name == path.stem]
        pairs = given or links_of_rows(path, reading)
        there = set(joint_columns(path, robot.joint_names, reading))
        between = _RowLinks.of(robot, pairs, there)
    needed = {name for pair in between.pairs for name in robot.joints_between(*pair)}
    own = [robot.joint_names[i] for i in robot.own_joints]
    resting = {name: 0.0 for name in own if name not in needed} | dict(links.rest)
    reading = of_path(path, needed, reading)
    table = read_measurements(path, robot, **vars(reading), require=require, resting=resting)
    return between.named_in(table)


def _only_start(robot: Robot, tip: str, there: Collection[str]) -> str | None:
    """Return the link from which rows of a hand are, of the start of the model's path and the base,
    by the joints that they have; None if they have those of both ways.
    """
    ends = dict.fromkeys((robot.path.start, robot.base))
    whole = [
        start
        for start in ends
        if start != tip and set(there).issuperset(robot.joints_between(start, tip))
    ]
    return whole[0] if len(whole) == 1 else None


def options_of(chosen: CalibrationOptions, tables: Mapping[str, Measurements]) -> Options:
    """Return the calibration's options from those of the command line.

    Raises:
        BadInputError: if no station has readings in the unit of the given noise.
    """
    setup = chosen.setup
    fit = chosen.fit
    listed = () if setup.distances is None else read_distances(setup.distances)
    _refuse_unused(setup, tables)
    return replace(
        chosen.model.options(None, setup.noise_angle),
        equilibrium=fit.equilibrium,
        stages=fit.stages,
        loss=fit.loss,
        length_bound=fit.length_bound,
        priors=fit.priors,
        zeros=fit.unknown_zeros,
        setup=Setup(
            points={} if setup.points is None else read_points(setup.points),
            distances=(*(KnownDistance(*gap) for gap in setup.gaps), *listed),
            lens=None if setup.camera is None else read_camera(setup.camera).lens(),
            fit_lens=setup.fit_camera,
        ),
        stations={
            name: _known_of(setup, table, alone=len(tables) == 1) for name, table in tables.items()
        },
    )


def _known_of(setup: SetupOptions, table: Measurements, *, alone: bool) -> StationOptions:
    base = (
        np.eye(4)
        if setup.points_in == "base" and (alone or table.point_names is not None)
        else None
    )
    if setup.anchor and (alone or table.distance is not None):
        base = transform(np.eye(3), -np.array(setup.anchor))
    mount = (
        read_camera(setup.camera).T_tip_camera
        if setup.camera and table.sensor and table.sensor.has_camera
        else None
    )
    if mount is not None and not (table.sensor and table.sensor.is_on_tool):
        raise BadInputError(
            f"{setup.camera}: T_tip_camera, but {table.source} is from a fixed camera; remove it"
        )
    is_place = table.sensor is None or table.sensor.reads_place
    known: tuple[float, float, float] | np.ndarray | None = (
        (setup.tool if is_place else None) if mount is None else mount
    )
    tools = None if known is None else {str(table.target[0]): known}
    sigma = (
        setup.noise[0]
        if setup.noise and table.sensor and setup.noise[1] == table.sensor.blocks[0].unit
        else None
    )
    is_by_range = setup.instrument is not None and table.position is not None
    instrument = InstrumentNoise.of(str(setup.instrument)) if is_by_range else None
    return StationOptions(sigma=sigma, base=base, tools=tools, instrument=instrument)


def _refuse_unused(setup: SetupOptions, tables: Mapping[str, Measurements]) -> None:
    """Refuse a camera, an instrument or a unit of noise that no station has."""
    held = " and ".join(f"{table.source} holds {table.kind}" for table in tables.values())
    if setup.camera and not any(
        table.sensor and table.sensor.has_camera for table in tables.values()
    ):
        raise BadInputError(f"--camera is for camera readings, but {held}; leave it out")
    if setup.instrument and setup.noise and setup.noise[1] == "m":
        raise BadInputError(
            "--instrument and --noise: both declare the noise of positions; expected one of the two"
        )
    if setup.instrument and all(table.position is None for table in tables.values()):
        raise BadInputError(
            f"--instrument is for positions in the instrument's frame, but {held}; leave "
            "it out, give --noise"
        )
    sensors = [table.sensor for table in tables.values() if table.sensor is not None]
    if (
        setup.noise
        and sensors
        and setup.noise[1] not in {sensor.blocks[0].unit for sensor in sensors}
    ):
        block = sensors[0].blocks[0]
        factor, name = readable_unit(block.unit)
        example = f"{block.noise * factor:g}{name}"
        raise BadInputError(
            f"--noise in {setup.noise[1]}, but {held}; expected a value such as {example}"
        )


def _refuse_far(options: Options, robot: Robot, tables: Mapping[str, Measurements]) -> None:
    """Refuse given distances between sockets that the arm does not span, such as of a number in
    millimetres.

    Raises:
        BadInputError: naming the distance.
    """
    held = [np.unique(table.socket) for table in tables.values() if table.socket is not None]
    touched = {str(name) for names in held for name in names}
    for given in options.setup.distances:
        if {given.first, given.second} <= touched and given.length > _FAR * robot.reach:
            raise BadInputError(
                f"--socket-distance {given.first} {given.second}: {given.length:g} m, which "
                f"{robot.name} of {robot.reach:.1f} m reach can't have touched; a number without a "
                f"unit is in metres: write {given.length:g}mm if millimetres are meant"
            )


@dataclass(frozen=True)
class PlacedModel:
    """A calibrated model with a placement of instrument and target.

    Attributes:
        model: the model.
        notes: for the user, on the placement, and what the model states of itself.
        contents: how the placement was identified, for ``--json``; empty for one of the
            calibration.
    """

    model: FittedRobot
    notes: tuple[str, ...] = ()
    contents: dict[str, Any] = field(default_factory=dict)

    def stated(self, notes: Iterable[str]) -> PlacedModel:
        """Return it with what it states of its robot, for ``--json``, and notes on that."""
        identity = self.model.identity
        contents = {"id": to_builtins(identity)} if identity else {}
        return PlacedModel(self.model, (*self.notes, *notes), self.contents | contents)

    def over(self, rows: Measurements) -> PlacedModel:
        """Return the model for some rows, without effects of the calibrated station for which they
        lack columns.
        """
        model, notes = without_absent(self.model, rows)
        return PlacedModel(model, (*self.notes, *notes), self.contents)


def find_place(path: Path, chosen: PlaceOptions, reading: TableOptions) -> PlacedModel:
    """Return the model of a file with the placement chosen on the command line.

    Raises:
        BadInputError: if the station is unknown, none of several is chosen, or rows do not
            determine a new one.
        ChangedRobotError: if the rows belong to another robot.
    """
    if chosen.placement is not None and chosen.station is not None:
        raise click.UsageError(
            "--placement identifies a new pose, --station takes one of the model; give one of them"
        )
    if (chosen.start or chosen.to) and (chosen.placement or chosen.station):
        raise click.UsageError(
            "--from and --to refer to links, --placement and --station to an instrument; "
            "use one pair"
        )
    stations = load_model(path)
    first = stations.each[0]
    said = () if stations.statement is None else tuple(stations.statement.notes())
    if chosen.start or chosen.to:
        return PlacedModel(stations.robot_model().between(chosen.start, chosen.to), said)
    if chosen.placement is not None:
        placed = _placed(path, first, chosen.placement, reading)
        return replace(placed, notes=(*said, *placed.notes))
    if chosen.station is not None:
        return PlacedModel(stations.at(chosen.station), said)
    if len(stations.stations) > 1:
        raise BadInputError(
            f"{path}: calibrated at the stations {', '.join(stations.names)}; expected a "
            "choice: --station NAME for one of "
            "them, --placement FEW.csv with some measured rows for a new place, or links "
            "of the robot: --from LINK --to LINK"
        )
    return PlacedModel(first, said)


def _placed(file: Path, model: FittedRobot, path: Path, reading: TableOptions) -> PlacedModel:
    robot = model.model.chain.robot
    table = load_table(robot, path, options=replace(reading, shares_log=True))
    check_table(robot, table, minimum=1)
    table = usable_rows(table, model.setup.over(table))
    found = place_station(model, table)
    if doubt := doubt_of(found):
        raise other_robot(doubt, file)
    words = f"placement from {counted(len(table), 'row')} of {path.name}: {found.moved}"
    contents = {
        "placement": {"rows": len(table), "ratio": found.misfit.ratio} | found.moved.to_dict()
    }
    return PlacedModel(found.model, (words, *found.notes), contents)


def other_robot(doubt: str, path: Path) -> ChangedRobotError:
    """Return the error that rows belong to another robot than the model, or that it has changed,
    with the next step.
    """
    return ChangedRobotError(
        f"{doubt}. They belong to another robot, or it has changed since calibration. "
        "Check joint columns, units "
        f"and times; then find out what changed: pincal diagnose {path} DATA.csv --out DIR"
    )
