// Formulas of csrc/core for WebGPU and WebGL 2: GLSL, of which wgslOf makes WGSL. `frame` is the Frame of either.

import { MINIMAX, shaderNumber } from './constants.js';

const TYPES = { float: 'f32', vec2: 'vec2f', vec3: 'vec3f', vec4: 'vec4f' };
const PARAMETER = /(\w+) (\w+)/g, swapped = (_, type, name) => `${name}: ${TYPES[type]}`;

/// A formula in WGSL. One declaration a statement; what changes later is declared without a value.
export const wgslOf = text => text
  .replace(/\b(float|vec[234]) (\w+)\(([^)]*)\) \{/g,
    (_, type, name, parameters) => `fn ${name}(${parameters.replace(PARAMETER, swapped)}) -> ${TYPES[type]} {`)
  .replace(/\b(?:float|vec[234]) (\w+) =/g, 'let $1 =')
  .replace(/\b(float|vec[234]) (\w+);/g, (...found) => `var ${swapped(...found)};`)
  .replace(/\b(vec[234])\(/g, '$1f(');

/// What WGSL has and GLSL lacks.
export const GL_FUNCTIONS = `#define fma(a, b, c) ((a) * (b) + (c))
#define select(otherwise, value, condition) ((condition) ? (value) : (otherwise))
`;

/// From `view`, the mean in camera space beyond kNear, `scale` and the quaternion `q` (w, x, y, z) to the mean `centre`
/// [px] and the covariance xx, xy, yy [px^2] in the picture, with its determinant.
export const PROJECTION = `
  vec2 ratio = view.xy / view.z;
  vec2 centre = frame.pinhole.xy * ratio + frame.pinhole.zw - 0.5;
  vec2 held = clamp(ratio, -frame.limit, frame.limit);
  vec3 jx = frame.pinhole.x / view.z * (frame.view[0].xyz - held.x * frame.view[2].xyz);
  vec3 jy = frame.pinhole.y / view.z * (frame.view[1].xyz - held.y * frame.view[2].xyz);
  vec3 r0 = vec3(1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z - q.x * q.w), 2.0 * (q.y * q.w + q.x * q.z));
  vec3 r1 = vec3(2.0 * (q.y * q.z + q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w - q.x * q.y));
  vec3 r2 = vec3(2.0 * (q.y * q.w - q.x * q.z), 2.0 * (q.z * q.w + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
  vec3 vx = (jx.x * r0 + jx.y * r1 + jx.z * r2) * scale;
  vec3 vy = (jy.x * r0 + jy.y * r1 + jy.z * r2) * scale;
  // The determinant is never xx yy - xy xy, which is negative for half of all long needles.
  vec3 normal = cross(vx, vy);
  float xx = dot(vx, vx); float xy = dot(vx, vy); float yy = dot(vy, vy); float det = dot(normal, normal);`;

/// The whitening matrix `w` (xx, yx, yy) of a Gaussian, log2 of its `peak`, and its `level`.
export const gaussianShape = amplitude => `
  float blurredX = xx + frame.variance;
  float blurredDet = det + frame.variance * (xx + yy) + frame.variance * frame.variance;
  float across = sqrt(blurredX / blurredDet); float amp = ${amplitude};
  vec3 w = vec3(1.0 / sqrt(blurredX), -across * (xy / blurredX), across);
  float peak = log2(opacity * amp);
  float level;
  level = 2.0 * log(opacity * amp / kAlphaMin);`;
export const COMPENSATED = 'sqrt(det / blurredDet)';

/// F(t) of docs/internals/numerics.md, "Logistic window", as numerator and denominator. `r` = 1/sigma [1/px].
export const WINDOW = `
float logistic2(float z) { return z * fma(kLogistic3 * kLog2e * z, z, kLogistic1 * kLog2e); }
float oneMinusExp(float x, float e) {  // 1 - exp(-x), of which e = exp(-x)
  float series = ${MINIMAX.map(shaderNumber).reduceRight((sum, c) => `fma(${sum}, x, ${c})`)};
  return select(1.0 - e, x * series, x < 0.5);
}
vec2 window(float t, float r) {
  float edge = 0.5 * r; float distance = abs(t);
  float lower = exp2(min(logistic2(distance - edge), 40.0 * kLog2e));
  float upper = exp2(max(-logistic2(distance + edge), -126.0));  // what is smaller is no normal number
  float y = fma(3.0 * kLogistic3 * r * t, t, r * (kLogistic1 + 0.25 * kLogistic3 * r * r));
  return vec2(oneMinusExp(y, lower * upper), (1.0 + lower) * (1.0 + upper));
}
`;

/// 1/sigma along both axes (`inverse`), (cos, sin) of the wide `axis`, `peak` and `level`. `conic`: 1/(sigma^2 + 1/12).
export const WINDOW_SHAPE = `
  float dx = xx - yy; float dy = 2.0 * xy; float gap = sqrt(dx * dx + dy * dy); float major = 0.5 * (xx + yy + gap);
  vec2 axis;
  axis = vec2(1.0, 0.0);
  if (dx > 0.0) {
    axis.x = sqrt(0.5 * (1.0 + dx / gap));
    axis.y = dy / (2.0 * gap * axis.x);
  } else if (gap > 0.0) {
    axis.y = sqrt(0.5 * (1.0 - dx / gap)) * (2.0 * step(0.0, dy) - 1.0);
    axis.x = dy / (2.0 * gap * axis.y);
  }
  vec2 sigma = max(vec2(sqrt(major), sqrt(det / max(major, 1e-30))), vec2(kMinSigma));
  vec2 inverse = 1.0 / sigma;
  float peak = opacity * (2.0 * kPi) * sigma.x * sigma.y;
  vec2 top = window(0.0, inverse.x) * window(0.0, inverse.y);
  vec2 conic = inverse * inverse / (1.0 + kPixelVariance * inverse * inverse);
  float level = 2.0 * log(peak * top.x / top.y / kAlphaMin) + dot(conic, conic) / 48.0 + 0.1;`;

// Colours of the heat map, for differences of 0, 1/16, ..., 1/4.
const HEAT = ['0.03, 0.03, 0.06', '0.32, 0.10, 0.45', '0.80, 0.26, 0.30', '0.98, 0.65, 0.18', '1.00, 0.98, 0.85'];

export const HEAT_MAP = `
vec3 heat(float difference) {
  vec3 color;
  color = vec3(${HEAT[0]});
  ${HEAT.slice(1).map((next, k) =>
    `color = mix(color, vec3(${next}), clamp(16.0 * difference - ${k}.0, 0.0, 1.0));`).join('\n  ')}
  return color;
}
`;
