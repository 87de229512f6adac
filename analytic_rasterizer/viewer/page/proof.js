// Whether what WebGPU has drawn is on the screen. Some drivers compute or show nothing, and call that no error.

import { CONSTANTS } from './constants.js';

const OPAQUE = 0.3;   // of a Gaussian
const BRIGHT = 0.15;  // of a pixel, in units of colour: nobody takes it for black

/// The pixel of a Gaussian that is there whatever the footprint, in the first `columns` of a picture; or null.
function coveredPixel(geometry, pinhole, columns) {
  const m = pinhole.w2c;
  for (let at = 0; at < geometry.length; at += 12) {
    const [x, y, z] = [0, 4, 8].map(
      k => m[k] * geometry[at] + m[k + 1] * geometry[at + 1] + m[k + 2] * geometry[at + 2] + m[k + 3]);
    if (!(z > 2 * CONSTANTS.kNear) || geometry[at + 3] < OPAQUE) continue;
    const column = Math.floor((pinhole.fx * x) / z + pinhole.cx), row = Math.floor((pinhole.fy * y) / z + pinhole.cy);
    if (!(column >= 0 && column < columns && row >= 0 && row < pinhole.height)) continue;
    const smallest = Math.min(geometry[at + 4], geometry[at + 5], geometry[at + 6]);
    if ((pinhole.fx * smallest) / z > 0.5) return [column, row];  // wider than a pixel
  }
  return null;
}

/// The column and row of the brightest of the first `columns` over the background, and how bright it is.
function brightestPixel(values, { width, height }, columns, background) {
  let found = [0, 0, 0];
  for (let p = 0; p < width * height; ++p) {
    for (let c = 0; c < 3 && p % width < columns; ++c) {
      const bright = values[4 * p + c] + values[4 * p + 3] * background[c];
      if (bright > found[2]) found = [p % width, Math.floor(p / width), bright];
    }
  }
  return found;
}

/// Throws an Error with a sentence where the picture 'left' or the canvas is black in a pixel that must not be.
export async function checkScreen(renderer, geometry, camera, columns, background) {
  const values = await renderer.read('left'), { width, height } = camera, covered = coveredPixel(geometry, camera, columns);
  if (covered !== null) {
    const transmittance = values[4 * (covered[1] * width + covered[0]) + 3];
    if (!(transmittance > 0 && transmittance < 1)) throw new Error('Its picture was empty where the scene is.');
  }
  const [column, row, bright] = brightestPixel(values, camera, columns, background), { canvas } = renderer;
  if (bright < BRIGHT) return;
  const context = new OffscreenCanvas(1, 1).getContext('2d', { willReadFrequently: true });
  renderer.present({ left: 'left', background });  // a canvas keeps its picture for the rest of this task only
  const place = [((column + 0.5) / width) * canvas.width, ((row + 0.5) / height) * canvas.height].map(Math.floor);
  context.drawImage(canvas, ...place, 1, 1, 0, 0, 1, 1);
  const [red, green, blue] = context.getImageData(0, 0, 1, 1).data;
  if (red + green + blue === 0) throw new Error('The page stayed black.');
}
