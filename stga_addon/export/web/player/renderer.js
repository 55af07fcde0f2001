// @ts-check
// Splats on a WebGL2 canvas: sorted, blended back to front into a float target, then over the
// background.

/**
 * @import { LightPass } from './light.js'
 * @import { Arrays, Camera, Data, GL, Look, Program, Uniforms } from './types.js'
 * @typedef {ReturnType<typeof makeTarget>} Target texture that splats are blended into
 */

import { FACE_FLOATS } from './face_frames.js';
import { FACE_TEXELS, OVER_FRAGMENT_SHADER, OVER_VERTEX_SHADER, SPLAT_TEXELS } from './shaders.js';
import { SPLAT_FRAGMENT_SHADER, TEXTURE_WIDTH, splatVertexShader, tailSizes } from './shaders.js';
import { dotProduct } from './vector.js';

const SH_C0 = 0.28209479177387814;

export class RendererError extends Error {}

/** @param {number} texels */
export const paddedLength = texels =>
  4 * TEXTURE_WIDTH * Math.max(1, Math.ceil(texels / TEXTURE_WIDTH));

/** @type {(gl: GL, vertex: string, fragment: string) => Program} */
export function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const kind of [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER]) {
    const shader = gl.createShader(kind);
    if (!shader) continue; // the context is lost
    gl.shaderSource(shader, kind === gl.VERTEX_SHADER ? vertex : fragment);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
    gl.deleteShader(shader);
  }
  gl.bindAttribLocation(made, 0, 'splatIndex');
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = (gl.getAttachedShaders(made) ?? []).map(shader => gl.getShaderInfoLog(shader));
    const log = `${logs.join(' ')} ${gl.getProgramInfoLog(made)}`;
    throw new RendererError(`The graphics driver rejects a shader: ${log}`);
  }
  /** @type {Uniforms} */
  const uniforms = {};
  const count = gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS) ?? 0;
  for (let k = 0; k < count; k++) {
    const name = gl.getActiveUniform(made, k)?.name;
    if (name) uniforms[name] = gl.getUniformLocation(made, name);
  }
  return { program: made, uniforms };
}

/** @type {(gl: GL, format: number, values: Float32Array) => WebGLTexture} */
export function floatTexture(gl, format, values) {
  const height = values.length / (4 * TEXTURE_WIDTH);
  if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE))
    throw new RendererError('The avatar has more splats than this graphics card can hold.');
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  gl.texImage2D(gl.TEXTURE_2D, 0, format, TEXTURE_WIDTH, height, 0, gl.RGBA, gl.FLOAT, values);
  return made;
}

// Replace all of a texture of `floatTexture`.
/** @type {(gl: GL, texture: WebGLTexture, values: Float32Array) => void} */
export function updateTexture(gl, texture, values) {
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  const rows = values.length / (4 * TEXTURE_WIDTH);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, rows, gl.RGBA, gl.FLOAT, values);
}

/** @type {(gl: GL, unit: number, bound: WebGLTexture, uniform: ?WebGLUniformLocation) => void} */
export function bindTexture(gl, unit, bound, uniform) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, bound);
  gl.uniform1i(uniform, unit);
}

/**
 * @param {GL} gl @param {number} format @param {number} width @param {number} height
 * @param {number} [kind] of attachment
 */
export function makeTarget(gl, format, width, height, kind = gl.COLOR_ATTACHMENT0) {
  const made = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  const framebuffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, kind, gl.TEXTURE_2D, made, 0);
  return { texture: made, framebuffer, format, width, height };
}

/** @type {(gl: GL, target: Target) => void} */
export function deleteTarget(gl, target) {
  gl.deleteFramebuffer(target.framebuffer);
  gl.deleteTexture(target.texture);
}

export class Renderer {
  // Upload the splats of `data` (readData). Throws RendererError where the browser cannot draw
  // them.
  /** @param {GL} gl @param {Data} data */
  constructor(gl, data) {
    if (!gl.getExtension('EXT_color_buffer_float'))
      throw new RendererError('This browser cannot draw to float textures, as the avatar needs.');
    this.gl = gl;
    const { arrays } = data;
    this.data = data;
    this.splatProgram = program(gl, splatVertexShader(arrays, false), SPLAT_FRAGMENT_SHADER);
    /** @type {Program | null} */
    this.litProgram = null;
    /** @type {LightPass | null} where the splats get their colors, if they are not as recorded */
    this.lightPass = null;
    this.overProgram = program(gl, OVER_VERTEX_SHADER, OVER_FRAGMENT_SHADER);
    this.splatTexture = floatTexture(gl, gl.RGBA32F, splatTexels(arrays));
    this.tailTexture = floatTexture(gl, gl.RGBA16F, tailValues(arrays));
    this.frameValues = new Float32Array(paddedLength(arrays.faces.shape[0] * FACE_TEXELS));
    this.frameTexture = floatTexture(gl, gl.RGBA32F, this.frameValues);
    this.vertexArray = gl.createVertexArray();
    this.indexBuffer = gl.createBuffer();
    gl.bindVertexArray(this.vertexArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indexBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, 4 * arrays.xyz.shape[0], gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    /** @type {Target | null} */
    this.target = null;
    this.finest = gl.getExtension('EXT_float_blend') ? gl.RGBA32F : gl.RGBA16F;
  }

  // Draw splats in `order` (back to front) on the frames in `frameValues` into a framebuffer, or
  // the canvas, where they are blended in half precision.
  /** @type {(order: Uint32Array, camera: Camera, look: Look, into?: ?WebGLFramebuffer) => void} */
  draw(order, camera, { background, showSelection }, into = null) {
    const gl = this.gl;
    const [width, height] = camera.size;
    const format = into ? this.finest : gl.RGBA16F;
    let { target } = this;
    if (target?.width !== width || target.height !== height || target.format !== format) {
      if (target) deleteTarget(gl, target);
      target = this.target = makeTarget(gl, format, width, height);
    }
    updateTexture(gl, this.frameTexture, this.frameValues);
    gl.bindVertexArray(this.vertexArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indexBuffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, order);
    const { splatTexture, tailTexture, frameTexture } = this;
    const colors = this.lightPass?.draw(camera.matrix, [splatTexture, tailTexture, frameTexture]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const { arrays, header } = this.data;
    if (colors)
      this.litProgram ??= program(gl, splatVertexShader(arrays, true), SPLAT_FRAGMENT_SHADER);
    const { program: used, uniforms } = (colors && this.litProgram) || this.splatProgram;
    gl.useProgram(used);
    bindTexture(gl, 0, frameTexture, uniforms.uFaces);
    bindTexture(gl, 1, splatTexture, uniforms.uSplats);
    bindTexture(gl, 2, colors ?? tailTexture, colors ? uniforms.uColors : uniforms.uTail);
    // Rows of world to camera are columns of its transpose, camera to world.
    const rows = camera.matrix.filter((_, k) => k < 12 && k % 4 < 3);
    gl.uniformMatrix3fv(uniforms.uToWorld, false, rows);
    gl.uniform2f(uniforms.uFocal, ...camera.focal);
    gl.uniform2f(uniforms.uCenter, ...camera.center);
    gl.uniform2f(uniforms.uSize, ...camera.size);
    gl.uniform1i(uniforms.uAntialiased, Number(header.antialiased));
    gl.uniform1i(uniforms.uShowSelection, Number(showSelection));
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, order.length);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, into);
    gl.useProgram(this.overProgram.program);
    bindTexture(gl, 0, target.texture, this.overProgram.uniforms.uPicture);
    const [red, green, blue, alpha] = background;
    const premultiplied = [red * alpha, green * alpha, blue * alpha, alpha];
    gl.uniform4fv(this.overProgram.uniforms.uBackground, premultiplied);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // The pixels of one drawing, rows from the top: Uint8ClampedArray (4·width·height), premultiplied
  // with alpha.
  /** @param {Uint32Array} order @param {Camera} camera @param {Look} look */
  read(order, camera, look) {
    const gl = this.gl;
    const [width, height] = camera.size;
    const copy = makeTarget(gl, gl.RGBA8, width, height);
    this.draw(order, camera, look, copy.framebuffer);
    const flipped = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, flipped);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    deleteTarget(gl, copy);
    const pixels = new Uint8ClampedArray(flipped.length);
    for (let row = 0; row < height; row++) {
      const from = 4 * width * (height - 1 - row);
      pixels.set(flipped.subarray(from, from + 4 * width), 4 * width * row);
    }
    return pixels;
  }

  dispose() {
    const { gl, splatTexture, tailTexture, frameTexture } = this;
    for (const texture of [splatTexture, tailTexture, frameTexture]) gl.deleteTexture(texture);
    gl.deleteBuffer(this.indexBuffer);
    gl.deleteVertexArray(this.vertexArray);
    for (const used of [this.splatProgram, this.overProgram, this.litProgram])
      gl.deleteProgram(used?.program ?? null);
    if (this.target) deleteTarget(gl, this.target);
  }
}

/** @param {Arrays} arrays */
function splatTexels({ xyz, splats_per_face, rotation, rotation_largest, ...arrays }) {
  const { log_scale, opacity, color } = arrays;
  const values = new Float32Array(paddedLength(xyz.shape[0] * SPLAT_TEXELS));
  for (let face = 0, splat = 0; face < splats_per_face.values.length; face++) {
    for (const end = splat + splats_per_face.values[face]; splat < end; splat++) {
      const to = 4 * SPLAT_TEXELS * splat;
      const from = 3 * splat;
      for (let k = 0; k < 3; k++) {
        values[to + k] = xyz.values[from + k];
        values[to + 8 + k] = Math.exp(log_scale.values[from + k]);
        values[to + 12 + k] = 0.5 + SH_C0 * color.values[from + k];
      }
      values[to + 3] = face; // a float holds whole numbers up to 2^24
      const turn = Array.from(rotation.values.subarray(from, from + 3));
      const rest = Math.sqrt(Math.max(0, 1 - dotProduct(turn, turn)));
      turn.splice(rotation_largest.values[splat], 0, rest); // the largest part, which is positive
      values.set(turn, to + 4);
      values[to + 11] = opacity.values[splat];
    }
  }
  return values;
}

/** @param {Arrays} arrays */
function tailValues(arrays) {
  const { xyz, sh } = arrays;
  const texels = tailSizes(arrays)[1];
  const values = new Float32Array(paddedLength(xyz.shape[0] * texels));
  for (let splat = 0; sh && splat < xyz.shape[0]; splat++) {
    const own = sh.values.subarray(sh.shape[1] * splat, sh.shape[1] * (splat + 1));
    values.set(own, 4 * texels * splat);
  }
  return values;
}

// Order of the splats from back to front: a radix sort of their depths in 22 bits.

const DIGIT_BITS = 11; // of which a key has two
const DIGITS = 1 << DIGIT_BITS;
const MAX_KEY = DIGITS * DIGITS - 1;

export class DepthSort {
  // xyz (3·N) of splats sorted by triangle, and how many each triangle has.
  /** @param {ArrayLike<number>} xyz @param {ArrayLike<number>} splatsPerFace */
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

  // Indices of the splats, farthest first; `frames` as FaceFrames.compose writes them.
  /** @param {ArrayLike<number>} frames */
  sort(frames) {
    const { byLow, depth, high, key, low, order, splatsPerFace, xyz } = this;
    let near = Infinity; // of those in front of the camera
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
    near = Math.min(near, far);
    const scale = MAX_KEY / (far - near || 1);
    low.fill(0);
    high.fill(0);
    for (let i = 0; i < key.length; i++) {
      // From 0 for the farthest to MAX_KEY for the nearest and those behind the camera; below 0
      // only by rounding.
      const steps = (far - depth[i]) * scale;
      key[i] = steps < MAX_KEY ? Math.max(steps, 0) : MAX_KEY;
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
    for (let i = 0; i < key.length; i++) byLow[low[key[i] & (DIGITS - 1)]++] = i;
    for (let n = 0; n < key.length; n++) order[high[key[byLow[n]] >> DIGIT_BITS]++] = byLow[n];
    return order;
  }
}
