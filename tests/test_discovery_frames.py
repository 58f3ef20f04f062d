"""Going on from what was found in one convention of moments in another that fits better."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from discovery_cases import SIGMA, draw_case

from pincal import ELASTIC, GEOMETRIC, Options, Robot, calibrate, measurements_from_arrays
from pincal.discover.candidate_tests import Search, is_small_table, variants
from pincal.discover.loop import _still_to_gain, compare_frames, discover_effects
from pincal.discover.policy import POLICY
from pincal.discover.score_tests import score_test
from pincal.discover.steps import SearchState, add_effects
from pincal.identify.calibrate import refit
from pincal.identify.split import row_groups
from pincal.model.chain import MOMENT_FRAMES


@pytest.mark.long
def test_what_was_found_in_a_wrong_frame_is_taken_over_by_the_one_that_fits_better() -> None:
    """What the wrong one brought about is gone, what is hidden stays, and each step begins where the one before ended."""
    case = draw_case("backlash", 3, n=160, arm="kuka", strength=200.0)
    first = calibrate(case.robot, case.rows, replace(case.options, moment_frame="paper"))
    groups = row_groups(case.rows, split="blocked", seed=0) % 8
    search = Search(POLICY, (), first.fit, groups, MOMENT_FRAMES)
    wrong = add_effects(SearchState(first.fit), search)

    found = compare_frames(wrong, search)

    assert found.fit.problem.chain.moment_frame != wrong.fit.problem.chain.moment_frame
    hidden = [("backlash", case.hidden[0].joint)]
    assert _names(found) == hidden and set(_names(wrong)) > set(hidden)
    assert found.steps[-1].after is found.fit
    for before, after in pairwise(found.steps):
        assert after.before is before.after


def test_a_base_that_moves_with_time_is_nothing_for_another_frame_to_gain() -> None:
    """Only loads may stand for what a bearing does in another convention."""
    robot, rng = Robot.from_urdf("ur10"), np.random.default_rng(0)
    q, time = robot.random_configurations(700, rng), np.linspace(0.0, 3600.0, 700)
    position = robot.forward_kinematics(q)[:, :3, 3] + 1e-4 * rng.standard_normal((700, 3))
    position[:, 2] += 3e-3 * time / time[-1]
    table = measurements_from_arrays(robot.joint_names, q, position=position, time=time)
    fit = calibrate(robot, table, Options(effects=GEOMETRIC, sigma=1e-4, serial=False))
    effects = list(variants(fit.fit, ("base",)))
    tests = score_test(fit.fit, effects)
    sure = [e.name for i, e in enumerate(effects) if tests.score([i], len(effects)).p_value < 1e-12]
    assert "base_drift" in sure
    search = Search(POLICY, (), fit.fit, row_groups(table, split="blocked", seed=0) % 8)
    assert not is_small_table(fit.fit, POLICY) and _still_to_gain(fit.fit, search) == 0.0


@pytest.mark.long
def test_loads_have_something_to_gain_where_they_predict_rows_left_out() -> None:
    """A base that is compliant; in rows left out at random and in none but one block, which tells nothing of others."""
    case = draw_case("base_elasticity", 9662, n=200, strength=200.0)
    fit = calibrate(case.robot, case.rows, replace(case.options, effects=ELASTIC))
    blocks, one = np.arange(len(case.rows)) % 8, np.zeros(len(case.rows), int)
    searches = [Search(POLICY, (), fit.fit, groups) for groups in (blocks, one)]

    assert [_still_to_gain(fit.fit, search) < 0.0 for search in searches] == [True, False]


@pytest.mark.long
def test_what_a_discovery_ends_with_is_settled() -> None:
    """Fits on the way end early: the last one, of few rows as of many, has nothing left to gain."""
    case = draw_case("backlash", 3, n=160, strength=200.0)
    first = calibrate(case.robot, case.rows, case.options)
    trail = discover_effects(first.fit, row_groups(case.rows, split="blocked", seed=0) % 8)
    again = refit(trail.final, trail.final.options.effects, start={})
    moved = [f.station.residuals(f.values) for f in (trail.final, again)]

    assert trail.changes[-1].fit is trail.final
    assert {id(step.after) for step in trail.steps} <= {id(change.fit) for change in trail.changes}
    np.testing.assert_allclose(*moved, rtol=0.0, atol=2e-3 * SIGMA)


def _names(state: SearchState) -> list[tuple[str, str | None]]:
    return [(step.effect.name, step.effect.locus.joint) for step in state.steps if not step.is_elastic]
