// Paths of the channel as lines over their interaction points, coloured by gain, order or kind.
import { BufferAttribute, BufferGeometry, Color, GreaterDepth, Group, Points, PointsMaterial } from "three";
import { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
import { LineSegments2 } from "three/examples/jsm/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/examples/jsm/lines/LineSegmentsGeometry.js";
import type { Channel, Scene } from "../../../js/src/types.d.ts";
import { KINDS, ORDERS, rgb, viridis, type Rgb } from "../colors";
import { numbers } from "../decode";
import type { ViewState } from "../state";
import type { Vector } from "../types";
import { devicePose } from "./pose";
import type { Theme } from "./theme";

export interface Path {
  key: string;
  index: number;
  tx: string;
  rx: string;
  /** Of the carrier that is shown [dB]. */
  gain: number;
  /** Kinds of its interactions, from TX to RX. */
  kinds: number[];
  /** From TX to RX [m, world]; of one whose route is unknown both its ends. */
  points: Vector[];
  /** Whether the line is its route; otherwise it has a tick at either end. */
  known: boolean;
  /** Unit vectors from TX along the departure, and from RX to where it arrives from. */
  leaving: Vector;
  coming: Vector;
}

/** Paths weaker than the strongest by more than this have the last colour [dB], as on maps. */
const RANGE_DB = 50;
/** Length of a tick, of the distance between both ends. */
const TICK = 0.08;
/** Cosine of the angle by which a straight path may leave the straight line. */
const STRAIGHT = Math.cos((0.5 * Math.PI) / 180);

/** Paths of a channel whose devices are in the scene, the weakest first. */
export function pathsOf(channel: Channel, scene: Scene, carrier: string | null): Path[] {
  const poses = new Map(scene.devices?.map((device) => [device.name, devicePose(scene, device)]));
  const [count, depth] = channel.interactions.shape;
  const a = numbers(channel.a);
  const kinds = numbers(channel.interactions);
  const places = numbers(channel.points);
  const offsets = numbers(channel.offsets);
  const [aod, aoa] = [numbers(channel.aod), numbers(channel.aoa)];
  const chosen = channel.carriers.findIndex(({ name }) => name === carrier);
  const power = (c: number, path: number) => {
    const at = 2 * (c * count + path);
    return a[at] ** 2 + a[at + 1] ** 2;
  };
  const found: Path[] = [];
  channel.tx.forEach((tx, t) =>
    channel.rx.forEach((rx, r) => {
      const [from, to] = [poses.get(tx), poses.get(rx)];
      if (!from || !to) return;
      const pair = t * channel.rx.length + r;
      for (let path = offsets[pair]; path < offsets[pair + 1]; path++) {
        // On carriers that a pair does not use its amplitudes are 0: then the first that it uses counts.
        const strongest = [chosen, ...channel.carriers.keys()].find((c) => c >= 0 && power(c, path) > 0);
        if (strongest === undefined) continue;
        const own: number[] = [];
        const between: Vector[] = [];
        for (let d = 0; d < depth; d++) {
          const kind = kinds[path * depth + d];
          if (!kind) break;
          own.push(kind);
          const at = 3 * (path * depth + d);
          between.push([places[at], places[at + 1], places[at + 2]]);
        }
        const leaving = direction(aod[2 * path], aod[2 * path + 1]);
        found.push({
          key: `${tx}>${rx}#${channel.id.data[path]}`,
          index: path,
          tx,
          rx,
          gain: 10 * Math.log10(power(strongest, path)),
          kinds: own,
          points: [from.position, ...between, to.position],
          known: own.length > 0 || isStraight(from.position, to.position, leaving),
          leaving,
          coming: direction(aoa[2 * path], aoa[2 * path + 1]),
        });
      }
    }),
  );
  return found.sort((p, q) => p.gain - q.gain);
}

/** Unit vector of zenith and azimuth [rad]. */
export function direction(zenith: number, azimuth: number): Vector {
  return [Math.sin(zenith) * Math.cos(azimuth), Math.sin(zenith) * Math.sin(azimuth), Math.cos(zenith)];
}

function isStraight(from: Vector, to: Vector, leaving: Vector): boolean {
  const line = to.map((value, i) => value - from[i]);
  const length = Math.hypot(...line);
  return length === 0 || line.reduce((sum, value, i) => sum + value * leaving[i], 0) / length >= STRAIGHT;
}

/** Ends of the colour scale [dB], to tens, so that they stay as frames go by. */
export function gainRange(paths: Path[]): [number, number] {
  if (!paths.length) return [-140, -60];
  const top = Math.max(...paths.map(({ gain }) => gain));
  const low = Math.max(Math.min(...paths.map(({ gain }) => gain)), top - RANGE_DB);
  const high = Math.ceil(top / 10) * 10;
  return [Math.min(Math.floor(low / 10) * 10, high - 10), high];
}

/** Place of a path's kind in `KINDS`: of several the one that is rarest. */
export function kindOf({ kinds }: Path): number {
  return [3, 2, 4, 1].find((kind) => kinds.includes(kind)) ?? 0;
}

export function colorOf(path: Path, coloring: ViewState["color"], [low, high]: [number, number]): Rgb {
  if (coloring === "gain") return viridis((path.gain - low) / (high - low));
  if (coloring === "order") return rgb(ORDERS[Math.min(path.kinds.length, ORDERS.length - 1)]);
  return rgb(KINDS[kindOf(path)].color);
}

export class Rays {
  readonly group = new Group();
  /** Of the frame. */
  paths: Path[] = [];
  /** Those that are drawn. */
  drawn: Path[] = [];
  range: [number, number] = [-140, -60];
  /** Path of each segment of the lines. */
  private segments: Path[] = [];
  private readonly lines: LineSegments2;
  private readonly casing: LineSegments2;
  private readonly hidden: LineSegments2;
  private readonly points: Points<BufferGeometry, PointsMaterial>;
  private readonly marked: LineSegments2;

  constructor(private readonly origin: Vector) {
    const line = (options: ConstructorParameters<typeof LineMaterial>[0], order: number) => {
      const made = new LineSegments2(
        new LineSegmentsGeometry(),
        new LineMaterial({ transparent: true, depthWrite: false, ...options }),
      );
      made.frustumCulled = false;
      made.renderOrder = order;
      this.group.add(made);
      return made;
    };
    this.casing = line({ linewidth: 4, opacity: 0.28 }, 10);
    this.lines = line({ linewidth: 2, vertexColors: true, opacity: 0.95 }, 11);
    // Behind buildings they are faint, and still there.
    this.hidden = line({ linewidth: 1.5, vertexColors: true, opacity: 0.22 }, 9);
    this.hidden.material.depthFunc = GreaterDepth;
    this.marked = line({ linewidth: 6, opacity: 0.9, depthTest: false }, 29);
    this.points = new Points(
      new BufferGeometry(),
      new PointsMaterial({ size: 6, sizeAttenuation: false, vertexColors: true, transparent: true, depthWrite: false }),
    );
    this.points.frustumCulled = false;
    this.points.renderOrder = 12;
    this.group.add(this.points);
  }

  setPaths(paths: Path[]): void {
    this.paths = paths;
    this.range = gainRange(paths);
  }

  /** Draw the paths that the state asks for. */
  draw(state: Pick<ViewState, "color" | "min" | "rays" | "sel">, user: { tx: string; rx: string } | null): void {
    this.drawn = this.paths.filter(
      (path) =>
        (state.min === null || path.gain >= state.min) &&
        (state.rays === "all" || !user || (path.tx === user.tx && path.rx === user.rx)),
    );
    const lines: number[] = [];
    const colors: number[] = [];
    const dots: number[] = [];
    const dotColors: number[] = [];
    const marked: number[] = [];
    this.segments = [];
    for (const path of this.drawn) {
      const color = new Color().setRGB(...colorOf(path, state.color, this.range), "srgb");
      const local = path.points.map((point) => point.map((value, i) => value - this.origin[i]));
      const pieces = path.known ? local.slice(1).map((point, i) => [local[i], point]) : ticks(path, local);
      for (const [a, b] of pieces) {
        lines.push(...a, ...b);
        colors.push(color.r, color.g, color.b, color.r, color.g, color.b);
        this.segments.push(path);
        if (path.key === state.sel) marked.push(...a, ...b);
      }
      path.kinds.forEach((kind, i) => {
        dots.push(...local[i + 1]);
        const own = state.color === "kind" ? new Color(KINDS[kind]?.color) : color;
        dotColors.push(own.r, own.g, own.b);
      });
    }
    for (const object of [this.lines, this.hidden]) fillLines(object, lines, colors);
    fillLines(this.casing, lines);
    fillLines(this.marked, marked);
    this.points.geometry.dispose();
    this.points.geometry = new BufferGeometry();
    this.points.geometry.setAttribute("position", new BufferAttribute(new Float32Array(dots), 3));
    this.points.geometry.setAttribute("color", new BufferAttribute(new Float32Array(dotColors), 3));
  }

  setTheme(theme: Theme): void {
    this.casing.material.color.set(theme.casing);
    this.marked.material.color.set(theme.ink);
  }

  /** What can be picked, and the path of a segment of it. */
  get pickable(): LineSegments2 {
    return this.lines;
  }
  pathOf(segment: number): Path | null {
    return this.segments[segment] ?? null;
  }
}

/** Pieces at either end of a path of unknown route: along its departure, and to where it arrives from. */
function ticks({ leaving, coming }: Path, ends: number[][]): number[][][] {
  const [from, to] = [ends[0], ends[ends.length - 1]];
  const length = TICK * Math.hypot(...from.map((value, i) => value - to[i]));
  const along = (place: number[], way: Vector) => place.map((value, i) => value + length * way[i]);
  return [
    [from, along(from, leaving)],
    [to, along(to, coming)],
  ];
}

function fillLines(object: LineSegments2, places: number[], colors?: number[]): void {
  object.geometry.dispose();
  object.geometry = new LineSegmentsGeometry();
  object.visible = places.length > 0;
  if (!places.length) return;
  object.geometry.setPositions(places);
  if (colors) object.geometry.setColors(colors);
}
