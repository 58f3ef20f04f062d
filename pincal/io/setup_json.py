"""A measuring setup as JSON and back: named points, distances between them, the camera."""

from __future__ import annotations

from typing import Any

import numpy as np

from pincal.errors import MeasurementError
from pincal.io.json_section import Section
from pincal.measure.lens import Lens
from pincal.measure.setup import KnownDistance, Place, Setup


def setup_to_json(setup: Setup) -> dict[str, Any]:
    """Return a setup in types that JSON knows; a point that was not known beforehand is null."""
    return {
        "points": [{"name": name, "position": None if at is None else list(at)} for name, at in setup.points.items()],
        "gaps": [
            {"first": gap.first, "second": gap.second, "length": gap.length, "sigma": gap.sigma} for gap in setup.distances
        ],
        "lens": None if setup.lens is None else setup.lens.values.tolist(),
        "fit_lens": setup.fit_lens,
    }


def setup_from_json(section: Section) -> Setup:
    """Return the setup of :func:`setup_to_json`.

    Raises:
        ModelFileError: if a key is missing or its value can't be right.
    """
    lens = section.at("lens")
    try:
        return Setup(
            points={entry.at("name").text(): _place(entry.at("position")) for entry in section.at("points").items()},
            distances=tuple(
                KnownDistance(e.at("first").text(), e.at("second").text(), e.at("length").number(), e.at("sigma").number())
                for e in section.at("gaps").items()
            ),
            lens=None if lens.value is None else Lens(*lens.numbers(9).tolist()),
            fit_lens=section.at("fit_lens").flag(),
        )
    except MeasurementError as error:
        raise section.at("gaps").error(str(error), "distances of two points") from None


def _place(section: Section) -> Place | None:
    if section.value is None:
        return None
    x, y, z = np.asarray(section.numbers(3), float).tolist()
    return x, y, z
