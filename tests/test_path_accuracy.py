"""Accuracy and repeatability along a path: closed forms on a circle, and what ``pincal validate`` says of a session."""

from __future__ import annotations

import numpy as np
import pytest

from pincal.validate.path_accuracy import along_path, cycles_of, path_words

PERIOD, RATE, RADIUS = 8.0, 200.0, 0.3


def circle(cycles: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return times, joints, positions and the outward and upward directions of a circle that is driven so many times."""
    time = np.arange(0.0, cycles * PERIOD + 0.5 / RATE, 1.0 / RATE)
    angle = 2.0 * np.pi * time / PERIOD
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    q = np.stack([np.sin(angle), 0.5 * np.cos(angle), 0.2 * np.sin(2.0 * angle)], axis=1)
    return time, q, RADIUS * outward, outward, np.tile([0.0, 0.0, 1.0], (len(time), 1))


def test_figures_of_a_circle_are_the_closed_forms() -> None:
    """Radial errors that each cycle shares, and height that it has of its own; what is along the path does not count."""
    time, q, path, outward, upward = circle(4)
    phase, cycle = 2.0 * np.pi * time / PERIOD, np.minimum((time / PERIOD + 1e-9).astype(int), 3)
    own = np.array([-3e-4, -1e-4, 1e-4, 3e-4])
    forward = np.stack([-outward[:, 1], outward[:, 0], np.zeros(len(time))], axis=1)
    off = 5e-4 * (1.0 + np.sin(phase))[:, None] * outward + own[cycle][:, None] * upward + 0.01 * forward
    turned = np.stack([2e-3 * np.cos(phase), own[cycle], np.zeros(len(time))], axis=1)
    found = along_path(time, q, path, np.hstack([off, turned]).T)

    assert (found["cycles"], found["points"]) == (4, round(PERIOD * RATE))
    assert found["AT_mm"] == pytest.approx(1.0, rel=1e-3)
    lengths = np.abs(own)
    assert found["RT_mm"] == pytest.approx(1e3 * (lengths.mean() + 3.0 * lengths.std(ddof=1)), rel=1e-3)
    assert found["AT_a_mrad"] == pytest.approx(2.0, rel=1e-3) and found["AT_c_mrad"] == found["RT_c_mrad"] == 0.0
    assert found["RT_b_mrad"] == pytest.approx(3e3 * own.std(ddof=1), rel=1e-3)
    assert found["RT_a_mrad"] < 1e-4
    assert path_words(found).endswith("RT c 0.0000 mrad; 4 cycles; ISO 9283 specifies 10")


def test_one_cycle_has_accuracy_alone() -> None:
    """A path that does not come again, or not whole, has no repeatability."""
    for cycles in (1.0, 1.6):
        time, q, path, outward, _ = circle(cycles)
        found = along_path(time, q, path, 2e-4 * outward.T)
        assert found["cycles"] == 1 and found["AT_mm"] == pytest.approx(0.2, rel=1e-3)
        assert not any(name.startswith("RT") for name in found)


def test_an_arm_that_stands_still_is_off_in_any_direction() -> None:
    """What is off along the path counts where the arm rests on it, and only there."""
    time, q, path, outward, _ = circle(1)
    forward = np.stack([-outward[:, 1], outward[:, 0], np.zeros(len(time))], axis=1)
    rests = (time > 2.0) & (time < 4.0)
    at = np.where(rests[:, None], path[np.argmax(rests)], path)
    assert along_path(time, q, at, 3e-4 * forward.T)["AT_mm"] == pytest.approx(0.3, rel=1e-3)
    assert along_path(time, q, path, 3e-4 * forward.T)["AT_mm"] < 1e-3


@pytest.mark.parametrize("cycles", [2, 3, 10])
def test_cycles_are_those_of_the_joints(cycles: int) -> None:
    """To a part of a sample, with the noise of encoders and something else before; one of what never comes again."""
    rng = np.random.default_rng(0)
    time, q, *_ = circle(cycles)
    q = q + 1e-4 * rng.normal(size=q.shape)
    assert cycles_of(time, q) == (0.0, pytest.approx(PERIOD, abs=0.2 / RATE), cycles)
    # Six seconds in which each joint goes elsewhere.
    elsewhere = np.arange(-6.0, 0.0, 1.0 / RATE)
    first = q[0] + np.array([0.9, -0.4, 0.7]) * np.sin(0.5 * elsewhere[:, None]) ** 2
    begin, period, n = cycles_of(np.concatenate([elsewhere, time]), np.concatenate([first, q]))
    assert begin == pytest.approx(0.0, abs=0.3) and period == pytest.approx(PERIOD, abs=0.01) and n == cycles
    for never in (np.cumsum(rng.normal(size=q.shape), axis=0), np.ones_like(q)):
        assert cycles_of(time, never) == (0.0, time[-1], 1)
