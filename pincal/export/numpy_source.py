"""The calibrated model as a Python file that needs only NumPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from operator import is_
from typing import Any, ClassVar

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.compensate.compensation import middle_of_range
from pincal.compensate.robot_frames import nominal_in_instrument, nominal_robot
from pincal.errors import BadInputError
from pincal.export.export_numbers import EXPORT
from pincal.export.exported import (
    FORMATS,
    Exported,
    Format,
    as_comment,
    checked_poses,
    export_notes,
    filled,
    header,
    placed_in,
    template_of,
)
from pincal.export.formulas import Formulas, Language, Spread, formulas_of, written
from pincal.measure.heading import NUMBERED
from pincal.model.conditions import Conditions
from pincal.thresholds import Count
from pincal.units import UNITS, size_of

_ARGUMENTS = "q, payload, temperature, time, approach, target"
_COLUMNS = ("payload", "temperature", "time", "approach", "target")
# Poses for each uncertain parameter, three equations each, by which motions are compared.
_POSES_EACH: Count = 3


def _input(name: str) -> str:
    column, _, index = name.partition("[")
    return name if not index or column == "moments" else f"{column}[:, {index}"


_NUMPY = Language(
    statement="    {} = {}",
    functions={
        name: f"np.{name}"
        for name in (
            "sin",
            "cos",
            "tan",
            "arcsin",
            "arccos",
            "arctan",
            "sinh",
            "cosh",
            "tanh",
            "arcsinh",
            "exp",
            "log",
            "sqrt",
            "fabs",
            "rint",
            "floor",
            "hypot",
            "arctan2",
        )
    },
    select="np.where({}, {}, {})",
    is_select_atom=True,
    input=_input,
    curve=lambda i, curve, x: f"_cubic({x}, {curve.lower!r}, {curve.upper!r}, _CURVE_{i})",
)


@FORMATS.register
@dataclass(frozen=True)
class NumpySource(Format):
    """A Python file whose only dependency is NumPy: forward kinematics and compensation of many
    poses at once.

    It is also a program that corrects a table: ``python arm.py program.csv corrected.csv``.

    Attributes:
        frame: frame of the poses: "instrument" or "base".
    """

    frame: str = "instrument"
    name: ClassVar[str] = "python"
    meaning: ClassVar[str] = "a Python file that needs only NumPy"

    def export(self, calibrated: FittedRobot) -> Exported:
        formulas = checked_formulas(calibrated, self.frame)
        text = numpy_source(formulas, frame=self.frame)
        worst = refuse_wrong(formulas.calibrated, text=text)
        return Exported({"": text.encode()}, export_notes(calibrated, formulas), worst)


def checked_formulas(calibrated: FittedRobot, frame: str) -> Formulas:
    """Return the formulas of a calibrated model in a frame, without those of its uncertainty where
    they differ from the model's whatever displacements of the parameters are taken.
    """
    formulas = formulas_of(placed_in(calibrated, frame))
    if not formulas.spread.is_known:
        return replace(formulas, motions=())
    source = _loaded(numpy_source(formulas, frame=frame))
    if _states_uncertainty(formulas, source["uncertainty"]):
        return formulas
    spread = _spread_by_model(formulas, source["_motions"], source["_inputs"])
    formulas = replace(formulas, spread=spread)
    source = _loaded(numpy_source(formulas, frame=frame))
    agrees = _states_uncertainty(formulas, source["uncertainty"])
    return formulas if agrees else replace(formulas, motions=())


def _states_uncertainty(formulas: Formulas, uncertainty: Callable[..., np.ndarray]) -> bool:
    """Return whether the function of a file states the uncertainty of the model."""
    found = formulas.calibrated
    at = checked_poses(found)
    expected = found.position_sigma(at)
    q, columns = _arguments(found, at)
    difference = np.abs(uncertainty(q, **columns) - expected).max()
    return bool(difference <= EXPORT.uncertainty * expected.mean())


def _spread_by_model(
    formulas: Formulas, motions: Callable[..., np.ndarray], inputs: Callable[..., Any]
) -> Spread:
    """Return the spread with which the functions of a file move the target as the model does, at
    poses that are not those of the check.
    """
    found = formulas.calibrated
    chosen = list(formulas.spread.parameters)
    # More equations than parameters.
    at = checked_poses(found, n=_POSES_EACH * len(chosen), seed=1)
    q, columns = _arguments(found, at)
    given = (columns[name] for name in _COLUMNS)
    by_formulas = np.swapaxes(motions(*inputs(q, *given)), 1, 2)[:, :, : len(chosen)]
    _, J = found.model.linearise(found.model_values, at, rows=3)
    return formulas.spread.with_exact_motions(by_formulas, J[:, :, chosen])


def numpy_source(formulas: Formulas, *, frame: str) -> str:
    """Return the text of the file."""
    found = formulas.calibrated
    chain = formulas.calibrated.model.chain
    functions, curves = _functions(formulas)
    other = nominal_robot(found) if frame == "base" else nominal_in_instrument(found)
    nominal = replace(formulas_of(other), motions=())
    functions += "\n\n\n" + _functions(nominal)[0].replace("def _evaluate(", "def _nominal(", 1)
    lines = header(formulas, frame=frame)
    return filled(
        template_of("model.py.in"),
        formulas,
        frame=frame,
        numbers=_list_of_numbers,
        header='"""' + "\n".join(lines) + '\n"""',
        joints=repr(tuple(chain.robot.joint_names[i] for i in formulas.joints)),
        targets=repr(chain.targets),
        needs=", ".join(("q", *formulas.inputs)),
        needed=repr(tuple(name for name in formulas.inputs if name not in ("payload", "target"))),
        curves=curves,
        evaluate=functions,
        uncertainty=_uncertainty(formulas, frame=frame),
        program=_program(formulas, frame=frame),
    )


def _uncertainty(formulas: Formulas, *, frame: str) -> str:
    """Return the function of the uncertainty; "" where it is not exported."""
    if not formulas.motions:
        return ""
    root = ",\n".join(f"    [{', '.join(row)}]" for row in formulas.spread.rows())
    return filled(
        template_of("uncertainty.py.in"),
        formulas,
        frame=frame,
        numbers=str,
        root=f"[\n{root},\n]",
        rest=f"{formulas.spread.rest:.9g}",
    )


def _program(formulas: Formulas, *, frame: str) -> str:
    """Return the part of the file that is its command."""
    found = formulas.calibrated
    chain = found.model.chain
    own = formulas.joints
    return filled(
        template_of("program.py.in"),
        formulas,
        frame=frame,
        numbers=str,
        slides=repr([chain.robot.joint_types[i] == "prismatic" for i in own]),
        start=repr(middle_of_range(chain.robot)[own].tolist()),
        days=repr(_mean_conditions(found)),
        units=repr(_sizes_of_units()),
        names=", ".join(as_comment(chain.robot.joint_names[i]) for i in own),
        reach=repr(float(chain.robot.reach)),
        numbered=repr(NUMBERED.pattern),
    )


def _mean_conditions(found: FittedRobot) -> dict[str, float]:
    """Return the means of temperature [deg C] and time [s] over the data, where recorded."""
    days = found.covered.days
    return {name: float(days[name][0]) for name in ("temperature", "time") if name in days}


def _sizes_of_units() -> dict[str, dict[str, float]]:
    """Return the size of each unit that a heading may name, by quantity."""
    return {
        quantity: {unit: size_of(unit, quantity) for unit in units}
        for quantity, units in UNITS.items()
    }


def _list_of_numbers(values: np.ndarray) -> str:
    """Return numbers as NumPy source."""
    return "[" + ", ".join(repr(float(value)).replace("inf", "np.inf") for value in values) + "]"


def refuse_wrong(calibrated: FittedRobot, *, text: str) -> float:
    """Return the largest difference between poses of a file and of the model [m, elements of the
    rotation matrix].

    Raises:
        BadInputError: if it exceeds rounding, naming the effect whose formula differs.
    """
    worst = _error(calibrated, text)
    if worst <= EXPORT.formulas:
        return worst
    for effect in calibrated.model.effects:
        alone = calibrated.with_effects(partial(is_, effect))
        error = _error(alone, numpy_source(formulas_of(alone), frame="instrument"))
        if not error <= EXPORT.formulas:
            raise BadInputError(
                f"{effect.name}: its formula differs from its prediction by up to {error:.2g} m, "
                f"expected at most {EXPORT.formulas:g} m; it can't be exported"
            )
    raise BadInputError(
        f"formulas differ from the model by up to {worst:.2g} m; expected at most "
        f"{EXPORT.formulas:g} m"
    )


def _error(calibrated: FittedRobot, text: str) -> float:
    at = checked_poses(calibrated)
    q, columns = _arguments(calibrated, at)
    found = _loaded(text)["forward"](q, **columns)
    return float(np.abs(found - calibrated.predict(at)).max())


def _loaded(text: str) -> dict[str, Callable[..., np.ndarray]]:
    """Return the functions of a file."""
    names: dict[str, Any] = {}
    exec(compile(text, "<export>", "exec"), names)
    return names


def _arguments(calibrated: FittedRobot, at: Conditions) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the joint positions of poses, and their other columns, as a file takes them."""
    robot = calibrated.model.chain.robot
    own = robot.own_joints
    columns = {name: getattr(at, name) for name in ("payload", "temperature", "time", "target")}
    assert at.approach is not None
    columns["approach"] = at.approach[:, own]
    return robot.as_reported(at.q)[:, own], columns


def _functions(formulas: Formulas) -> tuple[str, str]:
    """Return the functions that evaluate the formulas, and their tables."""
    found = written(_NUMPY, formulas)
    moments, pose, columns = found.moments, found.pose, found.columns
    functions = []
    taken = ""
    m = 3 * formulas.calibrated.model.chain.robot.n_joints
    if formulas.moments:
        returned = f"    return _stacked([{', '.join(moments[1])}], ({m},), len(q)).T"
        functions.append(
            "\n".join([f"def _moments({_ARGUMENTS}, moments):", *moments[0], returned, ""])
        )
        taken = _TAKEN.format(n=m, arguments=_ARGUMENTS)
    shapes = {"(3, 4)": pose, f"(6, {len(formulas.joints)})": columns}
    stacks = [
        f"_stacked([{', '.join(results)}], {shape}, len(q))"
        for shape, (_, results) in shapes.items()
    ]
    returned = f"    return {', '.join(stacks)}"
    functions.append(
        "\n".join([f"def _evaluate({_ARGUMENTS}):{taken}", *pose[0], *columns[0], returned])
    )
    if formulas.motions:
        count = len(formulas.motions) // 3
        lines, results = found.motions
        returned = f"    return _stacked([{', '.join(results)}], ({count}, 3), len(q))"
        functions.append("\n".join([f"\ndef _motions({_ARGUMENTS}):{taken}", *lines, returned]))
    tables = [f"_CURVE_{i} = np.array({curve.pieces})" for i, curve in enumerate(found.curves)]
    return "\n\n".join(functions), "\n".join(tables)


_TAKEN = """
    moments = np.zeros(({n}, len(q)))
    for _ in range(20):
        before, moments = moments, _moments({arguments}, moments)
        if np.abs(moments - before).max(initial=0.0) <= 1e-11 * np.abs(moments).max(initial=0.0):
            break"""
