"""Readings between any two links: hands that touch, a head that looks, an arm on a track, a palletizer with rods.

Five machines with unknown errors are simulated and calibrated, with the commands that are printed:

- Baxter's hands touch: a ball on the right one in two sockets on the left one, and a tracker that measures only the left
  hand; the right hand is predicted in the tracker's frame.
- TALOS: a camera on the head reads marks on the left wrist.
- A KUKA on a track of 4 m, measured by a tracker: the track is a joint like any other.
- A palletizer: the joints of its rods follow from the drives, and need no columns.
- A cell of two robots with a file each: the pose of the second one is not given but identified from contacts.

Run it as ``python examples/any_two_links.py [--out FOLDER]``.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import shlex
import sys
import tempfile
from pathlib import Path

from pincal.builtin import kuka_urdf_path
from pincal.cli import main

URDF = Path(__file__).resolve().parents[1] / "urdf"
_TRACK = """  <link name="floor"/>
  <joint name="track" type="prismatic">
    <parent link="floor"/><child link="{base}"/><origin xyz="0 0 0.3"/><axis xyz="1 0 0"/>
    <limit lower="-2" upper="2" effort="1000" velocity="1"/>
  </joint>
</robot>
"""


def run(command: str) -> str:
    """Run a command of pincal, print it, and return what it prints."""
    print(f"$ pincal {command}")
    told, sys.argv = io.StringIO(), ["pincal", *shlex.split(command), "--quiet"]
    with contextlib.redirect_stdout(told), contextlib.suppress(SystemExit):
        main()
    return told.getvalue()


def shown(results: Path) -> None:
    """Print the errors of a calibration."""
    result = json.loads((results / "result.json").read_text())
    before, after = (result["error"][model]["test"]["mean_mm"] for model in ("nominal", "calibrated"))
    print(f"  held out: nominal {before:.3f} mm, calibrated {after:.4f} mm; {result['verdict']}\n")


def two_arms(out: Path) -> None:
    """Calibrate both of Baxter's arms by contacts and a tracker that measures one hand."""
    noise = "--no-floor --noise 0.05mm --seed 1"
    left, right, touch = (out / f"{name}.csv" for name in ("left", "right", "touch"))
    run(f"simulate baxter --tip left_gripper --also right_gripper --poses 150 {noise} --out {left}")
    run(f"simulate baxter --tip right_gripper --also left_gripper --poses 150 {noise} --out {right}")
    hands = "--from left_gripper --tip right_gripper --also left_gripper --sockets 2"
    run(f"simulate baxter {hands} --poses 200 {noise} --out {touch}")
    run(f"calibrate baxter {touch} {left} --noise 0.05mm --out {out / 'both'}")
    shown(out / "both")
    found = json.loads(run(f"validate {out / 'both' / 'model.json'} {right} --json"))
    print(f"  the other hand, which no tracker saw: {found['error']['calibrated']['test']['mean_mm']:.4f} mm\n")


def head(out: Path) -> None:
    """Calibrate TALOS' head and left arm by marks on the wrist that the head's camera reads."""
    marks = out / "marks.csv"
    links = "--from rgbd_optical_frame --tip gripper_left_base_link"
    run(f"simulate talos {links} --poses 200 --no-floor --noise 0.05mm --out {marks}")
    run(f"calibrate talos {marks} --noise 0.05mm --out {out / 'head'}")
    shown(out / "head")


def track(out: Path) -> None:
    """Calibrate a KUKA on a track."""
    text = kuka_urdf_path().read_text(encoding="utf-8")
    robot, table = out / "kuka_on_track.urdf", out / "track.csv"
    robot.write_text(text.replace("</robot>", _TRACK.format(base="base_link")), encoding="utf-8")
    run(f"simulate {robot} --tip tool0 --poses 250 --noise 0.05mm --out {table}")
    run(f"calibrate {robot} {table} --noise 0.05mm --out {out / 'track'}")
    shown(out / "track")


def palletizer(out: Path) -> None:
    """Calibrate a palletizer by the positions of its four drives."""
    robot, table = URDF / "palletizer.urdf", out / "palletizer.csv"
    run(f"simulate {robot} --poses 150 --noise 0.05mm --out {table}")
    run(f"calibrate {robot} {table} --noise 0.05mm --out {out / 'palletizer'}")
    shown(out / "palletizer")


def cell(out: Path) -> None:
    """Calibrate a UR5 that a tracker measures, and a UR10 next to it that touches it."""
    left, right, touch = (out / f"cell_{name}.csv" for name in ("left", "right", "touch"))
    both, noise = "ur5 --beside right=ur10@1.3m,0.2m,0,0,0,170deg", "--no-floor --noise 0.05mm --seed 1"
    run(f"simulate {both} --tip tool0 --also right_tool0 --poses 120 {noise} --out {left}")
    run(f"simulate {both} --tip right_tool0 --also tool0 --poses 120 {noise} --out {right}")
    run(f"simulate {both} --from tool0 --tip right_tool0 --also tool0 --sockets 2 --poses 200 {noise} --out {touch}")
    run(f"calibrate ur5 {left} {touch} --beside right=ur10 --noise 0.05mm --out {out / 'cell'}")
    shown(out / "cell")
    found = json.loads(run(f"validate {out / 'cell' / 'model.json'} {right} --json"))
    print(f"  the other robot, which no tracker saw: {found['error']['calibrated']['test']['mean_mm']:.4f} mm\n")


def demonstrate() -> None:
    """Run all five."""
    parser = argparse.ArgumentParser(description="Calibrate between any two links.")
    parser.add_argument("--out", type=Path, help="folder for tables and results; default: a temporary one")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = given.out or Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        for act in (two_arms, head, track, palletizer, cell):
            act(out)


if __name__ == "__main__":
    demonstrate()
