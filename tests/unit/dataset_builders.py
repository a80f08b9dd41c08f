"""Small datasets for tests: two UAVs under a statistical channel, played in this process in a second."""

from __future__ import annotations

from pathlib import Path

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeTask, play_episode
from caviar_clients.datasets.plan import plan_dataset
from caviar_protocol.scenario import find_scenario, load_scenario

SCENES, TX, RX = 20, 16, 2


def written_scenario(folder: Path, agent: str = 'use = "los-beam"') -> Path:
    """Two UAVs under a statistical channel, both ends with several beams."""
    text = find_scenario("geometric").read_text()
    uav = text[text.index("[[services.world.settings.objects]]") : text.index("[services.channel]")]
    second = uav.replace('"uav"', '"uav2"', 1).replace("60.0, -25.0", "45.0, 30.0")
    for old, new in (
        (uav, uav + second),
        ("frames = 500", f"frames = {SCENES}"),
        ("columns = 64", f"columns = {TX}"),
        ('on = "uav"', f'on = "uav*"\ncount = 2\narray = {{ columns = {RX} }}'),
        ('use = "los-beam"', agent),
        ("sampling_period_ns = 100_000_000", "sampling_period_ns = 2_000_000_000"),
    ):
        assert old in text, old
        text = text.replace(old, new, 1)
    file = folder / "uavs.toml"
    file.write_text(text)
    return file


def generated(scenario: Path, out: Path, episodes: int) -> Path:
    plan = plan_dataset(load_scenario(scenario), episodes=episodes, scenes=SCENES)
    directory = DatasetDirectory(out)
    with writing_dataset(directory):
        catalogue = Catalogue(directory.catalogue, writable=True)
        catalogue.plan(plan.settings(), episodes)
        for number in range(episodes):
            result = play_episode(EpisodeTask(plan.scenario, number, str(out)))
            assert result.rows is not None, result.error
            catalogue.add(result.rows, result.measured)
        catalogue.close()
    return out
