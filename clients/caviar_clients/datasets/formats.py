"""Tables of the catalogue as files: ``caviar dataset tables`` writes CSV, or Parquet, which DuckDB,
pandas and others read."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from caviar_clients.datasets.catalogue import MEASURED_TABLES, TABLES, Catalogue, columns_of
from caviar_clients.datasets.remote import is_address
from caviar_clients.files import writing
from caviar_protocol.errors import RunError

TableFormat = Literal["csv", "parquet"]


def export_tables(catalogue: Catalogue, folder: str | Path, form: TableFormat) -> list[Path]:
    """Write each table into a file of its own, which takes its place in one step.

    A missing value is an empty field of CSV, an empty text is ``""``.

    Args:
        catalogue: Of the dataset.
        folder: Of the files ``users.csv``, …, on this machine; it is made.
        form: Of the files.

    Returns:
        The files.

    Raises:
        RunError: The folder is an address, a file is there that is no such table, or one cannot be written.
        SetupError: DuckDB, which writes Parquet, is not installed.
    """
    check_out(folder)
    folder = Path(folder)
    names = (*TABLES, *MEASURED_TABLES)
    files = [folder / f"{name}.{form}" for name in names]
    for name, file in zip(names, files, strict=True):
        if file.exists() and not _is_table(file, list(columns_of(name))):
            raise RunError(
                f"{file} is there, and is not the table {name} of a dataset: move it, or choose another "
                "folder with --out"
            )
    # A folder of its own: another command may write the same tables, and files of the user stay.
    with writing(files[0]), tempfile.TemporaryDirectory(prefix=".tables-", dir=folder) as work:
        for name, file in zip(names, files, strict=True):
            _export(catalogue, name, Path(work), form).replace(file)
    return files


def check_out(folder: str | Path) -> None:
    """Check that tables can be written to a place, before the dataset is looked for.

    Args:
        folder: As of `export_tables`.

    Raises:
        RunError: It is an address, or empty.
    """
    if is_address(folder):
        raise RunError(
            f"tables are written to a folder of this machine, and {folder} is an address: give a folder, and "
            "copy its files there"
        )


def _export(catalogue: Catalogue, name: str, folder: Path, form: TableFormat) -> Path:
    file = folder / f"{name}.csv"
    columns, rows = catalogue.table(name)
    with file.open("w", encoding="utf-8", newline="") as stream:
        stream.write(_line(columns))
        stream.writelines(map(_line, rows))
    return file if form == "csv" else _as_parquet(file, columns_of(name))


def _line(row: Sequence[Any]) -> str:
    """A line of CSV. `csv.writer` writes no value and an empty text alike."""
    return ",".join(map(_field, row)) + "\n"


def _field(value: Any) -> str:
    if value is None:
        return ""
    if not isinstance(value, str):
        return str(value)  # numbers in their shortest form that reads back as the same double
    if value and not any(mark in value for mark in ',"\r\n'):
        return value
    return '"' + value.replace('"', '""') + '"'


def _as_parquet(file: Path, types: dict[str, str]) -> Path:
    """A CSV file as Parquet, beside it."""
    import duckdb

    target = file.with_suffix(".parquet")
    with duckdb.connect() as connection:
        kinds = {"INTEGER": "BIGINT", "REAL": "DOUBLE", "TEXT": "VARCHAR"}
        columns = {name: kinds[kind] for name, kind in types.items()}
        relation = connection.read_csv(
            str(file),
            header=True,
            columns=columns,
            auto_detect=False,
            delimiter=",",
            quotechar='"',
            escapechar='"',
            allow_quoted_nulls=False,  # "" is a text
            parallel=False,  # a text may have line breaks
        )
        relation.write_parquet(str(target))
    return target


def _is_table(file: Path, columns: list[str]) -> bool:
    """Check whether a file has the columns of a table, and so may be replaced."""
    if file.suffix == ".csv":
        try:
            with file.open(encoding="utf-8") as stream:
                return stream.readline().rstrip("\n").split(",") == columns
        except (OSError, UnicodeDecodeError):
            return False
    import duckdb

    try:
        with duckdb.connect() as connection:
            found: list[str] = connection.read_parquet(str(file)).columns
            return found == columns
    except duckdb.Error:
        return False
