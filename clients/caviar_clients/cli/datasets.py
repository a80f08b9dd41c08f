"""``caviar dataset``: datasets of episodes are generated, looked at, verified, and tabulated."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from caviar_clients.cli.shared import (
    FiguresFile,
    Record,
    Set,
    complete_scenario,
    counted,
    keys_set,
    print_line,
    progress_bar,
    require_installed,
    require_known,
)
from caviar_clients.datasets.texts import bytes_text, duration_text
from caviar_clients.files import printable
from caviar_protocol.errors import RunError, one_line

if TYPE_CHECKING:
    from rich.progress import Progress

    from caviar_clients.datasets.episode import EpisodeResult
    from caviar_clients.datasets.estimate import Estimate

app = typer.Typer()
DatasetLocation = Annotated[
    str, typer.Argument(help="folder or address of a dataset", metavar="DATASET", show_default=False)
]
SHOWN_FAILURES = 10
SHOWN_FINDINGS = 40


@app.command("generate")
def generate_command(
    scenario: Annotated[
        Path,
        typer.Argument(
            help="preset (s001, s005, s006, s008, s011, s012), or scenario, by name or file",
            metavar="SCENARIO|PRESET",
            show_default=False,
            autocompletion=complete_scenario,
        ),
    ],
    out: Annotated[
        str,
        typer.Option(
            help="folder of the dataset, or address as s3://bucket/name; one that is begun is continued",
            metavar="FOLDER|ADDRESS",
        ),
    ],
    episodes: Annotated[
        int | None, typer.Option(min=1, help="episodes of the dataset, instead of the scenario's")
    ] = None,
    scenes: Annotated[
        int | None, typer.Option(min=1, help="scenes of an episode, instead of the scenario's frames")
    ] = None,
    scene: Annotated[
        Path | None,
        typer.Option(
            help="what a preset is applied to, instead of the district: scenario, by name or file, or "
            "folder of an imported scene"
        ),
    ] = None,
    more: Annotated[
        list[str] | None,
        typer.Option("--with", help="camera: pictures of three cameras, 960 × 540, beside the transmitter"),
    ] = None,
    traffic: Annotated[
        str, typer.Option(help="shared: all episodes are of one traffic, as the scenario says; independent")
    ] = "shared",
    seed: Annotated[
        int | None, typer.Option(min=0, max=2**63 - 1, help="seed, instead of the scenario's")
    ] = None,
    set_: Set = None,
    record: Record = None,
    workers: Annotated[int, typer.Option(min=0, help="processes that play; 0: one for each core")] = 0,
    scheduler: Annotated[
        str, typer.Option(help="address of a Dask scheduler, tcp://HOST:8786, instead of own processes")
    ] = "",
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="first delete the dataset that is there with all its episodes"),
    ] = False,
) -> None:
    """Generate a dataset: episodes, each a recording, and a catalogue of them; goes on where it stopped."""
    from caviar_clients.cli.scenarios import extras_of
    from caviar_clients.datasets.generate import generate
    from caviar_clients.datasets.plan import (
        PRESETS,
        apply_preset,
        find_preset,
        further_transmitters,
        plan_dataset,
        with_cameras,
        with_own_traffic,
    )
    from caviar_clients.datasets.reader import Dataset
    from caviar_clients.datasets.shares import count_users, paper_counts
    from caviar_protocol.scenario import load_scenario

    require_known("--traffic", traffic, ("shared", "independent"))
    settings = keys_set(set_, record)
    left_out: list[str] = []
    preset = None if scenario.is_file() else find_preset(str(scenario))
    if preset is not None:
        if scene is not None and scene.is_dir():
            scene /= f"{preset.receivers}.toml"
        base = load_scenario(scene or preset.scenario, settings)
        loaded, left_out = apply_preset(preset, base), further_transmitters(base)
    elif scene is not None:
        raise RunError(f"--scene goes with a preset, {scenario} is none; presets: {', '.join(PRESETS)}")
    else:
        loaded = load_scenario(scenario, settings)
    for extra in dict.fromkeys(more or ()):
        require_known("--with", extra, ("camera",))
        loaded = with_cameras(loaded)
    if traffic == "independent":
        loaded = with_own_traffic(loaded)
    plan = plan_dataset(loaded, episodes=episodes or loaded.run.episodes, scenes=scenes, seed=seed)
    require_installed(f"caviar dataset generate {scenario}", ("datasets", *extras_of(plan.scenario)))
    if overwrite:
        _remove(out)
    console = Console()
    shape = f"{counted(plan.episodes, 'episode')} of {counted(plan.scenes, 'scene')}"
    print_line(console, f"{loaded.run.name}: {shape} into {out}")
    if left_out:
        print_line(console, f"{loaded.run.name} has one transmitter; left out: {', '.join(left_out)}")
    with _Screen(console) as screen:
        try:
            outcome = generate(plan, out, screen, workers=workers, scheduler=scheduler)
        except KeyboardInterrupt:
            print_line(console, "stopped; the same command goes on with what is left")
            raise
    rate = outcome.scenes / outcome.wall_s if outcome.wall_s else 0.0
    if outcome.before:
        print_line(console, f"{counted(outcome.before, 'episode')} were there")
    print_line(
        console,
        f"{counted(outcome.episodes, 'episode')}, {counted(outcome.scenes, 'scene')}, "
        f"{bytes_text(outcome.bytes)} in {duration_text(outcome.wall_s)}: {rate:.2f} scenes/s",
    )
    if outcome.episodes or outcome.before:
        print_line(console, str(count_users(Dataset(out))))
        if words := paper_counts(loaded.run.name):
            print_line(console, words)
    if outcome.failed:
        for number, error in list(outcome.failed.items())[:SHOWN_FAILURES]:
            print_line(console, f"episode {number} failed: {printable(one_line(error))}", "red")
        raise RunError(
            f"{counted(len(outcome.failed), 'episode')} of {plan.episodes} failed, all are listed in "
            f"table failures of {out.rstrip('/')}/catalogue.sqlite; the same command tries them again"
        )


@app.command("tables")
def tables_command(
    dataset: DatasetLocation,
    form: Annotated[
        str, typer.Option("--format", help="csv, or parquet, which DuckDB and pandas read")
    ] = "parquet",
    out: Annotated[
        str | None,
        typer.Option(
            help="folder of the files; by default tables in that of the dataset; of an address in the cache"
        ),
    ] = None,
) -> None:
    """Write the catalogue of a dataset as files: episodes, scenes, users, products, timings, failures."""
    from caviar_clients.datasets.catalogue import Catalogue
    from caviar_clients.datasets.formats import check_out, export_tables
    from caviar_clients.datasets.reader import check_level
    from caviar_clients.datasets.remote import located

    require_known("--format", form, ("csv", "parquet"))
    if form == "parquet":
        require_installed("caviar dataset tables --format parquet", ["datasets"])
    if out is not None:
        check_out(out)
    check_level(dataset)
    directory, _ = located(dataset)
    catalogue, console = Catalogue(directory.catalogue), Console()
    for file in export_tables(catalogue, out or directory.tables, form):  # type: ignore[arg-type]
        print_line(console, file)


@app.command("look")
def look_command(
    dataset: DatasetLocation,
    out: Annotated[
        Path | None, typer.Option(help="the page; by default look.html in the folder of the dataset")
    ] = None,
) -> None:
    """Write a page of a dataset: what it is, maps, histograms, samples, and how it was generated."""
    require_installed("caviar dataset look", ["plot"])
    from caviar_clients.datasets.look.page import write_page
    from caviar_clients.datasets.reader import check_level

    check_level(dataset)
    console = Console()
    bar = progress_bar(console, transient=True)
    tasks: dict[str, Any] = {}

    def progress(what: str, done: int, of: int) -> None:
        if what not in tasks:
            tasks[what] = bar.add_task(what, total=of)
        bar.update(tasks[what], completed=done)

    def note(text: str) -> None:
        print_line(bar.console, printable(text), "yellow")

    with bar:
        file = write_page(dataset, out, progress, note)
    print_line(console, file)


@app.command("verify")
def verify_command(
    dataset: DatasetLocation,
    json: FiguresFile = None,
) -> None:
    """Verify a dataset: its files, its catalogue, and the physics of each scene; status 1 if one is wrong."""
    from rich.progress import MofNCompleteColumn, TimeRemainingColumn
    from rich.table import Column, Table

    from caviar_clients.cli.shared import require_writable, write_json
    from caviar_clients.datasets.reader import check_level
    from caviar_clients.datasets.verification import as_rows
    from caviar_clients.datasets.verification.verify import verify

    check_level(dataset)
    require_writable(json)  # before minutes of reading
    console = Console()
    with progress_bar(console, MofNCompleteColumn(), TimeRemainingColumn(), transient=True) as bar:
        task = bar.add_task("episodes", total=None)
        notes = list[str]()
        findings = list(
            verify(dataset, lambda done, total: bar.update(task, completed=done, total=total), notes.append)
        )
    write_json(json, as_rows(findings))
    for one_note in notes:
        print_line(console, f"note: {one_note}")
    if not findings:
        print_line(console, f"{dataset}: nothing is wrong")
        return
    table = Table(
        Column("episode", justify="right"),
        Column("scene", justify="right"),
        *(Column(name, overflow="fold") for name in ("user", "what", "expected", "found")),
        box=None,
        pad_edge=False,
    )
    for one in findings[:SHOWN_FINDINGS]:
        scene = "" if one.scene is None else str(one.scene)
        episode = "" if one.episode < 0 else str(one.episode)  # of the dataset as a whole
        cells = (episode, scene, one.user, one.what, one.expected, one.found)
        table.add_row(*(Text(printable(cell)) for cell in cells))
    console.print(table)
    more = f", the first {SHOWN_FINDINGS} are above" if len(findings) > SHOWN_FINDINGS else ""
    hint = "" if json else "; --json FILE writes all"
    raise RunError(f"{dataset}: {counted(len(findings), 'finding')}{more}{hint if more else ''}")


def _remove(out: str) -> None:
    """Remove a dataset; what else is in the folder stays."""
    from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
    from caviar_clients.datasets.remote import RemoteDataset, is_address

    directory = DatasetDirectory(Path(out))
    if is_address(out):
        remote = RemoteDataset(out)
        remote.remove()
        directory = remote.written()
    if not directory.catalogue.exists() and not directory.finished():
        return
    with writing_dataset(directory):
        for folder in (directory.episodes, directory.assets, directory.tables):
            shutil.rmtree(folder, ignore_errors=True)
        for file in (*directory.path.glob(f"{directory.catalogue.name}*"), directory.page):
            file.unlink(missing_ok=True)


@dataclass
class Pace:
    """Rate of episodes, and the time that is left.

    Example:
        >>> pace = Pace(episodes=6, began=100.0)
        >>> pace.ended(scenes=10)
        >>> pace.texts(110.0)  # of one episode nothing follows
        ('', '')
        >>> pace.ended(scenes=10)
        >>> pace.texts(120.0)
        ('1.00 scenes/s', '0:00:40 left')
    """

    episodes: int
    """That are left."""
    began: float
    """When the first of them began, of any clock [s]."""
    done: int = 0
    scenes: int = 0

    def ended(self, scenes: int) -> None:
        """Count an episode, with its scenes."""
        self.episodes, self.done, self.scenes = self.episodes - 1, self.done + 1, self.scenes + scenes

    def texts(self, now: float) -> tuple[str, str]:
        """Rate and time left; empty where fewer than two episodes have ended."""
        if self.done < 2 or now <= self.began:
            return "", ""
        left_s = round((now - self.began) / self.done * self.episodes)
        left = f"{timedelta(seconds=left_s)} left" if self.episodes else ""
        return f"{self.scenes / (now - self.began):.2f} scenes/s", left


class _Screen:
    """Shows how a generation goes on: as a bar, or as lines where no bar can be drawn."""

    def __init__(self, console: Console) -> None:
        from rich.progress import MofNCompleteColumn

        self._console = console
        self._bar: Progress = progress_bar(
            console, MofNCompleteColumn(), "{task.fields[rate]}", "{task.fields[left]}", transient=True
        )
        self._traffic: Any = None
        self._task: Any = None
        self._trials: Any = None
        self._done, self._pace = 0, Pace(0, 0.0)

    def __enter__(self) -> _Screen:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def note(self, text: str) -> None:
        """See `generate.Observer`."""
        print_line(self._bar.console, text, "yellow")

    def traffic(self, now_s: float, end_s: float) -> None:
        """See `generate.Observer`."""
        if self._traffic is None:
            print_line(
                self._bar.console,
                f"one pass through {duration_text(end_s)} of traffic, kept for all episodes",
            )
            self._traffic = self._bar.add_task("traffic", total=end_s, rate="s", left="")
            self._pace = Pace(0, time.monotonic())
        left_s = (time.monotonic() - self._pace.began) * (end_s / max(now_s, 1.0) - 1.0)
        left = f"{timedelta(seconds=round(left_s))} left"
        self._bar.update(self._traffic, completed=round(now_s), left=left)
        if now_s >= end_s:
            self._bar.remove_task(self._traffic)
            self._traffic = None

    def tried(self, done: int, of: int, phase: str) -> None:
        """See `generate.Observer`."""
        if self._trials is None:
            self._trials = self._bar.add_task("workers ready", total=of, rate="", left="")
        self._bar.update(self._trials, completed=done, left=phase)

    def estimated(self, found: Estimate, free: int | None, episodes: int, workers: int) -> None:
        """See `generate.Observer`."""
        space = bytes_text(found.bytes) + ("" if free is None else f" of {bytes_text(free)} that are free")
        print_line(
            self._bar.console,
            f"estimate: {duration_text(found.wall_s)} with {counted(workers, 'worker')}, {space}",
        )
        if self._trials is not None:
            self._bar.remove_task(self._trials)
        self._pace = Pace(episodes, time.monotonic())
        self._task = self._bar.add_task("episodes", total=episodes, rate="", left="")

    def returned(self) -> None:
        """See `generate.Observer`."""
        if self._task is not None:
            self._pace = Pace(self._pace.episodes, time.monotonic())
            self._bar.update(self._task, rate="", left="")

    def ended(self, result: EpisodeResult) -> None:
        """See `generate.Observer`."""
        self._done += 1
        self._pace.ended(len(result.rows.scenes) if result.rows else 0)
        rate, left = self._pace.texts(time.monotonic())
        self._bar.update(self._task, completed=self._done, rate=rate, left=left)
