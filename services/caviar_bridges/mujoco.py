"""The rigid body of a quadrotor in MuJoCo: the same forces, integrated by its Runge–Kutta method."""

from __future__ import annotations

import math
from typing import ClassVar

from caviar_protocol.errors import SetupError
from caviar_protocol.host import install_command
from caviar_protocol.space.coordinates import UnitQuaternion, Vector, multiply, rotated, unrotated
from caviar_services.world.quadrotor.airframe import (
    AIR_DENSITY,
    GRAVITY,
    Airframe,
    Body,
    Plant,
    Rotors,
    lagged,
)


class MujocoPlant(Plant):
    """Moves the body by MuJoCo, as `Plant` does itself.

    Forces and moments of the rotors are those of the middle of the step, held over it: errors are of the
    second order in its length.

    Args:
        airframe: What the quadrotor is made of.
        gravity: [m/s²]

    Raises:
        SetupError: MuJoCo is not installed.
    """

    extra: ClassVar[str] = "mujoco"
    packages: ClassVar[tuple[str, ...]] = ("mujoco",)

    def __init__(self, airframe: Airframe, gravity: float = GRAVITY) -> None:
        super().__init__(airframe, gravity)
        try:
            import mujoco
        except ImportError as error:
            raise SetupError(
                f'engine = "mujoco" needs MuJoCo, which is not installed; run: {install_command("mujoco")}'
            ) from error
        inertia = " ".join(map(repr, airframe.inertia_kg_m2))
        # Mass and inertia alone: what it touches is the world's matter.
        xml = (
            f'<mujoco><option integrator="RK4" gravity="0 0 {-gravity!r}"/><worldbody><body>'
            f'<freejoint/><inertial pos="0 0 0" mass="{airframe.mass_kg!r}" diaginertia="{inertia}"/>'
            "</body></worldbody></mujoco>"
        )
        self._step = mujoco.mj_step
        self._model = mujoco.MjModel.from_xml_string(xml)
        self._data = mujoco.MjData(self._model)

    def advance(
        self, body: Body, speeds: Rotors, commands: Rotors, air: Vector, h: float
    ) -> tuple[Body, Rotors, float]:
        """See `Plant.advance`."""
        left = math.exp(-0.5 * h / self.airframe.rotor_lag_s)
        middle = lagged(speeds, commands, left)
        end = lagged(middle, commands, left)
        w0, w1, w2 = self.wrench(speeds), self.wrench(middle), self.wrench(end)
        # Held over the step, so those of its middle; their directions turn with the body.
        a, b, c = (0.25 * h * rate for rate in body.rates)
        turned = multiply(body.orientation, (1.0, a, b, c))
        scale = 1.0 / math.hypot(*turned)
        there = (scale * turned[0], scale * turned[1], scale * turned[2], scale * turned[3])
        data = self._data
        self._model.opt.timestep = h
        data.qpos[:3], data.qpos[3:] = body.position, body.orientation
        data.qvel[:3], data.qvel[3:] = body.velocity, body.rates
        data.xfrc_applied[1, :3] = rotated(there, self._force(body.velocity, there, w1[0], air))
        data.xfrc_applied[1, 3:] = rotated(there, w1[1:4])
        self._step(self._model, data)
        x, y, z, qw, qx, qy, qz = data.qpos.tolist()
        u, v, w, o, p, r = data.qvel.tolist()
        moved = Body((x, y, z), (u, v, w), (qw, qx, qy, qz), (o, p, r))
        return moved, end, h / 6.0 * (w0[4] + 4.0 * w1[4] + w2[4])

    def _force(self, velocity: Vector, q: UnitQuaternion, thrust: float, air: Vector) -> Vector:
        """Force of rotors and air, in body axes [N]."""
        x, y, z = (a - b for a, b in zip(velocity, air, strict=True))
        speed = math.sqrt(x * x + y * y + z * z)
        frame = self.airframe
        fx, fy, fz = (
            -(linear + 0.5 * AIR_DENSITY * area * speed) * u
            for linear, area, u in zip(
                frame.linear_drag_n_s_m,
                frame.drag_area_m2,
                unrotated(q, (x, y, z)),
                strict=True,
            )
        )
        return (fx, fy, fz + thrust)
