"""Traffic models: how many packets arrive when, and traces that are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from caviar_protocol.cell.traffic import Offered, Traffic, arrivals, check_traffic, read_trace
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario.conversion import Place

PLACE = Place("services.link.settings.traffic[1]")


def test_constant_traffic_sends_each_packet_as_soon_as_it_is_whole() -> None:
    """0.3 packets a slot, of a size at which sums of floats miss whole numbers."""
    offered = Offered.for_traffic(Traffic(model="constant", rate_bit_s=3e6, packet_bits=10_000))
    found = arrivals(offered, 0, 100_000, 1e-3, None)
    whole = (3 * np.arange(1, 100_001)) // 10
    assert (np.cumsum(found) == whole).all()
    assert (arrivals(offered, 500, 100, 1e-3, None) == found[500:600]).all()


def test_poisson_traffic_has_its_mean_and_variance() -> None:
    offered = Offered.for_traffic(Traffic(model="poisson", rate_bit_s=24e6, packet_bits=12_000))
    found = arrivals(offered, 0, 200_000, 1e-3, np.random.default_rng(1))
    assert found.mean() == pytest.approx(2.0, rel=0.01)
    assert found.var() == pytest.approx(2.0, rel=0.02)


def test_alternating_traffic_begins_dense_and_changes_every_period() -> None:
    traffic = Traffic(
        model="alternating", rate_bit_s=9e6, light_rate_bit_s=1e6, period_s=0.5, packet_bits=1000
    )
    offered = Offered.for_traffic(traffic)
    instants = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 100.0, 100.25])
    expected = [0.0, 2250.0, 4500.0, 4750.0, 5000.0, 9500.0, 500_000.0, 502_250.0]
    np.testing.assert_allclose(offered.packets(instants), expected, rtol=1e-12)
    found = arrivals(offered, 0, 2000, 1e-3, np.random.default_rng(2)).reshape(4, 500).sum(1)
    np.testing.assert_allclose(found, [4500, 500, 4500, 500], rtol=0.15)


def written(folder: Path, text: str) -> str:
    (folder / "video.csv").write_text(text, "utf-8")
    return f"file:{folder / 'video.csv'}"


def test_a_trace_holds_each_rate_until_the_next(tmp_path: Path) -> None:
    file = written(tmp_path, "# of a camera\nt_s,rate_bit_s\n1, 2e3\n\n2.5,0\n4,1000\n")
    offered = Offered.for_traffic(Traffic(model="trace", file=file, packet_bits=1000))
    expected = [0.0, 0.0, 1.0, 3.0, 3.0, 3.0, 9.0]
    assert offered.packets(np.array([0.0, 1.0, 1.5, 2.5, 3.0, 4.0, 10.0])).tolist() == expected
    assert arrivals(offered, 0, 5, 1.0, None).tolist() == [0, 2, 1, 0, 1]


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("t_s,rate_bit_s\n0,1e6\n1,-5\n", 3, r"rate_bit_s = -5; write a rate from 0"),
        ("# x\nt_s,rate_bit_s\n0,1e6\n\none,5\n", 5, r"'one,5' is no pair of numbers"),
        ("t_s,rate_bit_s\n0,1e6,7\n", 2, r"'0,1e6,7' is no pair of numbers"),
        ("t_s,rate_bit_s\n0,nan\n", 2, r"rate_bit_s = nan"),
        ("t_s,rate_bit_s\n-1,5\n", 2, r"t_s = -1; write seconds from 0"),
        ("t_s,rate_bit_s\n2,5\n2,6\n", 3, r"t_s = 2 does not come after 2; order the rows by time"),
        ("time,rate\n0,5\n", 1, r"the first line is 'time,rate'; write t_s,rate_bit_s"),
        ("t_s,rate_bit_s\n", None, r"holds no rate; write t_s,rate_bit_s, then one a line"),
    ],
)
def test_a_trace_that_is_wrong_is_refused_with_file_and_line(
    text: str, line: int | None, message: str, tmp_path: Path
) -> None:
    file = written(tmp_path, text)
    where = f"video.csv:{line}: " if line else "video.csv: "
    with pytest.raises(ScenarioError, match=message) as refused:
        check_traffic(Traffic(model="trace", file=file), PLACE)
    assert where in str(refused.value)


def test_a_trace_of_a_spreadsheet_begins_with_a_mark(tmp_path: Path) -> None:
    (tmp_path / "video.csv").write_bytes(b"\xef\xbb\xbft_s,rate_bit_s\r\n0,2e6\r\n")
    assert read_trace(f"file:{tmp_path / 'video.csv'}", PLACE)[1].tolist() == [2e6]


def test_a_row_that_is_no_csv_is_refused_with_file_and_line(tmp_path: Path) -> None:
    (tmp_path / "video.csv").write_text("t_s,rate_bit_s\n0," + "1" * 200_000)
    with pytest.raises(ScenarioError, match=r"video\.csv:2: is no CSV: field larger"):
        read_trace(f"file:{tmp_path / 'video.csv'}", PLACE)


def test_a_trace_that_cannot_be_read_is_refused_with_its_key(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"traffic\[1\]\.file: .*none\.csv"):
        check_traffic(Traffic(model="trace", file=f"file:{tmp_path / 'none.csv'}"), PLACE)
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe")
    with pytest.raises(ScenarioError, match="cannot be read: not UTF-8 text"):
        read_trace(f"file:{tmp_path / 'bytes.csv'}", PLACE)
    with pytest.raises(ScenarioError, match=r'"file:video\.csv"'):
        read_trace("video.csv", PLACE)


@pytest.mark.parametrize(
    ("traffic", "message"),
    [
        (Traffic(model="poisson"), r"traffic\[1\]\.rate_bit_s: is missing; 'poisson' needs rate_bit_s"),
        (Traffic(model="alternating", rate_bit_s=1.0, period_s=1.0), r"\.light_rate_bit_s: is missing"),
        (Traffic(model="trace"), r"\.file: is missing; 'trace' needs file"),
        (
            Traffic(model="poisson", rate_bit_s=1.0, period_s=2.0),
            r"\.period_s: has no effect with model 'poisson'; leave it out, or choose 'alternating'",
        ),
        (Traffic(rate_bit_s=1.0), r"\.rate_bit_s: has no effect with model 'full'"),
        (
            Traffic(max_age_s=1.0),
            r"\.max_age_s: has no effect with model 'full', of which nothing is dropped",
        ),
    ],
)
def test_keys_that_are_missing_or_without_effect_are_refused(traffic: Traffic, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        check_traffic(traffic, PLACE)
