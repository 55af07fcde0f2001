// @ts-check
// Orbit, pan and zoom with mouse, pen and touch.

/**
 * @import { Player } from './player.js'
 * @typedef {[number, number]} Point pixels of the page
 */

import { dollied, orbited, panned, turnedAsSeen } from './camera.js';

const ORBIT_PER_PIXEL = 0.008; // radians
const ZOOM_PER_WHEEL_PIXEL = 0.0012;
const WHEEL_LINE_PX = 16;
const MAX_WHEEL_PX = 120; // of one event, so that no mouse jumps

/**
 * Let pointers on `element` move the camera of the player that `player()` gives, and with Alt its sun; `changed()` after
 * each move of the camera, `lit()` after each of the sun.
 * @param {HTMLElement} element
 * @param {() => Player | null} player
 * @param {() => void} changed
 * @param {() => void} lit
 */
export function addControls(element, player, changed, lit) {
  /** @type {Map<number, Point>} */
  const pointers = new Map();
  element.addEventListener('contextmenu', (event) => event.preventDefault());
  element.addEventListener('pointerdown', (event) => {
    element.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  for (const name of /** @type {const} */ (['pointerup', 'pointercancel'])) {
    element.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  element.addEventListener('pointermove', (event) => {
    const shown = player();
    if (!pointers.has(event.pointerId) || !shown) return;
    const before = [...pointers.values()];
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const after = [...pointers.values()];
    if (event.altKey && after.length === 1 && shown.lighting?.sun) {
      turnSun(shown, before[0], after[0]);
      lit();
      return;
    }
    if (after.length === 1) drag(shown, element, before[0], after[0], event.shiftKey || event.buttons > 1);
    else pinch(shown, element, before, after);
    changed();
  });
  element.addEventListener(
    'wheel',
    (event) => {
      const shown = player();
      if (!shown) return;
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode === 1 ? WHEEL_LINE_PX : 1);
      const limited = Math.max(-MAX_WHEEL_PX, Math.min(MAX_WHEEL_PX, pixels));
      zoomBy(shown, Math.exp(limited * ZOOM_PER_WHEEL_PIXEL));
      changed();
    },
    { passive: false },
  );
}

/**
 * @param {Player} player
 * @param {number} dx
 * @param {number} dy
 */
function orbitBy(player, dx, dy) {
  const { up } = player.data.header;
  player.camera = orbited(player.camera, player.pivot, up, -dx * ORBIT_PER_PIXEL, dy * ORBIT_PER_PIXEL);
}

/**
 * Move the light over the head as the pointer goes.
 * @param {Player} player
 * @param {Point} before
 * @param {Point} after
 */
function turnSun(player, before, after) {
  const [yaw, pitch] = [after[0] - before[0], after[1] - before[1]].map((pixels) => pixels * ORBIT_PER_PIXEL);
  const { lighting, camera } = player;
  if (!lighting?.sun) return;
  const toward = turnedAsSeen(camera, lighting.sun.toward, yaw, pitch);
  player.lighting = { ...lighting, sun: { ...lighting.sun, toward } };
}

/**
 * @param {Player} player
 * @param {number} factor
 */
function zoomBy(player, factor) {
  player.camera = dollied(player.camera, player.pivot, factor);
}

/**
 * @param {Player} player
 * @param {HTMLElement} element
 * @param {Point} before
 * @param {Point} after
 * @param {boolean} pans
 */
function drag(player, element, before, after, pans) {
  const [dx, dy] = [after[0] - before[0], after[1] - before[1]];
  if (pans) panBy(player, element, dx, dy);
  else orbitBy(player, dx, dy);
}

/**
 * Two fingers: their middle pans, their distance zooms.
 * @param {Player} player
 * @param {HTMLElement} element
 * @param {Point[]} before
 * @param {Point[]} after
 */
function pinch(player, element, before, after) {
  /** @type {(points: Point[]) => Point} */
  const middle = ([a, b]) => [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
  /** @type {(points: Point[]) => number} */
  const distance = ([a, b]) => Math.max(1, Math.hypot(a[0] - b[0], a[1] - b[1]));
  const [from, to] = [middle(before), middle(after)];
  panBy(player, element, to[0] - from[0], to[1] - from[1]);
  zoomBy(player, distance(before) / distance(after));
}

/**
 * Pan by pixels of the page, of which a pixel of the camera may be several.
 * @param {Player} player
 * @param {HTMLElement} element
 * @param {number} dx
 * @param {number} dy
 */
function panBy(player, element, dx, dy) {
  const { size } = player.camera;
  const scale = Math.max(size[0] / element.clientWidth, size[1] / element.clientHeight);
  [player.camera, player.pivot] = panned(player.camera, player.pivot, dx * scale, dy * scale);
}
