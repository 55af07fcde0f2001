// @ts-check
// Light that a head reflects onto itself. The rules are those of STGA for Blender's light/surface.py.

import { box } from './vector.js';

/** @import { Values } from './types.js' */

const CELL_M = 0.02;
const SKIN = [0.5, 0.33, 0.25];
const MIN_OPEN = 0.3; // share of the sky that a vertex must see to count as lit skin

export class Bounce {
  /**
   * Neutral vertices (3·V), triangles (3·F) with their areas, and the share of the sky that vertices see (V).
   * @param {Values} neutral
   * @param {Values} faces
   * @param {ArrayLike<number>} areas
   * @param {ArrayLike<number>} occlusion
   */
  constructor(neutral, faces, areas, occlusion) {
    this.occlusion = occlusion;
    this.weight = new Float64Array(occlusion.length);
    for (let c = 0; c < faces.length; c++) {
      if (occlusion[faces[c]] > MIN_OPEN) this.weight[faces[c]] += areas[Math.floor(c / 3)];
    }
    this.cell = new Int32Array(occlusion.length);
    this.cells = 0;
    /** Cells between neighbors along x, y and z; the outermost cells are empty. */
    this.strides = this.placeInCells(neutral);
    this.sumOfWeights = this.around(this.weight);
  }

  /** @param {Values} neutral */
  placeInCells(neutral) {
    const [low, high] = box(neutral);
    const place = (/** @type {number} */ value, /** @type {number} */ axis) =>
      Math.floor((value - low[axis]) / CELL_M) + 1;
    const [nx, ny, nz] = high.map((value, axis) => place(value, axis) + 2);
    for (let v = 0; v < this.cell.length; v++) {
      const [x, y, z] = [0, 1, 2].map((axis) => place(neutral[3 * v + axis], axis));
      this.cell[v] = (x * ny + y) * nz + z;
    }
    this.cells = nx * ny * nz;
    return [ny * nz, nz, 1];
  }

  /**
   * Sum of values (V) in each vertex's cell and the 26 around it.
   * @param {ArrayLike<number>} values
   */
  around(values) {
    const { cell } = this;
    let total = new Float64Array(this.cells);
    for (let v = 0; v < cell.length; v++) total[cell[v]] += values[v];
    for (const stride of this.strides) {
      const sum = new Float64Array(total.length);
      for (let k = stride; k < total.length - stride; k++) sum[k] = total[k - stride] + total[k] + total[k + stride];
      total = sum;
    }
    const found = new Float64Array(cell.length);
    for (let v = 0; v < cell.length; v++) found[v] = total[cell[v]];
    return found;
  }

  /**
   * Add the irradiance that vertices get from skin around them to `out`: of `arriving`, both three numbers a vertex.
   * @param {Float64Array} arriving
   * @param {Float64Array} out
   */
  add(arriving, out) {
    const { occlusion, weight, sumOfWeights } = this;
    const channel = new Float64Array(weight.length);
    for (let c = 0; c < 3; c++) {
      for (let v = 0; v < weight.length; v++) channel[v] = weight[v] * arriving[3 * v + c];
      const near = this.around(channel);
      for (let v = 0; v < weight.length; v++) {
        out[3 * v + c] += ((1 - occlusion[v]) * SKIN[c] * near[v]) / Math.max(sumOfWeights[v], 1e-12);
      }
    }
  }
}
