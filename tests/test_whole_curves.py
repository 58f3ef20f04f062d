"""Simple names of a drive's curve and the whole of it: which is taken, and when one is told beside the other."""

from __future__ import annotations

import numpy as np
import pytest
from machines import kuka as true_kuka

from pincal import GEOMETRIC, Measurements, Options, Robot, measurements_from_arrays, run_discovery
from pincal import simulate as sim
from pincal.discover.backward import judge_remainders
from pincal.discover.candidate_tests import Search
from pincal.discover.first_order import ScoreResult
from pincal.discover.policy import POLICY
from pincal.discover.steps import SearchState, SearchStep
from pincal.identify.calibrate import fit_tables, refit
from pincal.identify.split import row_groups
from pincal.model.catalogue import GearEccentricity, TransmissionError

SIGMA = 5e-5
OPTIONS = Options(effects=GEOMETRIC, sigma=SIGMA)
# Bumps of which a hint is left [rad].
HINT = 7e-6
WAVE = sim.GearEccentricity(joint="joint_3", size=4e-4, order=1, phase=0.4)


def bumps(size: float) -> sim.HiddenEffect:
    """Return what is irregular about the gear."""
    return sim.TransmissionError(joint="joint_3", size=size, seed=4, bumps=6, periodic=False)


def measured(kuka: Robot, *hidden: sim.HiddenEffect) -> Measurements:
    """Return noisy positions of a stiff machine with hidden effects."""
    rng = np.random.default_rng(8)
    machine = true_kuka(effects=hidden).draw_errors(rng, sigma_length=5e-4, sigma_angle=5e-4)
    q = sim.plan_poses(machine.nominal, 250, rng)
    table = sim.Instrument(targets={"ball": (0.1, 0.0, 0.1)}, sigma=SIGMA).measure(machine, q, rng=rng)
    return measurements_from_arrays(kuka.joint_names, q, position=np.column_stack([table[axis] for axis in "xyz"]))


def named(kuka: Robot, table: Measurements) -> SearchStep:
    """Return what becomes of the wave, as the one name that was found."""
    wave, first = GearEccentricity("joint_3"), fit_tables(kuka, table, OPTIONS)
    after = refit(first, [*GEOMETRIC, wave])
    step = SearchStep((wave,), ScoreResult(500.0, 2, 1e-50, -480.0), (), first, after, wave, np.zeros(2))
    search = Search(POLICY, (), first, row_groups(table, split="blocked", seed=0) % 8)
    (found,) = judge_remainders(SearchState(first).with_step(step), search).steps
    return found


@pytest.mark.parametrize(("size", "whole", "told"), [(0.0, False, False), (HINT, False, True), (2e-4, True, False)])
def test_a_simple_curve_may_be_part_of_a_whole_one(size: float, whole: bool, told: bool, kuka: Robot) -> None:
    """The drive's curve is an equivalent where the name leaves a hint of it, and is taken where it surely leaves more.

    Of a wave that is all there is nothing is left for a curve.
    """
    found = named(kuka, measured(kuka, WAVE, bumps(size)) if size else measured(kuka, WAVE))
    curves = [effect.locus.joint for effect in found.equivalent if isinstance(effect, TransmissionError)]

    assert isinstance(found.effect, TransmissionError) == whole and curves == ["joint_3"] * told
    assert not whole or GearEccentricity("joint_3").heading in [effect.heading for effect in found.equivalent]


@pytest.mark.long
def test_a_second_name_is_better_than_a_whole_curve(kuka: Robot) -> None:
    """Two waves of one drive are told by their names, or by one that is both; nothing of them is left for its curve."""
    twice = sim.GearEccentricity(joint="joint_3", size=3e-4, order=2, phase=1.0)
    found = run_discovery(kuka, measured(kuka, WAVE, twice), OPTIONS).findings.effects
    names = [(name.effect, name.joint) for entry in found for name in (entry, *entry.equivalent)]

    assert ("gear_eccentricity", "joint_3") in names and {joint for _, joint in names} == {"joint_3"}
    assert ("transmission_error", "joint_3") not in names
