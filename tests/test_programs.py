"""Programs of controllers: nothing but numbers changes, and the real arm arrives where the nominal one was told to go."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from program_cases import A_THIRD, COUNT, FEATURES, KUKA, LANGUAGES, PULSES, Case, Wanted, cases
from scipy.spatial.transform import Rotation

from pincal.calibration.covered import Covered
from pincal.calibration.fitted_robot import FittedRobot
from pincal.cli import main
from pincal.errors import ProgramError
from pincal.export import export_model
from pincal.model.chain import Chain
from pincal.model.effects import BearingElasticity, JointElasticity, JointOffset, LinkGeometry
from pincal.model.model import Model
from pincal.parameters import estimate_of
from pincal.programs.arms import ProgramAxes
from pincal.programs.correct import Corrector, ProgramCell
from pincal.programs.language import LANGUAGES as KNOWN
from pincal.programs.program import Edit, Program, spliced
from pincal.programs.syntax import Source

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

# What is promised of a corrected pose [m]; and of one in whole pulses, half a pulse of six axes over their levers.
PROMISED, PROMISED_IN_PULSES = 1e-6, 1e-4


def calibrated(size: float) -> FittedRobot:
    """Return the KUKA with an error of some millimetres, or with none."""
    chain = Chain.of(KUKA)
    model = Model(chain, (LinkGeometry(), JointOffset(), JointElasticity(), BearingElasticity()))
    values = size * np.random.default_rng(5).standard_normal(model.n_parameters)
    compliances = np.array([p.unit.endswith("(N m)") for p in model.parameters])
    values[compliances] = np.abs(values[compliances]) * 3.0 / (KUKA.masses.sum() * KUKA.reach * 9.81)
    covered = Covered(np.tile([-9.0, 9.0], (6, 1)), np.array([0.0, 200.0]))
    estimate = estimate_of(model.parameters, values, 1e-12 * np.eye(len(values)))
    return FittedRobot.given(model, estimate, covered, sensor_kind="pose", sigma=[5e-5])


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the files of a robot without errors and of one with them."""
    folder = tmp_path_factory.mktemp("models")
    for name, size in (("none", 0.0), ("some", 4e-4)):
        calibrated(size).save(folder / f"{name}.json")
    return folder / "none.json", folder / "some.json"


@pytest.fixture(scope="module")
def real_arm() -> Callable[[np.ndarray], np.ndarray]:
    """Return the exported NumPy model's forward kinematics: tips in the base."""
    names: dict[str, Any] = {}
    exec(compile(export_model(calibrated(4e-4), "python", frame="base").text, "arm.py", "exec"), names)
    forward: Callable[[np.ndarray], np.ndarray] = names["forward"]
    return forward


def run(*words: object) -> int:
    """Run the command."""
    with pytest.raises(SystemExit) as ended:
        main(["compensate", *map(str, words)])
    return int(ended.value.code or 0)


def corrected(model: Path, case: Case, folder: Path, *options: str, capsys: Any) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Correct a program, and return its files and the outcome."""
    folder = folder / case.name
    (folder / "out").mkdir(parents=True)
    for file in case.files:
        (folder / file).write_bytes(case.content(file))
    first = next(iter(case.files))
    words = [model, folder / first, "--out", folder / "out" / first, *LANGUAGES[case.language][1], *options]
    capsys.readouterr()
    code = run(*words, "--json", "--quiet")
    result = json.loads(capsys.readouterr().out)
    assert code == 0, result
    return {file: (folder / "out" / file).read_bytes() for file in case.files}, result


def pose_of(language: str, numbers: list[float]) -> np.ndarray:
    """Return the pose, shape (4, 4) [m], that numbers of a language are, turns behind them left out."""
    T = np.eye(4)
    if language == "FANUC LS":
        numbers = numbers[3:]
    if language == "URScript":
        T[:3, 3], T[:3, :3] = numbers[:3], Rotation.from_rotvec(numbers[3:6]).as_matrix()
        return T
    T[:3, 3] = 1e-3 * np.array(numbers[:3])
    if language == "RAPID":
        T[:3, :3] = Rotation.from_quat(numbers[3:7], scalar_first=True).as_matrix()
    else:
        order = "ZYX" if language == "KRL" else "xyz"
        T[:3, :3] = Rotation.from_euler(order, numbers[3:6], degrees=True).as_matrix()
    return T


def joints_of(language: str, numbers: list[float]) -> np.ndarray:
    """Return joint positions [rad]."""
    values = np.array(numbers[:6])
    if language == "URScript":
        return values
    return np.deg2rad(values / (np.array(PULSES) if language == "JBI" else 1.0))


def nominal_joints(tip: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return joints of the nominal arm at a pose of the tip, near others, by differences of Pinocchio's kinematics."""
    step = np.full(6, np.inf)
    for _ in range(8):
        here = KUKA.forward_kinematics(np.vstack([q, q + 1e-6 * np.eye(6)]))
        turns = Rotation.from_matrix(tip[:3, :3] @ here[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
        apart = np.hstack([tip[:3, 3] - here[:, :3, 3], turns])
        step = np.linalg.solve(((apart[0] - apart[1:]) / 1e-6).T, apart[0])
        q = q + step
        # The differences leave a part in a million of a step.
        if np.abs(step).max() < 1e-7:
            return q
    raise AssertionError(f"no joints within 8 steps: the last one was {step}")


def told_joints(language: str, point: Wanted, numbers: list[float]) -> np.ndarray:
    """Return the joints that a controller with the nominal model takes when it is told numbers."""
    if point.kind == "joints":
        return joints_of(language, numbers)
    return nominal_joints(point.base @ pose_of(language, numbers) @ np.linalg.inv(point.tool), point.q)


# A third of the programs of each language, and all of them.
SOME, ALL = pytest.param(A_THIRD, id="a third"), pytest.param(range(COUNT), id="all", marks=pytest.mark.rates)


def test_a_third_of_the_programs_has_whatever_any_has() -> None:
    """Every variant of a writer, of which it has up to 14, and every encoding with every end of line."""
    for variants in (2, 3, 4, 5, 7, 10, FEATURES):
        assert {k % variants for k in A_THIRD} == set(range(variants))
    assert len({(k % 3, k // FEATURES % 3) for k in A_THIRD}) == 9


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize(
    "chosen",
    [
        # A third of them are corrected below before each commit.
        pytest.param(range(2), id="two"),
        pytest.param(range(COUNT), id="all", marks=[pytest.mark.long, pytest.mark.rates]),
    ],
)
def test_without_errors_a_program_stays_as_it_is(
    language: str, chosen: Sequence[int], models: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Byte by byte, though every point of it is understood."""
    for case in cases(language, chosen):
        files, result = corrected(models[0], case, tmp_path, capsys=capsys)

        assert files == {file: case.content(file) for file in case.files}, case.name
        assert len(result["points"]) == len(case.points), (case.name, result["left"])


@pytest.mark.long
@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize("chosen", [SOME, ALL])
def test_the_real_arm_arrives_where_the_program_meant(
    language: str,
    chosen: Sequence[int],
    models: tuple[Path, Path],
    real_arm: Callable[[np.ndarray], np.ndarray],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Told the corrected numbers, to a micrometre; and nothing but numbers of points has changed."""
    assert COUNT >= 40
    worst, moved = 0.0, []
    for case in cases(language, chosen):
        files, result = corrected(models[1], case, tmp_path, capsys=capsys)
        assert len(result["points"]) == len(case.points), (case.name, result["left"])
        for file in case.files:
            before, after = (case.numbers(file, content) for content in (case.content(file), files[file]))
            for key, numbers in before.items():
                point = case.points[key]
                meant, commanded = (told_joints(language, point, told) for told in (numbers, after[key]))
                wanted = KUKA.forward_kinematics(meant[None])[0] @ point.tool
                uncorrected, reached = _whole(real_arm)(np.stack([meant, commanded])) @ point.tool
                distance = float(np.linalg.norm(reached[:3, 3] - wanted[:3, 3]))
                turn = Rotation.from_matrix(reached[:3, :3] @ wanted[:3, :3].T).magnitude()
                is_rounded = language == "JBI" and point.kind == "joints"
                assert distance < (PROMISED_IN_PULSES if is_rounded else PROMISED), (case.name, key)
                assert turn < (1e-4 if is_rounded else 1e-7), (case.name, key)
                worst = max(worst, 0.0 if is_rounded else distance)
                moved.append(float(np.linalg.norm(uncorrected[:3, 3] - wanted[:3, 3])))
    with capsys.disabled():
        print(f"\n{language}: {len(moved)} points, {1e3 * np.mean(moved):.3f} mm before, {1e6 * worst:.3f} um after")
    assert np.mean(moved) > 1e-3


def _whole(forward: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    def tips(q: np.ndarray) -> np.ndarray:
        return np.concatenate([forward(q), np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(q), 1, 1))], axis=1)

    return tips


# What mutations put in, and how many of them each language meets.
TOKENS = [
    "{",
    "}",
    "]",
    "(",
    '"',
    "'",
    ";",
    "\n",
    ",",
    "X 5",
    "END",
    "ENDDAT",
    "MoveL p1,v1,z1,t;",
    "-",
    ".",
    "1e5",
    "\0",
    ":=",
]
MUTATIONS = 400


def mutated(content: bytes, other: bytes, rng: np.random.Generator) -> bytes:
    """Return a program cut, with bytes lost or put in, lines exchanged or doubled, or a piece of another language in it."""
    kind = rng.integers(7)
    at = int(rng.integers(len(content)))
    lines = content.split(b"\n")
    i, j = (int(k) for k in rng.integers(len(lines), size=2))
    if kind == 0:
        return content[:at]
    if kind == 1:
        return content[:at] + content[at + int(rng.integers(1, 12)) :]
    if kind == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif kind == 3:
        lines.insert(i, lines[j])
    elif kind == 4:
        del lines[i]
    elif kind == 5:
        return content[:at] + str(rng.choice(TOKENS)).encode() + content[at:]
    else:
        lines[i:j] = other.split(b"\n")[:10]
    return b"\n".join(lines)


@pytest.mark.long
@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize("count", [MUTATIONS // 8, pytest.param(MUTATIONS, marks=pytest.mark.rates)])
def test_a_program_that_is_not_whole_is_never_made_wrong(
    language: str, count: int, real_arm: Callable[[np.ndarray], np.ndarray]
) -> None:
    """It is refused at a line and a column, or what is corrected in it is corrected rightly, and the rest is untouched."""
    assert len(LANGUAGES) * MUTATIONS >= 2000
    rng = np.random.default_rng(7)
    programs = list(cases(language, range(20)))
    others = [next(cases(name)) for name in LANGUAGES if name != language]
    reader = KNOWN.known()[language]()
    options = LANGUAGES[language][1]
    given = {kind: options[options.index(kind) + 1].split("=") for kind in ("--tool", "--base") if kind in options}
    if "--pulses" in options:
        reader = reader.with_pulses(options[options.index("--pulses") + 1])
    cell = ProgramCell(
        axes=ProgramAxes.parse(None, KUKA),
        tools={name: reader.frame(values) for kind, (name, values) in given.items() if kind == "--tool"},
        bases={name: reader.frame(values) for kind, (name, values) in given.items() if kind == "--base"},
    )
    corrector = Corrector(calibrated(4e-4), reader, cell)
    refused = points = 0
    for k in range(count):
        case, other = programs[k % 20], others[k % len(others)]
        broken = int(rng.integers(len(case.files)))
        whole = {file: case.content(file) for file in case.files}
        name = list(whole)[broken]
        whole[name] = mutated(whole[name], other.content(next(iter(other.files))), rng)
        sources = [Source(file, content) for file, content in whole.items()]
        try:
            program = reader.read(sources)
        except ProgramError as error:
            assert any(source.name in str(error) for source in sources) and "line" in str(error)
            refused += 1
            continue
        changes, left = corrector.changes(program)
        edits = [edit for change in changes.values() for edit in corrector.edits(change)]
        after = [spliced(source, i, edits) for i, source in enumerate(program.sources)]
        again = reader.read([Source(s.name, content) for s, content in zip(sources, after, strict=True)])
        assert all(one.line > 0 and one.reason for one in left)
        for source, content, file in zip(sources, after, range(len(after)), strict=True):
            assert _blanked(content, again, file) == _blanked(source.content, program, file)
        new = dict(zip(sorted(program.points), (again.points[key] for key in sorted(again.points)), strict=True))
        for key, change in changes.items():
            point, told = change.point, new[key].values
            points += 1
            before, behind = change.frames
            if point.kind == "pose":
                wanted = before @ reader.pose(point.values) @ behind
                q = nominal_joints(before @ reader.pose(told) @ behind, change.commanded)
            else:
                wanted = KUKA.forward_kinematics(corrector.joints(point)[None])[0]
                q = corrector.joints(point, told)
            off = np.linalg.norm(_whole(real_arm)(q[None])[0, :3, 3] - wanted[:3, 3])
            assert off < (PROMISED_IN_PULSES if language == "JBI" and point.kind == "joints" else PROMISED), (
                case.name,
                point,
            )
    print(f"{language}: {count} mutations, {refused} refused, {points} points corrected rightly")


def _blanked(content: bytes, program: Program, file: int) -> bytes:
    """Return a file without the numbers of its points."""
    edits = [
        Edit(file, n.start, n.end, "")
        for key, p in program.points.items()
        if key[0] == file
        for n in {*p.numbers, *(turn.number for turn in p.posture.turns)}
    ]
    return spliced(Source("", content), file, edits)
