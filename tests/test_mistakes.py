"""A sound table is never accused by chance."""

import pytest
from scipy.stats import f as f_distribution

from pincal.validate.trials import Remainder


def test_what_is_left_counts_by_its_degrees_of_freedom() -> None:
    """As many unknowns as readings leave nothing, whatever is wrong; a few more leave little by chance, by Fisher's F."""
    before = Remainder(1.0, 24, 9)
    assert Remainder(0.0, 9, 9).chance(before) == 1.0
    assert Remainder(0.0, 6, 9).chance(before) == 1.0
    found = Remainder(0.1, 12, 9).chance(before)
    assert found == pytest.approx(f_distribution.cdf(0.01 * 4.0 / (24 / 15), 3, 15))
    # With a hundred hypotheses a tenth of the residuals with three degrees of freedom is nothing; a thousandth is.
    assert 100 * found > 1e-2
    assert 100 * Remainder(1e-3, 12, 9).chance(before) < 1e-4
