"""Makes the byte vectors from the JSON beside them.

    python make.py            write NAME.msgpack, NAME.body and NAME.frame for every NAME.json
    python make.py --check    say which of them differ, and exit with 1 where one does

Needs the ``msgpack`` package and nothing of CAVIAR, so that the vectors judge its codec and are
not judged by it. A JSON file has these keys:

``about``     what the vector shows
``kind``      ``message``, ``payload`` (of ``topic``) or ``arrays`` (a list of array references)
``value``     the header, its keys in wire order; a number with a decimal point is a float. An array is
              ``{"dtype": …, "shape": …, "offset": …, "values": […]}``: ``values`` go to the body at
              ``offset``, the rest stands in the header. A complex number is ``[real, imaginary]``.
``raw``       instead of ``value``: the header as ``[hex, times]`` pairs
``body``      instead of ``values``: the body as hex
``parts``     further parts of a message, as hex; ``product`` names the vector that is the first product
``lengths``   lengths of further parts that are too large to be written out
``frame``     true where NAME.frame is the message with its parts as one WebSocket frame
``tolerated`` true where a reader accepts what a writer does not write; ``means`` is then the canonical form
``refused``   the error code with which a reader refuses it
"""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path
from typing import Any

import msgpack

FORMATS = {
    "|b1": "?", "|u1": "B", "|i1": "b", "<u2": "<H", "<i4": "<i", "<i8": "<q", "<u8": "<Q",
    "<f4": "<f", "<f8": "<d", "<c8": "<ff", "<c16": "<dd",
}  # fmt: skip


def elements(values: Any, depth: int) -> list[Any]:
    """The elements of nested lists, in C order."""
    if depth == 0:
        return [values]
    return [element for item in values for element in elements(item, depth - 1)]


def header_of(value: Any, body: bytearray) -> Any:
    """``value`` without the elements of its arrays, which are written into ``body``."""
    if isinstance(value, list):
        return [header_of(item, body) for item in value]
    if not isinstance(value, dict):
        return value
    if "values" not in value:
        return {key: header_of(item, body) for key, item in value.items()}
    layout, offset = FORMATS[value["dtype"]], value["offset"]
    data = b"".join(
        struct.pack(layout, *(item if isinstance(item, list) else [item]))
        for item in elements(value["values"], len(value["shape"]))
    )
    body.extend(bytes(max(0, offset + len(data) - len(body))))
    body[offset : offset + len(data)] = data
    return {key: item for key, item in value.items() if key != "values"}


def vector(text: str) -> tuple[bytes, bytes]:
    """Header and body of a vector from its JSON text."""
    stated = json.loads(text)
    body = bytearray.fromhex(stated.get("body", ""))
    if "raw" in stated:
        return b"".join(bytes.fromhex(digits) * times for digits, times in stated["raw"]), bytes(body)
    header: bytes = msgpack.packb(header_of(stated["value"], body))
    return header, bytes(body)


def frame_of(stated: Any, header: bytes) -> bytes:
    """A message as one WebSocket frame: u32 count, u32 lengths, the parts."""
    parts = [header, *map(bytes.fromhex, stated.get("parts", []))]
    if "product" in stated:
        source = Path(__file__).with_name(f"{stated['product']}.json")
        parts += vector(source.read_text("utf-8"))
    return struct.pack(f"<{len(parts) + 1}I", len(parts), *map(len, parts)) + b"".join(parts)


def main(check: bool) -> int:
    """Write or check every vector in this folder."""
    wrong = 0
    for source in sorted(Path(__file__).parent.glob("*.json")):
        header, body = vector(source.read_text("utf-8"))
        stated = json.loads(source.read_text("utf-8"))
        frame = frame_of(stated, header) if stated.get("frame") else b""
        for suffix, content in ((".msgpack", header), (".body", body), (".frame", frame)):
            target = source.with_suffix(suffix)
            if suffix != ".msgpack" and not content:
                continue
            if not check:
                target.write_bytes(content)
            elif not target.exists() or target.read_bytes() != content:
                wrong += 1
                sys.stderr.write(f"{target.name} is not what {source.name} says\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main("--check" in sys.argv[1:]))
