"""Rows of the catalogue, read from the recording of an episode."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from types import UnionType
from typing import Any, get_args, get_type_hints

import numpy as np

from caviar_protocol.digest import file_digest
from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import Status
from caviar_protocol.multipath import delay_spread
from caviar_protocol.recording import RecordedFrame, Recording
from caviar_protocol.recording.integrity import declared_digest
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import AntennaDevice, Channel, Link, Scene


@dataclass(frozen=True)
class Episode:
    """An episode whose recording is there."""

    episode: int
    scenes: int
    seed: int
    digest: str
    """Of the digests of all its recorded products."""
    bytes: int
    """Of the recording's files."""
    sha256: str
    """Of the first segment of the recording; later ones are in its manifest."""


@dataclass(frozen=True)
class SceneRow:
    """The state of the world at one instant."""

    episode: int
    scene: int
    t_s: float
    """Simulated time in the episode [s]."""
    objects: int
    users: int
    """Receivers, on each carrier."""
    valid: int
    """Of these, how many have a path."""
    los: int
    """Of these, how many have a free line of sight."""
    rung: str
    """Step of the channel's fidelity ladder."""


@dataclass(frozen=True)
class UserRow:
    """A receiver at one instant, on one carrier and for one transmitter."""

    episode: int
    scene: int
    carrier: str
    tx: str
    rx: str
    object: str
    """Which carries the receiver; empty where it stands."""
    object_class: str
    x_m: float | None
    """Position of the receiver in world axes [m]."""
    y_m: float | None
    z_m: float | None
    valid: bool
    """Whether a path reaches it."""
    los: bool
    paths: int
    gain_db: float | None
    """Sum of |a|² over its paths [dB]; None without a path."""
    delay_s: float | None
    """Of its first path [s]."""
    delay_spread_s: float | None
    """Square root of the second central moment of the power delay profile [s]."""
    tx_beam: int | None
    """Of the best pair of the codebooks, by the link: not of the pair that the agent chose, which is
    ``link.tx_beam`` of the recording."""
    rx_beam: int | None
    """Likewise."""
    abs_y: float | None
    """|w* H f| of the best pair, not of the chosen one (``link.abs_y``)."""
    snr_db: float | None
    """Of the best pair, not of the chosen one (``link.snr``) [dB]."""


USER_COLUMNS = {
    "episode": "number, from 0",
    "scene": "number in the episode, from 0",
    "carrier": "name",
    "tx": "transmitting device, name",
    "rx": "receiving device, name",
    "object": "what carries the receiver, name; empty where it stands",
    "object_class": "its class",
    "x_m": "position of the receiver in world axes, to the east [m]",
    "y_m": "likewise, to the north [m]",
    "z_m": "likewise, upwards [m]",
    "valid": "whether a path reaches it",
    "los": "whether the line of sight is free",
    "paths": "number of paths",
    "gain_db": "sum of |a|² over the paths [dB]",
    "delay_s": "of the first path [s]",
    "delay_spread_s": "square root of the second central moment of the power delay profile [s]",
    "tx_beam": "of the best pair; of the pair that the agent chose it is link.tx_beam",
    "rx_beam": "of the best pair; of the chosen one link.rx_beam",
    "abs_y": "|y| of the best pair; of the chosen one link.abs_y",
    "snr_db": "SNR of the best pair [dB]; of the chosen one link.snr, linear",
}
"""What each column of the users is, with its unit."""

SCENE_COLUMNS = {
    "episode": "number, from 0",
    "scene": "number in the episode, from 0",
    "t_s": "simulated time in the episode [s]",
    "objects": "number of objects",
    "users": "receivers, on each carrier",
    "valid": "of these, how many have a path",
    "los": "of these, how many have a free line of sight",
    "rung": "step of the channel's fidelity ladder",
}
"""What each column of the scenes is, with its unit."""


@dataclass(frozen=True)
class ProductRow:
    """Product of a service for one instant."""

    episode: int
    scene: int
    topic: str
    source: str
    status: str
    """``fresh``, ``held`` or ``absent``."""
    bytes: int
    sha256: str


@dataclass(frozen=True)
class EpisodeRows:
    """All rows of one episode, as tuples in the order of the columns."""

    episode: tuple[Any, ...]
    scenes: tuple[tuple[Any, ...], ...]
    users: tuple[tuple[Any, ...], ...]
    products: tuple[tuple[Any, ...], ...]


def column_types(row: type[Any]) -> dict[str, tuple[type[Any], bool]]:
    """Find the type of each column of a table, and whether it may lack a value.

    Args:
        row: Class whose fields are the columns.

    Example:
        >>> column_types(UserRow)["x_m"]
        (<class 'float'>, True)
    """
    hints = get_type_hints(row).items()
    return {n: (get_args(h)[0], True) if isinstance(h, UnionType) else (h, False) for n, h in hints}


def whole_recording(opened: Callable[[], Recording], *, with_digests: bool = False) -> Recording:
    """Open a recording that is neither damaged nor broken off.

    Args:
        opened: Opens it.
        with_digests: Whether every byte is compared with its digest.

    Raises:
        RecordingError: It is damaged or breaks off; says where.
    """
    with warnings.catch_warnings(action="ignore"):  # of damage, which is the error
        recording = opened()
    damage = [*recording.damage, *(recording.run_digest().damage if with_digests else ())]
    if damage or not recording.complete:
        raise RecordingError(damage[0] if damage else f"{recording.path} breaks off")
    return recording


def rows_of(recording: Recording) -> EpisodeRows:
    """Read the rows of an episode from its recording.

    Args:
        recording: Complete, of one episode.

    Raises:
        RecordingError: It cannot be read, or has no scene.
    """
    entries = [recording.entry(index) for index in range(len(recording))]
    if not entries:
        raise RecordingError(f"{recording.path} has no scene: it breaks off before the first one")
    scenes, users, products = list[Any](), list[Any](), list[Any]()
    for frame in recording.frames():
        scene, channel = frame.scene(), _only(frame, "channel", Channel)
        if channel is not None:
            found = [*_user_rows(frame, scene, channel, _only(frame, "link", Link))]
            users += found
        else:
            found = []
        scenes.append(
            SceneRow(
                episode=frame.episode,
                scene=frame.number,
                t_s=frame.t_ns * 1e-9,
                objects=0 if scene is None else len(scene.names),
                users=len(found),
                valid=sum(row.valid for row in found),
                los=sum(row.los for row in found),
                rung="" if channel is None else channel.rung,
            )
        )
        products += _product_rows(frame)
    episode = Episode(
        episode=entries[0].episode,
        scenes=len(entries),
        seed=entries[0].seed,
        digest=declared_digest(entries),
        bytes=sum(file.stat().st_size for file in recording.files),
        sha256=file_digest(recording.files[0]),
    )
    return EpisodeRows(_values(episode), *(tuple(map(_values, rows)) for rows in (scenes, users, products)))


def _values(row: Any) -> tuple[Any, ...]:
    return tuple(getattr(row, field.name) for field in fields(row))


def _only(frame: RecordedFrame, topic: str, cls: type[Any]) -> Any:
    """The payload of a topic that one service makes; None where it is absent."""
    return next(iter(frame.payloads(topic, cls).values()), None)


def _product_rows(frame: RecordedFrame) -> Iterator[ProductRow]:
    for product in frame.products:
        item = product.provenance
        if item.status is not Status.LATE:
            yield ProductRow(
                episode=frame.episode,
                scene=frame.number,
                topic=item.topic,
                source=item.source,
                status=item.status.value,
                bytes=product.size,
                sha256=item.digest,
            )


def _user_rows(
    frame: RecordedFrame, scene: Scene | None, channel: Channel, link: Link | None
) -> Iterator[UserRow]:
    receivers: dict[str, AntennaDevice] = {}
    class_of: dict[str, str] = {}
    if scene is not None:
        receivers = {device.name: device for device in antennas(scene, "rx")}
        class_of = dict(zip(scene.names, scene.classes, strict=True))
    best: dict[tuple[str, str, str], int] = {}
    if link is not None:
        best = {user: at for at, user in enumerate(zip(link.carrier, link.tx, link.rx, strict=True))}
    for c, carrier in enumerate(channel.carriers):
        for t, tx in enumerate(channel.tx):
            for r, rx in enumerate(channel.rx):
                if tx == rx or not channel.uses(c, t, r):
                    continue
                device = receivers.get(rx)
                x = y = z = None
                if device is not None and scene is not None:
                    x, y, z = device_pose(scene, device).position
                pair = t * len(channel.rx) + r
                cut = slice(int(channel.offsets[pair]), int(channel.offsets[pair + 1]))
                gain_db, delay_s, spread_s = _profile(channel.a[c, cut], channel.tau[cut])
                tx_beam, rx_beam, abs_y, snr_db = _best_pair(link, best.get((carrier.name, tx, rx)))
                yield UserRow(
                    episode=frame.episode,
                    scene=frame.number,
                    carrier=carrier.name,
                    tx=tx,
                    rx=rx,
                    object=device.parent if device is not None else "",
                    object_class=class_of.get(device.parent, "") if device is not None else "",
                    x_m=x,
                    y_m=y,
                    z_m=z,
                    valid=cut.stop > cut.start,
                    los=bool(channel.los[t, r]),
                    paths=cut.stop - cut.start,
                    gain_db=gain_db,
                    delay_s=delay_s,
                    delay_spread_s=spread_s,
                    tx_beam=tx_beam,
                    rx_beam=rx_beam,
                    abs_y=abs_y,
                    snr_db=snr_db,
                )


def _profile(a: Any, tau: Any) -> tuple[float | None, float | None, float | None]:
    """Gain [dB], first delay [s] and delay spread [s] of paths; None without one."""
    power = np.abs(a) ** 2
    total = float(power.sum())
    if not total:
        return None, None, None
    return 10.0 * math.log10(total), float(tau.min()), float(delay_spread(a, tau))


def _best_pair(
    link: Link | None, at: int | None
) -> tuple[int | None, int | None, float | None, float | None]:
    if link is None or at is None or not link.has_path[at]:
        return None, None, None, None
    snr = float(link.snr_best[at])
    return (
        int(link.top_tx_beam[at, 0]),
        int(link.top_rx_beam[at, 0]),
        float(link.top_abs_y[at, 0]),
        10.0 * math.log10(snr) if snr > 0.0 else None,
    )
