"""Acceptance by calibrated lengths: closed forms, the rule of ISO 14253-1, the plan, and the command on a real arm."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from scipy.optimize import least_squares, minimize

from pincal import Robot
from pincal.acceptance.decided_errors import decided
from pincal.acceptance.enclosing_sphere import smallest_sphere
from pincal.acceptance.lengths import Contacts, Permitted, acceptance
from pincal.acceptance.probing import KnownSphere, probing
from pincal.design.acceptance_plan import plan_acceptance
from pincal.design.probing_plan import plan_probing, points_on_hemisphere
from pincal.design.reach import Limits, Reach, SensorSetup
from pincal.errors import MeasurementError, PincalWarning
from pincal.sensors.setup import KnownDistance

SOCKETS = Path(__file__).parents[2] / "shared" / "data" / "holiday_sockets"
needs_sockets = pytest.mark.skipif(not SOCKETS.exists(), reason="measurements of shared/data are absent")


def test_the_smallest_sphere_is_that_of_closed_forms_and_of_a_search(rng: np.random.Generator) -> None:
    """A cube's corners have half its diagonal; of random points no centre gives a smaller largest distance."""
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
    assert smallest_sphere(corners).radius == pytest.approx(3.0**0.5)
    assert smallest_sphere(np.array([[1.0, 2.0, 3.0]])).radius == 0.0
    assert smallest_sphere(np.array([[0.0, 0, 0], [0.0, 0, 2.0], [0.0, 0, 2.0]])).radius == pytest.approx(1.0)
    for n in (3, 7, 40):
        points = rng.standard_normal((n, 3))
        found = smallest_sphere(points)
        assert found.holds(points)
        searched = minimize(
            lambda at, points=points: np.linalg.norm(points - at, axis=1).max(),
            points.mean(axis=0),
            method="Nelder-Mead",
            options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 4000},
        )
        assert found.radius == pytest.approx(searched.fun, rel=1e-3) and found.radius <= searched.fun + 1e-9


def contacts(*positions: float, sigma: float = 0.0) -> Contacts:
    """Return contacts with the seats a and b in turn, at these places along x, all errors their own."""
    place = np.array(positions)[:, None] * [1.0, 0.0, 0.0]
    n = len(place)
    covariance = sigma**2 * np.einsum("nm,ab->namb", np.eye(n), np.eye(3))
    return Contacts(np.array(["a", "b"] * (n // 2)), place, covariance)


def test_errors_of_lengths_are_those_of_the_standard() -> None:
    """A length of 500 mm, read .1 mm too long and .3 mm too short; the seat b is found .4 mm apart."""
    length = KnownDistance("a", "b", 0.5, 1e-5)
    found = acceptance(contacts(0.0, 0.5001, 0.0, 0.4997, sigma=1e-4), [length], Permitted(2e-4, 1e-4))
    (errors,) = found.lengths
    assert errors.errors == pytest.approx([1e-4, -3e-4]) and errors.worst == pytest.approx(-3e-4)
    assert errors.permitted == pytest.approx(2.5e-4) and found.outcome == "fail"
    assert errors.stated == pytest.approx([2.0**0.5 * 1e-4] * 2)
    assert errors.within_stated == 1
    assert "2 lengths where ISO 10360 asks for 105" in found.scope
    found = acceptance(contacts(0.0, 0.5001, 0.0, 0.4997), [length], Permitted(4e-4, 0.0), permitted_location=5e-4)
    by_seat = {each.seat: each.diameter for each in found.locations}
    assert by_seat == pytest.approx({"a": 0.0, "b": 4e-4}) and found.outcome == "pass"
    assert found.to_dict()["lengths"][0]["worst_mm"] == pytest.approx(-0.3)


def test_a_decision_leaves_the_uncertainty_of_the_test() -> None:
    """Proven within, proven beyond, or neither, by two standard uncertainties."""
    assert decided(1.79e-4, 2e-4, 1e-5) == "pass" and decided(-1.81e-4, 2e-4, 1e-5) == "undecided"
    assert decided(2.19e-4, 2e-4, 1e-5) == "undecided" and decided(-2.21e-4, 2e-4, 1e-5) == "fail"


def test_wrong_acceptances_are_as_rare_as_stated(rng: np.random.Generator) -> None:
    """Of lengths whose error is at the limit, 2.3 % pass where the artefact's uncertainty is all of it."""
    passed = [decided(2e-4 + 1e-5 * rng.standard_normal(), 2e-4, 1e-5) == "pass" for _ in range(4000)]
    assert np.mean(passed) < 0.0228 + 3.0 * (0.0228 * 0.98 / 4000) ** 0.5


def test_contacts_without_a_partner_are_told() -> None:
    """Two contacts with one end and one with the other make one length, and a warning."""
    uneven = contacts(0.0, 0.5001, 0.0, 0.4997)
    uneven.seat[3] = "c"
    with pytest.warns(PincalWarning, match="2 contacts with a, 1 with b; the first 1 of each are paired"):
        found = acceptance(uneven, [KnownDistance("a", "b", 0.5)], Permitted(4e-4, 0.0))
    assert found.lengths[0].errors == pytest.approx([1e-4])


def test_a_length_without_contacts_is_told() -> None:
    """A name that no row has is an error with the names that there are."""
    with pytest.raises(MeasurementError, match=r"no row of socket 'c'.*the table has a, b"):
        acceptance(contacts(0.0, 0.5), [KnownDistance("a", "c", 0.5)], Permitted(1e-4, 0.0))


@pytest.mark.parametrize(
    ("lengths", "words"),
    [
        ([KnownDistance("a", "b", 500.0)], r"500 m, and the contacts are 0.5 m apart.*distance \[mm\]"),
        ([KnownDistance("a", "b", 5e-4)], "0.0005 m, and the contacts are 0.5 m apart"),
        ([KnownDistance("a", "b", 0.5), KnownDistance("b", "a", 0.5)], "b and a occurs twice"),
    ],
)
def test_lengths_that_are_no_test_are_refused(lengths: list[KnownDistance], words: str) -> None:
    """Numbers in mm under a header without a unit, or the reverse, are no errors of a robot; a pair of ends counts once."""
    with pytest.raises(MeasurementError, match=words):
        acceptance(contacts(0.0, 0.5), lengths, Permitted(1e-4, 0.0))


def test_a_plan_that_no_model_can_be_judged_by_is_refused(tmp_path: Path) -> None:
    """A single contact with an end only tells where the end is: validate leaves it out."""
    assert run("design", "ur10", "--acceptance", "300mm", "--times", "1", "--out", tmp_path / "test.csv") == 2
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_a_plan_has_the_tool_point_in_the_ends() -> None:
    """By the nominal arm, each contact is at its end; ends are as far apart as the length, in seven places."""
    ur10 = Robot.from_urdf("ur10")
    reach = Reach(ur10, SensorSetup(tool=(0.0, 0.0, 0.1)), Limits())
    plan = plan_acceptance(reach, [0.4], times=2)
    assert len(plan.lengths) == 7 and len(plan.contacts) == 4 * 7
    ends = {name: end for of in plan.lengths for name, end in zip((of.first, of.second), of.ends, strict=True)}
    for of in plan.lengths:
        assert np.linalg.norm(of.ends[1] - of.ends[0]) == pytest.approx(0.4)
    tips = ur10.forward_kinematics(np.array([contact.q for contact in plan.contacts]))
    places = tips[:, :3, 3] + tips[:, :3, :3] @ [0.0, 0.0, 0.1]
    wanted = np.array([ends[contact.socket] for contact in plan.contacts])
    assert np.abs(places - wanted).max() < 2e-4


@pytest.mark.long
@needs_sockets
def test_the_command_judges_a_real_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A Panda calibrated at two places is tried at the third, whose sockets are 40 mm apart."""
    known = [("A1", "A2", "39.90mm"), ("A2", "A3", "39.92mm"), ("B1", "B2", "39.97mm"), ("B2", "B3", "40.00mm")]
    stated = [word for distance in known for word in ("--socket-distance", *distance)]
    tables = [SOCKETS / f"panda_{place}.csv" for place in "AB"]
    fit = ["--tip", "panda_hand_tcp", "--model", "geometric", "--quiet", "--out", tmp_path / "out"]
    assert run("calibrate", SOCKETS / "panda.urdf", *tables, *stated, *fit) == 0
    lengths = tmp_path / "lengths.csv"
    lengths.write_text("first,second,distance [mm],sigma [mm]\nC1,C2,40,0.02\nC2,C3,40,0.02\n")
    judged = ["validate", tmp_path / "out" / "model.json", SOCKETS / "panda_C.csv", "--acceptance", lengths, "--quiet"]
    capsys.readouterr()
    assert run(*judged, "--mpe", "0.1mm", "--json") == 5
    found = json.loads(capsys.readouterr().out)
    assert found["outcome"] == "fail" and found["measured"] == 20
    assert run(*judged, "--mpe", "1mm+1mm/m", "--mpe-location", "2mm") == 0
    text = capsys.readouterr().out
    assert "PASS" in text and "L_Dia" in text and "20 lengths where ISO 10360 asks for 105" in text


def touched(diameter: float, rng: np.random.Generator, *, noise: float = 0.0) -> np.ndarray:
    """Return where the centre of a ball of 2 mm radius is that touches a sphere, shape (25, 3)."""
    points = np.array([0.8, -0.3, 0.5]) + (diameter / 2.0 + 2e-3) * points_on_hemisphere()
    return np.asarray(points + noise * rng.standard_normal(points.shape))


def test_probing_errors_are_those_of_a_sphere_that_was_made_so(rng: np.random.Generator) -> None:
    """A sphere 60 um too large, one contact 80 um beside it; by a least-squares fit of another library."""
    sphere = KnownSphere(0.025, 1e-6, 2e-3)
    points = touched(0.02506, rng)
    found = probing(points, np.zeros((75, 75)), sphere, size=1e-4, form=1e-4)
    assert found.size == pytest.approx(6e-5, abs=1e-9) and found.form == pytest.approx(0.0, abs=1e-9)
    assert found.outcome == "pass" and not found.scope
    points = touched(0.02506, rng, noise=2e-5)
    found = probing(points, np.zeros((75, 75)), sphere, size=1e-4, form=1e-5)
    fitted = least_squares(lambda x: np.linalg.norm(points - x[:3], axis=1) - x[3], [0.8, -0.3, 0.5, 0.01], xtol=1e-15)
    away = np.linalg.norm(points - fitted.x[:3], axis=1)
    assert found.size == pytest.approx(2.0 * (fitted.x[3] - 2e-3) - 0.025, abs=1e-9)
    assert found.form == pytest.approx(np.ptp(away), abs=1e-9)
    assert found.outcome_of_size == "pass" and found.outcome_of_form == "fail" and found.outcome == "fail"


def test_the_stated_uncertainty_of_a_size_is_that_of_repetition(rng: np.random.Generator) -> None:
    """Independent noise of each coordinate, carried to the diameter, against 400 draws."""
    sphere, sigma = KnownSphere(0.025, 1e-6, 2e-3), 2e-5
    draws = [probing(touched(0.025, rng, noise=sigma), sigma**2 * np.eye(75), sphere) for _ in range(400)]
    assert np.std([one.size for one in draws]) == pytest.approx(draws[0].stated, rel=0.15)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.eye(4, 3), "4 contacts with the sphere; expected 25"),
        (np.column_stack([np.random.default_rng(0).random((9, 2)), np.ones(9)]), "lie in a plane"),
        (points_on_hemisphere(), r"on a sphere of radius 1000 mm; expected 14.5 mm"),
    ],
)
def test_contacts_that_are_of_no_such_sphere_are_refused(points: np.ndarray, words: str) -> None:
    """Too few, flat, or of another size."""
    with pytest.raises(MeasurementError, match=words):
        probing(points, np.eye(points.size), KnownSphere(0.025, probe=2e-3))


@pytest.mark.long
def test_a_plan_of_probing_touches_the_sphere() -> None:
    """By the nominal arm each of 25 contacts is on it, and the tool comes from outside."""
    ur10 = Robot.from_urdf("ur10")
    centre, q = plan_probing(Reach(ur10, SensorSetup(tool=(0.0, 0.0, 0.1)), Limits()), 0.0145)
    tips = ur10.forward_kinematics(q)
    away = tips[:, :3, 3] + tips[:, :3, :3] @ [0.0, 0.0, 0.1] - centre
    assert q.shape == (25, 6) and np.abs(np.linalg.norm(away, axis=1) - 0.0145).max() < 3e-4
    assert np.sum(away * tips[:, :3, 2], axis=1).max() < 0.0


@pytest.mark.long
def test_the_command_probes_a_sphere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Planned, touched by the arm of the calibration, and judged; options that belong together are asked for."""
    out, sphere = tmp_path / "test.csv", tmp_path / "test_sphere.csv"
    plan = ["design", "ur10", "--tool", 0, 0, 0.1, "--acceptance", "300mm", "--times", 2, "--sphere", "25mm", "--out", out]
    assert run(*plan) == 0 and "25 contacts with a sphere" in capsys.readouterr().out
    cal, model = tmp_path / "cal.csv", tmp_path / "m" / "model.json"
    exact = ["--errors", 0, "--elastic", 0, "--seed", 1, "--out", cal, "--quiet"]
    assert run("simulate", "ur10", "--sockets", 4, "--poses", 80, *exact) == 0
    assert run("calibrate", "ur10", cal, "--model", "geometric", "--out", model.parent, "--quiet") in (0, 4)
    lengths = tmp_path / "test_lengths.csv"
    judged = ["validate", model, out, "--acceptance", lengths, "--mpe", "50mm", "--sphere", sphere, "--quiet"]
    capsys.readouterr()
    assert run(*judged, "--sphere-diameter", "25mm") == 2 and "no limit" in capsys.readouterr().err
    assert run(*judged, "--mpe-size", "1mm") == 2 and "no diameter" in capsys.readouterr().err
    assert run("validate", model, out, "--mpe-size", "1mm") == 2
    capsys.readouterr()
    limits = ["--mpe-size", "1mm", "--mpe-form", "1mm"]
    assert run(*judged, "--sphere-diameter", "25mm", *limits) == 0 and "P_Size" in capsys.readouterr().out
    assert run(*judged, "--sphere-diameter", "22mm", *limits, "--json") == 5
    found = json.loads(capsys.readouterr().out)["probing"]
    assert found["outcome_of_size"] == "fail" and found["outcome_of_form"] == "pass" and found["points"] == 25
    assert found["P_Size_mm"] == pytest.approx(3.0, abs=0.5)
