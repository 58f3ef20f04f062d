"""The effects that can be tested with given poses, the reasons against the others, and effects by
name.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

import numpy as np

from pincal.errors import BadInputError, nearest_first
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, PoseSet
from pincal.model.effect import Candidate, Discoverable, Effect, Family, Harmonic
from pincal.model.effect_numbers import ORIGIN, SHOWN
from pincal.model.effect_registry import EFFECTS
from pincal.model.effects import Compliance
from pincal.model.evaluated import key_of
from pincal.model.model import Model
from pincal.model.sizes import largest_basis
from pincal.recorded import RECORDABLE
from pincal.robot.robot import Robot
from pincal.units import plain_numbers

_CONSTANT_AT = "{} does not move in any pose, so the effect is constant"
# Why a recorded variable contains no information on a joint, if not because its column is missing
# or constant.
_UNTOLD = {
    "move": "<joint> does not move, or its direction of approach does not follow from the "
    "previous row: see column approach_<joint>"
}


def candidates(chain: Chain, conditions: Conditions) -> tuple[Effect, ...]:
    """Return every effect, joint by joint, that these poses could show.

    Joint and bearing elasticity are not among them: see :func:`elasticity`.
    """
    return tuple(effect for effect, reason in _judged(PoseSet(chain, conditions)) if not reason)


def testable(situation: PoseSet, acts_on: Collection[str] | None = None) -> tuple[Candidate, ...]:
    """Return every candidate, plugins' included, joint by joint, that these poses could show.

    ``acts_on`` restricts what they move, see :class:`Locus`.
    """
    if acts_on is not None:
        some = (
            candidate for candidate in _all(situation) if candidate.effect.locus.acts_on in acts_on
        )
        return tuple(candidate for candidate in some if not why_not_testable(candidate, situation))
    # Requested again for each effect that is compared with the others.
    known: dict[Any, tuple[Candidate, ...]] = situation.chain.known(
        "testable", situation.conditions
    )
    key = (situation.compliances, tuple(EFFECTS.known().values()))
    if key not in known:
        # Results for other compliances won't be needed again.
        known.clear()
        known[key] = tuple(
            candidate for candidate in _all(situation) if not why_not_testable(candidate, situation)
        )
    return known[key]


def untestable(chain: Chain, conditions: Conditions) -> tuple[tuple[Effect, str], ...]:
    """Return the effects that these poses could not show, each with the reason."""
    return tuple(
        (effect, reason) for effect, reason in _judged(PoseSet(chain, conditions)) if reason
    )


def _judged(situation: PoseSet) -> list[tuple[Effect, str]]:
    return [
        (candidate.effect, why_not_testable(candidate, situation)) for candidate in _all(situation)
    ]


def elasticity(situation: PoseSet) -> tuple[Effect, ...]:
    """Return the linear compliances that these poses excite."""
    return tuple(candidate.effect for candidate in _every(situation, elastic=True))


def _every(situation: PoseSet, *, elastic: bool) -> list[Candidate]:
    classes = [cls for cls in EFFECTS.known().values() if issubclass(cls, Discoverable)]
    chosen = [cls for cls in classes if (cls.family is Family.ELASTICITY) == elastic]
    return [candidate for cls in chosen for candidate in cls.candidates(situation)]


def _all(situation: PoseSet) -> list[Candidate]:
    """Return all candidates but elasticity, joint by joint, those of the whole arm last."""
    place = {joint: i for i, joint in enumerate(situation.joints)}
    return sorted(
        _every(situation, elastic=False),
        key=lambda candidate: place.get(candidate.effect.locus.joint or "", len(place)),
    )


def why_not_testable(candidate: Candidate, situation: PoseSet) -> str:
    """Return why an effect can't be identified from these poses, empty if it can."""
    effect = candidate.effect
    chain = situation.chain
    conditions = situation.conditions
    if missing := effect.missing(conditions):
        return "; ".join(_lacking(column, conditions) for column in missing)
    joint = effect.locus.joint
    for name in effect.needs if joint is not None else ():
        column = conditions.column(name)
        if (
            column is not None
            and column.ndim == 2
            and not np.ptp(column[:, situation.index(str(joint))])
        ):
            reason = _UNTOLD.get(name, f"column {RECORDABLE[name].column} is missing or constant")
            return reason.replace("<joint>", str(joint))
    if candidate.obstacle:
        return candidate.obstacle
    # The effects are kept alive with the results.
    known = chain.known("still", conditions)
    key = key_of(effect)
    if key not in known:
        known[key] = (
            effect,
            _unmoved(effect, situation)
            if effect.uses_moments
            else _standing_still(effect, situation),
        )
    return str(known[key][1])


def _unmoved(effect: Effect, situation: PoseSet) -> str:
    excited = bool(largest_basis(Model(situation.chain, (effect,)), situation.conditions)[1].any())
    return "" if excited else "gravity exerts no moment about its axis in any pose"


def _lacking(column: str, conditions: Conditions) -> str:
    variable = RECORDABLE.get(column)
    name, instead = (column, "") if variable is None else (variable.column, variable.instead)
    if conditions.column(column) is not None:
        return f"column {name} is constant"
    return f"column {name} is missing" + (f" ({instead})" if instead else "")


def _standing_still(effect: Effect, situation: PoseSet) -> str:
    at = effect.locus
    if at.joint is None and at.follows is None:
        return ""  # A constant of the whole arm does not depend on the joint positions.
    if at.follows in situation.joints and at.follows not in situation.moving:
        # What an encoder reads of a resting joint is no position on which an error could depend.
        return _CONSTANT_AT.format(at.follows)
    bases = [
        t.basis
        for t in effect.terms(situation.chain, situation.conditions, None)
        if t.basis is not None
    ]
    bases = [basis for basis in bases if basis.any()]
    if any(np.ptp(basis) > SHOWN.constant * np.abs(basis).max() for basis in bases):
        return ""
    if not bases:
        return "it has no effect in these poses or on this arm"
    source = at.joint if at.follows in RECORDABLE else at.follows or at.joint
    return _CONSTANT_AT.format(source)


def effect_parts(text: str) -> tuple[str, list[tuple[str, str]]]:
    """Return the name of an effect NAME[:JOINT][:KEY=VALUE,...], and its keys with their values,
    the joint among them.

    Raises:
        BadInputError: for a key without a value.

    Example:
        >>> effect_parts("gear_eccentricity:joint_3:order=2")
        ('gear_eccentricity', [('joint', 'joint_3'), ('order', '2')])
    """
    name, *parts = (part.strip() for part in text.split(":"))
    found = []
    for pair in (
        pair for part in parts for pair in (part.split(",") if "=" in part else [f"joint={part}"])
    ):
        key, equals, value = (word.strip() for word in pair.partition("="))
        if not (key and equals and value):
            raise BadInputError(f"effect {text!r}: {pair!r}; expected KEY=VALUE, such as order=2")
        found.append((key, value))
    return name, found


def _single_compliances(situation: PoseSet) -> Iterator[tuple[Effect, str]]:
    """Yield the compliances of single joints, all of which poses show."""
    kinds = [type(effect) for effect in elasticity(situation) if isinstance(effect, Compliance)]
    for joint in situation.revolute:
        yield from ((kind(joints=(joint,)), "") for kind in kinds)


def find_effect(text: str, chain: Chain, conditions: Conditions) -> Effect:
    """Return the effect of a name.

    Args:
        text: NAME[:JOINT][:KEY=VALUE,...], such as ``gear_eccentricity:joint_3:order=2``, the keys
            those by which effects differ (``order``, ``frame``, ``source``); the first of its likes
            where keys leave it open. Waves of a gear stage or of an encoder's lines have any order.
        chain: the chain on which it acts.
        conditions: the poses that there are to choose from.

    Raises:
        BadInputError: for a name, joint or key that is invalid, or an effect that such poses can't
            show.

    Example:
        >>> from pincal.robot.robot import Robot
        >>> chain = Chain.of(Robot.from_urdf("ur10"))
        >>> q = chain.robot.random_configurations(20, np.random.default_rng(0))
        >>> find_effect("gear_eccentricity:elbow_joint:order=2", chain, Conditions.at(q))
        GearEccentricity(joint='elbow_joint', order=2)
    """
    name, pairs = effect_parts(text)
    joint = dict(reversed(pairs)).get("joint")
    keys = {key: value for key, value in pairs if key != "joint"}
    situation = PoseSet(chain, conditions)
    judged = [*_single_compliances(situation), *_judged(situation)]
    if "order" in keys:
        judged = [_tuned(text, pair, keys["order"], situation) for pair in judged]
    # Those that can be shown first.
    judged.sort(key=lambda pair: bool(pair[1]))
    likes = [(effect, reason) for effect, reason in judged if effect.name == name]
    if not likes:
        known = nearest_first([name], [effect.name for effect, _ in judged])
        raise BadInputError(f"effect {text!r}: unknown; expected one of {', '.join(known)}")
    likes = _at(text, joint, likes)
    likes = [
        (effect, reason)
        for effect, reason in likes
        if all(_matches(effect, k, v) for k, v in keys.items())
    ]
    if not likes:
        raise BadInputError(
            f"effect {text!r}: none has {', '.join(f'{k}={v}' for k, v in keys.items())}; "
            "leave it out"
        )
    effect, reason = likes[0]
    if reason:
        raise BadInputError(f"effect {text!r}: poses alone can't show it: {reason}")
    return effect


def needs_column(text: str, column: str, robot: Robot) -> bool:
    """Return whether an effect, as in :func:`find_effect`, can be shown only where a column is
    recorded.
    """
    name = text.split(":")[0].strip()
    anywhere = PoseSet(Chain.of(robot), Conditions.at(np.zeros((2, robot.n_joints))))
    return any(
        column in candidate.effect.needs
        for candidate in _all(anywhere)
        if candidate.effect.name == name
    )


def _matches(effect: Effect, key: str, value: str) -> bool:
    at = effect.locus
    keys = {
        "order": at.order,
        "frame": at.frame,
        "source": at.source,
        "joint": at.joint,
        "shape": at.shape,
    }
    return str(keys.get(key)) == value or (key == "order" and isinstance(effect, Harmonic))


def _tuned(
    text: str, pair: tuple[Effect, str], order: str, situation: PoseSet
) -> tuple[Effect, str]:
    """Return an effect and why it can't be tested, a harmonic tuned to the given order."""
    effect = pair[0]
    if not isinstance(effect, Harmonic):
        return pair
    (cycles,) = plain_numbers([order]) or [0.0]
    if not 0.0 < cycles <= ORIGIN.finest:
        raise BadInputError(
            f"effect {text!r}: order={order}; expected a number of cycles per revolution, "
            f"such as 101, of at most {ORIGIN.finest:g}"
        )
    tuned = effect.tuned(cycles)
    return tuned, why_not_testable(Candidate(tuned), situation)


def _at(text: str, joint: str | None, likes: list[tuple[Effect, str]]) -> list[tuple[Effect, str]]:
    """Return the effects that act on a joint, or on the whole arm."""
    everywhere = [effect.locus.joint for effect, _ in likes]
    joints = nearest_first([joint or ""], [place for place in everywhere if place is not None])
    if joint is None and joints and None not in everywhere:
        name = likes[0][0].name
        raise BadInputError(
            f"effect {text!r}: names no joint; expected {name}:JOINT, one of {', '.join(joints)}"
        )
    if joint is not None and joint not in joints:
        where = (
            f"expected one of {', '.join(joints)}"
            if joints
            else "it acts on the whole arm, leave out the joint"
        )
        raise BadInputError(f"effect {text!r}: not on {joint!r}; {where}")
    return [(effect, reason) for effect, reason in likes if effect.locus.joint == joint]
