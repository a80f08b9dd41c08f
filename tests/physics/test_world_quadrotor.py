"""The rigid body of a quadrotor and its controller against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from caviar_clients.envs.deliveries import rotary_wing_power
from caviar_protocol.space.coordinates import Vector, quaternion_from_euler, rotated
from caviar_services.world.quadrotor.airframe import AIR_DENSITY, GRAVITY, Airframe, Body, Plant, Rotors
from caviar_services.world.quadrotor.control import Attitude, Autopilot, Controller

pytestmark = pytest.mark.slow

STILL: Vector = (0.0, 0.0, 0.0)
OFF: Rotors = (0.0, 0.0, 0.0, 0.0)
STEP = 0.002
BARE = Airframe(linear_drag_n_s_m=STILL, drag_area_m2=STILL)

rates = st.floats(-6.0, 6.0, allow_subnormal=False)


def fly(plant: Plant, body: Body, rotors: Rotors, seconds: float, air: Vector = STILL) -> Body:
    """With rotors at constant speeds."""
    for _ in range(round(seconds / STEP)):
        body, _, _ = plant.advance(body, rotors, rotors, air, STEP)
    return body


def angular_momentum(airframe: Airframe, body: Body) -> np.ndarray:
    """In world axes [kg·m²/s]."""
    x, y, z = (j * o for j, o in zip(airframe.inertia_kg_m2, body.rates, strict=True))
    return np.array(rotated(body.orientation, (x, y, z)))


def spin_energy(airframe: Airframe, body: Body) -> float:
    """[J]"""
    return 0.5 * sum(j * o * o for j, o in zip(airframe.inertia_kg_m2, body.rates, strict=True))


def test_free_fall_without_air_keeps_energy_and_is_a_parabola() -> None:
    start = Body((1.0, 2.0, 300.0), (3.0, -4.0, 5.0))
    end = fly(Plant(BARE), start, OFF, 4.0)
    expected = (1.0 + 3.0 * 4, 2.0 - 4.0 * 4, 300.0 + 5.0 * 4 - GRAVITY * 8)
    assert end.position == pytest.approx(expected, abs=1e-9)
    energy = [0.5 * math.dist(b.velocity, STILL) ** 2 + GRAVITY * b.position[2] for b in (start, end)]
    assert energy[1] == pytest.approx(energy[0], rel=1e-12)


def test_free_fall_with_quadratic_drag_has_the_closed_form() -> None:
    """v = v∞·tanh(g·t/v∞) with v∞² = 2·m·g/(ρ·A): Landau and Lifshitz, or any text on drag."""
    area = 0.03
    airframe = replace(BARE, drag_area_m2=(0.0, 0.0, area))
    terminal = math.sqrt(2 * airframe.mass_kg * GRAVITY / (AIR_DENSITY * area))
    for t in (0.5, 2.0, 10.0):
        speed = -fly(Plant(airframe), Body((0.0, 0.0, 0.0)), OFF, t).velocity[2]
        assert speed == pytest.approx(terminal * math.tanh(GRAVITY * t / terminal), rel=1e-9)


def test_linear_drag_against_the_wind_has_the_closed_form() -> None:
    """Carried by the wind w: v = w·(1 − exp(−d·t/m)), along each axis of the world with its own d."""
    airframe = replace(BARE, linear_drag_n_s_m=(0.4, 0.3, 0.2))
    plant = Plant(airframe, gravity=0.0)
    wind = (5.0, -2.0, 1.0)
    end = fly(plant, Body(STILL), OFF, 3.0, air=wind)
    for v, w, d in zip(end.velocity, wind, airframe.linear_drag_n_s_m, strict=True):
        assert v == pytest.approx(w * (1 - math.exp(-d * 3.0 / airframe.mass_kg)), rel=1e-10)


def test_drag_turns_with_the_body() -> None:
    """With the nose to the north, what the air does along the world's y is the drag along the body's x."""
    airframe = replace(BARE, linear_drag_n_s_m=(0.4, 0.0, 0.0))
    north = Body(STILL, (3.0, 5.0, 0.0), quaternion_from_euler(math.pi / 2))
    end = fly(Plant(airframe, gravity=0.0), north, OFF, 2.0)
    expected = (3.0, 5.0 * math.exp(-0.4 * 2.0 / airframe.mass_kg), 0.0)
    assert end.velocity == pytest.approx(expected, abs=1e-9)


@given(st.tuples(rates, rates, rates))
@settings(max_examples=25, deadline=None)
def test_without_moments_angular_momentum_and_energy_stay(spin: Vector) -> None:
    """Torque-free motion of a body with three different moments of inertia (Euler's equations)."""
    airframe = replace(BARE, inertia_kg_m2=(0.02, 0.03, 0.05))
    start = Body(STILL, STILL, quaternion_from_euler(0.3, -0.2, 0.9), spin)
    end = fly(Plant(airframe), start, OFF, 1.0)
    size = max(float(np.linalg.norm(angular_momentum(airframe, start))), 1e-3)
    np.testing.assert_allclose(
        angular_momentum(airframe, end), angular_momentum(airframe, start), atol=1e-7 * size
    )
    assert spin_energy(airframe, end) == pytest.approx(spin_energy(airframe, start), rel=1e-7, abs=1e-12)


def test_a_step_of_half_the_length_has_a_sixteenth_of_the_error() -> None:
    """The order of the method is four."""
    plant, start = (
        Plant(Airframe()),
        Body(STILL, (9.0, 2.0, 0.0), quaternion_from_euler(0.0, 0.4), (5.0, 3.0, 2.0)),
    )
    rotors = (600.0, 640.0, 580.0, 620.0)

    def after(count: int) -> np.ndarray:
        body = start
        for _ in range(count):
            body, _, _ = plant.advance(body, rotors, rotors, STILL, 0.4 / count)
        return np.array([*body.velocity, *body.orientation, *body.rates])

    exact = after(640)
    errors = [float(np.abs(after(count) - exact).max()) for count in (10, 20, 40)]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.3)
    assert errors[1] / errors[2] == pytest.approx(16, rel=0.3)


def test_hover_thrust_is_the_weight_and_each_rotor_moves_its_own_corner() -> None:
    """Front left, rear left, rear right, front right; x forward, y left."""
    airframe, plant = Airframe(), Plant(Airframe())
    hover: Rotors = (airframe.hover_speed,) * 4
    assert 4 * airframe.thrust_n_s2 * airframe.hover_speed**2 == pytest.approx(airframe.mass_kg * GRAVITY)
    body, _, _ = plant.advance(Body(STILL), hover, hover, STILL, STEP)
    assert body.velocity == pytest.approx(STILL, abs=1e-15)
    # A faster rotor at (x, y) makes the moment (y·f, −x·f), and turns the body against its own turning.
    corners = {0: (1, -1, 1), 1: (1, 1, -1), 2: (-1, 1, 1), 3: (-1, -1, -1)}
    for index, signs in corners.items():
        speeds = list(hover)
        speeds[index] *= 1.01
        turned, _, _ = plant.advance(Body(STILL), tuple(speeds), tuple(speeds), STILL, STEP)  # type: ignore[arg-type]
        assert tuple(np.sign(turned.rates)) == signs


def test_a_rotor_follows_its_command_with_its_lag() -> None:
    """ω = u + (ω₀ − u)·exp(−t/τ), and the work is ∫ c_Q·Σω³ dt."""
    airframe, plant = Airframe(), Plant(Airframe())
    body, rotors, work = Body(STILL), (500.0, 600.0, 700.0, 550.0), 0.0
    start, command = rotors, (600.0, 500.0, 650.0, 800.0)
    for _ in range(25):
        body, rotors, done = plant.advance(body, rotors, command, STILL, STEP)
        work += done
    left = math.exp(-0.05 / airframe.rotor_lag_s)
    expected = [u + (o - u) * left for o, u in zip(start, command, strict=True)]
    assert rotors == pytest.approx(expected, rel=1e-12)
    t = np.linspace(0.0, 0.05, 20001)
    speeds = (
        np.array(command) + (np.array(start) - np.array(command)) * np.exp(-t / airframe.rotor_lag_s)[:, None]
    )
    power = airframe.torque_n_m_s2 * (speeds**3).sum(axis=1)
    assert work == pytest.approx(float(np.trapezoid(power, t)), rel=1e-6)


def test_the_default_takes_the_power_of_the_model_of_the_environments_in_hover() -> None:
    """Zeng, Xu and Zhang 2019, table I: 168.49 W; weight and disc area are theirs too."""
    airframe = Airframe()
    power = 4 * airframe.torque_n_m_s2 * airframe.hover_speed**3
    assert power == pytest.approx(rotary_wing_power(STILL), rel=3e-3)
    assert airframe.mass_kg * GRAVITY == pytest.approx(20.0, rel=1e-3)
    # Momentum theory: no rotor hovers with less than √(T³/(2·ρ·A)), of discs of 0.503 m² in all.
    ideal = math.sqrt((airframe.mass_kg * GRAVITY) ** 3 / (2 * AIR_DENSITY * 0.503))
    assert 0.4 < ideal / power < 0.8


@pytest.mark.parametrize(("axis", "angle"), [(0, 0.05), (1, -0.05), (2, 0.04)])
def test_a_step_of_attitude_is_that_of_a_second_order_system(axis: int, angle: float) -> None:
    """θ(t)/θ_d = 1 − e^(−ζωt)·(cos ω_d·t + ζω/ω_d·sin ω_d·t), with rotors that follow at once."""
    airframe = replace(BARE, rotor_lag_s=1e-5)
    controller = Controller(attitude_rad_s=12.0, attitude_damping=0.6)
    pilot, plant = Autopilot(airframe, controller, 4.0), Plant(airframe)
    angles = [0.0, 0.0, 0.0]
    angles[axis] = angle
    wanted = Attitude(quaternion_from_euler(angles[2], angles[1], angles[0]), airframe.mass_kg * GRAVITY)
    body, rotors, h = Body(STILL), (airframe.hover_speed,) * 4, 0.0005
    omega, zeta = 12.0, 0.6
    damped = omega * math.sqrt(1 - zeta**2)
    for k in range(1, 1601):
        body, rotors, _ = plant.advance(body, rotors, pilot.rotors(body, wanted), STILL, h)
        t = k * h
        decay = math.exp(-zeta * omega * t)
        expected = 1 - decay * (math.cos(damped * t) + zeta * omega / damped * math.sin(damped * t))
        got = 2.0 * body.orientation[1 + axis] / angle
        assert got == pytest.approx(expected, abs=5e-3)


def test_attitude_is_reached_from_upside_down_and_by_the_shorter_way() -> None:
    airframe = Airframe()
    pilot, plant = Autopilot(airframe, Controller(), 4.0), Plant(airframe)
    level = Attitude((1.0, 0.0, 0.0, 0.0), airframe.mass_kg * GRAVITY)
    body, rotors = Body(STILL, STILL, quaternion_from_euler(0.0, 0.0, 3.1)), (airframe.hover_speed,) * 4
    first = 0.0
    for k in range(1500):
        body, rotors, _ = plant.advance(body, rotors, pilot.rotors(body, level), STILL, STEP)
        if k == 20:
            first = body.rates[0]
    assert first < 0.0  # back by −3.1 rad, not on by 2π − 3.1
    assert abs(body.orientation[0]) == pytest.approx(1.0, abs=1e-6)


def test_thrust_and_attitude_give_the_acceleration_that_is_asked_for() -> None:
    """In still air, once the attitude is reached; turned to any heading."""
    airframe = BARE
    pilot, plant = Autopilot(airframe, Controller(), 4.0), Plant(airframe)
    for yaw in (0.0, 1.2, -2.5):
        wish = (2.0, -1.5, 1.0)
        body, rotors = Body(STILL, STILL, quaternion_from_euler(yaw)), (airframe.hover_speed,) * 4
        for _ in range(1000):
            wanted = pilot.attitude(body, wish, yaw, 0.0)
            body, rotors, _ = plant.advance(body, rotors, pilot.rotors(body, wanted), STILL, STEP)
        before = body.velocity
        for _ in range(50):
            wanted = pilot.attitude(body, wish, yaw, 0.0)
            body, rotors, _ = plant.advance(body, rotors, pilot.rotors(body, wanted), STILL, STEP)
        gained = [(b - a) / 0.1 for a, b in zip(before, body.velocity, strict=True)]
        assert gained == pytest.approx(wish, abs=1e-3)
        # Before the tilt stands the turn to the heading.
        nose = rotated(body.orientation, (1.0, 0.0, 0.0))
        assert math.remainder(math.atan2(nose[1], nose[0]) - yaw, 2 * math.pi) == pytest.approx(0.0, abs=0.06)


def test_rotors_stay_within_their_speeds_whatever_is_asked_for() -> None:
    rng = np.random.default_rng(4)
    airframe = Airframe()
    pilot = Autopilot(airframe, Controller(), 4.0)
    for _ in range(300):
        q = rng.normal(size=(2, 4))
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        body = Body(STILL, STILL, tuple(q[0].tolist()), tuple((10 * rng.normal(size=3)).tolist()))
        wanted = Attitude(tuple(q[1].tolist()), float(rng.uniform(0, 120)), float(rng.normal()))
        speeds = pilot.rotors(body, wanted)
        assert min(speeds) >= 0.0
        assert max(speeds) <= airframe.max_rotor_rad_s * (1 + 1e-12)
