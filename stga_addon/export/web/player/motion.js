// @ts-check
// The recorded motion, and the values by which a person or a program replaces parts of it.

/** @import { Data } from './types.js' */

import { slerpAxisAngle } from './rotation.js';
import { Shapes } from './shapes.js';

/** Coefficients, pose and translation of any moment. A pinned value (not NaN) replaces the recorded one. */
export class Motion {
  /** @param {Data} data */
  constructor(data) {
    const { arrays } = data;
    this.recordedFrames = arrays.coefficients.shape[0];
    this.recordedFps = data.header.fps;
    this.shapes = new Shapes(data);
    this.recorded = arrays;
    const [shapes, joints] = [arrays.coefficients.shape[1], arrays.pose.shape[1]];
    this.coefficients = new Float64Array(shapes);
    this.pose = new Float64Array(3 * joints);
    this.translation = new Float64Array(3);
    this.pinnedCoefficients = new Float64Array(shapes).fill(NaN);
    this.pinnedPose = new Float64Array(3 * joints).fill(NaN);
  }

  /** Of the performance, where one plays instead of the recording. */
  get frames() {
    return this.shapes.performance?.rows.length ?? this.recordedFrames;
  }

  get fps() {
    return this.shapes.performance?.fps ?? this.recordedFps;
  }

  /**
   * Fill coefficients, pose and translation with those of `frame`, between frames on the shortest way. Of a performance,
   * the head as a whole stays where it is in the first recorded frame.
   * @param {number} frame
   */
  sample(frame) {
    const recorded = this.shapes.performance ? 0 : frame;
    const first = Math.min(Math.max(Math.floor(recorded), 0), this.recordedFrames - 1);
    const second = Math.min(first + 1, this.recordedFrames - 1);
    const share = Math.min(Math.max(recorded - first, 0), 1);
    blend(this.recorded.coefficients.values, first, second, share, this.coefficients);
    blend(this.recorded.translation.values, first, second, share, this.translation);
    this.turn(first, second, share);
    if (this.shapes.active) this.shapes.apply(frame, this.coefficients, this.pose);
    replacePinned(this.coefficients, this.pinnedCoefficients);
    replacePinned(this.pose, this.pinnedPose);
  }

  /**
   * @param {number} first
   * @param {number} second
   * @param {number} share
   */
  turn(first, second, share) {
    const [pose, size] = [this.recorded.pose.values, this.pose.length];
    for (let at = 0; at < size; at += 3) {
      const before = pose.subarray(first * size + at, first * size + at + 3);
      const after = pose.subarray(second * size + at, second * size + at + 3);
      this.pose.set(share > 0 ? slerpAxisAngle(before, after, share) : before, at);
    }
  }

  release() {
    this.pinnedCoefficients.fill(NaN);
    this.pinnedPose.fill(NaN);
    this.shapes.release();
  }
}

/**
 * @param {ArrayLike<number>} values
 * @param {number} first
 * @param {number} second
 * @param {number} share
 * @param {Float64Array} out
 */
function blend(values, first, second, share, out) {
  const size = out.length;
  for (let k = 0; k < size; k++) {
    const before = values[first * size + k];
    out[k] = before + share * (values[second * size + k] - before);
  }
}

/**
 * @param {Float64Array} values
 * @param {Float64Array} pinned
 */
function replacePinned(values, pinned) {
  for (let k = 0; k < values.length; k++) if (!Number.isNaN(pinned[k])) values[k] = pinned[k];
}
