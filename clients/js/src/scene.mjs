// The scene of a frame from the objects of a world, checked by what consumers look at (SPEC.md, Content): an
// error here names the object, where one there ends the run.
import { NumericArray } from "./arrays.mjs";
import { SceneError } from "./errors.mjs";
import { isMeshName } from "./run_time_meshes.mjs";
import { byBytes } from "./schema.mjs";

/** @import { Device, Scene, SceneObject, Vector3 } from "./types.d.ts" */

/** Of an object; `centre` comes with what `offerMesh` returns. */
const FIELDS = "name class position velocity dimensions orientation angular_velocity mesh centre".split(" ");
const LEVEL = [1, 0, 0, 0];
const STILL = [0, 0, 0];
const LIGHT_M_S = 299_792_458;
const FARTHEST_M = 1e9;
const LARGEST_M = 1e5;
/** Of the norm of a quaternion. */
const UNIT_TOLERANCE = 1e-3;

/**
 * Make the scene of an instant.
 *
 * @param {readonly SceneObject[]} objects  in any order
 * @param {object} rules
 * @param {readonly string[]} rules.prefixes  that the world declared
 * @param {(name: string) => boolean} rules.offered  whether the world offered a mesh
 * @param {() => Device[]} rules.devices  of the frame, sorted; called once all objects are right
 * @returns {Scene} sorted by name
 * @throws {SceneError} for an object that no consumer would accept
 */
export function sceneOf(objects, { prefixes, offered, devices: mounted }) {
  const sorted = [...objects].sort((a, b) => byBytes(String(a.name), String(b.name)));
  sorted.forEach((object, index) => {
    if (index && object.name === sorted[index - 1].name)
      throw new SceneError(`two objects are named ${quoted(object.name)}; names have to differ`);
    checkName(object, prefixes);
    const unknown = Object.keys(object).find((field) => !FIELDS.includes(field));
    if (unknown)
      throw new SceneError(
        `object ${quoted(object.name)} has a field ${quoted(unknown)}; its fields are ${FIELDS.join(", ")}`,
      );
    checkNumbers(object);
    const { mesh = "" } = object;
    if (typeof mesh !== "string" || (mesh && !isMeshName(mesh) && !offered(mesh))) {
      throw new SceneError(
        `object ${quoted(object.name)}: mesh is ${quoted(mesh)}, which was not offered; ` +
          "take it from what offerMesh returns",
      );
    }
  });
  const names = sorted.map((object) => object.name);
  const devices = mounted();
  const clash = devices.find((device) => !device.parent && names.includes(device.name));
  if (clash)
    throw new SceneError(
      `object ${quoted(clash.name)} has the name of a device of the scenario; rename one of them`,
    );
  const turning = sorted.some((object) => object.angular_velocity?.some((value) => value !== 0));
  /** @param {number} width  @param {(object: SceneObject) => Vector3} value */
  const table = (width, value) => NumericArray.ofRows("<f8", width, sorted.map(value));
  return {
    names,
    classes: sorted.map((object) => object.class),
    assets: sorted.map((object) => object.mesh ?? ""),
    position: table(3, (object) => object.position),
    orientation: table(4, (object) => object.orientation ?? LEVEL),
    velocity: table(3, (object) => object.velocity),
    dimensions: table(3, (object) => object.dimensions),
    devices,
    ...(turning && { angular_velocity: table(3, (object) => object.angular_velocity ?? STILL) }),
  };
}

/** @param {SceneObject} object  @param {readonly string[]} prefixes */
function checkName({ name, class: kind }, prefixes) {
  if (typeof name !== "string" || !/^[^\x00-\x1f\x7f]+$/u.test(name)) {
    throw new SceneError(`an object has the name ${quoted(name)}; give it a text without control characters`);
  }
  if (!prefixes.some((prefix) => name.startsWith(prefix))) {
    throw new SceneError(
      `object ${quoted(name)} begins with none of the prefixes ${prefixes.map(quoted).join(", ")}; ` +
        "declare its prefix",
    );
  }
  if (typeof kind !== "string")
    throw new SceneError(`object ${quoted(name)}: class is ${quoted(kind)}; give it a text such as "car"`);
}

/** @param {SceneObject} object */
function checkNumbers({
  name,
  position,
  orientation = LEVEL,
  velocity,
  dimensions,
  angular_velocity: turning = STILL,
}) {
  const fields = /** @type {const} */ ([
    ["position", position, 3],
    ["orientation", orientation, 4],
    ["velocity", velocity, 3],
    ["dimensions", dimensions, 3],
    ["angular_velocity", turning, 3],
  ]);
  for (const [field, value, size] of fields) {
    if (value?.length !== size || !value.every(Number.isFinite)) {
      throw new SceneError(
        `object ${quoted(name)}: ${field} is ${shown(value)}; give it ${size} finite numbers`,
      );
    }
  }
  const norm = Math.hypot(...orientation);
  if (!(Math.abs(norm - 1) <= UNIT_TOLERANCE)) {
    throw new SceneError(
      `object ${quoted(name)}: orientation is ${shown(orientation)} of norm ${norm}; ` +
        "give it a unit quaternion (w, x, y, z)",
    );
  }
  if (!dimensions.every((side) => side > 0 && side <= LARGEST_M)) {
    throw new SceneError(
      `object ${quoted(name)}: dimensions are ${shown(dimensions)}; ` +
        `give sides above 0 and of at most ${LARGEST_M} m`,
    );
  }
  if (!position.every((coordinate) => Math.abs(coordinate) <= FARTHEST_M)) {
    throw new SceneError(
      `object ${quoted(name)}: position is ${shown(position)}; stay within ${FARTHEST_M} m of the origin`,
    );
  }
  const fastest = Math.hypot(...velocity) + Math.hypot(...turning) * (Math.hypot(...dimensions) / 2);
  if (!(fastest < LIGHT_M_S))
    throw new SceneError(`object ${quoted(name)}: velocity is ${shown(velocity)}, not below that of light`);
}

/** @param {unknown} value */
function shown(value) {
  return value === undefined
    ? "missing"
    : `[${Array.from(/** @type {ArrayLike<unknown>} */ (value) ?? [], String).join(", ")}]`;
}

/** @param {unknown} value */
function quoted(value) {
  return JSON.stringify(value) ?? "undefined";
}
