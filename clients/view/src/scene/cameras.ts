// Cameras as frusta: the pyramid that one sees, and at its end the picture that it took.
import {
  BufferAttribute,
  BufferGeometry,
  DataTexture,
  DoubleSide,
  Group,
  LinearFilter,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshBasicMaterial,
} from "three";
import type { Camera, CameraDevice, Scene } from "../../../js/src/types.d.ts";
import { numbers } from "../decode";
import type { About, Vector } from "../types";
import { devicePose, type Pose, rotate } from "./pose";
import type { Theme } from "./theme";

export class Cameras {
  readonly group = new Group();
  private readonly lines: LineSegments<BufferGeometry, LineBasicMaterial>;
  private readonly pictures = new Group();
  private readonly length: number;

  constructor(
    about: About,
    private readonly origin: Vector,
  ) {
    const { low, high } = about.bounds;
    this.length = Math.min(Math.max(1.5, 0.01 * Math.max(high[0] - low[0], high[1] - low[1])), 3.5);
    this.lines = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ transparent: true, opacity: 0.6 }));
    this.lines.frustumCulled = false;
    this.group.add(this.lines, this.pictures);
  }

  /** Draw the frusta of a scene's cameras, with their pictures where they are there. */
  update(scene: Scene | null, camera: Camera | null): void {
    for (const { geometry, material } of this.pictures.children as Mesh<BufferGeometry, MeshBasicMaterial>[]) {
      geometry.dispose();
      material.map?.dispose();
      material.dispose();
    }
    this.pictures.clear();
    const ends: number[] = [];
    for (const device of scene?.devices ?? []) {
      const pose = device.type === "camera" && scene ? devicePose(scene, device) : null;
      if (!pose || device.type !== "camera") continue;
      const corners = this.corners(pose, device);
      const apex = pose.position.map((value, i) => value - this.origin[i]);
      corners.forEach((corner, i) => ends.push(...apex, ...corner, ...corner, ...corners[(i + 1) % 4]));
      const image = camera?.images.find(({ sensor }) => sensor === device.name);
      if (image) this.addPicture(corners, image.rgb);
    }
    this.lines.geometry.dispose();
    this.lines.geometry = new BufferGeometry();
    this.lines.geometry.setAttribute("position", new BufferAttribute(new Float32Array(ends), 3));
  }

  setTheme(theme: Theme): void {
    this.lines.material.color.set(theme.ink);
  }

  /** Corners of the far end: top left, top right, bottom right, bottom left, as the picture has them. */
  private corners(pose: Pose, { width, height, field_of_view }: CameraDevice): Vector[] {
    const side = this.length * Math.tan(field_of_view / 2);
    const up = (side * height) / width;
    const ends: Vector[] = [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([y, z]) => [this.length, y * side, z * up]);
    return ends.map((end) => rotate(pose.orientation, end).map((value, i) => value + pose.position[i] - this.origin[i]) as Vector);
  }

  private addPicture(corners: Vector[], rgb: Camera["images"][number]["rgb"]): void {
    const [height, width] = rgb.shape;
    const colors = numbers(rgb);
    const pixels = new Uint8Array(4 * width * height).fill(255);
    for (let i = 0; i < width * height; i++) for (let k = 0; k < 3; k++) pixels[4 * i + k] = colors[3 * i + k];
    const texture = new DataTexture(pixels, width, height);
    texture.colorSpace = "srgb";
    texture.magFilter = texture.minFilter = LinearFilter;
    texture.needsUpdate = true;
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(corners.flat()), 3));
    // The first row of the texture is the top one.
    geometry.setAttribute("uv", new BufferAttribute(new Float32Array([0, 0, 1, 0, 1, 1, 0, 1]), 2));
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    const material = new MeshBasicMaterial({ map: texture, side: DoubleSide, transparent: true, opacity: 0.9 });
    this.pictures.add(new Mesh(geometry, material));
  }
}
