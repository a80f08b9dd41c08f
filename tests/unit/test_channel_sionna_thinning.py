"""Which points become diffuse paths, without a scene."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mitsuba")

from caviar_protocol.topics import AntennaArray
from caviar_services.channel.paths import Antenna
from caviar_services.channel.sionna.ray_launcher import Element, Thinning


def element(pattern: str, rotation: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Element:
    array = AntennaArray(pattern=pattern)  # type: ignore[arg-type]
    return Element(Antenna("tx", array, np.zeros(3), rotation, np.zeros(3)))


def thinning(wanted: int, seed: int = 0) -> Thinning:
    return Thinning(SimpleNamespace(shapes=list), wanted, seed)


def weights(count: int, receivers: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Of many sizes, some 0."""
    rng = np.random.default_rng(5)
    found: np.ndarray[tuple[int, int], np.dtype[np.float64]] = 10.0 ** rng.uniform(-7, -2, (count, receivers))
    found[rng.random((count, receivers)) < 0.3] = 0.0
    return found


def test_what_stands_for_all_is_right_in_the_mean() -> None:
    """What the points bring is not quite what was expected of them; over 300 seeds, to 4 standard errors."""
    weight = weights(3_000, 2)
    brings = weight * np.random.default_rng(6).uniform(0.3, 3.0, weight.shape)
    ray, depth = np.arange(3_000) * 3, np.repeat([1, 2], [2_000, 1_000])
    sums, counts = [], []
    for seed in range(300):
        kept, probability = thinning(100, seed).chosen(ray, depth, weight)
        sums.append(np.where(kept, brings / np.where(kept, probability, 1.0), 0.0).sum(0))
        counts.append(kept.sum(0))
    relative = np.array(sums) / brings.sum(0)
    assert (np.abs(relative.mean(0) - 1) < 4 * relative.std(0) / np.sqrt(300)).all()
    assert (relative.std(0) < 0.1).all()
    assert np.mean(counts) < 100
    assert np.mean(counts) > 60


def test_nothing_is_chosen_of_what_brings_nothing_and_all_of_what_brings_most() -> None:
    weight = weights(1_000, 1)
    weight[7] = 1.0
    for seed in range(20):
        kept, probability = thinning(50, seed).chosen(np.arange(1_000), np.ones(1_000, np.int64), weight)
        assert not kept[weight == 0].any()
        assert kept[7, 0]
        assert probability[7, 0] == 1.0


def test_the_choice_for_a_receiver_is_its_own() -> None:
    weight = weights(2_000, 5)
    ray, depth = np.arange(2_000), np.ones(2_000, np.int64)
    together = thinning(80).chosen(ray, depth, weight)
    for receiver in range(5):
        alone = thinning(80).chosen(ray, depth, weight[:, receiver : receiver + 1])
        np.testing.assert_array_equal(alone[0][:, 0], together[0][:, receiver])
        np.testing.assert_array_equal(alone[1][:, 0], together[1][:, receiver])


def test_without_weights_there_is_no_choice() -> None:
    kept, _ = thinning(10).chosen(np.arange(4), np.ones(4, np.int64), np.zeros((4, 2)))
    assert not kept.any()


def test_an_element_sends_along_its_own_axes() -> None:
    """The sector pattern of 3GPP TR 38.901 has 8 dBi ahead and 30 dB less behind; here ahead is +y."""
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    gain = element("tr38901", turned).gain(np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]))
    np.testing.assert_allclose(10 * np.log10(gain), [8.0, -22.0], atol=1e-9)
    assert element("tr38901", turned).key != element("iso", turned).key
