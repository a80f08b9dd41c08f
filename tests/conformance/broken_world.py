"""What the world of `broken_client` publishes: two cars that drive, with the devices of WELCOME.

Nothing but msgpack; the arithmetic of SPEC.md, written a second time.
"""

from __future__ import annotations

import math
import struct
from typing import Any

import msgpack

SIZE = (4.6, 1.9, 1.5)
MOUNT = {"centre": 0.0, "roof": 0.5, "floor": -0.5}


def scene(name: str, specs: list[dict[str, Any]], frame: int, fault: str) -> tuple[bytes, bytes]:
    """Header and body of the scene of a frame; ``fault`` is what is wrong with it, if anything here is."""
    names = [f"{name}.car.1", f"{name}.car.2"]
    arrays = {
        "position": [[-12.0 + 0.9 * frame, 4.0, 0.75], [30.0, -4.0 - 0.7 * frame, 0.75]],
        "orientation": [[math.cos(0.1 * frame), 0.0, 0.0, math.sin(0.1 * frame)], [1.0, 0.0, 0.0, 0.0]],
        "velocity": [[9.0, 0.0, 0.0], [0.0, -7.0, 0.0]],
        "dimensions": [list(SIZE), list(SIZE)],
        "angular_velocity": [[0.0, 0.0, 2.0], [0.0, 0.0, 0.0]],  # frames are 0.1 s apart
    }
    assets = ["", ""]
    devices = [found for spec in specs for found in _devices(spec, names, frame, fault)]
    match fault:
        case "publishes quaternions of length 2":
            arrays["orientation"][1][0] = 2.0
        case "publishes quaternions of zeros":
            arrays["orientation"][1][0] = 0.0
        case "publishes NaN":
            arrays["position"][0][2] = math.nan
        case "publishes cars that are faster than light":
            arrays["velocity"][0][0] = 3e8
        case "turns the other way":
            arrays["angular_velocity"][0][2] = -2.0
        case "gives degrees per second":
            arrays["angular_velocity"][0][2] = math.degrees(2.0)
        case "publishes negative dimensions":
            arrays["dimensions"][1][1] = -1.9
        case "publishes flat boxes":
            arrays["dimensions"][1][2] = 0.0
        case "does not sort names":
            names.reverse()
        case "publishes a name twice":
            names[1] = names[0]
        case "forgets its prefixes":
            names = [f"anothers.{tail}" for tail in ("car.1", "car.2")]
            devices = [d for d in devices if not d.get("parent")]
        case "names meshes that it did not offer":
            assets[0] = "objects/car.ply"
        case "publishes no devices":
            devices = []
        case "mounts devices on absent objects":
            absent = f"{name}.car.9"
            devices.append({"type": "antenna", "name": f"{absent}/rx", "parent": absent, "role": "rx"})
    if fault != "does not sort devices":
        devices.sort(key=lambda device: str(device["name"]).encode())
    header: dict[str, Any] = {"names": names, "classes": ["car", "car"], "assets": assets}
    body = b""
    for field, rows in arrays.items():
        if field == "angular_velocity" and devices:
            header["devices"] = devices
        header[field] = {"dtype": "<f8", "shape": [2, len(rows[0])], "offset": len(body)}
        body += struct.pack(f"<{2 * len(rows[0])}d", *rows[0], *rows[1])
    return msgpack.packb(header), body


def _devices(spec: dict[str, Any], names: list[str], frame: int, fault: str) -> list[dict[str, Any]]:
    """The devices that come of one entry of WELCOME's list, whose ``on`` is empty or ``*`` here."""
    if not spec.get("on"):
        return [_device(spec, "", 0.0, fault)]
    count = spec.get("count", 1)
    carriers = names[:count]
    if fault == "hands devices around" and frame % 2:
        carriers = names[-count:]
    if fault == "passes over count":
        carriers = names
    return [_device(spec, name, SIZE[2], fault) for name in carriers]


def _device(spec: dict[str, Any], parent: str, height: float, fault: str) -> dict[str, Any]:
    """One device, its fields in the order of SPEC.md and without those that equal their default."""
    x, y, z = spec.get("position_m", (0.0, 0.0, 0.0))
    position = [x, y, z + MOUNT[spec.get("mount", "centre")] * height]
    if fault == "ignores mounts":
        position = [x, y, z]
    if fault == "mounts on the roof what is on the floor":
        position = [x, y, z + abs(MOUNT[spec.get("mount", "centre")]) * height]
    if fault == "takes the array of another device":
        spec = spec | {"array": {"columns": 3}}
    device: dict[str, Any] = {
        "type": spec["kind"],
        "name": f"{parent}/{spec['name']}" if parent else spec["name"],
    }
    if parent:
        device["parent"] = parent
    if any(position):
        device["position"] = position
    orientation = _orientation(spec, fault)
    if orientation != [1.0, 0.0, 0.0, 0.0]:
        device["orientation"] = orientation
    if fault == "publishes devices with quaternions of length 2":
        device["orientation"] = [2.0, 0.0, 0.0, 0.0]
    match spec["kind"]:
        case "antenna":
            device["role"] = spec["role"]
            array = _array(spec.get("array") or {}, fault)
            if array:
                device["array"] = array
            if spec.get("power_dbm"):
                device["power_dbm"] = float(spec["power_dbm"])
        case "lidar":
            device |= {"beams": spec["beams"], "azimuth_steps": spec["azimuth_steps"]}
            low, high = (math.radians(angle) for angle in spec.get("elevation_deg", (-25.0, 3.0)))
            if low != math.radians(-25.0):
                device["elevation_min"] = low
            if high != math.radians(3.0):
                device["elevation_max"] = high
        case "camera":
            device["width"], device["height"] = spec["size_px"]
    return device


def _array(spec: dict[str, Any], fault: str) -> dict[str, Any]:
    """An array in the order of SPEC.md, without what equals its default."""
    found: dict[str, Any] = {key: spec[key] for key in ("rows", "columns") if spec.get(key, 1) != 1}
    if spec.get("polarization", "V") != "V" and fault != "drops dual polarizations":
        found["polarization"] = spec["polarization"]
    if spec.get("pattern_file") and fault != "drops pattern files":
        found["pattern_file"] = f"patterns/{spec['pattern_file'].rpartition('/')[2]}"
    if spec.get("panels") and fault != "drops panels":
        found["panels"] = [
            {key: n for key, n in panel.items() if n not in (0.0, [0.0] * 3)} for panel in spec["panels"]
        ]
    return found


def _orientation(spec: dict[str, Any], fault: str) -> list[float]:
    """The quaternion of intrinsic z–y′–x″ rotations, by the formulas of SPEC.md."""
    yaw, pitch, roll = (math.radians(spec.get(f"{angle}_deg", 0.0)) for angle in ("yaw", "pitch", "roll"))
    match fault:
        case "doubles yaw":
            yaw *= 2
        case "lifts the nose where it is to be lowered":
            pitch = -pitch
        case "ignores roll":
            roll = 0.0
        case "forgets to convert degrees":
            yaw, pitch, roll = (math.degrees(angle) for angle in (yaw, pitch, roll))
    cy, cp, cr = (math.cos(angle / 2) for angle in (yaw, pitch, roll))
    sy, sp, sr = (math.sin(angle / 2) for angle in (yaw, pitch, roll))
    return [
        cy * cp * cr + sy * sp * sr,
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
    ]
