"""Contacts of a quadrotor, as a ball, with scenery, boxes, other balls and the ground, and what follows."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

from caviar_protocol.space.coordinates import Pose, Vector, dot, rotated, unrotated
from caviar_services.world.quadrotor.airframe import Body
from caviar_space.obstacles import Obstacles

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
