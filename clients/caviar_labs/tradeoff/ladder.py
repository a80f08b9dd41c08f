"""The settings that are compared: the ladder, the lines of the paper's tables 3 and 4, and convergence.

To add a setting, add a line to `LADDER`, or to a table's columns, `TABLE_RUNGS`. A setting that the channel
of an installation does not know is reported as not measured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal

Block = Literal["ladder", "keyframes", "ray spacing", "arrays", "convergence", "diffuse convergence"]
"""Block that a setting belongs to. Settings of a block take turns, so that noise hits all alike."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Setting:
    """A channel model with its settings.

    Args:
        label: Unique name in tables and plots.
        use: Registered channel.
        settings: Over the scenario's, where its channel is the same implementation, or over the defaults.
        block: Block that it is measured in.
        column: Column of the table that it belongs to.
        row: Row of the table that it belongs to.
        elements: (Nt, Nr) of horizontal linear arrays in place of the scenario's; None: the scenario's.
        scattering: Whether every material of the scenery gets `SCATTERING`, unless the scenario sets
            coefficients itself.
        most_scenes: Scenes at most, for a setting that takes minutes each; None: all.
        most_receivers: Receivers at most, likewise.

    Example:
        >>> shallow = Setting(label="depth 2", use="sionna-rt", settings={"max_depth": 2})
        >>> shallow.over({"max_depth": 5, "samples": 10})
        {'max_depth': 2, 'samples': 10}
    """

    label: str
    use: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    block: Block = "ladder"
    column: str = ""
    row: str = ""
    elements: tuple[int, int] | None = None
    scattering: bool = False
    most_scenes: int | None = None
    most_receivers: int | None = None

    def over(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Put these settings over a scenario's; one that is None here is left out, whatever that has."""
        return {key: value for key, value in {**given, **self.settings}.items() if value is not None}


SCATTERING = 0.4
"""Scattering coefficient S of Degli-Esposti et al., "Measurement and modelling of scattering from buildings",
2007, who fitted S ≈ 0.4 to brick façades."""

# How much more diffuse scattering, H of each element over so many paths, and the tracing of every pair cost,
# about: only for the order of measurements.
_DIFFUSE_EFFORT = 120
_ELEMENTS_EFFORT = 15
_PAIRS_EFFORT = 100

CHEAP = 2
"""Receivers of a setting that traces every pair of antenna elements."""

_SIONNA = "sionna-rt"
# Settings of `geometric` with which its gains mean the same as those of the others.
_COMPARABLE = {"normalization": "path-loss", "nlos": "geometry"}
# Limit on the paths of a scene where they are diffuse, so that none is lost.
_DIFFUSE_PATHS = 2_000_000
CHOSEN_PATHS = 500
"""Diffuse paths that are chosen for a receiver, where they are chosen."""
CHOSEN = f"{CHOSEN_PATHS} paths"
_CHOSEN_EFFORT = 3
_ALL = {"refraction": True, "diffraction": True}


# What a ray-traced setting has unless it differs. All of it is given, so that none of the scenario's own
# choices, many of which exclude each other, is measured in its place.
_LAUNCH: Mapping[str, Any] = {
    "rung": "siso-rt",
    "candidates": "launched",
    "refraction": False,
    "diffraction": False,
    "scattering": False,
    "ray_spacing_deg": None,
    "scattering_samples": None,
    "scattering_paths": None,
    "follow": None,
}
# Which edges diffract is the scenario's choice where any do; without diffraction these keys are off.
_WITHOUT_DIFFRACTION: Mapping[str, Any] = {"free_edges": False, "edges_within_m": None}


def _traced(samples: int, depth: int, **more: Any) -> dict[str, Any]:
    """Make settings of a ray-traced rung; what is not named is off."""
    edges = {} if more.get("diffraction") else _WITHOUT_DIFFRACTION
    return {**_LAUNCH, **edges, "samples": samples, "max_depth": depth, **more}


def chosen_diffuse(samples: int) -> dict[str, Any]:
    """Make settings of diffuse paths chosen among the points of rays of their own.

    Args:
        samples: Number of these rays.
    """
    return {
        "scattering": True,
        "scattering_samples": samples,
        "scattering_paths": CHOSEN_PATHS,
        "max_paths": _DIFFUSE_PATHS,
    }


LADDER: tuple[Setting, ...] = (
    Setting(label="free-space", use="free-space"),
    Setting(label="geometric", use="geometric", settings=_COMPARABLE),
    Setting(label="siso-rt 1e5 d1", use=_SIONNA, settings=_traced(100_000, 1)),
    Setting(label="siso-rt 1e5 d2", use=_SIONNA, settings=_traced(100_000, 2)),
    Setting(label="siso-rt 1e4 d3", use=_SIONNA, settings=_traced(10_000, 3)),
    Setting(label="siso-rt 1e5 d3", use=_SIONNA, settings=_traced(100_000, 3)),
    Setting(label="siso-rt 1e6 d3", use=_SIONNA, settings=_traced(1_000_000, 3)),
    Setting(
        label="siso-rt enumerated d3", use=_SIONNA, settings=_traced(1_000_000, 3, candidates="enumerated")
    ),
    Setting(label="siso-rt 1e5 d3 +refraction", use=_SIONNA, settings=_traced(100_000, 3, refraction=True)),
    Setting(label="siso-rt 1e5 d3 +diffraction", use=_SIONNA, settings=_traced(100_000, 3, diffraction=True)),
    Setting(
        label="siso-rt 1e5 d3 +scattering 1e4",
        use=_SIONNA,
        settings=_traced(100_000, 3, scattering=True, scattering_samples=10_000, max_paths=_DIFFUSE_PATHS),
        scattering=True,
    ),
    Setting(
        label=f"siso-rt 1e5 d3 +scattering 1e4, {CHOSEN}",
        use=_SIONNA,
        settings=_traced(100_000, 3, **chosen_diffuse(10_000)),
        scattering=True,
    ),
    Setting(label="siso-rt 1e6 d5 +r+d", use=_SIONNA, settings=_traced(1_000_000, 5, **_ALL)),
    Setting(label="spherical 1e5 d3", use=_SIONNA, settings=_traced(100_000, 3, rung="spherical")),
    Setting(
        label="spherical 1e6 d5 +r+d",
        use=_SIONNA,
        settings=_traced(1_000_000, 5, rung="spherical", **_ALL),
    ),
    Setting(
        label="mimo-rt 1e4 d3",
        use=_SIONNA,
        settings=_traced(10_000, 3, rung="mimo-rt"),
        most_scenes=2,
        most_receivers=CHEAP,
    ),
)

# The finest first.
REFERENCES = (
    "spherical 1e6 d5 +r+d",
    "siso-rt 1e6 d5 +r+d",
    "siso-rt 1e6 d3",
    "siso-rt enumerated d3",
    "spherical 1e5 d3",
    "siso-rt 1e5 d3",
    "free-space",
)
"""The default reference is the first of these, which begin with the finest, that the channels of this
installation know and that was measured in time; ``free-space`` only where there is no scenery. ``mimo-rt`` is
none of them: it is affordable for few scenes, receivers and samples only."""

BASELINES = ("siso-rt 1e5 d3", "free-space")
"""The default baseline of the factors, likewise."""

TABLE_RUNGS: Mapping[str, Mapping[str, Any]] = {
    "siso-rt": {},
    "spherical": {"rung": "spherical"},
    "mimo-rt": {"rung": "mimo-rt"},
}
"""Columns of both tables, and what each adds to the settings of sionna-rt."""

FEW = frozenset({"mimo-rt"})
"""Rungs that are measured on one scene and few receivers, since each takes minutes."""

SPACINGS_DEG = (1.0, 0.5, 0.25, 0.1)
"""Ray spacings of the paper's Table 3."""
DIFFUSE_DEG = 0.5
"""Ray spacing of its line with diffuse scattering: by all rays, and by paths chosen among those of
`CHOSEN_SAMPLES`."""
DIFFUSE, DIFFUSE_CHOSEN = f"{DIFFUSE_DEG:g} (diffuse)", f"{DIFFUSE_DEG:g} (diffuse, {CHOSEN})"
"""Rows of Table 3 with diffuse scattering."""
CHOSEN_SAMPLES = 10_000
ELEMENTS = ((64, 2), (64, 8), (64, 64))
"""(Nt, Nr) of the paper's Table 4."""

CONVERGENCE_SCENES = 12
"""Scenes over which convergence is measured: each has as many users as it has receivers."""
CONVERGENCE_SAMPLES = (10_000, 30_000, 100_000, 300_000, 1_000_000)
DIFFUSE_SAMPLES = (10_000, 30_000, 100_000, 300_000)
SPECULAR_BESIDE = 100_000
"""Samples for specular paths while those of diffuse ones change."""
TRUTH_SAMPLES = 3_000_000
"""Samples of what the convergence of specular paths is measured against."""


def samples_of(spacing_deg: float) -> int:
    """Compute the number of rays that leave an angle between neighbours.

    N = 4π/Δ² with Δ in radians: each ray stands for the solid angle Δ² of a square lattice.

    Args:
        spacing_deg: The angle Δ [°].

    Example:
        >>> samples_of(1.0), samples_of(0.1)
        (41253, 4125296)
    """
    return round(4 * math.pi / math.radians(spacing_deg) ** 2)


@cache
def spacing_settings() -> tuple[Setting, ...]:
    """Make the lines of the paper's Table 3, the cheapest first: what time is short for comes last."""
    diffuse = {"scattering": True, "max_paths": _DIFFUSE_PATHS}
    rows: list[tuple[float, str, dict[str, Any]]] = [
        *((spacing, f"{spacing:g}", {}) for spacing in SPACINGS_DEG),
        (DIFFUSE_DEG, DIFFUSE, diffuse),
        (DIFFUSE_DEG, DIFFUSE_CHOSEN, chosen_diffuse(CHOSEN_SAMPLES)),
    ]
    made = (_spacing(rung, *row) for row in rows for rung in TABLE_RUNGS if (rung, row[1]) not in _NOT_MADE)
    return tuple(sorted(made, key=_effort))


# The rays of `mimo-rt` are those of the antenna pair: it has no launch of its own to choose from.
_NOT_MADE = frozenset({("mimo-rt", DIFFUSE_CHOSEN)})


def _spacing(rung: str, spacing_deg: float, row: str, options: Mapping[str, Any]) -> Setting:
    return Setting(
        label=f"{rung} {row.replace(' ', '° ', 1)}" if options else f"{rung} {row}°",
        use=_SIONNA,
        settings=_traced(samples_of(spacing_deg), 3, **options, **TABLE_RUNGS[rung]),
        block="ray spacing",
        column=rung,
        row=row,
        scattering="scattering" in options,
        most_scenes=1 if rung in FEW else None,
        most_receivers=CHEAP if rung in FEW else None,
    )


def array_settings() -> tuple[Setting, ...]:
    """Make the lines of the paper's Table 4, likewise."""
    made = (_arrays(rung, *elements) for elements in ELEMENTS for rung in TABLE_RUNGS)
    return tuple(sorted(made, key=_effort))


def _effort(setting: Setting) -> float:
    """Estimate the cost of a scene, in rays; good enough for an order."""
    rays = float(setting.settings["samples"])
    if setting.scattering:
        chosen = setting.settings.get("scattering_paths") is not None
        rays *= _CHOSEN_EFFORT if chosen else _DIFFUSE_EFFORT
        rays *= 1 if chosen or setting.column == "siso-rt" else _ELEMENTS_EFFORT
    if setting.column not in FEW:
        return rays
    # Each pair of elements is traced by itself.
    pairs = math.prod(setting.elements) if setting.elements else 1
    return rays * _PAIRS_EFFORT * pairs


def _arrays(rung: str, nt: int, nr: int) -> Setting:
    return Setting(
        label=f"{rung} {nt}×{nr}",
        use=_SIONNA,
        settings=_traced(10_000 if rung in FEW else 100_000, 3, **TABLE_RUNGS[rung]),
        block="arrays",
        column=rung,
        row=f"{nt}×{nr}",
        elements=(nt, nr),
        most_scenes=1 if rung in FEW else None,
        most_receivers=1 if rung in FEW else None,
    )


def convergence_settings(seeds: int) -> tuple[Setting, ...]:
    """Make settings of specular and diffuse paths over samples and seeds; the first one is the truth.

    Args:
        seeds: Seeds of the launch for each number of samples.
    """
    # Its seed is none of the others': rays in common would make errors look smaller.
    truth = _traced(TRUTH_SAMPLES, 3, launch_seed=0)
    made = [
        Setting(label=TRUTH, use=_SIONNA, settings=truth, block="convergence", most_scenes=CONVERGENCE_SCENES)
    ]
    for samples in CONVERGENCE_SAMPLES:
        for seed in range(1, seeds + 1):
            made.append(
                Setting(
                    label=f"siso-rt {_power(samples)} d3 seed {seed}",
                    use=_SIONNA,
                    most_scenes=CONVERGENCE_SCENES,
                    settings=_traced(samples, 3, launch_seed=seed),
                    block="convergence",
                    column="specular",
                    row=str(samples),
                )
            )
    for samples in DIFFUSE_SAMPLES:
        for seed in range(1, seeds + 1):
            made.append(
                Setting(
                    label=f"siso-rt {_power(samples)} d3 diffuse seed {seed}",
                    use=_SIONNA,
                    most_scenes=CONVERGENCE_SCENES,
                    settings=_traced(SPECULAR_BESIDE, 3, launch_seed=seed, **chosen_diffuse(samples)),
                    block="diffuse convergence",
                    column="diffuse",
                    row=str(samples),
                    scattering=True,
                )
            )
    return tuple(made)


def _power(number: int) -> str:
    """``3e5`` for 300,000."""
    exponent = len(str(number)) - 1
    return f"{number / 10**exponent:g}e{exponent}"


TRUTH = f"siso-rt {_power(TRUTH_SAMPLES)} d3 seed 0"
"""Label of what the convergence is measured against."""
