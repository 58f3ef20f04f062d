"""How stable names are: the search repeated on halves of the poses, whole regions of joint space at a time.

A half leaves out half of the regions; it and the rest of them are a pair (complementary pairs: Shah and Samworth 2013,
J. R. Stat. Soc. B 75, 55-80). A name that comes in 19 of 20 halves does not hang on a few poses, and somebody else's poses
would most likely have brought it up, too; one that comes in less than 60 % is a hint.

A search on a half starts from the geometric fit of all rows, in their convention of moments, and looks for everything in
the catalogue; of dependences without a name for those that all rows brought up. Where effects are chosen by a sample of the
rows, see ``Policy.enough_readings``, halves are of this sample.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np

from pincal.discover.candidate_tests import sampled, some_rows
from pincal.discover.history import History
from pincal.discover.loop import discover_effects
from pincal.discover.policy import Policy
from pincal.discover.where import sure_compliances
from pincal.errors import PincalError
from pincal.identify.calibrate import refit
from pincal.identify.fit import Fit
from pincal.model.effect import Effect
from pincal.spread import spread

# Blocks of poses that a search on a half leaves out in turn.
_CV_BLOCKS = 8

Heading = tuple[str, str | None, str | None]
"""Effect, joint and source: two effects that have them in common have the same name."""
Group = tuple[Heading, ...]
"""The heading of what was found, and those of what the data can't tell from it."""


@dataclass(frozen=True)
class Halves:
    """What the search named in each half of the poses.

    Attributes:
        named: for each half the names that it brought up.
        poses: rows of a half, on average.
    """

    named: tuple[tuple[Group, ...], ...]
    poses: int

    def __len__(self) -> int:
        return len(self.named)

    def count(self, heading: Heading) -> int:
        """Return in how many halves a name came up, as it is or among what the half could not tell from its name."""
        return sum(any(heading in group for group in groups) for groups in self.named)

    def others(self, known: Sequence[Heading], share: float) -> list[tuple[Heading, int]]:
        """Return names that are not known and came up first in at least a share of the halves, the most frequent first."""
        first = Counter(heading for groups in self.named for heading in dict.fromkeys(group[0] for group in groups))
        return [(name, n) for name, n in first.most_common() if name not in known and n >= share * len(self)]


def begin_halves(
    trail: History, regions: Sequence[np.ndarray], count: int, *, executor: Executor | None = None
) -> Callable[[], Halves]:
    """Begin to repeat a search on halves of the poses from which it chose; return what waits for the names.

    Args:
        trail: the search on all rows.
        regions: for each station shape (rows,), the region of joint space of each training row.
        count: number of halves.
        executor: makes the searches, all of them begun now; default: one after the other, here, once they are waited for.
    """
    if not count:
        return lambda: Halves((), 0)
    few, rows = sampled(trail.first, trail.policy)
    offsets = np.cumsum([0, *(int(part.max()) + 1 for part in regions)])
    joined = np.concatenate([part + offset for part, offset in zip(regions, offsets, strict=False)])[rows]
    parts = [np.unique(joined[span]) for span in few.problem.rows]
    found = [effect for step in trail.steps for effect in (*step.effects, *step.equivalent)]
    nameless = frozenset(effect.identity for effect in found if effect.is_nameless)
    run = partial(_names_in_half, few, joined, trail.extra, trail.policy, nameless)
    halves = list(_halves(parts, joined, count))
    poses = round(float(np.mean([np.count_nonzero(np.isin(joined, half)) for half in halves])))
    named = spread(run, halves, label="half of the poses", executor=executor)
    return lambda: Halves(tuple(groups for groups in named if groups is not None), poses)


def _halves(parts: Sequence[np.ndarray], regions: np.ndarray, count: int) -> Iterator[np.ndarray]:
    """Yield the regions of each half, those of every station divided so that both halves have about as many rows."""
    rng, sizes = np.random.default_rng(0), np.bincount(regions)
    for k in range(count):
        if k % 2 == 0:
            orders = [rng.permutation(part) for part in parts]
            cuts = [_middle(sizes[order]) for order in orders]
        pairs = zip(orders, cuts, strict=True)
        yield np.concatenate([order[cut:] if k % 2 else order[:cut] for order, cut in pairs])


def _middle(sizes: np.ndarray) -> int:
    """Return how many of these blocks hold about half of the rows; at least one, and not all."""
    counts = np.cumsum(sizes)
    return int(np.clip(np.argmin(np.abs(counts - 0.5 * counts[-1])) + 1, 1, max(len(sizes) - 1, 1)))


def _names_in_half(
    first: Fit,
    regions: np.ndarray,
    extra: tuple[Effect, ...],
    policy: Policy,
    nameless: frozenset[object],
    half: np.ndarray,
) -> tuple[Group, ...] | None:
    """Return the names that a search on some regions brings up; None if their rows do not make a fit."""
    rows = np.flatnonzero(np.isin(regions, half))
    groups = np.unique(regions[rows], return_inverse=True)[1] % _CV_BLOCKS
    try:
        few = some_rows(first, rows)
        start = refit(few, few.options.effects, start={})
        return tuple(_groups(discover_effects(start, groups, extra=extra, policy=policy, nameless=nameless)))
    except PincalError:
        return None


def _groups(trail: History) -> Iterator[Group]:
    """Yield what a search found as its findings name it: elasticity joint by joint."""
    for step in trail.steps:
        if step.is_elastic:
            yield from ((sure.effect.heading,) for sure in sure_compliances(trail.final, step.effects))
        else:
            yield (step.effect.heading, *(other.heading for other in step.equivalent))
