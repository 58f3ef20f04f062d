"""Fixtures shared by all tests."""

from pathlib import Path

import numpy as np
import pytest

from pincal.builtin import kuka_urdf_path
from pincal.robot.robot import Robot

# Data that is not part of the project stands next to it.
SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def kuka() -> Robot:
    """Return the built-in KUKA KR 125/2 of the paper."""
    return Robot.from_urdf(kuka_urdf_path())


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a generator that begins anew in every test."""
    return np.random.default_rng(20240607)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of measurements on real machines; skip the test where it is absent."""
    return _folder("data", "measurements on real machines")


@pytest.fixture(scope="session")
def hidden_examples() -> Path:
    """Return the folder of simulated cases with an undisclosed effect; skip the test where it is absent."""
    return _folder("hidden_examples", "cases with a hidden effect")


def _folder(name: str, what: str) -> Path:
    path = SHARED / name
    if not path.is_dir():
        pytest.skip(f"{what} are not here: no folder shared/{name} next to the project")
    return path
