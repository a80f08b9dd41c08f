// Beams as lobes: the distance from the array is the power gain in that direction, |array factor|².
import { BufferAttribute, BufferGeometry, DoubleSide, Group, Mesh, MeshLambertMaterial } from "three";
import { BEST, CHOSEN } from "../colors";
import type { Lobe, Vector } from "../types";
import type { Pose } from "./pose";

/** Below this gain, 18 dB under the strongest direction, nothing is drawn. */
const LEAST = 0.016;

export interface ShownBeam {
  lobe: Lobe;
  pose: Pose;
  /** Distance of the strongest direction [m]. */
  radius: number;
  best: boolean;
}

export class Beams {
  readonly group = new Group();
  shown: ShownBeam[] = [];

  constructor(private readonly origin: Vector) {}

  set(beams: ShownBeam[]): void {
    this.shown = beams;
    for (const child of this.group.children as Mesh<BufferGeometry, MeshLambertMaterial>[]) {
      child.geometry.dispose();
      child.material.dispose();
    }
    this.group.clear();
    for (const { lobe, pose, radius, best } of beams) {
      const color = best ? BEST : CHOSEN;
      const material = new MeshLambertMaterial({
        color,
        emissive: color,
        emissiveIntensity: 0.35,
        transparent: true,
        opacity: best ? 0.34 : 0.42,
        side: DoubleSide,
        depthWrite: false,
      });
      const mesh = new Mesh(lobeGeometry(lobe, radius), material);
      mesh.renderOrder = best ? 14 : 15;
      mesh.position.set(...(pose.position.map((value, i) => value - this.origin[i]) as Vector));
      const [w, x, y, z] = pose.orientation;
      mesh.quaternion.set(x, y, z, w);
      this.group.add(mesh);
    }
  }
}

/** Triangles of a lobe in the device's axes; places [m], Shape [elevations · azimuths, 3]. */
export function lobeMesh(lobe: Lobe, radius: number): { places: Float32Array; triangles: number[] } {
  const { azimuths, elevations, gain } = lobe;
  const wide = azimuths.length;
  const places = new Float32Array(3 * wide * elevations.length);
  const triangles: number[] = [];
  elevations.forEach((elevation, i) =>
    azimuths.forEach((azimuth, j) => {
      const at = i * wide + j;
      const r = radius * gain[i][j] ** 2;
      places[3 * at] = r * Math.cos(elevation) * Math.cos(azimuth);
      places[3 * at + 1] = r * Math.cos(elevation) * Math.sin(azimuth);
      places[3 * at + 2] = r * Math.sin(elevation);
      if (i + 1 >= elevations.length || j + 1 >= wide) return;
      if (Math.max(gain[i][j], gain[i + 1][j], gain[i][j + 1], gain[i + 1][j + 1]) ** 2 < LEAST) return;
      triangles.push(at, at + 1, at + wide, at + 1, at + wide + 1, at + wide);
    }),
  );
  return { places, triangles };
}

function lobeGeometry(lobe: Lobe, radius: number): BufferGeometry {
  const { places, triangles } = lobeMesh(lobe, radius);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(places, 3));
  geometry.setIndex(triangles);
  geometry.computeVertexNormals();
  return geometry;
}
