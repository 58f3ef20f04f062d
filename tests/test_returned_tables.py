"""Tables that come back from ``pincal compensate`` as they went in: other numbers of joints, and further columns behind."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import openpyxl
import polars as pl
import pytest
from command_line import run
from scipy.spatial.transform import Rotation
from test_corrector import answered
from test_export import EFFECTS, drawn

from pincal.calibration.fitted_robot import FittedRobot
from pincal.compensate.compensation import compensate_program
from pincal.compensate.robot_frames import false_targets, program_poses
from pincal.export import export_model
from pincal.model.conditions import Conditions
from pincal.robot.robot import Robot

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

N = 6


@dataclass(frozen=True)
class Made:
    """A robot that errs, its file, a program, and the joints that it becomes."""

    calibrated: FittedRobot
    model: Path
    at: Conditions
    q: np.ndarray


@pytest.fixture(scope="module")
def made(kuka: Robot, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Return the KUKA with a gear error."""
    calibrated = drawn(EFFECTS["gear_ratio"](kuka.joint_names), kuka)
    model = tmp_path_factory.mktemp("returned") / "model.json"
    calibrated.save(model)
    q = np.round(np.array([0.2, 0.6, -0.4, 0.3, 0.9, -0.2]) + np.random.default_rng(2).uniform(-0.3, 0.3, (N, 6)), 6)
    at = Conditions.at(q, payload_centre=calibrated.payload_centre)
    return Made(calibrated, model, at, compensate_program(calibrated, at).q)


def degrees(made: Made, k: int) -> list[str]:
    return [f"{x:.9f}" for x in np.rad2deg(made.at.q[k])]


def rows(made: Made, separator: str, *, comma: bool = False) -> list[str]:
    """Return the program in degrees, numbered, with a comment behind."""
    lines = [separator.join([str(k), *degrees(made, k), f"caf\xe9{k}"]) for k in range(N)]
    return [line.replace(".", ",") for line in lines] if comma else lines


HEADER = ["nr", *(f"J{i} [deg]" for i in range(1, 7)), "comment"]
UNITS = ["Cell 3;;;;;;;", ";".join(["nr", *(f"J{i}" for i in range(1, 7)), "comment"]), ";deg;deg;deg;deg;deg;deg;"]


def joined(separator: str, head: list[str], body: list[str], end: str = "\n") -> str:
    return end.join([*head[:-1], separator.join(HEADER) if head[-1] == "names" else head[-1], *body, ""])


def in_blanks(made: Made) -> str:
    return joined(" ", [" ".join(f"A{i}_deg" for i in range(1, 7))], ["  ".join(degrees(made, k)) for k in range(N)])


def quoted(made: Made) -> str:
    body = [re.sub(r"(-?[\d.]{5,})", r'"\1"', line) for line in rows(made, ",")]
    return joined(",", [",".join(f'"{name}"' for name in HEADER)], body)


# Name, text and encoding of each.
TEXTS: dict[str, Callable[[Made], tuple[str, str, str]]] = {
    "commas": lambda m: ("t.csv", joined(",", ["names"], rows(m, ",")), "utf-8"),
    "decimal commas": lambda m: (
        "t.csv", joined(";", ["# by hand", "names"], rows(m, ";", comma=True), "\r\n"), "latin-1",
    ),
    "tabs": lambda m: ("t.tsv", joined("\t", ["names"], rows(m, "\t")).rstrip("\n"), "utf-8"),
    "byte order mark": lambda m: ("t.csv", "\ufeff" + joined(",", ["names"], rows(m, ",")), "utf-8"),
    "utf-16": lambda m: ("t.txt", joined("\t", ["names"], rows(m, "\t"), "\r\n"), "utf-16"),
    "blanks": lambda m: ("t.txt", in_blanks(m), "utf-8"),
    "quotation marks": lambda m: ("t.csv", quoted(m), "utf-8"),
    "title and units": lambda m: ("t.csv", joined(";", UNITS, rows(m, ";")), "utf-8"),
}  # fmt: skip


def without_numbers(text: str) -> str:
    return re.sub(r"-?\d+[.,]\d{5,}", "#", text)


@pytest.mark.parametrize("kind", TEXTS)
def test_a_text_keeps_all_but_its_numbers(kind: str, made: Made, tmp_path: Path) -> None:
    """With --only-numbers; without, further columns stand behind and the lines begin as they did."""
    name, text, encoding = TEXTS[kind](made)
    (tmp_path / name).write_bytes(text.encode(encoding))
    command = ("compensate", made.model, tmp_path / name, "--quiet", "--json")
    assert run(*command, "--out", tmp_path / f"only_{name}", "--only-numbers") == 0
    assert run(*command, "--out", tmp_path / f"more_{name}") == 0
    only, more = ((tmp_path / f"{kind}_{name}").read_bytes().decode(encoding) for kind in ("only", "more"))

    assert only != text and without_numbers(only) == without_numbers(text)
    numbers = [re.findall(r"-?\d+[.,]\d{5,}", line) for line in only.splitlines()]
    found = np.array([[float(cell.replace(",", ".")) for cell in row] for row in numbers if row])
    np.testing.assert_allclose(np.deg2rad(found), made.q, rtol=0.0, atol=3e-11)
    assert all(b.startswith(a.rstrip(" ")) for a, b in zip(only.splitlines(), more.splitlines(), strict=True))
    assert more.splitlines()[-1].endswith("ok")


def test_a_workbook_stays_one(made: Made, tmp_path: Path) -> None:
    """Its other worksheets, formats and formulas, too."""
    book = openpyxl.Workbook()
    book.active.title = "notes"
    page = book.create_sheet("program")
    page.append(["Cell 3"])
    page.append([*(f"J{i}" for i in range(1, 7)), "twice"])
    for k, q in enumerate(np.rad2deg(made.at.q)):
        page.append([*q.tolist(), f"=2*A{k + 3}"])
    page["A3"].number_format = "0.00"
    page.insert_rows(3)
    for column in range(1, 7):
        page.cell(3, column, "deg")
    book.save(tmp_path / "t.xlsx")
    assert run("compensate", made.model, tmp_path / "t.xlsx", "--out", tmp_path / "out.xlsx", "--quiet") == 0
    out = openpyxl.load_workbook(tmp_path / "out.xlsx")["program"]
    found = np.array([[out.cell(4 + k, c + 1).value for c in range(6)] for k in range(N)])

    np.testing.assert_allclose(np.deg2rad(found), made.q, rtol=0.0, atol=1e-12)
    assert [out.cell(2, c).value for c in (1, 7, 8)] == ["J1", "twice", "x"] and out.cell(5, 7).value == "=2*A4"
    assert out["A4"].number_format == "0.00" and out.cell(4, 7 + 12).value == "ok"
    assert run("compensate", made.model, tmp_path / "t.xlsx", "--out", tmp_path / "out.csv", "--quiet") == 0
    assert (tmp_path / "out.csv").read_text().startswith("joint_1,")


def test_a_parquet_table_keeps_its_columns(made: Made, tmp_path: Path) -> None:
    """In their order and units."""
    columns = {f"J{i + 1} [deg]": np.rad2deg(made.at.q[:, i]) for i in range(6)}
    pl.DataFrame({"nr": np.arange(N)} | columns).write_parquet(tmp_path / "t.parquet")
    assert run("compensate", made.model, tmp_path / "t.parquet", "--out", tmp_path / "o.parquet", "--quiet") == 0
    found = pl.read_parquet(tmp_path / "o.parquet")

    assert found.columns[:7] == ["nr", *columns] and found["status"].to_list() == ["ok"] * N
    np.testing.assert_allclose(np.deg2rad(found.select(list(columns)).to_numpy()), made.q, rtol=0.0, atol=1e-12)


def test_false_targets_stand_in_the_tables_own_units(made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Millimetres and A B C, beside the joints to command; wanted poses stay as they were."""
    wanted = program_poses(made.calibrated, made.at)
    angles = Rotation.from_matrix(wanted[:, :, :3]).as_euler("ZYX", degrees=True)
    cells = np.column_stack([1e3 * wanted[:, :, 3], angles])
    lines = ["X [mm],Y [mm],Z [mm],A,B,C", *(",".join(f"{x:.7f}" for x in row) for row in cells)]
    (tmp_path / "poses.csv").write_text("\n".join([*lines, ""]))
    command = ("compensate", made.model, tmp_path / "poses.csv", "--out", tmp_path / "o.csv", "--frame", "base")
    seed = ("--seed-joints", " ".join(map(str, made.at.q[0])))
    assert run(*command, "--false-targets", "tip", *seed) == 0
    head, *body = (tmp_path / "o.csv").read_text().splitlines()
    names = head.split(",")
    table = np.array([line.split(",") for line in body])
    found = {name: table[:, i] for i, name in enumerate(names)}
    q = np.column_stack([found[name] for name in made.calibrated.model.chain.robot.joint_names]).astype(float)
    tips = false_targets(made.calibrated, made.calibrated.conditions_at(q))
    told = np.column_stack([found[f"false_{name}"] for name in lines[0].split(",")]).astype(float)

    assert head.startswith(lines[0]) and all(a.startswith(b) for a, b in zip(body, lines[1:], strict=True))
    np.testing.assert_allclose(1e-3 * told[:, :3], tips[:, :, 3], rtol=0.0, atol=1e-9)
    back = Rotation.from_euler("ZYX", told[:, 3:], degrees=True).as_matrix()
    np.testing.assert_allclose(back, tips[:, :, :3], rtol=0.0, atol=1e-9)
    assert run(*command, "--only-numbers") == 2
    assert "joint columns" in capsys.readouterr().err


@pytest.mark.long
def test_the_command_the_page_and_the_python_file_write_the_same(made: Made, tmp_path: Path) -> None:
    """A table of joints, byte for byte."""
    import subprocess
    import sys

    name, text, encoding = TEXTS["decimal commas"](made)
    (tmp_path / name).write_bytes(text.encode(encoding))
    command = ("compensate", made.model, tmp_path / name, "--out", tmp_path / "o.csv", "--only-numbers", "--frame", "base")
    assert run(*command, "--quiet") == 0
    export_model(made.calibrated, "python", tmp_path / "arm.py", frame="base")
    ran = [sys.executable, "arm.py", name, "p.csv"]
    subprocess.run(ran, cwd=tmp_path, check=True, capture_output=True)
    given = json.dumps(text).replace("<", "\\u003c")
    code = f"return correct('t.csv', {given}, {{ ...options, start: ABOUT.start, frame: 'base' }}).text;"
    page = answered(export_model(made.calibrated, "page", frame="base").text, code, tmp_path)

    assert (tmp_path / "o.csv").read_bytes() == (tmp_path / "p.csv").read_bytes() == page.encode(encoding)
