"""The command as a user meets it: exit codes, what is on stdout and stderr, and files whole or not at all."""

import csv
import json
import math
import re
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from linkages import four_bar
from scipy import stats
from test_calibrate import paper_table

from pincal.builtin import kuka_urdf_path
from pincal.cli import _spread
from pincal.measure.table import write_table

URDF = str(kuka_urdf_path())
COM = ["--payload-com", "0.08", "-0.05", "0.22"]


def columns_of(table):
    columns = {name: table.q[:, i] for i, name in enumerate(table.joint_names)}
    columns |= {axis: table.position[:, i] for i, axis in enumerate("xyz")}
    return columns | {"payload": table.payload}


@pytest.fixture(scope="module")
def columns(kuka):
    return columns_of(paper_table(kuka, 120, 0, 5e-5))


@pytest.fixture
def table(tmp_path, columns):
    write_table(tmp_path / "data.csv", columns)
    return tmp_path / "data.csv"


@pytest.fixture(scope="module")
def results(tmp_path_factory, columns):
    folder = tmp_path_factory.mktemp("results")
    write_table(folder / "data.csv", columns)
    assert run("calibrate", URDF, folder / "data.csv", "--out", folder / "out", *COM, "--quiet") == 0
    return folder / "out"


def test_calibrate_writes_all_files(results):
    """The folder holds the five files of the contract and nothing else."""
    assert {f.name for f in results.iterdir()} == {
        "model.json",
        "result.json",
        "calibrated.urdf",
        "report.html",
        "residuals.csv",
    }


def test_result_json_has_the_keys_of_the_contract(results):
    """Programs find noise, rows, parameters with status and reason, rank, chi-square and errors before and after."""
    result = json.loads((results / "result.json").read_text())

    assert {"noise", "rows", "parameters", "rank", "condition", "chi2_reduced", "iterations", "seconds", "error"} <= set(
        result
    )
    assert result["rows"] == {"train": 120, "test": 120}
    assert result["validation"]["way"] in ("regions", "stretches") and result["validation"]["folds"] == 25
    assert result["noise"]["source"] == "estimated"
    assert result["noise"]["sigma_m"] == pytest.approx(5e-5, rel=0.2)
    for parameter in result["parameters"]:
        assert set(parameter) == {"name", "unit", "nominal", "value", "sigma", "status", "reason"}
        assert parameter["status"] in {"identified", "prior", "fixed", "unidentifiable", "at bound"}
        assert parameter["status"] == "identified" or parameter["reason"]
    assert result["error"]["calibrated"]["test"]["mean_mm"] < 0.15
    assert result["error"]["nominal"]["test"]["mean_mm"] > 2.0


def test_intervals_of_errors_follow_from_the_residuals(results):
    """Mean and Student's t of the sizes by fits without their fold; 120 poses, none of them visited twice."""
    result = json.loads((results / "result.json").read_text())
    with (results / "residuals.csv").open() as file:
        rows = [[float(row[f"left_out_position_{axis} [m]"]) for axis in "xyz"] for row in csv.DictReader(file)]
    sizes = 1e3 * np.linalg.norm(rows, axis=1)

    half = stats.t(119).ppf(0.975) * sizes.std(ddof=1) / np.sqrt(120)
    low, high = result["intervals"]["mean_mm"]
    assert (low, high) == pytest.approx((sizes.mean() - half, sizes.mean() + half), rel=1e-6)
    low, high = result["intervals"]["p95_mm"]
    assert low < result["error"]["calibrated"]["test"]["p95_mm"] < high
    assert np.isclose(sizes, low).any() and np.isclose(sizes, high).any()


def test_json_goes_to_stdout_and_progress_to_stderr(tmp_path, table, capsys):
    """``--json`` prints one JSON object; what the fit does is told on stderr."""
    assert run("calibrate", URDF, table, "--out", tmp_path / "out", *COM, "--json") == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["converged"]
    assert "iteration" in printed.err


@pytest.mark.long
def test_quiet_says_nothing_on_stderr(tmp_path, table, capsys):
    """``--quiet`` silences progress and notes."""
    assert run("calibrate", URDF, table, "--out", tmp_path / "out", *COM, "--quiet") == 0
    assert capsys.readouterr().err == ""


@pytest.mark.long
def test_text_fits_a_hundred_columns(tmp_path, table, capsys):
    """The result table is not wider than a page; a command to copy and paths are not broken."""
    run("calibrate", URDF, table, "--out", tmp_path / "out", *COM, "--quiet")
    lines = capsys.readouterr().out.splitlines()
    assert max(len(line) for line in lines if not line.startswith(("next ", "more ", "written to "))) <= 100


@pytest.mark.long
def test_a_check_says_the_declared_noise_and_what_the_readings_show(tmp_path, capsys):
    """Of five readings a pose their scatter, as of independent draws; that of the table, if none was declared."""
    made = tmp_path / "repeated.csv"
    words = ("--poses", "20", "--cycles", "5", "--noise", "0.06mm", "--no-floor", "--seed", "3")
    assert run("simulate", URDF, *words, "--out", made, "--quiet") == 0
    assert "100 rows at 20 poses in 5 cycles" in capsys.readouterr().out
    xyz = np.genfromtxt(made, delimiter=",", names=True)
    read = np.stack([xyz[axis].reshape(5, 20) for axis in "xyz"])
    scatter = 1e3 * np.sqrt(np.sum((read - read.mean(axis=1, keepdims=True)) ** 2) / (3 * 20 * 4))

    assert run("check", URDF, made, "--noise", "0.05mm", "--quiet") == 0
    text = capsys.readouterr().out
    assert f"0.0500 mm per coordinate (declared; repeated poses show {scatter:.4f})" in text
    assert "rows     100 position measurements" in text
    assert run("check", URDF, made, "--quiet") == 0
    assert f"{scatter:.4f} mm per coordinate (estimated from repeated poses)" in capsys.readouterr().out


@pytest.mark.long
def test_ten_lines_come_first(tmp_path, table, capsys):
    """Before, after, noise as the mean distance it makes, verdict and next step; the tables only with --verbose."""
    assert run("calibrate", URDF, table, "--out", tmp_path / "out", *COM, "--noise", "0.05mm", "--quiet") == 0
    text = capsys.readouterr().out
    errors = json.loads((tmp_path / "out" / "result.json").read_text())["error"]
    heads = [line.split(" ")[0] for line in text.splitlines() if not line.startswith(" ")]

    expected = ["robot", "before", "after", "noise", "verdict", "next"]
    assert [head for head in heads if head in expected] == expected and len(text.splitlines()) <= 14
    for name, model in (("before", "nominal"), ("after", "calibrated")):
        assert f"{name:8s} mean {errors[model]['test']['mean_mm']:.4f} mm" in text
    # The mean of the chi distribution with three degrees of freedom, times the noise.
    shown = f"noise    mean {0.05 * np.sqrt(8.0 / np.pi):.4f} mm, 0.0500 mm per coordinate (declared; residuals show "
    noise = json.loads((tmp_path / "out" / "result.json").read_text())["noise"]
    assert shown + f"{1e3 * noise['residual_sigma_m']:.4f})" in text and noise["declared"] == ["sigma_m"]
    assert "Pose accuracy" not in text and "base_link to tool0 (--tip takes another link)" in text
    assert run("calibrate", URDF, table, "--out", tmp_path / "out", *COM, "--verbose", "--quiet") == 0
    assert "Pose accuracy" in capsys.readouterr().out


@pytest.mark.long
def test_max_error_is_a_gate(tmp_path, table):
    """Exit 5 where the held-out mean exceeds the limit; the files are written all the same."""
    assert run("calibrate", URDF, table, "--out", tmp_path / "out", *COM, "--max-error", "1um", "--quiet") == 5
    assert (tmp_path / "out" / "model.json").exists()
    assert run("calibrate", URDF, table, "--out", tmp_path / "out", *COM, "--max-error", "1mm", "--quiet") == 0


def test_validate_reports_errors_on_new_rows(results, tmp_path, kuka, capsys):
    """The model is as true on a second table as the calibration said."""
    write_table(tmp_path / "new.csv", columns_of(paper_table(kuka, 50, 8, 5e-5)))
    assert run("validate", results / "model.json", tmp_path / "new.csv", "--json", "--quiet") == 0
    assert json.loads(capsys.readouterr().out)["error"]["calibrated"]["test"]["mean_mm"] < 0.15
    assert run("validate", results / "model.json", tmp_path / "new.csv", "--max-error", "1um", "--quiet") == 5


def test_predict_gives_positions_in_the_instruments_frame(results, tmp_path, kuka, capsys):
    """Predicted positions are those that are measured; columns it does not need are ignored."""
    exact = paper_table(kuka, 20, 8)
    write_table(tmp_path / "poses.csv", columns_of(exact) | {"remark": np.full(20, "x")})
    assert run("predict", results / "model.json", tmp_path / "poses.csv", "--out", tmp_path / "p.csv", "--quiet") == 0
    lines = (tmp_path / "p.csv").read_text().splitlines()
    header = lines[0].split(",")
    rows = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    found = rows[:, [header.index(axis) for axis in "xyz"]]
    assert np.abs(found - exact.position).max() < 5e-4
    assert "sigma_x" in header


def test_predict_splits_the_uncertainty_by_source(results, tmp_path, kuka):
    """The squares of the components sum to that of the whole, in every row and axis."""
    write_table(tmp_path / "poses.csv", columns_of(paper_table(kuka, 4, 8)))
    out = tmp_path / "p.csv"
    assert run("predict", results / "model.json", tmp_path / "poses.csv", "--out", out, "--components", "--quiet") == 0
    lines = out.read_text().splitlines()
    table = dict(zip(lines[0].split(","), np.array([line.split(",") for line in lines[1:]], float).T, strict=True))
    for axis in "xyz":
        parts = [table[f"u_{source}_{axis}"] for source in ("parameters", "model", "arrival", "conditions")]
        np.testing.assert_allclose(np.sqrt(np.sum(np.square(parts), axis=0)), table[f"sigma_{axis}"], rtol=1e-6)


def test_predict_warns_outside_the_covered_poses(results, tmp_path, kuka, capsys):
    """A joint beyond the measured range is named with its line."""
    table = columns_of(paper_table(kuka, 5, 8))
    table["joint_3"] = np.full(5, 3.0)
    write_table(tmp_path / "poses.csv", table)
    run("predict", results / "model.json", tmp_path / "poses.csv", "--out", tmp_path / "p.csv")
    assert "joint_3 = 171.9 deg" in capsys.readouterr().err


def test_export_equals_the_urdf_of_the_calibration(results, tmp_path):
    """The URDF can be written again from model.json alone."""
    assert run("export", results / "model.json", "--urdf", tmp_path / "again.urdf") == 0
    assert (tmp_path / "again.urdf").read_bytes() == (results / "calibrated.urdf").read_bytes()


def test_check_says_what_can_be_told(table, capsys):
    """Coverage, what is determined, and the reason for what can't be identified, before any fit is trusted."""
    assert run("check", URDF, table, *COM, "--verbose", "--quiet") == 0
    text = " ".join(capsys.readouterr().out.split())
    expected = ("combinations of the", "condition number", "Coverage", "parallel", "unidentifiable")
    for words in expected:
        assert words in text


@pytest.mark.long
def test_check_counts_every_parameter_once(table, capsys):
    """What became of the parameters adds up to their number, in both forms of the text."""
    assert run("check", URDF, table, *COM, "--quiet", "--json") == 0
    total = len(json.loads(capsys.readouterr().out)["parameters"])
    for more in ([], ["--verbose"]):
        assert run("check", URDF, table, *COM, "--quiet", *more) == 0
        text = " ".join(capsys.readouterr().out.split())
        assert f"combinations of the {total} parameters" in text
        counts = re.findall(r"(\d+) (?:of them individually|not by themselves|hardly|stopped at a bound|held)", text)
        assert sum(map(int, counts)) == total


@pytest.mark.long
def test_the_next_command_of_check_is_one(tmp_path, columns, capsys, monkeypatch):
    """It calibrates what was checked, with all that was said of it: here a log of the joints and the names of columns."""
    monkeypatch.chdir(tmp_path)
    Path("kuka.urdf").write_bytes(Path(URDF).read_bytes())
    pose = np.arange(len(columns["x"]))
    joints = {name: columns[name] for name in columns if name.startswith("joint")}
    write_table(
        "tracker.csv", {"pose": pose, "height": columns["z"]} | {name: columns[name] for name in ("x", "y", "payload")}
    )
    write_table("log.csv", {"pose": pose} | joints)
    given = [
        "kuka.urdf",
        "tracker.csv",
        *COM,
        "--joints",
        "log.csv",
        "--columns",
        "height=z [m]",
        "--model",
        "geometric",
    ]
    # What only says how much is printed is not said of the data.
    assert run("check", *given, "--quiet") == 0
    words = " ".join(capsys.readouterr().out.split("\nnext ")[1].split("\nmore ")[0].split())
    _, verb, *rest = shlex.split(words, comments=True)
    assert (verb, rest) == ("calibrate", [*given, "--noise", "0.05mm"])
    assert run(verb, *rest) == 0
    inputs = json.loads(Path("results/model.json").read_text())["provenance"]["inputs"]
    assert list(inputs) == ["tracker.csv", "log.csv", "kuka.urdf"]


@pytest.mark.long
def test_headers_with_units_change_nothing(results, tmp_path, columns, capsys):
    """Degrees and millimetres that the header names give the same calibration."""
    joints = [name for name in columns if name.startswith("joint")]
    converted = {f"{name} [deg]": np.degrees(columns[name]) for name in joints}
    converted |= {f"{axis} [mm]": columns[axis] * 1e3 for axis in "xyz"} | {"payload [g]": columns["payload"] * 1e3}
    write_table(tmp_path / "units.csv", converted)
    assert run("calibrate", URDF, tmp_path / "units.csv", "--out", tmp_path / "out", *COM, "--json", "--quiet") == 0
    found = json.loads(capsys.readouterr().out)["error"]["calibrated"]["test"]["mean_mm"]
    assert found == pytest.approx(
        json.loads((results / "result.json").read_text())["error"]["calibrated"]["test"]["mean_mm"], rel=1e-6
    )


def _degrees(columns):
    return {n: np.degrees(c) if n.startswith("joint") else c for n, c in columns.items()}


def _millimetres(columns):
    return {n: c * 1e3 if n in "xyz" else c for n, c in columns.items()}


def _swapped(columns):
    names = list(columns)
    names[1], names[2] = names[2], names[1]
    return dict(zip(names, columns.values(), strict=True))


def _without(name):
    return lambda columns: {n: c for n, c in columns.items() if n != name}


def _with_cell(name, value):
    def change(columns):
        column = columns[name].astype(object)
        column[3] = value
        return columns | {name: column.astype(str)}

    return change


BAD_TABLES = {
    "degrees without a unit": (_degrees, "degrees"),
    "millimetres without a unit": (_millimetres, "mm"),
    "swapped joint columns": (_swapped, "swapped"),
    "a missing joint column": (_without("joint_3"), "joint_3"),
    "not a number": (_with_cell("joint_2", math.nan), "line 5"),
    "infinite": (_with_cell("y", math.inf), "line 5"),
    "a turn that no joint makes": (_with_cell("joint_3", 1e20), "line 5"),
    "a place beyond the earth": (lambda c: c | {"x": c["x"] + 1e19}, "at most 1e+07 m"),
    "a payload of a ship": (lambda c: c | {"payload": np.full(len(c["x"]), 1e300)}, "at most 1e+07 kg"),
    "a time beyond any clock": (lambda c: c | {"time": 1e300 * np.arange(len(c["x"]))}, "at most 1e+20"),
    "a standard deviation of nothing": (lambda c: c | {"sigma": np.full(len(c["x"]), 1e-300)}, "at least 1e-12"),
    "text in a number": (_with_cell("y", "abc"), "line 5"),
    "no measurement": (lambda c: {n: v for n, v in c.items() if n not in "xyz"}, "measurement"),
    "a column nearly known": (lambda c: c | {"temprature": c["x"]}, "nearest first: temperature"),
    "one row": (lambda c: {n: v[:1] for n, v in c.items()}, "1 position measurement;"),
    "no row": (lambda c: {n: v[:0] for n, v in c.items()}, "no rows"),
    "all poses equal": (lambda c: {n: np.repeat(v[:1], 50) for n, v in c.items()}, "same"),
    "fewer readings than parameters": (lambda c: {n: v[:14] for n, v in c.items()}, "noise"),
}


@pytest.mark.parametrize("case", BAD_TABLES)
def test_bad_tables_are_refused_at_the_door(tmp_path, columns, capsys, case):
    """Exit 3, one message that says what and where, and no trace on the disk."""
    change, words = BAD_TABLES[case]
    write_table(tmp_path / "bad.csv", change(dict(columns)))
    assert run("calibrate", URDF, tmp_path / "bad.csv", "--out", tmp_path / "out", *COM, "--quiet") == 3
    printed = capsys.readouterr()
    assert words in printed.err
    assert "Traceback" not in printed.err
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_a_failed_run_leaves_earlier_results_untouched(tmp_path, table, columns):
    """What was in the folder before is still there, byte for byte, and nothing else."""
    out = tmp_path / "out"
    run("calibrate", URDF, table, "--out", out, *COM, "--quiet")
    before = {f.name: f.read_bytes() for f in out.iterdir()}
    write_table(tmp_path / "bad.csv", _degrees(columns))
    assert run("calibrate", URDF, tmp_path / "bad.csv", "--out", out, "--quiet") == 3
    assert {f.name: f.read_bytes() for f in out.iterdir()} == before


def test_interruption_leaves_nothing_half_done(tmp_path, table, monkeypatch, capsys):
    """Ctrl-C in the middle ends with 130, a word, and no output folder."""
    import pincal.calibration.calibration as module

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "fit_agreed", interrupted)
    assert run("calibrate", URDF, table, "--out", tmp_path / "out", *COM, "--quiet") == 130
    assert "interrupted" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_output_that_is_a_file_is_refused(tmp_path, table, capsys):
    """Exit 3 before any work, and the file is untouched."""
    (tmp_path / "out").write_text("precious")
    assert run("calibrate", URDF, table, "--out", tmp_path / "out", *COM, "--quiet") == 3
    assert (tmp_path / "out").read_text() == "precious"


@pytest.mark.parametrize(
    "arguments",
    [["calibrate"], ["nonsense"], ["calibrate", URDF, "x.csv", "--out", "o", "--noise", "5"], ["validate", "--what"]],
)
def test_wrong_usage_exits_with_two(arguments):
    """Usage errors have an exit code of their own; a noise needs its unit."""
    assert run(*arguments) == 2


@pytest.mark.parametrize("verb", ["demo", "check", "calibrate", "validate", "predict", "export", "discover", "simulate"])
def test_every_verb_shows_an_example(verb, capsys):
    """``--help`` ends with a line to copy."""
    assert run(verb, "--help") == 0
    assert f"pincal {verb}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--version"], 0),
        *(pytest.param(*of, marks=pytest.mark.long) for of in ((["nothing"], 2), (["validate", "no.json", "no.csv"], 3))),
    ],
)
def test_a_process_ends_with_its_code_and_all_that_it_said(arguments: list[str], code: int) -> None:
    """The command leaves without tidying up, but not before its words are out."""
    done = subprocess.run([sys.executable, "-m", "pincal", *arguments], capture_output=True, text=True)

    assert done.returncode == code
    assert "pincal" in (done.stderr if code else done.stdout)


@pytest.mark.parametrize(
    ("given", "spread"),
    [
        ("x --socket-distance a b 0.05 c d 1e-1 --out o", "x --socket-distance a b 0.05 --socket-distance c d 1e-1 --out o"),
        ("--socket-distance a b 0.05 r.urdf t.csv", "--socket-distance a b 0.05 r.urdf t.csv"),
        ("--socket-distance a b --out o", "--socket-distance a b --out o"),
        ("x --socket-distance a b 50mm c d 2cm --out o", "x --socket-distance a b 50mm --socket-distance c d 2cm --out o"),
        (
            "x --socket-distance 01 02 4cm --socket-distance 02 03 4cm",
            "x --socket-distance 01 02 4cm --socket-distance 02 03 4cm",
        ),
        ("x --socket-distance 01 02 4cm --sigma 1 2", "x --socket-distance 01 02 4cm --sigma 1 2"),
        ("x --socket-distance a b 1 --socket-distance c d 2", "x --socket-distance a b 1 --socket-distance c d 2"),
    ],
)
def test_an_option_may_have_several_sets_of_values(given: str, spread: str) -> None:
    """Distances of sockets may follow one another, or each its own option."""
    assert _spread(given.split()) == spread.split()


@pytest.mark.long
def test_demo_tells_the_story(tmp_path, capsys):
    """Nothing to prepare: from some mm to hundredths; then a hidden effect is found; and files to open."""
    assert run("demo", "--out", tmp_path / "demo", "--quiet") == 0
    text = capsys.readouterr().out
    assert "standard DH" in text
    assert "report.html" in text
    # Some ten lines an act, and where to go from there.
    assert len(text.splitlines()) <= 80
    assert (tmp_path / "demo" / "deviations.png").stat().st_size > 10_000
    report = json.loads((tmp_path / "demo" / "hidden_effect" / "discovery.json").read_text())
    assert [(e["effect"], e["joint"], e["order"]) for e in report["effects"]] == [("gear_eccentricity", "joint_1", 2)]
    assert report["gap"]["before"]["rms_mm"] > 2.0 * report["noise_floor_mm"] > 1.8 * report["gap"]["after"]["rms_mm"]
    assert "Found: 0.19" in text or "Found: 0.20" in text
    assert {file.name for file in (tmp_path / "demo").iterdir()} > {"model.json", "hidden_effect", "measurements.csv"}
    programmed, corrected = (
        float(re.search(rf"{words} +error: mean +([\d.]+) mm", text)[1])
        for words in ("as programmed", "corrected with this model")
    )
    assert programmed > 2.0 and corrected < 0.06
    hit = json.loads((tmp_path / "demo" / "hit" / "diagnosis.json").read_text())
    (change,) = hit["changes"]
    (moved,) = change["parameters"].values()
    assert (change["effect"], change["joint"], hit["rows"]) == ("joint_offset", "joint_3", 10)
    assert moved["after"] - moved["before"] == pytest.approx(1e-3, abs=4.0 * moved["sigma"])
    assert hit["gap"]["before"]["mean_mm"] > 0.3 and hit["gap"]["after"]["mean_mm"] < 0.1
    assert "joint_offset of joint_3" in text
    assert {file.name for file in (tmp_path / "demo" / "hit").iterdir()} > {"model.json", "report.html"}


def test_a_broken_model_file_is_refused(results, tmp_path, capsys):
    """A model.json that is cut off is named, with exit 3."""
    text = (results / "model.json").read_text()
    Path(tmp_path / "cut.json").write_text(text[: len(text) // 2])
    assert run("validate", tmp_path / "cut.json", "x.csv") == 3
    assert "cut.json" in capsys.readouterr().err


@pytest.mark.long
def test_a_report_of_a_problem_says_what_was_run_and_not_what_was_measured(table, capsys):
    """Versions, command, files and names of columns are there, also of a table that is refused; no row of it is."""
    assert run("check", URDF, table, *COM, "--report", "--quiet") == 0
    whole = capsys.readouterr().out
    refused = table.with_name("refused.csv")
    refused.write_text(table.read_text().replace("joint_1", "joint_one"))
    assert run("check", URDF, refused, "--report", "--quiet") == 3
    head = capsys.readouterr().out

    for text in (whole, head):
        assert text.startswith(f"pincal {version('pincal')}, Python ") and f"numpy {version('numpy')}" in text
        assert "command: pincal check " in text and "sha256" in text
    assert "Coverage of the joint ranges" in whole and "first line: joint_1," in whole and "first line: joint_one," in head
    assert not any(row.split(",")[0] in whole for row in table.read_text().splitlines()[1:])


ARRAYS = """
import sys
from pathlib import Path
import numpy as np
from pincal.cli import _return_large_arrays

if sys.argv[1] == "yes":
    _return_large_arrays()
held = lambda: 4096e-6 * int(Path("/proc/self/statm").read_text().split()[1])
np.ones(2_500_000)
before, large, few = held(), [], []
for _ in range(10):
    large.append(np.ones(2_000_000))
    few.append(np.ones(10_000))
del large
print(held() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="of the C library of Linux")
def test_large_arrays_return_to_the_system():
    """What was freed between arrays that are kept is no memory of the process any more: of 160 MB, nothing."""
    done = subprocess.run([sys.executable, "-c", ARRAYS, "yes"], check=True, capture_output=True, text=True)

    assert float(done.stdout) < 10.0


def test_a_note_on_loops_is_printed_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In the summary, which has it; where a command is refused, before the refusal."""
    robot, table = tmp_path / "robot.urdf", tmp_path / "t.csv"
    robot.write_bytes(four_bar())
    assert run("simulate", robot, "--tip", "tip", "--poses", "20", "--seed", "1", "--out", table, "--quiet") == 0
    capsys.readouterr()
    assert run("check", robot, table, "--tip", "tip", "--model", "geometric", "--cell", "none") == 0
    told = capsys.readouterr()
    assert "through the loops closed by pin" in " ".join(told.out.split())
    assert "loops" not in told.err

    header, rows = table.read_text().split("\n", 1)
    table.write_text("\n".join([header.replace(",z", ",zz"), rows]))
    # A process reads the same content once, and warns of the same file once.
    robot = tmp_path / "again.urdf"
    robot.write_bytes(four_bar().replace(b"</robot>", b"<!-- again --></robot>"))
    assert run("check", robot, table, "--tip", "tip", "--cell", "none") == 3
    told = capsys.readouterr()
    assert "through the loops closed by pin" in told.err.splitlines()[0]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("diagnose", "TABLE", "MODEL", "--out", "d"), "is a table; expected a model.json"),
        (("calibrate", "TABLE", "ROBOT", "--cell", "none", "--out", "d"), "are robot and table in each other's place?"),
        (("design", "MODEL", "--poses", "20", "--out", "p.csv"), "beside a model.json stands its calibrated.urdf"),
    ],
)
def test_files_in_each_other_s_place_are_told(
    words: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A table in place of a model was advised to be taken from a backup."""
    monkeypatch.chdir(tmp_path)
    Path("t.csv").write_text("joint_1,x,y,z\n0,1,2,3\n")
    Path("model.json").write_text("{}")
    files = {"TABLE": "t.csv", "MODEL": "model.json", "ROBOT": kuka_urdf_path()}

    assert run(*(files.get(word, word) for word in words)) == 3
    assert said in capsys.readouterr().err


def test_a_slip_in_the_name_of_a_joint_above_the_base_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without its column the rail was taken to stand still; one that is not there at all, or a neighbour's, is no slip."""
    text = Path(kuka_urdf_path()).read_text(encoding="utf-8")
    rail = (
        '<link name="world"/><joint name="rail_1" type="prismatic"><parent link="world"/><child link="base_link"/>'
        '<axis xyz="1 0 0"/><limit lower="0" upper="4" effort="1" velocity="1"/></joint>'
    )
    robot, table = tmp_path / "rail.urdf", tmp_path / "t.csv"
    robot.write_text(text.replace("</robot>", f"{rail}</robot>"))
    assert run("simulate", robot, "--poses", "20", "--seed", "1", "--out", table, "--quiet") == 0
    header, rows = table.read_text().split("\n", 1)
    capsys.readouterr()

    table.write_text("\n".join([header.replace("rail_1", "rial_1"), rows]))
    assert run("check", robot, table, "--cell", "none") == 3
    assert 'no column for joint "rail_1" (is it "rial_1"?)' in capsys.readouterr().err

    # Rows of the arm alone, which fit with the rail at rest: no search for what is wrong with them.
    assert run("simulate", kuka_urdf_path(), "--poses", "20", "--seed", "1", "--out", table, "--quiet") == 0
    header, *rows = table.read_text().splitlines()
    table.write_text("\n".join([f"{header},travel", *(f"{row},0" for row in rows)]))
    run("check", robot, table, "--cell", "none")
    assert "no column for joint" not in capsys.readouterr().err
