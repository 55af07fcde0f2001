// @ts-check
// Order of the splats from back to front: a radix sort of their depths in 22 bits.

import { FACE_FLOATS } from './face_frames.js';

const DIGIT_BITS = 11; // of which a key has two
const DIGITS = 1 << DIGIT_BITS;
const MAX_KEY = DIGITS * DIGITS - 1;

export class DepthSort {
  /**
   * xyz (3·N) of splats sorted by triangle, and how many each triangle has.
   * @param {ArrayLike<number>} xyz
   * @param {ArrayLike<number>} splatsPerFace
   */
  constructor(xyz, splatsPerFace) {
    this.xyz = xyz;
    this.splatsPerFace = splatsPerFace;
    const count = xyz.length / 3;
    this.depth = new Float32Array(count);
    this.key = new Int32Array(count);
    this.byLow = new Int32Array(count);
    this.order = new Uint32Array(count);
    this.low = new Int32Array(DIGITS); // number of each digit, then where it begins
    this.high = new Int32Array(DIGITS);
  }

  /**
   * Indices of the splats, farthest first; `frames` as FaceFrames.compose writes them.
   * @param {ArrayLike<number>} frames
   */
  sort(frames) {
    const { byLow, depth, high, key, low, order } = this;
    const [near, far] = measureDepth(frames, this.xyz, this.splatsPerFace, depth);
    makeKeys(depth, near, far, key);
    countDigits(key, low, high);
    for (let i = 0; i < key.length; i++) byLow[low[key[i] & (DIGITS - 1)]++] = i;
    for (let n = 0; n < key.length; n++) order[high[key[byLow[n]] >> DIGIT_BITS]++] = byLow[n];
    return order;
  }
}

/**
 * Fill `depth`; returns the nearest in front of the camera, and the farthest.
 * @param {ArrayLike<number>} frames
 * @param {ArrayLike<number>} xyz
 * @param {ArrayLike<number>} splatsPerFace
 * @param {Float32Array} depth
 * @returns {[number, number]}
 */
function measureDepth(frames, xyz, splatsPerFace, depth) {
  let near = Infinity;
  let far = 0;
  for (let f = 0, i = 0; f < splatsPerFace.length; f++) {
    const at = FACE_FLOATS * f + 8;
    const a = frames[at];
    const b = frames[at + 1];
    const c = frames[at + 2];
    const d = frames[at + 3];
    for (const end = i + splatsPerFace[f]; i < end; i++) {
      const z = a * xyz[3 * i] + b * xyz[3 * i + 1] + c * xyz[3 * i + 2] + d;
      depth[i] = z;
      if (z < near && z > 0) near = z;
      if (z > far) far = z;
    }
  }
  return [Math.min(near, far), far];
}

/**
 * Whole numbers that grow from 0, for the farthest, to MAX_KEY, for the nearest and those behind the camera.
 * @param {Float32Array} depth
 * @param {number} near
 * @param {number} far
 * @param {Int32Array} key
 */
function makeKeys(depth, near, far, key) {
  const scale = MAX_KEY / (far - near || 1);
  for (let i = 0; i < depth.length; i++) {
    const steps = (far - depth[i]) * scale; // below 0 by the rounding of the farthest depth
    key[i] = steps < MAX_KEY ? Math.max(steps, 0) : MAX_KEY;
  }
}

/**
 * Where the splats of each digit begin in their order.
 * @param {Int32Array} key
 * @param {Int32Array} low
 * @param {Int32Array} high
 */
function countDigits(key, low, high) {
  low.fill(0);
  high.fill(0);
  for (let i = 0; i < key.length; i++) {
    low[key[i] & (DIGITS - 1)]++;
    high[key[i] >> DIGIT_BITS]++;
  }
  for (const counts of [low, high]) {
    for (let digit = 0, begin = 0; digit < DIGITS; digit++) {
      const count = counts[digit];
      counts[digit] = begin;
      begin += count;
    }
  }
}
