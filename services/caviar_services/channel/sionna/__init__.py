"""Ray tracing with Sionna RT, Mitsuba and Dr.Jit: scene, launches, candidates, and the path solver.

Mitsuba and Dr.Jit are `mi` and `dr` here, and imported when a name of theirs is first asked for: the base
install has neither, and Dr.Jit takes its LLVM library as it is imported (`drjit_setup.activate_llvm`).
"""

from __future__ import annotations

from importlib import import_module
from typing import Any


class LateModule:
    """A module that is imported at its first use."""

    def __init__(self, name: str, keeps: bool) -> None:
        self._name, self._keeps = name, keeps

    def __getattr__(self, attribute: str) -> Any:
        if attribute == "_module":
            self._module = import_module(self._name)
            return self._module
        value = getattr(self._module, attribute)
        if self._keeps:
            setattr(self, attribute, value)
        return value


dr: Any = LateModule("drjit", keeps=True)
# Names of Mitsuba stand for other things after each change of its variant.
mi: Any = LateModule("mitsuba", keeps=False)
