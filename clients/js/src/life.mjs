// One incarnation of a service at a broker: from HELLO to BYE, or to the loss of a connection. Rows of
// SPEC.md's table "Wrong things and their answers" are answered here.
import { ProtocolError, RunError } from "./errors.mjs";
import { Heartbeat, Progress } from "./heartbeat.mjs";
import { decodeMessage, encodeMessage, splitFrame } from "./messages.mjs";
import { openSocket } from "./socket.mjs";
import { decodePayload, payloadDigest } from "./topics.mjs";

/** @import { Message } from "./messages.mjs" */
/** @import { Assets } from "./scenery.mjs" */
/** @import { Closed, Socket } from "./socket.mjs" */
/** @import { Input, Log } from "./types.d.ts" */

/**
 * One product of a DONE.
 * @typedef {{ topic: string, header: Uint8Array, body: Uint8Array, digest: string }} Product
 */
/**
 * What a life asks of the service that it is one of.
 * @typedef {object} Part
 * @property {string} name
 * @property {string} role
 * @property {number} grace  [s] that its preparation may stay silent
 * @property {() => Message} hello
 * @property {(welcome: Message) => void} welcomed
 * @property {(prepare: Message) => Promise<{ ready: Record<string, any>, assets?: Assets }>} prepared
 * @property {(reset: Message) => Promise<void>} began
 * @property {(grant: Message, inputs: Input[]) => Promise<{ products: Product[], [field: string]: any }>}
 *   answered
 * @property {() => Promise<Uint8Array>} saved
 * @property {(state: Uint8Array, frame: number) => Promise<void>} restored
 * @property {(digest: string, offset: number) => ({ size: number, piece: Uint8Array } | undefined)} piece
 * @property {(error: Message) => void} refused
 */
/**
 * How a life ended: the run is over, or its connections are lost.
 * @typedef {{ over: string } | { lost: string, welcomed: boolean, rejoin_ms: number }} Outcome
 */

/** [B] of answers that are kept for a GRANT that is repeated; the newest two are, however large. */
const KEPT = 64 << 20;
/** [B] of an input up to which its digest is compared. */
const COMPARED = 16 << 10;
/** Handled as they come, also while a step goes on; the others in their order. */
const AT_ONCE = new Set(["ASSET_GET", "CANCEL", "STALE", "ERROR", "REFUSE", "SHUTDOWN"]);

/** A service between HELLO and BYE. */
export class Life {
  /** @type {"connecting" | "joined" | "preparing" | "ready" | "active"} */
  #state = "connecting";
  /** @type {Record<string, number>} */
  #who = {};
  /** Of the episode. @type {Record<string, number>} */
  #turn = {};
  /** Newest frame that was answered. */
  #answered = -1;
  /** @type {Map<number, Uint8Array[]>} */
  #answers = new Map();
  /** [B] of them. */
  #kept = 0;
  /** @type {Promise<void>} */
  #queue = Promise.resolve();
  #progress = new Progress();
  /** @type {Heartbeat | undefined} */
  #heart;
  #hasOffered = false;
  #rejoin_ms = 0;
  #over = false;
  /** @type {Error | undefined} what `step` threw first; the run is over, and was no success */
  #faulted;
  /** @type {(outcome: Outcome) => void} */
  #resolve = () => {};
  /** @type {(error: Error) => void} */
  #reject = () => {};

  /**
   * @param {Part} part
   * @param {string} url
   * @param {string} token
   * @param {Log} log
   * @param {boolean} returning  after one whose connections were lost
   */
  constructor(part, url, token, log, returning) {
    this.returning = returning;
    this.part = part;
    this.url = url;
    this.token = token;
    this.log = log;
  }

  /**
   * Live it.
   * @param {Socket} socket  open, of the ordered connection
   * @param {number} welcome_ms  to wait for WELCOME
   * @returns {Promise<Outcome>}
   * @throws {RunError} where the service cannot take part, or failed
   */
  live(socket, welcome_ms) {
    this.socket = socket;
    const patience = setTimeout(() => this.#lose("no WELCOME came"), welcome_ms);
    const outcome = new Promise((resolve, reject) => {
      this.#resolve = resolve;
      this.#reject = reject;
    });
    this.#send(this.part.hello());
    socket.listen(
      (frame) => this.#received(frame),
      (closed) => this.#closed(closed),
    );
    return /** @type {Promise<Outcome>} */ (outcome.finally(() => clearTimeout(patience)));
  }

  /** Say BYE, and end. @param {string} reason */
  leave(reason) {
    if (this.#over) return;
    if (this.#state !== "connecting") this.#send({ type: "BYE", ...this.#who, reason });
    this.#end();
    this.#resolve({ over: reason });
  }

  #end() {
    this.#over = true;
    this.#heart?.stop();
    this.socket?.close();
  }

  /** @param {Error} error */
  #fail(error) {
    if (this.#over) return;
    this.#end();
    this.#reject(error);
  }

  /** @param {string} lost  why */
  #lose(lost) {
    if (this.#over) return;
    this.#end();
    this.#resolve({ lost, welcomed: this.#state !== "connecting", rejoin_ms: this.#rejoin_ms });
  }

  /** @param {Closed} closed */
  #closed({ code, reason }) {
    const why = `the gateway closed the connection (${reason || `code ${code}`})`;
    // 1007 and 1008 say that this side is wrong: trying again would end in the same way.
    if (code === 1007 || code === 1008) this.#fail(new RunError(why));
    else this.#lose(why);
  }

  /** @param {Message} message  @param {...Uint8Array} parts */
  #send(message, ...parts) {
    if (!this.#over) this.socket?.send([encodeMessage(message), ...parts]);
  }

  /** @param {string} code  @param {string} message  @param {Record<string, string>} more */
  #complain(code, message, more = {}) {
    this.#send({ type: "ERROR", code, message, ...more });
  }

  /** @param {Uint8Array} frame */
  #received(frame) {
    if (this.#over) return;
    try {
      const parts = splitFrame(frame),
        message = decodeMessage(parts);
      if (AT_ONCE.has(message.type)) this.#handledAtOnce(message);
      else
        this.#queue = this.#queue
          .then(() => this.#handled(message, parts))
          .catch((error) => this.#fail(error));
    } catch (error) {
      if (!(error instanceof ProtocolError)) this.#fail(/** @type {Error} */ (error));
      else if (error.code === "version") this.#fail(new RunError(error.message));
      else this.#complain(error.code, error.message);
    }
  }

  /** @param {Message} message */
  #handledAtOnce(message) {
    switch (message.type) {
      case "ASSET_GET":
        return this.#assetGet(message);
      case "STALE":
        return this.log(`${this.part.name}: my ${message.of} was stale`);
      case "ERROR":
        this.part.refused(message);
        return this.log(
          `${this.part.name}: the broker could not use a message: ${message.code}: ${message.message}`,
        );
      case "REFUSE":
        return message.code === "name-taken" && this.returning
          ? this.#lose(message.message)
          : this.#fail(new RunError(`refused: ${message.code}: ${message.message}`));
      case "SHUTDOWN":
        // A reason that blames a service begins with its role and name.
        if (message.reason.startsWith(`${this.part.role} '${this.part.name}' `))
          this.#faulted ??= new RunError(message.reason);
        if (this.#faulted) this.#reject(this.#faulted); // before what `leave` resolves
        return this.leave(message.reason);
    } // CANCEL is advice: the answer that is under way is still due
  }

  /** @param {Message} message  @param {Uint8Array[]} parts */
  async #handled(message, parts) {
    if (this.#over) return;
    const { type } = message;
    if (type === "WELCOME" && this.#state === "connecting") await this.#welcome(message);
    else if (type === "PREPARE" && this.#state === "joined" && this.#isMine(message))
      await this.#prepare(message);
    else if (type === "RESET" && this.#state === "ready" && this.#isMine(message)) await this.#reset(message);
    else if (this.#state !== "active" || !this.#isMine(message)) this.#unexpected(message);
    else if (type === "GRANT") await this.#grant(message, parts);
    else if (type === "CHECKPOINT" && message.frame === this.#answered) await this.#checkpoint(message);
    else if (type === "RESTORE" && this.#answered < 0) await this.#restore(message, parts[1]);
    else if (type === "EPISODE_END") this.#state = "ready";
    else this.#unexpected(message);
  }

  /**
   * @param {Message} message
   * @returns {boolean} whether it is for this incarnation, and this episode where it says one
   */
  #isMine(message) {
    const expected = message.type === "RESET" ? this.#who : { ...this.#who, ...this.#turn };
    return Object.entries(expected).every(
      ([field, value]) => message[field] === undefined || message[field] === value,
    );
  }

  /** @param {Message} message */
  #unexpected({ type, epoch, attempt, episode, frame }) {
    const of = [
      ["epoch", epoch],
      ["attempt", attempt],
      ["episode", episode],
      ["frame", frame],
    ]
      .filter(([, value]) => value !== undefined)
      .map((pair) => pair.join(" "))
      .join(", ");
    this.#complain("unexpected", `${type}${of && ` of ${of}`} is not due: this service is ${this.#state}`, {
      of: type,
    });
  }

  /** @param {Message} welcome */
  async #welcome(welcome) {
    this.#state = "joined";
    this.#who = { epoch: welcome.epoch, attempt: welcome.attempt };
    this.#rejoin_ms = welcome.rejoin_ns / 1e6;
    this.part.welcomed(welcome);
    let pulse;
    try {
      pulse = await openSocket(this.url, this.token);
    } catch (error) {
      return this.#lose(/** @type {Error} */ (error).message);
    }
    if (this.#over) return pulse.close();
    const who = { epoch: welcome.epoch, attempt: welcome.attempt, name: this.part.name };
    const times = { heartbeat_ns: welcome.heartbeat_ns, liveness_ns: welcome.liveness_ns };
    this.#heart = new Heartbeat(pulse, who, times, this.#progress, (why) => this.#lose(why));
  }

  /** @param {Message} prepare */
  async #prepare(prepare) {
    this.#state = "preparing";
    this.#progress.enter("prepare", this.part.grace);
    const { ready, assets } = await this.#orFault("prepare", () => this.part.prepared(prepare));
    this.#hasOffered = true;
    if (assets?.listed.length) this.#send({ type: "ASSET_OFFER", ...this.#who, assets: assets.listed });
    this.#send({ type: "READY", ...this.#who, ...ready });
    this.#state = "ready";
    this.#progress.enter("ready");
  }

  /** @param {Message} get */
  #assetGet({ digest, offset }) {
    const found = this.#hasOffered ? this.part.piece(digest, offset) : undefined;
    if (!found)
      return this.#complain("unknown-asset", `no file that I offered has this digest and a byte ${offset}`, {
        of: "ASSET_GET",
        subject: digest,
      });
    this.#send({ type: "ASSET_DATA", digest, offset, size: found.size }, found.piece);
  }

  /** @param {Message} reset */
  async #reset(reset) {
    this.#turn = { episode: reset.episode };
    this.#answers.clear();
    this.#kept = 0;
    this.#answered = -1;
    this.#progress.enter("reset");
    await this.#orFault("reset", () => this.part.began(reset));
    this.#state = "active";
    this.#send({ type: "RESET_DONE", ...this.#who, ...this.#turn });
  }

  /** @param {Message} grant  @param {Uint8Array[]} parts */
  async #grant(grant, parts) {
    const stored = this.#answers.get(grant.frame);
    if (stored) return void (this.#over || this.socket?.send(stored));
    if (grant.frame <= this.#answered) return this.#unexpected(grant);
    this.#progress.enter("step");
    const answer = await this.#answer(grant, parts);
    this.#answered = grant.frame;
    this.#keep(grant.frame, answer);
    if (!this.#over) this.socket?.send(answer);
  }

  /** @param {Message} grant  @param {Uint8Array[]} parts  @returns {Promise<Uint8Array[]>} DONE or FAULT */
  async #answer(grant, parts) {
    const turn = { ...this.#who, ...this.#turn, frame: grant.frame };
    let culprit = "";
    try {
      /** @type {Input[]} */
      const inputs = [];
      let next = 1;
      for (const entry of grant.inputs) {
        culprit = entry.source;
        if (entry.status === "absent") inputs.push({ ...entry, payload: undefined });
        else inputs.push({ ...entry, payload: inputOf(entry, parts[next++], parts[next++]) });
      }
      culprit = "";
      const began = performance.now();
      const { products, ...more } = await this.part.answered(grant, inputs);
      const done = {
        type: "DONE",
        ...turn,
        ...more,
        products: products.map(({ topic, digest }) => ({ topic, digest })),
        measured: { step: Math.round(1e6 * (performance.now() - began)) },
      };
      return [encodeMessage(done), ...products.flatMap(({ header, body }) => [header, body])];
    } catch (error) {
      const { message, stack = "" } = asError(error);
      this.log(`${this.part.name}: frame ${grant.frame}: ${culprit ? message : stack}`);
      this.#faulted ??= new RunError(`it failed in frame ${grant.frame}: ${message}`);
      return [encodeMessage({ type: "FAULT", ...turn, phase: "step", message, detail: stack, culprit })];
    }
  }

  /** @param {number} frame  @param {Uint8Array[]} answer */
  #keep(frame, answer) {
    this.#answers.set(frame, answer);
    this.#kept += sizeOf(answer);
    for (const [oldest, parts] of this.#answers) {
      if (this.#kept <= KEPT || this.#answers.size <= 2) break;
      this.#answers.delete(oldest);
      this.#kept -= sizeOf(parts);
    }
  }

  /** @param {Message} checkpoint */
  async #checkpoint({ frame }) {
    const state = await this.#orFault("checkpoint", () => this.part.saved());
    this.#send({ type: "CHECKPOINT_DONE", ...this.#who, ...this.#turn, frame }, state);
  }

  /** @param {Message} restore  @param {Uint8Array} state */
  async #restore({ frame }, state) {
    await this.#orFault("restore", () => this.part.restored(state, frame));
    this.#answered = frame;
    this.#send({ type: "READY", ...this.#who });
  }

  /**
   * Do what the service has to; where it throws, say FAULT and end.
   * @template T
   * @param {string} phase
   * @param {() => Promise<T>} work
   * @returns {Promise<T>}
   */
  async #orFault(phase, work) {
    try {
      return await work();
    } catch (error) {
      const { message, stack = "" } = asError(error);
      this.#send({ type: "FAULT", ...this.#who, ...this.#turn, phase, message, detail: stack });
      throw error;
    }
  }
}

/** @param {Message} entry  @param {Uint8Array} header  @param {Uint8Array} body  @returns {any} */
function inputOf({ topic, source, digest }, header, body) {
  try {
    if (header.length + body.length <= COMPARED && digest && payloadDigest(header, body) !== digest) {
      throw new ProtocolError("malformed", "its bytes do not have the digest of its producer");
    }
    return decodePayload(topic, header, body);
  } catch (error) {
    throw new ProtocolError(
      "malformed",
      `the product of ${topic} from ${source} cannot be used: ${asError(error).message}`,
    );
  }
}

/** @param {Uint8Array[]} parts */
function sizeOf(parts) {
  return parts.reduce((bytes, part) => bytes + part.length, 0);
}

/** @param {unknown} error  @returns {Error} */
function asError(error) {
  return error instanceof Error ? error : new Error(String(error));
}
