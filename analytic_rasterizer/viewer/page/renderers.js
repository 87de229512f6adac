// The two renderers behind one interface. A picture has four floats for a pixel: colour and transmittance.
//
//   create(canvas, meta, ...)    of the class, before the scene is there. Where the browser or the device cannot draw,
//                                throws an Error with a sentence; WebGPU's completes "WebGL 2 draws: "
//   load(scene)                  throws an Error with a sentence where the device has no room
//   draws(footprint)             whether it can draw an entry of `footprints` of the scene
//   draw({camera, pictures, settled, cancelled})
//                                draws pictures, each {name, footprint, span}; columns from span[0] up to span[1] are
//                                needed [px]. `settled` ones are as exact as the device can. False if `cancelled` has
//                                become true; there is no picture then
//   put(name, size, values)      a picture from elsewhere; transmittance is -1 where the other one is to be shown
//   present({left, right, divider, difference, background})
//                                shows `left`, from column `divider` of the canvas on `right`, or their difference
//   read(name)                   rejects where there is no picture
//   progress                     called, if it is there, with what takes long, how much of it is done, and of how much
//   isLost; `lost` resolves when the device is lost, `returned` when it can be had again
//   dispose()

import { WebGLRenderer } from './webgl.js';
import { WebGPURenderer } from './webgpu.js';

/// A canvas in place of the old one: what was drawn into with WebGPU once cannot be with WebGL, or the reverse.
function freshCanvas() {
  const old = document.getElementById('canvas'), canvas = old.cloneNode();
  old.replaceWith(canvas);
  return canvas;
}

/// The renderer for a scene, and why it is not WebGPU, or ''. Throws an Error with a sentence where there is none.
/// `wish` is `renderer` of the address: 'webgpu' also takes a device that is only software, 'webgl' takes WebGL 2.
/// `reason` is why 'webgl' is wished for.
export async function openRenderer(meta, wish, reason = 'the address asks for it.') {
  if (wish !== 'webgl') {
    try {
      return { renderer: await WebGPURenderer.create(freshCanvas(), meta, wish === 'webgpu'), reason: '' };
    } catch (error) {
      reason = error.message;
    }
  }
  if (meta.compact) throw new Error(`A compact scene needs WebGPU. WebGL 2 would draw: ${reason}`);
  return { renderer: await WebGLRenderer.create(freshCanvas(), meta), reason };
}
