// The controls: what the user does becomes calls of the viewer, and what the viewer shows becomes text.

import { add, times } from './camera.js';
import { PHOTOGRAPH } from './constants.js';

const element = id => document.getElementById(id);
const DIVISORS = [1, 2, 4, 8];
const COMPARISONS = ['off', 'split', 'difference'];
const FLY_KEYS = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0] };
const BUTTONS = { previous: ',', next: '.', reset: 'r', screenshot: 'p', full: 'f', fold: 'h', 'help-open': '?' };
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const ARROW_STEP = 0.06;      // radians; with Shift, parts of the distance
const WHEEL_STEP = 0.0015;    // logarithm of the distance, per px of scrolling
const RADIANS_PER_PX = 0.006;
// Where the controls would cover much of the scene they are out of the way, until they are asked for.
const SMALL_WINDOW = '(max-width: 480px), (max-height: 360px), (pointer: coarse) and (max-width: 640px), ' +
  '(pointer: coarse) and (max-height: 480px)';
export const READING_TIME = 4;  // seconds that a message stays

/// Shows those of the sentences that are some, or hides the element.
function showIfAny(id, sentences) {
  element(id).textContent = sentences.filter(Boolean).join(' ');
  element(id).hidden = element(id).textContent === '';
}

/// Colours of fields, '#rrggbb', and back.
export const hexOf = rgb => `#${rgb.map(value => Math.round(255 * value).toString(16).padStart(2, '0')).join('')}`;
export const rgbOf = hex => [1, 3, 5].map(at => parseInt(hex.slice(at, at + 2), 16) / 255);

/// Shows one sentence in place of the picture.
export function showFailure(sentence) {
  element('failure').textContent = sentence;
  element('message').hidden = false;
  hideProgress();
  announce('');
}

/// Shows what is awaited where the picture will be: its part that is done, from 0 to 1, or null where nobody knows.
export function showProgress(text, part = null) {
  const bar = element('loading-part');
  element('loading').hidden = false;
  if (element('loading-text').textContent !== text) element('loading-text').textContent = text;
  if (part === null) bar.removeAttribute('value');
  else bar.value = part;
}

export function hideProgress() { element('loading').hidden = true; }

/// Resolves when what the page says now is on the screen.
export const painted = () => new Promise(done => requestAnimationFrame(() => setTimeout(done)));

let announcementEnds;

/// Shows what is going on, and has it read out. `seconds` later it is gone.
export function announce(text, seconds = Infinity) {
  clearTimeout(announcementEnds);
  if (element('status').textContent !== text) element('status').textContent = text;
  if (seconds < Infinity) announcementEnds = setTimeout(() => announce(''), 1000 * seconds);
}

export class Interface {
  constructor(viewer) {
    this.viewer = viewer;
    this.keys = new Set();
    this.pointers = new Map();
    this.surface = element('surface');
    this.actions = this.actionsOf(viewer);
    this.fillIn(viewer.meta);
    this.connectControls();
    this.connectPointers();
    this.connectKeys();
    this.connectDivider();
    const small = matchMedia(SMALL_WINDOW), fold = () => this.toggleFolded(small.matches);
    small.addEventListener('change', fold);
    fold();
    this.showRenderer();
  }

  fillIn(meta) {
    element('scene-name').textContent = meta.name;
    document.title = `${meta.name} - Gaussian splats, integrated over the pixel`;
    const count = meta.count.toLocaleString('en');
    element('scene-facts').textContent = `${count} Gaussians, spherical harmonics of degree ${meta.sh_degree}`;
    element('view').replaceChildren(...meta.views.map((view, k) => new Option(view.name, k)));
    for (const id of ['previous', 'next']) element(id).disabled = meta.views.length < 2;
  }

  /// Says which renderer draws and why, offers what it can draw, and shows what is chosen.
  showRenderer() {
    const { meta, renderer, reason } = this.viewer;
    const known = meta.footprints.some(({ name }) => name === meta.footprint);
    const all = known ? meta.footprints : [this.viewer.footprint(meta.footprint), ...meta.footprints];
    const options = () => all.map(footprint => {
      const option = new Option(footprint.text, footprint.name);
      option.disabled = !renderer.draws(footprint);
      return option;
    });
    element('footprint').replaceChildren(...options());
    const photographs = meta.photographs.length > 0 ? [new Option(PHOTOGRAPH, PHOTOGRAPH)] : [];
    element('compare').replaceChildren(new Option('nothing', ''), ...photographs, ...options());
    const lacks = all.some(footprint => !renderer.draws(footprint));
    element('renderer').textContent = `${renderer.name} draws${reason ? `: ${reason}` : '.'}` +
      `${lacks ? ' Footprints in grey need WebGPU.' : ''}`;
    this.update();
  }

  connectControls() {
    const { viewer } = this;
    element('controls').addEventListener('submit', event => event.preventDefault());
    element('footprint').addEventListener('change', event => viewer.change({ footprint: event.target.value }));
    element('compare').addEventListener('change', event => viewer.change({ compare: event.target.value || null }));
    for (const input of document.querySelectorAll('input[name="mode"]')) {
      input.addEventListener('change', () => viewer.change({ mode: input.value }));
    }
    element('resolution').addEventListener('input', event => viewer.change({ divisor: DIVISORS[event.target.value] }));
    element('background').addEventListener('input', event => viewer.change({ background: rgbOf(event.target.value) }));
    element('view').addEventListener('change', event => viewer.goToView(Number(event.target.value)));
    for (const [id, key] of Object.entries(BUTTONS)) element(id).addEventListener('click', this.actions[key]);
  }

  connectPointers() {
    const { surface, viewer, pointers } = this;
    const place = event => ({ x: event.clientX, y: event.clientY });
    surface.addEventListener('pointerdown', event => {
      surface.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, place(event));
      surface.classList.add('dragged');
    });
    const release = event => {
      pointers.delete(event.pointerId);
      if (pointers.size === 0) surface.classList.remove('dragged');
    };
    for (const end of ['pointerup', 'pointercancel']) surface.addEventListener(end, release);
    surface.addEventListener('pointermove', event => {
      const old = pointers.get(event.pointerId);
      if (!old) return;
      const now = place(event), [, other] = [...pointers].find(([id]) => id !== event.pointerId) ?? [];
      pointers.set(event.pointerId, now);
      const x = now.x - old.x, y = now.y - old.y;
      if (other) {
        const apart = at => Math.max(Math.hypot(at.x - other.x, at.y - other.y), 1);
        viewer.steer('dolly', apart(old) / apart(now));
        viewer.pan(x / 2, y / 2);
      } else if (event.shiftKey || (event.buttons & 6) !== 0) {
        viewer.pan(x, y);
      } else {
        viewer.steer('orbit', x * RADIANS_PER_PX, y * RADIANS_PER_PX);
      }
    });
    surface.addEventListener('contextmenu', event => event.preventDefault());
    surface.addEventListener('dblclick', event => viewer.focusOn(event.offsetX, event.offsetY));
    surface.addEventListener('wheel', event => {
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 18 : 1);
      viewer.steer('dolly', Math.exp(Math.min(Math.max(pixels * WHEEL_STEP, -1), 1)));
    }, { passive: false });
  }

  connectKeys() {
    window.addEventListener('keydown', event => {
      if (event.key === '?' && element('help').open) {
        element('help').close();
        event.preventDefault();
        return;
      }
      // Fields and the dialog keep their keys, also a dialog that has just been closed; so do the browser's shortcuts.
      const inField = event.target instanceof Element && event.target.closest('select, input, dialog[open]');
      if (inField || event.ctrlKey || event.metaKey || event.altKey) return;
      if (this.press(event)) event.preventDefault();
    });
    window.addEventListener('keyup', event => this.keys.delete(event.key.toLowerCase()));
    window.addEventListener('blur', () => this.keys.clear());
  }

  /// Does what a key stands for, if anything: true.
  press(event) {
    const { viewer } = this, key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    this.faster = event.shiftKey;
    if (key in FLY_KEYS) {
      this.keys.add(key);
      viewer.wake();
      return true;
    }
    if (key in ARROWS) {
      const [x, y] = ARROWS[key].map(value => value * ARROW_STEP);
      if (event.shiftKey) viewer.steer('pan', x, y);
      else viewer.steer('orbit', -x, -y);
      return true;
    }
    if (/^[0-9]$/.test(key)) {
      const chosen = viewer.meta.footprints[(Number(key) + 9) % 10];  // 0 is the tenth
      if (chosen && viewer.renderer.draws(chosen)) viewer.change({ footprint: chosen.name });
      return true;
    }
    this.actions[key]?.();
    return key in this.actions;
  }

  actionsOf(viewer) {
    const { state, meta } = viewer, after = (list, now) => list[(list.indexOf(now) + 1) % list.length];
    return {
      '+': () => viewer.steer('dolly', 0.9),
      '=': () => viewer.steer('dolly', 0.9),
      '-': () => viewer.steer('dolly', 1 / 0.9),
      ',': () => viewer.stepView(-1),
      '.': () => viewer.stepView(1),
      c: () => {
        const next = after(COMPARISONS, state.compare === null ? 'off' : state.mode);
        const other = meta.compared.find(
          name => name !== state.footprint && viewer.renderer.draws(viewer.footprint(name)));
        viewer.change(next === 'off' ? { compare: null } : { compare: state.compare ?? other, mode: next });
      },
      z: () => viewer.change({ divisor: after(DIVISORS, state.divisor) }),
      r: () => viewer.goToView(viewer.camera.view),
      p: () => viewer.saveScreenshot(),
      f: () => this.toggleFullScreen(),
      h: () => this.toggleFolded(),
      '?': () => element('help').showModal(),
    };
  }

  /// Direction of the fly keys that are held, or null.
  flight() {
    if (this.keys.size === 0) return null;
    return times([...this.keys].map(key => FLY_KEYS[key]).reduce(add), this.faster ? 4 : 1);
  }

  connectDivider() {
    const divider = element('divider'), { viewer } = this;
    const moveTo = part => viewer.change({ divider: Math.min(Math.max(part, 0), 1) });
    divider.addEventListener('pointerdown', event => divider.setPointerCapture(event.pointerId));
    divider.addEventListener('pointermove', event => {
      if (divider.hasPointerCapture(event.pointerId)) moveTo(event.clientX / this.surface.clientWidth);
    });
    divider.addEventListener('keydown', event => {
      const step = event.shiftKey ? 0.1 : 0.02, { divider: now } = viewer.state;
      const places = { ArrowLeft: now - step, ArrowRight: now + step, ArrowDown: now - step, ArrowUp: now + step,
        Home: 0, End: 1 };
      if (!(event.key in places)) return;
      event.preventDefault();
      event.stopPropagation();
      moveTo(places[event.key]);
    });
  }

  toggleFullScreen() {
    const page = document.documentElement;
    const request = document.fullscreenElement ? document.exitFullscreen() : page.requestFullscreen();
    request.catch(() => announce('This browser allows no full screen here.', READING_TIME));
  }

  toggleFolded(wanted) {
    const folded = document.body.classList.toggle('folded', wanted);
    element('fold').setAttribute('aria-expanded', String(!folded));
    element('fold').textContent = folded ? 'Show' : 'Hide';
  }

  update() {
    const { footprint, compare, mode, divisor, divider } = this.viewer.state;
    const isPhotograph = compare === PHOTOGRAPH, { besidePhotograph } = this.viewer;
    const comparing = isPhotograph ? besidePhotograph : compare !== null, split = comparing && mode === 'split';
    element('footprint').value = footprint;
    element('compare').value = compare ?? '';
    element('compare-options').hidden = compare === null;
    element('legend').hidden = !(comparing && mode === 'difference');
    for (const input of document.querySelectorAll('input[name="mode"]')) input.checked = input.value === mode;
    element('resolution').value = DIVISORS.indexOf(divisor);
    const resolution = divisor === 1 ? '1' : `1/${divisor}`;
    element('resolution-text').textContent = resolution;
    element('resolution').setAttribute('aria-valuetext', resolution);
    element('background').value = hexOf(this.viewer.state.background);
    element('view').value = this.viewer.camera.view;
    for (const id of ['divider', 'label-left', 'label-right']) {
      element(id).hidden = !split;
      element(id).style.left = `${100 * divider}%`;
    }
    element('divider').setAttribute('aria-valuenow', String(Math.round(100 * divider)));
    element('label-left').textContent = this.inWords(footprint);
    element('label-right').textContent = comparing ? this.inWords(compare) : '';
    const names = comparing && !isPhotograph ? [footprint, compare] : [footprint], { renderer } = this.viewer;
    const replaced = names.filter(name => !renderer.draws(this.viewer.footprint(name)));
    showIfAny('drawn', replaced.map(
      name => `Drawn: ${this.viewer.drawn(name).name}. ${renderer.name} cannot draw ${name}.`));
    const { view, lens } = this.viewer.camera, has = this.viewer.meta.photographs.includes(view);
    const missing = has ? 'The photograph is seen from its view: R goes there.' : 'This view has no photograph.';
    const unlike = lens.lens && 'This view is shown without its lens.';
    showIfAny('note', [unlike, isPhotograph && !besidePhotograph && missing]);
  }

  /// A footprint, and what is drawn for it where that is another one.
  inWords(name) {
    if (name === PHOTOGRAPH) return `photograph of ${this.viewer.meta.views[this.viewer.camera.view].name}`;
    const drawn = this.viewer.drawn(name).name, wanted = this.viewer.footprint(name).name;
    return drawn === wanted ? name : `${name}, drawn as ${drawn}`;
  }

  /// Names of footprints, size and times of a frame. `rate` is null at rest; `stages` are milliseconds by name.
  showFigures(drawn, width, height, milliseconds, rate, stages) {
    const parts = Object.entries(stages).map(([name, time]) => `${name} ${time.toFixed(1)}`);
    element('stages').textContent = parts.length > 0 ? `${parts.join(', ')} ms` : '';
    const speed = rate === null ? '' : `${rate.toFixed(rate < 10 ? 1 : 0)} FPS, `;
    const picture = `${drawn.join(' | ')}, ${width} x ${height}`;
    element('figures').textContent = `${picture}, ${speed}${milliseconds.toFixed(1)} ms per frame`;
  }
}
