// What the reader looks at. It stands in the fragment of the address, so that a link shows the same view.
import type { Vector } from "./types";

export const LAYERS = {
  buildings: "Buildings",
  terrain: "Terrain",
  objects: "Objects",
  names: "Names",
  trails: "Trails",
  devices: "Devices",
  rays: "Rays",
  beams: "Beams",
  lidar: "LIDAR",
  map: "Radio map",
  frusta: "Frusta",
  pictures: "Pictures",
  grid: "Grid",
} as const;
export type Layer = keyof typeof LAYERS;
const ALL = Object.keys(LAYERS) as Layer[];
/** Off at first: a scan of 20,000 points is the largest answer of a frame. */
const DEFAULT_LAYERS: readonly Layer[] = ALL.filter((layer) => layer !== "lidar");

export const COLORINGS = { gain: "Path gain", order: "Number of interactions", kind: "Kind of interaction" } as const;
export type Coloring = keyof typeof COLORINGS;
export const MODES = { free: "Free", follow: "Follow", board: "On board" } as const;
export type Mode = keyof typeof MODES;
export const DOCKS = { none: "None", clock: "Clock", curves: "Curves" } as const;
export type Dock = keyof typeof DOCKS;
export const PICTURES = ["camera", "depth", "segmentation"] as const;
export type PictureTopic = (typeof PICTURES)[number];
export const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10] as const;

export interface ViewState {
  /** Place; null: the first one, or the newest of a live run. */
  n: number | null;
  /** `tx|rx|carrier` of the user whose beams are shown; null: the first. */
  user: string | null;
  /** Name of the object or device, or key of the path or mesh, that is selected. */
  sel: string | null;
  /** Camera [m, world axes]; null: chosen from the scene. */
  cam: { position: Vector; target: Vector } | null;
  mode: Mode;
  color: Coloring;
  /** Weakest path gain that is drawn [dB]; null: all. */
  min: number | null;
  /** Rays of all pairs, or of the user alone. */
  rays: "all" | "user";
  layers: ReadonlySet<Layer>;
  /** Topic of the pictures in the corner; null: the first that there is. */
  pics: PictureTopic | null;
  dock: Dock;
  /** Whether the panel with layers and colours is there. */
  panel: boolean;
  speed: number;
  loop: boolean;
  theme: "auto" | "light" | "dark";
  /** Shadows and smooth edges: as the machine can, or in any case. */
  quality: "auto" | "fine" | "plain";
}

export const INITIAL: Readonly<ViewState> = {
  n: null,
  user: null,
  sel: null,
  cam: null,
  mode: "free",
  color: "gain",
  min: null,
  rays: "all",
  layers: new Set(DEFAULT_LAYERS),
  pics: null,
  dock: "none",
  panel: true,
  speed: 1,
  loop: false,
  theme: "auto",
  quality: "auto",
};

/** Write what differs from the initial view as a fragment, without `#`. */
export function toFragment(state: ViewState): string {
  const parts: [string, string][] = [];
  const put = (name: string, value: string | number | null, initial: unknown) => {
    if (value !== null && value !== initial) parts.push([name, String(value)]);
  };
  put("n", state.n, INITIAL.n);
  put("user", state.user, INITIAL.user);
  if (state.cam) {
    const { position, target } = state.cam;
    parts.push(["cam", [...position, ...target].map((value) => Number(value.toFixed(2))).join(",")]);
  }
  put("mode", state.mode, INITIAL.mode);
  put("sel", state.sel, INITIAL.sel);
  put("color", state.color, INITIAL.color);
  put("min", state.min, INITIAL.min);
  put("rays", state.rays, INITIAL.rays);
  const layers = ALL.filter((layer) => state.layers.has(layer)).join(",");
  put("layers", layers, DEFAULT_LAYERS.join(","));
  put("pics", state.pics, INITIAL.pics);
  put("dock", state.dock, INITIAL.dock);
  put("panel", state.panel ? 1 : 0, 1);
  put("speed", state.speed, INITIAL.speed);
  put("loop", state.loop ? 1 : 0, 0);
  put("theme", state.theme, INITIAL.theme);
  put("quality", state.quality, INITIAL.quality);
  // Commas, slashes and colons stay readable: a fragment may hold them.
  const coded = (text: string) => encodeURIComponent(text).replace(/%(2C|2F|3A)/g, decodeURIComponent);
  return parts.map(([name, value]) => `${name}=${coded(value)}`).join("&");
}

/** Read a fragment; what is missing or cannot be read is as in the initial view. */
export function fromFragment(fragment: string): ViewState {
  const given = new Map<string, string>();
  for (const part of fragment.replace(/^#/, "").split("&")) {
    const [name, ...rest] = part.split("=");
    try {
      given.set(name, decodeURIComponent(rest.join("=")));
    } catch {
      // A link that was cut within an escape: the rest of it counts.
    }
  }
  const number = (name: string) => {
    const text = given.get(name);
    return text === undefined || text.trim() === "" || !Number.isFinite(Number(text)) ? null : Number(text);
  };
  const one = <T extends string>(name: string, values: readonly T[], initial: T) =>
    values.find((value) => value === given.get(name)) ?? initial;
  const place = number("n");
  const cam = given.get("cam")?.split(",").map(Number);
  const layers = given.get("layers")?.split(",");
  const speed = number("speed");
  return {
    n: place !== null && place >= 0 ? Math.floor(place) : null,
    user: given.get("user") ?? null,
    sel: given.get("sel") ?? null,
    cam:
      cam?.length === 6 && cam.every(Number.isFinite)
        ? { position: cam.slice(0, 3) as Vector, target: cam.slice(3) as Vector }
        : null,
    mode: one("mode", Object.keys(MODES) as Mode[], INITIAL.mode),
    color: one("color", Object.keys(COLORINGS) as Coloring[], INITIAL.color),
    min: number("min"),
    rays: one("rays", ["all", "user"], INITIAL.rays),
    layers: layers ? new Set(ALL.filter((layer) => layers.includes(layer))) : INITIAL.layers,
    pics: PICTURES.find((topic) => topic === given.get("pics")) ?? null,
    dock: one("dock", Object.keys(DOCKS) as Dock[], INITIAL.dock),
    panel: given.get("panel") !== "0",
    speed: SPEEDS.find((value) => value === speed) ?? INITIAL.speed,
    loop: given.get("loop") === "1",
    theme: one("theme", ["auto", "light", "dark"], INITIAL.theme),
    quality: one("quality", ["auto", "fine", "plain"], INITIAL.quality),
  };
}

export type Changed = ReadonlySet<keyof ViewState>;

/** The state, and who hears of its changes. */
export class Store {
  private readonly listeners: ((state: ViewState, changed: Changed) => void)[] = [];

  constructor(private current: ViewState) {}

  get state(): Readonly<ViewState> {
    return this.current;
  }

  /** Change some of it; listeners hear of what differs. */
  set(patch: Partial<ViewState>): void {
    const names = Object.keys(patch) as (keyof ViewState)[];
    const changed = new Set(names.filter((name) => patch[name] !== this.current[name]));
    if (!changed.size) return;
    this.current = { ...this.current, ...patch };
    for (const listener of this.listeners) listener(this.current, changed);
  }

  listen(listener: (state: ViewState, changed: Changed) => void): void {
    this.listeners.push(listener);
  }

  toggleLayer(layer: Layer): void {
    const layers = new Set(this.current.layers);
    if (!layers.delete(layer)) layers.add(layer);
    this.set({ layers });
  }
}
