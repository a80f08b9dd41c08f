"""Tables of a catalogue as files: CSV, and Parquet, which DuckDB, pandas and others read."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Literal

from caviar_clients.datasets.catalogue import MEASURED_TABLES, TABLES, Catalogue, columns_of
from caviar_clients.files import writing

Format = Literal["csv", "parquet"]


def export_tables(catalogue: Catalogue, folder: Path, form: Format) -> list[Path]:
    """Write each table into a file of its own.

    Args:
        catalogue: Of the dataset.
        folder: Of the files ``users.csv``, …; it is made.
        form: Of the files.

    Returns:
        The files.

    Raises:
        RunError: One cannot be written.
        SetupError: DuckDB, which writes Parquet, is not installed.
    """
    return [_export(catalogue, name, folder, form) for name in (*TABLES, *MEASURED_TABLES)]


def _export(catalogue: Catalogue, name: str, folder: Path, form: Format) -> Path:
    file = folder / f"{name}.csv"
    columns, rows = catalogue.table(name)
    with writing(file), file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        # Numbers in their shortest form that reads back as the same double.
        writer.writerows(rows)
    return file if form == "csv" else _as_parquet(file, columns_of(name))


def _as_parquet(file: Path, types: dict[str, str]) -> Path:
    """A CSV file as Parquet, in its place."""
    import duckdb

    target = file.with_suffix(".parquet")
    with writing(target), duckdb.connect() as connection:
        kinds = {"INTEGER": "BIGINT", "REAL": "DOUBLE", "TEXT": "VARCHAR"}
        columns = {name: kinds[kind] for name, kind in types.items()}
        relation = connection.read_csv(
            str(file), header=True, columns=columns, auto_detect=False, delimiter=",", quotechar='"'
        )
        relation.write_parquet(str(target))
    file.unlink()
    return target
