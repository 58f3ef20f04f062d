"""What else could give way in the place of one joint's drive or bearing."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pincal.discover.decisions import each_heading_once
from pincal.discover.policy import POLICY, Policy
from pincal.discover.score_tests import ScoreTests
from pincal.identify.beliefs import priors_of
from pincal.identify.fit import Fit, carried
from pincal.model.effect import Effect, Family
from pincal.model.effects import Compliance
from pincal.parameters import Estimate


def instead_of(
    tests: ScoreTests, compliance: Effect, estimate: Estimate, beside: Collection[str] = (), policy: Policy = POLICY
) -> tuple[Effect, ...]:
    """Return the effects of loads that explain the data as well as one joint's compliances do.

    A bearing that tilts with the link before is, at the first joint, the foundation that tilts, and at others the end of a
    link that bends; all bearings came in together, so that none of them was ever judged against these.

    Args:
        tests: those against the last model, in which the compliance is.
        compliance: the effect, of one joint.
        estimate: its parameters.
        beside: parameters of another compliance, which stays as it is, or it would take over most itself.
        policy: what counts as a tie.
    """
    # Without the compliance it does not matter where it sits: that stays as it is.
    lost = {
        p.name: float(value) * p.unit.endswith("/(N m)")
        for p, value in zip(estimate.parameters, estimate.values, strict=True)
    }
    # What acts in the same place is a finer form of it.
    loads = [i for i, e in enumerate(tests.effects) if e.family is Family.LOAD and _place(e) != _place(compliance)]
    if beside and loads:
        tests, loads = tests.among(loads, ()).holding(beside), list(range(len(loads)))
    costs = sorted(zip(tests.costs_instead(loads, lost), loads, strict=True))
    rivals = [tests.effects[i] for cost, i in costs if cost < policy.tie]
    return each_heading_once(rivals, compliance, policy)


def without_compliance(fit: Fit, *compliances: Effect) -> Fit:
    """Return a fit as it stands without some compliances, of one joint each, its noise that of a fit of everything else.

    To first order that takes no fit: the squares grow by those of the compliances, in units of their covariance.
    """
    effects = fit.options.effects
    for compliance in compliances:
        effects = tuple(_without(effects, compliance, fit.problem.chain.robot.joint_names))
    problem = fit.problem.with_effects(effects)
    options = replace(fit.options, effects=effects)
    known = {parameter.name for parameter in problem.parameters}
    lost = fit.estimate.take(name for name in fit.estimate.names if name not in known)
    grown = float(lost.values @ np.linalg.pinv(lost.dense_covariance(), hermitian=True) @ lost.values)
    near, noise = carried(fit.solution, fit.problem, problem), fit.solution.sigma**2 * grown / fit.solution.degrees
    return replace(
        fit,
        problem=problem,
        nominal=carried(fit.nominal, fit.problem, problem),
        solution=replace(near, estimated=np.sqrt(fit.solution.estimated**2 + noise)),
        priors=priors_of(problem, options),
        options=options,
    )


def _without(effects: Iterable[Effect], compliance: Effect, joints: Sequence[str]) -> Iterator[Effect]:
    """Yield effects without the compliance of one joint and what else there is to know of it."""
    joint = compliance.locus.joint
    for effect in effects:
        own = effect.heading[0] == compliance.heading[0]
        if own and isinstance(effect, Compliance):
            have = joints if effect.joints is None else effect.joints
            yield replace(effect, joints=tuple(name for name in have if name != joint))
        elif own and effect.locus.joint is None:
            # What else there is to know of all bearings stays with the others.
            feature: Any = effect
            yield from (replace(feature, joint=name) for name in joints if name != joint)
        elif not own or effect.locus.joint != joint:
            yield effect


def _place(effect: Effect) -> tuple[str | None, str, str | None]:
    return effect.locus.joint, effect.locus.acts_on, effect.locus.follows
