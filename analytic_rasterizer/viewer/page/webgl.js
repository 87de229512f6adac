// Draws with WebGL 2, where there is no WebGPU: footprints of one sample. A fragment per Gaussian projects it into a
// splat; the splats are blended back to front, in the order of a worker. A renderer (renderers.js).

import { eyeAndLimits } from './camera.js';
import { CONSTANTS } from './constants.js';
import { startSorter } from './load.js';
import { noRoom } from './sh.js';
import {
  FULL_SCREEN, GL_KINDS, GL_PRESENT, SPLATS_PER_INSTANCE, SPLATS_PER_ROW, drawFragmentShader, drawVertexShader,
  projectShader, texelsOfHarmonics,
} from './webgl_shaders.js';
import { createFramebuffer, createProgram, createTexture, fillTexture, runProgram } from './webgl_tools.js';

const WORKING_BYTES_OF_GL = 3 * 16 + 4;  // of a Gaussian beside the scene: projected, order
const POLL = 50;                         // ms

/// The worker, asked for one order at a time.
class Sorter {
  constructor({ geometry, meta }) {
    this.worker = startSorter();
    this.known = null;  // row of the matrix whose order is known
    this.busy = null;
    this.worker.postMessage({ geometry, count: meta.count });
  }

  knows(w2c) { return this.known === w2c.slice(8, 12).join(); }

  /// Asks for the order that a camera sees, unless the worker is at work. `take` is called with it.
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
  static async create(canvas, meta) {
    const gl = canvas.getContext('webgl2', {
      antialias: false, alpha: false, depth: false, stencil: false, powerPreference: 'high-performance',
    });
    if (!gl) throw new Error('This viewer needs WebGPU or WebGL 2, which this browser or this machine does not offer.');
    if (!gl.getExtension('EXT_color_buffer_float')) {
      throw new Error('This viewer needs WebGPU, or WebGL 2 that draws into floats, which this device does not.');
    }
    if (gl.getParameter(gl.MAX_TEXTURE_SIZE) < 4096) throw new Error('This viewer needs textures of 4096 pixels.');
    const { count, sh_degree: degree } = meta, largest = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const most = largest * Math.min(SPLATS_PER_ROW, Math.floor(largest / texelsOfHarmonics(degree)));
    if (count > most) {
      throw new Error(`The scene has ${count.toLocaleString('en')} Gaussians; this device can hold ` +
        `${most.toLocaleString('en')} of spherical harmonics of degree ${degree}.`);
    }
    return new WebGLRenderer(canvas, gl);
  }

  constructor(canvas, gl) {
    Object.assign(this, { canvas, gl });
    this.name = 'WebGL 2';
    this.isLost = false;
    this.lost = new Promise(resolve => canvas.addEventListener('webglcontextlost', event => {
      event.preventDefault();
      this.isLost = true;
      resolve();
    }, { once: true }));
    this.returned = new Promise(resolve => canvas.addEventListener('webglcontextrestored', resolve, { once: true }));
    this.floats = [gl.RGBA32F, gl.RGBA, gl.FLOAT];
    this.halves = [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT];
    // Half floats are quick, but some devices cut them off at every blend where others round.
    this.settledFormat = gl.getExtension('EXT_float_blend') ? this.floats : this.halves;
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    const corner = (_, k) => 4 * Math.floor(k / 6) + [0, 1, 2, 2, 1, 3][k % 6];
    const corners = Uint16Array.from({ length: 6 * SPLATS_PER_INSTANCE }, corner);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    this.programs = {};
    this.pictures = new Map();
  }

  async load({ meta, geometry, harmonics }) {
    const { gl, floats, halves } = this, rows = Math.ceil(meta.count / SPLATS_PER_ROW);
    const words = [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT];
    this.orderFormat = [gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT];
    const texels = texelsOfHarmonics(meta.sh_degree);
    const perRow = Math.floor(gl.getParameter(gl.MAX_TEXTURE_SIZE) / texels);
    this.geometry = createTexture(gl, 3 * SPLATS_PER_ROW, rows, floats);
    this.harmonics = createTexture(gl, texels * perRow, Math.ceil(meta.count / perRow), halves);
    this.order = createTexture(gl, SPLATS_PER_ROW, rows, this.orderFormat);
    this.splats = [0, 1, 2].map(() => createTexture(gl, SPLATS_PER_ROW, rows, words));
    fillTexture(gl, this.geometry, 3 * SPLATS_PER_ROW, floats, 4, geometry);
    fillTexture(gl, this.harmonics, texels * perRow, halves, 4, harmonics);
    if (gl.getError() === gl.OUT_OF_MEMORY) throw noRoom(meta, WORKING_BYTES_OF_GL);
    Object.assign(this, { rows, degree: meta.sh_degree, projected: createFramebuffer(gl, this.splats) });
    this.sorter = new Sorter({ meta, geometry });
  }

  draws({ kind, samples }) { return samples === 1 && kind in GL_KINDS; }

  /// A program, made once. `vertex` and `fragment` return sources.
  program(key, vertex, fragment) {
    return this.programs[key] ??= createProgram(this.gl, vertex(), fragment());
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

  put(name, size, values) {
    const { texture, width } = this.picture(name, size, this.floats);
    fillTexture(this.gl, texture, width, this.floats, 4, values.map((value, at) => (at % 4 === 3 ? 1 - value : value)));
  }

  async draw({ camera, pictures, settled, cancelled = () => false }) {
    const { sorter } = this;
    while (!sorter.knows(camera.w2c)) {
      const order = sorter.ask(camera.w2c, found => { if (!this.isLost) this.setOrder(found); });
      // An order that is a little old will do while the camera moves.
      if (!settled && sorter.known !== null) break;
      await Promise.race([order, new Promise(resolve => setTimeout(resolve, POLL))]);
      if (cancelled()) return false;
    }
    this.complain();
    for (const { name, footprint, span } of pictures) {
      this.project(camera, footprint);
      this.blend(this.picture(name, camera, settled ? this.settledFormat : this.halves), footprint, span);
    }
    await this.finished();
    this.complain();
    return true;
  }

  complain() {
    if (this.isLost || this.gl.isContextLost()) throw new Error('The graphics device was lost.');
  }

  setOrder(order) {
    fillTexture(this.gl, this.order, SPLATS_PER_ROW, this.orderFormat, 1, order);
    this.visible = order.length;
  }

  /// Projects all Gaussians for a footprint, replacing the splats of the last call.
  project(camera, { kind, variance }) {
    const { eye, limits } = eyeAndLimits(camera), { fx, fy, cx, cy, w2c } = camera;
    const program = this.program(`project ${kind}`, () => FULL_SCREEN, () => projectShader(kind, this.degree));
    runProgram(this.gl, program, {
      framebuffer: this.projected, width: SPLATS_PER_ROW, height: this.rows,
      textures: { uGeometry: this.geometry, uHarmonics: this.harmonics },
      uniforms: {
        'frame.view': w2c.slice(0, 12), 'frame.eye': eye, 'frame.pinhole': [fx, fy, cx, cy], 'frame.limit': limits,
        'frame.variance': [variance],
      },
    });
  }

  blend(picture, { kind }, columns) {
    const program = this.program(`blend ${kind}`, () => drawVertexShader(kind), () => drawFragmentShader(kind));
    const [uMean, uWhitening, uColor] = this.splats;
    runProgram(this.gl, program, {
      ...picture, columns, blends: true,
      quads: { indices: 6 * SPLATS_PER_INSTANCE, instances: Math.ceil(this.visible / SPLATS_PER_INSTANCE) },
      textures: { uMean, uWhitening, uColor, uOrder: this.order },
      uniforms: { uSize: [picture.width, picture.height], uVisible: [this.visible] },
    });
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

  present({ left, right = null, divider = 0, difference = false, background }) {
    const { width, height } = this.canvas, a = this.pictures.get(left), b = this.pictures.get(right ?? left);
    runProgram(this.gl, this.program('present', () => FULL_SCREEN, () => GL_PRESENT), {
      framebuffer: null, width, height, textures: { uLeft: a.texture, uRight: b.texture },
      uniforms: {
        uCanvas: [width, height], uSize: [a.width, a.height], uBackground: background,
        uDivider: [right === null ? width : divider], uDifference: [difference ? 1 : 0],
      },
    });
  }

  async read(name) {
    const gl = this.gl, picture = this.pictures.get(name);
    if (!picture || gl.isContextLost()) throw new Error('There is no picture: the graphics device was lost since.');
    const { framebuffer, width, height } = picture;
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const values = new Float32Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, values);
    if (gl.isContextLost()) throw new Error('The graphics device was lost while the picture was read.');
    return values.map((value, at) => (at % 4 === 3 ? 1 - value : value));
  }

  dispose() { this.sorter?.worker.terminate(); }
}
