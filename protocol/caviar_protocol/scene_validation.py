"""Validation of a `Scene`: names, prefixes, meshes, devices, and the numbers of its objects.

Each function looks at one aspect and returns what is wrong there, as a phrase for an error, or an empty
string. `caviar_protocol.validation` applies them to every scene that a service consumes.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import cast

import msgspec
import numpy as np

from caviar_protocol.arrays import MAX_COORDINATE_M, BoolArray, Float64Array
from caviar_protocol.assets import is_mesh_name
from caviar_protocol.fields import PRINTABLE
from caviar_protocol.scenario.schema import DeviceSpec, carries, fixed_device, mounted_device, turned_back
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics.scene import AntennaDevice, Device, Scene

UNIT_TOLERANCE = 1e-3
"""By how much the norm of a unit quaternion may differ from 1: room for single precision, and no more than
0.02 dB in a gain."""
MAX_SPEED = SPEED_OF_LIGHT
"""[m/s]; every object, and every corner of one that turns, is slower."""
MAX_DIMENSION_M = 1e5
"""[m] of a side of a bounding box."""
FEW_OBJECTS = 8
"""Up to which Python's own numbers are quicker than NumPy's."""
MOUNT_TOLERANCE = {"rel_tol": 1e-5, "abs_tol": 1e-3}
"""Of numbers of a device against those of the scenario: [m], [rad], [dBm], [wavelengths]."""
SAME_ROTATION = 1e-6
"""1 − |⟨p, q⟩| of two unit quaternions that count as one rotation: 0.16°."""


_is_printable = re.compile(PRINTABLE).search


class SceneRules(msgspec.Struct, frozen=True, kw_only=True):
    """Rules for the scenes of the run's worlds; what is not known is not checked.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> scene = Recording("runs/smoke-20261122-101500")["scene"][0]
        >>> wrong_description(scene, "world", SceneRules(prefixes={"world": ("bus.",)}))
        "'car' has none of the prefixes that READY declared: 'bus.'"
    """

    prefixes: Mapping[str, tuple[str, ...]] = {}
    """By world: what the names of its objects and fixed devices begin with."""
    devices: Mapping[str, tuple[DeviceSpec, ...]] = {}
    """By world: the devices of the scenario that it publishes."""
    assets: frozenset[str] | None = None
    """Names of the files of scenery of the run."""


# --- numbers, in every frame ------------------------------------------------------------------------


def numbers_are_right(scene: Scene) -> bool:
    """Return whether `wrong_number` would find nothing, for a few microseconds; True is certain, False is
    not.

    A sum of squares bounds every term of it, and is no number where one of them is none.

    Args:
        scene: Of one world.
    """
    count = len(scene.names)
    if count <= FEW_OBJECTS:
        return _few_numbers_are_right(scene)
    orientation = scene.orientation
    # Written so that a NaN fails: a comparison with it is false.
    if not abs(np.vdot(orientation, orientation) - count) <= UNIT_TOLERANCE:
        return False
    # The sum alone would let a squared norm of 1.5 pass beside one of 0.5.
    excess = np.vecdot(orientation, orientation) - 1.0
    turning, dimensions = scene.angular_velocity, scene.dimensions
    return bool(
        # |n − 1| ≤ |n² − 1| for any norm n
        excess.dot(excess) <= UNIT_TOLERANCE**2
        and np.vdot(scene.position, scene.position) <= MAX_COORDINATE_M**2
        and np.vdot(scene.velocity, scene.velocity) < MAX_SPEED**2 / 4
        and np.vdot(dimensions, dimensions) <= MAX_DIMENSION_M**2
        and scene.dimensions.min() > 0
        and (turning is None or np.vdot(turning, turning) * np.vdot(dimensions, dimensions) < MAX_SPEED**2)
    )


def _few_numbers_are_right(scene: Scene) -> bool:
    """The same without NumPy, of which each call costs more than these sums."""
    columns = (scene.orientation, scene.position, scene.velocity, scene.dimensions)
    rows = zip(*[v.tolist() for v in columns], _turning(scene), strict=True)
    for (w, x, y, z), (e, n, u), (ve, vn, vu), (a, b, c), (p, q, r) in rows:
        if not (
            # |n − 1| ≤ |n² − 1| for any norm n
            abs(w * w + x * x + y * y + z * z - 1.0) <= UNIT_TOLERANCE
            and e * e + n * n + u * u <= MAX_COORDINATE_M**2
            # |v| + |ω|·|d| / 2 bounds the speed of every point, as in `_too_fast`; half of it each is enough.
            and ve * ve + vn * vn + vu * vu < MAX_SPEED**2 / 4
            and (p * p + q * q + r * r) * (a * a + b * b + c * c) < MAX_SPEED**2
            and min(a, b, c) > 0.0
            and a + b + c <= MAX_DIMENSION_M
        ):
            return False
    return True


def _turning(scene: Scene) -> Iterable[Sequence[float]]:
    """Angular velocities of the objects [rad/s]."""
    if scene.angular_velocity is None:
        return [(0.0, 0.0, 0.0)] * len(scene.names)
    found: list[list[float]] = scene.angular_velocity.tolist()
    return found


def _too_fast(scene: Scene) -> BoolArray:
    """Objects of which some point may be as fast as light, or whose velocities are not finite."""
    with np.errstate(all="ignore"):
        speed = np.linalg.norm(scene.velocity, axis=1)
        if scene.angular_velocity is not None:
            turning = np.linalg.norm(scene.angular_velocity, axis=1)
            speed = speed + turning * np.linalg.norm(scene.dimensions, axis=1) / 2
    slower: BoolArray = speed < MAX_SPEED
    return ~slower


def wrong_number(scene: Scene) -> str:
    """The first object with an orientation, position, velocity or dimension that cannot be.

    Args:
        scene: Of one world.

    Returns:
        Object, field and value, and what would be right; empty: all are possible.
    """
    return wrong_orientation(scene) or wrong_place(scene) or wrong_dimensions(scene)


def wrong_orientation(scene: Scene) -> str:
    """The first object whose orientation is no unit quaternion."""
    # Values may be anything here, and numbers that overflow are what is looked for.
    with np.errstate(all="ignore"):
        norms = np.linalg.norm(scene.orientation, axis=1)
        wrong = ~(abs(norms - 1) <= UNIT_TOLERANCE)
    return _first(scene, wrong, "orientation", scene.orientation, lambda i: _not_unit(norms[i]))


def wrong_place(scene: Scene) -> str:
    """The first object whose position or motion is not finite, or absurd."""
    far, bounds = _beyond(scene.position, MAX_COORDINATE_M), f"at most {MAX_COORDINATE_M:g} m from the origin"
    needed = f"m: finite numbers, {bounds}, are needed"
    return _first(scene, far, "position", scene.position, lambda _: needed) or too_fast(scene)


def too_fast(scene: Scene) -> str:
    """The first object that moves, or of which a corner may move, at the speed of light or faster.

    Args:
        scene: Of one world, or of all.

    Returns:
        Object, field and value, and what would be right; empty: there is none.
    """
    with np.errstate(all="ignore"):
        fast = ~(np.linalg.norm(scene.velocity, axis=1) < MAX_SPEED)
    below = f"m/s: a finite speed below light's, {MAX_SPEED:g} m/s, is needed"
    found = _first(scene, fast, "velocity", scene.velocity, lambda _: below)
    if found or scene.angular_velocity is None:
        return found
    below = f"rad/s: finite numbers are needed, and corners slower than light, {MAX_SPEED:g} m/s"
    return _first(scene, _too_fast(scene), "angular_velocity", scene.angular_velocity, lambda _: below)


def wrong_dimensions(scene: Scene) -> str:
    """The first object with a side that is not above 0, or absurd."""
    wrong = _beyond(scene.dimensions, MAX_DIMENSION_M) | np.any(scene.dimensions <= 0, axis=1)
    bounds = f"m: each has to be above 0 and at most {MAX_DIMENSION_M:g}"
    return _first(scene, wrong, "dimensions", scene.dimensions, lambda _: bounds)


def _beyond(values: Float64Array, limit: float) -> BoolArray:
    """Rows with a value that is none, or beyond the limit."""
    within: BoolArray = np.all(abs(values) <= limit, axis=1)
    return ~within


def _first(
    scene: Scene, wrong: BoolArray, field: str, values: Float64Array, why: Callable[[int], str]
) -> str:
    found = np.flatnonzero(wrong)
    if not len(found):
        return ""
    index = int(found[0])
    return f"object {scene.names[index]!r}: {field} {_numbers(values[index].tolist())} {why(index)}"


def _not_unit(norm: float) -> str:
    return f"has norm {norm:.6g}: a unit quaternion (w, x, y, z) is needed"


def _numbers(values: Iterable[float]) -> str:
    return f"({', '.join(f'{value:.6g}' for value in values)})"


# --- names, meshes and devices, where they changed -----------------------------------------------------


def wrong_description(scene: Scene, world: str, rules: SceneRules) -> str:
    """Error in the names, meshes and devices of a scene.

    Args:
        scene: Of one world.
        world: Name of the world.
        rules: What the run says about its scenes.

    Returns:
        The first thing that is wrong, and what would be right; empty: nothing.
    """
    return (
        wrong_order(scene)
        or wrong_prefix(scene, world, rules)
        or wrong_asset(scene, rules)
        or wrong_device(scene)
        or missing_device(scene, world, rules)
        or wrong_mount(scene, world, rules)
    )


def wrong_order(scene: Scene) -> str:
    """The first name of an object or device that has control characters, occurs twice, or is out of order."""
    devices = [device.name for device in scene.devices]
    return (
        _unsorted("object", scene.names)
        or _unsorted("device", devices)
        or next((f"{name!r} names an object and a device" for name in set(scene.names) & {*devices}), "")
    )


def _unsorted(kind: str, names: Sequence[str]) -> str:
    for name in names:
        if not _is_printable(name):
            return f"{kind} {name!r} has control characters: leave them out"
    for name, following in pairwise(names):
        if name == following:
            return f"two {kind}s are named {name!r}"
        if name > following:
            return f"{kind} {name!r} stands before {following!r}: sort them by the UTF-8 bytes of their names"
    return ""


def wrong_prefix(scene: Scene, world: str, rules: SceneRules) -> str:
    """The first object or fixed device without a prefix that its world declared."""
    prefixes = rules.prefixes.get(world)
    if not prefixes:  # a recorded world declares none: it does not know the names of all its frames
        return ""
    fixed = [device.name for device in scene.devices if not device.parent]
    for name in (*scene.names, *fixed):
        if not name.startswith(prefixes):
            return f"{name!r} has none of the prefixes that READY declared: {', '.join(map(repr, prefixes))}"
    return ""


def wrong_asset(scene: Scene, rules: SceneRules) -> str:
    """The first object with a mesh that no world offered."""
    if rules.assets is None:
        return ""
    for name, asset in zip(scene.names, scene.assets, strict=True):
        # A mesh that was announced while the run went on, or refused then: its object is a box without it.
        if asset and asset not in rules.assets and not is_mesh_name(asset):
            return f"object {name!r}: mesh {asset!r} was never offered; an empty name stands for a box"
    return ""


def wrong_device(scene: Scene) -> str:
    """The first device whose parent, name, pose or range cannot be."""
    # Looked up for each device.
    names = set(scene.names)
    return next((found for device in scene.devices if (found := _wrong_device(device, names))), "")


def _wrong_device(device: Device, objects: set[str]) -> str:
    what = f"device {device.name!r}:"
    if device.parent and device.parent not in objects:
        return f"{what} parent {device.parent!r} is no object of the scene"
    if device.parent and not device.name.startswith(f"{device.parent}/"):
        return f"{what} on {device.parent!r}, its name has to be {device.parent}/NAME"
    return _wrong_device_number(device)


def wrong_device_number(scene: Scene) -> str:
    """The first device with a pose or another number that cannot be."""
    return next((found for device in scene.devices if (found := _wrong_device_number(device))), "")


def _wrong_device_number(device: Device) -> str:
    what = f"device {device.name!r}:"
    for field in device.__struct_fields__:
        value = getattr(device, field)
        if not isinstance(value, float | tuple):
            continue
        numbers = value if isinstance(value, tuple) else (value,)
        if not all(math.isfinite(number) for number in numbers if isinstance(number, float)):
            return f"{what} {field} {_numbers(numbers)} is not finite"
    if isinstance(device, AntennaDevice):
        panels = [(*p.position_m, p.yaw_deg, p.pitch_deg, p.roll_deg) for p in device.array.panels]
        numbers = (device.array.vertical_spacing, device.array.horizontal_spacing, *itertools.chain(*panels))
        if not all(abs(number) <= MAX_COORDINATE_M for number in numbers):
            return f"{what} spacings and panels of its array {_numbers(numbers)} are no numbers up to 1e9"
    if max(map(abs, device.position)) > MAX_COORDINATE_M:
        return f"{what} position {_numbers(device.position)} m: at most {MAX_COORDINATE_M:g} m are possible"
    norm = math.hypot(*device.orientation)
    if not abs(norm - 1) <= UNIT_TOLERANCE:
        return f"{what} orientation {_numbers(device.orientation)} {_not_unit(norm)}"
    return ""


def missing_device(scene: Scene, world: str, rules: SceneRules) -> str:
    """The first device of the scenario that is not there, or on too few or too many objects."""
    published = {device.name for device in scene.devices}
    for spec in rules.devices.get(world, ()):
        if not spec.on:
            if spec.name not in published:
                return f"device {spec.name!r} of the scenario is missing"
            continue
        # Objects come and go; the world may choose which of the matching ones carry it.
        able = [name for name in scene.names if carries(spec, name)]
        carriers = sum(f"{name}/{spec.name}" in published for name in able)
        due = min(spec.count, len(able))
        if carriers != due:
            return (
                f"device {spec.name!r} of the scenario is on {carriers} objects: {due} of {len(able)} that "
                f"match on = {spec.on!r} carry it ({able[0]!r}, …; count = {spec.count})"
            )
    return ""


def wrong_mount(scene: Scene, world: str, rules: SceneRules) -> str:
    """The first device that is not mounted, or not made, as the scenario says."""
    published = {device.name: device for device in scene.devices}
    pairs = (pair for spec in rules.devices.get(world, ()) for pair in _as_published(spec, scene, published))
    return next((found for right, device in pairs if (found := _difference(right, device))), "")


def _as_published(
    spec: DeviceSpec, scene: Scene, published: Mapping[str, Device]
) -> Iterator[tuple[Device, Device]]:
    """The device by the scenario, and as it is published, on each object that carries it."""
    if not spec.on and spec.name in published:
        yield fixed_device(spec), published[spec.name]
    for index, name in enumerate(scene.names):
        device = published.get(f"{name}/{spec.name}")
        if device is not None and carries(spec, name):
            x, y, z = scene.dimensions[index].tolist()
            right = mounted_device(spec, name, (x, y, z))
            if spec.keeps_heading:
                right = turned_back(right, scene.orientation[index].tolist())
            yield right, device


def _difference(right: Device, device: Device) -> str:
    """The first field of a device that is not as the scenario says."""
    if device == right:  # as our worlds publish it, to the bit; what follows costs a hundred times as much
        return ""
    if type(device) is not type(right):
        return f"device {device.name!r} is of another kind than the scenario's"
    # q and −q are one rotation, so numbers alone would differ.
    cosine = sum(a * b for a, b in zip(right.orientation, device.orientation, strict=True))
    if abs(cosine) < 1 - SAME_ROTATION:
        return _not_as(device, "orientation", device.orientation, right.orientation)
    for field in right.__struct_fields__:
        if field != "orientation" and (
            found := _first_difference(field, getattr(right, field), getattr(device, field))
        ):
            return _not_as(device, *found)
    return ""


def _first_difference(key: str, expected: object, got: object) -> tuple[str, object, object] | None:
    """Dotted key of the first value that differs, the value, and the scenario's; None: all are equal, but for
    how a client rounds numbers."""
    if isinstance(expected, msgspec.Struct) and type(got) is type(expected):
        fields = expected.__struct_fields__
        found = (_first_difference(f"{key}.{f}", getattr(expected, f), getattr(got, f)) for f in fields)
        return next(filter(None, found), None)
    return None if _nearly_equal(expected, got) else (key, got, expected)


def _nearly_equal(expected: object, got: object) -> bool:
    """Equal, but for how a client rounds numbers."""
    if isinstance(expected, float) and isinstance(got, float):
        return math.isclose(expected, got, **MOUNT_TOLERANCE)
    if isinstance(expected, tuple) and isinstance(got, tuple):
        return len(expected) == len(got) and all(map(_nearly_equal, expected, got))
    if isinstance(expected, msgspec.Struct) and isinstance(got, msgspec.Struct):
        return _nearly_equal(msgspec.structs.astuple(expected), msgspec.structs.astuple(got))
    return expected == got


def _not_as(device: Device, field: str, got: object, expected: object) -> str:
    return f"device {device.name!r}: {field} {_text_of(got)}, by the scenario it is {_text_of(expected)}"


def _text_of(value: object) -> str:
    is_numbers = isinstance(value, tuple) and value and all(isinstance(v, float | int) for v in value)
    return _numbers(cast(tuple[float, ...], value)) if is_numbers else repr(value)
