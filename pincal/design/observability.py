r"""Observability indices of a set of poses, as the literature numbers them (Sun and Hollerbach 2008).

With the singular values :math:`\sigma_1 \ge \dots \ge \sigma_r` of the identification Jacobian at n poses:

.. math:: O_1 = \frac{(\sigma_1 \cdots \sigma_r)^{1/r}}{\sqrt n} \quad
    O_2 = \frac{\sigma_r}{\sigma_1} \quad O_3 = \sigma_r \quad O_4 = \frac{\sigma_r^2}{\sigma_1} \quad
    O_5 = \Big(\sum_i \frac{1}{\sigma_i}\Big)^{-1}

Such indices depend on units and on the choice of parameters. Here columns are in units of the priors (so many mm, mrad),
readings in units of the noise, and base and tool are projected out. The r directions are those that all candidates
together, spread over n poses, tell better than the priors do: the same for all designs that are compared.
"""

from __future__ import annotations

import numpy as np

from pincal.design.design_model import DesignModel
from pincal.identify.quadratic import NULL

SOURCES = {
    "O1": "Borm and Menq 1989",
    "O2": "Driels and Pathre 1990",
    "O3": "Nahvi, Hollerbach and Hayward 1994",
    "O4": "Nahvi and Hollerbach 1996",
    "O5": "Sun and Hollerbach 2008",
}
"""Where each index comes from."""


def observed_directions(design_model: DesignModel, mean: np.ndarray, n: int) -> np.ndarray:
    """Return the directions that n average candidates tell, orthonormal in units of the priors, shape (H, r).

    They span parts of the H parameters that have a prior; ``mean`` is the information of one candidate, shape (F, F).
    """
    posterior = design_model.posterior(n * mean)
    return posterior.directions[:, posterior.information > 1.0]


def observability(design_model: DesignModel, directions: np.ndarray, H: np.ndarray, n: int) -> dict[str, float]:
    """Return O1 to O5, in these directions, of n poses with information H, shape (F, F); empty where they tell nothing."""
    if not directions.shape[1]:
        return {}
    posterior = design_model.posterior(H)
    overlap = directions.T @ posterior.directions
    squares = np.linalg.eigvalsh((overlap * posterior.information) @ overlap.T)
    if squares[0] <= NULL * squares[-1]:
        return dict.fromkeys(SOURCES, 0.0)
    sigma = np.sqrt(squares)
    return {
        "O1": float(np.exp(np.mean(np.log(sigma))) / np.sqrt(n)),
        "O2": float(sigma[0] / sigma[-1]),
        "O3": float(sigma[0]),
        "O4": float(sigma[0] ** 2 / sigma[-1]),
        "O5": float(1.0 / np.sum(1.0 / sigma)),
    }
