// WGSL that every pass begins with: numbers of the rasterizer, and what is known of a frame. The passes of a picture:
//   project -> sort by depth -> bin: (tile, splat) pairs in that order -> sort by tile -> blend -> present

import { eyeAndLimits } from './camera.js';
import { CONSTANTS, shaderNumber } from './constants.js';

export const TILE = 8;          // edge of a tile [px]
export const WORKGROUP = 256;   // threads
export const FRAME_BYTES = 144;

export const FRAME = `
${Object.entries(CONSTANTS).map(([name, value]) => `const ${name} = ${shaderNumber(value)};`).join('\n')}
struct Frame {
  view: array<vec4f, 3>,                     // rows of world to camera
  eye: vec4f,
  pinhole: vec4f,                            // focal lengths and principal point [px]
  limit: vec2f,                              // of |x/z| and |y/z| in the Jacobian
  variance: f32, reach: f32,                 // of the footprint [px^2], [px]
  region: vec4u,                             // of the picture that is drawn: first column and row, end of both [tiles]
  size: vec2u,                               // of the picture [px]
  tiles: vec2u,                              // columns and rows of the picture
  count: u32,                                // Gaussians
  room: u32,                                 // for pairs
  zero: u32, unused: u32,
}
// counts[0]: Gaussians, [1]: those that are visible, [2]: pairs that there is room for, [3]: pairs.
// A splat: a = mean [px], s0, s1; b = s2, s3, s4, peak; c = colour, level. The footprint gives s0 to s4 their meaning.
struct Splat { a: vec4f, b: vec4f, c: vec4f }
`;

const ACCESS = { uniform: 'uniform', read: 'storage, read', write: 'storage, read_write' };

/// Declarations of the bindings 0, 1, ... of a pass, each 'uniform NAME: TYPE', 'read NAME: TYPE' or 'write NAME: TYPE'.
export const bindings = (...declared) => declared.map((text, k) => {
  const [access] = text.split(' ', 1);
  return `@group(0) @binding(${k}) var<${ACCESS[access]}>${text.slice(access.length)};`;
}).join('\n');

/// The head of a pass of workgroups in one direction: thread t of a block.
export const MAIN = `@compute @workgroup_size(${WORKGROUP})
fn main(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) block: vec3u) {`;

/// A camera and a footprint as the struct above. `region` is [first column, first row, end column, end row] in tiles.
export function frameData(camera, variance, reach, region, count, room) {
  const { width, height, fx, fy, cx, cy, w2c } = camera, { eye, limits } = eyeAndLimits(camera);
  const data = new ArrayBuffer(FRAME_BYTES), floats = new Float32Array(data), words = new Uint32Array(data);
  floats.set([...w2c.slice(0, 12), ...eye, 0, fx, fy, cx, cy, ...limits, variance, reach]);
  words.set([...region, width, height, Math.ceil(width / TILE), Math.ceil(height / TILE), count, room, 0, 0], 24);
  return data;
}
