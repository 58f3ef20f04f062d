"""Rates from counts: exact intervals, and what a number of tables lets a test notice.

``python tests/rates.py --add FILE.jsonl`` draws fresh cases of each claim of ``rate_claims`` and adds what came out to those
of earlier runs of the same library. A sequential test, valid however often it is looked at, tells when a rate is exceeded;
then the exit code is 1.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import betainc, betaln
from scipy.stats import beta, binom, t

# How often a test of a rate fails by chance alone.
CHANCE = 1e-3


def interval(hits: int, n: int, *, level: float = 0.95) -> tuple[float, float]:
    """Return the interval of a rate that was met so often (Clopper and Pearson, 1934), 0 to 1."""
    tail = (1.0 - level) / 2.0
    low, high = beta.ppf([tail, 1.0 - tail], [hits, hits + 1], [n - hits + 1, n - hits])
    return (float(low) if hits else 0.0), (float(high) if hits < n else 1.0)


def interval_of_blocks(hits: Sequence[float], counts: Sequence[float], *, level: float = 0.95) -> tuple[float, float]:
    """Return the interval of a rate of things that are alike within blocks, such as readings of a region, 0 to 1.

    It is that of Clopper and Pearson for the number of independent things that would scatter as the blocks do, and for
    how few blocks tell that (Korn and Graubard 1998, Survey Methodology 24, 193-201).

    Example:
        >>> interval_of_blocks([10, 0, 10, 10], [10, 10, 10, 10])[0] < 0.1 < interval(30, 40)[0]
        True
    """
    each, all_of = np.asarray(hits, float), np.asarray(counts, float)
    n, blocks = float(all_of.sum()), int(np.count_nonzero(all_of))
    rate = float(each.sum()) / n
    effective = float(blocks)
    if 0.0 < rate < 1.0 and blocks > 1:
        variance = blocks / (blocks - 1.0) * float(np.sum((each - rate * all_of) ** 2)) / n**2
        tail = (1.0 - level) / 2.0
        known = float(t.ppf(tail, n - 1.0) / t.ppf(tail, blocks - 1.0)) ** 2
        effective = min(known * rate * (1.0 - rate) / max(variance, 1e-12), n)
    return interval_of_share(rate, effective, level=level)


def interval_of_share(rate: float, n: float, *, level: float = 0.95) -> tuple[float, float]:
    """Return the interval of Clopper and Pearson of a rate of n things, of which n need not be whole."""
    tail = (1.0 - level) / 2.0
    low, high = beta.ppf([tail, 1.0 - tail], [rate * n, rate * n + 1.0], [n - rate * n + 1.0, n - rate * n])
    return (float(low) if rate > 0.0 else 0.0), (float(high) if rate < 1.0 else 1.0)


def in_words(hits: int, n: int) -> str:
    """Return a rate with its interval.

    Example:
        >>> in_words(3, 300)
        '3 of 300: 0.2 to 2.9 %'
    """
    low, high = (100.0 * edge for edge in interval(hits, n))
    return f"{hits} of {n}: {low:.1f} to {high:.1f} %"


def percent(rate: float) -> str:
    """Return a rate without decimals, which a small count does not have.

    Example:
        >>> percent(0.126), percent(0.003)
        ('13 %', '< 1 %')
    """
    return f"{100.0 * rate:.0f} %" if rate >= 0.005 else "< 1 %"


def is_at_least(rate: float, hits: Sequence[bool]) -> bool:
    """Return whether so few hits are no surprise at a rate."""
    return bool(binom.cdf(sum(hits), len(hits), rate) > CHANCE)


def is_at_most(rate: float, hits: Sequence[bool]) -> bool:
    """Return whether so many hits are no surprise at a rate."""
    return bool(binom.sf(sum(hits) - 1, len(hits), rate) > CHANCE)


def allowed(rate: float, n: int) -> int:
    """Return with how many hits in n tables :func:`is_at_most` still holds."""
    counts = np.arange(n + 1)
    return int(counts[binom.sf(counts - 1, n, rate) > CHANCE][-1])


def power(rate: float, n: int, *, factor: float = 2.0) -> float:
    """Return how likely :func:`is_at_most` of a rate fails in n tables where the rate is so many times as high."""
    return float(binom.sf(allowed(rate, n), n, min(factor * rate, 1.0)))


def tables_for(rate: float, *, factor: float = 2.0, wanted: float = 0.9) -> int:
    """Return how many tables it takes to notice a rate that is so many times as high, with a power."""
    n = 1
    while power(rate, n, factor=factor) < wanted:
        n += max(n // 200, 1)
    return n


def noticed(rate: float, n: int, *, wanted: float = 0.9) -> float:
    """Return the rate from which on n tables show, with a power, that it is higher than it should be; 1 if none does."""
    rates = np.linspace(rate, 1.0, 2001)
    seen = rates[binom.sf(allowed(rate, n), n, rates) >= wanted]
    return float(seen[0]) if len(seen) else 1.0


def evidence(rate: float, hits: int, n: int) -> float:
    """Return the evidence that a rate is exceeded: the likelihood, on average up to five times the rate, over that at it.

    Where the rate holds, it ever exceeds 1 / CHANCE, in however many looks at growing counts, with at most that chance
    (Ville's inequality; Howard et al. 2021, Annals of Statistics 49, 1055-1080).

    Example:
        >>> evidence(0.01, 1, 100) < 1.0 < 1000.0 < evidence(0.01, 12, 300)
        True
    """
    most = min(5.0 * rate, 1.0)
    log_null = hits * np.log(rate) + (n - hits) * np.log1p(-rate)
    between = float(np.diff(betainc(hits + 1, n - hits + 1, [rate, most]))[0])
    log_mean = betaln(hits + 1, n - hits + 1) + np.log(max(between, 1e-300)) - np.log(most - rate)
    return float(np.exp(log_mean - log_null))


def version() -> str:
    """Return what git calls the state of the library, whatever changed beside it."""
    root = Path(__file__).parent.parent

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True).stdout.strip()

    return git("rev-parse", "--short=12", "HEAD:pincal") + ("-dirty" if git("status", "--porcelain", "pincal") else "")


def read(path: Path) -> list[dict[str, Any]]:
    """Return the draws of a file; a line that a killed run left unfinished is none."""
    found = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return found


def summary(draws: Sequence[dict[str, Any]]) -> Iterator[tuple[str, bool]]:
    """Yield of each claim its counts in words, and whether its rate is exceeded."""
    from rate_claims import CLAIMS

    for claim in CLAIMS:
        told = [draw["wrong"] for draw in draws if draw["claim"] == claim.name and draw["wrong"] is not None]
        if not told:
            continue
        is_exceeded = evidence(claim.rate, sum(told), len(told)) > 1.0 / CHANCE
        verdict = "EXCEEDED" if is_exceeded else "not exceeded"
        seen = f"twice the rate would be seen with {percent(power(claim.rate, len(told)))}"
        words = f"{claim.words}: {in_words(sum(told), len(told))}; at most {claim.rate:.1%}: {verdict}; {seen}"
        yield words, is_exceeded


def main() -> int:
    """Add draws to a file and print the rates of this version."""
    from concurrent.futures import ProcessPoolExecutor, as_completed
    from multiprocessing import get_context

    from rate_claims import CLAIMS, is_wrong

    from pincal.spread import end_with_parent

    parser = argparse.ArgumentParser(description="Add fresh draws of each promised rate and print what all say.")
    parser.add_argument("--add", type=Path, required=True, metavar="FILE", help="lines of JSON; they add up")
    parser.add_argument("--tables", type=int, default=100, help="draws of each claim; default: 100")
    parser.add_argument("--claims", nargs="+", choices=[claim.name for claim in CLAIMS], help="default: all")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes; default: one for each core")
    chosen = parser.parse_args()
    of = version()
    before = read(chosen.add)
    # Seeds that no run has had, of any version.
    first = 1 + max((draw["seed"] for draw in before), default=1_000_000)
    names = chosen.claims or [claim.name for claim in CLAIMS]
    tasks = [(name, seed) for seed in range(first, first + chosen.tables) for name in names]
    with (
        ProcessPoolExecutor(chosen.workers, mp_context=get_context("forkserver"), initializer=end_with_parent) as pool,
        chosen.add.open("a", encoding="utf-8") as file,
    ):
        running = {pool.submit(is_wrong, task): task for task in tasks}
        for future in as_completed(running):
            name, seed = running[future]
            draw = {"version": of, "claim": name, "seed": seed, "wrong": future.result()}
            before.append(draw)
            print(json.dumps(draw), file=file, flush=True)
    found = list(summary([draw for draw in before if draw["version"] == of]))
    print("\n".join(words for words, _ in found))
    return int(any(is_exceeded for _, is_exceeded in found))


if __name__ == "__main__":
    for _name in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[_name] = "1"  # for the processes that are started
    raise SystemExit(main())
