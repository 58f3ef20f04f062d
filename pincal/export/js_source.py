"""The calibrated model as JavaScript, and a page around it that corrects programs in any browser, offline."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files
from typing import Any, ClassVar

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.compensate.compensation import middle_of_range
from pincal.compensate.robot_frames import base_in_instrument, nominal_robot
from pincal.export.exported import FORMATS, Exported, Format
from pincal.export.formulas import Formulas, formulas_of
from pincal.export.numpy_source import numpy_source, refuse_wrong
from pincal.export.source import as_comment, checked_poses, filled, header, notes_on, placed_in
from pincal.export.statements import Language, written
from pincal.robot.kinematics import Kinematics
from pincal.units import UNITS, size_of

_JS = Language(
    statement="  const {} = {};",
    functions={"rint": "rint"} | {name: f"Math.{spelled}" for name, spelled in (
        *((name, name) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt", "floor", "hypot")),
        ("arcsin", "asin"), ("arccos", "acos"), ("arctan", "atan"), ("arcsinh", "asinh"), ("arctan2", "atan2"),
        ("fabs", "abs"),
    )},
    select="{} ? {} : {}",
    is_select_atom=False,
    input=lambda name: name if name.startswith("moments") else f"state.{name}",
    curve=lambda i, curve, x: f"cubic({x}, {curve.lower!r}, {curve.upper!r}, CURVES[{i}])",
)  # fmt: skip
# Bases that differ less than this at all checked times and temperatures stand still [m, elements of the rotation matrix].
_STILL = 1e-12


@FORMATS.register
@dataclass(frozen=True)
class CorrectorPage(Format):
    """A page of one file that corrects tables and programs by the model in any browser, and asks no network for anything.

    Attributes:
        frame: in which positions are taken to be until the reader says otherwise: "instrument" or "base".
    """

    frame: str = "instrument"
    name: ClassVar[str] = "page"
    meaning: ClassVar[str] = "a page that corrects programs in any browser, offline"

    def export(self, calibrated: CalibratedModel) -> Exported:
        """Return the page."""
        import jinja2

        placed_in(calibrated, self.frame)
        formulas = formulas_of(placed_in(calibrated, "base"))
        worst = refuse_wrong(formulas.calibrated, text=numpy_source(formulas, frame="base"))
        templates = files("pincal.export").joinpath("templates")
        parts = {name: templates.joinpath(f"corrector{name}").read_text("utf-8") for name in (".css", ".js", "_table.js")}
        loader = jinja2.PackageLoader("pincal.export", "templates")
        page = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True).get_template("corrector.html.j2")
        html = page.render(
            title=calibrated.model.chain.robot.name,
            version=version("pincal"),
            notes=notes_on(calibrated),
            about=_in_script(_about(calibrated, formulas, self.frame)),
            model=js_source(formulas),
            style=parts[".css"],
            script=parts["_table.js"] + parts[".js"],
        )
        return Exported({"": html.encode()}, notes_on(calibrated), worst)


def js_source(formulas: Formulas) -> str:
    """Return the calibrated model and its compensation in JavaScript; ``formulas`` are those in the base frame."""
    found = formulas.calibrated
    robot = found.model.chain.robot
    nominal = formulas_of(nominal_robot(found))
    return filled(
        "model.js.in",
        formulas,
        frame="base",
        numbers=lambda values: ", ".join(repr(float(value)).replace("inf", "Infinity") for value in values),
        header="\n// ".join(as_comment(line) for line in header(formulas, frame="base")).replace("// \n", "//\n"),
        joints=_in_script([robot.joint_names[i] for i in formulas.joints]),
        targets=_in_script(found.model.chain.targets),
        needs=", ".join(("q", *formulas.inputs)),
        functions="\n\n".join((_function(formulas, "calibrated"), _function(nominal, "nominal"))),
    )


def _function(formulas: Formulas, name: str) -> str:
    """Return the function of a state that evaluates formulas, with the tables that it needs."""
    moments, pose, columns, used = written(_JS, formulas.moments, formulas.pose, formulas.columns)
    lines = [f"const {name} = (() => {{"]
    if used:
        lines += ["const CURVES = ["] + [f"  {json.dumps(curve.pieces)}," for curve in used] + ["];"]
    taken = []
    if formulas.moments:
        size = 3 * formulas.calibrated.model.chain.robot.n_joints
        lines += ["const taken = (state, moments) => {", *moments[0], f"  return [{', '.join(moments[1])}];", "};"]
        taken = [_TAKEN.format(n=size)]
    results = (f"[{', '.join(found)}]" for _, found in (pose, columns))
    body = (*taken, *pose[0], *columns[0], f"  return [{', '.join(results)}];", "};")
    return "\n".join((*lines, "return (state) => {", *body, "})();"))


_TAKEN = """  let moments = new Array({n}).fill(0);
  for (let round = 0; round < 20; ++round) {{
    const before = moments;
    moments = taken(state, before);
    if (largest(moments.map((x, i) => x - before[i])) <= 1e-11 * largest(moments)) break;
  }}"""


def _about(calibrated: CalibratedModel, formulas: Formulas, frame: str) -> dict[str, Any]:
    """Return what the page knows of the robot beside the formulas."""
    chain, own, at = calibrated.model.chain, formulas.joints, checked_poses(calibrated)
    robot, days = chain.robot, calibrated.covered.days
    bases = base_in_instrument(calibrated, at)
    stands = bool(np.ptp(bases, axis=0).max() <= _STILL) and not np.allclose(bases[0], np.eye(4)[:3], rtol=0.0, atol=_STILL)
    shown = Kinematics.of(robot)
    return {
        "robot": robot.name,
        "types": [robot.joint_types[i] for i in own],
        "start": middle_of_range(robot)[own].tolist(),
        "needs": formulas.inputs,
        "days": {name: days[name][0] for name in ("temperature", "time") if name in days},
        "frame": frame if stands else "base",
        "base": bases[0].ravel().tolist() if stands else None,
        "reach": robot.reach,
        "units": {quantity: {unit: size_of(unit, quantity) for unit in units} for quantity, units in UNITS.items()},
        "follows": _follows(calibrated),
        "arm": {"first": shown.first[:3].ravel().tolist(), "before": shown.before[:, :3].reshape(-1, 12).tolist(),
                "after": shown.after[:, :3].reshape(-1, 12).tolist(), "tip": robot.frames.T_last_tip[:3].ravel().tolist()},
        "nodes": [T[:3, 3].tolist() for T in robot.T_link_joint],
        "types_of_all": robot.joint_types,
        "up": (-chain.gravity / max(float(np.linalg.norm(chain.gravity)), 1e-300)).tolist(),
    }  # fmt: skip


def _follows(calibrated: CalibratedModel) -> list[list[float]]:
    """Return for each joint of the arm the joint of its own that it follows, factor and offset."""
    robot = calibrated.model.chain.robot
    place = {robot.joint_names[i]: k for k, i in enumerate(robot.own_joints)}
    mimics = {m.joint: [place[m.source], m.multiplier, m.offset] for m in robot.mimics}
    return [mimics[name] if name in mimics else [place[name], 1.0, 0.0] for name in robot.joint_names]


def _in_script(content: Any) -> str:
    """Return JSON that stays text inside of a script element, whatever names are in it."""
    text = json.dumps(content, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
