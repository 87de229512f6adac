// The window of `analytic`, F of docs/internals/numerics.md, "Logistic window", as a polynomial of each splat.
//
// The formula takes two exponentials for each axis and pixel. But (F(0)/F(t))^(1/4) is a smooth function of t, which
// grows from 1 to 4 or less where no opacity can make the splat visible. Let h be half a pixel in standard deviations,
// and w the distance from the flat top that F has for large h, in a unit that depends on h. Then
//
//   F(t) = F(0) / V^4,   V = 1 + c1 s + c2 s^2 + c3 s^3 + c4 s^4 + s^5,   s = w^2,   w = unit max(|t| - flat, 0),
//
// where unit and coefficients depend on h alone. They are fitted when the page starts, and the vertex shader reads them
// from a table. Alpha is off by at most 2.5e-4 (0.06 of 255 levels) and by at most 0.3% of itself; by 6e-5 where both
// standard deviations are half a pixel or more.

import { CONSTANTS } from './constants.js';

// Rows of the table per unit of h.
export const ROWS_PER_UNIT = 64;
// Beyond this h the edges of the window no longer see each other: F depends on |t| - h only, and the row is the last.
export const LAST_HALF = 6;
// From this h on there is a flat top; it ends this far before the edge of the pixel [standard deviations].
export const FLAT_FROM = 4;
const COEFFICIENTS = 4;
const DEGREE = COEFFICIENTS + 1;
const POINTS = 32;

const exponent = z => z * (CONSTANTS.kLogistic1 + CONSTANTS.kLogistic3 * z * z);

/// F(t), as LogisticWindow of csrc/core/footprint/analytic.h computes it.
function logisticWindow(t, half) {
  const a = exponent(t - half), b = exponent(t + half);
  return -Math.expm1(a - b) / ((1 + Math.exp(a)) * (1 + Math.exp(-b)));
}

/// t > 0 beyond which a splat is below 1/255, whatever its opacity and its other axis, along which it adds up to 1.003
/// at most.
function endOfWindow(half) {
  const top = logisticWindow(0, half), brightest = (1.003 * Math.sqrt(2 * Math.PI) * top) / (2 * half);
  let low = half, high = half + 4;
  for (let k = 0; k < 40; ++k) {
    const middle = (low + high) / 2;
    if (brightest * logisticWindow(middle, half) > CONSTANTS.kAlphaMin * top) low = middle;
    else high = middle;
  }
  return high;
}

/// c1, c2, ... of the polynomial 1 + c1 s + c2 s^2 + ... that is nearest to `values` at `places` by weighted squares.
function fitPolynomial(places, values, weights) {
  const normal = Array.from({ length: DEGREE }, () => new Array(DEGREE + 1).fill(0));
  places.forEach((s, k) => {
    const powers = Array.from({ length: DEGREE }, (_, i) => s ** (i + 1));
    for (let i = 0; i < DEGREE; ++i) {
      const part = weights[k] * powers[i];
      for (let j = 0; j < DEGREE; ++j) normal[i][j] += part * powers[j];
      normal[i][DEGREE] += part * (values[k] - 1);
    }
  });
  // The matrix is positive definite: no pivots are needed.
  for (let i = 0; i < DEGREE; ++i) {
    for (let row = 0; row < DEGREE; ++row) {
      const factor = normal[row][i] / normal[i][i];
      for (let j = i; row !== i && j <= DEGREE; ++j) normal[row][j] -= factor * normal[i][j];
    }
  }
  return normal.map((row, i) => row[DEGREE] / row[i]);
}

/// unit, c1, ..., c4 for h = `half`.
function windowRow(half) {
  const flat = Math.max(half - FLAT_FROM, 0), length = endOfWindow(half) - flat;
  const places = Array.from(
    { length: POINTS }, (_, k) => (0.5 - 0.5 * Math.cos((Math.PI * (k + 0.5)) / POINTS)) ** 1.5);
  const values = places.map(
    s => (logisticWindow(0, half) / logisticWindow(flat + length * Math.sqrt(s), half)) ** 0.25);
  // Relative errors of F weigh as sqrt(F): between small errors at the top and at the threshold.
  const coefficients = fitPolynomial(places, values, values.map(value => value ** -6));
  // A unit in which the last coefficient, which is always positive, is 1.
  const scale = coefficients[COEFFICIENTS] ** (1 / DEGREE);
  return [Math.sqrt(scale) / length, ...coefficients.slice(0, COEFFICIENTS).map((c, i) => c / scale ** (i + 1))];
}

/// Rows of eight numbers, of which the last three are not used, for h = 0, 1/ROWS_PER_UNIT, ..., LAST_HALF.
export function windowTable() {
  const table = new Float32Array(8 * (LAST_HALF * ROWS_PER_UNIT + 1));
  for (let k = 0; k <= LAST_HALF * ROWS_PER_UNIT; ++k) {
    table.set(windowRow(Math.max(k / ROWS_PER_UNIT, 1e-6)), 8 * k);  // at h = 0 the limit is meant
  }
  return table;
}
