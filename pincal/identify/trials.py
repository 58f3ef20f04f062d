"""Which steps a fit tries from a point, one after the other, until one does not make things worse."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np

from pincal.identify.equations import Linearised

# Steps remembered, and the ratio of successive steps above which they are put to use.
_MEMORY = 4
_SLOW = 0.3
# Damping of the first step that is damped, in priors; how much more of it each refusal brings, how much less a success;
# and after how many refusals steps are halved instead.
_FIRST, _MORE, _LESS, _MOST = 3.0, 4.0, 2.0, 6
# How much more a step is damped that puts right what another one did wrong.
_REPAIR = 10.0
# Halvings of a step that made things worse, before the fit is taken to stand still.
_HALVINGS = 10


class Memory:
    """What earlier steps of a fit tell of the next one.

    Anderson's acceleration of a slowly converging fit (Walker and Ni 2011), over the last few steps: where residuals are
    large against what a direction is known by, Gauss-Newton overshoots it again and again by almost the same amount; two
    such steps tell where it settles. A fit that converges fast is left alone.

    Attributes:
        damping: of the last step that was taken, less what its success is worth; 0 while whole steps do.
        was_refused: whether the last point had steps that made things worse.
    """

    def __init__(self) -> None:
        self.damping = 0.0
        self.was_refused = False
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._points: list[np.ndarray] = []
        self._steps: list[np.ndarray] = []

    def accelerate(self, at: np.ndarray, step: np.ndarray, metric: np.ndarray) -> np.ndarray:
        """Return the step to take at the point ``at``, where Gauss-Newton wants ``step``; all of shape (F,)."""
        self._points = [*self._points[-_MEMORY:], at.copy()]
        self._steps = [*self._steps[-_MEMORY:], step.copy()]
        if self.damping or len(self._steps) < 3:
            return step
        if np.linalg.norm(metric * step) < _SLOW * np.linalg.norm(metric * self._steps[-2]):
            return step
        dx, ds = np.diff(self._points, axis=0).T, np.diff(self._steps, axis=0).T
        mix = np.linalg.lstsq(metric[:, None] * ds, metric * step, rcond=1e-8)[0]
        return np.asarray(step - (dx + ds) @ mix)


def trials(
    here: Linearised, sigma: np.ndarray, bounds: np.ndarray, steps: list[np.ndarray], memory: Memory
) -> Generator[np.ndarray, Linearised, None]:
    """Yield the steps to try, shape (F,), the largest first; each wants to be sent the point that it led to.

    Where two parameters multiply each other and the readings hardly tell them apart, such as a bearing's compliance and its
    place, what Gauss-Newton wants along this bent ridge leads far off it. A step is then damped by the priors, and what such
    a one did wrong all the same is put right from where it led to, by what the readings are surest of. A step that is halved
    instead creeps along the ridge.

    Args:
        here: the point to leave.
        sigma: shape (blocks,), the noise.
        bounds: shape (F,), largest values of the free parameters.
        steps: the accelerated step and Gauss-Newton's own, or the latter alone.
        memory: of the fit; its damping is kept up to date.
    """
    step, damping = steps[-1], memory.damping
    if steps[0] is not step:
        yield steps[0]
    for _ in range(_MOST if np.isfinite(here.sizes[here.free]).any() else 0):
        if damping:
            step = here.equations(sigma).step(bounds, damping)[0]
        memory.damping = damping / _LESS if damping > _FIRST else 0.0
        there = yield step
        # From where a whole step led to, putting it right may lead on into another valley.
        if damping:
            worse = there.objective(sigma) / max(here.objective(sigma), 1e-300)
            yield step + there.equations(sigma).step(bounds, _REPAIR * (1.0 + damping) * max(worse, 1.0))[0]
        damping = max(_FIRST, _MORE * damping)
    memory.damping = damping
    for k in range(_HALVINGS):
        yield step * 0.5**k
