"""What a channel follows: the chains of each of its transmitters, and its state."""

from __future__ import annotations

from typing import cast

import msgspec

from caviar_protocol.arrays import Float64Array
from caviar_protocol.codec import decode_payload, encode_payload
from caviar_protocol.topics import Scene
from caviar_services.channel.sionna.path_solver import Tracer
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_services.channel.sionna.tracking import Followed, FollowedState, TableState


class FollowingState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is followed; nothing where each frame stands on its own."""

    followed: dict[str, FollowedState] = {}
    """By transmitter."""
    scene: tuple[bytes, bytes] | None = None
    """That the bodies stand in, header and body; None: they have been moved since."""
    offers: tuple[tuple[bytes, TableState], ...] = ()
    """What is on offer while nothing moves, and the position that it was launched from; oldest first."""


class Following:
    """The chains of all transmitters.

    Args:
        parts: Launches until every ray was launched once.
        scene, tracer: Of the channel. Other channels may move the bodies of the same scene.
        without_body: Classes of objects that have no body.
    """

    def __init__(self, parts: int, scene: SionnaScene, tracer: Tracer, without_body: frozenset[str]) -> None:
        self._parts, self._scene, self._tracer = parts, scene, tracer
        self._without_body = without_body
        self._followed: dict[str, Followed] = {}
        # What the bodies were moved to last, with the version that the scene then had.
        self._placed: tuple[Scene, int] | None = None

    def clear(self) -> None:
        """Know nothing, as at the beginning of an episode."""
        self._followed.clear()
        self._placed = None

    def of(self, transmitter: str) -> Followed:
        """The chains of a transmitter."""
        return self._followed.setdefault(transmitter, Followed(self._parts))

    def place(self, scene: Scene) -> tuple[tuple[str, ...], Float64Array]:
        """Move the bodies; see `SionnaScene.place`."""
        placed = self._scene.place(scene, self._without_body)
        self._placed = scene, self._scene.version
        return placed

    @property
    def state(self) -> FollowingState:
        """All that the next frame's chains follow from, beside its scene."""
        followed = {name: one.state for name, one in self._followed.items()}
        if self._placed is None or self._placed[1] != self._scene.version:
            return FollowingState(followed=followed)
        return FollowingState(
            followed=followed, scene=encode_payload(self._placed[0]), offers=self._tracer.offers()
        )

    def go_on(self, state: FollowingState) -> None:
        """Be where another one was."""
        self._followed = {name: Followed.going_on(self._parts, one) for name, one in state.followed.items()}
        if state.scene is not None:
            self.place(cast(Scene, decode_payload("scene", *state.scene)))
            self._tracer.offer_again(state.offers)
