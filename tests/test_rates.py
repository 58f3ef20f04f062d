"""Draws of promised rates add up, and a rate that is exceeded is told however often it is looked at."""

from __future__ import annotations

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import rate_claims
import rates

HERE = Path(__file__).parent


def test_evidence_is_a_mean_likelihood() -> None:
    """Between the rate and five times the rate, against numerical integration."""
    p = np.linspace(0.02, 0.1, 20001)
    likelihood = (p / 0.02) ** 7 * ((1.0 - p) / 0.98) ** 93

    assert rates.evidence(0.02, 7, 100) == pytest.approx(np.mean(likelihood), rel=1e-3)


def test_a_rate_that_holds_is_seldom_called_exceeded_in_all_looks() -> None:
    """None of 300 sequences of 3000 draws at 1 %, looked at after each hundred, and most of those at 3 %."""
    rng = np.random.default_rng(0)
    looks = np.arange(100, 3001, 100)
    told = {}
    for true in (0.01, 0.03):
        hits = (rng.random((300, 3000)) < true).cumsum(axis=1)[:, looks - 1]
        found = [
            any(rates.evidence(0.01, int(k), int(n)) > 1.0 / rates.CHANCE for k, n in zip(of, looks, strict=True))
            for of in hits
        ]
        told[true] = np.mean(found)

    assert told[0.01] == 0.0 and told[0.03] > 0.98


def test_an_interval_of_blocks_counts_what_is_alike_once() -> None:
    """Blocks of 30 that are half alike: the interval holds the rate in 95 % of draws, that of independent things in fewer.

    Of blocks of single things it is that of Clopper and Pearson.
    """
    rng = np.random.default_rng(0)
    held = {"blocks": 0, "alone": 0}
    for _ in range(300):
        # Rates of 15 blocks, 0.8 on average, scattering so that two of a block are correlated by 0.4.
        hits = rng.binomial(30, rng.beta(1.2, 0.3, 15))
        for name, (low, high) in {
            "blocks": rates.interval_of_blocks(hits.tolist(), [30] * 15),
            "alone": rates.interval(int(hits.sum()), 450),
        }.items():
            held[name] += low < 0.8 < high
    assert held["blocks"] > 0.92 * 300 and held["alone"] < 0.6 * 300
    single = rates.interval_of_blocks([1.0] * 180 + [0.0] * 20, [1.0] * 200)
    assert single == pytest.approx(rates.interval(180, 200), abs=2e-3)


def test_only_draws_of_a_claim_that_tell_something_count() -> None:
    draws = [{"claim": "alarm", "wrong": wrong} for wrong in (False, None, True)] + [{"claim": "pair", "wrong": None}]
    ((words, is_exceeded),) = rates.summary(draws)

    assert words.startswith("an alarm for a robot that has not changed: 1 of 2: ") and not is_exceeded


def test_claims_have_names_of_their_own() -> None:
    names = [claim.name for claim in rate_claims.CLAIMS]

    assert len(set(names)) == len(names) and all(0.0 < claim.rate <= 0.05 for claim in rate_claims.CLAIMS)


@pytest.mark.long
def test_runs_add_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A second run has other seeds; a line that was cut off is none."""
    file = tmp_path / "rates.jsonl"
    command = ["rates.py", "--add", str(file), "--tables", "1", "--claims", "alarm_stops", "name_rigid", "--workers", "1"]
    subprocess.run([sys.executable, *command], cwd=HERE, capture_output=True, check=True, timeout=300)
    # Processes of the second would import the library again.
    monkeypatch.setattr("concurrent.futures.ProcessPoolExecutor", lambda *_, **__: ThreadPoolExecutor(1))
    monkeypatch.setattr(sys, "argv", command)
    assert rates.main() == 0
    with file.open("a", encoding="utf-8") as cut:
        cut.write('{"version": "')

    assert len({(draw["claim"], draw["seed"]) for draw in rates.read(file)}) == 4
    assert all(json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()[:4])
    assert "a rigid arm): 0 of 2" in capsys.readouterr().out
