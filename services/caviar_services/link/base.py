"""What every link shares: base class, users of a frame, their channels, and the beams chosen for them.

A *user* is a pair of devices on one carrier: one transmitter can serve a receiver on two carriers with
different beams, and each is scored for itself. To add a link, subclass `LinkModel` and register the class.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, NamedTuple, TypeVar, cast

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, Int32Array, Int64Array
from caviar_protocol.errors import PayloadError, ProductError
from caviar_protocol.messages import GrantInput, Input, Role, Status
from caviar_protocol.space.codebooks import beam_count
from caviar_protocol.space.scene import Pair, pairs_of
from caviar_protocol.topics import Action, AntennaArray, BeamChoice, Carrier, Channel, Scene, UserSchedule
from caviar_services.channel.base import ChannelBatch, MemberSeed, SceneAt
from caviar_services.service import Frame, Service

S = TypeVar("S", bound=msgspec.Struct)


class LinkModel(Service[S]):
    """Base of all links.

    A link turns the channels of a frame and the agents' choices into what the users got. It scores every
    user, served or not, so that agents can be compared with the best possible. A subclass implements
    `Service.step`, which returns a `caviar_protocol.topics.Link` as product ``link``; `users_of`,
    `channels_of` and `choices_of` look up what it needs.

    Args:
        settings: The scenario's settings of the link.
        run: What the link knows about the run.

    Example:
        >>> from caviar_services.service import NoSettings, StepResult
        >>> class Counting(LinkModel[NoSettings]):
        ...     def step(self, frame: Frame) -> StepResult:
        ...         channel = require_channel(frame)
        ...         users = users_of(frame.scene(), channel.carriers)
        ...         served = (choices_of(frame, users).tx_beam >= 0).sum()
        ...         return StepResult(counts={"served": int(served)}, fidelity=channel.rung)
    """

    role: ClassVar[Role] = "link"
    inputs: ClassVar[tuple[Input, ...]] = (
        Input(topic="channel", parts=("h",)),
        Input(topic="scene"),
        Input(topic="action", required=False),
    )
    outputs: ClassVar[tuple[str, ...]] = ("link",)

    def batch(
        self, channels: ChannelBatch, members: int, frames: int, scene_at: Callable[[int], SceneAt]
    ) -> LinkBatch:
        """Make the links of many episodes at once; of links that say so with ``batches``.

        Args:
            channels: Of all members.
            members: Number of members.
            frames: Of an episode.
            scene_at: The scene of a frame, by its number.

        Returns:
            Links that are equal, bit by bit, to those of a run of each episode.
        """
        raise NotImplementedError(f"{type(self).__name__} computes one episode at a time")


class BatchLink(NamedTuple):
    """Result of a frame per member and user: fields of `caviar_protocol.topics.Link`, of M members and in the
    order of its users."""

    tx: tuple[str, ...]
    rx: tuple[str, ...]
    carrier: tuple[str, ...]
    has_path: BoolArray
    """Shape ``[M, U]``, as all below."""
    los: BoolArray
    tx_beam: Int64Array
    rx_beam: Int64Array
    abs_y: Float64Array
    top_abs_y: Float64Array
    """|y| of the best pair alone, Shape ``[M, U, 1]``."""
    baseline_abs_y: Float64Array
    snr: Float64Array
    spectral_efficiency: Float64Array
    """[bit/s/Hz]."""


class LinkBatch(ABC):
    """The links of many episodes; a link makes one with `LinkModel.batch`."""

    @abstractmethod
    def begin(self, members: Sequence[MemberSeed]) -> None:
        """Begin an episode of each member."""

    @abstractmethod
    def step(self, number: int, beams: Int64Array) -> BatchLink:
        """Score the beams of a frame.

        Args:
            number: Of the frame, which follows on the one before.
            beams: Index ``tx_beam·Nr + rx_beam`` of the pair of each member and user, −1 where it is not
                served; Shape ``[M, U]`` with the users of `users_of`.
        """


@dataclass(frozen=True)
class User(Pair):
    """A pair of devices on one carrier."""

    carrier: Carrier

    def __str__(self) -> str:
        return f"{self.tx.name} → {self.rx.name} on {self.carrier.name}"


class Users(tuple[User, ...]):
    """The users of a scene, with look-ups that hold as long as the users stay the same."""

    # Axes of the last channel product that was asked for, and the indices found in it. Consecutive products
    # mostly have the same axes, so a frame costs one comparison instead of a look-up for each user.
    _indices: tuple[object, list[tuple[int, int, int] | None]] | None = None

    @cached_property
    def by_pair(self) -> dict[tuple[str, str], list[int]]:
        """Indices of the users of each pair of devices, by the names of TX and RX."""
        found: dict[tuple[str, str], list[int]] = defaultdict(list)
        for index, user in enumerate(self):
            found[user.tx.name, user.rx.name].append(index)
        return dict(found)

    @cached_property
    def array_groups(self) -> list[int]:
        """A number for each user, the same for those with equal arrays: their H have one shape."""
        numbers: dict[tuple[AntennaArray, AntennaArray], int] = {}
        return [numbers.setdefault((user.tx.array, user.rx.array), len(numbers)) for user in self]

    def channel_indices(self, channel: Channel) -> list[tuple[int, int, int] | None]:
        """Find each user on the axes of a channel product.

        Args:
            channel: The product.

        Returns:
            Indices of carrier, TX and RX of each user; None for a user that the product does not cover.
        """
        axes = (channel.carriers, channel.tx, channel.rx)
        if self._indices is None or self._indices[0] != axes:
            carriers = {carrier.name: index for index, carrier in enumerate(channel.carriers)}
            tx = {name: index for index, name in enumerate(channel.tx)}
            rx = {name: index for index, name in enumerate(channel.rx)}
            found = [
                (carriers[user.carrier.name], tx[user.tx.name], rx[user.rx.name])
                if user.carrier.name in carriers and user.tx.name in tx and user.rx.name in rx
                else None
                for user in self
            ]
            self._indices = axes, found
        return self._indices[1]


def users_of(scene: Scene, carriers: Sequence[Carrier]) -> Users:
    """List all users of a scene.

    Args:
        scene: The scenes of all worlds as one.
        carriers: Carriers of the run.

    Returns:
        Users in the order of `caviar_protocol.topics.Link`: carriers as given, then TX, then RX by name.

    Example:
        >>> from caviar_services.testing.samples import CARRIERS, scene
        >>> [str(user) for user in users_of(scene(0), CARRIERS)]
        ['bs → car.1/rx on mmwave', 'bs → truck.2/rx on mmwave']
    """
    pairs = pairs_of(scene)
    return Users(
        User(pair.tx, pair.rx, carrier) for carrier in carriers for pair in pairs if pair.uses(carrier.name)
    )


def require_channel(frame: Frame) -> Channel:
    """The channel product of a frame, for a service that cannot do without.

    Args:
        frame: The frame, with topic ``channel`` among its inputs.

    Raises:
        PayloadError: The channel is absent, or the run has several channel services.

    Example:
        >>> from caviar_services.testing.samples import granted
        >>> require_channel(granted(LinkModel.inputs, 0, "link")).rung
        'free-space'
    """
    channel = frame.only("channel", Channel)
    if channel is None:
        raise PayloadError(f"{frame.service} was granted frame {frame.number} without a channel")
    return channel


class UserChannels(msgspec.Struct, frozen=True):
    """What the channel product says about each user, Shape ``[U]`` each."""

    unknown: int
    """Users that the channel does not cover: a held channel has no device that came later."""
    has_path: BoolArray
    """At least one path with an amplitude other than 0 on the user's carrier."""
    los: BoolArray
    """Whether the line of sight is free."""
    h: tuple[Complex128Array | None, ...]
    """H, Shape ``[Nr, Nt]``; None without a path."""


def channels_of(channel: Channel, users: Users) -> UserChannels:
    """Look up each user in the channel product.

    Args:
        channel: The product, with part ``h``.
        users: Users of the scene of the same frame.

    Returns:
        Channels in the order of ``users``.

    Raises:
        PayloadError: Paths reach a user, but its H is missing or does not fit its arrays; names the user.

    Example:
        >>> from caviar_services.testing.samples import CARRIERS, product, scene
        >>> channels_of(product("channel", 0), users_of(scene(0), CARRIERS)).h[0].shape
        (3, 16)
    """
    matrices = {(matrix.carrier, matrix.tx, matrix.rx): matrix.h for matrix in channel.h}
    offsets, free, receivers = channel.offsets.tolist(), channel.los.tolist(), len(channel.rx)
    unknown, has_path, los = 0, [False] * len(users), [False] * len(users)
    found: list[Complex128Array | None] = [None] * len(users)
    for u, indices in enumerate(users.channel_indices(channel)):
        if indices is None:
            unknown += 1
            continue
        c, t, r = indices
        first = t * receivers + r
        los[u] = free[t][r]
        # A path may carry another carrier only: an amplitude of 0 is no path on this one.
        if np.count_nonzero(channel.a[c, offsets[first] : offsets[first + 1]]):
            has_path[u], found[u] = True, _checked(users[u], matrices.get(indices))
    flags = np.array(has_path + los, np.bool_).reshape(2, -1)
    return UserChannels(unknown, flags[0], flags[1], tuple(found))


def _checked(user: User, h: Complex128Array | None) -> Complex128Array:
    if h is None:
        raise PayloadError(
            f"the channel has paths for {user} but no H; its service has to compute part 'h', "
            "which is in demand"
        )
    expected = (user.rx.array.size, user.tx.array.size)
    if h.shape != expected:
        raise PayloadError(
            f"H of {user} has shape {h.shape}, the arrays of the scene need {expected} (RX × TX elements)"
        )
    return h


# Names that an error message lists at most.
_LISTED = 8


class Choices(msgspec.Struct, frozen=True):
    """Chosen beams per user, −1 where no agent serves it, Shape ``[U]`` each."""

    tx_beam: Int32Array
    rx_beam: Int32Array
    outdated: int = 0
    """Commands of held actions whose user is no longer there."""


def choices_of(frame: Frame, users: Users) -> Choices:
    """Collect the beams that the agents of this frame chose.

    A choice without a carrier holds for every carrier on which its agent makes no other. Where an
    agent schedules receivers, the transmitter's other receivers are not served. A held action may name
    users that left since; those commands are counted.

    Args:
        frame: The frame, with the actions of all agents among its inputs.
        users: Users of the scene of the same frame.

    Returns:
        Choices in the order of ``users``.

    Raises:
        ProductError: An agent names a user that does not exist or a beam outside the codebook, or
            contradicts itself.
        PayloadError: The commands of two agents concern one user; both are named.

    Example:
        >>> from caviar_services.testing.samples import CARRIERS, granted, scene
        >>> frame = granted(LinkModel.inputs, 0, "link")
        >>> bool((choices_of(frame, users_of(scene(0), CARRIERS)).tx_beam >= 0).all())
        True
    """
    commands = _FrameCommands(users)
    for action, command in _commands(frame):
        if isinstance(command, BeamChoice):
            commands.choose_beams(action, command)
        elif isinstance(command, UserSchedule):
            commands.schedule_receiver(action, command)
    return commands.choices()


def _commands(frame: Frame) -> Iterator[tuple[GrantInput, object]]:
    """Each command, with the provenance of its action, agents in sorted order."""
    # Sorted, so that an error of two agents names the same one as the first in every run.
    actions = [item for item in frame.inputs if item.provenance.topic == "action" and item.present]
    if len(actions) > 1:
        actions.sort(key=lambda entry: entry.provenance.source)
    for item in actions:
        for command in cast(Action, item.payload).commands:
            yield item.provenance, command


@dataclass
class _FrameCommands:
    """Commands of a frame, entered one after the other."""

    users: Users
    # Agent and command by index of the user; agent and receivers by transmitter.
    chosen: dict[int, tuple[str, BeamChoice]] = field(default_factory=dict)
    scheduled: dict[str, tuple[str, set[str]]] = field(default_factory=dict)
    outdated: int = 0

    def choose_beams(self, action: GrantInput, command: BeamChoice) -> None:
        indices = [
            index
            for index in self.users.by_pair.get((command.tx, command.rx), ())
            if command.carrier in ("", self.users[index].carrier.name)
        ]
        if not indices:
            self._no_such_user(action, command.tx, command.rx, command.carrier)
        for index in indices:
            previous = self.chosen.get(index)
            if previous is not None and self._first_wins(index, previous, action, command):
                continue
            user = self.users[index]
            for side, beam, device in (("TX", command.tx_beam, user.tx), ("RX", command.rx_beam, user.rx)):
                count = beam_count(device.array)
                if not 0 <= beam < count:
                    raise _wrong(
                        action,
                        f"it chose {side} beam {beam} for {_user(user.tx.name, user.rx.name)}; "
                        f"the codebook of {device.name!r} has beams 0 to {count - 1}",
                    )
            self.chosen[index] = (action.source, command)

    def schedule_receiver(self, action: GrantInput, command: UserSchedule) -> None:
        if (command.tx, command.rx) not in self.users.by_pair:
            self._no_such_user(action, command.tx, command.rx, "")
            return
        agent, receivers = self.scheduled.setdefault(command.tx, (action.source, set()))
        if agent != action.source:
            problem = f"schedule receivers of {command.tx!r}; let one of them own 'schedule:{command.tx}'"
            raise _contradiction(agent, action, problem)
        if command.rx in receivers:
            raise _contradiction(agent, action, f"schedule {_user(command.tx, command.rx)}; send one of them")
        receivers.add(command.rx)

    def choices(self) -> Choices:
        tx_beam, rx_beam = ([-1] * len(self.users) for _ in range(2))
        for index, (_, command) in self.chosen.items():
            scheduled = self.scheduled.get(command.tx)
            if scheduled is None or command.rx in scheduled[1]:
                tx_beam[index], rx_beam[index] = command.tx_beam, command.rx_beam
        beams = np.array(tx_beam + rx_beam, np.int32).reshape(2, -1)
        return Choices(beams[0], beams[1], self.outdated)

    # One rule for both ways round: an agent may say «beam 3, and beam 5 on the second carrier» in any order.
    def _first_wins(
        self, index: int, previous: tuple[str, BeamChoice], action: GrantInput, command: BeamChoice
    ) -> bool:
        """Whether the earlier choice stays: one that names a carrier beats one that does not."""
        first_agent, first = previous
        if first_agent == action.source and bool(first.carrier) != bool(command.carrier):
            return bool(first.carrier)
        user = self.users[index]
        problem = (
            f"choose beams for {_user(user.tx.name, user.rx.name)} on carrier {user.carrier.name!r}; "
            "let one of them own the receiver (services.<agent>.users)"
        )
        raise _contradiction(first_agent, action, problem)

    def _no_such_user(self, action: GrantInput, tx: str, rx: str, carrier: str) -> None:
        # A fresh action was made from this frame's scene; a held one from an earlier frame's, whose devices
        # may be gone by now: that is no fault of the agent.
        if action.status is Status.HELD:
            self.outdated += 1
            return
        names = sorted({_user(user.tx.name, user.rx.name) for user in self.users})
        listed = ", ".join(names[:_LISTED]) + (", …" if len(names) > _LISTED else "")
        where = f" on carrier {carrier!r}" if carrier else ""
        raise _wrong(
            action,
            f"it commands {_user(tx, rx)}{where}, which does not exist in this frame; "
            f"there are: {listed or 'none'}",
        )


def wrong_choice(frame: Frame, user: User, problem: str) -> ProductError:
    """Make the error about the beams that an agent chose for a user.

    Args:
        frame: The frame.
        user: The user, for which one did.
        problem: What is wrong, and what to write instead.
    """
    for action, command in _commands(frame):
        if isinstance(command, BeamChoice) and (command.tx, command.rx) == (user.tx.name, user.rx.name):
            return _wrong(action, problem)
    raise ValueError(f"no agent chose beams for {user}")


def _user(tx: str, rx: str) -> str:
    return f"{tx} → {rx}"


def _wrong(action: GrantInput, problem: str) -> ProductError:
    return ProductError(action.topic, action.source, action.frame, problem)


def _contradiction(first: str, action: GrantInput, problem: str) -> PayloadError | ProductError:
    """An action against one of the agent ``first``: its own fault, or, of two agents, that of neither."""
    if first == action.source:
        return _wrong(action, f"two commands {problem}")
    return PayloadError(f"agents {first!r} and {action.source!r} both {problem}")
