// What every pass needs of WebGL2: programs, textures and framebuffers.

/// A linked program, and room for the places of its uniforms.
export function createProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  const shaders = [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]].map(([type, source]) => {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    return shader;
  });
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const reason = shaders.map(shader => gl.getShaderInfoLog(shader)).join(' ') + gl.getProgramInfoLog(program);
    throw new Error(`This browser's graphics driver rejects a shader: ${reason.trim()}`);
  }
  return { program, places: {} };
}

/// A texture without filtering. `format` is [internal format, format, type].
export function createTexture(gl, width, height, format) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format[0], width, height);
  for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
  for (const key of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, key, gl.CLAMP_TO_EDGE);
  return texture;
}

/// Fills the texture, `width` texels wide, from a flat array: whole rows at once, then the rest of the last one.
export function fillTexture(gl, texture, width, format, numbersPerTexel, data) {
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  const texels = data.length / numbersPerTexel;
  const rows = Math.floor(texels / width), rest = texels - rows * width;
  const [, layout, type] = format;
  if (rows > 0) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, rows, layout, type, data, 0);
  if (rest > 0) {
    const start = rows * width * numbersPerTexel;
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, rows, rest, 1, layout, type, data.subarray(start));
  }
}

export function createFramebuffer(gl, textures) {
  const framebuffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  textures.forEach((texture, i) =>
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0));
  gl.drawBuffers(textures.map((_, i) => gl.COLOR_ATTACHMENT0 + i));
  return framebuffer;
}

/// Draws a triangle or quads into `columns` of a framebuffer, or of the canvas for null. Uniforms are lists of floats.
export function runProgram(gl, { program, places }, target) {
  const { framebuffer, width, height, columns = [0, width], blends = false, textures, uniforms, quads } = target;
  const placeOf = name => places[name] ??= gl.getUniformLocation(program, name);
  gl.useProgram(program);
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  gl.viewport(0, 0, width, height);
  gl.enable(gl.SCISSOR_TEST);
  gl.scissor(columns[0], 0, Math.max(columns[1] - columns[0], 0), height);
  gl[blends ? 'enable' : 'disable'](gl.BLEND);
  if (blends) gl.clear(gl.COLOR_BUFFER_BIT);
  Object.entries(textures).forEach(([name, texture], unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.uniform1i(placeOf(name), unit);
  });
  for (const [name, values] of Object.entries(uniforms)) {
    gl[`uniform${Math.min(values.length, 4)}fv`](placeOf(name), values);
  }
  if (quads) gl.drawElementsInstanced(gl.TRIANGLES, quads.indices, gl.UNSIGNED_SHORT, 0, quads.instances);
  else gl.drawArrays(gl.TRIANGLES, 0, 3);
}
