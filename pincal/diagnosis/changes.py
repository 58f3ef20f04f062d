"""What may have happened to a calibrated robot: parameters that moved, alone or together, and effects that are new."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from pincal.identify.criteria import CHANGES
from pincal.model.catalogue.candidates import elasticity, testable
from pincal.model.conditions import Conditions, PoseSet
from pincal.model.effect import Curve, Effect, Family
from pincal.model.effects import Compliance
from pincal.model.model import Model
from pincal.parameters import Parameter


@dataclass(frozen=True)
class PossibleChange:
    """One thing that may have happened.

    Attributes:
        name: of the effect.
        joint: on which it acts; None for the whole arm.
        parameters: names of the parameters that it moves.
        effect: the effect that the robot would have now; None where parameters of the model moved.
        source: the joint that drives this one, where an effect has one.
        is_usual: whether it is what happens first: a drive that lost its zero.
        parts: whether other changes together are the same one, so that it is not counted among what is excluded.
        belief: shape (K, K), information about how far its K parameters change, where they are known to hang together, as
            the pieces of a smooth curve do; None where each changes by itself.
    """

    name: str
    joint: str | None
    parameters: tuple[str, ...]
    effect: Effect | None = None
    source: str | None = None
    parts: bool = False
    is_usual: bool = False
    belief: np.ndarray | None = field(default=None, repr=False, compare=False)

    @property
    def heading(self) -> tuple[str, str | None, str | None]:
        """What a report calls it."""
        return self.name, self.joint, self.source

    def describe(self) -> dict[str, str | None]:
        """Return what tells it from its likes in the terms of ``diagnosis.json``."""
        return {"effect": self.name, "joint": self.joint} | ({} if self.source is None else {"source": self.source})


def changes_of(model: Model, situation: PoseSet) -> tuple[PossibleChange, ...]:
    """Return all that may have happened to a calibrated robot, as far as these poses could show it; the usual first.

    Args:
        model: chain and effects of the robot.
        situation: the new poses.
    """
    added = (effect for effect in _catalogue(model, situation) if not _is_beside(effect))
    return tuple(_of_parameters(model)) + tuple(_of_effect(effect, model) for effect in added)


def additional_changes(model: Model, situation: PoseSet) -> tuple[Effect, ...]:
    """Return what new rows may show without any change of the robot: what follows instrument and weather."""
    return tuple(effect for effect in _catalogue(model, situation) if _is_beside(effect))


def _is_beside(effect: Effect) -> bool:
    """Return whether an effect is the station's, or the whole arm's at its temperature or as it warms up."""
    at = effect.locus
    return effect.scope == "station" or (at.joint is None and at.follows in ("temperature", "time"))


def _of_effect(effect: Effect, model: Model) -> PossibleChange:
    name, joint, source = effect.heading
    return PossibleChange(name, joint, tuple(parameter.name for parameter in effect.parameters(model.chain)), effect, source)


def _catalogue(model: Model, situation: PoseSet) -> Iterator[Effect]:
    """Yield the effects that these poses could show, and the compliances of single joints that the model does not have."""
    known, present = {parameter.name for parameter in model.parameters}, {effect.identity for effect in model.effects}
    kinds = [type(effect) for effect in elasticity(situation) if isinstance(effect, Compliance)]
    for kind in kinds:
        for joint in situation.revolute:
            effect = kind(joints=(joint,))
            if known.isdisjoint(p.name for p in effect.parameters(model.chain)):
                yield effect
    for candidate in testable(situation):
        for form in candidate.forms:
            size = form.resolution if isinstance(form, Curve) else 1
            if form.identity not in present and size * CHANGES.rows_each <= len(situation.conditions):
                yield form


def _of_parameters(model: Model) -> Iterator[PossibleChange]:
    """Yield each parameter of the robot alone, and those that change together: an effect's on a joint, a bent link's."""
    for effect in model.effects:
        # Links don't lose weight, and bearings stay in their places.
        if effect.scope == "station" or effect.bodies(model.chain) or effect.locus.acts_on == "place":
            continue
        single = effect.family in (Family.GEOMETRY, Family.ELASTICITY)
        by_element: dict[str, list[Parameter]] = {}
        for parameter in effect.parameters(model.chain):
            by_element.setdefault(parameter.element, []).append(parameter)
        for element, members in by_element.items():
            joint = element if element in model.chain.robot.joint_names else effect.locus.joint
            source = effect.heading[2]
            names = tuple(parameter.name for parameter in members)
            if single:
                usual = effect.locus.acts_on == "drive"
                yield from (PossibleChange(effect.name, joint, (name,), source=source, is_usual=usual) for name in names)
            if len(names) > 1 or not single:
                yield PossibleChange(
                    effect.name, joint, names, source=source, parts=single, belief=belief_of(effect, members)
                )
    yield from _bent_links(model)


def belief_of(effect: Effect, members: Sequence[Parameter]) -> np.ndarray | None:
    """Return what is believed of a new curve in the place of one whose roughness is known: it is as rough."""
    smooth = effect.smoothness()
    if smooth is None or len(smooth) != len(members):
        return None
    return smooth + np.diag([parameter.size**-2.0 for parameter in members])


def _bent_links(model: Model) -> Iterator[PossibleChange]:
    """Yield, for each link between two joints, all constants of the geometry between the motion of the one and the other."""
    chain, geometry = model.chain, [e for e in model.effects if e.family is Family.GEOMETRY]
    if not geometry:
        return
    name = next((effect.name for effect in geometry if effect.locus.acts_on == "link"), geometry[0].name)
    nothing = Conditions.at(np.zeros((0, chain.robot.n_joints)))
    places = [
        (effect.parameters(chain)[term.parameter].name, term.coordinate)
        for effect in geometry
        for term in effect.terms(chain, nothing, None)
    ]
    for i, joint in enumerate(chain.robot.joint_names[:-1]):
        # What turns about or slides along the axis of a joint may stand before or behind its own motion.
        here = {chain.joint(i, symbol) for symbol in ("theta", "d", "a", "alpha")}
        there = {chain.joint(i + 1, symbol) for symbol in ("s_x", "s_y", "theta", "d")}
        members = tuple(name for name, coordinate in places if coordinate in here | there)
        yield PossibleChange(name, joint, members, parts=True)
