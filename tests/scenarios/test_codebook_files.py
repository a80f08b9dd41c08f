"""Beams of a file reach every process of a run, its recording and its replay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scenarios_support import caviar, run, scenario_file

from caviar_clients.envs.base import BeamSelectionEnv
from caviar_clients.session.embedded import EmbeddedRun
from caviar_protocol.errors import ScenarioError
from caviar_protocol.recording import Recording
from caviar_protocol.scenario import load_scenario


def written(folder: Path, beams: int = 40, elements: int = 32) -> Path:
    """Random beams of norm 1, in single precision as PyTorch has them."""
    real, imaginary = np.random.default_rng(5).normal(size=(2, beams, elements))
    vectors = real + 1j * imaginary
    file = folder / "learned.npy"
    np.save(file, (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.complex64))
    return file


CHANGES = [
    ("frames = 100", "frames = 3"),
    ('"channel", ', '"channel", "channel.h", '),
    ("columns = 8 }", 'columns = 8, codebook = "file:learned.npy" }'),
]


def test_beams_of_a_file_reach_processes_recording_and_replay(tmp_path: Path) -> None:
    file = written(tmp_path)
    scenario = scenario_file(tmp_path, CHANGES)
    finished = run(scenario, tmp_path / "out")
    assert finished.status == 0, finished.output
    env = BeamSelectionEnv(scenario, users="car/*")
    assert env.action_space.n == 40 * 4  # type: ignore[attr-defined]
    env.close()
    beams = np.load(file)
    (tmp_path / "embedded").mkdir()
    embedded = EmbeddedRun(load_scenario(scenario), tmp_path / "embedded").run()
    file.unlink()  # the recording has a copy
    recording = Recording(finished.directory)
    assert embedded.digest
    assert f"digest {embedded.digest}" in finished.output
    channel, link = recording["channel"], recording["link"]
    dft = np.fft.fft(np.eye(4)) / 2  # of the receiver on the car: conj(c_r) is exp(−j2πrn/4)/2
    expected = np.abs(dft @ channel.h[:, 0] @ beams.conj().T).swapaxes(-1, -2)
    assert channel.beam_gains[:, 0] == pytest.approx(expected, abs=1e-12)
    assert link.top_abs_y[:, 0, 0] == pytest.approx(expected.max(axis=(1, 2)), rel=1e-6)
    again = caviar("replay", finished.directory, "--out", tmp_path / "again", "--replace", "link=beams")
    assert again.status == 0, again.output


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (lambda beams: beams[:, :31], r"shape \(40, 31\)"),
        (lambda beams: beams * np.where(np.arange(40) == 7, 1.5, 1.0)[:, None], "beam 7 of norm 1.5"),
        (lambda beams: np.where(np.arange(40)[:, None] == 9, np.nan, beams), "beam 9 of norm nan"),
        (lambda beams: (beams.real * 100).astype(int), "array of int"),
        (lambda beams: beams.astype(object), r"no \.npy"),
    ],
)
def test_a_file_that_holds_no_beams_is_refused_with_its_line(tmp_path: Path, make, problem: str) -> None:  # type: ignore[no-untyped-def]
    file = written(tmp_path)
    np.save(file, make(np.load(file)))
    with pytest.raises(ScenarioError, match=problem) as refused:
        load_scenario(scenario_file(tmp_path, CHANGES))
    assert str(file) in str(refused.value)
    assert refused.value.key == "devices[0].array.codebook"
    assert refused.value.line


def test_an_agent_that_needs_dft_beams_refuses_others_before_the_run(tmp_path: Path) -> None:
    changes = [
        ('use = "los-beam"', 'use = "hierarchical-sweep"'),
        ("columns = 8 }", 'columns = 8, codebook = "quantized:2" }'),
    ]
    finished = run(scenario_file(tmp_path, changes), tmp_path / "out")
    assert finished.status == 1
    assert "devices[0].array.codebook: is 'quantized:2', and 'hierarchical-sweep'" in finished.output
