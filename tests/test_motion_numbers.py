"""Numbers by which streams of a motion are left out, refused or doubted, on both sides of where they decide."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import pytest

from pincal.errors import MeasurementError
from pincal.measure.clock_jump import Jump
from pincal.motion.clocks import Alignment, Clock, SpeedMatch
from pincal.motion.joint_path import JointPath
from pincal.motion.stamps import in_order
from pincal.motion.starts import check_clock, steady
from pincal.motion.stream import Stream, checked_imu, checked_joints, interpolated
from pincal.sensors.imu import FORCE, RATE


def said(act: Callable[[], object]) -> str:
    """Return all warnings and the error of what is done, in words."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            act()
        except MeasurementError as error:
            return "; ".join([*(str(each.message) for each in caught), str(error)])
    return "; ".join(str(each.message) for each in caught)


def of_joints(q: np.ndarray, rate: float = 100.0) -> Stream:
    """Return the log of one joint."""
    return Stream("joints.csv", np.arange(len(q)) / rate, {"q": np.asarray(q, float)[:, None]}, {})


def of_stamps(time: np.ndarray, *, name: str = "q", units: dict[str, str] | None = None) -> Stream:
    """Return a log of something that moves smoothly from sample to sample, with some stamps."""
    values = np.sin(0.05 * np.arange(len(time)))[:, None] * np.ones(1 if name == "q" else 3)
    return Stream("log.csv", np.asarray(time, float), {name: values}, units or {})


def of_imu(force: np.ndarray, rate: np.ndarray) -> Stream:
    """Return the log of an IMU at 100 Hz."""
    return Stream("imu.csv", np.arange(len(force)) / 100.0, {FORCE.name: force, RATE.name: rate}, {})


def noise(seed: int, count: int = 1000) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((count, 3))


GRAVITY = np.array([0.0, 0.0, 9.80665])


def test_gaps_are_three_samples_or_a_fifth_of_a_second() -> None:
    """Whichever is longer."""
    assert [of_joints(np.zeros(50), rate).gap for rate in (5.0, 100.0)] == [pytest.approx(0.6), 0.2]


@pytest.mark.parametrize(("lost", "is_refused"), [(480, False), (520, True)])
def test_half_of_a_log_may_be_left_out(lost: int, is_refused: bool) -> None:
    """Not more."""
    stream = of_joints(np.sin(np.arange(1000) / 100.0))
    text = said(lambda: stream.without(np.arange(1000) < lost, "are wrong"))

    assert ("expected readings for most of the time" in text) == is_refused


@pytest.mark.parametrize(("step", "words"), [(0.048, ""), (0.052, "jumps by")])
def test_no_joint_moves_at_five_radians_a_second(step: float, words: str) -> None:
    """Where it moves at half a radian a second elsewhere, from sample to sample, a hundredth of a second apart."""
    q = 0.005 * np.arange(500)
    q[250:] += step - 0.005
    text = said(lambda: checked_joints(of_joints(q), ["joint_1"], np.array([True])))

    assert words in text and bool(words) == bool(text)


@pytest.mark.parametrize(("off", "is_turn"), [(0.28, True), (0.32, False)])
def test_a_jump_of_nearly_a_revolution_is_one(off: float, is_turn: bool) -> None:
    """To 0.3 rad."""
    q = 0.005 * np.arange(500)
    q[250:] += 2.0 * np.pi - off

    assert ("jumps by a revolution" in said(lambda: checked_joints(of_joints(q), ["joint_1"], np.array([True])))) == is_turn


@pytest.mark.parametrize(("twice", "is_told"), [(41, False), (45, True)])
def test_a_log_that_repeats_three_rows_of_ten_is_too_fast(twice: int, is_told: bool) -> None:
    """For the controller of the joints: of 41 positions that are logged twice and 59 that are once, 29 % are repeats."""
    count = np.tile(np.where(np.arange(100) < twice, 2, 1), 10)
    q = 0.005 * np.repeat(np.arange(1000), count)
    text = said(lambda: checked_joints(of_joints(q), ["joint_1"], np.array([True])))

    assert ("log joints at their own rate" in text) == is_told


@pytest.mark.parametrize(("factor", "is_read"), [(1.45, True), (0.7, True), (1.55, False), (0.64, False)])
def test_gravity_is_there_and_in_its_unit(factor: float, is_read: bool) -> None:
    """To half of it."""
    text = said(lambda: checked_imu(of_imu(factor * GRAVITY + 0.01 * noise(0), noise(1))))

    assert ("expected about 9.8" in text) != is_read


@pytest.mark.parametrize(
    ("repeats", "words"), [(40, "was it polled at nearly its own rate"), (60, "log the IMU at its own rate")]
)
def test_an_imu_that_repeats_a_row_of_twenty_is_logged_too_fast(repeats: int, words: str) -> None:
    """Fewer repeated rows are told as such."""
    force = GRAVITY + noise(0)
    rate = noise(1)
    rows = 1 + 16 * np.arange(repeats)
    force[rows] = force[rows - 1]
    rate[rows] = rate[rows - 1]

    assert words in said(lambda: checked_imu(of_imu(force, rate)))


@pytest.mark.parametrize(
    ("lasts", "times", "is_clipped"), [(3, 3, True), (3, 2, False), (2, 3, False), (20, 1, True), (19, 1, False)]
)
def test_an_axis_is_clipped_where_it_is_often_or_long_at_its_end(lasts: int, times: int, is_clipped: bool) -> None:
    """Three times for three samples, or once for twenty."""
    rate = np.clip(noise(1), -2.0, 2.0) * [1.0, 1.0, 0.5]
    rate += 1e-3 * noise(2)
    for k in range(times):
        rate[100 + 100 * k : 100 + 100 * k + lasts, 0] = 5.0
    text = said(lambda: checked_imu(of_imu(GRAVITY + noise(0), rate)))

    assert (f"{lasts * times} rows are clipped" in text) == is_clipped


@pytest.mark.parametrize(("share", "is_refused"), [(0.045, False), (0.055, True)])
def test_a_twentieth_of_the_rows_may_be_clipped(share: float, is_refused: bool) -> None:
    """More is a range that is too small."""
    rate = noise(1)
    top = np.quantile(rate[:, 0], 1.0 - share)
    rate[:, 0] = np.sort(np.minimum(rate[:, 0], top))
    rate[:, 0] += 1e-6 * (rate[:, 0] < top) * noise(2)[:, 0]
    rate[:, 0] = np.minimum(rate[:, 0], top)
    text = said(lambda: checked_imu(of_imu(GRAVITY + noise(0), rate)))

    assert ("choose a larger range of the IMU" in text) == is_refused


@pytest.mark.parametrize(("samples", "is_refused"), [(98, False), (106, True)])
def test_an_axis_is_broken_that_stands_still_for_a_second(samples: int, is_refused: bool) -> None:
    """While the others move."""
    rate = noise(1)
    rate[200 : 200 + samples, 1] = 0.1
    text = said(lambda: checked_imu(of_imu(GRAVITY + noise(0), rate)))

    assert ("column 'wy' is constant for" in text) == is_refused


@pytest.mark.parametrize(("moves", "is_refused"), [(0.45, False), (0.55, True)])
def test_an_axis_may_stand_still_with_the_others(moves: float, is_refused: bool) -> None:
    """Which move by less than half of their standard deviation."""
    rate = noise(1)
    rate[200:400, 1] = 0.1
    for _ in range(5):
        rate[200:400, [0, 2]] = np.linspace(0.0, moves, 200)[:, None] * rate[:, [0, 2]].std(axis=0)
    text = said(lambda: checked_imu(of_imu(GRAVITY + noise(0), rate)))

    assert ("column 'wy' is constant for" in text) == is_refused


@pytest.mark.parametrize(("steps", "is_told"), [(7, False), (9, True)])
def test_forces_that_stand_still_and_jump_were_not_updated(steps: int, is_told: bool) -> None:
    """By more than eight of their smallest steps."""
    signs = np.where(noise(0) > 0.0, 1.0, -1.0)
    signs[500:505] = 0.0
    signs[505] = steps
    force = GRAVITY + 0.01 * np.cumsum(signs, axis=0)
    text = said(lambda: checked_imu(of_imu(force, noise(1))))

    assert ("they were not updated" in text) == is_told


@pytest.mark.parametrize(("inside", "is_told"), [(7, False), (8, True)])
def test_eight_readings_on_a_straight_line_are_interpolated(inside: int, is_told: bool) -> None:
    """Fewer happen to be."""
    values = np.cumsum(noise(0, 500), axis=0)
    values[100 : 102 + inside] = np.linspace(values[100], values[101 + inside], inside + 2)

    assert interpolated(values).sum() == (inside if is_told else 0)


@pytest.mark.parametrize(("ratio", "is_told"), [(0.08, True), (0.13, False)])
def test_no_line_is_told_that_rounding_makes(ratio: float, is_told: bool) -> None:
    """A tenth of what readings are usually off one."""
    walk = np.cumsum(noise(0, 500), axis=0)
    off = np.median(np.abs(walk[1:-1] - 0.5 * (walk[:-2] + walk[2:])), axis=0)
    values = np.round(1.5e-3 / ratio * walk / off, 3)
    values[100:120] = np.round(np.linspace(values[100], values[119], 20), 3)

    assert interpolated(values).any() == is_told


@pytest.mark.parametrize(
    ("name", "rate", "is_read"), [("q", 9.1, True), ("q", 8.9, False), ("position", 2.1, True), ("position", 1.9, False)]
)
def test_a_motion_is_followed_by_fast_logs(name: str, rate: float, is_read: bool) -> None:
    """Joints by nine samples a second, instruments by two."""
    text = said(lambda: in_order(of_stamps(np.arange(200) / rate, name=name)))

    assert ("rows a second" in text) != is_read


@pytest.mark.parametrize(("step", "words"), [(0.55, r"looks like [ms]"), (0.45, "check its unit")])
def test_another_unit_of_time_is_told_by_a_usual_rate(step: float, words: str) -> None:
    """Of 2 kHz at most; 20 kHz is the highest there is."""
    assert words in said(lambda: in_order(of_stamps(step * np.arange(3000))))
    assert "rows a second" not in said(lambda: in_order(of_stamps(np.arange(300) / 1.9e4)))
    assert "rows a second" in said(lambda: in_order(of_stamps(np.arange(300) / 2.1e4)))


@pytest.mark.parametrize(("gap", "words"), [(3590.0, "1 gap of more than 0.2 s"), (3610.0, "time jumps from")])
def test_a_log_has_no_gap_of_an_hour(gap: float, words: str) -> None:
    """It is two."""
    time = np.arange(1000) / 100.0
    time[500:] += gap

    assert words in said(lambda: in_order(of_stamps(time)))


@pytest.mark.parametrize(("same", "words"), [(45, "rows with the previous stamp"), (55, "previous row: stamps are those")])
def test_a_twentieth_of_the_rows_may_have_the_stamp_of_the_row_before(same: int, words: str) -> None:
    """More are packets."""
    time = np.arange(1000) / 100.0
    rows = 1 + 18 * np.arange(same)
    time[rows] = time[rows - 1]

    assert words in said(lambda: in_order(of_stamps(time)))


@pytest.mark.parametrize(("late", "words"), [(190, "and sorted by time"), (210, "time runs backwards from")])
def test_a_row_is_late_by_two_seconds_at_most(late: int, words: str) -> None:
    """Or it is of another time."""
    order = np.arange(1000)
    order = np.insert(np.delete(order, 300), 300 + late, 300)
    stream = of_stamps(np.arange(1000) / 100.0).select(order)

    assert words in said(lambda: in_order(stream))


def in_bursts(*steps: float) -> str:
    """Return what is said of stamps whose steps recur, of samples that are evenly spaced."""
    time = np.concatenate([[0.0], np.cumsum(np.tile(steps, 1000 // len(steps)))])
    return said(lambda: in_order(of_stamps(0.01 * time / np.mean(steps))))


def test_rows_in_bursts_have_stamps_of_arrival() -> None:
    """If most follow at a third of the mean step, or a fifth of them at a quarter of it."""
    words = "rows are in bursts"

    assert words in in_bursts(0.32, 0.32, 0.32, 3.04) and words not in in_bursts(0.35, 0.35, 0.35, 2.95)
    assert words in in_bursts(0.2, 1.2, 1.2, 1.4) and words not in in_bursts(0.3, 1.2, 1.2, 1.3)
    assert words in in_bursts(*[0.1] * 22, *[1.254] * 78) and words not in in_bursts(*[0.1] * 18, *[1.198] * 82)


@pytest.mark.parametrize(("packets", "words"), [(48, "or lost digits; log"), (54, "samples are assumed to be")])
def test_fifty_packets_show_an_even_rate(packets: int, words: str) -> None:
    """Of five parts of a log, in each of which one of ten is hardly delayed."""
    count = np.arange(10 * packets)

    assert words in said(lambda: in_order(of_stamps(0.1 * (count // 10))))


def test_speeds_of_one_motion_are_alike() -> None:
    """A correlation of 0.6, and 0.03 more than at any other offset of the clocks."""
    assert [SpeedMatch(0.0, likeness, 0.0).is_same for likeness in (0.59, 0.61)] == [False, True]
    assert [SpeedMatch(0.0, 0.9, rival).is_clear for rival in (0.88, 0.86)] == [False, True]


def test_a_jump_of_a_clock_is_six_standard_deviations() -> None:
    """And more than the nominal arm explains, 50 ms; a drift is told from 200 ppm on."""
    assert [Jump(size, 1e-3, 0.0).is_sure(0.0) for size in (5.9e-3, 6.1e-3)] == [False, True]

    def told(clock: Clock, jump: Jump) -> str:
        found = Alignment(clock, np.eye(3), np.zeros(3), np.ones(3), jump)
        return said(lambda: check_clock(of_stamps(np.arange(100) / 100.0), found))

    exact = Clock(sigma=(0.0, 0.0))
    none = Jump(0.0, 1.0, 0.0)
    assert [bool(told(exact, Jump(size, 1e-4, 0.0))) for size in (0.049, 0.051)] == [False, True]
    assert [bool(told(exact.moved(0.0, drift), none)) for drift in (1.9e-4, 2.1e-4)] == [False, True]


@pytest.mark.parametrize(("off", "is_steady"), [(0.19, True), (0.21, False)])
def test_a_reading_off_its_neighbours_is_of_something_else(off: float, is_steady: bool) -> None:
    """By a fifth of the standard deviation of all."""
    values = np.sin(np.arange(1000) / 200.0)[:, None]
    values[500] += off * values.std()

    assert steady(values)[500] == is_steady


@pytest.mark.parametrize(("gap", "is_divided"), [(0.19, False), (0.21, True)])
def test_two_knots_are_bridged(gap: float, is_divided: bool) -> None:
    """And near an end, or for three knots, a path is not known; knots are a tenth of a second apart here."""
    time = np.arange(0.0, 10.0, 0.01)
    time = time[(time <= 5.0) | (time >= 5.0 + gap)]
    path = JointPath.through(time, np.sin(time)[:, None], knots_per_second=10.0)

    assert len(path.parts) == 1 + is_divided
    assert path.covers(np.array([0.29, 0.31])).tolist() == [False, True]


@pytest.mark.parametrize(("rate", "is_read"), [(22.0, True), (18.0, False)])
def test_a_knot_has_two_readings(rate: float, is_read: bool) -> None:
    """Of ten knots a second."""
    time = np.arange(0.0, 60.0, 1.0 / rate)
    text = said(lambda: JointPath.through(time, np.sin(time)[:, None], knots_per_second=10.0))

    assert ("has no" in text) != is_read
