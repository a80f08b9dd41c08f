"""What errors are stated of a rung, and how often that holds."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from caviar_protocol.arrays import Float64Array
from caviar_protocol.topics import Carrier, Channel, ChannelMatrix, ChannelOptions
from caviar_services.channel.adaptive.calibration import (
    CEILING_DB,
    FLOOR_DB,
    WINDOW,
    ErrorBound,
    errors_db,
    pair_powers,
    scores_db,
)
from caviar_services.channel.base import Modelled

PAIRS = [f"bs > car.{number}" for number in range(10)]


def channel(*matrices: complex, powers: tuple[tuple[float, int], ...] = ()) -> Channel:
    """One pair for each 1×1 matrix; ``powers``: of paths of the first pair, each with its reflections."""
    count, paths = len(matrices), len(powers)
    return Channel(
        rung="siso-rt",
        options=ChannelOptions(max_depth=2),
        carriers=(Carrier(name="c", frequency_hz=28e9),),
        tx=("t",),
        rx=tuple(f"r{i}" for i in range(count)),
        los=np.zeros((1, count), bool),
        offsets=np.array([0] + [paths] * count, np.int64),
        id=np.zeros(paths, np.uint64),
        a=np.sqrt([[power for power, _ in powers]]).astype(complex).reshape(1, paths),
        tau=np.zeros(paths),
        aod=np.zeros((paths, 2)),
        aoa=np.zeros((paths, 2)),
        doppler=np.zeros((1, paths)),
        interactions=np.array([[1] * n + [0] * (2 - n) for _, n in powers], np.uint8).reshape(paths, 2),
        points=np.zeros((paths, 2, 3)),
        objects=np.zeros((paths, 2), np.int32),
        h=tuple(
            ChannelMatrix(carrier=0, tx=0, rx=i, h=np.array([[value]], complex))
            for i, value in enumerate(matrices)
        ),
    )


class TestErrors:
    """The error of a pair, and what tells pairs apart before it is known."""

    def test_each_pair_has_its_own(self) -> None:
        """|0.1j|² / |1|² = 0.01 and |0.3|² / |3|² = 0.01; a missing path: 0 dB; a phase of π: 6 dB."""
        found = errors_db(channel(1 + 0.1j, 3.3, 0, -1), channel(1, 3, 1j, 1))
        np.testing.assert_allclose(found, [-20, -20, 0, 10 * np.log10(4)])

    def test_equal_matrices_have_the_floor_and_no_path_at_all_has_no_error(self) -> None:
        found = errors_db(channel(1, 2, 5), channel(1, 0, 1e-9))
        assert found[0] == FLOOR_DB
        assert np.isnan(found[1])
        assert found[2] == CEILING_DB

    def test_carriers_count_together(self) -> None:
        """|1|² / (|1|² + |3|²) = 0.1."""
        one, other = channel(2), channel(1)
        second = ChannelMatrix(carrier=1, tx=0, rx=0, h=np.array([[3.0 + 0j]]))
        both = [msgspec.structs.replace(found, h=(*found.h, second)) for found in (one, other)]
        np.testing.assert_allclose(errors_db(*both), [-10])

    def test_the_score_is_the_power_of_the_last_order(self) -> None:
        """0.25 of 4 comes by two reflections, as many as there may be; the second pair has no path."""
        made = channel(1, 1, powers=((3.0, 0), (0.75, 1), (0.25, 2)))
        np.testing.assert_allclose(scores_db(Modelled(channel=made)), [10 * np.log10(1 / 16), FLOOR_DB])

    def test_the_score_is_that_of_the_split_launch_where_there_is_one(self) -> None:
        made = Modelled(channel=channel(1, 1), split_nmse=np.array([[0.1, 0.0]]))
        np.testing.assert_allclose(scores_db(made), [-10, FLOOR_DB])


def normal(rng: np.random.Generator, check: int) -> Float64Array:
    """Errors that could have come in any order."""
    return rng.normal(-30, 5, 10)


def two_humps(rng: np.random.Generator, check: int) -> Float64Array:
    """All paths there, or one that is missing: in a third of the pairs, and the more of them the later."""
    lacks = rng.random(10) < 0.2 + 0.2 * np.sin(check / 40)
    return np.where(lacks, rng.uniform(-15, 2, 10), FLOOR_DB)


def steps(rng: np.random.Generator, check: int) -> Float64Array:
    """Fifty checks in a quiet street, fifty in a busy one."""
    return rng.normal(-35 if check // 50 % 2 else -10, 4, 10)


def drift(rng: np.random.Generator, check: int) -> Float64Array:
    """Ever larger errors: each is likely to be beyond all that were measured before."""
    return np.minimum(rng.normal(-50 + 0.15 * check, 2, 10), CEILING_DB)


def alike(rng: np.random.Generator, check: int) -> Float64Array:
    """Errors of one check go up and down together: all pairs drive in one street."""
    return -25 + 10 * np.sin(check / 3) + rng.normal(0, 6) + rng.normal(0, 1, 10)


def covered(stream: Callable[[np.random.Generator, int], Float64Array], checks: int = 300) -> list[int]:
    """How many of ten errors were within their bounds, check by check."""
    rng, bound = np.random.default_rng(11), ErrorBound()
    return [
        bound.check(10 * number, PAIRS, np.zeros(10), np.clip(stream(rng, number), FLOOR_DB, CEILING_DB))
        for number in range(checks)
    ]


class TestCoverage:
    """Nine of ten errors are within what is stated of them."""

    @pytest.mark.parametrize("stream", [normal, two_humps, steps, drift, alike])
    def test_it_is_that_promised_however_errors_change(
        self, stream: Callable[[np.random.Generator, int], Float64Array]
    ) -> None:
        """Within the 99 % interval of a binomial share, 0.9 ± 2.58·sqrt(0.9 · 0.1 / N), of N = 3,000."""
        share = sum(covered(stream)) / 3000
        assert share == pytest.approx(0.9, abs=2.58 * np.sqrt(0.09 / 3000))

    @pytest.mark.parametrize("stream", [normal, two_humps])
    def test_in_the_beginning_bounds_hold_too(
        self, stream: Callable[[np.random.Generator, int], Float64Array]
    ) -> None:
        assert sum(covered(stream, 3)) >= 27

    def test_before_anything_is_known_it_is_finite(self) -> None:
        assert ErrorBound().bounds_db(0, PAIRS, np.zeros(10)).tolist() == [6.0] * 10
        assert ErrorBound(-15.0).bounds_db(0, PAIRS, np.zeros(10)).tolist() == [-15.0] * 10
        assert ErrorBound().bounds_db(0, [], np.zeros(0)).shape == (0,)

    def test_a_declared_error_that_is_too_small_is_found_out(self) -> None:
        bound = ErrorBound(-50.0)
        assert bound.check(0, PAIRS, np.zeros(10), np.full(10, -20.0)) == 0
        assert bound.check(10, PAIRS, np.zeros(10), np.full(10, -20.0)) == 10

    def test_a_score_that_tells_pairs_apart_makes_bounds_narrower(self) -> None:
        """Half of the pairs are off by −10 dB, the others by −45 dB, and their scores say which."""
        rng, bound = np.random.default_rng(5), ErrorBound()
        scores = np.where(np.arange(10) % 2, -5.0, -40.0)
        centre = np.where(np.arange(10) % 2, -10.0, -45.0)
        for number in range(60):
            bound.check(10 * number, PAIRS, scores, rng.normal(centre, 2.0))
            bound.forget_pairs()
        stated = bound.bounds_db(600, PAIRS, scores)
        assert (stated[1::2] > -10).all()
        assert (stated[::2] < -35).all()

    def test_the_last_error_of_a_pair_makes_its_bound_narrower_until_it_is_old(self) -> None:
        rng, bound = np.random.default_rng(6), ErrorBound()
        centre = np.where(np.arange(10) < 2, -10.0, -45.0)
        for number in range(60):
            bound.check(10 * number, PAIRS, np.zeros(10), rng.normal(centre, 2.0))
        stated = bound.bounds_db(600, PAIRS, np.zeros(10))
        assert (stated[2:] < -35).all()
        assert (stated[:2] > -12).all()
        assert (bound.bounds_db(640, PAIRS, np.zeros(10)) > -15).all(), "which they are is not known any more"


class TestKnowledge:
    """What goes on in another episode or process."""

    def test_what_was_learned_is_a_text_that_another_one_learns(self) -> None:
        rng, bound = np.random.default_rng(2), ErrorBound()
        for number in range(40):
            bound.check(10 * number, PAIRS, rng.uniform(-40, 0, 10), rng.normal(-30, 8, 10))
        other = ErrorBound()
        other.learn(bound.learned)
        bound.forget_pairs()
        assert other.learned == bound.learned
        assert len(bound.learned) < 4 * WINDOW + 8
        scores = rng.uniform(-40, 0, 10)
        np.testing.assert_array_equal(other.bounds_db(0, PAIRS, scores), bound.bounds_db(0, PAIRS, scores))

    def test_nothing_learned_is_an_empty_text(self) -> None:
        bound = ErrorBound()
        bound.check(0, PAIRS, np.zeros(10), np.full(10, -3.0))
        bound.learn("")
        assert bound.learned == ""
        assert bound.bounds_db(0, PAIRS[:1], np.zeros(1)) == [6.0]

    @pytest.mark.parametrize(
        ("text", "told"),
        [
            ("?", "base64"),
            ("AA", "padding"),
            ("AAAAAA==", "4 bytes are no"),
            ("A" * 4000, "3000 bytes are no"),
        ],
    )
    def test_another_text_is_refused(self, text: str, told: str) -> None:
        with pytest.raises(ValueError, match=told):
            ErrorBound().learn(text)

    def test_a_thousand_pairs_of_one_frame_do_not_push_out_all_others(self) -> None:
        bound = ErrorBound()
        many = [f"bs > {number}" for number in range(1000)]
        bound.check(0, PAIRS, np.zeros(10), np.full(10, -3.0))
        bound.check(10, many, np.full(1000, -50.0), np.full(1000, -50.0))
        assert bound.bounds_db(20, PAIRS[:1], np.zeros(1))[0] >= -3.0


def test_a_weak_pair_keeps_its_power_beside_a_strong_one() -> None:
    channel = SimpleNamespace(a=np.array([[1.0, 1e-10, 2e-10]]), offsets=np.array([0, 1, 1, 3]))
    np.testing.assert_allclose(pair_powers(channel), [1.0, 0.0, 5e-20], rtol=1e-12)  # type: ignore[arg-type]
