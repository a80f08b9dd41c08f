"""`caviar paper pizza`: ways around blocks, both agents learn, the trial end to end, mistakes."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("scipy", reason="SciPy is not installed")
pytest.importorskip("matplotlib", reason="Matplotlib is not installed")
from caviar_clients.cli.main import app
from caviar_labs.paper.pizza import PAIRS, TRAINED, Report, Settings, Trained
from caviar_labs.paper.pizza_beams import train_beams
from caviar_labs.paper.pizza_flight import Pilot, legs_between, train_pilot
from caviar_labs.paper.pizza_play import Course, Flight, nearest_first
from caviar_labs.paper.pizza_radio import RadioTable
from caviar_labs.paper.pizza_tables import comparisons, ratio_of
from caviar_labs.paper.pizza_town import Ways, draw_places, draw_round, is_clear, is_free, points_along
from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import ScenarioError

ALONG_Y = np.array([[-23.0, -20.0], [-23.0, 20.0]])
"""Both ends in one street between the blocks."""
BEHIND = np.array([[0.0, 0.0], [0.0, 42.0]])
"""On both sides of the block from (−15.1, 9.6) to (16, 37.5)."""


def east_is_good(places: Float64Array) -> Float64Array:
    """A rate that is full east of x = 0 alone."""
    return (places[:, 0] > 0).astype(np.float64)


def town_of_two_beams() -> RadioTable:
    """Beam 0 is good in the west, beam 1 in the east, and beam 2, the straight one, never."""
    grid = np.stack(np.meshgrid(np.arange(-82.5, 83, 5.0), np.arange(-47.5, 48, 5.0), indexing="ij"), -1)
    places = grid[is_free(grid, 1.5)]
    east = places[:, 0] > 0
    efficiency = np.stack([np.where(east, 2.0, 8.0), np.where(east, 8.0, 2.0), np.ones(len(places))], axis=1)
    away = np.linalg.norm(grid[:, :, None] - places, axis=-1)
    straight = np.full(len(places), 2)
    return RadioTable(places, efficiency, straight, np.zeros(len(places), np.bool_), away.argmin(-1), 5.0)


def test_shortest_ways_are_straight_or_over_the_corners_of_blocks() -> None:
    straight = Ways(ALONG_Y).cheapest()
    assert straight.way(0, 1).tolist() == ALONG_Y.tolist()
    assert straight.cost[0, 1] == pytest.approx(40.0)
    # By hand: the nearer two corners, 3.5 m off the block, on the west side.
    low, high = np.array([-18.6, 6.1]), np.array([-18.6, 41.0])
    east_low, east_high = np.array([19.5, 6.1]), np.array([19.5, 41.0])
    by_hand = [
        np.linalg.norm(a - BEHIND[0]) + np.linalg.norm(b - a) + np.linalg.norm(BEHIND[1] - b)
        for a, b in ((low, high), (east_low, east_high))
    ]
    around = Ways(BEHIND).cheapest()
    way = around.way(0, 1)
    assert float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()) == pytest.approx(min(by_hand))
    assert is_clear(way[:-1], way[1:]).all()


def test_a_rate_that_is_worth_a_detour_makes_one() -> None:
    ways = Ways(BEHIND)
    assert ways.cheapest().way(0, 1)[1:-1, 0].max() < 0
    detour = ways.cheapest(east_is_good, worth=4.0).way(0, 1)
    assert detour[1:-1, 0].min() > 0
    assert is_clear(detour[:-1], detour[1:]).all()


def test_a_place_in_a_block_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"\[0\.0, 20\.0\].*3\.5 m"):
        Ways(np.array([[0.0, 0.0], [0.0, 20.0]]))


def test_rounds_are_drawn_by_their_generator_alone_and_apart() -> None:
    first, again = (draw_round(3, np.random.default_rng(3), 4) for _ in range(2))
    assert np.array_equal(first.places, again.places)
    assert is_free(first.places).all()
    apart = [math.dist(a, b) for a, b in itertools.combinations(first.places.tolist(), 2)]
    assert min(apart) >= 25.0
    assert len(draw_round(5, np.random.default_rng(5), 8).addresses) == 8
    other = draw_round(4, np.random.default_rng(4), 4)
    assert not np.array_equal(first.places, other.places)


def test_the_beams_agent_learns_from_feedback_where_each_beam_is_good_alike_for_a_seed() -> None:
    table = town_of_two_beams()
    agent, experience = train_beams(table, 250, 20, np.random.default_rng(1))
    far = table.places[np.abs(table.places[:, 0]) > 15]
    chosen = agent.choose(far, np.full(len(far), -1), np.zeros(len(far)))
    assert float((chosen == (far[:, 0] > 0)).mean()) > 0.95
    assert experience.figures[-1][1] > experience.figures[0][1]
    assert 6.5 < float(experience.efficiency.mean()) <= 8.0
    same, _ = train_beams(table, 250, 20, np.random.default_rng(1))
    assert np.array_equal(same.network.values(np.ones((1, 102))), agent.network.values(np.ones((1, 102))))


def test_the_pilot_comes_near_the_best_order_and_ways_and_is_better_than_the_nearest_address() -> None:
    pilot, figures = train_pilot(east_is_good, 3, 1500, 60, np.random.default_rng(2))
    assert figures[-1][1] < figures[0][1]
    draws, costs = np.random.default_rng(5), []
    for _ in range(15):
        legs = legs_between(draw_places(draws, 4, 25.0), east_is_good)
        least = legs.costs.min(-1)
        orders = itertools.permutations((1, 2, 3))
        best = min(sum(least[a, b] for a, b in zip((0, *o[:-1]), o, strict=True)) for o in orders)
        played = []
        for choose in (lambda *of: pilot.choose(of[0].frames, of[0].costs, *of[1:]), nearest_first):
            at, left, cost = 0, np.ones(3, np.bool_), 0.0
            while left.any():
                address, kind = choose(legs, at, left)
                assert left[address - 1]
                cost += float(legs.costs[at, address, kind])
                at, left[address - 1] = address, False
            played.append(cost)
        costs.append((*played, best))
    trained, nearest, best = np.mean(costs, axis=0)
    assert trained < 1.05 * best
    assert trained < 0.95 * nearest


def test_a_course_is_kept_and_slow_in_turns_and_at_its_end() -> None:
    way = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 30.0]])
    course, place, speeds, off = Course(way, 8.0), way[0].copy(), [], []
    for _ in range(60):
        velocity = course.velocity(place)
        place = place + 0.5 * velocity
        speeds.append(float(np.hypot(*velocity)))
        on_way = min(np.linalg.norm(points_along(way, 0.1) - place, axis=1))
        off.append(float(on_way))
    assert max(speeds) == pytest.approx(8.0)
    assert min(speeds[4:10]) < 5.0  # at the turn
    assert max(off) < 2.0
    assert np.linalg.norm(place - way[-1]) < 3.0


def test_ratios_have_the_interval_of_paired_logarithms() -> None:
    ours, theirs = np.array([2.0, 4.0, 3.0, 0.0]), np.array([1.0, 2.5, 1.0, 1.0])
    logs = np.log([2.0, 1.6, 3.0])
    half = 4.302653 * logs.std(ddof=1) / math.sqrt(3)  # t of two degrees of freedom
    found = ratio_of(ours, theirs)
    assert found.episodes == 3
    assert found.mean == pytest.approx(math.exp(logs.mean()))
    assert (found.low, found.high) == pytest.approx(
        (math.exp(logs.mean() - half), math.exp(logs.mean() + half)), rel=1e-5
    )


def flight(seconds: float, efficiency: float, delivered: int) -> Flight:
    """A flight at one rate, all of it out of sight."""
    frames = round(2 * seconds)
    never, rates = np.zeros(frames, np.bool_), np.full(frames, efficiency)
    return Flight(seconds, delivered, (1, 2), (0, 0), np.zeros((frames, 2)), rates, never, never)


def report(trained: list[Flight]) -> Report:
    """Two episodes of two addresses, in which all but the trained pair need 40 s at 2 bit/s/Hz."""
    draws = np.random.default_rng(0)
    agent, experience = train_beams(town_of_two_beams(), 1, 5, draws)
    pair = Trained(town_of_two_beams(), agent, experience, Pilot(2, draws), [])
    flights = {name: [flight(40.0, 2.0, 2)] * 2 for name in PAIRS} | {TRAINED: trained}
    rounds = [draw_round(seed, draws, 2) for seed in range(2)]
    return Report(Settings(episodes=2, addresses=2), pair, rounds, flights, 100e6, 0.5, 1.0, 1.0)


def test_tables_say_whether_targets_are_reached_and_by_how_much_one_is_missed() -> None:
    good = "\n".join(one.markdown() for one in comparisons(report([flight(42.0, 3.0, 2)] * 2)))
    assert "| time | 1.050 [1.050, 1.050] | ≤ 1.10 | yes |" in good
    assert "| mean rate | 1.500 [1.500, 1.500] | ≥ 1.20 | yes |" in good
    assert "misses" not in good
    bad = "\n".join(
        one.markdown() for one in comparisons(report([flight(50.0, 2.2, 1), flight(50.0, 0.0, 2)]))
    )
    assert "The time misses its target by 0.150." in bad
    assert "The mean rate misses its target by 0.100." in bad
    assert "before the last delivery, whose time is the whole episode: 1." in bad
    assert "The ratio of rates is of 1 of 2 episodes" in bad


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder and the output of the command's trial."""
    pytest.importorskip("sionna", reason="Sionna RT is not installed")
    folder = tmp_path_factory.mktemp("pizza")
    done = CliRunner().invoke(app, ["paper", "pizza", "--quick", "--out", str(folder)])
    assert done.exit_code == 0, done.output
    return folder, done.output


@pytest.mark.slow
@pytest.mark.exhaustive
def test_the_trial_plays_all_pairs_in_the_loop_and_is_called_a_trial(trial: tuple[Path, str]) -> None:
    folder, output = trial
    found = json.loads((folder / "pizza-quick.json").read_text())
    assert found["trial"]
    assert "A TRIAL" in output
    text = (folder / "pizza-quick.md").read_text()
    assert text.startswith("# Pizzas by drone: a trial")
    assert "95 % interval" in text
    assert list(found["pairs"]) == [
        "nearest, los-beam", "nearest, trained beams", "trained flight, los-beam", "both trained"
    ]  # fmt: skip
    for name, pair in found["pairs"].items():
        assert pair["delivered"] == [2, 2]
        assert all(0 < seconds < 120 for seconds in pair["seconds"])
        # The beam along the straight line is the link's own baseline in every frame.
        assert (pair["straight_beam"] == [1.0, 1.0]) == name.endswith("los-beam")
    nearest, beams = (found["pairs"][name] for name in ("nearest, los-beam", "nearest, trained beams"))
    assert nearest["seconds"] == beams["seconds"]  # the same flights


@pytest.mark.slow
@pytest.mark.exhaustive
def test_the_trial_has_a_figure_and_a_film(trial: tuple[Path, str]) -> None:
    from PIL import Image

    folder, _ = trial
    assert (folder / "pizza-quick.png").read_bytes()[1:4] == b"PNG"
    with Image.open(folder / "pizza-quick.gif") as film:
        assert film.n_frames > 20  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--episodes", "1"], "--episodes"),
        (["--addresses", "9"], "--addresses"),
        (["--out", "x.png"], "--out"),
    ],
)
def test_mistakes_are_said_before_the_work(arguments: list[str], text: str) -> None:
    done = CliRunner().invoke(app, ["paper", "pizza", *arguments])
    assert done.exit_code != 0
    assert text in done.output + str(done.exception)
