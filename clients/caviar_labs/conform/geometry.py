"""Cases of the capability ``geometry``: meshes that come and go while an episode goes on (clause 4)."""

from __future__ import annotations

import hashlib
from pathlib import Path
from tempfile import TemporaryDirectory

from caviar_labs.conform import street
from caviar_labs.conform.canonical import Answer
from caviar_labs.conform.case import Kit, case
from caviar_labs.conform.client import Failed, Fields, NotApplicable
from caviar_labs.conform.session import ACTIVE, JOINED, Session
from caviar_protocol.assets import is_mesh_name, read_unit_mesh, wrong_name
from caviar_protocol.codec import decode_payload
from caviar_protocol.errors import AssetError
from caviar_protocol.messages import Asset
from caviar_protocol.topics import Scene

CLAUSES = "clause 4; Geometry at run time"
FRAMES = 150
"""Within which a world has to bring a mesh, for `run_time_meshes` to judge it."""
MAX_FACES = 100_000
"""Triangles that PREPARE lets each of its meshes have."""


@case("geometry", CLAUSES, "GEOMETRY_DONE with the digest of all assets, and DONE that states it")
def geometry(kit: Kit) -> str:
    """Meshes that come while an episode goes on are fetched, loaded and used."""
    session = _with_capability(kit)
    session.step()
    crate = _mesh(session, "crate")
    held = _announce(session, session.frame, [crate])
    for _ in range(2):
        _expect_used(session, held)
    # Cases share a life: the next one begins with the geometry of READY.
    _announce(session, session.frame, [])
    return f"geometry {held[:12]}… with the frame that it is for, and after it"


@case("later-geometry", CLAUSES, "the frames before with the geometry of READY, then with the new one")
def later_geometry(kit: Kit) -> str:
    """Meshes for a later frame do not count before it."""
    session = _with_capability(kit)
    session.step()
    held = _announce(session, session.frame + 2, [_mesh(session, "barrel")])
    _expect_used(session, "")
    _expect_used(session, "")
    _expect_used(session, held)
    _announce(session, session.frame, [])
    return "from the frame on that it is for"


@case("geometry-gone", CLAUSES, "GEOMETRY_DONE with the digest of READY, and DONE without one")
def geometry_gone(kit: Kit) -> str:
    """Meshes go, and RESET takes the geometry back to that of READY."""
    session = _with_capability(kit)
    session.step()
    held = _announce(session, session.frame, [_mesh(session, "wall")])
    _expect_used(session, held)
    _announce(session, session.frame, [])
    _expect_used(session, "")
    _announce(session, session.frame, [_mesh(session, "wall")])
    episode = session.episode
    session.send("EPISODE_END", {**session.who, "episode": episode, "frames": session.frame})
    session.reset(episode + 1)
    _expect_used(session, "")
    return "with the frame that it is for, and with the next episode"


@case("run-time-meshes", CLAUSES, "meshes in DONE before scenes name them, their files, and more frames")
def run_time_meshes(kit: Kit) -> str:
    """A world's meshes that come while an episode goes on are there when scenes name them."""
    session = kit.at(JOINED)
    if session.hello["role"] != "world":
        raise NotApplicable("only worlds announce meshes")
    if "geometry" not in session.hello.get("capabilities", []):
        raise NotApplicable("it did not name the capability `geometry`")
    session.prepare(max_faces=MAX_FACES)
    session.reset(0)
    announced: dict[str, Fields] = {}
    for _ in range(FRAMES):
        done = session.step()
        change = done.fields.get("geometry", {})
        announced |= {asset["name"]: asset for asset in change.get("assets", [])}
        _expect_announced(done, announced)
        if announced:
            break
    else:
        kit.discard()  # other cases are for a run that takes no meshes
        raise NotApplicable(f"it announced no mesh in {FRAMES} frames")
    if change["frame"] < session.completed:
        raise Failed(f"geometry from frame {session.completed} on, or a later one", str(change["frame"]))
    for asset in announced.values():
        _expect_mesh(session, asset)
    refused = next(iter(announced.values()))["digest"]
    reason = {"code": "refused-mesh", "message": "the kit takes it for none", "of": "DONE"}
    session.send("ERROR", {**reason, "subject": refused})
    session.step()
    kit.discard()
    return f"{len(announced)} in frame {session.completed - 1}; after ERROR `refused-mesh` it went on"


def _expect_announced(done: Answer, announced: dict[str, Fields]) -> None:
    """Check that the scene of a DONE names no mesh that the world has not announced."""
    scene = decode_payload("scene", *done.parts[1:3])
    assets = scene.assets if isinstance(scene, Scene) else ()
    unknown = [name for name in assets if is_mesh_name(name) and name not in announced]
    if unknown:
        raise Failed("scenes that name meshes which were announced", unknown[0])


def _expect_mesh(session: Session, asset: Fields) -> None:
    """Fetch a mesh that was announced and check that consumers can use it."""
    stated = Asset(name=asset["name"], digest=asset["digest"], size=asset["size"])
    if problem := wrong_name(stated):
        raise Failed(f"an asset named objects/{stated.digest}.ply", f"{stated.name}: {problem}")
    with TemporaryDirectory(prefix="caviar-conform-") as folder:
        file = Path(folder) / "mesh.ply"
        file.write_bytes(session.fetch(asset))
        try:
            read_unit_mesh(file, stated.name, MAX_FACES)
        except AssetError as error:
            raise Failed("a mesh that fills the unit box", str(error)) from error


def _with_capability(kit: Kit) -> Session:
    session = kit.at(ACTIVE)
    if "geometry" not in session.hello.get("capabilities", []):
        raise NotApplicable("it did not name the capability `geometry`")
    if session.hello["role"] == "world":
        raise NotApplicable("a world announces meshes when it has some")
    return session


def _mesh(session: Session, text: str) -> Fields:
    """A mesh that no cache has, which the kit serves from now on."""
    data = street.unit_mesh(f"{text} {session.rules.mark} {session.frame}")
    digest = hashlib.sha256(data).hexdigest()
    session.serve(digest, data)
    return {"name": f"objects/{digest}.ply", "digest": digest, "size": len(data)}


def _announce(session: Session, frame: int, meshes: list[Fields]) -> str:
    """Have the client load the meshes of a frame; the digest of all that it holds then."""
    order: Fields = {**session.who, "episode": session.episode, "frame": frame}
    if meshes:
        order["assets"] = meshes
    session.send("GEOMETRY", order)
    answer = session.serving("GEOMETRY_DONE")
    session.check_frame(answer, frame)
    assets = sorted([*session.assets, *meshes], key=lambda asset: str(asset["name"]).encode())
    chain = "".join(f"{asset['name']}\0{asset['digest']}\0" for asset in assets)
    right = hashlib.sha256(chain.encode()).hexdigest() if assets else ""
    got = answer.fields.get("geometry", "")
    if got != right:
        recipe = "hash name NUL digest NUL of each asset of PREPARE and GEOMETRY, in ascending order of names"
        raise Failed(f"geometry {right or '(empty)'}: {recipe}", got or "none")
    return right


def _expect_used(session: Session, right: str) -> None:
    got = session.step().fields.get("geometry_digest", "")
    if got != right:
        said = f"geometry_digest {right[:12]}…" if right else "no geometry_digest: the geometry is READY's"
        raise Failed(f"DONE with {said}", got or "none")


CASES = (geometry, later_geometry, geometry_gone, run_time_meshes)
