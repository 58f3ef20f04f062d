"""Numbers by which poses show an effect, on both sides of where they decide."""

from __future__ import annotations

import numpy as np
import pytest

from pincal.model.catalogue.transmission import TransmissionError, most_pieces
from pincal.model.conditions import TURN, distinct_values, moves


@pytest.mark.parametrize(("apart", "count"), [(0.9e-3, 2), (1.1e-3, 3)])
def test_positions_are_distinct_by_a_thousandth_of_their_range(apart: float, count: int) -> None:
    """Encoder readings on a grid remain a grid."""
    assert distinct_values(np.array([0.0, apart, 1.0])) == count


def test_a_joint_moves_by_a_tenth_of_a_milliradian() -> None:
    """And by a thousandth of what the joint that moves most does."""

    def of(*ranges: float) -> list[bool]:
        return moves(np.array([np.zeros(len(ranges)), ranges])).tolist()

    assert of(0.9e-4) == [False] and of(1.1e-4) == [True]
    assert of(2.0, 1.9e-3, 2.1e-3) == [True, False, True]


@pytest.mark.parametrize(("turns", "is_periodic"), [(0.89, False), (0.91, True)])
def test_a_curve_over_nine_tenths_of_a_turn_is_periodic(turns: float, is_periodic: bool) -> None:
    """The gap is too small for it to oscillate in."""
    q = np.linspace(0.0, turns * TURN, 400)

    assert TransmissionError.over("joint_1", q).periodic == is_periodic


@pytest.mark.parametrize(("poses", "pieces"), [(59, 9), (60, 10)])
def test_a_piece_of_a_curve_has_six_poses(poses: int, pieces: int) -> None:
    """That show its size and its scatter."""
    assert most_pieces(np.arange(float(poses))) == pieces
