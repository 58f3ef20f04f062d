"""Smooth functions of two joints' positions: what they are, and that a wave which is part of one becomes one."""

from typing import Any

import numpy as np
import pytest
from interaction_study import ENOUGH, seen

from pincal.errors import BadInputError
from pincal.model.catalogue.unnamed import Unnamed
from pincal.model.chain import Chain
from pincal.model.smooth_field import SmoothField
from pincal.robot.robot import Robot

_URDF = "".join(
    f'<joint name="{name}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/>'
    f'<origin xyz="{0.3 * i} 0 0.4"/><axis xyz="0 0 1"/>'
    f'<limit lower="-2" upper="2" effort="1" velocity="1"/></joint><link name="l{i + 1}"/>'
    for i, (name, kind) in enumerate([("rail", "prismatic"), ("arm", "revolute")])
)


@pytest.mark.parametrize("lengths", [(0.6, 0.4), (1.2, 0.5), (0.3, 1.6)])
def test_a_field_has_the_covariance_of_its_lengths(lengths: tuple[float, float], rng: np.random.Generator) -> None:
    """That of a Gaussian process, within a tenth of its variance everywhere in its ranges."""
    field = SmoothField((-1.0, 2.0), (0.5, 2.5), lengths)
    at = rng.uniform([-1.0, 0.5], [2.0, 2.5], (200, 2))
    weighted = field.sizes[:, None] * field.basis(*at.T)
    expected = np.exp(-0.5 * np.sum(((at[:, None] - at) / lengths) ** 2, axis=2))

    assert np.abs(weighted.T @ weighted - expected).max() < 0.1
    assert len(field.orders) == len(field.sizes) == len(weighted)


def test_a_field_keeps_its_values_beyond_its_ranges() -> None:
    """As a curve does: nothing was measured there."""
    field = SmoothField((-1.0, 2.0), (0.5, 2.5), (0.6, 0.4))
    inside, beyond = (field.basis(np.array([x]), np.array([y])) for x, y in ((2.0, 0.5), (2.7, -1.0)))

    np.testing.assert_array_equal(inside, beyond)


def test_a_field_needs_lengths() -> None:
    """And a height above 0."""
    with pytest.raises(BadInputError, match="expected numbers above 0"):
        Unnamed("joint_1", "drive", "joint_2", "field")
    with pytest.raises(BadInputError, match="expected numbers above 0"):
        Unnamed("joint_1", "drive", "joint_2", "field", lengths=(1.0, 1.0), height=0.0)


@pytest.mark.parametrize(
    "wrong",
    [{"lengths": (1e-6, 1.0)}, {"lengths": (1.0, 0.1)}, {"lower": 5.0, "upper": 1.0}, {"own_lower": 2.0, "own_upper": 1.0}],
)
def test_a_field_is_no_finer_than_a_computer_holds(wrong: dict[str, Any]) -> None:
    """Of a model file that was edited, millions of functions are refused, not allocated."""
    with pytest.raises(BadInputError, match="expected ranges above 0, and lengths of at least 0"):
        Unnamed("joint_1", "drive", "joint_2", "field", **{"lengths": (1.0, 1.0)} | wrong)
    finest = Unnamed("joint_1", "drive", "joint_2", "field", lengths=(0.04 * np.pi, 0.04 * np.pi))
    assert 1000 < finest.n_functions < 2500


def test_an_error_along_an_axis_is_a_length() -> None:
    """The coefficients of a prismatic joint's drive are in metres, those of tilts in radians."""
    chain = Chain.of(Robot.from_urdf(f'<robot name="two"><link name="l0"/>{_URDF}</robot>'.encode()))
    errors = [
        Unnamed("rail", "drive", "arm", "product"),
        Unnamed("rail", "drive", "arm", "map", size=4),
        Unnamed("rail", "gamma_x", "arm", "waves", order=2.0),
        Unnamed("arm", "drive", "rail", "waves", order=2.0),
    ]

    units = [{parameter.unit for parameter in error.parameters(chain)} for error in errors]
    assert units == [{"m"}, {"m"}, {"rad"}, {"rad"}]


@pytest.mark.long
@pytest.mark.parametrize(
    ("task", "shape"),
    [
        (("field", 9104), "field"),
        *(pytest.param(task, "field", marks=pytest.mark.rates) for task in (("bump", 9103), ("field", 9114))),
        (("two_waves", 9100), "product"),
    ],
)
def test_a_wave_that_is_part_of_a_field_becomes_one(task: tuple[str, int], shape: str) -> None:
    """At its joint, without another name, and little is left of it; a wave that is all that is there stays one."""
    found = seen(task)

    assert found.is_found and not found.false
    assert f"shape={shape}" in found.words
    assert found.ratio <= ENOUGH
