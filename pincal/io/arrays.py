"""Arrays in files: lists of numbers whose shape, finiteness and meaning are checked where they are read.

A field declares its shape by a :class:`Shape` in its annotation. A name in it is a count that has to agree within one
structure; the first field that has the name decides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from itertools import chain
from typing import Annotated, Any, ClassVar, Self, get_args, get_type_hints

import msgspec
import numpy as np

from pincal.io.strict_json import Fault
from pincal.robot.se3 import are_rotations

# Users give rotations with as few as three decimals; what differs by more than this was not meant as one.
_ROTATION = 1e-3
# Those of the robot itself pincal writes in full precision; this turns or stretches an arm of a metre by a micrometre.
_EXACT = 1e-6
_NUMBERS = {float, int, type(None)}


class Shape:
    """The shape of an array, or the length of a list, and what its values have to be.

    Attributes:
        sizes: along each axis: a number, the name of a count that other fields share, or "any".
        check: raises :class:`Fault` for values that are invalid.
        write: returns what stands for the array in a file; default: nested lists.
    """

    def __init__(
        self,
        *sizes: int | str,
        check: Callable[[np.ndarray], None] | None = None,
        write: Callable[[np.ndarray], Any] = np.ndarray.tolist,
    ) -> None:
        self.sizes, self.check, self.write = sizes, check, write

    def expected(self, counts: Mapping[str, int]) -> tuple[int | None, ...]:
        """Return the sizes as far as they are known, None for others."""
        return tuple(counts.get(size) if isinstance(size, str) else size for size in self.sizes)


def _check_rotations(found: np.ndarray) -> None:
    if not are_rotations(found, tolerance=_ROTATION):
        raise Fault("is no rotation", "orthonormal rows of a right-handed system")


def _check_transforms(found: np.ndarray) -> None:
    last = found[..., 3, :]
    if not are_rotations(found[..., :3, :3], tolerance=_EXACT) or not (last == [0.0, 0.0, 0.0, 1.0]).all():
        raise Fault("is no transform", "4 rows of 4, rotation and metres, the last row 0 0 0 1")


def _numbers(depth: int, *, null: bool = False) -> msgspec.Meta:
    """Return the JSON Schema of numbers nested ``depth`` deep."""
    schema: dict[str, Any] = {"type": ["number", "null"] if null else "number"}
    for _ in range(depth):
        schema = {"type": "array", "items": schema}
    return msgspec.Meta(extra_json_schema=schema)


# Arrays of one and two dimensions, whose Shape stands beside them.
Numbers = Annotated[np.ndarray, _numbers(1)]
Matrix = Annotated[np.ndarray, _numbers(2)]
# Matrices that are written as text, see :mod:`pincal.io.packed`.
_AS_TEXT = msgspec.Meta(extra_json_schema={"anyOf": [_numbers(2).extra_json_schema, {"type": "string"}]})
Packed = Annotated[np.ndarray, _AS_TEXT]
# Limits, of which null says that there is none.
Limits = Annotated[np.ndarray, _numbers(1, null=True)]
Vector = Annotated[np.ndarray, _numbers(1), Shape(3)]
Rotation = Annotated[np.ndarray, _numbers(2), Shape(3, 3, check=_check_rotations)]
Rotations = Annotated[np.ndarray, _numbers(3), Shape("targets", 3, 3, check=_check_rotations)]
Transform = Annotated[np.ndarray, _numbers(2), Shape(4, 4, check=_check_transforms)]
Transforms = Annotated[np.ndarray, _numbers(3), Shape("joints", 4, 4, check=_check_transforms)]


class Record(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A structure of a file whose arrays have the shapes that their annotations declare.

    A key that it doesn't know is ignored, so that a later version can add some; optional ones are left out where absent.
    """

    # Field -> what null stands for in its array; elsewhere null is no number.
    NULLS: ClassVar[Mapping[str, float]] = {}

    @classmethod
    def of(cls, found: object, **others: Any) -> Self:
        """Return the record of an object that has the same fields as attributes, except for ``others``."""
        same = {name: getattr(found, name) for name in cls.__struct_fields__ if name not in others}
        return cls(**same | others)

    def written(self, name: str) -> Any:
        """Return what stands for an array of it in a file."""
        shape = dict(_declared(type(self))).get(name, Shape())
        return shape.write(getattr(self, name))

    def __post_init__(self) -> None:
        counts: dict[str, int] = {}
        for name, shape in _declared(type(self)):
            value = getattr(self, name)
            if isinstance(value, np.ndarray):
                known = _without_nulls(name, value, self.NULLS)
                msgspec.structs.force_setattr(self, name, shaped(f".{name}", known, shape, counts))
            elif value is not None:
                _check_length(f".{name}", len(value), shape, counts)


def shaped(key: str, value: np.ndarray, shape: Shape, counts: dict[str, int]) -> np.ndarray:
    """Return an array if it has the shape, of whose counts those that are not known yet are noted in ``counts``.

    Raises:
        Fault: at ``key``, if it has another one, or its values are invalid.
    """
    expected = shape.expected(counts)
    if value.size == 0 and 0 in expected:
        return np.zeros([size or 0 for size in expected])
    if value.ndim != len(expected) or any(size not in (None, n) for size, n in zip(expected, value.shape, strict=True)):
        words = str(tuple("any" if size is None else size for size in expected)).replace("'", "")
        raise Fault(f"has shape {value.shape}", f"numbers of shape {words}", key=key)
    counts.update((size, n) for size, n in zip(shape.sizes, value.shape, strict=True) if isinstance(size, str))
    counts.pop("any", None)
    if shape.check is not None and value.size:
        try:
            shape.check(value)
        except Fault as fault:
            raise Fault(fault.problem, fault.expected, key=key) from None
    return value


def array_of(value: Any) -> np.ndarray:
    """Return nested lists of numbers as an array; null becomes NaN, which no JSON number is.

    Raises:
        Fault: if something among them is no number, or rows have unequal lengths.
    """
    level, kinds = [value], {type(value)}
    while kinds == {list}:
        if len(set(map(len, level))) > 1:
            raise Fault("has rows of unequal length", "an array of numbers")
        level = list(chain.from_iterable(level))
        kinds = set(map(type, level))
    try:
        if kinds <= _NUMBERS:
            return np.array(value, float)
    except OverflowError:
        pass
    raise Fault("has entries that are no finite numbers", "an array of numbers")


def _check_length(key: str, length: int, shape: Shape, counts: dict[str, int]) -> None:
    (expected,) = shape.expected(counts)
    if expected not in (None, length):
        raise Fault(f"has {length} entries", f"{expected}", key=key)
    counts[str(shape.sizes[0])] = length


def _without_nulls(name: str, value: np.ndarray, nulls: Mapping[str, float]) -> np.ndarray:
    missing = np.isnan(value)
    if missing.any() and name not in nulls:
        raise Fault("has entries that are no finite numbers", "an array of numbers", key=f".{name}")
    return np.where(missing, nulls[name], value) if missing.any() else value


@lru_cache
def _declared(record: type[Record]) -> tuple[tuple[str, Shape], ...]:
    """Return the fields that declare a shape, in their order."""
    hints = get_type_hints(record, include_extras=True)
    found = ((name, _shape_in(hints[name])) for name in record.__struct_fields__)
    return tuple((name, shape) for name, shape in found if shape is not None)


def _shape_in(hint: Any) -> Shape | None:
    """Return the shape in an annotation or in a part of a union."""
    parts = (*getattr(hint, "__metadata__", ()), *(_shape_in(part) for part in get_args(hint)[:2]))
    return next((part for part in parts if isinstance(part, Shape)), None)
