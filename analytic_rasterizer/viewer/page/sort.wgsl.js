// WGSL of a stable radix sort of (key, value), 4 bits at a time: histograms of blocks of keys; for each digit a
// workgroup adds them up over the blocks; scatter. It needs no forward progress of workgroups, and no subgroups.

import { MAIN, WORKGROUP, bindings } from './frame.wgsl.js';

export const SORT_BITS = 4;
const SORT_ITEMS = 8;                            // keys of a thread
export const SORT_BLOCK = WORKGROUP * SORT_ITEMS;  // of a workgroup

/// What passes have in common, and their bindings from the third on.
const sort = (...more) => `
struct Pass { shift: u32, source: u32, first: u32, zero: u32 }  // source: of counts; first: drop keys 0xffffffff
${bindings('uniform pass_: Pass', 'read counts: array<u32>', ...more)}
fn blocksOf(n: u32) -> u32 { return (n + ${SORT_BLOCK - 1}u) / ${SORT_BLOCK}u; }
fn kept(key: u32) -> bool { return pass_.first == 0u || key != 0xffffffffu; }
fn digitOf(key: u32) -> u32 { return (key >> pass_.shift) & 15u; }
`;

/// Sums over every so many threads of a workgroup, of one number of each, at most 2^32 - 1. Ends with a barrier.
export const groupScan = (threads = WORKGROUP) => `
var<workgroup> sums: array<u32, ${WORKGROUP}>;
fn saturated(a: u32, b: u32) -> u32 { return select(a + b, 0xffffffffu, a + b < a); }
fn inclusive(t: u32, x: u32) -> u32 {
  var sum = x;
  sums[t] = sum;
  workgroupBarrier();
  for (var step = 1u; step < ${threads}u; step <<= 1u) {
    var other = 0u;
    if (t % ${threads}u >= step) { other = sums[t - step]; }
    workgroupBarrier();
    sum = saturated(sum, other);
    sums[t] = sum;
    workgroupBarrier();
  }
  return sum;
}
`;

/// Replaces n numbers of an array from first on by the sums of those before them; before is then that of all.
export const scanOf = (array, first) => `
  var before = 0u;
  for (var begin = 0u; begin < n; begin += ${WORKGROUP}u) {
    let k = begin + t; let at = ${first} + k;
    var x = 0u;
    if (k < n) { x = ${array}[at]; }
    let sum = inclusive(t, x);
    if (k < n) { ${array}[at] = saturated(before, sum - x); }
    before = saturated(before, sums[${WORKGROUP - 1}]);
    workgroupBarrier();
  }`;

export const SORT_COUNT = `${sort('read keysIn: array<u32>', 'write histogram: array<u32>')}
var<workgroup> bins: array<atomic<u32>, 16>;
${MAIN}
  let n = counts[pass_.source]; let blocks = blocksOf(n);
  if (t < 16u) { atomicStore(&bins[t], 0u); }
  workgroupBarrier();
  for (var k = 0u; k < ${SORT_ITEMS}u; k++) {
    let at = block.x * ${SORT_BLOCK}u + k * ${WORKGROUP}u + t;
    if (at < n && kept(keysIn[at])) { atomicAdd(&bins[digitOf(keysIn[at])], 1u); }
  }
  workgroupBarrier();
  if (t < 16u && block.x < blocks) { histogram[t * blocks + block.x] = atomicLoad(&bins[t]); }
}`;

export const SORT_SCAN = `${sort('write histogram: array<u32>', 'write totals: array<u32>')}${groupScan()}
var<workgroup> sharedBlocks: u32;
${MAIN}
  if (t == 0u) { sharedBlocks = blocksOf(counts[pass_.source]); }
  let n = workgroupUniformLoad(&sharedBlocks);${scanOf('histogram', 'block.x * n')}
  if (t == 0u) { totals[block.x] = before; }
}`;

export const SORT_SCATTER = `${sort(
  'read keysIn: array<u32>', 'read valuesIn: array<u32>', 'write keysOut: array<u32>', 'write valuesOut: array<u32>',
  'read histogram: array<u32>', 'read totals: array<u32>')}${groupScan(32)}
// places[d * WORKGROUP + t]: how many keys of digit d (low half) and d + 8 (high half) thread t has; then, how many come
// before them in the block.
var<workgroup> places: array<u32, ${8 * WORKGROUP}>;
var<workgroup> starts: array<u32, 16>;
${MAIN}
  let n = counts[pass_.source]; let blocks = blocksOf(n);
  for (var d = 0u; d < 8u; d++) { places[d * ${WORKGROUP}u + t] = 0u; }
  if (t < 16u && block.x < blocks) {
    var before = histogram[t * blocks + block.x];
    for (var d = 0u; d < t; d++) { before += totals[d]; }
    starts[t] = before;
  }
  let begin = block.x * ${SORT_BLOCK}u + t * ${SORT_ITEMS}u;  // a thread's keys are consecutive: the sort is stable
  var key: array<u32, ${SORT_ITEMS}>;
  for (var k = 0u; k < ${SORT_ITEMS}u; k++) {
    if (begin + k >= n) { break; }
    key[k] = keysIn[begin + k];
    let digit = digitOf(key[k]);
    if (kept(key[k])) { places[(digit & 7u) * ${WORKGROUP}u + t] += select(1u, 65536u, digit >= 8u); }
  }
  workgroupBarrier();
  // 32 threads for each pair of digits add up 8 numbers each.
  var sum = 0u;
  for (var k = 0u; k < 8u; k++) { sum += places[8u * t + k]; }
  var before = inclusive(t, sum) - sum;
  for (var k = 0u; k < 8u; k++) {
    let x = places[8u * t + k];
    places[8u * t + k] = before;
    before += x;
  }
  workgroupBarrier();
  for (var k = 0u; k < ${SORT_ITEMS}u; k++) {
    let at = begin + k;
    if (at < n && kept(key[k])) {
      let digit = digitOf(key[k]); let high = digit >= 8u;
      let cell = (digit & 7u) * ${WORKGROUP}u + t; let both = places[cell];
      let to = starts[digit] + select(both & 65535u, both >> 16u, high);
      places[cell] = both + select(1u, 65536u, high);
      keysOut[to] = key[k];
      if (pass_.first != 0u) { valuesOut[to] = at; } else { valuesOut[to] = valuesIn[at]; }
    }
  }
}`;
