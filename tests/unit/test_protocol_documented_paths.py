"""Import paths that a page has named stay importable."""

from __future__ import annotations

import importlib

import pytest


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("recording", "Recording"),
        ("recording", "newest_run"),
        ("topics", "BeamChoice"),
        ("digest", "payload_digest"),
        ("seeding", "generator"),
        ("errors", "CaviarError"),
        ("spec", "main"),
    ],
)
def test_a_documented_path_stays_importable(module: str, name: str) -> None:
    assert callable(getattr(importlib.import_module(f"caviar_protocol.{module}"), name))
