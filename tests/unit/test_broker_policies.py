"""Files of policies in a run's directory, and which of them a run begins with."""

from __future__ import annotations

import hashlib
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from caviar_broker import policies
from caviar_broker.control.socket import RequestRefusedError
from caviar_broker.policies import given_policies, offer_policy
from caviar_protocol.assets import AssetStore
from caviar_protocol.errors import RunError, ScenarioError
from caviar_protocol.policies import MAX_POLICY, PolicyFolder
from caviar_protocol.scenario import Scenario, find_scenario, load_scenario

FIRST, SECOND = b"one policy", b"another policy"


def digest_of(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def serving(folder: Path, more: str = "") -> Scenario:
    """A scenario that serves a file."""
    (folder / "beams.onnx").write_bytes(FIRST)
    text = find_scenario("geometric").read_text()
    served = 'use = "policy"\nsettings.file = "file:beams.onnx"\n'
    path = folder / "scenario.toml"
    path.write_text(text.replace('use = "los-beam"', served + more, 1))
    return load_scenario(path)


def test_files_keep_their_order_and_the_same_is_kept_once(tmp_path: Path) -> None:
    folder = PolicyFolder(tmp_path)
    assert (folder.digests("agent"), folder.files("agent")) == ((), {})
    for content in (FIRST, SECOND, SECOND, FIRST):
        assert folder.add("agent", content) == digest_of(content)
    one, two = digest_of(FIRST), digest_of(SECOND)
    assert folder.digests("agent") == (one, two, one)
    assert folder.files("agent")[two].read_bytes() == SECOND
    assert folder.digests("other") == ()


def test_the_order_is_that_of_numbers(tmp_path: Path) -> None:
    folder = PolicyFolder(tmp_path)
    (tmp_path / "policies" / "agent").mkdir(parents=True)
    (tmp_path / "policies" / "agent" / f"9999-{digest_of(FIRST)}.onnx").write_bytes(FIRST)
    folder.add("agent", SECOND)
    assert folder.digests("agent") == (digest_of(FIRST), digest_of(SECOND))


def test_only_the_last_file_is_taken_back(tmp_path: Path) -> None:
    folder = PolicyFolder(tmp_path)
    for content in (FIRST, SECOND):
        folder.add("agent", content)
    folder.remove("agent", digest_of(FIRST))
    assert len(folder.digests("agent")) == 2
    folder.remove("agent", digest_of(SECOND))
    assert folder.digests("agent") == (digest_of(FIRST),)


def test_a_file_that_is_too_large_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=f"a policy may have {MAX_POLICY} B"):
        PolicyFolder(tmp_path).add("agent", bytes(MAX_POLICY + 1))
    assert not list(tmp_path.iterdir())


def test_a_run_keeps_and_hands_out_the_file_of_the_scenario(tmp_path: Path) -> None:
    store, run = AssetStore(tmp_path / "cache"), tmp_path / "run"
    assert given_policies(serving(tmp_path), store, run) == {"agent": (digest_of(FIRST),)}
    assert store.path(digest_of(FIRST)).read_bytes() == FIRST
    assert PolicyFolder(run).digests("agent") == (digest_of(FIRST),)


def test_a_run_that_goes_on_has_what_it_was_given_and_not_the_file_of_today(tmp_path: Path) -> None:
    scenario, run = serving(tmp_path), tmp_path / "run"
    for content in (FIRST, SECOND):
        PolicyFolder(run).add("agent", content)
    (tmp_path / "beams.onnx").write_bytes(b"trained since")
    store = AssetStore(tmp_path / "cache")
    assert given_policies(scenario, store, run) == {"agent": (digest_of(FIRST), digest_of(SECOND))}
    assert store.path(digest_of(SECOND)).read_bytes() == SECOND
    assert len(PolicyFolder(run).digests("agent")) == 2, "brokers that follow one another add none"


def test_a_kept_file_that_was_changed_is_named(tmp_path: Path) -> None:
    scenario, run = serving(tmp_path), tmp_path / "run"
    PolicyFolder(run).add("agent", FIRST)
    file = PolicyFolder(run).files("agent")[digest_of(FIRST)]
    file.write_bytes(FIRST[:-1])
    with pytest.raises(RunError, match=r"0000-.*\.onnx") as refused:
        given_policies(scenario, AssetStore(tmp_path / "cache"), run)
    assert str(file) in str(refused.value)


class Broker:
    """Answers what `offer_policy` asks; the order of what it announces is kept."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, refuses: str = "") -> None:
        self.announced: list[str] = []
        self._refuses = refuses
        monkeypatch.setattr(policies, "ask", self.ask)

    def ask(self, directory: Path, do: str, **given: str) -> dict[str, Any]:
        if do == "policies":
            return {"policies": {"agent": {}}, "store": str(directory / "store")}
        if self._refuses:
            raise RequestRefusedError(directory, self._refuses)
        # Others come in between here, if they can.
        for _ in range(200):
            os.sched_yield()
        assert AssetStore(directory / "store").path(given["sha256"]).is_file(), "it need not be hashed there"
        self.announced.append(given["sha256"])
        return {}


def test_policies_given_at_once_are_kept_in_the_order_of_their_announcement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    PolicyFolder(tmp_path).add("agent", FIRST)
    broker = Broker(monkeypatch)
    with ThreadPoolExecutor(8) as several:
        offered = [several.submit(offer_policy, tmp_path, "", bytes([n])) for n in range(8)]
        assert {one.result()[1] for one in offered} == {digest_of(bytes([n])) for n in range(8)}
    assert PolicyFolder(tmp_path).digests("agent") == (digest_of(FIRST), *broker.announced)


def test_an_order_that_is_refused_keeps_what_was_there_and_nothing_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    PolicyFolder(tmp_path).add("agent", FIRST)
    Broker(monkeypatch, refuses="the run is over")
    for content in (FIRST, SECOND):
        with pytest.raises(RequestRefusedError, match="the run is over"):
            offer_policy(tmp_path, "agent", content)
        assert PolicyFolder(tmp_path).digests("agent") == (digest_of(FIRST),)


def test_a_file_that_is_not_the_pinned_one_is_refused_with_both(tmp_path: Path) -> None:
    pinned = digest_of(SECOND)
    with pytest.raises(ScenarioError) as refused:
        given_policies(serving(tmp_path, f'settings.sha256 = "{pinned}"'), AssetStore(tmp_path / "c"), None)
    assert pinned in str(refused.value)
    assert digest_of(FIRST) in str(refused.value)
    assert refused.value.key == "services.agent.settings.sha256"


def test_a_file_that_only_the_agents_machine_has_is_not_handed_out(tmp_path: Path) -> None:
    scenario = serving(tmp_path)
    (tmp_path / "beams.onnx").unlink()
    assert given_policies(scenario, AssetStore(tmp_path / "cache"), None) == {}
