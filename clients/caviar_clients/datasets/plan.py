"""What a dataset is made of: the scenario of its episodes, and the digest that tells it from others."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from caviar_clients.datasets.catalogue import FORMAT
from caviar_clients.session.prepared import implemented, prepare
from caviar_protocol.digest import file_digest
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import DeviceSpec, Scenario, ServiceSpec
from caviar_protocol.scenario.rules import with_overrides
from caviar_services.drjit_setup import choose_variant
from caviar_services.recorder.provenance import code_digests, used_versions
from caviar_space.scenery import scenery_assets


@dataclass(frozen=True)
class DatasetPlan:
    """A dataset: episodes of one scenario.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> plan = plan_dataset(load_scenario("smoke"), episodes=3, scenes=2)
        >>> plan.episodes, plan.scenes, plan.scenario.run.frames
        (3, 2, 2)
    """

    scenario: Scenario
    """Of an episode: its frames are the scenes, and its recorder leaves out what differs from run to run."""
    episodes: int

    @property
    def scenes(self) -> int:
        """Of an episode."""
        return self.scenario.run.frames

    def settings(self) -> dict[str, Any]:
        """All that the bytes of a recording follow from, beside the number of its episode, as plain values.

        Raises:
            ScenarioError: A file that the scenario names cannot be read.
            AssetError: Scenery lacks a file.
        """
        content = msgspec.to_builtins(self.scenario)
        content.pop("source", None)
        return {
            "format": FORMAT,
            "scenario": _without_folders(content),
            "files": _digests(_files(content)),
            "code": code_digests(content),
            "versions": used_versions(content),
            "device": choose_variant(),
        }


def plan_dataset(
    scenario: Scenario, *, episodes: int, scenes: int | None = None, seed: int | None = None
) -> DatasetPlan:
    """Make the plan of a dataset.

    Args:
        scenario: Whose episodes are played.
        episodes: How many.
        scenes: Of an episode; None: the frames of the scenario.
        seed: Of all random numbers; None: that of the scenario.

    Raises:
        ScenarioError: The scenario has no recorder ``mcap``, or a service elsewhere.
    """
    scenario = with_overrides(scenario, scenes, seed, "free")
    recorders = [name for name, spec in scenario.services.items() if spec.role == "recorder"]
    if len(recorders) != 1 or scenario.services[recorders[0]].use != "mcap":
        raise ScenarioError(
            'a dataset needs one recorder; add [services.recorder] with role = "recorder", use = "mcap"',
            scenario.source.file,
            "services",
        )
    for name, spec in scenario.services.items():
        if spec.remote:
            raise ScenarioError(
                f"{name!r} is a service elsewhere; the episodes of a dataset run in one process each: give "
                "it an implementation with use",
                scenario.source.file,
                f"services.{name}.use",
            )
    recorder = scenario.services[recorders[0]]
    settings = {
        "compression": "zstd",
        "only_named": True,
        **recorder.settings,
        "reproducible": True,
        "copy_assets": False,
    }
    services = {**scenario.services, recorders[0]: replace(recorder, settings=settings)}
    # A kill costs the episodes in progress, whatever the disk holds of them: each is synced as a whole.
    # Nor does a recording say how many episodes there are: a dataset may grow.
    run = replace(scenario.run, episodes=1, durability="none", checkpoint_frames=0)
    return DatasetPlan(prepare(replace(scenario, run=run, services=services)).scenario, episodes)


def with_own_traffic(scenario: Scenario) -> Scenario:
    """The scenario in which each episode has a traffic of its own, by its own seed.

    Args:
        scenario: Whose episodes may share one.
    """
    services = {
        name: replace(spec, settings={k: v for k, v in spec.settings.items() if k != "between_episodes_s"})
        for name, spec in scenario.services.items()
    }
    return replace(scenario, services=services)


def _without_folders(value: Any) -> Any:
    if isinstance(value, str) and value.startswith(("/", "file:/")):  # a codebook: ``file:PATH#SHA-256``
        return f"file:{Path(value).name}"
    if isinstance(value, Mapping):
        return {key: _without_folders(item) for key, item in value.items()}
    return [_without_folders(item) for item in value] if isinstance(value, list | tuple) else value


def _digests(files: Iterable[tuple[str, str, Path]]) -> dict[str, str]:
    """Digest of each file by its name; by key and name where several files of one name differ."""
    found: dict[str, dict[str, str]] = {}
    for key, name, path in files:
        found.setdefault(name, {})[key] = file_digest(path)
    digests: dict[str, str] = {}
    for name, by_key in found.items():
        if len(set(by_key.values())) == 1:
            digests[name] = next(iter(by_key.values()))
        else:
            digests |= {f"{key}: {name}": digest for key, digest in by_key.items()}
    return dict(sorted(digests.items()))


def _files(value: Any, key: str = "") -> Iterator[tuple[str, str, Path]]:
    """Key, name and path of each file that the settings name, and of those that scenery names in turn."""
    if isinstance(value, str) and value.startswith("/"):
        path = Path(value)
        if path.is_file():
            yield key, path.name, path
            if key.endswith(".scenery"):
                for name, mesh in scenery_assets(value).items():
                    if isinstance(mesh, Path) and mesh != path:
                        yield key, name, mesh
    elif isinstance(value, Mapping):
        for name, item in value.items():
            yield from _files(item, f"{key}.{name}" if key else name)
    elif isinstance(value, list | tuple):
        for at, item in enumerate(value):
            yield from _files(item, f"{key}[{at}]")


CAMERAS = ("left", "centre", "right")
"""Of ``--with camera``: as in the paper's pairs, beside the transmitter."""
CAMERA_PX = (960, 540)
CAMERA_TURN_DEG = 60.0
"""From one to the next."""


def with_cameras(scenario: Scenario) -> Scenario:
    """The scenario with three cameras beside its first standing transmitter, and their pictures recorded.

    Args:
        scenario: With a transmitter that stands.

    Raises:
        ScenarioError: It has none.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> scenario = with_cameras(load_scenario("canyon-mobile"))
        >>> [device.name for device in scenario.devices if device.kind == "camera"]
        ['left', 'centre', 'right']
    """
    standing = (d for d in scenario.devices if d.kind == "antenna" and d.role in ("tx", "both") and not d.on)
    tx = next(standing, None)
    if tx is None:
        raise ScenarioError(
            "has no transmitter that stands, beside which cameras could be; add cameras to the scenario",
            scenario.source.file,
            "devices",
        )
    x, y, z = tx.position_m
    cameras = tuple(
        DeviceSpec(
            name=name,
            kind="camera",
            # Above the array, whose elements are no obstacle.
            position_m=(x, y, z + 0.3),
            yaw_deg=tx.yaw_deg + turn * CAMERA_TURN_DEG,
            pitch_deg=tx.pitch_deg + 5.0,
            size_px=CAMERA_PX,
            field_of_view_deg=75.0,
        )
        for name, turn in zip(CAMERAS, (1, 0, -1), strict=True)
    )
    services = dict(scenario.services)
    if not any(spec.use == "camera" for spec in services.values()):
        services["camera"] = ServiceSpec(role="sensors", use="camera", budget_ms=5000.0)
    # Where none is named all are recorded, and that shall stay so.
    before = scenario.run.record or [
        topic
        for service in implemented(scenario).services.values()
        if service.spec.role != "sensors"
        for topic in service.cls.outputs
    ]
    topics = tuple(dict.fromkeys((*before, "camera")))
    return replace(
        scenario,
        run=replace(scenario.run, record=topics),
        services=services,
        devices=(*scenario.devices, *cameras),
    )
