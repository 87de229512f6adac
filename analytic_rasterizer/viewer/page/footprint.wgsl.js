// WGSL of the footprints, from the headers of csrc/core/footprint. A header names its formula, a key of KINDS, by kPage.

import { cellsOf, nodesOf, shaderNumber } from './constants.js';
import { COMPENSATED, WINDOW, WINDOW_SHAPE, gaussianShape, wgslOf } from './formulas.js';

/// Of an entry of `footprints` of the scene (viewer/packing.py). `reach`: the largest |coordinate| of a node [px].
export function sampling({ kind, samples }) {
  const moves = kind === 'moving', nodes = moves ? cellsOf(samples) : nodesOf(samples);
  return { nodes, moves, side: Math.sqrt(samples), reach: moves ? 0.5 : Math.max(...nodes.flat().map(Math.abs)) };
}

const point = ([x, y]) => `vec2f(${shaderNumber(x)}, ${shaderNumber(y)})`;

const WHITENED = `
fn whitened(w: vec3f, p: vec2f) -> vec2f { return vec2f(w.x * p.x, fma(w.y, p.x, w.z * p.y)); }
`;

/// s = w.xx, w.yx, w.yy, 0, 0.
const gaussian = amplitude => `${wgslOf(gaussianShape(amplitude))}
  s.a = vec4f(centre, w.xy);
  s.b = vec4f(w.z, 0.0, 0.0, peak);
  let largest = max(w.x, max(abs(w.y), w.z));`;

const GAUSSIAN = {
  functions: WHITENED,
  shape: gaussian(COMPENSATED),
  ellipse: 'return support(s.a.xy, s.a.zw, vec2f(0.0, s.b.x), s.a.z * s.b.x, s.c.w, reach);',
  slots: 2,
  terms: `
      let w = kBase2 * vec3f(s.a.zw, s.b.x);
      slot0[t] = vec4f(w, s.b.w);
      slot1[t] = vec4f(whitened(w, origin), 0.0, 0.0);`,
  pixel: `
      let m = slot0[k]; let w = m.xyz; let o = slot1[k].xy;
      let centre = vec2f(fma(w.x, p.x, o.x), fma(w.y, p.x, fma(w.z, p.y, o.y)));`,
  alpha: (place, inner) => `
      let z = ${place ? `centre + whitened(w, ${place})` : 'centre'};
      let log = fma(-z.y, z.y, fma(-z.x, z.x, m.w));
      if (log >= kLogAlphaMin) {
        let raw = exp2(log);${inner}
      }`,
};

const CUMULANTS = `
fn cumulantAxis(t: f32, unit: f32, scale: f32) -> vec4f {  // c4, c6, linear, cap
  let x = t * scale * kPixelVariance;
  let u2 = unit * scale * scale; let u3 = u2 * scale; let u4 = u3 * scale; let u6 = u4 * scale * scale;
  let c4 = u4 * (1.0 + x * (20.0 / 7.0 + x * 0.4366)); let c6 = u6 * max(1.0 - x, 1e-6) / 63.0;
  let linear = u3 * 6.0 * t * (1.0 + x * (10.0 / 7.0 + x * 0.6240));
  return vec4f(c4, c6, linear, (c4 + sqrt(c4 * c4 - 3.0 * c6 * linear)) / (3.0 * c6));
}
fn cumulantConstant(t: f32, unit: f32, scale: f32) -> f32 {
  let x = t * scale * kPixelVariance;
  return unit * scale * scale * 3.0 * t * t * (1.0 + x * (20.0 / 21.0 + x * 0.6975));
}
fn cumulantPart(p: f32, a: vec4f) -> f32 {
  let P = min(p * p, a.w);
  return P * fma(P, fma(-a.y, P, a.x), -a.z);
}
`;

export const KINDS = {
  gaussian: { ...GAUSSIAN, shape: gaussian('1.0') },
  compensated: GAUSSIAN,
  moving: GAUSSIAN,
  cumulants: {
    functions: WHITENED + CUMULANTS,
    shape: `${gaussian(COMPENSATED)}
  let conic = vec2f(dot(s.a.zw, s.a.zw), s.b.x * s.b.x);
  level += dot(conic, conic) / 124.0;`,
    ellipse: GAUSSIAN.ellipse,
    slots: 4,
    terms: `${GAUSSIAN.terms}
      let unit = kOrder4 * kLog2e; let scale = 1.0 / (kBase2 * kBase2);
      let a = dot(w.xy, w.xy); let c = w.z * w.z;
      slot0[t].w = s.b.w - cumulantConstant(a, unit, scale) - cumulantConstant(c, unit, scale);
      slot2[t] = cumulantAxis(a, unit, scale);
      slot3[t] = cumulantAxis(c, unit, scale);`,
    pixel: GAUSSIAN.pixel,
    alpha: (_, inner) => `
      let across = vec2f(fma(w.x, centre.x, w.y * centre.y), w.z * centre.y);
      let gaussian = fma(-centre.x, centre.x, fma(-centre.y, centre.y, m.w));
      let raw = exp2(gaussian - cumulantPart(across.y, slot3[k]) - cumulantPart(across.x, slot2[k]));${inner}`,
  },
  window: {
    functions: wgslOf(WINDOW),
    // s = 1/s1, 1/s2, (cos, sin) of the wide axis, 0; peak = opacity 2 pi s1 s2.
    shape: `${wgslOf(WINDOW_SHAPE)}
  s.a = vec4f(centre, inverse);
  s.b = vec4f(axis, 0.0, peak);
  let largest = sqrt(max(conic.x, conic.y));`,
    ellipse: `let r = s.a.zw / sqrt(1.0 + kPixelVariance * s.a.zw * s.a.zw);
  return support(s.a.xy, vec2f(r.x * s.b.x, -r.y * s.b.y), vec2f(r.x * s.b.y, r.y * s.b.x), r.x * r.y, s.c.w, reach);`,
    slots: 3,
    terms: `
      let u = s.a.z * s.b.xy; let v = s.a.w * vec2f(-s.b.y, s.b.x);
      slot0[t] = vec4f(u, v);
      slot1[t] = vec4f(fma(u.x, origin.x, u.y * origin.y), fma(v.x, origin.x, v.y * origin.y), s.a.zw);
      slot2[t] = vec4f(s.b.w, 0.0, 0.0, 0.0);`,
    pixel: `
      let m = slot0[k]; let o = slot1[k];`,
    alpha: (_, inner) => `
      let fu = window(fma(m.x, p.x, fma(m.y, p.y, o.x)), o.z);
      let fv = window(fma(m.z, p.x, fma(m.w, p.y, o.y)), o.w);
      let raw = slot2[k].x * (fu.x * fv.x) * (1.0 / (fu.y * fv.y));${inner}`,
  },
};

/// Statements for one sample: its place before the first splat, and what a splat does to it. T is its transmittance,
/// P its place if it moves; `inner` is for where raw alpha is known.
export function sampleOf(footprint, s) {
  const { nodes, moves, side } = sampling(footprint), node = nodes[s], half = 0.5 / side;
  if (!moves) return { place: footprint.samples === 1 ? null : point(node), start: '', move: '' };
  // step() of moment.h; node and cell of the sample.
  const perStep = shaderNumber(12 * footprint.samples);
  const lo = point(node.map(x => x - half)), hi = point(node.map(x => x + half));
  return {
    place: `P${s}`,
    start: `var P${s} = ${point(node)};`,
    move: `
          let perStep = kBase2 * kBase2 * ${perStep};
          let length = alpha / fma(-perStep, alpha, perStep);
          P${s} = clamp(fma(vec2f(length), vec2f(fma(w.x, z.x, w.y * z.y), w.z * z.y), P${s}), ${lo}, ${hi});`,
  };
}
