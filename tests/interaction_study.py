"""How often an error of one joint that depends on another is found: ``python tests/interaction_study.py``.

Each table is of another arm, with an error of the drive of one joint that follows its own position and another joint's
together, or the other's in fine waves, of lambda 400 in 300 poses, and no declared noise. It has to be found at its joint,
not taken for scatter. What is left at held-out poses without noise stands in units of what the same model leaves of the same
table without the error.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context

import numpy as np
from discovery_cases import FRESH_ARMS, INTERACTIONS, Case, discover, draw_case, gap, judge
from rates import in_words

from pincal import calibrate
from pincal.discover.ending import note_on_joints
from pincal.identify.split import hold_out
from pincal.model.chain import MomentFrame
from pincal.spread import end_with_parent

ARMS = ("kuka", "heavy", "light", *FRESH_ARMS)
STRENGTH, ROWS = 400.0, 300
# Most that may be left, in units of what the model leaves without the error.
ENOUGH = 1.5


@dataclass(frozen=True)
class Seen:
    """What a discovery made of one table.

    Attributes:
        kind, seed, arm: the table.
        is_found: whether an effect without a name stands at the joint.
        is_scatter: whether rows were weighed down as if joints scattered.
        false: names of the catalogue that are not there.
        left: error at held-out poses without noise [m].
        floor: the same without the error in the table.
        words: what was found.
    """

    kind: str
    seed: int
    arm: str
    is_found: bool
    is_scatter: bool
    false: int
    left: float
    floor: float
    words: str

    @property
    def ratio(self) -> float:
        """What is left, in units of the floor."""
        return self.left / self.floor

    def __str__(self) -> str:
        found = "found" if self.is_found else "not found"
        scatter = ", taken for scatter" if self.is_scatter else ""
        left = f"left {1e3 * self.left:.4f} mm, {self.ratio:.2f} times {1e3 * self.floor:.4f}"
        return f"{self.kind:12} {self.seed} {self.arm:12} {found}{scatter}; {left}: {self.words}"


def seen(task: tuple[str, int]) -> Seen:
    """Draw a table of a kind and return what a discovery makes of it."""
    kind, seed = task
    arm = ARMS[seed % len(ARMS)]
    case = draw_case(kind, seed, n=ROWS, strength=STRENGTH, arm=arm)
    case = replace(case, options=replace(case.options, sigma=None))
    trail = discover(case)
    verdict = judge(case, trail)
    _, held = hold_out(case.rows, 0.2, split="blocked", seed=0)
    at = held.rows - case.rows.rows[0]
    return Seen(
        kind,
        seed,
        arm,
        is_found=any(name[0] == "unnamed" and name[1] == case.hidden[0].joint for names in verdict.named for name in names),
        is_scatter=note_on_joints(trail.final) is not None,
        false=len(verdict.false_names),
        left=gap(trail.final, held, case.clean[at]),
        floor=_floor(case, trail.final.problem.chain.moment_frame),
        words=" | ".join(words for words in verdict.details if words[0] != "("),
    )


def _floor(case: Case, frame: MomentFrame) -> float:
    """Return what the plain model leaves of the same table without what is hidden, in the better moment frame."""
    _, held = hold_out(case.rows, 0.2, split="blocked", seed=0)
    position = case.rows.readings["position"] - (case.clean - case.sound)
    without = replace(case.rows, readings={**case.rows.readings, "position": position})
    training, _ = hold_out(without, 0.2, split="blocked", seed=0)
    frames = {case.moment_frame, frame}
    fits = [calibrate(case.robot, training, replace(case.plain, moment_frame=of)).fit for of in frames]
    return min(gap(fit, held, case.sound[held.rows - case.rows.rows[0]]) for fit in fits)


def study(tasks: Iterable[tuple[str, int]], workers: int) -> Iterator[Seen]:
    """Yield what is made of tables, as they come."""
    with ProcessPoolExecutor(workers, mp_context=get_context("forkserver"), initializer=end_with_parent) as pool:
        yield from pool.map(seen, tasks)


def summary(found: Sequence[Seen]) -> list[str]:
    """Return the rates in words."""
    if not found:
        return ["no table"]
    words = [
        f"found at its joint: {in_words(sum(one.is_found for one in found), len(found))}",
        f"rows weighed down as by scatter: {in_words(sum(one.is_scatter for one in found), len(found))}",
        f"with a false name: {in_words(sum(one.false > 0 for one in found), len(found))}",
    ]
    for kind in (*INTERACTIONS, None):
        own = [one.ratio for one in found if kind in (one.kind, None)]
        if own:
            rate = in_words(sum(ratio <= ENOUGH for ratio in own), len(own))
            words.append(f"left at most {ENOUGH} times the floor, {kind or 'all'}: {rate}; median {np.median(own):.2f}")
    return words


def main() -> None:
    """Print what is found table by table, and the rates."""
    parser = argparse.ArgumentParser(description="Print how often an error of one joint that depends on another is found.")
    parser.add_argument("--count", type=int, default=30, help="tables; default: 30")
    parser.add_argument("--seed", type=int, default=9100, help="of the first; default: 9100")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes; default: one for each core")
    chosen = parser.parse_args()
    tasks = [(INTERACTIONS[i % len(INTERACTIONS)], chosen.seed + i) for i in range(chosen.count)]
    found = list[Seen]()
    for one in study(tasks, chosen.workers):
        print(one, flush=True)
        found.append(one)
    print("\n".join(summary(found)))


if __name__ == "__main__":
    for _name in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[_name] = "1"  # for the processes that are started
    main()
