// The first camera: it looks at what moves and transmits, from where buildings hide the least of it.
import { Box3, Vector3 } from "three";
import type { Vector } from "../types";
import type { RunView } from "./view";

const CELLS = 192;

/**
 * Choose a camera.
 *
 * @param origin world coordinates of the scene's zero [m]
 * @param aspect width over height of the picture
 */
export function overview(view: RunView, origin: Vector, aspect: number): { position: Vector; target: Vector } {
  const { low, high } = view.about.bounds;
  const local = (place: ArrayLike<number>) => new Vector3(place[0] - origin[0], place[1] - origin[1], place[2] - origin[2]);
  let places = [
    ...[...view.objects.shown.values()].map(({ pose }) => local(pose.position)),
    ...[...view.devices.shown.values()].map(({ pose }) => local(pose.position)),
  ];
  if (!places.length) places = [local(low), local(high), local([low[0], high[1], low[2]]), local([high[0], low[1], low[2]])];
  const centre = mean(places);
  // Of many, what strays far off, as on another road, does not make the rest small.
  const distances = places.map((place) => place.distanceTo(centre)).sort((a, b) => a - b);
  const counted = places.length > 8 ? Math.floor(0.85 * (places.length - 1)) : places.length - 1;
  const radius = Math.max(30, 1.02 * distances[counted]);
  const near = places.filter((place) => place.distanceTo(centre) <= radius);
  const target = middle(near);
  const heights = new Heights(view, origin);
  let best = { score: -Infinity, position: new Vector3() };
  for (const elevation of [22, 30, 40, 52, 65]) {
    for (let azimuth = -90; azimuth < 270; azimuth += 10) {
      const away = along(azimuth, elevation);
      const position = away.clone().multiplyScalar(distanceFor(near, target, away, aspect)).add(target);
      if (heights.hides(position, position.clone().setZ(position.z + 1))) continue;
      const seen = near.filter((place) => !heights.hides(position, place)).length;
      // A low camera shows heights, and walls in the south-east are lit.
      const score = seen / Math.max(1, near.length) - elevation / 110 + 0.06 * Math.cos(((azimuth + 60) * Math.PI) / 180);
      if (score > best.score) best = { score, position };
    }
  }
  const world = (place: Vector3) => place.toArray().map((value, i) => value + origin[i]) as Vector;
  return { position: world(best.position), target: world(target) };
}

/** Distance from the target at which all places are in the picture [m], but 25 m at least. */
function distanceFor(places: Vector3[], target: Vector3, away: Vector3, aspect: number): number {
  const tall = 0.72 * Math.tan((25 * Math.PI) / 180);
  const right = new Vector3(-away.y, away.x, 0).normalize();
  const up = away.clone().cross(right);
  const needed = places.map((place) => {
    const from = place.clone().sub(target);
    const [x, y] = [Math.abs(from.dot(right)), Math.abs(from.dot(up))];
    return Math.max(x / (tall * aspect * 0.85), y / tall) + from.dot(away);
  });
  return Math.max(25, ...needed);
}

function mean(places: Vector3[]): Vector3 {
  return places.reduce((sum, place) => sum.add(place), new Vector3()).divideScalar(Math.max(1, places.length));
}

/** Middle of the box around places. */
function middle(places: Vector3[]): Vector3 {
  const box = new Box3().setFromPoints(places);
  return box.getCenter(new Vector3());
}

/** Unit vector of an azimuth from east and an elevation [°]. */
function along(azimuth: number, elevation: number): Vector3 {
  const [a, e] = [(azimuth * Math.PI) / 180, (elevation * Math.PI) / 180];
  return new Vector3(Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e));
}

/** Heights of buildings in a grid: casting rays through 100,000 triangles would take seconds. */
class Heights {
  private readonly heights: Float32Array;
  private readonly cell: number;
  private readonly low: [number, number];

  constructor(view: RunView, origin: Vector) {
    const { low, high } = view.about.bounds;
    this.low = [low[0] - origin[0], low[1] - origin[1]];
    this.cell = Math.max(high[0] - low[0], high[1] - low[1], 1) / CELLS;
    this.heights = new Float32Array(CELLS * CELLS).fill(-Infinity);
    for (const { info, mesh } of view.world.pieces) {
      if (info.kind === "terrain") continue;
      const places = mesh.geometry.getAttribute("position").array;
      const corners = mesh.geometry.index?.array ?? [];
      for (let i = 0; i < corners.length; i += 3) this.add(places, corners[i], corners[i + 1], corners[i + 2]);
    }
  }

  /** Whether a building stands between two places. */
  hides(from: Vector3, to: Vector3): boolean {
    const steps = Math.min(400, Math.ceil(from.distanceTo(to) / this.cell));
    // Not the last steps: what stands at a wall is not hidden by it.
    for (let i = 0; i < steps - 2; i++) {
      const share = i / steps;
      const height = this.at(from.x + share * (to.x - from.x), from.y + share * (to.y - from.y));
      if (height > from.z + share * (to.z - from.z)) return true;
    }
    return false;
  }

  private at(x: number, y: number): number {
    const [i, j] = [Math.floor((x - this.low[0]) / this.cell), Math.floor((y - this.low[1]) / this.cell)];
    return i >= 0 && j >= 0 && i < CELLS && j < CELLS ? this.heights[i * CELLS + j] : -Infinity;
  }

  /** Take in a triangle at points that are no further apart than a cell. */
  private add(places: ArrayLike<number>, a: number, b: number, c: number): void {
    const [ax, ay, az] = [places[3 * a], places[3 * a + 1], places[3 * a + 2]];
    const [bx, by, bz] = [places[3 * b] - ax, places[3 * b + 1] - ay, places[3 * b + 2] - az];
    const [cx, cy, cz] = [places[3 * c] - ax, places[3 * c + 1] - ay, places[3 * c + 2] - az];
    const steps = Math.ceil(Math.max(Math.hypot(bx, by), Math.hypot(cx, cy)) / this.cell) + 1;
    for (let u = 0; u <= steps; u++) {
      for (let v = 0; v <= steps - u; v++) {
        const i = Math.floor((ax + (u * bx + v * cx) / steps - this.low[0]) / this.cell);
        const j = Math.floor((ay + (u * by + v * cy) / steps - this.low[1]) / this.cell);
        if (i < 0 || j < 0 || i >= CELLS || j >= CELLS) continue;
        const z = az + (u * bz + v * cz) / steps;
        if (z > this.heights[i * CELLS + j]) this.heights[i * CELLS + j] = z;
      }
    }
  }
}
