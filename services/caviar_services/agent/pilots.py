"""Base of agents that measure beam pairs with pilots: the measurements, and the air time that they take.

A *pilot* is one beam pair of a transmitter and its receivers, tried once. The transmitters of a carrier send
their pilots one after the other, since they would disturb each other; carriers sound at the same time. All
receivers of a transmitter listen to the same pilot, each with a beam of its own. So a frame has as many
pilots as the carrier with the most of them, they last ``pilot_us`` each, and data have what is left of it: of
a frame of length T_sam, n pilots of length τ leave the share 1 − n·τ/T_sam of each rate (`share_left`).
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple, TypeVar

import msgspec
import numpy as np
from msgspec.structs import replace

from caviar_protocol.arrays import Complex128Array, Float64Array, quantity
from caviar_protocol.messages import Input
from caviar_protocol.space.beams import beam_gains
from caviar_protocol.space.scene import Pair
from caviar_protocol.topics import BeamChoice, Scene
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.link.base import User, Users, channels_of, require_channel
from caviar_services.link.link_budget import BOLTZMANN, transmit_power
from caviar_services.service import Frame, StepResult

PILOTS = "pilots"
"""Count of the pilots that a frame lasts for."""
PILOT_TIME = "pilot-time-ns"
"""Count of the air time [ns] that they take."""
TEMPERATURE_K = 290.0
"""[K] of the thermal noise in measurements."""


class PilotSettings(AgentSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of agents that measure beam pairs."""

    pilot_us: Annotated[float, quantity("µs", "air time of one pilot", gt=0, le=1e6)] = 8.93
    """The default is an OFDM symbol at 120 kHz: 14 of them are a slot of 125 µs (3GPP TS 38.211)."""
    noise_figure_db: Annotated[float, quantity("dB", "of the receivers", ge=0, le=60)] | None = None
    """With it measurements have thermal noise; absent: they are exact."""


P = TypeVar("P", bound=PilotSettings)
CHANNEL = Input(topic="channel", parts=("h",))
"""The channel of the frame itself: pilots are sent at its beginning. An agent looks at the pairs alone that
it counts pilots for."""


def share_left(pilots: int, pilot_us: float, sampling_period_ns: int) -> float:
    """The share of a frame that its pilots leave to data, and so of each rate.

    Args:
        pilots: Pilots of the frame.
        pilot_us: Air time of one [µs].
        sampling_period_ns: Length of the frame [ns].

    Example:
        >>> share_left(64, 8.93, 20_000_000)  # all beams of an array of 64 elements in a frame of 20 ms
        0.971424
    """
    return max(0.0, 1.0 - pilots * pilot_us * 1e3 / sampling_period_ns)


class Measured(NamedTuple):
    """The pair that an agent takes for a user."""

    user: int
    tx_beam: int
    rx_beam: int


@dataclass(frozen=True)
class Sounding:
    """The users of a frame with their channels, of which an agent learns through pilots alone."""

    frame: Frame
    scene: Scene
    users: Users
    """All carriers of the pairs that the agent serves."""
    h: tuple[Complex128Array | None, ...]
    """H of each user, Shape ``[Nr, Nt]``; None without a path."""
    noise_energy: float
    """Of the estimate of |y|² [W·s], kTF; 0: measurements are exact."""
    pilot_s: float
    """Air time of a pilot [s]."""
    sent: dict[tuple[str, str], int]
    """Pilots of the frame by carrier and transmitter."""
    events: dict[str, int]
    """Further counts of the frame by name."""

    def note(self, event: str) -> None:
        """Count an event of the frame."""
        self.events[event] = self.events.get(event, 0) + 1

    def count(self, user: User, pilots: int) -> None:
        """Count pilots that a user's transmitter sends for this user alone."""
        self.sent[user.carrier.name, user.tx.name] += pilots

    def count_shared(self, users: Iterable[tuple[User, int]]) -> None:
        """Count pilots that all users of a transmitter listen to: as many as the one that needs most.

        Args:
            users: Each user, and the pilots that it needs.
        """
        most: dict[tuple[str, str], int] = {}
        for user, pilots in users:
            key = user.carrier.name, user.tx.name
            most[key] = max(most.get(key, 0), pilots)
        for key, pilots in most.items():
            self.sent[key] += pilots

    def measured(self, user: User, abs_y: Float64Array, stage: str = "") -> Float64Array:
        """Measure pairs: their |y|, with the noise of a pilot.

        The matched filter of a pilot of power P and length τ estimates y with a circularly symmetric error
        of variance k·T·F/(P·τ), whatever its bandwidth; so the phase of y is of no consequence.

        Args:
            user: The user.
            abs_y: |y| of the pairs that pilots are sent for, of any shape.
            stage: Tells several measurements of a user in one frame apart.
        """
        if not self.noise_energy:
            return abs_y
        variance = self.noise_energy / (transmit_power(user) * self.pilot_s)
        # A stream of its own for each user: who else is there does not move its noise.
        generator = self.frame.generator(f"pilots/{stage}/{user.carrier.name}/{user.tx.name}/{user.rx.name}")
        real, imaginary = generator.standard_normal((2, *abs_y.shape)) * np.sqrt(variance / 2)
        noisy: Float64Array = np.abs(abs_y + real + 1j * imaginary)
        return noisy

    def error_of(self, user: User) -> float:
        """Standard deviation of a measured |y| that is well above it; 0: measurements are exact."""
        return math.sqrt(self.noise_energy / (transmit_power(user) * self.pilot_s) / 2)

    def measure(self, index: int, pairs: Sequence[tuple[int, int]]) -> Float64Array | None:
        """Send a pilot for each of some pairs of a user.

        Args:
            index: The user.
            pairs: TX and RX beam of each.

        Returns:
            |y| of each pair as measured; None for a user without a path.
        """
        user, matrix = self.users[index], self.h[index]
        self.count(user, len(pairs))
        if matrix is None or not pairs:
            return None
        tx_beams, rx_beams = zip(*pairs, strict=True)
        gains = beam_gains(matrix, user.tx.array, user.rx.array)
        return self.measured(user, gains[list(tx_beams), list(rx_beams)])

    def best_of(self, index: int, pairs: Sequence[tuple[int, int]]) -> Measured | None:
        """Try some pairs of a user, and count their pilots; one pair alone is taken untried.

        Args:
            index: The user.
            pairs: TX and RX beam of each.

        Returns:
            The best pair as measured, of equal ones the first; None for a user without a path.
        """
        if len(pairs) > 1:
            abs_y = self.measure(index, pairs)
            return None if abs_y is None else Measured(index, *pairs[int(abs_y.argmax())])
        return None if self.h[index] is None or not pairs else Measured(index, *pairs[0])

    @property
    def pilots(self) -> int:
        """Pilots that the frame lasts for: those of the carrier with the most."""
        carriers: dict[str, int] = defaultdict(int)
        for (carrier, _), count in self.sent.items():
            carriers[carrier] += count
        return max(carriers.values(), default=0)


class PilotAgent(Agent[P]):
    """Base of agents that measure beam pairs. Their pilots and air time are counts of every frame.

    Subclasses implement `select`.

    Args:
        settings: Users, and what a pilot is.
        run: What the agent knows about the run.

    Example:
        >>> from caviar_services.service import RunInfo
        >>> from caviar_services.testing.samples import CARRIERS, granted
        >>> class FirstPair(PilotAgent[PilotSettings]):
        ...     def select(self, sounding):
        ...         for index, user in enumerate(sounding.users):
        ...             sounding.count(user, 1)
        ...             yield Measured(index, 0, 0)
        >>> agent = FirstPair(PilotSettings(pilot_us=10.0), RunInfo(name="agent", carriers=CARRIERS))
        >>> agent.step(granted(agent.inputs, 0, "agent")).counts  # two users
        {'pilots': 2, 'pilot-time-ns': 20000}
    """

    Settings: ClassVar[type[msgspec.Struct]] = PilotSettings
    inputs: ClassVar[tuple[Input, ...]] = (*Agent.inputs, CHANNEL)
    _sounding: Sounding | None = None

    def step(self, frame: Frame) -> StepResult:
        """The choices, with the pilots that they took."""
        self._sounding = None
        made = super().step(frame)
        sounding = self._sounding
        if sounding is None:
            return made
        pilots = sounding.pilots
        air_time = {PILOTS: pilots, PILOT_TIME: round(pilots * self.settings.pilot_us * 1e3)}
        return replace(made, counts={**made.counts, **sounding.events, **air_time})

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """The pair that `select` takes for each user."""
        channel = require_channel(frame)
        users = Users(User(pair.tx, pair.rx, carrier) for carrier in channel.carriers for pair in pairs)
        figure = self.settings.noise_figure_db
        self._sounding = sounding = Sounding(
            frame=frame,
            scene=scene,
            users=users,
            h=channels_of(channel, users).h,
            noise_energy=0.0 if figure is None else BOLTZMANN * TEMPERATURE_K * 10 ** (figure / 10),
            pilot_s=self.settings.pilot_us * 1e-6,
            sent=defaultdict(int),
            events={},
        )
        for user, tx_beam, rx_beam in self.select(sounding):
            yield BeamChoice(
                tx=users[user].tx.name,
                rx=users[user].rx.name,
                tx_beam=tx_beam,
                rx_beam=rx_beam,
                carrier=users[user].carrier.name,
            )

    @abstractmethod
    def select(self, sounding: Sounding) -> Iterable[Measured]:
        """Take a pair for each user, and count the pilots that were sent for it.

        Args:
            sounding: Users and channels.

        Returns:
            In any order; a user without a pair is not served.
        """
