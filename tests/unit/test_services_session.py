"""What a service sees of a GRANT."""

from __future__ import annotations

from caviar_protocol.messages import Grant, Reset
from caviar_protocol.topics import Carrier
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.service import RunInfo
from caviar_services.session import frame_of

SERVICE = FreeSpaceChannel(
    FreeSpaceSettings(), RunInfo(name="channel", carriers=(Carrier(name="c", frequency_hz=1e9),))
)
IDS = {"epoch": 1, "attempt": 1, "episode": 2}


def test_a_frame_has_the_budget_and_the_decisions_imposed_of_its_grant() -> None:
    reset = Reset(**IDS, seed=5, t0_ns=0, seed_episode=1)
    grant = Grant(**IDS, frame=3, t_ns=300, budget_ns=20_000_000, decisions={"rung": "low"})
    frame = frame_of(SERVICE, reset, grant, ())
    assert (frame.budget_ns, frame.imposed) == (20_000_000, {"rung": "low"})
    assert (frame.episode, frame.number, frame.seed, frame.seed_episode) == (2, 3, 5, 1)


def test_by_default_there_is_no_limit_and_nothing_imposed() -> None:
    frame = frame_of(SERVICE, Reset(**IDS, seed=5, t0_ns=0), Grant(**IDS, frame=0, t_ns=0), ())
    assert (frame.budget_ns, frame.imposed) == (0, {})
