"""Make the pictures of the README from the program itself, and print its figures: ``python docs/pictures.py SERIES_B.csv``.

The table is that of ``examples/ur10_tracker.py``: a real UR10 before a laser tracker. The 3D view is drawn by Chromium,
which Selenium has to find.
"""

from __future__ import annotations

import argparse
import io
import tempfile
import time
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import font_manager
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Rectangle
from PIL import Image, ImageDraw, ImageFont
from selenium import webdriver

from pincal import Robot, read_measurements, run_discovery
from pincal.discover.report.found_drawings import discovery_drawings
from pincal.discover.run import Discovery
from pincal.measure.measurements import Measurements
from pincal.viewer import build_scene, write_html

# Identifiers in drawings are the same each time.
matplotlib.rcParams["svg.hashsalt"] = "pincal"
PICTURES = Path(__file__).parent / "pictures"
# Width of the page's panel, which the picture leaves out [px].
_PANEL = 360
_SEE = """
for (const path of [["points", "measured"], ["points", "held out"], ["workspace"]])
  viewer.set_property(path, "visible", false);
for (const bar of document.querySelectorAll(".dg")) bar.style.display = "none";
for (const layer of pincal.layers)
  viewer.set_property(layer.path, "visible", layer.path[0] === "deviations" && layer.path[1] === arguments[0]);
"""


def draw_view(found: Discovery, table: Measurements) -> None:
    """Draw the robot with its deviations at the measured poses, before and after, side by side."""
    calibrated = found.calibration.fit.at()
    error = found.calibration.result.error
    told = {
        "before": f"nominal kinematics: mean error {error['nominal']['test']['mean_mm']:.2f} mm",
        "after": f"calibrated by pincal: mean error {error['calibrated']['test']['mean_mm']:.2f} mm",
    }
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 26)
    # A pose in the middle, which hides little.
    middle = int(np.argmin(np.linalg.norm(table.position - table.position.mean(axis=0), axis=1)))
    options = webdriver.ChromeOptions()
    for word in ("--headless=new", "--no-sandbox", "--window-size=1150,900", "--enable-unsafe-swiftshader"):
        options.add_argument(word)
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "view.html"
        write_html(page, build_scene(calibrated, table, grid=0).opening(table.q[middle]))
        browser = webdriver.Chrome(options=options)
        try:
            browser.get(page.as_uri())
            parts = []
            for layer in ("before", "after"):
                browser.execute_script(_SEE, layer)
                time.sleep(3.0)
                shot = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
                parts.append(shot.crop((_PANEL, 0, shot.width, shot.height)))
                ImageDraw.Draw(parts[-1]).text((24, 20), told[layer], fill="white", font=font)
        finally:
            browser.quit()
    both = Image.new("RGB", (sum(part.width for part in parts), parts[0].height))
    for k, part in enumerate(parts):
        both.paste(part, (k * part.width, 0))
    both.save(PICTURES / "view.png", optimize=True)


def tell(found: Discovery) -> None:
    """Print the figures of the README: mean errors of poses that fits have not seen, stage by stage, and by each way."""
    for stage in found.findings.chain:
        print(f"{stage.name:60s} {stage.mean_mm:.3f} mm")
    for way, gap in found.findings.held_out.items():
        print(f"{'held-out ' + way:60s} {gap['before'].mean_mm:.3f} mm before, {gap['after'].mean_mm:.3f} mm after")


def draw_gap(found: Discovery) -> None:
    """Draw how the error on held-out poses shrinks as one effect after the other is found."""
    figure, _, _ = next(iter(discovery_drawings(found)))
    figure.savefig(PICTURES / "gap.svg", bbox_inches="tight", metadata={"Date": None})


def draw_link() -> None:
    """Draw one joint and its link with the symbols of the model, as a scheme."""
    ink, axis, bent = "#334155", "#0072b2", "#d55e00"
    figure = Figure(figsize=(8.0, 3.6))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, 8.0), ylim=(0.0, 3.6))
    axes.axis("off")

    def arrow(start: tuple[float, float], end: tuple[float, float], colour: str) -> None:
        axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 1.6})

    def text(x: float, y: float, words: str, colour: str = ink, size: float = 12.0) -> None:
        axes.text(x, y, words, color=colour, fontsize=size, ha="center", va="center")

    # The nominal axis, the real one tilted against it, and the turn about it.
    axes.plot([1.5, 1.5], [0.4, 3.2], "--", color=ink, linewidth=1.0)
    arrow((1.42, 0.4), (1.72, 3.3), axis)
    axes.add_patch(Arc((1.62, 2.35), 0.9, 0.35, theta1=100.0, theta2=430.0, color=axis, linewidth=1.6))
    text(2.55, 2.35, r"$q + \theta$", axis)
    text(1.02, 3.3, "nominal axis", ink, 9.0)
    text(2.3, 3.3, "tilted by $s_x, s_y$", axis, 9.0)
    # The bearing at its height, which is compliant.
    axes.add_patch(Rectangle((1.3, 1.35), 0.5, 0.28, color=bent, alpha=0.35))
    text(2.65, 1.5, "bearing: $\\gamma_x, \\gamma_y, \\gamma_z$", bent)
    axes.annotate("", (0.85, 1.5), (0.85, 0.4), arrowprops={"arrowstyle": "<->", "color": ink})
    text(0.65, 0.95, "$h$")
    axes.plot([0.8, 1.45], [0.4, 0.4], color=ink, linewidth=0.8)
    text(1.75, 0.3, "frame before", ink, 9.0)
    # The link to the next axis.
    axes.plot([1.66, 5.6], [2.85, 2.85], color=ink, linewidth=5.0, alpha=0.35, solid_capstyle="round")
    axes.annotate("", (1.7, 3.12), (5.55, 3.12), arrowprops={"arrowstyle": "<->", "color": ink})
    text(3.9, 3.3, "$a$")
    axes.annotate("", (0.35, 2.85), (0.35, 0.4), arrowprops={"arrowstyle": "<->", "color": ink})
    axes.plot([0.3, 1.6], [2.85, 2.85], color=ink, linewidth=0.8)
    text(0.18, 1.6, "$d$")
    arrow((5.3, 1.5), (5.95, 3.45), axis)
    axes.plot([5.6, 5.6], [1.5, 3.4], "--", color=ink, linewidth=1.0)
    axes.add_patch(Arc((5.6, 2.6), 1.6, 1.6, theta1=70.0, theta2=90.0, color=ink))
    text(6.15, 3.2, "$\\alpha$")
    text(6.3, 1.6, "next axis", axis, 9.0)
    # What bends it.
    arrow((4.1, 2.75), (4.1, 1.9), bent)
    text(3.3, 1.95, "weight of all beyond", bent, 9.0)
    figure.savefig(PICTURES / "link.svg", metadata={"Date": None})


def main() -> None:
    """Discover on the table, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", type=Path)
    arguments = parser.parse_args()
    robot = Robot.from_urdf("ur10")
    table = read_measurements(arguments.table, robot.joint_names)
    found = run_discovery(robot, table)
    PICTURES.mkdir(exist_ok=True)
    tell(found)
    draw_link()
    draw_gap(found)
    draw_view(found, table)


if __name__ == "__main__":
    main()
