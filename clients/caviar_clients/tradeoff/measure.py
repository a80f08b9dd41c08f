"""One channel model in this process: prepared, warmed up, timed scene by scene."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from caviar_clients.tradeoff.ladder import SCATTERING, Setting
from caviar_clients.tradeoff.scenes import Instant, Scenes
from caviar_clients.tradeoff.users import Noise, user_channels
from caviar_clients.tradeoff.worker import Loaded, Sample
from caviar_protocol.errors import CaviarError, RunError, ScenarioError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import AntennaArray, AntennaDevice, Channel, Scene
from caviar_services.registry import load
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

SERVICE = "channel"
"""Name of every model, so that the seeds that they derive from it are the same."""
MEBIBYTE = 2**20

_STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")


def is_known(setting: Setting, scenes: Scenes) -> bool:
    """Whether the channel knows a setting; nothing is loaded."""
    try:
        cls = load("channel", setting.use)
        convert_settings(cls.Settings, {**scenes.settings_of("channel", setting.use), **setting.settings})
    except CaviarError:
        return False
    return True


class Rung:
    """A channel model with one setting, ready to be timed.

    Raises `CaviarError` where the setting is unknown to the model or it cannot be loaded.
    """

    def __init__(
        self,
        setting: Setting,
        scenes: Scenes,
        receivers: int | None,
        noise: Noise,
        products: bool = False,
    ) -> None:
        self.setting, self._products = setting, products
        self._noise = noise
        limits = [n for n in (receivers, setting.most_receivers) if n is not None]
        self._receivers = min(limits, default=None)
        cls = load("channel", setting.use)
        settings = {**scenes.settings_of("channel", setting.use), **setting.settings}
        if setting.scattering:
            settings["materials"] = scattering_materials(settings.get("materials", {}), scenes.assets)
        before, begin = resident_mib(), time.perf_counter()
        self._model = cls(
            convert_settings(cls.Settings, settings),
            RunInfo(
                name=SERVICE,
                run="tradeoff",
                seed=scenes.seed,
                sampling_period_ns=scenes.sampling_period_ns,
                carriers=scenes.carriers,
                devices=scenes.devices,
            ),
        )
        if cls.uses_scenery and not scenes.assets:
            raise ScenarioError("the scenes have no scenery to trace rays in")
        assets = scenes.assets if cls.uses_scenery else {}
        self._model.prepare(Preparation(demand={"channel": frozenset({"h"})}, assets=assets))
        self._seed = scenes.seed
        first = self.sample(scenes.instants[0])
        after = resident_mib()
        self.loaded = Loaded(
            seconds=time.perf_counter() - begin,
            memory_mib=None if before is None or after is None else after - before,
            first=first,
        )

    def sample(self, instant: Instant) -> Sample:
        """The channels of a scene, timed: what a run waits for, H included."""
        scene = seen(instant.scene, self._receivers, self.setting.elements)
        entry = GrantInput(topic="scene", source="recorded", status=Status.FRESH, frame=instant.frame)
        frame = Frame(
            episode=0,
            number=instant.frame,
            t_ns=instant.t_ns,
            inputs=(FrameInput(entry, payload=scene),),
            service=SERVICE,
            seed=self._seed,
        )
        # What was traced before is not to be taken again, where a scene is timed that warmed the model up.
        self._model.reset(0, self._seed, 0)
        self._model.release_memory()
        before = reset_peak()
        begin = time.perf_counter()
        result = self._model.step(frame)
        time_ms = (time.perf_counter() - begin) * 1e3
        peak = peak_mib()
        channel = result.products["channel"]
        if not isinstance(channel, Channel):
            raise RunError(f"{self.setting.use} made no channel of frame {instant.frame}")
        return Sample(
            time_ms=time_ms,
            memory_mib=None if before is None or peak is None else peak - before,
            rung=channel.rung,
            receivers=len(channel.rx),
            paths=len(channel.tau),
            lost_paths=channel.dropped > 0 or result.counts.get("path_limit_reached", 0) > 0,
            users=user_channels(instant.frame, scene, channel, self._noise),
            channel=channel if self._products else None,
        )

    def close(self) -> None:
        """Release everything."""
        self._model.close()


def seen(scene: Scene, receivers: int | None, elements: tuple[int, int] | None) -> Scene:
    """The scene with its first receivers alone, and with horizontal linear arrays of (Nt, Nr) elements."""
    if receivers is None and elements is None:
        return scene
    kept = {device.name for device in antennas(scene, "rx")[:receivers]}
    devices: list[Any] = []
    for device in scene.devices:
        if isinstance(device, AntennaDevice):
            if device.role == "rx" and device.name not in kept:
                continue
            if elements is not None:
                columns = elements[1] if device.role == "rx" else elements[0]
                device = replace(device, array=_line(device.array, columns))
        devices.append(device)
    return replace(scene, devices=tuple(devices))


def _line(array: AntennaArray, columns: int) -> AntennaArray:
    return replace(array, rows=1, columns=columns)


def scattering_materials(given: Mapping[str, Any], assets: Mapping[str, Path]) -> dict[str, Any]:
    """Settings of materials in which something scatters.

    The scenario's own where one of them does; else each material of the scenery gets `SCATTERING`.
    """
    if any(entry.get("scattering_coefficient") for entry in given.values()):
        return dict(given)
    names = {name for file in assets.values() if file.suffix == ".xml" for name in _materials(file)}
    made = {name: {**given.get(name, {}), "scattering_coefficient": SCATTERING} for name in sorted(names)}
    return {**given, **made}


def _materials(file: Path) -> list[str]:
    """Names of the materials in a scenery file, as Sionna RT calls them."""
    found = re.findall(r"<bsdf\b[^>]*\bid=\"([^\"]+)\"", file.read_text())
    return [name.removeprefix("mat-") for name in found]


def resident_mib() -> float | None:
    """Resident memory of this process [MiB]; None where the system does not tell."""
    return _status("VmRSS")


def peak_mib() -> float | None:
    """Its highest value since `reset_peak`."""
    return _status("VmHWM")


def reset_peak() -> float | None:
    """Start looking for the highest value anew; the present one. None where that cannot be done."""
    try:
        _CLEAR.write_text("5")
    except OSError:
        return None
    return resident_mib()


def _status(name: str) -> float | None:
    try:
        text = _STATUS.read_text()
    except OSError:
        return None
    found = re.search(rf"^{name}:\s+(\d+) kB$", text, re.MULTILINE)
    return int(found[1]) * 1024 / MEBIBYTE if found else None
