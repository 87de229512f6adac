// WGSL of the projection, after csrc/core/project.h: a thread turns a Gaussian into a splat, and counts its tiles.

import { support } from './bin.wgsl.js';
import { shaderNumber } from './constants.js';
import { KINDS } from './footprint.wgsl.js';
import { PROJECTION, wgslOf } from './formulas.js';
import { FRAME, WORKGROUP, bindings } from './frame.wgsl.js';
import { harmonicsColor, sceneBytes } from './sh.js';

// A Gaussian as the page gets it: `read` for its geometry, `number` for its harmonics.
const PLAIN = {
  read: `
fn gaussianOf(i: u32) -> Gaussian {
  let a = geometry[3u * i];
  return Gaussian(a.xyz, a.w, geometry[3u * i + 1u].xyz, geometry[3u * i + 2u]);
}`,
  type: 'vec4f',
  word: k => `unpack2x16float(harmonics[at + ${k}u])`,
  number: k => `t${k >> 1}.${'xy'[k & 1]}`,
};

/// viewer/compact.py says what the words are.
const compact = largest => ({
  read: `
fn gaussianOf(i: u32) -> Gaussian {
  let at = 6u * i; let turn = geometry[at + 5u]; let last = turn >> 30u;
  let mean = vec3f(bitcast<f32>(geometry[at]), bitcast<f32>(geometry[at + 1u]), bitcast<f32>(geometry[at + 2u]));
  let b = unpack2x16float(geometry[at + 3u]); let c = unpack2x16float(geometry[at + 4u]);
  let v = (vec3f(vec3u(turn, turn >> 10u, turn >> 20u) & vec3u(1023u)) / 511.0 - 1.0) * sqrt(0.5);
  var q: vec4f;
  q[last] = sqrt(max(1.0 - dot(v, v), 0.0));
  for (var k = 0u; k < 3u; k++) { q[(last + 1u + k) & 3u] = v[k]; }
  return Gaussian(mean, c.y, vec3f(b, c.x) * ${shaderNumber(largest)}, q / length(q));
}`,
  type: 'u32',
  word: k => (k < 2 ? `unpack2x16float(harmonics[at + ${k}u])` : `unpack4x8snorm(harmonics[at + ${k}u]) * t1.y`),
  number: k => (k < 3 ? `t${k >> 1}.${'xy'[k & 1]}` : `t${2 + ((k - 3) >> 2)}.${'xyzw'[(k - 3) & 3]}`),
});

function colorOf(meta, { word, number }) {
  const { sh_degree: degree } = meta, words = sceneBytes(meta)[1] / 4;
  return `
fn colorOf(i: u32, direction: vec3f) -> vec3f {
  let at = i * ${words}u;
  ${Array.from({ length: words }, (_, k) => `let t${k} = ${word(k)};`).join('\n  ')}
  ${wgslOf(harmonicsColor(degree, number))}
}`;
}

export function project(kind, meta) {
  const form = meta.compact ? compact(meta.compact) : PLAIN;
  return `${FRAME}${KINDS[kind].functions}
${bindings(
  'uniform frame: Frame', `read geometry: array<${form.type}>`, 'read harmonics: array<u32>',
  'write splats: array<Splat>', 'write keys: array<u32>', 'write tiles: array<u32>')}
struct Gaussian { mean: vec3f, opacity: f32, scale: vec3f, q: vec4f }  // quaternion w x y z
${form.read}${support(kind)}${colorOf(meta, form)}
// Keeps products from being fused with sums: frame.zero is 0 at run time only. Depths order splats, to the last bit.
fn rounded(x: f32) -> f32 { return bitcast<f32>(bitcast<u32>(x) ^ frame.zero); }
fn row(r: vec4f, p: vec3f) -> f32 {
  return rounded(rounded(rounded(rounded(r.x * p.x) + rounded(r.y * p.y)) + rounded(r.z * p.z)) + r.w);
}
fn within(x: f32, bound: f32) -> bool { return abs(x) <= bound; }

@compute @workgroup_size(${WORKGROUP})
fn main(@builtin(global_invocation_id) id: vec3u, @builtin(num_workgroups) groups: vec3u) {
  let i = id.y * groups.x * ${WORKGROUP}u + id.x;
  if (i >= frame.count) { return; }
  keys[i] = 0xffffffffu;
  tiles[i] = 0u;
  let g = gaussianOf(i); let mean = g.mean; let opacity = g.opacity; let scale = g.scale; let q = g.q;
  let view = vec3f(row(frame.view[0], mean), row(frame.view[1], mean), row(frame.view[2], mean));
  if (!(view.z > kNear)) { return; }
  if (!(within(scale.x, kMaxScale) && within(scale.y, kMaxScale) && within(scale.z, kMaxScale))) { return; }
${wgslOf(PROJECTION)}
  if (!(det >= 0.0 && det < kMaxDet && within(xx, 1e18) && within(yy, 1e18) && opacity <= kMaxOpacity)) { return; }
  var s: Splat;
${KINDS[kind].shape}
  let drawn = level > 0.0 && level <= 1e6 && largest <= kMaxWhitening;
  if (!(drawn && within(centre.x, 1e9) && within(centre.y, 1e9))) { return; }
  s.c = vec4f(0.0, 0.0, 0.0, level);
  let area = supportOf(s, frame.reach);
  let half = area.halfWidth + area.reach;
  let columns = columnsWithin(centre.x - half, centre.x + half);
  let rows = rowsOf(area); let tileRows = tilesOf(rows);
  if (columns.x > columns.y || rows.x > rows.y) { return; }
  var count = 0u;
  for (var r = tileRows.x; r <= tileRows.y; r++) {
    let c = tileColumnsOf(area, rows, r);
    count += u32(max(c.y - c.x + 1, 0));
  }
  if (count == 0u) { return; }
  let fromEye = mean - frame.eye.xyz;
  s.c = vec4f(colorOf(i, fromEye / sqrt(dot(fromEye, fromEye))), level);
  splats[i] = s;
  tiles[i] = count;
  keys[i] = bitcast<u32>(view.z);
}`;
}
