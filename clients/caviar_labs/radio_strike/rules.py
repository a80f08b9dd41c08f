"""Rules of Radio-Strike: what distinguishes ``legacy`` from ``fixed``, and the formulas of both.

Radio-Strike is the environment of problem statement PS-006 of the ITU AI/ML in 5G Challenge 2021 (LASSE,
UFPA). A base station with 8×8 antennas at 60 GHz serves one of three users in each slot with one of 64 beams.

Each user's channel is two rays that depart within a degree of the straight line and are drawn anew in each
slot. With their amplitudes a_l, phases φ_l, zenith θ_l from the array's normal and azimuth ϕ_l,

    y = Σ_l a_l · exp(jφ_l) · Σ_{n,m = 0}^{7} exp(j(n·α_l + m·β_l)),
    α_l = π·sin θ_l·cos ϕ_l − 2π·p_k,    β_l = π·sin θ_l·sin ϕ_l − 2π·q_k

with turns p_k and q_k by which beam k advances from one antenna to the next. The bit rate is
R = B·log2(1 + ρ·|y|²).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, get_args

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.cell.link_adaptation import shannon
from caviar_protocol.errors import ScenarioError, suggestion
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT

RulesName = Literal["legacy", "fixed"]

USERS: Final = ("uav1", "simulation_car1", "simulation_pedestrian1")
"""Names of the users in the episode files, in the order of the action."""
BEAMS: Final = 64
SIDE: Final = 8
"""Antennas along each side of the array."""
RAYS: Final = 2
WAVELENGTH_M: Final = SPEED_OF_LIGHT / 60e9
BANDWIDTH_HZ: Final = 100e6
SPREAD_DEG: Final = 1.0
"""Standard deviation of a ray's azimuth and zenith around the straight line."""

PACKET_BITS: Final = 65_504
MAX_AGE: Final = 10
"""Slots in which a packet can be sent; then it is dropped. What ten slots bring is far from the 1e9 packets
that the buffers of the original hold, so that these never overflow."""
TOGGLE_STEPS: Final = 1000
"""Traffic is dense for so many steps, then light for as many, and so on."""
LIGHT, DENSE = 480e6, 960e6
"""[bit], of all users: in a slot with ``legacy``, in a second with ``fixed``."""
SHARES: Final = (0.5, 0.3, 0.2)
"""Share of each user in the traffic."""
LEGACY_STEPS: Final = 20
"""Steps after which ``legacy`` says that an episode has terminated."""

_POWER_DBM, _TEMPERATURE_K, _BOLTZMANN = 30.0, 290.0, 1.380649e-23


@dataclass(frozen=True, eq=False)
class Rules:
    """What distinguishes the variants of the environment."""

    name: RulesName
    all_move: bool
    """Whether all users go on along their trajectories, or only the scheduled one."""
    resets: bool
    """Whether a reset without a seed begins an episode, and an episode ends with its trajectory."""
    slot_s: float
    """Length of a slot, as far as packets are concerned [s]."""
    means: tuple[tuple[float, ...], tuple[float, ...]]
    """Packets of each user in a slot on average, in dense and in light traffic."""
    random_phases: bool
    """Whether the rays have phases; without, both have 0."""
    advance: Float64Array
    """Phase by which each beam advances from antenna to antenna, along x and along y [rad], Shape
    ``[2, 64]``."""
    element: float
    """Weight of an antenna: its magnitude in the entries of the codebook."""
    decade_db: float
    """Decibels of the path gain that make the amplitude ten times as large: 20 where it is an amplitude."""
    snr_scale: float
    """ρ: SNR over |y|²."""

    def levels(self, distance_m: Float64Array) -> Float64Array:
        """Path gain before the drawn part of it.

        Args:
            distance_m: From the base station [m], any shape.

        Returns:
            [dB], of the same shape.

        Example:
            >>> FIXED.levels(np.array([40.0])).round(2).tolist()  # free space: 20·log10(λ/4πd)
            [-100.05]
        """
        way = 4 * np.pi * distance_m
        if self.name == "legacy":
            # λ over the square, and not the square of λ over 4πd: so the original computes it.
            legacy: Float64Array = 20 * np.log10(WAVELENGTH_M / way**2) + 99.0 + 25.0
            return legacy
        level: Float64Array = 20 * np.log10(WAVELENGTH_M / way)
        return level

    def bit_rate(self, magnitude: Float64Array) -> Float64Array:
        """Bit rate R = B·log2(1 + ρ·|y|²).

        Args:
            magnitude: |y|, any shape.

        Returns:
            [bit/s], of the same shape.

        Example:
            >>> LEGACY.bit_rate(np.array([0.0695041436601549])).tolist()  # a row of a published run
            [164489650.45894945]
        """
        # Squared as a product: a power of an array may be rounded otherwise than that of its parts.
        rate: Float64Array = BANDWIDTH_HZ * shannon(self.snr_scale * (magnitude * magnitude))
        return rate

    def packets(self, bit_rate: Float64Array) -> Float64Array:
        """Whole packets that a slot carries.

        Args:
            bit_rate: [bit/s], any shape.

        Example:
            >>> LEGACY.packets(np.array([1e9])).tolist(), FIXED.packets(np.array([1e9])).tolist()
            ([15266.0], [152.0])
        """
        packets: Float64Array = np.floor(bit_rate * self.slot_s / PACKET_BITS)
        return packets


def rules_of(name: str) -> Rules:
    """Look up rules.

    Args:
        name: ``legacy`` or ``fixed``.

    Raises:
        ScenarioError: There are no such rules.

    Example:
        >>> rules_of("legcy")
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.ScenarioError: rules='legcy'; did you mean 'legacy'?
    """
    for rules in (LEGACY, FIXED):
        if rules.name == name:
            return rules
    known = get_args(RulesName)
    hint = suggestion(name, known) if isinstance(name, str) else f"write one of {', '.join(known)}"
    raise ScenarioError(f"rules={name!r}; {hint}")


def _means(bits: float) -> tuple[float, ...]:
    return tuple(share * bits / PACKET_BITS for share in SHARES)


def _row_beams() -> Float64Array:
    """A DFT over 64 antennas in a row, laid over 8 rows of 8: along y a beam advances 8 times as far."""
    along = 2 * np.pi * np.arange(BEAMS) / BEAMS
    return np.array([along, SIDE * along])


def _plane_beams() -> Float64Array:
    """The Kronecker product of a DFT along x and one along y; beam ``8·kx + ky``."""
    x, y = np.divmod(np.arange(BEAMS), SIDE)
    # Towards −y, as the rows of a device that looks down and whose y axis is north (`device` of a scenario).
    return 2 * np.pi * np.array([x, -y]) / SIDE


LEGACY: Final = Rules(
    name="legacy",
    all_move=False,
    resets=False,
    slot_s=1.0,
    means=(_means(DENSE), _means(LIGHT)),
    random_phases=False,
    advance=_row_beams(),
    element=1.0,
    decade_db=10.0,
    snr_scale=440.35,
)
"""The original, bug for bug."""

FIXED: Final = Rules(
    name="fixed",
    all_move=True,
    resets=True,
    slot_s=0.01,
    means=(_means(0.01 * DENSE), _means(0.01 * LIGHT)),
    random_phases=True,
    advance=_plane_beams(),
    element=1 / SIDE,
    decade_db=20.0,
    snr_scale=10 ** (_POWER_DBM / 10 - 3) / (_BOLTZMANN * _TEMPERATURE_K * BANDWIDTH_HZ),
)
"""The original without its defects. The 99 + 25 dB that it adds to the path gain are what 30 dBm have over
the thermal noise of 100 MHz at 290 K, 123.98 dB: that is ρ here, and noise is counted once."""


class Rays(NamedTuple):
    """Rays of K users, Shape ``[K, 2]`` each."""

    gain_db: Float64Array
    """Drawn part of the path gain."""
    azimuth_deg: Float64Array
    """Deviation from the straight line."""
    zenith_deg: Float64Array
    phase: Float64Array
    """[rad]; without meaning where rays have no phases."""


def magnitudes(
    rules: Rules,
    azimuth_deg: Float64Array,
    zenith_deg: Float64Array,
    level_db: Float64Array,
    rays: Rays,
    beams: Int64Array,
) -> Float64Array:
    """Work out |y| of beams.

    Args:
        rules: Of the environment.
        azimuth_deg: Of each user's straight line, from x to y, Shape ``[K]``.
        zenith_deg: From the z axis, Shape ``[K]``.
        level_db: `Rules.levels`, Shape ``[K]``.
        rays: Of each user.
        beams: B beams of each user, or the same of all: Shape ``[K, B]`` or ``[1, B]``.

    Returns:
        Shape ``[K, B]``. Each row depends on its own user alone, to the last bit: all operations are
        element by element, without a sum whose order follows from the number of users.

    Example:
        >>> still = Rays(*np.zeros((4, 1, 2)))
        >>> below, every = np.zeros(1), np.arange(64)[None]
        >>> abs_y = magnitudes(FIXED, below, below, below, still, every)  # two rays of amplitude 1 along z
        >>> int(abs_y.argmax()), round(float(abs_y.max()), 6)
        (0, 16.0)
    """
    azimuth = np.deg2rad(azimuth_deg[:, None] + rays.azimuth_deg)
    zenith = np.deg2rad(zenith_deg[:, None] + rays.zenith_deg)
    sine = np.pi * np.sin(zenith)
    advance = rules.advance[:, beams]
    angles = np.empty((2, len(azimuth), RAYS, beams.shape[1]))
    np.subtract((sine * np.cos(azimuth))[:, :, None], advance[0, :, None], out=angles[0])
    np.subtract((sine * np.sin(azimuth))[:, :, None], advance[1, :, None], out=angles[1])
    # Σ_{n=0}^{7} exp(jnα) = exp(3.5jα) · 8·cos(α/2)·cos(α)·cos(2α), by halving the sum three times.
    half = np.cos(0.5 * angles)
    whole = 2 * (half * half) - 1
    along = half * whole * (2 * (whole * whole) - 1)
    response = (SIDE * SIDE * rules.element) * (along[0] * along[1])
    amplitude = np.power(10.0, (level_db[:, None] + rays.gain_db) / rules.decade_db)
    weight = amplitude[:, :, None] * response
    # With random phases those of the centre of the array can be left out.
    phase = rays.phase[:, :, None] if rules.random_phases else 3.5 * (angles[0] + angles[1])
    real, imaginary = weight * np.cos(phase), weight * np.sin(phase)
    real, imaginary = real[:, 0] + real[:, 1], imaginary[:, 0] + imaginary[:, 1]
    magnitude: Float64Array = np.sqrt(real * real + imaginary * imaginary)
    return magnitude


def straight_lines(position: Float64Array, rules: Rules) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Directions and path gains of the straight lines from the base station.

    Args:
        position: North, east, down of the base station [m], Shape ``[..., 3]``.
        rules: Of the environment.

    Returns:
        Azimuth 0…360 [°], zenith angle from the z axis, which points down, [°] and path gain [dB], Shape
        ``[...]`` each.

    Example:
        >>> azimuth, zenith, level = straight_lines(np.array([30.0, 40.0, 0.0]), FIXED)
        >>> float(azimuth.round(2)), float(zenith), float(level.round(2))
        (53.13, 90.0, -101.99)
    """
    x, y, z = np.moveaxis(position, -1, 0)
    distance = np.sqrt(x * x + y * y + z * z)
    if rules.name == "legacy":
        x = np.where(x == 0, 0.001, x)
    azimuth = np.rad2deg(np.arctan2(y, x))
    azimuth = np.where(azimuth < 0, azimuth + 360, azimuth)
    zenith = np.rad2deg(np.arccos(np.clip(z / np.sqrt(x * x + y * y + z * z), -1.0, 1.0)))
    return azimuth, zenith, rules.levels(distance)
