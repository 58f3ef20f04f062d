"""A calibrated robot checked at intervals: evidence that holds its rate, what has moved, and the record beside the model."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from command_line import run
from interim_cases import INSTRUMENT, TOOL, CheckedArm, checked_arm, day_of
from interim_study import checks_of
from rates import is_at_most
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from pincal import Measurements
from pincal.calibration.check_record import CheckedRows, Withdrawal, load_record, record_of
from pincal.cli.checked import last_check
from pincal.errors import BadInputError, MeasurementError
from pincal.fleet.checked_robot import CheckedRobot, CheckSeries
from pincal.fleet.fleet_numbers import WATCH
from pincal.fleet.interim_evidence import (
    _FINE,
    _NOISES,
    _SIZES,
    _WALKS,
    CheckRows,
    InterimWatch,
    interim_evidence,
    interpolation,
)

KINDS = {"base": np.array([0, 1, 2, 3, 4, 5]), "joint": np.array([6])}
CHANCES = {"base": 0.5, "joint": 0.5}
DAYS = (1.0, 1.0, 5.0)
X, _, Z = np.eye(3)


@cache
def arm() -> CheckedArm:
    """Return a robot whose tables are drawn one after the other."""
    return checked_arm(1)


def drawn(rng: np.random.Generator, *, noise: float, walk: float = 0.0, checks: int = 3) -> list[CheckRows]:
    """Draw the readings of three points, day by day, of a robot that has not changed; of 50 um noise."""
    known, lever = rng.normal(size=(9, 4)), rng.normal(size=(9, 6))
    base, changes = lever / 5e-5, np.hstack([lever, rng.normal(size=(9, 1))]) / 5e-5
    x, b, rows = rng.standard_normal(4), np.zeros(6), []
    for k in range(checks):
        b = b + walk * np.sqrt(DAYS[k % 3]) * rng.standard_normal(6)
        rows.append(CheckRows(known @ x + base @ b + noise * rng.standard_normal(9), known, base, changes, DAYS[k % 3]))
    return rows


def dense(rows: list[CheckRows], noise: float, walk: float, change: tuple[np.ndarray, float, int] | None = None) -> float:
    """Return the log likelihood by one covariance of all readings, with a change of columns, size and start if any."""
    known = np.vstack([one.known for one in rows])
    V = known @ known.T + noise**2 * np.eye(len(known))
    ends = np.cumsum([0, *(len(one.known) for one in rows)])
    times = np.cumsum([one.days for one in rows])
    base = [one.base for one in rows]
    for i, start in enumerate(ends[:-1]):
        for j, other in enumerate(ends[:-1]):
            at = np.ix_(range(start, ends[i + 1]), range(other, ends[j + 1]))
            V[at] += walk**2 * min(times[i], times[j]) * base[i] @ base[j].T
    if change is not None:
        columns, size, since = change
        moved = np.vstack([one.changes[:, columns] * (k >= since) for k, one in enumerate(rows)])
        V += size**2 * moved @ moved.T
    return float(multivariate_normal(cov=V).logpdf(np.concatenate([one.residuals for one in rows])))


def constant(rows: list[CheckRows]) -> float:
    """Return the part of a log density that no parameter changes."""
    return 0.5 * sum(len(one.residuals) for one in rows) * np.log(2.0 * np.pi)


def test_evidence_is_that_of_the_covariance_of_all_readings() -> None:
    """The filter and its scores against one dense normal density for each noise, walk, start, kind and size."""
    rows = drawn(np.random.default_rng(3), noise=1.2, walk=3e-6)
    _, weights = interpolation(np.array(_NOISES))

    def mixed(change: tuple[np.ndarray, float, int] | None = None) -> float:
        logs = np.array([[dense(rows, s, w, change) for w in _WALKS] for s in _NOISES])
        return float(logsumexp(weights @ logs)) - np.log(_FINE * len(_WALKS))

    h = WATCH.hazard
    parts = [
        np.log(h) + s * np.log1p(-h) + np.log(CHANCES[kind] / len(_SIZES)) + mixed((at, size, s))
        for s in range(3)
        for kind, at in KINDS.items()
        for size in _SIZES
    ]
    null = np.array([[dense(rows, s, w) for w in _WALKS] for s in _NOISES])
    expected = logsumexp([*parts, 3 * np.log1p(-h) + mixed()]) - (weights @ null).max()

    watch = InterimWatch(KINDS, CHANCES, 4)
    for one in rows:
        watch.take(one)

    assert np.allclose(watch.log_likelihoods, null + constant(rows), atol=1e-6)
    assert abs(watch.evidence().log_e - expected) < 1e-6


def test_noises_and_walks_that_nothing_supports_hardly_matter() -> None:
    """They are left out for speed: the evidence is smaller, by next to nothing."""
    rows = drawn(np.random.default_rng(4), noise=1.0, checks=12)
    whole = InterimWatch(KINDS, CHANCES, 4)
    for one in rows:
        whole.take(one)
    less = whole.evidence().log_e - interim_evidence(rows, KINDS, CHANCES).log_e
    assert -1e-9 < less < 1e-3


@pytest.mark.long
@pytest.mark.parametrize("noise", [1.0, *(pytest.param(noise, marks=pytest.mark.rates) for noise in (0.5, 1.5))])
def test_evidence_reaches_twenty_in_a_twentieth_of_unchanged_robots(noise: float) -> None:
    """Ever within twenty days, whatever the noise is, and with a base that walks."""
    alarms = []
    for seed in range(60):
        watch = InterimWatch(KINDS, CHANCES, 4)
        largest = -np.inf
        for one in drawn(np.random.default_rng([seed, 7]), noise=noise, walk=3e-6, checks=20):
            watch.take(one)
            largest = max(largest, watch.evidence().log_e)
        alarms.append(largest >= np.log(20.0))
    assert is_at_most(0.05, alarms)


def checked(table: Measurements, before: CheckedRobot | None = None, day: int = 0, **options: object) -> CheckedRobot:
    """Return the robot with a further check."""
    return (before or CheckedRobot.of(arm().fitted)).checked(table, day_of(day), **options)  # type: ignore[arg-type]


@cache
def five_days() -> CheckedRobot:
    """Return the robot after five checks that found nothing."""
    found = CheckedRobot.of(arm().fitted)
    for day in range(5):
        found = checked(arm().table(), found, day)
    assert not any(check.has_failed for check in found.record.checks)
    return found


@pytest.mark.parametrize(
    ("what", "table"),
    [
        ("base", lambda: arm().table(base=np.array([3e-4, 0.0, 0.0]))),
        ("tool", lambda: arm().table(tool=TOOL + 2e-4 * X)),
        ("temperature", lambda: arm().table(warm=12.0)),
        ("joint_3", lambda: arm().table(arm().bent(2e-4))),
    ],
)
def test_what_has_moved_is_named(what: str, table: object) -> None:
    """Within three checks, and since the first of them."""
    found = five_days()
    for day in range(5, 8):
        found = checked(table(), found, day)  # type: ignore[operator]
    last = found.record.checks[-1]
    assert last.has_failed and last.change is not None
    assert what in (last.change.what, *last.change.equals)
    assert last.change.since == day_of(5)


def test_the_size_of_an_offset_is_told_within_its_uncertainty() -> None:
    """And a coordinate's U covers what is there: errors are larger than expected."""
    found = five_days()
    for day in range(5, 9):
        found = checked(arm().table(arm().bent(3e-4)), found, day)
    last = found.record.checks[-1]
    assert last.change is not None and last.change.joint == "joint_3"
    value, sigma, unit = last.change.sizes["offset"]
    assert unit == "rad" and abs(value - 3e-4) < 4.0 * sigma < 3e-4
    assert last.error > 0.5 * last.expanded and last.within < last.of


def test_a_walking_base_is_drift_and_no_alarm() -> None:
    """3 um a day in one direction for thirty days; the drift that is told is of that size."""
    found = CheckedRobot.of(arm().fitted)
    for day in range(0, 31, 3):
        found = checked(arm().table(base=np.array([3e-6 * day, 0.0, 0.0])), found, day)
    assert not any(check.has_failed for check in found.record.checks)
    last = found.record.checks[-1]
    # 90 um along one axis are 52 um of a coordinate, root mean square.
    assert 2e-5 < last.drift < 1.1e-4


def test_an_instrument_set_up_anew_hides_the_base_and_not_the_tool() -> None:
    """Its place is taken from the rows, wherever it stands."""
    turned = Rotation.from_euler("xyz", [0.3, -0.2, 1.0]).as_matrix()
    found = five_days()
    for day in range(5, 8):
        found = checked(arm().table(turned=turned, base=np.array([1e-3, 0.0, 0.0])), found, day, is_new_station=True)
    assert not found.record.checks[-1].has_failed
    for day in range(8, 12):
        found = checked(arm().table(turned=turned, tool=TOOL + 5e-4 * Z), found, day, is_new_station=True)
    last = found.record.checks[-1]
    assert last.has_failed and last.change is not None
    assert "tool" in (last.change.what, *last.change.equals)


def test_an_alarm_needs_evidence_of_the_inverse_of_its_rate() -> None:
    """Ville's inequality: 20 for 5 %, 1000 for a tenth of a per cent."""
    table = arm().table(arm().bent(5e-4))
    found = checked(table, five_days(), 5)
    last = found.record.checks[-1]
    rate = float(np.exp(-last.log_e))
    assert last.limit == pytest.approx(20.0)
    for factor in (0.9, 1.1):
        again = checked(table, five_days(), 5, false_alarms=rate * factor).record.checks[-1]
        assert again.has_failed == (factor > 1.0)
    for wrong in (0.0, 0.5, np.nan):
        with pytest.raises(BadInputError, match="over the whole life"):
            checked(table, five_days(), 5, false_alarms=wrong)


def test_two_points_are_refused() -> None:
    """Three are enough."""
    table = arm().table()
    assert checked(table.select(slice(0, 3))).record.checks
    with pytest.raises(MeasurementError, match=r"2 stops of the robot; expected 3 or more"):
        checked(table.select(slice(0, 2)))


def test_rows_are_judged_once_and_in_their_order() -> None:
    """Checked again under whatever name and noise, or before the last day, they are refused."""
    table = arm().table()
    found = checked(table, day=3)
    for same in (table, replace(table, source="other.csv", sigma=np.full(len(table), 1e-4))):
        with pytest.raises(BadInputError, match="were checked on 2026-01-04 already"):
            checked(same, found, 4)
    with pytest.raises(BadInputError, match=r"measured on 2026-01-03, but the last check"):
        checked(arm().table(), found, 2)
    for day in ("yesterday", "20260105", "2026-W02-1"):
        with pytest.raises(BadInputError, match="expected an ISO date"):
            found.checked(arm().table(), day)


def test_a_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    """Rows included, from which the same verdict follows; of another calibration it says nothing."""
    found = five_days()
    found.record.save(tmp_path / "model.checks.json")
    record, note = record_of(arm().fitted, tmp_path / "model.checks.json")
    assert record == found.record and note is None
    assert record is not None
    again = CheckSeries(arm().fitted, tuple(check.rows for check in record.checks)).judged(0.05)
    assert again == record.checks[-1]
    other, note = record_of(checked_arm(2).fitted, tmp_path / "model.checks.json")
    assert other is None and note is not None and "of another calibration" in note


@pytest.mark.parametrize(
    "change",
    [
        {"format": "pincal-model"},
        {"checks": [{"rows": {}}]},
        {"model": 3},
        {"model": "robot 17"},
        {"model": "A" * 64},
    ],
)
def test_a_file_that_is_no_record_is_refused(change: dict[str, object], tmp_path: Path) -> None:
    """With its name and the key that is wrong."""
    path = tmp_path / "model.checks.json"
    five_days().record.save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(BadInputError, match=r"model\.checks\.json.*expected"):
        load_record(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [("day", "foo"), ("day", "20260101"), ("sigma", [0.0]), ("sigma", []), ("joints", ["a", "a"]), ("mark", "x")],
)
def test_rows_of_a_damaged_record_are_refused_with_their_key(key: str, value: object, tmp_path: Path) -> None:
    """Before anything is judged by them."""
    path = tmp_path / "model.checks.json"
    five_days().record.save(path)
    content = json.loads(path.read_text())
    content["checks"][1]["rows"][key] = value
    path.write_text(json.dumps(content))
    with pytest.raises(BadInputError, match=rf"model\.checks\.json: checks\[1\]\.rows\.{key}: .*expected.*backup"):
        load_record(path)


@pytest.mark.parametrize("columns", [{"q": [[1.0]] * 2}, {"q": "text"}, {"position": [[1e99] * 3] * 5}, {}])
def test_columns_that_are_no_table_are_refused(columns: dict[str, object]) -> None:
    """Of a record that was edited by hand."""
    rows = five_days().record.checks[0].rows
    damaged = CheckedRows(
        day=rows.day,
        table="t.csv",
        mark="",
        joints=rows.joints,
        columns={**rows.columns, **columns} if columns else {},  # type: ignore[dict-item]
        sigma=rows.sigma,
    )
    with pytest.raises(BadInputError):
        damaged.measurements()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a model and tables of checks."""
    folder = tmp_path_factory.mktemp("interim")
    arm().fitted.save(folder / "model.json")
    for name, table in (("mon", arm().table()), ("tue", arm().table()), ("bad", arm().table(arm().bent(1e-3)))):
        write(table, folder / f"{name}.csv")
    return folder


def write(table: Measurements, path: Path) -> None:
    """Write positions as a table."""
    assert table.position is not None
    lines = [",".join([*table.joint_names, "x", "y", "z"])]
    lines += [",".join(f"{value:.9f}" for value in row) for row in np.hstack([table.q, table.position])]
    path.write_text("\n".join(lines) + "\n")


def test_the_command_keeps_a_record_and_tells_an_alarm(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 6; a check that is refused leaves the record as it was."""
    model = str(folder / "model.json")
    assert run("interim", model, str(folder / "mon.csv"), "--day", "2026-01-05") == 0
    out = capsys.readouterr().out
    assert "no change found" in out and len(out.splitlines()) <= 12
    # A ratio of likelihoods, which is no chance of a change.
    assert re.search(r"readings [0-9.]+ times as likely if something has changed; an alarm from 20 on\n", out)
    before = (folder / "model.checks.json").read_bytes()
    assert run("interim", model, str(folder / "mon.csv"), "--day", "2026-01-06") == 3
    assert (folder / "model.checks.json").read_bytes() == before
    assert "were checked on 2026-01-05 already" in capsys.readouterr().err
    assert run("interim", model, str(folder / "tue.csv"), "--day", "2026-01-06", "--json") == 0
    assert json.loads(capsys.readouterr().out)["check"] == 2
    assert run("interim", model, str(folder / "bad.csv"), "--day", "2026-01-07") == 6
    out = capsys.readouterr().out
    assert "ALARM" in out and "joint_3: offset" in out
    assert [check.has_failed for check in load_record(folder / "model.checks.json").checks] == [False, False, True]


def test_a_withdrawn_check_does_not_count_and_is_kept() -> None:
    """What is judged later is what a record without it shows, to the last digit."""
    days = [day_of(k) for k in range(1, 5)]
    tables = [arm().table(), arm().table(arm().bent(1e-3)), arm().table(), arm().table()]
    whole = sound = CheckedRobot.of(arm().fitted)
    for k, (table, day) in enumerate(zip(tables, days, strict=True)):
        whole = whole.checked(table, day)
        sound = sound if k == 1 else sound.checked(table, day)
    assert whole.record.checks[-1].has_failed and not sound.record.checks[-1].has_failed

    left = whole.withdrawn(days[1], "nest was loose", days[3])
    assert left.record.counting == sound.record.checks
    assert left.record.last == sound.record.last
    gone = left.record.checks[1]
    assert gone.rows == whole.record.checks[1].rows and gone.has_failed
    assert gone.withdrawn == Withdrawal(day=days[3], reason="nest was loose")
    assert left.record.withdrawn_words == f"number 2 of {days[1]} (nest was loose)"
    # Its table may be checked again, as where it was given a wrong day.
    assert len(left.checked(tables[1], days[3]).record.counting) == 4
    for which, words in ((days[1], "no such check"), ("9", "no such check"), ("", "no such check")):
        with pytest.raises(BadInputError, match=words):
            left.withdrawn(which, "why", days[3])
    with pytest.raises(BadInputError, match="no reason"):
        left.withdrawn(days[0], " ", days[3])
    twice = left.checked(arm().table(), days[3])
    with pytest.raises(BadInputError, match="several checks, numbers 4, 5"):
        twice.withdrawn(days[3], "why", days[3])
    assert twice.withdrawn("4", "why", days[3]).record.withdrawn_words.endswith(f"number 4 of {days[3]} (why)")


def test_the_command_withdraws_a_check(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An alarm is gone with it; measure and certificate say so; nothing is written where it is refused."""
    model, record = str(folder / "model.json"), tmp_path / "checks.json"
    words = ("interim", model, "--record", str(record))
    assert run(*words, str(folder / "mon.csv"), "--day", "2026-01-05") == 0
    assert run(*words, str(folder / "bad.csv"), "--day", "2026-01-06") == 6
    before = record.read_bytes()
    capsys.readouterr()
    for given, code, said in (
        (("--withdraw", "2026-01-09", "--reason", "x"), 3, "checks.json: --withdraw 2026-01-09: no such check"),
        (("--withdraw", "2026-01-06"), 2, "--reason TEXT"),
        (("--withdraw", "2026-01-06", "--reason", "x", str(folder / "tue.csv")), 2, "takes no table"),
        (("--reason", "x", str(folder / "tue.csv")), 2, "--withdraw DAY"),
        ((), 2, "TODAY.csv"),
        ((str(folder / "tue.csv"), "--day", "2026-01-01"), 3, "the last check in .*checks.json is of 2026-01-06"),
        ((str(folder / "tue.csv"), "--day", "monday"), 3, "--day: day 'monday'; expected an ISO date"),
    ):
        assert run(*words, *given) == code
        assert re.search(said, " ".join(capsys.readouterr().err.split()))
        assert record.read_bytes() == before
    assert run(*words, "--withdraw", "2", "--reason", "the nest was loose", "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["check"], shown["verdict"]) == (1, "checked")
    assert shown["withdrawn"][0]["check"] == 2 and shown["withdrawn"][0]["withdrawn"]["reason"] == "the nest was loose"
    found = load_record(record)
    assert [check.withdrawn is None for check in found.checks] == [True, False]
    assert last_check(folder / "model.json", record) == (
        found.checks[0],
        ("interim checks that were withdrawn: number 2 of 2026-01-06 (the nest was loose)",),
    )
    assert run(*words, str(folder / "tue.csv"), "--day", "2026-01-06") == 0
    out = capsys.readouterr().out
    assert "number 3 since" in out and "withdrawn number 2 of 2026-01-06 (the nest was loose)" in out
    for number in ("1", "3"):
        assert run(*words, "--withdraw", number, "--reason", "x") == 0
    assert "none of its checks counts" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("value", "key"),
    [({"day": "soon", "reason": "x"}, "day"), ({"day": "2026-01-01", "reason": " "}, "reason")],
)
def test_a_withdrawal_without_day_or_reason_is_refused(value: dict[str, str], key: str, tmp_path: Path) -> None:
    """Of a record that was edited by hand."""
    path = tmp_path / "model.checks.json"
    five_days().record.save(path)
    content = json.loads(path.read_text())
    content["checks"][0]["withdrawn"] = value
    path.write_text(json.dumps(content))
    with pytest.raises(BadInputError, match=rf"model\.checks\.json: checks\[0\]\.withdrawn\.{key}"):
        load_record(path)


def test_a_table_that_no_change_explains_is_not_recorded(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nor is a day to come: one or the other would spoil every later check."""
    shutil.copy(folder / "model.json", tmp_path)
    model = str(tmp_path / "model.json")
    wrong = pl.read_csv(folder / "mon.csv").with_columns(pl.col("x", "y", "z") * 1e3)
    wrong.write_csv(tmp_path / "wrong.csv")
    assert run("interim", model, str(tmp_path / "wrong.csv"), "--day", "2026-01-05") == 3
    assert "belong to another robot or target" in capsys.readouterr().err
    assert run("interim", model, str(folder / "mon.csv"), "--day", "2999-01-05") == 3
    assert "is to come" in capsys.readouterr().err
    assert not (tmp_path / "model.checks.json").exists()
    assert run("interim", model, str(folder / "mon.csv"), "--day", "2026-01-05") == 0


def test_the_record_of_an_earlier_calibration_is_kept(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Beside the new one: a calibration into the same folder begins anew."""
    five_days().record.save(tmp_path / "model.checks.json")
    checked_arm(2).fitted.save(tmp_path / "model.json")
    assert run("interim", str(tmp_path / "model.json"), str(folder / "mon.csv"), "--day", "2026-01-05") in (0, 6)
    assert "of another calibration" in capsys.readouterr().err
    assert len(load_record(tmp_path / "model.checks.json").checks) == 1
    mark = five_days().record.model[:8]
    assert load_record(tmp_path / f"model.checks.{mark}.json") == five_days().record


def test_a_record_may_stand_elsewhere(folder: Path) -> None:
    """And is no other file of the command."""
    model = str(folder / "model.json")
    assert run("interim", model, str(folder / "mon.csv"), "--record", str(folder / "r.json"), "--quiet") == 0
    assert load_record(folder / "r.json").last is not None
    assert run("interim", model, str(folder / "mon.csv"), "--record", model) == 3


def test_the_record_keeps_who_took_a_check(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As stated on the command line, also where a later withdrawal judges the check again."""
    record = folder / "operators.json"
    words = ("interim", str(folder / "model.json"), "--record", str(record))
    smith = ("--set", "id.operator=A. Smith", "--set", "id.temperature=21.5")
    assert run(*words, str(folder / "mon.csv"), "--day", "2026-01-05") == 0
    assert run(*words, str(folder / "tue.csv"), "--day", "2026-01-06", *smith) in (0, 6)
    assert "on 2026-01-06 by A. Smith" in " ".join(capsys.readouterr().out.split())
    assert run(*words, "--withdraw", "1", "--reason", "x") in (0, 6)
    first, second = load_record(record).checks

    assert not first.rows.identity and "by" not in first.words
    assert (second.rows.identity.operator, second.rows.identity.temperature) == ("A. Smith", 21.5)
    assert second.words.startswith("2026-01-06 by A. Smith: ")


@pytest.mark.long
def test_runs_at_once_all_enter_the_record(folder: Path) -> None:
    """The later one is judged together with the check of the other, and does not replace it."""
    place = folder / "at_once.json"
    names = [f"at_once_{k}.csv" for k in range(3)]
    for name in names:
        write(arm().table(), folder / name)
    words = [sys.executable, "-m", "pincal", "interim", str(folder / "model.json"), "--quiet", "--record", str(place)]
    running = [subprocess.Popen([*words, str(folder / name)], stdout=subprocess.DEVNULL) for name in names]
    assert [one.wait(timeout=120) for one in running] == [0, 0, 0]
    assert sorted(check.rows.table for check in load_record(place).checks) == names


def test_the_study_draws_what_it_says() -> None:
    """A target 0.2 mm off is seen so by the instrument, and days in the same poses differ by their residuals."""
    days = [arm().table() for _ in range(3)]
    rows = [CheckedRows.of(table, day_of(k), arm().fitted.sigma) for k, table in enumerate(days)]
    series = CheckSeries(arm().fitted, tuple(rows)).rows
    for one, other in zip(series, checks_of("sound", arm(), days), strict=True):
        assert np.allclose(one.residuals, other.residuals, atol=1e-6)
        assert np.allclose(one.known @ one.known.T, other.known @ other.known.T, atol=1e-6)
    moved = arm().table(tool=TOOL + 2e-4 * X, times=0.0).position
    still = arm().table(times=0.0).position
    assert moved is not None and still is not None
    assert np.allclose(np.linalg.norm(moved - still, axis=1), 2e-4)
    tip = arm().machine.tip(arm().q)
    assert np.allclose(still, tip[:, :3, :3] @ TOOL + tip[:, :3, 3] + INSTRUMENT)
