"""Programs of controllers in the page, in a real browser: the same files as the command writes, byte for byte."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import page_script
import pytest
from program_cases import COUNT, LANGUAGES, cases
from python_to_js import Translator
from test_corrector import ROOMS as PAGE_ROOMS
from test_corrector import answered
from test_program_safety import CASES as UNSAFE
from test_programs import calibrated, mutated, run
from trees import parsed

import pincal.programs
from pincal.export import export_model
from pincal.programs.krl import Krl

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

ROOMS = pytest.mark.rooms(*PAGE_ROOMS.args, "tests/program_cases.py")
# A program: its files by their names, and the options of the command.
Job = tuple[dict[str, bytes], list[str]]
# Mutated programs of each language.
BROKEN = 20


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return the file of a robot that errs by a millimetre, and its page."""
    path = tmp_path_factory.mktemp("model") / "model.json"
    robot = calibrated(4e-4)
    robot.save(path)
    return path, export_model(robot, "page", frame="base").text


def entered(options: list[str]) -> dict[str, Any]:
    """Return options of the command as they are entered in the page."""
    found: dict[str, Any] = {"tool": {}, "base": {}}
    for option, value in zip(options[::2], options[1::2], strict=True):
        name, _, numbers = value.partition("=")
        if option == "--pulses":
            found["pulses"] = value
        elif option == "--seed-joints":
            found["seed"] = list(map(float, value.split()))
        else:
            found[option.removeprefix("--")][name] = numbers
    return found


def by_page(page: str, jobs: list[Job], folder: Path) -> list[Any]:
    """Return what the page makes of programs: its files and the numbers of points corrected and left, or its refusal."""
    given = []
    for files, options in jobs:
        texts = [{"name": name, "text": text.decode("latin-1")} for name, text in files.items()]
        given.append({"files": texts, "said": entered(options)})
    text = json.dumps(given).replace("<", "\\u003c")
    code = (
        f"return {text}.map(({{ files, said }}) => {{ try {{"
        "const at = { payload: 0, temperature: 0, time: 0, target: 0 };"
        "const r = correctPrograms(languageOf(files[0].name), files, at, said);"
        "return [r.files, r.rows.filter((row) => row.status === 'ok').length, r.left.map((one) => one.reason)]; }"
        "catch (error) { return error instanceof Refused ? error.message : `CRASH ${error.stack}`; } });"
    )
    return list(answered(page, code, folder))


def by_command(model: Path, job: Job, folder: Path, capsys: Any) -> tuple[dict[str, bytes], int, int] | str:
    """Return what the command makes of a program, or its refusal."""
    files, options = job
    (folder / "out").mkdir(parents=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    first = next(iter(files))
    capsys.readouterr()
    code = run(model, folder / first, "--out", folder / "out" / first, *options, "--json", "--quiet")
    captured = capsys.readouterr()
    if code == 3:
        return str(captured.err)
    result = json.loads(captured.out)
    written = {name: (folder / "out" / name).read_bytes() for name in files}
    return written, len(result["points"]), len(result["left"])


def jobs_of(language: str, count: int, broken: int, rng: np.random.Generator) -> list[Job]:
    """Return programs as they should be, and mutated ones."""
    sound = [({file: case.content(file) for file in case.files}, LANGUAGES[language][1]) for case in cases(language)]
    others = [next(cases(name)) for name in LANGUAGES if name != language]
    jobs = sound[:count]
    for k in range(broken):
        files, options = sound[k % COUNT]
        name = sorted(files)[int(rng.integers(len(files)))]
        other = others[k % len(others)]
        jobs.append((files | {name: mutated(files[name], other.content(next(iter(other.files))), rng)}, options))
    return jobs


def compared(jobs: list[Job], made: tuple[Path, str], folder: Path, capsys: Any) -> tuple[int, int]:
    """Compare page and command; return how many programs both corrected, and how many both refused."""
    corrected = refused = 0
    for k, (job, found) in enumerate(zip(jobs, by_page(made[1], jobs, folder), strict=True)):
        expected = by_command(made[0], job, folder / str(k), capsys)
        if isinstance(expected, str):
            assert isinstance(found, str) and "CRASH" not in found, (k, expected, found)
            refused += 1
            continue
        assert not isinstance(found, str), (k, found)
        files, points, left = found
        assert {one["name"]: one["text"].encode("latin-1") for one in files} == expected[0], k
        assert (points, len(left)) == expected[1:], (k, left)
        corrected += 1
    return corrected, refused


@pytest.mark.long
@ROOMS
@pytest.mark.parametrize("count", [COUNT // 6, pytest.param(COUNT, marks=pytest.mark.rates)])
@pytest.mark.parametrize("language", LANGUAGES)
def test_the_page_writes_what_the_command_writes(
    language: str, count: int, made: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of sound programs and of mutated ones, and refuses what the command refuses."""
    jobs = jobs_of(language, count, BROKEN * count // COUNT, np.random.default_rng(4))
    corrected, refused = compared(jobs, made, tmp_path, capsys)

    assert corrected >= count
    with capsys.disabled():
        print(f"\n{language}: {corrected} programs equal byte for byte, {refused} refused by both")


@pytest.mark.long
@ROOMS
def test_the_page_leaves_what_the_command_leaves(
    made: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Points whose value, tool or base a program may set elsewhere."""
    suffixes = {"KRL": "src", "RAPID": "mod", "FANUC LS": "ls", "URScript": "script", "JBI": "jbi"}
    jobs = [({f"p.{suffixes[language]}": text.encode()}, list[str]()) for (language, text), _, _ in UNSAFE.values()]

    assert compared(jobs, made, tmp_path, capsys) == (len(UNSAFE), 0)


@pytest.mark.long
@ROOMS
def test_files_are_dropped_and_what_is_missing_is_asked_for(made: tuple[Path, str], tmp_path: Path) -> None:
    """A source with its data: the tool that they do not say is entered below, and each file has its button."""
    case = next(case for case in cases("KRL", range(8)) if len(case.files) == 2 and "BAS(#TOOL,3)" in case.files["test.src"])
    files = json.dumps([[name, case.content(name).decode("latin-1")] for name in case.files]).replace("<", "\\u003c")
    code = (
        f"const given = {files}.map(([name, text]) => new File([Uint8Array.from(text, (c) => c.charCodeAt(0))], name));"
        "await take(given); const labels = () => [...$('asked').querySelectorAll('label')].map((x) => x.firstChild.data);"
        "const words = () => [$('summary').textContent, labels()], before = words();"
        "const enter = (k, text) => { const box = $('asked').querySelectorAll('input')[k];"
        " box.value = text; box.onchange(); };"
        "enter(0, '12.5,-30,210.25,0,0,0'); enter(1, '400,-150,75.5,0,0,0');"
        "return [before, words(), [...$('saves').children].map((x) => [x.textContent, x.disabled]), $('notes').textContent,"
        " [...$('rows').tHead.querySelectorAll('th')].slice(0, 4).map((x) => x.textContent)];"
    )
    before, after, buttons, notes, head = answered(made[1], code, tmp_path)

    assert "1 of 5 points corrected" in before[0] and before[1] == ["Tool TOOL_DATA[3]", "Base BASE_DATA[2]"]
    assert "5 of 5 points corrected" in after[0]
    assert buttons == [["Save test.src", False], ["Save test.dat", False]]
    assert "between corrected points lines and circles are not checked" in notes
    assert head == ["line", "point", "moved bymm", "moved bymrad"]


def test_no_class_of_the_readers_has_the_name_of_another() -> None:
    """The translation knows the fields of a class by its name: those of a namesake would silently be taken for them."""
    trees = [parsed(path.read_text("utf-8")) for path in sorted(Path(pincal.programs.__path__[0]).glob("*.py"))]
    names = [node.name for tree in trees for node in tree.body if isinstance(node, ast.ClassDef)]

    assert len(set(names)) == len(names) > 20


def test_what_is_not_translated_is_refused_with_its_line() -> None:
    """When the script is made, not in the page."""
    with pytest.raises(NotImplementedError, match=r"line 2: with open"):
        Translator().translate({"a": "def f():\n    with open('x') as file:\n        pass\n"})
    with pytest.raises(NotImplementedError, match="two classes are named _Reader"):
        Translator().translate({name: "class _Reader:\n    pass\n" for name in ("a", "b")})


def test_a_grammar_is_numbered_in_the_order_in_which_it_is_read() -> None:
    """States and rules: the parser's own numbers follow the order of sets, which differs between processes."""
    states = json.loads(page_script.grammar_table(Krl.grammars[0]))["states"]
    actions = [action for state in states for action in state["actions"].values()]
    shifts, rules = ([*dict.fromkeys(at for kind, at in actions if kind == wanted)] for wanted in (0, 1))

    assert all([*state["actions"]] == sorted(state["actions"]) for state in states)
    assert shifts == [*range(1, len(states))] and rules == [*range(len(rules))]


def test_the_page_has_the_readers_of_the_command() -> None:
    """Else make them anew: python tools/page_script.py."""
    assert page_script.SCRIPT.read_text("utf-8") == page_script.script()


@pytest.mark.long
def test_processes_write_the_same_page() -> None:
    """Whatever the order of their sets."""
    code = "from page_script import programs_in_js; print(programs_in_js())"
    tools = str(Path(page_script.__file__).parent)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([tools, os.environ.get("PYTHONPATH", "")])}
    runs = [
        subprocess.run([sys.executable, "-c", code], env=environment | {"PYTHONHASHSEED": seed}, stdout=-1, check=True)
        for seed in "12"
    ]

    assert runs[0].stdout == runs[1].stdout
