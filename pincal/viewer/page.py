"""The page: meshcat's viewer, a scene as numbers, and a control panel, in one file that needs no
network.

A server on this machine can move the robot in open pages. A viewer of the user's own, such as
Pinocchio's ``MeshcatVisualizer`` or ``ViserVisualizer``, can show a field of deviations, too.
"""

from __future__ import annotations

import base64
import html
import json
import os
import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields
from functools import cache, partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from pincal.atomic import write_atomic
from pincal.calibration.fitted_robot import FittedRobot
from pincal.errors import BadInputError, OutputError, nearest_first, needed
from pincal.io.strict_json import in_script
from pincal.measure.measurements import Measurements
from pincal.robot.robot import Robot
from pincal.thresholds import Scale
from pincal.viewer.field import Layer, deviation_fields
from pincal.viewer.scene import Scene, base_of, visible_scale

if TYPE_CHECKING:
    import meshcat
    from pinocchio.visualize import MeshcatVisualizer, ViserVisualizer

# The page contains everything and may load nothing. The viewer's library evaluates code of its own.
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'"
)


def write_html(path: str | os.PathLike[str], scene: Scene) -> int:
    """Write a page that opens offline: the whole file or nothing.

    Args:
        path: the file; an existing one is replaced only when the new one is complete.
        scene: what to show.

    Returns:
        Its size [bytes].

    Raises:
        OutputError: if the place can't be written to.
    """
    text = page(scene).encode()
    write_atomic(path, text, advice="choose another file")
    return len(text)


def page(scene: Scene, *, live: bool = False) -> str:
    """Return the page of a scene; a ``live`` one listens to its server."""
    shown = {"live": live} | {field.name: getattr(scene, field.name) for field in fields(scene)}
    parts = {
        "@TITLE@": html.escape(scene.title),
        "@POLICY@": html.escape(_POLICY),
        "@STYLE@": _resource("view.css"),
        "@VIEWER@": _viewer(),
        "@SCENE@": in_script(msgspec.json.encode(shown, enc_hook=_encoded).decode()),
        "@SCRIPT@": _resource("view.js"),
    }
    text = _resource("view.html")
    for mark, content in parts.items():
        before, _, after = text.partition(mark)
        # Each mark is searched for after the last one, never in contents that were inserted.
        parts[mark] = before + content
        text = after
    return "".join(parts.values()) + text


def _encoded(value: np.ndarray | np.generic) -> Any:
    """Return an array, row by row, as little-endian 32-bit numbers in base64."""
    if isinstance(value, np.generic):
        return value.item()
    kind = "<f4" if value.dtype.kind == "f" else "<u4"
    return base64.b64encode(np.ascontiguousarray(value, kind).tobytes()).decode("ascii")


@cache
def _resource(name: str) -> str:
    return (files("pincal.viewer") / name).read_text(encoding="utf-8")


@cache
def _viewer() -> str:
    """Return meshcat's viewer without loading its Python side, which runs a server of its own."""
    spec = find_spec("meshcat")
    if spec is None or spec.submodule_search_locations is None:
        raise OutputError("pages in 3D need meshcat: run pip install meshcat")
    path = Path(next(iter(spec.submodule_search_locations)), "viewer", "dist", "main.min.js")
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise OutputError(
            f"{path}: meshcat's viewer can't be read ({error.strerror}); install meshcat again"
        ) from None


_HOST = "127.0.0.1"
# Interval of messages that detect closed connections [s].
_PULSE: Scale = 5.0


class LiveView:
    """A page served to the browsers of this machine.

    Attributes:
        url: where to open it.
    """

    def __init__(self, scene: Scene, port: int = 0) -> None:
        self._scene = scene
        self._page = page(scene, live=True).encode()
        self._listeners: set[queue.SimpleQueue[str | None]] = set()
        self._lock = threading.Lock()
        try:
            self._server = _Server((_HOST, port), _Handler)
        except (OSError, OverflowError) as error:
            raise OutputError(
                f"{_HOST}:{port}: can't serve here ({error}); choose another port"
            ) from None
        self._server.view = self
        self.url = f"http://{_HOST}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(
            target=self._server.serve_forever, name="pincal-view", daemon=True
        )
        self._thread.start()

    def pose(self, q: np.ndarray) -> None:
        """Move the robot to joint positions ``q``, shape (n,) [rad or m], in every open page.

        Raises:
            BadInputError: if they are not one finite number per joint.
        """
        values = np.asarray(q, float)
        if values.shape != self._scene.q.shape or not np.isfinite(values).all():
            raise BadInputError(
                f"a pose of shape {values.shape}; expected {len(self._scene.q)} finite numbers"
            )
        self._send({"q": values.tolist()})

    def replace(self, scene: Scene) -> None:
        """Show another scene in every open page."""
        self._scene = scene
        self._page = page(scene, live=True).encode()
        self._send({"reload": True})

    def wait(self) -> None:
        """Serve until :meth:`close` is called elsewhere, or the program is interrupted."""
        while self._thread.is_alive():
            self._thread.join(0.5)

    def close(self) -> None:
        """Stop serving; open pages remain."""
        self._server.shutdown()
        self._server.server_close()
        with self._lock:
            for listener in self._listeners:
                listener.put(None)
        self._thread.join()

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _send(self, message: dict[str, Any]) -> None:
        with self._lock:
            for listener in self._listeners:
                listener.put(json.dumps(message))

    @contextmanager
    def _listening(self) -> Iterator[queue.SimpleQueue[str | None]]:
        mine: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        with self._lock:
            self._listeners.add(mine)
        try:
            yield mine
        finally:
            with self._lock:
                self._listeners.discard(mine)


def show(scene: Scene, *, port: int = 0, browser: bool = False) -> LiveView:
    """Serve a scene to the browsers of this machine; no other machine can reach it.

    Args:
        scene: what to show.
        port: of the server; default: a free one.
        browser: whether to open the page.

    Returns:
        The running server; close it, or use it as a context.

    Raises:
        OutputError: if the port is taken.
    """
    view = LiveView(scene, port)
    if browser:
        import webbrowser

        webbrowser.open(view.url)
    return view


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    view: LiveView

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a browser that disconnects."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        """Answer with the page, or with the events of the program from now on."""
        # Requests under another host name, as from a page of another site, are not served.
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        if host not in (_HOST, "localhost"):
            self.send_error(403)
        elif self.path == "/":
            content = self.server.view._page
            self._begin(
                "text/html; charset=utf-8",
                {"Content-Length": str(len(content)), "X-Content-Type-Options": "nosniff"},
            )
            self.wfile.write(content)
        elif self.path == "/events":
            with suppress(OSError):
                self._events()
        elif self.path == "/favicon.ico":
            self.send_response(204)
            self.send_header("Content-Length", "0")
            self.end_headers()
        else:
            self.send_error(404)

    def _begin(self, kind: str, more: dict[str, str]) -> None:
        self.send_response(200)
        for name, value in ({"Content-Type": kind, "Cache-Control": "no-store"} | more).items():
            self.send_header(name, value)
        self.end_headers()

    def _events(self) -> None:
        self._begin("text/event-stream", {"Connection": "close"})
        self.close_connection = True
        with self.server.view._listening() as messages:
            self.wfile.write(b": here\n\n")
            while True:
                try:
                    message = messages.get(timeout=_PULSE)
                except queue.Empty:
                    self.wfile.write(b": still here\n\n")
                    continue
                if message is None:
                    return
                self.wfile.write(f"data: {message}\n\n".encode())

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing: the library never prints."""


# Length of the strokes of an arrow's head, over its length.
_HEAD: Scale = 0.25


def draw_field(
    viz: meshcat.Visualizer | MeshcatVisualizer | ViserVisualizer,
    calibrated: FittedRobot,
    measurements: Measurements | None = None,
    *,
    layer: str | None = None,
    scale: float | None = None,
    path: str = "pincal",
    grid: int = 1000,
) -> Layer:
    """Draw a deviation field as arrows into a viewer of meshcat or viser that shows the robot.

    The viewer's world is the root of the URDF, as in Pinocchio's viewers. A field of the same
    name is replaced.

    Args:
        viz: a ``meshcat.Visualizer`` or a ``viser.ViserServer``, or a viewer that has one as
            ``viewer``, as Pinocchio's ``MeshcatVisualizer`` and ``ViserVisualizer`` have after
            ``initViewer``.
        calibrated: the robot.
        measurements: its measured poses; default: none, arrows cover the workspace.
        layer: which field, by its name; default: the first one, from nominal to measured or to
            calibrated.
        scale: scale factor of the arrows; default: a round number that makes them visible.
        path: node of the viewer's tree below which the field is drawn, under its own name.
        grid: approximate number of workspace points with an arrow; 0 for none.

    Returns:
        The field, true to scale, in the frame of the viewer.

    Raises:
        BadInputError: if there is no such field, the factor is not positive, or it is no such
            viewer.
    """
    draw = _drawer(viz)
    if scale is not None and not 0.0 < scale < np.inf:
        raise BadInputError(f"scale is {scale}; expected a positive number")
    model = calibrated.at()
    robot = model.model.chain.robot
    fields = deviation_fields(model, measurements, grid=grid).transformed(
        _root_of(robot) @ np.linalg.inv(base_of(model))
    )
    names = [field.name for field in fields.layers]
    if layer is not None and layer not in names:
        raise BadInputError(
            f"no field {layer!r}; expected one of {', '.join(nearest_first([layer], names))}"
        )
    found = fields.layers[0 if layer is None else names.index(layer)]
    factor = visible_scale(found, robot.reach) if scale is None else scale
    ends, colours = _strokes(found, factor)
    draw(path, found.name, ends, colours)
    return found


def _drawer(viz: Any) -> Callable[[str, str, np.ndarray, np.ndarray], None]:
    """Return the function that draws strokes into a viewer: below a node, under a name, from
    their ends, shape (2 N, 3) [m], and the ends' colours, shape (2 N, 3).

    Raises:
        BadInputError: if it is neither meshcat's nor viser's.
    """
    # Viser need not be installed for a viewer of meshcat, nor meshcat for one of viser.
    scene = getattr(getattr(viz, "viewer", viz), "scene", None)
    if hasattr(scene, "add_line_segments"):
        return partial(_draw_in_viser, scene)
    with needed("meshcat", "fields in a viewer"):
        import meshcat
    viewer = viz if isinstance(viz, meshcat.Visualizer) else getattr(viz, "viewer", None)
    if not isinstance(viewer, meshcat.Visualizer):
        raise BadInputError(
            f"{type(viz).__name__} is no viewer of meshcat or viser; expected one after "
            "initViewer(), or a meshcat.Visualizer or viser.ViserServer"
        )
    return partial(_draw_in_meshcat, viewer)


def _draw_in_meshcat(
    viewer: Any, path: str, name: str, ends: np.ndarray, colours: np.ndarray
) -> None:
    import meshcat.geometry as g

    points = g.PointsGeometry(ends.T, color=colours.T)
    viewer[path][name].set_object(g.LineSegments(points, g.LineBasicMaterial(vertexColors=True)))


def _draw_in_viser(scene: Any, path: str, name: str, ends: np.ndarray, colours: np.ndarray) -> None:
    scene.add_line_segments(
        f"/{path}/{name}",
        points=ends.reshape(-1, 2, 3).astype(np.float32),
        colors=np.round(255.0 * colours).astype(np.uint8).reshape(-1, 2, 3),
    )


def _strokes(field: Layer, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of an arrow's three strokes, shape (6 N, 3) [m], and their colours by length,
    shape (6 N, 3).
    """
    from matplotlib import colormaps

    tails = field.points
    along = factor * field.vectors
    heads = tails + along
    size = np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(
        along, np.where(np.abs(along[:, 2:]) < 0.9 * size, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    )
    side *= 0.5 * _HEAD * size / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-300)
    back = heads - _HEAD * along
    ends = np.stack([tails, heads, heads, back + side, heads, back - side], axis=1).reshape(-1, 3)
    largest = max(float(field.sizes.max(initial=0.0)), 1e-300)
    return ends, np.repeat(colormaps["viridis"](field.sizes / largest)[:, :3], 6, axis=0)


def _root_of(robot: Robot) -> np.ndarray:
    """Return the base of the arm in the root of its URDF, shape (4, 4), the joints before it at
    zero.
    """
    import pinocchio as pin

    if not robot.urdf:
        return np.eye(4)
    model = robot.pinocchio_model()
    return np.asarray(model.frames[model.getFrameId(robot.base, pin.BODY)].placement.homogeneous)
