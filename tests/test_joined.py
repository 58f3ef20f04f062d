"""An instrument's table and a log of the joints become one table, or the next step is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.joined import held_poses, held_rows, is_log
from pincal.measure.measurements import Measurements
from pincal.measure.table import joint_columns, read_measurements, write_table
from pincal.measure.table_schema import TableOptions
from pincal.robot.tree import Mimic

JOINTS = ("a", "b", "c")
K = 8
RNG = np.random.default_rng(11)
Q = np.cumsum(RNG.uniform(0.2, 0.6, (K, 3)), axis=0)
XYZ = RNG.uniform(-1.0, 1.0, (K, 3))
# A recording at 50 Hz: each pose is held for two seconds, the next one reached in one.
TIME = 1e4 + np.arange(0.0, 3.0 * K, 0.02)
PHASE = (TIME - TIME[0]) / 3.0
STEP = np.minimum(PHASE.astype(int), K - 1)
SHARE = np.clip(3.0 * (PHASE - STEP) - 2.0, 0.0, 1.0)[:, None]
MOVING = Q[STEP] + SHARE * (Q[np.minimum(STEP + 1, K - 1)] - Q[STEP]) + RNG.normal(0.0, 2e-5, (len(TIME), 3))
HELD = TIME[0] + 3.0 * np.arange(K) + 1.0


def readings(**more: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip("xyz", XYZ.T, strict=True)) | more


def joints(q: np.ndarray, **more: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(JOINTS, q.T, strict=True)) | more


def joined(folder: Path, table: dict[str, np.ndarray], log: dict[str, np.ndarray], **said: object) -> Measurements:
    """Read a table with its log."""
    write_table(folder / "tracker.csv", table)
    write_table(folder / "log.csv", log)
    return read_measurements(folder / "tracker.csv", JOINTS, joints=folder / "log.csv", **said)  # type: ignore[arg-type]


def refused(folder: Path, table: dict[str, np.ndarray], log: dict[str, np.ndarray]) -> str:
    with pytest.raises(MeasurementError) as caught:
        joined(folder, table, log)
    return str(caught.value)


def test_rows_are_joined_by_a_common_column(tmp_path: Path) -> None:
    """A name that both files have finds the joints, whatever the order, and the log's other columns come along."""
    order = RNG.permutation(K)
    log = joints(Q[order], pose=order + 1, payload=np.full(K, 5.0), speed=np.ones(K))
    with pytest.warns(PincalWarning, match=r'tracker.csv: 8 rows have joints from log.csv by the column "pose"'):
        found = joined(tmp_path, readings(pose=np.arange(1.0, K + 1)), log)

    np.testing.assert_allclose(found.q, Q, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.position, XYZ)
    assert found.payload is not None and found.payload.tolist() == [5.0] * K


def test_several_rows_may_share_a_pose(tmp_path: Path) -> None:
    """Two targets that are measured in each pose take their joints from one sample."""
    twice = {name: np.repeat(value, 2) for name, value in readings(pose=np.arange(K)).items()}
    with pytest.warns(PincalWarning, match="by the column"):
        found = joined(tmp_path, twice | {"target": np.tile(["p", "q"], K)}, joints(Q, pose=np.arange(K)))

    np.testing.assert_allclose(found.q, np.repeat(Q, 2, axis=0), rtol=0, atol=1e-12)


def test_rows_are_joined_by_time_while_the_pose_is_held(tmp_path: Path) -> None:
    """A reading has the mean of the joints over the pose at its time; one during a motion is left out and told."""
    times = HELD.copy()
    times[3] += 1.5
    with pytest.warns(
        PincalWarning, match=r"7 rows .* by time, while the pose is held still; 1 row is left out, between two poses"
    ):
        found = joined(tmp_path, readings(time=times), joints(MOVING, time=TIME))

    kept = np.delete(np.arange(K), 3)
    np.testing.assert_allclose(found.q, Q[kept], rtol=0, atol=2e-5)
    np.testing.assert_array_equal(found.position, XYZ[kept])
    assert found.rows.tolist() == (kept + 2).tolist()


def test_rows_are_joined_by_order_where_counts_agree(tmp_path: Path) -> None:
    """As many rows as samples, or as poses held in a recording, belong together in their order."""
    with pytest.warns(PincalWarning, match="by order, row by row"):
        found = joined(tmp_path, readings(), joints(Q))
    np.testing.assert_allclose(found.q, Q, rtol=0, atol=1e-12)

    with pytest.warns(PincalWarning, match="by order, pose by pose"):
        found = joined(tmp_path, readings(), joints(MOVING, time=TIME))
    np.testing.assert_allclose(found.q, Q, rtol=0, atol=2e-5)


def test_order_tells_nothing_of_a_log_that_several_tables_share(tmp_path: Path) -> None:
    """Two tables of equal length are not both given the joints of the same rows; by a common column they may be."""
    write_table(tmp_path / "tracker.csv", readings())
    with pytest.raises(MeasurementError, match="several tables share it"):
        joined(tmp_path, readings(), joints(Q), shares_log=True)
    with pytest.warns(PincalWarning, match="by the column"):
        joined(tmp_path, readings(pose=np.arange(K)), joints(Q, pose=np.arange(K)), shares_log=True)


def test_names_and_units_of_the_log_are_understood(tmp_path: Path) -> None:
    """The log may number its joints in degrees, and the user may name columns of either file."""
    log = {f"J{i + 1} (deg)": np.degrees(Q[:, i]) for i in range(3)}
    table = {"east": XYZ[:, 0], "y": XYZ[:, 1], "z": XYZ[:, 2]}
    with pytest.warns(PincalWarning):
        found = joined(tmp_path, table, log, columns={"east": "x"})
    np.testing.assert_allclose(found.q, Q, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.position, XYZ)


def test_a_lost_row_does_not_shift_the_others(tmp_path: Path) -> None:
    """A table that lacks a row is not joined by order, and a name without joints is refused with its line."""
    fewer = {name: value[1:] for name, value in readings(pose=np.arange(K)).items()}
    with pytest.warns(PincalWarning, match="by the column"):
        found = joined(tmp_path, fewer, joints(Q, pose=np.arange(K)))
    np.testing.assert_allclose(found.q, Q[1:], rtol=0, atol=1e-12)

    text = refused(tmp_path, readings(pose=np.arange(K) + 1), joints(Q, pose=np.arange(K)))
    assert 'tracker.csv, line 9, column "pose": 8.0 is not in log.csv' in text and "ignore the column" in text


@pytest.mark.parametrize(
    ("table", "log", "parts"),
    [
        (readings(), joints(Q[1:]), ["it is not known which joints", "8 rows and 7 samples", "column time"]),
        (readings(time=HELD + 900.0), joints(MOVING[100:], time=TIME[100:]), ["do the clocks differ?", "poses held still"]),
        (readings(time=HELD), joints(MOVING[::-1], time=TIME[::-1]),
         ["time does not increase"]),
        (readings(id=np.arange(K), pose=np.arange(K)), joints(Q, id=np.arange(K), pose=np.arange(K)[::-1]),
         ['"id" and "pose"', "different joints"]),
        (readings(row=np.arange(K), time=HELD), joints(MOVING, time=TIME, row=np.arange(len(TIME))),
         ['by the column "row" contradict its time', "only counts rows"]),
        (readings(row=60 + np.arange(K) * 20), joints(MOVING, time=TIME, row=np.arange(len(TIME))),
         ["does not hold still", "only counts rows"]),
        (readings(), {"x1": Q[:, 0]}, ["log.csv: no column for joint"]),
        (readings() | joints(Q), joints(Q), ['joint "a" is in log.csv as well', "omit --joints"]),
    ],
)  # fmt: skip
def test_what_is_ambiguous_is_refused(
    tmp_path: Path, table: dict[str, np.ndarray], log: dict[str, np.ndarray], parts: list[str]
) -> None:
    """Counts, clocks, names or counters that don't agree end with the next step."""
    text = refused(tmp_path, table, log)
    for part in parts:
        assert part in text


def test_a_counter_that_is_ignored_gives_way_to_time(tmp_path: Path) -> None:
    """What the error says to do helps."""
    with pytest.warns(PincalWarning, match="by time"):
        found = joined(
            tmp_path,
            readings(row=np.arange(K), time=HELD),
            joints(MOVING, time=TIME, row=np.arange(len(TIME))),
            ignore=("row",),
        )
    np.testing.assert_allclose(found.q, Q, rtol=0, atol=2e-5)


def test_a_column_of_the_log_that_is_ignored_is_not_read(tmp_path: Path) -> None:
    """Words in a column that has a meaning stop nobody who leaves it out."""
    table = readings(pose=np.arange(K))
    log = joints(Q, pose=np.arange(K), payload=np.full(K, "unknown"))
    assert 'log.csv, line 2, column "payload": "unknown"; expected a finite number' in refused(tmp_path, table, log)
    with pytest.warns(PincalWarning, match="by the column"):
        found = joined(tmp_path, table, log, ignore=["payload"])
    assert found.payload is None
    np.testing.assert_allclose(found.q, Q, rtol=0, atol=1e-12)


def test_the_file_that_is_missing_is_named(tmp_path: Path) -> None:
    """Of a table and its log."""
    write_table(tmp_path / "there.csv", joints(Q))
    for table, log, missing in (("none", "there", "none"), ("there", "lost", "lost")):
        with pytest.raises(MeasurementError, match=rf"{missing}\.csv: no such file"):
            joint_columns(tmp_path / f"{table}.csv", JOINTS, TableOptions(joints=tmp_path / f"{log}.csv"))


def test_only_poses_that_are_held_count() -> None:
    """Creeping, a stop that is too short, and single samples give no pose; a jump between two holds gives two."""
    time = np.arange(0.0, 10.0, 0.02)
    assert len(held_poses(time, 0.01 * time[:, None])) == 0
    assert len(held_poses(time, 5e-4 * time[:, None])) == 0
    stop = np.interp(time, [0.0, 4.9, 5.1, 10.0], [0.0, 1.0, 1.0, 2.0])[:, None]
    assert len(held_poses(time, stop)) == 0
    jump = np.where(time < 5.0, 0.0, 1.0)[:, None]
    found = held_poses(time, jump)
    assert len(found) == 2 and found.at(time, np.array([4.9, 5.1])).tolist() == [0, 1]
    assert len(held_poses(time[::200], stop[::200])) == 0


def test_a_table_is_a_log_by_its_rows_and_their_times() -> None:
    """A hundred rows and more, ten a second and more: no one measures as many poses as fast."""
    assert is_log(0.09 * np.arange(100))
    assert not is_log(0.09 * np.arange(99))
    assert not is_log(0.11 * np.arange(1000))


def of_logged(count: int, held: int, moving: int, *, was_joined: bool = False) -> int:
    """Return how many rows remain of a log in steps of 0.09 s, with poses that are held for some rows and left for some."""
    q = np.concatenate([[k] * held + [k + (i + 1.0) / (moving + 1.0) for i in range(moving)] for k in range(count)])
    values = {"time": 0.09 * np.arange(len(q)), "a": q}
    return len(held_rows(values, np.arange(len(q)), ["a"], was_joined=was_joined, source="log.csv")[1])


def test_a_log_is_cut_where_the_arm_moves() -> None:
    """A table in which the arm hardly moves is none, unless it was joined with a log and has many rows of each pose."""
    with pytest.warns(PincalWarning, match="cut into the 10 poses"):
        assert of_logged(10, held=16, moving=1) == 10
    assert of_logged(10, held=24, moving=1) == 250
    with pytest.warns(PincalWarning, match="cut into the 10 poses"):
        assert of_logged(10, held=10, moving=0, was_joined=True) == 10
    assert of_logged(20, held=9, moving=0, was_joined=True) == 180


def test_a_joint_that_follows_another_needs_no_column(tmp_path: Path) -> None:
    """A joint that mimics another one is missing in the log, and not counted where joints are numbered."""
    mimics = (Mimic("b", "a", -2.0, 0.1),)
    log = {"J1": Q[:, 0], "J2": Q[:, 2]}
    with pytest.warns(PincalWarning, match=r"J1=a, J2=c"):
        found = joined(tmp_path, readings(), log, mimics=mimics)

    np.testing.assert_allclose(found.q, np.column_stack([Q[:, 0], 0.1 - 2.0 * Q[:, 0], Q[:, 2]]), rtol=0, atol=1e-12)
