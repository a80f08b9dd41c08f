"""Cases of what the scenes of a world and the channels of a channel say, each of one aspect."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING, Any, cast

import msgspec
import numpy as np

from caviar_clients.conform import street
from caviar_clients.conform.case import Case, Failed, NotApplicable, case
from caviar_clients.conform.session import ACTIVE, Session, known_parts
from caviar_protocol import scene_validation as scenes
from caviar_protocol.arrays import Float64Array
from caviar_protocol.codec import decode_payload
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scene_validation import SceneRules
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.topics import Carrier, Channel, Scene
from caviar_protocol.topics.channel import PLANE_WAVES
from caviar_protocol.validation import PartCheck

if TYPE_CHECKING:
    from caviar_clients.conform.kit import Kit

FRAMES = 4
AMBIGUOUS_RAD = 2.5
"""Between two frames; behind half a turn the other way is the shorter one."""
TURN_TOLERANCE, SLIGHT_RAD = 0.5, 0.01
"""Of an angular velocity: worlds take it between two frames, at one of them, or of their engine."""
PART_TOLERANCE = 1e-3
"""Relative, of the norm of a matrix: far above single precision, and of what models leave out."""
CLAUSES = "Content"


def _published(kit: Kit) -> tuple[Session, list[Scene]]:
    """The scenes of some frames of a world."""
    session = kit.at(ACTIVE)
    if "scene" not in session.hello.get("outputs", []):
        raise NotApplicable("it publishes no scene")
    found = []
    for _ in range(FRAMES):
        answer = session.step()
        topics = [entry["topic"] for entry in answer.fields.get("products", [])]
        if "scene" not in topics:
            raise Failed("a scene in each frame", f"none in frame {answer.fields['frame']}")
        place = 1 + 2 * topics.index("scene")
        payload = decode_payload("scene", *answer.parts[place : place + 2])
        found.append(cast(Scene, payload))
    return session, found


def _rules(session: Session) -> SceneRules:
    """What consumers of this world are told about it."""
    name = session.hello["name"]
    devices = msgspec.convert(street.briefing(session.hello)["devices"], tuple[DeviceSpec, ...])
    return SceneRules(
        prefixes={name: tuple(session.ready.get("prefixes", ()))},
        devices={name: devices},
        assets=frozenset(session.offered),
    )


def _aspect(name: str, title: str, expected: str, wrong: Callable[[Scene, str, SceneRules], str]) -> Case:
    """A case that fails where ``wrong`` finds something in one of some scenes."""

    def run(kit: Kit) -> str:
        session, found = _published(kit)
        world, rules = session.hello["name"], _rules(session)
        for frame, scene in enumerate(found, session.frame - len(found)):
            if problem := wrong(scene, world, rules):
                raise Failed(expected, f"in frame {frame}: {problem}")
        return f"so in {len(found)} frames, with {len(found[-1].names)} objects"

    run.__doc__ = title
    return case(name, CLAUSES, expected)(run)


orientations = _aspect(
    "scene-orientations",
    "Orientations of objects are unit quaternions.",
    "quaternions (w, x, y, z) of norm 1 ± 0.001",
    lambda scene, world, rules: scenes.wrong_orientation(scene),
)
places = _aspect(
    "scene-places",
    "Positions and velocities are finite, and possible.",
    "finite positions [m] and velocities [m/s] below light's",
    lambda scene, world, rules: scenes.wrong_place(scene),
)
dimensions = _aspect(
    "scene-dimensions",
    "Bounding boxes have an extent.",
    "length, width and height [m] above 0",
    lambda scene, world, rules: scenes.wrong_dimensions(scene),
)
names = _aspect(
    "scene-names",
    "Objects and devices are sorted by name, and each name is there once.",
    "names in ascending order of their UTF-8 bytes, none of them twice",
    lambda scene, world, rules: scenes.wrong_order(scene),
)
prefixes = _aspect(
    "scene-prefixes",
    "Names begin with what READY declared.",
    "names of objects and of fixed devices with a prefix of READY",
    scenes.wrong_prefix,
)
meshes = _aspect(
    "scene-meshes",
    "Meshes of objects were offered.",
    "`assets` that are names of ASSET_OFFER, or empty",
    lambda scene, world, rules: scenes.wrong_asset(scene, rules),
)
devices = _aspect(
    "scene-devices",
    "The devices of WELCOME are there, each on as many objects as it may.",
    "each device of WELCOME, on `count` of the objects that match `on`, or on all where they are fewer",
    scenes.missing_device,
)
poses = _aspect(
    "scene-device-poses",
    "Devices have a parent that is there, a name of its own, and a pose that can be.",
    "`parent` among the objects, the name `<parent>/<name>`, a unit quaternion",
    lambda scene, world, rules: scenes.wrong_device(scene),
)
mounts = _aspect(
    "scene-mounts",
    "Devices are mounted, turned and made as WELCOME says.",
    "pose, array, power and optics of WELCOME, at the mount point of the parent's bounding box",
    scenes.wrong_mount,
)


@case("scene-carriers", CLAUSES, "a device stays where it is, as long as that object is there")
def carriers(kit: Kit) -> str:
    """An object that carries a device keeps it."""
    _, found = _published(kit)
    for before, after in pairwise(found):
        there = {device.name for device in after.devices}
        for device in before.devices:
            if device.name not in there and device.parent in after.names:
                raise Failed(
                    f"{device.name!r} in each frame with {device.parent!r}",
                    "a frame in which it is not there",
                )
    return f"{len(found[-1].devices)} devices, in {len(found)} frames"


@case("scene-turning", "Worlds", "`angular_velocity` in world axes [rad/s] by which orientations turn")
def turning(kit: Kit) -> str:
    """Objects turn from frame to frame as their angular velocity says."""
    _, found = _published(kit)
    compared = 0
    for before, after in pairwise(found):
        if before.angular_velocity is None or after.angular_velocity is None:
            continue
        for name in set(before.names) & set(after.names):
            i, j = before.names.index(name), after.names.index(name)
            turned = _rotation(before.orientation[i], after.orientation[j])
            stated = (before.angular_velocity[i] + after.angular_velocity[j]) / 2 * street.PERIOD_NS / 1e9
            largest = max(np.linalg.norm(turned), np.linalg.norm(stated))
            if np.linalg.norm(turned) > AMBIGUOUS_RAD:
                continue
            compared += 1
            if np.linalg.norm(turned - stated) > TURN_TOLERANCE * largest + SLIGHT_RAD:
                per_s = turned / (street.PERIOD_NS / 1e9)
                raise Failed(
                    f"an angular velocity of {name!r} of about {_shown(per_s)} rad/s, by its orientations",
                    _shown(stated / (street.PERIOD_NS / 1e9)),
                )
    if not compared:
        raise NotApplicable("it gives no angular velocity")
    return f"so in {compared} steps of objects"


def _rotation(before: Float64Array, after: Float64Array) -> Float64Array:
    """Rotation vector [rad] in world axes that turns one orientation into another."""
    turn = rotation_matrix(after.tolist()) @ rotation_matrix(before.tolist()).T
    cosine = np.clip((np.trace(turn) - 1) / 2, -1, 1)
    angle = np.arccos(cosine)
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    length = np.linalg.norm(axis)
    vector: Float64Array = axis * (angle / length) if length > 0 else np.zeros(3)
    return vector


def _shown(vector: Float64Array) -> str:
    return f"({', '.join(f'{value:.3g}' for value in vector)})"


@case(
    "channel-parts", CLAUSES, "each part in demand, for each carrier that has it and each pair, of its shape"
)
def parts(kit: Kit) -> str:
    """A channel delivers the parts that PREPARE asks for, as large as carriers and arrays say."""
    session, _, channel = _channel(kit)
    briefing = street.briefing(session.hello)
    carriers = msgspec.convert(briefing["carriers"], tuple[Carrier, ...])
    devices = msgspec.convert(briefing["devices"], tuple[DeviceSpec, ...])
    asked = frozenset(known_parts("channel", session.hello))
    if problem := PartCheck({"channel": asked}, carriers, devices)("channel", channel):
        raise Failed(f"parts {', '.join(sorted(asked))}", problem)
    return ", ".join(f"{len(getattr(channel, part))} of {part}" for part in sorted(asked))


@case(
    "channel-consistency", "Payloads", "`h`, `hf` and `taps` that follow from each other and from the paths"
)
def consistency(kit: Kit) -> str:
    """The parts of a channel say the same as its paths, where arrays see plane waves."""
    _, scene, channel = _channel(kit)
    whole = {(entry.carrier, entry.tx, entry.rx): entry.h for entry in channel.h}
    for entry in channel.hf:
        middle = entry.h[0, channel.carriers[entry.carrier].subcarriers // 2]
        _compare("hf of the middle subcarrier in slot 0", middle, whole[entry.carrier, entry.tx, entry.rx])
    if channel.rung not in PLANE_WAVES:
        return f"hf agrees with h; {channel.rung!r} has no plane waves"
    for part, expected in street.parts_of(channel, scene).items():
        for mine, right in zip(getattr(channel, part), expected, strict=False):
            if part == "taps" and mine.first != right.first:
                raise Failed(f"taps from sample {right.first} on", f"from {mine.first}")
            _compare(part, mine.h, right.h)
    return "all parts follow from the paths"


def _channel(kit: Kit) -> tuple[Session, Scene, Channel]:
    """The channel of a frame of a client, and the scene that it is of."""
    session = kit.at(ACTIVE)
    if "channel" not in session.hello.get("outputs", []):
        raise NotApplicable("it makes no channel")
    frame = session.frame
    answer = session.step()
    topics = [entry["topic"] for entry in answer.fields.get("products", [])]
    if "channel" not in topics:
        raise Failed("a channel", f"none in frame {frame}")
    place = 1 + 2 * topics.index("channel")
    channel = cast(Channel, decode_payload("channel", *answer.parts[place : place + 2]))
    return (
        session,
        cast(Scene, decode_payload("scene", *street.product("scene", street.WORLD, frame))),
        channel,
    )


def _compare(what: str, got: Any, right: Any) -> None:
    off = float(np.linalg.norm(got - right) / max(float(np.linalg.norm(right)), 1e-30))
    if not off <= PART_TOLERANCE:
        raise Failed(f"{what} that follows from the rest", f"one that differs by {off:.2g} of its norm")


CASES = (
    orientations,
    places,
    dimensions,
    names,
    prefixes,
    meshes,
    devices,
    poses,
    mounts,
    carriers,
    turning,
    parts,
    consistency,
)
