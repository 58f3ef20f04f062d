"""The page that corrects programs, in a real browser, and the exported Python file as a program: both against the model."""

from __future__ import annotations

import html
import json
import re
import shutil
import socket
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run
from scipy.spatial.transform import Rotation
from test_export import EFFECTS, GANTRY, columns_of, drawn, everything, loaded, poses_of

from pincal.calibration.fitted_robot import FittedRobot
from pincal.compensate.compensation import compensate_program
from pincal.compensate.robot_frames import base_in_instrument, in_base_frame, program_poses
from pincal.export import export_model
from pincal.model.conditions import Conditions
from pincal.parameters import estimate_of
from pincal.robot.robot import Robot
from pincal.robot.se3 import compose, inverse
from pincal.viewer import build_scene
from pincal.viewer import page as view_page

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

# Pages are made from the model, and compared with it.
ROOMS = pytest.mark.rooms(
    "pincal/export",
    "pincal/programs",
    "tools",
    "pincal/compensate",
    "pincal/model",
    "pincal/robot",
    "pincal/calibration",
    "pincal/viewer",
)
EXACT = 1e-12
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-dev-shm-usage",
         "--virtual-time-budget=20000", "--dump-dom")  # fmt: skip


def answered(page: str, code: str, folder: Path, *flags: str) -> Any:
    """Return what JavaScript makes of a page: in a browser the page itself, else its formulas and tables in Node."""
    if CHROMIUM is not None:
        told = "const out = document.createElement('pre'); out.id = 'told'; document.body.append(out);"
        code = f"(async () => {{ {told} out.textContent = JSON.stringify(await (async () => {{ {code} }})()); }})();"
        before, _, after = page.rpartition("</body>")
        (folder / "page.html").write_text(f"{before}<script>{code}</script></body>{after}", encoding="utf-8")
        command = [CHROMIUM, *FLAGS, *flags, f"--user-data-dir={folder / 'profile'}", (folder / "page.html").as_uri()]
        dom = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
        found = re.search(r'<pre id="told">(.*?)</pre>', dom, re.DOTALL)
        assert found, "the page ended with an error"
        return json.loads(html.unescape(found[1]))
    if (node := shutil.which("node")) is None:
        pytest.skip("neither Chromium nor Node here: nothing to run a page with")
    script = page.split("<script>\n", 1)[1].split("// The page: files in and out", 1)[0]
    text = f"{script}\n(async () => {{ console.log(JSON.stringify(await (async () => {{ {code} }})())); }})();"
    (folder / "page.js").write_text(text, encoding="utf-8")
    return json.loads(subprocess.run([node, folder / "page.js"], capture_output=True, text=True, check=True).stdout)


def states_of(at: Conditions, own: np.ndarray) -> str:
    """Return poses as the page's functions take them."""
    columns = {name: getattr(at, name) for name in ("payload", "temperature", "time", "target")}
    assert at.approach is not None
    columns |= {"q": at.q[:, own], "approach": at.approach[:, own]}
    return json.dumps([{name: np.asarray(column[i]).tolist() for name, column in columns.items()} for i in range(len(at))])


# --- the formulas -------------------------------------------------------------------------------------------------


@pytest.mark.long
@ROOMS
@pytest.mark.parametrize("case", ["gear", "elastic", "everything", "gantry", "few"])
def test_the_page_predicts_and_compensates_as_the_model_does(kuka: Robot, case: str, tmp_path: Path) -> None:
    """In JavaScript as in Python to 1e-12, geometry, elasticity on the bent arm, every effect, joints that follow others."""
    if case == "few":
        robot = Robot.from_urdf("ur10", tip="wrist_1_link")
        calibrated = drawn(EFFECTS["gear_ratio"](robot.joint_names), robot)
    elif case == "gantry":
        robot = Robot.from_urdf(GANTRY)
        calibrated = drawn(EFFECTS["backlash"](robot.joint_names), robot, frame="after")
    elif case == "everything":
        calibrated = everything(kuka)
    else:
        name = "gear_ratio" if case == "gear" else "transmission_error"
        calibrated = drawn(EFFECTS[name](kuka.joint_names), kuka, frame="after", equilibrium=case == "elastic")
    at = poses_of(calibrated, 200, np.random.default_rng(3))
    robot = calibrated.model.chain.robot
    page = export_model(calibrated, "page").text
    told = answered(
        page,
        f"const S = {states_of(at, robot.own_joints)};"
        "return S.map((s) => { const m = nominal(s)[0]; return [calibrated(s)[0], m, compensate(calibrated, m, s)]; });",
        tmp_path,
    )
    poses, meant = (np.array([row[k] for row in told]).reshape(-1, 3, 4) for k in (0, 1))
    placed = in_base_frame(calibrated)

    np.testing.assert_allclose(poses, placed.predict(at), rtol=0.0, atol=EXACT)
    np.testing.assert_allclose(meant, program_poses(calibrated, at), rtol=0.0, atol=EXACT)
    if case == "gantry":
        return  # Backlash of a joint that follows another has a side of its own in these poses.
    ok = np.array([row[2]["status"] == "ok" for row in told])
    found = replace(at, q=robot.spread(np.array([row[2]["q"] for row in told])))
    arrived = placed.predict(found)[ok]
    wanted = program_poses(calibrated, at)[ok]
    if case == "few":
        np.testing.assert_allclose(arrived[:, :, 3], wanted[:, :, 3], rtol=0.0, atol=EXACT)
        return
    np.testing.assert_allclose(arrived, wanted, rtol=0.0, atol=EXACT)
    reached = compensate_program(calibrated, at)
    both = ok & reached.is_ok
    assert both.mean() > 0.95 and not (ok & ~reached.is_ok).any()
    # Beside a singularity joints that reach a pose to rounding may differ more than the poses.
    apart = np.abs(found.q - reached.q).max(axis=1)[both]
    assert np.quantile(apart, 0.9) < EXACT and np.median(apart) < 0.1 * EXACT


@pytest.mark.long
@ROOMS
def test_the_page_gives_the_uncertainty_of_predictions(kuka: Robot, tmp_path: Path) -> None:
    """In JavaScript as in Python, in the instrument's frame, as compensate states it; a model without any has none."""
    bare = drawn(EFFECTS["gear_ratio"](kuka.joint_names), kuka, frame="after", equilibrium=True)
    variances = np.diag(np.linspace(1.0, 2.0, len(bare.values)) * 1e-10)
    uncertain = replace(bare, estimate=estimate_of(bare.model.parameters, bare.values, variances))
    at = poses_of(uncertain, 20, np.random.default_rng(3))
    code = f"const S = {states_of(at, kuka.own_joints)}; return S.map((s) => uncertainty(s));"
    found = answered(export_model(uncertain, "page").text, code, tmp_path)
    np.testing.assert_allclose(found, uncertain.position_sigma(at), rtol=0.01)
    assert "const uncertainty = null" in export_model(bare, "page").text


# --- tables -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Made:
    """A calibrated robot, its page, its Python file, and a program of poses in the middle of its range."""

    calibrated: FittedRobot
    page: str
    python: Path
    at: Conditions

    @property
    def meant(self) -> np.ndarray:
        """Return the poses that the program means, in the base frame, shape (N, 3, 4)."""
        return program_poses(self.calibrated, self.at)

    def arrived(self, q: np.ndarray) -> np.ndarray:
        """Return where the robot goes with joint positions."""
        return in_base_frame(self.calibrated).predict(replace(self.at, q=q))


@pytest.fixture(scope="module")
def made(kuka: Robot, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Return an elastic robot and a program of 20 poses."""
    calibrated = drawn(EFFECTS["gear_ratio"](kuka.joint_names), kuka)
    folder = tmp_path_factory.mktemp("made")
    export_model(calibrated, "python", folder / "arm.py", frame="base")
    q = np.array([0.2, 0.6, -0.4, 0.3, 0.9, -0.2]) + np.random.default_rng(2).uniform(-0.3, 0.3, (20, 6))
    at = replace(Conditions.at(q, payload_centre=calibrated.payload_centre), payload=np.full(20, 60.0))
    return Made(calibrated, export_model(calibrated, "page", frame="base").text, folder / "arm.py", at)


def by_page(made: Made, name: str, text: bytes, folder: Path) -> tuple[bytes, list[str] | None]:
    """Return a file as the page corrects it, and how each row ended; what it says where it refuses the file."""
    return each_by_page(made, [(name, text)], folder)[0]


def each_by_page(made: Made, files: list[tuple[str, bytes]], folder: Path) -> list[tuple[bytes, list[str] | None]]:
    """Return files as one page corrects them, as :func:`by_page` does one."""
    given = json.dumps([(name, text.decode("latin-1")) for name, text in files]).replace("<", "\\u003c")
    code = (
        "const o = { payload: 60, temperature: 0, time: 0, target: 0, frame: 'base', start: [.2, .6, -.4, .3, .9, -.2] };"
        f"return {given}.map(([name, text]) => {{ try {{"
        "const r = correct(name, text, o); return [r.text, r.rows.map((row) => row.status)]; }"
        "catch (error) { return [error.message, null]; } });"
    )
    return [(found.encode("latin-1"), rows) for found, rows in answered(made.page, code, folder)]


def by_python(made: Made, text: bytes, folder: Path) -> tuple[bytes, int, str]:
    """Return a file as the Python file corrects it, run by itself without pincal, its exit code and its words."""
    (folder / "in.csv").write_bytes(text)
    start = ["--start", "0.2", "0.6", "-0.4", "0.3", "0.9", "-0.2", "--payload", "60"]
    command = [sys.executable, "-I", made.python, "in.csv", "out.csv", *start]
    block = {"PATH": "", "PYTHONPATH": ""}
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=block, check=False)
    written = (folder / "out.csv").read_bytes() if done.returncode == 0 else b""
    return written, done.returncode, done.stdout + done.stderr


JOINTS_TABLE = ("P{i};{q};60,0;caf\xe9 {i}", "nr;" + ";".join(f"J{k} [deg]" for k in range(1, 7)) + ";payload [kg];comment")


def joints_table(made: Made) -> bytes:
    """Return the program as a table of degrees with decimal commas, comments, Latin-1 and Windows line ends."""
    lines = ["# made by hand", JOINTS_TABLE[1]]
    for i, q in enumerate(np.degrees(made.at.q)):
        lines.append(JOINTS_TABLE[0].format(i=i, q=";".join(f"{x:.9f}".replace(".", ",") for x in q)))
    return "\r\n".join([*lines, ""]).encode("latin-1")


def without_numbers(text: bytes) -> bytes:
    """Return a text with each number as a hash."""
    return re.sub(rb"(?<![\w])[-+]?\d+[.,]\d+", b"#", text)


@pytest.mark.long
@ROOMS
def test_a_table_of_joints_comes_back_with_other_numbers_alone(made: Made, tmp_path: Path) -> None:
    """Page and Python file write the same text, at whose joints the robot does what was meant; all else is as it was."""
    text = joints_table(made)
    found, rows = by_page(made, "program.csv", text, tmp_path)
    other, code, words = by_python(made, text, tmp_path)

    assert rows == ["ok"] * 20 and code == 0 and "20 of 20 points corrected" in words
    assert found == other and found != text and without_numbers(found) == without_numbers(text)
    cells = [line.split(b";")[1:7] for line in found.splitlines()[2:]]
    q = np.radians(np.array([[float(cell.replace(b",", b".")) for cell in row] for row in cells]))
    assert np.abs(made.arrived(q) - made.meant).max() < 1e-8


@pytest.mark.long
@ROOMS
@pytest.mark.parametrize(
    "names",
    [
        *(("A", "B", "C"), ("rx", "ry", "rz"), ("q1", "q2", "q3", "q4")),
        *(pytest.param(names, marks=pytest.mark.rates) for names in (("W", "P", "R"), ("qx", "qy", "qz", "qw"))),
    ],
)
def test_a_table_of_poses_comes_back_in_its_own_way(made: Made, names: tuple[str, ...], tmp_path: Path) -> None:
    """A nominal controller that is given the new poses brings the robot where the old ones were meant."""
    kinds = {
        "A": (lambda r: r.as_euler("ZYX", degrees=True), lambda v: Rotation.from_euler("ZYX", v, degrees=True)),
        "W": (lambda r: r.as_euler("xyz", degrees=True), lambda v: Rotation.from_euler("xyz", v, degrees=True)),
        "rx": (lambda r: r.as_rotvec(), Rotation.from_rotvec),
        "qx": (lambda r: r.as_quat(), Rotation.from_quat),
        "q1": (lambda r: r.as_quat(scalar_first=True), lambda v: Rotation.from_quat(v, scalar_first=True)),
    }
    to_numbers, from_numbers = kinds[names[0]]
    values = to_numbers(Rotation.from_matrix(made.meant[:, :, :3]))
    header = "\t".join(["x [mm]", "y [mm]", "z [mm]", *names])
    rows = [
        "\t".join(f"{x:.10f}" for x in (*(1e3 * place), *turn))
        for place, turn in zip(made.meant[:, :, 3], values, strict=True)
    ]
    text = "\n".join([header, *rows]).encode()
    found, ended = by_page(made, "poses.txt", text, tmp_path)
    other, code, _ = by_python(made, text, tmp_path)

    assert ended == ["ok"] * 20 and code == 0
    numbers = [np.array([line.split(b"\t") for line in each.splitlines()[1:]], float) for each in (found, other)]
    np.testing.assert_allclose(*numbers, rtol=0.0, atol=1e-8)
    # What a controller with the nominal robot and the calibrated tool makes of them: the joints that compensation finds.
    expected = program_poses(made.calibrated, replace(made.at, q=compensate_program(made.calibrated, made.at).q))
    np.testing.assert_allclose(1e-3 * numbers[0][:, :3], expected[:, :, 3], rtol=0.0, atol=1e-9)
    back = from_numbers(numbers[0][:, 3:]).as_matrix()
    np.testing.assert_allclose(back, expected[:, :, :3], rtol=0.0, atol=1e-9)


@pytest.mark.long
@ROOMS
def test_what_can_not_be_read_is_refused_by_name(made: Made, tmp_path: Path) -> None:
    """With what to do; the Python file ends with 3 and writes nothing."""
    joints = ",".join(made.calibrated.model.chain.robot.joint_names)
    texts = [
        (b"", "header"),
        (b"joint_1,joint_2\n0,0\n", 'no column for joint'),
        (f"{joints}\n0,0,0,0,0\n".encode(), "line 2: 5 cells; expected 6"),
        (f"{joints}\n0,0,zero,0,0,0\n".encode(), '"zero" is not a number'),
        (f"{joints}\n0,-90,90,0,90,0\n".encode(), "looks like degrees"),
        (f"{joints.replace('joint_1', 'joint_1 [mm]')}\n0,0,0,0,0,0\n".encode(), "[mm] is not a unit of it"),
        (b"x,y,z\n1,1,1\n", "orientation"),
        (b"x,y,z,A,B,C,rx,ry,rz\n1,1,1,0,0,0,0,0,0\n", "delete one of them"),
    ]  # fmt: skip
    kinds = [("a.tp", "a FANUC binary"), ("t.xlsx", "save it as CSV"), ("weld.urp", "a packed PolyScope program")]
    files = [*(("table.csv", text) for text, _ in texts), *((name, b"whatever") for name, _ in kinds)]
    refusals = each_by_page(made, files, tmp_path)
    for (text, words), (refused, rows) in zip(texts, refusals[: len(texts)], strict=True):
        _, code, said = by_python(made, text, tmp_path)
        assert code == 3 and words in said and "Traceback" not in said
        assert rows is None and words in refused.decode("latin-1")
    assert not (tmp_path / "out.csv").exists()
    for (_, words), (refused, rows) in zip(kinds, refusals[len(texts) :], strict=True):
        assert rows is None and words in refused.decode() and "pincal compensate model.json" in refused.decode()


# --- the page itself ----------------------------------------------------------------------------------------------


def test_no_request_leaves_the_page(made: Made, tmp_path: Path) -> None:
    """It names nothing to load, its policy forbids all that it does not hold, and a browser obeys."""
    assert "Content-Security-Policy\" content=\"default-src 'none'; script-src 'unsafe-inline';" in made.page
    assert not re.search(r"\b(src|href)\s*=|@import|url\(|https?:", made.page)
    if CHROMIUM is None:
        pytest.skip("no Chromium here: the policy was read, not tried")
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        there = f"http://127.0.0.1:{server.getsockname()[1]}/"
        blocked, fetched = answered(
            made.page,
            "const fetched = performance.getEntriesByType('resource').map((e) => e.name), seen = [];"
            "document.addEventListener('securitypolicyviolation', (e) => seen.push(e.effectiveDirective));"
            f"await fetch('{there}').catch(() => 0); new Image().src = '{there}a.png';"
            "await new Promise((done) => setTimeout(done, 200)); return [seen, fetched];",
            tmp_path,
        )
        with pytest.raises(BlockingIOError):
            server.accept()
    assert sorted(blocked) == ["connect-src", "img-src"] and fetched == []


@pytest.mark.long
@ROOMS
def test_a_dropped_file_is_shown_and_saved(made: Made, tmp_path: Path) -> None:
    """The page takes a file, lists each point with its error and its change, and saves the corrected text."""
    if CHROMIUM is None:
        pytest.skip("no Chromium here: nothing to open a page with")
    given = json.dumps(joints_table(made).decode("latin-1"))
    told = answered(
        made.page,
        f"const bytes = Uint8Array.from({given}, (c) => c.charCodeAt(0)); let saved = null;"
        "URL.createObjectURL = (blob) => { saved = blob; return '#'; };"
        "await take([new File([bytes], 'weld.csv')]); $('saves').firstChild.click();"
        "const text = new Uint8Array(await saved.arrayBuffer());"
        "return [$('rows').tBodies[0].rows.length, $('rows').tBodies[0].rows[0].innerText, $('summary').textContent,"
        "  $('saves').textContent, String.fromCharCode(...text), document.documentElement.scrollWidth <= innerWidth];",
        tmp_path,
    )
    found, _ = by_page(made, "weld.csv", joints_table(made), tmp_path)

    assert told[0] == 20 and told[1].startswith("3\t") and "20 of 20 points corrected" in told[2]
    assert told[3] == "Save weld-corrected.csv" and told[4].encode("latin-1") == found and told[5]


@pytest.mark.long
@ROOMS
def test_what_the_picture_shows_is_said_in_sentences(made: Made, tmp_path: Path) -> None:
    """Names of joints that are more than their numbers end with a full stop, before what a reader can do."""
    if CHROMIUM is None:
        pytest.skip("no Chromium here: nothing to open a page with")
    said, numbered = answered(made.page, "draw(); return [$('legend').textContent, JOINTS.every(isNumbered)];", tmp_path)

    names = "" if numbered else r"J1: \w+(, J\d: \w+)+\. "
    assert re.fullmatch(names + r"Drag to turn, scroll or pinch to zoom\.", said)


@pytest.mark.long
@ROOMS
def test_all_joints_are_in_view_and_named(made: Made, tmp_path: Path) -> None:
    """At the start and along a program, from each side: names within the picture, none over another, the arm large."""
    if CHROMIUM is None:
        pytest.skip("no Chromium here: nothing to open a page with")
    given = json.dumps(joints_table(made).decode("latin-1"))
    pictures = answered(
        made.page,
        "const pictures = []; let names = [];"
        "CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {"
        "  names.push([text, x, y, this.measureText(text).width]); };"
        "const look = () => { for (const turn of [-0.9, 0.6, 2.5]) {"
        "  names = []; eye.turn = turn; draw(); const { width, height } = $('view').getBoundingClientRect();"
        "  pictures.push([[width, height], names]); names = []; } };"
        f"look(); const bytes = Uint8Array.from({given}, (c) => c.charCodeAt(0));"
        "await take([new File([bytes], 'weld.csv')]);"
        "for (const row of [0, 9, 19]) { show(row); look(); } return pictures;",
        tmp_path,
    )
    assert len(pictures) == 12
    for k, (box, names) in enumerate(pictures):
        assert [name for name, *_ in names] == [f"J{i + 1}" for i in range(len(names))] and len(names) == 6
        assert all(x >= 0 and x + wide <= box[0] - 5.9 and 0 <= y <= box[1] for _, x, y, wide in names)
        for i, (_, x, y, wide) in enumerate(names):
            assert all(abs(y - b) >= 14 or x > a + w or a > x + wide for _, a, b, w in names[:i])
        places = np.array([name[1:3] for name in names])
        assert k >= 3 or np.ptp(places, axis=0).max() > 0.4 * min(box)


def test_names_of_a_robot_are_no_code_in_the_page(kuka: Robot, tmp_path: Path) -> None:
    """Names that would end a script or a comment stay names."""
    from pincal.builtin import kuka_urdf_path

    attack = "</script><img src=x onerror=alert(1)>\u2028*/`${alert(1)}"
    urdf = kuka_urdf_path().read_text(encoding="utf-8")
    escaped = html.escape(attack, quote=True)
    for name in ("kuka_kr125_2", "joint_1"):
        urdf = urdf.replace(f'name="{name}"', f'name="{name}{escaped}"')
    robot = Robot.from_urdf(urdf.encode())
    page = export_model(drawn(EFFECTS["gear_ratio"](robot.joint_names), robot), "page").text

    assert "<img" not in page and page.count("</script>") == 1
    assert answered(page, "return JOINTS[0]", tmp_path) == "joint_1" + attack


@pytest.mark.long
@ROOMS
def test_positions_may_be_in_the_instruments_frame(made: Made, tmp_path: Path) -> None:
    """The page knows where the robot stands, if it stands still; the Python file has the frame it was exported with."""
    calibrated, at = made.calibrated, made.at
    seen = compose(base_in_instrument(calibrated, at), made.meant)
    about = answered(made.page, "return [ABOUT.frame, ABOUT.base]", tmp_path)
    np.testing.assert_allclose(np.reshape(about[1], (3, 4)), compose(seen, inverse(made.meant))[0], rtol=0.0, atol=EXACT)
    assert about[0] == "base"
    source = loaded(export_model(calibrated, "python").text)
    inputs = source["_inputs"](at.q, **(columns_of(at) | {"temperature": 0.0, "time": 0.0, "approach": 0.0}))
    np.testing.assert_allclose(source["_nominal"](*inputs)[0], seen, rtol=0.0, atol=EXACT)


def test_the_command_writes_the_page(made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One file, and how far its formulas are off."""
    made.calibrated.save(tmp_path / "model.json")
    assert run("export", tmp_path / "model.json", "--page", tmp_path / "corrector.html", "--frame", "base") == 0
    assert "its forward kinematics agree with the model to" in capsys.readouterr().out
    assert (tmp_path / "corrector.html").read_text(encoding="utf-8") == made.page


@pytest.mark.long
@ROOMS
def test_the_view_on_a_phone_shows_the_robot(made: Made, tmp_path: Path) -> None:
    """The picture stands above the panel and fills its part of the screen, and the viewer's own menu is not there."""
    if CHROMIUM is None:
        pytest.skip("no Chromium here: nothing to open a page with")
    view, panel, picture, menu = answered(
        view_page(build_scene(made.calibrated, grid=30)),
        "const box = (e) => { const b = e.getBoundingClientRect(); return [b.top, b.bottom, b.width]; };"
        "return [box(document.getElementById('view')), box(document.getElementById('panel')),"
        "  box(document.querySelector('canvas')), [...document.querySelectorAll('.dg')].every((e) => !e.offsetHeight)];",
        tmp_path,
        "--window-size=500,844",
        "--enable-unsafe-swiftshader",
    )
    assert view[0] == 0 and view[1] <= panel[0] + 1 and menu
    # The answer that the test adds to the page makes room for a scroll bar.
    assert picture == pytest.approx(view, abs=16)
