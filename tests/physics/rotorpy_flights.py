"""Flies rotor commands with RotorPy: JSON of a flight on standard input, JSON of states on standard output.

A program of its own, for a Python that has RotorPy, which needs packages that CAVIAR does not
(`test_world_quadrotor_rotorpy`).
"""

from __future__ import annotations

import json
import sys

import numpy as np
from rotorpy.vehicles.multirotor import Multirotor


def main() -> None:
    """Read the flight, fly it, write a state for each command."""
    flight = json.load(sys.stdin)
    frame = flight["airframe"]
    side = frame["arm_m"] * np.sqrt(0.5)
    corners = {"fl": (side, side), "rl": (-side, side), "rr": (-side, -side), "fr": (side, -side)}
    jx, jy, jz = frame["inertia_kg_m2"]
    drag = [0.5 * flight["air_density"] * area for area in frame["drag_area_m2"]]
    vehicle = Multirotor(
        {
            "mass": frame["mass_kg"],
            "Ixx": jx,
            "Iyy": jy,
            "Izz": jz,
            **dict.fromkeys(("Ixy", "Ixz", "Iyz"), 0.0),
            **dict(zip(("c_Dx", "c_Dy", "c_Dz"), drag, strict=True)),
            "num_rotors": 4,
            "rotor_pos": {name: np.array([x, y, 0.0]) for name, (x, y) in corners.items()},
            "rotor_directions": np.array([1.0, -1.0, 1.0, -1.0]),
            "rotor_speed_min": 0.0,
            "rotor_speed_max": frame["max_rotor_rad_s"] * 1.001,
            "k_eta": frame["thrust_n_s2"],
            "k_m": frame["torque_n_m_s2"],
            "tau_m": frame["rotor_lag_s"],
            "motor_noise_std": 0.0,
        },
        integrator_kwargs={"method": "RK45", "rtol": 1e-8, "atol": 1e-10},
    )
    vehicle.weight = np.array([0.0, 0.0, -frame["mass_kg"] * flight["gravity"]])  # its own is 9.81
    w, x, y, z = flight["orientation"]
    state = {
        "x": np.array(flight["position"]),
        "v": np.array(flight["velocity"]),
        "q": np.array([x, y, z, w]),
        "w": np.array(flight["rates"]),
        "wind": np.array(flight["air"]),
        "rotor_speeds": np.array(flight["rotors"]),
    }
    found = []
    for command in flight["commands"]:
        state = vehicle.step(state, {"cmd_motor_speeds": np.array(command)}, flight["step"])
        x, y, z, w = state["q"].tolist()
        found.append([*state["x"].tolist(), *state["v"].tolist(), w, x, y, z, *state["w"].tolist()])
    json.dump(found, sys.stdout)


main()
