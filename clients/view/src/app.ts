// The page: it loads what the state asks for, shows it, and keeps panels and address in step.
import { numbers } from "./decode";
import { el, fixed } from "./dom";
import { first, type Want } from "./frames";
import { type KeyAction, listenToKeys } from "./keys";
import { Live } from "./live";
import { Pace } from "./pace";
import { Banner } from "./panels/banner";
import { Dock } from "./panels/dock";
import { Header, toggleTheme } from "./panels/header";
import { showHelp } from "./panels/help";
import { Inspector } from "./panels/inspector";
import { LayersPanel, userKey } from "./panels/layers";
import { Pictures } from "./panels/pictures";
import { Transport } from "./panels/transport";
import { Player } from "./player";
import { differences, Run, usersOf } from "./run";
import { overview } from "./scene/overview";
import type { Pose } from "./scene/pose";
import { isSoftware, Stage } from "./scene/stage";
import { DARK, LIGHT } from "./scene/theme";
import type { Hit } from "./scene/view";
import { isOnThisMachine, isSaved, replaceFragment, type Source, takeToken } from "./source";
import { type Changed, fromFragment, type Mode, SPEEDS, type Store, toFragment, type ViewState } from "./state";
import type { Timeline } from "./timeline";
import type { About, News, User, Vector } from "./types";

/** Trails are loaded when no other frame was asked for in this time [ms]. */
const IDLE_MS = 200;

export class App {
  readonly player: Player;
  readonly timeline: Timeline;
  readonly errors: string[] = [];
  /** Resolves when the newest frame is shown, and all that belongs to it. */
  ready: Promise<void> = Promise.resolve();
  n: number;
  private readonly runs: Run[];
  private readonly stage: Stage;
  private readonly banner = new Banner();
  private readonly layers: LayersPanel;
  private readonly inspector: Inspector;
  private readonly pictures: Pictures;
  private readonly transport: Transport;
  private readonly dock: Dock;
  private readonly live: Live | null;
  private readonly loadingNote = el("p", { class: "loading" }, "Loading the world …");
  private readonly announcer = el("p", { class: "hidden", role: "status", "aria-live": "polite" });
  private readonly origin: Vector;
  private loading: AbortController | null = null;
  private writing = 0;
  private readonly pace: Pace;
  private different = { objects: new Set<string>(), receivers: new Set<string>() };

  constructor(
    private readonly store: Store,
    runs: { about: About; source: Source }[],
  ) {
    const { about } = runs[0];
    const { low, high } = about.bounds;
    this.origin = [Math.round((low[0] + high[0]) / 2), Math.round((low[1] + high[1]) / 2), Math.round(low[2])];
    this.runs = runs.map(({ about, source }) => new Run(about, source, this.origin));
    this.timeline = this.runs[0].timeline;
    this.n = this.placeOf(store.state);
    this.player = new Player(this.timeline, store, (n) => this.go(n), () => this.updateTransport());
    const { quality } = store.state;
    const software = isSoftware();
    const isFine = quality === "fine" || (quality === "auto" && !software);
    this.pace = new Pace(software && isOnThisMachine());
    for (const { view } of this.runs) view.beams.isFine = isFine;
    this.stage = new Stage(this.origin, isFine, () => this.keepCamera(), (hit) => this.pick(hit));
    this.stage.canvas.addEventListener("webglcontextlost", () => this.report("The browser gave up the picture: reload the page."));
    this.layers = new LayersPanel(store, about);
    this.inspector = new Inspector(() => store.set({ sel: null }));
    this.pictures = new Pictures(store, about);
    this.live = about.live
      ? new Live(
          runs[0].source,
          this.pace.newsEvery,
          (news) => void this.hear(news),
          (reason) => {
            this.pace.setBusy(false);
            this.banner.show(`The run has ended. ${reason}`);
          },
          (text) => this.report(text),
        )
      : null;
    this.dock = new Dock(store, this.runs, (n) => this.seek(n), (name) => void this.live?.command(name));
    this.transport = new Transport(store, this.timeline, about.live, this.dock.tabs, {
      go: (n) => this.seek(n),
      step: (by) => this.step(by),
      togglePlay: () => this.player.toggle(),
      follow: () => this.follow(),
    });
    const actions = this.keyActions();
    const header = new Header(store, runs.map((run) => run.about), isSaved(), this.pace.rests, () => this.goHome(), () => showHelp(actions));
    const overlays = [this.layers, this.inspector, this.pictures, this.banner].map(({ element }) => element);
    document.body.append(
      el(
        "div",
        { class: "page" },
        header.element,
        el("main", { class: "main" }, this.stage.element, this.loadingNote, ...overlays, this.announcer),
        this.dock.element,
        this.transport.element,
      ),
    );
    listenToKeys(actions);
    store.listen((state, changed) => this.changed(state, changed));
    addEventListener("hashchange", () => {
      takeToken();
      store.set(fromFragment(location.hash));
    });
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
    const report = (text: string) => this.report(text);
    await Promise.all(this.runs.map(({ view }) => view.load(report).catch((error: Error) => report(error.message))));
    this.layers.element.hidden = !state.panel;
    this.stage.setCovered(this.layers.element.offsetWidth);
    this.stage.setViews(this.runs.map(({ view }) => view));
    await this.show(this.n);
    for (const line of [...this.about.damage, ...(this.about.notes ?? [])]) report(line);
    if (!this.placed) this.placeCamera();
    this.loadingNote.remove();
    this.stage.start();
    void Promise.all(this.runs.map(({ view }) => view.world.addEdges())).then(() => this.stage.render());
    void this.live?.listen();
  }

  /** Put the camera where the address says, or where it sees what there is. */
  private placeCamera(): void {
    const { cam, mode } = this.store.state;
    if (cam) this.stage.setPlace(cam);
    else this.goHome(mode);
    this.track(cam !== null);
    // A live run that has no frame yet is looked at again with its first one.
    this.placed = this.runs[0].view.frame !== null;
  }
  private placed = false;

  /** Look at a place, which ends playing and following. */
  seek(n: number): void {
    this.player.stop();
    this.store.set({ n: this.timeline.snap(n) });
  }

  /** Show a place; resolves when it is there. */
  async go(n: number): Promise<void> {
    this.store.set({ n });
    await this.ready;
  }

  /** Draw at once, and not with the screen's next picture. */
  draw(): void {
    this.stage.draw();
  }

  private step(by: number): void {
    this.seek(this.timeline.step(this.n, by, this.store.state.loop));
  }

  private follow(): void {
    this.player.stop();
    this.store.set({ n: null });
  }

  /** Place that a state asks for. */
  private placeOf({ n }: Readonly<ViewState>): number {
    return n === null ? (this.runs[0].about.live ? this.timeline.last : this.timeline.first) : this.timeline.snap(n);
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
    if (this.timeline.last < this.timeline.first) return;
    const { user } = this.store.state;
    const wants = this.wants();
    const instant = this.timeline.at(n);
    const loaded = await Promise.all(
      this.runs.map((run, i) => {
        const place = i === 0 ? n : instant && run.timeline.find(instant.episode, instant.frame);
        return run.load(place, wants, user, signal);
      }),
    );
    if (signal.aborted) return;
    this.runs.forEach((run, i) => run.update(loaded[i]));
    await this.correct(n, loaded[0].frame?.info ?? null);
    if (this.runs.length > 1) this.compare();
    this.banner.clear();
    for (const { topic, reason, failed } of loaded.flatMap(({ frame }) => frame?.absent ?? [])) {
      if (failed) this.report(`${topic} is not shown. ${reason}`);
    }
    for (const run of this.runs) run.drawTrails(n);
    this.redraw();
    if (this.placed) this.track();
    else this.placeCamera();
    this.stage.refresh();
    this.announce();
    // A run that is followed fills the trails by itself.
    if (!this.player.playing && !this.following) setTimeout(() => void this.loadTrails(n, signal), IDLE_MS);
  }

  /** Ask again which frames there are, where a live run began another episode. */
  private async correct(n: number, info: { episode: number; frame: number } | null): Promise<void> {
    const known = this.timeline.at(n);
    if (!info || (known?.episode === info.episode && known.frame === info.frame)) return;
    this.timeline.reset((await this.runs[0].source.json<About>("about")).frames);
  }

  private async loadTrails(n: number, signal: AbortSignal): Promise<void> {
    if (signal.aborted || !this.store.state.layers.has("trails") || this.player.playing) return;
    try {
      await Promise.all(this.runs.map((run) => run.loadTrails(n, signal)));
      if (signal.aborted) return;
      for (const run of this.runs) run.drawTrails(n);
      this.redraw();
    } catch (error) {
      if (!signal.aborted) this.report((error as Error).message);
    }
  }

  /** Topics that are shown. */
  private wants(): Want[] {
    const { layers } = this.store.state;
    const wanted: Want[] = [{ topic: "scene" }, { topic: "link" }];
    if (layers.has("rays")) wanted.push({ topic: "channel" });
    if (layers.has("lidar")) wanted.push({ topic: "lidar" });
    const pictures = this.pictures.topic(this.store.state);
    if (layers.has("pictures") && pictures) wanted.push({ topic: pictures });
    return wanted;
  }

  private compare(): void {
    const [a, b] = this.runs;
    this.different = differences(a.view.frame, b.view.frame);
    for (const { view } of this.runs) {
      view.objects.setDifferent(this.different.objects);
      view.devices.setDifferent(this.different.receivers);
    }
  }

  private changed(state: ViewState, changed: Changed): void {
    this.stage.setState(state);
    if (changed.has("theme")) this.applyTheme();
    if (changed.has("cam") && state.cam) this.stage.setPlace(state.cam);
    const n = this.placeOf(state);
    if (changed.has("n") && n !== this.n) void this.show(n);
    else if (changed.has("layers") || changed.has("user") || changed.has("pics")) void this.show(this.n);
    if (changed.has("panel")) {
      this.layers.element.hidden = !state.panel;
      this.stage.setCovered(this.layers.element.offsetWidth);
    }
    if (changed.has("mode") || changed.has("sel")) this.track();
    // A new place is drawn when it is there: the old one again would only hold it up.
    if (changed.size > 1 || !changed.has("n")) this.redraw();
    this.updateTransport();
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
      names: { objects: [...view.objects.shown.keys()], devices: [...view.devices.shown.keys()] },
      range: view.rays.range,
      drawn: view.rays.drawn.length,
      ticks: view.rays.drawn.filter(({ known }) => !known).length,
      paths: view.rays.paths.length,
      of: channel?.kept.paths?.[1] ?? view.rays.paths.length,
      points: view.points.count ? (points ?? [view.points.count, view.points.count]) : null,
      gridSize: view.world.gridSize,
      different: this.runs.length > 1 ? this.different : null,
      absent: view.frame?.absent ?? [],
    });
    this.inspector.update(state.sel, view, view.frame);
    this.pictures.update(view.frame, state);
    void this.dock.update(this.n, user);
    this.stage.render();
    this.updateTransport();
  }

  private users(): { users: User[]; user: User | null } {
    return usersOf(this.runs[0].view.frame, this.store.state.user);
  }

  private updateTransport(): void {
    const { state } = this.store;
    this.transport.update(this.n, this.player.playing, this.following, state);
  }

  /** Follow the selection with the camera, or look from it. */
  private track(keep = false): void {
    const { sel } = this.store.state;
    const { objects, devices } = this.runs[0].view;
    const object = sel === null ? undefined : objects.shown.get(sel);
    const device = sel === null ? undefined : devices.shown.get(sel);
    const pose: Pose | null = object?.pose ?? device?.pose ?? null;
    const fieldOfView = device?.device.type === "camera" ? device.device.field_of_view : null;
    this.stage.track(pose, object?.size ?? [1, 1, 1], fieldOfView, keep);
  }

  private goHome(mode: Mode = "free"): void {
    const { clientWidth, clientHeight } = this.stage.element;
    this.store.set({ mode });
    const covered = this.runs.length === 1 ? this.layers.element.offsetWidth : 0;
    const aspect = (clientWidth - covered) / clientHeight / this.runs.length;
    this.stage.setPlace(overview(this.runs[0].view, this.origin, aspect));
    this.keepCamera();
  }

  private keepCamera(): void {
    this.store.set({ cam: this.stage.place });
  }

  private pick(hit: Hit | null): void {
    const name = (found: Hit) =>
      found.kind === "path" ? found.path.key : found.kind === "piece" ? `mesh ${found.name}` : found.name;
    this.store.set({ sel: hit && name(hit) });
  }

  private applyTheme(): void {
    const { theme } = this.store.state;
    const dark = theme === "auto" ? matchMedia("(prefers-color-scheme: dark)").matches : theme === "dark";
    document.documentElement.dataset.theme = dark ? "dark" : "light";
    for (const { view } of this.runs) view.setTheme(dark ? DARK : LIGHT);
    this.stage.refresh();
  }

  /** A live run went on. */
  private async hear(news: News): Promise<void> {
    this.timeline.grow(news.first, news.added);
    this.dock.setNews(news);
    this.pace.setBusy(!news.paused);
    // What is looked at is forgotten: the oldest frame that is held stands for it.
    if (this.n < this.timeline.first && this.store.state.n !== null) this.store.set({ n: this.timeline.first });
    if (this.catchingUp) return;
    // One frame after the other: each newer one would break off the one before, and none would be shown.
    this.catchingUp = true;
    while (this.following && this.n !== this.timeline.last) {
      const begin = performance.now();
      await this.show(this.timeline.last);
      if (!this.pace.rests) continue;
      this.stage.finish();
      await this.pace.rest(performance.now() - begin);
    }
    this.catchingUp = false;
    void this.dock.update(this.n, this.users().user);
    this.updateTransport();
  }
  private catchingUp = false;

  /** Whether the newest frame of a live run is shown. */
  private get following(): boolean {
    return this.about.live && this.store.state.n === null;
  }

  /** Report an error where the reader sees it. */
  report(text: string): void {
    if (!this.errors.includes(text)) this.errors.push(text);
    this.banner.show(text);
  }

  private writeAddress(): void {
    clearTimeout(this.writing);
    // Browsers refuse more than some hundred a minute.
    this.writing = setTimeout(() => replaceFragment(this.address()), 300);
  }

  /** Fragment of the view, with the camera where it has followed to. */
  private address(): string {
    return toFragment({ ...this.store.state, cam: this.stage.place });
  }

  private announce(): void {
    if (this.player.playing) return;
    const { snr_db, objects, paths } = this.summary();
    const instant = this.timeline.at(this.n);
    const snr = snr_db === null ? "" : `, SNR ${fixed(snr_db, 1)} dB`;
    this.announcer.textContent = `Frame ${instant?.frame ?? "none"}, ${Object.keys(objects).length} objects, ${paths} paths${snr}`;
  }

  private keyActions(): KeyAction[] {
    const { store } = this;
    const speed = (by: number) => {
      const index = SPEEDS.findIndex((value) => value === store.state.speed) + by;
      if (SPEEDS[index]) store.set({ speed: SPEEDS[index] });
    };
    const mode = (value: Mode) => store.set({ mode: store.state.mode === value ? "free" : value });
    const key = (keys: string[], shown: string, text: string, action: () => void) => ({ keys, shown, text, action });
    return [
      key([" "], "Space", "play, pause", () => this.player.toggle()),
      key(["ArrowLeft"], "←", "one frame back", () => this.step(-1)),
      key(["ArrowRight"], "→", "one frame on", () => this.step(1)),
      key(["Shift+ArrowLeft"], "Shift ←", "ten frames back", () => this.step(-10)),
      key(["Shift+ArrowRight"], "Shift →", "ten frames on", () => this.step(10)),
      key(["Home"], "Home", "first frame", () => this.seek(this.timeline.first)),
      key(["End"], "End", "last frame; of a live run, follow it", () => (this.live ? this.follow() : this.seek(this.timeline.last))),
      key(["+", "="], "+", "faster", () => speed(1)),
      key(["-"], "−", "slower", () => speed(-1)),
      key(["l"], "L", "loop", () => store.set({ loop: !store.state.loop })),
      key(["h"], "H", "show all", () => this.goHome()),
      key(["f"], "F", "follow the selection", () => mode("follow")),
      key(["b"], "B", "look from the selection", () => mode("board")),
      key(["c"], "C", "clock", () => this.dock.toggle("clock")),
      key(["v"], "V", "curves", () => this.dock.toggle("curves")),
      key(["p"], "P", "panel of layers", () => store.set({ panel: !store.state.panel })),
      key(["d"], "D", "light, dark", () => toggleTheme(store)),
      key(["Escape"], "Esc", "clear the selection", () => store.set({ sel: null, mode: "free" })),
      key(["?"], "?", "this help", () => showHelp(this.keyActions())),
    ];
  }

  /** What the frame shows, as it is in the products. */
  private summary() {
    const { view } = this.runs[0];
    const { user, users } = this.users();
    const link = first(view.frame, "link");
    const index = user ? users.findIndex((each) => userKey(each) === userKey(user)) : -1;
    const value = (array: Parameters<typeof numbers>[0] | undefined, place = index) =>
      array && index >= 0 && place >= 0 ? (numbers(array)[place] ?? null) : null;
    const decibels = (ratio: number | null) => (ratio ? 10 * Math.log10(ratio) : null);
    const ranks = link?.top_tx_beam.shape[1] ?? 0;
    const best = ranks ? index * ranks : -1;
    return {
      objects: Object.fromEntries([...view.objects.shown].map(([name, { pose }]) => [name, pose.position])),
      devices: Object.fromEntries([...view.devices.shown].map(([name, { pose }]) => [name, pose.position])),
      paths: first(view.frame, "channel")?.tau.shape[0] ?? 0,
      drawn: view.rays.drawn.length,
      points: view.points.count,
      lobes: view.beams.shown.map(({ lobe, best }) => ({ device: lobe.device, beam: lobe.beam, best })),
      user: user && userKey(user),
      tx_beam: value(link?.tx_beam),
      rx_beam: value(link?.rx_beam),
      best_tx_beam: value(link?.top_tx_beam, best),
      best_rx_beam: value(link?.top_rx_beam, best),
      abs_y: value(link?.abs_y),
      snr_db: decibels(value(link?.snr)),
      different: { objects: [...this.different.objects], receivers: [...this.different.receivers] },
      absent: view.frame?.absent ?? [],
      // Until it is loaded, not the one that was asked for.
      n: view.frame?.n ?? null,
    };
  }

  /** Where a place in the world [m] is in the window [px]. */
  project(place: Vector): [number, number] {
    return this.stage.project(place);
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
      live: this.following,
      frames: this.timeline.count,
      news: this.live?.news ?? null,
      selected: state.sel,
      camera: { ...this.stage.place, mode: state.mode },
      shown: this.summary(),
      errors: [...this.errors],
    };
  }
}
