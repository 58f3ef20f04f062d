"""A store of a fleet: files that many may write, SQL over them, and work on all of them that can be killed and goes on."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from fleet_cases import OPTIONS, Family, bit_flips, rows_of, siblings

import pincal
from pincal import BadInputError, Robot, measurements_from_arrays
from pincal.builtin import kuka_urdf_path
from pincal.fleet.checks import fleet_changes
from pincal.fleet.jobs import (
    CalibrateTables,
    DiagnoseTables,
    DiscoverTables,
    Done,
    add_model,
    run_job,
    visits_of,
    without_information,
)
from pincal.fleet.machines import Machine, parquet_bytes
from pincal.fleet.robot_type import learn_type
from pincal.fleet.store import Key, Store, open_store

DAY = "2026-11-03"


@pytest.fixture(scope="module")
def robot() -> Robot:
    """Return the KUKA up to its flange."""
    return Robot.from_urdf(kuka_urdf_path(), tip="tool0")


@pytest.fixture
def store(robot: Robot, tmp_path: Path) -> Store:
    """Return a store with six tables of three machines."""
    found = open_store(tmp_path / "fleet", create=True)
    for k, machine in enumerate(siblings(3)):
        for day in (DAY, "2026-11-10"):
            found.add_table(f"R/{k}", day, rows_of(robot, machine, 30, k + 10 * len(day)), labels={"hall": "north"})
    return found


def content_of(folder: Path) -> Mapping[str, bytes]:
    """Return all files of a folder."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_rows_come_back_as_they_were(robot: Robot, tmp_path: Path) -> None:
    """All columns, to the last bit, and odd names of machines."""
    store = open_store(tmp_path, create=True)
    table = replace(rows_of(robot, siblings(1)[0], 12, 0), readings_per_row=np.full(12, 3))
    key = store.add_table("a b/c=d", DAY, table, role="check")
    again = store.table(key)

    assert set(again.columns()) == set(table.columns()) and again.joint_names == table.joint_names
    for name, array in table.columns().items():
        np.testing.assert_array_equal(again.columns()[name], array)
    assert store.keys("tables") == [key] and key.machine == "a b/c=d"
    assert (tmp_path / key.path).is_file() and len(Path(key.path).parts) == 4


def test_what_is_added_twice_is_there_once(robot: Robot, store: Store) -> None:
    """By many writers at once, too, and nothing is written over."""
    before, table = content_of(Path(store.place)), rows_of(robot, siblings(1)[0], 30, 7)
    with ThreadPoolExecutor(4) as pool:
        keys = set(pool.map(lambda _: store.add_table("R7", DAY, table), range(12)))
    after = content_of(Path(store.place))

    assert len(keys) == 1 and len(after) == len(before) + 1
    assert all(after[name] == content for name, content in before.items())


def test_sql_sees_all_files(store: Store) -> None:
    """A view for each kind."""
    pytest.importorskip("duckdb", reason="DuckDB is not installed")
    found = store.query(
        "select machine, count(distinct day) as days, max(temperature) as t from tables group by 1 order by 1"
    )

    assert found.rows() == [(f"R/{k}", 2, 21.0) for k in range(3)]
    with pytest.raises(BadInputError, match="nothing"):
        store.query("select * from nothing")


def test_a_store_may_be_anywhere_that_fsspec_reaches(robot: Robot) -> None:
    """An object store in memory holds the same, and is calibrated the same."""
    pytest.importorskip("fsspec", reason="fsspec is not installed")
    store = open_store("memory://fleet", create=True)
    for k, machine in enumerate(siblings(2)):
        store.add_table(f"R{k}", DAY, rows_of(robot, machine, 30, k))
    done = run_job(store, CalibrateTables(robot, OPTIONS))

    assert (done.done, done.failed) == (2, {})
    assert [machine.name for _, machine, _ in open_store("memory://fleet").machines()] == ["R0", "R1"]


def test_a_job_does_what_is_left(robot: Robot, store: Store, tmp_path: Path) -> None:
    """A table that can't be calibrated is noted with the reason; nothing is done twice; other options are another job."""
    store.add_table("odd", DAY, measurements_from_arrays(["one"], np.ones((12, 1)), distance=np.ones(12)))
    job = CalibrateTables(robot, OPTIONS)
    first = run_job(store, job)
    content = content_of(Path(store.place))
    again = run_job(store, job)

    assert (first.done, first.before, len(first.failed)) == (7, 0, 1)
    assert (again.done, again.before, again.failed, again.failed_before) == (0, 6, {}, 1)
    assert content_of(Path(store.place)) == content
    (reason,) = first.failed.values()
    assert "joints" in reason
    found = [machine for _, machine, _ in store.machines()]
    assert [machine.name for machine in found] == ["R/0", "R/0", "R/1", "R/1", "R/2", "R/2"]
    assert learn_type(found).type.machines == 3
    assert run_job(store, CalibrateTables(robot, replace(OPTIONS, sigma=1e-4))).done == 7
    heavier = replace(robot, masses=robot.masses + 1.0)
    assert len({CalibrateTables(of, OPTIONS).name for of in (robot, replace(robot), heavier)}) == 2
    with pytest.raises(BadInputError, match="choose a job"):
        list(store.machines())
    assert len(list(store.machines(job=job.name))) == 6


@pytest.mark.long
def test_from_tables_to_changes(robot: Robot, tmp_path: Path) -> None:
    """Calibrated, learned and checked from the store alone: the one robot with a joint off is found."""
    store, machines = open_store(tmp_path, create=True), siblings(6)
    for k, machine in enumerate(machines):
        store.add_table(f"R{k}", "2026-01-05", rows_of(robot, machine, 40, k), labels={"hall": "ab"[k % 2]})
    run_job(store, CalibrateTables(robot, OPTIONS, role="calibration"))
    of = learn_type(machine for _, machine, _ in store.machines()).type
    offsets = np.zeros(6)
    offsets[2] = 4e-4
    machines[3] = replace(machines[3], joint_offsets=machines[3].joint_offsets + offsets)
    for week in (1, 2):
        for k, machine in enumerate(machines):
            day = str(np.datetime64("2026-01-05") + 7 * week)
            store.add_table(f"R{k}", day, rows_of(robot, machine, 12, 100 * week + k), role="check")
    done = run_job(store, CalibrateTables(robot, OPTIONS, of, role="check"))
    found = fleet_changes(of, visits_of(store))

    assert done.done == 12 and not done.failed
    assert [change.subject for change in found.changes] == ["R3"]
    (change,) = found.changes
    assert change.since == "2026-01-12"
    assert {"joint_3.theta", "joint_3"} & {change.what, *change.equals}


@pytest.mark.long
def test_models_and_diagnoses(robot: Robot, tmp_path: Path) -> None:
    """A check is diagnosed by the last model before it, and its p-value counts where there is no information."""
    store, machine = open_store(tmp_path / "fleet", create=True), siblings(1)[0]
    fit = pincal.calibrate(robot, rows_of(robot, machine, 60, 1), OPTIONS)
    fit.save(tmp_path / "model.json")
    add_model(store, "R1", "2026-01-05", tmp_path / "model.json")
    store.add_table("R1", "2026-02-02", rows_of(robot, machine, 12, 2), role="check")
    moved = replace(machine, joint_offsets=np.array([0.0, 0.0, 1e-3, 0.0, 0.0, 0.0]))
    store.add_table("R1", "2026-03-02", rows_of(robot, moved, 12, 3), role="check")
    store.add_table("R2", "2026-03-02", rows_of(robot, machine, 12, 4), role="check")
    done = run_job(store, DiagnoseTables(sigma=5e-5))
    visits = {visit.day: visit for visit in visits_of(store)}

    assert done.done == 3 and len(done.failed) == 1 and "no model" in next(iter(done.failed.values()))
    assert visits["2026-02-02"].p_value > 0.01 and visits["2026-03-02"].p_value < 1e-6
    assert visits["2026-03-02"].machine == "R1"


def test_a_job_that_failed_stands_in_no_other_job_s_way(robot: Robot, store: Store) -> None:
    """Tables that could not be calibrated, as with the wrong robot, are left to do; those that could are not."""
    wrong = Robot.from_urdf("ur10")
    tables = store.keys("tables")
    assert len(run_job(store, CalibrateTables(wrong, OPTIONS), tables=tables[:2]).failed) == 2
    assert without_information(store) == tables
    # Each of these rows stands there on two days.
    done = run_job(store, CalibrateTables(robot, OPTIONS), tables=tables[1:3])

    assert done == Done(2, 0, {})
    assert without_information(store) == tables[4:]


def test_a_model_that_comes_late_is_diagnosed_by(robot: Robot, tmp_path: Path) -> None:
    """A check that had no model has its turn again, and counts once however often it was diagnosed."""
    store, machine = open_store(tmp_path / "fleet", create=True), siblings(1)[0]
    key = store.add_table("R1", "2026-02-02", rows_of(robot, machine, 12, 2), role="check")
    assert "add its model.json" in run_job(store, DiagnoseTables(sigma=5e-5)).failed[key.path]
    pincal.calibrate(robot, rows_of(robot, machine, 30, 1), OPTIONS).save(tmp_path / "model.json")
    add_model(store, "R1", "2026-01-05", tmp_path / "model.json")
    done = [run_job(store, DiagnoseTables(sigma=sigma)) for sigma in (5e-5, 5e-5, 1e-4)]
    chances = [frame["p_value"].max() for _, frame in store.frames("diagnoses")]

    assert [(one.done, one.before) for one in done] == [(1, 0), (0, 1), (1, 0)]
    assert [visit.p_value for visit in visits_of(store)] == [None, *chances]


def test_a_calibration_does_not_hide_the_check_of_its_day(robot: Robot, tmp_path: Path) -> None:
    """As table and as diagnosis: the day is today where none is given. Its own table is calibrated already."""
    store, machine = open_store(tmp_path, create=True), siblings(1)[0]
    rows = rows_of(robot, machine, 30, 1)
    store.add_information(DAY, Machine.of(pincal.calibrate(robot, rows, OPTIONS).fit, "R1"))
    store.add_table("R1", DAY, rows)
    check = store.add_table("R1", DAY, rows_of(robot, machine, 12, 2), role="check")
    facts = {"changed": True, "p_value": 1e-9, "role": "check", "job": "", "table": "", "failure": ""}
    store.add_text("diagnoses", "R1", DAY, "{}", **facts)

    assert without_information(store) == [check]
    assert [visit.is_calibration for visit in visits_of(store)] == [True, False]


def test_what_stands_in_a_store_by_mistake_is_named(tmp_path: Path) -> None:
    """A damaged file, one of other columns, the copy of a folder, a day that is none; what is no Parquet file is left."""
    family, rng = Family.drawn(np.random.default_rng(1), parameters=12), np.random.default_rng(2)
    store = open_store(tmp_path, create=True)
    keys = [store.add_information(DAY, family.measured(x, rng, name=f"m{k}")) for k, x in enumerate(family.draw(3, rng))]
    folder, content = (tmp_path / keys[1].path).parent, (tmp_path / keys[1].path).read_bytes()
    (folder / "notes.txt").write_text("seen")
    assert len(list(store.machines())) == 3
    other = parquet_bytes(pl.DataFrame({"a": [1]}))
    for place, put, words in (
        ("junk.parquet", b"junk", "junk.parquet: damaged"),
        ("cut.parquet", content[:-50], "cut.parquet: damaged"),
        ("foreign.parquet", other, "foreign.parquet: columns a; expected"),
        ("../../machine=m1 (copy)/day=2026-11-03/x.parquet", content, "move it elsewhere"),
        ("../day=soon/x.parquet", content, "day 'soon'"),
    ):
        path = folder / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(put)
        with pytest.raises(BadInputError, match=re.escape(words)):
            list(store.machines())
        path.unlink()


@pytest.fixture
def kinds(robot: Robot, tmp_path: Path) -> tuple[Store, list[Key]]:
    """Return a store with a table, information and a text as a model has it, each of machine R1."""
    family, rng = Family.drawn(np.random.default_rng(1), parameters=12), np.random.default_rng(2)
    store = open_store(tmp_path / "kinds", create=True)
    machine = family.measured(family.draw(1, rng)[0], rng, name="R1")
    keys = [
        store.add_table("R1", DAY, rows_of(robot, siblings(1)[0], 12, 0)),
        store.add_information(DAY, machine),
        store.add_model("R1", DAY, "{}" + 200 * " "),
    ]
    return store, keys


def test_a_file_with_a_bit_changed_is_refused(kinds: tuple[Store, list[Key]]) -> None:
    """Whatever the bit, and of each kind; by SQL, too, whose engine reads the files itself."""
    store, keys = kinds
    for key in keys:
        assert bit_flips(store, key, 60) == {"refused": 60}, key.kind
    path = Path(store.place) / keys[0].path
    path.write_bytes(path.read_bytes()[:-1] + b"2")
    with pytest.raises(BadInputError, match=r"damaged \(its content has another checksum than its name\)"):
        store.query("select * from tables")


def test_rows_are_of_the_machine_and_day_of_their_path(kinds: tuple[Store, list[Key]]) -> None:
    """A folder under another name, another day, and the file of another machine in place of one's own."""
    store, keys = kinds
    for key in keys:
        path = Path(store.place) / key.path
        for other in (replace(key, machine="R9"), replace(key, day="2026-10-01"), replace(key, id="0" * 20)):
            there = Path(store.place) / other.path
            there.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, there)
            with pytest.raises(BadInputError, match=rf"the content is of {key.path}; .*move it there"):
                store.frame(other)
            with pytest.raises(BadInputError, match=r"move it there"):
                list(store.frames("models") if key.kind == "models" else store.machines()) if key.kind != "tables" else (
                    store.table(other)
                )
            there.unlink()
    another = store.add_model("R2", DAY, "{ }")
    shutil.copy(Path(store.place) / keys[2].path, Path(store.place) / another.path)
    with pytest.raises(BadInputError, match="another checksum"):
        store.last_model("R2")


@pytest.mark.long
def test_files_of_before_checksums_are_held_to_their_rows(kinds: tuple[Store, list[Key]]) -> None:
    """Their ID is a checksum of these. Changed ones are refused, whatever the decoder makes of them."""
    store, keys = kinds
    for key in keys[:2]:
        path, earlier = Path(store.place) / key.path, replace(key, checksum="")
        assert store.keys(key.kind) == [key] and store.keys(key.kind)[0].checksum
        path.rename(Path(store.place) / earlier.path)
        store.frame(earlier)
        counted = bit_flips(store, earlier, 150)
        assert counted["other"] == 0 and counted["refused"] > 50 and counted.total() == 150
    assert len(list(store.machines())) == 1
    earlier = replace(keys[0], checksum="")
    frame = store.frame(earlier)
    for bad, words in (
        (frame.head(0), "no rows"),
        (frame.drop("role"), "no role"),
        (frame.with_columns(labels=pl.lit(None, frame["labels"].dtype)), "no labels"),
        (frame.with_columns(machine=pl.lit("R2")), "the content is of"),
        (frame.with_columns(role=pl.lit("check")), "damaged"),
    ):
        (Path(store.place) / earlier.path).write_bytes(parquet_bytes(bad))
        with pytest.raises(BadInputError, match=words):
            store.frame(earlier)


def test_the_last_model_of_a_day_is_the_one_added_last(tmp_path: Path) -> None:
    """Whatever their checksums; one that is added again stays where it was, and an earlier day stays earlier."""
    store = open_store(tmp_path, create=True)
    for k in range(12):
        store.add_model("R1", DAY, f"model {k}")
        assert store.last_model("R1") == f"model {k}"
    store.add_model("R1", DAY, "model 0")
    store.add_model("R1", "2026-01-01", "of before")
    store.add_model("R2", DAY, "of another")

    assert len(store.keys("models")) == 14
    assert store.last_model("R1") == "model 11" and store.last_model("R1", "2026-10-31") == "of before"
    assert store.last_model("R3") is None and store.last_model() == "of another"


@pytest.mark.long
def test_discoveries(robot: Robot, store: Store) -> None:
    """What is missing, of each table."""
    done = run_job(store, DiscoverTables(robot, OPTIONS))
    (keys, frame), *_ = store.frames("discoveries")

    assert done.done == len(keys) == 6 and not done.failed
    assert set(frame["verdict"]) <= {"adequate", "not adequate", "undecided"}


KILLED = """
import sys
from pathlib import Path
from pincal import Options, GEOMETRIC, Robot
from pincal.builtin import kuka_urdf_path
from pincal.fleet.jobs import CalibrateTables, run_job
from pincal.fleet.store import open_store
from pincal.spread import own_processes
if __name__ == "__main__":
    robot = Robot.from_urdf(kuka_urdf_path(), tip="tool0")
    with own_processes() as executor:
        run_job(open_store(sys.argv[1]), CalibrateTables(robot, Options(effects=GEOMETRIC, sigma=5e-5)), executor=executor)
"""


@pytest.mark.long
def test_a_killed_job_goes_on_to_the_same_bytes(robot: Robot, tmp_path: Path) -> None:
    """Killed with all its workers, and restarted: the same files as by a run that was left alone."""
    for name in ("killed", "alone"):
        store = open_store(tmp_path / name, create=True)
        for k, machine in enumerate(siblings(4)):
            for day in range(10, 16):
                store.add_table(f"R{k}", f"2026-01-{day}", rows_of(robot, machine, 30, 100 * day + k))
    script = tmp_path / "job.py"
    script.write_text(KILLED)
    running = subprocess.Popen([sys.executable, script, tmp_path / "killed"], start_new_session=True)
    begun = time.monotonic()
    while len(list((tmp_path / "killed" / "information").rglob("[!.]*.parquet"))) < 5 and time.monotonic() < begun + 120.0:
        time.sleep(0.02)
    os.killpg(running.pid, signal.SIGKILL)
    running.wait()
    there = len(list((tmp_path / "killed" / "information").rglob("[!.]*.parquet")))
    job = CalibrateTables(robot, OPTIONS)
    after = run_job(open_store(tmp_path / "killed"), job)
    alone = run_job(open_store(tmp_path / "alone"), job)

    assert 5 <= there < 24 and after.before == there and after.done == 24 - there and alone.done == 24
    whole = content_of(tmp_path / "alone")
    # Drafts that the kill left are swept by the next to write there, or never seen.
    found = {
        name: content for name, content in content_of(tmp_path / "killed").items() if not Path(name).name.startswith(".")
    }
    assert found == whole


def test_what_is_no_store_is_refused(robot: Robot, tmp_path: Path) -> None:
    """No store, a newer one, odd names, days and roles, and damaged files."""
    with pytest.raises(BadInputError, match="no store"):
        open_store(tmp_path / "none")
    store, table = open_store(tmp_path / "one", create=True), rows_of(robot, siblings(1)[0], 12, 0)
    for machine, day, role, words in (
        ("", DAY, "check", "machine"),
        (80 * "\N{CJK UNIFIED IDEOGRAPH-540D}", DAY, "check", "short name"),
        ("R1", "soon", "check", "day"),
        ("R1", "NaT", "check", "day"),
        ("R1", "today", "check", "day"),
        ("R1", DAY, "other", "role"),
    ):
        with pytest.raises(BadInputError, match=words):
            store.add_table(machine, day, table, role=role)
    key = store.add_table("R1", DAY, table)
    (tmp_path / "one" / key.path).write_bytes(b"PAR1")
    with pytest.raises(BadInputError, match="damaged"):
        store.table(key)
    with pytest.raises(BadInputError, match="bytes that are no text"):
        store.add_table("R\udcff", DAY, table)
    for text, words in (
        ('{"format": "pincal-store", "format_version": 2}', "newer"),
        ('{"format": "pincal-store", "format_version": true}', "not mark"),
        ('{"format": "pincal-store", "format_version": -5}', "not mark"),
        ("{", "not mark"),
        ("[]", "not mark"),
        (100_000 * "[", "not mark"),
    ):
        (tmp_path / "one" / "store.json").write_text(text)
        with pytest.raises(BadInputError, match=words):
            open_store(tmp_path / "one")


def test_information_may_be_added_without_rows(tmp_path: Path) -> None:
    """What a site without poses sends is a part of the fleet, too."""
    family = Family.drawn(np.random.default_rng(1), parameters=12)
    rng, store = np.random.default_rng(2), open_store(tmp_path, create=True)
    for k, x in enumerate(family.draw(5, rng)):
        store.add_information(DAY, family.measured(x, rng, name=f"m{k}"))
    found = [machine for _, machine, _ in store.machines()]

    assert [machine.name for machine in found] == [f"m{k}" for k in range(5)]
    np.testing.assert_array_equal(found[0].information.form.H, found[0].information.form.H.T)
    assert learn_type(found).type.machines == 5
