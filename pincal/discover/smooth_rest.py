r"""What is smooth in the joints and has no name, as a remainder that predicts.

After the last name the drives may still err by smooth functions of joints
(:class:`pincal.model.catalogue.SmoothRemainder`). Length and size of these errors are those of
largest evidence, the amplitudes marginalised (type II maximum likelihood; MacKay 1992). The
remainder enters only if each region of joint space that is left out is predicted better with it, to
first order, and all together by more than their scatter. It is no name: it says nothing of causes.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from math import comb

import numpy as np

from pincal.discover.candidate_tests import Search
from pincal.discover.decisions import standard_errors
from pincal.discover.first_order import ScoreTests
from pincal.discover.policy import REMAINDER, TESTING
from pincal.discover.score_tests import score_test
from pincal.discover.steps import History, SearchState
from pincal.identify.calibrate import Tolerance, refit
from pincal.identify.fit import ModelFit
from pincal.model.catalogue.remainder import SmoothRemainder
from pincal.model.conditions import moves

log = logging.getLogger(__name__)


def add_remainder(state: SearchState, search: Search) -> SearchState:
    """Add what is smooth in the joints, if regions that are left out say that it predicts."""
    fit = state.fit
    if not search.remainder:
        return state
    remainder = predicting_remainder(fit, search.groups)
    if remainder is None:
        return state
    log.info("unnamed, smooth: over %.2f rad, %.0f urad", remainder.length, 1e6 * remainder.size)
    effects = [*fit.options.effects, remainder]
    after = refit(fit, effects, start={}, until=Tolerance.CLOSE)
    return state.changed(after, state.steps, (remainder,), ())


def predicting_remainder(fit: ModelFit, groups: np.ndarray) -> SmoothRemainder | None:
    """Return the likeliest remainder with which each block of rows that is left out is predicted
    better; None if none does. The blocks of the rows have shape (N,).
    """
    for remainder in likely_remainders(fit):
        tests = score_test(fit, [remainder], groups, wider=1.0)
        gains = tests.gains_by_block([0])
        if np.all(gains >= 0.0) and standard_errors(gains) > TESTING.predicts:
            return remainder
    return None


def likely_remainders(fit: ModelFit) -> list[SmoothRemainder]:
    """Return remainders that have more evidence than none, of each length with the likeliest size,
    the likeliest first.
    """
    robot = fit.problem.chain.robot
    does = moves(fit.problem.conditions.q)
    kinds = zip(robot.joint_names, robot.joint_types, does, strict=True)
    joints = tuple(joint for joint, kind, is_moved in kinds if kind != "prismatic" and is_moved)
    together = REMAINDER.together
    if len(joints) < together:
        return []
    count = REMAINDER.waves * comb(len(joints), together)
    found: list[tuple[float, SmoothRemainder]] = []
    for length in REMAINDER.lengths:
        remainder = SmoothRemainder(joints, together, length, REMAINDER.sizes[0], count)
        tests = score_test(fit, [remainder], wider=1.0)
        evidence = [_evidence(tests, size / remainder.size) for size in REMAINDER.sizes]
        best = int(np.argmax(evidence))
        if evidence[best] > REMAINDER.evidence:
            found.append((evidence[best], replace(remainder, size=REMAINDER.sizes[best])))
    return [remainder for _, remainder in sorted(found, key=lambda one: -one[0])]


def _evidence(tests: ScoreTests, factor: float) -> float:
    """Return the log evidence of the only candidate with its priors so many times as wide."""
    sizes = tests.sizes.copy()
    sizes[tests.n_model :] *= factor
    return replace(tests, sizes=sizes).log_evidence([0])


def remainder_of(fit: ModelFit) -> SmoothRemainder | None:
    """Return the remainder of a fit; None without any."""
    return next((e for e in fit.problem.effects if isinstance(e, SmoothRemainder)), None)


def note_on_remainder(trail: History) -> str:
    """Return in words what entered without a name, or that nothing did."""
    remainder = remainder_of(trail.final)
    if remainder is None:
        return (
            "unnamed, smooth: nothing entered; no smooth function of pairs of joints predicts "
            "each region that is left out better"
        )
    values = trail.final.estimate.take(trail.final.names_of([remainder])).values
    rms = float(np.sqrt(np.sum(values**2) / 2.0 / len(remainder.joints)))
    return (
        f"unnamed, smooth: the drives err by about {1e6 * rms:.0f} \u00b5rad as smooth functions "
        f"of pairs of joints, alike over {remainder.length:g} rad; each region that is left out "
        "is predicted better with them; they say nothing of causes"
    )
