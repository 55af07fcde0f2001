// @ts-check
// Lighting as it is asked for, and as the player computes with it. Axes are those of the data file's meshes.

/** @import { Environment, Lighting, LitBy, Vector } from './types.js' */

import { HARMONICS, addLobe, evenLight, turnedVector } from './harmonics.js';
import { matrixFromAxisAngle } from './rotation.js';
import { crossed, scaled, unit } from './vector.js';

/**
 * Built-in environments, y up and the face towards z: even radiance, lobes of radiance that falls with the cosine, and a
 * sun of irradiance `color` that throws shadows.
 * @type {Record<string, Environment>}
 */
export const ENVIRONMENTS = {
  studio: {
    label: 'Soft studio',
    even: [0.22, 0.22, 0.23],
    lobes: [
      { toward: [-0.6, 0.5, 0.6], color: [1.05, 1.0, 0.94] },
      { toward: [0.7, 0.2, 0.6], color: [0.42, 0.44, 0.48] },
    ],
  },
  sky: {
    label: 'Open sky',
    even: [0.2, 0.25, 0.32],
    lobes: [
      { toward: [0.1, 1, 0.3], color: [0.75, 0.92, 1.15] },
      { toward: [0, -1, 0], color: [0.16, 0.13, 0.1] },
    ],
  },
  sunset: {
    label: 'Sunset',
    even: [0.09, 0.09, 0.14],
    lobes: [
      { toward: [0.9, 0.15, 0.2], color: [0.75, 0.34, 0.16] },
      { toward: [-0.5, 0.8, 0.2], color: [0.16, 0.2, 0.42] },
    ],
    sun: { toward: [0.85, 0.28, 0.45], color: [3.4, 1.75, 0.7] },
  },
};

/**
 * What the player computes with. Throws RangeError where the lighting is none (types.d.ts).
 * @param {Lighting} lighting
 * @param {Vector} up
 * @returns {LitBy}
 */
export function litBy(lighting, up) {
  const { even = [0, 0, 0], environment, turn = 0, harmonics, exposure = 0 } = lighting;
  check([...even, turn, exposure], 5, 'even, turn and exposure');
  const world = evenLight(even);
  const added = environment === undefined ? null : addEnvironment(world, environment, fromUpright(up, turn));
  if (harmonics) {
    check(harmonics, 3 * HARMONICS, 'harmonics');
    for (let k = 0; k < world.length; k++) world[k] += harmonics[k];
  }
  const sun = lighting.sun ?? added;
  if (sun) check([...sun.toward, ...sun.color], 6, 'sun');
  return { world, sun: sun && { toward: unit(sun.toward), color: [...sun.color] }, factor: 2 ** exposure };
}

/**
 * Add an environment whose axes a rotation takes to those of the head; returns its sun.
 * @param {Float64Array} world
 * @param {string} name
 * @param {ArrayLike<number>} rotation
 */
function addEnvironment(world, name, rotation) {
  if (!Object.hasOwn(ENVIRONMENTS, name)) throw new RangeError(`There is no environment "${name}".`);
  const { even, lobes, sun } = ENVIRONMENTS[name];
  evenLight(even).forEach((value, k) => (world[k] += value));
  for (const { toward, color } of lobes) addLobe(world, turnedVector(rotation, unit(toward)), color);
  return sun ? { toward: turnedVector(rotation, sun.toward), color: sun.color } : null;
}

/**
 * The rotation from axes in which y is up, turned about it by an angle, to those in which `up` is.
 * @param {Vector} up
 * @param {number} turn
 */
function fromUpright(up, turn) {
  const [tilt, spin] = [new Float64Array(9), new Float64Array(9)];
  matrixFromAxisAngle(scaled(unit(up), turn), 0, spin, 0);
  const axis = crossed([0, 1, 0], unit(up));
  const sine = Math.hypot(...axis);
  const angle = Math.atan2(sine, unit(up)[1]);
  matrixFromAxisAngle(sine > 1e-9 ? scaled(axis, angle / sine) : [angle, 0, 0], 0, tilt, 0);
  const columns = [0, 1, 2].map((k) => turnedVector(spin, [tilt[k], tilt[k + 3], tilt[k + 6]]));
  return [0, 1, 2].flatMap((row) => columns.map((column) => column[row]));
}

/**
 * @param {ArrayLike<number>} values
 * @param {number} count
 * @param {string} name
 */
function check(values, count, name) {
  if (values.length !== count || !Array.from(values).every(Number.isFinite)) {
    throw new RangeError(`Lighting: ${name} holds something else than finite numbers, or too few or too many.`);
  }
}
