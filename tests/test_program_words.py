"""What the manuals of five controllers list of motions, offsets, frames and external axes: what displaces a point leaves it.

Each statement stands between two motions: the first one is corrected, the second one only if nothing displaces it.
"""

from functools import cache

import pytest
from program_cases import KUKA
from test_program_safety import FRAMES, TCP, P, Q, T, U, rapid, read
from test_programs import calibrated

from pincal.programs.arms import ProgramAxes
from pincal.programs.correct import Corrector, ProgramCell
from pincal.programs.language import LANGUAGES

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

TARGET = f"CONST robtarget b:={T};\n"
JOINTS = "CONST jointtarget b:=[[10,-20,15,20,30,40],[9E9,9E9,9E9,9E9,9E9,9E9]];\n"
AXES = "{A1 1,A2 2,A3 3,A4 4,A5 5,A6 6}"


def fanuc(between: str, options: str = "", before: str = "", kind: str = "pose") -> tuple[str, str]:
    """Return a listing whose positions have the user frame 0 and the tool 1."""
    numbers = "X = 1 mm, Y = 2 mm, Z = 3 mm, W = 0 deg, P = 0 deg, R = 0 deg"
    if kind == "joints":
        numbers = ", ".join(f"J{k} = {k} deg" for k in range(1, 7))
    head = "GP1:\n UF : 0, UT : 1," + (" CONFIG : 'N U T, 0, 0, 0'," if kind == "pose" else "")
    positions = "".join(f"P[{n}]{{\n {head}\n {numbers}\n}};\n" for n in (1, 2))
    lines = f"{before}   1:J P[1] 10% FINE ;\n{between}   3:L P[2] 9mm/sec FINE {options} ;\n"
    return "FANUC LS", f"/PROG A\n/MN\n{lines}/POS\n{positions}/END\n"


def jbi(between: str, options: str = "", before: str = "") -> tuple[str, str]:
    """Return a job of two positions in the robot's frame, and of its base axis."""
    head = "/JOB\n//NAME A\n//POS\n///NPOS 2,2,0,1,0,0\n///TOOL 1\n///POSTYPE ROBOT\n///RECTAN\n///RCONF 1,0,0,0,0,0,0,0\n"
    points = "".join(f"{name}=980,30,220,180,0,0\n" for name in ("C00001", "C00002", "P00009"))
    axes = "///POSTYPE PULSE\n///PULSE\nBC00001=300000\nBC00002=0\n"
    lines = f"NOP\n{before}MOVJ C00001 VJ=1\n{between}MOVL C00002 {options} V=1\nEND\n"
    return "JBI", f"{head}{points}{axes}//INST\n///GROUP1 RB1\n{lines}"


def krl(between: str, options: str = "", before: str = "", target: str = "XB", move: str = "LIN") -> tuple[str, str]:
    """Return a source with two points."""
    data = f"XA={P}\nXB={P}\nXJ={AXES}\n"
    return "KRL", f"DEF p()\n{data}{FRAMES}{before}PTP XA\n{between}{move} {target}{options}\nEND\n"


def abb(
    between: str, options: str = "", data: str = TARGET, more: str = "", move: str = "MoveL b,v1,fine,gun"
) -> tuple[str, str]:
    """Return a module with two targets."""
    return rapid(f"MoveJ a,v1,fine,gun;\n{between}{move}{options};\n", data, more)


def ur(between: str, options: str = "", move: str = "movel(b{})") -> tuple[str, str]:
    """Return a script with two poses."""
    return "URScript", f"{TCP}a={U}\nb={U}\nq={Q}\nmovej({Q})\nmovel(a)\n{between}{move.format(options)}\n"


@cache
def corrector_of(language: str, tool: str, values: str) -> Corrector:
    """Return the corrector of a cell with one tool, or with none."""
    reader = LANGUAGES.known()[language]()
    tools = {tool: reader.frame(values)} if tool else {}
    return Corrector(calibrated(0.0), reader, ProgramCell(axes=ProgramAxes.parse(None, KUKA), tools=tools))


def corrected(language: str, text: str, *, tool: str = "", values: str = "0,0,100,0,0,0") -> tuple[set[str], list[str]]:
    """Return the names of the points whose values and frames are known, and what is said of the others."""
    program = read(language, text)
    corrector = corrector_of(language, tool or {"FANUC LS": "1", "JBI": "1"}.get(language, ""), values)
    said = [f"{one.name}: {one.reason}" for one in program.skipped]
    found = set()
    for point in program.points.values():
        frames = corrector.frames(point, program) if point.kind == "pose" else ()
        if isinstance(frames, str):
            said.append(f"{point.name}: {frames}")
        else:
            found.add(point.name)
    return found, said


FIRST = {"FANUC LS": "P[1]", "JBI": "C00001", "KRL": "XA", "RAPID": "A", "URScript": "a"}
SECOND = {"FANUC LS": "P[2]", "JBI": "C00002", "KRL": "XB", "RAPID": "B", "URScript": "b"}

# Statements between the motions, or options of the second one, that displace it.
DISPLACED = {
    # FANUC, operator's manual: motion options, offset, frame, touch sensing, tracking, soft float, parameters.
    **{
        f"FANUC option {words}": fanuc("", words)
        for words in (
            "Offset,PR[1]",
            "OFFSET",
            "Tool_Offset,PR[2:x]",
            "WKZ_Offset ,PR[7]",
            "INC",
            "VOFFSET,VR[1]",
            "COORD[1]",
            "Somewhat_Offset,PR[3]",
            "\n    :  INC",
            "\n    :  Offset,PR[1]",
            "ACC100\n    :  Tool_Offset,PR[1]",
            "\n    :  ACC50\n    :  VOFFSET,VR[1]",
            "Skip,LBL[1]",
            "PTH_OFFSET",
            "RTCP",
            "Touch_Corr",
            "ACC50 Track_It",
        )
    },
    **{
        f"FANUC {words}": fanuc(f"   2:{words} ;\n")
        for words in (
            "UTOOL[1]=PR[2]",
            "UTOOL[R[1]]=PR[2]",
            "UFRAME[0]=PR[1]",
            "UFRAME[R[3]]=PR[1]",
            "Touch Offset PR[1]",
            "Touch Start PR[1],SCH[1]",
            "LINE_TRACK[1]",
            "STOP_TRACKING",
            "UTOOL[GP1:1]=PR[1]",
            "IF R[1]=1 THEN ;\n   2:UTOOL[1]=PR[1] ;\n   2:ENDIF",
            "Track TAST[1]",
            "Track AVC[2]",
            "SOFTFLOAT[1]",
            "WKZ_WECHSEL(2)",
            "MY_MACRO",
            "$MNUTOOL[1,1]=PR[1]",
            "$GROUP[1].$UFRAME=PR[1]",
            "IF (DI[1]),UTOOL[1]=PR[2]",
            "IF R[1]=1,MY_MACRO",
            "LINE[1] ON",
            "RPM Offset[1]",
            "FOLLOW UP",
        )
    },
    "FANUC a loop": fanuc("   2:UTOOL[1]=PR[2] ;\n   2:IF R[1]=1,JMP LBL[1] ;\n", before="   1:LBL[1] ;\n"),
    "FANUC joints behind a macro": fanuc("   2:MY_MACRO ;\n", kind="joints"),
    "FANUC joints with an offset": fanuc("", "Offset,PR[1]", kind="joints"),
    # Yaskawa, INFORM manual: shift, frames, tools, base axes, searches, sensors, macros.
    **{
        f"JBI {words}": jbi(f"{words}\n")
        for words in (
            "SFTON P009",
            "SFTON C00003 UF#(1)",
            "SETTOOL TL#(1) PX000",
            "SET USERFRAME 2",
            "CHGTOOL TL#(1)",
            "SMOVL C00001 V=1",
            "SETUFRAME UF#(1) PX000",
            "MFRAME UF#(1) C00003 C00004 C00005",
            "SYSTART CV#(1) STP=1",
            "PMTON",
            "MACRO1 MJ#(1) ARGF0.0",
            "COMARCON",
            "SOMETHING",
            'SKILLSND "x"',
            "FORCEON",
            "IFTHENEXP B000=1\nSFTON P009\nENDIF",
            "SFTOF\nCALL JOB:SHIFTON",
            "SFTON P009\nSFTOF IF IN#(1)=ON",
        )
    },
    **{
        f"JBI option {words}": jbi("", words)
        for words in ("BC00001", "UNTIL IN#(1)=ON", "SRCH RIN#(1)=ON T=1 DIS=5", "NEW=3")
    },
    # KUKA, system software: robot root, orientation, external axes, sensor, computed positions.
    **{
        f"KRL {words}": krl(f"{words}\n")
        for words in (
            "$ROBROOT={X 0,Y 0,Z 100,A 0,B 0,C 0}",
            "$ROBROOT.Z=100",
            "INTERRUPT DECL 3 WHEN $IN[1]==TRUE DO SUB()",
            "$ACT_BASE=3",
            "$TECH[1].MODE=#ON",
            "$BASE.X=5",
            "$ORI_TYPE=#CONSTANT",
            "$ORI_TYPE=#IGNORE",
            "$ORI_TYPE=X",
            "ASYPTP {E1 100}",
            "$ERSYSROOT={X 1,Y 0,Z 0,A 0,B 0,C 0}",
            "$TOOL.Z=5",
            "$BASE=XB",
            "XB.X=5",
            "$SOFT_CORR=1",
            "MOVE_IT XA {X 1}",
            "SHIFT()",
            "IF A THEN\n$ROBROOT.Z=1\nENDIF",
            "DECL LDAT L1={VEL 2,ORI_TYP #CONSTANT}\nLDAT_ACT=L1",
            "TRIGGER WHEN DISTANCE=0 DELAY=0 DO $ROBROOT=X",
        )
    },
    **{
        f"KRL option {words}": krl("", words)
        for words in (
            " WITH $ORI_TYPE=#CONSTANT",
            " WITH $ROBROOT=X",
            " WITH $TOOL.Z=5",
            ":{X 1,Y 0,Z 0,A 0,B 0,C 0}",
        )
    },
    "KRL E1": krl("", target="{A1 1,A2 2,A3 3,A4 4,A5 5,A6 6,E1 100}", move="PTP"),
    # ABB, RAPID instructions: program displacement, offsets of external axes, corrections, singularities, soft servo.
    **{
        f"RAPID {words}": abb(f"{words}\n")
        for words in (
            "PDispOn a,gun;",
            "PDispSet f;",
            "EOffsOn \\ExeP:=a,a;",
            "EOffsSet e;",
            "CorrCon c;",
            "gun.robhold:=FALSE;",
            "TEST x\nCASE 1:\nPDispSet f;\nENDTEST",
            "SingArea \\Wrist;",
            "SingArea \\LockAxis4;",
            "SoftAct 1,20;",
            "CSSAct \\X;",
            "SetDataVal s,x;",
            "WaitWObj wobj_on_cnv1;",
            "SyncMoveOn s1,t;",
            "EGMActMove id;",
            "FCAct gun;",
            "gun.tframe.trans.z:=5;",
            "gun:=other;",
            "MToolTCPCalib j,j,j,j,gun,e,m;",
            "up gun;",
            "upper gun.tframe.trans.z;",
            "IF x PDispSet f;",
            "PDispOff;\nsetup;",
            "d.trans.x:=5;\nPDispOff;\nsetup;",
        )
    },
    **{f"RAPID option {words}": abb("", words) for words in ("\\Corr", "\\Track:=tr", "\\Somewhat", "\\WObj:=unknown")},
    **{
        f"RAPID {mode} {kind}": abb(
            f"up {given};\n",
            "\\WObj:=table",
            f"PERS robtarget b:={T};\n",
            f"PROC up({mode} {kind} x)\nx{part}:=y;\nENDPROC\n",
        )
        for mode in ("INOUT", "PERS", "VAR", "REF")
        for kind, given, part in (
            ("pos", "b.trans", ".x"),
            ("num", "gun.tframe.trans.z", ""),
            ("pose", "table.uframe", ""),
            ("robtarget", "b", ".trans.x"),
            ("wobjdata", "table", ".uframe"),
        )
    },
    "RAPID a function changes it": abb(
        "IF f(gun) THEN\nENDIF\n", more="FUNC bool f(PERS tooldata x)\nx.tframe.trans.z:=1;\nRETURN TRUE;\nENDFUNC\n"
    ),
    "RAPID a routine passes it on": abb("up gun;\n", more="PROC up(PERS tooldata x)\nother x;\nENDPROC\n"),
    "RAPID a track": abb("", data="CONST robtarget b:=" + T.replace("[9E9,", "[1500,") + ";\n"),
    "RAPID a track of joints": abb("", data=JOINTS.replace("[9E9,", "[1500,"), move="MoveAbsJ b,v1,fine,gun"),
    "RAPID soft joints": abb("SoftAct 1,20;\n", data=JOINTS, move="MoveAbsJ b,v1,fine,gun"),
    # Universal Robots, script manual: path offset, conveyor, force, circles of fixed orientation, tools.
    **{
        f"URScript {words}": ur(f"{words}\n")
        for words in (
            "path_offset_enable()",
            "track_conveyor_linear(x,1)",
            "track_conveyor_circular(x,1,True)",
            "force_mode(a,b,c,2,d)",
            "set_tcp(x)",
            "something()",
            "x = something(1)",
            "rg_grip(10, 20)",
            "b[0] = 0.5",
            "b = pose_trans(a,b)",
            "freedrive_mode()",
            "if x:\n path_offset_enable()\nend",
        )
    },
    "URScript movec mode=1": ur("", ",mode=1", "movec(a,b{})"),
    "URScript movec 1": ur("", ",1.2,0.25,0,1", "movec(a,b{})"),
    "URScript movec mode=x": ur("", ",mode=x", "movec(a,b{})"),
}

# Statements and options of the same chapters that displace nothing.
KEPT = {
    **{
        f"FANUC option {words}": fanuc("", words)
        for words in (
            "",
            "ACC50",
            "CNT50 ACC100",
            "CNT R[2]",
            "Wjnt",
            "Mrot",
            "PTH",
            "RT_LD20",
            "AP_LD10",
            "BREAK",
            "EV50%",
            "Ind.EV50%",
            "DB 10mm,DO[1]=ON",
            "TB .50sec,CALL OPEN(1)",
            "TA .10sec,DO[2:x]=OFF",
            "SPOT[P=1,S=2]",
            "Arc Start[1]",
            "\n    :  Arc Start[1]",
            "\n    :  ACC50",
            "Arc End[1]",
            "CR10",
            "PSPD110",
            "TB 0.00sec,P-SPS",
            "SS[1]",
            "Weave Sine[2]",
        )
    },
    **{
        f"FANUC {words}": fanuc(f"   2:{words} ;\n")
        for words in (
            "R[1]=R[2]+1",
            "PR[1]=LPOS",
            "PR[2]=P[2]",
            "PR[1,3:z]=(PR[1,3]+5)",
            "DO[1:gripper]=ON",
            "RO[2]=PULSE,0.5sec",
            "GO[1]=5",
            "AO[1]=R[3]",
            "F[1]=(DI[1] AND !DI[2])",
            "WAIT DI[1]=ON",
            "WAIT .30(sec)",
            "WAIT DI[1]=ON,TIMEOUT,LBL[9]",
            "UFRAME_NUM=0",
            "UTOOL_NUM=1",
            "UTOOL_NUM=R[5]",
            "BENUTZER_NUM=0",
            "WKZ_NUM=1",
            "LBL[9:end]",
            "CALL FERM_PINCE",
            "CALL PICK(1,R[2])",
            "RUN WATCH",
            "IF R[1]=1,JMP LBL[9]",
            "IF DI[1]=ON,CALL X",
            "IF (R[1]=1 AND DI[2]),R[3]=(2)",
            "IF (DI[1]) THEN",
            "ELSE",
            "ENDIF",
            "FOR R[1]=1 TO 10",
            "ENDFOR",
            "SELECT R[1]=1,CALL A",
            "       ELSE,JMP LBL[9]",
            "PAYLOAD[1]",
            "OVERRIDE=50%",
            "TIMER[1]=START",
            "UALM[3]",
            "MESSAGE[it's]",
            "RSR[1]=ENABLE",
            "!L P[2] Offset",
            "--eg: INC",
            "// UTOOL[1]=PR[1]",
            "SKIP CONDITION DI[1]=ON",
            "OFFSET CONDITION PR[1]",
            "TOOL_OFFSET CONDITION PR[2]",
            "COL DETECT ON",
            "COL GUARD ADJUST 50",
            "PAUSE",
            "JOINT_MAX_SPEED[1]=100",
            "LINEAR_MAX_SPEED=500",
            "Arc Start[1]",
            "Arc End[1,R[1]]",
            "Weave Sine[1]",
            "Weave End",
            "$WAITTMOUT=200",
            "$MCR.$GENOVERRIDE=50",
            "LOCK PREG",
            "UNLOCK PREG",
            "VISION RUN_FIND 'A'",
            "MONITOR X",
            "MONITOR END X",
            "SR[1]='a b'",
            "HAND OPEN 1",
            "Touch Offset PR[1] ;\n   2:Touch Offset End",
            "Track TAST[1] ;\n   2:Track End",
            "SOFTFLOAT[1] ;\n   2:SOFTFLOAT END",
            "UTOOL[2]=PR[1]",
            "UFRAME[3]=PR[1]",
        )
    },
    "FANUC joints behind a tool": fanuc("   2:UTOOL[1]=PR[2] ;\n", kind="joints"),
    **{
        f"JBI {words}": jbi(f"{words}\n")
        for words in (
            "DOUT OT#(1) ON",
            "TIMER T=0.50",
            "WAIT IN#(1)=ON T=10.00",
            "SET B000 1",
            "INC B000",
            "ADD I000 5",
            "SETE P009 (3) 100",
            "JUMP *END IF IN#(1)=ON\n*END",
            "CALL JOB:SUB-1",
            "CALL JOB:SUB ARGF1",
            "IFTHENEXP B000=1\nDOUT OT#(2) ON\nELSE\nTIMER T=1\nENDIF",
            "WHILEEXP B000<5\nINC B000\nENDWHILE",
            "FOR I000 = 1 TO 5\nNEXT I000",
            "SWITCH B000 CASE 1\nCASE 2\nDEFAULT\nENDSWITCH",
            "ARCON ASF#(1)",
            "ARCON AC=200 AVP=100 T=0.3",
            "ARCOF",
            "WVON WEV#(1)",
            "WVOF",
            "AOUT AO#(1) 5.0",
            "PULSE OT#(1) T=1",
            "DIN B001 IN#(1)",
            'MSG "it\'s = here"',
            "PAUSE",
            "'SFTON P009",
            "SFTOF",
            "SFTON P009\nSFTOF",
            "GETS B000 $B002",
            "REFP 1 C00001",
            "HAND 1 ON",
            "SPEED VJ=50",
            "SHCKSET SSL1",
            "MSHIFT P009 PX001 PX002",
            "CNVRT PX000 PX001 BF",
            "SVSPOT GUN#(1) PRESS#(1) WTM=1 WST=1",
            "ADVINIT",
            "RET IF IN#(1)=ON",
            "MUL D000 2",
        )
    },
    **{
        f"JBI option {words}": jbi("", words)
        for words in ("PL=0", "CR=5.0", "ACC=50 DEC=50", "NWAIT", "BC00002", "FPT", "+MOVJ EC00001")
    },
    **{
        f"KRL {words}": krl(f"{words}\n")
        for words in (
            "$VEL.CP=2",
            "$ACC.ORI1=100",
            "$APO.CDIS=5",
            "$OV_PRO=50",
            "$ADVANCE=3",
            "$OUT[1]=TRUE",
            "$ANOUT[2]=0.5",
            "$TIMER[1]=0",
            "$TIMER_STOP[1]=FALSE",
            "$FLAG[3]=TRUE",
            "$CYCFLAG[1]=$IN[2]",
            "$BWDSTART=FALSE",
            "$ORI_TYPE=#VAR",
            "$ORI_TYPE=#JOINT",
            "$CIRC_TYPE=#BASE",
            "$IPO_MODE=#BASE",
            "$VEL_AXIS[1]=50",
            "WAIT SEC 0.5",
            "WAIT FOR $IN[1]",
            "HALT",
            "CONTINUE",
            "I=I+1",
            "PULSE($OUT[1],TRUE,0.5)",
            "INTERRUPT ON 3",
            "BRAKE",
            "TRIGGER WHEN DISTANCE=0 DELAY=0 DO $OUT[5]=TRUE",
            "IF $IN[1]==TRUE THEN\nI=1\nELSE\nI=2\nENDIF",
            "FOR I=1 TO 3 STEP 1\nENDFOR",
            "LOOP\nEXIT\nENDLOOP",
            "REPEAT\nUNTIL $IN[2]",
            "SWITCH I\nCASE 1\nDEFAULT\nENDSWITCH",
            "BAS(#VEL_CP,2)",
            "BAS(#INITMOV,0)\n" + FRAMES,
            "ANOUT ON X=1.0*Y",
            "SIGNAL S $OUT[1]",
            "$ORI_TYPE=#CONSTANT\n$ORI_TYPE=#VAR",
            "X=SIN(Y)",
            "IMPORT INT X IS /R1/A..X",
            "$LOAD={M 5,CM {X 0,Y 0,Z 0,A 0,B 0,C 0},J {X 0,Y 0,Z 0}}",
            "STRCLEAR(S[])",
        )
    },
    **{
        f"KRL option {words}": krl("", words)
        for words in (" C_DIS", " C_VEL", " C_ORI C_DIS", " WITH $VEL.CP=1", " WITH $ORI_TYPE=#VAR", " WITH $APO.CDIS=5")
    },
    "KRL constant orientation of joints": krl("$ORI_TYPE=#CONSTANT\n", move="PTP"),
    **{
        f"RAPID {words}": abb(f"{words}\n")
        for words in (
            "SetDO do1,1;",
            "SetSysData gun;",
            "GripLoad load0;",
            "Set do1;",
            "Reset do1;",
            "SetGO go1,5;",
            "PulseDO do1;",
            "WaitTime 0.5;",
            "WaitDI di1,1;",
            "WaitUntil di1=1;",
            'TPWrite "x";',
            "TPErase;",
            "ConfL\\Off;",
            "ConfJ\\Off;",
            "ConfL\\On;",
            "AccSet 50,50;",
            "VelSet 50,500;",
            "MotionSup\\Off;",
            "PathResol 150;",
            "SingArea \\Off;",
            "CirPathMode \\PathFrame;",
            "count:=count+1;",
            "IF di1=1 THEN\nStop;\nENDIF",
            "WHILE count<3 DO\nIncr count;\nENDWHILE",
            "FOR i FROM 1 TO 3 DO\nENDFOR",
            "TEST n\nCASE 1:\nDEFAULT:\nENDTEST",
            "ClkStart c;",
            "ClkStop c;",
            "Open s,f;",
            'Write f,"x";',
            "Close f;",
            "PDispOff;",
            "PDispSet f;\nPDispOff;",
            "EOffsOff;",
            "SoftDeact;",
            "setup;",
            "GOTO l;\nl:",
            "t:=CRobT();",
            "x:=Offs(a,0,0,10);",
            "up count;",
            "StopMove;",
            "StartMove;",
            "TriggIO t,5\\DOp:=do1,1;",
            "SyncMoveOff s;",
        )
    },
    **{f"RAPID option {words}": abb("", words) for words in ("\\WObj:=table", "\\ID:=10", "\\Conc", "\\TLoad:=l1")},
    "RAPID a copy": abb("up gun.tframe.trans.z;\n", more="PROC up(num x)\nx:=5;\nENDPROC\n"),
    "RAPID a routine that only moves": abb("up b;\n", more="PROC up(PERS robtarget x)\nMoveL x,v1,fine,gun;\nENDPROC\n"),
    "RAPID displaced poses, not joints": abb(
        "PDispSet f;\n", data=JOINTS, move="MoveAbsJ b\\NoEOffs,v1,fine,gun;\nPDispOff"
    ),
    **{
        f"URScript {words}": ur(f"{words}\n")
        for words in (
            "set_digital_out(1,True)",
            "sleep(0.5)",
            "sync()",
            'textmsg("x")',
            'popup("x")',
            "x = get_digital_in(1)",
            "set_payload(1.5)",
            "set_payload(1.5,[0,0,0.1])",
            "set_analog_out(0,0.5)",
            "x = pose_trans(a,p[0,0,0.1,0,0,0])",
            "x = get_actual_tcp_pose()",
            "i = i + 1",
            "while i < 3:\n i = i + 1\nend",
            "halt",
            "if x == 1:\n i = 2\nelse:\n i = 3\nend",
            'socket_send_string("x")',
            "x = d2r(90)",
            "path_offset_enable()\npath_offset_disable()",
            "stopl(1)",
            "set_tool_voltage(24)",
            "force_mode(a,b,c,2,d)\nend_force_mode()",
            "write_output_integer_register(0,1)",
            "zero_ftsensor()",
            "set_gravity([0,0,9.82])",
            "x = norm(a)",
            "def f(k):\n return k+1\nend\nx = f(1)",
            "stop_conveyor_tracking()",
            "set_standard_digital_out(1,False)",
        )
    },
    **{
        f"URScript option {words}": ur("", words)
        for words in (",a=1.2,v=0.25", ",1.2,0.25", ",r=0.01", ",a=1.2,v=0.25,t=0,r=0")
    },
    "URScript movec mode=0": ur("", ",mode=0", "movec(a,b{})"),
    "URScript movec": ur("", ",1.2,0.25", "movec(a,b{})"),
}


def test_what_displaces_a_point_leaves_it() -> None:
    """And the one before it is corrected; the reason is said."""
    wrong = {}
    for name, (language, text) in DISPLACED.items():
        found, said = corrected(language, text)
        if SECOND[language] in found or not said:
            wrong[name] = sorted(found)

    assert not wrong


def test_what_displaces_nothing_leaves_the_correction() -> None:
    """Of the points behind such statements all are corrected."""
    wrong = {}
    for name, (language, text) in KEPT.items():
        found, said = corrected(language, text)
        if not {FIRST[language], SECOND[language]} <= found:
            wrong[name] = said

    assert not wrong


def test_a_point_before_what_displaces_others_is_corrected() -> None:
    """Unless a loop leads back to it, or the program starts again displaced."""
    kept = 0
    cases = [(language, text) for language, text in DISPLACED.values() if language in ("FANUC LS", "URScript")]
    for language, text in cases:
        kept += FIRST[language] in corrected(language, text)[0]

    assert kept >= 0.9 * len(cases)
