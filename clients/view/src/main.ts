// The page begins here.
import { App } from "./app";
import { el } from "./dom";
import { RequestError, Source, takeToken } from "./source";
import { askToken } from "./panels/token";
import { fromFragment, Store } from "./state";
import type { About } from "./types";

declare global {
  interface Window {
    caviar?: {
      /** What is shown. */
      state(): ReturnType<App["state"]>;
      /** Resolves when the newest frame is drawn. */
      readonly ready: Promise<void>;
      /** Where a place in the world [m] is in the window [px]. */
      project: App["project"];
      /** Show a place, and draw it: for videos. */
      go(n: number): Promise<void>;
    };
  }
}

async function start(): Promise<App> {
  takeToken();
  const source = new Source("data/", askToken);
  const about = await whenBegun(source);
  const runs = [{ about, source }];
  if (about.beside) {
    const other = new Source("beside/data/", askToken);
    runs.push({ about: await other.json<About>("about"), source: other });
  }
  const app = new App(new Store(fromFragment(location.hash)), runs);
  await app.start();
  return app;
}

/** Ask what there is, again where a run has not begun. */
async function whenBegun(source: Source): Promise<About> {
  const note = el("p", { class: "loading", role: "status" });
  document.body.append(note);
  for (;;) {
    try {
      const about = await source.json<About>("about");
      note.remove();
      return about;
    } catch (error) {
      if (!(error instanceof RequestError && error.status === 503)) throw error;
      note.textContent = `${error.reason} …`;
      await new Promise((resolve) => setTimeout(resolve, 500));
    }
  }
}

const begun = start();
let app: App | null = null;
const loaded = () => {
  if (!app) throw new Error("the page is still loading: await caviar.ready");
  return app;
};
window.caviar = {
  state: () => loaded().state(),
  project: (place) => loaded().project(place),
  get ready() {
    return begun.then(async (started) => {
      await started.ready;
      started.draw();
    });
  },
  go: async (n) => {
    const started = await begun;
    await started.go(n);
    started.draw();
  },
};
begun.then(
  (started) => (app = started),
  (error: Error) => {
    const text = error instanceof RequestError ? `${error.path}: ${error.reason}` : error.message;
    document.body.append(el("p", { class: "fatal", role: "alert" }, `This page cannot show the run. ${text}`));
    console.error(error);
  },
);
