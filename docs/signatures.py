"""What each effect of the catalogue does to an arm, drawn, and which others could take its place: for the page of effects.

The arm is the KUKA KR 125/2, in 400 random poses in which everything varies that a table may record.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields
from functools import cache
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from pincal import ELASTIC, Conditions, Effect, Robot
from pincal.builtin import kuka_urdf_path
from pincal.io.entries import EFFECTS
from pincal.model.chain import Chain
from pincal.model.conditions import PoseSet
from pincal.model.effect import Discoverable, Family, Harmonic
from pincal.model.effects import BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.recorded import RECORDABLE

PICTURES = Path(__file__).parent / "pictures" / "effects"
_POSES = 400
# Where a tracker stands in the robot's base frame [m].
_TRACKER = np.array([-4.0, 2.5, 0.4])
# Compliances of a heavy arm's joints about x, y, z [rad/(N m)].
_SOFT = (2e-8, 2e-8, 1e-7) * 6
# The joints on which effects are shown; cycles per revolution of what has many; poses of a sweep.
_JOINTS = ("joint_2", "joint_3")
_WAVES = 12.0
_STEPS = 60
# A moment that changes by less than this part of the largest is rounding.
_FELT = 1e-6
# What is below this part of the largest is rounding.
_DISTINCT = 1e-9
# How large a frame's parameters are, which may be anywhere [m or rad].
_FRAME = 1e-3
# A look-alike takes at least this share of the square of what is left beside geometry and elasticity.
ALIKE = 0.3


# What is shown, in words, and the two axes of the picture.
_Drawing = tuple[str, tuple[str, np.ndarray], tuple[str, np.ndarray]]


@dataclass(frozen=True)
class Signature:
    """What one effect does.

    Attributes:
        effect: the effect, on one joint of the arm.
        what: what the picture shows, in words.
        variable: what it follows, with its unit, and shape (N,) its values.
        moved: what of the arm it moves most, with its unit, and shape (N,) by how much; of a constant how it moves the
            target, shape (N, 3), as one joint turns.
        alike: names of effects that could take its place, with the share that they take, largest first.
    """

    effect: Effect
    what: str
    variable: tuple[str, np.ndarray]
    moved: tuple[str, np.ndarray]
    alike: tuple[tuple[str, float], ...] = ()

    @property
    def is_constant(self) -> bool:
        """Whether it adds the same in all poses."""
        return self.moved[1].ndim > 1


@cache
def situation() -> PoseSet:
    """Return the arm and its poses."""
    robot, rng = Robot.from_urdf(kuka_urdf_path()), np.random.default_rng(0)
    q = robot.random_configurations(_POSES, rng)
    conditions = Conditions(
        q,
        np.zeros(_POSES, int),
        rng.choice([0.0, 80.0], _POSES),
        np.array([0.1, 0.0, 0.2]),
        temperature=rng.uniform(15.0, 35.0, _POSES),
        time=np.sort(rng.uniform(0.0, 3e4, _POSES)),
        approach=rng.choice([-1.0, 1.0], (_POSES, 6)),
        droop=rng.normal(0.0, 1e-4, (_POSES, 6)),
        move=rng.uniform(-2.0, 2.0, (_POSES, 6)),
        velocity=rng.normal(0.0, 0.5, (_POSES, 6)),
        sighted=robot.forward_kinematics(q)[:, :3, 3] - _TRACKER,
    )
    return PoseSet(Chain.of(robot, moment_frame="before"), conditions, _SOFT)


@cache
def own_effects() -> dict[str, type[Effect]]:
    """Return every effect that comes with pincal, by name; none of a plugin."""
    return {name: cls for name, cls in sorted(EFFECTS.known().items()) if cls.__module__.startswith("pincal.")}


@cache
def signatures() -> dict[str, Signature]:
    """Return the signature of every effect that discovery looks for, by name."""
    at = situation()
    others = {name: _examples(cls, at) for name, cls in own_effects().items()}
    motions = {name: [_motion(at, (effect,)) for effect in effects] for name, effects in others.items()}
    found = {}
    for name, effects in others.items():
        chosen = next((k for k, effect in enumerate(effects) if effect.locus.joint in _JOINTS), 0 if effects else None)
        if chosen is None:
            continue
        values = _values(effects[chosen], at)
        moves = _motion(at, (effects[chosen],)) @ values
        # So large that it moves the target by 0.1 mm rms.
        values *= 1e-4 * np.sqrt(_POSES) / max(float(np.linalg.norm(moves)), 1e-30)
        drawn = _drawn(effects[chosen], values, at)
        if drawn is None:
            found[name] = Signature(effects[chosen], *_swept(effects[chosen], at))
            continue
        shares = {}
        for other in (other for other in others if other != name):
            rotation = _known(frozenset({name, other}))
            left, bases = _left(motions[name][chosen] @ values, rotation), (_left(of, rotation) for of in motions[other])
            shares[other] = max((_share(left, basis) for basis in bases), default=0.0)
        alike = sorted(((other, share) for other, share in shares.items() if share > ALIKE), key=lambda pair: -pair[1])
        found[name] = Signature(effects[chosen], *drawn, tuple(alike))
    return found


def _examples(cls: type[Effect], at: PoseSet) -> list[Effect]:
    """Return an effect in every place of the arm, as a discovery tries it first; a single one of what is none of its."""
    if issubclass(cls, Discoverable):
        found = [(candidate.forms or (candidate.effect,))[0] for candidate in cls.candidates(at)]
        return [effect.tuned(_WAVES) if isinstance(effect, Harmonic) else effect for effect in found]
    needed = [field.name for field in fields(cls) if field.default is MISSING]
    return [cls(**dict.fromkeys(needed, _JOINTS[0]))] if needed in ([], ["joint"]) else []


def _motion(at: PoseSet, effects: tuple[Effect, ...]) -> np.ndarray:
    """Return how the target moves with each parameter, shape (3 N, P)."""
    model = Model(at.chain, effects)
    return model.linearise(np.zeros(model.n_parameters), at.conditions)[1].reshape(-1, model.n_parameters)


@cache
def _known(names: frozenset[str]) -> np.ndarray:
    """Return the directions of geometry and elasticity, but for linear elasticity of these names, shape (3 N, R)."""
    others = [e for e in ELASTIC if e.family is Family.GEOMETRY or e.name not in names]
    columns = _motion(situation(), (*others, BaseFrame(), ToolFrame()))
    sizes = np.linalg.norm(columns, axis=0)
    seen = sizes > _DISTINCT * sizes.max()
    directions, sizes, _ = np.linalg.svd(columns[:, seen] / sizes[seen], full_matrices=False)
    return np.asarray(directions[:, sizes > _DISTINCT * sizes[0]])


def _left(columns: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return what geometry and elasticity leave of columns; nothing where that is rounding."""
    left = columns - rotation @ (rotation.T @ columns)
    return np.asarray(np.where(np.linalg.norm(left, axis=0) > _DISTINCT * np.linalg.norm(columns, axis=0), left, 0.0))


def _share(signal: np.ndarray, basis: np.ndarray) -> float:
    """Return the part of the square of a signal that a basis takes."""
    fitted = basis @ np.linalg.lstsq(basis, signal, rcond=1e-9)[0]
    return float(fitted @ fitted / max(signal @ signal, 1e-300))


def _values(effect: Effect, at: PoseSet) -> np.ndarray:
    """Return values of the parameters as large as they may be; of a curve, those of a wave with a kink."""
    sizes = np.array([min(parameter.size, _FRAME) for parameter in effect.parameters(at.chain)])
    if not effect.shares_scale:
        return np.asarray(sizes * 0.7 ** np.arange(len(sizes)))
    place = np.linspace(-1.0, 1.0, len(sizes))
    return np.asarray(sizes * (np.sin(5.0 * place) - 1.5 * np.abs(place - 0.3) + 1.0))


def _swept(effect: Effect, at: PoseSet) -> _Drawing:
    """Return how one parameter moves the target as a joint turns and the others stand, by 0.1 mm rms."""
    joint = at.joints.index(_JOINTS[0])
    q = np.tile(0.5, (_STEPS, len(at.joints)))
    q[:, joint] = np.linspace(at.chain.robot.lower[joint], at.chain.robot.upper[joint], _STEPS)
    model = Model(at.chain, (*ELASTIC, effect))
    compliances = dict(zip([f"{name}.k_{axis}" for name in at.joints for axis in "xyz"], _SOFT, strict=True))
    values = np.array([compliances.get(parameter.name, 0.0) for parameter in model.parameters])
    conditions = Conditions.at(q, payload=80.0, payload_centre=(0.1, 0.0, 0.2))
    jacobian = model.linearise(values, conditions)[1]
    own = [p.name for p in effect.parameters(at.chain)]
    # That of the joint itself where there is one for each; of a frame a turn about the vertical, of a target its distance.
    first = next((name for name in own if name.startswith(f"{_JOINTS[0]}.")), "base.rz" if "base.rz" in own else own[0])
    moved = 1e3 * jacobian[:, :, model.index(first)]
    moved *= 0.1 / np.sqrt(np.mean(np.sum(moved**2, axis=1)))
    label = f"{_JOINTS[0]} [deg], {first} alone"
    what = f"how the target moves along x, y and z of the base as {_JOINTS[0]} turns, if {first} is off"
    return what, (label, np.rad2deg(q[:, joint])), ("target moves [mm]", moved)


def _drawn(effect: Effect, values: np.ndarray, at: PoseSet) -> _Drawing | None:
    """Return the variable and what is moved most, by rms, each in words with its numbers; None of a constant."""
    moved = np.zeros((_POSES, at.chain.size))
    for term in effect.terms(at.chain, at.conditions, at.moments if effect.uses_moments else None):
        moved[:, term.coordinate] += values[term.parameter] * (1.0 if term.basis is None else term.basis)
    k = int(np.argmax(moved.std(axis=0)))
    if not np.ptp(moved[:, k]):
        return None
    label, variable = "shift [mm]" if at.chain.layout.kind[k] >= 3 else "turn [mrad]", _variable(effect, moved[:, k], at)
    where = f"at {effect.locus.joint}" if effect.locus.joint else "in one place of the arm"
    where = "along an axis of the instrument" if effect.is_sighted else where
    what = f"the {label.split()[0]} added {where}, as a function of {variable[0].rsplit(' [', 1)[0]}"
    if isinstance(effect, Harmonic):
        what += f" (drawn with {_WAVES:.0f} cycles per revolution)"
    return what, variable, (label, 1e3 * moved[:, k])


def _variable(effect: Effect, moved: np.ndarray, at: PoseSet) -> tuple[str, np.ndarray]:
    """Return what an effect follows; where it says nothing, the moment or the position that it follows best."""
    follows = effect.locus.follows
    if follows in at.joints:
        return f"{follows} [deg]", np.rad2deg(at.positions(follows))
    if follows in RECORDABLE:
        values = np.asarray(at.conditions.column(follows))
        if values.ndim > 1:
            values = values[:, at.joints.index(effect.locus.joint or _JOINTS[0])]
        unit = RECORDABLE[follows].unit
        return f"{follows} [{unit}]" if unit else follows, values
    if effect.is_sighted and at.conditions.sighted is not None:
        x, y, z = at.conditions.sighted.T
        if effect.locus.acts_on in ("range", "directions"):
            ways = (x,) if effect.locus.acts_on == "range" else (x, y, z)
            k = int(np.argmax([abs(np.corrcoef(moved, way)[0, 1]) for way in ways]))
            return f"{'xyz'[k]} of the target [m]", ways[k]
        angle = np.arctan2(y, x) if effect.locus.acts_on == "azimuth" else np.arctan2(z, np.hypot(x, y))
        return f"{'azimuth' if effect.locus.acts_on == 'azimuth' else 'elevation'} of the target [deg]", np.rad2deg(angle)
    felt = at.moments.std(axis=0) > _FELT * at.moments.std(axis=0).max()
    rank = [abs(np.corrcoef(at.moments[:, k], moved)[0, 1]) if is_felt else 0.0 for k, is_felt in enumerate(felt)]
    best = int(np.argmax(rank))
    return f"moment about {'xyz'[best % 3]} of {at.joints[best // 3]} [N m]", at.moments[:, best]


def draw() -> None:
    """Draw every signature into a file of its own."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    for name, signature in signatures().items():
        figure = Figure(figsize=(4.6, 1.9), layout="constrained")
        axes = figure.subplots()
        (label, x), (moved, y) = signature.variable, signature.moved
        if y.ndim == 1:
            axes.plot(x, y, ".", markersize=2.5, color="#0072b2")
        else:
            for axis, colour, values in zip("xyz", ("#d55e00", "#009e73", "#0072b2"), y.T, strict=True):
                axes.plot(x, values, color=colour, label=axis)
            axes.legend(fontsize=7, frameon=False, ncols=3)
        axes.set_xlabel(label, fontsize=8)
        axes.set_ylabel(moved, fontsize=8)
        axes.tick_params(labelsize=7)
        axes.spines[["top", "right"]].set_visible(False)
        figure.savefig(PICTURES / f"{name}.png", dpi=130)
