// The top of the page: which run it is, and what holds for all of the page.
import { button, el } from "../dom";
import type { Store } from "../state";
import type { About } from "../types";

const KINDS = { recording: "Recording", run: "Live run", scenario: "Scenario, not run" } as const;

export class Header {
  readonly element: HTMLElement;

  /** @param slow whether a live run is shown by a picture in some seconds */
  constructor(store: Store, abouts: About[], saved: boolean, slow: boolean, goHome: () => void, help: () => void) {
    const [about] = abouts;
    const title = about.name || about.run;
    document.title = `${title} – CAVIAR`;
    const breaks = about.kind === "recording" && !about.complete ? ", breaks off" : "";
    const every = about.every > 1 ? `, every ${about.every} frames one` : "";
    const pace = slow && about.live ? ", a picture in 5 s: no graphics card" : "";
    const names = abouts.map(({ run }) => run).filter(Boolean);
    this.element = el(
      "header",
      { class: "bar" },
      el("h1", {}, title),
      el("span", { class: "badge" }, `${saved ? "Saved recording" : KINDS[about.kind]}${breaks}${every}${pace}`),
      el("span", { class: "run" }, names.length > 1 ? `left ${names[0]}, right ${names[1]}` : (names[0] ?? "")),
      el("span", { class: "grow" }),
      button("panel", "Panel of layers (P)", () => store.set({ panel: !store.state.panel })),
      button("home", "Show all (H)", goHome),
      button("theme", "Light or dark (D)", () => toggleTheme(store)),
      button(null, "Help (?)", help, "?"),
    );
  }
}

/** Light becomes dark, and dark light. */
export function toggleTheme(store: Store): void {
  store.set({ theme: document.documentElement.dataset.theme === "dark" ? "light" : "dark" });
}
