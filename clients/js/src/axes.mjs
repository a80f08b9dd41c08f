// Axes and units of game engines and flight simulators, to and from those of the protocol: metres, x east, y
// north, z up, bodies x forward, y left, z up ("ENU"). Tested against clients/axes.json.

import { cos, sin } from "./trigonometry.mjs";

/** @import { Quaternion, Vector3 } from "./types.d.ts" */
/** @import { Triples } from "./scenery.mjs" */
/** @typedef {readonly [Vector3, Vector3, Vector3]} Matrix  rows */
/** @typedef {number[]} Numbers */
/**
 * Where a body is and how it moves; what is left out stays left out.
 * @typedef {{ position?: Vector3, orientation?: Quaternion, velocity?: Vector3, angular_velocity?: Vector3 }
 * } Motion
 */

/** Axes and unit of length of an engine. */
export class EngineAxes {
  /**
   * @param {string} name
   * @param {Matrix} world  takes a direction in ENU to the engine's world axes; left-handed ones mirror it
   * @param {Matrix} body  the same from a body's axes (forward, left, up)
   * @param {number} unit  length in the engine of 1 m
   * @param {boolean} clockwise  whether its triangles are clockwise as seen from outside, as Unity and Godot
   *   have them; those of Unreal and three.js are counter-clockwise
   */
  constructor(name, world, body = world, unit = 1, clockwise = false) {
    this.name = name;
    this.clockwise = clockwise;
    this.unit = unit;
    this.world = world;
    this.body = body;
    // An angular velocity turns by the hand of the axes: a mirror turns it round.
    this.hand = determinant(world);
  }

  /**
   * From the engine: positions [its unit], unit quaternions (w, x, y, z), velocities [its unit/s], angular
   * velocities [rad/s], in its world axes.
   *
   * @template {Motion} T
   * @param {T} motion
   * @returns {{ [K in keyof T & keyof Motion]: Numbers }}
   * @example { name: "car", class: "car", dimensions, ...UNITY.toEnu({ position, orientation, velocity }) }
   */
  toEnu(motion) {
    return this.#converted(motion, transposed(this.world), transposed(this.body), 1 / this.unit);
  }

  /**
   * To the engine: the reverse of `toEnu`.
   *
   * @template {Motion} T
   * @param {T} motion
   * @returns {{ [K in keyof T & keyof Motion]: Numbers }}
   * @example mesh.position.set(...THREE.fromEnu({ position: scene.position.row(0) }).position);
   */
  fromEnu(motion) {
    return this.#converted(motion, this.world, this.body, this.unit);
  }

  /**
   * A mesh of the engine, as it gives it, for `offerMesh`.
   *
   * @param {Triples} vertices  in its body axes and unit
   * @param {Triples} triangles  three indices each, wound as the engine does
   * @returns {{ vertices: Numbers[], triangles: Numbers[] }} forward, left, up [m]; counter-clockwise as seen
   *   from outside: the second and third corner change places where the engine has them clockwise
   * @example const { vertices, triangles } = THREE_MODEL.meshToEnu(position.array, index.array);
   */
  meshToEnu(vertices, triangles) {
    const body = transposed(this.body);
    return {
      vertices: triples(vertices).map((vertex) => scaled(1 / this.unit, times(body, vertex))),
      triangles: triples(triangles).map(([a, b, c]) => (this.clockwise ? [a, c, b] : [a, b, c])),
    };
  }

  /**
   * @param {Motion} motion
   * @param {Matrix} world
   * @param {Matrix} body
   * @param {number} unit
   * @returns {any}
   */
  #converted({ position, orientation, velocity, angular_velocity }, world, body, unit) {
    return {
      ...(position && { position: scaled(unit, times(world, position)) }),
      ...(orientation && { orientation: conjugated(orientation, world, body) }),
      ...(velocity && { velocity: scaled(unit, times(world, velocity)) }),
      ...(angular_velocity && { angular_velocity: scaled(this.hand, times(world, angular_velocity)) }),
    };
  }
}

/** Left-handed centimetres: x east and forward, y south and right, z up. */
export const UNREAL = new EngineAxes(
  "unreal",
  [
    [1, 0, 0],
    [0, -1, 0],
    [0, 0, 1],
  ],
  undefined,
  100,
);
/** Left-handed metres: x south and right, y up, z east and forward. */
export const UNITY = new EngineAxes(
  "unity",
  [
    [0, -1, 0],
    [0, 0, 1],
    [1, 0, 0],
  ],
  undefined,
  1,
  true,
);
/** Right-handed metres: x south and right, y up, z west and back. */
export const GODOT = new EngineAxes(
  "godot",
  [
    [0, -1, 0],
    [0, 0, 1],
    [-1, 0, 0],
  ],
  undefined,
  1,
  true,
);
/** North, east, down; bodies forward, right, down. */
export const NED = new EngineAxes(
  "ned",
  [
    [0, 1, 0],
    [1, 0, 0],
    [0, 0, -1],
  ],
  [
    [1, 0, 0],
    [0, -1, 0],
    [0, 0, -1],
  ],
);
/** By name: those of clients/axes.json. */
export const ENGINES = { unreal: UNREAL, unity: UNITY, godot: GODOT, ned: NED };

/** three.js has the axes of Godot: right-handed metres, y up; a camera, and a body here, looks along −z. */
export const THREE = new EngineAxes("three", GODOT.world);
/** three.js with models whose front is +z, as glTF and `Object3D.lookAt` have it: x left, y up, z forward. */
export const THREE_MODEL = new EngineAxes("three-model", GODOT.world, [
  [0, 1, 0],
  [0, 0, 1],
  [1, 0, 0],
]);

/** (w, x, y, z) of a quaternion that is written (x, y, z, w), as three.js, Unity, Godot and glTF do.
 * @param {ArrayLike<number>} q */
export const wxyz = (q) => [q[3], q[0], q[1], q[2]];
/** (x, y, z, w) of a quaternion (w, x, y, z).
 * @param {ArrayLike<number>} q */
export const xyzw = (q) => [q[1], q[2], q[3], q[0]];

/**
 * The quaternion (w, x, y, z) of yaw, pitch and roll [rad]: first about z, counter-clockwise, then about the
 * new y, positive lowers the nose, then about the new x.
 *
 * @param {number} yaw
 * @param {number} pitch
 * @param {number} roll
 * @returns {[number, number, number, number]}
 */
export function quaternion(yaw, pitch = 0, roll = 0) {
  const [cy, sy, cp, sp, cr, sr] = [yaw, pitch, roll].flatMap((angle) => [cos(angle / 2), sin(angle / 2)]);
  return [
    cy * cp * cr + sy * sp * sr,
    cy * cp * sr - sy * sp * cr,
    cy * sp * cr + sy * cp * sr,
    sy * cp * cr - cy * sp * sr,
  ];
}

/**
 * The rotation that turns by `b` first, then by `a`.
 * @param {Quaternion} a
 * @param {Quaternion} b
 * @returns {[number, number, number, number]}
 */
export function multiply([w, x, y, z], [p, q, r, s]) {
  return [
    w * p - x * q - y * r - z * s,
    w * q + x * p + y * s - z * r,
    w * r - x * s + y * p + z * q,
    w * s + x * r - y * q + z * p,
  ];
}

/** @param {Matrix} m  @param {Vector3} v  @returns {Numbers} */
function times(m, [x, y, z]) {
  return m.map((row) => row[0] * x + row[1] * y + row[2] * z + 0);
}

/** @param {number} factor  @param {Numbers} vector  @returns {Numbers} */
function scaled(factor, vector) {
  // A hundredth is no binary number: dividing by 100 is exact where multiplying by 1/100 is not.
  return vector.map((value) => (Math.abs(factor) < 1 ? value / Math.round(1 / factor) : value * factor) + 0);
}

/** Rows of three of what is given as triples, or one after the other.
 * @param {Triples} values  @returns {Numbers[]} */
function triples(values) {
  const numbers = Array.from(/** @type {ArrayLike<any>} */ (values)).flat();
  // What is no row of three stays in the last one, for offerMesh to refuse.
  const rows = Math.ceil(numbers.length / 3);
  return Array.from({ length: rows }, (_, row) => numbers.slice(3 * row, 3 * row + 3));
}

/** @param {Matrix} m  @returns {Matrix} */
function transposed(m) {
  return [
    [m[0][0], m[1][0], m[2][0]],
    [m[0][1], m[1][1], m[2][1]],
    [m[0][2], m[1][2], m[2][2]],
  ];
}

/** @param {Matrix} m */
function determinant([[a, b, c], [d, e, f], [g, h, i]]) {
  return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g);
}

/**
 * Orientation in other axes: W·R·Bᵀ.
 *
 * W and B are both rotations, or both mirrors. R may be taken as the quaternion of its axis and angle: W·R·Wᵀ
 * turns about the axis W·v, by the reverse angle where W mirrors; W·Bᵀ is a rotation that stays to be
 * multiplied.
 *
 * @param {Quaternion} q
 * @param {Matrix} world
 * @param {Matrix} body
 * @returns {Numbers} w ≥ 0
 */
function conjugated([w, x, y, z], world, body) {
  const [a, b, c] = scaled(determinant(world), times(world, [x, y, z]));
  const [i, j, k] = world;
  const rest = /** @type {Matrix} */ ([times(body, i), times(body, j), times(body, k)]); // rows of W·Bᵀ
  const found = multiply([w, a, b, c], ofMatrix(rest));
  return found.map((value) => (found[0] < 0 ? -value : value) + 0);
}

/** @param {Matrix} m  a rotation  @returns {[number, number, number, number]} */
function ofMatrix(m) {
  const trace = m[0][0] + m[1][1] + m[2][2];
  if (trace > 0) {
    const w = Math.sqrt(1 + trace) / 2;
    return [w, (m[2][1] - m[1][2]) / (4 * w), (m[0][2] - m[2][0]) / (4 * w), (m[1][0] - m[0][1]) / (4 * w)];
  }
  // About the axis with the largest component: the divisor is never small.
  const i = m[0][0] >= m[1][1] && m[0][0] >= m[2][2] ? 0 : m[1][1] >= m[2][2] ? 1 : 2;
  const j = (i + 1) % 3,
    k = (i + 2) % 3;
  const large = Math.sqrt(1 + m[i][i] - m[j][j] - m[k][k]) / 2;
  const q = /** @type {[number, number, number, number]} */ ([(m[k][j] - m[j][k]) / (4 * large), 0, 0, 0]);
  q[1 + i] = large;
  q[1 + j] = (m[i][j] + m[j][i]) / (4 * large);
  q[1 + k] = (m[i][k] + m[k][i]) / (4 * large);
  return q;
}
