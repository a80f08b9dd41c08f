"""``caviar paper``: the paper's experiments, each with one command: figure, tables, and what differs.

To add one: a module in `caviar_labs.paper` that returns a list of `Comparison`, and a command here that
calls `report`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

if TYPE_CHECKING:
    from rich.progress import TaskID

    from caviar_labs.paper.comparison import Comparison

app = typer.Typer(no_args_is_help=True, help="The paper's experiments: figures and tables beside its own.")

Out = Annotated[Path, typer.Option(help="folder of picture, tables and figures")]
Seed = Annotated[int, typer.Option(min=0, help="of all random numbers")]
FOLDER = Path("paper")


@app.callback()
def _paper() -> None:
    """The paper's experiments: figures and tables beside its own."""


def report(
    console: Console,
    title: str,
    found: Sequence[Comparison],
    pictures: Sequence[Path],
    name: str,
    out: Path,
    figures: Any,
) -> None:
    """Show tables, and write them beside the pictures of an experiment: NAME.md and NAME.json.

    Args:
        console: Where tables and the names of files are shown.
        title: Heading of the page of tables.
        found: The tables.
        pictures: Which are written already.
        name: Of the experiment, in the names of its files.
        out: Folder.
        figures: What goes into the JSON file.
    """
    from caviar_clients.cli.shared import print_line, write_json
    from caviar_clients.files import write_file

    for one in found:
        one.show(console)
    shown = "".join(f"\n![{file.stem}]({file.name})\n" for file in pictures)
    text = "\n".join(one.markdown() for one in found)
    write_file(out / f"{name}.md", f"# {title}\n{shown}\n{text}")
    write_json(out / f"{name}.json", figures)
    for file in (*pictures, out / f"{name}.md", out / f"{name}.json"):
        print_line(console, file)


@app.command("radiostrike")
def radio_strike(
    episodes: Annotated[
        list[str] | None,
        typer.Option(
            help="episode file of the challenge, folder of these, or run; may be repeated; by default made-up"
        ),
    ] = None,
    published: Annotated[
        Path | None,
        typer.Option(
            help="run that the challenge published, data_output_optimun_traffic.csv: it is compared with"
        ),
    ] = None,
    count: Annotated[int, typer.Option(min=1, help="episodes that each agent plays")] = 10,
    steps: Annotated[int, typer.Option(min=1, help="of an episode at most")] = 4000,
    train_steps: Annotated[
        int, typer.Option(min=0, help="of B-A2C (extra `learning`); 0: without it")
    ] = 20_000,
    seed: Seed = 1,
    out: Out = FOLDER,
) -> None:
    """Radio-Strike: the challenge's agents by its rules and by mended ones, and its published run."""
    from caviar_clients.cli.shared import progress_bar
    from caviar_clients.files import require_folder, reserved
    from caviar_clients.plots.style import styled
    from caviar_labs.paper.radio_strike import Settings, experiment
    from caviar_labs.paper.radio_strike_figure import draw
    from caviar_labs.paper.radio_strike_tables import comparisons, figures_of

    require_folder("--out", out, "picture, tables and figures")
    settings = Settings(
        episodes=episodes, count=count, steps=steps, train_steps=train_steps, published=published, seed=seed
    )
    console = Console()
    with styled():  # says before the work that Matplotlib is missing
        pass
    with reserved(out / "radiostrike.md", out / "radiostrike.json"):
        with progress_bar(console, transient=True) as bar:
            task = bar.add_task("", total=1.0)
            found = experiment(
                settings, lambda what, share: bar.update(task, description=what, completed=share)
            )
        picture = draw(found, out / "radiostrike.png")
    tables = comparisons(found, settings)
    report(console, "Radio-Strike", tables, [picture], "radiostrike", out, figures_of(found))


@app.command("fig8")
def fig8(
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="of each training: 1, 2, …")] = 5,
    channel: Annotated[
        list[str] | None,
        typer.Option(help="geometric, quasi-static or munich; may be repeated; by default all"),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="two seeds, a fifteenth of the steps: to see that it works")
    ] = False,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="trainings at a time; by default as many as there are cores")
    ] = None,
    out: Out = FOLDER,
) -> None:
    """Fig. 8, beams for a UAV: DQN as in the paper and tuned, los-beam, optimum, LOS and NLOS apart."""
    from caviar_clients.cli.learning import cores
    from caviar_clients.cli.shared import counted, print_line, require_installed, require_known
    from caviar_clients.files import require_folder, reserved
    from caviar_labs.paper.fig8 import CHANNELS, Settings, done_seeds, experiment
    from caviar_labs.paper.fig8_figure import draw
    from caviar_labs.paper.fig8_tables import comparisons, figures_of

    require_folder("--out", out, "pictures, tables and figures")
    for one in channel or ():
        require_known("--channel", one, CHANNELS)
    require_installed("the experiment", ("learning", "plot"))
    name = "fig8-quick" if quick else "fig8"
    channels = tuple(one for one in CHANNELS if not channel or one in channel)
    settings = Settings(folder=out / name, seeds=seeds, channels=channels, jobs=jobs or cores())
    settings = settings.quick() if quick else settings
    console = Console()
    with reserved(out / f"{name}.md", out / f"{name}.json"):
        try:
            with _time_left(console) as show:
                found = experiment(settings, show)
        except KeyboardInterrupt:
            done = done_seeds(settings)
            print_line(console, f"stopped with {counted(done, 'training')} done; the same command goes on")
            raise
        label = "quick form, of which little can be concluded" if quick else ""
        pictures = draw(found, out, name, label)
    title = "Fig. 8 of the paper" + (f": {label}" if label else "")
    print_line(console, title, "yellow" if quick else "bold")
    report(console, title, comparisons(found), pictures, name, out, figures_of(found))


@contextmanager
def _time_left(console: Console) -> Iterator[Callable[[str, float], None]]:
    """Show a bar with the time left.

    Args:
        console: Where.

    Yields:
        What takes a text, and the share of the work that is done.
    """
    from rich.progress import TimeRemainingColumn

    from caviar_clients.cli.shared import progress_bar

    tasks: list[TaskID] = []
    with progress_bar(console, TimeRemainingColumn(), transient=True) as bar:

        def show(what: str, share: float) -> None:
            if not tasks:
                tasks.append(bar.add_task(what, total=1.0))
                # What an earlier call has done says nothing about the time left.
                bar.reset(tasks[0], completed=share)  # type: ignore[arg-type]  # of Rich: any number
            bar.update(tasks[0], description=what, completed=share)

        yield show


_SCENES = "scenario, by name or file, or directory of a run that recorded `scene`"
Scenes = Annotated[Path, typer.Argument(help=_SCENES)]
TableFrames = Annotated[int, typer.Option(min=1, max=10_000, help="scenes, spread over the episode")]
Minutes = Annotated[float, typer.Option(min=0.1, help="time for measuring")]


@app.command("table3")
def table3(
    source: Scenes = Path("street-canyon"),
    frames: TableFrames = 12,
    minutes: Minutes = 12.0,
    out: Out = FOLDER,
) -> None:
    """Table 3: time of ray tracing by ray spacing, with diffuse scattering and without (measure tradeoff)."""
    _tradeoff("table3", "spacing", source, frames, minutes, out)


@app.command("table4")
def table4(
    source: Scenes = Path("street-canyon"),
    frames: TableFrames = 12,
    minutes: Minutes = 12.0,
    out: Out = FOLDER,
) -> None:
    """Table 4: time of ray tracing by the elements of the arrays (measure tradeoff)."""
    _tradeoff("table4", "arrays", source, frames, minutes, out)


def _tradeoff(name: str, part: str, source: Path, frames: int, minutes: float, out: Path) -> None:
    from caviar_clients.files import require_folder
    from caviar_labs.cli.measure import trade, tradeoff_options

    require_folder("--out", out, "tables and pictures")
    options = tradeoff_options(None, None, None, 2, minutes, [part])
    trade(source, frames, options, out / name / "tradeoff.json", out / name, Console())


@app.command("pizza")
def pizza(
    episodes: Annotated[int | None, typer.Option(min=2, help="held out; by default 20")] = None,
    addresses: Annotated[int | None, typer.Option(min=2, max=8, help="of an episode; by default 4")] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="two episodes, a training of seconds: to see that it works")
    ] = False,
    seed: Seed = 1,
    out: Out = FOLDER,
) -> None:
    """A drone delivers pizzas: a trained pair of agents against nearest-address order with los-beam."""
    from dataclasses import replace

    from caviar_clients.cli.shared import print_line, require_installed
    from caviar_clients.files import require_folder, reserved
    from caviar_clients.session.prepared import prepare

    require_folder("--out", out, "pictures, tables and figures")
    require_installed("the experiment", ("channel", "plot"))
    # They need SciPy, which comes with the channel.
    from caviar_labs.paper.pizza import SCENARIO, Settings, experiment
    from caviar_labs.paper.pizza_figure import draw, film
    from caviar_labs.paper.pizza_tables import comparisons, figures_of

    settings = Settings(seed=seed)
    settings = settings.trial() if quick else settings
    settings = replace(
        settings, episodes=episodes or settings.episodes, addresses=addresses or settings.addresses
    )
    scenario = prepare(Path(SCENARIO)).scenario
    name = "pizza-quick" if quick else "pizza"
    console = Console()
    with reserved(out / f"{name}.md", out / f"{name}.json"):
        with _time_left(console) as show:
            found = experiment(settings, show)
        pictures = [draw(found, scenario, out / f"{name}.png"), film(found, scenario, out / f"{name}.gif")]
    title = "Pizzas by drone" + (": a trial, whose figures say nothing" if quick else "")
    print_line(console, title, "yellow" if quick else "bold")
    report(console, title, comparisons(found), pictures, name, out, figures_of(found))


@app.command("beams")
def beams(
    data: Annotated[
        Path | None,
        typer.Option(
            help="dataset to learn from, with LIDAR grids; by default s008 of district is generated"
        ),
    ] = None,
    other: Annotated[
        Path | None, typer.Option(help="dataset of another city; by default generated where --data is")
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(min=10, help="of each dataset that is generated; by default 2086")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="of each training: 1, 2, …")] = 5,
    quick: Annotated[
        bool, typer.Option("--quick", help="two seeds, few epochs and data: to see that it works")
    ] = False,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="trainings at a time; by default as many as there are cores")
    ] = None,
    out: Out = FOLDER,
) -> None:
    """Beams learnt from position and LIDAR: benchmark, learning curve, and what each sensor is worth."""
    from dataclasses import replace

    from caviar_clients.cli.learning import cores
    from caviar_clients.cli.shared import print_line, require_installed
    from caviar_clients.files import require_folder, reserved

    require_folder("--out", out, "pictures, tables and figures")
    generating = () if data else ("datasets", "channel", "world")
    require_installed("the experiment", ("learning", "plot", *generating))
    from caviar_labs.paper.beams import Settings, experiment
    from caviar_labs.paper.beams_figure import draw
    from caviar_labs.paper.beams_tables import comparisons, figures_of

    name = "beams-quick" if quick else "beams"
    settings = Settings(folder=out / name, data=data, other=other, seeds=seeds, jobs=jobs or cores())
    settings = replace(settings, episodes=episodes or settings.episodes)
    settings = settings.quick() if quick else settings
    console = Console()
    with reserved(out / f"{name}.md", out / f"{name}.json"):
        try:
            with _time_left(console) as show:
                found = experiment(settings, show)
        except KeyboardInterrupt:
            print_line(console, "stopped; the same command goes on")
            raise
        label = "quick form, of which little can be concluded" if quick else ""
        picture = draw(found, out / f"{name}.png", label)
    title = "Beam selection from position and LIDAR" + (f": {label}" if label else "")
    print_line(console, title, "yellow" if quick else "bold")
    report(console, title, comparisons(found), [picture], name, out, figures_of(found))
