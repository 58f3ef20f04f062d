"""``pincal demo``: the life of the KUKA KR 125/2 of the paper, from calibration to a collision, on
simulated measurements.

First the robot of Table I is calibrated. Then one of its gears has an error that the model lacks,
and discovery finds it. With the model that was found a program is compensated. Last, the robot is
hit, and ten poses show what changed; the model is re-identified.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pincal.cli.arguments import Output, group, option, verb
from pincal.cli.common import GeneralOptions
from pincal.cli.outputs import print_json, provenance
from pincal.errors import Exit
from pincal.io.result_folder import output_folder
from pincal.thresholds import Count, Scale

if TYPE_CHECKING:
    from rich.console import Console

    from pincal.calibration.calibration import Calibration
    from pincal.diagnosis.robot_diagnosis import Diagnosis
    from pincal.discover.run import Discovery
    from pincal.identify.options import Options
    from pincal.measure.measurements import Measurements
    from pincal.model.effect import Effect
    from pincal.robot.robot import Robot
    from pincal.simulate.instrument import Instrument
    from pincal.simulate.paper_machine import PaperMachine

# The models of the paper, with what is calibrated in each.
_MODELS = {
    "standard DH": "standard DH: base and tool only",
    "DH,s": "DH,s: lengths and angles, too",
    "DH,s,e": "DH,s,e: and elasticity",
}
# Why a better rigid model is hardly better here.
_SOFT = (
    "DH,s is hardly better than standard DH here: most of this machine's error is the deflection "
    "of drives and bearings under a payload of 125 kg, which no lengths and angles of rigid links "
    "can follow. Independent errors add as squares, so that the geometry which DH,s corrects shows "
    "little beside it. DH,s,e has both."
)
# As in the paper's section V: a tool point off the flange, and a tracker in an unknown pose.
_TOOL: tuple[Scale, Scale, Scale] = (0.05, 0.03, 0.12)
_NOISE: Scale = 5e-5
_ROWS: Count = 300
# The second act: the amplitude of a gear's error [rad], some forty arcseconds, and where it is.
_SIZE: Scale = 2e-4
_JOINT = "joint_1"
_HIDDEN_FOLDER = "hidden_effect"
# The third act: poses of a program.
_PROGRAM: Count = 200
# The fourth act: by how much a collision shifts the zero of a joint [rad], which one, and the
# number of poses measured then.
_HIT: Scale = 1e-3
_HIT_JOINT = "joint_3"
_HIT_ROWS: Count = 10
_HIT_FOLDER = "hit"
# Names of files in these folders.
_DATA = "measurements.csv"
_URDF = "kuka_kr125_2.urdf"


@dataclass(frozen=True, kw_only=True)
class DemoArguments:
    """Arguments of demo."""

    out: Path = option("Folder to write to.", Path("pincal-demo"), metavar="DIR", type=Output())
    seed: int = option("Random seed of poses and noise.", 1)
    general: GeneralOptions = group("General")


@verb(DemoArguments, examples="Example:\n  pincal demo --out kuka")
def demo(arguments: DemoArguments) -> Exit:
    """Run the complete example on a KUKA KR 125/2; no data needed."""
    from pincal.builtin import kuka_urdf_path
    from pincal.diagnosis.cli.new_rows import write_diagnosis
    from pincal.robot.robot import Robot

    robot = Robot.from_urdf(kuka_urdf_path())
    out = arguments.out
    seed = arguments.seed
    bad = _hidden_machine()
    with (
        output_folder(out) as draft,
        output_folder(out / _HIDDEN_FOLDER) as second,
        output_folder(out / _HIT_FOLDER) as fourth,
    ):
        runs = _calibrate(draft, robot, seed)
        found, tracker = _discover(second, robot, seed, machine=bad)
        q = robot.random_configurations(_PROGRAM, np.random.default_rng([seed, 3]))
        missed = _compensate(second, found, q, machine=bad, tracker=tracker)
        model = second / "model.json"
        rng = np.random.default_rng([seed, 4])
        diagnosis = _collide(model, fourth, robot, machine=bad, rng=rng)
        origin = provenance([model, fourth / _DATA], seed=seed)
        write_diagnosis(fourth, diagnosis, origin)
    acts = _Acts(runs, found, missed, diagnosis)
    if arguments.general.as_json:
        print_json(acts.to_dict())
    else:
        acts.print(out)
    return Exit.DONE


@dataclass(frozen=True)
class _Acts:
    """What the acts of the demo give.

    Attributes:
        runs: the calibrations, by the name of the model.
        found: the search for the hidden effect.
        missed: mean and largest error of the program [mm], as programmed and corrected.
        diagnosis: of the poses after the collision.
    """

    runs: dict[str, Calibration]
    found: Discovery
    missed: dict[str, dict[str, float]]
    diagnosis: Diagnosis

    def to_dict(self) -> dict[str, Any]:
        """Return all results as plain data."""
        return {name: run.result.to_dict() for name, run in self.runs.items()} | {
            "discovery": self.found.report,
            "program_error_mm": self.missed,
            "diagnosis": self.diagnosis.report,
        }

    def print(self, out: Path) -> None:
        """Print all acts, and what was written to a folder."""
        from pincal.cli.progress import console

        screen = console()
        _print_calibration(self.runs, screen)
        _print_hidden(self.found, screen, folder=out / _HIDDEN_FOLDER)
        _print_program(self.missed, screen)
        _print_collision(self.diagnosis, screen)
        _print_files(out, screen)


def _hidden_machine() -> PaperMachine:
    """Return the machine of the paper with an elliptical gear wheel."""
    from pincal.simulate.paper_machine import PaperMachine
    from pincal.simulate.typical import hidden_effect

    effect = hidden_effect("gear_eccentricity", joint=_JOINT, order=2, size=_SIZE)
    return PaperMachine(effects=(effect,))


def _calibrate(folder: Path, robot: Robot, seed: int) -> dict[str, Calibration]:
    """Calibrate the machine of the paper, with and without elasticity, and write the former."""
    from pincal.builtin import kuka_urdf_path
    from pincal.calibration.calibration import run_calibration
    from pincal.cli.fit_output import FitOutput
    from pincal.cli.fitting import write_results
    from pincal.model.effects import ELASTIC, GEOMETRIC
    from pincal.report.plots.found import deviation_figure
    from pincal.simulate.paper_machine import PaperMachine

    urdf = folder / _URDF
    data = folder / _DATA
    urdf.write_bytes(kuka_urdf_path().read_bytes())
    table, _ = _measure(data, PaperMachine(), robot, rng=np.random.default_rng(seed))
    runs = {
        name: run_calibration(robot, table, _options(effects), seed=seed)
        for name, effects in (("DH,s", GEOMETRIC), ("DH,s,e", ELASTIC))
    }
    origin = provenance([data, urdf], seed=seed)
    write_results(folder, FitOutput(runs["DH,s,e"]), origin, view=True)
    sizes = {_MODELS[name]: found for name, found in _deviations(runs).items()}
    drawn = deviation_figure(sizes, remark=_SOFT)
    drawn.savefig(folder / "deviations.png", dpi=120)
    return runs


def _discover(
    folder: Path, robot: Robot, seed: int, *, machine: PaperMachine
) -> tuple[Discovery, Instrument]:
    """Measure a machine with a hidden effect, search for it and write the result; return the
    tracker too, which stays where it is.
    """
    from pincal.cli.fitting import write_results
    from pincal.discover.cli.search_output import SearchOutput
    from pincal.discover.run import run_discovery
    from pincal.io.strict_json import write_json
    from pincal.model.effects import ELASTIC

    data = folder / _DATA
    table, tracker = _measure(data, machine, robot, rng=np.random.default_rng([seed, 2]))
    found = run_discovery(robot, table, _options(ELASTIC), seed=seed)
    write_results(folder, SearchOutput.of(found), provenance([data], seed=seed), view=True)
    write_json(folder / "discovery.json", found.report)
    return found, tracker


def _options(effects: tuple[Effect, ...]) -> Options:
    from pincal.identify.options import Options
    from pincal.simulate.paper_machine import PAYLOAD_COM

    return Options(effects=effects, payload_centre=PAYLOAD_COM, sigma=_NOISE)


def _measure(
    path: Path,
    machine: PaperMachine,
    robot: Robot,
    *,
    rng: np.random.Generator,
    rows: int = _ROWS,
    hit: float = 0.0,
) -> tuple[Measurements, Instrument]:
    """Write and read again the readings of a tracker in a random pose, of a machine in random
    poses.

    After a collision by ``hit`` [rad], one joint stands further by this angle than its controller
    reports.
    """
    from scipy.spatial.transform import Rotation

    from pincal.measure.table import read_measurements, write_table
    from pincal.simulate.instrument import Instrument
    from pincal.simulate.paper_machine import PAYLOAD_MASS

    q = robot.random_configurations(rows, rng)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
    pose[:3, 3] = rng.uniform(-4.0, 4.0, 3)
    tracker = Instrument(pose=pose, targets=_TOOL, sigma=_NOISE)
    shift = hit * np.array([name == _HIT_JOINT for name in robot.joint_names])
    read = tracker.measure(machine, q + shift, rng=rng, payload=PAYLOAD_MASS)
    write_table(path, read | dict(zip(robot.joint_names, q.T, strict=True)))
    return read_measurements(path, robot.joint_names), tracker


def _compensate(
    folder: Path, found: Discovery, q: np.ndarray, *, machine: PaperMachine, tracker: Instrument
) -> dict[str, dict[str, float]]:
    """Correct a program made with the nominal robot, run both on the machine, and return the errors
    [mm].
    """
    from pincal.calibration.fitted_robot import load_model
    from pincal.compensate.compensation import compensate_poses
    from pincal.measure.table import write_table
    from pincal.model.conditions import Conditions
    from pincal.simulate.paper_machine import PAYLOAD_COM, PAYLOAD_MASS

    # The program was made with the nominal robot, with base and tool fitted.
    fit = found.calibration.fit
    program = Conditions.at(q, payload=PAYLOAD_MASS, payload_centre=PAYLOAD_COM)
    wanted = fit.model.predict(fit.model.own(fit.fit.nominal.values), program)
    corrected = compensate_poses(load_model(folder / "model.json"), wanted, program)
    exact = replace(tracker, sigma=0.0)
    position = dict(zip("xyz", wanted[:, :, 3].T, strict=True))
    misses: dict[str, dict[str, float]] = {}
    for name, file, joints in (
        ("as programmed", "program.csv", q),
        ("corrected", "corrected.csv", corrected.q),
    ):
        columns = dict(zip(fit.model.chain.robot.joint_names, joints.T, strict=True))
        write_table(folder / file, columns | position | {"payload": program.payload})
        reached = exact.measure(machine, joints, payload=program.payload)
        missed = 1e3 * np.linalg.norm([reached[axis] - position[axis] for axis in "xyz"], axis=0)
        misses[name] = {"mean": float(missed.mean()), "max": float(missed.max())}
    misses["corrected"]["out_of_reach"] = int(np.sum(corrected.status != "ok"))
    return misses


def _collide(
    model: Path, folder: Path, robot: Robot, *, machine: PaperMachine, rng: np.random.Generator
) -> Diagnosis:
    """Measure a few poses after a collision, with the tracker in a new pose, and diagnose the
    change.
    """
    from pincal.calibration.fitted_robot import load_model
    from pincal.diagnosis.robot_diagnosis import diagnose

    table, _ = _measure(folder / _DATA, machine, robot, rng=rng, rows=_HIT_ROWS, hit=_HIT)
    return diagnose(load_model(model), table)


def _deviations(runs: dict[str, Calibration]) -> dict[str, np.ndarray]:
    """Return the deviations at unfitted poses [m], of the standard DH model and of each calibrated
    one (paper, Fig. 6).
    """
    first = runs["DH,s"]
    models = {"standard DH": (first, "nominal")} | {
        name: (run, "calibrated") for name, run in runs.items()
    }
    found = {name: _left_out(run, model) for name, (run, model) in models.items()}
    return {name: errors for name, errors in found.items() if errors is not None}


def _left_out(run: Calibration, model: str) -> np.ndarray | None:
    """Return the error of each pose by the fits without its region or stretch, the
    worse way [m].
    """
    if run.validated is None:
        return None
    (errors,) = run.validated.of_model[model][run.validated.headline]
    return np.asarray(np.linalg.norm(errors.residuals[:, errors.counted], axis=0))


def _print_calibration(runs: dict[str, Calibration], screen: Console) -> None:
    from pincal.report.words import rank_words
    from pincal.result_table import one_line

    result = runs["DH,s,e"].result
    screen.print(
        f"The KUKA KR 125/2 of the paper (Table I), {_ROWS} poses measured by a simulated "
        "tracker,\n"
        f"{_NOISE * 1e3:g} mm of noise per coordinate, each predicted by a fit without its part:\n"
    )
    for name, deviations in _deviations(runs).items():
        screen.print(
            f"  {name:12s} mean {deviations.mean() * 1e3:8.4f} mm   max "
            f"{deviations.max() * 1e3:8.4f} mm"
        )
    screen.print(
        "\n(standard DH: base and tool fitted; DH,s: geometry and axis distortions; "
        "DH,s,e: with elasticity)"
    )
    statuses = (parameter.status for parameter in result.parameters)
    words = rank_words(
        statuses,
        rank=result.rank,
        condition=result.condition,
        why="each with its reason in report.html",
    )
    screen.print(one_line(words), markup=False)
    for note in result.warnings:
        screen.print(f"{note.severity}: {note}")


def _print_hidden(found: Discovery, screen: Console, *, folder: Path) -> None:
    from pincal.cli.brief import print_brief
    from pincal.discover.cli.search_output import SearchOutput

    size = f"{_SIZE * 1e3:g} mrad"
    screen.rule("A hidden effect")
    screen.print(
        f"\nThe same robot, but a gear wheel of {_JOINT} is elliptical: the joint has an "
        f"error of {size}, twice per "
        f"revolution.\n{_ROWS} poses are measured again and calibrated with all of the "
        "above. The model does not include "
        "the\nwheel, and the held-out error stays above the noise. What is missing, and where?\n"
    )
    output = SearchOutput.of(found)
    print_brief(
        output.calibration,
        screen,
        more=str(folder / "report.html"),
        search=output.search,
        found=output.found(),
    )
    for entry in found.report["effects"]:
        if (entry["effect"], entry["joint"]) == ("gear_eccentricity", _JOINT):
            amplitude = 1e3 * np.hypot(
                *(parameter["value"] for parameter in entry["parameters"].values())
            )
            screen.print(
                f"\nSimulated: {size} at {_JOINT}, twice per revolution. Found: "
                f"{amplitude:.4f} mrad."
            )


def _print_program(missed: dict[str, dict[str, float]], screen: Console) -> None:
    screen.rule("Compensation")
    screen.print(
        f"\nA program of {_PROGRAM} other poses, written for the nominal robot, is run on "
        "this machine:\n"
    )
    for name, words in (
        ("as programmed", "as programmed"),
        ("corrected", "corrected with this model"),
    ):
        mean = missed[name]["mean"]
        largest = missed[name]["max"]
        screen.print(f"  {words:28s} error: mean {mean:8.4f} mm, max {largest:8.4f} mm")
    if short := int(missed["corrected"]["out_of_reach"]):
        screen.print(
            f"\n{short} of the poses are singular or out of reach, and are reached only "
            "approximately."
        )


def _print_collision(diagnosis: Diagnosis, screen: Console) -> None:
    from pincal.cli.screen import print_lines
    from pincal.diagnosis.diagnosis_page import lines

    screen.rule("A collision")
    screen.print(
        f"\nA collision shifts the zero of {_HIT_JOINT} by {_HIT * 1e3:g} mrad, and the "
        "tracker has been moved.\n"
        f"{_HIT_ROWS} poses are measured. Has the robot changed, and if so, how?\n"
    )
    print_lines(lines(diagnosis.found), screen)


def _print_files(out: Path, screen: Console) -> None:
    from pincal.cli.fitting import VIEW

    folder = out / _HIDDEN_FOLDER
    hit = out / _HIT_FOLDER
    urdf = out / _URDF
    screen.print("\nOpen", style="bold")
    pages = (
        (out / "report.html", "accuracy, where errors are, every parameter with its uncertainty"),
        (out / VIEW, "the robot, its errors and the measured poses in 3D"),
        (out / "deviations.png", "Fig. 6 of the paper: the error at held-out poses"),
        (folder / "report.html", "what was missing, and how the error shrank to the noise"),
        (folder / "discovery.json", "the findings, machine-readable"),
        (folder / "corrected.csv", "the corrected program: the joint positions to command"),
        (hit / "report.html", "what the collision changed, and what it did not"),
        (hit / "model.json", "the updated model: only what changed was re-estimated"),
    )
    width = max(len(str(path)) for path, _ in pages)
    for path, words in pages:
        screen.print(f"  {path!s:{width}s}  {words}", soft_wrap=True)
    screen.print("\nThen try your own robot, or a simulated one:", style="bold")
    for line in (
        f"pincal compensate {folder / 'model.json'} {folder / 'program.csv'} --out again.csv",
        f"pincal diagnose   {folder / 'model.json'} {hit / _DATA} --out again",
        f"pincal check      {urdf} {out / _DATA} --payload-com .08 -.05 .22",
        f"pincal simulate   {urdf} --poses 300 --effect backlash:joint_2 --out mine.csv",
        f"pincal discover   {urdf} mine.csv --out found --noise 0.05mm",
    ):
        screen.print(f"  {line}", soft_wrap=True)
