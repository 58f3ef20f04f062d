"""The paper's true robot against the true machine, which shares no code with it."""

from itertools import pairwise

import numpy as np
import pinocchio as pin
from machines import READY, kuka, random_poses

from pincal import simulate as sim
from pincal.simulate import paper_machine


def paper_like_machine(**errors: object) -> sim.TrueMachine:
    """Return the true machine with the real geometry of Table I, as errors of the nominal placements."""
    real, nominal = paper_machine.REAL, paper_machine.NOMINAL
    zero = np.zeros((1, 6))
    frames = [paper_machine.link_frames(zero, geometry) for geometry in (nominal, real)]
    placements = []
    for geometry, chain in zip((nominal, real), frames, strict=True):
        tilts = [
            pin.SE3(pin.rpy.rpyToMatrix(x, 0.0, 0.0) @ pin.rpy.rpyToMatrix(0.0, y, 0.0), np.zeros(3)).homogeneous
            for x, y in zip(geometry["s_x"], geometry["s_y"], strict=True)
        ]
        ends = [np.eye(4)] + [chain[k][0] @ tilts[k] for k in range(6)] + [chain[6][0]]
        placements.append([np.linalg.solve(a, b) for a, b in pairwise(ends)])
    deltas = [pin.SE3(np.linalg.solve(a, b)) for a, b in zip(*placements, strict=True)]
    vectors = [np.concatenate((delta.translation, pin.log3(delta.rotation))) for delta in deltas]
    return kuka(placement_errors=vectors, **errors)


def test_the_papers_geometry_is_that_of_the_true_machine() -> None:
    """Two independent codes place the flange of Table I's real robot alike."""
    machine = paper_like_machine()
    q = random_poses(machine, 20)
    np.testing.assert_allclose(sim.paper_transform(q, with_elasticity=False), machine.tip(q), rtol=0, atol=1e-12)


def test_the_papers_elastic_model_is_the_true_machine_but_for_the_deformed_levers() -> None:
    """The paper leaves out that the deformed arm has other levers: at most 3 % of the deflection."""
    constants = np.array([paper_machine.ELASTICITY[name] for name in ("k_x", "k_y", "k_z")]).T
    machine = paper_like_machine(compliance=constants)
    q = random_poses(machine, 50)
    paper = sim.paper_positions(q)
    true = machine.tip(q, payload=paper_machine.PAYLOAD_MASS, payload_com=paper_machine.PAYLOAD_COM)[:, :3, 3]
    deflection = np.linalg.norm(paper - sim.paper_positions(q, with_elasticity=False), axis=1).max()
    assert 1e-9 < np.linalg.norm(paper - true, axis=1).max() < 0.03 * deflection


def test_the_papers_moments_are_those_of_the_unloaded_machine() -> None:
    """Eq. (3) on DH,s agrees with the sums over Pinocchio's placements."""
    machine = paper_like_machine()
    q = random_poses(machine, 20)
    poses = machine.poses(q, payload=paper_machine.PAYLOAD_MASS, payload_com=paper_machine.PAYLOAD_COM)
    moments = machine.equilibrium(poses).loads.before
    # The paper's centres of mass follow S_k, the machine's the link before theta: about 1 N m of 8 kN m.
    np.testing.assert_allclose(sim.paper_moments(q), moments, rtol=0, atol=2.0)


def test_initial_deviations_are_those_of_the_paper() -> None:
    """From the nominal model the true positions are off by up to between 0.7 and 2 cm."""
    machine = kuka()
    q = sim.plan_poses(machine.nominal, 300, np.random.default_rng(0))
    off = np.linalg.norm(sim.paper_positions(q) - machine.tip(q)[:, :3, 3], axis=1)
    assert 0.007 < off.max() < 0.02


def test_tool_offset_moves_with_the_flange() -> None:
    """A point off the flange is carried by the flange's pose."""
    flange = sim.paper_transform(READY)[0]
    np.testing.assert_allclose(
        sim.paper_positions(READY, tool_offset=(0.1, 0.2, 0.3))[0],
        flange[:3, :3] @ [0.1, 0.2, 0.3] + flange[:3, 3],
        atol=1e-15,
    )
