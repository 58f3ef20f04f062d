r"""A smooth function of two variables, in sines.

With positions x in a range of half width r about its middle, held at its ends beyond it, and
:math:`L = r + 1.5\,l`,

.. math:: f(x, y) = \sum_{jk} c_{jk} \sin \omega_j (x - x_0 + L_x) \sin \omega'_k (y - y_0 + L_y) ,
    \qquad \omega_j = \frac{\pi j}{2 L_x} ,

with independent coefficients of standard deviation
:math:`s \sqrt{2 \pi l_x l_y / L_x L_y}\, e^{-(l_x^2 \omega_j^2 + l_y^2 \omega_k'^2) / 4}`, is a
Gaussian process of covariance :math:`s^2 e^{-(x - x')^2 / 2 l_x^2 - (y - y')^2 / 2 l_y^2}` (Solin
and Särkkä 2020, Statistics and Computing 30, 419-446).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pincal.model.effect_bases import waves
from pincal.model.effect_numbers import FIELD
from pincal.model.symbols import held

_Span = tuple[float, float]


@dataclass(frozen=True)
class SmoothField:
    """A smooth function of two variables x and y.

    Attributes:
        x, y: their ranges.
        lengths: over which values are alike, along x and y.
    """

    x: _Span
    y: _Span
    lengths: tuple[float, float]

    @property
    def orders(self) -> np.ndarray:
        """The angular frequencies of the functions along x and y, shape (K, 2)."""
        steps = 0.5 * np.pi / self._reach
        scale = steps * self.lengths
        most = np.sqrt(2.0 * FIELD.faintest) / scale
        j, k = (np.arange(1.0, of + 1.0) for of in np.ceil(most))
        both = np.stack([axis.ravel() for axis in np.meshgrid(j, k, indexing="ij")], axis=1)
        kept = 0.5 * np.sum((both * scale) ** 2, axis=1) <= FIELD.faintest
        kept[0] = True
        return np.asarray(both[kept] * steps)

    @property
    def sizes(self) -> np.ndarray:
        """Standard deviations of the coefficients of a function of standard deviation 1, shape
        (K,).
        """
        area = 2.0 * np.pi * np.prod(self.lengths) / np.prod(self._reach)
        decay = 0.25 * np.sum((self.orders * self.lengths) ** 2, axis=1)
        return np.asarray(np.sqrt(area) * np.exp(-decay))

    def basis(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the functions at positions, shape (N,) each: shape (K, N)."""
        starts = np.mean([self.x, self.y], axis=1) - self._reach
        (of_x, of_y) = zip(*self.orders.tolist(), strict=True)
        along = [
            {order: waves(order * (held(at, *span) - start))[0] for order in set(of)}
            for at, span, start, of in zip(
                (x, y), (self.x, self.y), starts.tolist(), (of_x, of_y), strict=True
            )
        ]
        return np.stack([along[0][m] * along[1][n] for m, n in zip(of_x, of_y, strict=True)])

    @property
    def _reach(self) -> np.ndarray:
        """Half of the lengths of the domains, shape (2,)."""
        half = 0.5 * np.ptp([self.x, self.y], axis=1)
        return np.asarray(half + FIELD.beyond * np.array(self.lengths))
