"""Seeds of services: random generators and integer seeds.

They depend on neither process nor order (contract, clause 19).

Every service learns the seed of the run, and derives from it by episode, frame and a name of its own: a NumPy
`generator` for its own draws, and with `derive_seed` the seed of a library that draws for it.
"""

from __future__ import annotations

import hashlib

import numpy as np


def generator(seed: int, episode: int, stream: str, frame: int = -1) -> np.random.Generator:
    """Make the random generator of one purpose (contract, clause 19).

    Args:
        seed: Of the run.
        episode: Episodes since the first with this seed.
        stream: Name of the service, or of a stream of it.
        frame: Frame of the episode; −1: the episode as a whole.

    Returns:
        A generator that depends on the arguments alone, never on when or in which process it is made.

    Example:
        >>> first, second = generator(1, 0, "traffic", frame=3), generator(1, 0, "traffic", frame=3)
        >>> bool(first.random() == second.random())
        True
    """
    key = hashlib.sha256(f"{seed}\0{episode}\0{stream}\0{frame}".encode()).digest()
    return np.random.Generator(np.random.Philox(key=int.from_bytes(key[:16], "little")))


def derive_seed(seed: int, episode: int, stream: str) -> int:
    """Derive the seed of a library that takes an integer, such as SUMO or a ray launcher.

    Args:
        seed: Of the run.
        episode: Episodes since the first with this seed.
        stream: Name of the service, or of a stream of it.

    Returns:
        A number of 31 bits, which every library takes as a signed integer.

    Example:
        >>> derive_seed(1, 0, "traffic")
        206690939
    """
    key = hashlib.sha256(f"{seed}\0{episode}\0{stream}".encode()).digest()
    return int.from_bytes(key[:4], "little") & 0x7FFFFFFF
