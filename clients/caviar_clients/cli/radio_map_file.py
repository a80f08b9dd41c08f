"""Radio maps in files: NumPy archives whose arrays have named axes and units."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from importlib import metadata as distribution
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.files import writing
from caviar_protocol.host import DISTRIBUTION
from caviar_services.channel.radio_map.coverage import decibels
from caviar_services.channel.radio_map.mapping import RadioMap

FORMAT = "caviar-radio-map-1"

ARRAYS: Mapping[str, tuple[tuple[str, ...], str, str]] = {
    "x": (("x",), "m", "middle of each column, east"),
    "y": (("y",), "m", "middle of each row, north"),
    "z": (("y", "x"), "m", "height of the middle of each cell; NaN where there is no ground"),
    "transmitter": (("transmitter",), "", "names"),
    "position": (("transmitter", "xyz"), "m", "of the transmitters"),
    "power": (("transmitter",), "dBm", "of the transmitters"),
    "gain": (("transmitter", "y", "x"), "dB", "mean path gain, serving beam; NaN: no signal"),
    "interference_gain": (
        ("transmitter", "y", "x"), "dB", "the same while a transmitter serves other cells",
    ),
    "rss": (("transmitter", "y", "x"), "dBm", "received power with the serving beam"),
    "sinr": (("transmitter", "y", "x"), "dB", "of each transmitter, all others interfering"),
    "best_server": (("y", "x"), "index", "transmitter of the greatest received power; -1: no signal"),
    "beam": (("transmitter", "y", "x"), "index", "serving beam of the codebook; -1: none"),
    "rays": (("transmitter", "y", "x"), "count", "that passed through a cell"),
}  # fmt: skip
"""Axes, unit and meaning of each array of a file."""


def save(found: RadioMap, about: Mapping[str, Any], file: Path) -> None:
    """Write a map; ``about`` becomes part of its metadata. Raises `RunError` where that fails."""
    surface, coverage = found.surface, found.coverage
    centres = surface.centres
    arrays = {
        "x": centres[0, :, 0],
        "y": centres[:, 0, 1],
        "z": centres[..., 2],
        "transmitter": np.array(found.names),
        "position": found.positions,
        "power": found.power_dbm,
        "gain": decibels(coverage.gain).astype(np.float32),
        "interference_gain": decibels(coverage.interference_gain).astype(np.float32),
        "rss": decibels(coverage.rss, 1e-3).astype(np.float32),
        "sinr": decibels(coverage.sinr).astype(np.float32),
        "best_server": coverage.best_server,
        "beam": found.beam,
        "rays": found.rays,
    }
    metadata = {
        "format": FORMAT,
        "caviar": distribution.version(DISTRIBUTION),
        **about,
        "shooting": asdict(found.shooting),
        "arrays": {
            name: {"axes": axes, "unit": unit, "meaning": meaning}
            for name, (axes, unit, meaning) in ARRAYS.items()
        },
    }
    with writing(file), file.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, metadata=np.array(json.dumps(metadata)), **arrays)
