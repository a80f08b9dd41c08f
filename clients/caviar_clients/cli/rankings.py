"""Tables of supervised experiments: what the seeds led to, and policies on a dataset beside baselines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from caviar_clients.cli.shared import counted, print_line, progress_bar, require_writable, write_json
from caviar_clients.datasets.directory import DatasetDirectory
from caviar_clients.datasets.remote import is_address
from caviar_protocol.errors import ScenarioError

if TYPE_CHECKING:
    from caviar_clients.learning.classification import Classification
    from caviar_clients.learning.dataset_evaluation import DatasetEvaluation
    from caviar_clients.learning.training import SeedResult

SHOWN = {"top_1": "top-1 %", "top_5": "top-5 %", "top_10": "top-10 %", "throughput_10": "ratio of 10"}
"""Figures of a table, with their columns: 80 characters hold no more; --json has all."""


def training_table(experiment: Classification, folder: Path, results: Sequence[SeedResult]) -> Table:
    """Table of the seeds of a supervised experiment.

    Args:
        experiment: Which.
        folder: Of it.
        results: Of its seeds.
    """
    from caviar_clients.learning.training import CURVES, POLICY, seed_folder

    table = Table(title=f"{experiment.experiment.name}: {experiment.model.name} in {folder}; % of validation")
    for name in ("seed", "epochs", "time", "top-1 %", "top-10 %"):
        table.add_column(name, justify="right")
    table.add_column("files", overflow="fold")
    for result in results:
        mine = seed_folder(folder, result.seed).relative_to(folder)
        figures = (f"{100 * result.figures[name]:.1f}" for name in ("top_1", "top_10"))
        row = (str(result.seed), f"{result.steps:,}", f"{result.seconds:.0f} s", *figures)
        table.add_row(*row, f"{mine}/: {POLICY}, {CURVES}/")
    return table


def is_dataset(location: str) -> bool:
    """Check whether a place is a dataset, or its address, and no scenario.

    Args:
        location: Folder, address, or name or file of a scenario.
    """
    return is_address(location) or DatasetDirectory(Path(location)).catalogue.is_file()


def policy_files(given: Sequence[Path]) -> list[Path]:
    """Files of policies, of folders all below them.

    Args:
        given: Files and folders.

    Raises:
        ScenarioError: A folder has none.
    """
    found: list[Path] = []
    for path in given:
        below = sorted(path.glob("**/policy.onnx")) if path.is_dir() else [path]
        if not below:
            raise ScenarioError(f"{path} has no policy.onnx; give the folder of a training, or an ONNX file")
        found += below
    return list(dict.fromkeys(found))


def evaluate_rankings(
    console: Console,
    policies: Sequence[Path],
    on: str,
    trained_on: Path | None,
    users: str,
    outage_db: float,
    json: Path | None,
) -> None:
    """Evaluate policies on a dataset, and show the tables.

    Args:
        console: Where.
        policies: Files, and folders of trainings.
        on: Folder of the dataset, or its address.
        trained_on: Dataset that baselines learn from.
        users: Receivers that count, as names with ``*`` and ``?``.
        outage_db: SNR below which a user is out of service [dB].
        json: File of all figures; None: none.
    """
    from caviar_clients.learning.dataset_evaluation import evaluate_on_dataset
    from caviar_clients.learning.samples import Selection

    require_writable(json)
    with progress_bar(console, transient=True) as bar:
        task = bar.add_task("", total=1.0)
        made = evaluate_on_dataset(
            policy_files(policies), on, trained_on, Selection((users,)), outage_db,
            lambda what, share: bar.update(task, description=what, completed=share),
        )  # fmt: skip
    print_line(
        console, f"{made.dataset}, {counted(len(made.episodes), 'episode')} that no policy was trained on"
    )
    print_line(
        console,
        f"{made.users['all']:,} users with a path, {made.without_path:,} without; {made.pairs_used} of "
        f"{made.pairs} pairs are the best of one, {made.entropy_bit:.2f} bit of entropy",
    )
    for table in ranking_tables(made):
        console.print(table)
    print_line(
        console,
        "ratio of 10: the challenge's throughput ratio of the best of ten pairs; 90 %: pairs that are tried "
        f"until 90 % of users have their best; out: SNR of the first pair below {outage_db:g} dB; ± 95 % "
        "over episodes and seeds",
    )
    for note in made.notes:
        print_line(console, note)
    if json is not None:
        write_json(json, made.as_json())


def ranking_tables(made: DatasetEvaluation) -> Iterator[Table]:
    """Tables of an evaluation, one for each kind of users.

    Args:
        made: The evaluation.
    """
    for kind, count in made.users.items():
        if not count:
            continue
        table = Table(title=f"{kind}, {count:,} users", title_justify="left", padding=(0, 1, 0, 0))
        table.add_column("", overflow="fold")
        for name in (*SHOWN.values(), "90 %", "out %"):
            table.add_column(name, justify="right", no_wrap=True)
        for method in made.methods:
            cells = []
            for name in SHOWN:
                found, factor = made.figure(method, kind, name), 100 if name.startswith("top") else 1
                digits = 1 if factor == 100 else 3
                cells.append(f"{factor * found.mean:.{digits}f}±{factor * found.half_width:.{digits}f}")
            needed = made.beams_needed(method, kind)
            out = made.figure(method, kind, "outage_1").mean
            table.add_row(method, *cells, "" if needed is None else str(needed), f"{100 * out:.1f}")
        yield table
