"""Format ``parquet``: users and scenes as flat tables, with units in the metadata of their columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import parquet

from caviar_clients.datasets.rows import SCENE_COLUMNS, USER_COLUMNS
from caviar_clients.datasets.user_rows import Columns, Users
from caviar_formats.base import Format, markdown_table
from caviar_protocol.recording.topics import TOPIC_ARRAYS


class Parquet(Format):
    """Tables ``users/part-NNNNN.parquet`` and ``scenes/part-NNNNN.parquet``."""

    loses = (
        "Products without a row for each user (scenes, actions) and objects; the scenery stands in the "
        "`assets` folder of the dataset."
    )

    def write(self, users: Users, folder: Path, number: int) -> None:
        self.put(folder, "users", number, user_table(users))
        self.put(folder, "scenes", number, _table(users.dataset.table("scenes"), SCENE_COLUMNS))

    def put(self, folder: Path, table: str, number: int, rows: pa.Table) -> None:
        """Write a part of a table."""
        file = folder / table / f"part-{number:05d}.parquet"
        file.parent.mkdir(exist_ok=True)
        parquet.write_table(rows, file, compression="zstd")

    def readme(self, users: Users) -> str:
        return f"""# {users.dataset.name} as Parquet

`users/` holds a row for each user (a receiver in a scene, on a carrier, for a transmitter), `scenes/` a row
for each scene. Both have `episode` and `scene`, which join them.

```python
import pyarrow.parquet as pq

users = pq.read_table("users")
users.schema.field("channel.a.real").metadata  # unit, description, shape
```

{CONVENTIONS}

{column_list(user_table(users[:1]).schema)}
"""


CONVENTIONS = """Arrays are lists in C order; a column's metadata has the `shape` of a row, by sizes where all
rows of the file share them. Complex arrays have two columns, `.real` and `.imag`. Angles are (zenith from +z,
azimuth from +x) in world axes: x to the east, y to the north, z upwards. `channel.a` has the phase of the
carrier."""
"""For the README of tables."""


def user_table(users: Users) -> pa.Table:
    """Make a table of users: columns of the catalogue, then their recorded arrays.

    Args:
        users: All rows of the table.
    """
    table = _table(users.read([*USER_COLUMNS]), USER_COLUMNS)
    names = list(users.recorded())
    for name, rows in users.rows(names).items() if names else ():
        topic, _, field = name.partition(".")
        column = TOPIC_ARRAYS[topic].columns[field]
        sizes = {np.shape(row) for row in rows}
        shape = list(sizes.pop()) if len(sizes) == 1 else "[" + ", ".join(map(str, column.shape)) + "]"
        metadata = {"unit": column.unit, "description": column.doc, "shape": str(shape)}
        for part, values in _parts(rows):
            array = _lists(values) if column.shape else pa.array(np.array(values))
            table = table.append_column(pa.field(name + part, array.type, metadata=metadata), array)
    return table


def column_list(schema: pa.Schema) -> str:
    """Describe the columns of a table as one of Markdown."""
    keys = (b"description", b"unit", b"shape")
    rows = [
        (f"`{field.name}`", field.type, *((field.metadata or {}).get(key, b"").decode() for key in keys))
        for field in schema
    ]
    return markdown_table(("column", "type", "what it is", "unit", "shape"), rows)


def _table(columns: Columns, about: dict[str, str]) -> pa.Table:
    """Make a table of columns of the catalogue; what is missing there is null."""
    arrays, fields = [], []
    for name, values in columns.items():
        mask = np.isnan(values) if values.dtype.kind == "f" else None
        arrays.append(pa.array(values, mask=mask))
        text, _, unit = about[name].partition(" [")
        metadata = {"unit": unit.partition("]")[0] or "1", "description": text}
        fields.append(pa.field(name, arrays[-1].type, metadata=metadata))
    return pa.table(arrays, pa.schema(fields))


def _parts(rows: Sequence[Any]) -> Iterator[tuple[str, list[NDArray[Any]]]]:
    """Split complex rows into real and imaginary ones."""
    arrays = [np.asarray(row) for row in rows]
    if arrays[0].dtype.kind == "c":
        yield ".real", [array.real for array in arrays]
        yield ".imag", [array.imag for array in arrays]
    else:
        yield "", arrays


def _lists(rows: Sequence[NDArray[Any]]) -> pa.Array:
    """Lists of the elements of each row, in C order."""
    ends = np.cumsum([0, *(row.size for row in rows)])
    return pa.LargeListArray.from_arrays(ends, np.concatenate([row.ravel() for row in rows]))
