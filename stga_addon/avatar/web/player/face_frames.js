// Local frames of the triangles, in which splats are stored, and the triangles' strain.
// The rules are those of STGA for Blender's embedding.py and strain.py.

const MIN_DIVISOR = 1e-30;
const MIN_AREA_RATIO = 1e-4; // of a triangle that counts as a line, to its longest edge's square
const UPRIGHT_COSINE = 0.8;
const STRAIN_GAIN = 5;
const MAX_STRAIN = 2;
const MIN_SQUARED_NORMAL = 1e-24;
export const FACE_FLOATS = 16; // of a triangle in the texture: three rows of matrix | origin, then strain | selected

export class FaceFrames {
  /** Arrays of the data file, and the convention of the embedding; strain is computed where colors follow it. */
  constructor(arrays, convention) {
    const [faces, neutral] = [arrays.faces.values, arrays.neutral.values];
    this.faces = faces;
    this.count = faces.length / 3;
    this.convention = convention;
    this.world = new Float64Array(12 * this.count); // rotation · scale and origin, rows of a 3×4 matrix
    this.neutralArea = neutralAreas(faces, neutral);
    this.strain = arrays.strain_color ? new Strain(faces, neutral, arrays.strain_range?.values) : null;
  }

  /** Follow the posed vertices (3·V). */
  update(vertices) {
    const write = this.convention === 'stga' ? writeStgaFrame : writeGaussianAvatarsFrame;
    const corners = new Float64Array(9);
    for (let f = 0; f < this.count; f++) {
      gather(this.faces, f, vertices, corners);
      write(corners, this.neutralArea[f], this.world, 12 * f);
    }
    this.strain?.update(vertices);
  }

  /** Write the frames as a camera (row-major 4×4 world to camera) sees them: FACE_FLOATS a triangle. */
  compose(camera, out) {
    const { world, count } = this;
    for (let f = 0; f < count; f++) {
      const w = 12 * f;
      for (let row = 0; row < 3; row++) {
        const [a, b, c] = [camera[4 * row], camera[4 * row + 1], camera[4 * row + 2]];
        const to = FACE_FLOATS * f + 4 * row;
        out[to] = a * world[w] + b * world[w + 4] + c * world[w + 8];
        out[to + 1] = a * world[w + 1] + b * world[w + 5] + c * world[w + 9];
        out[to + 2] = a * world[w + 2] + b * world[w + 6] + c * world[w + 10];
        out[to + 3] = a * world[w + 3] + b * world[w + 7] + c * world[w + 11] + camera[4 * row + 3];
      }
    }
  }

  /** Write strain and the selection flags (bits, or null: all selected) of the triangles. */
  annotate(selection, out) {
    const strain = this.strain?.values;
    for (let f = 0; f < this.count; f++) {
      const to = FACE_FLOATS * f + 12;
      for (let k = 0; k < 3; k++) out[to + k] = strain ? strain[3 * f + k] : 0;
      out[to + 3] = selection ? (selection[f >> 3] >> (7 - (f & 7))) & 1 : 1;
    }
  }
}

function gather(faces, face, vertices, corners) {
  for (let corner = 0; corner < 3; corner++) {
    const from = 3 * faces[3 * face + corner];
    corners[3 * corner] = vertices[from];
    corners[3 * corner + 1] = vertices[from + 1];
    corners[3 * corner + 2] = vertices[from + 2];
  }
}

function neutralAreas(faces, neutral) {
  const areas = new Float64Array(faces.length / 3);
  const corners = new Float64Array(9);
  for (let f = 0; f < areas.length; f++) {
    gather(faces, f, neutral, corners);
    const area = normalOf(corners) / 2;
    areas[f] = area > Math.max(MIN_AREA_RATIO * longestSquared(corners), MIN_DIVISOR) ? area : 0;
  }
  return areas;
}

const normal = new Float64Array(3);
const first = new Float64Array(3);

/** Write the triangle's normal to `normal`, as long as twice the area, which is returned. */
function normalOf(c) {
  const [ux, uy, uz] = [c[3] - c[0], c[4] - c[1], c[5] - c[2]];
  const [vx, vy, vz] = [c[6] - c[0], c[7] - c[1], c[8] - c[2]];
  normal[0] = uy * vz - uz * vy;
  normal[1] = uz * vx - ux * vz;
  normal[2] = ux * vy - uy * vx;
  return Math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2);
}

function longestSquared(c) {
  let longest = 0;
  for (let a = 0; a < 9; a += 3) {
    const b = (a + 3) % 9;
    longest = Math.max(longest, (c[b] - c[a]) ** 2 + (c[b + 1] - c[a + 1]) ** 2 + (c[b + 2] - c[a + 2]) ** 2);
  }
  return longest;
}

/** Axes [first, normal × first, normal]; scale sqrt(area / neutral area). */
function writeStgaFrame(c, neutralArea, out, at) {
  for (let k = 0; k < 3; k++) first[k] = (c[k] - c[3 + k] + (c[k] - c[6 + k])) / 3;
  const twice = normalOf(c);
  const scale = neutralArea > 0 ? Math.sqrt(twice / 2 / Math.max(neutralArea, MIN_DIVISOR)) : 1;
  orthonormalize(longestSquared(c), twice);
  writeAxes(c, scale, first, crossed(normal, first), normal, out, at);
}

/** Axes [first, normal, first × normal]; scale the mean of edge and height. */
function writeGaussianAvatarsFrame(c, neutralArea, out, at) {
  for (let k = 0; k < 3; k++) first[k] = c[3 + k] - c[k];
  const edge = Math.sqrt(first[0] ** 2 + first[1] ** 2 + first[2] ** 2);
  const side = Math.sqrt((c[6] - c[0]) ** 2 + (c[7] - c[1]) ** 2 + (c[8] - c[2]) ** 2);
  const [twice, longest] = [normalOf(c), longestSquared(c)];
  const height = edge <= MIN_AREA_RATIO * Math.sqrt(longest) ? side : twice / edge;
  orthonormalize(longest, twice);
  writeAxes(c, (edge + height) / 2, first, normal, crossed(first, normal), out, at);
}

/** Make `first` and `normal` unit vectors perpendicular to each other, with substitutes where a triangle has none. */
function orthonormalize(longest, twice) {
  const length = Math.sqrt(first[0] ** 2 + first[1] ** 2 + first[2] ** 2);
  if (length <= MIN_AREA_RATIO * Math.sqrt(longest)) first.set([1, 0, 0]);
  else scaleBy(first, 1 / length);
  if (twice <= 2 * MIN_AREA_RATIO * longest) {
    const upright = Math.abs(first[2]) > UPRIGHT_COSINE;
    normal.set(crossed(first, upright ? [1, 0, 0] : [0, 0, 1]));
  }
  const along = normal[0] * first[0] + normal[1] * first[1] + normal[2] * first[2];
  for (let k = 0; k < 3; k++) normal[k] -= along * first[k];
  scaleBy(normal, 1 / Math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2));
}

function writeAxes(c, scale, x, y, z, out, at) {
  for (let row = 0; row < 3; row++) {
    out[at + 4 * row] = scale * x[row];
    out[at + 4 * row + 1] = scale * y[row];
    out[at + 4 * row + 2] = scale * z[row];
    out[at + 4 * row + 3] = (c[row] + c[3 + row] + c[6 + row]) / 3;
  }
}

export function crossed(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function scaleBy(v, factor) {
  for (let k = 0; k < 3; k++) v[k] *= factor;
}

/**
 * Green's strain of the triangles against the neutral mesh, averaged over neighbors: three components, clipped to the
 * triangle's range (lowest three, highest three), or to ±MAX_STRAIN.
 */
class Strain {
  constructor(faces, neutral, range) {
    this.faces = faces;
    this.range = range ?? null;
    const count = faces.length / 3;
    this.values = new Float32Array(3 * count);
    this.gram = new Float64Array(3 * count);
    this.toTensor = new Float64Array(18 * count); // change of gram → tensor xx, yy, zz, xy, yz, zx
    this.toPlane = new Float64Array(18 * count); // tensor → along the first edge, across it, shear
    this.touching = new Float64Array(neutral.length / 3);
    this.atVertex = new Float64Array(2 * neutral.length);
    for (const vertex of faces) this.touching[vertex]++;
    const corners = new Float64Array(9);
    for (let f = 0; f < count; f++) {
      gather(faces, f, neutral, corners);
      this.prepare(f, corners);
    }
  }

  prepare(f, c) {
    const d1 = [c[3] - c[0], c[4] - c[1], c[5] - c[2]];
    const d2 = [c[6] - c[0], c[7] - c[1], c[8] - c[2]];
    gramOf(c, this.gram, 3 * f);
    const square = normalOf(c) ** 2;
    if (square < MIN_SQUARED_NORMAL) return;
    const n = Array.from(normal);
    const a1 = crossed(d2, n).map((value) => value / square);
    const a2 = crossed(n, d1).map((value) => value / square);
    const along = d1.map((value) => value / Math.hypot(...d1));
    const across = crossed(n, along).map((value) => value / Math.sqrt(square));
    symmetricProduct(a1, a1, 0.5, this.toTensor, 18 * f);
    symmetricProduct(a1, a2, 1, this.toTensor, 18 * f + 6);
    symmetricProduct(a2, a2, 0.5, this.toTensor, 18 * f + 12);
    symmetricProduct(along, along, 1, this.toPlane, 18 * f);
    symmetricProduct(across, across, 1, this.toPlane, 18 * f + 6);
    symmetricProduct(along, across, 1, this.toPlane, 18 * f + 12);
    // A tensor has each of the mixed components twice.
    for (let k = 0; k < 18; k++) if (k % 6 > 2) this.toPlane[18 * f + k] *= 2;
  }

  update(vertices) {
    this.spread(vertices);
    const { faces, atVertex, toPlane, touching, range, values } = this;
    const tensor = new Float64Array(6);
    for (let f = 0; f < values.length / 3; f++) {
      tensor.fill(0);
      for (let corner = 0; corner < 3; corner++) {
        const vertex = faces[3 * f + corner];
        for (let k = 0; k < 6; k++) tensor[k] += atVertex[6 * vertex + k] / (3 * touching[vertex]);
      }
      for (let row = 0; row < 3; row++) {
        let sum = 0;
        for (let k = 0; k < 6; k++) sum += toPlane[18 * f + 6 * row + k] * tensor[k];
        const lowest = range ? range[6 * f + row] : -MAX_STRAIN;
        const highest = range ? range[6 * f + 3 + row] : MAX_STRAIN;
        values[3 * f + row] = Math.min(highest, Math.max(lowest, STRAIN_GAIN * sum));
      }
    }
  }

  /** Add every triangle's tensor to its three vertices. */
  spread(vertices) {
    const { faces, gram, toTensor, atVertex } = this;
    const corners = new Float64Array(9);
    const change = new Float64Array(3);
    atVertex.fill(0);
    for (let f = 0; f < faces.length / 3; f++) {
      gather(faces, f, vertices, corners);
      gramOf(corners, change, 0);
      for (let k = 0; k < 3; k++) change[k] -= gram[3 * f + k];
      for (let k = 0; k < 6; k++) {
        const t = 18 * f + k;
        const part = change[0] * toTensor[t] + change[1] * toTensor[t + 6] + change[2] * toTensor[t + 12];
        for (let corner = 0; corner < 3; corner++) atVertex[6 * faces[3 * f + corner] + k] += part;
      }
    }
  }
}

/** Squared lengths and product of the edges from the first corner: d1·d1, d1·d2, d2·d2. */
function gramOf(c, out, at) {
  const [ux, uy, uz] = [c[3] - c[0], c[4] - c[1], c[5] - c[2]];
  const [vx, vy, vz] = [c[6] - c[0], c[7] - c[1], c[8] - c[2]];
  out[at] = ux * ux + uy * uy + uz * uz;
  out[at + 1] = ux * vx + uy * vy + uz * vz;
  out[at + 2] = vx * vx + vy * vy + vz * vz;
}

/** Symmetric part of the outer product of two vectors, times a factor: xx, yy, zz, xy, yz, zx. */
function symmetricProduct(a, b, factor, out, at) {
  for (let k = 0; k < 3; k++) {
    const next = (k + 1) % 3;
    out[at + k] = factor * a[k] * b[k];
    out[at + 3 + k] = (factor * (a[k] * b[next] + a[next] * b[k])) / 2;
  }
}
