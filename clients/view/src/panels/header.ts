// The top of the page: which run it is, and what holds for all of the page.
import { button, el } from "../dom";
import type { Store } from "../state";
import type { About } from "../types";

const KINDS = { recording: "Recording", run: "Live run", scenario: "Scenario, not run" } as const;

export class Header {
  readonly element: HTMLElement;

  constructor(store: Store, abouts: About[], goHome: () => void) {
    const [about] = abouts;
    const names = abouts.map(({ name, run }) => run || name).join(" | ");
    document.title = `${about.name || about.run} – CAVIAR`;
    const badge = KINDS[about.kind] + (about.complete || about.kind !== "recording" ? "" : ", breaks off");
    this.element = el(
      "header",
      { class: "bar" },
      el("h1", {}, about.name || about.run),
      el("span", { class: "badge" }, badge),
      el("span", { class: "run" }, names === about.name ? "" : names),
      el("span", { class: "grow" }),
      button("home", "Show all (H)", goHome),
      button("theme", "Light or dark (D)", () => toggleTheme(store)),
    );
  }
}

/** Light becomes dark, and dark light. */
export function toggleTheme(store: Store): void {
  store.set({ theme: document.documentElement.dataset.theme === "dark" ? "light" : "dark" });
}
