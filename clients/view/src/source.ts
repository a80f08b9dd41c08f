// Where answers come from: the server below `data/`, or the page itself where it was saved with its data.

/** A request that was refused or failed; the text names it and the reason. */
export class RequestError extends Error {
  constructor(
    readonly path: string,
    readonly status: number,
    readonly reason: string,
  ) {
    super(`${path}: ${reason}`);
  }
}

export type Query = Record<string, string | number>;
/** Asks the reader for a token; null where the form is given up. */
export type AskToken = (reason: string) => Promise<string | null>;

const STORED = "caviar.token";
let token = "";
/** Of several requests that are refused at once, one asks. */
let asking: Promise<string | null> | null = null;

/** Take the token out of the address, where it would be copied with the link, or from this tab's storage. */
export function takeToken(): void {
  const found = /(?:^#|&)token=([^&]*)/.exec(location.hash);
  if (found) {
    store(decodeURIComponent(found[1]));
    const rest = location.hash.replace(found[0], "").replace(/^[#&]*/, "");
    replaceFragment(rest);
  } else {
    try {
      token = sessionStorage.getItem(STORED) ?? "";
    } catch {
      // Pages from a file may have no storage.
    }
  }
}

/** Write the fragment of the address, without another entry in the history. */
export function replaceFragment(fragment: string): void {
  try {
    history.replaceState(null, "", `#${fragment}`);
  } catch {
    // A page within a notebook has no address of its own.
  }
}

function store(value: string): void {
  token = value;
  try {
    sessionStorage.setItem(STORED, value);
  } catch {
    // The token lasts as long as the page.
  }
}

/** Whether the answers come from the machine that the browser runs on. */
export function isOnThisMachine(): boolean {
  return /^(localhost|127\.[\d.]+|\[::1\])$/.test(location.hostname);
}

function readSaved(): Record<string, string> | null {
  const element = document.getElementById("saved");
  return element?.textContent ? (JSON.parse(element.textContent) as Record<string, string>) : null;
}
let saved: Record<string, string> | null | undefined;

/** Whether the page holds its data itself. */
export function isSaved(): boolean {
  saved ??= readSaved();
  return saved !== null;
}

/** Place of an answer in a saved page: lobes are those of all frames, users have curves of their own, and lanes stand
 * by their first frame. */
function savedKey(path: string, query: Query): string {
  if (path.endsWith("/lobes")) return `lobes/${query.device}/${query.beam}`;
  if (path === "clock") return `clock/${query.first}`;
  return path === "curves" ? `curves/${query.user ?? 0}` : path;
}

export class Source {
  /**
   * @param base relative to the page: `data/`, or `beside/data/` of a second run
   * @param askToken called where the server wants a token
   */
  constructor(
    private readonly base: string,
    private readonly askToken: AskToken,
  ) {}

  /** Content of `path` as bytes. */
  async bytes(path: string, query: Query = {}, signal?: AbortSignal): Promise<ArrayBuffer> {
    if (isSaved()) {
      const text = saved?.[this.base.replace(/data\/$/, "") + savedKey(path, query)];
      if (text === undefined) throw new RequestError(path, 404, "not in this saved page");
      return await unpacked(text);
    }
    return await (await this.request(path, query, signal)).arrayBuffer();
  }

  /** Content of `path` as JSON. */
  async json<T>(path: string, query: Query = {}, signal?: AbortSignal): Promise<T> {
    return JSON.parse(new TextDecoder().decode(await this.bytes(path, query, signal))) as T;
  }

  /** Answer of the server; one that is refused is an error. */
  async request(path: string, query: Query = {}, signal?: AbortSignal, method = "GET"): Promise<Response> {
    const url = new URL(method === "GET" ? this.base + path : path, document.baseURI);
    for (const [name, value] of Object.entries(query)) url.searchParams.set(name, String(value));
    for (;;) {
      const used = token;
      const headers: Record<string, string> = used ? { Authorization: `Bearer ${used}` } : {};
      let answer: Response;
      try {
        answer = await fetch(url, { method, headers, signal: signal ?? null, credentials: "omit" });
      } catch (error) {
        if (signal?.aborted) throw error;
        throw new RequestError(path, 0, "the server does not answer");
      }
      if (answer.ok) return answer;
      const reason = await detail(answer);
      if (answer.status !== 401) throw new RequestError(path, answer.status, reason);
      if (used === token) {
        asking ??= this.askToken(used ? reason : "This run is protected by a token.").finally(() => {
          asking = null;
        });
        const given = await asking;
        if (given === null) throw new RequestError(path, 401, reason);
        store(given);
      }
    }
  }

  /** Events of the server as they come, until the signal. */
  async *events<T>(path: string, query: Query, signal: AbortSignal): AsyncGenerator<T> {
    const answer = await this.request(path, query, signal);
    const reader = answer.body?.pipeThrough(new TextDecoderStream()).getReader();
    let held = "";
    for (;;) {
      const { value, done } = (await reader?.read()) ?? { value: undefined, done: true };
      if (done || value === undefined) return;
      held += value;
      const events = held.split(/\r?\n\r?\n/);
      held = events.pop() ?? "";
      for (const event of events) {
        const lines = event.split(/\r?\n/).filter((line) => line.startsWith("data:"));
        if (lines.length) yield JSON.parse(lines.map((line) => line.slice(5)).join("\n")) as T;
      }
    }
  }
}

async function detail(answer: Response): Promise<string> {
  const text = await answer.text();
  try {
    const found = (JSON.parse(text) as { detail?: unknown }).detail;
    if (typeof found === "string") return found;
  } catch {
    // No JSON: the status says it.
  }
  return `${answer.status} ${answer.statusText}`.trim();
}

async function unpacked(text: string): Promise<ArrayBuffer> {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return await new Response(stream).arrayBuffer();
}
