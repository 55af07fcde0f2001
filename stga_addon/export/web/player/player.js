// @ts-check
// One avatar on one canvas: follows motion and camera, and draws when something has changed.

/** @import { Camera, Color, Data, Lighting } from './types.js' */

import { cameraOfView, fitted, frontCamera, bounds } from './camera.js';
import { FaceFrames } from './face_frames.js';
import { LightPass } from './light_pass.js';
import { litBy } from './light.js';
import { Motion, Rig } from './motion.js';
import { DepthSort, Renderer, RendererError } from './renderer.js';

const TIMING_SHARE = 0.1; // of the newest frame in the running mean

export class Player {
  // `data` of readData. Throws RendererError where the browser cannot draw it.
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {Data} data
   */
  constructor(canvas, data) {
    const options = { alpha: true, antialias: false, depth: false, premultipliedAlpha: true };
    const gl = canvas.getContext('webgl2', { ...options, powerPreference: 'high-performance' });
    if (!gl)
      throw new RendererError(
        'This page needs WebGL 2, which this browser or graphics driver does not offer.',
      );
    this.gl = gl;
    const { header, arrays } = data;
    this.canvas = canvas;
    this.data = data;
    this.motion = new Motion(data);
    this.rig = new Rig(data);
    this.faceFrames = new FaceFrames(arrays, header.convention);
    this.depthSort = new DepthSort(arrays.xyz.values, arrays.splats_per_face.values);
    this.renderer = new Renderer(this.gl, data);
    /** @type {Color} */
    this.background = [...header.background, 1];
    this.showSelection = false;
    /** @type {Lighting | null} null: as recorded */
    this.lighting = null;
    /** @type {LightPass | null} */
    this.lightPass = null;
    /** @type {Lighting | null} that the light pass holds, for the pose that it holds */
    this.lit = null;
    /** @type {number | null} */
    this.posed = null; // frame that faceFrames hold
    this.frame = 0;
    this.milliseconds = 0;
    this.pose();
    const [middle] = bounds(this.rig.vertices);
    this.middle = middle;
    const [view] = header.views;
    this.home = view ? cameraOfView(view) : frontCamera(this.rig.vertices, header.up);
    this.camera = this.home;
    this.pivot = this.middle;
  }

  get frameCount() {
    return this.motion.frames;
  }

  resetCamera() {
    this.camera = this.home;
    this.pivot = this.middle;
  }

  /** Draw the current frame on the canvas. */
  draw() {
    const begin = performance.now();
    const camera = fitted(this.camera, this.canvas.width, this.canvas.height);
    const order = this.prepare(camera);
    this.renderer.draw(order, camera, this.background, this.showSelection);
    const spent = performance.now() - begin;
    this.milliseconds += (this.milliseconds ? TIMING_SHARE : 1) * (spent - this.milliseconds);
  }

  // Pixels of the current frame from `camera`, which has its own size (Renderer.read).
  /** @param {Camera} camera */
  read(camera) {
    return this.renderer.read(this.prepare(camera), camera, this.background, this.showSelection);
  }

  /** Forget the pose, because pinned values have changed. */
  invalidate() {
    this.posed = null;
  }

  /** @param {Camera} camera */
  prepare(camera) {
    this.pose();
    const values = this.renderer.frameValues;
    this.faceFrames.compose(camera.matrix, values);
    this.renderer.lightPass = this.lighting && this.litPass(this.lighting);
    return this.depthSort.sort(values);
  }

  pose() {
    if (this.posed === this.frame) return;
    this.motion.sample(this.frame);
    const { coefficients, pose, translation } = this.motion;
    this.faceFrames.update(this.rig.pose(coefficients, pose, translation));
    this.faceFrames.annotate(this.selectionBits(), this.renderer.frameValues);
    this.posed = this.frame;
    this.lit = null;
  }

  // The light pass for the current pose.
  /** @param {Lighting} lighting */
  litPass(lighting) {
    this.lightPass ??= new LightPass(this.gl, this.data);
    if (this.lit !== lighting) {
      const light = litBy(lighting, this.data.header.up);
      this.lightPass.update(this.rig.vertices, this.faceFrames.sides, light);
    }
    this.lit = lighting;
    return this.lightPass;
  }

  selectionBits() {
    const { selection } = this.data.arrays;
    if (!selection || this.motion.shapes.performance) return null;
    const [, bytes] = selection.shape;
    const first = bytes * Math.min(Math.round(this.frame), this.frameCount - 1);
    return selection.values.subarray(first, first + bytes);
  }

  dispose() {
    this.renderer.dispose();
    this.lightPass?.dispose();
  }
}
