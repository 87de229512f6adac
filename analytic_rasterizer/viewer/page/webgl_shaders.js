// GLSL of the passes project, blend and present, after csrc/core. Everything is highp: 16 bits are too few. Offsets are
// floor(gl_FragCoord) - mean, not interpolated, which is exact. Forms stay positive however a compiler rounds them.

import { CONSTANTS, MINIMAX, shaderNumber } from './constants.js';
import { heatMap } from './present.wgsl.js';
import { addHarmonics, harmonicNumbers } from './sh.js';

// Splats of one instance of the draw call. One instance per splat is eight times slower without a GPU.
export const SPLATS_PER_INSTANCE = 4096;
// Splats in a row of the textures that have one texel, or three, per splat.
export const SPLATS_PER_ROW = 1024;

const HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
${Object.entries(CONSTANTS).map(([name, value]) => `const float ${name} = ${shaderNumber(value)};`).join('\n')}
`;

// F(t) of docs/internals/numerics.md, "Logistic window", as numerator and denominator. `r` = 1/sigma [1/px].
const GL_WINDOW = `
float logistic2(float z) { return z * (kLogistic3 * kLog2e * z * z + kLogistic1 * kLog2e); }
float oneMinusExp(float x, float e) {  // 1 - exp(-x), of which e = exp(-x)
  float series = ${MINIMAX.map(shaderNumber).reduceRight((sum, c) => `${c} + x * (${sum})`)};
  return x < 0.5 ? x * series : 1.0 - e;
}
vec2 window(float t, float r) {
  float h = 0.5 * r, distance = abs(t);
  float lower = exp2(min(logistic2(distance - h), 40.0 * kLog2e));
  float upper = exp2(max(-logistic2(distance + h), -126.0));  // what is smaller is no normal number
  float y = 3.0 * kLogistic3 * r * t * t + r * (kLogistic1 + kLogistic3 * h * h);
  return vec2(oneMinusExp(y, lower * upper), (1.0 + lower) * (1.0 + upper));
}
`;

/// GLSL of the colour from spherical harmonics. Coefficients are packed four numbers to a texel.
function harmonics(degree) {
  const texels = texelsOfHarmonics(degree), number = k => `t${k >> 2}.${'xyzw'[k & 3]}`;
  const read = Array.from({ length: texels }, (_, k) => `vec4 t${k} = texelFetch(uHarmonics, at + ivec2(${k}, 0), 0);`);
  return `
vec3 colorSeenFrom(vec3 direction, ivec2 at) {
  vec3 color = vec3(0.5);
  ${read.join('\n  ')}
  float x = direction.x, y = direction.y, z = direction.z, xx = x * x, yy = y * y, zz = z * z;
  ${addHarmonics(degree, number, 'vec3')}
  return max(color, 0.0);
}
`;
}

/// Texels that the harmonics of a splat take.
export const texelsOfHarmonics = degree => harmonicNumbers(degree) / 4;

export const FULL_SCREEN = `${HEAD}
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0); }
`;

/// Projects one Gaussian per fragment. Written for each: mean, root of the level and peak; whitening matrix; colour.
/// A root of zero marks what is not drawn.
export function projectShader(kind, degree) {
  const gaussian = `
  float blurredX = xx + uVariance, blurredDet = det + uVariance * (xx + yy) + uVariance * uVariance;
  float across = sqrt(blurredX / blurredDet), slope = -across * (xy / blurredX);
  whitening = vec4(inversesqrt(blurredX), 0.0, slope, across);
  float amplitude = ${kind === 'gaussian' ? '1.0' : 'sqrt(det / blurredDet)'};
  peak = log2(opacity * amplitude);
  level = 2.0 * log(opacity * amplitude / kAlphaMin);`;
  const turned = `
  float dx = xx - yy, dy = 2.0 * xy, gap = length(vec2(dx, dy)), major = 0.5 * (xx + yy + gap);
  float s1 = max(sqrt(major), kMinSigma), s2 = max(sqrt(det / max(major, 1e-30)), kMinSigma);
  vec2 axis = vec2(1.0, 0.0);
  if (dx > 0.0) {
    axis.x = sqrt(0.5 * (1.0 + dx / gap));
    axis.y = dy / (2.0 * gap * axis.x);
  } else if (gap > 0.0) {
    float sine = sqrt(0.5 * (1.0 - dx / gap));
    axis = vec2(abs(dy) / (2.0 * gap * sine), dy < 0.0 ? -sine : sine);
  }
  vec2 inverse = 1.0 / vec2(s1, s2);
  whitening = vec4(axis * inverse.x, vec2(-axis.y, axis.x) * inverse.y);
  peak = opacity * (2.0 * kPi) * s1 * s2;
  vec2 top = window(0.0, inverse.x) * window(0.0, inverse.y);
  vec2 widened = inverse * inverse / (1.0 + kPixelVariance * inverse * inverse);
  level = 2.0 * log(peak * top.x / top.y / kAlphaMin) + dot(widened, widened) / 48.0 + 0.1;`;
  return `${HEAD}
uniform sampler2D uGeometry, uHarmonics;
uniform vec4 uView[3];  // rows of world to camera
uniform vec3 uEye;
uniform vec4 uPinhole;  // focal lengths and principal point [px]
uniform vec2 uLimit;    // of |x/z| and |y/z| in the Jacobian
uniform float uVariance;
layout(location = 0) out uvec4 outMean;
layout(location = 1) out uvec4 outWhitening;
layout(location = 2) out uvec4 outColor;
${kind === 'window' ? GL_WINDOW : ''}${harmonics(degree)}
void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  int i = pixel.x + pixel.y * ${SPLATS_PER_ROW};
  outMean = outWhitening = outColor = uvec4(0);
  ivec2 texel = ivec2(3 * pixel.x, pixel.y);
  vec4 g0 = texelFetch(uGeometry, texel, 0), g1 = texelFetch(uGeometry, texel + ivec2(1, 0), 0);
  vec4 q = texelFetch(uGeometry, texel + ivec2(2, 0), 0);
  vec3 position = g0.xyz, scale = g1.xyz;
  float opacity = g0.w;

  vec3 v = vec3(dot(uView[0].xyz, position) + uView[0].w, dot(uView[1].xyz, position) + uView[1].w,
                dot(uView[2].xyz, position) + uView[2].w);
  if (!(v.z > kNear)) return;
  float inverseZ = 1.0 / v.z;
  vec2 mean = uPinhole.xy * v.xy * inverseZ + uPinhole.zw - 0.5;
  if (!(abs(mean.x) < 1e9 && abs(mean.y) < 1e9)) return;
  vec2 ratio = clamp(v.xy * inverseZ, -uLimit, uLimit);
  vec3 ax = uPinhole.x * inverseZ * (uView[0].xyz - ratio.x * uView[2].xyz);
  vec3 ay = uPinhole.y * inverseZ * (uView[1].xyz - ratio.y * uView[2].xyz);
  float w = q.x, a = q.y, b = q.z, c = q.w;
  mat3 turn = mat3(1.0 - 2.0 * (b * b + c * c), 2.0 * (a * b - w * c), 2.0 * (a * c + w * b),
                   2.0 * (a * b + w * c), 1.0 - 2.0 * (a * a + c * c), 2.0 * (b * c - w * a),
                   2.0 * (a * c - w * b), 2.0 * (b * c + w * a), 1.0 - 2.0 * (a * a + b * b));
  vec3 rowX = (turn * ax) * scale, rowY = (turn * ay) * scale, normal = cross(rowX, rowY);
  // The determinant is never xx yy - xy xy, which is negative for half of all long needles.
  float xx = dot(rowX, rowX), xy = dot(rowX, rowY), yy = dot(rowY, rowY), det = dot(normal, normal);
  if (!(det < kMaxDet && xx < 1e18 && yy < 1e18)) return;
  vec4 whitening;
  float peak, level;
${kind === 'window' ? turned : gaussian}
  if (!(level > 0.0 && level < 1e6)) return;

  int texels = ${texelsOfHarmonics(degree)}, perRow = textureSize(uHarmonics, 0).x / texels;
  ivec2 at = ivec2(i % perRow * texels, i / perRow);
  outMean = floatBitsToUint(vec4(mean, sqrt(level + kLevelSlack), peak));
  outWhitening = floatBitsToUint(whitening);
  outColor = floatBitsToUint(vec4(colorSeenFrom(normalize(position - uEye), at), 0.0));
}
`;
}

// What the splat adds at d = pixel - mean [px], by the kind of its footprint.
const GL_GAUSSIAN = `
float alphaAt(vec2 d) {
  vec2 z = kBase2 * vec2(dot(fW.xy, d), dot(fW.zw, d));
  return exp2(fPeak - dot(z, z));
}
`;
export const GL_KINDS = {
  gaussian: GL_GAUSSIAN,
  compensated: GL_GAUSSIAN,
  window: `${GL_WINDOW}
float alphaAt(vec2 d) {
  vec2 u = window(dot(fW.xy, d), fR.x), v = window(dot(fW.zw, d), fR.y);
  return fPeak * (u.x * v.x) / (u.y * v.y);
}
`,
};

// Of a splat, from vertex to fragment shader. fR: lengths of the rows of the whitening matrix fW.
const varyings = direction => `
flat ${direction} highp vec4 fW;
flat ${direction} highp vec3 fColor;
flat ${direction} highp vec2 fMean, fR;
flat ${direction} highp float fPeak;
`;

/// Draws splats as the parallelograms W^-1 [-s, s]^2 around their ellipses, of `window` wider by the pixel's variance.
export function drawVertexShader(kind) {
  return `${HEAD}
uniform usampler2D uMean, uWhitening, uColor, uOrder;
uniform float uVisible;
uniform vec2 uSize;
${varyings('out')}
ivec2 texelOf(int k) { return ivec2(k % ${SPLATS_PER_ROW}, k / ${SPLATS_PER_ROW}); }
void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);  // outside: not drawn
  int k = gl_InstanceID * ${SPLATS_PER_INSTANCE} + gl_VertexID / 4;
  if (k >= int(uVisible)) return;
  ivec2 texel = texelOf(int(texelFetch(uOrder, texelOf(k), 0).x));
  vec4 m = uintBitsToFloat(texelFetch(uMean, texel, 0));
  if (!(m.z > 0.0)) return;
  fMean = m.xy;
  fPeak = m.w;
  fW = uintBitsToFloat(texelFetch(uWhitening, texel, 0));
  fR = vec2(length(fW.xy), length(fW.zw));
  fColor = uintBitsToFloat(texelFetch(uColor, texel, 0)).xyz;
  vec2 shrink = ${kind === 'window' ? 'inversesqrt(1.0 + kPixelVariance * fR * fR)' : 'vec2(1.0)'};
  vec4 E = vec4(fW.xy * shrink.x, fW.zw * shrink.y);
  vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
  const float margin = 0.25;  // px on all sides, because vertices may snap to 1/16 px
  vec2 s = corner * (m.z + margin * vec2(abs(E.x) + abs(E.y), abs(E.z) + abs(E.w)));
  vec2 offset = vec2(E.w * s.x - E.y * s.y, E.x * s.y - E.z * s.x) / (E.x * E.w - E.y * E.z);
  gl_Position = vec4((m.xy + offset + 0.5) / uSize * 2.0 - 1.0, 0.0, 1.0);
}
`;
}

/// Writes premultiplied colour and alpha.
export const drawFragmentShader = kind => `${HEAD}
${varyings('in')}
out vec4 color;
${GL_KINDS[kind]}
void main() {
  float raw = alphaAt(floor(gl_FragCoord.xy) - fMean);
  if (!(raw >= kAlphaMin)) discard;
  float alpha = min(raw, kAlphaMax);
  color = vec4(fColor * alpha, alpha);
}
`;

/// Shows one picture, two beside each other, or their difference. Row 0 of a picture is its top.
export const GL_PRESENT = `${HEAD}
uniform sampler2D uLeft, uRight;
uniform vec2 uCanvas, uSize;
uniform vec3 uBackground;
uniform float uDivider;  // canvas px; right of it is uRight
uniform bool uDifference;
out vec4 color;
vec3 over(vec4 c) { return clamp(c.rgb + (1.0 - c.a) * uBackground, 0.0, 1.0); }
vec3 heat(float difference) {
  vec3 color;
  ${heatMap('vec3')}
  return color;
}
void main() {
  vec2 at = vec2(gl_FragCoord.x, uCanvas.y - gl_FragCoord.y);
  ivec2 texel = min(ivec2(at / uCanvas * uSize), ivec2(uSize) - 1);
  vec4 a = texelFetch(uLeft, texel, 0), b = texelFetch(uRight, texel, 0);
  if (b.a > 1.5) b = a;  // beside a photograph
  vec3 d = abs(over(a) - over(b));
  color = vec4(uDifference ? heat(max(d.r, max(d.g, d.b))) : over(at.x < uDivider ? a : b), 1.0);
}
`;
