// Arrays of a payload: a reference in the header, elements in the body (SPEC.md, Arrays).
import { ProtocolError } from "./errors.mjs";

/** @typedef {"|b1" | "|u1" | "|i1" | "<u2" | "<i4" | "<i8" | "<u8" | "<f4" | "<f8" | "<c8" | "<c16"} Dtype */
/**
 * @typedef {Uint8Array | Int8Array | Uint16Array | Int32Array | BigInt64Array | BigUint64Array | Float32Array
 *   | Float64Array} Elements
 */

const MAX_DIMENSIONS = 6;
/** Numbers that one element has: a complex one has two. */
const NUMBERS = /** @type {Record<Dtype, number>} */ ({ "<c8": 2, "<c16": 2 });
/** @type {Record<Dtype, { new (buffer: ArrayBuffer): Elements, BYTES_PER_ELEMENT: number }>} */
const STORES = {
  "|b1": Uint8Array,
  "|u1": Uint8Array,
  "|i1": Int8Array,
  "<u2": Uint16Array,
  "<i4": Int32Array,
  "<i8": BigInt64Array,
  "<u8": BigUint64Array,
  "<f4": Float32Array,
  "<f8": Float64Array,
  "<c8": Float32Array,
  "<c16": Float64Array,
};

/**
 * An array of numbers, in C order (the last index runs fastest).
 *
 * Typed arrays have the byte order of the machine, and all that run JavaScript today are little-endian, as
 * the protocol is.
 */
export class NumericArray {
  /**
   * @param {Dtype} dtype
   * @param {number[]} shape
   * @param {Elements} data  the elements; of complex ones real and imaginary parts in turn
   */
  constructor(dtype, shape, data) {
    this.dtype = dtype;
    this.shape = shape;
    this.data = data;
  }

  /**
   * An array from rows of numbers, as positions are.
   * @param {Dtype} dtype
   * @param {number} columns
   * @param {ReadonlyArray<ArrayLike<number>>} rows
   */
  static ofRows(dtype, columns, rows) {
    const data = /** @type {Float64Array} */ (
      new STORES[dtype](new ArrayBuffer(rows.length * columns * STORES[dtype].BYTES_PER_ELEMENT))
    );
    rows.forEach((row, i) => {
      for (let j = 0; j < columns; j++) data[i * columns + j] = row[j] + 0; // + 0: no −0
    });
    return new NumericArray(dtype, [rows.length, columns], data);
  }

  /**
   * One element.
   * @param {...number} indices  one for each dimension
   * @returns {number | bigint | boolean | [real: number, imaginary: number]}
   * @example channel.a.at(0, path) // [real, imaginary]
   */
  at(...indices) {
    if (indices.length !== this.shape.length)
      throw new RangeError(`${indices.length} indices of ${this.shape.length} dimensions`);
    let place = 0;
    indices.forEach((index, axis) => {
      if (!(index >= 0 && index < this.shape[axis]))
        throw new RangeError(`index ${index} of ${this.shape[axis]} in dimension ${axis}`);
      place = place * this.shape[axis] + index;
    });
    if (this.dtype === "|b1") return this.data[place] === 1;
    if (NUMBERS[this.dtype] === 2) return [Number(this.data[2 * place]), Number(this.data[2 * place + 1])];
    return this.data[place];
  }

  /**
   * One row of real numbers: all elements with this first index.
   * @param {number} index
   * @returns {number[]}
   * @example const [x, y, z] = scene.position.row(scene.names.indexOf("car"));
   */
  row(index) {
    if (!(index >= 0 && index < this.shape[0])) throw new RangeError(`row ${index} of ${this.shape[0]}`);
    const width = this.data.length / this.shape[0];
    return Array.from(this.data.subarray(index * width, (index + 1) * width), Number);
  }

  /** All elements as they stand in a body. */
  bytes() {
    return new Uint8Array(this.data.buffer, this.data.byteOffset, this.data.byteLength);
  }
}

/** Places arrays in a body, each at the next multiple of eight bytes. */
export class BodyWriter {
  /** @type {[number, NumericArray][]} */
  #placed = [];
  #length = 0;

  /** @param {NumericArray} array  @returns {object} its reference */
  place(array) {
    const offset = 8 * Math.ceil(this.#length / 8);
    this.#placed.push([offset, array]);
    this.#length = offset + array.data.byteLength;
    return { dtype: array.dtype, shape: array.shape, offset };
  }

  /** @returns {Uint8Array} the body, which ends with the last array */
  body() {
    const body = new Uint8Array(this.#length);
    for (const [offset, array] of this.#placed) body.set(array.bytes(), offset);
    return body;
  }
}

/** Reads arrays out of a body, in the order of their references. */
export class BodyReader {
  #end = 0;

  /** @param {Uint8Array} body */
  constructor(body) {
    this.body = body;
  }

  /**
   * @param {any} reference  as decoded from the header
   * @param {string} place  of the reference, for errors
   * @returns {NumericArray} with a copy of the elements: where a part begins is not aligned
   */
  read(reference, place) {
    const { dtype, shape, offset } = this.#checked(reference, place);
    const Store = STORES[dtype];
    const size = Store.BYTES_PER_ELEMENT * (NUMBERS[dtype] ?? 1);
    const count = shape.reduce((product, length) => product * length, 1); // huge ones do not wrap around
    if (offset < this.#end)
      throw malformed(`${place} begins at byte ${offset}, before the end of the array before it`);
    if (offset + count * size > this.body.length) {
      throw malformed(
        `${place} needs ${count * size} bytes from ${offset} on, and the body has ${this.body.length}`,
      );
    }
    this.#end = offset + count * size;
    // Not `this.body.slice`: that of Node's Buffer copies nothing.
    const bytes = Uint8Array.prototype.slice.call(this.body, offset, this.#end);
    const data = new Store(/** @type {ArrayBuffer} */ (bytes.buffer));
    if (dtype === "|b1" && data.some((/** @type {number | bigint} */ flag) => Number(flag) > 1)) {
      throw malformed(`${place} holds a flag that is neither 0 nor 1`);
    }
    if (data instanceof Float32Array || data instanceof Float64Array) {
      for (let i = 0; i < data.length; i++) {
        if (!Number.isFinite(data[i])) throw malformed(`${place} holds ${data[i]} at element ${i}`);
      }
    }
    return new NumericArray(dtype, shape, data);
  }

  /**
   * @param {any} reference
   * @param {string} place
   * @returns {{ dtype: Dtype, shape: number[], offset: number }}
   */
  #checked(reference, place) {
    const { dtype, shape, offset } = reference ?? {};
    if (typeof dtype !== "string" || !Object.hasOwn(STORES, dtype))
      throw malformed(`${place} has elements of ${dtype}`);
    if (!Array.isArray(shape) || !shape.every(isSize))
      throw malformed(`${place} has the shape ${JSON.stringify(shape)}`);
    if (shape.length > MAX_DIMENSIONS)
      throw new ProtocolError("limit", `${place} has ${shape.length} dimensions, at most ${MAX_DIMENSIONS}`);
    if (!isSize(offset) || offset % 8 !== 0)
      throw malformed(`${place} has the offset ${offset}, no multiple of 8`);
    return { dtype: /** @type {Dtype} */ (dtype), shape, offset };
  }
}

/** @param {unknown} value */
function isSize(value) {
  return typeof value === "number" && Number.isSafeInteger(value) && value >= 0;
}

/** @param {string} message */
function malformed(message) {
  return new ProtocolError("malformed", message);
}
