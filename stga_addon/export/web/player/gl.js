// @ts-check
// WebGL2 objects: programs, textures of floats, targets.

/** @import { Program, Target } from './types.js' */

import { TEXTURE_WIDTH } from './shaders.js';

export class RendererError extends Error {}

/** @param {number} texels */
export function paddedLength(texels) {
  return 4 * TEXTURE_WIDTH * Math.max(1, Math.ceil(texels / TEXTURE_WIDTH));
}

/** @type {(gl: WebGL2RenderingContext, vertex: string, fragment: string) => Program} */
export function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  /** @type {[number, string][]} */
  const stages = [
    [gl.VERTEX_SHADER, vertex],
    [gl.FRAGMENT_SHADER, fragment],
  ];
  for (const [kind, source] of stages) {
    const shader = gl.createShader(kind);
    if (!shader) continue; // the context is lost
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
    gl.deleteShader(shader);
  }
  gl.bindAttribLocation(made, 0, 'splatIndex');
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = (gl.getAttachedShaders(made) ?? []).map((shader) => gl.getShaderInfoLog(shader));
    throw new RendererError(
      `The graphics driver rejects a shader: ${logs.join(' ')} ${gl.getProgramInfoLog(made)}`,
    );
  }
  /** @type {Program['uniforms']} */
  const uniforms = {};
  const count = gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS) ?? 0;
  for (let k = 0; k < count; k++) {
    const name = gl.getActiveUniform(made, k)?.name;
    if (name) uniforms[name] = gl.getUniformLocation(made, name);
  }
  return { program: made, uniforms };
}

/** @type {(gl: WebGL2RenderingContext, format: number, values: Float32Array) => WebGLTexture} */
export function floatTexture(gl, format, values) {
  const height = values.length / (4 * TEXTURE_WIDTH);
  if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
    throw new RendererError('The avatar has more splats than this graphics card can hold.');
  }
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  gl.texImage2D(gl.TEXTURE_2D, 0, format, TEXTURE_WIDTH, height, 0, gl.RGBA, gl.FLOAT, values);
  return made;
}

// Replace all of a texture of `floatTexture`.
/** @type {(gl: WebGL2RenderingContext, texture: WebGLTexture, values: Float32Array) => void} */
export function updateTexture(gl, texture, values) {
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  const rows = values.length / (4 * TEXTURE_WIDTH);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, rows, gl.RGBA, gl.FLOAT, values);
}

/**
 * @param {WebGL2RenderingContext} gl
 * @param {number} unit
 * @param {WebGLTexture} bound
 * @param {WebGLUniformLocation | null} [uniform]
 */
export function bindTexture(gl, unit, bound, uniform) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, bound);
  gl.uniform1i(uniform ?? null, unit);
}

/**
 * @param {WebGL2RenderingContext} gl
 * @param {number} format
 * @param {number} width
 * @param {number} height
 * @param {number} [attachment]
 * @returns {Target}
 */
export function makeTarget(gl, format, width, height, attachment = gl.COLOR_ATTACHMENT0) {
  const made = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  const framebuffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, attachment, gl.TEXTURE_2D, made, 0);
  return { texture: made, framebuffer, format, width, height };
}

/** @type {(gl: WebGL2RenderingContext, target: Target) => void} */
export function deleteTarget(gl, target) {
  gl.deleteFramebuffer(target.framebuffer);
  gl.deleteTexture(target.texture);
}
