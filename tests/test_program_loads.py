"""Loads that a program states: an elastic model takes those in numbers, says so of the others, and never mixes them up."""

import numpy as np
import pytest
from program_cases import KUKA
from test_program_safety import read
from test_program_words import AXES, FRAMES, JOINTS, TCP, abb, fanuc
from test_programs import calibrated

from pincal.programs.arms import ProgramAxes
from pincal.programs.correct import Corrector, ProgramCell
from pincal.programs.language import LANGUAGES

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

AXIS = "ABCDEF"
Q = "[0.1,0.9,-1.2,0.4,0.8,-0.5]"
LOADS = "PERS loaddata heavy:=[100,[0,0,1],[1,0,0,0],0,0,0];\nPERS loaddata light:=[10,[0,0,1],[1,0,0,0],0,0,0];\n"
TWO = JOINTS + JOINTS.replace(" b:", " c:") + LOADS
MOVE = "MoveAbsJ b,v1,fine,gun"
# Programs whose second motion has a load of 100 kg in numbers, and the first one none.
HEAVY = {
    "KRL": ("KRL", f"DEF p()\n{FRAMES}PTP {AXES}\n$LOAD={{M 100,CM {{X 0,Y 0,Z 0,A 0,B 0,C 0}}}}\nPTP {AXES}\nEND\n"),
    "KRL by its number": (
        "KRL",
        f"DEF p()\nLOAD_DATA[2]={{M 100,CM {{X 0,Y 0}}}}\n{FRAMES}PTP {AXES}\n$LOAD=LOAD_DATA[2]\nPTP {AXES}\nEND\n",
    ),
    "RAPID": abb("MoveAbsJ c,v1,fine,gun;\nGripLoad heavy;\n", data=TWO, move=MOVE),
    "RAPID of the motion": abb(
        "MoveAbsJ c,v1,fine,gun;\n",
        "\\TLoad:=heavy",
        data=TWO,
        move="MoveAbsJ b,v1,fine,gun",
    ),
    "URScript": ("URScript", f"{TCP}movej({Q})\nset_payload(100, [0,0,0.1])\nmovej({Q})\n"),
    "URScript target": ("URScript", f"{TCP}movej({Q})\nset_target_payload(100, [0,0,0.1])\nmovej({Q})\n"),
}


def corrector(language: str, size: float = 4e-4, payload: float = 0.0) -> Corrector:
    """Return the corrector of an elastic robot, or of a rigid one."""
    cell = ProgramCell(axes=ProgramAxes.parse(None, KUKA), payload=payload, max_change=1.0)
    return Corrector(calibrated(size), LANGUAGES.known()[language](), cell)


@pytest.mark.parametrize("name", HEAVY)
def test_a_load_in_numbers_is_taken(name: str) -> None:
    """From its statement on: as if the payload were given, to the bit."""
    language, text = HEAVY[name]
    program = read(language, text)
    joints = {key: point for key, point in program.points.items() if point.kind == "joints"}
    with_load, without = (corrector(language, payload=mass) for mass in (100.0, 0.0))
    found = list(without.changes(program)[0].values())[-len(joints) :]
    program.loads = {}
    plain, loaded = (list(one.changes(program)[0].values())[-len(joints) :] for one in (without, with_load))

    by_name = {change.point.line: change for change in found}
    first, last = sorted(by_name, key=lambda line: by_name[line].payload)
    at = {change.point.line: (change, other) for change, other in zip(plain, loaded, strict=True)}
    assert (by_name[first].payload, by_name[last].payload) == (0.0, 100.0)
    np.testing.assert_array_equal(by_name[first].commanded, at[first][0].commanded)
    np.testing.assert_array_equal(by_name[last].commanded, at[last][1].commanded)
    assert np.abs(at[last][0].commanded - at[last][1].commanded).max() > 1e-5


def test_a_load_that_is_not_in_numbers_is_said() -> None:
    """A single one is the payload of the command; of several none is."""
    one = read(*fanuc("   2:PAYLOAD[1] ;\n", kind="joints"))
    two = read(*fanuc("   2:PAYLOAD[1] ;\n", kind="joints", before="   1:PAYLOAD[2] ;\n"))
    elastic = corrector("FANUC LS", payload=7.0)

    assert elastic.notes(one) == ["line 4 has a load (PAYLOAD[1]), whose mass is not in numbers: 7 kg is taken (--payload)"]
    assert set(elastic.payloads(one).values()) == {7.0}
    assert all("program has several" in str(found) for found in elastic.payloads(two).values())


def test_a_point_with_two_loads_is_left() -> None:
    """It can have only one position."""
    language, text = abb("GripLoad heavy;\nMoveAbsJ b,v1,fine,gun;\nGripLoad light;\n", data=JOINTS + LOADS, move=MOVE)
    changes, left = corrector(language).changes(read(language, text))

    assert all(change.point.name != "B" for change in changes.values())
    assert "motions reach it with different loads" in [one.reason for one in left]


def test_a_rigid_model_asks_for_no_load() -> None:
    """Whatever the program states."""
    program = read(*fanuc("   2:PAYLOAD[1] ;\n", kind="joints", before="   1:PAYLOAD[2] ;\n"))
    rigid = corrector("FANUC LS", size=0.0)

    assert not rigid.is_elastic and not rigid.notes(program)
    assert set(rigid.payloads(program).values()) == {0.0}


def test_a_load_of_another_routine_is_not_known() -> None:
    """A routine that is called with a load in force has it."""
    sub = "PROC sub()\nMoveAbsJ b,v1,fine,gun;\nMoveAbsJ c,v1,fine,gun;\nENDPROC\n"
    language, text = abb("GripLoad heavy;\nsub;\n", data=TWO, more=sub, move="MoveL a,v1,fine,gun")
    program = read(language, text)
    found = corrector(language).payloads(program)

    assert all(isinstance(found[key], str) for key, point in program.points.items() if point.kind == "joints")


@pytest.mark.parametrize("mass", ["-5", "1e5", "1e300", "1e308"])
def test_a_load_that_no_robot_carries_leaves_its_points(mass: str) -> None:
    """The point before it is corrected."""
    text = f"{TCP}movej({Q})\nset_payload({mass}, [0,0,0.1])\nmovej({Q})\n"
    changes, left = corrector("URScript").changes(read("URScript", text))

    assert [change.point.line for change in changes.values()] == [2]
    assert [one.reason for one in left] == [f"line 3: a load of {float(mass):g} kg; expected 0 to 10000 kg"]
