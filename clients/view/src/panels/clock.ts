// The clock: when each service was granted a frame and answered, who was late, and what is waited for.
import { BLUE, ORANGE, SKY, VERMILION } from "../colors";
import { button, el, fill, fixed, svg } from "../dom";
import type { Timeline } from "../timeline";
import type { Clock, Lane, News } from "../types";

/** Frames that are shown at once. */
export const WINDOW = 40;
const LABEL = 150;
const ROW = 20;
const COLUMN = 27;

export type Command = "pause" | "resume" | "step" | "stop";

export class ClockPanel {
  readonly element: HTMLElement;
  private readonly lanes = el("div", { class: "lanes" });
  private readonly events = el("ul", { class: "events" });
  private readonly waits = el("p", { class: "waits", role: "status" });
  private readonly pause: HTMLButtonElement;
  private readonly cursor = svg("rect", { class: "now", y: 0, width: COLUMN });
  private shown: Clock | null = null;
  private paused = false;

  constructor(
    private readonly timeline: Timeline,
    controls: boolean,
    private readonly go: (n: number) => void,
    command: (name: Command) => void,
  ) {
    this.pause = button("pause", "Pause the run", () => command(this.paused ? "resume" : "pause"), "Pause");
    const buttons = el(
      "div",
      { class: "controls", role: "group", "aria-label": "Control of the run", hidden: !controls },
      this.pause,
      button("next", "Let the run make one frame", () => command("step"), "Step"),
      button("stop", "Stop the run", () => command("stop"), "Stop"),
    );
    const legend = el(
      "div",
      { class: "keys" },
      ...[["work", BLUE], ["granted to answered", SKY], ["missed its budget", VERMILION], ["held", ORANGE]].map(([name, color]) => {
        const key = el("span", { class: "key" }, name);
        key.style.borderColor = color;
        return key;
      }),
      el("span", { class: "key" }, "× absent"),
    );
    this.element = el("div", { class: "clock" }, el("div", { class: "head" }, buttons, this.waits, legend), this.lanes, this.events);
  }

  say(text: string): void {
    this.shown = null;
    fill(this.lanes, el("p", { class: "note" }, text));
  }

  /** What a live run does now. */
  setNews(news: News): void {
    this.paused = news.paused;
    const label = this.paused ? "Resume" : "Pause";
    this.pause.setAttribute("aria-label", `${label} the run`);
    this.pause.title = `${label} the run`;
    this.pause.lastChild!.textContent = label;
    const waits = news.waits
      .map(({ service, frame, elapsed_s, limit_s }) => `${service}${frame < 0 ? "" : ` in frame ${frame}`}, ${fixed(elapsed_s, 2)} of ${fixed(limit_s, 2)} s`)
      .join("; ");
    this.waits.textContent = `${news.state}${news.paused ? ", paused" : ""}${waits ? ` · waits for ${waits}` : ""}`;
    if (news.events?.length) {
      const texts = news.events.map((event) => (typeof event === "string" ? event : event.text));
      fill(this.events, ...texts.slice(-5).map((text) => el("li", {}, text)));
    }
  }

  /** Draw a window of frames. */
  draw(clock: Clock): void {
    this.shown = clock;
    const { services, frames } = clock;
    const ends = frames.flatMap(({ lanes }) => lanes.map((lane) => lane.end_ms ?? lane.work_ms ?? 0));
    const span = Math.max(1, ...ends);
    const width = LABEL + COLUMN * Math.max(frames.length, 1);
    const height = ROW * services.length + 16;
    this.cursor.setAttribute("height", String(ROW * services.length));
    const rows = services.map(({ name, role, budget_ms }, i) =>
      svg(
        "g",
        {},
        svg("title", {}, `${name}, ${role}${budget_ms ? `, budget ${budget_ms} ms` : ""}`),
        svg("text", { x: 0, y: ROW * i + 14, class: "name" }, name.length > 16 ? `${name.slice(0, 15)}…` : name),
        svg("text", { x: LABEL - 6, y: ROW * i + 14, class: "tick end" }, budget_ms ? `${budget_ms} ms` : ""),
        svg("path", { class: "axis", d: `M0 ${ROW * (i + 1)}H${width}` }),
      ),
    );
    const columns = frames.map(({ n, lanes }, column) => {
      const x = LABEL + COLUMN * column;
      const group = svg(
        "g",
        { class: "frame" },
        svg("rect", { x, y: 0, width: COLUMN, height: ROW * services.length, class: "hit" }),
        ...services.flatMap((service, i) => {
          const lane = lanes.find((each) => each.service === service.name);
          return lane ? laneMarks(lane, service.budget_ms, x + 1, ROW * i + 3, (COLUMN - 3) / span, n) : [];
        }),
        column % 5 === 0 && svg("text", { x: x + 1, y: height - 3, class: "tick" }, String(this.timeline.at(n)?.frame ?? n)),
      );
      group.addEventListener("click", () => this.go(n));
      return group;
    });
    const label = `Lanes of ${services.length} services over ${frames.length} frames; a frame is ${fixed(span, 1)} ms wide`;
    const drawing = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label }, ...rows, this.cursor, ...columns);
    drawing.style.width = `${width}px`;
    fill(this.lanes, drawing);
    const shown = clock.events ?? [];
    if (shown.length) fill(this.events, ...shown.slice(-5).map(({ n, text }) => el("li", {}, `${n}: ${text}`)));
  }

  setCursor(n: number): void {
    const column = this.shown?.frames.findIndex((frame) => frame.n === n) ?? -1;
    this.cursor.setAttribute("x", String(column < 0 ? -2 * COLUMN : LABEL + COLUMN * column));
  }

  /** Whether a place is in the window that is drawn. */
  holds(n: number): boolean {
    return this.shown?.frames.some((frame) => frame.n === n) ?? false;
  }
}

/** Bars of one service in one frame. */
function laneMarks(lane: Lane, budget: number | null, x: number, y: number, perMs: number, n: number): SVGElement[] {
  const { start_ms, end_ms, work_ms, missed, held, absent } = lane;
  const marks: SVGElement[] = [];
  const tall = ROW - 6;
  const texts = [lane.service, `place ${n}`];
  if (start_ms !== null && end_ms !== null) {
    const took = end_ms - start_ms;
    texts.push(`${fixed(took, 2)} ms from grant to answer${budget ? ` of ${budget} ms` : ""}`);
    const wide = Math.max(1.5, took * perMs);
    marks.push(svg("rect", { x: x + start_ms * perMs, y, width: wide, height: tall, fill: missed ? VERMILION : SKY }));
    if (work_ms !== null) {
      texts.push(`${fixed(work_ms, 2)} ms of work`);
      const work = Math.max(1, Math.min(took, work_ms) * perMs);
      marks.push(svg("rect", { x: x + start_ms * perMs, y: y + 4, width: work, height: tall - 8, fill: BLUE }));
    }
  } else if (work_ms !== null) {
    texts.push(`${fixed(work_ms, 2)} ms of work; when is not recorded`);
    marks.push(svg("rect", { x, y: y + 4, width: Math.max(1, work_ms * perMs), height: tall - 8, fill: BLUE }));
  }
  if (missed) texts.push("missed its budget");
  if (held) {
    texts.push("its last product was held");
    marks.push(svg("rect", { x: x + 0.5, y: y + 0.5, width: 22, height: tall - 1, fill: "none", stroke: ORANGE, "stroke-width": 2 }));
  }
  if (absent) {
    texts.push("absent");
    marks.push(svg("path", { class: "cross", d: `M${x + 7} ${y + 2}l10 10m0 -10l-10 10` }));
  }
  return marks.length ? [svg("g", {}, svg("title", {}, texts.join(", ")), ...marks)] : [];
}
