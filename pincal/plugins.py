"""Registries of classes by name, extended by installed packages and by modules that the user names.

Files never make pincal import code: custom classes in a model file have to be installed with an
entry point, or their module named by the user, with ``--plugin`` on the command line or
:func:`load_plugin` in Python.
"""

from __future__ import annotations

import importlib
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar

from pincal.errors import BadInputError, warn

_T = TypeVar("_T")
_C = TypeVar("_C", bound=type[Any])

# Modules named by users, in order, and the modules of registered classes.
_loaded: dict[str, None] = {}
_origins: list[str] = []


class Registry(Generic[_T]):
    """The classes of one kind by name: pincal's own, those of plugins, and those that a user
    registers.

    Example:
        >>> class Hose:
        ...     name = "hose"
        >>> hoses = Registry[Hose]("hose", group="pincal.hoses", name_of=lambda cls: cls.name)
        >>> hoses.register(Hose) is Hose
        True
        >>> list(hoses.known())
        ['hose']
    """

    def __init__(
        self,
        kind: str,
        *,
        group: str,
        name_of: Callable[[type[_T]], str],
        check: Callable[[type[_T]], None] | None = None,
        handed_in: Callable[[], Iterable[type[_T]]] = tuple,
    ) -> None:
        """Create an empty registry.

        Args:
            kind: of its classes, for messages: "effect", "sensor".
            group: entry points by which installed packages declare classes, or modules that
                register them.
            name_of: returns the name of a class.
            check: raises ``TypeError`` for an incomplete class.
            handed_in: returns the classes that satellites hand in; asked when classes are.
        """
        self.kind = kind
        self.group = group
        self._name_of = name_of
        self._check = check
        self._handed_in = handed_in
        self._is_handed_in = False
        self._classes: dict[str, type[_T]] = {}
        self._is_complete = False

    def register(self, cls: _C) -> _C:
        """Add a class, as a decorator or by a call.

        Raises:
            TypeError: if the class is incomplete, or another class has its name.
        """
        if self._check is not None:
            self._check(cls)
        name = self._name_of(cls)
        there = self._classes.get(name)
        # A module that is run and imported, or loaded again, defines its classes twice.
        if there is not None and there.__qualname__ != cls.__qualname__:
            raise TypeError(
                f"{self.kind} {name!r} of {cls.__module__} has the name of "
                f"{there.__module__}.{there.__qualname__}; choose another name"
            )
        self._classes[name] = cls
        _origins.append(cls.__module__)
        return cls

    def registered(self) -> Mapping[str, type[_T]]:
        """Return the classes registered so far, without loading installed packages."""
        if not self._is_handed_in:
            self._is_handed_in = True
            for cls in self._handed_in():
                self.register(cls)
        return dict(self._classes)

    def known(self) -> Mapping[str, type[_T]]:
        """Return all classes by name, including those of installed packages."""
        if not self._is_complete:
            self._is_complete = True
            # First pincal's own: a plug-in does not take their names.
            self.registered()
            self._load_entry_points()
        return dict(self._classes)

    def _load_entry_points(self) -> None:
        """Load the classes that installed packages declare; warn of those that fail."""
        for point in entry_points(group=self.group):
            try:
                found = point.load()
                if isinstance(found, type):
                    self.register(found)
            except (Exception, SystemExit) as error:  # Third-party code may raise anything.
                warn(
                    f"{self.kind} {point.name!r} of the entry point {point.value} can't be loaded "
                    f"({type(error).__name__}: {error}); it is left out"
                )


def load_plugin(name: str) -> ModuleType:
    """Import a module that registers effects or sensors.

    Args:
        name: its dotted name, on Python's path or in the current folder, or the path of a ``.py``
            file.

    Raises:
        BadInputError: if there is no such module, it fails, or it registers nothing.
    """
    path = Path(name)
    before = len(_origins)
    if not name:
        raise BadInputError(
            "plugin '': expected the name of a module, or a file such as my_effects.py"
        )
    folder, module = (
        (path.parent.resolve(), path.stem) if path.suffix == ".py" else (Path.cwd(), name)
    )
    found = _imported(name, module, folder)
    # A module that was already imported has registered its classes before.
    if not any(
        i >= before or f"{origin}.".startswith(f"{module}.") for i, origin in enumerate(_origins)
    ):
        raise BadInputError(
            f"plugin {name!r}: registers neither an effect nor a sensor; expected a "
            "module with a class under @register_effect or @register_sensor"
        )
    _loaded[os.fspath(path.resolve()) if path.suffix == ".py" else name] = None
    return found


def _imported(name: str, module: str, folder: Path) -> ModuleType:
    """Return the module of a plug-in, found in a folder if nowhere else on Python's path."""
    # After all other places, as modules of the same name there have precedence.
    sys.path.append(os.fspath(folder))
    importlib.invalidate_caches()
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not (module == error.name or module.startswith(error.name + ".")):
            raise BadInputError(
                f"plugin {name!r} needs the module {error.name!r}, which is not installed"
            ) from error
        raise BadInputError(
            f"plugin {name!r}: no such module; expected the name of an installed one, or "
            "a file such as my_effects.py"
        ) from None
    except SystemExit as error:
        raise BadInputError(
            f"plugin {name!r} ends the program (SystemExit: {error}); expected a module that only "
            "registers classes"
        ) from error
    except Exception as error:
        raise BadInputError(f"plugin {name!r} fails: {type(error).__name__}: {error}") from error
    finally:
        sys.path.remove(os.fspath(folder))


def loaded_plugins() -> tuple[str, ...]:
    """Return the modules loaded by :func:`load_plugin`, as names for loading them in another
    process.
    """
    return tuple(_loaded)


def of_moved_module(old: str, *new: str) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a module whose names moved to other modules: plugins that
    import it work for one more release, with a warning.

    Args:
        old: the module.
        new: where its names are now.
    """

    def find(name: str) -> Any:
        for place in new:
            module = importlib.import_module(place)
            if hasattr(module, name):
                warnings.warn(
                    f"{old}.{name} is now {place}.{name}", DeprecationWarning, stacklevel=2
                )
                return getattr(module, name)
        raise AttributeError(f"module {old!r} has no attribute {name!r}")

    return find
