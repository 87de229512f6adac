// WGSL of the footprints, from the headers of csrc/core/footprint. A header names its formula, a key of KINDS, by kPage.

import { MINIMAX, cellsOf, nodesOf, shaderNumber } from './constants.js';

/// What passes need to know of an entry of `footprints` of the scene (viewer/packing.py). `reach` is the largest
/// |coordinate| of a node [px].
export function sampling({ kind, samples }) {
  const moves = kind === 'moving', nodes = moves ? cellsOf(samples) : nodesOf(samples);
  return { nodes, moves, side: Math.sqrt(samples), reach: moves ? 0.5 : Math.max(...nodes.flat().map(Math.abs)) };
}

const point = ([x, y]) => `vec2f(${shaderNumber(x)}, ${shaderNumber(y)})`;

const WHITENED = `
fn whitened(w: vec3f, p: vec2f) -> vec2f { return vec2f(w.x * p.x, fma(w.y, p.x, w.z * p.y)); }
`;

/// s = w.xx, w.yx, w.yy, 0, 0 of the whitening matrix; peak = log2(opacity amp). `amplitude` uses det and blurredDet.
const gaussianShape = amplitude => `
  let v = frame.variance; let blurredX = xx + v; let blurredDet = det + v * (xx + yy) + v * v;
  let across = sqrt(blurredX / blurredDet); let amp = ${amplitude};
  s.a = vec4f(centre, 1.0 / sqrt(blurredX), -across * (xy / blurredX));
  s.b = vec4f(across, 0.0, 0.0, log2(opacity * amp));
  var level = 2.0 * log(opacity * amp / kAlphaMin);
  let largest = max(s.a.z, max(abs(s.a.w), across));`;

const GAUSSIAN = {
  functions: WHITENED,
  shape: gaussianShape('sqrt(det / blurredDet)'),
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

const WINDOW = `
struct Axis { half: f32, constant: f32, square: f32 }
fn axisAt(r: f32) -> Axis { return Axis(0.5 * r, r * (kLogistic1 + 0.25 * kLogistic3 * r * r), 3.0 * kLogistic3 * r); }
fn logistic2(z: f32) -> f32 { return z * fma(kLogistic3 * kLog2e * z, z, kLogistic1 * kLog2e); }
fn oneMinusExp(x: f32, e: f32) -> f32 {  // 1 - exp(-x), of which e = exp(-x)
  let series = ${MINIMAX.map(shaderNumber).reduceRight((sum, c) => `fma(${sum}, x, ${c})`)};
  return select(1.0 - e, x * series, x < 0.5);
}
struct Window { numerator: f32, denominator: f32 }
fn window(t: f32, a: Axis) -> Window {
  let distance = abs(t);
  let lower = exp2(min(logistic2(distance - a.half), 40.0 * kLog2e));
  let upper = exp2(max(-logistic2(distance + a.half), -126.0));  // what is smaller is no normal number
  return Window(oneMinusExp(fma(a.square * t, t, a.constant), lower * upper), (1.0 + lower) * (1.0 + upper));
}
fn widened(r: f32) -> f32 { return r / sqrt(1.0 + kPixelVariance * r * r); }
`;

export const KINDS = {
  gaussian: { ...GAUSSIAN, shape: gaussianShape('1.0') },
  compensated: GAUSSIAN,
  moving: GAUSSIAN,
  cumulants: {
    functions: WHITENED + CUMULANTS,
    shape: `${gaussianShape('sqrt(det / blurredDet)')}
  let conic = vec2f(dot(s.a.zw, s.a.zw), s.b.x * s.b.x);
  level += dot(conic, conic) / 124.0;`,
    ellipse: GAUSSIAN.ellipse,
    slots: 4,
    terms: `
      let w = kBase2 * vec3f(s.a.zw, s.b.x);
      let unit = kOrder4 * kLog2e; let scale = 1.0 / (kBase2 * kBase2);
      let a = dot(w.xy, w.xy); let c = w.z * w.z;
      slot0[t] = vec4f(w, s.b.w - cumulantConstant(a, unit, scale) - cumulantConstant(c, unit, scale));
      slot1[t] = vec4f(whitened(w, origin), 0.0, 0.0);
      slot2[t] = cumulantAxis(a, unit, scale);
      slot3[t] = cumulantAxis(c, unit, scale);`,
    pixel: GAUSSIAN.pixel,
    alpha: (_, inner) => `
      let across = vec2f(fma(w.x, centre.x, w.y * centre.y), w.z * centre.y);
      let gaussian = fma(-centre.x, centre.x, fma(-centre.y, centre.y, m.w));
      let raw = exp2(gaussian - cumulantPart(across.y, slot3[k]) - cumulantPart(across.x, slot2[k]));${inner}`,
  },
  window: {
    functions: WINDOW,
    // s = 1/s1, 1/s2, (cos, sin) of the wide axis, 0; peak = opacity 2 pi s1 s2.
    shape: `
  let dx = xx - yy; let dy = 2.0 * xy; let gap = sqrt(dx * dx + dy * dy); let major = 0.5 * (xx + yy + gap);
  var axis = vec2f(1.0, 0.0);
  if (dx > 0.0) {
    axis.x = sqrt(0.5 * (1.0 + dx / gap));
    axis.y = dy / (2.0 * gap * axis.x);
  } else if (gap > 0.0) {
    let sine = sqrt(0.5 * (1.0 - dx / gap));
    axis = vec2f(abs(dy) / (2.0 * gap * sine), select(sine, -sine, dy < 0.0));
  }
  let s1 = max(sqrt(major), kMinSigma); let s2 = max(sqrt(max(det / major, 0.0)), kMinSigma);
  let mass = opacity * (2.0 * kPi) * s1 * s2;
  s.a = vec4f(centre, 1.0 / s1, 1.0 / s2);
  s.b = vec4f(axis, 0.0, mass);
  let wu = widened(s.a.z); let wv = widened(s.a.w);
  let fu = window(0.0, axisAt(s.a.z)); let fv = window(0.0, axisAt(s.a.w));
  let top = mass * (fu.numerator * fv.numerator) / (fu.denominator * fv.denominator);
  let level = 2.0 * log(top / kAlphaMin) + (wu * wu * wu * wu + wv * wv * wv * wv) / 48.0 + 0.1;
  let largest = max(wu, wv);`,
    ellipse: `let r = vec2f(widened(s.a.z), widened(s.a.w));
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
      let fu = window(fma(m.x, p.x, fma(m.y, p.y, o.x)), axisAt(o.z));
      let fv = window(fma(m.z, p.x, fma(m.w, p.y, o.y)), axisAt(o.w));
      let raw = slot2[k].x * (fu.numerator * fv.numerator) * (1.0 / (fu.denominator * fv.denominator));${inner}`,
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
