"""Types that fields of several messages share: each carries its meaning, unit and bounds."""

from __future__ import annotations

from typing import Annotated

import msgspec

from caviar_protocol.arrays import described, quantity

MAX_INTEGER = 2**63 - 1
"""Every integer of the protocol fits into a signed 64-bit one."""

_PRINTABLE = r"^[^\x00-\x1f\x7f]+$(?!\n)"
_SEGMENT = r"(?!\.{1,2}(?:/|$))[^/\\\x00-\x1f\x7f]+"

Name = Annotated[str, described("name of a service or topic that was declared", min_length=1, max_length=128)]
"""Refers to a name that HELLO declared."""

NewName = Annotated[
    str,
    described("declares a name, no control characters", min_length=1, max_length=128, pattern=_PRINTABLE),
]
AssetName = Annotated[
    str,
    described(
        "relative path with forward slashes, without ``.`` and ``..``",
        min_length=1,
        max_length=255,
        pattern=rf"^{_SEGMENT}(?:/{_SEGMENT})*$(?!\n)",
    ),
]
"""Names a file below one folder, wherever that is; so it can never lead out of it."""

Text = Annotated[str, described("text for people")]
Word = Annotated[str, described("word that programs compare", min_length=1, max_length=128)]
NamePattern = Annotated[str, described("name, or a pattern with ``*``", min_length=1, max_length=255)]

Version = Annotated[
    tuple[Annotated[int, msgspec.Meta(ge=0)], Annotated[int, msgspec.Meta(ge=0)]],
    quantity("1", "(major, minor) version of the protocol"),
]
Epoch = Annotated[int, quantity("1", "incarnation of the broker, from 1", ge=1, le=MAX_INTEGER)]
Attempt = Annotated[int, quantity("1", "incarnation of the service, from 1", ge=1, le=MAX_INTEGER)]
EpisodeIndex = Annotated[int, quantity("1", "episode of the run, from 0", ge=0, le=MAX_INTEGER)]
FrameIndex = Annotated[int, quantity("1", "frame of the episode, from 0", ge=0, le=MAX_INTEGER)]
FrameOrNone = Annotated[int, quantity("1", "frame of the episode; −1: none", ge=-1, le=MAX_INTEGER)]
Age = Annotated[int, quantity("frame", "age", ge=0, le=MAX_INTEGER)]
Seed = Annotated[int, quantity("1", "seed of everything random", ge=0, le=MAX_INTEGER)]
SeedOrNone = Annotated[int, quantity("1", "seed; −1: none", ge=-1, le=MAX_INTEGER)]
Nanoseconds = Annotated[int, quantity("ns", "simulated time, whole", ge=-MAX_INTEGER, le=MAX_INTEGER)]
Duration = Annotated[int, quantity("ns", "wall time, whole", ge=0, le=MAX_INTEGER)]
Period = Annotated[int, quantity("ns", "wall time, whole, at least 1", ge=1, le=MAX_INTEGER)]
Count = Annotated[int, quantity("1", "count", ge=0, le=MAX_INTEGER)]
Size = Annotated[int, quantity("B", "number of bytes", ge=0, le=MAX_INTEGER)]

Digest = Annotated[
    str,
    quantity("1", "SHA-256, 64 lower-case hexadecimal digits", max_length=64, pattern="^[0-9a-f]{64}$"),
]
DigestOrNone = Annotated[
    str,
    quantity(
        "1",
        "SHA-256, 64 lower-case hexadecimal digits, or empty",
        max_length=64,
        pattern=r"^([0-9a-f]{64})?$(?!\n)",
    ),
]

few = msgspec.Meta(max_length=256)
"""Bound of a list whose items each belong to message parts, or to a declaration of such."""
