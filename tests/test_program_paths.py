"""Lines between corrected points, what a program leaves open, and what is refused, as a user meets it."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from program_cases import (
    ARMS,
    KUKA,
    LANGUAGES,
    Wanted,
    Writer,
    cases,
    fanuc_position,
    krl_point,
    posture_of,
    rapid_target,
    ur_pose,
)
from scipy.spatial.transform import Rotation
from test_programs import calibrated, nominal_joints, run

from pincal.export import export_model
from pincal.programs.arms import ArmSearch, ProgramAxes
from pincal.programs.language import LANGUAGES as KNOWN
from pincal.programs.language import read_sources
from pincal.programs.program import Number, Posture, Turn, number_text
from pincal.programs.rapid import Rapid

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

# An arm whose lines bend by tenths of a millimetre, and what is asked of it.
SIZE, LIMIT = 2e-3, 0.02e-3
ENDS = np.deg2rad([[40.0, 55.0, -75.0, 25.0, 50.0, -30.0], [-15.0, 75.0, -100.0, -5.0, 60.0, 10.0]])


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a robot that errs much."""
    path = tmp_path_factory.mktemp("model") / "model.json"
    calibrated(SIZE).save(path)
    return path


@pytest.fixture(scope="module")
def real_arm() -> Callable[[np.ndarray], np.ndarray]:
    """Return the exported NumPy model's forward kinematics."""
    names: dict[str, Any] = {}
    exec(compile(export_model(calibrated(SIZE), "python", frame="base").text, "arm.py", "exec"), names)
    forward: Callable[[np.ndarray], np.ndarray] = names["forward"]
    return forward


def line_program(language: str) -> tuple[str, str]:
    """Return name and text of a program with one line."""
    w = Writer(language, 0)
    w.points = {k: Wanted(q, "pose", np.eye(4), np.eye(4)) for k, q in enumerate(ENDS)}
    texts = {
        "KRL": lambda: "DEF a( )\r\n$TOOL=$NULLFRAME\r\n$BASE=$NULLFRAME\r\nPTP {}\r\n  LIN {} ; go\r\nEND\r\n",
        "RAPID": lambda: (
            "MODULE a\n PROC m()\n  MoveJ {},v10,fine,tool0;\n  MoveL {},v10,fine,tool0;\n ENDPROC\nENDMODULE\n"
        ),
        "URScript": lambda: "def a():\n  set_tcp(p[0,0,0,0,0,0])\n  movej({})\n  movel({}, a=1.2)\nend\n",
        "FANUC LS": lambda: "/PROG A\n/MN\n   1:J P[1] 10% FINE ;\n   2:L P[2] 9mm/sec FINE ;\n/POS\n{}{}/END\n",
    }[language]()
    write: dict[str, Callable[[int], str]] = {
        "KRL": lambda k: krl_point(w, k),
        "RAPID": lambda k: rapid_target(w, k),
        "URScript": lambda k: ur_pose(w, k),
        "FANUC LS": lambda k: fanuc_position(w, k, k + 1, "", False).replace("UF : 2, UT : 3", "UF : 0, UT : 0"),
    }
    parts = texts.split("{}")
    marked = parts[0] + write[language](0) + parts[1] + write[language](1) + parts[2]
    plain = re.sub("\x01\\d+:([^\x02]*)\x02", r"\1", marked)
    return "a" + KNOWN.known()[language].suffixes[0], plain


def poses_in(language: str, text: str) -> list[np.ndarray]:
    """Return the poses that stand in the motions of a program."""
    patterns = {
        "KRL": r"\{X ([^,]*),Y ([^,]*),Z ([^,]*),A ([^,]*),B ([^,]*),C ([^,}]*)",
        "RAPID": r"\[\[([^,]*),([^,]*),([^,]*)\],\[([^,]*),([^,]*),([^,]*),([^,]*)\]",
        "URScript": r"move.\(p\[([^,]*),([^,]*),([^,]*),([^,]*),([^,]*),([^,]*)\]",
    }
    reader = KNOWN.known()[language]()
    return [reader.pose(np.array(list(map(float, numbers)))) for numbers in re.findall(patterns[language], text)]


def off_line(told: list[np.ndarray], meant: list[np.ndarray], fk: Callable[[np.ndarray], np.ndarray]) -> float:
    """Return how far an arm that is told poses one after the other leaves the line between two others [m]."""
    start, along = meant[0][:3, 3], meant[1][:3, 3] - meant[0][:3, 3]
    along = along / np.linalg.norm(along)
    q, worst = ENDS[0], 0.0
    for a, b in pairwise(told):
        turn = Rotation.from_matrix(b[:3, :3] @ a[:3, :3].T).as_rotvec()
        for s in np.linspace(0.0, 1.0, 21):
            T = np.eye(4)
            T[:3, :3] = Rotation.from_rotvec(s * turn).as_matrix() @ a[:3, :3]
            T[:3, 3] = (1.0 - s) * a[:3, 3] + s * b[:3, 3]
            q = nominal_joints(T, q)
            off = fk(q[None])[0][:3, 3] - start
            worst = max(worst, float(np.linalg.norm(off - (off @ along) * along)))
    return worst


@pytest.mark.long
@pytest.mark.parametrize("language", ["KRL", "RAPID", "URScript"])
def test_points_are_inserted_where_a_line_is_not_straight(
    language: str,
    model: Path,
    real_arm: Callable[[np.ndarray], np.ndarray],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The deviation that is printed is the real one; with a limit, it is kept, and all other statements stay."""
    name, text = line_program(language)
    (tmp_path / name).write_bytes(text.encode())
    options = ["--seed-joints", " ".join(map(str, ENDS[0])), "--json", "--quiet"]
    assert run(model, tmp_path / name, "--out", tmp_path / f"ends{name}", *options) == 0
    plain = json.loads(capsys.readouterr().out)
    via_file = tmp_path / "new" / "folder" / name
    assert run(model, tmp_path / name, "--out", via_file, *options, "--path-error", "0.02mm") == 0
    more = json.loads(capsys.readouterr().out)
    meant = poses_in(language, text)
    two, many = (poses_in(language, file.read_text()) for file in (tmp_path / f"ends{name}", via_file))
    before, after = off_line(two, meant, real_arm), off_line(many, meant, real_arm)

    assert len(plain["points"]) == len(more["points"]) == 2 and not plain["left"] and not more["left"]
    assert before > 2.0 * LIMIT and plain["path"]["largest_mm"] == pytest.approx(1e3 * before, rel=0.05)
    assert len(many) == 2 + more["inserted"] and after < 1.05 * LIMIT
    ends, via = (file.read_bytes().splitlines(keepends=True) for file in (tmp_path / f"ends{name}", via_file))
    assert len(via) == len(ends) + more["inserted"] and [line for line in via if line in ends] == ends
    with capsys.disabled():
        print(f"\n{language}: {1e3 * before:.3f} mm off the line, {1e3 * after:.4f} mm with {more['inserted']} points")


def test_what_is_inserted_has_angles_of_half_a_turn_at_most(tmp_path: Path) -> None:
    """As a pendant shows them, wherever the angles of the end lie."""
    name, text = line_program("KRL")
    (tmp_path / name).write_bytes(text.encode())
    language = KNOWN.known()["KRL"]()
    program = language.read(read_sources([tmp_path / name]))
    values = np.array([1.0, 2.0, 3.0, -190.0, 20.0, 202.5])
    posture = next(iter(program.points.values())).posture
    inserted = language.statement(program.motions[-1][0], program.sources[0], values=values, posture=posture)
    assert inserted == "LIN {X 1.0000,Y 2.0000,Z 3.0000,A 170.000000,B 20.000000,C -157.500000} C_DIS"


def test_a_line_that_takes_no_points_is_named(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """FANUC's positions stand apart from their motions."""
    name, text = line_program("FANUC LS")
    (tmp_path / name).write_text(text)

    assert run(model, tmp_path / name, "--out", tmp_path / f"via{name}", "--path-error", "0.02mm") == 0
    out = capsys.readouterr().out
    assert "no points are inserted: none can be inserted into programs in FANUC LS" in out
    assert "line 4" in out and "leaves its path by" in out


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.src", "DEF a( )\nPTP {A1 0\nEND\n", "a.src, line 2, column 10"),
        ("a.src", "DEF a( )\nLOOP\nPTP XP1\nEND\n", "a.src, line 4, column 1: 'END' within LOOP of line 2"),
        ("a.src", "MODULE a\nENDMODULE\n", "a.src, line 1, column 1: a statement outside DEF"),
        (
            "a.src",
            "DEF a( )\nPTP XP1\n",
            "a.src, line 3, column 1: the end of the file within DEF of line 1: is it",
        ),
        ("a.mod", "MODULE a\nPROC b()\nENDPROC\n", "a.mod, line 4, column 1: the end of the file within MODULE of line 1"),
        ("a.mod", "DEF a( )\nEND\n", "a.mod, line 3, column 1: the end of the file, expected RAPID"),
        ("a.ls", "/PROG A\n/MN\n   1:J P[1] 10% FINE ;\n/POS\nP[1]{\n  GP1:\n  UF : 0, UT", "a.ls, line 7, column 13"),
        ("a.script", "def a():\n  movej([0,0,0,0,0,0])\n", "a.script, line 3, column 1: the end of the file within def"),
        ("a.jbi", "/JOB\n//NAME A\n//POS\n//INST\nNOP\n", "a.jbi, line 6, column 1: the end of the file without END"),
        ("a.script", "def a():\n\0end\n", "a.script, line 2, column 1: a zero byte"),
    ],
)
def test_what_is_cut_or_of_another_dialect_is_refused(
    name: str, text: str, words: str, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At a line and a column, and nothing is written."""
    (tmp_path / name).write_bytes(text.encode())

    assert run(model, tmp_path / name, "--out", tmp_path / f"out{name}") == 3
    assert words in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in tmp_path.iterdir()] == [name]


_NULL = "$TOOL=$NULLFRAME\n$BASE=$NULLFRAME\n"
LEFT = {
    "$BASE=$NULLFRAME\nLIN {X 1,Y 0,Z 2,A 0,B 0,C 0,S 2,T 0}": "$TOOL are not known: give --tool '$TOOL=X,Y,Z,...'",
    "$TOOL=$NULLFRAME\n$BASE=BASE_DATA[7]\nLIN {X 1,Y 0,Z 2,A 0,B 0,C 0,S 2,T 0}": "--base 'BASE_DATA[7]=X,Y,Z,...'",
    "$BASE=$NULLFRAME\nIF $IN[1] THEN\n$TOOL=$NULLFRAME\nENDIF\nLIN {X 1,Y 0,Z 2,A 0,B 0,C 0}": "on some paths only",
    "$BASE=$NULLFRAME\nFOR\nLIN {X 1,Y 0,Z 2,A 0,B 0,C 0}\n$TOOL=$NULLFRAME\nENDFOR": "it is set within the loop of line 3",
    _NULL + "LIN {X 9000,Y 0,Z 2,A 0,B 0,C 0,S 2,T 0}": "no joint positions within the limits reach it",
    _NULL + "LIN {X 1500,Y 0,Z 1500,A 0,B 90,C 0}": "nothing before it determines the arm configuration",
    "PTP {A1 0,A2 170,A3 0,A4 0,A5 0,A6 0}": "joint_2 is beyond its limits",
    "PTP {A1 0,A2 17}": "not all of A1 A2 A3 A4 A5 A6 are given as numbers",
    _NULL + "LIN {X 1,Y 0,Z 2,A 0,B 0,C 0,E1 5.0}": "an external axis is not at 0",
    "PTP XP1 : {X 5}": "a computed position",
    "PTP_REL {A1 5}": "a relative motion",
}


@pytest.mark.parametrize("statements", LEFT)
def test_what_is_not_understood_is_named_and_stays(
    statements: str, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the reason; exit code 4, as nothing was corrected."""
    text = f"DEF a( )\n{statements}\nEND\n"
    (tmp_path / "a.src").write_text(text)

    assert run(model, tmp_path / "a.src", "--out", tmp_path / "b.src") == 4
    assert LEFT[statements] in capsys.readouterr().out
    assert (tmp_path / "b.src").read_text() == text


def test_a_correction_that_is_too_large_is_left(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By --max-change; --strict makes exit code 4 of one point that is left."""
    (tmp_path / "a.src").write_text("DEF a( )\nPTP {A1 0,A2 60,A3 -80,A4 25,A5 50,A6 0}\nPTP_REL {A1 5}\nEND\n")

    assert run(model, tmp_path / "a.src", "--out", tmp_path / "b.src", "--max-change", "0.01deg") == 4
    assert "deg (--max-change)" in capsys.readouterr().out
    assert run(model, tmp_path / "a.src", "--out", tmp_path / "b.src") == 0
    assert run(model, tmp_path / "a.src", "--out", tmp_path / "b.src", "--strict") == 4
    assert run(model, tmp_path / "a.src", "--out", tmp_path / "b.mod") == 2


def test_frames_of_another_file_are_read_and_nothing_else_is_done_to_it(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As $config.dat has TOOL_DATA and BASE_DATA."""
    case = next(case for case in cases("KRL", range(12)) if len(case.files) == 2)
    for file in case.files:
        (tmp_path / file).write_bytes(case.content(file))
    frames = "TOOL_DATA[3]={X 12.5,Y -30,Z 210.25,A 0,B 0,C 0}\nBASE_DATA[2]={X 400,Y -150,Z 75.5,A 0,B 0,C 0}\n"
    config = f"DEFDAT $CONFIG\n{frames}ENDDAT\n"
    (tmp_path / "config.dat").write_text(config)
    words = [model, tmp_path / "test.src", "--json", "--quiet"]

    assert run(*words, "--out", tmp_path / "given.src", *LANGUAGES["KRL"][1]) == 0
    assert run(*words, "--out", tmp_path / "read.src", "--with", tmp_path / "config.dat") == 0
    assert (tmp_path / "read.dat").read_bytes() == (tmp_path / "given.dat").read_bytes()
    assert (tmp_path / "config.dat").read_text() == config


def test_flags_of_makers_are_the_shape_of_the_arm() -> None:
    """KUKA's S at home is 2: in front, elbow up, axis 5 not below 0; three of its axes run against the URDF's."""
    arms = ArmSearch(KUKA, ProgramAxes.parse("q1,-q2,-q3,q4,-q5,q6", KUKA))
    axes = np.deg2rad([[0.0, -90.0, 90.0, 0.0, 30.0, 0.0], [0.0, -90.0, 90.0, 0.0, -30.0, 0.0]])
    q = arms.axes.to_robot(axes)

    assert arms.sides(q).tolist() == [[1.0, 1.0, 1.0], [1.0, 1.0, -1.0]]
    assert KUKA.forward_kinematics(q)[0, 2, 3] < KUKA.forward_kinematics(q)[1, 2, 3]
    assert np.allclose(arms.axes.to_program(q), axes)


def test_an_arm_is_found_in_its_posture() -> None:
    """Of all that reach a pose, the one whose sides are named is found, and no other."""
    q = KUKA.random_configurations(50, np.random.default_rng(2))
    sides = ARMS.sides(q)
    found = ARMS.find(ARMS.tips(q), [posture_of(row) for row in q], None)
    assert [len(rows) for rows in found] == [1] * 50
    assert all(np.allclose(np.sin(0.5 * (rows[0] - row)), 0.0, atol=1e-6) for rows, row in zip(found, q, strict=True))
    assert np.array_equal(sides, ARMS.sides(np.concatenate(found)))


@pytest.mark.parametrize(("off", "count"), [(0.9e-4, {0, 1}), (1.1e-4, {0})])
def test_a_joint_at_the_edge_of_a_turn_may_have_either_number(off: float, count: set[int]) -> None:
    """Within a tenth of a milliradian of half a turn a controller may round either way."""
    q = np.zeros(6)
    q[3] = np.pi - off
    number = Number(0.0, 0, 1, "0")
    arms = ArmSearch(KUKA, ProgramAxes.parse("q1,q2,q3,q4,q5,q6", KUKA))
    held = {n for n in (0, 1) if arms.has_turns(q, Posture(turns=(Turn(3, "half", n, number),)))}

    assert held == count


@pytest.mark.parametrize(("length", "is_pose"), [(1.0019, True), (1.0021, False)])
def test_four_numbers_of_length_one_are_an_orientation(length: float, is_pose: bool) -> None:
    """Rounded to four digits; a longer list is of something else."""
    assert Rapid().is_pose(np.array([0.0, 0.0, 0.0, length, 0.0, 0.0, 0.0])) == is_pose


def test_numbers_keep_their_spelling() -> None:
    """Digits, sign and point as they were, where that says enough."""
    assert number_text(Number(-0.13, 0, 4, "-.13"), 0.25, 3) == ".250"
    assert number_text(Number(5.0, 0, 2, "+5"), 6.0, 2) == "+6.00"
    assert number_text(Number(5.0, 0, 7, "5.00000"), -0.0000001, 4) == "0.00000"
    assert number_text(Number(17.0, 0, 2, "17"), 17.4, 0) == "17"


def test_a_routine_is_not_called_by_an_argument_of_its_name(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """``a=1.2`` calls no routine a, though a sets the tool; that the program sets it counts more than the option."""
    name, text = line_program("URScript")
    seed = ["--seed-joints", " ".join(map(str, ENDS[0]))]
    (tmp_path / name).write_text(text)

    assert run(model, tmp_path / name, "--out", tmp_path / f"b{name}", *seed) == 0
    assert "2 points corrected, 0 left" in capsys.readouterr().out
    assert run(model, tmp_path / name, "--out", tmp_path / f"c{name}", *seed, "--tool", "tcp=0,0,0.5,0,0,0") == 0
    assert (tmp_path / f"c{name}").read_bytes() == (tmp_path / f"b{name}").read_bytes()


@pytest.mark.parametrize(
    "words",
    [
        ["--tool", "1=1,2,3"],
        ["--axes", "q1,q2"],
        ["--axes", "q1,q1,q3,q4,q5,q6"],
        ["--world", "nowhere"],
        ["--pulses", "1 2"],
    ],
)
def test_options_that_make_no_sense_are_refused(
    words: list[str], model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 3, with what is expected."""
    name, text = line_program("KRL")
    (tmp_path / name).write_text(text)

    assert run(model, tmp_path / name, "--out", tmp_path / f"b{name}", *words) == 3
    assert "expected" in (err := capsys.readouterr().err) or "leave --pulses out" in err


@pytest.mark.long
@pytest.mark.parametrize("axes", [None, "q1, -q2, q3, q4, q5, q6+10"])
def test_programs_of_coupled_joints_hold_what_the_controller_reports(axes: str | None, tmp_path: Path) -> None:
    """Joint 3 reports less than the URDF's by joint 2: axes are recombined, and poses are those of the same arm."""
    plain = calibrated(SIZE)
    chain = plain.model.chain
    robot = chain.robot.with_couplings("joint_3=+joint_2")
    coupled = plain.with_model(plain.model.with_chain(replace(chain, robot=robot)), plain.estimate)
    sign, zero = (
        (np.eye(6), np.zeros(6)) if axes is None else (np.diag([1, -1, 1, 1, 1, 1]), np.array([0, 0, 0, 0, 0, 10.0]))
    )
    pose = "LIN {X 1500, Y 200, Z 1100, A 0, B 90, C 0}"
    found = []
    for name, of, told in (("plain", plain, ENDS), ("coupled", coupled, robot.as_reported(ENDS))):
        of.save(tmp_path / f"{name}.json")
        lines = [", ".join(f"A{i + 1} {x:.9f}" for i, x in enumerate(sign @ row + zero)) for row in np.rad2deg(told)]
        moves = [f"PTP {{{line}}}" for line in lines]
        text = "\n".join(
            ["DEF p()", "$BASE={X 0,Y 0,Z 0,A 0,B 0,C 0}", "$TOOL={X 0,Y 0,Z 0,A 0,B 0,C 0}", *moves, pose, "END"]
        )
        (tmp_path / f"{name}.src").write_text(text + "\n", encoding="utf-8")
        options = [] if axes is None else ["--axes", axes]
        out = tmp_path / f"{name}_out.src"
        assert run(tmp_path / f"{name}.json", tmp_path / f"{name}.src", "--out", out, *options) == 0
        written = out.read_text(encoding="utf-8").splitlines()
        numbers = [[float(x) for x in re.findall(r"[A-Z]\d? (-?[\d.]+)", line)] for line in written if "{" in line][2:]
        found.append((np.array(numbers[:2]), np.array(numbers[2])))

    (q, there), (reported, again) = found
    own = np.deg2rad((reported - zero) @ sign)
    np.testing.assert_allclose(np.rad2deg(robot.from_reported(own)), (q - zero) @ sign, atol=2e-6)
    np.testing.assert_allclose(again, there, atol=1e-3)
    assert np.abs(q - zero - np.rad2deg(ENDS) @ sign).max() > 1e-3
