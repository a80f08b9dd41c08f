// Elements and numbers for people. Texts of a run become text nodes, never markup.

type Attributes = Record<string, string | number | boolean | ((event: never) => void) | null | undefined>;
type Content = Node | string | null | undefined | false;

/** Make an element; functions among the attributes are listeners, `false` and null leave one out. */
export function el<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Attributes = {},
  ...content: Content[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(name, value as EventListener);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, String(value));
  }
  append(element, content);
  return element;
}

/** Make an element of a drawing. */
export function svg(tag: string, attributes: Record<string, string | number> = {}, ...content: Content[]): SVGElement {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, String(value));
  append(element, content);
  return element;
}

function append(element: Element, content: Content[]): void {
  element.append(...content.filter((item): item is Node | string => Boolean(item)));
}

/** Replace all that an element holds. */
export function fill(element: Element, ...content: Content[]): void {
  element.replaceChildren();
  append(element, content);
}

const ICONS = {
  play: "M7 4v16l13-8z",
  pause: "M6 4h4v16H6zM14 4h4v16h-4z",
  first: "M5 4h3v16H5zM20 4v16L9 12z",
  last: "M16 4h3v16h-3zM4 4v16l11-8z",
  back: "M8 4h3v16H8zM20 4v16l-8-8z",
  next: "M13 4h3v16h-3zM4 4v16l8-8z",
  loop: "M17 3l4 4-4 4V8H7a3 3 0 0 0-3 3v1H2v-1a5 5 0 0 1 5-5h10zM7 21l-4-4 4-4v3h10a3 3 0 0 0 3-3v-1h2v1a5 5 0 0 1-5 5H7z",
  stop: "M5 5h14v14H5z",
  theme: "M12 3a9 9 0 1 0 0 18zM12 3a9 9 0 0 1 0 18",
  close: "M6 4.6 12 10.6l6-6L19.4 6l-6 6 6 6-1.4 1.4-6-6-6 6L4.600 18l6-6-6-6z",
  home: "M12 3 2 12h3v9h5v-6h4v6h5v-9h3z",
  panel: "M3 5h18v14H3zm2 2v10h4V7z",
} as const;
export type Icon = keyof typeof ICONS;

/** A drawn sign, hidden from screen readers. */
export function icon(name: Icon): SVGElement {
  return svg("svg", { viewBox: "0 0 24 24", "aria-hidden": "true", class: "icon" }, svg("path", { d: ICONS[name] }));
}

/** A button with a sign; its label is also its tooltip. */
export function button(sign: Icon | null, label: string, action: () => void, text = ""): HTMLButtonElement {
  return el("button", { type: "button", "aria-label": label, title: label, click: action }, sign && icon(sign), text);
}

/** A choice among few. */
export function choice<T extends string>(
  label: string,
  values: Readonly<Record<T, string>>,
  chosen: T,
  action: (value: T) => void,
): HTMLSelectElement {
  const select = el("select", { "aria-label": label, title: label });
  for (const [value, text] of Object.entries<string>(values)) {
    select.append(el("option", { value, selected: value === chosen }, text));
  }
  select.addEventListener("change", () => action(select.value as T));
  return select;
}

const PREFIXES: [number, string][] = [
  [1e12, "T"],
  [1e9, "G"],
  [1e6, "M"],
  [1e3, "k"],
  [1, ""],
  [1e-3, "m"],
  [1e-6, "µ"],
  [1e-9, "n"],
  [1e-12, "p"],
];

/** A number with a prefix of its unit, as 1.08 Gbit/s; of unit 1 as 1.2e-5. */
export function si(value: number | null | undefined, unit: string, digits = 3): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (unit === "1") return value !== 0 && Math.abs(value) < 0.01 ? value.toExponential(digits - 1) : trim(value, digits);
  if (value === 0) return `0 ${unit}`;
  if (unit === "dB" || unit === "°" || unit === "dBm") return `${fixed(value, 1)} ${unit}`;
  const [factor, prefix] = PREFIXES.find(([f]) => Math.abs(value) >= f * 0.9995) ?? PREFIXES[PREFIXES.length - 1];
  return `${trim(value / factor, digits)} ${prefix}${unit}`;
}

function trim(value: number, digits: number): string {
  return minus(String(Number(value.toPrecision(digits))));
}

/** A number with so many decimals, and a true minus sign. */
export function fixed(value: number, decimals: number): string {
  const text = value.toFixed(decimals);
  return minus(Number(text) === 0 ? text.replace("-", "") : text);
}

function minus(text: string): string {
  return text.replace("-", "−");
}

export const degrees = (radians: number): number => (radians * 180) / Math.PI;
