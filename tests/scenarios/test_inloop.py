"""What an agent does changes the world that the channel is computed in."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
from scenarios_support import SCENARIOS, Finished, run, scenario_file

from caviar_protocol.codec import decode_payload
from caviar_protocol.recording import Recording
from caviar_protocol.topics import Channel, Link, Scene

pytestmark = [
    pytest.mark.channel,
    pytest.mark.skipif(importlib.util.find_spec("sionna") is None, reason="needs sionna-rt"),
]

TOPICS = {"scene": Scene, "channel": Channel, "link": Link}

IN_SIGHT = "waypoints_m = [[-10.0, 125.0, 22.0]]\n"
OUT_OF_SIGHT = "waypoints_m = [[9.0, 178.0, 15.0], [23.0, 195.0, 14.0]]\n"


def recorded(finished: Finished, topic: str) -> list[Scene | Channel | Link]:
    """Payloads of a topic, one per frame."""
    assert finished.status == 0, finished.output
    products = [product for _, product in Recording(finished.directory).products(topic)]
    payloads = [decode_payload(topic, product.header, product.body) for product in products]
    return [payload for payload in payloads if isinstance(payload, Scene | Channel | Link)]


def flight(folder: Path, waypoints: str, *arguments: str) -> Finished:
    """The shipped scenario with other waypoints."""
    folder.mkdir()
    text = (SCENARIOS / "uav-path.toml").read_text()
    start = text.index("waypoints_m = [")
    end = text.index("\n]\n", start) + 3
    scenario = scenario_file(folder, [(text[start:end], waypoints)], base="uav-path")
    return run(scenario, folder / "out", "--embedded", *arguments, timeout=120)


def in_sight(finished: Finished) -> list[bool]:
    """Whether there is a line of sight, by the channel and by the link, which agree."""
    by_channel = [bool(c.los.all()) for c in recorded(finished, "channel") if isinstance(c, Channel)]
    by_link = [bool(link.los.all()) for link in recorded(finished, "link") if isinstance(link, Link)]
    assert by_channel == by_link
    return by_channel


def positions(finished: Finished) -> np.ndarray:
    return np.array([s.position[0] for s in recorded(finished, "scene") if isinstance(s, Scene)])


@pytest.mark.exhaustive
def test_where_the_agent_flies_decides_about_the_line_of_sight(tmp_path: Path) -> None:
    """Equal at frame 0, before any command acts; then each goes where its agent sends it."""
    near = flight(tmp_path / "near", IN_SIGHT, "--frames", "24")
    far = flight(tmp_path / "far", OUT_OF_SIGHT, "--frames", "24")
    here, there = positions(near), positions(far)
    np.testing.assert_array_equal(here[0], there[0])
    assert (np.linalg.norm(here[1:] - there[1:], axis=1) > 0.3).all()
    np.testing.assert_allclose(here[-1], (-10.0, 125.0, 22.0), atol=0.1)
    assert in_sight(near) == [True] * 24
    seen = in_sight(far)
    assert seen[0]
    assert not seen[-1]
    assert seen == sorted(seen, reverse=True)  # lost once


@pytest.mark.exhaustive
def test_it_is_lost_and_found_again_on_the_shipped_flight(tmp_path: Path) -> None:
    finished = run(SCENARIOS / "uav-path.toml", tmp_path, "--embedded", timeout=120)
    seen = np.array(in_sight(finished))
    assert seen[0]
    assert len(np.flatnonzero(np.diff(seen.astype(int)))) == 2
    assert seen[-1]
    link = [x for x in recorded(finished, "link") if isinstance(x, Link)]
    assert all(x.abs_y[0] > 0 for x, los in zip(link, seen, strict=True) if los)


@pytest.mark.exhaustive
def test_in_one_process_or_many_it_is_the_same_flight(tmp_path: Path) -> None:
    scenario = SCENARIOS / "uav-path.toml"
    runs = [
        run(scenario, tmp_path / name, "--frames", "5", *extra, timeout=120)
        for name, extra in (("many", ()), ("one", ("--embedded",)))
    ]
    digests = []
    for finished in runs:
        assert finished.status == 0, finished.output
        digests.append(json.loads((finished.directory / "summary.json").read_text())["digest"])
    assert digests[0] == digests[1]
    assert positions(runs[0])[-1][1] > 141.0  # it flew
