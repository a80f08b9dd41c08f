// A map of coverage: path gain of the strongest transmitter, a coloured square a cell.
import { BufferAttribute, BufferGeometry, DoubleSide, Group, Mesh, MeshBasicMaterial } from "three";
import { viridis } from "../colors";
import type { Source } from "../source";
import type { Vector } from "../types";

interface Cells {
  /** Middles of columns and rows [m]. */
  x: number[];
  y: number[];
  /** Heights [m] by row and column, and gains [dB]; null: no signal. */
  z: number[][];
  gain_db: (number | null)[][];
}

/** Above the surface, which it would flicker with [m]. */
const LIFT = 0.15;
const SPAN_DB = 80;

export class RadioMap {
  readonly group = new Group();
  /** Cells that are drawn. */
  count = 0;

  constructor(private readonly origin: Vector) {}

  /** Fetch and draw the map. */
  async load(source: Source): Promise<void> {
    const { x, y, z, gain_db: gain } = await source.json<Cells>("radio-map");
    const strongest = gain.flat().reduce<number>((best, value) => Math.max(best, value ?? -Infinity), -Infinity);
    const half = [x, y].map((axis) => (axis.length > 1 ? (axis[1] - axis[0]) / 2 : 0.5));
    const places: number[] = [];
    const colors: number[] = [];
    gain.forEach((row, j) =>
      row.forEach((value, i) => {
        if (value === null) return;
        const color = viridis(1 + (value - strongest) / SPAN_DB).map((part) => part ** 2.2);
        for (const [sx, sy] of [[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]]) {
          places.push(x[i] + sx * half[0] - this.origin[0], y[j] + sy * half[1] - this.origin[1], z[j][i] + LIFT - this.origin[2]);
          colors.push(...color);
        }
        this.count++;
      }),
    );
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(places), 3));
    geometry.setAttribute("color", new BufferAttribute(new Float32Array(colors), 3));
    const material = new MeshBasicMaterial({ vertexColors: true, side: DoubleSide, transparent: true, opacity: 0.8, depthWrite: false });
    this.group.add(new Mesh(geometry, material));
  }
}
