"""What every link is: channel, scene and actions of a frame in, `Link` out."""

from __future__ import annotations

from typing import ClassVar, TypeVar

import msgspec

from caviar_protocol.messages import Input, Role
from caviar_services.service import Service

S = TypeVar("S", bound=msgspec.Struct)


class LinkModel(Service[S]):
    """Base of all links.

    A link turns the channels of a frame and the agents' choices into what the users got. It scores every
    user, served or not, so that agents can be compared with the best possible. A subclass implements
    `Service.step`, which returns a `caviar_protocol.topics.Link` as product ``link``; `link.users` looks up
    users, channels and choices.

    Example:
        >>> from caviar_protocol.topics import Channel
        >>> from caviar_services.link.users import choices_of, users_of
        >>> from caviar_services.service import Frame, NoSettings, StepResult
        >>> class Counting(LinkModel[NoSettings]):
        ...     def step(self, frame: Frame) -> StepResult:
        ...         channel = frame.only("channel", Channel)
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
