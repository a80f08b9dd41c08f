// MessagePack in the canonical form of SPEC.md: every integer, string, list and map as short as it can be,
// every float in nine bytes, maps with string keys. Binary and extension types do not occur.
import { ProtocolError } from "./errors.mjs";

/** Maps and lists in one another that are read and written; deeper ones are refused (SPEC.md, Limits). */
export const MAX_NESTING = 32;

/**
 * A float. JavaScript has one type of numbers, so that 1.0 has to be marked to be written as a float.
 *
 * @example encode({ speed: new Float(1) })
 */
export class Float {
  /** @param {number} value */
  constructor(value) {
    this.value = value;
  }
}

const utf8 = new TextEncoder();
const text = new TextDecoder("utf-8", { fatal: true, ignoreBOM: true });

/** Bytes that grow. */
class Writer {
  constructor() {
    this.bytes = new Uint8Array(512);
    this.view = new DataView(this.bytes.buffer);
    this.length = 0;
  }

  /**
   * Make room and move on.
   * @param {number} count
   * @returns {number} where the room begins
   */
  take(count) {
    const at = this.length;
    this.length += count;
    if (this.length > this.bytes.length) {
      const grown = new Uint8Array(Math.max(this.length, 2 * this.bytes.length));
      grown.set(this.bytes.subarray(0, at));
      this.bytes = grown;
      this.view = new DataView(grown.buffer);
    }
    return at;
  }

  /**
   * @param {number} code
   * @param {number} size
   * @param {number} value  an unsigned number behind a type code
   */
  coded(code, size, value) {
    const at = this.take(1 + size);
    this.bytes[at] = code;
    if (size === 1) this.view.setUint8(at + 1, value);
    else if (size === 2) this.view.setUint16(at + 1, value);
    else if (size === 4) this.view.setUint32(at + 1, value);
  }

  /** @param {number} byte */
  byte(byte) {
    const at = this.take(1); // first: it may replace the bytes
    this.bytes[at] = byte;
  }
}

/**
 * Encode a value.
 *
 * @param {unknown} value  null, boolean, number (an integer as such, any other as a float), bigint, `Float`,
 *   string, array, `Map`, or object, of which keys whose value is undefined are left out
 * @returns {Uint8Array}
 */
export function encode(value) {
  const writer = new Writer();
  write(writer, value, 0);
  return writer.bytes.slice(0, writer.length);
}

/** @param {Writer} writer  @param {unknown} value  @param {number} depth */
function write(writer, value, depth) {
  if (value === null) writer.byte(0xc0);
  else if (typeof value === "boolean") writer.byte(value ? 0xc3 : 0xc2);
  else if (typeof value === "string") writeText(writer, value);
  else if (typeof value === "bigint") writeBig(writer, value);
  else if (typeof value === "number") {
    if (Number.isSafeInteger(value)) writeInteger(writer, value);
    else writeFloat(writer, value);
  } else if (value instanceof Float) writeFloat(writer, value.value);
  else if (typeof value === "object") writeNested(writer, /** @type {object} */ (value), depth + 1);
  else throw new TypeError(`MessagePack has no ${typeof value}`);
}

/** @param {Writer} writer  @param {object} value  @param {number} depth */
function writeNested(writer, value, depth) {
  if (depth > MAX_NESTING)
    throw new ProtocolError("limit", `more than ${MAX_NESTING} maps and lists in one another`);
  if (Array.isArray(value) || ArrayBuffer.isView(value)) {
    const items = /** @type {ArrayLike<unknown>} */ (/** @type {unknown} */ (value));
    sized(writer, items.length, 0x90, 15, [0, 0xdc, 0xdd]);
    for (const item of Array.from(items)) write(writer, item, depth);
    return;
  }
  const entries = [...(value instanceof Map ? value : Object.entries(value))].filter(
    ([, item]) => item !== undefined,
  );
  sized(writer, entries.length, 0x80, 15, [0, 0xde, 0xdf]);
  for (const [key, item] of entries) {
    writeText(writer, key);
    write(writer, item, depth);
  }
}

/**
 * The head of a text, list or map in its shortest form.
 * @param {Writer} writer
 * @param {number} count
 * @param {number} short  code to which a count of at most `most` is added
 * @param {number} most
 * @param {number[]} codes  with counts of 8 (0: there is none), 16 and 32 bits
 */
function sized(writer, count, short, most, codes) {
  if (count <= most) writer.byte(short + count);
  else if (codes[0] && count < 0x100) writer.coded(codes[0], 1, count);
  else if (count < 0x10000) writer.coded(codes[1], 2, count);
  else writer.coded(codes[2], 4, count);
}

/** @param {Writer} writer  @param {string} value */
function writeText(writer, value) {
  const bytes = utf8.encode(value);
  sized(writer, bytes.length, 0xa0, 31, [0xd9, 0xda, 0xdb]);
  const at = writer.take(bytes.length);
  writer.bytes.set(bytes, at);
}

/** @param {Writer} writer  @param {number} value */
function writeFloat(writer, value) {
  const at = writer.take(9);
  writer.bytes[at] = 0xcb;
  writer.view.setFloat64(at + 1, value + 0); // + 0: −0 has other bytes than the 0 that it equals
}

/** @param {Writer} writer  @param {number} value */
function writeInteger(writer, value) {
  if (value >= 0) {
    if (value < 0x80) writer.byte(value);
    else if (value < 0x100) writer.coded(0xcc, 1, value);
    else if (value < 0x10000) writer.coded(0xcd, 2, value);
    else if (value < 0x100000000) writer.coded(0xce, 4, value);
    else writeWide(writer, 0xcf, BigInt(value));
  } else if (value >= -0x20) writer.byte(value & 0xff);
  else if (value >= -0x80) writer.coded(0xd0, 1, value & 0xff);
  else if (value >= -0x8000) writer.coded(0xd1, 2, value & 0xffff);
  else if (value >= -0x80000000) writer.coded(0xd2, 4, value >>> 0);
  else writeWide(writer, 0xd3, BigInt(value));
}

/** @param {Writer} writer  @param {bigint} value */
function writeBig(writer, value) {
  if (BigInt.asIntN(54, value) === value && Number.isSafeInteger(Number(value)))
    writeInteger(writer, Number(value));
  else if (value >= 0n && value < 1n << 64n) writeWide(writer, 0xcf, value);
  else if (value >= -(1n << 63n)) writeWide(writer, 0xd3, value);
  else throw new RangeError(`${value} does not fit 64 bits`);
}

/** @param {Writer} writer  @param {number} code  @param {bigint} value */
function writeWide(writer, code, value) {
  const at = writer.take(9);
  writer.bytes[at] = code;
  writer.view.setBigUint64(at + 1, BigInt.asUintN(64, value));
}

/**
 * Decode one value that fills the bytes. Floats come as `Float`, integers beyond 2⁵³ as bigint, maps as
 * objects without a prototype, so that no key of a peer means anything to JavaScript.
 *
 * @param {Uint8Array} bytes
 * @returns {any}
 * @throws {ProtocolError} `malformed`, or `limit` where it nests too deep
 */
export function decode(bytes) {
  const reader = new Reader(bytes);
  const value = reader.value(0);
  if (reader.at < bytes.length)
    throw new ProtocolError("malformed", `${bytes.length - reader.at} bytes too many`);
  return value;
}

class Reader {
  /** @param {Uint8Array} bytes */
  constructor(bytes) {
    this.bytes = bytes;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    this.at = 0;
  }

  /**
   * Move on, over bytes that have to be there.
   * @param {number} count
   * @returns {number} where they begin
   */
  take(count) {
    const at = this.at;
    if (count > this.bytes.length - at)
      throw new ProtocolError("malformed", `it ends within a value, at byte ${at}`);
    this.at += count;
    return at;
  }

  /** @param {number} size  @returns {number} an unsigned number of 1, 2 or 4 bytes */
  count(size) {
    const at = this.take(size);
    return size === 1
      ? this.view.getUint8(at)
      : size === 2
        ? this.view.getUint16(at)
        : this.view.getUint32(at);
  }

  /** @param {number} depth  @returns {any} */
  value(depth) {
    const code = this.count(1);
    if (code < 0x80) return code;
    if (code < 0x90) return this.map(code & 15, depth + 1);
    if (code < 0xa0) return this.list(code & 15, depth + 1);
    if (code < 0xc0) return this.text(code & 31);
    if (code >= 0xe0) return code - 0x100;
    switch (code) {
      case 0xc0:
        return null;
      case 0xc2:
        return false;
      case 0xc3:
        return true;
      case 0xca:
        return new Float(this.view.getFloat32(this.take(4)));
      case 0xcb:
        return new Float(this.view.getFloat64(this.take(8)));
      case 0xcc:
        return this.count(1);
      case 0xcd:
        return this.count(2);
      case 0xce:
        return this.count(4);
      case 0xcf:
        return narrow(this.view.getBigUint64(this.take(8)));
      case 0xd0:
        return this.view.getInt8(this.take(1));
      case 0xd1:
        return this.view.getInt16(this.take(2));
      case 0xd2:
        return this.view.getInt32(this.take(4));
      case 0xd3:
        return narrow(this.view.getBigInt64(this.take(8)));
      case 0xd9:
        return this.text(this.count(1));
      case 0xda:
        return this.text(this.count(2));
      case 0xdb:
        return this.text(this.count(4));
      case 0xdc:
        return this.list(this.count(2), depth + 1);
      case 0xdd:
        return this.list(this.count(4), depth + 1);
      case 0xde:
        return this.map(this.count(2), depth + 1);
      case 0xdf:
        return this.map(this.count(4), depth + 1);
    }
    throw new ProtocolError("malformed", `type 0x${code.toString(16)} at byte ${this.at - 1} does not occur`);
  }

  /** @param {number} length  @returns {string} */
  text(length) {
    const at = this.take(length);
    try {
      return text.decode(this.bytes.subarray(at, at + length));
    } catch {
      throw new ProtocolError("malformed", `the text at byte ${at} is not UTF-8`);
    }
  }

  /** @param {number} count  @param {number} depth  @returns {any[]} */
  list(count, depth) {
    this.announce(count, depth);
    const items = [];
    for (let i = 0; i < count; i++) items.push(this.value(depth));
    return items;
  }

  /** @param {number} count  @param {number} depth  @returns {Record<string, any>} */
  map(count, depth) {
    this.announce(2 * count, depth);
    const found = Object.create(null);
    for (let i = 0; i < count; i++) {
      const key = this.value(depth);
      if (typeof key !== "string")
        throw new ProtocolError("malformed", `a key that is no text, before byte ${this.at}`);
      found[key] = this.value(depth);
    }
    return found;
  }

  /** @param {number} values  that follow, of at least a byte each  @param {number} depth */
  announce(values, depth) {
    if (depth > MAX_NESTING)
      throw new ProtocolError("limit", `more than ${MAX_NESTING} maps and lists in one another`);
    if (values > this.bytes.length - this.at) {
      throw new ProtocolError(
        "malformed",
        `${values} values announced at byte ${this.at}, more than there are bytes`,
      );
    }
  }
}

/** @param {bigint} value  @returns {number | bigint} */
function narrow(value) {
  const number = Number(value);
  return Number.isSafeInteger(number) ? number : value;
}
