"""Words for effects and noise, and the terms of the report, for readers who do not know
the paper.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from pincal.identify.explain import Status
from pincal.model.effect_registry import meaning_of
from pincal.report.report_numbers import REPORT
from pincal.units import readable_unit
from pincal.validate.outcome import Elsewhere

# Words for the numbers of parameters that the data do not identify by themselves, and for what this
# means.
_NOT_IDENTIFIED = {
    Status.UNIDENTIFIABLE: "not by themselves (predictions at such poses need no more)",
    Status.PRIOR: "hardly (they stay near nominal)",
    Status.AT_BOUND: "stopped at a bound",
    Status.FIXED: "held",
}
# Effects other than those of the robot, with their meanings.
_OTHER = {"lens_distortion": "the camera's lens bends the image"}

TERMS = (
    (
        "accuracy",
        "distance from the predicted to the measured pose of the tool, of a single measurement or "
        "of the mean of several (ISO 9283: pose accuracy).",
    ),
    (
        "repeatability",
        "scatter between repeated measurements of the same pose. Calibration does not improve it; "
        "it limits what can be achieved.",
    ),
    ("replicates", "repeated measurements of the same pose, one per measurement cycle."),
    (
        "lack of fit",
        "residuals that exceed the scatter between replicates: the model is incomplete.",
    ),
    (
        "residual",
        "measured minus predicted value: the part of a reading that the model does not explain.",
    ),
    (
        "held out",
        "poses that were not used by the fit: whole regions of joint space, and stretches of "
        "consecutive rows. Only these show what to expect at new poses.",
    ),
    ("95 %", "of errors: 95 of 100 poses have a smaller error."),
    ("noise", "standard deviation of the instrument's readings; no model can be better than this."),
    ("sigma", "standard deviation: in 95 of 100 cases the true value lies within two of them."),
    (
        "combinations determined",
        "number of independent combinations of parameters that the data determine better than the "
        "priors do (rank). A parameter that is only determined together with others is no fault: "
        "at poses like the measured ones all that predictions need is determined, and the expected "
        "error elsewhere shows whether other poses need more.",
    ),
    (
        "prior",
        "knowledge of a parameter before any measurement: a standard deviation about its "
        "nominal value.",
    ),
    (
        "compliance",
        "rotation of a joint or bearing per unit of moment, in rad per N m: the inverse "
        "of stiffness.",
    ),
    ("rms", "root mean square: like the mean, but large errors count more."),
    (
        "p",
        "probability that noise alone gives a result as extreme. A small value indicates "
        "an effect, not which one.",
    ),
)
"""The terms of the report; every text uses them in this sense."""


def effect_meaning(name: str) -> str:
    """Return the meaning of an effect in plain words.

    Example:
        >>> effect_meaning("link_bending")
        'the link itself bends under load'
    """
    return meaning_of(name) or _OTHER.get(name, "an effect of your own")


def noise_keys(noise: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the entries of a noise of which :func:`noise_words` tells.

    Example:
        >>> noise_keys({"sigma_m_s2": 0.01, "sigma_rad_s": 1e-3})
        ('sigma_m_s2', 'sigma_rad_s')
    """
    places = [key for key in ("sigma_px", "sigma_m") if key in noise]
    return tuple(places[:1]) or tuple(k for k in ("sigma_m_s2", "sigma_rad_s") if k in noise)


def noise_words(noise: Mapping[str, Any]) -> str:
    """Return the noise of the first block of readings in words, from its ``sigma_m`` or
    ``sigma_px``.

    Example:
        >>> noise_words({"sigma_m": 5e-5}), noise_words({"sigma_m": 3e-7})
        ('0.0500 mm per coordinate', '0.0003 mm per coordinate')
        >>> noise_words({"sigma_px": 0.1})
        '0.1 px per coordinate'
    """
    if "sigma_m_s2" in noise and not {"sigma_m", "sigma_px"} & noise.keys():
        rate = f", {1e3 * noise['sigma_rad_s']:.2g} mrad/s" if "sigma_rad_s" in noise else ""
        return f"{noise['sigma_m_s2']:.2g} m/s^2{rate} per coordinate"
    unit = "px" if "sigma_px" in noise else "m"
    factor, name = readable_unit(unit)
    sigma = noise[f"sigma_{unit}"] * factor
    form = ".4g" if unit == "px" else ".4f" if sigma >= 1e-3 else ".2g"
    return f"{sigma:{form}} {name} per coordinate"


def noise_example(noise: Mapping[str, Any]) -> str:
    """Return the option that states the noise of an instrument, with an example of its value; ""
    where readings are neither lengths nor pixels, or where it was stated and that of another
    instrument, such as an IMU or a camera, was not.

    Example:
        >>> noise_example({"sigma_px": 0.3}), noise_example({"sigma_m_s2": 0.02})
        ('--noise 0.1px', '')
        >>> noise_example({"sigma_m": 5e-5, "sigma_px": 0.1, "declared": ["sigma_m"]})
        ''
    """
    examples = {"sigma_m": "0.05mm", "sigma_px": "0.1px"}
    # The option takes one value: that of another kind of readings would replace it.
    is_stated = any(name in examples for name in noise.get("declared", ()))
    value = next((value for name, value in examples.items() if name in noise), "")
    return f"--noise {value}" if value and not is_stated else ""


def noise_to_state(noise: Mapping[str, Any]) -> str:
    """Return the option by which noise is still to be stated; "" if it was, or if repeated poses
    show it.
    """
    shown = any(name.startswith("repeated_") for name in noise)
    return "" if shown or noise["source"] == "declared" else noise_example(noise)


def is_noise_declared(noise: Mapping[str, Any]) -> bool:
    """Return whether the noise that :func:`noise_words` states was declared; that of other readings
    may not have been.

    Example:
        >>> mixed = {"sigma_m": 5e-5, "sigma_m_s2": 0.02, "source": "estimated"}
        >>> is_noise_declared(mixed | {"declared": ["sigma_m"]}), is_noise_declared(mixed)
        (True, False)
    """
    is_all = str(noise["source"]) == "declared"
    return _first_of(noise) in noise["declared"] if "declared" in noise else is_all


def _first_of(noise: Mapping[str, Any]) -> str:
    """Return the name of the noise that is stated first."""
    return next((name for name in ("sigma_m", "sigma_px") if name in noise), "sigma_m_s2")


def noise_origin(noise: Mapping[str, Any]) -> str:
    """Return where the noise that :func:`noise_words` states comes from, and what the readings
    themselves show where it was declared.

    Example:
        >>> declared = {"sigma_m": 5e-5, "source": "declared", "residual_sigma_m": 5.26e-5}
        >>> noise_origin(declared)
        'declared; residuals show 0.0526'
        >>> noise_origin(declared | {"repeated_sigma_m": 6.4e-5})
        'declared; repeated poses show 0.0640'
        >>> noise_origin({"sigma_m": 5.2e-5, "source": "estimated", "repeated_sigma_m": 5.2e-5})
        'estimated from repeated poses'
        >>> noise_origin({"sigma_px": 0.1, "source": "estimated"})
        'estimated from the residuals'
    """
    name = _first_of(noise)
    repeated = noise.get(f"repeated_{name}")
    source = str(noise["source"])
    shown = noise.get(f"residual_{name}") if repeated is None else repeated
    factor, _ = readable_unit(name.removeprefix("sigma_"))
    size = "" if shown is None else f"{shown * factor:.4f}"
    what = "residuals" if repeated is None else "repeated poses"
    if is_noise_declared(noise):
        return f"declared; {what} show {size}" if size else "declared"
    origin = "estimated from the residuals" if source in ("declared", "estimated") else source
    if repeated is None:
        return origin
    is_theirs = size == f"{noise[name] * factor:.4f}"
    return "estimated from repeated poses" if is_theirs else f"{origin}; {what} show {size}"


def is_worse_elsewhere(found: Elsewhere, error: Mapping[str, float]) -> bool:
    """Return whether the expected error elsewhere is much larger than the error at poses like the
    measured ones.
    """
    return "mean_mm" in error and found.mean_mm > REPORT.much * error["mean_mm"]


def elsewhere_words(found: Elsewhere, error: Mapping[str, float]) -> str:
    """Return what error the model expects elsewhere, where most, and the cure where it is much
    larger.

    Args:
        found: the expected errors.
        error: statistics of the error at poses like the measured ones.

    Example:
        >>> found = Elsewhere(0.31, 0.9, "joint_3 is above 95 deg (not measured there)", 400)
        >>> elsewhere_words(found, {"mean_mm": 0.05})[:76]
        'mean 0.3100 mm expected within the joint limits, worst 0.9000, most where jo'
        >>> elsewhere_words(Elsewhere(0.01, 0.02, "", 40, "task.csv"), {"mean_mm": 0.05})
        'mean 0.0100 mm expected at the poses of task.csv, worst 0.0200'
    """
    words = elsewhere_size(found)
    if not is_worse_elsewhere(found, error):
        return words
    where = (
        f"most where {found.where}"
        if found.where
        else "in combinations of joints that were not measured"
    )
    return f"{words}, {where}; pincal design plans poses for it"


def elsewhere_size(found: Elsewhere) -> str:
    """Return what error the model expects elsewhere."""
    poses = f"at the poses of {found.over}" if found.over else "within the joint limits"
    return f"mean {found.mean_mm:.4f} mm expected {poses}, worst {found.worst_mm:.4f}"


def rank_words(
    statuses: Iterable[Status], *, rank: int, condition: float | None = None, why: str = ""
) -> str:
    """Return what poses determine of the parameters, and what it means that they do not determine
    the others.

    Args:
        statuses: of every parameter; the numbers in the sentence add up to the number of
            parameters.
        rank: number of independent combinations that are determined.
        condition: condition number of these; None to leave it out.
        why: where the reasons are given, in words.

    Example:
        >>> statuses = [Status.IDENTIFIED] * 2 + [Status.UNIDENTIFIABLE] * 3 + [Status.FIXED]
        >>> rank_words(statuses, rank=3, condition=52.0)[:87]
        'these poses determine 3 combinations of the 6 parameters: 2 of them individually, 3 not'
        >>> rank_words([Status.IDENTIFIED] * 2, rank=2)
        'these poses determine all 2 parameters individually'
    """
    counts = Counter(statuses)
    total = counts.total()
    individually = counts[Status.IDENTIFIED]
    others = [
        f"{counts[status]} {words}" for status, words in _NOT_IDENTIFIED.items() if counts[status]
    ]
    if not others:
        words = f"these poses determine all {total} parameters individually"
    else:
        parts = ", ".join([f"{individually} of them individually", *others])
        words = f"these poses determine {rank} combinations of the {total} parameters: {parts}"
    words += f"; condition number {condition:.2g}" if condition is not None else ""
    return f"{words} ({why})" if why and others else words
