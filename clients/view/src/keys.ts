// Keys of the page. They act unless a field that takes text or arrows has the focus.

export interface KeyAction {
  keys: string[];
  /** As the help calls the keys, and what they do. */
  shown: string;
  text: string;
  action: () => void;
}

/** Listen to keys. */
export function listenToKeys(actions: KeyAction[]): void {
  const known = new Map(actions.flatMap((action) => action.keys.map((key) => [key, action.action])));
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    const target = event.target as HTMLElement;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const isArrow = key.startsWith("Arrow") || key === "Home" || key === "End";
    if (target.matches("select, input:not([type=range]):not([type=checkbox])") && key !== "Escape") return;
    // Sliders have arrows, buttons and boxes the space key.
    if (isArrow && target.matches("input[type=range]")) return;
    if (key === " " && target.matches("button, input[type=checkbox], summary")) return;
    const action = known.get(event.shiftKey && isArrow ? `Shift+${key}` : key);
    if (!action) return;
    event.preventDefault();
    action();
  });
}
