"""What a program may do to its points, tools and bases elsewhere: such points are named and left, the others corrected."""

from pathlib import Path

import numpy as np
import pytest
from program_cases import KUKA, Writer, krl_point, rapid_target
from test_programs import calibrated

from pincal.cli import main
from pincal.programs.arms import ProgramAxes
from pincal.programs.correct import Corrector, ProgramCell
from pincal.programs.language import LANGUAGES
from pincal.programs.program import Program
from pincal.programs.syntax import Source

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

P = "{X 900,Y 0,Z 900,A 0,B 90,C 0,S 2,T 2}"
FRAMES = "$TOOL={X 0,Y 0,Z 100,A 0,B 0,C 0}\n$BASE=$WORLD\n"
T = "[[900,0,900],[0.5,0.5,0.5,0.5],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"
GUN = "PERS tooldata gun:=[TRUE,[[0,0,100],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\n"
TABLE = 'PERS wobjdata table:=[FALSE,TRUE,"",[[0,0,0],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];\n'
U, Q = "p[0.5,0,0.5,0,3.1,0]", "[0,-1.5,1.5,-1.5,-1.5,0]"
TCP = "set_tcp(p[0,0,0.1,0,0,0])\n"


def krl(body: str, more: str = "") -> tuple[str, str]:
    return "KRL", f"DEF p()\n{body}END\n{more}"


def rapid(body: str, data: str = "", more: str = "") -> tuple[str, str]:
    data = f"{GUN}{TABLE}CONST robtarget a:={T};\n{data}"
    return "RAPID", f"MODULE m\n{data}PROC main()\n{body}ENDPROC\n{more}ENDMODULE\n"


def fanuc(lines: str) -> tuple[str, str]:
    numbers = "X = 1 mm, Y = 2 mm, Z = 3 mm, W = 0 deg, P = 0 deg, R = 0 deg"
    positions = "".join(f"P[{n}]{{\n GP1:\n UF : 0, UT : 0, CONFIG : 'N U T, 0, 0, 0',\n {numbers}\n}};\n" for n in (1, 2))
    return "FANUC LS", f"/PROG A\n/MN\n   1:J P[1] 10% FINE ;\n{lines}/POS\n{positions}/END\n"


def jbi(lines: str) -> tuple[str, str]:
    head = "/JOB\n//NAME A\n//POS\n///NPOS 1,0,0,1,0,0\n///TOOL 0\n///POSTYPE PULSE\n///PULSE\n"
    return "JBI", f"{head}C00000=1,2,3,4,5,6\nP00001=1,2,3,4,5,6\n//INST\nNOP\nMOVJ C00000 VJ=1\n{lines}END\n"


# A program, the points of it that have known frames, and what is said of the others.
CASES: dict[str, tuple[tuple[str, str], set[str], str]] = {
    "a part of a tool is set": (
        krl(f"TOOL_DATA[1]={P}\nTOOL_DATA[1].Z=5\n$BASE=$WORLD\n$TOOL=TOOL_DATA[1]\nA={P}\nPTP A\n"),
        {"A"}, "TOOL_DATA[1]: line 3 sets a part of it",
    ),
    "a tool is set by a computed index": (
        krl(f"TOOL_DATA[1]={P}\nTOOL_DATA[I]={P}\n$BASE=$WORLD\n$TOOL=TOOL_DATA[1]\nA={P}\nPTP A\n"),
        {"A"}, "TOOL_DATA[1]: line 3 sets it",
    ),
    "a base is computed from a point": (
        krl(f"{FRAMES}A={P}\nB={P}\nPTP A\nBASE_DATA[3]=A\n$BASE=BASE_DATA[3]\nPTP B\n"),
        {"B"}, "A: it is a tool or a base, or one is computed from it",
    ),
    "a routine calls another that sets the tool": (
        krl(f"{FRAMES}A={P}\nB={P}\nPTP A\nUP()\nPTP B\n", "DEF UP()\nUPPER()\nEND\nDEF UPPER()\n$TOOL=TOOL_DATA[2]\nEND\n"),
        {"A", "B"}, "$TOOL: line 7 calls UP, which sets it",
    ),
    "a function in an expression sets the tool": (
        krl(f"{FRAMES}A={P}\nK=UP(1)\nPTP A\n", "DEFFCT INT UP(X:IN)\n$TOOL=TOOL_DATA[2]\nRETURN(1)\nENDFCT\n"),
        {"A"}, "line 5 calls UP, which sets it",
    ),
    "a routine elsewhere may set the tool": (krl(f"{FRAMES}A={P}\nGRIPPER(1)\nPTP A\n"), {"A"}, "not in these files"),
    "an interrupt sets the tool": (
        krl(f"INTERRUPT DECL 3 WHEN $IN[1]==TRUE DO UP()\n{FRAMES}A={P}\nPTP A\n", "DEF UP()\n$TOOL=TOOL_DATA[2]\nEND\n"),
        {"A"}, "may set it at any time",
    ),
    "a parameter has the name of a point": (
        krl(f"A={P}\nUP(B)\n", f"DEF UP(A:IN)\n{FRAMES}PTP A\nEND\n"), set(), "A: a parameter of the routine",
    ),
    "a function may change a point": (krl(f"{FRAMES}A={P}\nK=CALC(A)\nPTP A\n"), set(), "line 5 passes it to CALC"),
    "a routine takes its value": (
        krl(f"{FRAMES}A={P}\nCALC(A)\n$TOOL=$NULLFRAME\n$BASE=$WORLD\nPTP A\n", "DEF CALC(X:IN)\nY=X.X\nEND\n"), {"A"}, "",
    ),
    "an array with a computed index": (
        krl(f"P[1]={P}\nP[2]={P}\n{FRAMES}PTP P[1]\n$TOOL=TOOL_DATA[5]\nPTP P[I]\n"), {"P[2]"}, "P[1]: used with different frames",
    ),
    "speeds are no frames": (krl(f"{FRAMES}BAS(#VEL_PTP,50)\nA={P}\nPTP A\n"), {"A"}, ""),
    "positions are displaced": (rapid("PDispOn a,gun;\nMoveJ a,v1,fine,gun;\n"), set(), "A: it is a tool or a base"),
    "positions are displaced by a frame": (rapid("PDispSet f;\nMoveJ a,v1,fine,gun;\n"), {"A"}, "line 6 displaces positions"),
    "positions are displaced no more": (rapid("PDispSet f;\nPDispOff;\nMoveJ a,v1,fine,gun;\n"), {"A"}, ""),
    "a track moves": (rapid("MoveExtJ j,v1,fine;\nMoveJ a,v1,fine,gun;\n"), {"A"}, "line 6 displaces positions"),
    "a track moves back": (
        rapid("MoveExtJ j,v1,fine;\nMoveExtJ [[0,0,0,0,0,0],[0,9E9,9E9,9E9,9E9,9E9]],v1,fine;\nMoveJ a,v1,fine,gun;\n"),
        {"A"}, "",
    ),
    "a track moves elsewhere": (
        rapid("MoveExtJ [[0,0,0,0,0,0],[500,9E9,9E9,9E9,9E9,9E9]],v1,fine;\nMoveJ a,v1,fine,gun;\n"),
        {"A"}, "line 6 displaces positions",
    ),
    "another routine displaces positions": (
        rapid("up;\nMoveJ a,v1,fine,gun;\n", more="PROC up()\nPDispSet f;\nENDPROC\n"), {"A"}, "line 6 calls UP, which sets it",
    ),
    "the first statement of a routine sets a tool": (
        rapid("gun.tframe.trans.z:=3;\nMoveJ a,v1,fine,gun;\n"), {"A"}, "GUN: line 6 sets a part of it",
    ),
    "a statement behind THEN sets a tool": (
        rapid("IF x THEN gun:=other; ENDIF\nMoveJ a,v1,fine,gun;\n"), {"A"}, "GUN: line 6 sets it",
    ),
    "a statement behind a condition sets a tool": (
        rapid("IF x gun.tframe.trans.z:=3;\nMoveJ a,v1,fine,gun;\n"), {"A"}, "GUN: line 6 sets a part of it",
    ),
    "an instruction may change a tool": (rapid("MToolTCPCalib j,gun,e;\nMoveJ a,v1,fine,gun;\n"), {"A"}, "passes it to MTOOL"),
    "a tool is a parameter": (
        rapid("up gun;\n", more="PROC up(PERS tooldata gun)\nMoveJ a,v1,fine,gun;\nENDPROC\n"), {"A"}, "GUN is a parameter",
    ),
    "a target is a parameter": (
        rapid("up a;\n", more="PROC up(robtarget a)\nMoveJ a,v1,fine,gun;\nENDPROC\n"), set(), "A: a parameter of the routine",
    ),
    "a routine changes its parameter": (
        rapid("up b;\nMoveJ b,v1,fine,gun;\n", f"PERS robtarget b:={T};\n", "PROC up(PERS robtarget x)\nx.trans.x:=5;\nENDPROC\n"),
        set(), "B: line 7 passes it to UP",
    ),
    "a routine moves to its parameter": (
        rapid("up b;\nMoveJ b,v1,fine,gun;\n", f"PERS robtarget b:={T};\n", "PROC up(PERS robtarget x)\nMoveL x,v1,fine,gun;\nENDPROC\n"),
        {"B"}, "X: a parameter",
    ),
    "an array of targets": (
        rapid("FOR i FROM 1 TO 2 DO\nMoveL b{i},v1,z1,gun;\nENDFOR\n", f"CONST robtarget b{{2}}:=[{T},{T}];\n"),
        {"B[1]", "B[2]"}, "A: no motion uses it here",
    ),
    "welding": (rapid("ArcLStart a,v1,s,w,fine,gun\\WObj:=table;\n"), {"A"}, ""),
    "a frame is computed from points": (
        rapid("MoveJ a,v1,fine,gun;\ntable.uframe:=DefFrame(a,b,c);\nMoveJ d,v1,fine,gun\\WObj:=table;\n", f"CONST robtarget d:={T};\n"),
        {"D"}, "A: it is a tool or a base, or one is computed from it",
    ),
    "a position is set": (fanuc("   2:P[1,3]=R[1] ;\n"), {"P[2]"}, "P[1]: line 4 sets it"),
    "a position of a group is set": (fanuc("   2:P[GP1:1]=PR[GP1:3] ;\n"), {"P[2]"}, "P[1]: line 4 sets it"),
    "a coordinated motion": (fanuc("   2:L P[2] 9mm/sec FINE COORD[1] ;\n"), {"P[1]"}, "P[2]: moved by an offset (COORD)"),
    "any position": (fanuc("   2:L P[R[1]] 9mm/sec FINE ;\n"), {"P[1]", "P[2]"}, ""),
    "a relative motion": (jbi("IMOV P001 V=1\n"), {"C00000"}, "P00001: line 13 moves by it"),
    "a position variable is set": (jbi("SETE P001 (3) 5\nMOVL P001 V=1\n"), {"C00000"}, "P00001: line 13 may set it"),
    "a user frame of positions": (jbi("MFRAME UF#(1) C00000 C00001 C00002\n"), set(), "computes a frame from them"),
    "an argument has the name of a pose": (
        ("URScript", f"a={U}\ndef go(a):\n{TCP}movel(a)\nend\ngo(b)\n"), set(), "a: a parameter of the routine",
    ),
    "a function calls another that sets the tool": (
        ("URScript", f"def f():\n g()\nend\ndef g():\n set_tcp(p[0,0,1,0,0,0])\nend\n{TCP}movej({Q})\nf()\nmovel({U})\n"),
        {"target of line 8", "target of line 10"}, "set_tcp: line 9 calls f, which sets it",
    ),
    "a thread sets the tool": (
        ("URScript", f"thread T():\n set_tcp(p[0,0,1,0,0,0])\nend\n{TCP}movel({U})\n"), {"target of line 5"}, "at any time",
    ),
    "the path is displaced": (
        ("URScript", f"{TCP}path_offset_enable()\nmovel({U})\npath_offset_disable()\nmovel({U})\n"),
        {"target of line 3", "target of line 5"}, "line 2 displaces positions (path_offset_enable)",
    ),
    "a list of poses": (("URScript", f"{TCP}a=[{U},{U}]\nmovel(a[1])\nmovel(a[i])\n"), {"a[0]", "a[1]"}, ""),
    "an element of a list is set": (("URScript", f"{TCP}a=[{U},{U}]\na[i]={U}\nmovel(a[1])\n"), set(), "sets a part of it"),
}  # fmt: skip


def read(language: str, text: str) -> Program:
    """Return a program of one file."""
    reader = LANGUAGES.known()[language]()
    return reader.read([Source("file", text.encode())])


@pytest.mark.parametrize("name", CASES)
def test_a_point_that_the_program_may_set_is_left(name: str) -> None:
    """It is no point to correct, or its tool or base has no value; the reason says which line does it."""
    (language, text), points, reason = CASES[name]
    program = read(language, text)
    corrector = Corrector(calibrated(0.0), LANGUAGES.known()[language](), ProgramCell(axes=ProgramAxes.parse(None, KUKA)))
    found = {point.name for point in program.points.values()}
    framed = [corrector.frames(point, program) for point in program.points.values() if point.kind == "pose"]
    said = [f"{one.name}: {one.reason}" for one in program.skipped] + [why for why in framed if isinstance(why, str)]

    assert found == points, said
    assert any(reason in one for one in said) if reason else not said


@pytest.mark.parametrize("status", [0, 6])
def test_a_line_obeys_no_status(status: int) -> None:
    """KUKA evaluates S and T of PTP alone: a line keeps the posture of its start, and stale numbers stay as they are."""
    w = Writer("KRL", 3)
    a, b = w.draw(), w.draw()
    right = krl_point(w, b)
    stale = f"{right.partition(',S ')[0]},S {status},T 63}}"
    texts = [f"DEF p()\n$TOOL={{X 12.5,Y -30,Z 210.25,A 0,B 0,C 0}}\n$BASE={{X 400,Y -150,Z 75.5,A 0,B 0,C 0}}\n"
             f"PTP {krl_point(w, a)}\nLIN {target}\nEND\n" for target in (right, stale)]  # fmt: skip
    plain = [text.replace("\x02", "").split("\x01") for text in texts]
    texts = ["".join(part.partition(":")[2] if k else part for k, part in enumerate(parts)) for parts in plain]
    language = LANGUAGES.known()["KRL"]()
    corrector = Corrector(calibrated(4e-4), language, ProgramCell(axes=ProgramAxes.parse(None, KUKA)))
    found = []
    for text in texts:
        changes, left = corrector.changes(read("KRL", text))
        assert len(changes) == 2 and not left
        found.append(list(changes.values()))

    np.testing.assert_allclose(found[1][1].values, found[0][1].values, atol=1e-9)
    assert not corrector.turn_edits(found[1][1])


def test_configurations_that_are_switched_off_are_not_obeyed() -> None:
    """Behind ConfL off a line goes to the arm nearest to the one before; its confdata stay."""
    w = Writer("RAPID", 3)
    w.points = {}
    a, b = w.draw(tool=False, base=False), w.draw(tool=False, base=False)
    target = [_plain(rapid_target(w, k)) for k in (a, b)]
    before, _, after = target[1].rsplit("],[", 2)
    junk = f"{before}],[1,-2,1,7],[{after}"
    text = "MODULE m\nPROC main()\n{}MoveJ {},v1,fine,tool0;\nMoveL {},v1,fine,tool0;\nENDPROC\nENDMODULE\n"
    language = LANGUAGES.known()["RAPID"]()
    corrector = Corrector(calibrated(4e-4), language, ProgramCell(axes=ProgramAxes.parse(None, KUKA)))
    right, obeyed, off = (
        corrector.changes(read("RAPID", text.format(*words)))
        for words in (("", *target), ("", target[0], junk), ("ConfL\\Off;\n", target[0], junk))
    )

    assert not right[1] and "reach it in its posture" in obeyed[1][0].reason and not off[1]
    changes = [list(found[0].values())[1] for found in (right, off)]
    np.testing.assert_allclose(changes[1].values, changes[0].values, atol=1e-9)
    assert not corrector.turn_edits(changes[1])


def _plain(text: str) -> str:
    return "".join(part.partition(":")[2] if k else part for k, part in enumerate(text.replace("\x02", "").split("\x01")))


def test_several_arms_that_are_as_near_are_not_chosen_from() -> None:
    """Of a pose without a word on the posture behind one that is not known; joint positions to start from decide."""
    q = np.deg2rad([[20.0, 60.0, -80.0, 5.0, 5.0, -30.0]])
    tip = KUKA.forward_kinematics(q)[0]
    language = LANGUAGES.known()["KRL"]()
    pose = ",".join(f"{name} {value:.6f}" for name, value in zip("XYZABC", language.numbers(tip, np.zeros(6)), strict=True))
    frames = "$TOOL=$NULLFRAME\n$BASE=$NULLFRAME\n"
    text = f"DEF p()\n{frames}PTP {{A1 20,A2 60,A3 -80,A4 95,A5 0,A6 60}}\nLIN A:B\nLIN {{{pose}}}\nEND\n"
    cell = ProgramCell(axes=ProgramAxes.parse(None, KUKA), max_change=10.0)
    _, left = Corrector(calibrated(0.0), language, cell).changes(read("KRL", text))

    assert "several arm configurations reach it" in left[-1].reason


def test_a_program_is_not_written_over_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A second run would correct what is corrected already."""
    calibrated(4e-4).save(tmp_path / "model.json")
    (tmp_path / "p.src").write_text(f"DEF p()\n{FRAMES}PTP {P}\nEND\n")
    with pytest.raises(SystemExit) as ended:
        main(["compensate", str(tmp_path / "model.json"), str(tmp_path / "p.src"), "--out", str(tmp_path / "p.src")])

    assert ended.value.code == 2 and "another folder" in capsys.readouterr().err
