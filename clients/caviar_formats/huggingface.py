"""Format ``huggingface``: a folder that the libraries ``datasets`` and ``mlcroissant`` open."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import parquet

from caviar_clients.datasets.user_rows import Users
from caviar_formats.parquet import CONVENTIONS, Parquet, column_list, user_table
from caviar_protocol.digest import file_digest

_TYPES = {"bool": "sc:Boolean", "string": "sc:Text", "double": "sc:Float", "float": "sc:Float"}
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

    def readme(self, users: Users) -> str:
        configs = "".join(
            f"- config_name: {table}\n  data_files: {table}.parquet\n" for table in ("users", "scenes")
        )
        return f"""---
configs:
{configs}---

# {users.dataset.name}

A dataset of CAVIAR: wireless channels, and what sensors saw, of the same instants of a virtual world.

```python
from datasets import load_dataset

users = load_dataset("PATH OF THIS FOLDER", "users", split="train")
```

{CONVENTIONS}

{column_list(user_table(users[:1]).schema)}
"""

    def finish(self, users: Users, folder: Path) -> None:
        records = []
        for table in ("users", "scenes"):
            schema = _joined(folder / table, folder / f"{table}.parquet")
            records.append(_record_set(table, schema))
        described = {
            "@context": _CONTEXT,
            "@type": "sc:Dataset",
            "conformsTo": "http://mlcommons.org/croissant/1.0",
            "name": users.dataset.name,
            "description": f"{len(users.dataset)} episodes of CAVIAR",
            "distribution": [_file_object(file) for file in sorted(folder.glob("*.parquet"))],
            "recordSet": records,
        }
        (folder / "croissant.json").write_text(json.dumps(described, indent=1), encoding="utf-8")


def _joined(parts: Path, file: Path) -> pa.Schema:
    """Join the parts of a table into one file, of which Croissant has the digest, and remove them.

    Columns of numbers whose sizes differ from part to part say so in their metadata.
    """
    files = sorted(parts.glob("*.parquet"))
    schema = pa.unify_schemas([parquet.read_schema(part) for part in files])
    with parquet.ParquetWriter(file, schema, compression="zstd") as writer:
        for part in files:
            writer.write_table(parquet.read_table(part).cast(schema))
    shutil.rmtree(parts)
    return schema


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


def _record_set(table: str, schema: pa.Schema) -> dict[str, Any]:
    """Columns of a table, with their units in the descriptions."""
    fields = []
    for column in schema:
        description, unit = (column.metadata[key].decode() for key in (b"description", b"unit"))
        is_list = pa.types.is_large_list(column.type)
        field = {
            "@type": "cr:Field",
            "@id": f"{table}/{column.name}",
            "name": f"{table}/{column.name}",
            "description": f"{description} [{unit}]",
            "dataType": _TYPES.get(str(column.type.value_type if is_list else column.type), "sc:Integer"),
            "source": {"fileObject": {"@id": f"{table}.parquet"}, "extract": {"column": column.name}},
        }
        fields.append(field | ({"repeated": True} if is_list else {}))
    return {"@type": "cr:RecordSet", "@id": table, "name": table, "field": fields}
