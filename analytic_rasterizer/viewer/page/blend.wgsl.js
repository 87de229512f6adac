// WGSL of blending, after csrc/core/blend.h: a workgroup draws a tile, front to back. Each sample of a pixel keeps its
// own transmittance, negative once it is closed, and its place where samples move.

import { shaderNumber } from './constants.js';
import { KINDS, sampleOf, sampling } from './footprint.wgsl.js';
import { FRAME, TILE, bindings } from './frame.wgsl.js';

const BATCH = TILE * TILE;  // splats in workgroup memory at once: one for each thread

export function blend(footprint) {
  const { slots, functions, terms, pixel, alpha } = KINDS[footprint.kind], { nodes } = sampling(footprint);
  const each = make => nodes.map((_, s) => make(s, sampleOf(footprint, s))).join('\n');
  const composite = (s, move) => `
        if (raw >= kAlphaMin) {
          let alpha = min(raw, kAlphaMax); let part = T${s} * alpha; let next = T${s} - part;
          if (next >= kTransmittanceMin) { T${s} = next; contribution += part; ${move} } else { T${s} = -abs(T${s}); }
        }`;
  return `${FRAME}${functions}
${bindings(
  'uniform frame: Frame', 'uniform band: vec4u', 'read ranges: array<vec2u>', 'read pairs: array<u32>',
  'read splats: array<Splat>', 'write picture: array<vec4f>')}
${Array.from({ length: slots }, (_, k) => `var<workgroup> slot${k}: array<vec4f, ${BATCH}>;`).join('\n')}
var<workgroup> colors: array<vec3f, ${BATCH}>;
var<workgroup> openPixels: atomic<u32>;
var<workgroup> list: vec2u;
var<workgroup> goesOn: u32;

@compute @workgroup_size(${TILE}, ${TILE})
fn main(@builtin(local_invocation_id) local: vec3u, @builtin(local_invocation_index) t: u32,
        @builtin(workgroup_id) group: vec3u) {
  let tile = vec2u(frame.region.x + group.x, band.x + group.y);
  let at = tile * ${TILE}u + local.xy; let inside = all(at < frame.size);
  let p = vec2f(local.xy); let corner = vec2f(tile * ${TILE}u);  // pixels are seen from the tile's first
  if (t == 0u) { list = ranges[tile.y * frame.tiles.x + tile.x]; }
  let both = workgroupUniformLoad(&list);
  ${each((s, { start }) => `var T${s} = select(-1.0, 1.0, inside); ${start}`)}
  var sum = vec3f(0.0);
  for (var begin = both.x; begin < both.y; begin += ${BATCH}u) {
    if (t == 0u) { atomicStore(&openPixels, 0u); }
    workgroupBarrier();
    if (${nodes.map((_, s) => `T${s} > 0.0`).join(' || ')}) { atomicStore(&openPixels, 1u); }
    workgroupBarrier();
    if (t == 0u) { goesOn = atomicLoad(&openPixels); }
    if (workgroupUniformLoad(&goesOn) == 0u) { break; }
    let number = min(both.y - begin, ${BATCH}u);
    if (t < number) {
      let s = splats[pairs[begin + t]];
      let origin = corner - s.a.xy;${terms}
      colors[t] = s.c.xyz;
    }
    workgroupBarrier();
    for (var k = 0u; k < number; k++) {
      var contribution = 0.0;${pixel}
      ${each((s, { place, move }) => `if (T${s} > 0.0) {${alpha(place, composite(s, move))}
      }`)}
      sum = fma(vec3f(contribution), colors[k], sum);
    }
  }
  if (!inside) { return; }
  let through = (${nodes.map((_, s) => `abs(T${s})`).join(' + ')}) / ${shaderNumber(nodes.length)};
  picture[at.y * frame.size.x + at.x] = vec4f(sum / ${shaderNumber(nodes.length)}, through);
}`;
}
