// The heartbeat connection (SPEC.md, Heartbeats and liveness).
import { encodeMessage, decodeMessage, splitFrame } from "./messages.mjs";

/** @import { Socket } from "./socket.mjs" */

/** [ms] at most that an answer may be late beyond the broker's liveness. */
const LATE_MS = 1000;

/** What the user sees of a service that stalls. */
export class Progress {
  progress = 0;
  phase = "joined";
  grace_ns = 0;

  /** The work advanced. @param {string} phase  @param {number} grace_s  that this phase may stay silent */
  enter(phase, grace_s = 0) {
    this.progress += 1;
    this.phase = phase;
    this.grace_ns = Math.round(grace_s * 1e9);
  }
}

/** Sends heartbeats and notices a broker that does not answer them. */
export class Heartbeat {
  #sequence = 0;
  /** When the oldest heartbeat without an answer was sent [ms]; 0: all are answered. */
  #unanswered = 0;
  #timer;

  /**
   * @param {Socket} socket
   * @param {{ epoch: number, attempt: number, name: string }} who
   * @param {{ heartbeat_ns: number, liveness_ns: number }} welcome
   * @param {Progress} progress
   * @param {(why: string) => void} lost  is called where the broker is gone
   */
  constructor(socket, who, welcome, progress, lost) {
    this.socket = socket;
    this.progress = progress;
    this.lost = lost;
    this.liveness_ms = welcome.liveness_ns / 1e6;
    socket.listen(
      (frame) => this.#received(frame),
      ({ code, reason }) => lost(`the heartbeat connection closed (${reason || `code ${code}`})`),
    );
    this.#send({ type: "ATTACH", ...who });
    this.#timer = setInterval(() => this.#beat(), welcome.heartbeat_ns / 1e6);
  }

  /** End it. */
  stop() {
    clearInterval(this.#timer);
    this.socket.close();
  }

  #beat() {
    const { progress, phase, grace_ns } = this.progress;
    this.#send({ type: "HEARTBEAT", sequence: this.#sequence++, progress, phase, grace_ns });
    const oldest = this.#unanswered;
    if (Date.now() - oldest < this.liveness_ms) return;
    // A page in the background or a long step holds this timer up, and answers that came meanwhile have not been
    // read yet; a busy broker is late. So it has a while more before its silence is believed.
    setTimeout(
      () => {
        if (this.#unanswered === oldest)
          this.lost(`the broker has been silent for ${Math.round(Date.now() - oldest)} ms`);
      },
      Math.min(LATE_MS, this.liveness_ms),
    );
  }

  /** @param {import("./messages.mjs").Message} message */
  #send(message) {
    this.#unanswered ||= Date.now();
    this.socket.send([encodeMessage(message)]);
  }

  /** @param {Uint8Array} frame */
  #received(frame) {
    this.#unanswered = 0;
    let message;
    try {
      message = decodeMessage(splitFrame(frame));
    } catch {
      return; // noise: the next heartbeat asks again
    }
    if (message.type === "REFUSE" || (message.type === "ERROR" && message.code === "unknown-peer"))
      this.lost(message.message);
  }
}
