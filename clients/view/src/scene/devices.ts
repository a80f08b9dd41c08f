// Antennas, LIDARs and cameras: plates and posts in the world, marks of constant size on top.
import {
  BoxGeometry,
  BufferAttribute,
  BufferGeometry,
  CanvasTexture,
  CylinderGeometry,
  Group,
  Mesh,
  MeshLambertMaterial,
  Points,
  PointsMaterial,
  Quaternion,
  Vector3,
} from "three";
import type { Device, Scene } from "../../../js/src/types.d.ts";
import { DIFFERENT } from "../colors";
import type { About, Vector } from "../types";
import type { Label } from "./labels";
import { devicePose, type Pose } from "./pose";
import type { Theme } from "./theme";

export interface ShownDevice {
  device: Device;
  pose: Pose;
}

type Sign = "tx" | "rx" | "sensor";
const SIZES: Record<Sign, number> = { tx: 19, rx: 9, sensor: 9 };

export class Devices {
  readonly group = new Group();
  readonly shown = new Map<string, ShownDevice>();
  private readonly bodies = new Group();
  private readonly marks: Record<Sign, Points<BufferGeometry, PointsMaterial>>;
  private readonly plate = new MeshLambertMaterial({ color: "#f4f6f8", flatShading: true });
  private readonly post = new MeshLambertMaterial({ color: "#7b838c", flatShading: true });
  private readonly extent: number;
  private names: Record<Sign, string[]> = { tx: [], rx: [], sensor: [] };
  private different: ReadonlySet<string> = new Set();

  constructor(
    about: About,
    private readonly origin: Vector,
  ) {
    const { low, high } = about.bounds;
    this.extent = Math.max(high[0] - low[0], high[1] - low[1]);
    const marks = (sign: Sign) => {
      const points = new Points(
        new BufferGeometry(),
        new PointsMaterial({ size: SIZES[sign], sizeAttenuation: false, transparent: true, alphaTest: 0.1, depthTest: false }),
      );
      points.frustumCulled = false;
      points.renderOrder = 25;
      this.group.add(points);
      return points;
    };
    this.marks = { tx: marks("tx"), rx: marks("rx"), sensor: marks("sensor") };
    this.group.add(this.bodies);
  }

  /** Place the devices of a scene. */
  update(scene: Scene | null): void {
    this.shown.clear();
    for (const device of scene?.devices ?? []) {
      const pose = scene && devicePose(scene, device);
      if (pose) this.shown.set(device.name, { device, pose });
    }
    this.names = { tx: [], rx: [], sensor: [] };
    for (const child of this.bodies.children) (child as Mesh).geometry.dispose();
    this.bodies.clear();
    for (const [name, { device, pose }] of this.shown) {
      this.names[device.type === "antenna" ? (device.role === "rx" ? "rx" : "tx") : "sensor"].push(name);
      if (device.type === "antenna" && device.role !== "rx" && !device.parent) this.addMast(pose, device.array);
    }
    for (const sign of ["tx", "rx", "sensor"] as const) {
      const places = this.names[sign].flatMap((name) => this.local(this.shown.get(name)!.pose.position).toArray());
      replacePlaces(this.marks[sign], places);
    }
  }

  /** Receivers whose beams differ from those of the run beside. */
  setDifferent(names: ReadonlySet<string>): void {
    this.different = names;
  }

  setTheme(theme: Theme): void {
    for (const sign of ["tx", "rx", "sensor"] as const) {
      const material = this.marks[sign].material;
      material.map?.dispose();
      material.map = drawSign(sign, theme);
      material.needsUpdate = true;
    }
  }

  show(layers: ReadonlySet<string>): void {
    for (const points of Object.values(this.marks)) points.visible = layers.has("devices");
    this.bodies.visible = layers.has("devices");
  }

  /** Marks that can be picked, and the name of one's point. */
  pickables(): [Points, string[]][] {
    return (["tx", "rx", "sensor"] as const).map((sign) => [this.marks[sign], this.names[sign]]);
  }

  labels(selected: string | null): Label[] {
    return [...this.shown]
      .filter(([name, { device }]) => name === selected || !device.parent || this.different.has(device.name))
      .map(([name, { pose }]) => ({
        text: this.different.has(name) ? `${name} ≠` : name,
        at: this.local(pose.position),
        rank: name === selected ? 4 : 2.5,
        marked: name === selected,
      }));
  }

  /** Colour of what differs, for legends. */
  static readonly different = DIFFERENT;

  private local(position: Vector): Vector3 {
    return new Vector3(...position.map((value, i) => value - this.origin[i]));
  }

  /** A plate along the array's panel, large enough to be seen, on a post. */
  private addMast(pose: Pose, array: { rows: number; columns: number }): void {
    const long = Math.min(Math.max(1.2, 0.008 * this.extent), 4);
    const share = Math.min(1, Math.max(0.3, array.rows / array.columns));
    const [tall, wide] = array.rows > array.columns ? [long, Math.max(0.3, array.columns / array.rows) * long] : [share * long, long];
    const [w, x, y, z] = pose.orientation;
    const at = this.local(pose.position);
    const plate = new Mesh(new BoxGeometry(0.12 * long, wide, tall), this.plate);
    plate.quaternion.copy(new Quaternion(x, y, z, w));
    plate.position.copy(at).add(new Vector3(-0.08 * long, 0, 0).applyQuaternion(plate.quaternion));
    const ground = -this.origin[2] + this.ground;
    const height = Math.max(0, at.z - ground);
    const post = new Mesh(new CylinderGeometry(0.05 * long, 0.07 * long, height, 10).rotateX(Math.PI / 2), this.post);
    post.position.set(plate.position.x, plate.position.y, ground + height / 2);
    const back = new Vector3(-0.14 * long, 0, 0).applyQuaternion(plate.quaternion);
    post.position.add(back.setZ(0));
    for (const mesh of [plate, post]) mesh.castShadow = true;
    this.bodies.add(plate, post);
  }

  /** Height of the ground [m]. */
  ground = 0;
}

function replacePlaces(object: Points, places: number[]): void {
  object.geometry.dispose();
  object.geometry = new BufferGeometry();
  object.geometry.setAttribute("position", new BufferAttribute(new Float32Array(places), 3));
}

/** Sign of a device: a triangle sends, a circle receives, a square senses. */
function drawSign(sign: Sign, theme: Theme): CanvasTexture {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 64;
  const context = canvas.getContext("2d");
  if (context) {
    context.fillStyle = theme.ink;
    context.strokeStyle = theme.dark ? "#000000" : "#ffffff";
    context.lineWidth = 7;
    context.lineJoin = "round";
    context.beginPath();
    if (sign === "tx") {
      context.moveTo(32, 7);
      context.lineTo(58, 55);
      context.lineTo(6, 55);
    } else if (sign === "rx") context.arc(32, 32, 24, 0, 7);
    else context.rect(11, 11, 42, 42);
    context.closePath();
    context.stroke();
    context.fill();
  }
  const texture = new CanvasTexture(canvas);
  texture.colorSpace = "srgb";
  return texture;
}
