// The scene on the graphics device, and its projection: one fragment per Gaussian writes a splat.

import { CONSTANTS } from './constants.js';
import { bindTextures, createFramebuffer, createProgram, createTexture, fillTexture } from './webgl_tools.js';
import { FULL_SCREEN, SPLATS_PER_ROW, projectShader, texelsOfHarmonics } from './webgl_shaders.js';

/// Gaussians that fit into the largest textures of a device, for harmonics of this degree. Sizes are 4096 or more.
export function largestCount(maxTextureSize, degree) {
  return maxTextureSize * Math.min(SPLATS_PER_ROW, Math.floor(maxTextureSize / texelsOfHarmonics(degree)));
}

/// Bytes that a scene takes on the device, without the pictures.
export function deviceBytes(count, degree) {
  const geometry = 3 * 16, harmonics = 8 * texelsOfHarmonics(degree), projected = 3 * 16, order = 4;
  return count * (geometry + harmonics + projected + order);
}

export class Projection {
  /// `scene` is what loadScene returned, of at most largestCount Gaussians. Throws an Error with a sentence where the
  /// device has no room for it.
  constructor(gl, scene) {
    const { count, sh_degree: degree } = scene.meta;
    const maxSize = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    this.gl = gl;
    this.count = count;
    this.degree = degree;
    this.visible = 0;
    this.programs = new Map();
    this.vertices = gl.createVertexArray();
    this.rows = Math.ceil(count / SPLATS_PER_ROW);

    const floats = [gl.RGBA32F, gl.RGBA, gl.FLOAT], halves = [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT];
    const words = [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT];
    this.orderFormat = [gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT];
    const texels = texelsOfHarmonics(degree);
    this.harmonicsPerRow = Math.floor(maxSize / texels);
    const harmonicsRows = Math.ceil(count / this.harmonicsPerRow);
    this.geometry = createTexture(gl, 3 * SPLATS_PER_ROW, this.rows, floats);
    this.harmonics = createTexture(gl, texels * this.harmonicsPerRow, harmonicsRows, halves);
    this.order = createTexture(gl, SPLATS_PER_ROW, this.rows, this.orderFormat);
    this.splats = [0, 1, 2].map(() => createTexture(gl, SPLATS_PER_ROW, this.rows, words));
    fillTexture(gl, this.geometry, 3 * SPLATS_PER_ROW, floats, 4, scene.geometry);
    fillTexture(gl, this.harmonics, texels * this.harmonicsPerRow, halves, 4, scene.harmonics);
    if (gl.getError() === gl.OUT_OF_MEMORY) {
      const megabytes = Math.ceil(deviceBytes(count, degree) / 1e6);
      throw new Error(`The graphics device has no room for the scene, which takes ${megabytes} MB of its memory.`);
    }
    this.framebuffer = createFramebuffer(gl, this.splats);
  }

  /// Takes the order in which to draw: indices of Gaussians, the farthest first.
  setOrder(order) {
    fillTexture(this.gl, this.order, SPLATS_PER_ROW, this.orderFormat, 1, order);
    this.visible = order.length;
  }

  /// Projects all Gaussians for a footprint, replacing the splats of the last call.
  project(camera, footprint) {
    const gl = this.gl, v = camera.w2c;
    if (!this.programs.has(footprint.kind)) {
      const source = projectShader(footprint.kind, this.degree);
      this.programs.set(footprint.kind, createProgram(gl, FULL_SCREEN, source));
    }
    const { program, uniforms } = this.programs.get(footprint.kind);
    gl.useProgram(program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.viewport(0, 0, SPLATS_PER_ROW, this.rows);
    gl.disable(gl.BLEND);
    gl.disable(gl.SCISSOR_TEST);
    gl.bindVertexArray(this.vertices);
    bindTextures(gl, uniforms, { uGeometry: this.geometry, uHarmonics: this.harmonics });
    gl.uniform1i(uniforms.uCount, this.count);
    gl.uniform1i(uniforms.uHarmonicsPerRow, this.harmonicsPerRow);
    gl.uniform4fv(uniforms.uView, v.slice(0, 12));
    gl.uniform3f(uniforms.uEye, ...[0, 1, 2].map(c => -(v[c] * v[3] + v[4 + c] * v[7] + v[8 + c] * v[11])));
    gl.uniform4f(uniforms.uPinhole, camera.fx, camera.fy, camera.cx, camera.cy);
    const clamp = CONSTANTS.kFrustumClamp / 2;
    gl.uniform2f(uniforms.uLimit, (clamp * camera.width) / camera.fx, (clamp * camera.height) / camera.fy);
    gl.uniform1f(uniforms.uVariance, footprint.variance);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}
