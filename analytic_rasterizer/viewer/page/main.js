// The viewer: its state, the loop that draws when something has changed, and the hooks for automation.

import { Camera, add, between, depthAt, times } from './camera.js';
import { CONSTANTS, parseFootprint } from './constants.js';
import { Renderer } from './draw.js';
import { Interface, READING_TIME, announce, hideFailure, showFailure } from './interface.js';
import { loadScene, startSorter } from './load.js';

// Above so many Gaussians the order is rough while the camera moves.
const ROUGH_ORDER_FROM = 200000;
const REST_AFTER = 200;         // ms without motion
const TRAVEL_TIME = 450;        // ms of the way to another pose
const FLIGHT_SPEED = 0.7;       // distances of the target per second
const GEOMETRY_STRIDE = 12;

/// The worker, asked for one order at a time.
class Sorter {
  constructor(scene) {
    this.worker = startSorter();
    this.waiting = null;
    this.worker.onmessage = ({ data }) => this.waiting?.resolve(data);
    this.worker.onerror = () => this.waiting?.reject(new Error('The worker that sorts the Gaussians has stopped.'));
    const { geometry, meta } = scene;
    this.worker.postMessage({ means: geometry, stride: GEOMETRY_STRIDE, count: meta.count });
  }

  get busy() {
    return this.waiting !== null;
  }

  /// Indices of the Gaussians in front of a camera, the farthest first.
  async sort(w2c, exact) {
    const answer = await new Promise((resolve, reject) => {
      this.waiting = { resolve, reject };
      // Rounded as the rasterizer rounds the matrix.
      this.worker.postMessage({ row: Float32Array.from(w2c.slice(8, 12)), near: CONSTANTS.kNear, exact });
    }).finally(() => { this.waiting = null; });
    return answer.order;
  }
}

class Viewer {
  constructor(scene) {
    this.scene = scene;
    this.canvas = document.getElementById('canvas');
    this.camera = new Camera(scene.meta);
    this.state = { footprint: scene.meta.footprint, compare: null, mode: 'split', divisor: 1, divider: 0.5 };
    this.sorter = new Sorter(scene);
    this.sorted = { row: null, exact: false };
    this.atView = true;  // nothing has moved the camera away from the view
    this.frameRequested = false;
    this.drawing = false;  // the device is at work on a frame
    this.again = false;    // and then there is another one to draw
    this.movedAt = -Infinity;
    this.rate = null;
    this.lost = false;
    this.controls = null;
    const asked = new URLSearchParams(location.search).get('bits');
    const bits = ['8', '16'].includes(asked) ? Number(asked) : 32;
    this.createRenderer = () => new Renderer(this.canvas, scene, bits);
    this.renderer = this.createRenderer();
    this.canvas.addEventListener('webglcontextlost', event => {
      event.preventDefault();
      this.lost = true;
      announce('The graphics device was taken away; waiting for it to come back.');
    });
    this.canvas.addEventListener('webglcontextrestored', () => this.restore());
  }

  /// Makes everything on the device anew, after it was lost.
  restore() {
    try {
      this.renderer = this.createRenderer();
    } catch (error) {
      showFailure(error.message);
      return;
    }
    this.lost = false;
    this.sorted = { row: null, exact: false };
    announce('');
    this.wake();
  }

  /// Starts to draw for the user.
  interact() {
    this.readAddress();
    this.controls = new Interface(this);
    if (this.renderer.bits === 8) {
      this.controls.showNote('This device draws with 8 bits per channel: colours are off by up to 6 of 255 levels.');
    }
    new ResizeObserver(() => this.wake()).observe(this.canvas);
    window.addEventListener('hashchange', () => {
      this.readAddress();
      this.controls.update();
      this.wake();
    });
    this.wake();
  }

  // ------------------------------------------------------------------ what the user asks for

  change(part) {
    Object.assign(this.state, part);
    this.controls.update();
    this.wake();
    this.restLater();
  }

  orbit(right, down) {
    this.camera.orbit(right, down);
    this.moved();
  }

  pan(x, y) {
    const pinhole = this.pinhole(), ratio = this.canvas.width / this.canvas.clientWidth;
    const { distance } = this.camera;
    this.camera.move((-x * ratio * distance) / pinhole.fx, (-y * ratio * distance) / pinhole.fy, 0);
    this.moved();
  }

  /// By parts of the distance.
  panBy(x, y) {
    this.camera.move(x * this.camera.distance, y * this.camera.distance, 0);
    this.moved();
  }

  dolly(factor) {
    this.camera.dolly(factor);
    this.moved();
  }

  focusOn(x, y) {
    const pinhole = this.pinhole(), ratio = this.canvas.width / this.canvas.clientWidth;
    const depth = depthAt(this.scene.geometry, pinhole, x * ratio, y * ratio);
    if (depth === null) {
      announce('There is nothing here to focus on.', READING_TIME);
      return;
    }
    const point = add(this.camera.position, times(this.camera.ray(pinhole, x * ratio, y * ratio), depth));
    this.travel(this.camera.poseTowards(point), () => {});
  }

  stepView(step) {
    const count = this.scene.meta.views.length;
    this.goToView((this.camera.view + step + count) % count);
  }

  goToView(k) {
    this.camera.view = k;
    this.camera.lens = this.scene.meta.views[k];
    this.controls.update();
    announce(`View ${this.scene.meta.views[k].name}`, READING_TIME);
    this.travel(this.camera.poseOfView(k), () => { this.atView = true; });
  }

  /// Moves to a pose, at once for people who prefer no motion.
  travel(pose, arrived) {
    const still = matchMedia('(prefers-reduced-motion: reduce)').matches;
    this.journey = { from: this.camera.pose, to: pose, start: still ? -Infinity : performance.now(), arrived };
    this.moved(true);
  }

  saveScreenshot() {
    this.drawFrame(false);
    const name = `${this.scene.meta.name.replace(/\.\w+$/, '')}_${this.state.footprint.replace(/\W+/g, '_')}.png`;
    this.canvas.toBlob(blob => {
      const link = document.createElement('a');
      link.href = URL.createObjectURL(blob);
      link.download = name;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
      announce(`Saved ${name}`, READING_TIME);
    });
  }

  /// What the page draws a footprint by. Throws for an unknown name.
  footprint(name) {
    return parseFootprint(name, this.scene.meta.footprints);
  }

  // ------------------------------------------------------------------ the address

  /// Takes pose, footprints and resolution from the address, where it has them.
  readAddress() {
    const given = new URLSearchParams(location.hash.slice(1)), { state } = this;
    const valid = name => {
      try {
        return name !== null && this.footprint(name) !== null;
      } catch {
        return false;
      }
    };
    const view = Number(given.get('view') ?? -1);
    if (Number.isInteger(view) && view >= 0 && view < this.scene.meta.views.length && given.has('view')) {
      this.camera.setView(view);
      this.atView = true;
    }
    if (valid(given.get('footprint'))) state.footprint = given.get('footprint');
    state.compare = valid(given.get('compare')) ? given.get('compare') : null;
    if (['split', 'difference'].includes(given.get('mode'))) state.mode = given.get('mode');
    if (['1', '2', '4', '8'].includes(given.get('reduce'))) state.divisor = Number(given.get('reduce'));
    const pose = Camera.poseFromText(given.get('camera') ?? '');
    if (pose !== null) {
      this.camera.pose = pose;
      this.atView = false;
    }
  }

  writeAddress() {
    const { footprint, compare, mode, divisor } = this.state, parts = [`view=${this.camera.view}`];
    if (!this.atView) parts.push(`camera=${this.camera.poseText()}`);
    parts.push(`footprint=${footprint}`);
    if (compare !== null) parts.push(`compare=${compare}`, `mode=${mode}`);
    if (divisor !== 1) parts.push(`reduce=${divisor}`);
    history.replaceState(null, '', `${location.pathname}${location.search}#${parts.join('&')}`);
  }

  // ------------------------------------------------------------------ the loop

  /// Has a frame drawn soon.
  wake() {
    this.again = this.drawing;
    if (!this.controls || this.frameRequested || this.drawing || this.lost) return;  // automation has no controls
    this.frameRequested = true;
    requestAnimationFrame(() => this.frame());
  }

  moved(onJourney = false) {
    if (!onJourney) this.journey = null;
    this.atView = false;
    this.movedAt = performance.now();
    this.wake();
    this.restLater();
  }

  /// When the camera has rested for a while: the exact order, all samples, and the address.
  restLater() {
    clearTimeout(this.restTimer);
    this.restTimer = setTimeout(() => {
      this.rate = null;
      this.writeAddress();
      this.wake();
    }, REST_AFTER + 20);  // timers may be early
  }

  get moving() {
    return performance.now() - this.movedAt < REST_AFTER;
  }

  fitCanvas() {
    const ratio = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
  }

  /// The camera of the canvas, at a resolution 1/divisor of it.
  pinhole(divisor = 1) {
    const { width, height } = this.canvas, p = this.camera.pinhole(width, height, false, this.atView);
    const w = Math.max(1, Math.round(width / divisor)), h = Math.max(1, Math.round(height / divisor));
    const x = w / width, y = h / height;
    return { ...p, width: w, height: h, fx: p.fx * x, fy: p.fy * y, cx: p.cx * x, cy: p.cy * y };
  }

  frame() {
    this.frameRequested = false;
    if (this.lost) return;
    const now = performance.now(), seconds = Math.min((now - (this.lastFrame ?? now)) / 1000, 0.2);
    this.animate(now, seconds);
    this.fitCanvas();
    this.order();
    if (this.sorted.row === null) return;  // the first order will wake the loop
    const timer = this.renderer.startTimer();
    try {
      this.drawFrame(this.moving);
    } catch (error) {
      if (this.renderer.gl.isContextLost()) return;
      showFailure(error.message);
      return;
    }
    this.renderer.stopTimer(timer);
    this.lastFrame = now;
    this.whenDrawn(now, timer);
  }

  /// Moves along a journey, or with the keys that are held.
  animate(now, seconds) {
    if (this.journey) {
      const { from, to, start, arrived } = this.journey, part = Math.min((now - start) / TRAVEL_TIME, 1);
      this.camera.pose = part < 1 ? between(from, to, part * part * (3 - 2 * part)) : to;
      if (part < 1) this.moved(true);
      else {
        this.journey = null;
        arrived();
        this.restLater();
      }
    }
    const flight = this.controls.flight();
    if (flight) {
      this.camera.move(...times(flight, FLIGHT_SPEED * this.camera.distance * seconds));
      this.moved();
    }
  }

  /// Asks for the order of this camera unless it is known or on its way.
  order() {
    const w2c = this.camera.matrix(this.atView), row = w2c.slice(8, 12).join();
    const exact = !this.moving || this.scene.meta.count < ROUGH_ORDER_FROM;
    if (this.sorter.busy || (this.sorted.row === row && (this.sorted.exact || !exact))) return;
    this.sorter.sort(w2c, exact).then(order => {
      if (this.lost) return;
      this.renderer.projection.setOrder(order);
      this.sorted = { row, exact };
      this.wake();
    }, error => showFailure(error.message));
  }

  /// Draws the state. While the camera moves, a pixel has one sample.
  drawFrame(coarse) {
    const { footprint, compare, mode, divisor, divider } = this.state, { renderer } = this;
    const pinhole = this.pinhole(divisor);
    const chosen = name => {
      const wanted = this.footprint(name);
      if (!coarse || wanted.samples === 1) return wanted;
      return this.scene.meta.footprints.find(({ family, samples }) => family === wanted.family && samples === 1);
    };
    const split = compare !== null && mode === 'split', column = Math.ceil(divider * pinhole.width);
    renderer.render('left', pinhole, chosen(footprint), !coarse, split ? [0, column] : undefined);
    if (compare !== null) {
      renderer.render('right', pinhole, chosen(compare), !coarse, split ? [Math.max(column - 1, 0), pinhole.width] : undefined);
    }
    renderer.present('left', compare === null ? null : 'right', divider * this.canvas.width,
      compare !== null && mode === 'difference');
  }

  /// Calls for the next frame, if there is to be one, only when the device has finished this one: otherwise a slow
  /// device would lag behind the mouse.
  whenDrawn(start, timer) {
    const { gl } = this.renderer, fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.drawing = true;
    const poll = () => {
      if (!gl.isContextLost() && gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.UNSIGNALED) {
        setTimeout(poll, 1);
        return;
      }
      gl.deleteSync(fence);
      const again = this.again, { width, height } = this.pinhole(this.state.divisor);
      this.drawing = this.again = false;
      const now = performance.now(), milliseconds = this.renderer.readTimer(timer) ?? now - start;
      const active = this.moving || this.journey || this.controls.flight();
      if (this.moving && this.lastDrawn) {
        const rate = 1000 / Math.max(now - this.lastDrawn, 1);
        this.rate = this.rate === null ? rate : 0.8 * this.rate + 0.2 * rate;
      }
      this.lastDrawn = active ? now : null;
      this.controls.showFigures(width, height, milliseconds, this.rate);
      if (active || again || this.wanted()) this.wake();
    };
    poll();
  }

  /// Whether what is shown is not yet what is asked for.
  wanted() {
    const row = this.camera.matrix(this.atView).slice(8, 12).join();
    return !this.sorter.busy && (this.sorted.row !== row || !this.sorted.exact);
  }

  // ------------------------------------------------------------------ automation

  /// Renders view k, with all its samples and the exact order, into a picture of this size.
  async renderView(k, footprint, width, height) {
    const { views } = this.scene.meta;
    if (!(Number.isInteger(k) && k >= 0 && k < views.length)) {
      throw new Error(`view must be a whole number from 0 to ${views.length - 1}, got ${k}.`);
    }
    const parsed = this.footprint(footprint);
    this.camera.setView(k);
    const pinhole = this.camera.pinhole(width ?? views[k].width, height ?? views[k].height, true, true);
    this.canvas.width = pinhole.width;
    this.canvas.height = pinhole.height;
    this.canvas.style.width = `${pinhole.width}px`;
    this.canvas.style.height = `${pinhole.height}px`;
    const order = await this.sorter.sort(pinhole.w2c, true);
    do {
      await this.device();
    } while (!this.drawSettled(order, pinhole, parsed));
    return pinhole;
  }

  /// Waits until there is a device, where it was lost.
  async device() {
    if (!this.renderer.gl.isContextLost()) return;
    // The listener of the constructor, which makes everything anew, is called before this one.
    await new Promise(resolve => this.canvas.addEventListener('webglcontextrestored', resolve, { once: true }));
    if (this.lost) throw new Error('The graphics device was lost, and cannot be used again.');
  }

  /// Draws a settled picture. False if the device was lost meanwhile, so that there is none.
  drawSettled(order, pinhole, footprint) {
    const { renderer } = this;
    try {
      renderer.projection.setOrder(order);
      renderer.render('left', pinhole, footprint, true);
      renderer.present('left', null, 0, false);
      renderer.finish('left');
    } catch (error) {
      if (!renderer.gl.isContextLost()) throw error;
    }
    return !renderer.gl.isContextLost();
  }

  /// Times every footprint in turn, `rounds` times. Milliseconds per frame: the median and every round.
  async bench(pinhole, rounds) {
    const { gl } = this.renderer, info = gl.getExtension('WEBGL_debug_renderer_info');
    const { footprints } = this.scene.meta, times = Object.fromEntries(footprints.map(({ name }) => [name, []]));
    for (let round = -1; round < rounds; ++round) {  // the first compiles shaders and is not counted
      for (const footprint of footprints) {
        const start = performance.now();
        this.renderer.render('left', pinhole, footprint, false);
        this.renderer.finish('left');
        if (round >= 0) times[footprint.name].push(performance.now() - start);
      }
      await new Promise(resolve => setTimeout(resolve));
    }
    const median = list => [...list].sort((a, b) => a - b)[list.length >> 1];
    return {
      device: info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : gl.getParameter(gl.RENDERER),
      count: this.scene.meta.count, width: pinhole.width, height: pinhole.height, rounds,
      median_ms: Object.fromEntries(Object.entries(times).map(([name, list]) => [name, median(list)])), ms: times,
    };
  }
}

/// What the address asks for: a settled frame without controls, or null for the viewer itself.
function automation() {
  const given = new URLSearchParams(location.search);
  if (!['view', 'size', 'bench'].some(key => given.has(key))) return null;
  const size = given.get('size')?.match(/^(\d{1,5})x(\d{1,5})$/);
  if (given.has('size') && !(size && size[1] > 0 && size[2] > 0)) throw new Error('size must be like 640x480.');
  return {
    view: Number(given.get('view') ?? 0), footprint: given.get('footprint'), rounds: Number(given.get('bench') ?? 0),
    width: size ? Number(size[1]) : undefined, height: size ? Number(size[2]) : undefined,
  };
}

async function main() {
  announce('Loading the scene');
  const scene = await loadScene(part => announce(`Loading the scene: ${Math.round(100 * part)}%`));
  const viewer = new Viewer(scene);
  announce('');
  hideFailure();
  window.analyticPixels = () => viewer.renderer.read('left');
  window.analyticRender = (k, footprint, width, height) => viewer.renderView(k, footprint, width, height);
  const asked = automation();
  if (asked === null) {
    viewer.interact();
    return;
  }
  document.body.classList.add('bare');
  const footprint = asked.footprint ?? scene.meta.footprint;
  const pinhole = await viewer.renderView(asked.view, footprint, asked.width, asked.height);
  if (asked.rounds > 0) window.analyticBench = await viewer.bench(pinhole, asked.rounds);
  window.analyticReady = true;
}

main().catch(error => {
  window.analyticError = error.message;
  showFailure(error.message);
});
