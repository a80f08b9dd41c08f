// The part below the picture: the clock, or curves.
import { el, fill } from "../dom";
import type { Run } from "../run";
import type { Dock as Choice, Store } from "../state";
import type { Clock, Curves, News, User } from "../types";
import { ClockPanel, type Command, WINDOW } from "./clock";
import { CurvesPanel } from "./curves";
import { userKey } from "./layers";

/** A live run's curves and lanes are asked for again after this time [ms]. */
const REFRESH_MS = 1000;

export class Dock {
  readonly element = el("section", { class: "dock", "aria-label": "Clock and curves", hidden: true });
  /** Buttons that open and close it. */
  readonly tabs: HTMLElement[];
  private readonly clock: ClockPanel;
  private readonly curves: CurvesPanel;
  private readonly buttons = new Map<Choice, HTMLButtonElement>();
  private asked = "";
  private loading: AbortController | null = null;
  private refreshed = 0;

  constructor(
    private readonly store: Store,
    private readonly runs: Run[],
    go: (n: number) => void,
    command: (name: Command) => void,
  ) {
    const [{ timeline, about }] = runs;
    const seek = (n: number) => go(timeline.snap(n));
    this.clock = new ClockPanel(timeline, about.controls, seek, command);
    this.curves = new CurvesPanel(timeline, seek);
    for (const [choice, text, title] of [
      ["clock", "Clock", "Lanes of the services (C)"],
      ["curves", "Curves", "Curves of the user (V)"],
    ] as const) {
      this.buttons.set(choice, el("button", { type: "button", class: "tab", title, click: () => this.toggle(choice) }, text));
    }
    // A scenario that has not run has neither.
    this.tabs = about.kind === "scenario" ? [] : [...this.buttons.values()];
  }

  toggle(choice: Choice): void {
    this.store.set({ dock: this.store.state.dock === choice ? "none" : choice });
  }

  /** Show what the state asks for, at a place and of a user. */
  async update(n: number, user: User | null): Promise<void> {
    const { dock } = this.store.state;
    for (const [choice, tab] of this.buttons) tab.setAttribute("aria-pressed", String(choice === dock));
    this.element.hidden = dock === "none";
    if (dock === "none") return;
    const panel = dock === "clock" ? this.clock : this.curves;
    if (this.element.firstChild !== panel.element) fill(this.element, panel.element);
    const [{ timeline }] = this.runs;
    const window = WINDOW * timeline.every;
    const start = Math.max(timeline.first, Math.floor(n / window) * window);
    const key = dock === "clock" ? `clock ${start}` : `curves ${user && userKey(user)}`;
    const isOld = this.runs[0].about.live && performance.now() - this.refreshed > REFRESH_MS;
    if (key !== this.asked || isOld) {
      this.asked = key;
      this.refreshed = performance.now();
      this.loading?.abort();
      this.loading = new AbortController();
      const { signal } = this.loading;
      try {
        if (dock === "clock") await this.loadClock(start, signal);
        else await this.loadCurves(user, signal);
      } catch (error) {
        if (signal.aborted) return;
        panel.say((error as Error).message);
      }
    }
    panel.setCursor(n);
  }

  setNews(news: News): void {
    this.clock.setNews(news);
  }

  private async loadClock(first: number, signal: AbortSignal): Promise<void> {
    const [{ source, timeline }] = this.runs;
    const query = { first, count: WINDOW, every: timeline.every };
    this.clock.draw(await source.json<Clock>("clock", query, signal));
  }

  private async loadCurves(user: User | null, signal: AbortSignal): Promise<void> {
    const of = async (run: Run): Promise<Curves | null> => {
      // Answers number users in their own order, which the first one tells.
      const indexIn = (known: User[]) => Math.max(0, known.findIndex((each) => user && userKey(each) === userKey(user)));
      const asked = indexIn(this.known.get(run) ?? []);
      const curves = await run.source.json<Curves>("curves", { user: asked }, signal);
      this.known.set(run, curves.users);
      const index = indexIn(curves.users);
      return index === asked ? curves : await run.source.json<Curves>("curves", { user: index }, signal);
    };
    const [curves, other] = await Promise.all(this.runs.map(of));
    if (curves) this.curves.draw(curves, other ?? null);
  }
  /** Users of a run by their number in answers. */
  private readonly known = new Map<Run, User[]>();
}
