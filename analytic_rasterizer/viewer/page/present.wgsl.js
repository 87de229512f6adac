// WGSL that shows one picture on the canvas, two beside each other, or their difference.

import { bindings } from './frame.wgsl.js';

export const SCREEN_BYTES = 48;

/// Numbers of the struct below.
export const screenData = ({ canvas, size, divider, difference, background }) => {
  const data = new ArrayBuffer(SCREEN_BYTES), floats = new Float32Array(data), words = new Uint32Array(data);
  floats.set([...background, divider, canvas.width, canvas.height, difference ? 1 : 0, 0], 0);
  words.set([size.width, size.height], 8);
  return data;
};

// Colours of the heat map, for differences of 0, 1/16, ..., 1/4.
const HEAT = ['0.03, 0.03, 0.06', '0.32, 0.10, 0.45', '0.80, 0.26, 0.30', '0.98, 0.65, 0.18', '1.00, 0.98, 0.85'];

/// Statements that set `color` for a `difference`, in GLSL and in WGSL. `vector` is the name of a type of three floats.
export const heatMap = vector => [`color = ${vector}(${HEAT[0]});`, ...HEAT.slice(1).map((next, k) =>
  `color = mix(color, ${vector}(${next}), clamp(16.0 * difference - ${k}.0, 0.0, 1.0));`)].join('\n  ');

/// Pictures hold colour and transmittance.
export const PRESENT = `
struct Screen { background: vec3f, divider: f32, canvas: vec2f, difference: f32, unused: f32, size: vec2u }
${bindings('uniform screen: Screen', 'read left: array<vec4f>', 'read right: array<vec4f>')}
@vertex fn corner(@builtin(vertex_index) i: u32) -> @builtin(position) vec4f {
  return vec4f(select(-1.0, 3.0, i == 1u), select(-1.0, 3.0, i == 2u), 0.0, 1.0);
}
fn over(c: vec4f) -> vec3f { return clamp(c.xyz + c.w * screen.background, vec3f(0.0), vec3f(1.0)); }
fn heat(difference: f32) -> vec3f {
  var color: vec3f;
  ${heatMap('vec3f')}
  return color;
}
@fragment fn show(@builtin(position) at: vec4f) -> @location(0) vec4f {
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
