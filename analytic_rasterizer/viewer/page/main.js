// Starts the viewer, or draws for a script: what the address says after the question mark, and the hooks for automation.

import { painted, showFailure, showProgress } from './interface.js';
import { loadMeta, loadScene } from './load.js';
import { Viewer } from './viewer.js';

/// Renders view k in full into a picture of this size.
async function renderView(viewer, k, footprint, width, height) {
  const { camera, meta } = viewer, { views } = meta;
  if (!(Number.isInteger(k) && k >= 0 && k < views.length)) {
    throw new Error(`view must be a whole number from 0 to ${views.length - 1}, got ${k}.`);
  }
  const parsed = viewer.footprint(footprint);
  camera.setView(k);
  const pinhole = camera.pinhole(width ?? views[k].width, height ?? views[k].height, true, true);
  for (;;) {
    await viewer.recovery;
    const { renderer } = viewer, { canvas } = renderer;
    if (!renderer.draws(parsed)) throw new Error(`${renderer.name} cannot draw '${footprint}': ${viewer.reason}`);
    canvas.width = pinhole.width;
    canvas.height = pinhole.height;
    try {
      await renderer.draw({ camera: pinhole, pictures: [{ name: 'asked', footprint: parsed }], settled: true });
      renderer.present({ left: 'asked', background: meta.background });
      return;
    } catch (error) {
      if (!await viewer.wasLost(renderer)) throw error;
    }
  }
}

/// The picture that was asked for last, over the background, as the rasterizer orders it: (3, H, W), not clamped.
async function planes({ renderer, meta: { background } }) {
  const values = await renderer.read('asked'), pixels = values.length / 4, made = new Float32Array(3 * pixels);
  for (let p = 0; p < pixels; ++p) {
    for (let c = 0; c < 3; ++c) made[c * pixels + p] = values[4 * p + c] + values[4 * p + 3] * background[c];
  }
  return made;
}

/// What the address asks for: a settled frame without controls, or null for the viewer itself.
function automation(given) {
  if (!['view', 'size'].some(key => given.has(key))) return null;
  const size = given.get('size')?.match(/^(\d{1,5})x(\d{1,5})$/);
  if (given.has('size') && !(size && size[1] > 0 && size[2] > 0)) throw new Error('size must be like 640x480.');
  return { view: Number(given.get('view') ?? 0), footprint: given.get('footprint'), size: size?.slice(1).map(Number) };
}

async function main() {
  showProgress('Loading the scene');
  const given = new URLSearchParams(location.search);
  const viewer = new Viewer(await loadMeta(), given.get('renderer'));
  await viewer.open();  // what the device cannot hold is not loaded
  const scene = await loadScene(viewer.meta, part => showProgress(`Loading the scene: ${Math.round(100 * part)}%`, part));
  showProgress('Preparing to draw');
  const asked = automation(given);
  if (asked === null) await painted();  // drivers may be at work for long
  await viewer.load(scene);
  window.analyticPixels = () => planes(viewer);
  window.analyticRender = (...view) => renderView(viewer, ...view);
  if (asked === null) {
    viewer.interact();
    return;
  }
  document.body.classList.add('bare');
  const footprint = asked.footprint ?? viewer.drawn(viewer.meta.footprint).name;
  await renderView(viewer, asked.view, footprint, ...(asked.size ?? []));
  window.analyticReady = true;
}

main().catch(error => {
  window.analyticError = error.message;
  showFailure(error.message);
});
