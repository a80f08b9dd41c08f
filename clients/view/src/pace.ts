// How often a page that follows a run draws, where the processor draws: the run needs it, too.

/** Time of rest after a picture, in times of the picture. */
const REST = 30;
const MOST_REST_MS = 5000;
/** [s] between news of the run at least, each of which redraws parts of the page: where the processor draws, and else. */
const NEWS_EVERY = { shared: 1, own: 0.1 };

export class Pace {
  private wake = (): void => undefined;
  private busy = true;

  /** @param sharesProcessor whether pictures take the time of a processor that the run may need */
  constructor(private readonly sharesProcessor: boolean) {}

  /** [s] between news of the run at least. */
  get newsEvery(): number {
    return this.sharesProcessor ? NEWS_EVERY.shared : NEWS_EVERY.own;
  }

  /** Whether a picture is followed by a rest. */
  get rests(): boolean {
    return this.sharesProcessor && this.busy;
  }

  /** Rest after a picture that took so long [ms], or until the run does. */
  async rest(took: number): Promise<void> {
    await new Promise<void>((resolve) => setTimeout((this.wake = resolve), Math.min(REST * took, MOST_REST_MS)));
  }

  /** A run that is paused or over leaves the processor to the page. */
  setBusy(busy: boolean): void {
    this.busy = busy;
    if (!busy) this.wake();
  }
}
