// The passes of a picture with WebGPU: their buffers, pipelines and order. Default limits are enough for all of them: at
// most 7 storage buffers, 256 threads, 9.3 KiB of workgroup memory. Timestamps are an optional feature: they are shown.

import { COUNT_VISIBLE, RANGES, SCAN_BLOCKS, SCAN_REDUCE, emit } from './bin.wgsl.js';
import { blend } from './blend.wgsl.js';
import { FRAME_BYTES, TILE, WORKGROUP } from './frame.wgsl.js';
import { project } from './project.wgsl.js';
import { sceneBytes } from './sh.js';
import { SORT_BITS, SORT_BLOCK, SORT_COUNT, SORT_SCAN, SORT_SCATTER } from './sort.wgsl.js';

const MOST_WORKGROUPS = 65535;  // along one direction
const SPLAT_BYTES = 48;
export const WORKING_BYTES = SPLAT_BYTES + 5 * 4;  // of a Gaussian beside the scene: splat, depths, order, tiles
const FIRST_ROOM = 65536;       // pairs, until it is known how many there are
// Byte offsets of the arguments of indirect dispatches, which COUNT_VISIBLE and SCAN_BLOCKS write.
const VISIBLE_SORT = 0, VISIBLE_EMIT = 16, PAIRS_SORT = 32;

export const STAGES = ['project', 'sort', 'bin', 'sort tiles', 'blend'];  // of a picture, in this order

/// A dispatch of `size` workgroups. `key` names the shader, of which `code` returns the text.
const step = (stage, key, code, buffers, size) => ({ stage, key, code, buffers, size });

/// Bytes of the largest binding that a scene needs.
export const largestBinding = meta => meta.count * Math.max(SPLAT_BYTES, ...sceneBytes(meta));

/// Pipelines and bind groups, each made once.
class Pipelines {
  constructor(device) {
    this.device = device;
    this.made = new Map();
    this.groups = {};
  }

  /// Compiles what these steps need. Calls `note` with how many shaders are done and how many there are.
  async prepare(steps, note = () => {}) {
    const missing = new Map(steps.filter(({ key }) => !this.made.has(key)).map(step => [step.key, step]));
    let done = 0;
    if (missing.size > 0) note(0, missing.size);
    await Promise.all([...missing.values()].map(async ({ key, code }) => {
      const module = this.device.createShaderModule({ code: code(), label: key });
      this.made.set(key, await this.device.createComputePipelineAsync({
        layout: 'auto', compute: { module, entryPoint: 'main' }, label: key,
      }));
      note(++done, missing.size);
    }));
  }

  encode(pass, { key, buffers, size }) {
    const pipeline = this.made.get(key), name = [key, ...buffers.map(buffer => buffer.label)].join();
    this.groups[name] ??= this.device.createBindGroup({
      layout: pipeline.getBindGroupLayout(0),
      entries: buffers.map((buffer, binding) => ({ binding, resource: { buffer } })),
    });
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, this.groups[name]);
    if (size.indirect) pass.dispatchWorkgroupsIndirect(size.indirect, size.offset);
    else pass.dispatchWorkgroups(...size);
  }
}

export class Passes {
  /// Uploads the scene, which loadScene returned.
  constructor(device, { meta, geometry, harmonics, packed = geometry }) {
    this.device = device;
    this.pipelines = new Pipelines(device);
    this.count = meta.count;
    this.meta = meta;
    this.numbered = 0;
    this.uniforms = {};
    this.room = 0;
    const n = this.count, words = 4 * n;
    this.geometry = this.buffer(packed.byteLength, packed);
    this.harmonics = this.buffer(harmonics.byteLength, harmonics);
    this.splats = this.buffer(SPLAT_BYTES * n);
    this.depths = [this.buffer(words), this.buffer(words)];
    this.order = [this.buffer(words), this.buffer(words)];
    this.tiles = this.buffer(words);
    this.blocks = this.buffer(4 * (Math.ceil(n / WORKGROUP) + 1));
    this.counts = this.buffer(16, new Uint32Array([n, 0, 0, 0]));
    this.arguments = this.buffer(48, null, GPUBufferUsage.INDIRECT);
    this.totals = this.buffer(64);
    this.frame = this.buffer(FRAME_BYTES, null, GPUBufferUsage.UNIFORM);
    if (device.features.has('timestamp-query')) {
      this.queries = device.createQuerySet({ type: 'timestamp', count: 2 * STAGES.length });
      this.stamps = this.buffer(16 * STAGES.length, null, GPUBufferUsage.QUERY_RESOLVE);
    }
    this.reserve(FIRST_ROOM);
  }

  buffer(bytes, data = null, usage = 0) {
    const { STORAGE, COPY_DST, COPY_SRC } = GPUBufferUsage;
    const size = Math.max(4 * Math.ceil(bytes / 4), 16), label = `${++this.numbered}`;
    const buffer = this.device.createBuffer({ size, label, usage: STORAGE | COPY_DST | COPY_SRC | usage });
    if (data) this.device.queue.writeBuffer(buffer, 0, data);
    return buffer;
  }

  /// A uniform of four whole numbers that never change.
  constant(...words) {
    return this.uniforms[words.join()] ??= this.buffer(16, new Uint32Array(words), GPUBufferUsage.UNIFORM);
  }

  get mostPairs() { return Math.floor(this.device.limits.maxStorageBufferBindingSize / 4); }

  /// Makes room for so many pairs, or as many as a binding can have, and forgets those that there were.
  reserve(room) {
    this.room = Math.min(room, this.mostPairs);
    for (const buffer of [...(this.pairKeys ?? []), ...(this.pairs ?? []), this.histogram]) buffer?.destroy();
    this.pairKeys = [this.buffer(4 * this.room), this.buffer(4 * this.room)];
    this.pairs = [this.buffer(4 * this.room), this.buffer(4 * this.room)];
    this.histogram = this.buffer(64 * (Math.ceil(Math.max(this.room, this.count) / SORT_BLOCK) + 1));
    this.pipelines.groups = {};
  }

  indirect(offset) { return { indirect: this.arguments, offset }; }

  /// Steps of a stable sort of two pairs of buffers into the first ones. `source` is where counts has their number.
  *sort(stage, keys, values, bits, source, offset, drops) {
    for (let shift = 0; shift < bits; shift += SORT_BITS) {
      const first = drops && shift === 0, uniform = this.constant(shift, first ? 0 : source, first ? 1 : 0, 0);
      const size = first ? [Math.ceil(this.count / SORT_BLOCK)] : this.indirect(offset);
      const { counts, histogram, totals } = this;
      yield step(stage, 'sort count', () => SORT_COUNT, [uniform, counts, keys[0], histogram], size);
      yield step(stage, 'sort scan', () => SORT_SCAN, [uniform, counts, histogram, totals], [2 ** SORT_BITS]);
      const buffers = [uniform, counts, keys[0], values[0], keys[1], values[1], histogram, totals];
      yield step(stage, 'sort scatter', () => SORT_SCATTER, buffers, size);
      keys.reverse();
      values.reverse();
      if (first) yield step(stage, 'count visible', () => COUNT_VISIBLE, [totals, counts, this.arguments], [1]);
    }
  }

  /// The steps that fill the lists of a picture of [columns, rows] of tiles, and a function that makes one that blends.
  steps(footprint, [columns, rows], width, ranges, picture) {
    const { counts, tiles, blocks, splats, frame } = this, { kind } = footprint;
    const depths = [...this.depths], order = [...this.order], pairKeys = [...this.pairKeys], pairs = [...this.pairs];
    const groups = Math.ceil(this.count / WORKGROUP), across = Math.min(groups, MOST_WORKGROUPS);
    const steps = [
      step('project', `project ${kind}`, () => project(kind, this.meta),
        [frame, this.geometry, this.harmonics, splats, depths[0], tiles], [across, Math.ceil(groups / across)]),
      ...this.sort('sort', depths, order, 32, 1, VISIBLE_SORT, true),
      step('bin', 'scan reduce', () => SCAN_REDUCE, [counts, order[0], tiles, blocks], this.indirect(VISIBLE_EMIT)),
      step('bin', 'scan blocks', () => SCAN_BLOCKS, [frame, counts, blocks, this.arguments], [1]),
      step('bin', `emit ${kind}`, () => emit(kind),
        [frame, counts, order[0], blocks, tiles, splats, pairKeys[0], pairs[0]], this.indirect(VISIBLE_EMIT)),
      ...this.sort('sort tiles', pairKeys, pairs, Math.ceil(Math.log2(columns * rows + 1)), 2, PAIRS_SORT, false),
      step('sort tiles', 'ranges', () => RANGES, [counts, pairKeys[0], ranges], this.indirect(PAIRS_SORT)),
    ];
    const blended = (first, number) => step('blend', `blend ${kind} ${footprint.samples}`, () => blend(footprint),
      [frame, this.constant(first, 0, 0, 0), ranges, pairs[0], splats, picture], [width, number]);
    return { steps, blended };
  }

  /// Each stage is a pass of its own, for the timestamps of its begin and end.
  encode(encoder, steps) {
    for (const [k, stage] of STAGES.entries()) {
      const own = steps.filter(step => step.stage === stage), { queries: querySet } = this;
      if (own.length === 0) continue;
      const pass = encoder.beginComputePass(querySet &&
        { timestampWrites: { querySet, beginningOfPassWriteIndex: 2 * k, endOfPassWriteIndex: 2 * k + 1 } });
      for (const step of own) this.pipelines.encode(pass, step);
      pass.end();
    }
  }

  stamp(encoder, buffer, at) {
    if (!this.queries) return;
    encoder.resolveQuerySet(this.queries, 0, 2 * STAGES.length, this.stamps, 0);
    encoder.copyBufferToBuffer(this.stamps, 0, buffer, at, 16 * STAGES.length);
  }
}

/// Columns and rows of tiles of a picture.
export const tilesOf = ({ width, height }) => [Math.ceil(width / TILE), Math.ceil(height / TILE)];
