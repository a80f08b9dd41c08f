"""Pictures of a comparison."""

from __future__ import annotations

from pathlib import Path

from caviar_clients.tradeoff.report import Report


def draw_pareto(report: Report, file: Path) -> Path:
    return file


def draw_convergence(report: Report, file: Path) -> Path:
    return file
