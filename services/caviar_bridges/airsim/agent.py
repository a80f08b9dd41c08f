"""Agent ``airsim``: scripts written for AirSim fly objects of the run, over AirSim's own RPC.

Motion calls become commands of the protocol; answers come from the newest frame: its scene, pictures and
LIDAR scans. The agent answers a frame at once, and the run goes on at its own pace. Once a client has paused
it, the agent keeps the frame, and the world waits for its answer.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import threading
from collections.abc import Coroutine, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import msgspec
from msgspec.structs import replace

from caviar_bridges.airsim.bridge import OVER, Bridge, Snapshot
from caviar_bridges.airsim.calls import Offer, StateCalls
from caviar_bridges.airsim.motion_calls import Habits, MotionCalls
from caviar_bridges.airsim.rpc import HOST, PORT, RpcServer, address_of
from caviar_bridges.airsim.sensor_calls import SensorCalls
from caviar_bridges.airsim.wire import GEO_ORIGIN
from caviar_protocol.errors import ScenarioError
from caviar_protocol.messages import Input
from caviar_protocol.scenario import Scenario
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.scene import Pair
from caviar_protocol.topics import BeamChoice, Camera, Depth, Lidar, Scene, Segmentation
from caviar_protocol.topics.link import Command
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.agent.baselines import straight_choices
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, StepResult
from caviar_space.scenery import scenery_triangles

LOOK_S = 0.1
"""[s] between looks for orders of the broker while a client holds the world."""
CLOSE_S = 5.0
"""[s] that closing may take."""
LOOPBACK = ("127.0.0.1", "localhost", "::1")

T = TypeVar("T")


class AirSimSettings(AgentSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the agent ``airsim``."""

    vehicles: Annotated[dict[str, str], msgspec.Meta(min_length=1)]
    """Object that each vehicle is, by the name that scripts use: ``vehicles = { Drone1 = "uav" }``. The first
    one is meant where a script names none. The agent owns ``motion:<object>`` of each."""
    listen: str = f"{HOST}:{PORT}"
    """``HOST:PORT`` at which scripts connect; port 0: any, which the run's log names. AirSim's RPC knows no
    keys: every program that reaches the address can fly."""
    start: Literal["at-once", "client", "paused"] = "at-once"
    """When the first frame goes by: at once; with the first call of a script; or when a script lets it, as if
    it had been paused before."""
    origin_m: tuple[float, float, float] | None = None
    """Origin of AirSim's axes; unset: where the first vehicle is in the first frame."""
    geo_origin: tuple[float, float, float] = GEO_ORIGIN
    """Latitude [°], longitude [°] and altitude [m] there; the default is AirSim's."""
    sensors: dict[str, str] = msgspec.field(default_factory=dict)
    """Device by a further name that scripts use for it: ``sensors = { front_center = "uav/gimbal" }``."""
    lidar_frame: Literal["inertial", "sensor"] = "inertial"
    """Axes of LIDAR points, as ``DataFrame`` of AirSim's settings: NED from the origin, or the sensor's."""
    habits: Habits = Habits()
    """Defaults of flight where a call does not say it."""


class AirSimAgent(Agent[AirSimSettings]):
    """Serves AirSim's RPC. Beams of the users it serves are those of ``los-beam``.

    Args:
        settings: Vehicles, address, and how they fly.
        run: What the agent knows about the run.

    Raises:
        ScenarioError: ``listen`` is no address.

    Example:
        >>> settings = AirSimSettings(vehicles={"Drone1": "uav"}, users=("motion:uav",))
        >>> AirSimAgent(settings, RunInfo(name="pilot")).other_actuators()
        ('motion:uav',)
    """

    Settings: ClassVar[type[msgspec.Struct]] = AirSimSettings
    uses_scenery: ClassVar[bool] = True
    inputs: ClassVar[tuple[Input, ...]] = (
        *Agent.inputs,
        *(Input(topic=topic, required=False) for topic in ("lidar", "camera", "depth", "segmentation")),
    )

    @classmethod
    def check_settings(cls, settings: AirSimSettings, place: Place) -> None:
        """Refuse an address that is none, and two vehicles that are one object."""
        try:
            address_of(settings.listen)
        except ValueError as error:
            raise place.at("listen").error(str(error)) from error
        objects = list(settings.vehicles.values())
        for name, thing in settings.vehicles.items():
            if objects.count(thing) > 1:
                raise place.at("vehicles").error(
                    f"{name!r} and another vehicle are the object {thing!r}; name one vehicle for each object"
                )

    @classmethod
    def check_scenario(cls, settings: AirSimSettings, scenario: Scenario, place: Place) -> None:
        """Refuse a policy under which the world would not wait for a script that has paused it."""
        for name, spec in scenario.services.items():
            if (spec.role, spec.use) == ("agent", "airsim") and spec.policy != "wait":
                raise ScenarioError(
                    f"is {spec.policy!r}: a script that pauses the world holds it by a late answer; write "
                    '"wait"',
                    key=f"services.{name}.policy",
                )

    def __init__(self, settings: AirSimSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._loop: _LoopThread | None = None
        self._assets: Mapping[str, Path] = {}
        self._ends = False

    def prepare(self, preparation: Preparation) -> Prepared:
        """Listen for scripts.

        Raises:
            SetupError: The address is in use.
        """
        self._assets = preparation.assets
        self._loop = _LoopThread()
        self._loop.run(self._listen(), CLOSE_S)
        host = self._server.host
        open_to_all = "" if host in LOOPBACK else "; every program that reaches it can fly"
        note = f"AirSim's RPC is served at {host}:{self._server.port}{open_to_all}"
        prepared = super().prepare(preparation)
        return Prepared(actuators=prepared.actuators, notes=(*prepared.notes, note))

    async def _listen(self) -> None:
        settings = self.settings
        self._bridge = Bridge(
            settings.vehicles, settings.origin_m, settings.geo_origin, paused=settings.start == "paused"
        )
        in_sensor_axes = settings.lidar_frame == "sensor"
        sensors = SensorCalls(
            self._bridge,
            settings.sensors,
            lidar_in_sensor_axes=in_sensor_axes,
            load_scenery=lambda: scenery_triangles(self._assets),
        )
        motion = MotionCalls(self._bridge, settings.habits)
        offer = Offer({**StateCalls(self._bridge).offered(), **sensors.offered(), **motion.offered()})
        self._server = RpcServer(offer.handle, *address_of(settings.listen))
        await self._server.start()

    def other_actuators(self) -> tuple[str, ...]:
        """The motion of each vehicle."""
        return tuple(sorted(f"motion:{thing}" for thing in self.settings.vehicles.values()))

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Every episode begins without API control."""
        if self._loop is not None:
            self._loop.run(self._begin_episode(), CLOSE_S)

    async def _begin_episode(self) -> None:
        self._bridge.begin_episode()

    def step(self, frame: Frame) -> StepResult:
        """Show the frame to clients, and command what they ask for."""
        self._ends = False
        made = super().step(frame)
        return replace(made, end_episode=True) if self._ends else made

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """The straight-line pair of each user."""
        return straight_choices(scene, pairs)

    def other_commands(self, frame: Frame, scene: Scene) -> Iterable[Command]:
        """Commands of the manoeuvres under way, once the frame may go by."""
        if self._loop is None:
            return ()
        snapshot = Snapshot(
            frame=frame.number,
            t_ns=frame.t_ns,
            scene=scene,
            lidars=tuple(frame.payloads("lidar", Lidar).values()),
            images={
                "camera": tuple(frame.payloads("camera", Camera).values()),
                "depth": tuple(frame.payloads("depth", Depth).values()),
                "segmentation": tuple(frame.payloads("segmentation", Segmentation).values()),
            },
            is_last_episode=frame.episode + 1 >= self.run.episodes,
        )
        deciding = self._loop.submit(self._decide(snapshot))
        # A script may hold the world for hours. Without progress the run would end with `stall_s`; and the
        # broker may end the run meanwhile.
        while not concurrent.futures.wait([deciding], LOOK_S).done:
            self.run.progress("a client of AirSim's RPC holds the world", 0.0)
            try:
                self.run.attend()
            except BaseException:
                deciding.cancel()
                raise
        commands, self._ends = deciding.result()
        return commands

    async def _decide(self, snapshot: Snapshot) -> tuple[Sequence[Command], bool]:
        if self.settings.start == "client":
            await self._server.called.wait()
        return await self._bridge.decide(snapshot)

    def close(self) -> None:
        """Answer calls under way with an error, and hang up."""
        loop, self._loop = self._loop, None
        if loop is not None:
            try:
                loop.run(self._server.close(OVER), CLOSE_S)
            finally:
                loop.close()


class _LoopThread:
    """An event loop in a thread of its own."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="airsim-rpc", daemon=True)
        self._thread.start()

    def submit(self, work: Coroutine[Any, Any, T]) -> concurrent.futures.Future[T]:
        """Run a coroutine in the loop."""
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def run(self, work: Coroutine[Any, Any, T], timeout_s: float) -> T:
        """Run a coroutine in the loop, and wait for its result."""
        return self.submit(work).result(timeout_s)

    def close(self) -> None:
        """End the loop and the thread, and what still runs in it."""
        self._loop.call_soon_threadsafe(self._end)
        self._thread.join(CLOSE_S)
        if not self._thread.is_alive():
            self._loop.close()

    def _end(self) -> None:
        for task in asyncio.all_tasks(self._loop):
            task.cancel()
        self._loop.call_soon(self._loop.stop)
