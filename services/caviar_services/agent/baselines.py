"""Agents without learning: ``los-beam``, ``random`` and ``oracle``, to compare with, and ``waypoints``.

``los-beam`` is the baseline of the paper (section 4): it points both beams along the straight line between
transmitter and receiver, from positions and orientations alone, whether or not that line is free.
``random`` is the floor. ``oracle`` is the bound: the best pair by exhaustive search over the true channel
(paper, eq. 2). ``waypoints`` flies an object from point to point with the beams of ``los-beam``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, ClassVar

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.messages import Input
from caviar_protocol.space.beams import best_pairs, straight_beams
from caviar_protocol.space.scene import Pair, directions
from caviar_protocol.topics import BeamChoice, Scene, WaypointCommand
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.checkpoint import restored, saved
from caviar_services.link.base import User, Users, channels_of, require_channel
from caviar_services.link.beam_scores import sweep_users
from caviar_services.service import Frame, RunInfo


def straight_choices(scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
    """Choose the straight-line pair of beams for each pair of devices, the same on every carrier.

    Args:
        scene: The scenes of all worlds as one.
        pairs: Transmitter and receiver of each user.

    Returns:
        One choice a pair, in the order of ``pairs``.
    """
    at_tx, at_rx = directions(scene, pairs)
    for pair, towards_rx, towards_tx in zip(pairs, at_tx, at_rx, strict=True):
        tx_beam, rx_beam = straight_beams(pair.tx.array, towards_rx, pair.rx.array, towards_tx)
        yield BeamChoice(tx=pair.tx.name, rx=pair.rx.name, tx_beam=tx_beam, rx_beam=rx_beam)


class LosBeamAgent(Agent[AgentSettings]):
    """Points both beams along the straight line.

    Example:
        >>> agent = LosBeamAgent(AgentSettings(users=("car.*",)), RunInfo(name="agent"))
        >>> agent.serves("car.1/rx")
        True
    """

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """The straight-line pair of each user, the same on every carrier."""
        return straight_choices(scene, pairs)


class RandomAgent(Agent[AgentSettings]):
    """Uniform over all beam pairs, independent between users and frames."""

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """A random pair for each user; a user's draw does not depend on who else is there."""
        for pair in pairs:
            # A stream of its own for each user: a vehicle that arrives does not move the draws of the others,
            # so that runs with and without it can be compared user by user.
            generator = frame.generator(f"{pair.tx.name}/{pair.rx.name}")
            yield BeamChoice(
                tx=pair.tx.name,
                rx=pair.rx.name,
                tx_beam=int(generator.integers(pair.beams[0])),
                rx_beam=int(generator.integers(pair.beams[1])),
            )


class OracleAgent(Agent[AgentSettings]):
    """Knows this frame's channel, which no real agent does: the bound that others are held to."""

    # The channel of the frame itself, lag 0: a real agent has the link of the frame before.
    inputs: ClassVar[tuple[Input, ...]] = (*Agent.inputs, Input(topic="channel", parts=("h",)))

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """The pair of greatest |y| on each carrier; no choice for a user without a path."""
        channel = require_channel(frame)
        users = Users(User(pair.tx, pair.rx, carrier) for carrier in channel.carriers for pair in pairs)
        for swept in sweep_users(users, channels_of(channel, users).h):
            best = best_pairs(swept.abs_y, 1)
            for u, tx_beam, rx_beam in zip(swept.users, best.tx_beam[:, 0], best.rx_beam[:, 0], strict=True):
                yield BeamChoice(
                    tx=users[u].tx.name,
                    rx=users[u].rx.name,
                    tx_beam=int(tx_beam),
                    rx_beam=int(rx_beam),
                    carrier=users[u].carrier.name,
                )


class WaypointsSettings(AgentSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the agent ``waypoints``."""

    object: Annotated[str, msgspec.Meta(min_length=1)]
    """The object it flies, which a world of the run must fly by command; it owns ``motion:<object>``."""
    waypoints_m: Annotated[tuple[tuple[float, float, float], ...], msgspec.Meta(min_length=1)]
    """Where to, in this order; at the last one the object stays."""
    speed_m_s: Annotated[float, quantity("m/s", "on the way", gt=0)]
    reach_m: Annotated[float, quantity("m", "so near, a waypoint is reached", gt=0)] = 1.0


class _WaypointsState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    next: Annotated[int, msgspec.Meta(ge=0)]
    """Index of the waypoint that it flies to."""


class WaypointsAgent(Agent[WaypointsSettings]):
    """Flies an object to one waypoint after the other; the beams are those of ``los-beam``.

    Args:
        settings: The object, its waypoints and speed, and the users that the agent serves.
        run: What the agent knows about the run.

    Example:
        >>> points = ((10.0, 0.0, 5.0), (10.0, 20.0, 5.0))
        >>> settings = WaypointsSettings(object="uav", waypoints_m=points, speed_m_s=6.0)
        >>> WaypointsAgent(settings, RunInfo(name="pilot")).other_actuators()
        ('motion:uav',)
    """

    Settings = WaypointsSettings
    checkpoints: ClassVar[bool] = True

    def __init__(self, settings: WaypointsSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._next = 0

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Every episode begins with the first waypoint."""
        self._next = 0

    def checkpoint(self) -> bytes:
        """The waypoint under way: which were reached does not follow from where the object is."""
        return saved(self, 1, _WaypointsState(self._next))

    def restore(self, state: bytes) -> None:
        """See `checkpoint`."""
        self._next = restored(self, 1, _WaypointsState, state).next

    def other_actuators(self) -> tuple[str, ...]:
        """The motion of the object."""
        return (f"motion:{self.settings.object}",)

    def other_commands(self, frame: Frame, scene: Scene) -> Iterable[WaypointCommand]:
        """The command to the next waypoint; none while the object is not in the scene."""
        name = self.settings.object
        if name not in scene.names:
            return
        x, y, z = scene.position[scene.names.index(name)].tolist()
        # The first waypoint not yet reached.
        position = (x, y, z)
        points = self.settings.waypoints_m
        # A loop, not a step: waypoints that lie closer together than the reach are passed in one frame.
        while (
            self._next < len(points) - 1 and math.dist(position, points[self._next]) <= self.settings.reach_m
        ):
            self._next += 1
        yield WaypointCommand(object=name, position=points[self._next], speed=self.settings.speed_m_s)

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """The straight-line pair of each user."""
        return straight_choices(scene, pairs)
