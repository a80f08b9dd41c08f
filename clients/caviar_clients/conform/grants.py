"""GRANTs as a broker writes them: provenance of each input, and the parts behind it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from caviar_clients.conform import street
from caviar_clients.conform.forms import product_digest
from caviar_clients.conform.packing import pack, unpack
from caviar_clients.conform.wire import Fields

Product = tuple[bytes, bytes]
HELD_FOR = 2
"""Frames that a held product is older than a fresh one."""


@dataclass(frozen=True)
class Inputs:
    """How the inputs of a grant are to be."""

    sources: Mapping[str, Sequence[str]] = field(default_factory=lambda: street.SOURCES)
    held: bool = False
    """Instead of the product of the frame there is an older one."""
    without_optional: bool = False
    """What is not required is absent."""
    late: bool = False
    """Beside each product there is one that came too late, of the frame before (recorders)."""
    spoil: str = ""
    """``header`` or ``body``: what of the first product is cut."""
    stranger: bool = False
    """Payloads have a field, and an array, that this version does not know."""

    def of(self, declared: Sequence[Fields], frame: int) -> tuple[list[Fields], list[bytes]]:
        """Entries of ``inputs`` and the parts behind the header."""
        entries: list[Fields] = []
        parts: list[bytes] = []
        for item in declared:
            topics = sorted(street.SOURCES) if item["topic"] == "*" else [item["topic"]]
            for topic in topics:
                for source in self.sources.get(topic, ()):
                    for entry, product in self._entries(item, topic, source, frame):
                        entries.append(entry)
                        parts += product
        return entries, self._spoiled(parts)

    def _entries(
        self, item: Fields, topic: str, source: str, frame: int
    ) -> list[tuple[Fields, tuple[bytes, ...]]]:
        lag = int(item.get("lag", 0))
        computed, optional = frame - lag, not item.get("required", True)
        if computed < 0 or (self.without_optional and optional):
            cause = "no frame before the first" if computed < 0 else f"{source} missed frame {computed}"
            return [({"topic": topic, "source": source, "status": "absent", "cause": cause}, ())]
        held = HELD_FOR if self.held and computed >= HELD_FOR else 0
        status = "held" if held else "fresh"
        found = [self._entry(topic, source, status, computed - held, lag + held)]
        if self.late and computed:
            found.append(self._entry(topic, source, "late", computed - 1, lag + 1))
        return found

    def _entry(
        self, topic: str, source: str, status: str, frame: int, age: int
    ) -> tuple[Fields, tuple[bytes, ...]]:
        header, body = street.product(topic, source, frame)
        if self.stranger:
            header, body = _with_stranger(header, body)
        entry: Fields = {"topic": topic, "source": source, "status": status, "frame": frame}
        if frame:
            entry["t_ns"] = frame * street.PERIOD_NS
        if age:
            entry["age"] = age
        entry["digest"] = product_digest(header, body)
        if status == "held":
            entry["cause"] = f"{source} missed frame {frame + HELD_FOR}"
        if self.stranger:
            entry["colour"] = ["not known to this version"]
        return entry, (header, body)

    def _spoiled(self, parts: list[bytes]) -> list[bytes]:
        if self.spoil and parts:
            number = next((n for n in range(1, len(parts), 2) if parts[n]), 1) - (self.spoil == "header")
            parts[number] = parts[number][: len(parts[number]) // 2] if self.spoil == "body" else b"\xc1\xff"
        return parts


def _with_stranger(header: bytes, body: bytes) -> Product:
    """The product with a field more, whose array lies behind all others."""
    fields = unpack(header)
    padded = body + bytes(-len(body) % 8)
    fields["strange"] = {"dtype": "<f8", "shape": [2], "offset": len(padded)}
    return pack(fields), padded + bytes(16)
