// Payloads of the topics (SPEC.md, Payloads): what they hold, in which order, and how large their arrays are.
import { BodyReader, BodyWriter } from "./arrays.mjs";
import { ProtocolError } from "./errors.mjs";
import { decode, encode } from "./messagepack.mjs";
import { MAX_BODY, MAX_HEADER } from "./messages.mjs";
import { array, bool, integer, list, optional, real, sizing, string, Struct, tagged } from "./schema.mjs";
import { sha256 } from "./sha256.mjs";

/** @import { Payloads } from "./types.d.ts" */

const text = string();
const names = list(text);
const count = integer(0);
const float = real();
const above = real((value) => value > 0);
const notBelow = real((value) => value >= 0);
const vector3 = list(float, { exactly: 3 });
const quaternion = list(float, { exactly: 4 });
const pose = { position: vector3, orientation: quaternion };
const mounted = {
  name: text,
  parent: optional(text, ""),
  position: optional(vector3, [0, 0, 0]),
  orientation: optional(quaternion, [1, 0, 0, 0]),
};
const panel = new Struct({
  position_m: optional(vector3, [0, 0, 0]),
  yaw_deg: optional(float, 0),
  pitch_deg: optional(float, 0),
  roll_deg: optional(float, 0),
});
const NO_ARRAY = {
  rows: 1,
  columns: 1,
  vertical_spacing: 0.5,
  horizontal_spacing: 0.5,
  pattern: "iso",
  polarization: "V",
  pattern_file: "",
  panels: [],
  codebook: "dft",
};
const antennaArray = new Struct({
  rows: optional(integer(1, 1024), 1),
  columns: optional(integer(1, 1024), 1),
  vertical_spacing: optional(above, 0.5),
  horizontal_spacing: optional(above, 0.5),
  pattern: optional(string({ values: ["iso", "dipole", "hw_dipole", "tr38901"] }), "iso"),
  polarization: optional(
    string({ values: ["V", "H", "-45", "+45", "RHCP", "LHCP", "VH", "cross", "circular"] }),
    "V",
  ),
  pattern_file: optional(text, ""),
  panels: optional(list(panel), []),
  codebook: optional(text, "dft"),
});
const device = tagged({
  antenna: new Struct({
    ...mounted,
    role: string({ values: ["tx", "rx", "both"] }),
    array: optional(antennaArray, NO_ARRAY),
    power_dbm: optional(float, 0),
    carriers: optional(names, []),
  }),
  lidar: new Struct({
    ...mounted,
    beams: optional(integer(1, 1024), 64),
    azimuth_steps: optional(integer(1, 36000), 1800),
    elevation_min: optional(float, -0.4363323129985824),
    elevation_max: optional(float, 0.05235987755982989),
    max_range: optional(above, 100),
    min_range: optional(notBelow, 0),
  }),
  camera: new Struct({
    ...mounted,
    width: optional(integer(1, 8192), 640),
    height: optional(integer(1, 8192), 480),
    field_of_view: optional(above, 1.5707963267948966),
  }),
});

const few65536 = integer(0, 65536);
const carrier = new Struct({
  name: text,
  frequency_hz: above,
  bandwidth_hz: optional(above, 1e8),
  subcarriers: optional(few65536, 0),
  subcarrier_spacing_hz: optional(notBelow, 0),
  taps: optional(few65536, 0),
  slots: optional(integer(1, 65536), 1),
  slot_duration_s: optional(notBelow, 0),
});
const NO_OPTIONS = {
  los: true,
  reflection: false,
  refraction: false,
  diffraction: false,
  scattering: false,
  max_depth: 0,
  samples: 0,
  materials_outside: [],
  absorption_db_per_km: [],
  detail: "",
  foliage: [],
  blockage: [],
};
const options = new Struct({
  los: optional(bool, true),
  reflection: optional(bool, false),
  refraction: optional(bool, false),
  diffraction: optional(bool, false),
  scattering: optional(bool, false),
  max_depth: optional(count, 0),
  samples: optional(count, 0),
  materials_outside: optional(names, []),
  absorption_db_per_km: optional(list(notBelow), []),
  detail: optional(text, ""),
  foliage: optional(names, []),
  blockage: optional(names, []),
});
const pair = { carrier: count, tx: count, rx: count };
const intrinsics = new Struct({ fx: float, fy: float, cx: float, cy: float });
const user = (/** @type {string} */ dtype) => array(dtype, "U");
const since15 = (/** @type {string} */ dtype) => optional(user(dtype));

/** @param {(fields: Record<string, any>) => Struct} make  an image, its sensor and its pose first */
const image = (make) => list(make({ sensor: text, intrinsics: intrinsics, ...pose }));
/** @param {Record<string, any>} fields */
const structOf = (fields) => new Struct(fields);

/** @param {any} channel  @param {string} place */
function checkOffsets({ offsets, tx, rx, tau }, place) {
  const found = Array.from(offsets.data, Number);
  const paths = tau.shape[0];
  const ascend = found.every((offset, index) => (index === 0 ? offset === 0 : offset >= found[index - 1]));
  if (found.length !== tx.length * rx.length + 1 || !ascend || found.at(-1) !== paths) {
    throw new ProtocolError(
      "malformed",
      `${place}.offsets do not divide ${paths} paths among ${tx.length} × ${rx.length} pairs`,
    );
  }
}

/** Payload of each topic. @type {Record<string, Struct>} */
export const TOPICS = {
  scene: new Struct({
    names: sizing(names, "N"),
    classes: sizing(names, "N"),
    assets: sizing(names, "N"),
    position: array("<f8", "N", 3),
    orientation: array("<f8", "N", 4),
    velocity: array("<f8", "N", 3),
    dimensions: array("<f8", "N", 3),
    devices: optional(list(device), []),
    angular_velocity: optional(array("<f8", "N", 3)),
  }),
  channel: new Struct(
    {
      rung: text,
      options: optional(options, NO_OPTIONS),
      expected_error_db: optional(float),
      carriers: sizing(list(carrier), "C"),
      tx: sizing(names, "T"),
      rx: sizing(names, "R"),
      los: array("|b1", "T", "R"),
      offsets: array("<i8", "L1"),
      object_names: optional(names, []),
      id: array("<u8", "P"),
      a: array("<c16", "C", "P"),
      tau: array("<f8", "P"),
      aod: array("<f8", "P", 2),
      aoa: array("<f8", "P", 2),
      doppler: array("<f8", "C", "P"),
      interactions: array("|u1", "P", "D"),
      points: array("<f8", "P", "D", 3),
      objects: array("<i4", "P", "D"),
      h: optional(list(new Struct({ ...pair, h: array("<c16", "Nr", "Nt") })), []),
      dropped: optional(count, 0),
      hf: optional(list(new Struct({ ...pair, h: array("<c8", "S", "K", "Nr", "Nt") })), []),
      taps: optional(
        list(new Struct({ ...pair, first: integer(), h: array("<c8", "S", "L", "Nr", "Nt") })),
        [],
      ),
      error_bound_db: optional(array("<f8", "T", "R")),
      error_reference: optional(text, ""),
      used: optional(array("|b1", "C", "T", "R")),
    },
    checkOffsets,
  ),
  lidar: new Struct({
    object_names: names,
    scans: list(
      new Struct({
        sensor: text,
        ...pose,
        ray: array("<i4", "N"),
        points: array("<f4", "N", 3),
        points_world: optional(array("<f4", "N", 3)),
        range: array("<f4", "N"),
        object: array("<i4", "N"),
        grid: optional(
          new Struct({ origin: vector3, cell: vector3, occupancy: array("|i1", "X", "Y", "Z") }),
        ),
      }),
    ),
  }),
  camera: new Struct({ images: image((fields) => structOf({ ...fields, rgb: array("|u1", "H", "W", 3) })) }),
  depth: new Struct({
    images: image((fields) =>
      structOf({ ...fields, depth: array("<f4", "H", "W"), normals: optional(array("<f4", "H", "W", 3)) }),
    ),
  }),
  segmentation: new Struct({
    object_names: names,
    material_names: optional(names, []),
    images: image((fields) =>
      structOf({ ...fields, object: array("<i4", "H", "W"), material: optional(array("<i4", "H", "W")) }),
    ),
  }),
  action: new Struct({
    commands: list(
      tagged({
        beam: new Struct({
          tx: text,
          rx: text,
          tx_beam: count,
          rx_beam: optional(count, 0),
          carrier: optional(text, ""),
        }),
        waypoint: new Struct({
          object: text,
          position: vector3,
          speed: above,
          at_once: optional(bool, false),
          yaw: optional(float),
        }),
        velocity: new Struct({
          object: text,
          velocity: vector3,
          yaw: optional(float),
          yaw_rate: optional(float),
        }),
        schedule: new Struct({ tx: text, rx: text }),
        path: new Struct({ object: text, points: list(vector3), speed: above }),
        attitude: new Struct({ object: text, orientation: quaternion, thrust: notBelow }),
        drive: new Struct({
          object: text,
          speed: optional(notBelow),
          lane: optional(count),
          route: optional(names, []),
          stop: optional(
            new Struct({ road: text, position: notBelow, duration: notBelow, lane: optional(count, 0) }),
          ),
        }),
        signal: new Struct({ signal: text, phase: count, duration: optional(above) }),
      }),
    ),
  }),
  link: new Struct({
    tx: sizing(names, "U"),
    rx: sizing(names, "U"),
    carrier: sizing(names, "U"),
    has_path: user("|b1"),
    los: user("|b1"),
    tx_beam: user("<i4"),
    rx_beam: user("<i4"),
    abs_y: user("<f8"),
    top_tx_beam: array("<i4", "U", "K"),
    top_rx_beam: array("<i4", "U", "K"),
    top_abs_y: array("<f8", "U", "K"),
    baseline_abs_y: user("<f8"),
    aod_azimuth: user("<f8"),
    aoa_azimuth: user("<f8"),
    snr: user("<f8"),
    snr_best: user("<f8"),
    spectral_efficiency: user("<f8"),
    bit_rate: user("<f8"),
    reward: user("<f8"),
    buffered: since15("<f8"),
    no_path: optional(count, 0),
    serving: since15("|b1"),
    arrived: since15("<i8"),
    sent: since15("<i8"),
    dropped: since15("<i8"),
    delivered: since15("<i8"),
    delay: since15("<f8"),
    waiting: since15("<f8"),
    sinr: since15("<f8"),
    throughput: since15("<f8"),
    blocks: since15("<i8"),
    block_errors: since15("<i8"),
  }),
};

/**
 * Encode a payload in canonical form.
 *
 * @template {keyof Payloads} T
 * @param {T} topic
 * @param {Payloads[T]} payload
 * @returns {{ header: Uint8Array, body: Uint8Array, digest: string }}
 */
export function encodePayload(topic, payload) {
  const writer = new BodyWriter();
  const header = encode(TOPICS[topic].write(payload, { writer, sizes: {} }));
  const body = writer.body();
  return { header, body, digest: payloadDigest(header, body) };
}

/**
 * Decode a payload and check its types and sizes.
 *
 * @template {keyof Payloads} T
 * @param {T} topic
 * @param {Uint8Array} header
 * @param {Uint8Array} body
 * @returns {Payloads[T]} defaults filled in
 * @throws {ProtocolError} naming the field
 */
export function decodePayload(topic, header, body) {
  if (!Object.hasOwn(TOPICS, topic)) throw new ProtocolError("malformed", `there is no topic ${topic}`);
  if (header.length > MAX_HEADER || body.length > MAX_BODY)
    throw new ProtocolError("limit", `a payload of ${header.length} + ${body.length} bytes`);
  return TOPICS[topic].read(decode(header), topic, { reader: new BodyReader(body), sizes: {} });
}

/**
 * Digest of a product: over the length of its header in eight bytes, its header, its body.
 * @param {Uint8Array} header
 * @param {Uint8Array} body
 */
export function payloadDigest(header, body) {
  const length = new Uint8Array(8);
  new DataView(length.buffer).setBigUint64(0, BigInt(header.length), true);
  return sha256(length, header, body);
}
