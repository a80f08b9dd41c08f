"""Element patterns from files: what tables and cuts mean, and what is wrong with bad ones."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest

from caviar_protocol.errors import AssetError
from caviar_services.channel.propagation.patterns import Patterns
from caviar_services.pattern_files import PatternTable, read_pattern

CUTS = ["GAIN 5 dBi", "HORIZONTAL 4", "0 0", "90 10", "180 25", "270 10"]
CUTS += ["VERTICAL 4", "0 0", "90 20", "180 25", "270 20"]


def written(folder: Path, name: str, *lines: str) -> PatternTable:
    (folder / name).write_text("\n".join(lines))
    return read_pattern(folder / name)


def test_a_table_is_bilinear_and_goes_once_around(tmp_path: Path) -> None:
    """Lines in any order, azimuths from −180° on; between 90° and −180° = 180° too."""
    gains = {(0, p): 0.0 for p in (-180, -90, 0, 90)} | {(180, p): -20.0 for p in (-180, -90, 0, 90)}
    gains |= {(90, -180): 8.0, (90, -90): 2.0, (90, 0): 4.0, (90, 90): 6.0}
    lines = [f"{theta}, {phi}, {gain}" for (theta, phi), gain in reversed(gains.items())]
    table = written(tmp_path, "a.csv", "# measured", "theta_deg,phi_deg,gain_dbi", "", *lines)
    theta, phi = np.radians([90, 90, 90, 45, 135]), np.radians([90, 135, -135, 0, 45])
    np.testing.assert_allclose(table.at(theta, phi), [6.0, 7.0, 5.0, 2.0, -7.5], atol=1e-12)


def test_a_table_of_fields_keeps_their_phases(tmp_path: Path) -> None:
    head = "theta_deg,phi_deg,e_theta_re,e_theta_im,e_phi_re,e_phi_im"
    table = written(
        tmp_path, "a.csv", head, "0,0,1,0,0,2", "180,0,3,0,0,-2", "0,120,1,0,0,2", "180,120,3,0,0,-2"
    )
    assert table.is_field
    np.testing.assert_allclose(table.at(np.radians([0, 45]), np.radians([60, 0])), [[1, 2j], [1.5, 1j]])


@pytest.mark.parametrize(("unit", "gain"), [("15.0 dBi", 15.0), ("12.85 dBd", 15.0), ("12.85", 15.0)])
def test_cuts_add_up_and_turn_clockwise_and_downwards(tmp_path: Path, unit: str, gain: float) -> None:
    """The horizontal cut has a loss of 10 dB at 90°, to the right; the vertical one of 4 dB at 30°, below."""
    horizontal = ["0 0", "90 10", "180 20", "270 12"]
    vertical = ["0 0", "30 4", "90 40", "180 25", "270 30", "330 6"]
    head = ["NAME x", f"GAIN {unit}", "TILT ELECTRICAL", "COMMENT é"]
    table = written(tmp_path, "a.MSI", *head, "HORIZONTAL 4", *horizontal, "VERTICAL 6", *vertical)
    losses = {(90, 0): 0.0, (90, -90): 10.0, (90, 90): 12.0, (120, 0): 4.0, (60, 0): 6.0}
    losses |= {(120, -90): 14.0, (90, 180): 20.0, (105, -45): 7.0, (180, 0): 40.0}
    theta, phi = np.radians(list(losses)).T
    np.testing.assert_allclose(table.at(theta, phi), gain - np.array(list(losses.values())), atol=1e-9)


@pytest.mark.parametrize(
    ("name", "lines", "message"),
    [
        ("a.txt", ["x"], r"no pattern has the ending '.txt'; known: .csv, .msi, .pln"),
        ("a.csv", ["theta,phi,gain"], r"a.csv:1: is 'theta,phi,gain'; write theta_deg,phi_deg,gain_dbi or"),
        ("a.csv", ["theta_deg,phi_deg,gain_dbi", "0,0,x"], r"a.csv:2: is '0,0,x'; write 3 finite numbers"),
        ("a.csv", ["theta_deg,phi_deg,gain_dbi", "0,0,nan"], r"a.csv:2: .*write 3 finite numbers"),
        ("a.csv", ["theta_deg,phi_deg,gain_dbi"], "holds no direction"),
        ("a.csv", ["theta_deg,phi_deg,gain_dbi", "0,0,1", "90,0,1"], "go from 0° to 90°; write 0° to 180°"),
        (
            "a.csv",
            ["theta_deg,phi_deg,gain_dbi", "0,0,1", "180,0,1", "0,90,1"],
            r"no line for theta_deg = 180, phi_deg = 90",
        ),
        (
            "a.csv",
            ["theta_deg,phi_deg,gain_dbi", "0,0,1", "180,0,1", "0,360,2"],
            "a direction has two different values",
        ),
        ("a.pln", ["NAME x", "HORIZONTAL 1", "0 0"], "has no GAIN"),
        ("a.pln", ["GAIN 10 dB"], r"a.pln:1: is '10 dB'; write GAIN, a number, and dBi or dBd"),
        ("a.pln", ["GAIN 10", "HORIZONTAL 2", "0 0", "180 9"], "has no vertical cut; add VERTICAL 360"),
        ("a.pln", ["GAIN 10", "HORIZONTAL 2", "0 0", "180"], r"a.pln:4: is '180'; write 2 finite numbers"),
        ("a.pln", [*CUTS, "90 20"], r"a.pln:7: VERTICAL says 4, 5 lines follow; complete the cut"),
        ("a.pln", CUTS[:-1], r"a.pln:7: VERTICAL says 4, 3 lines follow; complete the cut"),
        ("a.pln", [*CUTS[:6], "VERTICAL 2", "0 0", "1 0"], r"VERTICAL has no line between 1° and 0°; write"),
        ("a.pln", ["HORIZONTAL"], r"a.pln:1: is 'HORIZONTAL'; write HORIZONTAL and how many lines follow"),
        ("a.pln", ["VERTICAL 40000"], r"write VERTICAL and how many lines follow, up to 3600"),
        ("a.pln", [*CUTS, "HORIZONTAL 4"], r"a.pln:12: is a second HORIZONTAL; remove one"),
        ("a.pln", [*CUTS, "GAIN 3 dBi"], r"a.pln:12: is a second GAIN; remove one"),
        ("a.pln", [*CUTS[:4], "90 11", "270 4"], r"a.pln:5: a second loss at 90°; remove one"),
        ("a.pln", ["HORIZONTAL 2", "0 0", "90 -20"], r"a.pln:3: the loss is -20 dB; write the attenuation"),
    ],
)
def test_what_is_wrong_with_a_file_is_named_with_its_line(
    tmp_path: Path, name: str, lines: list[str], message: str
) -> None:
    with pytest.raises(AssetError, match=message):
        written(tmp_path, name, *lines)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(AssetError, match=r"b.csv cannot be read: No such file"):
        read_pattern(tmp_path / "b.csv")


def test_comments_may_stand_among_the_lines_of_a_cut_and_other_keys_after_them(tmp_path: Path) -> None:
    more = [*CUTS[:4], "COMMENT side lobe", *CUTS[4:], "ELECTRICAL_TILT 4"]
    plain, commented = written(tmp_path, "a.msi", *CUTS), written(tmp_path, "b.msi", *more)
    assert np.array_equal(plain.values, commented.values)
    joined = written(tmp_path, "c.msi", "GAIN 5dBi", *CUTS[1:])
    assert np.array_equal(plain.values, joined.values)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_files_with_a_byte_order_mark_are_read(tmp_path: Path, encoding: str) -> None:
    """As spreadsheets write them."""
    file = tmp_path / "a.csv"
    file.write_text("theta_deg,phi_deg,gain_dbi\n0,0,1\n180,0,1\n", encoding=encoding)
    assert read_pattern(file).values.tolist() == [[1.0, 1.0], [1.0, 1.0]]


def test_a_pipe_is_named_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.csv")
    with pytest.raises(AssetError, match=r"a\.csv .*named pipe"):
        read_pattern(tmp_path / "a.csv")


def test_the_mean_gain_is_that_over_the_sphere(tmp_path: Path) -> None:
    """Of a gain of 3·cos²θ, and of a field 1.5·sin²θ as a short dipole has it: 0 dBi."""
    angles = [(t, p) for t in range(0, 181, 2) for p in range(0, 360, 90)]
    gains = [f"{t},{p},{10 * math.log10(3 * max(math.cos(math.radians(t)) ** 2, 1e-9))}" for t, p in angles]
    fields = [f"{t},{p},0,{math.sqrt(1.5) * math.sin(math.radians(t))},0,0" for t, p in angles]
    head = "theta_deg,phi_deg,e_theta_re,e_theta_im,e_phi_re,e_phi_im"
    one = written(tmp_path, "a.csv", "theta_deg,phi_deg,gain_dbi", *gains)
    other = written(tmp_path, "b.csv", head, *fields)
    assert one.mean_gain_dbi == pytest.approx(0.0, abs=0.02)
    assert other.mean_gain_dbi == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("gain", [10.1, 400.0, 7000.0, 1e308])
def test_a_pattern_that_radiates_more_than_it_gets_is_refused(tmp_path: Path, gain: float) -> None:
    rows = [f"{t},{p},{gain}" for t in (0, 90, 180) for p in (0, 90, 180, 270)]
    with pytest.raises(AssetError, match=r"a\.csv: .*mean of .* dBi"):
        written(tmp_path, "a.csv", "theta_deg,phi_deg,gain_dbi", *rows)


def test_a_mean_gain_that_cannot_be_right_is_remarked_on(tmp_path: Path) -> None:
    tables = {
        name: written(tmp_path, name, "theta_deg,phi_deg,gain_dbi", f"0,0,{gain}", f"180,0,{gain}")
        for name, gain in (("a.csv", 1.9), ("b.csv", 5.0))
    }
    (note,) = Patterns(tables).notes()
    assert "pattern 'b.csv' has a mean gain of 5.0 dBi over the sphere" in note


def test_a_table_of_scattered_angles_is_refused_before_it_takes_memory(tmp_path: Path) -> None:
    """20,000 lines would become a table of 4e8 directions."""
    rows = [f"{180 * k / 19_999},{k / 100},0" for k in range(20_000)]
    with pytest.raises(AssetError, match=r"theta_deg = 0, phi_deg = 0\.01"):
        written(tmp_path, "a.csv", "theta_deg,phi_deg,gain_dbi", *rows)
