"""The summary of a calibration: fourteen lines that say all that was found, and one thing to do next."""

import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from command_line import run
from rich.console import Console

from pincal import Options, Robot, read_measurements, run_calibration
from pincal.builtin import kuka_urdf_path
from pincal.calibration.calibration import Calibration
from pincal.calibration.caveats import CaveatKind
from pincal.cli.brief import print_brief
from pincal.discover.cli.search_screen import _by_joint, _forms, _listed
from pincal.discover.discovery_file import FoundEffect, Stability
from pincal.notes import Note, Severity
from pincal.report.judgement import Act, NextStep, steps_after

URDF = kuka_urdf_path()
MOST = 14
SIMULATED = ("simulate", URDF, "--seed", "1", "--quiet")
Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the table of README.md."""
    folder = tmp_path_factory.mktemp("tables")
    assert run(*SIMULATED, "--poses", "60", "--out", folder / "tracker.csv") == 0
    return folder


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return tables of a tracker that was moved twice."""
    found = [tmp_path_factory.mktemp("days") / f"day{day}.csv" for day in (2, 3, 4)]
    for seed, path in enumerate(found, 2):
        assert run(*SIMULATED, "--poses", "40", "--pose-seed", seed, "--out", path) == 0
    return found


def printed(capsys: Capture, *words: object) -> list[str]:
    """Return the lines that a verb prints, none of which is wider than a hundred columns but those of paths."""
    capsys.readouterr()
    assert run(*words, "--quiet") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= MOST and lines[-1].startswith("written to ")
    assert max(len(line) for line in lines if not line.startswith(("next ", "more ", "written to "))) <= 100
    assert sum(line.startswith("next ") for line in lines) == 1
    return lines


def said(lines: list[str], head: str) -> str:
    """Return what a part of a summary says, on one line."""
    begin = next(k for k, line in enumerate(lines) if line.startswith(f"{head} "))
    more = []
    for line in lines[begin + 1 :]:
        if not line.startswith("   "):
            break
        more.append(line.strip())
    return " ".join([lines[begin].split(" ", 1)[1].strip(), *more])


def test_without_a_declared_noise_it_is_asked_for(tables: Path, tmp_path: Path, capsys: Capture) -> None:
    """By check and by calibrate, with what to write; with it the verdict is given, and the model is used."""
    table, out = tables / "tracker.csv", tmp_path / "results"
    assert run("check", URDF, table, "--quiet") == 0
    first = said(capsys.readouterr().out.splitlines(), "next")
    assert first.startswith(f"pincal calibrate {URDF} {table}") and "--noise 0.05mm" in first
    # What is printed is no part of what is done.
    assert "--quiet" not in first

    lines = printed(capsys, "calibrate", URDF, table, "--out", out)
    assert said(lines, "verdict").startswith("not judged. ") and "(--noise 0.05mm)" in said(lines, "verdict")
    words, _, why = said(lines, "next").partition("  # ")
    assert why == "your instrument's"
    pincal, verb, *rest = shlex.split(words)
    assert (pincal, verb) == ("pincal", "calibrate")

    capsys.readouterr()
    assert run(verb, *rest) == 0
    lines = capsys.readouterr().out.splitlines()
    assert said(lines, "verdict").startswith("adequate. ")
    assert said(lines, "next").startswith(f"pincal compensate {out / 'model.json'} PROGRAM.csv")


@pytest.mark.long
def test_a_dry_calibration_is_a_check(
    tables: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """The same text, also for programs; nothing is written."""
    monkeypatch.chdir(tmp_path)
    for more in [(), ("--verbose",), ("--json",)]:
        words = (URDF, tables / "tracker.csv", *more, "--quiet")
        capsys.readouterr()
        assert run("check", *words) == 0
        checked = capsys.readouterr().out
        assert run("calibrate", *words, "--dry") == 0
        assert capsys.readouterr().out == checked
        assert not [*tmp_path.glob("results*")]


@pytest.mark.long
def test_check_and_calibrate_leave_rows_out_alike(tables: Path, tmp_path: Path, capsys: Capture) -> None:
    """Before a fit as after it, the error of the nominal robot is the same by each way, and is named alike."""
    words = (URDF, tables / "tracker.csv", "--quiet")
    assert run("check", *words, "--json") == 0
    checked = json.loads(capsys.readouterr().out)
    assert run("calibrate", *words, "--out", tmp_path / "out") == 0
    lines = capsys.readouterr().out.splitlines()
    nominal = json.loads((tmp_path / "out" / "result.json").read_text())["error"]["nominal"]
    by_way = {way: nominal[way] for way in nominal if way not in ("train", "test")}

    assert set(checked["ways"]) == set(by_way) == {"regions", "stretches"}
    for way, of_way in by_way.items():
        for name, value in checked["ways"][way].items():
            assert of_way[name] == pytest.approx(value, rel=1e-9), (way, name)
    assert checked["nominal"] == max(checked["ways"].values(), key=lambda of: of["mean_mm"])
    assert run("check", *words) == 0
    before = said(capsys.readouterr().out.splitlines(), "before")
    headline = f" {nominal['test']['mean_mm']:.4f}"
    assert headline in before and headline in said(lines, "before")


@pytest.mark.long
@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("more", [("--split", "station"), ()])
def test_three_stations_take_fourteen_lines(
    days: list[Path], tmp_path: Path, more: tuple[str, ...], capsys: Capture
) -> None:
    """With or without leaving each out."""
    printed(capsys, "calibrate", URDF, *days, "--noise", "0.05mm", "--out", tmp_path / "out", *more)


# Robot, table, and of how many rows each is taken: what is printed is of as many lines with few of them.
REAL = {
    "ur5": ("ur5", "ur5_tracker/grid.csv", 4),
    "panda": ("panda", "panda_sockets/panda_3.csv", 1),
}


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "verb"),
    [
        ("panda", "calibrate"),
        # A search that has a name to say is that of the demo, below.
        *(
            pytest.param(*case, marks=pytest.mark.products)
            for case in (("ur5", "discover"), ("ur5", "calibrate"), ("panda", "discover"))
        ),
    ],
)
def test_real_tables_take_fourteen_lines(name: str, verb: str, shared_data: Path, tmp_path: Path, capsys: Capture) -> None:
    """Every effect found is named with its joint."""
    robot, file, every = REAL[name]
    out, table = tmp_path / "out", tmp_path / Path(file).name
    head, *rows = (shared_data / file).read_text(encoding="utf-8").splitlines(keepends=True)
    table.write_text("".join([head, *rows[::every]]), encoding="utf-8")
    more = ("--stability", "0") if verb == "discover" else ()
    lines = printed(capsys, verb, robot, table, "--out", out, *more)
    if verb == "discover":
        found = json.loads((out / "discovery.json").read_text())["effects"]
        assert found and all(entry["joint"] in said(lines, "found") for entry in found if entry["joint"])
        assert said(lines, "next").startswith(f"pincal compensate {out / 'model.json'}")


@pytest.mark.long
@pytest.mark.usefixtures("here")
def test_a_hidden_effect_of_the_demo_takes_fourteen_lines(tmp_path: Path, capsys: Capture) -> None:
    """The table of its second act, with the elliptical gear wheel."""
    table = tmp_path / "m.csv"
    hidden = ("--effect", "gear_eccentricity:joint_1:size=2e-4,order=2")
    assert run("simulate", URDF, "--poses", "300", *hidden, "--seed", "1", "--out", table, "--quiet") == 0
    lines = printed(capsys, "discover", URDF, table, "--noise", "0.05mm", "--stability", "4", "--out", tmp_path / "out")
    assert "gear_eccentricity of joint_1" in said(lines, "found") and "of 4 subsamples" in said(lines, "found")


@pytest.fixture(scope="module")
def calibrated(tables: Path) -> Calibration:
    """Return a calibration without a declared noise."""
    robot = Robot.from_urdf(URDF)
    return run_calibration(robot, read_measurements(tables / "tracker.csv", robot.joint_names), Options())


def shown(run_: Calibration, **more: object) -> list[str]:
    """Return the lines of a summary."""
    with (out := Console(width=100, highlight=False)).capture() as held:
        print_brief(run_, out, more="report.html", **more)  # type: ignore[arg-type]
    return held.get().splitlines()


def test_whatever_is_told_fits(calibrated: Calibration) -> None:
    """Many long doubts, notes and effects: the first doubt is first, the others and the notes are counted."""
    doubts = [Note(Severity.DOUBT, f"doubt {k} " + "of some length " * 30, ()) for k in range(4)]
    notes = [Note(Severity.NOTE, f"note {k} " + "and more " * 20, ()) for k in range(9)]
    crowded = replace(calibrated, result=replace(calibrated.result, warnings=(*doubts, *notes)))
    effects = "; ".join(f"gear_eccentricity of joint_{k} (in 20 of 20 subsamples)" for k in range(30))
    lines = shown(crowded, found=(effects, effects.replace(" (in 20 of 20 subsamples)", ""), "30 effects"))

    assert len(lines) < MOST
    assert lines[0].startswith("doubt: doubt 0 of some length") and "(3 more doubts in the report)" in said(
        ["doubt: " + lines[0], *lines[1:]], "doubt:"
    )
    assert lines[-1].startswith("more     9 notes")
    assert said(lines, "found") == "30 effects"


def test_what_is_short_is_said_in_full(calibrated: Calibration) -> None:
    """All effects with their evidence, where there is room."""
    assert said(shown(calibrated, found=("a of b (20)", "a of b", "1 effect")), "found") == "a of b (20)"


PLAIN: dict[str, Any] = {
    "parameters": {},
    "p_value": 1e-9,
    "gap_before_mm": 1.0,
    "gap_after_mm": 0.5,
    "equivalent": (),
    "tell_apart": "",
}
TILTS = ("gamma_x", "gamma_y", "s_x", "s_y")


def test_effects_of_a_kind_stand_together() -> None:
    """The joints behind one name; what is no more than a hint is set apart."""

    def entry(effect: str, joint: str, **more: object) -> FoundEffect:
        return FoundEffect(effect=effect, joint=joint, stability=Stability(9, 10), **(PLAIN | more))

    named = [entry("backlash", "a"), entry("gear_ripple", "b", order=20), entry("backlash", "c")]
    words = _listed(named, [" (in 9 of 10 subsamples)", " (9)", " (8)"])

    assert words == "backlash of a (in 9 of 10 subsamples), c (8); gear_ripple of b order 20 (9)"


def test_effects_without_a_name_are_told_apart() -> None:
    """Tilts of one joint about different axes; where lines are few, their number stands for them."""
    names = [FoundEffect(effect="unnamed", joint="a", depends_on="a", acts_on=on, shape="curve", **PLAIN) for on in TILTS]
    once = FoundEffect(effect="backlash", joint="b", **PLAIN)

    assert _listed(names[:2], ["", ""]) == "; ".join(f"unnamed of a (curve of a, tilt {on})" for on in TILTS[:2])
    assert _by_joint([*names, once]) == "unnamed of a (4 times); backlash of b"


def test_hints_are_counted_before_names_are(calibrated: Calibration) -> None:
    """A doubt leaves few lines: nine names on six joints do not fit, and those that are sure are said."""
    joints = [f"some_long_name_of_joint_{k}" for k in range(9)]
    sure = [FoundEffect(effect="gear_eccentricity", joint=at, stability=Stability(9, 10), **PLAIN) for at in joints[:4]]
    hints = [FoundEffect(effect="gear_ripple", joint=at, stability=Stability(1, 10), **PLAIN) for at in joints]
    run_ = replace(calibrated, result=replace(calibrated.result, warnings=(Note(Severity.DOUBT, "long; " * 60, ()),)))
    forms = _forms([*hints, *sure])
    lines = shown(run_, found=forms)

    assert said(lines, "found").endswith("; 9 hints in the report")
    # With still fewer lines their kinds are said, before all are only counted.
    assert forms[-2:] == ("gear_eccentricity (4 times); 9 hints in the report", "13 effects, listed in the report")
    assert all(at in said(lines, "found") for at in joints[:4])


def test_the_first_step_is_the_act_that_the_verdict_asks_for(calibrated: Calibration) -> None:
    """To state the noise, to search where it shows too little, or to use what is adequate."""
    result = calibrated.result
    acts = {
        None: Act.DECLARE,
        1e-9: Act.SEARCH,
        0.4: Act.USE,
    }
    for p_value, act in acts.items():
        noise = {**result.noise, "source": "estimated" if p_value is None else "declared"}
        given = replace(calibrated, result=replace(result, chi2_p_value=p_value, noise=noise, warnings=()))
        assert steps_after(given)[0].act is act
    lost = {
        part: {**errors, "rms_mm": 1e9 if part == "test" else 1.0} for part, errors in result.error["calibrated"].items()
    }
    worse = replace(calibrated, result=replace(result, chi2_p_value=0.4, error={**result.error, "calibrated": lost}))
    assert steps_after(worse)[0].act is None and "no better than by the URDF" in steps_after(worse)[0].text


@pytest.mark.parametrize("p_value", [None, 0.4, 1e-9])
def test_a_doubt_of_how_rows_were_measured_is_what_to_see_to(calibrated: Calibration, p_value: float | None) -> None:
    """No search undoes the order of the rows; it is first where the residuals exceed the noise, or may do so by effects."""
    doubt = Note(Severity.DOUBT, "of the order of the rows")
    noise = {**calibrated.result.noise, "source": "estimated" if p_value is None else "declared"}
    result = replace(calibrated.result, chi2_p_value=p_value, noise=noise, warnings=(doubt,))

    def steps(kind: CaveatKind) -> list[NextStep]:
        return steps_after(replace(calibrated, result=replace(result, doubted=(kind,))))

    is_within = p_value == 0.4
    for kind, is_told in ((CaveatKind.SORTED, p_value != 1e-9), (CaveatKind.DEPENDENT_ROWS, is_within)):
        first, *others = steps(kind)
        assert (first.act is None and first.text.endswith(("effect of a joint.", "and calibrate."))) == is_told
        assert any(step.act is Act.SEARCH for step in [first, *others]) != is_within


@pytest.mark.long
def test_a_table_in_the_order_of_a_joint_is_to_be_measured_in_another(tables: Path, tmp_path: Path, capsys: Capture) -> None:
    """Its residuals are no larger than the noise: a search has nothing to find; the file says as much as before."""
    head, *rows = (tables / "tracker.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    table, out = tmp_path / "sorted.csv", tmp_path / "out"
    table.write_text(head + "".join(sorted(rows, key=lambda row: float(row.split(",")[0]))), encoding="utf-8")
    lines = printed(capsys, "calibrate", URDF, table, "--noise", "0.05mm", "--out", out)

    assert "joint_1 moved steadily along the rows" in " ".join(lines)
    assert said(lines, "next").startswith("Measure some of the first poses once more at the end")
    assert "doubted" not in json.loads((out / "result.json").read_text())


def test_what_rejects_a_model_is_said_in_full_once(calibrated: Calibration, capsys: Capture) -> None:
    """By the doubt that stands first; verdict and next step refer to it."""
    words = "typical rows still have an error of 94 mm: too large for any calibrated arm"
    result = replace(calibrated.result, doubt=words, warnings=(Note(Severity.DOUBT, words),))
    print_brief(replace(calibrated, result=result), Console(width=100), more="--verbose")
    told = " ".join(capsys.readouterr().out.split())

    assert told.count(words) == 1 and told.startswith(f"doubt: {words}")
    assert "Do not use it. See the doubt stated first." in told
    assert "next Find out what is wrong, by the doubt stated first" in told
