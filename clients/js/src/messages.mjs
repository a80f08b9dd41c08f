// The messages between a service and the broker (SPEC.md, Messages), and their frame on a WebSocket.
import { ProtocolError } from "./errors.mjs";
import { decode, encode } from "./messagepack.mjs";
import { bigInteger, bool, integer, list, map, optional, plain, string, Struct } from "./schema.mjs";

/** @import { Context } from "./schema.mjs" */

/** Version of the protocol that this library speaks. */
export const VERSION = [1, 7];
export const MAX_HEADER = 1 << 20;
export const MAX_BODY = 1 << 30;
export const MAX_PARTS = 513;
export const MAX_ASSET_CHUNK = 4 << 20;

const text = string();
const word = string({ least: 1, most: 128 });
const newName = string({ least: 1, most: 128, pattern: /^[^\x00-\x1f\x7f]+$/u });
const assetName = string({
  least: 1,
  most: 255,
  pattern: /^(?!\.{1,2}(?:\/|$))[^/\\\x00-\x1f\x7f]+(?:\/(?!\.{1,2}(?:\/|$))[^/\\\x00-\x1f\x7f]+)*$/u,
});
const digest = string({ pattern: /^[0-9a-f]{64}$/ });
const digestOrNone = string({ pattern: /^([0-9a-f]{64})?$/ });
const count = integer(0);
const ordinal = integer(1);
const orNone = integer(-1);
const nanoseconds = bigInteger(1n - 2n ** 63n);
const few = { most: 256 };
const who = { epoch: ordinal, attempt: ordinal };
const turn = { ...who, episode: count, frame: count };
const version = list(count, { exactly: 2 });
const assets = list(new Struct({ name: assetName, digest, size: count }));
const parts = optional(list(word, few), []);
const geometryChange = optional(new Struct({ frame: count, assets: optional(assets, []) }));

const input = new Struct({
  topic: newName,
  lag: optional(integer(0, 1), 0),
  required: optional(bool, true),
  parts,
});
const product = new Struct({ topic: word, digest, fidelity: optional(text, "") });
const granted = new Struct({
  topic: word,
  source: word,
  status: string({ values: ["fresh", "held", "absent", "late"] }),
  frame: optional(orNone, -1),
  t_ns: optional(nanoseconds, 0n),
  age: optional(count, 0),
  fidelity: optional(text, ""),
  digest: optional(digestOrNone, ""),
  cause: optional(text, ""),
  geometry: optional(digestOrNone, ""),
});
const subscription = new Struct({
  topic: newName,
  source: optional(text, ""),
  every: optional(ordinal, 1),
});
const reported = {
  decisions: optional(map(text), {}),
  measured: optional(map(count), {}),
  counts: optional(map(count), {}),
};

const reports = optional(
  list(new Struct({ source: word, ...reported, geometry: geometryChange }), few),
  [],
);

/** Fields of each message, by its type. @type {Record<string, Struct>} */
export const MESSAGES = {
  HELLO: new Struct({
    version,
    name: newName,
    role: string({ values: ["world", "channel", "sensors", "link", "agent", "recorder", "observer"] }),
    inputs: optional(list(input, few), []),
    outputs: optional(list(newName, few), []),
    capabilities: optional(list(word, few), []),
    implementation: optional(text, ""),
    max_in_flight: optional(integer(1, 64), 1),
    host: optional(text, ""),
    pid: optional(count, 0),
    subscriptions: optional(list(subscription, { most: 32 }), []),
  }),
  WELCOME: new Struct({
    version,
    run: text,
    ...who,
    capabilities: optional(list(word, few), []),
    heartbeat_ns: ordinal,
    liveness_ns: ordinal,
    seed: optional(bigInteger(0), 0n),
    settings: optional(map(plain), {}),
    scenario: optional(map(plain), {}),
    rejoin_ns: optional(count, 0),
  }),
  REFUSE: new Struct({ code: word, message: text }),
  PREPARE: new Struct({
    ...who,
    demand: optional(list(new Struct({ topic: word, parts }), few), []),
    assets: optional(assets, []),
    producers: optional(map(list(word)), {}),
    prefixes: optional(map(list(text)), {}),
    max_faces: optional(count, 0),
  }),
  READY: new Struct({
    ...who,
    geometry: optional(digestOrNone, ""),
    prefixes: optional(list(text), []),
    actuators: optional(list(string({ least: 1, most: 255 })), []),
    notes: optional(list(text), []),
    seed: optional(orNone, -1),
  }),
  ASSET_OFFER: new Struct({ ...who, assets }),
  ASSET_GET: new Struct({ digest, offset: optional(count, 0) }),
  ASSET_DATA: new Struct({ digest, offset: count, size: count }),
  RESET: new Struct({
    ...who,
    episode: count,
    seed: bigInteger(0),
    t0_ns: nanoseconds,
    seed_episode: optional(count, 0),
  }),
  RESET_DONE: new Struct({ ...who, episode: count }),
  GRANT: new Struct({
    ...turn,
    previous_frame: optional(orNone, -1),
    t_ns: nanoseconds,
    budget_ns: optional(count, 0),
    inputs: optional(list(granted, few), []),
    final: optional(bool, false),
    decisions: optional(map(text), {}),
    reports,
  }),
  DONE: new Struct({
    ...turn,
    products: optional(list(product, few), []),
    ...reported,
    end_episode: optional(bool, false),
    seed: optional(orNone, -1),
    geometry: geometryChange,
    geometry_digest: optional(digestOrNone, ""),
  }),
  FAULT: new Struct({
    ...who,
    episode: optional(count, 0),
    frame: optional(orNone, -1),
    phase: text,
    message: text,
    detail: optional(text, ""),
    culprit: optional(text, ""),
  }),
  CANCEL: new Struct(turn),
  EPISODE_END: new Struct({ ...who, episode: count, frames: count }),
  CHECKPOINT: new Struct(turn),
  CHECKPOINT_DONE: new Struct(turn),
  RESTORE: new Struct(turn),
  GEOMETRY: new Struct({ ...turn, assets: optional(assets, []) }),
  GEOMETRY_DONE: new Struct({ ...turn, geometry: optional(digestOrNone, "") }),
  SHUTDOWN: new Struct({ reason: text, grace_ns: optional(count, 0) }),
  BYE: new Struct({ ...who, reason: optional(text, "") }),
  STALE: new Struct({ of: word, ...turn, frame: orNone }),
  ERROR: new Struct({ code: word, message: text, of: optional(text, ""), subject: optional(text, "") }),
  OBSERVE: new Struct({
    sequence: count,
    state: word,
    paused: optional(bool, false),
    episode: optional(count, 0),
    frame: optional(orNone, -1),
    t_ns: optional(nanoseconds, 0n),
    inputs: optional(list(granted, few), []),
    reports,
  }),
  OBSERVED: new Struct({ sequence: count }),
  ATTACH: new Struct({ ...who, name: word }),
  HEARTBEAT: new Struct({
    sequence: count,
    progress: optional(count, 0),
    phase: optional(text, ""),
    grace_ns: optional(count, 0),
  }),
  HEARTBEAT_ACK: new Struct({ sequence: count }),
};

/**
 * A message: its `type` and the fields of its table.
 * @typedef {{ type: string, [field: string]: any }} Message
 */

/**
 * Encode the header of a message in canonical form.
 * @param {Message} message
 * @returns {Uint8Array}
 */
export function encodeMessage(message) {
  return encode({ type: message.type, ...MESSAGES[message.type].write(message, { sizes: {} }) });
}

/**
 * Decode a message and check its parts.
 *
 * @param {Uint8Array[]} parts  header, and what follows it
 * @param {Partial<Context>} options  `keepFloats`: floats of plain values stay `Float`
 * @returns {Message} defaults filled in
 * @throws {ProtocolError} with the code of the ERROR that is due
 */
export function decodeMessage(parts, options = {}) {
  if (parts.length > MAX_PARTS)
    throw new ProtocolError("limit", `${parts.length} parts, at most ${MAX_PARTS}`);
  if (parts[0].length > MAX_HEADER)
    throw new ProtocolError("limit", `a header of ${parts[0].length} bytes, at most ${MAX_HEADER}`);
  const header = decode(parts[0]);
  const type = header?.type;
  if (typeof type !== "string" || !Object.hasOwn(MESSAGES, type)) {
    throw new ProtocolError("malformed", `no message has the type ${JSON.stringify(type) ?? "undefined"}`);
  }
  // Of another major version nothing but type and version can be relied on.
  const major = type === "HELLO" || type === "WELCOME" ? header.version?.[0] : VERSION[0];
  if (typeof major === "number" && major !== VERSION[0]) {
    throw new ProtocolError(
      "version",
      `the peer speaks version ${header.version.join(".")}, this library ${VERSION.join(".")}`,
    );
  }
  const message = { type, ...MESSAGES[type].read(header, type, { sizes: {}, ...options }) };
  checkParts(message, parts);
  return message;
}

/** @param {Message} message  @param {Uint8Array[]} parts */
function checkParts(message, parts) {
  const wanted = 1 + partsOf(message);
  if (parts.length !== wanted)
    throw new ProtocolError("malformed", `${message.type} has ${parts.length} parts where ${wanted} are due`);
  if (message.type === "ASSET_DATA") {
    const { length } = parts[1];
    if (length > MAX_ASSET_CHUNK)
      throw new ProtocolError("limit", `ASSET_DATA of ${length} bytes, at most ${MAX_ASSET_CHUNK}`);
    if (message.offset + length > message.size)
      throw new ProtocolError("malformed", "ASSET_DATA reaches beyond the size that it states");
    return;
  }
  const state = message.type === "CHECKPOINT_DONE" || message.type === "RESTORE";
  parts.slice(1).forEach(({ length }, index) => {
    const most = state || index % 2 ? MAX_BODY : MAX_HEADER;
    if (length > most)
      throw new ProtocolError(
        "limit",
        `part ${index + 1} of ${message.type} has ${length} bytes, at most ${most}`,
      );
  });
}

/** @param {Message} message  @returns {number} how many parts follow its header */
function partsOf(message) {
  switch (message.type) {
    case "GRANT":
    case "OBSERVE":
      return 2 * message.inputs.filter((/** @type {any} */ entry) => entry.status !== "absent").length;
    case "DONE":
      return 2 * message.products.length;
    case "ASSET_DATA":
    case "CHECKPOINT_DONE":
    case "RESTORE":
      return 1;
    default:
      return 0;
  }
}

/**
 * Lay parts out as one WebSocket message: their number, their lengths, the parts.
 * @param {Uint8Array[]} parts
 * @returns {Uint8Array<ArrayBuffer>}
 */
export function joinParts(parts) {
  const head = 4 * (1 + parts.length);
  const frame = new Uint8Array(parts.reduce((length, part) => length + part.length, head));
  const view = new DataView(frame.buffer);
  view.setUint32(0, parts.length, true);
  let at = head;
  parts.forEach((part, index) => {
    view.setUint32(4 * (1 + index), part.length, true);
    frame.set(part, at);
    at += part.length;
  });
  return frame;
}

/**
 * The parts of a WebSocket message, which share its memory.
 * @param {Uint8Array} frame
 * @returns {Uint8Array[]}
 * @throws {ProtocolError} where its lengths do not add up
 */
export function splitFrame(frame) {
  const view = new DataView(frame.buffer, frame.byteOffset, frame.byteLength);
  const parts = frame.length < 4 ? 0 : view.getUint32(0, true);
  if (parts < 1 || parts > MAX_PARTS || frame.length < 4 * (1 + parts)) {
    throw new ProtocolError("malformed", `a WebSocket message of ${frame.length} bytes and ${parts} parts`);
  }
  const found = [];
  let at = 4 * (1 + parts);
  for (let index = 0; index < parts; index++) {
    const end = at + view.getUint32(4 * (1 + index), true);
    if (end > frame.length)
      throw new ProtocolError("malformed", `part ${index} ends behind its WebSocket message`);
    found.push(frame.subarray(at, end));
    at = end;
  }
  if (at !== frame.length)
    throw new ProtocolError("malformed", `${frame.length - at} bytes behind the last part`);
  return found;
}
