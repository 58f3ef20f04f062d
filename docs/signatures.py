"""What each effect of the catalogue does to an arm, drawn, and which others could take its place: for the page of effects.

The arm is the KUKA KR 125/2, in 400 random poses in which everything varies that a table may record.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from pincal import ELASTIC, Chain, Conditions, Discoverable, Effect, Model, Robot, Situation
from pincal.builtin import kuka_urdf_path
from pincal.io.effect_entry import known_effects
from pincal.model.conditions import COLUMN_UNITS
from pincal.model.effects import BaseFrame, ToolFrame

PICTURES = Path(__file__).parent / "pictures" / "effects"
_POSES = 400
# Compliances of a heavy arm's joints about x, y, z [rad/(N m)].
_SOFT = (2e-8, 2e-8, 1e-7) * 6
# A look-alike takes at least this share of the square of what is left beside geometry and elasticity.
_ALIKE = 0.3


@dataclass(frozen=True)
class Signature:
    """What one effect does.

    Attributes:
        effect: the effect, on one joint of the arm.
        variable: what it follows, with its unit, and shape (N,) its values.
        moved: what of the arm it moves most, with its unit, and shape (N,) by how much.
        alike: names of effects that could take its place, with the share that they take, largest first.
    """

    effect: Effect
    variable: tuple[str, np.ndarray]
    moved: tuple[str, np.ndarray]
    alike: tuple[tuple[str, float], ...]

    @property
    def is_drawn(self) -> bool:
        """Whether it moves anything by more than a constant."""
        return bool(np.ptp(self.moved[1]) > 0.0)


@cache
def situation() -> Situation:
    """Return the arm and its poses."""
    robot, rng = Robot.from_urdf(kuka_urdf_path()), np.random.default_rng(0)
    conditions = Conditions(
        robot.random_configurations(_POSES, rng),
        np.zeros(_POSES, int),
        rng.choice([0.0, 80.0], _POSES),
        np.array([0.1, 0.0, 0.2]),
        temperature=rng.uniform(15.0, 35.0, _POSES),
        time=np.sort(rng.uniform(0.0, 3e4, _POSES)),
        approach=rng.choice([-1.0, 1.0], (_POSES, 6)),
        droop=rng.normal(0.0, 1e-4, (_POSES, 6)),
    )
    return Situation(Chain.of(robot, moment_frame="before"), conditions, _SOFT)


@cache
def own_effects() -> dict[str, type[Effect]]:
    """Return every effect that comes with pincal, by name; none of a plugin."""
    return {name: cls for name, cls in sorted(known_effects().items()) if cls.__module__.startswith("pincal.")}


@cache
def signatures() -> dict[str, Signature]:
    """Return the signature of every effect that discovery looks for, by name."""
    at = situation()
    others = {
        name: [form for candidate in cls.candidates(at) for form in candidate.forms[:1]]
        for name, cls in own_effects().items()
        if issubclass(cls, Discoverable)
    }
    known = _motion(at, (*ELASTIC, BaseFrame(), ToolFrame()))
    rotation = np.linalg.qr(known / np.maximum(np.linalg.norm(known, axis=0), 1e-30))[0]
    bases = {name: [_left(_motion(at, (effect,)), rotation) for effect in effects] for name, effects in others.items()}
    found = {}
    for name, effects in others.items():
        joints = ("joint_2", "joint_3")
        chosen = next((k for k, effect in enumerate(effects) if effect.locus.joint in joints), 0 if effects else None)
        if chosen is None:
            continue
        values = _values(effects[chosen], at)
        # So large that it moves the target by 0.1 mm rms.
        values *= 1e-4 * np.sqrt(_POSES) / np.linalg.norm(_motion(at, (effects[chosen],)) @ values)
        left = bases[name][chosen] @ values
        shares = {
            other: max((_share(left, basis) for basis in bases[other]), default=0.0) for other in others if other != name
        }
        alike = sorted(((other, share) for other, share in shares.items() if share > _ALIKE), key=lambda pair: -pair[1])
        found[name] = Signature(effects[chosen], *_drawn(effects[chosen], values, at), tuple(alike))
    return found


def _motion(at: Situation, effects: tuple[Effect, ...]) -> np.ndarray:
    """Return how the target moves with each parameter, shape (3 N, P)."""
    model = Model(at.chain, effects)
    return model.linearise(np.zeros(model.n_parameters), at.conditions)[1].reshape(-1, model.n_parameters)


def _left(columns: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    return np.asarray(columns - rotation @ (rotation.T @ columns))


def _share(signal: np.ndarray, basis: np.ndarray) -> float:
    """Return the part of the square of a signal that a basis takes."""
    fitted = basis @ np.linalg.lstsq(basis, signal, rcond=1e-9)[0]
    return float(fitted @ fitted / max(signal @ signal, 1e-300))


def _values(effect: Effect, at: Situation) -> np.ndarray:
    """Return values of the parameters as large as they may be; of a curve, those of a wave with a kink."""
    sizes = np.array([parameter.size for parameter in effect.parameters(at.chain)])
    if not effect.alike:
        return np.asarray(sizes * 0.7 ** np.arange(len(sizes)))
    place = np.linspace(-1.0, 1.0, len(sizes))
    return np.asarray(sizes * (np.sin(5.0 * place) - 1.5 * np.abs(place - 0.3) + 1.0))


def _drawn(effect: Effect, values: np.ndarray, at: Situation) -> tuple[tuple[str, np.ndarray], tuple[str, np.ndarray]]:
    """Return the variable and what is moved most, by rms, each in words with its numbers."""
    moved = np.zeros((_POSES, at.chain.size))
    for term in effect.terms(at.chain, at.conditions, at.moments if effect.uses_moments else None):
        moved[:, term.coordinate] += values[term.parameter] * (1.0 if term.basis is None else term.basis)
    k = int(np.argmax(moved.std(axis=0)))
    label = "shift [mm]" if at.chain.layout.kind[k] >= 3 else "turn [mrad]"
    return _variable(effect, moved[:, k], at), (label, 1e3 * moved[:, k])


def _variable(effect: Effect, moved: np.ndarray, at: Situation) -> tuple[str, np.ndarray]:
    """Return what an effect follows; where it says nothing, the moment or the position that it follows best."""
    follows = effect.locus.follows
    if follows in at.joints:
        return f"{follows} [deg]", np.rad2deg(at.positions(follows))
    if follows in COLUMN_UNITS:
        values = np.asarray(at.conditions.column(follows))
        if values.ndim > 1:
            values = values[:, at.joints.index(effect.locus.joint)]
        unit = COLUMN_UNITS[follows]
        return f"{follows} [{unit}]" if unit else follows, values
    rank = np.abs([np.corrcoef(moment, moved)[0, 1] if moment.std() else 0.0 for moment in at.moments.T])
    best = int(np.nanargmax(rank))
    return f"moment about {'xyz'[best % 3]} of {at.joints[best // 3]} [N m]", at.moments[:, best]


def draw() -> None:
    """Draw every signature into a file of its own."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    for name, signature in signatures().items():
        if not signature.is_drawn:
            continue
        figure = Figure(figsize=(4.6, 1.9), layout="constrained")
        axes = figure.subplots()
        (label, x), (moved, y) = signature.variable, signature.moved
        axes.plot(x, y, ".", markersize=2.5, color="#0072b2")
        axes.set_xlabel(label, fontsize=8)
        axes.set_ylabel(moved, fontsize=8)
        axes.tick_params(labelsize=7)
        axes.spines[["top", "right"]].set_visible(False)
        figure.savefig(PICTURES / f"{name}.png", dpi=130)
