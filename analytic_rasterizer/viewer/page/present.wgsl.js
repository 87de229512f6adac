// WGSL that shows one picture on the canvas, two beside each other, or their difference.

import { HEAT_MAP, wgslOf } from './formulas.js';
import { bindings } from './frame.wgsl.js';

export const SCREEN_BYTES = 48;

export const screenData = ({ canvas, size, divider, difference, background }) => {
  const data = new ArrayBuffer(SCREEN_BYTES), floats = new Float32Array(data), words = new Uint32Array(data);
  floats.set([...background, divider, canvas.width, canvas.height, difference ? 1 : 0, 0], 0);
  words.set([size.width, size.height], 8);
  return data;
};

export const PRESENT = `
struct Screen { background: vec3f, divider: f32, canvas: vec2f, difference: f32, unused: f32, size: vec2u }
${bindings('uniform screen: Screen', 'read left: array<vec4f>', 'read right: array<vec4f>')}
@vertex fn corner(@builtin(vertex_index) i: u32) -> @builtin(position) vec4f {
  return vec4f(select(-1.0, 3.0, i == 1u), select(-1.0, 3.0, i == 2u), 0.0, 1.0);
}
fn over(c: vec4f) -> vec3f { return clamp(c.xyz + c.w * screen.background, vec3f(0.0), vec3f(1.0)); }
${wgslOf(HEAT_MAP)}@fragment fn show(@builtin(position) at: vec4f) -> @location(0) vec4f {
  let pixel = min(vec2u(at.xy / screen.canvas * vec2f(screen.size)), screen.size - 1u);
  let k = pixel.y * screen.size.x + pixel.x;
  let a = over(left[k]); var b = over(right[k]);
  if (right[k].w < 0.0) { b = a; }  // beside a photograph
  if (screen.difference > 0.0) {
    let d = abs(a - b);
    return vec4f(heat(max(d.x, max(d.y, d.z))), 1.0);
  }
  return vec4f(select(b, a, at.x < screen.divider), 1.0);
}`;
