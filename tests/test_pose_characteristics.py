"""Characteristics of ISO 9283 by hand, and how often their intervals hold the truth."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pincal.validate.pose_characteristics import (
    PoseVisits,
    accuracy_interval,
    characteristics,
    error_intervals,
    interval_words,
    quantile_interval,
    repeatability_interval,
)

UP = np.array([0.0, 0.0, 1.0])
ALONG = np.array([1.0, 0.0, 0.0])


def visits(offsets: dict[int, list[np.ndarray]], **given: np.ndarray) -> PoseVisits:
    """Return visits of poses 1 m apart along x, pass by pass, with these residuals in each."""
    order = [(k, j) for j in range(len(offsets[0])) for k in offsets]
    pose = np.array([k for k, _ in order])
    residuals = np.array([offsets[k][j] for k, j in order])
    session = given.pop("session", np.zeros(len(order), int))
    return PoseVisits(residuals, pose[:, None] * ALONG, pose, session, **given)


def test_distances_are_those_of_the_standard() -> None:
    """Two poses, of which one is attained .3, .1 and .2 mm too far: AD is .2 mm, RD three times .1 mm."""
    far = [3e-4 * ALONG, 1e-4 * ALONG, 2e-4 * ALONG]
    found = characteristics(visits({0: [0.0 * UP] * 3, 1: far}))
    assert found["AD_mm"]["mean"] == pytest.approx(0.2) and found["AD_mm"]["of"] == 1
    assert found["RD_mm"]["mean"] == pytest.approx(0.3) and found["RD_mm"]["cycles"] == 3
    assert found["AP_mm"]["max"] == pytest.approx(0.2) and found["AP_mm"]["mean"] == pytest.approx(0.1)
    lengths = np.array([1e-4, 1e-4, 0.0])
    assert found["RP_mm"]["max"] == pytest.approx(1e3 * (lengths.mean() + 3.0 * lengths.std(ddof=1)))
    assert found["AP_mm"]["interval"] is None
    assert not {"vAP_mm", "dAP_mm", "dRP_mm"} & set(found)


def test_directions_and_sessions_are_told_apart() -> None:
    """Means from two sides .4 mm apart, and an accuracy that grows from .1 to .3 mm between sessions."""
    sides = np.array([1.0, -1.0, 1.0, -1.0])[:, None]
    found = characteristics(visits({0: [2e-4 * UP, -2e-4 * UP, 2e-4 * UP, -2e-4 * UP]}, side=sides))
    assert found["vAP_mm"]["mean"] == pytest.approx(0.4)
    found = characteristics(visits({0: [1e-4 * UP, 1e-4 * UP, 3e-4 * UP, 3e-4 * UP]}, session=np.array([0, 0, 1, 1])))
    assert found["dAP_mm"]["mean"] == pytest.approx(0.2) and found["dRP_mm"]["mean"] == pytest.approx(0.0)
    unknown = characteristics(visits({0: [2e-4 * UP] * 4}, side=np.zeros((4, 1))))
    assert "vAP_mm" not in unknown


@pytest.mark.parametrize(("across", "least"), [(1.0, 0.93), (1.0 / 3.0, 0.85)])
def test_intervals_of_one_pose_hold_the_truth(across: float, least: float, rng: np.random.Generator) -> None:
    """By simulation, for means at, near and far from zero, where scatter is even and where it is not."""
    scale = np.array([1.0, across, across])
    lengths = np.linalg.norm(rng.standard_normal((200000, 3)) * scale, axis=1)
    truth = lengths.mean() + 3.0 * lengths.std()
    for n, length in ((5, 0.0), (10, 2.0), (30, 40.0)):
        drawn = length * ALONG + rng.standard_normal((300, n, 3)) * scale
        ends = np.array([accuracy_interval(of) for of in drawn])
        held = np.mean((ends[:, 0] <= length) & (length <= ends[:, 1]))
        assert held > least - 2.6 * math.sqrt(least * (1.0 - least) / 300)
        ends = np.array([repeatability_interval(of) for of in drawn])
        held = np.mean((ends[:, 0] <= truth) & (truth <= ends[:, 1]))
        assert held > least - 2.6 * math.sqrt(least * (1.0 - least) / 300)


def test_intervals_of_quantiles_are_those_of_the_binomial_distribution() -> None:
    """The ranks are the least and greatest whose binomial tails are at most 2.5 %, by summing these."""
    n = 73
    chances = [math.comb(n, k) * 0.95**k * 0.05 ** (n - k) for k in range(n + 1)]
    low = max(rank for rank in range(1, n + 1) if sum(chances[:rank]) <= 0.025)
    high = [rank for rank in range(1, n + 1) if sum(chances[rank:]) <= 0.025]
    assert quantile_interval(np.arange(1.0, n + 1.0), 0.95) == (low, min(high) if high else None)
    assert quantile_interval(np.arange(1.0, 21.0), 0.95)[1] is None
    # Each of 73 values read four times tells no more than 73 do.
    repeated = quantile_interval(np.repeat(np.arange(1.0, n + 1.0), 4), 0.95, independent=n)
    assert repeated == quantile_interval(np.arange(1.0, n + 1.0), 0.95)


def test_intervals_of_errors_are_said() -> None:
    """The mean has Student's interval; what so few values do not bound is said to be above."""
    found = error_intervals({"mm": np.array([1.0, 2.0, 3.0])}, independent=3)
    assert found["mean_mm"] == pytest.approx((0.0, 2.0 + 4.3027 / 3.0**0.5), abs=1e-4)
    assert interval_words(found) == "95 % intervals: mean 0.0000 to 4.4841 mm; 95th percentile above 2.0000 mm"
