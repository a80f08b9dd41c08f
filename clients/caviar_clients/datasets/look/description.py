"""What a dataset is, in the words and tables at the head of its page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

import msgspec

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.look.data import Sample
from caviar_clients.datasets.look.html import absent, facts, folded, table
from caviar_clients.datasets.look.units import time_text
from caviar_clients.datasets.reader import Dataset
from caviar_clients.datasets.texts import bytes_text, counted

SHOWN_LEFT_OUT = 20
_MAIN_VERSIONS = ("caviar-sim", "python", "numpy", "sionna", "sionna-rt", "mitsuba", "drjit", "eclipse-sumo")


def what_it_is(data: Dataset, catalogue: Catalogue, users: int, sample: Sample) -> Iterator[str]:
    """Facts and tables of a dataset, and what of it cannot be read.

    Args:
        data: The dataset.
        catalogue: Its catalogue.
        users: How many rows of users there are.
        sample: What was read of its recordings.
    """
    scenario, settings = scenario_of(data), data.settings
    run, versions = scenario.get("run", {}), settings.get("versions", {})
    _, ((episodes, scenes, size, least, most),) = catalogue.query(
        "SELECT count(*), coalesce(sum(scenes), 0), coalesce(sum(bytes), 0), min(scenes), max(scenes) "
        "FROM episodes"
    )
    _, ((receivers, objects),) = catalogue.query(
        "SELECT count(DISTINCT rx), count(DISTINCT nullif(object, '')) FROM users"
    )
    planned = catalogue.planned
    of_planned = f" of {planned:,} that are planned" if planned > episodes else ""
    each = f"{least}" if least == most else f"{least:,} to {most:,}"
    carried = f", on {counted(objects, 'object')}" if objects else ""
    versioned = [f"{name} {versions[name]}" for name in _MAIN_VERSIONS if name in versions]
    known = {
        "Scenario": name_of(data),
        "Folder": data.name,
        "Episodes": f"{episodes:,}{of_planned}",
        "Scenes": f"{scenes:,}" + (f", {each} in each episode" if episodes else ""),
        "Users": f"{users:,}: a receiver in a scene, for each carrier and transmitter",
        "Receivers": f"{receivers:,} by name{carried}",
        "Size": f"{bytes_text(size)} of recordings, {bytes_text(size / scenes)} for a scene"
        if scenes
        else "0 B",
        "Seed": str(run.get("seed", "not kept")),
        "Time between scenes": _period(run),
        "Computed on": str(settings.get("device", "not kept")),
        "Versions": ", ".join(versioned) or "not kept",
    }
    yield facts(known)
    yield from _left_out(sample)
    if gone := episodes - sample.there:
        yield absent(
            f"The recordings of {counted(gone, 'episode')} are not in the folder: of them there is what the "
            "catalogue says."
        )
    yield from _products(catalogue)
    yield from _carriers_and_devices(scenario)
    yield from _services(scenario)
    others = {name: str(version) for name, version in sorted(versions.items())}
    if others:
        yield folded("All versions", table(("package", "version"), others.items()))
    files = settings.get("files", {})
    if files:
        yield folded("Files of the scenario", table(("file", "SHA-256"), files.items(), code=(0, 1)))
    if scenario:
        text = msgspec.json.format(msgspec.json.encode(scenario), indent=2).decode()
        yield folded("The whole scenario", f"<pre>{escape(text)}</pre>")


def _left_out(sample: Sample) -> Iterator[str]:
    """Recordings that cannot be read."""
    if not sample.left_out:
        return
    number = counted(len(sample.left_out), "recording")
    yield absent(
        f"{number} of the sample cannot be read, and {'is' if len(sample.left_out) == 1 else 'are'} left "
        "out: remove the folder of such an episode, and the generate command plays it again. caviar dataset "
        "verify looks at all of them."
    )
    shown = [(str(episode), text) for episode, text in sample.left_out[:SHOWN_LEFT_OUT]]
    yield table(("episode", "why"), shown, right=(0,))


def _period(run: Mapping[str, Any]) -> str:
    if run.get("instants_s"):
        return f"as listed in run.instants_s, {counted(len(run['instants_s']), 'instant')}"
    period = run.get("sampling_period_ns")
    return time_text(period * 1e-9) if period else "not kept"


def _products(catalogue: Catalogue) -> Iterator[str]:
    _, rows = catalogue.query(
        "SELECT topic, source, count(*), sum(status = 'held'), sum(status = 'absent'), sum(bytes) "
        "FROM products GROUP BY topic, source ORDER BY topic, source"
    )
    if rows:
        yield "<h3>What is recorded</h3>"
        found = [
            (topic, source, f"{count:,}", f"{held:,}", f"{absent:,}", bytes_text(size))
            for topic, source, count, held, absent, size in rows
        ]
        heads = ("topic", "service", "products", "held", "absent", "before compression")
        yield table(heads, found, code=(0, 1), right=(2, 3, 4, 5))


def _carriers_and_devices(scenario: Mapping[str, Any]) -> Iterator[str]:
    carriers = [
        (
            c.get("name", ""),
            f"{c.get('frequency_hz', 0) / 1e9:g} GHz",
            f"{c.get('bandwidth_hz', 0) / 1e6:g} MHz",
        )
        for c in scenario.get("carriers", ())
    ]
    if carriers:
        yield "<h3>Carriers</h3>"
        yield table(("carrier", "frequency", "bandwidth"), carriers, code=(0,), right=(1, 2))
    devices = [
        (
            d.get("name", ""),
            f"{d.get('kind', '')} {d.get('role', '')}".strip(),
            d.get("on") or "fixed",
            _device(d),
        )
        for d in scenario.get("devices", ())
    ]
    if devices:
        yield "<h3>Devices</h3>"
        yield table(("device", "kind", "on", "settings"), devices, code=(0, 2))


def _device(device: Mapping[str, Any]) -> str:
    """What matters of a device of its kind."""
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


def _services(scenario: Mapping[str, Any]) -> Iterator[str]:
    rows = [
        (name, spec.get("role", ""), spec.get("use", ""), _settings(spec.get("settings", {})))
        for name, spec in scenario.get("services", {}).items()
    ]
    if rows:
        yield "<h3>Services</h3>"
        yield table(("service", "role", "implementation", "settings"), rows, code=(0, 2))


def _settings(settings: Mapping[str, Any]) -> str:
    """Settings as ``key = value``; what is long is only counted, and stands in the whole scenario."""
    found = []
    for key, value in settings.items():
        text = msgspec.json.encode(value).decode()
        long = len(text) > 80 and isinstance(value, list | tuple | dict)
        found.append(f"{key}: {counted(len(value), 'entry', 'entries')}" if long else f"{key} = {text}")
    return ", ".join(found)


# --- coverage and paths ----------------------------------------------------------------------------------


def scenario_of(data: Dataset) -> dict[str, Any]:
    scenario = data.settings.get("scenario")
    return scenario if isinstance(scenario, dict) else {}


def name_of(data: Dataset) -> str:
    return str(scenario_of(data).get("run", {}).get("name", "")) or data.name
