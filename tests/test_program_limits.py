"""What a program may not be: too deep, too long, of numbers that are no pose. It is refused, or the point left."""

import time
from pathlib import Path

import numpy as np
import pytest
from program_cases import KUKA
from test_program_safety import FRAMES, TCP, Q, U, read
from test_programs import calibrated, run

from pincal.errors import BadInputError, ProgramError
from pincal.programs import syntax
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


def test_a_chain_of_routines_takes_time_in_proportion() -> None:
    """Each calls the next one."""

    def seconds(count: int) -> float:
        routines = "".join(f"def r{k}():\n r{k + 1}()\nend\n" for k in range(count))
        started = time.process_time()
        read("URScript", f"{routines}{TCP}movej({Q})\nr0()\nmovel({U})\n")
        return time.process_time() - started

    seconds(50)
    assert seconds(1000) < 10.0 * max(seconds(250), 0.05)


def test_computed_jumps_take_time_in_proportion() -> None:
    """Each may lead to every label."""

    def seconds(count: int) -> float:
        lines = "".join(f"   1:LBL[{k}] ;\n   1:JMP LBL[R[1]] ;\n" for k in range(count))
        started = time.process_time()
        read("FANUC LS", f"/PROG A\n/MN\n{lines}   1:MY_MACRO ;\n/POS\n/END\n")
        return time.process_time() - started

    seconds(50)
    assert seconds(1000) < 10.0 * max(seconds(250), 0.05)


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
    assert run(*words, "--payload", "-5000") == 2
    assert "'-5000'; expected a number from 0" in capsys.readouterr().err


def test_a_correction_is_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Where its tool and base are from, and what reaches it; without the option nothing is added."""
    calibrated(0.0).save(tmp_path / "model.json")
    axes = "{A1 20,A2 60,A3 -80,A4 25,A5 50,A6 -30}"
    (tmp_path / "p.src").write_text(f"DEF p()\nXJ={axes}\nPTP XJ\nPTP XJ\nEND\n")
    words = [tmp_path / "model.json", tmp_path / "p.src", "--out", tmp_path / "out" / "p.src"]

    assert run(*words) == 0 and "understood" not in capsys.readouterr().out
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
