"""Formats of Parquet: flat tables with their units, and a folder for Hugging Face and Croissant."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from caviar_clients.datasets.rows import SCENE_COLUMNS, USER_COLUMNS
from caviar_clients.datasets.user_rows import Users
from caviar_formats.base import Format, Part, markdown_table
from caviar_formats.npz import LOSES
from caviar_protocol.digest import file_digest
from caviar_protocol.recording.topics import TOPIC_ARRAYS

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

CONVENTIONS = """Arrays are lists in C order; the metadata of a file has description, unit and `shape` of a
row by the name of the column, as JSON, with sizes where all rows of the file share them. Complex arrays have
two columns, `.real` and `.imag`. Angles are (zenith from +z, azimuth from +x) in world axes: x to the east, y
to the north, z upwards. `channel.a` has the phase of the carrier."""
LEFT_OUT = ("camera", "depth", "segmentation", "channel.beam_gains")
"""Topics without columns, as a list of a million numbers a row is no table; gains follow from H."""


class Parquet(Format):
    """Tables ``users/part-NNNNN.parquet`` and ``scenes/part-NNNNN.parquet``."""

    loses = f"{LOSES} Pictures, which `npz` has where a user has one camera, and gains of beams."
    packages = ("duckdb", "nanoarrow")

    def begin(self, users: Users) -> None:
        self._connection = _connected()  # takes as long as writing a dozen scenes
        found = users.readable().items()
        self._names = {name: text for name, text in found if not name.startswith(LEFT_OUT)}

    def write(self, part: Part, folder: Path) -> None:
        if len(part.users):  # which --tx and the like narrow
            table = _Table(self._connection, len(part.users))
            table.add_columns(part.users.read([*USER_COLUMNS]), USER_COLUMNS)
            for name, rows in part.users.rows(list(self._names)).items() if self._names else ():
                table.add_rows(name, rows)
            table.save(_file(folder, "users", part.number))
        table = _Table(self._connection, len(part.scenes))
        table.add_columns(part.scenes, SCENE_COLUMNS)
        table.save(_file(folder, "scenes", part.number))

    def finish(self, users: Users, folder: Path) -> None:
        self._connection.close()

    def readme(self, users: Users) -> str:
        return f"""# {users.dataset.name} as Parquet

`users/` holds a row for each user (a receiver in a scene, on a carrier, for a transmitter), `scenes/` a row
for each scene. Both have `episode` and `scene`, which join them.

```python
import duckdb

duckdb.read_parquet("users/*.parquet").show()
duckdb.sql("FROM parquet_kv_metadata('users/part-00000.parquet')").show()  # units
```

{CONVENTIONS}

{markdown_table(("column", "what it is [unit], type, shape of a row"), (USER_COLUMNS | self._names).items())}
"""


def _file(folder: Path, table: str, number: int) -> Path:
    file = folder / table / f"part-{number:05d}.parquet"
    file.parent.mkdir(exist_ok=True)
    return file


def _connected() -> DuckDBPyConnection:
    """Connect to a database in memory; one thread, so that rows and elements of lists keep their order."""
    import duckdb

    return duckdb.connect(config={"threads": 1})


class _Table:
    """A table that is made column by column, and written to a file."""

    def __init__(self, connection: DuckDBPyConnection, rows: int) -> None:
        self._connection, self._rows = connection, rows
        self._select = list[str]()
        self._about: dict[str, str] = {}
        self._flat: dict[str, NDArray[Any]] = {}
        self._lists: dict[str, Any] = {}

    def add_columns(self, columns: Mapping[str, NDArray[Any]], about: Mapping[str, str]) -> None:
        """Add columns of the catalogue; a number that is missing there is null."""
        for name, values in columns.items():
            text, _, unit = about[name].partition(" [")
            self._add(name, values, text, unit.partition("]")[0] or "1", "[]")

    def add_rows(self, name: str, rows: Sequence[Any]) -> None:
        """Add the rows of a recorded array, which become lists; of complex numbers two columns."""
        topic, _, field = name.partition(".")
        column, arrays = TOPIC_ARRAYS[topic].columns[field], [np.asarray(row) for row in rows]
        sizes = {array.shape for array in arrays}
        shape = str(list(sizes.pop() if len(sizes) == 1 else column.shape))
        parts = ("real", "imag") if column.dtype.kind == "c" else ("",)
        for part in parts:
            values = [getattr(array, part) if part else array for array in arrays]
            full = f"{name}.{part}" if part else name
            if column.shape:
                self._add_lists(full, values)
                self._note(full, column.doc, column.unit, shape)
            else:
                self._add(full, np.array(values), column.doc, column.unit, shape)

    def _add(self, name: str, values: NDArray[Any], text: str, unit: str, shape: str) -> None:
        key = f"c{len(self._select)}"
        self._flat[key] = values
        kind = {"U": f"CAST({key} AS VARCHAR)", "f": f"CASE WHEN NOT isnan({key}) THEN {key} END"}
        self._select.append(f'{kind.get(values.dtype.kind, key)} AS "{name}"')
        self._note(name, text, unit, shape)

    def _add_lists(self, name: str, rows: Sequence[NDArray[Any]]) -> None:
        import nanoarrow

        values = np.concatenate([row.ravel() for row in rows])
        kind = getattr(nanoarrow, values.dtype.name)()
        items = nanoarrow.c_array_from_buffers(kind, len(values), [None, values], null_count=0)
        cuts = np.cumsum([0, *(row.size for row in rows)], dtype=np.int64)
        self._lists[name] = nanoarrow.c_array_from_buffers(
            nanoarrow.large_list(kind), len(rows), [None, cuts], null_count=0, children=[items]
        )
        self._select.append(f'"{name}"')

    def _note(self, name: str, text: str, unit: str, shape: str) -> None:
        self._about[name] = json.dumps(
            {"description": text, "unit": unit, "shape": shape}, ensure_ascii=False
        )

    def save(self, file: Path) -> None:
        """Write the table."""
        import nanoarrow

        self._connection.register("flat", self._flat)
        select = f"SELECT {', '.join(self._select)} FROM flat"  # noqa: S608
        if self._lists:
            kinds = {name: nanoarrow.Schema(lists.schema) for name, lists in self._lists.items()}
            rows = nanoarrow.c_array_from_buffers(
                nanoarrow.struct(kinds), self._rows, [None], null_count=0, children=self._lists.values()
            )
            self._connection.register("lists", nanoarrow.ArrayStream(rows))
            select += " POSITIONAL JOIN lists"
        _copy(self._connection, select, file, self._about)
        self._connection.unregister("flat").unregister("lists")


def _copy(connection: DuckDBPyConnection, select: str, file: Path, about: Mapping[str, str]) -> None:
    """Write rows to a Parquet file with metadata."""
    notes = ", ".join(f"{_text(key)}: {_text(value)}" for key, value in about.items())
    # Rows of arrays are long: a group of the default size would take a gigabyte.
    options = f"FORMAT parquet, COMPRESSION snappy, ROW_GROUP_SIZE 2048, KV_METADATA {{{notes}}}"
    connection.execute(f"COPY ({select}) TO {_text(str(file))} ({options})")


def _text(value: str) -> str:
    return "'" + value.replace("'", "''") + "'"


# --- Hugging Face and Croissant -----------------------------------------------------------------------------

_TYPES = {"BOOLEAN": "sc:Boolean", "VARCHAR": "sc:Text", "DOUBLE": "sc:Float", "FLOAT": "sc:Float"}
# Of Croissant 1.0, by the terms that are used here.
_TERMS = ("column", "extract", "field", "fileObject", "includes", "recordSet", "repeated", "source")
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
} | {term: f"cr:{term}" for term in _TERMS}


class HuggingFace(Parquet):
    """Parquet, a dataset card as README, and a description in Croissant 1.0 with the SHA-256 of each file."""

    temporary = ("users", "scenes")

    def finish(self, users: Users, folder: Path) -> None:
        super().finish(users, folder)
        records, files = [], []
        for table in ("users", "scenes"):
            file = folder / f"{table}.parquet"
            _join_parts(folder / table, file)
            records.append(_record_set(table, file))
            files.append(_file_object(file))
        described = {
            "@context": _CONTEXT,
            "@type": "sc:Dataset",
            "conformsTo": "http://mlcommons.org/croissant/1.0",
            "name": users.dataset.name,
            "description": f"{len(users.dataset)} episodes of CAVIAR",
            "distribution": files,
            "recordSet": records,
        }
        (folder / "croissant.json").write_text(json.dumps(described, indent=1), encoding="utf-8")

    def readme(self, users: Users) -> str:
        tables = ("users", "scenes")
        configs = "\n".join(f"- config_name: {name}\n  data_files: {name}.parquet" for name in tables)
        about = (USER_COLUMNS | self._names).items()
        return f"""---
configs:
{configs}
---

# {users.dataset.name}

A dataset of CAVIAR: wireless channels, and what sensors saw, of the same instants of a virtual world.

```python
from datasets import load_dataset

users = load_dataset("PATH OF THIS FOLDER", "users", split="train")
```

`croissant.json` describes the columns for readers of Croissant, with the SHA-256 of each file. {CONVENTIONS}

{markdown_table(("column", "what it is [unit], type, shape of a row"), about)}
"""


def _about(connection: DuckDBPyConnection, file: Path) -> dict[str, str]:
    """Read the metadata of a file, by column."""
    rows = connection.execute("SELECT key, value FROM parquet_kv_metadata(?)", [str(file)]).fetchall()
    return {key.decode(): value.decode() for key, value in rows}


def _join_parts(parts: Path, file: Path) -> None:
    """Join the parts of a table into one file, of which Croissant has the digest.

    Columns whose sizes differ from part to part have their names in the metadata.
    """
    with _connected() as connection:
        about: dict[str, str] = {}
        for part in sorted(parts.glob("*.parquet")):
            found = _about(connection, part)
            about = {
                key: value if about.get(key, value) == value else _open(key, value)
                for key, value in found.items()
            }
        paths = ", ".join(_text(str(part)) for part in sorted(parts.glob("*.parquet")))
        _copy(connection, f"SELECT * FROM read_parquet([{paths}])", file, about)  # noqa: S608


def _open(key: str, value: str) -> str:
    """Describe a column whose rows have other sizes in another part."""
    topic, field = key.split(".")[:2]
    shape = str(list(TOPIC_ARRAYS[topic].columns[field].shape))
    return json.dumps(json.loads(value) | {"shape": shape}, ensure_ascii=False)


def _file_object(file: Path) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": file.name,
        "name": file.name,
        "contentUrl": file.name,
        "contentSize": f"{file.stat().st_size} B",
        "encodingFormat": "application/x-parquet",
        "sha256": file_digest(file),
    }


def _record_set(table: str, file: Path) -> dict[str, Any]:
    """Describe the columns of a table, with their units in the descriptions."""
    with _connected() as connection:
        about = _about(connection, file)
        columns: Iterable[tuple[str, str]] = connection.execute(
            "SELECT column_name, column_type FROM (DESCRIBE SELECT * FROM read_parquet(?))", [str(file)]
        ).fetchall()
    fields = []
    for name, kind in columns:
        notes = json.loads(about[name])
        field = {
            "@type": "cr:Field",
            "@id": f"{table}/{name}",
            "name": f"{table}/{name}",
            "description": f"{notes['description']} [{notes['unit']}]",
            "dataType": _TYPES.get(kind.removesuffix("[]"), "sc:Integer"),
            "source": {"fileObject": {"@id": file.name}, "extract": {"column": name}},
        }
        fields.append(field | ({"repeated": True} if kind.endswith("[]") else {}))
    return {"@type": "cr:RecordSet", "@id": table, "name": table, "field": fields}
