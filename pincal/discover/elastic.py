"""Compliances of an arm: which enter together, which are significant, their equivalents, and
deciding measurements.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc

from pincal.discover.candidate_tests import is_small_table, sampled
from pincal.discover.decisions import (
    CandidateTable,
    Decision,
    Row,
    accepted,
    each_heading_once,
    is_supported,
)
from pincal.discover.detectability_numbers import SIGHT
from pincal.discover.first_order import ScoreTests
from pincal.discover.levers import missing_compliances
from pincal.discover.policy import POLICY, Policy
from pincal.discover.products import Information
from pincal.discover.score_numbers import TESTING
from pincal.discover.score_tests import GivenNuisances, score_test
from pincal.identify.beliefs import priors_of
from pincal.identify.calibrate import refit, with_bearings
from pincal.identify.choices import best_of
from pincal.identify.fit import ModelFit
from pincal.identify.quadratic import Factor
from pincal.model.catalogue.bearing_features import bearing_features
from pincal.model.chain import Chain, MomentFrame
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect, Family
from pincal.model.effects import Compliance
from pincal.parameters import Estimate
from pincal.robot.robot import Robot


def _alone(chain: Chain, part: Effect) -> tuple[Effect, ...]:
    """Return a compliance as it enters alone.

    A single bearing has its own principal directions; its place is not observable before it is
    compliant.
    """
    return (part, *(e for e in bearing_features(chain, (part,)) if e.uses_moments))


def elastic_way(
    fit: ModelFit, policy: Policy, test: GivenNuisances | None = None
) -> Decision | None:
    """Return the compliances that a fit lacks; None if they are not significant. ``test`` are the
    tests of this fit that a search has, default: new ones.

    One drive or one bearing enters alone if all others add nothing significant to it: among twenty
    correlated parameters it could not be identified. On a small table drives without bearings, or
    one of either, may be more probable than all.
    """
    chain = fit.problem.chain
    block = missing_compliances(fit)
    if not block:
        return None
    parts = [part for effect in block for part in effect.parts(chain)]
    forms = [_alone(chain, part) for part in parts]
    starts = np.cumsum([0, *map(len, forms)])
    # All arms are compliant, so geometric errors beyond their priors are not preferred to
    # deflection by gravity.
    test = GivenNuisances(fit) if test is None else test
    tests = test([effect for form in forms for effect in form], wider=1.0)
    whole = [int(i) for i in starts[:-1]]
    families = [
        [i for i, part in zip(whole, parts, strict=True) if part.name == effect.name]
        for effect in block
    ]
    singles = [range(a, b) for a, b in pairwise(starts)]
    if is_small_table(fit, policy):
        ways = [
            *zip(zip(parts, strict=True), singles, strict=True),
            *zip(zip(block, strict=True), families, strict=True),
        ]
        return _likeliest(tests, [*ways, (block, whole)], policy)
    chances = _chance(tests, singles), _chance(tests, [whole]), _chance(tests, families)
    every = _row(tests, block[0], whole, 1)
    if not accepted(replace(every, chance=min(chances)), policy):
        return None
    single = _single(tests, parts, singles, whole, policy)
    return Decision(every, effects=block) if single is None else single


def _single(
    tests: ScoreTests,
    parts: Sequence[Effect],
    singles: Sequence[Sequence[int]],
    whole: Sequence[int],
    policy: Policy,
) -> Decision | None:
    """Return the one drive or bearing to which all others add nothing significant; None if they
    do.
    """
    table = CandidateTable(
        [_row(tests, part, of, len(singles)) for part, of in zip(parts, singles, strict=True)],
        tests,
    )
    best = table.cheapest()[0]
    beyond = _chance(tests, [whole], singles[best]), _chance(tests, singles, singles[best])
    single = replace(table.rows[best], chance=_chance(tests, singles))
    if not accepted(single, policy) or min(beyond) < policy.adds_nothing:
        return None
    return Decision(table.rows[best], tuple(table.rivals(best, policy)))


def _row(tests: ScoreTests, effect: Effect, which: Sequence[int], groups: int) -> Row:
    score = tests.score(which, groups)
    return Row(effect, score, score.ebic, which, "elastic")


def _likeliest(
    tests: ScoreTests, ways: Sequence[tuple[tuple[Compliance, ...], Sequence[int]]], policy: Policy
) -> Decision | None:
    """Return the way of largest evidence, corrected for the number of its kind; None if it is not
    accepted.
    """
    kinds = [len(effects) == 1 and effects[0].only is not None for effects, _ in ways]
    evidence = [
        tests.log_evidence(of) - np.log(kinds.count(kind))
        for (_, of), kind in zip(ways, kinds, strict=True)
    ]
    effects, of = ways[int(np.argmax(evidence))]
    row = replace(_row(tests, effects[0], of, 1), question="enter", evidence=max(evidence))
    return Decision(row, effects=effects) if is_supported(row, policy) else None


def with_features(fit: ModelFit, effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Return effects with the features of bearings among them, which are added and removed
    together.
    """
    found = list(effects)
    chain = fit.problem.chain
    for effect in effects:
        if isinstance(effect, Compliance):
            joints = [part.only for part in effect.parts(chain)]
            found += [
                e
                for e in fit.problem.effects
                if e.locus.cause == effect.name and e.locus.joint in joints
            ]
    return tuple(found)


def _chance(tests: ScoreTests, ways: Sequence[Sequence[int]], given: Sequence[int] = ()) -> float:
    """Return the smallest p-value of several ways, corrected for their number, perhaps given others
    in the model.
    """
    scores = (tests.score_given(way, given) if given else tests.score(way, 1) for way in ways)
    return len(ways) * min(score.p_value for score in scores)


class JointCompliance(NamedTuple):
    """A compliance of one joint that is significant.

    Attributes:
        effect: the drive or the bearing.
        estimate: its parameters and features.
        p_value: of its compliances, perhaps conditional on another one, or of the whole step if
            none is significant.
        others: compliances that it could be instead.
        given: parameters of another compliance, if it is significant only conditional on that.
    """

    effect: Effect
    estimate: Estimate
    p_value: float
    others: tuple[Effect, ...]
    given: tuple[str, ...] = ()


def significant_compliances(
    fit: ModelFit, effects: Iterable[Effect], equivalent: tuple[Effect, ...] = ()
) -> list[JointCompliance]:
    """Return the compliances among effects of a fit that are significantly different from zero,
    largest statistic first.

    If none is, the first alone is returned, with the others and ``equivalent`` as rivals, and the
    p-value of all together.
    """
    found = list[tuple[float, int, JointCompliance]]()
    chain = fit.problem.chain
    for effect in effects:
        if not isinstance(effect, Compliance):
            continue
        likes = [e for e in fit.problem.effects if e.heading[0] == effect.heading[0]]
        own = [parameter for e in likes for parameter in e.parameters(chain)]
        for single in effect.parts(chain):
            estimate = fit.estimate.take(p.name for p in own if p.element == single.only)
            z2, size = _squares(estimate)
            found.append(
                (z2, size, JointCompliance(single, estimate, float(chdtrc(size, z2)), equivalent))
            )
    found.sort(key=lambda item: -item[0])
    sure = [(z2, entry) for z2, size, entry in found if z2 > TESTING.sure**2 * size]
    sure += _significant_given(
        fit, [entry for z2, size, entry in found if z2 <= TESTING.sure**2 * size]
    )
    if sure:
        return [entry for _, entry in sorted(sure, key=lambda item: -item[0])]
    first, *others = (entry for _, _, entry in found)
    rivals = each_heading_once(
        (*equivalent, *(other.effect for other in others)), first.effect, POLICY
    )
    z2, size = _squares(
        fit.estimate.take({name for _, _, entry in found for name in entry.estimate.names})
    )
    return [first._replace(others=rivals, p_value=float(chdtrc(size, z2)))]


def _squares(estimate: Estimate, known: Estimate | None = None) -> tuple[float, int]:
    """Return Wald's statistic of compliances, and their number; ``known`` are these, then others
    conditioned on.
    """
    # The place of a bearing is not part of the test.
    bends = [
        np.array([p.is_compliance for p in some.parameters])
        for some in (estimate, known or estimate)
    ]
    values = estimate.values[bends[0]]
    size = int(bends[0].sum())
    covariance = (known or estimate).dense_covariance()[np.ix_(bends[1], bends[1])]
    information = np.linalg.pinv(covariance, hermitian=True)[:size, :size]
    return float(values @ information @ values), size


def _significant_given(
    fit: ModelFit, uncertain: Sequence[JointCompliance]
) -> Iterator[tuple[float, JointCompliance]]:
    """Yield Wald's statistic and compliances that are significant conditional on another one, each
    with the best such.

    A drive and the bearing of the previous joint may be nearly equivalent: that one of them is
    compliant is significant, but not which.
    """
    for one in uncertain:
        pairs = []
        for other in (entry for entry in uncertain if entry is not one):
            z2, size = _squares(
                one.estimate, fit.estimate.take((*one.estimate.names, *other.estimate.names))
            )
            pairs.append((z2, size, other))
        z2, size, other = max(pairs, key=lambda pair: pair[0], default=(0.0, 1, one))
        if z2 > TESTING.sure**2 * size:
            others = each_heading_once((other.effect, *one.others), one.effect, POLICY)
            yield (
                z2,
                one._replace(
                    p_value=float(chdtrc(size, z2)), others=others, given=other.estimate.names
                ),
            )


def instead_of(
    tests: ScoreTests,
    compliance: Effect,
    estimate: Estimate,
    given: Collection[str] = (),
    policy: Policy = POLICY,
) -> tuple[Effect, ...]:
    """Return the effects of loads that explain the data as well as one joint's compliances do.

    A tilting bearing is equivalent to a tilting foundation at the first joint, and to a bending
    link at others; as all bearings entered together, none of them was tested against these.

    The tests are against the last model, which includes the compliance, with parameters
    ``estimate``. Parameters ``given`` of another compliance are held fixed, as it would absorb most
    itself.
    """
    # Without compliance the place of a bearing has no effect, so it is kept.
    lost = {
        p.name: float(value) * p.is_compliance
        for p, value in zip(estimate.parameters, estimate.values, strict=True)
    }
    # An effect in the same place is a finer form of it.
    loads = [
        i
        for i, e in enumerate(tests.effects)
        if e.family is Family.LOAD and _place(e) != _place(compliance)
    ]
    if given and loads:
        tests = _holding(tests.among(loads, ()), given)
        loads = list(range(len(loads)))
    costs = sorted(zip(costs_instead(tests, loads, lost), loads, strict=True))
    rivals = [tests.effects[i] for cost, i in costs if cost < policy.tie]
    return each_heading_once(rivals, compliance, policy)


def _holding(tests: ScoreTests, names: Collection[str]) -> ScoreTests:
    """Return the same tests against the model with some of its parameters held fixed."""
    held = np.array([name in names for name in tests.names])
    H = tests.model.of_priors + np.diag(held * np.diag(tests.model.rows.H) * TESTING.held)
    return replace(tests, model=Information(tests.model.blocks, replace(tests.model.prior, H=H)))


def costs_instead(
    tests: ScoreTests, which: Sequence[int], lost: Mapping[str, float]
) -> list[float]:
    """Return the changes of the information criterion if each candidate replaced some parameters of
    the model.

    To first order: from a model with both, the parameters are reduced by ``lost``.
    """
    j = np.array([i for i, name in enumerate(tests.names) if name in lost], int)
    columns = tests.model.factor.solve(np.eye(tests.n_model)[:, j])
    values = np.array([lost[tests.names[i]] for i in j]) + columns.T @ (
        tests.model.rows.g + tests.model.prior.g
    )
    spared = float(np.sum(np.clip(1.0 - np.diag(columns[j]) * tests.precision[j], 0.0, 1.0)))
    costs = []
    for i, (c, S, b) in ((i, tests.within([i])) for i in which):
        inverse = np.linalg.inv(S + tests.prior([i]))
        cross = columns.T @ tests.cross[:, c]
        rest = values - cross @ inverse @ b
        loss = (
            rest @ np.linalg.solve(columns[j] + cross @ inverse @ cross.T, rest) - b @ inverse @ b
        )
        costs.append(float(loss + (len(c) - spared) * np.log(tests.readings)))
    return costs


def without_compliance(fit: ModelFit, *compliances: Effect) -> ModelFit:
    """Return a fit without some compliances, of one joint each, not refitted, but with the noise of
    a refit.

    To first order the squares increase by Wald's statistic of the compliances.
    """
    effects = fit.options.effects
    for compliance in compliances:
        effects = tuple(_without(effects, compliance, fit.problem.chain.robot.joint_names))
    near = fit.with_effects(effects)
    known = {parameter.name for parameter in near.problem.parameters}
    lost = fit.estimate.take(name for name in fit.estimate.names if name not in known)
    grown = float(
        lost.values @ np.linalg.pinv(lost.dense_covariance(), hermitian=True) @ lost.values
    )
    noise = fit.solution.sigma**2 * grown / fit.solution.degrees
    solution = replace(near.solution, estimated=np.sqrt(fit.solution.estimated**2 + noise))
    return replace(near, solution=solution, priors=priors_of(near.problem, near.options))


def _without(
    effects: Iterable[Effect], compliance: Effect, joints: Sequence[str]
) -> Iterator[Effect]:
    """Yield effects without the compliance of one joint and its features."""
    joint = compliance.locus.joint
    for effect in effects:
        own = effect.heading[0] == compliance.heading[0]
        if own and isinstance(effect, Compliance):
            have = joints if effect.joints is None else effect.joints
            yield replace(effect, joints=tuple(name for name in have if name != joint))
        elif own and effect.locus.joint is None:
            # Features of all bearings are kept for the others.
            feature: Any = effect
            yield from (replace(feature, joint=name) for name in joints if name != joint)
        elif not own or effect.locus.joint != joint:
            yield effect


def _place(effect: Effect) -> tuple[str | None, str, str | None]:
    return effect.locus.joint, effect.locus.acts_on, effect.locus.follows


def deciding_measurement(fit: ModelFit, effect: Effect, value: np.ndarray, *rivals: Effect) -> str:
    """Return, in words, the cheapest further measurement that would distinguish an effect from
    rivals, all together.

    The power of each kind of further run is computed from the Jacobian at its poses, for a fit
    without the effect, and its parameters, shape (K,).
    """
    few, _ = sampled(fit, POLICY)
    stations = few.problem.stations
    rows_each = len(fit.problem) / len(few.problem)

    def tests_at(poses: Iterable[Conditions]) -> ScoreTests:
        there = few.over(replace(at, conditions=c) for at, c in zip(stations, poses, strict=True))
        return score_test(there, [effect, *rivals])

    here = tests_at(station.conditions for station in stations)
    designs = [_runs(few.problem.chain, station.conditions) for station in stations]
    for words in (words for words in designs[0] if all(words in others for others in designs)):
        try:
            there = tests_at(design[words] for design in designs)
        except (ValueError, KeyError):
            continue
        power = _separation([here, there], rows_each, value)
        if power > SIGHT.told_apart and power > SIGHT.telling * _separation(
            [here, here], rows_each, value
        ):
            return words
    many = SIGHT.told_apart / max(_separation([here], rows_each, value), 1e-9)
    if many < SIGHT.repetitions:
        return f"about {int(np.ceil(many)) * len(fit.problem)} poses of this kind"
    return (
        "no further measurement of this kind distinguishes them; inspect the joint itself, or "
        "its drive's own encoder"
    )


def _separation(runs: Sequence[ScoreTests], weight: float, value: np.ndarray) -> float:
    """Return the squared signal in all runs of the first effect, of parameters ``value``, that the
    others can't absorb.
    """
    c, *others = runs[0].columns
    g = np.concatenate(others)
    whole, cross, inner = (
        np.asarray(weight * sum(of))
        for of in (
            (run.model.rows.H for run in runs),
            (run.cross for run in runs),
            (run.inner for run in runs),
        )
    )
    taken = Factor.of(whole + runs[0].model.of_priors).half(cross)
    S = inner - taken.T @ taken
    G = S[np.ix_(g, g)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(G), 1e-300))
    taken = (
        scale[:, None]
        * np.linalg.pinv(G * np.outer(scale, scale), rcond=1e-6, hermitian=True)
        * scale
    )
    return float(
        max(value @ (S[np.ix_(c, c)] - S[np.ix_(c, g)] @ taken @ S[np.ix_(g, c)]) @ value, 0.0)
    )


def _second_load(robot: Robot, c: Conditions) -> float:
    """Return a payload that differs well from that of these poses [kg]."""
    if not np.any(c.payload):
        return 0.1 * float(robot.masses.sum())
    return 2.0 * float(c.payload.max())


# Two of the further runs.
_OTHER_SIDE = "the same poses with the instrument on another side of the robot, as a second station"
_BOTH_WAYS = "the same poses approached from both directions, with the columns approach_<joint>"


def _runs(chain: Chain, c: Conditions) -> dict[str, Conditions]:
    """Return further runs that a user could make instead of these poses, cheapest first; cached."""
    runs: dict[str, Conditions] = chain.kept.about("further runs", c, most=16)
    if runs:
        return runs
    robot = chain.robot
    rng = np.random.default_rng(0)
    if c.sighted is not None:
        # A quarter turn around the poses, its axes unchanged; relocating it costs six readings.
        x, y, _ = c.sighted.mean(axis=0)
        runs[_OTHER_SIDE] = replace(c, sighted=c.sighted - [x + y, y - x, 0.0])
    if np.ptp(c.payload) == 0.0:
        load = np.full(len(c), _second_load(robot, c))
        runs["the same poses with a second payload"] = replace(c, payload=load)
    if c.approach is None or not np.ptp(c.approach):
        runs[_BOTH_WAYS] = replace(c, approach=rng.choice([-1.0, 1.0], c.q.shape))
    if c.move is not None:
        moves = np.random.default_rng(1).choice(SIGHT.moves, c.q.shape)
        reached = replace(c, move=moves, approach=np.sign(moves))
        runs["the same poses, each reached by long and by short moves from both sides"] = reached
    temperature = np.full(len(c), 20.0) if c.temperature is None else c.temperature
    if np.ptp(temperature) < SIGHT.warmer:
        warm = replace(c, temperature=temperature + SIGHT.warmer)
        runs["the same poses warm and cold, with the column temperature"] = warm
    anywhere = replace(c, q=robot.random_configurations(len(c), rng), sighted=None)
    runs["poses over the whole range of the joints"] = anywhere
    return runs


def likeliest_fit(
    fit: ModelFit, compliances: Sequence[Effect], frames: Sequence[MomentFrame]
) -> ModelFit:
    """Return a fit with compliances in the moment frame in which they explain most; the first
    unless significant.

    The comparison includes bearing features that the data require; these may enter after names.
    """
    effects = [*fit.options.effects, *compliances]
    fits = {frame: refit(fit, effects, moment_frame=frame) for frame in frames}
    return fits[best_of([with_bearings(other) for other in fits.values()])]
