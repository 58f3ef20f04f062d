"""The order of the packages: each imports only what stands below it."""

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from trees import nodes

import pincal

PACKAGE = Path(pincal.__file__).resolve().parent
# The kernel from the bottom up; a layer imports itself and what stands before it.
LAYERS = (
    "thresholds",
    "errors",
    "atomic",
    "plugins",
    "satellites",
    "spread",
    "compiled",
    "units",
    "notes",
    "identity",
    "hypotheses",
    "result_table",
    "parameters",
    "recorded",
    "robot",
    "model",
    "sensors",
    "measure",
    "identify",
    "validate",
    "io",
    "calibration",
    "schemas",
    "report",
    "compensate",
    "export",
    "cli",
    "__main__",
)
# What stands on the kernel, and which the kernel never imports: it hands in its verbs and whatever else the kernel has
# a place for. Each imports the kernel but its command line, and the satellites before it; its own ``cli`` also imports
# the kernel's.
SATELLITES = (
    "readers",
    "motion",
    "programs",
    "discover",
    "diagnosis",
    "design",
    "fleet",
    "viewer",
    "features",
    "simulate",
    "certificate",
    "acceptance",
    "demo",
)
# Two layers that know nothing of each other.
SIBLINGS = {"model", "measure"}
# What stands beside the layers, and what it may import: machines of the simulator share no code with the model.
ASIDE = {
    "builtin": {"errors"},
    "simulate": {"errors", "builtin", "measure"},
}
HEAVY = (
    "pinocchio",
    "numba",
    "scipy",
    "polars",
    "matplotlib",
    "meshcat",
    "trimesh",
    "example_robot_data",
    "yourdfpy",
    "lark",
)


def modules() -> dict[str, Path]:
    """Return the files of the package by the dotted names of their modules."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def nodes_of(module: str) -> tuple[ast.AST, ...]:
    """Return all nodes of what a module says."""
    return nodes(MODULES[module].read_text(encoding="utf-8"))


@cache
def imports(module: str) -> set[str]:
    """Return the modules of pincal that a module imports, within functions and for type checkers, too."""
    found: set[str] = set()
    for node in nodes_of(module):
        if isinstance(node, ast.Import):
            found.update(name for alias in node.names for name in _prefixes(alias.name))
        elif isinstance(node, ast.ImportFrom):
            source = _absolute(module, node)
            found.update(_prefixes(source))
            found.update(f"{source}.{alias.name}" for alias in node.names)
    return (found & MODULES.keys()) - {"pincal", module}


def _prefixes(name: str) -> Iterator[str]:
    parts = name.split(".")
    return (".".join(parts[:count]) for count in range(1, len(parts) + 1))


def _absolute(module: str, node: ast.ImportFrom) -> str:
    if node.level == 0:
        return node.module or ""
    package = module.split(".") if MODULES[module].name == "__init__.py" else module.split(".")[:-1]
    kept = package[: len(package) - node.level + 1]
    return ".".join([*kept, *([node.module] if node.module else [])])


def layer(module: str) -> str:
    """Return the layer of a module: the name next to pincal, and of a satellite whether it is of its command line."""
    _, name, *inner = module.split(".")
    is_command_line = name in SATELLITES and inner[:1] in (["cli"], ["satellite"])
    return f"{name}.cli" if is_command_line else name


def may_import(importer: str, imported: str) -> bool:
    """Return whether one layer may import another."""
    satellite, _, is_command_line = importer.partition(".")
    other, _, is_of_command_line = imported.partition(".")
    if importer == imported or imported == "builtin":
        return True
    if {importer, imported} == SIBLINGS:
        return False
    if importer in ASIDE:
        return imported in ASIDE[importer]
    if satellite not in SATELLITES:
        return other in LAYERS and LAYERS.index(imported) < LAYERS.index(importer)
    if other in LAYERS:
        return imported not in ("cli", "__main__") or bool(is_command_line)
    if satellite == other:
        return bool(is_command_line)
    is_below = SATELLITES.index(other) < SATELLITES.index(satellite)
    return is_below and (bool(is_command_line) or not is_of_command_line)


INNER = sorted(MODULES.keys() - {"pincal"})


def test_every_module_has_a_layer() -> None:
    """A module has its place in the table."""
    assert [module for module in INNER if layer(module).partition(".")[0] not in (*LAYERS, *ASIDE, *SATELLITES)] == []


def test_imports_point_downwards() -> None:
    """No module imports anything from above it."""
    upwards = {
        f"{module} imports {name}"
        for module in INNER
        for name in imports(module)
        if not may_import(layer(module), layer(name))
    }

    assert upwards == set()


def test_imports_form_no_cycle() -> None:
    """The modules can be put in an order in which each comes after all that it imports."""
    # A package whose __init__ re-exports is imported with each of its modules; this is no cycle of their contents.
    packages = {name for name in INNER if MODULES[name].name == "__init__.py"}
    graph = {name: imports(name) - {p for p in packages if name.startswith(p + ".")} for name in INNER}
    try:
        order = list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))

    assert set(order) == set(INNER)


def test_import_of_the_package_is_light() -> None:
    """``import pincal`` loads none of the large libraries: they are imported where they are needed."""
    code = f"import sys, pincal; print([name for name in {HEAVY!r} if name in sys.modules])"
    paths = [str(PACKAGE.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)

    assert run.stdout.strip() == "[]"


def test_the_table_of_layers_forbids_what_it_should() -> None:
    """The rule itself: downwards yes, upwards no, the simulator only for commands, no satellite for the kernel."""
    assert may_import("model", "robot") and may_import("cli", "identify") and may_import("robot", "errors")
    assert not may_import("robot", "model") and not may_import("measure", "identify")
    assert not may_import("measure", "model") and not may_import("model", "measure")
    assert may_import("simulate.cli", "simulate") and not may_import("identify", "simulate")
    assert may_import("simulate", "measure") and not may_import("simulate", "model")
    assert may_import("robot", "builtin") and not may_import("builtin", "robot")
    assert may_import("discover", "report") and not may_import("report", "discover")
    assert may_import("fleet", "discover") and not may_import("discover", "fleet") and not may_import("cli", "fleet")
    assert may_import("discover.cli", "cli") and not may_import("discover", "cli")
    assert may_import("demo.cli", "discover.cli") and not may_import("discover", "discover.cli")
