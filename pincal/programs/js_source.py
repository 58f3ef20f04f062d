"""The calibrated model as JavaScript, and a page around it that corrects programs in any browser,
offline.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.resources import files
from typing import Any, ClassVar

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.compensate.compensation import middle_of_range
from pincal.compensate.robot_frames import base_in_instrument, nominal_robot
from pincal.export.export_numbers import EXPORT
from pincal.export.exported import (
    Exported,
    Format,
    as_comment,
    checked_poses,
    export_notes,
    filled,
    header,
    placed_in,
    worth_of,
)
from pincal.export.formulas import Formulas, Language, Written, formulas_of, written
from pincal.export.numpy_source import checked_formulas, numpy_source, refuse_wrong
from pincal.io.strict_json import in_script
from pincal.measure.heading import NUMBERED
from pincal.programs.arms import rigid_pose
from pincal.robot.robot import Robot
from pincal.units import UNITS, size_of

# The style and the scripts of the page, in their order.
_PARTS = (
    "corrector.css",
    "corrector_table.js",
    "python.js",
    "programs.js",
    "readers.js",
    "corrector_programs.js",
    "corrector.js",
)
_JS = Language(
    statement="  const {} = {};",
    functions={"rint": "rint"}
    | {
        name: f"Math.{spelled}"
        for name, spelled in (
            *(
                (name, name)
                for name in (
                    "sin",
                    "cos",
                    "tan",
                    "sinh",
                    "cosh",
                    "tanh",
                    "exp",
                    "log",
                    "sqrt",
                    "floor",
                    "hypot",
                )
            ),
            ("arcsin", "asin"),
            ("arccos", "acos"),
            ("arctan", "atan"),
            ("arcsinh", "asinh"),
            ("arctan2", "atan2"),
            ("fabs", "abs"),
        )
    },
    select="{} ? {} : {}",
    is_select_atom=False,
    input=lambda name: name if name.startswith("moments") else f"state.{name}",
    curve=lambda i, curve, x: f"cubic({x}, {curve.lower!r}, {curve.upper!r}, CURVES[{i}])",
)


@dataclass(frozen=True)
class CorrectorPage(Format):
    """A single-file page that corrects tables and programs by the model in any browser, without
    network access.

    Attributes:
        frame: default frame of positions: "instrument" or "base".
    """

    frame: str = "instrument"
    name: ClassVar[str] = "page"
    meaning: ClassVar[str] = "a page that corrects programs in any browser, offline"

    def export(self, calibrated: FittedRobot) -> Exported:
        import jinja2

        placed_in(calibrated, self.frame)
        formulas = checked_formulas(calibrated, "base")
        seen = checked_formulas(calibrated, "instrument")
        worst = refuse_wrong(formulas.calibrated, text=numpy_source(formulas, frame="base"))
        templates = files("pincal.programs").joinpath("page")
        style, *scripts = (templates.joinpath(name).read_text("utf-8") for name in _PARTS)
        loader = jinja2.PackageLoader("pincal.programs", "page")
        page = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True).get_template(
            "corrector.html.j2"
        )
        notes = export_notes(calibrated, seen)
        html = page.render(
            title=calibrated.model.chain.robot.name,
            machine=calibrated.identity.machine,
            version=version("pincal"),
            notes=notes,
            worth=worth_of(calibrated),
            about=in_script(json.dumps(_about(calibrated, formulas, self.frame), allow_nan=False)),
            model=js_source(formulas, seen),
            style=style,
            script="\n".join(scripts),
        )
        return Exported({"": html.encode()}, notes, worst)


def js_source(formulas: Formulas, seen: Formulas) -> str:
    """Return the calibrated model and its compensation in JavaScript.

    Args:
        formulas: in the base frame, in which controllers compute.
        seen: in the instrument's frame, of which the uncertainty is: where the base stands is known
            worse than where the tool is, and programs do not rest on it.
    """
    found = formulas.calibrated
    robot = found.model.chain.robot
    nominal = replace(formulas_of(nominal_robot(found)), motions=())
    template = files("pincal.programs").joinpath("page", "model.js.in").read_text("utf-8")
    return filled(
        template,
        formulas,
        frame="base",
        numbers=lambda values: ", ".join(
            repr(float(value)).replace("inf", "Infinity") for value in values
        ),
        header="\n// ".join(as_comment(line) for line in header(formulas, frame="base")).replace(
            "// \n", "//\n"
        ),
        joints=in_script(json.dumps([robot.joint_names[i] for i in formulas.joints])),
        targets=in_script(json.dumps(found.model.chain.targets)),
        needs=", ".join(("q", *formulas.inputs)),
        functions="\n\n".join(
            (
                _function(formulas, "calibrated"),
                _function(nominal, "nominal"),
                _uncertainty(seen),
            )
        ),
    )


def _function(formulas: Formulas, name: str) -> str:
    """Return the function of a state that evaluates formulas, with its tables."""
    found = written(_JS, formulas)
    results = (f"[{', '.join(results)}]" for _, results in (found.pose, found.columns))
    body = (*found.pose[0], *found.columns[0], f"  return [{', '.join(results)}];")
    return _enclosed(formulas, found, name, body)


def _uncertainty(formulas: Formulas) -> str:
    """Return the function of a state that gives the uncertainty of the target's position."""
    if not formulas.motions:
        return "const uncertainty = null;"
    found = written(_JS, formulas)
    lines, results = found.motions
    spread = formulas.spread
    rows = ", ".join(f"[{', '.join(row)}]" for row in spread.rows())
    body = (
        f"  const ROOT = [{rows}];",
        *lines,
        f"  const motions = [{', '.join(results)}];",
        f"  return [0, 1, 2].map((a) => Math.sqrt(ROOT[0].reduce((sum, _, r) => sum + "
        f"ROOT.reduce((along, row, p) => along + row[r] * motions[3 * p + a], 0) ** 2, "
        f"{spread.rest:.9g})));",
    )
    return _enclosed(formulas, found, "uncertainty", body)


def _enclosed(formulas: Formulas, found: Written, name: str, body: Sequence[str]) -> str:
    """Return a function of a state with its body and what this depends on."""
    lines = [f"const {name} = (() => {{"]
    if found.curves:
        curves = [f"  {json.dumps(curve.pieces)}," for curve in found.curves]
        lines += ["const CURVES = [", *curves, "];"]
    taken = []
    if formulas.moments:
        size = 3 * formulas.calibrated.model.chain.robot.n_joints
        lines += [
            "const taken = (state, moments) => {",
            *found.moments[0],
            f"  return [{', '.join(found.moments[1])}];",
            "};",
        ]
        taken = [_TAKEN.format(n=size)]
    return "\n".join((*lines, "return (state) => {", *taken, *body, "};", "})();"))


_TAKEN = """  let moments = new Array({n}).fill(0);
  for (let round = 0; round < 20; ++round) {{
    const before = moments;
    moments = taken(state, before);
    if (largest(moments.map((x, i) => x - before[i])) <= 1e-11 * largest(moments)) break;
  }}"""


def _about(calibrated: FittedRobot, formulas: Formulas, frame: str) -> dict[str, Any]:
    """Return the data of the robot on the page in addition to the formulas."""
    chain = calibrated.model.chain
    robot = chain.robot
    own = formulas.joints
    days = calibrated.covered.days
    combination = robot.combination[np.ix_(own, own)]
    return {
        "robot": robot.name,
        "types": [robot.joint_types[i] for i in own],
        "start": middle_of_range(robot)[own].tolist(),
        "needs": formulas.inputs,
        "days": {name: days[name][0] for name in ("temperature", "time") if name in days},
        **_base_of(calibrated, frame),
        "reach": robot.reach,
        "numbered": NUMBERED.pattern,
        "lower": [_limit(value) for value in robot.lower[own]],
        "upper": [_limit(value) for value in robot.upper[own]],
        "combination": combination.tolist(),
        "reported": np.linalg.inv(combination).tolist(),
        **{name: _place(robot, name) for name in ("world", "flange")},
        "units": {
            quantity: {unit: size_of(unit, quantity) for unit in units}
            for quantity, units in UNITS.items()
        },
        "follows": _follows(calibrated),
        "arm": _arm(robot),
        "nodes": [T[:3, 3].tolist() for T in robot.T_link_joint],
        "types_of_all": robot.joint_types,
        "up": (-chain.gravity / max(float(np.linalg.norm(chain.gravity)), 1e-300)).tolist(),
    }


def _base_of(calibrated: FittedRobot, frame: str) -> dict[str, Any]:
    """Return the default frame of positions, and the pose of the base in the instrument if the
    robot stands still in it elsewhere than at its origin.
    """
    bases = base_in_instrument(calibrated, checked_poses(calibrated))
    stands = bool(np.ptp(bases, axis=0).max() <= EXPORT.still) and not np.allclose(
        bases[0], np.eye(4)[:3], rtol=0.0, atol=EXPORT.still
    )
    return {
        "frame": frame if stands else "base",
        "base": bases[0].ravel().tolist() if stands else None,
    }


def _arm(robot: Robot) -> dict[str, Any]:
    """Return the fixed transforms of the nominal arm, row by row."""
    shown = robot.kinematics
    return {
        "first": shown.first[:3].ravel().tolist(),
        "before": shown.before[:, :3].reshape(-1, 12).tolist(),
        "after": shown.after[:, :3].reshape(-1, 12).tolist(),
        "tip": robot.frames.T_last_tip[:3].ravel().tolist(),
    }


def _limit(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _place(robot: Robot, name: str) -> list[float]:
    """Return the pose of the controller's world in the base, or of its flange in the tip, row by
    row.
    """
    found = rigid_pose(robot, *(("base", robot.base) if name == "world" else ("tool0", robot.tip)))
    return [float(x) for x in (np.eye(4) if found is None else found)[:3].ravel()]


def _follows(calibrated: FittedRobot) -> list[list[float]]:
    """Return for each joint of the arm the independent joint that it follows, factor and offset."""
    robot = calibrated.model.chain.robot
    place = {robot.joint_names[i]: k for k, i in enumerate(robot.own_joints)}
    mimics = {m.joint: [place[m.source], m.multiplier, m.offset] for m in robot.mimics}
    return [
        mimics[name] if name in mimics else [place[name], 1.0, 0.0] for name in robot.joint_names
    ]
