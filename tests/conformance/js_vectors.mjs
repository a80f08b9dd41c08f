// Holds the library in clients/js to the vectors of the protocol and of engine axes:
//   node js_vectors.mjs LIBRARY VECTORS AXES
// Prints {"checked": {…}, "wrong": […]}.
import { existsSync, readdirSync, readFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";
import { isDeepStrictEqual } from "node:util";

const [library, folder, axesFile] = process.argv.slice(2);
const from = (module) => import(pathToFileURL(join(library, module)).href);
const { BodyReader, BodyWriter, NumericArray } = await from("arrays.mjs");
const { decode, encode, Float } = await from("messagepack.mjs");
const { decodeMessage, encodeMessage, joinParts, splitFrame } = await from("messages.mjs");
const { decodePayload, encodePayload, payloadDigest } = await from("topics.mjs");
const { ProtocolError } = await from("errors.mjs");

const wrong = [];
const checked = {};
const count = (what) => {
  checked[what] = (checked[what] ?? 0) + 1;
};
function holds(name, right, why) {
  if (!right) wrong.push(`${name}: ${why}`);
}

const file = (name) => {
  const path = join(folder, name);
  return existsSync(path) ? readFileSync(path) : new Uint8Array(0);
};
const hex = (text) => Uint8Array.from(Buffer.from(text, "hex"));
const same = (a, b) => Buffer.compare(Buffer.from(a), Buffer.from(b)) === 0;

/** JSON with exact integers as bigint and numbers that have a point as `Float`. */
function parse(text) {
  const marked = text.replace(
    /("(?:[^"\\]|\\.)*")|(-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?)/g,
    (_, quoted, number) =>
      quoted ?? (/[.eE]/.test(number) ? `{"\\u0000float": ${number}}` : `{"\\u0000int": "${number}"}`),
  );
  return JSON.parse(marked, (_, value) => {
    if (value && typeof value === "object" && "\0float" in value) return new Float(value["\0float"]);
    return value && typeof value === "object" && "\0int" in value ? BigInt(value["\0int"]) : value;
  });
}

/** Numbers alike, whatever they are: bigint where whole. */
function alike(value) {
  if (value instanceof Float) return alike(value.value);
  if (typeof value === "number") return Number.isInteger(value) ? BigInt(value) : value;
  return value;
}

/** Whether a decoded object is what its JSON says; fields that JSON leaves out have their defaults. */
function means(found, stated) {
  if (stated && typeof stated === "object" && Object.hasOwn(stated, "values"))
    return arrayMeans(found, stated);
  if (Array.isArray(stated))
    return (
      Array.isArray(found) &&
      found.length === stated.length &&
      stated.every((item, i) => means(found[i], item))
    );
  if (stated && typeof stated === "object" && !(stated instanceof Float)) {
    return (
      !!found &&
      typeof found === "object" &&
      Object.keys(stated).every((key) => means(found[key], stated[key]))
    );
  }
  return alike(found) === alike(stated);
}

function arrayMeans(found, { dtype, shape, values }) {
  const flat = [];
  const level = (value, depth) =>
    depth ? value.forEach((item) => level(item, depth - 1)) : flat.push(value);
  level(values, shape.length);
  const round = dtype === "<f4" || dtype === "<c8" ? Math.fround : (value) => value;
  const expected = flat
    .flat()
    .map((value) =>
      typeof value === "boolean"
        ? BigInt(value)
        : alike(typeof alike(value) === "number" ? round(alike(value)) : value),
    );
  return (
    found instanceof NumericArray &&
    found.dtype === dtype &&
    isDeepStrictEqual(found.shape.map(BigInt), shape) &&
    isDeepStrictEqual(Array.from(found.data, alike), expected)
  );
}

function partsOf(stated, header) {
  const further = [
    ...(stated.parts ?? []).map(hex),
    ...(stated.lengths ?? []).map((length) => new Uint8Array(Number(length))),
  ];
  if (stated.product) further.push(file(`${stated.product}.msgpack`), file(`${stated.product}.body`));
  return [header, ...further];
}

function read(stated, header, body) {
  if (stated.kind === "message") return decodeMessage(partsOf(stated, header), { keepFloats: true });
  if (stated.kind === "payload") return decodePayload(stated.topic, header, body);
  const reader = new BodyReader(body);
  return decode(header).map((reference, index) => reader.read(reference, `array ${index}`));
}

function written(stated, value) {
  if (stated.kind === "message") return [encodeMessage(value), new Uint8Array(0)];
  if (stated.kind === "payload") {
    const { header, body } = encodePayload(stated.topic, value);
    return [header, body];
  }
  const writer = new BodyWriter();
  const header = encode(value.map((item) => writer.place(item)));
  return [header, writer.body()];
}

for (const source of readdirSync(folder)
  .filter((name) => name.endsWith(".json"))
  .sort()) {
  const name = source.slice(0, -".json".length);
  const stated = parse(readFileSync(join(folder, source), "utf8"));
  const header = file(`${name}.msgpack`),
    body = file(`${name}.body`);
  let value, refused;
  try {
    value = read(stated, header, body);
  } catch (error) {
    refused = error instanceof ProtocolError ? error.code : `a ${error.name}: ${error.stack}`;
  }
  if (stated.refused) {
    count("refused");
    holds(name, refused === stated.refused, `is refused with ${refused}, not ${stated.refused}`);
    continue;
  }
  holds(name, refused === undefined, `is refused: ${refused}`);
  if (refused !== undefined) continue;
  count("read");
  const meaning = stated.means ?? stated.value;
  if (meaning) holds(name, means(value, meaning), "does not mean what its JSON says");
  if (stated.tolerated && stated.kind !== "message") continue;
  const [again, contents] = written(stated, value);
  count("written");
  if (stated.tolerated)
    holds(
      name,
      means(decodeMessage(partsOf(stated, again)), meaning),
      "is not written in its canonical form",
    );
  else holds(name, same(again, header) && same(contents, body), "is written with other bytes");
  if (stated.frame) {
    count("frames");
    const parts = partsOf(stated, header),
      frame = file(`${name}.frame`);
    holds(name, same(joinParts(parts), frame), "has another frame");
    holds(
      name,
      splitFrame(frame).every((part, index) => same(part, parts[index])),
      "its frame is split otherwise",
    );
  }
  if (stated.product) {
    const [{ digest }] = value.products ?? value.inputs;
    holds(
      name,
      payloadDigest(...partsOf(stated, header).slice(1)) === digest,
      "its product has another digest",
    );
  }
}

if (axesFile) {
  const { ENGINES } = await from("axes.mjs");
  const close = (a, b, tolerance) => a.every((value, index) => Math.abs(value - b[index]) <= tolerance);
  const turned = (a, b) =>
    Math.abs(Math.abs(a.reduce((sum, value, index) => sum + value * b[index], 0)) - 1) <= 1e-12;
  const { poses, meshes } = JSON.parse(readFileSync(axesFile, "utf8"));
  for (const [name, axes] of Object.entries(ENGINES)) {
    const found = axes.meshToEnu(meshes[name].vertices, meshes[name].triangles);
    count("meshes");
    holds(`mesh of ${name}`, isDeepStrictEqual(found, meshes.enu), `is ${JSON.stringify(found)}`);
  }
  for (const [number, entry] of poses.entries()) {
    for (const [name, axes] of Object.entries(ENGINES)) {
      for (const [way, given, expected] of [
        ["fromEnu", entry.enu, entry[name]],
        ["toEnu", entry[name], entry.enu],
      ]) {
        const found = axes[way](given);
        count("poses");
        for (const key of ["position", "velocity", "angular_velocity"]) {
          holds(
            `pose ${number} ${way} ${name}`,
            close(found[key], expected[key], 1e-9),
            `${key} is ${found[key]}, not ${expected[key]}`,
          );
        }
        holds(
          `pose ${number} ${way} ${name}`,
          turned(found.orientation, expected.orientation),
          `orientation is ${found.orientation}`,
        );
      }
    }
  }
}
console.log(JSON.stringify({ checked, wrong }));
