// Draws with WebGL 2, where there is no WebGPU: footprints of one sample, blended back to front. A renderer
// (renderers.js).

import { CONSTANTS } from './constants.js';
import { startSorter } from './load.js';
import { Projection, largestCount } from './webgl_project.js';
import {
  FULL_SCREEN, GL_KINDS, PRESENT, SPLATS_PER_INSTANCE, drawFragmentShader, drawVertexShader,
} from './webgl_shaders.js';
import { bindTextures, createFramebuffer, createProgram, createTexture, fillTexture } from './webgl_tools.js';

const GEOMETRY_STRIDE = 12;
const POLL = 50;  // ms

/// The worker, asked for one order at a time.
class Sorter {
  constructor({ geometry, meta }) {
    this.worker = startSorter();
    this.known = null;  // row of the matrix whose order is known
    this.busy = null;
    this.worker.postMessage({ means: geometry, stride: GEOMETRY_STRIDE, count: meta.count });
  }

  knows(w2c) {
    return this.known === w2c.slice(8, 12).join();
  }

  /// Asks for the indices of the Gaussians in front of a camera, the farthest first, unless the worker is at work.
  /// `take` is called with them.
  ask(w2c, take) {
    this.busy ??= new Promise((resolve, reject) => {
      this.worker.onmessage = ({ data }) => resolve(data.order);
      this.worker.onerror = () => reject(new Error('The worker that sorts the Gaussians has stopped.'));
      // Rounded as the rasterizer rounds the matrix.
      this.worker.postMessage({ row: Float32Array.from(w2c.slice(8, 12)), near: CONSTANTS.kNear });
    }).then(order => {
      this.known = w2c.slice(8, 12).join();
      take(order);
    }).finally(() => { this.busy = null; });
    return this.busy;
  }
}

export class WebGLRenderer {
  /// Throws an Error with a sentence where the browser or the device cannot do it. `bits` per channel that are blended,
  /// at most: 8, 16, or 32 where the picture is settled.
  static async create(canvas, meta, { bits = 32, fullDifference }) {
    const gl = canvas.getContext('webgl2', {
      antialias: false, alpha: false, depth: false, stencil: false, powerPreference: 'high-performance',
    });
    if (!gl) throw new Error('This viewer needs WebGPU or WebGL 2, which this browser or this machine does not offer.');
    if (gl.getParameter(gl.MAX_TEXTURE_SIZE) < 4096) throw new Error('This viewer needs textures of 4096 pixels.');
    const { count, sh_degree: degree } = meta, most = largestCount(gl.getParameter(gl.MAX_TEXTURE_SIZE), degree);
    if (count > most) {
      throw new Error(`The scene has ${count.toLocaleString('en')} Gaussians; this device can hold ` +
        `${most.toLocaleString('en')} of spherical harmonics of degree ${degree}.`);
    }
    return new WebGLRenderer(canvas, gl, bits, fullDifference);
  }

  constructor(canvas, gl, bits, fullDifference) {
    Object.assign(this, { canvas, gl, fullDifference });
    this.name = 'WebGL 2';
    this.isLost = false;
    this.lost = new Promise(resolve => canvas.addEventListener('webglcontextlost', event => {
      event.preventDefault();
      this.isLost = true;
      resolve();
    }, { once: true }));
    this.returned = new Promise(resolve => canvas.addEventListener('webglcontextrestored', resolve, { once: true }));
    const halves = gl.getExtension('EXT_color_buffer_float') ?? gl.getExtension('EXT_color_buffer_half_float');
    const floats = gl.getExtension('EXT_color_buffer_float') && gl.getExtension('EXT_float_blend');
    this.bits = halves ? bits : 8;
    const full = [gl.RGBA32F, gl.RGBA, gl.FLOAT], half = [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT];
    const bytes = [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE];
    // Half floats are quick, but some devices cut them off at every blend where others round.
    this.quickFormat = this.bits === 8 ? bytes : half;
    this.settledFormat = this.bits === 8 ? bytes : floats && bits !== 16 ? full : half;
    this.programs = new Map();
    this.pictures = new Map();
    this.fullScreen = gl.createVertexArray();
    this.quads = this.createQuads();
  }

  /// Throws an Error with a sentence where the device cannot hold the scene.
  async load(scene) {
    this.projection = new Projection(this.gl, scene);
    this.sorter = new Sorter(scene);
  }

  draws({ kind, samples }) {
    return samples === 1 && kind in GL_KINDS;
  }

  /// Triangles of SPLATS_PER_INSTANCE quads, whose corners the vertex shader numbers.
  createQuads() {
    const gl = this.gl, quads = gl.createVertexArray();
    const indices = new Uint16Array(6 * SPLATS_PER_INSTANCE);
    for (let i = 0; i < SPLATS_PER_INSTANCE; ++i) indices.set([0, 1, 2, 2, 1, 3].map(k => 4 * i + k), 6 * i);
    gl.bindVertexArray(quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return quads;
  }

  program(key, vertex, fragment) {
    if (!this.programs.has(key)) this.programs.set(key, createProgram(this.gl, vertex(), fragment()));
    return this.programs.get(key);
  }

  /// The picture with this name; made anew when its size or format changes.
  picture(name, { width, height }, format) {
    const gl = this.gl, old = this.pictures.get(name);
    if (old?.width === width && old.height === height && old.format === format) return old;
    if (old) {
      gl.deleteFramebuffer(old.framebuffer);
      gl.deleteTexture(old.texture);
    }
    const texture = createTexture(gl, width, height, format);
    const made = { width, height, format, texture, framebuffer: createFramebuffer(gl, [texture]) };
    this.pictures.set(name, made);
    return made;
  }

  /// Takes a picture from elsewhere: colour and transmittance, which is -1 where the other picture is to be shown.
  put(name, { width, height }, values) {
    const { gl } = this, format = [gl.RGBA32F, gl.RGBA, gl.FLOAT];
    gl.deleteTexture(this.pictures.get(name)?.texture ?? null);
    const texture = createTexture(gl, width, height, format);
    fillTexture(gl, texture, width, format, 4, values.map((value, at) => (at % 4 === 3 ? 1 - value : value)));
    this.pictures.set(name, { width, height, texture });
  }

  /// Draws pictures, each {name, footprint, span}, of which the columns from span[0] on up to span[1] are needed [px];
  /// `settled` ones as exactly as the device can. False if `cancelled` has become true; there is no picture then.
  async draw({ camera, pictures, settled, cancelled = () => false }) {
    const { sorter } = this;
    while (!sorter.knows(camera.w2c)) {
      const order = sorter.ask(camera.w2c, found => { if (!this.isLost) this.projection.setOrder(found); });
      // An order that is a little old will do while the camera moves.
      if (!settled && sorter.known !== null) break;
      await Promise.race([order, new Promise(resolve => setTimeout(resolve, POLL))]);
      if (cancelled()) return false;
    }
    this.complain();
    for (const { name, footprint, span } of pictures) this.drawPicture(name, camera, footprint, settled, span);
    await this.finished();
    this.complain();
    return true;
  }

  complain() {
    if (this.isLost || this.gl.isContextLost()) throw new Error('The graphics device was lost.');
  }

  drawPicture(name, camera, footprint, settled, span = [0, camera.width]) {
    const gl = this.gl, { width, height } = camera, { projection } = this;
    const picture = this.picture(name, camera, settled ? this.settledFormat : this.quickFormat);
    projection.project(camera, footprint);
    const { program, uniforms } = this.program(
      `draw ${footprint.kind}`, () => drawVertexShader(footprint.kind), () => drawFragmentShader(footprint.kind));
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(span[0], 0, Math.max(span[1] - span[0], 0), height);
    gl.useProgram(program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, picture.framebuffer);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    const [uMean, uWhitening, uColor] = projection.splats;
    bindTextures(gl, uniforms, { uMean, uWhitening, uColor, uOrder: projection.order });
    gl.uniform1i(uniforms.uVisible, projection.visible);
    gl.uniform2f(uniforms.uSize, width, height);
    gl.bindVertexArray(this.quads);
    const instances = Math.ceil(projection.visible / SPLATS_PER_INSTANCE);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * SPLATS_PER_INSTANCE, gl.UNSIGNED_SHORT, 0, instances);
    gl.disable(gl.SCISSOR_TEST);
  }

  /// Resolves when the device has drawn everything, or is lost.
  async finished() {
    const { gl } = this, fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (!gl.isContextLost() && gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.UNSIGNALED) {
      await new Promise(resolve => setTimeout(resolve, 1));
    }
    gl.deleteSync(fence);
  }

  /// Shows the picture `left`, beside it from column `divider` of the canvas on `right`, or the difference of the two.
  present({ left, right = null, divider = 0, difference = false, background }) {
    const gl = this.gl, { width, height } = this.canvas;
    const a = this.pictures.get(left), b = this.pictures.get(right ?? left);
    const { program, uniforms } = this.program('present', () => FULL_SCREEN, () => PRESENT);
    gl.useProgram(program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.BLEND);
    bindTextures(gl, uniforms, { uLeft: a.texture, uRight: b.texture });
    gl.uniform2f(uniforms.uCanvas, width, height);
    gl.uniform2f(uniforms.uSize, a.width, a.height);
    gl.uniform3f(uniforms.uBackground, ...background);
    gl.uniform1f(uniforms.uDivider, right === null ? width : divider);
    gl.uniform1i(uniforms.uDifference, difference ? 1 : 0);
    gl.uniform1f(uniforms.uFull, this.fullDifference);
    gl.bindVertexArray(this.fullScreen);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /// Colour and transmittance of a picture: four numbers a pixel. Rejects where there is none, as after the device was
  /// lost.
  async read(name) {
    const gl = this.gl, picture = this.pictures.get(name);
    if (!picture || gl.isContextLost()) throw new Error('There is no picture: the graphics device was lost since.');
    const { framebuffer, width, height } = picture, pixels = width * height;
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    let values = new Float32Array(4 * pixels);
    if (this.bits === 8) {
      const bytes = new Uint8Array(4 * pixels);
      gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
      values = Float32Array.from(bytes, byte => byte / 255);
    } else {
      gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, values);
    }
    if (gl.isContextLost()) throw new Error('The graphics device was lost while the picture was read.');
    return values.map((value, at) => (at % 4 === 3 ? 1 - value : value));
  }

  dispose() {
    this.sorter?.worker.terminate();
  }
}
