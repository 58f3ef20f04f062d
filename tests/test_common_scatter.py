"""Drives that stop unevenly: a joint is named only if it scatters more than the others; all alike are no missing effect."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from discovery_cases import _setting

from pincal import GEOMETRIC, Options, measurements_from_arrays, run_discovery
from pincal.discover.alike_scatter import AlikeScatter
from pincal.discover.report.search_answer import SearchAnswer
from pincal.discover.run import Discovery
from pincal.discover.scatter import _Arrivals
from pincal.report.judgement import judged
from pincal.validate.misfit import Verdict

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

NOISE, N, ARMS = 1.5e-5, 140, ("kuka", "light", "heavy")
SIZES = (3e-5, 4.5e-5, 6e-5)
Arrival = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def seeds(count: int, *, first: int = 0) -> list[Any]:
    """Return seeds, an arm each: the first is in long runs of the tests, the others where rates are counted."""
    marks = [[pytest.mark.long], [pytest.mark.long, pytest.mark.rates]]
    return [pytest.param(seed, marks=marks[seed != first]) for seed in range(count)]


def alike(size: float) -> Arrival:
    """Return drives that all stop with the same standard deviation [rad]."""
    return lambda q, rng: size * rng.standard_normal(q.shape)


def of_one(joint: int, size: float, others: float = 0.0) -> Arrival:
    """Return drives one of which scatters more than the others [rad]."""
    sizes = np.where(np.arange(6) == joint, size, others)
    return lambda q, rng: sizes * rng.standard_normal(q.shape)


def of_pose(size: float) -> Arrival:
    """Return drives that are all off by a function of their own position and the next joint's, of some size [rad]."""

    def off(q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        own, following = rng.uniform(0.0, 2.0 * np.pi, (2, 6))
        return 2.0 * size * np.sin(2.0 * q + own) * np.sin(np.roll(q, -1, axis=1) + following)

    return off


def discovered(
    seed: int, arrival: Arrival, *, sigma: float | None = NOISE, noise: float = NOISE, poses: int = N, cycles: int = 1
) -> Discovery:
    """Return a discovery on poses of an elastic arm.

    Args:
        seed: of everything; arms in turn.
        arrival: returns where drives stop less where the table says, shape (N, 6) [rad].
        sigma: declared noise of the instrument [m].
        noise: its true noise [m].
        poses: number of poses.
        cycles: how often each is measured, arriving anew.
    """
    rng, arm = np.random.default_rng([seed, 4]), ARMS[seed % len(ARMS)]
    drawn = {"elastic": True, "masses": 0.0, "one_payload": True, "columns": set[str](), "in_order": False}
    s = _setting(rng, poses, arm=arm, moment_frame="after", **drawn)
    q, payload = np.tile(s.q, (cycles, 1)), np.tile(s.conditions["payload"], cycles)
    there = q + arrival(q, rng)
    tip = s.machine.equilibrium(s.machine.poses(there, payload_com=s.com, payload=payload)).tip
    position = tip[:, :3, 3] + tip[:, :3, :3] @ s.tool + noise * rng.standard_normal((len(q), 3))
    rows = measurements_from_arrays(s.machine.names, q, position=position, payload=payload)
    options = Options(effects=GEOMETRIC, sigma=sigma, moment_frame="after", payload_centre=s.com)
    return run_discovery(s.robot, rows, options)


@cache
def of_sound(seed: int, sigma: float | None) -> Discovery:
    """Return a discovery on a sound arm whose drives all stop to 30, 45 or 60 urad."""
    return discovered(seed, alike(SIZES[seed // len(ARMS) % len(SIZES)]), sigma=sigma)


def names(found: Discovery) -> list[str]:
    """Return what was named besides elasticity."""
    return [entry.effect for entry in found.findings.effects if "elasticity" not in entry.effect]


@pytest.mark.parametrize("seed", seeds(3))
def test_drives_that_stop_alike_are_no_missing_effect(seed: int) -> None:
    """Without a declared noise a sound arm is not accused, nor any of its joints."""
    found = of_sound(seed, None)

    assert names(found) == [] and found.findings.scatter == ()
    assert found.findings.verdict is Verdict.NOT_JUDGED
    assert any("consistent with joint noise" in str(note) for note in found.calibration.result.warnings)


@pytest.mark.long
@pytest.mark.rates
@pytest.mark.parametrize("sigma", [None, NOISE])
def test_drives_that_stop_alike_seldom_seem_to_lack_an_effect(sigma: float | None) -> None:
    """Of 9 sound arms at most one has an effect named by chance, 1 of 20 being promised, and none of its joints."""
    found = [of_sound(seed, sigma).findings for seed in range(9)]

    assert all(findings.scatter == () for findings in found)
    assert sum("elasticity" not in entry.effect for findings in found for entry in findings.effects) <= 1


@pytest.mark.long
@pytest.mark.parametrize("seeds", [range(0, 9, 4), pytest.param(range(9), marks=pytest.mark.rates)], ids=len)
def test_what_exceeds_a_declared_noise_may_be_how_drives_stop(seeds: range) -> None:
    """In all but one of sound tables, of three or nine, it is told to how much, within a quarter."""
    told = []
    for seed in seeds:
        found = of_sound(seed, NOISE)
        arrivals = found.calibration.result.arrivals
        if arrivals is None:
            continue
        assert arrivals == pytest.approx(SIZES[seed // len(ARMS)], rel=0.25)
        assert found.findings.verdict is found.calibration.result.verdict_of() is Verdict.NOT_JUDGED
        (words,) = [str(note) for note in found.calibration.result.warnings if "declared noise" in str(note)]
        assert "as of drives that all stop to" in words and "model is incomplete" not in words
        assert "measure ten poses three times each" in judged(found.calibration.result, SearchAnswer(found)).reason
        told.append(seed)

    assert len(told) >= len(seeds) - 1


@pytest.mark.parametrize("seed", seeds(2, first=1))
def test_repeated_poses_show_how_drives_stop(seed: int) -> None:
    """Their scatter is the noise by which a search's model is judged, too, whatever is declared of the instrument."""
    found = discovered(seed, alike(4.5e-5), poses=60, cycles=3)

    assert names(found) == [] and found.findings.scatter == ()
    assert found.findings.verdict is Verdict.ADEQUATE


def of_each_kind() -> list[Any]:
    """Return seeds with a noise that is declared or not: each joint, size and noise in long runs, the rest with rates."""
    found, counted = list[Any](), [pytest.mark.long, pytest.mark.rates]
    marks = {0: (), **dict.fromkeys((2, 7), pytest.mark.long)}
    for seed in range(8):
        sigma, other = (NOISE, None) if seed // 2 % 2 else (None, NOISE)
        found.append(pytest.param(seed, sigma, marks=marks.get(seed, counted)))
        found.append(pytest.param(seed, other, marks=counted))
    return found


@pytest.mark.long
@pytest.mark.parametrize(("seed", "sigma"), of_each_kind())
def test_a_joint_that_scatters_more_than_the_others_is_named(seed: int, sigma: float | None) -> None:
    """One drive to 50 or 80 urad, the others exactly or to a fifth of it: it is named, with its size."""
    size, joint = (5e-5, 8e-5)[seed % 2], seed % 3
    found = discovered(seed, of_one(joint, size, others=0.2 * size * (seed // 4)), sigma=sigma).findings

    (entry,) = found.scatter
    assert entry.joint.endswith(str(joint + 1))
    assert entry.sigma_rad == pytest.approx(size, rel=0.4)
    assert found.verdict is Verdict.NOT_ADEQUATE


@pytest.mark.parametrize("seed", seeds(6, first=1))
def test_errors_that_follow_the_pose_are_not_how_drives_stop(seed: int) -> None:
    """All drives are off by functions of two joints: something is named, or the model is not adequate."""
    found = discovered(seed, of_pose(8e-5))

    assert found.calibration.result.arrivals is None
    assert found.findings.verdict is Verdict.NOT_ADEQUATE or names(found)


@pytest.mark.parametrize("seed", seeds(6))
def test_an_instrument_that_is_noisier_than_declared_is_not_how_drives_stop(seed: int) -> None:
    """Its noise is the same wherever the arm is, unlike that of drives."""
    found = discovered(seed, alike(0.0), noise=4.0 * NOISE)

    assert found.calibration.result.arrivals is None
    assert any("model is incomplete or the declared noise is too small" in str(w) for w in found.calibration.result.warnings)


def test_scatter_beside_that_of_all_has_the_likelihood_of_its_covariance() -> None:
    """On a grid of variances, with one joint that slides and is not alike, as by the dense covariance of each visit."""
    rng = np.random.default_rng(3)
    V, n, m = 9, 4, 5
    levers, residuals = rng.standard_normal((V, n, m)), rng.standard_normal((V, m))
    turns, ratios = np.array([True, True, False, True]), np.array([0.0, 0.1, 3.0, 1e4])
    gram, along = levers @ levers.transpose(0, 2, 1), np.einsum("vnm,vm->vn", levers, residuals)
    squares = float(np.sum(residuals**2))

    def likelihood(alike: float, extra: float, joint: int, sigma2: float | None) -> float:
        variances = alike * turns + extra * (np.arange(n) == joint)
        M = np.eye(m) + np.einsum("vnm,n,vnk->vmk", levers, variances, levers)
        left = float(np.einsum("vm,vmk,vk->", residuals, np.linalg.inv(M), residuals))
        variance = left / (V * m) if sigma2 is None else sigma2
        return float(-V * m * np.log(variance) - np.sum(np.linalg.slogdet(M)[1]) - left / variance)

    found = AlikeScatter.of(gram, along, turns, ratios=ratios, squares=squares, readings=V * m)
    for joint in range(n):
        beside = found.beside(joint)
        for sigma2 in (None, 0.7):
            expected = np.array([[likelihood(a, b, joint, sigma2) for b in ratios] for a in ratios])
            rows = np.array([beside.likelihood(k, ratios, sigma2) for k in range(len(ratios))])
            columns = np.array([beside.likelihood(slice(None), b, sigma2) for b in ratios])
            np.testing.assert_allclose(rows, expected, rtol=1e-9)
            np.testing.assert_allclose(columns, expected.T, rtol=1e-9)
    arrivals = _Arrivals(tuple("abcd"), turns, gram, along, squares, V * m)
    at, likeliest = arrivals.alike()
    assert likeliest == pytest.approx(likelihood(at, 0.0, 0, None)) and likeliest == pytest.approx(
        max(likelihood(ratio, 0.0, 0, None) for ratio in arrivals._ratios)
    )
    assert all(gain >= -1e-9 for gain in arrivals.beyond_others().values())
