// Numbers of the rasterizer, by their names in csrc/core. tests/test_viewer_page.py compares them with the headers.

export const CONSTANTS = {
  kNear: 0.2,
  kFrustumClamp: 1.3,
  kAlphaMin: 1 / 255,
  kAlphaMax: 0.99,
  kPixelVariance: 1 / 12,
  kLevelSlack: 0.01,
  kMaxDet: 1e30,
  kBase2: 0.8493218002880191,
  kLog2e: 1.4426950408889634,
  kPi: 3.141592653589793,
  kLogistic1: 1.6,
  kLogistic3: 0.07,
  kMinSigma: 1e-6,
  kOrder4: 1 / 2880,
};

// 1 - exp(-x) = x (m0 + m1 x + ...) for x < 1/2: one_minus_exp_ratio of csrc/core/lanes.h.
export const MINIMAX = [
  0.9999999227245566, -0.4999924984750279, 0.16654815152216923, -0.041001278881188354, 0.006771038053309816,
];

// Half of the nodes of the footprint box [px]; the other half is opposite. box_node of csrc/core/footprint/gaussian.h.
export const HALF_NODES = {
  4: [[-0.12083, -0.36226], [0.36226, -0.12083]],
  16: [
    [0.26975, -0.14597], [0.14427, -0.43939], [0.062, -0.14646], [0.18749, 0.1472],
    [0.43551, -0.31294], [0.39499, 0.06396], [0.10473, 0.3564], [0.39573, 0.39912],
  ],
};

/// Variance of each Gaussian of the footprint box [px^2]: kBoxVariance of csrc/core/footprint/gaussian.h.
export function boxVariance(samples) {
  return samples === 1 ? CONSTANTS.kPixelVariance : 1 / (24 * samples);
}

/// All nodes of the footprint box [px].
export function boxNodes(samples) {
  if (samples === 1) return [[0, 0]];
  const half = HALF_NODES[samples];
  return [...half, ...half.map(([x, y]) => [-x, -y])];
}

// Added to the footprint's covariance by default [px^2]: the options of csrc/core/footprint/point.h and mip.h.
export const DEFAULT_VARIANCE = { point: 0.3, mip: 0.1 };

// What the page offers, with the name that people read.
export const FOOTPRINTS = [
  ['point', 'point (sampled)'],
  ['mip', 'mip (blurred)'],
  ['analytic', 'analytic'],
  ['cumulant', 'cumulant'],
  ['box:samples=1', 'box, 1 sample'],
  ['box:samples=4', 'box, 4 samples'],
  ['box:samples=16', 'box, 16 samples'],
];

/// A footprint by its name, such as 'box:samples=4': {name, kind, samples, variance}. Throws for an unknown one.
export function parseFootprint(name) {
  const [kind, option] = name.split(':');
  const [key, value] = (option ?? '').split('=');
  const expected = { point: 'dilation', mip: 'variance', box: 'samples', analytic: '', cumulant: '' }[kind];
  const number = Number(value);
  const valid = key === '' || (key === expected && value !== '' && Number.isFinite(number) && number >= 0);
  if (expected === undefined || !valid) throw new Error(`There is no footprint '${name}'.`);
  if (kind === 'box') {
    const samples = key === '' ? 4 : number;
    if (samples !== 1 && !(samples in HALF_NODES)) throw new Error(`box has 1, 4 or 16 samples, not ${value}.`);
    return { name, kind, samples, variance: boxVariance(samples) };
  }
  const fixed = kind === 'cumulant' ? CONSTANTS.kPixelVariance : 0;
  const variance = kind in DEFAULT_VARIANCE ? (key === '' ? DEFAULT_VARIANCE[kind] : number) : fixed;
  return { name, kind, samples: 1, variance };
}
