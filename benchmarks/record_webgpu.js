// Records what the viewer's page asks of WebGPU: its renderer draws with a device that only takes notes. Runs beside the
// modules of the page. Reads given.json: meta of the scene, cameras, names of footprints, and pairs, a number of pairs
// of splat and tile to make room for. Prints one JSON object:
//
//   buffers      size and usage by number
//   pipelines    texts of shaders
//   setup, and writes of a frame: [buffer, byte, 'geometry', 'harmonics' or bytes in base64]
//   frames       by size and footprint, one for each camera: writes, commands, and the buffers of the picture and of
//                the numbers that the page reads back (counts of bin.wgsl.js, then begin and end of every stage)
//   stages       their names

import { readFileSync } from 'fs';

const given = JSON.parse(readFileSync('given.json', 'utf8'));
const buffers = [], pipelines = [];
let writes = [], commands = [], numbers = null;

class RecordedBuffer {
  constructor({ size, usage, label }) {
    Object.assign(this, { size, label, number: buffers.length });
    buffers.push([size, usage]);
  }

  destroy() {}

  async mapAsync() {
    numbers = this.number;
  }

  getMappedRange() {
    const mapped = new ArrayBuffer(this.size);
    new Uint32Array(mapped, 0, 4).fill(given.pairs);
    return mapped;
  }

  unmap() {}
}

class RecordedPass {
  constructor(stamps) {
    this.steps = [];
    const { beginningOfPassWriteIndex: begin, endOfPassWriteIndex: end } = stamps;
    commands.push(['run', begin, end, this.steps]);
  }

  setPipeline(pipeline) { this.pipeline = pipeline; }

  setBindGroup(_, group) { this.group = group; }

  dispatchWorkgroups(...size) { this.steps.push([this.pipeline.number, this.group, size, null]); }

  dispatchWorkgroupsIndirect(buffer, offset) {
    this.steps.push([this.pipeline.number, this.group, [buffer.number, offset], 'indirect']);
  }

  end() {}
}

const encoder = {
  clearBuffer: buffer => commands.push(['clear', buffer.number]),
  beginComputePass: ({ timestampWrites }) => new RecordedPass(timestampWrites),
  copyBufferToBuffer: (from, at, to, start, bytes) => commands.push(['copy', from.number, at, to.number, start, bytes]),
  resolveQuerySet: (_, first, count, buffer, at) => commands.push(['resolve', first, count, buffer.number, at]),
  finish() {},
};

const queue = {
  writeBuffer(buffer, at, data) {
    const bytes = data.bytes ?? Buffer.from(data.buffer ?? data).toString('base64');
    writes.push([buffer.number, at, bytes]);
  },
  submit() {},
  async onSubmittedWorkDone() {},
};

const makeDevice = ({ requiredLimits, requiredFeatures }) => ({
  queue,
  features: new Set(requiredFeatures),
  limits: { maxStorageBufferBindingSize: 2 ** 27, ...requiredLimits },
  lost: new Promise(() => {}),
  addEventListener() {},
  pushErrorScope() {},
  popErrorScope: async () => null,
  createBuffer: description => new RecordedBuffer(description),
  createShaderModule: ({ code }) => code,
  createRenderPipeline: () => null,
  createQuerySet: () => ({}),
  async createComputePipelineAsync({ compute }) {
    pipelines.push(compute.module);
    return { number: pipelines.length - 1, getBindGroupLayout: () => null };
  },
  createBindGroup: ({ entries }) => entries.map(({ resource }) => resource.buffer.number),
  createCommandEncoder: () => encoder,
});

const adapter = {
  info: { isFallbackAdapter: false },
  limits: { maxStorageBufferBindingSize: 2 ** 31, maxBufferSize: 2 ** 31 },
  features: new Set(['timestamp-query']),
  requestDevice: async description => makeDevice(description),
};

Object.assign(globalThis, {
  GPUBufferUsage: {
    MAP_READ: 1, COPY_SRC: 4, COPY_DST: 8, UNIFORM: 64, STORAGE: 128, INDIRECT: 256, QUERY_RESOLVE: 512,
  },
  GPUMapMode: { READ: 1 },
});
const navigator = { gpu: { requestAdapter: async () => adapter, getPreferredCanvasFormat: () => 'bgra8unorm' } };
Object.defineProperty(globalThis, 'navigator', { value: navigator });
Object.defineProperty(globalThis, 'performance', { value: { now: () => 0 } });  // quick: pictures are blended at once

const { WebGPURenderer } = await import('./webgpu.js');
const { parseFootprint } = await import('./constants.js');
const { sceneBytes } = await import('./sh.js');
const { STAGES } = await import('./webgpu_passes.js');

const canvas = { getContext: () => ({ configure() {} }) };
const renderer = await WebGPURenderer.create(canvas, given.meta, { fullDifference: 1 });
const [geometry, harmonics] = sceneBytes(given.meta).map((bytes, k) =>
  ({ byteLength: bytes * given.meta.count, bytes: ['geometry', 'harmonics'][k] }));
await renderer.load({ meta: given.meta, geometry, harmonics });

async function frameOf(camera, footprint) {
  [commands, writes] = [[], []];
  await renderer.draw({ camera, pictures: [{ name: 'drawn', footprint }] });
  return { writes, commands, picture: renderer.pictures.get('drawn').buffer.number, numbers };
}

const setup = writes, frames = {};
for (const [size, cameras] of Object.entries(given.cameras)) {
  frames[size] = {};
  for (const name of given.footprints) {
    const footprint = parseFootprint(name, given.meta.footprints), made = [];
    setup.push(...(await frameOf(cameras[0], footprint)).writes);  // makes what the next frames have in common
    for (const camera of cameras) made.push(await frameOf(camera, footprint));
    frames[size][name] = made;
  }
}
console.log(JSON.stringify({ buffers, pipelines, setup, frames, stages: STAGES }));
