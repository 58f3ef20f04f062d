"""ROS packages near a robot's file, and the meshes in them; nothing is downloaded."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import unquote, urlparse

from lxml import etree

from pincal.thresholds import Count

# The file that marks the folder of a ROS package.
_MARK = "package.xml"
# Largest mesh file and largest sum of a robot's mesh files that are read [bytes]: the largest in
# example-robot-data are 29 MB and 90 MB, and reading takes twelve times their size in memory.
_LARGEST_MESH: Count = 40_000_000
_LARGEST_ROBOT: Count = 200_000_000


def neighbouring_packages(file: str | os.PathLike[str]) -> dict[str, Path]:
    """Return the folders of the ROS packages around a file, by name; of two with one name, the
    nearer one.

    Each folder above the file is searched, two levels deep, until one contains no more packages.
    """
    found: dict[str, Path] = {}
    for home in Path(file).resolve().parents:
        if home == home.parent:
            break
        marks = [
            mark for pattern in ("", "*/", "*/*/") for mark in sorted(home.glob(pattern + _MARK))
        ]
        if found and not marks:
            break
        for mark in marks:
            found.setdefault(_package_name(mark), mark.parent)
    return found


def packages_of_ros() -> dict[str, Path]:
    """Return the folders of the packages in ROS's search paths, by name; of two with one name, the
    first.

    ``ROS_PACKAGE_PATH`` lists folders of packages, ``AMENT_PREFIX_PATH`` folders with a ``share``.
    """
    found: dict[str, Path] = {}
    for home in _homes_of_ros():
        for pattern in ("", "*/", "*/*/"):
            for mark in sorted(home.glob(pattern + _MARK)):
                found.setdefault(_package_name(mark), mark.parent)
    return found


def _homes_of_ros() -> Iterator[Path]:
    """Yield the folders in which ROS looks for packages."""
    for variable, end in (("ROS_PACKAGE_PATH", ""), ("AMENT_PREFIX_PATH", "share")):
        for entry in os.environ.get(variable, "").split(os.pathsep):
            if entry:
                yield Path(entry, end)


def _package_name(mark: Path) -> str:
    try:
        name = etree.parse(mark, etree.XMLParser(resolve_entities=False, no_network=True)).findtext(
            "name"
        )
    except (OSError, etree.XMLSyntaxError):
        name = None
    return (name or "").strip() or mark.parent.name


class Meshes:
    """The mesh files of one robot that are on this machine, up to a total size that can be
    processed.
    """

    def __init__(self, source: str, folders: Sequence[Path] = ()) -> None:
        """Prepare a search as by :func:`find_mesh`."""
        self._source = source
        self._folders = folders
        self._read = 0

    def find(self, name: str) -> tuple[Path | None, str]:
        """Return the file of a name or URL in the URDF, to be read once; or None and the reason."""
        path = find_mesh(name, self._source, self._folders)
        if path is None:
            return None, "was not found"
        size = path.stat().st_size
        if size > _LARGEST_MESH:
            return (
                None,
                f"has {size / 1e6:.0f} MB, more than the {_LARGEST_MESH / 1e6:.0f} MB "
                "that are read: simplify it",
            )
        if self._read + size > _LARGEST_ROBOT:
            return (
                None,
                f"is left out, as the robot's meshes exceed {_LARGEST_ROBOT / 1e6:.0f} "
                "MB: simplify them",
            )
        self._read += size
        return path, ""


def find_mesh(name: str, source: str, folders: Sequence[Path] = ()) -> Path | None:
    """Return the mesh file of a name or URL in a URDF, None if it is not on this machine.

    The search covers the folder of the URDF's file ``source``, the packages around it, ROS's, and
    further folders with meshes or packages.
    """
    try:
        url = urlparse(name)
    except ValueError:
        return None
    if url.scheme not in ("", "file", "package", "model"):
        return None
    beside = Path(source).resolve().parent
    if url.scheme in ("", "file"):
        path = Path(unquote(url.path))
        candidates = (
            [path] if path.is_absolute() else [folder / path for folder in (beside, *folders)]
        )
        return next((file for file in candidates if file.is_file()), None)
    return next(
        (
            file
            for file in _in_packages(Path(unquote(f"{url.netloc}{url.path}")), source, folders)
            if file.is_file()
        ),
        None,
    )


def _in_packages(path: Path, source: str, folders: Sequence[Path]) -> Iterator[Path]:
    """Yield the possible locations of a path that begins with the name of a package, the likeliest
    first.
    """
    beside = Path(source).resolve().parent
    homes = [beside, *beside.parents]
    inside = Path(*path.parts[1:]) if len(path.parts) > 1 else path
    yield from (home / inside for home in homes if path.parts[:1] == (home.name,))
    yield from (home / path for home in (*homes, *folders, *_homes_of_ros()))
    yield from (folder / inside for folder in folders)
    yield from (
        home / inside
        for name, home in neighbouring_packages(source).items()
        if path.parts[:1] == (name,)
    )
