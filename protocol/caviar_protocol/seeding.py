"""Random generators that depend on what they are for, never on when they are made."""

from __future__ import annotations

import hashlib

import numpy as np


def generator(seed: int, episode: int, stream: str, frame: int = -1) -> np.random.Generator:
    """Generator for (run seed, episode, service or stream, frame) (contract, clause 19).

    ``frame`` −1 stands for the episode as a whole. Philox, so that the streams of different keys
    are independent and the same on every platform.
    """
    key = hashlib.sha256(f"{seed}\0{episode}\0{stream}\0{frame}".encode()).digest()
    return np.random.Generator(np.random.Philox(key=int.from_bytes(key[:16], "little")))


def derive_seed(seed: int, episode: int, stream: str) -> int:
    """31-bit seed for a library that takes an integer (SUMO, a ray launcher)."""
    key = hashlib.sha256(f"{seed}\0{episode}\0{stream}".encode()).digest()
    return int.from_bytes(key[:4], "little") & 0x7FFFFFFF
