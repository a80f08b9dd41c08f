// The scene of one run: everything that a frame of it shows.
import { DirectionalLight, Fog, HemisphereLight, PerspectiveCamera, Raycaster, Scene, Vector2, type Vector3 } from "three";
import type { Frame } from "../frames";
import { first } from "../frames";
import type { Source } from "../source";
import type { ViewState } from "../state";
import type { About, MeshInfo, User, Vector } from "../types";
import { Beams } from "./beams";
import { Cameras } from "./cameras";
import { Devices } from "./devices";
import type { Label } from "./labels";
import { Points } from "./lidar";
import { RadioMap } from "./radio_map";
import { Objects } from "./objects";
import { type Path, pathsOf, Rays } from "./rays";
import type { Theme } from "./theme";
import { World } from "./world";

/** What a click hit. */
export type Hit =
  | { kind: "object" | "device"; name: string }
  | { kind: "path"; path: Path }
  | { kind: "piece"; name: string; info: MeshInfo };

export class RunView {
  readonly scene = new Scene();
  readonly world: World;
  readonly objects: Objects;
  readonly devices: Devices;
  readonly rays: Rays;
  readonly beams: Beams;
  readonly points: Points;
  readonly cameras: Cameras;
  readonly radioMap: RadioMap;
  frame: Frame | null = null;
  private readonly hemisphere = new HemisphereLight();
  readonly sun = new DirectionalLight();

  /** @param origin world coordinates of the scene's zero [m] */
  constructor(
    readonly about: About,
    readonly source: Source,
    origin: Vector,
  ) {
    this.world = new World(about, origin);
    this.objects = new Objects(about, origin);
    this.devices = new Devices(about, origin);
    this.devices.ground = about.bounds.low[2];
    this.rays = new Rays(origin);
    this.beams = new Beams(origin);
    this.points = new Points(origin);
    this.cameras = new Cameras(about, origin);
    this.radioMap = new RadioMap(origin);
    const layers = [this.world, this.objects, this.devices, this.rays, this.beams, this.points, this.cameras, this.radioMap];
    this.scene.add(...layers.map(({ group }) => group), this.hemisphere, this.sun, this.sun.target);
    this.placeSun(origin);
  }

  /** Fetch what stands still. */
  async load(report: (text: string) => void): Promise<void> {
    const map = this.about.radio_map ? this.radioMap.load(this.source).catch((error: Error) => report(error.message)) : null;
    await Promise.all([this.world.load(this.source), this.objects.load(this.source, report), map]);
  }

  /** Show a frame. */
  update(frame: Frame | null, user: User | null): void {
    this.frame = frame;
    const scene = first(frame, "scene");
    const channel = first(frame, "channel");
    this.objects.update(scene);
    this.devices.update(scene);
    this.rays.setPaths(scene && channel ? pathsOf(channel, scene, user?.carrier ?? null) : []);
    this.cameras.update(scene, first(frame, "camera"));
    this.points.update(first(frame, "lidar"), new Set(scene?.names));
  }

  /** Draw it as the state asks for. */
  draw(state: ViewState, user: User | null): void {
    this.rays.draw(state, user);
    this.objects.select(state.sel);
    const { layers } = state;
    this.world.show(layers);
    this.objects.show(layers);
    this.devices.show(layers);
    this.rays.group.visible = layers.has("rays");
    this.beams.group.visible = layers.has("beams");
    this.points.group.visible = layers.has("lidar");
    this.radioMap.group.visible = layers.has("map");
    // On board of a camera its picture would stand before the world.
    this.cameras.group.visible = layers.has("frusta") && state.mode !== "board";
  }

  setTheme(theme: Theme): void {
    for (const layer of [this.world, this.objects, this.devices, this.rays, this.cameras]) layer.setTheme(theme);
    this.hemisphere.color.set(theme.sky);
    this.hemisphere.groundColor.set(theme.bounce);
    this.hemisphere.intensity = theme.ambient;
    this.sun.color.set(theme.sun);
    this.sun.intensity = theme.sunlight;
    const { low, high } = this.about.bounds;
    const extent = Math.max(high[0] - low[0], high[1] - low[1], 10);
    this.scene.fog = new Fog(theme.horizon, 1.5 * extent, 12 * extent);
  }

  labels(state: ViewState): Label[] {
    const { layers } = state;
    if (!layers.has("names")) return [];
    return [
      ...(layers.has("objects") ? this.objects.labels() : []),
      ...(layers.has("devices") ? this.devices.labels(state.sel) : []),
    ];
  }

  /** Find what is at a point of the picture, from −1 to 1; null: the sky. */
  pick(at: Vector2, camera: PerspectiveCamera, size: Vector2): Hit | null {
    const caster = new Raycaster();
    caster.setFromCamera(at, camera);
    const mark = this.pickMark(at, camera, size);
    if (mark) return mark;
    const { objects } = this;
    const solid = caster.intersectObjects([...objects.shown.values()].map(({ mesh }) => mesh).filter((m) => m.visible), false)[0];
    const pieces = this.world.pieces.filter(({ mesh }) => mesh.visible);
    const scenery = caster.intersectObjects(pieces.map(({ mesh }) => mesh), false)[0];
    const ray = this.pickRay(caster, size);
    const near = Math.min(solid?.distance ?? Infinity, scenery?.distance ?? Infinity);
    const name = solid && solid.distance <= near ? (solid.object.userData.name as string) : null;
    const size3 = name === null ? 0 : Math.max(...(objects.shown.get(name)?.size ?? [0]));
    const ends = name !== null && ray !== null && solid.object.position.distanceTo(ray.point) < size3;
    // A thin line is aimed at, what is behind it is hit by chance: it wins unless it is hidden, or ends there.
    if (ray && !ends && ray.distance < near + 0.5) return { kind: "path", path: ray.path };
    if (name !== null) return { kind: "object", name };
    const piece = pieces.find(({ mesh }) => mesh === scenery?.object);
    if (!piece || !scenery) return null;
    return { kind: "piece", info: piece.info, name: this.world.pieceName(piece.info, scenery.faceIndex ?? 0) };
  }

  private pickRay(caster: Raycaster, size: Vector2): { path: Path; distance: number; point: Vector3 } | null {
    const { pickable, group } = this.rays;
    if (!group.visible || !pickable.visible) return null;
    pickable.material.resolution.copy(size);
    caster.params.Line2 = { threshold: 6 };
    const hit = caster.intersectObject(pickable, false)[0];
    const path = hit && this.rays.pathOf(hit.faceIndex ?? -1);
    return path ? { path, distance: hit.distance, point: hit.point } : null;
  }

  /** Marks have a constant size in the picture: what counts is the distance in pixels. */
  private pickMark(at: Vector2, camera: PerspectiveCamera, size: Vector2): Hit | null {
    let nearest: { name: string; pixels: number } | null = null;
    for (const [points, names] of this.devices.pickables()) {
      if (!points.visible) continue;
      const places = points.geometry.getAttribute("position");
      for (let i = 0; i < (places?.count ?? 0); i++) {
        const p = this.projected.set(places.getX(i), places.getY(i), places.getZ(i)).project(camera);
        const pixels = Math.hypot(((p.x - at.x) * size.x) / 2, ((p.y - at.y) * size.y) / 2);
        if (p.z < 1 && pixels < this.reach(names[i], camera, size) && (!nearest || pixels < nearest.pixels)) nearest = { name: names[i], pixels };
      }
    }
    return nearest && { kind: "device", name: nearest.name };
  }
  /** Distance from a mark at which a click means it [px]: one on a small object would leave nothing of that to click. */
  private reach(device: string, camera: PerspectiveCamera, size: Vector2): number {
    const parent = this.objects.shown.get(this.devices.shown.get(device)?.device.parent ?? "");
    if (!parent) return 9;
    const distance = camera.position.distanceTo(parent.mesh.position);
    const pixels = (Math.max(...parent.size) * size.y) / (2 * distance * Math.tan((camera.fov * Math.PI) / 360));
    return pixels > 60 ? 6 : 0;
  }
  private readonly projected = this.sun.position.clone();

  /** A sun in the east-south-east whose shadows reach over the bounds. */
  private placeSun(origin: Vector): void {
    const { low, high } = this.about.bounds;
    const centre = low.map((value, i) => (value + high[i]) / 2 - origin[i]) as Vector;
    const radius = Math.min(0.5 * Math.hypot(...low.map((value, i) => high[i] - value)) + 5, 900);
    this.sun.target.position.set(...centre);
    this.sun.position.set(centre[0] + 0.95 * radius, centre[1] - 0.6 * radius, centre[2] + 1.6 * radius);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(4096, 4096);
    Object.assign(this.sun.shadow.camera, { left: -radius, right: radius, top: radius, bottom: -radius });
    Object.assign(this.sun.shadow.camera, { near: 0.1 * radius, far: 4 * radius });
    this.sun.shadow.autoUpdate = false;
    this.sun.shadow.normalBias = radius / 700;
    this.sun.shadow.bias = -0.0012;
    this.sun.shadow.radius = 2.5;
  }
}
