// Order of the splats from back to front: a counting sort of their depths in 16 bits.

import { FACE_FLOATS } from './face_frames.js';

const BUCKETS = 1 << 16;

export class DepthSort {
  /** xyz (3·N) of splats sorted by triangle, and how many each triangle has. */
  constructor(xyz, splatsPerFace) {
    this.xyz = xyz;
    this.splatsPerFace = splatsPerFace;
    const count = xyz.length / 3;
    this.depth = new Float32Array(count);
    this.key = new Uint16Array(count);
    this.start = new Uint32Array(BUCKETS + 1);
    this.order = new Uint32Array(count);
  }

  /** Indices of the splats, farthest first; `frames` as FaceFrames.compose writes them. */
  sort(frames) {
    const { depth, key, start, order } = this;
    const [near, far] = this.measure(frames);
    const scale = (BUCKETS - 1) / (far - near || 1);
    start.fill(0);
    for (let i = 0; i < depth.length; i++) {
      const bucket = (far - Math.max(depth[i], near)) * scale;
      key[i] = bucket;
      start[key[i] + 1]++;
    }
    for (let k = 0; k < BUCKETS; k++) start[k + 1] += start[k];
    for (let i = 0; i < depth.length; i++) order[start[key[i]]++] = i;
    return order;
  }

  /** Fill `depth`; returns the nearest in front of the camera and the farthest. */
  measure(frames) {
    const { xyz, splatsPerFace, depth } = this;
    let [near, far] = [Infinity, 0];
    for (let f = 0, i = 0; f < splatsPerFace.length; f++) {
      const at = FACE_FLOATS * f + 8;
      const [a, b, c, d] = [frames[at], frames[at + 1], frames[at + 2], frames[at + 3]];
      for (const end = i + splatsPerFace[f]; i < end; i++) {
        const z = a * xyz[3 * i] + b * xyz[3 * i + 1] + c * xyz[3 * i + 2] + d;
        depth[i] = z;
        if (z < near && z > 0) near = z;
        if (z > far) far = z;
      }
    }
    return [Math.min(near, far), far];
  }
}
