// A form that asks for the run's token.
import { el } from "../dom";

/** Ask for a token; null where the form is closed without one. */
export function askToken(reason: string): Promise<string | null> {
  return new Promise((resolve) => {
    const field = el("input", { type: "password", id: "token", autocomplete: "off", spellcheck: "false", required: true });
    const form = el(
      "form",
      { method: "dialog" },
      el("h2", {}, "Token"),
      el("p", {}, reason),
      el("label", { for: "token" }, "Token of this run"),
      field,
      el("div", { class: "actions" }, el("button", { type: "submit", class: "primary" }, "Open")),
    );
    const dialog = el("dialog", { class: "dialog", "aria-label": "Token" }, form);
    let given: string | null = null;
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      given = field.value.trim();
      dialog.close();
    });
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(given || null);
    });
    document.body.append(dialog);
    dialog.showModal();
  });
}
