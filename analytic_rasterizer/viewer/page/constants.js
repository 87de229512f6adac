// Numbers of the rasterizer, by their names in csrc/core. tests/viewer/test_viewer.py compares them with the headers.

export const CONSTANTS = {
  kNear: 0.2, kFrustumClamp: 1.3,
  kAlphaMin: 1 / 255, kLogAlphaMin: -7.99445, kAlphaMax: 0.99, kTransmittanceMin: 1e-4,
  kMaxDet: 1e30, kMaxScale: 1e18, kMaxOpacity: 1e6, kMaxWhitening: 1e7,
  kPixelVariance: 1 / 12, kLevelSlack: 0.01, kMinSigma: 1e-6,
  kLogistic1: 1.6, kLogistic3: 0.07, kOrder4: 1 / 2880,
  kBase2: 0.8493218002880191, kLog2e: 1.4426950408889634, kPi: 3.141592653589793,
};

// 1 - exp(-x) = x (m0 + m1 x + ...) for x < 1/2: one_minus_exp_ratio of csrc/core/lanes.h.
export const MINIMAX = [
  0.9999999227245566, -0.4999924984750279, 0.16654815152216923, -0.041001278881188354, 0.006771038053309816,
];

// Half of the nodes of a pixel [px], box_node of csrc/core/footprint/gaussian.h; the other half is opposite.
const HALF_NODES = {
  4: [[-0.12083, -0.36226], [0.36226, -0.12083]],
  16: [
    [0.26975, -0.14597], [0.14427, -0.43939], [0.062, -0.14646], [0.18749, 0.1472],
    [0.43551, -0.31294], [0.39499, 0.06396], [0.10473, 0.3564], [0.39573, 0.39912],
  ],
};

export function nodesOf(samples) {
  if (samples === 1) return [[0, 0]];
  const half = HALF_NODES[samples];
  return [...half, ...half.map(([x, y]) => [-x, -y])];
}

/// Centres of the equal square cells of a pixel [px]: node() of csrc/core/footprint/moment.h.
export function cellsOf(samples) {
  const side = Math.sqrt(samples), centre = k => (2 * k + 1 - side) / (2 * side);
  return Array.from({ length: samples }, (_, s) => [centre(s % side), centre(Math.floor(s / side))]);
}

/// A float in the text of a shader, of WGSL or of GLSL.
export const shaderNumber = value =>
  `${Number.isInteger(value) && Math.abs(value) < 1e6 ? value.toFixed(1) : value.toPrecision(12)}f`;

/// In place of a footprint to compare with.
export const PHOTOGRAPH = 'photograph';

/// A footprint by its name, 'FAMILY' or 'FAMILY:OPTION=VALUE', as an entry of `known`: `footprints` of the scene
/// (viewer/packing.py). Where the option is a variance it may have any value. Throws for an unknown name.
export function parseFootprint(name, known) {
  const found = known.find(entry => entry.name === name || (entry.family === name && entry.is_default));
  if (found) return found;
  const [family, option = ''] = name.split(':'), [key, value = ''] = option.split('=');
  const variable = known.find(entry => entry.family === family && entry.option === key), variance = Number(value);
  if (!variable || value === '' || !Number.isFinite(variance) || variance < 0) {
    throw new Error(`There is no footprint '${name}'.`);
  }
  return { ...variable, name, variance };
}
