// @ts-check
// Reading of skinned splats, and checks of everything that the player relies on.

/** @import { Data, DataArray, Values } from './types.js' */

import { SIGNALS, TARGETS } from './face_frames.js';
import { bytesOf, parseGlb, readSkin } from './glb.js';

export class DataError extends Error {}

const VERSION = 1;
const MAX_VIEW_SIZE = 1 << 16; // pixels

// Parse skinned splats (Uint8Array): a .glb file, or one gzipped: { header, arrays }. Throws
// DataError in one sentence.
/** @type {(bytes: Uint8Array<ArrayBuffer>) => Promise<Data>} */
export async function readData(bytes) {
  const raw = bytes[0] === 0x1f && bytes[1] === 0x8b ? await inflated(bytes) : bytes;
  const view = new DataView(raw.buffer, raw.byteOffset, raw.byteLength);
  if (raw.length < 20 || view.getUint32(0, false) !== 0x676c5446)
    throw new DataError('This is not an avatar data file.');
  if (view.getUint32(8, true) > raw.length) throw new DataError('The avatar data is cut off.');
  const { document, binary } = understood('document', () => parseGlb(raw));
  const splats = document.extras.stga_splats;
  if (splats.version !== VERSION) {
    const problem = `has format version ${splats.version}; this player reads ${VERSION}`;
    throw new DataError(`The avatar ${problem}.`);
  }
  const packed = understood('byteLength', () => bytesOf(binary, splats));
  const skin = understood('mesh', () => readSkin(document, binary));
  const header = { ...splats, joints: skin.joints, parents: skin.parents };
  const stored = readArrays(header, await inflated(packed));
  const arrays = { ...skin.arrays, ...stored };
  const joints = header.parents.length;
  const [vertices] = arrays.base.shape;
  arrays.neutral ??= arrays.base;
  const features = 9 * (joints - 1);
  arrays.correctives ??= {
    shape: [features, vertices, 3],
    values: new Float32Array(3 * features * vertices),
  };
  checkData(header, arrays);
  return { header, arrays };
}

/** @type {(bytes: Uint8Array<ArrayBuffer>) => Promise<Uint8Array<ArrayBuffer>>} */
async function inflated(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'));
  const buffer = await new Response(stream).arrayBuffer().catch(() => {
    throw new DataError('The avatar data is damaged.');
  });
  return new Uint8Array(buffer);
}

// What `read` returns; throws DataError where it throws.
/** @type {<T>(field: string, read: () => T) => T} */
function understood(field, read) {
  try {
    return read();
  } catch {
    throw new DataError(`The avatar data is damaged: ${field} is missing or malformed.`);
  }
}

/** @type {(header: any, payload: Uint8Array) => Record<string, DataArray>} */
function readArrays(header, payload) {
  /** @type {Record<string, DataArray>} */
  const arrays = {};
  let at = 0;
  for (const [name, entry] of Object.entries(header.arrays ?? {})) {
    const shape = list(entry?.shape, `${name}.shape`);
    require(shape.every(size => Number.isSafeInteger(size) && size >= 0), `${name}.shape`);
    const count = shape.reduce((product, size) => product * size, 1);
    const planes = entry.type === 'float32' ? 4 : entry.planes;
    require(Number.isInteger(planes) && planes >= 1 && planes <= 4, `${name}.planes`);
    if (!(at + planes * count <= payload.length))
      throw new DataError('The avatar data is cut off.');
    const block = payload.subarray(at, at + planes * count);
    arrays[name] = { shape, values: decoded(name, entry, block, count) };
    at += planes * count;
  }
  for (const [name, axes] of Object.entries(arrays)) {
    const along = arrays[name.replace(/_axes$/, '')];
    if (along !== axes) turn(along, axes);
  }
  return arrays;
}

// Rows of an array from what they are along axes (n, n), columns, in place.
/** @type {(array: DataArray, axes: DataArray) => void} */
function turn(array, axes) {
  const width = array?.shape[1];
  require(width && axes.shape.join() === [width, width].join(), 'axes');
  const row = new Float32Array(width);
  for (let at = 0; at < array.values.length; at += width) {
    row.set(array.values.subarray(at, at + width));
    for (let k = 0; k < width; k++) {
      let sum = 0;
      for (let n = 0; n < width; n++) sum += axes.values[width * k + n] * row[n];
      array.values[at + k] = sum;
    }
  }
}

/** @type {(name: string, entry: any, block: Uint8Array, count: number) => Values} */
function decoded(name, entry, block, count) {
  if (entry.type === 'float32') return new Float32Array(block.slice().buffer);
  const step = entry.type === 'fixed' ? entry.step : 1;
  require(['fixed', 'integer'].includes(entry.type) && step > 0 && step < Infinity, `${name}.type`);
  require(Number.isSafeInteger(entry.low), `${name}.low`);
  const values = entry.type === 'fixed' ? new Float32Array(count) : new Int32Array(count);
  const columns = count ? (entry.shape.at(-1) ?? 1) : 0;
  let from = 0;
  for (let column = 0; column < columns; column++) {
    for (let to = column; to < count; to += columns, from++) {
      let integer = 0;
      for (let plane = entry.planes - 1; plane >= 0; plane--)
        integer = integer * 256 + block[plane * count + from];
      values[to] = (integer + entry.low) * step;
    }
  }
  return values;
}

// Throw a DataError unless header and arrays fit each other and hold usable values.
/** @type {(header: any, arrays: Record<string, DataArray>) => void} */
function checkData(header, arrays) {
  const counted = ['xyz', 'base', 'faces', 'basis', 'coefficients'];
  const [splats, vertices, faces, shapes, frames] = counted.map(name => size(arrays, name, 0));
  const joints = list(header.parents, 'parents').length;
  const isEmpty = !vertices || !faces || !joints || !frames;
  require(!isEmpty, 'number of vertices, triangles, joints or frames');
  /** @type {[string, ...number[]][]} */
  const shapesOf = [
    ['xyz rotation log_scale color', splats, 3],
    ['opacity rotation_largest', splats],
    ['base neutral', vertices, 3],
    ['faces', faces, 3],
    ['splats_per_face', faces],
    ['basis', shapes, vertices, 3],
    ['correctives', 9 * (joints - 1), vertices, 3],
    ['weights', vertices, joints],
    ['joint_rest', joints, 3],
    ['joint_basis', shapes, joints, 3],
    ['coefficients', frames, shapes],
    ['pose', frames, joints, 3],
    ['translation', frames, 3],
  ];
  /** @type {[string, ...number[]][]} */
  const optional = [
    ['selection', frames, Math.ceil(faces / 8)],
    ['strain_range', faces, 12],
    ['sh', splats, [9, 24, 45].find(count => count === arrays.sh?.shape[1]) ?? 0],
  ];
  shapesOf.push(...optional.filter(([name]) => arrays[name]));
  for (const [name, row] of Object.entries(header.offsets ?? {})) {
    const [signal, target] = list(row, `offsets.${name}`);
    require(Object.hasOwn(SIGNALS, signal) && TARGETS.includes(target), `offsets.${name}`);
    shapesOf.push([name, faces, 9]);
  }
  if (header.shapes) {
    const controls = strings(header.shapes.names, 'shapes');
    const moved = size(arrays, 'shape_products', 1);
    require(moved <= shapes, 'shape_products');
    shapesOf.push(['shape_linear', controls.length, moved + 9]);
    shapesOf.push(['shape_products', controls.length, moved]);
    const { opens, limited } = header.shapes;
    require(controls.includes(opens) && controls.includes(limited), 'shapes');
  }
  const limits = { faces: vertices, rotation_largest: 4, splats_per_face: splats + 1 };
  if (header.light) {
    const { damping, recorded, typical } = header.light;
    require(damping >= 0 && damping <= 1 && numbers(recorded, 27) && numbers(typical, 3), 'light');
    const lashes = arrays.light_lash_face?.shape[0] ?? 0;
    shapesOf.push(['light_transfer', vertices, 9], ['light_irradiance', vertices, 3]);
    shapesOf.push(['light_occlusion light_roughness', vertices], ['light_face', splats]);
    shapesOf.push(['light_lash_face', lashes], ['light_lash_corners', lashes, 12]);
    Object.assign(limits, { light_face: faces, light_lash_face: faces });
  }

  for (const [names, ...expected] of shapesOf) {
    for (const name of names.split(' ')) {
      const { shape, values } = arrays[name] ?? { shape: [], values: [] };
      require(shape.join() === expected.join(), name);
      require(!(values instanceof Float32Array) || values.every(Number.isFinite), name);
    }
  }
  for (const [name, past] of Object.entries(limits)) {
    require(arrays[name].values.every(value => isIndex(value, past)), name);
  }
  const sum = arrays.splats_per_face.values.reduce((sum, count) => sum + count, 0);
  require(sum === splats, 'splats_per_face');
  for (const [joint, parent] of header.parents.entries())
    require(parent === -1 || isIndex(parent, joint), 'parents');
  require(header.convention === 'stga' || header.convention === 'gaussian_avatars', 'convention');
  require(typeof header.antialiased === 'boolean', 'antialiased');
  require(isText(header.title), 'title');
  require(numbers([header.fps], 1) && header.fps > 0 && header.fps <= 1000, 'fps');
  require(numbers(header.background, 3), 'background');
  require(Math.min(...header.background, 1 - Math.max(...header.background)) >= 0, 'background');
  require(numbers(header.up, 3) && Math.hypot(...header.up) > 0.1, 'up');
  require(strings(header.joints, 'joints').length === joints, 'joints');
  for (const slider of list(header.sliders, 'sliders')) {
    require(isText(slider?.name) && isIndex(slider.component, shapes), 'sliders');
    require(slider.reach > 0 && Number.isFinite(slider.reach), 'sliders');
  }
  for (const view of list(header.views, 'views')) {
    require(isText(view?.name) && numbers(view.size, 2), 'views');
    for (const side of view.size) require(side && isIndex(side, MAX_VIEW_SIZE), 'views');
    require(numbers(view.focal, 2) && Math.min(...view.focal) > 0, 'views');
    require(numbers(view.center, 2) && numbers(view.world_to_camera, 16), 'views');
  }
}

/** @type {(value: any, past: number) => boolean} */
const isIndex = (value, past) => Number.isInteger(value) && value >= 0 && value < past;

/** @type {(arrays: Record<string, DataArray>, name: string, axis: number) => number} */
function size(arrays, name, axis) {
  require(arrays[name] && arrays[name].shape.length > axis, name);
  return arrays[name].shape[axis];
}

/** @type {(value: unknown, count: number) => boolean} */
const numbers = (value, count) =>
  Array.isArray(value) && value.length === count && value.every(Number.isFinite);

/** @type {(value: any, name: string) => any[]} */
function list(value, name) {
  require(Array.isArray(value), name);
  return value;
}

/** @type {(value: any, name: string) => string[]} */
function strings(value, name) {
  require(list(value, name).every(isText), name);
  return value;
}

const isText = (/** @type {unknown} */ value) => typeof value === 'string';

/** @type {(holds: unknown, field: string) => void} */
function require(holds, field) {
  if (!holds) throw new DataError(`The avatar data is damaged: ${field} is missing or malformed.`);
}
