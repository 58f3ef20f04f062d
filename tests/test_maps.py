"""Functions of two joints without a name: one map with both joints, in place of scatter and of names that are not there."""

import numpy as np
import pytest
from machines import kuka as true_kuka
from scipy.interpolate import BSpline

from pincal import simulate as sim
from pincal.discover.candidate_tests import Search, nameless_kind
from pincal.discover.policy import Policy
from pincal.discover.report.found_figures import map_figure
from pincal.discover.run import Discovery, run_discovery
from pincal.identify.options import Options
from pincal.measure.measurements import measurements_from_arrays
from pincal.model.catalogue.unnamed import Unnamed
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, PoseSet
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot

RANGES = {"lower": -1.0, "upper": 2.0, "own_lower": -2.0, "own_upper": 1.5}


@pytest.fixture(scope="module")
def found(kuka: Robot) -> Discovery:
    """Return what is found of a KUKA whose third joint has a bump of 0.4 mrad where it and the fifth joint are half way."""
    rng = np.random.default_rng(5)
    machine = true_kuka().draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    q = sim.plan_poses(machine.nominal, 200, rng)
    there = q.copy()
    place = [(q[:, j] - np.median(q[:, j])) / (0.25 * np.ptp(q[:, j])) for j in (2, 4)]
    there[:, 2] += 4e-4 * np.exp(-0.5 * (place[0] ** 2 + place[1] ** 2))
    table = sim.Instrument(targets={"ball": (0.1, 0.0, 0.1)}, sigma=5e-5).measure(machine, there, rng=rng)
    position = np.column_stack([table[axis] for axis in "xyz"])
    rows = measurements_from_arrays(kuka.joint_names, q, position=position)
    return run_discovery(kuka, rows, Options(effects=GEOMETRIC, sigma=5e-5, moment_frame="after"), stability=4)


@pytest.mark.long
def test_a_function_of_two_joints_is_found_with_both(found: Discovery) -> None:
    """As one effect without a name, not as scatter; the error at held-out poses falls to the noise."""
    (entry,) = (entry for entry in found.report["effects"] if "elasticity" not in entry["effect"])
    before, after = (found.report["gap"][which]["rms_mm"] for which in ("before", "after"))
    floor = found.report["noise_floor_mm"]

    assert [entry[key] for key in ("effect", "joint", "depends_on", "shape")] == ["unnamed", "joint_3", "joint_5", "field"]
    assert not found.report["scatter"] and found.report["verdict"] == "adequate"
    assert before > 1.4 * floor and after < 1.05 * floor


@pytest.mark.long
def test_halves_of_the_poses_have_it_too(found: Discovery) -> None:
    """Of other lengths, and over other ranges: in a half every function of the two joints may become the smooth one."""
    (entry,) = (entry for entry in found.report["effects"] if "elasticity" not in entry["effect"])

    assert entry["stability"] == {"named": 4, "of": 4}
    assert "hints" not in found.report


def test_a_candidate_is_known_by_its_joints() -> None:
    """Ranges are of a table; what becomes a field may have been a wave, a product or a map."""
    own = {"own_lower": -1.0, "own_upper": 1.0}
    whole, half = (Unnamed("a", "drive", "b", "map", own_lower=-x, own_upper=x, lower=-x, upper=x) for x in (1.0, 0.9))
    field = Unnamed("a", "drive", "b", "field", lengths=(0.5, 0.5), **own)
    others = (Unnamed("a", "drive", "c"), Unnamed("b", "drive", "a"), Unnamed("a", "gamma_x", "b", "waves", order=1.0))
    search = Search(Policy(), (), None, np.zeros(0, int), nameless={nameless_kind(field)})  # type: ignore[arg-type]

    assert whole.identity == half.identity
    assert nameless_kind(whole) == nameless_kind(half)
    assert search.taking_part([whole, half, field, *others]) == [whole, half, field]


@pytest.mark.long
def test_a_map_is_drawn_over_both_joints(found: Discovery) -> None:
    """Where rows are: what they show, and the fitted effect, which is that of the model."""
    trace = next(trace for trace in found.traces if trace.own is not None)
    seen, fitted, _ = map_figure(trace, "a map").axes

    assert [axes.get_title(loc="left") for axes in (seen, fitted)] == ["measured", "fitted"]
    assert seen.get_xlabel() == "joint_5 [deg]" and seen.get_ylabel() == "joint_3 [deg]"
    drawn = fitted.collections[0].get_array()
    assert 0.5 * np.ptp(1e6 * trace.fitted) < np.ptp(drawn) <= np.ptp(1e6 * trace.fitted)


def test_a_map_is_made_of_products_of_splines(kuka: Robot, rng: np.random.Generator) -> None:
    """Against scipy's splines of both positions; beyond the ranges that were seen it keeps its end value."""
    q = rng.uniform(-3.0, 3.0, (50, 6))
    effect = Unnamed("joint_2", "drive", "joint_4", "map", size=5, **RANGES)
    terms = effect.terms(Chain.of(kuka), Conditions.at(q), None)

    inside = np.clip(q[:, [1, 3]], [-2.0, -1.0], [1.5, 2.0])
    own = BSpline.design_matrix(inside[:, 0], _knots(-2.0, 1.5), 3).toarray()
    other = BSpline.design_matrix(inside[:, 1], _knots(-1.0, 2.0), 3).toarray()
    expected = np.einsum("ni,nj->ijn", own, other).reshape(25, -1)
    np.testing.assert_allclose([term.basis for term in terms], expected, atol=1e-12)


def _knots(lower: float, upper: float) -> np.ndarray:
    return np.concatenate([[lower] * 3, np.linspace(lower, upper, 3), [upper] * 3])


@pytest.mark.parametrize(
    ("rows", "values", "sizes"), [(80, 80, []), (150, 150, [4, 5]), (400, 400, [4, 5, 6, 8]), (400, 5, [4, 5])]
)
def test_a_map_is_as_fine_as_rows_and_positions_allow(kuka: Robot, rows: int, values: int, sizes: list[int]) -> None:
    """Six rows a piece, and no more pieces along a joint than it has positions."""
    q = kuka.random_configurations(rows, np.random.default_rng(0))
    q[:, 3] = np.linspace(-1.0, 1.0, values)[np.arange(rows) % values]
    effect = Unnamed("joint_2", "drive", "joint_4", "map", size=4, **RANGES)

    assert [form.size for form in effect.resolutions(PoseSet(Chain.of(kuka), Conditions.at(q)))] == sizes
