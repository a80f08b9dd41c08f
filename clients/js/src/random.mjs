// Random numbers that follow from a seed and nothing else (SPEC.md, clause 19).
import { sha256 } from "./sha256.mjs";

/**
 * A generator of random numbers; equal keys give equal numbers.
 *
 * @param {...(string | number | bigint)} keys  such as the seed, the episode and the frame
 * @returns {() => number} the next number, from 0 to below 1
 * @example const random = generator(seed, episode, "wind"); const gust = 3 * random();
 */
export function generator(...keys) {
  const digest = sha256(new TextEncoder().encode(keys.map(String).join("\0")));
  let [a, b, c, d] = [0, 8, 16, 24].map((at) => parseInt(digest.slice(at, at + 8), 16) | 0);
  // sfc32 of PractRand: small, fast, and the same in every engine, which Math.random is not.
  const next = () => {
    const sum = (a + b + d) | 0;
    d = (d + 1) | 0;
    a = b ^ (b >>> 9);
    b = (c + (c << 3)) | 0;
    c = (((c << 21) | (c >>> 11)) + sum) | 0;
    return sum >>> 0;
  };
  for (let i = 0; i < 12; i++) next();
  return () => ((next() >>> 5) * 0x4000000 + (next() >>> 6)) / 2 ** 53;
}
