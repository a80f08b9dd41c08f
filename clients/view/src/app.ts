// The page: it loads what the state asks for, shows it, and keeps panels and address in step.
import { degrees, el, fixed } from "./dom";
import { type Frame, Frames, first, type Want } from "./frames";
import { numbers } from "./decode";
import { Banner } from "./panels/banner";
import { Header } from "./panels/header";
import { Inspector } from "./panels/inspector";
import { LayersPanel, userKey } from "./panels/layers";
import { Transport } from "./panels/transport";
import { Player } from "./player";
import { overview } from "./scene/overview";
import type { Pose } from "./scene/pose";
import { Stage } from "./scene/stage";
import { DARK, LIGHT } from "./scene/theme";
import { type Hit, RunView } from "./scene/view";
import type { Source } from "./source";
import { type Changed, fromFragment, type Store, toFragment, type ViewState } from "./state";
import { Timeline } from "./timeline";
import type { About, User, Vector } from "./types";

/** One of the runs that are shown. */
interface Shown {
  about: About;
  source: Source;
  timeline: Timeline;
  frames: Frames;
  view: RunView;
}

export class App {
  readonly player: Player;
  readonly timeline: Timeline;
  readonly errors: string[] = [];
  /** The newest frame is shown, and all that belongs to it. */
  ready: Promise<void> = Promise.resolve();
  n: number;
  private readonly runs: Shown[];
  private readonly stage: Stage;
  private readonly header: Header;
  private readonly banner = new Banner();
  private readonly layers: LayersPanel;
  private readonly inspector: Inspector;
  private readonly transport: Transport;
  private readonly announcer = el("p", { class: "hidden", role: "status", "aria-live": "polite" });
  private readonly origin: Vector;
  private loading: AbortController | null = null;
  private writing = 0;

  constructor(
    private readonly store: Store,
    runs: { about: About; source: Source }[],
  ) {
    const { about } = runs[0];
    const { low, high } = about.bounds;
    this.origin = [Math.round((low[0] + high[0]) / 2), Math.round((low[1] + high[1]) / 2), Math.round(low[2])];
    this.runs = runs.map(({ about, source }) => ({
      about,
      source,
      timeline: new Timeline(about.frames, about.sampling_period_s, about.every),
      frames: new Frames(source),
      view: new RunView(about, source, this.origin),
    }));
    this.timeline = this.runs[0].timeline;
    this.n = this.timeline.snap(store.state.n ?? (about.live ? this.timeline.last : this.timeline.first));
    this.player = new Player(this.timeline, store, (n) => this.go(n), () => this.updateTransport());
    this.stage = new Stage(this.origin, () => this.keepCamera(), (hit, view) => this.pick(hit, view));
    this.header = new Header(store, runs.map((run) => run.about), () => this.goHome());
    this.layers = new LayersPanel(store, about);
    this.inspector = new Inspector(() => store.set({ sel: null }));
    this.transport = new Transport(store, this.timeline, about.live, {
      go: (n) => this.seek(n),
      step: (by) => this.seek(this.timeline.step(this.n, by)),
      togglePlay: () => this.player.toggle(),
      follow: () => store.set({ n: null }),
    });
    document.body.append(
      el(
        "div",
        { class: "page" },
        this.header.element,
        el("main", { class: "main" }, this.stage.element, this.layers.element, this.inspector.element, this.banner.element),
        this.transport.element,
        this.announcer,
      ),
    );
    store.listen((state, changed) => this.changed(state, changed));
    addEventListener("hashchange", () => store.set(fromFragment(location.hash)));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.applyTheme());
  }

  get about(): About {
    return this.runs[0].about;
  }

  /** Load what stands still and show the first frame. */
  async start(): Promise<void> {
    const { state } = this.store;
    this.stage.setState(state);
    this.applyTheme();
    await Promise.all(
      this.runs.map(({ view }) => view.load((text) => this.report(text)).catch((error: Error) => this.report(error.message))),
    );
    this.stage.setViews(this.runs.map(({ view }) => view));
    this.stage.setCovered(this.layers.element.offsetWidth + 10);
    for (const line of this.about.damage) this.report(line);
    await this.show(this.n);
    if (state.cam) this.stage.setPlace(state.cam);
    else this.goHome();
    this.track();
    setTimeout(() => {
      for (const { view } of this.runs) view.world.addEdges();
      this.stage.refresh();
    }, 30);
  }

  /** Look at a place, which ends following and playing on. */
  seek(n: number): void {
    this.player.stop();
    this.store.set({ n: this.timeline.snap(n) });
  }

  /** Show a place; resolves when it is there. */
  async go(n: number): Promise<void> {
    this.store.set({ n });
    await this.ready;
  }

  /** Users of the frame, and the one that is chosen. */
  users(): { users: User[]; user: User | null } {
    return usersOf(this.runs[0].view.frame, this.store.state.user);
  }

  private show(n: number): Promise<void> {
    this.n = n;
    this.loading?.abort();
    const loading = new AbortController();
    this.loading = loading;
    this.ready = this.load(n, loading.signal).catch((error: Error) => {
      if (!loading.signal.aborted) this.report(error.message);
    });
    this.updateTransport();
    return this.ready;
  }

  private async load(n: number, signal: AbortSignal): Promise<void> {
    const wants = this.wants();
    const instant = this.timeline.at(n);
    const frames = await Promise.all(
      this.runs.map(async ({ frames, timeline }, i) => {
        const place = i === 0 ? n : instant && timeline.find(instant.episode, instant.frame);
        return place === null ? null : frames.load(place, wants, signal);
      }),
    );
    if (signal.aborted) return;
    this.runs.forEach(({ view }, i) => view.update(frames[i], usersOf(frames[i], this.store.state.user).user));
    this.banner.clear();
    this.redraw();
    this.track();
    this.stage.refresh();
    this.announce();
  }

  /** Topics that are shown, of those that there are. */
  private wants(): Want[] {
    const { layers } = this.store.state;
    const { topics } = this.about;
    const wanted: Want[] = [{ topic: "scene" }, { topic: "link" }];
    if (layers.has("rays")) wanted.push({ topic: "channel" });
    if (layers.has("lidar")) wanted.push({ topic: "lidar" });
    return wanted.filter(({ topic }) => topics[topic]?.length);
  }

  private changed(state: ViewState, changed: Changed): void {
    this.stage.setState(state);
    if (changed.has("theme")) this.applyTheme();
    if (changed.has("cam") && state.cam) this.stage.setPlace(state.cam);
    const n = this.timeline.snap(state.n ?? (this.about.live ? this.timeline.last : this.timeline.first));
    if (changed.has("n") && n !== this.n) void this.show(n);
    else if (changed.has("layers") || changed.has("user")) void this.show(this.n);
    if (changed.has("mode") || changed.has("sel")) this.track();
    this.redraw();
    this.writeAddress();
  }

  /** Draw the frame as the state asks for. */
  private redraw(): void {
    const { state } = this.store;
    const { users, user } = this.users();
    for (const { view } of this.runs) view.draw(state, user);
    const [{ view }] = this.runs;
    const channel = view.frame?.products.channel?.[0];
    const points = view.frame?.products.lidar?.[0]?.kept.points;
    this.layers.update(state, {
      users,
      user,
      range: view.rays.range,
      drawn: view.rays.drawn.length,
      paths: view.rays.paths.length,
      of: channel?.kept.paths?.[1] ?? view.rays.paths.length,
      points: view.points.count ? (points ?? [view.points.count, view.points.count]) : null,
      gridSize: view.world.gridSize,
      hasDifferences: this.runs.length > 1,
      absent: view.frame?.absent ?? [],
    });
    this.inspector.update(state.sel, view, view.frame);
    this.stage.render();
    this.updateTransport();
  }

  private updateTransport(): void {
    const { state } = this.store;
    this.transport.update(this.n, this.player.playing, this.about.live && state.n === null, state);
  }

  /** Follow the selection with the camera, or look from it. */
  private track(): void {
    const { sel } = this.store.state;
    const { objects, devices } = this.runs[0].view;
    const object = sel === null ? undefined : objects.shown.get(sel);
    const device = sel === null ? undefined : devices.shown.get(sel);
    const pose: Pose | null = object?.pose ?? device?.pose ?? null;
    const fieldOfView = device?.device.type === "camera" ? device.device.field_of_view : null;
    this.stage.track(pose, object?.size ?? [1, 1, 1], fieldOfView);
  }

  private goHome(): void {
    const { clientWidth, clientHeight } = this.stage.element;
    this.store.set({ mode: "free" });
    this.stage.setPlace(overview(this.runs[0].view, this.origin, clientWidth / clientHeight / this.runs.length));
    this.store.set({ cam: null });
  }

  private keepCamera(): void {
    this.store.set({ cam: this.stage.place });
  }

  private pick(hit: Hit | null, _view: number): void {
    const name = hit === null ? null : hit.kind === "path" ? hit.path.key : hit.kind === "piece" ? `mesh ${hit.name}` : hit.name;
    this.store.set({ sel: name });
  }

  private applyTheme(): void {
    const { theme } = this.store.state;
    const dark = theme === "auto" ? matchMedia("(prefers-color-scheme: dark)").matches : theme === "dark";
    document.documentElement.dataset.theme = dark ? "dark" : "light";
    for (const { view } of this.runs) view.setTheme(dark ? DARK : LIGHT);
    this.stage.refresh();
  }

  /** Show an error, and keep it for tests. */
  report(text: string): void {
    this.errors.push(text);
    this.banner.show(text);
  }

  private writeAddress(): void {
    clearTimeout(this.writing);
    // Browsers refuse more than some hundred a minute.
    this.writing = setTimeout(() => history.replaceState(null, "", `#${toFragment(this.store.state)}`), 300);
  }

  private announce(): void {
    if (this.player.playing) return;
    const { snr_db, objects, paths } = this.summary();
    const instant = this.timeline.at(this.n);
    const snr = snr_db === null ? "" : `, SNR ${fixed(snr_db, 1)} dB`;
    this.announcer.textContent = `Frame ${instant?.frame ?? "none"}, ${Object.keys(objects).length} objects, ${paths} paths${snr}`;
  }

  /** What the frame shows, as it is in the products. */
  summary() {
    const { view } = this.runs[0];
    const { user, users } = this.users();
    const link = first(view.frame, "link");
    const index = user ? users.findIndex((each) => userKey(each) === userKey(user)) : -1;
    const value = (array: Parameters<typeof numbers>[0] | undefined) => (array && index >= 0 ? numbers(array)[index] : null);
    const decibels = (ratio: number | null) => (ratio ? 10 * Math.log10(ratio) : null);
    const ranks = link?.top_tx_beam.shape[1] ?? 0;
    const best = (array: Parameters<typeof numbers>[0] | undefined) =>
      array && ranks && index >= 0 ? numbers(array)[index * ranks] : null;
    return {
      objects: Object.fromEntries([...view.objects.shown].map(([name, { pose }]) => [name, pose.position])),
      devices: Object.fromEntries([...view.devices.shown].map(([name, { pose }]) => [name, pose.position])),
      paths: first(view.frame, "channel")?.tau.shape[0] ?? 0,
      drawn: view.rays.drawn.length,
      points: view.points.count,
      user: user && userKey(user),
      tx_beam: value(link?.tx_beam),
      rx_beam: value(link?.rx_beam),
      best_tx_beam: best(link?.top_tx_beam),
      best_rx_beam: best(link?.top_rx_beam),
      abs_y: value(link?.abs_y),
      snr_db: decibels(value(link?.snr)),
      absent: view.frame?.absent ?? [],
    };
  }

  /** State of the page, for tests and for people at the console. */
  state() {
    const { state } = this.store;
    const instant = this.timeline.at(this.n);
    return {
      kind: this.about.kind,
      n: this.n,
      episode: instant?.episode ?? null,
      frame: instant?.frame ?? null,
      t_s: instant?.t_s ?? null,
      playing: this.player.playing,
      live: this.about.live && state.n === null,
      selected: state.sel,
      camera: { ...this.stage.place, mode: state.mode, field_of_view: degrees(1) && this.stage.camera.fov },
      shown: this.summary(),
      errors: [...this.errors],
    };
  }
}

/** Users of a frame; the chosen one, or else the first that has beams. */
function usersOf(frame: Frame | null, chosen: string | null): { users: User[]; user: User | null } {
  const link = first(frame, "link");
  if (!link) return { users: [], user: null };
  const users = link.tx.map((tx, i) => ({ tx, rx: link.rx[i], carrier: link.carrier[i] }));
  const beams = numbers(link.tx_beam);
  const user = users.find((each) => userKey(each) === chosen) ?? users.find((_, i) => beams[i] >= 0) ?? users[0] ?? null;
  return { users, user };
}
