// The state of the viewer in the address of the page, after the #, so that it can be saved and sent.

import { Camera } from './camera.js';
import { PHOTOGRAPH } from './constants.js';
import { hexOf, rgbOf } from './interface.js';

/// Takes pose, footprints, resolution and background from the address, where it has them.
export function readAddress(viewer) {
  const given = new URLSearchParams(location.hash.slice(1)), { state, camera, meta } = viewer;
  const valid = name => {
    try { return name !== null && Boolean(viewer.footprint(name)); } catch { return false; }
  };
  const view = Number(given.get('view') ?? NaN);
  if (meta.views[view]) {
    camera.setView(view);
    viewer.atView = true;
  }
  if (valid(given.get('footprint'))) state.footprint = given.get('footprint');
  const compare = given.get('compare');
  state.compare = valid(compare) || (compare === PHOTOGRAPH && meta.photographs.length > 0) ? compare : null;
  if (['split', 'difference'].includes(given.get('mode'))) state.mode = given.get('mode');
  if (['1', '2', '4', '8'].includes(given.get('reduce'))) state.divisor = Number(given.get('reduce'));
  if (/^[0-9a-f]{6}$/.test(given.get('background') ?? '')) state.background = rgbOf(`#${given.get('background')}`);
  const pose = Camera.poseFromText(given.get('camera') ?? '');
  if (pose !== null) {
    camera.pose = pose;
    viewer.atView = false;
  }
}

export function writeAddress({ state, camera, meta, atView }) {
  const { footprint, compare, mode, divisor, background } = state, parts = [`view=${camera.view}`];
  if (!atView) parts.push(`camera=${camera.poseText()}`);
  parts.push(`footprint=${footprint}`);
  if (compare !== null) parts.push(`compare=${compare}`, `mode=${mode}`);
  if (divisor !== 1) parts.push(`reduce=${divisor}`);
  if (background !== meta.background) parts.push(`background=${hexOf(background).slice(1)}`);
  history.replaceState(null, '', `${location.pathname}${location.search}#${parts.join('&')}`);
}
