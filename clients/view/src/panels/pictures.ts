// Pictures of cameras in a corner: colours, depths, and what was recognised.
import { cividis, KINDS, ORDERS, rgb, type Rgb } from "../colors";
import { numbers } from "../decode";
import { el, fixed } from "../dom";
import type { Frame } from "../frames";
import { PICTURES, type PictureTopic, type Store, type ViewState } from "../state";
import type { About } from "../types";
import type { NumericArray } from "../../../js/src/arrays.mjs";

interface Picture {
  key: string;
  title: string;
  pixels: ImageData;
}

export class Pictures {
  private readonly list = el("div", { class: "list" });
  private readonly tabs = new Map<PictureTopic, HTMLButtonElement>();
  readonly element: HTMLElement;
  private readonly shown = new Map<string, { figure: HTMLElement; canvas: HTMLCanvasElement; caption: HTMLElement }>();

  constructor(
    private readonly store: Store,
    about: About,
  ) {
    for (const topic of PICTURES.filter((topic) => about.topics[topic]?.length)) {
      this.tabs.set(topic, el("button", { type: "button", click: () => store.set({ pics: topic }) }, topic));
    }
    this.element = el(
      "div",
      { class: "pictures", role: "group", "aria-label": "Pictures of cameras", hidden: true },
      this.tabs.size > 1 && el("div", { class: "tabs" }, ...this.tabs.values()),
      this.list,
    );
  }

  /** Topic that a state shows; null: the run has no pictures. */
  topic({ pics }: ViewState): PictureTopic | null {
    const [first] = this.tabs.keys();
    return pics && this.tabs.has(pics) ? pics : (first ?? null);
  }

  update(frame: Frame | null, state: ViewState): void {
    const pictures = frame && state.layers.has("pictures") ? picturesOf(frame) : [];
    this.element.hidden = !pictures.length;
    for (const [topic, tab] of this.tabs) tab.setAttribute("aria-pressed", String(topic === this.topic(state)));
    this.list.classList.toggle("many", pictures.length > 4);
    for (const [key, { figure }] of this.shown) {
      if (pictures.some((picture) => picture.key === key)) continue;
      figure.remove();
      this.shown.delete(key);
    }
    for (const { key, title, pixels } of pictures) {
      let shown = this.shown.get(key);
      if (!shown) {
        const canvas = el("canvas", { role: "img" });
        const caption = el("figcaption", {});
        const sensor = key.split("|")[1];
        const open = el("button", { type: "button", title: `Select ${sensor}`, click: () => this.store.set({ sel: sensor }) }, canvas);
        const figure = el("figure", {}, open, caption);
        shown = { figure, canvas, caption };
        this.shown.set(key, shown);
        this.list.append(figure);
      }
      shown.canvas.width = pixels.width;
      shown.canvas.height = pixels.height;
      shown.canvas.setAttribute("aria-label", title);
      shown.caption.textContent = title;
      shown.canvas.getContext("2d")?.putImageData(pixels, 0, 0);
    }
  }
}

function picturesOf({ products }: Frame): Picture[] {
  const found: Picture[] = [];
  for (const { source, payload } of products.camera ?? []) {
    for (const { sensor, rgb: array } of payload.images) {
      const data = numbers(array);
      found.push(picture("camera", source, sensor, array, (i) => [data[3 * i] / 255, data[3 * i + 1] / 255, data[3 * i + 2] / 255]));
    }
  }
  for (const { source, payload } of products.depth ?? []) {
    for (const { sensor, depth } of payload.images) {
      const data = numbers(depth);
      let most = 0;
      for (let i = 0; i < data.length; i++) most = Math.max(most, data[i]);
      // Near is bright; 0 is no hit. The root spreads what is near.
      const made = picture("depth", source, sensor, depth, (i) => (data[i] > 0 ? cividis(1 - Math.sqrt(data[i] / most)) : [0, 0, 0]));
      found.push({ ...made, title: `${sensor}, depth to ${fixed(most, 0)} m` });
    }
  }
  for (const { source, payload } of products.segmentation ?? []) {
    for (const { sensor, object } of payload.images) {
      const data = numbers(object);
      found.push(picture("segmentation", source, sensor, object, (i) => segment(data[i])));
    }
  }
  return found;
}

const CATEGORIES: Rgb[] = [...ORDERS, ...KINDS.map(({ color }) => color)].map(rgb);

/** Colour of an object by its number: neighbours differ in colour or brightness. */
function segment(index: number): Rgb {
  if (index < 0) return [0.8, 0.88, 0.95];
  const shade = 1 - 0.18 * (Math.floor(index / 6) % 4);
  return CATEGORIES[index % 6].map((value) => value * shade) as Rgb;
}

function picture(topic: string, source: string, sensor: string, array: NumericArray, color: (i: number) => Rgb): Picture {
  const [height, width] = array.shape;
  const pixels = new ImageData(width, height);
  for (let i = 0; i < width * height; i++) {
    const [red, green, blue] = color(i);
    pixels.data.set([255 * red, 255 * green, 255 * blue, 255], 4 * i);
  }
  return { key: `${topic}|${sensor}|${source}`, title: topic === "camera" ? sensor : `${sensor}, ${topic}`, pixels };
}
