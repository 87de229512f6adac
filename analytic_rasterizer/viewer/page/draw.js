// Draws the projected splats into pictures of half floats, and shows pictures on the canvas.

import { nodesOf } from './constants.js';
import { bindTextures, createFramebuffer, createProgram, createTexture, fillTexture } from './gl.js';
import { LAST_HALF, ROWS_PER_UNIT, windowTable } from './logistic.js';
import { Projection } from './project.js';
import {
  ADD, FULL_SCREEN, PRESENT, SPLATS_PER_INSTANCE, drawFragmentShader, drawVertexShader,
} from './shaders.js';

// Difference between two pictures that the heat map shows in its last colour.
export const FULL_DIFFERENCE = 0.25;

export class Renderer {
  /// Throws an Error with a sentence where the browser or the device cannot do it. `bits` per channel that are blended,
  /// at most: 8, 16, or 32 where the picture is settled.
  constructor(canvas, scene, bits = 32) {
    const gl = canvas.getContext('webgl2', {
      antialias: false, alpha: false, depth: false, stencil: false, powerPreference: 'high-performance',
    });
    if (!gl) throw new Error('This viewer needs WebGL2, which this browser or this machine does not offer.');
    if (gl.getParameter(gl.MAX_TEXTURE_SIZE) < 4096) throw new Error('This viewer needs textures of 4096 pixels.');
    const halves = gl.getExtension('EXT_color_buffer_float') ?? gl.getExtension('EXT_color_buffer_half_float');
    const floats = gl.getExtension('EXT_color_buffer_float') && gl.getExtension('EXT_float_blend');
    this.gl = gl;
    this.canvas = canvas;
    this.background = scene.meta.background;
    this.bits = halves ? bits : 8;
    const full = [gl.RGBA32F, gl.RGBA, gl.FLOAT], half = [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT];
    const bytes = [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE];
    // Half floats are quick, but some devices cut them off at every blend where others round.
    this.quickFormat = this.bits === 8 ? bytes : half;
    this.settledFormat = this.bits === 8 ? bytes : floats && bits !== 16 ? full : half;
    this.sumFormat = this.bits === 8 ? bytes : floats ? full : half;
    // Every browser has four targets; numbers between four and eight would not divide the samples evenly.
    const targets = Math.min(gl.getParameter(gl.MAX_DRAW_BUFFERS), gl.getParameter(gl.MAX_COLOR_ATTACHMENTS));
    this.samplesPerPass = targets >= 8 ? 8 : 4;
    this.timing = gl.getExtension('EXT_disjoint_timer_query_webgl2');
    this.programs = new Map();
    this.targets = new Map();
    this.pictures = new Map();
    this.projection = new Projection(gl, scene);
    this.window = createTexture(gl, 2, LAST_HALF * ROWS_PER_UNIT + 1, full);
    fillTexture(gl, this.window, 2, full, 4, windowTable());
    this.fullScreen = gl.createVertexArray();
    this.quads = this.createQuads();
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

  /// Textures and a framebuffer under a name; made anew when their size, number or format changes.
  target(name, width, height, format, count = 1) {
    const gl = this.gl, shape = [width, height, format[0], count].join();
    const old = this.targets.get(name);
    if (old?.shape === shape) return old;
    if (old) {
      gl.deleteFramebuffer(old.framebuffer);
      old.textures.forEach(texture => gl.deleteTexture(texture));
    }
    const textures = Array.from({ length: count }, () => createTexture(gl, width, height, format));
    const target = { shape, textures, framebuffer: createFramebuffer(gl, textures), width, height };
    this.targets.set(name, target);
    return target;
  }

  /// Renders the picture called `name`, a `settled` one as exactly as the device can. `span` = [first column, last
  /// column) limits what is drawn [px].
  render(name, camera, footprint, settled, span = [0, camera.width]) {
    const gl = this.gl, { width, height } = camera;
    const nodes = nodesOf(footprint.samples);
    this.projection.project(camera, footprint);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(span[0], 0, Math.max(span[1] - span[0], 0), height);
    const format = settled ? this.settledFormat : this.quickFormat;
    let picture;
    if (nodes.length === 1) {
      picture = this.target(`picture ${name} ${format[2]}`, width, height, format);
      this.drawSamples(picture, camera, footprint, nodes);
    } else {
      // Every sample keeps its own transmittance, in a picture of its own; the result is their mean.
      picture = this.target(`sum ${name}`, width, height, this.sumFormat);
      // Four pictures of floats take the memory of eight of half floats.
      const group = Math.min(format[2] === gl.FLOAT ? 4 : this.samplesPerPass, nodes.length);
      const samples = this.target('samples', width, height, format, group);
      for (let start = 0; start < nodes.length; start += group) {
        this.drawSamples(samples, camera, footprint, nodes.slice(start, start + group));
        samples.textures.forEach((texture, k) => this.add(picture, texture, 1 / nodes.length, start + k === 0));
      }
    }
    gl.disable(gl.SCISSOR_TEST);
    this.pictures.set(name, picture);
  }

  drawSamples(target, camera, footprint, nodes) {
    const gl = this.gl, { kind, samples } = footprint, projection = this.projection;
    const { program, uniforms } = this.program(
      `draw ${kind} ${nodes.join()}`, () => drawVertexShader(kind, samples), () => drawFragmentShader(kind, nodes));
    gl.useProgram(program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    const [uMean, uWhitening, uColor] = projection.splats;
    bindTextures(gl, uniforms, { uMean, uWhitening, uColor, uOrder: projection.order, uWindow: this.window });
    gl.uniform1i(uniforms.uVisible, projection.visible);
    gl.uniform2f(uniforms.uSize, camera.width, camera.height);
    gl.bindVertexArray(this.quads);
    const instances = Math.ceil(projection.visible / SPLATS_PER_INSTANCE);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * SPLATS_PER_INSTANCE, gl.UNSIGNED_SHORT, 0, instances);
  }

  add(target, texture, factor, first) {
    const gl = this.gl;
    const { program, uniforms } = this.program('add', () => FULL_SCREEN, () => ADD);
    gl.useProgram(program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    if (first) gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    bindTextures(gl, uniforms, { uPicture: texture });
    gl.uniform1f(uniforms.uFactor, factor);
    gl.bindVertexArray(this.fullScreen);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /// Shows the picture `left`, beside it from column `divider` of the canvas on `right`, or the difference of the two.
  present(left, right, divider, difference) {
    const gl = this.gl, { width, height } = this.canvas;
    const a = this.pictures.get(left), b = this.pictures.get(right ?? left);
    const { program, uniforms } = this.program('present', () => FULL_SCREEN, () => PRESENT);
    gl.useProgram(program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.BLEND);
    bindTextures(gl, uniforms, { uLeft: a.textures[0], uRight: b.textures[0] });
    gl.uniform2f(uniforms.uCanvas, width, height);
    gl.uniform2f(uniforms.uSize, a.width, a.height);
    gl.uniform3f(uniforms.uBackground, ...this.background);
    gl.uniform1f(uniforms.uDivider, right === null ? width : divider);
    gl.uniform1i(uniforms.uDifference, difference ? 1 : 0);
    gl.uniform1f(uniforms.uFull, FULL_DIFFERENCE);
    gl.bindVertexArray(this.fullScreen);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /// Starts to measure the time on the device; null where it cannot be measured.
  startTimer() {
    if (!this.timing) return null;
    const query = this.gl.createQuery();
    this.gl.beginQuery(this.timing.TIME_ELAPSED_EXT, query);
    return query;
  }

  stopTimer(query) {
    if (query) this.gl.endQuery(this.timing.TIME_ELAPSED_EXT);
  }

  /// Milliseconds between start and stop, or null where they are not known.
  readTimer(query) {
    const gl = this.gl;
    if (!query) return null;
    const available = gl.getQueryParameter(query, gl.QUERY_RESULT_AVAILABLE);
    const known = available && !gl.getParameter(this.timing.GPU_DISJOINT_EXT);
    const milliseconds = known ? gl.getQueryParameter(query, gl.QUERY_RESULT) / 1e6 : null;
    gl.deleteQuery(query);
    return milliseconds;
  }

  /// Waits until everything has been drawn.
  finish(name) {
    const gl = this.gl, { framebuffer } = this.pictures.get(name);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const type = this.bits === 8 ? gl.UNSIGNED_BYTE : gl.FLOAT;
    gl.readPixels(0, 0, 1, 1, gl.RGBA, type, this.bits === 8 ? new Uint8Array(4) : new Float32Array(4));
  }

  /// The picture over the background as the rasterizer orders it: (3, height, width), not clamped. Throws an Error where
  /// there is none, as after the device was lost.
  read(name) {
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
    const planes = new Float32Array(3 * pixels);
    for (let p = 0; p < pixels; ++p) {
      const rest = 1 - values[4 * p + 3];
      for (let c = 0; c < 3; ++c) planes[c * pixels + p] = values[4 * p + c] + rest * this.background[c];
    }
    return planes;
  }
}
