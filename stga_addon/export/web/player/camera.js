// @ts-check
// Pinhole cameras (OpenCV axes: x right, y down, z ahead), and how mouse, pen and touch move one
// around a point.

/**
 * @import { Player } from './stga-avatar.js'
 * @import { Camera, Pair, Vector, View } from './types.js'
 */

import { box, crossed, difference, dotProduct, scaled, unit, vector } from './vector.js';

const MAX_ELEVATION = 1.54; // radians; short of the pole, where "up" has no direction
const MIN_DISTANCE_M = 0.02;

// A view of the data file as a camera.
/** @type {(view: View) => Camera} */
export function cameraOfView(view) {
  const { size, focal, center, world_to_camera } = structuredClone(view);
  return { size, focal, center, matrix: Float64Array.from(world_to_camera) };
}

// The same camera for a canvas of another size, with the whole of its picture in the middle.
/** @type {(camera: Camera, width: number, height: number) => Camera} */
export function fitted(camera, width, height) {
  const { size, focal, center, matrix } = camera;
  const scale = Math.min(width / size[0], height / size[1]);
  const x = width / 2 + (center[0] - size[0] / 2) * scale;
  const y = height / 2 + (center[1] - size[1] / 2) * scale;
  const [fx, fy] = focal;
  return { size: [width, height], focal: [fx * scale, fy * scale], center: [x, y], matrix };
}

// A camera in front (+z, y up) of the points (3·V) for data without views.
/** @type {(points: ArrayLike<number>, up: Vector) => Camera} */
export function frontCamera(points, up) {
  const [middle, radius] = bounds(points);
  const distance = 5 * radius;
  const y = scaled(unit(up), -1);
  const ahead = Math.abs(y[2]) < 0.9 ? [0, 0, -1] : [0, 1, 0];
  const x = unit(crossed(y, ahead));
  const z = crossed(x, y);
  const eye = difference(middle, scaled(z, distance));
  const rows = [x, y, z].flatMap(row => [...row, -dotProduct(row, eye)]);
  const matrix = Float64Array.from([...rows, 0, 0, 0, 1]);
  return { size: [800, 800], focal: [1600, 1600], center: [400, 400], matrix };
}

// Middle of the bounding box of points (3·V), and half its diagonal.
/** @type {(points: ArrayLike<number>) => [Vector, number]} */
export function bounds(points) {
  const [low, high] = box(points);
  const diagonal = difference(high, low);
  return [difference(high, scaled(diagonal, 0.5)), Math.hypot(...diagonal) / 2];
}

// Turn a camera around a point: by `yaw` about `up` and by `pitch` about its own x axis (radians).
/** @type {(camera: Camera, pivot: Vector, up: Vector, yaw: number, pitch: number) => Camera} */
export function orbited(camera, pivot, up, yaw, pitch) {
  const axis = unit(up);
  const elevation = Math.asin(Math.max(-1, Math.min(1, dotProduct(row(camera.matrix, 2), axis))));
  const tilt = Math.max(-MAX_ELEVATION - elevation, Math.min(MAX_ELEVATION - elevation, pitch));
  const yawed = turned(camera, pivot, axis, yaw);
  return turned(yawed, pivot, row(yawed.matrix, 0), tilt);
}

// Shift a camera's picture by pixels; returns the camera and the point to orbit about, which shifts
// with the view.
/** @type {(camera: Camera, pivot: Vector, dx: number, dy: number) => [Camera, Vector]} */
export function panned(camera, pivot, dx, dy) {
  const depth = inCamera(camera.matrix, pivot)[2];
  const shift = [(dx * depth) / camera.focal[0], (dy * depth) / camera.focal[1]];
  const matrix = camera.matrix.slice();
  matrix[3] += shift[0];
  matrix[7] += shift[1];
  const moved = difference(pivot, scaled(row(matrix, 0), shift[0]));
  return [{ ...camera, matrix }, difference(moved, scaled(row(matrix, 1), shift[1]))];
}

// Move a camera to `factor` times its distance from `pivot`.
/** @type {(camera: Camera, pivot: Vector, factor: number) => Camera} */
export function dollied(camera, pivot, factor) {
  const q = inCamera(camera.matrix, pivot);
  const kept = Math.max(factor, MIN_DISTANCE_M / Math.max(q[2], MIN_DISTANCE_M));
  const matrix = camera.matrix.slice();
  for (let k = 0; k < 3; k++) matrix[4 * k + 3] += (kept - 1) * q[k];
  return { ...camera, matrix };
}

// Rotate about a world axis through `pivot`, which stays where it is in the picture.
/** @type {(camera: Camera, pivot: Vector, axis: Vector, angle: number) => Camera} */
function turned(camera, pivot, axis, angle) {
  const before = inCamera(camera.matrix, pivot);
  const matrix = camera.matrix.slice();
  for (let k = 0; k < 3; k++) {
    const direction = rotatedAbout(row(camera.matrix, k), axis, angle);
    matrix.set(direction, 4 * k);
    matrix[4 * k + 3] = before[k] - dotProduct(direction, pivot);
  }
  return { ...camera, matrix };
}

/** @type {(v: Vector, axis: Vector, angle: number) => Vector} */
export function rotatedAbout(v, axis, angle) {
  const [cosine, sine] = [Math.cos(angle), Math.sin(angle)];
  const side = crossed(axis, v);
  const along = dotProduct(axis, v) * (1 - cosine);
  return vector(k => v[k] * cosine + side[k] * sine + axis[k] * along);
}

/** @type {(matrix: Float64Array, k: number) => Vector} */
export const row = (matrix, k) => vector(c => matrix[4 * k + c]);

/** @type {(matrix: Float64Array, point: Vector) => Vector} */
const inCamera = (matrix, point) =>
  vector(k => dotProduct(row(matrix, k), point) + matrix[4 * k + 3]);

const ORBIT_PER_PIXEL = 0.008; // radians
const ZOOM_PER_WHEEL_PIXEL = 0.0012;
const WHEEL_LINE_PX = 16;
const MAX_WHEEL_PX = 120; // of one event, so that no mouse jumps

// Let pointers on `element` move the camera of the player that `player()` gives, and with Alt its
// sun; `changed` hears of "camerachange" and "lightchange". Of two fingers, the middle pans and the
// distance zooms.
/** @type {(element: HTMLElement, player: () => ?Player, changed: (name: string) => void) => void} */
export function addControls(element, player, changed) {
  /** @type {Map<number, Pair>} */
  const pointers = new Map(); // pixels of the page
  element.addEventListener('contextmenu', event => event.preventDefault());
  element.addEventListener('pointerdown', event => {
    element.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  for (const name of /** @type {const} */ (['pointerup', 'pointercancel'])) {
    element.addEventListener(name, event => pointers.delete(event.pointerId));
  }
  element.addEventListener('pointermove', event => {
    const shown = player();
    if (!pointers.has(event.pointerId) || !shown) return;
    const before = [...pointers.values()];
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const after = [...pointers.values()];
    const { camera, data, lighting, pivot } = shown;
    const [dx, dy] = middle(after).map((place, axis) => place - middle(before)[axis]);
    const [yaw, pitch] = [dx * ORBIT_PER_PIXEL, dy * ORBIT_PER_PIXEL];
    if (event.altKey && after.length === 1 && lighting?.sun) {
      // With what faces the camera.
      const yawed = rotatedAbout(lighting.sun.toward, row(camera.matrix, 1), -yaw);
      const toward = rotatedAbout(yawed, row(camera.matrix, 0), pitch);
      shown.lighting = { ...lighting, sun: { ...lighting.sun, toward } };
      changed('lightchange');
      return;
    }
    if (after.length === 1 && !event.shiftKey && event.buttons <= 1) {
      shown.camera = orbited(camera, pivot, data.header.up, -yaw, pitch);
    } else {
      const [width, height] = camera.size;
      const scale = Math.max(width / element.clientWidth, height / element.clientHeight);
      [shown.camera, shown.pivot] = panned(camera, pivot, dx * scale, dy * scale);
    }
    if (after.length > 1)
      shown.camera = dollied(shown.camera, shown.pivot, distance(before) / distance(after));
    changed('camerachange');
  });
  // prettier-ignore
  element.addEventListener('wheel', event => {
    const shown = player();
    if (!shown) return;
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === 1 ? WHEEL_LINE_PX : 1);
    const limited = Math.max(-MAX_WHEEL_PX, Math.min(MAX_WHEEL_PX, pixels));
    shown.camera = dollied(shown.camera, shown.pivot, Math.exp(limited * ZOOM_PER_WHEEL_PIXEL));
    changed('camerachange');
  }, { passive: false });
}

/** @param {Pair[]} points one or two */
const middle = ([a, b = a]) => [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];

/** @param {Pair[]} points two, or more */
const distance = ([a, b]) => Math.max(1, Math.hypot(a[0] - b[0], a[1] - b[1]));
