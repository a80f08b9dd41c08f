// What is drawn, how rays are coloured, whose beams are shown, and what colours mean.
import { BEST, CHOSEN, css, DIFFERENT, KINDS, ORANGE, ORDERS, SKY, viridis } from "../colors";
import { choice, el, fill, fixed } from "../dom";
import { type Coloring, COLORINGS, type Layer, LAYERS, type Mode, MODES, type Store, type ViewState } from "../state";
import type { About, User } from "../types";

export interface LayersInput {
  users: User[];
  user: User | null;
  range: [number, number];
  drawn: number;
  /** Of these, how many have a tick at either end. */
  ticks: number;
  /** Paths of the frame, and of how many the server kept these. */
  paths: number;
  of: number;
  points: [number, number] | null;
  gridSize: number;
  names: { objects: string[]; devices: string[] };
  /** What differs between two runs. */
  different: { objects: ReadonlySet<string>; receivers: ReadonlySet<string> } | null;
  absent: { topic: string; source: string; reason: string }[];
}

export const userKey = ({ tx, rx, carrier }: User): string => `${tx}|${rx}|${carrier}`;

export class LayersPanel {
  readonly element: HTMLElement;
  private readonly users = el("select", { "aria-label": "User whose beams are shown", id: "user" });
  private readonly selection = el("select", { "aria-label": "Selected object or device", id: "selection" });
  private readonly shown = new Map<string, HTMLInputElement>();
  private readonly coloring: HTMLSelectElement;
  private readonly mode: HTMLSelectElement;
  private readonly only = el("input", { type: "checkbox", id: "only" });
  private readonly slider = el("input", { type: "range", id: "threshold", step: 1, "aria-label": "Weakest path gain that is drawn" });
  private readonly threshold = el("output", { for: "threshold" });
  private readonly legend = el("div", { class: "legend" });
  private readonly counts = el("p", { class: "note" });
  private readonly absent = el("ul", { class: "absent" });
  private readonly gain: HTMLElement;
  private listed = "";

  constructor(
    store: Store,
    private readonly about: About,
  ) {
    const { state } = store;
    this.users.addEventListener("change", () => store.set({ user: this.users.value }));
    this.coloring = choice("Colour of rays", COLORINGS, state.color, (color: Coloring) => store.set({ color }));
    this.mode = choice("Camera", MODES, state.mode, (mode: Mode) => store.set({ mode }));
    this.selection.addEventListener("change", () => store.set({ sel: this.selection.value || null }));
    this.only.addEventListener("change", () => store.set({ rays: this.only.checked ? "user" : "all" }));
    this.slider.addEventListener("input", () => {
      const value = Number(this.slider.value);
      store.set({ min: value <= Number(this.slider.min) ? null : value });
    });
    this.gain = el("div", { class: "gain" }, this.slider, this.threshold);
    const needed: Partial<Record<Layer, (keyof About["topics"])[]>> = {
      rays: ["channel"],
      beams: ["link"],
      lidar: ["lidar"],
      pictures: ["camera", "depth", "segmentation"],
    };
    const there = (layer: string) => (layer !== "map" || !!about.radio_map) && (needed[layer as Layer]?.some((topic) => about.topics[topic]?.length) ?? true);
    const boxes = Object.entries(LAYERS).filter(([layer]) => there(layer)).map(([layer, text]) => {
      const box = el("input", { type: "checkbox", change: () => store.toggleLayer(layer as Layer) });
      this.shown.set(layer, box);
      return el("label", { class: "check" }, box, text);
    });
    const parts = about.topics;
    this.element = el(
      "aside",
      { class: "card left", "aria-label": "View" },
      el("div", { class: "field" }, el("span", {}, "Camera"), this.mode),
      el("div", { class: "field" }, el("label", { for: "selection" }, "Select"), this.selection),
      parts.link && el("div", { class: "field" }, el("label", { for: "user" }, "User"), this.users),
      parts.channel && el("div", { class: "field" }, el("span", {}, "Rays by"), this.coloring),
      parts.channel && el("label", { class: "check" }, this.only, "only those of the user"),
      this.legend,
      parts.channel && this.gain,
      this.counts,
      this.absent,
      el("details", { open: true }, el("summary", {}, "Layers"), el("div", { class: "checks" }, ...boxes)),
      el("details", {}, el("summary", {}, "Colours"), this.colors()),
    );
  }

  update(state: ViewState, input: LayersInput): void {
    this.element.hidden = !state.panel;
    for (const [layer, box] of this.shown) box.checked = state.layers.has(layer as Layer);
    this.coloring.value = state.color;
    this.mode.value = state.mode;
    this.only.checked = state.rays === "user";
    this.listUsers(input);
    this.listNames(state.sel, input);
    const [low, high] = input.range;
    this.slider.min = String(low);
    this.slider.max = String(high);
    this.slider.value = String(state.min ?? low);
    this.threshold.textContent = state.min === null ? "all paths" : `≥ ${fixed(state.min, 0)} dB`;
    this.slider.setAttribute("aria-valuetext", this.threshold.textContent);
    fill(this.legend, ...this.legendOf(state.color, input.range));
    const kept = input.of > input.paths ? `, the strongest of ${input.of}` : "";
    const points = input.points ? ` · ${input.points[0]} of ${input.points[1]} points` : "";
    const paths = this.about.topics.channel ? `${input.drawn} of ${input.paths} paths${kept}${points} · ` : "";
    const differ = input.different ? ` · ${input.different.objects.size} objects and the beams of ${input.different.receivers.size} receivers differ` : "";
    const unknown = input.ticks ? `${input.ticks} of unknown route have a tick at either end · ` : "";
    this.counts.textContent = `${paths}${unknown}grid ${input.gridSize} m${differ}`;
    fill(
      this.absent,
      ...input.absent.map(({ topic, source, reason }) =>
        el("li", {}, `${topic}${source ? ` of ${source}` : ""} absent: ${reason}`),
      ),
    );
  }

  private listUsers({ users, user }: LayersInput): void {
    const keys = users.map(userKey);
    if (keys.join("\n") !== this.listed) {
      this.listed = keys.join("\n");
      const carriers = new Set(users.map(({ carrier }) => carrier)).size > 1;
      fill(
        this.users,
        ...users.map((each) =>
          el("option", { value: userKey(each) }, `${each.tx} → ${each.rx}${carriers ? ` (${each.carrier})` : ""}`),
        ),
      );
    }
    if (user) this.users.value = userKey(user);
  }

  private listNames(selected: string | null, { names }: LayersInput): void {
    const key = `${names.objects.join("\n")}\n\n${names.devices.join("\n")}`;
    if (key !== this.named) {
      this.named = key;
      const group = (label: string, list: string[]) =>
        el("optgroup", { label }, ...list.map((name) => el("option", { value: name }, name)));
      fill(this.selection, el("option", { value: "" }, "nothing"), group("Objects", names.objects), group("Devices", names.devices));
    }
    // A path or a building is selected, and none of the list.
    this.selection.value = selected !== null && (names.objects.includes(selected) || names.devices.includes(selected)) ? selected : "";
  }
  private named = "";

  private legendOf(coloring: Coloring, [low, high]: [number, number]): HTMLElement[] {
    if (!this.about.topics.channel) return [];
    if (coloring === "order") {
      return ORDERS.map((color, i) => swatch(color, i === ORDERS.length - 1 ? `${i} and more` : String(i)));
    }
    if (coloring === "kind") return KINDS.map(({ name, color }) => swatch(color, name));
    const bar = el("canvas", { class: "ramp", width: 128, height: 1, role: "img", "aria-label": "Colours of path gain" });
    const context = bar.getContext("2d");
    for (let i = 0; context && i < 128; i++) {
      context.fillStyle = css(viridis(i / 127));
      context.fillRect(i, 0, 1, 1);
    }
    const middle = (low + high) / 2;
    const ends = el("div", { class: "ends" }, el("span", {}, fixed(low, 0)), el("span", {}, fixed(middle, 0)), el("span", {}, `${fixed(high, 0)} dB`));
    return [bar, ends];
  }

  private colors(): HTMLElement {
    const list = el(
      "div",
      { class: "swatches" },
      swatch(ORANGE, "object with a device"),
      swatch(SKY, "other object"),
      this.about.topics.link && swatch(CHOSEN, "chosen beam"),
      this.about.topics.link && swatch(BEST, "best beam"),
      this.about.beside && swatch(DIFFERENT, "differs between the runs"),
    );
    for (const name of new Set(this.about.materials.map((material) => material.name))) {
      const material = this.about.materials.find((each) => each.name === name);
      if (material) list.append(swatch(css(material.color), name));
    }
    return list;
  }
}

function swatch(color: string, text: string): HTMLElement {
  const square = el("span", { class: "square" });
  // A property and no attribute: the page's policy refuses styles in markup.
  square.style.backgroundColor = color;
  return el("div", { class: "swatch" }, square, text);
}
