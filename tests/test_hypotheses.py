"""Of several hypotheses the one that explains is believed, and another is a rival only if it explains as much."""

import numpy as np
import pytest

from pincal.hypotheses.hypothesis import Explanation, Hypothesis, Likeliest, exchange_order, explaining, likeliest


def twice(least: float) -> float:
    """Return the limit of what explains as much where residuals are compared."""
    return 2.0 * least


def a_little_more(least: float) -> float:
    """Return the same where log likelihoods are."""
    return least + 10.0


def test_nothing_is_believed_that_does_not_explain_enough() -> None:
    """However much better than the others it is."""
    tried = [Explanation("one", 0.1, is_enough=False), Explanation("other", 5.0, is_enough=False)]

    assert likeliest(tried, twice) is None
    assert likeliest([], twice) is None


def test_the_first_of_equals_is_believed() -> None:
    """The order says what is simpler: with as much left the second is its rival, with less left than half it wins."""
    assert likeliest([Explanation("simple", 1.9), Explanation("odd", 1.0)], twice) == Likeliest("simple", ("odd",))
    assert likeliest([Explanation("simple", 2.1), Explanation("odd", 1.0)], twice) == Likeliest("odd", ())


@pytest.mark.parametrize("close", [twice, a_little_more])
def test_a_hypothesis_that_leaves_nothing_is_believed(close) -> None:
    """Also where nothing is below twice of what it leaves."""
    found = likeliest([Explanation("wrong", 30.0), Explanation("right", 0.0)], close)

    assert found == Likeliest("right", ())


def test_what_is_not_enough_alone_may_be_as_likely() -> None:
    """In odds: a change that no test finds by itself isn't told from a little weaker one that a test does find."""
    tried = [Explanation("no test", -12.0, is_enough=False), Explanation("found", -9.0), Explanation("far", 3.0)]
    found = likeliest(tried, a_little_more)

    assert found is not None and found.every == ("found", "no test")


def test_the_likeliest_of_a_sorted_list_is_its_best() -> None:
    """Of 200 random lists: nothing is believed but the least, and rivals are those within the margin."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        left = np.sort(rng.normal(size=6) * 10.0)
        found = likeliest([Explanation(k, float(x)) for k, x in enumerate(left)], a_little_more)

        assert found is not None
        assert found.every == tuple(np.flatnonzero(left < left[0] + 10.0).tolist())


def test_only_what_is_asked_for_is_tried() -> None:
    """Trials are fits: the first hypothesis that explains costs none of those behind it."""
    tried = list[int]()

    def undone(k: int) -> Hypothesis[float]:
        return Hypothesis(f"{k} too much", lambda value: (tried.append(k), value - k)[1])

    found = next(explaining(map(undone, range(100)), 3.0, lambda value: value == 0.0))

    assert found.words == "3 too much" and tried == [0, 1, 2, 3]


def test_two_exchanges_are_none() -> None:
    """The order of columns is its own inverse, and leaves the others where they are."""
    q = np.random.default_rng(0).normal(size=(4, 6))
    order = exchange_order(6, 1, 4)

    np.testing.assert_array_equal(q[:, order][:, order], q)
    np.testing.assert_array_equal(q[:, order][:, [0, 2, 3, 5]], q[:, [0, 2, 3, 5]])
