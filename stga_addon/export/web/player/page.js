// @ts-check
// The page's controls. Everything that they do is in the public interface of <stga-avatar>.

/** @import { Camera, Lighting, Vector } from './types.js' */
/** @typedef {[row: HTMLElement, value: HTMLElement, slider: HTMLInputElement]} Row */

import { row } from './camera.js';
import { DataError } from './data.js';
import { ENVIRONMENTS } from './light.js';
import { StgaAvatar, hexOf, levelsOf } from './stga-avatar.js';
import { dotProduct, scaled, vector } from './vector.js';

const fixed = (/** @type {number} */ value) => value.toFixed(2);
const degrees = (/** @type {number} */ value) => `${Math.round(value)}°`;
const signed = (/** @type {number} */ value) =>
  `${value < 0 ? '−' : '+'}${Math.abs(value).toFixed(1)}`;

const SLIDERS_SHOWN = 8;
// The last comes first.
const SHAPES_FIRST = `browInnerUp mouthPucker mouthSmileRight mouthSmileLeft eyeBlinkRight
  eyeBlinkLeft mouthClose jawOpen`.split(/\s+/);
const FACTS_INTERVAL_MS = 500;
const BACKGROUNDS = { 'As the page': '', White: '#ffffff', Gray: '#808080', Black: '#000000' };
const DARK_BACKGROUND = '#15171b'; // in light, what the avatar was trained against
// Joint, axis, smallest and largest angle in radians.
/** @type {[string, string[], number, number, number][]} */
const POSE_SLIDERS = [
  ['Jaw open', ['jaw'], 0, -0.1, 0.6],
  ['Nod', ['neck'], 0, -0.5, 0.5],
  ['Turn', ['neck'], 1, -0.8, 0.8],
  ['Tilt', ['neck'], 2, -0.5, 0.5],
  ['Look sideways', ['left_eye', 'right_eye'], 1, -0.6, 0.6],
  ['Look down', ['left_eye', 'right_eye'], 0, -0.5, 0.5],
];

const avatar = element('stga-avatar', StgaAvatar);
/** @type {{ update: () => void, release: () => void }[]} */
const sliders = [];

// The first element that the selector finds. Throws where there is none of the class.
/** @type {<E extends Element>(selector: string, kind: new () => E, parent?: ParentNode) => E} */
function element(selector, kind, parent = document) {
  const found = parent.querySelector(selector);
  if (!(found instanceof kind)) throw new Error(`The page has no ${selector}.`);
  return found;
}

const byId = (/** @type {string} */ id) => element(`#${id}`, HTMLElement);
const inputOf = (/** @type {string} */ id) => element(`#${id}`, HTMLInputElement);

/** The loaded file's header. */
function info() {
  if (!avatar.info) throw new Error('No avatar is loaded.');
  return avatar.info;
}

/** @type {(button: HTMLElement, pressed: boolean) => void} */
const setPressed = (button, pressed) => button.setAttribute('aria-pressed', String(pressed));

/** @param {HTMLInputElement} input */
function fillTrack(input) {
  const [low, high, value] = [input.min, input.max, input.value].map(Number);
  input.style.setProperty('--done', `${(100 * (value - low)) / (high - low || 1)}%`);
}

// Playback

function updateTransport() {
  const { frame, frameCount, playing } = avatar;
  setPressed(byId('play'), playing);
  byId('play').title = playing ? 'Pause (Space)' : 'Play (Space)';
  inputOf('scrub').value = String(frame); // up to the last
  byId('number').textContent = `${Math.min(Math.round(frame) + 1, frameCount)} / ${frameCount}`;
  fillTrack(inputOf('scrub'));
}

const toggle = () => (avatar.playing ? avatar.pause() : avatar.play());

function toggleLoop() {
  avatar.loop = !avatar.loop;
  setPressed(byId('loop'), avatar.loop);
}

/** @param {number} frame */
function stopAt(frame) {
  avatar.pause();
  avatar.frame = frame;
}

function showLength() {
  byId('transport').hidden = avatar.frameCount < 2;
  inputOf('scrub').max = String(avatar.frameCount - 1);
}

function addTransport() {
  showLength();
  byId('play').addEventListener('click', toggle);
  byId('loop').addEventListener('click', toggleLoop);
  const speed = element('#speed', HTMLSelectElement);
  speed.addEventListener('change', () => (avatar.speed = Number(speed.value)));
  const scrub = inputOf('scrub');
  scrub.addEventListener('input', () => stopAt(Number(scrub.value)));
  for (const name of ['frame', 'play', 'pause']) avatar.addEventListener(name, updateTransport);
  updateTransport();
}

// View

function addViews() {
  const names = info().views.map(({ name }) => name);
  const list = element('#view', HTMLSelectElement);
  for (const name of names.length ? names : ['Front']) list.add(new Option(name, name));
  list.addEventListener('change', () => showView(list.selectedIndex));
  byId('reset').addEventListener('click', resetView);
}

/** @param {number} index */
function showView(index) {
  const view = info().views[index];
  if (view) avatar.camera = view.name;
  else if (!index) avatar.resetCamera();
  if (view || !index) element('#view', HTMLSelectElement).selectedIndex = index;
}

const resetView = () => showView(0);

let background = ''; // chosen by the viewer; '': the theme's

/** @type {Map<HTMLElement, string>} */
const swatches = new Map(); // button → color

function applyBackground(chosen = background) {
  background = chosen;
  const dark = document.documentElement.dataset.theme === 'dark';
  avatar.background = background || (dark ? DARK_BACKGROUND : hexOf(info().background));
  for (const [swatch, color] of swatches) setPressed(swatch, color === background);
}

function addBackgrounds() {
  const row = byId('backgrounds');
  for (const [name, color] of Object.entries(BACKGROUNDS)) {
    const swatch = document.createElement('button');
    Object.assign(swatch, { className: 'swatch', title: name });
    swatches.set(swatch, color);
    swatch.style.setProperty('--color', color || 'linear-gradient(135deg, #fff 50%, #15171b 50%)');
    swatch.addEventListener('click', () => applyBackground(color));
    row.append(swatch);
  }
  const custom = document.createElement('input');
  Object.assign(custom, { type: 'color', className: 'swatch', title: 'Any color' });
  custom.addEventListener('input', () => applyBackground(custom.value));
  row.append(custom);
  applyBackground();
}

function toggleSelection() {
  avatar.showSelection = !avatar.showSelection; // stays false where there is none
  inputOf('show-selection').checked = avatar.showSelection;
}

function toggleTheme() {
  const root = document.documentElement;
  root.dataset.theme = root.dataset.theme === 'dark' ? 'light' : 'dark';
  if (avatar.info) applyBackground();
}

// Sliders: each shows what plays until it is moved, and again when its value is clicked.

// A row with a name, an `output` or (kind "slider") a button that shows the value, and the slider.
/** @type {(parent: HTMLElement, kind: string, label: string, low: number, high: number) => Row} */
function sliderRow(parent, kind, label, low, high) {
  const row = Object.assign(document.createElement('label'), { className: kind });
  const button = '<button class="value" title="Release"></button>';
  const shown = kind === 'slider' ? button : '<output></output>';
  row.innerHTML = `<span></span>${shown}<input type="range" step="any">`;
  element('span', HTMLElement, row).textContent = label;
  const input = Object.assign(element('input', HTMLInputElement, row), { min: low, max: high });
  parent.append(row);
  return [row, element('.value, output', HTMLElement, row), input];
}

// A slider that shows what `read` says plays, and writes; null: as recorded.
/**
 * @type {(parent: HTMLElement, label: string, low: number, high: number, read: () => number,
 *   write: (value: number | null) => void, format?: (value: number) => string) => HTMLElement}
 */
function addSlider(parent, label, low, high, read, write, format = fixed) {
  const [row, value, input] = sliderRow(parent, 'slider', label, low, high);
  const pin = (/** @type {boolean} */ whether) => {
    row.classList.toggle('pinned', whether);
    byId('released').hidden = !document.querySelector('.pinned');
  };
  const update = () => {
    const current = row.classList.contains('pinned') ? Number(input.value) : read();
    input.value = String(current); // within its range
    value.textContent = format(current);
    fillTrack(input);
  };
  input.addEventListener('input', () => {
    pin(true);
    write(Number(input.value));
    update();
  });
  value.addEventListener('click', event => {
    event.preventDefault();
    pin(false);
    write(null);
  });
  sliders.push({ update, release: () => pin(false) });
  update();
  return row;
}

function addExpressions() {
  const section = byId('expressions');
  const list = element('.sliders', HTMLElement, section);
  const rows = info().sliders.map(({ name, reach }) => {
    const label = name.replace(/^expr_0*(\d+)$/, 'Expression $1');
    const read = () => avatar.getExpression(name);
    return addSlider(list, label, -reach, reach, read, value => avatar.setExpression(name, value));
  });
  section.hidden = !rows.length;
  showFirst(rows, byId('more'));
}

// Hide all but the first rows until the button is clicked.
/** @type {(rows: HTMLElement[], more: HTMLElement) => void} */
function showFirst(rows, more) {
  more.hidden = rows.length <= SLIDERS_SHOWN;
  more.textContent = `Show all ${rows.length}`;
  for (const row of rows.slice(SLIDERS_SHOWN)) row.hidden = true;
  more.addEventListener('click', () => {
    for (const row of rows) row.hidden = false;
    more.hidden = true;
  });
}

// Face shapes (ARKit's), and a performance of them from a file

function addFaceShapes() {
  const names = [...(info().shapes?.names ?? [])];
  byId('shapes').hidden = !names.length;
  names.sort((one, other) => SHAPES_FIRST.indexOf(other) - SHAPES_FIRST.indexOf(one));
  const list = element('.sliders', HTMLElement, byId('shapes'));
  const rows = names.map(name => {
    const read = () => avatar.getShape(name);
    return addSlider(list, name, 0, 1, read, value => avatar.setShape(name, value));
  });
  showFirst(rows, byId('more-shapes'));
  const file = inputOf('performance');
  byId('open-performance').addEventListener('click', () => file.click());
  file.addEventListener('change', () => playFile(file.files?.[0]).then(() => (file.value = '')));
  byId('close-performance').addEventListener('click', () => avatar.setPerformance(null));
  const rate = inputOf('recorded-fps');
  rate.addEventListener('change', () => playText(performanceText, Number(rate.value)));
  avatar.addEventListener('motionchange', () => {
    byId('close-performance').hidden = !avatar.player?.motion.shapes.performance;
    byId('performance-rate').hidden = avatar.guessedFps === null;
    rate.value = String(avatar.fps);
    showLength();
  });
  document.addEventListener('dragover', event => event.preventDefault());
  document.addEventListener('drop', event => {
    event.preventDefault();
    playFile(event.dataTransfer?.files[0]);
  });
}

let performanceText = ''; // of the last file

/** @param {File | undefined} file */
async function playFile(file) {
  if (!file || !avatar.info) return;
  try {
    performanceText = await file.text();
  } catch (error) {
    return showProblem(error);
  }
  playText(performanceText);
}

/** @param {unknown} error */
function showProblem(error) {
  const problem = byId('performance-problem');
  const isKnown = error instanceof DataError;
  problem.textContent = isKnown ? error.message : `The file cannot be read: ${error}`;
  problem.hidden = false;
}

/** @type {(text: string, recordedFps?: number | null) => void} */
function playText(text, recordedFps = null) {
  byId('performance-problem').hidden = true;
  try {
    avatar.setPerformance(text, recordedFps);
    avatar.play();
  } catch (error) {
    showProblem(error);
  }
}

function addPose() {
  const known = POSE_SLIDERS.filter(([, joints]) => joints.every(j => info().joints.includes(j)));
  const list = element('.sliders', HTMLElement, byId('pose'));
  for (const [label, joints, axis, low, high] of known) {
    const read = () => avatar.getPose(joints[0])[axis];
    const write = (/** @type {number | null} */ value) => {
      for (const joint of joints) {
        pinnedAngles[joint] ??= [null, null, null];
        pinnedAngles[joint][axis] = value;
        avatar.setPose(joint, pinnedAngles[joint]);
      }
    };
    const format = (/** @type {number} */ value) => degrees((180 / Math.PI) * value);
    addSlider(list, label, low, high, read, write, format);
  }
  byId('pose').hidden = !known.length;
}

/** @type {Record<string, (number | null)[]>} */
const pinnedAngles = {}; // joint → three angles, null: as recorded

function releaseAll() {
  for (const joint of Object.keys(pinnedAngles)) delete pinnedAngles[joint];
  for (const slider of sliders) slider.release();
  avatar.release();
}

// Light: as recorded, of an environment, or a sun that is dragged over a pad.

// Radians from the camera's own direction at the rim of the pad: the light comes from behind.
const PAD_ANGLE = 2.6;
const DRAGGED = 'dragged';
// Label, kinds that have it ("*": all environments), range, first value and format of each slider.
const RANGES = {
  strength: { label: 'Strength', kinds: DRAGGED, low: 0, high: 8, value: 3, format: fixed },
  even: { label: 'Even light', kinds: DRAGGED, low: 0, high: 1, value: 0.15, format: fixed },
  turn: { label: 'Turn', kinds: '*', low: -180, high: 180, value: 0, format: degrees },
  exposure: { label: 'Exposure', kinds: `${DRAGGED}*`, low: -3, high: 3, value: 0, format: signed },
};

/** For an avatar whose light is known. */
function addLight() {
  const section = byId('light');
  const select = element('select', HTMLSelectElement, section);
  const color = element('input[type="color"]', HTMLInputElement, section);
  const pad = byId('light-pad');
  let toward = fromPad(-0.25, -0.22);
  section.hidden = false;
  select.add(new Option('As recorded', 'recorded'));
  select.add(new Option('A light to drag', DRAGGED));
  for (const [name, { label }] of Object.entries(ENVIRONMENTS)) select.add(new Option(label, name));
  /** @returns {Lighting | null} */
  const lighting = () => {
    if (select.value === 'recorded') return null;
    const values = Object.fromEntries(rows.map(({ name, input }) => [name, Number(input.value)]));
    const { strength, even, exposure } = values;
    if (select.value !== DRAGGED)
      return { environment: select.value, turn: (Math.PI / 180) * values.turn, exposure };
    const sun = { toward, color: scaled(levelsOf(color.value).map(linear), strength) };
    return { even: [even, even, even], sun, exposure };
  };
  const showDirection = () => {
    const [x, y] = onPad(toward);
    pad.style.setProperty('--x', `${50 + 50 * x}%`);
    pad.style.setProperty('--y', `${50 + 50 * y}%`);
  };
  const showKind = () => {
    byId('light-dragged').hidden = select.value !== DRAGGED;
    const kind = Object.hasOwn(ENVIRONMENTS, select.value) ? '*' : select.value;
    for (const { shown, kinds } of rows) shown.hidden = !kinds.includes(kind);
  };
  const rows = Object.entries(RANGES).map(([name, { label, kinds, low, high, value, format }]) => {
    const [shown, output, input] = sliderRow(section, 'range', label, low, high);
    Object.assign(input, { name, value });
    const show = () => {
      output.textContent = format(Number(input.value));
      fillTrack(input);
    };
    input.addEventListener('input', show);
    show();
    return { name, shown, input, kinds };
  });
  select.addEventListener('change', showKind);
  const apply = () => (avatar.lighting = lighting());
  select.addEventListener('change', apply);
  for (const { input } of [{ input: color }, ...rows]) input.addEventListener('input', apply);
  /** @param {PointerEvent} event */
  const drag = event => {
    if (event.type === 'pointerdown') pad.setPointerCapture(event.pointerId);
    else if (!pad.hasPointerCapture(event.pointerId)) return;
    const { left, top, width, height } = pad.getBoundingClientRect();
    const x = (2 * (event.clientX - left)) / width - 1;
    toward = fromPad(x, (2 * (event.clientY - top)) / height - 1);
    apply();
  };
  pad.addEventListener('pointerdown', drag);
  pad.addEventListener('pointermove', drag);
  avatar.addEventListener('camerachange', showDirection);
  avatar.addEventListener('lightchange', () => {
    const sun = avatar.lighting?.sun;
    if (sun && select.value === DRAGGED) toward = sun.toward; // dragged over the head, maybe
    showDirection();
  });
  showKind();
  showDirection();
}

const cameraMatrix = () => /** @type {Camera} */ (avatar.camera).matrix;

// The direction in the world of a place on the pad (x right, y down, from -1 to 1), whose middle is
// where the camera looks from.
/** @type {(x: number, y: number) => Vector} */
function fromPad(x, y) {
  const reach = Math.hypot(x, y);
  const angle = PAD_ANGLE * Math.min(1, reach);
  const side = reach > 0 ? Math.sin(angle) / reach : 0;
  const m = cameraMatrix();
  return vector(k => m[k] * x * side + m[4 + k] * y * side - m[8 + k] * Math.cos(angle));
}

// The reverse, within the pad.
/** @param {Vector} toward */
function onPad(toward) {
  const [x, y, z] = vector(k => dotProduct(row(cameraMatrix(), k), toward));
  const side = Math.hypot(x, y);
  const reach = Math.min(1, Math.atan2(side, -z) / PAD_ANGLE);
  return side > 1e-9 ? [(x / side) * reach, (y / side) * reach] : [0, 0];
}

// From sRGB.
/** @param {number} level */
const linear = level => (level <= 0.04045 ? level / 12.92 : ((level + 0.055) / 1.055) ** 2.4);

// Keyboard, panel and facts

/** @type {Record<string, () => unknown>} */
const KEYS = {
  ' ': toggle,
  k: toggle,
  ArrowLeft: () => stopAt(Math.round(avatar.frame) - 1),
  ArrowRight: () => stopAt(Math.round(avatar.frame) + 1),
  Home: () => (avatar.frame = 0),
  End: () => (avatar.frame = avatar.frameCount - 1),
  c: () => togglePanel(),
  f: toggleFullscreen,
  h: () => document.body.classList.toggle('bare'),
  l: toggleLoop,
  r: resetView,
  s: toggleSelection,
  t: toggleTheme,
  x: releaseAll,
};

// Whether a control that has the focus uses a key itself.
/** @type {(control: Element, key: string) => boolean} */
function usesKey(control, key) {
  if (control.matches('select')) return true;
  if (key !== ' ') return /^(Arrow.*|Home|End)$/.test(key) && control.matches('input');
  return control.matches('input:not([type="range"]), button, summary');
}

// A button that the mouse has clicked gives up the focus: Space plays again.
/** @param {MouseEvent} event whose `detail` counts clicks, 0 of the keyboard's */
function releaseFocus(event) {
  const focused = document.activeElement;
  if (event.detail && focused instanceof HTMLElement && focused.matches('button, summary'))
    focused.blur();
}

/** @param {KeyboardEvent} event */
function press(event) {
  if (event.target instanceof Element && usesKey(event.target, event.key)) return;
  if (event.ctrlKey || event.metaKey || event.altKey || !avatar.info) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const action = /^[1-9]$/.test(key) ? () => showView(Number(key) - 1) : KEYS[key];
  if (!action) return;
  event.preventDefault();
  action();
}

function togglePanel(open = byId('panel').hidden) {
  byId('panel').hidden = !open;
  byId('open').setAttribute('aria-expanded', String(open));
}

function toggleFullscreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.().catch(() => {});
}

function showFacts() {
  const splats = avatar.splatCount.toLocaleString('en');
  const rate = avatar.frameCount > 1 ? ` · ${Number(avatar.fps.toFixed(2))} fps` : '';
  byId('facts').innerHTML =
    `${splats} splats${rate}<span class="detail"> · ${avatar.frameTime.toFixed(1)} ms ` +
    'of JavaScript a frame</span>';
}

function start() {
  addTransport();
  addViews();
  addBackgrounds();
  if (avatar.hasLight) addLight();
  addFaceShapes();
  addExpressions();
  addPose();
  avatar.addEventListener('frame', () => {
    if (!byId('panel').hidden) for (const slider of sliders) slider.update();
  });
  byId('selection').hidden = !avatar.hasSelection;
  byId('show-selection').addEventListener('change', toggleSelection);
  byId('release').addEventListener('click', releaseAll);
  byId('open').addEventListener('click', () => togglePanel());
  togglePanel(innerWidth > 640);
  setInterval(showFacts, FACTS_INTERVAL_MS);
  showFacts();
  avatar.loop = true;
  if (!matchMedia('(prefers-reduced-motion: reduce)').matches) avatar.play();
}

const isDark = matchMedia('(prefers-color-scheme: dark)').matches;
document.documentElement.dataset.theme = isDark ? 'dark' : 'light';
byId('theme').addEventListener('click', toggleTheme);
byId('fullscreen').addEventListener('click', toggleFullscreen);
addEventListener('keydown', press);
addEventListener('click', releaseFocus);
avatar.addEventListener('load', start, { once: true });
avatar.addEventListener('error', () => {
  for (const id of ['heading', 'transport', 'panel', 'open']) byId(id).hidden = true;
});

const BASE_85 =
  '0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%,()*+-;.=:?@^_`{|}~';

// The data that the page holds in base 85. Throws DataError where it was cut off or altered.
async function embeddedData() {
  const text = document.querySelector('#data')?.textContent?.trim();
  if (!text) throw new DataError('This page holds no avatar data.');
  const values = new Map(Array.from(BASE_85, (digit, value) => [digit.charCodeAt(0), value]));
  const words = new DataView(new ArrayBuffer(4 * Math.ceil(text.length / 5)));
  for (let at = 0; at < text.length; at += 5) {
    let word = 0;
    for (let k = at; k < at + 5; k++)
      word = 85 * word + (k < text.length ? (values.get(text.charCodeAt(k)) ?? NaN) : 84);
    if (!(word < 2 ** 32)) throw new DataError('The avatar data is damaged.');
    words.setUint32((at / 5) * 4, word);
  }
  return words.buffer.slice(0, Math.floor((text.length * 4) / 5));
}

avatar.load(embeddedData()).catch(console.error);
