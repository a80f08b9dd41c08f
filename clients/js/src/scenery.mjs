// Files that a world brings, made in memory: PLY meshes and the XML of the static scene (SPEC.md, Scenery).
import { SceneError } from "./errors.mjs";
import { MAX_ASSET_CHUNK } from "./messages.mjs";
import { byBytes } from "./schema.mjs";
import { sha256 } from "./sha256.mjs";

/** @import { Material, OfferedMesh, SceneryMesh, Vector3 } from "./types.d.ts" */
/** @typedef {{ dimensions: [number, number, number], centre: [number, number, number] }} Box  [m] */
/** @typedef {ArrayLike<number> | readonly Vector3[]} Triples  as triples, or one number after the other */

/** Materials of Recommendation ITU-R P.2040. */
const MATERIALS = [
  "asphalt_concrete",
  "brick",
  "carpet_tile",
  "ceiling_board",
  "chipboard",
  "clear_acrylic",
  "concrete",
  "floorboard",
  "glass",
  "marble",
  "metal",
  "plasterboard",
  "plywood",
  "vinyl_tile",
  "wood",
  "very_dry_ground",
  "medium_dry_ground",
  "wet_ground",
  "vacuum",
];
const utf8 = new TextEncoder();

/** The files of a world, by name. */
export class Assets {
  /** @type {Map<string, { name: string, digest: string, size: number, data: Uint8Array }>} */
  #byName = new Map();
  /** @type {Map<string, Uint8Array>} */
  #byDigest = new Map();

  /**
   * Offer a file of any kind.
   * @param {string} name  a relative path with forward slashes
   * @param {Uint8Array} data
   */
  offerFile(name, data) {
    if (!/^(?!\.{1,2}(\/|$))[^/\\\x00-\x1f\x7f]+(\/(?!\.{1,2}(\/|$))[^/\\\x00-\x1f\x7f]+)*$/u.test(name)) {
      throw new SceneError(
        `an asset is named ${JSON.stringify(name)}; give it a relative path without . and ..`,
      );
    }
    const digest = sha256(data);
    const before = this.#byName.get(name);
    if (before && before.digest !== digest)
      throw new SceneError(`two different files are offered as ${JSON.stringify(name)}`);
    this.#byName.set(name, { name, digest, size: data.length, data });
    this.#byDigest.set(digest, data);
  }

  /**
   * Offer the mesh of a moving object.
   * @param {string} name  such as `car`: the asset is `objects/car.ply`
   * @param {Triples} vertices  [m], x forward, y left, z up
   * @param {Triples} triangles  three indices each, counter-clockwise seen from outside
   * @param {string} [material]  of ITU-R P.2040; empty: what the channel's settings say
   * @returns {OfferedMesh}
   */
  offerMesh(name, vertices, triangles, material = "") {
    const { file, dimensions, centre } = unitMesh(name, vertices, triangles, material);
    const mesh = `objects/${name}.ply`;
    this.offerFile(mesh, file);
    return { mesh, dimensions, centre };
  }

  /**
   * Offer the static scenery of the run.
   * @param {readonly SceneryMesh[]} meshes  in world axes [m]
   * @param {Record<string, Material>} materials  by the names that meshes refer to
   */
  offerScenery(meshes, materials) {
    for (const [key, { type, thickness = 0.1 }] of Object.entries(materials)) {
      if (!/^[\w.-]+$/.test(key))
        throw new SceneError(`a material is named ${JSON.stringify(key)}; use letters, digits, _, . and -`);
      checkMaterial(`material ${JSON.stringify(key)}`, type);
      if (!(thickness > 0))
        throw new SceneError(
          `material ${JSON.stringify(key)} has the thickness ${thickness}; give it metres above 0`,
        );
    }
    const names = new Set();
    for (const { name, vertices, triangles, material } of meshes) {
      if (!/^[\w.-]+$/.test(name) || name.startsWith("mesh-") || names.has(name)) {
        throw new SceneError(
          `a mesh of the scenery is named ${JSON.stringify(name)}; give each another name of letters, ` +
            "digits, _, . and -, that does not begin with mesh-",
        );
      }
      if (!Object.hasOwn(materials, material))
        throw new SceneError(
          `mesh ${name} has the material ${JSON.stringify(material)}, ` +
            `which is none of ${Object.keys(materials).join(", ")}`,
        );
      names.add(name);
      const points = flat(vertices),
        corners = flat(triangles);
      checkMesh(name, points, corners);
      this.offerFile(`scenery/meshes/${name}.ply`, ply(points, corners));
    }
    this.offerFile("scenery/scene.xml", utf8.encode(sceneXml(meshes, materials)));
  }

  /** Whether a file of this name is offered. @param {string} name */
  has(name) {
    return this.#byName.has(name);
  }

  /** What ASSET_OFFER lists, in ascending order of names. */
  get listed() {
    const all = [...this.#byName.values()].sort((a, b) => byBytes(a.name, b.name));
    return all.map(({ name, digest, size }) => ({ name, digest, size }));
  }

  /** Digest of all names and digests; empty without files. */
  get geometry() {
    const { listed } = this;
    return listed.length
      ? sha256(...listed.map(({ name, digest }) => utf8.encode(`${name}\0${digest}\0`)))
      : "";
  }

  /**
   * A piece of a file.
   * @param {string} digest
   * @param {number} offset
   * @returns {{ size: number, piece: Uint8Array } | undefined} undefined where there is none
   */
  piece(digest, offset) {
    const data = this.#byDigest.get(digest);
    if (!data || offset > data.length) return undefined;
    return { size: data.length, piece: data.subarray(offset, offset + MAX_ASSET_CHUNK) };
  }
}

/**
 * The file of a mesh that fills the unit box, and what it had measured.
 * @param {string} name
 * @param {Triples} vertices
 * @param {Triples} triangles
 * @param {string} material
 * @returns {{ file: Uint8Array, faces: number } & Box}
 */
export function unitMesh(name, vertices, triangles, material) {
  const points = flat(vertices),
    corners = flat(triangles);
  checkMesh(name, points, corners);
  if (material) checkMaterial(`mesh ${JSON.stringify(name)}`, material);
  const { dimensions, centre } = boxOf(points);
  if (!dimensions.every((side) => side > 0))
    throw new SceneError(`mesh ${JSON.stringify(name)} is flat: its sides are ${dimensions.join(", ")} m`);
  const unit = points.map((value, index) => (value - centre[index % 3]) / dimensions[index % 3]);
  return { file: ply(unit, corners, material), faces: corners.length / 3, dimensions, centre };
}

/**
 * The bounding box of points; without what is not finite.
 * @param {Triples} vertices
 * @returns {Box}
 */
export function boxOf(vertices) {
  const low = [Infinity, Infinity, Infinity],
    high = [-Infinity, -Infinity, -Infinity];
  flat(vertices).forEach((value, index) => {
    if (!Number.isFinite(value)) return;
    low[index % 3] = Math.min(low[index % 3], value);
    high[index % 3] = Math.max(high[index % 3], value);
  });
  const sides = triple((axis) => high[axis] - low[axis]),
    middle = triple((axis) => (high[axis] + low[axis]) / 2);
  const there = sides.every(Number.isFinite);
  return { dimensions: there ? sides : [0, 0, 0], centre: there ? middle : [0, 0, 0] };
}

/** @param {string} what  @param {string} type */
function checkMaterial(what, type) {
  if (!MATERIALS.includes(type))
    throw new SceneError(
      `${what} is of the type ${JSON.stringify(type)}; choose one of ${MATERIALS.join(", ")}`,
    );
}

/** @param {Triples} triples  @returns {number[]} */
function flat(triples) {
  return Array.from(/** @type {ArrayLike<any>} */ (triples)).flat();
}

/** @param {(axis: number) => number} value  @returns {[number, number, number]} */
function triple(value) {
  return [value(0), value(1), value(2)];
}

/** @param {string} name  @param {number[]} points  @param {number[]} corners */
function checkMesh(name, points, corners) {
  const where = `mesh ${JSON.stringify(name)}`;
  if (!points.length || points.length % 3)
    throw new SceneError(`${where} has ${points.length} coordinates; give three for each vertex`);
  const wrong = points.findIndex((value) => !Number.isFinite(value));
  if (wrong >= 0)
    throw new SceneError(`${where}: vertex ${Math.floor(wrong / 3)} has the coordinate ${points[wrong]}`);
  if (!corners.length || corners.length % 3)
    throw new SceneError(`${where} has ${corners.length} corners; give three for each triangle`);
  const count = points.length / 3;
  const outside = corners.find((index) => !Number.isInteger(index) || index < 0 || index >= count);
  if (outside !== undefined)
    throw new SceneError(`${where}: a triangle refers to vertex ${outside} of ${count}`);
}

/**
 * A binary PLY file.
 * @param {number[]} points
 * @param {number[]} corners
 * @param {string} [material]  of the object, where it has one of its own
 * @returns {Uint8Array}
 */
export function ply(points, corners, material = "") {
  const vertices = points.length / 3,
    faces = corners.length / 3;
  const head = utf8.encode(
    "ply\nformat binary_little_endian 1.0\n" +
      (material && `comment material ${material}\n`) +
      `element vertex ${vertices}\nproperty float x\nproperty float y\n` +
      `property float z\nelement face ${faces}\nproperty list uchar int vertex_indices\nend_header\n`,
  );
  const file = new Uint8Array(head.length + 4 * points.length + 13 * faces);
  file.set(head);
  const view = new DataView(file.buffer, head.length);
  points.forEach((value, index) => view.setFloat32(4 * index, value + 0, true));
  corners.forEach((corner, index) => {
    const face = 4 * points.length + 13 * Math.floor(index / 3);
    view.setUint8(face, 3);
    view.setInt32(face + 1 + 4 * (index % 3), corner, true);
  });
  return file;
}

/** @param {readonly SceneryMesh[]} meshes  @param {Record<string, Material>} materials */
function sceneXml(meshes, materials) {
  const bsdfs = Object.entries(materials).map(
    ([key, { type, thickness = 0.1 }]) =>
      `  <bsdf type="itu-radio-material" id="mat-${key}">\n    <string name="type" value="${type}"/>\n` +
      `    <float name="thickness" value="${thickness}"/>\n  </bsdf>\n`,
  );
  const shapes = meshes.map(
    ({ name, material }) =>
      `  <shape type="ply" id="mesh-${name}">\n    <string name="filename" value="meshes/${name}.ply"/>\n` +
      '    <boolean name="face_normals" value="true"/>\n' +
      `    <ref id="mat-${material}" name="bsdf"/>\n  </shape>\n`,
  );
  return `<scene version="2.1.0">\n${bsdfs.join("")}${shapes.join("")}</scene>\n`;
}
