// @ts-check
// The page's controls. Everything that they do is in the public interface of <stga-avatar>.

/**
 * @typedef {object} SliderOptions
 * @property {string} id
 * @property {string} label
 * @property {number} low
 * @property {number} high
 * @property {() => number} read what plays
 * @property {(value: number | null) => void} write null: as recorded
 * @property {(value: number) => string} format
 */

import { DataError } from './data.js';
import { LightControls } from './light_controls.js';
import { StgaAvatar } from './stga-avatar.js';

const SLIDERS_SHOWN = 8;
const SHAPES_FIRST = [
  'browInnerUp',
  'mouthPucker',
  'mouthSmileRight',
  'mouthSmileLeft',
  'eyeBlinkRight',
  'eyeBlinkLeft',
  'mouthClose',
  'jawOpen',
]; // the last comes first
const FACTS_INTERVAL_MS = 500;
const BACKGROUNDS = { White: '#ffffff', Gray: '#808080', Black: '#000000' };
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

/**
 * The first element that the selector finds. Throws where there is none of the class.
 * @template {Element} E
 * @param {string} selector
 * @param {new () => E} kind
 * @param {ParentNode} parent
 * @returns {E}
 */
function element(selector, kind, parent = document) {
  const found = parent.querySelector(selector);
  if (!(found instanceof kind)) throw new Error(`The page has no ${selector}.`);
  return found;
}

/** @param {string} id */
function byId(id) {
  return element(`#${id}`, HTMLElement);
}

/** @param {string} id */
function inputOf(id) {
  return element(`#${id}`, HTMLInputElement);
}

/** The loaded file's header. */
function info() {
  if (!avatar.info) throw new Error('No avatar is loaded.');
  return avatar.info;
}

/**
 * @param {HTMLElement} button
 * @param {boolean} pressed
 */
function setPressed(button, pressed) {
  button.setAttribute('aria-pressed', String(pressed));
}

/** @param {HTMLInputElement} input */
function fillTrack(input) {
  const [low, high] = [Number(input.min), Number(input.max)];
  const share = (Number(input.value) - low) / (high - low || 1);
  input.style.setProperty('--done', `${100 * share}%`);
}

// Playback

function updateTransport() {
  const last = avatar.frameCount - 1;
  const frame = Math.min(Math.round(avatar.frame), last);
  setPressed(byId('play'), avatar.playing);
  byId('play').title = avatar.playing ? 'Pause (Space)' : 'Play (Space)';
  inputOf('scrub').value = String(Math.min(avatar.frame, last));
  byId('number').textContent = `${frame + 1} / ${last + 1}`;
  fillTrack(inputOf('scrub'));
}

function toggle() {
  if (avatar.playing) avatar.pause();
  else avatar.play();
}

function toggleLoop() {
  avatar.loop = !avatar.loop;
  setPressed(byId('loop'), avatar.loop);
}

/** @param {number} by */
function step(by) {
  avatar.pause();
  avatar.frame = Math.round(avatar.frame) + by;
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
  scrub.addEventListener('input', () => {
    avatar.pause();
    avatar.frame = Number(scrub.value);
  });
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

function resetView() {
  avatar.resetCamera();
  element('#view', HTMLSelectElement).selectedIndex = 0;
}

/** @type {string | null} */
let background = null; // chosen by the viewer; null: the theme's

/** @type {Map<HTMLElement, string | null>} */
const swatches = new Map(); // button → color; null: the theme's

function applyBackground() {
  const dark = document.documentElement.dataset.theme === 'dark';
  const trained = `#${info()
    .background.map((part) =>
      Math.round(255 * part)
        .toString(16)
        .padStart(2, '0'),
    )
    .join('')}`;
  avatar.background = background ?? (dark ? DARK_BACKGROUND : trained);
  for (const [swatch, color] of swatches) setPressed(swatch, color === background);
}

function addBackgrounds() {
  const row = byId('backgrounds');
  for (const [name, color] of Object.entries({ 'As the page': '', ...BACKGROUNDS })) {
    const swatch = document.createElement('button');
    Object.assign(swatch, { className: 'swatch', title: name });
    swatches.set(swatch, color || null);
    swatch.style.setProperty('--color', color || 'linear-gradient(135deg, #fff 50%, #15171b 50%)');
    swatch.addEventListener('click', () => chooseBackground(color || null));
    row.append(swatch);
  }
  const custom = Object.assign(document.createElement('input'), {
    type: 'color',
    className: 'swatch',
    title: 'Any color',
  });
  custom.addEventListener('input', () => chooseBackground(custom.value));
  row.append(custom);
  applyBackground();
}

/** @param {string | null} color */
function chooseBackground(color) {
  background = color;
  applyBackground();
}

function toggleSelection() {
  if (!avatar.hasSelection) return;
  avatar.showSelection = !avatar.showSelection;
  inputOf('show-selection').checked = avatar.showSelection;
}

function toggleTheme() {
  const root = document.documentElement;
  root.dataset.theme = root.dataset.theme === 'dark' ? 'light' : 'dark';
  if (avatar.info) applyBackground();
}

// Sliders: each shows what plays until it is moved, and again when its value is clicked.

/**
 * @param {HTMLElement} parent
 * @param {SliderOptions} options
 */
function addSlider(parent, { id, label, low, high, read, write, format }) {
  const row = document.createElement('label');
  row.className = 'slider';
  row.dataset.name = id;
  row.innerHTML = '<span></span><button class="value" title="Release"></button><input type="range" step="any">';
  const [name, value] = [element('span', HTMLElement, row), element('button', HTMLElement, row)];
  const input = element('input', HTMLInputElement, row);
  name.textContent = label;
  [input.min, input.max] = [String(low), String(high)];
  let pinned = false;
  const pin = (/** @type {boolean} */ whether) => {
    pinned = whether;
    row.classList.toggle('pinned', whether);
    byId('released').hidden = !document.querySelector('.pinned');
  };
  const update = () => {
    const current = read();
    if (!pinned) input.value = String(current);
    value.textContent = format(pinned ? Number(input.value) : current);
    fillTrack(input);
  };
  input.addEventListener('input', () => {
    pin(true);
    write(Number(input.value));
    update();
  });
  value.addEventListener('click', (event) => {
    event.preventDefault();
    pin(false);
    write(null);
  });
  sliders.push({ update, release: () => pin(false) });
  parent.append(row);
  update();
  return row;
}

/**
 * "Expression 3" for expr_003.
 * @param {string} name
 */
function expressionLabel(name) {
  const number = /^expr_(\d+)$/.exec(name);
  return number ? `Expression ${Number(number[1])}` : name;
}

function addExpressions() {
  const section = byId('expressions');
  const list = element('.sliders', HTMLElement, section);
  const rows = info().sliders.map(({ name, reach }) =>
    addSlider(list, {
      id: name,
      label: expressionLabel(name),
      low: -reach,
      high: reach,
      read: () => avatar.getExpression(name),
      write: (value) => avatar.setExpression(name, value),
      format: (value) => value.toFixed(2),
    }),
  );
  section.hidden = !rows.length;
  showFirst(rows, byId('more'));
}

/**
 * Hide all but the first rows until the button is clicked.
 * @param {HTMLElement[]} rows
 * @param {HTMLElement} more
 */
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
  const rows = names.map((name) =>
    addSlider(list, {
      id: name,
      label: name,
      low: 0,
      high: 1,
      read: () => avatar.getShape(name),
      write: (value) => avatar.setShape(name, value),
      format: (value) => value.toFixed(2),
    }),
  );
  showFirst(rows, byId('more-shapes'));
  const file = inputOf('performance');
  byId('open-performance').addEventListener('click', () => file.click());
  file.addEventListener('change', () => playFile(file.files?.[0]).then(() => (file.value = '')));
  byId('close-performance').addEventListener('click', () => avatar.setPerformance(null));
  avatar.addEventListener('motionchange', () => {
    byId('close-performance').hidden = !avatar.player?.motion.shapes.performance;
    showLength();
  });
  document.addEventListener('dragover', (event) => event.preventDefault());
  document.addEventListener('drop', (event) => {
    event.preventDefault();
    playFile(event.dataTransfer?.files[0]);
  });
}

/** @param {File | undefined} file */
async function playFile(file) {
  if (!file || !avatar.info) return;
  const problem = byId('performance-problem');
  problem.hidden = true;
  try {
    avatar.setPerformance(await file.text());
    avatar.play();
  } catch (error) {
    problem.textContent = error instanceof DataError ? error.message : `The file cannot be read: ${error}`;
    problem.hidden = false;
  }
}

function addPose() {
  const known = POSE_SLIDERS.filter(([, joints]) => joints.every((joint) => info().joints.includes(joint)));
  const list = element('.sliders', HTMLElement, byId('pose'));
  for (const [label, joints, axis, low, high] of known) {
    addSlider(list, {
      id: label,
      label,
      low,
      high,
      read: () => avatar.getPose(joints[0])[axis],
      write: (value) => joints.forEach((joint) => avatar.setPose(joint, replaced(joint, axis, value))),
      format: (value) => `${Math.round((180 / Math.PI) * value)}°`,
    });
  }
  byId('pose').hidden = !known.length;
}

/** @type {Record<string, (number | null)[]>} */
const pinnedAngles = {}; // joint → three angles, null: as recorded

/**
 * @param {string} joint
 * @param {number} axis
 * @param {number | null} value
 */
function replaced(joint, axis, value) {
  pinnedAngles[joint] ??= [null, null, null];
  pinnedAngles[joint][axis] = value;
  return pinnedAngles[joint];
}

function releaseAll() {
  for (const joint of Object.keys(pinnedAngles)) delete pinnedAngles[joint];
  for (const slider of sliders) slider.release();
  avatar.release();
}

// Keyboard, panel and facts

/** @type {Record<string, () => unknown>} */
const KEYS = {
  ' ': toggle,
  k: toggle,
  ArrowLeft: () => step(-1),
  ArrowRight: () => step(1),
  Home: () => (avatar.frame = 0),
  End: () => (avatar.frame = avatar.frameCount - 1),
  c: togglePanel,
  f: toggleFullscreen,
  h: () => document.body.classList.toggle('bare'),
  l: toggleLoop,
  r: resetView,
  s: toggleSelection,
  t: toggleTheme,
  x: releaseAll,
};

/** @param {KeyboardEvent} event */
function press(event) {
  const isArrow = event.key.startsWith('Arrow');
  const isTyping = event.target instanceof Element && event.target.matches(isArrow ? 'select, input' : 'select');
  if (isTyping || event.ctrlKey || event.metaKey || event.altKey || !avatar.info) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const action = /^[1-9]$/.test(key) ? () => showView(Number(key) - 1) : KEYS[key];
  if (!action) return;
  event.preventDefault();
  action();
}

function togglePanel() {
  const { hidden } = byId('panel');
  byId('panel').hidden = !hidden;
  byId('open').setAttribute('aria-expanded', String(hidden));
}

function toggleFullscreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.().catch(() => {});
}

function showFacts() {
  const splats = avatar.splatCount.toLocaleString('en');
  const rate = avatar.frameCount > 1 ? ` · ${Number(avatar.fps.toFixed(2))} fps` : '';
  byId('facts').innerHTML =
    `${splats} splats${rate}<span class="detail"> · ${avatar.frameTime.toFixed(1)} ms of JavaScript a frame</span>`;
}

function start() {
  addTransport();
  addViews();
  addBackgrounds();
  if (avatar.hasLight) new LightControls(byId('light'), avatar);
  addFaceShapes();
  addExpressions();
  addPose();
  avatar.addEventListener('frame', () => {
    if (!byId('panel').hidden) for (const slider of sliders) slider.update();
  });
  byId('selection').hidden = !avatar.hasSelection;
  byId('show-selection').addEventListener('change', toggleSelection);
  byId('release').addEventListener('click', releaseAll);
  byId('open').addEventListener('click', togglePanel);
  byId('panel').hidden = innerWidth <= 640;
  byId('open').setAttribute('aria-expanded', String(!byId('panel').hidden));
  setInterval(showFacts, FACTS_INTERVAL_MS);
  showFacts();
  avatar.loop = true;
  if (!matchMedia('(prefers-reduced-motion: reduce)').matches) avatar.play();
}

function fail() {
  for (const id of ['heading', 'transport', 'panel', 'open']) byId(id).hidden = true;
}

document.documentElement.dataset.theme = matchMedia('(prefers-color-scheme: dark)').matches ? 'dark' : 'light';
byId('theme').addEventListener('click', toggleTheme);
byId('fullscreen').addEventListener('click', toggleFullscreen);
addEventListener('keydown', press);
avatar.addEventListener('load', start, { once: true });
avatar.addEventListener('error', fail);

/** The data file that the page holds as base64. Throws DataError where it was cut off or altered. */
async function embeddedData() {
  const text = document.querySelector('#data')?.textContent?.trim();
  if (!text) throw new DataError('This page holds no avatar data.');
  try {
    return Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  } catch {
    throw new DataError('The avatar data is damaged.');
  }
}

try {
  await avatar.load(embeddedData());
} catch (error) {
  console.error(error);
}
