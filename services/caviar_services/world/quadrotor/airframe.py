"""A quadrotor as a rigid body: four rotors with lag, drag against the air, and the power that it takes.

Body axes are x forward, y left, z up; the rotors stand in an X. With the rotor speeds ωᵢ [rad/s]
(Mahony, Kumar and Corke, "Multirotor Aerial Vehicles", IEEE Robotics & Automation Magazine 19(3), 2012):

    m·v̇ = −m·g·e₃ + R·(Σ c_T·ωᵢ²·e₃ + F),   q̇ = ½ q ⊗ (0, Ω),   J·Ω̇ = −Ω × J·Ω + M,   ω̇ᵢ = (uᵢ − ωᵢ)/τ

The force F of the air, in body axes, follows from the velocity u against the air: linear, of the rotors
(Faessler, Franchi and Scaramuzza, "Differential Flatness of Quadrotor Dynamics Subject to Rotor Drag", IEEE
Robotics and Automation Letters 3(2), 2018), and quadratic, of the body: Fⱼ = −dⱼ·uⱼ − ½·ρ·Aⱼ·|u|·uⱼ.

The rotors turn by turns: seen from above, front left and rear right clockwise, so that the torque of the air
on them turns the body counter-clockwise.
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, NamedTuple

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.errors import DeclarationError, suggestion
from caviar_protocol.plugins import plugin_class, plugins
from caviar_protocol.space.coordinates import UnitQuaternion, Vector

PLANTS = "caviar.plants"
"""Group of entry points, each a subclass of `Plant`, named as ``engine`` has it."""
GRAVITY = 9.80665
"""Standard acceleration of free fall [m/s²]."""

AIR_DENSITY = 1.225
"""At sea level [kg/m³] (ISO 2533)."""

Rotors = tuple[float, float, float, float]
"""A number for each rotor: front left, rear left, rear right, front right."""


NonNegative = Annotated[float, msgspec.Meta(ge=0)]


class Airframe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Mass, rotors and drag of a quadrotor.

    The defaults have the weight (20 N), the disc area of all rotors (0.5 m²), the tip speed (120 m/s) and,
    in hover, the shaft power (168 W) of the rotary-wing UAV of Zeng, Xu and Zhang (2019), table I.

    Example:
        >>> round(Airframe().hover_speed)  # rad/s
        600
    """

    mass_kg: Annotated[float, quantity("kg", "with battery and payload", gt=0)] = 2.04
    inertia_kg_m2: tuple[
        Annotated[float, msgspec.Meta(gt=0)],
        Annotated[float, msgspec.Meta(gt=0)],
        Annotated[float, msgspec.Meta(gt=0)],
    ] = (0.03, 0.03, 0.05)
    """Principal moments of inertia about x, y and z."""
    arm_m: Annotated[float, quantity("m", "from the centre to the axis of a rotor", gt=0)] = 0.3
    thrust_n_s2: Annotated[float, quantity("N·s²", "thrust of a rotor over its squared speed", gt=0)] = (
        1.389e-5
    )
    torque_n_m_s2: Annotated[float, quantity("N·m·s²", "torque of a rotor over its squared speed", gt=0)] = (
        1.95e-7
    )
    max_rotor_rad_s: Annotated[float, quantity("rad/s", "greatest speed of a rotor", gt=0)] = 850.0
    rotor_lag_s: Annotated[float, quantity("s", "time constant of the speed of a rotor", gt=0)] = 0.03
    linear_drag_n_s_m: tuple[NonNegative, NonNegative, NonNegative] = (0.3, 0.3, 0.1)
    """Drag of the rotors over the speed against the air, along the body's x, y and z."""
    drag_area_m2: tuple[NonNegative, NonNegative, NonNegative] = (0.015, 0.015, 0.03)
    """Drag coefficient times area, along the body's x, y and z."""

    @property
    def hover_speed(self) -> float:
        """Speed of each rotor at which the thrust is the weight [rad/s]."""
        return math.sqrt(self.mass_kg * GRAVITY / (4.0 * self.thrust_n_s2))

    @property
    def thrust_ratio(self) -> float:
        """Greatest thrust over the weight."""
        return (self.max_rotor_rad_s / self.hover_speed) ** 2


class Body(NamedTuple):
    """Pose of a rigid body, and its motion.

    Example:
        >>> Body((0.0, 0.0, 30.0)).velocity
        (0.0, 0.0, 0.0)
    """

    position: Vector
    """[m]"""
    velocity: Vector = (0.0, 0.0, 0.0)
    """[m/s], world axes."""
    orientation: UnitQuaternion = (1.0, 0.0, 0.0, 0.0)
    """Body to world."""
    rates: Vector = (0.0, 0.0, 0.0)
    """Angular velocity [rad/s], body axes."""


class Plant:
    """Moves the rigid body and its rotors by steps of time.

    Plain numbers, no arrays: for 17 of them a NumPy call costs more than the arithmetic.

    Args:
        airframe: What the quadrotor is made of.
        gravity: [m/s²]

    Example:
        >>> airframe = Airframe()
        >>> plant, level = Plant(airframe), (airframe.hover_speed,) * 4
        >>> body, _, work = plant.advance(Body((0.0, 0.0, 30.0)), level, level, (0.0, 0.0, 0.0), 0.002)
        >>> round(body.position[2], 9), round(work / 0.002)  # it hovers, with 169 W
        (30.0, 169)
    """

    extra: ClassVar[str] = ""
    """Extra of the distribution that brings its libraries, as `Service.extra`."""
    packages: ClassVar[tuple[str, ...]] = ()
    """Distributions whose versions may change a flight, as `Service.packages`."""

    def __init__(self, airframe: Airframe, gravity: float = GRAVITY) -> None:
        self.airframe = airframe
        self._gravity = gravity
        self._inverse_mass = 1.0 / airframe.mass_kg
        self._side = airframe.arm_m * math.sqrt(0.5)
        self._linear = airframe.linear_drag_n_s_m
        self._quadratic = tuple(0.5 * AIR_DENSITY * area for area in airframe.drag_area_m2)
        jx, jy, jz = airframe.inertia_kg_m2
        self._inertia = (jx, jy, jz)

    def advance(
        self, body: Body, speeds: Rotors, commands: Rotors, air: Vector, h: float
    ) -> tuple[Body, Rotors, float]:
        """Integrate over one step: rotors in closed form, the body by the classical Runge–Kutta method.

        Args:
            body: At the beginning.
            speeds: Of the rotors at the beginning [rad/s].
            commands: Speeds that the rotors strive for in the step [rad/s].
            air: Velocity of the air [m/s].
            h: The step [s].

        Returns:
            Body and rotor speeds at the end, and the work at the rotors' shafts [J].
        """
        left = math.exp(-0.5 * h / self.airframe.rotor_lag_s)
        middle = lagged(speeds, commands, left)
        end = lagged(middle, commands, left)
        w0, w1, w2 = self.wrench(speeds), self.wrench(middle), self.wrench(end)
        v, q, o = body.velocity, body.orientation, body.rates
        derivative, half = self._derivative, 0.5 * h
        a1, d1, e1 = derivative(v, q, o, w0, air)
        v2, q2, o2 = _plus3(v, a1, half), _plus4(q, d1, half), _plus3(o, e1, half)
        a2, d2, e2 = derivative(v2, q2, o2, w1, air)
        v3, q3, o3 = _plus3(v, a2, half), _plus4(q, d2, half), _plus3(o, e2, half)
        a3, d3, e3 = derivative(v3, q3, o3, w1, air)
        v4, q4, o4 = _plus3(v, a3, h), _plus4(q, d3, h), _plus3(o, e3, h)
        a4, d4, e4 = derivative(v4, q4, o4, w2, air)
        sixth = h / 6.0
        w, x, y, z = (q[i] + sixth * (d1[i] + 2.0 * (d2[i] + d3[i]) + d4[i]) for i in (0, 1, 2, 3))
        # The method keeps the norm to the order of its error alone.
        scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
        moved = Body(
            _mean3(body.position, v, v2, v3, v4, sixth),
            _mean3(v, a1, a2, a3, a4, sixth),
            (scale * w, scale * x, scale * y, scale * z),
            _mean3(o, e1, e2, e3, e4, sixth),
        )
        work = sixth * (w0[4] + 4.0 * w1[4] + w2[4])
        return moved, end, work

    def wrench(self, speeds: Rotors) -> tuple[float, float, float, float, float]:
        """Thrust [N], moments about x, y and z [N·m], and shaft power [W].

        Args:
            speeds: Of the rotors [rad/s].
        """
        a, b, c, d = speeds
        aa, bb, cc, dd = a * a, b * b, c * c, d * d
        k, side = self.airframe.thrust_n_s2, self._side
        drag = self.airframe.torque_n_m_s2
        return (
            k * (aa + bb + cc + dd),
            k * side * (aa + bb - cc - dd),
            k * side * (bb + cc - aa - dd),
            drag * (aa - bb + cc - dd),
            drag * (aa * a + bb * b + cc * c + dd * d),
        )

    def _derivative(
        self,
        velocity: Vector,
        q: UnitQuaternion,
        rates: Vector,
        wrench: tuple[float, float, float, float, float],
        air: Vector,
    ) -> tuple[Vector, UnitQuaternion, Vector]:
        """Acceleration [m/s²], derivative of the quaternion [1/s], angular acceleration [rad/s²]."""
        w, x, y, z = q
        o, p, r = rates
        xx, yy, zz = x * x, y * y, z * z
        xy, xz, yz, wx, wy, wz = x * y, x * z, y * z, w * x, w * y, w * z
        # Rows of R for the body's axes: R = [r00 r01 r02; …].
        r00, r01, r02 = 1.0 - 2.0 * (yy + zz), 2.0 * (xy - wz), 2.0 * (xz + wy)
        r10, r11, r12 = 2.0 * (xy + wz), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - wx)
        r20, r21, r22 = 2.0 * (xz - wy), 2.0 * (yz + wx), 1.0 - 2.0 * (xx + yy)
        ux, uy, uz = velocity[0] - air[0], velocity[1] - air[1], velocity[2] - air[2]
        speed = math.sqrt(ux * ux + uy * uy + uz * uz)
        lx, ly, lz = self._linear
        sx, sy, sz = self._quadratic
        scale = self._inverse_mass
        fx = -scale * (lx + sx * speed) * (r00 * ux + r10 * uy + r20 * uz)
        fy = -scale * (ly + sy * speed) * (r01 * ux + r11 * uy + r21 * uz)
        fz = scale * (wrench[0] - (lz + sz * speed) * (r02 * ux + r12 * uy + r22 * uz))
        jx, jy, jz = self._inertia
        return (
            (
                r00 * fx + r01 * fy + r02 * fz,
                r10 * fx + r11 * fy + r12 * fz,
                r20 * fx + r21 * fy + r22 * fz - self._gravity,
            ),
            (
                -0.5 * (x * o + y * p + z * r),
                0.5 * (w * o + y * r - z * p),
                0.5 * (w * p + z * o - x * r),
                0.5 * (w * r + x * p - y * o),
            ),
            (
                (wrench[1] + (jy - jz) * p * r) / jx,
                (wrench[2] + (jz - jx) * r * o) / jy,
                (wrench[3] + (jx - jy) * o * p) / jz,
            ),
        )


def plant_named(engine: str) -> type[Plant]:
    """Find what moves rigid bodies: `Plant` for ``caviar``, else a plug-in of the group ``caviar.plants``.

    Raises:
        DeclarationError: No plug-in has the name, or it is no `Plant`.

    Example:
        >>> plant_named("caviar").__name__
        'Plant'
    """
    found = Plant if engine == "caviar" else plugin_class(PLANTS, engine, Plant)
    if found is None:
        raise DeclarationError(f"is {engine!r}; {suggestion(engine, ['caviar', *plugins(PLANTS)])}")
    return found


def lagged(speeds: Rotors, commands: Rotors, left: float) -> Rotors:
    """Rotor speeds after some time.

    Args:
        speeds: Before [rad/s].
        commands: What they strive for [rad/s].
        left: Share of the distance between them that is left after the time.

    Example:
        >>> lagged((600.0,) * 4, (700.0,) * 4, 0.5)[0]
        650.0
    """
    a, b, c, d = speeds
    i, j, k, n = commands
    return (i + (a - i) * left, j + (b - j) * left, k + (c - k) * left, n + (d - n) * left)


def _plus3(a: Vector, b: Vector, h: float) -> Vector:
    return (a[0] + h * b[0], a[1] + h * b[1], a[2] + h * b[2])


def _plus4(a: UnitQuaternion, b: UnitQuaternion, h: float) -> UnitQuaternion:
    return (a[0] + h * b[0], a[1] + h * b[1], a[2] + h * b[2], a[3] + h * b[3])


def _mean3(start: Vector, a: Vector, b: Vector, c: Vector, d: Vector, sixth: float) -> Vector:
    """start + h/6·(a + 2b + 2c + d)."""
    return (
        start[0] + sixth * (a[0] + 2.0 * (b[0] + c[0]) + d[0]),
        start[1] + sixth * (a[1] + 2.0 * (b[1] + c[1]) + d[1]),
        start[2] + sixth * (a[2] + 2.0 * (b[2] + c[2]) + d[2]),
    )
