// An observer of a run: it sees the newest finished frame, and holds nothing up (SPEC.md, Observers).
import { ProtocolError, RunError } from "./errors.mjs";
import { decodeMessage, encodeMessage, splitFrame, VERSION } from "./messages.mjs";
import { openSocket } from "./socket.mjs";
import { decodePayload } from "./topics.mjs";

/** @import { Message } from "./messages.mjs" */
/** @import { Socket } from "./socket.mjs" */
/** @import { Observation, ObserverOptions, Payloads } from "./types.d.ts" */

/**
 * An observer of a run. It acknowledges what it got when the next one is asked for: one that is slower than
 * the run sees fewer frames, and each of them is the newest.
 *
 * @example
 * const observer = new Observer("ws://127.0.0.1:8080/ws", { subscriptions: [{ topic: "scene" }] });
 * for await (const { frame, products } of observer)
 *   for (const { payload } of products) console.log(frame, payload.names);
 * console.log(observer.ended);
 */
export class Observer {
  /** Why the run is over; empty while it goes on. */
  ended = "";
  /** WELCOME, once it came: `run`, `seed`, `scenario`. @type {Message | undefined} */
  welcome;
  /** @type {(Uint8Array | Error)[]} what came, and was not looked at */
  #inbox = [];
  #wake = () => {};
  /** @type {Socket | undefined} */
  #socket;
  #closed = false;

  /**
   * @param {string} url  of the gateway, `ws://HOST:PORT/ws`
   * @param {ObserverOptions} options
   */
  constructor(url, { name = "observer", subscriptions = [{ topic: "*" }], token = "", period = 0 } = {}) {
    this.url = url;
    const role = "observer";
    this.hello = { type: "HELLO", version: VERSION, name, role, capabilities: ["observe"], subscriptions };
    this.token = token;
    this.period = period;
  }

  /** Leave: the iteration ends. */
  close() {
    this.#closed = true;
    this.#socket?.close(); // counts as BYE
    this.#wake();
  }

  /**
   * Observe until the run is over, or `close`.
   * @returns {AsyncGenerator<Observation>}
   * @throws {RunError} where nothing listens, the observer is refused, or the connection is lost
   */
  async *[Symbol.asyncIterator]() {
    const socket = (this.#socket = await openSocket(this.url, this.token));
    socket.listen(
      (frame) => this.#came(frame),
      ({ code, reason }) =>
        this.#came(new RunError(`the gateway closed the connection (${reason || `code ${code}`})`)),
    );
    socket.send([encodeMessage(this.hello)]);
    try {
      while (!this.ended) {
        const parts = await this.#next();
        if (!parts) return;
        const message = decodeMessage(parts);
        if (message.type === "WELCOME") this.welcome = message;
        else if (message.type === "SHUTDOWN") this.ended = message.reason;
        else if (message.type === "REFUSE" || message.type === "ERROR")
          throw new RunError(`the broker refused the observer: ${message.code}: ${message.message}`);
        else if (message.type === "OBSERVE") {
          const ready = Date.now() + 1000 * this.period;
          yield observation(message, parts.slice(1));
          const left = ready - Date.now();
          if (left > 0) await new Promise((resolve) => setTimeout(resolve, left));
          socket.send([encodeMessage({ type: "OBSERVED", sequence: message.sequence })]);
        } else throw new ProtocolError("unexpected", `${message.type} has no place at an observer`);
      }
    } finally {
      this.close();
    }
  }

  /** @param {Uint8Array | Error} news */
  #came(news) {
    this.#inbox.push(news);
    this.#wake();
  }

  /** @returns {Promise<Uint8Array[] | undefined>} parts of the next message; undefined after `close` */
  async #next() {
    while (!this.#inbox.length && !this.#closed)
      await new Promise((resolve) => (this.#wake = () => resolve(undefined)));
    const news = this.#closed ? undefined : this.#inbox.shift();
    if (news instanceof Error) throw news;
    return news && splitFrame(news);
  }
}

/** @param {Message} message  @param {Uint8Array[]} parts  @returns {Observation} */
function observation({ episode, frame, t_ns, state, paused, inputs, reports }, parts) {
  const present = inputs.filter((/** @type {any} */ entry) => entry.status !== "absent");
  const products = present.map((/** @type {any} */ entry, /** @type {number} */ index) => {
    const [header, body] = parts.slice(2 * index, 2 * index + 2);
    /** @type {Payloads[keyof Payloads] | undefined} */
    let decoded;
    // Decoded when it is asked for: most pages draw a few topics.
    const payload = () => (decoded ??= decodePayload(entry.topic, header, body));
    return Object.defineProperty({ ...entry, header, body }, "payload", { get: payload });
  });
  return { episode, frame, t: Number(t_ns) / 1e9, state, paused, inputs, reports, products };
}
