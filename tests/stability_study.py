"""How true names are that come up in most halves of the poses: ``python tests/stability_study.py``.

Every case is a drawn arm whose frames are anywhere, of 200 poses, with an effect of the catalogue, one from outside it or
none. A discovery's names are repeated on 20 halves; each is right if it is what is hidden, alone or in its tie group.
"""

from __future__ import annotations

import argparse
import os
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from discovery_cases import ELASTICITY, FOREIGN, NAMED, discover, draw_case, fresh, name_of
from matplotlib.figure import Figure
from rates import interval

from pincal.calibration.fitted_robot import FittedRobot
from pincal.discover.discovery_file import EffectName
from pincal.discover.ending import widened
from pincal.discover.run import begin_subsamples
from pincal.errors import PincalWarning
from pincal.identify.split import hold_out, row_groups

HALVES = 20
POSES = 200  # of which a fifth is held out, and half of the others are a half
STRENGTHS = (30.0, 300.0)  # lambda of what is hidden: some of it comes up in few halves only
CLASSES = ((0, 6), (6, 12), (12, 18), (18, 21))  # numbers of halves, the last one left out


@dataclass(frozen=True)
class Printed:
    """What is printed of one case.

    Attributes:
        kind: what is hidden.
        seed: of the case.
        names: in how many halves each name comes up, and whether it is right.
        coverage: share of the 95 % intervals of held-out coordinates that hold the true one.
    """

    kind: str
    seed: int
    names: tuple[tuple[int, bool], ...]
    coverage: float


def printed(task: tuple[str, int, float]) -> Printed:
    """Return what a discovery prints of a case, given by its kind, its seed and its strength."""
    warnings.simplefilter("ignore", PincalWarning)
    kind, seed, strength = task
    case = draw_case(kind, seed, **{**fresh(seed), "n": POSES, "strength": strength})
    training, held = hold_out(case.rows, 0.2, split="blocked", seed=0)
    trail = discover(case)
    halves = begin_subsamples(trail, [row_groups(training, split="blocked", seed=0)], HALVES)()
    steps = [step for step in trail.steps if step.effect.name not in ELASTICITY]
    groups = [{name_of(effect) for effect in (step.effect, *step.equivalent)} for step in steps]
    # What has no name claims none.
    right = [
        step.effect.name == "unnamed" or any(t in names for t in case.truth)
        for step, names in zip(steps, groups, strict=True)
    ]
    fit = FittedRobot.of(widened(trail))
    at = fit.readings(held).conditions
    error = fit.predict(at)[:, :, 3] - case.clean[held.rows - case.rows.rows[0]]
    coverage = float(np.mean(np.abs(error) < 1.96 * fit.position_sigma(at)))
    names = tuple((halves.count(EffectName.of(step.effect).in_tables), ok) for step, ok in zip(steps, right, strict=True))
    return Printed(kind, seed, names, coverage)


def study(tasks: Sequence[tuple[str, int, float]]) -> list[Printed]:
    """Return what is printed of several cases, each a kind, a seed and a strength, on two processes."""
    with ProcessPoolExecutor(2, mp_context=get_context("forkserver")) as pool:
        return list(pool.map(printed, tasks))


def by_class(found: Sequence[Printed]) -> Iterator[tuple[range, list[bool]]]:
    """Yield numbers of halves, and of the names that came up in so many whether they are right."""
    for low, high in CLASSES:
        yield range(low, high), [right for case in found for count, right in case.names if low <= count < high]


def draw(found: Sequence[Printed], path: Path) -> None:
    """Draw which share of names is right, by the number of halves they come up in, with 95 % intervals."""
    figure = Figure(figsize=(5.0, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, HALVES], [0, 1], color="0.7", label="as often right as it comes up")
    for halves, right in by_class(found):
        if not right:
            continue
        middle, (low, high) = (halves[0] + halves[-1]) / 2.0, interval(sum(right), len(right))
        axes.errorbar(
            middle, np.mean(right), [[np.mean(right) - low], [high - np.mean(right)]], fmt="o", color="C0", capsize=3
        )
        axes.annotate(f"{sum(right)} of {len(right)}", (middle, low), (0, -11), textcoords="offset points", ha="center")
    axes.set(xlabel=f"subsamples in which a name is found, of {HALVES}", ylabel="share of names that are right")
    axes.set(xlim=(0, HALVES + 0.5), ylim=(0, 1.05), xticks=range(0, HALVES + 1, 5))
    axes.legend(loc="lower right")
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Print, and draw if wanted, how true printed names are."""
    parser = argparse.ArgumentParser(description="Print how often names are right that come up in so many halves.")
    parser.add_argument("--count", type=int, default=3, help="cases of each kind; default: 3, which takes about 20 minutes")
    parser.add_argument("--seed", type=int, default=9900, help="of the first case; default: 9900")
    parser.add_argument("--draw", type=Path, metavar="FILE", help="picture to write")
    chosen = parser.parse_args()
    kinds = [kind for kind in ("null", *NAMED, *FOREIGN) for _ in range(chosen.count)]
    strengths = np.exp(np.random.default_rng(chosen.seed).uniform(*np.log(STRENGTHS), len(kinds)))
    found = study([(kind, chosen.seed + i, float(strengths[i])) for i, kind in enumerate(kinds)])
    for case in found:
        if not all(right for _, right in case.names):
            print(f"{case.kind} {case.seed}: " + ", ".join(f"{count} {right}" for count, right in case.names))
    for halves, right in by_class(found):
        low, high = interval(sum(right), len(right))
        print(
            f"in {halves[0]} to {halves[-1]} of {HALVES}: {len(right)} names, {sum(right)} right ({low:.3f} to {high:.3f})"
        )
    for what, group in (("nothing", ("null",)), ("a name", NAMED), ("no name", FOREIGN), ("any", kinds)):
        coverage = np.array([case.coverage for case in found if case.kind in group])
        error = coverage.std(ddof=1) / np.sqrt(len(coverage))
        print(f"{what} hidden: 95 % intervals cover {coverage.mean():.4f} +- {error:.4f}, {len(coverage)} cases")
    if chosen.draw:
        draw(found, chosen.draw)


if __name__ == "__main__":
    for _name in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[_name] = "1"  # for the processes that are started
    main()
