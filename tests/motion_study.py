"""What an IMU on the flange and a tracker in motion tell of simulated arms: ``python tests/motion_study.py PART``.

The truth comes from ``pincal.simulate``, which shares no code with the model. Errors are judged at 300 random poses of the
whole workspace, base and tool placed by rigid transforms only, so that "nominal" means the same for all.
"""

from __future__ import annotations

import argparse
import time as wall
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from unittest.mock import patch

import numpy as np

import pincal
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.design.design_model import DesignModel
from pincal.design.motion_design import MotionDesign, design_motion
from pincal.design.reach import SensorSetup
from pincal.measure.measurements import Measurements
from pincal.motion.sessions import Session
from pincal.motion.stamps import in_order
from pincal.motion.stream import Stream, checked_imu
from pincal.robot.se3 import align, exponentials, nearest_rotation
from pincal.robot.urdf_file import find_file
from pincal.simulate.contact import draw_instrument, draw_targets
from pincal.simulate.moving import ViaPath, draw_path
from pincal.simulate.session import Clock, ImuSetup, MovingSession
from pincal.simulate.typical import draw_typical_elasticity, draw_typical_errors
from pincal.units import STANDARD_GRAVITY

# Noise of the IMU: 1 mg/sqrt(Hz) and 0.01 deg/s/sqrt(Hz); of the tracker [m].
DENSITIES, TRACKER = (1e-3 * STANDARD_GRAVITY, np.deg2rad(0.01)), 3e-5
G = (0.0, 0.0, -STANDARD_GRAVITY)
ARMS = {"kuka (6R)": (kuka_urdf_path, "tool0"), "panda (7R)": (lambda: find_file("panda"), "panda_hand_tcp")}
GEOMETRY = pincal.Options(effects=pincal.GEOMETRIC)


@dataclass(frozen=True)
class Truth:
    """A machine and a session of it."""

    robot: pincal.Robot
    machine: sim.TrueMachine
    session: MovingSession
    tracker: sim.Instrument

    @classmethod
    def draw(
        cls,
        name: str,
        seed: int,
        *,
        duration: float,
        imu: bool = True,
        tracker: bool = False,
        noise: float = 1.0,
        vibration: float = 0.0,
        drift: float | None = None,
        hidden: Sequence[sim.HiddenEffect] = (),
        **logs: float,
    ) -> Truth:
        """Draw a machine with typical errors, a path and what logs it."""
        urdf, tip = ARMS[name]
        rng = np.random.default_rng([seed, 31])
        robot = pincal.Robot.from_urdf(urdf(), tip=tip)
        machine = sim.TrueMachine.from_urdf(robot.urdf.decode(), tip=robot.tip, base=robot.base, gravity=G)
        machine = draw_typical_errors(machine, rng).with_effects(*hidden)
        path, (acc, gyro) = draw_path(machine.nominal, duration, rng), DENSITIES
        setup = ImuSetup.draw(rng, acc_density=noise * acc, gyro_density=noise * gyro, vibration=vibration)
        targets = draw_targets(machine.nominal, 1, rng)
        beside = sim.Instrument(
            pose=draw_instrument(machine.nominal, rng), targets=next(iter(targets.values())), sigma=TRACKER
        )
        clocks = {what: Clock.draw(rng, middle=0.5 * duration, drift=drift) for what in ("imu", "tracker")}
        given = {"resolution": 2e-5, "dropped": 0.01} | logs
        session = MovingSession(
            path=path,
            duration=duration,
            imu=setup if imu else None,
            tracker=beside if tracker else None,
            clocks=clocks,
            **given,  # type: ignore[arg-type]
        )
        return cls(robot, machine, session, beside)

    def logged(self, seed: int = 0) -> Mapping[str, Mapping[str, np.ndarray]]:
        """Return what is logged of the session, with noise of this seed."""
        return self.session.measure(self.machine, np.random.default_rng([seed, 7]))

    def tables(self, seed: int = 0, logged: Mapping[str, Mapping[str, np.ndarray]] | None = None) -> dict[str, Measurements]:
        """Return the stations of the session."""
        logged, streams = self.logged(seed) if logged is None else logged, {}
        for what, columns in logged.items():
            fields = {"specific_force": ("ax", "ay", "az"), "angular_rate": ("wx", "wy", "wz"), "position": tuple("xyz")}
            read = {f: np.column_stack([columns[c] for c in of]) for f, of in fields.items() if of[0] in columns}
            if what == "joints":
                read = {"q": np.column_stack([columns[name] for name in self.robot.joint_names])}
            streams[what] = in_order(Stream(what, columns["time"], read, {}))
        if "imu" in streams:
            streams["imu"] = checked_imu(streams["imu"])
        return pincal.session_tables(self.robot, [Session("", **streams)])

    def poses(self, n: int, seed: int = 0) -> Measurements:
        """Return n held poses before the tracker."""
        rng = np.random.default_rng([seed, 5])
        read = self.tracker.measure(self.machine, sim.plan_poses(self.machine.nominal, n, rng), rng=rng)
        q, position = (np.column_stack([read[c] for c in columns]) for columns in (self.robot.joint_names, "xyz"))
        return pincal.measurements(self.robot, q, position=position)

    @cached_property
    def elsewhere(self) -> tuple[np.ndarray, np.ndarray]:
        """Random poses, and where the true tip is there, shape (300, 3)."""
        q = sim.plan_poses(self.machine.nominal, 300, np.random.default_rng(1))
        return q, self.machine.tip(q)[:, :3, 3]

    def error(self, robot: pincal.FittedRobot | None) -> float:
        """Return the mean error of a model, or of the nominal robot, placed by rigid transforms [mm]."""
        q, expected = self.elsewhere
        tips = self.robot.forward_kinematics(q) if robot is None else robot.predict(q)
        p, R, n = tips[:, :3, 3], tips[:, :3, :3], len(q)
        turned, origin = align(p, expected)
        p, R = p @ turned.T + origin, turned @ R
        for _ in range(6):
            turns = np.stack([np.cross(axis, p) for axis in np.eye(3)], axis=2)
            B = np.concatenate([np.tile(np.eye(3), (n, 1, 1)), turns, R], axis=2).reshape(3 * n, 9)
            move = np.linalg.lstsq(B, (expected - p).ravel(), rcond=1e-12)[0]
            small = exponentials(move[None, 3:6])[0]
            p, R = (p + R @ move[6:]) @ small.T + move[:3], small @ R
        left = expected - p
        return 1e3 * float(np.linalg.norm(left, axis=1).mean())

    def axis_errors(self, found: pincal.FittedRobot | None) -> np.ndarray:
        """Return the rms angle between found and true axes as the tool sees them, shape (joints,) [mrad].

        The tool is turned so that they agree best: what no IMU can tell does not count.
        """
        rng = np.random.default_rng(0)
        q = self.session.path.at(rng.uniform(0.0, self.session.duration, 200))

        def in_tool(place: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
            axes = []
            for j in range(self.robot.n_joints):
                moved = q.copy()
                moved[:, j] += 0.5
                T = np.swapaxes(place(q)[:, :3, :3], 1, 2) @ place(moved)[:, :3, :3]
                axis = np.stack([T[:, 2, 1] - T[:, 1, 2], T[:, 0, 2] - T[:, 2, 0], T[:, 1, 0] - T[:, 0, 1]], axis=1)
                axes.append(axis / np.linalg.norm(axis, axis=1, keepdims=True))
            return np.array(axes)

        a, b = in_tool(self.robot.forward_kinematics if found is None else found.predict), in_tool(self.machine.tip)
        R = nearest_rotation(np.einsum("jna,jnb->ab", b, a))
        return 1e3 * np.sqrt(np.mean(np.sum((a @ R.T - b) ** 2, axis=2), axis=1))

    def clock_error(
        self, table: Measurements, fit: pincal.FittedRobot, name: str, prefix: str = ""
    ) -> tuple[float, float, float]:
        """Return by how much offset [ms] and drift [ppm] are off, and the offset in standard deviations."""
        assert table.moving is not None
        values = dict(zip(fit.estimate.names, zip(fit.values, fit.estimate.sigma, strict=True), strict=True))
        (offset, sigma), (drift, _) = (values[f"{prefix}clock.{what}"] for what in ("offset", "drift"))
        clock, middle = self.session.clocks[name], table.moving.middle
        off = table.moving.clock[0] + offset - (clock.offset + clock.drift * (middle - clock.middle))
        return 1e3 * off, 1e6 * (table.moving.clock[1] + drift - clock.drift), off / sigma


def calibrated(truth: Truth, tables: Mapping[str, Measurements]) -> pincal.FittedRobot:
    """Return a calibration by some stations; the noise of held poses is declared."""
    options = replace(GEOMETRY, sigma=TRACKER if "poses" in tables else None)
    return pincal.calibrate(truth.robot, dict(tables) if len(tables) > 1 else next(iter(tables.values())), options)


def axes(seeds: int, duration: float) -> Iterator[str]:
    """An IMU alone: axes, clock, and errors elsewhere."""
    for name in ARMS:
        for seed in range(seeds):
            truth = Truth.draw(name, seed, duration=duration)
            ((_, table),) = truth.tables().items()
            fit = calibrated(truth, {"": table})
            robot = fit.robot_model()
            clock = truth.clock_error(table, fit, "imu")
            nominal = truth.axis_errors(None).max()
            yield (
                f"{name}, seed {seed}: axes {np.array2string(truth.axis_errors(robot), precision=3)} mrad (nominal at most "
                f"{nominal:.1f}), elsewhere {truth.error(None):.3f} -> {truth.error(robot):.3f} mm, clock off by "
                f"{clock[0]:.3f} ms, {clock[1]:.2f} ppm"
            )


def together(seeds: int, duration: float) -> Iterator[str]:
    """A few held poses before a tracker, alone and with an IMU."""
    for name in ARMS:
        for seed in range(seeds):
            truth = Truth.draw(name, seed, duration=duration)
            tables, found = {"imu": truth.tables()["imu"]}, list[str]()
            for n in (6, 8, 10, 25):
                poses = truth.poses(n)
                sizes = [
                    truth.error(calibrated(truth, of).robot_model()) for of in ({"poses": poses}, {"poses": poses} | tables)
                ]
                found.append(f"{n}: {sizes[0]:.3f} -> {sizes[1]:.3f}")
            yield f"{name}, seed {seed}: nominal {truth.error(None):.3f}; poses -> and IMU [mm]: {', '.join(found)}"


def predicted(at: pincal.FittedRobot, q: np.ndarray) -> np.ndarray:
    """Return the standard deviations of predicted positions, shape (N,) [m]."""
    J = at.model.linearise(at.model_values, pincal.Conditions.at(q))[1][:, :3]
    return np.sqrt(np.einsum("nip,pq,niq->n", J, at.estimate.take(at.model.names).dense_covariance(), J))


def held(seeds: int, duration: float) -> Iterator[str]:
    """Every 25th position of a tracker in motion against as many poses that are held, on the path or anywhere."""
    for name in ARMS:
        truth = Truth.draw(name, 0, duration=duration, imu=False, tracker=True)
        table, rng = truth.tables()["tracker"].select(slice(None, None, 25)), np.random.default_rng(2)
        n, time = len(table), rng.uniform(0.0, duration, 300)
        fit = calibrated(truth, {"poses": table})
        q, sizes = truth.session.path.at(time), []
        for poses in (truth.session.path.at(rng.uniform(0.0, duration, n)), sim.plan_poses(truth.machine.nominal, n, rng)):
            read = truth.tracker.measure(truth.machine, poses, rng=rng)
            at, position = (np.column_stack([read[c] for c in names]) for names in (truth.robot.joint_names, "xyz"))
            still = calibrated(truth, {"poses": pincal.measurements(truth.robot, at, position=position)})
            sizes.append(float(np.mean(predicted(fit.at(), q) / predicted(still.at(), q))))
        off = truth.clock_error(table, fit, "tracker")
        yield (
            f"{name}: {n} positions in motion: standard deviation of predictions over that of held poses of the path "
            f"{sizes[0]:.3f}, of random ones {sizes[1]:.3f}; off elsewhere {truth.error(fit.robot_model()):.4f} mm, clock "
            f"{1e3 * off[0]:.2f} us"
        )


def coverage(seeds: int, duration: float) -> Iterator[str]:
    """In how many draws of noise intervals of 95 % cover: of positions of the tool in motion, and of clocks."""
    from scipy.stats import binomtest

    for name in ARMS:
        truth = Truth.draw(name, 0, duration=duration, imu=True, tracker=True)
        inside, clocks = [], {"imu": [], "tracker": []}
        rng = np.random.default_rng(3)
        q = truth.session.path.at(rng.uniform(0.1 * duration, 0.9 * duration, 100))
        for seed in range(seeds):
            tables = {what: table.select(slice(None, None, 5)) for what, table in truth.tables(seed).items()}
            fit = calibrated(truth, tables)
            at = fit.at("tracker")
            expected = (truth.tracker.pose @ truth.machine.tip(q) @ truth.tracker.targets[""])[:, :3, 3]
            poses, J = at.model.linearise(at.model_values, pincal.Conditions.at(q))
            C = at.estimate.take(at.model.names).dense_covariance()
            sigma = np.sqrt(np.einsum("nip,pq,niq->ni", J[:, :3], C, J[:, :3]))
            inside.append(np.mean(np.abs(poses[:, :, 3] - expected) < 1.96 * sigma))
            for what in clocks:
                clocks[what].append(abs(truth.clock_error(tables[what], fit, what, f"{what}/")[2]) < 1.96)
        told = []
        for what, hits in clocks.items():
            low, high = binomtest(sum(hits), len(hits)).proportion_ci(method="exact")
            told.append(f"clock of the {what} {np.mean(hits):.3f} ({low:.3f} to {high:.3f})")
        spread = np.std(inside) / len(inside) ** 0.5
        yield f"{name}: {seeds} draws: positions {np.mean(inside):.3f} +- {spread:.3f}, {', '.join(told)}"


def clocks(seeds: int, duration: float) -> Iterator[str]:
    """A clock that is 1000 ppm off, by IMU and by tracker, and what the calibration then leaves."""
    for name in ARMS:
        truth = Truth.draw(name, 0, duration=duration, tracker=True, drift=1e-3)
        tables = truth.tables()
        fit = calibrated(truth, tables)
        off = {what: truth.clock_error(tables[what], fit, what, f"{what}/") for what in tables}
        words = ", ".join(f"{what} {o:.4f} ms, {d:.2f} ppm" for what, (o, d, _) in off.items())
        yield f"{name}: 1000 ppm are found but for: {words}; elsewhere {truth.error(fit.robot_model()):.4f} mm"


def lag(seeds: int, duration: float) -> Iterator[str]:
    """A joint that lags by 2 ms and one that friction winds up, searched by name."""
    for name in ARMS:
        joint = pincal.Robot.from_urdf(ARMS[name][0](), tip=ARMS[name][1]).joint_names[1:3]
        hidden = (sim.JointLag(joint=joint[0], size=2e-3), sim.FrictionWindup(joint=joint[1], size=1e-4))
        truth = Truth.draw(name, 0, duration=duration, tracker=True, hidden=hidden)
        tables = truth.tables()
        tables["tracker"] = tables["tracker"].select(slice(None, None, 10))
        found = pincal.run_discovery(truth.robot, tables, GEOMETRY, stability=0)
        names = [f"{e.effect} of {e.joint}" for e in found.findings.effects]
        values = {p.name: p for p in found.calibration.result.parameters}
        size = values.get(f"{joint[0]}.lag")
        told = "" if size is None else f"; the lag is {1e3 * size.value:.3f} +- {1e3 * 1.96 * size.sigma:.3f} ms"
        yield f"{name}: hidden {joint[0]} lag 2 ms, {joint[1]} friction 0.1 mrad; found {', '.join(names)}{told}"


def stressed(seeds: int, duration: float) -> Iterator[str]:
    """An IMU alone where what is assumed fails."""
    cases = {
        "as assumed": {},
        "vibration 0.1 m/s^2": {"vibration": 0.1},
        "vibration 0.5 m/s^2": {"vibration": 0.5},
        "noise 5 times": {"noise": 5.0},
        "5 % of the rows lost": {"dropped": 0.05},
        "joints rounded to 0.01 deg": {"resolution": 1.7e-4},
    }
    for name in ARMS:
        for words, case in cases.items():
            truth = Truth.draw(name, 0, duration=duration, **case)
            table = truth.tables()["imu"]
            fit = calibrated(truth, {"": table})
            off, _, z = truth.clock_error(table, fit, "imu")
            robot = fit.robot_model()
            before, after = truth.error(None), truth.error(robot)
            yield (
                f"{name}, {words}: axes at most {truth.axis_errors(robot).max():.3f} mrad, elsewhere {before:.3f} -> "
                f"{after:.3f} mm, clock {off:.3f} ms ({z:+.1f} sigma)"
            )


def polled(seeds: int, duration: float) -> Iterator[str]:
    """An IMU alone whose latest sample is read at nearly its own rate: by stamps of polls, and of samples as found."""
    for name in ARMS:
        for seed in range(seeds):
            truth = Truth.draw(name, seed, duration=duration, vibration=0.1)
            logged = {what: dict(columns) for what, columns in truth.logged().items()}
            samples, rng = logged["imu"]["time"], np.random.default_rng([seed, 9])
            polls = np.arange(samples[0] + 0.5, samples[-1], 1.0 / 101.0)
            polls += rng.uniform(0.0, 1e-3, len(polls))
            rows = np.searchsorted(samples, polls) - 1
            late = logged | {"imu": {c: values[rows] for c, values in logged["imu"].items()} | {"time": polls}}
            with patch("pincal.motion.stations.at_samples", lambda *given: None):
                tables = {"samples": truth.tables(logged=logged), "polls": truth.tables(logged=late)}
            tables["polls, as found"] = truth.tables(logged=late)
            found = {words: calibrated(truth, of).robot_model() for words, of in tables.items()}
            told = [
                f"{words} {truth.error(robot):.3f} mm, axes at most {truth.axis_errors(robot).max():.3f} mrad"
                for words, robot in found.items()
            ]
            yield f"{name}, seed {seed}: nominal {truth.error(None):.3f} mm; by stamps of {'; '.join(told)}"


def drives(seeds: int, duration: float) -> Iterator[str]:
    """An IMU alone on arms with eccentric gears, ripples, friction and compliance, as fitted and by geometry alone."""
    for name in ARMS:
        for seed in range(seeds):
            rng, truth = np.random.default_rng([seed, 41]), Truth.draw(name, seed, duration=duration, vibration=0.1)
            hidden = [
                kind(joint=joint, size=float(size * rng.standard_normal()), **given)
                for joint in truth.robot.joint_names
                for kind, size, given in (
                    (sim.GearEccentricity, 8e-5, {"order": 1, "phase": rng.uniform(0.0, 6.3)}),
                    (sim.GearEccentricity, 6e-5, {"order": 2, "phase": rng.uniform(0.0, 6.3)}),
                    (sim.GearRipple, 3e-5, {"phase": rng.uniform(0.0, 6.3)}),
                    (sim.FrictionWindup, 8e-5, {}),
                )
            ]
            machine = draw_typical_elasticity(truth.machine.with_effects(*hidden), rng, scale=0.3)
            # An IMU tells no lengths; angles and zeros are those of an arm that is 1 mm off.
            machine = machine.draw_errors(rng, sigma_length=5e-5, sigma_angle=5e-4, sigma_offset=5e-4)
            truth = replace(truth, machine=machine)
            table = truth.tables()["imu"]
            found = calibrated(truth, {"": table}).robot_model()
            with patch("pincal.identify.calibrate.with_drives", lambda robot, effects: effects):
                bare = calibrated(truth, {"": table}).robot_model()
            yield (
                f"{name}, seed {seed}: elsewhere {truth.error(None):.3f} -> {truth.error(found):.3f} mm, "
                f"{truth.error(bare):.3f} mm by geometry alone; axes off by at most "
                f"{truth.axis_errors(found).max():.3f} mrad, {truth.axis_errors(bare).max():.3f}"
            )


def speed(seeds: int, duration: float) -> Iterator[str]:
    """Ten minutes of joints at 150 Hz, an IMU at 100 Hz and a tracker at 250 Hz: processor time of all."""
    for name in ARMS:
        truth = Truth.draw(name, 0, duration=600.0, tracker=True)
        calibrated(truth, Truth.draw(name, 0, duration=20.0, tracker=True).tables())
        logged = truth.logged()
        begin = wall.process_time()
        tables = truth.tables(logged=logged)
        laid = wall.process_time() - begin
        rows, told = ", ".join(f"{len(t)} of {what}" for what, t in tables.items()), []
        for words, options in {"geometry": GEOMETRY, "all": pincal.Options(moment_frame="auto")}.items():
            begin = wall.process_time()
            fit = pincal.calibrate(truth.robot, tables, options)
            told.append(f"{words} in {laid + wall.process_time() - begin:.1f} s, {len(fit.estimate.names)} parameters")
        yield f"{name}: rows {rows}: laid out in {laid:.1f} s; {'; '.join(told)}"


def picture(seeds: int, duration: float) -> Iterator[str]:
    """Error against the noise of the IMU, alone and with eight tracker poses: docs/pictures/imu_noise.png."""
    import matplotlib.pyplot as plt

    factors = np.array([0.3, 1.0, 3.0, 10.0, 30.0])
    figure, panels = plt.subplots(1, len(ARMS), figsize=(9.0, 3.4), sharey=True)
    for panel, name in zip(panels, ARMS, strict=True):
        alone, both, nominal, poses = [], [], [], []
        for seed in range(seeds):
            truths = [Truth.draw(name, seed, duration=duration, noise=factor) for factor in factors]
            held, imus = truths[0].poses(8), [truth.tables()["imu"] for truth in truths]
            pairs = list(zip(truths, imus, strict=True))
            alone.append([t.error(calibrated(t, {"": imu}).robot_model()) for t, imu in pairs])
            both.append([t.error(calibrated(t, {"poses": held, "imu": imu}).robot_model()) for t, imu in pairs])
            nominal.append(truths[0].error(None))
            poses.append(truths[0].error(calibrated(truths[0], {"poses": held}).robot_model()))
        for sizes, words, mark in ((alone, f"IMU alone, {duration:g} s", "o-"), (both, "IMU and 8 tracker poses", "s-")):
            panel.plot(factors, np.mean(sizes, axis=0), mark, label=words)
        panel.axhline(np.mean(nominal), color="0.5", linestyle="--", label="nominal")
        panel.axhline(np.mean(poses), color="0.5", linestyle=":", label="8 tracker poses alone")
        panel.set(
            title=name, xscale="log", yscale="log", xlabel="noise, times 1 mg and 0.01 deg/s per $\\sqrt{\\mathrm{Hz}}$"
        )
        means = [np.mean(sizes, axis=0).round(3) for sizes in (alone, both)]
        known = f"nominal {np.mean(nominal):.3f}, 8 poses {np.mean(poses):.3f}"
        yield f"{name}: noise {factors}: alone {means[0]}, with 8 poses {means[1]} mm; {known}"
    panels[0].set_ylabel("mean error of the tool [mm]")
    panels[1].legend(fontsize=8, loc="lower right")
    figure.tight_layout()
    figure.savefig(Path(__file__).parents[1] / "docs" / "pictures" / "imu_noise.png", dpi=110)


def via_path(truth: Truth, found: MotionDesign) -> ViaPath:
    """Return a chosen motion as the simulator drives it."""
    q = dict(zip(truth.robot.joint_names, found.q.T, strict=True))
    return ViaPath(found.time, np.column_stack([q[name] for name in truth.machine.names]))


def vouched(truth: Truth, fit: pincal.FittedRobot | None = None) -> float:
    """Return the error of the tool that a fit by an IMU alone foresees by what it releases, base and tool placed [mm]."""
    fit = calibrated(truth, truth.tables()) if fit is None else fit
    cared = pincal.Conditions.at(truth.robot.random_configurations(200, np.random.default_rng(0)))
    design = DesignModel.of(truth.robot, cared, GEOMETRY, SensorSetup())
    J = design.placed_errors(cared) / design.units[design.has_prior]
    names = [p.name for p, is_free in zip(fit.problem.parameters, fit.solution.free, strict=True) if is_free]
    known = [k for k, name in enumerate(design.own_names) if name in names]
    at = [names.index(design.own_names[k]) for k in known]
    C = fit.solution.known.covariance[np.ix_(at, at)]
    return 1e3 * float(np.sqrt(np.sum(J[:, known] @ C * J[:, known]) / len(cared.q)))


def chosen(seeds: int, duration: float) -> Iterator[str]:
    """A motion that was chosen, beside a random one as long: what a fit foresees of what an IMU tells."""
    for name in ARMS:
        ratios = []
        for seed in range(seeds):
            truth = Truth.draw(name, seed, duration=duration, vibration=0.1)
            found = design_motion(truth.robot, duration, GEOMETRY, seed=seed)
            session = replace(truth.session, path=via_path(truth, found), duration=float(found.time[-1]))
            ratios.append(vouched(replace(truth, session=session)) / vouched(truth))
        yield f"{name}: error foreseen after a chosen motion over that after a random one: {np.round(ratios, 2)}"


PARTS = {
    part.__name__: part
    for part in (axes, chosen, together, held, coverage, clocks, lag, stressed, polled, drives, speed, picture)
}


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "part", choices=PARTS, help="; ".join(f"{name}: {part.__doc__}".replace("%", "%%") for name, part in PARTS.items())
    )
    parser.add_argument("--seeds", type=int, default=2, help="machines, or draws of noise")
    parser.add_argument("--duration", type=float, default=300.0, help="of a path [s]")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    for line in PARTS[given.part](given.seeds, given.duration):
        print(line, flush=True)


if __name__ == "__main__":
    main()
