// The reference world: a car goes round in a circle, a UAV flies from point to point or where an agent sends
// it, a truck comes and goes; the ground, a building and the meshes of car and truck are its own. Killed and
// started again, it goes on as if nothing had happened.
// In Node: node world.mjs ws://HOST:PORT/ws NAME; in a browser: browser.html.
import { cos, generator, main, quaternion, sin, World } from "./src/index.mjs";

const POINTS = [[20, 10, 15], [-20, 10, 25], [-20, -10, 15], [20, -10, 25]]; // of the UAV's flight [m]
const UAV_M_S = 6, CAR_M_S = 10, CIRCLE_M = 15, TRUCK_M_S = 8, TRUCK_EVERY_S = 10, TRUCK_STAYS_S = 6;

/** A box between two opposite corners: 8 vertices, 12 triangles. */
function box([x0, y0, z0], [x1, y1, z1]) {
  const vertices = [z0, z1].flatMap((z) => [[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]]);
  const sides = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]];
  return { vertices, triangles: sides.flatMap(([a, b, c, d]) => [[a, b, c], [a, c, d]]) };
}

class Street extends World {
  objects = []; // of the last frame, for a page that shows them

  constructor() {
    super({ name: "world", prefixes: ["car", "truck.", "uav"] });
  }

  prepare() {
    const body = box([-2.25, -0.9, 0], [2.25, 0.9, 0.8]), cabin = box([-1.6, -0.8, 0.8], [0.8, 0.8, 1.5]);
    const above = cabin.triangles.map((corners) => corners.map((corner) => corner + body.vertices.length));
    this.car = this.offerMesh("car", [...body.vertices, ...cabin.vertices], [...body.triangles, ...above]);
    const square = [[-80, -80, 0], [80, -80, 0], [80, 80, 0], [-80, 80, 0]];
    const asphalt = { type: "asphalt_concrete", thickness: 0.3 }, walls = { type: "concrete", thickness: 0.2 };
    this.offerScenery([
      { name: "ground", vertices: square, triangles: [[0, 1, 2], [0, 2, 3]], material: "asphalt" },
      { name: "building", ...box([-30, 25, 0], [30, 40, 20]), material: "walls" },
    ], { asphalt, walls });
  }

  reset(seed, t0, episode) {
    this.phase = generator(seed, episode, "car")(); // where on its circle the car begins, in turns
    this.uav = { position: POINTS[0], target: POINTS[1], next: 2, speed: UAV_M_S };
  }

  step(t, previous, commands) {
    this.objects = [this.carAt(t), this.fly(t - previous, commands), ...this.truckAt(t)];
    return this.objects;
  }

  carAt(t) {
    const turning = CAR_M_S / CIRCLE_M, angle = 2 * Math.PI * this.phase + turning * t;
    return {
      name: "car", class: "car", mesh: this.car.mesh, dimensions: this.car.dimensions,
      position: [CIRCLE_M * cos(angle), CIRCLE_M * sin(angle), 0.75],
      orientation: quaternion(angle + Math.PI / 2),
      velocity: [-CAR_M_S * sin(angle), CAR_M_S * cos(angle), 0],
      angular_velocity: [0, 0, turning],
    };
  }

  fly(seconds, commands) {
    const order = commands.find((command) => command.type === "waypoint" && command.object === "uav");
    if (order) Object.assign(this.uav, { target: order.position, speed: order.speed });
    const { position, target, speed, next } = this.uav;
    const way = target.map((value, axis) => value - position[axis]);
    const left = Math.sqrt(way.reduce((sum, value) => sum + value * value, 0));
    const share = left > 0 ? Math.min(1, (speed * seconds) / left) : 1;
    this.uav.position = position.map((value, axis) => value + share * way[axis]);
    if (share === 1 && !order) Object.assign(this.uav, { target: POINTS[next], next: (next + 1) % 4 });
    const velocity = left > 0 ? way.map((value) => (value / left) * speed) : [0, 0, 0];
    return { name: "uav", class: "uav", dimensions: [0.6, 0.6, 0.25], position: this.uav.position, velocity };
  }

  truckAt(t) {
    const number = Math.floor(t / TRUCK_EVERY_S), since = t - number * TRUCK_EVERY_S;
    if (since >= TRUCK_STAYS_S) return [];
    // Its mesh comes with it, while the run goes on: a wedge.
    const wedge = [[-4, -1, 0], [4, -1, 0], [4, 1, 0], [-4, 1, 0], [-4, -1, 3], [-4, 1, 3]];
    const sides = [[0, 3, 2], [0, 2, 1], [0, 1, 4], [3, 5, 2], [0, 4, 5], [0, 5, 3], [1, 2, 5], [1, 5, 4]];
    const { mesh, dimensions } = this.offerMesh("truck", wedge, sides, "metal");
    const position = [TRUCK_M_S * (since - TRUCK_STAYS_S / 2), -20, 1.5], velocity = [TRUCK_M_S, 0, 0];
    return [{ name: `truck.${number}`, class: "truck", mesh, dimensions, position, velocity }];
  }

  save() { return this.uav; }
  restore(state) { this.uav = state; }
}

export const street = new Street();
export const ended = main(street);
