"""OpenCV's FileStorage, in YAML, XML or JSON, as plain values and arrays."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from pincal.errors import MeasurementError

TAG = "tag:yaml.org,2002:opencv-matrix"
"""The tag of a matrix in YAML."""
# The line by which OpenCV's YAML begins, which is no directive of YAML.
_FIRST = re.compile(rb"\A(?:\xef\xbb\xbf)?%YAML:\S*[^\n]*\n")
# Number of channels of a matrix, and their type: ``3d``.
_TYPE = re.compile(r'"?(\d*)[ucwsifdh]"?')


def is_storage(head: bytes) -> bool:
    """Return whether a file begins as OpenCV's XML."""
    return b"<opencv_storage" in head


def without_directive(text: bytes) -> bytes:
    """Return YAML as others write it, with as many lines."""
    return _FIRST.sub(b"\n", text)


def with_arrays(value: Any) -> Any:
    """Return plain values with their matrices as arrays; nested ones likewise.

    Example:
        >>> with_arrays({"t": {"rows": 1, "cols": 3, "dt": "d", "data": [1, 2, 3]}})["t"].tolist()
        [[1.0, 2.0, 3.0]]
    """
    if isinstance(value, list):
        return [with_arrays(inner) for inner in value]
    if not isinstance(value, Mapping):
        return value
    if {"rows", "cols", "dt", "data"} <= value.keys():
        return matrix(value)
    return {name: with_arrays(inner) for name, inner in value.items()}


def matrix(stated: Mapping[str, Any]) -> np.ndarray:
    """Return a matrix of rows, columns, type and data, shape (rows, cols) or with channels.

    Raises:
        MeasurementError: if these contradict each other.
    """
    kind = _TYPE.fullmatch(str(stated["dt"]))
    try:
        size = (int(stated["rows"]), int(stated["cols"]))
        channels = int(kind[1] or 1) if kind else 1
        values = np.array(stated["data"], float)
        return values.reshape(size if channels == 1 else (*size, channels))
    except (TypeError, ValueError, KeyError) as error:
        raise MeasurementError(
            f"a matrix of OpenCV has {stated.get('rows')} rows and {stated.get('cols')} columns, "
            "and other data; expected as many numbers"
        ) from error


def read_xml(path: Path) -> Any:
    """Return the values of OpenCV's XML.

    Raises:
        MeasurementError: for text that is not XML, or declares entities.
    """
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False
    )
    try:
        root = etree.fromstring(path.read_bytes(), parser)
    except etree.XMLSyntaxError as error:
        raise MeasurementError(
            f"{path.name}: not XML ({error}); expected what OpenCV's FileStorage writes"
        ) from error
    return _value(root)


def _value(element: Any) -> Any:
    """Return the value of an element: a matrix, a mapping, a list, a number or text."""
    children = [child for child in element if isinstance(child.tag, str)]
    if element.get("type_id") == "opencv-matrix":
        stated = {child.tag: (child.text or "").strip() for child in children}
        return matrix(stated | {"data": stated.get("data", "").split()})
    if children and all(child.tag == "_" for child in children):
        return [_value(child) for child in children]
    if children:
        return {child.tag: _value(child) for child in children}
    text = (element.text or "").strip()
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return text
    return numbers[0] if len(numbers) == 1 else numbers or text
