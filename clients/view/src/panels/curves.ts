// Curves of a user over the frames, with a cursor at the frame that is shown; a click goes to another one.
import { BEST, CHOSEN, STRAIGHT } from "../colors";
import { el, fill, si, svg } from "../dom";
import type { Timeline } from "../timeline";
import type { Curves } from "../types";

interface Line {
  series: string;
  name: string;
  color: string;
}
/** Charts, and the series of each. */
const CHARTS: { title: string; unit: string; lines: Line[]; transform?: (value: number) => number | null }[] = [
  {
    title: "|y|²",
    unit: "dB",
    transform: (value) => (value > 0 ? 20 * Math.log10(value) : null),
    lines: [
      { series: "best_abs_y", name: "best", color: BEST },
      { series: "baseline_abs_y", name: "straight line", color: STRAIGHT },
      { series: "abs_y", name: "chosen", color: CHOSEN },
    ],
  },
  {
    title: "SNR",
    unit: "dB",
    lines: [
      { series: "snr_best_db", name: "best", color: BEST },
      { series: "sinr_db", name: "SINR", color: STRAIGHT },
      { series: "snr_db", name: "chosen", color: CHOSEN },
    ],
  },
  {
    title: "Rate",
    unit: "bit/s",
    lines: [
      { series: "bit_rate", name: "bit rate", color: CHOSEN },
      { series: "throughput", name: "throughput", color: STRAIGHT },
    ],
  },
  { title: "Buffer", unit: "bit", lines: [{ series: "buffered", name: "buffered", color: CHOSEN }] },
  { title: "Delay", unit: "s", lines: [{ series: "delay", name: "delay", color: CHOSEN }] },
  { title: "Reward", unit: "1", lines: [{ series: "reward", name: "reward", color: CHOSEN }] },
];

const WIDTH = 300;
const HEIGHT = 108;
const [LEFT, RIGHT, TOP, BOTTOM] = [62, 6, 6, 16];

export class CurvesPanel {
  readonly element = el("div", { class: "charts" });
  private cursors: { line: SVGElement; text: HTMLElement; at: (n: number) => string }[] = [];
  private x: (n: number) => number = () => 0;

  constructor(
    private readonly timeline: Timeline,
    private readonly go: (n: number) => void,
  ) {}

  /** Draw the curves; those of a second run are dashed. */
  draw(curves: Curves, other: Curves | null): void {
    const [first, last] = [this.timeline.first, Math.max(this.timeline.last, this.timeline.first + 1)];
    this.x = (n) => LEFT + ((n - first) / (last - first)) * (WIDTH - LEFT - RIGHT);
    this.cursors = [];
    const charts = CHARTS.flatMap((chart) => {
      const lines = chart.lines.filter(({ series }) => curves.series[series]);
      return lines.length ? [this.chart(chart, lines, curves, other, first, last)] : [];
    });
    const note = other && el("p", { class: "note" }, "dashed: the run on the right");
    if (charts.length) fill(this.element, ...charts, note);
    else this.say("This run has no link whose curves could be shown.");
  }

  say(text: string): void {
    this.cursors = [];
    fill(this.element, el("p", { class: "note" }, text));
  }

  /** Put the cursor at a place. */
  setCursor(n: number): void {
    for (const { line, text, at } of this.cursors) {
      const x = String(this.x(n));
      line.setAttribute("x1", x);
      line.setAttribute("x2", x);
      text.textContent = at(n);
    }
  }

  private chart(
    { title, unit, transform }: (typeof CHARTS)[number],
    lines: Line[],
    curves: Curves,
    other: Curves | null,
    first: number,
    last: number,
  ): HTMLElement {
    const values = (from: Curves, series: string) =>
      (from.series[series]?.values ?? []).map((value) => (value === null ? null : transform ? transform(value) : value));
    const drawn = lines.flatMap((line) => [
      { ...line, values: values(curves, line.series), n: curves.n, dashed: false },
      ...(other ? [{ ...line, values: values(other, line.series), n: other.n, dashed: true }] : []),
    ]);
    const all = drawn.flatMap((line) => line.values).filter((value) => value !== null);
    let [low, high] = all.length ? [Math.min(...all), Math.max(...all)] : [0, 1];
    // Curves that do not change lie in the middle, those of zeros at the bottom.
    if (high === 0 && low === 0) high = 1;
    else if (high - low < 1e-9 * Math.abs(high)) [low, high] = [low - 0.5 * Math.abs(low), high + 0.5 * Math.abs(high)];
    const y = (value: number) => TOP + ((high - value) / (high - low)) * (HEIGHT - TOP - BOTTOM);
    const cursor = svg("line", { class: "cursor", y1: TOP, y2: HEIGHT - BOTTOM });
    const time = (n: number) => `${(this.timeline.at(n)?.t_s ?? 0).toFixed(1)} s`;
    const drawing = svg(
      "svg",
      { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": `${title} over time` },
      svg("path", { class: "axis", d: `M${LEFT} ${TOP}V${HEIGHT - BOTTOM}H${WIDTH - RIGHT}` }),
      svg("text", { x: LEFT - 4, y: TOP + 8, class: "tick end" }, si(high, unit)),
      svg("text", { x: LEFT - 4, y: HEIGHT - BOTTOM, class: "tick end" }, si(low, unit)),
      svg("text", { x: LEFT, y: HEIGHT - 4, class: "tick" }, time(first)),
      svg("text", { x: WIDTH - RIGHT, y: HEIGHT - 4, class: "tick end" }, time(last)),
      ...drawn.map((line) =>
        svg("path", { class: line.dashed ? "curve dashed" : "curve", stroke: line.color, d: this.path(line.n, line.values, y) }),
      ),
      cursor,
    );
    drawing.addEventListener("click", (event) => {
      const box = drawing.getBoundingClientRect();
      const x = ((event.clientX - box.left) / box.width) * WIDTH;
      this.go(first + ((x - LEFT) / (WIDTH - LEFT - RIGHT)) * (last - first));
    });
    const text = el("span", { class: "value" });
    const shown = lines.find(({ name }) => name === "chosen") ?? lines[0];
    const list = values(curves, shown.series);
    this.cursors.push({ line: cursor, text, at: (n) => si(list[nearest(curves.n, n)], unit) });
    const keys = lines.map(({ name, color }) => {
      const key = el("span", { class: "key" }, name);
      key.style.borderColor = color;
      return key;
    });
    return el("section", { class: "chart" }, el("div", { class: "head" }, el("h2", {}, title, " ", text), el("span", {}, ...keys)), drawing);
  }

  /** Lines that break where there is no value, and between episodes. */
  private path(places: number[], values: (number | null)[], y: (value: number) => number): string {
    let d = "";
    let pen = false;
    let episode: number | undefined;
    places.forEach((n, i) => {
      const value = values[i];
      const now = this.timeline.at(n)?.episode;
      if (value === null || value === undefined || now !== episode) pen = false;
      episode = now;
      if (value === null || value === undefined) return;
      d += `${pen ? "L" : "M"}${this.x(n).toFixed(1)} ${y(value).toFixed(1)}`;
      // A value alone is a dot.
      if (!pen) d += "h0.01";
      pen = true;
    });
    return d;
  }
}

/** Index of the place that is the nearest one; places ascend. */
function nearest(places: number[], n: number): number {
  let best = 0;
  places.forEach((place, i) => {
    if (Math.abs(place - n) < Math.abs(places[best] - n)) best = i;
  });
  return best;
}
