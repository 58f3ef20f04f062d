"""What a model lacks, as a part of the uncertainty of its predictions.

Errors are drawn here by a formula of their own: the discrepancy is judged by data that it did not make.
"""

import numpy as np
import pytest
from machines import kuka as true_kuka

from pincal import Measurements, Robot, calibrate, load_model, measurements_from_arrays, run_calibration
from pincal import simulate as sim
from pincal.calibration.discrepancy import Discrepancy, discrepancy_of
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.left_out_variance import target_variances
from pincal.calibration.structure import structure_among
from pincal.identify.options import Options

NOISE = 2e-5


def _levers(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return levers of three drives at n poses, shape (3, n, 3) [m/rad]."""
    return rng.normal(0.0, 0.5, (3, n, 3))


def _sines(q: np.ndarray, levers: np.ndarray, size: float, cycles: float) -> np.ndarray:
    """Return the displacement of targets by a sine of each drive, shape (N, 3) [m]."""
    return np.einsum("nj,jna->na", size * np.sin(cycles * q), levers)


def test_what_drives_lack_is_found_with_its_lengths(rng: np.random.Generator) -> None:
    """Errors of the drives that vary over half a radian are told from what no two poses share, and intervals hold them."""
    q = rng.uniform(-1.5, 1.5, (150, 3))
    levers = _levers(len(q), rng)
    off = _sines(q, levers, 1e-4, 4.0) + 3e-5 * rng.standard_normal((len(q), 3))
    found = discrepancy_of(off, q, levers, np.zeros((len(q), 3, 3)))
    assert found is not None
    variances = found.factor**2 * found.drives.sum(axis=1)
    assert np.all(np.abs(np.sqrt(variances) / (1e-4 / np.sqrt(2.0)) - 1.0) < 0.5)
    assert np.sqrt(found.rest) * found.factor < 6e-5
    others = rng.uniform(-1.5, 1.5, (2000, 3))
    levers = _levers(len(others), rng)
    truth = _sines(others, levers, 1e-4, 4.0) + 3e-5 * rng.standard_normal((len(others), 3))
    sigma = np.sqrt(np.einsum("naa->na", found.variances(levers)))
    assert 0.93 < np.mean(np.abs(truth) < 1.96 * sigma) < 0.995


def test_near_poses_differ_by_less_than_far_ones(rng: np.random.Generator) -> None:
    """The covariance of two poses gives the variance of their difference."""
    q = np.array([[0.0, 0.5], [0.01, 0.5], [1.4, -1.0]])
    levers = np.tile(rng.normal(0.0, 0.5, (2, 1, 3)), (1, 3, 1))
    found = Discrepancy(lengths=np.array([0.2]), drives=np.array([[1e-8], [1e-8]]), rest=1e-12, factor=1.2, coordinates=30)
    errors = found.errors(q, levers)
    C = errors.matrix.reshape(3, 3, 3, 3)
    near, far = (np.trace(C[0, :, 0] + C[i, :, i] - 2.0 * C[0, :, i]) for i in (1, 2))
    assert near < 0.05 * far
    assert np.allclose(errors.blocks, found.variances(levers), rtol=1e-9)
    assert np.linalg.eigvalsh(errors.matrix).min() > 0.0


@pytest.mark.long
def test_noise_is_no_discrepancy(rng: np.random.Generator) -> None:
    """Noise of unknown size has an e-value of 20 in at most one of twenty tables; a sine of the drives has a large one.

    Parameters were fitted: of residuals only what these do not determine counts, of twelve poses as well as of more.
    """
    for n in (12, 60):
        q = rng.uniform(-1.5, 1.5, (n, 3))
        levers = _levers(n, rng)
        motions = rng.normal(0.0, 1e-3, (8, n, 3))

        def evidence(off: np.ndarray, q: np.ndarray = q, levers: np.ndarray = levers, by: np.ndarray = motions) -> float:
            A = by.reshape(len(by), -1).T
            left = off.ravel() - A @ np.linalg.lstsq(A, off.ravel(), rcond=None)[0]
            return structure_among(left.reshape(-1, 3), q, levers, by, np.full(len(q), 1e-10)).evidence()

        draws = np.array([evidence(NOISE * rng.standard_normal((n, 3))) for _ in range(100)])
        # By chance one set of noise exceeds 20 in fewer than one of twenty, more than ten of 100 in one of 100.
        assert np.count_nonzero(draws >= 20.0) <= 10
        assert np.median(draws) < 1.0
        assert evidence(_sines(q, levers, 10.0 * NOISE, 3.0) + NOISE * rng.standard_normal((n, 3))) > 20.0
    # Errors that follow all joints and no drive, by the last and largest table.
    along = rng.normal(size=(3, 3))
    assert evidence(5.0 * NOISE * np.cos(q @ along) + NOISE * rng.standard_normal((n, 3))) > 20.0
    assert discrepancy_of(np.zeros((5, 3)), q[:5], levers[:, :5], np.zeros((5, 3, 3))) is None


@pytest.fixture(scope="module")
def ripples() -> tuple[Robot, np.ndarray, np.ndarray]:
    """Return a UR10, joint positions, and positions of its tip with a ripple of two drives that no model here has."""
    robot = Robot.from_urdf("ur10")
    rng = np.random.default_rng(5)
    q = rng.uniform(-1.5, 1.5, (400, 6))
    from pincal import Conditions
    from pincal.model.chain import Chain
    from pincal.model.model import Model

    turned = q.copy()
    turned[:, 1] += 3e-4 * np.sin(7.0 * q[:, 1])
    turned[:, 3] += 5e-4 * np.sin(5.0 * q[:, 3] + 1.0)
    place = Model(Chain.of(robot), ()).predict(np.zeros(0), Conditions.at(turned))[:, :, 3]
    return robot, q, place


def test_intervals_hold_what_the_model_lacks(ripples: tuple[Robot, np.ndarray, np.ndarray], tmp_path: object) -> None:
    """A model without the ripple of two drives says how well it predicts, in its file, too."""
    robot, q, place = ripples
    rng = np.random.default_rng(6)
    rows = measurements_from_arrays(robot.joint_names, q[:120], position=place[:120] + NOISE * rng.standard_normal((120, 3)))
    found = run_calibration(robot, rows, Options(sigma=NOISE)).fit
    assert found.discrepancy is not None
    poses, sigma = found.predict(q[120:], return_sigma=True)
    off = poses[:, :, 3] - place[120:]
    # Sines stay within their amplitude: an interval of 95 % for normal errors holds nearly all of them.
    assert np.mean(np.abs(off) < 1.96 * sigma) > 0.93
    assert np.sqrt(np.mean(sigma**2)) == pytest.approx(np.sqrt(np.mean(off**2)), rel=0.25)
    by_source = found.position_variances(found.conditions_at(q[120:]))
    assert np.mean(np.abs(off) < 1.96 * np.sqrt(by_source["parameters"])) < 0.6
    assert np.allclose(sum(by_source.values()), sigma**2, rtol=1e-12)
    C = found.covariance_of(q[120:140])
    assert np.allclose(np.einsum("naa->na", C.blocks), sigma[:20] ** 2, rtol=1e-8)
    found.save(f"{tmp_path}/model.json")
    again = load_model(f"{tmp_path}/model.json")
    assert np.allclose(again.predict(q[120:140], return_sigma=True)[1], sigma[:20], rtol=1e-9)


def test_an_adequate_model_may_lack_what_noise_hides(ripples: tuple[Robot, np.ndarray, np.ndarray]) -> None:
    """Where residuals are noise, what is lacking is at most what they could just not show; of unknown noise, nothing."""
    robot, q, _ = ripples
    from pincal import Conditions
    from pincal.model.chain import Chain
    from pincal.model.model import Model

    place = Model(Chain.of(robot), ()).predict(np.zeros(0), Conditions.at(q[:80]))[:, :, 3]
    noise = NOISE * np.random.default_rng(7).standard_normal((80, 3))
    rows = measurements_from_arrays(robot.joint_names, q[:80], position=place + noise)
    found = run_calibration(robot, rows, Options(sigma=NOISE)).fit
    assert found.discrepancy is not None
    lacking = found.position_variances(found.conditions_at(q[100:200]))["model"]
    assert np.sqrt(lacking.mean()) < 0.6 * NOISE
    assert run_calibration(robot, rows, Options()).fit.discrepancy is None
    assert calibrate(robot, rows, Options(sigma=NOISE)).discrepancy is None


def test_predictions_without_a_fold_are_as_uncertain_as_those_of_a_fit_without_it(
    ripples: tuple[Robot, np.ndarray, np.ndarray],
) -> None:
    """The covariance by a difference of information is that of a fit to the other rows."""
    robot, q, place = ripples
    rows = measurements_from_arrays(robot.joint_names, q[:120], position=place[:120])
    fit = calibrate(robot, rows, Options(sigma=NOISE)).fit
    fold = np.arange(120) % 4
    (found,) = target_variances(fit, fold, [0])
    others = calibrate(robot, rows.select(np.flatnonzero(fold != 2)), Options(sigma=NOISE))
    expected = others.position_variances(others.conditions_at(q[:120][fold == 2]))["parameters"]
    np.testing.assert_allclose(np.einsum("naa->na", found.without)[fold == 2], expected, rtol=0.03)
    model = FittedRobot.of(fit)
    by_all = model.position_variances(model.conditions_at(q[:120]))["parameters"]
    np.testing.assert_allclose(np.einsum("naa->na", found.by_all), by_all, rtol=1e-6)


@pytest.mark.long
def test_what_noise_hides_is_the_mean_of_its_posterior(rng: np.random.Generator) -> None:
    """The size of what is lacking is found where it shows, and is of the order of its own uncertainty where it does not.

    An error of the drives that is alike at near positions is told from errors of single readings.
    """
    n = 200
    q = rng.uniform(-1.5, 1.5, (n, 3))
    levers = _levers(n, rng)

    def hidden(off: np.ndarray) -> tuple[float, float]:
        """Return variances of a coordinate by the drives and beside them."""
        drives, rest = structure_among(off, q, levers, np.zeros((0, n, 3)), np.full(n, NOISE**2)).hidden()
        return float(np.mean(np.einsum("j,jna->na", drives.sum(axis=1), levers**2))), rest

    noise = NOISE * rng.standard_normal((n, 3))
    # The variance of 600 readings is known to sqrt(2 / 600) of theirs.
    assert np.sqrt(sum(hidden(noise))) < 2.0 * NOISE * (2.0 / 600.0) ** 0.25
    assert np.sqrt(sum(hidden(np.sqrt(5.0) * noise))) == pytest.approx(2.0 * NOISE, rel=0.15)
    sines = _sines(q, levers, 6e-5, 3.0)
    by_drives, rest = hidden(noise + sines)
    assert np.sqrt(by_drives) == pytest.approx(np.sqrt(np.mean(sines**2)), rel=0.25)
    assert rest < 0.2 * by_drives


def test_orientations_are_as_uncertain_as_drives_and_the_rest_make_them(rng: np.random.Generator) -> None:
    """Intervals of orientations hold fresh ones, of drives that turn the target and of errors of its mount."""
    found = Discrepancy(lengths=np.array([0.2]), drives=np.full((3, 1), 1e-8), rest=0.0, factor=1.0, coordinates=30)
    axes = rng.normal(size=(3, 4000, 3))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    off = np.einsum("jn,jna->na", 1e-4 * rng.standard_normal((3, 4000)), axes) + 2e-4 * rng.standard_normal((4000, 3))
    learned = found.with_turns(off[:1000], axes[:, :1000], np.zeros(1000))
    assert np.sqrt(learned.turn_rest) == pytest.approx(2e-4, rel=0.05)
    sigma = np.sqrt(learned.turn_variances(axes[:, 1000:]))
    assert np.mean(np.abs(off[1000:]) < 1.96 * sigma) == pytest.approx(0.95, abs=0.01)
    assert np.mean(np.abs(off[1000:]) < sigma) == pytest.approx(0.683, abs=0.02)


SOCKETS = {"a": (1.6, 0.3, 0.8), "b": (1.6, -0.4, 0.8), "c": (1.2, 0.9, 1.2)}
READ = 1e-4
# Differences of two positions.
APART = np.hstack([-np.eye(3), np.eye(3)])


def _contacts(seed: int, each: int) -> Measurements:
    """Return contacts of a machine with errors of its geometry, whose joints are read with an error of their own."""
    rng = np.random.default_rng(seed)
    machine = true_kuka().draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    setup = sim.Contact(fixed=SOCKETS, tool=(0.05, 0.03, 0.12), sigma=0.0)
    table = setup.measure(machine, setup.plan(machine.nominal, each * len(SOCKETS), rng=rng), rng=rng)
    q = np.column_stack([table[name] for name in machine.names])
    q += READ * rng.standard_normal(q.shape)
    return measurements_from_arrays(machine.names, q, socket=np.array(table["socket"]))


@pytest.mark.long
@pytest.mark.parametrize("each", [14, pytest.param(25, marks=pytest.mark.rates)])
def test_what_contacts_show_is_the_robots(each: int, kuka: Robot) -> None:
    """No instrument reads contacts: where they scatter without structure, intervals of differences hold it all the same."""
    hits = {"all": list[np.ndarray](), "parameters": list[np.ndarray]()}
    for seed in range(4):
        table = _contacts(seed, each + 15)
        at = {name: np.flatnonzero(np.array(table.socket) == name) for name in SOCKETS}
        found = run_calibration(kuka, table.select(np.concatenate([rows[:each] for rows in at.values()])), Options()).fit
        for rows in at.values():
            conditions = found.readings(table.select(rows[each:])).conditions
            places = found.predict(conditions)[:, :, 3]
            for first in range(len(places) - 1):
                sources = found.covariance_of(conditions.select(np.array([first, first + 1]))).sources
                off = np.abs(places[first + 1] - places[first])
                along = {name: np.diag(of.through(APART)) for name, of in sources.items()}
                hits["all"].append(off < 1.96 * np.sqrt(sum(along.values())))
                hits["parameters"].append(off < 1.96 * np.sqrt(along["parameters"]))
    rates = {name: float(np.mean(of)) for name, of in hits.items()}
    assert 0.93 < rates["all"] < 0.99
    assert rates["parameters"] < 0.7
