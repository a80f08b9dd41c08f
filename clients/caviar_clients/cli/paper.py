"""``caviar paper``: the paper's experiments, each with one command: figure, tables, and what differs.

To add one: a module in `caviar_clients.paper` that returns a list of `Comparison`, and a command here that
calls `report`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

if TYPE_CHECKING:
    from caviar_clients.paper.comparison import Comparison

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
    from caviar_clients.paper.radio_strike import Settings, experiment
    from caviar_clients.paper.radio_strike_figure import draw
    from caviar_clients.paper.radio_strike_tables import comparisons, figures_of
    from caviar_clients.plots.style import styled

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
