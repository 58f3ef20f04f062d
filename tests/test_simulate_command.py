"""``pincal simulate``: what a user asks for is what the table and the truth hold."""

import json
import re

import numpy as np
import pytest
from command_line import run

from pincal import Robot, read_measurements
from pincal.builtin import kuka_urdf_path
from pincal.errors import BadInputError
from pincal.simulate import HIDDEN_EFFECTS, TrueMachine, plan_poses
from pincal.simulate.cli.simulate import effect_help, parse_effect
from pincal.simulate.tracker import ReadingEffect
from pincal.simulate.typical import draw_typical_elasticity, typical_effect, typical_moments

URDF = str(kuka_urdf_path())
JOINTS = tuple(f"joint_{i}" for i in range(1, 7))


def simulate(folder, *arguments, poses=40, name="data", urdf=URDF):
    """Run the command; return the table's columns and the truth."""
    files = ["--out", folder / f"{name}.csv", "--truth", folder / f"{name}.json"]
    chosen = [] if "--at" in arguments else ["--poses", poses]
    assert run("simulate", urdf, *chosen, *files, "--quiet", *arguments) == 0
    lines = (folder / f"{name}.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    columns = dict(zip(lines[0].split(","), map(list, zip(*rows, strict=True)), strict=True))
    return columns, json.loads((folder / f"{name}.json").read_text())


def positions(columns):
    return np.column_stack([columns[axis] for axis in "xyz"]).astype(float)


@pytest.fixture(scope="module")
def machine():
    return draw_typical_elasticity(TrueMachine.from_urdf(URDF, tip="tool0"), np.random.default_rng(0))


@pytest.mark.long
@pytest.mark.usefixtures("here")
def test_a_hidden_effect_is_found_again(tmp_path, capsys):
    """A simulated table goes straight into discover, which names the effect and shrinks the gap to the noise."""
    arguments = ["--payload", "0,80", "--payload-com", ".02", ".01", ".1", "--masses-off", "3"]
    simulate(tmp_path, *arguments, "--effect", "gear_eccentricity:joint_1:size=2e-4", poses=150)
    assert "gear_eccentricity of joint_1, size 0.0002 rad, moves the target by 0.2" in capsys.readouterr().out
    out = ["--out", tmp_path / "out", "--noise", "0.05mm", "--payload-com", ".02", ".01", ".1", "--json", "--quiet"]
    assert run("discover", URDF, tmp_path / "data.csv", "--stability", "4", *out) == 0
    report = json.loads(capsys.readouterr().out)
    often = {entry["effect"]: entry["stability"] for entry in report["effects"]}
    assert often["gear_eccentricity"]["named"] == often["gear_eccentricity"]["of"] == 4

    named = [(entry["effect"], entry["joint"]) for entry in report["effects"]]
    assert named[-1] == ("gear_eccentricity", "joint_1")
    assert report["gap"]["after"]["rms_mm"] < 1.3 * report["noise_floor_mm"] < 0.3 * report["gap"]["before"]["rms_mm"]


def test_truth_tells_what_was_put_in(tmp_path):
    """Errors, effects with their units and what they do, noise and seeds stand in one file."""
    _, truth = simulate(tmp_path, "--effect", "backlash:joint_2", "--seed", "5", "--noise", "20um", "--masses-off", "3")

    assert truth["noise"] == {"sigma_m": pytest.approx(2e-5), "sigma_rad": None}
    assert (truth["seed"], truth["pose_seed"], truth["poses"], truth["tip"]) == (5, 5, 40, "tool0")
    (effect,) = truth["effects"]
    assert (effect["effect"], effect["joint"], effect["size"], effect["unit"]) == ("backlash", "joint_2", 2e-4, "rad")
    assert 0.05 < effect["moves_target_rms_mm"] < 0.5
    assert set(truth["geometry"]["placement_errors"]) == {*JOINTS, "tool0"}
    assert all(0.85 < factor < 1.15 and factor != 1.0 for factor in truth["mass_factors"].values())
    assert all(compliance["k_z"] > 0.0 for compliance in truth["compliance"].values())


def test_the_truth_is_what_was_measured(tmp_path):
    """A machine built from the truth by hand gives the positions of the table."""
    columns, truth = simulate(tmp_path, "--noise", "0mm", "--elastic", "0", "--effect", "gear_ratio:joint_3:size=1e-4")
    errors = truth["geometry"]["placement_errors"].values()
    rebuilt = TrueMachine.from_urdf(
        URDF,
        tip="tool0",
        placement_errors=np.array([e["translation_m"] + e["rotation_rad"] for e in errors]),
        joint_offsets=list(truth["geometry"]["joint_offsets"].values()),
    )
    q = np.column_stack([columns[name] for name in JOINTS]).astype(float)
    turned = q + np.array([0, 0, 1e-4, 0, 0, 0]) * q
    (target,) = truth["targets"].values()
    seen = np.array(truth["T_instrument_base"]) @ rebuilt.tip(turned) @ np.array(target)

    np.testing.assert_allclose(positions(columns), seen[:, :3, 3], rtol=0, atol=1e-12)


def test_the_same_seed_gives_the_same_file(tmp_path):
    """Byte for byte; another seed does not."""
    arguments = ["--effect", "joint_scatter", "--payload", "0,50", "--with", "temperature"]
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        simulate(tmp_path, *arguments, "--seed", seed, name=name)
    a, b, c = ((tmp_path / f"{name}.csv").read_bytes() for name in "abc")

    assert a == b != c


def test_a_pose_seed_measures_the_same_machine_elsewhere(tmp_path):
    """Other poses, the same machine, instrument and target: rows to validate on."""
    (first, one), (second, other) = (
        simulate(tmp_path, "--effect", "axis_wobble", "--pose-seed", seed, name=f"t{seed}") for seed in (1, 2)
    )
    same = ("geometry", "compliance", "T_instrument_base", "targets")

    assert first["joint_1"] != second["joint_1"]
    assert all(one[key] == other[key] for key in same)
    assert one["effects"][0]["joint"] == other["effects"][0]["joint"]


def test_a_setup_seed_moves_the_instrument_and_nothing_else(tmp_path):
    """The machine and its poses are the same; instrument and target stand elsewhere."""
    (first, one), (second, other) = (
        simulate(tmp_path, "--effect", "axis_wobble", "--setup-seed", seed, name=f"s{seed}") for seed in (1, 2)
    )

    assert first["joint_1"] == second["joint_1"] and first["x"] != second["x"]
    assert one["geometry"] == other["geometry"] and one["compliance"] == other["compliance"]
    assert one["T_instrument_base"] != other["T_instrument_base"] and one["targets"] != other["targets"]


def test_given_poses_are_measured_as_they_are(tmp_path):
    """Joints and conditions of another table are kept."""
    given, _ = simulate(tmp_path, "--payload", "0,40", "--with", "time", poses=12, name="given")
    again, _ = simulate(tmp_path, "--at", tmp_path / "given.csv", "--noise", "0mm", name="again")

    for name in (*JOINTS, "payload", "time"):
        assert again[name] == given[name]
    assert np.abs(positions(again) - positions(given)).max() < 5e-4


@pytest.mark.parametrize(
    ("arguments", "present", "absent"),
    [
        (["--effect", "backlash:joint_2"], {f"approach_{joint}" for joint in JOINTS}, {"temperature", "payload"}),
        (["--effect", "thermal_expansion"], {"temperature"}, {"time", "approach_joint_1"}),
        (["--effect", "base_drift", "--hide", "time"], set(), {"time"}),
        (["--effect", "backlash:joint_2", "--hide", "approach"], set(), {"approach_joint_1"}),
        (["--payload", "80", "--with", "time"], {"payload", "time"}, {"temperature"}),
        (["--sensor", "pose"], {"x", "qw"}, {"distance"}),
        (["--sensor", "distance", "--targets", "3"], {"distance", "target"}, {"x"}),
    ],
)
def test_tables_have_the_columns_that_matter_and_can_be_read(tmp_path, arguments, present, absent):
    """An effect brings the column that it needs, unless this is hidden; the reader knows every column."""
    columns, _ = simulate(tmp_path, *arguments, poses=8)
    rows = read_measurements(tmp_path / "data.csv", JOINTS)

    assert present <= columns.keys()
    assert not absent & columns.keys()
    assert len(rows) == 24 if "--targets" in arguments else 8


@pytest.mark.parametrize(("order", "expected"), [("blocks", [0, 0, 50, 50]), ("alternating", [0, 50, 0, 50])])
def test_payloads_come_in_blocks_or_in_turn(tmp_path, order, expected):
    """As the user chooses."""
    columns, _ = simulate(tmp_path, "--payload", "0,50", "--payload-order", order, poses=4)

    assert [float(load) for load in columns["payload"]] == expected


def test_nothing_wrong_is_the_nominal_robot(tmp_path, kuka):
    """Without errors, elasticity and noise the table is the URDF's forward kinematics."""
    columns, truth = simulate(tmp_path, "--errors", "0", "--elastic", "0", "--noise", "0", "--instrument", "base",
                              "--tool", "0", "0", "0")  # fmt: skip
    q = np.column_stack([columns[name] for name in JOINTS]).astype(float)

    np.testing.assert_allclose(positions(columns), kuka.forward_kinematics(q)[:, :3, 3], rtol=0, atol=1e-12)
    assert truth["effects"] == []


@pytest.mark.parametrize("name", HIDDEN_EFFECTS)
def test_every_effect_has_a_typical_size(machine, name):
    """It moves the tool by what one looks for in residuals, at any joint that has it, and shows up in the help."""
    effect = typical_effect(machine, name, np.random.default_rng(1))
    rng = np.random.default_rng(0)
    q = plan_poses(machine.nominal, 20, rng)
    conditions = {"payload": 60.0, "temperature": 30.0, "time": 1e4, "approach": rng.choice([-1, 1], (20, 6))}
    conditions["velocity"] = rng.uniform(-1.0, 1.0, (20, 6))
    scatter = rng.standard_normal((20, 6))
    tips = [m.tip(q, scatter=scatter, **conditions) for m in (machine, machine.with_effects(effect))]
    moved = np.linalg.norm(tips[1][:, :3, 3] - tips[0][:, :3, 3], axis=1).max()

    assert f"  {name}" in effect_help()
    assert effect.unit in effect_help()
    # An error of the instrument moves what it reads, and not the tool.
    assert moved == 0.0 if isinstance(effect, ReadingEffect) else 5e-6 < moved < 3e-3


def test_moments_are_those_of_the_arms_class(machine):
    """A heavy arm's shoulder carries kilonewton metres, its wrist hundreds of newton metres."""
    moments = typical_moments(machine)

    assert 3e3 < moments[1] < 3e4
    assert 50.0 < moments[5] < 1e3


def test_effects_are_read_from_the_command_line():
    """Joint, numbers, whole numbers, words, truth values and vectors, in any order."""
    assert parse_effect("base_drift:size=1e-8,direction=1/0/0", JOINTS) == (
        "base_drift",
        {"size": 1e-8, "direction": (1.0, 0.0, 0.0)},
    )
    assert parse_effect("joint_coupling:source=joint_4:joint_5", JOINTS)[1] == {"source": "joint_4", "joint": "joint_5"}
    assert parse_effect("transmission_error:joint_1:periodic=false,bumps=5", JOINTS)[1] == {
        "joint": "joint_1",
        "periodic": False,
        "bumps": 5,
    }


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("gear_ecentricity", "expected one of gear_eccentricity"),
        ("backlash:joint_9", "expected one of joint_1"),
        ("joint_coupling:joint_5:source=joint_9", "expected one of joint_1"),
        ("backlash:joint_2:sise=1", "backlash has size"),
        ("backlash:joint_2:size", "joint 'size'"),
        ("backlash:joint_2:size=big", "expected a number"),
        ("backlash:joint_2:size=nan", "expected a number"),
        ("backlash:joint_2:size=1e-4,size=2e-4", "twice"),
        ("backlash:joint_2:joint_3", "twice"),
        ("gear_eccentricity:joint_1:order=1.5", "whole number"),
        ("base_drift:direction=1/0", "three numbers"),
        ("axis_wobble:joint_1:frame=above", "before, after"),
    ],
)
def test_wrong_effects_are_refused_with_what_is_known(text, words):
    """Name, joint, key or value: the message lists what there is."""
    with pytest.raises(BadInputError, match=words):
        parse_effect(text, JOINTS)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--tip", "hand"], "unknown link 'hand'"),
        (["--floor", "9"], "--no-floor"),
        (["--sensor", "sonar"], "position, pose, distance"),
        (["--effect", "base_drift:joint_1"], "whole arm"),
        (["--effect", "joint_coupling:joint_2:source=joint_2"], "its own source"),
        (["--effect", "gear_eccentricity:joint_1:order=3"], "expected 1 or 2"),
        (["--effect", "joint_elasticity:joint_2:size=1"], "smaller"),
        (["--truth", "data.csv"], "two files"),
        (["--truth", "."], "is a folder"),
        (["--truth", "nowhere/truth.json"], "can't be written"),
        (["--out", "nowhere/data.csv", "--truth", "truth.json"], "can't be written"),
        (["--tool", "0", "0", "0", "--targets", "2"], "one target"),
    ],
)
def test_bad_input_is_refused_and_nothing_is_written(tmp_path, monkeypatch, capsys, arguments, words):
    """Exit 3, a message that helps, and no file, not even half of one."""
    monkeypatch.chdir(tmp_path)
    assert run("simulate", URDF, "--poses", "5", "--out", "data.csv", *arguments) == 3

    printed = capsys.readouterr()
    assert words in printed.err
    assert "Traceback" not in printed.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [[], ["--poses", "5", "--at", "x.csv"], ["--poses", "5", "--payload", "-1"],
                                       ["--poses", "5", "--noise", "5"], ["--poses", "5", "--errors", "nan"],
                                       ["--poses", "0"], ["--poses", "5", "--seed", "-1"]])  # fmt: skip
def test_wrong_usage_exits_with_two(tmp_path, arguments):
    """Neither or both sources of poses, and quantities that are none."""
    assert run("simulate", URDF, "--out", tmp_path / "data.csv", *arguments) == 2


def test_a_robot_without_masses_gets_some(tmp_path, capsys):
    """Plausible masses are drawn, lighter towards the tip, and said; they bend the arm as those of the URDF do."""
    text = kuka_urdf_path().read_text()
    own = [float(mass) for mass in re.findall('<mass value="([^"]*)"', text)]
    (tmp_path / "bare.urdf").write_text(re.sub("<inertial>.*?</inertial>", "", text, flags=re.DOTALL))
    _, truth = simulate(tmp_path, "--effect", "link_bending", urdf=tmp_path / "bare.urdf")
    drawn = [*truth["drawn_masses_kg"].values()]

    assert f"{sum(drawn):.3g} kg were drawn" in capsys.readouterr().out
    assert 0.3 * sum(own) < sum(drawn) < 3.0 * sum(own) and drawn[0] > drawn[-1] > 0.0
    assert all(row["k_z"] > 0.0 for row in truth["compliance"].values())
    assert truth["effects"][0]["moves_target_rms_mm"] > 0.01
    rigid = simulate(tmp_path, "--elastic", "0", urdf=tmp_path / "bare.urdf")[1]
    assert rigid["drawn_masses_kg"] == truth["drawn_masses_kg"] and rigid["geometry"] == truth["geometry"]
    assert "drawn_masses_kg" not in simulate(tmp_path)[1]


def test_a_robot_of_the_library_is_found_by_its_name(tmp_path, capsys):
    """``ur10`` needs no path, and the next command is told."""
    columns, _ = simulate(tmp_path, "--effect", "transmission_error:elbow_joint", urdf="ur10", poses=5)

    assert tuple(columns)[:6] == Robot.from_urdf("ur10").joint_names
    assert f"pincal check ur10 {tmp_path / 'data.csv'}" in capsys.readouterr().out


def test_help_shows_an_example_and_the_catalogue(capsys):
    """``--help`` ends with lines to copy and every effect."""
    assert run("simulate", "--help") == 0
    text = capsys.readouterr().out

    assert "pincal simulate robot.urdf --poses 300" in text
    assert "gear_eccentricity:JOINT: size [rad], order, phase" in text
