"""Agent `random`: uniform, and the same again from the same seed."""

from __future__ import annotations

from collections import Counter

from link_builders import antenna, frame_of, given, scene_of

from caviar_protocol.topics import Action, AntennaDevice, BeamChoice
from caviar_services.agent.base import AgentSettings
from caviar_services.agent.baselines import RandomAgent
from caviar_services.service import RunInfo

BS = antenna("bs", "tx", (1, 4))
CAR = antenna("car/rx", "rx", (2, 1), (9.0, 0.0, 0.0))


def drawn(
    number: int, seed: int = 1, devices: tuple[AntennaDevice, ...] = (BS, CAR)
) -> dict[str, tuple[int, int]]:
    agent = RandomAgent(AgentSettings(), RunInfo(name="dice"))
    frame = frame_of(given("scene", scene_of(*devices)), number=number, seed=seed, service="dice")
    product = agent.step(frame).products["action"]
    assert isinstance(product, Action)
    return {c.rx: (c.tx_beam, c.rx_beam) for c in product.commands if isinstance(c, BeamChoice)}


def test_every_pair_is_as_likely_as_any_other() -> None:
    """Chi-square of 800 draws over 8 pairs, 7 degrees of freedom: below 24.3 with p = 0.999."""
    counts = Counter(drawn(number)["car/rx"] for number in range(800))
    assert set(counts) == {(p, q) for p in range(4) for q in range(2)}
    assert sum((count - 100) ** 2 / 100 for count in counts.values()) < 24.3


def test_a_seed_repeats_its_draws_and_another_does_not() -> None:
    first, again, other = ([drawn(number, seed) for number in range(20)] for seed in (1, 1, 2))
    assert first == again
    assert first != other


def test_the_draw_of_a_user_does_not_depend_on_who_else_is_there() -> None:
    more = antenna("aaa/rx", "rx", (2, 1), (0.0, 9.0, 0.0))
    for number in range(20):
        assert drawn(number, devices=(BS, CAR, more))["car/rx"] == drawn(number)["car/rx"]
