"""The picture of packets: what of a run goes into the curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recording_builders import frame, link, product, record, with_packets

from caviar_clients.plots.packets import POINTS, draw_traffic, packet_series
from caviar_protocol.recording import Recording
from caviar_protocol.topics import Link

pytestmark = pytest.mark.slow

pytest.importorskip("matplotlib")


def recorded(folder: Path, links: list[Link]) -> Recording:
    return Recording(
        record(folder, [frame(n, product("link", "link", made, n)) for n, made in enumerate(links)])
    )


def test_curves_are_sums_over_frames_and_receivers_may_come_and_go(tmp_path: Path) -> None:
    """250 frames of two and three users: bins of three frames, the last of one, which counts for three."""
    made = packet_series(recorded(tmp_path, [with_packets(link(n, 2 + n % 2)) for n in range(250)]))
    assert made is not None
    assert made.rx == ("car.0/rx", "car.1/rx", "car.2/rx")
    assert made.sent.sum(0).tolist() == [0, 250_000, 250_000]
    binned = made.binned()
    assert len(binned.time) == 84 <= POINTS
    assert binned.frame_s == pytest.approx(0.3)
    assert binned.sent[:, 1].tolist() == [3000] * 84
    assert binned.time[:2].tolist() == pytest.approx([0.1, 0.4])
    # What is drawn: 1 kbit in 0.1 s, after 2 ms.
    np.testing.assert_allclose(binned.sent[:, 1] / binned.frame_s, 1e4)
    np.testing.assert_allclose(binned.delay[:, 1] / binned.delivered[:, 1], 2e-3)


def test_a_link_without_packets_has_no_picture_of_them(tmp_path: Path) -> None:
    assert packet_series(recorded(tmp_path, [link(0), link(1)])) is None


def test_the_picture_has_a_curve_of_each_receiver_and_grey_ones_past_the_colours(tmp_path: Path) -> None:
    made = packet_series(recorded(tmp_path / "run", [with_packets(link(n, 12)) for n in range(5)]))
    assert made is not None
    draw_traffic(made, tmp_path / "traffic.png")
    assert (tmp_path / "traffic.png").read_bytes()[1:4] == b"PNG"
