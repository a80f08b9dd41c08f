// Meshes that come while an episode goes on, each for as long as an object has it (SPEC.md, Geometry at run
// time).
import { MAX_ASSET_CHUNK } from "./messages.mjs";
import { sha256 } from "./sha256.mjs";

/** Frames for which a mesh stays that no object has any more: one that comes back soon costs nothing. */
export const LINGER_FRAMES = 20;
const NAME = /^objects\/[0-9a-f]{64}\.ply$/;

/**
 * Whether a name is that of a mesh that came while a run went on: consumers without that mesh show a box.
 * @param {string} name
 */
export function isMeshName(name) {
  return NAME.test(name);
}

/** The meshes of a world beside those of its scenery. */
export class RunTimeMeshes {
  /** Triangles that a mesh may have; 0: the run takes none, and objects are boxes. */
  maxFaces = 0;
  /**
   * File, and frame in which an object had it last or in which it came, by name.
   * @type {Map<string, { file: Uint8Array, used: number }>}
   */
  #meshes = new Map();
  /** @type {Set<string>} */
  #refused = new Set();
  /** Names that were announced last; undefined: not known. @type {string | undefined} */
  #announced = "";
  /** That is computed next. */
  #frame = 0;

  /**
   * Begin an episode, or go on in it.
   * @param {boolean} again  whether another process of this world may have announced some before
   * @param {number} [frame]  that is computed next
   */
  reset(again, frame = 0) {
    this.#meshes.clear();
    this.#announced = again ? undefined : "";
    this.#frame = frame;
  }

  /** Bring a mesh; its name. @param {Uint8Array} file */
  add(file) {
    const name = `objects/${sha256(file)}.ply`;
    const used = Math.max(this.#frame, this.#meshes.get(name)?.used ?? 0);
    this.#meshes.set(name, { file, used });
    return name;
  }

  /** Whether objects may have it. @param {string} name */
  has(name) {
    return this.#meshes.has(name) && !this.#refused.has(name);
  }

  /**
   * What DONE says of the meshes of a frame; undefined where they are those of the frame before.
   * @param {number} frame
   * @param {readonly string[]} assets  that objects have
   */
  change(frame, assets) {
    this.#frame = frame + 1;
    if (!this.maxFaces) return undefined;
    for (const name of assets) {
      const mesh = this.#meshes.get(name);
      if (mesh) mesh.used = frame;
    }
    for (const [name, { used }] of this.#meshes)
      if (used + LINGER_FRAMES < frame) this.#meshes.delete(name);
    const names = [...this.#meshes.keys()].filter((name) => this.has(name)).sort();
    if (names.join() === this.#announced) return undefined;
    this.#announced = names.join();
    const size = (/** @type {string} */ name) => this.#meshes.get(name)?.file.length ?? 0;
    return { frame, assets: names.map((name) => ({ name, digest: name.slice(8, 72), size: size(name) })) };
  }

  /** The broker takes a mesh for none, or all that were announced. @param {string} digest  empty: all */
  refuse(digest) {
    for (const name of this.#meshes.keys())
      if (!digest || name.slice(8, 72) === digest) this.#refused.add(name);
  }

  /**
   * A piece of a mesh; undefined where there is none.
   * @param {string} digest
   * @param {number} offset
   * @returns {{ size: number, piece: Uint8Array } | undefined}
   */
  piece(digest, offset) {
    const file = this.#meshes.get(`objects/${digest}.ply`)?.file;
    if (!file || offset > file.length) return undefined;
    return { size: file.length, piece: file.subarray(offset, offset + MAX_ASSET_CHUNK) };
  }
}
