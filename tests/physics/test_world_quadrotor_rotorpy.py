"""The quadrotor against RotorPy (Folk, Paulos and Kumar, 2023): the same rotor commands, the same flight.

RotorPy needs packages that CAVIAR does not. The variable CAVIAR_ROTORPY_PYTHON names a Python that has it,
where this one has not.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from quadrotor_flights import AIRFRAME, STEP, WIND, Flight, figure_of_eight, hover, step

from caviar_services.world.quadrotor.airframe import AIR_DENSITY, GRAVITY

PYTHON = os.environ.get("CAVIAR_ROTORPY_PYTHON", "")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not PYTHON and importlib.util.find_spec("rotorpy") is None,
        reason="needs RotorPy, or CAVIAR_ROTORPY_PYTHON with the path of a Python that has it",
    ),
]


def flown_by_rotorpy(flight: Flight) -> np.ndarray:
    """Position, velocity, quaternion and rates after each step, Shape ``[steps, 13]``."""
    start = flight.start
    given = {
        "airframe": msgspec.structs.asdict(AIRFRAME),
        "air_density": AIR_DENSITY,
        "gravity": GRAVITY,
        "air": WIND,
        "step": STEP,
        "position": start.position,
        "velocity": start.velocity,
        "orientation": start.orientation,
        "rates": start.rates,
        "rotors": flight.rotors,
        "commands": flight.commands,
    }
    program = Path(__file__).with_name("rotorpy_flights.py")
    done = subprocess.run(
        [PYTHON or sys.executable, str(program)],
        input=json.dumps(given),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={key: value for key, value in os.environ.items() if key != "PYTHONPATH"},
    )
    assert done.returncode == 0, done.stderr
    return np.array(json.loads(done.stdout))


@pytest.mark.parametrize("fly", [hover, step, figure_of_eight])
def test_a_flight_is_that_of_rotorpy(fly: Callable[[], Flight]) -> None:
    """Within 10 µm, 10 µm/s, 1e-6 in each part of the quaternion, and 10 µrad/s."""
    flight = fly()
    found = flown_by_rotorpy(flight)
    differences = np.abs(found - flight.states)
    largest = [
        float(differences[:, part].max()) for part in (slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13))
    ]
    assert largest[0] < 1e-5, largest
    assert largest[1] < 1e-5, largest
    assert largest[2] < 1e-6, largest
    assert largest[3] < 1e-5, largest


def test_the_figure_of_eight_tilts_and_comes_back() -> None:
    """What is compared above is a flight that is worth it: fast, tilted, and closed."""
    states = figure_of_eight().states
    tilt = np.degrees(2 * np.arcsin(np.hypot(states[:, 7], states[:, 8])))
    assert tilt.max() > 30
    assert np.linalg.norm(states[:, 3:6], axis=1).max() > 7
    np.testing.assert_allclose(states[-1, :3], (0.0, 0.0, 34.0), atol=0.5)
