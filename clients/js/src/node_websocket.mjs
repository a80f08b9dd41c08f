// A WebSocket (RFC 6455) for versions of Node that have none of their own, 18 to 21: what a client of one
// gateway needs, with the part of the browser's interface that socket.mjs uses. Bundlers for browsers leave
// this file out.
import { createHash, randomBytes } from "node:crypto";
import http from "node:http";
import https from "node:https";

/** @import { Duplex } from "node:stream" */

const GUID = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11";
const CONTINUATION = 0,
  TEXT = 1,
  BINARY = 2,
  CLOSE = 8,
  PING = 9,
  PONG = 10;
const MAX_MESSAGE = 1 << 28;
/** [ms] that the peer has for its part of the closing handshake. */
const CLOSE_MS = 1000;

/** What socket.mjs uses of the browser's class of this name. */
export class WebSocket {
  binaryType = "arraybuffer";
  /** @type {() => void} */
  onopen = () => {};
  /** @type {(event: { data: ArrayBuffer | string }) => void} */
  onmessage = () => {};
  /** @type {(event: { code: number, reason: string }) => void} */
  onclose = () => {};
  /** @type {(event: { message?: string }) => void} */
  onerror = () => {};
  /** @type {Duplex | undefined} */
  #stream;
  #received = Buffer.alloc(0);
  /** @type {Buffer[]} */
  #chunks = [];
  #chunkBytes = 0;
  /** @type {Buffer[]} */
  #fragments = [];
  #fragmentsAreText = false;
  #told = { code: 1006, reason: "" };
  #closing = false;
  #over = false;

  /**
   * @param {string} url
   * @param {string[]} protocols
   */
  constructor(url, protocols) {
    const { protocol, href } = new URL(url);
    const key = randomBytes(16).toString("base64");
    const request = (protocol === "wss:" ? https : http).request(href.replace(/^ws/, "http"), {
      headers: {
        Connection: "Upgrade",
        Upgrade: "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": key,
        "Sec-WebSocket-Protocol": protocols.join(", "),
      },
      agent: false,
    });
    request.on("upgrade", (response, stream, head) => {
      if (
        response.headers["sec-websocket-accept"] !==
        createHash("sha1")
          .update(key + GUID)
          .digest("base64")
      ) {
        stream.destroy();
        this.#end("the answer is none of a WebSocket");
      } else this.#opened(stream, head);
    });
    request.on("response", (response) => {
      response.resume();
      this.#end(`HTTP status ${response.statusCode}`);
    });
    request.on("error", (error) => this.#end(error.message));
    request.end();
    this.request = request;
  }

  /** @param {Uint8Array} data  one binary message */
  send(data) {
    this.#write(BINARY, data);
  }

  /** @param {number} code */
  close(code = 1000) {
    if (this.#closing) return;
    this.#closing = true;
    if (!this.#stream) {
      this.request.destroy();
      return;
    }
    const payload = Buffer.alloc(2);
    payload.writeUInt16BE(code);
    this.#write(CLOSE, payload);
    setTimeout(() => this.#stream?.destroy(), CLOSE_MS).unref();
  }

  /** @param {Duplex} stream  @param {Buffer} head */
  #opened(stream, head) {
    this.#stream = stream;
    /** @type {any} */ (stream).setNoDelay?.(true);
    stream.on("data", (chunk) => this.#take(chunk));
    stream.on("error", (error) => {
      this.#told.reason ||= error.message;
    });
    stream.on("close", () => this.#end(""));
    stream.on("end", () => stream.destroy());
    queueMicrotask(() => {
      this.onopen();
      if (head.length) this.#take(head);
    });
  }

  /** @param {string} why */
  #end(why) {
    if (this.#over) return;
    this.#over = true;
    if (why) this.onerror({ message: why });
    this.onclose({ ...this.#told, reason: this.#told.reason || why });
  }

  /** @param {number} opcode  @param {Uint8Array} payload */
  #write(opcode, payload) {
    if (!this.#stream || this.#stream.destroyed) return;
    const size = payload.length < 126 ? 0 : payload.length < 0x10000 ? 2 : 8;
    const frame = Buffer.allocUnsafe(6 + size + payload.length);
    frame[0] = 0x80 | opcode;
    frame[1] = 0x80 | (size === 0 ? payload.length : size === 2 ? 126 : 127);
    if (size === 2) frame.writeUInt16BE(payload.length, 2);
    if (size === 8) frame.writeBigUInt64BE(BigInt(payload.length), 2);
    const mask = randomBytes(4),
      at = 6 + size;
    mask.copy(frame, at - 4);
    for (let i = 0; i < payload.length; i++) frame[at + i] = payload[i] ^ mask[i & 3];
    this.#stream.write(frame);
  }

  /** @param {Buffer} chunk */
  #take(chunk) {
    this.#chunks.push(chunk);
    this.#chunkBytes += chunk.length;
    if (this.#wanted() > MAX_MESSAGE) return this.#refuse();
    // Joined only when the frame that they belong to may be whole: large ones come in hundreds of chunks.
    while (!this.#over && this.#received.length + this.#chunkBytes >= this.#wanted()) {
      if (this.#chunks.length) {
        this.#received = Buffer.concat([this.#received, ...this.#chunks]);
        this.#chunks = [];
        this.#chunkBytes = 0;
      }
      if (this.#received.length < this.#wanted()) return;
      if (this.#received.length >= 2) this.#frame();
      if (!this.#received.length) return;
    }
  }

  /** Bytes that the frame at hand has to have, as far as that can be known yet. */
  #wanted() {
    const bytes = this.#received;
    if (bytes.length < 2) return 2;
    const short = bytes[1] & 0x7f,
      size = short === 126 ? 2 : short === 127 ? 8 : 0;
    if (bytes.length < 2 + size) return 2 + size;
    const length = size === 2 ? bytes.readUInt16BE(2) : size === 8 ? Number(bytes.readBigUInt64BE(2)) : short;
    return 2 + size + length;
  }

  #frame() {
    const bytes = this.#received,
      total = this.#wanted(),
      short = bytes[1] & 0x7f;
    const begin = short === 126 ? 4 : short === 127 ? 10 : 2;
    if (bytes.length < total) return;
    const payload = bytes.subarray(begin, total);
    this.#received = bytes.subarray(total);
    const opcode = bytes[0] & 15,
      final = (bytes[0] & 0x80) !== 0;
    // A server never masks, and control frames are short and whole.
    if (bytes[1] & 0x80 || bytes[0] & 0x70 || (opcode >= CLOSE && (!final || payload.length > 125)))
      this.#refuse();
    else if (opcode === PING) this.#write(PONG, payload);
    else if (opcode === CLOSE) this.#closed(payload);
    else if (opcode !== PONG) this.#data(opcode, final, payload);
  }

  #refuse() {
    this.#told = { code: 1006, reason: "the gateway sent a frame that is none, or too large" };
    this.#stream?.destroy();
  }

  /** @param {Buffer} payload */
  #closed(payload) {
    this.#told =
      payload.length >= 2
        ? { code: payload.readUInt16BE(0), reason: payload.subarray(2).toString() }
        : { code: 1005, reason: "" };
    if (!this.#closing) {
      this.#closing = true;
      this.#write(CLOSE, payload.subarray(0, 2));
    }
    this.#stream?.end();
  }

  /** @param {number} opcode  @param {boolean} final  @param {Buffer} payload */
  #data(opcode, final, payload) {
    if (opcode !== CONTINUATION) {
      this.#fragments = [];
      this.#fragmentsAreText = opcode === TEXT;
    }
    this.#fragments.push(payload);
    if (!final) return;
    const whole = Buffer.concat(this.#fragments);
    this.#fragments = [];
    this.onmessage({
      data: this.#fragmentsAreText
        ? whole.toString()
        : /** @type {ArrayBuffer} */ (Uint8Array.prototype.slice.call(whole).buffer),
    });
  }
}
