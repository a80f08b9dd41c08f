"""``caviar run``: a scenario from beginning to end, in one process or many, with progress and a summary."""

from __future__ import annotations

import json
import shutil
import time
import warnings
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn
from rich.text import Text

from caviar_clients.cli.launch import Interruption, Launcher
from caviar_clients.cli.remote import key_text, reachable, start_command, waiting_text
from caviar_clients.cli.scenarios import require_extras
from caviar_clients.cli.shared import new_run_directory, print_line, progress_bar, require_writable
from caviar_clients.cli.view import live_page, open_browser
from caviar_clients.files import printable, write_file
from caviar_clients.session.prepared import PreparedScenario, implemented, prepare
from caviar_protocol.errors import RecordingError, RunError, SetupError
from caviar_protocol.host import loading
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import Scenario, find_scenario
from caviar_protocol.scenario.rules import refuse_remote

# What a run needs in one process, or after its end, is imported there: what stands above is imported before
# the broker starts.
if TYPE_CHECKING:
    from caviar_broker.core import events as ev

REPORT_S = 0.1
"""[s] between ``frame`` events at least."""
QUIET = frozenset({"stale", "note", "lag"})
"""Kinds of notices that are logged, and only counted on the screen."""
REPEATED = frozenset({"warning", "lost", "away", "back", "restarted", "refused", "disk"})
"""Kinds of notices that are shown every time, since what they ask of the user is always new."""


class EmbeddedLauncher:
    """A run in this process, with the interface of `caviar_clients.cli.launch.Launcher`.

    Args:
        scenario: As `prepare` returns it.
        directory: The run's directory.
    """

    def __init__(self, scenario: PreparedScenario, directory: Path) -> None:
        from caviar_clients.session.embedded import EmbeddedRun

        self._directory = directory
        # The run calls back in the middle of a step; events are passed on between steps.
        self._pending: deque[dict[str, Any]] = deque()
        self._reported_at = 0.0
        self._log_error = ""
        self._deleted = False
        self._stopping = ""
        self._run = EmbeddedRun(scenario, directory, self._notice, self._frame, self._waiting)

    def __enter__(self) -> EmbeddedLauncher:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is left to end: a caller that leaves the loop over `events` ends the run."""

    def events(self) -> Iterator[Mapping[str, Any]]:
        """Run, and yield what happens, in the words of the broker's events; the last one is ``finished``."""
        with closing(self._run.steps()) as steps:
            for _ in steps:
                if self._deleted:
                    self.stop("its directory was deleted")
                while self._pending:
                    event = self._pending.popleft()
                    if event["event"] == "notice":
                        self._log(event)
                    yield event
        outcome, statistics = self._run.outcome, self._run.statistics
        if outcome is None:
            raise RunError("the run ended without an outcome")
        statistics.save(RunDirectory(self._directory).latencies)
        if self._log_error:
            text = f"the log of notices is incomplete: {self._log_error}"
            yield {"event": "notice", "kind": "note", "service": "", "frame": -1, "text": text}
        yield {
            "event": "finished",
            "error": outcome.error,
            "culprit": outcome.culprit,
            "digest": outcome.digest,
            **statistics.figures(),
        }

    def stop(self, reason: str) -> None:
        """Ask for an orderly end."""
        self._stopping = reason
        self._run.stop(reason)

    def log_of(self, service: str) -> Path | None:
        """Services have no logs of their own in one process."""
        return None

    def _log(self, event: Mapping[str, Any]) -> None:
        # A disk that is full costs the log, not the run: the error is a notice at the end.
        try:
            with RunDirectory(self._directory).events.open("a", encoding="utf-8") as log:
                log.write(json.dumps(event, ensure_ascii=False) + "\n")
        except OSError as error:
            self._log_error = self._log_error or str(error)

    def _waiting(self, text: str) -> None:
        """Tell, from the watchdog's thread, which service the run waits for, and what ends it."""
        event = {"event": "notice", "kind": "waiting", "service": "", "episode": 0, "frame": -1, "text": text}
        self._log(event)
        if self._stopping:
            line = f"{self._stopping}: {text}; the run ends once it returns, or at once by another Ctrl-C"
        else:
            line = f"{text}; Ctrl-C ends the run once it returns, a second Ctrl-C at once"
        # Not on the console of the run: `caviar.run` shows nothing there, and this is to be seen.
        print_line(Console(stderr=True), printable(line), "yellow")

    def _notice(self, notice: ev.Notice) -> None:
        fields = ("kind", "service", "episode", "frame", "text")
        self._pending.append({"event": "notice", **{field: getattr(notice, field) for field in fields}})

    def _frame(self, frame: ev.FrameFinished) -> None:
        now = time.monotonic()
        if now - self._reported_at >= REPORT_S:
            self._reported_at = now
            self._deleted = not self._directory.exists()
            done = {"frames": self._run.statistics.frames, "misses": self._run.statistics.misses}
            self._pending.append({"event": "frame", "episode": frame.episode, **done})


def with_recording_checked(
    directory: Path, scenario: Scenario, outcome: Mapping[str, Any]
) -> Mapping[str, Any]:
    """Compare the digest of a run with that of its recording, of which no product is read.

    Args:
        directory: The run's directory.
        scenario: Of the run.
        outcome: The event ``finished``.

    Returns:
        ``outcome``, with an error where the run came to its end and its recording is not of that run.
    """
    from caviar_protocol.recording import Recording
    from caviar_protocol.recording.integrity import declared_digest

    recorders = [spec for spec in scenario.services.values() if spec.role == "recorder" and not spec.remote]
    # A recording of some topics has another digest than the run.
    if any(spec.settings.get("only_named") for spec in recorders):
        return outcome
    if outcome["error"] or not outcome["frames"] or not recorders:
        return outcome
    try:
        with warnings.catch_warnings(action="ignore"):  # what is missing shows in the digest
            recording = Recording(directory)
        digest = declared_digest(recording.entry(index) for index in range(len(recording)))
    except RecordingError as error:
        return {**outcome, "error": f"the run came to its end, and its recording cannot be read: {error}"}
    if digest == outcome["digest"]:
        return outcome
    differs = f"the run came to its end, and its recording in {directory} is not that of the run"
    figures = (
        f"{len(recording)} frames, digest {digest}; the run has {outcome['frames']}, {outcome['digest']}"
    )
    return {**outcome, "error": f"{differs}: {figures}"}


class RunOutcome(NamedTuple):
    """End of a run."""

    directory: Path
    status: int
    """Exit status: 0 exactly if the run came to its end, 130 after Ctrl-C."""
    error: str


def run_scenario(
    path: Path,
    out: Path,
    console: Console,
    frames: int | None = None,
    seed: int | None = None,
    json_file: Path | None = None,
    bind: str = "",
    embedded: bool = False,
    keys: Path | None = None,
    http: str = "",
    pace: str | None = None,
    attachments: Sequence[str] = (),
    settings: Sequence[str] = (),
    view: bool = False,
) -> RunOutcome:
    """Run a scenario to its end, with progress and summary on the screen.

    Args:
        path: A scenario's file, or the name of one that ships.
        out: Folder in which the run's own directory is made.
        console: Where progress and summary are shown.
        frames, seed, pace: What replaces the scenario's; None: nothing.
        json_file: Where the summary is written beside the run's own; None: nowhere.
        bind: Address of the broker; empty for a socket of this user alone, or a free port.
        embedded: Whether all services run in this process.
        keys: Keys directory; None: a run without keys.
        http: ``HOST:PORT`` at which HTTP is served; empty: nowhere.
        attachments: ``NAME=VALUE`` each, what is attached to the scenario.
        settings: ``KEY=VALUE`` each, in place of what the scenario's file says.
        view: Whether a browser is opened with the viewer's page, where there is one.

    Raises:
        ScenarioError: A key or value of the scenario is wrong.
        SetupError: An extra is missing, or options do not go together.
        RunError: A file cannot be written, or the broker cannot start.
    """
    http = http or "127.0.0.1:0" * view
    with loading():  # the classes of services
        prepared = prepare(path, frames, seed, pace, attachments, settings)
    scenario = prepared.scenario
    if bind:
        from caviar_broker.security.access import check_bind

        check_bind(bind, keys=keys is not None)
    require_extras(prepared)
    if embedded:
        refuse_remote(scenario)
    if http and embedded:
        raise SetupError(
            "an embedded run has no broker process that HTTP could ask; leave out --http and --view"
        )
    if embedded and (bind or keys is not None):
        raise SetupError("an embedded run has no sockets: leave out --bind and --keys, or --embedded")
    if http:
        from caviar_broker.http.auth import http_address

        http_address(http, keys)
    require_writable(json_file)
    directory = new_run_directory(out, scenario.run.name)
    print_line(console, f"run {directory}")
    for warning in prepared.warnings:
        print_line(console, f"warning: {warning}", "yellow")
    # The child processes get the scenario as it was found: they read the file themselves.
    launcher: Launcher | EmbeddedLauncher
    if embedded:
        launcher = EmbeddedLauncher(prepared, directory)
    else:
        launcher = Launcher(
            prepared,
            find_scenario(path).resolve(),
            directory,
            frames,
            seed,
            bind,
            keys,
            http,
            pace=pace,
            attachments=attachments,
            settings=settings,
        )
    return _follow(
        launcher, scenario, directory, console, json_file, keys, prepared.warnings, new=True, view=view
    )


def resume_run(
    directory: Path,
    console: Console,
    json_file: Path | None = None,
    bind: str = "",
    keys: Path | None = None,
    http: str = "",
    *,
    force: bool = False,
) -> RunOutcome:
    """Resume a run whose broker died, from where its journal ends.

    Args:
        directory: The run's directory.
        force: Whether to go on though code, libraries or files have changed since.
        console, json_file, bind, keys, http: As of `run_scenario`; an empty ``bind`` is that of before.

    Raises:
        RecordingError: The directory has no record of a run, or one that cannot be read.
        RunError: A file cannot be written, or the broker cannot start.
    """
    from caviar_broker.run_record import read_record

    prepared = implemented(read_record(directory).scenario)
    require_writable(json_file)
    print_line(console, f"run {directory}")
    launcher = Launcher(
        prepared,
        directory,
        directory.resolve(),
        bind=bind,
        keys=keys,
        http=http,
        resume=True,
        force=force,
    )
    return _follow(launcher, prepared.scenario, directory, console, json_file, keys)


def _follow(
    launcher: Launcher | EmbeddedLauncher,
    scenario: Scenario,
    directory: Path,
    console: Console,
    json_file: Path | None,
    keys: Path | None,
    warnings: Sequence[str] = (),
    *,
    new: bool = False,
    view: bool = False,
) -> RunOutcome:
    """Show a run to its end, and sum it up.

    Args:
        launcher: Runs it.
        scenario, directory, console, json_file, keys: As of `run_scenario`.
        warnings: Of the scenario.
        new: Whether the directory is removed where the user stops the run before its first frame.
        view: Whether a browser is opened with the viewer's page.
    """
    from caviar_clients.cli.summary import recorded_figures, summary_of

    outcome: Mapping[str, Any] = {}
    interrupted = Interruption(launcher.stop, in_process=isinstance(launcher, EmbeddedLauncher))
    try:
        columns = ("{task.fields[rate]}", TimeRemainingColumn(), "{task.fields[misses]}")
        with launcher, interrupted, progress_bar(console, MofNCompleteColumn(), *columns) as bar:
            watcher = _Watcher(bar, console, scenario, keys)
            for event in launcher.events():
                watcher.show(event)
                if view and (page := live_page(directory)):
                    view = False
                    print_line(console, f"{page} shows the run")
                    open_browser(page)
                if event["event"] == "finished":
                    outcome = event
    except KeyboardInterrupt:
        text = "ended at once, without a summary; what was recorded until then is in"
        print_line(console, f"{text} {directory}", "red")
        raise
    except RunError:
        if new and isinstance(launcher, Launcher) and launcher.refused:
            _remove_without_frames(directory, console)
        raise
    if outcome.get("disk"):  # the disk does not answer: whatever is read or written there would wait, too
        words = f"{outcome['error']}; there is no summary, since {outcome['disk']}"
        console.print(Text.assemble(("the run ended early:", "red"), f" {words}"), soft_wrap=True)
        return RunOutcome(directory, 130 if interrupted.came else 1, outcome["error"])
    if not directory.exists():
        raise RunError(f"{directory} was deleted while the run went on, which ended it")
    # Before anything is read of the recording for the summary: figures of another run would mislead.
    outcome = with_recording_checked(directory, scenario, outcome)
    recorded = recorded_figures(directory) if outcome["frames"] else None
    noted = [*warnings, *watcher.warnings, *watcher.idle.values()]
    summary = summary_of(outcome, recorded, scenario.run.name, directory, scenario.run.seed, noted)
    if outcome["frames"]:
        _show(console, summary)
    if outcome["error"]:
        ended = Text.assemble(("the run ended early:", "red"), f" {printable(outcome['error'])}")
        console.print(ended, soft_wrap=True)
        log = launcher.log_of(outcome["culprit"])
        if log is not None:
            print_line(console, f"its log: {log}")
    _write_summary(summary, directory, json_file)  # last: a disk that is full leaves the screen
    if new and interrupted.came and not outcome["frames"]:
        _remove_without_frames(directory, console)
    elif interrupted.came and not isinstance(launcher, EmbeddedLauncher):
        print_line(console, f"caviar run --resume {directory} goes on with it")
    status = 130 if interrupted.came else 1 if outcome["error"] else 0
    return RunOutcome(directory, status, outcome["error"])


def _remove_without_frames(directory: Path, console: Console) -> None:
    shutil.rmtree(directory, ignore_errors=True)
    print_line(console, f"no frame was simulated; {directory} is removed")


def _write_summary(summary: Mapping[str, Any], directory: Path, json_file: Path | None) -> None:
    text = json.dumps(summary, indent=2, ensure_ascii=False) + "\n"
    if json_file is not None:
        write_file(json_file, text)
    write_file(RunDirectory(directory).summary, text)
    if summary["frames"]:
        table = StringIO()
        _show(Console(file=table, width=100, force_terminal=False, force_jupyter=False), summary)
        write_file(RunDirectory(directory).summary_table, table.getvalue())


class _Watcher:
    """Shows the events of a run on the screen, and keeps what the summary says of them."""

    def __init__(self, bar: Progress, console: Console, scenario: Scenario, keys: Path | None) -> None:
        self._bar, self._console = bar, console
        total = scenario.run.frames * scenario.run.episodes
        self._task = bar.add_task("starting", total=total, rate="", misses="")
        self._first: tuple[float, int] | None = None
        self._shown: dict[tuple[str, str], int] = {}
        self._scenario, self._endpoint, self._keys = scenario, "", keys
        # For the summary: services that are not run, with the reason, and warnings of services.
        self.idle: dict[str, str] = {}
        self.warnings: list[str] = []

    def show(self, event: Mapping[str, Any]) -> None:
        """Show one event."""
        match event["event"]:
            case "listening":
                self._listening(event["endpoint"])
            case "frame":
                self._frame(event["frames"], event["misses"])
            case "notice" if event["kind"] not in QUIET:
                self._notice(event)
            case "finished":
                self._finished(event)

    def _listening(self, endpoint: str) -> None:
        self._endpoint = reachable(endpoint)
        for name, spec in self._scenario.services.items():
            if spec.remote:
                connect_s = self._scenario.timeouts.connect_s
                text = waiting_text(name, spec, endpoint, connect_s) + key_text(name, self._keys)
                print_line(self._console, printable(text), "bold")

    def _frame(self, frames: int, misses: int) -> None:
        now = time.monotonic()
        # From the first report on: a rate since the start would count what services load.
        self._first = self._first or (now, frames)
        elapsed, done = now - self._first[0], frames - self._first[1]
        rate = f"{done / elapsed:.1f} frames/s" if elapsed > 0.5 else ""
        self._bar.update(
            self._task, completed=frames, description="running", rate=rate, misses=f"{misses} misses"
        )

    def _finished(self, event: Mapping[str, Any]) -> None:
        # The last `frame` event need not have had the final figures: there are ten a second at most.
        misses = sum(service["misses"] for service in event["services"].values())
        self._bar.update(self._task, completed=event["frames"], misses=f"{misses} misses")
        if not event["error"]:
            self._bar.update(self._task, description="done")

    def _notice(self, event: Mapping[str, Any]) -> None:
        # The first of each kind and service; events.jsonl has all.
        key = (event["kind"], event["service"])
        if event["kind"] == "idle":
            self.idle[event["service"]] = f"{event['service']}: {event['text']}"
        if event["kind"] == "warning":
            self.warnings.append(f"{event['service']}: {event['text']}")
        self._shown[key] = self._shown.get(key, 0) + 1
        if self._shown[key] == 1 or event["kind"] in REPEATED:
            frame = f" in frame {event['frame']}" if event["frame"] >= 0 else ""
            who = f"{event['service']}{frame}: " if event["service"] or frame else ""
            text = f"{event['kind']}: {who}{event['text']}"
            print_line(self._console, printable(text + self._remedy(event)), "yellow")

    def _remedy(self, event: Mapping[str, Any]) -> str:
        """The command that brings a remote service back; empty for other events."""
        spec = self._scenario.services.get(event["service"])
        if event["kind"] != "away" or spec is None or not spec.remote:
            return ""
        command = start_command(event["service"], spec, self._endpoint)
        return f"; unless it comes back by itself, start it again as before (or, the example,  {command})"


def _show(console: Console, summary: Mapping[str, Any]) -> None:
    from caviar_clients.cli.summary_table import summary_table

    console.print(summary_table(summary))
    print_line(console, f"digest {summary['digest']}")
