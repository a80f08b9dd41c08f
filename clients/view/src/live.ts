// A run that goes on: news of its frames, and commands to it.
import type { Source } from "./source";
import type { News } from "./types";

const AGAIN_MS = 1000;

export class Live {
  /** Of the run, as last heard. */
  news: News | null = null;
  private readonly stopped = new AbortController();

  constructor(
    private readonly source: Source,
    /** [s] between news at least. */
    private readonly every: number,
    private readonly onNews: (news: News) => void,
    private readonly onEnd: (reason: string) => void,
    private readonly onError: (text: string) => void,
  ) {}

  /** Listen until the run ends; a connection that breaks is made anew. */
  async listen(): Promise<void> {
    const { signal } = this.stopped;
    let failures = 0;
    while (!signal.aborted) {
      try {
        for await (const news of this.source.events<News>("news", { every: this.every }, signal)) {
          failures = 0;
          if (news.ended !== undefined) {
            this.onEnd(news.ended);
            return;
          }
          this.news = news;
          this.onNews(news);
        }
      } catch (error) {
        if (signal.aborted) return;
        if (++failures === 3) this.onError(`The run is not heard of any more. ${(error as Error).message}`);
        if (failures > 30) return;
      }
      await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
    }
  }

  /** Pause, resume, step or stop the run. */
  async command(name: "pause" | "resume" | "step" | "stop"): Promise<void> {
    try {
      // The routes of the broker stand beside the page's folder.
      await this.source.request(`../${name}`, name === "step" ? { frames: 1 } : {}, undefined, "POST");
    } catch (error) {
      this.onError((error as Error).message.replace("../", ""));
    }
  }

  close(): void {
    this.stopped.abort();
  }
}
