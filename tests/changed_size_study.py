"""How often the interval of a diagnosed change covers: ``python tests/changed_size_study.py --draws 60``.

Each draw is of another arm (light, heavy, of seven joints), calibrated from 100 poses, whose zero of one joint has changed
since by lambda 80, and of a new set-up of 12 to 60 poses. Where `diagnose` names the zero of this joint, its interval of
95 % (from `before` to `after`, and 1.96 `sigma`) holds the change or not. The share is printed with its exact interval
(Clopper and Pearson), and how far off the changes are in their standard deviations.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from diagnosis_cases import ARMS, draw_case
from rates import in_words

from pincal import diagnose
from pincal.units import INTERVAL


@dataclass(frozen=True)
class Seen:
    """A diagnosed change.

    Attributes:
        seed, arm: the draw.
        rows: number of new rows.
        by, sigma, true: the change as diagnosed, its standard deviation, and the change itself [rad].
    """

    seed: int
    arm: str
    rows: int
    by: float
    sigma: float
    true: float

    @property
    def off(self) -> float:
        """Error of the change in its standard deviations."""
        return (self.by - self.true) / self.sigma


def changes(first: int, draws: int) -> Iterator[Seen | None]:
    """Yield what is diagnosed of each draw; None where it is not the zero of the joint alone."""
    for seed in range(first, first + draws):
        case = draw_case(seed, "offset")
        if case is None or case.truth is None or case.size is None:
            continue
        found = diagnose(case.model, case.new).found
        (joint,) = case.truth[1]
        one = found.changes[0] if len(found.changes) == 1 else None
        if one is None or (one.effect, one.joint) != ("joint_offset", joint):
            yield None
            continue
        (p,) = one.parameters.values()
        yield Seen(seed, ARMS[seed % 3], found.rows, p.after - p.before, p.sigma, case.size)


def summary(seen: list[Seen | None]) -> str:
    """Return the share of intervals that hold the change, for each arm and all, in words."""
    named = [one for one in seen if one is not None]
    words = [f"{len(named)} of {len(seen)} changes are named"]
    for arm in ("", *ARMS):
        of = [one for one in named if arm in ("", one.arm)]
        if not of:
            continue
        off = np.array([one.off for one in of])
        held = int((np.abs(off) <= INTERVAL).sum())
        words.append(f"{arm or 'all'}: {in_words(held, len(of))} hold it; off by {np.sqrt(np.mean(off**2)):.2f} sigma rms")
    return "\n".join(words)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=60, help="number of draws")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--out", type=Path, help="a line of JSON for each change that is named")
    given = parser.parse_args()
    found = list(changes(given.first, given.draws))
    if given.out:
        lines = (json.dumps(asdict(one)) for one in found if one is not None)
        given.out.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    print(summary(found))
