"""``caviar view``: a recording, a run as it goes on, or a scenario in 3D, served to a browser or saved."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import sys
import webbrowser
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING

import msgspec
from rich.console import Console

from caviar_clients.cli.shared import print_line, progress_bar, require_writable
from caviar_clients.files import writing
from caviar_protocol.errors import CaviarError, RecordingError, SetupError
from caviar_protocol.files import read_regular
from caviar_protocol.run_directory import RunDirectory, runs_below

if TYPE_CHECKING:
    from caviar_view.frames import Frames


def view(
    source: Path,
    beside: Path | None,
    http: str,
    keys: Path | None,
    save: Path | None,
    limit_mb: float,
    episode: int | None,
    opens: bool,
) -> None:
    """Show a run, an episode of a dataset, or a scenario.

    Args:
        source: Run directory, segment, dataset, or scenario.
        beside: A second run to show with it; None: none.
        http: ``HOST:PORT`` to serve at.
        keys: Keys directory with tokens; None: this machine alone.
        save: HTML file to write in place of serving.
        limit_mb: Size of that file at most [MB].
        episode: Of a dataset; None: its first.
        opens: Whether a browser is opened, where there is one.

    Raises:
        CaviarError: What is to be shown cannot be read; the text says why.
    """
    from caviar_view.answers import Answers

    console = Console()
    if save is not None:
        from caviar_view.save import saved_page

        require_writable(save)

        answers = Answers(_frames(source, episode))
        with progress_bar(Console(stderr=True), transient=True) as bar:
            task = bar.add_task("frames", total=None)
            content, every = saved_page(
                answers, int(limit_mb * 1e6), lambda done, of: bar.update(task, completed=done, total=of)
            )
        with writing(save):
            save.write_bytes(content)
        thin = "" if every == 1 else f", every {every} frames one"
        print_line(console, f"{save}: {len(content) / 1e6:.1f} MB{thin}; it opens without a server")
        return

    def announce(url: str) -> None:
        print_line(console, f"{url} shows {source}{'' if url == served else '; Ctrl-C ends it'}")
        if opens:
            open_browser(url)

    served = live_page(source)
    if _is_running(source):
        if served:
            announce(served)
            return
        from caviar_broker.http.process import serve

        with contextlib.suppress(KeyboardInterrupt):
            asyncio.run(serve(source, http, keys, lambda url: announce(f"{url}/view/")))
        return
    from caviar_broker.http.view import serve_views, standing

    views = {"": standing(Answers(_frames(source, episode), beside=beside is not None))}
    if beside is not None:
        views["beside/"] = standing(Answers(_frames(beside, episode)))

    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(serve_views(views, http, keys, announce))


def view_in_foxglove(run: Path, port: int) -> None:
    """Serve a run to Foxglove until it ends.

    Args:
        run: Directory of the run, which goes on.
        port: To serve at; 0: any.

    Raises:
        CaviarError: No broker runs there, or the SDK of Foxglove is missing.
    """
    # By name: formats are made of what clients have, and none of these imports them.
    serve = resolve_name("caviar_formats.live:serve_foxglove")
    with contextlib.suppress(KeyboardInterrupt):
        serve(run, port, lambda url: print_line(Console(), f"{url} shows {run} to Foxglove; Ctrl-C ends it"))


def take_picture(source: Path, file: Path, link: str, size: str, episode: int | None) -> None:
    """Write a picture of the page, with shadows and smooth edges unless the link has ``quality=plain``.

    Args:
        source: As of `view`, and no run that goes on.
        file: PNG.
        link: To the page, or its part from ``#`` on.
        size: ``WIDTHxHEIGHT`` [pixels].
        episode: As of `view`.

    Raises:
        CaviarError: There is no such picture; the text says why.
    """
    from caviar_clients.cli.page import fragment, opened_page
    from caviar_view.answers import Answers

    found = re.fullmatch(r"(\d{3,4})x(\d{3,4})", size)
    if found is None:
        raise SetupError(f"--size is {size!r}; write WIDTHxHEIGHT in pixels, each from 100 to 9999")
    answers = Answers(_frames(source, episode))
    shown = f"#quality=fine&{fragment(link)}"
    with opened_page(answers, shown, (int(found[1]), int(found[2]))) as draw, writing(file):
        file.write_bytes(draw(None))


def live_page(run: Path) -> str:
    """URL of the page of a run whose broker serves HTTP; empty where none does, or not yet."""
    try:
        note = json.loads(read_regular(RunDirectory(run).control_note))
    except (OSError, ValueError):
        return ""
    return f"{note['http']}/view/" if "http" in note else ""


def _is_running(run: Path) -> bool:
    from caviar_broker.control.socket import connect

    try:
        connect(run).close()
    except CaviarError:
        return False
    return True


def open_browser(url: str) -> None:
    """Open a page where this machine has a screen, and a browser for it."""
    has_screen = sys.platform != "linux" or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    if has_screen:
        webbrowser.open(url)


def _frames(source: Path, episode: int | None) -> Frames:
    from caviar_protocol.recording import Recording
    from caviar_view.frames import FirstScene, RecordedFrames

    if (source / "catalogue.sqlite").is_file():
        from caviar_clients.datasets.reader import Dataset

        dataset = Dataset(source)
        finished = dataset.finished()
        if not finished:
            raise RecordingError(f"{source} has no finished episode to show")
        recording = dataset.episode(finished[0] if episode is None else episode)
        folder = dataset.assets
        assets = {asset.name: folder / asset.name for asset in recording.metadata.assets}
        return RecordedFrames(recording, {name: file for name, file in assets.items() if file.is_file()})
    if episode is not None:
        raise SetupError(f"--episode is one of a dataset, and {source} is none")
    if source.is_dir() or source.suffix == ".mcap":
        try:
            return RecordedFrames(Recording(source))
        except RecordingError as error:
            raise RecordingError(f"{error}{runs_below(source)}") from None
    from caviar_clients.session.prepared import prepare
    from caviar_clients.session.scenes import scene_at

    prepared = prepare(source)
    scenes = scene_at(source, 0, prepared)
    scenario = msgspec.to_builtins(prepared.scenario)
    return FirstScene(scenario, scenes.instants[0].scene, scenes.assets, scenes.seed)
