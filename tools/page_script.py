"""Make the readers of controller programs in JavaScript, for the page that corrects programs.

``python tools/page_script.py`` writes them to ``pincal/programs/page/readers.js``: the grammars of
all languages as tables, and the modules of :mod:`pincal.programs` translated. A test makes them
anew and compares.
"""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

from pincal.io.strict_json import in_script
from pincal.programs.language import LANGUAGES
from pincal.programs.syntax import parser_of

from python_to_js import Translator, as_text

SCRIPT = Path(__file__).parents[1] / "pincal" / "programs" / "page" / "readers.js"
_HEADER = "// Made of the modules of pincal/programs by tools/page_script.py."

# Modules in the order of their dependencies; the languages come after them.
_MODULES = (
    "syntax",
    "understood",
    "flow",
    "line_flow",
    "program",
    "draft",
    "statement_reader",
    "language",
    "fanuc_lines",
    "jbi_lines",
    "rapid_blocks",
)
# What the page implements itself: files, lark, arrays of numbers, and what only the command needs.
_OWN = frozenset(
    (
        "Source",
        "Token",
        "_Nesting",
        "parser_of",
        "TYPE_CHECKING",
        "spliced",
        "Frame.__eq__",
        "Frame.__hash__",
        "ControllerLanguage.pose",
        "ControllerLanguage.is_pose",
        "ControllerLanguage.numbers",
        "ControllerLanguage.frame",
        "ControllerLanguage.joint_units",
        "ControllerLanguage._by_axis",
        "Jbi.joint_units",
        "LANGUAGES",
        "language_of",
        "files_of",
        "read_sources",
        "_nearest_angles",
        "Point.values",
    )
)


def programs_in_js() -> str:
    """Return the readers of all languages of pincal as JavaScript, to be placed after
    ``programs.js``.
    """
    known = [
        cls for cls in LANGUAGES.known().values() if cls.__module__.startswith("pincal.programs.")
    ]
    names = [*_MODULES, *(cls.__module__.rpartition(".")[2] for cls in known)]
    texts = {
        name: files("pincal.programs").joinpath(f"{name}.py").read_text("utf-8") for name in names
    }
    tables = (
        f"GRAMMARS[{as_text(grammar)}] = {grammar_table(grammar)};"
        for cls in known
        for grammar in cls.grammars
    )
    return "\n".join(("const GRAMMARS = {};", *tables, Translator(skip=_OWN).translate(texts)))


def grammar_table(grammar: str) -> str:
    """Return the LALR table of a grammar as JSON: patterns of terminals, when they are tried, and
    their actions.
    """
    front = parser_of(grammar).parser
    table: Any = front.parser._parse_table
    lexers = front.lexer.lexers
    names = list[str]()
    patterns = list[str]()
    rules = list[Any]()
    hidden = set[str]()
    places: dict[Any, int] = {}
    states = []
    # The parser numbers its states by the iteration order of sets, which differs between processes;
    # here states are numbered as they are reached.
    reached = [table.start_states["start"]]
    for number in reached:
        actions = {}
        for symbol, (action, argument) in sorted(table.states[number].items()):
            if action.name == "Shift":
                if argument not in reached:
                    reached.append(argument)
                actions[str(symbol)] = [0, reached.index(argument)]
                continue
            if argument not in places:
                places[argument] = len(rules)
                origin = str(argument.origin.name)
                rules.append([origin, len(argument.expansion), str(argument.alias or origin)])
                hidden |= {
                    str(part.name)
                    for part in argument.expansion
                    if getattr(part, "filter_out", False)
                }
            actions[str(symbol)] = [1, places[argument]]
        tried = []
        if number in lexers:
            for terminal in lexers[number].scanner.terminals:
                if terminal.name not in names:
                    names.append(terminal.name)
                    patterns.append(_pattern(terminal.pattern.to_regexp()))
                tried.append(names.index(terminal.name))
        states.append({"actions": actions, "tried": tried})
    ignored = sorted(next(iter(lexers.values())).ignore_types)
    content = {"start": 0, "names": names, "terminals": patterns, "rules": rules, "states": states,
               "hidden": sorted(hidden), "ignored": ignored}  # fmt: skip
    return in_script(json.dumps(content))


def _pattern(pattern: str) -> str:
    r"""Return a pattern for JavaScript, where ``\s`` and ``\w`` match other characters beyond
    ASCII.
    """
    spaces = "".join(chr(k) for k in range(256) if chr(k).isspace())
    letters = "0-9A-Z_a-z" + "".join(chr(k) for k in range(128, 256) if chr(k).isalnum())
    return pattern.replace("\\s", spaces).replace("\\w", letters)


def script() -> str:
    """Return the file of the package."""
    return f"{_HEADER}\n{programs_in_js()}"


if __name__ == "__main__":
    SCRIPT.write_text(script(), encoding="utf-8")
