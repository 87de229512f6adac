// Photographs of the scene, which pictures of their views are compared with. Exported files have none.

import { PHOTOGRAPH } from './constants.js';
import { READING_TIME, announce } from './interface.js';
import { get } from './load.js';

async function loadPhotograph(k) {
  const response = await get(`photographs/${k}`, 'The photograph cannot be loaded.');
  return createImageBitmap(await response.blob(), { colorSpaceConversion: 'none', premultiplyAlpha: 'none' });
}

/// A photograph as values for `put`. `pinhole` is that of the picture, `lens` the view.
function asPicture(bitmap, pinhole, lens) {
  const { width, height } = pinhole, canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext('2d', { willReadFrequently: true });
  const x = pinhole.fx / lens.fx, y = pinhole.fy / lens.fy;
  context.imageSmoothingQuality = 'high';
  context.drawImage(bitmap, pinhole.cx - lens.cx * x, pinhole.cy - lens.cy * y, lens.width * x, lens.height * y);
  const values = Float32Array.from(context.getImageData(0, 0, width, height).data, byte => byte / 255);
  for (let at = 3; at < values.length; at += 4) values[at] = values[at] === 1 ? 0 : -1;
  return values;
}

export class Photographs {
  /// `loaded` is called when a photograph that was asked for is here.
  constructor(loaded) {
    this.loaded = loaded;
    this.asked = { view: null, bitmap: null };
    this.placed = {};
  }

  /// Puts the photograph of the camera's view into the renderer, as the picture PHOTOGRAPH. False until it is here.
  place(renderer, pinhole, { view, lens }) {
    if (this.asked.view !== view) {
      const asked = this.asked = { view, bitmap: null };
      loadPhotograph(view).then(bitmap => {
        asked.bitmap = bitmap;
        this.loaded();
      }).catch(error => announce(error.message, READING_TIME));
    }
    const { bitmap } = this.asked, { width, height, fx, cx, cy } = pinhole;
    const key = [view, width, height, fx, cx, cy].join();
    if (bitmap && (this.placed.renderer !== renderer || this.placed.key !== key)) {
      renderer.put(PHOTOGRAPH, pinhole, asPicture(bitmap, pinhole, lens));
      this.placed = { renderer, key };
    }
    return bitmap !== null;
  }
}
