// A virtual world: an engine that says where things are.
import { Mounts } from "./mounts.mjs";
import { sceneOf } from "./scene.mjs";
import { Assets } from "./scenery.mjs";
import { byBytes } from "./schema.mjs";
import { Service } from "./service.mjs";
import { encodePayload } from "./topics.mjs";

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
   * @param {number} t  time of the frame [s]
   * @param {number} previous  time of the frame that this world completed before [s], from which it has to
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
   * Offer the mesh of a moving object, in `prepare`.
   *
   * @param {string} name  such as `car`
   * @param {Triples} vertices  x forward, y left, z up [m], as triples or one after the other
   * @param {Triples} triangles  three indices each, counter-clockwise seen from outside
   * @returns {OfferedMesh} `asset` and `dimensions` of objects that look like it
   */
  offerMesh(name, vertices, triangles) {
    return this.#assets.offerMesh(name, vertices, triangles);
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
  }

  /** @override  @param {Message} prepare */
  async prepared(prepare) {
    await this.prepare(this.info);
    const prefixes = [...new Set([...this.prefixes, ...this.#mounts.fixedNames])].sort(byBytes);
    return { ready: { geometry: this.#assets.geometry, prefixes }, assets: this.#assets };
  }

  /** @override */
  begin() {
    this.#mounts.clear();
  }

  /** @override  @param {Message} grant  @param {Input[]} inputs */
  async answered(grant, inputs) {
    const actions = inputs.filter((input) => input.topic === "action");
    const commands = actions.flatMap(
      (input) => /** @type {Action | undefined} */ (input.payload)?.commands ?? [],
    );
    const objects = await this.step(...this.times(grant), commands, inputs);
    const scene = sceneOf(objects, {
      prefixes: this.prefixes,
      offered: (name) => this.#assets.has(name),
      devices: () => this.#mounts.devices(objects),
    });
    return { products: [/** @type {Product} */ ({ topic: "scene", ...encodePayload("scene", scene) })] };
  }

  /** @override */
  ownState() {
    return this.#mounts.arrived;
  }

  /** @override  @param {string[]} arrived */
  restoreOwnState(arrived) {
    this.#mounts.clear(arrived);
  }
}
