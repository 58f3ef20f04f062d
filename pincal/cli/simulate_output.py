"""The output of ``pincal simulate``: the files, what was simulated in words, and the command to go on with."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pincal.atomic import replacing
from pincal.errors import OutputError

if TYPE_CHECKING:
    from pincal.simulate.setup import SensorSetup


def summary(truth: dict[str, Any], setup: SensorSetup, *, rows: int) -> str:
    """Return what was simulated: poses, sensor, noise and hidden effects.

    Args:
        truth: What was put in.
        setup: What measures.
        rows: Number of rows of the table.
    """
    lines = [
        f"{rows} rows in {truth['poses']} poses of {truth['robot']} ({truth['base']} to {truth['tip']}): "
        f"{truth['sensor']}, noise {_noise(setup)}"
    ]
    for entry in truth["effects"]:
        place = f" of {entry['joint']}" if entry["joint"] else ""
        place += f" by {entry['source']}" if "source" in entry else ""
        unit = "" if entry["unit"] == "1" else f" {entry['unit']}"
        moved = f"moves the target by {entry['moves_target_rms_mm']:.3f} mm rms"
        lines.append(f"  hidden: {entry['effect']}{place}, size {entry['size']:.3g}{unit}, {moved}")
    return "\n".join(lines)


def next_command(robot: str, out: Path, *, setup: SensorSetup, truth: dict[str, Any], chosen: dict[str, Any]) -> str:
    """Return the command that discovers the effects from the table.

    Args:
        robot: The robot as it was given.
        out: The table.
        setup: What measures.
        truth: What was put in.
        chosen: Options of the command by name.
    """
    words = [f"pincal discover {robot} {out} --out results"]
    words += [f"--{name} {chosen[name]}" for name in ("tip", "base") if chosen[name]]
    words += [f"--noise {_noise(setup)}"] if setup.sigma else []
    words += [f"--noise-angle {chosen['noise_angle'] * 1e3:g}mrad"] if truth["noise"]["sigma_rad"] else []
    words += [f"--points {chosen['points_out']}"] if chosen["points_out"] else []
    words += [f"--camera {chosen['camera_out']}"] if chosen["camera_out"] else []
    if setup.kind == "socket" and not chosen["points_out"] and len(setup.points) > 1:
        (a, first), (b, second) = list(setup.points.items())[:2]
        words.append(f"--socket-distance {a} {b} {np.linalg.norm(first - second):g}")
    for name in ("payload_com", "gravity"):
        if chosen[name] not in (None, (0.0, 0.0, 0.0)):
            words.append(f"--{name.replace('_', '-')} {' '.join(f'{value:g}' for value in chosen[name])}")
    return " ".join(words)


def _noise(setup: SensorSetup) -> str:
    """Return the noise as the option ``--noise`` takes it."""
    return f"{setup.sigma:g}px" if setup.kind == "camera_pixel" else f"{setup.sigma * 1e3:g}mm"


def point_columns(setup: SensorSetup) -> dict[str, np.ndarray]:
    """Return the named points as a table with columns ``point x y z``."""
    places = np.array([*setup.points.values()], float)
    return {"point": np.array(list(setup.points)), **dict(zip("xyz", places.T, strict=True))}


def write_files(files: dict[str, tuple[Path | None, Callable[[Path], None]]]) -> None:
    """Write several files, all of them or none.

    Args:
        files: By the option that names it: the file, None where it is not wanted, and what writes it.

    Raises:
        OutputError: If a place can't be written to, or two options name one file.
    """
    wanted = {option: (path, write) for option, (path, write) in files.items() if path is not None}
    _check_places({option: path for option, (path, _) in wanted.items()})
    with ExitStack() as drafts:
        for option, (path, write) in wanted.items():
            write(drafts.enter_context(replacing(path, advice=f"choose another {option}")))


def _check_places(paths: dict[str, Path]) -> None:
    places = [path.absolute() for path in paths.values()]
    for (option, path), place in zip(paths.items(), places, strict=True):
        if path.is_dir():
            raise OutputError(f"{path}: is a folder; expected a file to write to")
        if not path.absolute().parent.is_dir():
            raise OutputError(f"{path}: can't be written (no such folder); choose another {option}")
        if places.count(place) > 1:
            named = " and ".join(other for other, there in paths.items() if there.absolute() == place)
            raise OutputError(f"{path}: named by {named}; expected {'two' if len(paths) == 2 else 'different'} files")


def write_json(path: Path, *, contents: dict[str, Any]) -> None:
    """Write contents as JSON."""
    path.write_text(json.dumps(contents, indent=1, allow_nan=False), encoding="utf-8")
