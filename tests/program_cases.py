"""Programs of controllers for tests: forty-odd in each language, by what their manuals list.

Numbers of points stand between marks, so that a corrected program can be compared with the original in all other bytes.
"""

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from pincal.builtin import kuka_urdf_path
from pincal.programs.arms import ArmSearch, ProgramAxes
from pincal.programs.program import Posture
from pincal.robot.robot import Robot

KUKA = Robot.from_urdf(kuka_urdf_path())
ARMS = ArmSearch(KUKA, ProgramAxes.parse(None, KUKA))
TOOL, BASE = [12.5, -30.0, 210.25], [400.0, -150.0, 75.5]
PULSES = (-1200.5, 980.0, 1100.25, 900.0, 850.0, 500.0)
_MARKED = re.compile("\x01(\\d+):([^\x02]*)\x02")
_NUMBER = rb"([-+]?(?:\d+\.?\d*|\.\d+)|'B[01]+')"


@dataclass
class Case:
    """One program: its files, with marks around the numbers of points; which points these are; options of the command."""

    name: str
    language: str
    files: dict[str, str]
    encoding: str = "latin-1"
    points: dict[int, "Wanted"] = field(default_factory=dict)

    def content(self, file: str) -> bytes:
        """Return a file as the controller has it."""
        return _MARKED.sub(r"\2", self.files[file]).encode(self.encoding)

    def numbers(self, file: str, corrected: bytes) -> dict[int, list[float]]:
        """Return the numbers of each point in a corrected file, whose other bytes have to be as they were."""
        pieces, at, ids = [], 0, []
        for match in _MARKED.finditer(self.files[file]):
            pieces.append(re.escape(self.files[file][at : match.start()].encode(self.encoding)))
            ids.append(int(match[1]))
            at = match.end()
        pieces.append(re.escape(self.files[file][at:].encode(self.encoding)))
        found = re.fullmatch(_NUMBER.join(pieces), corrected, re.DOTALL)
        assert found, f"{self.name}: {file} differs in more than its numbers"
        numbers: dict[int, list[float]] = {}
        for key, text in zip(ids, found.groups(), strict=True):
            value = float(int(text[2:-1], 2)) if text.startswith(b"'") else float(text)
            numbers.setdefault(key, []).append(value)
        return numbers


@dataclass
class Wanted:
    """A point of a program: joint positions near it, and the tool and base that it is given with."""

    q: np.ndarray
    kind: str
    tool: np.ndarray
    base: np.ndarray


class Writer:
    """Draws points and writes them in a language's numbers."""

    def __init__(self, language: str, seed: int) -> None:
        self.language, self.rng, self.points = language, np.random.default_rng(seed), dict[int, Wanted]()
        self.home = np.deg2rad([20.0, 60.0, -80.0, 25.0, 50.0, -30.0])

    def draw(self, kind: str = "pose", tool: bool = True, base: bool = True) -> int:
        """Return a new point's number."""
        q = self.home + self.rng.uniform(-0.2, 0.2, 6)
        T, B = (frame(values) if used else np.eye(4) for values, used in ((TOOL, tool), (BASE, base)))
        self.points[len(self.points)] = Wanted(q, kind, T, B)
        return len(self.points) - 1

    def pose(self, k: int) -> np.ndarray:
        """Return the pose of the tool in the base, shape (4, 4) [m]."""
        point = self.points[k]
        return np.linalg.inv(point.base) @ KUKA.forward_kinematics(point.q[None])[0] @ point.tool

    def mark(self, k: int, value: float, digits: int = 3) -> str:
        """Return a marked number."""
        return f"\x01{k}:{value:.{digits}f}\x02"

    def xyz(self, k: int) -> list[str]:
        """Return marked coordinates in mm."""
        return [self.mark(k, 1e3 * value) for value in self.pose(k)[:3, 3]]

    def angles(self, k: int, order: str) -> list[str]:
        """Return marked angles in degrees about axes in an order."""
        angles = dict(zip("xyz", Rotation.from_matrix(self.pose(k)[:3, :3]).as_euler("xyz", degrees=True), strict=True))
        return [self.mark(k, angles[axis], 4) for axis in order]

    def joints(self, k: int, digits: int = 4) -> list[str]:
        """Return marked joint positions in degrees."""
        return [self.mark(k, value, digits) for value in np.rad2deg(self.points[k].q)]

    def sides(self, k: int) -> tuple[bool, bool, bool]:
        """Return front, up and down."""
        front, up, down = ARMS.sides(self.points[k].q[None])[0] > 0.0
        return bool(front), bool(up), bool(down)


def frame(values: list[float]) -> np.ndarray:
    """Return the pose of a frame that is not turned, from mm."""
    T = np.eye(4)
    T[:3, 3] = 1e-3 * np.array(values)
    return T


# --- KUKA


def krl_point(w: Writer, k: int, turns: str = "decimal", extra: str = "", sep: str = ",") -> str:
    """Return an E6POS."""
    front, up, down = w.sides(k)
    status = (not front) + 2 * up + 4 * (not down)
    bits = sum(int(value < 0.0) << j for j, value in enumerate(w.points[k].q))
    turn = f"\x01{k}:'B{bits:06b}'\x02" if turns == "bits" else f"\x01{k}:{bits}\x02"
    fields = [f"{n} {v}" for n, v in zip("XYZABC", [*w.xyz(k), *w.angles(k, "zyx")], strict=True)]
    return "{" + sep.join([*fields, f"S {status}", f"T {turn}"]) + extra + "}"


def krl_axes(w: Writer, k: int) -> str:
    """Return an E6AXIS."""
    return "{" + ",".join(f"A{j + 1} {v}" for j, v in enumerate(w.joints(k))) + ",E1 0.0}"


def krl(feature: int, w: Writer) -> dict[str, str]:
    """Return a program in KRL."""
    a, b, c, d = (w.draw() for _ in range(4))
    j = w.draw("joints")
    note = '; f\xfcr 5 \xb0 "kein Ende\n' if feature % 2 else "; {X 1,Y 2} DEF END\n"
    turns, sep = ("bits" if feature % 3 == 0 else "decimal"), (" , " if feature % 5 == 4 else ",")
    extra = ",E1 0.0,E2 0.0" if feature % 4 == 1 else ""
    p = [krl_point(w, k, turns, extra, sep) for k in (a, b, c, d)]
    frames = (f"$TOOL={{X {TOOL[0]},Y {TOOL[1]},Z {TOOL[2]},A 0,B 0,C 0}}\n"
              f"$BASE={{FRAME: X {BASE[0]},Y {BASE[1]},Z {BASE[2]},A 0,B 0,C 0}} ; base\n")  # fmt: skip
    inline = frames + f"PTP {krl_axes(w, j)}\nLIN {p[0]} C_DIS\nCIRC {p[1]},{p[2]}\nLIN  {p[3]}\n"
    named = frames + "PTP XJ\nLIN XA C_DIS C_DIS\nSCIRC XB,XC\n  LIN XD\n"
    declared = (f"DECL E6AXIS XJ={krl_axes(w, j)}\nDECL E6POS XA={p[0]}\nGLOBAL DECL E6POS XB={p[1]}\n"
                f"E6POS XC={p[2]}\nXD={p[3]}\n")  # fmt: skip
    fdat = ('DECL FDAT FA={TOOL_NO 3,BASE_NO 2,IPO_FRAME #BASE,POINT2[] " ",TQ_STATE FALSE}\n'
            "DECL PDAT PPDAT1={VEL 100.0,ACC 100.0,APO_DIST 100.0}\n")  # fmt: skip
    folded = ";FOLD INI;%{PE}\n  ;FOLD BASISTECH INI\n    INTERRUPT DECL 3 WHEN $STOPMESS==TRUE DO IR_STOPM ( )\n" + note
    folded += "    BAS (#INITMOV,0 )\n  ;ENDFOLD (BASISTECH INI)\n;ENDFOLD (INI)\n"
    taught = "".join(
        f";FOLD LIN {n} Vel=2 m/s CPDAT1 Tool[3] Base[2];%{{PE}}%R 8.3,%P 1:LIN, 2:{n}\n$BWDSTART=FALSE\nFDAT_ACT=FA\n"
        f"BAS(#CP_PARAMS,2)\nLIN X{n} {'C_DIS' if n == 'A' else ''}\n;ENDFOLD\n" for n in "ABCD"
    )  # fmt: skip
    spline = ("SPTP XJ WITH $TOOL=STOOL2(FA), $BASE=SBASE(FA.BASE_NO)\n"
              "SLIN XA WITH $VEL.CP=2, $TOOL = STOOL2( FA), $BASE= SBASE( FA.BASE_NO)\n")  # fmt: skip
    around = {
        0: inline,
        1: named,
        2: folded + taught + "PTP XJ\n",
        3: folded + "PTP XJ\n" + taught,
        4: f"IF $IN[1] == TRUE THEN\n{named}ELSE\n  WAIT SEC 0.5\nENDIF\n",
        5: f"LOOP\n  FOR I=1 TO 3 STEP 1\n{inline}  ENDFOR\nENDLOOP\n",
        6: f"SWITCH I\nCASE 1\n{named}CASE 2,3\n  HALT\nDEFAULT\nENDSWITCH\n",
        7: "BAS(#TOOL,3)\nBAS(#BASE,2)\nPTP XJ\nLIN XA\nLIN XB\nLIN XC\nLIN XD\n",
        8: "$TOOL=TOOL_DATA[3]\n$BASE=BASE_DATA[2]\nPTP XJ\nLIN XA:{X 5,Y 0,Z 0}\nLIN XA\nLIN_REL {X 10}\nLIN XB\nLIN XC\nLIN XD\n",
        9: named + "TRIGGER WHEN DISTANCE=0 DELAY=0 DO $OUT[5]=TRUE\nPTP $AXIS_ACT\nPTP HOME\n",
        10: "SIGNAL X $OUT[1] TO $OUT[8]\nPULSE($OUT[1],TRUE,0.5)\n" + named + 'MSG="; no comment {"\n',
        11: spline + "BAS(#TOOL,3)\nBAS(#BASE,2)\nLIN XB\nLIN XC\nLIN XD\n",
        12: "$TOOL=TOOL_DATA[3]\n$BASE=BASE_DATA[2]\nSPLINE\n SPL XA\n SLIN XB\n SCIRC XC,XD\nENDSPLINE\nPTP XJ\n",
        13: "WHILE NOT $IN[3]\nREPEAT\n" + inline + "UNTIL $IN[2]\nENDWHILE\nGOTO ENDE\nENDE:\n",
    }[feature % 14]
    head = "&ACCESS RVP\n&REL 12\n&PARAM EDITMASK = *\n" if feature % 2 else ""
    src = f"{head}{'GLOBAL ' if feature % 7 == 6 else ''}DEF test_{feature}( )\n INT I\n{note}{around}END\n"
    src += f"\nDEF sub (A:IN, B :OUT )\n{note}END\n" if feature % 3 == 1 else ""
    uses_names = "XA" in around
    dat = f"&ACCESS RVP\nDEFDAT test_{feature} PUBLIC\n{note};FOLD EXTERNAL DECLARATIONS\nEXT BAS(BAS_COMMAND:IN,REAL:IN)\n"
    dat += f";ENDFOLD\n{fdat}{declared}DECL INT COUNT=7\nDECL E6POS UNSET\nENDDAT\n"
    return {"test.src": src, "test.dat": dat} if uses_names else {"test.src": src}


KRL_OPTIONS = ["--tool", f"TOOL_DATA[3]={TOOL[0]},{TOOL[1]},{TOOL[2]},0,0,0",
               "--base", f"BASE_DATA[2]={BASE[0]},{BASE[1]},{BASE[2]},0,0,0"]  # fmt: skip


# --- ABB


def rapid_target(w: Writer, k: int, sep: str = ",") -> str:
    """Return a robtarget."""
    front, up, down = w.sides(k)
    turn = Rotation.from_matrix(w.pose(k)[:3, :3]).as_quat()[[3, 0, 1, 2]]
    quarters = [int(np.floor(w.points[k].q[j] / (0.5 * np.pi))) for j in (0, 3, 5)]
    conf = [*(f"\x01{k}:{value}\x02" for value in quarters), str(4 * (not front) + 2 * (not up) + (not down))]
    rest = ",".join(["9E9", "9E+09", "9E9", "9E9", "9E9", "9E9"])
    parts = [sep.join(w.xyz(k)), sep.join(w.mark(k, v, 8) for v in turn), ",".join(conf), rest]
    return "[" + sep.join(f"[{part}]" for part in parts) + "]"


def rapid_joints(w: Writer, k: int) -> str:
    """Return a jointtarget."""
    return f"[[{','.join(w.joints(k))}],[9E9,9E9,9E9,9E9,9E9,9E9]]"


def rapid(feature: int, w: Writer) -> dict[str, str]:
    """Return a program in RAPID."""
    a, b, c, d = (w.draw() for _ in range(4))
    j = w.draw("joints")
    note = '! f\xfcr 5 \xb0; "kein Ende\n' if feature % 2 else "! MoveL p1,v1,z1,t; [[1,2,3]]\n"
    sep = {0: ",", 1: ", ", 2: ",\n      ", 3: ", ! in the middle\n  "}[feature % 4]
    t = [rapid_target(w, k, sep) for k in (a, b, c, d)]
    kind = ("CONST", "PERS", "LOCAL CONST", "TASK PERS")[feature % 4]
    data = "".join(f"  {kind} robtarget p{n}:={text};\n" for n, text in zip("ABCD", t, strict=True))
    data += f"  CONST jointtarget jA:={rapid_joints(w, j)};\n"
    tool = (f"  PERS tooldata tGun:=[TRUE,[[{TOOL[0]},{TOOL[1]},{TOOL[2]}],[1,0,0,0]],"
            "[4.5,[0,0,80],[1,0,0,0],0,0,0]];\n")  # fmt: skip
    work = (f"  PERS wobjdata wTable:=[FALSE,TRUE,\"\",[[{BASE[0]},{BASE[1]},0],[1,0,0,0]],"
            f"[[0,0,{BASE[2]}],[1,0,0,0]]];\n")  # fmt: skip
    with_work = "tGun\\WObj:=wTable"
    moves = f"    MoveAbsJ jA,v200,fine,tGun;\n    MoveJ pA,v1000,z50,{with_work};\n    MoveL pB, v100, fine, {with_work};\n"
    moves += f"    MoveC pC,pD,v100,z10,{with_work};\n"
    inline = f"    MoveAbsJ {rapid_joints(w, j)}\\NoEOffs,v100,fine,tool0;\n"
    inline += "".join(f"    MoveL {text},v500,z1,{with_work};\n" for text in t)
    body = {
        0: moves,
        1: inline,
        2: f"    IF di1=1 THEN\n{moves}    ELSEIF di2=0 THEN\n      WaitTime 0.5;\n    ELSE\n      Stop;\n    ENDIF\n",
        3: f"    WHILE TRUE DO\n{moves}    ENDWHILE\n",
        4: f"    FOR i FROM 1 TO 3 DO\n{inline}    ENDFOR\n",
        5: f'    TEST n\n    CASE 1:\n{moves}    CASE 2,3:\n      TPWrite "n";\n    DEFAULT:\n    ENDTEST\n',
        6: moves + f"    MoveL Offs(pB,0,0,50),v100,fine,{with_work};\n    MoveL RelTool(pA,0,0,-10),v100,z0,{with_work};\n",
        7: f"    MoveLDO pA,v100,fine,{with_work},do1,1;\n    MoveL pB\\ID:=10,v100\\V:=50,z10\\Inpos:=inpos50,{with_work};\n"
        f"    MoveJ pC,v10,fine,{with_work};\n    MoveL pD,v10,fine,{with_work};\n    MoveAbsJ jA,v10,fine,tGun;\n",
        8: moves + '    TPWrite "it\'s; ""quoted"" ! no comment [";\n    SetDO do1,1;\n    count:=count+1;\n',
        9: moves + "  ERROR\n    IF ERRNO=1 RETRY;\n    RETURN;\n",
    }[feature % 10]
    head = "%%%\n  VERSION:1\n  LANGUAGE:ENGLISH\n%%%\n\n" if feature % 3 == 2 else ""
    attributes = "(SYSMODULE, NOSTEPIN)" if feature % 5 == 3 else ""
    text = f"{head}MODULE Main{feature}{attributes}\n{note}{tool}{work}{data if body.count('pA') else ''}"
    text += f"  VAR num count:=0;\n  PROC main()\n{note}{body}  ENDPROC\n{note}"
    text += "  FUNC num f(num x\\switch y)\n    RETURN x*2;\n  ENDFUNC\n" if feature % 2 else ""
    return {f"test{'.mod' if feature % 3 else '.prg'}": text + "ENDMODULE\n"}


# --- FANUC


def fanuc_position(w: Writer, k: int, n: int, label: str, group2: bool) -> str:
    """Return a position."""
    front, up, down = w.sides(k)
    turns = [f"\x01{k}:{int(np.floor((w.points[k].q[j] + np.pi) / (2 * np.pi)))}\x02" for j in (0, 3, 5)]
    if w.points[k].kind == "joints":
        values = ",\t".join(f"J{i + 1}=  {v} deg" for i, v in enumerate(w.joints(k)))
        inner = f"\tUF : 2, UT : 3,\t\n\t{values}\n"
    else:
        config = f"{'N' if down else 'F'} {'U' if up else 'D'} {'T' if front else 'B'}, {', '.join(turns)}"
        x = ",\t".join(f"{n} =  {v}  mm" for n, v in zip("XYZ", w.xyz(k), strict=True))
        a = ",\t".join(f"{n} =  {v} deg" for n, v in zip("WPR", w.angles(k, "xyz"), strict=True))
        inner = f"\tUF : 2, UT : 3,\t\tCONFIG : '{config}',\n\t{x},\n\t{a}\n"
    second = "   GP2:\n\tUF : 0, UT : 1,\t\n\tJ1=   100.000  mm\n" if group2 else ""
    return f"P[{n}{label}]{{\n   GP1:\n{inner}{second}}};\n"


def fanuc(feature: int, w: Writer) -> dict[str, str]:
    """Return a listing."""
    keys = [w.draw("joints"), *(w.draw() for _ in range(4))]
    labels = [':"App\xe9 [roche"' if feature % 2 and n == 2 else "" for n in range(1, 6)]
    notes = ["!it's a comment: P[9]", '!f\xfcr "5', "--eg:remark 'x", "// J P[3] 100% FINE"]
    lines = [notes[feature % 4], "UFRAME_NUM=2", "UTOOL_NUM=3"]
    motions = [
        "J P[1] 100% FINE",
        "L P[2] 500mm/sec CNT100",
        "L P[3] 250mm/sec FINE ACC50",
        "C P[4]    \n    :  P[5] 200mm/sec FINE",
    ]
    more = {
        0: [],
        1: ["IF R[1:it's]=1,JMP LBL[2]", "LBL[2]"],
        2: ["L P[3] 100mm/sec FINE Offset,PR[5:gratow offset]"],
        3: ["PR[99:PR mobil]=P[1]", "PR[99,3:PR mobil]=(PR[99,3]+(R[22:a'b]*R[34]))"],
        4: ["CALL FERM_PINCE", "WAIT    .30(sec)", "DO[1:x]=ON"],
        5: ["J PR[1] 100% FINE", "MESSAGE[text's (]"],
        6: ["FOR R[1]=1 TO 10", "ENDFOR", "J P[1] 5% CNT0 TB   0.00sec,P-SPS"],
        7: ["L P[2] R[25:posuw L]mm/sec FINE\n    :  Arc Start[1]", "Weave End"],
        8: ["SELECT R[1]=1,CALL A", "       =2,CALL B", "       ELSE,JMP LBL[1]"],
        9: ["", "  ", "J P[1:home] 100% FINE"],
    }[feature % 10]
    order = (
        [*lines, *motions, *more] if feature % 3 else [*lines, *motions[:2], notes[(feature + 1) % 4], *motions[2:], *more]
    )
    main = "".join(
        f"{n:4d}:{'' if line[:2] in ('J ', 'L ', 'C ') else '  '}{line}    ;\n" for n, line in enumerate(order, 1)
    )
    positions = "".join(fanuc_position(w, k, n, label, feature % 4 == 3)
                        for n, (k, label) in enumerate(zip(keys, labels, strict=True), 1))  # fmt: skip
    head = f'/PROG  TEST{feature}\n/ATTR\nOWNER\t\t= MNEDITOR;\nCOMMENT\t\t= "it\'s \xe9";\nPROG_SIZE\t= 636;\nTCD:  STACK_SIZE\t= 0,\n'
    head += "      TASK_PRIORITY\t= 50;\nDEFAULT_GROUP\t= 1,*,*,*,*;\n"
    appl = "/APPL\n\nAUTO_SINGULARITY_HEADER;\n  ENABLE_SINGULARITY_AVOIDANCE   : FALSE;\n" if feature % 2 else ""
    return {"TEST.LS" if feature % 5 == 0 else "test.ls": f"{head}{appl}/MN\n{main}/POS\n{positions}/END\n"}


# --- Universal Robots


def ur_pose(w: Writer, k: int, sep: str = ", ") -> str:
    """Return a pose."""
    T = w.pose(k)
    values = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_rotvec()]
    return "p[" + sep.join(w.mark(k, value, 6) for value in values) + "]"


def urscript(feature: int, w: Writer) -> dict[str, str]:
    """Return a script."""
    a, b, c, d = (w.draw(base=False) for _ in range(4))
    j = w.draw("joints", base=False)
    note = "# f\xfcr \"5 ' end [\n" if feature % 2 else "# def end\n"
    sep = (", ", ",", ",\n     ")[feature % 3]
    p = [ur_pose(w, k, sep) for k in (a, b, c, d)]
    q = "[" + ", ".join(w.mark(j, value, 6) for value in w.points[j].q) + "]"
    tcp = f"set_tcp(p[{1e-3 * TOOL[0]}, {1e-3 * TOOL[1]}, {1e-3 * TOOL[2]}, 0, 0, 0])\n"
    scope = ("", "global ", "local ")[feature % 3]
    named = "".join(f"  {scope}W_{n}_p={text}\n" for n, text in zip("abcd", p, strict=True)) + f"  {scope}W_q = {q}\n"
    moves = "  movej(W_q, a=1.4, v=1.05)\n  movel(W_a_p, a=1.2, v=0.25, t=0, r=0.001)\n  movep(W_b_p)\n  movec(W_c_p, W_d_p, a=1)\n"
    inline = f"  movej({q})\n  movel({p[0]}, a=1.2)\n  movel({p[1]})\n  movec({p[2]}, {p[3]})\n"
    body = {
        0: named + moves,
        1: inline,
        2: f"{named}  while (True):\n{moves}  end\n",
        3: f"{named}  if (get_digital_in(1) == True):\n{moves}  elif x > 2:\n    sleep(0.5)\n  else:\n    halt\n  end\n",
        4: named
        + moves
        + "  movel(pose_trans(W_a_p, p[0,0,-0.1,0,0,0]), a=1.2)\n  movel(pose_add(W_b_p, p[0,0,.1,0,0,0]))\n",
        5: named
        + "  movej(W_q)\n  movej(get_inverse_kin(W_a_p, qnear=W_q), a=1.4)\n  movel(W_b_p)\n  movel(W_c_p)\n  movel(W_d_p)\n",
        6: f"{named}  i = 0\n  while i < 3:\n    if i == 1:\n{moves}    end\n    i = i + 1\n  end\n",
        7: "  thread Watch():\n    while True:\n      sync()\n    end\n  end\n  run Watch()\n" + inline,
        8: 'textmsg("it\'s # no comment", 1)\n' + named + moves + '  socket_send_string("def end")\n',
        9: named + moves + "  x = 0xFF\n  f = [1, 2, 3]\n  set_payload(1.5)\n",
    }[feature % 10]
    text = f"{note}def prog_{feature}():\n{note}  {tcp}{body}end\n"
    return {"test.script": text + (f"prog_{feature}()\n" if feature % 2 else "")}


# --- Yaskawa


def jbi(feature: int, w: Writer) -> dict[str, str]:
    """Return a job."""
    in_pulses, poses = [w.draw("joints") for _ in range(2)], [w.draw() for _ in range(3)]
    front, up, down = w.sides(poses[0])
    flags = [int(down), int(not up), int(not front), 0, 0, 0, *([0] * (18 if feature % 2 else 2))]
    note = "'f\xfcr 5 C00001 \"\n" if feature % 2 else "' MOVJ C00001\n"
    pulses = [",".join(w.mark(k, value, 0) for value in np.rad2deg(w.points[k].q) * PULSES) for k in in_pulses]
    text = "".join(f"C{n:05d}={line}\n" for n, line in enumerate(pulses))
    kind, user = ("USER", "///USER 2\n")
    cartesian = f"{user}///TOOL 3\n///POSTYPE {kind}\n///RECTAN\n///RCONF {','.join(map(str, flags))}\n"
    cartesian += "".join(f"C{n:05d}={','.join([*w.xyz(k), *w.angles(k, 'xyz')])}{',0.0' if feature % 3 == 2 else ''}\n"
                         for n, k in enumerate(poses, 2))  # fmt: skip
    external = "///POSTYPE PULSE\n///PULSE\nEC00000=0\nEC00001=15505\n" if feature % 4 == 1 else ""
    count = f"5,0,{2 if external else 0},0,0,0"
    head = f"{note if feature % 5 == 0 else ''}/JOB\n//NAME TEST{feature}\n//POS\n///NPOS {count}\n///TOOL 3\n///POSTYPE PULSE\n///PULSE\n"
    info = f"//INST\n///DATE 2026/11/24 12:00\n///COMM it's {feature}\n///ATTR SC,RW,RJ\n///GROUP1 RB1\nNOP\n"
    moves = (
        "MOVJ C00000 VJ=0.78\nMOVL C00002 V=100.0 PL=0\n"
        + note
        + "MOVL C00003 V=100.0\nMOVL C00004 V=46\nMOVJ C00001 VJ=50.00\n"
    )
    body = {
        0: moves,
        1: "*START\n" + moves + "JUMP *START IF IN#(1)=ON\n",
        2: "MOVJ C00000 VJ=10\nMOVC C00002 V=100\nMOVC C00003 V=100\nMOVC C00004 V=100\nMOVJ C00001 VJ=10\n",
        3: moves + "DOUT OT#(1) ON\nTIMER T=0.50\n",
        4: "CALL JOB:SUB-1\n" + moves + "SET B000 1\nINC B000\n",
        5: moves.replace("V=46", "V=46 +MOVJ EC00000") + "SETE P001 (3) 100\n",
        6: "MOVS C00002 V=10\nMOVS C00003 V=10\nMOVS C00004 V=10\nMOVJ C00000 VJ=1\nMOVJ C00001 VJ=1\n",
    }[feature % 7]  # fmt: skip
    return {"TEST.JBI" if feature % 2 else "test.jbi": f"{head}{text}{cartesian}{external}{info}{body}END\n"}


_FANUC_OPTIONS = ["--tool", f"3={TOOL[0]},{TOOL[1]},{TOOL[2]},0,0,0", "--base", f"2={BASE[0]},{BASE[1]},{BASE[2]},0,0,0"]
LANGUAGES: dict[str, tuple[Callable[[int, Writer], dict[str, str]], list[str]]] = {
    "KRL": (krl, KRL_OPTIONS),
    "RAPID": (rapid, []),
    "FANUC LS": (fanuc, _FANUC_OPTIONS),
    "URScript": (urscript, []),
    "JBI": (jbi, [*_FANUC_OPTIONS, "--pulses", " ".join(map(str, PULSES))]),
}
COUNT = 42


# Programs that follow each other differ in what they have; then all come again in the next encoding.
FEATURES = 14
# A third of all, chosen so that nothing that only some programs have is missing.
A_THIRD = tuple(k + FEATURES * ((k // 3 + k // 9) % 3) for k in range(FEATURES))


def cases(language: str, numbers: Iterable[int] = range(COUNT)) -> Iterator[Case]:
    """Yield programs: with LF, CRLF or both, in ASCII, Latin-1 or UTF-8 with or without a byte order mark."""
    write = LANGUAGES[language][0]
    for k in numbers:
        writer = Writer(language, k)
        files = write(k, writer)
        encoding = ("latin-1", "utf-8", "utf-8-sig")[k // FEATURES % 3] if language != "JBI" else "latin-1"
        for name, text in files.items():
            lines = text.split("\n")
            ends = {0: ["\n"], 1: ["\r\n"], 2: ["\r\n", "\n"]}[k % 3]
            joined = "".join(line + ends[i % len(ends)] for i, line in enumerate(lines[:-1])) + lines[-1]
            files[name] = joined.removesuffix("\n").removesuffix("\r") if k % 7 == 5 else joined
        if encoding == "utf-8-sig":
            files = {name: "\ufeff" + text for name, text in files.items()}
            encoding = "utf-8"
        yield Case(f"{language} {k}", language, files, encoding, writer.points)


def posture_of(q: np.ndarray) -> Posture:
    """Return the posture of joint positions, shape (6,)."""
    return Posture(*(bool(side > 0.0) for side in ARMS.sides(q[None])[0]))
