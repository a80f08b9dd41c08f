// Beams as lobes: the distance from the array is the power gain in that direction, |array factor|². A surface shows
// it all around, and a slice what passes at the elevation of the other end, as maps do.
import { BufferAttribute, BufferGeometry, DoubleSide, Group, Mesh, MeshBasicMaterial, MeshLambertMaterial } from "three";
import { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
import { LineSegments2 } from "three/examples/jsm/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/examples/jsm/lines/LineSegmentsGeometry.js";
import { BEST, CHOSEN } from "../colors";
import type { Lobe, Vector } from "../types";
import { inverse, type Pose, rotate } from "./pose";

/** Below this gain, 18 dB under the strongest direction, no surface is drawn. */
const LEAST = 0.016;
/** Directions of a surface that a processor draws, along each of its two angles. */
const COARSE = 64;
/** Surfaces that the graphics card keeps. */
const MOST_SURFACES = 32;
/** Directions of a slice, and the least distance of its points, of the greatest radius. */
const AROUND = 1440;
const APART = 0.008;

export interface ShownBeam {
  lobe: Lobe;
  pose: Pose;
  /** Place of the other end [m, world]. */
  towards: Vector;
  /** Distance of the strongest direction [m]. */
  radius: number;
  best: boolean;
}

export class Beams {
  readonly group = new Group();
  shown: ShownBeam[] = [];
  /** Whether surfaces have all directions that there are. */
  isFine = true;
  /** Surfaces of radius 1: lobes come again, at other distances. */
  private readonly surfaces = new Map<Lobe, BufferGeometry>();
  /** Kept from frame to frame: with the last material of its kind a program goes, and is compiled anew. */
  private readonly materials = { best: beamMaterials(BEST), chosen: beamMaterials(CHOSEN) };

  constructor(private readonly origin: Vector) {}

  set(beams: ShownBeam[]): void {
    this.shown = beams;
    this.group.traverse((child) => {
      if (!(child instanceof Mesh)) return;
      if (!child.userData.kept) child.geometry.dispose();
    });
    this.group.clear();
    for (const beam of beams) this.add(beam);
    for (const [lobe, geometry] of this.surfaces) {
      if (this.surfaces.size <= MOST_SURFACES) break;
      if (beams.some((beam) => beam.lobe === lobe)) continue;
      geometry.dispose();
      this.surfaces.delete(lobe);
    }
  }

  private add({ lobe, pose, towards, radius, best }: ShownBeam): void {
    const materials = this.materials[best ? "best" : "chosen"];
    const at = pose.position.map((value, i) => value - this.origin[i]) as Vector;
    const order = best ? 14 : 17;
    let geometry = this.surfaces.get(lobe);
    if (!geometry) this.surfaces.set(lobe, (geometry = surfaceGeometry(this.isFine ? lobe : thinned(lobe))));
    const surface = new Mesh(geometry, materials.surface);
    const [w, x, y, z] = pose.orientation;
    surface.quaternion.set(x, y, z, w);
    surface.scale.setScalar(radius);
    surface.userData.kept = true;
    const outline = slice(lobe, pose, towards, radius);
    const area = new Mesh(fan(outline), materials.area);
    const lines = new LineSegmentsGeometry();
    lines.setPositions(outline.flatMap((point, i) => [...point, ...outline[(i + 1) % outline.length]]));
    const line = new LineSegments2(lines, materials.line);
    [surface, area, line].forEach((object, i) => {
      object.position.set(...at);
      object.renderOrder = order + i;
      this.group.add(object);
    });
  }
}

function beamMaterials(color: string) {
  const shared = { color, transparent: true, side: DoubleSide, depthWrite: false, forceSinglePass: true };
  return {
    surface: new MeshLambertMaterial({ ...shared, emissive: color, emissiveIntensity: 0.4, opacity: 0.14 }),
    area: new MeshBasicMaterial({ ...shared, opacity: 0.45 }),
    line: new LineMaterial({ color, linewidth: 2, transparent: true, depthWrite: false }),
  };
}

/** Places of a lobe's surface in the device's axes [m], Shape [elevations · azimuths, 3], and its triangles. */
export function lobeMesh(lobe: Lobe, radius: number): { places: Float32Array; triangles: number[] } {
  const { azimuths, elevations, gain } = lobe;
  const wide = azimuths.length;
  const places = new Float32Array(3 * wide * elevations.length);
  const triangles: number[] = [];
  elevations.forEach((elevation, i) =>
    azimuths.forEach((azimuth, j) => {
      const at = i * wide + j;
      const r = radius * gain[i][j] ** 2;
      const flat = r * Math.cos(elevation);
      const place = [flat * Math.cos(azimuth), flat * Math.sin(azimuth), r * Math.sin(elevation)];
      places.set(lobe.axis === "y" ? [place[1], place[2], place[0]] : place, 3 * at);
      if (i + 1 >= elevations.length || j + 1 >= wide) return;
      if (Math.max(gain[i][j], gain[i + 1][j], gain[i][j + 1], gain[i + 1][j + 1]) ** 2 < LEAST) return;
      triangles.push(at, at + 1, at + wide, at + 1, at + wide + 1, at + wide);
    }),
  );
  return { places, triangles };
}

/** Amplitude of a lobe in a direction of the device's axes (unit vector), between its samples. */
export function gainTowards({ axis, azimuths, elevations, gain }: Lobe, [x, y, z]: Vector): number {
  const [u, v, w] = axis === "y" ? [z, x, y] : [x, y, z];
  const place = (values: number[], value: number): [number, number] => {
    // Samples are evenly spaced.
    const share = (value - values[0]) / (values[values.length - 1] - values[0]);
    const at = Math.max(0, Math.min(1, share)) * (values.length - 1);
    const low = Math.min(Math.floor(at), values.length - 2);
    return [low, at - low];
  };
  const [i, s] = place(elevations, Math.asin(Math.max(-1, Math.min(1, w))));
  const [j, t] = place(azimuths, Math.atan2(v, u));
  return (1 - s) * ((1 - t) * gain[i][j] + t * gain[i][j + 1]) + s * ((1 - t) * gain[i + 1][j] + t * gain[i + 1][j + 1]);
}

/** Outline of the lobe at the elevation of the other end, around the array [m, world axes]. */
function slice(lobe: Lobe, pose: Pose, towards: Vector, radius: number): Vector[] {
  const way = towards.map((value, i) => value - pose.position[i]);
  const length = Math.hypot(...way) || 1;
  const sine = way[2] / length;
  const cosine = Math.sqrt(Math.max(0, 1 - sine * sine));
  const turn = inverse(pose.orientation);
  const outline: Vector[] = [];
  for (let k = 0; k < AROUND; k++) {
    const azimuth = (2 * Math.PI * k) / AROUND;
    const direction: Vector = [cosine * Math.cos(azimuth), cosine * Math.sin(azimuth), sine];
    const r = radius * gainTowards(lobe, rotate(turn, direction)) ** 2;
    const point = direction.map((value) => r * value) as Vector;
    const last = outline.at(-1);
    // Most directions have next to no gain, and the same point.
    if (!last || Math.hypot(...point.map((value, i) => value - last[i])) > APART * radius) outline.push(point);
  }
  return outline;
}

/** Triangles from the array to its outline. */
function fan(outline: Vector[]): BufferGeometry {
  const places = outline.flatMap((point, i) => [0, 0, 0, ...point, ...outline[(i + 1) % outline.length]]);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(places), 3));
  return geometry;
}

/** A lobe at fewer directions: of those that fall together the strongest counts, so that no beam is lost. */
function thinned(lobe: Lobe): Lobe {
  const strides = [lobe.elevations, lobe.azimuths].map(({ length }) => Math.max(1, Math.ceil((length - 1) / COARSE)));
  const places = [lobe.elevations, lobe.azimuths].map((values, k) =>
    // The last one closes the surface.
    values.map((_, i) => i).filter((i) => i % strides[k] === 0 || i === values.length - 1),
  );
  const around = (i: number, stride: number, length: number) => {
    const half = stride >> 1;
    return [Math.max(0, i - half), Math.min(length, i + half + 1)];
  };
  const gain = places[0].map((i) => {
    const rows = lobe.gain.slice(...around(i, strides[0], lobe.gain.length));
    return places[1].map((j) => {
      const [low, high] = around(j, strides[1], lobe.azimuths.length);
      return Math.max(...rows.flatMap((row) => row.slice(low, high)));
    });
  });
  const [elevations, azimuths] = [lobe.elevations, lobe.azimuths].map((values, k) => places[k].map((i) => values[i]));
  return { ...lobe, elevations, azimuths, gain };
}

function surfaceGeometry(lobe: Lobe): BufferGeometry {
  const { places, triangles } = lobeMesh(lobe, 1);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(places, 3));
  geometry.setIndex(triangles);
  geometry.computeVertexNormals();
  return geometry;
}
