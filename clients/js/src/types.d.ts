// Public types: what a world gives, what it is given, and what decoded payloads hold. Names and units are
// those of protocol/SPEC.md; coordinates are metres, x east, y north, z up; body axes x forward, y left, z
// up.
import type { NumericArray } from "./arrays.mjs";

/** x, y, z. */
export type Vector3 = readonly [number, number, number] | readonly number[];
/** w, x, y, z: rotates body axes into world axes. */
export type Quaternion = readonly [number, number, number, number] | readonly number[];

/** One object of a world at one instant. */
export interface SceneObject {
  /** Begins with one of the world's prefixes. */
  name: string;
  /** `car`, `truck`, `bus`, `uav`, `pedestrian`, … */
  class: string;
  /** Centre of its bounding box [m]. */
  position: Vector3;
  /** Unit quaternion; level and to the east where it is left out. */
  orientation?: Quaternion;
  /** [m/s], world axes. Doppler shifts follow from it. */
  velocity: Vector3;
  /** [rad/s], world axes; left out: it does not turn, or how is not known. */
  angular_velocity?: Vector3;
  /** Length (x), width (y), height (z) of its bounding box [m]. */
  dimensions: Vector3;
  /** Name of a mesh of `offerMesh`; empty or left out: the box itself. */
  mesh?: string;
}

/** What `offerMesh` returns: two fields of a `SceneObject`, and where the mesh's box was. */
export interface OfferedMesh {
  /** Empty where it was refused: its objects are boxes. */
  mesh: string;
  dimensions: [number, number, number];
  /** Centre of the mesh's bounding box in its own coordinates [m]. */
  centre: [number, number, number];
}

/** A mesh of the static scenery. */
export interface SceneryMesh {
  /** Its name in `object_names` of products. */
  name: string;
  /** x, y, z of each vertex [m], as triples or one after the other. */
  vertices: ArrayLike<number> | readonly Vector3[];
  /** Three indices of each triangle, counter-clockwise seen from outside. */
  triangles: ArrayLike<number> | readonly Vector3[];
  /** A key of the materials. */
  material: string;
}

/** A radio material of Recommendation ITU-R P.2040. */
export interface Material {
  /** `concrete`, `glass`, `metal`, `brick`, `wood`, … */
  type: string;
  /** [m] */
  thickness?: number;
}

/** What a service knows of the run that it takes part in. */
export interface RunInfo {
  /** Id of the run. */
  run: string;
  seed: bigint;
  /** `[services.NAME.settings]` of the scenario. */
  settings: Record<string, any>;
  /** Carriers, devices, episodes, frames, as in WELCOME. */
  scenario: Record<string, any>;
  /** Devices of the scenario; a world gets its own. */
  devices: Record<string, any>[];
  /** [s] from frame to frame. */
  samplingPeriod: number;
}

export interface BeamChoice {
  type: "beam";
  tx: string;
  rx: string;
  tx_beam: number;
  rx_beam?: number;
  carrier?: string;
}
export interface WaypointCommand {
  type: "waypoint";
  object: string;
  position: Vector3;
  speed: number;
  at_once?: boolean;
  /** Since 1.6: heading to turn to and to keep [rad]; left out: along the course. */
  yaw?: number;
}
export interface VelocityCommand {
  type: "velocity";
  object: string;
  velocity: Vector3;
  /** Since 1.6: heading to turn to and to keep [rad]; left out: along the course. */
  yaw?: number;
  /** Since 1.6: with which the heading turns [rad/s], where `yaw` is left out. */
  yaw_rate?: number;
}
export interface UserSchedule {
  type: "schedule";
  tx: string;
  rx: string;
}
/** Since 1.6: fly along straight lines between points. */
export interface PathCommand {
  type: "path";
  object: string;
  points: Vector3[];
  speed: number;
}
/** Since 1.6: an attitude (w, x, y, z) and a thrust over the mass [m/s²]. */
export interface AttitudeCommand {
  type: "attitude";
  object: string;
  orientation: [number, number, number, number];
  thrust: number;
}
/** Since 1.6: drive a vehicle on its network of roads. */
export interface DriveCommand {
  type: "drive";
  object: string;
  speed?: number;
  lane?: number;
  route?: string[];
  stop?: { road: string; position: number; duration: number; lane?: number };
}
/** Since 1.6: switch traffic lights to a phase of their program. */
export interface SignalCommand {
  type: "signal";
  signal: string;
  phase: number;
  duration?: number;
}
export type Command =
  | BeamChoice
  | WaypointCommand
  | VelocityCommand
  | UserSchedule
  | PathCommand
  | AttitudeCommand
  | DriveCommand
  | SignalCommand;

/** One declared input. */
export interface InputDeclaration {
  topic: keyof Payloads;
  /** 0: of the same frame, 1: of the one before. */
  lag?: 0 | 1;
  /** Without a required input the service is not granted the frame. */
  required?: boolean;
  /** `h`, `hf`, `taps` of a channel, `grid` of a LIDAR, … */
  parts?: string[];
}

/** One input of a frame. */
export type Input = {
  [T in keyof Payloads]: {
    topic: T;
    source: string;
    status: "fresh" | "held" | "absent" | "late";
    frame: number;
    age: number;
    fidelity: string;
    cause: string;
    digest: string;
    /** Undefined where it is absent. */
    payload: Payloads[T] | undefined;
  };
}[keyof Payloads];

/** A product of a frame, as an observer sees it; its payload is decoded at the first look. */
export type ObservedProduct = Input & { readonly header: Uint8Array; readonly body: Uint8Array };

/** The newest finished frame of a run, or another state of it. */
export interface Observation {
  episode: number;
  /** −1: none is finished yet. */
  frame: number;
  /** Time of the frame [s]. */
  t: number;
  /** `joining`, `preparing`, `resetting`, `running` or `stopping`. */
  state: string;
  paused: boolean;
  /** Provenance of what subscriptions ask for; of what is absent, too. */
  inputs: Omit<Input, "payload">[];
  /** What services reported of the frame: `source`, `decisions`, `measured`, `counts`. */
  reports: Record<string, any>[];
  /** Those that are there; none where only the state is news. */
  products: ObservedProduct[];
}

/** What an observer wants to see, of what the run has anyway. */
export interface Subscription {
  /** Or `*`. */
  topic: keyof Payloads | "*";
  /** Service; any where it is left out. */
  source?: string;
  /** Frames from one to the next at least; 1 by default. */
  every?: number;
}

export interface ObserverOptions {
  /** Unique in the run; with a token, the token's. */
  name?: string;
  /** Everything by default. */
  subscriptions?: Subscription[];
  /** Of the role `observer`, where the broker has tokens. */
  token?: string;
  /** [s] from one observation to the next at least. */
  period?: number;
}

/** How the library says what happens: one line of text each. */
export type Log = (line: string) => void;

export interface RunOptions {
  /** Of the broker's tokens, where it has any. */
  token?: string;
  /** [s] to wait for a broker that is not there yet; 120 by default. */
  patience?: number;
  log?: Log;
}

export interface AntennaArray {
  rows: number;
  columns: number;
  vertical_spacing: number;
  horizontal_spacing: number;
  pattern: string;
  polarization: string;
  pattern_file: string;
  panels: { position_m: Vector3; yaw_deg: number; pitch_deg: number; roll_deg: number }[];
  codebook: string;
}
interface Mounted {
  name: string;
  parent: string;
  position: Vector3;
  orientation: Quaternion;
}
export interface AntennaDevice extends Mounted {
  type: "antenna";
  role: "tx" | "rx" | "both";
  array: AntennaArray;
  power_dbm: number;
  carriers: string[];
}
export interface LidarDevice extends Mounted {
  type: "lidar";
  beams: number;
  azimuth_steps: number;
  elevation_min: number;
  elevation_max: number;
  max_range: number;
  min_range: number;
}
export interface CameraDevice extends Mounted {
  type: "camera";
  width: number;
  height: number;
  field_of_view: number;
}
export type Device = AntennaDevice | LidarDevice | CameraDevice;

export interface Scene {
  names: string[];
  classes: string[];
  assets: string[];
  position: NumericArray;
  orientation: NumericArray;
  velocity: NumericArray;
  dimensions: NumericArray;
  devices?: Device[];
  angular_velocity?: NumericArray;
}

export interface Carrier {
  name: string;
  frequency_hz: number;
  bandwidth_hz: number;
  subcarriers: number;
  subcarrier_spacing_hz: number;
  taps: number;
  slots: number;
  slot_duration_s: number;
}
export interface ChannelEntry {
  carrier: number;
  tx: number;
  rx: number;
  h: NumericArray;
}
export interface Channel {
  rung: string;
  options: Record<string, any>;
  expected_error_db?: number;
  carriers: Carrier[];
  tx: string[];
  rx: string[];
  los: NumericArray;
  offsets: NumericArray;
  object_names: string[];
  id: NumericArray;
  a: NumericArray;
  tau: NumericArray;
  aod: NumericArray;
  aoa: NumericArray;
  doppler: NumericArray;
  interactions: NumericArray;
  points: NumericArray;
  objects: NumericArray;
  h: ChannelEntry[];
  dropped: number;
  hf: ChannelEntry[];
  taps: (ChannelEntry & { first: number })[];
  error_bound_db?: NumericArray;
  error_reference: string;
  used?: NumericArray;
}

interface Sensed {
  sensor: string;
  position: Vector3;
  orientation: Quaternion;
}
export interface LidarScan extends Sensed {
  ray: NumericArray;
  points: NumericArray;
  points_world?: NumericArray;
  range: NumericArray;
  object: NumericArray;
  grid?: { origin: Vector3; cell: Vector3; occupancy: NumericArray };
}
export interface Lidar {
  object_names: string[];
  scans: LidarScan[];
}
interface Image extends Sensed {
  intrinsics: { fx: number; fy: number; cx: number; cy: number };
}
export interface Camera {
  images: (Image & { rgb: NumericArray })[];
}
export interface Depth {
  images: (Image & { depth: NumericArray; normals?: NumericArray })[];
}
export interface Segmentation {
  object_names: string[];
  material_names: string[];
  images: (Image & { object: NumericArray; material?: NumericArray })[];
}
export interface Action {
  commands: Command[];
}
export interface Link {
  tx: string[];
  rx: string[];
  carrier: string[];
  has_path: NumericArray;
  los: NumericArray;
  tx_beam: NumericArray;
  rx_beam: NumericArray;
  abs_y: NumericArray;
  top_tx_beam: NumericArray;
  top_rx_beam: NumericArray;
  top_abs_y: NumericArray;
  baseline_abs_y: NumericArray;
  aod_azimuth: NumericArray;
  aoa_azimuth: NumericArray;
  snr: NumericArray;
  snr_best: NumericArray;
  spectral_efficiency: NumericArray;
  bit_rate: NumericArray;
  reward: NumericArray;
  buffered?: NumericArray;
  no_path: number;
  serving?: NumericArray;
  arrived?: NumericArray;
  sent?: NumericArray;
  dropped?: NumericArray;
  delivered?: NumericArray;
  delay?: NumericArray;
  waiting?: NumericArray;
  sinr?: NumericArray;
  throughput?: NumericArray;
  blocks?: NumericArray;
  block_errors?: NumericArray;
}

/** Decoded payload of each topic. */
export interface Payloads {
  scene: Scene;
  channel: Channel;
  lidar: Lidar;
  camera: Camera;
  depth: Depth;
  segmentation: Segmentation;
  action: Action;
  link: Link;
}
