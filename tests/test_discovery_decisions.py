"""What a discovery decides, from tables alone: no robot, no fit, no data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pincal.discover import backward
from pincal.discover.decisions import (
    CandidateTable,
    Decision,
    Row,
    Unfitted,
    accepted,
    decide,
    each_heading_once,
    is_own_curve,
)
from pincal.discover.first_order import ScoreResult
from pincal.discover.policy import Policy
from pincal.model.catalogue import (
    AxisWobble,
    Backlash,
    GearEccentricity,
    GearRatio,
    GravityCompensator,
    JointCoupling,
    TransmissionError,
    Unnamed,
)
from pincal.model.effect import Effect

POLICY = Policy()
LEAST = 20.0
RATIO, WAVE, PLAY, OTHER = GearRatio("a"), GearEccentricity("a"), Backlash("a"), GearRatio("b")
SPRING = GravityCompensator("a")
CURVE, FINE = TransmissionError("a", -1.0, 1.0, 8), TransmissionError("a", -1.0, 1.0, 26)
STRANGE, ACROSS = Unnamed("a", "drive", "b"), Unnamed("a", "gamma_x", "b")


@dataclass(frozen=True)
class Told:
    """Evidence as a test wants it: everything is told apart and predicts unless said otherwise."""

    left: dict[tuple[int, int], float] = field(default_factory=dict)
    silent: frozenset[int] = frozenset()
    beside: dict[tuple[tuple[int, ...], tuple[int, ...]], float] = field(default_factory=dict)

    def score_given(self, which: Sequence[int], given: Sequence[int]) -> ScoreResult:
        """Return what the test says, else that they are told apart beyond doubt."""
        left = self.beside | {((i,), (k,)): p_value for (i, k), p_value in self.left.items()}
        return ScoreResult(200.0, 1, left.get((tuple(which), tuple(given)), 1e-12), 0.0)

    def chances_given_each(self, which: Sequence[int], others: Sequence[Sequence[int]]) -> np.ndarray:
        """Return the p-values of what the test says given each of the others."""
        return np.array([self.score_given(which, given).p_value for given in others])

    def left_out(self, which: int) -> Unfitted:
        """Return that it predicts if it is not silent."""
        return Unfitted(0.0 if which in self.silent else 5.0)


def row(effect: Effect, cost: float, *, p: float = 1e-9, gain: float = 200.0, rank: int = 1) -> Row:
    """Return a row of a table whose p-values have to stay below 1e-4."""
    return Row(effect, ScoreResult(gain, rank, p, cost), cost, among=POLICY.false_name / 1e-4, least=LEAST)


def table(*rows: Row, told: Told | None = None) -> CandidateTable:
    """Return a table."""
    told = told or Told()
    return CandidateTable([replace(of, which=(i,), left_out=partial(told.left_out, i)) for i, of in enumerate(rows)], told)


def decided(names: CandidateTable, *nameless: Row, told: Told | None = None) -> Decision | None:
    """Return the decision between the names of a table, the cheapest first, and some dependences without a name."""
    close = sorted(names.rows, key=lambda entry: entry.cost)
    return decide(names, lambda _: table(*close, *nameless, told=told), POLICY)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, True),
        ({"score": ScoreResult(200.0, 1, 2e-4, 0.0)}, False),
        ({"among": 1.0, "score": ScoreResult(200.0, 1, 2e-4, 0.0)}, True),
        ({"among": 1.0, "score": ScoreResult(200.0, 1, 2e-4, 0.0), "question": "elastic"}, False),
        ({"among": 1.0, "score": ScoreResult(200.0, 1, 6e-4, 0.0), "question": "stay"}, False),
        ({"among": 1.0, "score": ScoreResult(200.0, 1, 0.01, 0.0), "question": "rest"}, True),
        ({"least": 201.0}, False),
        ({"evidence": 9.3}, True),
        ({"evidence": 9.1}, False),
        ({"left_out": lambda: Unfitted(1.1)}, True),
        ({"left_out": lambda: Unfitted(0.9)}, False),
        ({"left_out": lambda: Unfitted(1.1), "enough": 2.0}, False),
        ({"left_out": lambda: Unfitted(1.1, lambda: 2e-4)}, False),
        ({"left_out": lambda: Unfitted(1.1, lambda: 0.5e-4)}, True),
    ],
)
def test_a_name_is_accepted_by_every_criterion_or_not_at_all(change: dict[str, Any], expected: bool) -> None:
    """Chance, by what is asked; size; priors; blocks left out, and those whatever the noise is: each can refuse alone."""
    assert accepted(replace(row(RATIO, -50.0), **change), POLICY) is expected


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([], None),
        ([row(RATIO, -50.0), row(PLAY, -60.0)], PLAY),
        ([row(RATIO, -50.0), row(PLAY, -60.0, p=1e-3)], RATIO),
        ([row(RATIO, -50.0), row(PLAY, -60.0, gain=19.0)], RATIO),
        ([row(RATIO, -50.0, p=0.5), row(PLAY, -60.0, p=0.5)], None),
        ([row(RATIO, -50.0), row(STRANGE, -55.0)], RATIO),
        ([row(RATIO, -50.0), row(STRANGE, -57.0)], STRANGE),
        ([row(RATIO, -50.0, p=0.5), row(STRANGE, -3.0)], STRANGE),
    ],
)
def test_the_cheapest_that_is_more_than_chance_is_chosen(rows: list[Row], expected: Effect | None) -> None:
    """A name has to pass its limit and matter; a dependence without a name has to be cheaper, its surcharge included."""
    names = [entry for entry in rows if not entry.effect.is_nameless]
    # The surcharge stands in the cost of a row already: here it is put on.
    nameless = [
        Row(r.effect, r.score, r.cost + POLICY.without_name, among=r.among, least=LEAST)
        for r in rows
        if r.effect.is_nameless
    ]
    found = decided(table(*names), *nameless)

    assert (None if found is None else found.effect) == expected


def test_what_matters_to_nobody_is_left_out() -> None:
    """An effect takes off a hundredth of the squares or a hundred noise variances; twice the share of undeclared noise."""
    assert POLICY.least_gain(1000.0, declared=True) == 10.0 and POLICY.least_gain(1000.0, declared=False) == 20.0
    assert POLICY.least_gain(1e6, declared=True) == POLICY.least_gain(1e6, declared=False) == 100.0
    assert decided(table(row(RATIO, -50.0, gain=LEAST - 1e-9))) is None
    assert decided(table(row(RATIO, -50.0, gain=LEAST))) is not None


def test_what_does_not_predict_is_passed_over() -> None:
    """The next that predicts rows left out is taken, however many do not; none if none does."""
    rows = [row(GearRatio(name), -50.0 - i) for i, name in enumerate("gfedcb")]
    best = decided(table(*rows, told=Told(silent=frozenset({5, 4, 3, 2}))))
    assert best is not None and best.effect == GearRatio("f")
    last = decided(table(*rows, told=Told(silent=frozenset({5, 4, 3, 2, 1}))))
    assert last is not None and last.effect == GearRatio("g")
    assert decided(table(*rows, told=Told(silent=frozenset(range(6))))) is None
    assert decided(table(), row(STRANGE, -50.0), told=Told(silent=frozenset({0}))) is None


@pytest.mark.parametrize(
    ("worse", "left", "is_rival"),
    [
        (5.9, 1.1e-5, True),
        (5.9, 0.9e-5, False),
        (6.1, 1.1e-3, True),
        (6.1, 0.9e-3, False),
        (14.9, 0.5, True),
        (15.1, 0.5, False),
    ],
)
def test_rivals_are_those_that_leave_little(worse: float, left: float, is_rival: bool) -> None:
    """What is as cheap is a rival unless told apart beyond doubt; what is dearer only if the best adds nothing to it."""
    found = decided(table(row(OTHER, -60.0), row(PLAY, -60.0 + worse), told=Told(left={(0, 1): left})))

    assert found is not None and found.effect == OTHER
    assert found.equivalent == ((PLAY,) if is_rival else ())


def test_what_the_data_do_not_see_is_no_rival() -> None:
    """Rank zero leaves all to the best, and says nothing of it."""
    found = decided(table(row(OTHER, -60.0), row(PLAY, -59.0, rank=0), told=Told(left={(0, 1): 1.0})))
    assert found is not None and found.equivalent == ()


@pytest.mark.parametrize(
    ("whole_beyond", "parts_beyond", "named", "together"),
    [
        (1e-12, 0.5, SPRING, ()),
        (0.5, 0.5, SPRING, (RATIO, WAVE)),
        (0.5, 1e-4, WAVE, ()),
    ],
)
def test_several_plain_curves_that_do_as_much_are_the_same(
    whole_beyond: float, parts_beyond: float, named: Effect, together: tuple[Effect, ...]
) -> None:
    """A spring that two plainer names of its joint replace is told with both; if they do more, the likeliest is named."""
    rows = row(RATIO, -40.0), row(WAVE, -50.0, rank=2), row(SPRING, -60.0, rank=4), row(OTHER, -55.0)
    beside = {((2,), (0, 1)): whole_beyond, ((0, 1), (2,)): parts_beyond}
    found = decided(table(*rows, told=Told(beside=beside)))

    assert found is not None and found.effect == named and found.together == together
    assert set(together) <= set(found.equivalent)


def test_dependences_without_a_name_are_rivals_of_a_name() -> None:
    """What the contest can't tell from the best name is listed after its rivals among the names."""
    names = table(row(OTHER, -60.0), row(PLAY, -58.0), told=Told(left={(0, 1): 0.5}))
    found = decided(names, row(STRANGE, -57.0), told=Told(left={(0, 2): 0.5}))
    assert found is not None and found.equivalent == (PLAY, STRANGE)


def test_each_heading_is_listed_once() -> None:
    """Variants of one effect are one entry, the best is none, and there are six at most."""
    orders = [GearEccentricity("a", 2), WAVE, GearEccentricity("b")]
    assert each_heading_once([RATIO, *orders, FINE, CURVE], RATIO, POLICY) == (orders[0], orders[2], FINE)
    many = [JointCoupling("a", source) for source in "bcdefghij"]
    assert each_heading_once(many, RATIO, POLICY) == tuple(many[:6])


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        (RATIO, True),
        (WAVE, True),
        (GravityCompensator("a"), True),
        (Unnamed("a", "drive", "a"), True),
        (CURVE, False),
        (PLAY, False),
        (AxisWobble("a"), False),
        (JointCoupling("a", "b"), False),
        (ACROSS, False),
    ],
)
def test_simple_curves_are_functions_of_the_joints_own_position(effect: Effect, expected: bool) -> None:
    """They act about the joint's own axis and follow nothing else; the drive curve itself is none."""
    assert is_own_curve(effect) is expected


def test_elasticity_that_predicts_is_not_asked_again_to_predict(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loss without it is positive; what the others, fitted without it, show of blocks may differ."""
    tests = SimpleNamespace(
        effects=[STRANGE],
        gains_by_block=lambda which: np.array([-1.0, -2.0, 0.5, -1.0]),
        score=lambda which, among: ScoreResult(343.0, 18, 1e-75, 0.0),
        p_value_of_any=lambda which: 1e-75,
    )
    monkeypatch.setattr(backward, "score_test_given_nuisances", lambda *_, **__: tests)
    monkeypatch.setattr(backward, "with_features", lambda fit, effects: effects)
    monkeypatch.setattr(backward, "_is_far_from_zero", lambda *_: False)
    search = SimpleNamespace(policy=POLICY, groups=None)

    def fails(worth: float, *, is_elastic: bool) -> bool:
        step: Any = SimpleNamespace(is_elastic=is_elastic, effect=STRANGE, effects=(STRANGE,))
        state: Any = SimpleNamespace(fit=None, steps=[step, step])
        return backward._fails(state, step, worth, search, lambda _: None)  # type: ignore[arg-type, return-value]

    assert not fails(5.0, is_elastic=True)
    assert fails(-0.5, is_elastic=True)
    assert fails(5.0, is_elastic=False)
