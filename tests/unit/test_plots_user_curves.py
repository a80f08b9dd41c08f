"""Pictures of |y|: which users they show, and what of a run goes into the curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recording_builders import absent, frame, frame_of, link, product, record

from caviar_clients.plots.user_curves import (
    _without_jumps,
    choose_user,
    draw_over_angle,
    draw_over_time,
    series,
    shade,
)
from caviar_protocol.errors import RecordingError
from caviar_protocol.recording import Recording

pytestmark = pytest.mark.slow

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")

USER = ("bs", "car.1/rx", "c0")


def with_links(folder: Path, users: list[int], without_path: tuple[int, ...] = ()) -> Recording:
    """A recording with as many users in each frame as ``users`` says; 0: the link is absent."""
    frames = []
    for number, count in enumerate(users):
        payload = link(number, count, tuple(u for u in without_path if u < count))
        item = product("link", "link", payload, number) if count else absent("link", "link", "late")
        frames.append(frame(number, item))
    return Recording(record(folder, frames))


def test_the_user_that_was_there_longest_is_shown(tmp_path):
    recording = with_links(tmp_path, [1, 1, 3, 2, 2])
    assert choose_user(recording) == ("bs", "car.0/rx", "c0")


@pytest.mark.parametrize("name", ["car.1/rx", "car.1"])
def test_a_user_is_named_by_receiver_or_object(tmp_path, name):
    assert choose_user(with_links(tmp_path, [3, 3]), name) == USER


def test_an_unknown_user_is_refused_with_the_names_there_are(tmp_path):
    with pytest.raises(RecordingError, match=r"'car\.9/rx'.*'car\.\d/rx'.*car\.0/rx"):
        choose_user(with_links(tmp_path, [2]), "car.9/rx")


def test_a_recording_without_a_link_says_so(tmp_path):
    with pytest.raises(RecordingError, match="has no link"):
        choose_user(Recording(record(tmp_path, frames=0)))


def test_the_curves_are_those_of_the_link_with_gaps_where_the_user_was_not(tmp_path):
    data = series(with_links(tmp_path, [3, 1, 0, 3, 2], without_path=()), USER)
    assert data.time.tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert data.present.tolist() == [True, False, False, True, True]
    assert data.los.tolist() == [False, False, False, True, True]  # the sample is NLOS in frame 0
    np.testing.assert_allclose(data.best, [4.0, np.nan, np.nan, 4.3, 4.4])
    np.testing.assert_allclose(data.abs_y, data.best / 2)
    np.testing.assert_allclose(data.baseline, data.best / 4)
    np.testing.assert_allclose(data.theta, [0.5, np.nan, np.nan, 0.56, 0.58])


def test_a_user_without_a_path_is_present_but_has_none(tmp_path):
    data = series(with_links(tmp_path, [3, 3], without_path=(1,)), USER)
    assert data.present.all()
    assert not data.has_path.any()
    assert not data.los.any()


def test_time_goes_on_over_episodes(tmp_path):
    record(tmp_path, [frame_of(number, link=link(number), episode=e) for e in (0, 1) for number in range(2)])
    assert series(Recording(tmp_path), USER).time.tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3])


@pytest.mark.parametrize("users", [[3] * 12, [3, 3, 0, 1, 3, 3, 3], [3]])
def test_the_pictures_are_drawn_whatever_is_missing(tmp_path, users):
    data = series(with_links(tmp_path / "run", users, without_path=(1,) if len(users) == 7 else ()), USER)
    for draw in (draw_over_time, draw_over_angle):
        file = tmp_path / "out" / f"{draw.__name__}.png"
        draw(data, "los-beam", file)
        with Image.open(file) as picture:
            assert picture.format == "PNG"
            assert picture.width > 1000
            assert len(np.unique(np.asarray(picture.convert("L")))) > 20


def test_an_angle_that_passes_180_degrees_leaves_a_gap():
    time, degrees = _without_jumps(np.arange(4.0), np.array([170.0, 179.0, -178.0, -170.0]))
    np.testing.assert_array_equal(time, [0, 1, 2, 2, 3])
    np.testing.assert_array_equal(degrees, [170, 179, np.nan, -178, -170])


def test_nlos_frames_are_shaded(tmp_path):
    data = series(with_links(tmp_path / "run", [3] * 11), USER)  # NLOS in frames 0, 5, 10
    spans: list[tuple[float, float, str | None]] = []

    class Axes:
        def axvspan(self, left, right, label=None, **_):
            spans.append((round(left, 3), round(right, 3), label))

    shade(Axes(), data)
    assert spans == [(-0.05, 0.05, "NLOS"), (0.45, 0.55, None), (0.95, 1.05, None)]
