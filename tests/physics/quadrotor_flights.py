"""Flights of a quadrotor by its own controller, with the rotor commands on the way: for other simulators."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from caviar_protocol.space.coordinates import Vector, quaternion_from_euler
from caviar_services.world.quadrotor.airframe import Airframe, Body, Plant, Rotors
from caviar_services.world.quadrotor.control import Attitude, Autopilot, Controller

STEP = 0.002
# Without what only this model has, the drag of the rotors.
AIRFRAME = Airframe(linear_drag_n_s_m=(0.0, 0.0, 0.0), drag_area_m2=(0.03, 0.02, 0.05))
WIND: Vector = (2.0, -1.0, 0.5)


class Flight(NamedTuple):
    """What was flown."""

    start: Body
    rotors: Rotors
    commands: list[Rotors]
    """For each step."""
    states: np.ndarray
    """Position, velocity, quaternion, rates after each step, Shape ``[steps, 13]``."""


def hover() -> Flight:
    """Two seconds at constant rotor speeds in the wind, from a turned and turning start."""
    start = Body(
        (1.0, 2.0, 30.0), (0.5, 0.0, 0.0), quaternion_from_euler(0.7, 0.02, -0.03), (0.01, 0.02, 0.1)
    )
    rotors = (AIRFRAME.hover_speed,) * 4
    return _flown(start, rotors, [rotors] * 1000)


def step() -> Flight:
    """A step of attitude by 25° about two axes and 40° of heading, 2 s."""
    pilot = Autopilot(AIRFRAME, Controller(), 4.0)
    wanted = Attitude(quaternion_from_euler(0.7, 0.3, -0.3), 1.1 * AIRFRAME.mass_kg * 9.80665)
    return _controlled(Body((0.0, 0.0, 30.0)), 2.0, lambda body, t: pilot.rotors(body, wanted))


def figure_of_eight() -> Flight:
    """x = 8·sin(ωt), y = 3·sin(2ωt), climbing, with the acceleration fed forward, for a period of 8 s."""
    pilot = Autopilot(AIRFRAME, Controller(max_tilt_deg=60.0), 9.0)
    omega = 2 * math.pi / 8.0

    def commands(body: Body, t: float) -> Rotors:
        s, c, s2, c2 = (f(k * omega * t) for k in (1, 2) for f in (math.sin, math.cos))
        place = (8 * s, 3 * s2, 30 + 0.5 * t)
        speed = (8 * omega * c, 6 * omega * c2, 0.5)
        force = (-8 * omega**2 * s, -12 * omega**2 * s2, 0.0)
        wish = [
            a + 4.0 * (v - u) + 6.0 * (p - q)
            for a, v, u, p, q in zip(force, speed, body.velocity, place, body.position, strict=True)
        ]
        yaw = math.atan2(speed[1], speed[0])
        return pilot.rotors(body, pilot.attitude(body, (wish[0], wish[1], wish[2]), yaw, 0.0))

    start = Body((0.0, 0.0, 30.0), (8 * omega, 6 * omega, 0.5), quaternion_from_euler(math.atan2(3, 4)))
    return _controlled(start, 8.0, commands)


def _controlled(start: Body, seconds: float, commands) -> Flight:  # type: ignore[no-untyped-def]
    plant, body, rotors, given = Plant(AIRFRAME), start, (AIRFRAME.hover_speed,) * 4, []
    for k in range(round(seconds / STEP)):
        given.append(commands(body, k * STEP))
        body, rotors, _ = plant.advance(body, rotors, given[-1], WIND, STEP)
    return _flown(start, (AIRFRAME.hover_speed,) * 4, given)


def _flown(start: Body, rotors: Rotors, commands: list[Rotors]) -> Flight:
    plant, body, speeds, states = Plant(AIRFRAME), start, rotors, []
    for command in commands:
        body, speeds, _ = plant.advance(body, speeds, command, WIND, STEP)
        states.append([*body.position, *body.velocity, *body.orientation, *body.rates])
    return Flight(start, rotors, commands, np.array(states))
