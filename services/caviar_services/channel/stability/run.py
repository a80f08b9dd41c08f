"""Running the cases, and what is written of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from caviar_protocol.host import has_extra
from caviar_services.channel.stability.bench import Bench
from caviar_services.channel.stability.case import CASES, Case, Outcome, Result

EXTRA = "channel"
"""Extra of the distribution that brings the ray tracer."""

GROUPS = ("waves", "places", "counts", "motion", "meshes", "edges", "inputs")
"""Modules with cases, in the order of the table."""


def cases() -> Sequence[Case]:
    """All cases."""
    for module in GROUPS:
        import_module(f"caviar_services.channel.stability.{module}")
    return tuple(CASES)


def run(chosen: Sequence[Case], progress: Callable[[int, Case], None] | None = None) -> list[Result]:
    """Ask the chosen cases, one after the other; one that raises an error of its own is wrong.

    Cases that trace are ``not run`` where the ray tracer is not installed: that says nothing about physics.
    ``progress`` is called with number and case before each case that runs.
    """
    has_tracer = has_extra(EXTRA)
    results: list[Result] = []
    with TemporaryDirectory(prefix="caviar-stability-") as folder:
        bench = Bench(Path(folder))
        for number, case in enumerate(chosen):
            if case.traced and not has_tracer:
                results.append(_not_run(case))
                continue
            if progress is not None:
                progress(number, case)
            begin = time.perf_counter()
            outcome = _asked(case, bench)
            results.append(
                Result(
                    group=case.group,
                    case=case.name,
                    expected=outcome.expected,
                    got=outcome.got.replace(f"{folder}/", "…/"),
                    verdict="right" if outcome.right else "wrong",
                    seconds=round(time.perf_counter() - begin, 3),
                )
            )
    return results


def _not_run(case: Case) -> Result:
    return Result(
        group=case.group,
        case=case.name,
        expected="an answer of the ray tracer",
        got=f"needs the extra {EXTRA!r}",
        verdict="not run",
        seconds=0.0,
    )


def _asked(case: Case, bench: Bench) -> Outcome:
    try:
        with np.errstate(all="ignore"):
            return case.ask(bench)
    except Exception as error:  # whatever goes wrong in a case is its answer
        return Outcome(expected="an answer", got=f"{type(error).__name__}: {error}", right=False)


def wrong(results: Sequence[Result]) -> list[Result]:
    """Those with another answer than expected."""
    return [result for result in results if result.verdict == "wrong"]


def markdown(results: Sequence[Result]) -> str:
    """The table for the documentation."""
    lines = ["| Case | Expected | Got | Verdict |", "|---|---|---|---|"]
    for result in results:
        cells = (f"{result.group}: {result.case}", result.expected, result.got, result.verdict)
        lines.append("| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |")
    return "\n".join(lines) + "\n"
