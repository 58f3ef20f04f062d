"""Calibrations for the tests of reports: plain and hostile names, seven joints, no held-out rows, poses, distances."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from discovery_cases import draw_case
from msgspec import structs

from pincal import GEOMETRIC, Options, Robot, run_calibration
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.calibration import Calibration
from pincal.diagnosis.robot_diagnosis import Diagnosis, diagnose
from pincal.discover.discovery_file import EffectName
from pincal.discover.run import Discovery, run_discovery
from pincal.measure.measurements import Measurements
from pincal.measure.table import measurements_from_arrays
from pincal.report.html import report_page
from pincal.report.subject import Subject
from pincal.robot.urdf_file import find_file

NOISE = 5e-5
ORIGIN: dict[str, Any] = {
    "pincal": "0",
    "python": "3",
    "command": "pincal test",
    "seed": 0,
    "inputs": {"data.csv": "0" * 64},
}
# What a report must not take for more than text: mark-up, quotes, mathematics, an end of line.
HOSTILE = "<script>window.hacked = 1</script>\"'&$x_1$\n<b onload=alert(1)>{{ 7 * 7 }}"


def measured(robot: Robot, urdf: Any, n: int, *, kind: str = "position", seed: int = 0, **options: Any) -> Measurements:
    """Return a table of a machine that differs from its drawing by half a millimetre and half a milliradian."""
    rng = np.random.default_rng(seed)
    machine = sim.TrueMachine.from_urdf(urdf, tip=robot.tip, base=robot.base)
    machine = machine.draw_errors(rng, sigma_length=5e-4, sigma_angle=5e-4)
    q = robot.random_configurations(n, rng)
    angle = 2e-5 if kind == "pose" else 0.0
    tracker = sim.Instrument(targets=(0.1, 0.0, 0.2), reads=kind, sigma=NOISE, sigma_angle=angle)
    columns = tracker.measure(machine, q, rng=rng)
    found: dict[str, Any] = {}
    if kind == "distance":
        found["distance"] = columns["distance"]
    else:
        found["position"] = np.column_stack([columns[c] for c in "xyz"])
    if kind == "pose":
        found["quaternion"] = np.column_stack([columns[c] for c in ("qx", "qy", "qz", "qw")])
    return measurements_from_arrays(robot.joint_names, q, **found, **options)


def kuka_run(
    kuka: Robot, n: int = 80, *, kind: str = "position", test_fraction: float = 0.25, **options: Any
) -> Calibration:
    """Return a geometric calibration of the built-in arm."""
    table = measured(kuka, kuka_urdf_path(), n, kind=kind)
    chosen = Options(effects=GEOMETRIC, **({"sigma": NOISE} | options))
    return run_calibration(kuka, table, chosen, test_fraction=test_fraction, split="random")


@cache
def hostile_run() -> Calibration:
    """Return a calibration in which robot, links, joints and table have names that would be mark-up."""
    from xml.sax.saxutils import quoteattr

    text = kuka_urdf_path().read_text(encoding="utf-8")
    rename = {'"joint_2"': HOSTILE + "2", '"tool0"': HOSTILE, '"joint_3"': "j3 " + "very_long_name_" * 6}
    for old, new in rename.items():
        text = text.replace(old, quoteattr(new).replace("\n", "&#10;"))
    name = text[text.index("<robot") :].split('"')[1]
    text = text.replace(f'"{name}"', quoteattr(HOSTILE), 1)
    robot = Robot.from_urdf(text.encode())
    plain = Robot.from_urdf(kuka_urdf_path())
    table = measured(plain, kuka_urdf_path(), 80)
    renamed = measurements_from_arrays(robot.joint_names, table.q, position=table.position, source=HOSTILE)
    return run_calibration(robot, renamed, Options(effects=GEOMETRIC, sigma=NOISE))


@cache
def discovered() -> Discovery:
    """Return a discovery of backlash."""
    case = draw_case("backlash", 3, n=160, arm="kuka", strength=200.0)
    return run_discovery(case.robot, case.rows, case.options)


def discovered_many(n: int) -> Discovery:
    """Return the same with n effects, each of which could be two others, as the page of a real arm has them."""
    found = discovered()
    first = found.findings.effects[0]
    others = tuple(EffectName(effect="encoder_subdivision", joint="joint_2", order=order) for order in (141.35, 70.675))
    more = {"equivalent": others, "tell_apart": "no further measurement of this kind distinguishes them; inspect the joint"}
    kinds = ("backlash", "gear_ripple")
    effects = [structs.replace(first, joint=f"joint_{k % 6 + 1}", effect=kinds[k % 2], **more) for k in range(n)]
    steps = [structs.replace(found.gaps[-1], name=f"+ gear_ripple of shoulder_lift_joint order {k}") for k in range(n)]
    findings = structs.replace(found.findings, effects=tuple(effects))
    return replace(found, findings=findings, gaps=(found.gaps[0], *steps))


def panda_run() -> Calibration:
    """Return a calibration of an arm with seven joints."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        robot = Robot.from_urdf("panda", tip="panda_link8")
        table = measured(robot, find_file("panda"), 90)
        return run_calibration(robot, table, Options(effects=GEOMETRIC))


def page_of(run: Calibration, **more: Any) -> str:
    """Return the report of a calibration."""
    return report_page(Subject(run, ORIGIN, ("elasticity stays in model.json",), **more))


def drifted(kuka: Robot) -> Diagnosis:
    """Return the diagnosis of an arm whose second zero has moved by half a milliradian."""
    model = run_calibration(kuka, measured(kuka, kuka_urdf_path(), 80), Options(effects=GEOMETRIC, sigma=NOISE)).fit
    rng = np.random.default_rng(0)
    # The machine of the calibration is the first that is drawn.
    machine = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip=kuka.tip, base=kuka.base)
    machine = machine.draw_errors(rng, sigma_length=5e-4, sigma_angle=5e-4)
    q = kuka.random_configurations(40, rng)
    tracker = sim.Instrument(targets=(0.1, 0.0, 0.2), sigma=NOISE)
    read = tracker.measure(machine, q + 5e-4 * np.eye(6)[1], rng=rng)
    place = np.column_stack([read[name] for name in "xyz"])
    return diagnose(model.at(), measurements_from_arrays(kuka.joint_names, q, position=place))
