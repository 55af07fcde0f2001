// The page's controls. Everything that they do is in the public interface of <stga-avatar>.

import { DataError } from './data.js';
import './stga-avatar.js';

const SLIDERS_SHOWN = 8;
const FACTS_INTERVAL_MS = 500;
const BACKGROUNDS = { White: '#ffffff', Gray: '#808080', Black: '#000000' };
const THEME_BACKGROUND = { light: null, dark: '#15171b' }; // null: what the avatar was trained against
// Joint, axis, smallest and largest angle in radians.
const POSE_SLIDERS = [
  ['Jaw open', ['jaw'], 0, -0.1, 0.6],
  ['Nod', ['neck'], 0, -0.5, 0.5],
  ['Turn', ['neck'], 1, -0.8, 0.8],
  ['Tilt', ['neck'], 2, -0.5, 0.5],
  ['Look sideways', ['left_eye', 'right_eye'], 1, -0.6, 0.6],
  ['Look down', ['left_eye', 'right_eye'], 0, -0.5, 0.5],
];

const avatar = document.querySelector('stga-avatar');
const byId = (id) => document.getElementById(id);
const sliders = []; // { update } of each

function setPressed(button, pressed) {
  button.setAttribute('aria-pressed', String(pressed));
}

function fillTrack(input) {
  const share = (input.value - input.min) / (input.max - input.min || 1);
  input.style.setProperty('--done', `${100 * share}%`);
}

// Playback

function updateTransport() {
  const last = avatar.frameCount - 1;
  const frame = Math.min(Math.round(avatar.frame), last);
  setPressed(byId('play'), avatar.playing);
  byId('play').title = avatar.playing ? 'Pause (Space)' : 'Play (Space)';
  byId('scrub').value = Math.min(avatar.frame, last);
  byId('number').textContent = `${frame + 1} / ${last + 1}`;
  fillTrack(byId('scrub'));
}

function toggle() {
  if (avatar.playing) avatar.pause();
  else avatar.play();
}

function toggleLoop() {
  avatar.loop = !avatar.loop;
  setPressed(byId('loop'), avatar.loop);
}

function step(by) {
  avatar.pause();
  avatar.frame = Math.round(avatar.frame) + by;
}

function addTransport() {
  byId('transport').hidden = avatar.frameCount < 2;
  byId('scrub').max = avatar.frameCount - 1;
  byId('play').addEventListener('click', toggle);
  byId('loop').addEventListener('click', toggleLoop);
  byId('speed').addEventListener('change', (event) => (avatar.speed = Number(event.target.value)));
  byId('scrub').addEventListener('input', (event) => {
    avatar.pause();
    avatar.frame = Number(event.target.value);
  });
  for (const name of ['frame', 'play', 'pause']) avatar.addEventListener(name, updateTransport);
  updateTransport();
}

// View

function addViews() {
  const names = avatar.info.views.map(({ name }) => name);
  for (const name of names.length ? names : ['Front']) byId('view').add(new Option(name, name));
  byId('view').addEventListener('change', (event) => showView(event.target.selectedIndex));
  byId('reset').addEventListener('click', resetView);
}

function showView(index) {
  const view = avatar.info.views[index];
  if (view) avatar.camera = view.name;
  else if (!index) avatar.resetCamera();
  if (view || !index) byId('view').selectedIndex = index;
}

function resetView() {
  avatar.resetCamera();
  byId('view').selectedIndex = 0;
}

let background = null; // chosen by the viewer; null: the theme's

function applyBackground() {
  const { theme } = document.documentElement.dataset;
  const trained = `#${avatar.info.background
    .map((part) =>
      Math.round(255 * part)
        .toString(16)
        .padStart(2, '0'),
    )
    .join('')}`;
  avatar.background = background ?? THEME_BACKGROUND[theme] ?? trained;
  for (const swatch of document.querySelectorAll('button.swatch'))
    setPressed(swatch, (swatch.dataset.color || null) === background);
}

function addBackgrounds() {
  const row = byId('backgrounds');
  for (const [name, color] of Object.entries({ 'As the page': '', ...BACKGROUNDS })) {
    const swatch = document.createElement('button');
    Object.assign(swatch, { className: 'swatch', title: name });
    swatch.dataset.color = color;
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

function chooseBackground(color) {
  background = color;
  applyBackground();
}

function toggleSelection() {
  if (!avatar.hasSelection) return;
  avatar.showSelection = !avatar.showSelection;
  byId('show-selection').checked = avatar.showSelection;
}

function toggleTheme() {
  const root = document.documentElement;
  root.dataset.theme = root.dataset.theme === 'dark' ? 'light' : 'dark';
  if (avatar.info) applyBackground();
}

// Sliders: each shows what plays until it is moved, and again when its value is clicked.

function addSlider(parent, { id, label, low, high, read, write, format }) {
  const row = document.createElement('label');
  row.className = 'slider';
  row.dataset.name = id;
  row.innerHTML = '<span></span><button class="value" title="Release"></button><input type="range" step="any">';
  const [name, value, input] = row.children;
  name.textContent = label;
  Object.assign(input, { min: low, max: high });
  let pinned = false;
  const pin = (whether) => {
    pinned = whether;
    row.classList.toggle('pinned', whether);
    byId('released').hidden = !document.querySelector('.pinned');
  };
  const update = () => {
    const current = read();
    if (!pinned) input.value = current;
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

/** "Expression 3" for expr_003. */
function expressionLabel(name) {
  const number = /^expr_(\d+)$/.exec(name);
  return number ? `Expression ${Number(number[1])}` : name;
}

function addExpressions() {
  const section = byId('expressions');
  const list = section.querySelector('.sliders');
  const rows = avatar.info.sliders.map(({ name, reach }) =>
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
  const more = byId('more');
  more.hidden = rows.length <= SLIDERS_SHOWN;
  more.textContent = `Show all ${rows.length}`;
  for (const row of rows.slice(SLIDERS_SHOWN)) row.hidden = true;
  more.addEventListener('click', () => {
    for (const row of rows) row.hidden = false;
    more.hidden = true;
  });
}

function addPose() {
  const known = POSE_SLIDERS.filter(([, joints]) => joints.every((joint) => avatar.info.joints.includes(joint)));
  const list = byId('pose').querySelector('.sliders');
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

const pinnedAngles = {}; // joint → three angles, null: as recorded

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

function press(event) {
  const isTyping = event.target.matches('select') || (event.target.matches('input') && event.key.startsWith('Arrow'));
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
  const rate = avatar.frameCount > 1 ? ` · ${Number(avatar.info.fps.toFixed(2))} fps` : '';
  byId('facts').innerHTML =
    `${splats} splats${rate}<span class="detail"> · ${avatar.frameTime.toFixed(1)} ms of JavaScript a frame</span>`;
}

function start() {
  addTransport();
  addViews();
  addBackgrounds();
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
  const text = document.getElementById('data')?.textContent?.trim();
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
