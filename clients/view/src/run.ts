// One of the runs that are shown: its frames, its scene, and what has to be fetched beyond a frame's products.
import { numbers } from "./decode";
import { type Frame, Frames, first, type Want } from "./frames";
import { userKey } from "./panels/layers";
import type { ShownBeam } from "./scene/beams";
import { devicePose, objectPose } from "./scene/pose";
import { SAME_PLACE_M } from "./scene/objects";
import { RunView } from "./scene/view";
import type { Source } from "./source";
import { Timeline } from "./timeline";
import type { About, Lobe, User, Vector } from "./types";
import type { AntennaDevice, Scene } from "../../js/src/types.d.ts";

/** Frames of a trail, and requests for them at a time. */
const TRAIL = 30;
const AT_ONCE = 4;
/** Lobes that are kept; one has up to 40,000 directions. */
const MOST_LOBES = 64;
/** Length of the strongest direction of a lobe, of the distance between both ends: of TX and of RX. */
const LOBE_SHARE = { tx: 0.42, rx: 0.15 };

export class Run {
  readonly timeline: Timeline;
  readonly view: RunView;
  private readonly frames: Frames;
  /** Where objects were, by place. */
  private readonly places = new Map<number, Map<string, Vector>>();
  private readonly lobes = new Map<string, Lobe>();

  /** @param origin world coordinates of the scene's zero [m] */
  constructor(
    readonly about: About,
    readonly source: Source,
    origin: Vector,
  ) {
    this.timeline = new Timeline(about.frames, about.sampling_period_s, about.every);
    this.frames = new Frames(source);
    this.view = new RunView(about, source, origin);
  }

  /** Load a frame, and the lobes that it needs. */
  async load(n: number | null, wants: Want[], user: string | null, signal: AbortSignal): Promise<Loaded> {
    const there = wants.filter(({ topic }) => this.about.topics[topic]?.length);
    const frame = n === null ? null : await this.frames.load(n, there, signal);
    const chosen = usersOf(frame, user).user;
    const beams = frame && chosen ? await this.beams(frame, chosen, signal) : [];
    return { frame, user: chosen, beams };
  }

  /** Show what was loaded. */
  update({ frame, user, beams }: Loaded): void {
    this.view.update(frame, user);
    this.view.beams.set(beams);
    const scene = first(frame, "scene");
    if (frame && scene) this.remember(frame.n, scene);
  }

  /** Draw where objects were in the frames before, as far as that is known. */
  drawTrails(n: number): void {
    const trails = new Map<string, Vector[]>();
    for (const place of this.trailPlaces(n)) {
      for (const [name, at] of this.places.get(place) ?? []) {
        const trail = trails.get(name);
        if (trail) trail.push(at);
        else trails.set(name, [at]);
      }
    }
    const shown = this.view.objects.shown;
    this.view.objects.setTrails(new Map([...trails].filter(([name]) => shown.has(name))));
  }

  /** Load what trails need. */
  async loadTrails(n: number, signal: AbortSignal): Promise<void> {
    const missing = this.trailPlaces(n).filter((place) => !this.places.has(place));
    const work = async () => {
      for (let place = missing.pop(); place !== undefined && !signal.aborted; place = missing.pop()) {
        const scene = first(await this.frames.load(place, [{ topic: "scene" }], signal), "scene");
        if (scene) this.remember(place, scene);
      }
    };
    await Promise.all(Array.from({ length: AT_ONCE }, work));
  }

  /** Places of the frames before in the same episode, and of this one. */
  private trailPlaces(n: number): number[] {
    const episode = this.timeline.at(n)?.episode;
    return Array.from({ length: TRAIL }, (_, i) => n - (TRAIL - 1 - i) * this.timeline.every).filter(
      (place) => place >= this.timeline.first && this.timeline.at(place)?.episode === episode,
    );
  }

  private remember(n: number, scene: Scene): void {
    this.places.set(n, new Map(scene.names.map((name, i) => [name, objectPose(scene, i).position])));
    const oldest = this.places.keys().next().value;
    if (this.places.size > 40 * TRAIL && oldest !== undefined) this.places.delete(oldest);
  }

  /** Lobes of the chosen and the best beams of a user, of arrays that have more than one element. */
  private async beams(frame: Frame, user: User, signal: AbortSignal): Promise<ShownBeam[]> {
    const link = first(frame, "link");
    const scene = first(frame, "scene");
    const index = link ? usersOf(frame, userKey(user)).users.findIndex((each) => userKey(each) === userKey(user)) : -1;
    if (!link || !scene || index < 0) return [];
    const ranks = link.top_tx_beam.shape[1];
    const best = (array: typeof link.top_tx_beam) => (ranks ? numbers(array)[index * ranks] : -1);
    const ends = [
      { name: user.tx, share: LOBE_SHARE.tx, chosen: numbers(link.tx_beam)[index], best: best(link.top_tx_beam) },
      { name: user.rx, share: LOBE_SHARE.rx, chosen: numbers(link.rx_beam)[index], best: best(link.top_rx_beam) },
    ];
    const poses = ends.map(({ name }) => {
      const device = scene.devices?.find((each) => each.name === name);
      return device ? devicePose(scene, device) : null;
    });
    const [from, to] = poses;
    if (!from || !to) return [];
    const distance = Math.hypot(...from.position.map((value, i) => value - to.position[i]));
    const wanted = ends.flatMap(({ name, share, chosen, best }, i) => {
      const device = scene.devices?.find((each): each is AntennaDevice => each.type === "antenna" && each.name === name);
      if (!device || !poses[i] || device.array.rows * device.array.columns < 2) return [];
      const other = i === 0 ? to : from;
      const shown = { device, pose: poses[i], towards: other.position, radius: Math.max(5, share * distance) };
      // Where the chosen beam is the best one, it is drawn once.
      const beams = [{ beam: best, best: true }, { beam: chosen, best: false }].filter(({ beam, best }) => beam >= 0 && (!best || beam !== chosen));
      return beams.map((beam) => ({ ...shown, ...beam }));
    });
    const found = await Promise.all(
      wanted.map(async ({ device, beam, best, ...shown }) => {
        const lobe = await this.lobe(frame, device, beam, signal);
        return lobe && { lobe, best, ...shown };
      }),
    );
    return found.filter((beam) => beam !== null);
  }

  private async lobe(frame: Frame, device: AntennaDevice, beam: number, signal: AbortSignal): Promise<Lobe | null> {
    // Of an array and its codebook: the same in all frames.
    const key = `${device.name}/${beam}/${JSON.stringify(device.array)}`;
    let lobe = this.lobes.get(key);
    if (!lobe) {
      try {
        lobe = await this.source.json<Lobe>(`frames/${frame.n}/lobes`, { device: device.name, beam }, signal);
      } catch (error) {
        if (signal.aborted) throw error;
        frame.absent.push({ topic: "link", source: device.name, reason: (error as Error).message, failed: true });
        return null;
      }
      this.lobes.set(key, lobe);
      const oldest = this.lobes.keys().next().value;
      if (this.lobes.size > MOST_LOBES && oldest !== undefined) this.lobes.delete(oldest);
    }
    return lobe;
  }
}

export interface Loaded {
  frame: Frame | null;
  user: User | null;
  beams: ShownBeam[];
}

/** Users of a frame; the chosen one, or else the first that has beams. */
export function usersOf(frame: Frame | null, chosen: string | null): { users: User[]; user: User | null } {
  const link = first(frame, "link");
  if (!link) return { users: [], user: null };
  const users = link.tx.map((tx, i) => ({ tx, rx: link.rx[i], carrier: link.carrier[i] }));
  const beams = numbers(link.tx_beam);
  const user = users.find((each) => userKey(each) === chosen) ?? users.find((_, i) => beams[i] >= 0) ?? users[0] ?? null;
  return { users, user };
}

/** Names of objects that stand elsewhere in another frame, and of receivers that have other beams. */
export function differences(a: Frame | null, b: Frame | null): { objects: Set<string>; receivers: Set<string> } {
  const objects = new Set<string>();
  const receivers = new Set<string>();
  const [scene, other] = [first(a, "scene"), first(b, "scene")];
  if (scene && other) {
    const before = new Map(other.names.map((name, i) => [name, objectPose(other, i).position]));
    scene.names.forEach((name, i) => {
      const place = before.get(name);
      const at = objectPose(scene, i).position;
      if (!place || Math.hypot(...at.map((value, k) => value - place[k])) > SAME_PLACE_M) objects.add(name);
    });
    for (const name of before.keys()) if (!scene.names.includes(name)) objects.add(name);
  }
  const chosen = (frame: Frame | null) => {
    const link = first(frame, "link");
    const pairs = link?.tx.map((tx, i): [string, string] => [
      `${tx}|${link.rx[i]}|${link.carrier[i]}`,
      `${numbers(link.tx_beam)[i]} ${numbers(link.rx_beam)[i]}`,
    ]);
    return new Map(pairs);
  };
  const [one, two] = [chosen(a), chosen(b)];
  for (const [user, beams] of one) if (two.has(user) && two.get(user) !== beams) receivers.add(user.split("|")[1]);
  return { objects, receivers };
}
