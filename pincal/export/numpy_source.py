"""The calibrated model as a Python file that needs NumPy alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.errors import BadInputError
from pincal.export.exported import FORMATS, Exported, Format
from pincal.export.formulas import Formulas, formulas_of
from pincal.export.source import checked_poses, filled, header, notes_on, placed_in
from pincal.export.statements import Language, Number, Writer

# Largest distance of the formulas' poses from the model's [m, and elements of the rotation matrix].
TOLERANCE = 1e-12
_ARGUMENTS = "q, payload, temperature, time, approach, target"


def _input(name: str) -> str:
    column, _, index = name.partition("[")
    return name if not index or column == "moments" else f"{column}[:, {index}"


_NUMPY = Language(
    statement="    {} = {}",
    functions={name: f"np.{name}" for name in (
        "sin", "cos", "tan", "arcsin", "arccos", "arctan", "sinh", "cosh", "tanh", "arcsinh", "exp", "log", "sqrt", "fabs",
        "rint", "floor", "hypot", "arctan2",
    )},
    select="np.where({}, {}, {})",
    is_select_atom=True,
    input=_input,
    curve=lambda i, curve, x: f"_cubic({x}, {curve.lower!r}, {curve.upper!r}, _CURVE_{i})",
)  # fmt: skip


@FORMATS.register
@dataclass(frozen=True)
class NumpySource(Format):
    """A Python file without dependencies but NumPy: forward kinematics and compensation of many poses at once.

    Attributes:
        frame: frame of the poses: "instrument" or "base".
    """

    frame: str = "instrument"
    name: ClassVar[str] = "python"
    meaning: ClassVar[str] = "a Python file that needs NumPy alone"

    def export(self, calibrated: CalibratedModel) -> Exported:
        """Return the file."""
        formulas = formulas_of(placed_in(calibrated, self.frame))
        text = numpy_source(formulas, frame=self.frame)
        return Exported({"": text.encode()}, notes_on(calibrated), refuse_wrong(formulas.calibrated, text=text))


def numpy_source(formulas: Formulas, *, frame: str) -> str:
    """Return the text of the file."""
    chain = formulas.calibrated.model.chain
    functions, curves = _functions(formulas)
    lines = header(formulas, frame=frame)
    return filled(
        "model.py.in",
        formulas,
        header='"""' + "\n".join(lines) + '\n"""',
        joints=repr(tuple(chain.robot.joint_names[i] for i in formulas.joints)),
        targets=repr(chain.targets),
        lower=_numbers(chain.robot.lower[formulas.joints]),
        upper=_numbers(chain.robot.upper[formulas.joints]),
        frame=frame,
        needs=", ".join(("q", *formulas.inputs)),
        needed=repr(tuple(name for name in formulas.inputs if name not in ("payload", "target"))),
        curves=curves,
        evaluate=functions,
    )


def refuse_wrong(calibrated: CalibratedModel, *, text: str) -> float:
    """Return how far the poses of a file are from those of the model at most [m, elements of the rotation matrix].

    Raises:
        BadInputError: if it is more than rounding, naming the effect whose formula differs.
    """
    worst = _error(calibrated, text)
    if worst <= TOLERANCE:
        return worst
    for effect in calibrated.model.effects:
        alone = calibrated.with_effects(lambda other, kept=effect: other is kept)  # type: ignore[misc]
        error = _error(alone, numpy_source(formulas_of(alone), frame="instrument"))
        if not error <= TOLERANCE:
            raise BadInputError(
                f"{effect.name}: its formula differs from what it predicts by up to {error:.2g} m, expected at most "
                f"{TOLERANCE:g} m; it can't be exported"
            )
    raise BadInputError(f"formulas differ from the model by up to {worst:.2g} m; expected at most {TOLERANCE:g} m")


def _error(calibrated: CalibratedModel, text: str) -> float:
    names: dict[str, Any] = {}
    exec(compile(text, "<export>", "exec"), names)
    forward: Callable[..., np.ndarray] = names["forward"]
    at = checked_poses(calibrated)
    own = calibrated.model.chain.robot.own_joints
    columns = {name: getattr(at, name) for name in ("payload", "temperature", "time", "target")}
    assert at.approach is not None
    columns["approach"] = at.approach[:, own]
    return float(np.abs(forward(at.q[:, own], **columns) - calibrated.predict(at)).max())


def _functions(formulas: Formulas) -> tuple[str, str]:
    """Return the functions that evaluate the formulas, and the tables that they need."""
    written, taken, m = [], "", 3 * formulas.calibrated.model.chain.robot.n_joints
    writer = Writer.of(_NUMPY, formulas.moments)
    if formulas.moments:
        lines, results = writer.statements(formulas.moments)
        returned = f"    return _stacked([{', '.join(results)}], ({m},), len(q)).T"
        written.append("\n".join([f"def _moments({_ARGUMENTS}, moments):", *lines, returned, ""]))
        taken = _TAKEN.format(n=m, arguments=_ARGUMENTS)
    entries: tuple[Number, ...] = (*formulas.pose, *formulas.columns)
    last = Writer.of(_NUMPY, entries)
    last.curves = writer.curves
    lines, results = last.statements(entries)
    pose, columns = (", ".join(part) for part in (results[:12], results[12:]))
    returned = f"    return _stacked([{pose}], (3, 4), len(q)), _stacked([{columns}], (6, {len(formulas.joints)}), len(q))"
    written.append("\n".join([f"def _evaluate({_ARGUMENTS}):{taken}", *lines, returned]))
    tables = [f"_CURVE_{i} = np.array({list(map(list, curve.pieces))})" for i, curve in enumerate(last.curves)]
    return "\n\n".join(written), "\n".join(tables)


_TAKEN = """
    moments = np.zeros(({n}, len(q)))
    for _ in range(20):
        before, moments = moments, _moments({arguments}, moments)
        if np.abs(moments - before).max(initial=0.0) <= 1e-11 * np.abs(moments).max(initial=0.0):
            break"""


def _numbers(values: np.ndarray) -> str:
    return "[" + ", ".join(repr(float(value)).replace("inf", "np.inf") for value in values) + "]"
