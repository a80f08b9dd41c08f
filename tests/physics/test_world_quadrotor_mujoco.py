"""The quadrotor of this project against the same forces in MuJoCo."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable

import numpy as np
import pytest
from quadrotor_flights import AIRFRAME, STEP, WIND, Flight, figure_of_eight, hover, step

from caviar_bridges.mujoco import MujocoPlant
from caviar_protocol.errors import SetupError
from caviar_services.world.quadrotor.airframe import Airframe, Body

pytestmark = pytest.mark.slow

HAS_MUJOCO = importlib.util.find_spec("mujoco") is not None
with_mujoco = pytest.mark.skipif(not HAS_MUJOCO, reason="needs MuJoCo, the extra mujoco")


def flown_by_mujoco(flight: Flight) -> np.ndarray:
    plant, body, rotors, states = MujocoPlant(AIRFRAME), flight.start, flight.rotors, []
    for command in flight.commands:
        body, rotors, _ = plant.advance(body, rotors, command, WIND, STEP)
        states.append([*body.position, *body.velocity, *body.orientation, *body.rates])
    return np.array(states)


@with_mujoco
@pytest.mark.parametrize("fly", [hover, step, figure_of_eight])
def test_a_flight_is_that_of_mujoco(fly: Callable[[], Flight]) -> None:
    """Forces are held over a step of 2 ms there: within 5 mm, 5 mm/s, 1e-3 and 5 mrad/s."""
    flight = fly()
    differences = np.abs(flown_by_mujoco(flight) - flight.states)
    assert differences[:, :3].max() < 5e-3
    assert differences[:, 3:6].max() < 5e-3
    assert differences[:, 6:10].max() < 1e-3
    assert differences[:, 10:].max() < 5e-3


@with_mujoco
def test_repeated_flights_have_equal_bits() -> None:
    flight = step()
    np.testing.assert_array_equal(flown_by_mujoco(flight), flown_by_mujoco(flight))


@with_mujoco
def test_a_fall_is_free() -> None:
    plant, body, off = MujocoPlant(AIRFRAME), Body((0.0, 0.0, 50.0)), (0.0, 0.0, 0.0, 0.0)
    for _ in range(100):
        body, _, _ = plant.advance(body, off, off, (0.0, 0.0, 0.0), STEP)
    assert body.velocity[2] == pytest.approx(-9.80665 * 0.2, rel=5e-3)
    assert math.isclose(body.position[2], 50 - 9.80665 * 0.02, rel_tol=1e-4)


@pytest.mark.skipif(HAS_MUJOCO, reason="MuJoCo is installed")
def test_without_mujoco_the_extra_is_named() -> None:
    with pytest.raises(SetupError, match=r"caviar-sim\[mujoco"):
        MujocoPlant(Airframe())
