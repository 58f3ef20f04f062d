"""Joints that take the same positions again and again: what can't be told of them is said, and no curve is finer."""

import numpy as np
import pytest
from machines import kuka as true_kuka

from pincal import simulate as sim
from pincal.calibration.precheck import precheck
from pincal.discover.drive_curves import notes_on_repeats, smoothed
from pincal.discover.run import run_discovery
from pincal.identify.calibrate import fit_tables
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.model.catalogue import TransmissionError
from pincal.model.catalogue.candidates import testable as candidates_on
from pincal.model.catalogue.candidates import untestable
from pincal.model.conditions import PoseSet
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot

ROWS = 126


@pytest.fixture(scope="module")
def rows(kuka: Robot) -> Measurements:
    """Return a table in which joint 2 stands at 5 positions and joint 3 at 12, but for what an encoder reads."""
    rng = np.random.default_rng(2)
    machine = true_kuka().draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    q = sim.plan_poses(machine.nominal, ROWS, rng)
    for joint, values in ((1, 5), (2, 12)):
        grid = np.linspace(q[:, joint].min(), q[:, joint].max(), values)
        nearest = np.argmin(np.abs(q[:, joint, None] - grid), axis=1)
        q[:, joint] = grid[nearest] + 2e-5 * rng.standard_normal(ROWS)
    table = sim.Instrument(targets={"ball": (0.1, 0.0, 0.1)}, sigma=5e-5).measure(machine, q, rng=rng)
    position = np.column_stack([table[axis] for axis in "xyz"])
    return measurements_from_arrays(kuka.joint_names, q, position=position)


@pytest.mark.long
def test_what_repeated_positions_can_not_tell_is_said(kuka: Robot, rows: Measurements) -> None:
    """By check and by discover: which joint, how many positions, and the waves that look like others."""
    options = Options(effects=GEOMETRIC, sigma=5e-5)
    report = precheck(kuka, rows, options)
    step = 2.0 * np.degrees(np.ptp(rows.q[:, 1])) / 4.0

    said = [note for note in report.warnings if "distinct positions" in note.text]
    texts = [note.text for note in said]
    assert [text.split()[0] for text in texts] == ["joint_2", "joint_3"]
    assert f"takes 5 distinct positions in {ROWS} rows" in texts[0] and f"a period shorter than {step:.3g} deg" in texts[0]
    assert [joint.distinct for joint in report.joints[1:3]] == [5, 12]
    assert set(said) <= set(run_discovery(kuka, rows, options, test_fraction=0.0).calibration.result.warnings)


def test_nothing_is_said_of_positions_that_do_not_repeat(kuka: Robot) -> None:
    """Nor of a joint that stands still, of which other words tell."""
    q = kuka.random_configurations(300, np.random.default_rng(0))
    q[:, 4] = 0.3

    assert not list(notes_on_repeats(kuka, q))


def test_no_curve_is_finer_than_the_positions_of_its_joint(kuka: Robot, rows: Measurements) -> None:
    """Of 5 positions none is tried, with the reason; of 12 none of more than 12 pieces; else a sixth of the rows."""
    fit = fit_tables(kuka, rows, Options(effects=GEOMETRIC, sigma=5e-5))
    situation = PoseSet(fit.model.chain, fit.station.conditions)
    found = [c for c in candidates_on(situation) if isinstance(c.effect, TransmissionError)]
    finest = {c.effect.locus.joint: max(form.size for form in c.forms) for c in found}
    lost = untestable(situation.chain, situation.conditions)
    reasons = [why for effect, why in lost if effect.heading[:2] == ("transmission_error", "joint_2")]

    assert finest == {"joint_1": 18, "joint_3": 12, "joint_4": 18, "joint_5": 18, "joint_6": 18}
    assert reasons == ["joint_2 takes 5 distinct positions, and the coarsest curve that is tried has 8 pieces"]
    curve = TransmissionError.over("joint_3", situation.positions("joint_3"), 8)
    ((entered, _),) = smoothed(fit, [curve])[0].values()
    assert curve.smooth(situation, None).resolution == 12 >= entered.resolution
