"""Pictures of a user's dispersion: which paths they show, over which time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from recording_builders import channel, frame_of, record

from caviar_clients.plots.user_curves import (
    _gains_db,
    _scale,
    _why_empty,
    draw_dispersion,
    draw_frequency_response,
    user_paths,
)
from caviar_protocol.recording import Recording

pytest.importorskip("matplotlib")


def recorded(folder: Path) -> Recording:
    """Two episodes of three frames with two users, of which the second has no path."""
    frames = [frame_of(k, channel=channel(k, 2), episode=episode) for episode in range(2) for k in range(3)]
    return Recording(record(folder, frames))


def test_a_user_s_paths_go_on_over_episodes(tmp_path: Path) -> None:
    recording = recorded(tmp_path)
    data = user_paths(recording, None)
    assert data is not None
    assert (data.tx, data.rx) == ("bs", "car.0/rx")
    assert data.time.tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert data.frames == [(e, n) for e in range(2) for n in range(3)]
    np.testing.assert_array_equal(data.tau[4, :2], channel(1, 2).tau[:2])
    assert user_paths(recording, ("bs", "bike/rx", data.carrier.name)) is None


def test_gains_over_frequency_are_those_of_the_paths(tmp_path: Path) -> None:
    data = user_paths(recorded(tmp_path), None)
    assert data is not None
    carrier = msgspec.structs.replace(data.carrier, subcarriers=5, subcarrier_spacing_hz=7e6)
    of_frame = channel(1, 2)
    phases = np.exp(-2j * np.pi * 7e6 * np.arange(-2, 3)[:, None] * of_frame.tau[:2])
    expected = 20 * np.log10(np.abs(phases @ of_frame.a[0, :2]))
    np.testing.assert_allclose(_gains_db(data, carrier)[1], expected, atol=1e-6)


def test_a_user_without_a_path_can_be_drawn(tmp_path: Path) -> None:
    recording = recorded(tmp_path)
    first = user_paths(recording, None)
    assert first is not None
    data = user_paths(recording, ("bs", "car.1/rx", first.carrier.name))
    assert data is not None
    draw_dispersion(data, tmp_path / "dispersion.png")
    draw_frequency_response(data, (1, 1), "frame 1", tmp_path / "response.png")
    assert (tmp_path / "dispersion.png").stat().st_size > 10_000
    assert (tmp_path / "response.png").stat().st_size > 10_000


def drawn(values: list[float]) -> Any:
    """The axes of a coherence that has these values."""
    from matplotlib.figure import Figure

    axes = Figure(figsize=(9.0, 2.0)).subplots()
    axes.plot(values)
    _scale(axes, np.array(values))
    axes.figure.canvas.draw()
    return axes


@pytest.mark.parametrize("values", [[23.0, 48.0], [23.0, 480.0], [0.9, 7.0, 4000.0]])
def test_the_axis_of_a_coherence_has_numbers(values: list[float]) -> None:
    """Within a decade a logarithmic axis has one of them at most."""
    axes = drawn(values)
    low, high = axes.get_ylim()
    shown = [t for t in axes.get_yticklabels() if t.get_text() and low <= t.get_position()[1] <= high]
    assert len(shown) >= 2


def test_a_panel_without_a_value_says_why() -> None:
    assert _why_empty(np.array([np.nan, np.inf])) == "infinite, with one path in each frame"
    assert _why_empty(np.array([np.nan, -np.inf])) == "no direct path"
    assert _why_empty(np.array([np.nan])) == "no path"
