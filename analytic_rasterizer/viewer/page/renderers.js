// The two renderers behind one interface:
//
//   create(canvas, meta, options)   of the class; before the scene is there
//   load(scene)
//   draws(footprint)                whether it can draw an entry of `footprints` of the scene
//   draw({camera, pictures, settled, cancelled}), put(name, size, values), present(...), read(name)
//   isLost; `lost` resolves when the device is lost, `returned` when it can be had again
//   dispose()

import { WebGLRenderer } from './webgl.js';
import { WebGPURenderer } from './webgpu.js';

// Difference between two pictures that the heat map shows in its last colour.
const FULL_DIFFERENCE = 0.25;

/// A canvas in place of the old one: what was drawn into with WebGPU once cannot be with WebGL, or the reverse.
function freshCanvas() {
  const old = document.getElementById('canvas'), canvas = old.cloneNode();
  old.replaceWith(canvas);
  return canvas;
}

/// The renderer for a scene, and why it is not WebGPU, or ''. `wish` is what the address says under `renderer`:
/// 'webgpu' also takes a device that is only software, 'webgl' takes WebGL 2. Throws an Error with a sentence where
/// neither can draw.
export async function openRenderer(meta, wish, bits) {
  const options = { fullDifference: FULL_DIFFERENCE, software: wish === 'webgpu', bits };
  let reason = 'the address asks for it.';
  if (wish !== 'webgl') {
    try {
      return { renderer: await WebGPURenderer.create(freshCanvas(), meta, options), reason: '' };
    } catch (error) {
      reason = error.message;
    }
  }
  if (meta.compact) throw new Error(`A compact scene needs WebGPU. WebGL 2 would draw: ${reason}`);
  return { renderer: await WebGLRenderer.create(freshCanvas(), meta, options), reason };
}
