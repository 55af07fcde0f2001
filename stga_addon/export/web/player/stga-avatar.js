// @ts-check
// <stga-avatar src="anna.glb" autoplay loop>: an animated head avatar as an HTML element
// (docs/web.md).

/** @import { Camera, Color, Data, Lighting } from './types.js' */

import { addControls, bounds, cameraOfView, fitted, frontCamera } from './camera.js';
import { DataError, readData } from './data.js';
import { FaceFrames } from './face_frames.js';
import { LightPass, litBy } from './light.js';
import { Motion, Rig } from './motion.js';
import { readPerformance } from './performance.js';
import { DepthSort, Renderer, RendererError } from './renderer.js';
import { vector } from './vector.js';

const MAX_PIXEL_RATIO = 2;
const TIMING_FRACTION = 0.1; // of the newest frame in the running mean
const MAX_STEP_S = 0.25; // of playback time between two frames: a hidden tab resumes where it was

// One avatar on one canvas: follows motion and camera, and draws when something has changed.
export class Player {
  // `data` of readData. Throws RendererError where the browser cannot draw it.
  /** @param {HTMLCanvasElement} canvas @param {Data} data */
  constructor(canvas, data) {
    const options = { antialias: false, depth: false };
    const gl = canvas.getContext('webgl2', { ...options, powerPreference: 'high-performance' });
    const problem = 'needs WebGL 2, which this browser or graphics driver does not offer.';
    if (!gl) throw new RendererError(`This page ${problem}`);
    this.gl = gl;
    const { header, arrays } = data;
    this.canvas = canvas;
    this.data = data;
    this.motion = new Motion(data);
    this.rig = new Rig(data);
    this.faceFrames = new FaceFrames(arrays, header.convention, header.offsets);
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
    /** @type {number | null} that faceFrames hold; null: the pose has to be computed anew */
    this.posed = null;
    this.frame = 0; // whole or fractional
    this.milliseconds = 0;
    this.pose();
    this.middle = bounds(this.rig.vertices)[0];
    const [view] = header.views;
    this.home = view ? cameraOfView(view) : frontCamera(this.rig.vertices, header.up);
    this.camera = this.home;
    this.pivot = this.middle;
  }

  /** Draw the current frame on the canvas. */
  draw() {
    const begin = performance.now();
    const camera = fitted(this.camera, this.canvas.width, this.canvas.height);
    const order = this.prepare(camera);
    this.renderer.draw(order, camera, this);
    const spent = performance.now() - begin;
    this.milliseconds += (this.milliseconds ? TIMING_FRACTION : 1) * (spent - this.milliseconds);
  }

  // Pixels of the current frame from `camera`, which has its own size (Renderer.read).
  /** @param {Camera} camera */
  read(camera) {
    return this.renderer.read(this.prepare(camera), camera, this);
  }

  /** @param {Camera} camera */
  prepare(camera) {
    this.pose();
    const { faceFrames, lighting, renderer, rig } = this;
    faceFrames.compose(camera.matrix, renderer.frameValues);
    if (lighting && this.lit !== lighting) {
      this.lightPass ??= new LightPass(this.gl, this.data);
      this.lightPass.update(rig.vertices, faceFrames.sides, litBy(lighting, this.data.header.up));
      this.lit = lighting;
    }
    renderer.lightPass = lighting && this.lightPass;
    return this.depthSort.sort(renderer.frameValues);
  }

  pose() {
    if (this.posed === this.frame) return;
    const { faceFrames, frame, motion, renderer, rig } = this;
    motion.sample(frame);
    faceFrames.update(rig.pose(motion));
    const { selection } = this.data.arrays;
    const bytes = selection?.shape[1] ?? 0;
    const first = bytes * Math.min(Math.round(frame), motion.frames - 1);
    const isKnown = selection && !motion.shapes.performance;
    const selected = isKnown ? selection.values.subarray(first, first + bytes) : null;
    faceFrames.annotate(selected, renderer.frameValues);
    this.posed = frame;
    this.lit = null;
  }

  dispose() {
    this.renderer.dispose();
    this.lightPass?.dispose();
  }
}

const STYLE = `
:host { display: block; position: relative; overflow: hidden; contain: content; }
canvas { display: block; width: 100%; height: 100%; touch-action: none; cursor: grab; }
canvas:active { cursor: grabbing; }
p { position: absolute; inset: 0; margin: auto; height: fit-content; max-width: 30em; padding: 1em;
  text-align: center; font: 16px/1.5 system-ui, sans-serif; }
[hidden] { display: none; }`;

export class StgaAvatar extends HTMLElement {
  static observedAttributes = ['src', 'loop', 'speed', 'background'];

  /** @type {Player | null} */
  #player = null;
  #playing = false;
  #last = 0;
  #request = 0;
  #loading = 0;
  #removed = false; // from the page, without having been put back
  #canvas = this.#newCanvas();
  #message = document.createElement('p');
  speed = 1;
  loop = false;

  constructor() {
    super();
    const style = Object.assign(document.createElement('style'), { textContent: STYLE });
    Object.assign(this.#message, { role: 'alert', hidden: true });
    this.attachShadow({ mode: 'open' }).append(style, this.#canvas, this.#message);
    new ResizeObserver(() => this.#resize()).observe(this);
  }

  connectedCallback() {
    if (!this.#removed) return;
    this.#removed = false;
    this.#restore();
  }

  disconnectedCallback() {
    // What moves an element removes it for a moment.
    queueMicrotask(() => this.isConnected || this.#release());
  }

  /** @type {(name: string, before: string | null, value: string | null) => void} */
  attributeChangedCallback(name, before, value) {
    if (name === 'src' && value) this.load(value).catch(() => {});
    if (name === 'loop') this.loop = value !== null;
    if (name === 'speed') this.speed = Number(value) || 1;
    if (name === 'background' && value && this.#player) this.background = value;
  }

  // Show the data file at a URL, or one held in memory (ArrayBuffer or Uint8Array, or a promise of
  // one). Rejects, and says why on the page.
  /** @param {string | ArrayBuffer | Uint8Array | Promise<ArrayBuffer | Uint8Array>} source */
  async load(source) {
    const loading = ++this.#loading;
    try {
      const bytes =
        typeof source === 'string' ? await fetchBytes(source) : new Uint8Array(await source);
      const data = await readData(bytes);
      if (loading !== this.#loading) return; // another load has begun
      this.#show(new Player(this.#canvas, data));
    } catch (error) {
      if (loading === this.#loading) this.#fail(error);
      throw error;
    }
  }

  // What the data file says of itself (types.d.ts); null before it is loaded.
  get info() {
    return this.#player?.data.header ?? null;
  }

  get frameCount() {
    return this.#player?.motion.frames ?? 0;
  }

  /** Whole or fractional frame that is shown, from 0. */
  get frame() {
    return this.#player?.frame ?? 0;
  }

  set frame(value) {
    const frame = Math.min(Math.max(Number(value) || 0, 0), this.frameCount - 1);
    if (this.#player) this.#player.frame = frame;
    this.#changed('frame');
  }

  get playing() {
    return this.#playing;
  }

  play() {
    if (!this.#player || this.#playing || this.frameCount < 2) return;
    if (!this.loop && this.frame >= this.frameCount - 1) this.#player.frame = 0;
    this.#playing = true;
    this.#last = 0;
    this.#changed('play');
  }

  /** Stop on a recorded frame. */
  pause() {
    if (!this.#playing) return;
    this.#playing = false;
    this.#loaded.frame = Math.min(Math.round(this.frame), this.frameCount - 1);
    this.#changed('pause');
  }

  // Replace an expression (its name or component) by a value; null: as recorded.
  /** @type {(name: string | number, value: number | null) => void} */
  setExpression(name, value) {
    this.#loaded.motion.pinnedCoefficients[this.#component(name)] = value ?? NaN;
    this.#posed();
  }

  /** @param {string | number} name */
  getExpression(name) {
    return this.#loaded.motion.coefficients[this.#component(name)];
  }

  // Replace a joint's rotation by an axis-angle vector in radians, parts that are null as recorded;
  // null: all parts.
  /** @type {(joint: string, rotation: ArrayLike<number | null> | null) => void} */
  setPose(joint, rotation) {
    const at = this.#joint(joint);
    const { pinnedPose } = this.#loaded.motion;
    for (let k = 0; k < 3; k++) pinnedPose[at + k] = rotation?.[k] ?? NaN;
    this.#posed();
  }

  /** @param {string} joint */
  getPose(joint) {
    const at = this.#joint(joint);
    return Array.from(this.#loaded.motion.pose.subarray(at, at + 3));
  }

  // Replace a shape (one of `info.shapes.names`) by a weight; null: as the performance has it, or
  // 0. While one is replaced, the shapes move expressions, jaw and eyes instead of the recording.
  /** @type {(name: string, weight: number | null) => void} */
  setShape(name, weight) {
    const { shapes } = this.#loaded.motion;
    shapes.pinned[this.#index(shapes.names, name, 'shape')] = weight ?? NaN;
    this.#posed();
  }

  /** @param {string} name */
  getShape(name) {
    const { names, weights } = this.#loaded.motion.shapes;
    return weights[this.#index(names, name, 'shape')];
  }

  // Play a performance (the text of a CSV file with a column per shape) instead of the recording;
  // null: the recording. recordedFps: the rate of a file without one (`guessedFps`).
  // Throws DataError where it is none.
  /** @type {(text: string | null, recordedFps?: number | null) => void} */
  setPerformance(text, recordedFps = null) {
    const { shapes } = this.#loaded.motion;
    if (text !== null && !shapes.names.length)
      throw new DataError('This avatar has no shapes for a performance.');
    const read = text === null ? null : readPerformance(text, shapes.names, recordedFps);
    shapes.performance = read;
    if (text === null) shapes.weights.fill(0);
    this.#loaded.frame = 0;
    this.#last = 0;
    this.dispatchEvent(new CustomEvent('motionchange'));
    this.#posed();
  }

  /** Frames per second assumed for a performance without a rate; else null. */
  get guessedFps() {
    return this.#player?.motion.shapes.performance?.guessedFps ?? null;
  }

  /** Frames per second of what plays. */
  get fps() {
    return this.#player?.motion.fps ?? 0;
  }

  /** Give expressions, shapes and joints back to the recorded motion. */
  release() {
    this.#player?.motion.release();
    this.#posed();
  }

  // { size, focal, center, matrix } (types.d.ts).
  /** @returns {Camera | null} */
  get camera() {
    return this.#player?.camera ?? null;
  }

  // A camera as above, or the name of one of the file's views.
  /** @param {Camera | string} value */
  set camera(value) {
    const player = this.#loaded;
    if (typeof value === 'string') {
      const { views } = player.data.header;
      const names = views.map(view => view.name);
      value = cameraOfView(views[this.#index(names, value, 'view')]);
    }
    player.camera = value;
    player.pivot = player.middle;
    this.#changed('camerachange');
  }

  resetCamera() {
    if (this.#player) this.camera = this.#player.home;
  }

  /** "#rrggbb" or "transparent". */
  get background() {
    const [red, green, blue, alpha] = this.#player?.background ?? [1, 1, 1, 1];
    return alpha ? hexOf([red, green, blue]) : 'transparent';
  }

  set background(value) {
    const isColor = /^#[0-9a-f]{6}$/i.test(value);
    if (!isColor && value !== 'transparent')
      throw new RangeError(`"${value}" is not #rrggbb or transparent.`);
    if (this.#player) this.#player.background = isColor ? [...levelsOf(value), 1] : [0, 0, 0, 0];
    this.#request ||= requestAnimationFrame(now => this.#tick(now));
  }

  /** Whether splats on triangles that the frame did not train are gray. */
  get showSelection() {
    return this.#player?.showSelection ?? false;
  }

  set showSelection(value) {
    if (this.#player) this.#player.showSelection = Boolean(value) && this.hasSelection;
    this.#changed('frame');
  }

  get hasSelection() {
    return Boolean(this.#player?.data.arrays.selection);
  }

  /** Whether the file knows the light of the capture, so that `lighting` can replace it. */
  get hasLight() {
    return Boolean(this.#player?.data.header.light);
  }

  // What lights the avatar (types.d.ts); null: the light that it was recorded in.
  /** @returns {Lighting | null} */
  get lighting() {
    return this.#player?.lighting ?? null;
  }

  set lighting(value) {
    const player = this.#loaded;
    if (value && !this.hasLight) throw new RangeError('The light of this avatar is not known.');
    if (value) litBy(value, player.data.header.up); // throws where it is none
    player.lighting = value && structuredClone(value);
    this.#changed('lightchange');
  }

  get splatCount() {
    return this.#player?.data.arrays.xyz.shape[0] ?? 0;
  }

  /** Milliseconds of JavaScript that a frame takes (running mean). */
  get frameTime() {
    return this.#player?.milliseconds ?? 0;
  }

  // The current frame as a PNG (Blob) from `camera`, by default the current one at its own size.
  /** @type {(camera?: Camera) => Promise<Blob | null>} */
  async snapshot(camera = this.#loaded.camera) {
    const pixels = this.#loaded.read(camera);
    const picture = document.createElement('canvas');
    [picture.width, picture.height] = camera.size;
    picture.getContext('2d')?.putImageData(new ImageData(pixels, ...camera.size), 0, 0);
    return new Promise(resolve => picture.toBlob(resolve, 'image/png'));
  }

  /** The player, for what this interface leaves out. */
  get player() {
    return this.#player;
  }

  /** Throws where no avatar is loaded. */
  get #loaded() {
    if (!this.#player) throw new Error('No avatar is loaded.');
    return this.#player;
  }

  // Index of a name among the names of a kind of thing. Throws RangeError where there is none.
  /** @type {(names: (string | number)[], name: string | number, kind: string) => number} */
  #index(names, name, kind) {
    const index = names.indexOf(name);
    if (index < 0) throw new RangeError(`There is no ${kind} "${name}".`);
    return index;
  }

  /** @param {string} name */
  #joint(name) {
    return 3 * this.#index(this.#loaded.data.header.joints, name, 'joint');
  }

  /** @param {string | number} name of an expression, or its component */
  #component(name) {
    const { sliders } = this.#loaded.data.header;
    const key = typeof name === 'string' ? 'name' : 'component';
    const names = sliders.map(slider => slider[key]);
    return sliders[this.#index(names, name, 'expression')].component;
  }

  #newCanvas() {
    const canvas = document.createElement('canvas');
    const get = () => this.#player;
    addControls(canvas, get, event => this.#changed(event));
    canvas.addEventListener('webglcontextlost', event => {
      if (canvas !== this.#canvas) return; // this element has given it back
      event.preventDefault(); // so that it will be given back
      this.#say('The graphics driver was restarted. Waiting for it …');
    });
    canvas.addEventListener('webglcontextrestored', () => this.#restore());
    return canvas;
  }

  /** Stop, and give the graphics memory back, of which a browser lends to few elements at a time. */
  #release() {
    this.#removed = true;
    cancelAnimationFrame(this.#request);
    this.#request = 0;
    if (!this.#player) return;
    const used = this.#canvas;
    this.#canvas = this.#newCanvas();
    this.#canvas.hidden = used.hidden;
    used.replaceWith(this.#canvas);
    this.#player.dispose();
    this.#player.gl.getExtension('WEBGL_lose_context')?.loseContext();
  }

  /** @param {Player} player */
  #show(player) {
    this.#player?.dispose();
    this.#player = null;
    this.#canvas.hidden = false;
    this.#message.hidden = true;
    this.#resize(); // before there is anything to draw
    this.#player = player;
    this.#playing = false;
    const background = this.getAttribute('background');
    if (background) this.background = background;
    this.dispatchEvent(new CustomEvent('load'));
    if (this.hasAttribute('autoplay')) this.play();
    this.#changed('frame'); // the first one is drawn once, as whoever waited for "load" wants it
    if (this.#removed) this.#release();
  }

  /** Upload everything again, and go on where it was. */
  #restore() {
    if (!this.#player) return;
    const { camera, pivot, background, showSelection, lighting, motion, frame } = this.#player;
    try {
      const kept = { camera, pivot, background, showSelection, lighting, motion, frame };
      this.#player = Object.assign(new Player(this.#canvas, this.#player.data), kept);
    } catch (error) {
      return this.#fail(error);
    }
    this.#message.hidden = true;
    this.#resize();
    this.#posed();
  }

  /** @param {unknown} error */
  #fail(error) {
    const known = error instanceof DataError || error instanceof RendererError;
    const text = error instanceof Error ? error.message : String(error);
    this.#say(known ? text : `The avatar cannot be shown: ${text}`);
    this.#canvas.hidden = true;
    this.dispatchEvent(new CustomEvent('error', { detail: error }));
  }

  /** @param {string} text */
  #say(text) {
    Object.assign(this.#message, { textContent: text, hidden: false });
  }

  /** After a change of what replaces the recorded motion. */
  #posed() {
    if (this.#player) this.#player.posed = null;
    this.#changed('frame');
  }

  /** @param {string} event */
  #changed(event) {
    if (this.#player) this.#request ||= requestAnimationFrame(now => this.#tick(now));
    this.#player?.motion.sample(this.frame); // what listeners ask for is that of the new frame
    this.dispatchEvent(new CustomEvent(event));
  }

  /** @param {number} now */
  #tick(now) {
    this.#request = 0;
    const player = this.#player;
    if (!player || player.gl.isContextLost()) return;
    if (this.#playing) {
      const step = this.#last ? Math.min(Math.max((now - this.#last) / 1000, 0), MAX_STEP_S) : 0;
      this.#last = now;
      player.frame += step * this.fps * this.speed;
      if (this.loop) player.frame %= this.frameCount;
      else if (player.frame >= this.frameCount - 1) this.pause();
    }
    player.draw();
    if (this.#playing) this.#changed('frame');
  }

  #resize() {
    const ratio = Math.min(devicePixelRatio || 1, MAX_PIXEL_RATIO);
    const sides = [this.clientWidth, this.clientHeight];
    const [width, height] = sides.map(side => Math.max(1, Math.round(side * ratio)));
    if (this.#canvas.width === width && this.#canvas.height === height) return;
    Object.assign(this.#canvas, { width, height });
    const player = this.#player;
    if (player && !player.gl.isContextLost()) player.draw(); // setting its size has cleared it
  }
}

/** @param {number[]} color red, green, blue from 0 to 1 */
export function hexOf(color) {
  const levels = color.map(part => (256 + Math.round(255 * part)).toString(16).slice(1));
  return `#${levels.join('')}`;
}

// The reverse.
/** @param {string} hex */
export const levelsOf = hex => vector(k => parseInt(hex.slice(2 * k + 1, 2 * k + 3), 16) / 255);

/** @param {string} address */
async function fetchBytes(address) {
  const response = await fetch(address);
  if (!response.ok) throw new DataError(`${address} cannot be loaded (${response.status}).`);
  return new Uint8Array(await response.arrayBuffer());
}

customElements.define('stga-avatar', StgaAvatar);
