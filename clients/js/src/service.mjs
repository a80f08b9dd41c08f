// What worlds and agents share: the way to the gateway, and back to it where the connections are lost.
import { RunError, SceneError } from "./errors.mjs";
import { Life } from "./life.mjs";
import { decode, encode, Float } from "./messagepack.mjs";
import { VERSION } from "./messages.mjs";
import { openSocket } from "./socket.mjs";

/** @import { Outcome, Part, Product } from "./life.mjs" */
/** @import { Message } from "./messages.mjs" */
/** @import { Assets } from "./scenery.mjs" */
/** @import { Input, InputDeclaration, RunInfo, RunOptions } from "./types.d.ts" */

/** [ms] between tries to reach a gateway that does not listen yet. */
const PAUSE_MS = 500;
const FIRST_PAUSE_MS = 50;
const LONGEST_PAUSE_MS = 1000;
/** [ms] that a service which comes back waits for WELCOME. */
const WELCOME_MS = 5000;
/** [s] to wait for a gateway, unless `run` is told otherwise. */
const PATIENCE_S = 120;

/**
 * A service of a run: the base of `World` and `Agent`.
 *
 * @implements {Part}
 */
export class Service {
  /** What it knows of the run; from WELCOME on. @type {RunInfo} */
  info = { run: "", seed: 0n, settings: {}, scenario: {}, devices: [], samplingPeriod: 0 };
  /** Where lines for people go. @type {(line: string) => void} */
  log = console.warn;
  /** @type {Life | undefined} */
  #life;
  #left = "";
  #t0_ns = 0n;
  #wake = () => {};

  /**
   * @param {string} name  as in the scenario
   * @param {"world" | "agent"} role
   * @param {InputDeclaration[]} inputs
   * @param {string[]} outputs
   * @param {number} grace  [s] that `prepare` may take in silence
   */
  constructor(name, role, inputs, outputs, grace) {
    this.name = name;
    this.role = role;
    this.inputs = inputs;
    this.outputs = outputs;
    this.grace = grace;
  }

  /**
   * Take part in a run until it is over.
   *
   * @param {string} url  of the gateway, `ws://HOST:PORT/ws`
   * @param {RunOptions} options
   * @returns {Promise<string>} why the run ended
   * @throws {RunError} where the service was refused, lost its broker for good, or no broker was there
   * @throws {Error} of the service's own code, outside of a frame
   */
  async run(url, { token = "", patience = PATIENCE_S, log = console.warn } = {}) {
    if (!/^wss?:\/\/./.test(url))
      throw new RunError(`${url} is no address of a gateway; write ws://HOST:PORT/ws`);
    this.log = log;
    let said = "";
    let until = Date.now() + 1000 * patience,
      pause = PAUSE_MS,
      lost = "";
    for (;;) {
      const outcome = await this.#live(url, token, log, until, lost !== "");
      if ("over" in outcome) return outcome.over;
      if (this.#left) return this.#left;
      if (!outcome.welcomed && !lost && outcome.lost !== said) {
        said = outcome.lost;
        log(`${this.name}: ${said}; trying again for ${Math.round((until - Date.now()) / 1000)} s`);
      }
      if (outcome.welcomed) {
        if (!outcome.rejoin_ms) throw new RunError(outcome.lost);
        if (!lost)
          log(`${this.name}: ${outcome.lost}; trying to come back for ${outcome.rejoin_ms / 1000} s`);
        [until, pause, lost] = [Date.now() + outcome.rejoin_ms, FIRST_PAUSE_MS, outcome.lost];
      }
      if (Date.now() >= until)
        throw new RunError(
          lost
            ? `${lost}, and it could not come back: ${outcome.lost}`
            : `${outcome.lost}, for ${patience} s now; start a run with  caviar run SCENARIO --http HOST:PORT`,
        );
      await new Promise((resolve) => {
        this.#wake = () => resolve(undefined);
        setTimeout(this.#wake, pause);
      });
      if (this.#left) return this.#left;
      if (lost) pause = Math.min(LONGEST_PAUSE_MS, 2 * pause);
    }
  }

  /**
   * Leave the run: says BYE, and `run` returns.
   * @param {string} reason
   */
  leave(reason) {
    this.#left = reason;
    this.#life?.leave(reason);
    this.#wake();
  }

  /**
   * @param {string} url
   * @param {string} token
   * @param {(line: string) => void} log
   * @param {number} until
   * @param {boolean} returning
   * @returns {Promise<Outcome>}
   */
  async #live(url, token, log, until, returning) {
    try {
      const socket = await openSocket(url, token);
      if (this.#left) {
        socket.close();
        return { over: this.#left };
      }
      this.#life = new Life(this, url, token, log, returning);
      return await this.#life.live(socket, returning ? WELCOME_MS : Math.max(until - Date.now(), PAUSE_MS));
    } catch (error) {
      if (this.#life) throw error;
      return { lost: /** @type {Error} */ (error).message, welcomed: false, rejoin_ms: 0 };
    } finally {
      this.#life = undefined;
    }
  }

  // --- what a life asks for
  // ---------------------------------------------------------------------------------

  /** @returns {Message} */
  hello() {
    return {
      type: "HELLO",
      version: VERSION,
      name: this.name,
      role: this.role,
      inputs: this.inputs,
      outputs: this.outputs,
      capabilities: ["assets", "checkpoint", "episodes", ...this.abilities, "parts"],
      implementation: "caviar-js",
      max_in_flight: 4,
    };
  }

  /** @param {Message} welcome */
  welcomed({ run, seed, settings, scenario }) {
    const samplingPeriod = Number(scenario.sampling_period_ns ?? 0) / 1e9;
    this.info = { run, seed, settings, scenario, devices: scenario.devices ?? [], samplingPeriod };
  }

  /** @param {Message} prepare  @returns {Promise<{ ready: Record<string, any>, assets?: Assets }>} */
  async prepared(prepare) {
    throw new TypeError("a service says what it prepares");
  }

  /** @param {Message} reset */
  async began({ seed, t0_ns, seed_episode }) {
    this.#t0_ns = t0_ns;
    this.begin();
    await this.reset(seed, Number(t0_ns) / 1e9, seed_episode);
  }

  /** Forget the episode before. */
  begin() {}

  /**
   * Go to the state at the start of an episode; equal arguments lead to equal frames.
   *
   * @param {bigint} seed
   * @param {number} t0  time of frame 0 in the run [s]
   * @param {number} episode  number of the episode from the first one with this seed
   * @returns {void | Promise<void>}
   */
  reset(seed, t0, episode) {}

  /**
   * @param {Message} grant
   * @param {Input[]} inputs
   * @returns {Promise<{ products: Product[], [field: string]: any }>}
   */
  async answered(grant, inputs) {
    throw new TypeError("a service says what it answers");
  }

  /**
   * Time of a grant and of the frame that this service completed before it, since frame 0 of the episode [s].
   * @param {Message} grant
   * @returns {[t: number, previous: number]}
   */
  times({ t_ns, previous_frame }) {
    const period = BigInt(this.info.scenario.sampling_period_ns ?? 0);
    return [Number(t_ns - this.#t0_ns) / 1e9, Number(BigInt(Math.max(previous_frame, 0)) * period) / 1e9];
  }

  /**
   * State that later frames depend on, beyond what `reset` and the frames' inputs make of it; null where
   * there is none.
   * @returns {unknown} plain: what JSON has, and typed arrays, which come back as lists
   */
  save() {
    return null;
  }

  /**
   * Take over a state that `save` returned, in this or in another process.
   * @param {any} state
   * @returns {void | Promise<void>}
   */
  restore(state) {}

  /** What the library itself has to remember. @returns {unknown} */
  ownState() {
    return null;
  }

  /** @param {any} state  @param {number} frame  after which the service goes on */
  restoreOwnState(state, frame) {}

  /** Capabilities that only some services have. @returns {string[]} */
  get abilities() {
    return [];
  }

  /**
   * A piece of a file that this service brought; undefined where there is none.
   * @param {string} digest
   * @param {number} offset
   * @returns {{ size: number, piece: Uint8Array } | undefined}
   */
  piece(digest, offset) {
    return undefined;
  }

  /** The broker could not use what this service sent. @param {Message} error */
  refused(error) {}

  /** @returns {Promise<Uint8Array>} */
  async saved() {
    return encode({ caviar: this.role, own: this.ownState(), state: this.save() });
  }

  /** @param {Uint8Array} bytes  @param {number} [frame]  after which the service goes on */
  async restored(bytes, frame = -1) {
    const found = unmarked(decode(bytes));
    if (found?.caviar !== this.role)
      throw new SceneError(`a state that no ${this.role} of this library saved`);
    this.restoreOwnState(found.own, frame);
    await this.restore(found.state);
  }
}

/** @param {any} value  @returns {any} with plain numbers */
function unmarked(value) {
  if (value instanceof Float) return value.value;
  if (Array.isArray(value)) return value.map(unmarked);
  if (typeof value !== "object" || value === null) return value;
  return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, unmarked(item)]));
}
