"""Element patterns from files: what tables and cuts mean, and what is wrong with bad ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from caviar_protocol.errors import AssetError
from caviar_services.pattern_files import PatternTable, read_pattern


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
