"""What effects and words of the trade mean, for readers who do not know the paper."""

from __future__ import annotations

# Names of the contract -> what a machine with this effect does.
EFFECTS = {
    "joint_offset": "the zero of a joint's scale is off",
    "link_geometry": "lengths and angles of the links differ from the drawing",
    "axis_distortion": "joint axes are slightly tilted (the paper's s_x, s_y)",
    "base_frame": "where the robot stands before the instrument",
    "tool_frame": "where the target sits on the tool",
    "joint_elasticity": "the drive twists under the load on its axis",
    "bearing_elasticity": "the bearing tilts under load across its axis",
    "nonlinear_elasticity": "the drive is soft under small loads and stiffens under large ones",
    "link_bending": "the link itself bends under load",
    "base_elasticity": "the foundation gives way under load",
    "gravity_compensator": "a spring or a counterweight acts on the joint otherwise than assumed",
    "payload_error": "the payload's mass or centre is not as declared",
    "gear_eccentricity": "a gear wheel is off centre or oval: the joint errs in a wave, once or twice a turn",
    "transmission_error": "the joint errs by a curve of its own angle: gear teeth, scale, wave generator",
    "gear_ratio": "the joint turns by a fixed part too far or too short",
    "joint_coupling": "moving one joint drags another along",
    "axis_wobble": "the axis tilts to and fro as the joint turns",
    "backlash": "play: the joint stops short, depending on the side from which it came",
    "load_backlash": "play: the joint falls to one side, depending on the sign of the load",
    "thermal_expansion": "the links grow with temperature",
    "thermal_offset": "the joint's zero moves with temperature",
    "base_drift": "robot and instrument move against each other as time goes by",
    "measurement_scale": "the instrument's lengths are off by a fixed part",
    "lens_distortion": "the camera's lens bends the image",
    "unnamed": "something real that no name here describes",
}

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
    """Return what an effect means, in plain words; an effect of the user's own has only its name.

    Example:
        >>> effect_meaning("link_bending")
        'the link itself bends under load'
    """
    return EFFECTS.get(name, "an effect of your own")
