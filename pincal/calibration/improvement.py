r"""Improvement of predictions by a calibration: standard deviations of positions before and after,
by region.

P and C are the prior and posterior covariances of the robot's parameters. The placement of an
instrument that sees the end of a path, and of its target, takes up part of their effect: with J the
derivative of the end's positions at many poses by the parameters and B the derivative by the
placement, the positions have the covariances :math:`J_\perp P J_\perp^T` and
:math:`J_\perp C J_\perp^T`, with :math:`J_\perp = J - B B^+ J`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import compress

import numpy as np

from pincal.calibration.caveats import Caveat, CaveatKind
from pincal.calibration.delivery_numbers import DELIVERY
from pincal.calibration.fitted_robot import FittedRobot
from pincal.identify.fit import ModelFit
from pincal.identify.options import PriorScale
from pincal.identify.station import Station
from pincal.model.chain import MOUNT_SYMBOLS
from pincal.model.model import Model
from pincal.robot.robot import Robot
from pincal.thresholds import Count, Scale
from pincal.validate.outcome import AngleGain, Improvement

# Random poses within the joints' limits, measured poses at most, and the seed of both.
_DRAWN: Count = 400
_MEASURED: Count = 200
_SEED: Count = 0
# Standard deviation of a combination of angles that has gained, over that before.
_HALVED: Scale = 0.5
_OF_GEOMETRY = ("joint_offset", "link_geometry", "axis_distortion")
_MEASURED_POSES = "measured poses"


def improvements(fit: ModelFit) -> tuple[Improvement, ...]:
    """Return the improvement of predictions, for each link at which a reading begins or ends,
    region by region.
    """
    stations = fit.problem.stations
    robot = fit.problem.chain.robot
    ends = dict.fromkeys(
        link for s in stations for link in (s.model.chain.path.start, s.model.chain.path.tip)
    )
    return tuple(found for link in ends if link != robot.base for found in _of_link(fit, link))


def angle_gain(fit: ModelFit) -> AngleGain | None:
    r"""Return what the angles of joints and links gained by readings that tell no places, as of an
    IMU; None where all tell places, or nothing was gained.

    With P and C the prior and posterior covariances of these angles, the eigenvectors e of
    :math:`C e = \lambda P e` are combinations that were learned independently of each other.
    """
    if all(station.sensor.reads_place for station in fit.problem.stations):
        return None
    places = [
        k
        for k, p in enumerate(fit.problem.parameters)
        if p.unit == "rad" and p.effect in _OF_GEOMETRY and fit.solution.free[k]
    ]
    sizes = fit.priors.sizes[places]
    if not places or not np.isfinite(sizes).all():
        return None
    C = fit.estimate.take([fit.estimate.names[k] for k in places]).dense_covariance()
    ratios, whitened = np.linalg.eigh(C / np.outer(sizes, sizes))
    along = whitened / sizes[:, None]
    along = along / np.linalg.norm(along, axis=0)
    gained = ratios <= _HALVED**2
    if not gained.any():
        return None
    before = np.sum((sizes[:, None] * along[:, gained]) ** 2, axis=0)
    after = np.einsum("pk,pq,qk->k", along[:, gained], C, along[:, gained])
    rms = (1e3 * float(np.sqrt(np.mean(squares))) for squares in (before, after))
    return AngleGain(len(places), int(gained.sum()), *rms)


def unseen_directions(fit: ModelFit) -> tuple[np.ndarray, ...]:
    """Return the directions, each of shape (3,), in the axes of the robot's base link, along which
    nothing was measured.
    """
    squares, axes = np.linalg.eigh(
        sum(_directions(station, fit.values[places]) for station, places, _ in fit.stations)
    )
    return tuple(axes[:, squares < DELIVERY.unseen_direction * squares.sum()].T)


def _directions(station: Station, values: np.ndarray) -> np.ndarray:
    """Return the sum of d d^T over the directions d in which a station's rows measure, shape (3,
    3).
    """
    of_model, own = station.split(values)
    poses = station.model.predict(of_model, station.conditions)
    size = station.sensor.twist_rows
    units = np.zeros((3, size, len(station)))
    units[[0, 1, 2], [0, 1, 2]] = 1.0
    along = station.sensor.jacobian(poses, units, own)[:3, : station.sensor.blocks[0].size]
    robot = station.model.chain.robot
    path = station.model.chain.path
    if path.start != robot.base:
        turned = robot.forward_kinematics(
            station.conditions.q, robot.between(robot.base, path.start, at_rest=True)
        )
        along = np.einsum("nij,jmn->imn", turned[:, :3, :3], along)
    return np.asarray(np.einsum("imn,jmn->ij", along, along))


def findings_without_instrument(fit: ModelFit, improved: Sequence[Improvement]) -> Iterator[Caveat]:
    """Yield what readings without an instrument leave undetermined, including mounts that they
    moved.
    """
    if not improved:
        return
    robot = fit.problem.chain.robot
    falls = list[str]()
    for link in dict.fromkeys(region.link for region in improved):
        before, after = _rms_elsewhere(region for region in improved if region.link == link)
        falls.append(f"from {before:.2g} to {after:.2g} mm at {link}")
        if after > DELIVERY.not_improved * before:
            yield Caveat(CaveatKind.BLIND, {"link": link, "before": before, "after": after})
    scales = PriorScale(*(fit.options.prior_scale or PriorScale()))
    yield Caveat(CaveatKind.NO_INSTRUMENT, {**scales._asdict(), "how": ", ".join(falls)})
    if unseen := unseen_directions(fit):
        yield Caveat(CaveatKind.UNSEEN_DIRECTION, {"where": _within(unseen), "base": robot.base})
    yield from _moved_mounts(fit)


def _rms_elsewhere(regions: Iterable[Improvement]) -> tuple[float, float]:
    """Return the rms of errors before and after [mm] over the regions but the measured poses."""
    sizes = np.array(
        [(one.before_mm, one.after_mm) for one in regions if one.region != _MEASURED_POSES]
    )
    before, after = np.sqrt(np.mean(sizes**2, axis=0))
    return float(before), float(after)


def _moved_mounts(fit: ModelFit) -> Iterator[Caveat]:
    """Yield the mounts that were moved though readings hardly hold them."""
    estimate = fit.estimate
    for joint in dict.fromkeys(name.partition(".")[0] for name in fit.problem.chain.mounts):
        of_mount = {f"{joint}.{symbol}" for symbol in (*MOUNT_SYMBOLS, "d")}
        lengths = [k for k, name in enumerate(estimate.names) if name in of_mount]
        moved, sigma = (float(np.linalg.norm(of[lengths])) for of in (fit.values, estimate.sigma))
        if moved > DELIVERY.mount_moved and sigma > DELIVERY.mount_held * moved:
            figures = {"joint": joint, "moved": 1e3 * moved, "sigma": 1e3 * sigma}
            yield Caveat(CaveatKind.MOUNT_MOVED, figures)


def _within(unseen: tuple[np.ndarray, ...]) -> str:
    """Return, in words, the plane or line perpendicular to one or two unmeasured directions."""

    def named(axis: np.ndarray) -> str:
        return "({:.2f} {:.2f} {:.2f})".format(*(axis * np.sign(axis[np.abs(axis).argmax()]) + 0.0))

    if len(unseen) == 1:
        return f"the plane across {named(unseen[0])}"
    return f"the line along {named(np.cross(unseen[0], unseen[1]))}"


def _of_link(fit: ModelFit, link: str) -> Iterator[Improvement]:
    """Yield the improvement of the predicted positions of a link, region by region."""
    found = FittedRobot.of(fit).each[0]
    q, seen = _poses_of_link(fit, link)
    model = _model_of_link(found, fit.problem.chain.robot, link)
    robots = ~model.of_station
    tips, J = model.linearise(
        np.where(robots, found.model_values, 0.0), found.of_its_day(found.conditions_at(q))
    )
    J = unplaced(J[:, :3, robots], tips)
    names = fit.estimate.names
    own = list(compress(model.names, robots))
    places = [names.index(name) for name in own]
    free = fit.solution.free[places]
    prior = fit.priors.sizes[places]
    known = np.where(free & np.isfinite(prior), prior, 0.0)
    covariance = found.estimate.take(own).dense_covariance()
    before = np.sum((J * known) ** 2, axis=(1, 2))
    after = np.einsum("nip,pq,niq->n", J, covariance, J)
    for region, rows in _regions(tips[:, :, 3], seen):
        sizes = [1e3 * float(np.sqrt(np.mean(np.maximum(of[rows], 0.0)))) for of in (before, after)]
        yield Improvement(link, region, int(rows.sum()), *sizes)


def _poses_of_link(fit: ModelFit, link: str) -> tuple[np.ndarray, np.ndarray]:
    """Return joint positions at which a link is judged, shape (N, n), and which were measured."""
    rng = np.random.default_rng(_SEED)
    paths = ((station, station.model.chain.path) for station in fit.problem.stations)
    measured = np.vstack(
        [station.conditions.q for station, path in paths if link in (path.start, path.tip)]
    )
    drawn = rng.permutation(measured)[:_MEASURED]
    anywhere = fit.problem.chain.robot.random_configurations(_DRAWN, rng)
    q = np.vstack([drawn, anywhere])
    return q, np.arange(len(q)) < len(q) - _DRAWN


def _model_of_link(found: FittedRobot, robot: Robot, link: str) -> Model:
    """Return the fitted model whose tip is a link, its targets turned as that."""
    chain = replace(found.model.chain, ends=robot.between(robot.base, link, at_rest=True))
    unturned = np.tile(np.eye(3), (len(chain.targets), 1, 1))
    return found.model.with_chain(chain.with_references(np.eye(3), unturned))


def unplaced(J: np.ndarray, tips: np.ndarray) -> np.ndarray:
    """Return derivatives of positions, shape (N, 3, P), with the placement of instrument and target
    projected out.
    """
    B = np.linalg.qr(placement_motions(tips).reshape(3 * len(J), 9))[0]
    flat = J.reshape(3 * len(J), -1)
    return np.asarray((flat - B @ (B.T @ flat)).reshape(J.shape))


def placement_motions(tips: np.ndarray) -> np.ndarray:
    """Return the derivatives of positions by the placement of instrument (three lengths, three
    angles) and target (three lengths), shape (N, 3, 9).
    """
    parts = np.zeros((len(tips), 3, 9))
    parts[:, :, :3] = np.eye(3)
    parts[:, :, 6:] = tips[:, :, :3]
    for k, axis in enumerate(np.eye(3)):
        parts[:, :, 3 + k] = np.cross(axis, tips[:, :, 3])
    return parts


def _regions(p: np.ndarray, seen: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the regions of positions, shape (N, 3) in the base link's axes, and masks of the
    positions in each.
    """
    yield _MEASURED_POSES, seen
    far = np.hypot(p[:, 0], p[:, 1])
    is_far = far > np.median(far[~seen])
    is_high = p[:, 2] > np.median(p[~seen, 2])
    for distance, by_distance in (("near", ~is_far), ("far", is_far)):
        for height, by_height in (("low", ~is_high), ("high", is_high)):
            rows = ~seen & by_distance & by_height
            if rows.any():
                yield f"{distance}, {height}", rows
