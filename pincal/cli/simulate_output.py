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
    from pincal.cli.simulate_options import SimulateArguments
    from pincal.simulate.setup import SensorSetup


def summary(arguments: SimulateArguments, truth: dict[str, Any], *, setup: SensorSetup, rows: int) -> str:
    """Return what was simulated and written, and the next command; ``truth`` is what the truth file holds."""
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
    given = arguments.sensor
    beside = {"what was put in": arguments.truth, "named points": given.points_out, "the camera": given.camera_out}
    written = "".join(f", {what} to {path}" for what, path in beside.items() if path)
    lines += [f"written to {arguments.out}{written}", f"next: {_next_command(arguments, setup)}"]
    return "\n".join(lines)


def _next_command(arguments: SimulateArguments, setup: SensorSetup) -> str:
    """Return the command that discovers the effects from the table."""
    machine, given = arguments.machine, arguments.sensor
    words = [f"pincal discover {arguments.robot} {arguments.out} --out results"]
    words += [f"--tip {machine.tip}"] if machine.tip else []
    words += [f"--base {machine.base}"] if machine.base else []
    words += [f"--noise {_noise(setup)}"] if setup.sigma else []
    angle = setup.truth()["noise"]["sigma_rad"]
    words += [f"--noise-angle {angle * 1e3:g}mrad"] if angle else []
    words += [f"--points {given.points_out}"] if given.points_out else []
    words += [f"--camera {given.camera_out}"] if given.camera_out else []
    if setup.kind == "socket" and not given.points_out and len(setup.points) > 1:
        (a, first), (b, second) = list(setup.points.items())[:2]
        words.append(f"--socket-distance {a} {b} {np.linalg.norm(first - second):g}")
    for name, vector in (("payload-com", arguments.campaign.payload_com), ("gravity", machine.gravity)):
        if vector not in (None, (0.0, 0.0, 0.0)):
            words.append(f"--{name} {' '.join(f'{value:g}' for value in vector)}")
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
        files: By the option that names it: the file, None where it is not wanted, and the function that writes it.

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
