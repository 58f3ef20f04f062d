"""Going on from what was found in one convention of moments in another that fits better."""

from dataclasses import replace
from itertools import pairwise

import pytest
from discovery_cases import draw_case

from pincal import calibrate
from pincal.discover.candidate_tests import Search
from pincal.discover.history import State
from pincal.discover.loop import add_effects, compare_frames
from pincal.discover.policy import POLICY
from pincal.identify.split import row_groups
from pincal.model.chain import MOMENT_FRAMES


@pytest.mark.long
def test_what_was_found_in_a_wrong_frame_is_taken_over_by_the_one_that_fits_better() -> None:
    """What the wrong one brought about is gone, what is hidden stays, and each step begins where the one before ended."""
    case = draw_case("backlash", 3, n=160, arm="kuka", strength=200.0)
    first = calibrate(case.robot, case.rows, replace(case.options, moment_frame="paper"))
    groups = row_groups(case.rows, split="blocked", seed=0) % 8
    search = Search(POLICY, (), first, groups, MOMENT_FRAMES)
    wrong = add_effects(State(first), search)

    found = compare_frames(wrong, search)

    assert found.fit.problem.chain.moment_frame != wrong.fit.problem.chain.moment_frame
    hidden = [("backlash", case.hidden[0].joint)]
    assert _names(found) == hidden and set(_names(wrong)) > set(hidden)
    assert found.steps[-1].after is found.fit
    for before, after in pairwise(found.steps):
        assert after.before is before.after


def _names(state: State) -> list[tuple[str, str | None]]:
    return [(step.effect.name, step.effect.locus.joint) for step in state.steps if not step.is_elastic]
