"""What all tests share: real data, hypothesis settings, and a search for processes left behind."""

from __future__ import annotations

import gc
import os
import re
import subprocess
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import psutil
import pytest

pytest.register_assert_rewrite("caviar_services.testing.base", "caviar_services.testing.roles")

REPOSITORY = Path(__file__).resolve().parent.parent
MARKER = "CAVIAR_TEST_SESSION"
"""Environment variable by which a process that a test started is known, also after its parent died."""

hypothesis.settings.register_profile("ci", derandomize=True, deadline=None, database=None, max_examples=40)
hypothesis.settings.register_profile("all", hypothesis.settings.get_profile("ci"), max_examples=100)
hypothesis.settings.register_profile("explore", deadline=None, max_examples=5000)
hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real inputs beside the checkout; skips where there is none."""
    folder = REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real inputs are not here: {folder}")
    return folder


@pytest.fixture
def small_disk(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Path]:
    """A file system of 256 KiB, or of a test's size, which root may mount; skips where that is refused."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = [
        "mount",
        "-t",
        "tmpfs",
        "-o",
        f"size={getattr(request, 'param', '256k')}",
        "tmpfs",
        str(folder),
    ]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        pytest.skip(f"mount is not here: {error}")
    if done.returncode:
        pytest.skip(f"mounting is not allowed here: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture(scope="session", autouse=True)
def _logs_of_stable_baselines3(tmp_path_factory: pytest.TempPathFactory) -> None:
    """A model without a logger makes a folder, which would stay in the temporary folder of the machine."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.getbasetemp() / "stable-baselines3")


@pytest.fixture(autouse=True)
def _keeps_its_place() -> Iterator[None]:
    """No test leaves this process in the real-time class, where it would starve those that run beside it."""
    before = os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)
    yield
    after = os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)
    if after != before:
        os.sched_setscheduler(0, before[0], os.sched_param(0))
        os.setpriority(os.PRIO_PROCESS, 0, before[1])
    assert after == before, f"scheduling class and niceness were {before} and are {after}"


class LeftoverProcesses:
    """Fails a test session whose tests leave processes behind, and names test and process."""

    def __init__(self) -> None:
        self.session = uuid.uuid4().hex
        self.owner: dict[int, str] = {}
        self.others: set[int] = set()
        self.told: list[str] = []
        os.environ[MARKER] = self.session

    def alive(self) -> list[psutil.Process]:
        """Processes that tests of this session started and that still run."""
        found = []
        for process in psutil.process_iter():
            try:
                if (
                    process.pid != os.getpid()
                    and process.environ().get(MARKER) == self.session
                    and process.status() != psutil.STATUS_ZOMBIE
                    and process.name() != "nursery"  # tests/unit/forked.py: it ends with this process
                    and not any("resource_tracker" in word for word in process.cmdline())
                ):
                    found.append(process)
            except psutil.Error:
                continue  # it ended meanwhile, or is another user's
        return found

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        try:
            return (yield)
        finally:
            # What an earlier test saw is not looked at again: reading every environment takes 3 ms.
            if new := set(psutil.pids()) - self.others:
                self.others |= new
                for process in self.alive():
                    self.owner.setdefault(process.pid, item.nodeid)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: object, error: object) -> None:
        """One of several test processes is through."""
        self.told += getattr(node, "workeroutput", {}).get(MARKER, [])

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        config = session.config
        is_one_of_several = hasattr(config, "workeroutput")
        starts_others = not is_one_of_several and config.getoption("dist", "no") != "no"
        left = [] if starts_others else psutil.wait_procs(self.alive(), timeout=2.0)[1]
        for process in left:
            first_seen = self.owner.get(process.pid, "an unknown test")
            self.told.append(
                f"process {process.pid} is left over, first seen after {first_seen}: {_command(process)}"
            )
            process.kill()
        if not self.told:
            return
        if is_one_of_several:
            config.workeroutput[MARKER] = self.told
            return
        reporter = config.pluginmanager.get_plugin("terminalreporter")
        reporter.ensure_newline()
        for line in self.told:
            reporter.write_line(line, red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


class FrozenHeap:
    """Keep loaded modules out of garbage collection: each scene that is loaded collects a million objects."""

    def __init__(self) -> None:
        self.modules = 0

    def pytest_runtest_teardown(self) -> None:
        self.freeze()

    def freeze(self) -> None:
        """Do so where modules were loaded since the last time."""
        if len(sys.modules) > self.modules + 50:
            self.modules = len(sys.modules)
            gc.collect()
            gc.freeze()


def _command(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return process.name()


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--all``: what ``make test-all`` runs beyond ``make test``."""
    parser.addoption("--all", action="store_true", help="run the tests marked `exhaustive`, too")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Skip what is marked `exhaustive` unless ``--all`` is given; the summary lists it."""
    if not config.getoption("--all"):
        left_out = pytest.mark.skip(reason="exhaustive: make test-all runs it")
        for item in items:
            if item.get_closest_marker("exhaustive"):
                item.add_marker(left_out)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files that are marked `slow` as a whole, whose imports take longer than all other tests."""
    if config.option.markexpr != "not slow" or collection_path.suffix != ".py":
        return None
    marked = r"^pytestmark = (\[[^\]]*)?\bpytest\.mark\.slow\b"
    return bool(re.search(marked, collection_path.read_text(), re.M)) or None


def pytest_configure(config: pytest.Config) -> None:
    """Watch for processes that outlive their test, and keep garbage collection short."""
    if config.getoption("--all") and "HYPOTHESIS_PROFILE" not in os.environ:
        hypothesis.settings.load_profile("all")
    config.pluginmanager.register(FrozenHeap(), "frozen-heap")
    config.pluginmanager.register(LeftoverProcesses(), "leftover-processes")
