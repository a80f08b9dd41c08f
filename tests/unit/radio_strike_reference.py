"""Radio-Strike once more, in plain Python: number by number, without a line of the environment's code.

`Legacy` follows the rules of the original as its code states them, `Fixed` those of the documentation. Each
has buffers as lists of packets, channels as sums over 64 antennas, and one object for a game.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

WAVELENGTH = 299_792_458 / 60e9
SHARES = (0.5, 0.3, 0.2)


class Game:
    """What both have in common.

    Args:
        ways: Positions of each user in each step, north, east, down [m]: ``ways[user][step]``.
    """

    slot_s: float

    def __init__(self, ways: Sequence[Sequence[Sequence[float]]]) -> None:
        self.ways = ways
        self.buffers = [[0.0] * 10 for _ in range(3)]
        self.steps = 0

    def slot(
        self, user: int, arrivals: Sequence[float], rate: float
    ) -> tuple[float, float, float, float, float]:
        """Reward; packets dropped, sent and buffered before; all packets."""
        before = sum(map(sum, self.buffers))
        dropped = 0.0
        for buffer, arrived in zip(self.buffers, arrivals, strict=True):
            dropped += buffer.pop()
            buffer.insert(0, arrived)
        room = math.floor(rate * self.slot_s / 65_504)
        sent = 0
        for age in range(9, -1, -1):
            out = min(room - sent, self.buffers[user][age])
            self.buffers[user][age] -= out
            sent += out
        offered = sum(arrivals) + before
        self.steps += 1
        return (sent - 2 * dropped) / offered, dropped, sent, before, offered

    @property
    def load(self) -> float:
        """Bits of a slot: dense for 1000 steps, light for the next."""
        return 960e6 if (self.steps // 1000) % 2 == 0 else 480e6


class Legacy(Game):
    """The original after ``numpy.random.seed(seed)``."""

    slot_s = 1.0

    def __init__(self, ways: Sequence[Sequence[Sequence[float]]], seed: int) -> None:
        super().__init__(ways)
        self.random = np.random.RandomState(seed)
        self.at = [0, 0, 0]

    def arrivals(self, user: int) -> float:
        return float(self.random.poisson(SHARES[user] * self.load / 65_504))

    def play(self, user: int, beam: int | None) -> dict[str, Any]:
        """One step; without a beam with the best one."""
        packets = {user: self.arrivals(user)}
        x, y, z = self.ways[user][self.at[user]]
        self.at[user] += 1
        draws = [[float(self.random.randn()) for _ in range(2)] for _ in range(6)]
        rays = []
        distance = math.sqrt(x**2 + y**2 + z**2)
        x = 0.001 if x == 0 else x
        azimuth = math.degrees(math.atan2(y, x)) % 360
        zenith = math.degrees(math.acos(z / math.sqrt(x**2 + y**2 + z**2)))
        for ray in range(2):
            gain = abs(draws[0][ray]) + abs(draws[1][ray]) + 25
            level = 20 * math.log10(WAVELENGTH / (4 * math.pi * distance) ** 2) + 99 + gain
            angles = math.radians(azimuth + draws[2][ray]), math.radians(zenith + draws[3][ray])
            rays.append((10 ** (level / 10), *angles))
        tried = range(64) if beam is None else (beam,)
        found = {k: abs(sum(map(lambda ray, k=k: self.ray(k, *ray), rays))) for k in tried}  # type: ignore[misc]
        best = max(found, key=lambda k: found[k])
        rate = 100e6 * math.log2(1 + 440.35 * found[best] ** 2)
        for other in range(3):
            if other != user:
                packets[other] = self.arrivals(other)
        reward, *counts = self.slot(user, [packets[u] for u in range(3)], rate)
        position = self.ways[user][self.at[user] - 1]
        return {
            "observation": [*position, *counts[:3], rate],
            "reward": reward,
            "packets": counts[3],
            "channel_mag": found[best],
            "best_beam": best,
            "terminated": self.steps >= 20,
        }

    @staticmethod
    def ray(beam: int, amplitude: float, azimuth: float, zenith: float) -> complex:
        """A ray through the array: antenna (m, n) is number 8n + m of a DFT of length 64 without 1/√64."""
        x = math.pi * math.sin(zenith) * math.cos(azimuth)
        y = math.pi * math.sin(zenith) * math.sin(azimuth)
        return amplitude * sum(
            cmath.exp(1j * (m * x + n * y - 2 * math.pi * beam * (8 * n + m) / 64))
            for n in range(8)
            for m in range(8)
        )


class Fixed(Game):
    """The documented rules, with the numbers that are given to it."""

    slot_s = 0.01
    power_over_noise = 10 ** (30.0 / 10 - 3) / (1.380649e-23 * 290.0 * 100e6)

    def play(
        self,
        user: int,
        beam: int,
        arrivals: Sequence[float],
        gains: Sequence[float],
        turns: Sequence[Sequence[float]],
        phases: Sequence[float],
    ) -> dict[str, Any]:
        """One step with these packets, and rays of these gains [dB], turns [°] and phases [rad]."""
        x, y, z = self.ways[user][self.steps]
        distance = math.sqrt(x**2 + y**2 + z**2)
        total = 0j
        for gain, (azimuth, zenith), phase in zip(gains, turns, phases, strict=True):
            east_of_north = math.atan2(y, x) + math.radians(azimuth)
            from_below = math.acos(z / distance) + math.radians(zenith)
            north = math.sin(from_below) * math.cos(east_of_north)
            east = math.sin(from_below) * math.sin(east_of_north)
            amplitude = WAVELENGTH / (4 * math.pi * distance) * 10 ** (gain / 20)
            along, across = divmod(beam, 8)
            response = sum(
                cmath.exp(
                    # The antennas lie half a wavelength apart around the base station.
                    1j * math.pi * ((m - 3.5) * north + (n - 3.5) * east)
                    - 2j * math.pi * (along * m - across * n) / 8
                )
                for m in range(8)
                for n in range(8)
            )
            total += amplitude * cmath.exp(1j * phase) * response / 8
        rate = 100e6 * math.log2(1 + self.power_over_noise * abs(total) ** 2)
        reward, *counts = self.slot(user, arrivals, rate)
        return {"observation": [x, y, z, *counts[:3], rate], "reward": reward, "channel_mag": abs(total)}

    @property
    def load(self) -> float:
        """Bits of a slot of 10 ms."""
        return 0.01 * super().load
