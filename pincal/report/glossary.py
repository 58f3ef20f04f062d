"""What effects and words of the trade mean, for readers who do not know the paper."""

from __future__ import annotations

from pincal.model.registry import meaning_of

# What a fit finds beside effects of the robot -> what it is.
_BESIDE = {"lens_distortion": "the camera's lens bends the image"}

TERMS = (
    (
        "accuracy",
        "distance from the predicted to the measured pose of the tool, of a single measurement or of the mean of several "
        "(ISO 9283: pose accuracy).",
    ),
    (
        "repeatability",
        "scatter between repeated measurements of the same pose. Calibration does not improve it; it limits what can be "
        "achieved.",
    ),
    ("replicates", "repeated measurements of the same pose, one per measurement cycle."),
    ("lack of fit", "residuals that exceed the scatter between replicates: the model is incomplete."),
    ("residual", "measured minus predicted value: what the model does not explain."),
    ("held out", "poses that were not used by the fit. Only these show what to expect of new poses."),
    ("noise", "standard deviation of the instrument's readings; no model can be better than this."),
    ("sigma", "standard deviation: in 95 of 100 cases the true value lies within two of them."),
    (
        "identifiable rank",
        "number of independent combinations of parameters that the data determine better than prior knowledge does.",
    ),
    ("prior", "what is known of a parameter before any measurement, as a standard deviation about its nominal value."),
    ("compliance", "rotation of a joint or bearing per unit of moment, in rad per N m: the inverse of stiffness."),
    ("rms", "root mean square: like the mean, but large errors count more."),
    ("p", "probability that noise alone looks like this. A small value says that there is an effect, not which."),
)
"""The terms of the report, for readers who do not know the paper; every text uses them in this sense."""


def effect_meaning(name: str) -> str:
    """Return what an effect means, in plain words; one that nobody registered has only its name.

    Example:
        >>> effect_meaning("link_bending")
        'the link itself bends under load'
    """
    return meaning_of(name) or _BESIDE.get(name, "an effect of your own")
