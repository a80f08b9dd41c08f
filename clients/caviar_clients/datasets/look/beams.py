"""Section of a page with the best pairs of beams, and the beams that no codebook has."""

from __future__ import annotations

import math
from collections.abc import Iterator

import msgspec
import numpy as np

from caviar_clients.datasets.look.data import Content
from caviar_clients.datasets.look.description import scenario_of
from caviar_clients.datasets.look.distributions import beams_height, draw_beams
from caviar_clients.datasets.look.html import absent, figure
from caviar_clients.datasets.look.pictures import PANELS, picture
from caviar_clients.datasets.texts import counted, percent
from caviar_protocol.errors import CaviarError
from caviar_protocol.space.codebooks import beam_count
from caviar_protocol.topics import AntennaArray

MOST_PAIRS = 2**24
"""Pairs of beams of a picture: more are finer than its pixels, and take the memory of the machine."""

BEAM_COLUMNS = ("users.tx_beam", "users.rx_beam")
"""Columns of which values that cannot be are left out: the rest of the row may be right."""

_SWEEPS = ("beams", "cell")
"""Links that take beams of the codebooks of arrays; others have those that they choose."""

_MOST_BEAMS = 2**31
"""That a recorded index of a beam can number."""


def impossible_beams(content: Content) -> str:
    """Say how many best beams are in no codebook, which the page leaves out.

    Args:
        content: Of the page.

    Returns:
        With the first of them; empty where there is none.
    """
    if "link" not in content.topics:
        return ""
    limits = _limit(content, "tx"), _limit(content, "rx")
    _, rows = content.catalogue.query(
        "SELECT count(*) OVER (), episode, scene, rx, tx_beam, rx_beam FROM users "
        "WHERE tx_beam NOT BETWEEN 0 AND ? OR rx_beam NOT BETWEEN 0 AND ? "
        "ORDER BY episode, scene, rx LIMIT 1",
        (limits[0] - 1, limits[1] - 1),
    )
    if not rows:
        return ""
    ((count, episode, scene, rx, tx_beam, rx_beam),) = rows
    users = f"{count:,} of {counted(len(content.users), 'user')}"
    return (
        f"left out: best beams of {users} that no codebook has (TX 0 to {limits[0] - 1}, RX 0 to "
        f"{limits[1] - 1}), the first of episode {episode}, scene {scene}, {rx}: TX {tx_beam}, RX {rx_beam}"
    )


def beams_section(content: Content) -> Iterator[str]:
    """How often each pair of beams is the best.

    Args:
        content: Of the page.
    """
    users = content.users
    if "link" not in content.topics:
        yield absent("No link is recorded: the best beams are not known.")
        return
    text, some = impossible_beams(content), np.ones(len(users), dtype=bool)
    if text:
        yield absent(f"{text}.")
    beams = []
    for role, column in (("tx", users.tx_beam), ("rx", users.rx_beam)):
        some &= (column >= 0) & (column < _limit(content, role))
        beams.append(_codebook(content, role))
    if not some.any():
        yield absent("No user has a best pair of beams.")
        return
    beams = [
        max(size, int(column[some].max()) + 1)
        for size, column in zip(beams, (users.tx_beam, users.rx_beam), strict=True)
    ]
    if math.prod(beams) > MOST_PAIRS:
        yield absent(f"Codebooks of {beams[0]:,} and {beams[1]:,} beams have too many pairs to be drawn.")
        return
    counts = np.bincount(users.group[some], minlength=len(users.groups))
    shown = [int(group) for group in np.argsort(-counts, kind="stable")[:PANELS] if counts[group]]
    panels = []
    for group in sorted(shown):
        mask = some & (users.group == group)
        carrier, tx = users.groups[group]
        panels.append((f"{tx}, {carrier}", users.tx_beam[mask], users.rx_beam[mask]))
    codebooks = beams[0], beams[1]
    pairs, numbers = np.unique(
        np.stack([users.group, users.tx_beam, users.rx_beam])[:, some], axis=1, return_counts=True
    )
    at = int(numbers.argmax())
    carrier, tx = users.groups[pairs[0, at]]
    left = int((counts > 0).sum()) - len(shown)
    left_out = f" Left out: {left} more with fewer users." if left else ""
    yield figure(
        picture(
            draw_beams(panels, codebooks),
            f"Heat map of how often each pair of beams is the best; the most frequent one is beam "
            f"{pairs[1, at]} of {tx} with beam {pairs[2, at]} of the receiver.",
            beams_height(panels),
        ),
        f"How often a pair of beams is the best of all, on a logarithmic scale: of "
        f"{counted(pairs.shape[1], 'pair')} that occur, most often "
        f"({percent(numbers[at] / some.sum())}) beam {pairs[1, at]} of {tx} with beam {pairs[2, at]} of the "
        f"receiver, on carrier {carrier}.{left_out}",
    )


def _limit(content: Content, role: str) -> int:
    """The first beam that no codebook of this role can have."""
    links = {
        spec.get("use")
        for spec in scenario_of(content.data).get("services", {}).values()
        if spec.get("role") == "link"
    }
    sizes = _sizes(content, role)
    return max(sizes) if links and sizes and links <= {*_SWEEPS} else _MOST_BEAMS


def _codebook(content: Content, role: str) -> int:
    """Beams that the largest codebook of this role has."""
    return max(_sizes(content, role), default=1)


def _sizes(content: Content, role: str) -> list[int]:
    """Beams of the arrays of this role."""
    found = []
    for device in scenario_of(content.data).get("devices", ()):
        if device.get("role") in (role, "both") and isinstance(array := device.get("array"), dict):
            try:
                found.append(beam_count(msgspec.convert(array, AntennaArray)))
            except (msgspec.ValidationError, CaviarError):  # of another version, or machine
                found.append(array.get("rows", 1) * array.get("columns", 1))
    return found
