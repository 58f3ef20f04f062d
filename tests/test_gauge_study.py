"""Studies of gauges: the example of AIAG's manual, closed forms, and intervals that cover."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pincal.errors import BadInputError
from pincal.features.gauge_entries import PassOf, gauge_entries
from pincal.features.gauge_study import GaugeStudy, TypeOneStudy
from pincal.features.part_feature import ToleranceLimits
from pincal.features.part_values import PartValue

# AIAG, Measurement Systems Analysis, 4th edition, chapter III: ten parts, three appraisers, three trials.
APPRAISERS = np.array(
    [
        [
            [0.29, -0.56, 1.34, 0.47, -0.80, 0.02, 0.59, -0.31, 2.26, -1.36],
            [0.41, -0.68, 1.17, 0.50, -0.92, -0.11, 0.75, -0.20, 1.99, -1.25],
            [0.64, -0.58, 1.27, 0.64, -0.84, -0.21, 0.66, -0.17, 2.01, -1.31],
        ],
        [
            [0.08, -0.47, 1.19, 0.01, -0.56, -0.20, 0.47, -0.63, 1.80, -1.68],
            [0.25, -1.22, 0.94, 1.03, -1.20, 0.22, 0.55, 0.08, 2.12, -1.62],
            [0.07, -0.68, 1.34, 0.20, -1.28, 0.06, 0.83, -0.34, 2.19, -1.50],
        ],
        [
            [0.04, -1.38, 0.88, 0.14, -1.46, -0.29, 0.02, -0.46, 1.77, -1.49],
            [-0.11, -1.13, 1.09, 0.20, -1.07, -0.67, 0.01, -0.56, 1.45, -1.77],
            [-0.15, -0.96, 0.67, 0.11, -1.45, -0.49, 0.21, -0.49, 1.87, -2.16],
        ],
    ]
)


def test_the_example_of_the_manual() -> None:
    """The analysis of variance that the manual prints, with the interaction pooled."""
    study = GaugeStudy(APPRAISERS.transpose(2, 0, 1))

    assert study.of_operators.value == pytest.approx(1.58363, abs=1e-5)
    assert study.of_parts.value == pytest.approx(9.81799, abs=1e-5)
    assert study.of_interaction.value == pytest.approx(0.01994, abs=1e-5)
    assert study.of_repeats.value == pytest.approx(0.04598, abs=1e-5)
    assert study.is_pooled
    assert study.repeatability == pytest.approx(0.199933, abs=1e-6)
    assert study.reproducibility == pytest.approx(0.226838, abs=1e-6)
    assert study.gauge == pytest.approx(0.302373, abs=2e-6)
    assert study.between_parts == pytest.approx(1.042327, abs=1e-6)
    assert 100.0 * study.share == pytest.approx(27.9, abs=0.05)
    assert study.categories == 4


def test_an_interaction_counts_as_reproducibility() -> None:
    """Operators who differ from part to part: variances are those that were drawn."""
    rng = np.random.default_rng(1)
    cells = rng.normal(0.0, 3.0, (60, 1)) + rng.normal(0.0, 1.0, (1, 40)) + rng.normal(0.0, 2.0, (60, 40))
    study = GaugeStudy(cells[:, :, None] + rng.normal(0.0, 0.5, (60, 40, 2)))

    assert not study.is_pooled
    assert study.repeatability == pytest.approx(0.5, rel=0.05)
    assert study.reproducibility == pytest.approx(np.hypot(1.0, 2.0), rel=0.1)
    assert study.between_parts == pytest.approx(3.0, rel=0.3)


def test_the_interval_of_the_gauge_covers() -> None:
    """In at least 93 of 100 draws, where the operators are few."""
    rng = np.random.default_rng(2)
    inside = 0
    for _ in range(300):
        operators = rng.normal(0.0, 1.0, (1, 5, 1))
        study = GaugeStudy(rng.normal(0.0, 3.0, (10, 1, 1)) + operators + rng.normal(0.0, 0.7, (10, 5, 3)))
        interval = study.gauge_interval(0.95)
        inside += interval.lower <= np.hypot(1.0, 0.7) <= interval.upper

    assert inside >= 0.93 * 300


def test_indices_of_one_feature() -> None:
    """Cg = 0.2 T / 6 s and Cgk = (0.1 T - |bias|) / 3 s."""
    readings = 10.0 + 0.01 * np.tile([-1.0, 0.0, 1.0], 9) + 0.004
    study = TypeOneStudy(readings, 10.0, 0.5)
    s = 0.01 * np.sqrt(18.0 / 26.0)

    assert study.cg == pytest.approx(0.1 / (6.0 * s))
    assert study.cgk == pytest.approx((0.05 - 0.004) / (3.0 * s))
    assert TypeOneStudy(readings, None, 0.5).cgk is None
    assert TypeOneStudy(np.ones(20), 1.0, 0.5).cg == np.inf


def test_intervals_of_the_indices_cover() -> None:
    """95 % intervals of Cg and Cgk cover the true ones in 93 to 97 of 100 draws."""
    rng = np.random.default_rng(4)
    of_cg = 0
    of_cgk = 0
    for _ in range(1000):
        study = TypeOneStudy(rng.normal(0.02, 0.05, 25), 0.0, 2.0)
        cg = study.cg_interval(0.95)
        cgk = study.cgk_interval(0.95)
        assert cgk is not None
        of_cg += cg.lower <= 0.4 / 0.3 <= cg.upper
        of_cgk += cgk.lower <= 0.18 / 0.15 <= cgk.upper

    assert 930 <= of_cg <= 970
    assert 930 <= of_cgk <= 970


def test_too_few_readings_are_refused() -> None:
    """With what is needed."""
    with pytest.raises(BadInputError, match="9 repeated readings; expected 10"):
        TypeOneStudy(np.arange(9.0), 0.0, 1.0)
    with pytest.raises(BadInputError, match=r"tolerance 0\.0"):
        TypeOneStudy(np.arange(20.0), 0.0, 0.0)
    with pytest.raises(BadInputError, match="two or more of each"):
        GaugeStudy(np.zeros((5, 1, 3)))


def passes_of(readings: np.ndarray, *, upper: float = 2e-3) -> list[PassOf]:
    """Return passes through holes of 20 mm whose diameters deviate so [mm], shape (appraisers, passes, parts)."""
    found = []
    for k, runs in enumerate(readings):
        for run in runs:
            limits = ToleranceLimits(-1e-3, upper)
            values = [PartValue(f"h{i}", "diameter", 0.02 + 1e-3 * off, 0.02, limits) for i, off in enumerate(run)]
            of_pass: Any = SimpleNamespace(values=tuple(values))
            found.append(PassOf("ABC"[k], of_pass))
    return found


def test_passes_of_several_operators_give_the_analysis_of_the_manual() -> None:
    """Ten holes, three operators, three passes: the same figures, whatever order the passes have."""
    kinds = {f"h{i}": "circle" for i in range(10)}
    for passes in (passes_of(APPRAISERS), passes_of(APPRAISERS)[::-1]):
        (found,) = gauge_entries(passes, kinds)
        assert (found.parts, found.appraisers, found.repeats, found.unit) == (10, 3, 3, "mm")
        assert found.ev == pytest.approx(0.199933, abs=1e-6) and found.av == pytest.approx(0.226838, abs=1e-6)
        assert found.grr == pytest.approx(0.302373, abs=2e-6) and found.pv == pytest.approx(1.042327, abs=1e-6)
        assert 100.0 * found.share == pytest.approx(27.9, abs=0.05) and found.ndc == 4
        # Six standard deviations of a tolerance of 3 mm.
        assert found.of_tolerance == pytest.approx(6.0 * 0.302373 / 3.0, rel=1e-5)


def test_there_is_no_analysis_of_one_operator_one_pass_or_one_feature() -> None:
    """Of unequal numbers of passes the first ones count; features that somebody left out do not."""
    kinds = {f"h{i}": "circle" for i in range(10)}
    assert not list(gauge_entries(passes_of(APPRAISERS[:1]), kinds))
    assert not list(gauge_entries(passes_of(APPRAISERS[:, :1]), kinds))
    assert not list(gauge_entries(passes_of(APPRAISERS[:, :, :1]), kinds))
    (found,) = gauge_entries(passes_of(APPRAISERS)[:-1], kinds)
    assert found.repeats == 2
    short = passes_of(APPRAISERS[:, :, :9])[:3] + passes_of(APPRAISERS)[3:]
    (found,) = gauge_entries(short, kinds)
    assert found.parts == 9
    (found,) = gauge_entries(passes_of(APPRAISERS, upper=np.inf), kinds)
    assert found.of_tolerance is None
