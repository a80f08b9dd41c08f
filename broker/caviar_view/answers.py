"""Answers to a viewer: a path below ``data/`` and its query become bytes of JSON or of products.

A product is laid out as a message of the gateway's WebSocket (protocol/SPEC.md): a map that says what it is,
header and body as on the wire, of fewer paths, points and pixels than the product where it has many.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple, cast
from zipfile import BadZipFile

import msgspec
import numpy as np
from msgspec.structs import replace

from caviar_protocol.arrays import Payload
from caviar_protocol.codec import encode_payload, join_parts
from caviar_protocol.errors import CaviarError, RecordingError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.recording import FrameEntry
from caviar_protocol.space.codebooks import codebook_of
from caviar_protocol.space.coordinates import unit_vectors
from caviar_protocol.space.scene import merge_scenes
from caviar_protocol.topics import (
    TOPICS,
    AntennaDevice,
    Camera,
    Channel,
    Depth,
    Lidar,
    Link,
    Scene,
    Segmentation,
)
from caviar_view.frames import AnsweredGrants, Frames
from caviar_view.world import World, whole

JSON = "application/json"
BINARY = "application/octet-stream"

PATHS, POINTS, PIXELS = 25, 20_000, 320
"""Paths of a pair, points of all scans, and width of a picture [px], unless a query says otherwise."""
CELLS = 40_000
"""Cells of a radio map."""
CURVE_POINTS = 400
"""Frames of curves: each costs a chunk of the recording."""

SERIES: dict[str, tuple[str, Callable[[Link], Any]]] = {
    "abs_y": ("1", lambda link: link.abs_y),
    "baseline_abs_y": ("1", lambda link: link.baseline_abs_y),
    "best_abs_y": ("1", lambda link: link.top_abs_y[:, 0] if link.top_abs_y.shape[1] else None),
    "snr_db": ("dB", lambda link: _decibels(link.snr)),
    "snr_best_db": ("dB", lambda link: _decibels(link.snr_best)),
    "sinr_db": ("dB", lambda link: None if link.sinr is None else _decibels(link.sinr)),
    "spectral_efficiency": ("bit/s/Hz", lambda link: link.spectral_efficiency),
    "bit_rate": ("bit/s", lambda link: link.bit_rate),
    "throughput": ("bit/s", lambda link: link.throughput),
    "buffered": ("bit", lambda link: link.buffered),
    "delay": ("s", lambda link: link.delay),
    "reward": ("1", lambda link: link.reward),
}
"""Curves of a user: unit, and values of all users of a link."""


_SHOWN = (Status.FRESH, Status.HELD)


class NotThereError(CaviarError):
    """There is nothing of that name to show."""


class Answer(NamedTuple):
    """Content of an answer, and its media type."""

    content: bytes
    media_type: str


class Answers:
    """Answers about frames and their world.

    Args:
        frames: Frames to show.
        controls: Whether this address can pause, step and stop the run.
        beside: Whether a second run is shown beside.
    """

    def __init__(self, frames: Frames, *, controls: bool = False, beside: bool = False) -> None:
        self.frames, self.world = frames, World(frames.assets, frames.scenario)
        self._flags = {"controls": controls, "beside": beside}
        self._links: dict[int, Link | None] = {}
        # A recording's reader keeps the newest chunk, and is asked by several threads of the server.
        self._lock = threading.Lock()

    def get(self, path: str, query: Mapping[str, str] | None = None) -> Answer:
        """Answer a request.

        Args:
            path: After ``data/``, such as ``frames/12/scene``.
            query: Its parameters.

        Raises:
            NotThereError: There is no such path, frame, product, device or beam.
            RecordingError: What is asked for is damaged.
        """
        query = query or {}
        match path.split("/"):
            case ["about"]:
                return _json(self.about())
            case ["meshes", name]:
                content = self.world.mesh(name)
                if content is None:
                    raise NotThereError(f"there is no mesh {name!r}")
                return Answer(content, BINARY)
            case ["radio-map"]:
                return _json(self._radio_map())
            case ["frames", place]:
                return _json(self._frame(self._place(place)))
            case ["frames", place, "lobes"]:
                return _json(self._lobe(self._place(place), query))
            case ["frames", place, topic] if topic in TOPICS:
                return self._product(self._place(place), topic, query)
            case ["curves"]:
                return _json(self._curves(query))
            case ["clock"]:
                return _json(self._clock(query))
        raise NotThereError(f"there is nothing at data/{path}")

    def about(self) -> dict[str, Any]:
        """What a viewer has to know of a run before it shows a frame."""
        frames = self.frames
        services: Mapping[str, Any] = frames.scenario.get("services") or {}
        run: Mapping[str, Any] = frames.scenario.get("run") or {}
        return {
            "kind": frames.kind,
            "live": frames.kind == "run",
            "name": run.get("name", ""),
            "run": frames.run,
            "seed": frames.seed,
            "sampling_period_s": run.get("sampling_period_ns", 0) / 1e9,
            "topics": frames.topics,
            "carriers": frames.scenario.get("carriers") or [],
            "services": [_service(name, spec) for name, spec in services.items()],
            "frames": self.blocks(),
            "complete": frames.complete,
            "damage": list(frames.damage),
            "every": 1,
            "radio_map": frames.radio_map is not None,
            **self._flags,
            **self.world.about(),
        }

    def blocks(self, first: int = 0) -> list[dict[str, int]]:
        """Runs of consecutive frames from a place on: episode, first frame, its place, and their number."""

        def block(place: int) -> tuple[int, int]:
            entry = self.frames.entry(place)
            return entry.episode, entry.frame - place

        found = []
        for (episode, offset), places in groupby(
            range(max(first, self.frames.first), self.frames.end), block
        ):
            held = list(places)
            found.append(
                {
                    "episode": episode,
                    "first_frame": held[0] + offset,
                    "first": held[0],
                    "count": len(held),
                }
            )
        return found

    def topics_of(self, place: int) -> list[str]:
        """Topics that a frame has a product of."""
        return sorted({item.topic for item in self.frames.entry(place).inputs if item.status in _SHOWN})

    def users(self, most: int = CURVE_POINTS) -> list[tuple[str, str, str]]:
        """TX, RX and carrier of each user of the frames that curves are of."""
        return _all_users(self._spread_links(most))

    def _spread_links(self, most: int) -> dict[int, Link | None]:
        """Links by place of so many frames at most, evenly over all."""
        places = _spread(self.frames.first, self.frames.end, most)
        # Those of the last request are kept, and no others: a run that goes on has ever new ones.
        self._links = {place: self._link(place) for place in places}
        return self._links

    def beams_of(self, place: int) -> set[tuple[str, int]]:
        """Devices, and their beams that are chosen or best in a frame."""
        link, found = self._link(place), set[tuple[str, int]]()
        if link is None:
            return found
        for i, (tx, rx, _) in enumerate(_users(link)):
            found |= {(tx, int(link.tx_beam[i])), (rx, int(link.rx_beam[i]))}
            found |= {(tx, int(beam)) for beam in link.top_tx_beam[i, :1]}
            found |= {(rx, int(beam)) for beam in link.top_rx_beam[i, :1]}
        return {(device, beam) for device, beam in found if beam >= 0}

    def _place(self, text: str) -> int:
        frames = self.frames
        place = whole(text)
        if place is None or not frames.first <= place < frames.end:
            raise NotThereError(f"there is no frame {text}; there are {frames.first} to {frames.end - 1}")
        return place

    def _frame(self, place: int) -> dict[str, Any]:
        entry = self.frames.entry(place)
        return {
            "n": place,
            "episode": entry.episode,
            "frame": entry.frame,
            "t_ns": entry.t_ns,
            "inputs": [
                {
                    "topic": item.topic,
                    "source": item.source,
                    "status": item.status.value,
                    "frame": item.frame,
                    "cause": item.cause,
                }
                for item in entry.inputs
            ],
            "decisions": {report.source: report.decisions for report in entry.reports if report.decisions},
        }

    def _product(self, place: int, topic: str, query: Mapping[str, str]) -> Answer:
        items = self._items(self.frames.entry(place), topic)
        source = query.get("source", "")
        if source:
            items = [item for item in items if item.source == source]
        if not items:
            raise NotThereError(f"frame {place} has no {topic}{f' of {source!r}' if source else ''}")
        if topic == "scene" and not source:
            payload: Payload = self._scene(place, items)
        else:
            payload = self._payload(place, items[0])
        kept: dict[str, tuple[int, int]] = {}
        thinned = _thinned(payload, query, kept)
        item = items[0]
        said = {"topic": topic, "source": item.source, "status": item.status.value, "frame": item.frame}
        header, body = encode_payload(thinned)
        return Answer(join_parts([msgspec.msgpack.encode(said | {"kept": kept}), header, body]), BINARY)

    def _items(self, entry: FrameEntry, topic: str) -> list[GrantInput]:
        return [item for item in entry.inputs if item.topic == topic and item.status in _SHOWN]

    def _payload(self, place: int, item: GrantInput) -> Payload:
        with self._lock:
            return self.frames.payload(place, item)

    def _scene(self, place: int, items: Sequence[GrantInput]) -> Scene:
        return merge_scenes({item.source: cast(Scene, self._payload(place, item)) for item in items})

    def _radio_map(self) -> dict[str, Any]:
        """Gain of the strongest transmitter in each cell, of a map beside the recording."""
        file = self.frames.radio_map
        if file is None:
            raise NotThereError(
                "there is no radio map beside the recording; make one with: caviar plot map RUN"
            )
        try:
            with file.open("rb") as opened, np.load(opened, allow_pickle=False) as found:
                x, y, z = (found[name].astype(float) for name in ("x", "y", "z"))
                gain = np.where(np.isnan(found["gain"]), -np.inf, found["gain"]).max(0).astype(float)
        except (OSError, EOFError, ValueError, KeyError, BadZipFile) as error:
            raise RecordingError(f"{file} is no radio map: {error}") from error
        step = math.ceil(math.sqrt(gain.size / CELLS)) or 1
        x, y, z, gain = x[::step], y[::step], z[::step, ::step], gain[::step, ::step]
        shown = np.isfinite(gain) & np.isfinite(z)
        cells = [
            [value if there else None for value, there in zip(*row, strict=True)]
            for row in zip(gain.tolist(), shown.tolist(), strict=True)
        ]
        heights = np.where(shown, z, 0.0).tolist()
        return {"x": x.tolist(), "y": y.tolist(), "z": heights, "gain_db": cells, "every": step}

    def _lobe(self, place: int, query: Mapping[str, str]) -> dict[str, Any]:
        name, beam = query.get("device", ""), whole(query.get("beam", ""))
        scene = self._scene(place, self._items(self.frames.entry(place), "scene"))
        device = next((d for d in scene.devices if d.name == name and isinstance(d, AntennaDevice)), None)
        if not isinstance(device, AntennaDevice):
            raise NotThereError(f"frame {place} has no antenna {name!r}")
        codebook = codebook_of(device.array)
        if beam is None or beam >= codebook.beams:
            wanted = query.get("beam", "")
            raise NotThereError(f"{name!r} has the beams 0 to {codebook.beams - 1}, and no {wanted!r}")
        # Around the longer side of the array, about which a line of elements looks the same from all sides;
        # finer than the narrowest beam: of N elements half a wavelength apart the first null is at 2/N rad.
        short, long = sorted((device.array.rows, device.array.columns))
        axis = "y" if device.array.columns > device.array.rows else "z"
        azimuth = np.radians(np.linspace(-180, 180, min(721, 8 * max(9, short) + 1)))
        elevation = np.radians(np.linspace(-90, 90, min(721, 8 * max(9, long) + 1)))
        grid = np.stack(np.meshgrid(np.pi / 2 - elevation, azimuth, indexing="ij"), -1)
        directions = unit_vectors(grid)
        gain = codebook.gain(beam, directions if axis == "z" else directions[..., [1, 2, 0]])
        return {
            "device": name,
            "beam": beam,
            "axis": axis,
            "azimuths": azimuth.round(6).tolist(),
            "elevations": elevation.round(6).tolist(),
            "gain": gain.round(4).tolist(),
        }

    def _curves(self, query: Mapping[str, str]) -> dict[str, Any]:
        most = _number(query, "points", CURVE_POINTS, 2)
        links = self._spread_links(most)
        users = _all_users(links)
        if not users:
            return {"user": None, "users": [], "n": [], "series": {}}
        number = _number(query, "user", 0, 0)
        if number >= len(users):
            raise NotThereError(f"there are {len(users)} users, and no user {number}")
        user = users[number]
        rows = {place: _row(link, user) for place, link in links.items()}
        series = {}
        for name, (unit, _) in SERIES.items():
            values = [None if row is None else row.get(name) for row in rows.values()]
            if any(value is not None for value in values):
                series[name] = {"unit": unit, "values": values}
        named = [dict(zip(("tx", "rx", "carrier"), each, strict=True)) for each in users]
        return {"user": named[number], "users": named, "n": list(links), "series": series}

    def _link(self, place: int) -> Link | None:
        if place in self._links:
            return self._links[place]
        items = self._items(self.frames.entry(place), "link")
        return cast(Link, self._payload(place, items[0])) if items else None

    def _clock(self, query: Mapping[str, str]) -> dict[str, Any]:
        first = _number(query, "first", self.frames.first, self.frames.first)
        count = _number(query, "count", 60, 1)
        every = _number(query, "every", 1, 1)
        places = range(first, min(first + min(count, 1000) * every, self.frames.end), every)
        services: Mapping[str, Any] = self.frames.scenario.get("services") or {}
        answered, events = self.frames.answers(), self.frames.events()
        # Events of the frames between those that are shown, too; without any, no record is looked at.
        span = range(first, min(first + len(places) * every, self.frames.end)) if events else ()
        shown = {(e.episode, e.frame): n for n in span for e in [self.frames.entry(n)]}
        return {
            "services": [_service(name, spec) for name, spec in services.items()],
            "frames": [_lanes(place, self.frames.entry(place), services, answered) for place in places],
            "events": [
                {"n": shown[event["episode"], event["frame"]], "text": event["text"]}
                for event in events
                if (event["episode"], event["frame"]) in shown
            ],
        }


def _all_users(links: Mapping[int, Link | None]) -> list[tuple[str, str, str]]:
    return list(dict.fromkeys(user for link in links.values() if link is not None for user in _users(link)))


def _service(name: str, spec: Any) -> dict[str, Any]:
    known = spec if isinstance(spec, dict) else {}
    return {"name": name, "role": known.get("role", ""), "budget_ms": known.get("budget_ms")}


def _lanes(
    place: int,
    entry: FrameEntry,
    services: Mapping[str, Any],
    answered: AnsweredGrants,
) -> dict[str, Any]:
    """Lanes of one frame: when each service was granted and answered, from the frame's first grant on."""
    key = (entry.episode, entry.frame)
    known = {name: table[key] for name, table in answered.items() if key in table}
    begin = min((at - took for at, _, took in known.values()), default=0)
    work = {report.source: report.measured.get("step") for report in entry.reports}
    lanes = []
    for name in services:
        states = {item.status for item in entry.inputs if item.source == name}
        at, missed, took = known.get(name, (None, 0, None))
        step = work.get(name)
        lanes.append(
            {
                "service": name,
                "start_ms": None if at is None or took is None else (at - took - begin) / 1e6,
                "end_ms": None if at is None else (at - begin) / 1e6,
                "work_ms": None if step is None else step / 1e6,
                "missed": bool(missed),
                "held": Status.HELD in states,
                "absent": Status.ABSENT in states,
            }
        )
    return {"n": place, "lanes": lanes}


def _thinned(payload: Payload, query: Mapping[str, str], kept: dict[str, tuple[int, int]]) -> Payload:
    """Leave out what a page does not draw; ``kept`` says how many of how many are left."""
    if isinstance(payload, Channel):
        return _strongest(payload, _number(query, "paths", PATHS, 0), kept)
    if isinstance(payload, Lidar):
        return _sparse(payload, _number(query, "points", POINTS, 1), kept)
    if isinstance(payload, Camera | Depth | Segmentation):
        images = [_small(image, _number(query, "pixels", PIXELS, 1), kept) for image in payload.images]
        return replace(payload, images=tuple(images))
    return payload


_BY_PATH = ("id", "tau", "aod", "aoa", "interactions", "points", "objects")


def _strongest(channel: Channel, most: int, kept: dict[str, tuple[int, int]]) -> Channel:
    """The strongest paths of each pair, in their order, without matrices."""
    power = (np.abs(channel.a) ** 2).max(0, initial=0.0)
    chosen, offsets = [], [0]
    for first, end in zip(channel.offsets[:-1].tolist(), channel.offsets[1:].tolist(), strict=True):
        strongest = np.argsort(-power[first:end], kind="stable")[:most]
        chosen.append(first + np.sort(strongest))
        offsets.append(offsets[-1] + len(strongest))
    paths = np.concatenate(chosen) if chosen else np.zeros(0, np.int64)
    kept["paths"] = len(paths), len(channel.tau)
    return replace(
        channel,
        offsets=np.array(offsets, np.int64),
        **{name: getattr(channel, name)[paths] for name in _BY_PATH},
        a=channel.a[:, paths],
        doppler=channel.doppler[:, paths],
        h=(), hf=(), taps=(),
    )  # fmt: skip


def _sparse(lidar: Lidar, most: int, kept: dict[str, tuple[int, int]]) -> Lidar:
    """Every k-th point of each scan, in the axes of the sensor alone."""
    total = sum(len(scan.ray) for scan in lidar.scans)
    step = math.ceil(total / most) or 1
    scans = tuple(
        replace(
            scan,
            ray=scan.ray[::step],
            points=np.ascontiguousarray(scan.points[::step]),
            range=scan.range[::step],
            object=scan.object[::step],
            points_world=None,
            grid=None,
        )
        for scan in lidar.scans
    )
    kept["points"] = sum(len(scan.ray) for scan in scans), total
    return replace(lidar, scans=scans)


def _small(image: Any, width: int, kept: dict[str, tuple[int, int]]) -> Any:
    """Every k-th pixel of a picture, and intrinsics to match."""
    arrays = [
        name
        for name in ("rgb", "depth", "normals", "object", "material")
        if getattr(image, name, None) is not None
    ]
    of = getattr(image, arrays[0]).shape[1]
    step = math.ceil(of / width)
    small = {name: np.ascontiguousarray(getattr(image, name)[::step, ::step]) for name in arrays}
    kept["pixels"] = small[arrays[0]].shape[1], of
    optics = image.intrinsics
    # Pixel i of the small picture is pixel k·i of the other: their centres, at +½, are at the same place.
    scaled = replace(
        optics,
        fx=optics.fx / step,
        fy=optics.fy / step,
        cx=(optics.cx - 0.5) / step + 0.5,
        cy=(optics.cy - 0.5) / step + 0.5,
    )
    return replace(image, intrinsics=scaled, **small)


def _users(link: Link) -> Iterator[tuple[str, str, str]]:
    return zip(link.tx, link.rx, link.carrier, strict=True)


def _row(link: Link | None, user: tuple[str, str, str]) -> dict[str, float | None] | None:
    """Values of one user in a frame; None where it is not there, and for what it has not."""
    places = [] if link is None else [i for i, each in enumerate(_users(link)) if each == user]
    if link is None or not places:
        return None
    found = {}
    for name, (_, values) in SERIES.items():
        column = values(link)
        value = math.nan if column is None else float(column[places[0]])
        found[name] = value if math.isfinite(value) else None
    return found


def _decibels(ratio: Any) -> Any:
    with np.errstate(divide="ignore"):
        return 10 * np.log10(ratio)


def _spread(first: int, end: int, most: int) -> list[int]:
    """At most so many places from the first to the last, evenly."""
    return sorted({round(place) for place in np.linspace(first, end - 1, min(most, end - first))})


def _number(query: Mapping[str, str], name: str, default: int, least: int) -> int:
    text = query.get(name, str(default))
    value = whole(text)
    if value is None or value < least:
        raise NotThereError(f"{name}={text!r:.40} is no whole number of {least} or more")
    return value


def _json(value: Any) -> Answer:
    return Answer(msgspec.json.encode(value), JSON)
