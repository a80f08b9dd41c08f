// The library: worlds and agents of CAVIAR runs in JavaScript and TypeScript, for Node and browsers.
export { Agent } from "./agent.mjs";
export { NumericArray } from "./arrays.mjs";
export {
  ENGINES,
  EngineAxes,
  GODOT,
  multiply,
  NED,
  quaternion,
  THREE,
  THREE_MODEL,
  UNITY,
  UNREAL,
  wxyz,
  xyzw,
} from "./axes.mjs";
export { CaviarError, ProtocolError, RunError, SceneError } from "./errors.mjs";
export { main } from "./main.mjs";
export { Observer } from "./observer.mjs";
export { generator } from "./random.mjs";
export { cos, sin } from "./trigonometry.mjs";
export { decodePayload, encodePayload } from "./topics.mjs";
export { World } from "./world.mjs";

/**
 * @typedef {import("./types.d.ts").Action} Action
 * @typedef {import("./types.d.ts").Channel} Channel
 * @typedef {import("./types.d.ts").Command} Command
 * @typedef {import("./types.d.ts").Input} Input
 * @typedef {import("./types.d.ts").Lidar} Lidar
 * @typedef {import("./types.d.ts").Link} Link
 * @typedef {import("./types.d.ts").Observation} Observation
 * @typedef {import("./types.d.ts").RunInfo} RunInfo
 * @typedef {import("./types.d.ts").Scene} Scene
 * @typedef {import("./types.d.ts").SceneObject} SceneObject
 */
