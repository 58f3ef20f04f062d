r"""How far readings are from a calibrated model, against what noise and the calibration's own uncertainty allow.

With residuals r of rows that the calibration did not use, weights W by the noise, Jacobians R and F by the parameters that
are known with covariance C and by those that are found from the very rows,

.. math:: \chi^2 = r^T V^{-1} r, \quad V = W^{-1} + R C R^T, \quad F \text{ projected out,}

follows the chi-square distribution if the robot is what the model says. It follows from the same A and b as a station's part
of a joint fit, see :mod:`pincal.identify.posterior`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from pincal.identify.normal import accumulate
from pincal.identify.posterior import eliminate
from pincal.identify.station import Station
from pincal.validate.lack_of_fit import explained_by_uncertainty


@dataclass(frozen=True)
class Misfit:
    """Misfit of a model to rows that its calibration did not use, all squares in units of the noise.

    Attributes:
        square: chi-square with the calibration's uncertainty allowed for.
        plain: sum of squared residuals.
        expected: what that is on average if noise and the calibration's uncertainty are all there is.
        degrees: degrees of freedom of both.
        found: number of directions that were found from the very rows.
    """

    square: float
    plain: float
    expected: float
    degrees: int
    found: int

    @property
    def ratio(self) -> float:
        """Residuals over what is expected of them, root mean square; 1 where no row is left to judge by."""
        return float(np.sqrt(self.plain / self.expected)) if self.degrees else 1.0

    @property
    def p_value(self) -> float:
        """Probability of a chi-square as large if noise and the calibration's uncertainty are all there is."""
        return float(chdtrc(self.degrees, self.square)) if self.degrees else 1.0


def misfit(
    station: Station,
    values: np.ndarray,
    *,
    covariance: np.ndarray,
    found: np.ndarray,
    sigma: np.ndarray,
    robust: np.ndarray,
) -> Misfit:
    """Return the misfit of a calibrated model to rows that its calibration did not use.

    Args:
        station: model and readings.
        values: shape (P,).
        covariance: shape (P, P), of what is known of the parameters from elsewhere; zero for those that are exact.
        found: shape (P,), parameters that were found from these rows; for them the covariance does not count.
        sigma: shape (blocks,), standard deviation of one component of each block of readings.
        robust: shape (N,), 0 for rows that are left out.
    """
    free = found | (np.diag(covariance) > 0.0)
    normal = accumulate(station, values, free, robust)
    counts = np.array([block.size for block in station.sensor.blocks]) * int(np.sum(robust > 0.0))
    G, g = normal.at(sigma) if found.any() else (_weighed(normal.G, sigma), _weighed(normal.g, sigma))
    sizes = np.array([parameter.size for parameter in station.parameters])[free]
    part = eliminate(G, g, found[free], sizes, values[free])
    directions = part.alone.visible_rank
    plain = float(np.sum(normal.squares / sigma**2) - g[found[free]] @ part.alone.step)
    known = free & ~found
    C = covariance[np.ix_(known, known)]
    degrees = int(counts.sum()) - directions
    return Misfit(
        square=max(plain - explained_by_uncertainty(part.G, part.g, C), 0.0),
        plain=max(plain, 0.0),
        expected=max(degrees, 0) + float(np.sum(C * part.G)),
        degrees=max(degrees, 0),
        found=directions,
    )


def _weighed(by_block: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("b,b...->...", sigma**-2.0, by_block))
