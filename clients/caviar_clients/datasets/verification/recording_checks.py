"""What the recording of an episode has to have: its scenes and instants, its seed, products, and meshes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Set
from pathlib import Path, PurePosixPath
from typing import Any

from caviar_clients.datasets.verification.findings import Finding, listed, runs
from caviar_protocol.errors import AssetError
from caviar_protocol.messages import Status
from caviar_protocol.recording import FrameEntry, Recording
from caviar_protocol.topics import AntennaDevice, Scene
from caviar_space.scenery import scenery_assets

_BUNDLED = "sionna:"


def scenes_and_stamps(recording: Recording, run: Mapping[str, Any], number: int) -> Iterator[Finding]:
    """Scenes that are missing, or stamped with another instant than the scenario has.

    Args:
        recording: Of the episode.
        run: Table ``run`` of the scenario.
        number: Of the episode.
    """
    period, instants = int(run.get("sampling_period_ns", 0)), run.get("instants_s", ())
    expected = int(run.get("frames", len(recording)))
    entries = _entries(recording)
    if [entry.frame for entry in entries] != list(range(expected)):
        has = ", ".join(str(entry.frame) for entry in entries[:8])
        more = ", …" if len(entries) > 8 else ""
        yield Finding(number, None, "", "scenes", f"0 to {expected - 1}", has + more)
        return
    for entry in entries:
        right = round(instants[entry.frame] * 1e9) if instants else entry.frame * period
        if entry.t_ns != right:
            yield Finding(number, entry.frame, "", "stamp", f"{right} ns", f"{entry.t_ns} ns")
        if entry.episode != number:
            yield Finding(number, entry.frame, "", "episode", str(number), str(entry.episode))


def seeds(recording: Recording, run: Mapping[str, Any], number: int) -> Iterator[Finding]:
    """Seeds that are not that of the dataset: all episodes have it, and services derive theirs from it and
    from the number of the episode (`caviar_protocol.seeding`).

    Args:
        recording: Of the episode.
        run: Table ``run`` of the scenario; without a seed nothing is compared.
        number: Of the episode.
    """
    if "seed" not in run:
        return
    right = run["seed"]
    if recording.metadata.seed != right:
        yield Finding(number, None, "", "seed of the recording", str(right), str(recording.metadata.seed))
    wrong = [entry for entry in _entries(recording) if entry.seed != right]
    if wrong:
        where = listed(runs(entry.frame for entry in wrong), "scene")
        yield Finding(number, wrong[0].frame, "", "seed", str(right), f"{wrong[0].seed} in {where}")


def products(recording: Recording, run: Mapping[str, Any], number: int) -> Iterator[Finding]:
    """Topics and sources that some scenes lack: those that the scenario records, and those of other scenes.

    Args:
        recording: Of the episode.
        run: Table ``run`` of the scenario.
        number: Of the episode.

    Yields:
        A finding for each topic and source, at the first scene that lacks it.
    """
    entries = _entries(recording)
    lacks: dict[tuple[str, str], list[int]] = {}
    causes: dict[tuple[str, str], str] = {}
    known = {(item.topic, item.source) for entry in entries for item in entry.inputs}
    named = {topic for topic, _ in known}
    known |= {(topic, "") for name in run.get("record", ()) if (topic := name.partition(".")[0]) not in named}
    for entry in entries:
        there = {(i.topic, i.source) for i in entry.inputs if i.status is not Status.ABSENT}
        for item in entry.inputs:
            if item.status is Status.ABSENT:
                causes.setdefault((item.topic, item.source), item.cause)
        for key in known - there:
            lacks.setdefault(key, []).append(entry.frame)
    for (topic, source), scenes in sorted(lacks.items()):
        cause = causes.get((topic, source), "")
        found = f"none in {listed(runs(scenes), 'scene')}{': ' * bool(cause)}{cause}"
        what = f"product {topic}{' of ' * bool(source)}{source}"
        yield Finding(number, scenes[0], "", what, "one in each scene", found)


def _entries(recording: Recording) -> list[FrameEntry]:
    return [recording.entry(index) for index in range(len(recording))]


# --- files that a dataset shares ----------------------------------------------------------------------------


def lacking_scenery(settings: Mapping[str, Any], assets: Mapping[str, Path]) -> Iterator[Finding]:
    """Files of scenery that the scenario's worlds name and that are not in the dataset, or cannot be read.

    Args:
        settings: Of the dataset.
        assets: Files of the dataset by asset name.
    """
    services = settings.get("scenario", {}).get("services", {})
    for spec in services.values() if isinstance(services, dict) else ():
        given = spec.get("settings", {}) if isinstance(spec, dict) and spec.get("role") == "world" else {}
        scenery = given.get("scenery") if isinstance(given, dict) else None
        if not isinstance(scenery, str) or not (scenery.endswith(".xml") or scenery.startswith(_BUNDLED)):
            continue
        # Of a user's file the folder is left out, and the file of a bundled scene may have another name.
        if scenery.startswith(_BUNDLED):
            described = [one for one in assets if PurePosixPath(one).match("scenery/*.xml")]
            name = described[0] if described else f"scenery/{scenery.removeprefix(_BUNDLED)}.xml"
        else:
            name = f"scenery/{PurePosixPath(scenery.removeprefix('file:')).name}"
        if name not in assets:
            yield Finding(-1, None, "", "scenery", f"the file assets/{name} in the dataset", "none")
            continue
        try:
            scenery_assets(str(assets[name].resolve()))
        except AssetError as error:
            yield Finding(-1, None, "", "scenery", f"assets/{name} with all that it names", str(error))


def lacking_assets(scene: Scene, assets: Set[str]) -> Iterator[tuple[str, str]]:
    """Files that a scene names and that are in neither the dataset nor the recording.

    Args:
        scene: The scene.
        assets: Names of the files that are there.

    Yields:
        What names the file, and its name.
    """
    for name, asset in zip(scene.names, scene.assets, strict=True):
        if asset and asset not in assets:
            yield name, asset
    for device in scene.devices:
        pattern = device.array.pattern_file if isinstance(device, AntennaDevice) else ""
        if pattern and pattern not in assets:
            yield device.name, pattern
