// What keys and the mouse do.
import { el } from "../dom";
import type { KeyAction } from "../keys";

const MOUSE: [string, string][] = [
  ["drag", "turn around what is looked at"],
  ["right drag, or Ctrl drag", "move over the ground"],
  ["wheel", "nearer, farther"],
  ["click", "numbers of an object, a path, a device or a building"],
];

/** Show the help. */
export function showHelp(actions: KeyAction[]): void {
  const rows = (pairs: [string, string][]) => pairs.flatMap(([key, text]) => [el("dt", {}, el("kbd", {}, key)), el("dd", {}, text)]);
  const dialog = el(
    "dialog",
    { class: "dialog help", "aria-label": "Help" },
    el("h2", {}, "Keys"),
    el("dl", {}, ...rows(actions.map(({ shown, text }) => [shown, text]))),
    el("h2", {}, "Mouse"),
    el("dl", {}, ...rows(MOUSE)),
    el(
      "p",
      { class: "note" },
      "x is east, y north, z up. The address of this page holds the view: a link to it shows the same. " +
        "Objects that fly are drawn at least 30 pixels wide; their positions are exact.",
    ),
    el("form", { method: "dialog", class: "actions" }, el("button", { class: "primary" }, "Close")),
  );
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}
