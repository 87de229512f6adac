// WGSL of the lists of tiles, after csrc/core/bin.h: passes that write pairs of a splat and a tile that it touches.

import { FRAME, MAIN, TILE, WORKGROUP, bindings } from './frame.wgsl.js';
import { KINDS } from './footprint.wgsl.js';
import { SORT_BLOCK, groupScan, scanOf } from './sort.wgsl.js';

// A splat in more tiles than these is written by a whole workgroup.
const LARGE = 32;

/// Needs the uniform `frame`.
export const support = kind => `
struct Support {
  mean: vec2f, level: f32, reach: f32, halfWidth: f32, halfHeight: f32, tip: f32, slope: f32, invA: f32, det2: f32,
}
fn support(mean: vec2f, x: vec2f, y: vec2f, det: f32, level: f32, reach: f32) -> Support {  // x, y: columns of w
  let a = dot(x, x); let b = dot(x, y); let c = dot(y, y);
  let l = level + kLevelSlack; let scale = sqrt(l) / abs(det); let rootC = sqrt(c);
  return Support(mean, l, reach, scale * rootC, scale * sqrt(a), -scale * b / rootC, -b / a, 1.0 / a, det * det);
}
fn supportOf(s: Splat, reach: f32) -> Support { ${KINDS[kind].ellipse} }
fn clampRange(lo: f32, hi: f32, begin: u32, end: u32) -> vec2i {  // pixels in [lo, hi]; empty where y < x
  let a = max(lo, f32(begin)); let b = min(hi, f32(end) - 1.0);
  if (!(a <= b)) { return vec2i(0, -1); }
  return vec2i(i32(ceil(a)), i32(floor(b)));
}
fn columnsWithin(lo: f32, hi: f32) -> vec2i {
  return clampRange(lo, hi, frame.region.x * ${TILE}u, min(frame.region.z * ${TILE}u, frame.size.x));
}
fn rowsOf(s: Support) -> vec2i {
  let half = s.halfHeight + s.reach;
  return clampRange(s.mean.y - half, s.mean.y + half, frame.region.y * ${TILE}u,
                    min(frame.region.w * ${TILE}u, frame.size.y));
}
fn tilesOf(pixels: vec2i) -> vec2i { return select(vec2i(0, -1), pixels / ${TILE}, pixels.x <= pixels.y); }
fn tileColumnsOf(s: Support, rows: vec2i, tileRow: i32) -> vec2i {
  let y0 = f32(max(tileRow * ${TILE}, rows.x)); let y1 = f32(min(tileRow * ${TILE} + ${TILE - 1}, rows.y));
  let lo = max(y0 - (s.mean.y + s.reach), -s.halfHeight); let hi = min(y1 - (s.mean.y - s.reach), s.halfHeight);
  if (hi < lo) { return vec2i(0, -1); }
  let right = clamp(s.tip, lo, hi); let left = clamp(-s.tip, lo, hi);
  let r = sqrt(max(s.level - s.det2 * right * right * s.invA, 0.0) * s.invA);
  let l = sqrt(max(s.level - s.det2 * left * left * s.invA, 0.0) * s.invA);
  return tilesOf(columnsWithin(s.mean.x + s.slope * left - l - s.reach, s.mean.x + s.slope * right + r + s.reach));
}
`;

/// After the first pass over depths: how many Gaussians are visible, and workgroups for them.
export const COUNT_VISIBLE = `
${bindings('read totals: array<u32>', 'write counts: array<u32>', 'write arguments: array<u32>')}
@compute @workgroup_size(1)
fn main() {
  var n = 0u;
  for (var d = 0u; d < 16u; d++) { n += totals[d]; }
  counts[1] = n;
  arguments[0] = (n + ${SORT_BLOCK - 1}u) / ${SORT_BLOCK}u; arguments[1] = 1u; arguments[2] = 1u;   // sort
  arguments[4] = (n + ${WORKGROUP - 1}u) / ${WORKGROUP}u; arguments[5] = 1u; arguments[6] = 1u;     // emit
}`;

/// How many tiles the visible splats of each workgroup of emit have.
export const SCAN_REDUCE = `${groupScan()}
${bindings('read counts: array<u32>', 'read order: array<u32>', 'read tiles: array<u32>', 'write blocks: array<u32>')}
${MAIN}
  let at = block.x * ${WORKGROUP}u + t;
  var x = 0u;
  if (at < counts[1]) { x = tiles[order[at]]; }
  let all = inclusive(t, x);
  if (t == ${WORKGROUP - 1}u) { blocks[block.x] = all; }
}`;

/// Sums over them; the number of pairs, and workgroups for them. Sums end at 2^32 - 1, beyond what there is room for.
export const SCAN_BLOCKS = `${FRAME}${groupScan()}
${bindings(
  'uniform frame: Frame', 'write counts: array<u32>', 'write blocks: array<u32>', 'write arguments: array<u32>')}
var<workgroup> number: u32;
${MAIN}
  if (t == 0u) { number = (counts[1] + ${WORKGROUP - 1}u) / ${WORKGROUP}u; }
  let n = workgroupUniformLoad(&number);${scanOf('blocks', '0u')}
  if (t == 0u) {
    counts[3] = before;
    let pairs = min(before, frame.room);
    counts[2] = pairs;
    arguments[8] = (pairs + ${SORT_BLOCK - 1}u) / ${SORT_BLOCK}u; arguments[9] = 1u; arguments[10] = 1u;
  }
}`;

/// A thread writes the pairs of a splat in few tiles; the workgroup together those of the others.
export const emit = kind => `${FRAME}${groupScan()}${KINDS[kind].functions}
${bindings(
  'uniform frame: Frame', 'read counts: array<u32>', 'read order: array<u32>', 'read blocks: array<u32>',
  'read tiles: array<u32>', 'read splats: array<Splat>', 'write keys: array<u32>', 'write values: array<u32>')}
${support(kind)}
var<workgroup> starts: array<u32, ${WORKGROUP}>;  // the first pair of each splat
var<workgroup> large: array<u32, ${WORKGROUP}>;
var<workgroup> largeCount: atomic<u32>;

/// Writes every \`step\`-th pair from the \`first\` on of the splat at \`place\` of the order.
fn write(place: u32, first: u32, step: u32) {
  let i = order[place];
  var at = starts[place % ${WORKGROUP}u];
  // Two compilations of one formula may round differently: no more than was counted, and no gaps.
  let end = min(saturated(at, tiles[i]), frame.room);
  let area = supportOf(splats[i], frame.reach);
  let rows = rowsOf(area); let tileRows = tilesOf(rows);
  for (var r = tileRows.x; r <= tileRows.y; r++) {
    let c = tileColumnsOf(area, rows, r);
    let width = u32(max(c.y - c.x + 1, 0));
    for (var x = first; x < width && at + x < end; x += step) {
      keys[at + x] = u32(r) * frame.tiles.x + u32(c.x) + x;
      values[at + x] = i;
    }
    at = min(at + width, end);
    if (at >= end) { break; }
  }
  for (var rest = at + first; rest < end; rest += step) {
    keys[rest] = frame.tiles.x * frame.tiles.y;  // of no tile
    values[rest] = i;
  }
}

${MAIN}
  let place = block.x * ${WORKGROUP}u + t;
  var number = 0u;
  if (place < counts[1]) { number = tiles[order[place]]; }
  if (t == 0u) { atomicStore(&largeCount, 0u); }
  starts[t] = saturated(blocks[block.x], inclusive(t, number) - number);
  workgroupBarrier();
  if (place < counts[1]) {
    if (number > ${LARGE}u) { large[atomicAdd(&largeCount, 1u)] = place; } else { write(place, 0u, 1u); }
  }
  workgroupBarrier();
  let many = atomicLoad(&largeCount);
  for (var k = 0u; k < many; k++) { write(large[k], t, ${WORKGROUP}u); }
}`;

/// Where the pairs of each tile begin and end.
export const RANGES = `
${bindings('read counts: array<u32>', 'read keys: array<u32>', 'write ranges: array<vec2u>')}
${MAIN}
  let n = counts[2];
  for (var k = 0u; k < ${SORT_BLOCK / WORKGROUP}u; k++) {
    let at = block.x * ${SORT_BLOCK}u + k * ${WORKGROUP}u + t;
    if (at >= n) { return; }
    let key = keys[at];
    if (at == 0u || keys[max(at, 1u) - 1u] != key) { ranges[key].x = at; }
    if (at + 1u == n || keys[min(at + 1u, n - 1u)] != key) { ranges[key].y = at + 1u; }
  }
}`;
