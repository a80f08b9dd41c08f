// Types of fields, and how values of them are read and written in canonical form. The tables of messages.mjs
// and topics.mjs are made of these.
import { BodyReader, BodyWriter, NumericArray } from "./arrays.mjs";
import { ProtocolError } from "./errors.mjs";
import { Float } from "./messagepack.mjs";

/**
 * What a value is read or written with: the body of a payload, and sizes of the innermost object that are
 * known.
 * @typedef {{ reader?: BodyReader, writer?: BodyWriter, sizes: Record<string, number>, keepFloats?: boolean }
 * } Context
 */
/**
 * A type of field.
 * @typedef {object} Type
 * @property {(value: any, place: string, context: Context) => any} read  what a decoded value means, checked
 * @property {(value: any, context: Context) => any} write  what `encode` is given
 */
/** A field: its type and, where it may be left out, its default (undefined: it has no value then).
 * @typedef {{ type: Type, optional: boolean, standard: any, list?: string }} Field */

const MAX_INTEGER = 2n ** 63n - 1n;

/** @param {string} place  @param {string} wrong  @returns {ProtocolError} */
function bad(place, wrong) {
  return new ProtocolError("malformed", `${place} ${wrong}`);
}

/** @param {unknown} value */
function shown(value) {
  if (value instanceof Float) return String(value.value);
  if (typeof value === "object" && value !== null) return Array.isArray(value) ? "a list" : "a map";
  return typeof value === "string" ? JSON.stringify(value.slice(0, 80)) : String(value);
}

/**
 * An integer; beyond 2⁵³ it is read as bigint.
 * @param {number | bigint} least
 * @param {number | bigint} most
 * @returns {Type}
 */
export function integer(least = -MAX_INTEGER - 1n, most = MAX_INTEGER) {
  return {
    read(value, place) {
      if (typeof value !== "bigint" && !(typeof value === "number"))
        throw bad(place, `is ${shown(value)}, no integer`);
      if (value < least || value > most) throw bad(place, `is ${value}, which is not in its range`);
      return value;
    },
    write: (value) => value,
  };
}

/**
 * An integer that is always read as bigint, such as a time: arithmetic on it is exact.
 * @param {number | bigint} least
 * @returns {Type}
 */
export function bigInteger(least) {
  const type = integer(least);
  return { ...type, read: (value, place, context) => BigInt(type.read(value, place, context)) };
}

/**
 * A float; an integer is accepted.
 * @param {(value: number) => boolean} accepts
 * @returns {Type}
 */
export function real(accepts = () => true) {
  return {
    read(value, place) {
      const number = value instanceof Float ? value.value : typeof value === "bigint" ? Number(value) : value;
      if (typeof number !== "number") throw bad(place, `is ${shown(value)}, no number`);
      if (!Number.isFinite(number)) throw bad(place, `is ${number}`);
      if (!accepts(number)) throw bad(place, `is ${number}, which is not in its range`);
      return number;
    },
    write: (value) => new Float(value + 0),
  };
}

/** @type {Type} */
export const bool = {
  read(value, place) {
    if (typeof value !== "boolean") throw bad(place, `is ${shown(value)}, neither true nor false`);
    return value;
  },
  write: (value) => value,
};

/**
 * A string.
 * @param {{ least?: number, most?: number, pattern?: RegExp, values?: readonly string[] }} rules  lengths in
 *   code points
 * @returns {Type}
 */
export function string({ least = 0, most = Infinity, pattern, values } = {}) {
  return {
    read(value, place) {
      if (typeof value !== "string") throw bad(place, `is ${shown(value)}, no text`);
      if (values && !values.includes(value))
        throw bad(place, `is ${shown(value)}, not one of ${values.join(", ")}`);
      if (value.length < least || (value.length > most && [...value].length > most))
        throw bad(place, `has ${value.length} characters`);
      if (pattern && !pattern.test(value)) throw bad(place, `is ${shown(value)}, which is not allowed`);
      return value;
    },
    write: (value) => value,
  };
}

/**
 * A list.
 * @param {Type} of
 * @param {{ most?: number, exactly?: number }} rules
 * @returns {Type}
 */
export function list(of, { most = Infinity, exactly } = {}) {
  return {
    read(value, place, context) {
      if (!Array.isArray(value)) throw bad(place, `is ${shown(value)}, no list`);
      if (value.length > most || (exactly !== undefined && value.length !== exactly))
        throw bad(place, `has ${value.length} items`);
      return value.map((item, index) => of.read(item, `${place}[${index}]`, context));
    },
    write: (value, context) => Array.from(value, (item) => of.write(item, context)),
  };
}

/**
 * A map with keys of any name; written in ascending order of them.
 * @param {Type} of
 * @returns {Type}
 */
export function map(of) {
  return {
    read(value, place, context) {
      if (!isMap(value)) throw bad(place, `is ${shown(value)}, no map`);
      return mapped(value, (item, key) => of.read(item, `${place}.${key}`, context));
    },
    write: (value, context) =>
      new Map(
        Object.keys(value)
          .sort(byBytes)
          .map((key) => [key, of.write(value[key], context)]),
      ),
  };
}

/**
 * Whatever JSON has. Floats are read as numbers, or kept as `Float` where a caller tells them from integers.
 * @type {Type}
 */
export const plain = {
  read: (value, place, context) => plainOf(value, context),
  write: (value) => sorted(value),
};

/** @param {any} value  @param {Context} context  @returns {any} */
function plainOf(value, context) {
  if (value instanceof Float) return context.keepFloats ? value : value.value;
  if (Array.isArray(value)) return value.map((item) => plainOf(item, context));
  return isMap(value) ? mapped(value, (item) => plainOf(item, context)) : value;
}

/** @param {any} value  @returns {any} with the keys of all maps in ascending order */
function sorted(value) {
  if (Array.isArray(value)) return value.map(sorted);
  if (!isMap(value)) return value;
  return new Map(
    Object.keys(value)
      .sort(byBytes)
      .map((key) => [key, sorted(value[key])]),
  );
}

/**
 * An array in the body.
 * @param {string} dtype
 * @param {...(string | number)} shape  a name stands for one size throughout an object
 * @returns {Type}
 */
export function array(dtype, ...shape) {
  return {
    read(value, place, context) {
      if (!context.reader) throw new TypeError("arrays stand in payloads only");
      const found = context.reader.read(value, place);
      if (found.dtype !== dtype) throw bad(place, `has elements of ${found.dtype}, not ${dtype}`);
      if (found.shape.length !== shape.length)
        throw bad(place, `has ${found.shape.length} dimensions, not ${shape.length}`);
      shape.forEach((size, axis) => agree(context, size, found.shape[axis], place));
      return found;
    },
    write(value, context) {
      if (!(value instanceof NumericArray) || !context.writer)
        throw new TypeError("a field of a payload wants a NumericArray");
      return context.writer.place(value);
    },
  };
}

/** @param {Context} context  @param {string | number} size  @param {number} found  @param {string} place */
function agree({ sizes }, size, found, place) {
  const wanted = typeof size === "number" ? size : (sizes[size] ??= found);
  if (found !== wanted) throw bad(place, `has the size ${found}, where ${wanted} is due`);
}

/**
 * A field that may be left out.
 * @param {Type} type
 * @param {any} standard  its default; undefined where a field that is left out has no value
 * @returns {Field}
 */
export function optional(type, standard = undefined) {
  return { type, optional: true, standard };
}

/**
 * A list that gives its length a name.
 * @param {Type} type
 * @param {string} size
 * @returns {Field}
 */
export function sizing(type, size) {
  return { type, optional: false, standard: undefined, list: size };
}

/** An object with these fields, in the order of the table. */
export class Struct {
  /**
   * @param {Record<string, Type | Field>} fields
   * @param {(value: any, place: string) => void} check  what one field says about another
   */
  constructor(fields, check = () => {}) {
    this.fields = Object.entries(fields).map(([name, field]) => ({
      name,
      ...("type" in field ? field : { type: field, optional: false, standard: undefined }),
    }));
    this.check = check;
  }

  /** @param {any} value  @param {string} place  @param {Context} outer  @returns {any} */
  read(value, place, outer) {
    if (!isMap(value)) throw bad(place, `is ${shown(value)}, no map`);
    const context = { ...outer, sizes: {} };
    /** @type {Record<string, any>} */
    const found = {};
    for (const { name, type, optional, standard, list } of this.fields) {
      if (value[name] === undefined) {
        if (!optional) throw bad(place, `has no ${name}`);
        if (standard !== undefined) found[name] = structuredClone(standard);
      } else {
        found[name] = type.read(value[name], `${place}.${name}`, context);
        if (list) agree(context, list, found[name].length, `${place}.${name}`);
      }
    }
    this.check(found, place);
    return found;
  }

  /**
   * @param {any} value
   * @param {Context} context
   * @returns {Record<string, any>} without what equals its default
   */
  write(value, context) {
    /** @type {Record<string, any>} */
    const written = {};
    for (const { name, type, optional, standard } of this.fields) {
      const item = value[name];
      if (item === undefined) {
        if (!optional) throw new TypeError(`${name} is missing`);
      } else if (!(optional && equal(item, standard))) written[name] = type.write(item, context);
    }
    return written;
  }
}

/**
 * One of several objects, told apart by their field `type`.
 * @param {Record<string, Struct>} kinds
 * @returns {Type}
 */
export function tagged(kinds) {
  return {
    read(value, place, context) {
      const kind = isMap(value) ? value.type : undefined;
      if (typeof kind !== "string" || !Object.hasOwn(kinds, kind))
        throw bad(place, `has the type ${shown(kind)}, not one of ${Object.keys(kinds).join(", ")}`);
      return { type: kind, ...kinds[kind].read(value, place, context) };
    },
    write: (value, context) => ({ type: value.type, ...kinds[value.type].write(value, context) }),
  };
}

/**
 * Order of names by their UTF-8 bytes, which is that of their code points.
 * @param {string} a
 * @param {string} b
 */
export function byBytes(a, b) {
  const shorter = Math.min(a.length, b.length);
  let i = 0;
  while (i < shorter && a.charCodeAt(i) === b.charCodeAt(i)) i++;
  if (i === shorter) return a.length - b.length;
  return rank(a.charCodeAt(i)) - rank(b.charCodeAt(i));
}

/** @param {number} unit  of UTF-16: surrogates stand for the code points above all others */
function rank(unit) {
  return unit >= 0xe000 ? unit - 0x800 : unit >= 0xd800 ? unit + 0x2000 : unit;
}

/** @param {any} value */
function isMap(value) {
  return typeof value === "object" && value !== null && !Array.isArray(value) && !(value instanceof Float);
}

/** @param {Record<string, any>} value  @param {(item: any, key: string) => any} change */
function mapped(value, change) {
  const found = Object.create(null);
  for (const key of Object.keys(value)) found[key] = change(value[key], key);
  return found;
}

/** @param {any} a  @param {any} b  @returns {boolean} */
function equal(a, b) {
  if (a === b) return true;
  if (typeof a === "bigint" || typeof b === "bigint") return a == b; // eslint-disable-line eqeqeq
  if (typeof a !== "object" || typeof b !== "object" || !a || !b || a instanceof NumericArray) return false;
  const keys = Object.keys(a);
  return keys.length === Object.keys(b).length && keys.every((key) => equal(a[key], b[key]));
}
