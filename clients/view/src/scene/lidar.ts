// Points of LIDAR scans, those on moving objects in another colour.
import { BufferAttribute, BufferGeometry, Color, Group, Points as PointCloud, PointsMaterial } from "three";
import type { Lidar } from "../../../js/src/types.d.ts";
import { ORANGE, SKY } from "../colors";
import { numbers } from "../decode";
import type { Vector } from "../types";
import { type Quaternion, rotate } from "./pose";

export class Points {
  readonly group = new Group();
  /** Points that are drawn. */
  count = 0;
  private readonly cloud: PointCloud<BufferGeometry, PointsMaterial>;

  constructor(private readonly origin: Vector) {
    this.cloud = new PointCloud(
      new BufferGeometry(),
      new PointsMaterial({ size: 2.2, sizeAttenuation: false, vertexColors: true }),
    );
    this.cloud.frustumCulled = false;
    this.group.add(this.cloud);
  }

  /** @param moving names of objects */
  update(lidar: Lidar | null, moving: ReadonlySet<string>): void {
    this.count = lidar?.scans.reduce((sum, scan) => sum + scan.points.shape[0], 0) ?? 0;
    const places = new Float32Array(3 * this.count);
    const colors = new Float32Array(3 * this.count);
    const [still, other] = [new Color(SKY), new Color(ORANGE)];
    const moves = lidar?.object_names.map((name) => moving.has(name)) ?? [];
    let at = 0;
    for (const scan of lidar?.scans ?? []) {
      const points = numbers(scan.points);
      const objects = numbers(scan.object);
      const turn = [...scan.orientation] as Quaternion;
      for (let i = 0; i < scan.points.shape[0]; i++, at += 3) {
        const turned = rotate(turn, [points[3 * i], points[3 * i + 1], points[3 * i + 2]]);
        for (let k = 0; k < 3; k++) places[at + k] = turned[k] + scan.position[k] - this.origin[k];
        const color = moves[objects[i]] ? other : still;
        colors[at] = color.r;
        colors[at + 1] = color.g;
        colors[at + 2] = color.b;
      }
    }
    this.cloud.geometry.dispose();
    this.cloud.geometry = new BufferGeometry();
    this.cloud.geometry.setAttribute("position", new BufferAttribute(places, 3));
    this.cloud.geometry.setAttribute("color", new BufferAttribute(colors, 3));
  }
}
