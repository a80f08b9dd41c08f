// Numbers of what was clicked, with their units.
import { button, degrees, el, fill, fixed, si } from "../dom";
import { numbers } from "../decode";
import { first, type Frame } from "../frames";
import { KINDS } from "../colors";
import { angles, row } from "../scene/pose";
import { direction, type Path } from "../scene/rays";
import type { RunView } from "../scene/view";
import type { MeshInfo, Vector } from "../types";
import { userKey } from "./layers";

type Row = [label: string, value: string];
type Section = { title: string; rows: Row[] };

const metres = (place: ArrayLike<number>) => Array.from(place, (value) => fixed(value, 2)).join(", ") + " m";

export class Inspector {
  readonly element: HTMLElement;
  private readonly title = el("h2", {});
  private readonly body = el("div", { class: "rows" });

  constructor(onClose: () => void) {
    this.element = el(
      "aside",
      { class: "card right", "aria-label": "Selection", hidden: true },
      el("div", { class: "head" }, this.title, button("close", "Clear the selection (Escape)", onClose)),
      this.body,
    );
  }

  /** Show what the selection is in this frame. */
  update(selected: string | null, view: RunView, frame: Frame | null): void {
    this.element.hidden = selected === null;
    if (selected === null) return;
    this.title.textContent = selected;
    const sections = describe(selected, view, frame);
    fill(
      this.body,
      ...(sections.length ? sections : [{ title: "", rows: [["", "not in this frame"]] as Row[] }]).map(sectionElement),
    );
  }
}

function sectionElement({ title, rows }: Section): HTMLElement {
  return el(
    "section",
    {},
    title ? el("h3", {}, title) : null,
    el("dl", {}, ...rows.flatMap(([label, value]) => [el("dt", {}, label), el("dd", {}, value)])),
  );
}

/** All that is known of a name in a frame: of an object, a device, a path or a piece of scenery. */
export function describe(selected: string, view: RunView, frame: Frame | null): Section[] {
  if (view.objects.shown.has(selected)) return describeObject(selected, view, frame);
  if (view.devices.shown.has(selected)) return describeDevice(selected, view, frame);
  const path = view.rays.paths.find(({ key }) => key === selected);
  if (path) return describePath(path, frame);
  const piece = selected.startsWith("mesh ") ? selected.slice(5) : null;
  const info = view.about.meshes.find(({ name, parts }) => name === piece || parts?.some(([part]) => part === piece));
  return info && piece ? [describePiece(info, view)] : [];
}

function describeObject(name: string, view: RunView, frame: Frame | null): Section[] {
  const scene = first(frame, "scene");
  const i = scene?.names.indexOf(name) ?? -1;
  if (!scene || i < 0) return [];
  const velocity = row(scene.velocity, i, 3);
  const { yaw, pitch, roll } = angles(row(scene.orientation, i, 4) as [number, number, number, number]);
  const [length, width, height] = row(scene.dimensions, i, 3);
  const rows: Row[] = [
    ["class", scene.classes[i]],
    ["position", metres(row(scene.position, i, 3))],
    ["speed", `${fixed(Math.hypot(...velocity), 2)} m/s`],
    ["velocity", Array.from(velocity, (v) => fixed(v, 2)).join(", ") + " m/s"],
    ["heading", `${fixed(degrees(yaw), 1)}° from east`],
    ["pitch, roll", `${fixed(degrees(pitch), 1)}°, ${fixed(degrees(roll), 1)}°`],
    ["size", `${fixed(length, 2)} × ${fixed(width, 2)} × ${fixed(height, 2)} m`],
    ["mesh", scene.assets[i] || "box"],
  ];
  const place = geographic(view, row(scene.position, i, 3) as Vector);
  if (place) rows.splice(2, 0, ["place", place]);
  const devices = scene.devices?.filter(({ parent }) => parent === name) ?? [];
  if (devices.length) rows.push(["devices", devices.map((device) => device.name).join(", ")]);
  return [{ title: "", rows }, ...devices.flatMap((device) => linkSections(device.name, frame))];
}

function describeDevice(name: string, view: RunView, frame: Frame | null): Section[] {
  const shown = view.devices.shown.get(name);
  if (!shown) return [];
  const { device, pose } = shown;
  const { yaw, pitch, roll } = angles(pose.orientation);
  const rows: Row[] = [
    ["device", device.type],
    ["mounted on", device.parent || "the world"],
    ["position", metres(pose.position)],
    ["azimuth", `${fixed(degrees(yaw), 1)}°`],
    ["elevation, roll", `${fixed(degrees(pitch), 1)}°, ${fixed(degrees(roll), 1)}°`],
  ];
  if (device.type === "antenna") {
    const { array } = device;
    rows.push(
      ["role", { tx: "transmitter", rx: "receiver", both: "both" }[device.role]],
      ["array", `${array.rows} × ${array.columns} (rows × columns)`],
      ["spacing", `${array.vertical_spacing} × ${array.horizontal_spacing} λ`],
      ["pattern", array.pattern_file || array.pattern],
      ["polarization", array.polarization],
      ["codebook", array.codebook],
    );
    if (array.panels.length) rows.push(["panels", String(array.panels.length)]);
    if (device.role !== "rx") rows.push(["power", `${fixed(device.power_dbm, 1)} dBm`]);
    rows.push(["carriers", carriers(view, device.carriers)]);
  } else if (device.type === "lidar") {
    rows.push(
      ["beams", `${device.beams} × ${device.azimuth_steps}`],
      ["elevation", `${fixed(degrees(device.elevation_min), 1)}° to ${fixed(degrees(device.elevation_max), 1)}°`],
      ["range", `${device.min_range} to ${device.max_range} m`],
    );
  } else {
    rows.push(
      ["picture", `${device.width} × ${device.height} px`],
      ["field of view", `${fixed(degrees(device.field_of_view), 1)}°`],
    );
  }
  return [{ title: "", rows }, ...linkSections(name, frame)];
}

function carriers(view: RunView, names: string[]): string {
  return view.about.carriers
    .filter(({ name }) => !names.length || names.includes(name))
    .map(({ name, frequency_hz }) => `${name} (${si(frequency_hz, "Hz")})`)
    .join(", ");
}

/** What the communication system did for the users of a device. */
function linkSections(device: string, frame: Frame | null): Section[] {
  const link = first(frame, "link");
  if (!link) return [];
  return link.tx.flatMap((tx, i) => {
    if (tx !== device && link.rx[i] !== device) return [];
    if (link.rx[i] !== device && link.tx.length > 12) return [];
    const value = (array: Parameters<typeof numbers>[0] | undefined) => (array ? numbers(array)[i] : undefined);
    const beams = (t: number, r: number) => (t < 0 ? "none" : `${t} (TX), ${r} (RX)`);
    const ranks = link.top_tx_beam.shape[1];
    const decibels = (ratio: number | undefined) => si(ratio ? 10 * Math.log10(ratio) : null, "dB");
    const rows: Row[] = [
      ["line of sight", link.los.at(i) ? "free" : link.has_path.at(i) ? "blocked" : "no path"],
      ["chosen beams", beams(Number(value(link.tx_beam)), Number(value(link.rx_beam)))],
    ];
    if (ranks) {
      const best = (array: typeof link.top_tx_beam) => numbers(array)[i * ranks];
      rows.push(["best beams", beams(best(link.top_tx_beam), best(link.top_rx_beam))]);
      rows.push(["|y|, of best", `${si(value(link.abs_y), "1")} of ${si(best(link.top_abs_y), "1")}`]);
    }
    rows.push(["SNR, of best", `${decibels(value(link.snr))} of ${decibels(value(link.snr_best))}`]);
    if (link.sinr) rows.push(["SINR", decibels(value(link.sinr))]);
    rows.push(["spectral efficiency", `${si(value(link.spectral_efficiency), "1")} bit/s/Hz`]);
    rows.push(["bit rate", si(value(link.bit_rate), "bit/s")]);
    if (link.throughput) rows.push(["throughput", si(value(link.throughput), "bit/s")]);
    if (link.buffered) rows.push(["buffered", si(value(link.buffered), "bit")]);
    if (link.delay) rows.push(["delay", si(value(link.delay), "s")]);
    rows.push(["reward", si(value(link.reward), "1")]);
    return [{ title: userKey({ tx, rx: link.rx[i], carrier: link.carrier[i] }).replace("|", " → ").replace("|", " on "), rows }];
  });
}

function describePath(path: Path, frame: Frame | null): Section[] {
  const channel = first(frame, "channel");
  if (!channel) return [];
  const { index } = path;
  const angle = (array: typeof channel.aod) => {
    const [zenith, azimuth] = row(array, index, 2);
    const [x, y, z] = direction(zenith, azimuth);
    return `azimuth ${fixed(degrees(Math.atan2(y, x)), 1)}°, elevation ${fixed(degrees(Math.asin(z)), 1)}°`;
  };
  const delay = numbers(channel.tau)[index];
  const depth = channel.interactions.shape[1];
  const doppler = channel.carriers.map((_, c) => `${fixed(numbers(channel.doppler)[c * channel.tau.shape[0] + index], 1)} Hz`);
  const rows: Row[] = [
    ["from, to", `${path.tx} → ${path.rx}`],
    ["path gain", `${fixed(path.gain, 1)} dB`],
    ["delay", si(delay, "s", 5)],
    ["length", `${fixed(delay * 299_792_458, 2)} m`],
    ["departure", angle(channel.aod)],
    ["arrival", angle(channel.aoa)],
    ["Doppler", doppler.join(", ")],
    ["route", path.kinds.length ? `${path.kinds.length} interactions` : path.known ? "straight" : "unknown"],
  ];
  const stops = path.kinds.map((kind, i): Row => {
    const object = numbers(channel.objects)[index * depth + i];
    const on = object >= 0 ? ` on ${channel.object_names[object]}` : "";
    return [`${i + 1}. ${KINDS[kind]?.name ?? kind}${on}`, metres(path.points[i + 1])];
  });
  return [{ title: "", rows }, ...(stops.length ? [{ title: "Interactions", rows: stops }] : [])];
}

function describePiece(info: MeshInfo, view: RunView): Section {
  const rows: Row[] = [
    ["material", view.about.materials[info.material]?.name ?? "unknown"],
    ["kind", info.kind],
    ["triangles of its material", info.of > info.triangles ? `${info.triangles}, thinned from ${info.of}` : String(info.triangles)],
  ];
  return { title: "", rows };
}

/** Latitude, longitude and height of a place near the reference (a sphere of the Earth's radius there is exact to
 * a metre within some kilometres). */
function geographic(view: RunView, [x, y, z]: Vector): string | null {
  const reference = view.about.georeference;
  if (!reference) return null;
  const phi = (reference.latitude * Math.PI) / 180;
  const e2 = 6.694379990141e-3;
  const w = Math.sqrt(1 - e2 * Math.sin(phi) ** 2);
  const north = (6_378_137 * (1 - e2)) / w ** 3;
  const east = (6_378_137 / w) * Math.cos(phi);
  const [latitude, longitude] = [reference.latitude + degrees(y / north), reference.longitude + degrees(x / east)];
  return `${latitude.toFixed(6)}°, ${longitude.toFixed(6)}°, ${fixed(reference.height + z, 1)} m`;
}
