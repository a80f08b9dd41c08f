"""The exchange of scenery before READY, from the broker's side (clause 4)."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from caviar_clients.conform import street
from caviar_clients.conform.case import Failed
from caviar_clients.conform.grants import Inputs
from caviar_clients.conform.wire import Fields
from caviar_protocol.topics import PARTS

if TYPE_CHECKING:
    from caviar_clients.conform.session import Session

CHUNK = 700
"""[B] of an ASSET_DATA from the kit, so that even small files take several."""


def order(session: Session, topics: list[str], inputs: Inputs) -> Fields:
    """What PREPARE holds beside epoch and attempt."""
    order: Fields = {}
    if topics:
        order["demand"] = [
            {"topic": topic, **({"parts": list(PARTS[topic])} if PARTS.get(topic) else {})}
            for topic in topics
        ]
    if session.hello["role"] != "world":
        files = street.scenery(session.rules.mark)
        session.served = {hashlib.sha256(data).hexdigest(): data for data in files.values()}
        session.assets = [
            {"name": name, "digest": hashlib.sha256(data).hexdigest(), "size": len(data)}
            for name, data in files.items()
        ]
        order["assets"] = session.assets
    order["producers"] = {topic: list(names) for topic, names in sorted(inputs.sources.items())}
    if session.hello["role"] != "world":
        order["prefixes"] = {world: street.PREFIXES[world] for world in inputs.sources["scene"]}
    return order


def serve(session: Session, get: Fields) -> None:
    """Answer an ASSET_GET of the client."""
    digest, offset = get["digest"], get.get("offset", 0)
    data = session.served.get(digest)
    if data is None or offset > len(data):
        raise Failed("ASSET_GET of an asset of PREPARE", f"one of {digest[:12]}… from byte {offset}")
    chunk = data[offset : offset + CHUNK]
    session.fetched[digest] = session.fetched.get(digest, 0) + len(chunk)
    session.send("ASSET_DATA", {"digest": digest, "offset": offset, "size": len(data)}, chunk)


def fetch(session: Session, offer: Fields) -> None:
    """Take a world's scenery, each file in as many parts as the world makes of it."""
    if session.hello["role"] != "world":
        raise Failed("READY", "ASSET_OFFER, which only worlds send")
    for asset in offer["assets"]:
        data = b""
        while True:
            session.send("ASSET_GET", {"digest": asset["digest"], "offset": len(data)})
            answer = session.receive("ASSET_DATA")
            if answer.kind == "READY":
                session.early.append(answer)
                answer = session.receive("ASSET_DATA")
            if answer.kind != "ASSET_DATA" or answer.fields["offset"] != len(data):
                raise Failed(f"ASSET_DATA from byte {len(data)}", str(answer))
            data += answer.parts[1]
            if len(data) >= asset["size"]:
                break
            if not answer.parts[1]:
                raise Failed("at least one byte of an ASSET_DATA before the end", "none")
        if hashlib.sha256(data).hexdigest() != asset["digest"]:
            raise Failed(f"bytes of {asset['name']} with the digest of its offer", "others")
        session.offered[asset["name"]] = data
    session.assets = list(offer["assets"])
