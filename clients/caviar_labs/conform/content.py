"""Cases of what the scenes of a world and the channels of a channel say, each of one aspect."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, cast

import msgspec
import numpy as np

from caviar_labs.conform import street
from caviar_labs.conform.case import Case, Kit, case
from caviar_labs.conform.client import Failed, NotApplicable
from caviar_labs.conform.session import ACTIVE, Session
from caviar_protocol import scene_validation as scenes
from caviar_protocol.arrays import Float64Array
from caviar_protocol.codec import decode_payload
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scene_validation import SceneRules
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.topics import Carrier, Channel, Scene
from caviar_protocol.topics.channel import PLANE_WAVES
from caviar_protocol.validation import PartCheck

FRAMES = 4
# Between two frames [rad]: beyond half a turn (π) the other way round is the shorter one, and the rotation
# between two orientations does not say which of them the object took.
AMBIGUOUS_RAD = 2.5
# Of an angular velocity, relative and [rad]: a world takes it between two frames, at one of them, or from its
# engine, and an object that begins to turn has half of it on average.
TURN_TOLERANCE, SLIGHT_RAD = 0.5, 0.01
# Of the norm of a matrix: far above single precision (6e-8), and above the paths that a model leaves out.
PART_TOLERANCE = 1e-3
CLAUSES = "Content"
"""Section of SPEC.md that all of these cases are of."""


def _published(kit: Kit) -> tuple[Session, list[Scene]]:
    """Play some frames of a world and return its scenes."""
    session = kit.at(ACTIVE)
    if "scene" not in session.hello.get("outputs", []):
        raise NotApplicable("it publishes no scene")
    found = []
    for _ in range(FRAMES):
        answer = session.step()
        product = answer.product("scene")
        if product is None:
            raise Failed("a scene in each frame", f"none in frame {answer.fields['frame']}")
        found.append(cast(Scene, decode_payload("scene", *product)))
    return session, found


def _rules(session: Session) -> SceneRules:
    """Rules that consumers of this world check its scenes by."""
    name = session.hello["name"]
    devices = msgspec.convert(street.briefing(session.hello)["devices"], tuple[DeviceSpec, ...])
    return SceneRules(
        prefixes={name: tuple(session.ready.get("prefixes", ()))},
        devices={name: devices},
        assets=frozenset(session.offered),
    )


# One case each, although one pass over the scenes would find everything: a verdict names its aspect, and a
# world with two faults gets two verdicts.
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
    "Objects and devices are sorted by name; names occur once, and have no control characters.",
    "names in ascending order of their UTF-8 bytes, none of them twice or with control characters",
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
        # Its object may leave, and the device with it; another one may then get the device.
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
    # Added with protocol 1.4: the field is optional, so a world of before has nothing to check.
    _, found = _published(kit)
    compared = 0
    for before, after in pairwise(found):
        if before.angular_velocity is None or after.angular_velocity is None:
            continue
        for name in set(before.names) & set(after.names):
            i, j = before.names.index(name), after.names.index(name)
            turned = _rotation(before.orientation[i], after.orientation[j])
            # The mean of both ends: exact for a turn that speeds up evenly.
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
    # R = R₂·R₁ᵀ turns world axes; its angle is arccos((tr R − 1)/2), its axis the antisymmetric part.
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
    asked = frozenset(street.known_parts("channel", session.hello))
    if problem := PartCheck({"channel": asked}, carriers, devices)("channel", channel):
        raise Failed(f"parts {', '.join(sorted(asked))}", problem)
    return ", ".join(f"{len(getattr(channel, part))} of {part}" for part in sorted(asked))


@case(
    "channel-consistency", "Payloads", "`h`, `hf` and `taps` that follow from each other and from the paths"
)
def consistency(kit: Kit) -> str:
    """The parts of a channel say the same as its paths, where arrays see plane waves."""
    # The right answer is computed from the client's own paths: the kit does not know which paths are right.
    _, scene, channel = _channel(kit)
    whole = {(entry.carrier, entry.tx, entry.rx): entry.h for entry in channel.h}
    # On every rung, since both are of the client: a factor or a conjugate that one of them lacks shows.
    for entry in channel.hf:
        # The middle subcarrier stands at the carrier's frequency, where the response is H itself.
        middle = entry.h[0, channel.carriers[entry.carrier].subcarriers // 2]
        _compare("hf of the middle subcarrier in slot 0", middle, whole[entry.carrier, entry.tx, entry.rx])
    # Other rungs have a path length for each pair of elements, which the paths of the product do not state.
    if channel.rung not in PLANE_WAVES:
        return f"hf agrees with h; {channel.rung!r} has no plane waves"
    for part, expected in street.parts_of(channel, scene).items():
        for mine, right in zip(getattr(channel, part), expected, strict=False):
            if part == "taps" and mine.first != right.first:
                raise Failed(f"taps from sample {right.first} on", f"from {mine.first}")
            _compare(part, mine.h, right.h)
    return "all parts follow from the paths"


def _channel(kit: Kit) -> tuple[Session, Scene, Channel]:
    """Play a frame of a channel model; return its channel and the scene that it was given."""
    session = kit.at(ACTIVE)
    if "channel" not in session.hello.get("outputs", []):
        raise NotApplicable("it makes no channel")
    frame = session.frame
    answer = session.step()
    product = answer.product("channel")
    if product is None:
        raise Failed("a channel", f"none in frame {frame}")
    scene = decode_payload("scene", *street.product("scene", street.WORLD, frame))
    return session, cast(Scene, scene), cast(Channel, decode_payload("channel", *product))


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
