// An agent: it chooses beams, moves objects, schedules users.
import { CaviarError } from "./errors.mjs";
import { matches } from "./mounts.mjs";
import { byBytes } from "./schema.mjs";
import { Service } from "./service.mjs";
import { encodePayload } from "./topics.mjs";

/** @import { Product } from "./life.mjs" */
/** @import { Message } from "./messages.mjs" */
/** @import { Command, Input, InputDeclaration, RunInfo } from "./types.d.ts" */

/** @type {InputDeclaration[]} */
const INPUTS = [{ topic: "scene" }, { topic: "link", lag: 1, required: false }];

/**
 * An agent of a run. A subclass says in `step` what is to be done.
 *
 * @example
 * class First extends Agent {
 *   step(t, previous, inputs) {
 *     const scene = inputs.find((input) => input.topic === "scene").payload;
 *     return scene.devices.filter((device) => device.role === "rx" && this.serves(device.name))
 *       .map((device) => ({ type: "beam", tx: "bs", rx: device.name, tx_beam: 0 }));
 *   }
 * }
 */
export class Agent extends Service {
  #ending = {};

  /**
   * @param {object} options
   * @param {string} [options.name]  as in the scenario
   * @param {InputDeclaration[]} [options.inputs]  scene and, of the frame before, link unless said otherwise
   * @param {string[]} [options.actuators]  that it owns, such as `motion:uav`; what the scenario says, and
   *   `beam:*` where it says nothing, unless given
   * @param {number} [options.grace]  [s] that `prepare` may take
   */
  constructor({ name = "agent", inputs = INPUTS, actuators, grace = 60 } = {}) {
    super(name, "agent", inputs, ["action"], grace);
    this.actuators = actuators;
  }

  /** Load what the agent needs. @param {RunInfo} run  @returns {void | Promise<void>} */
  prepare(run) {}

  /**
   * Choose.
   *
   * @param {number} t  time of the frame [s]
   * @param {number} previous  time of the frame before [s]
   * @param {Input[]} inputs  as declared; those that are absent, too
   * @returns {Command[] | Promise<Command[]>} in any order
   */
  step(t, previous, inputs) {
    throw new TypeError("an agent says in step what is to be done");
  }

  /**
   * Look at what the last action of an episode led to.
   * @param {Input[]} inputs
   * @returns {void | Promise<void>}
   */
  finish(inputs) {}

  /**
   * Whether the scenario leaves a receiver to this agent (`users`, `except_users` of its settings).
   * @param {string} receiver
   * @returns {boolean}
   */
  serves(receiver) {
    const { users, except_users: others } = this.info.settings;
    const owns = (/** @type {string[]} */ patterns) =>
      patterns.some((pattern) => matches(pattern.replace(/^beam:/, ""), receiver));
    return users?.length ? owns(users) : !(others?.length && owns(others));
  }

  /** End the episode with this frame; to be called in `step`. */
  endEpisode() {
    this.#ending = { end_episode: true };
  }

  /** @override  @param {Message} prepare */
  async prepared(prepare) {
    await this.prepare(this.info);
    return { ready: { actuators: this.actuators ?? this.#given() } };
  }

  /** @returns {string[]} */
  #given() {
    const { users, except_users: others } = this.info.settings;
    if (users?.length)
      return users.map((/** @type {string} */ pattern) =>
        /^(beam|motion|schedule):/.test(pattern) ? pattern : `beam:${pattern}`,
      );
    return others?.length ? [] : ["beam:*"];
  }

  /**
   * @override
   * @param {Message} grant
   * @param {Input[]} inputs
   * @returns {Promise<{ products: Product[], [field: string]: any }>}
   */
  async answered(grant, inputs) {
    if (grant.final) {
      await this.finish(inputs);
      return { products: [] };
    }
    this.#ending = {};
    const commands = sorted(await this.step(...this.times(grant), inputs));
    return { products: [{ topic: "action", ...encodePayload("action", { commands }) }], ...this.#ending };
  }
}

/** @param {Command[]} commands  @returns {Command[]} by actuator, TX and carrier, as SPEC.md asks */
function sorted(commands) {
  const keyed = commands
    .map((command) => /** @type {const} */ ([keyOf(command), command]))
    .sort(([a], [b]) => byBytes(a, b));
  keyed.forEach(([key], index) => {
    if (index && key === keyed[index - 1][0])
      throw new CaviarError(`two commands for ${key.split("\0").filter(Boolean).join(", ")}; give one`);
  });
  return keyed.map(([, command]) => command);
}

/** @param {Command} command */
function keyOf(command) {
  switch (command.type) {
    case "beam":
      return `beam:${command.rx}\0${command.tx}\0${command.carrier ?? ""}`;
    case "schedule":
      return `schedule:${command.tx}\0${command.rx}\0`;
    case "signal":
      return `signal:${command.signal}\0\0`;
    default:
      return `motion:${command.object}\0\0`;
  }
}
