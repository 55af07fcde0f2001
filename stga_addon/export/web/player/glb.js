// @ts-check
// Reading of skinned splats: glTF with a skinned, morphing mesh and splats bound to its triangles
// (docs/formats.md).

/** @import { DataArray, Values } from './types.js' */

import { axisAngleOf } from './vector.js';

const JSON_CHUNK = 0x4e4f534a;
const HEADER_BYTES = 12;
const CHUNK_BYTES = 8;
/** Component type -> array, and what an integer is divided by where it is normalized. */
/** @type {Record<number, [any, number]>} */
const COMPONENTS = {
  5121: [Uint8Array, 255],
  5122: [Int16Array, 32767],
  5123: [Uint16Array, 65535],
  5125: [Uint32Array, 1],
  5126: [Float32Array, 1],
};
const SHORT = 5122;
/** @type {Record<string, number>} */
const WIDTHS = { SCALAR: 1, VEC3: 3, VEC4: 4, MAT4: 16 };

// The document of a .glb file, and its binary chunk.
/** @type {(bytes: Uint8Array<ArrayBuffer>) => { document: any, binary: Uint8Array<ArrayBuffer> }} */
export function parseGlb(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const size = view.getUint32(HEADER_BYTES, true);
  const begin = HEADER_BYTES + CHUNK_BYTES;
  if (view.getUint32(HEADER_BYTES + 4, true) !== JSON_CHUNK) throw new RangeError('no document');
  const text = new TextDecoder('utf-8', { fatal: true }).decode(bytes.slice(begin, begin + size));
  const document = JSON.parse(text);
  const binary = bytes.slice(begin + size + CHUNK_BYTES);
  if (!(document.buffers[0].byteLength <= binary.length)) throw new RangeError('cut off');
  if (document.extras.stga_splats.planes) leavePlanes(document, binary);
  return { document, binary };
}

// What a buffer view, or what else has a place in the chunk, holds.
/** @type {(binary: Uint8Array<ArrayBuffer>, place: any) => Uint8Array<ArrayBuffer>} */
export function bytesOf(binary, { byteOffset = 0, byteLength }) {
  const bytes = binary.subarray(byteOffset, byteOffset + byteLength);
  if (bytes.length !== byteLength) throw new RangeError('cut off');
  return bytes;
}

// Put buffer views back, of which a page has one byte of all components after the other, and of
// integers without sign and floats the difference from the row before.
/** @type {(document: any, binary: Uint8Array<ArrayBuffer>) => void} */
function leavePlanes(document, binary) {
  /** @type {Map<number, [number, number]>} */
  const layouts = new Map();
  for (const { bufferView, componentType, sparse, type } of document.accessors) {
    if (bufferView !== undefined) layouts.set(bufferView, [componentType, WIDTHS[type]]);
    if (!sparse) continue;
    layouts.set(sparse.indices.bufferView, [sparse.indices.componentType, 1]);
    layouts.set(sparse.values.bufferView, [componentType, WIDTHS[type]]);
  }
  for (const [index, [componentType, width]] of layouts) {
    const stored = bytesOf(binary, document.bufferViews[index]);
    const planes = stored.slice();
    const size = COMPONENTS[componentType][0].BYTES_PER_ELEMENT;
    const row = size * width;
    const rows = planes.length / row;
    for (let k = 0; k < row; k++)
      for (let n = 0; n < rows; n++) stored[n * row + k] = planes[k * rows + n];
    if (componentType === SHORT) continue;
    for (let at = row; at < stored.length; at += size) {
      for (let k = 0, carry = 0; k < size; k++) {
        carry += stored[at + k] + stored[at + k - row];
        stored[at + k] = carry;
        carry >>= 8;
      }
    }
  }
}

// What the accessors hold of the mesh, its rig and its motion, as arrays of the player.
/** @type {(document: any, binary: Uint8Array<ArrayBuffer>) => { joints: string[], parents: number[], arrays: Record<string, DataArray> }} */
export function readSkin(document, binary) {
  const { accessors, animations, bufferViews, meshes, nodes, skins } = document;
  /** @type {(componentType: number, count: number, view: number, offset?: number) => any} */
  const typed = (componentType, count, view, offset = 0) => {
    const [kind] = COMPONENTS[componentType];
    const bytes = bytesOf(binary, bufferViews[view]);
    const end = offset + count * kind.BYTES_PER_ELEMENT;
    if (end > bytes.length) throw new RangeError('cut off');
    return new kind(bytes.slice(offset, end).buffer);
  };
  /** @type {(index: number, into?: Float32Array) => any} */
  const read = (index, into) => {
    const { bufferView, byteOffset, componentType, count, normalized, sparse, type } =
      accessors[index];
    const width = WIDTHS[type];
    const divisor = normalized ? COMPONENTS[componentType][1] : 1;
    if (sparse) {
      const { indices, values } = sparse;
      const counted = sparse.count;
      const moved = typed(indices.componentType, counted, indices.bufferView, indices.byteOffset);
      const by = typed(componentType, width * counted, values.bufferView, values.byteOffset);
      if (into)
        moved.forEach((/** @type {number} */ vertex, /** @type {number} */ n) => {
          for (let k = 0; k < width; k++) into[width * vertex + k] = by[width * n + k] / divisor;
        });
      return into;
    }
    if (bufferView === undefined) return into;
    const values = typed(componentType, width * count, bufferView, byteOffset);
    return normalized ? Float32Array.from(values, value => value / divisor) : values;
  };
  const [skin] = skins;
  const [primitive] = meshes[0].primitives;
  const { attributes, targets = [] } = primitive;
  const bind = read(skin.inverseBindMatrices);
  const unit = bind[0]; // meters
  const base = read(attributes.POSITION).map((/** @type {number} */ value) => unit * value);
  const vertices = base.length / 3;
  const count = skin.joints.length;
  const basis = new Float32Array(targets.length * base.length);
  for (const [shape, { POSITION }] of targets.entries())
    read(POSITION, basis.subarray(shape * base.length, (shape + 1) * base.length));
  for (let k = 0; k < basis.length; k++) basis[k] *= unit;
  const weights = new Float32Array(vertices * count);
  for (let set = 0; attributes[`JOINTS_${set}`] !== undefined; set++) {
    const joints = read(attributes[`JOINTS_${set}`]);
    const shares = read(attributes[`WEIGHTS_${set}`]);
    for (let k = 0; k < joints.length; k++) weights[(k >> 2) * count + joints[k]] += shares[k];
  }
  const rest = Float32Array.from(
    { length: 3 * count },
    (_, k) => -bind[16 * Math.floor(k / 3) + 12 + (k % 3)],
  );
  const { channels, samplers } = animations[0];
  const frames = read(samplers[0].input).length;
  const pose = new Float32Array(3 * frames * count);
  const translation = new Float32Array(3 * frames);
  let coefficients = new Float32Array(0);
  for (const { sampler, target } of channels) {
    const values = read(samplers[sampler].output);
    const joint = skin.joints.indexOf(target.node);
    if (target.path === 'weights') coefficients = values;
    for (let frame = 0; frame < frames && joint >= 0; frame++) {
      if (target.path === 'rotation') {
        const [x, y, z, w] = values.subarray(4 * frame, 4 * frame + 4);
        pose.set(axisAngleOf(w < 0 ? [-w, -x, -y, -z] : [w, x, y, z]), 3 * (frame * count + joint));
      } else if (target.path === 'translation') {
        for (let k = 0; k < 3; k++)
          translation[3 * frame + k] = values[3 * frame + k] - rest[3 * joint + k];
      }
    }
  }
  /** @type {(values: Values, ...shape: number[]) => DataArray} */
  const array = (values, ...shape) => ({ shape, values });
  const parents = skin.joints.map((/** @type {number} */ joint) =>
    skin.joints.findIndex((/** @type {number} */ other) => nodes[other].children?.includes(joint)),
  );
  const arrays = {
    base: array(base, vertices, 3),
    faces: array(
      Int32Array.from(read(primitive.indices)),
      accessors[primitive.indices].count / 3,
      3,
    ),
    basis: array(basis, targets.length, vertices, 3),
    weights: array(weights, vertices, count),
    joint_rest: array(rest, count, 3),
    coefficients: array(coefficients, frames, targets.length),
    pose: array(pose, frames, count, 3),
    translation: array(translation, frames, 3),
  };
  return {
    joints: skin.joints.map((/** @type {number} */ joint) => nodes[joint].name),
    parents,
    arrays,
  };
}
