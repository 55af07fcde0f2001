// @ts-check
// Colors of the splats under the light of a scene: a texel a splat, computed again where pose,
// light or eye have changed. What depends on the avatar alone is in the data file (STGA for
// Blender's light/surface.py and light/relight.py).

/** @import { Arrays, Data, LitBy, Program, Target, Values, Vector } from './types.js' */

import { bounds } from './camera.js';
import { FaceFrames } from './face_frames.js';
import {
  bindTexture,
  deleteTarget,
  floatTexture,
  makeTarget,
  paddedLength,
  program,
  updateTexture,
} from './renderer.js';
import {
  Bounce,
  HARMONICS,
  addPoint,
  keptColors,
  received,
  rigidRotation,
  rotatedLight,
} from './light.js';
import {
  LIFT_M,
  MAP_SIZE,
  OVER_VERTEX_SHADER,
  SHADOW_FRAGMENT_SHADER,
  SHADOW_VERTEX_SHADER,
  SURFACE_TEXELS,
  TEXTURE_WIDTH,
  VERTEX_TEXELS,
  lightFragmentShader,
} from './shaders.js';
import { crossed, difference, dotProduct, scaled, unit } from './vector.js';

// Of each harmonic in the mean radiance around the direction that skin mirrors (light/harmonics.py,
// GLOSSY).
const GLOSSY = [1, 0.85, 0.85, 0.85, 0.62, 0.62, 0.62, 0.62, 0.62];
const MIN_RIGID = 1e-3; // weight of covered vertices where the turn of the head is found
const MIN_IRRADIANCE = 0.15; // of the capture, as a share of its mean

export class LightPass {
  // For data of an avatar whose light is known.
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {Data} data
   */
  constructor(gl, data) {
    this.gl = gl;
    const { arrays, header } = data;
    const { convention } = header;
    const light = (/** @type {string} */ name) =>
      /** @type {Values} */ (arrays[`light_${name}`]?.values);
    this.faces = arrays.faces.values;
    this.neutral = arrays.neutral.values;
    this.transfer = light('transfer');
    this.rigid = Float64Array.from(light('occlusion'), share => share + MIN_RIGID);
    this.count = arrays.xyz.shape[0];
    const frames = new FaceFrames({ faces: arrays.faces, neutral: arrays.neutral }, convention);
    frames.placeFrames(Float64Array.from(this.neutral));
    this.bounce = new Bounce(this.neutral, this.faces, frames.neutralArea, light('occlusion'));
    this.surfaceTexture = floatTexture(gl, gl.RGBA32F, surfaceTexels(arrays, frames));
    this.lashCorners = light('lash_corners');
    this.lashes = light('lash_face').length;
    this.lashFrames = new FaceFrames(
      { faces: lashFaces(arrays), neutral: arrays.neutral },
      convention,
    );
    const vertices = this.neutral.length / 3;
    this.vertexValues = new Float32Array(
      paddedLength((vertices + 4 * this.lashes) * VERTEX_TEXELS),
    );
    this.vertexTexture = floatTexture(gl, gl.RGBA32F, this.vertexValues);
    const cards = Array.from(
      { length: 6 * this.lashes },
      (_, k) => 4 * Math.floor(k / 6) + [0, 1, 2, 0, 2, 3][k % 6],
    );
    this.casters = Uint32Array.from([...this.faces, ...cards.map(corner => vertices + corner)]);
    this.shadows = makeTarget(gl, gl.DEPTH_COMPONENT32F, MAP_SIZE, MAP_SIZE, gl.DEPTH_ATTACHMENT);
    this.vertexArray = gl.createVertexArray();
    this.indexBuffer = gl.createBuffer();
    gl.bindVertexArray(this.vertexArray);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.indexBuffer);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, this.casters, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.colors = makeTarget(
      gl,
      gl.RGBA32F,
      TEXTURE_WIDTH,
      Math.ceil(this.count / TEXTURE_WIDTH) || 1,
    );
    const harmonics = arrays.sh ? arrays.sh.shape[1] / 3 : 0;
    this.program = program(
      gl,
      OVER_VERTEX_SHADER,
      lightFragmentShader(harmonics, arrays.strain_color ? 3 : 0),
    );
    this.shadowProgram = program(gl, SHADOW_VERTEX_SHADER, SHADOW_FRAGMENT_SHADER);
    const { damping, recorded, typical } = header.light ?? {
      damping: 0,
      recorded: [],
      typical: [1, 1, 1],
    };
    this.recorded = recorded;
    this.typical = [...typical, damping];
    /** @type {LitBy | null} */
    this.light = null;
    this.kept = [0, 0, 0, 0]; // gain of red, green and blue, share
    this.view = sunView(this.neutral, [0, 1, 0]);
  }

  // Follow the posed vertices (3·V) and the light.
  /** @type {(vertices: Float64Array, sides: Float64Array, light: LitBy) => void} */
  update(vertices, sides, light) {
    const { gl } = this;
    this.light = light;
    this.packVertices(vertices, sides, light);
    updateTexture(gl, this.vertexTexture, this.vertexValues);
    if (!light.sun) return;
    this.view = sunView(vertices, light.sun.toward);
    this.drawShadows();
  }

  /** @type {(vertices: Float64Array, sides: Float64Array, light: LitBy) => void} */
  packVertices(vertices, sides, { world, sun }) {
    const normals = vertexNormals(this.faces, sides, vertices.length);
    const rotation = rigidRotation(vertices, this.neutral, this.rigid);
    const around = Float64Array.from(world);
    if (sun) addPoint(around, sun.toward, sun.color);
    const arriving = received(this.transfer, rotatedLight(world, rotation));
    const distant = rotatedLight(around, rotation);
    this.kept = keptColors(this.recorded, distant);
    this.bounce.add(received(this.transfer, distant), arriving);
    for (let from = 0, to = 0; from < vertices.length; from += 3, to += 4 * VERTEX_TEXELS) {
      for (let k = 0; k < 3; k++) {
        this.vertexValues[to + k] = vertices[from + k];
        this.vertexValues[to + 4 + k] = normals[from + k];
        this.vertexValues[to + 8 + k] = arriving[from + k];
      }
    }
    if (!sun) return;
    this.lashFrames.placeFrames(vertices);
    for (
      let corner = 0, to = (vertices.length / 3) * 4 * VERTEX_TEXELS;
      corner < 4 * this.lashes;
      corner++
    ) {
      this.vertexValues.set(
        placed(this.lashFrames.world, corner >> 2, this.lashCorners, corner),
        to,
      );
      to += 4 * VERTEX_TEXELS;
    }
  }

  drawShadows() {
    const { gl, view } = this;
    const { program, uniforms } = this.shadowProgram;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadows.framebuffer);
    gl.viewport(0, 0, MAP_SIZE, MAP_SIZE);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.useProgram(program);
    bindTexture(gl, 0, this.vertexTexture, uniforms.uVertices);
    gl.uniformMatrix3fv(uniforms.uToSun, true, view.axes);
    gl.uniform3f(uniforms.uMiddle, ...view.middle);
    gl.uniform1f(uniforms.uRadius, view.radius);
    gl.bindVertexArray(this.vertexArray);
    gl.drawElements(gl.TRIANGLES, this.casters.length, gl.UNSIGNED_INT, 0);
    gl.disable(gl.DEPTH_TEST);
  }

  // Compute the colors seen from a camera (world to camera, row-major); returns their texture.
  // Textures are the renderer's, and the framebuffer and viewport are others afterwards.
  /**
   * @type {(camera: ArrayLike<number>, splats: WebGLTexture, tail: WebGLTexture, frames:
   *   WebGLTexture) => WebGLTexture}
   */
  draw(camera, splats, tail, frames) {
    const { gl, colors, view, light } = this;
    const { program, uniforms } = this.program;
    gl.bindFramebuffer(gl.FRAMEBUFFER, colors.framebuffer);
    gl.viewport(0, 0, colors.width, colors.height);
    gl.useProgram(program);
    const { surfaceTexture, vertexTexture, shadows } = this;
    const textures = { uSplats: splats, uTail: tail, uFaces: frames, uSurface: surfaceTexture };
    Object.entries({ ...textures, uVertices: vertexTexture, uShadows: shadows.texture }).forEach(
      ([name, bound], unit) => bindTexture(gl, unit, bound, uniforms[name]),
    );
    gl.uniformMatrix3fv(uniforms.uToSun, true, view.axes);
    gl.uniform3f(uniforms.uMiddle, ...view.middle);
    gl.uniform1f(uniforms.uRadius, view.radius);
    gl.uniform1f(uniforms.uTexel, view.texel);
    const world = Float32Array.from(
      light?.world ?? [],
      (value, k) => GLOSSY[Math.floor(k / 3)] * value,
    );
    if (world.length) gl.uniform3fv(uniforms['uWorld[0]'], world);
    gl.uniform3f(uniforms.uSunColor, ...(light?.sun?.color ?? [0, 0, 0]));
    gl.uniform1f(uniforms.uFactor, light?.factor ?? 1);
    gl.uniform4fv(uniforms.uKept, this.kept);
    gl.uniform4fv(uniforms.uTypical, this.typical);
    const [x, y, z] = [0, 1, 2].map(
      k => -camera[k] * camera[3] - camera[4 + k] * camera[7] - camera[8 + k] * camera[11],
    );
    gl.uniform3f(uniforms.uEye, x, y, z);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    return colors.texture;
  }

  dispose() {
    const { gl } = this;
    for (const item of [this.surfaceTexture, this.vertexTexture]) gl.deleteTexture(item);
    gl.deleteBuffer(this.indexBuffer);
    gl.deleteVertexArray(this.vertexArray);
    for (const item of [this.program, this.shadowProgram]) gl.deleteProgram(item.program);
    for (const target of [this.colors, this.shadows]) deleteTarget(gl, target);
  }
}

// How a sun sees the head: rows across, up and along its rays; the middle and radius of what it
// sees, and the width of a texel of its shadow map, in meters.
/**
 * @param {ArrayLike<number>} vertices
 * @param {Vector} toward
 */
function sunView(vertices, toward) {
  const [middle, half] = bounds(vertices);
  let square = 0;
  for (let v = 0; v < vertices.length; v += 3) {
    const [x, y, z] = [
      vertices[v] - middle[0],
      vertices[v + 1] - middle[1],
      vertices[v + 2] - middle[2],
    ];
    square = Math.max(square, x * x + y * y + z * z);
  }
  const forward = scaled(toward, -1);
  const across = unit(crossed(forward, Math.abs(forward[1]) < 0.9 ? [0, 1, 0] : [1, 0, 0]));
  const axes = [...across, ...crossed(forward, across), ...forward];
  return {
    middle,
    radius: Math.sqrt(square) * 1.01 + 4 * LIFT_M,
    texel: (2 * half) / MAP_SIZE,
    axes,
  };
}

// Where the splats are on the neutral mesh, and what that receives: normal, roughness (0: skin) |
// irradiance of the capture, occlusion | corners of the triangle | their weights.
/**
 * @param {Arrays} arrays
 * @param {FaceFrames} frames of the neutral mesh
 */
function surfaceTexels(arrays, frames) {
  const { faces, neutral, splats_per_face, xyz } = arrays;
  const light = (/** @type {string} */ name) =>
    /** @type {Values} */ (arrays[`light_${name}`]?.values);
  const [face, irradiance, occlusion, roughness] = [
    'face',
    'irradiance',
    'occlusion',
    'roughness',
  ].map(light);
  const normals = vertexNormals(faces.values, frames.sides, neutral.values.length);
  const least = [0, 0, 0];
  for (let k = 0; k < irradiance.length; k++)
    least[k % 3] += (MIN_IRRADIANCE * 3 * irradiance[k]) / irradiance.length;
  const values = new Float32Array(paddedLength(xyz.shape[0] * SURFACE_TEXELS));
  for (let own = 0, splat = 0; own < splats_per_face.values.length; own++) {
    for (const end = splat + splats_per_face.values[own]; splat < end; splat++) {
      const from = 3 * ((own + face[splat]) % faces.shape[0]);
      const corners = Array.from(faces.values.subarray(from, from + 3));
      const [a, b, c] = corners.map(vertex => neutral.values.subarray(3 * vertex, 3 * vertex + 3));
      const weights = nearestWeights(a, b, c, placed(frames.world, own, xyz.values, splat));
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
    }
  }
  return values;
}

// The triangles of the lashes, as an array of their own.
/** @param {Arrays} arrays */
function lashFaces({ faces, light_lash_face }) {
  const found = Array.from(light_lash_face?.values ?? [], face =>
    Array.from(faces.values.subarray(3 * face, 3 * face + 3)),
  );
  return { shape: [found.length, 3], values: Int32Array.from(found.flat()) };
}

// The point of a splat (xyz in its triangle's frame) in space.
/**
 * @param {Float64Array} world rows of the frames
 * @param {number} face
 * @param {Values} xyz
 * @param {number} splat
 * @returns {Vector}
 */
function placed(world, face, xyz, splat) {
  const [x, y, z] = xyz.subarray(3 * splat, 3 * splat + 3);
  const part = (/** @type {number} */ k) =>
    world[k] * x + world[k + 1] * y + world[k + 2] * z + world[k + 3];
  return [part(12 * face), part(12 * face + 4), part(12 * face + 8)];
}

// Barycentric coordinates of a point in the plane of a triangle, clamped to it.
/**
 * @type {(a: ArrayLike<number>, b: ArrayLike<number>, c: ArrayLike<number>, point: Vector) =>
 *   number[]}
 */
function nearestWeights(a, b, c, point) {
  const [first, second, offset] = [difference(b, a), difference(c, a), difference(point, a)];
  const uu = dotProduct(first, first);
  const uv = dotProduct(first, second);
  const vv = dotProduct(second, second);
  const area = Math.max(uu * vv - uv * uv, 1e-30);
  const [pu, pv] = [dotProduct(offset, first), dotProduct(offset, second)];
  const [u, v] = [(vv * pu - uv * pv) / area, (uu * pv - uv * pu) / area];
  const clamped = [1 - u - v, u, v].map(weight => Math.max(0, Math.min(1, weight)));
  const sum = clamped[0] + clamped[1] + clamped[2];
  return clamped.map(weight => weight / sum);
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
