"""How fine a drive curve the data can tell: what distinct positions carry, judged by blocks of poses left out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pincal.discover.nuisance import BesideNuisances, situation_of
from pincal.identify.fit import Fit
from pincal.model.catalogue.curves import most_pieces
from pincal.model.conditions import distinct_values
from pincal.model.effect import Curve, Effect, Resolvable
from pincal.robot.robot import Robot

# Numbers of basis functions that are tried.
_SIZES = (8, 10, 12, 15, 18, 22, 26, 32, 38, 44, 52, 60, 70, 80, 100, 120, 150, 180)
# Parameters of curves that are tested at once.
_AT_ONCE = 400
# Distinct positions of a joint that are enough for most gears; fewer are worth a word where the poses carry more.
_ENOUGH_VALUES = 44


def notes_on_repeats(robot: Robot, q: np.ndarray) -> Iterator[str]:
    """Yield what can't be told of joints that take the same positions again and again, q of shape (N, n)."""
    for joint, kind, x in zip(robot.joint_names, robot.joint_types, q.T, strict=True):
        values = distinct_values(x)
        if 1 < values < _ENOUGH_VALUES and values == most_pieces(x):
            step = 2.0 * float(np.ptp(x)) / (values - 1)
            wave = f"{step:.3g} m" if kind == "prismatic" else f"{np.degrees(step):.3g} deg"
            yield (
                f"{joint} takes {values} distinct positions in {len(x)} rows: what its drive does between them can't be "
                f"told, and a wave shorter than {wave} looks like a longer one; choose positions that don't repeat, as "
                "pincal design does"
            )


def curves_over(fit: Fit, curve: Curve, sizes: Sequence[int]) -> list[Curve]:
    """Return a drive curve in several resolutions, as fine as the poses and their distinct positions allow."""
    situation = situation_of(fit)
    most = most_pieces(situation.positions(str(curve.locus.follows)))
    return [curve.resized(situation, size) for size in sizes if size <= most]


def resolved(fit: Fit, effect: Effect, groups: np.ndarray) -> tuple[Effect, np.ndarray, np.ndarray]:
    """Return an effect in the resolution that predicts blocks of poses left out best; itself if it has none.

    Every other resolution is tried first, then those on either side of the best. Its parameters and those of the effect as
    it was given are returned as well, to first order.
    """
    forms, test = _forms_of(fit, effect), BesideNuisances(fit)
    if not forms:
        estimate = test([effect]).estimate([0])
        return effect, estimate, estimate
    tried = dict(zip(range(0, len(forms), 2), _tested(test, forms[::2], groups), strict=True))
    best = max(tried, key=lambda k: tried[k][1])
    beside = [k for k in (best - 1, best + 1) if 0 <= k < len(forms)]
    *closer, (estimate, _) = _tested(test, [*(forms[k] for k in beside), effect], groups)
    tried |= zip(beside, closer, strict=True)
    best = max(tried, key=lambda k: tried[k][1])
    return forms[best], tried[best][0], estimate


def _forms_of(fit: Fit, effect: Effect) -> list[Effect]:
    if isinstance(effect, Resolvable):
        return list(effect.resolutions(situation_of(fit)))
    return list(curves_over(fit, effect, _SIZES)) if isinstance(effect, Curve) else []


def _tested(test: BesideNuisances, curves: Sequence[Effect], groups: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """Return, of each curve, its parameters to first order and by how much it lowers the squared error on blocks left out.

    They are tested a few at a time, as nothing is asked of two together and the memory grows with the square of all.
    """
    found = list[tuple[np.ndarray, float]]()
    for some in _few_at_once(test.fit, curves):
        tests = test(some, groups)
        found += [(tests.estimate([i]), float(tests.gains_by_block([i]).sum())) for i in range(len(some))]
        # Before the next tests are made, and not after it.
        del tests
    return found


def _few_at_once(fit: Fit, curves: Sequence[Effect]) -> Iterator[list[Effect]]:
    """Yield curves in their order, several together as long as they have few parameters."""
    some, total = list[Effect](), 0
    for curve in curves:
        size = len(curve.parameters(fit.problem.chain))
        if some and total + size > _AT_ONCE:
            yield some
            some, total = [], 0
        some.append(curve)
        total += size
    yield some
