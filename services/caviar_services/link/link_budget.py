"""Link budget: transmit power over thermal noise, of which the SNR of a beam pair follows.

The SNR of a user is transmit power · |y|² / (k·T·B·F), with |y| of its beam pair (`beam_sweep`). What it
carries follows from the SNR: `caviar_protocol.cell.link_adaptation`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.topics import Carrier, Scene
from caviar_protocol.topics.scene import Device
from caviar_services.link.base import User, Users, users_of

BOLTZMANN = 1.380649e-23
"""[J/K], exact (SI)."""

MAX_POWER_DBM = 200.0
"""A transmit power beyond this, either way, is a mistake of units and would overflow the SNR."""


def noise_power(carrier: Carrier, noise_figure_db: float, temperature_k: float) -> float:
    """Thermal noise k·T·B·F [W] in the carrier's bandwidth (Recommendation ITU-R P.372, noise factor).

    Args:
        carrier: The carrier, with its bandwidth.
        noise_figure_db: Noise figure of the receiver [dB].
        temperature_k: Temperature of the thermal noise [K].

    Example:
        >>> carrier = Carrier(name="mmwave", frequency_hz=28e9, bandwidth_hz=100e6)
        >>> f"{noise_power(carrier, 9.0, 290.0):.2e}"  # [W], −85 dBm
        '3.18e-12'
    """
    return BOLTZMANN * temperature_k * carrier.bandwidth_hz * 10 ** (noise_figure_db / 10)


def transmit_power(user: User) -> float:
    """Transmit power [W] of a user's transmitter.

    Args:
        user: The user.

    Raises:
        PayloadError: The power is beyond ±`MAX_POWER_DBM`; names the device.

    Example:
        >>> from caviar_services.testing.samples import CARRIERS, scene
        >>> transmit_power(users_of(scene(0), CARRIERS)[0])  # of 30 dBm
        1.0
    """
    if not abs(user.tx.power_dbm) <= MAX_POWER_DBM:
        raise PayloadError(
            f"device {user.tx.name!r} transmits {user.tx.power_dbm} dBm; "
            f"power_dbm must lie within ±{MAX_POWER_DBM:g}"
        )
    return 10 ** ((user.tx.power_dbm - 30) / 10)


@dataclass(frozen=True, eq=False)
class LinkBudget:
    """Power, noise and bandwidth of U users, which stay the same while the same devices are there.

    Example:
        >>> from caviar_services.testing.samples import CARRIERS, scene
        >>> budget = LinkBudget.for_scene(scene(0), CARRIERS, 9.0, 290.0)
        >>> budget.rx, f"{10 * np.log10(budget.power_over_noise[0]):.1f} dB"
        (('car.1/rx', 'truck.2/rx'), '115.0 dB')
    """

    devices: tuple[Device, ...]
    carriers: tuple[Carrier, ...]
    users: Users
    tx: tuple[str, ...]
    """Name of each user's transmitter; ``rx`` and ``carrier`` likewise."""
    rx: tuple[str, ...]
    carrier: tuple[str, ...]
    bandwidth: Float64Array
    """[Hz], Shape ``[U]``."""
    power_over_noise: Float64Array
    """Transmit power over noise power, Shape ``[U]``: the SNR of a beam pair is this times its |y|²."""
    receive_beams: Int64Array
    """Beams of the receivers, Shape ``[U]``."""

    @classmethod
    def for_scene(
        cls, scene: Scene, carriers: tuple[Carrier, ...], noise_figure_db: float, temperature_k: float
    ) -> LinkBudget:
        """Compute the link budget of each user of a scene.

        Args:
            scene: Has the devices.
            carriers: C carriers.
            noise_figure_db: Noise figure of the receivers [dB].
            temperature_k: Temperature of the thermal noise [K].

        Raises:
            PayloadError: A transmit power is beyond ±`MAX_POWER_DBM`.
        """
        users = users_of(scene, carriers)
        noise = np.array([noise_power(user.carrier, noise_figure_db, temperature_k) for user in users])
        return cls(
            devices=scene.devices,
            carriers=carriers,
            users=users,
            tx=tuple(user.tx.name for user in users),
            rx=tuple(user.rx.name for user in users),
            carrier=tuple(user.carrier.name for user in users),
            bandwidth=np.array([user.carrier.bandwidth_hz for user in users], dtype=np.float64),
            power_over_noise=np.array([transmit_power(user) for user in users]) / noise,
            receive_beams=np.array([user.beams[1] for user in users], np.int64),
        )
