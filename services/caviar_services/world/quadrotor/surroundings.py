"""Wind: a mean velocity, and gusts of the Dryden spectra at low altitude.

MIL-F-8785C, "Flying Qualities of Piloted Airplanes" (1980), section 3.7.1.2 (Dryden form of the spectra) and
section 3.7.3 (low altitude). With the height h [ft], the wind speed W₂₀ at 20 ft and spatial frequencies
Ω [rad/m]:

    L_w = h,   L_u = L_v = h / (0.177 + 0.000823·h)^1.2          10 ft ≤ h ≤ 1000 ft
    σ_w = 0.1·W₂₀,   σ_u = σ_v = σ_w / (0.177 + 0.000823·h)^0.4
    Φ_u(Ω) = σ_u²·(2·L_u/π) / (1 + (L_u·Ω)²)
    Φ_v(Ω) = σ_v²·(L_v/π)·(1 + 3·(L_v·Ω)²) / (1 + (L_v·Ω)²)²,   Φ_w likewise

u lies along the mean wind, v across it to the left, w upwards. The field is frozen: at the speed V against
the mean wind, Ω is a frequency of Ω·V. Filters of white noise with these spectra,

    H_u(s) = σ_u·√(2·T_u) / (1 + T_u·s),   H_v(s) = σ_v·√T_v·(1 + √3·T_v·s) / (1 + T_v·s)²,   T = L/V,

are integrated in closed form over a step, so that variances do not depend on its length.

Contacts of a quadrotor, as a ball, with scenery, boxes, other balls and the ground, and what follows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple, TypeAlias

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.space.coordinates import Pose, Vector, dot, rotated, unrotated
from caviar_services.world.quadrotor.airframe import Body
from caviar_space.obstacles import Obstacles

_FOOT = 0.3048

# Heights [ft] between which the low-altitude model holds.
_LOW, _HIGH = 10.0, 1000.0

# [m/s]; a UAV that drifts with the wind would meet no gust ever again.
_SLOWEST = 1.0

_ROOT3 = math.sqrt(3.0)

# Below this step over the time constant T, differences of the closed form lose more digits than its series.
_SHORT = 1e-3

NOISES = 5
"""Numbers of unit variance that a step of `Gusts` takes."""


WindSpeed: TypeAlias = Annotated[
    float, quantity("m/s", "velocity along an axis; no gust on Earth was faster", ge=-150, le=150)
]
"""The strongest gust that was measured had 113 m/s (WMO, Barrow Island 1996)."""


class Wind(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The air that a quadrotor flies in.

    Example:
        >>> Wind(velocity_m_s=(3.0, 4.0, 0.0), gusts="dryden").speed_6m
        5.0
    """

    velocity_m_s: tuple[WindSpeed, WindSpeed, WindSpeed] = (0.0, 0.0, 0.0)
    """Mean velocity of the air in world axes: where the wind blows to."""
    gusts: Literal["none", "dryden"] = "none"
    """``dryden``: gusts after MIL-F-8785C at low altitude, drawn by seed."""
    speed_6m_m_s: (
        Annotated[float, quantity("m/s", "mean wind speed 20 ft above ground, which scales gusts", ge=0)]
        | None
    ) = None
    """7.7 is light, 15.4 moderate and 23.2 severe turbulence; unset: the speed of the mean wind."""

    @property
    def speed_6m(self) -> float:
        """`speed_6m_m_s`, or what stands for it [m/s]."""
        if self.speed_6m_m_s is not None:
            return self.speed_6m_m_s
        return math.hypot(*self.velocity_m_s)


def scales(height_m: float, speed_6m: float) -> tuple[float, float, float, float]:
    """Scale lengths and standard deviations of gusts.

    Args:
        height_m: Above ground [m]; outside of 10 ft to 1000 ft, the nearer of the two counts.
        speed_6m: Mean wind speed at 20 ft [m/s].

    Returns:
        L_u = L_v and L_w [m], σ_u = σ_v and σ_w [m/s].

    Example:
        >>> [round(value, 2) for value in scales(30.48, 15.4)]  # 100 ft
        [153.98, 30.48, 2.64, 1.54]
    """
    h = min(max(height_m / _FOOT, _LOW), _HIGH)
    base = 0.177 + 0.000823 * h
    vertical = 0.1 * speed_6m
    return h / base**1.2 * _FOOT, h * _FOOT, vertical / base**0.4, vertical


class Gusts:
    """The gust at one body, step by step.

    Args:
        wind: Of which the gusts are.

    Example:
        >>> gusts = Gusts(Wind(velocity_m_s=(8.0, 0.0, 0.0), gusts="dryden"))
        >>> gusts.step((0.0, 0.0, 30.0), (0.0, 0.0, 0.0), [1.0, 0.0, 0.0, 0.0, 0.0], 0.01)[0] > 0.0
        True
    """

    def __init__(self, wind: Wind) -> None:
        self._wind = wind
        x, y, _ = wind.velocity_m_s
        speed = math.hypot(x, y)
        self._along = (x / speed, y / speed) if speed else (1.0, 0.0)
        # Outputs of the filters with unit variance: u; two states each of v and w.
        self.state: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
        """Of the filters; stationary with variances 1, ½, ¼, ½, ¼."""

    def reset(self, noises: Sequence[float]) -> None:
        """Begin with a state drawn from the stationary distribution.

        Args:
            noises: Independent normal numbers of unit variance.
        """
        a, b, c, d, e = noises
        # Of the two states of v the covariance is [[½, ¼], [¼, ¼]]: Cholesky factors √½, √⅛, √⅛.
        root = math.sqrt(0.125)
        self.state = (a, 2.0 * root * b, root * (b + c), 2.0 * root * d, root * (d + e))

    def step(self, position: Vector, velocity: Vector, noises: Sequence[float], length: float) -> Vector:
        """Advance the filters and give the gust.

        Args:
            position: Of the body [m]; its z counts as height above ground.
            velocity: Of the body [m/s].
            noises: Independent normal numbers of unit variance.
            length: Of the step [s].

        Returns:
            Velocity to be added to the mean wind [m/s], in world axes.
        """
        wx, wy, wz = self._wind.velocity_m_s
        vx, vy, vz = velocity
        speed = max(math.sqrt((vx - wx) ** 2 + (vy - wy) ** 2 + (vz - wz) ** 2), _SLOWEST)
        long, tall, sigma, sigma_w = scales(position[2], self._wind.speed_6m)
        way = speed * length
        u, v1, v2, w1, w2 = self.state
        kept = math.exp(-way / long)
        u = kept * u + math.sqrt(1.0 - kept * kept) * noises[0]
        v1, v2 = _second_order(v1, v2, way / long, noises[1], noises[2])
        w1, w2 = _second_order(w1, w2, way / tall, noises[3], noises[4])
        self.state = (u, v1, v2, w1, w2)
        gu, gv = sigma * u, sigma * (_ROOT3 * v1 + (1.0 - _ROOT3) * v2)
        cx, cy = self._along
        return (cx * gu - cy * gv, cy * gu + cx * gv, sigma_w * (_ROOT3 * w1 + (1.0 - _ROOT3) * w2))


def _second_order(a: float, b: float, d: float, n: float, m: float) -> tuple[float, float]:
    """One step of da = −a·dτ + dW, db = (a − b)·dτ over τ = d, with two normal numbers."""
    decay = math.exp(-d)
    # Covariance of what the noise adds: ∫ e^(−2s)·[1, s; s, s²] ds from 0 to d, as its Cholesky factor.
    if d < _SHORT:
        first = math.sqrt(d)
        cross, second = 0.5 * d * first, d * first / math.sqrt(12.0)
    else:
        square = decay * decay
        p = 0.5 * (1.0 - square)
        q = 0.25 * (1.0 - square * (1.0 + 2.0 * d))
        r = 0.25 * (1.0 - square * (1.0 + 2.0 * d + 2.0 * d * d))
        first = math.sqrt(p)
        cross = q / first
        second = math.sqrt(max(r - cross * cross, 0.0))
    return decay * a + first * n, decay * (b + d * a) + cross * n + second * m


OnCollision = Literal["stop", "bounce", "land", "fall", "ignore"]

SCENERY, GROUND = "scenery", "ground"
"""What a contact that is with no object is with."""


class Contact(NamedTuple):
    """Where a ball touches something.

    Example:
        >>> Contact("scenery", (0.0, 0.0, 1.0), 0.02).velocity
        (0.0, 0.0, 0.0)
    """

    what: str
    """``scenery``, ``ground``, or the name of an object."""
    normal: Vector
    """Unit vector away from it."""
    depth: float
    """How far the ball is in it [m]."""
    velocity: Vector = (0.0, 0.0, 0.0)
    """Of the thing that is touched [m/s]."""


def scenery_contact(obstacles: Obstacles, position: Vector, radius: float) -> Contact | None:
    """Contact with the nearest triangle.

    Args:
        obstacles: The scenery.
        position: Centre of the ball [m].
        radius: Of the ball [m].
    """
    found = obstacles.touched(position, radius)
    if found is None:
        return None
    distance, normal = found
    return Contact(SCENERY, normal, radius - distance)


def box_contact(
    what: str, box: Pose, dimensions: Vector, velocity: Vector, position: Vector, radius: float
) -> Contact | None:
    """Contact with the bounding box of an object (Ericson, "Real-Time Collision Detection", section 5.1.4).

    Args:
        what: Name of the object.
        box: Centre [m] and orientation.
        dimensions: Length, width and height [m].
        velocity: Of the object [m/s].
        position: Centre of the ball [m].
        radius: Of the ball [m].

    Example:
        >>> level = Pose((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
        >>> box_contact("van", level, (4.0, 2.0, 2.0), (0.0, 0.0, 0.0), (2.25, 0.0, 1.0), 0.5)[1:3]
        ((1.0, 0.0, 0.0), 0.25)
    """
    x, y, z = (a - b for a, b in zip(position, box.position, strict=True))
    reach = radius + 0.5 * math.hypot(*dimensions)
    if x * x + y * y + z * z > reach * reach:
        return None
    local = unrotated(box.orientation, (x, y, z))
    half = [0.5 * side for side in dimensions]
    gap = [a - max(-h, min(h, a)) for a, h in zip(local, half, strict=True)]
    distance = math.sqrt(gap[0] ** 2 + gap[1] ** 2 + gap[2] ** 2)
    if distance >= radius:
        return None
    if distance > 0.0:
        normal, depth = [g / distance for g in gap], radius - distance
    else:  # the centre is inside: out by the nearest face
        rooms = [h - abs(a) for a, h in zip(local, half, strict=True)]
        axis = rooms.index(min(rooms))
        normal = [math.copysign(1.0, local[i]) if i == axis else 0.0 for i in range(3)]
        depth = radius + rooms[axis]
    return Contact(what, rotated(box.orientation, normal), depth, velocity)


def ball_contact(
    what: str, other: Vector, other_radius: float, velocity: Vector, position: Vector, radius: float
) -> Contact | None:
    """Contact of two balls.

    Args:
        what: Name of the other one.
        other: Its centre [m].
        other_radius: Its radius [m].
        velocity: Of the other one [m/s].
        position: Centre of the ball [m].
        radius: Of the ball [m].
    """
    x, y, z = (a - b for a, b in zip(position, other, strict=True))
    distance = math.sqrt(x * x + y * y + z * z)
    depth = radius + other_radius - distance
    if depth <= 0.0:
        return None
    normal = (x / distance, y / distance, z / distance) if distance else (0.0, 0.0, 1.0)
    return Contact(what, normal, depth, velocity)


def answered(body: Body, contact: Contact, restitution: float, *, stops: bool) -> Body:
    """The body after a contact: out of what it touches, with no speed into it.

    Args:
        body: As it came.
        contact: What it touches.
        restitution: Speed away from it over the speed into it, 0 to 1.
        stops: Whether it takes the velocity of what it touches, and ceases to turn.

    Example:
        >>> wall = Contact("scenery", (-1.0, 0.0, 0.0), 0.1)
        >>> answered(Body((5.0, 0.0, 9.0), (4.0, 1.0, 0.0)), wall, 0.5, stops=False).velocity
        (-2.0, 1.0, 0.0)
    """
    n, v, u = contact.normal, body.velocity, contact.velocity
    depth = contact.depth
    x, y, z = (a + depth * b for a, b in zip(body.position, n, strict=True))
    position = (x, y, z)
    into = dot((v[0] - u[0], v[1] - u[1], v[2] - u[2]), n)
    if into >= 0.0:
        return body._replace(position=position)
    if stops:
        return body._replace(position=position, velocity=u, rates=(0.0, 0.0, 0.0))
    push = -(1.0 + restitution) * into
    velocity = (v[0] + push * n[0], v[1] + push * n[1], v[2] + push * n[2])
    return body._replace(position=position, velocity=velocity)
