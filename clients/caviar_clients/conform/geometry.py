"""Cases of the capability ``geometry``: meshes that come and go while an episode goes on (clause 4)."""

from __future__ import annotations

import hashlib

from caviar_clients.conform import street
from caviar_clients.conform.case import Kit, case
from caviar_clients.conform.client import Failed, Fields, NotApplicable
from caviar_clients.conform.session import ACTIVE, Session

CLAUSES = "clause 4; Geometry at run time"


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


CASES = (geometry, later_geometry, geometry_gone)
