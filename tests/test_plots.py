"""Figures of results: what they show, what they refuse, and that they leave matplotlib's state alone."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from report_cases import HOSTILE, kuka_run

from pincal import Robot
from pincal.calibration.calibration import Calibration
from pincal.report.illustrations import inline_svg
from pincal.report.plots import found, row_figures, style
from pincal.report.subject import RowErrors, evidence_of

OF_EVIDENCE = {
    "histogram": row_figures.histogram_figure,
    "cumulative": row_figures.cumulative_figure,
    "joint": lambda evidence: row_figures.joint_figure(evidence, 1),
    "top": lambda evidence: row_figures.workspace_figure(evidence, "top"),
    "side": lambda evidence: row_figures.workspace_figure(evidence, "side"),
    "order": row_figures.order_figure,
    "drift": row_figures.drift_figure,
}


@pytest.fixture(scope="module")
def run(kuka: Robot) -> Calibration:
    return kuka_run(kuka)


@pytest.fixture(scope="module")
def evidence(run: Calibration) -> RowErrors:
    return evidence_of(run)[0]


def only(evidence: RowErrors, rows: np.ndarray) -> RowErrors:
    """Return some rows of the evidence."""
    by_row = ("is_held", "is_outlier", "q", "place", "line")
    parts = {name: getattr(evidence, name)[rows] for name in by_row}
    return replace(evidence, before=evidence.before[:, rows], after=evidence.after[:, rows], **parts)


def test_evidence_is_that_of_the_result(run: Calibration, evidence: RowErrors) -> None:
    """Sizes of errors row by row have the statistics that result.json has."""
    for model, which in (("nominal", "before"), ("calibrated", "after")):
        for part, held in (("train", False), ("test", True)):
            sizes = evidence.sizes(which)[evidence.part(held=held)]
            assert sizes.mean() == pytest.approx(run.result.error[model][part]["mean_mm"])
            assert sizes.max() == pytest.approx(run.result.error[model][part]["max_mm"])
    assert evidence.noise == pytest.approx(0.05) and len(evidence.line) == 80


def test_the_axis_of_an_imu_has_no_name_of_the_program(evidence: RowErrors) -> None:
    """Its unit tells the quantity, and fits a small figure; a position keeps its name."""
    for name, unit, label in (("specific_force", "m/s^2", "error [m/s^2]"), ("position", "mm", "position error [mm]")):
        (axes,) = row_figures.histogram_figure(replace(evidence, name=name, unit=unit)).axes
        assert axes.get_xlabel() == label


@pytest.mark.parametrize("name", OF_EVIDENCE)
def test_each_figure_is_drawn(name: str, evidence: RowErrors) -> None:
    """Each figure has axes with labels and units, and becomes an SVG without a foreign colour of text."""
    figure = OF_EVIDENCE[name](evidence)
    assert any("[" in axes.get_xlabel() or "line" in axes.get_xlabel() for axes in figure.axes)
    svg = inline_svg(figure, key="k", title="a <title>")
    assert svg.startswith('<svg viewBox="') and 'aria-label="a &lt;title&gt;"' in svg and "http" not in svg
    assert "#000000" not in svg and "var(--ink)" in svg and len(svg) < 300_000


@pytest.mark.parametrize("name", OF_EVIDENCE)
@pytest.mark.parametrize("count", [1, pytest.param(5, marks=pytest.mark.long)])
def test_few_rows_are_enough(name: str, count: int, evidence: RowErrors) -> None:
    """A handful of rows, or a single one, makes a figure."""
    rows = np.flatnonzero(evidence.is_held)[:count]
    inline_svg(OF_EVIDENCE[name](only(evidence, rows)), key="k", title="few")


@pytest.mark.parametrize("name", OF_EVIDENCE)
def test_no_rows_are_refused(name: str, evidence: RowErrors) -> None:
    """Nothing to draw is an error that says so."""
    with pytest.raises(ValueError, match=r"no .*rows to draw"):
        OF_EVIDENCE[name](only(evidence, np.zeros(0, int)))


@pytest.mark.long
def test_exact_errors_are_drawn(evidence: RowErrors) -> None:
    """Errors of zero have a place on logarithmic axes."""
    exact = replace(evidence, after=0.0 * evidence.after)
    for draw in OF_EVIDENCE.values():
        inline_svg(draw(exact), key="k", title="exact")
    nothing = replace(exact, before=0.0 * evidence.before)
    for draw in OF_EVIDENCE.values():
        inline_svg(draw(nothing), key="k", title="nothing")


def test_time_takes_the_place_of_lines(evidence: RowErrors) -> None:
    """Where times were recorded they are the axis, in hours."""
    timed = replace(evidence, time=60.0 * np.arange(len(evidence.line)))
    assert "[h]" in row_figures.order_figure(timed).axes[0].get_xlabel()
    assert row_figures.drift_figure(timed).axes[0].get_xlim()[1] == pytest.approx(79 / 60, abs=0.2)


def test_corrections_are_those_of_identified_parameters(run: Calibration) -> None:
    """Lengths and angles that the data tell are drawn, the largest first; without any there is no figure."""
    figure = found.correction_figure(run.result.parameters, "m")
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    told = {p.name for p in run.result.parameters if p.status == "identified" and p.unit == "m"}
    assert set(names) <= told
    with pytest.raises(ValueError, match="no identified parameter"):
        found.correction_figure([], "rad")


def test_a_hostile_name_is_drawn_as_text(evidence: RowErrors) -> None:
    """Mark-up, dollars and line ends in a name are neither mark-up nor mathematics."""
    names = (evidence.joint_names[0], HOSTILE, *evidence.joint_names[2:])
    svg = inline_svg(row_figures.joint_figure(replace(evidence, joint_names=names), 1), key="k", title=HOSTILE)
    assert "<script" not in svg and "<b " not in svg and "&lt;script&gt;" in svg
    assert "$x_1$" in style.drawable("$x_1$").replace("\\", "")


def test_figures_in_one_page_share_no_identifier(evidence: RowErrors) -> None:
    """Identifiers begin with the figure's key, and each that is referred to is there."""
    import re

    for key in ("f1", "f2"):
        svg = inline_svg(row_figures.order_figure(evidence), key=key, title="order")
        found = re.findall(r' id="([^"]+)"', svg)
        assert found and all(name.startswith(f"{key}-") for name in found)
        assert set(re.findall(r'(?:url\(#|href="#)([^)"]+)', svg)) <= set(found)


def test_the_same_figure_is_the_same_text(evidence: RowErrors) -> None:
    """Drawn twice a figure is equal to the letter, so that a report is, too."""
    first, second = (inline_svg(row_figures.cumulative_figure(evidence), key="k", title="t") for _ in range(2))
    assert first == second


@pytest.mark.long
def test_no_display_and_no_pyplot_is_touched() -> None:
    """Importing the figures imports no pyplot, whose state is everybody's."""
    code = (
        "import sys, pincal.report.plots.row_figures, pincal.report.plots.found; print('matplotlib.pyplot' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "False"


def test_colours_are_told_apart_by_colour_blind_readers() -> None:
    """Before and after differ in lightness or in blue against yellow, whatever cone is missing (Vienot's projection)."""
    # Linear RGB as seen without L, without M cones.
    blind = (
        np.array([[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]]),
        np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]]),
    )
    rgb = [np.array([int(c[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]) ** 2.2 for c in (style.BEFORE, style.AFTER)]
    for seen in (np.eye(3), *blind):
        a, b = (np.clip(seen @ colour, 0.0, 1.0) ** (1 / 2.2) for colour in rgb)
        assert np.linalg.norm(a - b) > 0.4
