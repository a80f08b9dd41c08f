"""A channel model in a process of its own: prepared, warmed up, timed scene by scene.

Models of one process are not independent: Dr.Jit compiles calls of shapes and materials for all scenes that
are alive, so that a second scene changes the kernels and the time of the first; memory of one cannot be
distinguished from that of the other; and a model that takes too long could not be ended.
"""

from __future__ import annotations

import multiprocessing
import re
import signal
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from caviar_clients.tradeoff.ladder import SCATTERING, Setting
from caviar_clients.tradeoff.scenes import Instant, Scenes
from caviar_clients.tradeoff.users import Key, Noise, UserChannel, user_channels
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
        convert_settings(cls.Settings, setting.over(scenes.settings_of("channel", setting.use)))
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
        settings = setting.over(scenes.settings_of("channel", setting.use))
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
        assets = scenes.assets if self._model.needs_assets else {}
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


_GOODBYE_S = 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """One scene measured."""

    time_ms: float
    memory_mib: float | None
    """Growth of the resident memory at its peak; None where the system does not tell."""
    rung: str
    """As the product says."""
    receivers: int
    paths: int
    lost_paths: bool
    """Whether more paths were found than the setting allows, or some were not finite."""
    users: Mapping[Key, UserChannel]
    channel: Channel | None = None
    """The product, where it is asked for."""


@dataclass(frozen=True, kw_only=True)
class Loaded:
    """What loading took, the first scene included."""

    seconds: float
    memory_mib: float | None
    """Growth of the resident memory."""
    first: Sample


class Worker:
    """A model that is loaded, and asked for one scene after the other.

    With ``products`` samples hold the products too.

    Raises `RunError` with the reason where it cannot be loaded, or not within ``seconds``.
    """

    def __init__(
        self,
        setting: Setting,
        scenes: Scenes,
        receivers: int | None,
        noise: Noise,
        seconds: float,
        products: bool = False,
    ) -> None:
        context = multiprocessing.get_context("spawn")  # what is forked has no threads of Dr.Jit
        self.setting = setting
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, setting, scenes, receivers, noise, products), daemon=True
        )
        self._process.start()
        theirs.close()
        self.loaded: Loaded = self._answer(seconds)

    @property
    def pid(self) -> int:
        """Of its process, which may have ended."""
        return self._process.pid or 0

    def step(self, index: int, seconds: float) -> Sample:
        """The scene with this index. Raises `RunError` with the reason where it fails or takes too long."""
        with suppress(OSError):  # a process that died before is named by the read of its answer
            self._pipe.send(index)
        sample: Sample = self._answer(seconds)
        return sample

    def close(self) -> None:
        """End the process; again: nothing."""
        with suppress(OSError):
            self._pipe.send(None)
        self._pipe.close()
        self._process.join(_GOODBYE_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _answer(self, seconds: float) -> Any:
        try:
            late = not self._pipe.poll(seconds)
            answer = None if late else self._pipe.recv()
        except (EOFError, OSError) as error:
            self.close()
            code = self._process.exitcode or 0
            cause = f"signal {signal.Signals(-code).name}" if code < 0 else f"status {code}"
            raise RunError(f"its process ended with {cause}; was there enough memory?") from error
        if late:
            self._process.kill()  # it is in the middle of a scene, and hears nothing
            self.close()
            raise RunError(f"no answer within {seconds:.0f} s; give more with --minutes")
        if isinstance(answer, str):
            self.close()
            raise RunError(answer)
        return answer


def _serve(
    pipe: Connection,
    setting: Setting,
    scenes: Scenes,
    receivers: int | None,
    noise: Noise,
    products: bool,
) -> None:
    """Load, then answer until told to end or left alone; a text is the reason of a failure."""
    from caviar_clients.tradeoff.worker import Rung

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    with suppress(EOFError, BrokenPipeError):
        try:
            rung = Rung(setting, scenes, receivers, noise, products)
            pipe.send(rung.loaded)
            while (index := pipe.recv()) is not None:
                pipe.send(rung.sample(scenes.instants[index]))
            rung.close()
        except (CaviarError, RuntimeError, MemoryError) as error:  # Dr.Jit raises RuntimeError
            pipe.send(str(error) or type(error).__name__)
