// Sine and cosine of the same bits in every engine. ECMAScript leaves the last bits of Math.sin and Math.cos
// to the engine, and Node and Chromium differ there, so that a world would have another digest in a page than
// in Node. Sums, products and square roots are exact everywhere.

// π/2 in three parts; n·π/2 is exact in the first two for the n of any angle below 10⁶.
const A = 1.5707963267341256,
  B = 6.07710049817245e-11,
  C = 8.333742918520879e-20;
/** 1/n! with the signs of sine's and cosine's series, highest power first. */
const SINE = series([17, 15, 13, 11, 9, 7, 5, 3, 1]);
const COSINE = series([16, 14, 12, 10, 8, 6, 4, 2, 0]);

/** @param {number[]} powers  @returns {number[]} */
function series(powers) {
  return powers.map((power) => {
    let factorial = power & 2 ? -1 : 1;
    for (let n = 2; n <= power; n++) factorial *= n;
    return 1 / factorial;
  });
}

/** @param {number[]} coefficients  @param {number} x */
function polynomial(coefficients, x) {
  return coefficients.reduce((sum, coefficient) => sum * x + coefficient, 0);
}

/** @param {number} angle  [rad]  @param {number} quarters  turns added */
function turned(angle, quarters) {
  const n = Math.round(angle / A);
  const rest = angle - n * A - n * B - n * C;
  const square = rest * rest;
  switch ((((n + quarters) % 4) + 4) % 4) {
    case 0:
      return rest * polynomial(SINE, square);
    case 1:
      return polynomial(COSINE, square);
    case 2:
      return -rest * polynomial(SINE, square);
    default:
      return -polynomial(COSINE, square);
  }
}

/** Sine, of the same bits in every engine. @param {number} angle  [rad], below 10⁶ */
export function sin(angle) {
  return turned(angle, 0);
}

/** Cosine, of the same bits in every engine. @param {number} angle  [rad], below 10⁶ */
export function cos(angle) {
  return turned(angle, 1);
}
