"""Services that serve what a recorded run holds, byte for byte, under the name they had there.

What a replayed service produces differs from run to run, and a declaration stands in a class. So the
classes of this module are made when they are asked for, named by role and topics:
``use = "caviar_services.replay:sensors_camera_depth"``. `use_of` gives the name.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, cast, get_args

import msgspec
from msgspec import Meta

from caviar_protocol.assets import recorded_meshes
from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import GeometryChange, Role, Status
from caviar_protocol.recording import Recording
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.topics import PAYLOADS
from caviar_services.conversion import Encoded
from caviar_services.service import Frame, Preparation, Prepared, Service, StepResult

ROLES: tuple[str, ...] = get_args(Role)


class ReplaySettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of every replayed service."""

    recording: Annotated[str, Meta(min_length=1)]
    """Directory of the recorded run."""
    users: tuple[str, ...] = ()
    """Agents: users that they served; without effect here."""
    except_users: tuple[str, ...] = ()
    """Agents: users that they left to others; without effect here."""


class Replayer(Service[ReplaySettings]):
    """One recorded service: its products, decisions and counts, and where an agent, the ends of episodes.

    Frames are found by episode and number, so that a run which leaves some out gets the others as they
    were. The broker reports what was held or absent (`caviar_broker.run_record`), with the recorded cause.

    Args:
        settings: The recording.
        run: What the service knows about the run; it serves the products of the service of its own name.
    """

    Settings = ReplaySettings
    inputs = ()

    @classmethod
    def check_settings(cls, settings: ReplaySettings, place: Place) -> None:
        """Raise `ScenarioError` where there is no such directory."""
        if not Path(settings.recording).exists():
            raise place.at("recording").error(
                f"there is no {settings.recording}; name the directory of a run"
            )

    @cached_property
    def _recording(self) -> Recording:
        return Recording(self.settings.recording)

    @cached_property
    def _episodes(self) -> Mapping[int, tuple[int, int]]:
        """Last frame and seed of each recorded episode."""
        entries = (self._recording.entry(index) for index in range(len(self._recording)))
        return {entry.episode: (entry.frame, entry.seed) for entry in entries}

    def scenery(self) -> Mapping[str, Path | bytes]:
        """Worlds: the recorded scenery. It does not tell whose it was, so each replayed world brings all."""
        if self.role != "world":
            return {}
        # Meshes that came while the run went on come again with the frames that they came with.
        there, at_first = self._recording.assets, {asset.name for asset in self._recording.metadata.assets}
        return {name: file for name, file in there.items() if name in at_first}

    @classmethod
    def changes_geometry_with(cls, settings: Mapping[str, object]) -> bool:
        """Whether meshes came while the run went on.

        Args:
            settings: As they stand in the scenario.
        """
        path = Path(str(settings.get("recording", "")))
        folder = RunDirectory(path if path.is_dir() else path.parent).assets
        return cls.changes_geometry and bool(recorded_meshes(folder))

    def prepare(self, preparation: Preparation) -> Prepared:
        """Open the recording; `RecordingError` where it has nothing of this service."""
        recording, name = self._recording, self.run.name
        # The first frame names each source of each topic: absent products have an entry, too.
        first = recording.entry(0).inputs if len(recording) else ()
        missing = set(self.outputs) - {item.topic for item in first if item.source == name}
        if missing:
            raise RecordingError(
                f"{recording.path} has no {', '.join(sorted(missing))} of {name!r}; run that service again, "
                f"as in caviar replay --keep {name}"
            )
        if self.role == "world":
            self._check_scenery()
        # An agent that chose the first seed has to wish for it again; the run's own needs no wish.
        seed = self._episodes[0][1] if 0 in self._episodes else -1
        wished = seed if self.role == "agent" and seed != recording.metadata.seed else -1
        return Prepared(notes=(f"as recorded in {recording.path}",), seed=wished)

    def step(self, frame: Frame) -> StepResult:
        """What the service made of this frame. `RecordingError` where the frame was not recorded."""
        # The recording ends with the last frame; the agent's extra grant after it was not recorded.
        if frame.final:
            # Seed that the agents of the recorded run chose; −1 where the one before went on.
            here, following = self._episodes.get(frame.episode), self._episodes.get(frame.episode + 1)
            return StepResult(seed=following[1] if here and following and following[1] != here[1] else -1)
        recorded = self._recording.frame(frame.episode, frame.number)
        report = next((r for r in recorded.reports if r.source == self.run.name), None)
        last = self._episodes[frame.episode][0]
        change = report.geometry if report else None
        return StepResult(
            products={
                item.provenance.topic: Encoded(
                    topic=item.provenance.topic,
                    header=bytes(item.header),
                    body=bytes(item.body),
                    fidelity=item.provenance.fidelity,
                )
                for item in recorded.products
                if item.provenance.source == self.run.name
                and item.provenance.topic in self.outputs
                and item.provenance.status in (Status.FRESH, Status.HELD)
            },
            decisions=report.decisions if report else {},
            counts=report.counts if report else {},
            end_episode=self.role == "agent" and frame.number == last,
            meshes=self._meshes(change) if change else None,
            meshes_from=change.frame if change else -1,
        )

    def _meshes(self, change: GeometryChange) -> dict[str, Path | bytes]:
        """Recorded meshes that the world announced. `RecordingError` where one is not in the recording."""
        there = self._recording.meshes
        for asset in change.assets:
            if asset.name not in there:
                raise RecordingError(
                    f"{self._recording.path} was recorded without the mesh {asset.name}, which its world "
                    f"announced; run the world again, as in caviar replay --keep {self.run.name}"
                )
        return {asset.name: there[asset.name] for asset in change.assets}

    def _check_scenery(self) -> None:
        recording, there = self._recording, self._recording.assets
        missing = [asset.name for asset in recording.metadata.assets if asset.name not in there]
        if missing:
            raise RecordingError(
                f"{recording.path} was recorded without its scenery: {missing[0]} is not in it; run the "
                f"world again, as in caviar replay --keep {self.run.name}"
            )


def use_of(role: str, topics: Iterable[str]) -> str:
    """Name a replayed service for the ``use`` of a scenario.

    Args:
        role: Role of the recorded service.
        topics: Topics that it produced.

    Example:
        >>> use_of("sensors", ["depth", "camera"])
        'caviar_services.replay:sensors_camera_depth'
    """
    return f"{__name__}:{'_'.join((role, *sorted(topics)))}"


@cache
def _replayer(name: str) -> type[Replayer]:
    role, *topics = name.split("_")
    if role not in ROLES or not topics or any(topic not in PAYLOADS for topic in topics):
        raise AttributeError(
            f"{name!r} names no replayed service: write its role, then its topics, as in world_scene"
        )
    members: dict[str, Any] = {"role": role, "outputs": tuple(topics), "__module__": __name__}
    members["changes_geometry"] = role == "world"
    return cast(type[Replayer], type(name, (Replayer,), members))


# `registry.load` takes classes out of modules by name; this one makes those that it is asked for.
def __getattr__(name: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(name)
    return _replayer(name)
