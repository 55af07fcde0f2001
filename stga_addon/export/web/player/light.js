// @ts-check
// Distant light: as it is asked for, as the player computes with it, and how a head receives and
// reflects it. Axes are those of the data file's meshes; the rules are those of STGA for Blender's
// light/.

/** @import { Arrays, Data, DataArray, GL, LightOfCapture, Lighting, LitBy } from './types.js' */
/** @import { Sun, Uniforms, Values, Vector } from './types.js' */

import { bounds, rotatedAbout } from './camera.js';
import { CELL_M, COVERED_WEIGHT, GLOSSY, HAIR_ROUGHNESS, LAMBERT } from './constants.js';
import { LIFT_M, MAP_SIZE, MAX_CELLS, MIN_IRRADIANCE } from './constants.js';
import { MIN_OPEN, SKIN, UNLIKE_LIGHT } from './constants.js';
import { FaceFrames } from './face_frames.js';
import { bindTexture, deleteTarget, floatTexture, makeTarget, paddedLength } from './renderer.js';
import { program, updateTexture } from './renderer.js';
import { SURFACE_TEXELS, TEXTURE_WIDTH, VERTEX_TEXELS } from './shaders.js';
import { OVER_VERTEX_SHADER, SHADOW_FRAGMENT_SHADER, SHADOW_VERTEX_SHADER } from './shaders.js';
import { lightFragmentShader } from './shaders.js';
import { box, crossed, difference, dotProduct, scaled, unit, vector } from './vector.js';

// Built-in environments, y up and the face towards z: even radiance, lobes of radiance that falls
// with the cosine, and a sun of irradiance `color` that throws shadows.
/** @type {Record<string, { label: string, even: Vector, lobes: Sun[], sun?: Sun }>} */
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

// What the player computes with. Throws RangeError where the lighting is none (types.d.ts).
/** @type {(lighting: Lighting, up: Vector) => LitBy} */
export function litBy({ even = [0, 0, 0], environment, ...lighting }, up) {
  const { turn = 0, harmonics, exposure = 0 } = lighting;
  let sun = lighting.sun ?? null;
  check([...even, turn, exposure], 5, 'even, turn and exposure');
  const world = new Float64Array(3 * HARMONICS);
  let everywhere = even;
  if (environment !== undefined) {
    if (!Object.hasOwn(ENVIRONMENTS, environment))
      throw new RangeError(`There is no environment "${environment}".`);
    const { lobes, sun: own, ...found } = ENVIRONMENTS[environment];
    // From axes in which y is up to those in which `up` is, and about it.
    const top = unit(up);
    const axis = crossed([0, 1, 0], top);
    const sine = Math.hypot(...axis);
    const about = sine > 1e-9 ? scaled(axis, 1 / sine) : vector(k => Number(k === 0));
    const turned = (/** @type {Vector} */ v) =>
      rotatedAbout(rotatedAbout(v, about, Math.atan2(sine, top[1])), top, turn);
    everywhere = vector(k => even[k] + found.even[k]);
    for (const { toward, color } of lobes) addPoint(world, turned(unit(toward)), color, LAMBERT);
    if (own) sun ??= { toward: turned(own.toward), color: own.color };
  }
  if (harmonics) {
    check(harmonics, 3 * HARMONICS, 'harmonics');
    for (let k = 0; k < world.length; k++) world[k] += harmonics[k];
  }
  for (let c = 0; c < 3; c++) world[c] += everywhere[c] / DEGREE_0;
  if (sun) check([...sun.toward, ...sun.color], 6, 'sun');
  sun = sun && { toward: unit(sun.toward), color: sun.color };
  return { world, sun, factor: 2 ** exposure };
}

/** @type {(values: number[], count: number, name: string) => void} */
function check(values, count, name) {
  const problem = 'holds something else than finite numbers, or too few or too many';
  if (values.length !== count || !values.every(Number.isFinite))
    throw new RangeError(`Lighting: ${name} ${problem}.`);
}

// Spherical harmonics of degree 2, in which distant light is kept: nine coefficients of red, green
// and blue each.

const HARMONICS = 9;
const DEGREE_0 = 0.28209479177387814;
const DEGREE_1 = 0.4886025119029199;
const DEGREE_2 = 1.0925484305920792; // xy, yz, xz; half of it: x² − y²
const UPRIGHT = 0.31539156525252005; // 3z² − 1

// Basis functions of a unit vector, orthonormal on the sphere: 1, y, z, x, xy, yz, 3z² − 1, xz, x²
// − y².
/** @param {Vector} direction */
function harmonicsOf([x, y, z]) {
  const linear = [DEGREE_0, DEGREE_1 * y, DEGREE_1 * z, DEGREE_1 * x];
  const [xy, yz, xz, sides] = [x * y, y * z, x * z, (x * x - y * y) / 2].map(v => DEGREE_2 * v);
  return [...linear, xy, yz, UPRIGHT * (3 * z * z - 1), xz, sides];
}

// Add light of an irradiance from one direction; LAMBERT as `lobe`: radiance that falls with
// the cosine around it.
/** @type {(light: Float64Array, toward: Vector, color: Vector, lobe?: number[]) => void} */
function addPoint(light, toward, color, lobe) {
  harmonicsOf(toward).forEach((value, k) => {
    for (let c = 0; c < 3; c++) light[3 * k + c] += (lobe?.[k] ?? 1) * value * color[c];
  });
}

// An icosahedron's corners, over which sums of degrees up to 5 are integrals over the sphere.
const GOLDEN = (1 + Math.sqrt(5)) / 2;
const CORNERS = [-1, 1].flatMap(one =>
  [-GOLDEN, GOLDEN].flatMap(other =>
    [0, 1, 2].map(axis => unit(vector(k => [0, one, other][(k + axis) % 3]))),
  ),
);

// The same light in other axes: the rotation (3×3, row by row) takes old coordinates to new ones.
/** @type {(light: ArrayLike<number>, rotation: number[]) => Float64Array<ArrayBuffer>} */
function rotatedLight(light, rotation) {
  const turned = new Float64Array(3 * HARMONICS);
  for (const corner of CORNERS) {
    const column = (/** @type {number} */ k) => [rotation[k], rotation[k + 3], rotation[k + 6]];
    const values = harmonicsOf(vector(k => dotProduct(column(k), corner)));
    const radiance = vector(c =>
      values.reduce((sum, value, k) => sum + value * light[3 * k + c], 0),
    );
    addPoint(turned, corner, scaled(radiance, (4 * Math.PI) / CORNERS.length));
  }
  return turned;
}

// What arrives at a head, and how much of its recorded colors that keeps

// The rotation (3×3, row by row) that best takes vertices to those of the neutral mesh (both 3·V),
// by `arms`, the latter's weighted places about their mean: the orthogonal factor of the covariance
// (Higham's iteration).
/** @type {(arms: Values, vertices: ArrayLike<number>) => number[]} */
function rigidRotation(arms, vertices) {
  const covariance = Array(9).fill(0);
  for (let at = 0; at < arms.length; at += 3) {
    for (let k = 0; k < 9; k++)
      covariance[k] += arms[at + Math.floor(k / 3)] * vertices[at + (k % 3)];
  }
  const norm = Math.hypot(...covariance) || 1;
  let m = covariance.map(value => value / norm);
  for (let k = 0; k < 30; k++) {
    const [r0, r1, r2] = [m.slice(0, 3), m.slice(3, 6), m.slice(6, 9)];
    const cofactors = [crossed(r1, r2), crossed(r2, r0), crossed(r0, r1)].flat();
    const determinant = dotProduct(r0, cofactors);
    // A mesh without an extent.
    if (!(Math.abs(determinant) > 1e-300)) return [1, 0, 0, 0, 1, 0, 0, 0, 1];
    const next = m.map((value, at) => (value + cofactors[at] / determinant) / 2);
    const change = next.reduce((most, value, at) => Math.max(most, Math.abs(value - m[at])), 0);
    m = next;
    if (change < 1e-12) break;
  }
  return m;
}

// Neutral vertices (3·V) about their mean, times weights (V), for `rigidRotation`.
/** @type {(neutral: Values, weights: ArrayLike<number>) => Float64Array} */
function weightedArms(neutral, weights) {
  const sums = [0, 0, 0, 0];
  for (let v = 0; v < weights.length; v++) {
    for (let c = 0; c < 3; c++) sums[c] += weights[v] * neutral[3 * v + c];
    sums[3] += weights[v];
  }
  const arm = (/** @type {number} */ place, /** @type {number} */ k) =>
    weights[Math.floor(k / 3)] * (place - sums[k % 3] / sums[3]);
  return Float64Array.from(neutral, arm);
}

// Irradiance (3·V) of light (harmonics in the head's axes) past the head itself.
/** @param {Values} transfer (9·V) @param {Float64Array} light */
function received(transfer, light) {
  const found = new Float64Array(transfer.length / 3);
  for (let v = 0; 9 * v < transfer.length; v++) {
    for (let c = 0; c < 3; c++) {
      let sum = 0;
      for (let k = 0; k < HARMONICS; k++) sum += transfer[9 * v + k] * light[3 * k + c];
      found[3 * v + c] = Math.max(sum, 0);
    }
  }
  return found;
}

// What adds the irradiance that vertices get from skin around them to `out`, by what arrives at
// them (both three numbers a vertex). Neutral vertices (3·V); triangles (3·F) with their areas;
// share of the sky that vertices see (V).
/** @type {(...arrays: Values[]) => (arriving: Float64Array, out: Float64Array) => void} */
function bounceOf(neutral, faces, areas, occlusion) {
  const vertices = occlusion.length;
  const weight = new Float64Array(vertices);
  for (let c = 0; c < faces.length; c++) {
    if (occlusion[faces[c]] > MIN_OPEN) weight[faces[c]] += areas[Math.floor(c / 3)];
  }
  const [low, high] = box(neutral);
  const side = Math.max(CELL_M, Math.max(...difference(high, low)) / MAX_CELLS);
  const place = (/** @type {number} */ value, /** @type {number} */ axis) =>
    Math.floor((value - low[axis]) / side) + 1;
  const [nx, ny, nz] = high.map((value, axis) => place(value, axis) + 2);
  const strides = [ny * nz, nz, 1]; // to the next cell along x, y, z; the outermost are empty
  const cell = Int32Array.from(occlusion, (_, v) => {
    const places = vector(axis => place(neutral[3 * v + axis], axis));
    return dotProduct(places, strides);
  });
  // Sum of values (V) in each vertex's cell and the 26 around it.
  const around = (/** @type {Float64Array} */ values) => {
    let total = new Float64Array(nx * ny * nz);
    for (let v = 0; v < vertices; v++) total[cell[v]] += values[v];
    for (const stride of strides) {
      const sum = new Float64Array(total.length);
      for (let k = stride; k < total.length - stride; k++)
        sum[k] = total[k - stride] + total[k] + total[k + stride];
      total = sum;
    }
    const found = new Float64Array(vertices);
    for (let v = 0; v < vertices; v++) found[v] = total[cell[v]];
    return found;
  };
  const sumOfWeights = around(weight);
  const channel = new Float64Array(vertices);
  return (arriving, out) => {
    for (let c = 0; c < 3; c++) {
      for (let v = 0; v < vertices; v++) channel[v] = weight[v] * arriving[3 * v + c];
      const near = around(channel);
      for (let v = 0; v < vertices; v++) {
        const mean = near[v] / Math.max(sumOfWeights[v], 1e-12);
        out[3 * v + c] += (1 - occlusion[v]) * SKIN[c] * mean;
      }
    }
  };
}

// Gain of red, green and blue, and share, by the light of the capture and the one that is shown (27
// harmonics each, in the same axes; lamps as if they were far away).
/** @type {(recorded: ArrayLike<number>, shown: ArrayLike<number>) => number[]} */
function keptColors(recorded, shown) {
  const weight = (/** @type {number} */ k) => LAMBERT[Math.floor(k / 3)] ** 2;
  const [product, square] = [new Float64Array(3), new Float64Array(3).fill(1e-12)];
  for (let k = 0; k < 3 * HARMONICS; k++) {
    product[k % 3] += weight(k) * recorded[k] * shown[k];
    square[k % 3] += weight(k) * recorded[k] ** 2;
  }
  const gain = vector(c => Math.max(0, product[c] / square[c]));
  let [off, whole] = [0, 1e-24];
  for (let k = 0; k < 3 * HARMONICS; k++) {
    const same = gain[k % 3] * recorded[k];
    off += weight(k) * (shown[k] - same) ** 2;
    whole += weight(k) * same ** 2;
  }
  const step = Math.min(1, Math.sqrt(off / whole) / UNLIKE_LIGHT);
  return [...gain, 1 - step * step * (3 - 2 * step)];
}

// Colors of the splats under the light of a scene: a texel a splat, computed again where pose,
// light or eye have changed. What depends on the avatar alone is in the data file.

export class LightPass {
  // For data of an avatar whose light is known.
  /** @param {GL} gl @param {Data} data */
  constructor(gl, { arrays, header }) {
    this.gl = gl;
    const light = (/** @type {string} */ name) => arrays[`light_${name}`].values;
    this.faces = arrays.faces.values;
    this.transfer = light('transfer');
    const neutral = arrays.neutral.values;
    const weights = Float64Array.from(light('occlusion'), open => open + COVERED_WEIGHT);
    this.arms = weightedArms(neutral, weights);
    this.count = arrays.xyz.shape[0];
    const framesOf = (/** @type {DataArray} */ faces) =>
      new FaceFrames({ faces, neutral: arrays.neutral }, header.convention);
    const frames = framesOf(arrays.faces);
    this.addBounce = bounceOf(neutral, this.faces, frames.area, light('occlusion'));
    this.surfaceTexture = floatTexture(gl, gl.RGBA32F, surfaceTexels(arrays, frames));
    this.lashCorners = light('lash_corners');
    this.lashes = light('lash_face').length;
    const corners = (/** @type {number} */ face) => this.faces.subarray(3 * face, 3 * face + 3);
    const lashFaces = Array.from(light('lash_face')).flatMap(face => [...corners(face)]);
    this.lashFrames = framesOf({ shape: [this.lashes, 3], values: Int32Array.from(lashFaces) });
    const vertices = neutral.length / 3;
    const texels = (vertices + 4 * this.lashes) * VERTEX_TEXELS;
    this.vertexValues = new Float32Array(paddedLength(texels));
    this.vertexTexture = floatTexture(gl, gl.RGBA32F, this.vertexValues);
    const card = (/** @type {number} */ k) => 4 * Math.floor(k / 6) + [0, 1, 2, 0, 2, 3][k % 6];
    const cards = Array.from({ length: 6 * this.lashes }, (_, k) => vertices + card(k));
    this.casters = Uint32Array.from([...this.faces, ...cards]);
    this.shadows = makeTarget(gl, gl.DEPTH_COMPONENT32F, MAP_SIZE, MAP_SIZE, gl.DEPTH_ATTACHMENT);
    this.vertexArray = gl.createVertexArray();
    this.indexBuffer = gl.createBuffer();
    gl.bindVertexArray(this.vertexArray);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.indexBuffer);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, this.casters, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    const rows = Math.ceil(this.count / TEXTURE_WIDTH) || 1;
    this.colors = makeTarget(gl, gl.RGBA32F, TEXTURE_WIDTH, rows);
    this.program = program(gl, OVER_VERTEX_SHADER, lightFragmentShader(arrays));
    this.shadowProgram = program(gl, SHADOW_VERTEX_SHADER, SHADOW_FRAGMENT_SHADER);
    const { damping, recorded, typical } = /** @type {LightOfCapture} */ (header.light);
    this.recorded = recorded;
    this.typical = [...typical, damping];
    this.light = litBy({}, header.up);
    this.kept = [0, 0, 0, 0]; // gain of red, green and blue, share
    this.view = sunView(neutral, [0, 1, 0]);
  }

  // Follow the posed vertices (3·V), the sides of their triangles (`FaceFrames`) and the light.
  /** @type {(vertices: Float64Array, sides: Float64Array, light: LitBy) => void} */
  update(vertices, sides, light) {
    const { gl } = this;
    this.light = light;
    this.packVertices(vertices, sides, light);
    updateTexture(gl, this.vertexTexture, this.vertexValues);
    if (!light.sun) return;
    this.view = sunView(vertices, light.sun.toward);
    const { program, uniforms } = this.shadowProgram;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadows.framebuffer);
    gl.viewport(0, 0, MAP_SIZE, MAP_SIZE);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.useProgram(program);
    bindTexture(gl, 0, this.vertexTexture, uniforms.uVertices);
    this.setSun(uniforms);
    gl.bindVertexArray(this.vertexArray);
    gl.drawElements(gl.TRIANGLES, this.casters.length, gl.UNSIGNED_INT, 0);
    gl.disable(gl.DEPTH_TEST);
  }

  /** @type {(vertices: Float64Array, sides: Float64Array, light: LitBy) => void} */
  packVertices(vertices, sides, { world, sun }) {
    const normals = vertexNormals(this.faces, sides, vertices.length);
    const rotation = rigidRotation(this.arms, vertices);
    const around = Float64Array.from(world);
    if (sun) addPoint(around, sun.toward, sun.color);
    const arriving = received(this.transfer, rotatedLight(world, rotation));
    const distant = rotatedLight(around, rotation);
    this.kept = keptColors(this.recorded, distant);
    this.addBounce(received(this.transfer, distant), arriving);
    for (let from = 0, to = 0; from < vertices.length; from += 3, to += 4 * VERTEX_TEXELS) {
      for (let k = 0; k < 3; k++) {
        this.vertexValues[to + k] = vertices[from + k];
        this.vertexValues[to + 4 + k] = normals[from + k];
        this.vertexValues[to + 8 + k] = arriving[from + k];
      }
    }
    if (!sun) return;
    this.lashFrames.placeFrames(vertices);
    for (let corner = 0; corner < 4 * this.lashes; corner++) {
      const point = placed(this.lashFrames.world, corner >> 2, this.lashCorners, corner);
      this.vertexValues.set(point, (vertices.length / 3 + corner) * 4 * VERTEX_TEXELS);
    }
  }

  /** @param {Uniforms} uniforms */
  setSun(uniforms) {
    this.gl.uniformMatrix3fv(uniforms.uToSun, true, this.view.axes);
    this.gl.uniform3f(uniforms.uMiddle, ...this.view.middle);
    this.gl.uniform1f(uniforms.uRadius, this.view.radius);
  }

  // Compute the colors seen from a camera (world to camera, row-major); returns their texture.
  // Textures: the renderer's splats, tail and frames. Another framebuffer and viewport stay bound.
  /** @type {(camera: Float64Array, textures: WebGLTexture[]) => WebGLTexture} */
  draw(camera, textures) {
    const { gl, colors, view, light } = this;
    const { program, uniforms } = this.program;
    gl.bindFramebuffer(gl.FRAMEBUFFER, colors.framebuffer);
    gl.viewport(0, 0, colors.width, colors.height);
    gl.useProgram(program);
    const names = ['uSplats', 'uTail', 'uFaces', 'uSurface', 'uVertices', 'uShadows'];
    const own = [this.surfaceTexture, this.vertexTexture, this.shadows.texture];
    for (const [unit, bound] of [...textures, ...own].entries())
      bindTexture(gl, unit, bound, uniforms[names[unit]]);
    this.setSun(uniforms);
    gl.uniform1f(uniforms.uTexel, view.texel);
    const world = light.world.map((value, k) => GLOSSY[Math.floor(k / 3)] * value);
    gl.uniform3fv(uniforms['uWorld[0]'], world);
    gl.uniform3f(uniforms.uSunColor, ...(light.sun?.color ?? [0, 0, 0]));
    gl.uniform1f(uniforms.uFactor, light.factor);
    gl.uniform4fv(uniforms.uKept, this.kept);
    gl.uniform4fv(uniforms.uTypical, this.typical);
    const at = [-camera[3], -camera[7], -camera[11]];
    const eye = vector(k => dotProduct([camera[k], camera[4 + k], camera[8 + k]], at));
    gl.uniform3f(uniforms.uEye, ...eye);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    return colors.texture;
  }

  dispose() {
    const { gl, surfaceTexture, vertexTexture, colors, shadows } = this;
    for (const texture of [surfaceTexture, vertexTexture]) gl.deleteTexture(texture);
    gl.deleteBuffer(this.indexBuffer);
    gl.deleteVertexArray(this.vertexArray);
    for (const { program } of [this.program, this.shadowProgram]) gl.deleteProgram(program);
    for (const target of [colors, shadows]) deleteTarget(gl, target);
  }
}

// How a sun sees the head: rows across, up and along its rays; the middle and radius of what it
// sees, and the width of a texel of its shadow map, in meters.
/** @param {ArrayLike<number>} vertices @param {Vector} toward */
function sunView(vertices, toward) {
  const [middle, half] = bounds(vertices);
  let square = 0;
  for (let v = 0; v < vertices.length; v += 3) {
    const x = vertices[v] - middle[0];
    const y = vertices[v + 1] - middle[1];
    const z = vertices[v + 2] - middle[2];
    square = Math.max(square, x * x + y * y + z * z);
  }
  const forward = scaled(toward, -1);
  const across = unit(crossed(forward, Math.abs(forward[1]) < 0.9 ? [0, 1, 0] : [1, 0, 0]));
  const axes = [...across, ...crossed(forward, across), ...forward];
  const radius = Math.sqrt(square) * 1.01 + 4 * LIFT_M;
  return { middle, radius, texel: (2 * half) / MAP_SIZE, axes };
}

// Where the splats are on the neutral mesh, and what that receives: normal, roughness (0: skin) |
// irradiance of the capture, occlusion | corners of the triangle | their weights.
/** @param {Arrays} arrays @param {FaceFrames} frames of the neutral mesh */
function surfaceTexels(arrays, frames) {
  const { faces, neutral, splats_per_face, xyz } = arrays;
  const names = ['face', 'irradiance', 'occlusion', 'roughness'];
  const light = names.map(name => arrays[`light_${name}`].values);
  const [face, irradiance, occlusion, roughness] = light;
  const normals = vertexNormals(faces.values, frames.sides, neutral.values.length);
  const least = [0, 0, 0];
  for (let k = 0; k < irradiance.length; k++)
    least[k % 3] += (MIN_IRRADIANCE * 3 * irradiance[k]) / irradiance.length;
  const values = new Float32Array(paddedLength(xyz.shape[0] * SURFACE_TEXELS));
  for (let own = 0, splat = 0; own < splats_per_face.values.length; own++) {
    for (const end = splat + splats_per_face.values[own]; splat < end; splat++) {
      const from = 3 * ((own + face[splat]) % faces.shape[0]);
      const corners = Array.from(faces.values.subarray(from, from + 3));
      const places = corners.map(vertex => neutral.values.subarray(3 * vertex, 3 * vertex + 3));
      const weights = nearestWeights(places, placed(frames.world, own, xyz.values, splat));
      const to = 4 * SURFACE_TEXELS * splat;
      for (let k = 0; k < 3; k++) {
        const [vertex, weight] = [corners[k], weights[k]];
        for (let channel = 0; channel < 3; channel++) {
          values[to + channel] += weight * normals[3 * vertex + channel];
          values[to + 4 + channel] += weight * irradiance[3 * vertex + channel];
        }
        values[to + 3] += weight * roughness[vertex];
        values[to + 7] += weight * occlusion[vertex];
        values[to + 8 + k] = vertex;
        values[to + 12 + k] = weight;
      }
      for (let k = 0; k < 3; k++) values[to + 4 + k] = Math.max(values[to + 4 + k], least[k]);
      // between hair and skin, the nearer counts
      if (corners.some(vertex => roughness[vertex] > HAIR_ROUGHNESS / 2))
        values[to + 3] = values[to + 3] > HAIR_ROUGHNESS / 2 ? HAIR_ROUGHNESS : 0;
    }
  }
  return values;
}

// A point (its number among xyz, in a triangle's frame) in space.
/** @type {(world: Float64Array, face: number, xyz: Values, point: number) => Vector} */
function placed(world, face, xyz, point) {
  const [x, y, z] = xyz.subarray(3 * point, 3 * point + 3);
  return vector(row => {
    const at = 12 * face + 4 * row;
    return world[at] * x + world[at + 1] * y + world[at + 2] * z + world[at + 3];
  });
}

// Barycentric coordinates of a point in the plane of a triangle, clamped to it.
/** @type {(corners: Values[], point: Vector) => number[]} */
function nearestWeights([a, b, c], point) {
  const [first, second, offset] = [difference(b, a), difference(c, a), difference(point, a)];
  const [uu, uv, pu] = [first, second, offset].map(each => dotProduct(each, first));
  const [vv, pv] = [dotProduct(second, second), dotProduct(offset, second)];
  const area = Math.max(uu * vv - uv * uv, 1e-30);
  const [u, v] = [(vv * pu - uv * pv) / area, (uu * pv - uv * pu) / area];
  const clamped = [1 - u - v, u, v].map(weight => Math.max(0, Math.min(1, weight)));
  return clamped.map(weight => weight / (clamped[0] + clamped[1] + clamped[2]));
}

// Unit normals (3·V) weighted by the area of triangles, by their sides; 0 where there are none.
/** @type {(faces: Values, sides: Float64Array, size: number) => Float64Array<ArrayBuffer>} */
function vertexNormals(faces, sides, size) {
  const normals = new Float64Array(size);
  for (let c = 0; c < faces.length; c++) {
    const from = 9 * Math.floor(c / 3) + 6;
    for (let k = 0; k < 3; k++) normals[3 * faces[c] + k] += sides[from + k];
  }
  for (let at = 0; at < size; at += 3) {
    const length = Math.hypot(normals[at], normals[at + 1], normals[at + 2]);
    for (let k = at; k < at + 3; k++) normals[k] /= Math.max(length, 1e-20);
  }
  return normals;
}
