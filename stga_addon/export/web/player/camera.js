// @ts-check
// Pinhole cameras (OpenCV axes: x right, y down, z ahead) and the ways to move one around a point.

/** @import { Camera, Vector, View } from './types.js' */

import { box, crossed, difference, dotProduct, scaled, unit } from './vector.js';

const MAX_ELEVATION = 1.54; // radians; short of the pole, where "up" has no direction
const MIN_DISTANCE_M = 0.02;

/**
 * A view of the data file as a camera: { size, focal, center } in pixels, matrix (16): world to camera, row-major.
 * @param {View} view
 * @returns {Camera}
 */
export function cameraOfView(view) {
  const { size, focal, center } = view;
  return { size: [...size], focal: [...focal], center: [...center], matrix: Float64Array.from(view.world_to_camera) };
}

/**
 * The same camera for a canvas of another size, with the whole of its picture in the middle.
 * @param {Camera} camera
 * @param {number} width
 * @param {number} height
 * @returns {Camera}
 */
export function fitted(camera, width, height) {
  const scale = Math.min(width / camera.size[0], height / camera.size[1]);
  return {
    size: [width, height],
    focal: [camera.focal[0] * scale, camera.focal[1] * scale],
    center: [
      width / 2 + (camera.center[0] - camera.size[0] / 2) * scale,
      height / 2 + (camera.center[1] - camera.size[1] / 2) * scale,
    ],
    matrix: camera.matrix,
  };
}

/**
 * A camera in front (+z, y up) of the points (3·V) for data without views.
 * @param {ArrayLike<number>} points
 * @param {Vector} up
 * @returns {Camera}
 */
export function frontCamera(points, up) {
  const [middle, radius] = bounds(points);
  const distance = 5 * radius;
  const y = scaled(unit(up), -1);
  const ahead = Math.abs(y[2]) < 0.9 ? [0, 0, -1] : [0, 1, 0];
  const x = unit(crossed(y, ahead));
  const z = crossed(x, y);
  const eye = difference(middle, scaled(z, distance));
  const rows = [x, y, z].flatMap((row) => [...row, -dotProduct(row, eye)]);
  const matrix = Float64Array.from([...rows, 0, 0, 0, 1]);
  return { size: [800, 800], focal: [1600, 1600], center: [400, 400], matrix };
}

/**
 * Middle of the bounding box of points (3·V), and half its diagonal.
 * @param {ArrayLike<number>} points
 * @returns {[Vector, number]}
 */
export function bounds(points) {
  const [low, high] = box(points);
  const diagonal = difference(high, low);
  return [difference(high, scaled(diagonal, 0.5)), Math.hypot(...diagonal) / 2];
}

/**
 * Turn a camera around the point `pivot`: by `yaw` about `up` and by `pitch` about its own x axis (radians).
 * @param {Camera} camera
 * @param {Vector} pivot
 * @param {Vector} up
 * @param {number} yaw
 * @param {number} pitch
 * @returns {Camera}
 */
export function orbited(camera, pivot, up, yaw, pitch) {
  const axis = unit(up);
  const elevation = Math.asin(Math.max(-1, Math.min(1, dotProduct(row(camera.matrix, 2), axis))));
  const tilt = Math.max(-MAX_ELEVATION - elevation, Math.min(MAX_ELEVATION - elevation, pitch));
  const aside = turned(camera, pivot, axis, yaw);
  return turned(aside, pivot, row(aside.matrix, 0), tilt);
}

/**
 * Shift a camera's picture by pixels; returns the camera and the point to orbit about, shifted with the view.
 * @param {Camera} camera
 * @param {Vector} pivot
 * @param {number} dx
 * @param {number} dy
 * @returns {[Camera, Vector]}
 */
export function panned(camera, pivot, dx, dy) {
  const depth = inCamera(camera.matrix, pivot)[2];
  const shift = [(dx * depth) / camera.focal[0], (dy * depth) / camera.focal[1]];
  const matrix = camera.matrix.slice();
  matrix[3] += shift[0];
  matrix[7] += shift[1];
  const moved = difference(pivot, scaled(row(matrix, 0), shift[0]));
  return [{ ...camera, matrix }, difference(moved, scaled(row(matrix, 1), shift[1]))];
}

/**
 * Move a camera to `factor` times its distance from `pivot`.
 * @param {Camera} camera
 * @param {Vector} pivot
 * @param {number} factor
 * @returns {Camera}
 */
export function dollied(camera, pivot, factor) {
  const q = inCamera(camera.matrix, pivot);
  const kept = Math.max(factor, MIN_DISTANCE_M / Math.max(q[2], MIN_DISTANCE_M));
  const matrix = camera.matrix.slice();
  for (let k = 0; k < 3; k++) matrix[4 * k + 3] += (kept - 1) * q[k];
  return { ...camera, matrix };
}

/**
 * A direction turned with what faces the camera: `yaw` moves that to the right, `pitch` down (radians).
 * @param {Camera} camera
 * @param {Vector} direction
 * @param {number} yaw
 * @param {number} pitch
 * @returns {Vector}
 */
export function turnedAsSeen(camera, direction, yaw, pitch) {
  return rotatedAbout(rotatedAbout(direction, row(camera.matrix, 1), -yaw), row(camera.matrix, 0), pitch);
}

/**
 * Rotate about a world axis through `pivot`, which stays where it is in the picture.
 * @param {Camera} camera
 * @param {Vector} pivot
 * @param {Vector} axis
 * @param {number} angle
 * @returns {Camera}
 */
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

/**
 * @param {Vector} v
 * @param {Vector} axis
 * @param {number} angle
 * @returns {Vector}
 */
function rotatedAbout(v, axis, angle) {
  const [cosine, sine] = [Math.cos(angle), Math.sin(angle)];
  const side = crossed(axis, v);
  const along = dotProduct(axis, v) * (1 - cosine);
  const part = (/** @type {number} */ k) => v[k] * cosine + side[k] * sine + axis[k] * along;
  return [part(0), part(1), part(2)];
}

/**
 * @param {Float64Array} matrix
 * @param {number} k
 * @returns {Vector}
 */
function row(matrix, k) {
  return [matrix[4 * k], matrix[4 * k + 1], matrix[4 * k + 2]];
}

/**
 * @param {Float64Array} matrix
 * @param {Vector} point
 * @returns {Vector}
 */
function inCamera(matrix, point) {
  const part = (/** @type {number} */ k) => dotProduct(row(matrix, k), point) + matrix[4 * k + 3];
  return [part(0), part(1), part(2)];
}
