"""What every virtual world does: names, mounted devices, scenery, and the ``scene`` payload.

To add a world, such as a traffic model or a game engine, subclass `World`, say in `objects_at` where things
are, and register the class.
"""

from __future__ import annotations

import math
import re
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from itertools import pairwise, product
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple, TypeVar

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, quantity
from caviar_protocol.assets import is_mesh_name
from caviar_protocol.errors import AssetError, PayloadError, RunError, ScenarioError, SetupError
from caviar_protocol.fields import PRINTABLE
from caviar_protocol.messages import Role
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.scenario.schema import carries, fixed_device, mounted_device, turned_back
from caviar_protocol.space.coordinates import UnitQuaternion, Vector
from caviar_protocol.topics import Scene
from caviar_protocol.topics.scene import WITHOUT_OBJECT_PREFIX, Device
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, Service, StepResult, series_of
from caviar_services.world.assets import RunTimeMeshes, object_assets, pattern_assets
from caviar_space.scenery import scenery_assets, scenery_file


class ObjectState(NamedTuple):
    """One object at one instant.

    Example:
        >>> level, still = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        >>> ObjectState("car.1", "car", (0.0, 0.0, 0.75), level, still, (4.6, 1.9, 1.5)).class_
        'car'
    """

    name: str
    class_: str
    """``car``, ``truck``, ``bus``, ``uav``, ``pedestrian``, …"""
    position: Vector
    """Centre of the bounding box [m]."""
    orientation: UnitQuaternion
    velocity: Vector
    """[m/s], world axes."""
    dimensions: Vector
    """Length (x), width (y), height (z) [m]."""
    angular_velocity: Vector | None = None
    """[rad/s], world axes, right-handed; None: it does not turn, or how is not known."""
    mesh: str = ""
    """Its own mesh, by the name that `World.add_mesh` returned or that it has in `World.scenery`; empty: that
    of its class, or a box."""


class WorldSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings that all worlds share."""

    prefix: (
        Annotated[str, quantity("1", "what the names of its objects begin with", pattern=PRINTABLE)] | None
    ) = None
    """Unset: the world chooses. No two worlds of a run may share a prefix."""
    scenery: str = ""
    """Static geometry that this world brings: ``sionna:munich`` (a scene that comes with
    sionna-rt), ``file:city.xml`` (a Mitsuba XML), or empty: none."""


W = TypeVar("W", bound=WorldSettings)
_Listed = tuple[list[tuple[str, str, str]], tuple[str, ...], tuple[str, ...], tuple[str, ...]]


class World(Service[W]):
    """Base of all worlds: turns object states into the frame's `Scene`.

    A subclass implements `begin` and `objects_at`, and says with `prefixes` and `mesh_classes` what it may
    bring.

    Args:
        settings: Prefix of object names, and the scenery.
        run: What the world knows about the run; ``run.devices`` are those that it publishes.

    Example:
        >>> class Still(World[WorldSettings]):
        ...     def prefixes(self):
        ...         return ("car.",)
        ...
        ...     def mesh_classes(self):
        ...         return ("car",)
        ...
        ...     def begin(self, episode, seed):
        ...         pass
        ...
        ...     def objects_at(self, elapsed_ns):
        ...         at, level, still = (0.0, 0.0, 0.75), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        ...         yield ObjectState("car.1", "car", at, level, still, (4.6, 1.9, 1.5))
        >>> world = Still(WorldSettings(), RunInfo(name="world"))
        >>> world.reset(0, 1, 0)
        >>> world.step(Frame(episode=0, number=0, t_ns=0)).products["scene"].names
        ('car.1',)
    """

    role: ClassVar[Role] = "world"
    Settings: ClassVar[type[msgspec.Struct]] = WorldSettings
    outputs: ClassVar[tuple[str, ...]] = ("scene",)

    @classmethod
    def check_settings(cls, settings: W, place: Place) -> None:
        """Raise `ScenarioError` for scenery that is not there."""
        try:
            if settings.scenery:
                scenery_file(settings.scenery)
        except AssetError as error:
            raise place.at("scenery").error(str(error)) from error
        except SetupError:
            pass  # the world says so where it runs, which may be another machine

    def __init__(self, settings: W, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._mounts = Mounts(run.devices)
        self._t0_ns = 0
        # Names and classes of the objects of the last frame; their names, classes and assets as published.
        self._listed: _Listed = ([], (), (), ())
        self._meshes = RunTimeMeshes(run.again)

    @classmethod
    def placements(cls, settings: W) -> Iterable[tuple[str, str, Sequence[Vector]]]:
        """Where settings put objects, for a warning of implausible positions before the run.

        Args:
            settings: The settings of the world.

        Returns:
            Key within the settings, name of the object, and positions [m] in world axes, for each object;
            nothing where the world learns positions from elsewhere.
        """
        return ()

    @classmethod
    def known_objects(cls, settings: W) -> Mapping[str, str] | None:
        """Class of each object that may come, by name; None where they are not known before the run.

        Args:
            settings: The settings of the world.
        """
        return None

    @abstractmethod
    def prefixes(self) -> tuple[str, ...]:
        """What the names of this world's objects begin with; whole names where they are known.

        The broker refuses a run in which two worlds share a prefix (contract, clause 3).
        """

    @abstractmethod
    def mesh_classes(self) -> tuple[str, ...]:
        """Classes published with a mesh of their own (`shapes.SHAPES`); the others are boxes."""

    @abstractmethod
    def begin(self, episode: int, seed: int) -> None:
        """Go to the state that objects have at the start of an episode.

        Args:
            episode: Number of the episode from the first one with this seed.
            seed: Of the episode; equal arguments lead to equal scenes, bit by bit.
        """

    @abstractmethod
    def objects_at(self, elapsed_ns: int) -> Iterable[ObjectState]:
        """The objects at an instant.

        Args:
            elapsed_ns: Time from the episode's start [ns]. It never decreases within an episode; a world
                steps the whole way to it.

        Returns:
            One `ObjectState` an object, those that came first in front.

        Raises:
            RunError: The simulation behind the world has failed.
        """

    def scenery(self) -> Mapping[str, Path | bytes]:
        """Find the files that this world brings.

        Returns:
            File, or content, by asset name: the XML and the files it names, the meshes of the objects that
            may come, and the pattern files of antennas.

        Raises:
            AssetError: A file is missing or wrong.
            ScenarioError: The pattern file of a device is wrong; names its key.
        """
        classes = series_of(str, f"{type(self).__name__}.mesh_classes", self.mesh_classes())
        return {
            **scenery_assets(self.settings.scenery),
            **object_assets(classes),
            **pattern_assets(self.run.devices),
        }

    def prepare(self, preparation: Preparation) -> Prepared:
        """Declare the names: prefixes of objects, and fixed devices by their whole name.

        Raises:
            ScenarioError: A device is mounted on an object that can never come; names its key.
        """
        series_of(str, f"{type(self).__name__}.prefixes", self.prefixes())
        # Refuse a device on an object that can never come.
        # It would be missing in each frame, which looks like bad coverage.
        objects, prefixes = self.known_objects(self.settings), self.prefixes()
        known = prefixes if objects is None else tuple(objects)
        for spec in self.run.devices:
            if not spec.on:
                continue
            if objects is not None:
                possible = any(carries(spec, name) for name in objects)
                others = f"its objects are {', '.join(sorted(objects)) or 'none'}"
            else:
                possible = any(_may_begin(spec.on, prefix) for prefix in prefixes)
                others = f"their names begin with {', '.join(prefixes)}"
            if not possible:
                near = get_close_matches(spec.on, known, n=1)
                meant = f"did you mean {near[0]!r}? " if near else ""
                raise ScenarioError(
                    f"device {spec.name!r} stands on {spec.on!r}, which no object of world "
                    f"{self.run.name!r} can be: {meant}{others}",
                    key=Place("devices").at(spec.name).at("on").key,
                )
        self._meshes.max_faces = preparation.max_faces
        scenery = self.settings.scenery or "none"
        return Prepared(
            prefixes=tuple(sorted({*self.prefixes(), *self._mounts.fixed_names})),
            notes=(f"scenery: {scenery}",),
        )

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Begin an episode; the same arguments lead to the same scenes, bit by bit."""
        self._t0_ns = t0_ns
        self._mounts.clear()
        self._meshes.reset()
        self.begin(episode, seed)

    def step(self, frame: Frame) -> StepResult:
        """The scene at the frame's instant."""
        objects = self.objects_at(frame.t_ns - self._t0_ns)
        states = series_of(ObjectState, f"{type(self).__name__}.objects_at", objects)
        scene = self._scene(states)
        counts = {f"{WITHOUT_OBJECT_PREFIX}{name}": 1 for name in self._mounts.without_object}
        # Counted in the run's summary.
        if not self.changes_geometry:
            return StepResult(products={"scene": scene}, counts=counts)
        meshes = self._meshes.at(frame.number, {state.mesh for state in states if state.mesh})
        return StepResult(products={"scene": scene}, counts={**counts, **self._meshes.counts}, meshes=meshes)

    def add_mesh(self, content: bytes) -> str:
        """Bring a mesh while the run goes on, of a world with ``changes_geometry``.

        It is there from the frame that is computed next, or now, for as long as an object has it, and
        `RunTimeMeshes.LINGER_FRAMES` longer. Adding one that is there changes nothing.

        Args:
            content: A PLY file of a unit mesh, as `caviar_space.meshes.ply` makes it of what `fitted`
                returns.

        Returns:
            Its name, for `ObjectState.mesh`.

        Raises:
            RunError: The class does not say ``changes_geometry = True``.
        """
        if not self.changes_geometry:
            raise RunError(
                f"{type(self).__name__} brings a mesh while the run goes on: write changes_geometry = True "
                "in the class"
            )
        return self._meshes.add(content)

    def mesh_refused(self, digest: str, reason: str) -> None:
        """Note that a mesh is not used; its objects are boxes.

        Args:
            digest: SHA-256 of the file; empty: of none.
            reason: Why.
        """
        self._meshes.refuse(digest, reason)

    def _scene(self, states: list[ObjectState]) -> Scene:
        # Before they are sorted: devices go to the objects that came first, which a world lists in front.
        devices = self._mounts.devices([(state.name, state.dimensions) for state in states])
        devices = self._mounts.turned_back(devices, {state.name: state for state in states})
        states = sorted(states, key=lambda state: state.name)
        listed = [(state.name, state.class_, state.mesh) for state in states]
        # Objects hardly ever come and go: what follows from names and classes alone is kept.
        if listed != self._listed[0]:
            self._listed = listed, *self._described(listed)
        _, names, classes, assets = self._listed
        tables = _tables(states)
        turning = tables["angular_velocity"]
        return Scene(
            names=names,
            classes=classes,
            assets=assets,
            position=tables["position"],
            orientation=tables["orientation"],
            velocity=tables["velocity"],
            dimensions=tables["dimensions"],
            devices=devices,
            # Left out where nothing turns, so that such scenes stay as short.
            angular_velocity=turning if turning.any() else None,
        )

    def _described(
        self, listed: Sequence[tuple[str, str, str]]
    ) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
        """Names, classes and assets of objects by name, class and own mesh, sorted."""
        # Sorted, so neighbours: consumers look objects up by name, and would take one of the two.
        names = tuple(name for name, *_ in listed)
        if len(set(names)) < len(names):
            twice = next(name for name, following in pairwise(names) if name == following)
            raise PayloadError(f"world {self.run.name!r} has two objects named {twice!r}")
        # They stand in tables, logs and file names.
        if odd := next((name for name in names if not re.search(PRINTABLE, name)), None):
            raise PayloadError(
                f"world {self.run.name!r} has an object named {odd!r}; leave out the control characters"
            )
        for name, class_, mesh in listed:
            for field, value in (("class_", class_), ("mesh", mesh)):
                if not isinstance(value, str):
                    raise PayloadError(f"object {name!r}: {field} is {value!r}; give it a str")
        meshes = set(self.mesh_classes())
        assets = tuple(
            # A run may take no meshes that come while it goes on: their objects then are as if without.
            (mesh if self._meshes.max_faces or not is_mesh_name(mesh) else "")
            or (f"objects/{class_}.ply" if class_ in meshes else "")
            for _, class_, mesh in listed
        )
        return names, tuple(class_ for _, class_, _ in listed), assets


def _may_begin(on: str, prefix: str) -> bool:
    """Whether a name, or one that a pattern matches, may begin with a prefix."""
    literal = re.split(r"[*?[]", on)[0]
    return literal.startswith(prefix) or (literal != on and prefix.startswith(literal))


_WIDTHS = {"position": 3, "orientation": 4, "velocity": 3, "dimensions": 3, "angular_velocity": 3}
_STILL = (0.0, 0.0, 0.0)


def _tables(states: Sequence[ObjectState]) -> dict[str, Float64Array]:
    """Tables of the fields that are numbers, one row an object; raises `PayloadError` for others."""
    lists: list[list[float]] = [[] for _ in _WIDTHS]
    position, orientation, velocity, dimensions, turning = lists
    try:
        for state in states:
            position += state.position
            orientation += state.orientation
            velocity += state.velocity
            dimensions += state.dimensions
            turning += _STILL if state.angular_velocity is None else state.angular_velocity
        # One array of all numbers, cut up. + 0.0: −0 and 0 are equal, so must their bytes be.
        numbers = np.array(position + orientation + velocity + dimensions + turning, dtype="<f8") + 0.0
    except (TypeError, ValueError) as error:
        raise _wrong(states) from error
    count, tables, begin = len(states), {}, 0
    if not np.isfinite(numbers).all() or [len(row) for row in lists] != [n * count for n in _WIDTHS.values()]:
        raise _wrong(states)
    for field, width in _WIDTHS.items():
        tables[field] = numbers[begin : begin + count * width].reshape(count, width)
        begin += count * width
    return tables


def _wrong(states: Sequence[ObjectState]) -> PayloadError:
    """The error that names the first value of an object that is no row of numbers."""
    values = ((state.name, field, getattr(state, field)) for state, field in product(states, _WIDTHS))
    name, field, value = next(value for value in values if not _is_row(value[2], value[1]))
    return PayloadError(f"object {name!r}: {field} is {value!r}; give it {_WIDTHS[field]} finite numbers")


def _is_row(value: object, field: str) -> bool:
    if value is None:
        return field == "angular_velocity"
    try:
        row = np.array(value, dtype="<f8")
    except (TypeError, ValueError):
        return False
    return row.shape == (_WIDTHS[field],) and bool(np.isfinite(row).all())


class Mounts:
    """Which devices exist in a frame, and where they are mounted.

    A pattern with ``count`` devices gives them to the objects that came first. An object that has one
    keeps it, since all that came earlier have one too or have left.

    Args:
        specs: Devices that the world publishes.

    Example:
        >>> mounts = Mounts([DeviceSpec(name="rx", kind="antenna", role="rx", on="car.*", count=1)])
        >>> size = (4.6, 1.9, 1.5)
        >>> [device.name for device in mounts.devices([("car.b", size), ("car.a", size)])]
        ['car.b/rx']
    """

    def __init__(self, specs: Sequence[DeviceSpec]) -> None:
        self._fixed = tuple(fixed_device(spec) for spec in specs if not spec.on)
        self._keeping = frozenset(spec.name for spec in specs if spec.keeps_heading)
        self._mounted = tuple(spec for spec in specs if spec.on)
        self._arrived: list[str] = []
        self._objects: Sequence[tuple[str, Vector]] | None = None
        self.without_object: tuple[str, ...] = ()
        """Devices that found no object to stand on in the last frame."""
        # Of the objects of the frame before, which mostly are those of the next one: devices are made anew
        # only when an object comes or goes.
        self._devices: tuple[Device, ...] = ()

    @property
    def fixed_names(self) -> tuple[str, ...]:
        """Names of the devices that stand in the world without a parent."""
        return tuple(device.name for device in self._fixed)

    @property
    def arrived(self) -> tuple[str, ...]:
        """The objects of the last frame, those that came first in front."""
        return tuple(self._arrived)

    def clear(self, arrived: Sequence[str] = ()) -> None:
        """Forget which objects came first: a new episode begins, or continues after a frame.

        Args:
            arrived: Objects of that frame, those that came first in front.
        """
        self._arrived = list(arrived)
        self._objects = None

    def devices(self, objects: Sequence[tuple[str, Vector]]) -> tuple[Device, ...]:
        """Mount the devices of a frame.

        Args:
            objects: Names and dimensions [m] of all objects of the frame. Those that were not there in the
                previous frame count as having come in the given order.

        Returns:
            Devices, sorted by name.
        """
        if objects == self._objects:
            return self._devices
        dimensions = dict(objects)
        known = set(self._arrived)
        self._arrived = [name for name in self._arrived if name in dimensions]
        self._arrived += [name for name, _ in objects if name not in known]
        found, without = list(self._fixed), []
        for spec in self._mounted:
            carriers = [name for name in self._arrived if carries(spec, name)][: spec.count]
            found += [mounted_device(spec, name, dimensions[name]) for name in carriers]
            if not carriers:
                without.append(spec.name)
        self.without_object = tuple(without)
        self._objects, self._devices = objects, tuple(sorted(found, key=lambda device: device.name))
        return self._devices

    def turned_back(
        self, devices: tuple[Device, ...], states: Mapping[str, ObjectState]
    ) -> tuple[Device, ...]:
        """Turn devices that keep their headings against the objects that carry them.

        Args:
            devices: Of the frame, as of `devices`.
            states: Objects of the frame, by name.

        Returns:
            The same devices, in the same order.
        """
        if not self._keeping:
            return devices
        return tuple(
            turned_back(device, states[device.parent].orientation)
            if device.parent and device.name.removeprefix(f"{device.parent}/") in self._keeping
            else device
            for device in devices
        )


# [rad/s]; slower is the rounding of a straight line.
_TURNS = 1e-9

# [m]; a course that bends with a smaller radius is a vehicle that backs, or that stands and is measured with
# noise, and no turn: the rate, which grows without bounds as such a vehicle slows down, would move its
# antennas by kilometres a second.
_TIGHTEST_M = 0.1


def turning(rate: float) -> float:
    """Clear a yaw rate of rounding, so that a scene in which nothing turns says so.

    Args:
        rate: [rad/s]

    Returns:
        The rate; 0 where it is but rounding.

    Example:
        >>> turning(0.3), turning(1e-12)
        (0.3, 0.0)
    """
    return rate if abs(rate) > _TURNS else 0.0


def course_rate(velocity: Sequence[float], acceleration: Sequence[float]) -> float:
    """How fast the horizontal course of a velocity turns: dψ/dt = (vₓ·a_y − v_y·aₓ)/(vₓ² + v_y²).

    Args:
        velocity: [m/s]
        acceleration: [m/s²]

    Returns:
        [rad/s], counter-clockwise; 0 where the course reverses instead of turning (`reverses`): it jumps.

    Example:
        >>> course_rate((10.0, 0.0, 0.0), (0.0, 2.0, 0.0))
        0.2
    """
    if reverses(velocity, acceleration):
        return 0.0
    (vx, vy, _), (ax, ay, _) = velocity, acceleration
    return turning((vx * ay - vy * ax) / (vx * vx + vy * vy))


def reverses(velocity: Sequence[float], acceleration: Sequence[float]) -> bool:
    """Whether a course bends more tightly than a vehicle turns: its radius is v³ / |v × a|.

    Args:
        velocity: [m/s]
        acceleration: [m/s²]

    Example:
        >>> reverses((10.0, 0.0, 0.0), (0.0, 2.0, 0.0)), reverses((1e-4, 0.0, 0.0), (-2.0, 1.0, 0.0))
        (False, True)
    """
    (vx, vy, _), (ax, ay, _) = velocity, acceleration
    return math.hypot(vx, vy) ** 3 < _TIGHTEST_M * abs(vx * ay - vy * ax)
