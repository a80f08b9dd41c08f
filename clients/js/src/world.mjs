// A virtual world: an engine that says where things are.
import { SceneError } from "./errors.mjs";
import { Mounts } from "./mounts.mjs";
import { isMeshName, RunTimeMeshes } from "./run_time_meshes.mjs";
import { sceneOf } from "./scene.mjs";
import { Assets, boxOf, unitMesh } from "./scenery.mjs";
import { byBytes } from "./schema.mjs";
import { Service } from "./service.mjs";
import { encodePayload } from "./topics.mjs";

/** [m] side of the box of a mesh that is refused and has none. */
const SMALLEST_M = 0.01;

/** @import { Product } from "./life.mjs" */
/** @import { Message } from "./messages.mjs" */
/** @import { Action, Command, Input, InputDeclaration, Material, OfferedMesh } from "./types.d.ts" */
/** @import { RunInfo, SceneObject, SceneryMesh } from "./types.d.ts" */
/** @import { Triples } from "./scenery.mjs" */

/**
 * A world of a run. A subclass says in `step` where its objects are; the library does the rest: it mounts the
 * devices of the scenario, serves scenery, keeps heartbeats up, answers what is repeated, refuses what is
 * wrong, and comes back where a connection is lost.
 *
 * @example
 * class Street extends World {
 *   step(t) {
 *     const position = [10 * t, 0, 0.75], velocity = [10, 0, 0], dimensions = [4.5, 1.8, 1.5];
 *     return [{ name: "car", class: "car", position, velocity, dimensions }];
 *   }
 * }
 * await new Street({ name: "world", prefixes: ["car"] }).run("ws://127.0.0.1:8080/ws");
 */
export class World extends Service {
  #assets = new Assets();
  #mounts = new Mounts([]);
  #meshes = new RunTimeMeshes();
  /** Whether another process of this world may have been in the run. */
  #again = false;
  #isPrepared = false;
  /** What was said, once an episode each. @type {Set<string>} */
  #said = new Set();

  /**
   * @param {object} options
   * @param {string} [options.name]  as in the scenario
   * @param {string[]} options.prefixes  what the names of its objects begin with; whole names where they are
   *   known
   * @param {InputDeclaration[]} [options.inputs]  products that `step` gets, such as
   *   `{ topic: "link", lag: 1, required: false }`; commands of agents come without being declared
   * @param {number} [options.grace]  [s] that `prepare` may take
   */
  constructor({ name = "world", prefixes, inputs = [], grace = 60 }) {
    super(name, "world", [{ topic: "action", lag: 1, required: false }, ...inputs], ["scene"], grace);
    this.prefixes = prefixes;
  }

  /**
   * Load what the world needs, and offer meshes and scenery.
   * @param {RunInfo} run
   * @returns {void | Promise<void>}
   */
  prepare(run) {}

  /**
   * Say where the objects are.
   *
   * @param {number} t  time since frame 0 of the episode [s]
   * @param {number} previous  that of the frame which this world completed before [s], from which it has to
   *   advance; it equals `t` in the first frame
   * @param {Command[]} commands  of agents in the frame before
   * @param {Input[]} inputs  products that the world asked for
   * @returns {SceneObject[] | Promise<SceneObject[]>} those that came first in front: they get the devices of
   *   a scenario first; the same with the same seed
   */
  step(t, previous, commands, inputs) {
    throw new TypeError("a world says in step where its objects are");
  }

  /**
   * Offer the mesh of a moving object. In `prepare` it is there for the whole run. In `reset`, `step` and
   * `restore` it comes while the run goes on, and stays as long as an object has it, and 20 frames longer,
   * until the episode ends. A state has no meshes: `restore` offers those of its objects again.
   *
   * @param {string} name  such as `car`
   * @param {Triples} vertices  x forward, y left, z up [m], as triples or one after the other
   * @param {Triples} triangles  three indices each, counter-clockwise seen from outside
   * @param {string} [material]  of ITU-R P.2040, such as `wood`; left out: what the channel's settings say
   * @returns {OfferedMesh} `mesh` and `dimensions` of objects that look like it; where it is none and the
   *   run goes on, that is logged, and the `mesh` is empty: its objects are boxes
   * @throws {SceneError} in `prepare`, where it is none
   */
  offerMesh(name, vertices, triangles, material = "") {
    if (!this.#isPrepared) return this.#assets.offerMesh(name, vertices, triangles, material);
    try {
      const { file, faces, dimensions, centre } = unitMesh(name, vertices, triangles, material);
      const most = this.#meshes.maxFaces;
      if (most && faces > most)
        throw new SceneError(
          `mesh ${JSON.stringify(name)} has ${faces} triangles, and this run takes ${most}`,
        );
      return { mesh: this.#meshes.add(file), dimensions, centre };
    } catch (error) {
      if (!(error instanceof SceneError)) throw error;
      this.#say(`${error.message}; objects with it are boxes`);
      const { dimensions, centre } = boxOf(vertices);
      const [x, y, z] = dimensions.map((side) => Math.max(side, SMALLEST_M));
      return { mesh: "", dimensions: [x, y, z], centre };
    }
  }

  /** @param {string} line */
  #say(line) {
    if (!this.#said.has(line)) this.log(`${this.name}: ${line}`);
    this.#said.add(line);
  }

  /**
   * Offer the static scenery of the run, in `prepare`; at most one world of a run may.
   *
   * @param {SceneryMesh[]} meshes  in world axes [m]
   * @param {Record<string, Material>} materials  by the names that the meshes refer to
   */
  offerScenery(meshes, materials) {
    this.#assets.offerScenery(meshes, materials);
  }

  /**
   * Offer a file as it is, in `prepare`: an XML of a scene and its meshes, or the pattern of an antenna.
   * @param {string} name  such as `scenery/meshes/wall.ply`
   * @param {Uint8Array} data
   */
  offerFile(name, data) {
    this.#assets.offerFile(name, data);
  }

  /** @override  @param {Message} welcome */
  welcomed(welcome) {
    super.welcomed(welcome);
    this.#mounts = new Mounts(this.info.devices);
    this.#again = welcome.epoch > 1 || welcome.attempt > 1;
    this.#isPrepared = false;
  }

  /** @override  @param {Message} prepare */
  async prepared(prepare) {
    await this.prepare(this.info);
    this.#isPrepared = true;
    this.#meshes.maxFaces = prepare.max_faces;
    const prefixes = [...new Set([...this.prefixes, ...this.#mounts.fixedNames])].sort(byBytes);
    return { ready: { geometry: this.#assets.geometry, prefixes }, assets: this.#assets };
  }

  /** @override  @param {string} digest  @param {number} offset */
  piece(digest, offset) {
    return this.#assets.piece(digest, offset) ?? this.#meshes.piece(digest, offset);
  }

  /** @override  @param {Message} error */
  refused({ code, subject }) {
    if (code === "refused-mesh") this.#meshes.refuse(subject);
  }

  /** @override */
  get abilities() {
    return ["geometry"];
  }

  /** @override */
  begin() {
    this.#mounts.clear();
    this.#meshes.reset(this.#again);
    this.#said.clear();
  }

  /** @override  @param {Message} grant  @param {Input[]} inputs */
  async answered(grant, inputs) {
    const actions = inputs.filter((input) => input.topic === "action");
    const commands = actions.flatMap(
      (input) => /** @type {Action | undefined} */ (input.payload)?.commands ?? [],
    );
    const given = await this.step(...this.times(grant), commands, inputs);
    const objects = given.map((object) => this.#looked(object));
    const scene = sceneOf(objects, {
      prefixes: this.prefixes,
      offered: (name) => this.#assets.has(name),
      devices: () => this.#mounts.devices(objects),
    });
    const geometry = this.#meshes.change(grant.frame, scene.assets);
    return {
      products: [/** @type {Product} */ ({ topic: "scene", ...encodePayload("scene", scene) })],
      ...(geometry && { geometry }),
    };
  }

  /** An object as the run may have it. @param {SceneObject} object  @returns {SceneObject} */
  #looked(object) {
    const { mesh } = object;
    if (!mesh || !isMeshName(mesh)) return object;
    if (!this.#meshes.maxFaces) return { ...object, mesh: "" }; // the run takes no meshes now
    if (!this.#meshes.has(mesh))
      this.#say(`${mesh} is not there; objects with it are boxes until offerMesh brings it`);
    return object;
  }

  /** @override */
  ownState() {
    return this.#mounts.arrived;
  }

  /** @override  @param {string[]} arrived  @param {number} frame */
  restoreOwnState(arrived, frame) {
    this.#mounts.clear(arrived);
    this.#meshes.reset(this.#again, frame + 1);
  }
}
