"""The reference world in Python: `python world.py tcp://HOST:PORT NAME`.

A car goes round in a circle, a UAV flies from point to point or where an agent sends it, a truck comes and
goes. Ground, building and meshes are its own; that of the truck comes while the run goes on. Killed and
started again, the world goes on as if nothing had happened.
"""

import json
import math
import sys

import numpy as np

from caviar_protocol.topics import WaypointCommand
from caviar_services.world.base import ObjectState
from caviar_services.world.engine import Engine, SceneryMesh
from caviar_space.meshes import box, joined
from caviar_space.mitsuba_xml import RadioMaterial

POINTS = [[20, 10, 15], [-20, 10, 25], [-20, -10, 15], [20, -10, 25]]  # of the UAV's flight [m]
UAV_M_S, CAR_M_S, CIRCLE_M = 6.0, 10.0, 15.0
TRUCK_M_S, TRUCK_EVERY_S, TRUCK_STAYS_S = 8.0, 10.0, 6.0
LEVEL = (1.0, 0.0, 0.0, 0.0)


class Street(Engine):
    """Three objects on a street."""

    prefixes = ("car", "truck.", "uav")

    def prepare(self):
        cabin = box((-1.6, 0.8), (-0.8, 0.8), (0.8, 1.5))
        car = joined([box((-2.25, 2.25), (-0.9, 0.9), (0, 0.8)), cabin])
        self.car = self.offer_mesh("car", car.vertices, car.faces)
        ground = [[-80, -80, 0], [80, -80, 0], [80, 80, 0], [-80, 80, 0]]
        house = box((-30, 30), (25, 40), (0, 20))
        meshes = [
            SceneryMesh("ground", ground, [[0, 1, 2], [0, 2, 3]], "asphalt"),
            SceneryMesh("building", house.vertices, house.faces, "walls"),
        ]
        materials = {"asphalt": RadioMaterial("concrete"), "walls": RadioMaterial("brick", 0.3)}
        self.offer_scenery(meshes, materials)

    def reset(self, seed, t0):
        generator = np.random.default_rng([seed, self.seed_episode])
        self.phase = 2 * math.pi * generator.random()  # where on its circle the car begins [rad]
        self.uav = {"position": POINTS[0], "target": POINTS[1], "next": 2, "speed": UAV_M_S}

    def step(self, t, previous, commands):
        orders = [c for c in commands if isinstance(c, WaypointCommand) and c.object == "uav"]
        for order in orders:
            self.uav |= {"target": list(order.position), "speed": order.speed}
        return [self.driven(t), self.flown(t - previous, orders), *self.passing(t)]

    def driven(self, t):
        rate, (dx, dy, dz) = CAR_M_S / CIRCLE_M, self.car.dimensions
        angle = self.phase + rate * t
        at = (CIRCLE_M * math.cos(angle), CIRCLE_M * math.sin(angle), dz / 2)
        velocity = (-CAR_M_S * math.sin(angle), CAR_M_S * math.cos(angle), 0.0)
        half = (angle + math.pi / 2) / 2
        heading = (math.cos(half), 0.0, 0.0, math.sin(half))
        return ObjectState("car", "car", at, heading, velocity, (dx, dy, dz), (0.0, 0.0, rate), self.car.mesh)

    def flown(self, seconds, orders):
        way = np.subtract(self.uav["target"], self.uav["position"])
        left, step = float(np.linalg.norm(way)), self.uav["speed"] * seconds
        there = left <= step
        at = self.uav["target"] if there else (self.uav["position"] + way / left * step).tolist()
        velocity = (0.0, 0.0, 0.0) if left == 0 else tuple((way / left * self.uav["speed"]).tolist())
        self.uav["position"] = [float(x) for x in at]
        if there and not orders:
            self.uav |= {"target": POINTS[self.uav["next"]], "next": (self.uav["next"] + 1) % 4}
        return ObjectState("uav", "uav", tuple(self.uav["position"]), LEVEL, velocity, (0.6, 0.6, 0.25))

    def passing(self, t):
        number, since = divmod(t, TRUCK_EVERY_S)
        if since >= TRUCK_STAYS_S:
            return
        body = joined([box((-4, 2), (-1.25, 1.25), (0.6, 3.2)), box((2.2, 4), (-1.2, 1.2), (0, 2.4))])
        mesh, size, _ = self.offer_mesh("truck", body.vertices, body.faces, "metal")
        at = (TRUCK_M_S * (since - TRUCK_STAYS_S / 2), -20.0, 1.6)
        yield ObjectState(f"truck.{number:.0f}", "truck", at, LEVEL, (TRUCK_M_S, 0.0, 0.0), size, mesh=mesh)

    def save(self):
        return json.dumps(self.uav).encode()

    def restore(self, state):
        self.uav = json.loads(state)


if __name__ == "__main__":
    sys.exit(Street().run(*sys.argv[1:3]))
