// What moves: objects as their mesh or box, and the trails behind them.
import {
  BoxGeometry,
  BufferAttribute,
  BufferGeometry,
  Color,
  CylinderGeometry,
  EdgesGeometry,
  Group,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshLambertMaterial,
  type PerspectiveCamera,
  SphereGeometry,
  Vector3,
} from "three";
import { mergeGeometries } from "three/examples/jsm/utils/BufferGeometryUtils.js";
import { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
import { LineSegments2 } from "three/examples/jsm/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/examples/jsm/lines/LineSegmentsGeometry.js";
import type { Scene } from "../../../js/src/types.d.ts";
import { DIFFERENT, ORANGE, SKY } from "../colors";
import { decodeMesh } from "../decode";
import type { Source } from "../source";
import type { About, Vector } from "../types";
import type { Label } from "./labels";
import { objectPose, type Pose, row } from "./pose";
import type { Theme } from "./theme";

interface Shown {
  mesh: Mesh<BufferGeometry, MeshLambertMaterial>;
  asset: string;
  pose: Pose;
  size: Vector;
}

/** Size that flying objects have at least in the picture. */
const LEAST_PIXELS = 30;

/** Position further apart than this is another one [m]. */
export const SAME_PLACE_M = 1e-6;

export class Objects {
  readonly group = new Group();
  /** Objects of the frame by name. */
  readonly shown = new Map<string, Shown>();
  private readonly geometries = new Map<string, BufferGeometry>();
  private readonly trails: LineSegments2;
  private readonly outline: LineSegments<EdgesGeometry, LineBasicMaterial>;
  private carriers = new Set<string>();
  private theme: Theme | null = null;
  private selected: string | null = null;
  private different: ReadonlySet<string> = new Set();

  constructor(
    private readonly about: About,
    private readonly origin: Vector,
  ) {
    this.geometries.set("", new BoxGeometry(1, 1, 1));
    this.geometries.set("uav", multirotor());
    this.geometries.set("pedestrian", person());
    this.trails = new LineSegments2(
      new LineSegmentsGeometry(),
      new LineMaterial({ linewidth: 2.5, vertexColors: true, transparent: true, opacity: 0.75, depthWrite: false }),
    );
    this.trails.frustumCulled = false;
    this.outline = new LineSegments(
      new EdgesGeometry(new BoxGeometry(1.06, 1.06, 1.06)),
      new LineBasicMaterial({ depthTest: false, transparent: true }),
    );
    this.outline.renderOrder = 30;
    this.outline.visible = false;
    this.group.add(this.trails, this.outline);
  }

  /** Fetch the meshes of objects; what cannot be read stays a box, and is reported. */
  async load(source: Source, report: (text: string) => void): Promise<void> {
    const wanted = Object.entries(this.about.assets).filter(([asset]) => asset !== "");
    await Promise.all(
      wanted.map(async ([asset, id]) => {
        try {
          const { vertices, triangles } = decodeMesh(await source.bytes(`meshes/${id}`));
          const geometry = new BufferGeometry();
          geometry.setAttribute("position", new BufferAttribute(vertices, 3));
          geometry.setIndex(new BufferAttribute(triangles, 1));
          this.geometries.set(asset, geometry);
        } catch (error) {
          report(`mesh ${asset}: ${(error as Error).message}`);
        }
      }),
    );
  }

  /** Place the objects of a scene. */
  update(scene: Scene | null): void {
    const names = new Set(scene?.names ?? []);
    for (const [name, { mesh }] of this.shown) {
      if (names.has(name)) continue;
      this.group.remove(mesh);
      mesh.material.dispose();
      this.shown.delete(name);
    }
    if (!scene) return;
    this.carriers = new Set(scene.devices?.map(({ parent }) => parent).filter(Boolean));
    scene.names.forEach((name, i) => {
      const asset = this.shape(scene.assets[i], scene.classes[i]);
      let shown = this.shown.get(name);
      if (shown && shown.asset !== asset) this.group.remove(shown.mesh);
      if (!shown || shown.asset !== asset) {
        const mesh = new Mesh(this.geometries.get(asset), new MeshLambertMaterial({ flatShading: true }));
        mesh.castShadow = true;
        mesh.receiveShadow = true;
        mesh.userData.name = name;
        this.group.add(mesh);
        shown = { mesh, asset, pose: objectPose(scene, i), size: [1, 1, 1] };
        this.shown.set(name, shown);
      }
      shown.pose = objectPose(scene, i);
      shown.size = row(scene.dimensions, i, 3) as Vector;
      const [w, x, y, z] = shown.pose.orientation;
      shown.mesh.position.copy(this.local(shown.pose.position));
      shown.mesh.quaternion.set(x, y, z, w);
      shown.mesh.scale.set(...shown.size);
    });
    this.paint();
  }

  /** Coordinates of the scene of a place in the world. */
  local([x, y, z]: ArrayLike<number> & Iterable<number>): Vector3 {
    return new Vector3(x - this.origin[0], y - this.origin[1], z - this.origin[2]);
  }

  /**
   * Draw what flies at least so large that it is seen: a UAV of half a metre is no pixel of a city.
   *
   * @param height of the picture [px]
   */
  enlarge(camera: PerspectiveCamera, height: number): void {
    for (const { mesh, asset, size, pose } of this.shown.values()) {
      if (!asset.includes("uav")) continue;
      const perPixel = (2 * Math.tan((camera.fov * Math.PI) / 360) * camera.position.distanceTo(mesh.position)) / height;
      const factor = Math.max(1, (LEAST_PIXELS * perPixel) / Math.max(...size));
      mesh.scale.set(size[0] * factor, size[1] * factor, size[2] * factor);
      mesh.position.copy(this.local(pose.position));
    }
    const selected = this.selected ? this.shown.get(this.selected)?.mesh : undefined;
    if (selected) this.outline.scale.copy(selected.scale);
  }

  /** Draw where objects were: positions in the world of each, oldest first. */
  setTrails(trails: Map<string, Vector[]>): void {
    const places: number[] = [];
    const colors: number[] = [];
    for (const [name, points] of trails) {
      const color = new Color(this.color(name));
      for (let i = 1; i < points.length; i++) {
        places.push(...this.local(points[i - 1]).toArray(), ...this.local(points[i]).toArray());
        colors.push(color.r, color.g, color.b, color.r, color.g, color.b);
      }
    }
    this.trails.geometry.dispose();
    this.trails.geometry = new LineSegmentsGeometry();
    this.trails.visible = places.length > 0;
    if (!places.length) return;
    this.trails.geometry.setPositions(places);
    this.trails.geometry.setColors(colors);
  }

  select(name: string | null): void {
    this.selected = name;
    this.paint();
  }

  /** Mark objects that differ from those of the run beside. */
  setDifferent(names: ReadonlySet<string>): void {
    this.different = names;
    this.paint();
  }

  setTheme(theme: Theme): void {
    this.theme = theme;
    this.paint();
  }

  show(layers: ReadonlySet<string>): void {
    for (const { mesh } of this.shown.values()) mesh.visible = layers.has("objects");
    this.trails.visible &&= layers.has("trails");
    this.outline.visible &&= layers.has("objects");
  }

  labels(): Label[] {
    return [...this.shown].map(([name, { mesh, size }]) => ({
      text: name,
      at: mesh.position.clone().setZ(mesh.position.z + size[2] / 2),
      rank: name === this.selected ? 3 : this.carriers.has(name) ? 2 : 1,
      marked: name === this.selected,
    }));
  }

  private color(name: string): string {
    if (this.different.has(name)) return DIFFERENT;
    return this.carriers.has(name) ? ORANGE : SKY;
  }

  private paint(): void {
    for (const [name, { mesh }] of this.shown) {
      mesh.material.color.set(this.color(name));
      // They stand out in shadows, too.
      mesh.material.emissive.set(this.color(name)).multiplyScalar(0.15);
    }
    const mesh = this.selected ? this.shown.get(this.selected)?.mesh : undefined;
    this.outline.visible = mesh !== undefined;
    if (!mesh) return;
    this.outline.position.copy(mesh.position);
    this.outline.quaternion.copy(mesh.quaternion);
    this.outline.scale.copy(mesh.scale);
    this.outline.material.color.set(this.theme?.ink ?? "#000000");
  }

  /** Its mesh; signs for those without one that are no boxes in the world either. */
  private shape(asset: string, of: string): string {
    if (asset && this.geometries.has(asset)) return asset;
    if (/uav|drone|multirotor/i.test(of)) return "uav";
    return /pedestrian|person/i.test(of) ? "pedestrian" : "";
  }
}

/** A multirotor in a box from −½ to ½. */
function multirotor(): BufferGeometry {
  const parts: BufferGeometry[] = [new BoxGeometry(0.42, 0.26, 0.5), new BoxGeometry(0.1, 0.12, 0.3).translate(0.24, 0, -0.12)];
  for (const [x, y] of [[1, 1], [1, -1], [-1, 1], [-1, -1]]) {
    parts.push(new BoxGeometry(0.46, 0.05, 0.14).rotateZ(Math.atan2(y, x)).translate(0.19 * x, 0.19 * y, 0.1));
    parts.push(new CylinderGeometry(0.03, 0.03, 0.3, 8).rotateX(Math.PI / 2).translate(0.33 * x, 0.33 * y, 0.25));
    parts.push(new CylinderGeometry(0.17, 0.17, 0.05, 20).rotateX(Math.PI / 2).translate(0.33 * x, 0.33 * y, 0.42));
  }
  for (const y of [-0.18, 0.18]) parts.push(new BoxGeometry(0.5, 0.03, 0.06).translate(0, y, -0.46));
  return mergeGeometries(parts);
}

/** A person in a box from −½ to ½. */
function person(): BufferGeometry {
  const parts = [
    new CylinderGeometry(0.5, 0.36, 0.5, 10).rotateX(Math.PI / 2).translate(0, 0, 0.1),
    new CylinderGeometry(0.3, 0.3, 0.4, 10).rotateX(Math.PI / 2).translate(0, 0, -0.3),
    new SphereGeometry(0.3, 10, 8).scale(1, 1, 0.45).translate(0, 0, 0.37),
  ];
  return mergeGeometries(parts);
}
