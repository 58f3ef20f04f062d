"""Elasticity without masses: they are found with the compliances, and no prediction depends on their common factor."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run

from pincal import (
    ELASTIC,
    GEOMETRIC,
    Calibration,
    Measurements,
    Options,
    Robot,
    calibrate,
    load_model,
    read_measurements,
    run_calibration,
)
from pincal.builtin import kuka_urdf_path
from pincal.errors import BadInputError, PincalWarning
from pincal.identify.calibrate import refit
from pincal.identify.choices import along_gauge, found_moments, weight_of
from pincal.identify.mass_error import MassError
from pincal.measure.measurements import measurements_from_arrays
from pincal.model.catalogue.masses import LinkMass, with_masses
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.model import Model
from pincal.report.parameter_sections import moments as moments_section
from pincal.report.subject import Subject
from pincal.robot.arm_of_tree import are_placeholders, are_too_light, guessed_masses
from pincal.simulate import paper_positions
from pincal.simulate.paper_machine import PAYLOAD_COM

TOOL = (0.05, 0.03, 0.12)


def without_inertials(urdf: Path) -> bytes:
    """Return the text of a URDF as most makers publish it."""
    return re.sub(r"<inertial>.*?</inertial>", "", urdf.read_text(encoding="utf-8"), flags=re.DOTALL).encode()


def with_masses_of(urdf: Path, mass: str) -> bytes:
    """Return the text of a URDF in which every link has the same mass."""
    return re.sub(r'<mass value="[^"]*"', f'<mass value="{mass}"', urdf.read_text(encoding="utf-8")).encode()


def paper_table(robot: Robot, n: int, seed: int, payload: np.ndarray | None = None) -> Measurements:
    """Return noise-free readings of the paper's true machine, an independent NumPy program."""
    q = robot.random_configurations(n, np.random.default_rng(seed))
    payload = np.full(n, 125.0) if payload is None else payload
    p = paper_positions(q, tool_offset=TOOL, payload_mass=payload)
    return measurements_from_arrays(robot.joint_names, q, position=p, payload=payload)


def errors(fit, table: Measurements) -> np.ndarray:
    """Return the distances between readings and predictions [m]."""
    return np.linalg.norm(fit.readings(table).residuals(fit.values)[:3], axis=0)


@pytest.fixture(scope="module")
def bare() -> Robot:
    """Return the paper's KUKA without inertials."""
    return Robot.from_urdf(without_inertials(Path(kuka_urdf_path())))


# What is known of masses.


def test_placeholders_are_taken_for_what_they_are() -> None:
    """Links that all weigh the same were given a mass for a program's sake; arms with masses of their own keep them."""
    path = Path(kuka_urdf_path())
    alike, own = Robot.from_urdf(with_masses_of(path, "2")), Robot.from_urdf(path)

    assert len(alike.massless) == 6 and alike.masses.max() > 100.0
    assert own.massless == () and own.unweighed == ()
    assert are_placeholders([1.0] * 7) and not are_placeholders([0.0] * 6) and not are_placeholders([3.0, 3.0])


def with_mass_on(urdf: Path, masses: dict[str, float]) -> bytes:
    """Return the text of a URDF without masses but for these, by link."""
    text = without_inertials(urdf).decode()
    for link, mass in masses.items():
        inertial = f'<inertial><mass value="{mass}"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>'
        text, count = re.subn(rf'<link name="{link}"\s*(/>|>)', rf'<link name="{link}">{inertial}\1', text)
        assert count == 1
        text = text.replace(inertial + "/>", inertial + "</link>").replace(inertial + ">", inertial)
    return text.encode()


@pytest.mark.parametrize("mass", [1e-6, 1e-3, 0.05])
def test_masses_that_no_arm_can_have_are_no_masses(bare: Robot, mass: float) -> None:
    """An exporter's grams on the frame of a tool leave the arm as it is without any, and are told."""
    path = Path(kuka_urdf_path())
    told = r"has 0\.05 kg|has 0\.001 kg|has 1e-06 kg"
    with pytest.warns(PincalWarning, match=rf"({told}) for what joint_6 moves, which no arm of this reach .*--mass"):
        found = Robot.from_urdf(with_mass_on(path, {"tool0": mass}))

    assert len(found.massless) == 6
    np.testing.assert_array_equal(found.masses, bare.masses)
    np.testing.assert_array_equal(found.centres, bare.centres)
    # A mass that the arm can have is one.
    kept = Robot.from_urdf(with_mass_on(path, {"tool0": 20.0}))
    assert len(kept.massless) == 5 and kept.masses[-1] == 20.0 and not kept.notes


def test_an_arm_is_a_hundredth_of_an_industrial_one_at_least() -> None:
    """And a link two thousandths; published arms, cobots and toys among them, weigh more and keep their masses."""
    ends = np.array([[[0.0, 0.0, i], [0.0, 0.0, i + 1.0]] for i in range(3)])
    usual, _ = guessed_masses(np.zeros(3), ends, np.ones(3, bool))
    for factor, light in ((0.0099, True), (0.0101, False)):
        assert are_too_light(factor * usual, ends, range(-1, 2)).tolist() == [light] * 3
    for factor, light in ((0.0019, True), (0.0021, False)):
        assert are_too_light([1.0, 1.0, factor] * usual, ends, range(-1, 2)).tolist() == [False, False, light]
    for name in ("ur10", "panda", "so100", "kinova", "talos"):
        assert Robot.from_urdf(name).massless == (), name


def test_masses_are_guessed_from_the_shape() -> None:
    """Weight falls off along the arm, centres lie between the joints, and what is known sets the scale."""
    ends = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [1.0, 0.0, 2.0], [1.0, 0.0, 1.0]])
    known = np.array([False, True, False])
    masses, centres = guessed_masses(np.array([0.0, 10.0, 0.0]), ends, ~known)

    np.testing.assert_allclose(masses, [20.0, 10.0, 5.0])
    np.testing.assert_allclose(centres, [[0.0, 0.0, 1.0], [0.5, 0.0, 2.0], [1.0, 0.0, 1.5]])
    masses, _ = guessed_masses(np.zeros(3), ends, np.ones(3, bool), total=100.0)
    np.testing.assert_allclose(masses, [40.0, 20.0, 10.0])


def test_a_guess_is_near_the_masses_of_a_real_arm(bare: Robot, kuka: Robot) -> None:
    """Of the paper's KUKA all links together are guessed to a third, and on the data sheet's mass better."""
    assert bare.masses.sum() == pytest.approx(kuka.masses.sum(), rel=0.33)
    told = Robot.from_urdf(without_inertials(Path(kuka_urdf_path())), mass=975.0)
    assert told.masses.sum() == pytest.approx(kuka.masses.sum(), rel=0.05)


def test_a_mass_that_is_none_is_refused() -> None:
    """The mass of a robot is more than nothing."""
    for mass in (0.0, -3.0, np.inf, np.nan):
        with pytest.raises(BadInputError, match="mass of the robot"):
            Robot.from_urdf("ur10", mass=mass)


def test_masses_join_the_model_where_they_matter(bare: Robot, kuka: Robot) -> None:
    """Not beside rigid geometry, not where the URDF has them, and only of the links that it has none for."""
    assert with_masses(bare, GEOMETRIC) == GEOMETRIC == with_masses(bare, (*GEOMETRIC, LinkMass()))
    assert with_masses(kuka, ELASTIC) == ELASTIC
    assert with_masses(bare, ELASTIC) == (*ELASTIC, LinkMass()) == with_masses(bare, (*ELASTIC, LinkMass()))
    some = replace(kuka, massless=("link_4", "link_6"))
    assert with_masses(some, ELASTIC) == (*ELASTIC, LinkMass(("joint_4", "joint_6")))


# The gauge.


@pytest.mark.long
def test_predictions_do_not_depend_on_the_gauge(bare: Robot, rng: np.random.Generator) -> None:
    """All masses times c and all compliances over c predict the same, whatever they are."""
    model = Model(Chain.of(bare), (*ELASTIC, LinkMass()))
    conditions = Conditions.at(bare.random_configurations(20, rng))
    values = np.zeros(model.n_parameters)
    nominal = np.array([parameter.nominal for parameter in model.parameters])
    soft = np.array([parameter.unit == "rad/(N m)" for parameter in model.parameters])
    heavy = np.array([parameter.unit.startswith("kg") for parameter in model.parameters])
    values[soft] = rng.uniform(0.0, 1e-6, soft.sum())
    values[heavy] = 0.1 * nominal[heavy] + rng.uniform(-3.0, 3.0, heavy.sum())
    expected = model.predict(values, conditions)
    for factor in (0.1, 3.0):
        other = values.copy()
        other[soft] /= factor
        other[heavy] = factor * (nominal + values)[heavy] - nominal[heavy]
        np.testing.assert_allclose(model.predict(other, conditions), expected, rtol=0.0, atol=1e-14)


@pytest.mark.long
@pytest.mark.parametrize(
    ("folder", "frame", "limit_um"), [("elastic_after", "after", 14.0), ("elastic_paper", "paper", 16.0)]
)
def test_elastic_arms_are_predicted_without_their_masses(
    shared_data: Path, folder: str, frame: str, limit_um: float
) -> None:
    """With inertials thrown away held-out poses are predicted nearly as with them, and alike whatever mass is told."""
    found = []
    for mass in (None, 112.0):
        robot = Robot.from_urdf(without_inertials(shared_data / folder / "robot.urdf"), mass=mass)
        train = read_measurements(shared_data / folder / "train.csv", robot.joint_names)
        held = read_measurements(shared_data / folder / "heldout.csv", robot.joint_names)
        fit = calibrate(robot, train, Options(moment_frame=frame))
        found.append(fit.readings(held).residuals(fit.values))
        assert fit.solution.converged
        assert 1e6 * np.sqrt(np.mean(np.sum(found[-1] ** 2, axis=0))) <= limit_um
        masses = robot.masses + fit.estimate.take(f"{j}.mass" for j in robot.joint_names).values
        assert 0.5 * robot.masses.sum() < masses.sum() < 2.0 * robot.masses.sum()
    np.testing.assert_allclose(found[1], found[0], rtol=0.0, atol=1e-8)


@pytest.mark.long
def test_the_kuka_of_the_paper_is_found_without_its_masses(bare: Robot) -> None:
    """Noise-free, other poses are predicted to 1 um, with one payload and with several."""
    for payload in (np.full(120, 125.0), np.resize([0.0, 60.0, 125.0], 120)):
        fit = calibrate(bare, paper_table(bare, 120, 0, payload), Options(payload_centre=PAYLOAD_COM))

        assert errors(fit, paper_table(bare, 200, 1, np.resize(payload, 200))).max() < 1e-6


def test_payloads_make_masses_absolute(bare: Robot, kuka: Robot) -> None:
    """Where the payload changes, the moment at the shoulder is found as it is; with one payload only its proportions."""
    tables = [paper_table(bare, 120, 0, np.resize(loads, 120)) for loads in ([0.0, 60.0, 125.0], [0.0])]
    rng, moments, sigmas = np.random.default_rng(3), [], []
    pose = Conditions.at(np.array([[0.0, -0.3, 0.2, 0.0, 0.3, 0.0]]))
    for table in tables:
        noisy = table.with_readings(position=table.position + 2e-5 * rng.standard_normal(table.position.shape))
        fit = calibrate(bare, noisy, Options(payload_centre=PAYLOAD_COM, sigma=2e-5))
        moments.append(float(fit.model.static_moments(fit.model_values, pose)[0, 5]))
        sigmas.append(
            float(
                fit.estimate.sigma[fit.estimate.index(f"{bare.joint_names[1]}.k_z")]
                / fit.values[fit.estimate.index(f"{bare.joint_names[1]}.k_z")]
            )
        )
    rigid = Model(Chain.of(kuka), ELASTIC)
    truth = float(rigid.static_moments(np.zeros(rigid.n_parameters), pose)[0, 5])

    assert moments[0] == pytest.approx(truth, rel=0.03)
    assert abs(sigmas[0]) < 0.03 < 0.15 < abs(sigmas[1])


@pytest.mark.long
def test_an_earlier_fit_is_weighed_anew(bare: Robot) -> None:
    """Payloads that come after a fit without any change all masses at once: what is found is what the joint fit finds."""
    options = Options(payload_centre=PAYLOAD_COM, sigma=5e-5)
    rng = np.random.default_rng(8)

    def noisy(n: int, seed: int, loads: list[float]) -> Measurements:
        table = paper_table(bare, n, seed, np.resize(loads, n))
        return table.with_readings(position=table.position + 5e-5 * rng.standard_normal(table.position.shape))

    old, new = noisy(300, 0, [0.0]), noisy(40, 5, [0.0, 60.0, 125.0])
    first = calibrate(bare, old, options)
    later = calibrate(bare, new, replace(options, earlier=first.robot_estimate))
    both = calibrate(bare, {"old": old, "new": new}, options)
    for load in (0.0, 125.0):
        others = paper_table(bare, 200, 7, np.full(200, load))
        there = both.at("new").predict(both.fit.readings(others, station="new").conditions)
        joint = np.linalg.norm(there[:, :, 3] - others.position, axis=1)
        assert np.sqrt(np.mean(errors(later, others) ** 2)) < 1.2 * np.sqrt(np.mean(joint**2))


def test_a_robot_along_its_gauge_is_the_same(bare: Robot) -> None:
    """An estimate with other masses and compliances to match predicts what it did, and is known as well relative to them."""
    fit = calibrate(bare, paper_table(bare, 60, 0, np.zeros(60)), Options(sigma=5e-5))
    moved = along_gauge(fit.problem, fit.estimate, 1.7)
    conditions = Conditions.at(bare.random_configurations(10, np.random.default_rng(1)))

    assert weight_of(fit.problem, moved) == pytest.approx(1.7 * weight_of(fit.problem, fit.estimate))
    poses, jacobian = (of[:, :3] for of in fit.model.linearise(fit.values, conditions))
    again, other = (of[:, :3] for of in fit.model.linearise(moved.values, conditions))
    np.testing.assert_allclose(again, poses, rtol=0.0, atol=1e-13)
    spreads = [
        np.einsum("nip,pq,niq->ni", J, of.dense_covariance(), J) for J, of in ((jacobian, fit.estimate), (other, moved))
    ]
    np.testing.assert_allclose(spreads[1], spreads[0], rtol=1e-6)


# Beside the rest.


def test_what_is_known_of_some_masses_is_doubted_of_these_alone(kuka: Robot) -> None:
    """Masses that are parameters are no longer uncertain beside the model; those of the URDF are."""
    values = {"joint_2.k_z": 1e-7}
    for joints, links in (((), (0, 1, 2, 3, 4, 5)), (("joint_4", "joint_6"), (0, 1, 2, 4)), (None, ())):
        model = Model(Chain.of(kuka), (*ELASTIC, LinkMass(joints)))
        found = MassError.of(model, np.array([values.get(name, 0.0) for name in model.names]))
        assert (() if found is None else found.links) == links
        if found is not None:
            assert len(found.parameters(model.chain)) == 4 * len(links)
            Model(model.chain, (*model.effects, found)).index("joint_1.mass")


@pytest.fixture(scope="module")
def found(bare: Robot) -> Calibration:
    """Return a calibration of the paper's KUKA without its masses, every row with one payload."""
    table = paper_table(bare, 160, 0, np.zeros(160))
    noise = 2e-5 * np.random.default_rng(3).standard_normal(table.position.shape)
    return run_calibration(bare, table.with_readings(position=table.position + noise), Options(sigma=2e-5))


def test_the_moments_that_are_identified_are_those_of_the_machine(found: Calibration, kuka: Robot) -> None:
    """Up to their common factor, which is said to be unknown, moments that are called identified are the true ones."""
    moments = found_moments(found.fit.fit)
    assert moments is not None and len(moments.links) == 6 and 0.05 < moments.factor_sigma < 0.5
    true = Model(Chain.of(kuka), ELASTIC)
    n = true.static_moments(np.zeros(true.n_parameters), Conditions.at(moments.q[None]))[0]
    truth = {(joint, axis): n[3 * i + k] for i, joint in enumerate(kuka.joint_names) for k, axis in enumerate("xyz")}
    factor = moments.largest.moment / truth[moments.largest.joint, moments.largest.axis]
    identified = [axis for axis in moments.axes if axis.is_identified]

    assert len(identified) >= 5 and moments.largest in identified
    for axis in identified:
        error = axis.moment - factor * truth[axis.joint, axis.axis]
        assert abs(error) < 4.0 * axis.sigma + 0.01 * abs(moments.largest.moment)


def test_what_is_known_of_masses_is_said(found: Calibration) -> None:
    """The page has the moments, a note says what masses were found, and no mass is called indistinguishable."""
    section = moments_section(Subject(found, {}, ()))
    (note,) = [note.text for note in found.result.warnings if "masses" in note.text]
    rows = [row for row in found.result.parameters if row.effect == LinkMass.name]

    assert section is not None and "for 6 links" in note and "predictions do not depend" in note
    assert {row.status for row in rows} <= {"identified", "prior"} and len(rows) == 24
    (rigid,) = [note for note in found.fit.export_urdf().notes if "link_mass" in note]
    assert "rigid arm" in rigid


def test_masses_go_when_elasticity_goes(bare: Robot, tmp_path: Path) -> None:
    """A fit with them is saved, loaded and predicts the same; made rigid again it has none."""
    table = paper_table(bare, 60, 0)
    fit = calibrate(bare, table, Options(payload_centre=PAYLOAD_COM, sigma=5e-5))
    fit.save(tmp_path / "model.json")
    loaded = load_model(tmp_path / "model.json")

    np.testing.assert_array_equal(loaded.predict(table.q, payload=125.0), fit.predict(table.q, payload=125.0))
    assert not any(p.effect == LinkMass.name for p in refit(fit.fit, GEOMETRIC).problem.parameters)
    assert "link_mass" in {p.effect for p in refit(refit(fit.fit, GEOMETRIC), ELASTIC).problem.parameters}


@pytest.mark.long
def test_no_verb_refuses_a_robot_without_masses(tmp_path: Path) -> None:
    """From a simulated table to a design of the next one, every verb goes along with elasticity."""
    urdf, old, new = tmp_path / "bare.urdf", tmp_path / "old.csv", tmp_path / "new.csv"
    urdf.write_bytes(without_inertials(Path(kuka_urdf_path())))
    model, noise = tmp_path / "fit" / "model.json", ("--noise", "0.05mm")
    assert run("simulate", urdf, "--poses", "300", *noise, "--out", old) == 0
    assert run("simulate", urdf, "--poses", "20", "--pose-seed", "5", *noise, "--out", new) == 0
    assert run("check", urdf, old, *noise) == 0
    assert run("calibrate", urdf, old, *noise, "--mass", "975", "--out", tmp_path / "fit", "--quiet") == 0
    assert {"calibrated.urdf", "model.json"} <= {path.name for path in (tmp_path / "fit").iterdir()}
    assert run("predict", model, new, "--out", tmp_path / "predicted.csv") == 0
    assert run("compensate", model, new, "--out", tmp_path / "commands.csv") == 0
    assert run("validate", model, new) == 0
    assert run("diagnose", model, new, "--out", tmp_path / "diagnosis") == 0
    assert run("update", model, new, "--out", tmp_path / "updated") == 0
    assert run("design", urdf, "--poses", "30", "--candidates", "100", "--out", tmp_path / "poses.csv") == 0


@pytest.mark.long
def test_a_name_is_found_beside_unknown_masses(tmp_path: Path) -> None:
    """A gear's eccentricity on a bending arm without masses is named, and nothing else."""
    urdf, table = tmp_path / "bare.urdf", tmp_path / "table.csv"
    urdf.write_bytes(without_inertials(Path(kuka_urdf_path())))
    hidden = ("--effect", "gear_eccentricity:joint_4:size=2e-4,order=1")
    assert run("simulate", urdf, "--poses", "400", "--noise", "0.05mm", *hidden, "--out", table) == 0
    assert run("discover", urdf, table, "--noise", "0.05mm", "--stability", "0", "--out", tmp_path / "found", "--quiet") == 0
    found = json.loads((tmp_path / "found" / "discovery.json").read_text(encoding="utf-8"))
    named = {(of["effect"], of["joint"]) for of in found["effects"] if not of["effect"].endswith("_elasticity")}

    assert named == {("gear_eccentricity", "joint_4")} and found["verdict"] == "adequate"


@pytest.mark.long
@pytest.mark.rates
def test_intervals_of_predictions_cover(bare: Robot) -> None:
    """Over 200 draws of noise 95 % intervals of predictions cover 93 to 97 %, although the masses were not known."""
    options = Options(payload_centre=PAYLOAD_COM, sigma=5e-5)
    exact, others = paper_table(bare, 120, 0), paper_table(bare, 100, 1)
    rng, inside = np.random.default_rng(7), []
    for _ in range(200):
        noise = 5e-5 * rng.standard_normal(exact.position.shape)
        fit = calibrate(bare, exact.with_readings(position=exact.position + noise), options)
        predicted, sigma = fit.predict(fit.readings(others).conditions, return_sigma=True)
        inside.append(np.abs(predicted[:, :, 3] - others.position) < 1.96 * sigma)

    assert 0.93 < np.mean(inside) < 0.97
