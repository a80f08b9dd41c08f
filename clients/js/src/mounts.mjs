// Devices of the scenario as a world publishes them: on which objects they stand, and where (SPEC.md,
// Worlds).
import { multiply, quaternion } from "./axes.mjs";
import { SceneError } from "./errors.mjs";
import { byBytes } from "./schema.mjs";

/** @import { Device, SceneObject } from "./types.d.ts" */
/** @typedef {Record<string, any>} DeviceSpec  one of `scenario.devices` of WELCOME */

/** Which devices exist in a frame, and where they are mounted. */
export class Mounts {
  /** Objects that are there, those that came first in front. @type {string[]} */
  #arrived = [];

  /** @param {DeviceSpec[]} specs  those that the world publishes */
  constructor(specs) {
    this.specs = specs;
  }

  /** Names of the devices that stand in the world without a parent. */
  get fixedNames() {
    return this.specs.filter((spec) => !spec.on).map((spec) => spec.name);
  }

  /** The objects of the last frame, those that came first in front. */
  get arrived() {
    return [...this.#arrived];
  }

  /** Forget which objects came first: an episode begins, or goes on after a frame.
   * @param {string[]} arrived  objects of that frame, those that came first in front */
  clear(arrived = []) {
    this.#arrived = [...arrived];
  }

  /**
   * The devices of a frame. Objects that were not there in the frame before count as having come in the given
   * order; the `count` of a device goes to those that came first, so that one that has it keeps it.
   *
   * @param {readonly SceneObject[]} objects  of the frame
   * @returns {Device[]} sorted by name
   */
  devices(objects) {
    const there = new Map(objects.map((object) => [object.name, object]));
    const known = new Set(this.#arrived);
    this.#arrived = [
      ...this.#arrived.filter((name) => there.has(name)),
      ...[...there.keys()].filter((name) => !known.has(name)),
    ];
    /** @type {Device[]} */
    const found = [];
    for (const spec of this.specs) {
      if (!spec.on) found.push(deviceOf(spec, undefined));
      else {
        const carriers = this.#arrived.filter((name) => matches(spec.on, name)).slice(0, spec.count);
        for (const name of carriers) found.push(deviceOf(spec, there.get(name)));
      }
    }
    return found.sort((a, b) => byBytes(a.name, b.name));
  }
}

/**
 * A device of the scenario as it stands in a scene.
 *
 * @param {DeviceSpec} spec
 * @param {SceneObject | undefined} parent  that it is mounted on; undefined: it stands in the world
 * @returns {Device}
 */
export function deviceOf(spec, parent) {
  const [x, y, z] = spec.position_m;
  const turned = quaternion(radians(spec.yaw_deg), radians(spec.pitch_deg), radians(spec.roll_deg));
  const common = {
    name: parent ? `${parent.name}/${spec.name}` : spec.name,
    parent: parent?.name ?? "",
    position: [x, y, z + (parent ? heightOf(spec.mount) * parent.dimensions[2] : 0)],
    orientation:
      parent && spec.keeps_heading ? multiply(conjugate(parent.orientation ?? [1, 0, 0, 0]), turned) : turned,
  };
  switch (spec.kind) {
    case "antenna":
      return {
        type: "antenna",
        ...common,
        role: spec.role,
        array: arrayOf(spec.array),
        power_dbm: spec.power_dbm,
        carriers: spec.carriers ?? [],
      };
    case "lidar": {
      const [low, high] = spec.elevation_deg,
        [near, far] = spec.range_m;
      return {
        type: "lidar",
        ...common,
        beams: spec.beams,
        azimuth_steps: spec.azimuth_steps,
        elevation_min: radians(low),
        elevation_max: radians(high),
        max_range: far,
        min_range: near,
      };
    }
    case "camera":
      return {
        type: "camera",
        ...common,
        width: spec.size_px[0],
        height: spec.size_px[1],
        field_of_view: radians(spec.field_of_view_deg),
      };
  }
  throw new SceneError(
    `device ${spec.name} is of the kind ${spec.kind}, which this version of the library does not know`,
  );
}

/** @param {string} mount */
function heightOf(mount) {
  return mount === "roof" ? 0.5 : mount === "floor" ? -0.5 : 0;
}

/** @param {Record<string, any> | null | undefined} array  of the scenario  @returns {any} */
function arrayOf(array) {
  const {
    rows = 1,
    columns = 1,
    vertical_spacing = 0.5,
    horizontal_spacing = 0.5,
    pattern = "iso",
    polarization = "V",
    codebook = "dft",
  } = array ?? {};
  const file = array?.pattern_file ? `patterns/${array.pattern_file.split("/").at(-1)}` : "";
  return {
    rows,
    columns,
    vertical_spacing,
    horizontal_spacing,
    pattern,
    polarization,
    pattern_file: file,
    panels: array?.panels ?? [],
    codebook,
  };
}

/** @param {number} degrees */
function radians(degrees) {
  return (degrees * Math.PI) / 180;
}

/** @param {import("./types.d.ts").Quaternion} q  @returns {[number, number, number, number]} */
function conjugate([w, x, y, z]) {
  return [w, -x, -y, -z];
}

/**
 * Whether a device stands on an object: `*` is any text, `?` one character, `[abc]`, `[a-z]` and `[!abc]` one
 * of a set; a whole name matches itself, whatever is in it.
 *
 * @param {string} pattern
 * @param {string} name
 * @returns {boolean}
 */
export function matches(pattern, name) {
  return pattern === name || matchesFrom(pieces(pattern), 0, [...name], 0);
}

/** @typedef {"*" | ((character: string) => boolean)} Piece */

/** @param {string} pattern  @returns {Piece[]} */
function pieces(pattern) {
  const characters = [...pattern];
  /** @type {Piece[]} */
  const found = [];
  for (let at = 0; at < characters.length; at++) {
    const character = characters[at];
    if (character === "*") found.push("*");
    else if (character === "?") found.push(() => true);
    else {
      const negated = characters[at + 1] === "!" ? 1 : 0;
      // A bracket right behind the opening one belongs to the set.
      const end = character === "[" ? characters.indexOf("]", at + 2 + negated) : -1;
      if (end < 0) found.push((other) => other === character);
      else {
        const inside = members(characters.slice(at + 1 + negated, end));
        found.push((other) => inside(other) !== !!negated);
        at = end;
      }
    }
  }
  return found;
}

/** @param {string[]} set  @returns {(character: string) => boolean} */
function members(set) {
  /** @type {[string, string][]} */
  const ranges = [];
  for (let at = 0; at < set.length; at++) {
    if (set[at + 1] === "-" && at + 2 < set.length) {
      ranges.push([set[at], set[at + 2]]);
      at += 2;
    } else ranges.push([set[at], set[at]]);
  }
  return (character) =>
    ranges.some(([low, high]) => byBytes(low, character) <= 0 && byBytes(character, high) <= 0);
}

/**
 * @param {Piece[]} pattern
 * @param {number} p
 * @param {string[]} name
 * @param {number} n
 * @returns {boolean}
 */
function matchesFrom(pattern, p, name, n) {
  // Only the last star is ever taken back: whatever an earlier one could take, that one can take too.
  let star = -1,
    taken = 0;
  while (n < name.length) {
    const piece = pattern[p];
    if (piece === "*") {
      star = p++;
      taken = n;
    } else if (piece !== undefined && piece(name[n])) {
      p++;
      n++;
    } else if (star >= 0) {
      p = star + 1;
      n = ++taken;
    } else return false;
  }
  while (pattern[p] === "*") p++;
  return p === pattern.length;
}
