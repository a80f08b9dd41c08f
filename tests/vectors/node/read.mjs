// Reads every vector with @msgpack/msgpack and compares it, arrays too, with its JSON.
//   node read.mjs FOLDER_OF_VECTORS
import { readdirSync, readFileSync, existsSync } from "node:fs";
import { isDeepStrictEqual } from "node:util";
import { join } from "node:path";
import { decode } from "@msgpack/msgpack";

const folder = process.argv[2];

// Numbers beyond 2^53 stay exact: JSON.parse alone would round them.
function parse(text) {
  const quoted = text.replace(/([:[,]\s*)(-?\d{16,})(?=\s*[\],}\n])/g, '$1{"bigint": "$2"}');
  return JSON.parse(quoted, (_, value) =>
    value && typeof value === "object" && "bigint" in value ? BigInt(value.bigint) : value);
}

const readers = {
  "|b1": [1, (view, at) => view.getUint8(at) === 1],
  "|u1": [1, (view, at) => view.getUint8(at)],
  "|i1": [1, (view, at) => view.getInt8(at)],
  "<u2": [2, (view, at) => view.getUint16(at, true)],
  "<i4": [4, (view, at) => view.getInt32(at, true)],
  "<i8": [8, (view, at) => view.getBigInt64(at, true)],
  "<u8": [8, (view, at) => view.getBigUint64(at, true)],
  "<f4": [4, (view, at) => view.getFloat32(at, true)],
  "<f8": [8, (view, at) => view.getFloat64(at, true)],
  "<c8": [8, (view, at) => [view.getFloat32(at, true), view.getFloat32(at + 4, true)]],
  "<c16": [16, (view, at) => [view.getFloat64(at, true), view.getFloat64(at + 8, true)]],
};

// Integers as BigInt where either side has one, -0 as 0, and a JSON decimal at the precision of its array.
function plain(value, dtype) {
  if (typeof value === "bigint") return value;
  if (typeof value === "number") {
    if (dtype === "<f4") return Math.fround(value);
    return Number.isInteger(value) ? BigInt(value) : value;
  }
  if (Array.isArray(value)) return value.map((item) => plain(item, dtype));
  if (value && typeof value === "object") {
    if ("values" in value) {
      const { values, ...reference } = value;
      return plain(reference);
    }
    return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, plain(item)]));
  }
  return value;
}

function elements(view, { dtype, shape, offset }) {
  const [size, read] = readers[dtype];
  let at = offset;
  const level = (depth) => {
    if (depth === shape.length) {
      const value = read(view, at);
      at += size;
      return value;
    }
    return Array.from({ length: shape[depth] }, () => level(depth + 1));
  };
  return level(0);
}

function compareArrays(stated, view, path) {
  if (Array.isArray(stated)) {
    stated.forEach((item, index) => compareArrays(item, view, `${path}[${index}]`));
  } else if (stated && typeof stated === "object") {
    if ("values" in stated) {
      const found = elements(view, stated);
      const float = stated.dtype === "<f4" ? "<f4" : undefined;
      if (!isDeepStrictEqual(plain(found, float), plain(stated.values, float))) {
        throw new Error(`${path} holds ${found}, its JSON says ${stated.values}`);
      }
    } else {
      for (const [key, item] of Object.entries(stated)) compareArrays(item, view, `${path}.${key}`);
    }
  }
}

let read = 0;
const wrong = [];
for (const file of readdirSync(folder).filter((name) => name.endsWith(".json")).sort()) {
  const name = file.slice(0, -".json".length);
  const stated = parse(readFileSync(join(folder, file), "utf8"));
  if ("refused" in stated || !("value" in stated)) continue;
  try {
    const header = decode(readFileSync(join(folder, `${name}.msgpack`)), { useBigInt64: true });
    if (!isDeepStrictEqual(plain(header), plain(stated.value))) throw new Error("the header differs from its JSON");
    const path = join(folder, `${name}.body`);
    const body = existsSync(path) ? readFileSync(path) : Buffer.alloc(0);
    compareArrays(stated.value, new DataView(body.buffer, body.byteOffset, body.byteLength), name);
    read += 1;
  } catch (error) {
    wrong.push(`${name}: ${error.message}`);
  }
}
console.log(JSON.stringify({ read, wrong }));
process.exit(wrong.length ? 1 : 0);
