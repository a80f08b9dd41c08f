"""Equal seeds give equal digests, and a digest stands for every byte of every payload."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scenarios_support import SCENARIOS, Finished, caviar, run, scenario_file

from caviar_protocol.recording import Recording
from caviar_protocol.topics import Scene


def digest_of(finished: Finished) -> str:
    """Digest that the run's broker chained."""
    assert finished.status == 0, finished.output
    summary: dict[str, str] = json.loads((finished.directory / "summary.json").read_text())
    return summary["digest"]


def recomputed(directory: Path) -> tuple[int, str]:
    """Exit status and last word of ``caviar inspect --digest``."""
    done = caviar("inspect", "--digest", directory)
    found = [
        line for line in done.output.splitlines() if len(line) == 64 and set(line) <= set("0123456789abcdef")
    ]
    return done.status, found[0] if found else ""


RANDOM = ('use = "los-beam"', 'use = "random"')
"""The random agent is the one whose choices would differ first."""


@pytest.fixture(scope="module")
def random_run(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """The smoke scenario with the random agent and its own seed."""
    folder = tmp_path_factory.mktemp("random")
    return run(scenario_file(folder, [RANDOM]), folder / "out")


@pytest.fixture(scope="module")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """The smoke scenario as it is shipped."""
    folder = tmp_path_factory.mktemp("smoke")
    return run(scenario_file(folder), folder / "out")


def test_two_runs_with_one_seed_have_equal_digests_recomputed_from_the_recordings(
    random_run: Finished, tmp_path: Path
) -> None:
    runs = [random_run, run(scenario_file(tmp_path, [RANDOM]), tmp_path / "again")]
    digests = {digest_of(finished) for finished in runs}
    assert len(digests) == 1
    assert [recomputed(finished.directory) for finished in runs] == [(0, *digests)] * 2


def test_another_seed_gives_another_digest(random_run: Finished, tmp_path: Path) -> None:
    second = run(scenario_file(tmp_path, [RANDOM]), tmp_path / "b", "--seed", "2")
    assert digest_of(random_run) != digest_of(second)


def test_overlapping_frames_do_not_change_the_digest(smoke: Finished, tmp_path: Path) -> None:
    one_by_one = scenario_file(tmp_path, [("frames = 100\n", "frames = 100\nframes_in_flight = 1\n")])
    assert digest_of(smoke) == digest_of(run(one_by_one, tmp_path / "b"))


def test_one_changed_payload_byte_gives_another_digest(smoke: Finished, tmp_path: Path) -> None:
    """The byte is in the middle of the recorded link product of a frame in the middle of the run."""
    product = next(iter(p for f, p in Recording(smoke.directory).products("link") if f.number == 50))
    needle = bytes(product.header) + bytes(product.body)
    damaged = tmp_path / "damaged"
    shutil.copytree(smoke.directory, damaged)
    (segment,) = damaged.glob("*.mcap")
    data = bytearray(segment.read_bytes())
    at = data.index(needle) + len(needle) // 2
    data[at] ^= 0x01
    segment.write_bytes(data)
    status, digest = recomputed(damaged)
    assert digest != digest_of(smoke)
    assert digest
    assert status != 0


@pytest.mark.sumo
@pytest.mark.exhaustive
def test_seeds_lead_to_other_traffic(tmp_path: Path) -> None:
    """Street canyon with its real traffic; the ray tracer has no part in it, free space stands in."""
    pytest.importorskip("libsumo", reason="needs the world extra")
    text = (SCENARIOS / "street-canyon.toml").read_text()
    head, _, rest = text.partition("[services.channel]")
    _, _, tail = rest.partition("[services.link]")
    channel = '[services.channel]\nrole = "channel"\nuse = "free-space"\nbudget_ms = 100\n\n'
    text = (head + channel + "[services.link]" + tail).replace('"lidar", ', "")
    text = text.replace("file:street-canyon", f"file:{SCENARIOS}/street-canyon")
    text = text.replace('pattern = "tr38901"', 'pattern = "iso"')
    scenario = tmp_path / "scenario.toml"
    scenario.write_text(text)
    positions = []
    for folder, seed in (("a", "1"), ("b", "2")):
        finished = run(scenario, tmp_path / folder, "--frames", "52", "--seed", seed)
        assert finished.status == 0, finished.output
        scene = Recording(finished.directory).product(0, 50, "scene", "traffic")
        assert isinstance(scene, Scene)
        assert len(scene.names) > 5
        positions.append(dict(zip(scene.names, scene.position.tolist(), strict=True)))
    common = positions[0].keys() & positions[1].keys()
    differences = [np.linalg.norm(np.subtract(positions[0][n], positions[1][n])) for n in common]
    assert max(differences, default=100.0) > 1.0
