// Time: play, pause, step, scrub, speed, loop; follow a live run or look back.
import { button, choice, el, fill, icon } from "../dom";
import { SPEEDS, type Store } from "../state";
import type { Timeline } from "../timeline";

export interface TransportActions {
  go(n: number): void;
  step(by: number): void;
  togglePlay(): void;
  follow(): void;
}

export class Transport {
  readonly element: HTMLElement;
  private readonly play: HTMLButtonElement;
  private readonly loop: HTMLButtonElement;
  private readonly live: HTMLButtonElement | null;
  private readonly slider = el("input", { type: "range", step: 1, "aria-label": "Frame", class: "scrub" });
  private readonly text = el("output", { class: "time" });
  private readonly speed: HTMLSelectElement;
  private playing: boolean | null = null;

  constructor(
    store: Store,
    private readonly timeline: Timeline,
    isLive: boolean,
    tabs: HTMLElement[],
    actions: TransportActions,
  ) {
    this.play = button("play", "Play (space)", actions.togglePlay);
    this.loop = button("loop", "Loop (L)", () => store.set({ loop: !store.state.loop }));
    this.live = isLive ? button(null, "Follow the run", actions.follow, "Live") : null;
    this.live?.classList.add("live");
    this.slider.addEventListener("input", () => actions.go(Number(this.slider.value)));
    const speeds = Object.fromEntries(SPEEDS.map((value) => [String(value), `${value}×`]));
    // Keys of objects that look like whole numbers come first: the list is sorted by hand.
    this.speed = choice("Speed", speeds, String(store.state.speed), (value) => store.set({ speed: Number(value) }));
    fill(this.speed, ...SPEEDS.map((value) => el("option", { value }, `${value}×`)));
    this.element = el(
      "footer",
      { class: "transport", "aria-label": "Time" },
      button("first", "First frame (Home)", () => actions.go(timeline.first)),
      button("back", "One frame back (←)", () => actions.step(-1)),
      this.play,
      button("next", "One frame on (→)", () => actions.step(1)),
      button("last", "Last frame (End)", () => actions.go(timeline.last)),
      this.slider,
      this.text,
      this.speed,
      this.loop,
      this.live,
      ...tabs,
    );
  }

  update(n: number, playing: boolean, following: boolean, state: { loop: boolean; speed: number }): void {
    const { timeline } = this;
    const instant = timeline.at(n);
    this.slider.min = String(timeline.first);
    this.slider.max = String(Math.max(timeline.first, timeline.last));
    this.slider.value = String(n);
    const episodes = timeline.episodes.length > 1 ? `episode ${instant?.episode ?? 0}, ` : "";
    const text = instant ? `${episodes}frame ${instant.frame} · ${instant.t_s.toFixed(2)} s` : "no frame";
    this.text.textContent = text;
    this.slider.setAttribute("aria-valuetext", text);
    if (playing !== this.playing) {
      this.playing = playing;
      fill(this.play, icon(playing ? "pause" : "play"));
      this.play.title = playing ? "Pause (space)" : "Play (space)";
      this.play.setAttribute("aria-label", this.play.title);
    }
    this.loop.setAttribute("aria-pressed", String(state.loop));
    this.speed.value = String(state.speed);
    this.live?.setAttribute("aria-pressed", String(following));
  }
}
