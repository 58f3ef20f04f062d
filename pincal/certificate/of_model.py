"""The certificate of a calibrated robot: its ``model.json`` and the ``result.json`` beside it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
from msgspec import UNSET

from pincal.calibration.check_record import record_of, record_path
from pincal.calibration.elsewhere import position_covariances
from pincal.calibration.fitted_robot import FittedRobot, load_model
from pincal.calibration.model_statement import COVERAGE_FACTOR
from pincal.calibration.result import ResultFile
from pincal.certificate.contents import (
    NOT_STATED,
    Budget,
    BudgetLine,
    Certificate,
    Figure,
    FigureGroup,
    Issue,
    Range,
    checksums_of_inputs,
)
from pincal.discover.discovery_file import Findings
from pincal.discover.report.found_words import effect_words
from pincal.errors import BadInputError
from pincal.export.formulas import sides_following
from pincal.identity import Identity
from pincal.io.result_folder import file_hash
from pincal.io.strict_json import FileKind, read_json
from pincal.model.conditions import Conditions
from pincal.notes import Note, doubts_of
from pincal.report.report_numbers import REPORT
from pincal.report.words import noise_origin, noise_words
from pincal.sensors.registry import is_held
from pincal.thresholds import Count
from pincal.units import readable_unit, show_measured
from pincal.validate.misfit import Verdict, worst

# Poses over which the uncertainty is averaged, more of which change it by a per cent, and their
# seed.
_POSES: Count = 400
_SEED: Count = 0
_RESULT = "result.json"
_RESULT_FILE = FileKind(
    "a result.json", BadInputError, "take the file from a backup or run pincal calibrate again"
)
_DISCOVERY = "discovery.json"
_DISCOVERY_FILE = FileKind(
    "a discovery.json", BadInputError, "take the file from a backup or run pincal discover again"
)
_STATISTICS = {"mean": "mean", "rms": "root mean square", "p95": "95 % of the rows", "max": "worst"}
_WAYS = {
    "regions": "each row predicted by a fit without its region of joint space",
    "stretches": "each row predicted by a fit without its stretch of consecutive rows",
    "sessions": "each row predicted by a fit without its session",
    "random": "each row predicted by a fit without it and others at random",
    "held out": "rows that no fit has used",
    "station": "each station predicted by the others",
}
_UNCERTAINTY = "Uncertainty of predicted positions"
# What is said of positions where readings leave open where the base stands.
_RELATIVE = (
    "of positions once base and target are located, as the readings do not tell where the base "
    "stands"
)
_LENGTHS_HELD = (
    "the lengths of links are those of the robot's description, and their errors are not included"
)
# Sources that are known otherwise than by statistics of the readings.
_TYPE_B = {"conditions", "temperature"}


def certificate_of_model(path: Path, stated: Identity, issue: Issue) -> Certificate:
    """Return the certificate of a calibrated robot.

    Args:
        path: its ``model.json``; figures are those of the ``result.json`` in the same folder.
        stated: what is stated in addition to the model's own identity.
        issue: number and day of the certificate.

    Raises:
        ModelFileError: if the model can't be read.
        BadInputError: if there is no ``result.json`` beside it, or it can't be read; or if the
            model is of another robot than stated.
    """
    if _is_mended(path):
        return _certificate_of_mended(path, stated, issue)
    of = _Calibrated.read(path)
    fitted = of.fitted
    stated.require(fitted.identity, str(path))
    robot = _placed(fitted)
    budget, lacking = _budget_of(robot)
    alarms, checks, files = _of_checks(fitted, path)
    return Certificate(
        title="Calibration certificate of a robot",
        issue=issue,
        item=robot.model.chain.robot.name,
        identity=stated.over(fitted.identity.over(issue.usual)),
        ranges=tuple(_ranges(robot)),
        facts=_facts(fitted, of.result) | of.searched | checks | lacking,
        verdict=of.verdict.value,
        doubts=(*of.doubts, *alarms),
        groups=tuple(_groups(robot, of.result, budget)),
        budget=budget,
        lengths=source_of_lengths(fitted),
        files=of.files | files,
        versions={
            "calibrated with pincal": str(fitted.provenance.get("pincal", NOT_STATED)),
            "certificate by pincal": version("pincal"),
        },
    )


def _placed(fitted: FittedRobot) -> FittedRobot:
    """Return the robot at the first station whose readings tell where its base stands, or at the
    first.
    """
    kinds = (station.sensor_kind for station in fitted.stations if station.is_placed)
    return fitted.robot_model(next(kinds, None))


def _is_mended(path: Path) -> bool:
    """Return whether a model is of update or diagnose, which write no ``result.json``."""
    if path.with_name(_RESULT).is_file() or not path.is_file():
        return False
    words = str(load_model(path).provenance.get("command", "")).split()
    return words[1:2] in (["update"], ["diagnose"])


def _certificate_of_mended(path: Path, stated: Identity, issue: Issue) -> Certificate:
    """Return the certificate of the model of update or diagnose: what it says of itself, and what
    it is from; errors were not stated of it.
    """
    fitted = load_model(path)
    stated.require(fitted.identity, str(path))
    robot = _placed(fitted)
    budget, lacking = _budget_of(robot)
    said = fitted.statement
    command = str(fitted.provenance.get("command", "")).split()[1]
    alarms, checks, files = _of_checks(fitted, path)
    facts = {
        "arm": f"{robot.model.chain.robot.base} to {robot.model.chain.robot.tip}",
        "made by": f"pincal {command}, of an earlier calibration and new rows",
        "validation": "none of its own: validate tells the errors at rows that were not fitted",
        "rests on": "" if said is None else str(said.rests_on),
    }
    figures = tuple(_combined(budget))
    return Certificate(
        title="Calibration certificate of a robot",
        issue=issue,
        item=robot.model.chain.robot.name,
        identity=stated.over(fitted.identity.over(issue.usual)),
        ranges=tuple(_ranges(robot)),
        facts={name: text for name, text in facts.items() if text} | checks | lacking,
        verdict=(Verdict.NOT_JUDGED if said is None else said.verdict).value,
        doubts=(*(() if said is None else said.doubts), *alarms),
        groups=(FigureGroup(title=_UNCERTAINTY, figures=figures, remark=_remark(robot)),)
        if figures
        else (),
        budget=budget,
        files={path.name: file_hash(path)} | files | checksums_of_inputs(fitted.provenance),
        versions={
            "calibrated with pincal": str(fitted.provenance.get("pincal", NOT_STATED)),
            "certificate by pincal": version("pincal"),
        },
    )


def _of_checks(
    fitted: FittedRobot, path: Path
) -> tuple[tuple[str, ...], dict[str, str], dict[str, str]]:
    """Return the doubt of a last check that raised an alarm, what the last check found, and the
    checksum of their record.
    """
    place = record_path(path)
    record, _ = record_of(fitted, place)
    last = None if record is None else record.last
    withdrawn = "" if record is None else record.withdrawn_words
    beside = {"withdrawn checks": withdrawn} if withdrawn else {}
    if last is None:
        files = {place.name: file_hash(place)} if withdrawn else {}
        return (), {"interim checks": "none", **beside}, files
    alarm = (f"the last interim check raised an alarm: {last.words}",) if last.has_failed else ()
    drift = f"drift since the calibration u = {last.drift * 1e3:.2g} mm a coordinate"
    facts = {"interim checks": f"{last.words}; {drift}", **beside}
    return alarm, facts, {place.name: file_hash(place)}


@dataclass(frozen=True)
class _Calibrated:
    """What a folder of results says of a robot.

    Attributes:
        path: its ``model.json``.
        fitted: the robot.
        result: its result.
        search: what a search for missing effects found; None if there was none.
    """

    path: Path
    fitted: FittedRobot
    result: ResultFile
    search: Findings | None

    @classmethod
    def read(cls, path: Path) -> _Calibrated:
        """Read the files beside a ``model.json``, and refuse those of another model, as of two that
        were saved into one folder by hand.
        """
        fitted = load_model(path)
        beside = path.with_name(_RESULT)
        if not beside.is_file():
            raise BadInputError(
                f"{beside}: not there; a certificate states the figures of the calibration: give "
                "the model in the folder that calibrate or discover wrote"
            )
        result = read_json(beside, ResultFile, _RESULT_FILE)
        if {parameter.name for parameter in result.parameters} != set(fitted.estimate.names):
            raise BadInputError(
                f"{beside}: its parameters are not those of the model beside it; expected the "
                "result of the same calibration: calibrate again into a folder of its own"
            )
        found = path.with_name(_DISCOVERY)
        search = read_json(found, Findings, _DISCOVERY_FILE) if found.is_file() else None
        return cls(path, fitted, result, search)

    @property
    def verdict(self) -> Verdict:
        """The verdict on the fit or, if it is worse, on the search."""
        found = [self.result.verdict]
        found += [] if self.search is None else [self.search.verdict]
        return worst(found)

    @property
    def doubts(self) -> tuple[str, ...]:
        """The doubts of fit and search, each once."""
        notes = [note for note in self.result.warnings if isinstance(note, Note)]
        notes += () if self.search is None else self.search.warnings
        return tuple(dict.fromkeys(doubt.text for doubt in doubts_of(notes)))

    @property
    def files(self) -> dict[str, str]:
        """Checksums of the files read, and of what the robot was calibrated from."""
        names = [self.path.name, _RESULT, *([] if self.search is None else [_DISCOVERY])]
        own = {name: file_hash(self.path.with_name(name)) for name in names}
        return own | checksums_of_inputs(self.fitted.provenance)

    @property
    def searched(self) -> dict[str, str]:
        """What a search for missing effects found, in words."""
        if self.search is None:
            return {"search": "none for effects that the model lacks"}
        effects = ", ".join(map(effect_words, self.search.effects)) or "no effect"
        left = self.search.unexplained_mm
        rest = f"{left:.4f} mm unexplained" if left >= REPORT.beyond_noise else "the rest is noise"
        return {"search": f"{effects} found; {rest}"}


def _budget_of(robot: FittedRobot) -> tuple[Budget | None, dict[str, str]]:
    """Return the budget, or None and the fact why there is none: what an effect needs of each pose,
    such as the time since its last move, random poses have not.
    """
    try:
        found = position_budget(robot)
    except BadInputError as error:
        return None, {"budget": f"none: {error}"}
    return (found, {}) if found.lines else (None, {"budget": "none: no uncertainty is known"})


def position_budget(robot: FittedRobot) -> Budget:
    """Return the standard uncertainty of one coordinate of predicted positions by its sources, root
    mean squares over poses within the range of the calibration [mm].

    Where readings leave open where the base stands, it is that of the positions once base and
    target are located, as the errors are that the calibration states.

    Raises:
        BadInputError: if an effect needs of each pose what is not kept with the model.
    """
    covariances = position_covariances(robot, _covered_poses(robot))
    squares = {
        source: float(np.mean(np.einsum("naa->na", found))) for source, found in covariances.items()
    }
    total = sum(squares.values())
    lines = [
        BudgetLine(
            source=source,
            type="B" if source in _TYPE_B else "A",
            standard=1e3 * math.sqrt(square),
            degrees=None,
            share=square / total if total else 0.0,
        )
        for source, square in squares.items()
        if square > 0.0
    ]
    return Budget(
        of="one coordinate of a predicted position, root mean square over poses within the "
        "measured range of every joint",
        unit="mm",
        lines=tuple(sorted(lines, key=lambda line: -line.share)),
    )


def _covered_poses(robot: FittedRobot) -> Conditions:
    """Return random poses within the ranges of the calibration's rows."""
    arm = robot.model.chain.robot
    covered = robot.covered
    rng = np.random.default_rng(_SEED)
    lower, upper = covered.q[arm.own_joints].T
    q = arm.spread(lower + (upper - lower) * rng.random((_POSES, len(lower))))
    found = Conditions.at(q, payload_centre=robot.payload_centre)
    return replace(
        found,
        payload=rng.uniform(covered.payload[0], covered.payload[1], _POSES),
        approach=sides_following(arm, rng.choice([-1, 1], q.shape)),
    )


def _ranges(robot: FittedRobot) -> Iterator[Range]:
    """Yield what the calibration's rows cover."""
    arm = robot.model.chain.robot
    covered = robot.covered
    for name, unit, (lower, upper) in zip(arm.joint_names, arm.joint_units, covered.q, strict=True):
        factor = 180.0 / math.pi if unit == "rad" else 1e3
        shown = "deg" if unit == "rad" else "mm"
        yield Range(name=name, lower=lower * factor, upper=upper * factor, unit=shown)
    yield Range(
        name="payload",
        lower=float(covered.payload[0]),
        upper=float(covered.payload[1]),
        unit="kg",
    )
    if "temperature" in covered.days:
        mean, deviation = covered.days["temperature"]
        k = COVERAGE_FACTOR
        yield Range(
            name="temperature",
            lower=mean - k * deviation,
            upper=mean + k * deviation,
            unit="deg C",
        )


def _facts(fitted: FittedRobot, result: ResultFile) -> dict[str, str]:
    """Return the scope and the method, by names."""
    chain = fitted.stations[0].model.chain
    kinds = dict.fromkeys(station.sensor_kind for station in fitted.stations)
    effects = dict.fromkeys(
        effect.name for station in fitted.stations for effect in station.model.effects
    )
    found = {
        "arm": f"{chain.robot.base} to {chain.robot.tip}",
        "targets": ", ".join(chain.targets),
        "stations": ", ".join(fitted.names) if len(fitted.names) > 1 else "",
        "measured": f"{result.rows['train']} rows of {', '.join(kinds)}",
        "method": f"least squares on all rows; effects: {', '.join(effects)}",
        "validation": _validation(result),
        "noise": f"{noise_words(result.noise)} ({noise_origin(result.noise)})",
        "rests on": "" if result.uncertainty is UNSET else result.uncertainty.rests_on,
    }
    return {name: text for name, text in found.items() if text}


def source_of_lengths(fitted: FittedRobot) -> str:
    """Return what gives the unit of length where the arm was held in sockets alone, or only an IMU
    was on it; empty if an instrument read it, or the sockets.
    """
    if fitted.holds_lengths and not any(station.is_placed for station in fitted.stations):
        return "its description, as no reading tells them"
    setups = [station.setup for station in fitted.stations if is_held(station.sensor_kind)]
    is_measured = any(place is not None for setup in setups for place in setup.points.values())
    if len(setups) < len(fitted.stations) or is_measured:
        return ""
    # A distance between sockets in which the arm was not held tells nothing of it.
    given = dict.fromkeys(distance for setup in setups for distance in setup.named().distances)
    if not given:
        return "its description: no distance between sockets was given"
    listed = ", ".join(
        f"{one.first} to {one.second} "
        f"{show_measured(one.length, one.sigma, readable_unit('m'))} mm (95 %)"
        for one in given
    )
    return f"the distances between sockets as given: {listed}"


def _validation(result: ResultFile) -> str:
    """Return in words by what rows the errors are stated."""
    if result.validation is UNSET:
        return "none: the errors are those of the fitted rows"
    folds = f" ({result.validation.folds} folds)" if result.validation.folds else ""
    return _WAYS[result.validation.way] + folds


def _groups(robot: FittedRobot, result: ResultFile, budget: Budget | None) -> Iterator[FigureGroup]:
    """Yield the figures."""
    part = "test" if "test" in result.error["calibrated"] else "train"
    rows = result.rows["test" if part == "test" else "train"]
    seen = "not fitted" if part == "test" else "fitted"
    for model, title in (
        ("calibrated", "Error of the calibrated robot"),
        ("nominal", "Error of the nominal robot, base and tool fitted"),
    ):
        is_stated = model == "calibrated" and part == "test"
        intervals = {} if result.intervals is UNSET or not is_stated else result.intervals
        figures = tuple(_statistics(result.error[model][part], intervals))
        if figures:
            yield FigureGroup(title=title, figures=figures, remark=f"{rows} rows, {seen}")
    figures = (*_stated(result), *_combined(budget), *_elsewhere(result), *_improved(result))
    if figures:
        yield FigureGroup(title=_UNCERTAINTY, figures=figures, remark=_remark(robot))


def _remark(robot: FittedRobot) -> str:
    """Return how the uncertainties of positions are to be read."""
    said = ["U: of one coordinate, root mean square, without noise of new readings"]
    said += [] if robot.station.is_placed else [_RELATIVE]
    said += [_LENGTHS_HELD] if robot.holds_lengths else []
    return "; ".join(said)


def _combined(budget: Budget | None) -> Iterator[Figure]:
    """Yield the uncertainty that a budget adds up to."""
    if budget is not None:
        k = COVERAGE_FACTOR
        combined = math.sqrt(sum(line.standard**2 for line in budget.lines))
        name = f"U (k = {k:g}) over the measured ranges"
        yield Figure(name=name, value=k * combined, unit=budget.unit)


def _improved(result: ResultFile) -> Iterator[Figure]:
    """Yield how well positions are known of a robot that no instrument measured, at the measured
    poses and in the worst region, as its report has it.
    """
    if result.improvement is UNSET:
        return
    for link in dict.fromkeys(region.link for region in result.improvement):
        measured, *elsewhere = (region for region in result.improvement if region.link == link)
        worst_region = max(elsewhere, key=lambda region: region.after_mm, default=measured)
        for region in dict.fromkeys((measured, worst_region)):
            name = f"position of {link} (3D, k = 1), {region.region}"
            yield Figure(name=name, value=region.after_mm, unit="mm")


def _stated(result: ResultFile) -> Iterator[Figure]:
    """Yield the uncertainty that the calibration states."""
    if result.uncertainty is UNSET:
        return
    known = result.uncertainty
    yield Figure(name=f"U (k = {known.k:g}) at the measured poses", value=known.here_mm, unit="mm")
    yield Figure(
        name=f"U (k = {known.k:g}) within the joint limits", value=known.anywhere_mm, unit="mm"
    )


def _statistics(
    error: Mapping[str, float], intervals: Mapping[str, tuple[float | None, float | None]]
) -> Iterator[Figure]:
    """Yield the statistics of errors, with their intervals where these are known."""
    for unit in dict.fromkeys(statistic.split("_", 1)[1] for statistic in error):
        for key, name in _STATISTICS.items():
            statistic = f"{key}_{unit}"
            if statistic in error:
                yield Figure(
                    name=name,
                    value=error[statistic],
                    unit=unit,
                    interval=intervals.get(statistic),
                )


def _elsewhere(result: ResultFile) -> Iterator[Figure]:
    """Yield the error that the model expects anywhere."""
    if result.elsewhere is UNSET:
        return
    where = result.elsewhere.over or "the joint limits"
    yield Figure(name=f"expected within {where}, mean", value=result.elsewhere.mean_mm, unit="mm")
    yield Figure(name=f"expected within {where}, worst", value=result.elsewhere.worst_mm, unit="mm")
