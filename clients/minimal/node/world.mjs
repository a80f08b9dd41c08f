// A whole world, written from protocol/SPEC.md alone: node world.mjs tcp://HOST:PORT NAME
//
// Objects go round in circles, come and leave; the devices of the scenario are mounted on them; a ground and a
// mesh are its scenery. Nothing is random and nothing is remembered from frame to frame, so that a world which
// is killed and started again continues as if it had not been. Settings: objects, see OBJECTS below.
import { createHash } from "node:crypto";
import { readFileSync, readlinkSync } from "node:fs";
import { setTimeout as sleep } from "node:timers/promises";
import { decode, Encoder } from "@msgpack/msgpack";
import { Dealer } from "zeromq";

const [endpoint, name] = process.argv.slice(2);
const MAX_HEADER = 1 << 20, CHUNK = 1 << 22, WELCOME_MS = 120_000;
const OBJECTS = [ // on a circle around centre_m, from_s until before until_s; speed_m_s < 0 goes clockwise
  { name: "car", class: "car", dimensions_m: [4.5, 1.8, 1.5], centre_m: [0, 0, 0.75], radius_m: 20, speed_m_s: 10 },
  { name: "uav", class: "uav", dimensions_m: [0.6, 0.6, 0.25], centre_m: [5, -5, 15], radius_m: 8, speed_m_s: -4 },
];

// --- Encoding: canonical MessagePack, products, digests ---------------------------------------------------

class Float { constructor(value) { this.value = value; } }
class Canonical extends Encoder {
  encodeObject(object, depth) {
    if (object instanceof Float) this.encodeNumberAsFloat(object.value);
    else super.encodeObject(object, depth);
  }
}
const encode = (value) => Buffer.from(new Canonical({ ignoreUndefined: true }).encode(value));
const floats = (values) => values.map((value) => new Float(value + 0));
const sha256 = (...pieces) => pieces.reduce((hash, piece) => hash.update(piece), createHash("sha256")).digest("hex");
const byBytes = (a, b) => Buffer.compare(Buffer.from(a), Buffer.from(b));
const unlessEqual = (value, standard) => (JSON.stringify(value) === JSON.stringify(standard) ? undefined : value);

function product(topic, fields, arrays) { // arrays: name to [columns, rows]; all are float64, so 8 B aligned
  const order = {}, bodies = [];
  let offset = 0;
  for (const [key, value] of Object.entries(fields)) {
    order[key] = value;
    if (value !== null) continue;
    const [columns, rows] = arrays[key], numbers = Float64Array.from(rows.flat(), (value) => value + 0); // + 0: no −0
    order[key] = { dtype: "<f8", shape: [rows.length, columns], offset };
    bodies.push(Buffer.from(numbers.buffer));
    offset += numbers.byteLength;
  }
  const header = encode(order), body = Buffer.concat(bodies), length = Buffer.alloc(8);
  length.writeBigUInt64LE(BigInt(header.length));
  return { entry: { topic, digest: sha256(length, header, body) }, parts: [header, body] };
}

// --- Scenery: a ground of concrete and the mesh of a car --------------------------------------------------

const ply = (vertices, faces) => `ply\nformat ascii 1.0\nelement vertex ${vertices.length}\nproperty float x\n` +
  `property float y\nproperty float z\nelement face ${faces.length}\nproperty list uchar int vertex_indices\n` +
  `end_header\n${[...vertices.map((v) => v.join(" ")), ...faces.map((f) => `3 ${f.join(" ")}`)].join("\n")}\n`;
const BOX = [-0.5, 0.5].flatMap((z) => [[-0.5, -0.5, z], [0.5, -0.5, z], [0.5, 0.5, z], [-0.5, 0.5, z]]);
const SIDES = [[0, 3, 2], [0, 2, 1], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5],
  [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]];
const SCENE = `<scene version="2.1.0">
  <bsdf type="itu-radio-material" id="mat-concrete">
    <string name="type" value="concrete"/>
    <float name="thickness" value="0.2"/>
  </bsdf>
  <shape type="ply" id="mesh-ground">
    <string name="filename" value="meshes/ground.ply"/>
    <boolean name="face_normals" value="true"/>
    <ref id="mat-concrete" name="bsdf"/>
  </shape>
</scene>
`;
const FILES = new Map(Object.entries({
  "objects/car.ply": ply(BOX, SIDES),
  "scenery/ground.xml": SCENE,
  "scenery/meshes/ground.ply": ply([[-99, -99, 0], [99, -99, 0], [99, 99, 0], [-99, 99, 0]], [[0, 1, 2], [0, 2, 3]]),
}).map(([file, text]) => [file, Buffer.from(text)])); // in ascending order of their names
const ASSETS = [...FILES].map(([file, data]) => ({ name: file, digest: sha256(data), size: data.length }));
const GEOMETRY = sha256(ASSETS.map((asset) => `${asset.name}\0${asset.digest}\0`).join(""));

function assetData({ digest, offset = 0 }) {
  const asset = ASSETS.find((other) => other.digest === digest);
  if (!asset || offset > asset.size) return error("unknown-asset", "no such asset", digest);
  const chunk = FILES.get(asset.name).subarray(offset, offset + CHUNK);
  return [encode({ type: "ASSET_DATA", digest, offset, size: asset.size }), chunk];
}

// --- Devices: degrees of the scenario to radians of the scene ---------------------------------------------

const radians = (degrees) => (degrees * Math.PI) / 180;

function quaternion(yaw, pitch, roll) { // radians, z–y′–x″
  const [cy, sy, cp, sp, cr, sr] = [yaw, pitch, roll].flatMap((angle) => [Math.cos(angle / 2), Math.sin(angle / 2)]);
  return [cy * cp * cr + sy * sp * sr, cy * cp * sr - sy * sp * cr, cy * sp * cr + sy * cp * sr, sy * cp * cr - cy * sp * sr];
}

function matches(pattern, text) {
  const source = pattern.replace(/\[!?.[^\]]*\]|[\s\S]/g, (piece) => piece === "*" ? "[^]*" : piece === "?" ? "[^]"
    : piece.length > 1 ? piece.replace("[!", "[^") : piece.replace(/[\\^$.|+()[\]{}]/, "\\$&"));
  return pattern === text || new RegExp(`^${source}$`, "u").test(text);
}

function device(spec, parent) {
  const [x, y, z] = spec.position_m, up = { centre: 0, roof: 0.5, floor: -0.5 }[spec.mount];
  const turned = quaternion(radians(spec.yaw_deg), radians(spec.pitch_deg), radians(spec.roll_deg));
  const float = (value, standard) => (value === standard ? undefined : new Float(value));
  const integer = (value, standard) => (value === standard ? undefined : value);
  const common = {
    type: spec.kind,
    name: parent ? `${parent.name}/${spec.name}` : spec.name,
    parent: parent?.name,
    position: unlessEqual(floats([x, y, z + (parent ? up * parent.dimensions_m[2] : 0)]), floats([0, 0, 0])),
    orientation: unlessEqual(floats(turned), floats([1, 0, 0, 0])),
  };
  if (spec.kind === "antenna") {
    const { rows, columns, vertical_spacing, horizontal_spacing, pattern, polarization, pattern_file, panels, codebook } = spec.array ?? {};
    const array = spec.array && {
      rows: integer(rows, 1), columns: integer(columns, 1), vertical_spacing: float(vertical_spacing, 0.5),
      horizontal_spacing: float(horizontal_spacing, 0.5), pattern: integer(pattern, "iso"), polarization: integer(polarization, "V"),
      pattern_file: pattern_file ? `patterns/${pattern_file.split("/").at(-1)}` : undefined,
      panels: panels?.length ? panels.map(({ position_m, yaw_deg, pitch_deg, roll_deg }) => ({
        position_m: unlessEqual(floats(position_m), floats([0, 0, 0])),
        yaw_deg: float(yaw_deg, 0), pitch_deg: float(pitch_deg, 0), roll_deg: float(roll_deg, 0),
      })) : undefined, codebook: integer(codebook, "dft"),
    };
    return { ...common, role: spec.role, array: unlessEqual(array ?? {}, {}), power_dbm: float(spec.power_dbm, 0),
      carriers: spec.carriers?.length ? spec.carriers : undefined };
  }
  if (spec.kind === "lidar") {
    const [low, high] = spec.elevation_deg.map(radians), [near, far] = spec.range_m;
    return {
      ...common, beams: integer(spec.beams, 64), azimuth_steps: integer(spec.azimuth_steps, 1800),
      elevation_min: float(low, radians(-25)), elevation_max: float(high, radians(3)),
      max_range: float(far, 100), min_range: float(near, 0),
    };
  }
  return {
    ...common, width: integer(spec.size_px[0], 640), height: integer(spec.size_px[1], 480),
    field_of_view: float(radians(spec.field_of_view_deg), Math.PI / 2),
  };
}

// --- The scene of an instant ------------------------------------------------------------------------------

function state(object, t) { // t in seconds of the episode
  const { centre_m: [x, y, z], radius_m: radius, speed_m_s: speed } = object, angle = (speed / radius) * t;
  const heading = angle + (Math.sign(speed) * Math.PI) / 2;
  return {
    position: [x + radius * Math.cos(angle), y + radius * Math.sin(angle), z],
    orientation: quaternion(heading, 0, 0),
    velocity: [Math.abs(speed) * Math.cos(heading), Math.abs(speed) * Math.sin(heading), 0],
  };
}

function scene(t) {
  const there = objects.filter(({ from_s = 0, until_s = Infinity }) => from_s <= t && t < until_s);
  const arrived = there.toSorted((a, b) => (a.from_s ?? 0) - (b.from_s ?? 0)); // those that came first in front
  const devices = specs.flatMap((spec) => spec.on
    ? arrived.filter((object) => matches(spec.on, object.name)).slice(0, spec.count).map((object) => device(spec, object))
    : [device(spec)]).sort((a, b) => byBytes(a.name, b.name));
  there.sort((a, b) => byBytes(a.name, b.name));
  const states = there.map((object) => state(object, t)), rows = (key) => states.map((found) => found[key]);
  return product("scene", {
    names: there.map((object) => object.name),
    classes: there.map((object) => object.class),
    assets: there.map((object) => (object.class === "car" ? "objects/car.ply" : "")),
    position: null, orientation: null, velocity: null, dimensions: null, // arrays: references take their places
    devices: devices.length ? devices : undefined,
  }, {
    position: [3, rows("position")], orientation: [4, rows("orientation")], velocity: [3, rows("velocity")],
    dimensions: [3, there.map((object) => object.dimensions_m)],
  });
}

// --- The life of a client ---------------------------------------------------------------------------------

const read = (file) => { try { return readFileSync(file, "utf8"); } catch { return ""; } };
const link = (file) => { try { return readlinkSync(file); } catch { return ""; } };
const key = (variable, what) => process.env[variable] && read(process.env[variable]).match(`${what} = "(.*)"`)[1];
const curve = process.env.CAVIAR_KEY && {
  curvePublicKey: key("CAVIAR_KEY", "public"), curveSecretKey: key("CAVIAR_KEY", "secret"),
  curveServerKey: key("CAVIAR_BROKER_KEY", "public") };
const broker = new Dealer({ linger: 1000, ...curve });
let who = {}, turn = {}, t0 = 0n, stored = new Map(), objects = OBJECTS, specs = [], leaving = false;

const error = (code, message, subject) => [encode({ type: "ERROR", code, message, subject })];
const send = (message, ...parts) => broker.send([encode(message), ...parts]);
function fail(text) { process.stderr.write(`${name}: ${text}\n`); process.exit(1); }

async function beat({ heartbeat_ns, liveness_ns }) { // no frame takes long here, so that no thread is needed
  const pulse = new Dealer({ linger: 0, ...curve, receiveTimeout: liveness_ns / 1e6 });
  pulse.connect(endpoint);
  for (let sequence = -1; !leaving; sequence++) {
    await pulse.send(encode(sequence < 0 ? { type: "ATTACH", ...who, name } : { type: "HEARTBEAT", sequence }));
    const [part] = await pulse.receive().catch(() => [null]);
    if (leaving) return;
    if (part === null) fail("the broker is silent");
    try {
      const answer = decode(part);
      if (answer.type === "ERROR" || answer.type === "REFUSE") fail(`${answer.code}: ${answer.message}`);
    } catch { /* noise: the next heartbeat asks again */ }
    await sleep(heartbeat_ns / 1e6);
  }
}

function message(parts) { // the header, or the code of the ERROR that is due
  if (parts[0].length > MAX_HEADER) return { wrong: "limit" };
  try {
    const header = decode(parts[0], { maxArrayLength: 1 << 20, maxMapLength: 1 << 20 });
    const inputs = header.type === "GRANT" ? (header.inputs ?? []).filter((input) => input.status !== "absent") : [];
    return typeof header.type === "string" && parts.length === 1 + 2 * inputs.length ? { header } : { wrong: "malformed" };
  } catch { return { wrong: "malformed" }; }
}

function answer(grant) {
  const done = { type: "DONE", ...turn, frame: grant.frame };
  const { entry, parts } = scene(Number(BigInt(grant.t_ns) - t0) / 1e9);
  return [encode({ ...done, products: [entry] }), ...parts];
}

const isDue = (header) => Object.entries(turn).every(([field, value]) => header[field] === value);
const ON = {
  WELCOME(header) {
    who = { epoch: header.epoch, attempt: header.attempt };
    objects = header.settings?.objects ?? OBJECTS;
    specs = header.scenario?.devices ?? [];
    broker.receiveTimeout = -1;
    process.on("SIGTERM", () => send({ type: "BYE", ...who }).then(() => process.exit(143)));
    beat(header);
  },
  async PREPARE() {
    await send({ type: "ASSET_OFFER", ...who, assets: ASSETS });
    const fixed = specs.filter((spec) => !spec.on).map((spec) => spec.name);
    const prefixes = [...new Set([...objects.map((object) => object.name), ...fixed])].sort(byBytes);
    await send({ type: "READY", ...who, geometry: GEOMETRY, prefixes });
  },
  async ASSET_GET(header) { await broker.send(assetData(header)); },
  async RESET(header) {
    turn = { ...who, episode: header.episode };
    [t0, stored] = [BigInt(header.t0_ns), new Map()];
    await send({ type: "RESET_DONE", ...turn });
  },
  async GRANT(header) {
    if (turn.episode === undefined || !isDue(header)) return broker.send(error("unexpected", "this GRANT is not due"));
    if (!stored.has(header.frame)) stored.set(header.frame, answer(header));
    await broker.send(stored.get(header.frame));
  },
  CANCEL() {},
  EPISODE_END() {},
  STALE(header) { process.stderr.write(`${name}: my ${header.of} was stale\n`); },
  ERROR(header) { process.stderr.write(`${name}: ${header.code}: ${header.message}\n`); },
  REFUSE(header) { fail(`${header.code}: ${header.message}`); },
  async SHUTDOWN() { leaving = true; await send({ type: "BYE", ...who }); },
};

broker.connect(endpoint);
await send({
  type: "HELLO", version: [1, 4], name, role: "world", outputs: ["scene"], capabilities: ["assets", "episodes"],
  implementation: "minimal-world", max_in_flight: 4,
  ...(link("/proc/self/ns/pid") && { host: `${read("/proc/sys/kernel/random/boot_id").trim()}:${link("/proc/self/ns/pid")}`, pid: process.pid }),
});
broker.receiveTimeout = WELCOME_MS;
while (!leaving) {
  const parts = await broker.receive().catch(() => fail(`no WELCOME within ${WELCOME_MS / 1000} s`));
  const { header, wrong } = message(parts);
  if (header?.type === "WELCOME" && header.version?.[0] !== 1) fail(`the broker speaks version ${header.version}`);
  if (wrong || !(header.type in ON)) await broker.send(error(wrong ?? "unexpected", "I cannot use this message"));
  else await ON[header.type](header);
}
