"""Agents that know where to look: by the position of a user, or by a lower carrier."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from link_builders import antenna, channel_of, frame_of, given, random_h, scene_of

from caviar_clients.session.embedded import EmbeddedRun
from caviar_clients.session.prepared import prepare
from caviar_protocol.arrays import Complex128Array
from caviar_protocol.errors import CaviarError, ScenarioError
from caviar_protocol.recording import Recording
from caviar_protocol.scenario import DeviceSpec, load_scenario, parse_scenario
from caviar_protocol.space.antenna_arrays import dft_codebook
from caviar_protocol.topics import Action, AntennaArray, BeamChoice, Carrier, Scene
from caviar_services.agent.fingerprint import (
    UNKNOWN,
    Codebooks,
    FingerprintAgent,
    Fingerprints,
    FingerprintSettings,
)
from caviar_services.agent.pilots import PILOTS
from caviar_services.agent.sweeps import OutOfBandAgent, OutOfBandSettings
from caviar_services.link.beams import BeamLink, BeamLinkSettings
from caviar_services.service import Preparation, RunInfo, StepResult

pytestmark = pytest.mark.slow

SCENARIOS = Path(__file__).parents[2] / "deploy" / "caviar_scenarios"
LOW = Carrier(name="sub6", frequency_hz=3.5e9)
HIGH = Carrier(name="mmwave", frequency_hz=28e9)
RUN = RunInfo(name="agent", carriers=(HIGH, LOW))
SCENE = scene_of(antenna("bs", "tx", (1, 16)), antenna("rx", "rx", (1, 4), (9.0, 0.0, 0.0)))


def beams(made: StepResult) -> dict[tuple[str, str], tuple[int, int]]:
    action = made.products["action"]
    assert isinstance(action, Action)
    chosen = [command for command in action.commands if isinstance(command, BeamChoice)]
    return {(c.carrier, c.rx): (c.tx_beam, c.rx_beam) for c in chosen}


# --- out of band -----------------------------------------------------------------------------------


def path(tx_beam: int, rx_beam: int, gain: float = 1e-5) -> Complex128Array:
    """H of one path along a beam of each end."""
    h: Complex128Array = gain * np.outer(
        dft_codebook(AntennaArray(columns=4))[rx_beam], dft_codebook(AntennaArray(columns=16))[tx_beam]
    )
    return h


def aided(settings: OutOfBandSettings, low: Complex128Array, high: Complex128Array) -> StepResult:
    agent = OutOfBandAgent(settings, RUN)
    agent.prepare(Preparation(demand={}))
    h = {("mmwave", "bs", "rx"): high, ("sub6", "bs", "rx"): low}
    channel = channel_of(("bs",), ("rx",), h, (HIGH, LOW))
    return agent.step(frame_of(given("scene", SCENE), given("channel", channel), service="agent"))


def test_the_strongest_pair_of_the_lower_carrier_is_taken() -> None:
    made = aided(OutOfBandSettings(candidates=1), path(11, 2), path(3, 1))
    assert beams(made) == {("mmwave", "rx"): (11, 2), ("sub6", "rx"): (11, 2)}
    assert made.counts[PILOTS] == 0


def test_few_pairs_are_tried_on_the_higher_carrier() -> None:
    """The lower carrier hears two paths, of which the weaker one is the stronger on the higher carrier."""
    low, high = path(11, 2) + path(4, 1, 0.8e-5), path(11, 2) + path(4, 1, 3e-5) + path(8, 0, 9e-5)
    made = aided(OutOfBandSettings(candidates=2), low, high)
    assert beams(made)["mmwave", "rx"] == (4, 1), "the third path is not among the candidates"
    assert made.counts[PILOTS] == 2


def test_fewer_elements_blur_the_spectrum() -> None:
    """With 4 of 16 elements two paths next to each other are one; candidates around them find the better."""
    low, high = path(8, 1) + path(10, 1), path(9, 1) + path(10, 1, 2e-5)
    coarse = OutOfBandSettings(candidates=4, tx_elements=(1, 4))
    made = aided(coarse, low, high)
    assert beams(made)["mmwave", "rx"] == (10, 1)
    sharp = aided(OutOfBandSettings(candidates=1, tx_elements=(1, 4)), low, high)
    assert beams(sharp)["mmwave", "rx"] == (9, 1), "the middle of both"


def test_where_the_lower_carrier_is_dark_there_is_no_choice() -> None:
    agent = OutOfBandAgent(OutOfBandSettings(), RUN)
    agent.prepare(Preparation(demand={}))
    channel = channel_of(("bs",), ("rx",), {("mmwave", "bs", "rx"): path(3, 1)}, (HIGH, LOW))
    made = agent.step(frame_of(given("scene", SCENE), given("channel", channel), service="agent"))
    assert beams(made) == {}


@pytest.mark.parametrize(
    ("carriers", "aid", "words"),
    [((HIGH,), "", "has mmwave alone; add another"), ((HIGH, LOW), "sub7", "did you mean 'sub6'")],
)
def test_a_scenario_without_such_a_carrier_is_refused(
    carriers: tuple[Carrier, ...], aid: str, words: str
) -> None:
    agent = OutOfBandAgent(OutOfBandSettings(aid=aid), RunInfo(name="agent", carriers=carriers))
    with pytest.raises(ScenarioError, match=words):
        agent.prepare(Preparation(demand={}))


def test_it_serves_a_whole_run_of_two_carriers(tmp_path: Path) -> None:
    text = (SCENARIOS / "smoke.toml").read_text().replace('use = "los-beam"', 'use = "out-of-band"', 1)
    second = '\n[[carriers]]\nname = "sub6"\nfrequency_hz = 3.5e9\nbandwidth_hz = 20e6\n\n# --- services'
    scenario = parse_scenario(
        text.replace("\n# --- services", second, 1).replace("frames = 100", "frames = 20")
    )
    outcome = EmbeddedRun(scenario, tmp_path).run()
    assert not outcome.error, outcome.error
    link = Recording(tmp_path)["link"]
    # In free space the spectrum of the one is that of the other.
    np.testing.assert_allclose(link.abs_y, link.top_abs_y[..., 0], rtol=1e-6)


# --- fingerprints ----------------------------------------------------------------------------------


def at(x: float, y: float = 0.0) -> Scene:
    return scene_of(antenna("bs", "tx", (1, 16)), antenna("rx", "rx", (1, 4), (x, y, 1.0)))


def learn(table: Fingerprints, scene: Scene, h: Complex128Array) -> None:
    link = BeamLink(BeamLinkSettings(top_k=4), RunInfo(name="link"))
    channel = channel_of(("bs",), ("rx",), {("mmwave", "bs", "rx"): h}, (HIGH,))
    made = link.step(frame_of(given("scene", scene), given("channel", channel))).products["link"]
    table.learn(scene, made)  # type: ignore[arg-type]  # a link


KEY = Codebooks("bs", "mmwave", 16, 4)


def test_pairs_come_in_the_order_of_how_often_they_were_best() -> None:
    table = Fingerprints(5.0)
    for h in (path(3, 1), path(7, 2), path(7, 2)):
        learn(table, at(12.0), h)
    assert table.pairs(KEY, (14.9, 4.9, 4.9))[:2] == ((7, 2), (3, 1))
    learn(table, at(12.0), path(3, 1, 2e-5))
    assert table.pairs(KEY, (12.0, 0.0, 1.0))[:2] == ((3, 1), (7, 2)), "of equal ones the stronger"


def test_the_nearest_cell_stands_in_for_one_without_a_fingerprint() -> None:
    table = Fingerprints(5.0)
    learn(table, at(12.0), path(3, 1))
    learn(table, at(52.0), path(7, 2))
    assert table.pairs(KEY, (40.0, 0.0, 1.0))[0] == (7, 2)
    assert table.pairs(KEY, (-40.0, 0.0, 1.0))[0] == (3, 1)
    assert table.pairs(KEY._replace(rx_beams=2), (12.0, 0.0, 1.0)) == ()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in which the link lists the best pairs."""
    folder = tmp_path_factory.mktemp("recorded")
    assert not EmbeddedRun(load_scenario("smoke"), folder).run().error
    return folder


def served(folder: Path, recorded: Path, settings: str = "", base: str = "smoke") -> Recording:
    text = (SCENARIOS / f"{base}.toml").read_text()
    use = f'use = "fingerprint"\nsettings = {{ file = "file:{recorded}"{settings} }}'
    scenario = parse_scenario(text.replace('use = "los-beam"', use, 1))
    outcome = EmbeddedRun(scenario, folder).run()
    if outcome.error:
        raise CaviarError(outcome.error)
    return Recording(folder)


def test_a_run_is_served_by_the_fingerprints_of_another(tmp_path: Path, recorded: Path) -> None:
    recording = served(tmp_path, recorded, ", candidates = 4")
    link = recording["link"]
    assert (link.abs_y / link.top_abs_y[..., 0]).mean() > 0.9
    reports = [r for frame in recording.frames() for r in frame.reports if r.source == "agent"]
    assert {report.counts[PILOTS] for report in reports} == {8}
    assert not any(UNKNOWN in report.counts for report in reports)


def test_without_pilots_the_first_pair_of_the_cell_is_taken(tmp_path: Path, recorded: Path) -> None:
    link = served(tmp_path, recorded, ", candidates = 1")["link"]
    assert 0.6 < (link.abs_y / link.top_abs_y[..., 0]).mean() < 0.99


def test_a_recording_of_something_else_is_refused(tmp_path: Path, recorded: Path) -> None:
    (tmp_path / "run").mkdir()
    with pytest.raises(CaviarError, match="'bs' with 32 beams on mmwave"):
        served(tmp_path / "run", recorded, base="geometric")
    (tmp_path / "none").mkdir()
    file, use = tmp_path / "s.toml", 'use = "fingerprint"\nsettings.file = "/nowhere/run"'
    file.write_text((SCENARIOS / "smoke.toml").read_text().replace('use = "los-beam"', use, 1))
    with pytest.raises(CaviarError, match=r"settings\.file: there is no"):
        prepare(file)
    with pytest.raises(CaviarError, match=r"settings\.file: .*none"):
        served(tmp_path / "run", tmp_path / "none")


def test_a_user_of_another_array_is_served_along_the_straight_line() -> None:
    scene = scene_of(antenna("bs", "tx", (1, 16)), antenna("rx", "rx", (1, 2), (9.0, 0.0, 0.0)))
    table = Fingerprints(5.0)
    learn(table, at(12.0), path(3, 1))
    devices = (DeviceSpec(name="bs", kind="antenna", role="tx"),)
    agent = FingerprintAgent(
        FingerprintSettings(file="none"), RunInfo(name="agent", carriers=(HIGH,), devices=devices)
    )
    agent.table = table
    channel = channel_of(("bs",), ("rx",), {("mmwave", "bs", "rx"): random_h(1, 2, 16)}, (HIGH,))
    made = agent.step(frame_of(given("scene", scene), given("channel", channel), service="agent"))
    assert beams(made) == {("mmwave", "rx"): (0, 0)}
    assert made.counts[UNKNOWN] == 1
