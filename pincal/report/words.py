"""Effects and noise in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pincal.units import format_noise


def effect_words(entry: Mapping[str, Any], *, joint: bool = True) -> str:
    """Return an effect of ``discovery.json`` in words, with its joint unless that stands elsewhere.

    Example:
        >>> effect_words({"effect": "joint_coupling", "joint": "axis_5", "source": "axis_4"})
        'joint_coupling of axis_5 by axis_4'
        >>> effect_words({"effect": "unnamed", "joint": "axis_2", "depends_on": "time", "shape": "curve"}, joint=False)
        'unnamed (curve of time)'
    """
    words = [entry["effect"]]
    if joint and entry.get("joint"):
        words.append(f"of {entry['joint']}")
    if "source" in entry:
        words.append(f"by {entry['source']}")
    if "depends_on" in entry:
        order = f" of order {entry['order']}" if "order" in entry else ""
        across = "" if entry.get("acts_on", "drive") == "drive" else ", across the axis"
        words.append(f"({entry.get('shape', 'curve')}{order} of {entry['depends_on']}{across})")
    elif entry.get("order", 1) != 1:
        words.append(f"order {entry['order']}")
    if entry.get("frame") == "after":
        words.append("seen from the moving link")
    return " ".join(words)


def noise_words(noise: Mapping[str, Any]) -> str:
    """Return the noise of the first block of readings in words, from its ``sigma_m`` or ``sigma_px``."""
    unit = "px" if "sigma_px" in noise else "m"
    return format_noise(noise[f"sigma_{unit}"], unit)
