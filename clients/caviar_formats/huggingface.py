"""Format ``huggingface``: a folder that the libraries ``datasets`` and ``mlcroissant`` open."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import parquet

from caviar_clients.datasets.user_rows import Users
from caviar_formats.parquet import CONVENTIONS, Parquet, column_list, user_table
from caviar_protocol.digest import file_digest

_TYPES = {"bool": "sc:Boolean", "string": "sc:Text", "double": "sc:Float", "float": "sc:Float"}
_CONTEXT = {
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "recordSet": "cr:recordSet",
    "field": "cr:field",
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "source": "cr:source",
    "fileSet": "cr:fileSet",
    "fileObject": "cr:fileObject",
    "includes": "cr:includes",
    "extract": "cr:extract",
    "column": "cr:column",
    "repeated": "cr:repeated",
}


class HuggingFace(Parquet):
    """Parquet, a dataset card as README, and a description in Croissant 1.0 with the SHA-256 of each file."""

    def readme(self, users: Users) -> str:
        configs = "".join(
            f"- config_name: {table}\n  data_files: {table}/*.parquet\n" for table in ("users", "scenes")
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
        tables = {table: sorted((folder / table).glob("*.parquet")) for table in ("users", "scenes")}
        described: dict[str, Any] = {
            "@context": _CONTEXT,
            "@type": "sc:Dataset",
            "conformsTo": "http://mlcommons.org/croissant/1.0",
            "name": users.dataset.name,
            "description": f"{len(users.dataset)} episodes of CAVIAR",
            "distribution": [
                part for table, files in tables.items() for part in _distribution(folder, table, files)
            ],
            "recordSet": [
                _record_set(table, parquet.read_schema(files[0])) for table, files in tables.items()
            ],
        }
        (folder / "croissant.json").write_text(json.dumps(described, indent=1), encoding="utf-8")


def _distribution(folder: Path, table: str, files: list[Path]) -> list[dict[str, Any]]:
    """Files of a table, each with its digest, and the set of them."""
    objects: list[dict[str, Any]] = [
        {
            "@type": "cr:FileObject",
            "@id": str(file.relative_to(folder)),
            "name": str(file.relative_to(folder)),
            "contentUrl": str(file.relative_to(folder)),
            "contentSize": f"{file.stat().st_size} B",
            "encodingFormat": "application/x-parquet",
            "sha256": file_digest(file),
        }
        for file in files
    ]
    together = {
        "@type": "cr:FileSet",
        "@id": f"{table}-files",
        "name": f"{table}-files",
        "containedIn": [{"@id": entry["@id"]} for entry in objects],
        "encodingFormat": "application/x-parquet",
        "includes": f"{table}/*.parquet",
    }
    return [*objects, together]


def _record_set(table: str, schema: pa.Schema) -> dict[str, Any]:
    """Columns of a table, with their units in the descriptions."""
    fields = []
    for column in schema:
        description, unit = (column.metadata[key].decode() for key in (b"description", b"unit"))
        is_list = pa.types.is_large_list(column.type)
        kind = str(column.type.value_type if is_list else column.type)
        fields.append(
            {
                "@type": "cr:Field",
                "@id": f"{table}/{column.name}",
                "name": f"{table}/{column.name}",
                "description": f"{description} [{unit}]",
                "dataType": _TYPES.get(kind, "sc:Integer"),
                **({"repeated": True} if is_list else {}),
                "source": {"fileSet": {"@id": f"{table}-files"}, "extract": {"column": column.name}},
            }
        )
    return {"@type": "cr:RecordSet", "@id": table, "name": table, "field": fields}
