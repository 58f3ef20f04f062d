"""Draws of rows as they are measured in the world are what they are said to be, and what a discovery makes of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rows_study
from discovery_cases import SIGMA
from pairs import one_in_three
from rates import CHANCE, allowed, in_words, interval, is_at_most, power, tables_for
from row_cases import DRIVES_ARRIVE, KINDS, OF_ROBOT, REPEATS_AGREE, RowsCase, draw_rows_case, whitening_of
from rows_study import CI_HIDDEN, CI_TABLES, CORRELATED, Task, append, read, study
from scipy.linalg import toeplitz
from scipy.stats import binom, chi2

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")


def noise_of(case: RowsCase) -> np.ndarray:
    position = case.rows.position
    assert position is not None
    return np.asarray(position - case.clean)


def lag(noise: np.ndarray) -> float:
    """Return the correlation of neighbouring rows about a mean of zero."""
    return float(np.sum(noise[1:] * noise[:-1]) / np.sum(noise**2))


@pytest.mark.parametrize(("kind", "expected"), [("white", 0.0), ("ar_path", 0.9), ("ar_random", 0.9)])
def test_neighbouring_rows_have_the_correlation_that_is_said(kind: str, expected: float) -> None:
    """Within four standard errors, which Bartlett's formula gives."""
    noise = noise_of(draw_rows_case(kind, 1, arm="kuka", poses=300))

    assert lag(noise) == pytest.approx(expected, abs=4.0 * np.sqrt((1.0 - expected**2) / noise.size) + 5.0 / noise.size)


@pytest.mark.parametrize(
    "kind",
    [
        *("white", "ar_path", "walk_sorted", "repeats", "copies", "instrument_range"),
        pytest.param("repeats_cycles", marks=pytest.mark.long),
    ],
)
def test_noise_has_the_covariance_that_is_said(kind: str) -> None:
    """Whitened by it, the squares of what is drawn add up to as many as there are independent readings."""
    case = draw_rows_case(kind, 3, arm="light", poses=25)
    whitened = case.whitening @ noise_of(case).ravel()

    n = 3 * 25 if kind == "copies" else 3 * len(case.rows)
    assert len(whitened) == n
    assert CHANCE < chi2.cdf(float(whitened @ whitened), n) < 1.0 - CHANCE


def test_lambda_by_the_covariance_of_an_autoregression_is_that_of_its_innovations() -> None:
    """Closed form: the first term over its variance, and each innovation over its own."""
    rng, phi = np.random.default_rng(0), 0.9
    signal = rng.standard_normal(40)
    W = whitening_of(SIGMA**2 * toeplitz(phi ** np.arange(40)))
    innovations = np.sum((signal[1:] - phi * signal[:-1]) ** 2) / (1.0 - phi**2)

    assert np.sum((W @ signal) ** 2) == pytest.approx((signal[0] ** 2 + innovations) / SIGMA**2)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["ar_random", "repeats"])
def test_a_hidden_effect_has_the_strength_that_is_asked_for(kind: str) -> None:
    """Lambda over the true noise, and what a discovery can see of it is less."""
    case = draw_rows_case(kind, 5, hidden="gear_eccentricity", strength=80.0, arm="kuka", poses=80)

    assert case.strength == pytest.approx(80.0, rel=0.05)
    assert 0.0 < case.seen < case.strength
    assert case.truth == (("gear_eccentricity", case.hidden[0].joint, None),)


def test_repeats_agree_and_arrivals_do_not() -> None:
    """The readings of a visit scatter by 2 um, those of a pose from visit to visit as drives arrive."""
    case = draw_rows_case("repeats_cycles", 2, arm="kuka", poses=40)
    position = case.rows.position
    assert position is not None
    visits = position.reshape(3, 40, 3, 3)

    assert visits.std(axis=2, ddof=1).mean() == pytest.approx(REPEATS_AGREE, rel=0.25)
    # Each drive at the end of an arm of some metres.
    assert 0.5 * DRIVES_ARRIVE < visits.mean(axis=2).std(axis=0, ddof=1).mean() < 4.0 * DRIVES_ARRIVE
    assert len(np.unique(case.rows.q, axis=0)) == 40


def test_joints_that_are_read_back_differ_by_what_encoders_resolve() -> None:
    """No two rows of a pose have the same joint columns, and all are within some micro-radians."""
    q = draw_rows_case("repeats_scattered", 2, poses=40, arm="kuka").rows.q.reshape(40, 3, 6)

    assert 0.0 < np.ptp(q, axis=1).max() < 2e-5


def test_copies_are_copies() -> None:
    """Three rows in a line with the same joints and readings."""
    case = draw_rows_case("copies", 2, arm="kuka", poses=40)
    position = case.rows.position
    assert position is not None

    assert np.ptp(position.reshape(40, 3, 3), axis=1).max() == 0.0
    assert np.ptp(case.rows.q.reshape(40, 3, 6), axis=1).max() == 0.0


def test_a_bump_moves_few_rows_by_what_shows() -> None:
    """At most half of a millimetre, and nothing outside some degrees."""
    case = draw_rows_case("bump", 1, arm="heavy")
    campaign = case.campaign
    assert campaign.bump is not None
    moved = np.linalg.norm(case.clean - type(campaign)(**{**vars(campaign), "bump": None}).positions(case.world), axis=1)
    near = moved > 1e-5

    assert 2e-4 <= moved.max() <= 5e-4
    assert 6 <= near.sum() < 0.1 * len(moved)
    assert np.ptp(case.rows.q[near, campaign.joint]) < np.deg2rad(20.0)


def test_an_eccentric_encoder_turns_what_is_read_about_the_plumb_axis() -> None:
    """By 10 to 40 urad at most, a wave a turn, range and height as they are."""
    case = draw_rows_case("instrument_azimuth", 1, arm="heavy")
    campaign = case.campaign
    true = type(campaign)(**{**vars(campaign), "azimuth": (0.0, 0.0)}).positions(case.world)
    turn = np.angle(np.exp(1j * np.subtract(*(np.arctan2(at[:, 1], at[:, 0]) for at in (case.clean, true)))))

    assert case.clean[:, 2] == pytest.approx(true[:, 2])
    assert np.linalg.norm(case.clean, axis=1) == pytest.approx(np.linalg.norm(true, axis=1))
    assert np.abs(turn).max() <= 40e-6
    wave = np.column_stack([np.cos(azimuth := np.arctan2(true[:, 1], true[:, 0])), np.sin(azimuth)])
    found, left, *_ = np.linalg.lstsq(wave, turn, rcond=None)
    assert 10e-6 <= np.linalg.norm(found) <= 40e-6 and np.sqrt(left[0]) < 1e-9


@pytest.mark.parametrize("kind", ["moves", "repeats"])
def test_sides_are_those_from_which_drives_came(kind: str) -> None:
    """All that rows in order tell, in the later readings of a visit, too; they tell nearly all."""
    cases = [draw_rows_case(kind, seed, arm="kuka", poses=8) for seed in range(6)]
    tables = [(case.rows.approach, case.world.conditions["approach"]) for case in cases if case.rows.approach is not None]

    assert tables
    for told, true in tables:
        assert np.all((told == true) | (told == 0)) and np.mean(told == 0) < 0.2


@pytest.mark.parametrize("kind", one_in_three(KINDS))
def test_truth_at_fresh_poses_is_that_of_the_same_campaign(kind: str) -> None:
    """A draw is the same again, and what is read at a pose of the table without noise is what the simulator has there."""
    one, other = (draw_rows_case(kind, 9, poses=8 if kind != "bump" else None) for _ in range(2))
    table, clean = one.fresh(5)

    assert np.array_equal(one.rows.columns()["position"], other.rows.columns()["position"])
    assert np.array_equal(clean, other.fresh(5)[1]) and not np.array_equal(clean, one.fresh(5, seed=1)[1])
    assert table.columns().keys() == one.rows.columns().keys()
    assert one.clean == pytest.approx(one.campaign.positions(one.world))


def test_intervals_of_rates_are_exact() -> None:
    """Closed form at no hit, and the two tails of the binomial at some."""
    low, high = interval(3, 300)

    assert interval(0, 40) == (0.0, pytest.approx(1.0 - 0.025 ** (1 / 40)))
    assert interval(40, 40)[1] == 1.0
    assert binom.sf(2, 300, low) == pytest.approx(0.025) and binom.cdf(3, 300, high) == pytest.approx(0.025)
    assert in_words(3, 300) == "3 of 300: 0.2 to 2.9 %"


def test_power_is_the_chance_that_a_test_fails_where_the_rate_has_doubled() -> None:
    """Against draws, and about the numbers that the normal approximation gives."""
    n = tables_for(0.05)
    hits = np.random.default_rng(0).binomial(n, 0.1, 4000)
    fails = [not is_at_most(0.05, [True] * h + [False] * (n - h)) for h in hits]

    assert is_at_most(0.05, [True] * allowed(0.05, n) + [False] * (n - allowed(0.05, n)))
    assert np.mean(fails) == pytest.approx(power(0.05, n), abs=0.02) and power(0.05, n) >= 0.9
    roots = 3.09 * np.sqrt(0.05 * 0.95) + 1.28 * np.sqrt(0.1 * 0.9)
    assert n == pytest.approx((roots / 0.05) ** 2, rel=0.15)


def test_a_stopped_study_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is in the file is not done again, half a line is, and so is what another version of the code did."""
    asked: list[int] = []

    def said_of(task: Task) -> dict[str, Any]:
        asked.append(task.seed)
        return {**task._asdict(), "said": f"of {task.seed}"}

    monkeypatch.setattr(rows_study, "said_of", said_of)
    monkeypatch.setattr(rows_study, "version", lambda: "v1")
    path, tasks = tmp_path / "cases.jsonl", [Task("white", seed, "", 0.0) for seed in range(4)]
    study(tasks[:2], path, workers=1)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps({"version": "v1", **said_of(tasks[2])})[:20])
    append(path, {"version": "v0", **said_of(tasks[3])})
    asked.clear()
    found = study(tasks, path, workers=1)

    assert asked == [2, 3]
    assert [case["said"] for case in found] == [f"of {seed}" for seed in range(4)]
    assert [(case["seed"], case["version"]) for case in read(path)] == [
        (0, "v1"),
        (1, "v1"),
        (3, "v0"),
        (2, "v1"),
        (3, "v1"),
    ]
    assert [case["version"] for case in study(tasks, path, workers=1, any_version=True)] == ["v1"] * 4


def test_names_are_counted_as_what_they_are() -> None:
    """A robot's name is false unless it, or one of its equals, is true; set-up and what has no name count apart."""

    def names(*classes: list[list[str | None]]) -> dict[str, Any]:
        return {"names": [{"classes": own, "p": 0.0} for own in classes], "kind": "white", "truth": [], "setup": []}

    ripple: list[str | None] = ["gear_ripple", "a", None]
    drift: list[str | None] = ["base_drift", None, None]
    unnamed: list[str | None] = ["unnamed", "a", None]
    soft: list[str | None] = ["joint_elasticity", "a", None]
    found = names([ripple], [drift], [unnamed], [soft, ripple])

    assert rows_study.false_names(found) == [ripple]
    assert rows_study.names_of_setup(found) == [drift] and rows_study.alarms(found) == [unnamed]
    assert not rows_study.is_right(found)
    # Of a bump the joint is true, whatever it is called.
    assert rows_study.is_right({**found, "truth": [unnamed]}) and not rows_study.false_names({**found, "truth": [unnamed]})
    assert not rows_study.is_right({**names([soft, ripple]), "truth": [unnamed]})
    assert rows_study.is_right({**names([["backlash", "b", None], ripple]), "truth": [ripple]})


def test_a_change_is_told_by_what_it_is_and_near_its_line() -> None:
    """Three rows beside it is near; another joint or another cause is not told."""
    truth: list[list[str | None]] = [["remastered", "axis_1", None]]
    case = {"kind": "remastered", "truth": truth, "setup": [], "line": 100, "names": []}

    assert rows_study.is_right({**case, "notes": ["from line 102 on axis_1 is off by 1 mrad: was it remastered?"]})
    assert not rows_study.is_right({**case, "notes": ["from line 120 on axis_1 is off by 1 mrad: was it remastered?"]})
    assert not rows_study.is_right({**case, "notes": ["from line 100 on axis_2 is off by 1 mrad: was it remastered?"]})
    assert not rows_study.is_right({**case, "notes": ["from line 100 on readings are shifted by 2 mm: axis_1"]})


@pytest.mark.long
@pytest.mark.rates
def test_rows_of_the_world_bring_in_no_name_and_hide_none() -> None:
    """Some tables of each kind, bounds that chance fails once in a thousand; ``rows_study.py --rates`` tells their power."""
    seeds = range(27900, 27900 + CI_TABLES)
    plain = study([Task(kind, seed, "", 0.0) for seed in seeds for kind in KINDS])
    tasks = [Task(k, 27950 + i, h, 100.0) for i, h in enumerate(CI_HIDDEN) for k in CORRELATED]
    hidden = study(tasks)
    print("\n" + "\n".join(rows_study.table([*plain, *hidden])))
    sound = [case for case in plain if case["kind"] not in OF_ROBOT]
    covered = np.array([case["coverage"] for case in plain if rows_study.stands(case)])
    error = 3.3 * covered.std(ddof=1) / np.sqrt(len(covered))

    assert is_at_most(0.01, [bool(rows_study.false_names(case)) for case in sound])
    assert is_at_most(0.05, [not rows_study.is_right(case) for case in hidden])
    assert is_at_most(0.01, [rows_study.covers_too_little(case) for case in [*plain, *hidden]])
    assert 0.93 - error < covered.mean() < 0.97 + error
