// SHA-256 (FIPS 180-4), synchronous: WebCrypto's is not, and a product's digest is due in the middle of a
// step.

const PRIMES = primes(64);
const K = Uint32Array.from(PRIMES, (prime) => fraction(Math.cbrt(prime)));
const INITIAL = Uint32Array.from(PRIMES.slice(0, 8), (prime) => fraction(Math.sqrt(prime)));
const words = new Uint32Array(64);

/** @param {number} count  @returns {number[]} */
function primes(count) {
  /** @type {number[]} */
  const found = [];
  for (let n = 2; found.length < count; n++) if (found.every((prime) => n % prime)) found.push(n);
  return found;
}

/** @param {number} value  @returns {number} the first 32 bits behind its point */
function fraction(value) {
  return Math.floor((value - Math.floor(value)) * 0x100000000);
}

/**
 * SHA-256 of byte arrays one after the other.
 *
 * @param {...Uint8Array} pieces
 * @returns {string} 64 lower-case hexadecimal digits
 */
export function sha256(...pieces) {
  const state = INITIAL.slice();
  const block = new Uint8Array(64);
  const view = new DataView(block.buffer);
  let filled = 0;
  let length = 0;
  for (const piece of pieces) {
    length += piece.length;
    for (let at = 0; at < piece.length;) {
      const count = Math.min(64 - filled, piece.length - at);
      block.set(piece.subarray(at, at + count), filled);
      at += count;
      filled += count;
      if (filled === 64) {
        compress(state, view);
        filled = 0;
      }
    }
  }
  block[filled] = 0x80;
  block.fill(0, filled + 1);
  if (filled >= 56) {
    compress(state, view);
    block.fill(0);
  }
  view.setUint32(56, Math.floor(length / 0x20000000));
  view.setUint32(60, (length << 3) >>> 0);
  compress(state, view);
  return Array.from(state, (word) => word.toString(16).padStart(8, "0")).join("");
}

/** @param {Uint32Array} state  @param {DataView} block */
function compress(state, block) {
  for (let i = 0; i < 16; i++) words[i] = block.getUint32(4 * i);
  for (let i = 16; i < 64; i++) {
    const x = words[i - 15],
      y = words[i - 2];
    const s0 = ((x >>> 7) | (x << 25)) ^ ((x >>> 18) | (x << 14)) ^ (x >>> 3);
    const s1 = ((y >>> 17) | (y << 15)) ^ ((y >>> 19) | (y << 13)) ^ (y >>> 10);
    words[i] = words[i - 16] + s0 + words[i - 7] + s1;
  }
  let [a, b, c, d, e, f, g, h] = state;
  for (let i = 0; i < 64; i++) {
    const s1 = ((e >>> 6) | (e << 26)) ^ ((e >>> 11) | (e << 21)) ^ ((e >>> 25) | (e << 7));
    const t1 = (h + s1 + ((e & f) ^ (~e & g)) + K[i] + words[i]) | 0;
    const s0 = ((a >>> 2) | (a << 30)) ^ ((a >>> 13) | (a << 19)) ^ ((a >>> 22) | (a << 10));
    const t2 = (s0 + ((a & b) ^ (a & c) ^ (b & c))) | 0;
    h = g;
    g = f;
    f = e;
    e = (d + t1) | 0;
    d = c;
    c = b;
    b = a;
    a = (t1 + t2) | 0;
  }
  [a, b, c, d, e, f, g, h].forEach((word, i) => {
    state[i] += word;
  });
}
