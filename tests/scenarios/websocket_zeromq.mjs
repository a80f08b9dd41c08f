// What clients/minimal/node/agent.mjs takes for the package zeromq, over Node's own WebSocket and written
// from SPEC.md, section WebSocket.
import { setTimeout as sleep } from "node:timers/promises";

export class Dealer {
  constructor({ receiveTimeout } = {}) { this.timeout = receiveTimeout; this.came = []; this.wake = () => {}; }

  connect(url) {
    this.socket = new WebSocket(url, ["caviar.v1"]);
    this.socket.binaryType = "arraybuffer";
    this.open = new Promise((resolve) => { this.socket.onopen = resolve; });
    this.socket.onmessage = ({ data }) => { this.came.push(Buffer.from(data)); this.wake(); };
  }

  async send(message) {
    await this.open;
    const parts = (Array.isArray(message) ? message : [message]).map((part) => Buffer.from(part));
    const head = Buffer.alloc(4 * (1 + parts.length));
    [parts.length, ...parts.map((part) => part.length)].forEach((value, i) => head.writeUInt32LE(value, 4 * i));
    this.socket.send(Buffer.concat([head, ...parts]));
  }

  async receive() {
    if (!this.came.length) {
      const arrival = new Promise((resolve) => { this.wake = resolve; });
      await Promise.race(this.timeout ? [arrival, sleep(this.timeout)] : [arrival]);
    }
    if (!this.came.length) throw new Error("nothing came");
    const frame = this.came.shift(), count = frame.readUInt32LE(0), parts = [];
    for (let i = 0, place = 4 * (1 + count); i < count; i++) {
      const length = frame.readUInt32LE(4 * (i + 1));
      parts.push(frame.subarray(place, place += length));
    }
    return parts;
  }
}

process.on("beforeExit", () => process.exit()); // an open socket keeps nobody up
