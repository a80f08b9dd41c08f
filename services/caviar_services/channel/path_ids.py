"""Ids by which a path is found again in other frames and products (contract, clause 21)."""

from __future__ import annotations

import hashlib
from functools import lru_cache

import numpy as np

from caviar_protocol.arrays import Int64Array, UInt64Array
from caviar_services.channel.paths import PathTable


def stable_ids(table: PathTable) -> UInt64Array:
    """Stable ids of sorted paths: hash of types, object names, faces, and rank among equals in the pair."""
    ids = np.zeros(len(table.pair), np.uint64)
    if not len(ids):
        return ids
    base, kind = _kinds(table)
    # In a stable order, so the rank follows the sorted paths: distance to the start of the run of equals.
    order = np.lexsort((kind, table.pair))
    place = np.arange(len(ids))
    first = np.ones(len(ids), np.bool_)
    ranked, pair = kind[order], table.pair[order]
    first[1:] = (ranked[1:] != ranked[:-1]) | (pair[1:] != pair[:-1])
    rank = np.empty(len(ids), np.int64)
    rank[order] = place - np.maximum.accumulate(np.where(first, place, 0))
    return _mix(base[kind] + rank.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15))


def _kinds(table: PathTable) -> tuple[UInt64Array, Int64Array]:
    """Hashes of the kinds of paths that occur, and which of them each path is."""
    depth = table.types.shape[1]
    if not depth:
        return np.array([_name_hash(())], np.uint64), np.zeros(len(table.pair), np.int64)
    faces = np.zeros_like(table.objects) if table.faces is None else table.faces
    objects = np.where(faces < 0, -1, table.objects)
    discrete = np.concatenate([table.types.astype(np.int32), objects, faces], axis=1)
    kinds, kind = np.unique(discrete, axis=0, return_inverse=True)
    named = (
        tuple(
            (t, *(table.joined_faces[-1 - f] if f < 0 else (table.object_names[o], f)))
            for t, o, f in zip(row[:depth], row[depth : 2 * depth], row[2 * depth :], strict=True)
            if t
        )
        for row in kinds.tolist()
    )
    return np.array([_name_hash(names) for names in named], np.uint64), kind.reshape(-1)


@lru_cache(maxsize=4096)
def _name_hash(kind: tuple[tuple[int, str, int], ...]) -> int:
    text = "\0".join(f"{interaction}\0{name}\0{face}" for interaction, name, face in kind)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


def _mix(x: UInt64Array) -> UInt64Array:
    """Finaliser of SplitMix64 (Steele, Lea, Flood 2014): a bijection that spreads every bit."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
