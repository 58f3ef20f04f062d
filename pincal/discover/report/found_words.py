"""Words for what a search found."""

from __future__ import annotations

from collections.abc import Sequence

from pincal.discover.discovery_file import (
    Bootstrap,
    EffectName,
    Findings,
    FoundEffect,
    NamedRegion,
    Smooth,
)
from pincal.discover.remainder_numbers import REMAINDER
from pincal.errors import counted
from pincal.units import format_joint, format_small, show_chance

# Words for variables whose names do not explain themselves.
_VARIABLES = {"move": "its last move"}
# What a coordinate other than the drive's is, if not a tilt.
_ACROSS = {"gamma_z": "roll", "a": "displacement"}


def effect_words(entry: EffectName, *, joint: bool = True) -> str:
    """Return an effect in words, with or without its joint.

    Example:
        >>> effect_words(EffectName(effect="joint_coupling", joint="axis_5", source="axis_4"))
        'joint_coupling of axis_5 by axis_4'
        >>> drift = EffectName(effect="unnamed", joint="axis_2", depends_on="time", shape="curve")
        >>> effect_words(drift, joint=False)
        'unnamed (curve of time)'
        >>> both = EffectName(effect="unnamed", joint="axis_2", depends_on="axis_4", shape="map")
        >>> effect_words(both, joint=False)
        'unnamed (map of axis_2 and axis_4)'
        >>> tilt = dict(depends_on="axis_2", acts_on="s_x", shape="curve")
        >>> effect_words(EffectName(effect="unnamed", joint="axis_2", **tilt), joint=False)
        'unnamed (curve of axis_2, tilt s_x)'
        >>> rail = dict(depends_on="rail", shape="waves", period=2.0944)
        >>> effect_words(EffectName(effect="unnamed", joint="rail", **rail), joint=False)
        'unnamed (waves of period 2094 mm of rail)'
    """
    words = [entry.effect]
    if joint and entry.joint:
        words.append(f"of {entry.joint}")
    if entry.source:
        words.append(f"by {entry.source}")
    if entry.station:
        words.append(f"at {entry.station}")
    if entry.depends_on:
        order = _cycles(entry)
        on = entry.acts_on or "drive"
        across = "" if on == "drive" else f", {_ACROSS.get(on, 'tilt')} {on}"
        of = (
            f"{entry.joint} and {entry.depends_on}"
            if entry.shape in ("map", "product", "field")
            else _VARIABLES.get(entry.depends_on, entry.depends_on)
        )
        words.append(f"({entry.shape or 'curve'}{order} of {of}{across})")
    elif (entry.order or 1) != 1:
        if isinstance(entry, FoundEffect) and entry.resolution is not None:
            middle = sum((entry.order or 0.0, *entry.beside)) / (1 + len(entry.beside))
            words.append(f"order {middle:.1f} \u00b1 {entry.resolution:.1f}")
        else:
            words.append(f"order {entry.order}")
    return " ".join(words)


def _cycles(entry: EffectName) -> str:
    """Return the order of a periodic effect without a name, of a prismatic joint its period."""
    if entry.order:
        return f" of order {entry.order:g}"
    if entry.period is None or entry.shape not in ("waves", "product"):
        return ""
    return f" of period {format_joint(entry.period, 'm')}"


def line_words(entry: FoundEffect) -> str:
    """Return a remark on a spectral line in addition to its order, or an empty text.

    Example:
        >>> names = {"effect": "gear_ripple", "joint": "wrist_2", "order": 405.0}
        >>> names |= {"parameters": {}, "equivalent": (), "tell_apart": "", "beside": (401.4,)}
        >>> entry = FoundEffect(**names, p_value=0.0, gap_before_mm=1.0, gap_after_mm=1.0)
        >>> line_words(entry).removeprefix("one spectral line whose amplitude varies over ")
        'the span of the joint, fitted as harmonics of order 405 and 401.4'
    """
    orders = " and ".join(f"{order:g}" for order in (entry.order or 0.0, *entry.beside))
    whole = (
        "one spectral line whose amplitude varies over the span of the joint, fitted as "
        f"harmonics of order {orders}"
    )
    return "; ".join(filter(None, [entry.origin, whole if entry.beside else ""]))


HINTS = "Hints: named in less than 60 % of the subsamples"


SMOOTH_PARTS = {
    "drive": "errors of the drives",
    "base": "displacements along the axes of the base",
}
"""Parts of what is smooth in the joints and has no name, in words."""


def no_effect_words(found: Findings) -> str:
    """Return in words that no effect was found, or none but a remainder, which has no name."""
    what = "missing effect" if found.remainder is None else "effect with a name"
    return f"These data show no {what}."


def smooth_words(smooth: Smooth) -> str:
    """Return what is smooth in the joints and has no name, what it gains, and where not to trust
    it.
    """
    parts = " and ".join(
        f"{SMOOTH_PARTS[part.errs]}, {format_small(part.size, part.unit)} rms, alike over "
        f"{part.length_rad:g} rad"
        for part in smooth.parts
    )
    return (
        f"{parts}; regions left out are predicted to {smooth.smooth_mm:.4f} mm, without it to "
        f"{smooth.named_mm:.4f}. It says nothing of causes. {smooth_trust(smooth)}"
    )


def region_words(regions: Sequence[NamedRegion]) -> str:
    """Return how many regions that are left out names predict worse than geometry and elasticity.

    Example:
        >>> sizes = {"calibrated_mm": 0.09, "chance": 0.4, "centre": {}}
        >>> regions = [NamedRegion(rows=12, named_mm=named, **sizes) for named in (0.08, 0.1)]
        >>> print(region_words(regions))
        Of 2 regions left out the names predict 1, with 12 rows, worse than calibrate, by chance
    """
    worse = [region for region in regions if region.is_worse]
    if not worse:
        return f"None of {len(regions)} regions left out is predicted worse than by calibrate"
    rows = sum(region.rows for region in worse)
    least = min(region.chance for region in worse) * len(regions)
    how = f"beyond chance (p {show_chance(least)})" if least < REMAINDER.worse else "by chance"
    return (
        f"Of {len(regions)} regions left out the names predict {len(worse)}, with "
        f"{counted(rows, 'row')}, worse than calibrate, {how}"
    )


def smooth_trust(smooth: Smooth) -> str:
    """Return where what has no name may not be trusted."""
    far = (
        "Where no pose was measured nearby it is not known: one standard deviation is "
        + " and ".join(format_small(part.sigma, part.unit) for part in smooth.parts)
    )
    least = f"{far}. None of {len(smooth.regions)} regions is predicted worse than by calibrate"
    if not smooth.doubtful:
        return f"{least}."
    rows = sum(region.rows for region in smooth.doubtful)
    return (
        f"{least}; {len(smooth.doubtful)}, with {counted(rows, 'row')}, no better than without it "
        "(discovery.json says which)."
    )


def subsample_only_words(found: Findings) -> str:
    """Return the names that most subsamples have and the full data set has not."""
    names = ", ".join(
        f"{effect_words(entry)} ({entry.stability})" for entry in found.only_in_halves
    )
    return f"Named in most subsamples, but not in the full data set: {names}"


def bootstrap_words(last: Bootstrap) -> str:
    """Return the bootstrap test of the effect accepted last in words.

    Example:
        >>> last = Bootstrap(effect="base_drift", joint=None, p_value=2 / 201, draws=200)
        >>> bootstrap_words(last).removeprefix("Of 200 tables drawn from the model ")
        'without base_drift, accepted last, 1 has a candidate that fits as well.'
    """
    as_good = round(last.p_value * (last.draws + 1)) - 1
    count = f"{as_good or 'none'} has" if as_good < 2 else f"{as_good} have"
    words = (
        f"Of {last.draws} tables drawn from the model without {effect_words(last)}, accepted "
        f"last, {count}"
    )
    return f"{words} a candidate that fits as well."


def gain_words(entry: FoundEffect) -> str:
    """Return how the mean held-out error changed as an effect entered the model.

    Example:
        >>> from msgspec import structs
        >>> turned = {"gap_before_mrad": 0.168, "gap_after_mrad": 0.092}
        >>> names = {"effect": "transmission_error", "joint": "axis_6", "p_value": 1e-9}
        >>> names |= {"parameters": {}, "equivalent": (), "tell_apart": ""}
        >>> entry = FoundEffect(**names, gap_before_mm=0.0425, gap_after_mm=0.0434, **turned)
        >>> gain_words(entry)
        '0.0425 to 0.0434 mm, 0.1680 to 0.0920 mrad: improves orientation only'
        >>> gain_words(structs.replace(entry, gap_before_mrad=None, gap_after_mrad=None))
        '0.0425 to 0.0434 mm: no improvement on these rows'
    """
    figures = [f"{entry.gap_before_mm:.4f} to {entry.gap_after_mm:.4f} mm"]
    gains = [_falls(entry, "mm")]
    if entry.gap_before_mrad is not None:
        figures.append(f"{entry.gap_before_mrad:.4f} to {entry.gap_after_mrad:.4f} mrad")
        gains.append(_falls(entry, "mrad"))
    remark = (
        ""
        if gains[0]
        else ": improves orientation only"
        if any(gains)
        else ": no improvement on these rows"
    )
    return ", ".join(figures) + remark


def _falls(entry: FoundEffect, unit: str) -> bool:
    """Return whether an error falls to the four digits that are shown."""
    before = getattr(entry, f"gap_before_{unit}")
    after = getattr(entry, f"gap_after_{unit}")
    return float(f"{after:.4f}") < float(f"{before:.4f}")
