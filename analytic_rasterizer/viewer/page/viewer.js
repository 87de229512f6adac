// The viewer: its state, and the loop that draws when something has changed.

import { readAddress, writeAddress } from './address.js';
import { Camera, add, between, depthAt, times } from './camera.js';
import { PHOTOGRAPH, parseFootprint } from './constants.js';
import { acceptFiles } from './drop.js';
import { Interface, READING_TIME, announce, hideProgress, showFailure, showProgress } from './interface.js';
import { Pace } from './pace.js';
import { Photographs } from './photograph.js';
import { checkScreen } from './proof.js';
import { openRenderer } from './renderers.js';
import { WebGLRenderer } from './webgl.js';

const REST_AFTER = 200;         // ms without motion
const TRAVEL_TIME = 450;        // ms of the way to another pose
const FLIGHT_SPEED = 0.7;       // distances of the target per second
const LOSS_TIME = 500;          // ms in which a device that is lost says so

export class Viewer {
  /// `wish` is that of openRenderer.
  constructor(meta, wish) {
    Object.assign(this, { meta, wish });
    this.surface = document.getElementById('surface');
    this.camera = new Camera(meta);
    this.state = {
      footprint: meta.footprint, compare: null, mode: 'split', divisor: 1, divider: 0.5, background: meta.background,
    };
    this.atView = true;  // nothing has moved the camera away from the view
    this.frameRequested = false;
    this.drawing = false;  // the device is at work on a frame
    this.again = false;    // and then there is another one to draw
    this.movedAt = -Infinity;
    this.rate = null;
    this.losses = 0;
    this.controls = null;
    this.shown = null;  // what was drawn last: pictures by name, camera, and whether it was moving
    this.photographs = new Photographs(() => this.wake());
    this.paces = {};
    this.settledTime = 0;  // ms
  }

  /// Opens a renderer for the scene, which is not here yet. `reason` is that of openRenderer.
  async open(reason) {
    Object.assign(this, await openRenderer(this.meta, this.wish, reason));
    this.renderer.progress = (what, done, of) => this.noteProgress(what, done, of);
  }

  /// Says what takes long: in place of a picture, as long as there is none; of another footprint's shaders below it.
  noteProgress(what, done, of) {
    if (!this.controls) return;
    if (!this.shown) showProgress(`${what}: ${Math.round((100 * done) / of)}%`, done / of);
    else if (what.includes('shaders')) announce(done < of ? what : '');
  }

  async load(scene) {
    const { renderer } = this;
    this.scene = scene;
    await renderer.load(scene).then(() => {
      renderer.lost.then(() => this.replace(renderer)).catch(() => {});  // which has said why
    }, error => this.replace(renderer, error));
  }

  /// Another renderer in place of one whose device was lost: the same once, then WebGL 2; or of WebGPU that failed.
  async replace(renderer, failure = null) {
    if (failure && renderer instanceof WebGLRenderer) throw failure;
    if (this.renderer === renderer && this.replaced !== renderer) {
      this.replaced = renderer;
      this.recovery = this.recover(renderer, failure);
    }
    await this.recovery;
  }

  async recover(renderer, failure) {
    announce(failure ? 'WebGPU failed here; WebGL 2 takes over.'
      : 'The graphics device was taken away; waiting for it to come back.');
    if (!failure) await renderer.returned;
    renderer.dispose();
    this.shown = null;
    if (!(renderer instanceof WebGLRenderer)) this.losses += 1;
    if (failure || this.losses > 1) this.wish = 'webgl';
    const lost = this.losses > 1 ? 'WebGPU lost the graphics device twice.' : undefined;
    try {
      await this.open(failure ? `WebGPU failed here. ${failure.message}` : lost);
      await this.load(this.scene);
    } catch (error) {
      showFailure(error.message);
      throw error;
    }
    announce('');
    this.controls?.showRenderer();
    this.wake();
  }

  interact() {
    readAddress(this);
    this.controls = new Interface(this);
    acceptFiles();
    new ResizeObserver(() => this.wake()).observe(this.surface);
    window.addEventListener('hashchange', () => {
      readAddress(this);
      this.controls.update();
      this.wake();
    });
    this.wake();
  }

  change(part) {
    Object.assign(this.state, part);
    this.controls.update();
    this.wake();
    this.restLater();
  }

  /// Has the camera orbit, pan or dolly.
  steer(how, ...by) {
    this.camera[how](...by);
    this.moved();
  }

  /// By px of the page.
  pan(x, y) {
    const { fx, fy } = this.pinhole(), ratio = window.devicePixelRatio || 1;
    this.steer('pan', (-x * ratio) / fx, (-y * ratio) / fy);
  }

  focusOn(x, y) {
    const { camera } = this, pinhole = this.pinhole(), at = [x, y].map(value => value * (window.devicePixelRatio || 1));
    const depth = depthAt(this.scene.geometry, pinhole, ...at);
    if (depth === null) announce('There is nothing here to focus on.', READING_TIME);
    else this.travel(camera.poseTowards(add(camera.position, times(camera.ray(pinhole, ...at), depth))));
  }

  stepView(step) {
    const count = this.meta.views.length;
    this.goToView((this.camera.view + step + count) % count);
  }

  goToView(k) {
    this.camera.view = k;
    this.camera.lens = this.meta.views[k];
    this.controls.update();
    announce(`View ${this.meta.views[k].name}`, READING_TIME);
    this.travel(this.camera.poseOfView(k), () => {
      this.atView = true;
      this.controls.update();
    });
  }

  /// Moves to a pose, at once for people who prefer no motion.
  travel(pose, arrived = () => {}) {
    const still = matchMedia('(prefers-reduced-motion: reduce)').matches;
    this.journey = { from: this.camera.pose, to: pose, start: still ? -Infinity : performance.now(), arrived };
    this.moved(true);
  }

  /// Of what is on the screen: the divider and the heat map too.
  saveScreenshot() {
    if (!this.shown) return;
    const name = `${this.meta.name.replace(/\.\w+$/, '')}_${this.state.footprint.replace(/\W+/g, '_')}.png`;
    this.present();
    this.renderer.canvas.toBlob(blob => {
      const link = document.createElement('a');
      link.href = URL.createObjectURL(blob);
      link.download = name;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
      announce(`Saved ${name}`, READING_TIME);
    });
  }

  footprint(name) { return parseFootprint(name, this.meta.footprints); }

  /// What is drawn for this name: a quicker footprint while the camera moves, and where the renderer cannot draw it.
  drawn(name, moving = false) {
    const wanted = this.footprint(name);
    return moving || !this.renderer.draws(wanted) ? this.footprint(wanted.instead ?? wanted.name) : wanted;
  }

  /// Has a frame drawn soon.
  wake() {
    this.again = this.drawing;
    if (!this.controls || this.frameRequested || this.drawing || this.renderer.isLost) return;  // or automation
    this.frameRequested = true;
    this.surface.setAttribute('aria-busy', 'true');
    requestAnimationFrame(() => this.frame());
  }

  moved(onJourney = false) {
    if (!onJourney) this.journey = null;
    if (this.atView) {
      this.atView = false;
      this.controls.update();
    }
    this.movedAt = performance.now();
    this.wake();
    this.restLater();
  }

  /// When the camera has rested for a while: everything in full, and the address.
  restLater() {
    clearTimeout(this.restTimer);
    this.restTimer = setTimeout(() => {
      this.rate = null;
      writeAddress(this);
      this.wake();
    }, REST_AFTER + 20);  // timers may be early
  }

  get moving() { return performance.now() - this.movedAt < REST_AFTER; }

  /// Size of the canvas that fills the page [px].
  get size() {
    const ratio = window.devicePixelRatio || 1, { clientWidth, clientHeight } = this.surface;
    return [clientWidth, clientHeight].map(side => Math.max(1, Math.round(side * ratio)));
  }

  /// Whether a photograph is to be compared with, and can be: the camera is where it was taken.
  get besidePhotograph() {
    return this.state.compare === PHOTOGRAPH && this.atView && this.meta.photographs.includes(this.camera.view);
  }

  /// The camera of the canvas, at a resolution 1/divisor of it.
  pinhole(divisor = 1) {
    const [width, height] = this.size, p = this.camera.pinhole(width, height, false, this.atView);
    const w = Math.max(1, Math.round(width / divisor)), h = Math.max(1, Math.round(height / divisor));
    const x = w / width, y = h / height;
    return { ...p, width: w, height: h, fx: p.fx * x, fy: p.fy * y, cx: p.cx * x, cy: p.cy * y };
  }

  async frame() {
    this.frameRequested = false;
    const { renderer } = this, start = performance.now();
    if (renderer.isLost) return;
    this.animate(start, Math.min((start - (this.lastFrame ?? start)) / 1000, 0.2));
    this.lastFrame = start;
    this.drawing = true;
    this.again = false;
    let done = false;
    try {
      done = await this.drawFrame();
    } catch (error) {
      if (!await this.wasLost(renderer)) this.replace(renderer, error).catch(last => showFailure(last.message));
      return;  // another renderer wakes the loop
    } finally {
      this.drawing = false;
    }
    const active = this.moving || this.journey || this.controls.flight();
    if (done) this.noteTime(start, active);
    if (active || this.again || !done) this.wake();
    else if (!this.shown.moving) this.surface.setAttribute('aria-busy', 'false');  // what is shown is what is asked for
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

  /// Draws and shows the state, quicker and smaller while the camera moves. False if it begins to: there is no picture.
  async drawFrame() {
    const { footprint, compare, mode, divisor, divider } = this.state, { moving } = this;
    const left = this.drawn(footprint, moving), alone = compare === null || compare === PHOTOGRAPH;
    const right = alone ? null : this.drawn(compare, moving);
    const pace = moving ? this.paceOf(left, right) : null;
    const camera = this.pinhole(moving ? Math.max(divisor, pace.divisor) : divisor);
    const split = right !== null && mode === 'split', column = Math.ceil(divider * camera.width);
    const span = part => (split ? part : undefined), rest = span([Math.max(column - 1, 0), camera.width]);
    const pictures = [{ name: 'left', footprint: left, span: span([0, column]) }];
    if (right !== null) pictures.push({ name: 'right', footprint: right, span: rest });
    if (!this.shown) showProgress(`${this.renderer.name} draws`);
    const start = performance.now(), cancelled = () => !moving && this.moving;
    if (!await this.renderer.draw({ camera, pictures, settled: !moving, cancelled })) return false;
    const took = performance.now() - start;
    if (moving) pace.note(took);
    else this.settledTime = took;
    let beside = right === null ? null : 'right';
    if (this.besidePhotograph && this.photographs.place(this.renderer, camera, this.camera)) beside = PHOTOGRAPH;
    this.shown = { left: 'left', right: beside, camera, moving, drawn: pictures.map(({ footprint: { name } }) => name) };
    this.present();
    if (!moving) await this.proveScreen(split ? column : camera.width);
    hideProgress();
    return true;
  }

  /// Throws where WebGPU has shown nothing; asked of its first picture at rest, of which these columns were drawn.
  async proveScreen(columns) {
    const { renderer, shown } = this;
    if (this.proved === renderer || renderer instanceof WebGLRenderer) return;
    await checkScreen(renderer, this.scene.geometry, shown.camera, columns, this.state.background);
    this.proved = renderer;
    if (this.shown === shown) this.present();
  }

  /// The pace at which these footprints can follow the camera.
  paceOf(left, right) {
    return this.paces[`${left.name} ${right?.name}`] ??= new Pace(this.settledTime);
  }

  present() {
    const { mode, divider, background } = this.state, { left, right } = this.shown, { canvas } = this.renderer;
    const [width, height] = this.size;
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
    const difference = right !== null && mode === 'difference';
    this.renderer.present({ left, right, divider: divider * width, difference, background });
  }

  noteTime(start, active) {
    const now = performance.now(), { drawn, camera: { width, height } } = this.shown;
    if (this.moving && this.lastDrawn) {
      const rate = 1000 / Math.max(now - this.lastDrawn, 1);
      this.rate = this.rate === null ? rate : 0.8 * this.rate + 0.2 * rate;
    }
    this.lastDrawn = active ? now : null;
    this.controls.showFigures(drawn, width, height, now - start, this.rate, this.renderer.stages ?? {});
  }

  /// Whether an error was that the device is lost, which may be told a little later.
  async wasLost(renderer) {
    const late = new Promise(resolve => setTimeout(resolve, LOSS_TIME));
    await Promise.race([renderer.lost, late]);
    return renderer.isLost;
  }
}
