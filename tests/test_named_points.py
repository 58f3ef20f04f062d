"""Sockets, anchors and calibration objects: what can be found with them, what not, and what is refused."""

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run
from scipy.spatial.transform import Rotation

from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.calibration import run_calibration
from pincal.calibration.fitted_robot import FittedRobot, load_model
from pincal.design.health import calibrated_sockets
from pincal.errors import BadInputError, MeasurementError, PincalWarning
from pincal.identify.calibrate import fit_tables
from pincal.identify.fit import ModelFit
from pincal.identify.options import Options
from pincal.identify.split import cross_validate
from pincal.io.camera_file import read_camera
from pincal.measure.admit import scorable_rows, unobservable_notes, usable_rows
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.measure.points_table import read_distances, read_points
from pincal.measure.table import read_measurements
from pincal.model.effects import ELASTIC, GEOMETRIC
from pincal.robot.robot import Robot
from pincal.sensors.lens import Lens
from pincal.sensors.row_samples import sample_rows
from pincal.sensors.setup import KnownDistance, NamedPoints, Setup
from pincal.validate.given_lengths import Contradiction, contradicted_lengths

SOCKETS = {"a": (1.6, 0.3, 0.8), "b": (1.6, -0.4, 0.8), "c": (1.2, 0.9, 1.2), "d": (1.3, 0.0, 1.6)}
ANCHORS = {"n": (3.0, 2.0, 0.3), "e": (2.5, -3.0, 1.0), "w": (-2.0, 2.5, 2.0), "s": (0.5, 0.4, 3.5)}
TOOL = (0.05, 0.03, 0.12)
LENS = Lens(2000.0, 2010.0, 1024.0, 768.0, -0.1, 0.05, 1e-3, -5e-4)
MOUNT = np.eye(4)
MOUNT[:3, :3], MOUNT[:3, 3] = Rotation.from_euler("xyz", [0.3, -0.4, 2.0]).as_matrix(), (0.05, 0.1, 0.15)
PLACE = np.eye(4)
PLACE[:3, :3], PLACE[:3, 3] = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix(), (1.5, 0.3, 0.5)
GRID = {
    f"p{i}": (x, y, z)
    for i, (x, y, z) in enumerate((x, y, z) for z in (0.0, 0.05) for x in (0.0, 0.03, 0.06) for y in (0.0, 0.03, 0.07))
}


def contacts(machine: sim.TrueMachine, robot: Robot, *, sockets: Any = SOCKETS, each: int = 25, noise: float = 0.0) -> Any:
    """Return a table of contacts."""
    rng = np.random.default_rng(11)
    setup = sim.Contact(fixed=sockets, tool=tuple(TOOL), sigma=noise)
    table = setup.measure(machine, setup.plan(machine.nominal, each * len(sockets), rng=rng), rng=rng)
    return measurements_from_arrays(
        robot.joint_names, np.column_stack([table[n] for n in machine.names]), socket=table["socket"]
    )


def anchored(machine: sim.TrueMachine, robot: Robot, *, poses: int = 60, noise: float = 0.0) -> Measurements:
    """Return a table of distances from every anchor in every pose."""
    rng = np.random.default_rng(12)
    q = sim.plan_poses(machine.nominal, poses, rng)
    tip = machine.equilibrium(machine.poses(q)).tip
    point = tip[:, :3, :3] @ TOOL + tip[:, :3, 3]
    distance = np.linalg.norm(point[:, None] - np.array([*ANCHORS.values()]), axis=2).ravel()
    distance += rng.normal(0.0, noise, len(distance))
    names = np.tile(list(ANCHORS), poses)
    return measurements_from_arrays(robot.joint_names, np.repeat(q, len(ANCHORS), axis=0), distance=distance, anchor=names)


def seen(
    machine: sim.TrueMachine, robot: Robot, *, poses: int = 30, pixels: bool = False, noise: float = 0.0
) -> Measurements:
    """Return what a camera at the flange reads of the grid's points."""
    rng = np.random.default_rng(13)
    places = np.array([*GRID.values()]) @ PLACE[:3, :3].T + PLACE[:3, 3]
    view = sim.View(camera_pose=MOUNT, look_at=places.mean(axis=0), facing=PLACE[:3, 2], distance=(0.3, 0.7))
    q = sim.plan_views(machine.nominal, poses, rng=rng, view=view)
    camera = machine.equilibrium(machine.poses(q)).tip @ MOUNT
    found = np.einsum("nab,nka->nkb", camera[:, :3, :3], places - camera[:, None, :3, 3]).reshape(-1, 3)
    reading = LENS.project(found) if pixels else found
    reading = reading + rng.normal(0.0, noise, reading.shape)
    columns = {"pixel" if pixels else "camera_point": reading, "point": np.tile(list(GRID), poses)}
    return measurements_from_arrays(robot.joint_names, np.repeat(q, len(GRID), axis=0), **columns)


def apart(first: str, second: str) -> float:
    """Return the distance of two sockets [m]."""
    return float(np.linalg.norm(np.subtract(SOCKETS[first], SOCKETS[second])))


def largest(fit: ModelFit, table: Measurements) -> float:
    """Return the largest error at some rows [m]."""
    return float(np.linalg.norm(fit.readings(table).displacements(fit.values), axis=1).max())


CAMERA = Options(effects=GEOMETRIC)
TABLES: dict[str, tuple[Callable[..., Measurements], Setup]] = {
    "contacts": (contacts, Setup(distances=(KnownDistance("a", "b", 0.7),))),
    "contacts in known sockets": (contacts, Setup(points=SOCKETS)),
    "distances from unknown anchors": (anchored, Setup()),
    "distances from known anchors": (anchored, Setup(points=ANCHORS)),
    "camera, unknown points": (seen, Setup()),
    "camera, known object": (seen, Setup(points=GRID)),
    "images, all unknown": (lambda m, r: seen(m, r, pixels=True), Setup()),
    "images, known object": (lambda m, r: seen(m, r, pixels=True), Setup(points=GRID)),
    "images, known camera": (lambda m, r: seen(m, r, pixels=True), Setup(lens=LENS)),
    "images, all known": (lambda m, r: seen(m, r, pixels=True), Setup(points=GRID, lens=LENS)),
}


PINHOLE = '"fx": 1, "fy": 1, "u0": 0, "v0": 0'
SLOW = ("images, known object", "images, known camera")


@pytest.mark.long
@pytest.mark.parametrize("case", [pytest.param(case, marks=[pytest.mark.long] * (case in SLOW)) for case in TABLES])
def test_exact_readings_are_explained_wherever_things_stand(case: str, machine: sim.TrueMachine, kuka: Robot) -> None:
    """Without a first guess of where anything is, exact readings of every kind are predicted on rows held out."""
    make, setup = TABLES[case]
    table = make(machine, kuka)
    held = np.random.default_rng(1).random(len(table)) < 0.25
    fit = fit_tables(kuka, table.select(~held), Options(effects=GEOMETRIC, setup=setup))

    assert np.median(np.linalg.norm(fit.station.displacements(fit.nominal.values), axis=1)) > 2e-4
    assert fit.solution.converged
    assert largest(fit, table.select(held)) < 1e-10


def test_contacts_find_the_sockets_and_the_scale(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Sockets come out where they are, but for what no contact tells: a turn about the first axis and a shift along it."""
    setup = Setup(
        distances=(
            KnownDistance("a", "b", 0.7, 1e-6),
            KnownDistance("c", "d", float(np.linalg.norm(np.subtract(SOCKETS["c"], SOCKETS["d"])))),
        )
    )
    fit = fit_tables(kuka, contacts(machine, kuka, each=40), Options(effects=GEOMETRIC, setup=setup))
    found = fit.station.split(fit.values)[1].reshape(-1, 3)
    true = np.array([*SOCKETS.values()])

    for i, j in ((0, 1), (0, 2), (1, 3)):
        assert np.linalg.norm(found[i] - found[j]) == pytest.approx(np.linalg.norm(true[i] - true[j]), abs=1e-5)
    assert np.abs(found - true).max() < 0.03


def test_a_known_distance_sets_the_scale(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Contacts alone leave lengths to the prior; an artefact that is a thousandth longer stretches the arm by it."""
    table = contacts(machine, kuka, noise=5e-5)
    lengths = []
    for scale in (1.0, 1.001):
        gaps = tuple(KnownDistance(a, b, scale * apart(a, b), 1e-6) for a, b in ("ab", "cd", "ac", "bd"))
        fit = fit_tables(kuka, table, Options(effects=GEOMETRIC, setup=Setup(distances=gaps), sigma=5e-5))
        lengths.append(fit.values[fit.model.index("joint_2.a")])
    alone = fit_tables(kuka, table, Options(effects=GEOMETRIC, sigma=5e-5))
    place = alone.model.index("joint_2.a")
    sigma = [float(np.sqrt(FittedRobot.of(f, {}).covariance[place, place])) for f in (alone, fit)]

    assert lengths[1] - lengths[0] == pytest.approx(1e-3, rel=0.3)
    assert sigma[0] > 3.0 * sigma[1]


@pytest.mark.parametrize("off", [0.0, 1e-3, pytest.param(-2e-2, marks=pytest.mark.long)])
def test_a_wrong_distance_between_sockets_is_named(off: float, machine: sim.TrueMachine, kuka: Robot) -> None:
    """With the distance that readings and the arm's own lengths say; a right one is left in peace, and so is another one."""
    table = contacts(machine, kuka, noise=5e-5)
    true = {pair: float(np.linalg.norm(np.subtract(*(SOCKETS[name] for name in pair)))) for pair in ("ab", "cd")}
    gaps = (KnownDistance("a", "b", true["ab"] + off), KnownDistance("c", "d", true["cd"]))
    fit = fit_tables(kuka, table, Options(effects=GEOMETRIC, sigma=5e-5, setup=Setup(distances=gaps)))
    found = list(contradicted_lengths(fit, {"": table}))

    assert [one.given.first for one in found] == (["a"] if off else [])
    assert all(abs(one.found - true["ab"]) < 4.0 * one.sigma < 2e-4 for one in found)


@pytest.mark.long
def test_the_doubt_of_a_distance_stands_first(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Before that of residuals that no arm has, of which it is the reason."""
    table = contacts(machine, kuka, noise=5e-5)
    length = float(np.linalg.norm(np.subtract(SOCKETS["a"], SOCKETS["b"])))
    gaps = (KnownDistance("a", "b", length + 0.05),)
    result = run_calibration(kuka, table, Options(effects=GEOMETRIC, sigma=5e-5, setup=Setup(distances=gaps))).result
    doubts = [note.text for note in result.warnings if note.is_doubt]

    assert doubts[0].startswith(f"a and b were given as {1e3 * length + 50.0:.7g} mm apart; without that,")
    assert any("too large for any calibrated arm" in doubt for doubt in doubts[1:])


def test_a_real_distance_is_confirmed(shared_data: Path) -> None:
    """Of the Panda's artefact 50 mm were stated; 52 mm are doubted, with what the readings say, which is 50 mm to 0.1."""
    with warnings.catch_warnings(action="ignore", category=PincalWarning):
        robot = Robot.from_urdf("panda")
    table = read_measurements(shared_data / "panda_sockets" / "panda_3.csv", robot.joint_names)

    def doubted(length: float) -> list[Contradiction]:
        gaps = (KnownDistance("backcenter/0", "backcenter/1", length),)
        fit = fit_tables(robot, table, Options(effects=ELASTIC, setup=Setup(distances=gaps)))
        return list(contradicted_lengths(fit, {"": table}))

    assert doubted(0.05) == []
    assert [abs(one.found - 0.05) < 1e-4 for one in doubted(0.052)] == [True]


@pytest.mark.parametrize("are_known", [False, True])
def test_a_check_is_planned_in_the_sockets_of_the_calibration(
    are_known: bool, machine: sim.TrueMachine, kuka: Robot
) -> None:
    """Where they were found in the base's frame, by their own names, whatever frame their positions were given in."""
    table = contacts(machine, kuka, noise=5e-5)
    elsewhere = {name: tuple(PLACE[:3, :3] @ place + PLACE[:3, 3]) for name, place in SOCKETS.items()}
    setup = Setup(points=elsewhere) if are_known else Setup(distances=(KnownDistance("a", "b", 0.7),))
    rig = calibrated_sockets(
        FittedRobot.of(fit_tables(kuka, table, Options(effects=GEOMETRIC, sigma=5e-5, setup=setup)), {})
    )

    assert rig is not None and rig.sensor == "socket"
    assert sorted(rig.held_names) == sorted(SOCKETS)
    true = [SOCKETS[name] for name in rig.held_names]
    np.testing.assert_allclose(rig.held_at, true, atol=0.01)


def test_sockets_farther_apart_than_the_arm_reaches_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A number in millimetres without its unit, before anything is fitted."""
    out = tmp_path / "t.csv"
    assert run("simulate", kuka_urdf_path(), "--sockets", "2", "--poses", "20", "--seed", "1", "--out", out, "--quiet") == 0
    given = ("--socket-distance", "socket_1", "socket_2", "50")
    assert run("calibrate", kuka_urdf_path(), out, *given, "--out", tmp_path / "out") == 3
    assert "write 50mm if millimetres are meant" in capsys.readouterr().err


def test_sockets_that_the_fit_never_saw_are_judged_by_their_mean(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Rows in a new socket count by how well the model keeps the tool point in one place."""
    table = contacts(machine, kuka, each=40)
    new = table.socket == "d"
    fit = fit_tables(
        kuka, table.select(~new), Options(effects=GEOMETRIC, setup=Setup(distances=(KnownDistance("a", "b", 0.7),)))
    )
    problem = fit.readings(table.select(new))

    assert largest(fit, table.select(new)) < 1e-9
    np.testing.assert_allclose(problem.residuals(fit.nominal.values).mean(axis=1), 0.0, atol=1e-12)
    assert largest(fit, table) == pytest.approx(max(largest(fit, table.select(new)), largest(fit, table.select(~new))))


@pytest.mark.long
def test_real_panda_keeps_its_ball_in_a_socket(shared_data: Path) -> None:
    """Two placements of the artefact fitted, the third held out: within 0.20 mm of the socket's mean, nominally 2.7."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PincalWarning)
        robot = Robot.from_urdf("panda")
    table = read_measurements(shared_data / "panda_sockets" / "panda_3.csv", robot.joint_names)
    placement = np.array([name.split("/")[0] for name in table.socket])
    for held in np.unique(placement):
        train, test = table.select(placement != held), table.select(placement == held)
        gaps = tuple(KnownDistance(f"{p}/0", f"{p}/1", 0.05) for p in np.unique(placement) if p != held)
        run = run_calibration(robot, train, Options(effects=ELASTIC, setup=Setup(distances=gaps)), holdout=test)
        assert run.result.error["nominal"]["test"]["mean_mm"] > 2.0
        assert run.result.error["calibrated"]["test"]["mean_mm"] <= 0.20


@pytest.mark.parametrize(
    "case",
    [
        *(pytest.param(case, marks=pytest.mark.long) for case in ("contacts", "images, known object")),
        "camera, unknown points",
    ],
)
def test_model_file_reads_further_rows(case: str, machine: sim.TrueMachine, kuka: Robot, tmp_path: Path) -> None:
    """A model that comes back from its file reads measurements of the same points as it did."""
    make, setup = TABLES[case]
    table = make(machine, kuka)
    fit = fit_tables(kuka, table, Options(effects=GEOMETRIC, setup=setup))
    FittedRobot.of(fit, {}).save(tmp_path / "model.json")
    back = load_model(tmp_path / "model.json")

    np.testing.assert_array_equal(back.readings(table).residuals(back.values), fit.station.residuals(fit.values))
    if table.socket is None:
        other = table.select(np.arange(2))
        names = np.array(["new", "new"])
        changed = measurements_from_arrays(
            kuka.joint_names, other.q, point=names, camera_point=other.camera_point, pixel=other.pixel
        )
        with pytest.raises(MeasurementError, match="point 'new' was not among those of the calibration"):
            back.readings(changed)


def test_rows_that_tell_nothing_are_left_out_with_a_word(machine: sim.TrueMachine, kuka: Robot) -> None:
    """A socket touched once, a point seen once, a point behind the camera, an anchor of three distances."""
    held = contacts(machine, kuka, each=5)
    once = held.select(np.r_[0:10, 10])
    with pytest.warns(PincalWarning, match=r"1 row is of a socket with fewer than 2 readings.*\(c\).*line 12"):
        assert len(usable_rows(once, Setup())) == 10
    assert len(usable_rows(once, Setup(points=SOCKETS))) == 11
    points = seen(machine, kuka, poses=3)
    behind = np.array(points.camera_point)
    behind[4, 2] *= -1.0
    flipped = measurements_from_arrays(kuka.joint_names, points.q, camera_point=behind, point=points.point)
    with pytest.warns(PincalWarning, match=r"1 row has cz <= 0, a point behind the camera"):
        assert len(usable_rows(flipped, Setup())) == len(points) - 1
    with pytest.warns(PincalWarning, match=r"of an anchor with fewer than 4 readings.*\(s, w\)"):
        few = anchored(machine, kuka, poses=4).select(np.arange(14))
        assert len(usable_rows(few, Setup())) == 8
    with (
        pytest.warns(PincalWarning),
        pytest.raises(MeasurementError, match="no row is left; expected 2 readings"),
    ):
        usable_rows(points.select(np.arange(5)), Setup())


def test_rows_that_judge_nothing_are_left_out_with_a_word(machine: sim.TrueMachine, kuka: Robot) -> None:
    """A new socket touched once agrees with any model; a new point of an object with none."""
    held = contacts(machine, kuka, each=5)
    had = Setup().over(held.select(np.arange(10)))
    with pytest.warns(PincalWarning, match=r"1 row is of points not used in the calibration \(c\).*line 12"):
        assert len(scorable_rows(held.select(np.arange(11)), had)) == 10
    assert len(scorable_rows(held.select(np.arange(12)), had)) == 12
    views = seen(machine, kuka, poses=2)
    with pytest.warns(PincalWarning, match="34 rows are of points not used in the calibration"):
        assert len(scorable_rows(views, Setup().over(views.select(np.arange(1))))) == 2
    with pytest.warns(PincalWarning, match="36 rows"):
        assert len(scorable_rows(views, Setup(points={"other": None}))) == 0


def test_what_a_kind_of_data_cannot_tell_is_said(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Scale of contacts and images, the place of the base, collinear anchors."""
    held, far, near = (
        contacts(machine, kuka, each=3),
        anchored(machine, kuka, poses=5),
        seen(machine, kuka, poses=2, pixels=True),
    )

    def said(table: Measurements, setup: Setup | None = None) -> str:
        return " / ".join(unobservable_notes(table, setup or Setup()))

    assert "not the pose of its base" in said(held) and "scale of the arm" in said(held)
    assert "scale" not in said(held, Setup(distances=(KnownDistance("a", "b", 0.7),)))
    assert "the pose of the base" in said(far)
    assert said(far, Setup(points=ANCHORS)) == ""
    line = {name: (float(i), 2.0 * i, 0.0) for i, name in enumerate(ANCHORS)}
    assert "are collinear" in said(far, Setup(points=line))
    assert "fewer than three" in said(far, Setup(points={"n": (3.0, 2.0, 0.3)}))
    assert "do not determine the scale" in said(near) and said(near, Setup(points=GRID)) == ""


@pytest.mark.long
def test_another_camera_than_the_given_one_is_noticed(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Images that the given camera can't have made say so; its parameters are found on request."""
    table = seen(machine, kuka, poses=16, pixels=True, noise=0.1)
    pinhole = Lens(2000.0, 2010.0, 1024.0, 768.0)
    notes = {}
    for name, lens, again in (("right", LENS, False), ("wrong", pinhole, False), ("found again", pinhole, True)):
        setup = Setup(points=GRID, lens=lens, fit_lens=again)
        run = run_calibration(kuka, table, Options(effects=GEOMETRIC, setup=setup))
        notes[name] = " ".join(note.text for note in run.result.warnings)

    assert ["contradict the given camera" in note for note in notes.values()] == [False, True, False]


@pytest.mark.long
def test_a_camera_that_was_found_can_be_given(machine: sim.TrueMachine, kuka: Robot, tmp_path: Path) -> None:
    """Lens and mount of a calibrated model come back from its camera file, and hold in another calibration."""
    table = seen(machine, kuka, poses=16, pixels=True)
    model = FittedRobot.of(fit_tables(kuka, table, Options(effects=GEOMETRIC, setup=Setup(points=GRID))), {})
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(model.camera()))
    camera = read_camera(path)
    lens, mount = camera.lens(), camera.T_tip_camera

    np.testing.assert_allclose(lens.values, LENS.values, rtol=1e-6, atol=1e-9)
    assert mount is not None and np.abs(mount - MOUNT).max() < 0.01
    again = Options(effects=GEOMETRIC, setup=Setup(points=GRID, lens=lens), tools={"camera": mount})
    fit = fit_tables(kuka, table, again)
    assert largest(fit, table) < 1e-6
    assert not fit.solution.free[[fit.model.index(f"camera.{symbol}") for symbol in ("x", "rz")]].any()
    with pytest.raises(BadInputError, match="calibrated with socket, not with images"):
        held = fit_tables(kuka, contacts(machine, kuka, each=12), Options(effects=GEOMETRIC))
        FittedRobot.of(held, {}).camera()


def test_too_few_views_are_refused_however_many_points_they_have(machine: sim.TrueMachine, kuka: Robot) -> None:
    """A view tells six coordinates; two of them can't tell a camera and six joints."""
    with pytest.raises(MeasurementError, match=r"2 poses of the camera.*expected at least 3"):
        run_calibration(kuka, seen(machine, kuka, poses=2), Options(effects=GEOMETRIC, setup=Setup(points=GRID)))


def test_points_that_repeat_are_all_in_a_sample_of_rows() -> None:
    """Of every point some rows are taken, whatever the order of the table, and no more than there are."""
    index = np.concatenate([np.arange(9000) % 150, [150, 150, 151]])
    rows = sample_rows(len(index), 500, index)
    count = np.bincount(index[rows])

    assert np.all(np.diff(rows) > 0) and len(rows) < 1200
    assert count[:150].min() >= 6 and count[150] == 2 and count[151] == 1


def test_cross_validation_leaves_out_what_one_fold_alone_has_seen(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Every row is predicted by a fit without it, but for points that no other row has."""
    table = seen(machine, kuka, poses=20)
    names = table.point.copy()
    names[0] = "alone"
    columns = {"camera_point": table.camera_point, "point": names}
    found = cross_validate(
        kuka, measurements_from_arrays(kuka.joint_names, table.q, **columns), Options(effects=GEOMETRIC), folds=3
    )

    assert np.isnan(found.residuals[:, 0]).all()
    assert np.abs(found.residuals[:, 1:]).max() < 1e-3


@pytest.mark.long
def test_distances_to_unknown_points_are_refused(machine: sim.TrueMachine, kuka: Robot) -> None:
    """A misspelt socket is named, with what it may have been; a distance to itself, of nothing or of no row is none."""
    table = contacts(machine, kuka, each=12)
    with pytest.raises(MeasurementError, match="a known distance names 'A'; expected one of the points, nearest first: a"):
        run_calibration(kuka, table, Options(effects=GEOMETRIC, setup=Setup(distances=(KnownDistance("A", "b", 0.7),))))
    elsewhere = Setup(distances=(KnownDistance("a", "b", 0.7), KnownDistance("x", "y", 0.05)))
    notes = run_calibration(kuka, table, Options(effects=GEOMETRIC, setup=elsewhere)).notes
    assert any("without any row are not used: x to y" in note.text for note in notes)
    useless = Setup(distances=(KnownDistance("x", "y", 0.05),))
    with pytest.raises(MeasurementError, match="distance x to y: not between points of the table, which has a, b"):
        run_calibration(kuka, table, Options(effects=GEOMETRIC, setup=useless))
    for bad in (
        lambda: KnownDistance("a", "a", 1.0),
        lambda: KnownDistance("a", "b", 0.0),
        lambda: KnownDistance("a", "b", 1.0, float("nan")),
    ):
        with pytest.raises(MeasurementError, match="expected"):
            bad()


def test_side_files_are_read_with_their_units(tmp_path: Path) -> None:
    """Points and distances in the units of their header; a camera with or without a mount."""
    (tmp_path / "points.csv").write_text("point;x [mm];y [mm];z [mm]\nA;1,5;0;3\nB;0;0;1000\n")
    (tmp_path / "gaps.csv").write_text("first,second,distance [mm]\nA,B,50\n")
    (tmp_path / "camera.json").write_text(json.dumps({"fx": 1000, "fy": 1001.5, "u0": 320, "v0": 240, "k1": -0.1}))
    (tmp_path / "mounted.json").write_text(json.dumps({"fx": 1, "fy": 1, "u0": 0, "v0": 0, "T_tip_camera": MOUNT.tolist()}))

    assert read_points(tmp_path / "points.csv") == {"A": (0.0015, 0.0, 0.003), "B": (0.0, 0.0, 1.0)}
    assert read_distances(tmp_path / "gaps.csv") == (KnownDistance("A", "B", 0.05),)
    assert read_camera(tmp_path / "camera.json").lens() == Lens(1000.0, 1001.5, 320.0, 240.0, -0.1)
    assert read_camera(tmp_path / "camera.json").T_tip_camera is None
    np.testing.assert_array_equal(read_camera(tmp_path / "mounted.json").T_tip_camera, MOUNT)


def test_the_origin_of_an_object_is_a_point(tmp_path: Path) -> None:
    """Of a plate whose origin is a hole, 0 0 0 is a known place among many, and no reading that an instrument lost."""
    plate = {f"p{k}": (0.025 * (k % 5), 0.025 * (k // 5), 0.0) for k in range(25)} | {"far": (-1.0, -1.0, -1.0)}
    rows = "".join(f"{name},{x},{y},{z}\n" for name, (x, y, z) in plate.items())
    (tmp_path / "plate.csv").write_text(f"point,x,y,z\n{rows}")

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_points(tmp_path / "plate.csv") == plate


@pytest.mark.parametrize(
    ("read", "text", "message"),
    [
        (read_points, "point,x,y\nA,1,2\n", "no column 'z'"),
        (read_points, "point,x,y,z\nA,1,2,3\nA,1,2,4\n", "'A' occurs twice"),
        (read_distances, "first,second,distance\nA,B,-1\n", "file.*: distance of A and B.*expected more than 0"),
        (read_distances, "first,second,distance\nA,B,1\nB,C,\n", 'line 3, column "distance"'),
        (read_distances, "first,second,distance,sigma\nA,B,1,1e-5\nB,C,1,\n", 'line 3, column "sigma"'),
        (read_camera, "{", "not JSON"),
        (read_camera, '{"fx": 1}', "expected an object with fx, fy, u0, v0"),
        (read_camera, '{"fx": 0, "fy": 1, "u0": 1, "v0": 1}', "fx is 0 px"),
        (read_camera, '{"fx": "a", "fy": 1, "u0": 1, "v0": 1}', "fx is 'a'; expected a number"),
        (read_camera, "[1]", "expected an object with fx, fy, u0, v0"),
        (read_camera, f'{{{PINHOLE}, "T_tip_camera": [[1, 2], [3, 4]]}}', "T_tip_camera is not a rigid transform"),
        (
            read_camera,
            f'{{{PINHOLE}, "T_tip_camera": {np.diag([1, 1, -1, 1]).tolist()}}}',
            "T_tip_camera is not a rigid transform",
        ),
    ],
)
def test_side_files_that_cannot_be_right_are_refused(
    read: Callable[[Path], Any], text: str, message: str, tmp_path: Path
) -> None:
    """With the file, what is wrong and what was expected."""
    path = tmp_path / "side.file"
    path.write_text(text)
    with pytest.raises(MeasurementError, match=message):
        read(path)
    with pytest.raises(MeasurementError, match="nowhere"):
        read(tmp_path / "nowhere")


def test_named_points_tell_which_are_known() -> None:
    """Known points have no parameters; their place among the unknown is -1."""
    points = NamedPoints({"a": None, "b": (1.0, 2.0, 3.0), "c": None})

    assert [p.name for p in points.parameters] == ["a.x", "a.y", "a.z", "c.x", "c.y", "c.z"]
    assert points.slot.tolist() == [0, -1, 1]
    np.testing.assert_array_equal(points.positions(np.arange(6.0)), [[0, 1, 2], [1, 2, 3], [3, 4, 5]])
    assert points.are_in_line


def test_points_that_another_station_knows_free_no_base(machine: sim.TrueMachine, kuka: Robot) -> None:
    """A station that reads unknown anchors alone has the robot's base as its frame, whatever is known of other anchors."""
    known = anchored(machine, kuka, poses=40, noise=5e-5)
    unknown = measurements_from_arrays(
        kuka.joint_names,
        known.q,
        distance=known.distance,
        anchor=np.array([f"my_{name}" for name in known.point_names]),
    )
    both = {"first": known, "second": unknown}
    fit = fit_tables(kuka, both, Options(effects=GEOMETRIC, sigma=5e-5, setup=Setup(points=ANCHORS)))
    tied = Setup(points=ANCHORS, distances=(KnownDistance("my_n", "e", 1.0),)).over(unknown)

    names = [parameter.name for parameter in fit.problem.parameters]
    sigma = dict(zip(names, fit.estimate.sigma, strict=True))
    assert "first/base.x" in sigma and "second/base.x" not in sigma
    assert max(sigma[f"second/my_{name}.{axis}"] for name in ANCHORS for axis in "xyz") < 0.05
    assert tied.points["e"] == ANCHORS["e"] and tied.points["my_n"] is None
