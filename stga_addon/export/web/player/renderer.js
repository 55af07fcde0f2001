// @ts-check
// Splats on a WebGL2 canvas: blended back to front into a float target, then over the background.

/**
 * @import { LightPass } from './light_pass.js'
 * @import { Arrays, Camera, Color, Data, Program, Target, Values } from './types.js'
 */

import { RendererError, bindTexture, deleteTarget, floatTexture, makeTarget, paddedLength, program } from './gl.js';
import { wholeQuaternion } from './rotation.js';
import {
  FACE_TEXELS,
  OVER_FRAGMENT_SHADER,
  OVER_VERTEX_SHADER,
  SPLAT_FRAGMENT_SHADER,
  SPLAT_TEXELS,
  TEXTURE_WIDTH,
  splatVertexShader,
  tailTexels,
} from './shaders.js';

const SH_C0 = 0.28209479177387814;

export class Renderer {
  /**
   * Upload the splats of `data` (readData). Throws RendererError where the browser cannot draw them.
   * @param {WebGL2RenderingContext} gl
   * @param {Data} data
   */
  constructor(gl, data) {
    if (!gl.getExtension('EXT_color_buffer_float')) {
      throw new RendererError('This browser cannot draw to float textures, which the avatar needs.');
    }
    this.gl = gl;
    const { arrays, header } = data;
    this.antialiased = header.antialiased;
    this.count = arrays.xyz.shape[0];
    this.faces = arrays.faces.shape[0];
    const harmonics = arrays.sh ? arrays.sh.shape[1] / 3 : 0;
    const strains = arrays.strain_color ? 3 : 0;
    this.splatProgram = program(gl, splatVertexShader(harmonics, strains), SPLAT_FRAGMENT_SHADER);
    /** @type {Program | null} */
    this.litProgram = null;
    /** @type {LightPass | null} where the splats get their colors, if they are not as recorded */
    this.lightPass = null;
    this.overProgram = program(gl, OVER_VERTEX_SHADER, OVER_FRAGMENT_SHADER);
    this.splatTexture = floatTexture(gl, gl.RGBA32F, splatTexels(arrays));
    this.tailTexture = floatTexture(gl, gl.RGBA16F, tailValues(arrays, tailTexels(harmonics, strains)));
    this.frameValues = new Float32Array(paddedLength(this.faces * FACE_TEXELS));
    this.frameTexture = floatTexture(gl, gl.RGBA32F, this.frameValues);
    this.vertexArray = gl.createVertexArray();
    this.indexBuffer = gl.createBuffer();
    this.fillIndexArray();
    /** @type {Target | null} */
    this.target = null;
    this.finest = gl.getExtension('EXT_float_blend') ? gl.RGBA32F : gl.RGBA16F;
  }

  fillIndexArray() {
    const gl = this.gl;
    gl.bindVertexArray(this.vertexArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indexBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, 4 * this.count, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
  }

  /**
   * Draw `order` (back to front) of the splats on the frames in `frameValues`.
   * camera: { size, focal, center, matrix }; background: red, green, blue, alpha; framebuffer: null for the canvas;
   * format: of the target in which they are blended.
   * @param {Uint32Array} order
   * @param {Camera} camera
   * @param {Color} background
   * @param {boolean} showSelection
   * @param {WebGLFramebuffer | null} [framebuffer]
   * @param {number} [format]
   */
  draw(order, camera, background, showSelection, framebuffer = null, format = this.gl.RGBA16F) {
    const gl = this.gl;
    const [width, height] = camera.size;
    const target = this.resizedTarget(width, height, format);
    this.upload(order);
    const colors = this.lightPass?.draw(camera.matrix, this.splatTexture, this.tailTexture, this.frameTexture);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    this.drawSplats(camera, showSelection, colors);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.useProgram(this.overProgram.program);
    bindTexture(gl, 0, target.texture, this.overProgram.uniforms.uPicture);
    const [red, green, blue, alpha] = background;
    gl.uniform4f(this.overProgram.uniforms.uBackground, red * alpha, green * alpha, blue * alpha, alpha);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** @param {Uint32Array} order */
  upload(order) {
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.frameTexture);
    const rows = this.frameValues.length / (4 * TEXTURE_WIDTH);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, rows, gl.RGBA, gl.FLOAT, this.frameValues);
    gl.bindVertexArray(this.vertexArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indexBuffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, order);
  }

  /**
   * @param {Camera} camera
   * @param {boolean} showSelection
   * @param {WebGLTexture} [colors] of the light pass; else as recorded
   */
  drawSplats(camera, showSelection, colors) {
    const gl = this.gl;
    if (colors) this.litProgram ??= program(gl, splatVertexShader(0, 0, true), SPLAT_FRAGMENT_SHADER);
    const { program: used, uniforms } = (colors && this.litProgram) || this.splatProgram;
    gl.useProgram(used);
    bindTexture(gl, 0, this.frameTexture, uniforms.uFaces);
    bindTexture(gl, 1, this.splatTexture, uniforms.uSplats);
    bindTexture(gl, 2, colors ?? this.tailTexture, colors ? uniforms.uColors : uniforms.uTail);
    const m = camera.matrix;
    // Rows of world to camera are columns of its transpose, camera to world.
    gl.uniformMatrix3fv(uniforms.uToWorld, false, [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]]);
    gl.uniform2f(uniforms.uFocal, ...camera.focal);
    gl.uniform2f(uniforms.uCenter, ...camera.center);
    gl.uniform2f(uniforms.uSize, ...camera.size);
    gl.uniform1i(uniforms.uAntialiased, Number(this.antialiased));
    gl.uniform1i(uniforms.uShowSelection, Number(showSelection));
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
    gl.disable(gl.BLEND);
  }

  /**
   * @param {number} width
   * @param {number} height
   * @param {number} format
   */
  resizedTarget(width, height, format) {
    const { target } = this;
    if (target?.width === width && target.height === height && target.format === format) return target;
    if (target) deleteTarget(this.gl, target);
    this.target = makeTarget(this.gl, format, width, height);
    return this.target;
  }

  /**
   * The pixels of one drawing, rows from the top: Uint8ClampedArray (4·width·height), premultiplied with alpha.
   * @param {Uint32Array} order
   * @param {Camera} camera
   * @param {Color} background
   * @param {boolean} showSelection
   */
  read(order, camera, background, showSelection) {
    const gl = this.gl;
    const [width, height] = camera.size;
    const copy = makeTarget(gl, gl.RGBA8, width, height);
    this.draw(order, camera, background, showSelection, copy.framebuffer, this.finest);
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
    const gl = this.gl;
    for (const item of [this.splatTexture, this.tailTexture, this.frameTexture]) gl.deleteTexture(item);
    gl.deleteBuffer(this.indexBuffer);
    gl.deleteVertexArray(this.vertexArray);
    for (const item of [this.splatProgram, this.overProgram, this.litProgram]) gl.deleteProgram(item?.program ?? null);
    if (this.target) deleteTarget(gl, this.target);
  }
}

/** @param {Arrays} arrays */
function splatTexels({ xyz, splats_per_face, rotation, rotation_largest, log_scale, opacity, color }) {
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
      values.set(wholeQuaternion(rotation.values.subarray(from, from + 3), rotation_largest.values[splat]), to + 4);
      values[to + 11] = opacity.values[splat];
    }
  }
  return values;
}

/**
 * @param {Arrays} arrays
 * @param {number} texels
 */
function tailValues({ xyz, sh, strain_color }, texels) {
  const values = new Float32Array(paddedLength(Math.max(1, xyz.shape[0] * texels)));
  let offset = 0;
  for (const array of [sh, strain_color]) {
    if (!array) continue;
    const size = array.shape[1];
    for (let splat = 0; splat < xyz.shape[0]; splat++) {
      values.set(array.values.subarray(size * splat, size * (splat + 1)), 4 * texels * splat + offset);
    }
    offset += size;
  }
  return values;
}
