"""Who takes whose products in a measured run."""

from __future__ import annotations

from typing import Literal

import msgspec

from caviar_protocol.messages import Input, Role

Topology = Literal["hub", "all"]

HUB = "hub"


class Part(msgspec.Struct, frozen=True):
    """One service of a measured run."""

    name: str
    role: Role
    inputs: tuple[Input, ...]
    output: str


def parts(topology: Topology, services: int) -> tuple[Part, ...]:
    """The services of a run.

    ``hub``: one takes the products of all others in the same frame, and they take its product of the frame
    before. ``all``: everyone takes what every other made in the frame before.
    """
    if topology == "hub":
        leaf = (Input(topic="link", lag=1, required=False),)
        leaves = [Part(f"leaf-{i}", "sensors", leaf, "lidar") for i in range(1, services)]
        return (Part(HUB, "link", (Input(topic="lidar"),), "link"), *leaves)
    everyone = (Input(topic="lidar", lag=1, required=False),)
    return tuple(Part(f"peer-{i}", "sensors", everyone, "lidar") for i in range(services))


def deliveries(topology: Topology, services: int) -> int:
    """Products that consumers get in a frame."""
    # A service of `all` gets its own product too: the topic has all of them as sources.
    return 2 * (services - 1) if topology == "hub" else services * services
