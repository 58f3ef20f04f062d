"""Outside its own module and the catalogue an effect is known by its interface alone."""

from __future__ import annotations

import ast
from functools import cache

from test_layers import MODULES, nodes_of

from pincal.io.entries import EFFECTS

CLASSES = {cls.__name__: cls for cls in EFFECTS.known().values() if cls.__module__.split(".")[0] == "pincal"}
# Who may name which effects, and why. The simulator has effects of its own, which share no code with these.
ALLOWED = {
    "pincal.model.effect_registry": "registers the effects that a model is made of",
    "pincal.model.catalogue": "registers the catalogue",
    "pincal.model.effects": "lists what an elastic model is made of",
    "pincal.model.catalogue.bearing_features": "is the elasticity of a bearing in directions of its own",
    "pincal.model.catalogue.motion": "names what every drive does, which an IMU alone sees",
    "pincal.validate.agreement": "zeros that data have pulled far are looked for",
    "pincal.validate.rough_fit": "looks for the zeros of joints",
    "pincal.validate.descriptions": "looks for zeros and lengths that a description has wrong",
    "pincal.identify.explain": "a reason names base and tool",
    "pincal.identify.initial": "makes the frames of base and tool that a sensor's readings depend on, and its clock",
    "pincal.compensate.ik_problem": "moves joints as if their offsets were free",
    "pincal.discover.smooth_rest": "makes what has no name, which is no candidate",
    "pincal.discover.smooth_likelihood": "tells how likely errors without a name are",
    "pincal.calibration.information": "tells of causes, so that what has no name is left out",
    "pincal.identify.motion_fields": "what the sag of drives moves is no shift of the readings",
    "pincal.fleet.checked_motion": "lengths may have grown since the calibration",
    "pincal.design.design_model": "makes them for a sensor that has not measured yet",
}
# Who may tell parameters apart by the name of the effect that they belong to, and why.
ALLOWED_TEXTS = {
    "pincal.diagnosis.robot_diagnosis": "a misfit that nothing explains is a change without a name",
    "pincal.identify.calibrate": "the paper's stages are lists of names",
    "pincal.io.urdf_export": "notes what a URDF can't hold",
    "pincal.viewer.scene": "draws where the base is known",
    "pincal.calibration.improvement": "an IMU shows angles of the geometry",
    "pincal.demo.cli.demo": "hides an effect of the simulator",
}


@cache
def said(module: str) -> tuple[set[str], set[str]]:
    """Return all names that a module has, and all its texts."""
    names, found = set(), set()
    for node in nodes_of(module):
        if isinstance(node, ast.Name):
            names.add(node.id)
        elif isinstance(node, ast.Attribute):
            names.add(node.attr)
        elif isinstance(node, ast.ImportFrom):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.add(node.value)
    return names, found


def named(module: str) -> set[str]:
    """Return the classes of effects that a module names."""
    return said(module)[0] & CLASSES.keys()


def texts(module: str) -> set[str]:
    """Return the names of effects that a module compares with or looks up."""
    return said(module)[1] & EFFECTS.known().keys()


OTHERS = [name for name in MODULES if not name.startswith("pincal.simulate")]


def test_effects_are_known_by_their_interface() -> None:
    """No module names the class of another module's effect, unless it stands in the table with its reason."""
    foreign = {}
    for module in set(OTHERS) - ALLOWED.keys():
        own = {name for name, cls in CLASSES.items() if cls.__module__ == module}
        if others := named(module) - own:
            foreign[module] = others

    assert foreign == {}


def test_effects_are_not_looked_up_by_a_name() -> None:
    """No module compares with the name of another module's effect, unless it stands in the table with its reason."""
    foreign = {}
    for module in set(OTHERS) - set(ALLOWED_TEXTS):
        own = {cls.name for cls in CLASSES.values() if cls.__module__ == module}
        if others := texts(module) - own:
            foreign[module] = others

    assert foreign == {}


def test_the_tables_of_exceptions_are_needed() -> None:
    """An exception that nobody needs any more is taken out."""
    assert all(named(module) for module in ALLOWED)
    assert all(texts(module) for module in ALLOWED_TEXTS)
