"""The calibrated model as C99 without dependencies: for a controller's cycle, without allocation or
unbounded loops.
"""

from __future__ import annotations

from dataclasses import dataclass
from string import Template
from typing import ClassVar

from pincal.calibration.fitted_robot import FittedRobot
from pincal.export.exported import (
    FORMATS,
    Exported,
    Format,
    as_comment,
    export_notes,
    filled,
    header,
    identifier,
    template_of,
)
from pincal.export.formulas import Formulas, Language, WrittenPart, written
from pincal.export.numpy_source import checked_formulas, numpy_source, refuse_wrong

_C = Language(
    statement="    const double {} = {};",
    functions={
        "arcsin": "asin",
        "arccos": "acos",
        "arctan": "atan",
        "arcsinh": "asinh",
        "arctan2": "atan2",
    },
    select="{} ? {} : {}",
    is_select_atom=False,
    input=lambda name: name if name.startswith("moments") else f"state->{name}",
    curve=lambda i, curve, x: (
        f"cubic({x}, {curve.lower!r}, {curve.upper!r}, {len(curve.pieces)}, curve_{i})"
    ),
)


@FORMATS.register
@dataclass(frozen=True)
class CSource(Format):
    """One C99 header and one source: forward kinematics and compensation of one pose.

    Attributes:
        frame: frame of the poses: "instrument" or "base".
    """

    frame: str = "instrument"
    name: ClassVar[str] = "c"
    meaning: ClassVar[str] = "C99 without dependencies, for a controller's cycle"

    def export(self, calibrated: FittedRobot) -> Exported:
        formulas = checked_formulas(calibrated, self.frame)
        name = identifier(calibrated.model.chain.robot.name)
        files = {
            f"{name}.{kind}": _file(formulas, name, kind=kind, frame=self.frame).encode()
            for kind in "hc"
        }
        worst = refuse_wrong(formulas.calibrated, text=numpy_source(formulas, frame=self.frame))
        return Exported(files, export_notes(calibrated, formulas), worst)


def _file(formulas: Formulas, name: str, *, kind: str, frame: str) -> str:
    chain = formulas.calibrated.model.chain
    functions, curves = _functions(formulas, name)
    return filled(
        template_of(f"model.{kind}.in"),
        formulas,
        frame=frame,
        numbers=lambda values: ", ".join(
            repr(float(value)).replace("inf", "INFINITY") for value in values
        ),
        header="\n".join(f" * {line}".rstrip() for line in header(formulas, frame=frame)),
        name=name,
        NAME=name.upper(),
        joints=", ".join(as_comment(chain.robot.joint_names[i]) for i in formulas.joints),
        targets=", ".join(map(as_comment, chain.targets)),
        n_targets=str(len(chain.targets)),
        n_moments=str(3 * chain.robot.n_joints),
        needs="".join(f", {name}" for name in formulas.inputs),
        curves=curves,
        evaluate=functions,
        declared=Template(_DECLARED).substitute(name=name, frame=frame) if formulas.motions else "",
    )


def _functions(formulas: Formulas, name: str) -> tuple[str, str]:
    """Return the functions that evaluate the formulas, and their tables."""
    found = written(_C, formulas)
    lines, results = found.moments
    parts = (found.pose, found.columns)
    functions = []
    taken = ""
    if formulas.moments:
        returned = [f"    taken[{i}] = {text};" for i, text in enumerate(results)]
        arguments = (
            f"const {name}_state *state, const double moments[MOMENTS], double taken[MOMENTS]"
        )
        functions.append(
            "\n".join([f"static void moments_of({arguments})", "{", *lines, *returned, "}", ""])
        )
        taken = _TAKEN
    blocks = [
        [*lines, *(f"    {target}[{i}] = {text};" for i, text in enumerate(results))]
        for target, (lines, results) in zip(("pose", "columns"), parts, strict=True)
    ]
    body = [*blocks[0], "    if (!columns)", "        return;", *blocks[1]]
    unused = [] if taken else ["    (void)moments;"]
    functions.append("\n".join([_EVALUATE.format(name=name, taken=taken), *unused, *body, "}", ""]))
    if formulas.motions:
        functions.append(_uncertainty(formulas, name, found.motions))
    tables = [
        f"static const double curve_{i}[{len(curve.pieces)}][4] = {{"
        + ", ".join("{" + ", ".join(map(repr, piece)) + "}" for piece in curve.pieces)
        + "};"
        for i, curve in enumerate(found.curves)
    ]
    return "\n".join(functions), "\n".join([*tables, *([_CUBIC] if tables else [])])


def _uncertainty(formulas: Formulas, name: str, motions: WrittenPart) -> str:
    """Return the function of the uncertainty."""
    lines, results = motions
    spread = formulas.spread
    numbers = ",\n".join(f"    {{{', '.join(row)}}}" for row in spread.rows())
    return Template(_UNCERTAINTY).substitute(
        name=name,
        parameters=len(results) // 3,
        errors=spread.root.shape[1],
        root=numbers,
        rest=f"{spread.rest:.9g}",
        motions="\n".join(
            [*lines, *(f"    motions[{i}] = {text};" for i, text in enumerate(results))]
        ),
    )


_DECLARED = """
/*
 * The standard uncertainty of the target's position along the axes of the $frame frame [m]: of
 * the calibration's parameters, of what the model lacks and of how the robot arrives.
 */
void ${name}_uncertainty(const ${name}_state *state, double sigma[3]);
"""

_UNCERTAINTY = """
/* How the uncertain parameters and the drives err, by independent errors of unit variance. */
static const double root[$parameters][$errors] = {
$root};

/* How each uncertain parameter and drive moves the target. */
static void motions_of(
    const ${name}_state *state, const double moments[MOMENTS], double motions[3 * $parameters])
{
    (void)state;
    (void)moments;
$motions
}

void ${name}_uncertainty(const ${name}_state *state, double sigma[3])
{
    double moments[MOMENTS] = {0.0}, pose[12], motions[3 * $parameters];
    int a, p, r;
    evaluate(state, moments, pose, 0);
    motions_of(state, moments, motions);
    for (a = 0; a < 3; ++a) {
        double errors[$errors] = {0.0}, sum = $rest;
        for (p = 0; p < $parameters; ++p)
            for (r = 0; r < $errors; ++r)
                errors[r] += motions[3 * p + a] * root[p][r];
        for (r = 0; r < $errors; ++r)
            sum += errors[r] * errors[r];
        sigma[a] = sqrt(sum);
    }
}
"""

_EVALUATE = """/*
 * The pose, and unless columns is null how each joint moves and turns the target, row by row, six \
rows.
 * Static moments that are taken on the bent arm start from moments, and are left there.
 */
static void evaluate(const {name}_state *state, double moments[MOMENTS], double pose[12], \
double columns[6 * N])
{{{taken}"""

_TAKEN = """
    double taken[MOMENTS];
    int round, i;
    for (round = 0; round < 20; ++round) {
        double change = 0.0, largest = 0.0;
        moments_of(state, moments, taken);
        for (i = 0; i < MOMENTS; ++i) {
            change = fmax(change, fabs(taken[i] - moments[i]));
            largest = fmax(largest, fabs(taken[i]));
            moments[i] = taken[i];
        }
        if (change <= 1e-11 * largest)
            break;
    }"""

_CUBIC = """
/* A piecewise cubic over equal pieces, constant beyond its ends. */
static double cubic(double x, double first, double last, int pieces, const double curve[][4])
{
    double t = (fmin(fmax(x, first), last) - first) / (last - first) * pieces;
    int i = (int)t;
    if (i >= pieces)
        i = pieces - 1;
    t -= i;
    return ((curve[i][3] * t + curve[i][2]) * t + curve[i][1]) * t + curve[i][0];
}
"""
