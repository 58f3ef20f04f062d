"""What a program may not be: too deep, too long, of numbers that are no pose. It is refused, or the point left."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from program_cases import KUKA
from test_program_safety import FRAMES, TCP, P, U, rapid, read
from test_programs import calibrated, run

from pincal.errors import BadInputError, ProgramError
from pincal.programs import draft, syntax
from pincal.programs.arms import ProgramAxes
from pincal.programs.correct import Corrector, ProgramCell
from pincal.programs.language import LANGUAGES

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

DEEP = {
    "KRL": "DEF a()\nX={}1{}\nEND\n",
    "RAPID": "MODULE m\nPROC main()\nx:={}1{};\nENDPROC\nENDMODULE\n",
    "URScript": "def a():\n  x={}1{}\nend\n",
}


@pytest.mark.parametrize("language", DEEP)
def test_brackets_within_many_others_are_refused(language: str) -> None:
    """With the line; a hundred are read."""
    read(language, DEEP[language].format("(" * 100, ")" * 100))
    with pytest.raises(ProgramError, match=r"line \d, column \d+: brackets within 100 others"):
        read(language, DEEP[language].format("(" * 1000, ")" * 1000))


def test_blocks_within_many_others_are_refused() -> None:
    """With the line."""
    with pytest.raises(ProgramError, match=r"line \d+, column 1: a block within 100 others"):
        read("URScript", "def a():\n" + "while x:\n" * 1000 + "end\n" * 1000 + "end\n")


def test_a_program_is_limited_by_the_work_that_it_makes(monkeypatch: pytest.MonkeyPatch) -> None:
    """By its words, numbers and signs, which are counted before they are read."""
    monkeypatch.setattr(syntax, "MOST_WORDS", 2000)
    with pytest.raises(ProgramError, match="8006 words, numbers and signs; expected a program of at most 2000"):
        read("URScript", "def a():\n" + "x=1+2\n" * 1600 + "end\n")


def listing(lines: str, positions: str = "") -> str:
    return f"/PROG A\n/MN\n{lines}/POS\n{positions}/END\n"


def parameters(count: int) -> str:
    """Return a routine of many parameters, all of which each of its motions may mean."""
    names = ",".join(f"P{k}:IN" for k in range(count))
    return f"DEF a({names})\n" + "LIN XP\n" * count + "END\n"


def positions(count: int) -> str:
    return "".join(f"P[{k}]{{\nGP1:\nUF:0,UT:1,\nJ1=1 deg\n}};\n" for k in range(count))


# Programs of which each part might be compared with each other one.
GROWING: dict[str, tuple[str, Callable[[int], str]]] = {
    "a chain of routines": (
        "URScript",
        lambda n: "".join(f"def r{k}():\n r{k + 1}()\nend\n" for k in range(n)) + f"{TCP}r0()\nmovel({U})\n",
    ),
    "computed jumps": (
        "FANUC LS",
        lambda n: listing("".join(f"1:LBL[{k}] ;\n1:JMP LBL[R[1]] ;\n" for k in range(n)) + "1:MY_MACRO ;\n"),
    ),
    "one label everywhere": ("FANUC LS", lambda n: listing("1:LBL[1] ;\n1:JMP LBL[1] ;\n" * n + "1:MY_MACRO ;\n")),
    "continuation lines": ("FANUC LS", lambda n: listing("1:J P[1] 1% FINE\n" + ":ACC50\n" * n)),
    "positions in one line": ("FANUC LS", lambda n: listing("1:X=" + "P[1] " * 4 * n + ";\n")),
    "computed positions": ("FANUC LS", lambda n: listing("1:J P[R[1]] 1% FINE ;\n" * n + "1:M ;\n", positions(n))),
    "parameters": ("KRL", parameters),
    "conditions in one statement": ("RAPID", lambda n: rapid("IF x THEN " + "ELSEIF x THEN " * 2 * n + "ENDIF\n")[1]),
    "circles": (
        "JBI",
        lambda n: "/JOB\n//NAME A\n//POS\n///POSTYPE PULSE\nC0=1,2,3,4,5,6\n//INST\n" + "MOVC C0 V=1\n" * n + "END\n",
    ),
}


@pytest.mark.parametrize("kind", GROWING)
def test_reading_takes_time_in_proportion(kind: str) -> None:
    """Four times as much takes four times as long, not sixteen times."""
    language, text = GROWING[kind]

    def seconds(count: int) -> float:
        content = text(count)
        started = time.process_time()
        read(language, content)
        return time.process_time() - started

    seconds(50)
    assert seconds(1000) < 10.0 * max(seconds(250), 0.03)


def test_frames_that_change_everywhere_are_refused() -> None:
    """Before the states of all lines are followed; ten tools that change are no matter."""
    read("FANUC LS", listing("".join(f"1:UTOOL[{k % 10}]=PR[1] ;\n" for k in range(2000))))
    with pytest.raises(ProgramError, match="2000 frames that change on 2000 lines; expected"):
        read("FANUC LS", listing("".join(f"1:UTOOL[{k}]=PR[1] ;\n" for k in range(2000))))


def test_computed_indices_are_limited_by_their_uses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each motion to a computed element uses all of its array."""
    monkeypatch.setattr(draft, "MOST_USES", 99)
    text = "DEF p()\n" + FRAMES + "".join(f"P[{k}]={P}\n" for k in range(10)) + "LIN P[I]\n" * 10 + "END\n"
    with pytest.raises(ProgramError, match="more than 99 uses of points by motions"):
        read("KRL", text)


@pytest.mark.parametrize(
    "pose",
    [
        "p[0.5,0.1,0.5,1e200,1e200,0]",
        "p[1e200,0.1,0.5,0,3.1,0]",
        "p[1e308,1e308,0,0,0,0]",
        "p[0.5,0,0.5,2e5,0,0]",
        "p[2e4,0,0,0,0,0]",
    ],
)
def test_numbers_that_are_no_pose_are_left(pose: str) -> None:
    """As points, as tools, and as values of options."""
    language = LANGUAGES.known()["URScript"]()
    corrector = Corrector(calibrated(0.0), language, ProgramCell(axes=ProgramAxes.parse(None, KUKA)))
    program = read("URScript", f"{TCP}movel({pose})\n")
    tool = read("URScript", f"set_tcp({pose})\nmovel({U})\n")

    with np.errstate(all="raise"):
        assert "its numbers are no pose" in corrector.changes(program)[1][0].reason
        assert "line 1 sets what is no pose" in corrector.changes(tool)[1][0].reason
    with pytest.raises(BadInputError, match="is not a frame in URScript"):
        language.frame(pose[2:-1])


def test_joints_of_any_size_are_no_positions() -> None:
    """Whether the limits of the joints are ignored or not."""
    cell = ProgramCell(axes=ProgramAxes.parse(None, KUKA), limits=False)
    text = f"DEF p()\n{FRAMES}PTP {{A1 1e300,A2 2,A3 3,A4 4,A5 5,A6 6}}\nEND\n"
    _, left = Corrector(calibrated(0.0), LANGUAGES.known()["KRL"](), cell).changes(read("KRL", text))

    assert [one.reason for one in left] == ["its numbers are no joint positions"]


def test_a_program_without_a_point_is_undecided(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 4, as the page says; and a negative payload is refused."""
    calibrated(0.0).save(tmp_path / "model.json")
    (tmp_path / "p.src").write_text("DEF p()\nI=1\nEND\n")
    words = [tmp_path / "model.json", tmp_path / "p.src", "--out", tmp_path / "out" / "p.src"]

    assert run(*words) == 4
    assert "KRL: 0 points corrected, 0 left unchanged" in capsys.readouterr().out
    assert run(*words, "--payload", "-5000") == 2
    assert "'-5000'; expected a number from 0" in capsys.readouterr().err


def test_a_correction_is_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Where its tool and base are from, and what reaches it; without the option nothing is added."""
    calibrated(0.0).save(tmp_path / "model.json")
    axes = "{A1 20,A2 60,A3 -80,A4 25,A5 50,A6 -30}"
    (tmp_path / "p.src").write_text(f"DEF p()\nXJ={axes}\nPTP XJ\nPTP XJ\nEND\n")
    words = [tmp_path / "model.json", tmp_path / "p.src", "--out", tmp_path / "out" / "p.src"]

    assert run(*words) == 0
    said = capsys.readouterr().out
    assert "KRL: 1 point corrected, 0 left unchanged" in said and "understood" not in said
    assert run(*words, "--explain") == 0
    assert (
        "in numbers, which nothing else sets; in joints, so that it needs no tool and no base; reached on line 3, 4, "
        "before which all is understood and nothing displaces it; load 0 kg" in capsys.readouterr().out
    )


@pytest.mark.parametrize("language", LANGUAGES.known())
def test_every_word_has_its_manual(language: str) -> None:
    """And stands once among those of its kind."""
    tables = LANGUAGES.known()[language].understood
    words = [(table.kind, word.strip()) for table in tables for word in table.words.split(",")]

    assert tables and all(table.source for table in tables)
    assert len(set(words)) == len(words), sorted(word for word in set(words) if words.count(word) > 1)
