// Answers of the server below `data/` (broker/caviar_view/answers.py), in the units that their names state.
import type { Payloads } from "../../js/src/types.d.ts";

export type Topic = keyof Payloads;
export type Vector = [number, number, number];

/** Consecutive frames: place `first + i` holds frame `first_frame + i` of the episode, for i < count. */
export interface Block {
  episode: number;
  first_frame: number;
  first: number;
  count: number;
}

export interface Service {
  name: string;
  role: string;
  budget_ms: number | null;
}

export interface MeshInfo {
  id: string;
  name: string;
  /** Index into `About.materials`. */
  material: number;
  kind: "terrain" | "building" | "foliage" | "other";
  triangles: number;
  /** Triangles before thinning. */
  of: number;
  /** Name of each piece, and its first triangle. */
  parts?: [string, number][];
}

export interface About {
  kind: "recording" | "run" | "scenario";
  live: boolean;
  name: string;
  run: string;
  seed: number;
  sampling_period_s: number;
  topics: Partial<Record<Topic, string[]>>;
  carriers: { name: string; frequency_hz: number; bandwidth_hz?: number }[];
  services: Service[];
  frames: Block[];
  complete: boolean;
  damage: string[];
  notes?: string[];
  controls: boolean;
  /** Only every so-many-th place is there. */
  every: number;
  beside: boolean;
  /** Whether there is `radio-map`. */
  radio_map?: boolean;
  /** sRGB from 0 to 1. */
  materials: { name: string; color: Vector }[];
  meshes: MeshInfo[];
  /** Mesh of each asset of `Scene.assets`. */
  assets: Record<string, string>;
  /** [m] */
  bounds: { low: Vector; high: Vector };
  georeference?: { latitude: number; longitude: number; height: number } | null;
}

export interface FrameInfo {
  n: number;
  episode: number;
  frame: number;
  t_ns: number;
  inputs: { topic: Topic; source: string; status: string; frame: number; cause?: string }[];
  decisions: Record<string, unknown>;
}

export interface Product<T extends Topic> {
  source: string;
  status: string;
  frame: number;
  /** Numbers that the server kept, and of how many. */
  kept: Partial<Record<"paths" | "points" | "pixels", [number, number]>>;
  payload: Payloads[T];
}

export interface Lobe {
  device: string;
  beam: number;
  /** Axis of the device that directions are counted around. */
  axis?: "y" | "z";
  /**
   * [rad]: around z counter-clockwise from +x, and from the xy plane; around y likewise from +z, and from the zx
   * plane.
   */
  azimuths: number[];
  elevations: number[];
  /** Amplitude, 1 at the greatest, Shape [elevations][azimuths]. */
  gain: number[][];
}

export interface User {
  tx: string;
  rx: string;
  carrier: string;
}

export interface Curves {
  user: User | null;
  users: User[];
  n: number[];
  series: Record<string, { unit: string; values: (number | null)[] }>;
}

export interface Lane {
  service: string;
  /** [ms] from the beginning of the frame; null where unknown. */
  start_ms: number | null;
  work_ms: number | null;
  end_ms: number | null;
  missed: boolean;
  held: boolean;
  absent: boolean;
}

export interface Clock {
  services: Service[];
  frames: { n: number; lanes: Lane[] }[];
  events?: { n: number; text: string }[];
}

export interface News {
  /** Place of the last frame, plus 1. */
  frames: number;
  /** Oldest place that is held. */
  first: number;
  state: string;
  paused: boolean;
  waits: { service: string; frame: number; elapsed_s: number; limit_s: number }[];
  /** Frames that came since the news before. */
  added: Block[];
  /** Why there are no more. */
  ended?: string;
  events?: (string | { n?: number; text: string })[];
}
