"""URDFs that are written as xacro, expanded by xacrodoc: an extra, as only some users have such files."""

from __future__ import annotations

import contextlib
import io
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lxml import etree

from pincal.errors import PincalWarning, RobotFileError, nearest_first
from pincal.robot.packages import packages_beside

_NAMESPACE = "xacro"
# Longest part of an error of xacro that is passed on: it lists every macro on the way.
_LONGEST = 600


def is_xacro(text: bytes) -> bool:
    """Return whether a file has something that xacro has to expand; a declared namespace alone is none."""
    try:
        root = etree.fromstring(text, etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False))
    except etree.XMLSyntaxError:
        return False
    return any(_NAMESPACE in (etree.QName(element).namespace or "") for element in root.iter(etree.Element))


def expand_xacro(path: Path, text: bytes, arguments: Mapping[str, str]) -> bytes:
    """Return the URDF that a xacro file expands to; ``$(find NAME)`` and includes are found in the packages around it.

    Args:
        path: the file.
        text: what it holds.
        arguments: values of its arguments, as ``xacro FILE name:=value`` takes them.

    Raises:
        RobotFileError: if xacrodoc is not installed, or the file can't be expanded or describes no robot.
    """
    known = _arguments_of(text)
    unknown = [name for name in arguments if name not in known]
    if unknown:
        takes = f"those that it has: {', '.join(nearest_first(unknown, known))}" if known else "it has none of its own"
        warnings.warn(f"{path}: does not declare the xacro argument {unknown[0]!r}; {takes}", PincalWarning, stacklevel=2)
    # The name of the robot may use an argument before the line that gives its default.
    literal = {name: value for name, value in known.items() if value is not None and "$" not in value}
    dom = _expanded(path, literal | dict(arguments), known)
    if not dom.getElementsByTagName("link"):
        others = (file for file in sorted(path.parent.glob("*.xacro")) if file != path and os.access(file, os.R_OK))
        users = [file.name for file in others if file.is_file() and os.fsencode(path.name) in file.read_bytes()]
        use = " or ".join(users) or "the file that includes it"
        raise RobotFileError(f"{path}: expands to no link, as it only defines macros; expected {use}")
    return bytes(dom.toxml(encoding="utf-8"))


def _expanded(path: Path, values: Mapping[str, str], known: Mapping[str, str | None]) -> Any:
    try:
        import xacro
        import xacrodoc
    except ImportError:
        raise RobotFileError(
            f"{path}: is a xacro file, and xacrodoc, which reads it, is not installed; "
            "install it (pip install 'pincal[xacro]'), or expand the file with xacro first"
        ) from None
    xacrodoc.packages.update_package_cache(packages_beside(path))
    # Includes are relative to the file that has them; xacrodoc hands xacro the text alone, for which that is the working
    # folder, or the file at which an earlier expansion failed.
    xacro.init_stacks(os.fspath(path.absolute()))
    try:
        # Warnings of xacro are about its own history, such as the order of evaluation.
        with contextlib.redirect_stderr(io.StringIO()):
            document = xacrodoc.XacroDoc.from_file(path, walk_up=False, subargs=dict(values), resolve_packages=False)
    except (Exception, SystemExit) as error:  # Expressions in the file fail in every way there is.
        reason = " ".join(str(error).split())[:_LONGEST] or type(error).__name__
        listed = ", ".join(f"{name}:={values[name]}" if name in values else name for name in known)
        takes = f"; its arguments, to be set by --xacro-arg NAME:=VALUE: {listed}" if known else ""
        raise RobotFileError(f"{path}: xacro can't expand it ({reason}){takes}") from None
    return document.dom


def _arguments_of(text: bytes) -> dict[str, str | None]:
    """Return the arguments that a file declares, with their defaults."""
    root = etree.fromstring(text, etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False))
    declared = [element for element in root.iter("{*}arg") if _NAMESPACE in (etree.QName(element).namespace or "")]
    return {element.get("name", ""): element.get("default") for element in declared}
