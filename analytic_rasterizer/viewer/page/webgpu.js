// Draws with WebGPU: every footprint, by tiles and front to back, as the rasterizer does. A renderer (renderers.js).

import { KINDS, sampling } from './footprint.wgsl.js';
import { TILE, frameData } from './frame.wgsl.js';
import { PRESENT, SCREEN_BYTES, screenData } from './present.wgsl.js';
import { noRoom } from './sh.js';
import { Passes, STAGES, WORKING_BYTES, largestBinding, tilesOf } from './webgpu_passes.js';

const BAND_TIME = 250;   // ms that the device may blend at a stretch: systems end what seems to hang
const FIRST_BANDS = 8;   // of a picture, as long as nothing has been measured
const GROWTH = 1.25;     // of the room for pairs

export class WebGPURenderer {
  static async create(canvas, meta, software) {
    if (!navigator.gpu) throw new Error('this browser has no WebGPU.');
    const adapter = await navigator.gpu.requestAdapter({ powerPreference: 'high-performance' });
    if (!adapter) throw new Error('WebGPU finds no graphics device here.');
    const inSoftware = adapter.info?.isFallbackAdapter ?? adapter.isFallbackAdapter ?? false;
    if (inSoftware && !software) throw new Error('WebGPU would have no graphics device here.');
    const needed = largestBinding(meta), { maxStorageBufferBindingSize: most } = adapter.limits;
    if (needed > most) {
      const fit = form => Math.floor(most / largestBinding({ ...form, count: 1 })).toLocaleString('en');
      throw new Error(`the scene has ${meta.count.toLocaleString('en')} Gaussians, and WebGPU on this device can hold ` +
        `${fit(meta)} of spherical harmonics of degree ${meta.sh_degree}` +
        `${meta.compact ? '.' : `, or ${fit({ ...meta, compact: 1 })} with --compact.`}`);
    }
    // Where the default of 128 MiB is enough, none is asked for.
    const requiredLimits = needed <= 2 ** 27 ? {}
      : { maxStorageBufferBindingSize: most, maxBufferSize: adapter.limits.maxBufferSize };
    const requiredFeatures = ['timestamp-query'].filter(feature => adapter.features.has(feature));
    const device = await adapter.requestDevice({ requiredLimits, requiredFeatures });
    const context = canvas.getContext('webgpu');
    if (!context) throw new Error('WebGPU cannot draw into the page.');
    return new WebGPURenderer(canvas, context, device);
  }

  constructor(canvas, context, device) {
    Object.assign(this, { canvas, context, device });
    this.name = 'WebGPU';
    this.pictures = new Map();
    this.rate = null;    // ms for a sample of a pair
    this.pairs = null;   // of the last picture, as soon as there is a rate
    this.stages = {};    // ms of the last frame, where the device tells
    this.turn = Promise.resolve();
    this.progress = () => {};
    this.isLost = false;
    this.lost = device.lost.then(() => { this.isLost = true; });
    this.returned = Promise.resolve();
    device.addEventListener('uncapturederror', ({ error }) => { this.error ??= error.message; });
    const format = navigator.gpu.getPreferredCanvasFormat();
    context.configure({ device, format, alphaMode: 'opaque' });
    const module = device.createShaderModule({ code: PRESENT });
    this.show = device.createRenderPipeline({
      layout: 'auto', vertex: { module, entryPoint: 'corner' },
      fragment: { module, entryPoint: 'show', targets: [{ format }] },
    });
    const { UNIFORM, COPY_DST, MAP_READ } = GPUBufferUsage;
    this.screen = device.createBuffer({ size: SCREEN_BYTES, usage: UNIFORM | COPY_DST });
    this.numbers = device.createBuffer({ size: 16 + 16 * STAGES.length, usage: MAP_READ | COPY_DST });
  }

  async load(scene) {
    if (await this.fits(() => { this.passes = new Passes(this.device, scene); })) return;
    throw noRoom(scene.meta, WORKING_BYTES);
  }

  /// Whether the device had the memory for what `make` does.
  async fits(make) {
    this.device.pushErrorScope('out-of-memory');
    make();
    return await this.device.popErrorScope() === null;
  }

  draws({ kind }) { return kind in KINDS; }

  draw(request) {
    const drawn = this.turn.then(() => this.drawNow(request));
    this.turn = drawn.catch(() => {});  // buffers are for one picture at a time
    return drawn;
  }

  async drawNow({ camera, pictures, cancelled = () => false }) {
    this.stages = {};
    for (const { name, footprint, span = [0, camera.width] } of pictures) {
      const picture = this.picture(name, camera), [, rows] = tilesOf(camera);
      const region = [Math.floor(span[0] / TILE), 0, Math.ceil(span[1] / TILE), rows];
      if (region[0] >= region[2]) continue;
      if (!await this.drawRegion(picture, camera, footprint, region, cancelled)) return false;
    }
    await this.device.queue.onSubmittedWorkDone();
    this.complain();
    return true;
  }

  complain() {
    if (this.isLost) throw new Error('The graphics device was lost.');
    if (this.error) throw new Error(`This browser's graphics driver rejects a command: ${this.error}`);
  }

  /// The picture with this name, of the size of the camera's.
  picture(name, camera) {
    const { width, height } = camera, old = this.pictures.get(name);
    if (old?.width === width && old.height === height) return old;
    old?.buffer.destroy();
    old?.ranges.destroy();
    const [columns, rows] = tilesOf(camera);
    const made = { width, height, buffer: this.passes.buffer(16 * width * height),
      ranges: this.passes.buffer(8 * (columns * rows + 1)) };
    this.pictures.set(name, made);
    this.passes.pipelines.groups = {};
    return made;
  }

  put(name, size, values) {
    this.device.queue.writeBuffer(this.picture(name, size).buffer, 0, values);
  }

  async drawRegion(picture, camera, footprint, region, cancelled) {
    const { device, passes } = this, [, top, , bottom] = region, rows = bottom - top;
    for (;;) {
      const { steps, blended } = passes.steps(
        footprint, tilesOf(camera), region[2] - region[0], picture.ranges, picture.buffer);
      await passes.pipelines.prepare(
        [...steps, blended(top, rows)], (...parts) => this.progress('WebGPU compiles its shaders', ...parts));
      const frame = frameData(camera, footprint.variance, sampling(footprint).reach, region, passes.count, passes.room);
      device.queue.writeBuffer(passes.frame, 0, frame);
      const bands = this.bands(footprint, rows), start = performance.now();
      const encoder = device.createCommandEncoder();
      encoder.clearBuffer(picture.ranges);
      passes.encode(encoder, bands === 1 ? [...steps, blended(top, rows)] : steps);
      encoder.copyBufferToBuffer(passes.counts, 0, this.numbers, 0, 16);
      passes.stamp(encoder, this.numbers, 16);
      device.queue.submit([encoder.finish()]);
      await this.numbers.mapAsync(GPUMapMode.READ);
      const numbers = this.numbers.getMappedRange().slice(0), wanted = new Uint32Array(numbers)[3];
      this.numbers.unmap();
      this.complain();
      if (wanted > passes.room) {  // what was blended has holes
        if (await this.grow(Math.ceil(GROWTH * wanted), wanted)) continue;
        if (rows < 2) throw new Error('A row of this picture has more splats than the device can hold.');
        const middle = top + (rows >> 1), [left, , right] = region;
        return await this.drawRegion(picture, camera, footprint, [left, top, right, middle], cancelled)
          && await this.drawRegion(picture, camera, footprint, [left, middle, right, bottom], cancelled);
      }
      this.pairs = wanted;
      if (passes.queries) this.noteStages(new BigUint64Array(numbers, 16), bands === 1 ? STAGES : STAGES.slice(0, -1));
      if (bands === 1) this.rate = (performance.now() - start) / (Math.max(wanted, 1) * footprint.samples);
      return bands === 1 || await this.blendInBands(blended, footprint, top, bottom, bands, cancelled);
    }
  }

  /// Room for more pairs. False where the device has not got it; there is less room then.
  async grow(room, needed) {
    const before = this.passes.room;
    if (needed > this.passes.mostPairs) return false;
    if (await this.fits(() => this.passes.reserve(room))) return true;
    this.passes.reserve(before);
    return false;
  }

  /// Bands of rows in which a picture is blended.
  bands(footprint, rows) {
    const wanted = this.rate === null ? FIRST_BANDS : (this.rate * this.pairs * footprint.samples) / BAND_TIME;
    return Math.min(Math.max(Math.ceil(wanted), 1), rows);
  }

  noteStages(stamps, stages) {
    for (const [k, stage] of stages.entries()) {
      this.stages[stage] = (this.stages[stage] ?? 0) + Number(stamps[2 * k + 1] - stamps[2 * k]) / 1e6;
    }
  }

  async blendInBands(blended, footprint, top, bottom, bands, cancelled) {
    const height = Math.ceil((bottom - top) / bands), start = performance.now();
    for (let row = top; row < bottom; row += height) {
      if (cancelled()) return false;
      this.progress('WebGPU draws', row - top, bottom - top);
      const encoder = this.device.createCommandEncoder();
      this.passes.encode(encoder, [blended(row, Math.min(height, bottom - row))]);
      this.device.queue.submit([encoder.finish()]);
      await this.device.queue.onSubmittedWorkDone();
    }
    const took = performance.now() - start;
    this.rate = took / (Math.max(this.pairs, 1) * footprint.samples);
    if (this.passes.queries) this.stages.blend = (this.stages.blend ?? 0) + took;
    return true;
  }

  present({ left, right = null, divider = 0, difference = false, background }) {
    const a = this.pictures.get(left), b = this.pictures.get(right ?? left), { canvas, device } = this;
    const at = right === null ? canvas.width : divider;
    device.queue.writeBuffer(this.screen, 0, screenData({ canvas, size: a, divider: at, difference, background }));
    const group = device.createBindGroup({
      layout: this.show.getBindGroupLayout(0),
      entries: [this.screen, a.buffer, b.buffer].map((buffer, binding) => ({ binding, resource: { buffer } })),
    });
    const encoder = device.createCommandEncoder();
    const pass = encoder.beginRenderPass({ colorAttachments: [{
      view: this.context.getCurrentTexture().createView(), loadOp: 'clear', storeOp: 'store',
    }] });
    pass.setPipeline(this.show);
    pass.setBindGroup(0, group);
    pass.draw(3);
    pass.end();
    device.queue.submit([encoder.finish()]);
  }

  async read(name) {
    const picture = this.pictures.get(name);
    if (!picture || this.isLost) throw new Error('There is no picture: the graphics device was lost since.');
    const { MAP_READ, COPY_DST } = GPUBufferUsage, { size } = picture.buffer;
    const staging = this.device.createBuffer({ size, usage: MAP_READ | COPY_DST });
    const encoder = this.device.createCommandEncoder();
    encoder.copyBufferToBuffer(picture.buffer, 0, staging, 0, size);
    this.device.queue.submit([encoder.finish()]);
    await staging.mapAsync(GPUMapMode.READ);
    const values = new Float32Array(staging.getMappedRange().slice(0));
    staging.destroy();
    return values;
  }

  dispose() { this.device.destroy(); }
}
