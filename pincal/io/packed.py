r"""Large matrices as text: their 64-bit words byte by byte of equal weight, deflated, in base64.

A matrix comes back to the last bit. The covariance of many parameters is written as whole multiples of the power of two

.. math:: 2^{e_i + e_j - 50}, \qquad \sigma_i = m \, 2^{e_i}, \quad 1/2 \le m < 1,

and its lower half only, since half of its numbers are nothing but the rounding of its computation: 17 MB as lists of numbers
are 1.7 MB so. An entry is off by at most :math:`2^{-49} \sigma_i \sigma_j`, predictions' standard deviations of a UR10 with
850 parameters by 5e-10 of themselves.
"""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np

from pincal.io.strict_json import Fault

# Covariances of so many parameters are written to the last bit: that is less than 1 MB.
_MOST_EXACT = 300
# A larger one is none that pincal wrote.
_MOST_ROWS = 1500
_BITS = 50
_COVARIANCE, _MATRIX = "covariance:", "matrix:"
_EXPECTED = "a matrix, as lists of numbers or as pincal packs it"


def packed_matrix(matrix: np.ndarray) -> Any:
    """Return a matrix as text, to the last bit; as lists where it is empty or its numbers aren't finite."""
    if matrix.size == 0 or not np.isfinite(matrix).all():
        return matrix.tolist()
    words = np.ascontiguousarray(matrix, "<f8").view("<u8").ravel()
    return _MATRIX + _text(np.append(np.uint64(len(matrix)), words))


def packed_covariance(covariance: np.ndarray) -> Any:
    """Return a covariance as text, a large one to the rounding that the module's docstring tells."""
    n, sigma = len(covariance), np.sqrt(np.maximum(np.diag(covariance), 0.0))
    mean = 0.5 * (covariance + covariance.T)
    if n <= _MOST_EXACT or n > _MOST_ROWS or not (np.abs(mean) <= 2.0 * np.outer(sigma, sigma)).all():
        return packed_matrix(covariance)
    exponents = np.frexp(sigma)[1].astype("<i8")
    lower = np.tril_indices(n)
    units = np.rint(np.ldexp(mean[lower], _BITS - exponents[lower[0]] - exponents[lower[1]])).astype("<i8")
    words = np.concatenate([exponents, units])
    # The sign comes last, so that the leading bytes of small numbers are zero.
    return _COVARIANCE + _text(((words << 1) ^ (words >> 63)).view("<u8"))


def unpacked(text: str, most: int) -> np.ndarray:
    """Return the matrix that a text holds.

    Args:
        text: as the functions above return it.
        most: bytes that it may take.

    Raises:
        Fault: if it holds none, or a larger one.
    """
    kind = next((kind for kind in (_COVARIANCE, _MATRIX) if text.startswith(kind)), None)
    if kind is None:
        raise Fault("has entries that are no finite numbers", "an array of numbers")
    words = _words(text.removeprefix(kind), most)
    found = _covariance(words) if kind == _COVARIANCE else _matrix(words)
    if found is None or not np.isfinite(found).all():
        raise Fault("is cut off or damaged", _EXPECTED)
    return found


def _matrix(words: np.ndarray) -> np.ndarray | None:
    rows, values = (int(words[0]), words[1:].view("<f8")) if len(words) else (0, words)
    return values.reshape(rows, -1).astype(float) if rows and len(values) and len(values) % rows == 0 else None


def _covariance(words: np.ndarray) -> np.ndarray | None:
    # n exponents, and n (n + 1) / 2 entries.
    n = int((np.sqrt(9.0 + 8.0 * len(words)) - 3.0) / 2.0)
    if not 0 < n <= _MOST_ROWS or n * (n + 3) != 2 * len(words):
        return None
    numbers = (words >> np.uint64(1)).view("<i8") ^ -(words & np.uint64(1)).view("<i8")
    exponents, (i, j) = np.clip(numbers[:n], -600, 600), np.tril_indices(n)
    found = np.empty((n, n))
    found[i, j] = np.ldexp(numbers[n:].astype(float), exponents[i] + exponents[j] - _BITS)
    found[j, i] = found[i, j]
    return found


def _text(words: np.ndarray) -> str:
    planes = words.view(np.uint8).reshape(-1, 8).T.tobytes()
    return base64.b64encode(zlib.compress(planes)).decode()


def _words(text: str, most: int) -> np.ndarray:
    """Return what :func:`_text` was given."""
    unpacking = zlib.decompressobj()
    try:
        planes = unpacking.decompress(base64.b64decode(text, validate=True), most)
    except (ValueError, zlib.error):
        raise Fault("is cut off or damaged", _EXPECTED) from None
    if not unpacking.eof or unpacking.unused_data or len(planes) % 8:
        raise Fault("is cut off or damaged", _EXPECTED)
    return np.frombuffer(planes, np.uint8).reshape(8, -1).T.copy().view("<u8").ravel()
