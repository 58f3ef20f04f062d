"""Hidden effects of the true machine against closed forms."""

from functools import cache

import numpy as np
import pytest
from machines import G, angles, kuka, planar, planar_arm, random_poses, sweep

from pincal import simulate as sim
from pincal.errors import BadInputError
from pincal.simulate.effect import HiddenEffect

EFFECTS: list[HiddenEffect] = [
    sim.JointElasticity(joint="joint_2", size=2e-7),
    sim.BearingElasticity(joint="joint_1", size=2e-8),
    sim.NonlinearElasticity(joint="joint_3", size=2e-7),
    sim.LinkBending(joint="joint_2", size=1e-7),
    sim.BaseElasticity(size=1e-8),
    sim.GravityCompensator(joint="joint_2", size=2e4),
    sim.PayloadError(size=10.0),
    sim.JointOffset(joint="joint_2", size=3e-4),
    sim.GearEccentricity(joint="joint_1", size=1e-4),
    sim.GearEccentricity(joint="joint_4", size=1e-4, order=2),
    sim.GearRipple(joint="joint_2", size=1e-4),
    sim.EncoderSubdivision(joint="joint_1", size=1e-4),
    sim.TransmissionError(joint="joint_3", size=1e-4, seed=4),
    sim.TransmissionError(joint="joint_4", size=1e-4, periodic=False),
    sim.GearRatio(joint="joint_1", size=1e-4),
    sim.JointCoupling(joint="joint_5", source="joint_4", size=2e-4),
    sim.AxisWobble(joint="joint_1", size=5e-5),
    sim.Backlash(joint="joint_2", size=2e-4),
    sim.ShortOfTarget(joint="joint_2", size=2e-4),
    sim.LoadBacklash(joint="joint_3", size=2e-4),
    sim.Hysteresis(joint="joint_2", size=1e-7),
    sim.ServoDroop(joint="joint_2", size=1e-7),
    sim.ThermalExpansion(size=1.2e-5),
    sim.ThermalOffset(joint="joint_2", size=1e-5),
    sim.JointCreep(joint="joint_3", size=2e-4),
    sim.ThermalGrowth(size=1e-4),
    sim.BaseDrift(size=1e-8),
    sim.MeasurementScale(size=2e-5),
    sim.InstrumentAzimuth(size=2e-5),
    sim.InstrumentElevation(size=2e-5),
    sim.InstrumentTilt(size=2e-5),
    sim.InstrumentRange(size=2e-5),
    sim.InstrumentStretch(size=1e-4),
    sim.JointScatter(joint="joint_2", size=1e-4),
    sim.JointLag(joint="joint_2", size=1e-3),
    sim.FrictionWindup(joint="joint_2", size=1e-4),
]


def measured(*effects: HiddenEffect) -> np.ndarray:
    """Return positions of an elastic KUKA with the effects under changing conditions, shape (12, 3)."""
    machine = kuka(compliance=np.full((6, 3), 1e-7)).with_effects(*effects)
    rng = np.random.default_rng(5)
    q = random_poses(machine, 12, seed=3)
    conditions = {"payload": 80.0, "temperature": np.linspace(15, 35, 12), "time": np.arange(12) * 3600.0}
    conditions["velocity"] = np.random.default_rng(6).standard_normal((12, 6))
    table = sim.Instrument().measure(machine, q, rng=rng, approach=rng.choice([-1, 1], (12, 6)), **conditions)
    return np.column_stack([table[axis] for axis in "xyz"])


# Of the machine without effects the positions are always the same.
untouched = cache(measured)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.effect)
def test_effects_of_size_0_change_nothing_and_others_do(effect: HiddenEffect) -> None:
    """Size is what makes an effect, and sizes of practice move the tip by micrometres to millimetres."""
    nothing = sim.hidden_effect(effect.effect, **(vars(effect) | {"size": 0.0}))
    np.testing.assert_allclose(measured(nothing), untouched(), rtol=0, atol=1e-15)
    moved = np.linalg.norm(measured(effect) - untouched(), axis=1).max()
    assert 1e-5 < moved < 2e-2


def test_every_effect_of_the_catalogue_is_tested() -> None:
    """No entry is left out of the list above."""
    assert {effect.effect for effect in EFFECTS} == set(sim.HIDDEN_EFFECTS)


def test_eccentric_and_elliptical_wheels_make_one_and_two_waves_a_turn() -> None:
    """The error is e sin(phase - q) for a crank and e sin(2 (q - phase)) for ellipses, but for e squared."""
    q, e = sweep(), 1e-4
    crank = sim.GearEccentricity(joint="lift", size=e, phase=0.7)
    np.testing.assert_allclose(angles(planar(effects=(crank,)), q), e * np.sin(0.7 - q[:, 0]), rtol=0, atol=e**2)
    wheels = sim.GearEccentricity(joint="lift", size=e, phase=0.7, order=2)
    waves = e * np.sin(2 * (q[:, 0] - 0.7))
    np.testing.assert_allclose(angles(planar(effects=(wheels,)), q), waves, rtol=0, atol=e**2)


def test_a_lost_zero_is_the_same_at_every_angle() -> None:
    """The drive stands off by the size, wherever it is."""
    lost = angles(planar(effects=(sim.JointOffset(joint="lift", size=1e-3),)), sweep())
    np.testing.assert_allclose(lost, 1e-3, rtol=0, atol=1e-15)


def test_a_wheel_of_a_stage_and_an_encoders_lines_make_fine_waves() -> None:
    """A crank behind a ratio errs by e sin(phase - k q); offset and amplitude of a signal once and twice per line."""
    q, e, k = sweep(), 1e-5, 101.0
    crank = sim.GearRipple(joint="lift", size=e, order=k, phase=0.7)
    np.testing.assert_allclose(angles(planar(effects=(crank,)), q), e * np.sin(0.7 - k * q[:, 0]), rtol=0, atol=k * e**2)
    for offset, wave in ((1.0, -e * np.cos(k * q[:, 0])), (0.0, -e * np.sin(2 * k * q[:, 0]))):
        lines = sim.EncoderSubdivision(joint="lift", size=e, order=k, offset=offset)
        np.testing.assert_allclose(angles(planar(effects=(lines,)), q), wave, rtol=0, atol=3 * k * e**2)


def test_gear_ratio_and_coupling_scale_with_the_angle() -> None:
    """A wrong ratio adds size times the joint's own angle, a coupling size times its source's."""
    q = sweep()
    for effect in (
        sim.GearRatio(joint="lift", size=1e-3),
        sim.JointCoupling(joint="bend", source="lift", size=1e-3),
    ):
        np.testing.assert_allclose(angles(planar(effects=(effect,)), q), 1e-3 * q[:, 0], rtol=0, atol=1e-15)


def test_transmission_error_is_a_curve_of_the_angle_with_its_rms() -> None:
    """The curve repeats after a turn; its rms over a turn is its size; another seed is another curve."""
    turn = np.linspace(-np.pi, np.pi, 1000, endpoint=False)
    curve = sim.TransmissionError(joint="lift", size=3e-4, seed=2).curve
    assert curve(turn).std() == pytest.approx(3e-4)
    np.testing.assert_allclose(curve(turn), curve(turn + 2 * np.pi), rtol=0, atol=1e-14)
    assert not np.allclose(curve(turn), sim.TransmissionError(joint="lift", size=3e-4, seed=3).curve(turn))
    assert np.abs(np.diff(curve(turn))).max() < 3e-5


def test_backlash_follows_the_recorded_approach() -> None:
    """The joint lags by half the play behind the direction from which it came."""
    machine = planar(effects=(sim.Backlash(joint="lift", size=2e-3),))
    lag = angles(machine, np.zeros((3, 2)), approach={"lift": [-1, 0, 1]})
    np.testing.assert_allclose(lag, [1e-3, 0, -1e-3], rtol=0, atol=1e-15)


def test_backlash_without_a_record_follows_the_order_of_the_poses() -> None:
    """The drive crosses the play before it moves the joint."""
    machine = planar(effects=(sim.Backlash(joint="lift", size=2e-3),))
    drive = np.array([0.0, 0.5, 0.4995, 0.4, 0.4])
    lag = angles(machine, np.column_stack((drive, 0 * drive)))
    np.testing.assert_allclose(lag, [0, -1e-3, -5e-4, 1e-3, 1e-3], rtol=0, atol=1e-14)


def test_hysteresis_lags_by_friction_under_the_load() -> None:
    """Stretched out, the drive lags by the wind-up under friction from either side; upright by that of the preload."""
    machine = planar(effects=(sim.Hysteresis(joint="lift", size=1e-6, preload=2.0),))
    q = np.array([[0.0, 0.0], [0.0, 0.0], [np.pi / 2, 0.0]])
    lag = np.angle(np.exp(1j * angles(machine, q, approach={"lift": [-1, 1, 1]})))
    load = G * (10 * 0.5 + 5 * 1.25)
    np.testing.assert_allclose(lag, [1e-6 * (load + 2.0), -1e-6 * (load + 2.0), -2e-6], rtol=1e-3, atol=1e-9)
    drive = np.array([0.0, 0.5, 0.2])
    in_order = angles(machine, np.column_stack((drive, 0 * drive)))
    assert in_order[0] == 0.0 and in_order[1] < 0.0 < in_order[2], "without a record, the pose before tells the side"


def test_load_backlash_lies_on_the_side_of_the_load() -> None:
    """Under a large torque the joint sits at half the play, on both sides of the vertical."""
    machine = planar(effects=(sim.LoadBacklash(joint="lift", size=1e-3, transition=1.0),))
    play = angles(machine, np.array([[0.0, 0.0], [np.pi, 0.0], [np.pi / 2, 0.0]]))
    wrapped = np.angle(np.exp(1j * play))
    np.testing.assert_allclose(wrapped, [-5e-4, 5e-4, 0.0], rtol=0, atol=1e-6)


def test_nonlinear_elasticity_is_the_integral_of_its_compliance() -> None:
    """The wind-up is the integral of size / sqrt(1 + (torque / stiffening)^2)."""
    effect = sim.NonlinearElasticity(joint="bend", size=1e-5, stiffening=5.0)
    torque = np.linspace(0, -5 * G * 0.25, 20001)
    integral = np.trapezoid(1e-5 / np.sqrt(1 + (torque / 5.0) ** 2), torque)
    sag = angles(planar(effects=(effect,)), np.zeros((1, 2)))
    assert sag[0] == pytest.approx(integral, rel=1e-6)


def test_the_springs_torque_is_minus_the_gradient_of_its_energy() -> None:
    """The compensator conserves energy."""
    spring = sim.GravityCompensator(joint="lift", size=1e4)

    def energy(q: np.ndarray) -> np.ndarray:
        lever = spring.lever[0] * np.column_stack((np.cos(q), np.sin(q), 0 * q))
        return 0.5e4 * (np.linalg.norm(np.array(spring.anchor) - lever, axis=1) - spring.free_length) ** 2

    q, h = np.linspace(-1.0, 2.0, 31), 1e-6
    np.testing.assert_allclose(spring.torque(q), -(energy(q + h) - energy(q - h)) / (2 * h), rtol=0, atol=1e-4)


def test_a_bent_link_is_a_cantilever() -> None:
    """A payload at the end of the forearm bends it by F L^3 / 3 E I and turns its end by F L^2 / 2 E I."""
    machine = planar(effects=(sim.LinkBending(joint="bend", size=1e-6),))
    tip = machine.tip(np.zeros((1, 2)), payload=20.0)
    assert tip[0, 2, 3] - 0.4 == pytest.approx(-1e-6 * 20 * G * 0.5**3 / 3, rel=1e-6)
    assert tip[0, 2, 0] == pytest.approx(-1e-6 * 20 * G * 0.5**2 / 2, rel=1e-6)


def test_the_base_tilts_under_the_whole_arm() -> None:
    """The tip of the stretched arm sinks by its distance times the tilt."""
    machine = planar(effects=(sim.BaseElasticity(size=1e-7),))
    tilt = 1e-7 * G * (10 * 0.5 + 5 * 1.25)
    assert machine.tip(np.zeros((1, 2)))[0, 2, 3] - 0.4 == pytest.approx(-1.5 * tilt, rel=1e-4)


def test_wobble_tilts_the_axis_in_a_turning_direction() -> None:
    """Seen from before the joint the tilt points to order q + phase."""
    wobble = sim.AxisWobble(joint="lift", size=1e-4, phase=0.4)
    machine = sim.TrueMachine.from_urdf(planar_arm("0 0 1"), tip="tip", effects=(wobble,))
    q = sweep()
    tilt = np.cross([0, 0, 1], machine.tip(q)[:, :3, 2])
    direction = 2 * q[:, 0] + 0.4
    expected = 1e-4 * np.column_stack((np.cos(direction), np.sin(direction), 0 * direction))
    np.testing.assert_allclose(tilt, expected, rtol=0, atol=1e-8)


def test_heat_scales_the_whole_arm_or_one_link() -> None:
    """The whole arm grows about its base; one link moves what is beyond it."""
    q, cold = sweep(), planar().tip(sweep())[:, :3, 3]
    whole = planar(effects=(sim.ThermalExpansion(size=1e-5),)).tip(q, temperature=30.0)[:, :3, 3]
    np.testing.assert_allclose(whole, cold * (1 + 1e-4), rtol=0, atol=1e-14)
    upper = planar(effects=(sim.ThermalExpansion(joint="lift", size=1e-5),)).tip(q, temperature=10.0)[:, :3, 3]
    along = np.column_stack((np.cos(q[:, 0]), 0 * q[:, 0], np.sin(q[:, 0])))
    np.testing.assert_allclose(upper - cold, -1e-4 * along, rtol=0, atol=1e-14)


def test_zero_shift_and_drift_follow_temperature_and_time() -> None:
    """A joint shifts per kelvin, the base creeps per second."""
    q = np.zeros((2, 2))
    shift = angles(planar(effects=(sim.ThermalOffset(joint="lift", size=1e-5),)), q, temperature=[20.0, 27.0])
    np.testing.assert_allclose(shift, [0, 7e-5], rtol=0, atol=1e-15)
    drift = planar(effects=(sim.BaseDrift(size=1e-8),)).tip(q, time=[0.0, 1e4]) - planar().tip(q)
    np.testing.assert_allclose(drift[:, :3, 3], [[0, 0, 0], [0.8e-4, 0.6e-4, 0]], rtol=0, atol=1e-15)


def test_a_drive_is_short_by_a_share_of_its_way() -> None:
    """The way is from where the joint stood; not sent anywhere, it stays there; the first pose it has reached."""
    q = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.5], [0.4, 0.5]])
    machine = planar(effects=(sim.ShortOfTarget(joint="lift", size=0.1),))
    short = np.array([0.0, -0.1, -0.1, 0.1 * (0.9 - 0.4)])
    sides = np.ones((4, 2))
    np.testing.assert_allclose(angles(machine, q), short, rtol=0, atol=1e-15)
    np.testing.assert_allclose(angles(machine, q, approach=sides), short, rtol=0, atol=1e-15)


def test_creep_and_growth_die_away() -> None:
    """After a time constant 63 % are over; before the start nothing has happened."""
    q, t = np.zeros((3, 2)), np.array([-5.0, 2e3, 1e6])
    part = np.array([0.0, 1.0 - np.exp(-1.0), 1.0])
    creep = planar(effects=(sim.JointCreep(joint="lift", size=1e-4, time_constant=2e3),))
    np.testing.assert_allclose(angles(creep, q, time=t), 1e-4 * part, rtol=0, atol=1e-15)
    grown = planar(effects=(sim.ThermalGrowth(size=1e-4, time_constant=2e3),)).tip(q, time=t)[:, :3, 3]
    cold = planar().tip(q)[:, :3, 3]
    np.testing.assert_allclose(grown, cold * (1.0 + 1e-4 * part[:, None]), rtol=0, atol=1e-14)


def test_payload_error_adds_to_what_is_carried() -> None:
    """A machine that carries more than declared is one that declares more, in loaded rows only."""
    soft, q = planar(compliance=np.full((2, 3), 1e-6)), np.zeros((2, 2))
    heavier = soft.with_effects(sim.PayloadError(size=3.0))
    np.testing.assert_array_equal(heavier.tip(q, payload=[0.0, 10.0]), soft.tip(q, payload=[0.0, 13.0]))
    np.testing.assert_array_equal(heavier.tip(q), soft.tip(q, payload=3.0))


def test_unknown_effects_and_joints_are_named() -> None:
    """A message lists what there is, nearest first."""
    with pytest.raises(BadInputError, match=r"expected one of backlash"):
        sim.hidden_effect("backlsh", joint="lift")
    with pytest.raises(BadInputError, match="no sise; it has joint, size"):
        sim.hidden_effect("backlash", joint="lift", sise=1)
    with pytest.raises(BadInputError, match="source"):
        sim.hidden_effect("joint_coupling", joint="lift")
    with pytest.raises(BadInputError, match="expected one of lift, bend"):
        planar(effects=(sim.GearRatio(joint="lft", size=1e-4),)).tip(np.zeros((1, 2)))
    with pytest.raises(BadInputError, match="moment_frame"):
        sim.BearingElasticity(joint="lift", size=1e-7, moment_frame="between")
    with pytest.raises(BadInputError, match="order 3"):
        planar(effects=(sim.GearEccentricity(joint="lift", size=1e-4, order=3),)).tip(np.zeros((1, 2)))
