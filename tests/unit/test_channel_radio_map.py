"""Cells of a radio map, and what their gains mean; no rays are shot here."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_protocol.errors import RunError
from caviar_protocol.topics import AntennaArray
from caviar_services.channel.radio_map import (
    Coverage,
    beams_of,
    cell_counts,
    decibels,
    draped_surface,
    heights,
    least_memory,
    level_surface,
    part_of,
)


def test_cells_cover_the_area_and_share_what_is_too_much() -> None:
    surface = level_surface((0.0, -1.0, 10.0, 1.0), 3.0, 1.5)
    assert surface.shape == cell_counts((0.0, -1.0, 10.0, 1.0), 3.0) == (1, 4)
    np.testing.assert_allclose(surface.x, [-1, 2, 5, 8, 11])
    np.testing.assert_allclose(surface.y, [-1.5, 1.5])
    np.testing.assert_allclose(surface.centres[0, :, 0], [0.5, 3.5, 6.5, 9.5])
    assert (surface.centres[..., 2] == 1.5).all()


def test_an_area_of_whole_cells_has_no_further_one() -> None:
    assert cell_counts((0.0, 0.0, 0.3, 0.7), 0.1) == (7, 3)


def test_two_triangles_make_each_cell_and_face_upwards() -> None:
    surface = level_surface((0.0, 0.0, 6.0, 4.0), 2.0, 1.5)
    mesh, cells = surface.triangles()
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, 2.0], (12, 1)))
    np.testing.assert_array_equal(cells, np.repeat(np.arange(6), 2))
    middles = corners.reshape(6, 6, 3).mean(1)
    np.testing.assert_allclose(middles, surface.centres.reshape(-1, 3), atol=0.5)


def test_the_highest_of_several_triangles_counts_and_upright_ones_do_not() -> None:
    slope = [(0.0, 0.0, 0.0), (4.0, 0.0, 4.0), (0.0, 4.0, 0.0)]
    above = [(0.0, 0.0, 3.0), (1.0, 0.0, 3.0), (0.0, 1.0, 3.0)]
    wall = [(0.0, 2.0, 0.0), (4.0, 2.0, 0.0), (4.0, 2.0, 9.0)]
    found = heights(np.array([slope, above, wall]), np.array([0.5, 2.0, 3.9]), np.array([0.25, 1.5]))
    np.testing.assert_allclose(found, [[3.0, 2.0, np.nan], [0.5, 2.0, np.nan]])


def test_cells_without_ground_at_a_corner_are_left_out() -> None:
    square = np.array([[(0, 0, 1), (4, 0, 1), (4, 4, 1)], [(0, 0, 1), (4, 4, 1), (0, 4, 1)]], float)
    surface = draped_surface((-2.0, 0.0, 6.0, 4.0), 2.0, 1.5, square)
    np.testing.assert_array_equal(surface.covered, [[False, True, True, False]] * 2)
    mesh, cells = surface.triangles()
    assert (mesh.vertices[:, 2] == 2.5).all()
    np.testing.assert_array_equal(cells, np.repeat([1, 2, 5, 6], 2))


def coverage(**more: object) -> Coverage:
    """Two transmitters, three cells: the first serves, the second serves, neither does."""
    gain = np.array([[[1e-8, 1e-10, 0.0]], [[1e-9, 4e-10, 0.0]]])
    given = {"gain": gain, "interference_gain": gain / 4, "power_w": np.array([1.0, 0.5]), "noise_w": 1e-11}
    return Coverage(**{**given, **more})  # type: ignore[arg-type]


def test_best_server_by_received_power_and_none_without_a_signal() -> None:
    found = coverage()
    np.testing.assert_allclose(found.rss[:, 0], [[1e-8, 1e-10, 0], [5e-10, 2e-10, 0]])
    assert found.best_server.tolist() == [[0, 1, -1]]
    np.testing.assert_allclose(found.of_server(found.rss), [[1e-8, 2e-10, np.nan]])


def test_what_is_far_below_the_noise_is_no_signal() -> None:
    """−174 dB of one ray in a building: 59 dB below the noise of 100 MHz with 1 W."""
    gain = 10 ** np.array([[[-7.0, -15.4, -15.6, -17.4]]])
    found = coverage(gain=gain, interference_gain=gain, power_w=np.ones(1), noise_w=10**-11.5)
    assert found.best_server.tolist() == [[0, 0, -1, -1]]
    assert np.isnan(found.of_server(found.rss)[0]).tolist() == [False, False, True, True]
    assert found.rss[0, 0, 3] > 0.0  # the arrays keep it


def test_sinr_counts_all_others_with_their_interference_gain() -> None:
    expected = [[1e-8 / (1e-11 + 0.5e-9 / 4), 1e-10 / (1e-11 + 2e-10 / 4), 0.0]]
    np.testing.assert_allclose(coverage().sinr[0], expected)
    np.testing.assert_allclose(coverage().sinr[1, 0, 0], 5e-10 / (1e-11 + 1e-8 / 4))


def test_one_far_stronger_than_the_rest_leaves_them_their_interference() -> None:
    """Not the sum of all less one's own, of which rounding would leave nothing."""
    gain = np.array([[[1.0]], [[1e-20]]])
    found = coverage(gain=gain, interference_gain=gain, power_w=np.ones(2), noise_w=0.0)
    assert found.sinr[0, 0, 0] == pytest.approx(1e20)


def test_a_single_transmitter_has_its_signal_over_noise() -> None:
    gain = np.array([[[2e-10]]])
    found = coverage(gain=gain, interference_gain=gain, power_w=np.ones(1))
    assert found.sinr[0, 0, 0] == pytest.approx(20.0)


def test_decibels_of_nothing_are_no_number() -> None:
    np.testing.assert_allclose(decibels(np.array([1e-3, 0.0, np.nan]), 1e-3), [0.0, np.nan, np.nan])


def test_parts_are_equal_and_fit_the_memory() -> None:
    assert part_of(10_000_000, 70_000, 64, 2**31) == 1_000_000
    assert part_of(2_500_000, 100, 0, 2**31) == 833_334
    small = least_memory(70_000, 64)
    assert part_of(10_000_000, 70_000, 64, small) == 20_000
    assert part_of(10_000_000, 70_000, 64, small - 100_000) == 0
    assert part_of(5_000, 100, 4, 2**30) == 5_000


def test_beams_to_choose_among() -> None:
    planar = AntennaArray(rows=2, columns=4)
    assert beams_of(planar, "best", "bs") == range(8)
    assert beams_of(planar, "wide", "bs") == range(0)
    assert beams_of(planar, 7, "bs") == range(7, 8)
    assert beams_of(AntennaArray(), "best", "bs") == range(0)
    with pytest.raises(RunError, match=r"'bs'.*beams 0 to 7"):
        beams_of(planar, 8, "bs")
