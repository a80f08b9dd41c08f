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
from caviar_services.agent.base import AgentSettings
from caviar_services.channel.statistical.free_space import FreeSpaceChannel
from caviar_services.registry import BUILT_IN, load, registered


@pytest.fixture(autouse=True)
def fresh_registry() -> Iterator[None]:
    registered.cache_clear()
    yield
    registered.cache_clear()


def register(monkeypatch: pytest.MonkeyPatch, *points: tuple[str, str]) -> None:
    found = {name: EntryPoint(name, value, registry.ENTRY_POINT_GROUP) for name, value in points}
    monkeypatch.setattr(registry, "plugins", {registry.ENTRY_POINT_GROUP: found}.get)


def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str) -> None:
    (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)


def test_a_built_in_implementation_is_found_by_role_and_name() -> None:
    assert load("channel", "free-space") is FreeSpaceChannel


def test_an_unknown_role_is_answered_with_the_roles() -> None:
    with pytest.raises(DeclarationError, match=r"'wurld'.*agent, channel"):
        load("wurld", "sumo")


def test_an_implementation_is_found_by_its_place() -> None:
    assert (
        load("channel", "caviar_services.channel.statistical.free_space:FreeSpaceChannel") is FreeSpaceChannel
    )


def test_other_distributions_add_theirs(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch, ("channel:mine", BUILT_IN["channel:free-space"]))
    assert load("channel", "mine") is FreeSpaceChannel


def test_two_of_one_name_are_refused_naming_both(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch, ("channel:free-space", "other:Channel"))
    with pytest.raises(DeclarationError, match=r"FreeSpaceChannel.*other:Channel"):
        registered()


def test_an_unknown_name_comes_with_the_nearest_and_all_known() -> None:
    with pytest.raises(DeclarationError, match=r"'free-space'.*sionna-rt"):
        load("channel", "freespace")


UNFINISHED = """
import msgspec
from caviar_services.channel.base import ChannelSettings, PathModel

class NoRung(PathModel):
    def paths(self, scene, transmitters, receivers): ...

class Plain(msgspec.Struct, frozen=True): ...

class PlainSettings(NoRung):
    Settings, rung = Plain, "plain"

class Right(NoRung):
    rung = "right"

class NoCheckpoint(Right):
    checkpoints = True

class NoRestore(NoCheckpoint):
    def checkpoint(self): ...

class Whole(NoRestore):
    def restore(self, state): ...

class Undeclared(Right):
    def checkpoint(self): ...
    def restore(self, state): ...

class SwitchedOff(Undeclared):
    checkpoints = False
"""


BROKEN = {
    "no rung": ("unfinished:NoRung", "which does not set: rung"),
    "no checkpoint": (
        "unfinished:NoCheckpoint",
        "sets checkpoints = True and does not define checkpoint and restore; define checkpoint() and",
    ),
    "no restore": ("unfinished:NoRestore", "sets checkpoints = True and does not define restore; define"),
    "checkpoints that are not declared": (
        "unfinished:Undeclared",
        "defines checkpoint() or restore() and does not say whether they are used; write checkpoints = True",
    ),
    "settings of another kind": (
        "unfinished:PlainSettings",
        "whose Settings is Plain: it has to be a subclass of ChannelSettings, that of ChannelModel",
    ),
    "no module": ("nowhere_at_all:Channel", "No module named 'nowhere_at_all'"),
    "no class": ("caviar_services.channel.statistical.free_space:Chanel", "has no attribute 'Chanel'"),
    "nearly the class": ("unfinished:Righ", "unfinished.py has no attribute 'Righ'; did you mean 'Right'?"),
    "no class of the role": ("json:Channel", "has no attribute 'Channel'; it has no class of role 'channel'"),
    "a file": ("unfinished.py:Right", "a module is named without .py: unfinished:Right"),
    "a dot": ("unfinished.Right", "a class of your own is named unfinished:Right"),
    "a module": ("unfinished", "a class of your own is named unfinished:CLASS"),
    "no place": (":Channel", "cannot be loaded from :Channel"),
    "no service": ("pathlib:Path", "which is not a Service"),
    "another role": ("caviar_services.agent.baselines:RandomAgent", "whose role is 'agent'"),
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
    module(tmp_path, monkeypatch, "unfinished", UNFINISHED)
    assert load("channel", "unfinished:Right").__name__ == "Right"
    assert load("channel", "unfinished:Whole").checkpoints
    assert not load("channel", "unfinished:SwitchedOff").checkpoints
    with pytest.raises(DeclarationError) as caught:
        load("channel", place)
    assert words in str(caught.value)


def test_importing_the_registry_imports_no_implementation() -> None:
    code = "import sys, caviar_services.registry; print([m for m in sys.modules if 'free_space' in m])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=True
    )
    assert done.stdout.strip() == "[]"


def test_an_agent_of_no_settings_of_its_own_has_those_of_its_base(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "from caviar_services.agent.base import Agent\n\n\nclass Mine(Agent):\n"
    module(tmp_path, monkeypatch, "mine_whole", text + "    def choose(self, *given): return []\n")
    assert load("agent", "mine_whole:Mine").Settings is AgentSettings
    module(tmp_path, monkeypatch, "mine_empty", text + "    pass\n")
    with pytest.raises(DeclarationError, match=r"mine_empty:Mine.*choose$"):
        load("agent", "mine_empty:Mine")


def test_a_module_is_found_in_a_folder_that_was_added_and_hides_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "only_here.py").write_text(
        (Path(registry.__file__).parent / "agent/baselines.py").read_text()
    )
    with pytest.raises(DeclarationError, match="'only_here'"):
        load("agent", "only_here:RandomAgent")
    registry.find_modules_in(tmp_path)
    registry.find_modules_in(tmp_path)
    assert load("agent", "only_here:RandomAgent").role == "agent"
    assert sys.path.count(str(tmp_path)) == 1
    assert sys.path[-1] == str(tmp_path)
