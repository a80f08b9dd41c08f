"""Conformance kit for clients in any language: a broker that follows scripts, and a verdict per clause.

It shares no code with the product's broker and reads headers with the plain ``msgpack`` package, so that
it is a second reading of ``protocol/SPEC.md``. Only payloads are judged with `caviar_protocol`'s types.

`conform` plays the cases, which `lifecycle`, `frames`, `content` and `wrong` hold. `session` plays the broker
for one life of the client, which `client` starts, with the contents of `street`; `canonical` judges what
comes.
"""

from __future__ import annotations

from caviar_clients.conform.case import Case, Verdict
from caviar_clients.conform.kit import Kit, cases, conform

__all__ = ["Case", "Kit", "Verdict", "cases", "conform"]
