"""The case study of the paper, on the KUKA KR 125/2: Tables I and II, Fig. 6, and the coverage of the uncertainties.

Radkhah, Hemker, Friedmann, von Stryk, "Towards the deployment of industrial robots as measurement instruments", section V.
The measured robot is that of Table I, evaluated by code that is independent of the fitted model. 36 geometric parameters
and the 9 elastic ones of the first three joints are free; base and tool (the paper's camera) are known. Run it as

    python examples/kuka_kr125_2.py [--draws 200] [--figure FILE.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from pincal import FittedRobot, Options, Robot, measurements_from_arrays
from pincal.builtin import kuka_urdf_path
from pincal.calibration.checked_fit import fitted
from pincal.identify.options import Stages
from pincal.measure.measurements import Measurements
from pincal.model.effect import Effect
from pincal.model.effects import GEOMETRIC, BearingElasticity, JointElasticity
from pincal.model.model import Model
from pincal.report.plots.found import deviation_figure
from pincal.simulate import paper_positions, plan_poses, read_arm
from pincal.simulate.paper_machine import ELASTICITY, NOMINAL, PAYLOAD_COM, PAYLOAD_MASS, REAL

TOOL = (0.05, 0.03, 0.12)  # the measured point in the flange frame [m]
NOISE = 5e-5  # standard deviation of one component of a position [m]
MEASURED, OTHER = 60, 500  # poses to fit, and others to predict
PAPER_ITERATIONS = 122  # Table II: 10 + 51 + 61
INTERVAL = 1.96  # half width of a 95 % interval in standard deviations
# A direction with more information than this, relative to its prior, is determined by the data alone.
STRONG = 100.0
ROUNDING = 1e-15

ROBOT = Robot.from_urdf(kuka_urdf_path())
ARM = read_arm(kuka_urdf_path(), "tool0")
ELASTIC_JOINTS = ROBOT.joint_names[:3]
EFFECTS: tuple[Effect, ...] = (
    *GEOMETRIC,
    JointElasticity(joints=ELASTIC_JOINTS),
    BearingElasticity(joints=ELASTIC_JOINTS),
)
# Table I's letters by the symbols of pincal; o holds the constant part of the joint angle.
LETTERS = {"theta": "o", "d": "d", "a": "a", "alpha": "alpha", "s_x": "s_x", "s_y": "s_y"}
# Neighbours that rotate about, or shift along, the same nominal axis: only their sum is observable.
SUMS = (
    ("joint_1.alpha", "joint_2.s_x"),
    ("joint_2.alpha", "joint_3.s_x"),
    ("joint_3.alpha", "joint_4.s_x"),
    ("joint_4.alpha", "joint_5.s_x"),
    ("joint_5.alpha", "joint_6.s_x"),
    ("joint_2.d", "joint_3.d"),
)


def measure(q: np.ndarray, rng: np.random.Generator | None = None) -> Measurements:
    """Measure the true robot; without a source of noise, exactly."""
    noise = 0.0 if rng is None else rng.normal(0.0, NOISE, (len(q), 3))
    position = paper_positions(q, tool_offset=TOOL) + noise
    return measurements_from_arrays(ROBOT.joint_names, q, position=position, payload=np.full(len(q), PAYLOAD_MASS))


def fit(
    table: Measurements, *, effects: tuple[Effect, ...] = EFFECTS, stages: Stages = "joint", sigma: float | None = None
) -> FittedRobot:
    """Calibrate with base and tool known, as the paper does."""
    options = Options(
        effects=effects, sigma=sigma, stages=stages, base=np.eye(4), tools={"tool": TOOL}, payload_centre=PAYLOAD_COM
    )
    # Without the checks of ``pincal.calibrate``: where a model is too small they look for mistakes in the table.
    return fitted(ROBOT, table, options)


def deviations(found: FittedRobot, q: np.ndarray, values: np.ndarray | None = None) -> np.ndarray:
    """Return the distances of predictions from the truth, shape (N,) [m]."""
    residuals = found.readings(measure(q)).residuals(found.values if values is None else values)
    return np.asarray(np.linalg.norm(residuals, axis=0))


def true_values(model: Model) -> np.ndarray:
    """Return Table I's real values as deviations from its initial estimates, with the elastic constants, shape (P,)."""
    values = np.zeros(model.n_parameters)
    for i, parameter in enumerate(model.parameters):
        element, symbol = parameter.name.rsplit(".", 1)
        if element == "tool":
            values[i] = TOOL["xyz".index(symbol)]
        elif element != "base":
            joint = ROBOT.joint_names.index(element)
            letter = LETTERS.get(symbol)
            values[i] = REAL[letter][joint] - NOMINAL[letter][joint] if letter else ELASTICITY[symbol][joint]
    return values


def combination_error(found: FittedRobot, values: np.ndarray, reference: np.ndarray) -> float:
    """Return the relative difference of two sets of values in the combinations that the measured poses determine.

    Single parameters can't be compared: alpha_1 and s_x,2 turn about the same axis, and beside which masses they carry
    along (nanometres) only their sum moves the tool. Which of many equivalent sets a fit returns is its choice, so the
    null space has to be projected out. It bends with the parameters; the mean Jacobian along the straight line from one
    set to the other has, exactly, prediction(values) - prediction(reference) = J (values - reference).
    """
    free, sizes = found.solution.free, found.fit.priors.sizes[found.solution.free]
    nodes, weights = np.polynomial.legendre.leggauss(4)
    J = np.zeros((3 * len(found.problem), int(free.sum())))
    for node, weight in zip(0.5 + 0.5 * nodes, 0.5 * weights, strict=True):
        between = reference + node * (values - reference)
        J += weight * found.model.linearise(between, found.problem.conditions, free=free)[1].reshape(len(J), -1)
    _, singular, Vt = np.linalg.svd(J * sizes, full_matrices=False)
    # A combination is determined if a change of the size of its prior moves the readings by more than their noise.
    told = Vt[singular > NOISE]
    difference, size = (told @ (v[free] / sizes) for v in (values - reference, reference))
    return float(np.abs(difference).max() / np.abs(size).max())


def identify_without_noise(seeds: int) -> None:
    """Fit exact measurements: the robot of Table I has to be recovered, also at held-out poses."""
    print(f"(a) Exact measurements: {MEASURED} poses to fit, {OTHER} others to predict, {seeds} seeds")
    first: FittedRobot | None = None
    worst: dict[str, float] = dict.fromkeys(("initial", "joint", "paper", "real", "fits", "apart"), 0.0)
    iterations: dict[str, int] = {"joint": 0, "paper": 0}
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        measured, other = plan_poses(ARM, MEASURED, rng), plan_poses(ARM, OTHER, rng)
        for stages in ("joint", "paper"):
            found = fit(measure(measured), stages=stages)
            first = found if first is None else first
            worst[stages] = max(worst[stages], deviations(found, other).max())
            iterations[stages] = max(iterations[stages], found.fit.iterations)
            worst["real"] = max(worst["real"], combination_error(found, found.values, true_values(found.model)))
            worst["fits"] = max(worst["fits"], combination_error(found, found.values, first.values))
            conditions = found.readings(measure(other)).conditions
            both = [found.model.predict(values, conditions)[:, :, 3] for values in (found.values, first.values)]
            worst["apart"] = max(worst["apart"], float(np.linalg.norm(both[0] - both[1], axis=1).max()))
        worst["initial"] = max(worst["initial"], deviations(found, other, found.fit.nominal.values).max())
    print(f"  nominal model, largest deviation           {worst['initial'] * 1e3:9.2f} mm")
    print(f"  calibrated at once, held-out max           {worst['joint']:9.1e} m, at most {iterations['joint']} iterations")
    print(f"  calibrated in the paper's stages, max      {worst['paper']:9.1e} m, at most {iterations['paper']} iterations")
    print(f"  (the paper's optimisation took {PAPER_ITERATIONS})")
    print(f"  fits of different poses predict apart by   {worst['apart']:9.1e} m")
    print(f"  identified combinations, among these fits  {worst['fits']:9.1e} relative")
    print(f"  identified combinations, to the real ones  {worst['real']:9.1e} relative")


def number(value: float) -> str:
    """Write a value; what is only rounding is written as 0."""
    return f"{value if abs(value) > ROUNDING else 0.0:12.5g}"


def print_table_one() -> None:
    """Print Table I: identified from exact measurements, and from measurements with noise."""
    rng = np.random.default_rng(0)
    q = plan_poses(ARM, MEASURED, rng)
    exact, noisy = fit(measure(q)), fit(measure(q, rng), sigma=NOISE)
    real, nominal = true_values(exact.model), np.array([p.nominal for p in exact.model.parameters])
    print(f"\nTable I [rad, m, rad/(N m)]: identified from exact measurements, and from ones with {NOISE * 1e3:g} mm noise")
    print(f"  {'parameter':14s} {'real':>12s} {'initial':>12s} {'exact':>12s} {'with noise':>12s}")
    for i, finding in enumerate(noisy.explain()):
        if finding.status == "fixed":
            continue
        shown = " ".join(map(number, (nominal[i] + real[i], nominal[i], nominal[i] + exact.values[i])))
        sigma = float(np.sqrt(noisy.covariance[i, i]))
        known = f"{number(nominal[i] + noisy.values[i])} +- {sigma:.1e}"
        print(f"  {finding.name:14s} {shown} {known if finding.status == 'identified' else f'   {finding.reason}'}")
    for names in SUMS:
        pick = np.isin(exact.model.names, names).astype(float)
        shown = " ".join(number(pick @ v) for v in (nominal + real, nominal, nominal + exact.values, nominal + noisy.values))
        print(f"  {' + '.join(names)}\n  {'':14s} {shown} +- {np.sqrt(pick @ noisy.covariance @ pick):.1e}")


def print_table_two(figure: Path) -> None:
    """Print the course of the paper's stages, Table II, and draw Fig. 6."""
    rng = np.random.default_rng(0)
    table, other = measure(plan_poses(ARM, MEASURED, rng)), plan_poses(ARM, OTHER, rng)
    complete, geometric = fit(table, stages="paper"), fit(table, effects=GEOMETRIC)
    print(f"\nTable II: {'stage':36s} {'rms residual [m]':>16s} {'iterations':>10s}")
    for stage in complete.fit.stages:
        print(f"          {stage.name:36s} {stage.rms:16.1e} {stage.iterations:10d}")
    norm = float(np.linalg.norm(complete.fit.station.residuals(complete.values)))
    print(f"          {'norm of the last residual':36s} {norm:16.1e}")
    series = {
        "standard DH": deviations(geometric, other, geometric.fit.nominal.values),
        "DH,s": deviations(geometric, other),
        "DH,s,e": deviations(complete, other),
    }
    deviation_figure(series).savefig(figure)
    print(f"\nFig. 6: {'model':12s} {'mean [m]':>10s} {'max [m]':>10s}   drawn to {figure}")
    for name, values in series.items():
        print(f"        {name:12s} {values.mean():10.1e} {values.max():10.1e}")


def check_uncertainties(draws: int) -> None:
    """Fit many draws of measurements with noise: do the intervals have their nominal coverage?"""
    chi2, combinations, predictions = [], [], []
    for seed in range(draws):
        rng = np.random.default_rng([1, seed])
        measured, other = plan_poses(ARM, MEASURED, rng), plan_poses(ARM, 200, rng)
        # The truth in this choice of equivalent parameters: the estimate from the same poses without noise.
        truth, found = fit(measure(measured), sigma=NOISE), fit(measure(measured, rng), sigma=NOISE)
        chi2.append(found.solution.cost)
        told, free = found.solution.posterior, found.solution.free
        strong = told.information > STRONG
        off = told.directions[:, strong].T @ ((found.values - truth.values)[free] / found.fit.priors.sizes[free])
        combinations.append(np.abs(off) < INTERVAL / np.sqrt(1.0 + told.information[strong]))
        problem = found.readings(measure(other))
        sigma = found.position_sigma(problem.conditions)
        predictions.append(np.abs(problem.residuals(found.values)) < INTERVAL * sigma.T)
    covered = [100.0 * float(np.concatenate([c.ravel() for c in found]).mean()) for found in (combinations, predictions)]
    print(f"\n(b) Measurements with {NOISE * 1e3:g} mm noise, {draws} draws")
    print(f"  reduced chi-square, mean                   {np.mean(chi2):9.3f}   (expected 1)")
    print(f"  combinations within their 95 % interval    {covered[0]:9.1f} % (expected 95)")
    print(f"  predictions within their 95 % interval     {covered[1]:9.1f} % (expected 95)")


def main() -> None:
    """Run the case study."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=12, help="sets of exact measurements (default: %(default)s)")
    parser.add_argument("--draws", type=int, default=20, help="sets of measurements with noise (default: %(default)s)")
    parser.add_argument(
        "--figure", type=Path, default=Path("kuka_fig6.png"), help="where to draw Fig. 6 (default: %(default)s)"
    )
    chosen = parser.parse_args()
    print_table_one()
    print_table_two(chosen.figure)
    print()
    identify_without_noise(chosen.seeds)
    check_uncertainties(chosen.draws)


if __name__ == "__main__":
    main()
