"""What users say of parameters beforehand, and how likely a fit makes readings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import multivariate_normal, norm

from pincal import GEOMETRIC, BadInputError, Options, Robot, calibrate, measurements_from_arrays
from pincal.calibration.likelihood import log_likelihood
from pincal.cli import pincal as command
from pincal.identify.whitening import Serial
from pincal.measure.measurements import Measurements
from pincal.simulate import paper_positions
from pincal.units import size_in

NOISE = 5e-5  # [m]


@pytest.fixture(scope="module")
def table(kuka: Robot) -> Measurements:
    """Rows of the paper's machine, geometry alone."""
    rng = np.random.default_rng(5)
    q = kuka.random_configurations(90, rng)
    position = paper_positions(q, tool_offset=(0.1, 0.0, 0.2), with_elasticity=False)
    return measurements_from_arrays(kuka.joint_names, q, position=position + rng.normal(0.0, NOISE, position.shape))


@pytest.mark.long
def test_what_is_held_stays_nominal_and_what_is_free_has_no_prior(kuka: Robot, table: Measurements) -> None:
    priors: dict[str, float | str] = {"*.s_?": 0.0, "*.theta": "3mrad", "joint_2.theta": np.inf}
    usual, told = (calibrate(kuka, table, Options(effects=GEOMETRIC, priors=of)) for of in ({}, priors))
    sizes = dict(zip((p.name for p in told.problem.parameters), told.fit.priors.sizes, strict=True))
    held = [name.endswith(("s_x", "s_y")) for name in sizes]

    assert sum(held) == 12 and not told.values[held].any() and not told.solution.free[held].any()
    assert sizes["joint_3.theta"] == 3e-3 and sizes["joint_2.theta"] >= 1.0
    assert usual.solution.free.sum() == told.solution.free.sum() + 12


def test_a_prior_counts_as_much_as_a_reading_of_the_parameter(kuka: Robot, table: Measurements) -> None:
    """A prior so narrow that it holds: the posterior's spread is its own; of a wide one the spread is that of the rows."""
    for size, ratio in ((1e-9, 1.0), (1.0, None)):
        fit = calibrate(kuka, table, Options(effects=GEOMETRIC, sigma=NOISE, priors={"joint_2.a": size}))
        k = [p.name for p in fit.problem.parameters].index("joint_2.a")
        sigma = float(np.sqrt(fit.estimate.covariance.variance[k]))
        assert sigma == pytest.approx(size, rel=1e-3) if ratio else sigma < 1e-3


@pytest.mark.parametrize(
    ("priors", "words"),
    [
        ({"joint_2.thta": 1.0}, "such as joint_2.theta"),
        ({"base.x": 1.0}, "base and targets excluded"),
        ({"*.theta": "1mm"}, "expected a number in rad"),
        ({"*.theta": -1.0}, "a standard deviation"),
        ({"*.theta": float("nan")}, "a standard deviation"),
        ({"*.theta": 1e300}, "from 1e-30 to 1e\\+30"),
        ({"*.theta": 1e-300}, "from 1e-30 to 1e\\+30"),
    ],
)
def test_a_prior_that_means_nothing_is_refused(
    kuka: Robot, table: Measurements, priors: dict[str, float], words: str
) -> None:
    with pytest.raises(BadInputError, match=words):
        calibrate(kuka, table, Options(priors=priors))


@pytest.mark.parametrize("text", ["", "mm", "1e", "2 mrad", "1mm/Nm", "1_0mm", "0.1mm extra"])
def test_a_size_of_another_kind_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected a number in"):
        size_in(text, "m")


def test_log_likelihood_is_that_of_the_normal_distribution(kuka: Robot, table: Measurements) -> None:
    """Closed form, by scipy; that of a table is what a fit says of its own rows."""
    fit = calibrate(kuka, table, Options(effects=GEOMETRIC, sigma=NOISE, loss="none"))
    residuals = fit.predict(table.q)[:, :, 3] - table.position
    expected = norm.logpdf(residuals, scale=NOISE).sum()

    assert fit.log_likelihood == pytest.approx(expected, rel=1e-9)
    assert fit.score(table) == pytest.approx(expected / residuals.size, rel=1e-9)
    spent = fit.solution.effective
    assert fit.aic == pytest.approx(2.0 * spent - 2.0 * expected)
    assert fit.bic == pytest.approx(spent * np.log(residuals.size) - 2.0 * expected)


def test_log_likelihood_of_noise_along_the_order_is_that_of_its_covariance(kuka: Robot, table: Measurements) -> None:
    from dataclasses import replace

    fit = calibrate(kuka, table, Options(effects=GEOMETRIC, sigma=NOISE, loss="none"))
    n, phi, share = len(table), 0.8, 0.6
    serial = Serial(np.full(3, phi), np.full(3, share), np.arange(float(n)), np.ones(n, bool))
    problem = replace(fit.problem, stations=(replace(fit.problem.stations[0], serial=serial),))
    walk = share * phi ** np.abs(np.subtract.outer(np.arange(n), np.arange(n))) + (1.0 - share) * np.eye(n)
    covariance = NOISE**2 * walk / serial._spread(phi, share)
    residuals = fit.predict(table.q)[:, :, 3] - table.position
    expected = sum(multivariate_normal(np.zeros(n), covariance).logpdf(r) for r in residuals.T)

    assert log_likelihood(replace(fit.fit, problem=problem)) == pytest.approx(expected, rel=1e-6)


def test_tables_are_read_from_files(kuka: Robot, table: Measurements, tmp_path: Path) -> None:
    from pincal.measure.table import write_table

    columns = {**dict(zip(kuka.joint_names, table.q.T, strict=True)), **dict(zip("xyz", table.position.T, strict=True))}
    for name in ("monday", "tuesday"):
        write_table(tmp_path / f"{name}.csv", columns)
    options = Options(effects=GEOMETRIC)
    read = calibrate(kuka, str(tmp_path / "monday.csv"), options)

    np.testing.assert_array_equal(read.values, calibrate(kuka, table, options).values)
    assert calibrate(kuka, [tmp_path / "monday.csv", tmp_path / "tuesday.csv"], options).names == ("monday", "tuesday")
    assert read.score(tmp_path / "monday.csv") == read.score(table)


@pytest.mark.long
def test_the_command_takes_priors(kuka: Robot, table: Measurements, tmp_path: Path) -> None:
    from pincal.builtin import kuka_urdf_path
    from pincal.measure.table import write_table

    columns = {**dict(zip(kuka.joint_names, table.q.T, strict=True)), **dict(zip("xyz", table.position.T, strict=True))}
    write_table(tmp_path / "t.csv", columns)
    call = [
        "calibrate",
        str(kuka_urdf_path()),
        str(tmp_path / "t.csv"),
        "--out",
        str(tmp_path / "r"),
        "--model",
        "geometric",
    ]
    ran = CliRunner().invoke(command, [*call, "--fix", "*.s_x", "--prior", "*.theta=2mrad", "--free", "joint_2.a"])
    assert ran.exit_code == 0, ran.output
    assert CliRunner().invoke(command, [*call, "--prior", "*.theta"]).exit_code != 0
