"""Fields of position deviations: arrows from nominal or predicted to actual positions of the
target.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.discover.discovery_file import EffectName
from pincal.discover.report.found_words import effect_words
from pincal.errors import BadInputError
from pincal.identify.fit import Priors
from pincal.identify.noise import Noise
from pincal.identify.problem import Problem
from pincal.identify.solve import Course, likeliest_values
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect, Family
from pincal.model.model import Model
from pincal.model.sizes import largest_basis
from pincal.sensors.registry import simulatable
from pincal.sensors.row_samples import evenly
from pincal.thresholds import Count

# Number of poses over which nominal base and tool are fitted to the calibrated robot if there are
# no measurements.
_ENOUGH: Count = 400
# Random poses per cell of the grid, enough that hardly any cell is missed.
_DRAWS: Count = 40
_MOST_DRAWS: Count = 400_000
_PIECE: Count = 20_000
# Bisections in the search for the size of a cell.
_HALVINGS: Count = 16


@dataclass(frozen=True)
class FieldPoses:
    """Poses at which a field is given.

    Attributes:
        name: "measured" or "workspace".
        q: shape (N, n), joint positions [rad or m].
        target: shape (N,), index into the chain's targets.
        lines: shape (N,), line of each row in its file; None for poses from no file.
        held_out: shape (N,), rows that were held out of the fit; None if unknown.
        position: shape (N, 3), measured positions in the instrument's frame [m]; None without
            positions.
    """

    name: str
    q: np.ndarray
    target: np.ndarray
    lines: np.ndarray | None = None
    held_out: np.ndarray | None = None
    position: np.ndarray | None = None


@dataclass(frozen=True)
class Layer:
    """One field of arrows.

    Attributes:
        name: its path in the control tree, such as "deviations/before" or "workspace/explained by
            ...".
        poses: name of the poses at which it is given.
        points: shape (N, 3), tails, in the instrument's frame [m].
        vectors: shape (N, 3), from tail to head [m], true to scale.
        words: meaning of the arrows.
    """

    name: str
    poses: str
    points: np.ndarray
    vectors: np.ndarray
    words: str

    @property
    def sizes(self) -> np.ndarray:
        """Lengths of the arrows, shape (N,) [m]."""
        return np.asarray(np.linalg.norm(self.vectors, axis=1))


@dataclass(frozen=True)
class Fields:
    """All fields of a robot and their poses.

    Attributes:
        layers: the fields, the most important first.
        poses: the poses.
        notes: on what is not shown, and on assumptions.
    """

    layers: tuple[Layer, ...]
    poses: tuple[FieldPoses, ...]
    notes: tuple[str, ...]

    def transformed(self, T: np.ndarray) -> Fields:
        """Return the fields transformed by ``T``, shape (4, 4), into another frame."""
        R = T[:3, :3].T
        t = T[:3, 3]
        layers = (
            replace(layer, points=layer.points @ R + t, vectors=layer.vectors @ R)
            for layer in self.layers
        )
        poses = (
            p if p.position is None else replace(p, position=p.position @ R + t) for p in self.poses
        )
        return replace(self, layers=tuple(layers), poses=tuple(poses))


def _workspace_layers(part: FittedRobot, over: Conditions, nominal: np.ndarray) -> Iterator[Layer]:
    """Yield the deviations over a workspace: from the prediction at nominal values to the
    calibrated one, and of each effect.
    """
    after = part.model_values
    tails = _positions(part.model, part.model.own(nominal), over)
    heads = _positions(part.model, after, over)
    words = "from nominal, base and tool fitted, to calibrated prediction"
    yield Layer("workspace/nominal to calibrated", "workspace", tails, heads - tails, words)
    yield from _explained("workspace", "workspace", part.model, after, over, heads)


def deviation_fields(
    calibrated: FittedRobot,
    measurements: Measurements | None = None,
    *,
    held_out: np.ndarray | None = None,
    grid: int = 1000,
    seed: int = 0,
) -> Fields:
    """Return the deviations of a robot over measured poses and over its workspace.

    Over measured poses: from nominal (only base and tool fitted) to measured, from calibrated to
    measured, and for each effect from the prediction without it to the prediction with it, all else
    unchanged. Over the workspace: from nominal to calibrated, and again each effect. A distance
    determines only the deviation along the line of sight; for readings that determine no direction,
    "before" leads to the calibrated prediction.

    Args:
        calibrated: the robot.
        measurements: its measured poses.
        held_out: shape (N,), which of them were held out of the fit; None if unknown.
        grid: approximate number of workspace points with an arrow; 0 for none.
        seed: random seed of the poses that reach them.

    Returns:
        The fields, positions in the instrument's frame.

    Raises:
        BadInputError: if the measurements lack what the model needs, or there is nothing to show.
    """
    layers: list[Layer] = []
    poses: list[FieldPoses] = []
    notes: list[str] = []
    conditions = position = None
    if measurements is not None and len(measurements):
        conditions = calibrated.conditions(measurements)
        position = measurements.position
        poses.append(
            FieldPoses(
                "measured", measurements.q, conditions.target, measurements.rows, held_out, position
            )
        )
        nominal, note = _nominal_from_data(calibrated, measurements, held_out)
        notes += note
        layers += _measured_layers(calibrated, measurements, conditions, nominal)
    if grid > 0:
        over, part, note = _workspace(calibrated, grid, seed, conditions)
        # Distances and contacts do not determine the base well, which would show as deviations
        # elsewhere in the workspace.
        if position is None:
            nominal = _nominal_from_predictions(part, over)
        notes += note
        layers += _workspace_layers(part, over, nominal)
        poses.append(FieldPoses("workspace", over.q, over.target))
    if not layers:
        raise BadInputError(
            "nothing to show: no measured poses, and no points of the workspace requested"
        )
    return Fields(tuple(layers), tuple(poses), tuple(notes))


def _measured_layers(
    calibrated: FittedRobot,
    measurements: Measurements,
    conditions: Conditions,
    nominal: np.ndarray,
) -> Iterator[Layer]:
    model = calibrated.model
    values = calibrated.values
    problem = calibrated.readings(measurements)
    for name, of, words in (
        ("before", nominal, "nominal, base and tool fitted"),
        ("after", values, "calibrated"),
    ):
        tails = _positions(model, model.own(of), conditions)
        meaning = f"from {words} to {problem.sensor.deviation_end}"
        yield Layer(f"deviations/{name}", "measured", tails, problem.displacements(of), meaning)
    own = model.own(values)
    yield from _explained(
        "deviations", "measured", model, own, conditions, _positions(model, own, conditions)
    )


def _explained(
    folder: str,
    poses: str,
    model: Model,
    values: np.ndarray,
    conditions: Conditions,
    whole: np.ndarray,
) -> Iterator[Layer]:
    """Yield a layer for each effect, from the prediction without it to the prediction with it."""
    used = set()
    for effect, span in zip(model.effects, model.spans, strict=True):
        if effect.family is not Family.EXTRINSICS and np.any(values[span]):
            without = values.copy()
            without[span] = 0.0
            name = effect_name(effect)
            while name in used:
                name += " again"
            used.add(name)
            tails = _positions(model, without, conditions)
            words = (
                f"from the prediction without {name} to the prediction with it, all else unchanged"
            )
            yield Layer(f"{folder}/explained by {name}", poses, tails, whole - tails, words)


def effect_name(effect: Effect) -> str:
    """Return the name of an effect in the control tree."""
    words = effect_words(EffectName.of(effect))
    return f"{words} in the frame of the moving link" if effect.locus.frame == "after" else words


def _positions(model: Model, values: np.ndarray, conditions: Conditions) -> np.ndarray:
    return np.asarray(model.predict(values, conditions)[:, :, 3])


def _nominal_from_data(
    calibrated: FittedRobot, measurements: Measurements, held_out: np.ndarray | None
) -> tuple[np.ndarray, list[str]]:
    """Return the values with only base and tool fitted, to the rows that the calibration was fitted
    to.
    """
    if calibrated.nominal_values is not None:
        return calibrated.nominal_values, []
    problem = calibrated.readings(measurements)
    fitted = np.ones(len(problem), bool) if held_out is None else ~held_out
    if fitted.sum() < min(len(problem), 6):
        words = (
            "base and tool of the nominal robot are fitted to the rows shown, since few of "
            "them were used by the calibration"
        )
        return _frames_fitted(calibrated, problem), [words]
    return _frames_fitted(calibrated, problem.select(fitted)), []


def _nominal_from_predictions(calibrated: FittedRobot, over: Conditions) -> np.ndarray:
    """Return the values with only base and tool fitted, to the calibrated robot over
    its workspace.
    """
    sample = over.select(evenly(len(over), _ENOUGH))
    poses = calibrated.predict(sample)
    sensor = simulatable()[
        "pose" if calibrated.model.has_tool_orientation else "position"
    ].simulated(poses)
    return _frames_fitted(
        calibrated, Station(calibrated.model, sample, sensor, np.ones(len(sample)))
    )


def _frames_fitted(calibrated: FittedRobot, station: Station) -> np.ndarray:
    """Fit only base and tool; a frame that was known in the calibration is held fixed."""
    found = calibrated.estimate.take(parameter.name for parameter in station.parameters)
    frames = np.array([parameter.is_extrinsic for parameter in found.parameters], bool)
    free = frames & (found.free if np.any(found.free & frames) else frames)
    start = np.where(frames, found.values, 0.0)
    station.split(start)[1][:] = station.split(found.values)[1]
    if not free.any():
        return start
    # Targets that these rows do not measure are held fixed.
    station.split(free)[0][:] &= largest_basis(station.model, station.conditions)[1]
    nothing = np.full(len(start), np.inf)
    noise = Noise((None,) * len(station.sensor.blocks))
    return likeliest_values(
        Problem((station,)),
        start,
        free,
        Priors(nothing, nothing),
        noise,
        Course("huber", rough=True),
    )


def _workspace(
    calibrated: FittedRobot, grid: int, seed: int, seen: Conditions | None
) -> tuple[Conditions, FittedRobot, list[str]]:
    """Return poses all over the workspace, the model that can predict there, and notes on
    assumptions.
    """
    payload = (
        float(np.mean(calibrated.covered.payload))
        if seen is None
        else float(np.median(seen.payload))
    )
    columns = {} if seen is None else {"temperature": seen.temperature, "time": seen.time}
    known = {
        name: float(np.median(values)) for name, values in columns.items() if values is not None
    }

    def is_known(effect: Effect) -> bool:
        return not any(
            need in ("temperature", "time") and need not in known for need in effect.needs
        )

    left_out = [effect_name(effect) for effect in calibrated.model.effects if not is_known(effect)]
    part = calibrated.with_effects(is_known) if left_out else calibrated
    q = _workspace_poses(part, grid, payload=payload, known=known, seed=seed)
    over = _at_conditions(q, calibrated, payload, known)
    notes = [
        f"workspace: {len(q)} points within the joint ranges of the calibration, each reached by "
        f"one pose, at a payload of {payload:g} kg"
    ]
    if left_out:
        notes.append(
            f"workspace: without {', '.join(left_out)}, whose conditions are known at "
            "measured poses only"
        )
    return over, part, notes


def _workspace_poses(
    calibrated: FittedRobot, places: int, *, payload: float, known: dict[str, float], seed: int
) -> np.ndarray:
    """Return joint positions within the calibrated range, shape (about ``places``, n), one for each
    cell of a regular grid.

    Of random poses, the one nearest to the centre of a cell is taken.
    """
    rng = np.random.default_rng(seed)
    lower, upper = calibrated.covered.q.T
    q = rng.uniform(lower, upper, (min(_DRAWS * places, max(_MOST_DRAWS, places)), len(lower)))
    q = calibrated.model.chain.robot.following(q)
    pieces = (
        _at_conditions(q[i : i + _PIECE], calibrated, payload, known)
        for i in range(0, len(q), _PIECE)
    )
    reached = np.concatenate([calibrated.predict(piece)[:, :, 3] for piece in pieces])
    size = _cell_size(reached, places)
    off_centre = np.linalg.norm(reached - np.round(reached / size) * size, axis=1)
    order = np.argsort(off_centre, kind="stable")
    _, first = np.unique(_cells(reached[order], size), return_index=True)
    return np.asarray(q[order[first]])


def _at_conditions(
    q: np.ndarray, calibrated: FittedRobot, payload: float, known: dict[str, float]
) -> Conditions:
    """Return the conditions of joint positions, shape (N, n), with the same payload [kg],
    temperature and time.
    """
    plain = Conditions.at(q, payload=payload, payload_centre=calibrated.payload_centre)
    columns = {name: np.full(len(q), value) for name, value in known.items()}
    # Directions of approach are unknown, 0 as for a table without these columns; joints are at the
    # commanded positions.
    unknown = np.zeros(q.shape)
    return replace(plain, approach=unknown, move=unknown, droop=unknown, **columns)


def _cell_size(reached: np.ndarray, places: int) -> float:
    """Return the cell size [m] with which about ``places`` cells are reached."""
    extent = float(np.ptp(reached, axis=0).max())
    if extent == 0.0:
        return 1.0
    low = extent / 1e3
    high = 2.0 * extent
    for _ in range(_HALVINGS):
        size = float(np.sqrt(low * high))
        count = len(np.unique(_cells(reached, size)))
        low, high = (size, high) if count > places else (low, size)
    return high


def _cells(points: np.ndarray, size: float) -> np.ndarray:
    """Return the index of each point's cell, shape (N,)."""
    steps = np.round(points / size).astype(np.int64)
    steps -= steps.min(axis=0)
    return np.asarray(np.ravel_multi_index(tuple(steps.T), tuple(steps.max(axis=0) + 1)))
