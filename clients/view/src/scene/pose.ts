// Poses in double precision: world axes x east, y north, z up; quaternions (w, x, y, z) from body to world axes.
import { numbers } from "../decode";
import type { Device, Scene } from "../../../js/src/types.d.ts";
import type { Vector } from "../types";

export type Quaternion = [number, number, number, number];

export interface Pose {
  /** [m] */
  position: Vector;
  orientation: Quaternion;
}

/** Turn a vector by a unit quaternion. */
export function rotate([w, x, y, z]: Quaternion, [a, b, c]: Vector): Vector {
  // v + 2w(q × v) + 2q × (q × v)
  const [tx, ty, tz] = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
  return [a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx];
}

/** The turn back. */
export function inverse([w, x, y, z]: Quaternion): Quaternion {
  return [w, -x, -y, -z];
}

/** A pose given in the axes of another one, in the world. */
export function compose(parent: Pose, { position, orientation }: Pose): Pose {
  const [w, x, y, z] = parent.orientation;
  const [p, q, r, s] = orientation;
  const [dx, dy, dz] = rotate(parent.orientation, position);
  return {
    position: [parent.position[0] + dx, parent.position[1] + dy, parent.position[2] + dz],
    orientation: [
      w * p - x * q - y * r - z * s,
      w * q + x * p + y * s - z * r,
      w * r - x * s + y * p + z * q,
      w * s + x * r - y * q + z * p,
    ],
  };
}

export function objectPose(scene: Scene, index: number): Pose {
  return {
    position: Array.from(row(scene.position, index, 3)) as Vector,
    orientation: Array.from(row(scene.orientation, index, 4)) as Quaternion,
  };
}

/** World pose of a device: its mount on top of its parent's pose; null where the parent is not there. */
export function devicePose(scene: Scene, device: Device): Pose | null {
  const mount = { position: [...device.position] as Vector, orientation: [...device.orientation] as Quaternion };
  if (!device.parent) return mount;
  const index = scene.names.indexOf(device.parent);
  if (index >= 0) return compose(objectPose(scene, index), mount);
  const other = scene.devices?.find(({ name }) => name === device.parent && name !== device.name);
  const parent = other ? devicePose(scene, other) : null;
  return parent && compose(parent, mount);
}

/** One row of an array of numbers. */
export function row(array: Parameters<typeof numbers>[0], index: number, width: number): number[] {
  const data = numbers(array);
  return Array.from({ length: width }, (_, i) => data[index * width + i]);
}

/** Heading, elevation of the forward axis, and bank of a body [rad]. */
export function angles(orientation: Quaternion): { yaw: number; pitch: number; roll: number } {
  const forward = rotate(orientation, [1, 0, 0]);
  const left = rotate(orientation, [0, 1, 0]);
  const up = rotate(orientation, [0, 0, 1]);
  return {
    yaw: Math.atan2(forward[1], forward[0]),
    pitch: Math.asin(Math.max(-1, Math.min(1, forward[2]))),
    roll: Math.atan2(left[2], up[2]),
  };
}
