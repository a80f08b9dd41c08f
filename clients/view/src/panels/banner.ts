// Errors, where the reader sees them.
import { button, el } from "../dom";

export class Banner {
  private readonly text = el("span", {});
  readonly element = el(
    "div",
    { class: "banner", role: "alert", hidden: true },
    this.text,
    button("close", "Dismiss", () => this.clear()),
  );

  show(text: string): void {
    this.text.textContent = text;
    this.element.hidden = false;
  }

  clear(): void {
    this.element.hidden = true;
  }
}
