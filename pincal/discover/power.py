"""How large an effect has to be to be found, and which measurement would tell two effects apart: predicted, not guessed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pincal.discover.criticism import Criticism, criticise
from pincal.identify.calibrate import Fit
from pincal.identify.normal import block_rows
from pincal.model.effects import Conditions, Effect

# Non-centrality at which a test at 1 % family-wise over some hundred candidates has 90 % power, by degrees of freedom
# (DISCOVERY 2.2).
_DETECTABLE = {1: 26.0, 2: 30.0, 3: 32.0, 4: 34.0, 6: 38.0}
# Non-centrality above which two effects count as told apart.
TOLD_APART = 30.0
# A design has to do better than the same poses once more, by this factor.
_TELLING = 1.5
# What another run could change.
_WARMER = 10.0


@dataclass(frozen=True)
class Detectable:
    """The smallest size of an effect that would be found.

    Attributes:
        effect: what.
        parameter: its first parameter's name.
        size: of this parameter, in its unit; None where no size would show.
        unit: the unit.
    """

    effect: Effect
    parameter: str
    size: float | None
    unit: str


def minimum_detectable(fit: Fit, effects: Sequence[Effect]) -> list[Detectable]:
    """Return, for each effect, how large its parameters would have to be to be found with these poses and this noise."""
    found = criticise(fit, effects, [], np.zeros(len(fit.problem), int))
    S, _ = found._projected
    out = []
    for i, effect in enumerate(effects):
        j = found.columns_of([i])
        parameter = effect.parameters(fit.model.chain)[0]
        _, rank = found.gain([i])
        threshold = _DETECTABLE[min((k for k in _DETECTABLE if k >= rank), default=6)] if rank else None
        strength = float(np.max(np.diag(S)[j])) if rank else 0.0
        size = float(np.sqrt(threshold / strength)) if threshold and strength > 0 else None
        out.append(Detectable(effect, parameter.name, size, parameter.unit))
    return out


def deciding_measurement(fit: Fit, found: Criticism, best: int, rival: Effect) -> str:
    """Return, in words, the cheapest further measurement that would tell an effect from a rival.

    For each kind of further run the power to tell them apart is computed from the Jacobian at its poses.

    Args:
        fit: the fit before the effect was added.
        found: its criticism.
        best: the effect among the candidates of ``found``.
        rival: the other one.
    """
    pair = [found.effects[best], rival]
    here = criticise(fit, pair, [], np.zeros(len(fit.problem), int))
    value, _ = found.estimate([best])
    again = _separation(replace(here, S=2.0 * here.S), value)
    for words, conditions in _designs(fit):
        try:
            more = _criticised_at(fit, pair, conditions, here)
        except (ValueError, KeyError):
            continue
        if _separation(more, value) > max(TOLD_APART, _TELLING * again):
            return words
    many = TOLD_APART / max(_separation(here, value), 1e-9)
    if many < 50:
        return f"about {int(np.ceil(many)) * len(fit.problem)} poses of this kind"
    return "no further run of this kind tells them apart; look at the joint itself, or at its drive's own encoder"


def _separation(found: Criticism, value: np.ndarray) -> float:
    """Return the signal of the first effect that the second can't take over, squared, in units of the noise."""
    S, _ = found._projected
    c, g = found.columns_of([0]), found.columns_of([1])
    G = S[np.ix_(g, g)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(G), 1e-300))
    left = (
        S[np.ix_(c, c)]
        - S[np.ix_(c, g)]
        @ (scale[:, None] * np.linalg.pinv(G * np.outer(scale, scale), rcond=1e-6, hermitian=True) * scale)
        @ S[np.ix_(g, c)]
    )
    return float(max(value @ left @ value, 0.0))


def _designs(fit: Fit) -> Iterator[tuple[str, Conditions]]:
    """Return further runs that a user could make, cheapest first."""
    c = fit.problem.conditions
    rng = np.random.default_rng(0)
    robot = fit.model.chain.robot
    load = 0.1 * float(robot.masses.sum()) if not np.any(c.payload) else 2.0 * float(c.payload.max())
    if np.ptp(c.payload) == 0.0:
        yield "the same poses with a second payload", replace(c, payload=np.full(len(c), load))
    if c.approach is None or not np.ptp(c.approach):
        yield (
            "the same poses approached from both directions, with the columns approach_<joint>",
            replace(c, approach=rng.choice([-1.0, 1.0], c.q.shape)),
        )
    temperature = np.full(len(c), 20.0) if c.temperature is None else c.temperature
    if np.ptp(temperature) < _WARMER:
        yield "the same poses warm and cold, with the column temperature", replace(c, temperature=temperature + _WARMER)
    yield "poses over the whole range of the joints", replace(c, q=robot.random_configurations(len(c), rng))


def _criticised_at(fit: Fit, pair: list[Effect], conditions: Conditions, here: Criticism) -> Criticism:
    """Return the tests that the present readings and those at further conditions would allow together."""
    problem = replace(fit.problem, conditions=conditions)
    there = criticise(replace(fit, problem=problem), pair, [], np.zeros(len(problem), int))
    return replace(here, S=here.S + there.S)


def drive_errors(fit: Fit, lever: Callable[[Fit, str], np.ndarray], joint: str) -> np.ndarray:
    """Return the error of a joint's position that would explain each row's residual best, shape (N,) [rad or m]."""
    rows = block_rows(fit.problem)[0]
    a = lever(fit, joint)[rows]
    r = fit.problem.residuals(fit.values)[rows]
    return np.asarray(np.sum(a * r, axis=0) / np.maximum(np.sum(a**2, axis=0), 1e-300))
