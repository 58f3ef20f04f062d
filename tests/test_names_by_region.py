"""Regions of joint space that names predict worse than geometry and elasticity alone."""

from dataclasses import replace

import numpy as np
import pytest
from machines import kuka as true_kuka
from scipy.stats import ttest_rel

from pincal import simulate as sim
from pincal.discover.discovery_file import NamedRegion
from pincal.discover.names_by_region import chance_of_more, doubt_of_regions, regions_by_names
from pincal.discover.remainder_numbers import REMAINDER
from pincal.discover.report.found_section import found_section
from pincal.discover.report.found_words import region_words
from pincal.discover.run import Discovery, run_discovery
from pincal.discover.smooth_judge import as_calibrated, errors_left_out
from pincal.identify.calibrate import refit
from pincal.identify.options import Options
from pincal.measure.measurements import measurements_from_arrays
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot

SIGMA = 5e-5


@pytest.fixture(scope="module")
def found(kuka: Robot) -> Discovery:
    """Return a discovery of a KUKA whose fourth drive is eccentric, each pose of which was read once or twice."""
    rng = np.random.default_rng(8)
    machine = true_kuka().draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    q = sim.plan_poses(machine.nominal, 120, rng)
    q = np.vstack([q, q[::3]])
    there = q.copy()
    there[:, 3] += 6e-4 * np.sin(q[:, 3])
    read = sim.Instrument(targets={"ball": (0.1, 0.0, 0.1)}).measure(machine, there, rng=rng)
    position = np.column_stack([read[axis] for axis in "xyz"]) + SIGMA * rng.standard_normal((len(q), 3))
    rows = measurements_from_arrays(kuka.joint_names, q, position=position)
    return run_discovery(kuka, rows, Options(effects=GEOMETRIC, sigma=SIGMA, moment_frame="after"))


@pytest.mark.long
def test_regions_are_those_of_fits_of_the_others(found: Discovery) -> None:
    """Their means, by calibrate and with the names, are those of fits that leave each fold out; readings count once each."""
    regions = found.findings.regions
    whole = as_calibrated(found.trail)
    validated = found.calibration.validated
    assert validated is not None
    fold = validated.folds.of_way["regions"]
    by_names = errors_left_out(found.trail.final, fold)
    poses = len(whole.problem)
    (k,) = np.flatnonzero(np.bincount(fold) == np.bincount(fold).max())[:1]
    plain = refit(whole.select(np.flatnonzero(fold != k)), whole.options.effects, start={})
    station = whole.problem.stations[0].select(np.flatnonzero(fold == k))
    left = np.linalg.norm(station.residuals(plain.values), axis=0)

    assert found.findings.delivered == "named" and found.findings.remainder is None
    assert sum(of.rows for of in regions) == 160 > poses == 120
    assert min(of.rows for of in regions) >= REMAINDER.region
    assert np.mean([of.named_mm for of in regions]) == pytest.approx(by_names.mean(), rel=0.1)
    assert errors_left_out(whole, fold)[fold == k].mean() == pytest.approx(1e3 * left.mean(), rel=0.03)


@pytest.mark.long
def test_they_are_said(found: Discovery) -> None:
    """In discovery.json and in the report; without names there are none."""
    regions = found.findings.regions
    page = " ".join(map(str, found_section(found).blocks))
    bare = replace(found.trail, steps=())
    validated = found.calibration.validated

    assert found.report["delivered"] == "named"
    assert [of["rows"] for of in found.report["regions"]] == [of.rows for of in regions]
    assert region_words(regions) in page
    assert regions_by_names(bare, validated, found.calibration.stations) == ()
    assert regions_by_names(found.trail, None, found.calibration.stations) == ()


def test_chance_is_that_of_a_paired_test(rng: np.random.Generator) -> None:
    """As SciPy's one-sided paired t-test; nothing is told by a single row."""
    plain, named = rng.normal(0.1, 0.02, (2, 15))

    assert chance_of_more(named - plain) == pytest.approx(ttest_rel(named, plain, alternative="greater").pvalue)
    assert chance_of_more(np.array([0.1])) == 1.0


def test_what_is_beyond_scatter_is_a_doubt() -> None:
    """A region that is worse by chance is none, be it one of many; one that is worse beyond chance is, with its place."""
    fine = [NamedRegion(rows=12, calibrated_mm=0.1, named_mm=0.08, chance=0.9, centre={"a": 0.5})] * 24
    near = NamedRegion(rows=12, calibrated_mm=0.1, named_mm=0.12, chance=0.01, centre={"a": 1.25})
    sure = replace_chance(near, 0.001)
    doubt = doubt_of_regions([*fine, sure])

    assert doubt_of_regions([]) is None and doubt_of_regions(fine) is None and doubt_of_regions([*fine, near]) is None
    assert doubt is not None and doubt.is_doubt
    assert "a 1.25" in doubt.text and "0.120 mm instead of 0.100" in doubt.text
    assert "by chance" in region_words([*fine, near]) and "beyond chance" in region_words([*fine, sure])


def replace_chance(region: NamedRegion, chance: float) -> NamedRegion:
    """Return a region with another chance."""
    return NamedRegion(
        rows=region.rows,
        calibrated_mm=region.calibrated_mm,
        named_mm=region.named_mm,
        chance=chance,
        centre=region.centre,
    )
