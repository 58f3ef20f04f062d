"""How an arm is compliant: what enters as one, which compliances are sure, what else could be, and what would tell."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc

from pincal.discover.candidate_tests import is_small_table, sampled
from pincal.discover.decisions import CandidateTable, Decision, Row, accepted, each_heading_once
from pincal.discover.first_order import ScoreTests
from pincal.discover.levers import missing_compliances
from pincal.discover.policy import POLICY, SIGHT, TESTING, Policy
from pincal.discover.products import Information
from pincal.discover.score_tests import score_test, score_test_given_nuisances
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


def elastic_way(fit: ModelFit, policy: Policy) -> Decision | None:
    """Return how an arm is compliant beyond a fit; None if that is no more than chance.

    Where one drive or one bearing leaves nothing but chance to the others, it enters alone: among twenty parameters that
    trade with each other nobody could tell which it is. On a small table what bends least is enough: drives without
    bearings, or one of either, if that is likelier before the data than all.
    """
    chain, block = fit.problem.chain, missing_compliances(fit)
    if not block:
        return None
    parts = [part for effect in block for part in effect.parts(chain)]
    # One bearing alone is compliant in directions of its own; where it sits, nothing shows before it is compliant.
    forms = [(part, *(e for e in bearing_features(chain, (part,)) if e.uses_moments)) for part in parts]
    starts = np.cumsum([0, *map(len, forms)])
    # All arms are compliant: what gravity bends is not left to geometry that nobody would have built.
    tests = score_test_given_nuisances(fit, [effect for form in forms for effect in form], wider=1.0)
    whole = [int(i) for i in starts[:-1]]
    families = [[i for i, part in zip(whole, parts, strict=True) if part.name == effect.name] for effect in block]
    singles = [range(a, b) for a, b in pairwise(starts)]
    if is_small_table(fit, policy):
        ways = [*zip(zip(parts, strict=True), singles, strict=True), *zip(zip(block, strict=True), families, strict=True)]
        return _likeliest(tests, [*ways, (block, whole)], policy)
    chances = _chance(tests, singles), _chance(tests, [whole]), _chance(tests, families)
    every = _row(tests, block[0], whole, 1)
    if not _is_accepted(every, min(chances), policy):
        return None
    table = CandidateTable([_row(tests, part, of, len(singles)) for part, of in zip(parts, singles, strict=True)], tests)
    best = table.cheapest()[0]
    beyond = _chance(tests, [whole], singles[best]), _chance(tests, singles, singles[best])
    if not _is_accepted(table.rows[best], chances[0], policy) or min(beyond) < policy.adds_nothing:
        return Decision(every, effects=block)
    return Decision(table.rows[best], tuple(table.rivals(best, policy)))


def _row(tests: ScoreTests, effect: Effect, which: Sequence[int], groups: int) -> Row:
    score = tests.score(which, groups)
    return Row(effect, score, score.ebic, which, "elastic")


def _is_accepted(row: Row, p_value: float, policy: Policy) -> bool:
    """Return whether a row is accepted by another p-value than that of its own test."""
    return accepted(replace(row, score=replace(row.score, p_value=p_value)), policy)


def _likeliest(
    tests: ScoreTests, ways: Sequence[tuple[tuple[Compliance, ...], Sequence[int]]], policy: Policy
) -> Decision | None:
    """Return the way that is likeliest before the data, the choice among as many of its kind paid for; None without any."""
    kinds = [len(effects) == 1 and effects[0].only is not None for effects, _ in ways]
    evidence = [tests.log_evidence(of) - np.log(kinds.count(kind)) for (_, of), kind in zip(ways, kinds, strict=True)]
    effects, of = ways[int(np.argmax(evidence))]
    # What is known beforehand decides, whatever chance would make of it.
    row = replace(_row(tests, effects[0], of, 1), question="enter", evidence=max(evidence))
    return Decision(row, effects=effects) if _is_accepted(row, 0.0, policy) else None


def with_features(fit: ModelFit, effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Return effects, and of bearings among them what else a fit knows of each, which goes where they go."""
    found, chain = list(effects), fit.problem.chain
    for effect in effects:
        if isinstance(effect, Compliance):
            joints = [part.only for part in effect.parts(chain)]
            found += [e for e in fit.problem.effects if e.locus.cause == effect.name and e.locus.joint in joints]
    return tuple(found)


def _chance(tests: ScoreTests, ways: Sequence[Sequence[int]], given: Sequence[int] = ()) -> float:
    """Return the p-value of the surest of several ways, the choice among them paid for; beside what is given."""
    scores = (tests.score_given(way, given) if given else tests.score(way, 1) for way in ways)
    return len(ways) * min(score.p_value for score in scores)


class Sure(NamedTuple):
    """A compliance of one joint that is far from zero.

    Attributes:
        effect: the drive or the bearing.
        estimate: its parameters and those of the same name that go with them.
        p_value: the chance of compliances as large if there were none: of its own, with that other one as it is if it
            is sure only so, or of all of its step where none is sure.
        others: what could be compliant instead: none of its step is sure, or the data can't tell it from these.
        beside: parameters of the other one, if it is sure only together with another.
    """

    effect: Effect
    estimate: Estimate
    p_value: float
    others: tuple[Effect, ...]
    beside: tuple[str, ...] = ()


def sure_compliances(fit: ModelFit, effects: Iterable[Effect], equivalent: tuple[Effect, ...] = ()) -> list[Sure]:
    """Return the compliances among effects that are far from zero, the surest first.

    Args:
        fit: the fit in which they are.
        effects: what entered together.
        equivalent: what the data can't tell from it.

    Returns:
        If none is far from zero, the surest alone, with the others in its place and the p-value of all together.
    """
    found, chain = list[tuple[float, int, Sure]](), fit.problem.chain
    for effect in effects:
        if not isinstance(effect, Compliance):
            continue
        likes = [e for e in fit.problem.effects if e.heading[0] == effect.heading[0]]
        own = [parameter for e in likes for parameter in e.parameters(chain)]
        for single in effect.parts(chain):
            estimate = fit.estimate.take(p.name for p in own if p.element == single.only)
            z2, size = _squares(estimate)
            found.append((z2, size, Sure(single, estimate, float(chdtrc(size, z2)), equivalent)))
    found.sort(key=lambda item: -item[0])
    sure = [(z2, entry) for z2, size, entry in found if z2 > TESTING.sure**2 * size]
    sure += _sure_together(fit, [entry for z2, size, entry in found if z2 <= TESTING.sure**2 * size])
    if sure:
        return [entry for _, entry in sorted(sure, key=lambda item: -item[0])]
    first, *others = (entry for _, _, entry in found)
    rivals = each_heading_once((*equivalent, *(other.effect for other in others)), first.effect, POLICY)
    z2, size = _squares(fit.estimate.take({name for _, _, entry in found for name in entry.estimate.names}))
    return [first._replace(others=rivals, p_value=float(chdtrc(size, z2)))]


def _squares(estimate: Estimate, known: Estimate | None = None) -> tuple[float, int]:
    """Return the squares of compliances in units of their covariance, and their number.

    Some that trade with each other may be sure together and none of them alone.

    Args:
        estimate: the parameters.
        known: these first, then others that are taken to be as they are; default: without others.
    """
    # Where one sits says nothing of whether it is compliant.
    bends = [np.array([p.is_compliance for p in some.parameters]) for some in (estimate, known or estimate)]
    values, size = estimate.values[bends[0]], int(bends[0].sum())
    covariance = (known or estimate).dense_covariance()[np.ix_(bends[1], bends[1])]
    information = np.linalg.pinv(covariance, hermitian=True)[:size, :size]
    return float(values @ information @ values), size


def _sure_together(fit: ModelFit, doubtful: Sequence[Sure]) -> Iterator[tuple[float, Sure]]:
    """Yield the compliances that would be sure if another one stayed as it is, each with that of which this holds most.

    Their squares come first.

    A drive and the bearing of the joint before may turn an arm nearly alike; that one is compliant is sure, not which.
    """
    for one in doubtful:
        pairs = []
        for other in (entry for entry in doubtful if entry is not one):
            z2, size = _squares(one.estimate, fit.estimate.take((*one.estimate.names, *other.estimate.names)))
            pairs.append((z2, size, other))
        z2, size, other = max(pairs, key=lambda pair: pair[0], default=(0.0, 1, one))
        if z2 > TESTING.sure**2 * size:
            others = each_heading_once((other.effect, *one.others), one.effect, POLICY)
            yield z2, one._replace(p_value=float(chdtrc(size, z2)), others=others, beside=other.estimate.names)


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
    lost = {p.name: float(value) * p.is_compliance for p, value in zip(estimate.parameters, estimate.values, strict=True)}
    # What acts in the same place is a finer form of it.
    loads = [i for i, e in enumerate(tests.effects) if e.family is Family.LOAD and _place(e) != _place(compliance)]
    if beside and loads:
        tests, loads = _holding(tests.among(loads, ()), beside), list(range(len(loads)))
    costs = sorted(zip(costs_instead(tests, loads, lost), loads, strict=True))
    rivals = [tests.effects[i] for cost, i in costs if cost < policy.tie]
    return each_heading_once(rivals, compliance, policy)


def _holding(tests: ScoreTests, names: Collection[str]) -> ScoreTests:
    """Return the same tests against the model with some of its parameters held where they are."""
    held = np.array([name in names for name in tests.names])
    H = tests.model.prior.H + np.diag(held * np.diag(tests.model.rows.H) * TESTING.held)
    return replace(tests, model=Information(tests.model.blocks, replace(tests.model.prior, H=H)))


def costs_instead(tests: ScoreTests, which: Sequence[int], lost: Mapping[str, float]) -> list[float]:
    """Return the changes of the information criterion if each candidate took the place of some parameters of the model.

    Both are in the model first, priors included, and these parameters then lose what they are told to, to first order.
    """
    j = np.array([i for i, name in enumerate(tests.names) if name in lost], int)
    columns = tests.model.factor.solve(np.eye(tests.n_model)[:, j])
    values = np.array([lost[tests.names[i]] for i in j]) + columns.T @ (tests.model.rows.g + tests.model.prior.g)
    spared = float(np.sum(np.clip(1.0 - np.diag(columns[j]) * tests.precision[j], 0.0, 1.0)))
    costs = []
    for i, (c, S, b) in ((i, tests.within([i])) for i in which):
        inverse = np.linalg.inv(S + tests.prior([i]))
        cross = columns.T @ tests.cross[:, c]
        left = values - cross @ inverse @ b
        loss = left @ np.linalg.solve(columns[j] + cross @ inverse @ cross.T, left) - b @ inverse @ b
        costs.append(float(loss + (len(c) - spared) * np.log(tests.readings)))
    return costs


def without_compliance(fit: ModelFit, *compliances: Effect) -> ModelFit:
    """Return a fit as it stands without some compliances, of one joint each, its noise that of a fit of everything else.

    To first order that takes no fit: the squares grow by those of the compliances, in units of their covariance.
    """
    effects = fit.options.effects
    for compliance in compliances:
        effects = tuple(_without(effects, compliance, fit.problem.chain.robot.joint_names))
    near = fit.with_effects(effects)
    known = {parameter.name for parameter in near.problem.parameters}
    lost = fit.estimate.take(name for name in fit.estimate.names if name not in known)
    grown = float(lost.values @ np.linalg.pinv(lost.dense_covariance(), hermitian=True) @ lost.values)
    noise = fit.solution.sigma**2 * grown / fit.solution.degrees
    solution = replace(near.solution, estimated=np.sqrt(fit.solution.estimated**2 + noise))
    return replace(near, solution=solution, priors=priors_of(near.problem, near.options))


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


def deciding_measurement(fit: ModelFit, effect: Effect, value: np.ndarray, *rivals: Effect) -> str:
    """Return, in words, the cheapest further measurement that would tell an effect from a rival, or several together.

    For each kind of further run the power to tell them apart is computed from the Jacobian at its poses.

    Args:
        fit: the fit before the effect was added.
        effect: the effect.
        value: its parameters, shape (K,).
        rivals: the other one, or those that are together equivalent.
    """
    few, _ = sampled(fit, POLICY)
    stations, rows_each = few.problem.stations, len(fit.problem) / len(few.problem)

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
        told = _separation([here, there], rows_each, value)
        if told > SIGHT.told_apart and told > SIGHT.telling * _separation([here, here], rows_each, value):
            return words
    many = SIGHT.told_apart / max(_separation([here], rows_each, value), 1e-9)
    if many < SIGHT.repetitions:
        return f"about {int(np.ceil(many)) * len(fit.problem)} poses of this kind"
    return "no further measurement of this kind distinguishes them; inspect the joint itself, or its drive's own encoder"


def _separation(runs: Sequence[ScoreTests], weight: float, value: np.ndarray) -> float:
    """Return the signal of the first effect that the others can't take over, squared, in units of the noise.

    Args:
        runs: the tests of all at the poses of each run.
        weight: of each row.
        value: the parameters of the first.
    """
    c, *others = runs[0].columns
    g = np.concatenate(others)
    whole, cross, inner = (
        np.asarray(weight * sum(of))
        for of in ((run.model.rows.H for run in runs), (run.cross for run in runs), (run.inner for run in runs))
    )
    taken = Factor.of(whole + runs[0].model.prior.H).half(cross)
    S = inner - taken.T @ taken
    G = S[np.ix_(g, g)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(G), 1e-300))
    taken = scale[:, None] * np.linalg.pinv(G * np.outer(scale, scale), rcond=1e-6, hermitian=True) * scale
    left = S[np.ix_(c, c)] - S[np.ix_(c, g)] @ taken @ S[np.ix_(g, c)]
    return float(max(value @ left @ value, 0.0))


def _runs(chain: Chain, c: Conditions) -> dict[str, Conditions]:
    """Return further runs that a user could make instead of these poses, cheapest first; the same objects if asked again."""
    runs: dict[str, Conditions] = chain.kept.about("further runs", c, most=16)
    if runs:
        return runs
    robot, rng = chain.robot, np.random.default_rng(0)
    if c.sighted is not None:
        # A quarter of the way around the poses, its axes as they are; that its place is found anew costs six readings.
        x, y, _ = c.sighted.mean(axis=0)
        away = replace(c, sighted=c.sighted - [x + y, y - x, 0.0])
        runs["the same poses with the instrument on another side of the robot, as a second station"] = away
    load = 0.1 * float(robot.masses.sum()) if not np.any(c.payload) else 2.0 * float(c.payload.max())
    if np.ptp(c.payload) == 0.0:
        runs["the same poses with a second payload"] = replace(c, payload=np.full(len(c), load))
    if c.approach is None or not np.ptp(c.approach):
        sides = replace(c, approach=rng.choice([-1.0, 1.0], c.q.shape))
        runs["the same poses approached from both directions, with the columns approach_<joint>"] = sides
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


def likeliest_fit(fit: ModelFit, compliances: Sequence[Effect], frames: Sequence[MomentFrame]) -> ModelFit:
    """Return a fit with compliances in the convention in which they explain most; the first unless beyond chance.

    What the data call for of the bearings takes part in the choice, and may enter once names have had their turn.
    """
    effects = [*fit.options.effects, *compliances]
    fits = {frame: refit(fit, effects, moment_frame=frame) for frame in frames}
    return fits[best_of([with_bearings(other) for other in fits.values()])]
