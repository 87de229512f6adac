// GLSL of the passes project, blend and present, after csrc/core. Everything is highp: 16 bits are too few. Offsets are
// floor(gl_FragCoord) - mean, not interpolated, which is exact. Forms stay positive however a compiler rounds them.

import { CONSTANTS, shaderNumber } from './constants.js';
import {
  COMPENSATED, GL_FUNCTIONS, HEAT_MAP, PROJECTION, WINDOW, WINDOW_SHAPE, gaussianShape,
} from './formulas.js';
import { harmonicNumbers, harmonicsColor } from './sh.js';

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
${GL_FUNCTIONS}`;

/// GLSL of the colour from spherical harmonics. Coefficients are packed four numbers to a texel.
function harmonics(degree) {
  const texels = texelsOfHarmonics(degree), number = k => `t${k >> 2}.${'xyzw'[k & 3]}`;
  const read = Array.from({ length: texels }, (_, k) => `vec4 t${k} = texelFetch(uHarmonics, at + ivec2(${k}, 0), 0);`);
  return `
vec3 colorSeenFrom(vec3 direction, ivec2 at) {
  ${read.join('\n  ')}${harmonicsColor(degree, number)}
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
  const shape = kind === 'window' ? `${WINDOW_SHAPE}
  vec4 whitening = vec4(axis * inverse.x, vec2(-axis.y, axis.x) * inverse.y);`
    : `${gaussianShape(kind === 'gaussian' ? '1.0' : COMPENSATED)}
  vec4 whitening = vec4(w.x, 0.0, w.yz);`;
  return `${HEAD}
uniform sampler2D uGeometry, uHarmonics;
uniform struct Frame { vec4 view[3], pinhole; vec3 eye; vec2 limit; float variance; } frame;  // of frame.wgsl.js
layout(location = 0) out uvec4 outMean;
layout(location = 1) out uvec4 outWhitening;
layout(location = 2) out uvec4 outColor;
${kind === 'window' ? WINDOW : ''}${harmonics(degree)}
void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  int i = pixel.x + pixel.y * ${SPLATS_PER_ROW};
  outMean = outWhitening = outColor = uvec4(0);
  ivec2 texel = ivec2(3 * pixel.x, pixel.y);
  vec4 g0 = texelFetch(uGeometry, texel, 0), q = texelFetch(uGeometry, texel + ivec2(2, 0), 0);
  vec3 scale = texelFetch(uGeometry, texel + ivec2(1, 0), 0).xyz;
  float opacity = g0.w;
  vec4 mean = vec4(g0.xyz, 1.0);
  vec3 view = vec3(dot(frame.view[0], mean), dot(frame.view[1], mean), dot(frame.view[2], mean));
  if (!(view.z > kNear)) return;
${PROJECTION}
  if (!(abs(centre.x) < 1e9 && abs(centre.y) < 1e9 && det < kMaxDet && xx < 1e18 && yy < 1e18)) return;
${shape}
  if (!(level > 0.0 && level < 1e6)) return;

  int texels = ${texelsOfHarmonics(degree)}, perRow = textureSize(uHarmonics, 0).x / texels;
  ivec2 at = ivec2(i % perRow * texels, i / perRow);
  outMean = floatBitsToUint(vec4(centre, sqrt(level + kLevelSlack), peak));
  outWhitening = floatBitsToUint(whitening);
  outColor = floatBitsToUint(vec4(colorSeenFrom(normalize(mean.xyz - frame.eye), at), 0.0));
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
  window: `${WINDOW}
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
${HEAT_MAP}void main() {
  vec2 at = vec2(gl_FragCoord.x, uCanvas.y - gl_FragCoord.y);
  ivec2 texel = min(ivec2(at / uCanvas * uSize), ivec2(uSize) - 1);
  vec4 a = texelFetch(uLeft, texel, 0), b = texelFetch(uRight, texel, 0);
  if (b.a > 1.5) b = a;  // beside a photograph
  vec3 d = abs(over(a) - over(b));
  color = vec4(uDifference ? heat(max(d.r, max(d.g, d.b))) : over(at.x < uDivider ? a : b), 1.0);
}
`;
