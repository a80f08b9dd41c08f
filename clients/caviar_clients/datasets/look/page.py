"""Page of a dataset, one HTML file: ``page.html``, filled with what is known of the dataset and its figures.

The file is whole: pictures are in it, nothing is loaded from elsewhere, and it needs no JavaScript. For each
section a function returns the values that its macro of the template shows; the words are in the template.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.look import figures, maps
from caviar_clients.datasets.look.data import (
    SAMPLE_SCENES,
    Content,
    Progress,
    Sample,
    UserColumns,
    read_sample,
    read_throughput,
    read_users,
)
from caviar_clients.datasets.look.figures import picture, pixels
from caviar_clients.datasets.reader import Dataset
from caviar_clients.datasets.shares import count_users, paper_counts
from caviar_clients.datasets.texts import (
    bytes_text,
    counted,
    decimal,
    duration_text,
    percent,
    rate_unit,
    small_time_unit,
    time_text,
)
from caviar_clients.datasets.verification.verify import refuse_impossible
from caviar_clients.files import reserved, write_file
from caviar_clients.plots.rays import Footprints, footprints, obstacle_boxes, with_boxes
from caviar_protocol.errors import AssetError, CaviarError, SetupError
from caviar_protocol.host import install_command
from caviar_protocol.space.codebooks import beam_count
from caviar_protocol.topics import AntennaArray, Carrier
from caviar_space.mitsuba_xml import find_scenery, read_scenery

CLASSES = 12
"""Classes of objects with a bar of their own at most."""
MOST_PAIRS = 2**24
"""Pairs of beams of a picture: more are finer than its pixels, and take the memory of the machine."""
BEAM_COLUMNS = ("users.tx_beam", "users.rx_beam")
"""Columns of which values that cannot be are left out: the rest of the row may be right."""
_MOST_BEAMS = 2**31
"""That a recorded index of a beam can number."""
_NO_SPREAD_S = 1e-15
"""Delay spread [s] below which it is rounding, as of a single path."""
_BANDWIDTH_HZ = Carrier(name="default", frequency_hz=1.0).bandwidth_hz  # a kept scenario lacks defaults
_MAIN_VERSIONS = ("caviar-sim", "python", "numpy", "sionna", "sionna-rt", "mitsuba", "drjit", "eclipse-sumo")


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
        RecordingError: The folder is no dataset, or its catalogue cannot be read or has what cannot be; names
            table, row and column.
        SetupError: Matplotlib or Jinja2 is not installed.
        RunError: The file cannot be written.

    Example:
        >>> write_page(Path("data/s008"))  # doctest: +SKIP
        PosixPath('data/s008/look.html')
    """
    data = Dataset(dataset)  # before anything is written: a folder that is no dataset stays as it is
    file = out or data.directory.page
    with reserved(file):
        write_file(file, _page(data, progress, note))
    return file


def _page(data: Dataset, progress: Progress, note: Callable[[str], None]) -> str:
    """Make the page of a dataset."""
    template = _template()
    catalogue = Catalogue(data.directory.catalogue)
    try:
        refuse_impossible(catalogue, but=BEAM_COLUMNS)
        _, rows = catalogue.query("SELECT DISTINCT topic FROM products WHERE status <> 'absent'")
        topics = {topic for (topic,) in rows}
        found, error = _scenery(data)
        users = read_users(catalogue, progress)
        content = Content(data, catalogue, topics, users, read_sample(data, topics, progress), found, error)
        impossible = _impossible_beams(content)
        for text in (impossible, _unread(content.sample)):
            if text:
                note(f"{text}; caviar dataset verify {data.location} says more")
        made: dict[str, Any] = {}
        for at, (name, values_of) in enumerate(_SECTIONS.items()):
            if len(data) or name in ("dataset", "generation"):
                made[name] = values_of(content)
            progress("sections of the page", at + 1, len(_SECTIONS))
    finally:
        catalogue.close()
    page: str = template.render(
        name=str(_scenario_of(data).get("run", {}).get("name", "")) or data.name,
        folder=data.name,
        settings=data.settings,
        topics=topics,
        users=len(users),
        sampled=_sampled(content.sample),
        left_out=content.sample.left_out,
        impossible_beams=impossible,
        made=made,
    )
    return page


def _template() -> Any:
    """Load the template, with what writes numbers as its filters."""
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
        from markupsafe import Markup
    except ImportError as error:
        raise SetupError(f"the page needs {error.name}; run: {install_command('plot')}") from error
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "bytes": bytes_text, "counted": counted, "decimal": decimal, "duration": duration_text,
        "percent": percent, "time": time_text,
        "n": "{:,}".format, "g": "{:g}".format, "g3": "{:.3g}".format, "f3": "{:.3f}".format,
        # The lines of a sentence of the template as one.
        "joined": lambda text: Markup(" ").join(text.split()),
    }  # fmt: skip
    return environment.get_template("page.html")


def _unread(sample: Sample) -> str:
    """Name the recordings that are left out, and why; empty where none is."""
    if not sample.left_out:
        return ""
    number, why = sample.left_out[0]
    read = f"{len(sample.left_out)} of {counted(len(sample.episodes), 'recording')}"
    return f"left out: {read} that cannot be read, the first of episode {number}: {why}"


def _sampled(sample: Sample) -> str:
    """The sample in words."""
    episodes = counted(sample.read, "recorded episode")
    if sample.read < sample.there:
        episodes = f"{sample.read:,} of the {counted(sample.there, 'recorded episode')}, drawn with seed 0"
    first = f", of each the first {SAMPLE_SCENES} scenes" if sample.cut else ""
    return f"{episodes} ({counted(sample.scenes, 'scene')}{first})"


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
    boxes = obstacle_boxes(_scenario_of(data).get("services"))
    return with_boxes(drawn, boxes) if boxes else drawn, error


def _scenario_of(data: Dataset) -> dict[str, Any]:
    scenario: dict[str, Any] = data.settings.get("scenario", {})
    return scenario


# --- sections --------------------------------------------------------------------------------------------


def _description(content: Content) -> dict[str, Any]:
    scenario, catalogue = _scenario_of(content.data), content.catalogue
    versions = content.data.settings.get("versions", {})
    _, ((episodes, scenes, size, least, most),) = catalogue.query(
        "SELECT count(*), coalesce(sum(scenes), 0), coalesce(sum(bytes), 0), min(scenes), max(scenes) "
        "FROM episodes"
    )
    _, ((receivers, objects),) = catalogue.query(
        "SELECT count(DISTINCT rx), count(DISTINCT nullif(object, '')) FROM users"
    )
    _, products = catalogue.query(
        "SELECT topic, source, count(*), sum(status = 'held'), sum(status = 'absent'), sum(bytes) "
        "FROM products GROUP BY topic, source ORDER BY topic, source"
    )
    text = msgspec.json.format(msgspec.json.encode(scenario), indent=2).decode()
    return {
        "episodes": episodes, "scenes": scenes, "size": size, "least": least, "most": most,
        "receivers": receivers, "objects": objects, "planned": catalogue.planned,
        "run": scenario.get("run", {}),
        "versions": [f"{name} {versions[name]}" for name in _MAIN_VERSIONS if name in versions],
        "gone": episodes - content.sample.there,
        "products": [
            (topic, source, f"{count:,}", f"{held:,}", f"{absent:,}", bytes_text(size))
            for topic, source, count, held, absent, size in products
        ],
        "carriers": [
            (
                c.get("name", ""),
                f"{c.get('frequency_hz', 0) / 1e9:g} GHz",
                f"{c.get('bandwidth_hz', _BANDWIDTH_HZ) / 1e6:g} MHz",
            )
            for c in scenario.get("carriers", ())
        ],
        "devices": [
            (
                d.get("name", ""),
                f"{d.get('kind', '')} {d.get('role', '')}".strip(),
                d.get("on") or "fixed",
                _device(d),
            )
            for d in scenario.get("devices", ())
        ],
        "services": [
            (name, spec.get("role", ""), spec.get("use", ""), _settings(spec.get("settings", {})))
            for name, spec in scenario.get("services", {}).items()
        ],
        "scenario": text if scenario else "",
    }  # fmt: skip


def _device(device: Mapping[str, Any]) -> str:
    """Describe a device by the settings of its kind."""
    array, kind = device.get("array"), device.get("kind")
    found = []
    if kind == "antenna" and isinstance(array, dict):
        rows, columns = array.get("rows", 1), array.get("columns", 1)
        found.append(f"{rows} × {columns} elements")
        found += [f"{key} {value}" for key, value in array.items() if key not in ("rows", "columns")]
        if device.get("role") == "tx":
            found.append(f"{device.get('power_dbm', 0):g} dBm")
    elif kind == "antenna":
        found.append("1 × 1 elements")
    if kind == "camera":
        width, height = device.get("size_px", (0, 0))
        found.append(f"{width} × {height} pixels, {device.get('field_of_view_deg', 0):g}°")
    if kind == "lidar":
        reach = device.get("range_m", (0.0, 0.0))
        found.append(f"{device.get('beams')} beams × {device.get('azimuth_steps')}, up to {reach[1]:g} m")
    if device.get("count", 1) != 1:
        found.append(f"at most {device['count']}")
    return ", ".join(found)


def _settings(settings: Mapping[str, Any]) -> str:
    """Settings as ``key = value``; what is long is only counted, and stands in the whole scenario."""
    found = []
    for key, value in settings.items():
        text = msgspec.json.encode(value).decode()
        long = len(text) > 80 and isinstance(value, list | tuple | dict)
        found.append(f"{key}: {counted(len(value), 'entry', 'entries')}" if long else f"{key} = {text}")
    return ", ".join(found)


def _coverage(content: Content) -> dict[str, Any]:
    users, placed = content.users, content.users.placed
    if not placed.any():
        return {}
    place = maps.map_of(users, content.footprints, content.sample.transmitters)
    gains = users.gain_db[placed & np.isfinite(users.gain_db)]
    height = maps.map_height(place)
    return {
        "placed": int(placed.sum()),
        "span": (gains.min(), gains.max()) if len(gains) else (),
        "has_buildings": content.footprints is not None,
        "scenery_error": content.scenery_error,
        "dots": place.dots is not None,
        "cell_m": maps.cell_m(place),
        "lacking": int((placed & ~np.isfinite(users.gain_db)).sum()),
        "share": float(users.los[placed].mean()),
        "gain": picture(maps.draw_gain(users, place), height, map_like=True),
        "sight": picture(maps.draw_sight_map(users, place), height, map_like=True),
    }


def _sight(content: Content) -> dict[str, Any]:
    users = content.users
    if not len(users):
        return {}
    _, rows = content.catalogue.query(
        "SELECT object_class, count(*), sum(los AND valid), sum(valid AND NOT los), sum(NOT valid) "
        "FROM users GROUP BY object_class ORDER BY count(*) DESC, object_class"
    )
    named = [(name or "(stands still)", *numbers) for name, *numbers in rows[:CLASSES]]
    total = tuple(sum(row[column] for row in rows) for column in range(1, 5))
    bars = [("all", *total), *named] if len(named) > 1 else named
    names, _, *parts = zip(*bars, strict=True)
    _, scenes = content.catalogue.query("SELECT users FROM scenes")
    each = np.array([number for (number,) in scenes])
    counts = {"Users of a scene": each, "Paths of a user": users.paths}
    table = [
        (name, f"{count:,}", *map(percent, (1 - none / count, sight / count, hidden / count, none / count)))
        for name, count, sight, hidden, none in (*named, ("all", *total))
    ]
    _, _, valid, sight, hidden, none = table[-1]
    return {
        "rows": table, "valid": valid, "sight": sight, "hidden": hidden, "none": none,
        "others": max(len(rows) - CLASSES, 0),
        "shares": str(count_users(content.data)),
        "paper": paper_counts(str(_scenario_of(content.data).get("run", {}).get("name", ""))),
        "bars": picture(figures.draw_shares(names, *parts), 0.9 + 0.42 * len(bars)),
        "each": each,
        "paths": users.paths,
        "counts": picture(figures.draw_counts(counts), 3.3),
    }  # fmt: skip


def _gain(content: Content) -> dict[str, Any]:
    users = content.users
    some = np.isfinite(users.gain_db)
    if not some.any():
        return {}
    spread = np.where(users.spread_s < _NO_SPREAD_S, 0.0, users.spread_s)
    known = some & np.isfinite(spread)
    found: dict[str, Any] = {"gain": _histogram(users, users.gain_db, some, "Gain", "dB"), "spread": None}
    if spread[known].any():
        unit, name = small_time_unit(float(np.percentile(spread[known], 95)))
        found["spread"] = _histogram(users, spread / unit, known, "Delay spread", name)
    return found


def _histogram(users: UserColumns, values: Any, some: Any, name: str, unit: str) -> dict[str, Any]:
    """Histogram of some users for each carrier, the first ones only where they are many; and percentiles."""
    carriers = sorted({carrier for carrier, _ in users.groups})
    panels = []
    for wanted in carriers:
        groups = [at for at, (carrier, _) in enumerate(users.groups) if carrier == wanted]
        mask = np.isin(users.group, groups) & some
        if mask.any():
            title = f"carrier {wanted}" if len(carriers) > 1 else ""
            panels.append((title, values[mask], users.los[mask]))
    panels = panels[: figures.PANELS]
    low, median, high = (f"{decimal(at)} {unit}" for at in np.percentile(values[some], [5, 50, 95]))
    shown = picture(figures.draw_histograms(panels, f"{name} [{unit}]"), 3.0 * -(-len(panels) // 2) + 0.5)
    return {"shown": shown, "low": low, "median": median, "high": high}


def _angles(content: Content) -> dict[str, Any]:
    paths = content.sample.paths
    return {"paths": paths, "shown": picture(figures.draw_angles(content.sample), 5.6)} if paths else {}


def _impossible_beams(content: Content) -> str:
    """Say how many best beams are in no codebook, which the page leaves out; empty where there is none."""
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


def _beams(content: Content) -> dict[str, Any]:
    users, roles = content.users, ("tx", "rx")
    columns = users.tx_beam, users.rx_beam
    some = np.all([(c >= 0) & (c < _limit(content, r)) for c, r in zip(columns, roles, strict=True)], axis=0)
    if "link" not in content.topics or not some.any():
        return {}
    tx_beams, rx_beams = (
        max(*_codebooks(content, role), int(column[some].max()) + 1, 1)
        for role, column in zip(roles, columns, strict=True)
    )
    if tx_beams * rx_beams > MOST_PAIRS:
        return {"shown": None, "codebooks": (tx_beams, rx_beams)}
    counts = np.bincount(users.group[some], minlength=len(users.groups))
    shown = [int(group) for group in np.argsort(-counts, kind="stable")[: figures.PANELS] if counts[group]]
    panels = []
    for group in sorted(shown):
        mask = some & (users.group == group)
        carrier, tx = users.groups[group]
        panels.append((f"{tx}, {carrier}", users.tx_beam[mask], users.rx_beam[mask]))
    pairs, numbers = np.unique(np.stack([users.group, *columns])[:, some], axis=1, return_counts=True)
    group, tx_beam, rx_beam = pairs[:, numbers.argmax()]
    carrier, tx = users.groups[group]
    return {
        "shown": picture(figures.draw_beams(panels, (tx_beams, rx_beams)), 3.2 * -(-len(panels) // 2) + 0.4),
        "carrier": carrier, "tx": tx, "tx_beam": tx_beam, "rx_beam": rx_beam,
        "pairs": pairs.shape[1],
        "share": numbers.max() / some.sum(),
        "others": int((counts > 0).sum()) - len(shown),
    }  # fmt: skip


def _limit(content: Content, role: str) -> int:
    """The first beam that no codebook of this role can have."""
    services = _scenario_of(content.data).get("services", {}).values()
    links = {spec.get("use") for spec in services if spec.get("role") == "link"}
    sizes = _codebooks(content, role)
    # These links take beams of the codebooks of arrays; others have those that they choose.
    return max(sizes) if links and sizes and links <= {"beams", "cell"} else _MOST_BEAMS


def _codebooks(content: Content, role: str) -> list[int]:
    """Beams of the arrays of this role."""
    found = []
    for device in _scenario_of(content.data).get("devices", ()):
        if device.get("role") in (role, "both") and isinstance(array := device.get("array"), dict):
            try:
                found.append(beam_count(msgspec.convert(array, AntennaArray)))
            except (msgspec.ValidationError, CaviarError):  # of another version, or machine
                found.append(array.get("rows", 1) * array.get("columns", 1))
    return found


def _correlation(content: Content) -> dict[str, Any]:
    sample = content.sample
    _, ((most,),) = content.catalogue.query("SELECT max(scenes) FROM episodes")
    reasons = {
        "No channel is recorded: there is nothing to compare.": "channel" not in content.topics,
        "Episodes have one scene: there are no consecutive scenes to compare.": (most or 0) < 2,
        "No recording in the folder can be read: there is nothing to compare.": not sample.read,
        "The matrices H are not recorded (channel.h): they cannot be compared.": not sample.has_h,
        "No user has a path in two consecutive scenes of the sample.": not any(sample.consecutive),
    }
    if absent := next((text for text, is_so in reasons.items() if is_so), ""):
        return {"absent": absent}
    values = np.array(sample.correlation)[np.array(sample.consecutive)]
    apart, _, median, _ = figures.lags(sample)
    return {
        "absent": "",
        "shown": picture(figures.draw_correlation(sample), 3.4),
        "pairs": len(values),
        "median": float(np.median(values)),
        "last": (apart[-1], median[-1]) if len(apart) > 1 else (),
    }


def _lidar(content: Content) -> dict[str, Any]:
    scans = content.sample.scans
    if not scans:
        return {}
    return {
        "shown": picture(maps.draw_scans(scans), maps.scans_height(scans), map_like=True),
        "has_grid": any(scan.grid is not None for scan in scans),
        "titles": [scan.title.replace("\n", ", ") for scan in scans],
    }


def _cameras(content: Content) -> dict[str, Any]:
    """Rows of pictures by moment: kinds of pictures of a camera in a row, or cameras that have one kind."""
    shots, moments = content.sample.shots, []
    for moment in dict.fromkeys(shot.moment for shot in shots):
        rows = [
            [(shot.sensor, kind, pixels(image)) for kind, image in shot.images.items()]
            for shot in shots
            if shot.moment == moment
        ]
        if all(len(row) == 1 for row in rows):
            rows = [[one for row in rows for one in row]]
        moments.append((moment, rows))
    recorded = bool(content.topics & {"camera", "depth", "segmentation"})
    return {"recorded": recorded, "moments": moments if recorded else []}


def _generation(content: Content) -> dict[str, Any]:
    found = read_throughput(content.catalogue)
    _, ((attempts,),) = content.catalogue.query("SELECT count(*) FROM failures")
    values: dict[str, Any] = {"found": found, "failures": content.catalogue.failures(), "attempts": attempts}
    if found is None:
        return values
    per, name = rate_unit(found.scenes / found.elapsed_s)
    shares = dict(sorted(found.services_s.items(), key=lambda item: -item[1]))
    if shares and (rest := found.busy_s - sum(shares.values())) > 0.0:
        shares["start, reset, saving"] = rest
    values |= {
        "rate": (per * found.scenes / found.elapsed_s, name),
        "throughput": picture(figures.draw_throughput(found), 3.1),
        "services": None,
    }
    if shares:
        longest = max(shares, key=lambda name: shares[name])
        values |= {
            "services": picture(figures.draw_services(shares, found.scenes), 0.9 + 0.36 * len(shares)),
            "longest": longest,
            "longest_share": shares[longest] / sum(shares.values()),
        }
    return values


_SECTIONS: dict[str, Callable[[Content], dict[str, Any]]] = {
    "dataset": _description,
    "coverage": _coverage,
    "sight": _sight,
    "gain": _gain,
    "angles": _angles,
    "beams": _beams,
    "correlation": _correlation,
    "lidar": _lidar,
    "cameras": _cameras,
    "generation": _generation,
}
