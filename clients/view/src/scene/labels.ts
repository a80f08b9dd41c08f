// Names over the picture: elements that follow places, left out where they would cover one another.
import { type Camera, Vector3 } from "three";
import { el } from "../dom";

export interface Label {
  text: string;
  /** In the scene. */
  at: Vector3;
  /** The greater stands, where two do not fit. */
  rank: number;
  marked: boolean;
}

/** Names that are shown at once: more cannot be read. */
const MOST = 40;
const HEIGHT = 18;

export class Labels {
  readonly element = el("div", { class: "labels", "aria-hidden": "true" });
  private readonly pool: HTMLElement[] = [];
  private readonly place = new Vector3();

  /** Put names into a part of the picture, from `left` on and so wide [px]. */
  draw(labels: Label[], camera: Camera, left: number, width: number, height: number, used: number): number {
    const taken: [number, number, number, number][] = [];
    for (const label of [...labels].sort((a, b) => b.rank - a.rank)) {
      if (taken.length >= MOST) break;
      this.place.copy(label.at).project(camera);
      const { x, y, z } = this.place;
      if (z < -1 || z > 1 || Math.abs(x) > 1 || Math.abs(y) > 1) continue;
      // An estimate: measuring each name would lay out the page anew.
      const wide = 6.4 * label.text.length + 12;
      const centre = left + ((x + 1) / 2) * width;
      const bottom = ((1 - y) / 2) * height - 8;
      const box: [number, number, number, number] = [centre - wide / 2, bottom - HEIGHT, centre + wide / 2, bottom];
      if (box[0] < left || box[2] > left + width || box[1] < 0) continue;
      if (taken.some((other) => box[0] < other[2] && other[0] < box[2] && box[1] < other[3] && other[1] < box[3])) continue;
      taken.push(box);
      const element = this.pooled(used++);
      element.textContent = label.text;
      element.className = label.marked ? "label marked" : "label";
      element.style.transform = `translate(${Math.round(centre)}px, ${Math.round(bottom)}px) translate(-50%, -100%)`;
      element.hidden = false;
    }
    return used;
  }

  /** Hide the elements that are not used. */
  finish(used: number): void {
    for (let i = used; i < this.pool.length; i++) this.pool[i].hidden = true;
  }

  private pooled(index: number): HTMLElement {
    let element = this.pool[index];
    if (!element) {
      element = el("div", { class: "label" });
      this.pool.push(element);
      this.element.append(element);
    }
    return element;
  }
}
