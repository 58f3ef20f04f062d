"""What is told of a part: closed forms of distances, angles and datums, and Monte Carlo of what the datum shares."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pincal.errors import BadInputError
from pincal.features import feature_fit
from pincal.features.feature_set import FeatureSet
from pincal.features.part import Part
from pincal.features.part_feature import PartDatum, PartFeature, ToleranceLimits
from pincal.features.part_values import PartValues, evaluate_part

TURN = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
SHIFT = np.array([0.9, -0.3, 0.6])
Z = np.array([0.0, 0.0, 1.0])
X = np.array([1.0, 0.0, 0.0])


def circle(centre: list[float], radius: float = 0.006, n: int = 8) -> np.ndarray:
    """Return points of a circle in a plane z = constant of the part, shape (n, 3)."""
    angle = 2.0 * np.pi * np.arange(n) / n
    return centre + radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])


PART = Part(
    {
        "top": PartFeature("top", "plane", position=np.zeros(3), direction=Z),
        "edge": PartFeature("edge", "line", position=np.zeros(3), direction=X),
        "hole": PartFeature(
            "hole",
            "circle",
            position=np.array([0.02, 0.05, 0.0]),
            direction=Z,
            nominal={"diameter": 0.012},
            limits={"diameter": ToleranceLimits(0.0119, 0.0121)},
        ),
        "other": PartFeature("other", "circle", position=np.array([0.22, 0.09, 0.0]), direction=Z),
        "third": PartFeature("third", "circle", position=np.array([0.10, 0.30, 0.03]), direction=Z),
        "pitch": PartFeature("pitch", "distance", of=("hole", "other")),
        "square": PartFeature("square", "angle", of=("edge", "hole"), nominal={"angle": np.pi / 2}),
    }
)
POINTS = {
    "top": np.array([[0.0, 0, 0], [0.3, 0, 0], [0.3, 0.2, 0], [0, 0.2, 0], [0.1, 0.1, 0], [0.2, 0.15, 0]]),
    "edge": np.linspace(0.0, 0.3, 6)[:, None] * X,
    "hole": circle([0.02, 0.05, 0.0]),
    "other": circle([0.22, 0.09, 0.0]),
    "third": circle([0.10, 0.30, 0.03]),
}
NAMES = np.concatenate([[name] * len(points) for name, points in POINTS.items()])
STACKED = SHIFT + np.vstack(list(POINTS.values())) @ TURN.T
DATUMS = {
    "best fit": PartDatum("best fit", ("hole", "other", "third")),
    "3-2-1": PartDatum("3-2-1", ("top", "edge", "hole")),
    "best fit of surfaces": PartDatum("best fit", ("top", "edge", "hole")),
    "3-2-1 of two holes": PartDatum("3-2-1", ("top", "other", "hole")),
}


def covariance_of(n: int, seed: int = 1) -> np.ndarray:
    """Return a covariance of n points: what all share and what each has of its own."""
    common = 1e-4 * np.random.default_rng(seed).normal(size=(3 * n, 4)) + np.tile(2e-4 * np.eye(3, 4), (n, 1))
    return common @ common.T + 1e-10 * np.eye(3 * n)


def told(part: Part, points: np.ndarray, covariance: np.ndarray, names: np.ndarray = NAMES) -> PartValues:
    """Return the quantities of a part by its points."""
    return evaluate_part(part, FeatureSet.fit(part.kinds, names, points, covariance), covariance)


def by_name(values: PartValues) -> dict[str, float]:
    """Return the values by feature and quantity."""
    return {f"{of.feature}.{of.quantity}": of.value for of in values.values}


@pytest.mark.parametrize("datum", DATUMS)
def test_a_part_as_it_should_be_has_no_deviations(datum: str) -> None:
    """However it lies, with any datum; values without errors are the nominal ones."""
    values = told(Part(PART.features, DATUMS[datum]), STACKED, 1e-10 * np.eye(3 * len(STACKED)))
    found = by_name(values)

    assert values.frame.rotation == pytest.approx(TURN, abs=1e-9)
    assert values.frame.origin == pytest.approx(SHIFT, abs=1e-9)
    assert max(abs(of.deviation) for of in values.values if of.deviation is not None) < 1e-9
    assert found["hole.diameter"] == pytest.approx(0.012)
    assert found["pitch.distance"] == pytest.approx(np.hypot(0.2, 0.04))
    assert values.values[values.index("hole", "diameter")].limits == ToleranceLimits(0.0119, 0.0121)


def test_the_calibrated_datum_is_the_frame_of_the_points() -> None:
    """Positions are as they were measured."""
    found = by_name(told(PART, STACKED, 1e-10 * np.eye(3 * len(STACKED))))

    assert [found[f"hole.{axis}"] for axis in "xyz"] == pytest.approx(SHIFT + TURN @ [0.02, 0.05, 0.0])


@pytest.mark.parametrize("datum", DATUMS)
def test_a_datum_takes_out_what_all_points_share(datum: str) -> None:
    """A common shift and turn of all points moves nothing in the part's frame."""
    n = len(STACKED)
    rigid = np.zeros((n, 3, 6))
    rigid[:, :, :3] = 1e-4 * np.eye(3)
    rigid[:, :, 3:] = 1e-4 * np.cross(STACKED[:, None, :], np.eye(3))
    rigid = rigid.reshape(3 * n, 6)
    C = rigid @ rigid.T + 1e-12 * np.eye(3 * n)
    values = told(Part(PART.features, DATUMS[datum]), STACKED, C)
    moved = values.sensitivity @ rigid

    assert np.abs(moved).max() < 1e-9


@pytest.mark.parametrize(
    "datum",
    [pytest.param(datum, marks=() if datum == "3-2-1 of two holes" else pytest.mark.long) for datum in DATUMS],
)
def test_values_have_the_spread_that_is_stated(datum: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """JCGM 101: deviations of many draws, whitened by the covariance of the values, are of unit size."""
    # No draw is taken for a deviation from form, which would change its weights.
    monkeypatch.setattr(feature_fit, "FIT", replace(feature_fit.FIT, form=1e-12))
    part = Part(PART.features, DATUMS[datum])
    n = len(STACKED)
    # So small that what is of second order does not show; what is 0 at best, and the fold of an angle, are left out.
    C = 1e-4 * covariance_of(n)
    truth = told(part, STACKED, C)
    smooth = [i for i, of in enumerate(truth.values) if of.quantity not in ("position", "tilt", "angle")]
    stated = truth.covariance(C)[np.ix_(smooth, smooth)]
    sizes, axes = np.linalg.eigh(stated)
    some = sizes > 1e-6 * sizes[-1]
    whiten = axes[:, some] / np.sqrt(sizes[some])
    root = np.linalg.cholesky(C)
    rng = np.random.default_rng(3)
    squares = []
    for _ in range(12):
        draw = STACKED + (root @ rng.normal(size=3 * n)).reshape(n, 3)
        off = np.array([of.value for of in told(part, draw, C).values]) - [of.value for of in truth.values]
        squares.append(np.sum((off[smooth] @ whiten) ** 2))
    p = int(some.sum())

    assert np.mean(squares) == pytest.approx(p, abs=4.0 * np.sqrt(2.0 * p / 12))


def one_of(kind: str, position: list[float], direction: list[float], n: int = 8) -> np.ndarray:
    """Return points of a feature."""
    axis = np.array(direction) / np.linalg.norm(direction)
    first = np.cross(axis, [0.31, 0.77, 0.55])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    angle = 2.0 * np.pi * np.arange(n) / n
    around = 0.05 * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second)
    along = np.linspace(-0.05, 0.05, n)[:, None] * axis
    if kind == "cylinder":
        along = along[[0, 5, 2, 7, 4, 1, 6, 3]]
        return np.asarray(position + around + along)
    if kind == "line":
        return np.asarray(position + along)
    if kind == "point":
        return np.tile(np.array(position, float), (n, 1))
    return np.asarray(position + around)


PAIRS = {
    "points": ("point", [0, 0, 0], Z, "point", [0.3, 0.4, 0], Z, 0.5, None),
    "point and plane": ("point", [0.1, 0.2, 0.3], Z, "plane", [0.5, 0, 0.1], Z, 0.2, None),
    "point and line": ("line", [0, 0, 0], X, "point", [0.4, 0.3, 0.4], Z, 0.5, None),
    "parallel planes": ("plane", [0, 0, 0], Z, "plane", [0.4, 0.3, 0.4], Z, 0.4, 0.0),
    "parallel lines": ("line", [0, 0, 0], X, "cylinder", [0.4, 0.3, 0.4], X, 0.5, 0.0),
    "crossing lines": ("line", [0, 0, 0], X, "line", [0.4, 0.3, 0.2], [0, 1, 0], 0.2, np.pi / 2),
    "line and plane": ("line", [0, 0, 0.1], [1, 0, 1], "plane", [0, 0, 0], Z, 0.1, np.pi / 4),
    "hole and plane": ("circle", [0, 0, 0.1], Z, "plane", [0, 0, 0], Z, 0.1, np.pi / 2),
    "planes": ("plane", [0, 0, 0], Z, "plane", [0, 0, 0], [0, np.sqrt(3), -1], 0.0, np.pi / 3),
}


@pytest.mark.parametrize("case", PAIRS)
def test_distances_are_the_known_ones(case: str) -> None:
    """And angles: of points, lines, axes and planes with each other."""
    kind, position, direction, other, there, along, distance, angle = PAIRS[case]
    features = {
        "a": PartFeature("a", kind),  # type: ignore[arg-type]
        "b": PartFeature("b", other),  # type: ignore[arg-type]
        "d": PartFeature("d", "distance", of=("a", "b")),
    }
    if angle is not None:
        features["w"] = PartFeature("w", "angle", of=("a", "b"))
    points = np.vstack([one_of(kind, position, direction), one_of(other, there, along)])  # type: ignore[arg-type]
    names = np.repeat(["a", "b"], 8)
    found = by_name(told(Part(features), points, 1e-12 * np.eye(48), names))

    assert found["d.distance"] == pytest.approx(distance, abs=1e-9)
    if angle is not None:
        assert found["w.angle"] == pytest.approx(angle, abs=1e-9)


def test_an_obtuse_angle_is_told_where_it_is_meant() -> None:
    """Of the two angles of crossing lines the one nearer to the nominal."""
    features = {
        "a": PartFeature("a", "line"),
        "b": PartFeature("b", "line"),
        "w": PartFeature("w", "angle", of=("a", "b"), nominal={"angle": 2.0}),
    }
    points = np.vstack([one_of("line", [0, 0, 0], [1, 0, 0]), one_of("line", [0, 0, 0], [np.cos(1.9), np.sin(1.9), 0])])
    found = by_name(told(Part(features), points, 1e-12 * np.eye(48), np.repeat(["a", "b"], 8)))

    assert found["w.angle"] == pytest.approx(1.9, abs=1e-9)


def test_uncertainty_of_a_distance_of_two_points_is_the_known_one() -> None:
    """Independent points: sqrt(2) sigma / sqrt(n), whatever the datum's frame."""
    part = Part({name: PART.features[name] for name in ("hole", "other", "pitch")})
    points = np.vstack([POINTS["hole"], POINTS["other"]])
    names = np.repeat(["hole", "other"], 8)
    C = 1e-10 * np.eye(48)
    values = told(part, points, C, names)
    i = values.index("pitch", "distance")

    assert np.sqrt(values.covariance(C)[i, i]) == pytest.approx(1e-5 * np.sqrt(2.0 * 2.0 / 8.0), rel=1e-6)


def test_deviations_are_told_with_their_zone() -> None:
    """A hole that is 0.3, 0.4 mm off and tilted by 10 mrad: a zone of 1 mm, and a tilt of 10 mrad."""
    tilt = Rotation.from_rotvec([0.0, 0.01, 0.0]).as_matrix()
    centre = np.array([0.0203, 0.0504, 0.0])
    off = centre + (POINTS["hole"] - [0.02, 0.05, 0.0]) @ tilt.T
    part = Part({"hole": PART.features["hole"]})
    values = told(part, off, 1e-12 * np.eye(24), np.repeat(["hole"], 8))
    found = by_name(values)

    assert found["hole.position"] == pytest.approx(1e-3, rel=1e-6)
    assert found["hole.tilt"] == pytest.approx(0.01, rel=1e-6)
    assert found["hole.k"] == pytest.approx(np.cos(0.01))


REFUSED = {
    "no readings": (PartDatum("best fit", ("hole", "absent")), "'absent' has no readings"),
    "two holes": (PartDatum("best fit", ("hole", "other")), "leave the frame open"),
    "line along the normal": (PartDatum("3-2-1", ("top", "pin", "hole")), "along the normal"),
    "no direction": (PartDatum("best fit", ("top", "bare", "hole")), "no nominal direction"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_datum_that_leaves_the_frame_open_is_refused(case: str) -> None:
    """By the names of its features."""
    datum, words = REFUSED[case]
    more = {
        "absent": PartFeature("absent", "point", position=np.zeros(3)),
        "pin": PartFeature("pin", "line", position=np.zeros(3), direction=Z),
        "bare": PartFeature("bare", "plane", position=np.zeros(3)),
    }
    part = Part({**PART.features, **more}, datum)
    pin = one_of("line", [0.1, 0.1, 0.0], [0, 0, 1])
    points = np.vstack([STACKED, SHIFT + np.vstack([pin, POINTS["top"]]) @ TURN.T])
    names = np.concatenate([NAMES, ["pin"] * 8, ["bare"] * 6])

    with pytest.raises(BadInputError, match=words):
        told(part, points, 1e-10 * np.eye(3 * len(points)), names)


def test_a_file_leads_to_values(tmp_path: Path) -> None:
    """From TOML: units and limits arrive with the values."""
    (tmp_path / "p.toml").write_text(
        '[feature.hole]\nkind = "circle"\nnominal_mm = [20, 50, 0]\ndiameter_mm = 12\ndiameter_tolerance_mm = 0.1\n'
    )
    part = Part.from_toml(tmp_path / "p.toml")
    values = told(part, POINTS["hole"], 1e-12 * np.eye(24), np.repeat(["hole"], 8))
    diameter = values.values[values.index("hole", "diameter")]

    assert diameter.deviation == pytest.approx(0.0, abs=1e-9)
    assert diameter.limits is not None and diameter.limits.upper == pytest.approx(0.0121)
