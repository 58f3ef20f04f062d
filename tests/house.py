"""How large the library is and how its rooms are kept: ``python tests/house.py [PACKAGE]``.

Lines are divided into docstrings, imports, comments, blank ones and code, which is all else; a line of code with a comment
behind it is code.
"""

from __future__ import annotations

import ast
import io
import statistics
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from trees import nodes, parsed

LAYOUT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
KINDS = ("code", "imports", "docstrings", "comments", "blank")
# Arguments from which a function has too many, and lines from which on its body is too long.
MANY_ARGUMENTS = 8
LONG_BODY = 31

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class File:
    """One file of a package: its dotted name within the package, and its text."""

    name: str
    text: str
    is_package: bool = False

    @cached_property
    def tree(self) -> ast.Module:
        """The parsed file."""
        return parsed(self.text)

    @property
    def room(self) -> str:
        """The folder or the single file beside the folders."""
        return self.name.split(".")[0]

    @property
    def has_moved(self) -> bool:
        """Whether only its former name is left, for one release."""
        return "__getattr__ = of_moved_module(" in self.text

    @property
    def is_satellite(self) -> bool:
        """Whether it says what a satellite hands in; each has the same name for it."""
        return self.name.endswith(".satellite")

    @cached_property
    def lines(self) -> Counter[str]:
        """Number of lines of each kind."""
        kinds = ["blank"] * len(self.text.splitlines())
        for token in tokenize.generate_tokens(io.StringIO(self.text).readline):
            if token.type == tokenize.COMMENT and kinds[token.start[0] - 1] == "blank":
                kinds[token.start[0] - 1] = "comments"
            elif token.type not in LAYOUT:
                for row in range(token.start[0] - 1, token.end[0]):
                    kinds[row] = "code"
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Import | ast.ImportFrom):
                kinds[node.lineno - 1 : node.end_lineno] = ["imports"] * ((node.end_lineno or 0) - node.lineno + 1)
            elif (text := _docstring(node)) is not None:
                kinds[text.lineno - 1 : text.end_lineno] = ["docstrings"] * ((text.end_lineno or 0) - text.lineno + 1)
        return Counter(kinds)

    @cached_property
    def functions(self) -> list[Function]:
        """All functions and methods."""
        return [node for node in nodes(self.text) if isinstance(node, Function)]

    @cached_property
    def public_names(self) -> set[str]:
        """What the file defines at its top without a leading underscore; every file may have a ``log``."""
        found = set()
        for node in self.tree.body:
            if isinstance(node, ast.ClassDef | Function):
                found.add(node.name)
            elif isinstance(node, ast.Assign):
                found |= {target.id for target in node.targets if isinstance(target, ast.Name)} - {"log"}
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                found.add(node.target.id)
        return {name for name in found if not name.startswith("_")}

    @cached_property
    def numbers(self) -> list[str]:
        """Constants at the top of the file that are numbers, or tuples of them, unless they are said to decide nothing."""
        found = []
        for node in self.tree.body:
            if isinstance(node, ast.AnnAssign) and node.value is not None and _is_number(node.value):
                kinds = {of.id for of in ast.walk(node.annotation) if isinstance(of, ast.Name)}
                found += [ast.unparse(node.target)] if kinds.isdisjoint({"Count", "Scale"}) else []
            if isinstance(node, ast.Assign) and _is_number(node.value):
                for target in node.targets:
                    found += [name.id for name in ast.walk(target) if isinstance(name, ast.Name)]
        return found


def _docstring(node: ast.AST) -> ast.Expr | None:
    if isinstance(node, ast.Module | ast.ClassDef | Function) and node.body:
        first = node.body[0]
        if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
            return first
    return None


def _is_number(node: ast.expr) -> bool:
    if isinstance(node, ast.Tuple):
        return all(_is_number(inner) for inner in node.elts)
    if isinstance(node, ast.BinOp):
        return _is_number(node.left) and _is_number(node.right)
    if isinstance(node, ast.UnaryOp):
        return _is_number(node.operand)
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool)


def body_lines(function: Function) -> int:
    """Return how many lines the body of a function has, its docstring left out."""
    body = function.body[1:] if _docstring(function) is not None else function.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def is_parallel(node: ast.AST) -> bool:
    """Return whether a statement assigns several expressions at once, also in an arm of a condition; swaps do not count."""
    if not (isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple)):
        return False
    arms = [node.value.body, node.value.orelse] if isinstance(node.value, ast.IfExp) else [node.value]
    names = sorted(map(ast.unparse, node.targets[0].elts))
    return any(isinstance(arm, ast.Tuple) and sorted(map(ast.unparse, arm.elts)) != names for arm in arms)


def arguments(function: Function) -> int:
    """Return how many arguments a function takes, self and cls left out."""
    taken = [arg.arg for arg in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)]
    return len([name for name in taken if name not in ("self", "cls")])


@dataclass(frozen=True)
class House:
    """All files of a package."""

    files: tuple[File, ...]

    @classmethod
    def at(cls, package: Path) -> House:
        """Return the files of a folder."""
        files = []
        for path in sorted(package.rglob("*.py")):
            parts = path.relative_to(package).with_suffix("").parts
            is_package = parts[-1] == "__init__"
            name = ".".join(parts[:-1] if is_package else parts) or package.name
            files.append(File(name, path.read_text(encoding="utf-8"), is_package))
        return cls(tuple(files))

    @cached_property
    def lines(self) -> Counter[str]:
        """Number of lines of each kind."""
        return sum((file.lines for file in self.files), Counter())

    @cached_property
    def crowded(self) -> list[str]:
        """Functions that take too many arguments."""
        return [
            f"{file.name}:{function.name}({arguments(function)})"
            for file in self.files
            for function in file.functions
            if arguments(function) >= MANY_ARGUMENTS
        ]

    @cached_property
    def long_bodies(self) -> list[str]:
        """Functions whose bodies are too long."""
        return [
            f"{file.name}:{function.name}({body_lines(function)})"
            for file in self.files
            for function in file.functions
            if body_lines(function) >= LONG_BODY
        ]

    @cached_property
    def parallel(self) -> list[str]:
        """Assignments of several expressions at once."""
        return [f"{file.name}:{ast.unparse(node)}" for file in self.files for node in nodes(file.text) if is_parallel(node)]

    @cached_property
    def twice_defined(self) -> dict[str, list[str]]:
        """Public names that more than one file defines, the simulator's left out: it may know nothing of the others."""
        homes: dict[str, list[str]] = {}
        for file in self.files:
            if file.room != "simulate" and not file.is_satellite:
                for name in file.public_names:
                    homes.setdefault(name, []).append(file.name)
        return {name: found for name, found in sorted(homes.items()) if len(found) > 1}

    @cached_property
    def twice_named(self) -> dict[str, list[str]]:
        """Names of files that more than one room has, those of the simulator, of satellites and former names left out."""
        homes: dict[str, list[str]] = {}
        for file in self.files:
            is_special = file.is_package or file.is_satellite or file.has_moved
            if not is_special and file.room not in ("simulate", "__main__"):
                homes.setdefault(file.name.rsplit(".", 1)[-1], []).append(file.name)
        return {name: found for name, found in sorted(homes.items()) if len(found) > 1}

    def report(self) -> Iterator[str]:
        """Yield what a person asks of it, in lines."""
        sizes = sorted(file.lines.total() for file in self.files)
        yield f"{len(self.files)} files, {self.lines.total()} lines: " + ", ".join(f"{k} {self.lines[k]}" for k in KINDS)
        long = [f"{file.name} {file.lines.total()}" for file in self.files if file.lines.total() >= 400]
        yield f"lines of a file: median {statistics.median(sizes):.0f}, most {sizes[-1]}; from 400 on: {', '.join(long)}"
        rooms: dict[str, list[int]] = {}
        for file in self.files:
            rooms.setdefault(file.room, []).append(file.lines.total())
        yield "rooms (files, lines): " + ", ".join(f"{room} {len(own)} {sum(own)}" for room, own in sorted(rooms.items()))
        bodies = sorted(len(file.functions) for file in self.files)
        crowded = ", ".join(self.crowded)
        yield f"{sum(bodies)} functions; {len(self.crowded)} with {MANY_ARGUMENTS} arguments or more: {crowded}"
        yield f"{len(self.long_bodies)} bodies of {LONG_BODY} lines or more: {', '.join(self.long_bodies)}"
        yield f"{len(self.parallel)} assignments of several expressions at once"
        yield f"{len(self.twice_defined)} public names in more than one file: {_homes(self.twice_defined)}"
        yield f"{len(self.twice_named)} names of files in more than one room: {_homes(self.twice_named)}"
        numbers = {file.name: file.numbers for file in self.files if file.room == "discover" and file.numbers}
        yield f"numbers at the top of discover's files: {_homes(numbers)}"


def _homes(found: dict[str, list[str]]) -> str:
    return "; ".join(f"{name}: {' '.join(homes)}" for name, homes in found.items()) or "none"


def main(chosen: Sequence[str]) -> None:
    """Print what is known of a package; default: pincal beside this file's folder."""
    package = Path(chosen[0]) if chosen else Path(__file__).parents[1] / "pincal"
    print("\n".join(House.at(package).report()))


if __name__ == "__main__":
    main(sys.argv[1:])
