r"""Closed loops of the calibrated arm: positions of passive joints, their derivatives, and the
loads that they transmit.

The closure equations C that passive joints P satisfy hold for the chain's coordinates x, including
deformed ones:

.. math:: C(x) = 0, \qquad \frac{d x_P}{d x_k} = D_k = -C_P^{-1} C_k

A passive joint supports no moment about its own axis. The moment n_P of its subtree acts on the
joints that move it: by virtual work a drive i of a loop supports n_i + D_i . n_P. With the pin
forces lambda = C_P^{-T} n_P, its derivative is

.. math:: d n_i + D_i \cdot d n_P - \lambda \cdot (d C_i + dC_P D_i)

All of this is linear in the coordinates, so it yields further terms: a parameter that moves a
coordinate of a loop also moves the coordinates of the passive joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pincal.model import kernels
from pincal.model.chain import Chain
from pincal.model.effect_numbers import SHOWN
from pincal.model.kernel_inputs import FRAME, Compliances, Layout, Payload, Places, Terms, Values
from pincal.robot.closure import CLOSED, Closure, least_step
from pincal.thresholds import Count, Scale

# Newton steps, and the gap [m, rad] from which one more suffices; from the nominal arm, errors of
# millimetres need three.
_STEPS: Count = 12
_LAST: Scale = 1e-8
# Steps are limited while the gap is larger than this [m, rad].
_NEAR: Scale = 0.1
# Poses in which that is tested.
_SAMPLES: Count = 8


@dataclass(frozen=True, eq=False)
class _Walk:
    """One closure: its walk, and the step of each coordinate on it."""

    closure: Closure
    layout: Layout

    @cached_property
    def order(self) -> dict[int, int]:
        return {int(k): t for t, k in enumerate(self.layout.path.coordinate)}


@dataclass(frozen=True, eq=False)
class Loops:
    """The loops of a chain.

    Attributes:
        walks: one for each closure.
        passive: shape (p,), the passive joints.
        follow: shape (p,), the coordinates of their positions.
        drives: the other revolute joints of the loops, with the coordinates of their positions.
        size: number K of coordinates of the chain.
    """

    walks: tuple[_Walk, ...]
    passive: np.ndarray
    follow: np.ndarray
    drives: dict[int, int]
    size: int

    @classmethod
    def of(cls, chain: Chain) -> Loops | None:
        """Return the loops of a chain; None if it has none."""
        linkage = chain.robot.linkage
        if linkage is None:
            return None
        known = chain.kept.about("loops", chain.robot, chain.bearing_heights)
        if chain.moment_frame not in known:
            walks = tuple(
                _Walk(closure, chain.loop_layout(closure)) for closure in chain.robot.closures
            )
            turning = [int(i) for i in linkage.drivers if chain.robot.joint_types[i] != "prismatic"]
            drives = {i: int(chain.drives[i]) for i in turning}
            known[chain.moment_frame] = cls(
                walks, linkage.passive, chain.drives[linkage.passive], drives, chain.size
            )
        found: Loops = known[chain.moment_frame]
        return found

    @cached_property
    def coordinates(self) -> frozenset[int]:
        """The coordinates of the loops."""
        on_walks = frozenset(k for walk in self.walks for k in walk.order)
        return on_walks & frozenset(range(FRAME, self.size - FRAME))

    def closed(self, values: Values) -> Values:
        """Return coordinates at N poses with the passive joints where the loops close, or as nearly
        as possible.
        """
        values = values._replace(varying=values.varying.copy())
        for _ in range(_STEPS):
            missing, C, _ = self._motion(values, self.follow)
            open_by = float(np.abs(missing).max(initial=0.0))
            if open_by <= CLOSED:
                break
            step = (
                _solved(C, missing[..., None])[..., 0]
                if open_by < _NEAR
                else least_step(C, missing)
            )
            values.varying[values.slot[self.follow]] -= step.T
            if open_by < _LAST:
                break
        return values

    def _motion(
        self, values: Values, coordinates: Sequence[int] | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
        """Return the gaps of the loops, shape (N, p), their derivatives by M coordinates, shape (N,
        p, M), and the ends.

        The ends are the last frame of each walk, shape (N, 3, 4), and its velocities, shape (M, 6,
        N).
        """
        N = values.varying.shape[1]
        M = len(coordinates)
        constant = values.constant.copy()
        slot = values.slot.copy()
        for outside in (slice(FRAME), slice(self.size - FRAME, None)):
            constant[outside] = 0.0
            slot[outside] = -1
        values = Values(constant, slot, values.varying)
        terms = Terms(
            np.array(coordinates, np.int64),
            np.arange(M),
            np.full(M, -1),
            np.zeros(M, bool),
            np.empty((0, N)),
        )
        wanted = kernels.NOTHING._replace(terms=terms, n_columns=M, rows=6)
        here = np.zeros(N, np.int64)
        missing = []
        derivatives = []
        ends = []
        for walk in self.walks:
            T, _, J = kernels.evaluate(
                walk.layout, values, values, Places(here, here), kernels.NO_LOAD, wanted
            )
            T = np.moveaxis(T, -1, 0)
            rows = list(walk.closure.rows)
            missing.append(walk.closure.residuals(T)[:, rows])
            derivatives.append(walk.closure.derivatives(T, J.transpose(2, 1, 0))[:, rows])
            ends.append((T, J))
        return np.concatenate(missing, axis=1), np.concatenate(derivatives, axis=1), ends

    def rates(self, values: Values, coordinates: Sequence[int]) -> np.ndarray:
        """Return the derivatives of passive joints by coordinates at closed positions, shape (M, p,
        N).
        """
        p = len(self.follow)
        _, C, _ = self._motion(values, [*self.follow, *coordinates])
        return _solved(C[..., :p], -C[..., p:]).transpose(2, 1, 0)

    def borne(self, values: Values, moments: np.ndarray) -> np.ndarray:
        """Return the moments that joints support, shape (3 n, N), from those of the open tree [N
        m].
        """
        out = moments.copy()
        z = 3 * self.passive + 2
        for i, D in zip(self.drives, self.rates(values, list(self.drives.values())), strict=True):
            out[3 * i + 2] += (D * moments[z]).sum(axis=0)
        out[z] = 0.0
        return out

    def followed(
        self,
        layout: Layout,
        rigid: Values,
        deformed: Values,
        payload: Payload,
        terms: Terms,
        compliances: Compliances,
        *,
        equilibrium: bool,
    ) -> tuple[Terms, Compliances]:
        """Return terms and compliances extended by their effect through the passive joints.

        Moments are computed on the ``rigid`` coordinates; with ``equilibrium`` elastic motion
        changes them.
        """
        p = len(self.follow)
        drives = list(self.drives.values())
        moved = [*terms.coordinate.tolist(), *compliances.coordinate.tolist()]
        own = self.coordinates.intersection(moved)
        ks = [*self.follow.tolist(), *sorted(own.union(drives).difference(self.follow.tolist()))]
        at = {k: m for m, k in enumerate(ks)}
        on_rigid = self._motion(rigid, ks)
        D = _solved(on_rigid[1][..., :p], -on_rigid[1]).transpose(2, 1, 0)
        bent = D if rigid is deformed else self.rates(deformed, ks)
        felt = any(n % 3 == 2 and n // 3 in self.drives for n in compliances.moment.tolist())
        loads = (
            kernels.static_moments(layout, rigid, payload)[3 * self.passive + 2]
            if felt
            else np.empty((0, 0))
        )
        direct = self._direct(at, on_rigid, D, loads, compliances) if felt else {}
        passive = _Followed(at, self.follow.tolist(), D, bent, direct)
        found: list[_Term] = []
        for e in range(len(terms.coordinate)):
            if (k := int(terms.coordinate[e])) not in at:
                continue
            column = int(terms.parameter[e])
            basis = 1.0 if terms.slot[e] < 0 else terms.basis[terms.slot[e]]
            follows = equilibrium or not terms.elastic[e]
            found += passive.by_term(k, column, basis, on_rigid=follows)
        return _with_terms(terms, found), self._with_compliances(compliances, at, D, bent)

    def _direct(
        self,
        at: dict[int, int],
        on_rigid: tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray]]],
        D: np.ndarray,
        loads: np.ndarray,
        compliances: Compliances,
    ) -> dict[int, np.ndarray]:
        """Return derivatives of elastic coordinates by others, (M, N), due to changed load
        transmission, by coordinate.
        """
        p = len(self.follow)
        found = dict[int, np.ndarray]()
        entries = [
            e for e, n in enumerate(compliances.moment) if n % 3 == 2 and int(n) // 3 in self.drives
        ]
        forces = _solved(on_rigid[1][..., :p].swapaxes(1, 2), loads.T[..., None])[..., 0]
        of_passive = [self._turned(at, on_rigid[2], forces, k) for k in self.follow.tolist()]
        for e in entries:
            k = self.drives[int(compliances.moment[e]) // 3]
            change = -self._turned(at, on_rigid[2], forces, k)
            for q in range(p):
                change -= D[at[k], q] * of_passive[q]
            change = change + (change[:p] * D).sum(axis=1)
            c = int(compliances.coordinate[e])
            found[c] = found.get(c, 0.0) + compliances.rate[e] * change
        return found

    def _turned(
        self,
        at: dict[int, int],
        ends: list[tuple[np.ndarray, np.ndarray]],
        forces: np.ndarray,
        k: int,
    ) -> np.ndarray:
        """Return pin forces, shape (N, p), times the second derivatives of the equations by k and
        others, shape (M, N).
        """
        total = np.zeros((len(at), len(forces)))
        first = 0
        for walk, (T, J) in zip(self.walks, ends, strict=True):
            force = np.zeros((6, len(forces)))
            force[walk.closure.rows, :] = forces[:, first : first + len(walk.closure.rows)].T
            first += len(walk.closure.rows)
            if k not in walk.order:
                continue
            place = force[:3]
            turn = force[3:]
            v = J[:, :3]
            w = J[:, 3:]
            v_k = v[at[k]]
            w_k = w[at[k]]
            # The earlier of two coordinates turns the motion of the later one.
            behind = (v * np.cross(place, w_k, axis=0)).sum(axis=1)
            before = (w * np.cross(v_k, place, axis=0)).sum(axis=1)
            if walk.closure.kind == "axis":
                z = T[:, :, 2].T
                behind += (w * np.cross(z, np.cross(turn, w_k, axis=0), axis=0)).sum(axis=1)
                before += (w * np.cross(np.cross(w_k, z, axis=0), turn, axis=0)).sum(axis=1)
            elif walk.closure.kind == "pose":
                half = 0.5 * (w * np.cross(turn, w_k, axis=0)).sum(axis=1)
                behind = behind + half
                before = before - half
            for other, m in at.items():
                if other in walk.order:
                    total[m] += behind[m] if walk.order[other] >= walk.order[k] else before[m]
        return total

    def _with_compliances(
        self, compliances: Compliances, at: dict[int, int], D: np.ndarray, bent: np.ndarray
    ) -> Compliances:
        """Return compliances with moments of passive joints acting on the drives, and with the
        passive joints' motion.
        """
        found = []
        z = (3 * self.passive + 2).tolist()
        for k, n, rate in zip(
            compliances.coordinate.tolist(),
            compliances.moment.tolist(),
            compliances.rate,
            strict=True,
        ):
            drive = self.drives.get(n // 3) if n % 3 == 2 else None
            felt = [] if n in z else [(n, rate)]
            felt += [] if drive is None else [(z[q], rate * D[at[drive], q]) for q in range(len(z))]
            for moment, by in felt:
                found.append((k, moment, by))
                if k in at:
                    found += [
                        (int(joint), moment, by * bent[at[k], q])
                        for q, joint in enumerate(self.follow)
                    ]
        N = D.shape[2]
        return Compliances(
            np.array([k for k, _, _ in found], np.int64),
            np.array([moment for _, moment, _ in found], np.int64),
            np.array([np.broadcast_to(by, N) for _, _, by in found]).reshape(len(found), N),
        )


def closed_loops(chain: Chain, values: Values) -> Values:
    """Return coordinates at some poses with the passive joints, if any, where the loops close."""
    loops = Loops.of(chain)
    return values if loops is None else loops.closed(values)


def borne_moments(chain: Chain, values: Values, moments: np.ndarray) -> np.ndarray:
    """Return the moments that joints support, shape (3 n, N), from those of the tree with its
    loops, if any, open [N m].
    """
    loops = Loops.of(chain)
    return moments if loops is None else loops.borne(values, moments)


def moves_tip(chain: Chain) -> np.ndarray:
    """Return which coordinates move the tip kinematically, not only through loads, shape (K,)."""
    found = np.zeros(chain.size, bool)
    loops = Loops.of(chain)
    found[[*chain.layout.path.coordinate, *(loops.coordinates if loops else ())]] = True
    return found


def inert_coordinates(chain: Chain) -> frozenset[int]:
    """Return the coordinates of joints and pins that have no effect because of loops.

    They are the positions of passive joints, and motions of a rod or a crank that the loops don't
    transmit.
    """
    loops = Loops.of(chain)
    robot = chain.robot
    if loops is None:
        return frozenset()
    known = chain.kept.about("inert", robot, chain.bearing_heights)
    if chain.moment_frame not in known:
        q = robot.random_configurations(_SAMPLES, np.random.default_rng(0))
        slot = np.full(chain.size, -1)
        slot[chain.drives] = np.arange(robot.n_joints)
        values = Values(
            chain.nominal.copy(), slot, np.array(chain.nominal[chain.drives, None] + q.T, order="C")
        )
        ks = sorted(loops.coordinates)
        moved = np.abs(loops.rates(values, ks)).max(axis=(1, 2))
        rods = loops.coordinates.difference(chain.layout.path.coordinate.tolist())
        still = [k for k, move in zip(ks, moved, strict=True) if k in rods and move < SHOWN.inert]
        own = [chain.joint(int(i), "gamma_z") for i in loops.passive]
        known[chain.moment_frame] = frozenset([*still, *loops.follow.tolist(), *own])
    found: frozenset[int] = known[chain.moment_frame]
    return found


_Term = tuple[int, int, bool, np.ndarray]
"""Of a parameter: coordinate, column, whether it is elastic, and basis."""


@dataclass(frozen=True, eq=False)
class _Followed:
    """How p passive joints follow K coordinates.

    Attributes:
        at: place of each of these coordinates among the K.
        joints: the coordinates of the passive joints.
        D: shape (K, p, N), their rates where nothing is deformed.
        bent: shape (K, p, N), their rates where the arm is.
        direct: derivatives of elastic coordinates by the K, shape (K, N), due to changed load
            transmission.
    """

    at: dict[int, int]
    joints: list[int]
    D: np.ndarray
    bent: np.ndarray
    direct: dict[int, np.ndarray]

    def by_term(
        self, k: int, column: int, basis: np.ndarray | float, *, on_rigid: bool
    ) -> Iterator[_Term]:
        """Yield the terms by which joints follow that of a parameter on coordinate k.

        ``on_rigid`` is of a term that moves the coordinates at which moments are computed.
        """
        m = self.at[k]
        turned = {c: by[m] for c, by in self.direct.items()} if on_rigid else {}
        elastic = self.bent[m] - self.D[m] if on_rigid else self.bent[m]
        for c, by in turned.items():
            yield c, column, True, basis * by
            elastic = elastic + self.bent[self.at[c]] * by if c in self.at else elastic
        is_bent = self.bent is not self.D or bool(turned) or not on_rigid
        for q, joint in enumerate(self.joints):
            if on_rigid:
                yield joint, column, False, basis * self.D[m, q]
            if is_bent:
                yield joint, column, True, basis * elastic[q]


def _with_terms(terms: Terms, more: list[_Term]) -> Terms:
    """Return terms with further ones: coordinate, column, whether it is elastic, and basis."""
    if not more:
        return terms
    coordinates, columns, elastic, bases = zip(*more, strict=True)
    return Terms(
        np.append(terms.coordinate, np.array(coordinates, np.int64)),
        np.append(terms.parameter, np.array(columns, np.int64)),
        np.append(terms.slot, len(terms.basis) + np.arange(len(more))),
        np.append(terms.elastic, np.array(elastic, bool)),
        np.concatenate([terms.basis, np.array(bases)]),
    )


def _solved(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return the solutions of A X = B, or least-squares solutions if loops are at a dead centre in
    some pose.
    """
    try:
        return np.asarray(np.linalg.solve(A, B))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(A) @ B)
