"""The page: meshcat's viewer, a scene as numbers, and the panel beside it, in one file that needs no network."""

from __future__ import annotations

import base64
import html
import os
from dataclasses import fields
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pincal.atomic import write_atomic
from pincal.errors import OutputError
from pincal.viewer.scene import Scene

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
    write_atomic(path, text, advice="choose another file")
    return len(text)


def page(scene: Scene, *, live: bool = False) -> str:
    """Return the page of a scene; a ``live`` one listens to the server that it comes from."""
    parts = {
        "@TITLE@": html.escape(scene.title),
        "@POLICY@": html.escape(_POLICY),
        "@STYLE@": _resource("view.css"),
        "@VIEWER@": _viewer(),
        "@SCENE@": _json({"live": live} | {field.name: getattr(scene, field.name) for field in fields(scene)}),
        "@SCRIPT@": _resource("view.js"),
    }
    text = _resource("view.html")
    for mark, content in parts.items():
        before, _, after = text.partition(mark)
        # Contents are put in once each, from the end of the last: none is searched for the marks of others.
        parts[mark] = before + content
        text = after
    return "".join(parts.values()) + text


def _json(content: dict[str, Any]) -> str:
    """Return JSON that stays text inside of a script element, whatever names are in it."""
    text = msgspec.json.encode(content, enc_hook=_encoded).decode()
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _encoded(value: np.ndarray | np.generic) -> Any:
    """Return an array, row by row, as little-endian numbers of 32 bits in base 64."""
    if isinstance(value, np.generic):
        return value.item()
    kind = "<f4" if value.dtype.kind == "f" else "<u4"
    return base64.b64encode(np.ascontiguousarray(value, kind).tobytes()).decode("ascii")


@cache
def _resource(name: str) -> str:
    return (files("pincal.viewer") / name).read_text(encoding="utf-8")


@cache
def _viewer() -> str:
    """Return meshcat's viewer; its Python side, which talks to a server of its own, is not loaded."""
    spec = find_spec("meshcat")
    if spec is None or spec.submodule_search_locations is None:
        raise OutputError("pages in 3D need meshcat: run pip install meshcat")
    path = Path(next(iter(spec.submodule_search_locations)), "viewer", "dist", "main.min.js")
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: meshcat's viewer can't be read ({error.strerror}); install meshcat again") from None
