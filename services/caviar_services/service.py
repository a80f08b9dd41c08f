"""The contract between a service and the one runner that all services share.

An implementation subclasses `Service` (most subclass the base of their role: `world.base.World`,
`channel.base.ChannelModel`, …), says what it consumes and produces, and computes. It never
sees a socket, a deadline or another service: `runner.py` does that part for all of them, and
the embedded run uses the same objects without sockets.

Life of a service: ``__init__`` → ``scenery`` (worlds) → ``prepare`` → per episode ``reset``,
``step`` for each frame, ``end_episode`` → ``close``. What a service with state knows after a frame
it saves with ``checkpoint``; another process takes it over with ``restore``, after ``reset`` of the
same episode, and continues with the same bytes (`checkpoint` makes bytes of a struct, and checks them).

What methods that users write return, checked where they can still be named.
"""

from __future__ import annotations

import reprlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

import msgspec

from caviar_protocol.errors import PayloadError
from caviar_protocol.messages import Input, Role
from caviar_protocol.scenario import DeviceSpec, Scenario
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.topics import Carrier
from caviar_services.frame import Frame, FrameInput, StepResult

__all__ = [
    "Frame",
    "FrameInput",
    "NoSettings",
    "Preparation",
    "Prepared",
    "Progress",
    "RunInfo",
    "Service",
    "StepResult",
    "no_orders",
    "no_progress",
]

S = TypeVar("S", bound=msgspec.Struct)

Progress = Callable[[str, float], None]
"""``progress(phase, grace_s)``: tell the broker what is being done, and that it advances.

``grace_s`` is how long the phase may stay silent before it counts as stalled; 0 for the
scenario's ``stall_s``. Declare one before compiling kernels or loading large scenes.
"""


def no_progress(phase: str, grace_s: float = 0.0) -> None:
    """Report nothing: no broker watches this service.

    Args:
        phase: What is being done.
        grace_s: How long it may stay silent [s].
    """


def no_orders() -> None:
    """Look for no orders: no broker gives any to this service."""


@dataclass(frozen=True, kw_only=True)
class RunInfo:
    """What a service knows about the run it is part of.

    In a run the runner makes it of WELCOME; a test of a service makes its own.

    Example:
        >>> run = RunInfo(name="link", seed=7)
        >>> run.sampling_period_ns, run.again
        (100000000, False)
    """

    name: str
    """Name of this service, unique in the run."""
    run: str = ""
    """Identity of the run."""
    seed: int = 0
    """Of the run; `Frame.generator` gives random numbers that depend on it."""
    sampling_period_ns: int = 100_000_000
    """Simulated time between two frames [ns]."""
    frames: int = 1
    """Frames of an episode, unless an agent ends it earlier."""
    episodes: int = 1
    """Of the run."""
    carriers: tuple[Carrier, ...] = ()
    devices: tuple[DeviceSpec, ...] = ()
    """Worlds: the devices that this world publishes. Others: all devices of the scenario."""
    scenario: Mapping[str, object] = field(default_factory=dict)
    """The scenario as resolved, for the recorder's metadata."""
    directory: Path = Path()
    """Where the recorder writes."""
    progress: Progress = no_progress
    attend: Callable[[], None] = no_orders
    """Looks for orders of the broker. A step that waits for something outside of the run calls it a few times
    a second, and lets through what it raises (no `Exception`): the run is over, or the broker is gone."""
    again: bool = False
    """Whether another process of this name was in the run before, or may have been."""
    settings_key: str = ""
    """Dotted key of the service's settings in the scenario; empty: ``services.NAME.settings``."""

    @property
    def settings_place(self) -> Place:
        """Where the service's settings stand, for errors; the broker adds file and line."""
        return (
            Place(self.settings_key) if self.settings_key else Place("services").at(self.name).at("settings")
        )


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """What a service learns before its first frame: which of its products are wanted, and where files are.

    Example:
        >>> preparation = Preparation(demand={"channel": frozenset({"h"})})
        >>> "hf" in preparation.demand["channel"]  # so no response over the band is computed
        False
    """

    demand: Mapping[str, frozenset[str]]
    """Topics of this service that are consumed, with the parts asked for (clause 5)."""
    assets: Mapping[str, Path] = field(default_factory=dict)
    """Files of scenery by name; all are in one local folder, at their names as relative paths."""
    producers: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Topic to its sources in this run."""
    files: Mapping[str, Path] = field(default_factory=dict)
    """Files of `Service.own_files`, by SHA-256."""
    max_faces: int = 0
    """Worlds: triangles that a mesh may have which comes while the run goes on; 0: none may come."""


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """What a service declares once it is prepared. The runner adds the digest of the geometry for READY.

    Example:
        >>> Prepared(actuators=("beam:car.*",), notes=("model of 2026-11",)).prefixes
        ()
    """

    prefixes: tuple[str, ...] = ()
    """Worlds: what the names of their objects and fixed devices begin with."""
    actuators: tuple[str, ...] = ()
    """Agents: what they command, as names with ``*`` and ``?``."""
    notes: tuple[str, ...] = ()
    """For the user: shown at the start, kept in the summary."""
    seed: int = -1
    """Agents: of the first episode; −1: the run's."""


class NoSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a service that has none.

    Example:
        >>> NoSettings() == NoSettings()
        True
    """


class Service(ABC, Generic[S]):
    """One service of a run. An implementation subclasses it, mostly through the base of its role.

    Class attributes are the declaration; the broker builds the graph of the run from them. Raise a
    `CaviarError` whose text names the value and the remedy for what a user can mend; any exception becomes a
    FAULT of this service, with a traceback where it is no `CaviarError`.

    Args:
        settings: The scenario's settings of this service, converted to `Settings`.
        run: What the service knows about the run.

    Example:
        >>> from caviar_protocol.topics import Scene
        >>> class Counter(Service[NoSettings]):
        ...     role = "sensors"
        ...     inputs = (Input(topic="scene"),)
        ...
        ...     def step(self, frame: Frame) -> StepResult:
        ...         return StepResult(counts={"objects": len(frame.scene().names)})
        >>> counter = Counter(NoSettings(), RunInfo(name="counter"))
        >>> counter.prepare(Preparation(demand={})).notes
        ()
    """

    role: ClassVar[Role]
    inputs: ClassVar[tuple[Input, ...]] = ()
    outputs: ClassVar[tuple[str, ...]] = ()
    uses_scenery: ClassVar[bool] = False
    """Whether the assets of the run are fetched for this service before `prepare` (clause 4)."""
    changes_geometry: ClassVar[bool] = False
    """Whether meshes may come and go while the run goes on: a world announces them (`StepResult.meshes`),
    other services implement `use_meshes`."""
    checkpoints: ClassVar[bool] = False
    """Whether `checkpoint` and `restore` are implemented: the service has state that outlives a frame."""
    batches: ClassVar[bool] = False
    """Whether this class, and not one that it subclasses, computes many episodes at once: a world whose
    scenes depend on the instant alone, a channel model with `ChannelModel.batch`, a link with
    `LinkModel.batch`."""
    extra: ClassVar[str] = ""
    """Extra of the distribution that brings the libraries of this service; empty: the base install does."""
    packages: ClassVar[tuple[str, ...]] = ()
    """Distributions whose versions may change the products, beside NumPy and msgspec: a dataset that was
    generated with others is another one (`caviar_services.recorder.provenance`)."""
    attributes_to_set: ClassVar[tuple[str, ...]] = ()
    """Class attributes that an implementation has to set; looked for when its class is loaded."""
    Settings: ClassVar[type[msgspec.Struct]] = NoSettings
    """Settings from the scenario: a frozen struct, ``forbid_unknown_fields=True``, units in names."""

    @classmethod
    def check_settings(cls, settings: S, place: Place) -> None:  # optional hook
        """Check settings beyond what their types say, where the scenario is read, before anything starts.

        Args:
            settings: The settings.
            place: Where they stand in the scenario; ``place.at("key").error(text)`` makes the error.

        Raises:
            ScenarioError: A value is wrong; the error names file, key and line.
        """

    @classmethod
    def check_scenario(cls, settings: S, scenario: Scenario, place: Place) -> None:  # optional hook
        """Check settings against the rest of the scenario, after `check_settings`.

        Args:
            settings: The settings.
            scenario: Which the service is part of.
            place: Where the settings stand in it.

        Raises:
            ScenarioError: A value does not fit the scenario; the error names file, key and line.
        """

    def __init__(self, settings: S, run: RunInfo) -> None:
        self.settings = settings
        self.run = run

    @classmethod
    def computes_batches(cls, settings: Mapping[str, object]) -> bool:
        """Whether many episodes can be computed at once by this implementation (`batches`).

        Args:
            settings: As they stand in the scenario: some of an implementation may be left to single episodes.
        """
        # What a subclass overrides would be left out: it has to say so itself.
        return bool(vars(cls).get("batches", False))

    @classmethod
    def changes_geometry_with(cls, settings: Mapping[str, object]) -> bool:
        """Whether a world may announce meshes while the run goes on.

        Args:
            settings: As they stand in the scenario: not every world of a class does.
        """
        return cls.changes_geometry

    @classmethod
    def inputs_with(cls, settings: Mapping[str, object]) -> Sequence[Input]:
        """What the implementation consumes beside `inputs`, by its settings.

        Args:
            settings: As they stand in the scenario.
        """
        return ()

    @property
    def needs_assets(self) -> bool:
        """Whether the assets of the run are fetched before `prepare`: where the class uses scenery, or what
        it is to do in this run needs files."""
        return self.uses_scenery

    @property
    def own_files(self) -> Sequence[str]:
        """SHA-256 of files for this service alone, which are fetched from the broker before `prepare`."""
        return ()

    def wanted_files(self, decisions: Mapping[str, str]) -> Sequence[str]:
        """SHA-256 of files that are fetched from the broker beside the frames, for `take_file`.

        Args:
            decisions: Of a GRANT, after its frame was computed.
        """
        return ()

    def take_file(self, digest: str, path: Path | None, reason: str) -> None:  # optional hook
        """Take a file of `wanted_files`, between two frames.

        Args:
            digest: Its SHA-256.
            path: Where it is; None: it could not be fetched.
            reason: Why not.
        """

    def use_meshes(self, meshes: Mapping[str, Path]) -> None:  # optional hook
        """Take the meshes that objects may have from the next frame on, beside those of `prepare`.

        Called between two frames. What is computed follows from the frame and from these meshes alone,
        whichever there were before.

        Args:
            meshes: Files by asset name, all of them; those that are not here any more are gone.

        Raises:
            AssetError: A file cannot be read; the run has looked into it before.
        """

    def mesh_refused(self, digest: str, reason: str) -> None:  # optional hook
        """Worlds: note that a mesh is not used; objects that have it are boxes.

        Args:
            digest: SHA-256 of the file; empty: none of those that were announced together is used.
            reason: Why.
        """

    @property
    def parts(self) -> Mapping[str, frozenset[str]]:
        """Parts of the products that it asks for, by topic; a product without them is refused."""
        found: dict[str, frozenset[str]] = {}
        for entry in self.inputs:
            found[entry.topic] = found.get(entry.topic, frozenset()) | {*entry.parts}
        return found

    def scenery(self) -> Mapping[str, Path | bytes]:
        """Worlds: the scenery that this world brings (clause 4).

        Returns:
            File, or content, by asset name, for example ``{"scenery/town.xml": Path(...)}``.
        """
        return {}

    def prepare(self, preparation: Preparation) -> Prepared:
        """Load, compile and warm up, so that frame 0 is not late.

        Args:
            preparation: Parts in demand, files of the run's scenery, and who produces what.

        Returns:
            Names that the service owns, and notes for the user.

        Raises:
            SetupError: A library or a device is missing.
            AssetError: A file of scenery is wrong.
        """
        return Prepared()

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:  # optional hook
        """Begin an episode. The same arguments lead to the same episode, bit by bit.

        Args:
            episode: Number of the episode from the first one with this ``seed``: as agents choose seeds, it
                need not be the `Frame.episode` of the frames that follow.
            seed: Of the episode.
            t0_ns: Simulated time of frame 0 [ns].
        """

    @abstractmethod
    def step(self, frame: Frame) -> StepResult:
        """Compute this service's part of a frame.

        Args:
            frame: The frame, with its inputs.

        Returns:
            Products by topic, and what is reported beside them.

        Raises:
            CaviarError: The frame cannot be computed; the text names the value at fault and the remedy.
        """

    def checkpoint(self) -> bytes:
        """The state after the last frame, from which `restore` continues with the same bytes.

        Returns:
            Bytes, as `checkpoint.saved` makes them.
        """
        raise NotImplementedError(f"{type(self).__name__} has no state to save")

    def restore(self, state: bytes) -> None:
        """Take over a state that `checkpoint` gave. Called after `reset` of the same episode.

        Args:
            state: The bytes.

        Raises:
            RunError: They are another implementation's, or of another scenario (`checkpoint.restored`).
        """
        raise NotImplementedError(f"{type(self).__name__} has no state to restore")

    def release_memory(self) -> None:  # optional hook
        """Give back buffers that are kept for reuse. Called now and then between frames."""

    def end_episode(self, frames: int) -> None:  # optional hook
        """Note the end of an episode.

        Args:
            frames: Number of frames that it had.
        """

    def close(self) -> None:  # optional hook
        """Release what is held. Called once, also after an error."""


T = TypeVar("T")


def returned(cls: type[T], value: object, service: object, method: str) -> T:
    """What a method of a service returned, where it is what it has to be.

    Args:
        cls: What it has to be.
        value: What it returned.
        service: The service.
        method: Name of the method.

    Raises:
        PayloadError: It is something else; the text has class and method.

    Example:
        >>> from caviar_services.service import StepResult
        >>> returned(StepResult, None, object(), "step")
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.PayloadError: object.step returned None; return a StepResult
    """
    if not isinstance(value, cls):
        author = f"{type(service).__name__}.{method}"
        raise PayloadError(f"{author} returned {reprlib.repr(value)}; return a {cls.__name__}")
    return value


def series_of(cls: type[T], author: str, values: object) -> list[T]:
    """List the items that a method returned.

    Args:
        cls: What each has to be.
        author: What the method is called in errors: ``Mine.objects_at``.
        values: What it returned.

    Raises:
        PayloadError: It is no series of these; the text has author, value and remedy.

    Example:
        >>> series_of(str, "M.prefixes", "car.")
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.PayloadError: M.prefixes returned 'car.'; return a list of str, or yield them
    """
    # A text is a series of texts, and never what is meant.
    if not isinstance(values, Iterable) or isinstance(values, str | bytes):
        raise PayloadError(
            f"{author} returned {reprlib.repr(values)}; return a list of {cls.__name__}, or yield them"
        )
    found = list(values)
    for item in found:
        if not isinstance(item, cls):
            raise PayloadError(
                f"{author} returned {reprlib.repr(item)} among others; the items have to be {cls.__name__}"
            )
    return found
