"""Implementations by name: found late, and what is wrong with one is said."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from caviar_protocol.errors import DeclarationError
from caviar_services import registry
from caviar_services.channel.free_space import FreeSpaceChannel
from caviar_services.registry import BUILT_IN, load, registered


@pytest.fixture(autouse=True)
def fresh_registry() -> Iterator[None]:
    registered.cache_clear()
    yield
    registered.cache_clear()


def register(monkeypatch: pytest.MonkeyPatch, *points: tuple[str, str]) -> None:
    found = [EntryPoint(name, value, registry.ENTRY_POINT_GROUP) for name, value in points]
    monkeypatch.setattr(registry, "entry_points", lambda *, group: found)


def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str) -> None:
    (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)


def test_a_built_in_implementation_is_found_by_role_and_name() -> None:
    assert load("channel", "free-space") is FreeSpaceChannel


def test_an_unknown_role_is_answered_with_the_roles() -> None:
    with pytest.raises(DeclarationError, match="no service has the role 'wurld'; one of agent, channel, "):
        load("wurld", "sumo")


def test_an_implementation_is_found_by_its_place() -> None:
    assert load("channel", "caviar_services.channel.free_space:FreeSpaceChannel") is FreeSpaceChannel


def test_other_distributions_add_theirs(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch, ("channel:mine", BUILT_IN["channel:free-space"]))
    assert load("channel", "mine") is FreeSpaceChannel


def test_two_of_one_name_are_refused_naming_both(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch, ("channel:free-space", "other:Channel"))
    with pytest.raises(DeclarationError, match=r"registered twice.*FreeSpaceChannel.*other:Channel"):
        load("channel", "free-space")


def test_an_unknown_name_comes_with_the_nearest_and_all_known() -> None:
    with pytest.raises(DeclarationError, match=r"did you mean 'free-space'\? known: .*sionna-rt"):
        load("channel", "freespace")


BROKEN = {
    "no module": ("nowhere_at_all:Channel", "No module named 'nowhere_at_all'"),
    "no class": ("caviar_services.channel.free_space:Chanel", "has no attribute 'Chanel'"),
    "no place": (":Channel", "cannot be loaded from :Channel"),
    "no service": ("pathlib:Path", "which is not a Service"),
    "another role": ("caviar_services.agent.random:RandomAgent", "whose role is 'agent'"),
    "a base without a role": ("caviar_services.service:Service", "whose role is None"),
    "bad syntax": ("broken_syntax:Channel", "broken_syntax.py"),
    "fails on import": ("broken_import:Channel", "ZeroDivisionError: division by zero"),
}


@pytest.mark.parametrize(("place", "words"), BROKEN.values(), ids=BROKEN)
def test_what_is_wrong_with_an_implementation_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, words: str
) -> None:
    module(tmp_path, monkeypatch, "broken_syntax", "class Channel(:\n")
    module(tmp_path, monkeypatch, "broken_import", "1 / 0\n")
    with pytest.raises(DeclarationError) as caught:
        load("channel", place)
    assert words in str(caught.value)


def test_importing_the_registry_imports_no_implementation() -> None:
    code = "import sys, caviar_services.registry; print([m for m in sys.modules if 'free_space' in m])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=True
    )
    assert done.stdout.strip() == "[]"
