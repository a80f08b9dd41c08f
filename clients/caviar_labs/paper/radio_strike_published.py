"""The run that was published with Radio-Strike, and the first version of its simulator, which made it.

The data are 7,399 rows of an oracle that schedules the users in turn. They do not come from the simulator of
the challenge (`caviar_labs.radio_strike`, ``rules="legacy"``) but from the first version of its code,
with

* 64 antennas in a row along x instead of 8×8, steering vectors of norm 1 and the same codebook;
* the base station at [−15, 30, −1] m instead of the origin of the positions;
* 90 + 25 dB instead of 99 + 25, and 10^(dB/20) as the amplitude of a ray;
* Poisson traffic of 10 Mbit a slot for each user, never dense; R/65,504 packets a slot, as if it lasted 1 s;
* 0.4·R [Gbit/s] as reward.

Path gain, spread, phases and the law of the bit rate are those of ``legacy``. What is random cannot be made
again: the run had no seed.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caviar_labs.radio_strike.rules import (
    BEAMS,
    LEGACY,
    MAX_AGE,
    PACKET_BITS,
    RAYS,
    SPREAD_DEG,
    USERS,
    WAVELENGTH_M,
)
from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_protocol.cell.buffers import PacketBuffers
from caviar_protocol.errors import ScenarioError

BASE_STATION_M = (-15.0, 30.0, -1.0)
GAIN_DB = 90.0 + 25.0
TRAFFIC_BITS = 10e6
"""Of each user in a slot."""
SCORE = 0.4
"""Reward over the bit rate in Gbit/s."""

_COLUMNS = (
    "ue_number", "beam_index", "x", "y", "z", "dropped_packets", "sent_packets", "bit_rate", "channel_mag",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Run:
    """Steps of a run, Shape ``[N]`` each."""

    user: Int64Array
    beam: Int64Array
    magnitude: Float64Array
    """|y|."""
    bit_rate: Float64Array
    """[Gbit/s]."""
    sent: Float64Array
    """Packets."""
    dropped: Float64Array

    @property
    def score(self) -> float:
        """Return of the run, by its own reward."""
        return SCORE * float(self.bit_rate.sum())


@dataclass(frozen=True, eq=False)
class PublishedRun(Run):
    """The run of a file, with the positions of the users."""

    position: Float64Array
    """North, east, down [m], Shape ``[N, 3]``."""

    def rate_error(self) -> float:
        """Greatest relative deviation of a bit rate from 10^8·log2(1 + 440.35·|y|²)."""
        law = LEGACY.bit_rate(self.magnitude) / 1e9
        return float(np.abs(law / self.bit_rate - 1).max())


def read_run(file: Path) -> PublishedRun:
    """Read the published run.

    Args:
        file: ``data_output_optimun_traffic.csv`` of the challenge's code.

    Raises:
        ScenarioError: The file cannot be read, lacks a column, or a value is no number; names file and line.
    """
    values = []
    try:
        with file.open(newline="", encoding="utf-8") as text:
            reader = csv.DictReader(text)
            missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                raise ScenarioError(
                    f"has no column {', '.join(missing)}; name data_output_optimun_traffic.csv of the "
                    "challenge",
                    str(file),
                    line=1,
                )
            for row in reader:
                values.append(_numbers(file, reader.line_num, [row[name] for name in _COLUMNS]))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise ScenarioError(f"cannot be read: {why}; name the file of a run", str(file)) from error
    if not values:
        raise ScenarioError("has no row; name data_output_optimun_traffic.csv of the challenge", str(file))
    columns = np.array(values).T
    user, beam = columns[:2].astype(np.int64)
    if not ((user >= 0) & (user < len(USERS))).all():
        line = int(np.argmin((user >= 0) & (user < len(USERS)))) + 2
        raise ScenarioError(f"ue_number is not one of 0 to {len(USERS) - 1}", str(file), line=line)
    _, _, x, y, z, dropped, sent, rate, magnitude = columns
    return PublishedRun(user, beam, magnitude, rate, sent, dropped, np.stack([x, y, z], axis=1))


def _numbers(file: Path, line: int, cells: list[str | None]) -> list[float]:
    found = []
    for name, cell in zip(_COLUMNS, cells, strict=True):
        try:
            value = float(cell or "")
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            text = "the file breaks off: copy it again" if cell is None else f"{name} is {cell!r}, no number"
            raise ScenarioError(text, str(file), line=line)
        found.append(value)
    return found


def made_again(published: PublishedRun, seed: int) -> Run:
    """Play the published run with other random numbers: the same users in the same places, in each step the
    best of all beams.

    Args:
        published: The run.
        seed: Of the random numbers.
    """
    random, count = np.random.default_rng(seed), len(published.user)
    x, y, z = (published.position - BASE_STATION_M).T
    distance = np.sqrt(x**2 + y**2 + z**2)
    gain = np.abs(random.standard_normal((count, RAYS))) + np.abs(random.standard_normal((count, RAYS)))
    level = 20 * np.log10(WAVELENGTH_M / (4 * np.pi * distance) ** 2) + GAIN_DB
    amplitude = 10 ** ((level[:, None] + gain) / 20)
    azimuth = np.arctan2(y, x)[:, None] + np.deg2rad(SPREAD_DEG * random.standard_normal((count, RAYS)))
    antennas = np.arange(BEAMS)
    steering = np.exp(1j * np.pi * np.cos(azimuth)[:, :, None] * antennas) / np.sqrt(BEAMS)
    h = (amplitude[:, :, None] * steering).sum(1)
    codebook = np.exp(-2j * np.pi * np.outer(antennas, antennas) / BEAMS)
    abs_y = np.abs(h @ codebook)
    beam = abs_y.argmax(1)
    magnitude = abs_y.max(1)
    rate = LEGACY.bit_rate(magnitude)
    sent, dropped = _packets(published.user, LEGACY.packets(rate), random)
    return Run(published.user, beam, magnitude, rate / 1e9, sent, dropped)


def _packets(
    users: Int64Array, capacity: Float64Array, random: np.random.Generator
) -> tuple[Float64Array, Float64Array]:
    """Packets that are sent and dropped in each step."""
    count = len(USERS)
    # One packet is one bit here: capacities are whole packets.
    buffers = PacketBuffers(np.ones(count, np.int64), np.full(count, MAX_AGE))
    arrivals = random.poisson(TRAFFIC_BITS / PACKET_BITS, (len(users), count))
    sent, dropped = np.zeros((2, len(users)))
    before = 0
    room = np.zeros(count, np.int64)
    for step, (user, packets) in enumerate(zip(users.tolist(), capacity.tolist(), strict=True)):
        buffers.begin_slot(arrivals[step])
        room[user] = int(packets)
        sent[step] = buffers.serve(room).sum()
        room[user] = 0
        total = int(buffers.totals.dropped.sum())
        dropped[step], before = total - before, total
    return sent, dropped
