"""From the options of ``pincal simulate`` to a measuring set-up, and the files of what is known of it beside the table."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

from pincal.errors import BadInputError, OutputError

_BESIDE, _CAMERAS = ("position", "pose", "distance"), ("camera_point", "camera_pixel")
# Options that only some sensors have; the sensor that those of them which say it all stand for.
_GOES_WITH = {
    "sockets": ("socket",),
    "socket_spacing": ("socket",),
    "anchors": ("distance",),
    "ball_bar": ("distance",),
    "object": _CAMERAS,
    "lens": _CAMERAS,
    "camera_out": ("camera_pixel",),
    "targets": _BESIDE,
    "instrument": (*_BESIDE, "socket"),
    "noise_angle": ("pose",),
}
_IMPLIED = {"sockets": "socket", "anchors": "distance", "ball_bar": "distance"}
_NOISE = {"m": 5e-5, "px": 0.1}
# Images of the paper's object: three blocks on each of two sides, two joint configurations each.
_PAPER_POSES = 12


def settle_options(chosen: dict[str, Any]) -> None:
    """Fill in what follows from other options: sensor, noise, number of poses.

    Args:
        chosen: Options of the command by name; changed in place.

    Raises:
        UsageError: If an option has nothing to do with the sensor.
    """
    context = click.get_current_context()
    given = {name for name in chosen if context.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT}
    if chosen["sensor"] is None:
        implied = [kind for name, kind in _IMPLIED.items() if name in given]
        chosen["sensor"] = implied[0] if implied else "position"
    sensor = chosen["sensor"]
    for name in sorted(given & _GOES_WITH.keys()):
        if sensor not in _GOES_WITH[name]:
            option = f"--{name.replace('_', '-')}"
            raise click.UsageError(f"{option} goes with --sensor {' or '.join(_GOES_WITH[name])}, not with {sensor}")
    if chosen["ball_bar"] is not None and "targets" in given:
        raise click.UsageError("--ball-bar holds one tool point; leave out --targets")
    if chosen["points_out"] is not None and not (chosen["anchors"] or chosen["ball_bar"] or sensor not in _BESIDE):
        raise click.UsageError(
            f"--points-out: --sensor {sensor} has no named points; expected socket, a camera or --anchors"
        )
    if sensor in _CAMERAS and chosen["poses"] is None and chosen["at"] is None and chosen["object"] != "grid":
        chosen["poses"] = _PAPER_POSES
    _settle_noise(chosen)


def _settle_noise(chosen: dict[str, Any]) -> None:
    """Put a number in the sensor's own unit in place of the noise."""
    unit = "px" if chosen["sensor"] == "camera_pixel" else "m"
    value, given = (_NOISE[unit], unit) if chosen["noise"] is None else chosen["noise"]
    if given not in (unit, ""):
        raise click.UsageError(f"--noise: {chosen['sensor']} is measured in {unit}; expected such as {_example(unit)}")
    chosen["noise"] = value


def _example(unit: str) -> str:
    return "0.1px" if unit == "px" else "0.05mm"


def setup_of(machine: Any, chosen: dict[str, Any], rng: np.random.Generator) -> Any:
    """Return the set-up that the options ask for."""
    from pincal.simulate.sensors import SetupOptions, draw_setup

    lens = chosen["lens"] or {}
    options = SetupOptions(
        sigma=chosen["noise"],
        sigma_angle=chosen["noise_angle"],
        targets=chosen["targets"],
        tool=chosen["tool"] or None,
        at_base=chosen["instrument"] == "base",
        sockets=chosen["sockets"] or SetupOptions.sockets,
        spacing=chosen["socket_spacing"] or SetupOptions.spacing,
        anchors=chosen["anchors"] or 0,
        ball_bar=chosen["ball_bar"],
        seen=chosen["object"] or SetupOptions.seen,
        lens=lens,
        min_height=None if chosen["no_floor"] else chosen["floor"],
    )
    return draw_setup(chosen["sensor"], machine, rng, options)


def parse_lens(text: str) -> dict[str, float]:
    """Return intrinsics of a camera by name.

    Args:
        text: As on the command line, e.g. ``fx=1200,k1=-0.1``.

    Returns:
        Values by name.

    Raises:
        BadInputError: For a key or a value that can't be, with those that can.

    Example:
        >>> parse_lens("fx=1200,fy=1210,width=1280")
        {'fx': 1200.0, 'fy': 1210.0, 'width': 1280.0}
    """
    from pincal.simulate.lens import Lens

    known, found = tuple(Lens().intrinsics), dict[str, float]()
    for pair in text.split(","):
        key, _, value = (word.strip() for word in pair.partition("="))
        if key not in known:
            raise BadInputError(f"lens {text!r}: no key {key!r}; expected of {', '.join(known)}, as key=value")
        try:
            found[key] = float(value)
        except ValueError:
            raise BadInputError(f"lens {text!r}: {key}={value}; expected a number") from None
        positive = key in ("fx", "fy", "width", "height")
        if not np.isfinite(found[key]) or (positive and found[key] < 1.0):
            raise BadInputError(
                f"lens {text!r}: {key}={value}; expected a {'number of at least 1' * positive or 'finite number'}"
            )
    return found


def noise_words(setup: Any) -> str:
    """Return the noise as the option ``--noise`` takes it."""
    return f"{setup.sigma:g}px" if setup.kind == "camera_pixel" else f"{setup.sigma * 1e3:g}mm"


def known_beside(setup: Any, chosen: dict[str, Any]) -> list[str]:
    """Return the options that tell a calibration what it needs to know beside the table."""
    words = [f"--points {chosen['points_out']}"] if chosen["points_out"] else []
    words += [f"--camera {chosen['camera_out']}"] if chosen["camera_out"] else []
    if setup.kind == "socket" and not chosen["points_out"] and len(setup.points) > 1:
        (a, first), (b, second) = list(setup.points.items())[:2]
        words.append(f"--socket-distance {a} {b} {np.linalg.norm(first - second):g}")
    return words


def point_columns(setup: Any) -> dict[str, np.ndarray]:
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
    # Endings decide the format, so a draft keeps its file's.
    drafts = {path: path.with_name(f".{os.getpid()}-{path.name}") for path, _ in wanted.values()}
    steps = [(option, path, partial(write, drafts[path])) for option, (path, write) in wanted.items()]
    steps += [(option, path, partial(os.replace, drafts[path], path)) for option, (path, _) in wanted.items()]
    try:
        for option, path, step in steps:
            try:
                step()
            except OSError as error:
                raise OutputError(f"{path}: can't be written ({error.strerror}); choose another {option}") from None
    finally:
        for draft in drafts.values():
            draft.unlink(missing_ok=True)


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


def write_json(path: Path, contents: dict[str, Any]) -> None:
    """Write contents as JSON."""
    path.write_text(json.dumps(contents, indent=1, allow_nan=False), encoding="utf-8")
