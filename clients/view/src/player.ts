// Playing: one frame after the other as fast as time says, or as fast as they come.
import type { Store } from "./state";
import type { Timeline } from "./timeline";

export class Player {
  playing = false;
  private turn = 0;

  /** @param show shows a place, and resolves when it is there */
  constructor(
    private readonly timeline: Timeline,
    private readonly store: Store,
    private readonly show: (n: number) => Promise<void>,
    private readonly onChange: () => void,
  ) {}

  toggle(): void {
    if (this.playing) this.stop();
    else void this.run();
  }

  stop(): void {
    this.turn++;
    if (!this.playing) return;
    this.playing = false;
    this.onChange();
  }

  private async run(): Promise<void> {
    const turn = ++this.turn;
    this.playing = true;
    this.onChange();
    const { timeline } = this;
    let n = timeline.snap(this.store.state.n ?? timeline.first);
    // From the end it begins anew.
    if (n === timeline.last) await this.show((n = timeline.first));
    let shown = performance.now();
    let steps = 1;
    while (turn === this.turn) {
      const { loop, speed } = this.store.state;
      const next = timeline.step(n, steps, loop);
      if (next === n) break;
      n = next;
      await this.show(n);
      const interval = Math.max(10, (1000 * (timeline.every * timeline.period)) / speed);
      const took = performance.now() - shown;
      // Frames that come slower than time goes are skipped, so that the speed is the one that is asked for.
      steps = Math.max(1, Math.round(took / interval));
      await new Promise((resolve) => setTimeout(resolve, Math.max(0, steps * interval - took)));
      shown = performance.now();
    }
    if (turn === this.turn) this.stop();
  }
}
