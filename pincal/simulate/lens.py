"""The true camera: a pinhole with radial and tangential distortion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

# Deviations of a real camera from its data sheet: relative ones of focal length and principal
# point; distortion.
_FOCAL = 0.02
_SKEWED = 5e-4
_CENTRE = 0.01
_K1 = (-0.16, -0.08)
_K2 = (0.03, 0.09)
_TANGENTIAL = 5e-4


@dataclass(frozen=True, kw_only=True)
class Lens:
    r"""Pinhole camera with radial and tangential distortion, in the convention of OpenCV.

    With x = X / Z, y = Y / Z and r^2 = x^2 + y^2 of a point in the camera's frame:

    .. math::
        x'' = x (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + 2 p_1 x y + p_2 (r^2 + 2 x^2), \quad u = f_x x''
        + u_0 \\ y'' = y (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + p_1 (r^2 + 2 y^2) + 2 p_2 x y, \quad v
        = f_y y'' + v_0

    Attributes:
        focal: Focal length [px], one number or (fx, fy).
        centre: Principal point (u0, v0) [px].
        size: Width and height of the image [px].
        k1, k2, k3: Radial distortion [-].
        p1, p2: Tangential distortion [-].

    Example:
        >>> lens = Lens(focal=1000.0, centre=(320.0, 240.0), k1=0.5)
        >>> lens.project(np.array([[0.2, 0.0, 1.0]])).round(9)
        array([[524., 240.]])
    """

    focal: float | tuple[float, float] = 2000.0
    centre: tuple[float, float] = (1024.0, 768.0)
    size: tuple[int, int] = (2048, 1536)
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def focals(self) -> tuple[float, float]:
        """Focal lengths fx and fy [px]."""
        return self.focal if isinstance(self.focal, tuple) else (self.focal, self.focal)

    @property
    def intrinsics(self) -> dict[str, float | int]:
        """The camera's parameters by name, for other programs."""
        names = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2", "k3", "width", "height")
        values = (
            *self.focals,
            *self.centre,
            self.k1,
            self.k2,
            self.p1,
            self.p2,
            self.k3,
            *self.size,
        )
        return dict(zip(names, values, strict=True))

    def project(self, seen: np.ndarray) -> np.ndarray:
        """Return the image [px], shape (N, 2), of points in front of the camera [m],
        shape (N, 3).
        """
        x = seen[:, 0] / seen[:, 2]
        y = seen[:, 1] / seen[:, 2]
        r2 = x**2 + y**2
        radial = 1.0 + self.k1 * r2 + self.k2 * r2**2 + self.k3 * r2**3
        bent_x = x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x**2)
        bent_y = y * radial + self.p1 * (r2 + 2.0 * y**2) + 2.0 * self.p2 * x * y
        return np.column_stack((bent_x, bent_y)) * self.focals + self.centre

    def sees(self, seen: np.ndarray, *, margin: float = 0.0) -> np.ndarray:
        """Return which points of the camera's frame [m], shape (N, 3), lie in the image, shape
        (N,).

        ``margin`` is the width of an excluded border, relative to the image.
        """
        ahead = seen[:, 2] > 0.0
        safe = np.where(ahead[:, None], seen, [0.0, 0.0, 1.0])
        slope2 = (safe[:, 0] / safe[:, 2]) ** 2 + (safe[:, 1] / safe[:, 2]) ** 2
        border = margin * np.asarray(self.size)
        place = self.project(safe)
        inside = np.all((place >= border) & (place <= np.asarray(self.size) - 1.0 - border), axis=1)
        return np.asarray(ahead & inside & (slope2 < self._fold))

    @property
    def _fold(self) -> float:
        """Squared slope beyond which the polynomial folds the image back on itself, as no lens
        does.
        """
        roots = np.roots([7.0 * self.k3, 5.0 * self.k2, 3.0 * self.k1, 1.0])
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
        return float(real.min(initial=np.inf))


def draw_lens(rng: np.random.Generator, **given: Any) -> Lens:
    """Return a camera with a good machine-vision lens, about 1 % of barrel distortion at the
    corners.

    ``given`` are fixed values by the keys of :attr:`Lens.intrinsics`.
    """
    width = given.get("width", 2048)
    height = given.get("height", 1536)
    fx = given.get("fx", 2000.0 * (1.0 + _FOCAL * rng.uniform(-1.0, 1.0)))
    fy = fx * (1.0 + _SKEWED * rng.uniform(-1.0, 1.0))
    u0, v0 = (0.5 * size * (1.0 + _CENTRE * rng.uniform(-1.0, 1.0)) for size in (width, height))
    drawn = {
        "k1": rng.uniform(*_K1),
        "k2": rng.uniform(*_K2),
        "p1": _TANGENTIAL * rng.uniform(-1.0, 1.0),
        "p2": _TANGENTIAL * rng.uniform(-1.0, 1.0),
        "k3": 0.0,
    }
    distortion = {name: float(given.get(name, value)) for name, value in drawn.items()}
    return Lens(
        focal=(float(fx), float(given.get("fy", fy))),
        centre=(float(given.get("u0", u0)), float(given.get("v0", v0))),
        size=(int(width), int(height)),
        **distortion,
    )
