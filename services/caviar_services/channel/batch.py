"""Channels of many episodes of one run at once, for environments of which a learner steps a batch.

The episodes of a batch are its *members*. They are in the same frame, and in the same scene: the worlds of a
batch show the same in every episode. Each has a seed of its own, and so other draws.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.topics import Channel, Scene
from caviar_services.service import Frame, FrameInput, StepResult


class SceneAt(NamedTuple):
    """The scene of one frame, that of all members."""

    number: int
    t_ns: int
    scene: Scene


class MemberSeed(NamedTuple):
    """What random numbers of a member's episode depend on (contract, clause 19)."""

    seed: int
    seed_episode: int
    """Episodes since the first one with this seed."""


class BatchChannels(NamedTuple):
    """Channels of K frames; M is the number of members, or 1 where all have the same."""

    h: list[Complex128Array]
    """Of each pair, by transmitter, then receiver, Shape ``[M, K, C, Nr, Nt]``; zeros without a path."""
    has_path: BoolArray
    """Whether a path has an amplitude other than 0, Shape ``[M, K, pairs, C]``."""
    los: BoolArray
    """Whether the line of sight is free, Shape ``[K, pairs]``."""


class ChannelBatch(ABC):
    """The channels of many episodes; a channel model makes one with `ChannelModel.batch`."""

    @abstractmethod
    def begin(self, members: Sequence[MemberSeed]) -> None:
        """Begin an episode of each member."""

    @abstractmethod
    def reach(self, number: int) -> int:
        """How many frames can be computed together from a frame on."""

    @abstractmethod
    def width(self, members: int) -> int:
        """Numbers that are held at once for each element of an H, with so many members."""

    @abstractmethod
    def channels(self, frames: Sequence[SceneAt]) -> BatchChannels:
        """Compute the channels of frames that follow on each other, whose scenes have the same devices.

        Args:
            frames: At most `reach` of the first one.
        """


class _Steps(Protocol):
    """A channel model."""

    def step(self, frame: Frame) -> StepResult:
        """The channel of a frame."""


class SameChannels(ChannelBatch):
    """Channels that depend on the scene alone, so that one product is that of all members.

    Args:
        model: Draws nothing, and remembers nothing.
        name: Of its service.
    """

    def __init__(self, model: _Steps, name: str) -> None:
        self._model, self._name = model, name

    def begin(self, members: Sequence[MemberSeed]) -> None:
        """Nothing depends on seeds."""

    def reach(self, number: int) -> int:
        return 64  # products that are held at once

    def width(self, members: int) -> int:
        return 1

    def channels(self, frames: Sequence[SceneAt]) -> BatchChannels:
        products = [self._product(at) for at in frames]
        first = products[0]
        carriers, pairs = len(first.carriers), len(first.offsets) - 1
        has_path = np.zeros((1, len(frames), pairs, carriers), np.bool_)
        for k, product in enumerate(products):
            ends = product.offsets.tolist()
            for pair in range(pairs):
                has_path[0, k, pair] = product.a[:, ends[pair] : ends[pair + 1]].any(axis=1)
        receivers = len(first.rx)
        made = [{(m.carrier, m.tx * receivers + m.rx): m.h for m in product.h} for product in products]
        h = []
        for pair in range(pairs):
            # A pair has no matrix on a carrier that it does not use, and no user who looks at it.
            blank = np.zeros(next((m.shape for (_, p), m in made[0].items() if p == pair), (1, 1)), complex)
            h.append(np.array([[one.get((c, pair), blank) for c in range(carriers)] for one in made])[None])
        return BatchChannels(h, has_path, np.array([product.los.reshape(-1) for product in products]))

    def _product(self, at: SceneAt) -> Channel:
        entry = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=at.number)
        frame = Frame(
            episode=0,
            number=at.number,
            t_ns=at.t_ns,
            inputs=(FrameInput(entry, payload=at.scene),),
            service=self._name,
        )
        product = self._model.step(frame).products["channel"]
        if not isinstance(product, Channel):
            raise TypeError(f"channel {self._name!r} made a {type(product).__name__}")
        return product
