// Binary answers: products in the layout of a WebSocket message of the gateway, and meshes.
import { decode } from "../../js/src/messagepack.mjs";
import { splitFrame } from "../../js/src/messages.mjs";
import { decodePayload } from "../../js/src/topics.mjs";
import type { NumericArray } from "../../js/src/arrays.mjs";
import type { Product, Topic } from "./types";

/** Decode a product and check its types and sizes. */
export function decodeProduct<T extends Topic>(topic: T, content: ArrayBuffer): Product<T> {
  const [said, header, body] = splitFrame(new Uint8Array(content));
  if (!header || !body) throw new Error(`an answer without a payload of ${topic}`);
  const about = decode(said) as unknown as Omit<Product<T>, "payload" | "kept"> & Partial<Product<T>>;
  const { source, status, frame, kept = {} } = about;
  return { source, status, frame: Number(frame), kept: plainCounts(kept), payload: decodePayload(topic, header, body) };
}

function plainCounts(kept: Product<Topic>["kept"]): Product<Topic>["kept"] {
  return Object.fromEntries(Object.entries(kept).map(([name, [some, all]]) => [name, [Number(some), Number(all)]]));
}

export interface Mesh {
  /** [m], three a vertex. */
  vertices: Float32Array;
  /** Three vertices a triangle. */
  triangles: Uint32Array;
}

/** Decode a mesh: numbers of vertices and triangles, then both. */
export function decodeMesh(content: ArrayBuffer): Mesh {
  const [vertices, triangles] = new Uint32Array(content, 0, 2);
  if (content.byteLength !== 8 + 12 * (vertices + triangles)) {
    throw new Error(`a mesh of ${content.byteLength} bytes, ${vertices} vertices and ${triangles} triangles`);
  }
  return {
    vertices: new Float32Array(content, 8, 3 * vertices),
    triangles: new Uint32Array(content, 8 + 12 * vertices, 3 * triangles),
  };
}

/** Elements as numbers; of complex ones real and imaginary parts in turn. */
export function numbers(array: NumericArray): ArrayLike<number> {
  const { data } = array;
  if (data instanceof BigInt64Array || data instanceof BigUint64Array) return Array.from(data, Number);
  return data;
}
