// One WebSocket to the gateway: that of the browser, or of Node, or our own for a Node that has none.
import { joinParts } from "./messages.mjs";

/** How a WebSocket ended. @typedef {{ code: number, reason: string }} Closed */

/** [ms] that a WebSocket may take to open. */
const OPEN_MS = 5000;

/** A WebSocket that is open. */
export class Socket {
  /** @type {(frame: Uint8Array) => void} */
  #onmessage;
  /** @type {(closed: Closed) => void} */
  #onclose;
  /** What came before somebody listened: a refusal comes with the answer to the request. @type {(() => void)[]} */
  #early = [];
  #socket;
  #over = false;

  /** @param {any} socket  of the browser's interface, open */
  constructor(socket) {
    this.#socket = socket;
    this.#onmessage = (frame) => this.#early.push(() => this.#onmessage(frame));
    this.#onclose = (closed) => this.#early.push(() => this.#onclose(closed));
    // Text is no message of this protocol: an empty frame is refused as one.
    socket.onmessage = (/** @type {{ data: ArrayBuffer | string }} */ { data }) => {
      if (!this.#over) this.#onmessage(typeof data === "string" ? new Uint8Array(0) : new Uint8Array(data));
    };
    socket.onclose = (/** @type {Closed} */ { code, reason }) => {
      if (this.#over) return;
      this.#over = true;
      this.#onclose({ code, reason });
    };
    socket.onerror = () => setTimeout(() => socket.onclose({ code: 1006, reason: "" }));
  }

  /**
   * Get what came so far and what comes.
   * @param {(frame: Uint8Array) => void} onmessage  gets each message
   * @param {(closed: Closed) => void} onclose  is called once, unless this side closed it
   */
  listen(onmessage, onclose) {
    this.#onmessage = onmessage;
    this.#onclose = onclose;
    for (const deliver of this.#early.splice(0)) deliver();
  }

  /** @param {Uint8Array[]} parts  of one message */
  send(parts) {
    if (!this.#over) this.#socket.send(joinParts(parts));
  }

  /** Close it after what was sent; nothing is heard of it afterwards. */
  close() {
    this.#over = true;
    this.#socket.close(1000);
  }
}

/**
 * Open a WebSocket.
 *
 * @param {string} url
 * @param {string} token  empty: none
 * @returns {Promise<Socket>}
 * @throws {Error} where nothing listens there; browsers do not say why
 */
export async function openSocket(url, token) {
  const Constructor = /** @type {any} */ (
    globalThis.WebSocket ?? (await import("./node_websocket.mjs")).WebSocket
  );
  const socket = new Constructor(url, ["caviar.v1", ...(token ? [`bearer.${token}`] : [])]);
  socket.binaryType = "arraybuffer";
  return new Promise((resolve, reject) => {
    const fail = (/** @type {string} */ why) => {
      clearTimeout(patience);
      reject(new Error(`${url} does not answer (${why})`));
    };
    const patience = setTimeout(() => {
      fail(`not within ${OPEN_MS} ms`);
      socket.close();
    }, OPEN_MS);
    socket.onopen = () => {
      clearTimeout(patience);
      resolve(new Socket(socket));
    };
    socket.onclose = (/** @type {Closed} */ { code, reason }) => fail(reason || `code ${code}`);
    // The WebSocket of Node 20 does not close where it could not open, others close after their error.
    socket.onerror = (/** @type {any} */ event) =>
      setTimeout(() => fail(event?.message || event?.error?.message || "nothing listens there"));
  });
}
