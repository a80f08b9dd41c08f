"""Scenes full of boxes, in which one frame is asked for in many ways."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from caviar_labs.stability.lab import Array, Thing, antenna, measure, scene, sionna
from caviar_protocol.codec import encode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.topics import AntennaArray, Channel
from caviar_services.channel.base import ChannelModel
from caviar_space.scenery import scenery_assets

POSITIONS = int(os.environ.get("CAVIAR_SAME_PATHS", "20"))
"""Receivers that are drawn in each scene."""

SCENES = {
    "simple_street_canyon_with_cars": ((-31.0, 5.0, 12.0), (80.0, 25.0)),
    "munich": ((8.5, 21.0, 27.0), (70.0, 70.0)),
    "etoile": ((4.0, -30.0, 9.0), (200.0, 200.0)),
}
"""Position of the transmitter [m], and half of what the receivers are drawn from in x and y [m]."""

SPECULAR = {"max_depth": 3}
EVERYTHING = {
    "max_depth": 2,
    "refraction": True,
    "diffraction": True,
    "scattering": True,
    "samples": 3_000,
}


def model(name: str, **settings: Any) -> ChannelModel[Any]:
    """The channel of a bundled scene at 28 GHz; every material scatters a little."""
    assets = {
        asset: file for asset, file in scenery_assets(f"sionna:{name}").items() if isinstance(file, Path)
    }
    rough = {material: {"scattering_coefficient": 0.3} for material in ("concrete", "marble")}
    return sionna(28e9, assets, **{"bodies": 12, "materials": rough, **settings})


def things(seed: int, name: str) -> list[Thing]:
    """Boxes of the size of cars, which stand about at random."""
    rng = np.random.default_rng(seed)
    _, (x, y) = SCENES[name]
    turned = rng.uniform(-np.pi, np.pi, 12) / 2
    return [
        Thing(
            f"car-{i:02d}",
            rng.uniform((-x, -y, 0.8), (x, y, 1.2)),
            rng.uniform((3.5, 1.6, 1.4), (12.0, 2.5, 3.2)),
            (float(np.cos(turned[i])), 0.0, 0.0, float(np.sin(turned[i]))),
        )
        for i in range(12)
    ]


def places(seed: int, name: str, count: int) -> Array:
    """Positions of receivers [m], low and high, in the street and wherever they fall."""
    _, (x, y) = SCENES[name]
    return np.random.default_rng(seed).uniform((-x, -y, 0.5), (x, y, 30.0), (count, 3))


def asked(
    channel: ChannelModel[Any], name: str, positions: Array, names: Sequence[str], seed: int = 0
) -> Channel:
    """The product for receivers of these names at these positions."""
    tx = antenna("t", "tx", SCENES[name][0], AntennaArray(polarization="VH"[seed % 2]))  # type: ignore[arg-type]
    devices = [antenna(rx, "rx", place) for rx, place in zip(names, positions, strict=True)]
    channel.reset(0, 0, 0)  # where nothing moves it would not trace again
    return measure(channel, scene([tx, *devices], things(seed, name)))


def of_receiver(channel: Channel, rx: str) -> dict[str, bytes]:
    """Everything that a product says about one receiver's paths, bit by bit; names in place of numbers."""
    mine = channel.pair("t", rx)
    names = np.array([*channel.object_names, ""])
    depth = channel.interactions.shape[1]
    padded = {"interactions": channel.interactions, "points": channel.points, "objects": channel.objects}
    used = slice(0, int((channel.interactions[mine] != 0).sum(1).max(initial=0)) if depth else 0)
    return {
        "los": channel.los[0, channel.rx.index(rx)].tobytes(),
        "id": channel.id[mine].tobytes(),
        "a": channel.a[:, mine].tobytes(),
        "tau": channel.tau[mine].tobytes(),
        "aod": channel.aod[mine].tobytes(),
        "aoa": channel.aoa[mine].tobytes(),
        "doppler": channel.doppler[:, mine].tobytes(),
        "interactions": padded["interactions"][mine, used].tobytes(),
        "points": padded["points"][mine, used].tobytes(),
        "objects": "\0".join(names[padded["objects"][mine, used]].ravel().tolist()).encode(),
    }


def digest(channel: Channel) -> str:
    """Digest of a whole product."""
    return payload_digest(*encode_payload(channel))


if __name__ == "__main__":
    import sys

    scenery = sys.argv[1]
    settings = EVERYTHING if sys.argv[2] == "everything" else SPECULAR
    found = asked(
        model(scenery, **settings), scenery, places(5, scenery, 10), [f"r{i}" for i in range(10)], seed=5
    )
    sys.stdout.write(digest(found))
