"""A channel model in a process of its own: prepared, warmed up, timed scene by scene.

Models of one process are not independent: Dr.Jit compiles calls of shapes and materials for all scenes that
are alive, so that a second scene changes the kernels and the time of the first; memory of one cannot be
distinguished from that of the other; and a model that takes too long could not be ended.
"""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from caviar_clients.session.scenes import Instant, Scenes
from caviar_labs.tradeoff.errors import Key, Noise, UserChannel, user_channels
from caviar_labs.tradeoff.ladder import SCATTERING, Setting
from caviar_protocol.errors import CaviarError, RunError, ScenarioError
from caviar_protocol.host import peak_mib, reset_peak, resident_mib, start_process
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import AntennaDevice, Channel, Scene
from caviar_services.registry import load
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_space.mitsuba_xml import read_scenery

SERVICE = "channel"
"""Name of every model, so that the seeds that they derive from it are the same."""


def is_known(setting: Setting, scenes: Scenes) -> bool:
    """Tell whether the channel knows a setting; nothing is loaded."""
    try:
        cls = load("channel", setting.use)
        convert_settings(cls.Settings, setting.over(scenes.settings_of("channel", setting.use)))
    except CaviarError:
        return False
    return True


class Rung:
    """A channel model with one setting, loaded and warmed up in this process.

    Args:
        setting: Model and settings.
        scenes: The first of them warms the model up.
        receivers: Receivers of a scene at most; None: all.
        products: Whether samples hold the channels themselves.

    Raises:
        CaviarError: The setting is unknown to the model, or the model cannot be loaded.
    """

    def __init__(
        self,
        setting: Setting,
        scenes: Scenes,
        receivers: int | None,
        products: bool = False,
    ) -> None:
        self.setting, self._products = setting, products
        self._noise = Noise.of(scenes)
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
        # The first scene compiles kernels and fills caches: its time counts as loading.
        first = self.sample(scenes.instants[0])
        after = resident_mib()
        self.loaded = Loaded(
            seconds=time.perf_counter() - begin,
            memory_mib=None if before is None or after is None else after - before,
            first=first,
        )

    def sample(self, instant: Instant) -> Sample:
        """Compute the channels of a scene and time that: what a run waits for, H included."""
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
        # Else a scene that warmed the model up would be timed with paths that were traced before.
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
    """Reduce a scene to what a setting sees of it.

    Args:
        scene: The whole scene.
        receivers: Receivers that stay, the first ones; None: all.
        elements: (Nt, Nr) of horizontal linear arrays in place of the scene's; None: those of the scene.
    """
    if receivers is None and elements is None:
        return scene
    kept = {device.name for device in antennas(scene, "rx")[:receivers]}
    devices: list[Any] = []
    for device in scene.devices:
        if isinstance(device, AntennaDevice):
            if device.role == "rx" and device.name not in kept:
                continue
            if elements is not None:
                # As in the paper's Table 4: one row, whatever the scenario's array is.
                columns = elements[1] if device.role == "rx" else elements[0]
                device = replace(device, array=replace(device.array, rows=1, columns=columns))
        devices.append(device)
    return replace(scene, devices=tuple(devices))


def scattering_materials(given: Mapping[str, Any], assets: Mapping[str, Path]) -> dict[str, Any]:
    """Make settings of materials in which something scatters.

    Args:
        given: The scenario's own, which stay where one of them scatters.
        assets: Files of scenery, each of whose materials gets `SCATTERING` otherwise.
    """
    # Coefficients that the user chose are better than one value for all.
    if any(entry.get("scattering_coefficient") for entry in given.values()):
        return dict(given)
    shapes = (
        shape for file in assets.values() if file.suffix == ".xml" for shape in read_scenery(file).shapes
    )
    names = {shape.radio.name for shape in shapes if shape.radio}  # none of foliage that is a volume alone
    made = {name: {**given.get(name, {}), "scattering_coefficient": SCATTERING} for name in sorted(names)}
    return {**given, **made}


# [s] for a process to end by itself, before it is killed.
_GOODBYE_S = 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """One scene measured."""

    time_ms: float
    memory_mib: float | None
    """Growth of the resident memory at its peak; None where the system does not state it."""
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
    """Cost of loading, the first scene included."""

    seconds: float
    memory_mib: float | None
    """Growth of the resident memory."""
    first: Sample


class Worker:
    """A `Rung` in a process of its own.

    Args:
        setting: Model and settings.
        scenes: Scenes that it is asked for by index.
        receivers: Receivers of a scene at most; None: all.
        seconds: Time for loading [s].
        products: Whether samples hold the channels themselves.

    Raises:
        RunError: The model cannot be loaded, or not in time; the error says why.
    """

    def __init__(
        self,
        setting: Setting,
        scenes: Scenes,
        receivers: int | None,
        seconds: float,
        products: bool = False,
    ) -> None:
        context = multiprocessing.get_context("spawn")  # what is forked has no threads of Dr.Jit
        self.setting = setting
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, setting, scenes, receivers, products), daemon=True
        )
        start_process(self._process)
        theirs.close()  # else the end of the process would not be seen: this one would hold the pipe open
        self.loaded: Loaded = self._answer(seconds)

    @property
    def pid(self) -> int:
        """Id of its process, which may have ended."""
        return self._process.pid or 0

    def step(self, index: int, seconds: float) -> Sample:
        """Measure the scene with this index.

        Args:
            index: Index among the scenes' instants.
            seconds: Time for it [s].

        Raises:
            RunError: It fails or takes too long; the process has ended then.
        """
        # An index and not a scene: the process has had all of them since its start.
        with suppress(OSError):  # a process that died before is named by the read of its answer
            self._pipe.send(index)
        sample: Sample = self._answer(seconds)
        return sample

    def close(self) -> None:
        """End the process; does nothing where it has ended."""
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
            # A process that the kernel ends for want of memory dies of SIGKILL, without a word.
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
    products: bool,
) -> None:
    """Load, then answer until the parent asks for the end or has gone; a text is the reason of a failure."""
    with suppress(EOFError, BrokenPipeError):
        try:
            rung = Rung(setting, scenes, receivers, products)
            pipe.send(rung.loaded)
            while (index := pipe.recv()) is not None:
                pipe.send(rung.sample(scenes.instants[index]))
            rung.close()
        except (CaviarError, RuntimeError, MemoryError) as error:  # Dr.Jit raises RuntimeError
            pipe.send(str(error) or type(error).__name__)
