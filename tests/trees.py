"""Source files as trees of their syntax."""

import ast
import gc
from functools import cache


@cache
def parsed(text: str) -> ast.Module:
    """Return what a source says, parsed once for all rules.

    Its nodes are many, and all of them stay: to look for some to be freed meanwhile took two thirds of the time, and to
    look through them later would take that of tests which measure it.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        return ast.parse(text)
    finally:
        gc.freeze()
        if was_enabled:
            gc.enable()


@cache
def nodes(text: str) -> tuple[ast.AST, ...]:
    """Return all nodes of what a source says, walked once for all rules."""
    return tuple(ast.walk(parsed(text)))
