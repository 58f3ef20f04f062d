r"""Arrays in files: lists of numbers whose shape and values are validated on reading.

A field declares its shape by an :class:`ArrayShape` in its annotation. A name in it is a count that
has to agree within one structure; the first field with the name determines it.

Large matrices are text: their 64-bit words, transposed to bytes of equal weight, deflated, in
base64. A matrix is restored to the last bit; of a large one that is symmetric only the lower half
is written. The covariance of many parameters is written as integer multiples of the power of two

.. math:: 2^{e_i + e_j - 50}, \qquad \sigma_i = m \, 2^{e_i}, \quad 1/2 \le m < 1,

and also only its lower half, as the digits beyond are rounding of its computation: 17 MB as lists
of numbers become 1.7 MB. The error of an entry is at most :math:`2^{-49} \sigma_i \sigma_j`; for a
UR10 with 850 parameters, standard deviations of predictions have relative errors of 5e-10.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from itertools import chain
from typing import Annotated, Any, Self, get_args, get_type_hints

import msgspec
import numpy as np

from pincal.io.file_numbers import IN_FILES
from pincal.io.strict_json import Fault
from pincal.robot.se3 import are_rotations
from pincal.thresholds import Count

_NUMBERS = {float, int, type(None)}


class ArrayShape:
    """The shape of an array, or the length of a list, and conditions on its values.

    Attributes:
        sizes: along each axis: a number, the name of a count shared with other fields, or "any".
        check: raises :class:`Fault` for invalid values.
        write: returns the representation of the array in a file; default: nested lists.
        null: the number that is null in a file; default: null is refused.
    """

    def __init__(
        self,
        *sizes: int | str,
        check: Callable[[np.ndarray], None] | None = None,
        write: Callable[[np.ndarray], Any] = np.ndarray.tolist,
        null: float | None = None,
    ) -> None:
        self.sizes = sizes
        self.check = check
        self.write = write
        self.null = null

    def expected(self, counts: Mapping[str, int]) -> tuple[int | None, ...]:
        """Return the known sizes, None for others."""
        return tuple(counts.get(size) if isinstance(size, str) else size for size in self.sizes)


def _check_rotations(found: np.ndarray) -> None:
    if not are_rotations(found, tolerance=IN_FILES.rotation):
        raise Fault("is not a rotation", "orthonormal rows of a right-handed system")


def _check_transforms(found: np.ndarray) -> None:
    last = found[..., 3, :]
    if (
        not are_rotations(found[..., :3, :3], tolerance=IN_FILES.transform)
        or not (last == [0.0, 0.0, 0.0, 1.0]).all()
    ):
        raise Fault(
            "is not a rigid transform", "4 rows of 4, rotation and metres, the last row 0 0 0 1"
        )


def _numbers(depth: int, *, null: bool = False) -> msgspec.Meta:
    """Return the JSON Schema of numbers nested ``depth`` deep."""
    schema: dict[str, Any] = {"type": ["number", "null"] if null else "number"}
    for _ in range(depth):
        schema = {"type": "array", "items": schema}
    return msgspec.Meta(extra_json_schema=schema)


# Arrays of one and two dimensions, without a shape.
Numbers = Annotated[np.ndarray, _numbers(1)]
Matrix = Annotated[np.ndarray, _numbers(2)]
# Matrices that are written as text.
_AS_TEXT = msgspec.Meta(
    extra_json_schema={"anyOf": [_numbers(2).extra_json_schema, {"type": "string"}]}
)
Packed = Annotated[np.ndarray, _AS_TEXT]
# Limits, with null for none.
LimitNumbers = Annotated[np.ndarray, _numbers(1, null=True)]
Vector = Annotated[np.ndarray, _numbers(1), ArrayShape(3)]
Rotation = Annotated[np.ndarray, _numbers(2), ArrayShape(3, 3, check=_check_rotations)]
Rotations = Annotated[np.ndarray, _numbers(3), ArrayShape("targets", 3, 3, check=_check_rotations)]
Transform = Annotated[np.ndarray, _numbers(2), ArrayShape(4, 4, check=_check_transforms)]
BranchTransforms = Annotated[np.ndarray, _numbers(3)]
Transforms = Annotated[np.ndarray, _numbers(3), ArrayShape("joints", 4, 4, check=_check_transforms)]


class Record(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A structure of a file whose arrays have the shapes declared by their annotations.

    Unknown keys are ignored, so that later versions can add some; optional ones are omitted where
    absent.
    """

    @classmethod
    def like(cls, found: object, **others: Any) -> Self:
        """Return the record of an object with the same fields as attributes, except for
        ``others``.
        """
        same = {name: getattr(found, name) for name in cls.__struct_fields__ if name not in others}
        return cls(**same | others)

    def written(self, name: str) -> Any:
        """Return the representation of one of its arrays in a file."""
        shape = dict(_declared(type(self))).get(name, ArrayShape())
        value = getattr(self, name)
        if shape.null is not None:
            return [number if np.isfinite(number) else None for number in value.tolist()]
        return shape.write(value)

    def __post_init__(self) -> None:
        counts: dict[str, int] = {}
        for name, shape in _declared(type(self)):
            value = getattr(self, name)
            if isinstance(value, np.ndarray):
                if np.isnan(value).any():
                    if shape.null is None:
                        raise Fault(
                            "has entries that are not finite numbers",
                            "an array of numbers",
                            key=f".{name}",
                        )
                    value = np.where(np.isnan(value), shape.null, value)
                msgspec.structs.force_setattr(self, name, shaped(f".{name}", value, shape, counts))
            elif value is not None:
                (expected,) = shape.expected(counts)
                if expected not in (None, len(value)):
                    raise Fault(f"has {len(value)} entries", f"{expected}", key=f".{name}")
                counts[str(shape.sizes[0])] = len(value)


def shaped(key: str, value: np.ndarray, shape: ArrayShape, counts: dict[str, int]) -> np.ndarray:
    """Return an array of the right shape, whose counts are added to ``counts``; refuse others with
    a Fault at ``key``.
    """
    expected = shape.expected(counts)
    if value.size == 0 and 0 in expected:
        return np.zeros([size or 0 for size in expected])
    if value.ndim != len(expected) or any(
        size not in (None, n) for size, n in zip(expected, value.shape, strict=True)
    ):
        words = str(tuple("any" if size is None else size for size in expected)).replace("'", "")
        raise Fault(f"has shape {value.shape}", f"numbers of shape {words}", key=key)
    counts.update(
        (size, n) for size, n in zip(shape.sizes, value.shape, strict=True) if isinstance(size, str)
    )
    counts.pop("any", None)
    if shape.check is not None and value.size:
        try:
            shape.check(value)
        except Fault as fault:
            raise Fault(fault.problem, fault.expected, key=key) from None
    return value


def array_of(value: Any) -> np.ndarray:
    """Return nested lists of numbers as an array, with NaN for null.

    Raises:
        Fault: for other values, or rows of unequal length.
    """
    level = [value]
    kinds = {type(value)}
    while kinds == {list}:
        if len(set(map(len, level))) > 1:
            raise Fault("has rows of unequal length", "an array of numbers")
        level = list(chain.from_iterable(level))
        kinds = set(map(type, level))
    with suppress(OverflowError):
        if kinds <= _NUMBERS:
            return np.array(value, float)
    raise Fault("has entries that are not finite numbers", "an array of numbers")


@lru_cache
def _declared(record: type[Record]) -> tuple[tuple[str, ArrayShape], ...]:
    """Return the fields that declare a shape, in their order."""
    hints = get_type_hints(record, include_extras=True)
    found = ((name, _shape_in(hints[name])) for name in record.__struct_fields__)
    return tuple((name, shape) for name, shape in found if shape is not None)


def _shape_in(hint: Any) -> ArrayShape | None:
    """Return the shape in an annotation or in a member of a union."""
    parts = (*getattr(hint, "__metadata__", ()), *(_shape_in(part) for part in get_args(hint)[:2]))
    return next((part for part in parts if isinstance(part, ArrayShape)), None)


# Most parameters whose matrices are written whole, to the last bit, in less than 1 MB.
_MOST_EXACT: Count = 100
# Rows of the largest matrix of which pincal writes a half.
_MOST_ROWS: Count = 2500
_BITS: Count = 50
_COVARIANCE = "covariance:"
_SYMMETRIC = "symmetric:"
_MATRIX = "matrix:"
_EXPECTED = "a matrix, as lists of numbers or as pincal packs it"


def packed_matrix(matrix: np.ndarray) -> Any:
    """Return a matrix as text, to the last bit; as lists where it is empty or its numbers aren't
    finite.
    """
    if matrix.size == 0 or not np.isfinite(matrix).all():
        return matrix.tolist()
    words = np.ascontiguousarray(matrix, "<f8").view("<u8").ravel()
    return _MATRIX + _text(np.append(np.uint64(len(matrix)), words))


def packed_symmetric(matrix: np.ndarray) -> Any:
    """Return a symmetric matrix as text, to the last bit, a large one by its lower half; one that
    is not symmetric as :func:`packed_matrix` does.
    """
    n = len(matrix)
    is_large = _MOST_EXACT < n <= _MOST_ROWS
    if not is_large or not np.isfinite(matrix).all() or not np.array_equal(matrix, matrix.T):
        return packed_matrix(matrix)
    return _SYMMETRIC + _text(np.ascontiguousarray(matrix[np.tril_indices(n)], "<f8").view("<u8"))


def packed_covariance(covariance: np.ndarray) -> Any:
    """Return a covariance as text, a large one rounded as in the docstring of the module."""
    n = len(covariance)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    mean = 0.5 * (covariance + covariance.T)
    if (
        n <= _MOST_EXACT
        or n > _MOST_ROWS
        or not (np.abs(mean) <= 2.0 * np.outer(sigma, sigma)).all()
    ):
        return packed_matrix(covariance)
    exponents = np.frexp(sigma)[1].astype("<i8")
    lower = np.tril_indices(n)
    units = np.rint(
        np.ldexp(mean[lower], _BITS - exponents[lower[0]] - exponents[lower[1]])
    ).astype("<i8")
    words = np.concatenate([exponents, units])
    # With the sign as the last bit, so that the leading bytes of small numbers are zero.
    return _COVARIANCE + _text(((words << 1) ^ (words >> 63)).view("<u8"))


def is_half(text: str) -> bool:
    """Return whether a text holds only the lower half of a matrix."""
    return text.startswith((_COVARIANCE, _SYMMETRIC))


def unpacked(text: str, most: int) -> np.ndarray:
    """Return the matrix in a text, which holds at most so many bytes.

    Raises:
        Fault: for other text, or a larger matrix.
    """
    kind = next((kind for kind in _READ if text.startswith(kind)), None)
    if kind is None:
        raise Fault("has entries that are not finite numbers", "an array of numbers")
    found = _READ[kind](_words(text.removeprefix(kind), most))
    if found is None or not np.isfinite(found).all():
        raise Fault("is truncated or damaged", _EXPECTED)
    return found


def _matrix(words: np.ndarray) -> np.ndarray | None:
    rows, values = (int(words[0]), words[1:].view("<f8")) if len(words) else (0, words)
    return (
        values.reshape(rows, -1).astype(float)
        if rows and len(values) and len(values) % rows == 0
        else None
    )


def _symmetric(words: np.ndarray) -> np.ndarray | None:
    # n (n + 1) / 2 entries.
    n = int((np.sqrt(1.0 + 8.0 * len(words)) - 1.0) / 2.0)
    if not 0 < n <= _MOST_ROWS or n * (n + 1) != 2 * len(words):
        return None
    return _both_halves(words.view("<f8"), n)


def _covariance(words: np.ndarray) -> np.ndarray | None:
    # n exponents, and n (n + 1) / 2 entries.
    n = int((np.sqrt(9.0 + 8.0 * len(words)) - 3.0) / 2.0)
    if not 0 < n <= _MOST_ROWS or n * (n + 3) != 2 * len(words):
        return None
    numbers = (words >> np.uint64(1)).view("<i8") ^ -(words & np.uint64(1)).view("<i8")
    exponents = np.clip(numbers[:n], -600, 600)
    found = _both_halves(numbers[n:].astype(float), n)
    np.ldexp(found, np.add.outer(exponents, exponents - _BITS), out=found)
    return found


def _both_halves(lower: np.ndarray, n: int) -> np.ndarray:
    """Return a symmetric matrix, shape (n, n), by its lower half, row by row."""
    found = np.empty((n, n))
    at = 0
    for i in range(n):
        row = lower[at : at + i + 1]
        found[i, : i + 1] = row
        found[: i + 1, i] = row
        at += i + 1
    return found


# How a text is read, by what it begins with.
_READ: dict[str, Callable[[np.ndarray], np.ndarray | None]] = {
    _COVARIANCE: _covariance,
    _SYMMETRIC: _symmetric,
    _MATRIX: _matrix,
}


def _text(words: np.ndarray) -> str:
    planes = words.view(np.uint8).reshape(-1, 8).T.tobytes()
    return base64.b64encode(zlib.compress(planes)).decode()


def _words(text: str, most: int) -> np.ndarray:
    """Return the words in a text; the inverse of :func:`_text`."""
    unpacking = zlib.decompressobj()
    try:
        planes = unpacking.decompress(base64.b64decode(text, validate=True), most)
    except (ValueError, zlib.error):
        raise Fault("is truncated or damaged", _EXPECTED) from None
    if not unpacking.eof or unpacking.unused_data or len(planes) % 8:
        raise Fault("is truncated or damaged", _EXPECTED)
    return np.frombuffer(planes, np.uint8).reshape(8, -1).T.copy().view("<u8").ravel()
