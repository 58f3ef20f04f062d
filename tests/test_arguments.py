"""Typed arguments: the command line fills a frozen dataclass, and the help text says what each option is and defaults to."""

import json
import math
from dataclasses import MISSING, FrozenInstanceError, dataclass
from pathlib import Path
from typing import Any, Literal

import click
import numpy as np
import pytest
from command_line import run
from test_cli import URDF, columns, results  # noqa: F401

from pincal.cli import pincal
from pincal.cli.arguments import NumberType, Verb, argument, group, option, verb
from pincal.cli.common import GeneralOptions
from pincal.cli.quantities import ANGLE, LENGTH, NoiseType, QuantityType, beside, masses, resting
from pincal.errors import BadInputError, Exit, OutputError, PincalError
from pincal.identify.options import Options, StationOptions
from pincal.measure.table import write_table

CONTEXT = click.Context(pincal)
TYPED = [name for name in pincal.list_commands(CONTEXT) if isinstance(pincal.get_command(CONTEXT, name), Verb)]


@dataclass(frozen=True)
class Part:
    """A group."""

    colour: Literal["red", "blue"] = option("Its colour.", "red")
    at: tuple[float, float, float] | None = option("Where it is.", words="anywhere")


@dataclass(frozen=True, kw_only=True)
class Everything:
    """One field of each type."""

    table: Path = argument("TABLE", "What to read.")
    other: Path | None = argument("[OTHER]", "What else to read.", required=False)
    out: Path = option("Where to write.", MISSING)
    size: float | None = option("How large it is.", type=LENGTH)
    count: int = option("How many there are.", 3)
    pairs: tuple[tuple[str, float], ...] = option("What belongs together.", ())
    names: tuple[str, ...] = option("What they are called.", ())
    is_open: bool | None = option("Whether it is open.", name="--open/--closed")
    part: Part = group("Part of it")
    general: GeneralOptions = group("General")


def read(*words: str, defaults: dict[str, Any] | None = None) -> Everything:
    """Return what a command line is read as."""
    found: list[Everything] = []

    @verb(Everything, examples="Example:\n  pincal thing", defaults=defaults)
    def thing(arguments: Everything) -> Exit:
        """Do something."""
        found.append(arguments)
        return Exit.DONE

    assert thing.main(list(words), standalone_mode=False) is Exit.DONE
    return found[0]


def test_the_command_line_fills_the_dataclass() -> None:
    """Each type is read as it says, groups in their place, and nothing can be changed afterwards."""
    given = "a.csv --out b.csv --size 2mm --pairs x 1 --pairs y 2 --names n --closed --colour blue --at 1 2 3 --quiet"
    found = read(*given.split())

    assert found == Everything(
        table=Path("a.csv"),
        other=None,
        out=Path("b.csv"),
        size=2e-3,
        count=3,
        pairs=(("x", 1.0), ("y", 2.0)),
        names=("n",),
        is_open=False,
        part=Part(colour="blue", at=(1.0, 2.0, 3.0)),
        general=GeneralOptions(plugins=(), as_json=False, quiet=True),
    )
    with pytest.raises(FrozenInstanceError):
        found.count = 4  # type: ignore[misc]


def test_what_is_not_given_is_the_default_of_the_field_or_of_the_verb() -> None:
    """A verb may have another default than the group that it shares."""
    bare = ["a.csv", "--out", "b.csv"]
    assert read(*bare).part == Part(colour="red", at=None)
    assert read(*bare, "--quiet").is_open is None
    assert read(*bare, defaults={"colour": "blue"}).part.colour == "blue"


@pytest.mark.parametrize("wrong", [["", "--out", "b.csv"], ["a.csv", "--out", ""]])
def test_no_text_is_no_file(wrong: list[str]) -> None:
    """It is refused, and not the current folder."""
    with pytest.raises(click.UsageError, match="is not a name; expected a file or a folder"):
        read(*wrong)


@pytest.mark.parametrize("wrong", ["--out b.csv", "a.csv", "a.csv --out b --colour green", "a.csv --out b --at 1 2"])
def test_what_does_not_fit_is_a_usage_error(wrong: str) -> None:
    """A missing argument, a missing option, no such choice, too few values."""
    with pytest.raises(click.UsageError) as refused:
        read(*wrong.split())
    assert refused.value.exit_code == Exit.USAGE


def test_bytes_that_are_no_text_are_refused() -> None:
    """In any word, as such names reach neither a file nor the libraries that read and write them."""
    for words in (["\udcff.csv", "--out", "b.csv"], ["a.csv", "--out", "b.csv", "--names", "n\udcff"]):
        with pytest.raises(BadInputError, match=r"udcff.*: has bytes that are no text in UTF-8; .*rename the file"):
            read(*words)
    assert read("\u00e9.csv", "--out", "b.csv").table == Path("\u00e9.csv")


def test_a_mass_of_a_program_is_no_less_than_nothing() -> None:
    """It is what hangs on the tip."""
    command = pincal.get_command(click.Context(pincal), "compensate")
    (payload,) = (parameter for parameter in command.params if parameter.name == "payload")
    with pytest.raises(click.BadParameter, match="expected a number from 0 to"):
        payload.process_value(click.Context(command), "-5000")


def _flat(texts: list[list[str]]) -> list[str]:
    return [text for one in texts for text in one]


def _numbers(kind: click.ParamType[Any]) -> list[list[str]]:
    """Return texts that no option of a type takes: too large, too small, none; empty for a type that is not of numbers."""
    huge = ["nan", "inf", "-inf", "1e300", "-1e300"]
    if isinstance(kind, click.Tuple):
        parts = [_numbers(part) for part in kind.types]
        return [[odd[k % len(odd)] if odd else "a" for odd in map(_flat, parts)] for k in range(max(map(len, parts)))]
    if isinstance(kind, QuantityType | NoiseType):
        unit = "rad" if kind is ANGLE else "m"
        return [[number + unit] for number in (*huge, "1e-300")]
    function = getattr(kind, "func", None)
    if isinstance(kind, NumberType) or function is masses:
        return [[number] for number in huge]
    if function in (resting, beside):
        texts = [number + unit for number in huge for unit in ("", "deg", "m")]
        return [["joint_1=" + text if function is resting else f"a.urdf@0,0,0,0,0,{text}"] for text in texts]
    return [["-1"], ["1.5"]] if isinstance(kind, click.IntRange) else []


@pytest.mark.parametrize("name", TYPED)
def test_no_option_takes_a_number_that_can_not_be_meant(name: str) -> None:
    """What is not finite, or of a size that nothing about a robot has, is a usage error of every option of every verb."""
    command, tried = pincal.get_command(click.Context(pincal), name), 0
    context = click.Context(command)
    for parameter in command.params:
        assert not isinstance(parameter.type, click.types.FloatParamType) and parameter.type is not click.INT
        for words in _numbers(parameter.type):
            given: Any = words[0] if parameter.nargs == 1 else tuple(words)
            with pytest.raises(click.BadParameter):
                parameter.process_value(context, (given,) if parameter.multiple else given)
            tried += 1
    assert tried or name in ("validate", "predict", "export", "certificate")


@pytest.mark.parametrize("gravity", [("0", "0", "1e-300"), ("0", "0", "1e6")])
def test_a_gravity_is_none_or_one_that_there_is(gravity: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    """What says what is expected is refused, whether in a fit or a simulation; from Python as well."""
    for words in (["check", URDF, "t.csv"], ["simulate", URDF, "--poses", "5", "--out", "o.csv"]):
        assert run(*words, "--gravity", *gravity) == 2
        assert "0 0 0, or a vector of 1e-06 to 1000 m/s^2" in capsys.readouterr().err
    x, y, z = map(float, gravity)
    with pytest.raises(BadInputError, match="gravity"):
        Options(gravity=(x, y, z))


@pytest.mark.parametrize(
    "wrong",
    [
        {"sigma": 1e-300},
        {"sigma": math.nan},
        {"sigma_orientation": math.inf},
        {"payload_centre": (0.0, 0.0, math.nan)},
        {"tools": {"tool": (0.0, 0.0, 1e300)}},
        {"base": np.full((4, 4), math.nan)},
        {"length_bound": -1.0},
    ],
)
def test_options_from_python_are_numbers_that_can_be_meant(wrong: dict[str, Any]) -> None:
    """They are refused by name, those of a station as well."""
    name = "tool" if "tools" in wrong else next(iter(wrong))
    with pytest.raises(BadInputError, match=name):
        Options(**wrong)
    if name != "length_bound":
        with pytest.raises(BadInputError, match=name):
            StationOptions(**wrong)


@pytest.mark.parametrize("name", TYPED)
def test_the_help_of_every_verb_is_complete(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Every option has a sentence, every default can be read, every section has a heading, every exit code its meaning."""
    command = pincal.get_command(click.Context(pincal), name)
    assert run(name, "--help", "all") == 0
    text = " ".join(capsys.readouterr().out.split())
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            assert parameter.help and parameter.help[0].isupper() and "." in parameter.help
            assert "unless given" not in parameter.help
    assert ("Arguments:" in text) == any(isinstance(parameter, click.Argument) for parameter in command.params)
    assert "General: --plugin MODULE" in text and f"Exit codes: 0 {Exit.DONE.meaning}" in text


def test_every_error_has_an_exit_code_that_has_a_meaning() -> None:
    """The code of a class of errors is one of those that the help texts explain."""
    classes, found = [PincalError], set()
    while classes:
        cls = classes.pop()
        classes += cls.__subclasses__()
        found.add(cls.exit_code)
    assert found == {Exit.INTERNAL_ERROR, Exit.BAD_INPUT, Exit.UNDECIDED, Exit.INACCURATE, Exit.CHANGED}
    assert [(int(code), code.meaning) for code in Exit][:3] == [(0, "done"), (1, "internal error"), (2, "usage error")]


@pytest.mark.long
def test_calibrate_and_discover_record_the_same_inputs(
    tmp_path: Path,
    columns: Any,  # noqa: F811
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Whatever was read for a fit is in its provenance, whichever verb made it, and both say what the URDF can't carry."""
    data, held, known = tmp_path / "data.csv", tmp_path / "held.csv", tmp_path / "distances.csv"
    write_table(data, {name: column[:90] for name, column in columns.items()})
    write_table(held, {name: column[90:] for name, column in columns.items()})
    known.write_text("first,second,distance\na,b,1.0\n")
    points = tmp_path / "points.csv"
    points.write_text("point,x,y,z\na,0,0,0\nb,1,0,0\n")
    files = ["--holdout", held, "--distances", known, "--points", points]
    given = [URDF, data, *files, "--noise", "0.05mm", "--payload-com", ".08", "-.05", ".22"]
    found, notes = [], []
    for name in ("calibrate", "discover"):
        own = ["--stability", "0"] if name == "discover" else []
        given += ["--model", "elastic", "--moment-frame", "paper"] if name == "calibrate" else []
        assert run(name, *given, *own, "--out", tmp_path / name, "--quiet", "--verbose") == 0
        origin = json.loads((tmp_path / name / "model.json").read_text())["provenance"]
        assert origin["seed"] == 0
        found.append(origin["inputs"])
        notes.append([line for line in capsys.readouterr().out.splitlines() if "URDF" in line or "urdf" in line])

    assert found[0] == found[1]
    assert set(found[0]) == {"data.csv", "held.csv", "distances.csv", "points.csv", Path(URDF).name}
    assert any(line.startswith("note:") for line in notes[0])
    assert [line for line in notes[0] if line.startswith("note:")] == [n for n in notes[1] if n.startswith("note:")]


@pytest.mark.parametrize("verb_name", ["predict", "validate", "compensate"])
def test_every_verb_tells_where_a_model_extrapolates_unless_it_is_to_be_quiet(
    tmp_path: Path,
    columns: Any,  # noqa: F811
    results: Path,  # noqa: F811
    capsys: pytest.CaptureFixture[str],
    verb_name: str,
) -> None:
    """A payload that no row of the calibration had is named on stderr, with its line and the range, and counted in JSON."""
    rows = {name: column[:5] for name, column in columns.items()}
    write_table(tmp_path / "new.csv", rows | {"payload": np.full(5, 900.0)})
    out = [] if verb_name == "validate" else ["--out", tmp_path / "out.csv"]
    command = [verb_name, results / "model.json", tmp_path / "new.csv", *out]
    codes = [run(*command, "--json"), run(*command, "--quiet")]
    printed = capsys.readouterr()

    assert codes == [0, 0] and printed.err.count("payload = 900") == 5
    assert json.JSONDecoder().raw_decode(printed.out)[0]["outside"] == 5


@pytest.mark.parametrize(
    "words",
    [
        "predict model.json t.csv --out p.xlsx",
        "predict model.json t.csv --out p",
        "simulate ur10 --poses 3 --out s.pdf",
        "calibrate robot.urdf t.csv --out model.json",
        "export model.json --urdf a.csv",
        "view model.json --html view.png",
    ],
)
def test_a_name_that_can_not_be_written_is_refused_first(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Before any file is looked at, exit code 3, with the endings that can be."""
    assert run(*words.split()) == 3
    told = capsys.readouterr().err
    assert "can't be written as" in told or "give the name of a folder" in told


@pytest.mark.parametrize("name", ["t.csv", "./t.csv", "model.json/../t.csv"])
def test_a_table_that_is_read_is_not_replaced(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By whatever name, before anything is computed: measurements would be lost to predictions of them."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.json").mkdir()
    (tmp_path / "t.csv").write_text("measured")

    assert run("predict", "model.json", "t.csv", "--out", name) == 3

    assert "is read by this command and would be replaced" in capsys.readouterr().err
    assert (tmp_path / "t.csv").read_text() == "measured"


def test_a_table_ends_as_it_is_written(tmp_path: Path) -> None:
    """From Python, too: tabs where the name says so, and no other format under its name."""
    write_table(tmp_path / "t.tsv", {"a": np.ones(1), "b": np.ones(1)})
    assert (tmp_path / "t.tsv").read_text() == "a\tb\n1.0\t1.0\n"
    with pytest.raises(OutputError, match=r"can't be written as \.xlsx"):
        write_table(tmp_path / "t.xlsx", {"a": np.ones(1)})
