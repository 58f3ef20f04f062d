"""Two sessions in one table, hours apart: a step between them is no drift, and a drift within them is one."""

from __future__ import annotations

import re

import numpy as np
import pytest

from pincal import GEOMETRIC, Options, Robot, measurements_from_arrays, run_discovery
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.discover.run import Discovery

URDF = kuka_urdf_path()
ROBOT = Robot.from_urdf(URDF)
NOISE, N, EVERY, HOUR = 3e-5, 120, 60.0, 3600.0
TARGET = np.array([0.1, 0.05, 0.2])
SHIFT = np.array([1.2e-4, -0.8e-4, 0.6e-4])
_COUNTED = [pytest.mark.long, pytest.mark.rates]
SEEDS = [0, *(pytest.param(seed, marks=_COUNTED) for seed in range(1, 4))]


def discovered(
    seed: int,
    *,
    pause: float,
    shift: bool = False,
    drift: float = 0.0,
    effects: tuple[sim.HiddenEffect, ...] = (),
    warmer: float | None = None,
) -> Discovery:
    """Return a discovery on a machine of the KUKA's type, measured in two sessions of an hour with a pause between.

    Args:
        seed: of everything.
        pause: between the sessions [s].
        shift: whether the instrument is displaced in the pause.
        drift: of the base [m/h].
        effects: further hidden effects.
        warmer: the second session's temperature less the first's [K]; default: no column.
    """
    rng = np.random.default_rng([seed, 19])
    machine = sim.TrueMachine.from_urdf(URDF, tip="tool0").draw_errors(rng, sigma_length=3e-4, sigma_angle=5e-4)
    machine = machine.with_effects(*effects)
    if drift:
        machine = machine.with_effects(sim.BaseDrift(size=drift / HOUR, direction=(0.6, 0.8, 0.0)))
    q, second = sim.plan_poses(machine.nominal, N, rng), np.arange(N) >= N // 2
    columns = {"time": EVERY * np.arange(N) + np.where(second, pause, 0.0)}
    if warmer is not None:
        columns["temperature"] = 20.0 + np.where(second, warmer, 0.0) + 0.1 * rng.standard_normal(N)
    tip = machine.tip(q, **columns)
    position = tip[:, :3, 3] + tip[:, :3, :3] @ TARGET + NOISE * rng.standard_normal((N, 3))
    position += np.where(second[:, None] & shift, SHIFT, 0.0)
    rows = measurements_from_arrays(machine.names, q, position=position, **columns)
    return run_discovery(ROBOT, rows, Options(effects=GEOMETRIC, sigma=NOISE), test_fraction=0.0)


def names(found: Discovery) -> list[str]:
    """Return the names of the effects found."""
    return [entry.effect for entry in found.findings.effects]


def steps(found: Discovery) -> list[int]:
    """Return the lines from which on something is said to be different."""
    texts = map(str, found.calibration.result.warnings)
    return [int(line[1]) for text in texts if (line := re.match(r"from line (\d+) on ", text))]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("pause", [17.0, *(pytest.param(pause, marks=pytest.mark.long) for pause in (1.0, 200.0))])
def test_an_instrument_displaced_in_a_pause_is_no_drift(pause: float, seed: int) -> None:
    """The line is told, and nothing that follows the time is named."""
    found = discovered(seed, pause=pause * HOUR, shift=True)

    assert names(found) == []
    (line,) = steps(found)
    assert abs(line - (2 + N // 2)) <= 3


@pytest.mark.long
@pytest.mark.parametrize("seed", SEEDS)
def test_an_instrument_displaced_between_a_cool_and_a_warm_session_is_no_expansion(seed: int) -> None:
    """Nor is it what grew with the temperature."""
    found = discovered(seed, pause=17.0 * HOUR, shift=True, warmer=4.0)

    assert names(found) == [] and len(steps(found)) == 1


@pytest.mark.long
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("pause", "drift"), [(1.0, 1e-4), *(pytest.param(*case, marks=pytest.mark.long) for case in ((0.0, 1e-4), (3.0, 2e-4)))]
)
def test_a_drift_that_goes_on_in_both_sessions_is_named(pause: float, drift: float, seed: int) -> None:
    """Beside a pause of up to three of these sessions, and nothing changed at once."""
    found = discovered(seed, pause=pause * HOUR, drift=drift)

    assert names(found) == ["base_drift"]
    assert steps(found) == []


@pytest.mark.long
@pytest.mark.parametrize("seed", SEEDS[:2])
def test_an_arm_that_is_warmer_in_the_second_session_has_expanded(seed: int) -> None:
    """Its links grow and nothing else moves: no step of the set-up explains that."""
    found = discovered(seed, pause=17.0 * HOUR, warmer=6.0, effects=(sim.ThermalExpansion(size=1.2e-5),))

    assert names(found) == ["thermal_expansion"] and steps(found) == []
