"""A setting in a process of its own: what is said of one that fails, dies or takes too long."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from link_builders import CARRIER, antenna, scene_of

from caviar_clients.session.scenes import Instant, Scenes
from caviar_labs.tradeoff.ladder import Setting
from caviar_labs.tradeoff.worker import Worker
from caviar_protocol.errors import RunError

pytestmark = pytest.mark.slow

SCENES = Scenes(
    name="one",
    origin="made by hand",
    instants=(
        Instant(0, 0, scene_of(antenna("bs", "tx"), antenna("ue", "rx", position=(30.0, 4.0, 1.0)))),
        Instant(7, 700, scene_of(antenna("bs", "tx"), antenna("ue", "rx", position=(60.0, 4.0, 1.0)))),
    ),
    carriers=(CARRIER,),
    devices=(),
    assets={},
    services={},
    seed=1,
    sampling_period_ns=100,
)


@contextmanager
def working() -> Iterator[Worker]:
    worker = Worker(Setting(label="f", use="free-space"), SCENES, None, 60.0)
    try:
        yield worker
    finally:
        worker.close()


def test_scenes_are_answered_by_their_index() -> None:
    with working() as worker:
        near, far = worker.step(0, 30.0), worker.step(1, 30.0)
    assert [next(iter(sample.users))[0] for sample in (near, far)] == [0, 7]
    gains = [next(iter(sample.users.values())).path_gain_db for sample in (near, far)]
    assert gains[0] - gains[1] == pytest.approx(6, abs=0.2)
    assert worker.loaded.first.time_ms > 0


def test_the_reason_why_it_cannot_be_loaded_is_told() -> None:
    with pytest.raises(RunError, match="no channel is named 'free-spaec'"):
        Worker(Setting(label="f", use="free-spaec"), SCENES, None, 60.0)


def test_a_process_that_dies_is_told_by_its_signal() -> None:
    with working() as worker:
        os.kill(worker.pid, signal.SIGKILL)
        with pytest.raises(RunError, match="SIGKILL"):
            worker.step(0, 30.0)


def test_what_takes_too_long_is_ended() -> None:
    with working() as worker:
        os.kill(worker.pid, signal.SIGSTOP)
        with pytest.raises(RunError, match=r"no answer within 0 s.*--minutes"):
            worker.step(0, 0.2)
        with pytest.raises(ProcessLookupError):
            os.kill(worker.pid, 0)
