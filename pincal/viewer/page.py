"""The page: meshcat's viewer, a scene as numbers, and the panel beside it, in one file that needs no network."""

from __future__ import annotations

import base64
import html
import json
import os
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pincal.atomic import write_whole
from pincal.errors import OutputError
from pincal.viewer.scene import Scene

# Viridis without its dark end, which would not be told from the background: steps of equal lightness, for every eye.
_COLOURS = ("#375a8c", "#2d718e", "#24868e", "#1e9c89", "#2cb17e", "#52c569", "#86d549", "#c2df23", "#fde725")
# Part of the arrows of a layer that the colour scale covers; the few largest share its last colour.
_COVERED_PERCENT = 99.0
# Nothing may be loaded from anywhere: what the page shows is in it. The viewer's library evaluates code of its own.
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; img-src data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'"
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
    write_whole(path, text, advice="choose another file")
    return len(text)


def page(scene: Scene, *, live: bool = False) -> str:
    """Return the page of a scene; a ``live`` one listens to the server that it comes from."""
    parts = {
        "@TITLE@": html.escape(scene.title),
        "@POLICY@": html.escape(_POLICY),
        "@STYLE@": _resource("view.css"),
        "@VIEWER@": _viewer(),
        "@SCENE@": _json({**scene_to_json(scene), "live": live}),
        "@SCRIPT@": _resource("view.js"),
    }
    text = _resource("view.html")
    for mark, content in parts.items():
        before, _, after = text.partition(mark)
        # Contents are put in once each, from the end of the last: none is searched for the marks of others.
        parts[mark] = before + content
        text = after
    return "".join(parts.values()) + text


def scene_to_json(scene: Scene) -> dict[str, Any]:
    """Return a scene in types that JSON knows, arrays as little-endian numbers of 32 bits in base 64."""
    base = scene.T_scene_base
    steps = scene.kinematics
    return {
        "title": scene.title,
        "joints": list(scene.joint_names),
        "prismatic": [kind == "prismatic" for kind in steps.types],
        "lower": scene.lower.tolist(),
        "upper": scene.upper.tolist(),
        "q": scene.q.tolist(),
        "base": _matrix(base),
        "first": _matrix(base @ steps.first),
        "before": [_matrix(T) for T in steps.before],
        "after": [_matrix(T) for T in steps.after],
        "shapes": [
            {
                "link": shape.link,
                "body": shape.body,
                "vertices": _floats(shape.vertices),
                "faces": _packed(shape.faces, "<u4"),
                "colour": [round(c, 3) for c in shape.colour],
            }
            for shape in scene.shapes
        ],
        "axes": msgspec.to_builtins(scene.axes, enc_hook=np.ndarray.tolist),
        "axisScale": scene.axis_scale,
        "frames": [{"name": f.name, "body": f.body, "placement": _matrix(f.placement)} for f in scene.frames],
        "poses": [_poses(scene, part) for part in scene.fields.poses],
        "layers": [_layer(scene, layer) for layer in scene.fields.layers],
        "scale": scene.scale,
        "reach": scene.reach,
        "colours": list(_COLOURS),
        "notes": list(scene.notes),
    }


def _poses(scene: Scene, part: Any) -> dict[str, Any]:
    found: dict[str, Any] = {"name": part.name, "q": _floats(part.q)}
    if part.lines is not None:
        found["lines"] = _packed(part.lines, "<u4")
    if part.held_out is not None:
        found["held"] = _packed(part.held_out, "<u4")
    if part.position is not None:
        found["points"] = _floats(_moved(scene.T_scene_instrument, part.position))
    return found


def _layer(scene: Scene, layer: Any) -> dict[str, Any]:
    sizes = layer.sizes
    return {
        "name": layer.name,
        "poses": layer.poses,
        "words": layer.words,
        "points": _floats(_moved(scene.T_scene_instrument, layer.points)),
        "vectors": _floats(layer.vectors @ scene.T_scene_instrument[:3, :3].T),
        "mean": float(np.mean(sizes)),
        "largest": float(np.max(sizes)),
        "covered": float(np.percentile(sizes, _COVERED_PERCENT)),
    }


def _moved(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _matrix(T: np.ndarray) -> list[float]:
    """Return a placement column by column, as three.js takes it."""
    return [float(value) for value in T.T.ravel()]


def _floats(values: np.ndarray) -> str:
    return _packed(values, "<f4")


def _packed(values: np.ndarray, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode("ascii")


def _json(content: dict[str, Any]) -> str:
    """Return JSON that stays text inside of a script element, whatever names are in it."""
    text = json.dumps(content, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


@cache
def _resource(name: str) -> str:
    return (files("pincal.viewer") / name).read_text(encoding="utf-8")


@cache
def _viewer() -> str:
    """Return meshcat's viewer; its Python side, which talks to a server of its own, is not loaded."""
    spec = find_spec("meshcat")
    folder = "" if spec is None or spec.submodule_search_locations is None else next(iter(spec.submodule_search_locations))
    path = Path(folder, "viewer", "dist", "main.min.js")
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: meshcat's viewer can't be read ({error.strerror}); install meshcat again") from None
