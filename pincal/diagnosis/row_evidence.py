r"""Evidence of new readings on changes of a calibrated robot, with the uncertainty of its
calibration.

With r the residuals of the new rows in units of their noise, R the Jacobian by the robot's
parameters, known with covariance C, M by the masses, which a URDF gives to some per cent, F by the
parameters of the new station (base, targets, instrument) and of changes found already, and G by the
changes to be tested,

.. math:: r = R d + M m + F f + G g + e, \qquad
    d \sim N(0, C), \quad m \sim N(0, S), \quad e \sim N(0, 1),

d and m are uncertain and f is unconstrained. With all three projected out the gain of a change is

.. math:: T_g = b_g^T P_{gg}^{-1} b_g, \quad P = G^T V^{-1} G, \quad b = G^T V^{-1} r,

its reduction of the squares: chi-square with as many degrees of freedom as the data observe of it,
if it has not happened.

Errors of masses have biased the calibration, too: M m is reduced by what its parameters absorbed.
As its rows are not available, that part is computed at random poses within the range that they
covered.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.unmodelled import Unmodelled
from pincal.identify.mass_error import MassError
from pincal.identify.normal import belief_rows
from pincal.identify.quadratic import ROUNDING, SEEN, Quadratic, root_of_inverse
from pincal.identify.station import Station
from pincal.identify.stop_scatter import SharedNoise
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect
from pincal.model.sizes import largest_basis
from pincal.parameters import root_of
from pincal.recorded import RECORDED, typical_columns
from pincal.thresholds import Count

# Random poses at which the calibration's bias by masses is computed.
_POSES: Count = 200


@dataclass(frozen=True)
class Known:
    """What is known of a robot's parameters from its calibration.

    Attributes:
        names: the parameters.
        values: shape (K,).
        root: shape (K, n), root of their covariance.
        masses: errors of masses as an effect; None for a rigid model.
        taken_up: shape (K, m), what the calibration's parameters absorb of a unit of each mass
            parameter.
        unmodelled: effects of the rows that it lacks; their parameters are the last of the K.
    """

    names: tuple[str, ...]
    values: np.ndarray
    root: np.ndarray
    masses: MassError | None
    taken_up: np.ndarray
    unmodelled: tuple[Effect, ...] = ()

    @classmethod
    def of(cls, calibrated: FittedRobot, conditions: Conditions) -> Known:
        """Return what is known from a calibrated model, with unmodelled effects that new rows can
        show.
        """
        chain = calibrated.model.chain
        effects = (effect for effect in calibrated.model.effects if effect.scope == "robot")
        names = tuple(
            parameter.name for effect in effects for parameter in effect.parameters(chain)
        )
        estimate = calibrated.estimate.take(names)
        masses = MassError.of(calibrated.model, calibrated.model_values)
        taken_up = (
            np.zeros((len(names), 0)) if masses is None else _taken_up(calibrated, names, masses)
        )
        root = root_of(estimate.dense_covariance())
        if calibrated.repeatability is not None:
            # A calibration takes the targets of a stop to be independent.
            root = root * np.sqrt(calibrated.repeatability.shared)
        known = cls(names, estimate.values, root, masses, taken_up)
        left = calibrated.unmodelled
        return known if left is None else known._with_unmodelled(left, chain, conditions)

    def _with_unmodelled(self, left: Unmodelled, chain: Chain, conditions: Conditions) -> Known:
        """Return what is known of effects that the model lacks, too, where new rows show them.

        The part that the parameters absorbed remains in them where rows lack a column that the
        effect needs.
        """
        taken = np.zeros((len(self.names), len(left.values)))
        root = root_of(left.covariance)
        taken[[self.names.index(name) for name in left.names]] = left.taken_up
        shown = [
            effect
            for effect in left.effects
            if all(conditions.column(name) is not None for name in effect.needs)
        ]
        own = [
            left.parameter_names.index(parameter.name)
            for effect in shown
            for parameter in effect.parameters(chain)
        ]
        E = len(own)
        return Known(
            names=(*self.names, *(left.parameter_names[i] for i in own)),
            values=np.concatenate([self.values - taken @ left.values, left.values[own]]),
            root=np.block(
                [[self.root, -taken @ root], [np.zeros((E, self.root.shape[1])), root[own]]]
            ),
            masses=self.masses,
            taken_up=np.vstack([self.taken_up, np.zeros((E, self.taken_up.shape[1]))]),
            unmodelled=tuple(shown),
        )


def _taken_up(calibrated: FittedRobot, names: tuple[str, ...], masses: MassError) -> np.ndarray:
    """Return the change of a calibration's parameters per unit of each mass parameter, shape (K,
    m).
    """
    model = calibrated.model
    rng = np.random.default_rng(0)
    lower, upper = calibrated.covered.q.T
    q = model.chain.robot.following(rng.uniform(lower, upper, (_POSES, len(lower))))
    conditions = calibrated.conditions_at(model.chain.robot.as_reported(q))
    columns = typical_columns(RECORDED, conditions.q)
    columns["approach"] = rng.choice([-1.0, 1.0], conditions.q.shape)
    columns["time"] = np.linspace(0.0, 1.0, _POSES)
    payload = rng.choice(calibrated.covered.payload, _POSES)
    conditions = replace(conditions, payload=payload, **columns)
    wide = model.with_effects([*model.effects, masses])
    n = model.n_parameters
    values = np.append(calibrated.model_values, np.zeros(wide.n_parameters - n))
    _, J = wide.linearise(values, conditions)
    columns = J.transpose(2, 0, 1).reshape(J.shape[2], -1) / calibrated.sigma[0]
    G = columns @ columns.T
    sizes = (
        np.array([parameter.size for parameter in model.parameters])
        / largest_basis(model, conditions)[0]
    )
    H = G[:n, :n] + np.diag(sizes**-2.0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    slope = np.linalg.lstsq(H * np.outer(scale, scale), scale[:, None] * G[:n, n:], rcond=ROUNDING)[
        0
    ]
    return np.asarray((scale[:, None] * slope)[[model.index(name) for name in names]])


@dataclass(frozen=True)
class RowEvidence:
    """Evidence of new rows on the F parameters of a wide model, beyond what is known.

    Attributes:
        form: P as its information, b as its gradient, r^T V^-1 r as its square.
        n: number of rows, of m readings each.
        jacobian: shape (F, R), with R >= n m, in units of the noise.
        projected: shape (k, F), combinations of its rows that are projected out.
        weighted: shape (R,), V^-1 r.
        shared: noise that rows share, by which all of these are whitened; default: none.
    """

    form: Quadratic
    n: int
    jacobian: np.ndarray = field(repr=False)
    projected: np.ndarray = field(repr=False)
    weighted: np.ndarray = field(repr=False)
    shared: SharedNoise | None = field(default=None, repr=False)

    @cached_property
    def rows(self) -> np.ndarray:
        """Gain and rank of each row if its reading alone is wrong, shape (N, 2)."""
        m = len(self.weighted) // self.n
        projected = self.projected @ self.jacobian[:, : self.n * m]
        weighted = self.weighted[: self.n * m]
        own = np.broadcast_to(np.eye(m), (self.n, m, m))
        if self.shared is not None:
            # A wrong reading of one row, whitened, is seen in all rows of its pose.
            own = self.shared.own_precision()
            projected = self.shared.back(projected)
            weighted = self.shared.back(weighted)
        Q = projected.reshape(-1, self.n, m).transpose(1, 0, 2)
        seen, axes = np.linalg.eigh(own - Q.transpose(0, 2, 1) @ Q)
        along = np.einsum("nab,na->nb", axes, weighted.reshape(self.n, m))
        gains = np.where(seen > SEEN, along**2 / np.maximum(seen, SEEN), 0.0)
        return np.stack([gains.sum(axis=1), np.sum(seen > SEEN, axis=1)], axis=1)

    def gain(self, j: np.ndarray, belief: np.ndarray | None = None) -> tuple[float, int]:
        """Return T and rank of parameters, by index, that change together.

        With a joint prior on them, of information ``belief``, shape (K, K), these are of the
        directions in which the rows have more information than the prior: chosen without the
        readings, so T keeps its distribution.
        """
        if belief is None:
            return self.form.gain(j)
        information, along = self._relative_to(belief, j)
        seen = information > 1.0
        return float(np.sum(along[seen] ** 2 / information[seen])), int(seen.sum())

    def odds(self, j: np.ndarray, belief: np.ndarray) -> float:
        """Return -2 log odds of a change of parameters with a joint prior, against none."""
        information, along = self._relative_to(belief, j)
        return float(np.sum(np.log1p(information) - along**2 / (1.0 + information)))

    def _relative_to(self, belief: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return information and gradient of the rows along their principal directions in units of
        the prior, shape (K,).
        """
        root = root_of_inverse(belief, np.diag(belief), ROUNDING)
        information, axes = np.linalg.eigh(root.T @ self.form.H[np.ix_(j, j)] @ root)
        return np.maximum(information, 0.0), axes.T @ (root.T @ self.form.g[j])

    def estimate(self, j: np.ndarray, belief: np.ndarray | None = None) -> np.ndarray:
        """Return the most probable change of parameters to first order, zero in unobservable
        directions.
        """
        if belief is None:
            return self.form.estimate(j)[0]
        H = self.form.H[np.ix_(j, j)] + belief
        root = root_of_inverse(H, np.diag(H), ROUNDING)
        return np.asarray(root @ (root.T @ self.form.g[j]))


def prior_root(station: Station, known: Known, surroundings: np.ndarray) -> np.ndarray:
    """Return the root of the prior covariance of a station's parameters, shape (n, P), of
    ``surroundings`` by size.
    """
    # Tested effects may share names; the parameters of the model and of masses come first.
    index = {parameter.name: i for i, parameter in reversed(list(enumerate(station.parameters)))}
    robot = [index[name] for name in known.names]
    masses = () if known.masses is None else known.masses.parameters(station.model.chain)
    sizes = np.array([parameter.size for parameter in masses])
    n = known.root.shape[1]
    k = known.root.shape[1] + len(surroundings)
    out = np.zeros((k + len(masses), len(station.parameters)))
    out[:n, robot] = known.root.T
    out[np.arange(n, k), surroundings] = [station.parameters[i].size for i in surroundings]
    out[np.arange(k, len(out)), np.array([index[p.name] for p in masses], int)] = sizes
    out[k:, robot] = -sizes[:, None] * known.taken_up.T
    return out


def rows_in_noise(
    station: Station,
    values: np.ndarray,
    sigma: np.ndarray,
    places: np.ndarray | None = None,
    *,
    shared: SharedNoise | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return Jacobian, shape (P, R), and residuals, shape (R,), in units of the noise, row by row.

    Prior information of the sensor comes last. With places, shape (p,), the Jacobian is by these
    parameters only, (p, R). Noise that rows share is whitened.
    """
    free = np.ones(len(values), bool) if places is None else np.isin(np.arange(len(values)), places)
    columns = []
    readings = []
    for piece, residuals, jacobian in station.linearise(values, free):
        whitening = np.empty_like(residuals)
        for rows, size in zip(station.block_rows, sigma, strict=True):
            whitening[rows] = station.weights[piece] / size
        columns.append((jacobian * whitening).transpose(0, 2, 1).reshape(len(jacobian), -1))
        readings.append((residuals * whitening).T.ravel())
    whole = np.hstack(columns)
    off = np.concatenate(readings)
    if shared is not None:
        whole = shared.whitened(whole)
        off = shared.whitened(off)
    J, r = belief_rows(station, values, free)
    A = np.hstack([whole, J])
    return A if places is None else A[
        np.searchsorted(np.flatnonzero(free), places)
    ], np.concatenate([off, r])
