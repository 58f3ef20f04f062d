"""A part: the features that it has, and its datum."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field

from pincal.features.part_expansion import PartExpansion
from pincal.features.part_feature import PartDatum, PartFeature
from pincal.features.part_file import read_part


@dataclass(frozen=True, eq=False)
class Part:
    """Features of a part by name, its datum, and its expansion where lengths are to be stated at 20
    deg C.

    Example:
        >>> hole = PartFeature("hole", "circle", nominal={"diameter": 0.02})
        >>> Part({"hole": hole}).kinds
        {'hole': 'circle'}
    """

    features: Mapping[str, PartFeature]
    datum: PartDatum = field(default_factory=PartDatum)
    expansion: PartExpansion | None = None

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> Part:
        """Read a part.

        Args:
            path: a TOML file with a table ``[feature.NAME]`` for each feature and ``[datum]``, see
                :mod:`pincal.features.part_file`.

        Raises:
            BadInputError: for a file that can't be read, unknown keys, kinds, units or features, a
                tolerance without what it is about, or values that are none.
        """
        content = read_part(path)
        return cls(content.features, content.datum, content.expansion)

    @property
    def kinds(self) -> dict[str, str]:
        """Kinds of the features that are fitted to points, by name."""
        return {name: of.kind for name, of in self.features.items() if not of.is_derived}
