// Pinhole cameras (OpenCV axes: x right, y down, z ahead) and the ways to move one around a point.

import { crossed, dotProduct, unit } from './vector.js';

const MAX_ELEVATION = 1.54; // radians; short of the pole, where "up" has no direction
const MIN_DISTANCE_M = 0.02;

/** A view of the data file as a camera: { size, focal, center } in pixels, matrix (16): world to camera, row-major. */
export function cameraOfView(view) {
  const { size, focal, center } = view;
  return { size: [...size], focal: [...focal], center: [...center], matrix: Float64Array.from(view.world_to_camera) };
}

/** The same camera for a canvas of another size, with the whole of its picture in the middle. */
export function fitted(camera, width, height) {
  const scale = Math.min(width / camera.size[0], height / camera.size[1]);
  return {
    size: [width, height],
    focal: camera.focal.map((value) => value * scale),
    center: [
      width / 2 + (camera.center[0] - camera.size[0] / 2) * scale,
      height / 2 + (camera.center[1] - camera.size[1] / 2) * scale,
    ],
    matrix: camera.matrix,
  };
}

/** A camera in front (+z, y up) of the points (3·V) for data without views. */
export function frontCamera(points, up) {
  const [middle, radius] = bounds(points);
  const distance = 5 * radius;
  const y = up.map((value) => -value / Math.hypot(...up));
  const ahead = Math.abs(y[2]) < 0.9 ? [0, 0, -1] : [0, 1, 0];
  const x = unit(crossed(y, ahead));
  const z = crossed(x, y);
  const eye = middle.map((value, k) => value - distance * z[k]);
  const rows = [x, y, z].flatMap((row) => [...row, -dotProduct(row, eye)]);
  const matrix = Float64Array.from([...rows, 0, 0, 0, 1]);
  return { size: [800, 800], focal: [1600, 1600], center: [400, 400], matrix };
}

/** Middle of the bounding box of points (3·V), and half its diagonal. */
export function bounds(points) {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (let k = 0; k < points.length; k++) {
    low[k % 3] = Math.min(low[k % 3], points[k]);
    high[k % 3] = Math.max(high[k % 3], points[k]);
  }
  const middle = low.map((value, k) => (value + high[k]) / 2);
  return [middle, Math.hypot(...high.map((value, k) => value - low[k])) / 2];
}

/** Turn a camera around the point `pivot`: by `yaw` about `up` and by `pitch` about its own x axis (radians). */
export function orbited(camera, pivot, up, yaw, pitch) {
  const axis = unit(up);
  const elevation = Math.asin(Math.max(-1, Math.min(1, dotProduct(row(camera.matrix, 2), axis))));
  const tilt = Math.max(-MAX_ELEVATION - elevation, Math.min(MAX_ELEVATION - elevation, pitch));
  const aside = turned(camera, pivot, axis, yaw);
  return turned(aside, pivot, row(aside.matrix, 0), tilt);
}

/** Shift a camera's picture by pixels; returns the camera and the point to orbit about, shifted with the view. */
export function panned(camera, pivot, dx, dy) {
  const depth = inCamera(camera.matrix, pivot)[2];
  const shift = [(dx * depth) / camera.focal[0], (dy * depth) / camera.focal[1]];
  const matrix = camera.matrix.slice();
  matrix[3] += shift[0];
  matrix[7] += shift[1];
  const [x, y] = [row(matrix, 0), row(matrix, 1)];
  return [{ ...camera, matrix }, pivot.map((value, k) => value - shift[0] * x[k] - shift[1] * y[k])];
}

/** Move a camera to `factor` times its distance from `pivot`. */
export function dollied(camera, pivot, factor) {
  const q = inCamera(camera.matrix, pivot);
  const kept = Math.max(factor, MIN_DISTANCE_M / Math.max(q[2], MIN_DISTANCE_M));
  const matrix = camera.matrix.slice();
  for (let k = 0; k < 3; k++) matrix[4 * k + 3] += (kept - 1) * q[k];
  return { ...camera, matrix };
}

/** Rotate about a world axis through `pivot`, which stays where it is in the picture. */
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

function rotatedAbout(v, axis, angle) {
  const [cosine, sine] = [Math.cos(angle), Math.sin(angle)];
  const side = crossed(axis, v);
  const along = dotProduct(axis, v) * (1 - cosine);
  return v.map((value, k) => value * cosine + side[k] * sine + axis[k] * along);
}

function row(matrix, k) {
  return [matrix[4 * k], matrix[4 * k + 1], matrix[4 * k + 2]];
}

function inCamera(matrix, point) {
  return [0, 1, 2].map((k) => dotProduct(row(matrix, k), point) + matrix[4 * k + 3]);
}
