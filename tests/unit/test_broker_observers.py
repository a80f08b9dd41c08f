"""Observers of a broker: what they see, and that the run does not feel them."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from broker_harness import (
    MS,
    PAIR,
    PATIENCE_S,
    Client,
    Serving,
    eventually,
    finishes_well,
    plan,
    play_to_the_end,
    playing,
    serving,
)
from core_harness import Simulation, agent, channel, link, recorder, sensors, world
from http_harness import Peer, site
from security_harness import Ring, ring

from caviar_broker.control.socket import ask
from caviar_broker.core import events as ev
from caviar_broker.security.access import PAGE
from caviar_broker.security.limits import PeerLimits
from caviar_protocol import keys as k
from caviar_protocol import messages as m
from caviar_protocol.errors import RunError
from caviar_protocol.observer import EVERYTHING, Observation, Observer

pytestmark = pytest.mark.slow

OBSERVER: dict[str, Any] = {"version": m.PROTOCOL_VERSION, "capabilities": ("observe",)}


def looker(endpoint: str, name: str = "eye", **hello: Any) -> Client:
    """An observer, played by hand."""
    declared = OBSERVER | {"subscriptions": EVERYTHING} | hello
    return Client(endpoint, name, "observer", **{"inputs": (), "outputs": ()} | declared)


def taken(client: Client, until: Callable[[m.Observe], bool]) -> m.Observe:
    """The first observation for which that holds, not acknowledged; those before it are."""
    while not until(seen := client.expect(m.Observe)):
        client.send(m.Observed(sequence=seen.sequence))
    return seen


def watched(endpoint: str, name: str, seen: list[Observation]) -> threading.Thread:
    """A thread that observes from now on until the run is over."""
    observer = Observer(endpoint, name)

    def body() -> None:
        with observer:
            seen.extend(observer)

    thread = threading.Thread(target=body, daemon=True)
    thread.start()
    return thread


def test_three_observers_see_a_run_whose_digest_is_that_of_a_run_without(tmp_path: Path) -> None:
    digests, seen = [], [list[Observation]() for _ in range(3)]
    for number in (0, 3):
        folder = tmp_path / str(number)
        folder.mkdir()
        with serving(plan(*PAIR, frames=20), folder) as broker:
            threads = [watched(broker.endpoint, f"eye {n}", seen[n]) for n in range(number)]
            with playing(broker.endpoint, *PAIR) as clients:
                play_to_the_end(clients, 20)
            digests.append(broker.outcome().digest)
            for thread in threads:
                thread.join(PATIENCE_S)
    assert digests[0] == digests[1]
    for observations in seen:
        frames = [o for o in observations if o.products]
        assert observations[0].message.state == "joining"
        assert [o.frame for o in frames] == sorted({o.frame for o in frames})
        for o in frames:
            assert o.message.t_ns == o.frame * 100 * MS
            assert {entry.status for entry in o.message.inputs} == {m.Status.FRESH}
            bodies = {topic: bytes(product.body) for (topic, _), product in o.products.items()}
            assert bodies == {
                topic: (f"{name} {o.frame} ".encode() * 25)[:100]
                for name, topic in (("world", "scene"), ("sensors", "lidar"))
            }


def test_an_observer_gets_the_newest_frame_once_it_has_taken_the_one_before(tmp_path: Path) -> None:
    with serving(plan(*PAIR, frames=9), tmp_path) as broker, looker(broker.endpoint) as eye:
        eye.join()
        with playing(broker.endpoint, *PAIR) as clients:
            first = taken(eye, lambda seen: seen.state == "running")
            assert (first.frame, first.inputs) == (-1, ())
            for _ in range(7):
                for client in clients:
                    client.answer()
            eventually(lambda: broker.witness.frames == 7, "7 frames are finished")
            assert eye.quiet()
            eye.send(m.Observed(sequence=first.sequence))
            assert eye.expect(m.Observe).frame == 6
            play_to_the_end(clients, 2)
        assert finishes_well(broker)
        assert eye.expect(m.Observe).frame == 8
        assert eye.expect(m.Shutdown).reason == m.RUN_COMPLETE


def test_a_subscription_is_due_every_so_many_frames_and_has_a_topic_and_a_source(tmp_path: Path) -> None:
    wanted = (
        m.Subscription(topic="lidar", source="sensors", every=3),
        m.Subscription(topic="scene", source="x"),
    )
    with (
        serving(plan(*PAIR, frames=8), tmp_path) as broker,
        looker(broker.endpoint, subscriptions=wanted) as eye,
    ):
        eye.join()
        got = []
        with playing(broker.endpoint, *PAIR) as clients:
            for number in range(8):
                for client in clients:
                    client.answer()
                seen = taken(eye, lambda seen, n=number: seen.frame == n)
                eye.send(m.Observed(sequence=seen.sequence))
                got.append([entry.topic for entry in seen.inputs])
            play_to_the_end(clients, 0)
    assert got == [["lidar"], [], [], ["lidar"], [], [], ["lidar"], []]


def test_an_observer_that_acknowledges_nothing_is_disconnected_and_named(tmp_path: Path) -> None:
    limits = PeerLimits(observer_ns=200 * MS)
    with (
        serving(plan(*PAIR), tmp_path, peer_limits=limits) as broker,
        Observer(broker.endpoint, "eye") as eye,
    ):
        assert eye.receive(PATIENCE_S) is not None
        with playing(broker.endpoint, *PAIR) as clients:
            why = "observer 'eye' was disconnected: it has not acknowledged OBSERVE 0 for 0.2 s"
            eventually(lambda: why in broker.witness.texts(), "it is named")
            with looker(broker.endpoint) as again:  # nobody is barred
                again.join()
                play_to_the_end(clients, 3)
        assert finishes_well(broker)
        with pytest.raises(RunError, match="has ended the connection, or is gone"):
            eye.receive(PATIENCE_S)


def test_fifty_observers_that_do_not_read_cost_one_message_each(tmp_path: Path) -> None:
    """Scans of 1 MB for 30 frames would else be 1.5 GB."""
    with serving(plan(*PAIR, frames=31), tmp_path) as broker, ExitStack() as stack:
        eyes = [stack.enter_context(looker(broker.endpoint, f"eye {n}")) for n in range(50)]
        for eye in eyes:
            eye.join()
        with playing(broker.endpoint, *PAIR) as clients:
            for number in range(31):
                for client in clients:
                    client.answer(size=1 << 20)
                if not number:
                    for eye in eyes:
                        taken(eye, lambda seen: seen.frame == 0)
            play_to_the_end(clients, 0)
        assert finishes_well(broker)
        for eye in eyes:
            assert eye.expect(m.Observe).frame == 30  # the last one goes to all, and nothing in between
            eye.expect(m.Shutdown)


def test_an_observer_comes_late_leaves_and_comes_back_under_its_name(tmp_path: Path) -> None:
    with serving(plan(*PAIR, frames=4), tmp_path) as broker, playing(broker.endpoint, *PAIR) as clients:
        for number in range(3):
            for client in clients:
                client.answer()
            eventually(lambda n=number: broker.witness.frames > n, "the frame is finished")
            with Observer(broker.endpoint, "eye") as observer:
                seen = observer.receive(PATIENCE_S)
                assert seen is not None
                assert seen.frame == number
                if number == 1:
                    observer.ended = "killed"  # so that no BYE is sent
        with looker(broker.endpoint, "last") as eye:
            eye.join()
            play_to_the_end(clients, 1)
            assert taken(eye, lambda seen: seen.frame == 3).episode == 0
        assert finishes_well(broker)


def test_a_pause_is_told_and_the_run_in_a_pause_is_seen(tmp_path: Path) -> None:
    with (
        serving(plan(*PAIR, frames=2), tmp_path, desk=tmp_path) as broker,
        playing(broker.endpoint, *PAIR) as clients,
        Observer(broker.endpoint) as observer,
    ):
        for client in clients:
            client.answer()
        ask(tmp_path, do="pause")
        while not (seen := observer.receive(PATIENCE_S)).message.paused:  # type: ignore[union-attr]
            pass
        with Observer(broker.endpoint, "other") as other:
            late = other.receive(PATIENCE_S)
            assert late is not None
            assert late.message.paused
            assert late.frame == seen.frame == 0  # type: ignore[union-attr]
        ask(tmp_path, do="resume")
        while (observer.receive(PATIENCE_S)).message.paused:  # type: ignore[union-attr]
            pass
        play_to_the_end(clients, 1)
        assert list(observer)[-1].frame == 1
        assert observer.ended == m.RUN_COMPLETE


@pytest.mark.parametrize("policy", ["hold", "drop", "wait"])
def test_what_is_observed_of_a_frame_is_what_a_recorder_of_it_is_granted(policy: m.Policy) -> None:
    slow = sensors(policy=policy, latency=lambda _, frame: 250 * MS if frame in (0, 3) else MS)
    services = [world(), channel(), agent(ends=frozenset({(0, 6)})), link(), slow, recorder()]
    run, seen = Simulation(services, frames=9, episodes=2).join(), {}
    while run.step():
        if (newest := run.clock.newest_frame()) is not None:
            seen[newest.episode, newest.frame] = newest
    finished = [action for _, action in run.log if isinstance(action, ev.FrameFinished)]
    assert list(seen) == [(action.episode, action.frame) for action in finished]
    for (episode, frame), newest in seen.items():
        entries = {(d.provenance.topic, d.provenance.source): d.provenance for d in newest.decisions}
        assert entries == run.inputs("recorder", frame, episode)
        assert newest.t_ns == run.plan.t_ns(frame)


ALL = {"epoch": 1, "attempt": 1, "episode": 0, "frame": 0}


@pytest.mark.parametrize(
    "wrong",
    [
        m.Done(**ALL),
        m.Fault(**ALL, phase="step", message="no"),
        m.Ready(epoch=1, attempt=1),
        m.AssetGet(digest="00" * 32),
        m.Observed(sequence=7),
        m.Observe(sequence=0, state="running"),
        m.Hello(name="eye", role="observer", **OBSERVER),
    ],
    ids=lambda message: type(message).__name__,
)
def test_an_observer_that_sends_what_a_service_does_is_told_so(tmp_path: Path, wrong: m.Message) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, looker(broker.endpoint) as eye:
        eye.join()
        eye.expect(m.Observe)
        eye.send(wrong)
        assert eye.expect(m.Error).code == "unexpected"
        with playing(broker.endpoint, *PAIR) as clients:
            play_to_the_end(clients, 3)
        assert finishes_well(broker)


@pytest.mark.parametrize(
    ("hello", "code"),
    [
        ({"name": "world"}, "name-taken"),
        ({"name": "first"}, "name-taken"),
        ({"capabilities": ()}, "declaration"),
        ({"outputs": ("scene",)}, "declaration"),
        ({"version": (2, 0)}, "version"),
    ],
)
def test_an_observer_is_refused_for(tmp_path: Path, hello: dict[str, Any], code: str) -> None:
    with serving(plan(*PAIR), tmp_path) as broker, looker(broker.endpoint, "first") as first:
        first.join()
        with looker(broker.endpoint, **{"name": "second"} | hello) as second:
            second.send(second.hello)
            assert second.expect(m.Refuse).code == code
        with playing(broker.endpoint, *PAIR) as clients:
            play_to_the_end(clients, 3)
        assert finishes_well(broker)


# --- keys and tokens ----------------------------------------------------------------------------------------


def answered(broker: Serving, name: str, role: str, credentials: k.Credentials) -> m.Message:
    client = Client(broker.endpoint, name, role, inputs=(), outputs=(), credentials=credentials, **OBSERVER)
    with client:
        client.send(client.hello)
        return client.receive()


@pytest.fixture
def keys(tmp_path: Path) -> Ring:
    return ring(tmp_path / "keys")


def test_a_key_of_a_service_cannot_observe_nor_that_of_an_observer_serve(tmp_path: Path, keys: Ring) -> None:
    world, eye = keys.authorize("world", "world"), keys.authorize("eye", "observer")
    access = keys.access()
    with serving(plan(*PAIR), tmp_path, access=access) as broker:
        for name, role, own in (
            ("world", "observer", world),
            ("eye", "observer", world),
            ("eye", "world", eye),
        ):
            refusal = answered(broker, name, role, own)
            assert isinstance(refusal, m.Refuse)
            assert refusal.code == "unauthorized"
        page = keys.of(access.gateway)
        for name, own in (("eye", eye), (PAGE, page)):
            assert isinstance(answered(broker, name, "observer", own), m.Welcome)
        for name, role in (("eye", "observer"), (PAGE, "world")):
            assert isinstance(answered(broker, name, role, page), m.Refuse)
        with Observer(broker.endpoint, "eye", credentials=eye) as observer:
            keys.revoke("eye")
            with pytest.raises(RunError, match="ended the connection"):
                list(observer)


def test_over_a_websocket_a_token_of_an_observer_observes_and_reads(tmp_path: Path) -> None:
    digest = hashlib.sha256(b"secret").hexdigest()
    tokens = f'[[token]]\nname = "eye"\nrole = "observer"\nsha256 = "{digest}"\n'
    with site(tmp_path, tokens=tokens, frames=1) as http:
        assert http.get("/status", "secret").status == 200
        assert http.post("/pause", "secret").status == 403
        with Peer(http.url, "eye", "world", "secret") as peer:
            peer.send(peer.hello)
            assert peer.expect(m.Refuse).code == "unauthorized"
        with Peer(http.url, "eye", "observer", "secret", **OBSERVER, subscriptions=EVERYTHING) as peer:
            peer.join()
            with playing(http.broker.endpoint, *PAIR) as clients:
                play_to_the_end(clients, 1)
                while (seen := peer.expect(m.Observe)).frame < 0:
                    peer.send(m.Observed(sequence=seen.sequence))
            assert [entry.topic for entry in seen.inputs] == ["scene", "lidar"]
            assert peer.parts[1].startswith(b"world 0")
