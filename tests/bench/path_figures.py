"""How far the paths of a channel are from those of a reference, and which of them blink."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from path_check import PathCheck
from path_reference import Path as Ray
from path_reference import absent

from caviar_protocol.arrays import Complex128Array
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import Scene
from caviar_services.channel.sionna.scene import SionnaScene

FIGURES = ("error", "gain", "beam")


def compared(
    found: list[list[Ray]], reference: list[list[Ray]], check: PathCheck, notes: list[str]
) -> list[dict[str, float]]:
    """Figures of each receiver that the reference reaches; what is lacking or more is noted."""
    rows = []
    for number, (paths, known) in enumerate(zip(found, reference, strict=True)):
        if not known:
            continue
        power = float((np.abs(h_of(known, paths)) ** 2).sum())
        extra, missing = absent(paths, known), absent(known, paths)
        row = against(paths, known)
        if row["error"] > 1e-5:
            notes.append(f"rx {number}: NMSE {_db(row['error']):.1f} dB")
            for path in paths:
                notes += [
                    f"  {10 * np.log10(path.power / power):.1f} dB, {len(path.points)} points, apart by "
                    f"{_db((np.abs(path.h - other.h) ** 2).sum() / path.power):.1f} dB"
                    for other in known
                    if path.is_same(other) and (np.abs(path.h - other.h) ** 2).sum() > 1e-5 * power
                ]
        judged = [(path, check(path.start, path.points, path.end)) for path in extra]
        for path, verdict in judged:
            row[f"extra_{verdict.word}"] += 1
            level = 10 * np.log10(path.power / power)
            notes.append(f"rx {number}: extra {level:.1f} dB, {len(path.points)} points: {verdict}")
        lost = [(path, check(path.start, path.points, path.end)) for path in missing]
        for path, verdict in lost:
            part = path.power / power
            row[f"missing_{verdict.word}"] = max(row[f"missing_{verdict.word}"], part)
            level = 10 * np.log10(part)
            notes.append(f"rx {number}: missing {level:.1f} dB, {len(path.points)} points: {verdict}")
        real = [path for path, verdict in judged if verdict.word == "real"]
        unreal = [path for path, verdict in lost if verdict.word != "real"]
        whole = against(paths, [*absent(known, unreal), *real])
        common = against(absent(paths, extra), absent(known, missing))
        row |= {f"all_{name}": whole[name] for name in FIGURES}
        rows.append(row | {f"common_{name}": common[name] for name in FIGURES})
    return rows


def h_of(paths: list[Ray], like: list[Ray]) -> Complex128Array:
    """Sum of what paths add to H."""
    return sum((path.h for path in paths), np.zeros((paths or like)[0].h.shape, np.complex128))


def against(paths: list[Ray], known: list[Ray]) -> dict[str, float]:
    """‖H − H_ref‖²/‖H_ref‖², error of the gain [dB], whether the best pair of DFT beams is one."""
    got, wanted = h_of(paths, known), h_of(known, paths)
    power = float((np.abs(wanted) ** 2).sum())
    best = [int(np.abs(np.fft.fft2(h)).argmax()) for h in (got, wanted)]
    words = ("real", "border", "wrong")
    return {
        "error": float((np.abs(got - wanted) ** 2).sum()) / power,
        "gain": abs(float(10 * np.log10(max(float((np.abs(got) ** 2).sum()), 1e-300) / power))),
        "beam": float(best[0] == best[1]),
        **{f"extra_{word}": 0.0 for word in words},
        **{f"missing_{word}": 0.0 for word in words},
    }


def described(rows: list[dict[str, float]]) -> dict[str, float]:
    """Figures of many receivers."""
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    told: dict[str, float] = {"receivers": len(rows)}
    for kind in ("", "all_", "common_"):
        error = columns[f"{kind}error"]
        told |= {
            f"{kind}nmse_db": _db(error.mean()),
            f"{kind}median_db": _db(np.median(error)),
            f"{kind}worst_db": _db(error.max()),
            f"{kind}within_20_db": float((error < 0.01).mean()),
            f"{kind}gain_error_db": float(np.median(columns[f"{kind}gain"])),
            f"{kind}best_beams": float(columns[f"{kind}beam"].mean()),
        }
    for word in ("real", "border", "wrong"):
        told[f"extra_{word}"] = float(columns[f"extra_{word}"].sum())
        told[f"missing_{word}_db"] = _db(columns[f"missing_{word}"].max())
    return told


def _db(power: float) -> float:
    return float(10 * np.log10(max(power, 1e-20)))


@dataclass(frozen=True)
class Seen:
    """What a channel made of a frame."""

    scene: Scene
    paths: list[list[Ray]]
    check: PathCheck
    names: tuple[str, ...]
    """Of the pieces of its scene."""


def blinking(scene: SionnaScene, one: Seen, other: Seen, notes: list[str]) -> int:
    """Paths of more than 1 % of a receiver's power in a frame that another lacks, though real there, too."""
    there = {
        (device.name, device.parent): number for number, device in enumerate(antennas(other.scene, "rx"))
    }
    count = 0
    for number, device in enumerate(antennas(one.scene, "rx")):
        also, paths = there.get((device.name, device.parent)), one.paths[number]
        if also is None or not other.paths[also]:
            continue
        power = float((np.abs(h_of(paths, paths)) ** 2).sum()) if paths else 0.0
        start, end = other.paths[also][0].start, other.paths[also][0].end
        for path in (path for path in paths if path.power > 0.01 * power):
            triangles = scene.moved_triangles(one.check.triangles(path.points), one.names, other.names)
            if (triangles < 0).any():
                continue
            points = other.check.mirrored_at(triangles, start, end)
            moved = Ray(start, points, end, path.h)
            if any(moved.is_same(known) for known in other.paths[also]):
                continue
            if np.isfinite(points).all() and other.check(start, points, end).word == "real":
                count += 1
                notes.append(f"rx {number}: {10 * np.log10(path.power / power):.1f} dB blinks")
    return count
