"""Places, headings and classes of SUMO as those of a scene.

SUMO gives the centre of the front bumper on the ground, a heading in degrees clockwise from north, and a
slope in degrees, positive uphill; a scene has the centre of the bounding box and angles counter-clockwise
from +x.

Steps of SUMO that fit the sampling period of a run and the spacing of its episodes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from caviar_protocol.errors import ScenarioError
from caviar_protocol.space.coordinates import Pose, Vector, quaternion_from_euler

_NS_PER_MS = 1_000_000
# SUMO's car-following models are made for steps up to one second.
_LONGEST_STEP_MS = 1000


def step_length_ms(sampling_period_ns: int, step_ms: int | None) -> int:
    """Choose SUMO's step for a sampling period. SUMO steps whole milliseconds.

    Args:
        sampling_period_ns: Sampling period of the run [ns].
        step_ms: The step that is asked for [ms]; None: the sampling period.

    Returns:
        [ms]

    Raises:
        ScenarioError: The sampling period is no whole number of steps; says what to write.

    Example:
        >>> step_length_ms(100_000_000, None), step_length_ms(100_000_000, 20)
        (100, 20)
    """
    period_ms, rest = divmod(sampling_period_ns, _NS_PER_MS)
    if rest:
        near = " or ".join(str(ms * _NS_PER_MS) for ms in (period_ms, period_ms + 1) if ms)
        raise ScenarioError(
            f"SUMO steps whole milliseconds, and {sampling_period_ns} ns is none; write {near}",
            key="run.sampling_period_ns",
        )
    step = period_ms if step_ms is None else step_ms
    if (step_ms is None and period_ms > _LONGEST_STEP_MS) or not 1 <= step <= period_ms or period_ms % step:
        fitting = max(
            n for n in range(1, min(period_ms, max(step, 1), _LONGEST_STEP_MS) + 1) if period_ms % n == 0
        )
        raise ScenarioError(
            f"a step of {step} ms does not fit the sampling period of {period_ms} ms; "
            f"write step_ms = {fitting}",
            key="settings.step_ms",
        )
    return step


def check_spacing(between_episodes_s: float, step_ms: int) -> None:
    """Check that episodes can begin so far apart in one traffic.

    Args:
        between_episodes_s: From the beginning of an episode to that of the next [s].
        step_ms: SUMO's step [ms].

    Raises:
        ScenarioError: It is not a whole number of steps, or none at all.

    Example:
        >>> check_spacing(30.0, 100)
    """
    ms = between_episodes_s * 1000.0
    if not 0 < ms < math.inf or abs(ms / step_ms - round(ms / step_ms)) > 1e-6:
        raise ScenarioError(
            f"{between_episodes_s} s is not a whole number of SUMO's steps of {step_ms} ms, at least one",
            key="settings.between_episodes_s",
        )


class Placement(NamedTuple):
    """How the road network lies in the scene: turned about its origin, then shifted.

    Example:
        >>> Placement((100.0, 0.0, 0.0)).yaw
        0.0
    """

    offset: Vector = (0.0, 0.0, 0.0)
    """[m]"""
    yaw: float = 0.0
    """[rad], counter-clockwise."""


class Heading(NamedTuple):
    """Where a body on the road points [rad].

    Example:
        >>> Heading(0.0, 0.0).forward
        (1.0, 0.0, 0.0)
    """

    yaw: float
    slope: float

    @property
    def forward(self) -> Vector:
        """Unit vector out of the nose."""
        horizontal = math.cos(self.slope)
        return (math.cos(self.yaw) * horizontal, math.sin(self.yaw) * horizontal, math.sin(self.slope))

    @property
    def up(self) -> Vector:
        """Unit vector out of the roof."""
        horizontal = -math.sin(self.slope)
        return (math.cos(self.yaw) * horizontal, math.sin(self.yaw) * horizontal, math.cos(self.slope))


def heading(angle_deg: float, slope_deg: float, placement: Placement) -> Heading:
    """Convert a direction of SUMO: yaw = 90° − angle, turned with the network.

    Args:
        angle_deg: SUMO's angle, clockwise from north [°].
        slope_deg: SUMO's slope, positive uphill [°].
        placement: How the network lies in the scene.

    Example:
        >>> heading(90.0, 0.0, Placement())  # eastwards is +x
        Heading(yaw=0.0, slope=0.0)
    """
    return Heading(math.radians(90.0 - angle_deg) + placement.yaw, math.radians(slope_deg))


def body_pose(bumper: Vector, towards: Heading, length: float, height: float, placement: Placement) -> Pose:
    """Pose of the bounding box of a body, which SUMO places by its front bumper.

    Args:
        bumper: Centre of the front bumper on the ground, in SUMO's coordinates [m].
        towards: Where the body points in the scene.
        length: Of the body [m].
        height: Of the body [m].
        placement: How the network lies in the scene.

    Example:
        >>> body_pose((10.0, 0.0, 0.0), Heading(0.0, 0.0), 4.0, 1.5, Placement()).position
        (8.0, 0.0, 0.75)
    """
    c, s = math.cos(placement.yaw), math.sin(placement.yaw)
    x, y, z = bumper
    dx, dy, dz = placement.offset
    front = (c * x - s * y + dx, s * x + c * y + dy, z + dz)
    fx, fy, fz = towards.forward
    ux, uy, uz = towards.up
    back, rise = length / 2, height / 2
    position = (
        front[0] - back * fx + rise * ux,
        front[1] - back * fy + rise * uy,
        front[2] - back * fz + rise * uz,
    )
    # Positive pitch lowers the nose, a positive slope lifts it.
    return Pose(position, quaternion_from_euler(towards.yaw, -towards.slope))


_CLASS_OF: dict[str, str] = {
    "aircraft": "uav",
    "bicycle": "bicycle",
    "bus": "bus",
    "cable_car": "train",
    "coach": "bus",
    "container": "container",
    "delivery": "truck",
    "drone": "uav",
    "moped": "motorcycle",
    "motorcycle": "motorcycle",
    "pedestrian": "pedestrian",
    "rail": "train",
    "rail_electric": "train",
    "rail_fast": "train",
    "rail_urban": "train",
    "scooter": "bicycle",
    "ship": "ship",
    "subway": "train",
    "trailer": "truck",
    "tram": "train",
    "truck": "truck",
    "wheelchair": "pedestrian",
}


def object_class(type_id: str, vehicle_class: str, chosen: dict[str, str]) -> str:
    """Find the class of an object: as chosen for its vehicle type or its vClass, else by its vClass.

    A vClass that is not in the table drives on roads and is a ``car``.

    Args:
        type_id: SUMO's vehicle type.
        vehicle_class: SUMO's vClass.
        chosen: Class by vehicle type or vClass, which goes before the table.

    Example:
        >>> object_class("Lorry@17", "passenger", {"Lorry": "truck"}), object_class("t", "coach", {})
        ('truck', 'bus')
    """
    base_type = type_id.partition("@")[0]  # SUMO appends @VEHICLE to a type changed for one vehicle
    for key in (base_type, vehicle_class):
        if key in chosen:
            return chosen[key]
    return _CLASS_OF.get(vehicle_class, "car")


def distance_to_line(point: complex, line: Sequence[complex]) -> float:
    """Distance of a place from a line of straight pieces, both as x + jy [m].

    Args:
        point: The place.
        line: Ends of the pieces, at least two.

    Example:
        >>> distance_to_line(5 + 2j, [0j, 10 + 0j, 10 + 10j])
        2.0
    """
    distances = []
    for start, end in pairwise(line):
        along = end - start
        share = ((point - start) * along.conjugate()).real / abs(along) ** 2 if along else 0.0
        distances.append(abs(point - start - min(max(share, 0.0), 1.0) * along))
    return min(distances)
