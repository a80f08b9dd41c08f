// Places of frames in time: which frame of which episode stands at a place, and which places there are.
import type { Block } from "./types";

export interface Instant {
  episode: number;
  frame: number;
  /** From the beginning of the episode [s]. */
  t_s: number;
}

export class Timeline {
  /**
   * @param blocks consecutive frames, in ascending order
   * @param period sampling period [s]
   * @param every only places that are a multiple of it, from the first on, are there
   */
  constructor(
    private blocks: Block[],
    readonly period: number,
    readonly every = 1,
  ) {}

  /** First place. */
  get first(): number {
    return this.blocks[0]?.first ?? 0;
  }

  /** Last place that is there; before the first where there is none. */
  get last(): number {
    const block = this.blocks.at(-1);
    const last = block ? block.first + block.count - 1 : this.first - 1;
    return last - ((last - this.first) % this.every);
  }

  /** Number of places. */
  get count(): number {
    return Math.floor((this.last - this.first) / this.every) + 1;
  }

  /** Frame at a place; null where there is none. */
  at(n: number): Instant | null {
    const block = this.blocks.find(({ first, count }) => n >= first && n < first + count);
    if (!block) return null;
    const frame = block.first_frame + (n - block.first);
    return { episode: block.episode, frame, t_s: frame * this.period };
  }

  /** Place of a frame; null where it is not there. */
  find(episode: number, frame: number): number | null {
    for (const block of this.blocks) {
      const offset = frame - block.first_frame;
      if (block.episode === episode && offset >= 0 && offset < block.count) {
        const n = block.first + offset;
        return (n - this.first) % this.every === 0 ? n : null;
      }
    }
    return null;
  }

  /** The nearest place that is there. */
  snap(n: number): number {
    const steps = Math.round((n - this.first) / this.every);
    return Math.max(this.first, Math.min(this.last, this.first + steps * this.every));
  }

  /** The place so many steps further; past an end the end, or round where it loops. */
  step(n: number, by: number, loop = false): number {
    const place = Math.round((n - this.first) / this.every) + by;
    const count = Math.max(1, this.count);
    const held = loop ? ((place % count) + count) % count : Math.max(0, Math.min(count - 1, place));
    return this.first + held * this.every;
  }

  /** First places of episodes. */
  get episodes(): { episode: number; first: number }[] {
    return this.blocks
      .filter((block, i) => block.episode !== this.blocks[i - 1]?.episode)
      .map(({ episode, first }) => ({ episode, first }));
  }

  /** Take in that a live run went on by `added`, and that places before `first` are no longer held. */
  grow(first: number, added: Block[]): void {
    for (const block of added) {
      const last = this.blocks.at(-1);
      const end = last ? last.first + last.count : block.first;
      if (block.first + block.count <= end) continue;
      const known = Math.max(0, end - block.first);
      const rest = { ...block, first: block.first + known, first_frame: block.first_frame + known, count: block.count - known };
      const goesOn = last?.episode === rest.episode && last.first_frame + last.count === rest.first_frame && end === rest.first;
      if (last && goesOn) last.count += rest.count;
      else this.blocks.push(rest);
    }
    this.blocks = this.blocks
      .filter((block) => block.first + block.count > first)
      .map((block) => {
        const gone = Math.max(0, first - block.first);
        return { ...block, first: block.first + gone, first_frame: block.first_frame + gone, count: block.count - gone };
      });
  }

  /** Replace what is known of the frames. */
  reset(blocks: Block[]): void {
    this.blocks = blocks;
  }
}
