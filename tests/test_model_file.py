"""The file of a calibrated model: the same predictions after reading, and a clear word for every damage."""

import base64
import json
import subprocess
import sys
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import pincal
from pincal.builtin import kuka_urdf_path
from pincal.calibration.fitted_robot import FittedRobot, load_model
from pincal.errors import ModelFileError, OutputError
from pincal.identify.calibrate import fit_tables
from pincal.identify.fit import ModelFit
from pincal.identify.options import Options
from pincal.io.arrays import packed_covariance, packed_matrix, packed_symmetric, unpacked
from pincal.io.entries import EFFECTS
from pincal.io.strict_json import Fault
from pincal.io.urdf_export import calibrated_urdf
from pincal.measure.table import measurements_from_arrays
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect, Locus, Term
from pincal.model.effect_registry import register_effect
from pincal.model.effects import ELASTIC, GEOMETRIC
from pincal.parameters import Parameter, estimate_of
from pincal.robot.robot import Robot
from pincal.simulate import Instrument, TrueMachine, plan_poses

PROVENANCE = {"pincal": "0.1.0", "created": "2024-01-02T03:04:05+00:00", "seed": 3, "inputs": {"data.csv": "ab12"}}


def simulated_fit(kind: str, options: Options, *, targets: Any = (0.0, 0.0, 0.0), **conditions: Any) -> ModelFit:
    """Calibrate the KUKA on 60 simulated rows with noise."""
    rng = np.random.default_rng(3)
    machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0").draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    q = plan_poses(machine.nominal, 60, rng)
    tracker = Instrument(reads=kind, targets=targets, sigma=5e-5, sigma_angle=5e-5)
    columns = tracker.measure(machine, q, rng=rng, **conditions)
    robot = Robot.from_urdf(kuka_urdf_path())
    rows = np.column_stack([columns[name] for name in robot.joint_names])
    given: dict[str, Any] = {name: columns[name] for name in ("payload", "target", "distance") if name in columns}
    if "x" in columns:
        given["position"] = np.column_stack([columns[name] for name in "xyz"])
    if "qx" in columns:
        given["quaternion"] = np.column_stack([columns[name] for name in ("qx", "qy", "qz", "qw")])
    return fit_tables(robot, measurements_from_arrays(robot.joint_names, rows, **given), options)


def elastic_fit() -> ModelFit:
    """Return an elastic model with two targets, of which one is known, and a payload with a lever."""
    options = Options(effects=ELASTIC, tools={"far": (0.1, 0.0, 0.4)}, payload_centre=(0.0, 0.1, 0.2), moment_frame="after")
    weights = np.tile([0.0, 60.0, 120.0], 20)
    targets = {"near": (0.1, 0.0, 0.2), "far": (0.1, 0.0, 0.4)}
    return simulated_fit("position", options, targets=targets, payload=weights, payload_com=(0.0, 0.1, 0.2))


@pytest.fixture(scope="module")
def fit() -> ModelFit:
    """Return the elastic fit."""
    return elastic_fit()


@pytest.fixture(scope="module")
def calibrated(fit: ModelFit) -> FittedRobot:
    """Return its model."""
    return FittedRobot.of(fit, PROVENANCE)


@pytest.fixture
def path(calibrated: FittedRobot, tmp_path: Path) -> Path:
    """Return a model.json of it."""
    calibrated.save(tmp_path / "model.json")
    return tmp_path / "model.json"


def poses(model: FittedRobot, count: int = 50) -> Conditions:
    """Return conditions with all targets and payloads."""
    rng = np.random.default_rng(8)
    robot, targets = model.model.chain.robot, len(model.model.chain.targets)
    q = robot.random_configurations(count, rng)
    return Conditions(q, rng.integers(0, targets, count), rng.uniform(0.0, 125.0, count), model.payload_centre)


# The covariance of all parameters of a robot with one station.
BLOCK = ("covariance", "groups", 0, "block")


def listed(text: str) -> list[list[float]]:
    """Return a matrix in the way that files of version 0.1.0 have it."""
    words = np.frombuffer(zlib.decompress(base64.b64decode(text.removeprefix("matrix:"))), np.uint8).reshape(8, -1)
    values = np.ascontiguousarray(words.T).view("<f8").ravel()
    return values[1:].reshape(int(values[:1].view("<u8")[0]), -1).tolist()


def edited(path: Path, *keys: str | int, value: Any = None, edit: Callable[[Any], Any] | None = None) -> Path:
    """Change or (without value or edit) remove what stands at some keys of a JSON file, which has no check then."""
    content = json.loads(path.read_text())
    if keys != ("check",):
        content.pop("check", None)
    place = content
    for key in keys[:-1]:
        place = place[key]
    if edit is not None:
        place[keys[-1]] = edit(place[keys[-1]])
    elif value is None:
        del place[keys[-1]]
    else:
        place[keys[-1]] = value
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("position", None),
        ("pose", Options(effects=GEOMETRIC, base=np.eye(4))),
        ("distance", Options(effects=GEOMETRIC, equilibrium=True)),
    ],
)
def test_a_model_read_again_predicts_the_same_to_the_last_bit(
    kind: str, options: Options | None, fit: ModelFit, tmp_path: Path
) -> None:
    """Poses, their uncertainty and everything else come back with no difference at all."""
    model = FittedRobot.of(fit if options is None else simulated_fit(kind, options), PROVENANCE)
    model.save(tmp_path / "model.json")
    again = load_model(tmp_path / "model.json")
    conditions = poses(model)

    assert np.array_equal(again.predict(conditions), model.predict(conditions))
    assert np.array_equal(again.position_sigma(conditions), model.position_sigma(conditions))
    assert again.outside(conditions) == model.outside(conditions)
    for name in ("values", "covariance", "payload_centre", "sigma"):
        assert np.array_equal(getattr(again, name), getattr(model, name)), name
    assert again.estimate.parameters == model.estimate.parameters
    assert again.sensor_kind == kind
    assert again.provenance == PROVENANCE
    assert again.model.effects == model.model.effects
    assert again.model.equilibrium == model.model.equilibrium


def test_robot_and_chain_come_back_whole(calibrated: FittedRobot, path: Path) -> None:
    """Every field of the robot and the chain is in the file, limits that are not there included."""
    chain, again = calibrated.model.chain, load_model(path).model.chain

    for name in Robot.__dataclass_fields__.keys() - {"frames"}:
        np.testing.assert_array_equal(getattr(again.robot, name), getattr(chain.robot, name), err_msg=name)
    for name in Chain.__dataclass_fields__.keys() - {"robot", "kept"}:
        np.testing.assert_array_equal(getattr(again, name), getattr(chain, name), err_msg=name)


def test_limits_that_are_not_there_and_odd_bytes_survive(calibrated: FittedRobot, tmp_path: Path) -> None:
    """Infinite limits and a URDF that is no UTF-8 come back as they were."""
    robot = calibrated.model.chain.robot
    lower = robot.lower.copy()
    lower[2] = -np.inf
    odd = replace(robot, lower=lower, upper=np.full(6, np.inf), urdf="<!-- é -->".encode("latin-1") + "😀\n".encode())
    model = calibrated.with_model(
        calibrated.model.with_chain(replace(calibrated.model.chain, robot=odd)), calibrated.estimate
    )
    model.save(tmp_path / "model.json")
    again = load_model(tmp_path / "model.json").model.chain.robot

    assert again.urdf == odd.urdf
    assert np.array_equal(again.lower, lower)
    assert np.array_equal(again.upper, odd.upper)


@pytest.mark.long
def test_a_model_predicts_where_no_urdf_and_no_pinocchio_is(tmp_path: Path) -> None:
    """Another process, with the URDF deleted and its text taken out of the file, predicts the same."""
    urdf = tmp_path / "robot.urdf"
    urdf.write_bytes(kuka_urdf_path().read_bytes())
    robot = Robot.from_urdf(urdf)
    fit = simulated_fit("position", Options(effects=GEOMETRIC))
    chain = replace(fit.model.chain, robot=robot)
    model = FittedRobot.of(fit).with_model(fit.model.with_chain(chain), fit.estimate)
    file = tmp_path / "model.json"
    model.save(file)
    urdf.unlink()
    edited(file, "robot", "urdf")
    conditions = poses(model, 5)
    np.save(tmp_path / "q.npy", conditions.q)
    code = (
        "import sys, numpy as np\n"
        "from pincal.calibration.fitted_robot import load_model\n"
        "from pincal.model.conditions import Conditions\n"
        "model = load_model('model.json')\n"
        "np.save('poses.npy', model.predict(Conditions.at(np.load('q.npy'))))\n"
        "print('pinocchio' in sys.modules)\n"
    )
    root = str(Path(pincal.__file__).resolve().parents[1])
    run = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {root!r})\n{code}"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )

    assert run.stdout.strip() == "False"
    assert np.array_equal(np.load(tmp_path / "poses.npy"), model.predict(Conditions.at(conditions.q)))


def test_a_model_read_again_exports_the_same_urdf(calibrated: FittedRobot, path: Path) -> None:
    """The text of the URDF travels in the file, so that the calibrated one can be written later."""
    again = load_model(path)

    assert calibrated_urdf(again.model, again.values) == calibrated_urdf(calibrated.model, calibrated.values)


def test_a_model_is_that_of_its_fit(fit: ModelFit, calibrated: FittedRobot) -> None:
    """Predictions are the fit's own; what was given and not fitted has no variance."""
    poses = fit.model.predict(fit.values, fit.station.conditions)
    held = ~fit.solution.free

    assert np.array_equal(calibrated.predict(fit.station.conditions), poses)
    assert held.any()
    assert not calibrated.covariance[held].any()
    assert not calibrated.covariance[:, held].any()
    free = fit.solution.free
    assert np.array_equal(calibrated.covariance[np.ix_(free, free)], fit.solution.known.covariance)
    assert np.array_equal(calibrated.sigma, fit.solution.sigma)


@pytest.mark.long
def test_uncertainty_is_that_of_values_drawn_from_the_covariance(calibrated: FittedRobot) -> None:
    """The spread of predictions with 4000 drawn sets of values is the stated sigma, to the accuracy of a sample.

    The draws are scaled down: along directions that the data leave to the priors, base and arm turn against each other by
    milliradians, whose squares alone would move the target by as much as sigma.
    """
    conditions = poses(calibrated, 3)
    n = calibrated.model.n_parameters
    rng = np.random.default_rng(2)
    scale = 1e-3
    drawn = rng.multivariate_normal(calibrated.values, scale**2 * calibrated.covariance, 4000, method="eigh")
    spread = np.std([calibrated.model.predict(values[:n], conditions)[:, :, 3] for values in drawn], axis=0) / scale

    # A standard deviation from 4000 draws is itself uncertain by 1.1 %.
    np.testing.assert_allclose(calibrated.position_sigma(conditions), spread, rtol=0.06)


def test_uncertainty_of_many_poses_is_worked_out_in_pieces(calibrated: FittedRobot) -> None:
    """Rows beyond the first piece have the sigma that they have alone."""
    conditions = poses(calibrated, 5000)
    whole = calibrated.position_sigma(conditions)
    last = np.arange(4990, 5000)

    np.testing.assert_allclose(calibrated.position_sigma(conditions.select(last)), whole[last], rtol=1e-12)


def test_outside_names_rows_joints_and_ranges(fit: ModelFit, calibrated: FittedRobot) -> None:
    """Training rows are covered, and so is a little more; beyond it each joint and the payload are named."""
    conditions = fit.station.conditions
    assert calibrated.outside(conditions) == []

    lower, upper = calibrated.covered.q.T
    middle = (lower + upper) / 2
    q = np.tile(middle, (3, 1))
    q[1, 3] = upper[3] + 0.02 * (upper[3] - lower[3])
    q[2, 4] = lower[4] - 0.03 * (upper[4] - lower[4])
    payload = np.array([200.0, 0.0, 60.0])
    found = calibrated.outside(Conditions(q, np.zeros(3, int), payload, calibrated.payload_centre))

    assert [(row, name) for row, name, *_ in found] == [(0, "payload"), (2, "joint_5")]
    assert found[0][2:] == (200.0, 0.0, 120.0)
    assert found[1][2:] == (q[2, 4], lower[4], upper[4])


@register_effect
@dataclass(frozen=True)
class ShapedEffect(Effect):
    """An effect with every sort of field that a file has to carry."""

    joint: str
    orders: tuple[int, ...] = (1, 2)
    nested: tuple[tuple[str, float], ...] = ()
    period: float | None = None
    knots: np.ndarray | None = None
    is_signed: bool = False
    name: ClassVar[str] = "shaped_effect"
    meaning: ClassVar[str] = "an effect of these tests"

    @property
    def locus(self) -> Locus:
        """The drive, by its own position."""
        return Locus(self.joint, "drive", self.joint)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """One parameter an order."""
        return tuple(Parameter(f"{self.joint}.c_{order}", "rad", self.name, 0.0, 1e-3) for order in self.orders)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add harmonics of the joint's angle."""
        i = chain.robot.joint_names.index(self.joint)
        places = enumerate(self.orders)
        return tuple(Term(p, chain.joint(i, "theta"), np.sin(order * conditions.q[:, i])) for p, order in places)


def shaped(calibrated: FittedRobot) -> FittedRobot:
    """Return the calibrated model with an effect more, defined outside the package."""
    effect = ShapedEffect("joint_2", (3,), (("a", 0.1), ("b", 1e-17)), np.pi, np.array([[0.1, 2.0]]), True)
    model = calibrated.model.with_effects((*calibrated.model.effects, effect))
    n = len(calibrated.values)
    covariance = np.zeros((n + 1, n + 1))
    covariance[:n, :n] = calibrated.covariance
    return calibrated.with_model(model, estimate_of(model.parameters, np.append(calibrated.values, 1e-3), covariance))


def test_an_effect_from_elsewhere_is_written_and_read(calibrated: FittedRobot, tmp_path: Path) -> None:
    """A new effect needs no entry anywhere: its name and its fields are enough."""
    model = shaped(calibrated)
    model.save(tmp_path / "model.json")
    again = load_model(tmp_path / "model.json")
    effect, expected = again.model.effects[-1], model.model.effects[-1]

    assert isinstance(effect, ShapedEffect)
    assert isinstance(expected, ShapedEffect)
    assert effect.knots is not None
    assert np.array_equal(effect.knots, np.array([[0.1, 2.0]]))
    assert replace(effect, knots=None) == replace(expected, knots=None)
    assert np.array_equal(again.predict(poses(model)), model.predict(poses(model)))


def test_a_field_younger_than_the_file_has_its_default(calibrated: FittedRobot, tmp_path: Path) -> None:
    """A file written before an effect got a field is read; a field without default has to be there."""
    file = tmp_path / "model.json"
    shaped(calibrated).save(file)
    last = len(calibrated.model.effects)
    assert load_model(edited(file, "stations", 0, "effects", last, "period")).model.effects[-1].period is None  # type: ignore[attr-defined]

    with pytest.raises(ModelFileError, match=rf"stations\[0\]\.effects\[{last}\]\.joint: is missing"):
        load_model(edited(file, "stations", 0, "effects", last, "joint"))


def test_every_catalogued_effect_is_known() -> None:
    """Effects are found by the names of the contract; classes without a name of their own are none."""
    assert {effect.name for effect in ELASTIC} | {"base_frame", "tool_frame"} <= EFFECTS.known().keys()
    assert all(cls.name == name for name, cls in EFFECTS.known().items())


def _keys(value: Any, way: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Return the ways to all keys of objects that the reader knows: free text in the provenance is not checked."""
    if isinstance(value, dict) and way != ("provenance",):
        for key, entry in value.items():
            yield (*way, key)
            yield from _keys(entry, (*way, key))
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        yield from _keys(value[0], (*way, 0))


def test_every_missing_key_is_named(path: Path) -> None:
    """Whatever key is taken out, the error says which and in which file; fields of effects and the URDF may be missing."""
    text = path.read_text()
    optional = ("symbols", "urdf", "nominal_values", "rows", "is_noise_declared", "bearing_heights", "days")
    optional += ("repeatability", "on_carriages", "unmodelled", "information", "files", "priors", "check")
    ways = [way for way in _keys(json.loads(text)) if way[-1] not in optional]

    assert len(ways) > 40
    for way in ways:
        path.write_text(text)
        shown = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in way).lstrip(".")
        with pytest.raises(ModelFileError) as error:
            load_model(edited(path, *way))
        assert str(error.value).startswith(f"{path}: {shown}: is missing")


def test_every_value_of_the_wrong_kind_is_refused(path: Path) -> None:
    """A text for numbers, numbers for a text, null or an object anywhere: an error of the file, never another one."""
    text = path.read_text()
    for way in _keys(json.loads(text)):
        for wrong in ({"x": [None]}, [["x"], 1], -3.5):
            fits = (way[-1] in ("nominal", "size", "square", "degrees") and wrong == -3.5) or (
                way == ("provenance",) and isinstance(wrong, dict)
            )
            if fits:
                continue
            path.write_text(text)
            with pytest.raises(ModelFileError, match=r"model\.json"):
                load_model(edited(path, *way, value=wrong))


@pytest.mark.parametrize("keys", [("values", 3), ("stations", 0, "sigma", 0), ("robot", "masses", 1)])
def test_a_value_that_was_edited_is_refused(path: Path, keys: tuple[str | int, ...]) -> None:
    """Each is valid by itself; another layout or order of the file is none; without the check it is used as it is."""
    content = json.loads(path.read_text())
    path.write_text(json.dumps(dict(reversed(content.items())), indent=2))
    load_model(path)
    place = content
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] += 1e-3
    path.write_text(json.dumps(content))

    with pytest.raises(ModelFileError, match=r"a value was changed after the file was written .*remove the key check"):
        load_model(path)
    load_model(edited(path, *keys, edit=lambda value: value))


@pytest.mark.parametrize("kept", [0.0, 0.001, 0.3, 0.7, 0.999])
def test_a_cut_off_file_is_refused(path: Path, kept: float) -> None:
    """A file that ends too early says so and what to do."""
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])

    with pytest.raises(ModelFileError, match=r"model\.json: truncated or not JSON .*run pincal calibrate again"):
        load_model(path)


def test_bytes_that_are_no_text_are_refused_in_any_key(path: Path) -> None:
    """Keys that are not known are skipped; one of them may have been ``check``."""
    path.write_bytes(path.read_bytes().replace(b'"check"', b'"ch\xffck"'))
    with pytest.raises(ModelFileError, match=r"model\.json: truncated or not JSON .*0xff"):
        load_model(path)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"[" * 100_000, b"9" * 10_000, b"[1, 2]", b"null", b"{}"])
def test_what_is_no_model_is_refused(tmp_path: Path, content: bytes) -> None:
    """Bytes that are no text, JSON without end, numbers without end, another value: always the same class of error."""
    (tmp_path / "model.json").write_bytes(content)

    with pytest.raises(ModelFileError, match=r"model\.json"):
        load_model(tmp_path / "model.json")


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    """A missing file and a folder are errors of the model file."""
    with pytest.raises(ModelFileError, match=r"absent\.json: can't be read"):
        load_model(tmp_path / "absent.json")
    with pytest.raises(ModelFileError, match=r"expected a model\.json$"):
        load_model(tmp_path)
    (tmp_path / "model.json").touch()
    with pytest.raises(ModelFileError, match=r"expected a model\.json, such as .*model\.json$"):
        load_model(tmp_path)
    for name, text in (("result.json", "{}"), ("new.csv", "x,y")):
        (tmp_path / name).write_text(text)
        with pytest.raises(ModelFileError, match=rf"{name}: .*; expected a model\.json, such as .*model\.json$"):
            load_model(tmp_path / name)


@pytest.mark.parametrize(
    ("version", "words"), [(4, "newer pincal; .*update pincal"), ("1", "is '1'"), (0, "is 0"), (True, "True")]
)
def test_another_format_version_is_refused(path: Path, version: Any, words: str) -> None:
    """A newer file asks for an update; what is no version is said so."""
    with pytest.raises(ModelFileError, match=f"format_version.* {words}|format_version: {words}"):
        load_model(edited(path, "format_version", value=version))


@pytest.mark.parametrize(
    ("keys", "edit", "words"),
    [
        (("values",), lambda v: v[1:], r"values: has shape \(\d+,\); expected numbers of shape"),
        (BLOCK, lambda v: listed(v)[:-1], "block: has shape"),
        (BLOCK, lambda v: [*listed(v)[:-1], listed(v)[-1][1:]], "block: has rows of unequal length"),
        (BLOCK, lambda v: packed_matrix(np.eye(3)), "block: has shape"),
        (BLOCK, lambda v: v[:-4], "block: is truncated or damaged"),
        (BLOCK, lambda v: v[:40] + "?" + v[41:], "block: is truncated or damaged"),
        (("stations", 0, "covered", "q"), lambda v: v[:5], r"covered\.q: has shape \(5, 2\)"),
        (("robot", "masses"), lambda v: [*v, 1.0], r"robot\.masses: has shape \(7,\)"),
        (("robot", "joint_types"), lambda v: v[1:], "joint_types: has 5 entries"),
        (("robot", "joint_types", 0), lambda v: "planar", "is 'planar'; expected one of revolute, prismatic"),
        (("stations", 0, "chain", "moment_frame"), lambda v: "middle", "is 'middle'; expected one of paper, before, after"),
        (("stations", 0, "chain", "targets"), lambda v: [*v, "third"], "tool_rotations: has shape"),
        (("robot", "urdf"), lambda v: "\ud800", "urdf: is not text"),
        (("parameters", 0, "name"), lambda v: "base.w", "parameters: are not those of the effects"),
        (("stations", 0, "effects"), lambda v: v[1:], "parameters: are not those of the effects"),
        (("stations", 0, "effects", 5, "joints"), lambda v: ["elbow"], "effects: do not fit the robot"),
        (("stations", 0, "effects", 2, "colour"), None, "joint_offset has no such field"),
        (("provenance",), lambda v: [], "provenance: is a list, not an object"),
        (("stations", 0, "sigma"), lambda v: 1e-4, r"sigma: has shape \(\); expected numbers of shape \(any,\)"),
    ],
)
def test_what_does_not_fit_together_is_refused(path: Path, keys: tuple[str | int, ...], edit: Any, words: str) -> None:
    """Shapes, choices and names that contradict each other are found on reading, with key and expectation."""
    with pytest.raises(ModelFileError, match=words):
        load_model(edited(path, *keys, edit=edit) if edit else edited(path, *keys, value="red"))


@pytest.mark.parametrize("number", ["NaN", "Infinity", "1e999", "null", '"1"', "true", "9" * 400])
@pytest.mark.parametrize("key", ["values", "block", "sigma"])
def test_numbers_that_are_none_are_refused(path: Path, key: str, number: str) -> None:
    """NaN, infinity, null and texts among numbers are named by their key."""
    ways = {"values": ("values",), "block": BLOCK, "sigma": ("stations", 0, "sigma")}

    def marked(numbers: Any) -> Any:
        rows = listed(numbers) if key == "block" else numbers
        return [["mark"] * len(rows) if key == "block" else "mark", *rows[1:]]

    edited(path, *ways[key], edit=marked)
    path.write_text(path.read_text().replace('"mark"', number))

    with pytest.raises(ModelFileError, match=f"{key}: has entries that are not finite numbers"):
        load_model(path)


def test_a_covariance_in_lists_is_read_like_a_packed_one(path: Path) -> None:
    """Files of earlier versions, whose covariance is nested lists, are the same model."""
    packed = load_model(path)
    again = load_model(edited(path, *BLOCK, edit=listed))

    assert np.array_equal(again.covariance, packed.covariance)


def test_a_large_covariance_keeps_what_rounding_leaves() -> None:
    """Each entry to 2^-49 of the standard deviations' product, however far these are apart; at a fifth of the size."""
    rng = np.random.default_rng(4)
    sigma = 10.0 ** rng.uniform(-12.0, 3.0, 400)
    sigma[7] = 0.0
    A = rng.normal(size=(400, 40))
    C = np.outer(sigma, sigma) * (A @ A.T / 40.0 + np.eye(400))
    text = packed_covariance(C)
    again = unpacked(text, 10**7)

    assert len(text) < 0.2 * len(json.dumps(C.tolist()))
    assert np.array_equal(again, again.T)
    scale = np.sqrt(np.diag(C))
    assert np.all(np.abs(again - C) <= 2.0**-49 * np.outer(scale, scale))
    with pytest.raises(Fault, match="truncated or damaged"):
        unpacked(text[:-400] + "=" * 4, 10**7)


@pytest.mark.parametrize("n", [1, 100, 101, 1700, 2501])
def test_a_symmetric_matrix_is_restored_to_the_last_bit(n: int) -> None:
    """Whatever its size; of a large one a half is written, of the largest all."""
    A = np.zeros((n, 3))
    # Full matrices of this size take seconds to pack.
    A[:: 1 + n // 200] = np.random.default_rng(n).normal(size=A[:: 1 + n // 200].shape)
    H = A @ A.T
    text = packed_symmetric(H)

    assert np.array_equal(unpacked(text, H.nbytes + 8), H)
    is_half = 100 < n <= 2500
    assert len(text) < (0.55 if is_half else 1.1) * len(packed_matrix(H))
    if is_half:
        with pytest.raises(Fault, match="truncated or damaged"):
            unpacked(text, H.nbytes // 2)


def test_a_matrix_that_is_hardly_symmetric_is_written_whole() -> None:
    """A last bit on one side of the diagonal is kept."""
    H = np.eye(200)
    H[150, 3] = 2.0**-1000

    assert np.array_equal(unpacked(packed_symmetric(H), 10**6), H)


@pytest.mark.long
def test_a_matrix_that_unpacks_to_gigabytes_costs_nothing(path: Path) -> None:
    """What all matrices of a file may take is bounded before they are unpacked."""
    bomb = base64.b64encode(zlib.compress(bytes(64 << 20))).decode()
    edited(path, *BLOCK, value=f"matrix:{bomb}")
    tracemalloc.start()
    with pytest.raises(ModelFileError, match="block: is truncated or damaged"):
        load_model(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 200 << 20


def test_an_unknown_effect_lists_the_known_ones(path: Path) -> None:
    """A name that no effect has is refused with those that there are, nearest first."""
    with pytest.raises(
        ModelFileError, match=r"effects\[2\]\.name: unknown effect 'joint_ofset'; expected one of joint_offset, "
    ):
        load_model(edited(path, "stations", 0, "effects", 2, "name", value="joint_ofset"))


def test_a_place_that_can_not_be_written_is_named(calibrated: FittedRobot, tmp_path: Path) -> None:
    """No folder, or a folder of this name: an error of the output, and nothing is left behind."""
    with pytest.raises(OutputError, match="can't be written"):
        calibrated.save(tmp_path / "absent" / "model.json")
    (tmp_path / "model.json").mkdir()
    with pytest.raises(OutputError, match="can't be written"):
        calibrated.save(tmp_path / "model.json")

    assert [entry.name for entry in tmp_path.iterdir()] == ["model.json"]


def test_a_model_that_can_not_be_written_leaves_the_old_file(calibrated: FittedRobot, path: Path) -> None:
    """Numbers that are not finite are refused before the file is touched; no draft stays."""
    before = path.read_bytes()
    broken = replace(calibrated.estimate, values=np.full(len(calibrated.values), np.nan))
    with pytest.raises(OutputError, match="not finite"):
        replace(calibrated, estimate=broken).save(path)

    assert path.read_bytes() == before
    assert [entry.name for entry in path.parent.iterdir()] == ["model.json"]
