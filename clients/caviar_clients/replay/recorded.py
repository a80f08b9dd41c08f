"""A recorded run as replays need it: scenario, producers of each input, and length."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property

import msgspec

from caviar_clients.session.prepared import declared_hello, demanded
from caviar_protocol.digest import RunDigest
from caviar_protocol.errors import DeclarationError, RecordingError
from caviar_protocol.messages import PROTOCOL_VERSION, Hello, Status
from caviar_protocol.recording import Recording
from caviar_protocol.scenario import Scenario, ServiceSpec


class RecordedRun:
    """The run that a recording holds.

    Args:
        recording: Open.

    Raises:
        RecordingError: It holds no frame, or a scenario that this version does not read.

    Example:
        >>> run = RecordedRun(Recording("runs/smoke-20261122-101500"))
        >>> run.topics["link"]
        ('link',)
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        if not len(recording):
            raise RecordingError(f"{recording.path} holds no frame, so there is nothing to repeat")
        try:
            self.scenario = msgspec.convert(recording.metadata.scenario, Scenario)
        except msgspec.ValidationError as error:
            made = recording.metadata.versions.get("caviar", "another version")
            raise RecordingError(
                f"{recording.path} was recorded by {made}, its scenario is not one of this version: {error}; "
                "replay it with the version that recorded it"
            ) from error

    @cached_property
    def topics(self) -> Mapping[str, tuple[str, ...]]:
        """Recorded topics of each service; one that was not run has none."""
        # The first and the last frame: a service may join late, or be given up.
        entries = (self.recording.entry(index) for index in (0, len(self.recording) - 1))
        pairs = {(item.source, item.topic) for entry in entries for item in entry.inputs}
        return {
            name: tuple(sorted(topic for source, topic in pairs if source == name))
            for name in self.scenario.services
        }

    @cached_property
    def hellos(self) -> Mapping[str, Hello]:
        """HELLO of each service; without its implementation, with the topics that were recorded."""
        return {name: self._hello(name, spec) for name, spec in self.scenario.services.items()}

    def _hello(self, name: str, spec: ServiceSpec) -> Hello:
        try:
            return declared_hello(name, spec)
        except DeclarationError:
            return Hello(version=PROTOCOL_VERSION, name=name, role=spec.role, outputs=self.topics[name])

    @cached_property
    def demand(self) -> tuple[str, ...]:
        """Topics that the run produced, and the parts demanded of them, as entries of ``run.record``."""
        found = demanded(self.hellos, self.scenario.run.record)
        recorded = {topic for topics in self.topics.values() for topic in topics}
        return tuple(sorted(entry for entry in found | recorded if entry.partition(".")[0] in recorded))

    @cached_property
    def parts_are_known(self) -> bool:
        """True where every consumer's declaration is here, so that a part not demanded is not recorded."""
        return not any(spec.remote for spec in self.scenario.services.values())

    @cached_property
    def lengths(self) -> Mapping[int, int]:
        """Frames of each recorded episode."""
        found: dict[int, int] = {}
        for index in range(len(self.recording)):
            entry = self.recording.entry(index)
            found[entry.episode] = entry.frame + 1
        return found

    def after(self, names: Iterable[str]) -> set[str]:
        """Find the services downstream: those that take a product of these, at any lag, or of such a service.

        Args:
            names: Services to start from.

        Returns:
            Names of services, without recorders and services of which nothing was recorded.
        """
        found: set[str] = set()
        # Inputs of a frame before count, too: the graph has circles, as from the link back to the agent.
        todo = list(names)
        while todo:
            name = todo.pop()
            outputs = set(self.hellos[name].outputs)
            for other, hello in self.hellos.items():
                takes = any(item.topic in outputs for item in hello.inputs)
                if takes and hello.role != "recorder" and other not in found and self.topics[other]:
                    found.add(other)
                    todo.append(other)
        return found

    def misses(self, name: str) -> int:
        """Count the frames in which a service's products were held or absent."""
        statuses = (Status.HELD, Status.ABSENT)
        entries = (self.recording.entry(index) for index in range(len(self.recording)))
        return sum(any(i.source == name and i.status in statuses for i in entry.inputs) for entry in entries)

    def digest(self, frames: int) -> str:
        """Work out the digest of the run, had it been shorter.

        Args:
            frames: Of each episode, at most.
        """
        # As the broker does: of each frame the digests of its fresh products.
        chain = RunDigest()
        for index in range(len(self.recording)):
            entry = self.recording.entry(index)
            if entry.frame < frames:
                fresh = ((i.topic, i.source, i.digest) for i in entry.inputs if i.status is Status.FRESH)
                chain.add_frame(entry.episode, entry.frame, fresh)
        return chain.hexdigest()
