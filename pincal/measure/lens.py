"""A camera's image of points in front of it: a pinhole with radial and tangential distortion.

With x = X / Z, y = Y / Z and r^2 = x^2 + y^2 of a point in the camera's frame (z along the view, x to the right, y down):

    x'' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y'' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y
    u = fx x'' + u0,  v = fy y'' + v0

(Brown 1966; the same order and signs as OpenCV's.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PINHOLE = ("fx", "fy", "u0", "v0")
DISTORTION = ("k1", "k2", "p1", "p2", "k3")
# Points nearer to the plane of the lens than this [m], or behind it, have no image; their prediction stays finite.
NEAREST = 1e-3


@dataclass(frozen=True)
class Lens:
    """Intrinsic parameters of a camera.

    Attributes:
        fx, fy: focal lengths [px].
        u0, v0: principal point [px].
        k1, k2, k3: radial distortion, as in OpenCV [1].
        p1, p2: tangential distortion [1].

    Example:
        >>> Lens(1000.0, 1000.0, 320.0, 240.0).project(np.array([[0.1, 0.0, 1.0]])).tolist()
        [[420.0, 240.0]]
    """

    fx: float
    fy: float
    u0: float
    v0: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def values(self) -> np.ndarray:
        """The parameters in the order of ``PINHOLE`` and ``DISTORTION``, shape (9,)."""
        return np.array([getattr(self, name) for name in (*PINHOLE, *DISTORTION)], float)

    def project(self, seen: np.ndarray) -> np.ndarray:
        """Return the image [px], shape (N, 2), of points in the camera's frame [m], shape (N, 3)."""
        return _bent(self, _slopes(seen)[0])[0]

    def linearise(self, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the image and how it moves.

        Args:
            seen: shape (N, 3), points in the camera's frame [m].

        Returns:
            Image [px], shape (N, 2); its derivative by the point, shape (N, 2, 3), and by the parameters, shape (N, 2, 9).
        """
        slopes, depth = _slopes(seen)
        image, by_slope, by_lens = _bent(self, slopes)
        by_point = np.empty((len(seen), 2, 3))
        by_point[:, :, :2] = by_slope / depth[:, None, None]
        by_point[:, :, 2] = -np.einsum("nab,nb->na", by_slope, slopes) / depth[:, None]
        return image, by_point, by_lens


def _slopes(seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    depth = np.maximum(seen[:, 2], NEAREST)
    return seen[:, :2] / depth[:, None], depth


def _bent(lens: Lens, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the image of slopes x, y, shape (N, 2), and its derivatives by slopes and by parameters."""
    x, y = slopes.T
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
    change = lens.k1 + r2 * (2.0 * lens.k2 + r2 * 3.0 * lens.k3)  # d radial / d r2
    bent_x = x * radial + 2.0 * lens.p1 * x * y + lens.p2 * (r2 + 2.0 * x * x)
    bent_y = y * radial + lens.p1 * (r2 + 2.0 * y * y) + 2.0 * lens.p2 * x * y
    cross = 2.0 * x * y * change + 2.0 * lens.p1 * x + 2.0 * lens.p2 * y
    by_slope = np.empty((len(x), 2, 2))
    by_slope[:, 0, 0] = lens.fx * (radial + 2.0 * x * x * change + 2.0 * lens.p1 * y + 6.0 * lens.p2 * x)
    by_slope[:, 0, 1] = lens.fx * cross
    by_slope[:, 1, 0] = lens.fy * cross
    by_slope[:, 1, 1] = lens.fy * (radial + 2.0 * y * y * change + 6.0 * lens.p1 * y + 2.0 * lens.p2 * x)
    by_lens = np.zeros((len(x), 2, 9))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = bent_x, bent_y
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    for k, power in zip((4, 5, 8), (r2, r2**2, r2**3), strict=True):
        by_lens[:, 0, k], by_lens[:, 1, k] = lens.fx * x * power, lens.fy * y * power
    by_lens[:, 0, 6], by_lens[:, 1, 6] = lens.fx * 2.0 * x * y, lens.fy * (r2 + 2.0 * y * y)
    by_lens[:, 0, 7], by_lens[:, 1, 7] = lens.fx * (r2 + 2.0 * x * x), lens.fy * 2.0 * x * y
    image = np.stack([lens.fx * bent_x + lens.u0, lens.fy * bent_y + lens.v0], axis=1)
    return image, by_slope, by_lens
