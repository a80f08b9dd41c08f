"""The response of beam pairs, from paths alone, against the matrices of the whole grid."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest

from caviar_protocol.errors import PayloadError
from caviar_protocol.space.antenna_arrays import dft_beam, dft_codebook
from caviar_protocol.topics import AntennaArray, Carrier, Channel, Scene
from caviar_services.channel.statistical.geometric import GeometricChannel
from caviar_services.channel.statistical.waves import GeometricSettings
from caviar_services.link.base import Users, users_of
from caviar_services.link.beam_scores import beam_responses
from caviar_services.service import Preparation, RunInfo
from caviar_services.testing import samples

CARRIERS = (
    Carrier(
        name="mmwave",
        frequency_hz=28e9,
        subcarriers=24,
        subcarrier_spacing_hz=480e3,
        slots=3,
        slot_duration_s=1e-4,
    ),
    Carrier(name="low", frequency_hz=3.5e9, subcarriers=7, subcarrier_spacing_hz=30e3),
)


@pytest.fixture(scope="module")
def street() -> tuple[Scene, Users, Channel]:
    """A frame of turned arrays of 2×8, 1×3 and 2×1 elements, six paths to each user."""
    run = RunInfo(name="channel", carriers=CARRIERS)
    model = GeometricChannel(GeometricSettings(components=6), run)
    model.prepare(Preparation(demand={"channel": frozenset({"hf"})}))
    frame = samples.granted(model.inputs, 1, "channel")
    channel = model.step(frame).products["channel"]
    assert isinstance(channel, Channel)
    scene = frame.scene()
    return scene, users_of(scene, CARRIERS), channel


def test_beams_of_paths_are_beams_of_the_whole_grid(street: tuple[Scene, Users, Channel]) -> None:
    scene, users, channel = street
    grid = {(r.carrier, r.tx, r.rx): r.h for r in channel.hf}
    for beams in itertools.product((0, 5, 13), (0, 1)):
        found = beam_responses(channel, scene, users, [beams] * len(users))
        for user, place, y in zip(users, users.channel_indices(channel), found, strict=True):
            assert place is not None
            w, f = dft_codebook(user.rx.array)[beams[1]], dft_codebook(user.tx.array)[beams[0]].conj()
            expected = np.einsum("m,skmn,n->sk", w.conj(), grid[place], f)
            assert y.shape == (user.carrier.slots, user.carrier.subcarriers)
            assert np.abs(y - expected).max() <= 1e-6 * np.abs(grid[place]).max()


def test_where_paths_do_not_say_it_the_grid_is_asked_for(street: tuple[Scene, Users, Channel]) -> None:
    scene, users, channel = street
    beams = [(3, 1)] * len(users)
    near = msgspec.structs.replace(channel, rung="spherical")
    grid = {(r.carrier, r.tx, r.rx): r.h for r in channel.hf}
    for place, y, expected in zip(
        users.channel_indices(channel),
        beam_responses(near, scene, users, beams),
        beam_responses(channel, scene, users, beams),
        strict=True,
    ):
        # The grid is in single precision: a beam that misses is a small difference of its large numbers.
        assert place is not None
        assert np.abs(y - expected).max() <= 1e-6 * np.abs(grid[place]).max()
    with pytest.raises(PayloadError, match=r"'spherical'.*'hf'"):
        beam_responses(msgspec.structs.replace(near, hf=()), scene, users, beams)


def test_users_that_are_not_served_get_nothing(street: tuple[Scene, Users, Channel]) -> None:
    scene, users, channel = street
    found = beam_responses(channel, scene, users, [(-1, -1)] + [(0, 0)] * (len(users) - 1))
    assert not found[0].any()
    assert all(y.any() for y in found[1:])
    other = msgspec.structs.replace(channel, tx=("mast",))
    assert not any(y.any() for y in beam_responses(other, scene, users, [(0, 0)] * len(users)))


def test_a_beam_outside_the_codebook_is_named(street: tuple[Scene, Users, Channel]) -> None:
    scene, users, channel = street
    with pytest.raises(PayloadError, match=r"beam 16 of user bs → .* beams 0 to 15"):
        beam_responses(channel, scene, users, [(16, 0)] * len(users))


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (1, 5), (3, 1), (4, 6)])
def test_a_beam_is_a_row_of_the_codebook(rows: int, columns: int) -> None:
    array = AntennaArray(rows=rows, columns=columns)
    for beam, row in enumerate(dft_codebook(array)):
        np.testing.assert_array_equal(dft_beam(array, beam), row)
