// Frames as they are decoded, the newest asked for first, a bounded number of bytes of them kept.
import { decodeProduct } from "./decode";
import type { Query, Source } from "./source";
import type { FrameInfo, Product, Topic } from "./types";

/** Topics that a view asks for, with the source where several produce it, and how much of it. */
export interface Want {
  topic: Topic;
  source?: string;
  query?: Query;
}

export interface Frame {
  n: number;
  info: FrameInfo;
  products: Partial<{ [T in Topic]: Product<T>[] }>;
  /** Topics that were wanted and are not there, and why; some since a request failed. */
  absent: { topic: Topic; source: string; reason: string; failed?: boolean }[];
}

/** The first product of a topic of a frame. */
export function first<T extends Topic>(frame: Frame | null, topic: T): Product<T>["payload"] | null {
  return frame?.products[topic]?.[0]?.payload ?? null;
}

interface Kept {
  value: unknown;
  bytes: number;
}
const MOST_BYTES = 192e6;

export class Frames {
  private readonly kept = new Map<string, Kept>();
  private bytes = 0;

  constructor(private readonly source: Source) {}

  /** Load a frame; a product that fails is absent with its reason, a frame that fails is an error. */
  async load(n: number, wants: Want[], signal?: AbortSignal): Promise<Frame> {
    const info = await this.cached(`frames/${n}`, {}, signal, (content) =>
      JSON.parse(new TextDecoder().decode(content)) as FrameInfo,
    );
    const frame: Frame = { n, info, products: {}, absent: [] };
    // What is known to be absent is not asked for: its refusal would be an error in the browser's console.
    const asked = wants.flatMap((want) => {
      const inputs = info.inputs.filter((i) => i.topic === want.topic && (!want.source || i.source === want.source));
      const there = inputs.filter(({ status }) => status === "fresh" || status === "held");
      for (const { source, status, cause } of inputs) {
        if (!there.some((input) => input.source === source))
          frame.absent.push({ topic: want.topic, source, reason: cause || status });
      }
      if (!inputs.length) frame.absent.push({ topic: want.topic, source: want.source ?? "", reason: "not recorded" });
      // Scenes of several worlds come as one.
      if (want.topic === "scene") return there.length ? [{ ...want, source: "" }] : [];
      return there.map(({ source }) => ({ ...want, source }));
    });
    await Promise.all(asked.map((want) => this.loadProduct(frame, want, signal)));
    for (const list of Object.values(frame.products)) list.sort((a, b) => (a.source < b.source ? -1 : 1));
    return frame;
  }

  private async loadProduct(frame: Frame, { topic, source, query }: Want, signal?: AbortSignal): Promise<void> {
    const asked = { ...query, ...(source ? { source } : {}) };
    try {
      const product = await this.cached(`frames/${frame.n}/${topic}`, asked, signal, (content) =>
        decodeProduct(topic, content),
      );
      const list = (frame.products[topic] ??= []) as Product<Topic>[];
      list.push(product);
    } catch (error) {
      if (signal?.aborted) throw error;
      frame.absent.push({ topic, source: source ?? "", reason: (error as Error).message, failed: true });
    }
  }

  private async cached<T>(
    path: string,
    query: Query,
    signal: AbortSignal | undefined,
    read: (content: ArrayBuffer) => T,
  ): Promise<T> {
    const key = `${path}?${JSON.stringify(query)}`;
    const found = this.kept.get(key);
    if (found) {
      // Used last: the oldest stand first.
      this.kept.delete(key);
      this.kept.set(key, found);
      return found.value as T;
    }
    const content = await this.source.bytes(path, query, signal);
    const value = read(content);
    this.kept.set(key, { value, bytes: content.byteLength + 1000 });
    this.bytes += content.byteLength + 1000;
    for (const [old, { bytes }] of this.kept) {
      if (this.bytes <= MOST_BYTES) break;
      this.kept.delete(old);
      this.bytes -= bytes;
    }
    return value;
  }
}
