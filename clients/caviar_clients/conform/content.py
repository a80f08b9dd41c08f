"""Cases of what a world's scenes say: each looks at one aspect, as consumers do in every run."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING, cast

import msgspec

from caviar_clients.conform import street
from caviar_clients.conform.case import Case, Failed, NotApplicable, case
from caviar_clients.conform.session import ACTIVE, Session
from caviar_protocol import scene_validation as scenes
from caviar_protocol.codec import decode_payload
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scene_validation import SceneRules
from caviar_protocol.topics import Scene

if TYPE_CHECKING:
    from caviar_clients.conform.kit import Kit

FRAMES = 4
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


CASES = (orientations, places, dimensions, names, prefixes, meshes, devices, poses, mounts, carriers)
