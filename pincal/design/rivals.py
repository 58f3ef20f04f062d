"""Effects that are to be told apart: found by name, and how well a design does it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from difflib import get_close_matches

import numpy as np

from pincal.design.design_model import RIVAL
from pincal.discover.loop import place_of
from pincal.errors import BadInputError
from pincal.model.catalogue import TransmissionError, candidates, untestable
from pincal.model.chain import Chain
from pincal.model.effects import BearingElasticity, Compliance, Conditions, Effect, JointElasticity

# Pieces of a drive curve that is to be told from something else: as smooth as a discovery tries first.
_CURVE_SIZE = 8


def needs_approach(text: str) -> bool:
    """Return whether a rival, as in :func:`find_rival`, can be told only by the direction from which joints arrive."""
    return text.split(":")[0].strip() == "backlash"


def find_rival(text: str, chain: Chain, conditions: Conditions) -> Effect:
    """Return the effect of a name.

    Args:
        text: NAME[:JOINT][:KEY=VALUE,...], such as ``gear_eccentricity:joint_3:order=2``; the first of its likes where keys
            leave it open.
        chain: the chain on which it acts.
        conditions: the poses that there are to choose from.

    Raises:
        BadInputError: for a name, joint or key that can't be, or an effect that such poses can't show.

    Example:
        >>> from pincal.robot.robot import Robot
        >>> chain = Chain.of(Robot.from_urdf("ur10"))
        >>> q = chain.robot.random_configurations(20, np.random.default_rng(0))
        >>> find_rival("gear_eccentricity:elbow_joint:order=2", chain, Conditions.at(q))
        GearEccentricity(joint='elbow_joint', order=2)
    """
    name, *parts = (part.strip() for part in text.split(":"))
    joint = next((part for part in parts if "=" not in part), None)
    keys = dict(_pair(text, pair) for part in parts if "=" in part for pair in part.split(","))
    reasons = {id(effect): (effect, reason) for effect, reason in untestable(chain, conditions)}
    found = [*_elastic(chain), *candidates(chain, conditions), *(effect for effect, _ in reasons.values())]
    likes = [effect for effect in found if effect.name == name]
    if not likes:
        raise BadInputError(f"effect {text!r}: unknown; expected one of {_listed(name, (e.name for e in found))}")
    likes = _at(text, joint, likes)
    likes = [effect for effect in likes if all(str(vars(effect).get(key)) == value for key, value in keys.items())]
    if not likes:
        raise BadInputError(f"effect {text!r}: none has {', '.join(f'{k}={v}' for k, v in keys.items())}; leave it out")
    effect = likes[0]
    if id(effect) in reasons:
        raise BadInputError(f"effect {text!r}: poses alone can't show it: {reasons[id(effect)][1]}")
    return _smooth(effect, chain, conditions)


def _elastic(chain: Chain) -> Iterator[Effect]:
    """Yield the compliances of single joints, which the catalogue leaves to the model."""
    for joint, kind in zip(chain.robot.joint_names, chain.robot.joint_types, strict=True):
        if kind != "prismatic" and not chain.robot.massless:
            yield from (JointElasticity(joints=(joint,)), BearingElasticity(joints=(joint,)))


def _joint(effect: Effect) -> str | None:
    return effect.joints[0] if isinstance(effect, Compliance) and effect.joints else place_of(effect)[0]


def _at(text: str, joint: str | None, likes: list[Effect]) -> list[Effect]:
    """Return those of some effects that act on a joint, or on the whole arm."""
    places = list(dict.fromkeys(place for effect in likes if (place := _joint(effect)) is not None))
    if joint is None and places and all(_joint(effect) is not None for effect in likes):
        raise BadInputError(f"effect {text!r}: names no joint; expected {likes[0].name}:JOINT, one of {_listed('', places)}")
    if joint is not None and joint not in places:
        where = f"expected one of {_listed(joint, places)}" if places else "it acts on the whole arm, leave out the joint"
        raise BadInputError(f"effect {text!r}: not on {joint!r}; {where}")
    return [effect for effect in likes if _joint(effect) == joint]


def _pair(text: str, pair: str) -> tuple[str, str]:
    key, equals, value = (word.strip() for word in pair.partition("="))
    if not (key and equals and value):
        raise BadInputError(f"effect {text!r}: {pair!r}; expected KEY=VALUE, such as order=2")
    return key, value


def _listed(name: str, known: Iterable[str]) -> str:
    names = list(dict.fromkeys(known))
    near = get_close_matches(name, names, n=1, cutoff=0.7)
    return ", ".join([*near, *(other for other in names if other not in near)])


def _smooth(effect: Effect, chain: Chain, conditions: Conditions) -> Effect:
    """Return a drive curve with few pieces, anything else as it is."""
    if isinstance(effect, TransmissionError):
        q = conditions.q[:, chain.robot.joint_names.index(effect.joint)]
        return TransmissionError.over(effect.joint, q, _CURVE_SIZE)
    return effect


def weights(rivals: tuple[np.ndarray, ...], n_free: int) -> np.ndarray:
    """Return W of the criterion tr(W C) that tells rivals apart, shape (F, F).

    It is the sum of the variances of both rivals' parameters, in units of their typical sizes, with everything refitted:
    the A-criterion for a subset (A_s; Atkinson, Donev and Tobias 2007, sec. 10.3). Of an effect with one parameter the
    variance is the inverse of the non-centrality that T-optimality maximises (Atkinson and Fedorov 1975); of several it
    makes up for the worst direction first.
    """
    W = np.zeros((n_free, n_free))
    for columns in rivals:
        W[columns, columns] = RIVAL**2
    return W


def noncentrality(C: np.ndarray, rivals: tuple[np.ndarray, ...]) -> tuple[float, ...]:
    """Return, for each rival of typical size, its squared signal in units of the noise that no refit takes up.

    The rest, the other rival among it, is refitted; it is the mean over the directions of its parameters.

    Args:
        C: shape (F, F), posterior covariance in units of the priors.
        rivals: places of their parameters.
    """
    found = []
    for columns in rivals:
        left = np.linalg.inv(C[np.ix_(columns, columns)]) - np.eye(len(columns))
        found.append(max(float(np.trace(left)) / len(columns) / RIVAL**2, 0.0))
    return tuple(found)
