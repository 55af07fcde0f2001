// @ts-check
// The page's Light section: as recorded, a light that is dragged over the head, or an environment.

/**
 * @import { StgaAvatar } from './stga-avatar.js'
 * @import { Camera, Lighting, Vector } from './types.js'
 *
 * @typedef {'recorded' | 'dragged' | string} Kind the name of an environment, or one of these
 */

import { ENVIRONMENTS } from './lighting.js';
import { linearOfSrgb } from './surface.js';
import { scaled } from './vector.js';

const PAD_ANGLE = 2.6; // radians from the camera's own direction at the rim of the pad: the light comes from behind
const DRAGGED = 'dragged';
/** Label, kinds that have it ("*": all environments), range, first value and format of each slider. */
const RANGES = {
  strength: { label: 'Strength', kinds: DRAGGED, low: 0, high: 8, value: 3, format: fixed },
  even: { label: 'Even light', kinds: DRAGGED, low: 0, high: 1, value: 0.15, format: fixed },
  turn: { label: 'Turn', kinds: '*', low: -180, high: 180, value: 0, format: degrees },
  exposure: { label: 'Exposure', kinds: `${DRAGGED}*`, low: -3, high: 3, value: 0, format: signed },
};

export class LightControls {
  /**
   * Fill and show `section` for an avatar whose light is known.
   * @param {HTMLElement} section
   * @param {StgaAvatar} avatar
   */
  constructor(section, avatar) {
    this.avatar = avatar;
    /** @type {Kind} */
    this.kind = 'recorded';
    /** @type {Vector} towards the light */
    this.toward = fromPad(avatar.camera, -0.25, -0.22);
    this.select = /** @type {HTMLSelectElement} */ (section.querySelector('select'));
    this.pad = /** @type {HTMLElement} */ (section.querySelector('#light-pad'));
    this.color = /** @type {HTMLInputElement} */ (section.querySelector('input[type="color"]'));
    this.dragged = /** @type {HTMLElement} */ (section.querySelector('#light-dragged'));
    section.hidden = false;
    this.addKinds();
    this.rows = Object.entries(RANGES).map(([name, range]) => this.addRange(section, name, range));
    this.color.addEventListener('input', () => this.apply());
    for (const name of ['pointerdown', 'pointermove']) {
      this.pad.addEventListener(name, (event) => this.drag(/** @type {PointerEvent} */ (event)));
    }
    avatar.addEventListener('camerachange', () => this.showDirection());
    avatar.addEventListener('lightchange', () => this.followAvatar());
    this.showKind();
  }

  addKinds() {
    const environments = Object.entries(ENVIRONMENTS).map(([name, { label }]) => [name, label]);
    for (const [name, label] of [['recorded', 'As recorded'], [DRAGGED, 'A light to drag'], ...environments]) {
      this.select.add(new Option(label, name));
    }
    this.select.addEventListener('change', () => this.choose(this.select.value));
  }

  /** @param {Kind} kind */
  choose(kind) {
    this.kind = kind;
    this.showKind();
    this.apply();
  }

  /**
   * @param {HTMLElement} section
   * @param {string} name
   * @param {typeof RANGES['turn']} range
   */
  addRange(section, name, { label, kinds, low, high, value, format }) {
    const row = document.createElement('label');
    row.className = 'range';
    row.innerHTML = '<span></span><output></output><input type="range" step="any">';
    const [text, output, input] = /** @type {[HTMLElement, HTMLElement, HTMLInputElement]} */ ([...row.children]);
    text.textContent = label;
    [input.min, input.max, input.value, input.name] = [String(low), String(high), String(value), name];
    const show = () => {
      output.textContent = format(Number(input.value));
      input.style.setProperty('--done', `${(100 * (Number(input.value) - low)) / (high - low)}%`);
    };
    input.addEventListener('input', () => {
      show();
      this.apply();
    });
    show();
    section.append(row);
    return { name, row, input, kinds };
  }

  showKind() {
    this.dragged.hidden = this.kind !== DRAGGED;
    const isEnvironment = Object.hasOwn(ENVIRONMENTS, this.kind);
    for (const { row, kinds } of this.rows) {
      row.hidden = !(isEnvironment ? kinds.endsWith('*') : this.kind === DRAGGED && kinds.startsWith(DRAGGED));
    }
    this.showDirection();
  }

  apply() {
    this.avatar.lighting = this.lighting();
  }

  /** @returns {Lighting | null} */
  lighting() {
    if (this.kind === 'recorded') return null;
    const value = Object.fromEntries(this.rows.map(({ name, input }) => [name, Number(input.value)]));
    const { strength, even, exposure } = value;
    if (this.kind !== DRAGGED) return { environment: this.kind, turn: (Math.PI / 180) * value.turn, exposure };
    const color = scaled(linearColor(this.color.value), strength);
    return { even: [even, even, even], sun: { toward: this.toward, color }, exposure };
  }

  /** The light may have been dragged over the head. */
  followAvatar() {
    const sun = this.avatar.lighting?.sun;
    if (sun && this.kind === DRAGGED) this.toward = sun.toward;
    this.showDirection();
  }

  /** @param {PointerEvent} event */
  drag(event) {
    if (event.type === 'pointerdown') this.pad.setPointerCapture(event.pointerId);
    else if (!this.pad.hasPointerCapture(event.pointerId)) return;
    const { left, top, width, height } = this.pad.getBoundingClientRect();
    const x = (2 * (event.clientX - left)) / width - 1;
    const y = (2 * (event.clientY - top)) / height - 1;
    this.toward = fromPad(this.avatar.camera, x, y);
    this.apply();
  }

  showDirection() {
    if (this.kind !== DRAGGED) return;
    const [x, y] = onPad(this.avatar.camera, this.toward);
    this.pad.style.setProperty('--x', `${50 + 50 * x}%`);
    this.pad.style.setProperty('--y', `${50 + 50 * y}%`);
  }
}

/**
 * The direction in the world of a place on the pad, whose middle is where the camera looks from.
 * @param {Camera | null} camera
 * @param {number} x from -1 to 1, to the right
 * @param {number} y from -1 to 1, down
 * @returns {Vector}
 */
function fromPad(camera, x, y) {
  const reach = Math.hypot(x, y);
  const angle = PAD_ANGLE * Math.min(1, reach);
  const side = reach > 0 ? Math.sin(angle) / reach : 0;
  const m = camera?.matrix ?? [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  const part = (/** @type {number} */ k) => m[k] * x * side + m[4 + k] * y * side - m[8 + k] * Math.cos(angle);
  return [part(0), part(1), part(2)];
}

/**
 * The reverse, within the pad.
 * @param {Camera | null} camera
 * @param {Vector} toward
 */
function onPad(camera, toward) {
  const m = camera?.matrix ?? [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  const along = (/** @type {number} */ k) => m[k] * toward[0] + m[k + 1] * toward[1] + m[k + 2] * toward[2];
  const [x, y, z] = [along(0), along(4), along(8)];
  const side = Math.hypot(x, y);
  const reach = Math.min(1, Math.atan2(side, -z) / PAD_ANGLE);
  return side > 1e-9 ? [(x / side) * reach, (y / side) * reach] : [0, 0];
}

/**
 * "#rrggbb" in linear light.
 * @param {string} hex
 * @returns {Vector}
 */
function linearColor(hex) {
  const part = (/** @type {number} */ at) => linearOfSrgb(parseInt(hex.slice(at, at + 2), 16) / 255);
  return [part(1), part(3), part(5)];
}

/** @param {number} value */
function fixed(value) {
  return value.toFixed(2);
}

/** @param {number} value */
function degrees(value) {
  return `${Math.round(value)}°`;
}

/** @param {number} value */
function signed(value) {
  return `${value < 0 ? '−' : '+'}${Math.abs(value).toFixed(1)}`;
}
