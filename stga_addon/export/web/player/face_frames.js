// @ts-check
// Local frames of the triangles, in which splats are stored.
// The rules are those of STGA for Blender's embedding.py.

/** @import { Arrays, Values, Vector } from './types.js' */

import { SIGNALS } from './signals.js';
import { Strain } from './strain.js';
import { crossed, difference, dotProduct, scaled, unit } from './vector.js';

const MIN_DIVISOR = 1e-30;
const MIN_AREA_RATIO = 1e-4; // of a triangle that counts as a line, to its longest edge's square
const UPRIGHT_COSINE = 0.8;
export const FACE_FLOATS = 16; // of a triangle in the texture: three rows of matrix | origin, then strain | selected

export class FaceFrames {
  /**
   * Arrays of the data file, and the convention of the embedding; strain is computed where splats follow it.
   * @param {Pick<Arrays, 'faces' | 'neutral'> & Partial<Arrays>} arrays
   * @param {string} convention
   */
  constructor(arrays, convention) {
    const faces = arrays.faces.values;
    const neutral = arrays.neutral.values;
    this.faces = faces;
    this.count = faces.length / 3;
    this.isStga = convention === 'stga';
    this.world = new Float64Array(12 * this.count); // rotation · scale and origin, rows of a 3×4 matrix
    this.neutralArea = neutralAreas(faces, neutral);
    const offsets = Object.entries(SIGNALS).filter(([name]) => arrays[name]);
    const followsStrain = arrays.strain_color || offsets.length;
    const strain = followsStrain ? new Strain(faces, neutral, arrays.strain_range?.values) : null;
    this.strain = strain;
    /** Signals and their coefficients (3·S·F): for each of S components a vector in the frame. */
    this.offsets = strain
      ? offsets.map(([name, Signal]) => ({
          signal: new Signal(strain),
          components: Signal.components,
          coefficients: /** @type {Values} */ (arrays[name]?.values),
        }))
      : [];
  }

  /**
   * Follow the posed vertices (3·V).
   * @param {Float64Array} vertices
   */
  update(vertices) {
    this.placeFrames(vertices);
    this.strain?.update(vertices);
    for (const { signal, components, coefficients } of this.offsets) {
      signal.update();
      this.moveOrigins(signal.values, components, coefficients);
    }
  }

  /**
   * "stga": axes [first, normal × first, normal], first from the middle to corner 0; scale sqrt(area / neutral area).
   * "gaussian_avatars": axes [first, normal, first × normal], first along the first edge; scale the mean of edge and
   * height.
   * @param {Float64Array} vertices
   */
  placeFrames(vertices) {
    const { faces, isStga, neutralArea, world } = this;
    for (let f = 0; f < this.count; f++) {
      const i = 3 * faces[3 * f];
      const j = 3 * faces[3 * f + 1];
      const k = 3 * faces[3 * f + 2];
      // Edges u and v from corner 0, and their normal n, as long as twice the area.
      const ux = vertices[j] - vertices[i];
      const uy = vertices[j + 1] - vertices[i + 1];
      const uz = vertices[j + 2] - vertices[i + 2];
      const vx = vertices[k] - vertices[i];
      const vy = vertices[k + 1] - vertices[i + 1];
      const vz = vertices[k + 2] - vertices[i + 2];
      let nx = uy * vz - uz * vy;
      let ny = uz * vx - ux * vz;
      let nz = ux * vy - uy * vx;
      let x = isStga ? -(ux + vx) / 3 : ux;
      let y = isStga ? -(uy + vy) / 3 : uy;
      let z = isStga ? -(uz + vz) / 3 : uz;
      const twice = Math.sqrt(nx * nx + ny * ny + nz * nz);
      const length = Math.sqrt(x * x + y * y + z * z);
      const uu = ux * ux + uy * uy + uz * uz;
      const vv = vx * vx + vy * vy + vz * vz;
      const longest = Math.max(uu, vv, (vx - ux) * (vx - ux) + (vy - uy) * (vy - uy) + (vz - uz) * (vz - uz));
      const isShort = length <= MIN_AREA_RATIO * Math.sqrt(longest);
      const isLine = twice <= 2 * MIN_AREA_RATIO * longest;
      if (isShort || isLine) {
        [x, y, z, nx, ny, nz] = substitutes([x, y, z], [nx, ny, nz], isShort, isLine);
      } else {
        const perLength = 1 / length;
        const perTwice = 1 / twice;
        x *= perLength;
        y *= perLength;
        z *= perLength;
        nx *= perTwice;
        ny *= perTwice;
        nz *= perTwice;
      }
      let scale = 1;
      if (!isStga) scale = (length + (isShort ? Math.sqrt(vv) : twice / length)) / 2;
      else if (neutralArea[f] > 0) scale = Math.sqrt(twice / 2 / neutralArea[f]);
      x *= scale;
      y *= scale;
      z *= scale;
      const sx = ny * z - nz * y;
      const sy = nz * x - nx * z;
      const sz = nx * y - ny * x;
      const to = 12 * f;
      world[to] = x;
      world[to + 1] = isStga ? sx : scale * nx;
      world[to + 2] = isStga ? scale * nx : -sx;
      world[to + 3] = vertices[i] + (ux + vx) / 3;
      world[to + 4] = y;
      world[to + 5] = isStga ? sy : scale * ny;
      world[to + 6] = isStga ? scale * ny : -sy;
      world[to + 7] = vertices[i + 1] + (uy + vy) / 3;
      world[to + 8] = z;
      world[to + 9] = isStga ? sz : scale * nz;
      world[to + 10] = isStga ? scale * nz : -sz;
      world[to + 11] = vertices[i + 2] + (uz + vz) / 3;
    }
  }

  /**
   * Move the origins by a signal (S·F) times coefficients (3·S·F), in each triangle's own axes and unit.
   * @param {Float64Array} values
   * @param {number} components
   * @param {Values} coefficients
   */
  moveOrigins(values, components, coefficients) {
    const { count, world } = this;
    for (let f = 0; f < count; f++) {
      let x = 0;
      let y = 0;
      let z = 0;
      for (let k = components * f; k < components * (f + 1); k++) {
        x += values[k] * coefficients[3 * k];
        y += values[k] * coefficients[3 * k + 1];
        z += values[k] * coefficients[3 * k + 2];
      }
      for (let to = 12 * f; to < 12 * f + 12; to += 4) {
        world[to + 3] += world[to] * x + world[to + 1] * y + world[to + 2] * z;
      }
    }
  }

  /**
   * Write the frames as a camera (row-major 4×4 world to camera) sees them: FACE_FLOATS a triangle.
   * @param {ArrayLike<number>} camera
   * @param {Float32Array} out
   */
  compose(camera, out) {
    const { world, count } = this;
    for (let row = 0; row < 3; row++) {
      const a = camera[4 * row];
      const b = camera[4 * row + 1];
      const c = camera[4 * row + 2];
      const d = camera[4 * row + 3];
      for (let f = 0, from = 0, to = 4 * row; f < count; f++, from += 12, to += FACE_FLOATS) {
        out[to] = a * world[from] + b * world[from + 4] + c * world[from + 8];
        out[to + 1] = a * world[from + 1] + b * world[from + 5] + c * world[from + 9];
        out[to + 2] = a * world[from + 2] + b * world[from + 6] + c * world[from + 10];
        out[to + 3] = a * world[from + 3] + b * world[from + 7] + c * world[from + 11] + d;
      }
    }
  }

  /**
   * Write strain, for colors that follow it, and the triangles' selection flags (bits, or null: all selected).
   * @param {ArrayLike<number> | null} selection
   * @param {Float32Array} out
   */
  annotate(selection, out) {
    const strain = this.strain?.values;
    for (let f = 0; f < this.count; f++) {
      const to = FACE_FLOATS * f + 12;
      for (let k = 0; k < 3; k++) out[to + k] = strain ? strain[3 * f + k] : 0;
      out[to + 3] = selection ? (selection[f >> 3] >> (7 - (f & 7))) & 1 : 1;
    }
  }
}

/**
 * Areas of the triangles; 0 for those that count as lines.
 * @param {Values} faces
 * @param {Values} neutral
 */
function neutralAreas(faces, neutral) {
  const areas = new Float64Array(faces.length / 3);
  const corner = (/** @type {number} */ f, /** @type {number} */ k) =>
    neutral.subarray(3 * faces[3 * f + k], 3 * faces[3 * f + k] + 3);
  for (let f = 0; f < areas.length; f++) {
    const u = difference(corner(f, 1), corner(f, 0));
    const v = difference(corner(f, 2), corner(f, 0));
    const w = difference(corner(f, 2), corner(f, 1));
    const area = Math.hypot(...crossed(u, v)) / 2;
    const longest = Math.max(dotProduct(u, u), dotProduct(v, v), dotProduct(w, w));
    areas[f] = area > Math.max(MIN_AREA_RATIO * longest, MIN_DIVISOR) ? area : 0;
  }
  return areas;
}

/**
 * Perpendicular unit vectors first and normal (six numbers) of a triangle that is a line, or whose `first` has no length.
 * @param {Vector} first
 * @param {Vector} normal
 * @param {boolean} isShort
 * @param {boolean} isLine
 * @returns {number[]}
 */
function substitutes(first, normal, isShort, isLine) {
  const x = isShort ? [1, 0, 0] : unit(first);
  const isUpright = Math.abs(x[2]) > UPRIGHT_COSINE;
  const n = isLine ? crossed(x, isUpright ? [1, 0, 0] : [0, 0, 1]) : normal;
  return [...x, ...unit(difference(n, scaled(x, dotProduct(n, x))))];
}
