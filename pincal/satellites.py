"""Satellites: packages beside pincal's kernel, which hand in verbs, readers, sections, schemas.

The kernel (robot, model, tables, fits, validation, compensation, export, report and their verbs)
names none of them and works without them. A satellite is a package of pincal, or of another
distribution by an entry point of the group ``pincal.satellites``, with a module ``satellite`` whose
``HANDED_IN`` says where it hands in what, by names that are imported when they are used.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar, cast

from pincal.errors import BadInputError

_T = TypeVar("_T")
_GROUP = "pincal.satellites"

# What a satellite hands in: by place of the kernel, "module:attribute" by name.
HandedIn = Mapping[str, Mapping[str, str]]


class Place(Generic[_T]):
    """A place of the kernel where satellites hand in objects of one type by name.

    Example:
        >>> Place[object]("nothing is handed in here").names()
        ()
    """

    def __init__(self, name: str) -> None:
        """Create a place.

        Args:
            name: by which satellites hand in, such as "verbs".
        """
        self.name = name

    def names(self) -> tuple[str, ...]:
        """Return the names of what is handed in, in the order of the satellites; nothing is
        imported.
        """
        return tuple(self._sources())

    def __contains__(self, name: str) -> bool:
        return name in self._sources()

    def __getitem__(self, name: str) -> _T:
        """Return what is handed in by this name.

        Raises:
            KeyError: if nothing is.
        """
        module, _, attribute = self._sources()[name].partition(":")
        return cast(_T, attrgetter(attribute)(importlib.import_module(module)))

    def get(self, name: str) -> _T | None:
        """Return what is handed in by this name, None if nothing is."""
        if name not in self:
            return None
        return self[name]

    def only(self, wanted: str, part: str) -> _T:
        """Return the first that is handed in.

        Args:
            wanted: what the user wants of it, such as an option.
            part: the satellite that usually hands it in.

        Raises:
            BadInputError: if nothing is.
        """
        for found in self.all():
            return found
        raise lacking(wanted, part)

    def all(self) -> Iterator[_T]:
        """Yield all that is handed in."""
        return (self[name] for name in self.names())

    def _sources(self) -> dict[str, str]:
        return {
            name: source
            for handed_in in _declarations()
            for name, source in handed_in.get(self.name, {}).items()
        }


def lacking(wanted: str, part: str) -> BadInputError:
    """Return the error that what the user wants, such as an option, needs an absent satellite."""
    return BadInputError(
        f"{wanted}: this installation lacks {part}, which does this; leave {wanted} "
        "out, or install pincal as a whole"
    )


@cache
def _declarations() -> tuple[HandedIn, ...]:
    """Return what all satellites hand in, those of pincal first."""
    own = sorted(Path(__file__).parent.glob("*/satellite.py"))
    others = (point.value for point in entry_points(group=_GROUP))
    found: list[Any] = [
        *(_without_package(path) for path in own),
        *(importlib.import_module(module) for module in others if find_spec(module)),
    ]
    return tuple(module.HANDED_IN for module in found)


def _without_package(path: Path) -> ModuleType:
    """Return the module ``satellite`` of a satellite of pincal; its package, which may import all
    that its work needs, is left alone.
    """
    spec = spec_from_file_location(f"pincal.{path.parent.name}.satellite", path)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
