// @ts-check
// Colors of the splats under the light of a scene: a texel a splat, computed again where pose, light or eye have changed.

/** @import { Data, LitBy, Program, Target, Values } from './types.js' */

import { Bounce } from './bounce.js';
import { bounds } from './camera.js';
import { bindTexture, deleteTarget, floatTexture, makeTarget, paddedLength, program } from './gl.js';
import { HARMONICS, addPoint, rotatedLight } from './harmonics.js';
import { Lashes } from './lashes.js';
import {
  LIFT_M,
  LIGHT_VERTEX_SHADER,
  MAP_SIZE,
  SHADOW_FRAGMENT_SHADER,
  SHADOW_VERTEX_SHADER,
  SURFACE_TEXELS,
  VERTEX_TEXELS,
  lightFragmentShader,
} from './light_shaders.js';
import { keptColors, recordedLight } from './likeness.js';
import { TEXTURE_WIDTH } from './shaders.js';
import { Surface, received, rigidRotation, vertexNormals } from './surface.js';
import { crossed, scaled, unit } from './vector.js';

/** Of each harmonic in the mean radiance around the direction that skin mirrors (light/harmonics.py, GLOSSY). */
const GLOSSY = [1, 0.85, 0.85, 0.85, 0.62, 0.62, 0.62, 0.62, 0.62];
const MIN_RIGID = 1e-3; // weight of covered vertices where the turn of the head is found

export class LightPass {
  /**
   * For data of an avatar whose light is known.
   * @param {WebGL2RenderingContext} gl
   * @param {Data} data
   */
  constructor(gl, data) {
    this.gl = gl;
    const { arrays } = data;
    this.faces = arrays.faces.values;
    this.neutral = arrays.neutral.values;
    this.transfer = /** @type {Values} */ (arrays.light_transfer?.values);
    const occlusion = /** @type {Values} */ (arrays.light_occlusion?.values);
    this.rigid = Float64Array.from(occlusion, (share) => share + MIN_RIGID);
    this.surface = new Surface(data);
    this.bounce = new Bounce(this.neutral, this.faces, this.surface.areas, occlusion);
    this.surfaceTexture = floatTexture(gl, gl.RGBA32F, surfaceTexels(this.surface));
    this.lashes = new Lashes(data, this.surface);
    const points = this.neutral.length / 3 + 4 * this.lashes.count;
    this.vertexValues = new Float32Array(paddedLength(points * VERTEX_TEXELS));
    this.vertexTexture = floatTexture(gl, gl.RGBA32F, this.vertexValues);
    const corners = this.lashes.faces.map((corner) => this.neutral.length / 3 + corner);
    this.casters = Uint32Array.from([...this.faces, ...corners]);
    this.shadows = makeShadowMap(gl, this.casters);
    this.colors = makeTarget(gl, gl.RGBA32F, TEXTURE_WIDTH, Math.ceil(this.surface.count / TEXTURE_WIDTH) || 1);
    const harmonics = arrays.sh ? arrays.sh.shape[1] / 3 : 0;
    this.program = program(gl, LIGHT_VERTEX_SHADER, lightFragmentShader(harmonics, arrays.strain_color ? 3 : 0));
    this.shadowProgram = program(gl, SHADOW_VERTEX_SHADER, SHADOW_FRAGMENT_SHADER);
    /** @type {LitBy | null} */
    this.light = null;
    this.recorded = recordedLight(this.transfer, this.bounce, /** @type {Values} */ (arrays.light_irradiance?.values));
    this.kept = { share: 0, gain: [0, 0, 0] };
    this.view = sunView(this.neutral, [0, 1, 0]);
  }

  /**
   * Follow the posed vertices (3·V) and the light.
   * @param {Float64Array} vertices
   * @param {LitBy} light
   */
  update(vertices, light) {
    const { gl } = this;
    this.light = light;
    this.packVertices(vertices, light);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.vertexTexture);
    const rows = this.vertexValues.length / (4 * TEXTURE_WIDTH);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, rows, gl.RGBA, gl.FLOAT, this.vertexValues);
    if (!light.sun) return;
    this.view = sunView(vertices, light.sun.toward);
    this.drawShadows();
  }

  /**
   * @param {Float64Array} vertices
   * @param {LitBy} light
   */
  packVertices(vertices, { world, sun }) {
    const normals = vertexNormals(this.faces, vertices);
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
    const lashes = this.lashes.place(vertices); // after the vertices, with nothing but their positions
    for (let from = 0, to = (vertices.length / 3) * 4 * VERTEX_TEXELS; from < lashes.length; from += 3) {
      this.vertexValues.set(lashes.subarray(from, from + 3), to);
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
    gl.bindVertexArray(this.shadows.vertexArray);
    gl.drawElements(gl.TRIANGLES, this.casters.length, gl.UNSIGNED_INT, 0);
    gl.disable(gl.DEPTH_TEST);
  }

  /**
   * Compute the colors seen from a camera (world to camera, row-major); returns their texture. Textures are the
   * renderer's, and the framebuffer and viewport are others afterwards.
   * @param {ArrayLike<number>} camera
   * @param {WebGLTexture} splats
   * @param {WebGLTexture} tail
   * @param {WebGLTexture} frames
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
    this.setLight(light, uniforms);
    const [x, y, z] = [0, 1, 2].map(
      (k) => -camera[k] * camera[3] - camera[4 + k] * camera[7] - camera[8 + k] * camera[11],
    );
    gl.uniform3f(uniforms.uEye, x, y, z);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    return colors.texture;
  }

  /**
   * @param {LitBy | null} light
   * @param {Program['uniforms']} uniforms
   */
  setLight(light, uniforms) {
    const { gl, surface, kept } = this;
    const world = new Float32Array(3 * HARMONICS);
    for (let k = 0; light && k < world.length; k++) world[k] = GLOSSY[Math.floor(k / 3)] * light.world[k];
    gl.uniform3fv(uniforms['uWorld[0]'], world);
    gl.uniform3f(uniforms.uSunColor, ...(light?.sun?.color ?? [0, 0, 0]));
    gl.uniform1f(uniforms.uFactor, light?.factor ?? 1);
    gl.uniform4f(uniforms.uKept, kept.gain[0], kept.gain[1], kept.gain[2], kept.share);
    gl.uniform1f(uniforms.uDamping, surface.damping);
    gl.uniform3f(uniforms.uTypical, surface.typical[0], surface.typical[1], surface.typical[2]);
  }

  dispose() {
    const { gl, shadows } = this;
    for (const item of [this.surfaceTexture, this.vertexTexture, shadows.texture]) gl.deleteTexture(item);
    gl.deleteFramebuffer(shadows.framebuffer);
    gl.deleteBuffer(shadows.indexBuffer);
    gl.deleteVertexArray(shadows.vertexArray);
    for (const item of [this.program, this.shadowProgram]) gl.deleteProgram(item.program);
    deleteTarget(gl, this.colors);
  }
}

/**
 * How a sun sees the head: rows across, up and along its rays; the middle and radius of what it sees, and the width of a
 * texel of its shadow map, in meters.
 * @param {ArrayLike<number>} vertices
 * @param {import('./types.js').Vector} toward
 */
function sunView(vertices, toward) {
  const [middle, half] = bounds(vertices);
  let square = 0;
  for (let v = 0; v < vertices.length; v += 3) {
    const [x, y, z] = [vertices[v] - middle[0], vertices[v + 1] - middle[1], vertices[v + 2] - middle[2]];
    square = Math.max(square, x * x + y * y + z * z);
  }
  const forward = scaled(toward, -1);
  const across = unit(crossed(forward, Math.abs(forward[1]) < 0.9 ? [0, 1, 0] : [1, 0, 0]));
  const axes = [...across, ...crossed(forward, across), ...forward];
  return { middle, radius: Math.sqrt(square) * 1.01 + 4 * LIFT_M, texel: (2 * half) / MAP_SIZE, axes };
}

/** @param {Surface} surface */
function surfaceTexels({ count, color, irradiance, occlusion, roughness, corners, weights }) {
  const values = new Float32Array(paddedLength(Math.max(1, count * SURFACE_TEXELS)));
  for (let splat = 0; splat < count; splat++) {
    const to = 4 * SURFACE_TEXELS * splat;
    [color, irradiance, corners, weights].forEach((array, texel) =>
      values.set(array.subarray(3 * splat, 3 * splat + 3), to + 4 * texel),
    );
    values[to + 3] = roughness[splat];
    values[to + 7] = occlusion[splat];
  }
  return values;
}

/**
 * @param {WebGL2RenderingContext} gl
 * @param {Uint32Array} faces
 */
function makeShadowMap(gl, faces) {
  const texture = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT32F, MAP_SIZE, MAP_SIZE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  const framebuffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, texture, 0);
  const [vertexArray, indexBuffer] = [gl.createVertexArray(), gl.createBuffer()];
  gl.bindVertexArray(vertexArray);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, indexBuffer);
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
  gl.bindVertexArray(null);
  return { texture, framebuffer, vertexArray, indexBuffer };
}
