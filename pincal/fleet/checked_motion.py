"""How the readings of an interim check depend on what is known of a robot and on what may have
moved since its calibration: base, tool, drives, and the length of all links.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.diagnosis.row_evidence import rows_in_noise
from pincal.identify.station import Station
from pincal.model.catalogue.environment import ThermalExpansion
from pincal.model.motions import Motions
from pincal.parameters import FRAME_SYMBOLS
from pincal.thresholds import Scale

BASE = "base"
TOOL_MOVED = "tool"
TEMPERATURE = "temperature"
SEVERAL = "several"
# How likely a change is of each kind, beforehand; that of joints is divided among them.
_CHANCES: dict[str, Scale] = {BASE: 0.25, TOOL_MOVED: 0.25, TEMPERATURE: 0.15, SEVERAL: 0.05}
_OF_JOINTS: Scale = 0.3


@dataclass(frozen=True, eq=False)
class CheckMotion:
    """How one check's readings depend on what is known and on what may change.

    Attributes:
        robot: at the station of the check.
        station: the model over its rows.
        sigma: shape (blocks,), stated noise.
        is_new_station: whether the instrument was set up anew.
    """

    robot: FittedRobot
    station: Station
    sigma: np.ndarray
    is_new_station: bool

    @cached_property
    def _wide(self) -> Station:
        """The station with unit motions of base, tool and drives as further parameters."""
        chain = self.station.model.chain
        coordinates = [chain.base(symbol) for symbol in FRAME_SYMBOLS]
        coordinates += [chain.tool(symbol) for symbol in FRAME_SYMBOLS]
        coordinates += list(map(int, chain.drives))
        effects = (*self.station.model.effects, Motions(tuple(coordinates)))
        return self.station.with_model(self.station.model.with_effects(effects))

    @cached_property
    def _warm(self) -> tuple[Station, int]:
        """The station a degree warmer than its links' reference, and the place of their growth."""
        model = self.station.model
        growth = next((e for e in model.effects if e == ThermalExpansion()), None)
        if growth is None:
            model = model.with_effects((*model.effects, ThermalExpansion()))
        (name,) = (p.name for p in ThermalExpansion().parameters(model.chain))
        n = len(self.station)
        conditions = replace(
            self.station.conditions, temperature=np.full(n, ThermalExpansion().reference + 1.0)
        )
        station = replace(self.station.with_model(model), conditions=conditions)
        return station, model.index(name)

    def _values(self, station: Station) -> np.ndarray:
        """Return the values of a station's parameters; those beyond the robot's are zero."""
        of_model, own = self.station.split(self.robot.values)
        more = station.model.n_parameters - self.station.model.n_parameters
        return np.concatenate([of_model, np.zeros(more), own])

    @property
    def _n(self) -> int:
        return self.station.model.n_parameters

    @cached_property
    def _rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Jacobian by all parameters of the wide model, shape (P, R), and residuals, (R,), in units
        of the noise.
        """
        A, r = rows_in_noise(self._wide, self._values(self._wide), self.sigma)
        size = len(self.station) * self.station.reading_size
        return A[:, :size], r[:size]

    @property
    def residuals(self) -> np.ndarray:
        """Readings minus predictions in units of the noise, shape (R,)."""
        return self._rows[1]

    @property
    def _motions(self) -> np.ndarray:
        """Jacobian by unit motions of base, tool and drives, shape (12 + n, R)."""
        return self._rows[0][self._n : self._n + 12 + len(self.station.model.chain.drives)]

    @property
    def base(self) -> np.ndarray:
        """Jacobian by the base, shape (R, 6)."""
        return self._motions[:6].T

    @property
    def drives(self) -> np.ndarray:
        """Jacobian by the drives, shape (n, R)."""
        return self._motions[12:]

    @property
    def by_parameters(self) -> np.ndarray:
        """Jacobian by the parameters of the calibration, shape (R, P)."""
        of_model, own = self._wide.split(self._rows[0])
        return np.vstack([of_model[: self._n], own]).T

    @cached_property
    def changes(self) -> np.ndarray:
        """Jacobian by what may change: base, tool, growth, drives, shape (R, 13 + n)."""
        station, place = self._warm
        A, _ = rows_in_noise(station, self._values(station), self.sigma, np.array([place]))
        growth = A[:, : len(self.residuals)]
        return np.vstack([self._motions[:12], growth, self._motions[12:]]).T

    @cached_property
    def displacements(self) -> np.ndarray:
        """Motion of the target by what may change, shape (N, 3, 13 + n) [m per m, rad or 1]."""
        wide = self._wide
        _, J = wide.model.linearise(wide.split(self._values(wide))[0], wide.conditions, rows=3)
        warm, place = self._warm
        _, growth = warm.model.linearise(warm.split(self._values(warm))[0], warm.conditions, rows=3)
        J = J[:, :, self._n :]
        return np.concatenate([J[:, :, :12], growth[:, :, [place]], J[:, :, 12:]], axis=2)


def kinds_of_changes(joints: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the columns of changes by kind, as :attr:`CheckMotion.changes` has them."""
    n = len(joints)
    found = {BASE: np.arange(6), TOOL_MOVED: np.arange(6, 12), TEMPERATURE: np.array([12])}
    found |= {name: np.array([13 + i]) for i, name in enumerate(joints)}
    found[SEVERAL] = np.delete(np.arange(13 + n), 12)
    return found


def chances_of(joints: Sequence[str]) -> dict[str, float]:
    """Return how likely each kind of change is beforehand."""
    found = {name: _CHANCES[name] for name in (BASE, TOOL_MOVED, TEMPERATURE, SEVERAL)}
    return found | dict.fromkeys(joints, _OF_JOINTS / len(joints))
