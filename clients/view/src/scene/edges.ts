// Edges of buildings: where two faces meet at an angle, or a face ends.

/** Faces that turn by less than this are one surface: cosine of 20°. */
const FLAT = Math.cos((20 * Math.PI) / 180);

/**
 * Find the edges of a mesh. three's EdgesGeometry does the same with texts as keys, and takes five times as long:
 * seconds for a city.
 *
 * @param places coordinates of the vertices [m]
 * @param corners three vertices a triangle
 * @returns both ends of each edge
 */
export function edgesOf(places: ArrayLike<number>, corners: ArrayLike<number>): Float32Array {
  const welded = weld(places);
  const count = places.length / 3;
  /** Edge by its welded ends: normal of its first face and its own ends; null once it is known not to show. */
  const open = new Map<number, { normal: number[]; a: number; b: number } | null>();
  const found: number[] = [];
  const add = (a: number, b: number) => {
    for (const v of [a, b]) found.push(places[3 * v], places[3 * v + 1], places[3 * v + 2]);
  };
  for (let i = 0; i < corners.length; i += 3) {
    const face = [corners[i], corners[i + 1], corners[i + 2]];
    const normal = normalOf(places, face);
    if (!normal) continue;
    for (let k = 0; k < 3; k++) {
      const [a, b] = [face[k], face[(k + 1) % 3]];
      const [low, high] = welded[a] < welded[b] ? [welded[a], welded[b]] : [welded[b], welded[a]];
      const key = low * count + high;
      const other = open.get(key);
      if (other === undefined) open.set(key, { normal, a, b });
      else if (other) {
        // Either hand: scenery is not always turned outwards.
        const cosine = Math.abs(normal[0] * other.normal[0] + normal[1] * other.normal[1] + normal[2] * other.normal[2]);
        if (cosine < FLAT) add(a, b);
        open.set(key, null);
      }
    }
  }
  for (const edge of open.values()) if (edge) add(edge.a, edge.b);
  return new Float32Array(found);
}

/** Number of the first vertex at the same place, to a millimetre, for each vertex. */
function weld(places: ArrayLike<number>): Uint32Array {
  const known = new Map<string, number>();
  const welded = new Uint32Array(places.length / 3);
  for (let v = 0; v < welded.length; v++) {
    const key = [0, 1, 2].map((k) => Math.round(1000 * places[3 * v + k])).join();
    const first = known.get(key);
    if (first === undefined) known.set(key, v);
    welded[v] = first ?? v;
  }
  return welded;
}

/** Unit normal of a triangle; null where it has no area. */
function normalOf(places: ArrayLike<number>, [a, b, c]: number[]): number[] | null {
  const [ux, uy, uz] = [0, 1, 2].map((k) => places[3 * b + k] - places[3 * a + k]);
  const [vx, vy, vz] = [0, 1, 2].map((k) => places[3 * c + k] - places[3 * a + k]);
  const normal = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
  const length = Math.hypot(...normal);
  return length > 1e-9 ? normal.map((value) => value / length) : null;
}
