"""The page of a dataset: one HTML file with what it is, its maps and distributions, and how it was made.

The file is whole: pictures are in it, nothing is loaded from elsewhere, and it needs no JavaScript.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.look.beams import BEAM_COLUMNS, beams_section, impossible_beams
from caviar_clients.datasets.look.data import (
    Content,
    Progress,
    Sample,
    UserColumns,
    read_sample,
    read_users,
)
from caviar_clients.datasets.look.description import name_of, scenario_of, what_it_is
from caviar_clients.datasets.look.distributions import (
    draw_angles,
    draw_correlation,
    draw_counts,
    draw_histograms,
    draw_shares,
    lags,
)
from caviar_clients.datasets.look.generation import generation_section
from caviar_clients.datasets.look.html import Section, absent, document, figure, table
from caviar_clients.datasets.look.maps import cell_m, draw_gain, draw_sight_map, map_height, map_of
from caviar_clients.datasets.look.pictures import PANELS, picture
from caviar_clients.datasets.look.scans import (
    camera_section,
    lidar_section,
    sampled,
)
from caviar_clients.datasets.look.units import small_time_unit, time_text
from caviar_clients.datasets.reader import Dataset
from caviar_clients.datasets.texts import counted, decimal, percent
from caviar_clients.datasets.verification.catalogue_checks import refuse_impossible
from caviar_clients.files import reserved, write_file
from caviar_clients.plots.rays import Footprints, footprints, obstacle_boxes, with_boxes
from caviar_protocol.errors import AssetError
from caviar_space.mitsuba_xml import find_scenery, read_scenery

CLASSES = 12
"""Classes of objects with a bar of their own at most."""


def _quiet(*_: object) -> None:
    """Discard what is reported."""


def write_page(
    dataset: str | Path,
    out: Path | None = None,
    progress: Progress = _quiet,
    note: Callable[[str], None] = _quiet,
) -> Path:
    """Write the page of a dataset.

    Args:
        dataset: Folder or address of the dataset.
        out: The file; None: ``look.html`` in the folder, of an address in that of the cache.
        progress: Is told how far it is.
        note: Called with a line for each kind of thing that is left out: how many, and why.

    Returns:
        The file.

    Raises:
        RecordingError: The folder is no dataset, or its catalogue has what cannot be.
        SetupError: Matplotlib is not installed.
        RunError: The file cannot be written.

    Example:
        >>> write_page(Path("data/s008"))  # doctest: +SKIP
        PosixPath('data/s008/look.html')
    """
    data = Dataset(dataset)  # before anything is written: a folder that is no dataset stays as it is
    file = out or data.directory.page
    with reserved(file):
        write_file(file, page(data, progress, note))
    return file


def page(data: Dataset, progress: Progress = _quiet, note: Callable[[str], None] = _quiet) -> str:
    """Make the page of a dataset.

    Args:
        data: The dataset.
        progress: Is told how far it is.
        note: As of `write_page`.

    Returns:
        HTML.

    Raises:
        RecordingError: The catalogue cannot be read, or has what cannot be; names table, row and column.
        SetupError: Matplotlib is not installed.
    """
    catalogue = Catalogue(data.directory.catalogue)
    try:
        refuse_impossible(catalogue, but=BEAM_COLUMNS)
        _, rows = catalogue.query("SELECT DISTINCT topic FROM products WHERE status <> 'absent'")
        topics = {topic for (topic,) in rows}
        found, error = _scenery(data)
        users = read_users(catalogue, progress)
        content = Content(data, catalogue, topics, users, read_sample(data, topics, progress), found, error)
        for text in (impossible_beams(content), _unread(content.sample)):
            if text:
                note(f"{text}; caviar dataset verify {data.location} says more")
        sections = list[Section]()
        for at, (name, title, make) in enumerate(_SECTIONS):
            some = len(data) or name in ("dataset", "generation")
            parts = make(content) if some else [absent("No episode is there yet.")]
            sections.append(Section(name, title, "\n".join(parts)))
            progress("sections of the page", at + 1, len(_SECTIONS))
    finally:
        catalogue.close()
    return document(name_of(data), data.name, sections)


def _unread(sample: Sample) -> str:
    """Which recordings are left out, and why; empty where none is."""
    if not sample.left_out:
        return ""
    number, why = sample.left_out[0]
    read = f"{len(sample.left_out)} of {counted(len(sample.episodes), 'recording')}"
    return f"left out: {read} that cannot be read, the first of episode {number}: {why}"


def _scenery(data: Dataset) -> tuple[Footprints | None, str]:
    """Outlines of what stands still; and why there are none, where that is an error."""
    files = sorted(path for path in data.assets.rglob("*") if path.is_file())
    assets = {path.relative_to(data.assets).as_posix(): path for path in files}
    drawn, error = None, ""
    try:
        description = find_scenery(assets)
        if description is not None:
            drawn = footprints((shape.file, shape.to_world) for shape in read_scenery(description).shapes)
    except AssetError as caught:
        error = str(caught)
    boxes = obstacle_boxes(scenario_of(data).get("services"))
    return with_boxes(drawn, boxes) if boxes else drawn, error


# --- what it is ------------------------------------------------------------------------------------------

_NO_CHANNEL = "No channel is recorded: there are no users."


def _what_it_is(content: Content) -> Iterator[str]:
    return what_it_is(content.data, content.catalogue, len(content.users), content.sample)


def _coverage(content: Content) -> Iterator[str]:
    users = content.users
    if not len(users):
        yield absent(_NO_CHANNEL)
        return
    placed = users.placed
    if not placed.any():
        yield absent("No scene is recorded: where the users were is not known.")
        return
    if content.scenery_error:
        yield absent(f"The scenery cannot be drawn: {content.scenery_error}")
    number = counted(int(placed.sum()), "user")
    place = map_of(users, content.footprints, content.sample.transmitters)
    gains = users.gain_db[placed & np.isfinite(users.gain_db)]
    span = f", from {decimal(gains.min())} dB to {decimal(gains.max())} dB" if len(gains) else ""
    buildings = "outlines of buildings" if content.footprints is not None else "no buildings"
    height = map_height(place)
    dots = place.dots is not None
    where = "at each place, to 0.1 m" if dots else f"in cells of {cell_m(place):g} m"
    lacking = int((placed & ~np.isfinite(users.gain_db)).sum())
    without = ""
    if lacking:
        marked = "a cross stands" if dots else "cells are grey"
        without = f" {counted(lacking, 'user')} had no path; {marked} where nobody had one."
    yield figure(
        picture(
            draw_gain(users, place),
            f"Map of {number} seen from above, {buildings}, coloured by gain{span}.",
            height,
            map_like=True,
        ),
        f"Where users were ({number}), coloured by the median gain {where}. Gain is the sum of |a|² over the "
        f"paths{span}.{without}",
    )
    share = float(users.los[placed].mean())
    yield figure(
        picture(
            draw_sight_map(users, place),
            f"Map of the share of users with a line of sight, {percent(share)} of all, {buildings}.",
            height,
            map_like=True,
        ),
        f"Share of users with a free line of sight, in cells of {cell_m(place):g} m; over all cells "
        f"{percent(share)}.",
    )


def _sight(content: Content) -> Iterator[str]:
    users = content.users
    if not len(users):
        yield absent(_NO_CHANNEL)
        return
    _, rows = content.catalogue.query(
        "SELECT object_class, count(*), sum(los AND valid), sum(valid AND NOT los), sum(NOT valid) "
        "FROM users GROUP BY object_class ORDER BY count(*) DESC, object_class"
    )
    kept = rows[:CLASSES]
    total = tuple(sum(row[column] for row in rows) for column in range(1, 5))
    named = [(_class(name), *numbers) for name, *numbers in kept]
    bars = [("all", *total), *named] if len(named) > 1 else named
    yield table(
        ("users on", "users", "valid", "line of sight", "other paths only", "no path"),
        [
            (name, f"{count:,}", percent(1 - none / count), percent(sight / count), percent(hidden / count),
             percent(none / count))
            for name, count, sight, hidden, none in (*named, ("all", *total))
        ],
        right=(1, 2, 3, 4, 5),
    )  # fmt: skip
    count, sight, hidden, none = total
    shares = f"{percent(sight / count)} have a line of sight, {percent(hidden / count)} other paths only"
    names, _, *parts = zip(*bars, strict=True)
    few = counted(len(rows) - CLASSES, "class", "classes")
    left_out = f" Without a bar: {few} with fewest users." if len(rows) > CLASSES else ""
    yield figure(
        picture(
            draw_shares(names, *parts),
            f"Bars of the shares of users by class of object: of all, {shares}, "
            f"{percent(none / count)} no path.",
            0.9 + 0.42 * len(bars),
        ),
        f"A user is valid where a path reaches it: {percent(1 - none / count)} are. "
        f"Of all users, {shares}.{left_out}",
    )
    _, scenes = content.catalogue.query("SELECT users FROM scenes")
    each = np.array([number for (number,) in scenes])
    yield figure(
        picture(
            draw_counts([("Users of a scene", each), ("Paths of a user", users.paths)]),
            f"Histograms of users of a scene, {each.min()} to {each.max()}, and of paths of a user, "
            f"{users.paths.min()} to {users.paths.max()}.",
            3.3,
        ),
        f"Users of a scene, receivers for each carrier and transmitter, on average {each.mean():.3g}; "
        f"paths of a user, on average {users.paths.mean():.3g}.",
    )


def _class(name: str) -> str:
    return name or "(stands still)"


def _gain(content: Content) -> Iterator[str]:
    users = content.users
    some = np.isfinite(users.gain_db)
    if not len(users):
        yield absent(_NO_CHANNEL)
        return
    if not some.any():
        yield absent("No user has a path: there is neither gain nor delay.")
        return
    yield _histogram(users, users.gain_db, some, "Gain", "dB", "sum of |a|² over the paths of a user")
    # Of a single path it is 0 but for rounding.
    spread = np.where(users.spread_s < _NO_SPREAD_S, 0.0, users.spread_s)
    some &= np.isfinite(spread)
    if not spread[some].any():
        yield absent("The delay spread of all users is 0: each has one path, or paths of equal length.")
        return
    explained = "square root of the second central moment of the power delay profile"
    unit, name = small_time_unit(float(np.percentile(spread[some], 95)))
    yield _histogram(users, spread / unit, some, "Delay spread", name, explained)


_NO_SPREAD_S = 1e-15


def _histogram(users: UserColumns, values: Any, some: Any, name: str, unit: str, explained: str) -> str:
    carriers = _by_carrier(users, some)
    panels = [(title, values[mask & some], users.los[mask & some]) for title, mask in carriers]
    low, median, high = (f"{decimal(at)} {unit}" for at in np.percentile(values[some], [5, 50, 95]))
    middle = f"median {median}, nine of ten from {low} to {high}"
    alt = f"Histogram of the {name.lower()}: {middle}."
    shown = picture(draw_histograms(panels, f"{name} [{unit}]"), alt, _rows_height(len(panels)))
    return figure(shown, f"{name}: {explained}; {middle}.")


def _by_carrier(users: UserColumns, some: Any) -> list[tuple[str, Any]]:
    """Title and mask of each carrier that has users; the first ones only where they are many."""
    names = sorted({carrier for carrier, _ in users.groups})
    found = []
    for name in names:
        of_carrier = [at for at, (carrier, _) in enumerate(users.groups) if carrier == name]
        mask = np.isin(users.group, of_carrier)
        if (mask & some).any():
            found.append((f"carrier {name}" if len(names) > 1 else "", mask))
    return found[:PANELS]


def _rows_height(panels: int) -> float:
    return 3.0 * (-(-panels // 2)) + 0.5


def _angles(content: Content) -> Iterator[str]:
    sample = content.sample
    if "channel" not in content.topics:
        yield absent("No channel is recorded: there are no angles.")
    elif not sample.paths:
        yield absent(f"No path is in {sampled(content)}: there are no angles.")
    else:
        yield figure(
            picture(
                draw_angles(sample),
                "Four histograms: azimuth and zenith angle of the paths at departure and at arrival, of all "
                "paths and of the strongest path of each user.",
                5.6,
            ),
            f"{counted(sample.paths, 'path')} of {sampled(content)}. Angles are in world axes: zenith from "
            "+z, azimuth counter-clockwise from +x (east); arrival is the direction that the wave comes "
            "from.",
        )


def _correlation(content: Content) -> Iterator[str]:
    sample = content.sample
    _, ((most,),) = content.catalogue.query("SELECT max(scenes) FROM episodes")
    if "channel" not in content.topics:
        yield absent("No channel is recorded: there is nothing to compare.")
    elif (most or 0) < 2:
        yield absent("Episodes have one scene: there are no consecutive scenes to compare.")
    elif not sample.read:
        yield absent("No recording in the folder can be read: there is nothing to compare.")
    elif not sample.has_h:
        yield absent("The matrices H are not recorded (channel.h): they cannot be compared.")
    elif not any(sample.consecutive):
        yield absent("No user has a path in two consecutive scenes of the sample.")
    else:
        values = np.array(sample.correlation)[np.array(sample.consecutive)]
        *others, last = lags(sample)
        later = f"; of scenes {time_text(last.apart_s)} apart {last.median:.3f}" if others else ""
        median = float(np.median(values))
        yield figure(
            picture(
                draw_correlation(sample),
                "Correlation of the channel matrices of scenes of an episode: a histogram for consecutive "
                f"scenes, median {median:.3f}{later}.",
                3.4,
            ),
            "|⟨H(k), H(k+1)⟩| / (‖H(k)‖ ‖H(k+1)‖) of the same user in two scenes of "
            f"{sampled(content)}: 1 where the channel has not changed but for a factor. Median of the "
            f"{counted(len(values), 'pair')} of consecutive scenes {median:.3f}{later}.",
        )


_SECTIONS: tuple[tuple[str, str, Callable[[Content], Iterator[str]]], ...] = (
    ("dataset", "What it is", _what_it_is),
    ("coverage", "Coverage", _coverage),
    ("sight", "Line of sight and paths", _sight),
    ("gain", "Gain and delay spread", _gain),
    ("angles", "Angles", _angles),
    ("beams", "Best beams", beams_section),
    ("correlation", "Correlation of consecutive scenes", _correlation),
    ("lidar", "LIDAR", lidar_section),
    ("cameras", "Cameras", camera_section),
    ("generation", "Generation", generation_section),
)
